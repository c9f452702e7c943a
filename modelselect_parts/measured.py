"""Landing on errors that real programs made: fitted on half of the views, flown on the others.

A file of residuals (`perception.read_residuals`) holds what W models erred by on the same views,
whose numbers are one of its variables, ``view``, as is what each took in ``milliseconds``.  Views
are split, not rows: what one model did on a view says something of the others.  The price of a
model is its median time; where it gives nothing, a prior acts in its place.
"""

from __future__ import annotations

import pathlib
from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import numpy as np

import modelselect as ms
from modelselect_parts.checks import Array, Choices, check_class
from modelselect_parts.kernels import Kernel
from modelselect_parts.measurements import Residuals, rows_of
from modelselect_parts.regulator import PATTERNS, roll_out
from modelselect_parts.residual_files import read_residuals
from modelselect_parts.residuals import fit_suite
from modelselect_parts.sight import Aircraft
from modelselect_parts.suites import PerceptionSuite, with_dropouts

Rng = np.random.Generator
TAGS = pathlib.Path(__file__).resolve().parents[1] / "notebooks" / "data" / "tags.csv"
KERNEL = Kernel(0.3, log=["altitude"], relative="altitude")  # errors grow with the distance
PRIOR = 3.3  # ft: how far off the path an aircraft believes to be that sees nothing
LOWEST = 5.0  # ft: closer views were not taken
NEAR = 40  # views that a flight draws from, around its altitude


class Sights(NamedTuple):
    """Views, each with the errors of all models."""

    altitude: Array  #: (views,), increasing
    errors: Array  #: (views, W), NaN where a model gave nothing


def read(path: str | None = None) -> Residuals:
    """Read a file of residuals; by default those of a tag detector (notebooks/data/tags.py)."""
    return read_residuals(TAGS if path is None else path)


def column(residuals: Residuals, name: str) -> Array:
    """Return a variable (N,) of residuals by its name."""
    if name not in residuals.variables:
        found = ", ".join(residuals.variables)
        raise ValueError(f"residuals: expected a column {name} before residual, found {found}")
    table = residuals.altitude.reshape(-1, len(residuals.variables))
    return np.asarray(table[:, list(residuals.variables).index(name)])


def halves(residuals: Residuals, rng: Rng) -> tuple[Residuals, Sights]:
    """Return the rows of a random half of the views, and the other half."""
    check_class("residuals", residuals, "Residuals")
    view, W = column(residuals, "view"), len(residuals.names)
    numbers, count = np.unique(view, return_counts=True)
    if residuals.residual.ndim > 1 or len(numbers) < 2 or set(count) != {W}:
        odd = int(np.argmax(count != W))
        found = f"{count[odd] * residuals.residual[0].size} on view {numbers[odd]:g}"
        raise ValueError(
            f"residuals: expected one number of each of {W} models on each of 2 or more views, "
            f"found {len(numbers)} views, and {found}"
        )
    kept = rng.permutation(numbers)[: len(numbers) // 2]
    flown = rows_of(residuals, ~np.isin(view, kept))
    order = np.lexsort([flown.model, column(flown, "view")])
    altitude = column(flown, "altitude")[order].reshape(-1, W)
    if np.ptp(altitude, axis=1).any() or (flown.model[order].reshape(-1, W) != np.arange(W)).any():
        raise ValueError("residuals: expected every model once, at one altitude, on every view")
    up = altitude[:, 0].argsort(kind="stable")
    errors = flown.residual[order].reshape(-1, W)[up]
    return rows_of(residuals, np.isin(view, kept)), Sights(altitude[up, 0], errors)


def latencies(residuals: Residuals) -> Array:
    """Return the median milliseconds of each model, (W,)."""
    taken = column(residuals, "milliseconds")
    models = range(len(residuals.names))
    return np.array([np.median(taken[residuals.model == w]) for w in models])


def suite_along(residuals: Residuals, path: Array, price: Array) -> PerceptionSuite:
    """Fit a suite along a path (H,) of altitudes; where models give nothing, the prior acts."""
    way = {"altitude": np.maximum(path, LOWEST)}
    table = replace(residuals, ordered=True)  # prices are of the same table
    suite = fit_suite(table, way, price, kernel=KERNEL)
    return with_dropouts(suite, np.asarray(suite.miss_rate), ([0.0], [PRIOR**2]))


def draw(sights: Sights, altitude: Array, rng: Rng) -> Array:
    """Draw errors (N, W) of all models from a view near each altitude (N,), and of the prior."""
    views = len(sights.altitude)
    first = np.searchsorted(sights.altitude, altitude) - NEAR // 2
    first = np.clip(first, 0, max(views - NEAR, 0))  # the same number at either end
    errors = sights.errors[first + rng.integers(0, min(NEAR, views), len(altitude))]
    prior = rng.normal(0, PRIOR, (len(altitude), 1))
    return np.where(np.isnan(errors), prior, errors)


def regret(
    landing: Aircraft,
    information: str,
    gains: Array | None,
    sights: Sights,
    choices: Choices,
    s: Array,
    seed: int,
) -> Array:
    """Return what errors cost flights (N,) through inputs s (N, H, 1), by a seed for all policies.

    Errors are those of views near the altitude at which the aircraft is, so they act back on its
    state; a pattern with foresight is told its errors beforehand, as they are along the path.
    """
    task, path, row = landing.task, landing.path, PATTERNS[information]
    N, H, _ = s.shape
    streams = np.random.default_rng([seed, 1]).spawn(H)  # those of the seed alone draw inputs

    def errors(t: int, altitude: Array) -> Array:
        return draw(sights, np.maximum(altitude, LOWEST), streams[t])[:, [choices[t]]]

    none, told = np.zeros_like(s), np.zeros_like(s)
    prior = np.broadcast_to(landing.prior_mean * row.now, s.shape[1:])[None]
    if row.foresight:
        told = np.stack([errors(t, np.full(N, path[t])) for t in range(H)], axis=1)

    def look(t: int, x: Array) -> Array:
        return told[:, t] if row.foresight else errors(t, path[t] + x[:, 0])

    def cost(see: Callable[[int, Array], Array], off: Array) -> Array:
        ahead = s + off if row.foresight else prior
        x, u = roll_out(task, landing.x0, s, see, information, ahead, gains=gains)
        return np.asarray(ms.control_cost(task, x, u))

    return cost(look, told) - cost(lambda t, x: none[:, t], none)
