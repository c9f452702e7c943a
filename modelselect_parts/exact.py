"""Floats in exact numbers: what sums of them come to, and whether a matrix is semidefinite.

>>> exact_form(np.array([[0.1]]), np.array([1.0])) == Fraction(0.1)  # not 1/10
True
"""

from __future__ import annotations

import contextlib
from fractions import Fraction
from typing import Any

import numpy as np
import numpy.typing as npt

from modelselect_parts.checks import Array

EPS, TINY = float(np.finfo(float).eps), float(np.finfo(float).tiny)
EXACT_ROWS = 32  # elimination in integers takes milliseconds


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


def semidefinite_defect(A: Array) -> float:
    """Return tau >= 0 such that A + tau diag(A) is semidefinite, in exact numbers.

    tau = 0 is proved by Cholesky's method with a reserve for its own rounding (Demmel 1989; Rump
    2006), or, of a singular A of up to EXACT_ROWS rows, by elimination in integers (Bareiss 1968).
    Otherwise tau = 8 k eps is an estimate, no theorem: of a singular A, what rounding may hide of
    an eigenvalue that `check_semidefinite` let pass.
    """
    A = A[np.ix_(A.any(axis=1), A.any(axis=1))]
    k, root = len(A), np.sqrt(np.maximum(A.diagonal(), TINY))
    with contextlib.suppress(np.linalg.LinAlgError):
        np.linalg.cholesky(A / root / root[:, None] - k * (k + 8) * EPS * np.eye(k))
        return 0.0
    if k > EXACT_ROWS:
        return 8 * k * EPS
    (S, _), before = as_integers(A), 1
    while len(S) and (pivot := S.diagonal().max()) > 0:
        i = int(S.diagonal().argmax())
        column, rest = np.delete(S[:, i], i), np.delete(np.delete(S, i, 0), i, 1)
        S, before = (pivot * rest - np.multiply.outer(column, column)) // before, pivot
    return 8 * k * EPS if S.any() else 0.0
