"""Flights: with errors out of a table, by sight, and what the difference rests on.

A schedule is chosen by a table of errors.  `fly` draws errors from that table, or from any other
array; in `fly_by_sight` a drone takes a picture at every step, from where its errors so far have
led it, and acts on what the scheduled network reads off it.  The table was measured on other
pictures: `judge` tells how far its promise is kept, `regret_of_few` how many pictures it takes.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from scipy.special import stdtrit

from modelselect_parts.camera import (
    HIGHEST,
    LOWEST,
    Pictures,
    draw_pose,
    draw_scenes,
    photograph,
)
from modelselect_parts.checks import (
    Array,
    Choices,
    check_array,
    check_choices,
    check_class,
    check_count,
    check_range,
)
from modelselect_parts.regulator import (
    PATTERNS,
    ControlTask,
    check_information,
    control_cost,
    psi,
    roll_out,
    run_controller,
)
from perception import (
    Network,
    PerceptionSuite,
    Residuals,
    Trained,
    altitude_bins,
    bootstrap_errors,
    fit_suite,
    guard_suite,
    measure_models,
)

Rng = np.random.Generator
BINS = 20  # of altitude: the 897 held-out pictures leave some 35 along the way in each
MOST_PITCH = 0.2  # rad that the mount of the camera turns with the drone
FRESH = 2000  # pictures that judge a schedule, seen by no model before


@dataclass(frozen=True, eq=False)
class Aircraft:
    """What lands.  States: altitude less the path, its rate, pitch, its rate."""

    task: ControlTask
    x0: Array  #: (n,), initial state
    prior_mean: Array  #: (H, p), expectation of s: all that a causal controller foresees
    path: Array  #: (H+1,), altitude = path + first state
    dt: float  #: seconds a step


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
    landing: Aircraft, measured: Residuals, cost: Array, bins: int = BINS, *, guard: bool = False
) -> PerceptionSuite:
    """Fit a suite along a landing, in `bins` of equally many of the residuals `measured`.

    With `guard`, its upper confidence bounds; the `cost` (W,) is passed on to `fit_suite`.
    """
    check_class("landing", landing, "Aircraft")
    check_class("measured", measured, "Residuals")
    h = landing.path[:-1]
    with warnings.catch_warnings():  # pictures are taken from further than a short way leads
        warnings.filterwarnings("ignore", "fit_suite: .* residuals count along this trajectory")
        suite = fit_suite(measured, h, cost, bins=altitude_bins(measured.altitude, h, bins))
    return guard_suite(suite) if guard else suite


def errors_by_altitude(altitude: Array, errors: Array) -> tuple[Array, Array, Array]:
    """Return root mean squares (W, 2) with their intervals, edges of altitude, and means between.

    The latter are the root mean squares (W, edges - 1) of the errors (W, M) at such altitudes (M,).
    """
    edges = np.array([LOWEST, 0.0, 5, 15, 35, 70, 100])
    place = np.digitize(altitude, edges)
    parts = [[root_mean_square(e[place == b])[0] for b in range(1, len(edges))] for e in errors]
    return np.array(list(map(root_mean_square, errors))), edges, np.array(parts)


def redraw_errors(landing: Aircraft, measured: Residuals, trials: int, rng: Rng) -> Array:
    """Draw errors (trials, H, W, 1) from the residuals that `fit_landing` takes its moments of."""
    h = landing.path[:-1]
    edges = altitude_bins(measured.altitude, h, BINS)
    return bootstrap_errors(measured, h, trials, rng, bins=edges)


# ------------------------------------------------------------------------------ the flight


def sensitivities(task: ControlTask) -> dict[str, Array]:
    """Psi (pH, pH) of every pattern that needs no more than the task, and is within reach."""
    found = {}
    for information in PATTERNS:
        with suppress(ValueError):
            found[information] = psi(task, information)
    return found


def fly(
    landing: Aircraft, information: str, s: Array, errors: Array, choices: Choices | None
) -> tuple[Array, Array]:
    """Roll out all trials of a landing; return altitudes (trials, H+1), control costs (trials,).

    s is (trials, H, p), errors of all models are (trials, H, W, p), choices (H,), (trials, H), or
    None for estimates without error; `information` is a pattern.
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
    x, u = run_controller(task, landing.x0, s, s + error, information, prior)
    return landing.path + x[..., 0], control_cost(task, x, u)


def fly_by_sight(
    landing: Aircraft,
    networks: Sequence[Network],
    information: str,
    s: Array,
    choices: Choices,
    seed: int,
) -> tuple[Array, Array, Array]:
    """Land by what the scheduled networks see; return altitude, control cost and errors.

    At every step each trial takes a picture from its true altitude and pitch, and acts on what the
    network makes of it.  The scene of a landing stays the same, but for what moves and shakes: so
    errors depend on the state, and on those before.  Beyond its range the camera sees what it sees
    at the end of it, and its mount turns by `MOST_PITCH`.

    True inputs s are (N, H, 1) and `choices` (H,); the `seed` of the scenes is the same for all
    policies.  Altitudes are (N, H+1), costs (N,), errors s_hat - s (N, H, 1).
    """
    check_information(information)
    if PATTERNS[information].foresight:
        raise ValueError(f"information: a flight has no forecast, found {information!r}")
    task, path = landing.task, landing.path
    s = check_array("s", s, "trials H p", (None, task.horizon, task.p))
    check_array("choices", choices, "H", (task.horizon,))
    models = check_choices(choices, task.horizon, len(networks))
    seed, N = check_count("seed", seed, minimum=0, top=math.inf), len(s)
    rng, errors = np.random.default_rng(seed), np.empty_like(s)
    scene = draw_scenes(N, rng)

    def look(t: int, x: Array) -> Array:
        h, network = path[t] + x[:, 0], networks[models[t]]
        pitch, seconds = np.clip(x[:, 2], -MOST_PITCH, MOST_PITCH), t * landing.dt
        shaken, within = scene._replace(pose=draw_pose(N, rng)), np.clip(h, LOWEST, HIGHEST)
        # Noise of its own stream, so that all policies meet the same poses.
        noise = np.random.default_rng([seed, t])
        picture = photograph(shaken, within, network.side, noise, pitch=pitch, seconds=seconds)
        errors[:, t, 0] = network.altitude(picture) - h
        return errors[:, t]

    expected = landing.prior_mean[None] * PATTERNS[information].now
    x, u = roll_out(task, landing.x0, s, look, information, expected)
    return path + x[..., 0], control_cost(task, x, u), errors


def photograph_landings(seed: int) -> tuple[Array, list[Pictures]]:
    """Return altitudes (8,), and from there pictures of three landings, (8, side, side) each.

    The fourth of them shows the third landing as b7 sees it (``fig:airsim_env``).
    """
    seed = check_count("seed", seed, minimum=0, top=math.inf)
    altitude, rng = np.array([100.0, 60, 35, 20, 10, 5, 2, 0]), np.random.default_rng(seed)
    N, worlds, rows = len(altitude), draw_scenes(3, rng), []
    for world, side in [(0, 128), (1, 128), (2, 128), (2, 40)]:
        same = type(worlds)(*(np.repeat(table[world : world + 1], N, axis=0) for table in worlds))
        same = same._replace(pose=draw_pose(N, np.random.default_rng([seed, world])))
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
    networks: Sequence[Network],
    information: str,
    problem: Any,
    choices: Choices,
    s: Array,
    drawn: Sequence[Array],
    seed: int,
) -> Regret:
    """Fly a schedule (H,) through the same inputs (trials, H, 1) in three ways.

    With errors (trials, H, W, 1) as they are `drawn` of the suite and of its residuals, and by
    sight; the promise is that of the `problem`, and the `seed` that of the scenes.
    """
    ideal = fly(landing, information, s, drawn[0], None)[1]
    gaussian, bootstrap = (fly(landing, information, s, e, choices)[1] - ideal for e in drawn)
    flown = fly_by_sight(landing, networks, information, s, choices, seed)[1] - ideal
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
) -> Array:
    """Return the regret of schedules fitted on few residuals (sizes, 2, repeats).

    Of the held-out pictures n are drawn and a suite is fitted, as it is or guarded; the schedule
    that is optimal for it is judged by a suite of `fresh` new pictures.  Regret is the total cost
    beyond that of the optimum of the latter, as a share of it: a little too much, as that one has
    had some luck as well.  `problem` is that of `modelselect`, and `solve` its solver.
    """
    (networks, _, old), cost = trained, problem.model_cost
    fresh, repeats = check_count("fresh", fresh), check_count("repeats", repeats)
    counts = [check_count("sizes", n, minimum=2) for n in check_array("sizes", sizes, "n", (None,))]
    W, M = len(networks), len(old.residual) // len(networks)
    if max(counts) > M:
        raise ValueError(f"sizes: expected numbers up to the {M} residuals, found {sizes}")
    truth = pose(problem, fit_landing(landing, measure_models(networks, fresh, rng), cost))
    least = solve(truth).cost
    table = np.empty((len(counts), 2, repeats))
    for i, k in np.ndindex(len(counts), repeats):
        chosen = rng.permutation(M)[: counts[i]]
        rows = (M * np.arange(W)[:, None] + chosen).ravel()
        few = Residuals(old.names, old.model[rows], old.altitude[rows], old.residual[rows])
        bins = min(BINS, max(2, counts[i] // 12))  # which leaves about ten residuals in each
        for j, guard in enumerate((False, True)):
            suite = fit_landing(landing, few, cost, bins, guard=guard)
            table[i, j, k] = truth.total_cost(solve(pose(problem, suite)).choices) / least - 1
    return table
