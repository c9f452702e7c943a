"""Rivals: whom the optimum is compared with, and what the trade between the two costs looks like.

Eight policies that obey the limits of the problem; the sweep of weights
(``fig:simulation_pareto``); and all Pareto points, of which a sweep sees the corners.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Iterable
from dataclasses import replace
from itertools import islice
from typing import NamedTuple

import numpy as np

import modelselect as ms
import perception
from modelselect import Array, Choices, Schedule, SelectionProblem
from modelselect_parts import trellis
from modelselect_parts.checks import (
    Mask,
    check_choices,
    check_class,
    check_count,
    check_number,
    check_rng,
)

Rng = np.random.Generator
CONSTANT = ("Best Single", "All Large", "All Small")


def _step_by_step(problem: SelectionProblem, pick: Callable[[int, Array], int]) -> Choices:
    """Return the schedule (H,) of one who decides as they go, and can always pay for the rest.

    At step t, `pick` chooses a model from t and what each (W,) costs alone, with the move to it:
    infinitely much where even the cheapest way on from it breaks the budget.
    """
    form, (H, W, _) = problem.form, problem.mean.shape
    free = np.zeros((W, W))
    arc, toll = (free if moves is None else moves for moves in (form.arc, form.toll))
    price = np.where(np.isinf(form.linear), np.inf, 0 if form.price is None else form.price)
    rest = trellis.forward(price[::-1], toll.T)[::-1]  # (H, W), the cheapest way on from (t, w)
    budget = math.inf if problem.budget is None else problem.budget
    alone, choices, spent = ms.stepwise_cost(problem), np.zeros(H, dtype=np.intp), 0.0
    for t in range(H):
        before = choices[t - 1]
        cost, move = (arc[before], toll[before]) if t else (free[0], free[0])
        needed = spent + move + rest[t]
        payable = needed <= max(budget, needed.min())  # the least is, whatever rounding says
        choices[t] = w = pick(t, np.where(payable, alone[t] + cost, np.inf))
        spent += float(move[w] + price[t, w])
    return choices


def policies(
    problem: SelectionProblem, optimal: Choices, errors: Iterable[Array], rng: Rng
) -> dict[str, Choices | None]:
    """Return the schedules (H,) of all policies, or (trials, H) where each trial has its own.

    Oracle is that of the authors' code: no model, no error.  Clairvoyant is the Oracle of their
    text: it knows the errors (H, W, p) of every trial beforehand and solves
    ``prob:model_selection``.  Both are infeasible.  Random is one schedule for all trials, as in
    their code.  Best Single (constant) and Greedy (each step alone, coupling ignored) are ours.
    The schedule `optimal` (H,) is that of the solver.

    All keep a budget: Greedy and Random decide among the models after which the rest can still be
    paid for, and a constant schedule that cannot keep it is left out.
    """
    check_class("problem", problem, "SelectionProblem")
    H, W, _ = problem.mean.shape
    constant = np.repeat(np.arange(W)[:, None], H, axis=1)
    cost = np.where(problem.is_feasible(constant), problem.total_cost(constant), np.inf)
    known = (replace(problem, mean=e, variance=np.zeros_like(problem.mean)) for e in errors)
    drawn = check_rng(rng).integers(W, size=(H,))

    def redraw(t: int, cost: Array) -> int:
        left = np.flatnonzero(cost < np.inf)
        return int(drawn[t] if drawn[t] in left else rng.choice(left))

    schedules = {
        "Clairvoyant": np.array([ms.solve(trial).choices for trial in known]),
        "Optimal": check_choices(optimal, H, W),
        "Best Single": constant[cost.argmin()],
        "Greedy": _step_by_step(problem, lambda _, cost: int(cost.argmin())),
        "Random": _step_by_step(problem, redraw),
        "All Large": constant[-1],
        "All Small": constant[0],
    }
    beyond = {k for k in CONSTANT if not problem.is_feasible(schedules[k])}
    return {"Oracle": None} | {k: c for k, c in schedules.items() if k not in beyond}


def pareto(
    problem: SelectionProblem, points: int = 40, *, progress: bool = False
) -> tuple[Array, list[Schedule]]:
    """Solve for `points` ratios r = alpha / beta (``fig:simulation_pareto``); return r and optima.

    Let the schedule of least control term C have (C+, P+), and the cheapest (C-, P-).  As the
    optimum at r has the least r C + P, its C exceeds C+ by at most (P+ - P-) / r, and its P
    exceeds P- by at most r C-: so r = 0.01 (P+ - P-) / C- to 100 (P+ - P-) / C+ reaches both
    ends to 1%.  Weighted sums find the corners of the front's convex hull, nothing in between.
    """
    check_class("problem", problem, "SelectionProblem")
    points = check_count("points", points)
    ends = [ms.solve(replace(problem, alpha=a, beta=1 - a)).choices for a in (1.0, 0.0)]
    (least, most), (dear, cheap) = problem.control_term(ends), problem.perception_term(ends)
    span, ratio = dear - cheap, np.ones(1)
    if span > 0 and most > 0:  # else there is nothing to trade
        ratio = np.geomspace(0.01 * span / most, 100 * span / max(least, 1e-6 * most), points)
    bar = perception.with_bar(ratio, "Pareto front", progress)
    return ratio, [ms.solve(replace(problem, alpha=r / (1 + r), beta=1 / (1 + r))) for r in bar]


class Front(NamedTuple):
    """All Pareto points, the cheapest to run first."""

    points: Array  #: (n, 2), perception and control term
    corner: Mask  #: (n,), whether some alpha : beta leads there
    missed: Array  #: (n,), by what share the best corner that spends no more costs control more
    left: str  #: what a time limit left open, or nothing


def whole_front(problem: SelectionProblem, seconds: float, *, progress: bool = False) -> Front:
    """Find all Pareto points that `pareto_front` proves in so many `seconds`."""
    check_class("problem", problem, "SelectionProblem")
    seconds = check_number("seconds", seconds, minimum=0)
    bar, done = iter(perception.with_bar(range(100), "All Pareto points", progress)), 0

    def tell(share: float) -> None:
        nonlocal done
        done += sum(1 for _ in islice(bar, int(100 * share) - done))

    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        found = ms.pareto_front(problem, time_limit=seconds, progress=tell)[::-1]
    terms = [(problem.perception_term(point.choices), point.cost) for point in found]
    points = np.reshape(np.array(terms), (-1, 2))
    corner, control = _corners(points), points[:, 1]
    best = np.minimum.accumulate(np.where(corner, control, np.inf))
    missed = np.divide(best - control, control, out=np.zeros(len(points)), where=control > 0)
    said = [str(warning.message).removeprefix("pareto_front: ") for warning in caught]
    return Front(points, corner, missed, "; ".join(said))


def _corners(points: Array) -> Mask:
    """Whether each of `points` (n, 2), of ascending x, is a corner of the convex hull below them.

    So it is if the steepest way to it from the left is steeper than the flattest on to the right.
    """
    (x, y), left = np.reshape(points, (-1, 2)).T, np.tri(len(points), k=-1, dtype=bool)
    with np.errstate(divide="ignore", invalid="ignore"):  # from a point to itself
        slope = np.subtract.outer(y, y) / np.subtract.outer(x, x)
    arriving = np.where(left, slope, -np.inf).max(axis=1, initial=-np.inf)
    leaving = np.where(left.T, slope, np.inf).min(axis=1, initial=np.inf)
    return np.asarray(arriving < leaving)
