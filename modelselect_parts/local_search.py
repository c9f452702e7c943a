r"""Local search, on bare arrays: better schedules by small changes, with no proof.

The change of mu_c'M mu_c is cheap to know for all neighbours at once: of one step, of all intervals
of steps that go to one model.  Where neither helps, disturb the schedule and try again.

>>> M, mean = np.ones((2, 2)), np.array([[[1.0], [-1.0]]] * 2)  # two steps whose errors may cancel
>>> form = Form(M, mean, np.zeros((2, 2)), np.zeros((2, 2)))
>>> choices, swaps = swap(form, np.array([0, 0]), 0.0, lambda: 1.0)
>>> choices.tolist(), swaps
([1, 0], 1)
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from modelselect_parts.checks import Array, Choices
from modelselect_parts.trellis import Form, path_sum


def moved(node: Array, arc: Array | None, c: Choices) -> Array:
    """Return what changing w_t to w changes in the sum of nodes and arcs, (H, W)."""
    change = node - node[np.arange(len(node)), c][:, None]
    if arc is not None:
        now = arc[c[:-1], c[1:]][:, None]
        change[1:] += arc[c[:-1]] - now
        change[:-1] += arc[:, c[1:]].T - now
    return np.asarray(change)


def swap(
    form: Form, choices: Choices, noise: float, time_left: Callable[[], float]
) -> tuple[Choices, int]:
    """Take the best single swap while it helps by more than `noise`; return choices and count.

    Step t moves by D = mu[t, w] - mu[t, w_t], and mu_c'M mu_c by 2 D'(M mu_c)_t + D'M_tt D.  Over
    the limit, the swap that costs least per unit saved comes first.
    """
    M, mean, (H, _, p), c, swaps = form.matrix, form.mean, form.mean.shape, choices.copy(), 0
    steps = np.arange(H)
    pull, blocks = M @ mean[steps, c].ravel(), M.reshape(H, p, H, p)[steps, :, steps]
    while time_left() > 0 and swaps < 100 * H:  # rounding that runs in circles comes to an end
        D = mean - mean[steps, c][:, None]
        change = 2 * np.einsum("twi,ti->tw", D, pull.reshape(H, p))
        change += np.einsum("twi,tij,twj->tw", D, blocks, D)
        change = score = change + moved(form.linear, form.arc, c)
        over = False
        if form.price is not None:
            spent = path_sum(form.price, form.toll, c)
            more, over = moved(form.price, form.toll, c), bool(spent > form.limit)
            if over:
                score = np.full_like(change, np.inf)
                with np.errstate(over="ignore"):  # a saving of next to nothing
                    np.divide(np.maximum(change, 0), -more, out=score, where=more < 0)
            score = np.where(over | (spent + more <= form.limit), score, np.inf)
        t, w = np.unravel_index(score.argmin(), score.shape)
        if not (score[t, w] < np.inf if over else score[t, w] < -noise):
            break
        pull += M[:, t * p : (t + 1) * p] @ (mean[t, w] - mean[t, c[t]])
        c[t], swaps = w, swaps + 1
    return c, swaps


def swap_blocks(
    form: Form, choices: Choices, noise: float, time_left: Callable[[], float]
) -> tuple[Choices, int]:
    """Take the best change of an interval of steps to one model while it helps; count them.

    Where moves cost something, changing one step alone pays two of them.  With D the change of the
    mean error and C the sums of D_t'M_ts D_s over all earlier t and s, the interval from a to b
    changes mu_c'M mu_c by what lies between four corners of C, plus 2 D'M mu_c.
    """
    (H, W, _), c, count = form.mean.shape, choices.copy(), 0
    while time_left() > 0 and count < 10 * H:
        best = min(((*_best_interval(form, c, w), w) for w in range(W)), key=lambda found: found[0])
        change, first, last, w = best
        if not change < -noise:
            break
        c[first : last + 1], count = w, count + 1
    return c, count


def _best_interval(form: Form, c: Choices, w: int) -> tuple[float, int, int]:
    """Return the change, first and last step of the best interval to change to model w."""
    H, _, p = form.mean.shape
    steps, now = np.arange(H), form.mean[np.arange(H), c]
    D = form.mean[:, w] - now
    felt = (form.matrix @ now.ravel()).reshape(H, p)
    coupled = np.einsum("ti,tisj,sj->ts", D, form.matrix.reshape(H, p, H, p), D)
    corner = np.zeros((H + 1, H + 1))
    coupled.cumsum(axis=0).cumsum(axis=1, out=corner[1:, 1:])
    change = corner.diagonal()[None, 1:] - corner[:-1, 1:] - corner[1:, :-1].T
    change = change + corner.diagonal()[:-1, None] + _interval_sum(2 * (D * felt).sum(axis=1))
    change += _of_interval(form.linear, form.arc, c, w)
    legal = steps[:, None] <= steps
    if form.price is not None:
        more = _of_interval(form.price, form.toll, c, w)
        legal &= path_sum(form.price, form.toll, c) + more <= form.limit
    change = np.where(legal, change, np.inf)
    first, last = np.unravel_index(change.argmin(), change.shape)
    return float(change[first, last]), int(first), int(last)


def _interval_sum(values: Array) -> Array:
    """Return the sum from step a to step b, [a, b]."""
    total = np.zeros(len(values) + 1)
    values.cumsum(out=total[1:])
    return total[1:] - total[:-1, None]


def _of_interval(node: Array, arc: Array | None, c: Choices, w: int) -> Array:
    """Return what model w from step a to step b changes in the sum of nodes and arcs, [a, b]."""
    steps, missing = np.arange(len(node)), np.isinf(node[:, w])
    change = _interval_sum(np.where(missing, 0, node[:, w] - node[steps, c]))
    if arc is not None:
        old = arc[c[:-1], c[1:]]
        change -= _interval_sum(np.append(0.0, old)) - np.append(0.0, old)[:, None]  # inside
        change += np.append(0.0, arc[c[:-1], w] - old)[:, None]
        change += np.append(arc[w, c[1:]] - old, 0.0)
    return np.where(_interval_sum(missing * 1.0) > 0, np.inf, change) if missing.any() else change


def descend(
    form: Form, choices: Choices, noise: float, time_left: Callable[[], float]
) -> tuple[Choices, int]:
    """Swap steps, and intervals where moves cost something, while that helps; count them."""
    choices, swaps = swap(form, choices, noise, time_left)
    if form.arc is None or _cost(form, choices) == math.inf:
        return choices, swaps
    choices, blocks = swap_blocks(form, choices, noise, time_left)
    return choices, swaps + blocks


def perturbed(
    form: Form, choices: Choices, trials: int, noise: float, time_left: Callable[[], float]
) -> Choices:
    """Set a random interval to a random model, search on from there, keep what is better; repeat.

    Iterated local search (Lourenco, Martin and Stuetzle 2003), its random numbers always the same.
    Where moves cost something and spending is limited, one interval must become cheaper for another
    to become better, which no single change does.
    """
    (H, W, _), rng = form.mean.shape, np.random.default_rng(0)
    best, cost = choices, _cost(form, choices)
    for _ in range(trials):
        first, last = np.sort(rng.integers(0, H + 1, 2))
        c, w = best.copy(), rng.integers(W)
        c[first:last] = np.where(form.linear[:, w] < np.inf, w, best)[first:last]
        c, _ = descend(form, c, noise, time_left)
        if time_left() <= 0:
            break
        if _cost(form, c) < cost - noise:
            best, cost = c, _cost(form, c)
    return best


def _cost(form: Form, c: Choices) -> float:
    """Return what a schedule costs, inf beyond the limit."""
    if form.price is not None and path_sum(form.price, form.toll, c) > form.limit:
        return math.inf
    mu = form.mean[np.arange(len(c)), c].ravel()
    return float(mu @ form.matrix @ mu + path_sum(form.linear, form.arc, c))
