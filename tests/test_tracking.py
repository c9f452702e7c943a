"""Cross costs, references, known disturbances and uneven steps, by stacked matrices and 60 digits.

Of a task the oracles read its arrays alone.  Without true inputs and from rest, right estimates
cost nothing, so J(fed e) is e'Psi e; in 60 digits, Psi is read off the flights of unit errors.
"""

from decimal import Decimal, localcontext

import numpy as np
import pytest
from scipy.linalg import block_diag, expm, solve_discrete_are
from test_digits import DIGITS, entry_error, precise, solved

from modelselect import (
    INFORMATION,
    PATTERNS,
    ControlTask,
    Pattern,
    control_cost,
    plan,
    preview_regret,
    prior_pull,
    psi,
    riccati,
    run_controller,
    sensitivity,
)

from strategies import at, plain_cost, plain_states, stacked, weight

seeds = pytest.mark.parametrize("seed", range(12))
patterns = pytest.mark.parametrize("information", PATTERNS)


def crossed(seed, stiff=1.0, cross=True):
    """A task whose states and controls cost together; of even seeds all matrices vary."""
    rng = np.random.default_rng([3, seed])
    n, m, p = (int(rng.integers(1, top)) for top in (4, 3, 3))
    H = int(rng.integers(2, 7))
    lead = (H,) * (seed % 2 == 0)
    G = rng.normal(size=(*lead, n + m, int(rng.integers(1, n + m + 1))))
    joint = G @ np.swapaxes(G, -1, -2)
    Q, N, R = joint[..., :n, :n], joint[..., :n, n:], joint[..., n:, n:]
    return ControlTask(
        rng.normal(size=(*lead, n, n)) / np.sqrt(n),
        rng.normal(size=(*lead, n, m)),
        rng.normal(size=(*lead, n, p)),
        Q,
        R * stiff**2 + 0.1 * stiff**2 * np.eye(m),
        H,
        Q_final=np.eye(n),
        N=N * stiff if cross else None,
    )


def draw(task, seed):
    """Initial state, inputs, errors and gains."""
    rng, shape = np.random.default_rng([5, seed]), (task.horizon, task.p)
    return 9 * rng.normal(size=task.n), *rng.normal(size=(2, *shape)), gains_of(task, rng)


def gains_of(task, rng):
    return rng.normal(size=(task.horizon, task.n, task.p)) / 2


def taken(information, gains):
    return {"gains": gains} if PATTERNS[information].gains else {}


def cross_cost(task, states, controls):
    """The sum of 2 x_t'N u_t, index by index, x_0 included."""
    terms = [
        2 * states[t][i] * at(task.N, t)[i, j] * controls[t][j]
        for t in range(task.horizon)
        for i in range(task.n)
        for j in range(task.m)
    ]
    return sum(terms)


def total(task, states, controls):
    return plain_cost(task, states, controls) + cross_cost(task, states, controls)


def best(task, x0, s, reference, disturbance):
    """Stacked matrices: minimise the cost of x - r over all u at once, x = F x_0 + M u + ..."""
    H, n = task.horizon, task.n
    F, M, Z, Q, R = stacked(task)
    D = stacked(ControlTask(task.A, task.B, np.eye(n), task.Q, task.R, H, task.Q_final))[2]
    N = block_diag(*(at(task.N, t) for t in range(H)))
    free = F @ x0 + Z @ s.ravel() + D @ disturbance.ravel() - reference[1:].ravel()
    before = np.concatenate([x0 - reference[0], free[:-n]])  # x_0 - r_0 .. x_{H-1} - r_{H-1}
    late = np.vstack([np.zeros((n, M.shape[1])), M[:-n]])
    K = R + M.T @ Q @ M + late.T @ N + N.T @ late
    return -np.linalg.solve(K, M.T @ Q @ free + N.T @ before).reshape(H, task.m)


# ------------------------------------------------------------------------------ the cross cost


@seeds
def test_the_cost_adds_the_cross_terms_of_x0_to_xh_minus_1(seed):
    task, rng = crossed(seed), np.random.default_rng(seed)
    x, u = rng.normal(size=(task.horizon + 1, task.n)), rng.normal(size=(task.horizon, task.m))
    assert control_cost(task, x, u) == pytest.approx(total(task, x, u), rel=1e-12)


@seeds
def test_the_plan_under_cross_costs_is_that_of_stacked_matrices(seed):
    task = crossed(seed)
    x0, s, _, _ = draw(task, seed)
    nothing = np.zeros((task.horizon + 1, task.n))
    expected = best(task, x0, s, nothing, nothing[1:])
    np.testing.assert_allclose(plan(task, x0, s), expected, atol=1e-10 * np.abs(expected).max())


@seeds
def test_the_open_loop_psi_under_cross_costs_is_that_of_stacked_matrices(seed):
    task = crossed(seed)
    _, M, Z, Q, R = stacked(task)
    N = block_diag(*(at(task.N, t) for t in range(task.horizon)))
    late, drift = (np.vstack([np.zeros((task.n, X.shape[1])), X[: -task.n]]) for X in (M, Z))
    K, L = R + M.T @ Q @ M + late.T @ N + N.T @ late, M.T @ Q @ Z + N.T @ drift
    np.testing.assert_allclose(psi(task), L.T @ np.linalg.solve(K, L), atol=1e-10 * abs(L).max())


@pytest.mark.parametrize("seed", range(1, 12, 2))
def test_over_a_long_horizon_riccati_reaches_the_stationary_solution_with_n(seed):
    task = crossed(seed)
    rng = np.random.default_rng(seed)
    A, Q = rng.normal(size=(task.n, task.n)), task.Q + np.eye(task.n)
    law = riccati(ControlTask(A, task.B, task.C, Q, task.R, 400, N=task.N))
    P = solve_discrete_are(A, task.B, Q, task.R, s=task.N)
    K = np.linalg.solve(task.R + task.B.T @ P @ task.B, task.B.T @ P @ A + task.N.T)
    np.testing.assert_allclose(law.P[0], P, rtol=1e-8, atol=1e-8)
    np.testing.assert_allclose(law.K[0], K, rtol=1e-8, atol=1e-8)


def believing(task, information, gains):
    """States and controls, in 60 digits, of pH robots at rest that are fed a unit error each."""
    H, n, p, row = task.horizon, task.n, task.p, PATTERNS[information]
    A, B, C, R, N = (
        [precise(at(M, t)) for t in range(H)] for M in (task.A, task.B, task.C, task.R, task.N)
    )
    Q = [None, *(precise(weight(task, t)) for t in range(1, H + 1))]
    P, K, S, q = Q[H], [None] * H, [None] * H, precise(np.zeros((n, p * H)))
    asked, told = [None] * H, [precise(np.eye(p * H)[t * p : (t + 1) * p]) for t in range(H)]
    for t in reversed(range(H)):
        S[t] = R[t] + B[t].T @ P @ B[t]
        K[t] = solved(S[t], B[t].T @ P @ A[t] + N[t].T)
        ahead = P @ (C[t] @ told[t]) * int(row.now) + q
        asked[t], closed = solved(S[t], B[t].T @ ahead), (A[t] - B[t] @ K[t]).T
        q = closed @ ahead if row.foresight else q
        P = (Q[t] if t else precise(at(task.Q, 0))) + A[t].T @ P @ A[t] - K[t].T @ S[t] @ K[t]
    x = expected = precise(np.zeros((n, p * H)))
    states, controls = [x], []
    for t in range(H):
        own, sees, gain = C[t] @ told[t], precise(np.linalg.pinv(at(task.C, t))), precise(gains[t])
        believed = {"open_loop": expected, "measurement": x + own}.get(information, x)
        if information == "filter":
            believed = expected + gain @ (sees @ (x - expected) + told[t])
        u = -K[t] @ believed - asked[t]
        expected = A[t] @ believed + B[t] @ u + own * int(row.now)
        x = A[t] @ x + B[t] @ u
        states.append(x)
        controls.append(u)
    return states, controls


def exact_psi(task, information, gains):
    """The cost of every two of these flights, as a bilinear form in 60 digits."""
    with localcontext(prec=DIGITS):
        x, u = believing(task, information, gains)
        found = 0
        for t in range(task.horizon):
            R, N, Q = (precise(M) for M in (at(task.R, t), at(task.N, t), weight(task, t + 1)))
            found = found + u[t].T @ R @ u[t] + x[t + 1].T @ Q @ x[t + 1]
            found = found + x[t].T @ N @ u[t] + u[t].T @ N.T @ x[t]
        return found * Decimal(1)


@patterns
@pytest.mark.parametrize("stiff", [1.0, 1e-3, 1e-5])
def test_psi_under_cross_costs_has_nine_digits_in_every_entry(information, stiff):
    for seed in range(6):
        task = crossed(seed, stiff)
        gains = gains_of(task, np.random.default_rng(seed))
        found = psi(task, information, **taken(information, gains))
        assert entry_error(found, exact_psi(task, information, gains)) < 1e-9, seed


@seeds
@patterns
def test_regret_under_cross_costs_is_quadratic(information, seed):
    task = crossed(seed)
    x0, s, e, gains = draw(task, seed)
    s = s * PATTERNS[information].exact
    given = taken(information, gains)
    wrong, right = (
        total(task, *run_controller(task, x0, s, s + k * e, information, **given)) for k in (1, 0)
    )
    regret = e.ravel() @ psi(task, information, **given) @ e.ravel()
    assert abs(wrong - right - regret) <= 1e-11 * (abs(wrong) + abs(right))
    if information == "preview":
        assert preview_regret(task, e) == pytest.approx(regret, rel=1e-10)


@seeds
@pytest.mark.parametrize("information", [*PATTERNS, "late"][1:])
def test_the_system_under_cross_costs_is_the_dense_psi_and_what_flights_cost(
    information, seed, monkeypatch
):
    late = Pattern(lambda look: look.late, False, False, False, "acts on the picture before this")
    monkeypatch.setitem(PATTERNS, "late", late)
    task = crossed(seed)
    x0, s, e, gains = draw(task, seed)
    given = taken(information, gains)
    system, Psi = sensitivity(task, information, **given), psi(task, information, **given)
    np.testing.assert_allclose(np.asarray(system), Psi, rtol=0, atol=1e-11 * Psi.max())
    flown = total(task, *run_controller(task, 0 * x0, 0 * s, e, information, **given))
    assert e.ravel() @ (system @ e.ravel()) == pytest.approx(flown, rel=1e-9)


@seeds
def test_the_pull_of_a_misjudged_start_under_cross_costs_is_what_plans_pay(seed):
    task = crossed(seed)
    m, _, e, _ = draw(task, seed)
    nothing = np.zeros((task.horizon + 1, task.n))
    plans = [best(task, m, k * e, nothing, nothing[1:]) for k in (1, 0)]
    wrong, right = (total(task, plain_states(task, 0 * m, 0 * e, u), u) for u in plans)
    regret = e.ravel() @ psi(task) @ e.ravel() + (prior_pull(task, m, "open_loop") * e).sum()
    assert abs(wrong - right - regret) <= 1e-10 * (wrong + right)


def test_no_cross_cost_is_a_cross_cost_of_zero_to_the_last_bit():
    for seed in range(4):
        without = crossed(seed, cross=False)
        zero = crossed(seed, cross=False)
        zero = ControlTask(
            zero.A, zero.B, zero.C, zero.Q, zero.R, zero.horizon, zero.Q_final,
            N=np.zeros((zero.n, zero.m)),
        )  # fmt: skip
        for information in INFORMATION:
            assert (psi(zero, information) == psi(without, information)).all()


def test_states_and_controls_must_cost_something_together():
    ControlTask([[1]], [[1]], [[1]], [[1]], [[1]], 3, N=[[1]])  # (x + u)^2
    message = r"^N: expected \[\[Q, N\], \[N', R\]\] positive semidefinite, found smallest eigenval"
    for N in ([[1.1]], [[[0]], [[0]], [[2]]]):
        with pytest.raises(ValueError, match=message):
            ControlTask([[1]], [[1]], [[1]], [[1]], [[1]], 3, N=N)
    with pytest.raises(
        ValueError,
        match=r"^N: expected shape \(n, m\) = \(1, 1\) \(n = 1 as of A, m = 1 ",
    ):
        ControlTask([[1]], [[1]], [[1]], [[1]], [[1]], 3, N=[[0, 0]])
    with pytest.raises(TypeError):
        ControlTask([[1]], [[1]], [[1]], [[1]], [[1]], 3, [[1]], [[1]])


# ------------------------------------------------------- references and known disturbances


def test_three_lines_for_a_robot_that_follows_a_reference():
    task = ControlTask([[1]], [[1]], [[1]], [[1]], [[0.1]], horizon=4, N=[[0.2]])
    ramp, slope, s = np.arange(5.0)[:, None], np.full((4, 1), 0.5), np.zeros((4, 1))
    states, controls = run_controller(task, [0], s, s, reference=ramp, disturbance=slope)
    assert control_cost(task, states - ramp, controls) < control_cost(task, states, controls)
    assert np.abs(states - ramp).max() < 0.2


def way(task, seed):
    """A reference (H+1, n) and a known disturbance (H, n)."""
    rng = np.random.default_rng([7, seed])
    return rng.normal(size=(task.horizon + 1, task.n)), rng.normal(size=(task.horizon, task.n))


@seeds
@pytest.mark.parametrize("information", ["open_loop", "preview"])
def test_a_reference_and_a_disturbance_are_answered_as_well_as_can_be(information, seed):
    task = crossed(seed)
    (x0, s, _, _), (r, d) = draw(task, seed), way(task, seed)
    states, controls = run_controller(task, x0, s, s, information, reference=r, disturbance=d)
    expected = best(task, x0, s, r, d)
    np.testing.assert_allclose(controls, expected, atol=1e-10 * np.abs(expected).max())
    x = x0
    for t in range(task.horizon):
        assert states[t] == pytest.approx(x, rel=1e-10, abs=1e-9)
        x = at(task.A, t) @ x + at(task.B, t) @ controls[t] + at(task.C, t) @ s[t] + d[t]


@seeds
@patterns
def test_neither_changes_what_errors_cost(information, seed):
    task = crossed(seed)
    (x0, s, e, gains), (r, d) = draw(task, seed), way(task, seed)
    s, e, given = s * PATTERNS[information].exact, 20 * e, taken(information, gains)
    given |= {"reference": r, "disturbance": d}

    def cost(errors):
        states, controls = run_controller(task, x0, s, s + errors, information, **given)
        return control_cost(task, states - r, controls)

    regret = e.ravel() @ psi(task, information, **taken(information, gains)) @ e.ravel()
    wrong, right = cost(e), cost(0 * e)
    assert abs(wrong - right - regret) <= 1e-12 * (abs(wrong) + abs(right))


@patterns
def test_a_reference_may_stand_still_and_the_way_there_is_flown(information):
    task = ControlTask([[1, 0.1], [0, 1]], [[0], [0.1]], [[1], [0]], np.eye(2), [[0.01]], 200)
    given = {"gains": [[0.5], [0.4]]} if PATTERNS[information].gains else {}
    calm = np.zeros((200, 1))
    one, same = (
        run_controller(task, [0, 0], calm, calm, information, reference=r, **given)
        for r in ([3, 0], np.tile([3.0, 0], (201, 1)))
    )
    assert (one[0] == same[0]).all() and (one[1] == same[1]).all()
    assert one[0][0] == pytest.approx([0, 0]) and one[0][-1] == pytest.approx([3, 0], abs=1e-3)


@patterns
def test_steps_may_be_uneven(information):
    """An oscillator whose camera is read after 0.02 to 0.3 s: A_t and B_t held exactly."""
    rng = np.random.default_rng(8)
    steps = rng.uniform(0.02, 0.3, 12)
    F = np.array([[0, 1, 0], [-4, -0.2, 1], [0, 0, 0]])  # position, speed, held control
    held = np.array([expm(F * dt) for dt in steps])
    C = np.array([[1.0], [0]])
    Q, R = (steps[:, None, None] * np.eye(k) for k in (2, 1))
    task = ControlTask(held[:, :2, :2], held[:, :2, 2:], C, Q, R, 12, Q_final=np.eye(2))
    x0, s, e, gains = draw(task, 0)
    s, given = s * PATTERNS[information].exact, taken(information, gains)
    wrong, right = (
        plain_cost(task, plain_states(task, x0, s, u), u)
        for k in (1, 0)
        for u in [run_controller(task, x0, s, s + 9 * k * e, information, **given)[1]]
    )
    regret = 81 * e.ravel() @ psi(task, information, **given) @ e.ravel()
    assert wrong - right == pytest.approx(regret, rel=1e-10)
