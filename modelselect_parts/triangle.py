r"""What is left of a schedule's cost after the certificate, in a form that a search can add up.

After the certificate of a point (d, lam) (see trellis.py) a schedule's cost exceeds the bound by

    excess(c) = sum_t r_t[w_t, w_{t+1}] + lam (K - spent(c)) + (mu_c - d)'M(mu_c - d),      r >= 0,

where r is what each move exceeds the cheapest path by.  Factor M = U'U, U upper triangular, and
read from the last step to the first: with e = mu_c - d the quadratic is sum_t |U_tt e_t + y_t|^2,
where the *offset* y_t collects the steps already chosen (Fincke and Pohst 1985).  Offsets lie in a
few directions, as many as the task has states or twice that; `compress` finds them.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import scipy.linalg as la

from modelselect_parts.checks import Array
from modelselect_parts.semidefinite import MATRIX_TOLERANCE
from modelselect_parts.trellis import Certificate, Form, forward

EPS, TINY = float(np.finfo(float).eps), float(np.finfo(float).tiny)


class Triangle(NamedTuple):
    """The excess: constant + sum_t moves[t, w_{t+1}, w_t] + sum_t |U_tt e_t + y_t|^2 + the last.

    A state is the model of the step after; where moves are free there is one state, 0.
    """

    constant: float
    moves: Array  #: (H, states, W), non-negative, inf where the model cannot be of use
    deviation: Array  #: (H, W, p), e[t, w] = mu[t, w] - d_t
    U: Array  #: (pH, pH), upper triangular; of a linear system, of no rows
    size: Array  #: (pH,), the largest |e| of a model that can be of use
    rounding: float  #: of the moves of a schedule, and of U'U
    length: float  #: no schedule's rows U_tt e_t and U_:t e_t are longer, summed over steps


class Purse(NamedTuple):
    """What labels spend; `spend` is None where there is no limit."""

    multiplier: float  #: lam
    spend: Array | None  #: (H, states, W), what a move spends
    ahead: Array | None  #: (H, W), the least that the steps before this one spend
    limit: float
    size: float  #: no schedule within the limit sums more, sizes added
    grain: float  #: how far a sum of what a schedule spends may be off, per step


FREE = Purse(0.0, None, None, math.inf, 0.0, 0.0)


def factor(form: Form, found: Certificate, d: Array, multiplier: float, excess: float) -> Triangle:
    """Factor M + shift = U'U and take the shift out of the nodes again.

    A model is of no use if the cheapest path through it is above `excess`, what the best schedule
    known exceeds `found.base` by; nor is one that errs more than other steps can make up for.
    A diagonal shift s adds sum_i s_i e_i^2, which depends on one step's model only, so it can be
    subtracted there: the sum stays the same, and a singular M has a Cholesky factor.  That lowers
    the constant by a hundredth of the excess at most, plus what rounding needs.
    """
    M, A, node, (H, _, p) = form.matrix, form.priced(multiplier), found.node, form.mean.shape
    useful = (found.reduced + (found.bound - found.base) <= max(excess, 0.0)) & (node < np.inf)
    slack = excess - (found.bound - found.base)
    while True:
        deviation = np.where(useful[..., None], form.mean - d.reshape(H, 1, p), 0)
        size, diagonal = np.abs(deviation).max(axis=1).ravel(), M.diagonal()
        # More than 1e-6 gains nothing: rounding leaves eps / sqrt(1e-6) = 2e-13 of a row in U.
        share = min(1e-6, max(float(slack), 0.0) / 100 / max(float(size**2 @ diagonal), TINY))
        shift = (share + 2 * MATRIX_TOLERANCE * len(diagonal)) * diagonal + TINY
        lent = (shift - form.defect * diagonal).reshape(H, p)  # the rest is off the nodes already
        shifted = node - np.einsum("twi,ti->tw", deviation**2, lent)
        shifted = np.where(useful, shifted, np.inf)
        lowest = shifted.min(axis=1)
        lowest[lowest == np.inf] = 0  # no model is of use: no schedule beats the best known
        left, constant = shifted - lowest[:, None], float(lowest.sum())
        moves, least = (left[:, None], 0.0) if A is None else _moves(left, A)
        constant += least
        U = la.cholesky(M + np.diag(shift))
        # |Ue|^2 <= excess - constant, as what is left of the path is >= 0, and by Cauchy and
        # Schwarz e_i^2 <= |Ue|^2 (U'U)^{-1}_ii; 2 covers rounding for pH up to thousands.
        inverse = la.solve_triangular(U, np.eye(H * p))
        most = 2 * math.sqrt(max(excess - constant, 0.0)) * np.linalg.norm(inverse, axis=1)
        beyond = useful & (np.abs(deviation) > most.reshape(H, 1, p)).any(axis=-1)
        if not beyond.any():
            break
        useful &= ~beyond  # a smaller shift will do
    size = np.minimum(size, most)
    rows = np.abs(U) @ size  # U'U differs from M by (pH + 1) eps/2 |U|'|U| (Higham, theorem 10.3)
    rounding = (p * H + 10) * EPS / 2 * float(rows @ rows)
    rounding += 0.0 if A is None else 8 * H * EPS * (least + max(excess, 0.0))
    return Triangle(constant, moves, deviation, U, size, rounding, float(rows.sum()))


def _moves(node: Array, A: Array) -> tuple[Array, float]:
    """Return what the move from w at t to v at t + 1 exceeds the cheapest path by: [t, v, w].

    F[t, w] + A[w, v] + node[t+1, v] - F[t+1, v]; at the end, F[H-1, w] less the cheapest path.
    """
    with np.errstate(invalid="ignore"):
        F = forward(node, A)
        least = float(F[-1].min())
        least = least if least < np.inf else 0.0
        into = (F[:-1, :, None] + A) + node[1:, None] - F[1:, None]
    last = np.broadcast_to(F[-1] - least, (1, *A.shape))
    moves = np.concatenate([into.swapaxes(1, 2), last])
    return np.where(np.isnan(moves), np.inf, np.maximum(moves, 0)), least


def purse(form: Form, multiplier: float) -> Purse:
    """Return what moves spend, as `_moves` is laid out, and what the rest spends at least."""
    if form.price is None:
        return FREE
    price = np.where(form.linear < np.inf, form.price, np.inf)
    H, W = price.shape
    spend = price[:, None]
    if form.toll is not None:
        tolls = np.concatenate([np.broadcast_to(form.toll.T, (H - 1, W, W)), np.zeros((1, W, W))])
        spend = spend + tolls
    ahead = forward(price, form.toll) - np.where(price < np.inf, price, 0)
    size = abs(form.limit) + 2 * float(np.maximum(-price.min(axis=1), 0).sum()) + TINY
    return Purse(multiplier, spend, ahead, form.limit, size, 4 * EPS * size)


class Coordinates(NamedTuple):
    """Offsets of one step in a basis of the few directions in which they lie."""

    own: Array  #: (q, p), U_tt: e_t -> its share in the rows of step t
    read: Array  #: (q, r'), coordinates of step t+1 -> offset on the rows of step t
    carry: Array  #: (r, r'), coordinates of step t+1 -> those of step t
    push: Array  #: (r, p), e_t -> its share in the coordinates of step t
    reach: float  #: no offset is longer than this
    lost: float = 0.0  #: nor what it has in the directions that were dropped, longer than this


def compress(triangle: Triangle, least: float, expired: Callable[[], bool]) -> list[Coordinates]:
    """Find a basis of the offsets of every step; empty if time is over.

    The offset on the rows before step t lies in the range of U[:tp, tp:].  Its rank is that of
    U[:tp, :tp]'U[:tp, tp:], a block of M, as the shift is diagonal: n or 2n, for Psi of a task with
    n states.  Rounding adds weak directions; those of strength (singular value) at most `least`
    are dropped.  Orthonormal columns keep all distances.  An offset is the basis times strengths
    times a vector of p(H - t) numbers of size 1 at most (`label_search.Losses`).
    """
    U, size, (H, _, p) = triangle.U, triangle.size, triangle.deviation.shape
    steps: list[Coordinates] = [None] * H  # type: ignore[list-item]
    basis = scaled = np.zeros((H * p, 0))
    for t in reversed(range(H)):
        if expired():
            return []
        rows, before = slice(t * p, (t + 1) * p), slice(0, t * p)
        column = U[before, rows]
        wide = np.hstack([scaled[before], column * size[rows]])
        V, strength, _ = np.linalg.svd(wide, full_matrices=False)  # SciPy's refuses no rows
        most, weak = math.sqrt(p * (H - t)), strength <= least
        reach = most * float(strength.max(initial=0))
        lost = most * float(strength[weak].max(initial=0))
        V = V[:, ~weak]
        own, read = U[rows, rows].copy(), basis[rows].copy()
        steps[t] = Coordinates(own, read, V.T @ basis[before], V.T @ column, reach, lost)
        basis, scaled = V, V * strength[: V.shape[1]]
    return steps
