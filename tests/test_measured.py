"""Landing on what real programs erred by: views split, flown, told apart from what was promised."""

import importlib.util
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import landing
import modelselect as ms
from landing import Settings
from modelselect_parts import measured
from modelselect_parts.flights import half_width
from perception import Kernel, Residuals, fit_suite, read_residuals, with_dropouts

ROOT = Path(landing.__file__).parent
CHOSEN = {"experiment": "measured"} | landing.DEFAULTS["measured"]


def views(N, W=2, seed=0):
    """Residuals of W models on N views; model w errs by 100 w + the view's number."""
    rng = np.random.default_rng(seed)
    number, altitude = np.repeat(np.arange(N), W), np.repeat(rng.uniform(5, 100, N), W)
    model, ms_ = np.tile(np.arange(W), N), np.tile([2.0, 7.0][:W], N)
    table = np.stack([number, ms_ + rng.uniform(-1, 1, N * W), altitude], axis=1)
    variables = ("view", "milliseconds", "altitude")
    names = [f"m{w}" for w in range(W)]
    return Residuals(names, model, table, 100.0 * model + number, variables)


def test_views_are_split_and_not_rows():
    fitted, sights = measured.halves(views(40), np.random.default_rng(1))
    kept = set(measured.column(fitted, "view"))
    flown = sights.errors[:, 0]
    assert len(kept) == len(flown) == 20 and not kept & set(flown)
    np.testing.assert_array_equal(sights.errors[:, 1], flown + 100)  # of the same view
    assert (np.diff(sights.altitude) >= 0).all()
    np.testing.assert_allclose(measured.latencies(views(400)), [2, 7], atol=0.2)


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda r: replace(r, model=[0] * len(r.model)), "residuals: expected every model once"),
        (lambda r: replace(r, variables=("a", "b", "altitude")), "residuals: expected a column vi"),
        (
            lambda r: replace(
                r, residual=np.ones((len(r.model), 2)), components=None, resolution=0
            ),
            "residuals: expected one number of each of 2 models",
        ),
        (lambda r: np.eye(2), "residuals: expected Residuals, found ndarray"),
    ],
)
def test_what_cannot_be_split_is_refused(spoil, message):
    with pytest.raises(ValueError) as caught:
        measured.halves(spoil(views(10)), np.random.default_rng(0))
    assert str(caught.value).startswith(message)


def test_flights_meet_errors_of_views_near_them_or_the_prior():
    sights = measured.Sights(
        np.linspace(5, 100, 500), np.linspace(5, 100, 500)[:, None] * [1, np.nan]
    )
    z = np.array([5.0, 30.0, 100.0])
    drawn = np.stack([measured.draw(sights, z, np.random.default_rng(k)) for k in range(300)])
    assert (np.abs(drawn[..., 0] - z) < 8).all()
    assert drawn[..., 1].std() == pytest.approx(measured.PRIOR, rel=0.15)


@pytest.mark.parametrize("information", ["preview", "measurement"])
def test_regret_is_that_of_psi_where_errors_are_the_same_everywhere(information):
    aircraft = landing.preset("textbook", 12)
    sights = measured.Sights(np.linspace(5, 100, 60), np.tile([0.7, -0.4], (60, 1)))
    choices = np.arange(12) % 2
    s = aircraft.draw_inputs(np.random.default_rng(0), 5)
    cost = measured.regret(aircraft, information, None, sights, choices, s, 0)
    e = np.where(choices, -0.4, 0.7)
    expected = e @ ms.psi(aircraft.task, information) @ e
    half = half_width(cost)
    assert abs(cost.mean() - expected) <= max(1e-6 * expected, 3 * half)


def test_the_experiment_lands_on_views_that_no_fit_has_seen():
    run = landing.run_experiment(Settings(**CHOSEN | {"horizon": 15, "trials": 2}))
    assert run.optimal.is_optimal and run.suite.names[0] == "0.25 none"
    text = landing.report(run)
    assert "perception costs are median ms" in text
    flown = landing.report_measured(run)
    assert flown.startswith("1000 flights each on views that no fit has seen")
    assert flown == landing.report_measured(run)  # the same seed, the same views
    row = next(line for line in flown.splitlines() if line.startswith("Optimal"))
    promised, regret, total = (float(word) for word in row.split()[1:4])
    assert 0.5 < promised / regret < 1.5
    paid = run.problem.beta * run.problem.perception_term(run.optimal.choices)
    assert total == pytest.approx(run.settings.alpha * regret + paid, rel=2e-3)


def test_files_of_others_are_flown_too(tmp_path):
    path = tmp_path / "mine.csv"
    lines = (ROOT / "notebooks" / "data" / "tags.csv").read_text().splitlines()
    path.write_text("\n".join(line.replace("1 apriltag", "mine") for line in lines))
    run = Settings(**CHOSEN | {"horizon": 10, "trials": 1}, residuals=str(path))
    assert "mine" in landing.run_experiment(run).suite.names
    for changes, message in (
        ({"residuals": str(tmp_path / "none.csv")}, "cannot be read as a CSV file"),
        ({"cost": "linear"}, "^cost: measured models cost their latency, found 'linear'"),
        ({"preset": "published"}, "^preset: the cameras need textbook altitudes"),
        ({"experiment": "simulated"}, "^residuals: used by experiment measured"),
    ):
        with pytest.raises(ValueError, match=message):
            landing.run_experiment(replace(run, **changes))
    path.write_text(path.read_text() + "\nmine,0,1,8,0.5")
    found = r"found 1600 views, and 7 on view 0$"
    with pytest.raises(ValueError, match=f"^residuals: expected one number of each of 6 .*{found}"):
        landing.run_experiment(run)
    simulated = landing.run_experiment(Settings(horizon=2, trials=1))
    with pytest.raises(ValueError, match=r"^result: expected one of experiment measured"):
        landing.report_measured(simulated)


def script(name):
    path = ROOT / "notebooks" / "data" / f"{name}.py"
    spec = importlib.util.spec_from_file_location(name, path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module, path.with_suffix(".csv").read_text().splitlines()


@pytest.mark.parametrize(("name", "needs"), [("tags", ("cv2",)), ("stereo", ("cv2", "skimage"))])
def test_the_script_measures_the_committed_errors(name, needs):
    for package in needs:
        pytest.importorskip(package, reason="of the extra `data`")
    module, committed = script(name)
    found = module.text(module.rows(range(6) if name == "tags" else 6)).splitlines()
    assert len(found) > 30
    for line, known in zip(found, committed, strict=False):
        here, there = (text.split(",") for text in (line, known))
        assert (here[:2], here[3]) == (there[:2], there[3])  # all but the milliseconds
        if here[0] != "model":
            assert (here[4] == "") == (there[4] == "")
            assert here[4] == "" or float(here[4]) == pytest.approx(float(there[4]), abs=2e-4)


def test_stereo_matchers_trade_time_for_error_and_choosing_among_them_pays():
    """A cart drives up to a motorcycle, from 4.8 to 2.3 m: see notebooks/data/stereo.py."""
    residuals = read_residuals(ROOT / "notebooks" / "data" / "stereo.csv")
    price, H = measured.latencies(residuals), 50
    assert price.max() / price.min() > 200
    way = {"distance": np.linspace(4.8, 2.3, H)}
    near = Kernel(0.3, log=["distance"], relative="distance")
    table = replace(residuals, ordered=True)
    suite = fit_suite(table, way, price, kernel=near)
    missed = np.asarray(suite.miss_rate)
    assert missed[0].mean() > 2 * missed[-1].mean()  # from afar they say nothing more often
    suite = with_dropouts(suite, missed, ([0.0], [0.3**2]))
    task = ms.ControlTask([[1, 0.1], [0, 1]], [[0], [0.1]], [[1], [0]], np.eye(2), [[0.1]], H)
    free = ms.SelectionProblem.from_suite(ms.psi(task, "preview"), suite)
    constant = np.repeat(np.arange(7)[:, None], H, axis=1)
    level = np.median(free.control_term(constant)) / free.perception_term(constant).mean()
    problem = replace(free, beta=0.3 * level)
    best = ms.solve(problem)
    assert best.is_optimal and len(set(best.choices.tolist())) > 2
    assert problem.total_cost(constant).min() > 1.15 * best.cost
