"""What to expect of models whose errors were measured: fitted, guarded, and drawn from.

`fit_suite` asks which errors to expect along a path of the operating variables at which they were
made.  Over one variable, residuals are sorted into bins.  Over several, bins would be empty, and
each residual counts by how near it was: a `Kernel`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import chdtri, stdtrit

from modelselect_parts.checks import (
    Array,
    Mask,
    as_numbers,
    check_array,
    check_class,
    check_count,
    check_number,
    check_range,
    check_rng,
)
from modelselect_parts.checks import Choices as Indices
from modelselect_parts.doubts import digits, report, span
from modelselect_parts.kernels import (
    Axes,
    Kernel,
    Path,
    along,
    check_path,
    errors_of,
    kernel_moments,
    near,
    path_of,
    relate,
    scale,
    weights,
)
from modelselect_parts.measurements import Residuals, as_residuals, rows_of
from modelselect_parts.suites import LARGEST, PerceptionSuite, Rng, priced

# ------------------------------------------------------------------------- what to expect, and draw


def fit_suite(
    residuals: Residuals | Any,
    trajectory: Path,
    cost: ArrayLike | Mapping[str, ArrayLike],
    *,
    bins: ArrayLike = 10,
    kernel: Kernel | None = None,
) -> PerceptionSuite:
    """Estimate a suite: moments of the residuals by operating variables, along a trajectory.

    Of the n >= 2 residuals r_i of a model in a bin of altitudes,

        m = sum r_i / n,   v = sum (r_i - m)^2 / (n - 1),   sqrt(v / n)

    are the mean, the unbiased variance, and the standard error of m; where p > 1, v is the
    covariance (H, W, p, p).  Step t takes those of the bin that `trajectory[t]` (H,) falls into;
    `cost` is (W,) or (H, W), or names each model's.  A table of pandas does for `residuals`.

    `bins` are a number of bins of equal width, or increasing edges around the trajectory.  A bin
    includes its lower edge, the last one its upper edge too; residuals outside are not used.

    Looks that gave nothing count for `miss_rate` only, their share in the bin: see `with_dropouts`.
    `used` is the share of residuals that count anywhere on the way; a warning says if it is under a
    half.  Residuals that are all the same tell no variance: one of 0 is refused, unless they have a
    resolution q; then it is q^2/12 at least, that of what rounding to q hides.

    Of residuals over several variables the trajectory is a dictionary, from names of one or more of
    them to (H,); those left out do not count.  With a `kernel` instead of bins, step t weighs all
    residuals of a model by k_i, normalised to a_i = k_i / sum k:

        m = sum a_i r_i,   v = sum a_i (r_i - m)(r_i - m)' / (1 - sum a_i^2),   n = 1 / sum a_i^2

    with n rounded down in `sample_size`.  Near every step there must be sum k >= 2 residuals.
    `used` are those within three widths of the path, each variable by itself.  Where a model gave
    nothing but for fewer than two residuals it is not available: its cost is infinite.
    """
    table = as_residuals(residuals)
    price, seen = _prices(table, cost), _seen(table)
    if kernel is not None:
        check_class("kernel", kernel, "Kernel")
    axes, everywhere = along(seen, trajectory), along(table, trajectory)
    if kernel is None:
        mean, S, n, used = _bin_moments(seen, axes, bins)
        rate = _bin_rate(table, everywhere, bins)
    else:
        mean, S, n, rate = kernel_moments(table, everywhere, kernel)
        price = np.where(rate == 1, np.inf, price) if (rate == 1).any() else price
        used = near(everywhere, kernel)[~table.missed]
    S = _with_resolution(seen, mean, S)
    v = np.einsum("twii->twi", S)
    report(seen, mean, v, axes, used)
    error, variance = np.sqrt(v / n[..., None]), v if v.shape[-1] == 1 else S
    share = float(used.mean())
    return PerceptionSuite(table.names, mean, variance, price, np.floor(n), error, rate, share)


def bootstrap_errors(
    residuals: Residuals | Any,
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
    table, N = as_residuals(residuals), check_count("trials", trials)
    seen, rng = _seen(table), check_rng(rng)
    if kernel is not None:
        check_class("kernel", kernel, "Kernel")
        return _drawn_near(table, along(table, trajectory), kernel, N, rng)
    cell, visited, n = _sort_into_bins(seen, along(seen, trajectory), bins)
    first = np.cumsum(n).reshape(n.shape) - n  # where each cell starts, once they are in order
    pick = first[visited] + rng.integers(n[visited], size=(N, len(visited), len(table.names)))
    return np.asarray(errors_of(seen)[np.argsort(cell, kind="stable")][pick])


def _drawn_near(table: Residuals, axes: Axes, kernel: Kernel, N: int, rng: Rng) -> Array:
    """Draw errors (N, H, W, p) with the chances by which `kernel_moments` weighs them."""
    r, seen = relate(errors_of(table), axes, kernel), ~table.missed
    drawn = np.empty((N, len(path_of(axes)), len(table.names), r.shape[1]))
    for steps, w, rows, k in weights(table, axes, kernel):
        for t, each in zip(steps, k * seen[rows], strict=True):
            if (total := each.sum()) < 2:
                raise ValueError(
                    f"residuals: expected 2 or more of {table.names[w]} near step {t}, found "
                    f"{total:.2g}, as it mostly gave nothing there"
                )
            drawn[:, t, w] = r[rng.choice(rows, N, p=each / total)]
    return drawn * scale(axes, kernel)


def guard_suite(suite: PerceptionSuite, level: float = 0.95) -> PerceptionSuite:
    """Replace moments measured on n residuals by upper confidence bounds of the given level.

    With the quantiles of Student's t and of chi-square at n - 1 degrees of freedom,

        bias away from 0 by t(level) sqrt(v / n),   v (n - 1) / chi-square(1 - level).

    Each bound holds with at least this chance, from 1/2 to below 1, if errors are normal: that of
    each component's bias, and of the variance a'Sa along any one direction a.  A schedule then
    trusts no model because of luck with few residuals.  Where Psi couples steps, a larger bias may
    cancel another: no bound on the cost.
    """
    check_class("suite", suite, "PerceptionSuite")
    if suite.sample_size is None or suite.standard_error is None or suite.sample_size.min() < 2:
        raise ValueError("suite: expected one measured on 2 residuals or more, found another")
    spread = suite.variance if suite.variance.ndim == 3 else np.einsum("twii->twi", suite.variance)
    if not spread.min() > 0:
        raise ValueError("suite: expected measured variances > 0, found 0: of how many digits?")
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

    Of the `altitude` (N,) of residuals, those beyond the `trajectory` (H,) do not count.  Edges are
    fewer where so many altitudes are the same that bins between them would be empty.
    """
    h = check_path(trajectory, None)
    near, bins = check_array("altitude", altitude, "N", (None,)), check_count("count", count)
    _check_moves(h, "altitude", bins)
    near = near[(near > h.min()) & (near < h.max())]
    if len(near) < bins:
        raise ValueError(f"altitude: expected {bins} or more along the way, found {len(near)}")
    inner = np.linspace(0, 1, bins + 1)[1:-1]
    return np.unique([h.min(), *np.quantile(near, inner), h.max()])


# --------------------------------------------------------------------------- what a fit looks at


def _seen(table: Residuals) -> Residuals:
    """Return the rows that hold an error."""
    if (gone := table.missed).all():
        raise ValueError("residuals: expected some errors, found looks that gave nothing only")
    return rows_of(table, ~gone) if gone.any() else table


def _prices(table: Residuals, cost: ArrayLike | Mapping[str, ArrayLike]) -> Array:
    """Return prices (..., W), by name if only a file says in which order the models come."""
    names, by_name = table.names, isinstance(cost, Mapping)
    price = check_array("cost", priced(cost, names), "... W", (len(names),), finite=False)
    if not (table.ordered or by_name) and (price != price[..., :1]).any():
        told = ", ".join(f"{name!r}: ..." for name in names)
        raise ValueError(
            f"cost: expected prices by name, {{{told}}}, as only the file puts the models in this "
            "order, or read_residuals(path, names), found numbers"
        )
    return price


def _with_resolution(residuals: Residuals, mean: Array, S: Array) -> Array:
    """Return covariances with what rounding hides; refuse one of 0, or of sums' rounding."""
    v = np.einsum("twii->twi", S)
    lift = np.maximum(np.square(residuals.resolution) / 12 - v, 0)
    dead = (v + lift <= 1e-24 * (mean**2 + v)).any(axis=-1)
    if dead.any():
        t, w = np.argwhere(dead)[0]
        raise ValueError(
            f"residuals: expected different ones of {residuals.names[w]} near step {t}, found equal"
            " ones; measure more, or state the resolution they are rounded to"
        )
    return np.asarray(S + lift[..., None] * np.eye(v.shape[-1]))


# ------------------------------------------------------------------------------------------- bins


def _bin_moments(
    residuals: Residuals, axes: Axes, bins: ArrayLike
) -> tuple[Array, Array, Array, Mask]:
    """Mean (H, W, p), covariance (H, W, p, p), number (H, W) in the bins; who is in one, (N,)."""
    cell, visited, n = _sort_into_bins(residuals, axes, bins)
    r, W = errors_of(residuals), len(residuals.names)
    # The maxima keep cells with 0 or 1 residuals finite, which no step visits.
    total = np.stack([np.bincount(cell, x, n.size) for x in r.T], -1)
    m = total / np.maximum(n.reshape(-1, 1), 1)
    d = (r - m[cell]).T
    squares = [np.stack([np.bincount(cell, x * y, n.size) for x in d], -1) for y in d]
    v = np.stack(squares, -1) / np.maximum(n.reshape(-1, 1, 1) - 1, 1)
    mean, S = (table.reshape(-1, W, *table.shape[1:])[visited] for table in (m, v))
    return mean, S, n[visited].astype(float), (cell >= W) & (cell < n.size - W)


def _bin_rate(residuals: Residuals, axes: Axes, bins: ArrayLike) -> Array:
    """Return the share (H, W) of looks in the bin of a step that gave nothing."""
    cell, visited, n = _sort_into_bins(residuals, axes, bins)
    missed = np.bincount(cell, residuals.missed, n.size).reshape(n.shape)
    return np.asarray(missed[visited] / n[visited])


def _sort_into_bins(residuals: Residuals, axes: Axes, bins: ArrayLike) -> tuple[Indices, ...]:
    """Sort residuals into cells, one a bin and model, of 2 or more where the path passes.

    Return the cell of every residual (N,), the bin that every step visits (H,), and the number of
    residuals (bins + 2, W) of every cell; the first bin and the last lie outside the edges.
    """
    if len(axes) > 1:
        raise ValueError(f"kernel: expected one for {', '.join(axes)}, as bins hold one of them")
    ((variable, (altitude, h)),) = axes.items()
    edges, W = _bin_edges(bins, h, variable), len(residuals.names)
    check_range("residuals", abs(residuals.residual[~residuals.missed]), LARGEST)
    visited = _bin_of(h, edges)
    cell = _bin_of(altitude, edges) * W + residuals.model
    n = np.bincount(cell, minlength=(len(edges) + 1) * W).reshape(-1, W)
    if n[visited].min() < 2:
        t, w = np.argwhere(n[visited] < 2)[0]
        low, high = edges[visited[t] - 1], edges[visited[t]]
        raise ValueError(
            f"residuals: expected 2 or more of {residuals.names[w]} at {variable}s "
            f"{digits(low)} to {digits(high)}, found {n[visited[t], w]}; use fewer bins or "
            "measure more"
        )
    return cell, visited, n


def _bin_edges(bins: ArrayLike, h: Array, variable: str) -> Array:
    """Return the edges of bins around the path h."""
    if as_numbers("bins", bins).ndim == 0:
        count = check_count("bins", bins)
        _check_moves(h, variable, count)
        edges = np.linspace(h.min(), h.max(), count + 1)
    else:
        edges = check_array("bins", bins, "edges", (None,)).copy()
        check_range("bins", abs(edges), LARGEST)
    increasing = len(edges) > 1 and np.diff(edges).min() > 0
    if not (increasing and set(_bin_of(h, edges)) <= set(range(1, len(edges)))):
        raise ValueError(
            f"bins: expected increasing edges from {digits(h.min())} or less to "
            f"{digits(h.max())} or more, found {len(edges)} edges {span(edges)}"
        )
    return edges


def _check_moves(h: Array, variable: str, count: int) -> None:
    """Refuse a path h (H,) that stays where it is, as no bins can be made of one place."""
    if h.min() == h.max():
        raise ValueError(
            f"trajectory: expected several {variable}s to make {count} bins of, found "
            f"{digits(h[0])} at every step; state edges, such as bins=[low, high]"
        )


def _bin_of(z: Array, edges: Array) -> Indices:
    """Return the bin of each z, from 1 to bins, 0 and bins + 1 beyond the edges.

    A value that lies on an edge but for its last digits is in the bin above it, or in the last.
    """
    rounding = 1e-12 * float(np.abs(edges).max())
    found = np.digitize(z + rounding, edges)
    return np.where(z <= edges[-1] + rounding, np.minimum(found, len(edges) - 1), found)
