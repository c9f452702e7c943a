r"""The control task, its controllers, what each of them knows, and Psi: section II of the paper.

A robot follows x_{t+1} = A x_t + B u_t + C s_t and pays for its states and controls.  With the
cost-to-go x'P_t x of the Riccati recursion and S_t = R + B'P_{t+1}B = G_t G_t', *completing the
square* writes the cost of any controls u as a constant plus a sum of squares,

    J = constant + sum_t |G_t'(u_t - u*_t)|^2,
    u*_t = -S_t^{-1} B'(P_{t+1}(A x_t + C s_t) + q_{t+1}),

where q carries what later inputs ask of u_t.  Every controller here does just this with what it
*believes*: a state x_hat_t for x_t, an estimate s_hat_t for s_t, a forecast for q.  So the regret
of wrong beliefs is that sum over their errors: exactly where right beliefs give u*, else in
expectation, as the cross term averages out.  A pattern of information is one row of the table
`PATTERNS`: which state the controller acts on, whether it sees this step's input, whether
it foresees later ones.

>>> task = ControlTask(A=[[1]], B=[[1]], C=[[1]], Q=[[1]], R=[[1]], horizon=2)  # an integrator
>>> psi(task)  # early errors cost more, and errors of one sign add up
array([[1.4, 0.8],
       [0.8, 0.6]])
>>> s, e = np.array([[2.0], [5.0]]), np.array([[1.0], [-1.0]])
>>> right, wrong = (control_cost(task, *run_controller(task, [3], s, s + k * e)) for k in (0, 1))
>>> float(wrong - right), (e.T @ psi(task) @ e).item()
(0.4, 0.4)
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import scipy.linalg as la

from modelselect_parts.checks import (
    Array,
    Frozen,
    as_numbers,
    check_array,
    check_count,
    check_name,
    check_semidefinite,
)
from modelselect_parts.semidefinite import MATRIX_TOLERANCE, semidefinite_root

PSI_TOLERANCE = 3e-10  # of sqrt(Psi_ii Psi_jj), between two ways of rounding; 1e-9 is promised

# ------------------------------------------------------------------------------------ the task


@dataclass(frozen=True, eq=False)
class ControlTask(Frozen):
    """A linear-quadratic control task with a perception input.

    x_{t+1} = A x_t + B u_t + C s_t for t = 0..H-1 (``eq:dynamics``), with cost
    J = sum_{t=1}^{H-1} x_t'Q x_t + x_H'Q_final x_H + sum_{t=0}^{H-1} u_t'R u_t: ``eq:jc``, with
    its terminal state read as x_H and the constant x_0'Q x_0 left out.

    Every matrix is constant, or varies with time and then has a leading axis of length H.
    A square array given transposed has the right shape and cannot be caught.

    Parameters
    ----------
    A : array_like, (n, n) or (H, n, n)
        Dynamics.
    B : array_like, (n, m) or (H, n, m)
        Effect of the control.
    C : array_like, (n, p) or (H, n, p)
        Effect of the perception input.
    Q : array_like, (n, n) or (H, n, n)
        State cost, positive semidefinite; Q_t weighs x_t, so Q_0 enters no cost (only P_0).
    R : array_like, (m, m) or (H, m, m)
        Control cost, positive definite.
    horizon : int
        Number of steps H >= 1.
    Q_final : array_like, (n, n), optional
        Terminal state cost, positive semidefinite; `Q` if that is constant, else required.

    Raises
    ------
    ValueError
        A wrong shape, a number that is not finite, an asymmetric or indefinite cost.

    Examples
    --------
    Position and speed, pushed by a motor and by a wind that is estimated:

    >>> A, B, C = [[1, 0.1], [0, 1]], [[0], [0.1]], [[0], [0.1]]
    >>> task = ControlTask(A, B, C, Q=np.diag([1, 0]), R=[[0.1]], horizon=50)
    >>> task.n, task.m, task.p
    (2, 1, 1)
    """

    A: Array
    B: Array
    C: Array
    Q: Array
    R: Array
    horizon: int
    Q_final: Array | None = None

    def __post_init__(self) -> None:
        raw = {name: as_numbers(name, getattr(self, name)) for name in "ABCQR"}
        n, m, p = ((raw[name].shape[-1:] or (None,))[0] or None for name in "ABC")
        H = check_count("horizon", self.horizon)
        sizes = {"H": H, "n": n, "m": m, "p": p}
        checked: dict[str, Any] = {"horizon": H}
        for name, axes in {"A": "n n", "B": "n m", "C": "n p", "Q": "n n", "R": "m m"}.items():
            axes = "H " + axes if raw[name].ndim == 3 else axes
            lengths = [sizes[letter] for letter in axes.split()]
            checked[name] = check_array(name, getattr(self, name), axes, lengths)
        if self.Q_final is None and checked["Q"].ndim == 3:
            raise ValueError("Q_final: required when Q varies with time, found None")
        final = checked["Q"] if self.Q_final is None else self.Q_final
        checked["Q_final"] = check_array("Q_final", final, "n n", (n, n))
        for name in ("Q", "Q_final", "R"):
            checked[name] = check_semidefinite(name, checked[name], definite=name == "R")
        self._set(**checked)

    @property
    def n(self) -> int:
        """Dimension of the state."""
        return int(self.A.shape[-1])

    @property
    def m(self) -> int:
        """Dimension of the control."""
        return int(self.B.shape[-1])

    @property
    def p(self) -> int:
        """Dimension of the perception input."""
        return int(self.C.shape[-1])

    def over_time(self) -> tuple[Array, Array, Array, Array, Array]:
        """Return A, B, C, Q, R with a time axis: 0..H-1, but 0..H for Q, whose last is Q_final."""
        H = self.horizon
        A, B, C, Q, R = (
            np.broadcast_to(M, (H, *M.shape[-2:])) for M in (self.A, self.B, self.C, self.Q, self.R)
        )
        return A, B, C, np.concatenate([Q, np.asarray(self.Q_final)[None]]), R

    @cached_property
    def _roots(self) -> list[_Roots]:
        return _square_root_recursion(self)


def control_cost(task: ControlTask, states: npt.ArrayLike, controls: npt.ArrayLike) -> Any:
    """Cost of a roll-out: sum_{t=1}^{H} x_t'Q_t x_t + sum_{t=0}^{H-1} u_t'R_t u_t (``eq:jc``).

    `states` (..., H+1, n), of which x_0 is not charged, and `controls` (..., H, m) give a number,
    or an array of the leading axes.
    """
    H = task.horizon
    x = check_array("states", states, "... H+1 n", (H + 1, task.n))[..., 1:, :]
    u = check_array("controls", controls, "... H m", (H, task.m))
    if u.shape[:-2] != x.shape[:-2]:
        raise ValueError(
            f"controls: expected the leading axes of states, {x.shape[:-2]}, found {u.shape[:-2]}"
        )
    _, _, _, Q, R = task.over_time()
    with np.errstate(over="ignore", invalid="ignore"):
        over_states = np.einsum("...ti,tij,...tj->...", x, Q[1:], x)
        cost = over_states + np.einsum("...ti,tij,...tj->...", u, R, u)
    if not np.isfinite(cost).all():
        raise ValueError("states: the cost overflows, or that of controls does; rescale")
    return cost


# ------------------------------------------------------------------------ the Riccati recursion


class _Roots(NamedTuple):
    """Step t of the Riccati recursion, in square roots: P_{t+1} = F F' and S_t = G G'."""

    F: Array  #: (n, n)
    G: Array  #: (m, m)
    push: Array  #: (m, n), takes F'f to G^{-1}B'P_{t+1}f, for any f
    rest: Array  #: (n, n), takes F'f to the rest b of the rotated column
    fold: Array  #: (n, n), takes b to r, where closed_loop_t'P_{t+1}f = (root of P_t) r


def _rotation(stack: Array) -> tuple[Array, Array]:
    """Orthogonal O (l, l) and T (k, k) such that `stack` (l, k) is the first columns of O times T.

    With rows sorted and columns pivoted, small rows keep their digits beside large ones
    (Cox and Higham 1998).
    """
    k, order = stack.shape[1], np.argsort(-np.abs(stack).max(axis=1), kind="stable")
    Q, triangle, pivot = la.qr(stack[order], pivoting=True, check_finite=False)
    rotation, root = np.empty_like(Q), np.empty((k, k))
    rotation[order], root[:, pivot] = Q, triangle[:k]
    return rotation, root


def _square_root_recursion(task: ControlTask) -> list[_Roots]:
    """Run S_t = R + B'P_{t+1}B and P_t = Q + A'P_{t+1}(A - B K_t) on roots, backwards.

    A rotation O that clears the first of two columns,

        O' [ R^{1/2}'   0    ]   =   [ G'   G^{-1}B'P_{t+1}f ]
           [ F'B        F'f  ]       [ 0    b                ],

    tells G, and of any f what the control sees of it and what it leaves, b.  For f = A, b = N with
    P_t = Q + N'N, and clearing Q^{1/2}' over N leaves the next root.  Forming B'PB would lose the
    small numbers where B nearly lacks rank and R is tiny (the array form of Kailath, Sayed and
    Hassibi, Linear Estimation, 2000).
    """
    A, B, _, Q, R = task.over_time()
    H, m = task.horizon, task.m
    R_root, Q_root = np.linalg.cholesky(R), semidefinite_root(Q)
    steps: list[_Roots] = [None] * H  # type: ignore[list-item]
    F = Q_root[H]
    with np.errstate(over="ignore", invalid="ignore"):
        for t in reversed(range(H)):
            controls, states = F.T @ B[t], F.T @ A[t]
            if not (np.isfinite(controls).all() and np.isfinite(states).all()):
                raise ValueError(
                    f"task: the cost-to-go overflows at step {t} of {H}; a mode of A that the "
                    "control cannot reach grows too fast: shorten the horizon or rescale"
                )
            rotation, root = _rotation(np.vstack([R_root[t].T, controls]))
            scaled = root / np.linalg.norm(root, axis=0)
            if m > 1 and np.linalg.svd(scaled, compute_uv=False)[-1] ** 2 < MATRIX_TOLERANCE:
                raise ValueError(
                    f"task: R is lost in rounding beside B'PB at step {t} of {H}, so that controls "
                    "of equal effect cannot be told apart; raise R, or merge those controls"
                )
            push, rest = rotation[m:, :m].T, rotation[m:, m:].T
            folding, next_root = _rotation(np.vstack([Q_root[t].T, rest @ states]))
            steps[t] = _Roots(F, root.T, push, rest, folding[task.n :, : task.n].T)
            F = next_root.T
    return steps


class Riccati(NamedTuple):
    """The backward recursion of the linear-quadratic regulator (see `riccati`)."""

    P: Array  #: (H+1, n, n), cost-to-go x_t'P_t x_t
    S: Array  #: (H, m, m), R + B'P_{t+1}B
    K: Array  #: (H, m, n), feedback u_t = -K_t x_t
    closed_loop: Array  #: (H, n, n), A - B K_t


def riccati(task: ControlTask) -> Riccati:
    """Solve the finite-horizon Riccati recursion.

    P_H = Q_final, S_t = R + B'P_{t+1}B, K_t = S_t^{-1}B'P_{t+1}A, P_t = Q + A'P_{t+1}(A - B K_t).
    Refused if the cost-to-go overflows, as some growing mode is out of the control's reach; or if
    R is lost in rounding beside B'PB, so that nothing tells redundant controls apart.
    """
    A, B, _, Q, _ = task.over_time()
    F, G, push, rest, _ = (np.array(table) for table in zip(*task._roots, strict=True))
    transposed = np.swapaxes(F, -1, -2)
    with np.errstate(over="ignore", invalid="ignore"):
        N = rest[0] @ transposed[0] @ A[0]
        P = np.concatenate([(Q[0] + N.T @ N)[None], (F @ transposed)[:-1], Q[-1:]])
        S = G @ np.swapaxes(G, -1, -2)
        K = np.linalg.solve(np.swapaxes(G, -1, -2), push @ transposed @ A)
    if not (np.isfinite(P).all() and np.isfinite(S).all()):
        raise ValueError("task: the cost-to-go overflows; shorten the horizon or rescale")
    return Riccati(P, S, K, A - B @ K)


# ---------------------------------------------------------------------- what a controller knows


class Look(NamedTuple):
    """What the world holds for a controller at one step; N trials side by side."""

    state: Array  #: (n, N), the true x_t
    expected: Array  #: (n, N), what the controller expected of x_t one step ago
    C: Array  #: (n, p)
    error: Array  #: (p, N), e_t = s_hat_t - s_t


class Pattern(NamedTuple):
    """A pattern of information: what a controller knows, and when; a row of `PATTERNS`."""

    memory: Callable[[Look], Array]  #: (n, N), the state x_hat_t that it acts on
    now: bool  #: whether s_hat_t enters u_t as an input
    foresight: bool  #: whether later estimates do
    exact: bool  #: whether regret is e'Psi e in every realisation, or in expectation
    controller: str  #: in words


PATTERNS: dict[str, Pattern] = {
    "open_loop": Pattern(
        memory=lambda look: look.expected,
        now=True,
        foresight=True,
        exact=True,
        controller="plans once from the whole forecast and never looks again (the authors' code)",
    ),
    "preview": Pattern(
        memory=lambda look: look.state,
        now=True,
        foresight=True,
        exact=True,
        controller="sees the true state and the rest of the forecast (the paper's text)",
    ),
    "causal": Pattern(
        memory=lambda look: look.state,
        now=True,
        foresight=False,
        exact=False,
        controller="sees the true state and this step's estimate; expects the prior mean later",
    ),
    "measurement": Pattern(
        memory=lambda look: look.state + look.C @ look.error,
        now=False,
        foresight=False,
        exact=False,
        controller="sees a state that is off by C e_t, and nothing else; expects no input",
    ),
}


def __getattr__(name: str) -> tuple[str, ...]:
    if name == "INFORMATION":  # read when asked, as rows may be added
        return tuple(PATTERNS)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def check_information(information: str) -> None:
    """Raise ValueError unless `information` is the name of a pattern."""
    check_name("information", information, PATTERNS)


def _foreseen(task: ControlTask, forecast: Array) -> Array:
    """r (H, n, N) with q_{t+1} = F_t r_t: what a forecast (H, p, N) of later inputs asks of u_t.

    q_H = 0, q_t = closed_loop_t'(P_{t+1}C s_t + q_{t+1}).
    """
    C, H = task.over_time()[2], task.horizon
    r = np.zeros((H, task.n, forecast.shape[-1]))
    for t in reversed(range(1, H)):
        step = task._roots[t]
        r[t - 1] = step.fold @ (step.rest @ (step.F.T @ (C[t] @ forecast[t]) + r[t]))
    return r


def _regret_rows(task: ControlTask, information: str, errors: Array) -> Array:
    """G_t'(u*_t - u_t) for `errors` (H, p, N), as (H, m, N): their squares sum to the regret.

    Beliefs are linear, so their errors are the beliefs of a controller fed e in a world at rest.
    """
    row, (A, _, C, _, _) = PATTERNS[information], task.over_time()
    nothing = expected = np.zeros((task.n, errors.shape[-1]))
    found = np.empty((task.horizon, task.m, errors.shape[-1]))
    with np.errstate(over="ignore", invalid="ignore"):
        r = _foreseen(task, errors * row.foresight)
        for t, step in enumerate(task._roots):
            believed = row.memory(Look(nothing, expected, C[t], errors[t]))
            expected = A[t] @ believed + C[t] @ errors[t] * row.now
            found[t] = step.push @ (step.F.T @ expected + r[t])
    return found


def psi(task: ControlTask, information: str = "open_loop") -> Array:
    """Sensitivity of the control cost to perception errors (``eq:control_cost_diff``).

    J(controller fed s + e) - J(controller fed s) = e' Psi e, free of x_0: for every realisation
    where the pattern's row says `exact`, else in expectation over inputs that are independent of
    e, with the controller's prior mean (``measurement``: zero) as their mean.  Psi = Y'Y, where
    row t of Y e is G_t^{-1}B'(P_{t+1}(A m_t + C e_t) + q_{t+1}): what e makes the controller
    believe wrongly of the state it is in, of this step's input (``now``), and of later ones.

    Parameters
    ----------
    task : ControlTask
        The task.
    information : str
        A row of `PATTERNS`.

    Returns
    -------
    ndarray, (pH, pH)
        Symmetric positive semidefinite, in cost per squared unit of perception; entry r of step
        t at t*p + r.  Block diagonal under ``causal`` and ``measurement``.

    Raises
    ------
    ValueError
        An unknown pattern, or dynamics so unstable that Psi is out of reach of double precision.

    Examples
    --------
    An integrator whose controller sees each estimate as it comes:

    >>> psi(ControlTask(A=[[1]], B=[[1]], C=[[1]], Q=[[1]], R=[[1]], horizon=2), "causal")
    array([[0.9, 0. ],
           [0. , 0.5]])
    """
    check_information(information)
    Psi = _squared_regret(task, information)
    if not np.isfinite(Psi).all():
        raise ValueError("task: Psi overflows; rescale the costs or C, or shorten the horizon")
    size = felt_size(task, Psi.diagonal())
    lost = np.abs(Psi - _squared_regret(_in_other_units(task), information))
    if (lost > PSI_TOLERANCE * size[:, None] * size).any():
        raise ValueError(
            "task: Psi loses its digits: it changes with the units of the states, as a growing "
            "mode is beyond the control's or the cost's reach; remove it, or shorten the horizon"
        )
    return Psi


def felt_size(task: ControlTask, diagonal: Array) -> Array:
    """Return sqrt(Psi_ii), which digits count by, and no less than its rounding.

    Where errors have next to no effect, sums cancel to what rounding leaves: that is no loss.
    """
    _, _, C, Q, _ = task.over_time()
    alone = np.einsum("tij,tii->tj", C**2, np.maximum(Q[:-1], Q[1:])).max()
    least = 1e-10 * max(diagonal.max(), alone)
    return np.asarray(np.sqrt(np.maximum(diagonal, least)) + np.finfo(float).tiny)


def _squared_regret(task: ControlTask, information: str) -> Array:
    H, p = task.horizon, task.p
    Y = _regret_rows(task, information, np.eye(H * p).reshape(H, p, H * p)).reshape(-1, H * p)
    with np.errstate(over="ignore", invalid="ignore"):
        return np.asarray(Y.T @ Y)


def _in_other_units(task: ControlTask) -> ControlTask:
    """Return the task with states x' = D x, D diagonal: the same Psi, but for rounding."""
    D = 1 + np.arange(task.n) / 7
    A, B, C, Q, R = task.over_time()
    last, Q = Q[-1] / np.outer(D, D), Q[:-1] / np.outer(D, D)
    return ControlTask(
        A * D[:, None] / D, B * D[:, None], C * D[:, None], Q, R, task.horizon, Q_final=last
    )


def preview_regret(task: ControlTask, errors: npt.ArrayLike) -> Any:
    """e' Psi e of the ``preview`` pattern without Psi, for `errors` (..., H, p): O(H n^2) each."""
    e = check_array("errors", errors, "... H p", (task.horizon, task.p))
    rows = _regret_rows(task, "preview", _columns(e))
    with np.errstate(over="ignore", invalid="ignore"):
        regret = (rows**2).sum(axis=(0, 1)).reshape(e.shape[:-2])
    if not np.isfinite(regret).all():
        raise ValueError("errors: the regret overflows; rescale the errors or the costs")
    return regret[()]


# ------------------------------------------------------------------------- the robot in motion


def _columns(trials: Array) -> Array:
    """(..., H, k) as (H, k, N): trials side by side."""
    return np.ascontiguousarray(np.moveaxis(trials.reshape(-1, *trials.shape[-2:]), 0, -1))


def roll_out(
    task: ControlTask,
    x0: Array,
    s: Array,
    perceive: Callable[[int, Array], Array],
    information: str,
    ahead: Array,
) -> tuple[Array, Array]:
    """Roll out N trials of a controller whose errors e_t (N, p) are perceive(t, x_t (N, n)).

    u_t = -S_t^{-1}B'(P_{t+1}(A x_hat_t + C s_hat_t) + q_{t+1}), with s_hat_t left out unless the
    pattern has it `now`, and q of `ahead` (N or 1, H, p): the forecast, or what is expected
    without one.  s is (N, H, p); returns states (N, H+1, n) and controls (N, H, m).
    """
    row, (A, B, C, _, _), H = PATTERNS[information], task.over_time(), task.horizon
    inputs, state = _columns(s), np.repeat(x0[:, None], len(s), axis=1)
    states, controls, expected = [state], [], state
    with np.errstate(over="ignore", invalid="ignore"):
        r = _foreseen(task, _columns(ahead))
        for t, step in zip(range(H), task._roots, strict=True):
            error = perceive(t, state.T).T
            believed = row.memory(Look(state, expected, C[t], error))
            coming = A[t] @ believed + C[t] @ (inputs[t] + error) * row.now
            u = -np.linalg.solve(step.G.T, step.push @ (step.F.T @ coming + r[t]))
            expected = coming + B[t] @ u
            state = A[t] @ state + B[t] @ u + C[t] @ inputs[t]
            states.append(state)
            controls.append(u)
    if not np.isfinite(states).all():
        raise ValueError("task: the states overflow; shorten the horizon or rescale the inputs")
    return np.moveaxis(np.array(states), -1, 0), np.moveaxis(np.array(controls), -1, 0)


def run_controller(
    task: ControlTask,
    x0: npt.ArrayLike,
    s: npt.ArrayLike,
    s_hat: npt.ArrayLike,
    information: str = "open_loop",
    prior_mean: npt.ArrayLike | None = None,
) -> tuple[Array, Array]:
    """Roll out the dynamics under true inputs and a controller that is fed estimates of them.

    From `x0` (n,), with `s` and `s_hat` (..., H, p), leading axes being trials; returns states
    (..., H+1, n), x_0 first, and controls (..., H, m).  The controller is that of a row of
    `PATTERNS`; `prior_mean` (H, p), 0 by default, is what one without foresight expects of
    inputs that it has not seen.
    """
    check_information(information)
    H, p, row = task.horizon, task.p, PATTERNS[information]
    x = check_array("x0", x0, "n", (task.n,))
    s = check_array("s", s, "... H p", (H, p))
    s_hat = check_array("s_hat", s_hat, "... H p", (H, p))
    if s.shape != s_hat.shape:
        raise ValueError(f"s_hat: expected the shape of s, {s.shape}, found {s_hat.shape}")
    if prior_mean is not None and (row.foresight or not row.now):
        users = " or ".join(repr(k) for k, it in PATTERNS.items() if it.now and not it.foresight)
        raise ValueError(f"prior_mean: used only by {users}, found with {information!r}")
    prior = np.zeros((H, p)) if prior_mean is None else prior_mean
    ahead = s_hat if row.foresight else check_array("prior_mean", prior, "H p", (H, p))
    trials, errors = s.reshape(-1, H, p), (s_hat - s).reshape(-1, H, p)
    states, controls = roll_out(task, x, trials, lambda t, _: errors[:, t], information, ahead)
    shape = s.shape[:-2]
    return states.reshape(*shape, H + 1, task.n), controls.reshape(*shape, H, task.m)


def plan(task: ControlTask, x0: npt.ArrayLike, s: npt.ArrayLike) -> Array:
    """Plan all controls (..., H, m) at t = 0 from `x0` (n,) and a forecast `s` (..., H, p).

    While a forecast is right, planning once and
    feeding back the state give the same controls, so we run the feedback law on the forecast.
    """
    return run_controller(task, x0, s, s, "preview")[1]
