r"""The certificate, on bare arrays: what no schedule can cost less than, and why.

A schedule c names a model for each of H steps.  With M = alpha Psi, positive semidefinite, means
mu (H, W, p), linear costs l (H, W) and costs arc[v, w] of going from model v to model w it costs

    total(c) = mu_c'M mu_c + sum_t l[t, w_t] + sum_t arc[w_{t-1}, w_t],

and it spends spent(c) = sum_t price[t, w_t] + sum_t toll[w_{t-1}, w_t], no more than a limit K.
Take any point d (pH,) and any multiplier lam >= 0.  As x'Mx = 2 x'Md - d'Md + (x - d)'M(x - d),
with G[t, w] = 2 mu[t, w]'(M d)_t + l[t, w] + lam price[t, w] and A = arc + lam toll,

    total(c) = LB(d, lam) + (path of c - cheapest path) + lam (K - spent(c)) + (mu_c-d)'M(mu_c-d),
    LB(d, lam) = cheapest path of nodes G and arcs A - d'Md - lam K.

Nothing after LB is negative, so LB bounds every schedule: any (d, lam) is a proof, a good one
tight.  Who found it does not matter.  Without arcs the cheapest path is sum_t min_w G[t, w].

>>> M, mean, linear = np.array([[2.0]]), np.array([[[1.0], [-1.0]]]), np.array([[0.0, 1.0]])
>>> form = Form(M, mean, linear, linear)
>>> found = certificate(form, d=np.array([0.25]))
>>> found.bound, found.reduced  # the models cost 2 = -0.125 + 1 + 1.125, 3 = -0.125 + 0 + 3.125
(-0.125, array([[1., 0.]]))
"""

from __future__ import annotations

import math
from collections.abc import Callable
from fractions import Fraction
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import scipy.linalg as la

from modelselect_parts.checks import Array, Choices

EPS: float = float(np.finfo(float).eps)


class Form(NamedTuple):
    """The selection problem on bare arrays."""

    M: Array  #: (pH, pH), positive semidefinite
    mean: Array  #: (H, W, p)
    linear: Array  #: (H, W), inf where a model is not available
    size: Array  #: (H, W), the sizes of the terms that `linear` was summed from
    arc: Array | None = None  #: (W, W), from row to column, >= 0; None: moves are free
    price: Array | None = None  #: (H, W), finite; None: no limit
    toll: Array | None = None  #: (W, W), what moves spend; None where arc is
    limit: float = math.inf  #: the most that a schedule may spend

    @property
    def bare(self) -> bool:
        """Whether steps are independent but for M: no arcs, no limit."""
        return self.arc is None and self.price is None

    def priced(self, multiplier: float) -> Array | None:
        """Return A = arc + lam toll, (W, W)."""
        if self.arc is None or self.toll is None or not multiplier:
            return self.arc
        return self.arc + multiplier * self.toll


class Certificate(NamedTuple):
    """LB(d, lam), and what it says of single models."""

    bound: float
    reduced: Array  #: (H, W), >= 0: every schedule with model w at step t costs so much more
    base: float  #: `bound` = base + cheapest path of `node` and A = `Form.priced`
    node: Array  #: (H, W), G less each step's least


# ------------------------------------------------------------------------------ cheapest paths


def forward(node: Array, arc: Array | None) -> Array:
    """Return F[t, w], the cheapest path that ends with model w at step t (Viterbi): O(H W^2)."""
    if arc is None:
        before = np.cumsum(node.min(axis=1)) - node.min(axis=1)
        return np.asarray(before[:, None] + node)
    F = node.copy()
    for t in range(1, len(node)):
        F[t] += (F[t - 1][:, None] + arc).min(axis=0)
    return F


def through(node: Array, arc: Array | None) -> Array:
    """Return what the cheapest path with model w at step t costs, (H, W)."""
    if arc is None:
        lowest = node.min(axis=1)
        return np.asarray(node + (lowest.sum() - lowest)[:, None])
    both = forward(node, arc) + forward(node[::-1], arc.T)[::-1]
    return np.asarray(both - np.where(node < np.inf, node, 0))


def cheapest_path(node: Array, arc: Array | None) -> Choices:
    """Return a schedule of least sum of nodes and arcs, (H,)."""
    if arc is None:
        return np.asarray(node.argmin(axis=1))
    F, c = forward(node, arc), np.empty(len(node), dtype=np.intp)
    c[-1] = F[-1].argmin()
    for t in reversed(range(len(node) - 1)):
        c[t] = (F[t] + arc[:, c[t + 1]]).argmin()
    return c


def path_sum(node: Array, arc: Array | None, c: Choices) -> Any:
    """Return the sum of nodes and arcs of schedules c (..., H)."""
    total = node[np.arange(len(node)), c].sum(axis=-1)
    return total if arc is None else total + arc[c[..., :-1], c[..., 1:]].sum(axis=-1)


# ------------------------------------------------------------------------------ the certificate


def slopes(form: Form, d: Array, multiplier: float = 0.0) -> tuple[Array, float]:
    """G (H, W) less each step's least l, and what is missing for LB: the least l, -d'Md, -lam K.

    Leaving out the least l first saves the digits that a large common price would cost.
    """
    M, mean, linear = form.M, form.mean, form.linear
    pull, cheapest = M @ d, linear.min(axis=1)
    H, _, p = mean.shape
    G = 2 * np.einsum("twi,ti->tw", mean, pull.reshape(H, p)) + (linear - cheapest[:, None])
    constant = float(cheapest.sum() - d @ pull)
    if multiplier and form.price is not None:
        G, constant = G + multiplier * form.price, constant - multiplier * form.limit
    return G, constant


def rounding_unit(M: Array, mean: Array) -> float:
    """How far rounding moves a total, a bound or an entry of G, as a share of the terms summed.

    Sums of k terms err by at most k half units in the last place of the sum of their sizes, and
    nested sums of k and l terms by k + l: x'Mx nests two of pH.
    """
    H, _, p = mean.shape
    return float(2 * len(M) + H + 2 * p + 10) * EPS / 2


def certificate(form: Form, d: Array, multiplier: float = 0.0) -> Certificate:
    """LB(d, lam), from which all that rounding may have added has been taken away.

    Where terms cancel, the bound is low, not wrong: with path(c) of `node` and A = form.priced,
    total(c) >= base + path(c) + lam (K - spent(c)) + (mu_c - d)'M(mu_c - d) holds of exact numbers.
    """
    M, mean, linear = form.M, form.mean, form.linear
    unit, (H, _, p) = rounding_unit(M, mean), mean.shape
    A, price = form.priced(multiplier), 0.0 if form.price is None else multiplier * form.price
    with np.errstate(over="ignore", invalid="ignore"):
        G, constant = slopes(form, d, multiplier)
        felt = np.abs(M) @ np.abs(d)
        size = 2 * np.einsum("twi,ti->tw", np.abs(mean), felt.reshape(H, p)) + form.size
        G = np.where(np.isfinite(linear), G - unit * (size + np.abs(price)), np.inf)
        lowest = G.min(axis=1)
        common = np.abs(linear.min(axis=1)).sum() + np.abs(lowest).sum()
        if multiplier and form.price is not None:
            common += multiplier * abs(form.limit)
        base = lowest.sum() + constant - unit * (np.abs(d) @ felt + common)
        node = G - lowest[:, None]
        if A is None:
            return Certificate(float(base), node, float(base), node)
        paths = through(node, A)
        least = paths[-1].min()  # a sum of 2H non-negative numbers, each of a few roundings
        bound = base + least * (1 - (2 * len(node) + 8) * EPS) - EPS * abs(base)
    return Certificate(float(bound), np.maximum(paths - least, 0), float(base), node)


def relaxed(form: Form, b: Array) -> tuple[float, float, Array]:
    """Evaluate d'M d + l.b at d_t = sum_w b[t, w] mu[t, w]: value, LB(d) and G; no arcs, no limit.

    G is the gradient, but for a constant in each row, which does not matter on the simplex.
    The value is LB(d) + sum r.b, so at weights that touch only the least r it meets its bound.
    """
    G, constant = slopes(form, mixed(form.mean, b))
    lowest = G.min(axis=1)
    bound = lowest.sum() + constant
    surplus = np.where(b > 0, G - lowest[:, None], 0)
    return float(bound + (surplus * b).sum()), float(bound), G


def mixed(mean: Array, b: Array) -> Array:
    """Return the mean error d (pH,) of weights b (H, W)."""
    return np.asarray(np.einsum("tw,twi->ti", b, mean).ravel())


# --------------------------------------------------------------------------- column generation


class Columns(NamedTuple):
    """A point of the relaxation over mixtures of whole schedules."""

    weights: Array  #: (H, W), what share of the mixture runs each model
    reference: Array  #: (pH,), the mixture's mean error
    multiplier: float  #: lam
    value: float  #: the least value of a mixture that was found
    iterations: int


def columns(
    form: Form,
    closed: Callable[[float, float], bool],
    *,
    ceiling: float,
    time_left: Callable[[], float],
    max_iterations: int,
) -> Columns | None:
    """Relax by column generation (Dantzig and Wolfe 1960; von Hohenbalken 1977).

    Keep a few schedules.  The *master* minimises the cost over their mixtures, of spending within
    the limit; at its optimum the mean error is d, and the price of the limit lam.  The cheapest
    path at these prices gives LB(d, lam): it proves the mixture best, or is the next schedule.
    None if no schedule keeps the limit.
    """
    M, mean, usable, (H, W, _) = form.M, form.mean, form.linear < np.inf, form.mean.shape
    steps, limited = np.arange(H), form.price is not None
    price, toll = np.zeros((H, W)) if form.price is None else form.price, form.toll
    spend, arc = (np.where(usable, price, np.inf), toll) if limited else (form.linear, form.arc)
    least = cheapest_path(spend, arc)
    if path_sum(price, toll, least) > form.limit:
        return None
    kept, best, value, k = least[None], None, math.inf, 0
    bound = -math.inf
    for k in range(1, max_iterations + 1):
        mu = mean[steps, kept].reshape(len(kept), -1)
        cost = path_sum(form.linear, form.arc, kept)
        x, lam = master(mu @ M @ mu.T, cost, path_sum(price, toll, kept), form.limit)
        d, b = x @ mu, np.zeros((H, W))
        np.add.at(b, (steps, kept), x[:, None])
        value = min(value, float(d @ M @ d + cost @ x))
        G, constant = slopes(form, d, lam)
        path = cheapest_path(G, form.priced(lam))
        found = constant + float(path_sum(G, form.priced(lam), path))
        if best is None or found > bound:
            bound, best = found, Columns(b, d, lam, value, k)
        if closed(value, bound) or bound > ceiling or time_left() <= 0:
            break
        kept = np.vstack([kept[(x > 0) | (np.arange(len(kept)) == 0)], path])
    assert best is not None
    return best._replace(value=value, iterations=k)


def master(G: Array, cost: Array, spent: Array, limit: float) -> tuple[Array, float]:
    """Minimise x'Gx + cost'x over x >= 0, sum x = 1, spent'x <= limit; return x and lam.

    Mehrotra's method on v = (x, slack): 2Gv + q = E'y + z, Ev = f, v z = tau -> 0.  The multiplier
    of the limit is that of its row of E.
    """
    k, limited = len(cost), limit < math.inf
    scale = max(np.ptp(cost), np.abs(G).max()) or 1.0
    unit = (max(np.abs(spent).max(), abs(limit)) if limited else 0.0) or 1.0
    P, q = np.zeros((k + limited, k + limited)), np.zeros(k + limited)
    P[:k, :k], q[:k] = 2 * G / scale, (cost - cost.min()) / scale
    E, f = np.zeros((1 + limited, k + limited)), np.ones(1 + limited)
    E[0, :k] = 1
    v, y = np.full(k + limited, 1 / k), np.zeros(1 + limited)
    if limited:
        E[1, :k], E[1, k], f[1] = spent / unit, 1, limit / unit
        v[k] = max(f[1] - E[1, :k] @ v[:k], 0.1)
    z = np.maximum(P @ v + q, 0.1)
    for _ in range(80):
        tau, dual, primal = float(v @ z) / len(v), E.T @ y + z - P @ v - q, f - E @ v
        if tau < 1e-15:
            break
        try:
            direction = _newton(P, E, dual, primal, v, z)
        except la.LinAlgError:
            break
        dv, dy, dz = direction(-v * z)
        step = _inside(v, dv, z, dz)
        left = float((v + step * dv) @ (z + step * dz)) / len(v)
        dv, dy, dz = direction((left / tau) ** 3 * tau - v * z - dv * dz)
        step = 0.995 * _inside(v, dv, z, dz)
        v, y, z = v + step * dv, y + step * dy, z + step * dz
    x = np.where(v[:k] > 1e-11, v[:k], 0)
    return x / x.sum(), max(0.0, -float(y[1]) * scale / unit) if limited else 0.0


def _newton(
    P: Array, E: Array, dual: Array, primal: Array, v: Array, z: Array
) -> Callable[[Array], tuple[Array, Array, Array]]:
    """Return r -> dv, dy, dz with P dv - E'dy - dz = dual, E dv = primal, z dv + v dz = r."""
    system = la.cho_factor(P + np.diag(z / v))
    back = la.cho_solve(system, E.T)
    small = la.cho_factor(E @ back)

    def direction(r: Array) -> tuple[Array, Array, Array]:
        a = la.cho_solve(system, dual + r / v)
        dy = la.cho_solve(small, primal - E @ a)
        dv = a + back @ dy
        return dv, dy, (r - z * dv) / v

    return direction


def _inside(v: Array, dv: Array, z: Array, dz: Array) -> float:
    """Return the longest step up to 1 that keeps v and z positive."""
    return min(1.0, 1 / max(float((-dv / v).max()), float((-dz / z).max()), 1e-300))


# -------------------------------------------------------------------------------- local search


def moved(node: Array, arc: Array | None, c: Choices) -> Array:
    """Return what changing w_t to w changes in the sum of nodes and arcs, (H, W)."""
    change = node - node[np.arange(len(node)), c][:, None]
    if arc is not None:
        now = arc[c[:-1], c[1:]][:, None]
        change[1:] += arc[c[:-1]] - now
        change[:-1] += arc[:, c[1:]].T - now
    return np.asarray(change)


def swap(
    form: Form, choices: Choices, noise: float, time_left: Callable[[], float]
) -> tuple[Choices, int]:
    """Take the best single swap while it helps by more than `noise`; return choices and count.

    Step t moves by D = mu[t, w] - mu[t, w_t], and mu_c'M mu_c by 2 D'(M mu_c)_t + D'M_tt D.  Over
    the limit, the swap that costs least per unit saved comes first.
    """
    M, mean, (H, _, p), c, swaps = form.M, form.mean, form.mean.shape, choices.copy(), 0
    steps = np.arange(H)
    pull, blocks = M @ mean[steps, c].ravel(), M.reshape(H, p, H, p)[steps, :, steps]
    while time_left() > 0 and swaps < 100 * H:  # rounding that runs in circles comes to an end
        D = mean - mean[steps, c][:, None]
        change = 2 * np.einsum("twi,ti->tw", D, pull.reshape(H, p))
        change += np.einsum("twi,tij,twj->tw", D, blocks, D)
        change = score = change + moved(form.linear, form.arc, c)
        over = False
        if form.price is not None:
            spent = path_sum(form.price, form.toll, c)
            more, over = moved(form.price, form.toll, c), bool(spent > form.limit)
            if over:
                score = np.full_like(change, np.inf)
                np.divide(np.maximum(change, 0), -more, out=score, where=more < 0)
            score = np.where(over | (spent + more <= form.limit), score, np.inf)
        t, w = np.unravel_index(score.argmin(), score.shape)
        if not (score[t, w] < np.inf if over else score[t, w] < -noise):
            break
        pull += M[:, t * p : (t + 1) * p] @ (mean[t, w] - mean[t, c[t]])
        c[t], swaps = w, swaps + 1
    return c, swaps


def swap_blocks(
    form: Form, choices: Choices, noise: float, time_left: Callable[[], float]
) -> tuple[Choices, int]:
    """Take the best change of an interval of steps to one model while it helps; count them.

    Where moves cost something, changing one step alone pays two of them.  With D the change of the
    mean error and C the sums of D_t'M_ts D_s over all earlier t and s, the interval from a to b
    changes mu_c'M mu_c by what lies between four corners of C, plus 2 D'M mu_c.
    """
    (H, W, _), c, count = form.mean.shape, choices.copy(), 0
    while time_left() > 0 and count < 10 * H:
        best = min(((*_best_interval(form, c, w), w) for w in range(W)), key=lambda found: found[0])
        change, first, last, w = best
        if not change < -noise:
            break
        c[first : last + 1], count = w, count + 1
    return c, count


def _best_interval(form: Form, c: Choices, w: int) -> tuple[float, int, int]:
    """Return the change, first and last step of the best interval to change to model w."""
    H, _, p = form.mean.shape
    steps, now = np.arange(H), form.mean[np.arange(H), c]
    D = form.mean[:, w] - now
    felt = (form.M @ now.ravel()).reshape(H, p)
    coupled = np.einsum("ti,tisj,sj->ts", D, form.M.reshape(H, p, H, p), D)
    corner = np.pad(coupled.cumsum(axis=0).cumsum(axis=1), ((1, 0), (1, 0)))
    change = corner.diagonal()[None, 1:] - corner[:-1, 1:] - corner[1:, :-1].T
    change = change + corner.diagonal()[:-1, None] + _interval_sum(2 * (D * felt).sum(axis=1))
    change += _of_interval(form.linear, form.arc, c, w)
    legal = steps[:, None] <= steps
    if form.price is not None:
        more = _of_interval(form.price, form.toll, c, w)
        legal &= path_sum(form.price, form.toll, c) + more <= form.limit
    change = np.where(legal, change, np.inf)
    first, last = np.unravel_index(change.argmin(), change.shape)
    return float(change[first, last]), int(first), int(last)


def _interval_sum(values: Array) -> Array:
    """Return the sum from step a to step b, [a, b]."""
    total = np.append(0.0, values.cumsum())
    return np.asarray(total[None, 1:] - total[:-1, None])


def _of_interval(node: Array, arc: Array | None, c: Choices, w: int) -> Array:
    """Return what model w from step a to step b changes in the sum of nodes and arcs, [a, b]."""
    steps, missing = np.arange(len(node)), np.isinf(node[:, w])
    change = _interval_sum(np.where(missing, 0, node[:, w] - node[steps, c]))
    if arc is not None:
        old = arc[c[:-1], c[1:]]
        change -= _interval_sum(np.append(0.0, old)) - np.append(0.0, old)[:, None]  # inside
        change += np.append(0.0, arc[c[:-1], w] - old)[:, None]
        change += np.append(arc[w, c[1:]] - old, 0.0)
    return np.where(_interval_sum(missing * 1.0) > 0, np.inf, change)


# -------------------------------------------------------------------------- exact arithmetic


def as_integers(array: Array) -> tuple[npt.NDArray[Any], int]:
    """Write finite floats as integers over one common denominator, exactly."""
    ratios = [x.as_integer_ratio() for x in np.ravel(array).tolist()]
    common = max(d for _, d in ratios)  # a power of two, as all are
    whole = np.array([n * (common // d) for n, d in ratios], dtype=object)
    return whole.reshape(np.shape(array)), common


def exact_form(M: Array, x: Array) -> Fraction:
    """Return x'M x of these very floats, in rational arithmetic."""
    (numbers, common), (vector, scale) = as_integers(M), as_integers(x)
    return Fraction(vector @ numbers @ vector, common * scale**2)


def exact_product(A: Array, B: Array) -> Fraction:
    """Return the sum of A * B, entry by entry, of these very floats, in rational arithmetic."""
    (left, common), (right, scale) = as_integers(A), as_integers(B)
    return Fraction((left * right).sum(), common * scale)
