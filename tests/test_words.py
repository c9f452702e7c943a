"""What is said, whole: refusals, warnings, tables, help and figures, word by word.

Other tests ask for the word that matters to them; here no other word can go astray unseen.  Where a
text was meant to change, it changes here, too.
"""

import warnings
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

import landing
import modelselect as ms
import perception
from landing import Settings, run_experiment
from modelselect_parts import measured
from modelselect_parts.pooling import Labelled, bootstrapped, labelled
from perception import Kernel, PerceptionSuite, Residuals, fit_suite

# ------------------------------------------------------------------------------------- refusals

RNG = np.random.default_rng(0)
MEAN = np.zeros((2, 3, 1))
SUITE = PerceptionSuite(["a", "b", "c"], MEAN, MEAN + 1, [0, 1, 2])
WAY = np.array([8.0, 6, 3, 1])


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


S = np.ones((9, 1))
TASK = ms.ControlTask([[1.0]], [[1.0]], [[1.0]], [[1.0]], [[1.0]], len(S))


def flown(s):
    """States and controls of a filter that takes what pushes it for what it measures."""
    return ms.run_controller(TASK, [1.0], s, s, "filter", gains=[[0.5]])


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
    "which then pushes it; for perfect perception give s = 0 and s_hat = 0": lambda: flown(
        flown(0 * S)[0][:-1]
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
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        WARNED[message]()
    assert [str(warning.message) for warning in caught] == [message]
    assert caught[0].filename == __file__
