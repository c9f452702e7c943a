r"""The relaxation by Newton's method, on bare arrays: about ten steps, however stiff M.

Minimise f(b) = d'M d + l.b over weights b (H, W), each row on the simplex, d_t = sum_w b mu.
With the gradient G(b) and a price y_t for each row, optimal weights and slacks z = G - y satisfy
b z = 0, b, z >= 0, sum_w b = 1.  A primal-dual method starts inside and follows b z = tau to
tau = 0 (Mehrotra's predictor and corrector, SIAM J. Optim. 2, 1992).

Newton's equations, with dz = 2 mu'v - dy, v = M dd, dd = sum_w mu db and sum_w db = 0:

    z db + b dz = tau - b z.

Eliminating db and dy leaves dd = a - 2 S v, with S_t = F_t F_t' the scatter of mu[t] under
weights b/z; hence one positive definite system (I + 2 F'MF) x = F'M a and v = M(a - 2 F x): of
size pH, not HW.
"""

from __future__ import annotations

from collections.abc import Callable
from time import perf_counter

import numpy as np
from scipy.linalg import LinAlgError

from modelselect_parts.checks import Array, Mask
from modelselect_parts.semidefinite import cholesky_solver, semidefinite_root

# An evaluation of f: weights -> value, lower bound, gradient G (infinite where not allowed).
Evaluate = Callable[[Array], tuple[float, float, Array]]


def interior_point(
    M: Array,
    mean: Array,
    allowed: Mask,
    evaluate: Evaluate,
    closed: Callable[[float, float], bool],
    *,
    ceiling: float,
    time_left: Callable[[], float],
    max_iterations: int,
) -> tuple[Array, int]:
    """Return the weights of the smallest gap, over `allowed` models (H, W), and the steps taken.

    Stops where closed(value, bound), where the bound exceeds `ceiling`, where rounding has the
    upper hand, and before a step that would last longer than the time left.
    """
    p = mean.shape[2]
    free = np.flatnonzero(allowed.sum(axis=1) > 1)
    index = (free[:, None] * p + np.arange(p)).ravel()
    M, mean, inside = M[np.ix_(index, index)], mean[free], allowed[free]

    weights = best = allowed / allowed.sum(axis=1, keepdims=True)
    value, bound, G = evaluate(weights)
    gap, its_bound, tau = value - bound, bound, np.inf
    lasted = 1e-10 * len(M) ** 3  # seconds: a guess at the first step
    lowest = G[free].min(axis=1)  # slacks z = G - y: what G exceeds its least by, plus a margin
    y = lowest - np.where(inside, G[free] - lowest[:, None], 0).sum() / max(len(free), 1)
    for iteration in range(max_iterations):
        done = not free.size or closed(value, bound) or its_bound > ceiling
        if done or time_left() <= lasted:
            return best, iteration
        started = perf_counter()
        b, z = weights[free], np.where(inside, G[free] - y[:, None], 1)
        tau, previous = float((b * z)[inside].mean()), tau
        if not (tau < previous and z.min() > 1e-280):
            return best, iteration  # rounding, or underflow, has the upper hand
        try:
            db, dy = _newton_step(M, mean, inside, b, z)
        except LinAlgError:
            return best, iteration
        weights = weights.copy()
        weights[free] = np.maximum(b + db, 0)
        weights[free] /= weights[free].sum(axis=1, keepdims=True)
        value, bound, G = evaluate(weights)
        lowest = G[free].min(axis=1)  # rounding must not close z
        y = np.minimum(y + dy, lowest - np.maximum(1e-3 * tau, 1e-15 * np.abs(lowest)))
        if value - bound < gap:
            best, gap, its_bound = weights, value - bound, bound
        lasted = perf_counter() - started
    return best, max_iterations


def congruence(F: Array, M: Array) -> Array:
    """F'MF for symmetric M (pk, pk) and block-diagonal F, given by its blocks (k, p, p)."""
    k, p, _ = F.shape

    def halfway(X: Array) -> Array:
        return np.asarray(np.matmul(np.swapaxes(F, 1, 2), X.reshape(k, p, -1)).reshape(k * p, -1))

    return halfway(halfway(M).T)


def _newton_step(M: Array, mu: Array, inside: Mask, b: Array, z: Array) -> tuple[Array, Array]:
    """Predictor and corrector: db and dy, cut so that b and z stay positive."""
    k, _, p = mu.shape
    w = b / z
    total = w.sum(axis=1)
    D = mu - (np.einsum("tw,twi->ti", w, mu) / total[:, None])[:, None]
    F = semidefinite_root(np.einsum("twi,twj->tij", w[..., None] * D, D))
    system = cholesky_solver(np.eye(k * p) + 2 * congruence(F, M))

    def direction(r: Array) -> tuple[Array, Array, Array]:
        rate = np.where(inside, r / z, 0)
        a = np.einsum("tw,twi->ti", rate - w * (rate.sum(axis=1) / total)[:, None], mu)
        x = system(np.einsum("tij,ti->tj", F, (M @ a.ravel()).reshape(k, p)).ravel())
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
