r"""An exact search pass by pass, on bare arrays: what each pass finds makes the next one shorter.

A pass keeps so many labels a step (label_search.py).  One that had to drop labels proves the least
that those cost; a better schedule shrinks the budget of labels; bounds of the steps ahead
(ahead.py), too.  Where spending is limited, so does a better price of it:

*The dual of a budget.*  At lam a unit of spending, with no limit, the best schedule costs

    L(lam) = min over all schedules c of total(c) + lam (spent(c) - K),      lam >= 0,

and none that keeps the limit K costs less.  This is a problem without a limit.  Its optimum is a
schedule, where the relaxation's is a mixture of schedules: where mixtures promise what no schedule
does, L at its best lam lies far above the relaxation.  Every schedule is a cut of L from above, a
line in lam that rises where it overspends.  L is concave: where a rising cut and a falling one meet
is the next lam to try (Handler and Zang 1980).  Its use: see `Search.move`, and the margin of
`label_search.search`.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from modelselect_parts import ahead, label_search, long_horizon, trellis
from modelselect_parts.checks import Array, Choices
from modelselect_parts.sensitivity import Sensitivity
from modelselect_parts.triangle import Coordinates, Triangle, purse

CUTS, ENOUGH = 20, 0.1  # most prices tried; the share of the gap not worth another one


class Cut(NamedTuple):
    """What a schedule costs, and what it spends: total(c) + lam (spent(c) - K) >= L(lam)."""

    cost: float
    spent: float


def best_price(
    cut_at: Callable[[float], Cut],
    limit: float,
    known: Cut,
    multiplier: float,
    expired: Callable[[], bool],
) -> float:
    """Return a lam at which L is within a tenth of the gap of its maximum, as far as cuts tell.

    `cut_at` gives the cut of a schedule that is good at a lam, `known` is that of one that keeps
    the limit; begin at the `multiplier`.
    """
    lam, falling, rising, best = multiplier, known, None, (-math.inf, multiplier)
    for _ in range(CUTS):
        cut = cut_at(lam)
        best = max(best, (cut.cost + lam * (cut.spent - limit), lam))
        if expired():
            break
        if cut.spent > limit:
            rising = cut
        elif lam == 0:
            break  # the limit does not bind
        else:
            falling = cut
        if rising is None:
            lam = lam / 2 if lam > multiplier / 8 else 0.0
            continue
        lam = max(0.0, falling.cost - rising.cost) / (rising.spent - falling.spent)
        meeting = falling.cost + lam * (falling.spent - limit)
        if meeting - best[0] <= ENOUGH * (known.cost - best[0]):
            break
    return best[1]


@dataclass
class Search:
    """A search under way: the best schedule, what is proved, and what the last pass did."""

    form: trellis.Form
    point: tuple[Array, float]  #: (d, lam), of the certificate that the search rests on
    choices: Choices  #: (H,), the best schedule known
    cost: float
    proved: float  #: no schedule costs less
    improve: Callable[[Choices], tuple[Choices, float]]  #: a schedule near by, its cost or inf
    allowance: Callable[[Choices, float], float]  #: what a pass may give away, if these are best
    expired: Callable[[], bool]
    passes: int = 0
    complete: bool = False  #: whether the last pass dropped no label for lack of room

    def __post_init__(self) -> None:
        """Begin at the point."""
        self.labels = np.zeros(len(self.form.mean), dtype=np.intp)
        self.move(self.point, -math.inf)

    def move(self, point: tuple[Array, float], floor: float) -> None:
        """Rest on another point (d, lam), where L(lam) is no less than `floor`."""
        found = trellis.certificate(self.form, *point)
        if not math.isfinite(found.base):
            return
        self.point, self.found, self.floor = point, found, floor
        self.purse = purse(self.form, point[1])
        self.parts: tuple[Triangle, list[Coordinates]] | None = None
        self.ahead: label_search.Ahead | None = None
        self.proved = max(self.proved, min(floor, self.cost))

    def offer(self, choices: Choices) -> None:
        """Keep a schedule near this one if it is better than the best one known."""
        better, cost = self.improve(choices)
        if cost < self.cost:
            self.choices, self.cost = better, cost

    def step(self, width: int) -> bool:
        """Search with `width` labels a step; return whether another pass would have more to do."""
        root, before, system = self.found.base, self.cost, self.form.M
        turn = -1 if isinstance(system, Sensitivity) and system.forward else 1  # begins at the end
        slack = self.allowance(self.choices, before)
        if self.parts is None:
            known = self.form, self.found, self.point, before - root
            self.parts = long_horizon.prepared(*known, slack, self.expired)
        triangle, steps = self.parts
        if not steps:
            return False
        excess = max(0.0, before - root - triangle.constant)
        if self.ahead is None and self._wants_bounds():
            limits = self.choices[::turn], excess, slack, self.form.bare, self.expired
            self.ahead = ahead.bounds_ahead(triangle, steps, *limits)
        lost = label_search.losses(triangle, steps, self.purse, excess, slack)
        rounding = self.found.taken + 4 * trellis.EPS * (abs(root) + abs(triangle.constant))
        margin = before - self.floor + 2 * lost.total + rounding
        given = lost, width, self.expired, self.ahead, margin
        found = label_search.search(triangle, steps, self.purse, *given)
        self.labels, self.complete = found.labels[::turn], found.complete
        self.passes += 1
        if found.choices is not None:
            self.offer(found.choices[::turn])
        summing = 4 * trellis.EPS * (abs(root) + abs(found.least))
        self.proved = max(self.proved, min(before, root + found.least - summing))
        return self.cost < before if found.complete else True

    def share_closed(self) -> float:
        """Return what share of the gap at the root has been closed."""
        whole = self.cost - self.found.bound
        return (self.proved - self.found.bound) / whole if whole > 0 else 1.0

    def may_price(self) -> bool:
        """Whether a better price of the limit may be worth its time: once, where a pass failed.

        Where moves cost something mixtures promise most, and the next pass would be in vain.
        """
        return not self.complete and self.passes == (2 if self.form.arc is None else 1)

    def _wants_bounds(self) -> bool:
        return self.passes >= long_horizon.passes_before_bounds(self.form) and not self.complete
