"""What is said, whole: refusals, warnings, tables, help and figures, word by word.

Other tests ask for the word that matters to them; here no other word can go astray unseen.  Where a
text was meant to change, it changes here, too.
"""

import inspect
import types
import warnings
from dataclasses import replace
from functools import cache
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import pytest

import landing
import modelselect as ms
import perception
from landing import Settings, run_experiment
from modelselect_parts import figures, measured, options, tables
from modelselect_parts.pooling import Labelled, bootstrapped, labelled
from perception import Kernel, PerceptionSuite, Residuals, fit_suite

# ------------------------------------------------------------------------------------- refusals

RNG = np.random.default_rng(0)
MEAN = np.zeros((2, 3, 1))
SUITE = PerceptionSuite(["a", "b", "c"], MEAN, MEAN + 1, [0, 1, 2])
S = np.ones((9, 1))


def rows(residual, **changes):
    """Residuals of model a at altitudes 1, 2, 3, ..."""
    n = len(residual)
    fields = {"names": ["a"], "model": np.zeros(n, int), "altitude": np.arange(1.0, n + 1)}
    return Residuals(**fields | {"residual": residual} | changes)


def table(**columns):
    """What is asked of a table: names of columns, and columns by name."""

    class Table(dict):
        columns = property(list)

    return Table(columns)


FOUR = rows([1.0, 2, 4, 7])
TWO_WAYS = rows([1.0, 2, 4, 7], altitude=np.ones((4, 2)), variables=["range", "bearing"])
EVERY = Residuals(["a", "b"], [0, 0, 1, 1], [1, 2, 1, 2], [1, 2, 3, 4])


def fitted(residuals=FOUR, way=(1.0,), cost=(1,), **how):
    return fit_suite(residuals, way, cost, **how)


def near(residuals=FOUR, width=9.0, way=(1.0,), **how):
    return fit_suite(residuals, way, [1], kernel=Kernel(width, **how))


def pictures(group, error=((1.0, 2, 3),)):
    h = np.arange(3.0)
    return Labelled(h, np.array(error), np.array(group), h)


def network():
    return perception.new_network((8, 1, 1), RNG)


@cache
def run(horizon=2, information="causal"):
    return run_experiment(Settings("simulated", "textbook", information, horizon, trials=1))


REFUSED = {
    # ---- suites
    "models: expected names among a, b, c, or indices, found 'd'": lambda: SUITE.pick(["d"]),
    "models: expected different names among a, b, c, or indices, found ['a', 0]": lambda: (
        SUITE.pick(["a", 0])
    ),
    "fallback: expected (mean, variance), found (1, 2, 3)": lambda: perception.with_dropouts(
        SUITE, 0.5, (1, 2, 3)
    ),
    "cost: expected one for each of a, b, found {'a': 1}": lambda: fitted(EVERY, cost={"a": 1}),
    "cost: expected numbers, or all (H,), found {'a': [1, 2], 'b': [1, 2, 3]}": lambda: fitted(
        EVERY, cost={"a": [1, 2], "b": [1, 2, 3]}
    ),
    "cost: expected a finite cost at every step, found none at step 0": lambda: PerceptionSuite(
        ["a", "b", "c"], MEAN, MEAN, [np.inf] * 3
    ),
    "mean: expected shape (H, W, p) = (H, 2, p) (W = 2 as of names), found (2, 3, 1)": lambda: (
        PerceptionSuite(["a", "b"], MEAN, MEAN, [0, 1])
    ),
    "variance: expected shape (H, W, p, p) = (2, 3, 1, 1), found (3, 3, 1, 1)": lambda: replace(
        SUITE, variance=np.ones((3, 3, 1, 1))
    ),
    "cost: expected shape (H, W) = (2, 3), found (3, 3)": lambda: replace(SUITE, cost=np.eye(3)),
    "variance: expected finite numbers, found inf at step 0, model 0, component 0": lambda: (
        perception.with_dropouts(SUITE, 0.5, ([1e200], [1]))
    ),
    "mean: expected finite numbers, found -inf at step 0, model 0, component 0": lambda: (
        perception.with_latency(SUITE, 1e200, [1], [1e200])
    ),
    "delay: expected shape (H, W) = (2, 3), found (3, 3)": lambda: perception.with_latency(
        SUITE, np.eye(3), [1]
    ),
    "variance: expected shape (H, p, p) = (2, 1, 1), found (2, 2, 2)": lambda: (
        perception.with_latency(SUITE, 1, np.ones((2, 2, 2)))
    ),
    "variance: expected shape (H, p) = (2, 1), found (1, 1)": lambda: perception.with_latency(
        SUITE, 1, S[:1]
    ),
    "fallback.mean: expected shape (H, p) = (2, 1), found (1, 1)": lambda: perception.with_dropouts(
        SUITE, 0.5, (S[:1], [1])
    ),
    "fallback.variance: expected shape (H, p) = (2, 1), found (1, 1)": lambda: (
        perception.with_dropouts(SUITE, 0.5, ([1], S[:1]))
    ),
    "fallback.variance: expected shape (H, p, p) = (2, 1, 1), found (1, 1, 1)": lambda: (
        perception.with_dropouts(SUITE, 0.5, ([1], np.ones((1, 1, 1))))
    ),
    "drift: expected shape (H, p) = (2, 1), found (3, 1)": lambda: perception.with_latency(
        SUITE, 1, [1], S[:3]
    ),
    # ---- rows of residuals
    "residual: expected NaN in all components of a row or none, found some": lambda: rows(
        [[1.0, np.nan], [1, 2]]
    ),
    "components: expected names that begin with residual, and none of model and variables that do, "
    "found ['altitude', 'error']": lambda: rows([1.0], components=["error"]),
    "components: expected 1 names, found ('residual_x', 'residual_y')": lambda: rows(
        [1.0], components=["residual_x", "residual_y"]
    ),
    "resolution: expected numbers >= 0, found -1": lambda: rows([1.0], resolution=-1),
    "period: expected numbers > 0, found 0": lambda: rows([1.0], period=0),
    "residual: expected finite numbers, found -inf at [0]": lambda: rows([1e308], period=1e-300),
    "residuals: expected Residuals, or a table with the columns model,altitude,residual, found "
    "int": lambda: fitted(3),
    "residuals: expected Residuals, or a table with the columns model,altitude,residual, found "
    "'model,height'": lambda: fitted(table(model=[], height=[])),
    "residuals: expected a model in every row, found nan": lambda: fitted(
        table(model=[np.nan], x=[1.0], residual=[1.0])
    ),
    "x: expected shape (N,) = (1,), found (2,)": lambda: fitted(
        table(model=["a"], x=[1.0, 2], residual=[1.0])
    ),
    # ---- fits
    "residuals: expected 2 or more of a at altitudes 1 to 1.5, found 1; use fewer bins or measure "
    "more": lambda: fitted(bins=[1, 1.5]),
    "bins: expected increasing edges from 1 or less to 3 or more, found 2 edges from 2 to 9": (
        lambda: fitted(way=[1.0, 3], bins=[2, 9])
    ),
    "trajectory: expected several altitudes to make 10 bins of, found 1 at every step; state "
    "edges, such as bins=[low, high]": fitted,
    "residuals: expected different ones of a near step 0, found equal ones; measure more, or state "
    "the resolution they are rounded to": lambda: fitted(rows([1.0, 1]), bins=[0, 9]),
    "residuals: expected some errors, found looks that gave nothing only": lambda: fitted(
        rows([np.nan, np.nan]), bins=[0, 9]
    ),
    "cost: expected prices by name, {'a': ..., 'b': ...}, as only the file puts the models in this "
    "order, or read_residuals(path, names), found numbers": lambda: fitted(
        table(model=["a", "a", "b", "b"], x=[1.0, 2, 1, 2], residual=[1.0, 2, 3, 4]),
        cost=[1, 2],
        bins=[0, 9],
    ),
    "kernel: expected one for range, bearing, as bins hold one of them": lambda: fitted(
        TWO_WAYS, {"range": [1.0], "bearing": [1.0]}, bins=[0, 2]
    ),
    "trajectory: expected a dictionary from some of range, bearing to arrays, found (1.0,)": (
        lambda: fitted(TWO_WAYS)
    ),
    "trajectory: expected some of range, bearing, found none": lambda: fitted(TWO_WAYS, {}),
    "residuals: expected several values of range, found 1 only": lambda: near(
        TWO_WAYS, way={"range": [1.0]}
    ),
    "residuals: expected 2 or more of a near range 9, bearing 2, found 0 within the kernel; widen "
    "it or measure more": lambda: near(
        rows([1.0, 2, 4], altitude=[[1, 2], [2, 1], [3, 3]], variables=["range", "bearing"]),
        0.01,
        {"range": [9.0], "bearing": [2.0]},
    ),
    "kernel: expected altitude > 0 for a logarithm or a ratio, found -1": lambda: near(
        way=[-1.0], log=["altitude"]
    ),
    "kernel.log: expected one of altitude, found 'range'": lambda: near(log=["range"]),
    "kernel.relative: expected one of altitude, found 'range'": lambda: near(relative="range"),
    "width: expected a number > 0, found 0": lambda: Kernel(0),
    "residuals: expected 2 or more of a near step 0, found 1, as it mostly gave nothing there": (
        lambda: perception.bootstrap_errors(
            rows([1.0, np.nan, np.nan]), [1.0], 2, RNG, kernel=Kernel(1e6)
        )
    ),
    "altitude: expected 3 or more along the way, found 1": lambda: perception.altitude_bins(
        [0, 2, 9], [1, 3], 3
    ),
    "suite: expected one measured on 2 residuals or more, found another": lambda: (
        perception.guard_suite(SUITE)
    ),
    "suite: expected measured variances > 0, found 0: of how many digits?": lambda: (
        perception.guard_suite(
            PerceptionSuite(["a"], MEAN[:, :1], MEAN[:, :1], [1], [[9], [9]], MEAN[:, :1])
        )
    ),
    "level: expected a number from 0.5 to below 1, found 1": lambda: perception.guard_suite(
        fitted(bins=[0, 9]), 1
    ),
    # ---- files
    "sep: expected ',' with decimal='.', or ';' with ',', found sep='ab', decimal='.'": lambda: (
        perception.read_residuals("x.csv", sep="ab")
    ),
    "none.csv: cannot be read as a CSV file: [Errno 2] No such file or directory: 'none.csv'": (
        lambda: perception.read_residuals("none.csv")
    ),
    "path: expected one that can be written, found none/x.csv: No such file or directory": (
        lambda: perception.write_residuals("none/x.csv", FOUR)
    ),
    "path: expected a file of models, found 'none.npz': No such file or directory": lambda: (
        perception.load_models("none.npz", "key")
    ),
    # ---- networks and camera
    "networks: expected one or more of class Network, found []": lambda: perception.measure_models(
        [], 1, RNG
    ),
    "shape: expected pictures of 8 pixels or more a side, found 7": lambda: perception.new_network(
        (7, 1, 1), RNG
    ),
    "altitude: expected -2 to 135 ft, found 0 to 136": lambda: perception.photograph(
        perception.draw_scenes(2, RNG), [0, 136], 8, RNG
    ),
    "altitude: expected -2 to 135 ft, found 136 to 136": lambda: perception.train_network(
        network(), np.ones((1, 8, 8)), [136], 1, RNG
    ),
    "pictures: expected larger ones, found (1, 6, 6)": lambda: perception.forward(
        network().layers, np.ones((1, 6, 6))
    ),
    "pictures: expected smaller ones, found (1, 24, 24)": lambda: perception.forward(
        network().layers, np.ones((1, 24, 24))
    ),
    # ---- pictures that all models saw
    "measured: expected errors (N,) over one variable, found several columns": lambda: labelled(
        TWO_WAYS
    ),
    "measured: expected all models on the same pictures, one after the other": lambda: labelled(
        Residuals(["a", "b"], [0, 1, 0, 1], [1, 1, 2, 2], [1, 2, 3, 4])
    ),
    "measured: expected all models at the same altitudes, in the same order": lambda: labelled(
        Residuals(["a", "b"], [0, 0, 1, 1], [1, 2, 2, 1], [1, 2, 3, 4])
    ),
    "measured: expected pictures of 2 or more groups, found 1": lambda: bootstrapped(
        SUITE, pictures([0, 0, 0]), np.ones(2), RNG
    ),
    "measured: expected errors, found looks that gave nothing": lambda: bootstrapped(
        SUITE, pictures([0, 1, 2], [[np.nan, 2, 3]]), np.ones(2), RNG
    ),
    "measured: expected pictures from several altitudes, found one only": lambda: (
        landing.fit_landing(landing.preset("textbook", 2), rows([1.0, 2], altitude=[3, 3]), [1])
    ),
    # ---- landings
    "suite: expected 2 or more models to put a price on, found 1": lambda: landing.cost_scale(
        np.eye(2), SUITE.pick(["a"])
    ),
    "result: expected one of experiment trained, found no networks in use": lambda: (
        landing.report_pictures(run())
    ),
    "result: expected one of experiment measured, found simulated": lambda: landing.report_measured(
        run()
    ),
    "result: expected one with a front, found none": lambda: landing.plot_front(run()),
    "result: expected what `fly_stages` found in its flown, found nothing": lambda: (
        landing.plot_stages(run())
    ),
    "upsilon: the costs overflow, found 1e+308": lambda: run_experiment(Settings(upsilon=1e308)),
    "switch_cost: the costs overflow, found 1e+308": lambda: run_experiment(
        Settings(switch_cost=1e308)
    ),
    "--out: expected a writable folder, found none\0: embedded null byte": lambda: (
        landing.check_targets(Path("none\0"), None)
    ),
    "--json: expected a file in a writable folder, found .: not a file, or a folder of --out": (
        lambda: landing.check_targets(None, Path("."))
    ),
    "choices: expected shape (3, 2) or (2,), found (1, 2)": lambda: landing.fly(
        run().landing, "causal", np.zeros((3, 2, 1)), np.zeros((3, 2, 8, 1)), [[0, 0]]
    ),
    "residuals: expected a column view before residual, found altitude": lambda: measured.halves(
        FOUR, RNG
    ),
    "residuals: expected one number of each of 1 models on each of 2 or more views, found 1 views, "
    "and 4 on view 1": lambda: measured.halves(
        rows([1.0, 2, 4, 7], altitude=np.ones(4), variables=["view"]), RNG
    ),
    "residuals: expected every model once, at one altitude, on every view": lambda: measured.halves(
        Residuals(
            ["a", "b"],
            [0, 1, 0, 1],
            [[1, 5], [1, 6], [2, 5], [2, 6]],
            [1, 2, 3, 4],
            ["view", "altitude"],
        ),
        RNG,
    ),
}
#: A message and the settings that it refuses.
SETTINGS_REFUSED = {
    "preset: the cameras need textbook altitudes, found 'published'": {"experiment": "trained"},
    "cost: measured models cost their latency, found 'linear'": {
        "experiment": "measured",
        "preset": "textbook",
    },
    "residuals: used by experiment measured, found 'simulated'": {"residuals": "x.csv"},
    "cost: simulated models have linear cost or latency, found 'counted'": {"cost": "counted"},
    "calibrate: expected True or False, found 1": {"calibrate": 1},
    "calibrate: of experiment trained, found 'simulated'": {"calibrate": True},
    "rounds: of experiment trained, found 'simulated'": {"rounds": 1},
    "fit: of experiment trained, found 'simulated'": {"fit": "bins"},
    "rounds: a flight has no forecast, found 'preview'": {
        **{"experiment": "trained", "preset": "textbook", "cost": "counted"},
        **{"information": "preview", "rounds": 1},
    },
}
REFUSED |= {
    message: lambda settings=settings: Settings(**settings)
    for message, settings in SETTINGS_REFUSED.items()
}


def problem(**changes):
    """Two steps, three models."""
    fields = {"psi": np.eye(2), "mean": MEAN + 1, "variance": MEAN + 1, "model_cost": [0, 1, 2]}
    return ms.SelectionProblem(**fields | changes)


def task(**changes):
    return ms.ControlTask(**{key: [[1.0]] for key in "ABCQR"} | {"horizon": 2} | changes)


def plant(**changes):
    fields = {"A": np.eye(1), "B": np.eye(1), "dt": 0.5} | changes
    return types.SimpleNamespace(**fields)


WEIGHTS = [[1.0]], [[1.0]], [[1.0]], 2
EVEN = np.full((2, 3), 1 / 3)
COUPLED = np.array([[2.0, 1], [1, 2]])
SYSTEM = ms.sensitivity(task(), "preview")
DOCUMENT = '{"format": "modelselect.Schedule", "version": 1}'
REFUSED |= {
    # ---- solvers
    "reference: the bound overflows; take a point among the mean errors": lambda: (
        ms.reference_bound(problem(), [1e300, 1e300])
    ),
    "schedule.cost: expected 4.0, found 9.0": lambda: ms.check_certificate(
        problem(), replace(ms.solve(problem()), cost=9.0)
    ),
    "schedule.choices: expected available models within the budget": lambda: ms.check_certificate(
        problem(budget=1.0), replace(ms.solve(problem()), choices=[2, 2])
    ),
    "problem: expected at most 8 schedules, found 3^2": lambda: ms.enumerate_schedules(
        problem(), max_schedules=8
    ),
    "problem: expected at most 1 labels, found 3^2": lambda: ms.plain_dynamic_program(
        problem(psi=COUPLED), max_labels=1
    ),
    "problem: expected uncoupled steps, found a mean error that Psi couples": lambda: (
        ms.solve_separable(problem(psi=COUPLED))
    ),
    "relaxation.weights: expected rows >= 0 that sum to 1, and 0 where a model is not available, "
    "found others": lambda: ms.round_and_swap(
        problem(model_cost=[0, np.inf, 2]), replace(ms.relax(problem()), weights=EVEN)
    ),
    "problem: expected no switching costs, no budget; use relax_by_columns": lambda: ms.relax(
        problem(budget=9.0)
    ),
    "allowed: expected True and False only": lambda: ms.relax_interior_point(
        problem(), allowed=EVEN
    ),
    "allowed: expected an available model in every row, found none": lambda: (
        ms.relax_interior_point(problem(), allowed=0 * EVEN)
    ),
    "problem: expected no budget, which blends do not have, found one": lambda: ms.BlendProblem(
        problem(budget=9.0)
    ),
    "worst: expected an available model of 3, found 3": lambda: ms.BlendProblem(problem(), worst=3),
    "blend: the cost overflows; expected numbers from 0 to 1": lambda: ms.BlendProblem(
        problem(mean=MEAN + np.arange(3)[:, None])
    ).total_cost([1e300, 0]),
    # ---- problems
    "covariance: expected shape (H, W, p, H, W, p) = (2, 3, 1, 2, 3, 1), found (2, 2)": lambda: (
        ms.correlated_problem(problem(), np.eye(2))
    ),
    "correlation: expected 1 on the diagonal d, found 2.0; divide by "
    "np.sqrt(np.outer(d, d))": lambda: ms.persistent_bias(
        np.ones((3, 1)), np.ones((2, 3, 1)), correlation=2 * np.eye(3)
    ),
    "correlation: expected a positive semidefinite matrix, found smallest eigenvalue -1 (of the "
    "matrix scaled to unit diagonal)": lambda: ms.persistent_bias(
        np.ones((2, 1)), np.ones((2, 2, 1)), correlation=[[1, 2], [2, 1]]
    ),
    "problem: the lifted Psi overflows; rescale psi or the mean errors": lambda: (
        ms.correlated_problem(
            problem(psi=1e200 * np.eye(2), mean=MEAN + 1e160 * np.eye(3)[:, :1], alpha=0),
            np.zeros((2, 3, 2, 3)),
        )
    ),
    "integers: expected a sum of at most 1e7, found 10000001": lambda: ms.partition_problem(
        [10_000_000, 1]
    ),
    "adjacency: expected a symmetric matrix of 0 and 1 without loops, found others": lambda: (
        ms.maximum_cut_problem(np.eye(2))
    ),
    "model_cost: expected numbers above -inf, found -inf": lambda: problem(
        model_cost=[0, -np.inf, 2]
    ),
    "model_cost: expected an available model at every step, found none at step 1": lambda: problem(
        model_cost=[[0, 1, 2], [np.inf] * 3]
    ),
    "psi: the costs overflow; rescale psi, mean, variance, the prices, alpha or beta": lambda: (
        problem(model_cost=[0, 1, 1e300], beta=1e10)
    ),
    "problem: the error cost overflows; rescale psi or the mean errors": lambda: ms.error_cost(
        problem(psi=1e200 * np.eye(2), mean=MEAN + 1e160 * np.eye(3)[:, :1], alpha=0)
    ),
    "variance: expected shape (H, W, p, p) = (2, 3, 1, 1), found (2, 3, 2, 2)": lambda: problem(
        variance=np.ones((2, 3, 2, 2))
    ),
    "model_cost: expected shape (H, W) = (2, 3), found (3, 3)": lambda: problem(
        model_cost=np.ones((3, 3))
    ),
    "suite: expected PerceptionSuite, found int": lambda: ms.SelectionProblem.from_suite(
        np.eye(2), 3
    ),
    "choices: expected available models, found one that is not": lambda: problem(
        model_cost=[0, np.inf, 2]
    ).exact_cost([1, 0]),
    "switch_cost: expected 0 on the diagonal, found others": lambda: problem(
        switch_cost=np.ones((3, 3))
    ),
    "initial_model: expected one of 3 models, found 3": lambda: problem(initial_model=3),
    "budget: expected one of at least 2.0, which one schedule needs, found 1.0": lambda: problem(
        model_cost=[1, 2, 3], budget=1.0
    ),
    "weights: expected a single 1 and otherwise 0 in every row": lambda: ms.from_one_hot(EVEN),
    "choices: expected integers >= 0, found others": lambda: replace(
        ms.solve(problem()), choices=[0.5, 0]
    ),
    # ---- control
    "gains: required by 'filter' (see kalman_gains), found None": lambda: ms.psi(task(), "filter"),
    "gains: expected shape (H, n, p) = (2, 1, 1), found (3, 1, 1)": lambda: ms.psi(
        task(), "filter", gains=np.ones((3, 1, 1))
    ),
    "gains: used only by 'filter', found with 'causal'": lambda: ms.psi(
        task(), "causal", gains=[[0.5]]
    ),
    "prior_mean: used only by 'causal', found with 'preview'": lambda: ms.run_controller(
        task(), [1.0], S[:2], S[:2], "preview", S[:2]
    ),
    "s_hat: expected the shape of s, (2, 1), found (3, 2, 1)": lambda: ms.run_controller(
        task(), [1.0], S[:2], np.ones((3, 2, 1)), "preview"
    ),
    "A: expected shape (H, n, n) = (2, 1, 1), found (3, 1, 1)": lambda: task(A=np.ones((3, 1, 1))),
    "reference: expected shape (H+1, n) = (3, 1), found (2, 1)": lambda: ms.run_controller(
        task(), [1.0], S[:2], S[:2], "preview", reference=S[:2]
    ),
    "process_noise: expected shape (H, n, n) = (2, 1, 1), found (3, 1, 1)": lambda: ms.kalman_gains(
        task(), np.ones((3, 1, 1)), [[1]]
    ),
    "measurement_noise: expected shape (H, p, p) = (2, 1, 1), found (3, 1, 1)": lambda: (
        ms.kalman_gains(task(), [[1]], np.ones((3, 1, 1)))
    ),
    "task: Psi overflows; rescale the costs or C, or shorten the horizon": lambda: ms.sensitivity(
        task(C=[[1e155]]), "preview"
    ),
    "information: 'open_loop' believes what it foresaw earlier; use psi": lambda: ms.sensitivity(
        task(), "open_loop"
    ),
    "errors: expected shape (pH,) = (2,), found (9, 1)": lambda: SYSTEM @ S,
    "dt: expected a step in which the plant stays finite, found 1.0": lambda: (
        ms.ControlTask.from_statespace(plant(A=[[1e5]], dt=0), *WEIGHTS, dt=1.0)
    ),
    "C: expected shape (n, p) = (1, p) (n = 1 as of A), found (2, 1)": lambda: (
        ms.ControlTask.from_statespace(plant(dt=0), S[:2], *WEIGHTS[1:], dt=1.0)
    ),
    "system: expected a StateSpace with A, B and dt, found int": lambda: (
        ms.ControlTask.from_statespace(3, *WEIGHTS)
    ),
    "system.A: expected shape (n, n) = (3, 3), found (2, 3)": lambda: (
        ms.ControlTask.from_statespace(plant(A=np.ones((2, 3))), *WEIGHTS)
    ),
    "system.B: expected shape (n, m) = (1, m), found (2, 1)": lambda: (
        ms.ControlTask.from_statespace(plant(B=np.ones((2, 1))), *WEIGHTS)
    ),
    "own: expected shape (H, q, p) = (H, q, p), found (3,); did you mean np.reshape(own, (3, 1, "
    "1))?": lambda: replace(SYSTEM, own=S[:3, 0]),
    "push: expected shape (H, n, p) = (2, n, 1), found (2, 3, 2)": lambda: replace(
        SYSTEM, push=np.ones((2, 3, 2))
    ),
    "read: expected shape (H, q, n) = (2, 1, 1), found (2, 1, 2)": lambda: replace(
        SYSTEM, read=np.ones((2, 1, 2))
    ),
    "carry: expected shape (H, n, n) = (2, 1, 1), found (1, 1)": lambda: replace(
        SYSTEM, carry=np.ones((1, 1))
    ),
    "carry: expected [read; carry] of orthonormal columns, found others": lambda: replace(
        SYSTEM, carry=9 * SYSTEM.carry
    ),
    "system: expected one with a time base, found dt = None": lambda: (
        ms.ControlTask.from_statespace(plant(dt=None), *WEIGHTS)
    ),
    "dt: expected a step > 0 for a continuous system, found None": lambda: (
        ms.ControlTask.from_statespace(plant(dt=0), *WEIGHTS)
    ),
    "dt: expected that of the discrete system, 0.5, found 0.25": lambda: (
        ms.ControlTask.from_statespace(plant(), *WEIGHTS, dt=0.25)
    ),
    "N: expected [[Q, N], [N', R]] positive semidefinite, found smallest eigenvalue -1 (of "
    "the matrix scaled to unit diagonal)": (lambda: task(N=[[2.0]])),
    "Q_final: required when Q varies with time, found None": lambda: task(Q=np.ones((2, 1, 1))),
    "controls: expected the leading axes of states, (4,), found (3,)": lambda: ms.control_cost(
        task(), np.ones((4, 3, 1)), np.ones((3, 2, 1))
    ),
    "states: the cost overflows, or that of controls does; rescale": lambda: ms.control_cost(
        task(), np.full((3, 1), 1e300), np.ones((2, 1))
    ),
    # ---- files
    "text: expected strict JSON, found NaN": lambda: ms.Schedule.from_json("[NaN]"),
    "format: expected modelselect.Schedule, found [1]": lambda: ms.Schedule.from_json("[1]"),
    "version: expected 1, found 2": lambda: ms.Schedule.from_json(DOCUMENT.replace("1}", "2}")),
    "choices: expected one": lambda: ms.Schedule.from_json(DOCUMENT),
    "extra: expected no such field": lambda: ms.Schedule.from_json(
        ms.solve(problem()).to_json().replace("{", '{"extra": 1, ', 1)
    ),
    "text: expected every field once, found ['a', 'a']": lambda: ms.Schedule.from_json(
        '{"a": 1, "a": 2}'
    ),
}


@pytest.mark.parametrize("message", REFUSED)
def test_a_refusal_says_what_was_expected_and_found(message, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ValueError) as caught:
        REFUSED[message]()
    assert str(caught.value) == message


# ------------------------------------------------------------------------------------- warnings


def turned(**changes):
    """Errors of angles, some of them a full turn off."""
    return rows([1.0, -2, 359, 358, 361, 0], **changes)


TASK = ms.ControlTask([[1.0]], [[1.0]], [[1.0]], [[1.0]], [[1.0]], len(S))


def states():
    """States of a robot that nothing pushes."""
    return ms.run_controller(TASK, [1.0], 0 * S, 0 * S, "filter", gains=[[0.5]])[0][:-1]


WARNED = {
    "fit_suite: 2 of 5 residuals count along this trajectory (altitude from 1 to 5, on the way "
    "from 1 to 2.5): are both in one unit?": lambda: fit_suite(
        rows([1.0, 2, 4, 7, 9]), [1.0, 2.5], [1], bins=1
    ),
    "fit_suite: errors lie around 0 and around 360: of angles, state the period (see Residuals)": (
        lambda: fit_suite(turned(), [1.0], [1], bins=[0, 9])
    ),
    "fit_suite: errors of a near step 0 reach half a period, where nobody can tell them from "
    "errors of the other sign": lambda: fit_suite(
        rows([170.0, 175, 190], period=360), [1.0], [1], bins=[0, 9]
    ),
    "residuals: 1 of 3 rows repeat an earlier one to the last digit: were they logged twice?  If "
    "residuals are rounded, state their resolution": lambda: fit_suite(
        table(model=["a", "a", "a"], x=[1.0, 1, 2], residual=[1.0, 1, 2]), [1], [1], bins=[0, 9]
    ),
    "twice.csv: 1 of 2 rows repeat an earlier one to the last digit: were they logged twice?  If "
    "residuals are rounded, state their resolution": lambda: perception.read_residuals("twice.csv"),
    "pareto_front: not proved from perception inf down to 0": lambda: ms.pareto_front(
        run(30, "open_loop").problem, time_limit=0
    ),
    "s: expected an unknown push C s of mean zero, found what the models measure of the state, "
    "which then pushes it; for perfect perception give s = 0 and s_hat = 0": lambda: (
        ms.run_controller(TASK, [1.0], states(), states(), "filter", gains=[[0.5]])
    ),
    "suite: looks that gave nothing are left out; see with_dropouts": lambda: (
        ms.SelectionProblem.from_suite(np.eye(2), replace(SUITE, miss_rate=np.ones((2, 3)) / 2))
    ),
}


@pytest.mark.parametrize("message", WARNED)
def test_a_warning_says_what_is_odd_and_points_at_the_line_that_called(
    message, tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    Path("twice.csv").write_text("model,altitude,residual\na,1,2\na,1,2\n")
    found = []

    def warn(said, stacklevel=1):
        stack = inspect.stack()[1:]
        ours = [f for f in stack if "trampoline" not in f.filename]  # by which mutmut calls all
        found.append((said, ours[stacklevel - 1].filename, ours[stacklevel - 1].function))

    monkeypatch.setattr(warnings, "warn", warn)
    WARNED[message]()
    assert found == [(message, __file__, "<lambda>")]


#: What is just not odd enough.
FINE = {
    "half of the rows count": lambda: fit_suite(FOUR, [1.0, 2], [1], bins=1),
    "who hovers sees few": lambda: fitted(rows([1.0, 2, 4, 7, 9]), bins=[0, 2]),
    "two errors of a turn": lambda: fitted(rows([1.0, -2, 359, 358, 0]), bins=[0, 9]),
    "all near a turn": lambda: fitted(rows([359.0, 358, 361, 362]), bins=[0, 9]),
    "all of a component near a turn": lambda: fitted(
        rows([[359.0, 1], [358, 3], [361, -1], [362, 0]]), bins=[0, 9]
    ),
    "a tenth of a turn off": lambda: fitted(rows([1.0, 36, 359, 358, 361]), bins=[0, 9]),
    "just half a period": lambda: fitted(rows([60.0, 100, 140], period=360), bins=[0, 9]),
    "rounded alike": lambda: perception.read_residuals("twice.csv", resolution=0.1),
}


@pytest.mark.parametrize("what", FINE)
def test_what_is_not_odd_raises_no_warning(what, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("twice.csv").write_text("model,altitude,residual\na,1,2\na,1,2\n")
    with warnings.catch_warnings(record=True) as found:
        warnings.simplefilter("always")
        FINE[what]()
    assert not found


# --------------------------------------------------------------------------------------- tables

ROWS = ["Optimal", "Oracle", "Random", "Greedy"]
NAN = np.nan
POLICIES = np.array(
    [  # control cost, perception cost, reward, what Optimal gains: mean, half of its interval
        [(4000, 100), (500, 0), (-3300, 90), (0, 0)],
        [(2500, NAN), (0, 0), (-2000, NAN), (-1300, NAN)],
        [(9000, 100), (1000, 0), (-7400, 90), (4100, 80)],
        [(4100, 100), (500, 0), (-3400, 90), (100, 200)],
    ]
)
WAYS = np.array([[(0, 1), (2, 3), (4, 5)], [(0, 10), (20, 30), (40, 50)]])
GAINS = np.array([[(0, 0), (0, 0)], [(3, 1), (2, 4)]])
CAME = np.array([[(NAN, NAN), (7, 1), (8, 2)], [(4, 0.5), (7, 1), (8.25, NAN)]])
LEADS = [{"Greedy": (0.25, 0.1)}, {"Greedy": (0.1, 0.25)}]
LOST = {"Optimal": np.array([1.0, 3]), "Greedy": np.array([2.0, 5]), "Random": np.array([30.0, 50])}
POINTS = np.array([[0, 5], [1.5, 4], [12345.67, 1]]), np.array([True, False, True])
#: The text of a table, and the table: its numbers are chosen to be told apart.
TABLES = [
    (
        """
        Means of 5 trials ± 95% t-intervals, in units of 1e+03; perception costs are w * Upsilon
                         control cost        perception cost                 reward          Optimal gains
        Optimal            4.000 ± 0.100          0.500                 -3.300 ± 0.090          0.000
        Oracle             2.500 ± -              0.000                 -2.000 ± -             -1.300 ± -
        Random             9.000 ± 0.100          1.000                 -7.400 ± 0.090          4.100 ± 0.080
          published        9.500                  1.200                 -7.800
        Greedy             4.100 ± 0.100          0.500                 -3.400 ± 0.090          0.100 ± 0.200
        Oracle (no error) and Clairvoyant (knows all errors beforehand) are infeasible.
        Optimal gains: its reward less that of the policy, in the same trials.
        Undecided (a single trial): Oracle, Greedy.
        """,  # noqa: E501
        lambda: tables.table_of_policies(
            ROWS, POLICIES, {"Random": np.array([9500.0, 1200, -7800])}, 5, "w * Upsilon"
        ),
    ),
    (
        """
        Means of 5 trials ± 95% t-intervals, in units of 1e+03; perception costs are median ms
                         control cost        perception (ms)                 reward          Optimal gains
        Optimal            4.000 ± 0.100        500.000                 -3.300 ± 0.090          0.000
        Random             9.000 ± 0.100       1000.000                 -7.400 ± 0.090          4.100 ± 0.080
        Oracle (no error) and Clairvoyant (knows all errors beforehand) are infeasible.
        Optimal gains: its reward less that of the policy, in the same trials.
        """,  # noqa: E501
        lambda: tables.table_of_policies(ROWS[::2], POLICIES[::2], {}, 5, "median ms", "ms"),
    ),
    (
        """
        Its steps: a 2, b 0, c 2.
        The next larger model has the smaller |mean error| in 75.0%, the smaller variance in 100.0% of cases.
        """,  # noqa: E501
        lambda: tables.table_of_models(
            ["a", "b", "c"],
            np.array([0, 2, 2, 0]),
            np.array([[3.0, 2, -2], [1, -3, 0]]),
            np.array([[3.0, 2, 1], [1, 1, 0]]),
        ),
    ),
    (
        """
        Pareto points: 3 proved, 2 of them corners, which weights alpha : beta reach.
        Open: not proved; this is of what is above.
        The best corner costs control up to 25% more, within a budget of 1.5 ms.
        """,
        lambda: tables.table_of_front((*POINTS, np.array([0, 0.25, 0]), "not proved"), " ms"),
    ),
    (
        "Pareto points: 0 proved, 0 of them corners, which weights alpha : beta reach.",
        lambda: tables.table_of_front((np.empty((0, 2)), np.zeros(0, bool), np.empty(0), "")),
    ),
    (
        """
        Held-out errors (ft): parameters, multiply-adds, root mean square ± 95%, by altitude
                                                           to 0     to 5
        b0     1,234     56,789     1.23 ± 0.06            1.00     2.00
        b1    12,345  1,234,567    10.50 ± 1.00            3.00     4.00
        """,
        lambda: tables.table_of_errors(
            ["b0", "b1"],
            np.array([[1234, 56789], [12345, 1234567]]),
            np.array([[1.234, 0.056], [10.5, 1]]),
            np.array([-2.0, 0, 5]),
            np.array([[1.0, 2], [3, 4]]),
        ),
    ),
    (
        """
        Regret under causal, where the drone acts on what it sees as it lands
                              predicted    Gaussian errors          bootstrap  flown on pictures    perception cost      Optimal gains              flown
        Optimal                     1.2       0.0 ±    1.0       2.0 ±    3.0       4.0 ±    5.0              100.0
        Greedy                      7.5       0.0 ±   10.0      20.0 ±   30.0      40.0 ±   50.0               50.0       3.0 ±    1.0       2.0 ±    4.0
        Undecided when flown (0 is in the interval): Greedy.
        """,  # noqa: E501
        lambda: tables.table_of_regrets(
            "causal", ["Optimal", "Greedy"], np.array([[1.25, 100], [7.5, 50]]), WAYS, GAINS
        ),
    ),
    (
        """
        Regret under causal, where the drone acts on what it sees as it lands
                              predicted    Gaussian errors          bootstrap  flown on pictures    perception (ms)      Optimal gains              flown
        Optimal                     1.2       0.0 ±    1.0       2.0 ±    3.0       4.0 ±    5.0              100.0
        """,  # noqa: E501
        lambda: tables.table_of_regrets(
            "causal", ["Optimal"], np.array([[1.25, 100]]), WAYS[:1], GAINS[:1], "ms"
        ),
    ),
    (
        """
        Total cost of schedules fitted on n residuals, judged on 2000 new pictures:
            n      beyond the optimum        with guard_suite  (mean ± 95%, 40 draws)
           50          10.00 ±  2.00%          30.00 ±  4.00%
         1000           1.00 ±  0.20%           3.00 ±  0.50%
        """,
        lambda: tables.table_of_sizes(
            [50, 1000],
            np.array([[(0.1, 0.02), (0.3, 0.04)], [(0.01, 0.002), (0.03, 0.005)]]),
            40,
            2000,
        ),
    ),
    (
        """
        Optimal at every stage, flown on pictures in 9 trials, the same for all
                                    promised               by labels            flown regret             flown total         below Greedy, %
        kernel                           5.0                       -               7.0 ± 1.0               8.0 ± 2.0             25.0 ± 10.0
        round 1                          6.0               4.0 ± 0.5               7.0 ± 1.0                 8.2 ± -            10.0 ± 25.0?
        ? undecided: 0 is in the interval, or it is one of a single trial.
        """,  # noqa: E501
        lambda: tables.table_of_stages(["kernel", "round 1"], np.array([5.0, 6]), CAME, LEADS, 9),
    ),
    (
        """
        Optimal at every stage, flown on pictures in 9 trials, the same for all
                                    promised               by labels            flown regret             flown total         below Greedy, %
        kernel                           5.0                       -               7.0 ± 1.0               8.0 ± 2.0             25.0 ± 10.0
        """,  # noqa: E501
        lambda: tables.table_of_stages(["kernel"], np.array([5.0]), CAME[:1], LEADS[:1], 9),
    ),
    (
        """
        2 flights each on views that no fit has seen; means
                               promised regret              flown regret               flown total  Optimal lies below by, %
        Optimal                            1.5                         2                        20
        Greedy                               2                       3.5                        35             25.0 ± 30.0 undecided
        Random                              20                        40                       400             90.0 ± 10.0
        """,  # noqa: E501
        lambda: tables.table_of_measured(
            {"Optimal": 1.5, "Greedy": 2.0, "Random": 20.0},
            LOST,
            {policy: 10 * lost for policy, lost in LOST.items()},
            {"Greedy": (0.25, 0.3), "Random": (0.9, 0.1)},
        ),
    ),
]


@pytest.mark.parametrize(("text", "table"), TABLES)
def test_a_table_has_these_heads_and_columns(text, table):
    assert "\n".join(table()) == inspect.cleandoc(text)


def test_percentages_are_a_table_with_names():
    means = {"this run": {"New": np.array([3.0, 2]), "Old": np.array([-2.0, 0])}, "log": {}}
    found = tables.table_of_percentages(
        [("control_cost", "New", "Old", "more"), ("reward", "New", "Old", "")],
        ["control_cost", "reward"],
        means,
    )
    assert tables.as_csv(found) == (
        "quantity,new,old,formula,this run,log,what the paper prints\n"
        "control cost,New,Old,100 (New - Old) / |Old|,250.0,,more\n"
        "reward,New,Old,100 (New - Old) / |Old|,,,\n"
    )


REPORT = [
    """
    Means of 4 trials ± 95% t-intervals, in units of 1e+00; perception costs are ms of EfficientNet on an i7-12700H, 5 ms a switch
    """,  # noqa: E501
    """
    Reward: -0.8 control cost - 0.2 * 0.01108 a ms of perception.

    Optimal: expected total 4.492183e+00 (less alpha J(u*)), lower bound 4.492183e+00,
    gap 0e+00, proved optimal by dynamic_program in 1.25 s.
    It spends 397.3 ms of a budget of 400 ms.
    Left out, as beyond the budget: All Large.
    Its steps: b0 0, b1 0, b2 6, b3 5, b4 1, b5 0, b6 0, b7 0.
    The next larger model has the smaller |mean error| in 97.6%, the smaller variance in 100.0% of cases.
    It switches 3 times.
    Pareto points: 84 proved, 20 of them corners, which weights alpha : beta reach.
    The best corner costs control up to 52% more, within a budget of 305.1 ms.
    """,  # noqa: E501
    """
    Reward: -0 control cost - 0 * 0 a ms of perception.

    Optimal: expected total 4.492183e+00 (less alpha J(u*)), lower bound 2.246091e+00,
    gap 5e-01, not proved optimal by dynamic_program in 1.25 s.
    Its steps: b0 0, b1 0, b2 6, b3 5, b4 1, b5 0, b6 0, b7 0.
    The next larger model has the smaller |mean error| in 97.6%, the smaller variance in 100.0% of cases.
    """,  # noqa: E501
]


def test_a_report_has_these_lines_around_its_table():
    limits = {"cost": "latency", "switch_cost": 5.0, "budget": 400.0}
    run = run_experiment(Settings("simulated", "textbook", "preview", 12, 4, **limits))
    best = replace(run.optimal, lower_bound=run.optimal.cost)
    run = replace(run, seconds=1.25, optimal=best, front=landing.whole_front(run.problem, 60))
    free = replace(run.settings, alpha=0.0, beta=0.0, switch_cost=0.0, budget=None)
    half = replace(best, lower_bound=best.cost / 2)
    text = landing.report(run)
    other = landing.report(replace(run, optimal=half, settings=free, front=None))
    heading, lines, open_lines = map(inspect.cleandoc, REPORT)
    assert text.startswith(heading + "\n") and text.endswith("\n" + lines)
    assert other.endswith("\n" + open_lines)


# --------------------------------------------------------------------------------- command line


def test_help_has_the_words_and_the_default_of_every_option(capsys):
    with pytest.raises(SystemExit):
        landing.main(["--help"])
    assert capsys.readouterr().out.startswith("Land an aircraft, choosing perception models.\n")
    defaults = vars(Settings()) | {"upsilon": "as the preset", "budget": "none"}
    for option in landing._parser()._actions[1:]:
        (flag,) = option.option_strings
        about = options.ABOUT[flag[2:] if flag[2:] in options.ABOUT else option.dest]
        switched = option.dest not in defaults or defaults[option.dest] is False
        told = switched or option.dest == "residuals"  # which say their default, if they have one
        assert option.help == (about if told else f"{about}; default: {defaults[option.dest]}")
    places = {
        option.dest: option.metavar for option in landing._parser()._actions if option.metavar
    }
    assert places == {"residuals": "FILE", "front": "SECONDS", "out": "FOLDER", "json": "FILE"}


# -------------------------------------------------------------------------------------- figures

PAIR = ["Optimal", "Greedy"]
PAID, CONTROL = np.array([[3.0, 0.5], [4, NAN]]), np.array([[40.0, 5], [50, 6]])
BETWEEN = np.array([[0.0, 5], [1, 4], [2, 1]])
STAGES = {
    "Optimal": np.array([[(1, 0.1), (2, 0.2)], [(3, 0.3), (4, NAN)]]),
    "Greedy": np.array([[(5, 0.1), (6, 0.2)], [(7, 0.3), (8, 0.4)]]),
}

#: A figure, its words in order, the scales of its axes, and the points of the lines in them.
FIGURES = [
    (
        lambda: figures.draw_schedule(
            np.array([0, 2, 1]), ["a", "b", "c"], np.array([1.0, 4, 2]), "A title", 0.5
        ),
        ["A title", "model", "step (of 0.5 s)", r"$\Psi_{tt}$"],
        ["linear linear"] * 2,
        [[[(0, 0), (1, 2), (2, 1)]] * 2, [[(0, 1), (1, 4), (2, 2)]]],
    ),
    (
        lambda: figures.draw_costs(PAIR, PAID, CONTROL, "an axis"),
        [*PAIR, "Lower left is better", "an axis", "control cost"],
        ["linear log"],
        [[[(3, 40)], [(4, 50)]]],
    ),
    (
        lambda: figures.draw_rewards(PAIR, PAID * [-1, 1]),
        ["Rewards (hollow: infeasible)", "minus reward (left is better)", "-4", "-3"],
        ["log linear"],
        [[[(4, 0)], [(3, 1)]]],
    ),
    (
        lambda: figures.draw_front(BETWEEN, 2, PAIR, CONTROL, "an axis"),
        [
            *("optimal at 3 $\\alpha:\\beta$\n(2 proved)", *PAIR),
            *("The best schedules found", "an axis", "extra control cost"),
        ],
        ["linear log"],
        [[BETWEEN, [(40, 5)], [(50, 6)]]],
    ),
    (
        lambda: figures.draw_all_points(
            BETWEEN,
            np.array([True, False, True]),
            np.array([0, 0.25, 0]),
            "something open",
            ["a", "b"],
            np.array([[0, 5.0], [2, 9]]),
            "an axis",
        ),
        [
            "2 corners: optimal\nat some $\\alpha:\\beta$",
            *("1 points between:\nby budgets only", "one model\nthroughout"),
            *("Weights reach 2 of 3 Pareto points\n(something open)", "extra control cost"),
            *("a", "b", "an axis", "weights\ndearer (%)"),
        ],
        ["linear log", "linear linear"],
        [[BETWEEN[::2], BETWEEN[1:2], [(0, 5), (2, 9)]], [[(0, 0), (1, 25), (2, 0)]]],
    ),
    (
        lambda: figures.draw_landings(
            np.arange(2), {"Oracle": np.array([[1.0, 2]]), "Optimal": np.array([[3.0, 4]])}, "ft"
        ),
        [
            "Mean and 90% band of trials; dotted: Oracle; note the scales",
            *("time (s)", "altitude (ft)", "Oracle", "Optimal"),
        ],
        ["linear linear"] * 2,
        [[[(0, 1), (1, 2)]] * 2, [[(0, 3), (1, 4)], [(0, 1), (1, 2)]]],
    ),
    (
        lambda: figures.draw_sensitivities(["p", "q"], {"p": np.array([[2.0, -1], [0, 1]])}),
        [
            *("p\n25% negative", "step $k$", "step $t$", "q\nnot available", "step $k$"),
            r"$|\Psi_{tk}|$ (white: 0)",
        ],
        ["linear linear"] * 2 + ["linear log"],
        [[], [], []],
    ),
    (
        lambda: figures.draw_published_models(
            ["a", "b"], np.array([1e9, 2e9]), np.array([1e6, 3e6]), np.array([70.0, 80])
        ),
        [
            *("operations per picture (billions)", "ImageNet top-1 accuracy (%)", "a", "b"),
            *("parameters (millions)", "a", "b"),
        ],
        ["log linear"] * 2,
        [[[(1, 70), (2, 80)]], [[(1, 70), (3, 80)]]],
    ),
    (
        lambda: figures.draw_gallery([np.zeros((2, 4, 4))] * 2, ["one", "two"], "a heading"),
        ["a heading", "one", "two"],
        ["linear linear"] * 4,
        [[]] * 4,
    ),
    (
        lambda: figures.draw_accuracy(["a", "b"], np.array([10, 100]), CONTROL),
        ["parameters", "root mean square error (ft)", "a", "b"],
        ["log linear"],
        [[[(10, 40), (100, 50)], [(10, 35), (100, 44)], [(10, 45), (100, 56)]]],
    ),
    (
        lambda: figures.draw_distribution("a", np.arange(1.0, 21), np.arange(20.0)),
        [
            *("Errors of a", "distance of the camera (ft)", "error (ft)"),
            *("held-out pictures", "mean", "± standard deviation"),
        ],
        ["log symlog"],
        [[[(x + 1, x) for x in range(20)]] * 2],
    ),
    (
        lambda: figures.draw_training(["a", "b"], np.array([[4.0, 2], [3, 1]])),
        ["a", "b", "epoch", "training error of log distance"],
        ["linear log"],
        [[[(1, 4), (2, 2)], [(1, 3), (2, 1)]]],
    ),
    (
        lambda: figures.draw_stages(["k", "r"], np.array([10.0, 20]), STAGES),
        [
            *("promised", *PAIR, "Regret, in flight"),
            "α regret + β perception cost, in flight",
        ],
        ["linear log"] * 2,
        [
            [
                *([(0, 10), (1, 20)], [(0, 1), (1, 3)], [(0, 0.9), (1, 2.7)], [(0, 1.1), (1, 3.3)]),
                *([(0.12, y), (1.12, z)] for y, z in ((5, 7), (4.9, 6.7), (5.1, 7.3))),
            ],
            [
                *([(0, 2), (1, 4)], [(0, 1.8), (1, 4)], [(0, 2.2), (1, 4)]),
                *([(0.12, y), (1.12, z)] for y, z in ((6, 8), (5.8, 7.6), (6.2, 8.4))),
            ],
        ],
    ),
]


def words(figure, panels):
    """All words of a figure but those at ticks: its own, of its legends, and of its panels."""
    found = [figure.get_suptitle(), figure.get_supxlabel(), figure.get_supylabel()]
    found += [text.get_text() for legend in figure.legends for text in legend.texts]
    for axes in panels:
        found += [axes.get_title(), axes.get_xlabel(), axes.get_ylabel()]
        found += [text.get_text() for text in axes.texts]
        found += [text.get_text() for text in axes.get_legend().texts] if axes.get_legend() else []
    return [word for word in found if word]


@pytest.mark.parametrize(("draw", "said", "scales", "lines"), FIGURES)
def test_a_figure_has_these_words_scales_and_points(draw, said, scales, lines):
    figure = draw()
    panels = [axes for axes in figure.axes if axes.get_visible()]
    assert words(figure, panels) == said
    assert [f"{axes.get_xscale()} {axes.get_yscale()}" for axes in panels] == scales
    for axes, expected in zip(panels, lines, strict=True):
        for line, points in zip(axes.lines, expected, strict=True):
            np.testing.assert_allclose(line.get_xydata(), points)
    plt.close(figure)


def test_markers_of_policies_have_their_intervals_and_their_looks():
    figure = figures.draw_costs(PAIR, PAID, CONTROL, "an axis")
    for line, policy in zip(figure.axes[0].lines, PAIR, strict=True):
        style = figures.POLICY_STYLE[policy]
        assert (line.get_color(), line.get_marker()) == (style["color"], style["marker"])
        assert line.get_linestyle() == "None"
    ends = [bar.get_segments()[0].tolist() for bar in figure.axes[0].collections]
    assert ends == [
        *([[2.5, 40], [3.5, 40]], [[3, 35], [3, 45]]),
        *([[4, 50], [4, 50]], [[4, 44], [4, 56]]),  # a single trial has no interval
    ]
    plt.close(figure)


def test_schedules_and_rewards_name_their_rows():
    drawn = (
        (figures.draw_rewards(PAIR, PAID * [-1, 1]), ["Greedy", "Optimal"]),
        (figures.draw_schedule(np.array([0, 1]), ["a", "b"], np.ones(2), "", 1.0), ["a", "b"]),
    )
    for figure, names in drawn:
        axes = figure.axes[0]
        assert [tick.get_text() for tick in axes.get_yticklabels()] == names
        assert axes.get_yticks().tolist() == [0, 1]
        plt.close(figure)
