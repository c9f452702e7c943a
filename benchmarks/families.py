"""The instances that are timed: families of selection problems, each drawn from a seed.

`published` is the paper's first experiment.  The others land the textbook aircraft, named by what
the controller knows and by the signs of the biases: all the `same`, one for each `model`, or one
for each `step` and model.  `long` ones fly on at 150 steps in 20 s, rising and sinking between 0
and 100 ft every 700 steps, with preview; their Psi is a linear system.

`constrained` adds what a kind says to a textbook family: switching costs, a budget, or both.  There
prices are EfficientNet's measured latencies on an i7-12700H (pytorch-image-models), weighed so that
the largest model costs what it costs in its family.  A switch costs 2% of the family's optimum; the
budget lies half-way between what the cheapest schedule and the optimum without one spend.
"""

from __future__ import annotations

from dataclasses import fields, replace
from typing import Any

import numpy as np

import perception
from landing import cost_scale, preset
from modelselect import ControlTask, SelectionProblem, Sensitivity, psi, sensitivity, solve
from perception import PerceptionSuite, gaussian_suite

ALPHA, BETA = 0.8, 0.2
SIGNS = ("same", "model", "step")
TEXTBOOK = tuple(f"{known}/{signs}" for known in ("open_loop", "preview") for signs in SIGNS)
FAMILIES = ("published", *TEXTBOOK)
ONE_SIGN = ("published", "open_loop/same", "preview/same")
MIXED_SIGNS = tuple(family for family in FAMILIES if family not in ONE_SIGN)
LONG = tuple(f"long/{signs}" for signs in SIGNS)

KINDS = ("switching", "budget", "both")
LATENCY = np.array([12.9, 18.4, 24.0, 34.0, 68.3, 143.8, 256.0, 465.8])

# A bias in altitude (ft), in its rate (ft/s) and in pitch (rad); at 256 ft/s a pitch that is off
# by 1/256 rad takes the aircraft off its path at 1 ft/s.
UNITS = np.array([1, 1, 1 / 256])


def task(family: str, H: int = 150, p: int = 1) -> tuple[ControlTask, str]:
    """The task of a family, and what its controller knows."""
    if family == "published":
        return preset("published", H).task, "open_loop"
    if family in LONG:
        return replace(preset("textbook", 150).task, horizon=H), "preview"
    return replace(preset("textbook", H).task, C=np.eye(4)[:, :p]), family.split("/")[0]


def built(family: str, H: int, p: int = 1) -> np.ndarray | Sensitivity:
    """Psi of a family, as a matrix or as a linear system."""
    return (sensitivity if family in LONG else psi)(*task(family, H, p))


def instance(
    family: str,
    seed: int,
    H: int = 150,
    W: int = 8,
    p: int = 1,
    Psi: np.ndarray | Sensitivity | None = None,
) -> SelectionProblem:
    """The problem that a family draws from a seed (`published`, `long`: W = 8 and p = 1 only)."""
    Psi = built(family, H, p) if Psi is None else Psi
    rng = np.random.default_rng(seed)
    if family == "published":
        landing = preset("published", H)
        suite, price = landing.draw_suite(rng), landing.upsilon
    elif family in LONG:
        path = 50 + 50 * np.sin(2 * np.pi * np.arange(H) / 700)
        suite = perception.textbook_suite(path, rng, family.split("/")[1])
        price = cost_scale(Psi, suite)
    else:
        suite = textbook_suite(family.split("/")[1], rng, H, W, p)
        price = cost_scale(Psi, suite)
    return SelectionProblem(Psi, suite.mean, suite.variance, price * suite.cost, ALPHA, BETA)


def textbook_suite(signs: str, rng: np.random.Generator, H: int, W: int, p: int) -> PerceptionSuite:
    """`perception.textbook_suite`, its range of quality shared by W models, for p components."""
    altitude = preset("textbook", H).path[:-1]
    finer = 7 / (W - 1)
    components = [
        gaussian_suite(
            lambda w, h: 1.5 * 0.6 ** (w * finer) * (0.3 + h / 100),
            lambda w, h: 2.0 * 0.65 ** (w * finer) * (0.3 + h / 100),
            np.arange(W),
            altitude,
            jitter=(0.2, 0.1),
            signs=signs,
            rng=rng,
        )
        for _ in range(p)
    ]
    mean = np.concatenate([suite.mean for suite in components], axis=2) * UNITS[:p]
    variance = np.concatenate([suite.variance for suite in components], axis=2) * UNITS[:p] ** 2
    return replace(components[0], mean=mean, variance=variance)


def constrained(family: str, kind: str, seed: int, H: int) -> SelectionProblem:
    """The instance of a family, with latencies for prices and what its kind adds."""
    drawn = instance(family, seed, H)
    beta = float(drawn.beta * drawn.model_cost.max() / LATENCY.max())
    problem = replace(drawn, model_cost=LATENCY, beta=beta)
    if kind != "budget":
        switch = 0.02 * solve(problem).cost / beta * (1 - np.eye(len(LATENCY)))
        problem = replace(problem, switch_cost=switch)
    if kind != "switching":
        least, most = H * LATENCY.min(), problem.perception_term(solve(problem).choices)
        problem = replace(problem, budget=float(least + most) / 2)
    return problem


def arguments(problem: SelectionProblem) -> dict[str, Any]:
    """What `SelectionProblem` makes the same problem from, to be stored in a NumPy archive."""
    given = {field.name: getattr(problem, field.name) for field in fields(problem)}
    return {name: value for name, value in given.items() if value is not None}
