r"""Gains of an observer: how far a controller should believe what it measures.

The models measure y = C^+ x; call Z = C^+ (p, n).  An observer corrects what it expects, x_hat^-,
by x_hat = x_hat^- + Gamma (y_hat - Z x_hat^-).  The gains that leave the least variance if the
process is pushed by white noise of covariance W, and y_hat errs by white noise of covariance V, are

    Gamma_t = P_t^- Z' (Z P_t^- Z' + V)^{-1},    P_{t+1}^- = A (I - Gamma_t Z) P_t^- A' + W,

P^- being the covariance of x - x_hat^-.

>>> walk = ControlTask(A=[[1]], B=[[1]], C=[[1]], Q=[[1]], R=[[1]], horizon=3)
>>> kalman_gains(walk, process_noise=[[1]], measurement_noise=[[2]]).ravel()  # P^- = 2
array([0.5, 0.5, 0.5])
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import scipy.linalg as la

from modelselect_parts.checks import Array, as_numbers, check_array, check_class
from modelselect_parts.matrices import check_semidefinite
from modelselect_parts.task import ControlTask


def _covariance(task: ControlTask, name: str, value: npt.ArrayLike, axis: str) -> Array:
    """Check a covariance, constant or varying, of what has the `axis` n or p."""
    k, varies = getattr(task, axis), as_numbers(name, value).ndim == 3
    axes, sizes = ("H " * varies + f"{axis} {axis}"), ((task.horizon,) * varies + (k, k))
    found = check_array(name, value, axes, sizes)
    return check_semidefinite(name, found, definite=axis == "p", given=value)


def kalman_gains(
    task: ControlTask, process_noise: npt.ArrayLike, measurement_noise: npt.ArrayLike
) -> Array:
    """Return filter gains (H, n, p) for the pattern ``filter``.

    The `process_noise` W (n, n) or (H, n, n) is the covariance of what pushes x_{t+1} at step t,
    such as C E[s s'] C'; the `measurement_noise` V (p, p) or (H, p, p), definite, that of an error
    e_t.  Where A, C, W and V are constant the gains are those of the steady state, by SciPy's
    `solve_discrete_are`, at every step, the first included; refused if there is none.  Where one of
    them varies they are the recursion's, from a known initial state: P_0^- = 0, so Gamma_0 = 0.
    """
    check_class("task", task, "ControlTask")
    W = _covariance(task, "process_noise", process_noise, "n")
    V = _covariance(task, "measurement_noise", measurement_noise, "p")
    sees = np.asarray(np.linalg.pinv(task.C), dtype=float)
    if max(M.ndim for M in (task.A, sees, W, V)) == 2:
        return np.repeat(_gain(_steady(task.A, sees, W, V), sees, V)[None], task.horizon, axis=0)
    return _from_step_to_step(task, sees, W, V)


def _steady(A: Array, sees: Array, W: Array, V: Array) -> Array:
    """P^- of the steady state, which the recursion reaches from any definite P_0^-.

    The stabilising solution of the controller's Riccati equation, all transposed.
    """
    try:
        with np.errstate(all="ignore"):
            P = np.asarray(la.solve_discrete_are(A.T, sees.T, W, V))
    except np.linalg.LinAlgError:
        P = np.array(np.nan)
    if not np.isfinite(P).all():
        raise ValueError(
            "process_noise: expected noise under which an observer of C^+ x settles, found none of "
            "a steady state; give it as (H, n, n) for gains from step to step"
        )
    return P


def _gain(P: Array, sees: Array, V: Array) -> Array:
    """P Z'(Z P Z' + V)^{-1} of covariance P (n, n) and Z = `sees` (p, n)."""
    return np.asarray(np.linalg.solve(sees @ P @ sees.T + V, sees @ P).T)


def _from_step_to_step(task: ControlTask, sees: Array, W: Array, V: Array) -> Array:
    """Run the recursion from P_0^- = 0, in Joseph's form, which keeps P semidefinite."""
    H, n, p = task.horizon, task.n, task.p
    sees, W, V = (np.broadcast_to(M, (H, *M.shape[-2:])) for M in (sees, W, V))
    gains, P = np.zeros((H, n, p)), np.zeros((n, n))
    for t, A in enumerate(task.over_time()[0]):
        gains[t] = gain = _gain(P, sees[t], V[t])
        kept = np.eye(n) - gain @ sees[t]
        P = A @ (kept @ P @ kept.T + gain @ V[t] @ gain.T) @ A.T + W[t]
    return gains
