"""The relaxation by the fastest engine for it, on bare arrays, with its certificate.

Newton's method where steps are independent (interior_point.py), in windows if the horizon is
long (long_horizon.py); column generation where switching costs or a limit tie them
(column_generation.py).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from modelselect_parts import column_generation, long_horizon, trellis
from modelselect_parts.checks import Array
from modelselect_parts.descent import Relaxation
from modelselect_parts.interior_point import interior_point


def of_weights(form: trellis.Form, b: Array, iterations: int = 0) -> Relaxation:
    """Evaluate weights b (H, W), 0 where `form.linear` is infinite."""
    d, value = trellis.mixed(form.mean, b), trellis.relaxed(form, b)[0]
    return Relaxation(b, d, value, trellis.certificate(form, d).bound, iterations)


def of_mixture(form: trellis.Form, found: column_generation.Columns | None) -> Relaxation:
    """Certify a mixture of schedules; where there is none, no schedule is below infinity.

    Where all that is feasible just keeps the limit, its price may be as high as one likes: a lower
    one that bounds as well is taken, down to a half of the least, as products lose digits.
    """
    if found is None:
        b = np.where(form.linear < np.inf, 1.0, 0.0)
        b /= b.sum(axis=1, keepdims=True)
        return Relaxation(b, trellis.mixed(form.mean, b), math.inf, math.inf, 0)
    b, d, multiplier, value, iterations = found
    bound = trellis.certificate(form, d, multiplier).bound
    if multiplier and (unpriced := trellis.certificate(form, d).bound) >= bound:
        multiplier, bound = 0.0, unpriced
    while multiplier and (lower := trellis.certificate(form, d, multiplier / 2).bound) >= bound:
        multiplier, bound = multiplier / 2, lower
    return Relaxation(b, d, value, bound, iterations, multiplier)


def fastest(
    form: trellis.Form, closed: Callable[[float, float], bool], max_iterations: int, **limits: Any
) -> Relaxation:
    """Relax schedules of models of finite cost until value and bound have `closed`, or a limit."""
    if not form.bare:
        mixture = column_generation.columns(form, closed, **limits, max_iterations=300)
        return of_mixture(form, mixture)

    def evaluate(b: Array) -> tuple[float, float, Array]:
        return trellis.relaxed(form, b)

    usable, limits = np.isfinite(form.linear), limits | {"max_iterations": max_iterations}
    if not isinstance(form.M, np.ndarray):
        return of_weights(form, long_horizon.relax_in_windows(form, usable, closed, **limits))
    given = form.matrix, form.mean, usable, evaluate, closed
    weights, steps = interior_point(*given, **limits)
    return of_weights(form, weights, steps)
