"""The solvers that meet in peers.py, each a function of a problem and a time limit.

Run as a script, this solves one problem in a process of its own:

    python contenders.py '{"solver": "ours", "file": "problem.npz", "limit": 60, "repeat": 5}'

General solvers work to absolute tolerances around 1e-6.  They are given the problem in units in
which the cost of our first schedule and the largest bias of every step are 1.  Their time is that
of the call to optimise; building the model is not counted.
"""

from __future__ import annotations

import itertools
import json
import sys
import tempfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from statistics import median
from time import perf_counter, process_time
from typing import Any, NamedTuple

import numpy as np
import scipy.linalg as la
import scipy.sparse as sparse
from measure import peak_memory

from modelselect import (
    OPTIMALITY_GAP,
    Schedule,
    SelectionProblem,
    branch_and_bound,
    check_certificate,
    enumerate_schedules,
    round_and_swap,
    solve,
)


class Clock:
    """What a ``with`` block took: by the wall clock, and of processor time."""

    def __enter__(self) -> Clock:
        self.wall, self.processor = perf_counter(), process_time()
        return self

    def __exit__(self, *_: object) -> None:
        self.wall, self.processor = perf_counter() - self.wall, process_time() - self.processor


class Attempt(NamedTuple):
    """What a solver says: recomputing the cost is left to the caller."""

    choices: np.ndarray | None  #: (H,), none found if None
    bound: float  #: its lower bound
    clock: Clock | None  #: None: it refused
    closed: bool  #: whether it claims a proof, by its own tolerances
    status: str
    labels: int = 0  #: that the widest step of a label search kept


# ------------------------------------------------------------------------------ our solvers


def _ours(solver: Callable[..., Schedule], problem: SelectionProblem, **limits: Any) -> Attempt:
    with Clock() as clock:
        schedule = solver(problem, **limits)
    check_certificate(problem, schedule)
    status = "optimal" if schedule.is_optimal else "time limit"
    labels, proved = int(np.max(schedule.work.get("labels", 0))), schedule.is_optimal
    return Attempt(schedule.choices, schedule.lower_bound, clock, proved, status, labels)


def ours(problem: SelectionProblem, limit: float) -> Attempt:
    return _ours(solve, problem, time_limit=limit)


def root(problem: SelectionProblem, limit: float) -> Attempt:
    """What `solve` knows before it searches; knows no time limit."""
    return _ours(round_and_swap, problem)


def tree(problem: SelectionProblem, limit: float) -> Attempt:
    return _ours(branch_and_bound, problem, time_limit=limit)


def enumeration(problem: SelectionProblem, limit: float) -> Attempt:
    """Knows no time limit; ask only where W^H is small."""
    return _ours(enumerate_schedules, problem)


# ----------------------------------------------------- the problem in units of size one


class Scaled(NamedTuple):
    """min d'Qd + l.b + switches at `arc`, d_t = sum_w b[t,w] mu[t,w], times `unit`.

    Subject to price.b + switches at `toll` <= 1, where there is a budget.
    """

    Q: np.ndarray  #: (pH, pH)
    mean: np.ndarray  #: (H, W, p), largest entry of each step and component 1
    linear: np.ndarray  #: (H, W)
    unit: float  #: cost of one
    arc: np.ndarray | None  #: (W, W), None: switches are free
    price: np.ndarray | None  #: (H, W), None: no budget
    toll: np.ndarray | None  #: (W, W), None: switches are free, or no budget


def scaled(problem: SelectionProblem) -> Scaled:
    size = np.abs(problem.mean).max(axis=1, keepdims=True)
    size[size == 0] = 1
    unit = round_and_swap(problem).cost or 1.0
    Q = problem.quadratic / unit * size.ravel()[:, None] * size.ravel()
    switch, first, budget = problem.switch_cost, problem.initial_model, problem.budget
    arc = None if switch is None else problem.beta * switch / unit
    price = toll = None
    if budget is not None:
        assert budget > 0, "the unit of what is spent"
        price = np.broadcast_to(problem.model_cost / budget, problem.linear.shape).copy()
        if switch is not None:
            toll = switch / budget
            price[0] += 0 if first is None else toll[first]
    return Scaled(Q, problem.mean / size, problem.linear / unit, unit, arc, price, toll)


def triangular_factor(Q: np.ndarray) -> np.ndarray:
    """U with Q = U'U, upper triangular, also for singular Q."""
    values, V = la.eigh(Q)
    kept = values > 1e-12 * values[-1]
    return la.qr((V[:, kept] * np.sqrt(values[kept])).T, mode="r")[0]


# -------------------------------------------------------------------------------------- SCIP


def scip_cone(problem: SelectionProblem, limit: float) -> Attempt:
    """SCIP, one cone: min theta + l.b with |z|^2 <= theta, z = U d."""
    return _scip(problem, limit, split=False)


def scip_split(problem: SelectionProblem, limit: float) -> Attempt:
    """SCIP, a parabola for each z: min sum theta_k + l.b with z_k^2 <= theta_k, z = U d."""
    return _scip(problem, limit, split=True)


def _scip(problem: SelectionProblem, limit: float, *, split: bool) -> Attempt:
    from pyscipopt import Model

    easy, model = scaled(problem), Model()
    model.hideOutput()
    model.setParams({"limits/time": limit, "limits/gap": OPTIMALITY_GAP})
    b = _scip_model(model, easy, split)
    with tempfile.TemporaryDirectory() as folder:
        _without_metis(model, folder)
        with Clock() as clock:
            model.optimize()
    status, choices = model.getStatus(), None
    if model.getNSols():
        best = model.getBestSol()
        choices = np.array([[best[x] for x in row] for row in b]).argmax(axis=1)
    bound = model.getDualbound() if model.getDualbound() > -model.infinity() else -np.inf
    closed = status in ("optimal", "gaplimit")
    return Attempt(choices, bound * easy.unit, clock, closed, status)


def _without_metis(model: Any, folder: str) -> None:
    """Let the Ipopt inside SCIP, which its heuristics call, order sparse matrices by AMD.

    METIS, the default, ends the process in pyscipopt 6.3's wheels: "free(): invalid pointer".
    """
    if "nlpi/ipopt/optfile" in model.getParams():
        file = Path(folder) / "ipopt.opt"
        file.write_text("mumps_pivot_order 0\n", encoding="utf-8")
        model.setParam("nlpi/ipopt/optfile", str(file))


def _scip_model(model: Any, easy: Scaled, split: bool) -> list[list[Any]]:
    """State the problem in SCIP's variables; return the binaries b[t][w]."""
    from pyscipopt import quicksum

    H, W, p = easy.mean.shape
    b = [[model.addVar(vtype="B", obj=easy.linear[t, w]) for w in range(W)] for t in range(H)]
    spent = [] if easy.price is None else [easy.price[t, w] * b[t][w] for t, w in np.ndindex(H, W)]
    if easy.arc is not None:
        spent += _scip_flows(model, b, easy.arc, easy.toll)
    if easy.price is not None:
        model.addCons(quicksum(spent) <= 1)
    d = [model.addVar(lb=-1, ub=1) for _ in range(H * p)]
    for t in range(H):
        model.addCons(quicksum(b[t]) == 1)
        for i in range(p):
            means = (easy.mean[t, w, i] * b[t][w] for w in range(W))
            model.addCons(quicksum(means) == d[t * p + i])
    z = []
    for row in triangular_factor(easy.Q):
        z.append(model.addVar(lb=None))
        model.addCons(quicksum(row[k] * d[k] for k in np.flatnonzero(row)) == z[-1])
    for part in ([x] for x in z) if split else [z]:
        theta = model.addVar(obj=1)
        model.addCons(quicksum(x * x for x in part) <= theta)
    return b


def _scip_flows(
    model: Any, b: list[list[Any]], arc: np.ndarray, toll: np.ndarray | None
) -> list[Any]:
    """Add flows y[t, v, w] >= 0 from b[t-1][v] to b[t][w], which cost `arc`; what they spend.

    With b a single 1 in every step, y is 1 for the move that is made and 0 for the others.
    """
    from pyscipopt import quicksum

    spent, models = [], range(len(arc))
    for before, now in itertools.pairwise(b):
        y = [[model.addVar(ub=1, obj=arc[v, w]) for w in models] for v in models]
        for v in models:
            model.addCons(quicksum(y[v]) == before[v])
            model.addCons(quicksum(row[v] for row in y) == now[v])
        if toll is not None:
            spent += [toll[v, w] * y[v][w] for v, w in np.argwhere(toll)]
    return spent


# ------------------------------------------------------------------------------------ Gurobi


def gurobi(problem: SelectionProblem, limit: float) -> Attempt:
    """Gurobi on min d'Qd + l.b; its free licence holds 200 variables with a quadratic term."""
    import gurobipy

    assert problem.switch_cost is None and problem.budget is None, "not stated for Gurobi"
    try:
        return _gurobi(problem, limit)
    except gurobipy.GurobiError as refusal:
        return Attempt(None, -np.inf, None, False, str(refusal))


def _gurobi(problem: SelectionProblem, limit: float) -> Attempt:
    import gurobipy

    easy = scaled(problem)
    H, W, p = easy.mean.shape
    with gurobipy.Env(params={"OutputFlag": 0}) as env, gurobipy.Model(env=env) as model:
        model.setParam("Threads", 1)
        model.setParam("MIPGap", OPTIMALITY_GAP)
        model.setParam("TimeLimit", limit)
        b = model.addMVar((H, W), vtype=gurobipy.GRB.BINARY)
        d = model.addMVar((H, p), lb=-1, ub=1)
        model.addConstr(b.sum(axis=1) == 1)
        for i in range(p):
            model.addConstr((b * easy.mean[:, :, i]).sum(axis=1) == d[:, i])
        flat = d.reshape(-1)
        model.setObjective(flat @ easy.Q @ flat + (b * easy.linear).sum())
        with Clock() as clock:
            model.optimize()
        choices = b.X.argmax(axis=1) if model.SolCount else None
        closed = model.Status == gurobipy.GRB.OPTIMAL
        status = "optimal" if closed else f"status {model.Status}"
        return Attempt(choices, model.ObjBound * easy.unit, clock, closed, status)


# -------------------------------------------------------------------------- scipy.optimize.milp


def linearised(problem: SelectionProblem, limit: float) -> Attempt:
    """HiGHS, which has no MIQPs: a variable y for each product of two binaries.

    Instead of McCormick's y <= b_i, y <= b_j, y >= b_i + b_j - 1, we state what implies them
    (Adams and Sherali 1986): for each binary i and each other step, sum_j y_ij = b_i.  Products of
    adjacent steps are the switches.
    """
    from scipy.optimize import Bounds, LinearConstraint, milp

    easy = scaled(problem)
    H, W, _ = easy.mean.shape
    cost, rows, right, spent = _products(easy)
    rules = [LinearConstraint(rows, right, right)]
    if spent is not None:
        rules.append(LinearConstraint(spent, ub=1))
    with Clock() as clock:
        result = milp(
            cost,
            integrality=np.arange(len(cost)) < H * W,
            bounds=Bounds(0, 1),
            constraints=rules,
            options={"time_limit": limit, "mip_rel_gap": OPTIMALITY_GAP},
        )
    choices = None if result.x is None else result.x[: H * W].reshape(H, W).argmax(axis=1)
    bound = -np.inf if result.mip_dual_bound is None else result.mip_dual_bound * easy.unit
    status = {0: "optimal", 1: "time limit"}.get(result.status, result.message)
    return Attempt(choices, bound, clock, result.status == 0, status)


def _products(
    easy: Scaled,
) -> tuple[np.ndarray, sparse.csr_array, np.ndarray, np.ndarray | None]:
    """Costs, rows, their right-hand sides and what is spent, over (b, y).

    A y_ij for all i < j at different steps.
    """
    H, W, _ = easy.mean.shape
    N = H * W
    F = la.block_diag(*np.swapaxes(easy.mean, 1, 2))  # d = F b
    Q = F.T @ easy.Q @ F
    step = np.arange(N) // W
    i, j = np.nonzero(step[:, None] < step)
    y = N + np.arange(len(i))

    def switches(table: np.ndarray | None) -> np.ndarray:
        """What the products of adjacent steps cost."""
        adjacent = step[j] == step[i] + 1
        return np.zeros(len(i)) if table is None else np.where(adjacent, table[i % W, j % W], 0)

    cost = np.concatenate([easy.linear.ravel() + Q.diagonal(), 2 * Q[i, j] + switches(easy.arc)])
    # Row H + i * H + s says: the y between binary i and step s add up to b_i.
    here = [step, H + i * H + step[j], H + j * H + step[i]]
    own, other = np.repeat(np.arange(N), H), np.tile(np.arange(H), N)
    own, other = own[step[own] != other], other[step[own] != other]
    row = np.concatenate([*here, H + own * H + other], dtype=np.int32)  # as SciPy 1.13's milp wants
    column = np.concatenate([np.arange(N), y, y, own], dtype=np.int32)
    value = np.concatenate([np.ones(N + 2 * len(y)), -np.ones(len(own))])
    matrix = sparse.csr_array((value, (row, column)), shape=(H + N * H, N + len(y)))
    used = np.diff(matrix.indptr) > 0
    right = (np.arange(H + N * H) < H).astype(float)[used]
    spent = None
    if easy.price is not None:
        spent = np.concatenate([easy.price.ravel(), switches(easy.toll)])
    return cost, matrix[used], right, spent


# ------------------------------------------------------------------------- one measurement

SOLVERS: dict[str, Callable[[SelectionProblem, float], Attempt]] = {
    "solve": ours,
    "round_and_swap": root,
    "branch_and_bound": tree,
    "enumerate_schedules": enumeration,
    "SCIP, one cone": scip_cone,
    "SCIP, split": scip_split,
    "Gurobi": gurobi,
    "milp (HiGHS), linearised": linearised,
}


def load(file: str) -> SelectionProblem:
    with np.load(file) as given:
        return SelectionProblem(**given)


def summary(problem: SelectionProblem, runs: list[Attempt]) -> dict[str, Any]:
    """The last run, with the median of all times and the cost computed anew."""
    last, clocks = runs[-1], [run.clock for run in runs if run.clock]
    answer: dict[str, Any] = {"status": last.status, "closed": bool(last.closed)}
    answer["labels"] = last.labels
    if last.choices is not None:
        answer["choices"] = last.choices.tolist()
        answer["switches"] = int(np.count_nonzero(np.diff(last.choices)))
        if problem.is_feasible(last.choices):
            answer["cost"] = float(problem.total_cost(last.choices))
        else:
            answer |= {"closed": False, "status": "its schedule breaks the budget"}
    if np.isfinite(last.bound):
        answer["bound"] = float(last.bound)
    if clocks:
        answer["all_seconds"] = [clock.wall for clock in clocks]
        answer["seconds"] = median(answer["all_seconds"])
        answer["processor_seconds"] = median(clock.processor for clock in clocks)
    return answer


def main() -> None:
    request = json.loads(sys.argv[1])
    problem = load(request["file"])
    before, solver, runs = peak_memory(), SOLVERS[request["solver"]], []
    for _ in range(request["repeat"]):
        if sum(run.clock.wall for run in runs if run.clock) > request["limit"]:
            break
        # A fresh copy: nothing that a run has cached helps the next one.
        runs.append(solver(replace(problem), request["limit"]))
    print(
        json.dumps({"memory": peak_memory(), "before": before} | summary(problem, runs)), flush=True
    )


if __name__ == "__main__":
    main()
