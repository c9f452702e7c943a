r"""Which perception model should a robot run at each step?  The mathematics, in the paper's order.

A robot follows x_{t+1} = A x_t + B u_t + C s_t for t = 0..H-1.  It never sees the perception
input s_t; at every step it runs one of W perception models and acts on the estimate
s_hat_t = s_t + error.  A small model is cheap and wrong, a large one is dear and right.
A schedule c = (w_0, ..., w_{H-1}) names the model of every step.  Wrong estimates cost the
controller e' Psi e more than true ones, so the best schedule in expectation minimises

    alpha * (mu_c' Psi mu_c + sum_t trace(Psi_tt Sigma_{t,w_t}))  +  beta * sum_t kappa_{w_t},

quadratic in the mean errors, linear in the variances: an integer quadratic programme.
The functions stand in the order of the paper: task -> Psi -> problem -> schedule.

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
==================  ==============  ===================  ==========  =========================

A vector over time is flattened with entry r of step t at index t*p + r.  Inside functions the
paper's letters are used, unpacked in the first lines.

Examples
--------
An integrator that plans ahead, one model that is off by 1, one that costs 2 a step:

>>> import numpy as np
>>> one = np.eye(1)
>>> task = ControlTask(A=one, B=one, C=one, Q=one, R=one, horizon=4)
>>> mean = np.tile([[1.0], [0.0]], (4, 1, 1))
>>> problem = SelectionProblem(psi(task), mean, 0 * mean, model_cost=[0, 2])
>>> schedule = solve(problem)
>>> schedule.choices, schedule.is_optimal
(array([1, 1, 1, 0]), True)
"""

from __future__ import annotations

import heapq
import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from time import perf_counter
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import scipy.linalg as la

from modelselect_parts.blends import Blend, BlendProblem, sdp_blocks, solve_blend
from modelselect_parts.checks import (
    MATRIX_TOLERANCE,
    Array,
    Choices,
    Frozen,
    as_numbers,
    check_array,
    check_choices,
    check_count,
    check_number,
    check_semidefinite,
    frozen,
    semidefinite_root,
    shown,
)
from modelselect_parts.descent import project_to_simplex, projected_gradient
from modelselect_parts.regulator import (
    PATTERNS,
    ControlTask,
    Pattern,
    Riccati,
    check_information,
    control_cost,
    plan,
    preview_regret,
    psi,
    riccati,
    run_controller,
)

__version__ = "0.2.0"


def __getattr__(name: str) -> tuple[str, ...]:
    if name == "INFORMATION":  # the rows of the table, read when asked
        return tuple(PATTERNS)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


# A schedule counts as optimal when its relative gap is at most this.
OPTIMALITY_GAP = 1e-9
# Passes of `dynamic_program`: labels kept a step.
WIDTHS = [64 * 16**k for k in range(8)]
# `dynamic_program` merges labels and truncates offsets up to this fraction of the cost.
ROUNDING = 1e-10
# Most numbers in one array, 8 GB: what needs more is refused before memory runs out.
# -------------------------------------------------------------------- the selection problem


def one_hot(choices: npt.ArrayLike, models: int) -> Array:
    """Encode c as b: b[t, w] = 1 exactly where w = w_t (``eq:perEncoding``).

    Parameters
    ----------
    choices : array_like of int, (H,)
        Model of every step.
    models : int
        Number of models W.

    Returns
    -------
    ndarray, (H, W)
        Zeros and ones.

    Raises
    ------
    ValueError
        A choice that is not an integer in 0..W-1.
    """
    H = np.size(check_array("choices", choices, "H", (None,)))
    W = check_count("models", models)
    return np.where(check_choices(choices, H, W)[:, None] == np.arange(W), 1.0, 0.0)


def from_one_hot(weights: npt.ArrayLike) -> Choices:
    """Decode b into c, the inverse of `one_hot`.

    Parameters
    ----------
    weights : array_like, (H, W)
        Zeros and ones, a single one in every row.

    Returns
    -------
    ndarray of int, (H,)

    Raises
    ------
    ValueError
        Entries other than 0 and 1, or a row that does not hold exactly one 1.
    """
    b = check_array("weights", weights, "H W", (None, None))
    if not ((b == 0) | (b == 1)).all() or (b.sum(axis=1) != 1).any():
        raise ValueError("weights: expected a single 1 and otherwise 0 in every row")
    return np.asarray(b.argmax(axis=1))


@dataclass(frozen=True, eq=False)
class SelectionProblem(Frozen):
    """Which model to run at each step (``prob:model_selection_expectation``).

    E[total](c) = alpha (mu_c' Psi mu_c + sum_t trace(Psi_tt Sigma[t, w_t]))
                + beta sum_t kappa[t, w_t],
    without the constant alpha J(u*).  Errors must be independent across steps; zero variance
    states known errors (``prob:model_selection``).  Where p = 1, `mean` and `variance` both
    given transposed, (1, W, H), pose one step of H components: this cannot be caught.

    Parameters
    ----------
    psi : array_like, (pH, pH)
        Sensitivity of the control cost, symmetric positive semidefinite; see `psi`.
    mean : array_like, (H, W, p)
        Mean error of each model at each step.
    variance : array_like, (H, W, p) or (H, W, p, p)
        Variance of each component, then uncorrelated, or covariance within a step.
    model_cost : array_like, (W,) or (H, W)
        Cost of running a model; ``inf`` where a model is not available.
    alpha, beta : float
        Weights >= 0 of control and perception cost (``eq:jtot``).

    Raises
    ------
    ValueError
        A wrong shape, a NaN, a negative variance or weight, an indefinite `psi`, or a step at
        which no model is available.

    Examples
    --------
    Two steps; model 0 is free and off by 1, model 1 costs 2 and is right:

    >>> mean = [[[1], [0]], [[1], [0]]]
    >>> problem = SelectionProblem([[1.4, 0.8], [0.8, 0.6]], mean, np.zeros((2, 2, 1)), [0, 2])
    >>> problem.total_cost([[0, 0], [0, 1], [1, 0], [1, 1]])
    array([3.6, 3.4, 2.6, 4. ])
    """

    psi: Array
    mean: Array
    variance: Array
    model_cost: Array
    alpha: float = 1.0
    beta: float = 1.0

    def __post_init__(self) -> None:
        names = ("psi", "mean", "variance", "model_cost")
        raw = {name: as_numbers(name, getattr(self, name)) for name in names}
        Psi = check_array("psi", raw["psi"], "pH pH", 2 * (raw["psi"].shape[-1:] or (None,)))
        shape = raw["mean"].shape
        p = shape[-1] if len(shape) == 3 and shape[-1] and len(Psi) % shape[-1] == 0 else 1
        mean = check_array("mean", self.mean, "H W p", (len(Psi) // p, None, p))
        H, W, _ = mean.shape
        axes = "H W p p" if raw["variance"].ndim == 4 else "H W p"
        variance = check_array("variance", self.variance, axes, (H, W, p, p)[: len(axes.split())])
        axes = "H W" if raw["model_cost"].ndim == 2 else "W"
        cost = check_array(
            "model_cost", self.model_cost, axes, (H, W)[-len(axes.split()) :], finite=False
        )
        if np.isneginf(cost).any() or np.isinf(cost).all(axis=-1).any():
            raise ValueError("model_cost: expected a finite cost at every step, found none or -inf")
        check_semidefinite("psi", Psi)
        if variance.ndim == 4:
            check_semidefinite("variance", variance)
        elif variance.min() < 0:
            raise ValueError(f"variance: expected numbers >= 0, found {variance.min():g}")
        checked = {"psi": Psi, "mean": mean, "variance": variance, "model_cost": cost}
        weights = {
            name: check_number(name, getattr(self, name), minimum=0) for name in ("alpha", "beta")
        }
        for name, value in {**checked, **weights}.items():
            object.__setattr__(self, name, value)
        with np.errstate(over="ignore", invalid="ignore"):
            felt = np.abs(mean).max(axis=1).ravel()
            largest = felt @ np.abs(self.quadratic) @ felt + np.abs(self.spread).sum()
            largest += np.abs(self.linear[np.isfinite(np.broadcast_to(cost, (H, W)))]).sum()
        if not largest < 1e300:
            raise ValueError(
                "psi: the costs overflow; rescale psi, mean, variance, model_cost, alpha or beta"
            )

    @cached_property
    def quadratic(self) -> Array:
        """Return alpha Psi, (pH, pH)."""
        return frozen(self.alpha * self.psi)

    @cached_property
    def blocks(self) -> Array:
        """Diagonal blocks Psi_tt, (H, p, p)."""
        H, _, p = self.mean.shape
        return frozen(self.psi.reshape(H, p, H, p)[np.arange(H), :, np.arange(H)])

    @cached_property
    def spread(self) -> Array:
        """What the variances add to the control term, trace(Psi_tt Sigma[t,w]), (H, W)."""
        over = "tij,twji->tw" if self.variance.ndim == 4 else "tii,twi->tw"
        return frozen(np.einsum(over, self.blocks, self.variance))

    @cached_property
    def linear(self) -> Array:
        """Linear cost l[t,w] = alpha trace(Psi_tt Sigma[t,w]) + beta kappa[t,w], (H, W)."""
        unavailable = np.isinf(self.model_cost)  # also where beta = 0
        priced = self.beta * np.where(unavailable, 0, self.model_cost)
        return frozen(self.alpha * self.spread + np.where(unavailable, np.inf, priced))

    @cached_property
    def rounding(self) -> float:
        """How far rounding can move a cost near the optimum: what no solver can tell apart.

        A unit in the last place of the terms that the cost of the greedy schedule is summed from:
        models nobody would use do not count, however wrong or dear they are.
        """
        H, greedy = len(self.mean), stepwise_cost(self).argmin(axis=1)
        linear = self.linear[np.arange(H), greedy]
        quadratic = stepwise_cost(self)[np.arange(H), greedy] - linear
        return float(np.finfo(float).eps * (quadratic.sum() + np.abs(linear).sum()))

    def chosen_mean(self, choices: npt.ArrayLike) -> Array:
        """Stack the mean errors mu_c of `choices` (..., H) into vectors (..., pH)."""
        c = self._check(choices)
        return self.mean[np.arange(c.shape[-1]), c].reshape(*c.shape[:-1], -1)

    def control_term(self, choices: npt.ArrayLike) -> Any:
        """Return mu_c' Psi mu_c + sum_t trace(Psi_tt Sigma[t, w_t]) of `choices` (..., H)."""
        mu = self.chosen_mean(choices)
        return ((mu @ self.psi) * mu).sum(axis=-1) + self._total(self.spread, choices)

    def perception_term(self, choices: npt.ArrayLike) -> Any:
        """Return sum_t kappa[t, w_t] of `choices` (..., H) (``eq:jp``)."""
        return self._total(np.broadcast_to(self.model_cost, self.mean.shape[:2]), choices)

    def total_cost(self, choices: npt.ArrayLike) -> Any:
        """Return alpha control_term + beta perception_term of `choices` (..., H)."""
        mu = self.chosen_mean(choices)
        return ((mu @ self.quadratic) * mu).sum(axis=-1) + self._total(self.linear, choices)

    def _total(self, table: Array, choices: npt.ArrayLike) -> Any:
        c = self._check(choices)
        return table[np.arange(c.shape[-1]), c].sum(axis=-1)

    def _check(self, choices: npt.ArrayLike) -> Choices:
        return check_choices(choices, *self.mean.shape[:2])


# --------------------------------------------------------------- schedules and certificates


@dataclass(frozen=True, eq=False)
class Schedule(Frozen):
    """A schedule with its proof: every solver returns one.

    Parameters
    ----------
    choices : ndarray of int, (H,)
        Model of every step.
    cost : float
        `SelectionProblem.total_cost` of the choices.
    lower_bound : float
        No schedule costs less (up to `ROUNDING`).  Where it exceeds `root_bound`, the search has
        proved it.
    root_bound : float
        LB(reference), which `check_certificate` derives anew.
    reference : ndarray, (pH,)
        The point d of the certificate: any d gives a bound, a good d a tight one.
    solver : str
        Name of the function that found the schedule.
    work : mapping
        What the search did: counts, seconds, and the tree of `branch_and_bound`.
    """

    choices: Choices
    cost: float
    lower_bound: float
    root_bound: float
    reference: Array
    solver: str
    work: Mapping[str, Any] = field(default_factory=dict, repr=False)

    @property
    def gap(self) -> float:
        """(cost - lower_bound) / max(|cost|, |lower_bound|), or 0 where the two are equal."""
        if self.cost == self.lower_bound:
            return 0.0
        return (self.cost - self.lower_bound) / max(abs(self.cost), abs(self.lower_bound))

    @property
    def is_optimal(self) -> bool:
        """Whether the gap is at most `OPTIMALITY_GAP`, so that nothing is better by more."""
        return self.gap <= OPTIMALITY_GAP


def reference_bound(problem: SelectionProblem, reference: npt.ArrayLike) -> tuple[float, Array]:
    """Bound every schedule from below, from one point d.

    With G[t,w] = 2 mu[t,w]'(alpha Psi d)_t + l[t,w], LB(d) = sum_t min_w G[t,w] - d'(alpha Psi)d
    and r[t,w] = G[t,w] - min_w G[t,w] >= 0, every schedule satisfies

        total(c) = LB(d) + sum_t r[t, w_t] + (mu_c - d)'(alpha Psi)(mu_c - d),

    because x'Mx = 2 x'Md - d'Md + (x - d)'M(x - d).  Nothing after LB(d) is negative.

    Parameters
    ----------
    problem : SelectionProblem
        The problem.
    reference : array_like, (pH,)
        The point d, in units of perception.

    Returns
    -------
    bound : float
        LB(d).
    reduced_cost : ndarray, (H, W)
        r[t, w]: what using model w at step t adds at the least.

    Raises
    ------
    ValueError
        A wrong shape or a number that is not finite.
    """
    d = check_array("reference", reference, "pH", (len(problem.psi),))
    with np.errstate(over="ignore", invalid="ignore"):
        G, constant = _slopes(problem, problem.linear, d)
        lowest = G.min(axis=1)
        bound = float(lowest.sum() + constant)
    if not math.isfinite(bound):
        raise ValueError("reference: the bound overflows; take a point among the mean errors")
    return bound, G - lowest[:, None]


def _slopes(problem: SelectionProblem, linear: Array, d: Array) -> tuple[Array, float]:
    """G (H, W) less each step's least l, and what is missing for LB(d) = sum_t min_w G + constant.

    Leaving out the least l first saves the digits that a large common price would cost.
    """
    pull, cheapest = problem.quadratic @ d, linear.min(axis=1)
    H, _, p = problem.mean.shape
    G = 2 * np.einsum("twi,ti->tw", problem.mean, pull.reshape(H, p)) + (linear - cheapest[:, None])
    return G, float(cheapest.sum() - d @ pull)


def check_certificate(problem: SelectionProblem, schedule: Schedule) -> float:
    """Derive a schedule's root bound and its cost anew, trusting no solver.

    Parameters
    ----------
    problem : SelectionProblem
        The problem.
    schedule : Schedule
        What a solver returned for it.

    Returns
    -------
    float
        LB(reference), a lower bound on every schedule.  A `lower_bound` above it was proved by
        the solver's search and is not re-derived here.

    Raises
    ------
    ValueError
        If the schedule does not state this bound and its own cost (up to rounding), or a lower
        bound outside of them.

    Examples
    --------
    >>> mean = [[[1], [0]], [[1], [0]]]
    >>> problem = SelectionProblem([[1.4, 0.8], [0.8, 0.6]], mean, np.zeros((2, 2, 1)), [0, 1])
    >>> schedule = solve(problem)
    >>> check_certificate(problem, schedule) <= schedule.lower_bound <= schedule.cost
    True
    """
    bound, _ = reference_bound(problem, schedule.reference)
    cost, d = float(problem.total_cost(schedule.choices)), schedule.reference
    # Rounding is relative to the largest terms that the two are summed from.
    scale = max(abs(cost), abs(bound), float(d @ problem.quadratic @ d))
    claims = (("cost", schedule.cost, cost), ("root_bound", schedule.root_bound, bound))
    for name, stated, found in claims:
        if not (math.isfinite(found) and abs(stated - found) <= 1e-9 * scale):
            raise ValueError(f"schedule.{name}: expected {found!r}, found {stated!r}")
    lower = schedule.lower_bound
    if not bound - 1e-9 * scale <= lower <= cost + 1e-9 * scale:
        raise ValueError(
            f"schedule.lower_bound: expected a number from {bound!r} to {cost!r}, found {lower!r}"
        )
    return bound


# ------------------------------------------------------------------- solvers: what they share


def _certified(
    problem: SelectionProblem,
    choices: npt.ArrayLike,
    reference: Array,
    solver: str,
    proved: float = -math.inf,
    **work: Any,
) -> Schedule:
    """Make a Schedule: the root bound from the reference, the better of it and `proved`."""
    c = frozen(np.array(choices, dtype=np.intp))
    d = frozen(np.array(reference))
    cost, root = float(problem.total_cost(c)), reference_bound(problem, d)[0]
    return Schedule(c, cost, min(cost, max(root, proved)), root, d, solver, work)


def _stopwatch(time_limit: float | None) -> Callable[[], bool]:
    """Return a function that tells whether the time limit (in seconds, if any) is over."""
    if time_limit is None:
        return lambda: False
    end = perf_counter() + check_number("time_limit", time_limit, minimum=0)
    return lambda: perf_counter() >= end


# ----------------------------------------------------------------------- solvers: enumeration


def enumerate_schedules(problem: SelectionProblem, *, max_schedules: int = 2**22) -> Schedule:
    """Try every schedule: the definition of ``sol:model_selection_expectation``, as code.

    Parameters
    ----------
    problem : SelectionProblem
        The problem.
    max_schedules : int
        Refuse to try more than this many of the W^H schedules.

    Returns
    -------
    Schedule
        The first of the cheapest schedules in lexicographic order, with its own mean error as
        reference; proved by exhaustion.

    Raises
    ------
    ValueError
        If there are more than `max_schedules`.

    Examples
    --------
    >>> mean = [[[1], [0]], [[1], [0]]]
    >>> problem = SelectionProblem([[1.4, 0.8], [0.8, 0.6]], mean, np.zeros((2, 2, 1)), [0, 1])
    >>> schedule = enumerate_schedules(problem)
    >>> schedule.choices, schedule.cost, schedule.work["schedules"]
    (array([1, 0]), 1.6, 4)
    """
    H, W, _ = problem.mean.shape
    max_schedules = check_count("max_schedules", max_schedules)
    if W**H > max_schedules:
        raise ValueError(f"problem: expected at most {max_schedules} schedules, found {W}^{H}")
    best, lowest = np.zeros(H, dtype=np.intp), math.inf
    for first in range(0, W**H, 2**14):
        number = np.arange(first, min(first + 2**14, W**H))
        block = number[:, None] // W ** np.arange(H)[::-1] % W  # the digits of 0..W^H-1 in base W
        costs = problem.total_cost(block)
        if costs.min() < lowest:
            best, lowest = block[costs.argmin()], costs.min()
    cost, d = float(problem.total_cost(best)), problem.chosen_mean(best)
    return _certified(problem, best, d, "enumerate_schedules", cost, schedules=W**H)


def is_separable(problem: SelectionProblem) -> bool:
    """Whether no mean error at one step meets one at another step through Psi."""
    H, _, p = problem.mean.shape
    felt = (problem.mean != 0).any(axis=1).ravel() & (problem.alpha != 0)
    meets = ((problem.psi != 0) & felt[:, None] & felt).reshape(H, p, H, p).any(axis=(1, 3))
    return not (meets & ~np.eye(H, dtype=bool)).any()


def stepwise_cost(problem: SelectionProblem) -> Array:
    """Cost (H, W) of each model at each step alone: alpha mu'Psi_tt mu + l, coupling ignored."""
    own = np.einsum("twi,tij,twj->tw", problem.mean, problem.blocks, problem.mean)
    return np.asarray(problem.alpha * own + problem.linear)


def solve_separable(problem: SelectionProblem) -> Schedule:
    """Solve a problem without coupling exactly, by one minimum per step: O(H W) once it is known.

    Steps decouple where Psi is block diagonal (``causal``, ``measurement``), where all mean
    errors are zero, and where alpha = 0.  Otherwise this is the greedy policy's mistake.

    Parameters
    ----------
    problem : SelectionProblem
        The problem.

    Returns
    -------
    Schedule
        The optimum.

    Raises
    ------
    ValueError
        If the steps are coupled.
    """
    if not is_separable(problem):
        raise ValueError("problem: expected uncoupled steps, found a mean error that Psi couples")
    choices = stepwise_cost(problem).argmin(axis=1)
    cost = float(problem.total_cost(choices))
    return _certified(problem, choices, problem.chosen_mean(choices), "solve_separable", cost)


# ------------------------------------------------------------------- solvers: the relaxation


class Relaxation(NamedTuple):
    """A point of the convex relaxation (see `relax`)."""

    weights: Array  #: (H, W), each row on the simplex
    reference: Array  #: (pH,), the mean error d_t = sum_w b[t,w] mu[t,w]
    value: float  #: objective at `weights`
    bound: float  #: LB(reference), a lower bound on every schedule
    iterations: int  #: iterations of the method

    @property
    def gap(self) -> float:
        """(value - bound) / max(|value|, |bound|), or 0 where the two are equal."""
        if self.value <= self.bound:
            return 0.0
        return (self.value - self.bound) / max(abs(self.value), abs(self.bound))


def _relaxed(
    problem: SelectionProblem, linear: Array, b: Array, iteration: int
) -> tuple[Relaxation, Array]:
    """Evaluate f(b) = d'(alpha Psi)d + l.b, its bound LB(d), and its gradient G (`_slopes`).

    l and G are infinite where a model may not be used.  f(b) = LB(d) + G.b - sum_t min_w G[t,w].
    """
    d = np.einsum("tw,twi->ti", b, problem.mean).ravel()
    G, constant = _slopes(problem, linear, d)
    bound = G.min(axis=1).sum() + constant
    surplus = np.where(b > 0, G - G.min(axis=1, keepdims=True), 0)
    return Relaxation(b, d, float(bound + (surplus * b).sum()), float(bound), iteration), G


def _congruence(F: Array, M: Array) -> Array:
    """F'MF for symmetric M (pk, pk) and block-diagonal F, given by its blocks (k, p, p)."""
    k, p, _ = F.shape

    def halfway(X: Array) -> Array:
        return np.asarray(np.matmul(np.swapaxes(F, 1, 2), X.reshape(k, p, -1)).reshape(k * p, -1))

    return halfway(halfway(M).T)


def relax(
    problem: SelectionProblem, *, gap: float = 1e-6, max_iterations: int = 20_000
) -> Relaxation:
    """Relax each choice to weights on the simplex; solve by accelerated projected gradient.

    min over b of d'(alpha Psi)d + sum l.b with d_t = sum_w b[t,w] mu[t,w] (``eq:perEncoding``
    with 0 <= b <= 1): convex, and at any iterate LB(d) bounds every schedule from below.

    Step t moves by its own 1/L_t, made for steps of very different weight: with centred means D_t
    (on the simplex only differences between models matter), L_t = 2 L trace(D_t'M_tt D_t) and L
    the largest eigenvalue of the Hessian so scaled.  See `projected_gradient`.

    Parameters
    ----------
    problem : SelectionProblem
        The problem.
    gap : float
        Stop when value and bound agree to this fraction.
    max_iterations : int
        Stop after this many iterations in any case.

    Returns
    -------
    Relaxation
        The last iterate.

    Raises
    ------
    ValueError
        A `gap` or `max_iterations` out of range.

    Examples
    --------
    Its value is below the optimum, 1.6, and its bound as good as its value.

    >>> mean = [[[1], [0]], [[1], [0]]]
    >>> problem = SelectionProblem([[1.4, 0.8], [0.8, 0.6]], mean, np.zeros((2, 2, 1)), [0, 1])
    >>> relaxation = relax(problem)
    >>> relaxation.bound
    1.5833
    """
    H, _, p = problem.mean.shape
    allowed = np.isfinite(problem.linear)
    D = (problem.mean - problem.mean.mean(axis=1, keepdims=True)) * allowed[..., None]
    F = semidefinite_root(np.einsum("twi,twj->tij", D, D))
    M = _congruence(F, problem.quadratic)
    size = M.diagonal().reshape(H, p).sum(axis=1)
    slope = np.ptp(
        np.where(allowed, problem.linear, problem.linear.min(axis=1, keepdims=True)), axis=1
    )
    tiny = np.finfo(float).tiny
    size = np.where(size > tiny, size, np.where(slope > tiny, slope, 1))  # a step only linear
    scale = np.repeat(size, p) ** -0.5
    largest = max(1, la.eigvalsh(scale[:, None] * M * scale)[-1])
    step = 1 / (2 * largest * size)[:, None]

    def project(b: Array) -> Array:  # more than 1 below the largest entry: no weight
        shunned = np.where(allowed, b, np.inf).min(axis=1, keepdims=True) - 2
        return project_to_simplex(np.where(allowed, b, shunned))

    def evaluate(b: Array) -> tuple[float, float, Array]:
        point, G = _relaxed(problem, problem.linear, b, 0)
        return point.value, point.bound, np.where(allowed, G, 0)

    start = allowed / allowed.sum(axis=1, keepdims=True)
    b, iterations = projected_gradient(
        evaluate, project, start, step, gap, problem.rounding, max_iterations
    )
    return _relaxed(problem, problem.linear, b, iterations)[0]


def relax_interior_point(
    problem: SelectionProblem,
    *,
    allowed: npt.NDArray[np.bool_] | None = None,
    gap: float = 1e-7,
    ceiling: float = math.inf,
    time_limit: float | None = None,
    max_iterations: int = 60,
) -> Relaxation:
    """Solve the relaxation of `relax` by Newton's method: about ten steps, however stiff Psi.

    A primal-dual interior-point method with Mehrotra's predictor and corrector.  Optimal weights
    b and slacks z = G(b) - y satisfy b z = 0, b, z >= 0, sum_w b = 1.  Start inside and follow
    b z = tau to tau = 0.  Eliminating db and dy from Newton's equations

        z db + b dz = tau - b z,   dz = 2 mu'v - dy,   v = M dd,   dd = sum_w mu db,   sum_w db = 0

    leaves dd = a - 2 S v with S_t = F_t F_t' the scatter of mu[t] under weights b/z, hence one
    positive definite system (I + 2 F'MF) x = F'M a and v = M(a - 2 F x): size pH, not HW.

    Parameters
    ----------
    problem : SelectionProblem
        The problem; M = alpha Psi.
    allowed : ndarray of bool, (H, W), optional
        Models that may be used, at least one a step; those of finite cost by default.
    gap : float
        Stop when value and bound agree to this fraction.
    ceiling : float
        Stop as soon as the bound exceeds this (used by `branch_and_bound`).
    time_limit : float, optional
        Stop after this many seconds: any iterate is a certificate.
    max_iterations : int
        Stop after this many iterations in any case.

    Returns
    -------
    Relaxation
        The iterate of the smallest gap, over schedules of allowed models.

    Raises
    ------
    ValueError
        An option out of range, or a step at which no available model is allowed.
    """
    expired, p = _stopwatch(time_limit), problem.mean.shape[2]
    gap = check_number("gap", gap, minimum=0)
    max_iterations = check_count("max_iterations", max_iterations)
    ceiling = float(check_array("ceiling", ceiling, "", (), finite=False))
    usable = _usable(problem, allowed)
    linear = np.where(usable, problem.linear, np.inf)
    free = np.flatnonzero(usable.sum(axis=1) > 1)
    index = (free[:, None] * p + np.arange(p)).ravel()
    mu, inside = problem.mean[free], usable[free]
    M = problem.quadratic[np.ix_(index, index)]

    weights = usable / usable.sum(axis=1, keepdims=True)
    best, G = point, _ = _relaxed(problem, linear, weights, 0)
    negligible, tau = problem.rounding, math.inf
    lowest = G[free].min(axis=1)  # slacks z = G - y: what G exceeds its least by, plus a margin
    y = lowest - np.where(inside, G[free] - lowest[:, None], 0).sum() / max(len(free), 1)
    for iteration in range(1, max_iterations + 1):
        within = max(gap * max(abs(point.value), abs(point.bound)), negligible)
        done = not free.size or point.value - point.bound <= within or best.bound > ceiling
        if done or expired():
            break
        b, z = weights[free], np.where(inside, G[free] - y[:, None], 1)
        tau, previous = float((b * z)[inside].mean()), tau
        if not (tau < previous and z.min() > 1e-280):
            break  # rounding, or underflow, has the upper hand; the best bound so far stands
        db, dy = _newton_step(M, mu, inside, b, z)
        weights = weights.copy()
        weights[free] = np.maximum(b + db, 0)
        weights[free] /= weights[free].sum(axis=1, keepdims=True)
        point, G = _relaxed(problem, linear, weights, iteration)
        lowest = G[free].min(axis=1)  # rounding must not close z
        y = np.minimum(y + dy, lowest - np.maximum(1e-3 * tau, 1e-15 * np.abs(lowest)))
        best = min(best, point, key=lambda it: it.value - it.bound)
    return best


def _usable(
    problem: SelectionProblem, allowed: npt.NDArray[np.bool_] | None
) -> npt.NDArray[np.bool_]:
    """Return which models are available and allowed, or raise ValueError if a step has none."""
    usable = np.isfinite(problem.linear)
    if allowed is None:
        return usable
    mask = check_array("allowed", allowed, "H W", usable.shape)
    if not ((mask == 0) | (mask == 1)).all():
        raise ValueError("allowed: expected True and False only")
    if not (usable & (mask == 1)).any(axis=1).all():
        raise ValueError("allowed: expected an available model in every row, found none")
    return np.asarray(usable & (mask == 1))


def _given(problem: SelectionProblem, relaxation: Relaxation) -> Relaxation:
    """Evaluate a relaxation that was handed over anew, as another problem's proves nothing."""
    b = check_array("relaxation.weights", relaxation.weights, "H W", problem.mean.shape[:2])
    off = np.abs(b.sum(axis=1) - 1).max()
    if b.min() < 0 or off > 1e-9 or (b > 0)[np.isinf(problem.linear)].any():
        raise ValueError(
            "relaxation.weights: expected rows >= 0 that sum to 1, and 0 where a model is not "
            "available, found others"
        )
    return _relaxed(problem, problem.linear, b, relaxation.iterations)[0]


def _newton_step(
    M: Array, mu: Array, inside: npt.NDArray[np.bool_], b: Array, z: Array
) -> tuple[Array, Array]:
    """Predictor and corrector of `relax_interior_point`, cut so that b and z stay positive."""
    k, _, p = mu.shape
    w = b / z
    total = w.sum(axis=1)
    D = mu - (np.einsum("tw,twi->ti", w, mu) / total[:, None])[:, None]
    F = semidefinite_root(np.einsum("twi,twj->tij", w[..., None] * D, D))
    system = la.cho_factor(np.eye(k * p) + 2 * _congruence(F, M))

    def direction(r: Array) -> tuple[Array, Array, Array]:
        rate = np.where(inside, r / z, 0)
        a = np.einsum("tw,twi->ti", rate - w * (rate.sum(axis=1) / total)[:, None], mu)
        x = la.cho_solve(system, np.einsum("tij,ti->tj", F, (M @ a.ravel()).reshape(k, p)).ravel())
        v = M @ (a - 2 * np.einsum("tij,tj->ti", F, x.reshape(k, p))).ravel()
        pull = 2 * np.einsum("twi,ti->tw", mu, v.reshape(k, p))
        dy = ((w * pull).sum(axis=1) - rate.sum(axis=1)) / total
        dz = pull - dy[:, None]
        return rate - w * dz, dz, dy

    def longest(db: Array, dz: Array) -> float:
        shrink = np.maximum(
            np.where(inside, -db, 0) / np.where(b > 0, b, 1), np.where(inside, -dz, 0) / z
        )
        return min(1.0, 0.995 / max(float(shrink.max()), 1e-300))

    tau = (b * z)[inside].mean()
    db, dz, _ = direction(-b * z)
    step = longest(db, dz)
    left = ((b + step * db) * (z + step * dz))[inside].mean()
    db, dz, dy = direction((left / tau) ** 3 * tau - b * z - db * dz)
    step = longest(db, dz)
    return step * db, step * dy


# -------------------------------------------------------------------- solvers: local search


def round_and_swap(problem: SelectionProblem, relaxation: Relaxation | None = None) -> Schedule:
    """Round the relaxation to a schedule, then swap single models for as long as that helps.

    Swapping w_t for w moves step t by D = mu[t,w] - mu[t,w_t] and the cost by
    2 D'(alpha Psi mu_c)_t + D'(alpha Psi_tt)D + l[t,w] - l[t,w_t]; the best swap is taken.

    Parameters
    ----------
    problem : SelectionProblem
        The problem.
    relaxation : Relaxation, optional
        Where to start; `relax_interior_point` by default.

    Returns
    -------
    Schedule
        A schedule that no single swap improves, with the relaxation's bound.

    Raises
    ------
    ValueError
        A relaxation whose weights are no point of this problem's.

    Examples
    --------
    >>> mean = [[[1], [0]], [[1], [0]]]
    >>> problem = SelectionProblem([[1.4, 0.8], [0.8, 0.6]], mean, np.zeros((2, 2, 1)), [0, 1])
    >>> schedule = round_and_swap(problem)
    >>> schedule.choices, schedule.cost, schedule.is_optimal
    (array([1, 0]), 1.6, False)
    """
    start = relax_interior_point(problem) if relaxation is None else _given(problem, relaxation)
    choices, swaps = _swap(problem, start.weights.argmax(axis=1))
    return _certified(problem, choices, start.reference, "round_and_swap", swaps=swaps)


def _swap(problem: SelectionProblem, choices: Choices) -> tuple[Choices, int]:
    """Take the best single swap until none lowers the cost; return the choices and a count."""
    H, _, p = problem.mean.shape
    M, blocks, steps = problem.quadratic, problem.alpha * problem.blocks, np.arange(H)
    c, cost, swaps = choices, problem.total_cost(choices), 0
    pull = (M @ problem.chosen_mean(c)).reshape(H, p)
    while True:
        D = problem.mean - problem.mean[steps, c][:, None]
        change = 2 * np.einsum("twi,ti->tw", D, pull) + np.einsum("twi,tij,twj->tw", D, blocks, D)
        change += problem.linear - problem.linear[steps, c][:, None]
        t, w = np.unravel_index(change.argmin(), change.shape)
        better = c.copy()
        better[t] = w
        lower = problem.total_cost(better)
        if not lower < cost:
            return c, swaps
        pull += (M[:, t * p : (t + 1) * p] @ D[t, w]).reshape(H, p)
        c, cost, swaps = better, lower, swaps + 1


# ----------------------------------------------------- solvers: dynamic programming on labels


class _Triangle(NamedTuple):
    """The certificate of a reference point, with its quadratic written as a sum over steps.

    total(c) = bound + sum_t reduced[t, w_t] + sum_t |U_tt e_t + (later steps' share)|^2, where
    e = mu_c - d and U is upper triangular: read from the last step to the first, every term is
    known as soon as w_t is.
    """

    bound: float
    reduced: Array  #: (H, W), non-negative
    deviation: Array  #: (H, W, p), mu[t, w] - d_t
    U: Array  #: (pH, pH), upper triangular


def _triangle(problem: SelectionProblem, reference: Array, budget: float = 0.0) -> _Triangle:
    """Factor alpha Psi + shift = U'U and take the shift out of the reduced costs again.

    A diagonal shift s adds sum_r s_r e_r^2, which depends on one step's model only, so it can
    be subtracted there: the identity stays exact, and a singular Psi has a Cholesky factor.  The
    bound loses a little: at most a hundredth of the budget, plus what rounding needs.
    """
    H, _, p = problem.mean.shape
    bound, reduced = reference_bound(problem, reference)
    deviation = problem.mean - reference.reshape(H, 1, p)
    diagonal = problem.quadratic.diagonal()
    most = (deviation**2).max(axis=1).ravel() @ diagonal
    # 1e-6 is already enough: it leaves errors of 1e-13 of a row's size in the factor.
    share = min(1e-6, max(0.0, budget) / 100 / max(most, np.finfo(float).tiny))
    shift = (share + MATRIX_TOLERANCE * len(diagonal)) * diagonal + np.finfo(float).tiny
    reduced = reduced - np.einsum("twi,ti->tw", deviation**2, shift.reshape(H, p))
    lowest = reduced.min(axis=1)
    U = la.cholesky(problem.quadratic + np.diag(shift))
    return _Triangle(bound + lowest.sum(), reduced - lowest[:, None], deviation, U)


def plain_dynamic_program(problem: SelectionProblem, *, max_labels: int = 2**18) -> Schedule:
    """Extend every partial schedule from the last step to the first: the form to read first.

    A label is (cost so far above the bound, offset y it hands to earlier steps, choices).
    Nothing is discarded, so there are W^H labels at the end; `dynamic_program` gives the same
    optimum with a handful.

    Parameters
    ----------
    problem : SelectionProblem
        A tiny problem.
    max_labels : int
        Refuse a problem with more labels than this.

    Returns
    -------
    Schedule
        The optimum.

    Raises
    ------
    ValueError
        If W^H exceeds `max_labels`.
    """
    H, W, p = problem.mean.shape
    max_labels = check_count("max_labels", max_labels)
    if W**H > max_labels:
        raise ValueError(f"problem: expected at most {max_labels} labels, found {W}^{H}")
    reference = relax_interior_point(problem).reference
    _, reduced, e, U = _triangle(problem, reference)
    labels: list[tuple[Any, Array, tuple[int, ...]]] = [(0.0, np.zeros(H * p), ())]
    for t in reversed(range(H)):
        rows = slice(t * p, (t + 1) * p)
        grown = (
            (extra + reduced[t, w], y + U[:, rows] @ e[t, w], (w, *later))
            for extra, y, later in labels
            for w in range(W)
        )
        labels = [(extra + (y[rows] ** 2).sum(), y, choices) for extra, y, choices in grown]
    _, _, choices = min(labels, key=lambda label: label[0])
    cost = float(problem.total_cost(choices))
    return _certified(
        problem, choices, reference, "plain_dynamic_program", cost, labels=len(labels)
    )


def _compress(
    triangle: _Triangle, budget: float, least: float, expired: Callable[[], bool]
) -> list[tuple[Array, Array, Array]]:
    """Coordinates for offsets: (read, carry, push) of each step.

    The offset on the rows before step t lies in the range of U[:tp, tp:], whose rank is small
    (n or 2n).  With an orthonormal basis V_t of it, coordinates y_t = V_t'offset keep all
    distances, and choosing e at step t gives y_t = carry y_{t+1} + push e; read y_{t+1} is the
    offset on the rows of step t itself.  A direction of strength (singular value) at
    most `least` is dropped: it carries no offset above sqrt(pH) least.  Empty if time is over.
    """
    _, reduced, deviation, U = triangle
    H, _, p = deviation.shape
    usable = (reduced <= budget)[..., None]
    size = np.abs(np.where(usable, deviation, 0)).max(axis=1).ravel()
    steps: list[tuple[Array, Array, Array]] = [None] * H  # type: ignore[list-item]
    basis = scaled = np.zeros((H * p, 0))
    for t in reversed(range(H)):
        if expired():
            return []
        rows, before = slice(t * p, (t + 1) * p), slice(0, t * p)
        column = U[before, rows]
        reach = np.hstack([scaled[before], column * size[rows]])
        V, strength, _ = np.linalg.svd(reach, full_matrices=False)  # SciPy's refuses no rows
        V = V[:, strength > least]
        steps[t] = (basis[rows].copy(), V.T @ basis[before], V.T @ column)
        basis, scaled = V, V * strength[: V.shape[1]]
    return steps


# Cells of `_undominated`: the root of the budget, halved so often; the last merges equal offsets.
GRIDS = (0, 1, 2, 3, 4, 5, 6, 7, 24)


def _undominated(
    extra: Array, y: Array, budget: float, merge: float, expired: Callable[[], bool]
) -> npt.NDArray[np.bool_]:
    """Mark the labels, sorted by extra cost, that no cheaper label nearby makes superfluous.

    Let i, j be labels at distance rho = |y_i - y_j|.  A completion costs them |v + y_i|^2 and
    |v + y_j|^2 plus the same reduced costs, and a completion of j within the budget has
    |v + y_j|^2 <= budget - extra_j.  Since |v + y_i| <= |v + y_j| + rho, i is never worse if

        extra_i + 2 rho sqrt(budget - extra_j) + rho^2 <= extra_j    (or exceeds it by `merge`).

    Any label may be tested against any cheaper one; we test against the cheapest label of the
    same grid cell, for cells of several sizes.  A cell's corner is hashed by multiplying with
    powers of an odd number (2^64 over the golden ratio); its top bits index a table.  Cells that
    share an entry do no harm, as the test itself is exact.
    """
    alive = np.arange(len(extra))
    hashing = np.cumprod(np.full(y.shape[1], 0x9E3779B97F4A7C15, dtype=np.uint64))
    for halvings in GRIDS:
        if len(alive) < 2 or expired():
            break
        width = math.sqrt(budget) / 2**halvings
        corner = np.floor(y[alive] / width + 0.618 * halvings)  # shifted: cells share no borders
        cell = corner.astype(np.int64).astype(np.uint64) @ hashing
        bits = len(alive).bit_length() + 2
        key = cell >> np.uint64(64 - bits)
        table = np.empty(2**bits, dtype=np.intp)
        table[key[::-1]] = np.arange(len(alive))[::-1]  # of equal keys, the first is written last
        i, j = alive[table[key]], alive
        rho2 = ((y[i] - y[j]) ** 2).sum(axis=1)
        reach = 2 * np.sqrt(rho2) * np.sqrt(np.maximum(budget - extra[j], 0))
        alive = alive[(i == j) | (extra[i] + reach + rho2 > extra[j] + merge)]
    kept = np.zeros(len(extra), dtype=bool)
    kept[alive] = True
    return kept


def dynamic_program(
    problem: SelectionProblem,
    *,
    time_limit: float | None = None,
    max_labels: int = WIDTHS[2],
    gap: float = OPTIMALITY_GAP,
    relaxation: Relaxation | None = None,
) -> Schedule:
    """Prove an optimum by dynamic programming from the last step to the first.

    Sphere decoding (Fincke and Pohst 1985) on a Viterbi trellis: every label is a partial
    schedule; one whose cost so far exceeds the budget cost - LB(d) is dropped, and so is one
    that a cheaper label at nearly the same offset dominates (`_undominated`).  What remains is
    a handful of labels, though the worst case is exponential: the problem is NP-hard.

    Passes keep at most 64, then 1024, then 16384 labels a step.  A pass that had to drop
    labels proves the least extra cost it dropped; one that did not is a proof of optimality (up
    to `ROUNDING` and to rounding errors); and a better schedule found by one pass shrinks
    the budget of the next.

    Parameters
    ----------
    problem : SelectionProblem
        The problem.
    time_limit : float, optional
        Seconds after which the best schedule and bound so far are returned.
    max_labels : int
        Most labels kept a step, at least 64: bounds memory and time.
    gap : float
        Stop when cost and bound agree to this fraction.
    relaxation : Relaxation, optional
        Where d and the first schedule come from; `relax_interior_point` by default.

    Returns
    -------
    Schedule
        `work` holds the labels kept at every step of the last pass, the passes and the seconds.

    Raises
    ------
    ValueError
        A limit out of range, or a relaxation whose weights are no point of this problem's.

    Examples
    --------
    >>> mean = [[[1], [0]], [[1], [0]]]
    >>> problem = SelectionProblem([[1.4, 0.8], [0.8, 0.6]], mean, np.zeros((2, 2, 1)), [0, 1])
    >>> schedule = dynamic_program(problem)
    >>> schedule.choices, schedule.is_optimal
    (array([1, 0]), True)
    """
    expired = _stopwatch(time_limit)
    started, max_labels = perf_counter(), check_count("max_labels", max_labels, minimum=WIDTHS[0])
    gap = check_number("gap", gap, minimum=0)
    if relaxation is None:
        relaxation = relax_interior_point(problem, time_limit=time_limit)
    relaxation = _given(problem, relaxation)
    first = round_and_swap(problem, relaxation)
    best, cost, proved = first.choices, first.cost, first.root_bound
    triangle = _triangle(problem, relaxation.reference, cost - proved)
    steps: list[tuple[Array, Array, Array]] = []
    H, passes = len(problem.mean), 0
    labels = np.zeros(H, dtype=int)
    for width in itertools.takewhile(lambda labels: labels <= max_labels, WIDTHS):
        if cost - proved <= gap * max(abs(cost), abs(proved)) or (passes and expired()):
            break
        slack = ROUNDING * min(abs(cost), abs(proved)) + problem.rounding
        budget = cost - triangle.bound + slack
        # An offset wrong by x changes a tail of cost q by at most 2 x sqrt(q) + x^2.  Truncation
        # makes x = H sqrt(pH) least at worst; on measurement it stays below H least / 3.
        least = slack / (2 * H * math.sqrt(budget))
        steps = steps or _compress(triangle, budget, least, expired)
        if not steps:
            break
        # Merging may lose a slack in all, and what rounding has blurred.
        merge = slack / (len(GRIDS) * H) + 16 * problem.rounding
        found, missed, labels = _decode(triangle, steps, budget, merge, width, expired)
        passes += 1
        if found is not None:
            found, _ = _swap(problem, found)
            if problem.total_cost(found) < cost:
                best, cost = found, float(problem.total_cost(found))
        proved = max(proved, min(cost, triangle.bound + missed) - 2 * slack)  # merged, truncated
        if missed == math.inf:
            break
    work = {"labels": labels, "passes": passes, "seconds": perf_counter() - started}
    return _certified(problem, best, relaxation.reference, "dynamic_program", proved, **work)


def _decode(
    triangle: _Triangle,
    steps: list[tuple[Array, Array, Array]],
    budget: float,
    merge: float,
    width: int,
    expired: Callable[[], bool],
) -> tuple[Choices | None, float, npt.NDArray[np.int_]]:
    """Run one pass of `dynamic_program`: cheapest choices, least extra cost dropped, labels."""
    _, reduced, deviation, U = triangle
    H, _, p = deviation.shape
    extra, y, missed = np.zeros(1), np.zeros((1, 0)), math.inf
    trail: list[tuple[Choices, Choices]] = []
    for t in reversed(range(H)):
        read, carry, push = steps[t]
        models = np.flatnonzero(reduced[t] <= budget)
        own = deviation[t, models] @ U[t * p : (t + 1) * p, t * p : (t + 1) * p].T
        felt = ((y @ read.T)[:, None] + own) ** 2
        grown = extra[:, None] + reduced[t, models] + felt.sum(axis=-1)
        parent, child = np.nonzero(grown <= budget)
        order = np.argsort(grown[parent, child])
        parent, child = parent[order], child[order]
        extra = grown[parent, child]
        y = (y @ carry.T)[parent] + (deviation[t, models] @ push.T)[child]
        kept = np.flatnonzero(_undominated(extra, y, budget, merge, expired))
        most = min(width, 64) if expired() else width  # out of time: finish on a narrow beam
        if len(kept) > most:
            missed = min(missed, float(extra[kept[most]]))
        kept = kept[:most]
        extra, y = extra[kept], y[kept]
        trail.append((parent[kept], models[child[kept]]))
    labels = np.array([len(models) for _, models in reversed(trail)])
    if not len(extra):
        return None, missed, labels
    choices, label = np.empty(H, dtype=np.intp), 0
    for t, (parent, models) in enumerate(reversed(trail)):
        choices[t], label = models[label], parent[label]
    return choices, missed, labels


# --------------------------------------------------------------- solvers: branch and bound


class Node(NamedTuple):
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
    """Split the problem where rounding hurts most, always the part with the lowest bound next.

    Every node relaxes what is still open, rounds the result to a schedule, and forbids for all
    its children the models whose reduced cost exceeds best - bound.  Its children settle the
    step with the largest blur sum_w b[t,w] |mu[t,w] - d_t|^2, weighed by Psi's diagonal.  Nodes
    that cannot beat the best schedule are dropped.  Best first expands only nodes
    whose bound is below the optimum, and its lower bound only rises.

    Parameters
    ----------
    problem : SelectionProblem
        The problem.
    time_limit : float, optional
        Seconds after which the best schedule and bound so far are returned.
    max_nodes : int, optional
        Most nodes bounded.
    gap : float
        Stop when cost and bound agree to this fraction.
    relaxation : Relaxation, optional
        Of the root; `relax_interior_point` by default.

    Returns
    -------
    Schedule
        `work["tree"]` is the list of `Node`, root first; also `nodes` and `seconds`.

    Raises
    ------
    ValueError
        A limit out of range, or a relaxation whose weights are no point of this problem's.

    Examples
    --------
    >>> mean = [[[1], [0]], [[1], [0]]]
    >>> problem = SelectionProblem([[1.4, 0.8], [0.8, 0.6]], mean, np.zeros((2, 2, 1)), [0, 1])
    >>> schedule = branch_and_bound(problem)
    >>> schedule.choices, schedule.is_optimal
    (array([1, 0]), True)
    """
    expired, started = _stopwatch(time_limit), perf_counter()
    most = math.inf if max_nodes is None else check_count("max_nodes", max_nodes)
    gap, root = check_number("gap", gap, minimum=0), relaxation
    if root is None:
        root = relax_interior_point(problem, gap=gap / 10, time_limit=time_limit)
    root = _given(problem, root)
    incumbent = round_and_swap(problem, root)
    best, cost, lower = incumbent.choices, incumbent.cost, root.bound
    tree = [Node(-1, -1, -1, lower, perf_counter() - started, cost)]
    allowed, step = _narrow(problem, np.isfinite(problem.linear), root, cost)
    queue = [(lower, 0, allowed, step)]
    while queue and len(tree) < most and not expired():
        lower, parent, allowed, step = queue[0]
        if cost - lower <= max(gap * max(abs(cost), abs(lower)), problem.rounding):
            break
        node = heapq.heappop(queue)
        for model in np.flatnonzero(allowed[step]):
            if expired() or len(tree) >= most:
                heapq.heappush(queue, node)  # its bound must not be lost
                break
            child = allowed.copy()
            child[step] = np.arange(child.shape[1]) == model
            point = relax_interior_point(problem, allowed=child, gap=gap / 10, ceiling=cost)
            bound = max(lower, point.bound)
            tree.append(Node(parent, int(step), int(model), bound, perf_counter() - started, cost))
            child, undecided = _narrow(problem, child, point, cost)
            rounded = np.where(child, point.weights, -1).argmax(axis=1)
            candidate, _ = _swap(problem, rounded)
            if problem.total_cost(candidate) < cost:
                best, cost = candidate, float(problem.total_cost(candidate))
            if bound < cost and child[undecided].sum() > 1:
                heapq.heappush(queue, (bound, len(tree) - 1, child, undecided))
    lower = queue[0][0] if queue else cost
    work = {"nodes": len(tree), "tree": tree, "seconds": perf_counter() - started}
    return _certified(problem, best, root.reference, "branch_and_bound", lower, **work)


def _narrow(
    problem: SelectionProblem, allowed: npt.NDArray[np.bool_], point: Relaxation, cost: float
) -> tuple[npt.NDArray[np.bool_], int]:
    """Forbid models that cannot belong to a schedule cheaper than `cost`; name the step to split.

    A step without a choice left is never named unless there is no other.
    """
    H, _, p = problem.mean.shape
    again, G = _relaxed(problem, np.where(allowed, problem.linear, np.inf), point.weights, 0)
    narrowed = allowed & (G - G.min(axis=1, keepdims=True) <= cost - again.bound)
    narrowed[np.arange(H), G.argmin(axis=1)] = True
    away = (problem.mean - point.reference.reshape(H, 1, p)) ** 2
    weight = problem.quadratic.diagonal().reshape(H, 1, p)
    blur = (point.weights * (away * weight).sum(axis=-1)).sum(axis=1)
    return narrowed, int(np.where(narrowed.sum(axis=1) > 1, blur, -1.0).argmax())


# ------------------------------------------------------------------------ solvers: all in one


def solve(
    problem: SelectionProblem,
    *,
    time_limit: float | None = None,
    gap: float = OPTIMALITY_GAP,
    max_labels: int = WIDTHS[2],
) -> Schedule:
    """Find and certify a best schedule by the cheapest way that proves it.

    Uncoupled steps: one minimum per step.  Otherwise relax, round and swap; if the gap is still
    open, `dynamic_program`.  Given a time limit, it gets half; the rest goes to
    `branch_and_bound`, and the best schedule and the highest proved bound come back.  Without
    one, `max_labels` may leave a gap.

    Parameters
    ----------
    problem : SelectionProblem
        The problem.
    time_limit : float, optional
        Seconds after which the best schedule and bound so far are returned.
    gap : float
        Stop when cost and bound agree to this fraction.
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
    >>> schedule.choices, schedule.gap
    (array([1, 0]), 0.0)
    """
    gap = check_number("gap", gap, minimum=0)
    max_labels = check_count("max_labels", max_labels, minimum=WIDTHS[0])
    started = perf_counter()
    expired = _stopwatch(time_limit)
    if is_separable(problem):
        return solve_separable(problem)
    relaxation = relax_interior_point(problem, time_limit=time_limit)
    quick = round_and_swap(problem, relaxation)
    if quick.gap <= gap or expired():
        return quick
    if time_limit is None:
        return dynamic_program(problem, max_labels=max_labels, gap=gap, relaxation=relaxation)
    left = time_limit - (perf_counter() - started)
    decoded = dynamic_program(
        problem, time_limit=left / 2, max_labels=max_labels, gap=gap, relaxation=relaxation
    )
    left = time_limit - (perf_counter() - started)
    if decoded.gap <= gap or left <= 0:
        return decoded
    searched = branch_and_bound(problem, time_limit=left, gap=gap, relaxation=relaxation)
    best = min(decoded, searched, key=lambda schedule: schedule.cost)
    bound = max(decoded.lower_bound, searched.lower_bound)
    return replace(best, lower_bound=min(best.cost, bound))


# ---------------------------------------------------------- what biased and noisy models cost


class ErrorCost(NamedTuple):
    """What each model would cost the controller if it ran at every step (see `error_cost`)."""

    mean_square: Array  #: (W,), mean squared error per step: what model cards print
    uncoupled: Array  #: (W,), sum_t trace(Psi_tt E[e_t e_t']): what follows from squared errors
    bias: Array  #: (W,), mu'Psi mu
    noise: Array  #: (W,), sum_t trace(Psi_tt Sigma_t)


def error_cost(problem: SelectionProblem) -> ErrorCost:
    """Split the control cost of each model into bias and noise, beside its mean squared error.

    Noise costs what its square says: ``noise`` is part of ``uncoupled``.  A bias also meets
    itself at other steps, through the blocks Psi_tk: it costs more than its square where the
    products add up and less where they cancel, so two models of equal squared error can differ
    either way.  bias + noise is the control term; uncoupled alone is what greedy selection sees.

    Parameters
    ----------
    problem : SelectionProblem
        Any suite, with its Psi.

    Returns
    -------
    ErrorCost
        Four arrays (W,); unweighted by alpha, perception cost left out.
    """
    H, W, _ = problem.mean.shape
    always = np.repeat(np.arange(W)[:, None], H, axis=1)
    noise = problem.spread.sum(axis=0)
    own = np.einsum("twi,tij,twj->w", problem.mean, problem.blocks, problem.mean)
    variance = problem.variance
    if variance.ndim == 4:
        variance = np.diagonal(variance, axis1=-2, axis2=-1)
    mean_square = (problem.mean**2 + variance).sum(axis=-1).mean(axis=0)
    return ErrorCost(mean_square, own + noise, problem.control_term(always) - noise, noise)


def correlated_cost(
    problem: SelectionProblem,
    choices: npt.ArrayLike,
    covariance: Callable[[int, int, int, int], npt.ArrayLike],
) -> float:
    """Return the exact expected total cost of a schedule whose errors are correlated over time.

    alpha (mu_c'Psi mu_c + sum_{t,k} sum(Psi_tk * Cov[e_t, e_k])) + beta sum_t kappa[t, w_t]: an
    extension of ``eq:expTmp1``, whose assumption of independence keeps the terms t = k only.

    Parameters
    ----------
    problem : SelectionProblem
        The problem; its `variance` is not used.
    choices : array_like of int, (H,)
        Model of every step.
    covariance : callable
        covariance(t, w, k, v) -> (p, p), or a number where p = 1: the covariance of model w's
        error at step t with model v's error at step k.

    Returns
    -------
    float
        The expected total cost.

    Raises
    ------
    ValueError
        A wrong shape, or a covariance over all steps that is not positive semidefinite.
    """
    H, W, p = problem.mean.shape
    c = check_choices(choices, H, W)

    def block(t: int, k: int) -> Array:
        found = as_numbers("covariance", covariance(t, int(c[t]), k, int(c[k])))
        found = found.reshape(1, 1) if p == 1 and found.ndim == 0 else found
        return check_array("covariance", found, "p p", (p, p))

    joint = np.block([[block(t, k) for k in range(H)] for t in range(H)])
    check_semidefinite("covariance", joint)
    mu = problem.chosen_mean(c)
    control = mu @ problem.psi @ mu + (problem.psi * joint).sum()
    return float(problem.alpha * control + problem.beta * problem.perception_term(c))


# --------------------------------------------------------------------- why it is hard (Remark)


def partition_problem(integers: Sequence[int], information: str = "open_loop") -> SelectionProblem:
    """Turn a PARTITION instance into a model selection problem: the paper's open question.

    One integrator x_{t+1} = x_t + u_t + s_t with R = 1, Q = 0, Q_final = 1 has Psi = g 11' with
    g = H/(1+H) (``open_loop``; for ``preview`` only u_0 acts and g = 1/2).  Let model 0 err by
    +a_t and model 1 by -a_t at step t.  A schedule costs g (sum_t +-a_t)^2 plus less than g / 2
    for perception, so the optimum is below g exactly if the integers split into two halves of
    equal sum: model selection is NP-hard (weakly: with offsets so few, `dynamic_program` is
    pseudo-polynomial here).

    Parameters
    ----------
    integers : sequence of int
        Positive integers a_0..a_{H-1}; their sum is at most 1e7, so that costs are exact.
    information : str
        ``open_loop`` or ``preview``; under the other patterns steps decouple.

    Returns
    -------
    SelectionProblem
        H steps, two models.

    Raises
    ------
    ValueError
        An entry that is not a positive integer, too large a sum, or another pattern.
    """
    check_array("integers", integers, "H", (None,))
    a = [check_count("integers", value) for value in as_numbers("integers", integers)]
    H = len(a)
    if sum(a) > 1e7:
        raise ValueError(f"integers: expected a sum of at most 1e7, found {sum(a)}")
    check_information(information)
    if information not in ("open_loop", "preview"):
        raise ValueError(f"information: expected open_loop or preview, found {information!r}")
    one, B = np.ones((1, 1)), np.ones((H, 1, 1))
    B[1:] = 0 if information == "preview" else 1
    task = ControlTask(one, B, one, 0 * one, one, H, Q_final=one)
    mean = np.stack([a, np.negative(a)], axis=1)[:, :, None]
    return SelectionProblem(psi(task, information), mean, 0 * mean, np.array([0, 1 / (8 * H)]))
