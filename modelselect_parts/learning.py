"""Learning on the way: what is known of networks at each stage, and what it is worth in flight.

A stage is a table of errors, the schedule that is best by it, and flights with that schedule.  The
next one knows more: what the errors were on more pictures, or where the drone really was when it
took them.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from modelselect_parts.checks import Array, Choices
from modelselect_parts.flights import estimate, fly, leads
from modelselect_parts.networks import Network
from modelselect_parts.pooling import Labelled, calibrate_all, joined, labelled
from modelselect_parts.sight import Aircraft, Reader, fly_by_sight
from modelselect_parts.suites import PerceptionSuite
from perception import Trained

Rng = np.random.Generator


class Skill(NamedTuple):
    """Networks, what they were labelled on, and what reads altitudes off pictures after that."""

    networks: Sequence[Network]
    pictures: Labelled  #: with the errors of the networks
    readers: Sequence[Reader]  #: the networks, or what calibration makes of them
    seen: Labelled  #: with the errors of readers, none calibrated by the picture that it errs on


class Stage(NamedTuple):
    """What is known of the models, the problem that it poses, and its optimum."""

    name: str
    suite: PerceptionSuite
    gains: Array | None  #: (H, n, p), of a pattern that takes them
    problem: Any  #: of `modelselect`, as is its Schedule
    optimal: Any
    seconds: float  #: that the solver took
    skill: Any = None  #: what networks can do by then, a `Skill`


def skill(networks: Sequence[Network], pictures: Labelled, calibrated: bool) -> Skill:
    """Return what W networks can do after labels on `pictures`, `calibrated` by them or not."""
    plain = (networks, pictures)
    return Skill(*plain, *(calibrate_all(networks, pictures) if calibrated else plain))


def of_held_out(trained: Trained) -> Skill:
    """Return what trained networks can do: they were labelled on held-out pictures."""
    return skill(trained.networks, labelled(trained.residuals), False)


def label_landings(
    landing: Aircraft,
    able: Skill,
    information: str,
    choices: Choices,
    rng: Rng,
    s: Array,
    gains: Array | None = None,
) -> Labelled:
    """Fly a schedule (H,) through inputs s (N, H, 1), label what is seen, and add it (DAgger).

    Errors depend on where errors have led.  So a picture counts where the drone should have been,
    with the error of every network from where it was (Ross, Gordon and Bagnell 2011).
    """
    seed, path, N = int(rng.integers(2**32)), landing.path[:-1], len(s)
    given = (landing, able.readers, information, s, choices, seed)
    altitude, _, error = fly_by_sight(*given, gains=gains, label=able.networks)
    group, planned = np.repeat(np.arange(N), len(path)), np.tile(path, N)
    errors = np.moveaxis(error, -1, 0).reshape(len(able.networks), -1)
    return joined(able.pictures, Labelled(altitude[:, :-1].ravel(), errors, group, planned))


def regret_of_labels(pictures: Labelled, first: int, Psi: Array, choices: Choices) -> Array:
    """Return e'Psi e (N,) of a schedule (H,) in N labelled landings: the pictures from `first` on.

    Psi (H, H) weighs products of errors of two steps; the scene of a landing makes both alike,
    which a table of means and variances does not know.
    """
    error = pictures.error[:, first:].reshape(len(pictures.error), -1, len(choices))
    e = error[choices, :, np.arange(len(choices))]  # (H, N)
    return np.asarray(np.einsum("tn,tk,kn->n", e, Psi, e))


# ---------------------------------------------------------------------- what a stage is worth


class Flown(NamedTuple):
    """What policies lost by errors in flights by sight, and what it cost them in all."""

    promised: float  #: regret of Optimal, by the suite
    lost: dict[str, Array]  #: regret (trials,), by policy
    totals: dict[str, Array]  #: alpha regret + beta perception cost (trials,)
    labelled: Array = np.empty(0)  #: regret of Optimal, by the errors of labelled landings


def fly_rivals(
    landing: Aircraft,
    readers: Sequence[Reader],
    information: str,
    problem: Any,
    chosen: Mapping[str, Choices],
    s: Array,
    seed: int,
    gains: Array | None = None,
) -> Flown:
    """Fly the schedules (H,) that were `chosen` through the same inputs s and scenes, by sight."""
    none = np.zeros((*s.shape[:2], 1, 1))
    ideal, seen = fly(landing, information, s, none, None, gains)[1], {}
    for c in chosen.values():
        if c.tobytes() not in seen:
            flight = fly_by_sight(landing, readers, information, s, c, seed, gains=gains)
            seen[c.tobytes()] = flight[1] - ideal
    lost = {policy: seen[c.tobytes()] for policy, c in chosen.items()}
    paid = {k: problem.beta * float(problem.perception_term(c)) for k, c in chosen.items()}
    totals = {k: problem.alpha * lost[k] + paid[k] for k in chosen}
    return Flown(float(problem.control_term(chosen["Optimal"])), lost, totals)


def in_numbers(flown: Mapping[str, Flown]) -> dict[str, dict[str, Any]]:
    """Return what stages promised and what came of it as plain numbers, None where unknown."""

    def plain(pair: Iterable[float]) -> list[float | None]:
        return [None if math.isnan(value) else float(value) for value in pair]

    found: dict[str, dict[str, Any]] = {}
    for stage, each in flown.items():
        found[stage] = {"promised": each.promised}
        for policy, lost in each.lost.items():
            regret, total = map(plain, estimate(lost, each.totals[policy]))
            found[stage][policy] = {"regret": regret, "total": total}
        for policy, lead in leads(each.totals).items():
            found[stage][policy]["optimal below"] = plain(lead)
    return found


def by_stage(
    flown: Mapping[str, Flown],
) -> tuple[list[str], Array, Array, list[dict[str, tuple[float, float]]]]:
    """Return names, promises (stages,), what came (stages, 3, 2), and the leads of each stage.

    What came are estimates of Optimal's regret by labelled landings (NaN without), of its regret
    and of its total in flight.
    """
    promised, came, ahead = [], [], []
    for each in flown.values():
        some = estimate(each.labelled) if len(each.labelled) else np.full((1, 2), math.nan)
        came.append([*some, *estimate(each.lost["Optimal"], each.totals["Optimal"])])
        promised.append(each.promised)
        ahead.append(leads(each.totals))
    return list(flown), np.array(promised), np.array(came), ahead
