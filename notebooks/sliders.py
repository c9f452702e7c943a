"""The panels of play.md: every optimum behind their sliders, proved while the book is made.

A panel has one or two sliders.  For each of their positions there is a frame: an optimal schedule,
a picture of it, and what it costs.  sliders.js shows the frame chosen and computes nothing; on
paper, or without scripts, a table stands in its place.
"""

from __future__ import annotations

import json
from dataclasses import replace
from functools import cache
from io import StringIO
from itertools import product
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import ArrayLike
from scipy.spatial import ConvexHull

import landing
import modelselect as ms
from perception import sample_errors

RATIOS = [(1, 2**k) for k in range(6, 0, -1)] + [(2**k, 1) for k in range(10)]  # alpha : beta
BIASES = [k / 10 for k in range(11)]  # m/s
NOISES = BIASES[1:]
TOLLS = [0, 0.002, 0.005, 0.01, 0.02, 0.03, 0.05, 0.07, 0.1, 0.15, 0.2, 0.3, 0.5]
LARGEST_BUDGET = 72  # more buys nothing
WIDTH, HEIGHT = 760, 420  # of a picture

# --- three robots ---


@cache
def drone() -> landing.Result:
    """Land the aircraft of the literature, 20 s in 150 steps, with eight models."""
    return landing.run_experiment(landing.Settings(preset="textbook", trials=1))


def landing_problem(alpha: float, beta: float) -> ms.SelectionProblem:
    """Weigh control against perception; the weights are scaled to add up to 1."""
    whole = alpha + beta
    return replace(drone().problem, alpha=alpha / whole, beta=beta / whole)


#: A boat, held at its mooring for 8 s in 40 steps; waves displace it (notebook 1).
BOAT = ms.ControlTask(
    [[1, 0.2], [-0.2, 0.95]], [[0], [0.2]], [[0.2], [0]], np.diag([1, 0]), [[0.1]], 40
)


def boat_problem(bias: float, noise: float) -> ms.SelectionProblem:
    """Choose between a biased model and a noisy one, both free (m/s)."""
    mean = np.tile([[bias], [0.0]], (40, 1, 1))
    variance = np.tile([[0.0], [noise**2]], (40, 1, 1))
    return ms.SelectionProblem(ms.psi(BOAT, "preview"), mean, variance, [0, 0])


@cache
def cart_problem(toll: float = 0.0) -> ms.SelectionProblem:
    """Steer a cart for 2 s in 20 steps with four models; a change of model costs the toll."""
    A, B, C = [[1, 0.1], [0, 1]], [[0], [0.1]], [[0.1], [0]]
    task = ms.ControlTask(A, B, C, np.eye(2), [[0.1]], 20)
    mean = np.tile([[0.6], [-0.4], [0.2], [0.05]], (20, 1, 1))
    variance = np.tile([[0.16], [0.09], [0.04], [0.01]], (20, 1, 1))
    cost = 0.02 * np.array([0, 1, 2, 4])
    return ms.SelectionProblem(
        ms.psi(task, "preview"), mean, variance, cost, switch_cost=toll * (1 - np.eye(4))
    )


def budget_problem(budget: float) -> ms.SelectionProblem:
    """Steer the cart as well as the budget allows, with prices in whole units."""
    free = replace(cart_problem(), switch_cost=None, alpha=1.0, beta=0.0)
    return replace(free, model_cost=[0.0, 1.0, 2.0, 4.0], budget=budget)


def proved(problem: ms.SelectionProblem) -> ms.Schedule:
    """Return the optimum, or refuse what is not proved."""
    schedule = ms.solve(problem)
    ms.check_certificate(problem, schedule)
    if not schedule.is_optimal:
        raise ValueError(f"sliders: a gap of {schedule.gap:.1e} is left, so this is no optimum")
    return schedule


def number(value: float) -> str:
    """Write a cost to three digits, thousands with commas."""
    return f"{value:,.0f}" if abs(value) >= 1000 else f"{value:.3g}"


# --- a panel ---


class Panel:
    """Sliders (name, values, first position) above two charts: an effect, and the models in use."""

    def __init__(
        self, key: str, sliders: list[tuple[str, list[str], int]], names: list[str], steps: int
    ) -> None:
        """Draw the lower chart; whoever makes a panel draws in the upper one."""
        self.key, self.sliders, self.names, self.steps = key, sliders, names, steps
        self.frames: list[dict[str, Any]] = []
        self.figure = Figure((WIDTH / 72, HEIGHT / 72), dpi=72)  # SVG has 72 units an inch
        with mpl.rc_context(landing.STYLE):
            self.above = self.figure.add_axes((0.1, 0.44, 0.88, 0.53))
            self.below = self.figure.add_axes((0.1, 0.11, 0.88, 0.18))
        ticks = range(0, steps + 1, steps // 5)
        self.below.set(xlim=(0, steps), xticks=ticks, ylim=(0, len(names) - 1), xlabel="step")
        labelled = range(0, len(names), 1 + len(names) // 5)
        self.below.set_yticks(labelled, [names[k] for k in labelled])

    def path(self, kind: str, x: ArrayLike, y: ArrayLike, chart: Axes | None = None) -> str:
        """Draw a line through points; those beyond the chart, which is the upper one, at its edge."""
        chart = chart or self.above
        within = np.transpose([x, np.clip(y, *chart.get_ylim())])
        points = (f"{a:.1f} {HEIGHT - b:.1f}" for a, b in chart.transData.transform(within))
        return f'<path class="{kind}" d="M{"L".join(points)}"/>'

    def add(self, best: ms.Schedule, facts: dict[str, str], picture: str) -> None:
        """Add the next position: to its picture when which model runs, to its facts how often."""
        time, models = np.repeat(np.arange(self.steps + 1), 2)[1:-1], np.repeat(best.choices, 2)
        picture += self.path("stairs", time, models, self.below)
        counts = np.bincount(best.choices, minlength=len(self.names))
        used = ", ".join(f"{name} {n}" for name, n in zip(self.names, counts, strict=True) if n)
        self.frames.append({"picture": picture, "facts": facts | {"steps by model": used}})

    def svg(self) -> str:
        """Write the charts, with a group for what moves."""
        file = StringIO()
        with mpl.rc_context({"svg.fonttype": "none", "svg.hashsalt": self.key}):
            self.figure.savefig(file, format="svg", metadata={"Date": None})
        shown = f"{self.above.get_ylabel()} over {self.above.get_xlabel()}"
        label = f"{shown}, and model in use over {self.steps} steps"
        svg = file.getvalue().partition("<svg")[2].rpartition("</svg>")[0]
        return f'<svg role="img" aria-label="{label}"{svg}<g class="moving"></g></svg>'

    def table(self) -> str:
        """Write all facts, a position a row; with two sliders, their costs as a grid."""
        (head, values, _), *second = self.sliders
        facts = [frame["facts"] for frame in self.frames]
        columns, cells = list(facts[0]), [list(fact.values()) for fact in facts]
        if second:
            other, columns, _ = second[0]
            head = f"cost of the optimum: {head} down, {other} across"
            cells = [fact["cost of the optimum"] for fact in facts]
        lines = ["".join(f'<th scope="col">{name}</th>' for name in (head, *columns))]
        for value, row in zip(values, np.reshape(cells, (len(values), -1)), strict=True):
            lines.append(f'<th scope="row">{value}</th>' + "".join(f"<td>{x}</td>" for x in row))
        return "<table>" + "\n".join(f"<tr>{line}</tr>" for line in lines) + "</table>"

    def html(self) -> str:
        """Write sliders, a picture, its numbers, and the table of all numbers."""
        key = self.key
        sliders = "".join(
            f'<label for="{key}-{k}">{name}</label><input type="range" id="{key}-{k}" min="0" '
            f'max="{len(values) - 1}" value="{start}" aria-controls="{key}-facts" '
            f'autocomplete="off"><span aria-hidden="true"></span>'
            for k, (name, values, start) in enumerate(self.sliders)
        )
        data = json.dumps({"sliders": self.sliders, "frames": self.frames}, ensure_ascii=False)
        return f"""<div class="panel" id="{key}" role="group" aria-label="{key}">
<div class="sliders">{sliders}</div>
{self.svg()}
<output id="{key}-facts"></output>
<button type="button" aria-expanded="false" aria-controls="{key}-all">All as a table</button>
<div class="table" id="{key}-all" role="region" aria-label="{key}: all positions" tabindex="0">
{self.table()}
</div>
<script type="application/json">{data}</script>
</div>
"""


# --- the panels ---


def weights_panel() -> Panel:
    """Slide alpha : beta of the landing."""
    run, rng, time = drone(), np.random.default_rng(0), np.linspace(0, 20, 151)
    panel = Panel(
        "weights",
        [("α : β", [f"{a} : {b}" for a, b in RATIOS], RATIOS.index((4, 1)))],
        list(run.suite.names),
        150,
    )
    panel.above.set(xlim=(0, 20), xlabel="time (s)", ylim=(-100, 110), ylabel="altitude (ft)")
    s = run.landing.draw_inputs(rng, 1)
    errors = sample_errors(run.suite, 1, rng)
    for ratio in RATIOS:
        problem = landing_problem(*ratio)
        best = proved(problem)
        flown = landing.fly(run.landing, "open_loop", s, errors, best.choices)[0][0]
        off = np.abs(flown - run.landing.path).max()
        facts = {
            "expected control cost of errors": number(problem.control_term(best.choices)),
            "perception cost": number(problem.perception_term(best.choices)),
            "weighted total": number(best.cost),
            "no schedule is below": number(best.lower_bound),
            "this flight leaves its path by at most": f"{off:.1f} ft",
        }
        panel.add(best, facts, panel.path("line", time, flown))
    panel.above.plot(time, run.landing.path, "k:")
    return panel


def errors_panel() -> Panel:
    """Slide the bias of one model against the noise of another."""
    tens = [f"{value:.1f} m/s" for value in BIASES]
    panel = Panel(
        "errors",
        [("bias of the biased model", tens, 3), ("noise of the noisy model", tens[1:], 4)],
        ["biased", "noisy"],
        40,
    )
    panel.above.set(xlim=(0, 8), xlabel="time (s)", ylim=(-0.5, 0.5), ylabel="position (m)")
    time, pushes = np.linspace(0, 8, 41), np.eye(40)[:, :, None]
    moved = ms.run_controller(BOAT, [0, 0], 0 * pushes, pushes, "preview")[0][..., 0]
    there_and_back = np.concatenate([time, time[::-1]])
    for bias, noise in product(BIASES, NOISES):
        problem = boat_problem(bias, noise)
        best = proved(problem)
        always = problem.total_cost(np.repeat([[0], [1]], 40, axis=1))
        drift = problem.chosen_mean(best.choices) @ moved
        spread = np.sqrt((noise**2 * (best.choices == 1)) @ moved**2)
        facts = {
            "mean square, biased and noisy": f"{bias**2:.2f} and {noise**2:.2f}",
            "cost of always biased": number(always[0]),
            "cost of always noisy": number(always[1]),
            "cost of the optimum": number(best.cost),
        }
        edge = np.concatenate([drift - spread, (drift + spread)[::-1]])
        band = panel.path("band", there_and_back, edge)
        panel.add(best, facts, band + panel.path("line", time, drift))
    return panel


def switching_panel() -> Panel:
    """Slide what a change of model costs."""
    panel = Panel(
        "switching",
        [("cost of a switch", [f"{toll:g}" for toll in TOLLS], 0)],
        ["b0", "b1", "b2", "b3"],
        20,
    )
    panel.above.set(
        xlim=(0, TOLLS[-1]), xlabel="cost of a switch", ylim=(0, 1.2), ylabel="total of the optimum"
    )
    for toll in TOLLS:
        problem = cart_problem(toll)
        best = proved(problem)
        switches = int((np.diff(best.choices) != 0).sum())
        models = problem.perception_term(best.choices) - toll * switches
        facts = {
            "control": number(problem.control_term(best.choices)),
            "running the models": number(models),
            "switches": f"{switches}, for {number(toll * switches)}",
            "total": number(best.cost),
            "no schedule is below": number(best.lower_bound),
        }
        rest = best.cost - toll * switches
        end = min(TOLLS[-1], (1.2 - rest) / max(switches, 1))
        line = panel.path("straight", [0, end], [rest, rest + end * switches])
        here = panel.path("here", [toll, toll], [best.cost, best.cost])
        panel.above.plot(toll, best.cost, "k.")
        panel.add(best, facts, line + here)
    return panel


def corners(points: list[tuple[float, float]]) -> list[tuple[float, float]]:
    """Keep the corners of the convex hull below points of ascending x: those that weights reach."""
    hull = ConvexHull(points)
    below = hull.simplices[hull.equations[:, 1] < 0]  # the edges whose normal points down
    return [points[k] for k in np.unique(below)]


@cache
def front() -> tuple[list[ms.Schedule], list[tuple[float, float]]]:
    """Return the optimum at each budget, and what it spends beside its control cost."""
    optima = [proved(budget_problem(budget)) for budget in range(LARGEST_BUDGET + 1)]
    spent = (budget_problem(LARGEST_BUDGET).perception_term(best.choices) for best in optima)
    return optima, [(float(x), best.cost) for x, best in zip(spent, optima, strict=True)]


def budget_panel() -> Panel:
    """Slide the budget along the whole front."""
    optima, points = front()
    hull = corners(sorted(set(points)))
    panel = Panel(
        "budget",
        [("budget", [str(budget) for budget in range(len(optima))], 30)],
        ["b0", "b1", "b2", "b3"],
        20,
    )
    panel.above.set(
        xlim=(0, LARGEST_BUDGET), xlabel="spent", ylim=(0.005, 4), ylabel="control", yscale="log"
    )
    panel.above.plot(*zip(*points, strict=True), "k.")
    panel.above.plot(*zip(*hull, strict=True), "ko", fillstyle="none")
    for budget, (best, (spent, cost)) in enumerate(zip(optima, points, strict=True)):
        reached = [cost for spending, cost in hull if spending <= budget][-1]
        more = f"{reached / best.cost - 1:.0%} more" if reached > best.cost else "the same"
        facts = {
            "spent": f"{spent:g} of {budget}",
            "control": number(best.cost),
            "the best that some α : β leads to within this budget": f"{number(reached)}, {more}",
        }
        here = panel.path("here", [spent, spent], [cost, cost])
        panel.add(best, facts, here)
    return panel


def panels() -> dict[str, str]:
    """Prove all that the panels show, which takes seconds; return them by key."""
    made = (weights_panel(), errors_panel(), switching_panel(), budget_panel())
    return {panel.key: panel.html() for panel in made}
