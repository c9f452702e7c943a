"""Objects as JSON and back, for a robot that is told its schedule, or its problem, in a message.

A document is strict JSON: no NaN; infinities are the strings "inf" and "-inf"; floats are written
with as many digits as bring back the same float.  What comes back has passed the same checks as
what a caller gives.

>>> class Point(Stored):
...     x: float
...     y: Array
>>> point = dataclass(frozen=True)(Point)(1.5, np.array([0.1, np.inf]))
>>> print(text := point.to_json())
{"format": "modelselect.Point", "version": 1, "x": 1.5, "y": [0.1, "inf"]}
>>> Point.from_json(text).x
1.5
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import MISSING, dataclass, fields  # noqa: F401  (dataclass: the example)
from typing import Any, ClassVar, Self

import numpy as np

from modelselect_parts.checks import Array, Frozen, check_array, shown  # noqa: F401

VERSION = 1
INFINITE = {"inf": math.inf, "-inf": -math.inf}
PLAIN = {"str": str, "bool": bool, "Mapping[str, Any]": dict}


class Stored(Frozen):
    """A dataclass that writes its fields as JSON, and reads them again."""

    _kinds: ClassVar[dict[str, type[Stored]]] = {}

    def __init_subclass__(cls) -> None:
        Stored._kinds[f"modelselect.{cls.__name__}"] = cls

    def to_json(self) -> str:
        """Return all fields as one JSON document; of a schedule's `work` numbers and counts."""
        return json.dumps(self._document(), allow_nan=False)

    @classmethod
    def from_json(cls, text: str) -> Self:
        """Read what `to_json` wrote; ValueError names the field that is missing, odd or wrong."""
        try:
            document = json.loads(text, parse_constant=_refuse, object_pairs_hook=_once)
        except (TypeError, RecursionError, UnicodeError, json.JSONDecodeError) as error:
            raise ValueError(f"text: expected a JSON document, found {error}") from None
        found = _read(document)
        if not isinstance(found, cls):
            raise ValueError(f"format: expected modelselect.{cls.__name__}, found {shown(found)}")
        return found

    def _document(self) -> dict[str, Any]:
        written = {f.name: _written(getattr(self, f.name)) for f in fields(self)}  # type: ignore[arg-type]
        return {"format": f"modelselect.{type(self).__name__}", "version": VERSION} | written


def _written(value: Any) -> Any:
    """Write arrays as lists, infinities as strings, and of a mapping what is numbers or words."""
    if isinstance(value, Stored):
        return value._document()
    if isinstance(value, Mapping):
        return {key: _written(entry) for key, entry in value.items() if _is_plain(entry)}
    if isinstance(value, np.ndarray | np.generic):
        return _written(value.tolist())
    if isinstance(value, list):
        return [_written(entry) for entry in value]
    if isinstance(value, float) and math.isinf(value):
        return "inf" if value > 0 else "-inf"
    return value


def _is_plain(value: Any) -> bool:
    if isinstance(value, list):
        return all(isinstance(entry, int | float) for entry in value)
    return isinstance(value, int | float | str | np.ndarray | np.generic)


def _read(document: Any) -> Any:
    """Make an object of its document; leave what is none as it is."""
    if not (isinstance(document, dict) and "format" in document):
        return document
    kind, version = document.pop("format"), document.pop("version", None)
    cls = Stored._kinds.get(kind) if isinstance(kind, str) else None
    if cls is None:
        raise ValueError(f"format: expected one of {', '.join(Stored._kinds)}, found {shown(kind)}")
    if type(version) is not int or version != VERSION:
        raise ValueError(f"version: expected {VERSION}, found {shown(version)}")
    known = {f.name: f for f in fields(cls)}  # type: ignore[arg-type]
    required = {k for k, f in known.items() if f.default is f.default_factory is MISSING}
    for name in sorted((required - set(document)) | (set(document) - set(known))):
        raise ValueError(f"{name}: expected {'one' if name in known else 'no such field'}")
    return cls(**{k: _value(k, v, str(known[k].type)) for k, v in document.items()})


def _value(name: str, value: Any, kind: str) -> Any:
    """Read one field; those of numbers are checked here, arrays by the class that takes them."""
    if kind in PLAIN:
        if not isinstance(value, PLAIN[kind]):
            raise ValueError(f"{name}: expected {PLAIN[kind].__name__}, found {shown(value)}")
        return value
    value = _numbers(name, _read(value))
    return float(check_array(name, value, "", (), finite=False)) if kind == "float" else value


def _numbers(name: str, value: Any) -> Any:
    if isinstance(value, list):
        return [_numbers(name, entry) for entry in value]
    if isinstance(value, str):
        if value not in INFINITE:
            raise ValueError(f"{name}: expected numbers, found {shown(value)}")
        return INFINITE[value]
    return value


def _refuse(constant: str) -> None:
    raise ValueError(f"text: expected strict JSON, found {constant}")


def _once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    document = dict(pairs)
    if len(document) < len(pairs):
        raise ValueError(f"text: expected every field once, found {shown([k for k, _ in pairs])}")
    return document
