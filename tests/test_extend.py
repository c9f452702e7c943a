"""What README calls an extension is a few lines: one of each."""

import numpy as np
import pytest

import landing
import modelselect as ms
from landing import EXPERIMENTS, Settings, run_experiment
from modelselect import PATTERNS, ControlTask, Pattern, Schedule, SelectionProblem
from perception import PerceptionSuite, gaussian_suite


def test_a_pattern_is_a_row(capsys):
    PATTERNS["reckoning"] = Pattern(lambda look: look.expected, True, False, False, "reckons")
    try:
        settings = Settings(information="reckoning", horizon=6, trials=3)
        result = run_experiment(settings)
        assert np.isfinite(result.means()["Optimal"]).all()
        with pytest.raises(SystemExit):
            landing.main(["--help"])
        assert "reckoning" in capsys.readouterr().out
    finally:
        del PATTERNS["reckoning"]


def always(model):
    """A solver: the same model throughout, certified by its own mean errors."""

    def solver(problem):
        choices = np.full(len(problem.mean), model)
        d = problem.chosen_mean(choices)
        bound, _ = ms.reference_bound(problem, d)
        cost = float(problem.total_cost(choices))
        return Schedule(choices, cost, bound, bound, d, f"always({model})")

    return solver


def a_problem():
    task = ControlTask([[1]], [[1]], [[1]], [[1]], [[1]], 5)  # a robot
    suite = halving(5)
    return SelectionProblem(ms.psi(task), suite.mean, suite.variance, suite.cost)


def halving(horizon):
    """A source of errors: each model errs by half of what the one before it does."""
    return gaussian_suite(
        lambda w, t: 0.5**w + 0 * t, lambda w, t: 0.1 + 0 * w * t, [0, 1, 2], np.arange(horizon)
    )


def test_a_solver_is_a_function_and_the_certificate_judges_it():
    problem = a_problem()
    schedule = always(1)(problem)
    assert ms.check_certificate(problem, schedule) == schedule.root_bound
    assert schedule.lower_bound <= ms.solve(problem).cost <= schedule.cost


def test_a_source_of_errors_and_a_robot_pose_a_problem():
    assert isinstance(halving(5), PerceptionSuite)
    assert ms.solve(a_problem()).is_optimal


def test_an_experiment_is_a_row():
    def half(aircraft, run, rng, trained):
        suite = aircraft.draw_suite(rng)
        return suite.pick(suite.names[::2])

    EXPERIMENTS["half"] = half
    try:
        result = run_experiment(Settings(experiment="half", horizon=6, trials=3))
        assert result.suite.names == ("b0", "b2", "b4", "b6")
        assert "Optimal" in landing.report(result)
        assert landing.summary(result)["settings"]["experiment"] == "half"
    finally:
        del EXPERIMENTS["half"]
