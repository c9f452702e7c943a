"""Covariances and cost matrices as users give them: checked, mended, or made semidefinite."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from modelselect_parts.checks import FACTS, Array, as_numbers, check_array
from modelselect_parts.semidefinite import EPSILON, MATRIX_TOLERANCE, judged, mended


def tolerance(*given: npt.ArrayLike | None) -> float:
    """Return how far rounding can have moved an eigenvalue: of the fewest digits that were `given`.

    Relative to a unit diagonal.
    """
    digits = [np.asarray(matrix).dtype for matrix in given]
    single = [np.finfo(d).eps for d in digits if d.kind == "f" and d.itemsize < 8]
    return max([MATRIX_TOLERANCE, *(8 * float(eps) for eps in single)])


def check_semidefinite(
    name: str, matrices: Array, *, definite: bool = False, given: npt.ArrayLike | None = None
) -> Array:
    """Return symmetric positive semidefinite, or definite, `matrices` (..., k, k), mended.

    As they were `given`, they may have had fewer digits than ours; messages say `name`.
    """
    fact, k = "definite" if definite else "semidefinite", matrices.shape[-1]
    if FACTS.get((id(matrices), fact)) is matrices:
        return matrices
    (skew, least), slack = judged(matrices), tolerance(given)
    if skew > slack:
        found = f"asymmetry {skew:.3g}; symmetrise it first: ({name} + {name}.T) / 2"
        raise ValueError(f"{name}: expected a symmetric matrix, found {found}")
    if least <= (10 * EPSILON if definite else -slack) * k:
        found = f"smallest eigenvalue {least:.3g} (of the matrix scaled to unit diagonal)"
        if -1e-3 < least <= 0 and not definite:
            found += f"; if digits were lost: nearest_semidefinite({name})"
        raise ValueError(f"{name}: expected a positive {fact} matrix, found {found}")
    result = check_array(name, mended(matrices, skew, least), "...", ())
    FACTS[id(result), fact] = result
    return result


def nearest_semidefinite(matrices: npt.ArrayLike) -> Array:
    """Return the nearest symmetric positive semidefinite matrices to `matrices` (..., n, n).

    Of the symmetric part, scaled to unit diagonal, eigenvalues below 0 become 0: nearest in the
    Frobenius norm of the scaled ones (Higham 1988).  For matrices that are semidefinite but for
    digits that were lost, in single precision or in print.
    """
    n = (as_numbers("matrices", matrices).shape[-1:] or (None,))[0] or None
    M = check_array("matrices", matrices, "... n n", (n, n))
    M = M / 2 + np.swapaxes(M, -1, -2) / 2
    diagonal = np.diagonal(M, axis1=-2, axis2=-1)[..., None]
    scale = np.sqrt(np.where(diagonal > 0, diagonal, 1))
    values, V = np.linalg.eigh(M / scale / np.swapaxes(scale, -1, -2))
    root = scale * V * np.sqrt(np.maximum(values, 0))[..., None, :]
    nearest = root @ np.swapaxes(root, -1, -2)
    return np.asarray(nearest / 2 + np.swapaxes(nearest, -1, -2) / 2)
