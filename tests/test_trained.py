"""Experiment 2 end to end, with three small networks: landings on pictures, cache, figures."""

from dataclasses import replace
from functools import partial

import matplotlib.pyplot as plt
import numpy as np
import pytest
from matplotlib.figure import Figure

import landing
import modelselect as ms
from landing import Settings, fly_on_pictures, judge_on_pictures, learn, run_experiment
from perception import (
    ARCHITECTURE,
    HIGHEST,
    LOWEST,
    draw_pose,
    draw_scenes,
    guard_suite,
    photograph,
    read_residuals,
)

TINY = {"architecture": ARCHITECTURE[:3], "training": 320, "held_out": 300, "epochs": 4}
CHOSEN = {"experiment": "trained"} | landing.DEFAULTS["trained"]


@pytest.fixture(scope="module")
def trained():
    return learn(0, **TINY)


@pytest.fixture(scope="module", params=["measurement", "causal"])
def result(request, trained):
    settings = Settings(**CHOSEN | {"information": request.param, "trials": 8})
    return run_experiment(settings, trained=trained)


@pytest.fixture
def tiny(monkeypatch):
    """The command line with networks that are learned in a second."""
    monkeypatch.setattr(landing, "learn", partial(learn, **TINY))


# --------------------------------------------------------------------------------- the experiment


def test_costs_are_counted_from_the_arrays_or_linear(trained):
    counted = landing.model_cost(trained.networks, "counted")
    operations = np.array([network.multiply_adds for network in trained.networks])
    np.testing.assert_allclose(counted, 2 * operations / operations[-1])
    np.testing.assert_array_equal(landing.model_cost(trained.networks, "linear"), [0, 1, 2])


@pytest.mark.parametrize("cost", ["linear", "counted"])
def test_the_price_follows_the_rule_at_fixed_weights(trained, cost):
    """beta Upsilon (W-1) H = 0.2 alpha (control term of All Small) at alpha, beta = 0.8, 0.2."""
    run = run_experiment(Settings(**CHOSEN | {"cost": cost, "trials": 2}), trained=trained)
    small = run.problem.control_term(np.zeros(150, int))
    assert 0.2 * run.settings.upsilon * 2 * 150 == pytest.approx(0.2 * 0.8 * small)
    assert run.suite.cost[-1] == pytest.approx(2 * run.settings.upsilon)
    given = replace(run.settings, upsilon=7.0)
    assert run_experiment(given, trained=trained).suite.cost[-1] == 14.0


def test_the_suite_is_that_of_the_held_out_pictures(result, trained):
    measured = trained.residuals
    edges = landing.altitude_bins(measured.altitude, result.landing.path[:-1], 20)
    t, w = 40, 1
    b = np.digitize(result.landing.path[t], edges)
    mine = (np.digitize(measured.altitude, edges) == b) & (measured.model == w)
    assert result.suite.sample_size[t, w] == mine.sum()
    assert result.suite.mean[t, w, 0] == pytest.approx(measured.residual[mine].mean())
    assert result.suite.variance[t, w, 0] == pytest.approx(measured.residual[mine].var(ddof=1))


@pytest.mark.parametrize(
    ("settings", "start"),
    [
        ({"experiment": "trained"}, "preset: the cameras need textbook altitudes, found 'publi"),
        ({"cost": "counted"}, "cost: simulated models have linear cost, found 'counted'"),
        (CHOSEN | {"cost": "free"}, "cost: expected one of linear, counted, found 'free'"),
    ],
)
def test_settings_refuse(settings, start):
    with pytest.raises(ValueError) as caught:
        Settings(**settings)
    assert str(caught.value).startswith(start)


@pytest.mark.parametrize(("offset", "column"), [(1, 0), (0, 1)])
def test_the_published_log_is_that_of_experiment_2(offset, column):
    """Rewards of REFERENCE.md; w * Upsilon instead of (w + 1) * Upsilon is 150 Upsilon less."""
    log = landing.published_log(Settings(**CHOSEN), offset)
    logged = {"Oracle": -3.113470e15, "Optimal": -3.122875e15, "Random": -4.309759e15}
    logged |= {"All Large": -3.559247e15, "All Small": -1.131439e16}
    for policy, reward in logged.items():
        shift = 0.4 * 150 * 1e10 * column * (policy != "Oracle")
        assert log[policy][2] == pytest.approx(reward + shift, rel=1e-6)
    assert log["All Large"][1] == (12 - 1.5 * column) * 1e12


# ---------------------------------------------------------------------------- landings on pictures


def inputs(result):
    return result.landing.draw_inputs(np.random.default_rng(3), 8)


def test_flights_are_those_of_the_controller_fed_the_same_errors(result):
    s, choices = inputs(result), np.arange(150) % 3
    altitude, cost, e = fly_on_pictures(result, s, choices, 5)
    task, information = result.landing.task, result.settings.information
    x, u = ms.run_controller(task, result.landing.x0, s, s + e, information)
    np.testing.assert_allclose(altitude, result.landing.path + x[..., 0], atol=1e-8)
    np.testing.assert_allclose(cost, ms.control_cost(task, x, u), rtol=1e-8)


def test_the_drone_sees_the_picture_at_its_true_altitude(result):
    """Step 0 by hand; later the estimate is within the range of the networks at every step."""
    s, choices = inputs(result), np.full(150, 2)
    altitude, _, e = fly_on_pictures(result, s, choices, 5)
    rng = np.random.default_rng(5)
    scene, h = draw_scenes(8, rng), np.full(8, 105.0)
    scene = scene._replace(pose=draw_pose(8, rng))
    network = result.trained.networks[2]
    picture = photograph(scene, h, network.side, np.random.default_rng([5, 0]))
    np.testing.assert_allclose(e[:, 0, 0], network.altitude(picture) - h)
    seen = altitude[:, :-1] + e[..., 0]
    assert seen.min() >= LOWEST - 1e-9 and seen.max() <= HIGHEST + 1e-9


def test_policies_meet_the_same_scenes_and_flights_repeat(result):
    s = inputs(result)
    first, again = (fly_on_pictures(result, s, np.zeros(150, int), 5) for _ in range(2))
    mixed = fly_on_pictures(result, s, np.r_[0, np.full(149, 1)], 5)
    for a, b in zip(first, again, strict=True):
        np.testing.assert_array_equal(a, b)
    np.testing.assert_array_equal(first[2][:, 0], mixed[2][:, 0])
    assert np.any(first[2][:, 1] != mixed[2][:, 1])
    other = fly_on_pictures(result, s, np.zeros(150, int), 6)
    assert np.any(first[2] != other[2])


def test_flights_need_networks_and_no_forecast(trained):
    run = run_experiment(Settings(preset="textbook", information="causal", horizon=5, trials=2))
    with pytest.raises(ValueError, match="information: a flight has no forecast"):
        fly_on_pictures(run, np.zeros((2, 5, 1)), np.zeros(5, int), 0)
    wrong = Settings(**CHOSEN | {"information": "preview", "horizon": 40, "trials": 1})
    run = run_experiment(wrong, trained=trained)
    with pytest.raises(ValueError, match="found 'preview'"):
        fly_on_pictures(run, np.zeros((1, 40, 1)), np.zeros(40, int), 0)


def test_predicted_regret_is_that_of_the_error_models(result):
    many = replace(result, settings=replace(result.settings, trials=60))
    run, found = judge_on_pictures(many, result.settings.information)
    assert tuple(found) == landing.FLOWN
    for policy, regret in found.items():
        choices = run.flights.get(policy, run.flights["Optimal"]).choices
        if policy == "Guarded":
            safe = guard_suite(run.suite)
            safer = replace(run.problem, mean=safe.mean, variance=safe.variance)
            choices = ms.solve(safer).choices
        assert regret.predicted == pytest.approx(run.problem.control_term(choices))
        assert regret.paid == pytest.approx(run.problem.perception_term(choices))
        for drawn in (regret.gaussian, regret.bootstrap):
            error = drawn.std() / np.sqrt(len(drawn))
            # The bootstrap has (n-1)/n of the variance, n about 12 here.
            assert abs(drawn.mean() - regret.predicted) <= 6 * error + 0.1 * regret.predicted
        assert regret.flown.shape == (60,)
    assert run.optimal.is_optimal
    least = found["Optimal"]
    for regret in found.values():
        total = 0.6 * regret.predicted + 0.4 * regret.paid
        assert total >= (0.6 * least.predicted + 0.4 * least.paid) * (1 - 1e-9)


def test_regret_of_few_residuals_is_never_below_the_optimum(result):
    table = landing.sample_sizes(result, (50, 300), repeats=6, fresh=900)
    assert table.shape == (2, 2, 6)
    assert table.min() >= -1e-9
    assert np.ptp(table[0, 0]) > 0  # draws of 50 differ, the draw of all does not
    np.testing.assert_allclose(table[1], table[1][:, :1].repeat(6, axis=1))


def test_root_mean_square_covers_the_truth():
    rng, covered = np.random.default_rng(1), 0
    for _ in range(400):
        rms, half = landing.root_mean_square(rng.normal(0, 3, 300))
        covered += abs(rms - 3) <= half
    assert abs(covered / 400 - 0.95) <= 4 * np.sqrt(0.95 * 0.05 / 400)
    assert landing.root_mean_square(np.zeros(3)) == (0, 0)


# ------------------------------------------------------------------------- cache and command line


def test_models_are_learned_once_for_each_seed(trained, tmp_path, monkeypatch):
    first = learn(0, tmp_path / "new", **TINY)
    np.testing.assert_array_equal(first.residuals.residual, trained.residuals.residual)
    (path,) = (tmp_path / "new").iterdir()
    monkeypatch.setattr(landing, "train_models", lambda *_, **__: pytest.fail("trained again"))
    again = learn(0, tmp_path / "new", **TINY)
    np.testing.assert_array_equal(first.residuals.residual, again.residuals.residual)
    np.testing.assert_array_equal(first.losses, again.losses)
    path.write_bytes(b"foreign")
    with pytest.raises(ValueError, match="no file of these models"):
        learn(0, tmp_path / "new", **TINY)
    assert path.read_bytes() == b"foreign"
    for seed, options in ((1, TINY), (0, TINY | {"epochs": 5})):
        with pytest.raises(pytest.fail.Exception, match="trained again"):
            learn(seed, tmp_path / "new", **options)


def test_the_command_line_runs_it_all(tiny, tmp_path, capsys):
    argv = ["--experiment", "trained", "--trials", "4", "--out", str(tmp_path / "out")]
    assert landing.main([*argv, "--json", str(tmp_path / "a.json")]) == 0
    first = capsys.readouterr().out
    for text in (
        "published",
        "b2",
        "Regret under measurement",
        "Regret under causal",
        "predicted",
        "flown on pictures",
        "with guard_suite",
        "parameters",
    ):
        assert text in first
    files = {path.name: path.read_bytes() for path in (tmp_path / "out").iterdir()}
    wanted = {"gallery.png", "accuracy.png", "distribution.png", "training.png", "quantiles.png"}
    assert wanted | {"schedule.png", "residuals.csv"} <= set(files)
    residuals = read_residuals(tmp_path / "out" / "residuals.csv")
    np.testing.assert_array_equal(residuals.residual, learn(0, **TINY).residuals.residual)
    (tmp_path / "out" / "gallery.png").unlink()
    assert landing.main([*argv, "--no-figures", "--quiet"]) == 0
    assert capsys.readouterr().out == ""
    (cache,) = (tmp_path / "out").glob("models-*.npz")
    cache.write_bytes(files[cache.name][:-100])
    with pytest.raises(SystemExit) as caught:
        landing.main(argv)
    assert caught.value.code == 2
    assert "delete or move it" in capsys.readouterr().err
    assert cache.read_bytes() == files[cache.name][:-100]
    assert not (tmp_path / "out" / "gallery.png").exists()


@pytest.mark.parametrize(
    "plot",
    [
        landing.plot_accuracy,
        landing.plot_distribution,
        landing.plot_training,
        landing.plot_quantiles,
        lambda _: landing.plot_gallery(3),
    ],
)
def test_figures_are_drawn(plot, trained):
    figure = plot(trained)
    assert isinstance(figure, Figure)
    figure.canvas.draw()
    assert all(axes.has_data() or axes.images for axes in figure.axes if axes.get_title())
    plt.close(figure)


@pytest.mark.parametrize("plot", [landing.plot_costs, landing.plot_pareto])
def test_counted_costs_are_not_labelled_as_multiples_of_upsilon(plot, result):
    figure = plot(result)
    assert [axes.get_xlabel() for axes in figure.axes] == ["perception cost (operations)"]
    plt.close(figure)
