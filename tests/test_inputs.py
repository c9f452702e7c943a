"""Bad input, as a table: every argument of every public function, times every way to spoil it.

A row holds one good call.  Each argument has a kind, and each kind its `ERRORS`: ways to spoil it
that must end in one line that names the argument, raised by our code and not inside NumPy; and
its `SAMES`: other forms of the same numbers, which must give the same answer.  In no case may an
input be modified.  What is fine after all in an argument stands in its `valid`.
"""

import copy
import dataclasses
import inspect
import pickle
import re
import sys
import traceback
import types
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib.pyplot as plt
import numpy as np
import pytest
import scipy.signal

import landing
import modelselect as ms
import perception
from landing import Settings
from modelselect_parts.measured import halves

from strategies import belongs

MODULES = (ms, perception, landing)

# ----------------------------------------------------------------------------- kinds of argument


class Arg(NamedTuple):
    """A good value, or a function `fresh` that makes it anew for every call."""

    kind: str
    value: Any = None
    valid: str = ""  # names, or beginnings of names, of what does no harm here
    blames: str = ""  # other arguments that the message may name: sizes must agree
    fresh: Callable[[], Any] | None = None

    def make(self):
        return self.fresh() if self.fresh else self.value

    def spares(self, way):
        return any(way.startswith(word) for word in self.valid.split())


def real(value, valid="", blames=""):
    """An array of real numbers."""
    return Arg("array", np.array(value, dtype=float), valid + " negative", blames)


def weight(value, valid="", blames=""):
    """An array of numbers >= 0."""
    return Arg("array", np.array(value, dtype=float), valid, blames)


def index(value, valid="", blames=""):
    """An array of indices: whole numbers from 0."""
    return Arg("index", np.array(value), valid, blames)


def number(value, valid="", blames=""):
    """A finite number >= 0."""
    return Arg("number", value, valid, blames)


def count(value, valid="", blames=""):
    """A whole number >= 1."""
    return Arg("count", value, valid, blames)


def word(value, valid="", blames=""):
    """A name out of a few."""
    return Arg("word", value, valid, blames)


def record(fresh, valid=""):
    """An object of ours, which was checked when it was made."""
    return Arg("record", valid=valid, fresh=fresh)


def function(value):
    return Arg("function", value)


def names(value, valid="", blames=""):
    """A sequence of names."""
    return Arg("names", value, valid, blames)


def path(value, valid=""):
    """The path of a file."""
    return Arg("path", value, valid)


RNG = Arg("rng", fresh=lambda: np.random.default_rng(3))

# ---------------------------------------------------------------------------- ways to spoil them


def first(bad):
    """Put a bad number at the first place."""

    def spoil(good):
        spoiled = np.array(good, dtype=np.result_type(np.asarray(good, dtype=float), bad))
        spoiled.flat[0] = bad
        return spoiled

    return spoil


def longer(axis):
    def spoil(good):
        return np.concatenate([good, good.take([0], axis)], axis)

    return spoil


def masked(good):
    return np.ma.masked_array(good, np.arange(np.size(good)).reshape(np.shape(good)) == 0)


NO_NUMBER = {
    "nan": first(np.nan),
    "inf": first(np.inf),
    "minus-inf": first(-np.inf),
    "complex": lambda good: np.array(good) + 0j,
    "text": lambda good: np.array(good).astype(str),
    "object": lambda good: np.array(good).astype(object),
    "none": lambda good: None,
    "dict": lambda good: {"a": 1},
    "masked": masked,
    "date": lambda good: np.array(good).astype("datetime64[s]"),
    "beyond-int64": lambda good: np.full(np.shape(good), 2**70, dtype=object).tolist(),
    "beyond-float": lambda good: np.full(np.shape(good), 10**400, dtype=object).tolist(),
}
NO_ARRAY = NO_NUMBER | {
    "rank-more": lambda good: good[..., None],
    "rank-less": lambda good: good[0],
    "rank-0": lambda good: 1.0,
    "length-0": longer(0),
    "length-1": longer(1),
    "length-2": longer(2),
    "length-3": longer(3),
    "transposed": np.transpose,
    "empty": lambda good: [],
    "empty-rows": lambda good: good[:0],
    "empty-columns": lambda good: good[..., :0],
    "ragged": lambda good: [[1.0, 2.0], [3.0]],
    "negative": lambda good: -1 - np.abs(good),
}
NO_INDEX = {"fraction": first(0.5), "minus-one": first(-1), "too-large": first(1e6)}
NO_SINGLE = NO_NUMBER | {
    "list": lambda good: [good, good],
    "row": lambda good: [good],
    "negative": lambda good: -1 - good,
}
ERRORS = {
    "array": NO_ARRAY,
    "index": NO_ARRAY | NO_INDEX,
    "number": NO_SINGLE,
    "count": NO_SINGLE
    | {
        "zero": lambda good: 0,
        "fraction": lambda good: 1.5,
        "truth": lambda good: True,
    },
    "word": {
        "unknown": lambda good: "nonsense",
        "case": str.upper,
        "none": lambda good: None,
        "number": lambda good: 0,
        "list": lambda good: [good],
        "array": lambda good: np.array([good, good]),
        "long": lambda good: np.zeros((50, 50)),
    },
    "record": {
        "none": lambda good: None,
        "number": lambda good: 3.0,
        "text": lambda good: "nonsense",
        "array": lambda good: np.ones((3, 3)),
        "tuple": lambda good: (1, 2),
        "object": lambda good: object(),
    },
    "rng": {
        "none": lambda good: None,
        "seed": lambda good: 3,
        "legacy": lambda good: np.random.RandomState(3),
        "array": lambda good: np.zeros((50, 50)),
    },
    "function": {"none": lambda good: None, "number": lambda good: 3.0},
    "names": {
        "none": lambda good: None,
        "number": lambda good: 3,
        "text": lambda good: "abc",
        "empty": lambda good: [],
        "blank": lambda good: [" ", *good[1:]],
        "twice": lambda good: [good[1], *good[1:]],
        "fewer": lambda good: good[1:],
        "numbers": lambda good: [0.5, *good[1:]],
        "mask": lambda good: [True, *good[1:]],
        "array": lambda good: np.zeros((50, 50)),
    },
    "path": {
        "none": lambda good: None,
        "number": lambda good: 0,
        "missing": lambda good: "none/none.csv",
        "folder": lambda good: ".",
        "null": lambda good: "a\0b",
        "lines": lambda good: "none/a\nb",
    },
    "flag": {},
}
ERRORS["batches"] = ERRORS["array"]
ERRORS["limit"] = ERRORS["count"]  # of what takes long, so that other forms are not tried
ERRORS["result"] = {way: ERRORS["record"][way] for way in ("none", "number")}
#: Where Python itself refuses: what has not the attributes, or cannot be called.
REFUSALS = {
    "record": ValueError,
    "result": ValueError,
    "function": ValueError,
    "names": (TypeError, ValueError),
    "batches": (TypeError, ValueError),
    "path": ValueError,
}


def strided(good):
    return np.repeat(good, 2, axis=-1)[..., ::2]


def read_only(good):
    copy = np.array(good)
    copy.flags.writeable = False
    return copy


SAME_ARRAY = {
    "list": lambda good: np.array(good).tolist(),
    "tuple": lambda good: tuple(np.array(good).tolist()),
    "read-only": read_only,
    "strided": strided,
    "reversed": lambda good: np.flip(np.flip(good).copy()),
    "fortran": np.asfortranarray,
    "float32": lambda good: np.asarray(good, dtype=np.float32),
    "longdouble": lambda good: np.asarray(good, dtype=np.longdouble),
    "big-endian": lambda good: np.asarray(good, dtype=float).astype(">f8"),
    "int8": lambda good: np.asarray(good, dtype=np.int8),
    "uint8": lambda good: np.asarray(good, dtype=np.uint8),
    "unmasked": np.ma.masked_array,
}
SAME_SINGLE = {
    "0-d": np.array,
    "float": float,
    "float32": np.float32,
    "float16": lambda good: np.array(good).astype(np.float16),
    "int8": lambda good: np.array(good).astype(np.int8),
    "big-endian": lambda good: np.array(good, dtype=">f8"),
}
SAMES = {
    "array": SAME_ARRAY,
    "index": SAME_ARRAY | {"float": lambda good: good.astype(float)},
    "number": SAME_SINGLE,
    "count": SAME_SINGLE,
}

# ------------------------------------------------------------------------------- the good values

H, W, P = 4, 3, 2


def numbered(*shape):
    """Small numbers that float32 and int8 hold exactly: -5, -2, 1, 4, -4, ..."""
    return (np.arange(np.prod(shape)) * 3 % 11 - 5.0).reshape(shape)


A, B, C = np.tril(numbered(3, 3)) / 4, numbered(3, 2), numbered(3, 1)
R = np.array([[2.0, 1], [1, 2]])
FACTOR = numbered(P * H, P * H)
PSI = FACTOR @ FACTOR.T + np.eye(P * H)  # whole numbers below 2^24
MEAN, VARIANCE, PRICE = numbered(H, W, P), numbered(H, W, P) ** 2, np.array([0.0, 20, 40])
SWITCH = np.array([[0.0, 1, 2], [3, 0, 4], [5, 6, 0]])
COVARIANCE = np.eye(H * W * P).reshape(H, W, P, H, W, P)


@cache
def task():
    return ms.ControlTask(A, B, C, np.diag([1.0, 2, 0]), R, H)


@cache
def system():
    return ms.sensitivity(task(), "preview")


def problem():
    return ms.SelectionProblem(PSI, MEAN, VARIANCE, PRICE, 1, 2)


@cache
def point():
    return ms.relax_interior_point(problem())


@cache
def schedule():
    return ms.solve(problem())


@cache
def blend():
    return ms.BlendProblem(problem())


def suite_of(cost=PRICE, **measured):
    return perception.PerceptionSuite(["a", "b", "c"], MEAN, VARIANCE, cost, **measured)


@cache
def suite():
    return suite_of()


@cache
def measured():
    """Six residuals of each of three models on either side of altitude 4."""
    model, altitude = np.divmod(np.arange(36), 12)
    return perception.Residuals(["a", "b", "c"], model, altitude * 0.75, altitude % 5 - 2.0)


@cache
def trained():
    sizes = {"architecture": SIZES, "training": 33, "held_out": 300, "epochs": 1}
    return perception.train_models(np.random.default_rng(1), **sizes)


@cache
def flown():
    return landing.run_experiment(Settings("simulated", "textbook", "preview", 4, 3))


@cache
def fronted():
    """That run with all its Pareto points."""
    return dataclasses.replace(flown(), front=landing.whole_front(flown().problem, 60))


@cache
def seen():
    """A run of the second experiment with two tiny networks."""
    chosen = {"experiment": "trained"} | landing.DEFAULTS["trained"]
    return landing.run_experiment(Settings(**chosen, horizon=6, trials=2), trained=trained())


@cache
def scene():
    return perception.draw_scenes(2, np.random.default_rng(0))


def network():
    """A network of fresh weights, as training changes them in place."""
    return perception.new_network((8, 2, 3), np.random.default_rng(0))


def layers():
    return network().layers


SIZES = [(8, 1, 2), (9, 1, 2)]
PICTURES = numbered(3, 8, 8) / 4
QUADRATIC = np.diag([1.0, 2, 4])


def falling(x):
    """Value, bound and slope of x'Mx/2 over the box, for `projected_gradient`."""
    slope = QUADRATIC @ x - 1
    value = float(x @ (slope - 1) / 2)
    return value, value - float(np.maximum(slope * x, slope * (x - 1)).sum()), slope


# ---------------------------------------------------------------------------------- the table

TASK, PROBLEM, SUITE = record(task), record(problem), record(suite)
BLEND, RESIDUALS = record(blend), record(measured)
TRAINED, SEEN, FLOWN = record(trained), record(seen), Arg("result", fresh=flown)
SEEN_VIEWS = record(lambda: seen_views())
STAGED = record(lambda: dataclasses.replace(seen(), flown=landing.fly_stages(seen())))
RELAXATION, FLAG = record(point, "none"), Arg("flag")
GAP, LIMIT, PATTERN = number(0.25), number(64.0, "none"), word("preview")
STEPS = index([0, 2, 1, 2])


COST = {
    "C": real(C, "length-1"),
    "Q": weight(np.diag([1.0, 2, 0])),
    "R": weight(R),
    "horizon": count(H),
    "Q_final": weight(np.diag([3.0, 0, 1]), "none"),
    "N": real(np.array([[0, 1], [1, 0], [0, 0]]) / 4, "none"),
}


@cache
def seen_views():
    chosen = {"experiment": "measured", **landing.DEFAULTS["measured"], "horizon": 3, "trials": 1}
    return landing.run_experiment(Settings(**chosen))


def plant():
    return scipy.signal.StateSpace(np.array(A) - np.eye(3), B, np.eye(3), np.zeros((3, 2)))


def covariance(t, w, k, v):
    return np.eye(P) * (t == k)


def bias(w, x):
    return w + x


def spread(w, x):
    return 1 + w * abs(x) / 8


def apart():
    return dataclasses.replace(problem(), alpha=0)


#: name of a public callable: the call and its arguments
ROWS: dict[str, tuple[Callable[..., Any], dict[str, Arg]]] = {
    # ---- modelselect: checkers
    "as_numbers": (
        lambda value: ms.as_numbers("value", value),
        {
            "name": FLAG,
            "value": real(A, "nan inf minus rank length empty transposed"),
        },
    ),
    "shown": (ms.shown, {"value": FLAG}),
    "check_array": (
        lambda value: ms.check_array("value", value, "n n", (3, 3)),
        {
            **{"name": FLAG, "value": real(A), "axes": FLAG, "sizes": FLAG, "finite": FLAG},
            "known": FLAG,
        },
    ),
    "check_number": (
        lambda value: ms.check_number("value", value, minimum=0),
        {"name": FLAG, "value": number(3), "minimum": FLAG},
    ),
    "check_count": (
        lambda value: ms.check_count("value", value),
        {"name": FLAG, "value": count(3), "minimum": FLAG, "top": FLAG},
    ),
    "check_semidefinite": (
        lambda matrices: ms.check_semidefinite("matrices", matrices),
        {
            "name": FLAG,
            "matrices": FLAG,
            "definite": FLAG,
            "given": FLAG,
        },  # its callers check the array first
    ),
    "check_information": (ms.check_information, {"information": PATTERN}),
    "check_choices": (
        lambda choices: ms.check_choices(choices, H, W),
        {"choices": STEPS, "H": FLAG, "W": FLAG},
    ),
    # ---- modelselect: control
    "ControlTask": (
        lambda **arrays: ms.psi(ms.ControlTask(**arrays)),
        {
            "A": real(A),
            "B": real(B, blames="R"),
            **COST,
        },
    ),
    "ControlTask/from_statespace": (
        lambda **given: ms.psi(ms.ControlTask.from_statespace(**given)),
        {
            "system": record(plant),
            **COST,
            "dt": number(0.25),
        },
    ),
    "nearest_semidefinite": (ms.nearest_semidefinite, {"matrices": real(np.eye(3))}),
    "ControlTask.over_time": (lambda: task().over_time(), {}),
    "riccati": (ms.riccati, {"task": TASK}),
    "plan": (ms.plan, {"task": TASK, "x0": real(numbered(3)), "s": real(numbered(H, 1))}),
    "run_controller": (
        ms.run_controller,
        {
            "task": TASK,
            "x0": real(numbered(3)),
            "s": real(numbered(H, 1)),
            "s_hat": real(numbered(H, 1) + 1),
            "information": word("causal"),
            "prior_mean": real(numbered(H, 1) - 1, "none"),
            "gains": FLAG,
            "reference": real(numbered(H + 1, 3), "none rank-less"),
            "disturbance": real(numbered(H, 3), "none"),
        },
    ),
    "run_controller/filter": (
        ms.run_controller,
        {
            "task": TASK,
            "x0": real(numbered(3)),
            "s": real(0 * numbered(H, 1)),
            "s_hat": real(numbered(H, 1) + 1),
            "information": word("filter"),
            "gains": real(numbered(3, 1) / 8),
        },
    ),
    "control_cost": (
        ms.control_cost,
        {"task": TASK, "states": real(numbered(H + 1, 3)), "controls": real(numbered(H, 2))},
    ),
    "psi": (ms.psi, {"task": TASK, "information": PATTERN, "gains": FLAG}),
    "psi/filter": (
        ms.psi,
        {
            "task": TASK,
            "information": word("filter"),
            "gains": real(numbered(H, 3, 1) / 8, "rank-less"),
        },
    ),
    "prior_pull": (
        ms.prior_pull,
        {
            "task": TASK,
            "prior_error": real(numbered(3)),
            "information": word("filter"),
            "gains": real(numbered(3, 1) / 8),
        },
    ),
    "sensitivity": (
        ms.sensitivity,
        {"task": TASK, "information": word("filter"), "gains": real(numbered(3, 1) / 8)},
    ),
    "Sensitivity.diagonal": (lambda: system().diagonal(), {}),
    "Sensitivity.order": (lambda: system().order(), {}),
    "kalman_gains": (
        ms.kalman_gains,
        {
            "task": TASK,
            "process_noise": weight(np.diag([1.0, 2, 3])),
            "measurement_noise": weight([[2.0]]),
        },
    ),
    "preview_regret": (ms.preview_regret, {"task": TASK, "errors": real(numbered(H, 1))}),
    # ---- modelselect: the problem
    "one_hot": (
        ms.one_hot,
        {"choices": index([0, 2, 1, 2], "length-0"), "models": count(W)},
    ),
    "from_one_hot": (ms.from_one_hot, {"weights": weight(np.eye(4)[[2, 0, 3]], "length-0")}),
    "SelectionProblem": (
        lambda **fields: ms.SelectionProblem(**fields).total_cost([0, 2, 1, 2]),
        {
            "psi": weight(PSI, blames="mean"),
            "mean": real(MEAN, blames="variance"),
            "variance": weight(VARIANCE),
            "model_cost": real(PRICE, "inf"),
            "alpha": number(1),
            "beta": number(2),
            "switch_cost": weight(SWITCH, "none"),
            "initial_model": count(2, "none zero", blames="initial_model"),
            "budget": number(90.0, "none"),
            "pull": real(numbered(H, P), "none"),
        },
    ),
    "SelectionProblem.is_feasible": (
        lambda choices: problem().is_feasible(choices),
        {"choices": STEPS},
    ),
    "SelectionProblem.chosen_mean": (
        lambda choices: problem().chosen_mean(choices),
        {"choices": STEPS},
    ),
    "SelectionProblem.control_term": (
        lambda choices: problem().control_term(choices),
        {"choices": STEPS},
    ),
    "SelectionProblem.perception_term": (
        lambda choices: problem().perception_term(choices),
        {"choices": STEPS},
    ),
    "SelectionProblem.total_cost": (
        lambda choices: problem().total_cost(choices),
        {"choices": STEPS},
    ),
    "SelectionProblem.cost_rounding": (
        lambda choices: problem().cost_rounding(choices),
        {"choices": STEPS},
    ),
    "SelectionProblem.exact_cost": (
        lambda choices: float(problem().exact_cost(choices)),
        {"choices": STEPS},
    ),
    "reference_bound": (
        ms.reference_bound,
        {"problem": PROBLEM, "reference": real(numbered(P * H)), "multiplier": number(0.0)},
    ),
    "check_certificate": (ms.check_certificate, {"problem": PROBLEM, "schedule": record(schedule)}),
    # ---- modelselect: solvers
    "enumerate_schedules": (
        ms.enumerate_schedules,
        {"problem": PROBLEM, "max_schedules": count(100, "huge")},
    ),
    "is_separable": (ms.is_separable, {"problem": PROBLEM}),
    "stepwise_cost": (ms.stepwise_cost, {"problem": PROBLEM}),
    "solve_separable": (ms.solve_separable, {"problem": record(apart)}),
    "project_to_simplex": (
        ms.project_to_simplex,
        {"points": real(numbered(3, 2), "rank-more rank-less length transposed")},
    ),
    "projected_gradient": (
        lambda evaluate=falling, project=lambda x: np.clip(x, 0, 1), **options: (
            ms.projected_gradient(evaluate, project, **options)
        ),
        {
            "evaluate": function(falling),
            "project": function(lambda x: np.clip(x, 0, 1)),
            "start": real([0.5, 0, 1], "length 1e300 -1e300", blames="step"),
            "step": weight([0.25, 0.25, 0.125]),
            "gap": number(0.0),
            "negligible": number(0.0),
            "max_iterations": count(20, "huge"),
        },
    ),
    "relax": (ms.relax, {"problem": PROBLEM, "gap": GAP, "max_iterations": count(20, "huge")}),
    "relax_interior_point": (
        ms.relax_interior_point,
        {
            "problem": PROBLEM,
            "allowed": weight(numbered(H, W) > -5, "none"),
            "gap": GAP,
            "ceiling": number(0.5, "inf minus-inf negative"),
            "time_limit": LIMIT,
            "max_iterations": count(20, "huge"),
        },
    ),
    "relax_by_columns": (
        ms.relax_by_columns,
        {"problem": PROBLEM, "gap": GAP, "time_limit": LIMIT, "max_iterations": count(20, "huge")},
    ),
    "round_and_swap": (
        ms.round_and_swap,
        {"problem": PROBLEM, "relaxation": RELAXATION, "time_limit": LIMIT},
    ),
    "plain_dynamic_program": (
        ms.plain_dynamic_program,
        {"problem": PROBLEM, "max_labels": count(100, "huge")},
    ),
    "dynamic_program": (
        ms.dynamic_program,
        {
            "problem": PROBLEM,
            "time_limit": LIMIT,
            "max_labels": count(100, "huge"),
            "gap": GAP,
            "relaxation": RELAXATION,
        },
    ),
    "branch_and_bound": (
        ms.branch_and_bound,
        {
            "problem": PROBLEM,
            "time_limit": LIMIT,
            "max_nodes": count(100, "none huge"),
            "gap": GAP,
            "relaxation": RELAXATION,
        },
    ),
    "solve": (
        ms.solve,
        {"problem": PROBLEM, "time_limit": LIMIT, "gap": GAP, "max_labels": count(100, "huge")},
    ),
    "pareto_front": (
        ms.pareto_front,
        {
            **{"problem": PROBLEM, "resolution": number(30.0), "time_limit": LIMIT},
            "progress": function(float)._replace(valid="none"),
        },
    ),
    "receding_horizon": (
        lambda **given: list(ms.receding_horizon(**given)),
        {
            "outlook": function(lambda t: problem()),
            "steps": count(2),
            "budget": number(300.0, "none"),
        }
        | {"time_limit": LIMIT},
    ),
    "error_cost": (ms.error_cost, {"problem": PROBLEM}),
    "correlated_cost": (
        ms.correlated_cost,
        {"problem": PROBLEM, "choices": STEPS, "covariance": function(covariance)},
    ),
    "correlated_cost/array": (
        ms.correlated_cost,
        {"problem": PROBLEM, "choices": STEPS, "covariance": weight(COVARIANCE)},
    ),
    "correlated_problem": (
        lambda **given: ms.correlated_problem(**given).total_cost([0, 2, 1, 2]),
        {"problem": PROBLEM, "covariance": weight(COVARIANCE, blames="psi")},
    ),
    "persistent_bias": (
        ms.persistent_bias,
        {
            "bias_variance": weight(VARIANCE[0]),
            "white_variance": weight(VARIANCE, "length-0", blames="bias_variance"),
            "correlation": weight(np.eye(W), "none"),
        },
    ),
    "autoregressive_errors": (
        ms.autoregressive_errors,
        {
            "variance": weight(VARIANCE, "length-0 length-2 transposed", blames="rho"),
            "rho": weight([0, 0.5, 0.25], "rank-0 rank-less"),
            "correlation": weight(np.eye(W), "none"),
        },
    ),
    "hold": (
        lambda problem, steps: ms.hold(problem, steps).total_cost(np.ones(-(-H // int(steps)))),
        {"problem": PROBLEM, "steps": count(3)},
    ),
    "expand_choices": (
        ms.expand_choices,
        {"choices": index([0, 2], "too-large"), "steps": count(3), "horizon": count(H)},
    ),
    # ---- modelselect: blends, the gadget
    "BlendProblem": (
        lambda **fields: ms.BlendProblem(**fields).total_cost([0.5, 0, 1, 0.25]),
        {
            "problem": PROBLEM,
            "worst": count(0, "zero negative"),
            "best": count(2, "zero negative"),
        },
    ),
    "BlendProblem.total_cost": (
        lambda blend: BLEND.make().total_cost(blend),
        {"blend": real([0.5, 0, 1, 0.25])},
    ),
    "solve_blend": (
        ms.solve_blend,
        {"blend": BLEND, "gap": GAP, "max_iterations": count(20, "huge")},
    ),
    "sdp_blocks": (
        ms.sdp_blocks,
        {"blend": BLEND, "theta": number(3.0, "negative"), "choices": real([0.5, 0, 1, 0.25])},
    ),
    "partition_problem": (
        ms.partition_problem,
        {"integers": index([3, 1, 2], "length too-large"), "information": PATTERN},
    ),
    "maximum_cut_problem": (
        ms.maximum_cut_problem,
        {"adjacency": FLAG, "information": FLAG},  # see test_theory.py
    ),
    # ---- perception: suites
    "PerceptionSuite": (
        perception.PerceptionSuite,
        {
            "names": names(["a", "b", "c"], blames="mean"),
            "mean": real(MEAN, blames="variance"),
            "variance": weight(VARIANCE),
            "cost": real(PRICE, "inf"),
            "sample_size": index(np.full((H, W), 5), "none too-large"),
            "standard_error": weight(VARIANCE / 4, "none"),
            "miss_rate": weight(np.full((H, W), 0.25), "none"),
            "used": number(0.5),
        },
    ),
    "PerceptionSuite.pick": (
        lambda models: suite().pick(models),
        {"models": names(["c", "a"], "fewer")},
    ),
    "published_suite": (
        perception.published_suite,
        {"horizon": count(H), "rng": RNG, "upsilon": number(3.0)},
    ),
    "gaussian_suite": (
        perception.gaussian_suite,
        {
            "bias": function(bias),
            "spread": function(spread),
            "cost": real(PRICE, "inf", blames="mean"),
            "at": real([8, 4, 2, 1], "length"),
            "names": names(["a", "b", "c"], "none", blames="mean"),
            "jitter": weight([0.5, 0.25]),
            "signs": word("step"),
            "rng": RNG,
        },
    ),
    "textbook_suite": (
        perception.textbook_suite,
        {
            "altitude": real([8, 4, 2, 1], "length"),
            "rng": RNG,
            "signs": word("step"),
            "upsilon": number(3.0),
        },
    ),
    "sample_errors": (perception.sample_errors, {"suite": SUITE, "trials": count(2), "rng": RNG}),
    # ---- perception: measurements
    "Residuals": (
        perception.Residuals,
        {
            "names": names(["a", "b", "c"], blames="model"),
            "model": index([0, 2, 1, 1]),
            "altitude": real([1, 2, 3, 4], "rank-more"),
            "residual": real(
                [0, 1, -1, 2], "rank-more nan", blames="altitude"
            ),  # NaN: no detection
            "variables": names(["range"], "twice", blames="altitude"),
            "components": names(["residual_x"], "none twice"),
            "period": real([9.0], "none inf rank-less rank-0"),
            "resolution": weight([0.5], "rank-less rank-0"),
            "ordered": Arg("flag", True),
        },
    ),
    "Residuals/tables": (
        lambda **given: perception.Residuals(["a"], [0, 0], **given),
        {
            "altitude": real([[1, 2], [3, 4]]),
            "residual": real([[0, 1], [2, 3]], blames="altitude components"),
            "variables": names(["range", "bearing"], blames="altitude"),
            "components": names(["residual_x", "residual_y"], "none"),
        },
    ),
    "Kernel": (
        perception.Kernel,
        {
            "width": number(0.25),
            "log": names(["range"], "empty twice fewer"),
            "relative": word("range", "unknown none case"),
        },
    ),
    "with_dropouts": (
        perception.with_dropouts,
        {
            "suite": SUITE,
            "probability": weight([0, 0.5, 0.25], "rank-0 rank-less"),
            "fallback": word("b", "number"),
        },
    ),
    "with_dropouts/prior": (
        lambda mean, variance: perception.with_dropouts(suite(), 0.5, (mean, variance)),
        {
            "mean": real([0.0] * P, blames="fallback.mean"),
            "variance": weight([1.0] * P, blames="fallback.variance"),
        },
    ),
    "with_latency": (
        perception.with_latency,
        {
            "suite": SUITE,
            "delay": weight([0, 1, 2], "rank-0 rank-less"),
            "variance": weight([1.0] * P),
            "drift": real([0.5] * P, "none"),
        },
    ),
    "measured_latency": (perception.measured_latency, {"table": word("resnet-jetson-nano")}),
    "read_residuals": (
        perception.read_residuals,
        {
            "path": path("residuals.csv"),
            "names": names(["a", "b", "c"], "none", blames="residuals"),
            "sep": Arg("flag", ","),
            "decimal": Arg("flag", "."),
            "period": real([9.0], "none inf rank-less rank-0"),
            "resolution": weight([0.5], "rank-less rank-0"),
        },
    ),
    "write_residuals": (
        perception.write_residuals,
        {"path": path("written.csv"), "residuals": RESIDUALS},
    ),
    "fit_suite": (
        perception.fit_suite,
        {
            "residuals": RESIDUALS,
            "trajectory": real([8, 6, 3, 1], "length"),
            "cost": real(PRICE, "inf"),
            "bins": count(2),
            "kernel": record(lambda: None, "none"),
        },
    ),
    "fit_suite/edges": (
        lambda bins: perception.fit_suite(measured(), [8, 6, 3, 1], PRICE, bins=bins),
        {"bins": real([0, 4, 9], "rank-0")},
    ),
    "bootstrap_errors": (
        perception.bootstrap_errors,
        {
            "residuals": RESIDUALS,
            "trajectory": real([8, 6, 3, 1], "length"),
            "trials": count(2),
            "rng": RNG,
            "bins": count(2),
            "kernel": record(lambda: None, "none"),
        },
    ),
    "guard_suite": (
        perception.guard_suite,
        {
            "suite": record(lambda: perception.fit_suite(measured(), [8, 6, 3, 1], PRICE, bins=2)),
            "level": number(0.75),
        },
    ),
    "altitude_bins": (
        perception.altitude_bins,
        {
            "altitude": real([1, 2, 3, 4, 5], "length"),
            "trajectory": real([8, 6, 3, 1], "length"),
            "count": count(2, blames="altitude"),
        },
    ),
    # ---- perception: camera and networks
    "check_rng": (lambda rng: perception.check_rng(rng).random(), {"rng": RNG}),
    "draw_pose": (perception.draw_pose, {"count": count(2), "rng": RNG}),
    "draw_scenes": (perception.draw_scenes, {"count": count(2), "rng": RNG}),
    "draw_views": (perception.draw_views, {"count": count(2), "rng": RNG}),
    "photograph": (
        perception.photograph,
        {
            "scene": record(scene),
            "altitude": real([8, 1]),
            "side": count(8),
            "rng": RNG,
            "pitch": real([0.25, -0.5], "rank-0 rank-less"),
            "seconds": number(2.0, "negative"),
        },
    ),
    "Network.altitude": (
        lambda pictures: network().altitude(pictures),
        {"pictures": real(PICTURES, "length-0")},
    ),
    "new_network": (
        perception.new_network,
        {"shape": index([8, 2, 3], "too-large"), "rng": RNG},
    ),
    "forward": (
        perception.forward,
        {"layers": record(layers), "pictures": real(PICTURES, "length")},
    ),
    "gradients": (
        perception.gradients,
        {
            "layers": record(layers),
            "pictures": real(PICTURES, "length-1 length-2", blames="target"),
            "target": real([1, -1, 0]),
        },
    ),
    "train_network": (
        perception.train_network,
        {
            "network": record(network),
            "pictures": real(PICTURES, blames="altitude"),
            "altitude": real([1, 5, 20]),
            "epochs": count(1),
            "rng": RNG,
        },
    ),
    "train_models": (
        perception.train_models,
        {
            "rng": RNG,
            "architecture": index(SIZES, "length-0 too-large", blames="shape"),
            "training": count(4, blames="count"),
            "held_out": count(3, blames="count"),
            "epochs": count(1),
            "progress": FLAG,
        },
    ),
    "measure_models": (
        perception.measure_models,
        {"networks": record(lambda: [network()]), "count": count(2), "rng": RNG},
    ),
    "with_bar": (
        perception.with_bar,
        {"items": FLAG, "title": FLAG, "progress": FLAG},  # see test_perception.py
    ),
    "pack_models": (perception.pack_models, {"trained": TRAINED, "key": Arg("flag", "key")}),
    "load_models": (
        lambda path="models.npz", key="key", architecture=SIZES: perception.load_models(
            path, key, architecture
        ),
        {
            "path": path("models.npz"),
            "key": FLAG,
            "architecture": index(SIZES, "too-large", blames="shape models.npz"),
        },
    ),
    # ---- landing
    "preset": (
        lambda **options: landing.preset(**options).task,
        {"name": word("textbook", blames="preset"), "horizon": count(H)},
    ),
    "cost_scale": (
        landing.cost_scale,
        {"Psi": weight(PSI, blames="psi mean"), "suite": SUITE},
    ),
    "Settings": (
        Settings,
        {
            "experiment": word("trained"),
            "preset": word("textbook"),
            "information": word("measurement"),
            "horizon": count(H),
            "trials": count(3),
            "alpha": number(0.5),
            "beta": number(0.5),
            "upsilon": number(2.0, "none"),
            "cost": word("linear"),
            "seed": count(7, "zero huge beyond-int64 beyond-float"),
            "switch_cost": number(0.5),
            "budget": number(2.0, "none"),
            "residuals": Arg("flag"),
            "fit": word("kernel"),
            "calibrate": FLAG,
            "rounds": count(1, "zero", blames="rounds"),
        },
    ),
    "Result.means": (lambda: flown().means(), {}),
    "policies": (
        landing.policies,
        {
            "problem": PROBLEM,
            "optimal": index([0, 2, 1, 2], blames="choices"),
            "errors": Arg(
                "batches", np.array([MEAN, 1 - MEAN]), "empty length-0 negative", "mean variance"
            ),
            "rng": RNG,
        },
    ),
    "fly": (
        landing.fly,
        {
            "landing": record(lambda: landing.preset("textbook", H)),
            "information": word("filter"),
            "s": real(numbered(2, H, 1), blames="errors"),
            "errors": real(numbered(2, H, W, 1), "length-2"),
            "choices": index([0, 2, 1, 2], "none"),
            "gains": real(numbered(H, 4, 1) / 32, "rank-less"),
        },
    ),
    "run_experiment": (
        landing.run_experiment,
        {
            "settings": record(lambda: Settings("simulated", "textbook", "causal", 2, 2), "none"),
            "trained": FLAG,
            "progress": FLAG,
        },
    ),
    "pareto": (
        landing.pareto,
        {"problem": PROBLEM, "points": count(2), "progress": FLAG},
    ),
    "whole_front": (
        landing.whole_front,
        {"problem": PROBLEM, "seconds": number(60.0), "progress": FLAG},
    ),
    "model_cost": (
        landing.model_cost,
        {"networks": record(lambda: [network()]), "cost": word("counted")},
    ),
    "fit_landing": (
        landing.fit_landing,
        {
            "landing": record(lambda: seen().landing),
            "measured": record(lambda: trained().residuals),
            "cost": real([0, 1], "inf"),
            "bins": count(2, "none", blames="count altitude"),
            "guard": FLAG,
            "rng": Arg("rng", valid="none", fresh=lambda: np.random.default_rng(3)),
        },
    ),
    "learn": (
        lambda seed=7, folder=None, **more: landing.learn(
            seed, folder, architecture=SIZES, training=4, held_out=3, epochs=1, **more
        ),
        {
            "seed": count(7, "zero huge beyond-int64 beyond-float"),
            "folder": record(lambda: Path("learned"), "none"),
            "progress": FLAG,
            "options": FLAG,
        },
    ),
    "fly_on_pictures": (
        landing.fly_on_pictures,
        {
            "result": SEEN,
            "s": real(numbered(2, 6, 1) / 8, "length-0"),
            "choices": index([0, 1, 1, 0, 1, 0]),
            "seed": count(5, "zero huge beyond-int64 beyond-float"),
        },
    ),
    "judge_on_pictures": (
        landing.judge_on_pictures,
        {
            "result": SEEN,
            "information": word("measurement"),
            "policies": names(["Optimal", "Random"], "fewer empty twice"),
            "progress": FLAG,
        },
    ),
    "fly_stages": (
        lambda result, trials=None, **more: landing.fly_stages(result, trials, **more)[
            "kernel"
        ].totals["Optimal"],
        {"result": SEEN, "trials": count(2, "none"), "progress": FLAG},
    ),
    "sample_sizes": (
        landing.sample_sizes,
        {
            "result": SEEN,
            "sizes": index([50, 60], "length-0"),
            "repeats": count(1),
            "fresh": count(300, blames="count"),
        },
    ),
    "report_measured": (landing.report_measured, {"result": SEEN_VIEWS}),
    "report_pictures": (landing.report_pictures, {"result": SEEN, "progress": FLAG}),
    "root_mean_square": (landing.root_mean_square, {"values": real([1, 2, 4], "length")}),
    "published_log": (
        landing.published_log,
        {"settings": record(lambda: Settings(upsilon=1e14)), "offset": count(1, "zero huge")},
    ),
    "half_width": (landing.half_width, {"values": real([1, 2, 4], "length")}),
    "report": (landing.report, {"result": FLOWN}),
    "percentages": (landing.percentages, {"result": FLOWN}),
    "summary": (landing.summary, {"result": FLOWN}),
    "plot_schedule": (landing.plot_schedule, {"result": FLOWN}),
    "plot_costs": (landing.plot_costs, {"result": FLOWN}),
    "plot_rewards": (landing.plot_rewards, {"result": FLOWN}),
    "plot_pareto": (
        landing.plot_pareto,
        {"result": FLOWN, "optima": record(lambda: [flown().optimal], "none")},
    ),
    "plot_front": (
        landing.plot_front,
        {"result": record(fronted)},
    ),
    "plot_landing": (landing.plot_landing, {"result": FLOWN}),
    "plot_efficientnet": (landing.plot_efficientnet, {}),
    "plot_psi": (landing.plot_psi, {"task": Arg("result", fresh=task)}),
    "plot_gallery": (
        landing.plot_gallery,
        {"seed": Arg("limit", 3, "zero huge beyond-int64 beyond-float")},
    ),
    "plot_accuracy": (landing.plot_accuracy, {"trained": Arg("result", fresh=trained)}),
    "plot_distribution": (
        landing.plot_distribution,
        {"trained": TRAINED, "model": Arg("limit", 1, "zero negative")},
    ),
    "plot_training": (landing.plot_training, {"trained": Arg("result", fresh=trained)}),
    "plot_stages": (landing.plot_stages, {"result": STAGED}),
    "plot_quantiles": (landing.plot_quantiles, {"trained": Arg("result", fresh=trained)}),
    "write_figures": (
        landing.write_figures,
        {"result": FLOWN, "folder": Arg("flag", Path("figures")), "progress": FLAG},
    ),
    "write_percentages": (
        landing.write_percentages,
        {"result": FLOWN, "path": Arg("flag", Path("percentages.csv"))},
    ),
    "write_atomically": (
        landing.write_atomically,
        {
            "path": record(lambda: Path("written")),
            "content": record(lambda: b"all", "array"),
            "make_folder": FLAG,
        },
    ),
    "check_targets": (
        landing.check_targets,
        {"out": record(lambda: Path("out"), "none"), "path": record(lambda: Path("p"), "none")},
    ),
    "main": (landing.main, {"argv": FLAG}),  # see test_command_line.py
}

#: What functions return, and nobody makes by hand: fields without checks.
RECORDS = {
    *("Riccati", "Pattern", "Schedule", "Relaxation", "Node", "ErrorCost", "Blend"),
    *("Sensitivity", "ModelTable", "Scene", "Layer", "Network", "Trained"),
    *("Preset", "Flights", "Result", "Regret", "Front"),
}


def public(module):
    """Public callables that a module defines: functions, classes, and methods of classes."""
    for name, thing in vars(module).items():
        if not belongs(name, thing, module):
            continue
        if inspect.isclass(thing):
            methods = {k: v for k, v in vars(thing).items() if inspect.isfunction(v)}
            yield from ((f"{name}.{k}", v) for k, v in methods.items() if k[0] != "_")
        if callable(thing):
            yield name, thing


@pytest.mark.unmutated
def test_the_table_is_complete():
    found = {name: thing for module in MODULES for name, thing in public(module)}
    assert set(found) == RECORDS | {row.split("/")[0] for row in ROWS}
    for name in set(found) - RECORDS:
        parameters = set(inspect.signature(found[name]).parameters) - {"self"}
        assert parameters == set(ROWS[name][1]), name


def test_records_have_no_checks():
    found = {name: thing for module in MODULES for name, thing in public(module)}
    for name in RECORDS - {"Schedule", "Sensitivity"}:  # which freeze their arrays
        assert "__post_init__" not in vars(found[name])


# ------------------------------------------------------------------------------------- the tests


@pytest.fixture(scope="module", autouse=True)
def place(tmp_path_factory):
    """A folder of its own, with the files that the table names."""
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(tmp_path_factory.mktemp("inputs"))
        perception.write_residuals("residuals.csv", measured())
        Path("models.npz").write_bytes(perception.pack_models(trained(), "key"))
        yield


def numbers(result):
    """All numbers and words of a result, but not the seconds it took."""
    if dataclasses.is_dataclass(result):
        result = {f.name: getattr(result, f.name) for f in dataclasses.fields(result)}
    if isinstance(result, tuple) and hasattr(result, "_asdict"):
        result = result._asdict()
    if isinstance(result, dict):
        timed = {"work", "seconds", "solve_seconds"}
        return [x for key, value in result.items() if key not in timed for x in numbers(value)]
    if isinstance(result, plt.Figure):
        images = [image.get_array() for axes in result.axes for image in axes.images]
        result = images + [line.get_xydata() for axes in result.axes for line in axes.lines]
    if isinstance(result, list | tuple):
        return [x for value in result for x in numbers(value)]
    return [] if callable(result) else [np.asarray(result)]


def called(row, *without, **changes):
    """Call a function with its good arguments, but for the changes; inputs stay as they are."""
    call, arguments = ROWS[row]
    arguments = {name: arg for name, arg in arguments.items() if name not in without}
    optional = {
        key for key, p in inspect.signature(call).parameters.items() if p.default != p.empty
    }
    given = {
        name: changes[name] if name in changes else arg.make()
        for name, arg in arguments.items()
        if name in changes or arg.kind != "flag" or (arg.value is not None and name not in optional)
    }
    before = {name: np.copy(value) for name, value in given.items() if is_array(value)}
    try:
        return call(**given)
    finally:
        plt.close("all")  # what a spoiled call left half drawn
        for name, array in before.items():
            np.testing.assert_array_equal(np.asarray(given[name]), array, f"{name} was modified")


def is_array(value):
    return isinstance(value, np.ndarray)


@cache
def expected(row):
    return numbers(called(row))


def cases(ways):
    """Every row, argument and way, as parameters of a test."""
    return [
        pytest.param(row, name, way, id=f"{row}-{name}-{way}")
        for row, (_, arguments) in ROWS.items()
        for name, arg in arguments.items()
        for way in ways.get(arg.kind, ())
        if not arg.spares(way) and differs(arg, way, ways)
    ]


def differs(arg, way, ways):
    """Whether this way applies to the value: it has such an axis, or holds such numbers."""
    if way.startswith("length"):
        return arg.value.ndim > int(way[-1])
    if way == "transposed":  # of a square array it cannot be told, nor of one with a single axis
        return arg.value.T.shape != arg.value.shape
    if ways is not SAMES:
        return True
    with np.errstate(invalid="ignore"):
        return np.array_equal(np.asarray(SAMES[arg.kind][way](arg.value)), arg.value)


def by(error, *places):
    """Whether an exception was raised in a file of such a name."""
    where = traceback.extract_tb(error.__traceback__)[-1].filename
    return any(place in where for place in places)


#: The axes that messages name: those of the symbol table, and what else docstrings explain.
AXES = {"H", "W", "p", "n", "m", "pH", "N", "V", "side", "trials", "edges", "or"}


#: What is said of each array that has an axis too many, word by word.
LINES = Path(__file__).with_name("shapes.txt").read_text(encoding="utf-8").splitlines()
SHAPES = {(row, name): message for row, name, message in (line.split(" | ") for line in LINES)}


def check_line(error, opening):
    """A single, short line that opens with one of these, raised by our modules."""
    message = str(error)
    axes = re.findall(r"[a-zA-Z]+", "".join(re.findall(r"expected shape \((.*?)\)", message)))
    assert set(axes) <= AXES and not ("n" in axes and "side" in axes), message
    assert by(error, "modelselect_parts", *(module.__file__ for module in MODULES)), message
    assert "\n" not in message and len(message) < 250 and message.startswith(opening), message


@pytest.mark.parametrize("row, name, way", cases(ERRORS))
def test_a_spoiled_argument_is_refused_in_a_line_that_names_it(row, name, way):
    arg = ROWS[row][1][name]
    bad = ERRORS[arg.kind][way](arg.make())
    with pytest.raises(REFUSALS.get(arg.kind, ValueError)) as caught:
        called(row, **{name: bad})
    if isinstance(caught.value, TypeError):
        assert "\n" not in str(caught.value) and not by(caught.value, "site-packages", __file__)
    else:
        names = (name, *arg.blames.split(), *[" ".join(str(bad).split())] * (arg.kind == "path"))
        check_line(caught.value, tuple(f"{word}{end}" for word in names for end in ":."))
    if way == "rank-more":
        assert str(caught.value) == SHAPES[row, name]


@pytest.mark.no_cover
@pytest.mark.unmutated
@pytest.mark.parametrize("row, name, way", cases(SAMES))
def test_other_forms_of_the_same_numbers_give_the_same_answer(row, name, way):
    arg = ROWS[row][1][name]
    found = numbers(called(row, **{name: SAMES[arg.kind][way](arg.make())}))
    for one, other in zip(found, expected(row), strict=True):
        if one.dtype.kind in "US" or other.dtype.kind in "USO":
            assert (one == other).all()
        else:
            np.testing.assert_allclose(one, other, rtol=1e-12, atol=1e-12 * np.abs(other).max())


SEEDS = {
    (row, name): {"rng": np.random.default_rng, "seed": int}[name]
    for row, (_, arguments) in ROWS.items()
    for name in {"rng", "seed"} & set(arguments)
}


#: What else must be given for a generator to be used, or for anything to be learned.
BESIDES = {"fit_landing": {"bins": None}, "learn": {"folder": None}}


def equal(one, other):
    pairs = zip(numbers(one), numbers(other), strict=True)
    return all(np.array_equal(a, b, equal_nan=a.dtype.kind == "f") for a, b in pairs)


@pytest.mark.no_cover
@pytest.mark.parametrize("row, name", SEEDS)
def test_a_seed_fixes_all_numbers_and_another_changes_some(row, name):
    seeds, given = (5, 5, 6), BESIDES.get(row, {})
    first, again, other = (called(row, **given | {name: SEEDS[row, name](k)}) for k in seeds)
    assert equal(first, again) and not equal(first, other)


#: Defaults that take long, and functions that are called elsewhere only.
ELSEWHERE = {("train_models", name) for name in ("architecture", "training", "held_out")}
ELSEWHERE |= {("run_experiment", "settings"), ("maximum_cut_problem", "information")}
ELSEWHERE |= {("main", "argv")}
OPTIONAL = {
    (row, name): p.default
    for row, (call, _) in ROWS.items()
    for name, p in inspect.signature(call).parameters.items()
    if p.default is not p.empty and call.__name__ != "<lambda>" and name != "progress"
    if (row, name) not in ELSEWHERE
}


@pytest.mark.no_cover
@pytest.mark.parametrize("row, name", OPTIONAL)
def test_what_is_not_given_is_what_the_signature_says(row, name):
    def outcome(*without, **given):
        try:
            return called(row, *without, **given)
        except ValueError as error:
            return str(error)

    assert equal(outcome(name), outcome(**{name: OPTIONAL[row, name]}))


#: What draws by the seed of a run, of which it is given the result.
BY_RUN = {
    "judge": lambda run: landing.judge_on_pictures(run, "measurement", ["Optimal"])[1],
    "stages": lambda run: landing.fly_stages(run)["kernel"].lost,
    "sizes": lambda run: landing.sample_sizes(run, [50], repeats=1, fresh=300),
    "views": lambda run: landing.report_measured(run),
}


@pytest.mark.parametrize("what", BY_RUN)
def test_the_seed_of_a_run_is_that_of_all_that_is_made_of_it(what):
    run = seen_views() if what == "views" else seen()
    runs = [
        dataclasses.replace(run, settings=dataclasses.replace(run.settings, seed=seed))
        for seed in (5, 5, 6)
    ]
    first, again, other = map(BY_RUN[what], runs)
    assert equal(first, again) and not equal(first, other)


#: The bars of what takes `progress`; a bar of what it calls may be left out.
BARS = {
    "train_models": ["Training"],
    "run_experiment": ["Clairvoyant"],
    "pareto": ["Pareto front"],
    "whole_front": ["All Pareto points"],
    "learn": ["Training"],
    "judge_on_pictures": ["Flights (measurement)"],
    "fly_stages": ["Stages"],
    "report_pictures": [*(f"Flights ({k})" for k in ("measurement", "causal", "filter")), "Stages"],
    "write_figures": ["Pareto front"],
}


@pytest.fixture
def bars(monkeypatch):
    """The titles of bars that are shown, in order."""
    shown = []

    def with_bar(items, title, progress):
        shown.extend([title] * (progress is True))
        return items

    monkeypatch.setattr(perception, "with_bar", with_bar)
    return shown


def test_bars_of_all_that_take_progress_are_known():
    take = {row for row, (_, arguments) in ROWS.items() if "progress" in arguments}
    assert take == set(BARS) | {"with_bar", "pareto_front"}


@pytest.mark.parametrize("row", BARS)
def test_progress_is_handed_on_and_nothing_is_shown_without(row, bars, monkeypatch):
    monkeypatch.setattr(landing, "sample_sizes", lambda *_: np.zeros((2, 2, 3)))  # has no bar
    monkeypatch.setattr(plt.Figure, "savefig", lambda *_, **__: None)  # which takes seconds
    for asked, titles in (({}, []), ({"progress": True}, BARS[row])):
        called(row, **asked, **BESIDES.get(row, {}))
        assert bars == titles


@pytest.mark.parametrize("progress", [False, True])
def test_a_bar_is_shown_at_a_terminal_if_it_is_asked_for(progress, monkeypatch):
    asked = []
    fake = types.SimpleNamespace(tqdm=lambda *given, **options: asked.append((given, options)))
    monkeypatch.setitem(sys.modules, "tqdm", fake)
    perception.with_bar([1, 2], "A title", progress)
    # None is tqdm's word for: only at a terminal.
    assert asked == [(([1, 2], "A title"), {"leave": False, "disable": None if progress else True})]


HUGE = {kind: {"1e300": first(1e300), "-1e300": first(-1e300)} for kind in ("array", "number")}


@pytest.mark.parametrize("row, name, way", cases(HUGE))
def test_a_huge_number_gives_finite_numbers_or_a_line_that_says_what_is_wrong(row, name, way):
    arg = ROWS[row][1][name]
    try:
        found = called(row, **{name: HUGE[arg.kind][way](arg.make())})
    except ValueError as error:
        words = (*ROWS[row][1], *arg.blames.split(), "task", "states", "spread")
        check_line(error, tuple(f"{word}: " for word in words))
    else:
        assert all(np.isfinite(x).all() for x in numbers(found) if x.dtype.kind == "f")


def with_rows(n):
    """Fit a bin of n residuals of a model."""
    rows = perception.Residuals(["a"], np.zeros(n, int), np.ones(n), np.arange(n) - 1.0)
    return perception.fit_suite(rows, [1], [1], bins=[0, 2])


def near_rows(n):
    """Fit by nearness where n residuals lie, and others infinitely far away."""
    altitude = np.r_[np.ones(n), [1e9, 2e9]]
    rows = perception.Residuals(["a"], np.zeros(n + 2, int), altitude, np.arange(n + 2.0))
    return perception.fit_suite(rows, [1], [1], kernel=perception.Kernel(1e-3), bins=1)


def with_sizes(n):
    size, error = np.full((1, 1), n), np.ones((1, 1, 1))
    return perception.guard_suite(
        perception.PerceptionSuite(["a"], error, error, [1], size, standard_error=error)
    )


def with_views(n):
    rows = perception.Residuals(
        ["a"], np.zeros(n, int), [[k, 1 + k] for k in range(n)], np.ones(n), ["view", "altitude"]
    )
    return halves(rows, np.random.default_rng(0))


def above(limit):
    return np.nextafter(limit, np.inf)


def below(limit):
    return np.nextafter(limit, -np.inf)


TINY = np.finfo(float).tiny
#: What takes a number, the last number that it takes, and the first one that it does not.
LIMITS = {
    "probability-0": (lambda q: perception.with_dropouts(suite(), q, 0), 0, -TINY),
    "probability-1": (lambda q: perception.with_dropouts(suite(), q, 0), 1, above(1)),
    "miss_rate": (lambda q: suite_of(miss_rate=np.full((H, W), q)), 1, above(1)),
    "sample_size": (lambda n: suite_of(sample_size=np.full((H, W), n)), 2**53, 2**53 + 2),
    "guarded": (with_sizes, 2, 1),
    "level-half": (lambda level: perception.guard_suite(with_rows(3), level), 0.5, below(0.5)),
    "level-1": (lambda level: perception.guard_suite(with_rows(3), level), below(1), 1),
    "width": (perception.Kernel, TINY, 0),
    "period": (lambda p: perception.Residuals(["a"], [0], [1], [0], period=p), TINY, 0),
    "in-a-bin": (with_rows, 2, 1),
    "near": (near_rows, 2, 1),
    "bins": (lambda n: perception.altitude_bins([1, 2, 3, 4], [0, 3.5], n), 3, 4),
    "views": (with_views, 2, 1),
    "lowest": (lambda h: perception.photograph(scene(), [h, 1], 8, RNG.make()), -2, below(-2)),
    "highest": (lambda h: perception.photograph(scene(), [h, 1], 8, RNG.make()), 135, above(135)),
    "taught-low": (lambda h: train_on(h), -2, below(-2)),
    "taught-high": (lambda h: train_on(h), 135, above(135)),
    "side": (lambda side: perception.new_network((side, 1, 1), RNG.make()), 8, 7),
    "sizes": (lambda n: landing.sample_sizes(seen(), [n], repeats=1, fresh=300), 300, 301),
    "last": (lambda w: landing.plot_distribution(trained(), w), 1, 2),
    "first": (lambda w: landing.plot_distribution(trained(), w), -2, -3),
    "prices": (lambda w: landing.cost_scale(PSI, suite().pick([0, 1][:w])), 2, 1),
    "seconds": (lambda seconds: landing.whole_front(problem(), seconds), 0, -TINY),
    "offset": (lambda k: landing.published_log(Settings(upsilon=1e14), k), 0, -1),
    "published-price": (lambda u: perception.published_suite(1, RNG.make(), u), 0, -TINY),
    "textbook-price": (lambda u: perception.textbook_suite([1], RNG.make(), upsilon=u), 0, -TINY),
    "used": (lambda share: suite_of(used=share), 0, -TINY),
    "delay": (lambda d: perception.with_latency(suite(), d, [1.0] * P), 0, -TINY),
    "repeats": (lambda n: landing.sample_sizes(seen(), [50], repeats=n, fresh=300), 1, 0),
    "learned": (lambda seed: ROWS["learn"][0](seed), 0, -1),
    "scenes": (lambda seed: by_sight(seed), 0, -1),
    "gallery": (lambda seed: landing.flights.photograph_landings(seed), 0, -1),
    **{
        f"{name}": (lambda value, name=name: Settings(**{name: value}), last, first)
        for name, last, first in (
            *(("horizon", 1, 0), ("trials", 1, 0), ("seed", 0, -1), ("rounds", 0, -1)),
            *((name, 0, -TINY) for name in ("alpha", "beta", "upsilon", "switch_cost", "budget")),
        )
    },
}


def by_sight(seed):
    s, choices = numbered(1, 6, 1) / 8, [0, 1, 1, 0, 1, 0]
    return landing.fly_on_pictures(seen(), s, choices, seed)


@pytest.mark.parametrize("draw", [ROWS["learn"][0], by_sight, lambda seed: Settings(seed=seed)])
def test_a_seed_may_be_of_any_size(draw):
    assert not equal(draw(2**70), draw(2**70 + 1))


def train_on(h):
    given = PICTURES[:1], [h], 1, RNG.make()
    return perception.train_network(network(), *given)


@pytest.mark.parametrize("limit", LIMITS)
def test_a_limit_itself_is_allowed_and_nothing_beyond(limit):
    call, last, beyond = LIMITS[limit]
    call(last)
    with pytest.raises(ValueError):
        call(beyond)
    plt.close("all")


# ------------------------------------------------------------------- what the table cannot hold


def refused(call, *opening):
    with pytest.raises(ValueError) as caught:
        call()
    check_line(caught.value, opening)


@pytest.mark.parametrize("way", ["nan", "inf", "longer", "rank", "text", "huge"])
@pytest.mark.parametrize("name", perception.Scene._fields)
def test_a_spoiled_scene_is_refused(name, way):
    spoil = {"nan": first(np.nan), "inf": first(np.inf), "huge": first(1e300), "longer": longer(1)}
    spoil |= {"rank": lambda good: good[0], "text": lambda good: good.astype(str)}
    spoiled = scene()._replace(**{name: spoil[way](getattr(scene(), name))})
    rng = np.random.default_rng(0)
    refused(lambda: perception.photograph(spoiled, [8, 1], 8, rng), f"scene.{name}: ", "scene.")


@pytest.mark.parametrize("bad", [np.nan, "x", [1.0], np.ones((W, H)), 1e300, 1j])
def test_functions_that_return_rubbish_are_refused(bad):
    cost, at = PRICE, [8, 4, 2, 1]
    good = (lambda w, x: w + x, lambda w, x: w * x)
    refused(lambda: perception.gaussian_suite(lambda w, x: bad, good[1], cost, at), "bias: ")
    refused(lambda: perception.gaussian_suite(good[0], lambda w, x: bad, cost, at), "spread: ")
    steps = [0, 2, 1, 2]
    refused(lambda: ms.correlated_cost(problem(), steps, lambda *_: bad), "covariance: ")


def test_a_formula_that_overflows_is_refused_and_not_warned_of():
    def wild(w, x):
        return (1 + w) * (x * 1e300 * 1e300 - x * 1e300 * 1e300)  # inf - inf

    refused(lambda: perception.gaussian_suite(wild, spread, PRICE, [8, 4]), "bias: expected finite")
    refused(lambda: perception.gaussian_suite(bias, wild, PRICE, [8, 4]), "spread: expected finite")


@pytest.mark.parametrize("solver", [ms.round_and_swap, ms.dynamic_program, ms.branch_and_bound])
def test_a_relaxation_of_another_problem_proves_nothing(solver):
    dear = dataclasses.replace(problem(), psi=1000 * problem().psi)
    own, other = solver(problem()), solver(problem(), relaxation=ms.relax_interior_point(dear))
    assert ms.check_certificate(problem(), other) == other.root_bound
    least = ms.enumerate_schedules(problem()).cost
    for found in (own, other):
        assert found.lower_bound <= least <= found.cost
    lie = dataclasses.replace(
        point(), bound=2 * least, value=2 * least, reference=point().reference + 1
    )
    found = solver(problem(), relaxation=lie)
    assert found.lower_bound <= least <= found.cost and found.root_bound < least


@pytest.mark.parametrize("weights", [-1 / 3, 0.5, 1.0, np.nan])
@pytest.mark.parametrize("solver", [ms.round_and_swap, ms.dynamic_program, ms.branch_and_bound])
def test_weights_that_are_no_relaxation_are_refused(solver, weights):
    spoiled = dataclasses.replace(point(), weights=np.full((H, W), weights))
    refused(lambda: solver(problem(), relaxation=spoiled), "relaxation.weights: expected")
    shorter = dataclasses.replace(point(), weights=point().weights[:, 1:])
    refused(lambda: solver(problem(), relaxation=shorter), "relaxation.weights: expected shape")


def test_weights_on_a_model_that_is_not_available_are_refused():
    gone = dataclasses.replace(problem(), model_cost=[0, np.inf, 40])
    even = dataclasses.replace(point(), weights=np.full((H, W), 1 / W))
    refused(lambda: ms.round_and_swap(gone, even), "relaxation.weights: expected")


def test_costs_that_overflow_are_refused_and_do_not_make_a_model_unavailable():
    tables = np.eye(2), np.zeros((2, 2, 1)), np.zeros((2, 2, 1))
    refused(lambda: ms.SelectionProblem(*tables, [0, 1e300], beta=1e10), "psi: the costs overflow")


def test_entries_far_above_their_diagonal_are_indefinite():
    Q = [[1e-300, 1e300], [1e300, 1e-300]]
    refused(
        lambda: ms.ControlTask(np.eye(2), np.eye(2), np.eye(2), Q, np.eye(2), 2),
        "Q: expected a positive semidefinite matrix, found smallest eigenvalue -inf",
    )


def test_what_numpy_would_warn_of_or_forget_is_refused():
    row = np.ma.masked_array([1.0, 2.0], [False, True])
    for hidden in ([row, row], [[1.0, 2.0], [3.0, np.ma.masked]]):  # NumPy drops masks in a list
        refused(lambda: ms.check_array("mean", hidden, "H p", (None, None)), "mean: expected all")  # noqa: B023
    far = np.array(["1e4000"], dtype=np.longdouble)
    refused(lambda: ms.check_array("mean", far, "H", (None,)), "mean: expected finite numbers")
    one = ["a"], [0], [1.0], [1e300]
    refused(lambda: perception.Residuals(*one, period=1e-300), "residual: expected finite numbers")


def test_lists_are_no_numbers():
    for bad, found in (([1.0], "(1,)"), ([[1.0, 2.0]], "(1, 2)"), ([], "(0,)")):
        line = f"alpha: expected a number, found shape {found}"
        refused(lambda: dataclasses.replace(problem(), alpha=bad), line)  # noqa: B023


def test_a_choice_that_is_none_is_shown_with_its_place():
    start = "choices: expected integers from 0 to 2, found "
    refused(lambda: problem().total_cost([0, 1, 5, 2]), start + "5 at step 2")
    refused(lambda: problem().total_cost([[0, 1, 0, 2], [0, 0.5, 0, 0]]), start + "0.5 at [1, 1]")


@pytest.mark.parametrize("way", [pickle.dumps, copy.copy, copy.deepcopy, None])
@pytest.mark.parametrize("make", [point, lambda: ms.error_cost(problem())])
def test_arrays_of_results_that_solvers_take_cannot_be_written_to(make, way):
    result = made = make()
    if way:
        made = pickle.loads(way(result)) if way is pickle.dumps else way(result)
    first, value = next((name, x) for name, x in vars(made).items() if isinstance(x, np.ndarray))
    for one in (made, dataclasses.replace(made, **{first: value.copy()})):
        arrays = [value for value in numbers(one) if value.ndim]
        assert len(arrays) >= 2
        for array in arrays:
            with pytest.raises(ValueError, match="WRITEABLE"):
                array.flags.writeable = True
    for one, other in zip(numbers(result), numbers(made), strict=True):
        np.testing.assert_array_equal(one, other)


def test_a_value_is_shown_on_one_line_of_at_most_80_characters():
    assert ms.shown(np.zeros((2, 2))) == "array([[0., 0.], [0., 0.]])"
    assert ms.shown("x" * 78) == "'" + "x" * 78 + "'"
    assert ms.shown("x" * 79) == "'" + "x" * 76 + "..."


def test_large_integers_keep_their_last_digit():
    assert ms.check_count("seed", 2**53 + 1) == 2**53 + 1
    assert Settings(seed=2**53 + 1).seed == 2**53 + 1
    assert ms.check_count("seed", np.uint64(2**64 - 1)) == 2**64 - 1
    seed = 12345678901234567890123456
    assert Settings(seed=seed).seed == ms.check_count("seed", seed, top=np.inf) == seed
    refused(lambda: Settings(trials=seed), f"trials: expected an integer >= 1 and <= {2**64 - 1}")


def test_a_run_takes_settings_and_networks_and_nothing_else():
    refused(lambda: landing.run_experiment(trained=5), "trained: expected Trained, found 5")
    refused(lambda: landing.run_experiment({}), "settings: expected Settings, found {}")


def test_a_mask_is_no_list_of_models():
    refused(lambda: suite().pick([True, False]), "models: expected names")
    refused(lambda: suite().pick(np.array([True, False, True])), "models: expected names")


def test_a_suite_of_one_model_has_no_price():
    refused(lambda: landing.cost_scale(PSI, suite().pick(["a"])), "suite: expected 2 or more")


@pytest.mark.parametrize(
    "call", [lambda: landing.model_cost([], "linear"), lambda: perception.measure_models([], 1, 0)]
)
def test_no_networks_cannot_be_measured(call):
    refused(call, "networks: expected one or more")


def test_a_square_or_doubly_readable_array_given_transposed_is_not_caught_and_the_text_says_so():
    turned = ms.ControlTask(A.T, B, C, np.diag([1.0, 2, 0]), R, H)
    assert not np.allclose(ms.psi(turned), ms.psi(task()))
    assert "square array given transposed" in ms.ControlTask.__doc__
    mean = numbered(H, 2, 1)
    ms.SelectionProblem(np.eye(H), mean.T, mean.T**2, [0, 1])  # one step of H components
    assert "given transposed" in ms.SelectionProblem.__doc__


def test_a_network_has_a_smallest_and_a_largest_picture():
    refused(lambda: perception.new_network((7, 1, 1), np.random.default_rng(0)), "shape: expected")
    for size, words in ((24, "pictures: expected smaller"), (6, "pictures: expected larger")):
        refused(lambda: perception.forward(layers(), np.ones((2, size, size))), words)  # noqa: B023


def test_schedules_of_trials_are_as_many_as_the_trials():
    aircraft, errors = landing.preset("textbook", H), numbered(2, H, W, 1)
    s = numbered(2, H, 1)
    refused(
        lambda: landing.fly(aircraft, "preview", s, errors, np.zeros((3, H))),
        "choices: expected shape (2, 4) or (4,), found (3, 4)",
    )
