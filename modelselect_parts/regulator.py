"""The control task, its controllers, what each knows, and Psi: section II of the paper."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import scipy.linalg as la

from modelselect_parts.checks import (
    MATRIX_TOLERANCE,
    Array,
    Frozen,
    as_numbers,
    check_array,
    check_count,
    check_name,
    check_semidefinite,
)

INFORMATION = ("open_loop", "preview", "causal", "measurement")


def check_information(information: str) -> None:
    """Raise ValueError unless `information` names one of the four patterns."""
    check_name("information", information, INFORMATION)


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
        State cost, positive semidefinite; Q_t weighs x_t, so Q_0 is never used.
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
            checked[name] = check_array(name, raw[name], axes, lengths)
        if self.Q_final is None and checked["Q"].ndim == 3:
            raise ValueError("Q_final: required when Q varies with time, found None")
        final = checked["Q"] if self.Q_final is None else self.Q_final
        checked["Q_final"] = check_array("Q_final", final, "n n", (n, n))
        check_semidefinite("Q", checked["Q"])
        check_semidefinite("Q_final", checked["Q_final"])
        check_semidefinite("R", checked["R"], definite=True)
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


class Riccati(NamedTuple):
    """The backward recursion of the linear-quadratic regulator (see `riccati`)."""

    P: Array  #: (H+1, n, n), cost-to-go x_t'P_t x_t
    S: Array  #: (H, m, m), R + B'P_{t+1}B
    K: Array  #: (H, m, n), feedback u_t = -K_t x_t
    closed_loop: Array  #: (H, n, n), A - B K_t


def riccati(task: ControlTask) -> Riccati:
    """Solve the finite-horizon Riccati recursion.

    P_H = Q_final, S_t = R + B'P_{t+1}B, K_t = S_t^{-1}B'P_{t+1}A, P_t = Q + A'P_{t+1}(A - B K_t).

    Parameters
    ----------
    task : ControlTask
        The task.

    Returns
    -------
    Riccati
        P (H+1, n, n), S (H, m, m), K (H, m, n) and closed_loop (H, n, n).

    Raises
    ------
    ValueError
        If the cost-to-go overflows, as some growing mode is out of the control's reach; or if
        R is lost in rounding beside B'PB, so that nothing tells redundant controls apart.
    """
    A, B, _, Q, R = task.over_time()
    H = task.horizon
    P, S = Q.copy(), np.empty((H, task.m, task.m))
    K, closed_loop = np.empty((H, task.m, task.n)), np.empty((H, task.n, task.n))
    with np.errstate(over="ignore", invalid="ignore"):
        for t in reversed(range(H)):
            S[t] = R[t] + B[t].T @ P[t + 1] @ B[t]
            if _lost(S[t]):
                raise ValueError(
                    f"task: R is lost in rounding beside B'PB at step {t} of {H}, so that controls "
                    "of equal effect cannot be told apart; raise R, or merge those controls"
                )
            K[t] = np.linalg.solve(S[t], B[t].T @ P[t + 1] @ A[t])
            closed_loop[t] = A[t] - B[t] @ K[t]
            P[t] = Q[t] + A[t].T @ P[t + 1] @ closed_loop[t]
            P[t] = (P[t] + P[t].T) / 2
            if not (np.isfinite(P[t]).all() and np.isfinite(S[t]).all()):
                raise ValueError(
                    f"task: the cost-to-go overflows at step {t} of {H}; a mode of A that the "
                    "control cannot reach grows too fast: shorten the horizon or rescale"
                )
    return Riccati(P, S, K, closed_loop)


def _lost(S: Array) -> bool:
    """Whether a finite S (m, m), scaled to unit diagonal, is singular up to rounding."""
    if len(S) == 1 or not np.isfinite(S).all():
        return False
    scale = S.diagonal() ** -0.5
    return bool(np.linalg.eigvalsh(scale[:, None] * S * scale)[0] < MATRIX_TOLERANCE)


def _costate(task: ControlTask, law: Riccati, s: Array) -> Array:
    """q_t = closed_loop_t'(P_{t+1}C s_t + q_{t+1}), q_H = 0: what the forecast s asks of u_{t-1}.

    s is (..., H, p), q is (..., H+1, n); vectors are rows, so a matrix acts from the right.
    """
    C = task.over_time()[2]
    q = np.zeros((*s.shape[:-2], task.horizon + 1, task.n))
    with np.errstate(over="ignore", invalid="ignore"):  # seen in the states, and refused there
        for t in reversed(range(task.horizon)):
            push = s[..., t, :] @ (law.P[t + 1] @ C[t]).T + q[..., t + 1, :]
            q[..., t, :] = push @ law.closed_loop[t]
    return q


def plan(task: ControlTask, x0: npt.ArrayLike, s: npt.ArrayLike) -> Array:
    """Plan all controls at t = 0 from a forecast: u = -K^{-1}(M'Q F x_0 + L s).

    Computed without the stacked matrices of `psi`: while a forecast is right, planning once and
    feeding back the state give the same controls, so we run the feedback law on the forecast.

    Parameters
    ----------
    task : ControlTask
        The task.
    x0 : array_like, (n,)
        Initial state.
    s : array_like, (..., H, p)
        Forecast of the perception input; leading axes are trials.

    Returns
    -------
    ndarray, (..., H, m)
        The controls.

    Raises
    ------
    ValueError
        A wrong shape or a number that is not finite.
    """
    return run_controller(task, x0, s, s, "preview")[1]


def run_controller(
    task: ControlTask,
    x0: npt.ArrayLike,
    s: npt.ArrayLike,
    s_hat: npt.ArrayLike,
    information: str = "open_loop",
    prior_mean: npt.ArrayLike | None = None,
) -> tuple[Array, Array]:
    """Roll out the dynamics under true input `s` and a controller that is fed `s_hat`.

    What the controller knows, and when, is its information pattern:

    - ``open_loop``: u = plan(s_hat), all of it fixed at t = 0 (the authors' code);
    - ``preview``: u_t = -K_t x_t - S_t^{-1}B'(P_{t+1}C s_hat_t + q_{t+1}(s_hat)), the true state
      fed back and the rest of the forecast used (the paper's text);
    - ``causal``: the same with q_{t+1}(prior_mean), as only s_hat_t is known at step t;
    - ``measurement``: u_t = -K_t (x_t + C (s_hat_t - s_t)): the models measure the state.

    Parameters
    ----------
    task : ControlTask
        The task.
    x0 : array_like, (n,)
        Initial state.
    s, s_hat : array_like, (..., H, p)
        True and estimated perception inputs; leading axes are trials.
    information : str
        One of `INFORMATION`.
    prior_mean : array_like, (H, p), optional
        What ``causal`` expects of the inputs it has not seen; 0 by default.

    Returns
    -------
    states : ndarray, (..., H+1, n)
        x_0 first.
    controls : ndarray, (..., H, m)

    Raises
    ------
    ValueError
        A wrong shape, a number that is not finite, an unknown pattern, or a prior mean given to
        a pattern that does not use one.
    """
    check_information(information)
    H, n, p = task.horizon, task.n, task.p
    x = check_array("x0", x0, "n", (n,))
    s = check_array("s", s, "... H p", (H, p))
    s_hat = check_array("s_hat", s_hat, "... H p", (H, p))
    if s.shape != s_hat.shape:
        raise ValueError(f"s_hat: expected the shape of s, {s.shape}, found {s_hat.shape}")
    if prior_mean is not None and information != "causal":
        raise ValueError(f"prior_mean: used only by 'causal', found with {information!r}")
    if information == "open_loop":
        planned = plan(task, x, s_hat)
        return _simulate(task, x, s, lambda t, _: planned[..., t, :])

    _, B, C, _, _ = task.over_time()
    law = riccati(task)
    if information == "measurement":
        e = s_hat - s
        return _simulate(task, x, s, lambda t, x: -(x + e[..., t, :] @ C[t].T) @ law.K[t].T)
    forecast = s_hat
    if information == "causal":
        prior_mean = np.zeros((H, p)) if prior_mean is None else prior_mean
        forecast = check_array("prior_mean", prior_mean, "H p", (H, p))
    q = _costate(task, law, forecast)
    gain = np.linalg.solve(law.S, np.swapaxes(B, -1, -2))

    def feedback(t: int, x: Array) -> Array:
        push = s_hat[..., t, :] @ (law.P[t + 1] @ C[t]).T + q[..., t + 1, :]
        return np.asarray(-x @ law.K[t].T - push @ gain[t].T)

    return _simulate(task, x, s, feedback)


def _simulate(
    task: ControlTask, x0: Array, s: Array, policy: Callable[[int, Array], Array]
) -> tuple[Array, Array]:
    """Roll out x_{t+1} = A x_t + B u_t + C s_t with u_t = policy(t, x_t)."""
    A, B, C, _, _ = task.over_time()
    states = np.empty((*s.shape[:-2], task.horizon + 1, task.n))
    controls = np.empty((*s.shape[:-2], task.horizon, task.m))
    states[..., 0, :] = x0
    with np.errstate(over="ignore", invalid="ignore"):
        for t in range(task.horizon):
            x, u = states[..., t, :], policy(t, states[..., t, :])
            controls[..., t, :] = u
            states[..., t + 1, :] = x @ A[t].T + u @ B[t].T + s[..., t, :] @ C[t].T
    if not np.isfinite(states).all():
        raise ValueError("task: the states overflow; shorten the horizon or rescale the inputs")
    return states, controls


def control_cost(task: ControlTask, states: npt.ArrayLike, controls: npt.ArrayLike) -> Any:
    """Cost of a roll-out: sum_{t=1}^{H} x_t'Q_t x_t + sum_{t=0}^{H-1} u_t'R_t u_t (``eq:jc``).

    Parameters
    ----------
    task : ControlTask
        The task.
    states : array_like, (..., H+1, n)
        x_0 first; it is not charged.
    controls : array_like, (..., H, m)
        The controls.

    Returns
    -------
    float, or ndarray of the leading axes
        The control cost J.

    Raises
    ------
    ValueError
        A wrong shape or a number that is not finite.
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


# -------------------------------------------------------------------- Psi, the sensitivity


def psi(task: ControlTask, information: str = "open_loop") -> Array:
    """Sensitivity of the control cost to perception errors (``eq:control_cost_diff``).

    J(controller fed s + e) - J(controller fed s) = e' Psi e, with Psi = L'K^{-1}L, free of x_0:
    for every realisation under ``open_loop`` and ``preview``; under ``causal`` and
    ``measurement`` in expectation over inputs that are independent of e, with the controller's
    prior mean (``measurement``: zero) as their mean.  The patterns are those of `run_controller`.

    Parameters
    ----------
    task : ControlTask
        The task.
    information : str
        One of `INFORMATION`.

    Returns
    -------
    ndarray, (pH, pH)
        Symmetric positive semidefinite, in cost per squared unit of perception.
        Block diagonal under ``causal`` and ``measurement``.

    Raises
    ------
    ValueError
        An unknown pattern, or dynamics so unstable that Psi is out of reach of double precision.

    Examples
    --------
    Of an integrator: errors cost more if they come early, and add up if they have one sign.

    >>> one = np.eye(1)
    >>> psi(ControlTask(A=one, B=one, C=one, Q=one, R=one, horizon=2))
    array([[1.4, 0.8],
           [0.8, 0.6]])
    """
    check_information(information)
    with np.errstate(over="ignore", invalid="ignore"):
        if information in ("causal", "measurement"):
            Psi = la.block_diag(*_diagonal_blocks(task, information))
        else:
            Y = _open_loop_factor(task) if information == "open_loop" else _preview_factor(task)
            Psi = Y.T @ Y
    if not np.isfinite(Psi).all():
        raise ValueError("task: Psi overflows; rescale the costs or C, or shorten the horizon")
    return np.asarray(Psi)


def _open_loop_factor(task: ControlTask) -> Array:
    """Y with Psi = Y'Y = L'K^{-1}L, K = blkdiag(R) + M'QM, L = M'QN on stacked states.

    The stacked states are X = F x_0 + M u + N s; row block t of M and N is A times the row block
    before it, plus B or C at place t.  With the Cholesky factor K = GG', Y = G^{-1}L.
    """
    A, B, C, Q, R = task.over_time()
    H, n, m, p = task.horizon, task.n, task.m, task.p
    M, N = np.zeros((H, n, H, m)), np.zeros((H, n, H, p))
    for t in range(H):
        if t > 0:
            M[t], N[t] = (np.tensordot(A[t], Z[t - 1], axes=1) for Z in (M, N))
        M[t, :, t], N[t, :, t] = B[t], C[t]
    QM = np.matmul(Q[1:], M.reshape(H, n, H * m)).reshape(H * n, H * m)
    K = la.block_diag(*R) + QM.T @ M.reshape(H * n, H * m)
    L = QM.T @ N.reshape(H * n, H * p)
    try:
        G = la.cholesky((K + K.T) / 2, lower=True)
        return np.asarray(la.solve_triangular(G, L, lower=True))
    except (la.LinAlgError, ValueError):
        raise ValueError(
            "task: planning open loop over this horizon is out of reach of double precision, as A "
            "is too unstable or R too small; use information='preview', a shorter horizon or more R"
        ) from None


def _preview_factor(task: ControlTask) -> Array:
    """Y with Psi = Y'Y: row block t is G_t^{-1}B'h_t, S_t = G_t G_t', as a linear map of e.

    h_t = P_{t+1}C e_t + closed_loop_{t+1}'h_{t+1}: the recursion of `preview_regret`, carried
    out on all of e at once, so block upper triangular.
    """
    _, B, C, _, _ = task.over_time()
    H, n, m, p = task.horizon, task.n, task.m, task.p
    law = riccati(task)
    Y, h = np.zeros((H, m, H * p)), np.zeros((n, H * p))
    for t in reversed(range(H)):
        h[:, t * p : (t + 1) * p] = law.P[t + 1] @ C[t]
        Y[t] = np.linalg.solve(np.linalg.cholesky(law.S[t]), B[t].T @ h)
        h = np.asarray(law.closed_loop[t].T @ h)
    return Y.reshape(H * m, H * p)


def _diagonal_blocks(task: ControlTask, information: str) -> Array:
    """Psi_tt = (K_t C)'S_t(K_t C) for ``measurement``, C'P B S_t^{-1}B'P C for ``causal``."""
    _, B, C, _, _ = task.over_time()
    law = riccati(task)
    pull: npt.NDArray[Any] = law.K @ C
    if information == "causal":
        pull = np.linalg.solve(law.S, np.swapaxes(B, -1, -2) @ law.P[1:] @ C)
    blocks = np.swapaxes(pull, -1, -2) @ law.S @ pull
    return np.asarray((blocks + np.swapaxes(blocks, -1, -2)) / 2)


def preview_regret(task: ControlTask, errors: npt.ArrayLike) -> Any:
    """e' Psi e of the ``preview`` pattern without Psi: O(H n^2) a trial, after `riccati`.

    h_t = P_{t+1}C e_t + q_{t+1}, q_t = closed_loop_t'h_t, regret = sum_t (B'h_t)'S_t^{-1}(B'h_t).

    Parameters
    ----------
    task : ControlTask
        The task.
    errors : array_like, (..., H, p)
        Perception errors s_hat - s; leading axes are trials.

    Returns
    -------
    float, or ndarray of the leading axes
        Extra control cost caused by the errors.

    Raises
    ------
    ValueError
        A wrong shape or a number that is not finite.
    """
    e = check_array("errors", errors, "... H p", (task.horizon, task.p))
    _, B, C, _, _ = task.over_time()
    law = riccati(task)
    q = _costate(task, law, e)
    regret = np.zeros(e.shape[:-2])
    with np.errstate(over="ignore", invalid="ignore"):
        for t in range(task.horizon):
            B_h = (e[..., t, :] @ (law.P[t + 1] @ C[t]).T + q[..., t + 1, :]) @ B[t]
            regret += ((B_h @ np.linalg.inv(law.S[t])) * B_h).sum(axis=-1)
    if not np.isfinite(regret).all():
        raise ValueError("errors: the regret overflows; rescale the errors or the costs")
    return regret[()]
