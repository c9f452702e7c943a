"""A choice that holds for k steps: it costs what the schedule that repeats it does."""

from dataclasses import replace

import numpy as np
import pytest

import modelselect as ms
from modelselect import SelectionProblem, expand_choices, hold, sensitivity

from strategies import every_schedule, gram

SEEDS = pytest.mark.parametrize("seed", range(30))


def drawn(seed):
    """A tiny problem of any features, and for how many steps a choice holds."""
    rng = np.random.default_rng(seed)
    H, W, p = (int(rng.integers(1, top + 1)) for top in (7, 3, 2))
    price = rng.integers(0, 5, (H, W)).astype(float)
    price[:, 1:][rng.random((H, W - 1)) < 0.1] = np.inf
    full = seed % 2 == 0
    problem = SelectionProblem(
        gram(rng, (H * p,), H * p, False),
        rng.normal(size=(H, W, p)),
        gram(rng, (H, W, p), p, False) if full else rng.random((H, W, p)),
        price if seed % 5 else rng.random(W),
        alpha=0.8,
        beta=1.5,
        switch_cost=rng.integers(0, 4, (W, W)) * (1.0 - np.eye(W)) if seed % 3 else None,
        initial_model=0,
        pull=rng.normal(size=(H, p)) if seed % 4 < 2 else None,
    )
    if seed % 7 < 4:  # half-way between what single models spend
        dear = problem.perception_term([[w] * H for w in range(W)])
        dear = dear[np.isfinite(dear)]
        problem = replace(problem, budget=float((dear.min() + dear.max()) / 2))
    return problem, int(rng.integers(1, H + 2))


def repeated(c, k, H):
    return [c[t // k] for t in range(H)]


@SEEDS
def test_every_schedule_costs_and_spends_what_the_one_that_repeats_it_does(seed):
    problem, k = drawn(seed)
    H, held = len(problem.mean), hold(problem, k)
    assert held.mean.shape == (-(-H // k), problem.mean.shape[1], k * problem.mean.shape[2])
    short = every_schedule(held)
    long = np.array([repeated(c, k, H) for c in short])
    np.testing.assert_array_equal(expand_choices(short, k, H), long)
    for name in ("control_term", "perception_term", "total_cost"):
        found, expected = getattr(held, name)(short), getattr(problem, name)(long)
        np.testing.assert_allclose(found, expected, rtol=1e-11, atol=1e-11, err_msg=name)
    np.testing.assert_array_equal(held.is_feasible(short), problem.is_feasible(long))


@SEEDS
def test_the_optimum_is_the_cheapest_of_all_schedules_that_hold_so_long(seed):
    problem, k = drawn(seed)
    H, schedules = len(problem.mean), every_schedule(problem)
    steady = np.diff(schedules, axis=1, prepend=schedules[:, :1]) == 0
    schedules = schedules[(steady | (np.arange(H) % k == 0)).all(axis=1)]
    best = problem.total_cost(schedules[problem.is_feasible(schedules)]).min()
    found = ms.solve(hold(problem, k))
    assert found.is_optimal and found.cost == pytest.approx(best, rel=1e-9, abs=1e-9)
    choices = expand_choices(found.choices, k, H)
    assert problem.total_cost(choices) == pytest.approx(best, rel=1e-9, abs=1e-9)


def test_three_lines_for_a_choice_that_holds():
    problem = SelectionProblem(np.eye(5), np.ones((5, 2, 1)), np.ones((5, 2, 1)), [1, 2])
    schedule = ms.solve(hold(problem, 2))
    assert list(expand_choices(schedule.choices, 2, horizon=5)) == [0, 0, 0, 0, 0]


def test_a_linear_system_is_held_as_its_matrix():
    task = ms.ControlTask([[1]], [[1]], [[1]], [[1]], [[1]], 5)
    mean = np.ones((5, 2, 1)) * [[1.0], [0.5]]
    system, matrix = (
        SelectionProblem(Psi, mean, 0 * mean, [0, 1])
        for Psi in (sensitivity(task, "preview"), ms.psi(task, "preview"))
    )
    np.testing.assert_allclose(hold(system, 2).psi, hold(matrix, 2).psi, rtol=1e-12)


def test_correlated_errors_are_held_as_well():
    problem, _ = drawn(1)
    H, W, p = problem.mean.shape
    Cov = ms.persistent_bias(np.ones((W, p)), np.ones((H, W, p)))
    held = hold(ms.correlated_problem(problem, Cov), 2)
    short = every_schedule(held)
    expected = ms.correlated_cost(problem, expand_choices(short, 2, H), Cov)
    np.testing.assert_allclose(held.total_cost(short), expected, rtol=1e-11)


@pytest.mark.parametrize(
    "call, line",
    [
        (lambda problem: hold(problem, 0), "steps: expected an integer >= 1, found 0"),
        (
            lambda problem: expand_choices([0, 1], 2, 5),
            "choices: expected shape (..., N)",
        ),
        (lambda problem: expand_choices([0, -1, 0], 2, 5), "choices: expected integers"),
    ],
)
def test_what_cannot_hold_is_refused(call, line):
    with pytest.raises(ValueError) as caught:
        call(drawn(0)[0])
    assert str(caught.value).startswith(line)
