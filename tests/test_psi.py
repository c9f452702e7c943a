"""Psi (`eq:control_cost_diff`) against roll-outs, two-point priors and rational arithmetic."""

import warnings
from dataclasses import replace
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import modelselect
from modelselect import (
    INFORMATION,
    PATTERNS,
    ControlTask,
    Pattern,
    control_cost,
    plan,
    preview_regret,
    psi,
    riccati,
    run_controller,
)
from modelselect_parts.semidefinite import semidefinite_root

from strategies import (
    SEEDS,
    at,
    cases,
    dense_flight,
    idle_size,
    plain_cost,
    sign_patterns,
    stacked,
    tasks,
)

# A regret by roll-out is a difference of two costs: exact up to this fraction of their sum.
REGRET = 1e-9
# Psi made in two ways: sums of products, exact up to this fraction of `psi_size`.
ROUNDING = 1e-11

patterns = pytest.mark.parametrize("information", INFORMATION)


def psi_size(task):
    """What rounding in Psi = Y'Y, Y = K^{-1/2} M'Q-bar N, is relative to, also where Y cancels.

    |Y| <= |Q|^{1/2} |N|, and rounding in Y is relative to |K^{-1/2}| |M| |Q| |N|.
    """
    _, M, N, Q, _ = (np.linalg.norm(matrix, 2) for matrix in stacked(task))
    smallest = min(np.linalg.eigvalsh(at(task.R, t))[0] for t in range(task.horizon))  # K is larger
    return Q * N**2 * (1 + M * np.sqrt(Q / smallest))


def close(found, expected, *own):
    """Whether two forms of Psi, of these tasks, agree up to rounding."""
    size = max([np.abs(expected).max(), *map(psi_size, own)])
    return found.shape == np.shape(expected) and np.abs(found - expected).max() <= ROUNDING * size


def quadratic(Psi, errors):
    """e'Psi e of errors (H, p), index by index: component r of step t stands at t p + r."""
    e = [errors[t, r] for t in range(errors.shape[0]) for r in range(errors.shape[1])]
    return sum(e[i] * Psi[i, j] * e[j] for i in range(len(e)) for j in range(len(e)))


def regret_is_quadratic(task, x0, s, errors, information, prior_mean=None):
    """Whether J(fed s + e) - J(fed s), averaged over the trials in s, is e'Psi e."""
    Psi = psi(task, information)
    wrong, right = (
        control_cost(task, *run_controller(task, x0, s, s_hat, information, prior_mean))
        for s_hat in (s + errors, s)
    )
    tolerance = REGRET * np.mean(wrong + right) + ROUNDING * idle_size(task, x0, s, errors)
    return abs(np.mean(wrong - right) - quadratic(Psi, errors)) <= tolerance


# --------------------------------------------------------------------- what Psi is, by roll-out


@given(cases(), st.sampled_from(("open_loop", "preview")))
def test_open_loop_and_preview_regret_is_quadratic_for_every_input_and_initial_state(case, pattern):
    task, (x0, s, errors) = case
    assert regret_is_quadratic(task, x0, s, errors, pattern)


@given(cases())
def test_measurement_regret_is_quadratic_for_every_initial_state_when_nothing_disturbs(case):
    task, (x0, s, errors) = case
    assert regret_is_quadratic(task, x0, 0 * s, errors, "measurement")


@given(cases(max_horizon=3, max_p=2), SEEDS)
def test_measurement_regret_is_quadratic_in_expectation_over_zero_mean_inputs(case, seed):
    task, (x0, _, errors) = case
    spread = np.random.default_rng(seed).normal(size=errors.shape)
    s = spread * sign_patterns(*errors.shape)  # all equally likely draws: an exact expectation
    assert regret_is_quadratic(task, x0, s, errors, "measurement")


@given(cases(max_horizon=3, max_p=2), st.booleans(), SEEDS)
def test_causal_regret_is_quadratic_in_expectation_over_inputs_around_their_prior_mean(
    case, stated, seed
):
    task, (x0, _, errors) = case
    spread, prior = np.random.default_rng(seed).normal(size=(2, *errors.shape))
    s = prior * stated + spread * sign_patterns(*errors.shape)
    assert regret_is_quadratic(task, x0, s, errors, "causal", prior if stated else None)


@given(tasks(max_horizon=4), st.sampled_from(INFORMATION))
def test_every_entry_of_psi_is_the_cost_of_unit_errors_at_rest(task, information):
    # From x_0 = 0 under s = 0, the prior mean, J(fed s) = 0 and J is e'Psi e: nothing cancels.
    H, p = task.horizon, task.p
    pairs = np.eye(H * p)[:, None] + np.eye(H * p)  # e_i + e_j; 2 e_i on the diagonal
    e = pairs.reshape(H * p, H * p, H, p)
    cost = control_cost(task, *run_controller(task, np.zeros(task.n), 0 * e, e, information))
    unit = np.diag(cost) / 4
    assert close(psi(task, information), (cost - unit[:, None] - unit) / 2, task)


@given(cases(max_horizon=4), st.sampled_from(INFORMATION))
def test_psi_is_the_regret_of_a_robot_that_plans_anew_by_dense_algebra(case, information):
    # From rest under s = 0 errors alone cost something, and no code of ours computes what.
    task, (_, s, errors) = case
    expected = plain_cost(task, *dense_flight(task, np.zeros(task.n), 0 * s, errors, information))
    found = [quadratic(psi(task, information), errors)]
    found += [preview_regret(task, errors)] * (information == "preview")
    assert np.abs(np.array(found) - expected).max() <= ROUNDING * psi_size(task) * (errors**2).sum()


# ------------------------------------------------------------------------ what Psi is, by algebra


def exact_open_loop(task):
    """L'K^{-1}L in rational arithmetic: the plan's Psi without any rounding, for constant tasks."""

    def exact(matrix):
        return np.vectorize(lambda x: Fraction(float(x)), otypes=[object])(matrix)

    A, B, C = (exact(getattr(task, name)) for name in "ABC")
    H, n = task.horizon, task.n
    power = [exact(np.eye(n))]
    for _ in range(H - 1):
        power.append(A @ power[-1])
    M, N = (
        np.block(
            [[power[t - k] @ Z if k <= t else exact(0 * Z) for k in range(H)] for t in range(H)]
        )
        for Z in (B, C)
    )
    QM = exact(np.kron(np.eye(H), task.Q)) @ M
    L = QM.T @ N
    K = exact(np.kron(np.eye(H), task.R)) + QM.T @ M
    return (L.T @ eliminate(K, L)).astype(float)


def eliminate(K, L):
    """K^{-1} L by Gauss and Jordan, exact; K is positive definite, so no pivot is zero."""
    rows = np.hstack([K, L])
    for i in range(len(K)):
        rows[i] = rows[i] / rows[i, i]
        for k in range(len(K)):
            if k != i:
                rows[k] = rows[k] - rows[k, i] * rows[i]
    return rows[:, len(K) :]


@pytest.mark.parametrize("growth", [0.5, 1.25, 2, 10])
@pytest.mark.parametrize("horizon", [1, 2, 6, 14])
def test_open_loop_psi_of_a_stable_or_unstable_plant_is_exact(growth, horizon):
    A = growth * np.array([[1, 0.5], [-0.25, 1]])
    task = ControlTask(A, [[0], [1]], [[1], [0]], np.diag([1, 2]), [[4]], horizon)
    # entry by entry, though they differ by ten powers of ten
    assert psi(task) == pytest.approx(exact_open_loop(task), rel=1e-9)


@pytest.mark.parametrize("H", range(1, 6))
def test_the_plant_of_the_hardness_proof_has_a_constant_psi(H):
    # MATH.md, section 6: A = B = C = R = 1, Q = 0, Q_final = 1.
    open_loop = ControlTask([[1]], [[1]], [[1]], [[0]], [[1]], H, Q_final=[[1]])
    assert psi(open_loop) == pytest.approx(np.full((H, H), H / (1 + H)), rel=1e-12)
    B = np.zeros((H, 1, 1))
    B[0] = 1
    preview = ControlTask([[1]], B, [[1]], [[0]], [[1]], H, Q_final=[[1]])
    assert psi(preview, "preview") == pytest.approx(np.full((H, H), 1 / 2), rel=1e-12)


def test_the_four_patterns_of_a_two_step_integrator_by_hand():
    # P_2 = 1, S_1 = 2, K_1 = 1/2, P_1 = 1/2, S_0 = 3/2, K_0 = 1/3.
    task = ControlTask([[1]], [[1]], [[1]], [[0]], [[1]], 2, Q_final=[[1]])
    by_hand = {
        "open_loop": [[2 / 3, 2 / 3], [2 / 3, 2 / 3]],
        "preview": [[1 / 6, 1 / 6], [1 / 6, 1 / 6 + 1 / 2]],  # h_0 = (e_0 + e_1) / 2, h_1 = e_1
        "causal": [[1 / 6, 0], [0, 1 / 2]],
        "measurement": [[1 / 6, 0], [0, 1 / 2]],
    }
    for information, expected in by_hand.items():
        assert psi(task, information) == pytest.approx(np.array(expected), rel=1e-12, abs=1e-15)


@given(tasks(max_horizon=1))
def test_over_a_single_step_psi_is_that_of_least_squares(task):
    B, C, R, P = at(task.B, 0), at(task.C, 0), at(task.R, 0), task.Q_final
    S = R + B.T @ P @ B
    expected = C.T @ P @ B @ np.linalg.solve(S, B.T @ P @ C)
    for information in ("open_loop", "preview", "causal"):
        assert close(psi(task, information), expected, task)


@given(tasks())
def test_measurement_blocks_are_the_cost_of_feeding_back_the_error(task):
    law, p = riccati(task), task.p  # riccati has its own oracles in test_control.py
    Psi = psi(task, "measurement")
    for t in range(task.horizon):
        push = law.K[t] @ at(task.C, t)
        parts = (np.linalg.inv(law.S[t]), at(task.B, t).T, law.P[t + 1], at(task.A, t))
        size = np.linalg.multi_dot([*map(np.abs, parts), np.abs(at(task.C, t))]).max()
        size = size**2 * np.abs(law.S[t]).max()
        block = Psi[t * p : (t + 1) * p, t * p : (t + 1) * p]
        assert np.abs(block - push.T @ law.S[t] @ push).max() <= ROUNDING * size


# --------------------------------------------------------------------- a pattern is one row


@given(cases(max_horizon=3, max_p=2), SEEDS)
def test_a_fifth_pattern_is_one_row_of_the_table(case, seed):
    """Dead reckoning: it never looks again, and acts on this step's estimate as it comes."""
    task, (x0, _, errors) = case
    prior = np.random.default_rng(seed).normal(size=(task.horizon, task.p))
    row = Pattern(lambda look: look.expected, True, False, False, "reckons where it is")
    assert "reckoning" not in modelselect.INFORMATION
    PATTERNS["reckoning"] = row
    try:
        assert modelselect.INFORMATION[-1] == "reckoning"
        signs = sign_patterns(task.horizon, task.p)
        assert regret_is_quadratic(task, x0, prior + signs, errors, "reckoning", prior)
    finally:
        del PATTERNS["reckoning"]
    with pytest.raises(ValueError, match=r"^information: expected one of open_loop"):
        psi(task, "reckoning")


# ------------------------------------------------------------------------------ structure of Psi


@given(tasks(), st.sampled_from(INFORMATION))
def test_psi_is_symmetric_and_positive_semidefinite(task, information):
    Psi = psi(task, information)
    assert Psi.shape == (task.horizon * task.p,) * 2 and (Psi == Psi.T).all()
    assert np.linalg.eigvalsh(Psi)[0] >= -1e-13 * np.trace(Psi)  # rounding of the eigenvalues


@given(tasks(), st.sampled_from(("causal", "measurement")))
def test_without_a_forecast_no_two_steps_are_coupled(task, information):
    step = np.arange(task.horizon * task.p) // task.p
    assert (psi(task, information)[step[:, None] != step] == 0).all()


@given(tasks())
def test_an_error_in_one_step_costs_open_loop_most_and_causal_least(task):
    # J - J* = sum_t |u_t - u*_t(x_t)|^2 in S_t, where u*_t is the best feedback under the true s
    # (completed squares).  An error in step k alone moves u_t - u*_t(x_t): in causal at t = k only;
    # in preview by the same at t = k, and at t < k; in open loop by the same as preview at t <= k,
    # and at t > k, where the plan assumes a state that the error displaced.
    p, size = task.p, psi_size(task)
    least, middle, most = (psi(task, name) for name in ("causal", "preview", "open_loop"))
    for k in range(0, task.horizon * p, p):
        block = slice(k, k + p), slice(k, k + p)
        for more in (middle[block] - least[block], most[block] - middle[block]):
            assert np.linalg.eigvalsh((more + more.T) / 2)[0] >= -ROUNDING * size


def test_feedback_can_cost_more_than_open_loop_where_errors_cancel():
    task = ControlTask([[1]], [[1]], [[1]], [[0]], [[1]], 2, Q_final=[[1]])
    opposite = np.array([1, -1])  # open loop expects the displacement to undo itself, and is right
    assert opposite @ psi(task) @ opposite == pytest.approx(0, abs=1e-12)
    assert opposite @ psi(task, "preview") @ opposite == pytest.approx(1 / 2)


@given(tasks(), st.sampled_from(INFORMATION), st.integers(-3, 3))
def test_psi_scales_with_the_costs_and_with_the_square_of_c(task, information, power):
    k, Psi = 10.0**power, psi(task, information)
    dearer = replace(task, Q=task.Q * k, R=task.R * k, Q_final=task.Q_final * k)
    louder = replace(task, C=task.C * k)
    assert close(psi(dearer, information), Psi * k, dearer)
    assert close(psi(louder, information), Psi * k**2, louder)


def test_errors_without_any_effect_have_a_psi_of_rounding():
    """The only state that is charged is the last, which A C = 0 keeps them out of."""
    Q, C = np.zeros((2, 2, 2)), [[[1], [-1]], [[0], [0]]]
    B = [[[-1, 0], [-1, -1]], [[0, 1], [-1, -1]]]
    task = ControlTask(np.ones((2, 2)), B, C, Q, [[3, -1], [-1, 2]], 2, Q_final=2 * np.eye(2))
    for information in INFORMATION:
        assert np.abs(psi(task, information)).max() < 1e-25


@given(tasks(), st.sampled_from(INFORMATION), SEEDS)
def test_psi_does_not_depend_on_the_coordinates_of_the_state(task, information, seed):
    rng = np.random.default_rng(seed)
    rotation = np.linalg.qr(rng.normal(size=(task.n, task.n)))[0]
    T = rotation * rng.uniform(0.5, 2, task.n)  # x = T z
    into = np.linalg.inv(T)
    roots = (T.T @ semidefinite_root(M) for M in (task.Q, task.Q_final))
    Q, Q_final = (F @ F.swapaxes(-1, -2) for F in roots)  # semidefinite, where T'QT cancels
    same = replace(
        task, A=into @ task.A @ T, B=into @ task.B, C=into @ task.C, Q=Q, Q_final=Q_final
    )
    assert close(psi(same, information), psi(task, information), task, same)


@given(tasks(), st.sampled_from(INFORMATION), st.data())
def test_leaving_out_a_perception_input_leaves_out_its_rows_and_columns(task, information, data):
    r = data.draw(st.integers(0, task.p - 1))
    places = np.arange(task.horizon) * task.p + r
    one = psi(replace(task, C=task.C[..., r : r + 1]), information)
    assert close(one, psi(task, information)[np.ix_(places, places)], task)


def test_open_loop_is_the_default():
    task = ControlTask([[1]], [[1]], [[1]], [[1]], [[1]], 3)
    assert (psi(task) == psi(task, "open_loop")).all()


# ------------------------------------------------------------------------------- preview_regret


@given(cases(trials=(2, 3)))
def test_preview_regret_of_a_batch_is_that_of_the_dense_psi(case):
    task, (_, _, errors) = case
    Psi, found = psi(task, "preview"), preview_regret(task, errors)
    assert found.shape == (2, 3)
    for k in np.ndindex(2, 3):
        size = psi_size(task) * (errors[k] ** 2).sum()
        assert abs(found[k] - quadratic(Psi, errors[k])) <= ROUNDING * size


@given(cases())
def test_preview_regret_of_one_trial_is_the_number_found_by_roll_out(case):
    task, (_, s, errors) = case
    found, rest = preview_regret(task, errors), np.zeros(task.n)
    cost = control_cost(task, *run_controller(task, rest, 0 * s, errors, "preview"))
    assert np.ndim(found) == 0
    assert abs(found - cost) <= ROUNDING * psi_size(task) * (errors**2).sum()


# -------------------------------------------------------------------------- the published landing


def published_task():
    """The landing task of the paper's experiments, from the numbers in REFERENCE.md."""
    K_s, T_s, zeta, omega, V, dt = -0.95, 2.5, 0.5, 1, 20, 0.01
    row = [1 / (V * T_s) - 2 * zeta * omega / (V * T_s) + omega**2 / V]
    row += [2 * zeta * omega / T_s - omega**2 - 1 / T_s**2, 1 / T_s - 2 * zeta * omega]
    A = [[0, 1, 0, 0], [0, 1 / T_s, V / T_s, 0], [0, 0, 0, 1], [0, *row]]
    B = [[0], [0], [0], [omega**2 / K_s]]
    C = [[0], [0], [1], [0]]
    Q = np.diag([1e8, 1, 1e8, 1])
    return ControlTask(np.eye(4) + dt * np.array(A), dt * np.array(B), C, Q, [[1]], 150)


def test_the_published_landing_costs_what_the_authors_log_says():
    task, x0, s = published_task(), (1000, 2, 2, 0.2), np.zeros((150, 1))
    cost = control_cost(task, *run_controller(task, x0, s, s))
    assert f"{cost:.6e}" == "5.189117e+15"
    assert (run_controller(task, x0, s, s)[1] == plan(task, x0, s)).all()


@patterns
def test_the_published_psi_is_the_regret_of_the_roll_out(information):
    task, rng = published_task(), np.random.default_rng(0)
    s, errors = rng.uniform(0, 0.002, (150, 1)), rng.normal(10, 3, (150, 1))
    s *= information in ("open_loop", "preview")  # without a forecast: at the prior mean, 0
    assert regret_is_quadratic(task, (1000, 2, 2, 0.2), s, errors, information)


# --------------------------------------------------------------------- beyond double precision


def unstable(growth, horizon, reach):
    """A growing mode and a decaying one; the control reaches the growing one, or does not."""
    B = [[1], [1]] if reach else [[0], [1]]
    A = [[growth, 0], [0, 0.5]]
    return ControlTask(A, B, [[1], [0]], [[1, 0.5], [0.5, 1]], [[1]], horizon)


@pytest.mark.no_cover
@patterns
@pytest.mark.parametrize("reach", [True, False])
@pytest.mark.parametrize(
    "growth, horizon", [(1.1, 150), (2, 60), (2, 400), (2, 600), (1e76, 3), (1e100, 3), (1e160, 2)]
)
def test_of_an_unstable_plant_psi_is_finite_and_semidefinite_or_refused(
    growth, horizon, reach, information
):
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # what is refused is refused by us, not by NumPy
        try:
            Psi = psi(unstable(growth, horizon, reach), information)
        except ValueError as error:
            assert str(error).startswith("task: ") and "\n" not in str(error)
        else:
            assert np.isfinite(Psi).all()
            assert np.linalg.eigvalsh(Psi)[0] >= -1e-12 * np.trace(Psi)


@pytest.mark.no_cover
@pytest.mark.parametrize("growth, horizon", [(2, 24), (10, 14)])
def test_planning_open_loop_is_right_far_beyond_the_digits_of_the_stacked_matrices(growth, horizon):
    task = unstable(growth, horizon, reach=True)
    assert psi(task) == pytest.approx(exact_open_loop(task), rel=1e-9)


@patterns
@pytest.mark.parametrize("weight, gain", [(1e300, 1e10), (1e-300, 1e-10)])
def test_weights_near_the_ends_of_double_precision_are_refused_or_right(weight, gain, information):
    task = ControlTask([[1]], [[1]], [[gain]], [[weight]], [[weight]], 3)
    unit = psi(ControlTask([[1]], [[1]], [[1]], [[1]], [[1]], 3), information)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        try:
            found = psi(task, information)
        except ValueError as error:
            assert weight > 1 and str(error).startswith("task: ")
        else:
            assert weight < 1 and found == pytest.approx(unit * weight * gain**2, rel=1e-6)


def test_an_error_without_effect_beside_others_is_rounding_and_no_lost_digit():
    """The control undoes the first error at no cost, up to 12 units in the last place."""
    A = [[[1, 1], [0, 1]], [[0, 1], [-1, 0]], [[1, -1], [0, 1]]]
    B = [[[-1], [-1]], [[-1], [1]], [[0], [0]]]
    C = [[[-1, 0], [0, 1]], [[1, 1], [1, 1]], [[-1, 1], [0, 1]]]
    Q = [[[0, 0], [0, 10]], [[10, -10], [-10, 10]], [[10, 0], [0, 0]]]
    task = modelselect.ControlTask(A, B, C, Q, [[0.01]], 3, [[10, 10], [10, 10]])
    Psi = modelselect.psi(task, "preview")
    assert np.abs(Psi[0]).max() < 1e-13 * Psi.max() < Psi[1, 1]
