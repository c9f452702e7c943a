r"""Which partial schedules no better one makes superfluous, on bare arrays.

Let i, j be labels (see label_search.py) at distance rho = |y_i - y_j|.  A completion costs them
|v + y_i|^2 and |v + y_j|^2 plus the same moves, and (y_i - y_j)'(v + y_j) <= rho room_j for every
completion of j within the budget (see `label_search.Ahead.room`).  So |v + y_i|^2 <= |v + y_j|^2 +
2 rho room_j + rho^2, and i is never worse if

    extra_i + 2 rho room_j + rho^2 <= extra_j    (or exceeds it by `merge`).

*Moves that cost something.*  Where i and j are in different states, a completion costs i at most
`detours` more, which is added on the left.

*A limit.*  Then i must be in the state of j and must not have spent more, and extra - lam spent
takes the place of extra: the rest of what they may spend is paid for at the end.

Any label may be tested against any other.  Tests are made against the cheapest of the same cell of
a grid, for cells of several sizes, until few labels are left: of these all pairs are tested.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from modelselect_parts.checks import Array, Choices, Mask

Cells = npt.NDArray[np.uint64]

# Sides of cells: the largest room, halved so often; the last: all but equal.
GRIDS = (0, 1, 2, 3, 4, 5, 6, 7, 24)
ODD = np.uint64(0x9E3779B97F4A7C15)  # 2^64 over the golden ratio: neighbours fall far apart
FEW = 96  # labels of which all pairs are tested, which is quicker then, and drops more
MANY = 512  # labels from which passes with detours are worth their time
TELLING = 1e-6  # the share of the room that labels must differ by for a direction to tell cells


class Pairs(NamedTuple):
    """What a test of label i against label j looks at."""

    paid: Array  #: (labels,)
    room: Array  #: (labels,)
    y: Array  #: (r, labels)
    near: Array  #: (r', labels), the coordinates that tell labels apart, the widest first
    far: float  #: what the others add to rho^2 at most

    def never_worse(self, i: Choices, j: Choices, due: Array) -> Mask:
        """Mark the pairs where i has paid no more than is `due`, however j goes on."""
        return self._within(i, j, _apart(self.y, i, j), due)

    def screened(self, i: Choices, j: Choices, due: Array) -> Mask:
        """Mark the same pairs; look first at what is quick, as most of them fail."""
        passed = self.paid[i] <= due
        hope = np.flatnonzero(passed)
        i, j, due = i[hope], j[hope], due[hope]
        rho2 = _apart(self.near, i, j)
        well = self._within(i, j, rho2, due)
        if len(self.near) < len(self.y):  # rho^2 is not known where it matters
            close = np.flatnonzero(well & ~self._within(i, j, rho2 + self.far, due))
            well[close] = self.never_worse(i[close], j[close], due[close])
        passed[hope] = well
        return np.asarray(passed)

    def _within(self, i: Choices, j: Choices, rho2: Array, due: Array) -> Mask:
        return np.asarray(self.paid[i] + 2 * np.sqrt(rho2) * self.room[j] + rho2 <= due)


def undominated(
    extra: Array,
    y: Array,
    room: Array,
    merge: float,
    expired: Callable[[], bool],
    state: Choices | None = None,
    detour: Array | None = None,
    spent: Array | None = None,
    multiplier: float = 0.0,
) -> Mask:
    """Mark the labels, sorted by extra cost, that no cheaper label nearby makes superfluous.

    All are in one `state` where none is given; without `detour` none stands for another state.
    A grid is passed over once for labels of one state, and with detours once for all, until one
    drops less than a fiftieth.
    """
    paid = extra if spent is None else extra - multiplier * spent
    alive = np.arange(len(extra)) if spent is None else np.argsort(spent, kind="stable")
    if len(alive) > FEW:
        rank = None if spent is None else _ranks(paid)
        alive = _of_cells(paid, y, room, merge, expired, state, detour, rank, alive)
    if 1 < len(alive) <= FEW and not expired():
        here = None if state is None else state[alive]
        alive = alive[_of_all_pairs(paid[alive], y[:, alive], room[alive], merge, here, detour)]
    kept = np.zeros(len(extra), dtype=bool)
    kept[alive] = True
    return kept


def _of_cells(
    paid: Array,
    y: Array,
    room: Array,
    merge: float,
    expired: Callable[[], bool],
    state: Choices | None,
    detour: Array | None,
    rank: Choices | None,
    alive: Choices,
) -> Choices:
    """Return which labels are left when those of a cell were tested against its cheapest.

    Grid after grid, until few are left.  Where spending is limited `alive` is in its order, and
    labels have a `rank` by what they have paid.
    """
    largest, many = float(room.max()), state is not None and len(paid) >= MANY
    near, spread, far = _telling(y, TELLING * largest)
    pairs = Pairs(paid, room, y, near, far)
    powers = np.cumprod(np.full(len(near) + 1, ODD))
    fruitful = [True] if detour is None or not many else [True, True]
    for halvings in GRIDS if merge >= 0 else GRIDS[:-1]:  # equal labels do not differ by a margin
        if len(alive) <= FEW or largest == 0 or expired():
            break
        if not (any(fruitful) or halvings == GRIDS[-1]):
            continue
        side = largest / 2**halvings
        k = np.count_nonzero(spread > side)  # others would part labels that are near
        corner = np.floor(near[:k].take(alive, axis=1) / side + 0.618 * halvings)
        cell = powers[:k] @ corner.astype(np.int64).view(np.uint64)  # grids share no borders
        for across in range(len(fruitful)):
            if not (fruitful[across] or halvings == GRIDS[-1]):
                continue
            own = None if across else state
            key = cell if own is None else cell + own[alive].astype(np.uint64) * powers[-1]
            first = _first_of_cell(key) if rank is None else _cheapest_so_far(key, rank[alive])
            i, j = alive[first], alive
            tested = (i != j if own is None else (i != j) & (own[i] == own[j])).nonzero()[0]
            i, j = i[tested], j[tested]
            due = paid[j] + merge
            if across and state is not None and detour is not None:
                due -= detour[state[i], state[j]]
            test = pairs.screened if many else pairs.never_worse
            gone = tested[test(i, j, due)]
            fruitful[across] = halvings < 2 or len(gone) > len(alive) / 50
            stays = np.ones(len(alive), dtype=bool)
            stays[gone] = False
            alive, cell = alive[stays], cell[stays]
    return alive


def _of_all_pairs(
    paid: Array, y: Array, room: Array, merge: float, state: Choices | None, detour: Array | None
) -> Mask:
    """Mark which of a few labels stay: a label goes if one before it that stays is never worse."""
    due = paid + merge
    if state is not None:
        i, j = state[:, None], state
        due = np.where(i == j, due, -np.inf) if detour is None else due - detour[i, j]
    apart = y[:, :, None] - y[:, None]
    apart *= apart
    rho2 = apart.sum(axis=0)
    better = np.triu(paid[:, None] + 2 * np.sqrt(rho2) * room + rho2 <= due, 1)
    stays = np.zeros(len(paid), dtype=bool)
    asked = ~stays
    while asked.any():
        stays |= asked & ~better[asked].any(axis=0)
        asked &= ~(stays | better[stays].any(axis=0))
    return stays


def detours(moves: Array) -> Array | None:
    """Return what the steps before t cost state a more than state b at most, [t, a, b].

    The greatest moves[t-1, a, v] - moves[t-1, b, v] of all models v before; nothing before step 0.
    """
    states = moves.shape[1]
    if states == 1:
        return None
    from_a, from_b = moves[:-1, :, None], moves[:-1, None]
    with np.errstate(invalid="ignore"):
        more = np.where(from_b < np.inf, from_a - from_b, -np.inf).max(axis=-1)
    return np.concatenate([np.zeros((1, states, states)), more])


def _apart(y: Array, i: Choices, j: Choices) -> Array:
    """Return rho^2 of pairs of labels."""
    apart = y.take(i, axis=1) - y.take(j, axis=1)
    apart *= apart
    return np.asarray(apart.sum(axis=0))


def _telling(y: Array, least: float) -> tuple[Array, Array, float]:
    """Return the coordinates in which labels differ by more than `least`; what others add.

    The widest come first, with their widths between.
    """
    spread = y.max(axis=1, initial=-np.inf) - y.min(axis=1, initial=np.inf)
    order = np.argsort(-spread)
    k = np.count_nonzero(spread > least)
    far = spread[order[k:]]
    return y[order[:k]], spread[order[:k]], float(far @ far)


def _first_of_cell(cell: Cells) -> Choices:
    """Return for every label the first of its cell.

    The top bits of a cell's number index a table.  Cells that share an entry do no harm, as tests
    are exact.
    """
    bits = len(cell).bit_length() + 2
    key = cell >> np.uint64(64 - bits)
    table = np.empty(2**bits, dtype=np.intp)
    table[key[::-1]] = np.arange(len(cell))[::-1]  # of equal keys, the first stays
    return np.asarray(table[key])


def _ranks(paid: Array) -> Choices:
    """Return the place of every label in the order of what it has paid."""
    rank = np.empty(len(paid), dtype=np.intp)
    rank[np.argsort(paid, kind="stable")] = np.arange(len(paid))
    return rank


def _cheapest_so_far(cell: Cells, rank: Choices) -> Choices:
    """Return for every label the one of its cell that has paid least, up to itself.

    Labels come in the order of what they have spent, so it has not spent more.  Sixteen bits of a
    cell's number do for some ten thousand labels, and sort in linear time.
    """
    n, most = len(cell), int(rank.max()) + 1
    key = cell * ODD
    key = (key >> np.uint64(48)).astype(np.uint16) if n < 2**16 else key
    order = np.argsort(key, kind="stable")
    key = key[order]
    number = np.cumsum(np.append(True, key[1:] != key[:-1]))
    least = np.minimum.accumulate(rank[order] - most * number)  # cells count down: each anew
    label, found = np.empty(most, dtype=np.intp), np.empty(n, dtype=np.intp)
    label[rank] = np.arange(n)
    found[order] = label[least % most]
    return found
