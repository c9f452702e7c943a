"""What counts near a place: residuals weighed by how near they were made.

Over several operating variables bins would be empty, so each residual counts by its distance.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from modelselect_parts.checks import (
    Array,
    Frozen,
    Mask,
    check_array,
    check_name,
    check_number,
    check_range,
    shown,
)
from modelselect_parts.checks import Choices as Indices
from modelselect_parts.measurements import Residuals
from modelselect_parts.suites import LARGEST, check_names

MOST_WEIGHTS = 1 << 18  # that are held at a time: 2 MB
Path = ArrayLike | Mapping[str, ArrayLike]  #: one operating variable, or several by name
Axes = dict[str, tuple[Array, Array]]  #: by variable: where residuals were made, and the path


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


# --------------------------------------------------------------- where residuals were made, and go


def errors_of(residuals: Residuals) -> Array:
    """Return the residuals as (N, p)."""
    check_range("residuals", abs(residuals.residual), LARGEST)
    return residuals.residual.reshape(len(residuals.model), -1)


def along(residuals: Residuals, trajectory: Path) -> Axes:
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
        H = len(path_of(axes)) if axes else None
        axes[name] = columns[name], check_path(path, H)
    return axes


def path_of(axes: Axes) -> Array:
    """Return the path (H,) of the first variable."""
    return next(iter(axes.values()))[1]


def check_path(trajectory: ArrayLike, H: int | None) -> Array:
    """Return a trajectory (H,) of one variable."""
    h = check_array("trajectory", trajectory, "H", (H,))
    check_range("trajectory", abs(h), LARGEST)
    return h


def kernel_moments(
    residuals: Residuals, axes: Axes, kernel: Kernel
) -> tuple[Array, Array, Array, Array]:
    """Mean (H, W, p), covariance (H, W, p, p), effective number and miss rate (H, W) by nearness.

    Where a model sees next to nothing the rate is 1, and the moments are 0 and 1.
    """
    r, gone = relate(errors_of(residuals), axes, kernel), residuals.missed
    H, W, p = len(path_of(axes)), len(residuals.names), r.shape[1]
    mean, S = np.zeros((H, W, p)), np.zeros((H, W, p, p)) + np.eye(p)
    n, rate = np.full((H, W), 2.0), np.ones((H, W))
    for steps, w, rows, k in weights(residuals, axes, kernel):
        seen = ~gone[rows]
        e, near = r[rows[seen]], k[:, seen].sum(axis=1)
        known = near >= 2
        t = steps[known]
        a = k[np.ix_(known, seen)] / near[known, None]
        n[t, w] = 1 / (left := (a**2).sum(axis=1))
        rate[t, w] = 1 - near[known] / k[known].sum(axis=1)
        mean[t, w] = a @ e
        d = e - mean[t, w][:, None]
        S[t, w] = np.einsum("ti,tip,tiq->tpq", a, d, d) / (1 - left)[:, None, None]
    z = scale(axes, kernel)
    return mean * z, S * z[..., None] ** 2, n, np.where(rate < 1e-12, 0.0, rate)


def near(axes: Axes, kernel: Kernel) -> Mask:
    """Return which residuals (N,) lie within three widths of the path in each variable."""
    points, path = _coordinates(axes, kernel)
    reach = 3 * kernel.width
    inside = (points >= path.min(axis=0) - reach) & (points <= path.max(axis=0) + reach)
    return np.asarray(inside.all(axis=1))


def weights(
    residuals: Residuals, axes: Axes, kernel: Kernel
) -> Iterator[tuple[Indices, int, Indices, Array]]:
    """Yield some steps (T,), a model, the rows (n,) of its looks, and how much each counts (T, n).

    Of a model with many looks they are fewer steps at a time.
    """
    points, path = _coordinates(axes, kernel)
    for w, name in enumerate(residuals.names):
        rows = np.flatnonzero(residuals.model == w)
        at_once = max(1, MOST_WEIGHTS // max(1, len(rows)))
        for first in range(0, len(path), at_once):
            here = path[first : first + at_once]
            d = (points[rows] - here[:, None]) / kernel.width
            k = np.exp(-0.5 * np.square(d).sum(axis=2))
            steps = np.arange(first, first + len(here))
            if not (near := k.sum(axis=1)).min(initial=2) >= 2:
                t = int(np.flatnonzero(~(near >= 2))[0])
                place = ", ".join(f"{key} {h[first + t]:g}" for key, (_, h) in axes.items())
                raise ValueError(
                    f"residuals: expected 2 or more of {name} near {place}, found {near[t]:.2g} "
                    "within the kernel; widen it or measure more"
                )
            yield steps, w, rows, k


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


def relate(r: Array, axes: Axes, kernel: Kernel) -> Array:
    """Divide the residuals (N, p) by the variable to which they are relative, if there is one."""
    if kernel.relative is None:
        return r
    check_name("kernel.relative", kernel.relative, axes)
    return r / _positive(kernel.relative, axes[kernel.relative])[0][:, None]


def scale(axes: Axes, kernel: Kernel) -> Array:
    """Return that variable along the path, (H, 1, 1)."""
    relative = kernel.relative
    return (np.ones(1) if relative is None else axes[relative][1])[:, None, None]
