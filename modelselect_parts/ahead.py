r"""What the steps ahead of a label add, and how little it matters to them where it stands.

The search goes from step H-1 down to step 0: y_t is the offset that steps t, ..., H-1 hand on to
those before t, x_t the excess that they have added, V_t(y) the least that those before t add to it
after an offset y.

*Segments.*  Let e_S be the least that the steps a to b - 1 of a segment S add, whatever offset
comes in from later steps.  Every row belongs to one step, so to one segment, and what segments add
at least adds up: V_t(y) >= R_t, the sum over segments before t, and a label goes when its excess
and R_t exceed the budget.

*Handicaps.*  At every boundary R gives something away, so that labels would still grow with H.  But
steps forget.  Of the best schedule known let u_b be the excess of its steps from b on and y*_b its
offset there; let D_b, its handicap, be no less than V_b(y*_b) - min V_b, the least over all offsets
that a schedule may have.  As one may follow it down to b and do the best from there, an optimal
schedule, whose offset at b is y_b, has

    x_b + V_b(y_b) <= u_b + V_b(y*_b),    so    x_t + R_t <= u_b + D_b + R_b    for all t >= b,

as no segment reaches across b, so that steps b to t - 1 add R_t - R_b at least: a budget of labels
that sees no further than b.  Two searches of the segment before b find D_b: of labels c that begin
anywhere, and of labels i that begin at y*_b.  Some c begins a way no dearer than min V_b; an i that
takes the models of this way before a costs x_i + 2 rho room_c + rho^2 - x_c more at most, x_c and
x_i what they add within the segment (dominance.py).  Which c it is we do not know:

    D_b = max_c min_i  x_i + 2 rho room_c + rho^2 - x_c,    D_0 = 0.

The budgets of the labels c know D_a, their rooms handicaps before it: one boundary comes after the
other.  Where a segment forgets what came in, D stays as it is from some boundary on.  Nor does
it matter what the best schedule known has lost since step H-1: a label near y*_b that has added
less takes the place of its steps from b on (`Ahead.passed`).  But for shares sqrt(far) of sqrt(B),
with far < FORGOTTEN, nothing here grows with H; nor do labels, as measured, up to H = 10,000.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable

import numpy as np

from modelselect_parts.checks import Array, Choices
from modelselect_parts.label_search import Ahead, Mark, label, losses, search
from modelselect_parts.triangle import EPS, FREE, Coordinates, Triangle

SEGMENTS = (40, 200)  # steps of a segment, the second a multiple of the first
WIDTHS = (64, 512, 4096)  # labels that begin anywhere
BEAM = 256  # labels that begin where the best schedule known is
LOOK = 50  # the fewest steps that count as near
FORGOTTEN = 1e-4  # share of rho^2 below which steps count as far
INFORMED = 1e-6  # share of what rows say most of below which they say nothing
WEAK = 1e-12  # share of the strongest direction below which others are rounding


def is_long(mean: Array) -> bool:
    """Whether there are segments enough to lie side by side."""
    return len(mean) > 2 * SEGMENTS[-1]


def bounds_ahead(
    triangle: Triangle,
    steps: list[Coordinates],
    known: Choices,
    excess: float,
    slack: float,
    bare: bool,
    expired: Callable[[], bool],
) -> Ahead:
    """Bound what the steps before each one add to an excess, whatever comes from later ones.

    Of a long horizon by segments side by side, long ones after the short ones within them; with
    handicaps where long ones forget, moves are free and nothing limits spending (`bare`).  A short
    one by Russian dolls (Verfaillie, Lemaitre and Schiex 1996): the first sixth of the steps, the
    first third, the first half, and so on.  What would end with the horizon is ahead of no label.
    The limit on spending is left out, which only lowers them.
    """
    H, long, (look, far) = len(steps), SEGMENTS[-1], forgetting(steps)
    spans, forgets = [(0, b) for b in range(-(-H // 6), H, -(-H // 6))], False
    if is_long(triangle.deviation):
        spans = [(b - k, b) for k in SEGMENTS for b in range(k, H, k)]
        spans.sort(key=lambda span: (span[1], -span[0]))  # from step 0 on
        forgets = bare and 2 * look <= long
    added, offsets = follow(triangle, steps, known)
    forgets &= math.isfinite(added[0])  # else `factor` has ruled out a model of its own
    most = np.full(H + 1, added[0] if forgets else math.inf)
    marks: dict[int, Mark] = {}
    ahead = Ahead(np.zeros(H + 1), most, look, far, marks=marks)
    for a, b in spans:
        if expired():
            break
        part, share, handicap = segment(triangle, steps, a, b), slack * (b - a) / H, math.inf
        if forgets and b - a == long:
            near, whole = added[b - look] - added[b], math.sqrt(added[0] - added[b])
            room = math.sqrt(near) + math.sqrt(far[b]) * whole
            marks[b] = Mark(added[b], offsets[b], room, whole)
            least, handicap = _handicap(part, steps, a, ahead, marks[b], excess, share, expired)
        else:
            least = _least_of(part, steps, a, ahead.least, known[a:b], excess, share, expired)
        ahead.least[b:] += max(0.0, least - (ahead.least[b] - ahead.least[a]))
        ahead.most[b:] = np.minimum(ahead.most[b:], added[b] + handicap + ahead.least[b])
    return ahead


def follow(
    triangle: Triangle, steps: list[Coordinates], choices: Choices
) -> tuple[Array, list[Array]]:
    """Return u_b, what a schedule's steps from b on add, and its offset there, b = 0, ..., H."""
    H, state = len(steps), 0
    added, offsets = np.zeros(H + 1), [np.zeros(steps[-1].read.shape[1])] * (H + 1)
    for t, step in reversed(list(enumerate(steps))):
        e, y = triangle.deviation[t, choices[t]], offsets[t + 1]
        felt = step.read @ y + step.own @ e
        added[t] = added[t + 1] + triangle.moves[t, state, choices[t]] + felt @ felt
        offsets[t] = step.carry @ y + step.push @ e
        state = choices[t] if triangle.moves.shape[1] > 1 else 0
    return added, offsets


# ---------------------------------------------------------------------------- one segment


def segment(triangle: Triangle, steps: list[Coordinates], a: int, b: int) -> Triangle:
    """Return what steps a to b - 1 add to an excess; the model that comes after them is free."""
    moves, p = triangle.moves[a:b], triangle.deviation.shape[2]
    last = np.broadcast_to(moves[-1].min(axis=0), moves[-1:].shape)
    moves = np.concatenate([moves[:-1], last])
    size = triangle.size[a * p : b * p]
    parts = zip(steps[a:b], size.reshape(b - a, p), strict=True)
    rows = [np.abs(np.vstack([step.own, step.push])) @ most for step, most in parts]
    length = float(sum(np.linalg.norm(row) for row in rows))
    return Triangle(0.0, moves, triangle.deviation[a:b], triangle.U, size, 0.0, length)


def free_start(
    part: Triangle, steps: list[Coordinates], a: int, onward: bool
) -> tuple[list[Coordinates], float]:
    """Return the steps of a segment such that a label adds no more than it must, whatever came in.

    Let y be the offset that came in.  That of a step is Phi y + eta, its rows G y + g, with G =
    read Phi and g = read eta + own e.  The rows so far are R y - z, apart from a constant that no y
    can lower, the label's excess; a step's join them by a QR factorisation,

        [R; G] = Q [R'; 0],    |R y - z|^2 + |G y + g|^2 = |R' y - z'|^2 + |left|^2,

    [z'; left] = Q'[z; -g].  So (z, eta) takes the place of an offset.  Its coordinates are chosen
    as in `sensitivity._in_felt_states`: their length is what the steps of the segment feel of it
    and, if the search goes `onward`, those before, to which it hands on eta + Phi y with the y that
    fits best, R^+ z.  Return how far this may stray, too: |Phi (y - R^+ z)| at most, for offsets y
    that a schedule may have.
    """
    b = a + len(part.moves)
    n, free = steps[b - 1].read.shape[1], []
    R, Phi = np.zeros((n, n)), np.eye(n)
    reach = part.length + math.sqrt(sum(step.reach**2 for step in steps[a : b + 1]))
    for own, read, carry, push, _, lost in reversed(steps[a:b]):
        Q, whole = np.linalg.qr(np.vstack([R, read @ Phi]), mode="complete")
        rows = np.hstack([Q[:n].T, -Q[n:].T @ np.hstack([read, own])])
        down = np.vstack([rows[:n], np.hstack([np.zeros((len(carry), n)), carry, push])])
        k = n + read.shape[1]
        step = rows[n:, k:], rows[n:, :k], down[:, :k], down[:, k:]
        free.append(Coordinates(*step, len(Q) * reach, lost))
        R, Phi = whole[:n], carry @ Phi
    fit = np.asarray(np.linalg.pinv(R, INFORMED), dtype=float)
    T = np.hstack([Phi @ fit, np.eye(len(Phi))])[: len(Phi) if onward else 0]
    for t, (own, read, carry, push, most, lost) in reversed(list(enumerate(free))):
        V, strength, feels = np.linalg.svd(np.vstack([read, T @ carry]), full_matrices=False)
        weak = strength <= WEAK * strength.max(initial=0)
        lost += reach * float(strength[weak].max(initial=0))
        V = V[:, ~weak]
        free[t] = Coordinates(own, V[: len(read)], V[len(read) :], T @ push, most, lost)
        T = strength[~weak, None] * feels[~weak]
    stray = _strength(Phi) * (steps[b].reach + _strength(fit) * reach)
    return free[::-1], stray


def _least_of(
    part: Triangle,
    steps: list[Coordinates],
    a: int,
    least: Array,
    known: Choices,
    excess: float,
    slack: float,
    expired: Callable[[], bool],
) -> float:
    """Search a segment for the least that it adds; dropping labels proves something, too."""
    free, _ = free_start(part, steps, a, onward=False)
    nothing = np.full(len(least), math.inf), len(steps), np.zeros(len(least))
    found, ahead = 0.0, Ahead(least, *nothing, a)
    excess = min(excess, follow(part, free, known)[0][0])
    for width in WIDTHS:
        given = losses(part, free, FREE, excess, slack)
        again = search(part, free, FREE, given, width, expired, ahead)
        found = max(found, again.least)
        if again.complete or again.choices is None:
            break
        excess = min(excess, follow(part, free, again.choices)[0][0])
    return found


def _handicap(
    part: Triangle,
    steps: list[Coordinates],
    a: int,
    ahead: Ahead,
    known: Mark,
    excess: float,
    slack: float,
    expired: Callable[[], bool],
) -> tuple[float, float]:
    """Return the least that a segment adds, and D_b: infinity if there is no room for all labels.

    Where what is handed on strays, what earlier steps add changes by 2 stray sqrt(B) + stray^2 at
    most; to this comes rounding.  Labels that the budget of an earlier boundary drops add more to
    the segment than the best schedule known does, D >= 0: they do not lower the least, and of one
    that does, x_t + R_t <= u_a - u_b + R_a keeps it within the rooms.  Labels i need no proof: any
    of them bounds V_b(y*_b) from above, so a narrow beam will do.
    """
    free, stray = free_start(part, steps, a, onward=True)
    given = losses(part, free, FREE, excess, slack)
    rounding = 4 * EPS * len(steps) * float(ahead.most[0])
    change = 2 * stray * math.sqrt(given.budget) + stray**2 + rounding
    first, far = max(0, a - 2 * ahead.look), np.zeros(a + len(free))
    far[first:] = forgotten(steps[first:a] + free, ahead.look)
    here = Ahead(ahead.least, ahead.most - known.added + change, ahead.look, far, a)
    anywhere = search(part, free, FREE, given, WIDTHS[-1], expired, here)
    begin, plain = label(known.offset), steps[a : a + len(free)]
    i = search(part, plain, FREE, given, BEAM, expired, here, begin=begin).ends
    c = anywhere.ends
    if not anywhere.complete or not len(c.extra) or not len(i.extra):
        return anywhere.least, math.inf
    rho2 = ((c.y[:, :, None] - i.y[:, None]) ** 2).sum(axis=0)
    room = here.room(0, c.extra, given)[:, None]
    on = (i.extra + 2 * np.sqrt(rho2) * room + rho2).min(axis=1)
    return anywhere.least, max(0.0, float((on - c.extra).max())) + change + 2 * given.total


# ---------------------------------------------------------------------------- forgetting


def forgetting(steps: list[Coordinates]) -> tuple[int, Array]:
    """Return how many steps L count as near, and what those further away feel (`forgotten`)."""
    look = LOOK
    while True:
        far = forgotten(steps, look)
        if far.max() < FORGOTTEN or 2 * look > len(steps):
            return look, far
        look *= 2


def forgotten(steps: list[Coordinates], look: int) -> Array:
    """Return the share (H,) of rho^2 that steps more than L before each one feel at most.

    Any L = 2k steps in a row contain a whole block, ik to (i + 1)k - 1.  As no step makes an offset
    longer, the squared norm of that block's product of carries bounds the share.
    """
    H, k = len(steps), look // 2
    share = np.ones(H // k + 2)
    for i in range(1, H // k):
        carries = [step.carry for step in steps[i * k : (i + 1) * k]]
        share[i] = min(1.0, _strength(functools.reduce(np.matmul, carries)) ** 2)
    first = np.maximum(-(-np.arange(H) // k) - 2, 0)
    return np.where(first > 0, share[first], 0.0)


def _strength(M: Array) -> float:
    """Return the largest singular value, 0 without entries: NumPy 2.0 has no norm of these."""
    return float(np.linalg.svd(M, compute_uv=False).max(initial=0))
