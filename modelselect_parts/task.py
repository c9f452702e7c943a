r"""The control task, what a flight costs, and its Riccati recursion on square roots.

A robot follows x_{t+1} = A x_t + B u_t + C s_t and pays x'Qx + u'Ru a step, or with a cross term
x'Qx + 2x'Nu + u'Ru.  What is left to pay from x_t on, if nothing disturbs, is x_t'P_t x_t.

>>> task = ControlTask(A=[[1]], B=[[1]], C=[[1]], Q=[[1]], R=[[1]], horizon=2)  # an integrator
>>> riccati(task).K.ravel()  # u_t = -K_t x_t
array([0.6, 0.5])
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, NamedTuple, Self

import numpy as np
import numpy.typing as npt
import scipy.linalg as la

from modelselect_parts.checks import (
    Array,
    Frozen,
    as_numbers,
    check_array,
    check_class,
    check_count,
    check_number,
)
from modelselect_parts.matrices import check_semidefinite, tolerance
from modelselect_parts.semidefinite import MATRIX_TOLERANCE, judged, mended, semidefinite_root

# ------------------------------------------------------------------------------------ the task


@dataclass(frozen=True, eq=False)
class ControlTask(Frozen):
    """A linear-quadratic control task with a perception input.

    x_{t+1} = A x_t + B u_t + C s_t for t = 0..H-1 (``eq:dynamics``), with cost
    J = sum_{t=1}^{H-1} x_t'Q x_t + x_H'Q_final x_H + sum_{t=0}^{H-1} u_t'R u_t: ``eq:jc``, with
    its terminal state read as x_H and the constant x_0'Q x_0 left out; beyond the paper, plus the
    cross term sum_{t=0}^{H-1} 2 x_t'N u_t, which x_0'N u_0 belongs to.

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
        ``dataclasses.replace(task, Q=...)`` keeps the old one: give both.
    N : array_like, (n, m) or (H, n, m), optional
        Cross cost of state and control, such that [[Q, N], [N', R]] is positive semidefinite.

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
    N: Array | None = field(default=None, kw_only=True)

    def __post_init__(self) -> None:
        shapes = {"A": "n n", "B": "n m", "C": "n p", "Q": "n n", "R": "m m"}
        shapes |= {} if self.N is None else {"N": "n m"}
        raw = {name: as_numbers(name, getattr(self, name)) for name in shapes}
        H = check_count("horizon", self.horizon)
        sizes: dict[str, int | None] = {"H": H, "n": None, "m": None, "p": None}
        source = {"n": "A", "m": "B"}
        checked: dict[str, Any] = {"horizon": H}
        for name, axes in shapes.items():
            axes = "H " + axes if raw[name].ndim == 3 else axes
            if name == "A":  # which must be square
                sizes["n"] = (raw[name].shape[-1:] or (None,))[0] or None
            lengths = [sizes[letter] for letter in axes.split()]
            told = [f"{x} = {sizes[x]} as of {source[x]}" for x in "nm" if x in axes and sizes[x]]
            known = f" ({', '.join(told)})" if told and name != "A" else ""
            value = getattr(self, name)
            checked[name] = check_array(name, value, axes, lengths, known=known)
            sizes[axes[-1]] = checked[name].shape[-1]
        if self.Q_final is None and checked["Q"].ndim == 3:
            raise ValueError("Q_final: required when Q varies with time, found None")
        final = checked["Q"] if self.Q_final is None else self.Q_final
        known = f" (n = {sizes['n']} as of A)"
        checked["Q_final"] = check_array("Q_final", final, "n n", 2 * (sizes["n"],), known=known)
        for name in ("Q", "Q_final", "R"):
            given, definite = getattr(self, name), name == "R"
            given = self.Q if given is None else given
            checked[name] = check_semidefinite(name, checked[name], definite=definite, given=given)
        if self.N is not None:
            slack = tolerance(self.N, self.Q, self.R)
            lost = _check_cross(checked["N"], checked["Q"], checked["R"], slack)
            for name in "QR":
                checked[name] = check_array(name, mended(checked[name], 0.0, lost), "...", ())
        self._set(**checked)

    @classmethod
    def from_statespace(
        cls,
        system: Any,
        C: npt.ArrayLike,
        Q: npt.ArrayLike,
        R: npt.ArrayLike,
        horizon: int,
        Q_final: npt.ArrayLike | None = None,
        *,
        N: npt.ArrayLike | None = None,
        dt: float | None = None,
    ) -> Self:
        """Take A and B of a plant (scipy.signal, python-control), all else as above.

        `system` is discrete, or continuous, x' = Ax + Bu + Cs, and is then sampled every `dt`
        seconds, u and s held in between (zero-order hold); a `dt` that a discrete one does not have
        is refused.  Its own output matrix is not our C and plays no part.
        """
        A, B = _plant(system)
        cost: dict[str, Any] = {"Q": Q, "R": R, "horizon": horizon, "Q_final": Q_final, "N": N}
        sample = 0.0 if dt is None else check_number("dt", dt)
        if step := _step(system):
            if dt is not None and (step is True or not abs(step - sample) <= 1e-9 * abs(sample)):
                raise ValueError(f"dt: expected that of the discrete system, {step}, found {dt}")
            return cls(A, B, C, **cost)  # type: ignore[arg-type]
        if not sample > 0:
            raise ValueError(f"dt: expected a step > 0 for a continuous system, found {dt}")
        n, (_, m) = len(A), B.shape
        both = np.hstack([B, check_array("C", C, "n p", (n, None), known=f" (n = {n} as of A)")])
        k = both.shape[1]
        with np.errstate(all="ignore"):  # Van Loan 1978
            held = la.expm(sample * np.block([[A, both], [np.zeros((k, n + k))]]))
        if not np.isfinite(held).all():
            raise ValueError(f"dt: expected a step in which the plant stays finite, found {dt}")
        return cls(held[:n, :n], held[:n, n : n + m], held[:n, n + m :], **cost)

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

    @property
    def _cross(self) -> Array:
        """N with a time axis, (H, n, m); zero where there is none."""
        N = np.zeros((self.n, self.m)) if self.N is None else self.N
        return np.broadcast_to(N, (self.horizon, self.n, self.m))

    @cached_property
    def _roots(self) -> list[_Roots]:
        return _square_root_recursion(self)


def _plant(system: Any) -> tuple[Array, Array]:
    """Return A (n, n) and B (n, m) of a state-space system."""
    if not all(hasattr(system, name) for name in ("A", "B", "dt")):
        found = type(system).__name__
        raise ValueError(f"system: expected a StateSpace with A, B and dt, found {found}")
    A = check_array("system.A", system.A, "n n", 2 * (np.shape(system.A)[-1:] or (None,)))
    return A, check_array("system.B", system.B, "n m", (len(A), None))


def _step(system: Any) -> Any:
    """Return a system's step: 0 if it is continuous, True if it is discrete and does not say."""
    if system.dt is None and not type(system).__module__.startswith("scipy"):
        raise ValueError("system: expected one with a time base, found dt = None")
    return system.dt or 0


def _check_cross(N: Array, Q: Array, R: Array, slack: float) -> float:
    """Refuse N unless x'Qx + 2x'Nu + u'Ru >= 0 at every step; return what lost digits take off."""
    lead = np.broadcast_shapes(*(M.shape[:-2] for M in (N, Q, R)))
    N, Q, R = (np.broadcast_to(M, (*lead, *M.shape[-2:])) for M in (N, Q, R))
    (_, least), k = judged(np.block([[Q, N], [np.swapaxes(N, -1, -2), R]])), sum(N.shape[-2:])
    if least < -slack * k:
        found = f"smallest eigenvalue {least:.3g} (of the matrix scaled to unit diagonal)"
        if least > -1e-3:
            found += "; if digits were lost: nearest_semidefinite of it"
        raise ValueError(f"N: expected [[Q, N], [N', R]] positive semidefinite, found {found}")
    return least if least < -MATRIX_TOLERANCE * k else 0.0


def control_cost(task: ControlTask, states: npt.ArrayLike, controls: npt.ArrayLike) -> Any:
    """Cost of a roll-out: sum_{t=1}^{H} x_t'Q_t x_t + sum_{t=0}^{H-1} u_t'R_t u_t (``eq:jc``).

    `states` (..., H+1, n), of which x_0 is not charged, and `controls` (..., H, m) give a number,
    or an array of the leading axes.  A task with N adds sum_{t=0}^{H-1} 2 x_t'N_t u_t, with x_0.
    Who follows a reference gives states less the reference.
    """
    check_class("task", task, "ControlTask")
    H = task.horizon
    x = check_array("states", states, "... H+1 n", (H + 1, task.n))
    u = check_array("controls", controls, "... H m", (H, task.m))
    if u.shape[:-2] != x.shape[:-2]:
        raise ValueError(
            f"controls: expected the leading axes of states, {x.shape[:-2]}, found {u.shape[:-2]}"
        )
    _, _, _, Q, R = task.over_time()
    with np.errstate(all="ignore"):
        over_states = np.einsum("...ti,tij,...tj->...", x[..., 1:, :], Q[1:], x[..., 1:, :])
        cost = over_states + np.einsum("...ti,tij,...tj->...", u, R, u)
        if task.N is not None:
            cost = cost + 2 * np.einsum("...ti,tij,...tj->...", x[..., :-1, :], task._cross, u)
    if not np.isfinite(cost).all():
        raise ValueError("states: the cost overflows, or that of controls does; rescale")
    return cost


# ------------------------------------------------------------------------ the Riccati recursion


class _Roots(NamedTuple):
    """Step t of the Riccati recursion, in square roots: P_{t+1} = F F' and S_t = G G'."""

    F: Array  #: (n, n)
    G: Array  #: (m, m)
    push: Array  #: (m, n), takes F'f to G^{-1}B'P_{t+1}f, for any f
    cross: Array  #: (m, n), G^{-1}N'
    rest: Array  #: (n, n), takes F'f to the rest b of the rotated column
    left: Array  #: (n, n), what N adds to the rest of the column of A
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


def _without_cross(Q: Array, R: Array, N: Array) -> tuple[Array, Array, Array]:
    """Lower R^{1/2} (H, m, m), R^{-1/2}N' (H, m, n) and the rest Q - N R^{-1}N' (H, n, n).

    x'Qx + 2x'Nu + u'Ru = |R^{1/2}'u + R^{-1/2}N'x|^2 + x'(Q - N R^{-1}N')x.
    """
    R_root = np.asarray(np.linalg.cholesky(R), dtype=float)
    cross_root = np.asarray(np.linalg.solve(R_root, np.swapaxes(N, -1, -2)), dtype=float)
    return R_root, cross_root, Q - np.swapaxes(cross_root, -1, -2) @ cross_root


def _square_root_recursion(task: ControlTask) -> list[_Roots]:
    """Run S_t = R + B'P_{t+1}B and P_t = Q + A'P_{t+1}A - K_t'S_t K_t on roots, backwards.

    With the costs of `_without_cross`, a rotation O that clears the first of two columns,

        O' [ R^{1/2}'   R^{-1/2}N' ]   =   [ G'   G^{-1}(N' + B'P_{t+1}A) ]
           [ F'B        F'A        ]       [ 0    b                       ],

    tells G, and of the states what the control sees of them and what it leaves, b; so it does of
    any other column f with zeros over F'f.  P_t is Q - N R^{-1}N' + b'b: clearing the root of the
    former over b leaves the next root.  Forming B'PB would lose the small numbers where B nearly
    lacks rank and R is tiny (the array form of Kailath, Sayed and Hassibi, Linear Estimation,
    2000).
    """
    A, B, _, Q, R = task.over_time()
    H, m = task.horizon, task.m
    R_root, cross_root, Q_rest = _without_cross(Q[:-1], R, task._cross)
    Q_root, F = semidefinite_root(Q_rest), semidefinite_root(Q[H])
    steps: list[_Roots] = [None] * H  # type: ignore[list-item]
    with np.errstate(all="ignore"):
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
            cross, left = rotation[:m, :m].T @ cross_root[t], rotation[:m, m:].T @ cross_root[t]
            push, rest = rotation[m:, :m].T, rotation[m:, m:].T
            folding, next_root = _rotation(np.vstack([Q_root[t].T, rest @ states + left]))
            fold = folding[task.n :, : task.n].T
            steps[t] = _Roots(F, root.T, push, cross, rest, left, fold)
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

    P_H = Q_final, S_t = R + B'P_{t+1}B, K_t = S_t^{-1}(B'P_{t+1}A + N'),
    P_t = Q + A'P_{t+1}A - K_t'S_t K_t.
    Refused if the cost-to-go overflows, as some growing mode is out of the control's reach; or if
    R is lost in rounding beside B'PB, so that nothing tells redundant controls apart.
    """
    check_class("task", task, "ControlTask")
    A, B, _, Q, R = task.over_time()
    F, G, push, cross, rest, left, _ = (np.array(part) for part in zip(*task._roots, strict=True))
    transposed = np.swapaxes(F, -1, -2)
    with np.errstate(all="ignore"):
        b = rest[0] @ transposed[0] @ A[0] + left[0]
        first = _without_cross(Q[:1], R[:1], task._cross[:1])[2] + b.T @ b
        P = np.concatenate([first, (F @ transposed)[:-1], Q[-1:]])
        S = G @ np.swapaxes(G, -1, -2)
        K = np.linalg.solve(np.swapaxes(G, -1, -2), push @ transposed @ A + cross)
    if not (np.isfinite(P).all() and np.isfinite(S).all()):
        raise ValueError("task: the cost-to-go overflows; shorten the horizon or rescale")
    return Riccati(P, S, K, A - B @ K)
