r"""Errors that correlate over time: what they cost, and the same problem with W components.

Pictures taken one after another look alike, so a network's errors last; after a calibration a bias
is left that nobody knows.  Let e[t, w] (p,) be the error of model w at step t, of mean mu, with

    Cov[(t,w,r), (k,v,s)] = Cov(e[t,w]_r, e[k,v]_s),    M = Cov + mu mu'.

A covariance is an array (H, W, p, H, W, p), or (H, W, H, W) where p = 1, that stands in the place
of a problem's variance.  With the choices as 0 and 1 (`one_hot`), a schedule costs

    E[e_c'Psi e_c] = b'Psi' b,    Psi'[(t,w), (k,v)] = sum_rs Psi_tk[r,s] M[(t,w,r), (k,v,s)].

Psi' is semidefinite by Schur's product theorem.  So errors that correlate pose a selection problem
again: its W components are b itself, its mean errors unit vectors, its variance 0, whatever p is.

Models whose biases persist, unknown, average out like shares in a portfolio: halves of a flight
under two of them, of variance 1 and with Psi = 11', cost H^2/2 where either alone costs H^2.

>>> Cov = np.kron(np.ones((4, 4)), np.eye(2)).reshape(4, 2, 4, 2)  # two biases of variance 1
>>> problem = SelectionProblem(np.ones((4, 4)), np.zeros((4, 2, 1)), np.zeros((4, 2, 1)), [0, 0])
>>> correlated_cost(problem, [[0, 0, 0, 0], [0, 1, 0, 1]], Cov)
array([16.,  8.])
>>> correlated_problem(problem, Cov).total_cost([[0, 0, 0, 0], [0, 1, 0, 1]])
array([16.,  8.])
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.linalg import solve_triangular

from modelselect_parts.checks import (
    Array,
    Choices,
    as_numbers,
    check_array,
    check_choices,
    check_class,
)
from modelselect_parts.matrices import check_semidefinite
from modelselect_parts.problem import SelectionProblem
from modelselect_parts.semidefinite import EPSILON, MATRIX_TOLERANCE, judged

Covariance = npt.ArrayLike | Callable[[int, int, int, int], npt.ArrayLike]

SAFETY = (1e-6, 1e-3)  # shares of the largest multiple that rounding may take, first try, second


# ---------------------------------------------------------------------- covariances, as given


def _joint(problem: SelectionProblem, covariance: Covariance, t: Choices, w: Choices) -> Array:
    """Covariance (np, np) of the errors of n models w at steps t, both (n,), as found."""
    H, W, p = problem.mean.shape
    if callable(covariance):
        pairs = list(zip(t.tolist(), w.tolist(), strict=True))
        rows = [[_entry(covariance(*one, *other), p) for other in pairs] for one in pairs]
        blocks = np.array(rows)
    else:
        given, shape = as_numbers("covariance", covariance), 2 * (H, W, p)
        if p == 1 and given.ndim == 4:
            given = given[:, :, None, :, :, None]
        if given.shape != shape:
            expected = f"(H, W, p, H, W, p) = {shape}"
            raise ValueError(f"covariance: expected shape {expected}, found {given.shape}")
        blocks = given[t[:, None], w[:, None], :, t, w]
    joint = blocks.swapaxes(1, 2).reshape(2 * (len(t) * p,))
    checked = check_array("covariance", joint, "N N", joint.shape)
    if _clearly_semidefinite(checked):
        return checked
    return check_semidefinite("covariance", checked, given=joint)


def _entry(found: npt.ArrayLike, p: int) -> Array:
    """One (p, p) block that a callable returned; a number will do where p = 1."""
    block = as_numbers("covariance", found)
    block = block.reshape(1, 1) if p == 1 and block.ndim == 0 else block
    return check_array("covariance", block, "p p", (p, p))


def _clearly_semidefinite(A: Array) -> bool:
    """Whether Cholesky's method says so, up to its rounding: ten times faster than eigenvalues."""
    root = np.sqrt(np.maximum(A.diagonal(), 1e-300))
    with np.errstate(over="ignore"):
        scaled = A / root / root[:, None]
    if not (A == A.T).all() or not np.isfinite(scaled).all():
        return False
    try:
        np.linalg.cholesky(scaled + 10 * EPSILON * len(A) * np.eye(len(A)))
    except np.linalg.LinAlgError:
        return False
    return True


# ------------------------------------------------------------------------------ what it costs


def correlated_cost(
    problem: SelectionProblem, choices: npt.ArrayLike, covariance: Covariance
) -> Any:
    """Return the exact expected total cost of `choices` (..., H) whose errors correlate over time.

    alpha (mu_c'Psi mu_c + sum_{t,k} sum(Psi_tk * Cov[e_t, e_k]) + g'mu_c) + beta perception_term,
    an extension of ``eq:expTmp1``, whose assumption of independence keeps the terms t = k only.
    `covariance`, in the place of `problem.variance`, is an array (H, W, p, H, W, p), or
    (H, W, H, W) where p = 1; or a function: covariance(t, w, k, v), (p, p) or a number where p = 1,
    is that of model w's error at step t with model v's at step k.
    """
    check_class("problem", problem, "SelectionProblem")
    H, W, p = problem.mean.shape
    c, Psi = check_choices(choices, H, W), np.asarray(problem.psi)
    used, place = np.unique(np.arange(H) * W + c.reshape(-1, H), return_inverse=True)
    joint = _joint(problem, covariance, *np.divmod(used, W))
    rows = (place.reshape(-1, H, 1) * p + np.arange(p)).reshape(-1, H * p)
    noise = np.array([(Psi * joint[np.ix_(row, row)]).sum() for row in rows])
    certain = replace(problem, variance=np.zeros_like(problem.mean))
    return certain.total_cost(c) + problem.alpha * noise.reshape(c.shape[:-1])[()]


# ------------------------------------------------------------------------ the lifted problem


def correlated_problem(problem: SelectionProblem, covariance: Covariance) -> SelectionProblem:
    """Return the problem of W components in which every schedule costs its `correlated_cost`.

    Takes `covariance` as `correlated_cost` does, in the place of the problem's variance; prices,
    weights, switching costs and budget stay.  With Psi' of the module,

        b'Psi'b = b'(Psi' - diag(g))b + g'b,    as b^2 = b for a choice.

    But b^2 < b for the fraction of one, so that relaxations cost more, and prove more, the larger
    g is: it takes as much as leaves Psi' semidefinite and becomes `pull`, beside what the problem's
    own pull makes of the mean errors.
    """
    check_class("problem", problem, "SelectionProblem")
    H, W, p = problem.mean.shape
    joint = _joint(problem, covariance, *np.divmod(np.arange(H * W), W))
    mu, Psi = problem.mean.ravel(), np.asarray(problem.psi).reshape(2 * (H, p))
    with np.errstate(all="ignore"):
        M = (joint + np.outer(mu, mu)).reshape(2 * (H, W, p))
        lifted = np.einsum("trks,twrkvs->twkv", Psi, M).reshape(2 * (H * W,))
        lifted = (lifted + lifted.T) / 2
    if not np.isfinite(lifted).all():
        raise ValueError("problem: the lifted Psi overflows; rescale psi or the mean errors")
    # Where terms cancel, rounding may leave a square negative: b^2 - b may be added as well.
    size = np.einsum("trs,twrtws->tw", np.abs(problem.blocks), np.abs(M)).ravel()
    raised = lifted + np.diag(len(joint) * EPSILON * size)
    coupled = _without_diagonal(raised, _white(problem, joint))
    pull = (lifted - coupled).diagonal().reshape(H, W)
    if problem.pull is not None:
        pull = pull + problem._pulled(problem.pull, problem.mean)
    unit, none = np.tile(np.eye(W), (H, 1, 1)), np.zeros((H, W, W))
    return replace(problem, psi=coupled, mean=unit, variance=none, pull=pull)


def _white(problem: SelectionProblem, joint: Array) -> Array:
    """Guess what the errors that are uncorrelated in time cost each step, flat (HW,).

    That is by how much trace(Psi_tt Cov[e_t, e_t]) exceeds trace(Psi_tt Cov[e_t, e_k]) at all other
    steps k: the cost of the white part exactly, where a persistent bias is the rest.
    """
    H, W, p = problem.mean.shape
    traces = np.einsum("trs,twrkws->wtk", problem.blocks, joint.reshape(2 * (H, W, p)))
    own, same = np.diagonal(traces, axis1=1, axis2=2), np.eye(H, dtype=bool)
    others = np.where(same, 0, np.abs(traces)).max(axis=2)
    return np.asarray(np.maximum(own - others, 0).T.ravel())


def _without_diagonal(S: Array, white: Array) -> Array:
    """Take off the diagonal of S what leaves it semidefinite.

    The largest multiple of the `white` part, or of the diagonal if that is more.
    """
    felt = np.flatnonzero(S.diagonal() > 0)
    own = S.diagonal()[felt]
    A = S[np.ix_(felt, felt)] / np.sqrt(own) / np.sqrt(own)[:, None]
    shares = [_largest_multiple(A, shape) for shape in (white[felt] / own, np.ones(len(felt)))]
    share = np.zeros(len(S))
    share[felt] = max(shares, key=np.sum)
    return S - np.diag(share * S.diagonal())


def _largest_multiple(A: Array, shape: Array) -> Array:
    """Return the largest multiple of `shape` >= 0 that A, of unit diagonal, has on its diagonal.

    With A = LL' and D = diag(shape), A - lam D is semidefinite as long as lam |L^-1 D L^-T| <= 1.
    It must pass without being mended, as that would change what schedules cost: else 0.
    """
    k = len(A)
    if not shape.any():
        return shape
    L = np.linalg.cholesky(A + MATRIX_TOLERANCE * k * np.eye(k))
    G = solve_triangular(L, np.diag(np.sqrt(shape)), lower=True)
    most = shape / np.linalg.eigvalsh(G.T @ G)[-1]
    for lost in SAFETY:
        taken = (1 - lost) * most
        if (taken < 1).all() and judged(A - np.diag(taken))[1] >= -k * EPSILON:
            return np.asarray(taken)
    return 0 * shape
