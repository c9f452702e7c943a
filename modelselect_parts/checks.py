"""The one checker of arguments, and the types of array that all modules speak of.

What is wrong raises ValueError, in one line: the caller's name of the argument, what was expected
and what was found.  What is right comes back as an array that nobody can write to, and that is not
checked twice: another weight for a large problem is free.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import fields
from functools import partial
from typing import Any
from weakref import WeakValueDictionary

import numpy as np
import numpy.typing as npt

from modelselect_parts.semidefinite import EPSILON, MATRIX_TOLERANCE, judged, mended

Array = npt.NDArray[np.float64]
Choices = npt.NDArray[np.intp]
Mask = npt.NDArray[np.bool_]

#: What was found of arrays that cannot change, such as "finite"; an entry goes with its array.
_FACTS: WeakValueDictionary[tuple[int, str], npt.NDArray[Any]] = WeakValueDictionary()


class Frozen:
    """A dataclass whose copies pass its checks again, and carry no cached results."""

    def __reduce__(self) -> tuple[Any, ...]:
        values = {f.name: getattr(self, f.name) for f in fields(self)}  # type: ignore[arg-type]
        return partial(type(self), **values), ()

    def _set(self, **checked: object) -> None:
        for name, value in checked.items():
            object.__setattr__(self, name, value)


def frozen(array: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Return a copy in memory that cannot be written to, whatever its flags are set to."""
    return np.frombuffer(array.tobytes(), array.dtype).reshape(array.shape)


def shown(value: object) -> str:
    """Return `value` as it stands in a message: on one line, and not too long."""
    text = " ".join(repr(value).split())
    return text if len(text) <= 80 else text[:77] + "..."


def as_numbers(name: str, value: npt.ArrayLike) -> npt.NDArray[Any]:
    """Return `value` as an array of booleans, integers or floats."""
    if np.ma.is_masked(value):
        raise ValueError(f"{name}: expected all entries, found a masked array")
    try:
        raw = np.asarray(value)
    except ValueError:
        raise ValueError(f"{name}: expected a rectangular array, found ragged sequences") from None
    if raw.dtype.kind not in "biuf":
        raise ValueError(f"{name}: expected real numbers, found dtype {raw.dtype}")
    return raw


def check_array(
    name: str, value: npt.ArrayLike, axes: str, sizes: Sequence[int | None], *, finite: bool = True
) -> Array:
    """Return `value` as frozen floats of the given axes, such as ``"H W p"``, none of them NaN.

    `sizes` holds a length for each axis, or None; a leading ``...`` admits axes in front.
    """
    raw, letters = as_numbers(name, value), tuple(axes.replace("...", "").split())
    front = ("...",) if "..." in axes else ()
    last = raw.shape[max(0, raw.ndim - len(letters)) :] if front else raw.shape
    right = len(last) == len(letters) and all(map(lambda k, n: k in (None, n), sizes, last))
    if not right or 0 in raw.shape:
        sized = tuple(map(lambda axis, k: axis if k is None else str(k), letters, sizes))
        expected = f"{front + letters} = {front + sized}".replace("'", "")
        raise ValueError(f"{name}: expected shape {expected}, found {raw.shape}")
    fact = "finite" if finite else "without NaN"
    if _FACTS.get((id(raw), fact)) is raw:
        return raw
    array = frozen(np.asarray(raw, dtype=np.float64))
    if np.isnan(array).any() or (finite and np.isinf(array).any()):
        raise ValueError(f"{name}: expected finite numbers, found NaN or infinity")
    _FACTS[id(array), fact] = array
    return array


def check_number(name: str, value: Any, *, minimum: float = -np.inf) -> float:
    """Return `value` as a finite float >= `minimum`."""
    number = float(check_array(name, value, "", ()))
    if number < minimum:
        raise ValueError(f"{name}: expected a number >= {minimum:g}, found {number:g}")
    return number


def check_count(name: str, value: Any, *, minimum: int = 1, top: float = 2**64 - 1) -> int:
    """Return `value` as an int from `minimum` to `top`."""
    number, raw = value if type(value) is int else check_number(name, value), np.asarray(value)
    if raw.dtype == bool or number != int(number) or not minimum <= int(raw) <= top:
        expected = f"an integer >= {minimum}" + (f" and <= {top}" if int(raw) > top else "")
        raise ValueError(f"{name}: expected {expected}, found {shown(value)}")
    return int(raw)  # of `number`, the last digits of a large integer are lost


def check_choices(choices: npt.ArrayLike, H: int | None, W: int) -> Choices:
    """Return `choices` (..., H) as integers from 0 to W - 1."""
    c = check_array("choices", choices, "... H", (H,))
    if np.any((c != np.floor(c)) | (c < 0) | (c >= W)):
        raise ValueError(f"choices: expected integers from 0 to {W - 1}, found others")
    return c.astype(np.intp)


def check_rng(rng: object) -> np.random.Generator:
    """Return `rng` if it is a generator."""
    if not isinstance(rng, np.random.Generator):
        raise ValueError(f"rng: expected numpy.random.default_rng(seed), found {shown(rng)}")
    return rng


def check_range(name: str, array: Array, top: float = np.inf) -> None:
    """Refuse an entry below 0 or above `top`."""
    if array.min() < 0:
        raise ValueError(f"{name}: expected numbers >= 0, found {array.min():g}")
    if array.max() > top:
        raise ValueError(f"{name}: expected numbers of size <= {top:g}, found {array.max():g}")


def check_name(argument: str, name: object, known: Collection[str]) -> None:
    """Refuse a name that is not among those that are known."""
    if not isinstance(name, str) or name not in known:
        raise ValueError(f"{argument}: expected one of {', '.join(known)}, found {shown(name)}")


def check_semidefinite(name: str, matrices: Array, *, definite: bool = False) -> Array:
    """Return symmetric positive semidefinite, or definite, `matrices` (..., k, k), mended."""
    fact, k = "definite" if definite else "semidefinite", matrices.shape[-1]
    if _FACTS.get((id(matrices), fact)) is matrices:
        return matrices
    skew, least = judged(matrices)
    if skew > MATRIX_TOLERANCE:
        found = f"asymmetry {skew:.3g}; symmetrise it first: ({name} + {name}.T) / 2"
        raise ValueError(f"{name}: expected a symmetric matrix, found {found}")
    if least <= (10 * EPSILON if definite else -MATRIX_TOLERANCE) * k:
        found = f"smallest eigenvalue {least:.3g} (of the matrix scaled to unit diagonal)"
        raise ValueError(f"{name}: expected a positive {fact} matrix, found {found}")
    result = check_array(name, mended(matrices, skew, least), "...", ())
    _FACTS[id(result), fact] = result
    return result
