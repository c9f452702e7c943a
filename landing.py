r"""Landing a drone with eight perception models: the paper's first experiment, end to end.

An aircraft comes down.  At every step it may run one of the models b0 (free, far off) to b7
(dear, nearly right) to estimate the input s_t that disturbs it.  The arrays flow one way:

    preset -> Psi -> problem -> schedules of eight policies -> trials -> report, JSON, figures.

A schedule is chosen from means and variances, but judged in flight: every trial draws the true
input and the errors of all models, the controller acts on the estimates of the scheduled models,
and the costs are those of the roll-out.  All policies meet the same inputs and the same errors.
Perception costs are w * Upsilon for model w (``eq:perceptionCost``); the authors' code charges
(w + 1) * Upsilon, which adds the same H * Upsilon to every schedule.

From the shell, ``python landing.py --help``; from a notebook::

    result = run_experiment(Settings(preset="textbook", trials=20))
    print(report(result))
    plot_schedule(result)
"""

from __future__ import annotations

import argparse
import io
import json
import math
import os
import sys
import tempfile
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from time import perf_counter
from typing import Any, NamedTuple, NoReturn

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axis import Axis
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from scipy.signal import cont2discrete
from scipy.special import stdtrit
from tqdm import tqdm

import modelselect as ms
from modelselect import Array, Choices
from perception import EFFICIENTNET, PerceptionSuite, published_suite, sample_errors, textbook_suite

Rng = np.random.Generator

# -------------------------------------------------------------------------------- two aircraft


@dataclass(frozen=True, eq=False)
class Preset:
    """An aircraft, its landing, and how the world and the models are drawn.

    States: altitude, its rate, pitch, its rate.  Control: the elevator.
    """

    task: ms.ControlTask
    x0: Array  #: (n,), initial state
    draw_inputs: Callable[[Rng, int], Array]  #: generator, trials -> true s (trials, H, p)
    prior_mean: Array  #: (H, p), expectation of s: all that a causal controller foresees
    draw_suite: Callable[[Rng], PerceptionSuite]  #: at the price Upsilon = 1
    upsilon: float | None  #: price of one model up; None: by `cost_scale`
    path: Array  #: (H+1,), altitude = path + first state
    dt: float  #: seconds a step
    unit: str  #: of altitude


K_S, T_S, ZETA, OMEGA = -0.95, 2.5, 0.5, 1.0


def _aircraft(V: float, a22: float, a42: float, b4: float) -> tuple[Array, Array]:
    """Continuous dynamics x' = F x + G u at speed V; sources differ on a22, a42 and b4."""
    a43, a44 = 2 * ZETA * OMEGA / T_S - OMEGA**2 - 1 / T_S**2, 1 / T_S - 2 * ZETA * OMEGA
    F = [[0, 1, 0, 0], [0, a22, V / T_S, 0], [0, 0, 0, 1], [0, a42, a43, a44]]
    return np.array(F), np.array([[0], [0], [0], [b4]])


def _published(H: int) -> Preset:
    """Return the aircraft of the authors' code: forward Euler, C not scaled by dt."""
    V, dt = 20.0, 0.01
    a42 = (1 - 2 * ZETA * OMEGA) / (V * T_S) + OMEGA**2 / V
    F, G = _aircraft(V, 1 / T_S, a42, OMEGA**2 / K_S)
    A, B, C = np.eye(4) + dt * F, dt * G, np.array([[0], [0], [1], [0]])
    return Preset(
        task=ms.ControlTask(A, B, C, np.diag([1e8, 1, 1e8, 1]), np.eye(1), H),
        x0=np.array([1000, 2, 2, 0.2]),
        draw_inputs=lambda rng, trials: rng.uniform(0, 0.002, (trials, H, 1)),
        prior_mean=np.full((H, 1), 0.001),
        draw_suite=lambda rng: published_suite(H, rng, upsilon=1.0),
        upsilon=1e14,
        path=np.zeros(H + 1),
        dt=dt,
        unit="units of the authors' code",
    )


def _textbook(H: int) -> Preset:
    """Return the aircraft of Ellert and Merriam 1963, in deviations from its glide path.

    20 s from 100 ft in H steps, discretised exactly; gusts and a moving pad displace the altitude.
    """
    V, dt = 256.0, 20 / H
    a42 = 1 / (V * T_S**2) - 2 * ZETA * OMEGA / (V * T_S) + OMEGA**2 / V
    F, G = _aircraft(V, -1 / T_S, a42, OMEGA**2 * K_S * T_S)
    A, B, *_ = cont2discrete((F, G, np.eye(4), np.zeros((4, 1))), dt, method="zoh")
    time = dt * np.arange(H + 1)
    path = np.where(time < 15, 100 * np.exp(-time / 5), 20 - time)
    return Preset(
        task=ms.ControlTask(A, B, np.eye(4)[:, :1], np.diag([1, 1, 100, 100]), 10 * np.eye(1), H),
        x0=np.array([5.0, 0, 0, 0]),
        draw_inputs=lambda rng, trials: rng.normal(0, 0.3, (trials, H, 1)),
        prior_mean=np.zeros((H, 1)),
        draw_suite=lambda rng: textbook_suite(path[:-1], rng),
        upsilon=None,
        path=path,
        dt=dt,
        unit="ft",
    )


PRESETS = {"published": _published, "textbook": _textbook}


def preset(name: str = "published", horizon: int = 150) -> Preset:
    """Return an aircraft of `PRESETS` that lands in `horizon` steps; ValueError if unknown."""
    return PRESETS[_known("preset", name, PRESETS)](ms.check_count("horizon", horizon))


def cost_scale(Psi: Array, suite: PerceptionSuite) -> float:
    """Upsilon by a rule fixed before any result was seen, for presets that publish none.

    beta Upsilon (W-1) H = 0.2 alpha (expected control term of All Small) at alpha = 0.8 and
    beta = 0.2, whatever the weights in use, so that sweeping those means something.
    """
    H, W, _ = suite.mean.shape
    problem = ms.SelectionProblem(Psi, suite.mean, suite.variance, suite.cost)
    harm = float(problem.control_term(np.zeros(H, dtype=int)))
    return 0.2 * 0.8 * harm / (0.2 * (W - 1) * H)


# ------------------------------------------------------------------------------ the experiment


def _simulated(landing: Preset, Psi: Array, upsilon: float | None, rng: Rng) -> PerceptionSuite:
    """Draw the preset's suite and price it (``subsec:expSimulation``)."""
    suite = landing.draw_suite(rng)
    price = landing.upsilon if upsilon is None else upsilon
    return replace(suite, cost=suite.cost * (cost_scale(Psi, suite) if price is None else price))


EXPERIMENTS = {"simulated": _simulated}


def _known(name: str, value: str, known: Iterable[str]) -> str:
    """Return `value` if it is one of the known ones, else raise ValueError."""
    if value not in known:
        raise ValueError(f"{name}: expected one of {', '.join(known)}, found {value!r}")
    return value


@dataclass(frozen=True)
class Settings:
    """What a run is made of: the options of the command line.  ValueError names a wrong one."""

    experiment: str = "simulated"  #: one of `EXPERIMENTS`
    preset: str = "published"  #: one of `PRESETS`
    information: str = "open_loop"  #: one of `modelselect.INFORMATION`
    horizon: int = 150  #: steps of a landing
    trials: int = 100  #: landings
    alpha: float = 0.8  #: weight of control cost (``eq:jtot``)
    beta: float = 0.2  #: weight of perception cost
    upsilon: float | None = None  #: model w costs w * upsilon; None: as the preset says
    seed: int = 0  #: of everything random

    def __post_init__(self) -> None:
        _known("experiment", self.experiment, EXPERIMENTS)
        _known("preset", self.preset, PRESETS)
        ms.check_information(self.information)
        for name, minimum in (("horizon", 1), ("trials", 1), ("seed", 0)):
            ms.check_count(name, getattr(self, name), minimum=minimum)
        for name in ("alpha", "beta", "upsilon"):
            if getattr(self, name) is not None:
                ms.check_number(name, getattr(self, name), minimum=0)


class Flights(NamedTuple):
    """What one policy did, and what came of it."""

    choices: Choices | None  #: (H,), or (trials, H); None for Oracle, which runs no model
    altitude: Array  #: (trials, H+1)
    control_cost: Array  #: (trials,), of the roll-out
    perception_cost: Array  #: (trials,)
    reward: Array  #: (trials,), -alpha control_cost - beta perception_cost


@dataclass(frozen=True, eq=False)
class Result:
    """A run: its settings with the Upsilon that was used, the problem, its optimum, the trials."""

    settings: Settings
    landing: Preset
    suite: PerceptionSuite
    problem: ms.SelectionProblem
    optimal: ms.Schedule
    seconds: float  #: that `modelselect.solve` took
    flights: dict[str, Flights]  #: by policy

    def mean(self, quantity: str) -> dict[str, float]:
        """Mean over trials of ``control_cost``, ``perception_cost`` or ``reward`` by policy."""
        return {p: float(getattr(flown, quantity).mean()) for p, flown in self.flights.items()}


INFEASIBLE = ("Oracle", "Clairvoyant")


def policies(problem: ms.SelectionProblem, optimal: Choices, rng: Rng) -> dict[str, Choices]:
    """Return the schedules (H,) of the feasible policies.

    Random is one schedule for all trials, as in the authors' code.  Best Single (the best
    constant schedule) and Greedy (each step alone, coupling ignored) are not in the paper.
    """
    H, W, _ = problem.mean.shape
    constant = np.repeat(np.arange(W)[:, None], H, axis=1)
    return {
        "Optimal": optimal,
        "Best Single": constant[problem.total_cost(constant).argmin()],
        "Greedy": ms.stepwise_cost(problem).argmin(axis=1),
        "Random": rng.integers(W, size=H),
        "All Large": constant[-1],
        "All Small": constant[0],
    }


def clairvoyant(problem: ms.SelectionProblem, errors: Array, progress: bool = False) -> Choices:
    """Schedule every trial knowing its errors (trials, H, W, p); returns (trials, H).

    This is Oracle as the paper's text has it: ``prob:model_selection``, solved in every trial.
    """
    known = [replace(problem, mean=e, variance=np.zeros_like(e)) for e in errors]
    return np.array([ms.solve(trial).choices for trial in _bar("Clairvoyant", known, progress)])


def fly(
    landing: Preset,
    problem: ms.SelectionProblem,
    information: str,
    s: Array,
    errors: Array,
    choices: Choices | None,
) -> Flights:
    """Roll out every trial under one schedule (H,), or its own (trials, H), or no error (None).

    s is (trials, H, p), errors are (trials, H, W, p).
    """
    trials, H, _ = s.shape
    error, perception = np.zeros_like(s), np.zeros(trials)
    if choices is not None:
        run = np.broadcast_to(choices, (trials, H))
        error = np.take_along_axis(errors, run[..., None, None], axis=2)[:, :, 0]
        perception = problem.perception_term(run)
    prior = landing.prior_mean if information == "causal" else None
    x, u = ms.run_controller(landing.task, landing.x0, s, s + error, information, prior)
    control = ms.control_cost(landing.task, x, u)
    reward = -problem.alpha * control - problem.beta * perception
    return Flights(choices, landing.path + x[..., 0], control, perception, reward)


def run_experiment(settings: Settings = Settings(), *, progress: bool = False) -> Result:
    """Draw a suite, solve, and fly all policies, with a progress bar if one is wanted.

    Suite, inputs, errors and Random draw from streams of their own, so that further trials
    change neither the problem nor the first trials.  ValueError as in `modelselect.psi`.
    """
    chosen, streams = settings, np.random.default_rng(settings.seed).spawn(4)
    landing = preset(chosen.preset, chosen.horizon)
    Psi = ms.psi(landing.task, chosen.information)
    suite = EXPERIMENTS[chosen.experiment](landing, Psi, chosen.upsilon, streams[0])
    tables = (suite.mean, suite.variance, suite.cost)
    problem = ms.SelectionProblem(Psi, *tables, chosen.alpha, chosen.beta)
    started = perf_counter()
    optimal = ms.solve(problem)
    seconds = perf_counter() - started

    s = landing.draw_inputs(streams[1], chosen.trials)
    errors = sample_errors(suite, chosen.trials, streams[2])
    plans: dict[str, Choices | None] = {"Oracle": None}
    plans["Clairvoyant"] = clairvoyant(problem, errors, progress)
    plans |= policies(problem, optimal.choices, streams[3])
    flights = {
        policy: fly(landing, problem, chosen.information, s, errors, choices)
        for policy, choices in plans.items()
    }
    used = replace(chosen, upsilon=float(suite.cost[1]))
    return Result(used, landing, suite, problem, optimal, seconds, flights)


class Front(NamedTuple):
    """The best trade-offs between control and perception, from `pareto`."""

    ratio: Array  #: (points,), alpha / beta
    control: Array  #: (points,), expected control term of the optimum
    perception: Array  #: (points,), its perception term
    gap: Array  #: (points,), that its certificate leaves


def pareto(problem: ms.SelectionProblem, points: int = 40, *, progress: bool = False) -> Front:
    """Solve the problem for `points` ratios r = alpha / beta (``fig:simulation_pareto``).

    Let the schedule of least control term C have (C+, P+), and the cheapest (C-, P-).  As the
    optimum at r has the least r C + P, its C exceeds C+ by at most (P+ - P-) / r, and its P
    exceeds P- by at most r C-: so r = 0.01 (P+ - P-) / C- to 100 (P+ - P-) / C+ reaches both
    ends to 1%.  Weighted sums find the corners of the front's convex hull, nothing in between.
    """
    ends = [ms.solve(replace(problem, alpha=a, beta=1 - a)).choices for a in (1.0, 0.0)]
    (least, most), (dear, cheap) = (
        [float(term(c)) for c in ends] for term in (problem.control_term, problem.perception_term)
    )
    span, ratio = dear - cheap, np.ones(1)
    if span > 0 and most > 0:
        ratio = np.geomspace(0.01 * span / most, 100 * span / max(least, 1e-6 * most), points)
    weighted = [replace(problem, alpha=r / (1 + r), beta=1 / (1 + r)) for r in ratio]
    found = [ms.solve(each) for each in _bar("Pareto front", weighted, progress)]
    c, gap = np.array([each.choices for each in found]), np.array([each.gap for each in found])
    return Front(ratio, problem.control_term(c), problem.perception_term(c), gap)


def _bar(label: str, work: Sequence[Any], progress: bool) -> Iterable[Any]:
    """Show the progress through `work`, but only on a terminal."""
    return tqdm(work, label, leave=False, disable=None if progress else True)


# ---------------------------------------------------------------------------------- the report

QUANTITIES = ("control_cost", "perception_cost", "reward")

#: What the authors' code logged for experiment 1: means of 100 trials, at (w + 1) * Upsilon.
PUBLISHED_LOG = {
    "Oracle": (5.189117e15, 0.0, -4.151294e15),
    "Optimal": (7.299417e15, 6.28e16, -1.839953e16),
    "Random": (4.871516e16, 6.64e16, -5.225213e16),
    "All Large": (5.190354e15, 1.2e17, -2.815228e16),
    "All Small": (4.915508e17, 1.5e16, -3.962407e17),
}

#: Comparisons (quantity, new, old, what the paper's text says of this number).
COMPARISONS = (
    ("control_cost", "Optimal", "Random", ""),
    ("control_cost", "Random", "Optimal", '"567.18% lower" for Optimal'),
    ("perception_cost", "Optimal", "Random", ""),
    ("perception_cost", "All Large", "Random", '"80.72% less" for Optimal'),
    ("reward", "Optimal", "Random", ""),
    ("control_cost", "Optimal", "All Large", ""),
    ("perception_cost", "Optimal", "All Large", ""),
    ("reward", "Optimal", "All Large", ""),
    ("reward", "All Large", "Optimal", '"53.26% better" for Optimal'),
    ("reward", "Oracle", "Optimal", '"77% far"; "very close"'),
)


def has_log(settings: Settings) -> bool:
    """Whether the authors published a log for these settings (trials and seed aside)."""
    return replace(settings, trials=100, seed=0) == Settings(upsilon=1e14)


def published_log(quantity: str, offset: int = 0) -> dict[str, float]:
    """Means that the authors published, by policy, at (w + offset) * Upsilon: they have 1."""
    paid = (1 - offset) * 150 * 1e14 * {"control_cost": 0, "perception_cost": 1, "reward": -0.2}[quantity]
    column = QUANTITIES.index(quantity)
    return {p: row[column] - paid * (p != "Oracle") for p, row in PUBLISHED_LOG.items()}


def half_width(values: Array) -> float:
    """Half of the 95% t-interval for the mean of values (trials,); NaN for a single trial."""
    N = len(values)
    return float(stdtrit(N - 1, 0.975) * values.std(ddof=1) / math.sqrt(N)) if N > 1 else math.nan


def report(result: Result) -> str:
    """Return the costs, the certificate, the comparisons and the checks of a run, as text."""
    parts = (_costs, _certificate, _comparisons, _checks)
    return "\n\n".join("\n".join(part(result)) for part in parts)


def _costs(result: Result) -> list[str]:
    """Costs and reward of every policy, the published ones below them."""
    best, logged = result.flights["Optimal"].reward, has_log(result.settings)
    size = abs(best.mean())
    unit = 1000.0 ** math.floor(math.log10(size) / 3) if size > 0 else 1.0

    def cell(values: Array) -> str:
        half = half_width(values) / unit
        tail = "" if np.ptp(values) == 0 < len(values) - 1 else f"± {half:.3f}".replace("nan", "-")
        return f"{values.mean() / unit:12.3f} {tail:9}"

    lines = [
        f"Means of {result.settings.trials} trials ± 95% t-interval, in units of {unit:.0e}; "
        "perception costs w * Upsilon" + logged * ", also of the published log",
        f"{'':14}{'control cost':>15}{'perception cost':>24}{'reward':>17}{'Optimal gains':>25}",
    ]
    for policy, flown in result.flights.items():
        row = [*flown[-3:], best - flown.reward]
        lines.append(f"{policy:14}" + "".join(cell(values) for values in row).rstrip())
        if logged and policy in PUBLISHED_LOG:
            values = [published_log(q)[policy] / unit for q in QUANTITIES]
            lines.append(f"{'  published':14}" + "".join(f"{v:12.3f}{'':10}" for v in values).rstrip())
    return [*lines, "Infeasible: Oracle (no error) and Clairvoyant (knows all errors beforehand)."]


def _certificate(result: Result) -> list[str]:
    """What is proved of Optimal, and how often it runs each model."""
    best, names = result.optimal, result.suite.names
    used = np.bincount(best.choices, minlength=len(names))
    proof = "optimal" if best.is_optimal else "optimality not proved"
    return [
        f"Optimal: expected total {best.cost:.6e} without alpha J(u*), lower bound "
        f"{best.lower_bound:.6e},",
        f"gap {best.gap:.1e} ({proof}), {best.solver} in {result.seconds:.2f} s; "
        "steps: " + ", ".join(f"{m} {n}" for m, n in zip(names, used, strict=True)),
    ]
