"""Thirty small problems with proved optima, for any solver to be tried on.

Each file of benchmarks/instances/ is a NumPy archive of the arguments of `SelectionProblem`:

    psi (pH, pH), mean (H, W, p), variance (H, W, p), model_cost (W,) or (H, W), alpha, beta;
    where they apply: switch_cost (W, W), initial_model, budget, pull (H, p);
    choices (H,), a best schedule; cost, its total cost; lower_bound, proved to 1e-9 of it.

A solver is a function from a `SelectionProblem` to choices (H,), named as module:function:

    python benchmarks/instances.py                      # solve, ours
    python benchmarks/instances.py --solver mine:solve  # yours: from mine.py on the Python path
    python benchmarks/instances.py --write              # draws and proves them anew
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from time import perf_counter

import numpy as np
from families import FAMILIES, KINDS, TEXTBOOK, arguments, constrained, instance

from modelselect import SelectionProblem, maximum_cut_problem, partition_problem, solve

FOLDER = Path(__file__).parent / "instances"
CLAIMS = ("choices", "cost", "lower_bound")


def drawn() -> Iterator[tuple[str, SelectionProblem]]:
    """All problems, by name."""
    for family in FAMILIES:
        yield f"{family.replace('/', '-')}-40", instance(family, 0, 40)
    for kind in KINDS:
        for family in TEXTBOOK:
            yield f"{family.replace('/', '-')}-{kind}-30", constrained(family, kind, 0, 30)
    yield "preview-step-p3-20", instance("preview/step", 1, 20, W=4, p=3)
    rng = np.random.default_rng(0)
    graph = np.triu(rng.integers(0, 2, (12, 12)), 1)
    yield "maximum-cut-12", maximum_cut_problem(graph + graph.T)
    yield "partition-10", partition_problem([3, 1, 4, 1, 5, 9, 2, 6, 5, 3])
    problem = instance("open_loop/model", 2, 30)
    pull = rng.normal(size=problem.mean.shape[::2]) * 10
    yield "open_loop-model-pull-30", replace(problem, pull=pull)
    W = problem.mean.shape[1]
    yield "loaded-large-30", replace(problem, switch_cost=2 * (1 - np.eye(W)), initial_model=W - 1)


def write(folder: Path) -> None:
    """Prove and store all of them."""
    folder.mkdir(exist_ok=True)
    for name, problem in drawn():
        best = solve(problem)
        assert best.is_optimal, name
        claims = {key: getattr(best, key) for key in CLAIMS}
        np.savez_compressed(folder / f"{name}.npz", **arguments(problem), **claims)


def read(file: Path) -> tuple[SelectionProblem, np.ndarray, float, float]:
    """A stored problem, its best schedule, that one's cost and what none costs less than."""
    with np.load(file) as stored:
        given = {key: stored[key] for key in stored.files if key not in CLAIMS}
        claims = (stored["choices"], float(stored["cost"]), float(stored["lower_bound"]))
    return (SelectionProblem(**given), *claims)


def compare(solver: Callable[[SelectionProblem], np.ndarray]) -> bool:
    """Print what a solver makes of each problem; whether nothing beats what was proved."""
    sound = True
    print(f"{'instance':32} {'seconds':>8} {'excess cost':>12}")
    for file in sorted(FOLDER.glob("*.npz")):
        problem, _, _, bound = read(file)
        started = perf_counter()
        choices = np.asarray(solver(problem))
        took, cost = perf_counter() - started, float(problem.total_cost(choices))
        feasible = bool(problem.is_feasible(choices))
        excess = f"{(cost - bound) / abs(bound):.1e}" if feasible else "infeasible"
        sound &= not feasible or cost >= bound - 1e-9 * abs(bound)
        print(f"{file.stem:32} {took:8.3f} {excess:>12}")
    return sound


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--solver", metavar="MODULE:FUNCTION")
    parser.add_argument("--write", action="store_true")
    options = parser.parse_args()
    if options.write:
        write(FOLDER)
    if options.solver is None:
        return not compare(lambda problem: solve(problem).choices)
    module, name = options.solver.split(":")
    return not compare(getattr(import_module(module), name))


if __name__ == "__main__":
    sys.exit(main())
