"""Measured errors: read, written, fitted, guarded, and drawn from.

Each residual s_hat - s has p components and was made where V operating variables (an altitude; or
a range and a bearing) had certain values.  `fit_suite` asks which errors to expect along a path of
these variables.  Over one of them, residuals are sorted into bins.  Over several, bins would be
empty, and each residual counts by how near it was: a `Kernel`.
"""

from __future__ import annotations

import csv
import io
import os
import pathlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import chdtri, stdtrit

from modelselect_parts.checks import (
    Array,
    Frozen,
    as_numbers,
    check_array,
    check_count,
    check_name,
    check_number,
    check_range,
    check_rng,
    shown,
)
from modelselect_parts.checks import Choices as Indices
from modelselect_parts.files import write_atomically
from modelselect_parts.suites import LARGEST, PerceptionSuite, Rng, check_names, check_whole

PathLike = str | os.PathLike[str]
Path = ArrayLike | Mapping[str, ArrayLike]  #: one operating variable, or several by name
Axes = dict[str, tuple[Array, Array]]  #: by variable: where residuals were made, and the path


@dataclass(frozen=True, eq=False)
class Residuals(Frozen):
    """N measured errors s_hat - s, each with the model that made it and the altitude.

    In the place of the altitude there may be V operating variables, a column each, named by
    `variables`; residuals of p components have a column each, named by `components`, whose names
    begin with ``residual``.  A single column is (N,).
    """

    names: Sequence[str]  #: (W,), distinct
    model: Indices  #: (N,), index in `names`
    altitude: Array  #: (N,) or (N, V), in the units of the trajectory
    residual: Array  #: (N,) or (N, p), in the units of perception
    variables: Sequence[str] = ("altitude",)  #: (V,)
    components: Sequence[str] | None = None  #: (p,); if left out, residual, or residual_0, ...

    def __post_init__(self) -> None:
        names = check_names("names", self.names)
        residual = _check_columns("residual", self.residual, "p", (None, None))
        N, p = len(residual), residual[0].size
        plain = ["residual"] if p == 1 else [f"residual_{i}" for i in range(p)]
        components = check_names(
            "components", plain if self.components is None else self.components
        )
        variables = check_names("variables", self.variables)
        if _split_header(["model", *variables, *components]) != (variables, components):
            raise ValueError(
                "components: expected names that begin with residual, and none of model and "
                f"variables that do, found {shown([*variables, *components])}"
            )
        if len(components) != p:
            raise ValueError(f"components: expected {p} names, found {shown(components)}")
        altitude = _check_columns("altitude", self.altitude, "V", (N, len(variables)))
        model = check_whole("model", self.model, "N", (N,), len(names) - 1)
        self._set(names=names, model=model, altitude=altitude, residual=residual)
        self._set(variables=variables, components=components)


def _check_columns(name: str, value: ArrayLike, axis: str, sizes: tuple[int | None, ...]) -> Array:
    """Return a table (N, k) of k columns, or (N,) of a single one."""
    if as_numbers(name, value).ndim == 2 or (sizes[1] or 1) > 1:
        table = check_array(name, value, f"N {axis}", sizes)
        return table if table.shape[1] > 1 else check_array(name, table[:, 0], "N", sizes[:1])
    return check_array(name, value, "N", sizes[:1])


# ------------------------------------------------------------------------------------ the files


def read_residuals(path: PathLike, names: Sequence[str] | None = None) -> Residuals:
    """Read a CSV file with the header ``model,altitude,residual`` and one residual a line.

    Any other variable may stand in the place of the altitude, or several, and several components
    in that of the residual: ``model,range,bearing,residual_x,residual_y``.  The columns keep this
    order, as an altitude taken for a residual would pass for one: the model, the variables, and
    from the first name that begins with ``residual`` on, the residuals.  Blanks around cells and
    empty lines do no harm.

    Parameters
    ----------
    path : str or path
        The file, in UTF-8.
    names : sequence of str, optional
        The models in the order of the suite; that of the file if left out.

    Returns
    -------
    Residuals
        In the order of the file.

    Raises
    ------
    ValueError
        Any fault, with the file, the line, what was expected and what was found.
    """
    (line, header), *rows = _read_rows(path) or [(1, [])]
    columns = _split_header(header)
    if columns is None:
        found = repr(",".join(header)[:60])
        raise ValueError(
            f"{path}, line {line}: expected the header model,altitude,residual, found {found}"
            " (or model, variables, and columns that begin with residual)"
        )
    if not rows:
        raise ValueError(f"{path}: expected residuals below the header, found none")
    V, p = map(len, columns)
    number = {} if names is None else {n: w for w, n in enumerate(check_names("names", names))}
    count = "two" if V + p == 2 else V + p
    wanted = f"{' or '.join(number) or 'a model'} and {count} finite numbers"
    records = []
    for line, row in rows:
        try:
            (model,) = check_names("names", row[:1])
            values = check_array("", [float(cell) for cell in row[1:]], "n", (V + p,))
            w = number.setdefault(model, len(number)) if names is None else number[model]
        except (ValueError, KeyError):
            found = ",".join(row)[:60]
            raise ValueError(f"{path}, line {line}: expected {wanted}, found {found!r}") from None
        records.append((w, *values))
    table = np.array(records)
    where, residual = table[:, 1 : 1 + V], table[:, 1 + V :]
    return Residuals(list(number), table[:, 0], where, residual, *columns)


def _split_header(header: list[str]) -> tuple[tuple[str, ...], tuple[str, ...]] | None:
    """Names of the variables and of the components in a header; None if it is none."""
    is_residual = [name.startswith("residual") for name in header]
    first = is_residual.index(True) if True in is_residual else 0
    try:
        good = check_names("", header)[0] == "model" and first > 1 and all(is_residual[first:])
    except ValueError:
        return None
    return (tuple(header[1:first]), tuple(header[first:])) if good else None


def _read_rows(path: PathLike) -> list[tuple[int, list[str]]]:
    """Line number and stripped cells of all rows of a CSV file that are not blank."""
    try:
        # Spreadsheets put a byte order mark before UTF-8 text: "-sig" skips it.
        with open(os.fspath(path), encoding="utf-8-sig", newline="") as file:
            reader = csv.reader(file, strict=True)
            lines = [(reader.line_num, [cell.strip() for cell in row]) for row in reader]
    except (OSError, ValueError, csv.Error) as error:
        why = f"{path}: cannot be read as a CSV file: {error}"
        raise ValueError(" ".join(why.split())) from None
    return [(line, row) for line, row in lines if any(row)]


def write_residuals(path: PathLike, residuals: Residuals) -> None:
    """Write the file at `path` from which `read_residuals` restores them to the last digit."""
    header = ["model", *residuals.variables, *(residuals.components or ())]
    names = [residuals.names[w] for w in residuals.model]
    numbers = np.column_stack([residuals.altitude, residuals.residual]).tolist()
    rows = [[name, *row] for name, row in zip(names, numbers, strict=True)]
    text = io.StringIO(newline="")
    csv.writer(text).writerows([header, *rows])
    write_atomically(pathlib.Path(path), text.getvalue().encode(), make_folder=False)


# ------------------------------------------------------------------------- what to expect, and draw


@dataclass(frozen=True)
class Kernel(Frozen):
    """How near a residual must have been made to count: Nadaraya-Watson, with normal weights.

    Each variable is measured in standard deviations of its own over all residuals, those named in
    `log` after taking the logarithm.  At distance d a residual counts k(d) = exp(-d^2/(2 width^2)).
    If errors grow in proportion to a variable such as the distance, `relative` is its name: what is
    averaged is then residual / variable, times the variable on the way.

    A wide kernel mixes what differs: a mean that changes by b within a width is off by up to about
    b (at the ends of the data), and adds b^2 to the variance.
    """

    width: float = 0.3  #: > 0, in standard deviations
    log: Sequence[str] = ()
    relative: str | None = None

    def __post_init__(self) -> None:
        if not (width := check_number("width", self.width)) > 0:
            raise ValueError(f"width: expected a number > 0, found {width:g}")
        empty = isinstance(self.log, list | tuple) and not self.log
        log = () if empty else check_names("log", self.log)
        if self.relative is not None:
            check_names("relative", [self.relative])
        self._set(width=width, log=log)


def fit_suite(
    residuals: Residuals,
    trajectory: Path,
    cost: ArrayLike,
    *,
    bins: ArrayLike = 10,
    kernel: Kernel | None = None,
) -> PerceptionSuite:
    """Estimate a suite: moments of the residuals by operating variables, along a trajectory.

    Of the n >= 2 residuals r_i of a model in a bin of altitudes,

        m = sum r_i / n,   v = sum (r_i - m)^2 / (n - 1),   sqrt(v / n)

    are the mean, the unbiased variance, and the standard error of m; where p > 1, v is the
    covariance (H, W, p, p).  Step t takes those of the bin that `trajectory[t]` (H,) falls into;
    `cost` is (W,) or (H, W).

    `bins` are a number of bins of equal width, or increasing edges around the trajectory.  A bin
    includes its lower edge, the last one its upper edge too; residuals outside are not used.

    Of residuals over several variables the trajectory is a dictionary, from names of one or more of
    them to (H,); those left out do not count.  With a `kernel` instead of bins, step t weighs all
    residuals of a model by k_i, normalised to a_i = k_i / sum k:

        m = sum a_i r_i,   v = sum a_i (r_i - m)(r_i - m)' / (1 - sum a_i^2),   n = 1 / sum a_i^2

    with n rounded down in `sample_size`.  Near every step there must be sum k >= 2 residuals.
    """
    axes = _along(residuals, trajectory)
    if kernel is None:
        mean, S, n = _bin_moments(residuals, axes, bins)
    else:
        mean, S, n = _kernel_moments(residuals, axes, kernel)
    price = check_array("cost", cost, "... W", (len(residuals.names),), finite=False)
    v = np.einsum("twii->twi", S)
    error = np.sqrt(v / n[..., None])
    variance = v if v.shape[-1] == 1 else S
    return PerceptionSuite(residuals.names, mean, variance, price, np.floor(n), error)


def bootstrap_errors(
    residuals: Residuals,
    trajectory: Path,
    trials: int,
    rng: Rng,
    *,
    bins: ArrayLike = 10,
    kernel: Kernel | None = None,
) -> Array:
    """Draw errors (trials, H, W, p) from the residuals themselves, instead of `sample_errors`.

    Step t and model w draw, with equal chances, from the n residuals that `fit_suite` would use
    with this `trajectory` and these `bins`, or with chances a_i by `kernel`, all p components of
    one residual together.  Their mean is that of the suite, their variance (n - 1) / n of its own.
    """
    axes, N = _along(residuals, trajectory), check_count("trials", trials)
    r = _errors(residuals)
    if kernel is not None:
        r, weighed = _relate(r, axes, kernel), _weights(residuals, axes, kernel)
        H, W = len(_path_of(axes)), len(residuals.names)
        drawn = np.empty((N, H, W, r.shape[1]))
        for t, w, rows, a in weighed:
            drawn[:, t, w] = r[check_rng(rng).choice(rows, N, p=a)]
        return drawn * _scale(axes, kernel)
    cell, visited, n = _sort_into_bins(residuals, axes, bins)
    first = np.cumsum(n).reshape(n.shape) - n  # where each cell starts, once they are in order
    shape = (N, len(visited), len(residuals.names))
    pick = first[visited] + check_rng(rng).integers(n[visited], size=shape)
    return np.asarray(r[np.argsort(cell, kind="stable")][pick])


def guard_suite(suite: PerceptionSuite, level: float = 0.95) -> PerceptionSuite:
    """Replace moments measured on n residuals by upper confidence bounds of the given level.

    With the quantiles of Student's t and of chi-square at n - 1 degrees of freedom,

        bias away from 0 by t(level) sqrt(v / n),   v (n - 1) / chi-square(1 - level).

    Each bound holds with at least this chance, from 1/2 to below 1, if errors are normal: that of
    each component's bias, and of the variance a'Sa along any one direction a.  A schedule then
    trusts no model because of luck with few residuals.  Where Psi couples steps, a larger bias may
    cancel another: no bound on the cost.
    """
    if suite.sample_size is None or suite.standard_error is None or suite.sample_size.min() < 2:
        raise ValueError("suite: expected one measured on 2 residuals or more, found another")
    if not 0.5 <= (chance := check_number("level", level)) < 1:
        raise ValueError(f"level: expected a number from 0.5 to below 1, found {chance:g}")
    freedom = suite.sample_size[..., None] - 1.0
    away = np.where(suite.mean < 0, -1, 1) * stdtrit(freedom, chance) * suite.standard_error
    if suite.variance.ndim == 4:
        freedom = freedom[..., None]
    variance = suite.variance * freedom / chdtri(freedom, chance)
    return replace(suite, mean=suite.mean + away, variance=variance)


def altitude_bins(altitude: ArrayLike, trajectory: ArrayLike, count: int) -> Array:
    """Return count + 1 edges around a trajectory, with equally many altitudes in every bin.

    Of the `altitude` (N,) of residuals, those beyond the `trajectory` (H,) do not count.
    """
    h = _check_path(trajectory, None)
    near = check_array("altitude", altitude, "N", (None,))
    near, bins = near[(near > h.min()) & (near < h.max())], check_count("count", count)
    if len(near) < bins:
        raise ValueError(f"altitude: expected {bins} or more along the way, found {len(near)}")
    inner = np.linspace(0, 1, bins + 1)[1:-1]
    return np.array([h.min(), *np.quantile(near, inner), h.max()])


def _errors(residuals: Residuals) -> Array:
    """Return the residuals as (N, p)."""
    check_range("residuals", abs(residuals.residual), LARGEST)
    return residuals.residual.reshape(len(residuals.model), -1)


def _along(residuals: Residuals, trajectory: Path) -> Axes:
    """Return, for each variable of the trajectory, where residuals were made (N,) and it (H,)."""
    names = residuals.variables
    columns = dict(zip(names, residuals.altitude.reshape(-1, len(names)).T, strict=True))
    if not isinstance(trajectory, Mapping):
        if len(names) > 1:
            wanted = f"a dictionary from some of {', '.join(names)} to arrays"
            raise ValueError(f"trajectory: expected {wanted}, found {shown(trajectory)}")
        trajectory = {names[0]: trajectory}
    if not trajectory:
        raise ValueError(f"trajectory: expected some of {', '.join(names)}, found none")
    axes: Axes = {}
    for name, path in trajectory.items():
        check_name("trajectory", name, names)
        H = len(_path_of(axes)) if axes else None
        axes[name] = columns[name], _check_path(path, H)
    return axes


def _path_of(axes: Axes) -> Array:
    """Return the path (H,) of the first variable."""
    return next(iter(axes.values()))[1]


def _check_path(trajectory: ArrayLike, H: int | None) -> Array:
    """Return a trajectory (H,) of one variable."""
    h = check_array("trajectory", trajectory, "H", (H,))
    check_range("trajectory", abs(h), LARGEST)
    return h


# ------------------------------------------------------------------------------------------- bins


def _bin_moments(residuals: Residuals, axes: Axes, bins: ArrayLike) -> tuple[Array, Array, Array]:
    """Mean (H, W, p), covariance (H, W, p, p) and number (H, W) of residuals in the bins."""
    cell, visited, n = _sort_into_bins(residuals, axes, bins)
    r, W = _errors(residuals), len(residuals.names)
    # The maxima keep cells with 0 or 1 residuals finite, which no step visits.
    total = np.stack([np.bincount(cell, x, n.size) for x in r.T], -1)
    m = total / np.maximum(n.reshape(-1, 1), 1)
    d = (r - m[cell]).T
    squares = [np.stack([np.bincount(cell, x * y, n.size) for x in d], -1) for y in d]
    v = np.stack(squares, -1) / np.maximum(n.reshape(-1, 1, 1) - 1, 1)
    mean, S = (table.reshape(-1, W, *table.shape[1:])[visited] for table in (m, v))
    return mean, S, n[visited].astype(float)


def _sort_into_bins(residuals: Residuals, axes: Axes, bins: ArrayLike) -> tuple[Indices, ...]:
    """Sort residuals into cells, one a bin and model, of 2 or more where the path passes.

    Return the cell of every residual (N,), the bin that every step visits (H,), and the number of
    residuals (bins + 2, W) of every cell; the first bin and the last lie outside the edges.
    """
    if len(axes) > 1:
        raise ValueError(f"kernel: expected one for {', '.join(axes)}, as bins hold one of them")
    ((variable, (altitude, h)),) = axes.items()
    edges, W = _bin_edges(bins, h), len(residuals.names)
    check_range("residuals", abs(residuals.residual), LARGEST)
    visited = np.digitize(h, edges)
    cell = np.digitize(altitude, edges) * W + residuals.model
    n = np.bincount(cell, minlength=(len(edges) + 1) * W).reshape(-1, W)
    if n[visited].min() < 2:
        t, w = np.argwhere(n[visited] < 2)[0]
        low, high = edges[visited[t] - 1], edges[visited[t]]
        raise ValueError(
            f"residuals: expected 2 or more of {residuals.names[w]} at {variable}s "
            f"{low:g} to {high:g}, found {n[visited[t], w]}; use fewer bins or measure more"
        )
    return cell, visited, n


def _bin_edges(bins: ArrayLike, h: Array) -> Array:
    """Return the edges of bins around the altitudes h, the last moved up by a rounding step."""
    if as_numbers("bins", bins).ndim == 0:
        edges = np.linspace(h.min(), h.max(), check_count("bins", bins) + 1)
    else:
        edges = check_array("bins", bins, "edges", (None,)).copy()
        check_range("bins", abs(edges), LARGEST)
    if len(edges) < 2 or np.diff(edges).min() <= 0 or h.min() < edges[0] or h.max() > edges[-1]:
        raise ValueError(
            f"bins: expected increasing edges from {h.min():g} or less to {h.max():g} or more, "
            f"found {len(edges)} edges from {edges[0]:g} to {edges[-1]:g}"
        )
    edges[-1] = np.nextafter(edges[-1], np.inf)  # so that the half-open last bin holds its edge
    return edges


# ---------------------------------------------------------------------------------------- kernels


def _kernel_moments(residuals: Residuals, axes: Axes, kernel: Kernel) -> tuple[Array, Array, Array]:
    """Mean (H, W, p), covariance (H, W, p, p) and effective number (H, W) by nearness."""
    r = _relate(_errors(residuals), axes, kernel)
    H, W, p = len(_path_of(axes)), len(residuals.names), r.shape[1]
    mean, S, n = np.empty((H, W, p)), np.empty((H, W, p, p)), np.empty((H, W))
    for t, w, rows, a in _weights(residuals, axes, kernel):
        n[t, w] = 1 / (a @ a)
        mean[t, w] = a @ r[rows]
        d = r[rows] - mean[t, w]
        S[t, w] = (a * d.T) @ d / (1 - a @ a)
    z = _scale(axes, kernel)
    return mean * z, S * z[..., None] ** 2, n


def _weights(
    residuals: Residuals, axes: Axes, kernel: Kernel
) -> Iterator[tuple[int, int, Indices, Array]]:
    """Yield each step and model, the rows of its residuals, and their weights, which sum to 1."""
    points, path = _coordinates(axes, kernel)
    for w, name in enumerate(residuals.names):
        rows = np.flatnonzero(residuals.model == w)
        for t, here in enumerate(path):
            k = np.exp(-0.5 * np.square((points[rows] - here) / kernel.width).sum(axis=1))
            if not (near := k.sum()) >= 2:
                place = ", ".join(f"{key} {h[t]:g}" for key, (_, h) in axes.items())
                raise ValueError(
                    f"residuals: expected 2 or more of {name} near {place}, found {near:.2g} "
                    "within the kernel; widen it or measure more"
                )
            yield t, w, rows, k / near


def _coordinates(axes: Axes, kernel: Kernel) -> tuple[Array, Array]:
    """Return residuals (N, V) and path (H, V) in standard deviations of each variable."""
    for name in kernel.log:
        check_name("kernel.log", name, axes)
    columns = []
    for name, pair in axes.items():
        z, h = map(np.log, _positive(name, pair)) if name in kernel.log else pair
        check_range(name, abs(z), LARGEST)
        if not (deviation := z.std()) > 0:
            raise ValueError(f"residuals: expected several values of {name}, found {z[0]:g} only")
        columns.append((z / deviation, h / deviation))
    points, path = (np.stack(side, axis=1) for side in zip(*columns, strict=True))
    return points, path


def _positive(name: str, pair: tuple[Array, Array]) -> tuple[Array, Array]:
    """Refuse a variable that is not above 0, at residuals or along the path."""
    if not (least := min(x.min() for x in pair)) > 0:
        raise ValueError(f"kernel: expected {name} > 0 for a logarithm or a ratio, found {least:g}")
    return pair


def _relate(r: Array, axes: Axes, kernel: Kernel) -> Array:
    """Divide the residuals (N, p) by the variable to which they are relative, if there is one."""
    if kernel.relative is None:
        return r
    check_name("kernel.relative", kernel.relative, axes)
    return r / _positive(kernel.relative, axes[kernel.relative])[0][:, None]


def _scale(axes: Axes, kernel: Kernel) -> Array:
    """Return that variable along the path, (H, 1, 1)."""
    relative = kernel.relative
    return (np.ones(1) if relative is None else axes[relative][1])[:, None, None]
