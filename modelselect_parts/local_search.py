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
from collections.abc import Callable, Sequence

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

    Where moves cost something, changing one step alone pays two of them.
    """
    (H, W, p), c, count = form.mean.shape, choices.copy(), 0
    while time_left() > 0 and count < 10 * H:
        felt = (form.matrix @ form.mean[np.arange(H), c].ravel()).reshape(H, p)
        best = min((*_best_interval(form, c, w, felt), w) for w in range(W))
        change, first, last, w = best
        if not change < -noise:
            break
        c[first : last + 1], count = w, count + 1
    return c, count


def _best_interval(form: Form, c: Choices, w: int, felt: Array) -> tuple[float, int, int]:
    """Return the change, first and last step of the best interval to change to model w.

    With D the change of the mean error, and C[a, b] the sum of D_t'M_ts D_s over t < a and s < b,
    that from a to b changes mu_c'M mu_c by C[a, a] + C[b+1, b+1] - 2 C[a, b+1] + 2 D'M mu_c.
    """
    H, _, p = form.mean.shape
    D = form.mean[:, w] - form.mean[np.arange(H), c]
    C = np.zeros((H + 1, H + 1))
    coupled = (form.matrix * np.outer(D, D)).cumsum(axis=0).cumsum(axis=1)
    C[1:, 1:] = coupled[p - 1 :: p, p - 1 :: p]
    first, last = _ends(form.linear, form.arc, c, w)
    into, out = _sums(2 * (D * felt).sum(axis=1))
    first, last = first + into + C.diagonal()[:-1], last + out + C.diagonal()[1:]
    change = first[:, None] + last - 2 * C[:-1, 1:]
    change[np.tri(H, k=-1, dtype=bool)] = np.inf
    if form.price is not None:
        more = np.add.outer(*_ends(form.price, form.toll, c, w))
        change[path_sum(form.price, form.toll, c) + more > form.limit] = np.inf
    missing = np.isinf(form.linear[:, w])
    if missing.any():
        change[np.add.outer(*_sums(missing)) > 0] = np.inf
    a, b = divmod(int(change.argmin()), H)
    return float(change[a, b]), a, b


def _sums(values: Array) -> tuple[Array, Array]:
    """Return first and last such that steps a to b sum to first[a] + last[b]."""
    total = np.append(0.0, np.cumsum(values))
    return -total[:-1], total[1:]


def _ends(node: Array, arc: Array | None, c: Choices, w: int) -> tuple[Array, Array]:
    """Return what model w from step a to step b changes in nodes and arcs: first[a] + last[b]."""
    missing = np.isinf(node[:, w])
    first, last = _sums(np.where(missing, 0, node[:, w] - node[np.arange(len(node)), c]))
    if arc is not None:
        old = np.append(0.0, arc[c[:-1], c[1:]])  # the move into each step
        inside = old.cumsum()
        first, last = first + inside, last - inside
        first[1:] += arc[c[:-1], w] - old[1:]
        last[:-1] += arc[w, c[1:]] - old[1:]
    return first, last


def descend(
    form: Form, starts: Sequence[Choices], noise: float, time_left: Callable[[], float]
) -> tuple[Choices, int]:
    """Swap steps of each start; of the best, intervals too, where moves cost something; count."""
    swapped = [swap(form, choices, noise, time_left) for choices in starts]
    choices, swaps = min(swapped, key=lambda pair: _cost(form, pair[0]))
    if form.arc is None or _cost(form, choices) == math.inf:
        return choices, swaps
    choices, blocks = swap_blocks(form, choices, noise, time_left)
    return choices, swaps + blocks


def perturbed(
    form: Form, choices: Choices, tries: int, noise: float, time_left: Callable[[], float]
) -> Choices:
    """Set a random interval to a random model, search on from there, keep what is better; repeat.

    Iterated local search (Lourenco, Martin and Stuetzle 2003), its random numbers always the same.
    Where moves cost something and spending is limited, one interval must become cheaper for another
    to become better, which no single change does.
    """
    (H, W, _), rng = form.mean.shape, np.random.default_rng(0)
    best, cost = choices, _cost(form, choices)
    for _ in range(tries):
        first, last = np.sort(rng.integers(0, H + 1, 2))
        c, w = best.copy(), rng.integers(W)
        c[first:last] = np.where(form.linear[:, w] < np.inf, w, best)[first:last]
        c, _ = descend(form, [c], noise, time_left)
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
