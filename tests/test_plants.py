"""Plants as others hand them over: state spaces, single precision, printed digits."""

import numpy as np
import pytest
import scipy.signal
from hypothesis import given
from hypothesis import strategies as st

import modelselect as ms
from modelselect import ControlTask, SelectionProblem
from perception import PerceptionSuite

SEEDS = st.integers(0, 2**32 - 1)
A, B, C = np.array([[0.0, 1], [2, -0.5]]), np.array([[0.0], [1]]), np.array([[0.0], [0.3]])
COST = (np.diag([1.0, 0.1]), [[0.2]], 30)


def continuous():
    return scipy.signal.StateSpace(A, B, np.eye(2), np.zeros((2, 1)))


def test_a_continuous_plant_is_sampled_as_scipy_does_it():
    """B and C together, as both inputs are held."""
    task = ControlTask.from_statespace(continuous(), C, *COST, dt=0.1)
    both = np.hstack([B, C])
    held, inputs, *_ = scipy.signal.cont2discrete((A, both, np.eye(2), np.zeros((2, 2))), 0.1)
    np.testing.assert_allclose(task.A, held, rtol=1e-12)
    np.testing.assert_allclose(np.hstack([task.B, task.C]), inputs, rtol=1e-12)
    assert ms.psi(task).any()


def test_a_continuous_plant_does_not_pass_for_a_discrete_one():
    for dt in (None, 0, -0.1):
        with pytest.raises(ValueError, match=r"^dt: expected a (step|number)"):
            ControlTask.from_statespace(continuous(), C, *COST, dt=dt)
    discrete = scipy.signal.StateSpace(A, B, np.eye(2), np.zeros((2, 1)), dt=0.5)
    task = ControlTask.from_statespace(discrete, C, *COST)
    np.testing.assert_array_equal(task.A, A)
    np.testing.assert_array_equal(task.C, C)
    ControlTask.from_statespace(discrete, C, *COST, dt=0.5)
    for dt in (0.1, 0.5 + 1e-8, 1.0):
        with pytest.raises(ValueError, match=r"^dt: expected that of the discrete system, 0\.5, f"):
            ControlTask.from_statespace(discrete, C, *COST, dt=dt)
    with pytest.raises(ValueError, match=r"^dt: expected real numbers, found"):
        ControlTask.from_statespace(discrete, C, *COST, dt="0.5 s")
    for other in (A, (A, B, C), "plant", scipy.signal.TransferFunction([1], [1, 2])):
        with pytest.raises(ValueError, match=r"^system: expected a StateSpace with A, B and dt, f"):
            ControlTask.from_statespace(other, C, *COST, dt=0.1)


def test_python_control_says_its_time_base_otherwise():
    control = pytest.importorskip("control", reason="python-control comes with the notebooks")
    parts = A, B, np.eye(2), np.zeros((2, 1))
    task = ControlTask.from_statespace(control.ss(*parts, 0), C, *COST, dt=0.1)
    np.testing.assert_allclose(task.A, control.c2d(control.ss(*parts), 0.1).A)
    stepped = control.ss(*parts, True)  # discrete, of unstated step
    np.testing.assert_array_equal(ControlTask.from_statespace(stepped, C, *COST).A, A)
    with pytest.raises(ValueError, match=r"^dt: expected that of the discrete system, True"):
        ControlTask.from_statespace(stepped, C, *COST, dt=0.1)
    with pytest.raises(ValueError, match=r"^system: expected one with a time base"):
        ControlTask.from_statespace(control.ss(*parts, None), C, *COST, dt=0.1)


# --------------------------------------------------------------------------- digits that were lost


@given(SEEDS, st.integers(1, 5), st.integers(1, 5))
def test_semidefinite_matrices_in_single_precision_are_taken(seed, k, rank):
    F = np.random.default_rng(seed).normal(size=(k, rank)) * 10.0 ** (seed % 9 - 4)
    S = np.float32(F) @ np.float32(F).T
    one = np.ones((k, 1))
    task = ControlTask(np.eye(k), one, one, S, [[1]], 2)
    np.testing.assert_allclose(task.Q, S, atol=1e-5 * np.abs(S).max())
    variance = np.broadcast_to(S, (1, 2, k, k))
    suite = PerceptionSuite(["a", "b"], np.zeros((1, 2, k)), variance, [0, 1])
    SelectionProblem(S, suite.mean, variance, suite.cost)
    assert np.linalg.eigvalsh(task.Q).min() >= -1e-12 * np.abs(S).max()


class Tensor:
    """An array of another library, with a dtype of its own."""

    dtype = "float32"

    def __init__(self, array):
        self.array = array

    def __array__(self, dtype=None, copy=None):
        return self.array


@pytest.mark.parametrize("form", [list, Tensor])
def test_single_precision_is_known_whatever_holds_it(form):
    one, refused = np.ones((4, 1)), 0
    for seed in range(20):
        F = np.random.default_rng(seed).normal(size=(4, 2))
        S = np.float32(F @ F.T)
        assert ControlTask(np.eye(4), one, one, form(S), [[1]], 2).Q.shape == (4, 4)
        try:
            ControlTask(np.eye(4), one, one, S.astype(float), [[1]], 2)
        except ValueError:
            refused += 1
    assert refused > 5  # in double precision these would be digits that are wrong


def test_single_precision_excuses_last_digits_only():
    Q = np.array([[1, 1.0001], [1.0001, 1]], np.float32)  # of eigenvalue -1e-4
    with pytest.raises(ValueError, match=r"^Q: expected a positive semidefinite matrix"):
        ControlTask(np.eye(2), B, C, Q, [[1]], 3)
    Q = np.array([[2, 1], [1.0001, 2]], np.float32)
    with pytest.raises(ValueError, match=r"^Q: expected a symmetric matrix"):
        ControlTask(np.eye(2), B, C, Q, [[1]], 3)


def test_what_rounding_made_asymmetric_becomes_symmetric():
    Q = np.array([[2, 1], [np.nextafter(1, 2), 2]])
    task = ControlTask(np.eye(2), B, C, Q, [[1]], 3)
    assert (task.Q == task.Q.T).all() and (task.Q_final == task.Q_final.T).all()


def test_cross_terms_and_correlations_in_single_precision_are_taken():
    for seed in range(20):
        F = np.float32(np.random.default_rng(seed).normal(size=(2, 4)))
        C, D = F[:, :3], F[:, 3:]
        one = np.ones((3, 1))
        task = ControlTask(np.eye(3), one, one, C.T @ C, D.T @ D, 3, N=C.T @ D)  # |Cx + Du|^2
        np.testing.assert_allclose(task.Q, C.T @ C, rtol=1e-4, atol=1e-5)
        assert np.isfinite(ms.psi(task)).all()
        size = np.linalg.norm(F, axis=0)
        R = F.T @ F / np.outer(size, size)
        np.fill_diagonal(R, 1)
        assert ms.persistent_bias(np.ones(4), np.ones((2, 4, 1)), correlation=R).shape[0] == 2
        ms.autoregressive_errors(np.ones((2, 4, 1)), 0.5, correlation=R)
        joint = np.kron(R, np.ones((2, 2), dtype=np.float32))  # four models, errors as at step 0
        joint = joint.reshape(4, 2, 4, 2).transpose(1, 0, 3, 2)
        problem = SelectionProblem(np.eye(2), np.zeros((2, 4, 1)), np.ones((2, 4, 1)), np.arange(4))
        ms.correlated_problem(problem, joint)


@pytest.mark.parametrize("name", ["Q", "Q_final", "R"])
def test_a_matrix_is_judged_by_the_digits_of_its_own_type(name):
    almost = np.array([[1, 1], [1, 1 - 1e-7]])  # smallest eigenvalue about -5e-8
    plant, exact = [np.eye(2)] * 3, {"Q": np.eye(2), "R": np.eye(2), "Q_final": np.eye(2)}
    single = {key: np.float32(matrix) for key, matrix in exact.items()}
    if name != "R":  # which has to be definite
        ControlTask(*plant, **(exact | {name: np.float32(almost)}), horizon=2)
    with pytest.raises(ValueError, match=rf"^{name}: expected"):
        ControlTask(*plant, **(single | {name: almost}), horizon=2)


def test_a_cross_term_with_few_digits_is_told_what_to_do():
    Q, N = [[1, 0.7], [0.7, 0.49]], [[1], [0.7001]]
    with pytest.raises(ValueError, match=r"^N: expected \[\[Q, N\].*nearest_semidefinite of it$"):
        ControlTask(np.eye(2), B, C, Q, [[1]], 3, N=N)


def test_the_nearest_of_huge_matrices_does_not_overflow():
    huge = np.full((2, 2), 1.5e308)
    np.testing.assert_allclose(ms.nearest_semidefinite(huge), huge)


def test_a_correlation_that_was_mended_is_told_how_to_get_its_ones_back():
    mended = ms.nearest_semidefinite([[1, 0.8, 0.1], [0.8, 1, 0.7], [0.1, 0.7, 1]])
    given = np.ones(3), np.ones((2, 3, 1))
    with pytest.raises(ValueError, match=r"^correlation: expected 1 on the diagonal d, found 1\.0"):
        ms.persistent_bias(*given, correlation=mended)
    d = mended.diagonal()
    ms.persistent_bias(*given, correlation=mended / np.sqrt(np.outer(d, d)))


@given(SEEDS, st.integers(2, 5), st.integers(2, 6))
def test_printed_matrices_are_taken_once_they_are_mended(seed, k, digits):
    F = np.random.default_rng(seed).normal(size=(k, k - 1))
    S = np.round(F @ F.T, digits)
    one = np.ones((k, 1))
    try:
        ControlTask(np.eye(k), one, one, S, [[1]], 2)
    except ValueError as error:
        assert "smallest eigenvalue" in str(error)
        close = float(str(error).split("eigenvalue ")[1].split()[0]) > -1e-3
        assert ("nearest_semidefinite(Q)" in str(error)) == close
    mended = ms.nearest_semidefinite(S)
    task = ControlTask(np.eye(k), one, one, mended, [[1]], 2)
    np.testing.assert_allclose(task.Q, mended, atol=1e-12 * np.abs(S).max())
    if S.diagonal().min() > 0.1:
        assert np.abs(mended - S).max() <= 2 * k * 10.0**-digits * max(1, np.abs(S).max())


@pytest.mark.parametrize("stack", [(3,), (2, 3)])
def test_each_matrix_of_a_stack_is_mended_as_if_it_were_alone(stack):
    rng = np.random.default_rng(len(stack))
    scale = rng.uniform(0.1, 10, (*stack, 4))
    S = rng.normal(size=(*stack, 4, 4)) * scale[..., None] * scale[..., None, :]
    for at in np.ndindex(stack):
        alone = ms.nearest_semidefinite(S[at])
        np.testing.assert_allclose(ms.nearest_semidefinite(S)[at], alone, rtol=1e-12, atol=1e-12)


@given(SEEDS, st.integers(1, 5))
def test_the_nearest_semidefinite_matrix_is_nearer_than_any_other(seed, k):
    rng = np.random.default_rng(seed)
    S = rng.normal(size=(k, k))
    np.fill_diagonal(S, 1.0)
    nearest, S = ms.nearest_semidefinite(S), (S + S.T) / 2
    F = rng.normal(size=(k, k))
    other = nearest + 0.3 * rng.random() * (F @ F.T - nearest)
    assert np.linalg.eigvalsh(nearest).min() >= -1e-12
    assert np.linalg.norm(nearest - S) <= np.linalg.norm(other - S) + 1e-12
    np.testing.assert_allclose(ms.nearest_semidefinite(nearest), nearest, atol=1e-12)


# ---------------------------------------------------------------------------------- what is said


@pytest.mark.parametrize(
    ("spoiled", "message"),
    [
        ({"C": np.ones((3, 2))}, "C: expected shape (n, p) = (2, p) (n = 2 as of A), found (3, 2)"),
        (
            {"B": [0, 1]},
            "B: expected shape (n, m) = (2, m) (n = 2 as of A), found (2,); did you mean "
            "np.reshape(B, (2, 1))?",
        ),
        (
            {"C": [[0, 1]]},  # a row
            "C: expected shape (n, p) = (2, p) (n = 2 as of A), found (1, 2); did you mean "
            "np.reshape(C, (2, 1))?",
        ),
        ({"B": [0, 1, 2]}, "B: expected shape (n, m) = (2, m) (n = 2 as of A), found (3,)"),
        (
            {"N": [0, 0]},
            "N: expected shape (n, m) = (2, 1) (n = 2 as of A, m = 1 as of B), found (2,); did you "
            "mean np.reshape(N, (2, 1))?",
        ),
        (
            {"Q_final": np.eye(3)},
            "Q_final: expected shape (n, n) = (2, 2) (n = 2 as of A), found (3, 3)",
        ),
        ({"A": [0, 1]}, "A: expected shape (n, n) = (2, 2), found (2,)"),
        (
            {"R": 1.0},
            "R: expected shape (m, m) = (1, 1) (m = 1 as of B), found (); did you mean "
            "np.reshape(R, (1, 1))?",
        ),
        ({"A": [[1, np.nan], [0, 1]]}, "A: expected finite numbers, found nan at [0, 1]"),
    ],
)
def test_a_wrong_shape_says_which_length_is_known_and_whence(spoiled, message):
    good = {"A": A, "B": B, "C": C, "Q": np.eye(2), "R": [[1]], "horizon": 3}
    with pytest.raises(ValueError) as caught:
        ControlTask(**(good | spoiled))
    assert str(caught.value) == message


def test_a_price_that_is_none_says_at_which_step_and_model():
    mean = np.zeros((3, 2, 1))
    price = np.array([[0, 1], [0, np.nan], [0, 1]])
    for argument, value, message in (
        ("model_cost", price, "model_cost: expected finite or infinite numbers, found nan at step"),
        ("model_cost", np.where(np.arange(6).reshape(3, 2) > 3, np.inf, 0),
         "model_cost: expected an available model at every step, found none at step 2"),
        ("mean", np.where(np.arange(6).reshape(3, 2, 1) == 5, np.inf, 0),
         "mean: expected finite numbers, found inf at step 2, model 1, component 0"),
    ):  # fmt: skip
        given_ = {"psi": np.eye(3), "mean": mean, "variance": mean, "model_cost": [0, 1]}
        with pytest.raises(ValueError) as caught:
            SelectionProblem(**(given_ | {argument: value}))
        assert str(caught.value).startswith(message)


def test_a_wrong_class_is_told_the_right_one():
    one = np.zeros((2, 2, 1))
    problem = SelectionProblem(np.eye(2), one, one, [0, 1])
    task = ControlTask(A, B, C, *COST)
    for call, message in (
        (lambda: ms.solve(np.eye(2)), "problem: expected SelectionProblem, found ndarray"),
        (lambda: ms.psi(problem), "task: expected ControlTask, found SelectionProblem"),
        (lambda: ms.solve_blend(problem), "blend: expected BlendProblem, found SelectionProblem"),
        (lambda: ms.check_certificate(problem, task), "schedule: expected Schedule, found Control"),
        (
            lambda: SelectionProblem.from_suite(np.eye(2), one),
            "suite: expected Perce",
        ),
    ):
        with pytest.raises(ValueError) as caught:
            call()
        assert str(caught.value).startswith(message)
