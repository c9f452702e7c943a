r"""The certificate, on bare arrays: what no schedule can cost less than, and why.

A schedule c names a model for each of H steps.  With M = alpha Psi, positive semidefinite,
means mu (H, W, p) and linear costs l (H, W) it costs

    total(c) = mu_c'M mu_c + sum_t l[t, w_t].

Take any point d (pH,).  As x'Mx = 2 x'Md - d'Md + (x - d)'M(x - d), with
G[t, w] = 2 mu[t, w]'(M d)_t + l[t, w] and r[t, w] = G[t, w] - min_w G[t, w] >= 0,

    total(c) = LB(d) + sum_t r[t, w_t] + (mu_c - d)'M(mu_c - d),
    LB(d) = sum_t min_w G[t, w] - d'Md.

Nothing after LB(d) is negative, so LB(d) bounds every schedule: any d is a proof, a good d a
tight one.  Who found d does not matter.

>>> M, mean, linear = np.array([[2.0]]), np.array([[[1.0], [-1.0]]]), np.array([[0.0, 1.0]])
>>> bound, reduced = certificate(M, mean, linear, linear, d=np.array([0.25]))
>>> bound, reduced  # the two models cost 2 = -0.125 + 1 + 1.125 and 3 = -0.125 + 0 + 3.125
(-0.125, array([[1., 0.]]))
"""

from __future__ import annotations

from fractions import Fraction
from typing import Any

import numpy as np
import numpy.typing as npt

from modelselect_parts.checks import Array, Choices

EPS: float = float(np.finfo(float).eps)


def slopes(M: Array, mean: Array, linear: Array, d: Array) -> tuple[Array, float]:
    """G (H, W) less each step's least l, and what is missing for LB(d) = sum_t min_w G + constant.

    Leaving out the least l first saves the digits that a large common price would cost.
    """
    pull, cheapest = M @ d, linear.min(axis=1)
    H, _, p = mean.shape
    G = 2 * np.einsum("twi,ti->tw", mean, pull.reshape(H, p)) + (linear - cheapest[:, None])
    return G, float(cheapest.sum() - d @ pull)


def rounding_unit(M: Array, mean: Array) -> float:
    """How far rounding moves a total, a bound or an entry of G, as a share of the terms summed.

    Sums of k terms err by at most k half units in the last place of the sum of their sizes, and
    nested sums of k and l terms by k + l: x'Mx nests two of pH.
    """
    H, _, p = mean.shape
    return float(2 * len(M) + H + 2 * p + 10) * EPS / 2


def certificate(
    M: Array, mean: Array, linear: Array, linear_size: Array, d: Array
) -> tuple[float, Array]:
    """LB(d) and r (H, W), from which all that rounding may have added has been taken away.

    `linear_size` (H, W) is what `linear` was summed from.  Where terms cancel, the bound is low,
    not wrong: total(c) >= LB + sum_t r[t, w_t] + (mu_c - d)'M(mu_c - d) holds of exact numbers.
    """
    unit, (H, _, p) = rounding_unit(M, mean), mean.shape
    with np.errstate(over="ignore", invalid="ignore"):
        G, constant = slopes(M, mean, linear, d)
        felt = np.abs(M) @ np.abs(d)
        size = 2 * np.einsum("twi,ti->tw", np.abs(mean), felt.reshape(H, p)) + linear_size
        G = np.where(np.isfinite(linear), G - unit * size, np.inf)
        lowest = G.min(axis=1)
        common = np.abs(linear.min(axis=1)).sum() + np.abs(lowest).sum()
        bound = lowest.sum() + constant - unit * (np.abs(d) @ felt + common)
    return float(bound), G - lowest[:, None]


def relaxed(M: Array, mean: Array, linear: Array, b: Array) -> tuple[float, float, Array]:
    """Evaluate d'M d + l.b at d_t = sum_w b[t, w] mu[t, w]: value, LB(d) and G.

    G is the gradient, but for a constant in each row, which does not matter on the simplex.

    The value is LB(d) + sum r.b, so at weights that touch only the least r it meets its bound.
    """
    G, constant = slopes(M, mean, linear, mixed(mean, b))
    lowest = G.min(axis=1)
    bound = lowest.sum() + constant
    surplus = np.where(b > 0, G - lowest[:, None], 0)
    return float(bound + (surplus * b).sum()), float(bound), G


def mixed(mean: Array, b: Array) -> Array:
    """Return the mean error d (pH,) of weights b (H, W)."""
    return np.asarray(np.einsum("tw,twi->ti", b, mean).ravel())


def swap_costs(M: Array, mean: Array, linear: Array, c: Choices, pull: Array) -> Array:
    """Return what changing w_t to w changes, (H, W), given pull = M mu_c.

    Step t moves by D = mu[t, w] - mu[t, w_t], and the total by
    2 D'pull_t + D'M_tt D + l[t, w] - l[t, w_t].
    """
    H, _, p = mean.shape
    steps = np.arange(H)
    blocks = M.reshape(H, p, H, p)[steps, :, steps]
    D = mean - mean[steps, c][:, None]
    change = 2 * np.einsum("twi,ti->tw", D, pull.reshape(H, p))
    change += np.einsum("twi,tij,twj->tw", D, blocks, D)
    return np.asarray(change + linear - linear[steps, c][:, None])


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
