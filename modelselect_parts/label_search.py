r"""The exact search, on bare arrays: sphere decoding on a trellis, with dominance.

After the certificate of a point (d, lam) (see trellis.py) what is left of a schedule's cost is

    excess(c) = sum_t r_t[w_t, w_{t+1}] + lam (K - spent(c)) + (mu_c - d)'M(mu_c - d),      r >= 0,

where r is what each move exceeds the cheapest path by.  A schedule better than the best one known
has excess below what that one has.  Factor M = U'U, U upper triangular, and read from the last
step to the first: with e = mu_c - d the quadratic is sum_t |U_tt e_t + y_t|^2, where the *offset*
y_t collects the steps already chosen (Fincke and Pohst 1985).  A *label* is a partial schedule: its
excess so far, its offset on the rows still to come, its model where moves cost something, what it
has spent where there is a limit.  It goes when its excess exceeds the budget, when it cannot keep
the limit, or when a cheaper label near it *dominates* it (`undominated`).  What remains is a few
labels, though in the worst case exponentially many: the problem is NP-hard.

Everything that rounding and shortcuts give away is added up (`Losses`) and taken off the bound,
so what a search claims is a theorem (`search`).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import scipy.linalg as la

from modelselect_parts.checks import Array, Choices, Mask
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
    U: Array  #: (pH, pH), upper triangular
    size: Array  #: (pH,), the largest |e| of a model that can be of use
    rounding: float  #: of the moves of a schedule


class Purse(NamedTuple):
    """What labels spend; `spend` is None where there is no limit."""

    multiplier: float  #: lam
    spend: Array | None  #: (H, states, W), what a move spends
    ahead: Array | None  #: (H, W), the least that the steps before this one spend
    limit: float
    size: float  #: the most that a schedule might spend
    grain: float  #: a label may spend so much more than one that it makes superfluous


FREE = Purse(0.0, None, None, math.inf, 0.0, 0.0)


def factor(form: Form, found: Certificate, d: Array, multiplier: float, excess: float) -> Triangle:
    """Factor M + shift = U'U and take the shift out of the nodes again.

    A model is of no use if the cheapest path through it is above `excess`, what the best schedule
    known exceeds `found.base` by; nor is one that errs more than other steps can make up for.
    A diagonal shift s adds sum_i s_i e_i^2, which depends on one step's model only, so it can be
    subtracted there: the sum stays the same, and a singular M has a Cholesky factor.  That lowers
    the constant by a hundredth of the excess at most, plus what rounding needs.
    """
    M, A, node, (H, _, p) = form.M, form.priced(multiplier), found.node, form.mean.shape
    useful = (found.reduced + (found.bound - found.base) <= max(excess, 0.0)) & (node < np.inf)
    slack = excess - (found.bound - found.base)
    while True:
        deviation = np.where(useful[..., None], form.mean - d.reshape(H, 1, p), 0)
        size, diagonal = np.abs(deviation).max(axis=1).ravel(), M.diagonal()
        # More than 1e-6 gains nothing: rounding leaves eps / sqrt(1e-6) = 2e-13 of a row in U.
        share = min(1e-6, max(slack, 0.0) / 100 / max(size**2 @ diagonal, TINY))
        shift = (share + 2 * MATRIX_TOLERANCE * len(diagonal)) * diagonal + TINY
        shifted = node - np.einsum("twi,ti->tw", deviation**2, shift.reshape(H, p))
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
    rounding = 0.0 if A is None else 8 * H * EPS * (least + max(excess, 0.0))
    return Triangle(constant, moves, deviation, U, np.minimum(size, most), rounding)


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
    largest = np.abs(form.price).max(axis=1).sum()
    largest += 0.0 if form.toll is None else H * form.toll.max()
    size = float(largest) + TINY
    return Purse(multiplier, spend, ahead, form.limit, size, 4 * EPS * size)


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
# And, where there is a limit: shares of it, from equal spending to any.
SHARES = (1e-12, 1e-3, 8e-3, 1e3)


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
      pass: at most H tests merge in all, and as many roundings of a test.  Where there is a limit,
      a dominator may spend a grain more: H tests grains in all, at the price lam.
    - *Rounding.*  U'U differs from M by (pH + 1) eps/2 |U|'|U| at most (Higham, Accuracy and
      Stability, theorem 10.3).  An offset errs at every step by a few eps of its reach for each
      term that its coordinates sum, those of the basis included, which changes the residuals as
      truncation does.
    """

    budget: float  #: B: labels above it go
    merge: float
    grains: float  #: what dominators may spend more, in all
    total: float  #: what the bound is lowered by, B less the excess that must be kept


def negligible_strength(triangle: Triangle, excess: float, slack: float) -> float:
    """Return how weak a direction may be dropped, to give away a quarter of the slack or less."""
    H, _, p = triangle.deviation.shape
    root = math.sqrt(excess + slack)
    return slack / 8 / (2 * root * H * math.sqrt(p * H)) if root > 0 else 0.0


def losses(
    triangle: Triangle,
    steps: list[Coordinates],
    purse: Purse,
    excess: float,
    slack: float,
    least: float,
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
    rest = slack / 2 + (p * H + 10) * EPS / 2 * float(own @ own) + triangle.rounding
    tests = len(GRIDS) * (1 if purse.spend is None else len(SHARES))
    grains = H * (tests + 1) * purse.grain
    rest += purse.multiplier * grains
    budget = (x + math.sqrt(excess + rest + 2 * x * x)) ** 2
    budget *= 1 + (16 + terms) * EPS * H * (tests + 1)  # the roundings of tests and sums
    return Losses(budget, slack / (2 * H * tests), grains, budget - excess)


def undominated(
    extra: Array,
    y: Array,
    budget: float,
    merge: float,
    expired: Callable[[], bool],
    state: Choices | None = None,
    spent: Array | None = None,
    purse: Purse = FREE,
) -> Mask:
    """Mark the labels, sorted by extra cost, that no cheaper label nearby makes superfluous.

    Let i, j be labels at distance rho = |y_i - y_j|.  A completion costs them |v + y_i|^2 and
    |v + y_j|^2 plus the same moves, and a completion of j within the budget has
    |v + y_j|^2 <= budget - extra_j.  Since |v + y_i| <= |v + y_j| + rho, i is never worse if

        extra_i + 2 rho sqrt(budget - extra_j) + rho^2 <= extra_j    (or exceeds it by `merge`).

    Where moves cost something both must be in one `state`.  Where there is a limit i must not
    have spent more, and extra - lam spent takes the place of extra: the rest of what they may spend
    is paid for at the end.

    Any label may be tested against any cheaper one; we test against the cheapest label of the
    same grid cell, for cells of several sizes, of offsets and of spending.  A cell's corner is
    hashed by multiplying with powers of an odd number (2^64 over the golden ratio); its top bits
    index a table.  Cells that share an entry do no harm, as the test itself is exact.
    """
    alive = np.arange(len(extra))
    hashing = np.cumprod(np.full(y.shape[1] + 2, 0x9E3779B97F4A7C15, dtype=np.uint64))
    paid = extra if spent is None else extra - purse.multiplier * spent
    for halvings in GRIDS:
        if len(alive) < 2 or expired():
            break
        side = math.sqrt(budget) / 2**halvings
        corner = np.floor(y[alive] / side + 0.618 * halvings)  # shifted: cells share no borders
        cell = corner.astype(np.int64).astype(np.uint64) @ hashing[:-2]
        if state is not None:
            cell = cell + state[alive].astype(np.uint64) * hashing[-2]
        for share in SHARES if spent is not None else (0.0,):
            key = cell
            if spent is not None:
                bucket = np.floor(spent[alive] / (share * purse.size) + 0.5)
                key = cell + bucket.astype(np.int64).astype(np.uint64) * hashing[-1]
            bits = len(alive).bit_length() + 2
            key = (key * hashing[0] if spent is not None else key) >> np.uint64(64 - bits)
            table = np.empty(2**bits, dtype=np.intp)
            table[key[::-1]] = np.arange(len(alive))[::-1]  # of equal keys, the first stays
            i, j = alive[table[key]], alive
            rho2 = ((y[i] - y[j]) ** 2).sum(axis=1)
            cross = 2 * np.sqrt(rho2) * np.sqrt(np.maximum(budget - extra[j], 0))
            keep = (i == j) | (paid[i] + cross + rho2 > paid[j] + merge)
            if state is not None:
                keep |= state[i] != state[j]
            if spent is not None:
                keep |= spent[i] > spent[j] + purse.grain
            alive, cell = alive[keep], cell[keep]
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
    purse: Purse,
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
    moves, deviation, U = triangle.moves, triangle.deviation, triangle.U
    (H, states, _), p, limited = moves.shape, deviation.shape[2], purse.spend is not None
    extra, y, dropped = np.zeros(1), np.zeros((1, 0)), math.inf
    state, spent = np.zeros(1, dtype=np.intp), np.zeros(1)
    trail: list[tuple[Choices, Choices]] = []
    for t in reversed(range(H)):
        step = steps[t]
        models = np.flatnonzero(moves[t].min(axis=0) <= given.budget)
        own = deviation[t, models] @ U[t * p : (t + 1) * p, t * p : (t + 1) * p].T
        felt = ((y @ step.read.T)[:, None] + own) ** 2
        move = moves[t][:, models][state] if states > 1 else moves[t, 0, models]
        grown = extra[:, None] + move + felt.sum(axis=-1)
        within = grown <= given.budget
        if purse.spend is not None and purse.ahead is not None:
            spend = purse.spend[t, :, models].T
            total = spent[:, None] + (spend[state] if len(spend) > 1 else spend)
            within &= total + purse.ahead[t, models] <= purse.limit + given.grains
        parent, child = np.nonzero(within)
        order = np.argsort(grown[parent, child])
        parent, child = parent[order], child[order]
        extra = grown[parent, child]
        y = (y @ step.carry.T)[parent] + (deviation[t, models] @ step.push.T)[child]
        state = models[child] if states > 1 else np.zeros(len(child), dtype=np.intp)
        spent = total[parent, child] if limited else spent
        who = (state if states > 1 else None, spent if limited else None, purse)
        kept = np.flatnonzero(undominated(extra, y, given.budget, given.merge, expired, *who))
        most = min(width, 64) if expired() else width  # out of time: finish on a narrow beam
        if len(kept) > most:
            dropped = min(dropped, float(extra[kept[most]]))
        kept = kept[:most]
        extra, y, state = extra[kept], y[kept], state[kept]
        spent = spent[kept] if limited else spent
        trail.append((parent[kept], models[child[kept]]))
    labels = np.array([len(models) for _, models in reversed(trail)], dtype=np.intp)
    if limited:  # what is left of the limit is paid for; those a grain over it prove, and are none
        extra = extra + purse.multiplier * np.maximum(purse.limit - spent, 0)
        extra_of_legal = np.where(spent <= purse.limit, extra, math.inf)
    least = min(given.budget, dropped, float(extra.min(initial=math.inf)))
    final = extra_of_legal if limited else extra
    found = bool((final < math.inf).any())
    choices, label = np.empty(H, dtype=np.intp), int(final.argmin()) if found else 0
    for t, (parent, models) in enumerate(reversed(trail) if found else ()):
        choices[t], label = models[label], parent[label]
    least += triangle.constant - given.total
    return Pass(choices if found else None, least, dropped == math.inf, labels)
