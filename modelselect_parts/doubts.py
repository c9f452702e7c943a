"""What a fit warns of: other units, angles without a period, angles of half a turn."""

from __future__ import annotations

import warnings

import numpy as np

from modelselect_parts.checks import Array, Mask
from modelselect_parts.kernels import Axes, errors_of
from modelselect_parts.measurements import Residuals

TURNS = (360.0, 2 * np.pi)  # in degrees and in radians


def report(residuals: Residuals, mean: Array, v: Array, axes: Axes, used: Mask) -> None:
    """Warn where few residuals count, angles err by half a turn, or turns pass for errors."""
    moves = any(np.ptp(h) > 0 for _, h in axes.values())
    if moves and used.mean() < 0.5:
        ways = (f"{n} {span(z)}, on the way {span(h)}" for n, (z, h) in axes.items())
        warnings.warn(
            f"fit_suite: {used.sum()} of {len(used)} residuals count along this trajectory "
            f"({'; '.join(ways)}): are both in one unit?",
            stacklevel=3,
        )
    if residuals.period is None:
        _report_turns(residuals)
        return
    far = (np.abs(mean) + 2 * np.sqrt(v) > residuals.period / 2).any(axis=-1)
    if far.any():
        t, w = np.argwhere(far)[0]
        warnings.warn(
            f"fit_suite: errors of {residuals.names[w]} near step {t} reach half a period, where "
            "nobody can tell them from errors of the other sign",
            stacklevel=3,
        )


def _report_turns(residuals: Residuals) -> None:
    """Warn where all errors are near 0 or a full turn, and some are near either: angles."""
    r = np.abs(errors_of(residuals))
    for turn in TURNS:
        around = r > turn / 2
        near = np.abs(r - turn * around).max(axis=0) < turn / 10
        if (near & (around.sum(axis=0) > 2) & ~around.all(axis=0)).any():
            warnings.warn(
                f"fit_suite: errors lie around 0 and around {turn:.4g}: of angles, state the "
                "period (see Residuals)",
                stacklevel=4,
            )


def span(z: Array) -> str:
    """Return from where to where numbers reach."""
    return f"from {digits(z.min())} to {digits(z.max())}"


def digits(number: float) -> str:
    """Return the shortest text that is this number, without a point where none is needed."""
    short = f"{number:g}"
    return short if float(short) == number else repr(float(number))
