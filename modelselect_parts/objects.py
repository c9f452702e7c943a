"""Objects that nobody can change, and the checks of what is no number: classes and names."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import fields
from functools import partial
from typing import Any

import numpy as np
import numpy.typing as npt


class Frozen:
    """A dataclass whose copies pass its checks again, and carry no cached results."""

    def __reduce__(self) -> tuple[Any, ...]:
        values = {f.name: getattr(self, f.name) for f in fields(self)}  # type: ignore[arg-type]
        return partial(type(self), **values), ()

    def _set(self, **checked: object) -> None:
        for name, value in checked.items():
            object.__setattr__(self, name, value)


class Record(Frozen):
    """Such a dataclass of results: nothing is checked, and no array can be written to."""

    def __post_init__(self) -> None:
        arrays = {k: value for k, value in vars(self).items() if isinstance(value, np.ndarray)}
        self._set(**{name: frozen(array) for name, array in arrays.items()})


def frozen(array: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Return a copy in memory that cannot be written to, whatever its flags are set to."""
    return np.frombuffer(array.tobytes(), array.dtype).reshape(array.shape)


def shown(value: object) -> str:
    """Return `value` as it stands in a message: on one line, and not too long."""
    text = " ".join(repr(value.item() if isinstance(value, np.generic) else value).split())
    return text if len(text) <= 80 else text[:77] + "..."


def check_class(argument: str, value: object, wanted: str) -> None:
    """Refuse an object of another class; it is named, as a room knows none of those below it."""
    if wanted not in [cls.__name__ for cls in type(value).__mro__]:
        raise ValueError(f"{argument}: expected {wanted}, found {type(value).__name__}")


def check_classes(argument: str, values: Any, wanted: str) -> None:
    """Refuse what is no sequence, and not an empty one, of objects of this class."""
    good = isinstance(values, list | tuple) and len(values) > 0
    if not good or any(wanted not in [c.__name__ for c in type(v).__mro__] for v in values):
        raise ValueError(
            f"{argument}: expected one or more of class {wanted}, found {shown(values)}"
        )


def check_function(argument: str, value: object) -> None:
    """Refuse what cannot be called."""
    if not callable(value):
        raise ValueError(f"{argument}: expected a function, found {shown(value)}")


def check_rng(rng: object) -> np.random.Generator:
    """Return `rng` if it is a generator."""
    if not isinstance(rng, np.random.Generator):
        raise ValueError(f"rng: expected numpy.random.default_rng(seed), found {shown(rng)}")
    return rng


def check_name(argument: str, name: object, known: Collection[str]) -> None:
    """Refuse a name that is not among those that are known."""
    if not isinstance(name, str) or name not in known:
        raise ValueError(f"{argument}: expected one of {', '.join(known)}, found {shown(name)}")
