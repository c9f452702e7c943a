"""The landing experiments, held to the published numbers, to first principles and to roll-outs."""

import csv
import io
import json
import math
import re
import statistics
import subprocess
import sys
from contextlib import chdir, redirect_stderr, redirect_stdout
from dataclasses import replace
from itertools import pairwise, product
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import pytest
from matplotlib.colors import LogNorm
from scipy.linalg import expm, logm

import landing
from landing import (
    PRESETS,
    Settings,
    fly,
    main,
    pareto,
    percentages,
    preset,
    report,
    run_experiment,
    summary,
)
from modelselect import (
    INFORMATION,
    PATTERNS,
    ControlTask,
    SelectionProblem,
    check_certificate,
    control_cost,
    psi,
    run_controller,
    solve,
)
from modelselect_parts.tables import undecided
from perception import EFFICIENTNET, PerceptionSuite, sample_errors

from strategies import dense_flight, plain_cost

POLICIES = [
    *("Oracle", "Clairvoyant", "Optimal", "Best Single"),
    *("Greedy", "Random", "All Large", "All Small"),
]
FEASIBLE = POLICIES[2:]
SMALL = {"horizon": 12, "trials": 8}
FIGURES = {"schedule", "costs", "rewards", "pareto", "landing", "efficientnet", "psi"}


@pytest.fixture(scope="module")
def published():
    """The published experiment as `python landing.py` runs it."""
    return run_experiment()


@pytest.fixture(scope="module", params=list(PRESETS))
def small(request):
    return run_experiment(Settings(preset=request.param, **SMALL))


# ------------------------------------------------------------------------------ the two aircraft


def test_published_control_cost_without_inputs_is_that_of_the_log():
    aircraft = preset("published")
    s = np.zeros((150, 1))
    x, u = run_controller(aircraft.task, aircraft.x0, s, s)
    assert f"{control_cost(aircraft.task, x, u):.6e}" == "5.189117e+15"


def test_published_dynamics_are_eulers_of_the_published_coefficients():
    task, dt = preset("published").task, 0.01
    K, T, z, w, V = -0.95, 2.5, 0.5, 1.0, 20.0
    a42 = 1 / (V * T) - 2 * z * w / (V * T) + w**2 / V
    rows = [
        [0, 1, 0, 0],
        [0, 1 / T, V / T, 0],
        [0, 0, 0, 1],
        [0, a42, 2 * z * w / T - w**2 - 1 / T**2, 1 / T - 2 * z * w],
    ]
    np.testing.assert_allclose((task.A - np.eye(4)) / dt, rows, rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(task.B.ravel() / dt, [0, 0, 0, w**2 / K], rtol=1e-12)
    np.testing.assert_array_equal(task.C.ravel(), [0, 0, 1, 0])


@pytest.mark.parametrize("horizon", [150, 40])
def test_textbook_dynamics_are_ellert_and_merriams_held_exactly(horizon):
    aircraft = preset("textbook", horizon)
    assert aircraft.dt == 20 / horizon
    rows = [[0, 1, 0, 0], [0, -0.4, 102.4, 0], [0, 0, 0, 1], [0, 0.00296875, -0.76, -0.6]]
    F, G = np.array(rows), np.array([[0], [0], [0], [-2.375]])
    np.testing.assert_allclose(logm(aircraft.task.A).real / aircraft.dt, F, atol=1e-7)
    held = expm(np.block([[F, G], [np.zeros((1, 5))]]) * aircraft.dt)
    np.testing.assert_allclose(aircraft.task.B, held[:4, 4:], rtol=1e-9, atol=1e-12)


def test_weights_and_starts_are_those_of_the_sources():
    published, textbook = (preset(name).task for name in ("published", "textbook"))
    for task, Q, R in ((published, [1e8, 1, 1e8, 1], 1), (textbook, [1, 1, 100, 100], 10)):
        assert task.Q.tolist() == task.Q_final.tolist() == np.diag(Q).tolist()
        assert task.R.tolist() == [[R]] and task.horizon == 150
    assert textbook.C.ravel().tolist() == [1, 0, 0, 0]
    assert preset("published").x0.tolist() == [1000, 2, 2, 0.2]
    assert preset("textbook").x0.tolist() == [5, 0, 0, 0]


def test_textbook_flies_down_the_glide_path():
    path = preset("textbook").path
    seconds = np.linspace(0, 20, 151)
    np.testing.assert_allclose(path[seconds < 14.9], 100 * np.exp(-seconds[seconds < 14.9] / 5))
    np.testing.assert_allclose(path[seconds > 15.1], 20 - seconds[seconds > 15.1], atol=1e-12)


@pytest.mark.parametrize("name", PRESETS)
def test_inputs_have_the_mean_that_a_causal_controller_is_told(name):
    aircraft = preset(name, 5)
    s = aircraft.draw_inputs(np.random.default_rng(1), 20_000)
    assert s.shape == (20_000, 5, 1)
    error = s.std(axis=0) / np.sqrt(len(s))
    assert np.all(np.abs(s.mean(axis=0) - aircraft.prior_mean) < 5 * error)


@pytest.mark.parametrize("information", INFORMATION)
def test_textbook_price_follows_the_rule_whatever_the_weights(information):
    runs = [
        run_experiment(Settings("simulated", "textbook", information, 20, 1, alpha, beta))
        for alpha, beta in ((0.8, 0.2), (0.3, 5.0))
    ]
    upsilon = runs[0].settings.upsilon
    assert upsilon == runs[1].settings.upsilon > 0
    harm = runs[0].problem.control_term(np.zeros(20))
    assert 0.2 * upsilon * 7 * 20 == pytest.approx(0.2 * 0.8 * harm, rel=1e-12)
    np.testing.assert_allclose(runs[0].suite.cost, upsilon * np.arange(8), rtol=1e-12)
    over = run_experiment(Settings("simulated", "textbook", information, 20, 1, upsilon=3.5))
    assert over.settings.upsilon == 3.5 and over.suite.cost[7] == 24.5


def test_the_price_of_two_models_by_hand():
    # All Small, errors 1 and 2: 1 + 2 * 2 + 2 * 4 = 13, and variances 0.5 + 2 * 2: 17.5 in all.
    mean, variance = [[[1], [0]], [[2], [0]]], [[[0.5], [9]], [[2], [9]]]
    suite = PerceptionSuite(["small", "large"], mean, variance, [0, 1])
    found = landing.cost_scale(np.array([[1.0, 1], [1, 2]]), suite)
    assert found == pytest.approx(0.2 * 0.8 * 17.5 / (0.2 * 1 * 2), rel=1e-14)


# ----------------------------------------------------------------------- the published experiment


@pytest.mark.no_cover
def test_published_run_matches_the_log(published):
    means, log = published.means(), landing.published_log(published.settings)
    for policy, tolerance in (("All Small", 0.2), ("All Large", 0.005), ("Oracle", 1e-5)):
        assert means[policy][0] == pytest.approx(log[policy][0], rel=tolerance)
    assert means["All Large"][1] == log["All Large"][1] == 1.05e17


def test_the_log_stands_beside_a_run_whose_budget_never_binds():
    most = 7 * 150 * 1e14  # the largest model throughout
    settings = [Settings(upsilon=1e14, budget=budget) for budget in (None, most, 0.9 * most)]
    free, just, bound = (landing.published_log(each) for each in settings)
    assert free and just.keys() == free.keys() and not bound


@pytest.fixture(scope="module")
def twenty_suites():
    """Mean control costs (20, 2) of All Small and All Large, for 20 suites that are not seed 0."""
    aircraft, costs = preset("published"), []
    for seed in range(1, 21):
        rng = np.random.default_rng(seed)
        suite, s = aircraft.draw_suite(rng), aircraft.draw_inputs(rng, 20)
        errors = sample_errors(suite, 20, rng)
        flown = (fly(aircraft, "open_loop", s, errors, np.full(150, w)) for w in (0, 7))
        costs.append([cost.mean() for _, cost in flown])
    return np.array(costs)


def expected_over_suites(aircraft, models):
    """E over suites of the control cost of the smallest of some models that are left.

    A model's mean is a sum of U(0, x), independent over steps: J(u*) + m^2 1'Psi 1 + v tr(Psi),
    m = sum x / 2, and v = sum x^2 / 12 plus the expected variance of the error.
    """
    Psi, s = psi(aircraft.task), np.zeros((150, 1))
    base = control_cost(aircraft.task, *run_controller(aircraft.task, aircraft.x0, s, s))
    x = np.array([0.05, 0.1, 1, 4, 8, 12, 16, 16])[:models]
    noise = np.array([0.3, 0.06, 0.08, 0.01, 0.02, 0.02, 0.03, 0.03])[:models]
    spread = (x**2).sum() / 12 + noise.sum() / 2
    return base + (x.sum() / 2) ** 2 * Psi.sum() + spread * np.trace(Psi)


def test_mean_over_twenty_suites_is_that_of_the_published_generator(twenty_suites):
    error = twenty_suites.std(axis=0, ddof=1) / np.sqrt(20)
    mean = twenty_suites.mean(axis=0)
    assert np.all(np.abs(mean - (4.93e17, 5.1907e15)) <= 2 * error)
    exact = [expected_over_suites(preset("published"), models) for models in (8, 1)]
    assert np.all(np.abs(mean - exact) <= 2 * error)
    assert exact == pytest.approx([4.93e17, 5.1907e15], rel=5e-3)


def test_optimal_is_proved_and_beats_every_feasible_policy(published):
    optimal, rewards = published.optimal, published.flights
    assert optimal.is_optimal and 0 <= optimal.gap <= 1e-9
    check_certificate(published.problem, optimal)
    for policy in FEASIBLE[1:]:
        gains = rewards["Optimal"].reward - rewards[policy].reward
        assert gains.mean() > 5 * gains.std() / 10, policy


def test_claims_of_the_text_about_the_published_experiment(published):
    assert 7 not in published.optimal.choices  # "b7 was never invoked"
    assert np.all(np.diff(np.abs(published.suite.mean), axis=1) <= 0)
    assert np.all(np.diff(published.suite.variance, axis=1) <= 0)


@pytest.mark.parametrize(
    ("offset", "quantity", "new", "old", "percent"),
    [
        (1, "control_cost", "Random", "Optimal", 567.38),
        (1, "control_cost", "Optimal", "Random", -85.0),
        (1, "perception_cost", "All Large", "Random", 80.72),
        (0, "perception_cost", "All Large", "Random", 104.3),
        (1, "perception_cost", "Optimal", "Random", -5.4),
        (0, "perception_cost", "Optimal", "Random", -7.0),
        (1, "reward", "All Large", "Optimal", -53.01),
        (1, "reward", "Oracle", "Optimal", 77.4),
    ],
)
def test_what_the_printed_percentages_are(offset, quantity, new, old, percent):
    log = landing.published_log(Settings(upsilon=1e14), offset)
    q = landing.QUANTITIES.index(quantity)
    change = 100 * (log[new][q] - log[old][q]) / abs(log[old][q])
    assert change == pytest.approx(percent, abs=0.06)


def test_logged_rewards_are_those_that_the_authors_print():
    log = landing.published_log(Settings(upsilon=1e14), offset=1)
    printed = {
        "Oracle": -4.151294e15,
        "Optimal": -1.839953e16,
        "Random": -5.225213e16,
        "All Large": -2.815228e16,
        "All Small": -3.962407e17,
    }
    for policy, reward in printed.items():
        assert log[policy][2] == pytest.approx(reward, rel=1e-6)


def test_log_stands_only_beside_the_settings_it_belongs_to(published):
    assert report(published).count("published") == 5
    assert any(row["what the paper prints"] == "567.18% lower" for row in percentages(published))
    for other in (
        *({"preset": "textbook"}, {"information": "preview"}, {"horizon": 149}),
        *({"alpha": 0.5}, {"beta": 0.3}, {"upsilon": 2e14}),
    ):
        assert not landing.published_log(Settings(**{"upsilon": 1e14, **other}))
    assert landing.published_log(Settings(upsilon=1e14, trials=3, seed=9))


# ------------------------------------------------------------------------- policies and trials


@pytest.mark.no_cover
@pytest.mark.parametrize("horizon", [1, 2, 30])
@pytest.mark.parametrize("information", INFORMATION)
@pytest.mark.parametrize("name", PRESETS)
def test_flown_costs_agree_with_the_problem(name, information, horizon):
    """Psi, the expected cost and the controllers, together: flown, not computed."""
    exact = information in ("open_loop", "preview")
    trials = 20 if exact else 400  # the uncoupled ones are quick to solve for Clairvoyant
    run = run_experiment(Settings("simulated", name, information, horizon, trials))
    errors = sample_errors(run.suite, trials, np.random.default_rng(0).spawn(4)[2])
    ideal = run.flights["Oracle"].control_cost
    for policy in FEASIBLE:
        choices, _, control, perception, reward = run.flights[policy]
        regret, expected = control - ideal, run.problem.control_term(choices)
        rounding = 1e-12 * ideal.mean()
        error = regret.std(ddof=1) / np.sqrt(trials) + rounding
        assert abs(regret.mean() - expected) <= 5 * error, policy
        if exact:
            e = errors[:, np.arange(horizon), choices, 0]
            computed = np.einsum("ki,ij,kj->k", e, run.problem.psi, e)
            np.testing.assert_allclose(regret, computed, rtol=1e-6, atol=20 * rounding)
        assert np.all(perception == run.problem.perception_term(choices))
        np.testing.assert_allclose(reward, -0.8 * control - 0.2 * perception)


@pytest.mark.parametrize("information", INFORMATION)
@pytest.mark.parametrize("name", PRESETS)
def test_trials_are_those_of_a_robot_that_plans_anew_by_dense_algebra(name, information):
    aircraft, rng = preset(name, 5), np.random.default_rng(2)
    s = aircraft.draw_inputs(rng, 3)
    errors, own = rng.normal(size=(3, 5, 8, 1)), rng.integers(8, size=(3, 5))
    for choices in (None, own[0], own):
        altitude, cost = fly(aircraft, information, s, errors, choices)
        for k in range(3):
            c = None if choices is None else choices[k] if choices.ndim == 2 else choices
            e = 0 * s[k] if c is None else np.array([errors[k, t, c[t]] for t in range(5)])
            x0, prior = aircraft.x0, aircraft.prior_mean
            x, u = dense_flight(aircraft.task, x0, s[k], s[k] + e, information, prior)
            expected = [height + state[0] for height, state in zip(aircraft.path, x, strict=True)]
            np.testing.assert_allclose(altitude[k], expected, rtol=1e-9)
            assert cost[k] == pytest.approx(plain_cost(aircraft.task, x, u), rel=1e-9)


@pytest.mark.parametrize("information", ["open_loop", "preview"])
@pytest.mark.parametrize("name", PRESETS)
def test_clairvoyant_is_best_in_every_single_trial(name, information):
    run = run_experiment(Settings("simulated", name, information, 20, 10))
    best = run.flights["Clairvoyant"].reward
    for policy in FEASIBLE:
        reward = run.flights[policy].reward
        assert np.all(best >= reward - 1e-9 * np.abs(reward)), policy


def test_clairvoyant_solves_each_trial_on_its_own_errors():
    run = run_experiment(Settings(preset="textbook", horizon=4, trials=5, seed=3))
    streams = np.random.default_rng(3).spawn(4)
    errors = sample_errors(run.suite, 5, streams[2])
    for e, choices in zip(errors, run.flights["Clairvoyant"].choices, strict=True):
        known = SelectionProblem(run.problem.psi, e, np.zeros_like(e), run.suite.cost, 0.8, 0.2)
        schedules = np.array(list(product(range(8), repeat=4)))
        assert known.total_cost(choices) == pytest.approx(known.total_cost(schedules).min())


def test_schedules_of_the_simple_policies(small):
    flown, problem = small.flights, small.problem
    assert list(flown) == POLICIES
    assert np.all(flown["All Small"].choices == 0) and np.all(flown["All Large"].choices == 7)
    totals = [problem.total_cost(np.full(12, w)) for w in range(8)]
    assert np.all(flown["Best Single"].choices == np.argmin(totals))
    assert flown["Random"].choices.shape == (12,)  # one schedule for all trials
    for t, w in enumerate(flown["Greedy"].choices):
        alone = [
            0.8 * problem.psi[t, t] * (problem.mean[t, i, 0] ** 2 + problem.variance[t, i, 0])
            + 0.2 * problem.model_cost[i]
            for i in range(8)
        ]
        assert w == np.argmin(alone)
    assert flown["Oracle"].choices is None and np.all(flown["Oracle"].perception_cost == 0)


def test_separable_patterns_make_greedy_optimal():
    for information in ("causal", "measurement"):
        run = run_experiment(Settings("simulated", "textbook", information, **SMALL))
        np.testing.assert_array_equal(run.flights["Greedy"].choices, run.flights["Optimal"].choices)


def test_trials_meet_the_same_errors_and_more_trials_keep_the_first():
    few, many = (run_experiment(Settings(horizon=12, trials=n)) for n in (3, 6))
    np.testing.assert_array_equal(few.problem.mean, many.problem.mean)
    for policy in POLICIES:
        first = many.flights[policy].control_cost[:3]
        np.testing.assert_allclose(few.flights[policy].control_cost, first, rtol=1e-12)


def test_altitude_starts_where_the_aircraft_does(small):
    start = {"published": 1000, "textbook": 105}[small.settings.preset]
    for flown in small.flights.values():
        assert flown.altitude.shape == (8, 13) and np.all(flown.altitude[:, 0] == start)


@pytest.mark.no_cover
@pytest.mark.parametrize("weights", [(0, 0.2), (0.8, 0), (0, 0)])
def test_zero_weights(weights):
    run = run_experiment(Settings(alpha=weights[0], beta=weights[1], horizon=12, trials=3))
    means = run.means()
    assert max(means[policy][2] for policy in FEASIBLE) == means["Optimal"][2]
    assert run.optimal.gap <= 1e-9
    if weights[0] == 0 < weights[1]:
        assert np.all(run.optimal.choices == 0)
    assert "nan" not in report(run)


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        (
            {"experiment": "no"},
            "experiment: expected one of simulated, trained, measured, found 'no'",
        ),
        ({"preset": "no"}, "preset: expected one of published, textbook, found 'no'"),
        ({"information": "no"}, "information: expected one of open_loop, preview, causal"),
        ({"horizon": 0}, "horizon: expected an integer >= 1, found 0"),
        ({"horizon": 1.5}, "horizon: expected an integer >= 1, found 1.5"),
        ({"trials": 0}, "trials: expected an integer >= 1, found 0"),
        ({"seed": -1}, "seed: expected an integer >= 0, found -1"),
        ({"alpha": -1}, "alpha: expected a number >= 0, found -1"),
        ({"alpha": None}, "alpha: expected"),
        ({"beta": np.nan}, "beta: expected"),
        ({"upsilon": np.inf}, "upsilon: expected"),
        ({"switch_cost": -1}, "switch_cost: expected a number >= 0, found -1"),
        ({"switch_cost": None}, "switch_cost: expected"),
        ({"budget": -1}, "budget: expected a number >= 0, found -1"),
        ({"budget": np.nan}, "budget: expected"),
    ],
)
def test_settings_are_checked(setting, message):
    with pytest.raises(ValueError) as caught:
        Settings(**setting)
    assert str(caught.value).startswith(message)


def test_preset_is_checked():
    with pytest.raises(ValueError, match="preset: expected one of published, textbook"):
        preset("no")
    with pytest.raises(ValueError, match="horizon: expected an integer >= 1"):
        preset("published", 0)


# ----------------------------------------------------------------- switching costs and a budget


def small_problem(seed, **limits):
    """Four steps, three models of prices 0, 1 and 2.5, at random."""
    rng = np.random.default_rng(seed)
    root, mean = rng.normal(size=(4, 4)), rng.normal(size=(4, 3, 1))
    return SelectionProblem(root @ root.T, mean, mean**2 / 4, [0, 1, 2.5], 0.8, 0.2, **limits)


def spending(problem, choices):
    """What a schedule spends, in plain sums."""
    price, switch = problem.model_cost, problem.switch_cost
    paid = sum(price[w] for w in choices)
    return paid + (0 if switch is None else sum(switch[v, w] for v, w in pairwise(choices)))


def payable(problem, begun):
    """The models after which some way on, of all that there are, stays within the budget."""
    ways = product(range(3), repeat=3 - len(begun))
    spent = {way: [spending(problem, (*begun, w, *way)) for w in range(3)] for way in ways}
    return [w for w in range(3) if min(s[w] for s in spent.values()) <= problem.budget + 1e-9]


def cost_alone(problem, t, before, w):
    """What model w costs at step t after the models `before`, coupling ignored."""
    felt = problem.mean[t, w, 0] ** 2 + problem.variance[t, w, 0]
    move = problem.switch_cost[before[-1], w] if before else 0
    return 0.8 * problem.psi[t, t] * felt + 0.2 * (problem.model_cost[w] + move)


SWITCHES = np.array([[0, 0.4, 1], [0.1, 0, 0.7], [0.2, 3, 0]])


@pytest.mark.no_cover
@pytest.mark.parametrize("seed", range(20))
@pytest.mark.parametrize("budget", [0.0, 1.3, 2.0, 4.4, 7.0])
def test_every_policy_keeps_the_budget_and_none_is_below_the_optimum(seed, budget):
    problem = small_problem(seed, switch_cost=SWITCHES, budget=budget)
    best, rng = solve(problem), np.random.default_rng(seed)
    errors = rng.normal(size=(2, 4, 3, 1))
    found = landing.policies(problem, best.choices, errors, rng)
    assert best.is_optimal and found.pop("Oracle") is None
    for policy, schedules in found.items():
        for c in np.atleast_2d(schedules):
            assert spending(problem, c) <= budget + 1e-9, policy
            assert problem.total_cost(c) >= best.lower_bound - 1e-12, policy
    constants = {w: problem.total_cost([w] * 4) for w in range(3) if [0, 4, 10][w] <= budget}
    assert found["Best Single"].tolist() == [min(constants, key=constants.get)] * 4
    assert ("All Large" in found) == (2 in constants) and "All Small" in found
    begun = []
    for t, w in enumerate(found["Greedy"]):
        assert w == min(payable(problem, begun), key=lambda v: cost_alone(problem, t, begun, v))
        begun.append(w)


def test_random_draws_evenly_among_the_models_that_can_be_afforded():
    problem = small_problem(0, switch_cost=SWITCHES, budget=3.2)
    rng, counts = np.random.default_rng(1), {}
    for _ in range(3000):
        c = tuple(landing.policies(problem, [0] * 4, [], rng)["Random"].tolist())
        counts[c] = counts.get(c, 0) + 1
    chances = {}
    for c in product(range(3), repeat=4):
        shares = [(c[t] in left) / len(left) for t in range(4) if (left := payable(problem, c[:t]))]
        chances[c] = math.prod(shares)
    assert sum(chances.values()) == pytest.approx(1)
    for c, chance in chances.items():
        assert abs(counts.get(c, 0) - 3000 * chance) <= 5 * (3000 * chance * (1 - chance)) ** 0.5


def test_where_no_constant_schedule_is_affordable_there_is_none():
    mean = np.ones((2, 2, 1))
    problem = SelectionProblem(np.eye(2), mean, mean, [[0, 5], [5, 0]], budget=1.0)
    found = landing.policies(problem, [0, 1], [], np.random.default_rng(0))
    assert list(found) == ["Oracle", "Clairvoyant", "Optimal", "Greedy", "Random"]
    assert found["Greedy"].tolist() == found["Random"].tolist() == [0, 1]


def test_a_model_that_is_missing_is_not_drawn():
    mean = np.ones((6, 3, 1))
    problem = SelectionProblem(np.eye(6), mean, mean, [0, np.inf, 1])
    found = landing.policies(problem, [0] * 6, [], np.random.default_rng(0))
    assert set(found["Random"].tolist()) == {0, 2}
    assert set(found["Greedy"].tolist()) == set(found["Best Single"].tolist()) == {0}


@pytest.mark.parametrize("name", PRESETS)
@pytest.mark.parametrize("information", ["open_loop", "causal"])
def test_a_landing_obeys_its_limits(name, information):
    free = run_experiment(Settings("simulated", name, information, **SMALL))
    upsilon = free.settings.upsilon
    chosen = free.settings, {"switch_cost": upsilon / 2, "budget": 20.2 * upsilon}
    run = run_experiment(replace(chosen[0], **chosen[1]))
    assert list(run.flights) == [policy for policy in POLICIES if policy != "All Large"]
    for policy in [name for name in FEASIBLE if name in run.flights]:
        c = run.flights[policy].choices
        paid = upsilon * (c.sum() + np.count_nonzero(np.diff(c)) / 2)
        assert paid <= 20.2 * upsilon
        np.testing.assert_allclose(run.flights[policy].perception_cost, paid, rtol=1e-12)
        assert run.problem.total_cost(c) >= run.optimal.lower_bound * (1 - 1e-12)
    assert run.flights["Clairvoyant"].perception_cost.max() <= 20.2 * upsilon
    text, c = report(run), run.optimal.choices
    spent = run.problem.perception_term(c)
    assert f"It spends {spent:.6g} of a budget of {20.2 * upsilon:.6g}." in text
    assert "Left out, as beyond the budget: All Large." in text
    assert f"It switches {np.count_nonzero(np.diff(c))} times." in text
    assert f"perception costs are w * Upsilon, {upsilon / 2:g} a switch" in text
    assert {k: summary(run)["settings"][k] for k in chosen[1]} == chosen[1]
    assert len(percentages(run)) == 10 and not landing.published_log(run.settings)


#: Milliseconds of EfficientNet b0 to b7 on an i7-12700H, as they were published.
MILLISECONDS = [12.9, 18.4, 24.0, 34.0, 68.3, 143.8, 256.0, 465.8]


@pytest.mark.parametrize("upsilon", [None, 3e13])
@pytest.mark.parametrize("name", PRESETS)
def test_milliseconds_are_prices_as_dear_as_w_upsilon_at_the_top(name, upsilon):
    linear, run = (
        run_experiment(Settings(preset=name, cost=cost, upsilon=upsilon, **SMALL))
        for cost in ("linear", "latency")
    )
    assert run.settings.upsilon == linear.settings.upsilon
    np.testing.assert_array_equal(run.problem.model_cost, MILLISECONDS)
    dearest = [each.problem.beta * each.problem.model_cost[7] for each in (linear, run)]
    assert dearest[1] == pytest.approx(dearest[0]) == 0.2 * 7 * run.settings.upsilon
    for policy in POLICIES[2:]:
        flown = run.flights[policy]
        paid = sum(MILLISECONDS[w] for w in flown.choices)
        np.testing.assert_allclose(flown.perception_cost, paid)
        weighed = paid * 0.2 * 7 * run.settings.upsilon / 465.8
        np.testing.assert_allclose(flown.reward, -0.8 * flown.control_cost - weighed)


@pytest.mark.no_cover
def test_three_lines_for_prices_and_a_budget_in_milliseconds():
    limits = {"cost": "latency", "switch_cost": 5.0, "budget": 400.0}
    run = run_experiment(Settings(preset="textbook", **limits, **SMALL))
    spent = run.problem.perception_term(run.optimal.choices)

    c = run.optimal.choices
    assert spent == pytest.approx(
        sum(MILLISECONDS[w] for w in c) + 5 * np.count_nonzero(np.diff(c))
    )
    assert spent <= 400 and run.optimal.is_optimal
    assert max(flown.perception_cost.max() for flown in run.flights.values()) <= 400
    text = report(replace(run, front=landing.whole_front(run.problem, 60)))
    assert f"It spends {spent:.6g} ms of a budget of 400 ms." in text
    assert "perception costs are ms of EfficientNet on an i7-12700H, 5 ms a switch" in text
    assert "perception (ms)" in text and re.search(r"within a budget of \S+ ms\.", text)
    assert f"Reward: -0.8 control cost - 0.2 * {7 * run.settings.upsilon / 465.8:.4g} a ms" in text
    row = re.search(r"^Optimal +\S+ ± \S+ +(\S+) ", text, re.M)
    assert float(row[1]) == pytest.approx(spent, abs=6e-4)  # not in units of the control cost
    figure = landing.plot_costs(run)
    said = figure.axes[0].get_xlabel(), figure.axes[0].get_ylabel()
    plt.close(figure)
    assert "perception cost (ms of models and switches)" in said


@pytest.mark.parametrize(
    ("mean", "half", "open_"),
    [
        *((1.0, 0.5, False), (-1.0, 0.5, False), (1.0, 1.5, True), (-1.0, 1.5, True)),
        *((1.0, 1.0, True), (0.0, 0.5, True), (1.0, 0.0, False), (0.0, 0.0, False)),
        *((5.0, np.nan, True), (0.0, np.nan, True)),
    ],
)
def test_undecided_is_what_an_interval_with_0_in_it_leaves(mean, half, open_):
    assert undecided(mean, half) is open_


def test_a_report_says_what_is_not_decided(small):
    """Of four trials with gains -1, 0, 1, 2 the mean is 0.5, the half-width 3.18 * 1.29 / 2."""
    best = small.flights["Optimal"]
    gains = {"Random": np.array([-1.0, 0, 1, 2]), "Greedy": np.array([9.0, 10, 11, 12])}
    gains |= {"Best Single": np.zeros(4)}
    flown = {
        policy: best._replace(**dict.fromkeys(landing.QUANTITIES, 100 - gain))
        for policy, gain in ({"Optimal": np.zeros(4)} | gains).items()
    }
    text = report(replace(small, flights=flown))
    assert re.findall(r"^Undecided.*", text, re.M) == ["Undecided (0 is in the interval): Random."]
    assert "decided" not in report(replace(small, flights={"Optimal": best}))
    one = replace(small, flights={k: f._replace(reward=f.reward[:1]) for k, f in flown.items()})
    assert "Undecided (a single trial): Random, Greedy, Best Single." in report(one)


@pytest.mark.parametrize("settings", [{}, {"preset": "textbook", "horizon": 30}])
def test_limits_that_never_bind_change_no_number(settings):
    plain = run_experiment(Settings(**settings, trials=2))
    loose = run_experiment(Settings(**settings, trials=2, switch_cost=0, budget=1e30))
    assert report(loose).split("\n\n")[0] == report(plain).split("\n\n")[0]
    for policy in POLICIES[1:]:
        np.testing.assert_array_equal(loose.flights[policy].choices, plain.flights[policy].choices)
    assert not {"switch_cost", "budget"} & set(summary(plain)["settings"])
    assert "switch" not in report(plain) and "budget" not in report(plain)
    assert percentages(loose) == percentages(plain)


def test_figures_have_room_for_fewer_policies():
    run = run_experiment(Settings(horizon=4, trials=3, budget=1e15))
    assert "All Large" not in run.flights
    for plot in (landing.plot_costs, landing.plot_rewards, landing.plot_pareto):
        plt.close(plot(run))
    figure = landing.plot_landing(run)
    assert [axes.get_title() for axes in figure.axes if axes.get_visible()] == list(run.flights)
    plt.close(figure)


# ----------------------------------------------------------------------------------- Pareto front


def test_front_is_proved_and_reaches_both_ends(small):
    problem = small.problem
    ratio, optima = pareto(problem, 25)
    c = np.array([optimum.choices for optimum in optima])
    control, perception = problem.control_term(c), problem.perception_term(c)
    assert len(ratio) == 25 and all(optimum.is_optimal for optimum in optima)
    # A larger alpha : beta never costs more control, nor less perception.
    assert np.all(np.diff(control) <= 1e-9 * control[:-1])
    assert np.all(np.diff(perception) >= -1e-9 * perception.max())
    best = solve(SelectionProblem(problem.psi, problem.mean, problem.variance, np.zeros(8)))
    assert control[-1] <= 1.01 * best.cost * (1 + 1e-9)
    assert perception[0] <= 0.01 * problem.perception_term(best.choices)


def test_no_schedule_is_better_in_both_than_the_front():
    run = run_experiment(Settings(preset="textbook", horizon=5, trials=1))
    schedules = np.array(list(product(range(8), repeat=5)))
    C, P = run.problem.control_term(schedules), run.problem.perception_term(schedules)
    for r, optimum in zip(*pareto(run.problem, 10), strict=True):
        c, p = (f(optimum.choices) for f in (run.problem.control_term, run.problem.perception_term))
        assert not np.any((C < c * (1 - 1e-9)) & (P <= p))
        assert r * c + p <= (r * C + P).min() * (1 + 1e-9)


def test_nothing_to_trade_makes_a_front_of_one_point():
    run = run_experiment(Settings(horizon=1, trials=2))  # B'QC = 0: one step cannot err
    assert run.problem.psi[0, 0] == 0
    ratio, optima = pareto(run.problem)
    assert len(ratio) == len(optima) == 1 and optima[0].cost == 0


# ------------------------------------------------------------------------------ all Pareto points


def unbeaten(problem):
    """Perception and control term of the schedules that no other beats in both, by enumeration."""
    schedules = [c for c in product(range(3), repeat=4) if problem.is_feasible(c)]
    terms = sorted((spending(problem, c), float(problem.control_term(c))) for c in schedules)
    best, kept = math.inf, []
    for paid, control in terms:
        if control < best * (1 - 1e-9):
            best, kept = control, [*kept, (paid, control)]
    return kept


def led_to(points):
    """The points that are cheapest at some ratio: tried between all slopes there are."""
    pairs = [(a, b) for a in points for b in points if a[0] < b[0]]
    slopes = sorted((a[1] - b[1]) / (b[0] - a[0]) for a, b in pairs)
    tried = [0.0, *((a + b) / 2 for a, b in pairwise(slopes)), *(2 * s for s in slopes[-1:])]
    return {min(points, key=lambda point: r * point[0] + point[1]) for r in tried} | {points[0]}


@pytest.mark.no_cover
@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("limits", [{}, {"switch_cost": SWITCHES}, {"budget": 4.2}])
def test_all_points_are_those_that_no_schedule_beats_and_corners_those_that_weights_reach(
    seed, limits
):
    problem = small_problem(seed, **limits)
    front, points = landing.whole_front(problem, 60), unbeaten(problem)
    np.testing.assert_allclose(front.points, points, rtol=1e-8, atol=1e-9)
    assert front.left == "" and len(points) > 2
    assert front.corner.tolist() == [point in led_to(points) for point in points]
    for k, (_, control) in enumerate(points):
        affordable = [points[j][1] for j in range(k + 1) if front.corner[j]]
        assert front.missed[k] == pytest.approx(min(affordable) / control - 1, abs=1e-8)
    on_corners = front.points[front.corner]
    for optimum in pareto(problem, 12)[1]:
        terms = problem.perception_term(optimum.choices), problem.control_term(optimum.choices)
        assert np.isclose(on_corners, terms, rtol=1e-8, atol=1e-9).all(axis=1).any()


@pytest.fixture(scope="module")
def fronted():
    """A landing with all its Pareto points."""
    run = run_experiment(Settings(preset="textbook", horizon=6, trials=2, switch_cost=3.0))
    return replace(run, front=landing.whole_front(run.problem, 60))


def test_the_report_counts_corners_and_says_what_they_miss(fronted):
    points, corner, missed, left = fronted.front
    text, worst = report(fronted), missed.argmax()
    assert left == "" and 2 <= corner.sum() < len(points) and missed[worst] > 0
    assert f"Pareto points: {len(points)} proved, {corner.sum()} of them corners" in text
    assert f"up to {100 * missed[worst]:.2g}% more, within a budget of " in text
    assert f"budget of {points[worst, 0]:.6g}." in text and "Open" not in text
    assert "Pareto" not in report(replace(fronted, front=None))


def test_what_a_time_limit_leaves_open_is_said(fronted):
    cut = replace(fronted, front=landing.whole_front(preset_problem(), 0))
    assert cut.front.left == "not proved from perception inf down to 0"
    assert "Pareto points: 0 proved" in report(cut)
    assert "Open: not proved from perception inf down to 0" in report(cut)
    figure = landing.plot_front(cut)
    assert "not proved from perception inf" in figure.axes[0].get_title()
    plt.close(figure)


def preset_problem():
    """A landing that is not proved in no time."""
    return run_experiment(Settings(preset="textbook", horizon=30, trials=1)).problem


def test_front_figure_shows_corners_points_between_and_constants(fronted):
    figure, (points, corner, missed, _) = landing.plot_front(fronted), fronted.front
    top, bottom = figure.axes
    drawn = [line.get_xydata() for line in top.lines]
    constant = [
        (f(np.full(6, w)))
        for w in range(8)
        for f in (fronted.problem.perception_term, fronted.problem.control_term)
    ]
    for line, expected in zip(drawn, (points[corner], points[~corner], constant), strict=True):
        np.testing.assert_allclose(line, np.reshape(expected, (-1, 2)))
    np.testing.assert_allclose(bottom.lines[0].get_ydata(), 100 * missed)
    assert [text.get_text() for text in top.texts] == list(fronted.suite.names)
    assert f"{corner.sum()} of {len(points)}" in top.get_title()
    assert top.get_yscale() == "log" and "and switches)" in bottom.get_xlabel()
    figure.draw_without_rendering()
    plt.close(figure)
    with pytest.raises(ValueError, match="result: expected one with a front"):
        landing.plot_front(replace(fronted, front=None))


def test_the_bar_of_the_front_moves_by_shares(monkeypatch):
    moved = []
    bar = lambda items, title, progress: (moved.append(k) or k for k in items)  # noqa: E731
    monkeypatch.setattr("modelselect_parts.rivals.perception.with_bar", bar)
    front = landing.whole_front(small_problem(0), 60, progress=True)
    assert len(front.points) > 2 and moved == list(range(100))


def test_the_bar_of_the_front_moves_by_whole_hundredths(monkeypatch):
    moved, seen = [], []

    def front(problem, *, time_limit, progress):
        for share in (0.0, 0.25, 0.259, 0.5, 1.0):
            progress(share)
            seen.append(len(moved))
        return []

    bar = lambda items, title, progress: (moved.append(k) or k for k in items)  # noqa: E731
    monkeypatch.setattr("modelselect_parts.rivals.perception.with_bar", bar)
    monkeypatch.setattr("modelselect_parts.rivals.ms.pareto_front", front)
    landing.whole_front(small_problem(0), 60)
    assert seen == [0, 25, 25, 50, 100]


@pytest.mark.parametrize("unit", [2.0**-60, 2.0**60])
def test_units_of_cost_change_no_choice(unit):
    """Costs in another unit, of powers of two: the same policies, ratios and corners."""
    problem = small_problem(3, switch_cost=SWITCHES, budget=4.4)
    price = {"model_cost": unit * problem.model_cost, "switch_cost": unit * SWITCHES}
    other = replace(problem, psi=unit * problem.psi, budget=unit * 4.4, **price)
    errors = np.random.default_rng(0).normal(size=(2, 4, 3, 1))
    found, same = (
        landing.policies(each, solve(each).choices, errors, np.random.default_rng(1))
        for each in (problem, other)
    )
    for policy, choices in found.items():
        np.testing.assert_array_equal(choices, same[policy])
    (ratio, optima), (again, rescaled) = pareto(problem, 9), pareto(other, 9)
    np.testing.assert_allclose(again, ratio)
    for one, two in zip(optima, rescaled, strict=True):
        np.testing.assert_array_equal(one.choices, two.choices)
    front, scaled = (landing.whole_front(each, 60) for each in (problem, other))
    np.testing.assert_allclose(scaled.points, unit * front.points)
    assert scaled.corner.tolist() == front.corner.tolist()
    np.testing.assert_allclose(scaled.missed, front.missed)


@pytest.mark.parametrize("quiet", [[], ["--quiet"]])
def test_the_command_line_finds_the_front(tmp_path, capsys, quiet, rough_figures):
    target = tmp_path / "r.json"
    argv = [*TINY, "--front", "60", "--out", str(tmp_path), "--json", str(target), *quiet]
    assert main(argv) == 0
    printed = capsys.readouterr()
    assert ("Pareto points: " in printed.out) == (not quiet) and printed.err == ""
    assert (tmp_path / "front.png").stat().st_size > 1000
    written = json.loads(target.read_text())["front"]
    found = landing.whole_front(run_experiment(Settings(horizon=4, trials=3)).problem, 60)
    assert written["corner"] == found.corner.tolist() and written["left"] == ""
    np.testing.assert_allclose(written["points"], found.points)
    assert set(written) == {"points", "corner", "missed", "left"}


# --------------------------------------------------------------------------- report and JSON


def test_intervals_are_students(small):
    values = small.flights["Optimal"].control_cost
    t = 2.364624251  # 97.5% quantile at 7 degrees of freedom, from a table
    expected = t * values.std(ddof=1) / np.sqrt(8)
    assert landing.half_width(values) == pytest.approx(expected, rel=1e-9)
    assert np.isnan(landing.half_width(values[:1]))


def test_means_are_sums_over_trials(small):
    for policy, found in small.means().items():
        rows = [getattr(small.flights[policy], q) for q in landing.QUANTITIES]
        np.testing.assert_allclose(found, [math.fsum(row) / 8 for row in rows], rtol=1e-12)


def test_report_prints_means_and_intervals(small):
    text = report(small)
    unit = float(re.search(r"in units of (\S+);", text)[1])
    best = small.flights["Optimal"]
    for policy, flights in small.flights.items():
        columns = [*flights[2:], best.reward - flights.reward]
        row = re.search(rf"^{policy} .*", text, re.M)[0][12:]
        cells = re.findall(r"(-?[\d.]+)(?: ± ([\d.]+))?", row)
        for column, (printed, interval) in zip(columns, cells, strict=True):
            half = 2.364624 * statistics.stdev(column) / 8**0.5
            assert float(printed) == pytest.approx(statistics.fmean(column) / unit, abs=6e-4)
            assert float(interval or 0) == pytest.approx(half / unit, rel=1e-6, abs=6e-4)
    steps = [small.optimal.choices.tolist().count(w) for w in range(8)]
    assert "Its steps: " + ", ".join(f"b{w} {n}" for w, n in enumerate(steps)) in text


def test_percentages_are_shares_of_the_old_mean(small):
    mean = {
        policy: [statistics.fmean(column) for column in flights[2:]]
        for policy, flights in small.flights.items()
    }
    rows = percentages(small)
    assert len(rows) == 10
    for row in rows:
        q = ["control cost", "perception cost", "reward"].index(row["quantity"])
        new, old, base = re.match(r"100 \((.*) - (.*)\) / \|(.*)\|$", row["formula"]).groups()
        assert (new, old, base) == (row["new"], row["old"], row["old"])
        change = 100 * (mean[new][q] - mean[old][q]) / abs(mean[old][q])
        assert row["this run"] == pytest.approx(change, rel=1e-9)
        # No log belongs to a landing of twelve steps.
        assert row["log at w*Upsilon"] is None is row["log at (w+1)*Upsilon"]
        assert row["what the paper prints"] == ""


def test_summary_has_the_promised_keys(small):
    found = json.loads(json.dumps(summary(small), allow_nan=False))
    assert set(found) == {
        *("policies", "schedule", "lower_bound", "gap", "solve_seconds", "settings")
    }
    assert list(found["policies"]) == POLICIES
    for policy, row in found["policies"].items():
        flown = small.flights[policy]
        for quantity in ("control_cost", "perception_cost", "reward"):
            values = getattr(flown, quantity)
            assert row[quantity] == pytest.approx(values.mean(), rel=1e-12)
            low, high = row[f"{quantity}_interval"]
            assert low <= row[quantity] <= high
            assert high - low == pytest.approx(2 * landing.half_width(values))
    assert found["schedule"] == small.optimal.choices.tolist()
    assert found["lower_bound"] <= small.optimal.cost and found["gap"] == small.optimal.gap
    assert found["settings"]["upsilon"] == small.settings.upsilon > 0


def test_report_names_what_it_shows(small, published):
    text = report(small)
    for policy in POLICIES:
        assert f"\n{policy:12}" in text
    assert "w * Upsilon" in text and "lower bound" in text and "proved optimal" in text
    assert max(map(len, f"{text}\n{report(published)}".splitlines())) <= 105


def test_benchmarks_show_the_report_of_the_published_experiment(published):
    page = Path(landing.__file__).with_name("benchmarks") / "README.md"
    shown = re.findall(
        r"```text\n(Means.*?)\n\n\[then", page.read_text(encoding="utf-8"), re.DOTALL
    )[0]
    printed = report(published)
    number = r"\d+\.\d+(?:e[+-]\d+)?|\d+e-\d+"
    old, new = (re.sub(r"in [0-9.]+ s\.$", "", text, flags=re.M) for text in (shown, printed))
    assert re.sub(number, "", old).split() == re.sub(number, "", new).split()
    old, new = ([float(x) for x in re.findall(number, text)] for text in (old, new))
    assert new == pytest.approx(old, rel=2e-3, abs=2e-3)


def test_the_published_percentages_are_recomputed_from_the_log(published):
    rows = {(row["quantity"], row["formula"]): row for row in percentages(published)}
    # formula -> from the log at w Upsilon, at (w + 1) Upsilon, and what the paper says of it
    for quantity, formula, log, higher, said in (
        ("control cost", "(Optimal - Random) / |Random|", -85.0, -85.0, ""),
        ("control cost", "(Random - Optimal) / |Optimal|", 567.4, 567.4, "567.18% lower"),
        ("perception cost", "(Optimal - Random) / |Random|", -7.0, -5.4, ""),
        ("perception cost", "(All Large - Random) / |Random|", 104.3, 80.7, "80.72% less"),
        ("reward", "(All Large - Optimal) / |Optimal|", -63.3, -53.0, "53.26% better"),
        ("reward", "(Oracle - Optimal) / |Optimal|", 73.0, 77.4, "77% far from Oracle"),
    ):
        row = rows[quantity, f"100 {formula}"]
        assert row["log at w*Upsilon"] == pytest.approx(log, abs=0.06)
        assert row["log at (w+1)*Upsilon"] == pytest.approx(higher, abs=0.06)
        assert math.copysign(1, row["this run"]) == math.copysign(1, log)
        assert row["what the paper prints"] == said


def test_percentages_of_next_to_nothing_are_no_numbers():
    tiny = Settings(preset="textbook", alpha=1e-300, upsilon=1e14, horizon=1, trials=2)
    rows = percentages(run_experiment(tiny))  # by default, a warning is an error here
    numbers = [row["this run"] for row in rows]
    assert None in numbers
    assert all(number is None or math.isfinite(number) for number in numbers)


def test_the_file_of_percentages_holds_the_rows(published, tmp_path):
    landing.write_percentages(published, tmp_path / "new" / "percentages.csv")
    with open(tmp_path / "new" / "percentages.csv", encoding="utf-8", newline="") as file:
        found = list(csv.DictReader(file))
    for row, expected in zip(found, percentages(published), strict=True):
        assert list(row) == [
            *("quantity", "new", "old", "formula", "this run"),
            *("log at w*Upsilon", "log at (w+1)*Upsilon", "what the paper prints"),
        ]
        assert row == {key: str(value) for key, value in expected.items()}


def test_the_report_states_numbers_and_draws_no_conclusions(small, published):
    for text in map(report, (small, published)):
        assert not re.search(r"\b(because|reasons?|holds|plainly|so that|means that)\b", text, re.I)


def test_what_is_not_said_is_as_published():
    assert preset().unit == preset("published", 150).unit != preset("textbook").unit == "ft"
    assert len(preset().prior_mean) == 150


@pytest.fixture(scope="module")
def drawn(tmp_path_factory):
    """Where the command line ran without --out, its numbers, and what it printed."""
    folder, out, err = tmp_path_factory.mktemp("drawn"), io.StringIO(), io.StringIO()
    with chdir(folder), redirect_stdout(out), redirect_stderr(err):
        assert main([*TINY, "--quiet", "--json", "r.json"]) == 0
    assert plt.get_fignums() == []
    return folder, json.loads((folder / "r.json").read_text()), out.getvalue() + err.getvalue()


def test_figures_go_to_a_folder_of_that_name_unless_told_otherwise(drawn):
    folder, _, _ = drawn
    assert {path.name for path in folder.iterdir()} == {"r.json", "figures"}
    files = {path.name for path in (folder / "figures").iterdir()}
    assert files == {"percentages.csv", *(f"{key}.png" for key in FIGURES)}


def test_a_single_trial_has_no_interval():
    run = run_experiment(Settings(horizon=3, trials=1))
    assert "± -" in report(run) and "nan" not in report(run)
    rows = summary(run)["policies"].values()
    assert all(row[key] is None for row in rows for key in row if key.endswith("interval"))


# ------------------------------------------------------------------------------------- figures


def labels(figure):
    """The text on the axes of a figure, shared labels included."""
    found = [figure.get_supxlabel(), figure.get_supylabel()]
    return found + [text for axes in figure.axes for text in (axes.get_xlabel(), axes.get_ylabel())]


@pytest.mark.parametrize(
    ("name", "sizes"), [("textbook", SMALL), ("published", {"horizon": 1, "trials": 1})]
)
def test_every_figure_is_drawn_and_labelled(name, sizes):
    run = run_experiment(Settings(preset=name, **sizes))
    arguments = {"efficientnet": (), "psi": (run.landing.task,)}
    expected = {
        "schedule": ("step", "model"),
        "costs": ("perception cost", "control cost"),
        "rewards": ("minus reward",),
        "pareto": ("perception cost", "extra control cost"),
        "landing": ("time (s)", f"altitude ({run.landing.unit})"),
        "efficientnet": ("operations", "parameters", "top-1 accuracy (%)"),
        "psi": ("step $k$", "step $t$"),
    }
    assert set(expected) == FIGURES
    for key, words in expected.items():
        figure = getattr(landing, f"plot_{key}")(*arguments.get(key, (run,)))
        assert isinstance(figure, plt.Figure)
        for word in words:
            assert any(word in text for text in labels(figure)), (key, word)
        plt.close(figure)


def test_schedule_figure_shows_the_schedule(small):
    figure = landing.plot_schedule(small)
    points = figure.axes[0].lines[-1].get_ydata()
    np.testing.assert_array_equal(points, small.optimal.choices)
    assert [tick.get_text() for tick in figure.axes[0].get_yticklabels()] == list(small.suite.names)
    plt.close(figure)


def test_cost_and_reward_figures_show_the_means(small):
    means = small.means()
    for figure, x, y in (
        (landing.plot_costs(small), 1, 0),
        (landing.plot_rewards(small), 2, None),
    ):
        for line in figure.axes[0].lines:
            if line.get_label() in means:
                row = means[line.get_label()]
                assert abs(line.get_xdata()[0]) == pytest.approx(abs(row[x]))
                assert y is None or line.get_ydata()[0] == pytest.approx(row[y])
        plt.close(figure)


def test_pareto_figure_shows_the_front_and_the_policies_in_expectation(small):
    problem, optima = small.problem, pareto(small.problem, 5)[1]
    figure = landing.plot_pareto(small, optima)
    front, *dots = figure.axes[0].lines

    def costs(c):
        e, steps = problem.mean[range(12), c, 0], range(12)
        noise = sum(problem.psi[t, t] * problem.variance[t, c[t], 0] for t in steps)
        paid = sum(problem.model_cost[w] for w in c)
        return paid, noise + sum(e[t] * problem.psi[t, k] * e[k] for t in steps for k in steps)

    expected = [costs(optimum.choices) for optimum in optima]
    np.testing.assert_allclose(front.get_xydata(), expected, rtol=1e-9)
    assert [dot.get_label() for dot in dots] == FEASIBLE
    for dot in dots:
        expected = [costs(small.flights[dot.get_label()].choices)]
        np.testing.assert_allclose(dot.get_xydata(), expected, rtol=1e-9)
    plt.close(figure)


def test_landing_figure_shows_mean_and_band_over_seconds(small):
    figure = landing.plot_landing(small)
    time = [t * small.landing.dt for t in range(13)]
    for axes, (policy, flights) in zip(figure.axes, small.flights.items(), strict=True):
        assert axes.get_title() == policy
        mean = [math.fsum(column) / 8 for column in flights.altitude.T]
        np.testing.assert_allclose(axes.lines[0].get_xydata(), np.transpose([time, mean]))
        # Of 8 sorted trials the 5% and 95% quantiles lie 0.35 of a step from either end.
        low, second, *_, seventh, high = np.sort(flights.altitude, axis=0)
        edges = [low + 0.35 * (second - low), high - 0.35 * (high - seventh)]
        drawn = axes.collections[0].get_paths()[0].vertices
        for t in range(13):
            here = drawn[np.isclose(drawn[:, 0], time[t]), 1]
            assert [here.min(), here.max()] == pytest.approx([edge[t] for edge in edges])
    plt.close(figure)


def test_efficientnet_figure_shows_the_table():
    figure = landing.plot_efficientnet()
    for axes, x, unit in zip(figure.axes, EFFICIENTNET[1:3][::-1], (1e9, 1e6), strict=True):
        points = np.transpose([x / unit, EFFICIENTNET.top1])
        np.testing.assert_allclose(axes.lines[0].get_xydata(), points)
        assert [note.get_text() for note in axes.texts] == list(EFFICIENTNET.names)
    plt.close(figure)


def test_psi_figure_has_one_scale_and_four_patterns(small):
    figure = landing.plot_psi(small.landing.task)
    images = [axes.images[0] for axes in figure.axes[:4]]
    assert all(isinstance(image.norm, LogNorm) for image in images)
    assert len({(image.norm.vmin, image.norm.vmax) for image in images}) == 1
    for axes, information in zip(figure.axes, INFORMATION, strict=False):
        assert axes.get_title().startswith(information)
        shown = np.abs(psi(small.landing.task, information))
        np.testing.assert_array_equal(axes.images[0].get_array(), shown)
    plt.close(figure)


def test_psi_figure_leaves_empty_what_is_out_of_reach():
    one = np.eye(1)
    wild = ControlTask(9 * one, one, one, one, one, 400)  # 9^400 is beyond the largest float
    with pytest.raises(ValueError, match="Psi overflows"):
        psi(wild)
    figure = landing.plot_psi(wild)
    assert "not available" in figure.axes[0].get_title() and not figure.axes[0].images
    plt.close(figure)


@pytest.fixture
def hearsay(monkeypatch):
    """A fifth pattern of information, added while the program runs."""
    row = PATTERNS["causal"]._replace(controller="sees what it is told")
    monkeypatch.setitem(PATTERNS, "hearsay", row)


def test_a_pattern_that_is_added_is_known_everywhere(hearsay, small, capsys):
    figure = landing.plot_psi(small.landing.task)
    assert figure.axes[4].get_title().startswith("hearsay") and figure.axes[4].images
    plt.close(figure)
    with pytest.raises(SystemExit):
        main(["--help"])
    assert "hearsay" in capsys.readouterr().out
    ours, theirs = (
        run_experiment(Settings(preset="published", information=pattern, **SMALL)).means()
        for pattern in ("hearsay", "causal")
    )
    assert all((ours[policy] == theirs[policy]).all() for policy in POLICIES)


def test_a_front_that_is_not_proved_is_not_called_one(small):
    optima = pareto(small.problem, 3)[1]
    figure = landing.plot_pareto(small, optima)
    assert figure.axes[0].get_title() == "No schedule beats the front in both costs"
    doubtful = [replace(optima[0], lower_bound=optima[0].lower_bound / 2), *optima[1:]]
    assert not doubtful[0].is_optimal
    other = landing.plot_pareto(small, doubtful)
    assert other.axes[0].get_title() == "The best schedules found"
    plt.close("all")


def test_style_leaks_no_further():
    before = dict(plt.rcParams)
    plt.close(landing.plot_efficientnet())
    assert dict(plt.rcParams) == before


# -------------------------------------------------------------------------------- command line


TINY = ["--horizon", "4", "--trials", "3"]


@pytest.mark.parametrize("information", INFORMATION)
@pytest.mark.parametrize("name", PRESETS)
def test_command_line_prints_and_writes(name, information, tmp_path, capsys):
    path = tmp_path / "new" / "results.json"
    options = ["--preset", name, "--information", information, "--no-figures", *TINY]
    assert main([*options, "--json", str(path)]) == 0
    printed = capsys.readouterr()
    assert printed.err == ""  # no progress bars off a terminal
    settings = Settings("simulated", name, information, 4, 3)
    run = run_experiment(settings)
    costs = report(run).split("\n\n")[0]
    assert printed.out.startswith(costs)
    found = json.loads(path.read_text())
    assert found["policies"] == summary(run)["policies"]
    assert found["settings"] == summary(run)["settings"]
    assert [file.name for file in tmp_path.rglob("*")] == ["new", "results.json"]


def test_same_seed_same_files(drawn, tmp_path, capsys):
    folder, numbers, printed = drawn
    path = tmp_path / "out" / "r.json"
    options = ["--quiet", "--out", str(path.parent), "--json", str(path), "--no-figures"]
    assert main([*TINY, *options]) == 0
    assert printed == "" and capsys.readouterr() == ("", "")
    again = json.loads(path.read_text())
    assert numbers["solve_seconds"] >= 0 and again["solve_seconds"] >= 0
    assert again == numbers | {"solve_seconds": again["solve_seconds"]}
    assert plt.get_fignums() == []
    files = {file.name: file for file in (folder / "figures").iterdir()}
    assert set(files) == {"percentages.csv", *(f"{key}.png" for key in FIGURES)}
    assert not any(b"Software" in file.read_bytes() for file in files.values())
    run = run_experiment(Settings(horizon=4, trials=3))
    for key in ("costs", "schedule"):
        again, figure = tmp_path / "again.png", getattr(landing, f"plot_{key}")(run)
        figure.savefig(again, metadata={"Software": None})
        plt.close(figure)
        assert files[f"{key}.png"].read_bytes() == again.read_bytes(), key


def test_other_seed_other_numbers(tmp_path):
    for seed in "01":
        target = str(tmp_path / f"{seed}.json")
        main([*TINY, "--quiet", "--no-figures", "--seed", seed, "--json", target])
    one, two = (json.loads((tmp_path / f"{seed}.json").read_text()) for seed in "01")
    assert one["policies"] != two["policies"]
    assert not (tmp_path / "figures").exists()


def attempt(argv):
    """Exit status of the command line, however it ends."""
    try:
        return main(argv)
    except SystemExit as ended:
        return ended.code


@pytest.mark.parametrize(
    ("argv", "words"),
    [
        ("--horizon 0", "horizon: expected an integer >= 1, found 0"),
        ("--horizon -3", "horizon"),
        ("--horizon 1.5", "--horizon"),
        ("--horizon many", "--horizon"),
        ("--horizon", "--horizon"),
        ("--trials 0", "trials: expected an integer >= 1, found 0"),
        ("--trials -1", "trials"),
        ("--trials x", "--trials"),
        ("--alpha -0.1", "alpha: expected a number >= 0, found -0.1"),
        ("--alpha nan", "alpha"),
        ("--alpha inf", "alpha"),
        ("--alpha x", "--alpha"),
        ("--beta -1", "beta"),
        ("--beta nan", "beta"),
        ("--upsilon -1", "upsilon"),
        ("--upsilon inf", "upsilon"),
        ("--switch-cost -1", "switch_cost: expected a number >= 0, found -1"),
        ("--switch-cost nan", "switch_cost"),
        ("--switch-cost x", "--switch-cost"),
        ("--budget -1", "budget: expected a number >= 0, found -1"),
        ("--budget inf", "budget"),
        ("--budget", "--budget"),
        ("--front -1", "front: expected a number >= 0, found -1"),
        ("--front nan", "front"),
        ("--front x", "--front"),
        ("--seed -1", "seed"),
        ("--seed 1.5", "--seed"),
        ("--preset moon", "--preset"),
        ("--information none", "--information"),
        ("--experiment none", "--experiment"),
        ("--unknown", "--unknown"),
        ("surplus", "surplus"),
        ("--upsilon 1e308", "upsilon: the costs overflow"),
        ("--json {file}/results.json", "--json"),
        ("--json {folder}", "--json: expected a file"),
        ("--json /dev/null", "--json: expected a file"),
        ("--json /proc/none/results.json", "--json"),
        ("--out {file}", "--out: expected a writable folder"),
        ("--out {file}/figures", "--out"),
        ("--out /proc/none", "--out"),
        ("--out {folder}/new --json {folder}/new", "--json: expected a file"),
    ],
)
def test_bad_input_is_one_line_and_status_2_and_leaves_nothing(
    argv, words, tmp_path, capsys, monkeypatch
):
    folder, file = tmp_path / "folder", tmp_path / "file"
    folder.mkdir()
    file.write_text("kept")
    monkeypatch.chdir(folder)
    if "1e308" not in argv:
        monkeypatch.setattr(landing, "run_experiment", lambda *_, **__: pytest.fail("it ran"))
    assert attempt(argv.format(folder=folder, file=file).split()) == 2
    printed = capsys.readouterr()
    assert printed.out == ""
    assert printed.err.startswith("landing.py: error: ") and printed.err.count("\n") == 1
    assert words in printed.err
    assert list(folder.iterdir()) == [] and file.read_text() == "kept"


def test_a_file_is_written_with_its_folder_and_nothing_else(tmp_path):
    path = tmp_path / "new" / "file"
    for content in (b"one", b"", bytes(range(256))):
        landing.write_atomically(path, content)
        assert path.read_bytes() == content and list(path.parent.iterdir()) == [path]


def test_a_failed_write_leaves_the_old_file(tmp_path, monkeypatch):
    path = tmp_path / "results.json"
    path.write_text("old")

    def fail(self, content):
        self.touch()
        raise OSError("disk full")

    monkeypatch.setattr(Path, "write_bytes", fail)
    assert attempt([*TINY, "--quiet", "--no-figures", "--json", str(path)]) == 2
    assert path.read_text() == "old" and list(tmp_path.iterdir()) == [path]


@pytest.mark.unmutated
def test_script_runs_from_the_shell():
    script = Path(landing.__file__)
    command = [sys.executable, script, "--no-figures", "--horizon", "5", "--trials", "2"]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert "Clairvoyant" in done.stdout and done.stderr == ""
    helped = subprocess.run([sys.executable, script, "--help"], capture_output=True, text=True)
    for option in (
        "information",
        "horizon",
        "alpha",
        "upsilon",
        "budget",
        "switch-cost",
        "out",
        "json",
    ):
        assert f"--{option}" in helped.stdout


def test_a_landing_without_switching_costs_poses_a_problem_that_has_none():
    # Zeros in their place cost nothing, but blends refused them.
    assert run_experiment(Settings(horizon=4, trials=1)).problem.switch_cost is None
