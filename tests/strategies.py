"""Random tasks, inputs and problems for hypothesis, and the plain oracles that several tests share.

`from strategies import tasks, problems` works in any test file: pytest puts the folder on the path.
Sizes and kinds are drawn, so that they shrink; bulk numbers come from a drawn seed.  Half of the
examples hold small whole numbers, in which zeros, ties and singular matrices occur.
The oracles import nothing from the modules under test: they read the arrays of a task, no more.
"""

from itertools import product
from typing import NamedTuple

import numpy as np
from hypothesis import strategies as st
from scipy.linalg import block_diag

from modelselect import ControlTask, SelectionProblem

SEEDS = st.integers(0, 2**32 - 1)
PSI_KINDS = ("dense", "singular", "block", "zero")
VARIANCE_KINDS = ("zero", "vector", "full")


class Inputs(NamedTuple):
    """What a controller meets: initial state (n,), true inputs and errors (*trials, H, p)."""

    x0: np.ndarray
    s: np.ndarray
    errors: np.ndarray


def numbers(rng, shape, whole):
    """Standard normal numbers, or whole ones from -1 to 1."""
    return rng.integers(-1, 2, shape).astype(float) if whole else rng.normal(size=shape)


def gram(rng, shape, rank, whole):
    """Positive semidefinite matrices (*shape, shape[-1]) of at most this rank."""
    G = numbers(rng, (*shape, rank), whole)
    return G @ np.swapaxes(G, -1, -2)


@st.composite
def tasks(draw, max_horizon=6, max_p=3):
    """Control tasks; each of A, B, C, Q, R is constant or time-varying, Q may be singular or 0."""
    n, m, p, H = (draw(st.integers(1, top)) for top in (4, 3, max_p, max_horizon))
    whole, varying = draw(st.booleans()), draw(st.sets(st.sampled_from("ABCQR")))
    scale = {name: 10.0 ** draw(st.integers(-2, 2)) for name in "CQR"}
    rng = np.random.default_rng(draw(SEEDS))
    lead = {name: (H,) * (name in varying) for name in "ABCQR"}
    weights = [gram(rng, (*axes, n), draw(st.integers(0, n)), whole) for axes in (lead["Q"], ())]
    return ControlTask(
        A=numbers(rng, (*lead["A"], n, n), whole) / (1 if whole else np.sqrt(n)),
        B=numbers(rng, (*lead["B"], n, m), whole),
        C=numbers(rng, (*lead["C"], n, p), whole) * scale["C"],
        Q=weights[0] * scale["Q"],
        R=(gram(rng, (*lead["R"], m), m, whole) + np.eye(m)) * scale["R"],
        horizon=H,
        Q_final=weights[1] * scale["Q"] if "Q" in varying or draw(st.booleans()) else None,
    )


@st.composite
def inputs(draw, task, trials=()):
    """Initial state, true inputs and errors for this task, with leading trial axes."""
    whole, far = draw(st.booleans()), draw(st.sampled_from((0.0, 1.0, 100.0)))
    rng = np.random.default_rng(draw(SEEDS))
    shape = (*trials, task.horizon, task.p)
    return Inputs(
        far * numbers(rng, task.n, whole), numbers(rng, shape, whole), numbers(rng, shape, whole)
    )


def cases(max_horizon=6, max_p=3, trials=()):
    """Pairs (task, inputs)."""
    return tasks(max_horizon, max_p).flatmap(
        lambda task: st.tuples(st.just(task), inputs(task, trials))
    )


@st.composite
def problems(
    draw, max_horizon=5, max_models=4, max_p=3, psi_kinds=PSI_KINDS, unbiased=None, unavailable=None
):
    """Selection problems that enumeration can solve; `unbiased`, `unavailable`: None draws them."""
    H, W, p = (draw(st.integers(1, top)) for top in (max_horizon, max_models, max_p))
    whole, seed = draw(st.booleans()), draw(SEEDS)
    rng, unit = np.random.default_rng(seed), 2.0 ** draw(st.integers(-27, 53))  # 1e-8 to 1e16
    mean = numbers(rng, (H, W, p), whole)
    if draw(st.booleans()) if unbiased is None else unbiased:
        mean *= 0
    variance = _variance(rng, (H, W, p), draw(st.sampled_from(VARIANCE_KINDS)), whole)
    shape = (H, W) if draw(st.booleans()) else (W,)
    cost = np.abs(numbers(rng, shape, whole)) * unit * draw(st.sampled_from((1, 8, 0)))
    if draw(st.booleans()):  # the last model is a copy of the first
        mean[:, -1], variance[:, -1], cost[..., -1] = mean[:, 0], variance[:, 0], cost[..., 0]
    if draw(st.booleans()) if unavailable is None else unavailable:
        missing = rng.random(shape) < 0.4
        np.put_along_axis(missing, rng.integers(W, size=(*shape[:-1], 1)), False, axis=-1)
        cost[missing] = np.inf
    return SelectionProblem(
        psi=_psi(rng, H, p, draw(st.sampled_from(psi_kinds)), whole) * unit,
        mean=mean,
        variance=variance,
        model_cost=cost,
        alpha=draw(st.sampled_from((1.0, 0.8, 0.25, 0.0))),
        beta=draw(st.sampled_from((1.0, 0.2, 4.0, 0.0))),
    )


def _psi(rng, H, p, kind, whole):
    """A positive semidefinite (pH, pH) matrix of this kind."""
    if kind == "block":
        return block_diag(*gram(rng, (H, p), p, whole))
    rank = {"dense": p * H, "singular": max(1, p * H // 3), "zero": 0}[kind]
    return gram(rng, (p * H,), rank, whole)


def _variance(rng, shape, kind, whole):
    """Variances (H, W, p), zero or not, or covariances (H, W, p, p), singular where whole."""
    if kind == "full":
        return gram(rng, shape, shape[-1], whole)
    return numbers(rng, shape, whole) ** 2 * (kind == "vector")


# ------------------------------------------------------------------------------------ oracles


def every_schedule(problem):
    """All W^H schedules as rows."""
    H, W, _ = problem.mean.shape
    return np.array(list(product(range(W), repeat=H)))


def sign_patterns(*shape):
    """All arrays of this shape that hold -1 and 1: the equally likely draws of two-point noise."""
    return np.array(list(product((-1.0, 1.0), repeat=int(np.prod(shape))))).reshape(-1, *shape)


def at(M, t):
    """The matrix of step t, of a constant or a time-varying M."""
    return M[t] if M.ndim == 3 else M


def weight(task, t):
    """The cost matrix of x_t, t = 1..H."""
    return task.Q_final if t == task.horizon else at(task.Q, t)


def plain_states(task, x0, s, controls):
    """Step x_{t+1} = A x_t + B u_t + C s_t, a single trial."""
    states = [np.asarray(x0, dtype=float)]
    for t in range(task.horizon):
        states.append(
            at(task.A, t) @ states[t] + at(task.B, t) @ controls[t] + at(task.C, t) @ s[t]
        )
    return np.array(states)


def plain_cost(task, states, controls):
    """The definition of J, index by index: x_1..x_H and u_0..u_{H-1} of a single trial."""
    total = 0.0
    for t in range(1, task.horizon + 1):
        Q, R, x, u = weight(task, t), at(task.R, t - 1), states[t], controls[t - 1]
        total += sum(x[i] * Q[i, j] * x[j] for i in range(task.n) for j in range(task.n))
        total += sum(u[i] * R[i, j] * u[j] for i in range(task.m) for j in range(task.m))
    return total


def stacked(task, start=0):
    """F, M, N, Q-bar, R-bar of (x_{start+1}, .., x_H) = F x_start + M u + N s, block by block."""
    steps = range(start, task.horizon)

    def carried(first, matrix):  # what enters x_{first+1} as `matrix`, in x_{first+1} .. x_H
        column = [matrix]
        for t in range(first + 1, task.horizon):
            column.append(at(task.A, t) @ column[-1])
        return column

    def response(Z):
        zero = np.zeros(Z.shape[-2:])
        columns = [[zero] * (k - start) + carried(k, at(Z, k)) for k in steps]
        return np.hstack([np.vstack(column) for column in columns])

    F = np.vstack(carried(start, at(task.A, start)))
    weights = block_diag(*(weight(task, t + 1) for t in steps))
    return (
        F,
        response(task.B),
        response(task.C),
        weights,
        block_diag(*(at(task.R, t) for t in steps)),
    )


def idle_size(task, x0, *signals):
    """Norms multiplied: what doing nothing can cost, to which rounding in any cost is relative.

    A cost is far smaller where the states cancel, as they do in singular tasks of whole numbers.
    """
    F, _, N, Q, _ = (np.linalg.norm(matrix, 2) for matrix in stacked(task))
    reach = F * np.linalg.norm(x0) + N * sum(np.sqrt(np.square(s).sum()) for s in signals)
    return Q * reach**2


def dense_plan(task, x, s, start=0):
    """u = -K^{-1} M'Q-bar (F x + N s) from step `start` on, as (H - start, m)."""
    F, M, N, Q, R = stacked(task, start)
    u = -np.linalg.solve(R + M.T @ Q @ M, M.T @ Q @ (F @ x + N @ np.ravel(s)))
    return u.reshape(-1, task.m)


def replanned(task, x0, s, forecast, perceived=lambda t, x: x):
    """Controls of a robot that plans anew at each step t, from what it then believes."""
    x, controls = np.array(x0), np.zeros((task.horizon, task.m))
    for t in range(task.horizon):
        controls[t] = dense_plan(task, perceived(t, x), forecast(t), t)[0]
        x = at(task.A, t) @ x + at(task.B, t) @ controls[t] + at(task.C, t) @ s[t]
    return controls


def dense_flight(task, x0, s, s_hat, information, prior=0.0):
    """States and controls of a robot that plans by dense algebra from what its pattern tells it."""
    zero = np.zeros(s.shape)
    if information == "open_loop":
        controls = dense_plan(task, x0, s_hat)
    elif information == "preview":
        controls = replanned(task, x0, s, lambda t: s_hat[t:])
    elif information == "causal":
        controls = replanned(task, x0, s, lambda t: np.vstack([s_hat[t], (zero + prior)[t + 1 :]]))
    else:
        controls = replanned(
            task, x0, s, lambda t: zero[t:], lambda t, x: x + at(task.C, t) @ (s_hat - s)[t]
        )
    return plain_states(task, x0, s, controls), controls


# -------------------------------------------------------------------------- what is public, where

#: Tools that the modules take from their parts for themselves.
TOOLS = {
    *("Frozen", "frozen", "closes", "step_lengths", "congruence", "interior_point", "check_name"),
    *(
        "semidefinite_root",
        "relative_gap",
        "check_range",
        "check_class",
        "check_classes",
        "check_function",
        "priced",
    ),
}
#: Parts that users reach through another module than modelselect.
HOMES = {
    **{"camera": "perception", "networks": "perception"},
    **dict.fromkeys(
        ("suites", "measurements", "residual_files", "kernels", "doubts", "residuals"), "perception"
    ),
    **dict.fromkeys(
        ("flights", "rivals", "plots", "files", "options", "prices", "measured"), "landing"
    ),
}


def belongs(name, thing, module):
    """Whether a public name is this module's: defined in it, or in one of its parts."""
    home = getattr(thing, "__module__", None) or ""
    if home.startswith("modelselect_parts."):
        home = HOMES.get(home.split(".")[1], "modelselect")
        home = "perception" if name == "check_rng" else home
    return name[0] != "_" and name not in TOOLS and home == module.__name__
