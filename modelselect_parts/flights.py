"""Flights: with errors out of a table, by sight, and what the difference rests on.

A schedule is chosen by a table of errors.  `fly` draws errors from that table, or from any other
array; in `fly_by_sight` a drone sees for itself, from where its errors so far have led it.  The
table was measured on other pictures: `judge` tells how far its promise is kept, `regret_of_few` how
many pictures it takes.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from scipy.special import stdtrit

from modelselect_parts.camera import LOWEST, Pictures, draw_pose, draw_scenes, photograph
from modelselect_parts.checks import (
    Array,
    Choices,
    check_array,
    check_choices,
    check_class,
    check_count,
    check_range,
    check_rng,
)
from modelselect_parts.pooling import (
    Labelled,
    binned_suite,
    bootstrapped,
    labelled,
    pooled_suite,
)
from modelselect_parts.regulator import (
    PATTERNS,
    ControlTask,
    check_information,
    control_cost,
    psi,
    run_controller,
)
from modelselect_parts.sight import Aircraft, Reader, fly_by_sight
from perception import PerceptionSuite, Residuals, Trained, guard_suite, measure_models

Rng = np.random.Generator
BINS = 20  # of altitude: the 897 held-out pictures leave some 35 along the way in each
FRESH = 2000  # pictures that judge a schedule, seen by no model before


# ----------------------------------------------------------------------- means, and how sure


def _check_values(values: Array) -> Array:
    checked = check_array("values", values, "trials", (None,))
    check_range("values", abs(checked), top=1e150)  # squares must not overflow
    return checked


def half_width(values: Array) -> float:
    """Half of the 95% t-interval for the mean of values (trials,); NaN for a single trial."""
    values = _check_values(values)
    N = len(values)
    if N > 1 and np.ptp(values) == 0:  # whatever the rounding of their mean
        return 0.0
    return float(stdtrit(N - 1, 0.975) * values.std(ddof=1) / math.sqrt(N)) if N > 1 else math.nan


def estimate(*over_trials: Array) -> Array:
    """Return the mean of each array (trials,) and half of its 95% interval, (arrays, 2)."""
    return np.array([(values.mean(), half_width(values)) for values in over_trials])


def root_mean_square(values: Array) -> tuple[float, float]:
    """Return the root mean square of values (N,), and half of its 95% interval.

    The interval is that of the mean square, through the derivative of the root.
    """
    squares = _check_values(values) ** 2
    rms = math.sqrt(squares.mean())
    return rms, half_width(squares) / (2 * rms) if rms > 0 else 0.0


# ------------------------------------------------------------------------------- how models err


def by_network(residuals: Residuals) -> tuple[Array, Array]:
    """Return altitudes (M,) of pictures that all W models saw, and their errors (W, M)."""
    W = len(residuals.names)
    return residuals.altitude.reshape(W, -1)[0], residuals.residual.reshape(W, -1)


def fit_landing(
    landing: Aircraft,
    measured: Residuals | Labelled,
    cost: Array,
    bins: int | None = None,
    *,
    guard: bool = False,
    rng: Rng | None = None,
) -> PerceptionSuite:
    """Fit a suite along a landing to errors that were `measured` on the same pictures.

    By nearness in ln z, or in `bins` of equally many; with `guard`, its upper confidence bounds.
    By nearness, standard errors are those of a bootstrap over groups of pictures, if there is a
    generator for it.  The `cost` (W,) is passed on to `fit_suite`.
    """
    check_class("landing", landing, "Aircraft")
    rng is None or check_rng(rng)
    pictures, path = labelled(measured), landing.path[:-1]
    if bins is not None:
        suite = binned_suite(pictures, path, cost, bins)
    else:
        suite = pooled_suite(pictures, path, cost)
        suite = suite if rng is None else bootstrapped(suite, pictures, path, rng)
    return guard_suite(suite) if guard else suite


def errors_by_altitude(altitude: Array, errors: Array) -> tuple[Array, Array, Array]:
    """Return root mean squares (W, 2) with their intervals, edges of altitude, and means between.

    The latter are the root mean squares (W, edges - 1) of the errors (W, M) at such altitudes (M,).
    """
    edges = np.array([LOWEST, 0.0, 5, 15, 35, 70, 100])
    place = np.digitize(altitude, edges)
    parts = [[root_mean_square(e[place == b])[0] for b in range(1, len(edges))] for e in errors]
    return np.array(list(map(root_mean_square, errors))), edges, np.array(parts)


# ------------------------------------------------------------------------------ the flight


def sensitivities(task: ControlTask) -> dict[str, Array]:
    """Psi (pH, pH) of every pattern that needs no more than the task, and is within reach."""
    found = {}
    for information in PATTERNS:
        with suppress(ValueError):
            found[information] = psi(task, information)
    return found


def fly(
    landing: Aircraft,
    information: str,
    s: Array,
    errors: Array,
    choices: Choices | None,
    gains: Array | None = None,
) -> tuple[Array, Array]:
    """Roll out all trials of a landing; return altitudes (trials, H+1), control costs (trials,).

    s is (trials, H, p), errors of all models are (trials, H, W, p), choices (H,), (trials, H), or
    None for estimates without error; `information` is a pattern, and `gains` are what it takes.
    """
    check_class("landing", landing, "Aircraft")
    task = landing.task
    s = check_array("s", s, "trials H p", (None, task.horizon, task.p))
    errors = check_array("errors", errors, "trials H W p", (*s.shape[:2], None, task.p))
    error = np.zeros_like(s)
    if choices is not None:
        c = check_choices(choices, task.horizon, errors.shape[2])
        if c.shape not in (s.shape[1:2], s.shape[:2]):
            expected = f"{s.shape[:2]} or ({task.horizon},)"
            raise ValueError(f"choices: expected shape {expected}, found {c.shape}")
        run = np.broadcast_to(c, s.shape[:2])[..., None, None]
        error = np.take_along_axis(errors, run, axis=2)[:, :, 0]
    check_information(information)
    row = PATTERNS[information]
    prior = landing.prior_mean if row.now and not row.foresight else None
    x, u = run_controller(task, landing.x0, s, s + error, information, prior, gains=gains)
    return landing.path + x[..., 0], control_cost(task, x, u)


def photograph_landings(seed: int) -> tuple[Array, list[Pictures]]:
    """Return altitudes (8,), and from there pictures of three landings, (8, side, side) each.

    The fourth of them shows the third landing as b7 sees it (``fig:airsim_env``).
    """
    seed = check_count("seed", seed, minimum=0, top=math.inf)
    altitude, rng = np.array([100.0, 60, 35, 20, 10, 5, 2, 0]), np.random.default_rng(seed)
    N, worlds, rows = len(altitude), draw_scenes(3, rng), []
    for world, side in [(0, 128), (1, 128), (2, 128), (2, 40)]:
        same = type(worlds)(*(np.repeat(table[world : world + 1], N, axis=0) for table in worlds))
        same = same._replace(pose=draw_pose(N, np.random.default_rng([seed, world, 1])))
        rows.append(photograph(same, altitude, side, rng))
    return altitude, rows


# --------------------------------------------------------------- what its regret rests on


class Regret(NamedTuple):
    """Control cost of a policy beyond that of the same controller without errors."""

    predicted: float  #: expected, by the suite
    gaussian: Array  #: (trials,), with errors of `sample_errors`
    bootstrap: Array  #: (trials,), with errors of `bootstrap_errors`
    flown: Array  #: (trials,), by what the networks see
    paid: float  #: perception cost


def judge(
    landing: Aircraft,
    readers: Sequence[Reader],
    information: str,
    problem: Any,
    choices: Choices,
    s: Array,
    drawn: Sequence[Array],
    seed: int,
    gains: Array | None = None,
) -> Regret:
    """Fly a schedule (H,) through the same inputs (trials, H, 1) in three ways.

    With errors (trials, H, W, 1) as they are `drawn` of the suite and of its residuals, and by
    sight; the promise is that of the `problem`, and the `seed` that of the scenes.
    """
    ideal, *ways = (
        fly(landing, information, s, errors, c, gains)[1]
        for errors, c in [(drawn[0], None), *((e, choices) for e in drawn)]
    )
    gaussian, bootstrap = (cost - ideal for cost in ways)
    flown = fly_by_sight(landing, readers, information, s, choices, seed, gains=gains)[1] - ideal
    predicted, paid = problem.control_term(choices), problem.perception_term(choices)
    return Regret(float(predicted), gaussian, bootstrap, flown, float(paid))


def compare(found: Mapping[str, Regret], alpha: float, beta: float) -> tuple[Array, Array, Array]:
    """Return what was expected, what came of it, and what Optimal gains, of every policy.

    Expected are regret and perception cost (policies, 2).  Estimates of regret (policies, 3, 2) are
    those of the three ways; of Optimal's reward less the policy's (policies, 2, 2), with Gaussian
    errors and by sight.
    """
    best, gains = found["Optimal"], []
    for regret in found.values():
        spent = beta * (regret.paid - best.paid)
        saved = regret.gaussian - best.gaussian, regret.flown - best.flown
        gains += [estimate(*(alpha * more + spent for more in saved))]
    expected = np.array([(regret.predicted, regret.paid) for regret in found.values()])
    return expected, np.array([estimate(*r[1:4]) for r in found.values()]), np.array(gains)


def leads(totals: Mapping[str, Array]) -> dict[str, tuple[float, float]]:
    """Return by what share Optimal's mean total lies below the others', with half of its interval.

    Of paired flights, with totals T_i and T_i - d_i, the share is r = mean d / mean T.  As mean T
    is an estimate, too, its interval is that of the mean of d_i - r T_i, by mean T (delta method).
    Mean T of a few flights can be negative, as noise may happen to help: then a share of its size.
    """
    found = {}
    for policy, total in totals.items():
        if policy != "Optimal":
            whole, saved = total.mean() or math.inf, total - totals["Optimal"]
            share = saved.mean() / whole  # where nothing is lost, nothing is saved
            half = half_width(saved - share * total) / abs(whole)
            found[policy] = float(math.copysign(share, saved.mean())), half
    return found


def pose(problem: Any, suite: PerceptionSuite) -> Any:
    """Return the same selection problem with the errors of another suite."""
    return replace(problem, mean=suite.mean, variance=suite.variance)


def regret_of_few(
    landing: Aircraft,
    trained: Trained,
    problem: Any,
    solve: Callable[[Any], Any],
    rng: Rng,
    sizes: Sequence[int],
    repeats: int,
    fresh: int,
    bins: int | None,
) -> Array:
    """Return the regret of schedules fitted on few residuals (sizes, 2, repeats).

    Of the held-out pictures n are drawn and a suite is fitted, as it is or guarded; the schedule
    that is optimal for it is judged by a suite of `fresh` new pictures.  Regret is the total cost
    beyond that of the optimum of the latter, as a share of it: a little too much, as that one has
    had some luck as well.  `problem` is that of `modelselect`, and `solve` its solver; fits are by
    nearness, or in at most so many `bins` that about ten residuals are left in each.
    """
    (networks, _, old), cost = trained, problem.model_cost
    fresh, repeats = check_count("fresh", fresh), check_count("repeats", repeats)
    counts = [check_count("sizes", n, minimum=2) for n in check_array("sizes", sizes, "n", (None,))]
    W, M = len(networks), len(old.residual) // len(networks)
    if max(counts) > M:
        raise ValueError(f"sizes: expected numbers up to the {M} residuals, found {sizes}")
    truth = pose(problem, fit_landing(landing, measure_models(networks, fresh, rng), cost, bins))
    least = solve(truth).cost
    table = np.empty((len(counts), 2, repeats))
    for i, k in np.ndindex(len(counts), repeats):
        chosen = rng.permutation(M)[: counts[i]]
        rows = (M * np.arange(W)[:, None] + chosen).ravel()
        few = Residuals(old.names, old.model[rows], old.altitude[rows], old.residual[rows])
        parts = bins and min(bins, max(2, counts[i] // 12))
        for j, redrawn in enumerate((None, rng)):
            suite = fit_landing(landing, few, cost, parts, guard=j == 1, rng=redrawn)
            table[i, j, k] = truth.total_cost(solve(pose(problem, suite)).choices) / least - 1
    return table
