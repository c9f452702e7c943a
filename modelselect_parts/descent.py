"""Projected gradient with its duality gap, and the projection onto the simplex."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from modelselect_parts.checks import Array, check_array, check_count, check_number


def project_to_simplex(points: Array) -> Array:
    """Project each row to the nearest point with non-negative entries that sum to one.

    The nearest point is max(v - h, 0); the threshold h is found by trying, from the largest
    entry down, how many entries stay positive.

    Parameters
    ----------
    points : array_like, (..., W)
        Finite numbers.

    Returns
    -------
    ndarray, (..., W)
        Points of the simplex.

    Raises
    ------
    ValueError
        Points that are no finite numbers.
    """
    points = check_array("points", points, "... W", (None,))
    points = points - points.max(axis=-1, keepdims=True)  # same nearest point, no lost digits
    v = -np.sort(-points, axis=-1)
    thresholds = (np.cumsum(v, axis=-1) - 1) / np.arange(1, v.shape[-1] + 1)
    positive = np.count_nonzero(v > thresholds, axis=-1, keepdims=True)
    return np.maximum(points - np.take_along_axis(thresholds, positive - 1, axis=-1), 0)


def projected_gradient(
    evaluate: Callable[[Array], tuple[float, float, Array]],
    project: Callable[[Array], Array],
    start: Array,
    step: Array,
    gap: float,
    negligible: float,
    max_iterations: int,
) -> tuple[Array, int]:
    """Minimise a convex quadratic over a simple set by Nesterov's accelerated projected gradient.

    From a point beyond the last two iterates, step against the gradient and project.  The
    gradient is affine, so its value beyond is extrapolated rather than computed.  Momentum is
    dropped whenever it points uphill (O'Donoghue and Candes 2015).

    Parameters
    ----------
    evaluate : callable
        Point -> (value, lower bound on the minimum, gradient).
    project : callable
        Any array -> the nearest point of the set.
    start : array_like, any shape
        A point of the set.
    step : array_like, (...) as many axes as `start`, of its lengths or 1
        Step lengths > 0, at most 1/L in the metric in which `project` projects.
    gap : float
        Stop when value and bound agree to this fraction.
    negligible : float
        Stop as well when they differ by no more than this: by rounding.
    max_iterations : int
        Stop after this many steps in any case.

    Returns
    -------
    point : ndarray
        The last iterate.
    iterations : int
        Steps taken.

    Raises
    ------
    ValueError
        A limit out of range, or a `start` or `step` that is no array of finite numbers.
    """
    gap = check_number("gap", gap, minimum=0)
    negligible = check_number("negligible", negligible, minimum=0)
    x = older = check_array("start", start, "...", ())
    step = check_array("step", step, "...", ())
    axes = zip(step.shape, x.shape, strict=False)
    if step.ndim != x.ndim or any(k not in (1, n) for k, n in axes) or step.min() <= 0:
        raise ValueError(f"step: expected lengths > 0 for a start {x.shape}, found {step.shape}")
    value, bound, slope = evaluate(x)
    older_slope, momentum = slope, 1.0
    for iteration in range(check_count("max_iterations", max_iterations)):
        if value - bound <= max(gap * max(abs(value), abs(bound)), negligible):
            return x, iteration
        faster = (1 + math.sqrt(1 + 4 * momentum**2)) / 2
        beyond = (momentum - 1) / faster
        ahead = x + beyond * (x - older)
        new = project(ahead - step * (slope + beyond * (slope - older_slope)))
        uphill = ((ahead - new) / step * (new - x)).sum() > 0
        older, older_slope, x, momentum = x, slope, new, 1.0 if uphill else faster
        value, bound, slope = evaluate(x)
    return x, max_iterations
