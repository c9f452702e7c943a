r"""The exact search, on bare arrays: sphere decoding on a trellis, with dominance.

A *label* is a partial schedule, from step t to the last (see triangle.py): its excess so far, its
offset on the rows still to come, its model where moves cost something, what it has spent where
there is a limit.  A schedule better than the best one known has excess below what that one has.  So
a label goes when its excess, and what the steps before must add to it (ahead.py), exceeds
this budget; when it cannot keep the limit; or when a cheaper label near it *dominates* it
(dominance.py).  What remains is a few labels, though in the worst case exponentially many: the
problem is NP-hard.

Everything that rounding and shortcuts give away is added up (`Losses`) and taken off the bound,
so what a search claims is a theorem (`search`).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np

from modelselect_parts.checks import Array, Choices
from modelselect_parts.dominance import GRIDS, detours, undominated
from modelselect_parts.triangle import EPS, Coordinates, Purse, Triangle

RESTS = 2  # steps for which a test that drops less than a third is left out, beside a margin


class Losses(NamedTuple):
    """What one pass gives away, so that its proof is a theorem in spite of it.

    Let Q be the quadratic of a schedule within the budget B, in exact numbers.

    - *Truncation.*  Offsets of step t are (basis times strengths) a with |a|^2 <= p(H - t): true
      at the start, and kept, as a column more appends p entries of size at most 1, and turning
      keeps |a|.  Dropping directions of strength <= s_t at step t changes the stacked residuals
      U_tt e_t + y_t by a vector of norm x <= sum_t s_t sqrt(p(H - t)): later steps only project
      and cut it, which does not lengthen it.  So Q becomes at most (sqrt(Q) + x)^2 <=
      Q + 2 x sqrt(B) + x^2.
    - *Merging.*  A dominance test may lose `merge`.  A schedule's chain of dominators has one
      link a step and grid at most, as the representative of a cell is not discarded in its own
      pass, nor one that stays among few: at most H tests merge in all, and as many roundings of a
      test.  Where moves cost something every grid is passed over twice.
    - *Spending.*  Sums in another order differ by grains, for each of which lam is paid.  A
      dominator never spends more, as sums of floats are monotone.
    - *Rounding.*  An offset errs at every step by a few eps of its reach for each term that its
      coordinates sum, those of the basis included, which changes the residuals as truncation does.
    """

    budget: float  #: B: labels above it go
    merge: float
    grains: float  #: what labels may spend beyond the limit
    total: float  #: what the bound is lowered by, B less the excess that must be kept


def negligible_strength(triangle: Triangle, excess: float, slack: float) -> float:
    """Return how weak a direction may be dropped: all of them give away 3/4 of the slack at most.

    Most are rounding, far weaker, and `losses` counts what they are.
    """
    H, _, p = triangle.deviation.shape
    root = math.sqrt(excess + slack)
    return 0.75 * slack / (2 * root * H * math.sqrt(p * H)) if root > 0 else 0.0


def losses(
    triangle: Triangle,
    steps: list[Coordinates],
    purse: Purse,
    excess: float,
    slack: float,
) -> Losses:
    """Return B such that every schedule of up to this excess keeps a representative within B.

    A quarter of the slack is for merging.  Of B itself 2 x sqrt(B) + x^2 is given away, so B must
    solve B = excess + rest + 2 x sqrt(B) + x^2: sqrt(B) = x + sqrt(excess + rest + 2 x^2) does.
    """
    H, _, p = triangle.deviation.shape
    terms = max((len(step.push) for step in steps), default=0) + p
    lengths = sum(step.reach for step in steps) + triangle.length
    x = sum(step.lost for step in steps) + 2 * EPS * (len(triangle.U) + terms + 10) * lengths
    rest = slack / 4 + triangle.rounding
    tests = len(GRIDS) * (1 if triangle.moves.shape[1] == 1 else 2)
    grains = H * (tests + 1) * purse.grain
    rest += purse.multiplier * grains
    budget = (x + math.sqrt(excess + rest + 2 * x * x)) ** 2
    budget *= 1 + (16 + terms) * EPS * H * (tests + 1)  # the roundings of tests and sums
    return Losses(budget, slack / (4 * H * tests), grains, budget - excess)


class Mark(NamedTuple):
    """Where the best schedule known stands, at a boundary of segments."""

    added: float  #: u, what its steps from there on add
    offset: Array  #: (r,), y*
    room: float  #: its own, going on as it does
    whole: float  #: sqrt(u_0 - u_b), the room of all its steps before, near or far


class Ahead(NamedTuple):
    """What is known of the steps that a label has yet to go through, those before t (ahead.py)."""

    least: Array  #: (H + 1,), R_t, the least that they add to an excess, whatever came in
    most: Array  #: (H + 1,), what x_t + R_t is at most, x_t what an optimal schedule added so far;
    #: in the search of a segment, what it added there
    look: int  #: of them, the next so many are near
    far: Array  #: (H,), the share of rho^2 that those which are not near feel at most
    first: int = 0  #: the step with which the search ends, where it is of a segment
    marks: Mapping[int, Mark] = {}  #: by step
    gain: float = 0.0  #: by which the best schedule known has been beaten

    def left(self, t: int, given: Losses) -> float:
        """Return what labels may have added when the steps before t are still to come.

        Dominators may have added more than an optimal schedule: at any step by what all of merging
        and rounding gives away, `given.total`, as they may take its own models from there on.
        """
        whole = given.budget + float(self.least[self.first])
        most = float(self.most[t]) - self.gain + given.total
        return min(whole, most) - float(self.least[t])

    def room(self, t: int, extra: Array, given: Losses) -> Array:
        """Return the room of labels, (labels,), at step t of the search (dominance.py).

        |v + y|^2 is at most what is left of the budget; that of near steps t - L to t - 1 at most
        what is left at t - L, as the far ones before need their R.  With rho_far <= sqrt(far) rho,
        (y_i - y_j)'(v + y_j) <= rho (|v + y_j|_near + sqrt(far) |v + y_j|_far).
        """
        t += self.first
        whole = np.sqrt(np.maximum(given.budget - extra, 0))
        near = np.sqrt(np.maximum(self.left(max(t - self.look, 0), given) - extra, 0))
        return np.asarray(np.minimum(whole, near + math.sqrt(self.far[t]) * whole))

    def passed(self, t: int, labels: Labels) -> Ahead:
        """Return what is known when the best schedule known may begin like any label at t.

        It goes on as it does, from y_i in the place of y*: with rho = |y_i - y*| that costs 2 rho
        room + rho^2 at most.  The boundaries to come are farther away than near steps: to its
        handicaps there sqrt(far) rho adds at most what rho would, with sqrt(V) <= `whole` for room.
        """
        if t not in self.marks:
            return self
        added, offset, room, whole = self.marks[t]
        rho = np.linalg.norm(labels.y - offset[:, None], axis=0)
        far = math.sqrt(self.far[t]) * rho
        costs = rho * (2 * room + rho) + far * (2 * whole + far)
        gain = float((added - labels.extra - costs).max(initial=self.gain))
        return self._replace(gain=gain)


class Labels(NamedTuple):
    """Partial schedules, from one step to the last, side by side."""

    extra: Array  #: (labels,), their excess so far
    spent: Array  #: (labels,), of the limit; 0 where there is none
    y: Array  #: (r, labels), their offsets in coordinates
    state: Choices  #: (labels,), the model of their first step; 0 where moves are free


def label(offset: Array) -> Labels:
    """Return the label that has added nothing, at an offset."""
    nothing = np.zeros(1)
    return Labels(nothing, nothing, offset[:, None], np.zeros(1, dtype=np.intp))


class Pass(NamedTuple):
    """What one pass found and proved: see `search`."""

    choices: Choices | None  #: (H,), of the least excess among the labels that are left
    least: float  #: the excess of every schedule is at least this
    complete: bool  #: whether no label within the budget was dropped for lack of room
    labels: Choices  #: (H,), labels kept at every step
    ends: Labels  #: those that are left after step 0


def search(
    triangle: Triangle,
    steps: list[Coordinates],
    purse: Purse,
    given: Losses,
    width: int,
    expired: Callable[[], bool],
    ahead: Ahead | None = None,
    margin: float = math.inf,
    begin: Labels | None = None,
) -> Pass:
    """Keep at most `width` labels a step, from the last step to the first.

    An optimal schedule is over the budget, or descends from a label that was dropped, or has a
    survivor that is no worse, up to the losses: so no schedule's excess is below the least of the
    three, less the losses.  One with a model that `factor` ruled out costs no less than the best
    schedule known then, to which callers limit the claim.  A later pass may reuse the basis: its
    excess is smaller, so no model that it needs was ruled out.

    The `margin` is what the budget exceeds the excess of every schedule by that disregards the
    limit, twice the losses and what the certificate took off: L(lam) of passes.py, where known.
    """
    H, dropped, rests = len(steps), math.inf, 0
    ahead = ahead or Ahead(np.zeros(H + 1), np.full(H + 1, math.inf), H, np.zeros(H))
    labels = begin or label(np.zeros(steps[-1].read.shape[1]))
    trail: list[tuple[Choices, Choices]] = []
    detour = detours(triangle.moves)
    for t, step in reversed(list(enumerate(steps))):
        left = ahead.left(ahead.first + t, given)
        labels, parent, model = _extended(triangle, step, t, purse, given, left, labels)
        room = ahead.room(t, labels.extra, given)
        across = None if detour is None else detour[t]
        kept, rests = _survivors(labels, room, purse, given, margin, across, rests, expired)
        most = min(width, 64) if expired() else width  # out of time: finish on a narrow beam
        if len(kept) > most:
            before = ahead.least[ahead.first + t] - ahead.least[ahead.first]
            dropped = min(dropped, float(labels.extra[kept[most]] + before))
        kept = kept[:most]
        extra, spent, y, state = labels
        labels = Labels(extra[kept], spent[kept], y.take(kept, axis=1), state[kept])
        ahead = ahead.passed(t, labels)
        trail.append((parent[kept], model[kept]))
    extra, spent = labels.extra, labels.spent
    if purse.spend is not None:  # what is left of the limit is paid for
        extra = extra + purse.multiplier * np.maximum(purse.limit - spent, 0)
    least = min(given.budget, dropped, float(extra.min(initial=math.inf)))
    least += triangle.constant - given.total
    legal = np.where(spent <= purse.limit, extra, math.inf)  # a grain over it proves, and is none
    counts = np.array([len(models) for _, models in reversed(trail)], dtype=np.intp)
    return Pass(_traced(trail, legal), least, dropped == math.inf, counts, labels)


def _survivors(
    labels: Labels,
    room: Array,
    purse: Purse,
    given: Losses,
    margin: float,
    detour: Array | None,
    rests: int,
    expired: Callable[[], bool],
) -> tuple[Choices, int]:
    """Return which labels, sorted by extra cost, no other makes superfluous.

    Where spending is limited label j also goes if a label i, whatever it has spent, undercuts it by
    the margin, extra_i + 2 rho room_j + rho^2 + margin <= extra_j: a completion of j within the
    budget would give i an excess that no schedule has.  So nothing is merged, and i need not stay.
    The other test then rests for so many steps, which come back with the labels.
    """
    extra, spent, y, state = labels
    here, across = (state, detour) if (state != state[:1]).any() else (None, None)
    if purse.spend is None:
        kept = undominated(extra, y, room, given.merge, expired, here, across)
        return np.flatnonzero(kept), 0
    alive = np.arange(len(room))
    if margin < given.budget:
        alive = np.flatnonzero(undominated(extra, y, room, -margin, expired, here))
        if rests:
            return alive, rests - 1
    y, room = y.take(alive, axis=1), room[alive]
    who = None if here is None else here[alive], None, spent[alive], purse.multiplier
    kept = undominated(extra[alive], y, room, given.merge, expired, *who)
    return alive[kept], RESTS if 3 * kept.sum() > 2 * len(alive) else 0


def _extended(
    triangle: Triangle,
    step: Coordinates,
    t: int,
    purse: Purse,
    given: Losses,
    left: float,
    labels: Labels,
) -> tuple[Labels, Choices, Choices]:
    """Put a model of step t in front of every label, where what is left and the limit allow it.

    Return the new labels, cheapest first, with the label that each extends and its model.
    """
    moves, free = triangle.moves[t], triangle.moves.shape[1] == 1
    models = np.flatnonzero(moves.min(axis=0) <= given.budget)
    deviation = triangle.deviation[t, models]
    felt = ((step.read @ labels.y)[:, :, None] + (step.own @ deviation.T)[:, None]) ** 2
    move = moves[0, models] if free else moves[:, models][labels.state]
    grown = labels.extra[:, None] + move + felt.sum(axis=0)
    within, total = grown <= left, labels.spent[:, None] + np.zeros(len(models))
    if purse.spend is not None and purse.ahead is not None:
        spend = purse.spend[t, :, models].T
        total = labels.spent[:, None] + (spend[labels.state] if len(spend) > 1 else spend)
        within &= total + purse.ahead[t, models] <= purse.limit + given.grains
    parent, child = np.nonzero(within)
    order = np.argsort(grown[parent, child])
    parent, child = parent[order], child[order]
    y = (step.carry @ labels.y).take(parent, axis=1)
    y += (step.push @ deviation.T).take(child, axis=1)
    state = np.zeros(len(child), dtype=np.intp) if free else models[child]
    found = Labels(grown[parent, child], total[parent, child], y, state)
    return found, parent, models[child]


def _traced(trail: list[tuple[Choices, Choices]], extra: Array) -> Choices | None:
    """Follow the least label of step 0, if any is finite, by parents and models of every step."""
    if not (extra < math.inf).any():
        return None
    choices, label = [], extra.argmin()
    for parents, models in reversed(trail):
        choices.append(models[label])
        label = parents[label]
    return np.array(choices)
