r"""Column generation, on bare arrays: the relaxation where schedules meet in more than M.

A point of the relaxation is a mixture of whole schedules.  Keep a few (the columns); the *master*
minimises the cost over their mixtures, a small quadratic programme.  At its optimum the mean error
is d, and the price of the limit lam.  The cheapest path at these prices (see trellis.py) gives
LB(d, lam): it proves the mixture best, or is the column to add.  Few schedules matter, so few are
ever made (Dantzig and Wolfe 1960; von Hohenbalken 1977).

>>> form = Form(np.array([[2.0]]), np.array([[[1.0], [-1.0]]]), *np.array([[[0.0, 1.0]]] * 2))
>>> found = columns(form, lambda value, bound: value - bound < 1e-9, max_iterations=9)
>>> found.weights.round(4), round(found.value, 3)  # at 0.125 mean error
(array([[0.5625, 0.4375]]), 0.469)
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from scipy.linalg import LinAlgError

from modelselect_parts.checks import Array
from modelselect_parts.semidefinite import cholesky_solver
from modelselect_parts.trellis import Form, cheapest_path, path_sum, slopes


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
    max_iterations: int,
    ceiling: float = math.inf,
    time_left: Callable[[], float] = lambda: math.inf,
) -> Columns | None:
    """Minimise over mixtures of schedules, until `closed` says that value and bound agree.

    Stops, too, when the bound exceeds `ceiling`, without time, or after `max_iterations`; None if
    no schedule keeps the limit.
    """
    M, mean, usable, (H, W, _) = form.matrix, form.mean, form.linear < np.inf, form.mean.shape
    steps, limited = np.arange(H), form.price is not None
    price, toll = np.zeros((H, W)) if form.price is None else form.price, form.toll
    spend, arc = (np.where(usable, price, np.inf), toll) if limited else (form.linear, form.arc)
    least = cheapest_path(spend, arc)
    if path_sum(price, toll, least) > form.limit:
        return None
    alone = np.repeat(np.flatnonzero(usable.all(axis=0)), H).reshape(-1, H)  # a model throughout
    kept, best, value, bound, k = np.vstack([least, alone]), None, math.inf, -math.inf, 0
    dearest = 1.0 + H * (np.abs(price).max() + (0 if toll is None else toll.max()))
    for k in range(1, max_iterations + 1):
        mu = mean[steps, kept].reshape(len(kept), -1)
        cost = path_sum(form.linear, form.arc, kept)
        x, lam = master(mu @ M @ mu.T, cost, path_sum(price, toll, kept), form.limit)
        lam = min(lam, 1e300 / dearest)  # any one is valid, as long as it does not overflow
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
        kept = kept[(x > 0) | (np.arange(len(kept)) == 0)]
        if (kept == path).all(axis=1).any():
            break  # no schedule is missing; the rest of the gap is the master's rounding
        kept = np.vstack([kept, path])
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
        except LinAlgError:  # the method has gone as far as digits go
            break
        dv, dy, dz = direction(-v * z)
        step = _inside(v, dv, z, dz)
        left = float((v + step * dv) @ (z + step * dz)) / len(v)
        dv, dy, dz = direction((left / tau) ** 3 * tau - v * z - dv * dz)
        step = 0.995 * _inside(v, dv, z, dz)
        v, y, z = v + step * dv, y + step * dy, z + step * dz
    x = np.where(v[:k] > 1e-11, v[:k], 0)
    return x / x.sum(), max(0.0, -float(y[1]) * float(scale) / float(unit)) if limited else 0.0


def _newton(
    P: Array, E: Array, dual: Array, primal: Array, v: Array, z: Array
) -> Callable[[Array], tuple[Array, Array, Array]]:
    """Return r -> dv, dy, dz with P dv - E'dy - dz = dual, E dv = primal, z dv + v dz = r."""
    system = cholesky_solver(P + np.diag(z / v))
    back = system(E.T)
    small = cholesky_solver(E @ back)

    def direction(r: Array) -> tuple[Array, Array, Array]:
        a = system(dual + r / v)
        dy = small(primal - E @ a)
        dv = a + back @ dy
        return dv, dy, (r - z * dv) / v

    return direction


def _inside(v: Array, dv: Array, z: Array, dz: Array) -> float:
    """Return the longest step up to 1 that keeps v and z positive."""
    return min(1.0, 1 / max(float((-dv / v).max()), float((-dz / z).max()), 1e-300))
