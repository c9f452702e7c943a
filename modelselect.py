r"""Which perception model should a robot run at each step?  The mathematics, in the paper's order.

A robot follows x_{t+1} = A x_t + B u_t + C s_t for t = 0..H-1.  It never sees the perception
input s_t; at every step it runs one of W perception models and acts on the estimate
s_hat_t = s_t + error.  A small model is cheap and wrong, a large one is dear and right.
A schedule c = (w_0, ..., w_{H-1}) names the model of every step.  Wrong estimates cost the
controller e' Psi e more than true ones, so the best schedule in expectation minimises

    alpha * (mu_c' Psi mu_c + sum_t trace(Psi_tt Sigma_{t,w_t}))  +  beta * sum_t kappa_{w_t},

quadratic in the mean errors, linear in the variances: an integer quadratic programme.  Beyond the
paper, switching models may cost something, and what is spent may be limited.  Of modelselect_parts,
task.py and regulator.py are section II, the task and Psi; problem.py is section III, the problem;
trellis.py computes the certificate and takes rounding off it.  Here are the solvers, plain forms
first: each is a function from a problem to a `Schedule`, which `_certified` makes.

Symbol table (paper: "Dynamic Selection of Perception Models for Robotic Control";
equations by their LaTeX labels)

==================  ==============  ===================  ==========  =========================
name here           paper           shape                unit        equation
==================  ==============  ===================  ==========  =========================
horizon, H          H               int                  steps       ``eq:dynamics``
n, m, p             n, -, p         ints                 -           ``eq:dynamics``
A, B, C             A, B, C         (n,n) (n,m) (n,p)    per step    ``eq:dynamics``
Q, R, Q_final       c, c_{H-1}      (n,n) (m,m) (n,n)    cost        ``eq:jc``
s, s_hat            s, s-hat        (H, p)               perception  ``eq:perceptionModel``
errors, e           s-hat - s       (H, p)               perception  ``eq:control_cost_diff``
psi                 Psi             (pH, pH)             cost/per^2  ``eq:control_cost_diff``
choices, c          c               (H,) ints            model       ``prob:model_selection``
one-hot, b          b               (H, W)               0 or 1      ``eq:perEncoding``
mean, mu            g_exp           (H, W, p)            perception  ``eq:perModelExp``
variance, Sigma     g_var           (H, W, p[, p])       per^2       ``eq:perModelVar``
model_cost, kappa   cost_per        (W,) or (H, W)       cost        ``eq:perceptionCost``
alpha, beta         alpha, beta     floats >= 0          -           ``eq:jtot``
linear, l           -               (H, W)               cost        ``opt:model_selection_
                                                                     expectation_sol``
reference, d        -               (pH,)                perception  (ours: the certificate)
multiplier, lam     -               float >= 0           cost/spent  (ours: the certificate)
switch_cost, sigma  -               (W, W)               cost        (ours: switching costs)
budget              -               float                cost        (ours: a hard budget)
pull, g             -               (H, p)               cost/per    (ours: a known term)
==================  ==============  ===================  ==========  =========================

A vector over time is flattened with entry r of step t at index t*p + r.  Inside functions the
paper's letters are used, unpacked in the first lines.

Tolerances.  All are relative.  A matrix of unit diagonal counts as symmetric, and an eigenvalue per
row as non-negative, up to MATRIX_TOLERANCE = 1e-12 (semidefinite.py; 1e-6 if given in single
precision): a thousand times what rounding leaves in a product of matrices; what is let pass is
taken out, but for last digits, which bounds allow for (`SelectionProblem.defect`; exact at up to
EXACT_ROWS = 32 rows).  A sum of k terms errs by at most k half units in the last place of the sum
of their sizes (`cost_rounding`, `trellis.rounding_unit`): bounds are lowered by that much, and a
cost of which it is more than EXACT_BELOW = 1e-10 is summed in fractions where that takes no time,
at up to EXACT_SIZE = 100 errors pH.  A budget is kept up to 1e-12 of it.  The label search may give
away SEARCH_SLACK = 1e-10 of the cost, its rounding if more, or MERGING = 30 roundings if those rule
out a proof; all of it lowers its bound.  So OPTIMALITY_GAP = 1e-9 (schedule.py) counts as proved.

>>> one = np.eye(1)  # an integrator that plans ahead
>>> task = ControlTask(A=one, B=one, C=one, Q=one, R=one, horizon=4)
>>> mean = np.tile([[1.0], [0.0]], (4, 1, 1))  # model 0 is off by 1, model 1 costs 2 a step
>>> problem = SelectionProblem(psi(task), mean, 0 * mean, model_cost=[0, 2])
>>> schedule = solve(problem)
>>> schedule.choices, schedule.cost, schedule.is_optimal
(array([1, 1, 1, 0]), 6.618, True)
>>> check_certificate(problem, schedule) <= schedule.lower_bound <= schedule.cost
True
>>> enumerate_schedules(problem).cost, relax(problem).value  # 16 schedules; fractions of models
(6.618, 6.604)
"""

from __future__ import annotations

import heapq
import math
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from time import perf_counter
from typing import Any

import numpy as np
import numpy.typing as npt

from modelselect_parts import column_generation as generation
from modelselect_parts import label_search, local_search, long_horizon, passes, relaxations, trellis
from modelselect_parts import regulator as controllers
from modelselect_parts import triangle as triangles
from modelselect_parts.blends import Blend, BlendProblem, sdp_blocks, solve_blend
from modelselect_parts.checks import (
    Array,
    Choices,
    Mask,
    as_numbers,
    check_array,
    check_choices,
    check_class,
    check_count,
    check_function,
    check_number,
    shown,
)
from modelselect_parts.correlated import correlated_cost, correlated_problem
from modelselect_parts.covariances import autoregressive_errors, persistent_bias
from modelselect_parts.descent import (
    Relaxation,
    closes,
    project_to_simplex,
    projected_gradient,
    step_lengths,
)
from modelselect_parts.error_costs import ErrorCost, error_cost, is_separable
from modelselect_parts.hardness import maximum_cut_problem, partition_problem
from modelselect_parts.held import expand_choices, hold
from modelselect_parts.interior_point import congruence, interior_point
from modelselect_parts.matrices import check_semidefinite, nearest_semidefinite
from modelselect_parts.observers import kalman_gains
from modelselect_parts.problem import EXACT_BELOW, SelectionProblem, stepwise_cost
from modelselect_parts.regulator import (
    PATTERNS,
    ControlTask,
    Pattern,
    Riccati,
    check_information,
    control_cost,
    plan,
    preview_regret,
    prior_pull,
    psi,
    riccati,
    run_controller,
)
from modelselect_parts.schedule import OPTIMALITY_GAP, Schedule, from_one_hot, one_hot
from modelselect_parts.semidefinite import semidefinite_root
from modelselect_parts.sensitivity import Sensitivity, sensitivity

__version__ = "0.2.0"

SEARCH_SLACK, MERGING = 1e-10, 30
PRICING_GAP = 1e-4  #: of the problems that price a budget, whose dual leaves more open than that
PERTURBATIONS = 20  #: tries of `local_search.perturbed` where moves cost something, too
WIDTHS = [64 * 8**k for k in range(8)]  #: labels that the passes of `dynamic_program` keep a step


def __getattr__(name: str) -> tuple[str, ...]:
    if name == "INFORMATION":  # the patterns that a task alone defines, read when asked
        return controllers.INFORMATION
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


# ---------------------------------------------------------------------------- certificates


def reference_bound(
    problem: SelectionProblem, reference: npt.ArrayLike, multiplier: float = 0.0
) -> tuple[float, Array]:
    """Bound every schedule from below: LB(d, lam) and r (H, W) of any `reference` d (pH,).

    lam is the `multiplier` >= 0 of the budget.

    With G[t,w] = 2 mu[t,w]'(alpha Psi d)_t + l[t,w] + lam kappa[t,w] and arcs (beta + lam) sigma,

        LB(d, lam) = cheapest path - d'(alpha Psi)d - lam budget,
        total(c)  >= LB(d, lam) + r[t, w_t] + (mu_c - d)'(alpha Psi)(mu_c - d)    for every t,

    r >= 0 what the cheapest path through (t, w) costs more.  Without switching costs the cheapest
    path is sum_t min_w G[t,w], and the sum of all r[t, w_t] may stand there.  Rounding is taken
    off, of Psi too (`problem.defect`): total(c) is not less, in exact numbers.
    """
    check_class("problem", problem, "SelectionProblem")
    d = check_array("reference", reference, "pH", (len(problem.psi),))
    found = _certificate(problem, d, check_number("multiplier", multiplier, minimum=0))
    return found.bound, found.reduced


def _certificate(problem: SelectionProblem, d: Array, multiplier: float) -> trellis.Certificate:
    found = trellis.certificate(problem.form, d, multiplier)
    if not math.isfinite(found.bound):
        raise ValueError("reference: the bound overflows; take a point among the mean errors")
    return found


def check_certificate(problem: SelectionProblem, schedule: Schedule) -> float:
    """Derive a schedule's root bound and its cost anew, trusting no solver; return the bound.

    A `lower_bound` above it was proved by a search, a minimum per step, or the prices: not here.
    ValueError if the schedule is not feasible, does not state this bound and its own cost (up to
    rounding), or a lower bound outside of them.  `Schedule.proof` says whether this is all of it.
    """
    check_class("schedule", schedule, "Schedule")
    check_class("problem", problem, "SelectionProblem")
    bound, _ = reference_bound(problem, schedule.reference, schedule.multiplier)
    if not problem.is_feasible(schedule.choices):
        raise ValueError("schedule.choices: expected available models within the budget")
    cost, rounding = problem._accurate_cost(schedule.choices)
    d = np.abs(schedule.reference)
    unit = trellis.rounding_unit(problem.mean)
    rounding += float(problem.cost_rounding(schedule.choices))  # Psi is semidefinite up to that
    paid = abs(schedule.multiplier * problem._limit) if schedule.multiplier else 0.0
    felt = float(trellis.form_size(problem.form.M, d))
    rounding += 4 * unit * (felt + abs(bound) + abs(cost) + paid)
    claims = (("cost", schedule.cost, cost), ("root_bound", schedule.root_bound, bound))
    for name, stated, found in claims:
        if not (math.isfinite(found) and abs(stated - found) <= rounding):
            raise ValueError(f"schedule.{name}: expected {found!r}, found {stated!r}")
    lower = schedule.lower_bound
    if not bound - rounding <= lower <= cost + rounding:
        raise ValueError(
            f"schedule.lower_bound: expected a number from {bound!r} to {cost!r}, found {lower!r}"
        )
    return bound


# ------------------------------------------------------------------- solvers: what they share


def _certified(
    problem: SelectionProblem,
    choices: Choices,
    point: tuple[Array, float],
    solver: str,
    proved: float = -math.inf,
    **work: Any,
) -> Schedule:
    """Make a Schedule, with the better of the bound at a point (d, lam) and what a search `proved`.

    LB(0, 0) is a bound as well: the better one where errors cancel.  So are the cheapest prices,
    to the last digit, without a pull: no variance costs less than 0.
    """
    cost, rounding = problem._accurate_cost(choices)
    points = (point, (np.zeros(len(point[0])), 0.0))
    root, d, multiplier = max(
        ((_certificate(problem, *pair).bound, *pair) for pair in points),
        key=lambda triple: triple[0],
    )
    lent = trellis.lacking(problem.form, 0 * d)
    cheapest = (problem._priced(problem._price, np.inf) - lent).min(axis=1)
    floor = float(cheapest.sum() - len(cheapest) * trellis.EPS * np.abs(cheapest).sum())
    plain = problem.pull is None and problem.variance.ndim == 3
    lower = max(root, floor if plain else root, min(proved, cost - rounding))
    return Schedule(choices, cost, min(cost, lower), root, d, solver, work, multiplier)


def _proved(
    problem: SelectionProblem, first: Schedule, choices: Choices, proved: float, **found: Any
) -> Schedule:
    """Return what a search from a first schedule found, on the certificate of that one."""
    cost, rounding = problem._accurate_cost(choices)
    lower = min(cost, max(first.lower_bound, min(proved, cost - rounding)))
    return replace(first, choices=choices, cost=cost, lower_bound=lower, **found)


def _stopwatch(problem: SelectionProblem, time_limit: float | None) -> Callable[[], float]:
    """Return a function that tells how many seconds of a limit are left for the problem."""
    check_class("problem", problem, "SelectionProblem")
    limit = math.inf if time_limit is None else check_number("time_limit", time_limit, minimum=0)
    end = perf_counter() + limit
    return lambda: end - perf_counter()


# ----------------------------------------------------------------------- solvers: enumeration


def enumerate_schedules(problem: SelectionProblem, *, max_schedules: int = 2**22) -> Schedule:
    """Try every schedule: the definition of ``sol:model_selection_expectation``, as code.

    Refuses more than `max_schedules`; of several optima it returns the first in lexicographic
    order, with its own mean error as reference.
    """
    check_class("problem", problem, "SelectionProblem")
    H, W, _ = problem.mean.shape
    max_schedules = check_count("max_schedules", max_schedules)
    if W**H > max_schedules:
        raise ValueError(f"problem: expected at most {max_schedules} schedules, found {W}^{H}")
    found = []
    for first in range(0, W**H, 2**14):
        number = np.arange(first, min(first + 2**14, W**H))
        block = number[:, None] // W ** np.arange(H)[::-1] % W  # the digits of 0..W^H-1 in base W
        found.append(_cheapest(problem, block))
    best, _ = _cheapest(problem, np.array([choices for choices, _ in found]))
    proved, point = min(bound for _, bound in found), (problem.chosen_mean(best), 0.0)
    return _certified(problem, best, point, "enumerate_schedules", proved, schedules=W**H)


def _cheapest(problem: SelectionProblem, schedules: Choices) -> tuple[Choices, float]:
    """Return the first cheapest of `schedules` (N, H), and what none of them costs less than.

    Where rounding hides which is the cheapest, up to 1000 of them are compared in fractions.
    """
    costs, rounding = problem.total_cost(schedules), problem.cost_rounding(schedules)
    costs = np.where(problem.is_feasible(schedules), costs, np.inf)
    upper = (costs + rounding).min()
    close = np.flatnonzero(costs - rounding <= upper)
    clear = not math.isfinite(upper) or rounding[close].max() <= EXACT_BELOW * abs(upper)
    if clear or len(close) > 1000:
        return schedules[costs.argmin()], float((costs - rounding).min())
    exact = [problem.exact_cost(c) for c in schedules[close]]
    return schedules[close[exact.index(min(exact))]], float(min(exact))


def solve_separable(problem: SelectionProblem) -> Schedule:
    """Solve a problem without coupling exactly, by one minimum per step: O(H W) once it is known.

    Steps decouple where Psi is block diagonal (without a forecast or memory), where all mean
    errors are zero, and where alpha = 0.  Otherwise this is the greedy policy's mistake.
    """
    if not is_separable(problem):
        raise ValueError("problem: expected uncoupled steps, found a mean error that Psi couples")
    alone = stepwise_cost(problem)
    mean, blocks = np.abs(problem.mean), problem.alpha * np.abs(problem.blocks)
    size = np.einsum("twi,tij,twj->tw", mean, blocks, mean) + problem.linear_size
    unit = trellis.rounding_unit(mean)
    proved = float((alone - unit * size).min(axis=1).sum())
    choices = alone.argmin(axis=1)
    point = problem.chosen_mean(choices), 0.0
    return _certified(problem, choices, point, "solve_separable", proved)


# ------------------------------------------------------------------- solvers: the relaxation


def _own_weights(problem: SelectionProblem, relaxation: Relaxation | None) -> Relaxation | None:
    """Evaluate a relaxation that was handed over anew, as another problem's proves nothing."""
    if relaxation is None:
        return None
    check_class("relaxation", relaxation, "Relaxation")
    b = check_array("relaxation.weights", relaxation.weights, "H W", problem.mean.shape[:2])
    off = np.abs(b.sum(axis=1) - 1).max()
    if b.min() < 0 or off > 1e-9 or (b > 0)[np.isinf(problem.linear)].any():
        raise ValueError(
            "relaxation.weights: expected rows >= 0 that sum to 1, and 0 where a model is not "
            "available, found others"
        )
    if problem.form.bare:
        return relaxations.of_weights(problem.form, b, relaxation.iterations)
    multiplier = relaxation.multiplier if problem.budget is not None else 0.0
    d = trellis.mixed(problem.mean, b)
    bound = _certificate(problem, d, multiplier).bound
    return replace(relaxation, reference=d, bound=bound, multiplier=multiplier)


def relax(
    problem: SelectionProblem, *, gap: float = 1e-6, max_iterations: int = 20_000
) -> Relaxation:
    """Relax each choice to weights on the simplex; solve by accelerated projected gradient.

    min over b of d'(alpha Psi)d + sum l.b with d_t = sum_w b[t,w] mu[t,w] (``eq:perEncoding``
    with 0 <= b <= 1): convex, and at any iterate LB(d) bounds every schedule from below.  Stops
    when value and bound agree to the fraction `gap`, or after `max_iterations`.

    Step t moves by its own 1/L_t, made for steps of very different weight: with centred means D_t
    (on the simplex only differences between models matter), L_t = 2 L trace(D_t'M_tt D_t) and L
    the largest eigenvalue of the Hessian so scaled.  See `projected_gradient`.
    """
    _expect_bare(problem)
    H, _, p = problem.mean.shape
    allowed = np.isfinite(problem.linear)
    D = (problem.mean - problem.mean.mean(axis=1, keepdims=True)) * allowed[..., None]
    F = semidefinite_root(np.einsum("twi,twj->tij", D, D))
    M, tiny = congruence(F, problem.quadratic), np.finfo(float).tiny
    size = M.diagonal().reshape(H, p).sum(axis=1)
    cheapest = problem.linear.min(axis=1, keepdims=True)
    slope = np.ptp(np.where(allowed, problem.linear, cheapest), axis=1)
    size = np.where(size > tiny, size, np.where(slope > tiny, slope, 1))  # a step only linear
    step = step_lengths(M, np.repeat(size, p))[::p, None]

    def project(b: Array) -> Array:  # more than 1 below the largest entry: no weight
        below = b - np.where(allowed, b, -np.inf).max(axis=1, keepdims=True)
        return project_to_simplex(np.where(allowed, np.maximum(below, -2), -2))

    def evaluate(b: Array) -> tuple[float, float, Array]:
        value, bound, G = trellis.relaxed(problem.form, b)
        return value, bound, np.where(allowed, G, 0)

    start = allowed / allowed.sum(axis=1, keepdims=True)
    limits = (gap, problem.rounding, max_iterations)
    b, iterations = projected_gradient(evaluate, project, start, step, *limits)
    return relaxations.of_weights(problem.form, b, iterations)


def _expect_bare(problem: SelectionProblem) -> None:
    check_class("problem", problem, "SelectionProblem")
    if not problem.form.bare:
        raise ValueError("problem: expected no switching costs, no budget; use relax_by_columns")


def relax_interior_point(
    problem: SelectionProblem,
    *,
    allowed: Mask | None = None,
    gap: float = 1e-7,
    ceiling: float = math.inf,
    time_limit: float | None = None,
    max_iterations: int = 60,
) -> Relaxation:
    """Solve the relaxation of `relax` by Newton's method: about ten steps, however stiff Psi.

    Over schedules of `allowed` models (H, W), those of finite cost by default; see
    modelselect_parts/interior_point.py.  Stops when value and bound agree to the fraction `gap`,
    as soon as the bound exceeds `ceiling`, after `time_limit` seconds or `max_iterations`: any
    iterate is a certificate, and that of the smallest gap comes back.
    """
    _expect_bare(problem)
    usable = np.isfinite(problem.linear)
    if allowed is not None:
        mask = check_array("allowed", allowed, "H W", usable.shape)
        if not ((mask == 0) | (mask == 1)).all():
            raise ValueError("allowed: expected True and False only")
        usable &= mask == 1
        if not usable.any(axis=1).all():
            raise ValueError("allowed: expected an available model in every row, found none")
    gap = check_number("gap", gap, minimum=0)
    ceiling = float(check_array("ceiling", ceiling, "", (), finite=False))
    time_left, most = _stopwatch(problem, time_limit), check_count("max_iterations", max_iterations)
    return _relax(problem, usable, gap, ceiling, time_left, most)


def relax_by_columns(
    problem: SelectionProblem,
    *,
    gap: float = 1e-8,
    time_limit: float | None = None,
    max_iterations: int = 300,
) -> Relaxation:
    """Relax to mixtures of whole schedules: with switching costs and a budget, too.

    The mixtures' mean errors form a polytope; column generation (column_generation.py) finds its
    corners as it needs them, by the cheapest path at the prices (d, lam) of the last mixture.
    Stops as `relax_interior_point` does, at the fraction `gap`, after `time_limit` seconds or
    `max_iterations`; without switching costs and a budget it is that one, slower.
    """
    gap, time_left = check_number("gap", gap, minimum=0), _stopwatch(problem, time_limit)
    most = check_count("max_iterations", max_iterations)
    closed = closes(gap, problem.rounding)
    limits: dict[str, Any] = {"time_left": time_left, "max_iterations": most}
    return relaxations.of_mixture(problem.form, generation.columns(problem.form, closed, **limits))


def _relax(
    problem: SelectionProblem,
    usable: Mask,
    gap: float,
    ceiling: float,
    time_left: Callable[[], float],
    max_iterations: int = 60,
) -> Relaxation:
    """Relax the problem whose other models are not available (relaxations.py)."""
    form = problem.form._replace(linear=np.where(usable, problem.linear, np.inf))
    limits: dict[str, Any] = {"ceiling": ceiling, "time_left": time_left}
    return relaxations.fastest(form, closes(gap, problem.rounding), max_iterations, **limits)


# -------------------------------------------------------------------- solvers: local search


def round_and_swap(
    problem: SelectionProblem,
    relaxation: Relaxation | None = None,
    *,
    time_limit: float | None = None,
) -> Schedule:
    """Round the relaxation to a schedule, then swap single models for as long as that helps.

    The `relaxation` is that of `relax_interior_point` by default.  Swapping w_t for w moves step
    t by D = mu[t,w] - mu[t,w_t] and the cost by 2 D'(alpha Psi mu_c)_t + D'(alpha Psi_tt)D
    + l[t,w] - l[t,w_t]; the best swap is taken, until `time_limit` seconds are over.
    """
    time_left = _stopwatch(problem, time_limit)
    return _start(problem, _own_weights(problem, relaxation), time_left)


def _start(
    problem: SelectionProblem, point: Relaxation | None, time_left: Callable[[], float]
) -> Schedule:
    """Relax, unless that is done, round and swap: what exact searches start from."""
    if point is None:
        point = _relax(problem, np.isfinite(problem.linear), 1e-7, math.inf, time_left)
    starts, form = [point.weights.argmax(axis=1)], problem.form
    if not form.bare:  # swaps are weak beside arcs
        lam = point.multiplier
        priced = trellis.slopes(form, point.reference, lam)[0], form.priced(lam)
        starts.append(trellis.cheapest_path(*priced))
    if form.price is not None:  # which rounding may exceed
        starts.append(trellis.cheapest_path(problem._price, problem.switch_cost))
    swapped = [_swap(problem, starts, time_left), (starts[-1], 0)]
    choices, swaps = min(swapped, key=lambda pair: _feasible_cost(problem, pair[0]))
    known = point.reference, point.multiplier
    return _certified(problem, choices, known, "round_and_swap", swaps=swaps)


def _swap(
    problem: SelectionProblem, starts: list[Choices], time_left: Callable[[], float], tries: int = 0
) -> tuple[Choices, int]:
    """Improve the best of these schedules by more than rounding; count the first descent."""
    if not isinstance(problem.form.M, np.ndarray):  # a product takes as long as a pass
        return starts[0], 0
    noise = max(problem.rounding, *(float(problem.cost_rounding(c)) for c in starts))
    choices, changes = local_search.descend(problem.form, starts, noise, time_left)
    return local_search.perturbed(problem.form, choices, tries, noise, time_left), changes


# ----------------------------------------------------- solvers: dynamic programming on labels


def plain_dynamic_program(problem: SelectionProblem, *, max_labels: int = 2**18) -> Schedule:
    """Extend every partial schedule from the last step to the first: the form to read first.

    A label is (cost so far above the bound, offset y it hands to earlier steps, choices); see
    modelselect_parts/label_search.py.  Nothing is discarded, so there are W^H labels at the end,
    `max_labels` at most; `dynamic_program` gives the same optimum with a handful.
    """
    check_class("problem", problem, "SelectionProblem")
    H, W, p = problem.mean.shape
    max_labels = check_count("max_labels", max_labels)
    if W**H > max_labels:
        raise ValueError(f"problem: expected at most {max_labels} labels, found {W}^{H}")
    first = _start(problem, None, _stopwatch(problem, None))
    d, lam = first.reference, first.multiplier
    found = _certificate(problem, d, lam)
    triangle = triangles.factor(problem.form, found, d, lam, first.cost - found.base)
    purse, U, e = triangles.purse(problem.form, lam), triangle.U, triangle.deviation
    moves = triangle.moves  # infinite where no better schedule goes
    spend = np.zeros_like(moves) if purse.spend is None else purse.spend
    labels: list[tuple[Any, Any, Array, tuple[int, ...]]] = [(0.0, 0.0, np.zeros(H * p), ())]
    for t in reversed(range(H)):
        rows, grown = slice(t * p, (t + 1) * p), []
        for extra, spent, y, later in labels:
            state = later[0] if later and moves.shape[1] > 1 else 0
            for w in range(W):
                shifted = y + U[:, rows] @ e[t, w]
                cost = extra + moves[t, state, w] + (shifted[rows] ** 2).sum()
                grown.append((cost, spent + spend[t, state, w], shifted, (w, *later)))
        labels = grown
    rest = [
        (extra + lam * max(purse.limit - spent, 0) if lam else extra, choices)
        for extra, spent, _, choices in labels
        if spent <= purse.limit + purse.grain
    ]
    excess, choices = min(rest, default=(math.inf, ()))
    best, proved, work = first.choices, first.cost, {"labels": len(labels)}
    if excess < math.inf:
        lost = label_search.losses(triangle, [], purse, float(excess), 0.0).total
        proved = min(proved, found.base + triangle.constant + excess - lost)
        if problem.is_feasible(choices):
            best = np.array(choices)
    return _proved(problem, first, best, proved, solver="plain_dynamic_program", work=work)


def dynamic_program(
    problem: SelectionProblem,
    *,
    time_limit: float | None = None,
    max_labels: int = WIDTHS[4],
    gap: float = OPTIMALITY_GAP,
    relaxation: Relaxation | None = None,
) -> Schedule:
    """Prove an optimum by dynamic programming from the last step to the first.

    Sphere decoding on a Viterbi trellis (label_search.py): a label is a partial schedule, and goes
    when it costs too much or when another one dominates it.  Passes (passes.py) keep at most 64
    (512 with switching costs or a budget), then eight times as many labels a step (with both, as
    many as there are), up to `max_labels` (at least 64; the default, 262144, takes a gigabyte or
    two where it is needed).
    Ends with the gap, or after `time_limit` seconds with what is proved by then; `relaxation`, of
    `relax_interior_point` by default, gives d and the first schedule.
    `work` holds the labels kept at every step of the last pass, whether it was complete (a gap is
    then due to rounding), the passes and the seconds.
    """
    max_labels = check_count("max_labels", max_labels, minimum=WIDTHS[0])
    gap, time_left = check_number("gap", gap, minimum=0), _stopwatch(problem, time_limit)
    first = _start(problem, _own_weights(problem, relaxation), time_left)
    return _searched(problem, first, gap, max_labels, time_left)


def _searched(
    problem: SelectionProblem,
    first: Schedule,
    gap: float,
    max_labels: int,
    time_left: Callable[[], float],
    skipped: int = 0,
    shared: bool = False,
) -> Schedule:
    """Search pass by pass from a first schedule and its certificate (passes.py).

    Narrow passes may be `skipped`: a wide one with room for all labels takes no longer.  A solver
    with which time is `shared` has what a longer pass would take most of, if passes closed little.
    """
    started, closed, seconds = perf_counter(), closes(gap, 0.0), 0.0

    def improve(choices: Choices) -> tuple[Choices, float]:
        better, _ = _swap(problem, [choices], time_left)
        return better, _feasible_cost(problem, better)

    known = (first.reference, first.multiplier), first.choices, first.cost, first.root_bound
    told = improve, lambda *best: _slack(problem, *best), lambda: time_left() <= 0
    search = passes.Search(problem.form, *known, *told)
    narrow = long_horizon.widths(problem.form, WIDTHS)[skipped:]
    widths = [width for width in narrow if width < max_labels] + [max_labels]
    for width in [*widths, max_labels]:
        if closed(search.cost, search.proved) or search.expired():
            break
        if (price := problem.form.price) is not None and search.may_price():
            _price_the_budget(problem, search, price, time_left)
        if shared and 1 < seconds > time_left() / 16 and search.share_closed() < 1 / 8:
            break  # the next pass takes up to eight times as long, more than half of what is left
        begun = perf_counter()
        again = search.step(width)
        seconds = perf_counter() - begun
        if not again or (width == max_labels and not search.complete):
            break  # again only with less to give away, or with room for more
    work = {"labels": search.labels, "passes": search.passes, "complete": search.complete}
    work["seconds"] = perf_counter() - started
    best, proved = search.choices, search.proved
    return _proved(problem, first, best, proved, solver="dynamic_program", work=work)


def _price_the_budget(
    problem: SelectionProblem, search: passes.Search, price: Array, time_left: Callable[[], float]
) -> None:
    """Let a search rest on a better price lam of the budget: the problem without, at beta + lam.

    A narrow pass a price finds schedules, hence where L is highest; only there is L proved.
    """
    limit, toll, tried = problem._limit, problem.switch_cost, dict[float, Schedule]()
    most = np.abs(price).max(axis=1).sum() + len(price) * (0.0 if toll is None else toll.max())

    def priced(lam: float) -> SelectionProblem:
        return replace(problem, beta=problem.beta + lam, budget=None)

    def cut(lam: float) -> passes.Cut:
        first = _start(priced(lam), None, time_left)
        found = _searched(priced(lam), first, PRICING_GAP, WIDTHS[1], time_left)
        search.offer(found.choices)
        spent, tried[lam] = float(problem.perception_term(found.choices)), found
        return passes.Cut(found.cost - lam * spent, spent)

    known = passes.Cut(search.cost, float(problem.perception_term(search.choices)))
    lam = passes.best_price(cut, limit, known, search.point[1], search.expired)
    found = _searched(priced(lam), tried[lam], PRICING_GAP, WIDTHS[4], time_left, skipped=2)
    search.offer(found.choices)
    lower, size = found.lower_bound, (problem.beta + lam) * most + lam * abs(limit)
    bound = float(lower - lam * limit - 8 * trellis.EPS * (size + abs(lower)))
    if toll is not None:
        search.offer(_swap(problem, [search.choices], time_left, PERTURBATIONS)[0])
    search.move((found.reference, lam), bound)


def _feasible_cost(problem: SelectionProblem, choices: Choices) -> float:
    """Return what a schedule costs, infinity beyond the budget."""
    return problem._accurate_cost(choices)[0] if problem.is_feasible(choices) else math.inf


def _slack(problem: SelectionProblem, choices: Choices, cost: float) -> float:
    """Return what a search may give away; without a proof in reach, enough for labels to merge."""
    rounding = float(problem.cost_rounding(choices))
    if 4 * rounding > OPTIMALITY_GAP * abs(cost):
        return MERGING * rounding
    return max(SEARCH_SLACK * abs(cost), rounding)


# --------------------------------------------------------------- solvers: branch and bound


@dataclass(frozen=True)
class Node:
    """A node of the tree of `branch_and_bound`: its parent with one more choice made."""

    parent: int  #: position of the parent in the tree; -1 for the root
    step: int  #: the step at which this node has chosen; -1 for the root
    model: int  #: the model chosen there
    bound: float  #: every schedule below this node costs at least this, or at least `best`
    seconds: float  #: when it was bounded
    best: float  #: cost of the best schedule known then


def branch_and_bound(
    problem: SelectionProblem,
    *,
    time_limit: float | None = None,
    max_nodes: int | None = None,
    gap: float = OPTIMALITY_GAP,
    relaxation: Relaxation | None = None,
) -> Schedule:
    """Split where the relaxation mixes models most, always the part with the lowest bound next.

    Every node relaxes what is still open, rounds the result to a schedule, and forbids for all
    its children the models whose reduced cost exceeds best - bound.  Its children settle the
    step with the largest blur sum_w b[t,w] |mu[t,w] - d_t|^2, weighed by Psi's diagonal.  Nodes
    that cannot beat the best schedule are dropped.  Best first expands only nodes whose bound is
    not above the optimum, and its lower bound only rises.  Ends with the gap, after `time_limit`
    seconds or `max_nodes` nodes; `work["tree"]` is the list of `Node`, root first.
    """
    time_left, started = _stopwatch(problem, time_limit), perf_counter()
    most = math.inf if max_nodes is None else check_count("max_nodes", max_nodes)
    gap = check_number("gap", gap, minimum=0)
    allowed = np.isfinite(problem.linear)
    root = _own_weights(problem, relaxation)
    root = root or _relax(problem, allowed, gap / 10, math.inf, time_left)
    first = _start(problem, root, time_left)
    best, cost, settled = first.choices, first.cost, math.inf
    tree = [Node(-1, -1, -1, first.root_bound, perf_counter() - started, cost)]
    _, allowed, step = _narrowed(problem, allowed, root, cost)
    queue = [(first.root_bound, 0, allowed, step)]
    while queue and len(tree) < most and time_left() > 0:
        lower, parent, allowed, step = queue[0]
        if closes(gap, 0.0)(cost, lower):
            break
        node = heapq.heappop(queue)
        for model in np.flatnonzero(allowed[step]):
            if time_left() <= 0 or len(tree) >= most:
                heapq.heappush(queue, node)  # its bound must not be lost
                break
            child = allowed.copy()
            child[step] = np.arange(child.shape[1]) == model
            point = _relax(problem, child, gap / 10, cost, time_left)
            bound, child, undecided = _narrowed(problem, child, point, cost)
            bound = max(lower, bound)
            tree.append(Node(parent, int(step), int(model), bound, perf_counter() - started, cost))
            rounded = np.where(child, point.weights, -1).argmax(axis=1)
            if child[undecided].sum() == 1:  # a single schedule is left
                if problem.is_feasible(rounded):
                    alone, rounding = problem._accurate_cost(rounded)
                    settled = min(settled, alone - rounding)
            elif bound < cost:
                heapq.heappush(queue, (bound, len(tree) - 1, child, undecided))
            candidate, _ = _swap(problem, [rounded], time_left)
            if (lower_cost := _feasible_cost(problem, candidate)) < cost:
                best, cost = candidate, lower_cost
    lower = min([settled, cost, *(node[0] for node in queue[:1])])
    work = {"nodes": len(tree), "tree": tree, "seconds": perf_counter() - started}
    return _proved(problem, first, best, lower, solver="branch_and_bound", work=work)


def _narrowed(
    problem: SelectionProblem, allowed: Mask, point: Relaxation, cost: float
) -> tuple[float, Mask, int]:
    """Bound the schedules of allowed models; forbid models of none cheaper than `cost`.

    Return the bound, the models left, and the step to split, which has a choice left if any has.
    """
    H, _, p = problem.mean.shape
    if point.bound == math.inf:  # nothing below this node keeps the budget
        return math.inf, allowed, 0
    form = problem.form._replace(linear=np.where(allowed, problem.linear, np.inf))
    found = trellis.certificate(form, point.reference, point.multiplier)
    bound, reduced = found.bound, found.reduced
    narrowed = allowed & (reduced <= cost - bound)
    narrowed[np.arange(H), reduced.argmin(axis=1)] = True
    away = (problem.mean - point.reference.reshape(H, 1, p)) ** 2
    weight = form.M.diagonal().reshape(H, 1, p)
    blur = (point.weights * (away * weight).sum(axis=-1)).sum(axis=1)
    return bound, narrowed, int(np.where(narrowed.sum(axis=1) > 1, blur, -1.0).argmax())


# ------------------------------------------------------------------------ solvers: all in one


def solve(
    problem: SelectionProblem,
    *,
    time_limit: float | None = None,
    gap: float = OPTIMALITY_GAP,
    max_labels: int = WIDTHS[4],
) -> Schedule:
    """Find and certify a best schedule by the cheapest way that proves it.

    Uncoupled steps: one minimum per step.  Otherwise relax, round and swap; if the gap is still
    open, `dynamic_program`; if rounding stops that, 1000 nodes of `branch_and_bound`.  Under a time
    limit it has all the time left, also where `max_labels` stops the search or, with no arcs and no
    budget, its passes close little.  The best schedule and the highest proved bound come back.

    Parameters
    ----------
    problem : SelectionProblem
        The problem.
    time_limit : float, optional
        Seconds after which the best schedule and bound so far are returned; 0 gives one, too.
        Looked at between Newton steps, swaps, steps of the search and nodes.
    gap : float
        Stop when cost and bound agree to this fraction; `is_optimal` does not depend on it.
    max_labels : int
        Most labels kept a step by `dynamic_program`, at least 64.

    Returns
    -------
    Schedule
        Ask `.is_optimal` or `.gap` whether optimality was proved.

    Raises
    ------
    ValueError
        A limit out of range.

    Examples
    --------
    >>> mean = [[[1], [0]], [[1], [0]]]
    >>> problem = SelectionProblem([[1.4, 0.8], [0.8, 0.6]], mean, np.zeros((2, 2, 1)), [0, 1])
    >>> schedule = solve(problem)
    >>> schedule.choices, schedule.cost, schedule.is_optimal
    (array([1, 0]), 1.6, True)
    """
    gap = check_number("gap", gap, minimum=0)
    max_labels = check_count("max_labels", max_labels, minimum=WIDTHS[0])
    time_left = _stopwatch(problem, time_limit)
    if is_separable(problem):
        return solve_separable(problem)
    relaxation = _relax(problem, np.isfinite(problem.linear), 1e-7, math.inf, time_left)
    quick = _start(problem, relaxation, time_left)
    if quick.gap <= gap or time_left() <= 0:
        return quick
    decoded = _searched(problem, quick, gap, max_labels, time_left, shared=problem.form.bare)
    if decoded.gap <= gap or time_left() <= 0 or not (time_limit or decoded.work["complete"]):
        return decoded
    options: dict[str, Any] = {"gap": gap, "relaxation": relaxation}
    limits = {"time_limit": max(0.0, time_left())} if time_limit else {"max_nodes": 1000}
    split = branch_and_bound(problem, **options, **limits)
    best = min(decoded, split, key=lambda schedule: schedule.cost)
    bound = max(decoded.lower_bound, split.lower_bound)
    return replace(best, lower_bound=min(best.cost, bound))


# ---------------------------------------------------- the whole Pareto front; planning anew


def pareto_front(
    problem: SelectionProblem,
    *,
    resolution: float = 0.0,
    time_limit: float | None = None,
    progress: Callable[[float], None] | None = None,
) -> list[Schedule]:
    """Return the schedules that no other beats in both control and perception term, dearest first.

    Each is the optimum at alpha = 1, beta = 0 under a budget just below what the one before spends,
    or `resolution` below: its `cost` is its `control_term`, and `check_certificate` judges its
    proof.  Weights reach the corners of the front's convex hull only, budgets every point.  The
    problem's own `budget` is where the front begins.

    Points of equal control up to OPTIMALITY_GAP count as one; real-valued prices can give tens of
    thousands: then state a resolution.  Where `time_limit` seconds, or rounding, leave a gap, a
    warning says what is open.  `progress` is called with the share of the range done, up to 1.
    """
    resolution = check_number("resolution", resolution, minimum=0)
    time_left, now = _stopwatch(problem, time_limit), replace(problem, alpha=1.0, beta=0.0)
    if progress is not None:
        check_function("progress", progress)
    tolls = 0.0 if problem.switch_cost is None else problem.switch_cost
    prices = np.append(problem._price[np.isfinite(problem._price)], tolls)
    whole = bool((prices == np.floor(prices)).all() and np.abs(prices).max() < 2**53)
    cheapest = trellis.cheapest_path(problem._price, problem.switch_cost)
    least, most = float(problem.perception_term(cheapest)), -math.inf
    budget = math.inf if problem.budget is None else problem.budget
    front: list[Schedule] = []
    while True:
        found = solve(now, time_limit=None if time_limit is None else max(0.0, time_left()))
        if not found.is_optimal:
            left = f"not proved from perception {budget:g} down to {least:g}"
            warnings.warn("pareto_front: " + left, stacklevel=2)
            return front
        if front and closes(OPTIMALITY_GAP, 0.0)(found.cost, front[-1].cost):
            front.pop()  # as good for control, and spends less
        front.append(found)
        spent = float(problem.perception_term(found.choices))
        step = max(resolution, float(whole), 4 * problem._spending_slack(spent))
        most, budget = max(most, spent), spent - step
        if progress is not None:
            progress((most - budget) / (most - least) if budget > least else 1.0)
        if spent <= least or budget < least - problem._spending_slack(least):
            return front
        now = replace(now, budget=max(budget, least))


def receding_horizon(
    outlook: Callable[[int], SelectionProblem],
    steps: int,
    *,
    budget: float | None = None,
    time_limit: float | None = None,
) -> Iterator[Schedule]:
    """Plan anew at each of `steps` steps, run the first model of each plan; yield plan after plan.

    outlook(t) is the problem from step t on, as it looks then: a window, or all that is left, with
    the `pull` of a known error of the state (`prior_pull`); it gets the model that ran before as
    `initial_model`, what is left of a `budget`, `time_limit` seconds, and a certificate of its own.
    """
    check_function("outlook", outlook)
    spent, known = 0.0, dict[str, Any]()
    budget = None if budget is None else check_number("budget", budget)
    for t in range(check_count("steps", steps)):
        if budget is not None:
            known["budget"] = budget - spent + 1e-12 * abs(budget)  # see Tolerances
        problem = replace(outlook(t), **known)
        yield (found := solve(problem, time_limit=time_limit))
        known["initial_model"] = int(found.choices[0])
        spent += float(problem._price[0, found.choices[0]])
