"""The control task and its controllers (`eq:dynamics`, `eq:jc`) against loops and dense algebra."""

from dataclasses import FrozenInstanceError, replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.linalg import solve_discrete_are

from modelselect import INFORMATION, ControlTask, control_cost, plan, riccati, run_controller

from strategies import (
    SEEDS,
    at,
    cases,
    dense_plan,
    plain_cost,
    plain_states,
    replanned,
    stacked,
    tasks,
    weight,
)

# Sums of a few dozen products are exact up to this fraction of their largest terms, and solutions
# of linear equations up to this fraction of `solution_size`: 5,000 rounding units.  The worst
# seen in 1,500 examples was a single unit.
ROUNDING = 1e-12
MATRICES = ("A", "B", "C", "Q", "R")


def close(found, expected, *sizes):
    """Whether arrays agree up to rounding of their largest entry or of the largest of `sizes`."""
    size = max(np.abs(z).max() for z in (expected, *sizes))
    return np.shape(found) == np.shape(expected) and np.all(
        np.abs(found - expected) <= ROUNDING * size
    )


def solution_size(task, u, x0, *signals):
    """What rounding in u = -K^{-1} M'Q-bar (F x_0 + N s) is relative to: all norms multiplied.

    Larger than u where terms cancel, as they do in singular tasks of whole numbers.
    """
    F, M, N, Q, R = (np.linalg.norm(matrix, 2) for matrix in stacked(task))
    reach = F * np.abs(x0).max() + N * sum(np.abs(s).max() for s in signals)
    smallest = min(np.linalg.eigvalsh(at(task.R, t))[0] for t in range(task.horizon))  # K is larger
    return ((R + M * Q * M) * np.abs(u).max() + M * Q * reach) / smallest


def cost_size(task, states, controls):
    """The same for a cost: x'Qx is a cancelled sum where x is near the null space of Q."""
    steps = range(task.horizon)
    state = sum(np.abs(weight(task, t + 1)).sum() * (states[t + 1] ** 2).sum() for t in steps)
    return state + sum(np.abs(at(task.R, t)).sum() * (controls[t] ** 2).sum() for t in steps)


def a_task(**changes):
    """A small time-varying task with n = 3, m = 2, p = 1, H = 4."""
    rng = np.random.default_rng(5)
    A, B, C = (rng.normal(size=(4, 3, k)) for k in (3, 2, 1))
    arrays = {"A": A, "B": B, "C": C, "Q": np.diag([1, 2, 0]), "R": np.eye(2), "horizon": 4}
    return ControlTask(**(arrays | changes))


# ------------------------------------------------------------------------------------ the task


def test_a_task_knows_its_dimensions():
    task = a_task()
    assert (task.n, task.m, task.p, task.horizon) == (3, 2, 1, 4)


def test_a_task_keeps_floats_whatever_real_numbers_it_was_given():
    task = ControlTask([[1]], [[True]], np.float32([[2]]), [[1]], [[3]], horizon=np.int8(2))
    assert [getattr(task, name).dtype for name in (*MATRICES, "Q_final")] == [np.float64] * 6
    assert type(task.horizon) is int and task.horizon == 2


def test_a_task_does_not_change_with_the_array_it_was_made_from():
    A = np.eye(3)
    task = a_task(A=A)
    A[0, 0] = 7
    assert task.A[0, 0] == 1


@pytest.mark.parametrize("name", [*MATRICES, "Q_final"])
def test_the_arrays_of_a_task_are_read_only(name):
    with pytest.raises(ValueError, match="read-only"):
        getattr(a_task(), name)[...] = 0
    with pytest.raises(FrozenInstanceError):
        setattr(a_task(), name, np.eye(3))


def test_the_terminal_weight_is_q_unless_stated():
    assert (a_task().Q_final == np.diag([1, 2, 0])).all()
    assert (a_task(Q_final=np.eye(3)).Q_final == np.eye(3)).all()


def test_a_terminal_weight_is_required_when_q_varies():
    with pytest.raises(ValueError, match=r"^Q_final: required"):
        a_task(Q=np.zeros((4, 3, 3)))


@given(tasks())
def test_matrices_over_time_are_those_of_each_step(task):
    A, B, C, Q, R = task.over_time()
    for t in range(task.horizon):
        for found, M in zip((A, B, C, R), (task.A, task.B, task.C, task.R), strict=True):
            assert (found[t] == at(M, t)).all()
        assert (Q[t + 1] == weight(task, t + 1)).all()
    assert [len(M) - task.horizon for M in (A, B, C, Q, R)] == [0, 0, 0, 1, 0]


@given(cases())
def test_a_constant_matrix_is_the_same_task_as_its_repetition(case):
    task, (x0, s, errors) = case
    H = task.horizon
    repeated = {name: np.array([at(getattr(task, name), t) for t in range(H)]) for name in MATRICES}
    same = replace(task, **repeated)
    for information in INFORMATION:
        found, expected = (
            run_controller(each, x0, s, s + errors, information) for each in (same, task)
        )
        assert close(found[0], expected[0]) and close(found[1], expected[1])


# ------------------------------------------------------------------------------------ the cost


@given(cases(), SEEDS)
def test_the_control_cost_is_the_sum_over_x1_to_xh_and_u0_to_uh_minus_1(case, seed):
    task, (x0, s, _) = case
    controls = np.random.default_rng(seed).normal(size=(task.horizon, task.m))
    states = plain_states(task, x0, s, controls)
    expected, size = plain_cost(task, states, controls), cost_size(task, states, controls)
    assert close(control_cost(task, states, controls), expected, size)


def test_the_initial_state_is_not_charged():
    states = np.zeros((5, 3))
    states[0] = 9
    assert control_cost(a_task(), states, np.zeros((4, 2))) == 0


@pytest.mark.parametrize("name, cost", [("states", 12), ("controls", 1)])
def test_every_other_number_is_charged_at_its_own_step(name, cost):
    task = a_task(Q=[(t + 1) * np.eye(3) for t in range(4)], Q_final=9 * np.eye(3), R=np.eye(2) / 4)
    arrays = {"states": np.zeros((5, 3)), "controls": np.zeros((4, 2))}
    arrays[name][2, 1] = 2
    assert control_cost(task, **arrays) == cost


@given(cases(trials=(2, 3)), st.sampled_from(INFORMATION))
def test_leading_axes_are_trials_and_each_is_what_it_would_be_alone(case, information):
    task, (x0, s, errors) = case
    states, controls = run_controller(task, x0, s, s + errors, information)
    costs, plans = control_cost(task, states, controls), plan(task, x0, s)
    assert costs.shape == (2, 3)
    size = solution_size(task, controls, x0, s, errors)  # a batch may add in another order
    for k in np.ndindex(2, 3):
        u = run_controller(task, x0, s[k], s[k] + errors[k], information)[1]
        assert close(controls[k], u, size) and close(plans[k], plan(task, x0, s[k]), size)
        assert close(states[k], plain_states(task, x0, s[k], controls[k]), x0, u, s)
        expected = plain_cost(task, states[k], controls[k])
        assert close(costs[k], expected, cost_size(task, states[k], controls[k]))


def test_a_single_trial_has_a_number_as_its_cost():
    assert np.ndim(control_cost(a_task(), np.zeros((5, 3)), np.zeros((4, 2)))) == 0


# --------------------------------------------------------------------------------- the recursion


@pytest.mark.parametrize("seed", range(8))
def test_over_a_long_horizon_riccati_reaches_the_stationary_solution(seed):
    rng = np.random.default_rng(seed)
    n, m = 1 + seed % 4, 1 + seed % 3
    A, B = rng.normal(size=(n, n)), rng.normal(size=(n, m))
    law = riccati(ControlTask(A, B, np.ones((n, 1)), np.eye(n), 2 * np.eye(m), horizon=400))
    stationary = solve_discrete_are(A, B, np.eye(n), 2 * np.eye(m))
    # As Q > 0, the closed loop is stable; 400 steps are many of its time constants here.
    assert np.abs(law.P[0] - stationary).max() <= 1e-9 * np.abs(stationary).max()
    assert np.abs(np.linalg.eigvals(law.closed_loop[0])).max() < 1


@given(tasks(max_horizon=4), st.data())
def test_p_is_the_optimal_cost_to_go_found_by_least_squares(task, data):
    t = data.draw(st.integers(0, task.horizon - 1))
    F, M, _, Q, R = stacked(task, t)
    values, vectors = np.linalg.eigh(Q)
    root = np.sqrt(np.maximum(values, 0))[:, None] * vectors.T  # root'root = Q
    rows = np.vstack([root @ M, np.linalg.cholesky(R).T])
    goal = np.vstack([root @ F, np.zeros((len(R), task.n))])
    # min over u of |root (F x + M u)|^2 + u'Ru is |left x|^2, and P_t charges x_t as well.
    left = goal - rows @ np.linalg.lstsq(rows, goal)[0]
    reach = [max(1, np.linalg.norm(at(task.A, k), 2)) for k in range(t, task.horizon)]
    size = np.linalg.norm(Q, 2) * np.prod(reach) ** 2  # what doing nothing can cost
    assert close(riccati(task).P[t], left.T @ left + at(task.Q, t), size)


@given(tasks(), st.data())
def test_the_feedback_is_the_first_control_of_the_best_plan_from_each_state(task, data):
    t = data.draw(st.integers(0, task.horizon - 1))
    nothing = np.zeros((task.horizon - t, task.p))
    first = np.array([dense_plan(task, x, nothing, t)[0] for x in np.eye(task.n)]).T
    assert close(-riccati(task).K[t], first, solution_size(task, first, np.ones(1)))


@given(tasks())
def test_the_parts_of_riccati_obey_their_definitions(task):
    law, H = riccati(task), task.horizon
    assert [len(part) for part in law] == [H + 1, H, H, H]
    assert (law.P[H] == task.Q_final).all()
    for t in range(H):
        A, B, P = at(task.A, t), at(task.B, t), law.P[t + 1]
        assert close(law.S[t], at(task.R, t) + B.T @ P @ B)
        assert close(law.closed_loop[t], A - B @ law.K[t], A)
        assert (law.P[t] == law.P[t].T).all()


@pytest.mark.parametrize("growth, horizon", [(2.0, 600), (1e80, 3), (1e76, 3), (1e200, 1)])
def test_a_cost_to_go_beyond_the_largest_float_is_refused_never_returned(growth, horizon):
    task = ControlTask([[growth]], [[0]], [[1]], [[1]], [[1]], horizon)
    with pytest.raises(ValueError, match=r"^task: the cost-to-go overflows"):
        riccati(task)


# -------------------------------------------------------------------------------------- the plan


@given(cases())
def test_the_plan_is_that_of_the_dense_formula(case):
    task, (x0, s, _) = case
    expected = dense_plan(task, x0, s)
    assert close(plan(task, x0, s), expected, solution_size(task, expected, x0, s))


@given(cases(max_horizon=3))
def test_the_plan_minimises_the_quadratic_that_its_cost_is(case):
    task, (x0, s, _) = case
    shape, size = (task.horizon, task.m), task.horizon * task.m

    def cost(u):
        u = u.reshape(shape)
        return plain_cost(task, plain_states(task, x0, s, u), u)

    # J(u) = c + g'u + u'Ku exactly: probe c, g and K with whole steps; the minimum has 2Ku = -g.
    steps, c = np.eye(size), cost(np.zeros(size))
    K = np.array([[cost(i + j) - cost(i) - cost(j) + c for j in steps] for i in steps]) / 2
    g = np.array([cost(i) - cost(-i) for i in steps]) / 2
    u = plan(task, x0, s).ravel()
    states = plain_states(task, x0, s, u.reshape(shape))
    terms = (c + np.trace(K)) * (1 + np.abs(u).sum()) + cost_size(task, states, u.reshape(shape))
    assert (
        np.abs(2 * K @ u + g).max() <= 1e-10 * terms
    )  # probing subtracts costs, so 100 times more


@given(cases(), SEEDS)
def test_departing_from_the_plan_by_d_costs_at_least_what_the_controls_d_cost(case, seed):
    task, (x0, s, _) = case
    u = plan(task, x0, s)
    d = np.random.default_rng(seed).normal(size=u.shape)
    # J(u + d) - J(u) = d'Kd at a stationary u, and K = R-bar + M'Q-bar M.
    best, other = (plain_cost(task, plain_states(task, x0, s, v), v) for v in (u, u + d))
    least = sum(d[t] @ at(task.R, t) @ d[t] for t in range(task.horizon))
    assert other - best >= least - 1e-10 * (best + other)


# --------------------------------------------------------------------------- the four controllers


@given(cases(), st.sampled_from(INFORMATION))
def test_the_states_of_every_controller_obey_the_dynamics(case, information):
    task, (x0, s, errors) = case
    states, controls = run_controller(task, x0, s, s + errors, information)
    assert (states[0] == x0).all() and controls.shape == (task.horizon, task.m)
    assert close(states, plain_states(task, x0, s, controls), x0, controls, s)


@given(cases())
def test_open_loop_carries_out_the_plan_for_the_forecast(case):
    task, (x0, s, errors) = case
    controls = run_controller(task, x0, s, s + errors, "open_loop")[1]
    expected = dense_plan(task, x0, s + errors)
    assert close(controls, expected, solution_size(task, expected, x0, s, errors))
    assert (run_controller(task, x0, s, s + errors)[1] == controls).all()  # the default


@given(cases())
def test_preview_plans_anew_from_the_true_state_with_the_rest_of_the_forecast(case):
    task, (x0, s, errors) = case
    controls = run_controller(task, x0, s, s + errors, "preview")[1]
    expected = replanned(task, x0, s, lambda t: (s + errors)[t:])
    assert close(controls, expected, solution_size(task, expected, x0, s, errors))


@given(cases(), st.booleans(), SEEDS)
def test_causal_plans_anew_with_this_estimate_and_the_prior_mean_after_it(case, stated, seed):
    task, (x0, s, errors) = case
    prior = np.random.default_rng(seed).normal(size=s.shape) * stated
    prior_mean = prior if stated else None
    controls = run_controller(task, x0, s, s + errors, "causal", prior_mean)[1]
    expected = replanned(task, x0, s, lambda t: np.vstack([(s + errors)[t], prior[t + 1 :]]))
    assert close(controls, expected, solution_size(task, expected, x0, s, errors, prior))


@given(cases())
def test_measurement_plans_anew_from_the_perceived_state_and_expects_no_input(case):
    task, (x0, s, errors) = case
    controls = run_controller(task, x0, s, s + errors, "measurement")[1]
    zero = np.zeros(s.shape)
    expected = replanned(
        task, x0, s, lambda t: zero[t:], lambda t, x: x + at(task.C, t) @ errors[t]
    )
    assert close(controls, expected, solution_size(task, expected, x0, s, errors))


@given(cases())
def test_without_errors_open_loop_and_preview_are_the_plan(case):
    task, (x0, s, _) = case
    expected = plan(task, x0, s)
    for information in ("open_loop", "preview"):
        controls = run_controller(task, x0, s, s, information)[1]
        assert close(controls, expected, solution_size(task, expected, x0, s))


@given(cases())
def test_causal_with_the_forecast_as_its_prior_mean_is_preview(case):
    task, (x0, s, errors) = case
    causal = run_controller(task, x0, s, s + errors, "causal", prior_mean=s + errors)
    preview = run_controller(task, x0, s, s + errors, "preview")
    assert close(causal[0], preview[0]) and close(causal[1], preview[1])


@given(cases(max_horizon=1))
def test_over_a_single_step_the_first_three_patterns_are_one(case):
    task, (x0, s, errors) = case
    expected = dense_plan(task, x0, s + errors)
    for information in ("open_loop", "preview", "causal"):
        controls = run_controller(task, x0, s, s + errors, information)[1]
        assert close(controls, expected, solution_size(task, expected, x0, s, errors))
