r"""Which perception model should a robot run at each step?  The mathematics, in the paper's order.

A robot follows x_{t+1} = A x_t + B u_t + C s_t for t = 0..H-1.  It never sees the perception
input s_t; at every step it runs one of W perception models and acts on the estimate
s_hat_t = s_t + error.  A small model is cheap and wrong, a large one is dear and right.
A schedule c = (w_0, ..., w_{H-1}) names the model of every step.  Wrong estimates cost the
controller e' Psi e more than true ones, so the best schedule in expectation minimises

    alpha * (mu_c' Psi mu_c + sum_t trace(Psi_tt Sigma_{t,w_t}))  +  beta * sum_t kappa_{w_t},

quadratic in the mean errors, linear in the variances: an integer quadratic programme.  Beyond the
paper, switching models may cost something, and what is spent may be limited.  Section
II, the task and Psi, is modelselect_parts/regulator.py; here are the problem, its certificate and
its solvers, the plain form of each first.  A solver is a function from a problem to a `Schedule`.

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
row as non-negative, up to MATRIX_TOLERANCE = 1e-12: a thousand times what rounding leaves in a
product of double-precision matrices; what is let pass is taken out.  A sum of k terms errs by at
most k half units in the last place of the sum of their sizes (`SelectionProblem.cost_rounding`, the
certificate): bounds are lowered by that much, and a cost of which it is more than EXACT_BELOW =
1e-10 is summed in fractions where that takes no time, at up to EXACT_SIZE = 100 errors pH.  The
label search may give away SEARCH_SLACK = 1e-10 of the cost, or the cost's rounding where that is
more, or MERGING = 30 roundings where they alone are too many for a proof; its bound is lowered by
all that it gives away.  So a gap of OPTIMALITY_GAP = 1e-9 counts as proved.

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
from collections.abc import Callable, Mapping, Sequence
from dataclasses import KW_ONLY, dataclass, field, replace
from fractions import Fraction
from functools import cached_property
from time import perf_counter
from typing import Any

import numpy as np
import numpy.typing as npt

from modelselect_parts import label_search, local_search, trellis
from modelselect_parts import triangle as triangles
from modelselect_parts.blends import Blend, BlendProblem, sdp_blocks, solve_blend
from modelselect_parts.checks import (
    Array,
    Choices,
    Frozen,
    Mask,
    as_numbers,
    check_array,
    check_choices,
    check_count,
    check_name,
    check_number,
    check_range,
    check_semidefinite,
    frozen,
    shown,
)
from modelselect_parts.column_generation import Columns, columns
from modelselect_parts.descent import (
    Relaxation,
    closes,
    project_to_simplex,
    projected_gradient,
    relative_gap,
    step_lengths,
)
from modelselect_parts.interior_point import congruence, interior_point
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
from modelselect_parts.semidefinite import semidefinite_root

__version__ = "0.2.0"

OPTIMALITY_GAP = 1e-9
SEARCH_SLACK = 1e-10
EXACT_BELOW = 1e-10
EXACT_SIZE = 100
MERGING = 30
PERTURBATIONS = 50
#: Labels that the passes of `dynamic_program` keep a step.
WIDTHS = [64 * 8**k for k in range(8)]


def __getattr__(name: str) -> tuple[str, ...]:
    if name == "INFORMATION":  # the rows of the table, read when asked
        return tuple(PATTERNS)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


# -------------------------------------------------------------------- the selection problem


def one_hot(choices: npt.ArrayLike, models: int) -> Array:
    """Encode `choices` (H,) of W `models` as b (H, W): 1 where w = w_t (``eq:perEncoding``)."""
    W = check_count("models", models)
    c = check_choices(check_array("choices", choices, "H", (None,)), None, W)
    return np.where(c[:, None] == np.arange(W), 1.0, 0.0)


def from_one_hot(weights: npt.ArrayLike) -> Choices:
    """Decode `weights` b (H, W), a single 1 in every row, into c (H,): the inverse of `one_hot`."""
    b = check_array("weights", weights, "H W", (None, None))
    if not ((b == 0) | (b == 1)).all() or (b.sum(axis=1) != 1).any():
        raise ValueError("weights: expected a single 1 and otherwise 0 in every row")
    return np.asarray(b.argmax(axis=1))


@dataclass(frozen=True, eq=False)
class SelectionProblem(Frozen):
    """Which model to run at each step (``prob:model_selection_expectation``).

    E[total](c) = alpha (mu_c'Psi mu_c + sum_t trace(Psi_tt Sigma[t,w_t]) + sum_t g_t'mu[t,w_t])
                + beta (sum_t kappa[t, w_t] + sum_t sigma[w_{t-1}, w_t]),
    the second sum the `perception_term`, without the constant alpha J(u*).  Errors must be
    independent across steps; zero variance states known errors (``prob:model_selection``).  Where
    p = 1, `mean` and `variance` both given transposed, (1, W, H), pose one step of H components:
    this cannot be caught.
    ``dataclasses.replace`` of a weight shares the arrays, and checks them no second time.

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
    switch_cost : array_like, (W, W), optional
        sigma[v, w] >= 0, perception cost of going from model v (row) to model w: loading, warm-up.
        The diagonal is 0.
    initial_model : int, optional
        The model in memory before step 0; without one the first model is free to load.
    budget : float, optional
        The most that `perception_term`, unweighted and with all switches, may be.
    pull : array_like, (H, p), optional
        g: a known term sum_t g_t'mu[t, w_t] of the control cost, e.g. of a plan that goes on.

    Raises
    ------
    ValueError
        A wrong shape, a NaN, a negative variance or weight, an indefinite `psi`, a step at
        which no model is available, or a budget that no schedule keeps: says what would do.

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
    _: KW_ONLY
    switch_cost: Array | None = None
    initial_model: int | None = None
    budget: float | None = None
    pull: Array | None = None

    def __post_init__(self) -> None:
        names = ("psi", "mean", "variance", "model_cost")
        raw = {name: as_numbers(name, getattr(self, name)) for name in names}
        Psi = check_array("psi", self.psi, "pH pH", 2 * (raw["psi"].shape[-1:] or (None,)))
        shape = raw["mean"].shape
        p = shape[-1] if len(shape) == 3 and shape[-1] and len(Psi) % shape[-1] == 0 else 1
        mean = check_array("mean", self.mean, "H W p", (len(Psi) // p, None, p))
        H, W, _ = mean.shape
        axes = "H W p p" if raw["variance"].ndim == 4 else "H W p"
        variance = check_array("variance", self.variance, axes, (H, W, p, p)[: len(axes.split())])
        axes = "H W" if raw["model_cost"].ndim == 2 else "W"
        sizes = (H, W)[-len(axes.split()) :]
        cost = check_array("model_cost", self.model_cost, axes, sizes, finite=False)
        if np.isneginf(cost).any() or np.isinf(cost).all(axis=-1).any():
            raise ValueError("model_cost: expected a finite cost at every step, found none or -inf")
        Psi = check_semidefinite("psi", Psi)
        if variance.ndim == 4:
            variance = check_semidefinite("variance", variance)
        else:
            check_range("variance", variance)
        weights = {
            name: check_number(name, getattr(self, name), minimum=0) for name in ("alpha", "beta")
        }
        self._set(psi=Psi, mean=mean, variance=variance, model_cost=cost, **weights)
        self._check_beyond_the_paper(H, W, p)
        with np.errstate(over="ignore", invalid="ignore"):
            # By Cauchy and Schwarz, a bound on every |mu|'|alpha Psi||mu|, without Psi's square.
            felt = np.sqrt(self.alpha * np.abs(Psi.diagonal())) @ np.abs(mean).max(axis=1).ravel()
            largest = felt**2 + self.linear_size.sum() + self._most_spent * max(self.beta, 1)
        if not largest < 1e300:
            raise ValueError(
                "psi: the costs overflow; rescale psi, mean, variance, the prices, alpha or beta"
            )

    def _check_beyond_the_paper(self, H: int, W: int, p: int) -> None:
        """Check what moves cost, the model in memory, the pull and that the budget can be kept."""
        if self.switch_cost is not None:
            switch = check_array("switch_cost", self.switch_cost, "W W", (W, W))
            check_range("switch_cost", switch)
            if switch.diagonal().any():
                raise ValueError("switch_cost: expected 0 on the diagonal, found others")
            self._set(switch_cost=switch)
        if self.initial_model is not None:
            first = check_count("initial_model", self.initial_model, minimum=0)
            if first >= W:
                raise ValueError(f"initial_model: expected one of {W} models, found {first}")
            self._set(initial_model=first)
        if self.pull is not None:
            self._set(pull=check_array("pull", self.pull, "H p", (H, p)))
        if self.budget is not None:
            self._set(budget=check_number("budget", self.budget))
            cheapest = trellis.cheapest_path(self._price, self.switch_cost)
            least = float(self.perception_term(cheapest))
            if least > self._limit:
                found = f"of at least {least!r}, which one schedule needs, found {self.budget!r}"
                raise ValueError(f"budget: expected one {found}")

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
        return frozen(self._traces(self.blocks, self.variance))

    @cached_property
    def linear(self) -> Array:
        """What single models cost, (H, W): variances, pull, prices, and going to the first model.

        l[t,w] = alpha (trace(Psi_tt Sigma[t,w]) + g_t'mu[t,w]) + beta kappa[t,w], and at step 0
        beta sigma[initial, w] more.
        """
        control = self.alpha * self.spread
        if self.pull is not None:
            control = control + self.alpha * self._pulled(self.pull, self.mean)
        return frozen(control + self._priced(self._price, np.inf))

    @cached_property
    def linear_size(self) -> Array:
        """The sizes of the terms that `linear` is summed from, (H, W); 0 where not available."""
        size = self.alpha * self._traces(np.abs(self.blocks), np.abs(self.variance))
        if self.pull is not None:
            size = size + self.alpha * self._pulled(np.abs(self.pull), np.abs(self.mean))
        return frozen(size + self._priced(np.abs(self._price), 0))

    @cached_property
    def _price(self) -> Array:
        """What a model alone adds to `perception_term`, (H, W); inf where not available."""
        H, W, _ = self.mean.shape
        price = np.array(np.broadcast_to(self.model_cost, (H, W)))
        if self.switch_cost is not None and self.initial_model is not None:
            price[0] += self.switch_cost[self.initial_model]
        return frozen(price)

    @cached_property
    def _most_spent(self) -> float:
        """No schedule's `perception_term` is larger."""
        price = np.abs(np.where(np.isinf(self._price), 0, self._price))
        tolls = 0.0 if self.switch_cost is None else len(price) * self.switch_cost.max()
        return float(price.max(axis=1).sum() + tolls)

    @cached_property
    def _limit(self) -> float:
        """The most that a feasible schedule may spend."""
        return math.inf if self.budget is None else self.budget + self._limit_slack

    @property
    def _limit_slack(self) -> float:
        """1e-12 of the most that could be spent: sums in another order differ by less."""
        return 1e-12 * self._most_spent

    @cached_property
    def form(self) -> trellis.Form:
        """The bare arrays that the engines work on."""
        form = trellis.Form(self.quadratic, self.mean, self.linear, self.linear_size)
        switch, limited = self.switch_cost, self.budget is not None
        if switch is not None and switch.any() and (self.beta > 0 or limited):
            form = form._replace(arc=frozen(self.beta * switch), toll=switch if limited else None)
        if limited:
            price = frozen(np.where(np.isinf(self._price), 0, self._price))
            form = form._replace(price=price, limit=self._limit)
        return form

    @staticmethod
    def _pulled(pull: Array, mean: Array) -> Array:
        return np.asarray(np.einsum("ti,twi->tw", pull, mean))

    def _traces(self, blocks: Array, variance: Array) -> Array:
        over = "tij,twji->tw" if variance.ndim == 4 else "tii,twi->tw"
        return np.asarray(np.einsum(over, blocks, variance))

    def _priced(self, cost: Array, missing: float) -> Array:
        unavailable = np.isinf(cost)  # also where beta = 0
        return np.where(unavailable, missing, self.beta * np.where(unavailable, 0, cost))

    @cached_property
    def rounding(self) -> float:
        """How far rounding can move a cost near the optimum: that of the stepwise cheapest models.

        Models nobody would use do not count, however wrong or dear they are.
        """
        return float(self.cost_rounding(stepwise_cost(self).argmin(axis=1)))

    def chosen_mean(self, choices: npt.ArrayLike) -> Array:
        """Stack the mean errors mu_c of `choices` (..., H) into vectors (..., pH)."""
        c = self._check(choices)
        return self.mean[np.arange(c.shape[-1]), c].reshape(*c.shape[:-1], -1)

    def control_term(self, choices: npt.ArrayLike) -> Any:
        """Return mu_c' Psi mu_c + sum_t trace(Psi_tt Sigma[t, w_t]) + sum_t g_t'mu[t, w_t].

        Of `choices` (..., H), unweighted.
        """
        table = self.spread
        if self.pull is not None:
            table = table + self._pulled(self.pull, self.mean)
        return self._total(self.psi, self.chosen_mean(choices), table, None, choices)

    def perception_term(self, choices: npt.ArrayLike) -> Any:
        """Return sum_t kappa[t,w_t] + sum_t sigma[w_{t-1},w_t] (``eq:jp``), `choices` (..., H)."""
        return trellis.path_sum(self._price, self.switch_cost, self._check(choices))

    def total_cost(self, choices: npt.ArrayLike) -> Any:
        """Return alpha control_term + beta perception_term of `choices` (..., H)."""
        mu = self.chosen_mean(choices)
        return self._total(self.quadratic, mu, self.linear, self.form.arc, choices)

    def is_feasible(self, choices: npt.ArrayLike) -> Any:
        """Whether `choices` (..., H) are available and keep the budget, up to rounding."""
        return self.perception_term(choices) <= min(self._limit, 1e308)

    def cost_rounding(self, choices: npt.ArrayLike) -> Any:
        """How far `total_cost` of `choices` (..., H) can be off: its terms' sizes, times k eps."""
        mu, M = np.abs(self.chosen_mean(choices)), np.abs(self.quadratic)
        unit = trellis.rounding_unit(M, self.mean)
        return unit * self._total(M, mu, self.linear_size, self.form.arc, choices)

    def exact_cost(self, choices: npt.ArrayLike) -> Fraction:
        """Total cost of `choices` (H,), all available, in rational arithmetic on these floats."""
        c, steps = self._check(choices), np.arange(len(self.mean))
        chosen, mu = self.variance[steps, c], self.chosen_mean(choices)
        Sigma = chosen if chosen.ndim == 3 else chosen[..., None] * np.eye(chosen.shape[-1])
        control = trellis.exact_form(self.psi, mu)
        control += trellis.exact_product(self.blocks, Sigma.swapaxes(-1, -2))
        if self.pull is not None:
            control += trellis.exact_product(self.pull.ravel(), mu)
        paid = np.broadcast_to(self.model_cost, self.mean.shape[:2])[steps, c]
        if self.switch_cost is not None:
            paid = np.append(paid, self.switch_cost[c[:-1], c[1:]])
            if self.initial_model is not None:
                paid = np.append(paid, self.switch_cost[self.initial_model, c[0]])
        return Fraction(self.alpha) * control + Fraction(self.beta) * sum(map(Fraction, paid))

    def _total(
        self, M: Array, mu: Array, table: Array, arc: Array | None, choices: npt.ArrayLike
    ) -> Any:
        return ((mu @ M) * mu).sum(axis=-1) + trellis.path_sum(table, arc, self._check(choices))

    def _check(self, choices: npt.ArrayLike) -> Choices:
        return check_choices(choices, *self.mean.shape[:2])


def stepwise_cost(problem: SelectionProblem) -> Array:
    """Cost (H, W) of each model at each step alone: alpha mu'Psi_tt mu + l, coupling ignored."""
    own = np.einsum("twi,tij,twj->tw", problem.mean, problem.blocks, problem.mean)
    return np.asarray(problem.alpha * own + problem.linear)


def is_separable(problem: SelectionProblem) -> bool:
    """Whether steps meet neither through Psi nor through switching costs or a budget."""
    H, _, p = problem.mean.shape
    felt = (problem.mean != 0).any(axis=1).ravel() & (problem.alpha != 0)
    meets = ((problem.psi != 0) & felt[:, None] & felt).reshape(H, p, H, p).any(axis=(1, 3))
    return problem.form.bare and not (meets & ~np.eye(H, dtype=bool)).any()


# --------------------------------------------------------------- schedules and certificates


@dataclass(frozen=True, eq=False)
class Schedule(Frozen):
    """A schedule with its proof: every solver returns one."""

    choices: Choices  #: (H,), model of every step
    cost: float  #: `SelectionProblem.total_cost` of the choices
    lower_bound: float  #: no schedule costs less; above root_bound by a search, or the prices
    root_bound: float  #: LB(reference, multiplier), which `check_certificate` derives anew
    reference: Array  #: (pH,), the point d: any d gives a bound, a good d a tight one
    solver: str  #: name of the function that found the schedule
    work: Mapping[str, Any] = field(default_factory=dict, repr=False)  #: counts, seconds, the tree
    multiplier: float = 0.0  #: lam >= 0: total cost that one more unit of budget saves the bound

    def __post_init__(self) -> None:
        self._set(choices=frozen(np.asarray(self.choices, dtype=np.intp)))
        self._set(reference=frozen(np.asarray(self.reference, dtype=np.float64)))

    @property
    def gap(self) -> float:
        """(cost - lower_bound) / max(|cost|, |lower_bound|), or 0 where the two are equal."""
        return relative_gap(self.cost, self.lower_bound)

    @property
    def proof(self) -> str:
        """What carries `lower_bound`: "root", the certificate, or "search", a search's word."""
        return "root" if self.lower_bound <= self.root_bound else "search"

    @property
    def is_optimal(self) -> bool:
        """Whether the gap is at most `OPTIMALITY_GAP`, so that nothing is better by more."""
        return self.gap <= OPTIMALITY_GAP


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
    off: total(c) is not less, in exact numbers.
    """
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

    A `lower_bound` above it was proved by a search, a minimum per step, or the prices, and is not
    re-derived here.
    ValueError if the schedule is not feasible, does not state this bound and its own cost (up to
    rounding), or a lower bound outside of them.  `Schedule.proof` says whether this is all of it.
    """
    bound, _ = reference_bound(problem, schedule.reference, schedule.multiplier)
    if not problem.is_feasible(schedule.choices):
        raise ValueError("schedule.choices: expected available models within the budget")
    cost, rounding = _cost(problem, schedule.choices)
    d = np.abs(schedule.reference)
    unit = trellis.rounding_unit(problem.quadratic, problem.mean)
    rounding += float(problem.cost_rounding(schedule.choices))  # Psi is semidefinite up to that
    paid = abs(schedule.multiplier * problem._limit) if schedule.multiplier else 0.0
    rounding += 4 * unit * float(d @ np.abs(problem.quadratic) @ d + abs(bound) + abs(cost) + paid)
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


def _cost(problem: SelectionProblem, choices: Choices) -> tuple[float, float]:
    """Cost of a schedule (H,), in fractions where digits cancel, and how far it may be off."""
    cost, rounding = float(problem.total_cost(choices)), float(problem.cost_rounding(choices))
    small = len(problem.psi) <= EXACT_SIZE
    if not (small and EXACT_BELOW * abs(cost) < rounding and math.isfinite(cost)):
        return cost, rounding
    cost = float(problem.exact_cost(choices))
    return cost, abs(cost) * trellis.EPS


def _certified(
    problem: SelectionProblem,
    choices: Choices,
    point: Relaxation,
    solver: str,
    proved: float = -math.inf,
    **work: Any,
) -> Schedule:
    """Make a Schedule, with the better bound of the certificate and what a search has `proved`.

    As Psi is semidefinite, LB(0, 0) is a bound as well; without a pull so are the cheapest prices,
    as no trace(Psi_tt Sigma) is negative.
    """
    cost, rounding = _cost(problem, choices)
    points = ((point.reference, point.multiplier), (np.zeros(len(point.reference)), 0.0))
    root, d, multiplier = max(
        ((_certificate(problem, *pair).bound, *pair) for pair in points),
        key=lambda triple: triple[0],
    )
    cheapest = problem._priced(problem._price, np.inf).min(axis=1)
    floor = float(cheapest.sum() - len(cheapest) * trellis.EPS * np.abs(cheapest).sum())
    lower = max(root, floor if problem.pull is None else root, min(proved, cost - rounding))
    return Schedule(choices, cost, min(cost, lower), root, d, solver, work, multiplier)


def _at(problem: SelectionProblem, choices: Choices) -> Relaxation:
    """Return the point of the relaxation that a schedule is itself."""
    cost = float(problem.total_cost(choices))
    b = one_hot(choices, problem.mean.shape[1])
    return Relaxation(b, problem.chosen_mean(choices), cost, -math.inf, 0)


def _stopwatch(time_limit: float | None) -> Callable[[], float]:
    """Return a function that tells how many seconds of a limit are left."""
    limit = math.inf if time_limit is None else check_number("time_limit", time_limit, minimum=0)
    end = perf_counter() + limit
    return lambda: end - perf_counter()


# ----------------------------------------------------------------------- solvers: enumeration


def enumerate_schedules(problem: SelectionProblem, *, max_schedules: int = 2**22) -> Schedule:
    """Try every schedule: the definition of ``sol:model_selection_expectation``, as code.

    Refuses more than `max_schedules`; of several optima it returns the first in lexicographic
    order, with its own mean error as reference.
    """
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
    proved, point = min(bound for _, bound in found), _at(problem, best)
    return _certified(problem, best, point, "enumerate_schedules", proved, schedules=W**H)


def _cheapest(problem: SelectionProblem, schedules: Choices) -> tuple[Choices, float]:
    """Return the first cheapest of `schedules` (N, H), and what none of them costs less than.

    Where rounding hides which is the cheapest, up to 1000 of them are compared in fractions.
    """
    costs, rounding = problem.total_cost(schedules), problem.cost_rounding(schedules)
    costs = np.where(problem.is_feasible(schedules), costs, np.inf)
    upper = (costs + rounding).min()
    close = np.flatnonzero(costs - rounding <= upper)
    if (
        not math.isfinite(upper)
        or rounding[close].max() <= EXACT_BELOW * abs(upper)
        or len(close) > 1000
    ):
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
    unit = trellis.rounding_unit(problem.quadratic, mean)
    proved = float((alone - unit * size).min(axis=1).sum())
    choices = alone.argmin(axis=1)
    return _certified(problem, choices, _at(problem, choices), "solve_separable", proved)


# ------------------------------------------------------------------- solvers: the relaxation


def _relaxation(
    problem: SelectionProblem, form: trellis.Form, b: Array, iterations: int = 0
) -> Relaxation:
    """Evaluate weights b; the linear costs of `form` are infinite where a model may not be used."""
    d, value = trellis.mixed(form.mean, b), trellis.relaxed(form, b)[0]
    return Relaxation(b, d, value, trellis.certificate(form, d).bound, iterations)


def _own_weights(problem: SelectionProblem, relaxation: Relaxation) -> Relaxation:
    """Evaluate a relaxation that was handed over anew, as another problem's proves nothing."""
    b = check_array("relaxation.weights", relaxation.weights, "H W", problem.mean.shape[:2])
    off = np.abs(b.sum(axis=1) - 1).max()
    if b.min() < 0 or off > 1e-9 or (b > 0)[np.isinf(problem.linear)].any():
        raise ValueError(
            "relaxation.weights: expected rows >= 0 that sum to 1, and 0 where a model is not "
            "available, found others"
        )
    if problem.form.bare:
        return _relaxation(problem, problem.form, b, relaxation.iterations)
    multiplier = relaxation.multiplier if problem.budget is not None else 0.0
    d = trellis.mixed(problem.mean, b)
    bound = _certificate(problem, d, multiplier).bound
    return relaxation._replace(reference=d, bound=bound, multiplier=multiplier)


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
    return _relaxation(problem, problem.form, b, iterations)


def _expect_bare(problem: SelectionProblem) -> None:
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
    time_left, iterations = _stopwatch(time_limit), check_count("max_iterations", max_iterations)
    return _relax(problem, usable, gap, ceiling, time_left, iterations)


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
    gap, time_left = check_number("gap", gap, minimum=0), _stopwatch(time_limit)
    most = check_count("max_iterations", max_iterations)
    found = columns(
        problem.form,
        closes(gap, problem.rounding),
        ceiling=math.inf,
        time_left=time_left,
        max_iterations=most,
    )
    return _mixture(problem.form, found)


def _mixture(form: trellis.Form, found: Columns | None) -> Relaxation:
    """Certify a mixture of schedules; where there is none, no schedule is below infinity."""
    if found is None:
        b = np.where(form.linear < np.inf, 1.0, 0.0)
        b /= b.sum(axis=1, keepdims=True)
        return Relaxation(b, trellis.mixed(form.mean, b), math.inf, math.inf, 0)
    bound = trellis.certificate(form, found.reference, found.multiplier).bound
    b, d, multiplier, value, iterations = found
    return Relaxation(b, d, value, bound, iterations, multiplier)


def _relax(
    problem: SelectionProblem,
    usable: Mask,
    gap: float,
    ceiling: float,
    time_left: Callable[[], float],
    max_iterations: int = 60,
) -> Relaxation:
    """Relax the problem whose other models are not available, by the fastest way that does it."""
    form = problem.form._replace(linear=np.where(usable, problem.linear, np.inf))
    closed = closes(gap, problem.rounding)
    limits: dict[str, Any] = {"ceiling": ceiling, "time_left": time_left}
    if not form.bare:
        return _mixture(form, columns(form, closed, **limits, max_iterations=300))

    def evaluate(b: Array) -> tuple[float, float, Array]:
        return trellis.relaxed(form, b)

    limits["max_iterations"] = max_iterations
    weights, steps = interior_point(form.M, form.mean, usable, evaluate, closed, **limits)
    return _relaxation(problem, form, weights, steps)


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
    return _start(problem, relaxation, _stopwatch(time_limit))


def _start(
    problem: SelectionProblem, relaxation: Relaxation | None, time_left: Callable[[], float]
) -> Schedule:
    """Relax, unless that is done, round and swap: what exact searches start from."""
    if relaxation is None:
        relaxation = _relax(problem, np.isfinite(problem.linear), 1e-7, math.inf, time_left)
    point = _own_weights(problem, relaxation)
    choices, swaps = _swap(problem, point.weights.argmax(axis=1), time_left)
    if not problem.form.bare:  # rounding may break the budget, and swaps are weak beside arcs
        starts = [trellis.cheapest_path(problem._price, problem.switch_cost), choices]
        starts.append(_path_at(problem, point))
        swapped = [_swap(problem, c, time_left) for c in starts]
        legal = [pair for pair in swapped if problem.is_feasible(pair[0])] or [(starts[0], 0)]
        choices, swaps = min(legal, key=lambda pair: _cost(problem, pair[0])[0])
    return _certified(problem, choices, point, "round_and_swap", swaps=swaps)


def _path_at(problem: SelectionProblem, point: Relaxation) -> Choices:
    """Return the cheapest path at the prices of a point."""
    form, lam = problem.form, point.multiplier
    return trellis.cheapest_path(trellis.slopes(form, point.reference, lam)[0], form.priced(lam))


def _swap(
    problem: SelectionProblem, choices: Choices, time_left: Callable[[], float]
) -> tuple[Choices, int]:
    """Swap single models, and intervals where moves cost something, while that helps; count."""
    noise = max(problem.rounding, float(problem.cost_rounding(choices)))
    choices, swaps = local_search.swap(problem.form, choices, noise, time_left)
    if problem.form.arc is None or not problem.is_feasible(choices):
        return choices, swaps
    choices, blocks = local_search.swap_blocks(problem.form, choices, noise, time_left)
    return choices, swaps + blocks


# ----------------------------------------------------- solvers: dynamic programming on labels


def plain_dynamic_program(problem: SelectionProblem, *, max_labels: int = 2**18) -> Schedule:
    """Extend every partial schedule from the last step to the first: the form to read first.

    A label is (cost so far above the bound, offset y it hands to earlier steps, choices); see
    modelselect_parts/label_search.py.  Nothing is discarded, so there are W^H labels at the end,
    `max_labels` at most; `dynamic_program` gives the same optimum with a handful.
    """
    H, W, p = problem.mean.shape
    max_labels = check_count("max_labels", max_labels)
    if W**H > max_labels:
        raise ValueError(f"problem: expected at most {max_labels} labels, found {W}^{H}")
    first = _start(problem, None, _stopwatch(None))
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
        lost = label_search.losses(triangle, [], purse, float(excess), 0.0, 0.0).total
        proved = min(proved, found.base + triangle.constant + excess - lost)
        if problem.is_feasible(choices):
            best = np.array(choices)
    return _certified(problem, best, _point(first), "plain_dynamic_program", proved, **work)


def _point(schedule: Schedule) -> Relaxation:
    """Return the certificate's point of a schedule."""
    empty = np.zeros((0, 0))
    return Relaxation(empty, schedule.reference, math.inf, 0.0, 0, schedule.multiplier)


def dynamic_program(
    problem: SelectionProblem,
    *,
    time_limit: float | None = None,
    max_labels: int = WIDTHS[4],
    gap: float = OPTIMALITY_GAP,
    relaxation: Relaxation | None = None,
) -> Schedule:
    """Prove an optimum by dynamic programming from the last step to the first.

    Sphere decoding on a Viterbi trellis (modelselect_parts/label_search.py): a label is a partial
    schedule, and goes when it costs too much or when another one dominates it.  Passes keep at
    most 64, then eight times as many labels a step, up to `max_labels` (at least 64; the default,
    262144, takes a gigabyte or two where it is needed).  One that had to drop labels proves the
    least that those cost; one that did not proves the optimum.  A better schedule found by one
    pass shrinks the budget of the next; from the fourth on labels also go by what the steps before
    must add at least (`label_search.prefix_bounds`).  Ends with the gap, or after `time_limit`
    seconds with what is proved by then; `relaxation`, of `relax_interior_point` by default, gives d
    and the first schedule.
    `work` holds the labels kept at every step of the last pass, whether it was complete (a gap is
    then due to rounding), the passes and the seconds.
    """
    time_left, started = _stopwatch(time_limit), perf_counter()
    max_labels = check_count("max_labels", max_labels, minimum=WIDTHS[0])
    closed = closes(check_number("gap", gap, minimum=0), 0.0)
    first = _start(problem, relaxation, time_left)
    best, cost, proved, d = first.choices, first.cost, first.root_bound, first.reference
    certificate = _certificate(problem, d, first.multiplier)
    root, purse = certificate.base, triangles.purse(problem.form, first.multiplier)
    steps: list[triangles.Coordinates] = []
    labels, passes, complete = np.zeros(len(problem.mean), dtype=np.intp), 0, False
    ahead = None

    def expired() -> bool:
        return time_left() <= 0

    widths = [width for width in WIDTHS if width < max_labels] + [max_labels]
    for width in [*widths, max_labels]:
        if closed(cost, proved) or expired():
            break
        if passes == 2 and not complete:
            best, cost = _perturbed(problem, best, cost, time_left)
        if not steps:
            point = (d, first.multiplier)
            triangle = triangles.factor(problem.form, certificate, *point, cost - root)
        excess = max(0.0, cost - root - triangle.constant)
        slack = _slack(problem, best, cost)
        if not steps:
            least = label_search.negligible_strength(triangle, excess, slack)
            steps = triangles.compress(triangle, least, expired)
            if not steps:
                break
        if passes == 3 and not complete:
            ahead = label_search.prefix_bounds(triangle, steps, excess, slack, expired)
        lost = label_search.losses(triangle, steps, purse, excess, slack, least)
        found = label_search.search(triangle, steps, purse, lost, width, expired, ahead)
        labels, passes, complete, before = found.labels, passes + 1, found.complete, cost
        if found.choices is not None:
            better, _ = _swap(problem, found.choices, time_left)
            if problem.is_feasible(better) and (lower := _cost(problem, better)[0]) < cost:
                best, cost = better, lower
        summing = 4 * trellis.EPS * (abs(root) + abs(found.least))
        proved = max(proved, min(before, root + found.least - summing))
        again = cost < before if found.complete else width < max_labels  # with less to give away
        if not again:
            break
    work = {"labels": labels, "passes": passes, "complete": complete}
    work["seconds"] = perf_counter() - started
    return _certified(problem, best, _point(first), "dynamic_program", proved, **work)


def _perturbed(
    problem: SelectionProblem, choices: Choices, cost: float, time_left: Callable[[], float]
) -> tuple[Choices, float]:
    """Look further for a first schedule where switching costs and a budget mislead swaps."""
    form = problem.form
    if form.arc is None or form.price is None:
        return choices, cost
    noise = max(problem.rounding, float(problem.cost_rounding(choices)))
    better = local_search.perturbed(form, choices, PERTURBATIONS, noise, time_left)
    return better, min(cost, _cost(problem, better)[0])


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
    time_left, started = _stopwatch(time_limit), perf_counter()
    most = math.inf if max_nodes is None else check_count("max_nodes", max_nodes)
    gap = check_number("gap", gap, minimum=0)
    allowed = np.isfinite(problem.linear)
    if relaxation is None:
        relaxation = _relax(problem, allowed, gap / 10, math.inf, time_left)
    root = _own_weights(problem, relaxation)
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
                    settled = min(settled, _at_least(problem, rounded))
            elif bound < cost:
                heapq.heappush(queue, (bound, len(tree) - 1, child, undecided))
            candidate, _ = _swap(problem, rounded, time_left)
            legal = problem.is_feasible(candidate)
            if legal and (lower_cost := _cost(problem, candidate)[0]) < cost:
                best, cost = candidate, lower_cost
    lower = min([settled, cost, *(node[0] for node in queue[:1])])
    work = {"nodes": len(tree), "tree": tree, "seconds": perf_counter() - started}
    return _certified(problem, best, _point(first), "branch_and_bound", lower, **work)


def _at_least(problem: SelectionProblem, choices: Choices) -> float:
    """Return what a schedule costs at least, whatever rounding did."""
    cost, rounding = _cost(problem, choices)
    return cost - rounding


def _narrowed(
    problem: SelectionProblem, allowed: Mask, point: Relaxation, cost: float
) -> tuple[float, Mask, int]:
    """Bound the schedules of allowed models; forbid models of none cheaper than `cost`.

    Return the bound, the models left, and the step to split, which has a choice left if any has.
    """
    H, _, p = problem.mean.shape
    form = problem.form._replace(linear=np.where(allowed, problem.linear, np.inf))
    found = trellis.certificate(form, point.reference, point.multiplier)
    bound, reduced = found.bound, found.reduced
    if point.bound == math.inf:  # nothing below this node keeps the budget
        return math.inf, allowed, 0
    narrowed = allowed & (reduced <= cost - bound)
    narrowed[np.arange(H), reduced.argmin(axis=1)] = True
    away = (problem.mean - point.reference.reshape(H, 1, p)) ** 2
    weight = problem.quadratic.diagonal().reshape(H, 1, p)
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
    open, `dynamic_program`.  If that runs into `max_labels` and a time limit leaves time, or into
    rounding, `branch_and_bound`; the best schedule and the highest proved bound come back.

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
    time_left = _stopwatch(time_limit)
    if is_separable(problem):
        return solve_separable(problem)
    relaxation = _relax(problem, np.isfinite(problem.linear), 1e-7, math.inf, time_left)
    quick = _start(problem, relaxation, time_left)
    if quick.gap <= gap or time_left() <= 0:
        return quick

    def limit() -> float | None:
        return None if time_limit is None else max(0.0, time_left())

    decoded = dynamic_program(
        problem, time_limit=limit(), max_labels=max_labels, gap=gap, relaxation=relaxation
    )
    if decoded.gap <= gap or time_left() <= 0 or not (time_limit or decoded.work["complete"]):
        return decoded
    options: dict[str, Any] = {"time_limit": limit(), "gap": gap, "relaxation": relaxation}
    searched = branch_and_bound(problem, max_nodes=None if time_limit else 1000, **options)
    best = min(decoded, searched, key=lambda schedule: schedule.cost)
    bound = max(decoded.lower_bound, searched.lower_bound)
    return replace(best, lower_bound=min(best.cost, bound))


# ------------------------------------------------------------------- the whole Pareto front


def pareto_front(
    problem: SelectionProblem, *, resolution: float = 0.0, time_limit: float | None = None
) -> list[Schedule]:
    """Return the schedules that no other beats in both control and perception term, dearest first.

    Each is the optimum of the problem at alpha = 1, beta = 0 under a budget just below what the one
    before spends, or `resolution` below, so its `cost` is its `control_term`, and its proof is one
    that `check_certificate` judges.  Weights alpha and beta reach the corners of the front's convex
    hull only; budgets reach every point.  The problem's own `budget` is where the front begins.

    Points of equal control up to OPTIMALITY_GAP count as one.  With real-valued prices there can be
    tens of thousands: then state a resolution.  Where `time_limit` seconds end first, or rounding
    leaves a gap, the proved points are returned, with a warning that says where they end.
    """
    resolution = check_number("resolution", resolution, minimum=0)
    time_left = _stopwatch(time_limit)
    prices = problem._price[np.isfinite(problem._price)]
    if problem.switch_cost is not None:
        prices = np.append(prices, problem.switch_cost)
    whole = bool((prices == np.floor(prices)).all() and np.abs(prices).max() < 2**53)
    step = max(resolution, 1.0 if whole else 4e-12 * problem._most_spent)
    cheapest = trellis.cheapest_path(problem._price, problem.switch_cost)
    least = float(problem.perception_term(cheapest))
    front: list[Schedule] = []
    now = replace(problem, alpha=1.0, beta=0.0)
    while True:
        limit = None if time_limit is None else max(0.0, time_left())
        found = solve(now, time_limit=limit)
        if not found.is_optimal:
            budget = math.inf if now.budget is None else now.budget
            warnings.warn(f"pareto_front: not proved from perception {budget:g} down", stacklevel=2)
            return front
        if front and closes(OPTIMALITY_GAP, 0.0)(found.cost, front[-1].cost):
            front.pop()  # as good for control, and spends less
        front.append(found)
        spent = float(problem.perception_term(found.choices))
        if spent - step < least - problem._limit_slack:
            return front
        now = replace(now, budget=max(spent - step, least))


# ---------------------------------------------------------- what biased and noisy models cost


@dataclass(frozen=True, eq=False)
class ErrorCost:
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
    either way.  bias + noise is the control term, unweighted and without a pull; uncoupled alone
    is what greedy selection sees.
    """
    H, W, _ = problem.mean.shape
    always = np.repeat(np.arange(W)[:, None], H, axis=1)
    noise = problem.spread.sum(axis=0)
    own = np.einsum("twi,tij,twj->w", problem.mean, problem.blocks, problem.mean)
    variance = problem.variance
    if variance.ndim == 4:
        variance = np.diagonal(variance, axis1=-2, axis2=-1)
    mean_square = (problem.mean**2 + variance).sum(axis=-1).mean(axis=0)
    mu = problem.chosen_mean(always)
    return ErrorCost(mean_square, own + noise, ((mu @ problem.psi) * mu).sum(axis=1), noise)


def correlated_cost(
    problem: SelectionProblem,
    choices: npt.ArrayLike,
    covariance: Callable[[int, int, int, int], npt.ArrayLike],
) -> float:
    """Return the exact expected total cost of `choices` (H,) whose errors correlate over time.

    alpha (mu_c'Psi mu_c + sum_{t,k} sum(Psi_tk * Cov[e_t, e_k]) + g'mu_c) + beta perception_term,
    an extension of ``eq:expTmp1``, whose assumption of independence keeps the terms t = k only.
    covariance(t, w, k, v), (p, p) or a number where p = 1, is that of model w's error at step t
    with model v's at step k, in the place of `problem.variance`.
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
    control += 0.0 if problem.pull is None else problem.pull.ravel() @ mu
    return float(problem.alpha * control + problem.beta * problem.perception_term(c))


# --------------------------------------------------------------------- why it is hard (Remark)


def partition_problem(integers: Sequence[int], information: str = "open_loop") -> SelectionProblem:
    """Turn PARTITION of positive `integers` into model selection: the paper's open question.

    One integrator x_{t+1} = x_t + B_t u_t + s_t with B_0 = 1 and then 0, R = 1, Q = 0, Q_final = 1
    has Psi = 11'/2, for every pattern that foresees.  Let model 0 err by +a_t and model 1 by -a_t
    at step t.  A schedule costs (sum_t +-a_t)^2 / 2 plus less than 1/4 for perception, so the
    optimum is below 1/2 exactly if the integers split into two halves of equal sum: model
    selection is NP-hard (Karp 1972), weakly: with offsets so few, `dynamic_program` is
    pseudo-polynomial here.  The sum is at most 1e7, so that its square has its digits in a float.
    """
    check_array("integers", integers, "H", (None,))
    a = [check_count("integers", value) for value in as_numbers("integers", integers)]
    H = len(a)
    if sum(a) > 1e7:
        raise ValueError(f"integers: expected a sum of at most 1e7, found {sum(a)}")
    one, B = np.ones((1, 1)), np.zeros((H, 1, 1))
    B[0] = 1
    task = ControlTask(one, B, one, 0 * one, one, H, Q_final=one)
    mean = np.stack([a, np.negative(a)], axis=1)[:, :, None]
    return SelectionProblem(
        _foreseen_psi(task, information), mean, 0 * mean, np.array([0, 1 / (8 * H)])
    )


def maximum_cut_problem(
    adjacency: npt.ArrayLike, information: str = "open_loop"
) -> SelectionProblem:
    """Turn MAXIMUM CUT of a graph on H nodes, `adjacency` (H, H) of 0 and 1, into model selection.

    So model selection is strongly NP-hard where the state dimension may grow (Karp 1972).  Proof.
    Let L be the graph's Laplacian, D = 2H I - L; the eigenvalues of L are at most H, so D >= H I.
    Take n = H states that shift by one place a step, s_t entering at the first; so x_H holds s_t
    in place H-1-t.  Let the control act at t = 0 only, on every place, with R = I; let Q = 0 and
    let Q_final weigh these places by H D.  Then x_H = u + s up to order, and

        Psi = H D (I + H D)^{-1} H D = H D - I + (I + H D)^{-1}.

    With two free models that err by -1 and +1, a schedule is e in {-1, 1}^H: a side for each
    node.  As e'L e = 4 cut(e) and e'e = H,

        e'Psi e = H (2 H^2 - 4 cut(e)) - H + e'(I + H D)^{-1} e,

    whose last term lies in (0, 1/2), while one more edge in the cut is worth 4H >= 4: the cheapest
    schedule is a maximum cut, and no number is larger than a polynomial in H.
    """
    graph = as_numbers("adjacency", adjacency)
    size = 2 * (graph.shape[-1:] or (None,))
    graph = check_array("adjacency", graph, "H H", size)
    if not np.isin(graph, (0, 1)).all() or graph.diagonal().any() or (graph != graph.T).any():
        raise ValueError("adjacency: expected a symmetric matrix of 0 and 1 without loops")
    H = len(graph)
    D = 2 * H * np.eye(H) - (np.diag(graph.sum(axis=0)) - graph)
    B = np.zeros((H, H, H))
    B[0] = np.eye(H)
    shift, entry = np.roll(np.eye(H), 1, axis=0), np.eye(H)[:, :1]
    Q_final = H * D[::-1, ::-1]
    task = ControlTask(shift, B, entry, np.zeros((H, H)), np.eye(H), H, Q_final=Q_final)
    mean = np.tile([[-1.0], [1.0]], (H, 1, 1))
    return SelectionProblem(_foreseen_psi(task, information), mean, 0 * mean, np.zeros(2))


def _foreseen_psi(task: ControlTask, information: str) -> Array:
    """Psi of a pattern with foresight; under the others steps decouple, and nothing is hard."""
    foreseeing = [name for name, row in PATTERNS.items() if row.foresight]
    check_name("information", information, foreseeing)
    return psi(task, information)
