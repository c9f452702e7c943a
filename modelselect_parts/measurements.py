"""Measured errors as a table of rows, in memory and in files.

A row says which model looked, where (an altitude; or a range and a bearing), and what it erred by,
s_hat - s, in p components; or that it gave nothing: NaN in memory, an empty cell in a file.
"""

from __future__ import annotations

import csv
import io
import os
import pathlib
import re
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from modelselect_parts.checks import (
    Array,
    Frozen,
    Mask,
    as_numbers,
    check_array,
    check_class,
    frozen,
    shown,
)
from modelselect_parts.checks import Choices as Indices
from modelselect_parts.files import write_atomically
from modelselect_parts.suites import check_names, check_whole

PathLike = str | os.PathLike[str]
HEADER = "model,altitude,residual"
FOREIGN = re.compile(r"[^0-9+\-.eE \t]")  # Python's float also reads 1_000, nan, and other scripts


@dataclass(frozen=True, eq=False)
class Residuals(Frozen):
    """N measured errors s_hat - s, each with the model that made it and the altitude.

    In the place of the altitude there may be V operating variables, a column each, named by
    `variables`; residuals of p components have a column each, named by `components`, whose names
    begin with ``residual``.  A single column is (N,).  Where a model gave nothing, no detection,
    its residual is NaN in all components.

    Components that are angles have a `period`, one number or (p,), infinity for those that are
    none; residuals are taken to lie within half of it around 0.  `resolution`, one number or (p,),
    is what residuals are rounded to, 0 if unknown.
    """

    names: Sequence[str]  #: (W,), distinct
    model: Indices  #: (N,), index in `names`
    altitude: Array  #: (N,) or (N, V), in the units of the trajectory
    residual: Array  #: (N,) or (N, p), in the units of perception
    variables: Sequence[str] = ("altitude",)  #: (V,)
    components: Sequence[str] | None = None  #: (p,); if left out, residual, or residual_0, ...
    period: Any = None  #: (p,) or None
    resolution: Any = 0.0  #: (p,)
    ordered: bool = True  #: whether somebody chose the order of `names`, and not a file

    def __post_init__(self) -> None:
        names = check_names("names", self.names)
        residual = _check_residuals(self.residual)
        N, p = len(residual), residual[0].size
        plain = ["residual"] if p == 1 else [f"residual_{i}" for i in range(p)]
        components = check_names(
            "components", plain if self.components is None else self.components
        )
        variables = check_names("variables", self.variables)
        if split_header(["model", *variables, *components]) != (variables, components):
            raise ValueError(
                "components: expected names that begin with residual, and none of model and "
                f"variables that do, found {shown([*variables, *components])}"
            )
        if len(components) != p:
            raise ValueError(f"components: expected {p} names, found {shown(components)}")
        altitude = _check_columns("altitude", self.altitude, "V", (N, len(variables)))
        model = check_whole("model", self.model, "N", (N,), len(names) - 1)
        self._set(names=names, model=model, altitude=altitude)
        self._set(variables=variables, components=components)
        resolution = _check_each("resolution", self.resolution, p, minimum=0)
        self._set(residual=residual, resolution=resolution)
        if self.period is not None:
            period = _check_each("period", self.period, p, minimum=np.finfo(float).tiny)
            turns = np.round(residual.reshape(N, p) / period)
            turned = residual.reshape(N, p) - np.where(np.isinf(period), 0, period) * turns
            self._set(period=period, residual=_check_residuals(turned.reshape(residual.shape)))

    @property
    def missed(self) -> Mask:
        """Where a model gave nothing, (N,)."""
        return np.isnan(self.residual.reshape(len(self.model), -1)[:, 0])


def rows_of(residuals: Residuals, these: Mask) -> Residuals:
    """Return these rows (N,) only."""
    columns = {name: getattr(residuals, name)[these] for name in ("model", "altitude", "residual")}
    return replace(residuals, **columns)


def _check_residuals(value: ArrayLike) -> Array:
    """Return residuals (N,) or (N, p), NaN where all components of a row are."""
    raw = as_numbers("residual", value)
    gone = np.isnan(raw) if raw.dtype.kind == "f" else np.zeros(raw.shape, dtype=bool)
    if not gone.any():
        return _check_columns("residual", value, "p", (None, None))
    lost = gone if raw.ndim == 1 else gone.reshape(len(raw), -1).any(axis=1)
    if raw.ndim > 1 and not gone[lost].all():
        raise ValueError("residual: expected NaN in all components of a row or none, found some")
    filled = _check_columns("residual", np.where(gone, 0.0, raw), "p", (None, None)).copy()
    filled[lost] = np.nan
    return np.asarray(frozen(filled))


def _check_columns(name: str, value: ArrayLike, axis: str, sizes: tuple[int | None, ...]) -> Array:
    """Return a table (N, k) of k columns, or (N,) of a single one."""
    if as_numbers(name, value).ndim == 2 or (sizes[1] or 1) > 1:
        table = check_array(name, value, f"N {axis}", sizes)
        return table if table.shape[1] > 1 else check_array(name, table[:, 0], "N", sizes[:1])
    return check_array(name, value, "N", sizes[:1])


def _check_each(name: str, value: ArrayLike, p: int, minimum: float) -> Array:
    """Return one number for each component, (p,), given once or p times."""
    axes, sizes = ("", ()) if as_numbers(name, value).ndim == 0 else ("p", (p,))
    each = check_array(name, value, axes, sizes, finite=name != "period") + np.zeros(p)
    if each.min() < minimum:
        sign = ">= 0" if minimum == 0 else "> 0"
        raise ValueError(f"{name}: expected numbers {sign}, found {each.min():g}")
    return np.asarray(frozen(each))


def as_residuals(table: Any) -> Residuals:
    """Return residuals, or the rows of a table with the columns of such a file (pandas, polars)."""
    if isinstance(table, Residuals):
        return table
    wanted = f"Residuals, or a table with the columns {HEADER}"
    if not (hasattr(table, "columns") and hasattr(table, "__getitem__")):
        raise ValueError(f"residuals: expected {wanted}, found {type(table).__name__}")
    header = [str(name) for name in table.columns]
    if (columns := split_header(header)) is None:
        raise ValueError(f"residuals: expected {wanted}, found {shown(','.join(header))}")
    model = [str(name) for name in table[table.columns[0]]]
    number = {name: w for w, name in enumerate(dict.fromkeys(model))}
    where, residual = (np.stack([np.asarray(table[name]) for name in side], 1) for side in columns)
    index = [number[name] for name in model]
    return Residuals(list(number), np.array(index), where, residual, *columns, ordered=False)


# ------------------------------------------------------------------------------------ the files


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
    if decimal not in (".", ",") or not isinstance(sep, str) or len(sep) != 1 or sep == decimal:
        found = f"sep={sep!r}, decimal={decimal!r}"
        raise ValueError(f"sep: expected ',' with decimal='.', or ';' with ',', found {found}")
    known = None if names is None else check_names("names", names)
    ends, rows = _read_rows(path, sep)
    header = [cell.strip() for cell in rows[0]] if rows else []
    if (columns := split_header(header)) is None:
        also = " (or model, variables, and columns that begin with residual)"
        raise _fault(path, (0, *ends, 1)[:2], f"the header {HEADER}", also, sep)
    if len(rows) == 1:
        raise ValueError(f"{path}: expected residuals below the header, found none")
    V, p = map(len, columns)
    resolution = _check_each("resolution", resolution, p, minimum=0)
    try:
        models, where, residual = _parsed(rows[1:], known, V, p, decimal)
    except ValueError:
        bad = next(k for k, row in enumerate(rows) if k and not _parses(row, known, V, p, decimal))
        count = "two" if V + p == 2 else V + p
        wanted = f"{' or '.join(known or ()) or 'a model'} and {count} finite numbers"
        raise _fault(path, (ends[bad - 1], ends[bad]), wanted, "", sep) from None
    if not resolution.any():
        _report_repeated(path, rows[1:], np.isnan(residual[:, 0]))
    number = {name: w for w, name in enumerate(known or dict.fromkeys(models))}
    index = np.array([number[name] for name in models])
    given = *columns, period, resolution, known is not None
    return Residuals(list(number), index, where, residual, *given)


def split_header(header: list[str]) -> tuple[tuple[str, ...], tuple[str, ...]] | None:
    """Names of the variables and of the components in a header; None if it is none."""
    is_residual = [name.lower().startswith("residual") for name in header]
    first = is_residual.index(True) if True in is_residual else 0
    try:
        good = check_names("", header)[0].lower() == "model" and first > 1
    except ValueError:
        return None
    good = good and all(is_residual[first:])
    return (tuple(header[1:first]), tuple(header[first:])) if good else None


def _read_rows(path: PathLike, sep: str) -> tuple[list[int], list[tuple[str, ...]]]:
    """Return the rows of a CSV file that are not blank nor comments, and where each ends."""
    ends: list[int] = []
    rows: list[tuple[str, ...]] = []
    try:
        # Spreadsheets put a byte order mark before UTF-8 text: "-sig" skips it.
        with open(os.fspath(path), encoding="utf-8-sig", newline="") as file:
            reader = csv.reader(file, delimiter=sep, strict=True)
            for row in reader:
                if any(map(str.strip, row)) and not row[0].startswith("#"):
                    ends.append(reader.line_num)
                    rows.append(tuple(row))  # of which no collector of garbage keeps track
    except (OSError, ValueError, csv.Error) as error:
        why = f"{path}: cannot be read as a CSV file: {error}"
        raise ValueError(" ".join(why.split())) from None
    return ends, rows


def _parsed(
    rows: list[tuple[str, ...]], known: tuple[str, ...] | None, V: int, p: int, decimal: str
) -> tuple[list[str], Array, Array]:
    """Return the model of every row, its V variables and its p residuals; ValueError if not all."""
    columns = list(zip(*rows, strict=True))
    if len(columns) != 1 + V + p or {len(row) for row in rows} != {1 + V + p}:
        raise ValueError
    models = list(map(str.strip, columns[0]))
    distinct = set(check_names("", list(dict.fromkeys(models))))
    if known is not None and not distinct <= set(known):
        raise ValueError
    numbers = [_numbers(column, decimal, i >= V) for i, column in enumerate(columns[1:])]
    where, residual = np.stack(numbers[:V], axis=1), np.stack(numbers[V:], axis=1)
    gone = np.isnan(residual)
    if (gone.any(axis=1) != gone.all(axis=1)).any():
        raise ValueError
    return models, where, residual


def _parses(
    row: tuple[str, ...], known: tuple[str, ...] | None, V: int, p: int, decimal: str
) -> bool:
    try:
        _parsed([row], known, V, p, decimal)
    except ValueError:
        return False
    return True


def _numbers(column: Sequence[str], decimal: str, may_be_empty: bool) -> Array:
    """Return finite numbers, NaN of empty cells; a million take a fraction of a second."""
    if decimal != ".":
        if any("." in cell for cell in column):
            raise ValueError
        column = [cell.replace(decimal, ".") for cell in column]
    if FOREIGN.search("".join(column)):
        raise ValueError
    try:
        values = np.array(list(map(float, column)))
    except ValueError:
        if not may_be_empty:
            raise
        values = np.array([float(cell) if cell.strip() else np.nan for cell in column])
    if np.isinf(values).any():
        raise ValueError
    return values


def _fault(
    path: PathLike, between: tuple[int, ...], wanted: str, also: str, sep: str
) -> ValueError:
    """Return the error of what stands between two ends of line, as it stands there."""
    first, last = between
    with open(os.fspath(path), encoding="utf-8-sig") as file:
        text = "".join(line for k, line in enumerate(file, 1) if first < k <= last).strip()
    if any(mark in text for mark in ";\t|".replace(sep, "")) or text.count(",") > 3:
        also += "; for other separators: sep=';', decimal=','"
    return ValueError(f"{path}, line {last}: expected {wanted}, found {text[:60]!r}{also}")


def _report_repeated(path: PathLike, rows: list[tuple[str, ...]], missed: Mask) -> None:
    """Warn of rows that repeat an earlier one; looks that gave nothing may well be alike."""
    made = [row for row, gone in zip(rows, missed, strict=True) if not gone]
    if again := len(made) - len(set(made)):
        warnings.warn(
            f"{path}: {again} of {len(rows)} rows repeat an earlier one to the last digit: were "
            "they logged twice?  If residuals are rounded, state their resolution",
            stacklevel=3,
        )


def write_residuals(path: PathLike, residuals: Residuals) -> None:
    """Write the file at `path` from which `read_residuals` restores them to the last digit."""
    check_class("residuals", residuals, "Residuals")
    header = ["model", *residuals.variables, *(residuals.components or ())]
    names = [residuals.names[w] for w in residuals.model]
    numbers = np.column_stack([residuals.altitude, residuals.residual]).tolist()
    rows = ([name, *map(_cell, row)] for name, row in zip(names, numbers, strict=True))
    text = io.StringIO(newline="")
    csv.writer(text).writerows([header, *rows])
    write_atomically(pathlib.Path(path), text.getvalue().encode(), make_folder=False)


def _cell(number: float) -> float | str:
    return "" if np.isnan(number) else number
