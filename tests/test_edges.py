"""Numerical edges: every solver on every edge, against enumeration in exact rational arithmetic.

`EDGES` is a table of small problems, each at an end of what the mathematics allows or of what
double precision holds.  Psi of unstable plants is held against rational and extended arithmetic.
"""

from dataclasses import replace
from fractions import Fraction
from functools import cache
from itertools import product

import numpy as np
import pytest

import modelselect as ms
from modelselect import INFORMATION, BlendProblem, ControlTask, SelectionProblem, psi

# ----------------------------------------------------------------------------- the table of edges


def orthogonal(rng, k):
    return np.linalg.qr(rng.normal(size=(k, k)))[0]


def a_problem(H=4, W=3, p=1, seed=0, unit=1.0, spectrum=None, grading=None, **changes):
    """Random signs and decreasing biases; Psi of this unit, spectrum or grading of its rows."""
    rng = np.random.default_rng(seed)
    V, k = orthogonal(rng, p * H), p * H
    Psi = (V * np.linspace(1, 3, k) if spectrum is None else V * spectrum(k)) @ V.T
    if grading is not None:
        Psi = Psi * grading(k)[:, None] * grading(k)
    fields = {
        "psi": unit * (Psi + Psi.T) / 2,
        "mean": rng.normal(size=(H, W, p)) * np.linspace(2, 0.5, W)[:, None],
        "variance": rng.random((H, W, p)),
        "model_cost": unit * np.arange(W),
    }
    return SelectionProblem(**fields | changes)


def twins(difference, **sizes):
    """The last model is the first but for a cost that moves the optimum by this fraction."""
    problem = a_problem(**sizes)
    mean, variance = problem.mean.copy(), problem.variance.copy()
    mean[:, -1], variance[:, -1] = mean[:, 0], variance[:, 0]
    least = ms.enumerate_schedules(replace(problem, mean=mean, variance=variance)).cost
    cost = np.array([0.0, 1.0, -difference * least])
    return replace(problem, mean=mean, variance=variance, model_cost=cost)


def without_a_model():
    cost = np.ones((4, 3))
    cost[[0, 1, 2], [0, 1, 2]] = np.inf
    return a_problem(model_cost=cost)


def rank_one(k):
    return np.append(np.zeros(k - 1), 1.0)


def falling(digits):
    """From 1 down to 10^-digits."""
    return lambda k: np.logspace(0, -digits, k)


COVARIANCE = np.einsum("twi,twj->twij", *[np.random.default_rng(1).normal(size=(3, 3, 2))] * 2)
EDGES = {
    "one step": lambda: a_problem(H=1),
    "one model": lambda: a_problem(W=1),
    "one step, one model": lambda: a_problem(H=1, W=1),
    "one step, p = 3": lambda: a_problem(H=1, p=3),
    "p = 3": lambda: a_problem(p=3),
    "covariance of rank 1": lambda: a_problem(H=3, p=2, variance=COVARIANCE),
    "all models equal": lambda: a_problem(
        mean=np.ones((4, 3, 1)), variance=np.ones((4, 3, 1)), model_cost=np.zeros(3)
    ),
    "equal but for the price": lambda: a_problem(
        mean=np.ones((4, 3, 1)), variance=np.ones((4, 3, 1))
    ),
    "no control cost (alpha = 0)": lambda: a_problem(alpha=0),
    "no perception cost (beta = 0)": lambda: a_problem(beta=0),
    "nothing costs (alpha = beta = 0)": lambda: a_problem(alpha=0, beta=0),
    "tiny alpha": lambda: a_problem(alpha=1e-12),
    "huge alpha": lambda: a_problem(alpha=1e12),
    "tiny beta": lambda: a_problem(beta=1e-12),
    "alpha = 1e-300, beta = 0": lambda: a_problem(alpha=1e-300, beta=0),
    "Psi = 0": lambda: a_problem(psi=np.zeros((4, 4))),
    "unbiased": lambda: a_problem(mean=np.zeros((4, 3, 1))),
    "certain": lambda: a_problem(variance=np.zeros((4, 3, 1))),
    "Psi of rank 1": lambda: a_problem(spectrum=rank_one),
    "paid to run models": lambda: a_problem(model_cost=[0, -5, -9]),
    "models missing": without_a_model,
    "a price that dwarfs Psi": lambda: a_problem(model_cost=1e12 + np.arange(3)),
    "a model that errs by 1e8": lambda: a_problem(
        mean=np.random.default_rng(2).normal(size=(4, 3, 1)) * [[1e8], [1], [1]]
    ),
    "a dead row in Psi": lambda: a_problem(psi=np.diag([1.0, 0, 2, 0])),
    **{
        f"Psi of size 1e{e}": lambda e=e: a_problem(unit=10.0**e, seed=e % 7)
        for e in (-300, -200, -100, -8, -4, 4, 8, 11, 16, 100, 280)
    },
    **{
        f"condition 1e{e}{', p = 2' * (p > 1)}": lambda e=e, p=p: a_problem(
            p=p, spectrum=falling(e)
        )
        for e in (6, 10, 12, 14)
        for p in (1, 2)
    },
    **{
        f"graded, condition 1e{2 * e}": lambda e=e: a_problem(grading=falling(e)) for e in (3, 5, 7)
    },
    **{
        f"tied to 1e-{e}{', p = 2' * (p > 1)}": lambda e=e, p=p: twins(10.0**-e, p=p)
        for e in (6, 8, 9, 10, 12, 15)
        for p in (1, 2)
    },
}
EXACT = {
    "enumerate_schedules": ms.enumerate_schedules,
    "plain_dynamic_program": ms.plain_dynamic_program,
    "dynamic_program": ms.dynamic_program,
    "branch_and_bound": ms.branch_and_bound,
    "solve": ms.solve,
}
edges = pytest.mark.parametrize("edge", EDGES)


@cache
def posed(edge):
    return EDGES[edge]()


@cache
def solved(solver, edge):
    return EXACT[solver](posed(edge))


# ------------------------------------------------------------------------------------ the oracle


def exactly(array):
    """The rational numbers that floating-point numbers are."""
    found = np.empty(np.shape(array), dtype=object)
    found.flat = [Fraction(float(x)) for x in np.ravel(array)]
    return found


@cache
def enumerated(edge):
    """{schedule: expected total in rational arithmetic}, by the definition."""
    problem = posed(edge)
    H, W, p = problem.mean.shape
    Psi, mean, variance = (exactly(x) for x in (problem.psi, problem.mean, problem.variance))
    alpha, beta = Fraction(problem.alpha), Fraction(problem.beta)
    price = np.broadcast_to(problem.model_cost, (H, W))
    blocks = [Psi[t * p : (t + 1) * p, t * p : (t + 1) * p] for t in range(H)]
    full = variance.ndim == 4
    noise = [
        [(blocks[t] * (v if full else np.diag(v))).sum() for v in variance[t]] for t in range(H)
    ]
    totals = {}
    for c in product(range(W), repeat=H):
        if all(np.isfinite(price[t, w]) for t, w in enumerate(c)):
            mu = np.concatenate([mean[t, w] for t, w in enumerate(c)])
            control = mu @ Psi @ mu + sum(noise[t][w] for t, w in enumerate(c))
            paid = sum(Fraction(float(price[t, w])) for t, w in enumerate(c))
            totals[c] = alpha * control + beta * paid
    return totals


def optimum(edge):
    return min(enumerated(edge).values())


def slack(edge):
    """What rounding and the optimality gap allow: a fraction of the optimum and of its terms."""
    problem = posed(edge)
    return Fraction(ms.OPTIMALITY_GAP) * abs(optimum(edge)) + 64 * Fraction(problem.rounding)


# ------------------------------------------------------------------------- every solver, every edge


@pytest.mark.no_cover
@edges
@pytest.mark.parametrize("solver", EXACT)
def test_an_exact_solver_finds_and_proves_the_optimum(solver, edge):
    problem, least = posed(edge), optimum(edge)
    found = solved(solver, edge)
    chosen = enumerated(edge)[tuple(found.choices.tolist())]
    assert chosen - least <= slack(edge)
    assert abs(Fraction(found.cost) - chosen) <= slack(edge)
    assert Fraction(found.lower_bound) <= least + slack(edge)
    assert found.is_optimal or Fraction(found.cost) - Fraction(found.lower_bound) <= slack(edge)
    assert ms.check_certificate(problem, found) <= least + slack(edge)


@edges
def test_enumeration_finds_the_very_best_where_doubles_tell_them_apart(edge):
    totals = sorted(enumerated(edge).values())
    found = enumerated(edge)[tuple(solved("enumerate_schedules", edge).choices.tolist())]
    clear = Fraction(8 * posed(edge).rounding)  # doubles cannot tell less
    assert found <= next((x for x in totals if x > totals[0] + clear), totals[-1])


@pytest.mark.no_cover
@edges
@pytest.mark.parametrize("relaxed", [ms.relax, ms.relax_interior_point])
def test_a_relaxation_brackets_its_optimum_below_that_of_schedules(relaxed, edge):
    problem = posed(edge)
    found = relaxed(problem)
    assert (found.weights >= 0).all()
    np.testing.assert_allclose(found.weights.sum(axis=1), 1, rtol=1e-12)
    assert not found.weights[np.isinf(problem.linear)].any()
    assert np.isfinite([found.value, found.bound]).all()
    assert Fraction(found.bound) <= optimum(edge) + slack(edge)
    negligible = 1e-12 * np.abs(problem.linear[np.isfinite(problem.linear)]).max()
    if edge != "a model that errs by 1e8":  # there, rounding ends the search, and the gap says so
        assert found.gap <= 1e-6 or found.value - found.bound <= negligible + 1e-100


@edges
def test_round_and_swap_is_between_its_bound_and_no_better_than_the_optimum(edge):
    problem = posed(edge)
    found = ms.round_and_swap(problem)
    chosen = enumerated(edge)[tuple(found.choices.tolist())]
    assert abs(chosen - Fraction(found.cost)) <= slack(edge)
    assert Fraction(found.lower_bound) <= optimum(edge) + slack(edge)
    assert ms.check_certificate(problem, found) == found.root_bound
    for t, w in np.ndindex(*problem.mean.shape[:2]):  # no swap helps
        other = (*found.choices[:t].tolist(), w, *found.choices[t + 1 :].tolist())
        assert enumerated(edge).get(other, np.inf) >= chosen - slack(edge)


@edges
def test_a_blend_is_proved_best_among_corners_and_points_between(edge):
    problem = posed(edge)
    if edge == "models missing":
        with pytest.raises(ValueError, match=r"^worst: expected an available model"):
            BlendProblem(problem)
        return
    blend = BlendProblem(problem)
    far_off = edge == "a model that errs by 1e8"  # 1e-16 of it is felt: the gap says so
    found = ms.solve_blend(blend, max_iterations=1000 if far_off else 100_000)
    H = len(problem.mean)
    corners = np.array(list(product((0.0, 1.0), repeat=H)))
    points = np.concatenate([corners, np.random.default_rng(0).random((50, H))])
    values = blend.total_cost(points)
    scale = 1e-9 * abs(found.cost) + 64 * problem.rounding
    assert (found.choices >= 0).all() and (found.choices <= 1).all()
    assert found.lower_bound <= found.cost <= values.min() + scale
    assert found.cost - found.lower_bound <= 2 * scale or far_off
    # A corner takes at each step the worst model or the best one: as schedules cost.
    schedules = np.where(corners > 0, problem.mean.shape[1] - 1, 0)
    exact = [float(enumerated(edge)[tuple(c.tolist())]) for c in schedules]
    np.testing.assert_allclose(values[: len(corners)], exact, rtol=1e-9, atol=scale)


@pytest.mark.no_cover
@edges
def test_costs_scale_with_the_problem(edge):
    """Powers of two change no digit of Psi, and so none of the answer."""
    problem = posed(edge)
    size = np.abs(problem.psi).max() or 1.0
    k = 2.0**26 if size < 1e200 else 0.5
    scaled = replace(problem, psi=k * problem.psi, model_cost=k * problem.model_cost)
    for name, solver in EXACT.items():
        one, other = solved(name, edge), solver(scaled)
        assert other.cost == pytest.approx(k * one.cost, rel=1e-12, abs=0)
        assert (one.choices == other.choices).all()


@pytest.mark.parametrize("p", [1, 2])
@pytest.mark.parametrize("digits", [6, 8])
def test_what_is_cheaper_by_more_than_the_gap_is_chosen(digits, p):
    edge = f"tied to 1e-{digits}{', p = 2' * (p > 1)}"
    best = min(enumerated(edge), key=enumerated(edge).get)
    for solver in EXACT:
        assert tuple(solved(solver, edge).choices.tolist()) == best


def test_separable_edges_are_solved_step_by_step():
    for edge in ("no control cost (alpha = 0)", "Psi = 0", "unbiased", "a dead row in Psi"):
        found = ms.solve_separable(posed(edge))
        assert enumerated(edge)[tuple(found.choices.tolist())] == optimum(edge)


# -------------------------------------------------------------------------------- unstable plants


def eliminate(M, Y):
    """M^{-1}Y in rational arithmetic, by Gauss and Jordan; M is positive definite."""
    rows = np.concatenate([M, Y], axis=1)
    for i in range(len(M)):
        rows[i] = rows[i] / rows[i, i]
        for r in range(len(M)):
            if r != i and rows[r, i]:
                rows[r] = rows[r] - rows[r, i] * rows[i]
    return rows[:, len(M) :]


def stack_up(A, Z, H):
    """Block rows of the response of x_1..x_H to what enters through Z at steps 0..H-1."""
    powers = [Z]
    for _ in range(H - 1):
        powers.append(A @ powers[-1])
    zero = 0 * Z
    return np.block([[powers[t - k] if k <= t else zero for k in range(H)] for t in range(H)])


def exact_psi(task, information):
    """Psi in rational arithmetic; patterns other than open loop by the Riccati recursion."""
    A, B, C, Q, R, P = (exactly(getattr(task, key)) for key in ("A", "B", "C", "Q", "R", "Q_final"))
    H, p = task.horizon, task.p
    if information == "open_loop":
        M, N = stack_up(A, B, H), stack_up(A, C, H)
        weights = [Q] * (H - 1) + [P]
        QM = np.concatenate([w @ rows for w, rows in zip(weights, np.split(M, H), strict=True)])
        K, L = M.T @ QM, QM.T @ N
        for t in range(H):
            K[t * task.m : (t + 1) * task.m, t * task.m : (t + 1) * task.m] += R
        return L.T @ eliminate(K, L)
    Psi, h = exactly(np.zeros((p * H, p * H))), exactly(np.zeros((task.n, p * H)))
    for t in reversed(range(H)):
        rows, S = slice(t * p, (t + 1) * p), R + B.T @ P @ B
        K = eliminate(S, B.T @ P @ A)
        h[:, rows] = P @ C
        if information == "preview":
            Psi = Psi + (B.T @ h).T @ eliminate(S, B.T @ h)
        else:
            pull = K @ C if information == "measurement" else eliminate(S, B.T @ P @ C)
            Psi[rows, rows] = pull.T @ S @ pull
        h, P = (A - B @ K).T @ h, Q + A.T @ P @ (A - B @ K)
    return Psi


def unstable(growth, H, reach=True, p=1):
    """A growing and a decaying mode, coupled in cost; the control reaches the first, or not."""
    B = [[1], [1]] if reach else [[0], [1]]
    C = [[1], [0]] if p == 1 else [[1, 0, 1], [0, 1, 1]]
    A = [[growth, 0.25], [0, 0.5]] if reach else [[growth, 0], [0, 0.5]]
    return ControlTask(A, B, C, [[1, 0.5], [0.5, 1]], [[1]], H)


def row_error(found, exact):
    """Largest error relative to the sizes of its row and of its column: small rows count."""
    size = np.sqrt(np.maximum(np.diag(exact), 1e-300).astype(float))
    return float(np.abs((found - exact) / size / size[:, None]).max())


@pytest.mark.parametrize("information", INFORMATION)
@pytest.mark.parametrize(
    "growth, H, reach, p",
    [(1.25, 12, True, 1), (2, 12, True, 1), (2, 12, False, 1), (4, 10, True, 1), (2, 6, True, 3)],
)
def test_psi_of_an_unstable_plant_is_right_to_ten_digits_in_every_row(
    growth, H, reach, p, information
):
    task = unstable(growth, H, reach, p)
    exact = exact_psi(task, information)
    assert row_error(psi(task, information), exact.astype(float)) < 1e-10


def extended_psi(task, information):
    """As `exact_psi` in 64 bits of mantissa instead of 53, m = 1: for long horizons."""
    A, B, C, Q, R, P = (
        getattr(task, key).astype(np.longdouble) for key in ("A", "B", "C", "Q", "R", "Q_final")
    )
    H, p, b = task.horizon, task.p, B[:, 0]
    Psi = np.zeros((p * H, p * H), np.longdouble)
    h = np.zeros((task.n, p * H), np.longdouble)
    for t in reversed(range(H)):
        rows, s = slice(t * p, (t + 1) * p), (R + B.T @ P @ B)[0, 0]
        gain = (b @ P @ A) / s
        h[:, rows] = P @ C
        if information == "preview":
            Psi += np.outer(b @ h, b @ h) / s
        else:
            pull = gain @ C if information == "measurement" else b @ P @ C / s
            Psi[rows, rows] = np.outer(pull, pull) * s
        closed = A - np.outer(b, gain)
        h, P = closed.T @ h, Q + A.T @ P @ closed
        P = (P + P.T) / 2
    return Psi


@pytest.mark.no_cover
@pytest.mark.parametrize("information", INFORMATION)
@pytest.mark.parametrize("reach", [True, False])
@pytest.mark.parametrize("growth", [1.05, 1.5, 3, 30])
@pytest.mark.parametrize("H", [40, 150, 400])
def test_over_long_horizons_psi_is_right_or_refused_with_a_way_out(H, growth, reach, information):
    task = unstable(growth, H, reach)
    try:
        found = psi(task, information)
    except ValueError as error:
        assert str(error).startswith("task: ") and "\n" not in str(error)
        assert any(advice in str(error) for advice in ("preview", "shorten", "rescale"))
        assert information == "open_loop" or not reach  # feedback tames what it can reach
        return
    assert np.isfinite(found).all()
    assert (found == found.T).all()
    SelectionProblem(found / found.max(), np.zeros((H, 1, 1)), np.zeros((H, 1, 1)), [0])
    if information != "open_loop" and H <= 150:
        assert row_error(found, extended_psi(task, information)) < 1e-9


@pytest.mark.parametrize("gain", [1e-6, 1.0, 1e6])
@pytest.mark.parametrize("weight", [1e12, 1e15, 1e17, 1e20])
def test_controls_of_equal_effect_are_told_apart_or_refused(weight, gain):
    """Q far above R leaves only rounding to say how two equal controls share the work: evenly."""
    one = np.eye(1)
    task = ControlTask(one, [[gain, gain]], one, weight * one, np.eye(2), 3)
    for information in INFORMATION:
        try:
            found = psi(task, information)
        except ValueError as error:
            assert str(error).startswith("task: ") and "R" in str(error)
        else:
            exact = exact_psi(task, information).astype(float)
            assert np.abs(found - exact).max() < 1e-9 * exact.max()
    try:
        K = ms.riccati(task).K
    except ValueError as error:
        assert str(error).startswith("task: R is lost in rounding beside B'PB")
    else:
        assert weight * gain**2 <= 1e13
        np.testing.assert_allclose(K[:, 0], K[:, 1], rtol=1e-3)


def test_what_overflows_on_the_way_is_refused():
    one = np.eye(1)
    task = ControlTask(one, one, one, one, one, 2)
    for call, name in (
        (lambda: ms.preview_regret(task, [[1e200], [1]]), "errors"),
        (lambda: ms.control_cost(task, [[0], [1e200], [0]], [[1], [1]]), "states"),
        (lambda: ms.control_cost(task, [[0], [0], [0]], [[1e200], [1]]), "states"),
        (lambda: ms.reference_bound(a_problem(), np.full(4, 1e200)), "reference"),
        (lambda: BlendProblem(a_problem()).total_cost(np.full(4, 1e200)), "blend"),
    ):
        with pytest.raises(ValueError, match=f"^{name}: .*overflow"):
            call()


@pytest.mark.parametrize("information", ["causal", "preview", "measurement"])
@pytest.mark.parametrize(("horizon", "growth"), [(20, 2.0), (40, 2.0), (60, 1.2), (60, 1.5)])
def test_a_growing_mode_out_of_the_controls_reach_is_refused(information, horizon, growth):
    # T diag(growth, 0.5) T^{-1}, and B along the second mode: right to 2e-6 or less was nothing.
    T = np.array([[2.0, 1], [1, 1]])
    A = T @ np.diag([growth, 0.5]) @ np.linalg.inv(T)
    task = ms.ControlTask(A, T[:, 1:], [[1], [0]], np.eye(2), [[1]], horizon)
    with pytest.raises(ValueError, match=r"^task: Psi loses its digits"):
        ms.psi(task, information)


def test_a_growing_mode_that_the_cost_does_not_see_is_refused():
    A, B, C, Q = [[3, -2], [1, 0]], [[1], [1]], [[1], [0]], [[1, -2], [-2, 4]]
    with pytest.raises(ValueError, match=r"^task: Psi loses its digits"):
        ms.psi(ms.ControlTask(A, B, C, Q, [[1]], 60))  # 47114.6 came out for 59.382
