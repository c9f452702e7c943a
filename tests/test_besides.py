"""What models do besides erring: they give nothing, answer late, err in several ways at once."""

import numpy as np
import pytest
from scipy.signal import cont2discrete

import modelselect as ms
import perception
from modelselect import ControlTask, SelectionProblem, psi
from modelselect_parts import kernels
from perception import (
    Kernel,
    PerceptionSuite,
    Residuals,
    bootstrap_errors,
    fit_suite,
    guard_suite,
    measured_latency,
    read_residuals,
    sample_errors,
    with_dropouts,
    with_latency,
    write_residuals,
)


def a_suite(p=2, H=3, seed=0, **more):
    rng = np.random.default_rng(seed)
    mean, variance = rng.normal(size=(H, 2, p)), rng.uniform(0.2, 1, (H, 2, p))
    return PerceptionSuite(["small", "large"], mean, variance, [1.0, 4.0], **more)


def moments(e):
    """Mean and covariance (H, W, p, p) of draws (N, H, W, p), and their standard errors."""
    N, d = len(e), e - e.mean(axis=0)
    products = d[..., None] * d[..., None, :]
    spread = products.std(axis=0) / np.sqrt(N)
    return e.mean(axis=0), e.std(axis=0) / np.sqrt(N), products.mean(axis=0), spread


def near(found, mean, error):
    return (np.abs(found - mean) <= 5 * error + 1e-12).all()


# ------------------------------------------------------------------------------------- dropouts


@pytest.mark.parametrize("p", [1, 2])
def test_dropouts_have_the_moments_of_errors_that_are_dropped_by_hand(p):
    suite, rng, N = a_suite(p), np.random.default_rng(1), 40_000
    q = np.array([0.3, 0.1])
    prior = (np.full(p, 2.0), np.full(p, 0.5))
    e = sample_errors(suite, N, rng)
    fallback = prior[0] + np.sqrt(prior[1]) * rng.standard_normal(e.shape)
    e = np.where(rng.random(e.shape[:3])[..., None] < q[:, None], fallback, e)
    dropped = with_dropouts(suite, q, prior)
    mean, error, covariance, spread = moments(e)
    full = dropped.variance if p > 1 else dropped.variance[..., None]
    assert near(dropped.mean, mean, error) and near(full, covariance, spread)
    assert dropped.variance.ndim == (4 if p > 1 else 3)
    np.testing.assert_array_equal(dropped.cost, suite.cost)


def test_a_model_that_takes_over_is_paid_for():
    suite = a_suite()
    dropped = with_dropouts(suite, [0.25, 0], "large")
    np.testing.assert_allclose(dropped.cost, [1 + 0.25 * 4, 4])
    np.testing.assert_allclose(
        dropped.mean[:, 0], 0.75 * suite.mean[:, 0] + 0.25 * suite.mean[:, 1]
    )
    np.testing.assert_allclose(dropped.mean[:, 1], suite.mean[:, 1])
    always = with_dropouts(suite, 1, "large")
    np.testing.assert_allclose(always.mean[:, 0], suite.mean[:, 1])
    never = with_dropouts(suite, 0, "large")
    np.testing.assert_allclose(np.einsum("twii->twi", never.variance), suite.variance)
    np.testing.assert_array_equal(never.cost, suite.cost)


def test_dropouts_in_three_lines():
    problem = SelectionProblem.from_suite(np.eye(6), with_dropouts(a_suite(), 0.2, "large"))
    assert problem.variance.shape == (3, 2, 2, 2)
    assert ms.solve(problem).is_optimal


# -------------------------------------------------------------------------------------- latency


def test_an_estimate_that_is_late_errs_by_what_the_input_walked():
    """Simulated: s walks, a picture of s_{t-delta} is used at t."""
    rng, N, H = np.random.default_rng(2), 40_000, 4
    suite, v, drift = a_suite(1, H), 0.3, 0.5
    steps = drift + np.sqrt(v) * rng.standard_normal((N, 3 + H))
    s = np.cumsum(steps, axis=1)
    now = np.arange(3, 3 + H)
    delay = np.array([1, 3])
    e = sample_errors(suite, N, rng)[..., 0]
    late = np.stack([e[:, :, w] + s[:, now - d] - s[:, now] for w, d in enumerate(delay)], axis=2)
    found = with_latency(suite, delay, [v], [drift])
    mean, error, covariance, spread = moments(late[..., None])
    assert near(found.mean, mean, error) and near(found.variance[..., None], covariance, spread)
    same = with_latency(suite, 0, [v], [drift])
    np.testing.assert_array_equal(same.variance, suite.variance)
    full = with_latency(a_suite(2), delay, np.array([[[1, 0.5], [0.5, 1]]] * 3))
    np.testing.assert_allclose(full.variance[0, 1, 0, 1], 3 * 0.5)


def test_latency_moves_the_choice_to_a_model_that_answers_in_time():
    suite = PerceptionSuite(["fast", "exact"], np.zeros((3, 2, 1)), [[[0.4], [0.1]]] * 3, [0, 0])
    here = ms.solve(SelectionProblem.from_suite(np.eye(3), suite))
    late = ms.solve(SelectionProblem.from_suite(np.eye(3), with_latency(suite, [0, 2], [0.5])))
    assert here.choices.tolist() == [1, 1, 1] and late.choices.tolist() == [0, 0, 0]


def test_measured_latencies_are_prices_that_grow_faster_than_the_models_number():
    for table, models in (("efficientnet-i7-12700H", 8), ("resnet-jetson-nano", 5)):
        price = measured_latency(table)
        assert price.shape == (models,) and (np.diff(price) > 0).all()
        assert price[-1] - price[-2] > 2 * (price[1] - price[0])
    assert measured_latency("efficientnet-i7-12700H")[-1] == 465.8
    suite = a_suite()
    problem = SelectionProblem.from_suite(
        np.eye(6), suite, model_cost=measured_latency("resnet-jetson-nano")[:2], budget=40.0
    )
    assert problem.model_cost.tolist() == [11.4, 20.2] and problem.budget == 40


# --------------------------------------------------------------------- several variables, p = 2


def world(N, seed, W=2):
    """Residuals (N,) of ranges and bearings whose moments are known; and the moments."""
    rng = np.random.default_rng(seed)
    model, distance = rng.integers(0, W, N), rng.uniform(1, 5, N)
    angle = rng.uniform(-1, 1, N)
    z = rng.standard_normal((N, 2))
    mean, deviation = truth(model, distance, angle)
    correlated = np.stack([z[:, 0], 0.6 * z[:, 0] + 0.8 * z[:, 1]], axis=1)
    names = ["near", "far"][:W]
    where = np.stack([distance, angle], axis=1)
    given = (names, model, where, mean + deviation * correlated)
    return Residuals(*given, ["range", "bearing"], ["residual_x", "residual_y"])


def truth(model, distance, angle):
    """Biases in proportion to the distance, and to the bearing; spreads to the distance."""
    bias = np.stack([0.1 * distance * (1 + model), 0.2 * angle * distance], axis=-1)
    return bias, np.stack([0.05 * distance, 0.03 * distance * (1 + model)], axis=-1)


KERNEL = Kernel(0.2, log=["range"], relative="range")


def test_a_kernel_finds_the_moments_of_a_world_that_is_known():
    path = {"range": np.linspace(4.5, 1.5, 6), "bearing": np.linspace(-0.6, 0.6, 6)}
    suite = fit_suite(world(20_000, 0), path, [1, 2], kernel=KERNEL)
    for w in (0, 1):
        mean, deviation = truth(w, path["range"], path["bearing"])
        error = suite.standard_error[:, w]
        smoothing = 0.02 * path["range"][:, None]  # what a width mixes of a bias that varies
        assert (np.abs(suite.mean[:, w] - mean) <= 4 * error + smoothing).all()
        found = np.sqrt(np.einsum("tii->ti", suite.variance[:, w]))
        mixed = 0.2 * 0.2 * np.sqrt(1 / 3) * path["range"]  # slope, width, deviation of bearings
        deviation[:, 1] = np.hypot(deviation[:, 1], mixed)
        luck = 4 / np.sqrt(2 * suite.sample_size[:, w, None])
        assert (np.abs(found / deviation - 1) <= luck).all()
        correlation = suite.variance[:, w, 0, 1] / found.prod(axis=1)
        assert (correlation > 0.35).all() and (correlation < 0.75).all()
    assert suite.sample_size.min() > 100


def test_a_kernel_is_a_plain_weighted_mean():
    residuals = world(60, 1, W=1)
    path = {"range": [2.0, 3.0], "bearing": [0.1, -0.1]}
    suite = fit_suite(residuals, path, [1], kernel=Kernel(0.7))
    z = residuals.altitude / residuals.altitude.std(axis=0)
    for t in (0, 1):
        here = np.array([path["range"][t], path["bearing"][t]]) / residuals.altitude.std(axis=0)
        k = np.exp(-((z - here) ** 2).sum(axis=1) / 2 / 0.7**2)
        a = k / k.sum()
        mean = sum(x * r for x, r in zip(a, residuals.residual, strict=True))
        np.testing.assert_allclose(suite.mean[t, 0], mean)
        d = residuals.residual - mean
        S = sum(x * np.outer(y, y) for x, y in zip(a, d, strict=True)) / (1 - (a**2).sum())
        np.testing.assert_allclose(suite.variance[t, 0], S)
        assert suite.sample_size[t, 0] == int(1 / (a**2).sum())


@pytest.mark.parametrize("most", [1, 130])
def test_a_kernel_finds_the_same_in_however_many_parts_it_looks(most, monkeypatch):
    """Weights at a time: those of one step, or of two with some 60 looks of a model."""
    residuals, kernel = world(120, 1), Kernel(0.7, log=["range"], relative="range")
    path = {"range": np.linspace(2, 4, 5), "bearing": np.zeros(5)}
    whole = fit_suite(residuals, path, [1, 2], kernel=kernel)
    monkeypatch.setattr(kernels, "MOST_WEIGHTS", most)
    parts = fit_suite(residuals, path, [1, 2], kernel=kernel)
    for field in ("mean", "variance", "sample_size"):
        np.testing.assert_allclose(getattr(parts, field), getattr(whole, field), rtol=1e-12)
    with pytest.raises(ValueError, match="of near near range 90, bearing 0, found"):
        fit_suite(residuals, path | {"range": [2, 3, 3, 90, 4]}, [1, 2], kernel=kernel)


def test_draws_have_the_moments_of_the_suite_they_belong_to():
    residuals = world(400, 3)
    path = {"range": [2.0, 4.0], "bearing": [0.3, -0.3]}
    suite = fit_suite(residuals, path, [1, 2], kernel=KERNEL)
    drawn = bootstrap_errors(residuals, path, 20_000, np.random.default_rng(0), kernel=KERNEL)
    mean, error, covariance, spread = moments(drawn)
    assert near(suite.mean, mean, error)
    n = suite.sample_size[..., None, None]
    assert (
        np.abs(suite.variance * (n - 1) / n - covariance) <= 5 * spread + suite.variance.max() / n
    ).all()


def test_bins_over_one_variable_hold_several_components():
    residuals, path = world(2000, 4), {"range": np.array([1.5, 3.0, 4.5])}
    suite = fit_suite(residuals, path, [1, 2], bins=4)
    cell = np.digitize(residuals.altitude[:, 0], np.linspace(1.5, 4.5, 5))
    used = (cell == 3) & (residuals.model == 1)  # the bin from 3 to 3.75
    np.testing.assert_allclose(suite.mean[1, 1], residuals.residual[used].mean(axis=0))
    np.testing.assert_allclose(suite.variance[1, 1], np.cov(residuals.residual[used].T))
    drawn = bootstrap_errors(residuals, path, 3, np.random.default_rng(0), bins=4)
    assert drawn.shape == (3, 3, 2, 2)
    assert (drawn[:, 1, 1, None] == residuals.residual[used]).all(axis=-1).any(axis=-1).all()
    guarded = guard_suite(suite)
    assert (np.abs(guarded.mean) > np.abs(suite.mean)).all()
    ratio = guarded.variance / suite.variance
    np.testing.assert_allclose(ratio, ratio[..., :1, :1] + 0 * ratio)
    assert ratio.min() > 1
    assert SelectionProblem.from_suite(np.eye(6), guarded).variance.ndim == 4


def test_a_file_of_several_columns_comes_back_to_the_last_digit(tmp_path):
    residuals, file = world(20, 5), tmp_path / "residuals.csv"
    write_residuals(file, residuals)
    assert file.read_text().splitlines()[0] == "model,range,bearing,residual_x,residual_y"
    again = read_residuals(file, ["near", "far"])
    np.testing.assert_array_equal(again.altitude, residuals.altitude)
    np.testing.assert_array_equal(again.residual, residuals.residual)
    assert again.variables == ("range", "bearing")


@pytest.mark.parametrize(
    "header", ["model,residual", "range,model,residual", "model,range,residual,bearing", "model"]
)
def test_a_header_that_could_be_misread_is_refused(tmp_path, header):
    file = tmp_path / "residuals.csv"
    file.write_text(f"{header}\na,1,2,3\n")
    with pytest.raises(ValueError, match="line 1: expected the header"):
        read_residuals(file)


def test_what_a_kernel_cannot_do_is_said():
    residuals = world(50, 6)
    path = {"range": [2.0], "bearing": [0.0]}
    for given, complaint in (
        ((residuals, [2.0], [1, 2]), "^trajectory: expected a dictionary"),
        ((residuals, {"tilt": [2.0]}, [1, 2]), "^trajectory: expected one of range, bearing"),
        ((residuals, path, [1, 2]), "^kernel: expected one for range, bearing"),
    ):
        with pytest.raises(ValueError, match=complaint):
            fit_suite(*given)
    for kernel, complaint in (
        (Kernel(1e-3), "^residuals: expected 2 or more of near near range 2"),
        (Kernel(log=["bearing"]), "^kernel: expected bearing > 0"),
        (Kernel(relative="tilt"), "^kernel.relative: expected one of range, bearing"),
    ):
        with pytest.raises(ValueError, match=complaint):
            fit_suite(residuals, path, [1, 2], kernel=kernel)


# ---------------------------------------------------------------------------------- end to end


def a_rover(H=40, dt=0.1, speed=0.5):
    """A two-wheeled robot that follows a straight line: state (along, sideways, heading)."""
    A = np.array([[0, 0, 0], [0, 0, speed], [0, 0, 0]])
    B, C = np.array([[1, 0], [0, 0], [0, 1]]), np.array([[1, 0], [0, 1], [0, 0]])
    A, both, *_ = cont2discrete((A, np.hstack([B, C]), np.eye(3), np.zeros((3, 4))), dt)
    C = np.array([[1.0, 0], [0, 1], [0, 0]])  # the tag tells both positions
    return ControlTask(A, both[:, :2], C, np.diag([1, 4, 0.1]), 0.1 * np.eye(2), H)


def test_a_rover_with_tags_pays_what_was_predicted():
    """Residuals of two variables and p = 2, dropouts, schedule, flights on errors drawn anew."""
    task, rng, N = a_rover(), np.random.default_rng(0), 1500
    H = task.horizon
    path = {"range": np.linspace(4.5, 1.2, H), "bearing": np.linspace(-0.5, 0.5, H)}
    residuals, q = world(3000, 7), np.array([0.2, 0.05])
    suite = fit_suite(residuals, path, [0.1, 0.0], kernel=KERNEL)
    prior = ([0.0, 0.0], [0.04, 0.04])
    problem = SelectionProblem.from_suite(psi(task, "measurement"), with_dropouts(suite, q, prior))
    schedule = ms.solve(problem)
    assert schedule.is_optimal and len(set(schedule.choices)) == 2
    errors = bootstrap_errors(residuals, path, N, rng, kernel=KERNEL)
    free = 0.2 * rng.standard_normal(errors.shape)
    errors = np.where(rng.random((N, H, 2))[..., None] < q[:, None], free, errors)
    e = errors[:, np.arange(H), schedule.choices]
    states, controls = ms.run_controller(task, np.zeros(3), 0 * e, e, "measurement")
    flown = ms.control_cost(task, states, controls)
    half = 2.6 * flown.std() / np.sqrt(N)
    assert half < 0.03 * flown.mean()
    predicted = float(problem.control_term(schedule.choices))
    assert abs(flown.mean() - predicted) <= half + 0.02 * predicted  # (n - 1) / n of its variance
    alone = SelectionProblem.from_suite(problem.psi, suite)
    assert abs(flown.mean() - alone.control_term(schedule.choices)) > 3 * half


def an_arm(H=60, dt=0.05):
    """Two joints of 1 kg m^2 and 0.3 kg m^2 that carry loads; s is the load at the hand, in N m."""
    inertia = np.array([[1.3, 0.3], [0.3, 0.3]])
    A = np.block([[np.zeros((2, 2)), np.eye(2)], [np.zeros((2, 2)), -0.2 * np.eye(2)]])
    B = np.vstack([np.zeros((2, 2)), np.linalg.inv(inertia)])
    A, both, *_ = cont2discrete((A, np.hstack([B, B[:, 1:]]), np.eye(4), np.zeros((4, 3))), dt)
    return ControlTask(A, both[:, :2], both[:, 2:], np.diag([20, 20, 1, 1]), 0.05 * np.eye(2), H)


def test_an_arm_with_a_forecast_of_its_load_pays_what_was_predicted():
    """It swings along a reference under gravity, while a camera weighs what comes on the belt."""
    task, rng, N = an_arm(), np.random.default_rng(3), 1500
    H = task.horizon
    swing = np.sin(np.linspace(0, np.pi, H + 1))
    reference = np.stack([swing, 0.5 * swing, 0 * swing, 0 * swing], axis=1)
    gravity = np.tile(-0.1 * task.B[:, 0], (H, 1))
    loads = 0.5 + 0.2 * rng.standard_normal((H, 1))
    suite = perception.gaussian_suite(
        lambda w, t: 0.3 * (-0.6) ** w + 0 * t, lambda w, t: 0.3 * 0.6**w + 0 * t, [0, 0.02, 0.03],
        at=np.arange(H),
    )  # fmt: skip
    load = 0.002 * (1 - np.eye(3))
    problem = SelectionProblem.from_suite(psi(task, "preview"), suite, switch_cost=load)
    schedule = ms.solve(problem)
    assert schedule.is_optimal and len(set(schedule.choices)) > 1
    e = sample_errors(suite, N, rng)[:, np.arange(H), schedule.choices]
    known = {"reference": reference, "disturbance": gravity}
    flown = []
    for perceived in (loads + e, np.broadcast_to(loads, e.shape)):
        s = np.broadcast_to(loads, e.shape)
        states, controls = ms.run_controller(task, np.zeros(4), s, perceived, "preview", **known)
        flown.append(ms.control_cost(task, states - reference, controls))
    regret = flown[0] - flown[1]
    half = 2.6 * regret.std() / np.sqrt(N)
    predicted = float(problem.control_term(schedule.choices))
    assert half < 0.05 * predicted
    assert abs(regret.mean() - predicted) <= half
    alone = ms.stepwise_cost(problem)[np.arange(H), schedule.choices].sum()  # no coupling
    assert abs(regret.mean() + problem.perception_term(schedule.choices) - alone) > 3 * half


def test_a_problem_of_a_suite_takes_all_that_a_problem_takes():
    suite = a_suite()
    problem = SelectionProblem.from_suite(np.eye(6), suite, alpha=2.0, budget=9.0, initial_model=1)
    by_hand = SelectionProblem(
        np.eye(6), suite.mean, suite.variance, suite.cost, 2.0, budget=9.0, initial_model=1
    )
    assert problem.to_json() == by_hand.to_json()
    with pytest.raises(TypeError):
        SelectionProblem.from_suite(np.eye(6), suite, colour="red")
    assert perception.PerceptionSuite is PerceptionSuite
