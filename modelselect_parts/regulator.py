r"""The controllers of a task, what each of them knows, and Psi: section II of the paper.

A robot follows x_{t+1} = A x_t + B u_t + C s_t and pays for its states and controls.  With the
cost-to-go x'P_t x of the Riccati recursion and S_t = R + B'P_{t+1}B = G_t G_t', *completing the
square* writes the cost of any controls u as a constant plus a sum of squares,

    J = constant + sum_t |G_t'(u_t - u*_t)|^2,
    u*_t = -S_t^{-1} (B'(P_{t+1}(A x_t + C s_t) + q_{t+1}) + N'x_t),

where N, mostly 0, is the cross cost of a task, and q carries what later inputs ask of u_t.  Every
controller here does just this with what it *believes*: a state x_hat_t for x_t, an estimate s_hat_t
for s_t, a forecast for q.  So the regret of wrong beliefs is that sum over their errors: exactly
where right beliefs give u*, else in expectation, as the cross term averages out.  A pattern of
information is one row of the table `PATTERNS`: which state the controller acts on, whether it sees
this step's input, whether it foresees later ones, and in words what all that assumes.

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

import warnings
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from modelselect_parts.checks import Array, as_numbers, check_array, check_class, check_name
from modelselect_parts.task import ControlTask, Riccati, control_cost, riccati  # noqa: F401

PSI_TOLERANCE = 3e-10  # of sqrt(Psi_ii Psi_jj), between two ways of rounding; 1e-9 is promised
FEWEST = 5  # fewer numbers s that repeat what the models measure may do so by chance

# ---------------------------------------------------------------------- what a controller knows


class Look(NamedTuple):
    """What the world holds for a controller at one step; N trials side by side."""

    state: Array  #: (n, N), the true x_t
    expected: Array  #: (n, N), what x_hat_{t-1} has become, as it reckons; x_0 at t = 0
    C: Array  #: (n, p)
    error: Array  #: (p, N), e_t = s_hat_t - s_t
    late: Array  #: (n, N), what x_{t-1} + C e_{t-1} has become, as it reckons; x_0 at t = 0
    gain: Any  #: (n, p), Gamma_t of a row that takes `gains`, else None
    sees: Any  #: (p, n), C^+ of such a row: its models measure C^+ x


class Pattern(NamedTuple):
    """A pattern of information: what a controller knows, and when; a row of `PATTERNS`."""

    memory: Callable[[Look], Array]  #: (n, N), the state x_hat_t that it acts on
    now: bool  #: whether s_hat_t enters u_t as an input
    foresight: bool  #: whether later estimates do
    exact: bool  #: whether regret is e'Psi e in every realisation, or in expectation
    controller: str  #: in words
    assumes: str = ""  #: in words: what s is, and when e'Psi e is the regret
    gains: bool = False  #: whether it takes the gains of an observer


_FORECAST = "s pushes the robot, s_hat is a forecast of it; holds for any s and any start"
_STATE = (
    "the models measure the component C^+ x of the state, not s: s is an unknown push of mean zero "
    "that no model sees, and s_hat - s is the error of what is measured; exact where s = 0, and in "
    "expectation where s has mean zero and is independent of the errors"
)
PATTERNS: dict[str, Pattern] = {
    "open_loop": Pattern(
        memory=lambda look: look.expected,
        now=True,
        foresight=True,
        exact=True,
        controller="plans once from the whole forecast and never looks again (the authors' code)",
        assumes=_FORECAST + "; the start is known",
    ),
    "preview": Pattern(
        memory=lambda look: look.state,
        now=True,
        foresight=True,
        exact=True,
        controller="sees the true state and the rest of the forecast (the paper's text)",
        assumes=_FORECAST + "; the state is known at every step",
    ),
    "causal": Pattern(
        memory=lambda look: look.state,
        now=True,
        foresight=False,
        exact=False,
        controller="sees the true state and this step's estimate; expects the prior mean later",
        assumes="s pushes the robot, s_hat_t is known at step t; the state is known at every step; "
        "in expectation where s varies about its prior mean, independently of the errors",
    ),
    "measurement": Pattern(
        memory=lambda look: look.state + look.C @ look.error,
        now=False,
        foresight=False,
        exact=False,
        controller="sees a state that is off by C e_t, and nothing else; expects no input",
        assumes=_STATE + "; what C does not reach is known",
    ),
    "filter": Pattern(
        memory=lambda look: (
            look.expected + look.gain @ (look.sees @ (look.state - look.expected) + look.error)
        ),
        now=False,
        foresight=False,
        exact=False,
        controller="corrects what it expects by gains times what its measurement differs from it",
        assumes=_STATE + "; the start is known, the gains are fixed beforehand",
        gains=True,
    ),
}


def __getattr__(name: str) -> tuple[str, ...]:
    if name == "INFORMATION":  # what a task alone defines; read when asked, as rows may be added
        return tuple(name for name, row in PATTERNS.items() if not row.gains)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def check_information(information: str) -> None:
    """Raise ValueError unless `information` is the name of a pattern."""
    check_name("information", information, PATTERNS)


class Observer(NamedTuple):
    """What a row that takes gains corrects its expectation with.

    C^+ is that of the units in which the task is given: it does not turn with those of the states.
    """

    gain: Array  #: (H, n, p), Gamma_t
    sees: Array  #: (H, p, n), C_t^+


def observer_of(
    task: ControlTask, information: str, gains: npt.ArrayLike | None
) -> Observer | None:
    """Check that `gains` (n, p) or (H, n, p) are where a pattern takes them, and only there."""
    check_information(information)
    if not PATTERNS[information].gains:
        if gains is not None:
            users = " or ".join(repr(name) for name, row in PATTERNS.items() if row.gains)
            raise ValueError(f"gains: used only by {users}, found with {information!r}")
        return None
    if gains is None:
        raise ValueError(f"gains: required by {information!r} (see kalman_gains), found None")
    H, n, p = task.horizon, task.n, task.p
    axes, sizes = ("H n p", (H, n, p)) if as_numbers("gains", gains).ndim == 3 else ("n p", (n, p))
    gain, sees = check_array("gains", gains, axes, sizes), np.linalg.pinv(task.C)
    return Observer(np.broadcast_to(gain, (H, n, p)), np.broadcast_to(sees, (H, p, n)))


def at_step(observer: Observer | None, t: int) -> tuple[Any, Any]:
    """Return gain and sees of step t, as `Look` has them."""
    return (observer.gain[t], observer.sees[t]) if observer else (None, None)


def _foreseen(task: ControlTask, forecast: Array, known: Array | None = None) -> Array:
    """r (H, n, N) with q_{t+1} = F_t r_t: what a forecast (H, p, N) of later inputs asks of u_t.

    q_H = 0, q_t = closed_loop_t'(P_{t+1}(C s_t + d_t) + q_{t+1}), d (H, n, 1) being `known`.
    """
    C, H = task.over_time()[2], task.horizon
    r = np.zeros((H, task.n, forecast.shape[-1]))
    for t in reversed(range(1, H)):
        step, push = task._roots[t], C[t] @ forecast[t]
        push = push if known is None else push + known[t]
        r[t - 1] = step.fold @ (step.rest @ (step.F.T @ push + r[t]))
    return r


def _regret_rows(
    task: ControlTask,
    information: str,
    errors: Array,
    observer: Observer | None = None,
    expected: Array | None = None,
) -> Array:
    """G_t'(u*_t - u_t) for `errors` (H, p, N), as (H, m, N): their squares sum to the regret.

    Beliefs are linear, so their errors are the beliefs of a controller fed e in a world at rest;
    `expected` (n, N) is what it believes there of x_0 beforehand.
    """
    row, (A, _, C, _, _) = PATTERNS[information], task.over_time()
    nothing = np.zeros((task.n, errors.shape[-1]))
    late = expected = nothing if expected is None else expected
    found = np.empty((task.horizon, task.m, errors.shape[-1]))
    with np.errstate(all="ignore"):
        r = _foreseen(task, errors * row.foresight)
        for t, step in enumerate(task._roots):
            look = Look(nothing, expected, C[t], errors[t], late, *at_step(observer, t))
            believed, told = row.memory(look), C[t] @ errors[t]
            expected, late = (A[t] @ z + told * row.now for z in (believed, told))
            found[t] = step.push @ (step.F.T @ expected + r[t]) + step.cross @ believed
    return found


def psi(
    task: ControlTask, information: str = "open_loop", *, gains: npt.ArrayLike | None = None
) -> Array:
    """Sensitivity of the control cost to perception errors (``eq:control_cost_diff``).

    J(controller fed s + e) - J(controller fed s) = e' Psi e, free of x_0: for every realisation
    where the pattern's row says `exact`, else in expectation over inputs that are independent of
    e, with the controller's prior mean (where it measures states: zero) as their mean.  Psi = Y'Y,
    where row t of Y e is G_t^{-1}(B'(P_{t+1}(A m_t + C e_t) + q_{t+1}) + N'm_t): what e makes the
    controller believe wrongly of the state it is in, m_t, of this step's input (where it is told
    it ``now``), and of later ones.  A reference and known disturbances leave Psi as it is.

    Parameters
    ----------
    task : ControlTask
        The task.
    information : str
        A row of `PATTERNS`.
    gains : array_like, (n, p) or (H, n, p)
        Of the observer, where the pattern takes them: ``filter``.

    Returns
    -------
    ndarray, (pH, pH)
        Symmetric positive semidefinite, in cost per squared unit of perception; entry r of step
        t at t*p + r.  Block diagonal under ``causal`` and ``measurement``; ``filter`` remembers,
        which couples steps.

    Raises
    ------
    ValueError
        An unknown pattern, gains that are missing or not taken, or dynamics so unstable that Psi is
        out of reach of double precision.

    Examples
    --------
    An integrator whose controller sees each estimate as it comes:

    >>> psi(ControlTask(A=[[1]], B=[[1]], C=[[1]], Q=[[1]], R=[[1]], horizon=2), "causal")
    array([[0.9, 0. ],
           [0. , 0.5]])
    """
    check_class("task", task, "ControlTask")
    observer = observer_of(task, information, gains)
    Psi = _squared_regret(task, information, observer)
    if not np.isfinite(Psi).all():
        raise ValueError("task: Psi overflows; rescale the costs or C, or shorten the horizon")
    size = felt_size(task, Psi.diagonal(), observer)
    lost = np.abs(Psi - _squared_regret(*in_other_units(task, information, observer)))
    if (lost > PSI_TOLERANCE * size[:, None] * size).any():
        raise ValueError(
            "task: Psi loses its digits: it changes with the units of the states, as a growing "
            "mode is beyond the control's or the cost's reach; remove it, or shorten the horizon"
        )
    return Psi


def felt_size(task: ControlTask, diagonal: Array, observer: Observer | None = None) -> Array:
    """Return sqrt(Psi_ii), which digits count by, and no less than its rounding.

    Where errors have next to no effect, sums cancel to what rounding leaves: that is no loss.
    """
    _, _, C, Q, _ = task.over_time()
    entering = C**2 if observer is None else C**2 + observer.gain**2
    alone = np.einsum("tij,ii->tj", entering, Q.max(axis=0)).max()
    least = 1e-9 * max(diagonal.max(), alone)
    return np.asarray(np.sqrt(np.maximum(diagonal, least)) + np.finfo(float).tiny)


def _squared_regret(task: ControlTask, information: str, observer: Observer | None) -> Array:
    H, p = task.horizon, task.p
    each = np.eye(H * p).reshape(H, p, H * p)
    Y = _regret_rows(task, information, each, observer).reshape(-1, H * p)
    with np.errstate(all="ignore"):
        return np.asarray(Y.T @ Y)


def in_other_units(
    task: ControlTask, information: str, observer: Observer | None
) -> tuple[ControlTask, str, Observer | None]:
    """Return the same with states x' = D x, D diagonal: the same Psi, but for rounding."""
    D = 1 + np.arange(task.n) / 7
    A, B, C, Q, R = task.over_time()
    last, Q = Q[-1] / np.outer(D, D), Q[:-1] / np.outer(D, D)
    N = None if task.N is None else task._cross / D[:, None]
    A, B, C = A * D[:, None] / D, B * D[:, None], C * D[:, None]
    other = ControlTask(A, B, C, Q, R, task.horizon, Q_final=last, N=N)
    seen = observer and Observer(observer.gain * D[:, None], observer.sees / D)
    return other, information, seen


def preview_regret(task: ControlTask, errors: npt.ArrayLike) -> Any:
    """e' Psi e of the ``preview`` pattern without Psi, for `errors` (..., H, p): O(H n^2) each."""
    check_class("task", task, "ControlTask")
    e = check_array("errors", errors, "... H p", (task.horizon, task.p))
    rows = _regret_rows(task, "preview", _columns(e))
    with np.errstate(all="ignore"):
        regret = (rows**2).sum(axis=(0, 1)).reshape(e.shape[:-2])
    if not np.isfinite(regret).all():
        raise ValueError("errors: the regret overflows; rescale the errors or the costs")
    return regret[()]


def prior_pull(
    task: ControlTask,
    prior_error: npt.ArrayLike,
    information: str = "filter",
    *,
    gains: npt.ArrayLike | None = None,
) -> Array:
    """Return the `pull` g (H, p) on a selection problem of a start that is known to be misjudged.

    If the controller takes x_0 + m for x_0, m (n,) being the `prior_error`, say what an estimate
    was off by when its robot planned anew, then errors e cost e'Psi e + g'e beyond what m costs by
    itself: |Y e + y|^2 - |y|^2, where y is what m adds to the rows Y of `psi`, so g = 2 Y'y.
    Of patterns that remember: ``filter`` with its `gains` (n, p) or (H, n, p), and ``open_loop``.
    """
    check_class("task", task, "ControlTask")
    observer = observer_of(task, information, gains)
    H, p = task.horizon, task.p
    m = check_array("prior_error", prior_error, "n", (task.n,))[:, None]
    each = np.eye(H * p).reshape(H, p, H * p)
    Y = _regret_rows(task, information, each, observer)
    y = _regret_rows(task, information, np.zeros((H, p, 1)), observer, m)
    with np.errstate(all="ignore"):
        pull = np.asarray(2 * np.einsum("tik,ti->k", Y, y[..., 0]).reshape(H, p))
    if not np.isfinite(pull).all():
        raise ValueError("prior_error: the pull overflows; rescale it, the gains or the costs")
    return pull


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
    *,
    gains: npt.ArrayLike | None = None,
    known: Array | None = None,
) -> tuple[Array, Array]:
    """Roll out N trials of a controller whose errors e_t (N, p) are perceive(t, x_t (N, n)).

    u_t = -S_t^{-1}(B'(P_{t+1}(A x_hat_t + C s_hat_t + d_t) + q_{t+1}) + N'x_hat_t), with s_hat_t
    left out unless the pattern has it `now`, and q of d and `ahead` (N or 1, H, p): the forecast,
    or what is expected without one.  s is (N, H, p), d (H, n) is `known`, and `gains` are those
    of `psi`; returns states (N, H+1, n) and controls (N, H, m).
    """
    row, (A, B, C, _, _), H = PATTERNS[information], task.over_time(), task.horizon
    observer = observer_of(task, information, gains)
    d = (np.zeros((H, task.n)) if known is None else known)[..., None]
    inputs, state = _columns(s), np.repeat(x0[:, None], len(s), axis=1)
    states, controls, expected, late = [state], [], state, state
    with np.errstate(all="ignore"):
        r = _foreseen(task, _columns(ahead), d)
        for t, step in zip(range(H), task._roots, strict=True):
            error = perceive(t, state.T).T
            look = Look(state, expected, C[t], error, late, *at_step(observer, t))
            believed, told = row.memory(look), C[t] @ (inputs[t] + error) * row.now
            coming = A[t] @ believed + told + d[t]
            asked = step.push @ (step.F.T @ coming + r[t]) + step.cross @ believed
            u = -np.linalg.solve(step.G.T, asked)
            expected = coming + B[t] @ u
            late = expected + A[t] @ (state + C[t] @ error - believed)
            state = A[t] @ state + B[t] @ u + C[t] @ inputs[t] + d[t]
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
    *,
    gains: npt.ArrayLike | None = None,
    reference: npt.ArrayLike | None = None,
    disturbance: npt.ArrayLike | None = None,
) -> tuple[Array, Array]:
    """Roll out the dynamics under true inputs and a controller that is fed estimates of them.

    From `x0` (n,), with `s` and `s_hat` (..., H, p), leading axes being trials; returns states
    (..., H+1, n), x_0 first, and controls (..., H, m).  The controller is that of a row of
    `PATTERNS`, which says what s is there; `prior_mean` (H, p), 0 by default, is what one without
    foresight expects of inputs that it has not seen, and `gains` are those of `psi`.

    It steers x to a `reference` (H+1, n) or (n,), 0 by default, so its cost is
    ``control_cost(task, states - reference, controls)``; and it knows a `disturbance` (H, n) that
    is added to x_{t+1}.  Both are answered in advance, and neither changes Psi.

    Where the models measure the state (``measurement``, ``filter``), C s is an unknown push of mean
    zero.  Who means by s what they measure of the state pushes the robot by its own state, and is
    warned if that is plain from the numbers: s = 0 and s_hat = the errors is what they mean.
    """
    check_class("task", task, "ControlTask")
    check_information(information)
    H, n, p, row = task.horizon, task.n, task.p, PATTERNS[information]
    x = check_array("x0", x0, "n", (n,))
    s = check_array("s", s, "... H p", (H, p))
    s_hat = check_array("s_hat", s_hat, "... H p", (H, p))
    if s.shape != s_hat.shape:
        raise ValueError(f"s_hat: expected the shape of s, {s.shape}, found {s_hat.shape}")
    if prior_mean is not None and (row.foresight or not row.now):
        users = " or ".join(repr(k) for k, it in PATTERNS.items() if it.now and not it.foresight)
        raise ValueError(f"prior_mean: used only by {users}, found with {information!r}")
    prior = np.zeros((H, p)) if prior_mean is None else prior_mean
    ahead = s_hat if row.foresight else check_array("prior_mean", prior, "H p", (H, p))
    path, known = _deviations(task, reference, disturbance)
    trials, errors = s.reshape(-1, H, p), (s_hat - s).reshape(-1, H, p)

    def fly(s: Array, errors: Array) -> tuple[Array, Array]:
        given = (task, x - path[0], s, lambda t, _: errors[:, t], information, ahead)
        states, controls = roll_out(*given, gains=gains, known=known)
        return states + path, controls

    if not row.now and s.size >= FEWEST and s.any():
        calm = np.zeros((1, H, p))
        _warn_of_states(task, trials, fly(calm, calm)[0][0])
    states, controls = fly(trials, errors)
    shape = s.shape[:-2]
    return states.reshape(*shape, H + 1, n), controls.reshape(*shape, H, task.m)


def _deviations(
    task: ControlTask, reference: npt.ArrayLike | None, disturbance: npt.ArrayLike | None
) -> tuple[Array, Array]:
    """Return the reference r (H+1, n), and what is known to push x - r: d_t + A r_t - r_{t+1}."""
    H, n = task.horizon, task.n
    r, d = np.zeros((H + 1, n)), np.zeros((H, n))
    if reference is not None:
        along = as_numbers("reference", reference).ndim == 2
        axes, sizes = ("H+1 n", (H + 1, n)) if along else ("n", (n,))
        r = np.broadcast_to(check_array("reference", reference, axes, sizes), (H + 1, n))
    if disturbance is not None:
        d = check_array("disturbance", disturbance, "H n", (H, n))
    return r, d + np.einsum("tij,tj->ti", task.over_time()[0], r[:-1]) - r[1:]


def _warn_of_states(task: ControlTask, s: Array, states: Array) -> None:
    """Warn if s (N, H, p) repeats what the models measure of undisturbed `states` (H+1, n).

    It does if it has about their size, and their direction up to an angle a that k = s.size
    independent normal numbers of mean zero keep to with odds below e^-20, or about sin(a)^(k-1).
    """
    y = np.einsum("...ij,...j->...i", np.linalg.pinv(task.C), states[:-1])
    with np.errstate(all="ignore"):  # what is too large or too small to square is no match
        slope = (s * y).sum() / (len(s) * (y**2).sum())
        sine = np.sqrt(np.maximum(1 - slope * (s * y).sum() / (s**2).sum(), 0))
        repeats = 0.5 < slope < 2 and sine ** (s.size - 1) < np.exp(-20)
    if repeats:
        warnings.warn(
            "s: expected an unknown push C s of mean zero, found what the models measure of the "
            "state, which then pushes it; for perfect perception give s = 0 and s_hat = 0",
            stacklevel=3,
        )


def plan(task: ControlTask, x0: npt.ArrayLike, s: npt.ArrayLike) -> Array:
    """Plan all controls (..., H, m) at t = 0 from `x0` (n,) and a forecast `s` (..., H, p).

    While a forecast is right, planning once and feeding back the state give the same controls, so
    we run the feedback law on the forecast.
    """
    check_class("task", task, "ControlTask")
    return run_controller(task, x0, s, s, "preview")[1]
