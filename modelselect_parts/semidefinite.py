"""Symmetric positive semidefinite matrices (..., k, k) up to rounding: judged, mended, factored.

Where they are judged, mended and rooted they are scaled to unit diagonal first, so that the units
of the rows do not matter.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import numpy.typing as npt
from scipy.linalg import LinAlgError, lapack

Array = npt.NDArray[np.float64]

EPSILON = float(np.finfo(float).eps)
MATRIX_TOLERANCE = 1e-12  # see "Tolerances" in modelselect.py


def judged(matrices: Array) -> tuple[float, float]:
    """Largest asymmetry and least eigenvalue of `matrices` scaled to unit diagonal."""
    diagonal = np.diagonal(matrices, axis1=-2, axis2=-1)[..., None]
    # Beside a zero on the diagonal, nothing but underflow may stand.
    scale = np.sqrt(np.where(diagonal == 0, 1e-300, np.abs(diagonal)))
    with np.errstate(all="ignore"):
        scaled = matrices / scale / np.swapaxes(scale, -1, -2)
        skew = np.abs(scaled - np.swapaxes(scaled, -1, -2)).max()
    # Entries that overflow exceed their diagonal by far: the matrix is indefinite.
    least = np.linalg.eigvalsh(scaled)[..., 0].min() if np.isfinite(scaled).all() else -math.inf
    return float(skew), float(least)


def mended(matrices: Array, skew: float, least: float) -> Array:
    """Return `matrices` without their asymmetry, a negative eigenvalue lifted by the diagonal."""
    k = matrices.shape[-1]
    lift = -least if least < -k * EPSILON else 0.0
    if skew > 0 or lift > 0:
        matrices = (matrices + np.swapaxes(matrices, -1, -2)) / 2
        matrices = matrices + lift * np.eye(k) * matrices
    return matrices


def semidefinite_root(matrices: Array) -> Array:
    """F (..., k, k) with F F' = `matrices`, symmetric positive semidefinite, up to rounding."""
    diagonal = np.diagonal(matrices, axis1=-2, axis2=-1)[..., None]
    scale = np.sqrt(np.where(diagonal > 0, diagonal, 1))
    rounding = matrices.shape[-1] * EPSILON
    with np.errstate(invalid="ignore"):  # what overflows is its caller's to see
        values, V = np.linalg.eigh(matrices / scale / np.swapaxes(scale, -1, -2))
        root = np.sqrt(np.where(values > rounding, values, 0))[..., None, :]
        return np.asarray(scale * V * root)


def cholesky_solver(A: Array) -> Callable[[Array], Array]:
    """Return b -> A^{-1}b for definite A (k, k), b (k,) or (k, n); LinAlgError if A is not.

    LAPACK's own routines: SciPy's `cho_solve` calls the same ones, and looks at its arguments for
    longer than a small system takes.
    """
    U, failed = lapack.dpotrf(A, clean=False)
    if failed or not np.isfinite(A).all():  # LAPACK lets NaN pass
        raise LinAlgError("expected a positive definite matrix")

    def solve(b: Array) -> Array:
        return np.asarray(lapack.dpotrs(U, b)[0])

    return solve
