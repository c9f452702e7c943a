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
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np

from modelselect_parts.checks import Array, Choices
from modelselect_parts.sensitivity import Sensitivity, product, squares

EPS = float(np.finfo(float).eps)


class Form(NamedTuple):
    """The selection problem on bare arrays."""

    M: Array | Sensitivity  #: (pH, pH), positive semidefinite
    mean: Array  #: (H, W, p)
    linear: Array  #: (H, W), inf where a model is not available
    size: Array  #: (H, W), the sizes of the terms that `linear` was summed from
    arc: Array | None = None  #: (W, W), from row to column, >= 0; None: moves are free
    price: Array | None = None  #: (H, W), finite; None: no limit
    toll: Array | None = None  #: (W, W), what moves spend; None where arc is
    limit: float = math.inf  #: the most that a schedule may spend
    defect: float = 0.0  #: M + defect diag(M) is semidefinite, in exact numbers

    @property
    def matrix(self) -> Array:
        """M, which has to be an array here."""
        if isinstance(self.M, np.ndarray):
            return self.M
        raise ValueError("psi: expected a matrix, as np.asarray(psi) is, found a linear system")

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
    base: float  #: `bound` = base + cheapest path of `node` and `arc`
    node: Array  #: (H, W), G less each step's least
    arc: Array | None  #: A = `Form.priced`
    taken: float  #: `base` and a path of `node` are at most so much too low, for rounding

    @property
    def reduced(self) -> Array:
        """What every schedule with model w at step t costs more than the bound, (H, W), >= 0."""
        if self.arc is None:
            return self.node
        paths = through(self.node, self.arc)
        return np.asarray(np.maximum(paths - paths[-1].min(), 0))


# ------------------------------------------------------------------------------ cheapest paths


def forward(node: Array, arc: Array | None) -> Array:
    """Return F[t, w], the cheapest path that ends with model w at step t (Viterbi): O(H W^2).

    Of several problems side by side: node (H, ..., W), arc (..., W, W).
    """
    if arc is None:
        before = np.cumsum(node.min(axis=1)) - node.min(axis=1)
        return np.asarray(before[:, None] + node)
    F = node.copy()
    for before, here in pairwise(F):
        here += np.minimum.reduce(before[..., None] + arc, axis=-2)
    return F


def through(node: Array, arc: Array | None) -> Array:
    """Return what the cheapest path with model w at step t costs, (H, W)."""
    if arc is None:
        lowest = node.min(axis=1)
        return np.asarray(node + (lowest.sum() - lowest)[:, None])
    ways = forward(np.stack([node, node[::-1]], axis=1), np.stack([arc, arc.T]))
    return np.asarray(ways[:, 0] + ways[::-1, 1] - np.where(node < np.inf, node, 0))


def cheapest_path(node: Array, arc: Array | None) -> Choices:
    """Return a schedule of least sum of nodes and arcs, (H,)."""
    if arc is None:
        return np.asarray(node.argmin(axis=1))
    F, c = forward(node, arc), np.empty(len(node), dtype=np.intp)
    c[-1], best = F[-1].argmin(), (F[:-1, :, None] + arc).argmin(axis=1)  # the model to come from
    for t in reversed(range(len(best))):
        c[t] = best[t, c[t + 1]]
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


def form_of(M: Array | Sensitivity, x: Array) -> Any:
    """Return x'M x of vectors x (..., pH)."""
    if isinstance(M, np.ndarray):
        return ((x @ M) * x).sum(axis=-1)
    return squares(M, x.reshape(-1, len(M)))[0].reshape(x.shape[:-1])[()]


def form_size(M: Array | Sensitivity, x: Array) -> Any:
    """Return sizes such that `rounding_unit` times them bounds how far `form_of` is off."""
    if isinstance(M, np.ndarray):
        return form_of(np.abs(M), np.abs(x))
    found, off = squares(M, x.reshape(-1, len(M)))
    return (found + off / (len(M) * EPS)).reshape(x.shape[:-1])[()]


def felt_sizes(M: Array | Sensitivity, d: Array) -> Array:
    """Return sizes (pH,) such that `rounding_unit` times them bounds how far M d is off."""
    if isinstance(M, np.ndarray):
        return np.asarray(np.abs(M) @ np.abs(d))
    found, off = product(M, d)
    return np.abs(found) + off / (len(M) * EPS)


def rounding_unit(mean: Array) -> float:
    """How far rounding moves a total, a bound or an entry of G, as a share of the terms summed.

    Sums of k terms err by at most k half units in the last place of the sum of their sizes, and
    nested sums of k and l terms by k + l: x'Mx nests two of pH.
    """
    H, _, p = mean.shape
    return float(2 * p * H + H + 2 * p + 10) * EPS / 2


def certificate(form: Form, d: Array, multiplier: float = 0.0) -> Certificate:
    """LB(d, lam), from which all that rounding may have added has been taken away.

    Where terms cancel, the bound is low, not wrong: with path(c) of `node` and A = form.priced,
    total(c) >= base + path(c) + lam (K - spent(c)) + e'(M + D)e, e = mu_c - d, holds of exact
    numbers.  D = defect diag(M) is what M may lack of being semidefinite; D e^2 depends on one
    step's model only, so it is taken off the nodes.
    """
    M, mean, linear = form.M, form.mean, form.linear
    unit, (H, _, p) = rounding_unit(mean), mean.shape
    A, price = form.priced(multiplier), 0.0 if form.price is None else multiplier * form.price
    with np.errstate(all="ignore"):
        G, constant = slopes(form, d, multiplier)
        felt = felt_sizes(M, d)
        size = 2 * np.einsum("twi,ti->tw", np.abs(mean), felt.reshape(H, p)) + form.size
        G = G - unit * (size + np.abs(price)) - lacking(form, d)
        G = np.where(np.isfinite(linear), G, np.inf)
        lowest = G.min(axis=1)
        common = np.abs(linear.min(axis=1)).sum() + np.abs(lowest).sum()
        if multiplier and form.price is not None:
            common += multiplier * abs(form.limit)
        base = lowest.sum() + constant - unit * (np.abs(d) @ felt + common)
        node = G - lowest[:, None]
        worst = np.where(np.isfinite(linear), size + np.abs(price), 0).max(axis=1).sum()
        taken = float(2 * unit * (worst + np.abs(d) @ felt + common))
        if A is None:
            return Certificate(float(base), float(base), node, A, taken)
        least = forward(node, A)[-1].min()  # of 2H non-negative numbers, each of a few roundings
        bound = base + least * (1 - (2 * len(node) + 8) * EPS) - EPS * abs(base)
    return Certificate(float(bound), float(base), node, A, taken)


def lacking(form: Form, d: Array) -> Array:
    """Return what the diagonal lends to M, defect sum_i M_ii e_i^2 at e = mu - d, (H, W)."""
    H, _, p = form.mean.shape
    root = np.sqrt(form.defect * np.abs(form.M.diagonal())).reshape(H, 1, p)
    return np.asarray(((root * (form.mean - d.reshape(H, 1, p))) ** 2).sum(axis=-1))


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
