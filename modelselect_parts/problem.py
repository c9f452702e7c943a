r"""Section III of the paper: which model to run at each step, as a problem to be solved.

The symbols are those of the table in modelselect.py.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping
from dataclasses import KW_ONLY, dataclass, replace
from fractions import Fraction
from functools import cached_property
from typing import Any, Protocol, Self

import numpy as np
import numpy.typing as npt

from modelselect_parts import exact, trellis
from modelselect_parts.checks import (
    Array,
    Choices,
    as_numbers,
    check_array,
    check_choices,
    check_class,
    check_count,
    check_number,
    check_range,
    frozen,
)
from modelselect_parts.matrices import check_semidefinite
from modelselect_parts.sensitivity import Sensitivity
from modelselect_parts.stored import Stored

EXACT_BELOW = 1e-10
EXACT_SIZE = 100
LONG = 1000  # errors pH beyond which a linear system is not written out as a matrix


class Suite(Protocol):
    """What `SelectionProblem.from_suite` takes: a `PerceptionSuite`, or alike."""

    @property
    def mean(self) -> Array:
        """(H, W, p)."""
        ...

    @property
    def variance(self) -> Array:
        """(H, W, p) or (H, W, p, p)."""
        ...

    @property
    def cost(self) -> Array:
        """(W,) or (H, W)."""
        ...


@dataclass(frozen=True, eq=False)
class SelectionProblem(Stored):
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
    psi : array_like, (pH, pH), or Sensitivity
        Sensitivity of the control cost, symmetric positive semidefinite; see `psi`.  A system of
        more than LONG = 1000 errors stays one where neither switching costs nor a budget tie steps
        together; else it becomes its matrix.
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

    psi: Array | Sensitivity
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
        raw = {name: as_numbers(name, getattr(self, name)) for name in ("mean", "variance")}
        shape, Psi = raw["mean"].shape, self.psi
        free = self.switch_cost is None and self.budget is None
        if isinstance(Psi, Sensitivity) and len(Psi) > LONG and free:
            p = Psi.own.shape[2]
        else:
            Psi = as_numbers("psi", Psi)
            Psi = check_array("psi", Psi, "pH pH", 2 * ((Psi.shape[-1:] or (None,))[0] or None,))
            p = shape[-1] if len(shape) == 3 and shape[-1] and len(Psi) % shape[-1] == 0 else 1
        mean = check_array("mean", self.mean, "H W p", (len(Psi) // p, None, p))
        H, W, _ = mean.shape
        axes = "H W p p" if raw["variance"].ndim == 4 else "H W p"
        variance = check_array("variance", self.variance, axes, (H, W, p, p)[: len(axes.split())])
        cost = _check_cost(self.model_cost, H, W)
        if isinstance(Psi, np.ndarray):
            Psi = check_semidefinite("psi", Psi, given=self.psi)
        if variance.ndim == 4:
            variance = check_semidefinite("variance", variance, given=self.variance)
        else:
            check_range("variance", variance)
        weights = {
            name: check_number(name, getattr(self, name), minimum=0) for name in ("alpha", "beta")
        }
        self._set(psi=Psi, mean=mean, variance=variance, model_cost=cost, **weights)
        self._check_beyond_the_paper(H, W, p)
        with np.errstate(all="ignore"):
            # By Cauchy and Schwarz, a bound on every |mu|'|alpha Psi||mu|, without Psi's square.
            felt = np.sqrt(self.alpha * np.abs(Psi.diagonal())) @ np.abs(mean).max(axis=1).ravel()
            largest = felt**2 + self.linear_size.sum() + self._most_spent * max(self.beta, 1)
        if not largest < 1e300:
            raise ValueError(
                "psi: the costs overflow; rescale psi, mean, variance, the prices, alpha or beta"
            )

    @classmethod
    def from_suite(cls, psi: Array | Sensitivity, suite: Suite, **given: Any) -> Self:
        """Pose the problem of a suite's means, variances and, unless `given`, costs.

        A `model_cost` may be by name, too; all else that a problem takes may be given.  A suite
        whose models sometimes gave nothing (`miss_rate`) says how they err when they do not, which
        is too good: `perception.with_dropouts` adds what happens then.
        """
        if not all(hasattr(suite, name) for name in ("mean", "variance", "cost")):
            raise ValueError(f"suite: expected PerceptionSuite, found {type(suite).__name__}")
        if np.any(getattr(suite, "miss_rate", None)):
            left_out = "suite: looks that gave nothing are left out; see with_dropouts"
            warnings.warn(left_out, stacklevel=2)
        price = given.pop("model_cost", suite.cost)
        if isinstance(price, Mapping):  # by name, which the suite knows
            price = replace(suite, cost=price).cost  # type: ignore[type-var]
        return cls(psi, suite.mean, suite.variance, price, **given)

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
        """Return alpha Psi as a matrix (pH, pH), be it of a long system."""
        return frozen(self.alpha * np.asarray(self.psi))

    @cached_property
    def blocks(self) -> Array:
        """Diagonal blocks Psi_tt, (H, p, p)."""
        H, _, p = self.mean.shape
        if isinstance(self.psi, Sensitivity):
            return self.psi.blocks
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
        return math.inf if self.budget is None else self.budget + self._spending_slack(self.budget)

    def _spending_slack(self, spent: float) -> float:
        """1e-12 of the sizes that a schedule adds up to this: sums in another order differ by less.

        What negative prices pay back stands among them twice.
        """
        refunds = np.maximum(-self._price.min(axis=1), 0).sum()
        return float(1e-12 * (abs(spent) + 2 * refunds))

    @cached_property
    def defect(self) -> float:
        """What psi lacks of being semidefinite: psi + defect diag(psi) is, in exact numbers."""
        if isinstance(self.psi, Sensitivity):
            return 0.0  # a sum of squares
        return exact.semidefinite_defect(self.psi)

    @cached_property
    def form(self) -> trellis.Form:
        """The bare arrays that the engines work on."""
        long = isinstance(self.psi, Sensitivity)
        M = self.alpha * self.psi if long else self.quadratic
        form = trellis.Form(M, self.mean, self.linear, self.linear_size, defect=self.defect)
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
        return self._total(self.form.M, mu, self.linear, self.form.arc, choices)

    def is_feasible(self, choices: npt.ArrayLike) -> Any:
        """Whether `choices` (..., H) are available and keep the budget, up to rounding."""
        return self.perception_term(choices) <= min(self._limit, 1e308)

    def cost_rounding(self, choices: npt.ArrayLike) -> Any:
        """How far `total_cost` of `choices` (..., H) can be off: its terms' sizes, times k eps."""
        size = trellis.form_size(self.form.M, self.chosen_mean(choices))
        singles = trellis.path_sum(self.linear_size, self.form.arc, self._check(choices))
        return trellis.rounding_unit(self.mean) * (size + singles)

    def exact_cost(self, choices: npt.ArrayLike) -> Fraction:
        """Total cost of `choices` (H,), all available, in rational arithmetic on these floats."""
        c, steps = self._check(choices), np.arange(len(self.mean))
        chosen, mu = self.variance[steps, c], self.chosen_mean(choices)
        Sigma = chosen if chosen.ndim == 3 else chosen[..., None] * np.eye(chosen.shape[-1])
        control = exact.exact_form(np.asarray(self.psi), mu)
        control += exact.exact_product(self.blocks, Sigma.swapaxes(-1, -2))
        if self.pull is not None:
            control += exact.exact_product(self.pull.ravel(), mu)
        paid = np.broadcast_to(self.model_cost, self.mean.shape[:2])[steps, c]
        if self.switch_cost is not None:
            paid = np.append(paid, self.switch_cost[c[:-1], c[1:]])
            if self.initial_model is not None:
                paid = np.append(paid, self.switch_cost[self.initial_model, c[0]])
        if np.isinf(paid).any():
            raise ValueError("choices: expected available models, found one that is not")
        return Fraction(self.alpha) * control + Fraction(self.beta) * sum(map(Fraction, paid))

    def _accurate_cost(self, choices: Choices) -> tuple[float, float]:
        """Cost of a schedule (H,), in fractions where digits cancel, and how far it may be off."""
        cost, rounding = float(self.total_cost(choices)), float(self.cost_rounding(choices))
        small = isinstance(self.psi, np.ndarray) and len(self.psi) <= EXACT_SIZE
        if not (small and EXACT_BELOW * abs(cost) < rounding and math.isfinite(cost)):
            return cost, rounding
        cost = float(self.exact_cost(choices))
        return cost, abs(cost) * trellis.EPS

    def _total(
        self,
        M: Array | Sensitivity,
        mu: Array,
        table: Array,
        arc: Array | None,
        choices: npt.ArrayLike,
    ) -> Any:
        return trellis.form_of(M, mu) + trellis.path_sum(table, arc, self._check(choices))

    def _check(self, choices: npt.ArrayLike) -> Choices:
        return check_choices(choices, *self.mean.shape[:2])


def _check_cost(value: Any, H: int, W: int) -> Array:
    """Return model costs (W,) or (H, W), with a model that is available at every step."""
    axes, sizes = ("H W", (H, W)) if as_numbers("model_cost", value).ndim == 2 else ("W", (W,))
    cost = check_array("model_cost", value, axes, sizes, finite=False)
    if np.isneginf(cost).any():
        raise ValueError("model_cost: expected numbers above -inf, found -inf")
    if (none := np.isinf(np.atleast_2d(cost)).all(axis=-1)).any():
        found = f"none at step {none.argmax()}" if cost.ndim == 2 else "none"
        raise ValueError(f"model_cost: expected an available model at every step, found {found}")
    return cost


def stepwise_cost(problem: SelectionProblem) -> Array:
    """Cost (H, W) of each model at each step alone: alpha mu'Psi_tt mu + l, coupling ignored."""
    check_class("problem", problem, "SelectionProblem")
    weighed = problem.alpha * problem.blocks
    own = np.einsum("twi,tij,twj->tw", problem.mean, weighed, problem.mean)
    return np.asarray(own + problem.linear)
