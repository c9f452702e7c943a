"""A schedule with its proof, what every solver returns; schedules as zeros and ones."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from modelselect_parts.checks import (
    Array,
    Choices,
    check_array,
    check_choices,
    check_count,
    check_number,
    frozen,
)
from modelselect_parts.descent import relative_gap
from modelselect_parts.stored import Stored

OPTIMALITY_GAP = 1e-9


def one_hot(choices: npt.ArrayLike, models: int) -> Array:
    """Encode `choices` (H,) of W `models` as b (H, W): 1 where w = w_t (``eq:perEncoding``)."""
    W = check_count("models", models)
    c = check_choices(check_array("choices", choices, "H", (None,)), None, W)
    return np.where(c[:, None] == np.arange(W), 1.0, 0.0)


def from_one_hot(weights: npt.ArrayLike) -> Choices:
    """Decode `weights` b (H, W), a single 1 in every row, into c (H,): the inverse of `one_hot`."""
    b = check_array("weights", weights, "H W", (None, None))
    if not ((b == 0) | (b == 1)).all() or (b.sum(axis=1) != 1).any():
        raise ValueError("weights: expected a single 1 and otherwise 0 in every row")
    return np.asarray(b.argmax(axis=1))


@dataclass(frozen=True, eq=False)
class Schedule(Stored):
    """A schedule with its proof: every solver returns one."""

    choices: Choices  #: (H,), model of every step
    cost: float  #: `SelectionProblem.total_cost` of the choices
    lower_bound: float  #: no schedule costs less; above root_bound by a search, or the prices
    root_bound: float  #: LB(reference, multiplier), which `check_certificate` derives anew
    reference: Array  #: (pH,), the point d: any d gives a bound, a good d a tight one
    solver: str  #: name of the function that found the schedule
    work: Mapping[str, Any] = field(default_factory=dict, repr=False)  #: counts, seconds, the tree
    multiplier: float = 0.0  #: lam >= 0: total cost that one more unit of budget saves the bound

    def __post_init__(self) -> None:
        choices = check_array("choices", self.choices, "H", (None,))
        if ((choices != np.floor(choices)) | (choices < 0) | (choices >= 2**31)).any():
            raise ValueError("choices: expected integers >= 0, found others")
        self._set(choices=frozen(choices.astype(np.intp)))
        self._set(reference=check_array("reference", self.reference, "pH", (None,)))
        self._set(multiplier=check_number("multiplier", self.multiplier, minimum=0))

    @property
    def gap(self) -> float:
        """(cost - lower_bound) / max(|cost|, |lower_bound|), or 0 where the two are equal."""
        return relative_gap(self.cost, self.lower_bound)

    @property
    def proof(self) -> str:
        """What carries `lower_bound`: "root", the certificate, or "search", a solver's word."""
        return "root" if self.lower_bound <= self.root_bound else "search"

    @property
    def is_optimal(self) -> bool:
        """Whether the gap is at most `OPTIMALITY_GAP`, so that nothing is better by more."""
        return self.gap <= OPTIMALITY_GAP
