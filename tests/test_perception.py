"""Error models (`eq:perModelExp`, `eq:perModelVar`) against formulas, loops and their own moments.

Random checks allow six standard errors, which a normal number exceeds once in 5e8 draws.
"""

import math
import pickle
import subprocess
import sys
from copy import deepcopy
from dataclasses import FrozenInstanceError, replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import perception
from modelselect import SelectionProblem
from perception import (
    EFFICIENTNET,
    PerceptionSuite,
    Residuals,
    fit_suite,
    gaussian_suite,
    published_suite,
    read_residuals,
    sample_errors,
    textbook_suite,
    write_residuals,
)

SIX = 6.0
SEEDS = st.integers(0, 2**32 - 1)
NAMES = st.lists(
    st.text(min_size=1, max_size=5).filter(
        lambda n: n.isprintable() and n == n.strip() and n[0] != "#"
    ),
    min_size=1,
    max_size=4,
    unique=True,
)
FINITE = st.floats(allow_nan=False, allow_infinity=False)


def generator(seed=0):
    return np.random.default_rng(seed)


SHAPE = "mean: expected shape (H, W, p) ="


def refuses(start, function, *arguments, **options):
    """Whether the call raises ValueError with one line that starts like this."""
    with pytest.raises(ValueError) as caught:
        function(*arguments, **options)
    message = str(caught.value)
    assert message.startswith(start)
    assert "\n" not in message
    return True


def a_suite(**changes):
    """A measured suite with H = 2, W = 3, p = 1."""
    fields = {
        "names": ("small", "middle", "large"),
        "mean": np.arange(6.0).reshape(2, 3, 1) - 2,
        "variance": np.arange(6.0).reshape(2, 3, 1),
        "cost": [1, 2, 4],
        "sample_size": [[7, 8, 9], [2, 3, 4]],
        "standard_error": np.full((2, 3, 1), 0.5),
    }
    return PerceptionSuite(**(fields | changes))


@st.composite
def suites(draw):
    """Suites with vector, full or singular within-step covariance, some entries without noise."""
    H, W, p = (draw(st.integers(1, top)) for top in (3, 3, 3))
    rank, full = draw(st.integers(0, p)), draw(st.booleans())
    rng = generator(draw(SEEDS))
    root = rng.normal(size=(H, W, p, rank)) * 10.0 ** draw(st.integers(-6, 6))
    variance = root @ np.swapaxes(root, -1, -2)
    if not full:
        variance = np.diagonal(variance, axis1=-2, axis2=-1)
    names = [f"m{w}" for w in range(W)]
    return PerceptionSuite(names, rng.normal(size=(H, W, p)), variance, np.ones(W))


# ----------------------------------------------------------------------------------- the suite


def test_a_suite_holds_what_it_was_given():
    suite = a_suite()
    assert suite.names == ("small", "middle", "large")
    np.testing.assert_array_equal(suite.mean[1, :, 0], [1, 2, 3])
    np.testing.assert_array_equal(suite.variance[1, :, 0], [3, 4, 5])
    np.testing.assert_array_equal(suite.cost, [1, 2, 4])
    np.testing.assert_array_equal(suite.sample_size, [[7, 8, 9], [2, 3, 4]])
    assert suite.sample_size.dtype == np.intp
    np.testing.assert_array_equal(suite.standard_error, np.full((2, 3, 1), 0.5))
    assert suite != a_suite()  # suites are told apart by identity, and can be keys
    assert {suite: 1}[suite] == 1
    plain = a_suite(sample_size=None, standard_error=None)
    assert plain.sample_size is None
    assert plain.standard_error is None


@pytest.mark.parametrize("field", ["mean", "variance", "cost", "sample_size", "standard_error"])
def test_a_suite_is_a_frozen_copy(field):
    given_array = np.array(getattr(a_suite(), field))
    suite = a_suite(**{field: given_array})
    held = getattr(suite, field)
    assert not np.shares_memory(held, given_array)
    with pytest.raises(ValueError, match="read-only"):
        held[...] = 0
    with pytest.raises(FrozenInstanceError):
        setattr(suite, field, given_array)


@pytest.mark.parametrize(
    ("argument", "value", "start"),
    [
        ("names", "abc", "names: expected distinct, non-blank strings, found 'abc'"),
        ("names", 5, "names: expected distinct, non-blank strings, found 5"),
        ("names", (), "names: expected distinct"),
        ("names", ("a", "b", "a"), "names: expected distinct"),
        ("names", ("a", "", "b"), "names: expected distinct"),
        ("names", ("a", " b", "c"), "names: expected distinct"),
        ("names", ("a", "b\nb", "c"), "names: expected distinct"),
        ("names", ("a", 1, "c"), "names: expected distinct"),
        (
            "names",
            ("a", "b"),
            f"{SHAPE} (H, 2, p) (W = 2 as of names), found (2, 3, 1)",
        ),
        (
            "mean",
            np.zeros((3, 2, 1)),
            f"{SHAPE} (H, 3, p) (W = 3 as of names), found (3, 2, 1",
        ),
        (
            "mean",
            np.zeros((2, 3)),
            f"{SHAPE} (H, 3, p) (W = 3 as of names), found (2, 3)",
        ),
        ("mean", np.zeros((0, 3, 1)), "mean: expected shape"),
        ("mean", np.full((2, 3, 1), np.nan), "mean: expected finite numbers"),
        ("mean", [[[1], [2]], [[3]]], "mean: expected a rectangular array"),
        ("variance", np.zeros((3, 2, 1)), "variance: expected shape (H, W, p) = (2, 3, 1), found"),
        ("variance", np.zeros((2, 3, 1, 2)), "variance: expected shape (H, W, p, p) = (2, 3, 1, 1"),
        ("variance", [[[1], [2]], [[3]]], "variance: expected a rectangular array"),
        ("variance", np.full((2, 3, 1), np.inf), "variance: expected finite numbers"),
        ("variance", np.full((2, 3, 1), -0.5), "variance: expected numbers >= 0, found -0.5"),
        (
            "variance",
            np.full((2, 3, 1, 1), -1),
            "variance: expected a positive semidefinite matrix",
        ),
        ("cost", [1, 2], "cost: expected shape (W,) = (3,), found (2,)"),
        ("cost", 1.0, "cost: expected shape (W,) = (3,), found ()"),
        ("cost", np.ones((3, 2)), "cost: expected shape (H, W) = (2, 3), found (3, 2)"),
        ("cost", [[1, 2], [3]], "cost: expected a rectangular array"),
        ("names", ("a", "#b", "c"), "names: expected distinct, non-blank strings"),
        ("cost", [1, 2, np.nan], "cost: expected finite or infinite numbers, found nan at model 2"),
        ("cost", [1, 2, -np.inf], "cost: expected a finite cost at every step, found -inf"),
        ("cost", [[1, 2, 3], [np.inf] * 3], "cost: expected a finite cost at every step"),
        ("cost", ["1", "2", "3"], "cost: expected real numbers"),
        ("sample_size", [7, 8, 9], "sample_size: expected shape (H, W) = (2, 3), found (3,)"),
        ("sample_size", np.full((2, 3), 1.5), "sample_size: expected integers from 0 to 9007"),
        (
            "sample_size",
            np.full((2, 3), -1),
            "sample_size: expected integers from 0 to 9007199254740992, found -1",
        ),
        ("sample_size", np.full((2, 3), 1e300), "sample_size: expected integers from 0"),
        ("standard_error", np.ones((2, 3)), "standard_error: expected shape (H, W, p) = (2, 3, 1)"),
        (
            "standard_error",
            np.full((2, 3, 1), -1),
            "standard_error: expected numbers >= 0, found -",
        ),
    ],
)
def test_a_suite_refuses(argument, value, start):
    assert refuses(start, a_suite, **{argument: value})


@pytest.mark.parametrize("copy", [deepcopy, lambda thing: pickle.loads(pickle.dumps(thing))])
@pytest.mark.parametrize("make", [lambda: a_suite(), lambda: some_residuals()])
def test_copies_are_checked_and_frozen_again(make, copy):
    original = make()
    twin = copy(original)
    assert twin is not original and vars(twin).keys() == vars(original).keys()
    for field, value in vars(original).items():
        held = getattr(twin, field)
        np.testing.assert_array_equal(held, value)
        if isinstance(value, np.ndarray):
            assert held.dtype == value.dtype
            for array in (value, held):
                with pytest.raises(ValueError):
                    array.flags.writeable = True


def test_another_price_copies_no_table():
    suite = a_suite()
    dear = replace(suite, cost=2 * suite.cost)
    for field in ("mean", "variance", "sample_size", "standard_error"):
        assert getattr(dear, field) is getattr(suite, field)
    residuals = some_residuals()
    assert replace(residuals, residual=-residuals.residual).model is residuals.model
    with pytest.raises(ValueError, match="model: expected integers from 0 to 0, found 1"):
        replace(residuals, names=["a"])


def test_zero_variance_unavailable_models_and_another_price_are_fine():
    assert not a_suite(variance=np.zeros((2, 3, 1, 1))).variance.any()
    assert a_suite(cost=[1, np.inf, 2]).cost[1] == np.inf
    per_step = replace(a_suite(), cost=[[1, np.inf, np.inf], [np.inf, np.inf, 0]])
    assert per_step.cost.shape == (2, 3)
    assert per_step.mean is not a_suite().mean


@given(suites())
def test_a_suite_poses_a_selection_problem(suite):
    H, W, p = suite.mean.shape
    problem = SelectionProblem(np.eye(H * p), suite.mean, suite.variance, suite.cost)
    trace = np.einsum("twii->tw", suite.variance) if suite.variance.ndim == 4 else suite.variance
    spread = trace if suite.variance.ndim == 4 else trace.sum(-1)
    expected = (suite.mean[:, W - 1] ** 2).sum() + spread[:, W - 1].sum() + H
    np.testing.assert_allclose(problem.total_cost(np.full(H, W - 1)), expected)


@given(suites(), st.data())
def test_picked_models_keep_their_entries(suite, data):
    H, W, _ = suite.mean.shape
    order = data.draw(st.lists(st.integers(0, W - 1), min_size=1, unique=True))
    rng = generator(3)
    suite = replace(
        suite,
        cost=data.draw(st.sampled_from([rng.random(W), rng.random((H, W))])),
        sample_size=data.draw(st.sampled_from([None, rng.integers(1, 9, (H, W))])),
        standard_error=data.draw(st.sampled_from([None, rng.random(suite.mean.shape)])),
    )
    picked = suite.pick([data.draw(st.sampled_from([w, suite.names[w]])) for w in order])
    assert picked.names == tuple(suite.names[w] for w in order)
    for new, old in enumerate(order):
        np.testing.assert_array_equal(picked.cost[..., new], suite.cost[..., old])
        for field in ("mean", "variance", "sample_size", "standard_error"):
            table = getattr(suite, field)
            if table is None:
                assert getattr(picked, field) is None
            else:
                np.testing.assert_array_equal(getattr(picked, field)[:, new], table[:, old])


@pytest.mark.parametrize(
    ("models", "start"),
    [
        (["huge"], "models: expected names among small, middle, large, or indices, found 'huge'"),
        ([0, 3], "models: expected names among small, middle, large, or indices, found 3"),
        ([-1], "models: expected names among small, middle, large, or indices, found -1"),
        ([0, "small"], "models: expected different names among small, middle, large, or indices"),
        ([], "models: expected different names among small, middle, large, or indices, found []"),
        (0, "models: expected different names among small, middle, large, or indices, found 0"),
    ],
)
def test_pick_refuses(models, start):
    assert refuses(start, a_suite().pick, models)


def test_pick_must_leave_a_model_at_every_step():
    suite = a_suite(cost=[[1, np.inf, 1], [1, 1, 1]])
    assert refuses("cost: expected a finite cost at every step", suite.pick, ["middle"])


# ------------------------------------------------------------------------------- drawn errors


@given(suites(), SEEDS)
def test_sampled_errors_have_the_moments_of_the_suite(suite, seed):
    """Mean and covariance over all (step, model, component): blocks within a step, 0 elsewhere."""
    trials, (H, W, p) = 2000, suite.mean.shape
    e = sample_errors(suite, trials, generator(seed))
    assert e.shape == (trials, H, W, p)
    blocks = suite.variance if suite.variance.ndim == 4 else suite.variance[..., None] * np.eye(p)
    sigma = np.zeros((H, W, p, H, W, p))
    for t in range(H):
        for w in range(W):
            sigma[t, w, :, t, w] = blocks[t, w]
    sigma = sigma.reshape(H * W * p, H * W * p)
    deviation = (e - suite.mean).reshape(trials, -1)
    v = np.diag(sigma)
    tiny = 1e-7 * np.sqrt(v.max()) + 1e-12  # rounding in a singular covariance's square root
    assert np.all(np.abs(deviation.mean(0)) <= SIX * np.sqrt(v / trials) + tiny)
    # For Gaussians of known mean, var(mean of x_i x_j) = (v_i v_j + sigma_ij^2) / trials.
    allowed = SIX * np.sqrt((np.outer(v, v) + sigma**2) / trials)
    error = np.abs(deviation.T @ deviation / trials - sigma)
    assert np.all(error <= allowed + tiny * (np.sqrt(v.max()) + tiny))


@given(suites(), SEEDS)
def test_diagonal_covariances_and_variances_draw_the_same_errors(suite, seed):
    v = suite.variance if suite.variance.ndim == 3 else np.einsum("twii->twi", suite.variance)
    vector = replace(suite, variance=v)
    full = replace(suite, variance=v[..., None] * np.eye(v.shape[-1]))
    drawn, expected = (sample_errors(s, 5, generator(seed)) for s in (full, vector))
    np.testing.assert_allclose(drawn, expected, rtol=1e-12, atol=1e-12 * np.sqrt(v.max()))


@given(suites(), SEEDS)
def test_errors_of_a_singular_covariance_stay_in_its_range(suite, seed):
    """Two components that are equal up to a factor err alike; no trial breaks the tie."""
    mean = np.repeat(suite.mean[..., :1], 2, axis=-1)
    tied = replace(suite, mean=mean, variance=np.full((*mean.shape, 2), [[1.0, 3.0], [3.0, 9.0]]))
    e = sample_errors(tied, 10, generator(seed)) - mean
    np.testing.assert_allclose(e[..., 1], 3 * e[..., 0], rtol=1e-6, atol=1e-6)
    assert np.abs(e).max() > 0


@pytest.mark.parametrize(
    ("trials", "rng", "start"),
    [
        (0, generator(), "trials: expected an integer >= 1, found 0"),
        (2.5, generator(), "trials: expected an integer >= 1, found 2.5"),
        (3, 0, "rng: expected numpy.random.default_rng(seed), found 0"),
        (3, None, "rng: expected numpy.random.default_rng(seed), found None"),
    ],
)
def test_sample_errors_refuses(trials, rng, start):
    assert refuses(start, sample_errors, a_suite(), trials, rng)


# --------------------------------------------------------------------------- simulated suites

# REFERENCE.md, "Simulated suite": upper ends of the increments from b7 down to b0.
MEAN_INCREMENTS = [0.05, 0.1, 1, 4, 8, 12, 16, 16]
VARIANCE_INCREMENTS = [0.3, 0.06, 0.08, 0.01, 0.02, 0.02, 0.03, 0.03]


@given(st.integers(1, 200), SEEDS)
def test_published_suite_accumulates_bounded_increments_from_b7_down(horizon, seed):
    suite = published_suite(horizon, generator(seed))
    assert suite.names == ("b0", "b1", "b2", "b3", "b4", "b5", "b6", "b7")
    for table, tops in ((suite.mean, MEAN_INCREMENTS), (suite.variance, VARIANCE_INCREMENTS)):
        assert table.shape == (horizon, 8, 1)
        below = np.zeros(horizon)
        for model, top in zip(reversed(range(8)), tops, strict=True):
            increment = table[:, model, 0] - below
            assert np.all((increment >= 0) & (increment <= top * (1 + 1e-12)))
            below = table[:, model, 0]


def test_published_suite_has_the_published_averages():
    """Every increment is U(0, x): mean x/2, variance x^2/12, none correlated with another."""
    suites = [published_suite(500, generator(seed)) for seed in range(40)]
    draws = []
    for field, tops in (("mean", MEAN_INCREMENTS), ("variance", VARIANCE_INCREMENTS)):
        table = np.concatenate([getattr(suite, field)[:, ::-1, 0] for suite in suites])
        increments = np.diff(table, axis=1, prepend=0) / tops
        assert np.all(np.abs(increments.mean(0) - 1 / 2) <= 4 * math.sqrt(1 / 12 / len(table)))
        draws.append(increments)
    draws = np.hstack(draws)
    # For U(0, 1) the fourth central moment is 1/80, so var((u - 1/2)^2) = 1/80 - 1/144 = 1/180.
    spread = ((draws - 1 / 2) ** 2).mean(0)
    assert np.all(np.abs(spread - 1 / 12) <= SIX * math.sqrt(1 / 180 / len(draws)))
    correlation = np.corrcoef(np.hstack([draws[1:], draws[:-1]]), rowvar=False) - np.eye(32)
    assert np.abs(correlation).max() <= SIX / math.sqrt(len(draws) - 1)


@pytest.mark.parametrize("upsilon", [0, 1, 1e10])
def test_published_and_textbook_models_cost_w_upsilon(upsilon):
    for suite in (
        published_suite(3, generator(), upsilon),
        textbook_suite([9.0, 5.0], generator(), upsilon=upsilon),
    ):
        np.testing.assert_array_equal(suite.cost, [w * upsilon for w in range(8)])


def test_the_default_upsilon():
    assert published_suite(1, generator()).cost[1] == 1e14
    assert textbook_suite([1.0], generator()).cost[1] == 1


@pytest.mark.parametrize(
    ("arguments", "start"),
    [
        ((0, generator()), "horizon: expected an integer >= 1, found 0"),
        ((1.5, generator()), "horizon: expected an integer"),
        ((3, 7), "rng: expected numpy.random.default_rng(seed), found 7"),
        ((3, generator(), -1), "upsilon: expected a number >= 0, found -1"),
        ((3, generator(), np.nan), "upsilon: expected finite numbers"),
    ],
)
def test_published_suite_refuses(arguments, start):
    assert refuses(start, published_suite, *arguments)


def bias(w, x):
    return (w - 1) * x


def spread(w, x):
    return (1 + w) / (1 + x)


@given(st.integers(1, 4), st.integers(1, 4), st.sampled_from([None, "xyzt"]))
def test_gaussian_suite_evaluates_its_formulas(horizon, models, letters):
    at = np.arange(1.0, horizon + 1) ** 2
    names = None if letters is None else list(letters[:models])
    suite = gaussian_suite(bias, spread, np.arange(models), at, names=names)
    assert suite.names == tuple(names or [f"b{w}" for w in range(models)])
    np.testing.assert_array_equal(suite.cost, range(models))
    for t in range(horizon):
        for w in range(models):
            assert suite.mean[t, w, 0] == (w - 1) * at[t]
            assert suite.variance[t, w, 0] == pytest.approx(((1 + w) / (1 + at[t])) ** 2, rel=1e-14)


def test_formulas_may_raise_whole_numbers_to_negative_powers():
    suite = gaussian_suite(lambda w, x: 2**-w * x, spread, [1, 2], [1.0])
    np.testing.assert_array_equal(suite.mean[0, :, 0], [1, 0.5])


@given(st.sampled_from(["same", "model", "step"]), SEEDS)
def test_signs_change_no_magnitude(signs, seed):
    options = {"cost": np.ones((50, 40)), "at": np.arange(1.0, 51)}
    plain, signed = (
        gaussian_suite(
            lambda w, x: -1 - w * x,
            lambda w, x: 1 + w * x,
            jitter=(0.1, 0.2),
            signs=s,
            rng=generator(seed),
            **options,
        )
        for s in ("same", signs)
    )
    np.testing.assert_array_equal(np.abs(plain.mean), np.abs(signed.mean))
    np.testing.assert_array_equal(plain.variance, signed.variance)
    negative = signed.mean[..., 0] < 0
    by_model = negative.mean(axis=0)
    if signs == "same":
        assert negative.all()
    elif signs == "model":
        assert set(by_model) == {0.0, 1.0}  # each is missing once in 2^40 draws
    else:
        assert np.all((by_model > 0) & (by_model < 1))  # 50 equal signs: 40 * 2^-49
        assert abs(negative.mean() - 1 / 2) <= SIX * math.sqrt(1 / 4 / negative.size)


def test_jitter_multiplies_by_normal_factors():
    jitter = (0.3, 0.1)
    at = np.linspace(1, 2, 20_000)
    suite = gaussian_suite(
        lambda w, x: x + w, lambda w, x: 2 * x + w, [0, 1], at, jitter=jitter, rng=generator(1)
    )
    x = at[:, None] + [0, 1]
    assert suite.mean.min() < 0 or suite.mean.max() > 2  # not constant
    factors = (suite.mean[..., 0] / x, np.sqrt(suite.variance[..., 0]) / (x + at[:, None]))
    for factor, size in zip(factors, jitter, strict=True):
        z = (factor - 1) / size
        assert np.all(np.abs(z.mean(0)) <= SIX / math.sqrt(len(at)))
        assert np.all(np.abs((z**2).mean(0) - 1) <= SIX * math.sqrt(2 / len(at)))
    columns = np.hstack([np.hstack(factors)[1:], np.hstack(factors)[:-1]])
    correlation = np.corrcoef(columns, rowvar=False) - np.eye(8)
    assert np.abs(correlation).max() <= SIX / math.sqrt(len(at) - 1)


def test_a_jitter_may_be_large_and_one_of_the_two_zero():
    wild = gaussian_suite(bias, spread, [1, 2], [3, 4, 5], jitter=(0, 9), rng=generator())
    plain = gaussian_suite(bias, spread, [1, 2], [3, 4, 5])
    assert wild.variance.min() >= 0
    assert np.all(wild.variance != plain.variance)
    np.testing.assert_array_equal(wild.mean, plain.mean)
    other = gaussian_suite(bias, spread, [1, 2], [3, 4, 5], jitter=(9, 0), rng=generator())
    np.testing.assert_array_equal(other.variance, plain.variance)
    assert np.all(other.mean[:, 0] != plain.mean[:, 0])


@pytest.mark.parametrize(
    ("changes", "start"),
    [
        ({"at": [[1, 2]]}, "at: expected shape (H,) = (H,), found (1, 2)"),
        ({"at": []}, "at: expected shape (H,)"),
        ({"at": [1, np.inf]}, "at: expected finite numbers"),
        ({"cost": 3.0}, "cost: expected shape (..., W) = (..., W), found ()"),
        ({"cost": np.ones((3, 4))}, "cost: expected shape (H, W) = (2, 4), found (3, 4)"),
        ({"cost": [np.inf, np.inf]}, "cost: expected a finite cost"),
        ({"bias": lambda w, x: w}, "bias: expected shape (H, W) = (2, 3), found (3,)"),
        ({"bias": lambda w, x: 1 / (w * x - 3)}, "bias: expected finite numbers"),
        ({"spread": lambda w, x: x}, "spread: expected shape (H, W) = (2, 3), found (2, 1)"),
        ({"spread": lambda w, x: x - w}, "spread: expected numbers >= 0, found -1"),
        (
            {"names": ["a", "b"]},
            f"{SHAPE} (H, 2, p) (W = 2 as of names), found (2, 3, 1)",
        ),
        ({"names": "abc"}, "names: expected distinct"),
        ({"jitter": 0.2}, "jitter: expected shape (2,) = (2,), found ()"),
        ({"jitter": (0.1, -0.2), "rng": generator()}, "jitter: expected numbers >= 0, found -0.2"),
        ({"jitter": (0.1, 0.0)}, "rng: expected numpy.random.default_rng(seed), found None"),
        ({"jitter": (0.0, 0.1)}, "rng: expected"),
        ({"signs": "model"}, "rng: expected"),
        ({"signs": "step", "rng": 5}, "rng: expected numpy.random.default_rng(seed), found 5"),
        ({"signs": "both"}, "signs: expected one of same, model, step, found 'both'"),
    ],
)
def test_gaussian_suite_refuses(changes, start):
    plain = {"bias": bias, "spread": spread, "cost": [0, 1, 2], "at": [1.0, 3.0]}
    with np.errstate(divide="ignore"):
        assert refuses(start, gaussian_suite, **(plain | changes))


@pytest.mark.parametrize("signs", ["same", "model", "step"])
def test_textbook_suite_follows_its_formulas(signs):
    """REFERENCE.md: bias 1.5 * 0.6^w * (0.3 + h/100), sd 2 * 0.65^w * ..., jitter 20% and 10%."""
    h = 100 * np.exp(-np.linspace(0, 3, 4000))
    suite = textbook_suite(h, generator(4), signs)
    assert suite.mean.shape == (4000, 8, 1)
    for w in range(8):
        scale = 0.3 + h / 100
        factors = (
            np.abs(suite.mean[:, w, 0]) / (1.5 * 0.6**w * scale),
            np.sqrt(suite.variance[:, w, 0]) / (2 * 0.65**w * scale),
        )
        for factor, jitter in zip(factors, (0.2, 0.1), strict=True):
            assert abs(factor.mean() - 1) <= SIX * jitter / math.sqrt(len(h))
            assert abs(factor.std() / jitter - 1) <= SIX / math.sqrt(2 * len(h))
    changes = {w: len(set(np.sign(suite.mean[:, w, 0]))) for w in range(8)}
    assert set(changes.values()) == {2 if signs == "step" else 1}


def test_textbook_suite_refuses():
    assert refuses("altitude: expected shape (H,)", textbook_suite, [[1.0]], generator())
    assert refuses(
        "upsilon: expected a number >= 0", textbook_suite, [1.0], generator(), "same", -1
    )
    assert refuses("spread: expected numbers >= 0", textbook_suite, [-50.0], generator())
    assert refuses("rng: expected", textbook_suite, [1.0], None)


@given(SEEDS)
def test_equal_seeds_give_equal_numbers(seed):
    def draw(seed):
        rng = generator(seed)
        published, textbook = published_suite(3, rng), textbook_suite([9.0, 1.0], rng, "step")
        errors = sample_errors(textbook, 4, rng)
        return [published.mean, published.variance, textbook.mean, textbook.variance, errors]

    for first, second, other in zip(draw(seed), draw(seed), draw(seed + 1), strict=True):
        np.testing.assert_array_equal(first, second)
        assert np.any(first != other)


def test_the_efficientnet_table():
    """REFERENCE.md: millions of parameters, billions of FLOPs, top-1 in percent, pixels."""
    rows = [
        ("b0", 5.3, 0.39, 77.1, 224),
        ("b1", 7.8, 0.70, 79.1, 240),
        ("b2", 9.2, 1.0, 80.1, 260),
        ("b3", 12, 1.8, 81.6, 300),
        ("b4", 19, 4.2, 82.9, 380),
        ("b5", 30, 9.9, 83.6, 456),
        ("b6", 43, 19, 84.0, 528),
        ("b7", 66, 37, 84.3, 600),
    ]
    for row, *columns in zip(rows, *EFFICIENTNET, strict=True):
        expected = (row[0], row[1] * 1e6, row[2] * 1e9, row[3], row[4])
        assert columns[0] == expected[0]
        np.testing.assert_allclose(columns[1:], expected[1:], rtol=1e-15)
    assert not any(column.flags.writeable for column in EFFICIENTNET[1:])
    suite = replace(published_suite(2, generator()), cost=EFFICIENTNET.flops)
    np.testing.assert_array_equal(suite.cost, EFFICIENTNET.flops)


# ---------------------------------------------------------------------------- measured suites


def some_residuals(**changes):
    """Five residuals of two models."""
    fields = {
        "names": ("a", "b"),
        "model": [0, 1, 0, 1, 0],
        "altitude": [1.0, 2.0, 3.0, 4.0, 5.0],
        "residual": [0.5, -1.0, 1.5, 0.0, 2.5],
    }
    return Residuals(**(fields | changes))


@pytest.mark.parametrize(
    ("argument", "value", "start"),
    [
        ("names", ("a", "a"), "names: expected distinct"),
        ("model", [0, 1, 0, 1], "model: expected shape (N,) = (5,), found (4,)"),
        ("model", [0, 1, 2, 0, 0], "model: expected integers from 0 to 1, found 2"),
        ("model", [0, -1, 1, 0, 0], "model: expected integers from 0 to 1, found -1"),
        ("model", [0, 0.5, 1, 0, 0], "model: expected integers from 0 to 1, found 0.5"),
        ("altitude", [1.0], "altitude: expected shape (N,) = (5,), found (1,)"),
        ("altitude", [1, 2, 3, 4, np.inf], "altitude: expected finite numbers"),
        ("residual", [1, 2, 3, 4, np.inf], "residual: expected finite numbers"),
        ("residual", [[1, np.nan]] * 5, "residual: expected NaN in all components of a row or n"),
        ("period", 0, "period: expected numbers > 0, found 0"),
        ("period", [1, 2], "period: expected shape (p,) = (1,), found (2,)"),
        ("resolution", -1, "resolution: expected numbers >= 0, found -1"),
        ("residual", [], "residual: expected shape (N,) = (N,), found (0,)"),
    ],
)
def test_residuals_refuse(argument, value, start):
    assert refuses(start, some_residuals, **{argument: value})


@pytest.mark.parametrize("field", ["model", "altitude", "residual"])
def test_residuals_are_frozen_copies(field):
    residuals = some_residuals()
    assert residuals != some_residuals()  # told apart by identity
    with pytest.raises(ValueError, match="read-only"):
        getattr(residuals, field)[0] = 1
    with pytest.raises(FrozenInstanceError):
        setattr(residuals, field, [1])


def plain_edges(bins, trajectory):
    """Return the edges as a list."""
    if not isinstance(bins, int):
        return bins
    low, high = min(trajectory), max(trajectory)
    return [low + i * (high - low) / bins for i in range(bins + 1)]


def plain_cell(residuals, model, altitude, edges):
    """Residuals of a model in the bin of this altitude, found by walking through all of them."""
    for low, high in pairwise(edges):
        inside = [
            r
            for w, h, r in zip(residuals.model, residuals.altitude, residuals.residual, strict=True)
            if w == model and (low <= h < high or h == high == edges[-1])
        ]
        if low <= altitude < high or altitude == high == edges[-1]:
            return inside
    raise AssertionError("the trajectory leaves the edges")


@st.composite
def measurements(draw):
    """Residuals and a trajectory at whole altitudes, which often lie on the edges, and bins."""
    rng, models, count = generator(draw(SEEDS)), draw(st.integers(1, 3)), draw(st.integers(2, 80))
    residuals = Residuals(
        [f"m{w}" for w in range(models)],
        rng.integers(0, models, count),
        rng.integers(-2, 11, count),
        rng.normal(size=count),
    )
    trajectory = [float(h) for h in rng.integers(1, 8, draw(st.integers(0, 4)))] + [0.0, 8.0]
    bins = draw(st.sampled_from([1, 2, 4, 8, [0, 8], [-1, 2, 8.5], [0, 1, 5, 7, 9], [-5, 0, 8]]))
    return residuals, trajectory, bins


@pytest.mark.filterwarnings("ignore:fit_suite:UserWarning")  # of ways that few residuals lie on
@given(measurements())
def test_fit_equals_a_plain_loop(measured):
    """To the last bit: the sums run in the same order."""
    residuals, trajectory, bins = measured
    W, edges = len(residuals.names), plain_edges(bins, trajectory)
    cells = [[plain_cell(residuals, w, h, edges) for w in range(W)] for h in trajectory]
    cost = np.arange(W)
    if any(len(cell) < 2 for row in cells for cell in row):
        assert refuses("residuals: expected 2 or more", fit_suite, *measured[:2], cost, bins=bins)
        return
    suite = fit_suite(residuals, trajectory, cost, bins=bins)
    assert suite.names == residuals.names
    assert suite.mean.shape == suite.standard_error.shape == (len(trajectory), W, 1)
    np.testing.assert_array_equal(suite.cost, cost)
    for t, row in enumerate(cells):
        for w, cell in enumerate(row):
            n, total, squares = len(cell), 0.0, 0.0
            for r in cell:
                total += r
            for r in cell:
                squares += (r - total / n) * (r - total / n)
            assert suite.sample_size[t, w] == n
            assert suite.mean[t, w, 0] == total / n
            assert suite.variance[t, w, 0] == squares / (n - 1)
            assert suite.standard_error[t, w, 0] == math.sqrt(squares / (n - 1) / n)


def test_fit_recovers_the_generator_within_its_standard_errors():
    """320 cells: every z below 6, and sum z^2 within six deviations of its chi-square mean."""
    bins, models, size = 40, 8, 300
    rng = generator(11)
    mean, deviation = rng.normal(size=(bins, models)), rng.uniform(0.5, 2, (bins, models))
    home, model = (k.ravel() for k in np.indices((bins, models, size))[:2])
    altitude = 10 * home + rng.uniform(0, 10, home.size)
    residual = mean[home, model] + deviation[home, model] * rng.normal(size=home.size)
    shuffle = rng.permutation(home.size)
    residuals = Residuals(
        [f"b{w}" for w in range(models)], *(k[shuffle] for k in (model, altitude, residual))
    )
    edges = 10.0 * np.arange(bins + 1)
    trajectory = edges[:-1][::-1] + 3
    suite = fit_suite(residuals, trajectory, np.ones(models), bins=edges)
    z = (suite.mean[..., 0] - mean[::-1]) / suite.standard_error[..., 0]
    assert np.abs(z).max() <= SIX
    assert abs((z**2).sum() - z.size) <= SIX * math.sqrt(2 * z.size)
    ratio = suite.variance[..., 0] / deviation[::-1] ** 2
    assert np.abs(ratio - 1).max() <= SIX * math.sqrt(2 / (size - 1))
    assert abs(ratio.mean() - 1) <= SIX * math.sqrt(2 / (size - 1) / ratio.size)
    assert np.all(suite.sample_size == size)


def test_fit_has_ten_bins_by_default():
    altitude = np.repeat(np.arange(11.0), 2)
    residuals = Residuals(["a"], np.zeros(22), altitude, altitude + np.tile([-0.1, 0.1], 11))
    suite = fit_suite(residuals, np.arange(11.0), [1])
    np.testing.assert_allclose(suite.mean[:, 0, 0], [0, 1, 2, 3, 4, 5, 6, 7, 8, 9.5, 9.5])
    np.testing.assert_array_equal(suite.sample_size[:, 0], [2] * 9 + [4, 4])


def test_bins_off_the_trajectory_need_no_residuals():
    residuals = Residuals(["a"], [0] * 4, [0.5, 0.6, 2.5, 2.6], [1.0, 3.0, 4.0, 6.0])
    suite = fit_suite(residuals, [0.1, 2.9], [1], bins=[0, 1, 2, 3])
    np.testing.assert_array_equal(suite.mean[:, 0, 0], [2, 5])
    np.testing.assert_array_equal(suite.variance[:, 0, 0], [2, 2])


@pytest.mark.parametrize(
    ("changes", "start"),
    [
        ({"trajectory": [[1.0]]}, "trajectory: expected shape (H,) = (H,), found (1, 1)"),
        ({"trajectory": [np.nan]}, "trajectory: expected finite numbers"),
        ({"cost": [1]}, "cost: expected shape (..., W) = (..., 2), found (1,)"),
        ({"cost": np.ones((3, 2))}, "cost: expected shape (H, W) = (2, 2), found (3, 2)"),
        ({"cost": [np.inf, np.inf]}, "cost: expected a finite cost"),
        ({"bins": 0}, "bins: expected an integer >= 1, found 0"),
        ({"bins": 2.5}, "bins: expected an integer >= 1, found 2.5"),
        ({"bins": "two"}, "bins: expected real numbers"),
        ({"bins": None}, "bins: expected real numbers"),
        ({"bins": [[1, 2]]}, "bins: expected shape (edges,) = (edges,), found (1, 2)"),
        ({"bins": [0.0]}, "bins: expected increasing edges"),
        (
            {"bins": [0, 9, 4]},
            "bins: expected increasing edges from 1 or less to 5 or more, found 3",
        ),
        ({"bins": [0, 0, 9]}, "bins: expected increasing edges"),
        (
            {"bins": [1.5, 9]},
            "bins: expected increasing edges from 1 or less to 5 or more, found 2 e",
        ),
        (
            {"bins": [0, 4.5]},
            "bins: expected increasing edges from 1 or less to 5 or more, found 2 e",
        ),
        (
            {"trajectory": [2.0, 2.0]},
            "trajectory: expected several altitudes to make 1 bins of, found 2 at every step",
        ),
        (
            {"bins": 2},
            "residuals: expected 2 or more of a at altitudes 1 to 3, found 1; use fewer bins or",
        ),
        ({"bins": [0, 2, 6]}, "residuals: expected 2 or more of a at altitudes 0 to 2, found 1"),
        (
            {"bins": [0, 1.5, 6], "trajectory": [4.0, 1.0]},
            "residuals: expected 2 or more of a at altitudes 0 to 1.5, found 1",
        ),
    ],
)
def test_fit_suite_refuses(changes, start):
    plain = {"trajectory": [1.0, 5.0], "cost": [1, 2], "bins": 1}
    assert refuses(start, fit_suite, some_residuals(), **(plain | changes))


# ---------------------------------------------------------------------------------- the files


@pytest.mark.filterwarnings("ignore:.*repeat an earlier one")
@given(NAMES, st.data())
def test_residuals_survive_a_file(tmp_path_factory, names, data):
    records = data.draw(
        st.lists(st.tuples(st.integers(0, len(names) - 1), FINITE, FINITE), min_size=1, max_size=9)
    )
    model, altitude, residual = zip(*records, strict=True)
    residuals = Residuals(names, model, altitude, residual)
    path = tmp_path_factory.mktemp("residuals") / "residuals.csv"
    write_residuals(path, residuals)
    back = read_residuals(path, names)
    assert back.names == residuals.names
    for field in ("model", "altitude", "residual"):
        np.testing.assert_array_equal(getattr(back, field), getattr(residuals, field))
    bare = read_residuals(str(path))
    assert bare.names == tuple(dict.fromkeys(names[w] for w in model))
    assert [bare.names[w] for w in bare.model] == [names[w] for w in model]
    np.testing.assert_array_equal(bare.residual, residuals.residual)


def test_the_file_format(tmp_path):
    path = tmp_path / "residuals.csv"
    write_residuals(path, some_residuals(names=("a", "b, wide")))
    lines = path.read_bytes().decode().splitlines()
    assert lines[:3] == ["model,altitude,residual", "a,1.0,0.5", '"b, wide",2.0,-1.0']


@pytest.mark.parametrize(
    "text",
    [
        "model,altitude,residual\na,1,2\nb,3,4\n",
        "\ufeffmodel,altitude,residual\r\na,1,2\r\nb,3,4",
        "\n model , altitude, residual\n\n  a ,1.0 ,  2\n,,\nb,3e0,+4\n\n",
        'model,"altitude",residual\n"a",1,"2"\nb,3,4\n',
    ],
)
def test_blanks_quotes_and_line_ends_do_no_harm(tmp_path, text):
    path = tmp_path / "residuals.csv"
    path.write_bytes(text.encode())
    residuals = read_residuals(path)
    assert residuals.names == ("a", "b")
    np.testing.assert_array_equal(residuals.model, [0, 1])
    np.testing.assert_array_equal(residuals.altitude, [1, 3])
    np.testing.assert_array_equal(residuals.residual, [2, 4])


def test_named_models_keep_the_given_order_and_may_be_absent(tmp_path):
    path = tmp_path / "residuals.csv"
    path.write_text("model,altitude,residual\na,1,2\nc,3,4\nc,3,5\n")
    residuals = read_residuals(path, ["c", "b", "a"])
    assert residuals.names == ("c", "b", "a")
    np.testing.assert_array_equal(residuals.model, [2, 0, 0])
    start = "residuals: expected 2 or more of b at altitudes 0 to 9, found 0"
    assert refuses(start, fit_suite, residuals, [3.0], [1, 1, 1], bins=[0, 9])


HEADER = "model,altitude,residual\n"


@pytest.mark.parametrize(
    ("text", "start"),
    [
        ("", "line 1: expected the header model,altitude,residual, found ''"),
        ("\n\n", "line 1: expected the header"),
        ("a,1,2\n", "line 1: expected the header model,altitude,residual, found 'a,1,2'"),
        ("\nmodel,residual,altitude\na,1,2\n", "line 2: expected the header"),
        (
            "model;altitude;residual\na;1;2\n",
            "line 1: expected the header model,altitude,residual, found 'model;altitude;residual'",
        ),
        (HEADER, "expected residuals below the header, found none"),
        (HEADER + "a,1\n", "line 2: expected a model and two finite numbers, found 'a,1'"),
        (HEADER + "a,1,2,3\n", "line 2: expected a model and two finite numbers, found 'a,1,2,3'"),
        (
            HEADER + "a,1,2\n\na,1,x\n",
            "line 4: expected a model and two finite numbers, found 'a,1,x",
        ),
        (HEADER + "a,,2\n", "line 2: expected a model and two finite numbers"),
        (HEADER + "a,1,nan\n", "line 2: expected a model and two finite numbers, found 'a,1,nan'"),
        (HEADER + "a,-inf,1\n", "line 2: expected a model and two finite numbers"),
        (HEADER + ",1,2\n", "line 2: expected a model and two finite numbers, found ',1,2'"),
        (HEADER + '"a\nb",1,2\n', "line 3: expected a model and two finite numbers"),
        (HEADER + 'a,1,2\n"a,1,2\n', "cannot be read as a CSV file: unexpected end of data"),
        (HEADER + "a,1," + "2" * 500 + "x", "line 2: expected a model"),
        ("x" * 500, "line 1: expected the header"),
        (b"\xff\xfe\x00", "cannot be read as a CSV file: 'utf-8' codec"),
    ],
)
def test_read_residuals_refuses(tmp_path, text, start):
    path = tmp_path / "residuals.csv"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    with pytest.raises(ValueError) as caught:
        read_residuals(path)
    message = str(caught.value)
    assert message.startswith((f"{path}, {start}", f"{path}: {start}"))
    assert "\n" not in message
    assert len(message) < len(str(path)) + 200


def test_read_residuals_refuses_unknown_models_and_bad_paths(tmp_path):
    path = tmp_path / "residuals.csv"
    path.write_text(HEADER + "a,1,2\nz,1,2\n")
    start = f"{path}, line 3: expected a or b and two finite numbers, found 'z,1,2'"
    assert refuses(start, read_residuals, path, ["a", "b"])
    assert refuses("names: expected distinct", read_residuals, path, ["a", "z", "z"])
    for path in (tmp_path, tmp_path / "none.csv"):
        assert refuses(f"{path}: cannot be read as a CSV file: [Errno", read_residuals, path)
    assert refuses("None: cannot be read as a CSV file: expected str", read_residuals, None)
    for path in (tmp_path, tmp_path / "none" / "file.csv", None, "a\0b"):
        start = f"path: expected one that can be written, found {path}: "
        assert refuses(start, write_residuals, path, some_residuals())


ALONE = """
import sys
for name in ("tqdm", "matplotlib", "modelselect", "landing"):
    sys.modules[name] = None  # not to be found
import numpy as np, perception
few = {"architecture": [(8, 1, 2)], "training": 3, "held_out": 2, "epochs": 1}
print(perception.train_models(np.random.default_rng(0), **few, progress=True).losses.shape)
"""


def test_perception_stands_on_numpy_and_scipy_alone():
    place = Path(perception.__file__).parent
    command = [sys.executable, "-c", ALONE]
    run = subprocess.run(command, cwd=place, capture_output=True, text=True, check=False)
    assert (run.stdout, run.stderr) == ("(1, 1)\n", "")
