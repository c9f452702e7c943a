"""The solvers: every bound below, every heuristic above, every exact method at the optimum.

The oracle is `every_schedule` of strategies.py: the cost of each schedule, and their minimum.
"""

import inspect
from dataclasses import replace
from time import perf_counter

import cvxpy as cp
import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from scipy.optimize import lsq_linear

import modelselect as ms
from modelselect import SelectionProblem
from modelselect_parts import blends, column_generation, dominance, passes, trellis
from modelselect_parts import triangle as triangle_part
from modelselect_parts.semidefinite import cholesky_solver
from perception import published_suite, textbook_suite

from strategies import SEEDS, every_schedule, problems

EXACT = [
    ms.enumerate_schedules,
    ms.plain_dynamic_program,
    ms.dynamic_program,
    ms.branch_and_bound,
    ms.solve,
]
INEXACT = [ms.round_and_swap]
names = {"ids": lambda solver: solver.__name__}


def rounding(problem):
    """What cannot be told apart: 1e-10 of the largest terms that a cost is summed from."""
    felt = np.abs(problem.mean).max(axis=1).ravel()
    singles = problem.linear_size.max(axis=1).sum()
    return 1e-10 * float(felt @ np.abs(problem.quadratic) @ felt + singles)


def optimum(problem):
    return problem.total_cost(every_schedule(problem)).min()


def known_suite(seed, H=12, W=4, p=1, rank=None):
    """A coupled problem without special structure."""
    rng = np.random.default_rng(seed)
    F = rng.normal(size=(rank or p * H, p * H))
    mean = rng.normal(size=(H, W, p))
    return SelectionProblem(F.T @ F, mean, mean**2 / 4, np.arange(W) * H / 4)


def landing(task, suite, information, upsilon=1.0):
    """The selection problem of a landing."""
    psi = ms.psi(task, information)
    return SelectionProblem(psi, suite.mean, suite.variance, upsilon * suite.cost, 0.8, 0.2)


def glider(H=150):
    """A textbook-like task: an unstable pair of modes with an altitude to hold."""
    A = np.array([[1, 0.13, 0.1], [0, 0.95, 0.9], [0, -0.03, 0.9]])
    return ms.ControlTask(
        A, [[0], [0], [-0.3]], [[1.0], [0], [0]], np.diag([1.0, 1, 100]), [[10.0]], H
    )


# ------------------------------------------------------------------------------- relaxations


def test_projection_takes_any_leading_axes():
    v = np.random.default_rng(0).normal(size=(2, 3, 4))
    each = [[ms.project_to_simplex(point) for point in row] for row in v]
    np.testing.assert_array_equal(ms.project_to_simplex(v), each)


@given(SEEDS, st.integers(1, 6), st.integers(-8, 16))
def test_projection_is_the_nearest_point_of_the_simplex(seed, W, magnitude):
    v = np.random.default_rng(seed).normal(size=(3, W)) * 10.0**magnitude
    x = ms.project_to_simplex(v)
    assert (x >= 0).all()
    assert np.abs(x.sum(axis=1) - 1).max() <= 1e-14 * W
    # x is nearest exactly if v - x makes no acute angle with the way to any vertex.
    angle = (v - x)[:, None] * (np.eye(W) - x[:, None])
    assert angle.sum(axis=2).max() <= 1e-13 * max(1, np.abs(v).max()) * W


@given(problems())
def test_both_relaxations_bound_every_schedule_and_reach_their_bound(problem):
    best, slack = optimum(problem), rounding(problem)
    for point in (ms.relax(problem), ms.relax_interior_point(problem)):
        assert point.bound <= best + slack
        assert point.bound <= point.value + slack
        assert point.value - point.bound <= 1e-5 * abs(point.value) + 1e3 * slack
        assert np.abs(point.weights.sum(axis=1) - 1).max() < 1e-9
        assert point.weights.min() >= 0
        assert point.bound == pytest.approx(
            ms.reference_bound(problem, point.reference)[0], rel=1e-12, abs=slack
        )


@pytest.mark.parametrize("relax", [ms.relax, ms.relax_interior_point])
def test_the_value_of_a_relaxation_that_was_stopped_is_that_of_its_weights(relax):
    rng = np.random.default_rng(5)
    F = rng.normal(size=(6, 6))
    given_ = rng.normal(size=(6, 3, 1)), rng.uniform(0, 1, (6, 3, 1)), rng.uniform(0, 1, 3)
    problem = SelectionProblem(F @ F.T, *given_, 0.7, 0.3)
    point = relax(problem, max_iterations=1)
    d = np.einsum("tw,twi->ti", point.weights, problem.mean).ravel()
    value = 0.7 * d @ F @ F.T @ d + (point.weights * problem.linear).sum()
    assert point.value == pytest.approx(value, rel=1e-12)
    assert point.value > point.bound + 1e-6


@given(SEEDS, st.integers(1, 8))
def test_projected_gradient_meets_bounded_least_squares(seed, k):
    rng = np.random.default_rng(seed)
    F, goal = rng.normal(size=(k + 2, k)), 2 * rng.normal(size=k + 2)
    expected = lsq_linear(F, goal, (0, 1), method="bvls", tol=1e-14)  # cost: half the square

    def evaluate(x):
        slope = F.T @ (F @ x - goal)
        value = ((F @ x - goal) ** 2).sum() / 2
        return value, value - np.maximum(slope * x, slope * (x - 1)).sum(), slope

    step = np.full(k, 1 / np.linalg.norm(F, 2) ** 2)
    found, steps = ms.projected_gradient(
        evaluate, lambda x: np.clip(x, 0, 1), np.full(k, 0.5), step, 1e-12, 0.0, 100_000
    )
    assert steps < 100_000
    assert evaluate(found)[0] == pytest.approx(expected.cost, rel=1e-11, abs=1e-14)
    curved = np.linalg.svd(F)[1][-1] ** 2  # f(x) - f(best) >= curved / 2 |x - best|^2
    assert curved * ((found - expected.x) ** 2).sum() <= 4e-12 * expected.cost + 1e-13


@pytest.mark.no_cover
@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("p", [1, 2])
@pytest.mark.parametrize("some", [False, True])
def test_relaxations_agree_with_a_general_convex_solver(seed, p, some):
    problem = known_suite(seed, H=8, p=p, rank=5)
    H, W, _ = problem.mean.shape
    allowed = np.random.default_rng(seed).random((H, W)) < 0.6 if some else np.ones((H, W), bool)
    allowed[:, seed] = True
    b, U = cp.Variable((H, W), nonneg=True), np.linalg.cholesky(problem.psi + 1e-12 * np.eye(p * H))
    d = cp.hstack([b[t] @ problem.mean[t, :, i] for t in range(H) for i in range(p)])
    objective = cp.sum_squares(U.T @ d) + cp.sum(cp.multiply(problem.linear, b))
    rules = [cp.sum(b, axis=1) == 1, cp.multiply(b, ~allowed) == 0]
    value = cp.Problem(cp.Minimize(objective), rules).solve(solver="CLARABEL")
    found = [ms.relax_interior_point(problem, allowed=allowed, gap=1e-7)]
    cost = np.where(allowed, problem.model_cost, np.inf)
    found += [relax(replace(problem, model_cost=cost), gap=1e-7)
              for relax in (ms.relax, ms.relax_interior_point)]  # fmt: skip
    for point in found:
        assert point.value == pytest.approx(value, rel=1e-6) and not point.weights[~allowed].any()


def test_interior_point_needs_few_steps_where_gradients_need_thousands():
    # The published Psi spans four orders of magnitude.
    problem = published()
    newton, gradient = ms.relax_interior_point(problem), ms.relax(problem)
    assert newton.gap <= 1e-7
    assert newton.iterations <= 20
    assert gradient.gap <= 1e-6
    assert gradient.iterations >= 500
    assert newton.bound == pytest.approx(gradient.bound, rel=1e-6)


@given(SEEDS, st.integers(1, 9))
def test_cholesky_solves_what_is_definite_and_refuses_the_rest(seed, k):
    root = np.random.default_rng(seed).normal(size=(k, 2 * k))
    A, b = root @ root.T + np.eye(k), root[:, :2]
    solve = cholesky_solver(A)
    np.testing.assert_allclose(A @ solve(b), b, atol=1e-9)
    np.testing.assert_allclose(A @ solve(b[:, 0]), b[:, 0], atol=1e-9)
    for spoiled in (-A, np.where(np.eye(k), np.nan, A), np.where(np.eye(k), np.inf, A)):
        with pytest.raises(np.linalg.LinAlgError, match="definite"):
            cholesky_solver(spoiled)


def test_interior_point_keeps_to_the_models_it_is_allowed():
    problem = known_suite(3)
    allowed = np.random.default_rng(0).random(problem.mean.shape[:2]) < 0.5
    allowed[:, 2] = True
    point = ms.relax_interior_point(problem, allowed=allowed)
    cheapest = optimum(
        replace(problem, model_cost=np.where(allowed, problem.model_cost, np.inf))
        if problem.mean.shape[0] < 8
        else shortened(problem, allowed)
    )
    assert point.weights[~allowed].max() == 0
    assert ms.relax_interior_point(shortened(problem, allowed)).bound <= cheapest + 1e-9


def shortened(problem, allowed, H=6):
    """The first steps of a p = 1 problem, with the other models made unavailable."""
    cost = np.where(allowed, problem.model_cost, np.inf)[:H]
    return SelectionProblem(problem.psi[:H, :H], problem.mean[:H], problem.variance[:H], cost)


# ------------------------------------------------------------------------------ exact solvers


@pytest.mark.parametrize("solver", EXACT, **names)
@settings(max_examples=5 * settings.default.max_examples)
@given(problem=problems())
def test_exact_solvers_find_and_prove_the_enumerated_optimum(solver, problem):
    best, slack = optimum(problem), rounding(problem)
    schedule = solver(problem)
    error = abs(schedule.cost - problem.total_cost(schedule.choices))
    assert error <= problem.cost_rounding(
        schedule.choices
    )  # where digits cancel, the cost is exact
    assert schedule.cost <= best + 1e-9 * abs(best) + slack
    assert schedule.lower_bound <= best + slack
    assert schedule.cost - schedule.lower_bound <= 1e-9 * abs(best) + slack
    assert ms.check_certificate(problem, schedule) == schedule.root_bound <= best + slack


@given(problems(), st.integers(1, 3))
def test_schedules_of_any_budget_are_honest(problem, budget):
    best, slack = optimum(problem), rounding(problem)
    for schedule in (
        ms.round_and_swap(problem),
        ms.dynamic_program(problem, max_labels=64 * budget),
        ms.branch_and_bound(problem, max_nodes=budget),
        ms.solve(problem, time_limit=0.0),
        ms.solve(problem, max_labels=64 * budget),
    ):
        assert schedule.lower_bound <= best + slack
        assert schedule.cost >= best - slack
        assert schedule.lower_bound <= schedule.cost
        ms.check_certificate(problem, schedule)


@given(problems())
def test_no_single_swap_improves_what_round_and_swap_returns(problem):
    schedule = ms.round_and_swap(problem)
    H, W, _ = problem.mean.shape
    neighbours = np.repeat(schedule.choices[None], H * W, axis=0)
    neighbours[np.arange(H * W), np.repeat(np.arange(H), W)] = np.tile(np.arange(W), H)
    assert problem.total_cost(neighbours).min() >= schedule.cost - rounding(problem)


def factored(problem, d):
    """What the bound of d is made from, and the excess over it as a sum over steps."""
    found = trellis.certificate(problem.form, d)
    return found.base, triangle_part.factor(problem.form, found, d, 0.0, np.inf)


@given(problems(max_horizon=4, max_models=3), SEEDS)
def test_triangle_restates_the_cost_exactly(problem, seed):
    # For any reference, though a shifted Psi was factored.
    d = np.random.default_rng(seed).normal(size=len(problem.psi))
    root, triangle = factored(problem, d)
    bound, reduced, e, U = root + triangle.constant, triangle.moves[:, 0], *triangle[2:4]
    assert (reduced >= 0).all()
    H = len(reduced)
    scale = rounding(problem) + 1e-10 * float(np.abs(d) @ np.abs(problem.quadratic) @ np.abs(d))
    schedules = every_schedule(problem)
    for c in schedules[np.isfinite(problem.total_cost(schedules))]:
        steps = np.arange(H)
        rebuilt = bound + reduced[steps, c].sum() + ((U @ e[steps, c].ravel()) ** 2).sum()
        assert abs(rebuilt - problem.total_cost(c)) <= scale + 1e-300


def test_models_of_no_use_have_no_deviation_and_no_size():
    mean = np.tile([[0.1], [50.0]], (3, 1, 1))
    problem = SelectionProblem(np.eye(3), mean, 0 * mean, [0, np.inf])
    _, triangle = factored(problem, np.zeros(3))
    np.testing.assert_array_equal(triangle.deviation, mean * [[1], [0]])
    np.testing.assert_array_equal(triangle.size, 0.1)


@pytest.mark.parametrize(("slack", "share"), [(1e-6, 5e-9), (1e-3, 1e-6), (1e3, 1e-6)])
def test_the_shift_of_a_factor_is_a_millionth_and_costs_a_hundredth_of_the_slack(slack, share):
    """Errors (1, 1) that cancel: a shift of this share of the diagonal 1 lowers the nodes by 2."""
    M = np.array([[1.0, -1], [-1, 1]])
    form = SelectionProblem(M, np.ones((2, 1, 1)), np.zeros((2, 1, 1)), [0]).form
    found, d = trellis.certificate(form, np.zeros(2)), np.zeros(2)
    excess = slack + found.bound - found.base
    triangle = triangle_part.factor(form, found, d, 0.0, excess)
    np.testing.assert_allclose(triangle.U.T @ triangle.U - M, share * np.eye(2), atol=1e-11)
    assert triangle.constant == pytest.approx(-2 * share, abs=2e-11)


@pytest.mark.parametrize(("p", "rank"), [(1, None), (2, None), (2, 5), (3, 2)])
def test_compressed_offsets_keep_their_lengths(p, rank):
    problem = known_suite(5, H=10, p=p, rank=rank)
    _, triangle = factored(problem, np.zeros(10 * p))
    steps = triangle_part.compress(triangle, 1e-9, lambda: False)
    e, U = triangle.deviation, triangle.U
    chosen = e[np.arange(10), np.random.default_rng(1).integers(0, 4, 10)]
    y, offset = np.zeros(0), np.zeros(10 * p)
    for t in reversed(range(10)):
        own, read, carry, push, *_ = steps[t]
        np.testing.assert_array_equal(own, U[t * p : (t + 1) * p, t * p : (t + 1) * p])
        rows = slice(t * p, (t + 1) * p)
        np.testing.assert_allclose(read @ y, offset[rows], atol=1e-8)
        y, offset = carry @ y + push @ chosen[t], offset + U[:, rows] @ chosen[t]
        assert np.linalg.norm(y) == pytest.approx(np.linalg.norm(offset[: t * p]), abs=1e-8)


@pytest.mark.parametrize("signs", ["same", "model", "step"])
@pytest.mark.parametrize("information", ["open_loop", "preview"])
def test_truncated_offsets_stay_within_the_error_that_the_proof_allows(information, signs):
    problem = landing_problem(information, signs)
    _, triangle = factored(problem, ms.relax_interior_point(problem).reference)
    (H, W, _), e, U = problem.mean.shape, triangle.deviation, triangle.U
    least = 1e-3 * float(np.abs(U).max() * np.abs(e).max())  # coarse, so that truncation shows
    steps, rng = triangle_part.compress(triangle, least, lambda: False), np.random.default_rng(0)
    for _ in range(5):
        chosen = e[np.arange(H), rng.integers(0, W, H)]
        y, read = np.zeros(0), np.zeros(H)
        for t in reversed(range(H)):
            read[t] = (steps[t].read @ y)[0]
            y = steps[t].carry @ y + steps[t].push @ chosen[t]
        exact = np.triu(U, 1) @ chosen[:, 0]
        error, most = np.linalg.norm(read - exact), sum(step.lost for step in steps)
        assert 0 < error <= most <= H * least * np.sqrt(H) and error <= H * least / 3


@given(SEEDS, st.integers(0, 4), st.integers(1, 60), st.booleans(), st.booleans())
def test_only_dominated_labels_are_discarded(seed, dimensions, labels, whole, few):
    rng = np.random.default_rng(seed)
    extra = np.sort(rng.integers(0, 4, labels) / 4 if whole else rng.random(labels))
    y = (
        rng.integers(-1, 2, (labels, dimensions)) / 2
        if whole
        else rng.normal(size=(labels, dimensions)) / 10
    )
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(dominance, "FEW", 60 * few)
        kept = dominance.undominated(extra, y.T, np.sqrt(1 - extra), 0.0, lambda: False)
    assert kept[0]
    for j in range(1, labels):
        rho = np.linalg.norm(y[:j] - y[j], axis=1)
        excess = extra[:j] + 2 * rho * np.sqrt(1 - extra[j]) + rho**2 - extra[j]
        if not kept[j]:
            assert (excess <= 1e-12).any(), "nothing before this label dominates it"
            assert not few or (excess[kept[:j]] <= 1e-12).any(), "nothing that stays does"
        elif few and extra[j] < 1:
            assert (excess[kept[:j]] > -1e-12).all(), "a label that stays dominates this one"


def test_equal_offsets_merge_although_they_differ_by_rounding():
    y = np.array([[0.1 + 0.2], [0.3], [-1e-17], [1e-17]])
    kept = dominance.undominated(np.zeros(4), y.T, np.ones(4), 1e-10, lambda: False)
    assert kept.sum() == 2


def test_a_label_that_only_a_discarded_one_dominates_stays():
    y = 0.9 * np.arange(5.0)[None]  # with 1 to give away, each is near the next one only
    kept = dominance.undominated(np.zeros(5), y, np.zeros(5), 1.0, lambda: False)
    assert kept.tolist() == [True, False, True, False, True]


def test_preview_labels_stay_few_at_full_scale():
    problem = landing_problem("preview", "step")
    schedule = ms.dynamic_program(problem)
    assert schedule.is_optimal
    assert schedule.work["labels"].max() < 5000
    assert schedule.work["labels"].shape == (150,)


@pytest.mark.parametrize("solver", [ms.dynamic_program, ms.branch_and_bound, ms.solve], **names)
@pytest.mark.parametrize("price", [1e6, np.inf])
@pytest.mark.parametrize("wrong", [1e5, 1e8, 1e10])
@pytest.mark.parametrize("seed", range(6))
def test_a_model_nobody_would_use_does_not_blur_the_proof(solver, price, wrong, seed):
    rng = np.random.default_rng(seed)
    mean = rng.integers(-4, 5, (6, 2, 1)).astype(float)
    F = rng.integers(-2, 3, (6, 6)).astype(float)
    good = SelectionProblem(F.T @ F, mean, 0 * mean, [0.0, 0.0])
    mean = np.concatenate([mean, np.full((6, 1, 1), wrong)], axis=1)
    schedule = solver(SelectionProblem(F.T @ F, mean, 0 * mean, [0, 0, price]))
    assert schedule.cost == pytest.approx(optimum(good), rel=1e-12, abs=1e-9)
    assert schedule.lower_bound <= optimum(good) + 1e-9


@pytest.mark.parametrize("offset", [1e6, 1e8, 1e10])
def test_large_prices_that_cancel_cost_no_digits_and_no_crash(offset):
    for seed in range(5):
        rng = np.random.default_rng(seed)
        mean, F = rng.normal(size=(4, 2, 1)), rng.normal(size=(2, 4))
        cost = np.zeros((4, 2))
        cost[2, 1] = 0.1
        plain = SelectionProblem(F.T @ F, mean, 0 * mean, cost)
        cost[0] += offset
        cost[1] -= offset
        shifted = SelectionProblem(F.T @ F, mean, 0 * mean, cost)
        for solver in (ms.dynamic_program, ms.branch_and_bound, ms.solve):
            found = solver(shifted)
            assert abs(found.cost - optimum(plain)) <= 1e-15 * offset
            assert found.lower_bound <= found.cost


# ------------------------------------------------------------------------------ at full scale


def published(seed=0, information="open_loop"):
    """Experiment 1 of the paper (REFERENCE: forward Euler, C not scaled)."""
    Ks, Ts, zeta, omega, V, dt = -0.95, 2.5, 0.5, 1.0, 20.0, 0.01
    A = np.array(
        [
            [0, 1, 0, 0],
            [0, 1 / Ts, V / Ts, 0],
            [0, 0, 0, 1],
            [
                0,
                1 / (V * Ts) - 2 * zeta * omega / (V * Ts) + omega**2 / V,
                2 * zeta * omega / Ts - omega**2 - 1 / Ts**2,
                1 / Ts - 2 * zeta * omega,
            ],
        ]
    )
    task = ms.ControlTask(
        np.eye(4) + dt * A,
        [[0], [0], [0], [dt * omega**2 / Ks]],
        [[0], [0], [1.0], [0]],
        np.diag([1e8, 1, 1e8, 1]),
        [[1.0]],
        150,
    )
    return landing(task, published_suite(150, np.random.default_rng(seed)), information)


def landing_problem(information, signs, seed=0, H=150):
    altitude = 100 * np.exp(-np.linspace(0, 4, H))
    suite = textbook_suite(altitude, np.random.default_rng(seed), signs=signs)
    task = glider(H)
    small = landing(task, suite, information).control_term(np.zeros(H, dtype=int))
    return landing(task, suite, information, upsilon=0.8 * small / (7 * H))


@pytest.mark.no_cover
@pytest.mark.parametrize("signs", ["same", "model", "step"])
@pytest.mark.parametrize("information", ["open_loop", "preview"])
def test_every_family_is_proved_at_full_scale(information, signs):
    problem = landing_problem(information, signs)
    schedule = ms.solve(problem)
    assert schedule.is_optimal
    assert ms.check_certificate(problem, schedule) <= schedule.cost


@pytest.mark.parametrize("information", ["open_loop", "preview"])
def test_published_experiment_is_proved(information):
    schedule = ms.solve(published(information=information))
    assert schedule.gap <= 1e-9


@pytest.mark.parametrize("problem", [published(), landing_problem("preview", "same")])
def test_branch_and_bound_proves_one_sign_instances_at_full_scale(problem):
    schedule = ms.branch_and_bound(problem, max_nodes=5000)
    assert schedule.is_optimal
    assert schedule.cost == pytest.approx(ms.dynamic_program(problem).cost, rel=1e-12)


def test_tree_of_branch_and_bound_is_a_tree_whose_bounds_only_rise():
    schedule = ms.branch_and_bound(known_suite(0, H=14))
    tree = schedule.work["tree"]
    assert len(tree) == schedule.work["nodes"] > 1
    assert tree[0].parent == -1
    for position, node in enumerate(tree[1:], start=1):
        assert 0 <= node.parent < position
        assert node.bound >= tree[node.parent].bound
    assert all(node.step == node.model == -1 for node in tree[:1])
    for rising in ([-node.best for node in tree], [0, *(node.seconds for node in tree)]):
        assert rising == sorted(rising)


@pytest.mark.parametrize("most", [1, 2, 7])
def test_branch_and_bound_bounds_no_more_nodes_than_it_may(most):
    schedule = ms.branch_and_bound(known_suite(0, H=14), max_nodes=most)
    assert schedule.work["nodes"] == len(schedule.work["tree"]) == most


def test_branch_and_bound_stops_at_the_gap_that_it_is_given():
    problem = known_suite(0, H=14)
    nodes = [ms.branch_and_bound(problem, gap=gap).work["nodes"] for gap in (1, 0.2, 0.1, 0)]
    assert nodes == sorted(set(nodes)) and nodes[0] == 1


@pytest.mark.parametrize("seed", range(3))
def test_no_schedule_below_a_node_beats_both_its_bound_and_the_best_known_then(seed):
    problem = known_suite(seed, H=6, W=4, p=2)
    schedules = every_schedule(problem)
    totals, tree = problem.total_cost(schedules), ms.branch_and_bound(problem, gap=0).work["tree"]
    assert len(tree) > 3
    for node in tree:
        below, place = np.ones(len(schedules), dtype=bool), node
        while place.parent >= 0:
            below &= schedules[:, place.step] == place.model
            place = tree[place.parent]
        least = totals[below].min()
        assert least >= min(node.bound, node.best) - rounding(problem)
        assert node.best >= totals.min() - rounding(problem)


def test_separable_problems_take_one_minimum_per_step():
    problem = known_suite(1, H=9)
    block_diagonal = replace(problem, psi=np.diag(problem.psi.diagonal()))
    unbiased = replace(problem, mean=0 * problem.mean)
    indifferent = replace(problem, alpha=0.0)
    for separable in (block_diagonal, unbiased, indifferent):
        schedule = ms.solve(separable)
        assert schedule.solver == "solve_separable"
        assert schedule.cost == pytest.approx(ms.dynamic_program(separable).cost, rel=1e-12)
    assert not ms.is_separable(problem)
    with pytest.raises(ValueError, match=r"^problem: expected uncoupled steps"):
        ms.solve_separable(problem)


# --------------------------------------------------------------------- metamorphic properties


def edited(problem, **changes):
    return ms.solve(replace(problem, **changes)).cost


@given(problems(unavailable=False), SEEDS)
def test_a_further_model_never_raises_the_optimum(problem, seed):
    rng = np.random.default_rng(seed)
    H, _, p = problem.mean.shape
    more = {
        "mean": np.concatenate([problem.mean, rng.normal(size=(H, 1, p))], axis=1),
        "variance": np.concatenate([problem.variance, problem.variance[:, :1]], axis=1),
        "model_cost": np.append(problem.model_cost, np.abs(problem.model_cost[..., :1]), axis=-1),
    }
    bigger = replace(problem, **more)
    assert ms.solve(bigger).cost <= ms.solve(problem).cost + rounding(bigger)


@given(problems())
def test_removing_an_unused_model_leaves_the_optimum(problem):
    schedule = ms.solve(problem)
    used = np.isin(np.arange(problem.mean.shape[1]), schedule.choices)
    assume(not used.all())
    fewer = {name: getattr(problem, name)[:, used] for name in ("mean", "variance")}
    fewer["model_cost"] = problem.model_cost[..., used]
    assert abs(edited(problem, **fewer) - schedule.cost) <= rounding(problem)


@given(problems(), SEEDS)
def test_permuting_the_models_permutes_the_schedule(problem, seed):
    order = np.random.default_rng(seed).permutation(problem.mean.shape[1])
    permuted = replace(
        problem,
        mean=problem.mean[:, order],
        variance=problem.variance[:, order],
        model_cost=problem.model_cost[..., order],
    )
    schedule = ms.solve(permuted)
    assert abs(schedule.cost - ms.solve(problem).cost) <= rounding(problem)
    assert abs(problem.total_cost(order[schedule.choices]) - schedule.cost) <= rounding(problem)


@given(problems(), st.sampled_from([2.0**-40, 0.5, 8.0, 2.0**40]))
def test_scaling_both_weights_scales_cost_and_bound(problem, factor):
    scaled = replace(problem, alpha=factor * problem.alpha, beta=factor * problem.beta)
    one, other = ms.solve(problem), ms.solve(scaled)
    # A power of two changes no digit, so only the tolerances could tell the two apart.
    assert abs(other.cost - factor * one.cost) <= factor * rounding(problem)
    assert abs(other.lower_bound - factor * one.lower_bound) <= factor * rounding(problem)


@given(problems(), st.floats(-3, 3))
def test_shifting_every_price_shifts_the_total(problem, shift):
    finite = problem.model_cost[np.isfinite(problem.model_cost)]
    shift *= max(1.0, float(np.abs(finite).max()))
    shifted = replace(problem, model_cost=problem.model_cost + shift)
    moved = problem.beta * shift * len(problem.mean)
    tolerance = rounding(problem) + rounding(shifted)
    assert abs(ms.solve(shifted).cost - ms.solve(problem).cost - moved) <= tolerance


@pytest.mark.no_cover
@pytest.mark.unmutated
@settings(max_examples=5)
@given(st.integers(0, 10**6))
def test_larger_budgets_never_worsen_the_answer(seed):
    problem = known_suite(seed, H=12, W=4, p=2)
    for solver, budget in ((ms.dynamic_program, "max_labels"), (ms.branch_and_bound, "max_nodes")):
        sizes = (64, 128, 1024, 5000) if budget == "max_labels" else (1, 8, 64, 512)
        answers = [solver(problem, **{budget: size}) for size in sizes]
        costs = [answer.cost for answer in answers]
        gaps = [answer.gap for answer in answers]
        assert costs == sorted(costs, reverse=True)
        assert gaps == sorted(gaps, reverse=True)


@given(problems())
def test_optimum_does_not_exceed_any_constant_schedule(problem):
    H, W, _ = problem.mean.shape
    constant = np.repeat(np.arange(W)[:, None], H, axis=1)
    assert ms.solve(problem).cost <= problem.total_cost(constant).min() + rounding(problem)


def test_a_schedule_says_who_found_it_and_with_how_much_work():
    problem = known_suite(3, H=5, W=3)
    found = {solver.__name__: solver(problem) for solver in [*EXACT[:-1], *INEXACT]}
    assert {name: schedule.solver for name, schedule in found.items()} == {n: n for n in found}
    assert found["enumerate_schedules"].work["schedules"] == 3**5
    assert found["plain_dynamic_program"].work["labels"] == 3**5


@pytest.mark.parametrize("solver", [ms.dynamic_program, ms.branch_and_bound, ms.solve])
def test_the_seconds_of_a_solver_are_those_that_it_took(solver):
    started = perf_counter()
    assert 0 <= solver(known_suite(3)).work["seconds"] <= perf_counter() - started


def test_enumeration_sees_schedules_beyond_the_first_block_of_numbers():
    for H, W in ((17, 2), (11, 3)):  # 2^14 schedules are priced at a time
        last = np.full(H, W - 1)
        mean = np.zeros((H, W, 1))
        problem = SelectionProblem(np.zeros((H, H)), mean, mean, -np.arange(W) + W)
        assert np.array_equal(ms.enumerate_schedules(problem).choices, last)
        cost = np.tile(np.arange(W), (H, 1))
        cost[0] *= -3  # the best is the first of the last block
        best = ms.enumerate_schedules(SelectionProblem(np.zeros((H, H)), mean, mean, cost)).choices
        assert np.array_equal(best, (last[0],) + (0,) * (H - 1))


@pytest.mark.parametrize("solver", [ms.enumerate_schedules, ms.plain_dynamic_program])
def test_as_many_schedules_as_allowed_are_not_too_many(solver):
    problem = known_suite(1, H=4, W=3)
    limit = {ms.enumerate_schedules: "max_schedules", ms.plain_dynamic_program: "max_labels"}
    assert solver(problem, **{limit[solver]: 81}).is_optimal
    with pytest.raises(ValueError, match=r"^problem: expected at most 80 .*, found 3\^4"):
        solver(problem, **{limit[solver]: 80})


def test_gradients_need_no_more_steps_where_steps_have_very_different_weights():
    for seed in range(4):
        problem = known_suite(seed, H=20, W=4, p=2)
        unit = 10.0 ** np.random.default_rng(seed).uniform(-3, 3, 20).repeat(2)
        cost = np.tile(problem.model_cost, (20, 1))
        cost[::3, 1] = np.inf
        uneven = replace(problem, psi=problem.psi * np.outer(unit, unit), model_cost=cost)
        assert ms.relax(problem).iterations <= 500
        assert ms.relax(uneven).iterations <= 200
        assert ms.solve_blend(ms.BlendProblem(problem)).iterations <= 100


# ------------------------------------------------------------------------------- limits, edges


def test_too_many_schedules_are_refused_by_the_exhaustive_solvers():
    problem = known_suite(0, H=30)
    for solver in (ms.enumerate_schedules, ms.plain_dynamic_program):
        with pytest.raises(ValueError, match=r"^problem: expected at most \d+ .*, found 4\^30"):
            solver(problem)


@pytest.mark.parametrize(
    ("solver", "option", "value", "message"),
    [
        (ms.solve, "time_limit", -1, "time_limit: expected a number >= 0"),
        (ms.solve, "gap", np.nan, "gap: expected finite numbers"),
        (ms.solve, "max_labels", 0, "max_labels: expected an integer >= 64"),
        (ms.dynamic_program, "max_labels", 1.5, "max_labels: expected an integer >= 64"),
        (ms.branch_and_bound, "max_nodes", 0, "max_nodes: expected an integer >= 1"),
        (ms.branch_and_bound, "time_limit", "soon", "time_limit: expected real numbers"),
        (ms.relax, "gap", -1, "gap: expected a number >= 0"),
        (ms.relax, "max_iterations", 0, "max_iterations: expected an integer >= 1"),
    ],
)
def test_limits_are_checked_at_the_door(solver, option, value, message):
    with pytest.raises(ValueError, match=f"^{message}"):
        solver(known_suite(0, H=3), **{option: value})


def test_one_step_and_one_model():
    one = SelectionProblem([[2.0]], [[[3.0]]], [[[0.5]]], [7.0])
    for solver in EXACT + INEXACT:
        schedule = solver(one)
        assert schedule.cost == 2 * 9 + 2 * 0.5 + 7
        assert schedule.choices.tolist() == [0]
        assert schedule.is_optimal


def test_a_time_limit_returns_the_best_so_far_with_a_true_bound():
    # p = 2, random signs, low-rank Psi: no solver here proves this one in the time it has.
    problem = known_suite(0, H=60, W=8, p=2, rank=8)
    problem = replace(problem, variance=0 * problem.variance, model_cost=np.arange(8.0))
    schedule = ms.solve(problem, time_limit=0.5)
    assert schedule.root_bound <= schedule.lower_bound < schedule.cost
    assert schedule.gap > 1e-9
    assert not schedule.is_optimal
    assert schedule.cost <= ms.round_and_swap(problem).cost


def test_what_a_long_pass_would_take_most_of_goes_to_branch_and_bound(monkeypatch):
    """It finds what passes that a limit cuts off do not; here 64 labels a step take a second."""
    problem = known_suite(0, H=60, W=8, p=2, rank=8)
    problem = replace(problem, variance=0 * problem.variance, model_cost=np.arange(8.0))
    now, given, real, step = [0.0], [], ms.branch_and_bound, passes.Search.step

    def timed(search, width):
        now[0] += width / 64
        return step(search, width)

    def watched(problem, *, time_limit, **options):
        given.append(time_limit)
        return real(problem, max_nodes=1, **options)

    monkeypatch.setattr(ms, "perf_counter", lambda: now[0])
    monkeypatch.setattr(passes.Search, "step", timed)
    monkeypatch.setattr(ms, "branch_and_bound", watched)
    schedule = ms.solve(problem, time_limit=80)
    assert given == [80 - 1 - 8]  # the next pass would take 64
    ms.check_certificate(problem, schedule)
    given.clear()
    ms.dynamic_program(problem, time_limit=80)  # alone, it shares with nobody
    assert not given and now[0] > 80


def test_passes_that_have_closed_much_of_the_gap_go_on_however_long_they_take(
    monkeypatch, ten_seconds_a_pass
):
    monkeypatch.setattr(ms, "WIDTHS", [8 * 4**k for k in range(8)])
    monkeypatch.setattr(ms, "branch_and_bound", None)
    schedule = ms.solve(known_suite(5, H=40, rank=3), time_limit=100)
    assert schedule.is_optimal and ten_seconds_a_pass[0] > 10


def test_schedule_gap_is_relative_to_the_larger_of_cost_and_bound():
    one = ms.solve(known_suite(0, H=3))
    assert replace(one, cost=2.0, lower_bound=1.0).gap == 0.5
    assert replace(one, cost=1.0, lower_bound=-4.0).gap == 1.25
    assert replace(one, cost=0.0, lower_bound=0.0).gap == 0.0
    assert one.choices.flags.writeable is False


# ------------------------------------------------------------------- corners that rounding opens


def test_what_overflows_is_refused_and_never_returned():
    task = ms.ControlTask([[2.0]], [[1.0]], [[1.0]], [[1.0]], [[1.0]], 2)
    with pytest.raises(ValueError, match=r"^task: the states overflow"):
        ms.plan(task, [1e308], np.full((2, 1), 1e308))
    with pytest.raises(ValueError, match=r"^psi: the costs overflow"):
        SelectionProblem(np.eye(2), np.full((2, 1, 1), 1e200), np.zeros((2, 1, 1)), [0.0])


@pytest.mark.parametrize("off", [1e-6, 1, 1e9])
def test_a_lower_bound_outside_root_bound_and_cost_has_no_certificate(off):
    problem = known_suite(0, H=4)
    schedule = ms.solve(problem)
    for claim in (schedule.root_bound - off * schedule.cost, (1 + off) * schedule.cost):
        with pytest.raises(ValueError, match=r"^schedule\.lower_bound: expected"):
            ms.check_certificate(problem, replace(schedule, lower_bound=claim))


def test_enumeration_compares_all_that_rounding_cannot_tell_apart():
    mean = np.array([[[1e8], [0]], [[1e8 + 1], [0.5]]])  # errors of 1e8 cancel to 1: it costs more
    problem = ms.SelectionProblem([[1, -1], [-1, 1]], mean, 0 * mean, [0, 0])
    found = ms.enumerate_schedules(problem)
    assert found.choices.tolist() == [1, 1] and found.cost == 0.25


def test_enumeration_keeps_the_best_of_several_blocks_and_tries_each_schedule_once(monkeypatch):
    # 3^10 schedules fill four blocks; the cheapest, found first, must survive the later ones.
    mean = np.tile([[0.0], [1.0], [2.0]], (10, 1, 1))
    problem = SelectionProblem(np.eye(10), mean, 0 * mean, [0.0, 1.0, 2.0])
    tried, priced = [], SelectionProblem.total_cost
    noted = lambda self, c: tried.append(np.atleast_2d(c)) or priced(self, c)  # noqa: E731
    monkeypatch.setattr(SelectionProblem, "total_cost", noted)
    schedule = ms.enumerate_schedules(problem)
    assert schedule.cost == 0
    assert not schedule.choices.any()
    blocks = [c for c in tried if len(c) > 4]  # the best of the four blocks come after
    assert len(blocks) == 4 and len(np.unique(np.concatenate(blocks), axis=0)) == 3**10
    assert sum(map(len, blocks)) == 3**10


@pytest.mark.parametrize("most", [1, 2, 3])
def test_newtons_method_takes_no_more_steps_than_it_may(most):
    assert ms.relax_interior_point(known_suite(0), gap=0, max_iterations=most).iterations == most


@pytest.mark.parametrize(
    ("relax", "module", "name"),
    [
        (ms.relax, ms, "projected_gradient"),
        (ms.relax_interior_point, ms, "_relax"),
        (ms.relax_by_columns, column_generation, "columns"),
        (ms.solve_blend, blends, "projected_gradient"),
    ],
)
def test_a_relaxation_stops_after_as_many_steps_as_its_signature_says(
    relax, module, name, monkeypatch
):
    def limits(*given, **named):
        raise StopIteration(*given, *named.values())

    monkeypatch.setattr(module, name, limits)
    problem = known_suite(0, H=3)
    with pytest.raises(StopIteration) as told:
        relax(ms.BlendProblem(problem) if relax is ms.solve_blend else problem)
    assert inspect.signature(relax).parameters["max_iterations"].default in told.value.args[-2:]


def test_the_gap_of_a_relaxation_is_zero_where_value_and_bound_meet():
    point = ms.relax_interior_point(known_suite(0, H=3))
    assert replace(point, value=1.0, bound=1.0).gap == 0
    assert replace(point, value=2.0, bound=1.0).gap == 0.5


@pytest.mark.parametrize(
    ("allowed", "message"),
    [
        (np.zeros((12, 4), dtype=bool), "an available model in every row"),
        (np.arange(12)[:, None] != [7] * 4, "an available model in every row"),
        (np.ones((12, 3), dtype=bool), r"shape \(H, W\) = \(12, 4\), found \(12, 3\)"),
        (np.full((12, 4), 2), "True and False only"),
    ],
)
def test_every_step_needs_a_model_that_is_allowed(allowed, message):
    with pytest.raises(ValueError, match=f"^allowed: expected {message}"):
        ms.relax_interior_point(known_suite(0), allowed=allowed)


def test_the_bound_of_separable_problems_is_below_exact_costs_where_terms_cancel():
    """Prices of 1e16 that a pull takes off again: what is left is rounding, either way."""
    for seed in range(40):
        rng = np.random.default_rng(seed)
        mean, size = rng.choice([-1.0, 1], (3, 2, 1)), rng.uniform(1e15, 1e16, (3, 1))
        price = rng.uniform(0, 3, (3, 2)) - size * mean[..., 0]
        problem = SelectionProblem(
            np.eye(3), mean, 0 * mean, price / 0.3, pull=size / 0.7, alpha=0.7, beta=0.3
        )
        found = ms.solve_separable(problem)
        assert found.lower_bound <= min(map(problem.exact_cost, every_schedule(problem)))


def test_out_of_time_before_the_first_pass_leaves_the_root_bound():
    problem = known_suite(0, H=30, p=2)
    relaxation = ms.relax_interior_point(problem)
    late = ms.dynamic_program(problem, time_limit=0.0, relaxation=relaxation)
    assert late.work["passes"] == 0
    assert late.lower_bound == late.root_bound < late.cost
    assert late.cost >= ms.round_and_swap(problem, relaxation).cost  # no time to swap either


def test_solve_returns_what_it_has_where_decoding_used_up_the_time(monkeypatch):
    problem = known_suite(0, H=60, W=8, p=2, rank=8)
    problem = replace(problem, variance=0 * problem.variance, model_cost=np.arange(8.0))
    looks = iter(range(10**6))  # the more often one looks at this clock, the faster it runs
    monkeypatch.setattr(ms, "perf_counter", lambda: 0.001 * 1.02 ** next(looks))
    schedule = ms.solve(problem, time_limit=0.065)
    assert schedule.solver == "dynamic_program"
    assert schedule.lower_bound < schedule.cost


def test_integers_whose_costs_would_not_be_exact_are_refused():
    with pytest.raises(ValueError, match=r"^integers: expected a sum of at most 1e7, found"):
        ms.partition_problem([10**7, 1])


def test_projected_gradient_keeps_off_models_that_are_not_available_however_long_its_steps():
    near = [[[1], [1 + 1e-9]], [[1], [-1]]]  # a row whose models hardly differ takes huge steps
    problem = SelectionProblem([[2, 1], [1, 2]], near, np.zeros((2, 2, 1)), [[0, np.inf], [0, 1]])
    point = ms.relax(problem)
    assert point.weights[0].tolist() == [1, 0]
    assert point.value == pytest.approx(2.21875, rel=1e-6)
    assert ms.round_and_swap(problem, point).cost == 3


def test_a_search_uses_all_the_labels_that_it_may_keep():
    problem = landing_problem("open_loop", "model")
    few, more = (ms.dynamic_program(problem, max_labels=most) for most in (64, 100))
    assert few.work["labels"].max() == 64 < more.work["labels"].max() <= 100


@pytest.mark.parametrize("swapped", [False, True])
def test_of_two_solvers_solve_takes_the_better_schedule_and_the_higher_bound(monkeypatch, swapped):
    problem = known_suite(0)  # its relaxation leaves a gap
    optimum, quick = ms.dynamic_program(problem), ms.round_and_swap(problem)
    most = (quick.root_bound + optimum.cost) / 2
    assert quick.gap > 1e-6 and most < optimum.cost
    found = [replace(optimum, lower_bound=quick.root_bound), replace(quick, lower_bound=most)]
    decoded, split = (replace(found[k], work={"complete": True}) for k in (swapped, not swapped))
    monkeypatch.setattr(ms, "_searched", lambda *_, **__: decoded)
    monkeypatch.setattr(ms, "branch_and_bound", lambda *_, **__: split)
    answer = ms.solve(problem)
    assert (answer.cost, answer.lower_bound) == (optimum.cost, most)
