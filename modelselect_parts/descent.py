"""Projected gradient with its duality gap, and the projection onto the simplex.

For convex f on a convex set, f(v) >= f(x) + f'(x)(v - x): minimised over the set, the right-hand
side is a lower bound, and value - bound a certificate (Frank and Wolfe 1956).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import scipy.linalg as la

from modelselect_parts.checks import Array, check_array, check_count, check_function, check_number
from modelselect_parts.objects import Record


def relative_gap(value: float, bound: float) -> float:
    """(value - bound) / max(|value|, |bound|), or 0 where value <= bound."""
    return 0.0 if value <= bound else (value - bound) / max(abs(value), abs(bound))


@dataclass(frozen=True, eq=False)
class Relaxation(Record):
    """A point of the convex relaxation (see `modelselect.relax`)."""

    weights: Array  #: (H, W), each row on the simplex
    reference: Array  #: (pH,), the mean error d_t = sum_w b[t,w] mu[t,w]
    value: float  #: objective at `weights`
    bound: float  #: LB(reference, multiplier), a lower bound on every schedule
    iterations: int  #: iterations of the method
    multiplier: float = 0.0  #: lam, the price of one unit of budget

    @property
    def gap(self) -> float:
        """(value - bound) / max(|value|, |bound|), or 0 where the two are equal."""
        return relative_gap(self.value, self.bound)


def closes(gap: float, negligible: float) -> Callable[[float, float], bool]:
    """Return the test whether value and bound agree to the fraction `gap`, or up to rounding."""
    return lambda value, bound: value - bound <= negligible or relative_gap(value, bound) <= gap


def project_to_simplex(points: npt.ArrayLike) -> Array:
    """Project each row (..., W) to the nearest point with non-negative entries that sum to one.

    The nearest point is max(v - h, 0); the threshold h is found by trying, from the largest
    entry down, how many entries stay positive.
    """
    v = check_array("points", points, "... W", (None,))
    v = v - v.max(axis=-1, keepdims=True)  # same nearest point, no lost digits
    entries, v = v, -np.sort(-v, axis=-1)
    thresholds = (np.cumsum(v, axis=-1) - 1) / np.arange(1, v.shape[-1] + 1)
    positive = np.count_nonzero(v > thresholds, axis=-1, keepdims=True)
    threshold = np.take_along_axis(thresholds, positive - 1, axis=-1)
    return np.asarray(np.maximum(entries - threshold, 0))


def step_lengths(M: Array, size: Array) -> Array:
    """Return steps (k,) for x'Mx, each in proportion to 1/size of its coordinate, that are safe.

    1/(2 L size) with L the largest eigenvalue of M in coordinates of unit size.
    """
    scale = size**-0.5
    largest = max(1.0, la.eigvalsh(scale[:, None] * M * scale)[-1])
    return np.asarray(1 / (2 * largest * size))


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

    `evaluate` takes a point, of the shape of `start`, to its value, a lower bound on the minimum
    and its gradient; `project` takes any array to the nearest point of the set.  `step` > 0, of
    lengths as `start` or 1, is at most 1/L in the metric in which `project` projects.  Returns
    the last iterate and the steps taken: until value and bound agree to the fraction `gap`, or to
    the number `negligible`, or `max_iterations`.
    """
    check_function("evaluate", evaluate)
    check_function("project", project)
    closed = closes(
        check_number("gap", gap, minimum=0), check_number("negligible", negligible, minimum=0)
    )
    x = older = check_array("start", start, "...", ())
    step = check_array("step", step, "...", ())
    axes = zip(step.shape, x.shape, strict=False)
    if step.ndim != x.ndim or any(k not in (1, n) for k, n in axes) or step.min() <= 0:
        raise ValueError(f"step: expected lengths > 0 for a start {x.shape}, found {step.shape}")
    value, bound, slope = evaluate(x)
    older_slope, momentum = slope, 1.0
    for iteration in range(check_count("max_iterations", max_iterations)):
        if closed(value, bound):
            return x, iteration
        faster = (1 + math.sqrt(1 + 4 * momentum**2)) / 2
        beyond = (momentum - 1) / faster
        ahead = x + beyond * (x - older)
        with np.errstate(all="ignore"):  # far beyond the set is far enough
            move = step * (slope + beyond * (slope - older_slope))
            new = project(ahead - np.clip(move, -1e200, 1e200))
            uphill = ((ahead - new) / step * (new - x)).sum() > 0
        older, older_slope, x, momentum = x, slope, new, 1.0 if uphill else faster
        value, bound, slope = evaluate(x)
    return x, max_iterations
