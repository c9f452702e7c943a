r"""Psi as a linear system: what errors cost without any matrix of pH rows.

Where a controller's wrong beliefs come from the past alone (measurement, filter), or from what it
foresees alone (preview, causal), the rows whose squares sum to the regret (`regulator.psi`) are
the outputs v of a system that errors drive,

    v_t = read_t eta_t + own_t e_t,    eta_next = carry_t eta_t + push_t e_t,    e'Psi e = |v|^2,

with as many states eta as the task has (twice as many where late pictures are used). It runs from
the last step to the first under foresight, the other way with memory; open_loop needs both and is
no such system. A product with Psi takes two sweeps, O(H n^2), forth and back:

    (Psi e)_t = own_t'v_t + push_t'z_t,    z_next = read_t'v_t + carry_t'z_t.

States can be chosen freely.  We choose those in which |eta|^2 is what eta adds to all outputs yet
to come if no more errors come: then [read; carry] has orthonormal columns, and neither states nor
rounding can grow on the way.

>>> task = ControlTask(A=[[1]], B=[[1]], C=[[1]], Q=[[1]], R=[[1]], horizon=2)
>>> system = sensitivity(task, "preview")
>>> np.asarray(system)
array([[0.9, 0.3],
       [0.3, 0.6]])
>>> system @ np.array([1.0, -1.0])
array([ 0.6, -0.3])
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

from modelselect_parts.checks import Array, check_array, check_class, check_number, frozen
from modelselect_parts.regulator import (
    PATTERNS,
    PSI_TOLERANCE,
    Look,
    Observer,
    at_step,
    felt_size,
    in_other_units,
    observer_of,
)
from modelselect_parts.semidefinite import MATRIX_TOLERANCE
from modelselect_parts.stored import Stored
from modelselect_parts.task import ControlTask

Wide = np.longdouble  # sums over ten thousand steps keep 16 digits, where machines have it
EPS, WIDE_EPS = float(np.finfo(float).eps), float(np.finfo(Wide).eps)


@dataclass(frozen=True, eq=False)
class Sensitivity(Stored):
    """Psi as a linear system in the states that `sensitivity` chooses; made by it.

    ``@`` multiplies a vector (pH,), ``np.asarray`` builds the matrix.
    """

    own: Array  #: (H, q, p)
    read: Array  #: (H, q, n)
    carry: Array  #: (H, n, n)
    push: Array  #: (H, n, p)
    forward: bool  #: whether it runs from the first step to the last

    def __post_init__(self) -> None:
        H, q, p = check_array("own", self.own, "H q p", (None, None, None)).shape
        n = check_array("push", self.push, "H n p", (H, None, p)).shape[1]
        shapes = {"H q p": (H, q, p), "H q n": (H, q, n), "H n n": (H, n, n), "H n p": (H, n, p)}
        for name, axes in zip(("own", "read", "carry", "push"), shapes, strict=True):
            self._set(**{name: check_array(name, getattr(self, name), axes, shapes[axes])})
        on = np.concatenate([self.read, self.carry], axis=1)
        if np.abs(on.swapaxes(1, 2) @ on - np.eye(n)).max(initial=0) > MATRIX_TOLERANCE:
            raise ValueError("carry: expected [read; carry] of orthonormal columns, found others")

    def __len__(self) -> int:
        return int(self.own.shape[0] * self.own.shape[2])

    def __matmul__(self, errors: npt.ArrayLike) -> Array:
        return product(self, check_array("errors", errors, "pH", (len(self),)))[0]

    def __rmul__(self, weight: float) -> Sensitivity:
        root = math.sqrt(check_number("weight", weight, minimum=0))
        return replace(self, own=root * self.own, push=root * self.push)

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> Array:
        H, _, p = self.own.shape
        v, _ = outputs(self, np.eye(p * H).reshape(H, p, p * H))
        rows = v.reshape(-1, p * H)
        return np.asarray(rows.T @ rows, dtype)

    def order(self) -> range:
        """Return the steps in the order in which the system runs."""
        H = len(self.own)
        return range(H) if self.forward else range(H - 1, -1, -1)

    @property
    def coupled(self) -> bool:
        """Whether errors of one step meet those of another."""
        return bool(self.read.any() and self.push.any())

    @cached_property
    def blocks(self) -> Array:
        """Diagonal blocks Psi_tt, (H, p, p): own'own + push'push, as states have that length."""
        own, push = self.own, self.push
        return frozen(own.swapaxes(1, 2) @ own + push.swapaxes(1, 2) @ push)

    def diagonal(self) -> Array:
        """Return the diagonal of Psi, (pH,)."""
        return np.diagonal(self.blocks, axis1=1, axis2=2).ravel()

    @property
    def _plain(self) -> tuple[Array, ...]:
        return self.own, self.read, self.carry, self.push

    @cached_property
    def _wide(self) -> tuple[npt.NDArray[Wide], ...]:
        return tuple(x.astype(Wide) for x in self._plain)


def outputs(
    system: Sensitivity, errors: npt.NDArray[Any]
) -> tuple[npt.NDArray[Any], npt.NDArray[Any]]:
    """Return v (H, q, N) and the states met (H, n, N) of `errors` (H, p, N), in their dtype."""
    wide = errors.dtype == Wide
    own, read, carry, push = system._wide if wide else system._plain
    v, states = own @ errors, push @ errors
    eta = np.zeros(states.shape[1:], errors.dtype)
    for t in system.order():
        v[t] += read[t] @ eta
        states[t], eta = eta, carry[t] @ eta + states[t]
    return v, states


def product(system: Sensitivity, e: Array) -> tuple[Array, Array]:
    """Return Psi e (pH,), and how far each entry may be off.

    Entry i is c'v, c column i of Y and |c| = sqrt(Psi_ii), so an error of length x in v moves it by
    |c| x at most.  Each step adds to (v, eta), then to z, at most `_unit` of the lengths that it
    sums, and no later step lengthens these.  The factor 2 covers what is of second order.
    """
    own, read, carry, push = system._wide
    H, _, p = own.shape
    v, states = outputs(system, e.astype(Wide).reshape(H, p, 1))
    z, costates = np.zeros(push.shape[1], Wide), np.zeros((H, push.shape[1]), Wide)
    for t in reversed(system.order()):
        costates[t] = z
        z = read[t].T @ v[t, :, 0] + carry[t].T @ z
    found = np.einsum("tqp,tq->tp", own, v[..., 0]) + np.einsum("tnp,tn->tp", push, costates)
    column = np.sqrt(system.diagonal())
    lengths = np.linalg.norm(np.hstack([v[..., 0], costates]).astype(float), axis=1)
    off = _rounding(system, states[..., 0], e) + _unit(system) * float(lengths.sum())
    rounded = found.ravel().astype(float)
    return rounded, 2 * off * column + EPS * np.abs(rounded)


def squares(system: Sensitivity, errors: Array) -> tuple[Array, Array]:
    """Return e'Psi e of `errors` (N, pH), and how far it may be off, (N,).

    (|v| + off)^2 - |v|^2 = 2 |v| off + off^2.
    """
    H, _, p = system.own.shape
    e = errors.reshape(-1, H, p)
    v, states = outputs(system, np.moveaxis(e, 0, -1).astype(Wide))
    found = (v**2).sum(axis=(0, 1)).astype(float)
    off = np.array([_rounding(system, states[..., k], e[k]) for k in range(len(e))])
    return found, 2 * np.sqrt(found) * off + off**2 + H * EPS * found


def window(system: Sensitivity, part: slice) -> Array:
    """Return the block of Psi of a `part` of the steps, as a matrix."""
    own, read, carry, push = (array[part] for array in system._plain)
    cut = Sensitivity(own, read, carry, push, system.forward)
    unit = np.eye(k := len(cut)).reshape(len(cut.own), -1, k)
    v, states = outputs(cut, unit)
    t = cut.order()[-1]
    last = cut.carry[t] @ states[t] + cut.push[t] @ unit[t]
    rows = np.concatenate([v.reshape(-1, k), last])
    return np.asarray(rows.T @ rows)


def _unit(system: Sensitivity) -> float:
    """Return what a step may lose, as a share of the lengths that it sums."""
    q, p, n = *system.own.shape[1:], system.push.shape[1]
    return float(2 * (q + p + n + 2) * math.sqrt(q + n + 1) * WIDE_EPS)


def _rounding(system: Sensitivity, states: npt.NDArray[Any], e: Array) -> float:
    """How far the outputs of e, stacked, may be off: the length of their error."""
    H, _, p = system.own.shape
    felt = np.sqrt(system.diagonal()).reshape(H, p) * np.abs(e.reshape(H, p))
    return _unit(system) * float(np.linalg.norm(states.astype(float), axis=1).sum() + felt.sum())


# ---------------------------------------------------------------------------- from a task to it


def sensitivity(
    task: ControlTask, information: str, *, gains: npt.ArrayLike | None = None
) -> Sensitivity:
    """Psi of a pattern of `PATTERNS` (see `psi`) as a linear system.

    `gains` (n, p) or (H, n, p) are those of an observer, where the pattern takes them.  ValueError
    for patterns that believe what comes from the past and what they foresee at once, such as
    ``open_loop``, for which there is `psi`; or where Psi is out of reach of double precision: a
    product with it changes with the units of the states.
    """
    check_class("task", task, "ControlTask")
    observer = observer_of(task, information, gains)
    with np.errstate(all="ignore"):
        plain = _in_felt_states(*_beliefs(task, information, observer))
        other = _in_felt_states(*_beliefs(*in_other_units(task, information, observer)))
        diagonal = (plain[0] ** 2).sum(axis=1) + (plain[3] ** 2).sum(axis=1)
    if not all(np.isfinite(array).all() for array in (*plain[:-1], *other[:-1], diagonal)):
        raise ValueError("task: Psi overflows; rescale the costs or C, or shorten the horizon")
    system = Sensitivity(*plain)
    size = felt_size(task, system.diagonal(), observer)
    probe = np.cos(np.arange(len(size))) / size
    off = np.abs(system @ probe - Sensitivity(*other) @ probe)
    if not (off <= PSI_TOLERANCE * math.sqrt(len(size)) * size).all():
        raise ValueError("task: Psi loses its digits with the units of states: use fewer steps")
    return system


def _beliefs(
    task: ControlTask, information: str, observer: Observer | None
) -> tuple[Array, Array, Array, Array, bool]:
    """Write the rows of `regulator.psi` as a system: own, read, carry, push, forward.

    Looking back, its states are what the controller expected wrongly, and what a late picture
    shows wrongly; looking ahead, the r of `regulator._foreseen`.
    """
    row, (A, _, C, _, _) = PATTERNS[information], task.over_time()
    n, m, p, H = task.n, task.m, task.p, task.horizon
    expected, late, error = np.split(np.eye(2 * n + p), [n, 2 * n])
    nothing = np.zeros((n, 2 * n + p))
    own, read, push = np.empty((H, m, p)), np.empty((H, m, 2 * n)), np.empty((H, 2 * n, p))
    carry = np.empty((H, 2 * n, 2 * n))
    for t, step in enumerate(task._roots):
        told = C[t] @ error
        look = Look(nothing, expected, C[t], error, late, *at_step(observer, t))
        believed = row.memory(look)
        coming, shown = (A[t] @ z + told * row.now for z in (believed, told))
        felt = step.push @ step.F.T @ coming + step.cross @ believed
        read[t], own[t] = np.split(felt, [2 * n], axis=1)
        carry[t], push[t] = np.split(np.vstack([coming, shown]), [2 * n], axis=1)
    if not carry[:, :n, n:].any() and not read[..., n:].any():  # late pictures are not used
        read, carry, push = read[..., :n], carry[:, :n, :n], push[:, :n]
    if not row.foresight:
        return own, read, carry, push, True
    if read.any():
        raise ValueError(f"information: {information!r} believes what it foresaw earlier; use psi")
    roots = task._roots
    fold = np.array([step.fold @ step.rest for step in roots])
    push = fold @ np.array([step.F.T for step in roots]) @ C
    return own, np.array([step.push for step in roots]), fold, push, False


def _in_felt_states(
    own: Array, read: Array, carry: Array, push: Array, forward: bool
) -> tuple[Array, Array, Array, Array, bool]:
    """Choose states whose length is what they add to later outputs.

    T'T is the Gramian of the outputs to come, T = 0 at the end.  With [read; T carry] = O T' (QR)
    the new states T eta have the rows of O for read and carry.
    """
    read, carry, push = read.copy(), carry.copy(), push.copy()
    (H, q, _), T = read.shape, np.zeros(carry.shape[1:])
    for t in range(H) if not forward else reversed(range(H)):
        push[t] = T @ push[t]
        basis, T = np.linalg.qr(np.vstack([read[t], T @ carry[t]]))
        read[t], carry[t] = basis[:q], basis[q:]
    return own, read, carry, push, forward
