r"""The exact search, on bare arrays: sphere decoding on a trellis, with dominance.

After the certificate of a point d (see trellis.py) what is left of a schedule's cost is

    excess(c) = sum_t r[t, w_t] + (mu_c - d)'M(mu_c - d),      r >= 0,

and a schedule better than the best one known has excess below what that one has.  Factor
M = U'U, U upper triangular, and read from the last step to the first: with e = mu_c - d the
quadratic is sum_t |U_tt e_t + y_t|^2, where the *offset* y_t collects the steps already chosen
(Fincke and Pohst 1985).  A *label* is a partial schedule: its excess so far, its offset on the
rows still to come.  It goes when its excess exceeds the budget, or when a cheaper label near it
*dominates* it (`undominated`).  What remains is a handful of labels, though in the worst case
exponentially many: the problem is NP-hard.

Everything that rounding and shortcuts give away is added up (`Losses`) and taken off the bound,
so what a search claims is a theorem (`search`).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import scipy.linalg as la

from modelselect_parts.checks import MATRIX_TOLERANCE, Array, Choices, Mask

EPS, TINY = float(np.finfo(float).eps), float(np.finfo(float).tiny)


class Triangle(NamedTuple):
    """The excess: constant + sum_t reduced[t, w_t] + sum_t |U_tt e_t + y_t|^2."""

    constant: float
    reduced: Array  #: (H, W), non-negative, inf where the model cannot be of use
    deviation: Array  #: (H, W, p), e[t, w] = mu[t, w] - d_t
    U: Array  #: (pH, pH), upper triangular
    size: Array  #: (pH,), the largest |e| of a model that can be of use


def factor(M: Array, deviation: Array, reduced: Array, excess: float) -> Triangle:
    """Factor M + shift = U'U and take the shift out of the reduced costs again.

    A model whose reduced cost is above `excess`, that of the best schedule known, is of no use;
    nor is one that errs more than any other steps can make up for.
    A diagonal shift s adds sum_i s_i e_i^2, which depends on one step's model only, so it can be
    subtracted there: the sum stays the same, and a singular M has a Cholesky factor.  That lowers
    the constant by a hundredth of the excess at most, plus what rounding needs.
    """
    H, _, p = deviation.shape
    useful = (reduced <= max(excess, 0.0)) & (reduced < np.inf)
    deviation = np.where(useful[..., None], deviation, 0)
    size, diagonal = np.abs(deviation).max(axis=1).ravel(), M.diagonal()
    # More than 1e-6 gains nothing: rounding leaves eps / sqrt(1e-6) = 2e-13 of a row's size in U.
    share = min(1e-6, max(excess, 0.0) / 100 / max(size**2 @ diagonal, TINY))
    shift = (share + 2 * MATRIX_TOLERANCE * len(diagonal)) * diagonal + TINY
    shifted = reduced - np.einsum("twi,ti->tw", deviation**2, shift.reshape(H, p))
    lowest = np.where(useful, shifted, np.inf).min(axis=1)
    lowest[lowest == np.inf] = 0  # no model is of use: no schedule is better than the best known
    U = la.cholesky(M + np.diag(shift))
    # |Ue|^2 <= excess - sum of lowest, as what is left of r is >= 0, and by Cauchy and Schwarz
    # e_i^2 <= |Ue|^2 (U'U)^{-1}_ii; a factor of 2 covers rounding for pH up to thousands.
    inverse = la.solve_triangular(U, np.eye(H * p))
    most = 2 * math.sqrt(max(excess - lowest.sum(), 0.0)) * np.linalg.norm(inverse, axis=1)
    beyond = useful & (np.abs(deviation) > most.reshape(H, 1, p)).any(axis=-1)
    if beyond.any():  # a smaller shift will do
        return factor(M, deviation, np.where(beyond, np.inf, reduced), excess)
    left = np.where(useful, shifted - lowest[:, None], np.inf)
    return Triangle(float(lowest.sum()), left, deviation, U, np.minimum(size, most))


class Coordinates(NamedTuple):
    """Offsets of one step in a basis of the few directions in which they lie."""

    read: Array  #: (p, r'), coordinates of step t+1 -> offset on the rows of step t
    carry: Array  #: (r, r'), coordinates of step t+1 -> those of step t
    push: Array  #: (r, p), e_t -> its share in the coordinates of step t
    reach: float  #: no offset is longer than this


def compress(triangle: Triangle, least: float, expired: Callable[[], bool]) -> list[Coordinates]:
    """Find a basis of the offsets of every step; empty if time is over.

    The offset on the rows before step t lies in the range of U[:tp, tp:].  Its rank is that of
    U[:tp, :tp]'U[:tp, tp:], a block of M, as the shift is diagonal: n or 2n, for Psi of a task with
    n states.  Rounding adds weak directions; those of strength (singular value) at most `least`
    are dropped.  Orthonormal columns keep all distances.
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
        reach = math.sqrt(p * (H - t)) * float(strength.max(initial=0))
        V = V[:, strength > least]
        steps[t] = Coordinates(basis[rows].copy(), V.T @ basis[before], V.T @ column, reach)
        basis, scaled = V, V * strength[: V.shape[1]]
    return steps


# Cells of `undominated`: the root of the budget, halved so often; the last merges equal offsets.
GRIDS = (0, 1, 2, 3, 4, 5, 6, 7, 24)


class Losses(NamedTuple):
    """What one pass gives away, so that its proof is a theorem in spite of it.

    Let Q be the quadratic of a schedule within the budget B, in exact numbers.

    - *Truncation.*  Offsets of step t are (basis times strengths) a with |a|^2 <= p(H - t): true
      at the start, and kept, as a column more appends p entries of size at most 1, and turning
      keeps |a|.  Dropping directions of strength <= least at every step changes the stacked
      residuals U_tt e_t + y_t by a vector of norm x <= H least sqrt(pH): later steps only project
      and cut it, which does not lengthen it.  So Q becomes at most (sqrt(Q) + x)^2 <=
      Q + 2 x sqrt(B) + x^2.
    - *Merging.*  A dominance test may lose `merge`.  A schedule's chain of dominators has one
      link a step and grid at most, as the representative of a cell is not discarded in its own
      pass: at most H len(GRIDS) merge in all, and as many roundings of a test.
    - *Rounding.*  U'U differs from M by (pH + 1) eps/2 |U|'|U| at most (Higham, Accuracy and
      Stability, theorem 10.3).  An offset errs at every step by a few eps of its reach for each
      term that its coordinates sum, those of the basis included, which changes the residuals as
      truncation does.
    """

    budget: float  #: B: labels above it go
    merge: float
    total: float  #: what the bound is lowered by, B less the excess that must be kept


def negligible_strength(triangle: Triangle, excess: float, slack: float) -> float:
    """Return how weak a direction may be dropped, to give away a quarter of the slack or less."""
    H, _, p = triangle.deviation.shape
    root = math.sqrt(excess + slack)
    return slack / 8 / (2 * root * H * math.sqrt(p * H)) if root > 0 else 0.0


def losses(
    triangle: Triangle, steps: list[Coordinates], excess: float, slack: float, least: float
) -> Losses:
    """Return B such that every schedule of up to this excess keeps a representative within B.

    Half the slack is for merging.  Of B itself 2 x sqrt(B) + x^2 is given away, so B must solve
    B = excess + rest + 2 x sqrt(B) + x^2: sqrt(B) = x + sqrt(excess + rest + 2 x^2) does.
    """
    H, _, p = triangle.deviation.shape
    own = np.abs(triangle.U) @ triangle.size
    terms = max((len(step.push) for step in steps), default=0) + p
    lengths = sum(step.reach for step in steps) + float(own.sum())
    x = H * least * math.sqrt(p * H) + 2 * EPS * (p * H + terms + 10) * lengths
    rest = slack / 2 + (p * H + 10) * EPS / 2 * float(own @ own)
    budget = (x + math.sqrt(excess + rest + 2 * x * x)) ** 2
    budget *= 1 + (16 + terms) * EPS * H * (len(GRIDS) + 1)  # the roundings of tests and sums
    return Losses(budget, slack / (2 * H * len(GRIDS)), budget - excess)


def undominated(
    extra: Array, y: Array, budget: float, merge: float, expired: Callable[[], bool]
) -> Mask:
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
        side = math.sqrt(budget) / 2**halvings
        corner = np.floor(y[alive] / side + 0.618 * halvings)  # shifted: cells share no borders
        cell = corner.astype(np.int64).astype(np.uint64) @ hashing
        bits = len(alive).bit_length() + 2
        key = cell >> np.uint64(64 - bits)
        table = np.empty(2**bits, dtype=np.intp)
        table[key[::-1]] = np.arange(len(alive))[::-1]  # of equal keys, the first is written last
        i, j = alive[table[key]], alive
        rho2 = ((y[i] - y[j]) ** 2).sum(axis=1)
        cross = 2 * np.sqrt(rho2) * np.sqrt(np.maximum(budget - extra[j], 0))
        alive = alive[(i == j) | (extra[i] + cross + rho2 > extra[j] + merge)]
    kept = np.zeros(len(extra), dtype=bool)
    kept[alive] = True
    return kept


class Pass(NamedTuple):
    """What one pass found and proved: see `search`."""

    choices: Choices | None  #: (H,), of the least excess among the labels that are left
    least: float  #: the excess of every schedule is at least this
    complete: bool  #: whether no label within the budget was dropped for lack of room
    labels: Choices  #: (H,), labels kept at every step


def search(
    triangle: Triangle,
    steps: list[Coordinates],
    given: Losses,
    width: int,
    expired: Callable[[], bool],
) -> Pass:
    """Keep at most `width` labels a step, from the last step to the first.

    A schedule is over the budget, or descends from a label that was dropped, or has a survivor
    that is no worse, up to the losses: so no schedule's excess is below the least of the three,
    less the losses.  One with a model that `factor` ruled out costs no less than the best schedule
    known then, to which callers limit the claim.  A later pass may reuse the basis: its excess is
    smaller, so no model that it needs was ruled out, and `losses` is given the same `least`.
    """
    _, reduced, deviation, U, _ = triangle
    H, _, p = deviation.shape
    extra, y, dropped = np.zeros(1), np.zeros((1, 0)), math.inf
    trail: list[tuple[Choices, Choices]] = []
    for t in reversed(range(H)):
        step = steps[t]
        models = np.flatnonzero(reduced[t] <= given.budget)
        own = deviation[t, models] @ U[t * p : (t + 1) * p, t * p : (t + 1) * p].T
        felt = ((y @ step.read.T)[:, None] + own) ** 2
        grown = extra[:, None] + reduced[t, models] + felt.sum(axis=-1)
        parent, child = np.nonzero(grown <= given.budget)
        order = np.argsort(grown[parent, child])
        parent, child = parent[order], child[order]
        extra = grown[parent, child]
        y = (y @ step.carry.T)[parent] + (deviation[t, models] @ step.push.T)[child]
        kept = np.flatnonzero(undominated(extra, y, given.budget, given.merge, expired))
        most = min(width, 64) if expired() else width  # out of time: finish on a narrow beam
        if len(kept) > most:
            dropped = min(dropped, float(extra[kept[most]]))
        kept = kept[:most]
        extra, y = extra[kept], y[kept]
        trail.append((parent[kept], models[child[kept]]))
    labels = np.array([len(models) for _, models in reversed(trail)], dtype=np.intp)
    least = min(given.budget, dropped, float(extra.min(initial=math.inf)))
    choices, label = np.empty(H, dtype=np.intp), 0
    for t, (parent, models) in enumerate(reversed(trail) if len(extra) else ()):
        choices[t], label = models[label], parent[label]
    found = choices if len(extra) else None
    return Pass(found, triangle.constant + least - given.total, dropped == math.inf, labels)
