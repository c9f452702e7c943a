"""Continuous choices: section V of the paper, Problem 4."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple, Protocol

import numpy as np
import numpy.typing as npt
import scipy.linalg as la

from modelselect_parts.checks import (
    Array,
    Frozen,
    check_array,
    check_class,
    check_count,
    check_number,
)
from modelselect_parts.descent import projected_gradient
from modelselect_parts.semidefinite import semidefinite_root


class Selection(Protocol):
    """What is read of a `modelselect.SelectionProblem`."""

    mean: Array
    quadratic: Array
    linear: Array
    rounding: float
    total_cost: Callable[..., Any]


@dataclass(frozen=True, eq=False)
class BlendProblem(Frozen):
    """Blend the worst and the best model by c_t in [0, 1]: the paper's Problem 4.

    Source: ``prob:model_selection_expectation_cont``.
    Mean, variance and cost of the blend are (1 - c_t) times the worst model's plus c_t times the
    best one's (``eq:perModelExpCont``, ``eq:perModelVarCont``).  In canonical form
    (``opt:canonical``) the expected total is f(c) = c'Psi'c + linear'c + constant with
    Psi' = alpha D'Psi D, where column t of D (pH, H) holds delta_t = mu[t, best] - mu[t, worst].
    Psi' is positive semidefinite for every suite, as x'Psi'x = alpha |(Dx)|_Psi^2: a convex
    problem over a box.

    Parameters
    ----------
    problem : SelectionProblem
        Its model costs set the price of the best model; both models available at every step.
    worst, best : int
        The two models blended.

    Raises
    ------
    ValueError
        A model that does not exist or is not available; switching costs, a budget or a pull.
    """

    problem: Selection
    worst: int = 0
    best: int = -1

    def __post_init__(self) -> None:
        check_class("problem", self.problem, "SelectionProblem")
        W = self.problem.mean.shape[1]
        for name in ("switch_cost", "budget", "pull"):
            if getattr(self.problem, name) is not None:
                raise ValueError(
                    f"problem: expected no {name}, which blends do not have, found one"
                )
        for name in ("worst", "best"):
            w = check_count(name, getattr(self, name), minimum=-W)
            if w >= W or not np.isfinite(self.problem.linear[:, w]).all():
                raise ValueError(f"{name}: expected an available model of {W}, found {w}")
            object.__setattr__(self, name, w % W)

    @cached_property
    def _differences(self) -> Array:
        """D, (pH, H)."""
        delta = self.problem.mean[:, self.best] - self.problem.mean[:, self.worst]
        return np.asarray(la.block_diag(*delta[:, :, None]))

    def _mean(self, c: Array) -> Array:
        """Mean errors (..., pH) of blends (..., H)."""
        mu, c = self.problem.mean, c[..., None]
        mixed = (1 - c) * mu[:, self.worst] + c * mu[:, self.best]
        return np.asarray(mixed.reshape(*c.shape[:-2], -1))

    @cached_property
    def quadratic(self) -> Array:
        """Psi', (H, H)."""
        D = self._differences
        return np.asarray(D.T @ self.problem.quadratic @ D)

    @cached_property
    def linear(self) -> Array:
        """Linear term of f, (H,)."""
        mu, ell = self.problem.mean[:, self.worst].ravel(), self.problem.linear
        pull = 2 * self._differences.T @ self.problem.quadratic @ mu
        return np.asarray(pull + ell[:, self.best] - ell[:, self.worst])

    @cached_property
    def constant(self) -> float:
        """f(0): the worst model throughout."""
        return float(self.problem.total_cost(np.full(len(self.linear), self.worst)))

    def total_cost(self, blend: npt.ArrayLike) -> Any:
        """Return f(c) of `blend` (..., H): 0 <= c_t <= 1, or beyond; ValueError if it overflows."""
        c = check_array("blend", blend, "... H", (len(self.linear),))
        # Not in canonical form, which loses the digits of f(0) - f(c) where models differ much.
        ell = self.problem.linear
        with np.errstate(all="ignore"):
            d = self._mean(c)
            cost = ((d @ self.problem.quadratic) * d).sum(axis=-1)
            cost += (1 - c) @ ell[:, self.worst] + c @ ell[:, self.best]
        if not np.isfinite(cost).all():
            raise ValueError("blend: the cost overflows; expected numbers from 0 to 1")
        return cost


class Blend(NamedTuple):
    """A solution of a `BlendProblem` with its certificate."""

    choices: Array  #: (H,), c_t in [0, 1]
    cost: float  #: f(c)
    lower_bound: float  #: f(c) minus the duality gap
    iterations: int  #: gradient steps taken


def solve_blend(blend: BlendProblem, *, gap: float = 1e-9, max_iterations: int = 100_000) -> Blend:
    """Minimise f over the box by projected gradient (``sol:model_selection_expectation_cont``).

    By convexity f(v) >= f(c) + f'(c)(v - c) for all v; minimised over the box this gives the
    bound f(c) - sum_t max over v in {0, 1} of f'_t(c)(c_t - v), the duality gap of Frank and Wolfe.

    Parameters
    ----------
    blend : BlendProblem
        The problem.
    gap : float
        Stop when the duality gap is this fraction of the cost.
    max_iterations : int
        Stop after this many steps in any case.

    Returns
    -------
    Blend
        The blend, its cost and a lower bound on the optimum.

    Raises
    ------
    ValueError
        A `gap` or `max_iterations` out of range.
    """
    check_class("blend", blend, "BlendProblem")
    M, g = blend.quadratic, blend.linear
    tiny = np.finfo(float).tiny
    size = np.where(M.diagonal() > tiny, M.diagonal(), np.where(np.abs(g) > tiny, np.abs(g), 1))
    scale = size**-0.5
    step = scale**2 / (2 * max(1, la.eigvalsh(scale[:, None] * M * scale)[-1]))

    ell = blend.problem.linear[:, blend.best] - blend.problem.linear[:, blend.worst]

    def evaluate(c: Array) -> tuple[float, float, Array]:
        pull = blend.problem.quadratic @ blend._mean(c)
        slope, cost = 2 * blend._differences.T @ pull + ell, float(blend.total_cost(c))
        return cost, cost - float(np.maximum(slope * c, slope * (c - 1)).sum()), slope

    def project(c: Array) -> Array:
        return np.clip(c, 0, 1)

    half = np.full(len(g), 0.5)
    negligible = blend.problem.rounding
    c, iterations = projected_gradient(
        evaluate, project, half, step, gap, negligible, max_iterations
    )
    return Blend(c, *evaluate(c)[:2], iterations)


def sdp_blocks(blend: BlendProblem, theta: float, choices: npt.ArrayLike) -> list[Array]:
    """Build the blocks of the paper's semidefinite programme (``opt:sdp``, corrected).

    With Psi' = N'N, f(c) <= theta and 0 <= c <= 1 hold exactly where every block is positive
    semidefinite: [1 - c_t], [c_t], and the Schur complement [[I, Nc], [c'N', theta - linear'c -
    constant]].  Min theta subject to them is the value of `solve_blend`.

    Parameters
    ----------
    blend : BlendProblem
        The problem.
    theta : float
        Claimed upper bound on f(c).
    choices : array_like, (H,)
        The blend c.

    Returns
    -------
    list of ndarray
        2H blocks (1, 1), then one (H+1, H+1).

    Raises
    ------
    ValueError
        A wrong shape or a number that is not finite.
    """
    check_class("blend", blend, "BlendProblem")
    H = len(blend.linear)
    c = check_array("choices", choices, "H", (H,))
    N = semidefinite_root(blend.quadratic).T
    corner = check_number("theta", theta) - blend.linear @ c - blend.constant
    schur = np.block([[np.eye(H), (N @ c)[:, None]], [N @ c, np.array([corner])]])
    return [np.array([[x]]) for x in (*(1 - c), *c)] + [schur]
