r"""Long horizons: windows, systems, and the passes that a search takes.

*Windows.*  Any reference point d certifies a bound; that of a long horizon is put together from
the middles of windows that overlap.

*Systems.*  Psi of a linear system (sensitivity.py) needs no factor, as it is a sum of squares, and
no basis of offsets, as these are its states.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from typing import Any

import numpy as np

from modelselect_parts.ahead import is_long
from modelselect_parts.checks import Array, Mask
from modelselect_parts.interior_point import interior_point
from modelselect_parts.label_search import negligible_strength
from modelselect_parts.sensitivity import Sensitivity, window
from modelselect_parts.trellis import Certificate, Form, relaxed
from modelselect_parts.triangle import (
    Coordinates,
    Triangle,
    compress,
    factor,
)

LAP = 100  # steps that windows overlap by, on either side


def widths(form: Form, known: list[int]) -> list[int]:
    """Return which of the `known` widths the passes of a search take, one after the other.

    The first need not be complete: what it finds makes the next one shorter.  With switching costs
    or a budget fewer labels dominate others, so that 64 rarely find much; tried at H = 50 and 150.
    With both, the price of the budget comes after the first pass: what is left needs many labels,
    and a pass that is too narrow for it proves nothing that the price has not.
    Of systems, few need 512 or 4096 where 64 did not do: they have bounds ahead by then, with which
    a wide pass takes no longer than its labels do.
    """
    if isinstance(form.M, Sensitivity):
        return known[:1] + known[3:]
    if form.arc is not None and form.price is not None:
        return known[1:2] + known[4:]
    return known if form.bare else known[1:]


def passes_before_bounds(form: Form) -> int:
    """Return after how many passes of the search bounds ahead are worth their time.

    Tried at H = 300 to 1000: earlier they cost a matrix more than they save, up to twice the time.
    They come after as many labels whether the first pass had 64 or 512 (`widths`).
    """
    if isinstance(form.M, Sensitivity):
        return 1
    if form.arc is not None and form.price is not None:
        return 1
    passes = 2 if is_long(form.mean) else 3
    return passes if form.bare else passes - 1


def relax_in_windows(
    form: Form, allowed: Mask, closed: Callable[[float, float], bool], **limits: Any
) -> Array:
    """Return weights (H, W) for a system: of each window, those of the steps in its middle."""
    weights: Array = allowed / allowed.sum(axis=1, keepdims=True)
    assert isinstance(form.M, Sensitivity)
    for a in range(0, len(weights), 2 * LAP):
        part = slice(lo := max(0, a - LAP), a + 3 * LAP)
        M, mean = window(form.M, part), form.mean[part]
        evaluate = functools.partial(relaxed, Form(M, mean, form.linear[part], form.size[part]))
        found, _ = interior_point(M, mean, allowed[part], evaluate, closed, **limits)
        weights[a : a + 2 * LAP] = found[a - lo : a - lo + 2 * LAP]
    return weights


# -------------------------------------------------------------- coordinates, of either kind of Psi


def prepared(
    form: Form,
    found: Certificate,
    point: tuple[Array, float],
    excess: float,
    slack: float,
    expired: Callable[[], bool],
) -> tuple[Triangle, list[Coordinates]]:
    """Write the excess over `found.base`, up to this one, at (d, lam), as a sum over steps."""
    if isinstance(form.M, Sensitivity):
        return _of_system(form, form.M, found, point[0], excess)
    triangle = factor(form, found, *point, excess)
    least = negligible_strength(triangle, max(0.0, excess - triangle.constant), slack)
    return triangle, compress(triangle, least, expired)


def _of_system(
    form: Form, system: Sensitivity, found: Certificate, d: Array, excess: float
) -> tuple[Triangle, list[Coordinates]]:
    """Write the excess of a system as a sum over steps; the last is that with which it begins."""
    useful = found.reduced + (found.bound - found.base) <= max(excess, 0.0)
    moves = np.where(useful & (found.node < np.inf), found.node, np.inf)
    deviation = np.where(useful[..., None], form.mean - d.reshape(len(moves), 1, -1), 0)
    size = np.abs(deviation).max(axis=1)
    length = float((np.sqrt(system.diagonal()) * size.ravel()).sum())
    arrays = (system.own, system.read, system.carry, system.push, _reaches(system, size))
    steps = [Coordinates(*step) for step in zip(*arrays, strict=True)]
    turn = -1 if system.forward else 1
    turned = (moves[::turn, None], deviation[::turn], np.zeros((0, 0)), size[::turn].ravel())
    return Triangle(0.0, *turned, 0.0, length), steps[::turn]


def _reaches(system: Sensitivity, size: Array) -> Array:
    """Bound the lengths (H,) of the states that each step hands on, for errors up to `size` (H, p).

    A state sums x_k a_k over the errors so far, |a_k| <= 1.  For weights f^k, k steps back,
    |sum_k x_k a_k|^2 <= |sum_k x_k x_k' / f^k| sum_k p f^k (Cauchy and Schwarz).
    """
    (_, n, p), best = system.push.shape, np.full(len(size), np.inf)
    for f in (1.0, 0.99, 0.9):
        S, total = np.zeros((n, n)), 0.0
        for t in system.order():
            push, total = system.push[t] * size[t], p + f * total
            S = system.carry[t] @ S @ system.carry[t].T / f + push @ push.T
            if not np.trace(S) < 1e300:
                break  # what does not forget so fast grows without end; f = 1 has bounded it
            best[t] = min(best[t], math.sqrt(total * np.linalg.norm(S, 2)))
    return best
