"""The paper's theorems, and what it leaves open, against oracles of their own.

In order: continuous choices and their semidefinite form, the Hadamard theorem, complexity,
information patterns, bias against variance, correlated errors.
"""

from dataclasses import replace
from itertools import combinations, product

import numpy as np
import pytest
from hypothesis import assume, example, given, settings
from hypothesis import strategies as st

import modelselect as ms
from modelselect import BlendProblem, ControlTask, SelectionProblem

from strategies import SEEDS, every_schedule, gram, problems, sign_patterns, tasks

# Sums of a few dozen products: exact up to this fraction of the norms that they multiply.
ROUNDING = 1e-11
INTEGERS = st.lists(st.integers(1, 40), min_size=1, max_size=9)


def cvxpy():
    """An open convex solver, independent of ours; in the extra `dev`."""
    return pytest.importorskip("cvxpy", reason="cvxpy is the oracle here: pip install '.[dev]'")


def size(problem):
    """What rounding in total costs is relative to: norms multiplied, of models that can be run."""
    most = (problem.mean**2).sum(-1).max(1).sum() + np.abs(problem.variance).sum()
    price = problem.model_cost[np.isfinite(problem.model_cost)].max()
    control = np.linalg.norm(problem.psi) * most
    return problem.alpha * control + problem.beta * price * len(problem.mean)


def sigma(problem, t, w):
    """Covariance (p, p) of model w's error at step t."""
    variance = problem.variance[t, w]
    return variance if variance.ndim == 2 else np.diag(variance)


def kappa(problem, t, w):
    """Cost of model w at step t."""
    return problem.model_cost[t, w] if problem.model_cost.ndim == 2 else problem.model_cost[w]


def least(problem):
    """The least total cost of all schedules, by enumeration."""
    return problem.total_cost(every_schedule(problem)).min()


def suite(seed, H=4, W=2, p=1, full=False, rank=None):
    """A problem without special structure, all its numbers around one."""
    rng = np.random.default_rng(seed)
    mean = rng.normal(size=(H, W, p))
    variance = gram(rng, (H, W, p), p, False) if full else rng.random((H, W, p))
    Psi, cost = gram(rng, (p * H,), rank or p * H, False) / p, rng.random((H, W)) * H
    return SelectionProblem(Psi, mean, variance, cost, alpha=0.8, beta=0.2)


def scalar(H, A=1.0, Q=0.0, Q_final=1.0):
    """x_{t+1} = A x_t + u_t + s_t with R = 1: with A = 1 and Q = 0, an integrator."""
    return ControlTask([[A]], [[1]], [[1]], [[Q]], [[1]], H, Q_final=[[Q_final]])


def tiled(task, errors, cost=0.0, information="open_loop"):
    """Models with known errors (W, H) for this task, all at this cost."""
    mean = np.transpose(errors)[:, :, None]
    price = np.zeros(len(errors)) + cost
    return SelectionProblem(ms.psi(task, information), mean, 0 * mean, price)


def rolled_out(task, errors, information="open_loop"):
    """Cost of errors (..., H) by simulation from rest without input: nothing but their regret."""
    e = np.asarray(errors)[..., None]
    return ms.control_cost(task, *ms.run_controller(task, [0], 0 * e, e, information))


# ---------------------------------------------------------------------------- continuous choices


@st.composite
def blends(draw):
    """A problem, two of its models, and a generator for choices c."""
    problem = draw(problems(max_horizon=4, max_models=3, unavailable=False))
    W = problem.mean.shape[1]
    worst, best = draw(st.integers(0, W - 1)), draw(st.integers(0, W - 1))
    return problem, worst, best, np.random.default_rng(draw(SEEDS))


def mixed(problem, worst, best, c):
    """Mean (pH,), covariances (H, p, p) and total price of a blend, by the definitions."""
    mean, H = problem.mean, len(c)
    m = [(1 - c[t]) * mean[t, worst] + c[t] * mean[t, best] for t in range(H)]
    S = [(1 - c[t]) * sigma(problem, t, worst) + c[t] * sigma(problem, t, best) for t in range(H)]
    price = [(1 - c[t]) * kappa(problem, t, worst) + c[t] * kappa(problem, t, best)
             for t in range(H)]  # fmt: skip
    return np.concatenate(m), np.array(S), sum(price)


def blended_cost(problem, worst, best, c):
    """E[alpha e'Psi e] + beta price of a blend, entry by entry."""
    m, S, price = mixed(problem, worst, best, c)
    p, Psi = problem.mean.shape[2], problem.psi
    control = sum(m[i] * Psi[i, j] * m[j] for i, j in product(range(len(m)), repeat=2))
    for t in range(len(c)):
        for r, q in product(range(p), repeat=2):
            control += Psi[t * p + r, t * p + q] * S[t][q, r]
    return problem.alpha * control + problem.beta * price


@given(blends())
def test_a_blend_costs_the_expectation_under_its_mean_variance_and_price(case):
    problem, worst, best, rng = case
    blend, H = BlendProblem(problem, worst, best), len(problem.mean)
    c = rng.random((5, H))
    found = blend.total_cost(c)
    assert found.shape == (5,) and np.ndim(blend.total_cost(c[0])) == 0
    for k in range(5):
        expected = blended_cost(problem, worst, best, c[k])
        assert abs(found[k] - expected) <= ROUNDING * size(problem)


@given(blends())
def test_that_expectation_is_the_average_over_errors_with_these_moments(case):
    problem, worst, best, rng = case
    H, _, p = problem.mean.shape
    assume(H * p <= 6)
    c, signs = rng.random(H), sign_patterns(H, p)
    m, S, price = mixed(problem, worst, best, c)
    values, vectors = np.linalg.eigh(S)
    roots = vectors * np.sqrt(np.maximum(values, 0))[:, None]
    e = m + np.einsum("tij,ktj->kti", roots, signs).reshape(len(signs), -1)
    expected = problem.alpha * np.mean([row @ problem.psi @ row for row in e])
    expected += problem.beta * price
    found = BlendProblem(problem, worst, best).total_cost(c)
    assert abs(found - expected) <= ROUNDING * size(problem)


@given(blends())
def test_at_the_corners_a_blend_is_a_schedule_of_its_two_models(case):
    problem, worst, best, _ = case
    corners = np.array(list(product((0, 1), repeat=len(problem.mean))))
    found = BlendProblem(problem, worst, best).total_cost(corners)
    expected = problem.total_cost(np.where(corners, best, worst))
    assert np.abs(found - expected).max() <= ROUNDING * size(problem)


@given(blends())
def test_the_canonical_form_holds_the_coefficients_of_the_expectation(case):
    problem, worst, best, _ = case
    blend, H = BlendProblem(problem, worst, best), len(problem.mean)

    def f(c):
        return blended_cost(problem, worst, best, c)

    zero, unit = np.zeros(H), np.eye(H)
    once = np.array([f(unit[t]) - f(zero) for t in range(H)])  # Psi'_tt + linear_t
    twice = np.array([f(2 * unit[t]) - f(zero) for t in range(H)])  # 4 Psi'_tt + 2 linear_t
    tolerance = 10 * ROUNDING * size(problem)
    assert blend.quadratic.shape == (H, H) and blend.linear.shape == (H,)
    assert abs(blend.constant - f(zero)) <= tolerance
    assert np.abs(blend.linear - (2 * once - twice / 2)).max() <= tolerance
    assert np.abs(blend.quadratic.diagonal() - (twice / 2 - once)).max() <= tolerance
    for t, k in combinations(range(H), 2):
        cross = f(unit[t] + unit[k]) - f(unit[t]) - f(unit[k]) + f(zero)
        assert abs(2 * blend.quadratic[t, k] - cross) <= tolerance
        assert abs(blend.quadratic[k, t] - blend.quadratic[t, k]) <= tolerance


@given(problems(unavailable=False))
def test_by_default_the_first_and_the_last_model_are_blended(problem):
    stated, W = BlendProblem(problem, 0, problem.mean.shape[1] - 1), problem.mean.shape[1]
    for other in (BlendProblem(problem), BlendProblem(problem, -W, -1)):
        assert (other.quadratic == stated.quadratic).all()
        assert (other.linear == stated.linear).all() and other.constant == stated.constant


@given(blends())
def test_the_solver_of_blends_brackets_the_optimum_over_the_box(case):
    problem, worst, best, rng = case
    H, slack = len(problem.mean), 1e-9 * size(problem)
    found = ms.solve_blend(BlendProblem(problem, worst, best), max_iterations=3000)
    assert found.choices.shape == (H,)
    assert found.choices.min() >= 0 and found.choices.max() <= 1
    assert abs(found.cost - blended_cost(problem, worst, best, found.choices)) <= slack
    assert 0 <= found.cost - found.lower_bound <= slack
    for c in (*rng.random((5, H)), *rng.integers(0, 2, (5, H))):
        assert found.lower_bound <= blended_cost(problem, worst, best, c) + slack


@given(blends())
def test_the_best_blend_costs_at_most_the_best_schedule_of_the_two_models(case):
    problem, worst, best, _ = case
    corners = np.array(list(product((0, 1), repeat=len(problem.mean))))
    cheapest = problem.total_cost(np.where(corners, best, worst)).min()
    found = ms.solve_blend(BlendProblem(problem, worst, best), max_iterations=3000)
    assert found.cost <= cheapest + 1e-9 * size(problem)


def test_the_best_blend_can_cost_less_than_every_schedule():
    # Errors +1 and -1 of equal price: half and half has no error at all.
    problem = SelectionProblem(np.ones((1, 1)), [[[1], [-1]]], np.zeros((1, 2, 1)), [1, 1])
    found = ms.solve_blend(BlendProblem(problem))
    assert least(problem) == 2 and found.cost == 1 and found.choices == [0.5]


@pytest.mark.parametrize("p, full", [(1, False), (2, False), (2, True), (3, True)])
@pytest.mark.parametrize("seed, rank", [(0, None), (1, 2), (2, None)])
def test_the_solver_of_blends_meets_a_general_qp_solver(seed, p, full, rank):
    cp, problem = cvxpy(), suite(seed, H=8, W=3, p=p, full=full, rank=rank)
    values, vectors = np.linalg.eigh(problem.psi)
    F = (vectors * np.sqrt(np.maximum(values, 0))).T
    c, ell = cp.Variable(8), problem.linear
    mean = [
        (1 - c[t]) * problem.mean[t, 0, r] + c[t] * problem.mean[t, 2, r]
        for t in range(8)
        for r in range(p)
    ]
    objective = 0.8 * cp.sum_squares(F @ cp.hstack(mean)) + (1 - c) @ ell[:, 0] + c @ ell[:, 2]
    value = cp.Problem(cp.Minimize(objective), [c >= 0, c <= 1]).solve(solver="CLARABEL")
    found = ms.solve_blend(BlendProblem(problem))
    # Clarabel stops at 1e-8, ours at 1e-9.
    assert found.lower_bound <= value * (1 + 1e-7) and found.cost >= value * (1 - 1e-7)
    assert found.cost == pytest.approx(value, rel=1e-7)


@given(SEEDS, st.integers(1, 8), st.integers(1, 2), st.integers(1, 3))
def test_the_bound_of_any_iterate_is_the_least_value_of_its_tangent_plane(seed, H, p, steps):
    problem, worst, best, unit = suite(seed, H=H, p=p), 0, 1, np.eye(H)
    found = ms.solve_blend(BlendProblem(problem), gap=0.0, max_iterations=steps)
    c = found.choices
    slope = np.array([blended_cost(problem, worst, best, c + e)
                      - blended_cost(problem, worst, best, c - e) for e in unit]) / 2  # fmt: skip
    corners = np.array(list(product((0, 1), repeat=len(c))))
    expected = (found.cost + (corners - c) @ slope).min()
    assert found.iterations <= steps
    assert abs(found.lower_bound - expected) <= 10 * ROUNDING * size(problem)


@pytest.mark.parametrize("which", ["worst", "best"])
@pytest.mark.parametrize("bad", [3, -4, 0.5, True, np.nan])
def test_only_models_that_exist_can_be_blended(which, bad):
    with pytest.raises(ValueError, match=f"^{which}: expected"):
        BlendProblem(suite(0, W=3), **{which: bad})


@pytest.mark.parametrize("which", ["worst", "best"])
def test_only_models_that_are_available_at_every_step_can_be_blended(which):
    problem = suite(0, W=3)
    cost = problem.model_cost.copy()
    cost[2, 1] = np.inf
    sometimes = replace(problem, model_cost=cost)
    with pytest.raises(ValueError, match=f"^{which}: expected an available model"):
        BlendProblem(sometimes, **{which: 1})
    assert ms.solve_blend(BlendProblem(sometimes)).cost < np.inf  # of models 0 and 2


@pytest.mark.parametrize("limit", [{"gap": -1.0}, {"gap": np.nan}, {"max_iterations": 0}])
def test_limits_of_the_solver_of_blends_are_checked(limit):
    with pytest.raises(ValueError, match=f"^{next(iter(limit))}: expected"):
        ms.solve_blend(BlendProblem(suite(0)), **limit)


@pytest.mark.parametrize(
    "call, name",
    [
        (lambda blend: blend.total_cost(np.zeros(3)), "blend"),
        (lambda blend: ms.sdp_blocks(blend, 1.0, np.zeros(3)), "choices"),
        (lambda blend: ms.sdp_blocks(blend, np.inf, np.zeros(4)), "theta"),
    ],
)
def test_choices_of_another_length_are_refused(call, name):
    with pytest.raises(ValueError, match=f"^{name}: expected"):
        call(BlendProblem(suite(0)))


# -------------------------------------------------------------- copies of c, semidefinite form


def in_copies(problem, worst, best):
    """Psi', linear and constant of the objective in c' (pH,): ``appx:canonical``, corrected."""
    G0, G1 = problem.mean[:, worst].ravel(), problem.mean[:, best].ravel()
    alpha, Psi, H, p = problem.alpha, problem.psi, *problem.mean.shape[::2]
    Phi = np.outer(G1 - G0, G1 - G0)
    noise = np.array([[np.trace(Psi[t * p : t * p + p, t * p : t * p + p] @ sigma(problem, t, w))
                       for w in (worst, best)] for t in range(H)])  # fmt: skip
    price = np.array([[kappa(problem, t, w) for w in (worst, best)] for t in range(H)])
    step = alpha * noise + problem.beta * price
    linear = 2 * alpha * (G1 - G0) * (Psi @ G0) + np.repeat(np.diff(step)[:, 0] / p, p)
    return alpha * Phi * Psi, linear, alpha * G0 @ Psi @ G0 + step[:, 0].sum()


def ties(H, p):
    """The rows W_{t,r}, r = 1..p-1, which make the p copies of each c_t equal."""
    return [np.eye(H * p)[t * p + r - 1] - np.eye(H * p)[t * p + r]
            for t in range(H) for r in range(1, p)]  # fmt: skip


@given(blends())
def test_the_objective_in_p_tied_copies_of_c_is_the_blend(case):
    problem, worst, best, rng = case
    H, _, p = problem.mean.shape
    c = rng.random(H)
    copies = np.repeat(c, p)
    assert all(row @ copies == 0 for row in ties(H, p))
    quadratic, linear, constant = in_copies(problem, worst, best)
    found = copies @ quadratic @ copies + linear @ copies + constant
    expected = BlendProblem(problem, worst, best).total_cost(c)
    assert abs(found - expected) <= ROUNDING * size(problem)


@pytest.mark.parametrize("p, full", [(1, False), (2, False), (2, True), (3, False)])
@pytest.mark.parametrize("seed", range(2))
def test_the_semidefinite_programme_has_the_optimum_of_the_blend(seed, p, full):
    cp, H, problem = cvxpy(), 3, suite(seed, H=3, p=p, full=full)
    quadratic, linear, constant = in_copies(problem, 0, 1)
    values, vectors = np.linalg.eigh(quadratic)
    M = (vectors * np.sqrt(np.maximum(values, 0))).T  # M'M = Psi'
    c, theta = cp.Variable((H * p, 1)), cp.Variable((1, 1))
    corner = theta - constant - linear[None] @ c
    schur = cp.bmat([[np.eye(H * p), M @ c], [(M @ c).T, corner]])
    numbers = [sign * row @ c for row in ties(H, p) for sign in (1, -1)]
    numbers += [number for t in range(H) for number in (1 - c[t * p], c[t * p])]
    blocks = [cp.diag(cp.hstack([1, number])) for number in numbers]  # [[1, 0], [0, x]]
    programme = cp.Problem(cp.Minimize(theta), [block >> 0 for block in (schur, *blocks)])
    value = programme.solve(solver="CLARABEL")
    assert ms.solve_blend(BlendProblem(problem)).cost == pytest.approx(value, rel=1e-6)


@given(SEEDS, st.integers(1, 4), st.integers(1, 3), st.booleans(), st.sampled_from((-1, 1)))
def test_the_semidefinite_blocks_hold_exactly_above_the_cost_and_in_the_box(
    seed, H, p, inside, side
):
    blend, rng = BlendProblem(suite(seed, H=H, p=p)), np.random.default_rng(seed)
    c = rng.random(H)
    if not inside:
        c[rng.integers(H)] = rng.choice([-0.01, 1.01])
    margin = 1e-6 * size(blend.problem)
    blocks = ms.sdp_blocks(blend, blended_cost(blend.problem, 0, 1, c) + side * margin, c)
    assert [len(block) for block in blocks] == [1] * (2 * H) + [H + 1]
    smallest = np.array([np.linalg.eigvalsh(block)[0] for block in blocks])
    # A step of `margin` past the boundary moves the Schur complement's eigenvalue by a share of
    # it, far above rounding; at the boundary itself rounding would decide.
    assert (smallest[-1] > -1e-12 * np.trace(blocks[-1])) == (side > 0)
    assert (smallest[:-1] >= 0).all() == inside


@pytest.mark.parametrize("p, full", [(1, False), (2, True)])
def test_an_sdp_solver_on_our_blocks_meets_a_qp_solver_on_the_definition(p, full):
    cp, H, problem = cvxpy(), 4, suite(5, H=4, p=p, full=full)
    blend, unit = BlendProblem(problem), np.eye(4)
    # The blocks are affine in (theta, c): probe them with zero and with unit vectors.
    base, *probes = (ms.sdp_blocks(blend, theta, c) for theta, c in
                     [(0, 0 * unit[0]), (1, 0 * unit[0]), *((0, row) for row in unit)])  # fmt: skip
    x, c = cp.Variable(1 + H), cp.Variable(H)
    affine = [block + sum(x[i] * (probe[k] - block) for i, probe in enumerate(probes))
              for k, block in enumerate(base)]  # fmt: skip
    sdp = cp.Problem(cp.Minimize(x[0]), [block >> 0 for block in affine]).solve(solver="CLARABEL")
    values, vectors = np.linalg.eigh(problem.psi)
    F, mean = (vectors * np.sqrt(np.maximum(values, 0))).T, problem.mean
    mixed = [(1 - c[t]) * mean[t, 0, r] + c[t] * mean[t, 1, r] for t in range(H) for r in range(p)]
    step = [[problem.alpha * np.trace(problem.psi[t * p : t * p + p, t * p : t * p + p] @ sigma(
        problem, t, w)) + problem.beta * kappa(problem, t, w) for t in range(H)]
        for w in (0, 1)]  # fmt: skip
    cost = problem.alpha * cp.sum_squares(F @ cp.hstack(mixed)) + (1 - c) @ step[0] + c @ step[1]
    qp = cp.Problem(cp.Minimize(cost), [c >= 0, c <= 1]).solve(solver="CLARABEL")
    assert sdp == pytest.approx(qp, rel=1e-6)


# ------------------------------------------------------------------ a random mixture is no blend


def test_a_random_mixture_adds_the_spread_between_the_models_and_is_not_convex():
    # Draw model 1 with chance c_t, else model 0: errors 0 or 1 of an integrator over two steps.
    problem, chance = tiled(scalar(2), [[0, 0], [1, 1]]), np.array([0.3, 0.6])
    draws = np.array(list(product((0, 1), repeat=2)))
    weight = np.where(draws, chance, 1 - chance).prod(axis=1)
    mixture = weight @ problem.total_cost(draws)
    blend = BlendProblem(problem)
    spread = problem.psi.diagonal() @ (chance * (1 - chance))
    assert mixture == pytest.approx(blend.total_cost(chance) + spread, rel=1e-12)
    # c(1 - c) takes the diagonal out of the quadratic form: what is left has trace zero.
    left = blend.quadratic - np.diag(problem.psi.diagonal())
    assert np.linalg.eigvalsh(left) == pytest.approx([-2 / 3, 2 / 3], rel=1e-12)
    assert np.linalg.eigvalsh(blend.quadratic)[0] >= -1e-15


# ------------------------------------------------------------------------- the Hadamard theorem


@given(blends())
def test_the_quadratic_of_a_blend_is_semidefinite_for_every_suite(case):
    problem, worst, best, _ = case
    in_c = BlendProblem(problem, worst, best).quadratic
    for matrix in (in_c, in_copies(problem, worst, best)[0]):
        values = np.linalg.eigvalsh((matrix + matrix.T) / 2)
        assert values[0] >= -ROUNDING * size(problem)


@given(SEEDS, st.integers(1, 8), st.booleans())
def test_the_printed_and_the_right_factor_are_both_rank_one_gram_matrices(seed, N, whole):
    rng = np.random.default_rng(seed)
    G0, G1 = rng.integers(-2, 3, (2, N)) if whole else rng.normal(size=(2, N))
    printed = np.array([[G0[i] * G0[j] + G0[i] * G1[j] + G1[i] * G0[j] + G1[i] * G1[j]
                         for j in range(N)] for i in range(N)])  # fmt: skip
    right = np.outer(G1 - G0, G1 - G0)
    assert printed == pytest.approx(np.outer(G0 + G1, G0 + G1), abs=1e-12)
    for Phi in (printed, right):
        values, tolerance = np.linalg.eigvalsh(Phi), 1e-13 * N * (np.trace(Phi) + 1)
        assert values[0] >= -tolerance and (np.abs(values[:-1]) <= tolerance).all()


def split(Phi, epsilon):
    """Phi_c = epsilon I + mean(Phi) 11' and Phi_delta = Phi - Phi_c (``eq:phi``)."""
    constant = epsilon * np.eye(len(Phi)) + np.full(Phi.shape, Phi.mean())
    return constant, Phi - constant


def excess(Phi, epsilon):
    """How far ``eq:ass`` is from holding: |Phi_delta| / |Phi_c| * kappa(Phi_c), at most 1 if so."""
    constant, rest = split(Phi, epsilon)
    return np.linalg.norm(rest, 2) / np.linalg.norm(constant, 2) * np.linalg.cond(constant, 2)


@given(SEEDS, st.integers(2, 8), st.integers(-6, 6), st.sampled_from((-1, 1)))
def test_the_papers_assumption_never_holds_strictly(seed, N, magnitude, sign):
    # Phi = Phi_c + Phi_delta is singular, and no singular matrix is nearer to Phi_c than its
    # smallest singular value |Phi_c| / kappa (Eckart and Young).
    G0, G1 = np.random.default_rng(seed).normal(size=(2, N))
    Phi = np.outer(G1 + sign * G0, G1 + sign * G0)
    assert excess(Phi, 10.0**magnitude) >= 1 - 1e-9


@pytest.mark.parametrize("sums", [[2, 2, 2], [3, -1, -2]])
def test_the_papers_assumption_holds_with_equality_where_sums_are_all_equal_or_add_to_zero(sums):
    assert excess(np.outer(sums, sums), epsilon=20) == pytest.approx(1, rel=1e-12)


def test_the_papers_assumption_can_hold_strictly_for_a_single_number_only():
    assert excess(np.array([[4.0]]), 0.5) == pytest.approx(0.5 / 4.5)


def test_the_quadratic_is_semidefinite_where_the_assumption_fails_for_every_epsilon():
    problem = suite(3, H=6)
    delta = problem.mean[:, 1, 0] - problem.mean[:, 0, 0]
    # As epsilon grows, |Phi_delta| kappa / |Phi_c| falls to 1, and from above.
    far = [excess(np.outer(delta, delta), 10.0**k) - 1 for k in range(-3, 5)]
    assert (np.diff(far) < 0).all() and far[-1] > 1e-8
    values = np.linalg.eigvalsh(BlendProblem(problem).quadratic)
    assert values[0] >= -1e-14 * values[-1]


# ------------------------------------------------------------------------------------- complexity


def halves(integers):
    """Whether the integers split into two halves of equal sum: subset sums, as a set."""
    sums = {0}
    for a in integers:
        sums |= {s + a for s in sums}
    return sum(integers) % 2 == 0 and sum(integers) // 2 in sums


def fewest_minuses(integers):
    """The fewest minus signs of every signed sum that can be reached."""
    fewest = {0: 0}
    for a in integers:
        longer = {}
        for s, n in fewest.items():
            for new, minuses in ((s + a, n), (s - a, n + 1)):
                longer[new] = min(minuses, longer.get(new, minuses))
        fewest = longer
    return fewest


def gain(H, information):
    """The g of Psi = g 11' in the gadget: the same for every pattern that foresees."""
    return 1 / 2


FORECASTS = pytest.mark.parametrize("information", ["open_loop", "preview"])


@FORECASTS
@pytest.mark.parametrize("H", [1, 2, 7, 60])
def test_the_gadgets_psi_is_constant_and_is_that_of_a_real_task(H, information):
    problem = ms.partition_problem([3] * H, information)
    assert problem.psi == pytest.approx(np.full((H, H), gain(H, information)), rel=1e-11)
    errors = np.random.default_rng(H).normal(size=(4, H))
    B = np.ones((H, 1, 1))
    B[1:] = 0
    task = replace(scalar(H), B=B)
    by_simulation = gain(H, information) * errors.sum(axis=1) ** 2
    assert rolled_out(task, errors, information) == pytest.approx(by_simulation, rel=1e-9)


@FORECASTS
@example([1])
@example([1, 1])
@example([2, 2, 3])
@example([3, 1, 1, 2, 2, 1])
@given(INTEGERS)
def test_the_optimum_is_below_the_gain_exactly_if_the_integers_split_in_halves(
    information, integers
):
    problem, g = ms.partition_problem(integers, information), gain(len(integers), information)
    schedule = ms.solve(problem)
    balance = np.where(schedule.choices == 0, 1, -1) @ integers
    # Crumbs lie far below the terms (sum a)^2 / 2: rounding leaves a gap, but no doubt.
    assert schedule.cost - schedule.lower_bound <= 1e-9 * schedule.cost + 1e-12 * sum(integers) ** 2
    if halves(integers):
        assert schedule.cost < g / 2 and balance == 0  # the schedule is the partition
    else:
        assert schedule.cost >= g * (1 - 1e-12) and balance != 0


@FORECASTS
@settings(max_examples=settings.default.max_examples // 3)
@given(INTEGERS)
def test_the_optimum_of_the_gadget_is_that_of_a_table_over_signed_sums(information, integers):
    problem, H = ms.partition_problem(integers, information), len(integers)
    g, table = gain(H, information), fewest_minuses(integers)
    expected = min(g * s**2 + n / (8 * H) for s, n in table.items())
    assert ms.solve(problem).cost == pytest.approx(expected, rel=1e-9)


@FORECASTS
def test_a_single_one_costs_the_gain_itself_and_has_no_halves(information):
    # The boundary: |+-1| = 1, and model 0 is free.
    schedule = ms.solve(ms.partition_problem([1], information))
    assert schedule.cost == pytest.approx(1 / 2, rel=1e-15) and not halves([1])


@pytest.mark.no_cover
@FORECASTS
@pytest.mark.parametrize("H, top", [(20, 60), (40, 30), (60, 9), (60, 30)])
@pytest.mark.parametrize("odd", [False, True])
def test_on_the_gadget_labels_stay_within_a_few_times_the_distinct_signed_sums(
    H, top, odd, information
):
    integers = [int(a) for a in np.random.default_rng(H + top).integers(1, top, H)]
    integers[0] += sum(integers) % 2 != odd
    schedule = ms.dynamic_program(ms.partition_problem(integers, information))
    # Costs far below their terms: double precision leaves a gap, but decides the question.
    assert schedule.gap <= 1e-9 or schedule.cost - schedule.lower_bound <= 1e-6
    assert (schedule.cost < gain(H, information)) == (not odd)
    sums = [len(fewest_minuses(integers[t:])) for t in range(H)]
    # Equal sums merge; rounding keeps a few copies apart.  Without merging there were 2^H.
    assert (schedule.work["labels"] <= 2 * np.array(sums)).all()
    assert max(sums) <= sum(integers) + 1 < 2**H  # sums of one parity from -sum to sum


@pytest.mark.parametrize("information", ["causal", "measurement"])
def test_the_gadget_needs_a_forecast(information):
    with pytest.raises(ValueError, match=r"^information: expected one of open_loop, preview"):
        ms.partition_problem([1, 2], information)


@FORECASTS
@pytest.mark.parametrize("seed", range(12))
def test_the_cheapest_schedule_is_a_maximum_cut(seed, information):
    rng = np.random.default_rng(seed)
    H = int(rng.integers(1, 8))
    graph = np.triu(rng.random((H, H)) < 0.5, 1).astype(float)
    graph += graph.T
    problem = ms.maximum_cut_problem(graph, information)
    signs = sign_patterns(H)
    cuts = [sum(graph[i, j] for i in range(H) for j in range(i) if e[i] != e[j]) for e in signs]
    values = ((signs @ problem.psi) * signs).sum(axis=1)
    rest = values - H * (2 * H * H - 4 * np.array(cuts)) + H
    assert (rest > 0).all() and (rest < 1 / 2).all()
    best = ms.solve(problem)
    assert best.is_optimal
    chosen = (signs == 2 * best.choices - 1).all(axis=1)
    assert cuts[int(chosen.argmax())] == max(cuts)


@pytest.mark.parametrize("bad", [[[0, 1]], [[0, 1], [0, 0]], [[1]], [[0, 2], [2, 0]], 3])
def test_a_graph_is_a_symmetric_matrix_of_0_and_1_without_loops(bad):
    with pytest.raises(ValueError, match=r"^adjacency: expected"):
        ms.maximum_cut_problem(bad)


@pytest.mark.parametrize("bad", [[], [0], [-1], [1.5], [True], [[1, 2]]])
def test_the_gadget_takes_positive_integers_only(bad):
    with pytest.raises(ValueError, match=r"integers"):
        ms.partition_problem(bad)


def solved_step_by_step(problem):
    """Whether `solve_separable` finds and proves the enumerated optimum."""
    schedule, best = ms.solve_separable(problem), least(problem)
    tolerance = ROUNDING * size(problem)
    return (
        abs(schedule.cost - best) <= tolerance
        and abs(problem.total_cost(schedule.choices) - schedule.cost) <= tolerance
        and schedule.cost - tolerance <= schedule.lower_bound <= schedule.cost
    )


@given(problems(unbiased=True))
def test_unbiased_models_are_solved_step_by_step(problem):
    assert solved_step_by_step(problem)


@given(problems())
def test_without_control_cost_models_are_solved_step_by_step(problem):
    assert solved_step_by_step(replace(problem, alpha=0.0))


@given(tasks(max_horizon=4), st.sampled_from(("causal", "measurement")), SEEDS)
def test_without_a_forecast_models_are_solved_step_by_step(task, information, seed):
    Psi, rng = ms.psi(task, information), np.random.default_rng(seed)
    shape = (task.horizon, 3, task.p)
    cost = rng.random(3) * np.trace(Psi)  # so that neither cost decides alone
    problem = SelectionProblem(Psi, rng.normal(size=shape), rng.random(shape), cost)
    assert solved_step_by_step(problem)


# --------------------------------------------------------------------------- information patterns

PATTERNS = ms.INFORMATION  # open_loop, preview, causal, measurement


def bills(task, errors, cost):
    """Optimal schedules by pattern, and bills[i, j]: acting on j's schedule, where i is true.

    The schedules come from `solve`, the bills from roll-outs.
    """
    errors, cost, steps = np.asarray(errors, dtype=float), np.asarray(cost), np.arange(task.horizon)
    optima = {name: ms.solve(replace(tiled(task, errors, information=name), model_cost=cost))
              for name in PATTERNS}  # fmt: skip
    chosen = [optima[name].choices for name in PATTERNS]
    paid = [[rolled_out(task, errors[c, steps], name) + cost[c].sum() for c in chosen]
            for name in PATTERNS]  # fmt: skip
    return [c.tolist() for c in chosen], np.array(paid)


def test_errors_of_one_sign_need_the_better_models_the_more_is_staked_on_the_forecast():
    # A stable plant, three models off by 1, by 1/2 and not at all, at a quarter a class.
    schedules, paid = bills(
        scalar(6, A=0.8), [np.ones(6), np.full(6, 0.5), np.zeros(6)], [0, 0.25, 0.5]
    )
    assert schedules == [
        [0, 0, 2, 2, 2, 2],  # open_loop
        [0, 0, 0, 0, 0, 2],  # preview
        [0, 0, 0, 0, 0, 1],  # causal
        [0, 0, 0, 0, 0, 0],  # measurement
    ]
    extra = paid / paid.diagonal()[:, None] - 1
    # What acting on the wrong pattern's schedule costs, in per cent of the right one's bill.
    assert np.round(100 * extra).tolist() == [
        [0, 139, 217, 310],
        [117, 0, 23, 84],
        [314, 26, 0, 26],
        [414, 46, 3, 0],
    ]


def test_errors_that_alternate_need_them_the_less():
    # An unstable plant, twice the price: a plan cancels such errors, feedback reacts to each.
    sign = (-1.0) ** np.arange(6)
    schedules, paid = bills(scalar(6, A=1.2), [sign, sign / 2, 0 * sign], [0, 0.1, 0.2])
    assert schedules == [
        [0, 0, 1, 0, 0, 0],
        [0, 0, 0, 0, 0, 1],
        [1, 1, 1, 1, 1, 2],
        [1, 1, 1, 1, 2, 2],
    ]
    extra = paid / paid.diagonal()[:, None] - 1
    assert extra[0, 1] > extra[0, 2] > extra[0, 3] > 8  # a plan, on schedules made for feedback
    assert extra[3, 0] > extra[3, 1] > extra[3, 2] > 0  # feedback, on schedules made for a plan


@settings(max_examples=settings.default.max_examples // 2)
@given(tasks(max_horizon=4, max_p=2), SEEDS)
def test_acting_on_the_schedule_of_another_pattern_never_pays(task, seed):
    rng, shape = np.random.default_rng(seed), (task.horizon, 3, task.p)
    mean, variance, cost = rng.normal(size=shape), rng.random(shape), rng.random(3)
    cost *= np.trace(ms.psi(task))
    here = [SelectionProblem(ms.psi(task, name), mean, variance, cost) for name in PATTERNS]
    schedules = [ms.solve(problem).choices for problem in here]
    for i, problem in enumerate(here):
        paid = problem.total_cost(schedules)
        assert paid[i] <= paid.min() + 1e-9 * size(problem)


# --------------------------------------------------------------------------- bias against variance


def coupled(problem, theta):
    """The problem with its coupling turned down: (1 - theta) blockdiag(Psi) + theta Psi."""
    H, _, p = problem.mean.shape
    same = np.kron(np.eye(H), np.ones((p, p)))
    return replace(problem, psi=np.where(same, problem.psi, theta * problem.psi))


@given(problems())
def test_the_error_cost_splits_the_control_term_of_running_one_model(problem):
    H, W, p = problem.mean.shape
    found, Psi = ms.error_cost(problem), problem.psi
    tolerance = ROUNDING * size(replace(problem, alpha=1.0, beta=0.0))
    for w in range(W):
        mu = problem.mean[:, w].ravel()
        bias = sum(mu[i] * Psi[i, j] * mu[j] for i, j in product(range(H * p), repeat=2))
        squares, noise, uncoupled = 0.0, 0.0, 0.0
        for t in range(H):
            block, S = Psi[t * p : t * p + p, t * p : t * p + p], sigma(problem, t, w)
            second = S + np.outer(problem.mean[t, w], problem.mean[t, w])  # E[e_t e_t']
            squares += np.trace(second) / H
            noise += sum(block[r, q] * S[q, r] for r in range(p) for q in range(p))
            uncoupled += sum(block[r, q] * second[q, r] for r in range(p) for q in range(p))
        assert found.mean_square[w] == pytest.approx(squares, rel=1e-12)
        assert abs(found.bias[w] - bias) <= tolerance
        assert abs(found.noise[w] - noise) <= tolerance
        assert abs(found.uncoupled[w] - uncoupled) <= tolerance
        always = problem.control_term(np.full(H, w))
        assert abs(found.bias[w] + found.noise[w] - always) <= tolerance


@given(problems())
def test_the_uncoupled_cost_is_what_choosing_step_by_step_sees(problem):
    alone = replace(problem, alpha=1.0, beta=0.0, model_cost=np.zeros(problem.mean.shape[1]))
    seen = ms.stepwise_cost(alone).sum(axis=0)
    assert np.abs(ms.error_cost(problem).uncoupled - seen).max() <= ROUNDING * size(alone)


@given(problems(), st.floats(0, 1))
def test_bias_cost_is_linear_in_the_coupling_and_the_rest_does_not_feel_it(problem, theta):
    none, part, full = (ms.error_cost(coupled(problem, x)) for x in (0, theta, 1))
    tolerance = ROUNDING * size(replace(problem, alpha=1.0, beta=0.0))
    assert np.abs(part.bias - (1 - theta) * none.bias - theta * full.bias).max() <= tolerance
    assert np.abs(none.bias + none.noise - none.uncoupled).max() <= tolerance  # no coupling
    for name in ("noise", "uncoupled", "mean_square"):
        assert (getattr(part, name) == getattr(full, name)).all()


def three_suites(H, biased=1.0, alternating=1.0, information="open_loop", Q=0.0):
    """An integrator with models of these mean squares: biased, noisy (mean square 1), alternating.

    The models' errors are +b; +-1 at random; +b, -b, +b, ...
    """
    constant, sign = np.full(H, biased**0.5), alternating**0.5 * (-1.0) ** np.arange(H)
    problem = tiled(scalar(H, Q=Q), [constant, 0 * sign, sign], information=information)
    variance = np.zeros((H, 3, 1))
    variance[:, 1] = 1
    return replace(problem, variance=variance)


@pytest.mark.parametrize("information, Q", [("open_loop", 0), ("open_loop", 1), ("preview", 1)])
@pytest.mark.parametrize("H", [4, 12])
def test_at_equal_mean_square_one_sign_costs_more_than_noise_and_alternation_less(
    H, information, Q
):
    problem = three_suites(H, information=information, Q=Q)
    assert (problem.psi > 0).all()  # errors of one sign add up
    cost = ms.error_cost(problem)
    assert cost.mean_square == pytest.approx(1) and np.ptp(cost.uncoupled) <= 1e-12
    biased, noisy, alternating = cost.bias + cost.noise
    assert biased > noisy > alternating


def test_over_an_integrator_one_sign_costs_h_times_what_the_square_says_and_alternation_nothing():
    cost = ms.error_cost(three_suites(12))
    assert (cost.bias + cost.noise) / cost.uncoupled == pytest.approx([12, 1, 0], abs=1e-12)


def test_the_misjudgement_grows_with_the_coupling_both_ways():
    problem, thetas = three_suites(12, Q=1), np.linspace(0, 1, 6)
    costs = [ms.error_cost(coupled(problem, theta)) for theta in thetas]
    ratio = np.array([(cost.bias + cost.noise) / cost.uncoupled for cost in costs])
    assert ratio[0] == pytest.approx(1, rel=1e-12)
    steps = np.diff(ratio, axis=0)
    assert (steps[:, 0] > 0).all() and (steps[:, 2] < 0).all()
    assert steps == pytest.approx(np.tile(steps[0], (5, 1)), rel=1e-9, abs=1e-12)  # a line


def true_costs(problem):
    """Expected control cost of running each of `three_suites`, by flying all draws of the noise."""
    H, task = len(problem.mean), scalar(len(problem.mean))
    errors = problem.mean[:, :, 0].T[:, None] + np.sqrt(problem.variance[:, :, 0]).T[
        :, None
    ] * sign_patterns(H)
    return rolled_out(task, errors).mean(axis=1)


def test_mean_square_ranks_a_biased_model_first_that_flies_worse_than_noise():
    problem = three_suites(8, biased=0.5)
    biased, noisy, _ = true_costs(problem)
    cost = ms.error_cost(problem)
    assert cost.mean_square[0] == pytest.approx(0.5) and cost.mean_square[1] == 1
    assert cost.bias[0] == pytest.approx(biased) and cost.noise[1] == pytest.approx(noisy)
    assert biased == pytest.approx(4 * noisy)  # 8 steps, half the square: not half, four times


def test_mean_square_ranks_an_alternating_model_last_that_flies_better_than_noise():
    problem = three_suites(7, alternating=2)
    _, noisy, alternating = true_costs(problem)
    cost = ms.error_cost(problem)
    assert cost.mean_square[2] == pytest.approx(2) and cost.mean_square[1] == 1
    assert cost.bias[2] == pytest.approx(alternating)
    assert alternating == pytest.approx(2 / 7 * noisy)  # one of seven errors is left, not double


# ------------------------------------------------------------------------------ correlated errors


def joint_errors(problem, seed, whole=False):
    """Errors of all models at all steps, factor @ independent unit noise: (H, W, p, k)."""
    rng, k = np.random.default_rng(seed), 6
    shape = (*problem.mean.shape, k)
    return rng.integers(-1, 2, shape).astype(float) if whole else rng.normal(size=shape)


def covariance_of(factor):
    """covariance(t, w, k, v) of errors factor @ noise."""
    return lambda t, w, k, v: factor[t, w] @ factor[k, v].T


@given(problems(unavailable=False), SEEDS)
def test_uncorrelated_steps_are_the_special_case_of_independence(problem, seed):
    H, W, p = problem.mean.shape
    c = np.random.default_rng(seed).integers(W, size=H)
    found = ms.correlated_cost(
        problem, c, lambda t, w, k, v: sigma(problem, t, w) if t == k else np.zeros((p, p))
    )
    assert abs(found - problem.total_cost(c)) <= ROUNDING * size(problem)


@given(problems(unavailable=False), SEEDS, st.booleans())
def test_correlated_cost_is_the_exact_average_over_correlated_draws(problem, seed, whole):
    factor, steps = joint_errors(problem, seed, whole), np.arange(len(problem.mean))
    c = np.random.default_rng(seed).integers(problem.mean.shape[1], size=len(steps))
    e = np.einsum("tij,kj->kti", factor[steps, c], sign_patterns(6)) + problem.mean[steps, c]
    e = e.reshape(64, -1)
    expected = problem.alpha * np.mean([row @ problem.psi @ row for row in e])
    expected += problem.beta * sum(kappa(problem, t, w) for t, w in enumerate(c))
    found = ms.correlated_cost(problem, c, covariance_of(factor))
    assert abs(found - expected) <= ROUNDING * (size(problem) + np.linalg.norm(problem.psi) * (
        factor**2).sum())  # fmt: skip


def test_correlated_cost_is_the_average_over_sampled_gaussian_errors():
    problem, trials = suite(4, H=5, W=3, p=2), 200_000
    factor, c = joint_errors(problem, 9), np.array([2, 0, 1, 1, 2])
    mean, G = problem.chosen_mean(c), factor[np.arange(5), c].reshape(10, 6)
    e = np.random.default_rng(6).multivariate_normal(mean, G @ G.T, trials)
    paid = 0.8 * ((e @ problem.psi) * e).sum(axis=1) + 0.2 * problem.perception_term(c)
    found = ms.correlated_cost(problem, c, covariance_of(factor))
    # 4.5 standard errors: a right formula fails for one seed in 150,000, and this seed is fixed.
    standard_error = paid.std() / np.sqrt(trials)
    assert abs(found - paid.mean()) <= 4.5 * standard_error
    assert standard_error < 0.01 * found  # so that a few per cent would be seen
    independent = replace(problem, variance=np.einsum("twik,twjk->twij", factor, factor))
    assert abs(independent.total_cost(c) - found) > 20 * standard_error


@given(problems(unavailable=False), SEEDS)
def test_the_variance_of_the_problem_plays_no_part(problem, seed):
    c = np.random.default_rng(seed).integers(problem.mean.shape[1], size=len(problem.mean))
    covariance = covariance_of(joint_errors(problem, seed))
    without = replace(problem, variance=np.zeros_like(problem.mean))
    found, same = (ms.correlated_cost(it, c, covariance) for it in (problem, without))
    assert abs(found - same) <= ROUNDING * size(problem)


def autoregressive(rho):
    """e_{t+1} = rho e_t + noise with unit variance throughout, whichever model runs."""
    return lambda t, w, k, v: rho ** abs(t - k)


def recursion(rho, H):
    """The factor of such errors: e = factor @ unit noise, by unrolling the recursion."""
    rows = [np.eye(H)[0]]
    for t in range(1, H):
        rows.append(rho * rows[-1] + np.sqrt(1 - rho**2) * np.eye(H)[t])
    return np.array(rows)


@pytest.mark.parametrize("information", ["open_loop", "preview"])
@pytest.mark.parametrize("rho", [-0.9, -0.3, 0.0, 0.5, 0.99])
def test_autoregressive_errors_cost_what_flying_them_costs(rho, information):
    H, task = 8, scalar(8, Q=1)
    problem = tiled(task, np.zeros((1, H)), information=information)
    flown = rolled_out(task, sign_patterns(H) @ recursion(rho, H).T, information).mean()
    found = ms.correlated_cost(problem, [0] * H, autoregressive(rho))
    assert found == pytest.approx(flown, rel=1e-10)


@pytest.mark.parametrize("rho", [-0.9, -0.3, 0.0, 0.5, 0.99])
def test_autoregressive_errors_of_an_integrator_have_a_closed_form(rho):
    H = 12
    problem = tiled(scalar(H), np.zeros((1, H)))
    # Psi = g 11', so the cost is g Var(sum_t e_t).
    total = H * (1 + rho) / (1 - rho) - 2 * rho * (1 - rho**H) / (1 - rho) ** 2
    found = ms.correlated_cost(problem, [0] * H, autoregressive(rho))
    assert found == pytest.approx(H / (1 + H) * total, rel=1e-11)


def test_independence_understates_the_cost_the_more_the_longer_errors_last():
    H, rhos = 12, np.array([-0.9, -0.5, 0, 0.3, 0.6, 0.9, 0.99, 1])
    problem = replace(tiled(scalar(H), np.zeros((1, H))), variance=np.ones((H, 1, 1)))
    claimed = problem.total_cost([0] * H)
    ratio = [ms.correlated_cost(problem, [0] * H, autoregressive(rho)) / claimed for rho in rhos]
    assert (np.diff(ratio) > 0).all()
    assert ratio[2] == pytest.approx(1) and ratio[0] < 0.1  # alternating errors cancel
    assert ratio[4] == pytest.approx(3.38, abs=0.005)
    assert ratio[-1] == pytest.approx(H)  # an error that never changes is a bias


@pytest.mark.parametrize(
    "covariance, fragment",
    [
        (lambda t, w, k, v: 1.0 if t == k else 2.0, "positive semidefinite"),
        (lambda t, w, k, v: -1.0 if t == k else 0.0, "positive semidefinite"),
        (lambda t, w, k, v: 1.0 + (t == k) + 0.5 * (t < k), "symmetric"),
        (lambda t, w, k, v: np.nan, "finite"),
    ],
)
def test_what_is_no_covariance_over_all_steps_is_refused(covariance, fragment):
    problem = tiled(scalar(3), np.zeros((1, 3)))
    with pytest.raises(ValueError, match=rf"^covariance: expected .*{fragment}"):
        ms.correlated_cost(problem, [0, 0, 0], covariance)


def test_integers_may_add_up_to_ten_million_and_no_further():
    assert len(ms.partition_problem([9_999_999, 1]).psi) == 2
    with pytest.raises(ValueError, match=r"^integers: .* at most 1e7, found 10000001"):
        ms.partition_problem([10_000_000, 1])


def test_a_number_is_a_covariance_only_of_errors_with_one_component():
    problem = SelectionProblem(np.eye(4), np.zeros((2, 1, 2)), np.zeros((2, 1, 2)), [0])
    with pytest.raises(ValueError, match=r"^covariance: expected shape \(p, p\) = \(2, 2\), found"):
        ms.correlated_cost(problem, [0, 0], lambda *_: 1.0)
