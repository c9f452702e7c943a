"""Experiment 2 end to end, with three small networks: landings on pictures, cache, figures."""

import math
import re
import statistics
from dataclasses import replace
from functools import partial
from itertools import pairwise

import matplotlib.pyplot as plt
import numpy as np
import pytest
from matplotlib.figure import Figure
from scipy.ndimage import zoom
from scipy.stats import chi2, t

import landing
import modelselect as ms
from landing import Settings, fly_on_pictures, judge_on_pictures, learn, run_experiment
from modelselect_parts import flights
from perception import (
    ARCHITECTURE,
    HIGHEST,
    LOWEST,
    altitude_bins,
    draw_pose,
    draw_scenes,
    guard_suite,
    measure_models,
    photograph,
    read_residuals,
    train_models,
)

HORIZON = 40  # of what needs no whole landing
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
def few_sizes(monkeypatch):
    """A short table of sample sizes."""
    short = partial(landing.sample_sizes, repeats=2, fresh=200)
    monkeypatch.setattr(landing, "sample_sizes", short)


@pytest.fixture
def tiny(monkeypatch, few_sizes):
    """The command line with networks that are learned in a second."""
    monkeypatch.setattr(landing, "learn", partial(learn, **TINY))


# --------------------------------------------------------------------------------- the experiment


def test_costs_are_counted_from_the_arrays_or_linear(trained):
    counted = landing.model_cost(trained.networks, "counted")
    operations = np.array([network.multiply_adds for network in trained.networks])
    np.testing.assert_allclose(counted, 2 * operations / operations[-1])
    np.testing.assert_array_equal(landing.model_cost(trained.networks, "linear"), [0, 1, 2])


def test_counted_costs_by_hand(trained):
    # Windows times weights, layer by layer, of pictures of 12, 16 and 20 pixels a side.
    small = 5**2 * 16 * 2 + 2**2 * 18 * 4 + 1 * 16 * 8 + 8
    middle = 7**2 * 16 * 3 + 3**2 * 27 * 6 + 1 * 54 * 12 + 12
    large = 9**2 * 16 * 4 + 4**2 * 36 * 8 + 1 * 128 * 16 + 16
    expected = [2 * small / large, 2 * middle / large, 2]
    assert landing.model_cost(trained.networks, "counted") == pytest.approx(expected, rel=1e-14)


def test_milliseconds_stay_what_they_are_under_every_pattern(trained, few_sizes):
    limits = {"switch_cost": 2.5, "budget": HORIZON * 18.4 - 1}
    chosen = {"trials": 3, "cost": "latency", "horizon": HORIZON}
    run = run_experiment(Settings(**CHOSEN | chosen | limits), trained=trained)
    np.testing.assert_array_equal(run.problem.model_cost, [12.9, 18.4, 24.0])
    for information in ("causal", "measurement"):
        again, found = judge_on_pictures(run, information)
        assert {k: getattr(again.settings, k) for k in limits} == limits
        assert again.problem.beta == pytest.approx(0.4 * again.settings.upsilon * 2 / 24.0)
        paid = [regret.paid for regret in found.values()]
        assert HORIZON * 12.9 <= min(paid) and max(paid) <= limits["budget"]
    assert not landing.published_log(run.settings)  # which is in Upsilon
    text = landing.report_pictures(run)
    assert text.count("perception (ms)") == 3
    spent = again.problem.beta * (found["All Small"].paid - found["Optimal"].paid)
    more = np.mean(found["All Small"].gaussian - found["Optimal"].gaussian)
    row = re.search(r"Regret under measurement.*?^All Small (.*?)$", text, re.M | re.S)[1]
    gain = float(row.replace("±", "").split()[8])
    assert gain == pytest.approx(0.6 * more + spent, abs=0.06)


@pytest.mark.parametrize("cost", ["linear", "counted"])
def test_the_price_follows_the_rule_at_fixed_weights(trained, cost):
    """beta Upsilon (W-1) H = 0.2 alpha (control term of All Small) at alpha, beta = 0.8, 0.2."""
    run = run_experiment(Settings(**CHOSEN | {"cost": cost, "trials": 2}), trained=trained)
    small = run.problem.control_term(np.zeros(150, int))
    assert 0.2 * run.settings.upsilon * 2 * 150 == pytest.approx(0.2 * 0.8 * small)
    assert run.suite.cost[-1] == pytest.approx(2 * run.settings.upsilon)
    given = replace(run.settings, upsilon=7.0)
    assert run_experiment(given, trained=trained).suite.cost[-1] == 14.0


def test_the_suite_in_bins_is_that_of_the_held_out_pictures(result, trained):
    measured, bins = trained.residuals, replace(result.settings, fit="bins", trials=1)
    result = run_experiment(bins, trained=trained)
    seen = measured.altitude[measured.model == 0]  # by all models
    edges = altitude_bins(seen, result.landing.path[:-1], 20)
    t, w = 40, 1
    b = np.digitize(result.landing.path[t], edges)
    mine = (np.digitize(measured.altitude, edges) == b) & (measured.model == w)
    assert result.suite.sample_size[t, w] == mine.sum()
    assert result.suite.mean[t, w, 0] == pytest.approx(measured.residual[mine].mean())
    assert result.suite.variance[t, w, 0] == pytest.approx(measured.residual[mine].var(ddof=1))


def fitted(measured, path, bins, guarded):
    """Mean and variance (H, W) by loops over steps: equally full bins, textbook bounds."""
    seen = measured.altitude[measured.model == 0]  # by all models
    within = seen[(seen > path.min()) & (seen < path.max())]
    edges = [path.min(), *np.quantile(within, np.arange(1, bins) / bins), path.max()]
    moments = np.empty((2, len(path), len(measured.names)))
    for step, w in np.ndindex(moments.shape[1:]):
        b = min(sum(edge <= path[step] for edge in edges) - 1, bins - 1)
        below = measured.altitude <= edges[b + 1] if b == bins - 1 else (
            measured.altitude < edges[b + 1])  # fmt: skip
        r = measured.residual[below & (measured.altitude >= edges[b]) & (measured.model == w)]
        n, m, v = len(r), statistics.fmean(r), statistics.variance(r)
        if guarded:
            m += math.copysign(t.ppf(0.95, n - 1) * math.sqrt(v / n), m)
            v *= (n - 1) / chi2.ppf(0.05, n - 1)
        moments[:, step, w] = m, v
    return moments


@pytest.mark.parametrize("guarded", [False, True])
def test_a_suite_along_the_landing_is_that_of_loops_and_textbook_bounds(trained, guarded):
    aircraft, bins = landing.preset("textbook", 30), 7
    mean, variance = fitted(trained.residuals, aircraft.path[:-1], bins, guarded)
    found = landing.fit_landing(aircraft, trained.residuals, [0, 1, 5], bins, guard=guarded)
    np.testing.assert_allclose(found.mean[..., 0], mean, rtol=1e-9)
    np.testing.assert_allclose(found.variance[..., 0], variance, rtol=1e-9)
    assert found.cost.tolist() == [0, 1, 5]


@pytest.mark.parametrize(
    ("settings", "start"),
    [
        ({"experiment": "trained"}, "preset: the cameras need textbook altitudes, found 'publi"),
        ({"cost": "counted"}, "cost: simulated models have linear cost or latency, found"),
        (CHOSEN | {"cost": "free"}, "cost: expected one of linear, counted, latency, found 'free'"),
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
    picture = photograph(scene, h, network.side, np.random.default_rng([5, 0, 1]))
    np.testing.assert_allclose(e[:, 0, 0], network.altitude(picture) - h)
    seen = altitude[:, :-1] + e[..., 0]
    assert seen.min() >= LOWEST - 1e-9 and seen.max() <= HIGHEST + 1e-9


@pytest.mark.no_cover
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
    with pytest.raises(ValueError, match="result: expected one of experiment trained"):
        fly_on_pictures(run, np.zeros((2, 5, 1)), np.zeros(5, int), 0)
    wrong = Settings(**CHOSEN | {"information": "preview", "horizon": 40, "trials": 1})
    run = run_experiment(wrong, trained=trained)
    with pytest.raises(ValueError, match="found 'preview'"):
        fly_on_pictures(run, np.zeros((1, 40, 1)), np.zeros(40, int), 0)


@pytest.mark.no_cover
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


@pytest.mark.no_cover
def test_limits_keep_their_ratio_to_the_price_under_every_pattern(trained, few_sizes):
    small = {"trials": 2, "horizon": HORIZON}
    free = run_experiment(Settings(**CHOSEN | small), trained=trained)
    upsilon, least = free.settings.upsilon, float(free.suite.cost[0]) * len(free.suite.mean)
    limits = {"switch_cost": upsilon / 4, "budget": least + 5 * upsilon}
    run = run_experiment(replace(free.settings, upsilon=None, **limits), trained=trained)
    for information in ("causal", "measurement"):
        again, found = judge_on_pictures(run, information)
        used = again.settings
        assert used.switch_cost / used.upsilon == pytest.approx(0.25)
        assert used.budget / used.upsilon == pytest.approx(limits["budget"] / upsilon)
        assert "All Large" not in found and {"Guarded", "Optimal", "Random"} <= set(found)
        assert all(regret.paid <= used.budget * (1 + 1e-9) for regret in found.values())
    assert "Left out" in landing.report(run)
    assert "All Large" not in landing.report_pictures(run)


@pytest.mark.no_cover
def test_flown_regret_is_that_of_the_controller_fed_what_the_networks_made_of_it(result):
    run, found = judge_on_pictures(result, result.settings.information, ("Optimal",))
    s = run.landing.draw_inputs(np.random.default_rng(0).spawn(5)[1], 8)
    e = fly_on_pictures(run, s, run.optimal.choices, 0)[2]
    with_e, without = (
        ms.control_cost(task, *ms.run_controller(task, run.landing.x0, s, fed, pattern))
        for task, pattern in [(run.landing.task, run.settings.information)]
        for fed in (s + e, s)
    )
    np.testing.assert_allclose(found["Optimal"].flown, with_e - without, rtol=1e-6)


def test_regret_of_all_residuals_is_that_of_loops_over_steps(result):
    # Without a forecast steps decouple: the best model of each is found alone.
    bins = replace(result.settings, fit="bins", trials=1)
    result = run_experiment(bins, trained=result.trained)
    problem, path = result.problem, result.landing.path[:-1]
    new = measure_models(result.trained.networks, 900, np.random.default_rng([0, 1]))

    def totals(measured, guarded=False):
        mean, variance = fitted(measured, path, 20, guarded)
        felt = [problem.psi[i, i] * (mean[i] ** 2 + variance[i]) for i in range(150)]
        return 0.6 * np.array(felt) + 0.4 * problem.model_cost

    truth = totals(new)
    least = sum(min(row) for row in truth)
    for guarded, found in enumerate(landing.sample_sizes(result, (300,), repeats=1, fresh=900)[0]):
        seen = totals(result.trained.residuals, guarded)
        chosen = sum(row[min(range(3), key=own.__getitem__)]
                     for row, own in zip(truth, seen, strict=True))  # fmt: skip
        assert found == pytest.approx([chosen / least - 1], rel=1e-6, abs=1e-12)


def test_the_report_on_pictures_prints_what_it_was_told(result, monkeypatch):
    """Three trials, t = 4.302653: regrets 1, 2, 3 have mean 2 and half-width 4.3 / sqrt(3)."""
    three = np.array([1.0, 2, 3])
    regrets = {"Optimal": landing.Regret(1.25, three, 2 * three, 10 * three, 100.0)}
    regrets["All Small"] = landing.Regret(7.5, 3 * three, 4 * three, 20 * three, 50.0)
    monkeypatch.setattr(landing, "judge_on_pictures", lambda run, *_, **__: (run, regrets))
    table = np.array([[[0.1, 0.2], [0.3, 0.5]]]).repeat(2, axis=0)
    monkeypatch.setattr(landing, "sample_sizes", lambda *_: table)
    text = landing.report_pictures(result)
    rows = {line[:9].strip(): line[12:].replace("±", "").split() for line in text.splitlines()}
    assert rows["Optimal"] == ["1.2", "2.0", "2.5", "4.0", "5.0", "20.0", "24.8", "100.0"]
    # Optimal gains 0.6 (6 - 2) - 0.4 (100 - 50) in one, 0.6 (40 - 20) - 20 on pictures.
    small = ["7.5", "6.0", "7.5", "8.0", "9.9", "40.0", "49.7", "50.0"]
    assert rows["All Small"] == [*small, "-17.6", "3.0", "-8.0", "14.9"]
    assert "\nUndecided when flown (0 is in the interval): All Small.\n" in text
    assert re.findall(r"^ +(50|100) +(\S+) ± +(\S+)% +(\S+) ± +(\S+)%$", text, re.M) == [
        (n, "15.00", "63.53", "40.00", "127.06") for n in ("50", "100")
    ]  # two draws, t = 12.7062: 5 and 10 times it, in per cent
    measured, edges = result.trained.residuals, [-2, 0, 5, 15, 35, 70, 100]
    for w, network in enumerate(result.trained.networks):
        h, r = (x[measured.model == w] for x in (measured.altitude, measured.residual))
        bins = [r[(h >= low) & (h < high)] for low, high in pairwise(edges)]
        rms = [math.sqrt(statistics.fmean(part**2)) for part in (r, *bins)]
        half = t.ppf(0.975, 299) * statistics.stdev(r**2) / math.sqrt(300) / (2 * rms[0])
        shown = re.search(rf"^b{w} .*", text, re.M)[0].replace(",", "").replace("±", "").split()
        assert shown[1:3] == [str(network.parameters), str(network.multiply_adds)]
        expected = [rms[0], half, *rms[1:]]
        assert [float(x) for x in shown[3:]] == pytest.approx(expected, abs=6e-3)


def test_regret_of_few_residuals_is_never_below_the_optimum(result):
    table = landing.sample_sizes(result, (50, 300), repeats=6, fresh=900)
    assert table.shape == (2, 2, 6)
    assert table.min() >= -1e-9
    assert np.ptp(table[0, 0]) > 0  # draws of 50 differ, the draw of all does not
    np.testing.assert_allclose(table[1, 0], table[1, 0, :1].repeat(6))


def test_few_residuals_are_fitted_plain_and_then_guarded(result, monkeypatch):
    fits, fit = [], flights.fit_landing

    def recorded(aircraft, measured, cost, bins=None, *, guard=False, rng=None):
        fits.append((len(measured.model), bins, guard, rng is not None))
        return fit(aircraft, measured, cost, bins, guard=guard, rng=rng)

    monkeypatch.setattr(flights, "fit_landing", recorded)
    landing.sample_sizes(result, (50, 60), repeats=2, fresh=200)
    truth, *few = fits
    assert truth == (3 * 200, None, False, False)
    assert few == [
        (3 * n, None, *way) for n in (50, 50, 60, 60) for way in [(False,) * 2, (True,) * 2]
    ]
    fits.clear()
    bins = replace(result, settings=replace(result.settings, fit="bins"))
    landing.sample_sizes(bins, (50, 120), repeats=1, fresh=200)
    assert [parts for _, parts, _, _ in fits] == [20, 4, 4, 10, 10]  # about ten in each


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
    monkeypatch.setattr(
        landing.perception, "train_models", lambda *_, **__: pytest.fail("trained again")
    )
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


def test_what_is_learned_is_what_training_makes_of_the_first_stream_of_the_seed(tmp_path):
    tiny = {"architecture": ((8, 1, 2),), "training": 20, "held_out": 5, "epochs": 2}
    expected = train_models(np.random.default_rng(3).spawn(1)[0], **tiny)
    for found in (learn(3, **tiny), learn(3, tmp_path, **tiny), learn(3, tmp_path, **tiny)):
        np.testing.assert_array_equal(found.losses, expected.losses)
        np.testing.assert_array_equal(found.residuals.residual, expected.residuals.residual)
        for a, b in zip(found.networks[0].layers, expected.networks[0].layers, strict=True):
            np.testing.assert_array_equal(a.weight, b.weight)
    (file,) = tmp_path.iterdir()
    assert re.fullmatch(r"models-[0-9a-f]{16}\.npz", file.name)


def test_the_command_line_runs_it_all(tiny, tmp_path, capsys, rough_figures):
    small = ["--trials", "4", "--horizon", "30"]
    argv = ["--experiment", "trained", *small, "--out", str(tmp_path / "out")]
    assert landing.main([*argv, "--json", str(tmp_path / "a.json")]) == 0
    first = capsys.readouterr().out
    assert "published" not in first  # the log is of another aircraft
    for text in (
        "Means of 4 trials",
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
    assert wanted | {"schedule.png", "residuals.csv", "percentages.csv"} <= set(files)
    assert b"38.04% lower" in files["percentages.csv"]
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


def test_accuracy_figure_shows_root_mean_squares_over_parameters(trained):
    figure = landing.plot_accuracy(trained)
    line, measured = figure.axes[0].lines[0], trained.residuals
    for w, (x, y) in enumerate(line.get_xydata()):
        assert x == sum(a.size for layer in trained.networks[w].layers for a in layer[:2])
        assert y == pytest.approx(
            math.sqrt(statistics.fmean(measured.residual[measured.model == w] ** 2))
        )
    plt.close(figure)


@pytest.mark.parametrize("model", [0, -1])
def test_distribution_figure_shows_errors_their_mean_and_deviation(model, trained):
    figure, measured = landing.plot_distribution(trained, model), trained.residuals
    dots, mean = figure.axes[0].lines
    mine = measured.model == model % 3
    pairs = sorted(zip(measured.altitude[mine] + 5, measured.residual[mine], strict=True))
    assert sorted(map(tuple, dots.get_xydata())) == pairs
    parts = [pairs[i : i + 15] for i in range(0, 300, 15)]  # twenty parts of equal size
    expected = [[statistics.fmean(column) for column in zip(*part, strict=True)] for part in parts]
    np.testing.assert_allclose(mean.get_xydata(), expected)
    band = figure.axes[0].collections[0].get_paths()[0].vertices[:, 1]
    for (_, y), part in zip(expected, parts, strict=True):
        deviation = statistics.pstdev(e for _, e in part)
        assert min(abs(band - y - deviation)) < 1e-9 and min(abs(band - y + deviation)) < 1e-9
    plt.close(figure)


def test_training_figure_shows_roots_of_losses_in_logarithms_of_distance(trained):
    figure = landing.plot_training(trained)
    for w, line in enumerate(figure.axes[0].lines):
        roots = [math.log(140 / 3) / math.sqrt(12) * math.sqrt(x) for x in trained.losses[w]]
        np.testing.assert_allclose(line.get_xydata(), [*enumerate(roots, start=1)])
    assert w == 2 and [text.get_text() for text in figure.legends[0].texts] == ["b0", "b1", "b2"]
    plt.close(figure)


def test_quantile_figure_shows_standardised_errors_over_normal_quantiles(trained):
    figure, measured = landing.plot_quantiles(trained), trained.residuals
    normal = [statistics.NormalDist().inv_cdf((i + 0.5) / 300) for i in range(300)]
    for w, axes in enumerate(figure.axes[:3]):
        mine = measured.model == w
        pairs = sorted(zip(measured.altitude[mine], measured.residual[mine], strict=True))
        z = []
        for part in (pairs[i : i + 15] for i in range(0, 300, 15)):
            errors = [e for _, e in part]
            middle, deviation = statistics.fmean(errors), statistics.stdev(errors)
            z += [(e - middle) / deviation for e in errors]
        expected = np.transpose([normal, sorted(z)])
        np.testing.assert_allclose(axes.lines[0].get_xydata(), expected, rtol=1e-9, atol=1e-9)
    plt.close(figure)


def test_gallery_shows_three_landings_and_the_third_again_at_40_pixels():
    figure = landing.plot_gallery(3)
    pictures = [axes.images[0].get_array() for axes in figure.axes]
    assert [picture.shape for picture in pictures] == [(128, 128)] * 24 + [(40, 40)] * 8
    titles = [axes.get_title() for axes in figure.axes[:8]]
    assert titles == [f"{h} ft" for h in (100, 60, 35, 20, 10, 5, 2, 0)]
    for fine, coarse in zip(pictures[16:24], pictures[24:], strict=True):
        assert np.corrcoef(zoom(fine, 40 / 128, order=1).ravel(), coarse.ravel())[0, 1] > 0.8
    assert np.corrcoef(pictures[0].ravel(), pictures[8].ravel())[0, 1] < 0.8  # another landing
    plt.close(figure)
