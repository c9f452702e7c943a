"""Covariances of errors that correlate over time: the two models that robotics uses most.

An array (H, W, p, H, W, p) holds Cov(e[t,w]_r, e[k,v]_s) at [t, w, r, k, v, s].

>>> persistent_bias([4], np.ones((2, 1, 1))).reshape(2, 2)  # 4 for ever, 1 anew at each step
array([[5., 4.],
       [4., 5.]])
>>> autoregressive_errors(np.ones((3, 1, 1)), 0.5).reshape(3, 3)
array([[1.  , 0.5 , 0.25],
       [0.5 , 1.  , 0.5 ],
       [0.25, 0.5 , 1.  ]])
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from modelselect_parts.checks import (
    Array,
    as_numbers,
    check_array,
    check_range,
)
from modelselect_parts.matrices import check_semidefinite


def persistent_bias(
    bias_variance: npt.ArrayLike,
    white_variance: npt.ArrayLike,
    *,
    correlation: npt.ArrayLike | None = None,
) -> Array:
    """Covariance (H, W, p, H, W, p) of a bias that lasts for the whole run, plus white errors.

    e[t,w] = b_w + n[t,w]: b_w is drawn once, with `bias_variance` (W,) where p = 1, or (W, p), such
    as what a calibration leaves; n anew at every step, with `white_variance` (H, W, p).  The biases
    of two models have this `correlation` (W, W), by default none; components have none.
    """
    white = check_array("white_variance", white_variance, "H W p", (None, None, None))
    H, W, p = white.shape
    given = as_numbers("bias_variance", bias_variance)
    given = given[:, None] if p == 1 and given.ndim == 1 else given
    lasting = check_array("bias_variance", given, "W p", (W, p))
    check_range("bias_variance", lasting)
    check_range("white_variance", white)
    size = np.broadcast_to(np.sqrt(lasting), (H, W, p))
    return _over_time(size, white, np.ones(W), _correlation(correlation, W))


def autoregressive_errors(
    variance: npt.ArrayLike, rho: npt.ArrayLike, *, correlation: npt.ArrayLike | None = None
) -> Array:
    """Covariance (H, W, p, H, W, p) of errors that follow AR(1): x[t,w] = rho_w x[t-1,w] + noise.

    e[t,w] = sqrt(variance[t,w]) x[t,w], componentwise, with x of unit variance throughout;
    `variance` (H, W, p), and `rho`, from -1 to 1, is a number or one for each model, (W,).  At the
    same step x of two models have this `correlation` R (W, W), by default none, and
    so Cov(x[t,w], x[k,v]) = R[w,v] rho_w^(t-k) for t >= k; components are independent.
    """
    spread = check_array("variance", variance, "H W p", (None, None, None))
    W = spread.shape[1]
    given = as_numbers("rho", rho)
    last = check_array("rho", np.full(W, given) if given.ndim == 0 else given, "W", (W,))
    check_range("rho", np.abs(last), 1)
    check_range("variance", spread)
    R = _correlation(correlation, W)
    # The noise that keeps x at correlation R has this covariance: it must be one.
    check_semidefinite("correlation", R * (1 - np.outer(last, last)), given=correlation)
    return _over_time(np.sqrt(spread), np.zeros_like(spread), last, R)


def _correlation(given: npt.ArrayLike | None, W: int) -> Array:
    R = check_array("correlation", np.eye(W) if given is None else given, "W W", (W, W))
    if (other := R.diagonal() != 1).any():
        wrong = f"{float(R.diagonal()[other][0])}; divide by np.sqrt(np.outer(d, d))"
        raise ValueError(f"correlation: expected 1 on the diagonal d, found {wrong}")
    return check_semidefinite("correlation", R, given=given)


def _over_time(size: Array, white: Array, rho: Array, R: Array) -> Array:
    """Covariance of size[t,w,r] x[t,w,r] + white errors, x of lag correlations R rho^|t-k|."""
    H, W, p = size.shape
    lag = np.subtract.outer(np.arange(H), np.arange(H))
    result = np.zeros((H, W, p, H, W, p))
    for w, v in np.argwhere(R):
        x = R[w, v] * np.where(lag >= 0, rho[w], rho[v]) ** np.abs(lag)  # the later one's memory
        for r in range(p):
            result[:, w, r, :, v, r] = np.outer(size[:, w, r], size[:, v, r]) * x
    at = tuple(np.indices(size.shape))
    result[at + at] += white
    return result
