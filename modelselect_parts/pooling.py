"""Errors that grow with distance, pooled: what to expect of them, how surely, and what to undo.

A camera sees ratios: at a distance z twice as large the same network errs twice as far.  So let

    e = z r,    z = altitude + `MOUNT`,

and average the scaled errors r over pictures taken from about as far, in ln z: of the same
pictures a bin that is narrow enough for e holds few, and a kernel over ln z many.

Pictures are the unit of chance.  All models saw the same ones, and those of one landing show the
same scene: so a bootstrap draws whole *groups* of pictures anew, a calibration is judged on groups
that it was not fitted to, and a guard counts groups.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from modelselect_parts.camera import HIGHEST, LOWEST, MOUNT
from modelselect_parts.checks import Array, Choices, check_class, check_count
from modelselect_parts.kernels import Kernel
from modelselect_parts.measurements import Residuals
from modelselect_parts.networks import Network
from modelselect_parts.residuals import altitude_bins, bootstrap_errors, fit_suite
from modelselect_parts.suites import PerceptionSuite

Rng = np.random.Generator
WIDTH = 0.3  # of the kernel, in ln z: a factor of 1.35 in distance
REDRAWN = 200  # bootstrap samples, which give a standard error to 5%
FOLDS = 5  # parts of the pictures, each calibrated by the rest


class Labelled(NamedTuple):
    """Errors of W models on the same M pictures, whose altitude is known."""

    altitude: Array  #: (M,), ft, where they were taken
    error: Array  #: (W, M), s_hat - s in ft
    group: Choices  #: (M,), from 0 on and ascending; pictures of one group show the same scene
    planned: Array  #: (M,), ft, where on a path they count: where a landing should have been

    @property
    def distance(self) -> Array:
        """The distance z (M,) at which they count, within the camera's reach."""
        return np.clip(self.planned, LOWEST, HIGHEST) + MOUNT

    def over(self, name: str) -> Residuals:
        """Return the errors over a variable of this name, all those of the first model first."""
        W, variable = len(self.error), getattr(self, name)
        model, names = np.repeat(np.arange(W), len(variable)), [f"b{w}" for w in range(W)]
        return Residuals(names, model, np.tile(variable, W), self.error.ravel(), [name])


def labelled(measured: Residuals | Labelled) -> Labelled:
    """Return residuals of all models on the same pictures as such, each a group of its own."""
    if isinstance(measured, Labelled):
        return measured
    check_class("measured", measured, "Residuals")
    W, M = len(measured.names), len(measured.model) // len(measured.names)
    if measured.residual.size != len(measured.model) or len(measured.variables) > 1:
        raise ValueError("measured: expected errors (N,) over one variable, found several columns")
    if not np.array_equal(measured.model, np.repeat(np.arange(W), M)):
        raise ValueError("measured: expected all models on the same pictures, one after the other")
    h, e = measured.altitude.reshape(W, -1)[0], measured.residual.reshape(W, -1)
    if (measured.altitude != np.tile(h, W)).any():
        raise ValueError("measured: expected all models at the same altitudes, in the same order")
    return Labelled(h, e, np.arange(len(h)), h)


def _groups(pictures: Labelled) -> int:
    """Return how many groups there are; of a single one none can be left out, or drawn instead."""
    if (count := len(np.unique(pictures.group))) < 2:
        raise ValueError(f"measured: expected pictures of 2 or more groups, found {count}")
    return count


def joined(first: Labelled, second: Labelled) -> Labelled:
    """Return the pictures of both; their groups stay apart."""
    second = second._replace(group=second.group + first.group.max() + 1)
    return Labelled(*(np.concatenate(pair, axis=-1) for pair in zip(first, second, strict=True)))


# -------------------------------------------------------------------------------------- the fit


def _nearness(at: Array, here: Array, width: float) -> Array:
    """Weights (H, M) of pictures at distances (M,), as seen from others (H,)."""
    apart = (np.log(at) - np.log(here)[:, None]) / width
    return np.exp(-0.5 * apart**2)


def _kernel(pictures: Labelled) -> Kernel:
    """Return the kernel of `WIDTH` in ln z, as `fit_suite` takes it: in deviations of ln z."""
    if not np.ptp(pictures.distance) > 0:
        raise ValueError("measured: expected pictures from several altitudes, found one only")
    return Kernel(WIDTH / np.log(pictures.distance).std(), log=["distance"], relative="distance")


def pooled_suite(pictures: Labelled, path: Array, cost: npt.ArrayLike) -> PerceptionSuite:
    """Fit a suite along a `path` (H,) of altitudes, by nearness in ln z; `cost` is (W,).

    Mean and variance are z and z^2 times those of scaled errors: `fit_suite` with a `Kernel`.
    """
    return fit_suite(pictures.over("distance"), path + MOUNT, cost, kernel=_kernel(pictures))


def bootstrapped(
    suite: PerceptionSuite, pictures: Labelled, path: Array, rng: Rng, repeats: int = REDRAWN
) -> PerceptionSuite:
    """Return a pooled suite with standard errors and sample sizes that count groups of pictures.

    In each of the `repeats` the G groups are drawn anew, with replacement; picture i then counts
    c_i times, and with weights k and scaled errors r,

        m* = z sum c_i k_i r_i / sum c_i k_i,    standard error = deviation of m*.

    So it holds for errors that are neither normal nor of equal variance, and that the models and
    the pictures of one landing share.  The sample size is that of groups, with k_g their sums of
    k: n = (sum k_g)^2 / sum k_g^2, rounded down, 2 at least.  `guard_suite` reads both.
    """
    if np.isnan(pictures.error).any():
        raise ValueError("measured: expected errors, found looks that gave nothing")
    G, z, here = _groups(pictures), pictures.distance, path + MOUNT
    k, r = _nearness(z, here, WIDTH), pictures.error / z
    first = np.flatnonzero(np.diff(pictures.group, prepend=-1))  # of each group
    total = np.add.reduceat(k, first, axis=1)
    drawn = rng.multinomial(G, np.full(G, 1 / G), check_count("repeats", repeats, minimum=2)).T
    weight = total @ drawn
    spread = [
        (np.add.reduceat(k * each, first, axis=1) @ drawn / weight).std(axis=1, ddof=1)
        for each in r
    ]
    size = np.maximum(np.floor(total.sum(axis=1) ** 2 / (total**2).sum(axis=1) + 1e-9), 2)
    sizes = np.repeat(size[:, None], len(r), axis=1)
    return replace(suite, sample_size=sizes, standard_error=(here * spread).T[..., None])


def binned_suite(
    pictures: Labelled, path: Array, cost: npt.ArrayLike, bins: int
) -> PerceptionSuite:
    """Fit a suite along a `path` (H,) in `bins` of altitude that hold equally many pictures."""
    edges = altitude_bins(pictures.planned, path, bins)
    with warnings.catch_warnings():  # pictures are taken from further than a short way leads
        warnings.filterwarnings("ignore", "fit_suite: .* residuals count along this trajectory")
        return fit_suite(pictures.over("planned"), path, cost, bins=edges)


def redraw(pictures: Labelled, path: Array, trials: int, rng: Rng, bins: int | None) -> Array:
    """Draw errors (trials, H, W, 1) from those that a suite takes its moments of."""
    if bins is None:
        given = pictures.over("distance"), path + MOUNT, trials, rng
        return bootstrap_errors(*given, kernel=_kernel(pictures))
    edges = altitude_bins(pictures.planned, path, bins)
    return bootstrap_errors(pictures.over("planned"), path, trials, rng, bins=edges)


# -------------------------------------------------------------------------------- calibration


class Calibrated(NamedTuple):
    """A network that reports E[z | z_hat] instead of z_hat.

    A network that is trained on squares of ln z shrinks what it is unsure of towards the middle,
    and its errors are skew in z: of all that it could be told, z_hat is what it has to go by.
    """

    network: Network
    log_distance: Array  #: (K,), of z_hat
    ratio: Array  #: (K,), E[z | z_hat] / z_hat

    @property
    def side(self) -> int:
        """Pixels along a side of its pictures."""
        return self.network.side

    def correct(self, altitude: npt.ArrayLike) -> Array:
        """Return what is expected where the network says `altitude` (N,), within its reach."""
        z_hat = np.asarray(altitude) + MOUNT
        z = z_hat * np.interp(np.log(z_hat), self.log_distance, self.ratio)
        return np.clip(z - MOUNT, LOWEST, HIGHEST)

    def altitude(self, pictures: npt.ArrayLike) -> Array:
        """Estimate altitudes (N,) in feet from pictures (N, side, side)."""
        return self.correct(self.network.altitude(pictures))


def calibrate(network: Network, altitude: Array, error: Array) -> Calibrated:
    """Calibrate a network by its errors (M,) on pictures from such `altitude` (M,).

    The regression is local in ln z_hat, with a kernel k of `WIDTH`, and relative:

        E[z | z_hat] = z_hat sum k_i z_i / z_hat_i / sum k_i.
    """
    z = altitude + MOUNT
    z_hat = z + error
    knots = np.geomspace(LOWEST + MOUNT, HIGHEST + MOUNT, 200)
    k = _nearness(z_hat, np.clip(knots, z_hat.min(), z_hat.max()), WIDTH)
    return Calibrated(network, np.log(knots), k @ (z / z_hat) / k.sum(axis=1))


def calibrate_all(
    networks: Sequence[Network], pictures: Labelled
) -> tuple[list[Calibrated], Labelled]:
    """Return calibrated networks, and the errors that they make on pictures they do not know.

    The former rest on all `pictures`, the latter are those of maps fitted without the fifth of the
    groups that a picture is in: a map that has seen it would look too good.
    """
    _groups(pictures)
    h, error = pictures.altitude, np.empty_like(pictures.error)
    pairs = list(zip(networks, pictures.error, strict=True))
    for fold in range(FOLDS):
        out = pictures.group % FOLDS == fold
        for w, (network, e) in enumerate(pairs):
            without = calibrate(network, h[~out], e[~out])
            error[w, out] = without.correct((h + e)[out]) - h[out]
    return [calibrate(network, h, e) for network, e in pairs], pictures._replace(error=error)
