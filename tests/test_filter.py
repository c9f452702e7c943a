"""The pattern `filter`, gains for it, and what s means where models measure the state."""

import warnings
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.signal import cont2discrete

import landing
import modelselect as ms
from landing import half_width
from modelselect import (
    PATTERNS,
    ControlTask,
    Pattern,
    control_cost,
    kalman_gains,
    prior_pull,
    psi,
    run_controller,
    sensitivity,
)
from perception import gaussian_suite, sample_errors

from strategies import (
    SEEDS,
    at,
    cases,
    dense_plan,
    idle_size,
    plain_cost,
    plain_states,
    sign_patterns,
    tasks,
)


def draw_gains(task, seed, varying=True):
    rng = np.random.default_rng(seed)
    return rng.normal(size=(task.horizon,) * varying + (task.n, task.p)) / 2


def observed(task, x0, s, errors, gains, misjudged=0.0):
    """Cost of a robot that plans anew by dense algebra from what its observer makes of y + e."""
    x, expected, controls = np.array(x0), x0 + misjudged, np.zeros((task.horizon, task.m))
    for t in range(task.horizon):
        A, B, sees, gain = at(task.A, t), at(task.B, t), np.linalg.pinv(at(task.C, t)), gains[t]
        believed = expected + gain @ (sees @ x + errors[t] - sees @ expected)
        controls[t] = dense_plan(task, believed, 0 * s[t:], t)[0]
        expected = A @ believed + B @ controls[t]
        x = A @ x + B @ controls[t] + at(task.C, t) @ s[t]
    return plain_cost(task, plain_states(task, x0, s, controls), controls)


# ----------------------------------------------------------------------------------- the filter


def test_three_lines_for_a_robot_with_a_kalman_filter():
    task, s = ControlTask([[1]], [[1]], [[1]], [[1]], [[1]], horizon=3), np.zeros((3, 1))
    gains = kalman_gains(task, process_noise=[[1]], measurement_noise=[[2]])
    Psi = psi(task, "filter", gains=gains)
    states, controls = run_controller(task, [0], s, s + 1, "filter", gains=gains)
    assert control_cost(task, states, controls) == pytest.approx(Psi.sum())


@given(cases(max_horizon=4), SEEDS)
def test_a_filter_flies_like_an_observer_in_plain_loops(case, seed):
    task, (x0, s, errors) = case
    gains = draw_gains(task, seed)
    found = control_cost(task, *run_controller(task, x0, s, s + errors, "filter", gains=gains))
    expected = observed(task, x0, s, errors, gains)
    assert abs(found - expected) <= 1e-9 * (expected + idle_size(task, x0, s, errors))


@pytest.mark.parametrize("seed", range(20))
def test_its_regret_is_quadratic_without_noise_from_any_start(seed):
    rng = np.random.default_rng(seed)
    n, p, H = int(rng.integers(1, 4)), int(rng.integers(1, 3)), int(rng.integers(2, 12))
    A, B, C = rng.normal(size=(n, n)) / 2, rng.normal(size=(n, 1)), rng.normal(size=(n, p))
    task = ControlTask(A, B, C, np.eye(n), [[1]], H)
    x0, e, gains = rng.normal(size=n), 9 * rng.normal(size=(H, p)), draw_gains(task, seed, seed % 2)
    wrong, right = (
        control_cost(task, *run_controller(task, x0, 0 * e, e * k, "filter", gains=gains))
        for k in (1, 0)
    )
    Psi = psi(task, "filter", gains=gains)
    assert e.ravel() @ Psi @ e.ravel() == pytest.approx(wrong - right, rel=1e-10)


@given(cases(max_horizon=3, max_p=2), SEEDS)
def test_its_regret_is_quadratic_in_expectation_over_pushes_of_mean_zero(case, seed):
    task, (x0, _, errors) = case
    gains, spread = draw_gains(task, seed), np.random.default_rng(seed).normal(size=errors.shape)
    s = spread * sign_patterns(*errors.shape)  # all equally likely draws: an exact expectation
    wrong, right = (
        control_cost(task, *run_controller(task, x0, s, s + k * errors, "filter", gains=gains))
        for k in (1, 0)
    )
    e = errors.ravel()
    size = np.mean(wrong + right) + idle_size(task, x0, s, errors)
    assert abs(np.mean(wrong - right) - e @ psi(task, "filter", gains=gains) @ e) <= 1e-9 * size


def test_a_filter_that_measures_nothing_has_a_psi_all_the_same():
    """C = 0: errors enter through the gains, and next to nothing of them through this cost."""
    A, Q = [[0, 1], [-1, 0]], [[1, -1], [-1, 1]]
    task = ControlTask(A, [[-1], [-1]], [[0], [0]], Q, [[2]], 1)
    gains = np.random.default_rng(0).normal(size=(2, 1))
    assert abs(psi(task, "filter", gains=gains)).max() < 1e-25
    assert abs(np.asarray(sensitivity(task, "filter", gains=gains))).max() < 1e-25


def test_memory_couples_steps_under_feedback():
    task = ControlTask([[1]], [[1]], [[1]], [[1]], [[1]], 20)
    Psi = psi(task, "filter", gains=[[0.3]])
    blocks, every = np.abs(Psi.diagonal()).sum(), np.abs(Psi).sum()
    assert blocks < every / 2
    assert Psi[3, 0] / Psi[3, 1] == pytest.approx(0.7)  # an error is forgotten by 1 - 0.3 a step


def test_a_filter_that_believes_all_it_sees_of_the_whole_state_is_measurement():
    rng = np.random.default_rng(2)
    task = ControlTask(rng.normal(size=(2, 2)), np.ones((2, 1)), 2 * np.eye(2), np.eye(2), [[1]], 6)
    measured = psi(task, "measurement")
    np.testing.assert_allclose(psi(task, "filter", gains=task.C), measured, rtol=1e-12)


def test_constant_gains_are_the_same_at_every_step():
    task = ControlTask([[1]], [[1]], [[1]], [[1]], [[1]], 3)
    again = psi(task, "filter", gains=np.full((3, 1, 1), 0.4))
    assert (psi(task, "filter", gains=[[0.4]]) == again).all()


@pytest.mark.parametrize(
    "information, gains, message",
    [
        ("filter", None, r"^gains: required by 'filter' \(see kalman_gains\), found None$"),
        ("filter", [[1.0, 2]], r"^gains: expected shape \(n, p\) = \(1, 1\), found \(1, 2\)$"),
        ("filter", np.ones((2, 1, 1)), r"^gains: expected shape \(H, n, p\) = \(3, 1, 1\), found"),
        ("open_loop", [[1.0]], r"^gains: used only by 'filter', found with 'open_loop'$"),
    ],
)
def test_gains_stand_where_a_pattern_takes_them_and_only_there(information, gains, message):
    task, s = ControlTask([[1]], [[1]], [[1]], [[1]], [[1]], 3), np.zeros((3, 1))
    for call in (
        lambda: psi(task, information, gains=gains),
        lambda: run_controller(task, [1], s, s, information, gains=gains),
        lambda: prior_pull(task, [1], information, gains=gains),
    ):
        with pytest.raises(ValueError, match=message):
            call()


def test_a_refusal_names_every_row_that_takes_what_was_given(monkeypatch):
    monkeypatch.setitem(PATTERNS, "late", PATTERNS["filter"])
    monkeypatch.setitem(PATTERNS, "slow", PATTERNS["causal"])
    task, s = ControlTask([[1]], [[1]], [[1]], [[1]], [[1]], 3), np.zeros((3, 1))
    with pytest.raises(ValueError, match=r"^gains: used only by 'filter' or 'late', found with"):
        psi(task, "preview", gains=[[1.0]])
    with pytest.raises(ValueError, match=r"^prior_mean: used only by 'causal' or 'slow', found"):
        run_controller(task, [1], s, s, "preview", s)


def test_what_a_task_alone_defines_is_listed_and_every_row_says_what_it_assumes():
    assert ms.INFORMATION == ("open_loop", "preview", "causal", "measurement")
    assert all(row.assumes for row in PATTERNS.values())
    assert landing.Settings(information="filter").information == "filter"  # with gains of its own


@pytest.mark.parametrize("varying", [False, True])
def test_a_row_may_remember_a_step(monkeypatch, varying):
    """A camera whose picture is a step old when it is read: x_hat = A(x + Ce) + Bu of then."""
    row = Pattern(lambda look: look.late, False, False, False, "acts on the picture before this")
    monkeypatch.setitem(PATTERNS, "late", row)
    rng = np.random.default_rng(4)
    A, B, C = (rng.normal(size=(8,) * varying + (2, k)) / 2 for k in (2, 1, 2))
    task = ControlTask(A, B, C, np.eye(2), [[1]], 8)
    x0, e = rng.normal(size=2), rng.normal(size=(8, 2))

    def cost(errors):
        x, believed, controls = x0, x0, []
        for t in range(8):
            controls.append(dense_plan(task, believed, 0 * e[t:], t)[0])
            seen = x + at(C, t) @ errors[t]
            believed, x = (at(A, t) @ z + at(B, t) @ controls[t] for z in (seen, x))
        return plain_cost(task, plain_states(task, x0, 0 * e, controls), np.array(controls))

    expected = e.ravel() @ psi(task, "late") @ e.ravel()
    assert cost(e) - cost(0 * e) == pytest.approx(expected, rel=1e-10)
    flown = control_cost(task, *run_controller(task, x0, 0 * e, e, "late"))
    assert flown == pytest.approx(cost(e), rel=1e-12)


# ------------------------------------------------------------------------------------ the gains


@given(tasks(max_horizon=5, max_p=2), SEEDS)
def test_gains_that_vary_give_the_conditional_mean_of_a_gaussian(task, seed):
    rng, H, n, p = np.random.default_rng(seed), task.horizon, task.n, task.p
    W = [G @ G.T for G in rng.normal(size=(H, n, n))]
    V = [G @ G.T + np.eye(p) for G in rng.normal(size=(H, p, p))]
    gains = kalman_gains(task, W, V)
    # x_t and y_t as rows over all that is drawn: w_0 .. w_{H-1}, v_0 .. v_{H-1}
    x, states, seen, filtered = np.zeros((n, H * (n + p))), [], [], np.zeros((n, H * p))
    cov = np.zeros((H * (n + p),) * 2)
    for t in range(H):
        own, noise = (slice(t * n, (t + 1) * n), slice(H * n + t * p, H * n + (t + 1) * p))
        cov[own, own], cov[noise, noise] = W[t], V[t]
        y = np.linalg.pinv(at(task.C, t)) @ x
        y[:, noise] += np.eye(p)
        states.append(x)
        seen.append(y)
        x = at(task.A, t) @ x
        x[:, own] += np.eye(n)
    for t in range(H):
        sees, Y = np.linalg.pinv(at(task.C, t)), np.vstack(seen[: t + 1])
        filtered = filtered - gains[t] @ sees @ filtered
        filtered[:, t * p : (t + 1) * p] += gains[t]
        best = states[t] @ cov @ Y.T @ np.linalg.inv(Y @ cov @ Y.T)
        size = max(1, np.abs(best).max()) * np.linalg.cond(Y @ cov @ Y.T)
        assert np.abs(filtered[:, : (t + 1) * p] - best).max() <= 1e-11 * size
        filtered = at(task.A, t) @ filtered


@pytest.mark.parametrize("seed", range(5))
def test_constant_gains_are_those_that_the_recursion_comes_to(seed):
    rng = np.random.default_rng(seed)
    A, C, G = rng.normal(size=(3, 3)), rng.normal(size=(3, 2)), rng.normal(size=(3, 3))
    task = ControlTask(A, np.ones((3, 1)), C, np.eye(3), [[1]], 300)
    W, V = G @ G.T, np.diag([0.5, 2])
    steady, recursion = kalman_gains(task, W, V), kalman_gains(task, [W] * 300, V)
    assert (steady == steady[0]).all() and (recursion[0] == 0).all()
    np.testing.assert_allclose(recursion[-1], steady[0], rtol=1e-8, atol=1e-10)


def test_where_an_observer_does_not_settle_steady_gains_are_refused():
    task = ControlTask(np.eye(2), np.eye(2), [[1], [0]], np.eye(2), np.eye(2), 4)  # x_2 unseen
    with pytest.raises(ValueError) as refused:
        kalman_gains(task, np.eye(2), [[1]])
    expected = "process_noise: expected noise under which an observer of C^+ x settles, found none"
    way_out = "give it as (H, n, n) for gains from step to step"
    assert str(refused.value) == f"{expected} of a steady state; {way_out}"
    assert np.isfinite(kalman_gains(task, [np.eye(2)] * 4, [[1]])).all()
    with pytest.raises(ValueError, match=r"^measurement_noise: expected a positive definite"):
        kalman_gains(task, np.eye(2), [[0]])


# ----------------------------------------------------------------------------- a misjudged start


@pytest.mark.parametrize("seed", range(6))
def test_the_pull_of_a_misjudged_start_is_what_the_observer_pays_with_it(seed):
    rng = np.random.default_rng(seed)
    task = ControlTask(
        rng.normal(size=(3, 3)) / 2, rng.normal(size=(3, 2)), rng.normal(size=(3, 1)), np.eye(3),
        np.eye(2), 7,
    )  # fmt: skip
    x0, m, e, gains = *rng.normal(size=(2, 3)), rng.normal(size=(7, 1)), draw_gains(task, seed)
    wrong, right = (observed(task, x0, 0 * e, k * e, gains, m) for k in (1, 0))
    pull, Psi = prior_pull(task, m, gains=gains), psi(task, "filter", gains=gains)
    assert pull.shape == (7, 1)
    expected = e.ravel() @ Psi @ e.ravel() + pull.ravel() @ e.ravel()
    assert wrong - right == pytest.approx(expected, rel=1e-10)
    planned, perfect = (
        plain_cost(task, plain_states(task, x0, 0 * e, u), u)
        for u in (dense_plan(task, x0 + m, k * e) for k in (1, 0))
    )
    expected = e.ravel() @ psi(task) @ e.ravel() + (prior_pull(task, m, "open_loop") * e).sum()
    assert planned - perfect == pytest.approx(expected, rel=1e-10)
    assert not prior_pull(task, m, "preview").any()


# ------------------------------------------------- what s is, where models measure the state


def cart(H=40):
    """A cart whose camera measures where it is."""
    return ControlTask([[1, 0.1], [0, 1]], [[0], [0.1]], [[1], [0]], np.diag([1, 0.1]), [[0.1]], H)


@pytest.mark.parametrize("information, gains", [("measurement", None), ("filter", [[0.5], [0.4]])])
def test_who_gives_the_measured_state_as_s_is_told(information, gains):
    task, x0, calm = cart(), [1, 0], np.zeros((40, 1))
    ideal = run_controller(task, x0, calm, calm, information, gains=gains)
    s = ideal[0][:-1, :1]  # "what a perfect camera sees"
    for repeated in (
        s,
        np.tile(s, (3, 1, 1)),
        s + 0.05 * np.random.default_rng(0).normal(size=s.shape),
    ):
        with pytest.warns(UserWarning, match=r"^s: expected an unknown push C s of mean zero"):
            pushed = run_controller(task, x0, repeated, repeated, information, gains=gains)
        assert (control_cost(task, *pushed) > 10 * control_cost(task, *ideal)).all()


@given(st.integers(1, 40), st.sampled_from((1e-200, 0.01, 1, 100, 1e160)), SEEDS)
def test_a_push_of_mean_zero_is_not_taken_for_the_state(horizon, scale, seed):
    rng = np.random.default_rng(seed)
    s = scale * rng.normal(size=(2, horizon, 1))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        states, _ = run_controller(cart(horizon), rng.normal(size=2), s, s, "measurement")
    assert states.shape == (2, horizon + 1, 2) and np.isfinite(states).all()


# ----------------------------------------------------------------------------------- end to end


def cart_pole(H):
    """A pole of 1 m and 0.2 kg on a cart of 1 kg, at 20 Hz; a camera measures where the cart is."""
    F = np.array([[0, 1, 0, 0], [0, 0, -1.962, 0], [0, 0, 0, 1], [0, 0, 11.772, 0]])
    G = np.array([[0], [1], [0], [-1]])
    A, B, *_ = cont2discrete((F, G, np.eye(4), np.zeros((4, 1))), 0.05)
    return ControlTask(A, B, [[1], [0], [0], [0]], np.diag([1, 0.1, 10, 0.1]), [[0.01]], H)


def test_a_cart_pole_with_a_camera_and_a_filter_pays_what_was_predicted():
    H, trials, push = 100, 2000, 0.002
    task, rng = cart_pole(H), np.random.default_rng(11)
    gains = kalman_gains(task, np.diag([push, 0.01, 0.001, 0.01]) ** 2, [[0.01**2]])
    suite = gaussian_suite(  # metres: a bias that fades with the model, and noise
        lambda w, t: 0.02 * np.cos(t / 9 + w) / (1 + w), lambda w, t: 0.02 / (1 + w) + 0 * t,
        [0, 1, 2], np.arange(H),
    )  # fmt: skip
    Psi = psi(task, "filter", gains=gains)
    problem = ms.SelectionProblem(Psi, suite.mean, suite.variance, [0.0, 5, 10])
    schedule = ms.solve(problem)
    assert schedule.is_optimal and len(set(schedule.choices)) > 1
    s = push * rng.normal(size=(trials, H, 1))
    errors = sample_errors(suite, trials, rng)[:, np.arange(H), schedule.choices]
    flown, ideal = (
        control_cost(
            task, *run_controller(task, [0.5, 0, 0.05, 0], s, s + e, "filter", gains=gains)
        )
        for e in (errors, 0 * errors)
    )
    regret, predicted = flown - ideal, float(problem.control_term(schedule.choices))
    assert half_width(regret) < 0.03 * predicted
    assert abs(regret.mean() - predicted) < half_width(regret)
    forgetful = replace(problem, psi=psi(task, "measurement")).control_term(schedule.choices)
    assert abs(regret.mean() - forgetful) > 5 * half_width(regret)
