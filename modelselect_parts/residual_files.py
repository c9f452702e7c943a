"""Files of measured errors: read with every fault named, and written to the last digit.

A file says what a table of rows does (measurements.py), with an empty cell where a model gave
nothing.
"""

from __future__ import annotations

import csv
import io
import os
import pathlib
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from modelselect_parts.checks import Array, check_class
from modelselect_parts.files import told, write_atomically
from modelselect_parts.measurements import (
    HEADER,
    PathLike,
    Residuals,
    numbered,
    report_repeated,
    split_header,
)
from modelselect_parts.suites import check_names

PLAIN = b"0123456789+-.eE \t"  # Python's float also reads 1_000, nan, and other scripts


def read_residuals(
    path: PathLike,
    names: Sequence[str] | None = None,
    *,
    sep: str = ",",
    decimal: str = ".",
    period: ArrayLike | None = None,
    resolution: ArrayLike = 0.0,
) -> Residuals:
    """Read a CSV file with the header ``model,altitude,residual`` and one residual a line.

    Any other variable may stand in the place of the altitude, or several, and several components
    in that of the residual: ``model,range,bearing,residual_x,residual_y``.  The columns keep this
    order, as an altitude taken for a residual would pass for one: the model, the variables, and
    from the first name that begins with ``residual`` on, the residuals.  A row whose residuals are
    all empty is a look that gave nothing, no detection.  Leave out no such look: a model that fails
    where it is hard would seem perfect.  What else is known of a look, its time or the number of
    its picture, may be one more variable.  Blanks around cells, empty lines, capitals in the header
    and lines that begin with # do no harm.

    Parameters
    ----------
    path : str or path
        The file, in UTF-8.
    names : sequence of str, optional
        The models in the order of the suite; if left out, that of the file, which a lost line may
        change: `fit_suite` then asks for prices by name.
    sep, decimal : str
        What stands between cells, and between a number's whole part and its fraction.
    period, resolution : float or (p,), optional
        See `Residuals`.

    Returns
    -------
    Residuals
        In the order of the file.

    Warns
    -----
    UserWarning
        Rows that repeat an earlier one to the last digit, unless a resolution is stated: errors
        logged twice make means look surer than they are.

    Raises
    ------
    ValueError
        Any fault, with the file, the line, what was expected and what was found.
    """
    good = isinstance(sep, str) and len(sep) == 1 and sep not in (decimal, *'"#\r\n')
    if decimal not in (".", ",") or not good:
        found = f"sep={sep!r}, decimal={decimal!r}"
        raise ValueError(f"sep: expected ',' with decimal='.', or ';' with ',', found {found}")
    known = None if names is None else check_names("names", names)
    lines, ends, rows = _read_rows(path, sep)

    def fault(k: int, wanted: str, advice: str) -> ValueError:
        first, last = ((0, *ends)[k], ends[k]) if rows else (0, 1)
        text = "".join(lines[first:last]).strip()[:60]
        return ValueError(f"{told(path)}, line {last}: expected {wanted}, found {text!r}{advice}")

    header = [cell.strip() for cell in rows[0]] if rows else []
    if (columns := split_header(header)) is None:
        also = " (or model, variables, and columns that begin with residual)"
        raise fault(0, f"the header {HEADER}", also + _advice(header, len(header), sep, decimal))
    if len(rows) == 1:
        raise ValueError(f"{told(path)}: expected residuals below the header, found none")
    V, p = map(len, columns)
    given = known, V, p, decimal
    try:
        models, where, residual = _parsed(rows[1:], *given)
    except ValueError:
        bad = _first_bad(rows, *given)
        count = "two" if V + p == 2 else V + p
        wanted = f"{' or '.join(known or ()) or 'a model'} and {count} finite numbers"
        raise fault(bad, wanted, _advice(rows[bad], 1 + V + p, sep, decimal)) from None
    table = *numbered(models, known), where, residual, *columns
    residuals = Residuals(*table, period, resolution, known is not None)
    report_repeated(told(path), residuals)
    return residuals


def _read_rows(path: PathLike, sep: str) -> tuple[list[str], list[int], list[tuple[str, ...]]]:
    """Return the lines of a CSV file, without comments; its rows but blank ones, and their ends."""
    ends: list[int] = []
    rows: list[tuple[str, ...]] = []
    try:
        # Spreadsheets put a byte order mark before UTF-8 text: "-sig" skips it.
        with open(os.fspath(path), encoding="utf-8-sig", newline="") as file:
            lines = ["\n" if line.startswith("#") else line for line in file]
        reader = csv.reader(lines, delimiter=sep, strict=True)
        for row in reader:
            if "".join(row).strip():
                ends.append(reader.line_num)
                rows.append(tuple(row))  # of which no collector of garbage keeps track
    except (OSError, TypeError, ValueError, csv.Error) as error:
        raise ValueError(told(f"{path}: cannot be read as a CSV file: {error}")) from None
    return lines, ends, rows


def _parsed(
    rows: list[tuple[str, ...]], known: tuple[str, ...] | None, V: int, p: int, decimal: str
) -> tuple[list[str], Array, Array]:
    """Return the model of every row, its V variables and its p residuals; ValueError if not all."""
    if set(map(len, rows)) != {1 + V + p}:
        raise ValueError
    models, *columns = ([row[i] for row in rows] for i in range(1 + V + p))
    models = list(map(str.strip, models))
    distinct = set(check_names("", list(dict.fromkeys(models))))
    if known is not None and not distinct <= set(known):
        raise ValueError
    numbers = [_numbers(column, decimal, i >= V) for i, column in enumerate(columns)]
    where, residual = np.stack(numbers[:V], axis=1), np.stack(numbers[V:], axis=1)
    gone = np.isnan(residual)
    if (gone.any(axis=1) != gone.all(axis=1)).any():
        raise ValueError
    return models, where, residual


def _first_bad(rows: list[tuple[str, ...]], *given: Any) -> int:
    """Return which row below the header is the first that cannot be parsed, by halving."""
    first, beyond = 1, len(rows)
    while beyond - first > 1:
        middle = (first + beyond) // 2
        try:
            _parsed(rows[first:middle], *given)
            first = middle
        except ValueError:
            beyond = middle
    return first


def _numbers(column: Sequence[str], decimal: str, may_be_empty: bool) -> Array:
    """Return finite numbers, NaN of empty cells; a million take a fraction of a second."""
    if decimal != ".":
        if any("." in cell for cell in column):
            raise ValueError
        column = [cell.replace(decimal, ".") for cell in column]
    if "".join(column).encode().translate(None, PLAIN):
        raise ValueError
    try:
        values = np.fromiter(map(float, column), float, len(column))
    except ValueError:
        if not may_be_empty:
            raise
        values = np.array([float(cell) if cell.strip() else np.nan for cell in column])
    if np.isinf(values).any():
        raise ValueError
    return values


def _advice(row: Sequence[str], count: int, sep: str, decimal: str) -> str:
    """Return what may help with a row that should have had so many cells."""
    if {cell.strip().lower() for cell in row} & {"nan", "na", "none", "null"}:
        return "; where a model gave nothing, leave its residuals empty"
    if (sep, decimal) != (",", "."):
        return f"; read with sep={sep!r}, decimal={decimal!r}"
    foreign = any(mark in cell for cell in row for mark in ";\t|")
    return "; for other separators: sep=';', decimal=','" if foreign or len(row) > count else ""


def write_residuals(path: PathLike, residuals: Residuals) -> None:
    """Write the file at `path` from which `read_residuals` restores them to the last digit."""
    check_class("residuals", residuals, "Residuals")
    header = ["model", *residuals.variables, *(residuals.components or ())]
    names = [residuals.names[w] for w in residuals.model]
    numbers = np.column_stack([residuals.altitude, residuals.residual]).tolist()
    rows = ([name, *map(_cell, row)] for name, row in zip(names, numbers, strict=True))
    text = io.StringIO(newline="")
    csv.writer(text).writerows([header, *rows])
    try:
        write_atomically(pathlib.Path(path), text.getvalue().encode(), make_folder=False)
    except (OSError, TypeError, ValueError) as error:
        why = getattr(error, "strerror", None) or error
        found = f"{told(path)}: {why}"
        raise ValueError(f"path: expected one that can be written, found {found}") from None


def _cell(number: float) -> float | str:
    return "" if np.isnan(number) else number
