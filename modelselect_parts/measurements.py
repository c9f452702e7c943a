"""Measured errors as a table of rows.

A row says which model looked, where (an altitude; or a range and a bearing), and what it erred by,
s_hat - s, in p components; or that it gave nothing: NaN in memory, an empty cell in a file.
"""

from __future__ import annotations

import os
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from modelselect_parts.checks import (
    Array,
    Frozen,
    Mask,
    as_numbers,
    check_array,
    frozen,
    shown,
)
from modelselect_parts.checks import Choices as Indices
from modelselect_parts.suites import check_names, check_whole

PathLike = str | os.PathLike[str]
HEADER = "model,altitude,residual"


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
        resolution = check_each("resolution", self.resolution, p, minimum=0)
        self._set(residual=residual, resolution=resolution)
        if self.period is not None:
            period = check_each("period", self.period, p, minimum=np.finfo(float).tiny)
            with np.errstate(all="ignore"):  # checked thereafter
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


def check_each(name: str, value: ArrayLike, p: int, minimum: float) -> Array:
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
    key = dict(zip(header, table.columns, strict=True))
    given = list(table[key[header[0]]])
    if odd := [name for name in given if not isinstance(name, str | int | np.integer)]:
        raise ValueError(f"residuals: expected a model in every row, found {shown(odd[0])}")
    model, N = list(map(str, given)), len(given)
    where, residual = (
        np.stack([_check_length(name, table[key[name]], N) for name in side], 1) for side in columns
    )
    names, index = numbered(model, None)
    found = Residuals(names, index, where, residual, *columns, ordered=False)
    report_repeated("residuals", found, stacklevel=4)
    return found


def _check_length(name: str, value: ArrayLike, N: int) -> NDArray[Any]:
    """Return a column (N,) of numbers, which may be NaN."""
    column = as_numbers(name, value)
    if column.shape != (N,):
        raise ValueError(f"{name}: expected shape (N,) = ({N},), found {column.shape}")
    return column


def numbered(model: list[str], names: tuple[str, ...] | None) -> tuple[list[str], Indices]:
    """Return all names, by default as they come, and the index of each row's model, (N,)."""
    number = {name: w for w, name in enumerate(names or dict.fromkeys(model))}
    return list(number), np.array([number[name] for name in model])


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


def report_repeated(source: str, residuals: Residuals, stacklevel: int = 3) -> None:
    """Warn of rows that repeat an earlier one; looks that gave nothing may well be alike."""
    if residuals.resolution.any():
        return
    columns = [residuals.model, residuals.altitude, residuals.residual]
    rows = np.column_stack(columns)[~residuals.missed] + 0.0  # so that -0 is 0
    again = len(rows) - len(set(rows.view(f"V{8 * rows.shape[1]}").ravel().tolist()))
    if again:
        warnings.warn(
            f"{source}: {again} of {len(residuals.model)} rows repeat an earlier one to the last "
            "digit: were they logged twice?  If residuals are rounded, state their resolution",
            stacklevel=stacklevel,
        )
