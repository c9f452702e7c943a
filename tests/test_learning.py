"""Experiment 2 by stages: pooled errors, calibration, rounds of labelled landings, a filter."""

import statistics
import subprocess
import sys
from dataclasses import replace
from itertools import product
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import pytest
from scipy.stats import t as student

import landing
import modelselect as ms
from landing import Settings, fly_stages, learn, run_experiment
from modelselect_parts import learning, pooling, sight
from modelselect_parts.flights import fly, leads
from modelselect_parts.sight import MOST_PITCH, fly_by_sight, gains_for
from perception import ARCHITECTURE, HIGHEST, LOWEST, MOUNT, Residuals, sample_errors

TINY = {"architecture": ARCHITECTURE[:3], "training": 320, "held_out": 300, "epochs": 4}
CHOSEN = {"experiment": "trained", "horizon": 20, "trials": 4} | landing.DEFAULTS["trained"]
PATH = np.array([90.0, 40.0, 10.0, 0.0])


@pytest.fixture(scope="module")
def trained():
    return learn(0, **TINY)


@pytest.fixture(autouse=True)
def few_sizes(monkeypatch):
    """No long table of sample sizes, which test_trained.py has."""
    some = np.full((2, 2, 3), 0.1)
    monkeypatch.setattr(landing, "sample_sizes", lambda *_, **__: some)
    monkeypatch.setattr(landing, "SIZES", (50, 100))


@pytest.fixture(scope="module")
def result(trained):
    settings = Settings(**CHOSEN | {"calibrate": True, "rounds": 2})
    return run_experiment(settings, trained=trained)


# ----------------------------------------------------------- synthetic pictures of a known law


def pictures(rng, groups=600, size=1, scene=0.0):
    """Errors z (b + scene part + noise) of two models, uniform in ln z; groups share the scene."""
    z = np.exp(rng.uniform(np.log(LOWEST + MOUNT), np.log(HIGHEST + MOUNT), groups * size))
    group = np.repeat(np.arange(groups), size)
    bias, noise = np.array([[0.2], [-0.05]]), np.array([[0.1], [0.02]])
    same = scene * rng.normal(size=groups)[group]
    e = z * (bias + same + noise * rng.normal(size=(2, groups * size)))
    return pooling.Labelled(z - MOUNT, e, group, z - MOUNT)


def test_pooled_moments_are_those_of_the_law_and_of_loops():
    few = pictures(np.random.default_rng(0))
    suite = pooling.pooled_suite(few, PATH, [0, 1])
    z, here = few.altitude + MOUNT, PATH + MOUNT
    for step, w in np.ndindex(4, 2):
        k = np.exp(-0.5 * ((np.log(z) - np.log(here[step])) / 0.3) ** 2)
        a, r = k / k.sum(), few.error[w] / z
        m = float(a @ r)
        v = float(a @ (r - m) ** 2 / (1 - a @ a))
        assert suite.mean[step, w, 0] == pytest.approx(here[step] * m, rel=1e-9)
        assert suite.variance[step, w, 0] == pytest.approx(here[step] ** 2 * v, rel=1e-9)
    many = pooling.pooled_suite(pictures(np.random.default_rng(1), 20000), PATH, [0, 1])
    truth = here[:, None] * [0.2, -0.05]
    np.testing.assert_allclose(many.mean[..., 0], truth, atol=0.02 * here[0] * 0.05)
    np.testing.assert_allclose(many.variance[..., 0] ** 0.5, here[:, None] * [0.1, 0.02], rtol=0.05)


@pytest.mark.unmutated
@pytest.mark.parametrize(("size", "scene"), [(1, 0.0), (10, 0.2)])
def test_standard_errors_are_the_deviation_of_means_over_new_pictures(size, scene):
    """Where a landing shares its scene, ten pictures of it count as hardly more than one."""
    rng, found, told = np.random.default_rng(2), [], []
    for _ in range(60):
        drawn = pictures(rng, 100, size, scene)
        suite = pooling.pooled_suite(drawn, PATH, [0, 1])
        suite = pooling.bootstrapped(suite, drawn, PATH, rng)
        found.append(suite.mean[..., 0])
        told.append(suite.standard_error[..., 0])
    # Of 60 draws a deviation is sure to 1/sqrt(120), 9%; of a pool of 15 to 30 groups to as much.
    np.testing.assert_allclose(np.mean(told, axis=0), np.std(found, axis=0, ddof=1), rtol=0.3)
    naive = pooling.pooled_suite(drawn, PATH, [0, 1]).standard_error[..., 0]
    assert (np.mean(told, axis=0) > 1.5 * naive).all() == (size > 1)


def test_standard_errors_are_those_of_loops_over_the_same_draws():
    few, group = pictures(np.random.default_rng(0), 30, 3, 0.2), np.repeat(np.arange(30), 3)
    suite = pooling.pooled_suite(few, PATH, [0, 1])
    suite = pooling.bootstrapped(suite, few, PATH, np.random.default_rng(1), 4)
    counts = np.random.default_rng(1).multinomial(30, np.full(30, 1 / 30), 4)
    z = few.altitude + MOUNT
    for (step, here), w in product(enumerate(PATH + MOUNT), range(2)):
        k = np.exp(-0.5 * (np.log(z / here) / 0.3) ** 2)
        r = few.error[w] / z
        means = [here * np.average(r, weights=k * count[group]) for count in counts]
        assert suite.standard_error[step, w, 0] == pytest.approx(statistics.stdev(means))


def test_sample_sizes_count_landings_not_pictures():
    drawn = pictures(np.random.default_rng(3), 50, 10)
    drawn = drawn._replace(planned=np.tile(np.linspace(90, 0, 10), 50))
    suite = pooling.pooled_suite(drawn, PATH, [0, 1])
    counted = pooling.bootstrapped(suite, drawn, PATH, np.random.default_rng(0)).sample_size
    np.testing.assert_array_equal(counted, 50)  # all saw the same way
    assert suite.sample_size.max() > 200


def test_the_guard_takes_the_bootstrap():
    drawn, cost = pictures(np.random.default_rng(4), 80, 5, 0.3), [0, 1]
    aircraft = replace(landing.preset("textbook", 4), path=np.append(PATH, 0.0))
    plain = landing.fit_landing(aircraft, drawn, cost, rng=np.random.default_rng(5))
    safe = landing.fit_landing(aircraft, drawn, cost, guard=True, rng=np.random.default_rng(5))
    bound = student.ppf(0.95, plain.sample_size - 1) * plain.standard_error[..., 0]
    np.testing.assert_allclose(abs(safe.mean - plain.mean)[..., 0], bound)
    assert (abs(safe.mean) >= abs(plain.mean)).all()


@pytest.mark.parametrize(
    "spoil",
    [
        lambda r: replace(r, model=r.model[::-1].copy()),
        lambda r: replace(r, altitude=r.altitude + (np.arange(6) == 5)),
    ],
)
def test_errors_must_be_of_the_same_pictures(spoil):
    r = Residuals(["a", "b"], [0, 0, 0, 1, 1, 1], [1.0, 2, 3] * 2, np.arange(6.0))
    assert pooling.labelled(r).error.tolist() == [[0, 1, 2], [3, 4, 5]]
    with pytest.raises(ValueError, match="measured: expected all models"):
        pooling.labelled(spoil(r))


def test_errors_are_one_of_a_picture_from_several_altitudes():
    """Refused where they are not, in one line that says of what, and not by an inner sum."""
    aircraft, rng = landing.preset("textbook", 5), np.random.default_rng(0)
    h, e = np.tile(np.geomspace(1, 100, 60), 2), rng.normal(size=120)
    model, names = np.repeat([0, 1], 60), ["a", "b"]
    refused = {
        "all models on the same pictures": Residuals(names, [0, 0, 1], [1.0, 2, 3], [1.0, 2, 3]),
        "one variable": Residuals(names, model, h, np.stack([e, e], axis=1)),
        "several altitudes": Residuals(names, model, 0 * h + 5, e),
        "gave nothing": Residuals(names, model, h, np.where(h == h[3], np.nan, e)),
    }
    for words, measured in refused.items():
        with pytest.raises(ValueError, match=f"^measured: expected .*{words}"):
            landing.fit_landing(aircraft, measured, [0, 1], rng=rng)


def test_a_single_landing_tells_nothing_of_others():
    """Its bootstrap would be sure of everything, and a map judged by it has nothing to learn of."""
    one = pictures(np.random.default_rng(9), 60)._replace(group=np.zeros(60, int))
    suite = pooling.pooled_suite(one, PATH, [0, 1])
    with pytest.raises(ValueError, match="measured: expected pictures of 2 or more groups, found"):
        pooling.bootstrapped(suite, one, PATH, np.random.default_rng(0))
    with pytest.raises(ValueError, match="measured: expected pictures of 2 or more groups, found"):
        pooling.calibrate_all([Fixed(None)] * 2, one)


@pytest.mark.filterwarnings("ignore:fit_suite")
def test_bins_survive_landings_that_were_labelled_at_the_same_places():
    """Half of the pictures count at one altitude: the edges on both sides of it are no two."""
    seen = pictures(np.random.default_rng(10), 200)
    place = np.where(np.arange(200) % 2, 26.0, seen.planned)
    seen = seen._replace(planned=place, error=seen.error / seen.distance)
    path = np.array([90.0, 26.0, 7.0])
    suite = pooling.binned_suite(seen, path, [0, 1], 20)
    edges = pooling.altitude_bins(place, path, 20)
    assert (np.diff(edges) > 0).all() and 26.0 in edges
    inside = (place >= 26) & (place < edges[edges > 26][0])
    np.testing.assert_allclose(suite.mean[1, :, 0], seen.error[:, inside].mean(axis=1))
    drawn = pooling.redraw(seen, path, 30, np.random.default_rng(0), 20)
    assert np.isin(drawn[:, 1, 0], seen.error[0, inside]).all()


def test_errors_are_drawn_of_the_pictures_that_the_fit_looks_at():
    seen = pictures(np.random.default_rng(11), 40)
    path = np.array([90.0, 26.0, 7.0])
    edges = pooling.altitude_bins(seen.planned, path, 2)
    drawn = pooling.redraw(seen, path, 900, np.random.default_rng(0), 2)
    part = [seen.planned >= edges[1], seen.planned < edges[1]]
    inside = (seen.planned > 7) & (seen.planned < 90)
    for step, w in np.ndindex(3, 2):
        high = path[step] >= edges[1]
        assert set(drawn[:, step, w, 0]) == set(seen.error[w, part[1 - high] & inside])
    drawn = pooling.redraw(seen, path, 20, np.random.default_rng(0), None)
    scaled = drawn / (path + MOUNT)[:, None, None]
    for w in range(2):
        apart = abs(scaled[:, :, w] - seen.error[w] / seen.distance)
        assert apart.min(axis=-1).max() < 1e-12


# -------------------------------------------------------------------------------- calibration


class Fixed:
    """A network that was told what to say."""

    side = 8

    def __init__(self, says):
        self.says = says

    def altitude(self, _):
        return self.says


def test_calibration_is_the_expectation_of_what_is_where_so_much_is_said():
    """ln z ~ N(m, 1), ln z_hat = ln z + N(0, 0.5^2): E[z | z_hat] is known in closed form."""
    rng, m, prior, noise = np.random.default_rng(6), np.log(20.0), 0.4, 0.3
    z = np.exp(rng.normal(m, prior, 40000))
    z_hat = z * np.exp(rng.normal(0, noise, 40000))
    inside = (z_hat > LOWEST + MOUNT) & (z_hat < HIGHEST + MOUNT)
    z, z_hat = z[inside], z_hat[inside]
    said = np.array([12.0, 20.0, 35.0])
    ready = pooling.calibrate(Fixed(said - MOUNT), z - MOUNT, z_hat - z)
    keep = prior**2 / (prior**2 + noise**2)
    expected = np.exp(m + keep * (np.log(said) - m) + prior**2 * (1 - keep) / 2)
    # A kernel of 0.3 in ln z flattens the relation a little: 7% here.
    np.testing.assert_allclose(ready.altitude(None) + MOUNT, expected, rtol=0.08)
    assert ready.side == 8
    assert abs(expected - said).max() > 0.2 * said.max() * 0.5  # it had something to do


def test_errors_after_calibration_are_those_of_maps_that_have_not_seen_the_picture():
    seen = pictures(np.random.default_rng(7), 40, 3, 0.2)
    seen = seen._replace(error=0.5 * seen.error)
    networks = [Fixed(None), Fixed(None)]
    _, found = pooling.calibrate_all(networks, seen)
    for picture in (0, 17, 119):
        fold = seen.group % 5 == seen.group[picture] % 5
        for w in (0, 1):
            ready = pooling.calibrate(networks[w], seen.altitude[~fold], seen.error[w, ~fold])
            said = seen.altitude[picture] + seen.error[w, picture]
            expected = ready.correct([said])[0] - seen.altitude[picture]
            assert found.error[w, picture] == pytest.approx(expected, abs=1e-9)


# ------------------------------------------------------------------------- rounds, and the flight


def test_labels_are_the_errors_of_networks_where_the_drone_is(trained, result):
    first = result.stages[0]
    s, choices = np.zeros((3, 20, 1)), np.arange(20) % 3
    labelled = learning.label_landings(
        result.landing, first.skill, "measurement", choices, np.random.default_rng(1), s
    )
    seed = int(np.random.default_rng(1).integers(2**32))
    altitude, cost, errors = fly_by_sight(
        result.landing, trained.networks, "measurement", s, choices, seed
    )
    known = len(first.skill.pictures.altitude)
    new = labelled.error[:, known:].reshape(3, 3, 20)
    np.testing.assert_allclose(new[choices, :, np.arange(20)].T, errors[..., 0], atol=1e-9)
    np.testing.assert_allclose(labelled.altitude[known:], altitude[:, :-1].ravel())
    np.testing.assert_array_equal(labelled.planned[known:], np.tile(result.landing.path[:-1], 3))
    assert np.bincount(labelled.group)[-3:].tolist() == [20, 20, 20]
    again = fly_by_sight(
        result.landing, trained.networks, "measurement", s, choices, seed, label=trained.networks
    )
    np.testing.assert_allclose(again[1], cost)  # to be labelled changes no flight


def states(recorded):
    """What identifies a stream: where it stood when it was first handed over."""
    return [str(rng.bit_generator.state["state"]) for rng in recorded]


def test_training_knows_nothing_of_what_its_pictures_are_judged_by(trained, monkeypatch):
    """Training, the fit, the rounds, scenes and noise draw from streams of their own."""
    seen = []

    def noting(where, name, at):
        old = getattr(where, name)

        def noted(*args, **options):
            seen.extend(states([args[at] if at else options["rng"]]))
            return old(*args, **options)

        monkeypatch.setattr(where, name, noted)

    monkeypatch.setattr(landing.perception, "train_models", lambda rng, **_: seen.append(rng))
    learn(0)
    seen[:] = states(seen)
    noting(landing, "fit_landing", 0)
    noting(sight, "draw_scenes", 1)
    noting(sight, "photograph", 3)
    run = run_experiment(Settings(**CHOSEN | {"horizon": 3, "rounds": 1}), trained=trained)
    inputs = np.random.default_rng(0).spawn(2)[1:]
    fly_by_sight(run.landing, trained.networks, "measurement", np.zeros((2, 3, 1)), [0, 1, 2], 0)
    known = [*seen, *states(inputs)]
    shots = {known.index(each) for each in known}  # the networks of one step share its noise
    assert len(shots) == 1 + 2 + 2 + 2 * 3 + 1  # training, fits, scenes, noise, inputs


def test_the_camera_sees_altitude_and_pitch_not_their_rates():
    aircraft = landing.preset("textbook", 4)

    def seen(state):
        altitude, shoot = sight._viewer(aircraft, 1, 0)(0, np.array([state], dtype=float))
        return altitude[0], shoot(16)

    height, still = seen([0, 0, 0, 0])
    for k, changed in enumerate((True, False, True, False)):
        altitude, picture = seen(0.2 * np.eye(4)[k])
        assert (altitude != height) == (k == 0) and (picture != still).any() == changed
    for beyond in (MOST_PITCH, 2 * MOST_PITCH):  # as far as its mount turns
        np.testing.assert_array_equal(seen([0, 0, beyond, 0])[1], seen([0, 0, 9.0, 0])[1])


@pytest.mark.no_cover
def test_rounds_label_the_same_landings_whatever_is_fitted(trained):
    """The first look is from the same place at the same scene: errors of the same sight."""
    looks = []
    for changes in ({}, {"fit": "bins"}, {"calibrate": True}):
        settings = Settings(**CHOSEN | {"rounds": 1} | changes)
        seen = run_experiment(settings, trained=trained).stages[-1].skill.pictures
        looks.append(seen.error[:, seen.altitude.size - 400 :: 20])
    np.testing.assert_array_equal(looks[0], looks[1])
    np.testing.assert_array_equal(looks[0], looks[2])


def test_the_stage_table_flies_through_errors_that_know_nothing_of_the_inputs(trained, monkeypatch):
    """Their streams are those of a run: inputs, Gaussian errors, and a fifth for the bootstrap."""
    pytest.importorskip("joblib", reason="of the extra benchmarks")
    monkeypatch.syspath_prepend(str(Path(__file__).resolve().parents[1] / "benchmarks"))
    import stages

    run = Settings(**CHOSEN | {"horizon": 6})
    row, result = stages.measured(run, trained, 30), run_experiment(run, trained=trained)
    _, inputs, normal, _, drawn = np.random.default_rng(0).spawn(5)
    s, choices = result.landing.draw_inputs(inputs, 30), result.optimal.choices
    errors = {"Gaussian": sample_errors(result.suite, 30, normal)}
    given = result.stages[-1].skill.seen, result.landing.path[:-1], 30, drawn, None
    errors["bootstrap"] = pooling.redraw(*given)
    for name, e in errors.items():
        cost, ideal = (fly(result.landing, "measurement", s, e, c)[1] for c in (choices, None))
        assert row[name] == pytest.approx((cost - ideal).mean())


def test_regret_of_labels_is_the_quadratic_of_loops():
    rng = np.random.default_rng(8)
    error, Psi, choices = rng.normal(size=(2, 3 + 4 * 5)), rng.normal(size=(5, 5)), [0, 1, 1, 0, 1]
    seen = pooling.Labelled(np.zeros(23), error, np.zeros(23, int), np.zeros(23))
    found = learning.regret_of_labels(seen, 3, Psi, np.array(choices))
    for n in range(4):
        e = [error[w, 3 + 5 * n + step] for step, w in enumerate(choices)]
        expected = sum(e[i] * Psi[i, j] * e[j] for i in range(5) for j in range(5))
        assert found[n] == pytest.approx(expected)


def test_stages_learn_one_after_the_other_at_the_same_price(result, trained):
    assert [stage.name for stage in result.stages] == ["kernel", "calibrated", "round 1", "round 2"]
    held_out = len(trained.residuals.residual) // 3
    sizes = [len(stage.skill.pictures.altitude) for stage in result.stages]
    assert np.diff(sizes).tolist() == [0, 400, 400] and sizes[0] == held_out
    for stage in result.stages:
        np.testing.assert_array_equal(stage.suite.cost, result.suite.cost)
        assert stage.optimal.is_optimal
        ms.check_certificate(stage.problem, stage.optimal)
    assert result.optimal is result.stages[-1].optimal
    plain = run_experiment(replace(result.settings, calibrate=False, rounds=0), trained=trained)
    np.testing.assert_array_equal(plain.suite.mean, result.stages[0].suite.mean)
    again = run_experiment(replace(result.settings, upsilon=None), trained=trained)
    np.testing.assert_array_equal(again.suite.mean, result.suite.mean)


def test_flown_stages_are_flights_of_each_schedule_by_what_then_reads(result):
    found = fly_stages(result)
    assert list(found) == [stage.name for stage in result.stages]
    s = result.landing.draw_inputs(np.random.default_rng(0).spawn(2)[1], 4)
    for stage, flown in zip(result.stages, found.values(), strict=True):
        given = (result.landing, stage.skill.readers, "measurement", s)
        cost = fly_by_sight(*given, stage.optimal.choices, 0)[1]
        ideal = fly(result.landing, "measurement", s, np.zeros((4, 20, 1, 1)), None)[1]
        np.testing.assert_allclose(flown.lost["Optimal"], cost - ideal)
        paid = stage.problem.beta * stage.problem.perception_term(stage.optimal.choices)
        np.testing.assert_allclose(flown.totals["Optimal"], 0.6 * (cost - ideal) + paid)
        assert flown.promised == pytest.approx(stage.problem.control_term(stage.optimal.choices))
    assert [len(each.labelled) for each in found.values()] == [0, 0, 20, 40]


def test_the_file_of_results_has_a_row_for_every_stage(result):
    flown = fly_stages(result)
    rows = landing.summary(replace(result, flown=flown))["stages"]
    assert list(rows) == [stage.name for stage in result.stages]
    for stage, row in rows.items():
        for policy in ("Optimal", "Best Single", "Greedy"):
            assert row[policy]["regret"][0] == pytest.approx(flown[stage].lost[policy].mean())
            assert row[policy]["total"][0] == pytest.approx(flown[stage].totals[policy].mean())
        assert row["Greedy"]["optimal below"] == [0, 0]  # without a forecast steps decouple
    assert "stages" not in landing.summary(result)
    alone = landing.summary(replace(result, flown=fly_stages(result, 1)))["stages"]["kernel"]
    assert alone["Optimal"]["total"][1] is None and alone["Greedy"]["optimal below"][1] is None


def test_a_forecast_is_no_flight_by_sight(trained):
    run = run_experiment(Settings(**CHOSEN | {"information": "preview"}), trained=trained)
    assert "Optimal at every stage" not in landing.report_pictures(run)
    with pytest.raises(ValueError, match="found 'preview'"):
        fly_stages(run)


def test_networks_that_an_experiment_does_not_use_do_not_fly(trained):
    run = run_experiment(Settings(horizon=5, trials=2), trained=trained)
    for fails in (fly_stages, landing.report_pictures):
        with pytest.raises(ValueError, match="result: expected one of experiment trained"):
            fails(run)


def test_leads_are_paired_shares():
    totals = {"Optimal": np.array([1.0, 2, 3]), "Greedy": np.array([3.0, 5, 4])}
    lead, half = leads(totals)["Greedy"]
    assert lead == pytest.approx(2 / 4)
    spread = np.std([0.5, 0.5, -1], ddof=1)  # of [2, 3, 1] - [3, 5, 4] / 2
    assert half == pytest.approx(student.ppf(0.975, 2) * spread / np.sqrt(3) / 4)


@pytest.mark.unmutated
@pytest.mark.parametrize("keeps", [1.0, 0.85])
def test_intervals_of_leads_hold_the_share_as_often_as_they_say(keeps):
    """Whether Optimal is lower by a constant, a share of what varies, or by a factor."""
    rng, held = np.random.default_rng(11), 0
    for _ in range(1000):
        total = rng.exponential(size=400) + 1
        best = keeps * total + 0.02 * rng.normal(size=400) - 0.3 * (keeps == 1)
        lead, half = leads({"Optimal": best, "Greedy": total})["Greedy"]
        held += abs(lead - 0.15) <= half
    assert abs(held / 1000 - 0.95) < 4 * np.sqrt(0.95 * 0.05 / 1000)


@pytest.mark.parametrize("best", [-10.0, -2.0])
def test_a_lead_is_one_where_the_other_total_is_negative(best):
    """A single flight may gain by errors: who gains more leads all the same."""
    totals = {"Optimal": np.array([best]), "Greedy": np.array([-5.0])}
    assert leads(totals)["Greedy"][0] == pytest.approx((-5 - best) / 5)


def test_the_report_shows_every_stage(result):
    text = landing.report_pictures(result)
    table = text.partition("Optimal at every stage")[2].splitlines()[2:]
    assert [line.split()[0] for line in table[:2]] == ["kernel", "calibrated"]
    promised = result.stages[0].problem.control_term(result.stages[0].optimal.choices)
    assert float(table[0].split()[1]) == pytest.approx(promised, abs=0.06)


def test_the_figure_shows_estimates_of_every_stage(result):
    with pytest.raises(ValueError, match="fly_stages"):
        landing.plot_stages(result)
    flown = fly_stages(result)
    figure = landing.plot_stages(replace(result, flown=flown))
    for axes, kind in zip(figure.axes, ("lost", "totals"), strict=True):
        assert [text.get_text() for text in axes.get_xticklabels()] == list(flown)
        drawn = {c.get_label(): c.lines[0].get_ydata() for c in axes.containers}
        assert list(drawn) == ["Optimal", "Best Single", "Greedy"]
        for policy, heights in drawn.items():
            means = [getattr(each, kind)[policy].mean() for each in flown.values()]
            np.testing.assert_allclose(heights, means)
    promised = figure.axes[0].lines[0].get_ydata()
    np.testing.assert_allclose(promised, [each.promised for each in flown.values()])
    figure.draw_without_rendering()
    (legend,) = figure.legends  # beside the panels: inside it could hide a promise
    assert not any(legend.get_window_extent().overlaps(axes.bbox) for axes in figure.axes)
    plt.close(figure)


# ------------------------------------------------------------------------------------- the filter


def test_gains_are_those_of_the_recursion_with_the_median_error_of_each_step(result):
    aircraft, suite = result.landing, result.suite
    assert gains_for(aircraft, "measurement", suite) is None
    gains = gains_for(aircraft, "filter", suite)
    A, C = aircraft.task.A, aircraft.task.C
    push = 0.09 * (C @ C.T + 1e-4 * np.eye(4))
    sees, P = np.linalg.pinv(C), np.zeros((4, 4))
    for step in range(20):
        squares = suite.mean[step, :, 0] ** 2 + suite.variance[step, :, 0]
        gain = P @ sees.T / (sees @ P @ sees.T + sorted(squares)[1])
        np.testing.assert_allclose(gains[step], gain, rtol=1e-8, atol=1e-12)
        P = A @ (np.eye(4) - gain @ sees) @ P @ A.T + push


@pytest.mark.parametrize(("preset", "horizon"), [("textbook", 12), ("published", 150)])
def test_a_filter_flies_as_its_table_promises(preset, horizon):
    """In the mean, and with the errors that the table describes."""
    chosen = {"preset": preset, "information": "filter", "horizon": horizon, "trials": 1}
    run = run_experiment(Settings(**chosen))
    gains, rng = run.stages[-1].gains, np.random.default_rng(3)
    s, errors = np.zeros((600, horizon, 1)), sample_errors(run.suite, 600, rng)
    regret = fly(run.landing, "filter", s, errors, run.optimal.choices, gains)[1]
    regret -= fly(run.landing, "filter", s, errors, None, gains)[1]
    promised = run.problem.control_term(run.optimal.choices)
    assert abs(regret.mean() - promised) <= 5 * regret.std() / np.sqrt(600)


def test_a_filter_lands_by_sight(trained):
    settings = Settings(**CHOSEN | {"information": "filter", "rounds": 1, "trials": 2})
    run = run_experiment(settings, trained=trained)
    flown = fly_stages(run, 6)
    assert list(flown) == ["kernel", "round 1"]
    assert all(np.isfinite(each.totals["Optimal"]).all() for each in flown.values())
    assert run.stages[-1].gains.shape == (20, 4, 1)


@pytest.mark.parametrize(
    ("settings", "start"),
    [
        ({"fit": "bins"}, "fit: of experiment trained, found 'simulated'"),
        ({"calibrate": True}, "calibrate: of experiment trained, found"),
        ({"rounds": 1}, "rounds: of experiment trained, found"),
        (CHOSEN | {"calibrate": 1}, "calibrate: expected True or False, found 1"),
        (CHOSEN | {"fit": "spline"}, "fit: expected one of kernel, bins, found 'spline'"),
        (CHOSEN | {"rounds": 1, "information": "preview"}, "rounds: a flight has no forecast"),
    ],
)
def test_settings_refuse(settings, start):
    with pytest.raises(ValueError) as caught:
        Settings(**settings)
    assert str(caught.value).startswith(start)


def test_the_stage_table_is_the_same_whatever_the_number_of_processes(tmp_path):
    script = Path(__file__).resolve().parents[1] / "benchmarks" / "stages.py"
    pytest.importorskip("joblib", reason="of the extra benchmarks")
    written = []
    for jobs in ("1", "2"):
        out = tmp_path / jobs
        command = [sys.executable, script, "--quick", "--jobs", jobs, "--output", out]
        subprocess.run(command, check=True, capture_output=True, timeout=100)
        written.append((out / "stages.csv").read_text(encoding="utf-8"))
    assert written[0] == written[1]
    text = (out / "stages.md").read_text(encoding="utf-8")
    for stage in ("bins", "kernel", "calibrated", "on-policy", "filter"):
        assert f"\n| {stage} | " in text
    assert (out / "stages.png").exists()
