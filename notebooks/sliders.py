"""The page of the book to play with: every optimum behind its sliders, proved while it is made.

A panel has one or two sliders.  For each of their positions there is a frame: an optimal schedule,
what it costs, and a picture.  sliders.js shows the frame chosen and computes nothing; on paper, or
without scripts, a table stands in its place.
"""

from __future__ import annotations

import json
from dataclasses import replace
from functools import cache
from html import escape
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

import landing
from modelselect import (
    ControlTask,
    Schedule,
    SelectionProblem,
    check_certificate,
    psi,
    run_controller,
    solve,
)
from perception import sample_errors

Frame = dict[str, Any]
HERE = Path(__file__).parent
TITLE = "Play: proved optima behind sliders"
RATIOS = [(1, 2**k) for k in range(6, 0, -1)] + [(2**k, 1) for k in range(10)]  # alpha : beta
BIASES = [k / 10 for k in range(11)]  # m/s
NOISES = BIASES[1:]
TOLLS = [0, 0.002, 0.005, 0.01, 0.02, 0.03, 0.05, 0.07, 0.1, 0.15, 0.2, 0.3, 0.5]
LARGEST_BUDGET = 72  # more buys nothing

# --- three robots ---


@cache
def drone() -> landing.Result:
    """Land the aircraft of the literature, 20 s in 150 steps, with eight models."""
    return landing.run_experiment(landing.Settings(preset="textbook", trials=1))


def landing_problem(alpha: float, beta: float) -> SelectionProblem:
    """Weigh control against perception; the weights are scaled to add up to 1."""
    whole = alpha + beta
    return replace(drone().problem, alpha=alpha / whole, beta=beta / whole)


@cache
def boat() -> ControlTask:
    """Hold a boat at its mooring for 8 s in 40 steps; waves displace it (notebook 1)."""
    A, B, C = [[1, 0.2], [-0.2, 0.95]], [[0], [0.2]], [[0.2], [0]]
    return ControlTask(A, B, C, np.diag([1, 0]), [[0.1]], 40)


@cache
def boat_psi() -> np.ndarray:
    """Return what the boat's errors cost if it acts on a forecast."""
    return psi(boat(), "preview")


def boat_problem(bias: float, noise: float) -> SelectionProblem:
    """Choose between a biased model and a noisy one, both free (m/s)."""
    mean = np.tile([[bias], [0.0]], (40, 1, 1))
    variance = np.tile([[0.0], [noise**2]], (40, 1, 1))
    return SelectionProblem(boat_psi(), mean, variance, [0, 0])


@cache
def cart_problem(toll: float = 0.0) -> SelectionProblem:
    """Steer a cart for 2 s in 20 steps with four models; a change of model costs the toll."""
    A, B, C = [[1, 0.1], [0, 1]], [[0], [0.1]], [[0.1], [0]]
    task = ControlTask(A, B, C, np.eye(2), [[0.1]], 20)
    mean = np.tile([[0.6], [-0.4], [0.2], [0.05]], (20, 1, 1))
    variance = np.tile([[0.16], [0.09], [0.04], [0.01]], (20, 1, 1))
    cost = 0.02 * np.array([0, 1, 2, 4])
    return SelectionProblem(
        psi(task, "preview"), mean, variance, cost, switch_cost=toll * (1 - np.eye(4))
    )


def budget_problem(budget: float) -> SelectionProblem:
    """Steer the cart as well as the budget allows, with prices in whole units."""
    free = replace(cart_problem(), switch_cost=None, alpha=1.0, beta=0.0)
    return replace(free, model_cost=[0.0, 1.0, 2.0, 4.0], budget=budget)


# --- frames ---


def proved(problem: SelectionProblem) -> Schedule:
    """Return the optimum, or refuse what is not proved."""
    schedule = solve(problem)
    check_certificate(problem, schedule)
    if not schedule.is_optimal:
        raise ValueError(f"sliders: a gap of {schedule.gap:.1e} is left, so this is no optimum")
    return schedule


def number(value: float) -> str:
    """Write a cost to three digits, thousands with commas."""
    return f"{value:,.0f}" if abs(value) >= 1000 else f"{value:.3g}"


def used(schedule: Schedule, names: list[str]) -> str:
    """Count the steps of each model that is used."""
    counts = np.bincount(schedule.choices, minlength=len(names))
    return ", ".join(f"{name} {n}" for name, n in zip(names, counts, strict=True) if n)


def frame(schedule: Schedule, names: list[str], facts: dict[str, str], **picture: Any) -> Frame:
    """Gather what is shown at one position of the sliders."""
    models = {"steps by model": used(schedule, names)}
    return {"models": schedule.choices.tolist(), "facts": facts | models, **picture}


def rounded(values: np.ndarray) -> list[float]:
    """Keep the digits that a picture can show."""
    return [float(f"{value:.4g}") for value in np.asarray(values)]


def axis(label: str, low: float, high: float, ticks: Any) -> dict[str, Any]:
    """Describe an axis; a tick is a number."""
    named = [(float(tick), f"{tick:g}".replace("-", "−")) for tick in ticks]
    return {"label": label, "low": low, "high": high, "ticks": named}


# --- panels ---


def weights_panel() -> dict[str, Any]:
    """Slide alpha : beta of the landing."""
    run, names, rng = drone(), list(drone().suite.names), np.random.default_rng(0)
    s = run.landing.draw_inputs(rng, 1)
    errors = sample_errors(run.suite, 1, rng)
    frames = []
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
        frames.append(frame(best, names, facts, line=rounded(flown)))
    return {
        "id": "weights",
        "title": "α : β, the landing",
        "text": "A drone lands from 100 ft in 20 s on a forecast by eight models: b0 is free and "
        'far off, b7 dear and nearly right (<a href="05_landing.html">notebook 5</a>). The weight '
        "α counts control, β perception. Same gusts, same luck: only the schedule changes. Costs know "
        "the dotted glide path, but no ground: who departs from it below 0 has crashed.",
        "sliders": [("α : β", [f"{a} : {b}" for a, b in RATIOS], RATIOS.index((4, 1)))],
        "names": names,
        "x": axis("time (s)", 0, 20, range(0, 21, 5)),
        "y": axis("altitude (ft)", -100, 110, range(-100, 101, 50)),
        "dotted": rounded(run.landing.path),
        "frames": frames,
    }


def errors_panel() -> dict[str, Any]:
    """Slide the bias of one model against the noise of another."""
    task, names, zero = boat(), ["biased", "noisy"], np.zeros((40, 40, 1))
    pushed = run_controller(task, [0, 0], zero, np.eye(40)[:, :, None], "preview")[0][..., 0]
    frames = []
    for bias, noise in product(BIASES, NOISES):
        problem = boat_problem(bias, noise)
        best = proved(problem)
        always = problem.total_cost(np.repeat([[0], [1]], 40, axis=1))
        drift = problem.chosen_mean(best.choices) @ pushed
        spread = np.sqrt((noise**2 * (best.choices == 1)) @ pushed**2)
        facts = {
            "mean square, biased and noisy": f"{bias**2:.2f} and {noise**2:.2f}",
            "cost of always biased": number(always[0]),
            "cost of always noisy": number(always[1]),
            "cost of the optimum": number(best.cost),
        }
        band = [rounded(drift - spread), rounded(drift + spread)]
        frames.append(frame(best, names, facts, line=rounded(drift), band=band))
    tens = [f"{value:.1f} m/s" for value in BIASES]
    return {
        "id": "errors",
        "title": "Bias against noise",
        "text": "A boat holds its place for 8 s by estimates of the waves. One model always errs "
        "by the same, the other by chance, as much on average as its noise says; both are free. "
        "The line is the mean position, the band one standard deviation to each side. Which has "
        'the smaller mean square, and which flies better (<a href="02_mean_and_variance.html">'
        "notebook 2</a>)?",
        "sliders": [
            ("bias of the biased model", tens, 3),
            ("noise of the noisy model", tens[1:], 4),
        ],
        "names": names,
        "x": axis("time (s)", 0, 8, range(0, 9, 2)),
        "y": axis("position (m)", -0.5, 0.5, (-0.4, 0, 0.4)),
        "frames": frames,
    }


def switching_panel() -> dict[str, Any]:
    """Slide what a change of model costs."""
    names, frames, top = ["b0", "b1", "b2", "b3"], [], 1.2
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
        end = min(TOLLS[-1], (top - rest) / max(switches, 1))
        line = [rounded([0, rest]), rounded([end, rest + end * switches])]
        frames.append(frame(best, names, facts, at=rounded([toll, best.cost]), straight=line))
    return {
        "id": "switching",
        "title": "Switching costs",
        "text": "A cart on a forecast chooses among four models whose biases, 0.6, −0.4, 0.2 and "
        "0.05, cancel if it alternates. Let every change of model cost something. A schedule is a "
        "straight line over that cost, as steep as it has switches: here is that of the optimum, "
        'and none lies below the points (<a href="03_exact.html">notebook 3</a>).',
        "sliders": [("cost of a switch", [f"{toll:g}" for toll in TOLLS], 0)],
        "names": names,
        "x": axis("cost of a switch", 0, 0.5, (0, 0.1, 0.2, 0.3, 0.4, 0.5)),
        "y": axis("total of the optimum", 0, top, (0, 0.5, 1)),
        "dots": [shown["at"] for shown in frames],
        "frames": frames,
    }


def corners(points: list[tuple[float, float]]) -> list[tuple[float, float]]:
    """Keep the corners of the convex hull below points of ascending x: those that weights reach."""
    hull: list[tuple[float, float]] = []
    for x, y in points:
        while len(hull) > 1:
            (x0, y0), (x1, y1) = hull[-2:]
            if (x1 - x0) * (y - y0) > (x - x0) * (y1 - y0):  # a turn to the left
                break
            hull.pop()
        hull.append((x, y))
    return hull


def budget_panel() -> dict[str, Any]:
    """Slide the budget along the whole front."""
    names, frames = ["b0", "b1", "b2", "b3"], []
    optima = [proved(budget_problem(budget)) for budget in range(LARGEST_BUDGET + 1)]
    spent = [float(budget_problem(80).perception_term(best.choices)) for best in optima]
    points = sorted({(x, best.cost) for x, best in zip(spent, optima, strict=True)})
    hull = corners(points)
    for budget, (x, best) in enumerate(zip(spent, optima, strict=True)):
        reached = [cost for spending, cost in hull if spending <= budget][-1]
        facts = {
            "spent": f"{x:g} of {budget}",
            "control": number(best.cost),
            "the best that some α : β leads to within this budget": number(reached)
            + (", the same" if reached == best.cost else f", {reached / best.cost - 1:.0%} more"),
        }
        frames.append(frame(best, names, facts, at=rounded([x, np.log10(best.cost)])))
    return {
        "id": "budget",
        "title": "A budget, and the front",
        "text": "The same cart, without switching costs; its models cost 0, 1, 2 and 4 a step, and "
        "all 20 steps together may cost no more than the budget. The points are all schedules that "
        "none beats in both, control and spending. Diamonds are those that some α : β leads to; "
        "the others are optimal under a budget only.",
        "sliders": [("budget", [str(k) for k in range(len(frames))], 30)],
        "names": names,
        "x": axis("spent", 0, LARGEST_BUDGET, range(0, LARGEST_BUDGET + 1, 10)),
        "y": axis("control, power of ten", -2.2, 0.6, (-2, -1, 0)),
        "dots": [rounded([x, np.log10(y)]) for x, y in points],
        "diamonds": [rounded([x, np.log10(y)]) for x, y in hull],
        "frames": frames,
    }


# --- the page ---


def panels() -> list[dict[str, Any]]:
    """Prove all that the page shows; takes seconds."""
    return [weights_panel(), errors_panel(), switching_panel(), budget_panel()]


def table(panel: dict[str, Any]) -> str:
    """Write all frames of a panel: one a row, or with two sliders the last fact in a grid."""
    (name, values, _), *second = panel["sliders"]
    facts = [list(shown["facts"].items()) for shown in panel["frames"]]
    if second:
        other, columns, _ = second[0]
        what = facts[0][-2][0]
        head = [f"{what}: {name} down, {other} across", *columns]
        cells = iter(fact[-2][1] for fact in facts)
        rows = [[value, *(next(cells) for _ in columns)] for value in values]
    else:
        head = [name, *(key for key, _ in facts[0])]
        rows = [[value, *(v for _, v in fact)] for value, fact in zip(values, facts, strict=True)]
    lines = ["".join(f'<th scope="col">{escape(text)}</th>' for text in head)]
    for first, *rest in rows:
        cells = "".join(f"<td>{escape(text)}</td>" for text in rest)
        lines.append(f'<th scope="row">{escape(first)}</th>{cells}')
    return "<table>" + "\n".join(f"<tr>{line}</tr>" for line in lines) + "</table>"


def section(panel: dict[str, Any]) -> str:
    """Write a panel: its sliders, a place for its picture, its numbers, and the table."""
    key, title = panel["id"], escape(panel["title"])
    sliders = "".join(
        f'<label for="{key}-{k}">{escape(name)}</label><input type="range" id="{key}-{k}" min="0" '
        f'max="{len(values) - 1}" value="{start}" aria-controls="{key}-facts" autocomplete="off">'
        f'<span class="value" aria-hidden="true"></span>'
        for k, (name, values, start) in enumerate(panel["sliders"])
    )
    data = json.dumps(panel, ensure_ascii=False, separators=(",", ":")).replace("</", "<\\/")
    return f"""<h2 id="{key}">{title}</h2>
<p>{panel["text"]}</p>
<div class="panel" role="group" aria-labelledby="{key}">
<div class="sliders">{sliders}</div>
<svg viewBox="0 0 760 420" role="img"></svg>
<output id="{key}-facts"></output>
<button type="button" aria-expanded="false" aria-controls="{key}-all">All as a table</button>
<div class="table" id="{key}-all" role="region" aria-label="{title}: all positions" tabindex="0">
{table(panel)}
</div>
<script type="application/json">{data}</script>
</div>
"""


def body() -> str:
    """Write the page: its title, what it is, and its panels."""
    return f"""<h1>{TITLE}</h1>
<p>Move a slider, with the mouse or with the arrow keys, and see the best schedule there. Nothing is
computed in your browser: every schedule was proved optimal when this book was made, by
<code>modelselect.solve</code>, and the page only shows it.
Predict first.</p>
{"".join(section(panel) for panel in panels())}
<script>{(HERE / "sliders.js").read_text(encoding="utf-8")}</script>"""
