"""What a robot takes on board: problems and schedules as JSON, and planning anew at every step."""

import json
from dataclasses import fields, replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from test_constrained import a_problem

import modelselect as ms
from modelselect import ControlTask, Schedule, SelectionProblem, Sensitivity, sensitivity
from modelselect_parts import problem as problem_part

SEEDS = st.integers(0, 2**32 - 1)


def same(a, b):
    if isinstance(a, Sensitivity):
        return isinstance(b, Sensitivity) and all(same(*pair) for pair in both(a, b))
    return np.array_equal(a, b) if isinstance(a, np.ndarray) else a == b


def both(a, b):
    return [(getattr(a, f.name), getattr(b, f.name)) for f in fields(a) if f.name != "work"]


# ------------------------------------------------------------------------------------- as JSON


@given(SEEDS)
def test_what_comes_back_is_what_was_written(seed):
    problem = a_problem(seed)
    schedule = ms.solve(problem)
    again = SelectionProblem.from_json(problem.to_json())
    told = Schedule.from_json(schedule.to_json())
    assert all(same(*pair) for pair in (*both(problem, again), *both(schedule, told)))
    assert ms.check_certificate(again, told) == schedule.root_bound
    assert again.to_json() == problem.to_json() and told.to_json() == schedule.to_json()
    with pytest.raises(ValueError, match="read-only"):
        again.mean[0] = 0


def test_infinities_are_strings_and_the_search_tree_stays_behind():
    mean = np.zeros((2, 2, 1))
    problem = SelectionProblem(np.eye(2), mean, mean, [0, np.inf])
    text = replace(ms.branch_and_bound(problem), lower_bound=-np.inf).to_json()
    document = json.loads(text, parse_constant=lambda constant: pytest.fail(constant))
    assert document["lower_bound"] == "-inf" and "tree" not in document["work"]
    assert document["work"]["nodes"] == 1
    assert Schedule.from_json(text).lower_bound == -np.inf
    assert json.loads(problem.to_json())["model_cost"] == [0, "inf"]


def test_a_long_system_is_written_as_a_system(monkeypatch):
    monkeypatch.setattr(problem_part, "LONG", 1)
    task, mean = ControlTask([[1]], [[1]], [[1]], [[1]], [[1]], 3), np.ones((3, 2, 1))
    problem = SelectionProblem(sensitivity(task, "preview"), mean, mean, [0, 1])
    assert isinstance(problem.psi, Sensitivity)
    again = SelectionProblem.from_json(problem.to_json())
    assert all(same(*pair) for pair in both(problem, again))


def a_document(**changes):
    problem = SelectionProblem(np.eye(2), [[[1], [0]]] * 2, np.zeros((2, 2, 1)), [0, 1])
    document = json.loads(problem.to_json()) | changes
    return json.dumps({name: value for name, value in document.items() if value != "left out"})


@pytest.mark.parametrize(
    "text, complaint",
    [
        ("", "^text: expected a JSON document"),
        (None, "^text: expected a JSON document"),
        ("[1, 2]", "^format: expected modelselect.SelectionProblem"),
        ("{}", "^format: expected modelselect.SelectionProblem"),
        (a_document(format="modelselect.Robot"), "^format: expected one of modelselect"),
        ("[" * 100_000, "^text: expected a JSON document"),
        (b"\xff\xfe\x00", "^text: expected a JSON document"),
        (a_document(format=["x"]), "^format: expected one of"),
        (a_document(version=2), "^version: expected 1, found 2"),
        (a_document(version=True), "^version: expected 1, found True"),
        (a_document(version="left out"), "^version: expected 1, found None"),
        (a_document(mean="left out"), "^mean: expected one$"),
        (a_document(colour="red"), "^colour: expected no such field"),
        (a_document(alpha="1.0"), "^alpha: expected numbers, found '1.0'"),
        (a_document(alpha=[1]), "^alpha: expected a number"),
        (a_document(alpha=None), "^alpha: expected real numbers"),
        (a_document(mean=[[1], [2, 3]]), "^mean: expected a rectangular array"),
        (a_document(model_cost=[0, "oo"]), "^model_cost: expected numbers, found 'oo'"),
        (a_document(budget=-1.0), "^budget: "),
        (a_document(psi=[[1, 2], [2, 1]]), "^psi: expected a positive semidefinite"),
        (a_document().replace("1.0", "NaN", 1), "^text: expected strict JSON, found NaN"),
        (a_document().replace("{", '{"alpha": 1, ', 1), "^text: expected every field once"),
    ],
)
def test_a_wrong_document_is_refused_in_a_line_that_names_the_field(text, complaint):
    with pytest.raises(ValueError, match=complaint) as caught:
        SelectionProblem.from_json(text)
    assert "\n" not in str(caught.value)


def test_a_wrong_schedule_is_refused():
    mean = np.zeros((2, 2, 1))
    good = json.loads(ms.solve(SelectionProblem(np.eye(2), mean, mean, [0, 1])).to_json())
    for change, complaint in (
        ({"choices": [0, 0.5]}, "^choices: expected integers"),
        ({"choices": [-1, 0]}, "^choices: expected integers >= 0"),
        ({"choices": [1e300, 0]}, "^choices: expected integers >= 0"),
        ({"multiplier": -1.0}, "^multiplier: expected a number >= 0"),
        ({"multiplier": "inf"}, "^multiplier: expected finite numbers"),
        ({"choices": "all"}, "^choices: expected numbers"),
        ({"solver": 3}, "^solver: expected str"),
        ({"work": [1]}, "^work: expected dict"),
        ({"reference": [0, "NaN"]}, "^reference: expected numbers"),
    ):
        with pytest.raises(ValueError, match=complaint):
            Schedule.from_json(json.dumps(good | change))
    with pytest.raises(ValueError, match=r"^format: expected modelselect\.Schedule"):
        Schedule.from_json(a_document())


# ---------------------------------------------------------------------------- planning anew


def what_is_left(problem, done):
    """The problem of the steps that are left, after `done`: what errors were met pulls on."""
    t, p = len(done), problem.mean.shape[2]
    met = problem.mean[np.arange(t), done].ravel()
    pull = np.zeros(problem.mean.shape[::2]) if problem.pull is None else problem.pull
    coupled = 2 * (problem.psi[t * p :, : t * p] @ met).reshape(-1, p)
    price = np.broadcast_to(problem.model_cost, problem.mean.shape[:2])
    return replace(
        problem,
        psi=problem.psi[t * p :, t * p :],
        mean=problem.mean[t:],
        variance=problem.variance[t:],
        model_cost=price[t:],
        pull=pull[t:] + coupled,
        budget=None,
    )


@given(SEEDS)
def test_who_learns_nothing_new_does_not_change_the_plan_for_a_dearer_one(seed):
    problem, done = a_problem(seed), []
    plans = ms.receding_horizon(
        lambda t: what_is_left(problem, done), len(problem.mean), budget=problem.budget
    )
    for plan in plans:
        assert plan.cost - plan.lower_bound <= 1e-9 * (1 + abs(plan.cost))
        done.append(int(plan.choices[0]))
    assert problem.is_feasible(done)
    best = ms.enumerate_schedules(problem).cost
    assert problem.total_cost(done) == pytest.approx(best, rel=1e-9, abs=1e-9)


def test_planning_anew_in_three_lines():
    task = ControlTask([[1, 0.1], [0, 1]], [[0], [0.1]], [[0], [0.1]], np.eye(2), [[0.1]], 20)
    Psi, mean = ms.psi(task), np.linspace(1, 0, 60)[:, None, None] * [[1.0], [0.1]]
    window = lambda t: SelectionProblem(Psi, mean[t : t + 20], 0 * mean[:20], [0, 0.01])  # noqa: E731
    plans = list(ms.receding_horizon(window, 40, budget=0.2))
    assert all(plan.is_optimal for plan in plans)
    assert sum(plan.choices[0] for plan in plans) <= 20


def test_planning_anew_takes_whole_steps_and_keeps_to_its_limits():
    problem = a_problem(3, budget=False)
    with pytest.raises(ValueError, match=r"^steps: expected an integer >= 1"):
        next(ms.receding_horizon(lambda t: problem, 0))
    [hurried] = ms.receding_horizon(lambda t: problem, 1, time_limit=0)
    assert hurried.lower_bound <= ms.solve(problem).cost <= hurried.cost + 1e-9
