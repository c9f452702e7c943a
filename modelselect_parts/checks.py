"""The one checker of arguments, and the types of array that all modules speak of.

What is wrong raises ValueError, in one line: the caller's name of the argument, what was expected
and what was found.  What is right comes back as an array that nobody can write to, and that is not
checked twice: another weight for a large problem is free.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any
from weakref import WeakValueDictionary

import numpy as np
import numpy.typing as npt

from modelselect_parts.objects import (
    Frozen,
    check_class,
    check_classes,
    check_function,
    check_name,
    check_rng,
    frozen,
    shown,
)

Array = npt.NDArray[np.float64]
Choices = npt.NDArray[np.intp]
Mask = npt.NDArray[np.bool_]

#: What was found of arrays that cannot change, such as "finite"; an entry goes with its array.
FACTS: WeakValueDictionary[tuple[int, str], npt.NDArray[Any]] = WeakValueDictionary()


def as_numbers(name: str, value: npt.ArrayLike) -> npt.NDArray[Any]:
    """Return `value` as an array of booleans, integers or floats."""
    if _is_masked(value):
        raise ValueError(f"{name}: expected all entries, found a masked array")
    try:
        raw = np.asarray(value)
    except ValueError:
        raise ValueError(f"{name}: expected a rectangular array, found ragged sequences") from None
    if raw.dtype.kind not in "biuf":
        raise ValueError(f"{name}: expected real numbers, found dtype {raw.dtype}")
    return raw


def _is_masked(value: Any) -> bool:
    """Whether an entry is masked, be it of an array in a list, where NumPy forgets its mask."""
    parts = value if isinstance(value, list | tuple) else ()
    inside = any(_is_masked(part) for part in parts if not isinstance(part, float | int))
    return bool(inside or np.ma.is_masked(value))


def check_array(
    name: str,
    value: npt.ArrayLike,
    axes: str,
    sizes: Sequence[int | None],
    *,
    finite: bool = True,
    known: str = "",
) -> Array:
    """Return `value` as frozen floats of the given axes, such as ``"H W p"``, none of them NaN.

    `sizes` holds a length for each axis, or None; a leading ``...`` admits axes in front.  Where
    lengths are `known` from other arguments, messages say from which.
    """
    raw, letters = as_numbers(name, value), tuple(axes.replace("...", "").split())
    front = ("...",) if "..." in axes else ()
    last = raw.shape[max(0, raw.ndim - len(letters)) :] if front else raw.shape
    if not _fits(last, sizes) or 0 in raw.shape:
        sized = tuple(map(lambda axis, k: axis if k is None else str(k), letters, sizes))
        expected = f"{front + letters} = {front + sized}".replace("'", "") + known
        row = raw.ndim == 2 and len(raw) == 1
        column = raw.shape[::-1] if row else raw.shape + (1,) * (len(sizes) - raw.ndim)
        meant = raw.size and _fits(column, sizes)
        hint = f"; did you mean np.reshape({name}, {column})?" if meant else ""
        wanted = f"shape {expected}" if axes else "a number"
        found = f"{raw.shape}{hint}" if axes else f"shape {raw.shape}"
        raise ValueError(f"{name}: expected {wanted}, found {found}")
    fact = "finite" if finite else "finite or infinite"
    if FACTS.get((id(raw), fact)) is raw:
        return raw
    with np.errstate(over="ignore"):
        array = frozen(np.asarray(raw, dtype=np.float64))
    bad = ~np.isfinite(array) if finite else np.isnan(array)
    if bad.any():
        where = _place(letters, np.argwhere(bad)[0])
        raise ValueError(f"{name}: expected {fact} numbers, found {array[bad][0]}{where}")
    FACTS[id(array), fact] = array
    return array


def _fits(shape: Sequence[int], sizes: Sequence[int | None]) -> bool:
    return len(shape) == len(sizes) and all(map(lambda n, k: k in (None, n), shape, sizes))


def _place(letters: Sequence[str], index: npt.NDArray[np.intp]) -> str:
    """Return where an entry stands, in words where its axes have some."""
    words = {"H": "step", "W": "model", "p": "component"}
    if not len(index):
        return ""
    if len(letters) == len(index) and set(letters) <= set(words):
        return " at " + ", ".join(f"{words[x]} {i}" for x, i in zip(letters, index, strict=True))
    return f" at {index.tolist()}"


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
    if (
        type(choices) is np.ndarray
        and choices.dtype == np.intp
        and choices.size
        and choices.shape[-1:] == (H,)
        and 0 <= choices.min() <= choices.max() < W
    ):
        return choices.copy()  # as solvers have them, which ask time and again
    c = check_array("choices", choices, "... H", (H,))
    bad = (c != np.floor(c)) | (c < 0) | (c >= W)
    if bad.any():
        found = f"{c[bad][0]:g}{_place('H', np.argwhere(bad)[0])}"
        raise ValueError(f"choices: expected integers from 0 to {W - 1}, found {found}")
    return c.astype(np.intp)


def check_range(name: str, array: Array, top: float = np.inf) -> None:
    """Refuse an entry below 0 or above `top`."""
    if array.min() < 0:
        raise ValueError(f"{name}: expected numbers >= 0, found {array.min():g}")
    if array.max() > top:
        raise ValueError(f"{name}: expected numbers of size <= {top:g}, found {array.max():g}")
