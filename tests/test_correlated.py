"""Errors that correlate over time: the problem of W components, against all draws and schedules.

The oracle draws errors e = mean + factor @ signs, all 64 vectors of signs equally likely, and adds
up what they cost: no covariance, no lift.
"""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import landing
import modelselect as ms
from modelselect import SelectionProblem, autoregressive_errors, persistent_bias

from strategies import every_schedule, gram, numbers, problems, sign_patterns

SEEDS = pytest.mark.parametrize("seed", range(30))


def drawn(seed):
    """A tiny problem of any features, and factors (H, W, p, 6) of its errors."""
    rng = np.random.default_rng(seed)
    H, W, p = (int(rng.integers(1, top + 1)) for top in (4, 3, 2))
    factor = rng.normal(size=(H, W, p, 6)) * (rng.random((H, W, 1, 1)) < 0.9)
    features = {}
    if seed % 2:
        features["switch_cost"] = rng.integers(0, 4, (W, W)) * (1.0 - np.eye(W))
        features["initial_model"] = 0
    if seed % 3 == 0:
        features["pull"] = rng.normal(size=(H, p))
    price = rng.integers(0, 5, (H, W)).astype(float)
    price[:, 1:][rng.random((H, W - 1)) < 0.1] = np.inf
    if seed % 4 < 2:
        features["budget"] = 2.5 * H + 3
    problem = SelectionProblem(
        gram(rng, (H * p,), int(rng.integers(1, H * p + 1)), False),
        rng.normal(size=(H, W, p)) * (seed % 5 > 0),
        rng.random((H, W, p)),
        np.minimum(price, price[:, :1] + 9) if seed % 7 == 0 else price,
        alpha=0.8,
        beta=1.5,
        **features,
    )
    return problem, factor


def covariance_of(factor):
    return np.einsum("twri,kvsi->twrkvs", factor, factor)


def drawn_cost(problem, factor, c):
    """The mean over all draws of what schedule c costs, term by term."""
    t = np.arange(len(c))
    e = np.einsum("tri,ni->ntr", factor[t, c], sign_patterns(6)) + problem.mean[t, c]
    e = e.reshape(64, -1)
    control = np.mean(((e @ problem.psi) * e).sum(axis=1))
    if problem.pull is not None:
        control += np.mean(e @ problem.pull.ravel())
    price = np.broadcast_to(problem.model_cost, problem.mean.shape[:2])
    paid = [*price[t, c]]
    if problem.switch_cost is not None:
        paid += [problem.switch_cost[v, w] for v, w in zip([0, *c[:-1]], c, strict=True)]
    spent = sum(paid)
    return problem.alpha * control + problem.beta * spent if spent < np.inf else np.inf


@SEEDS
def test_every_schedule_costs_what_all_draws_cost_on_average(seed):
    problem, factor = drawn(seed)
    Cov, schedules = covariance_of(factor), every_schedule(problem)
    lifted = ms.correlated_problem(problem, Cov)
    assert lifted.mean.shape[2] == problem.mean.shape[1] and not lifted.variance.any()
    expected = np.array([drawn_cost(problem, factor, c) for c in schedules])
    for found in (lifted.total_cost(schedules), ms.correlated_cost(problem, schedules, Cov)):
        np.testing.assert_allclose(found, expected, rtol=1e-11, atol=1e-11)
    one = ms.correlated_cost(problem, schedules[-1], Cov)
    assert np.ndim(one) == 0 and one == pytest.approx(expected[-1], rel=1e-11)
    np.testing.assert_array_equal(lifted.is_feasible(schedules), problem.is_feasible(schedules))


@SEEDS
def test_solvers_find_and_prove_the_cheapest_schedule(seed):
    problem, factor = drawn(seed)
    schedules = [c for c in every_schedule(problem) if problem.is_feasible(c)]
    best = min(drawn_cost(problem, factor, c) for c in schedules)
    lifted = ms.correlated_problem(problem, covariance_of(factor))
    found = ms.solve(lifted)
    assert found.is_optimal and found.cost == pytest.approx(best, rel=1e-9, abs=1e-9)
    assert ms.check_certificate(lifted, found) <= best + 1e-9 * abs(best)


@SEEDS
def test_what_is_left_is_semidefinite_and_what_is_taken_is_not_negative(seed):
    problem, factor = drawn(seed)
    lifted = ms.correlated_problem(replace(problem, pull=None), covariance_of(factor))
    least = np.linalg.eigvalsh(lifted.psi)[0]
    assert least >= -1e-13 * np.abs(lifted.psi).max()
    assert lifted.pull.min() >= -1e-13 * np.abs(lifted.psi).max()


@given(problems(), st.integers(0, 2**32 - 1), st.booleans())
def test_singular_and_whole_problems_of_any_unit_cost_the_same_and_are_solved(problem, seed, whole):
    rng = np.random.default_rng(seed)
    factor = numbers(rng, (*problem.mean.shape, 6), whole)
    lifted = ms.correlated_problem(problem, covariance_of(factor))
    schedules = every_schedule(problem)
    expected = np.array([drawn_cost(problem, factor, c) for c in schedules])
    found, usable = lifted.total_cost(schedules), np.isfinite(expected)
    np.testing.assert_array_equal(np.isfinite(found), usable)
    found, expected = found[usable], expected[usable]
    size = np.linalg.norm(problem.psi) * ((factor**2).sum() + (problem.mean**2).sum())
    within = 1e-11 * (problem.alpha * size + np.abs(expected).max())
    assert np.abs(found - expected).max() <= within
    best, least = ms.solve(lifted), expected.min()
    assert best.lower_bound - within <= least <= best.cost + within
    assert best.cost - best.lower_bound <= 1e-9 * best.cost + within


def test_three_lines_for_biases_that_nobody_knows():
    problem = SelectionProblem(np.ones((6, 6)), np.zeros((6, 3, 1)), np.zeros((6, 3, 1)), [0, 0, 0])
    lasting = persistent_bias([1, 1, 2], white_variance=problem.variance)
    schedule = ms.solve(ms.correlated_problem(problem, lasting))
    assert schedule.is_optimal and len(set(schedule.choices)) == 3


# -------------------------------------------------------------------------- the covariance


def test_a_covariance_of_one_component_may_leave_it_out():
    problem = SelectionProblem(np.eye(2), np.ones((2, 1, 1)), np.ones((2, 1, 1)), [0])
    Cov = persistent_bias([2], np.ones((2, 1, 1)))
    short = Cov.reshape(2, 1, 2, 1)
    assert ms.correlated_cost(problem, [0, 0], short) == 2 * (1 + 2 + 1)
    np.testing.assert_array_equal(
        ms.correlated_problem(problem, short).psi, ms.correlated_problem(problem, Cov).psi
    )


def test_a_function_fills_the_array():
    problem, factor = drawn(10)
    Cov = covariance_of(factor)
    lifted = ms.correlated_problem(problem, Cov)
    other = ms.correlated_problem(problem, lambda t, w, k, v: Cov[t, w, :, k, v])
    np.testing.assert_array_equal(other.psi, lifted.psi)


def sampled(Cov, draw, trials=20_000):
    """How many standard errors the products of drawn errors (trials, H, W, p) are off Cov."""
    e = draw(trials).reshape(trials, -1)
    products = e.T @ e / trials
    variance = Cov.reshape(products.shape)
    own = variance.diagonal()
    return np.abs(products - variance) / np.sqrt((np.outer(own, own) + variance**2) / trials)


SHARED = np.array([[1, 0.6], [0.6, 1]])


def test_a_persistent_bias_has_the_covariance_of_its_draws():
    rng, H = np.random.default_rng(1), 3
    tau2, white = np.array([[1, 4], [9, 2]]), rng.random((H, 2, 2)) + 0.5
    root = np.linalg.cholesky(SHARED)

    def draw(trials):
        bias = np.einsum("vw,nwp->nvp", root, rng.normal(size=(trials, 2, 2))) * np.sqrt(tau2)
        return bias[:, None] + rng.normal(size=(trials, H, 2, 2)) * np.sqrt(white)

    assert sampled(persistent_bias(tau2, white, correlation=SHARED), draw).max() < 4.5


@pytest.mark.parametrize("rho", [0.8, -0.5, [0.9, 0.5], [1, 0]])
def test_autoregressive_errors_have_the_covariance_of_their_recursion(rho):
    rng, H = np.random.default_rng(2), 4
    variance, last = rng.random((H, 2, 2)) + 0.5, np.broadcast_to(rho, 2)
    R = np.eye(2) if rho == [1, 0] else SHARED
    noise = R * (1 - np.outer(last, last))

    def draw(trials):
        first = rng.multivariate_normal([0, 0], R, (trials, 2))
        x = [first]
        for _ in range(H - 1):
            x.append(x[-1] * last + rng.multivariate_normal([0, 0], noise, (trials, 2)))
        return np.moveaxis(np.array(x), (0, 1, 2, 3), (1, 0, 3, 2)) * np.sqrt(variance)

    assert sampled(autoregressive_errors(variance, rho, correlation=R), draw).max() < 4.5


@pytest.mark.parametrize(
    "call, line",
    [
        (lambda: persistent_bias([1, -1], np.ones((3, 2, 1))), "bias_variance: expected numbers"),
        (lambda: persistent_bias([1, 1], -np.ones((3, 2, 1))), "white_variance: expected numbers"),
        (lambda: persistent_bias([1, 1], np.ones((3, 2, 2))), "bias_variance: expected shape"),
        (lambda: autoregressive_errors(np.ones((3, 2, 1)), 1.1), "rho: expected numbers"),
        (lambda: autoregressive_errors(np.ones((3, 2, 1)), [0, 0, 0]), "rho: expected shape"),
        (
            lambda: autoregressive_errors(np.ones((3, 2, 1)), 0, correlation=2 * np.eye(2)),
            "correlation: expected 1 on the diagonal",
        ),
        (  # two that share 0.9 of their errors cannot remember so differently
            lambda: autoregressive_errors(
                np.ones((3, 2, 1)), [0.99, 0], correlation=[[1, 0.9], [0.9, 1]]
            ),
            "correlation: expected a positive semidefinite",
        ),
        (
            lambda: ms.correlated_cost(*tiny(), np.ones((2, 2, 1))),
            "covariance: expected shape (H, W, p, H, W, p) = (2, 1, 1, 2, 1, 1), found (2, 2, 1)",
        ),
        (
            lambda: ms.correlated_problem(tiny()[0], np.reshape([1, 2, 2, 1], (2, 1, 2, 1))),
            "covariance: expected a positive semidefinite",
        ),
        (
            lambda: ms.correlated_problem(tiny()[0], np.reshape([1, 0.5, 0, 1], (2, 1, 2, 1))),
            "covariance: expected a symmetric",
        ),
    ],
)
def test_what_is_no_covariance_is_refused(call, line):
    with pytest.raises(ValueError) as caught:
        call()
    assert str(caught.value).startswith(line)


def tiny():
    return SelectionProblem(np.eye(2), np.ones((2, 1, 1)), np.ones((2, 1, 1)), [0]), [0, 0]


# ------------------------------------------------------------------- what is taken out


@pytest.mark.parametrize("p", [1, 2])
def test_white_errors_become_the_pull_and_persistent_ones_stay(p):
    """All of a white part that varies by model and step; Psi alone has nothing to give (rank 1)."""
    rng, H, W = np.random.default_rng(3), 6, 3
    white = gram(rng, (H, W, p), p, False)
    Psi = np.outer(*2 * (rng.random(H * p) + 0.5,))
    problem = SelectionProblem(Psi, np.zeros((H, W, p)), white, np.zeros(W))
    Cov, (t, w) = persistent_bias(rng.random((W, p)), np.zeros((H, W, p))), np.indices((H, W))
    Cov[t, w, :, t, w] += white
    lifted = ms.correlated_problem(problem, Cov)
    np.testing.assert_allclose(lifted.pull, problem.spread, rtol=1e-5)
    values = np.linalg.eigvalsh(lifted.psi)
    assert values[-W * p] > 1e-3 * values[-1] and values[-W * p - 1] < 1e-5 * values[-1]


@pytest.mark.parametrize("seed", range(20))
def test_errors_that_the_controller_does_not_feel_leave_rounding_only(seed):
    """Psi_tt = uu' and errors across u: squares that cancel, of either sign as computed."""
    rng, H = np.random.default_rng(seed), 4
    u = rng.normal(size=2)
    Psi = np.kron(gram(rng, (H,), 2, False), np.outer(u, u))
    factor = rng.normal(size=(H, 2, 2, 6))
    factor[:, 0] = np.multiply.outer([-u[1], u[0]], rng.normal(size=(H, 6))).swapaxes(0, 1)
    problem = SelectionProblem(Psi, np.zeros((H, 2, 2)), np.zeros((H, 2, 2)), [1, 0])
    lifted = ms.correlated_problem(problem, covariance_of(factor))
    for c in every_schedule(problem):
        expected = drawn_cost(problem, factor, c)
        assert lifted.total_cost(c) == pytest.approx(expected, rel=1e-12, abs=1e-11)


def test_autoregressive_errors_give_the_least_eigenvalue_of_their_correlations():
    H, rho = 8, 0.9
    problem = SelectionProblem(np.ones((H, H)), np.zeros((H, 1, 1)), np.zeros((H, 1, 1)), [0])
    lifted = ms.correlated_problem(problem, autoregressive_errors(np.ones((H, 1, 1)), rho))
    least = np.linalg.eigvalsh(rho ** np.abs(np.subtract.outer(np.arange(H), np.arange(H))))[0]
    np.testing.assert_allclose(lifted.pull, least, rtol=1e-5)
    assert least > (1 - rho) / (1 + rho)


def test_what_psi_itself_has_on_its_diagonal_alone_is_taken_out_too():
    """Psi = 11' + I under persistent errors of variance 4: Psi' = 4 x 11' + 4 I for each model."""
    zero = np.zeros((5, 2, 1))
    problem = SelectionProblem(np.ones((5, 5)) + np.eye(5), zero, zero, [0, 0])
    lifted = ms.correlated_problem(problem, persistent_bias([4, 4], zero))
    np.testing.assert_allclose(lifted.pull, 4, rtol=1e-5)


# -------------------------------------------------------------------- the portfolio effect


@pytest.mark.parametrize("W", [2, 3])
def test_a_single_model_costs_w_times_as_much_as_a_share_of_each(W):
    """Psi = 11', equal tau: model w on h_w steps costs tau^2 sum_w h_w^2, H^2 or W (H/W)^2."""
    H, tau = 6, 3.0
    zero = np.zeros((H, W, 1))
    problem = SelectionProblem(np.ones((H, H)), zero, zero, np.zeros(W))
    Cov = persistent_bias(np.full(W, tau**2), zero)
    best = ms.solve(ms.correlated_problem(problem, Cov))
    assert (np.bincount(best.choices, minlength=W) == H / W).all()
    assert best.cost == pytest.approx(tau**2 * H**2 / W, rel=1e-12)
    single = ms.correlated_cost(problem, np.full(H, 0), Cov)
    assert single == pytest.approx(W * best.cost, rel=1e-12)


def test_the_optimum_weighs_models_by_the_inverse_of_their_variance():
    """Minimise tau_0^2 h^2 + tau_1^2 (H-h)^2: h = H tau_1^2 / (tau_0^2 + tau_1^2)."""
    zero = np.zeros((6, 2, 1))
    problem = SelectionProblem(np.ones((6, 6)), zero, zero, np.zeros(2))
    best = ms.solve(ms.correlated_problem(problem, persistent_bias([1, 2], zero)))
    assert (np.bincount(best.choices) == [4, 2]).all()
    assert best.cost == pytest.approx(36 / (1 / 1 + 1 / 2), rel=1e-12)  # H^2 / sum_w tau_w^-2


def test_entering_a_bias_as_if_its_sign_were_known_is_wrong_for_two_models():
    """+1 and -1 cancel on paper; two unknown biases never do."""
    known = SelectionProblem(
        np.ones((4, 4)), np.tile([[1.0], [-1.0]], (4, 1, 1)), np.zeros((4, 2, 1)), [0, 0]
    )
    unknown = replace(known, mean=0 * known.mean)
    Cov, c = persistent_bias([1, 1], known.variance), [0, 1, 0, 1]
    assert known.total_cost(c) == 0 and ms.correlated_cost(unknown, c, Cov) == 8


def test_on_the_textbook_plant_the_best_single_model_costs_173_percent():
    """Shares b_w of models with biases tau_w^2 cost sum_w tau_w^2 b_w'Psi b_w, sum_w b_w = 1.

    The least over all fractions, whatever Psi is, is that of resistors in parallel,
    1'Psi 1 / sum_w tau_w^-2, at constant b_w ~ tau_w^-2; a single model costs tau_w^2 1'Psi 1.
    """
    H, W = 50, 3
    tau2, zero = 0.49 ** np.arange(W), np.zeros((H, W, 1))
    Psi = ms.psi(landing.preset("textbook", H).task, "open_loop")
    problem = SelectionProblem(Psi, zero, zero, np.zeros(W))
    Cov = persistent_bias(tau2, zero)
    schedule = ms.round_and_swap(ms.correlated_problem(problem, Cov))
    single = ms.correlated_cost(problem, [[w] * H for w in range(W)], Cov)
    np.testing.assert_allclose(single, tau2 * Psi.sum(), rtol=1e-12)
    assert schedule.gap < 2e-3 and len(set(schedule.choices)) == W
    most = tau2.min() * (1 / tau2).sum()
    assert 1.72 < single.min() / schedule.cost <= most == pytest.approx(1.7301, abs=1e-4)


def test_on_the_textbook_plant_the_schedule_for_independent_errors_costs_twice_as_much():
    H, W = 50, 3
    Psi = ms.psi(landing.preset("textbook", H).task, "open_loop")
    tau2, white = 2.25 * 0.49 ** np.arange(W), np.tile(0.49 ** np.arange(W)[:, None], (H, 1, 1))
    price = 0.06 * white[0].max() * Psi.trace() * (np.arange(W) / 2) ** 1.5
    believed = SelectionProblem(Psi, 0 * white, white + tau2[:, None], price)
    Cov = persistent_bias(tau2, white)
    best = ms.round_and_swap(ms.correlated_problem(believed, Cov))
    single = ms.correlated_cost(believed, [[w] * H for w in range(W)], Cov).min()
    paid = ms.correlated_cost(believed, ms.solve(believed).choices, Cov)
    assert best.gap < 2e-3 and 1.57 < single / best.cost < 1.71 and 2.1 < paid / best.cost < 6.8
