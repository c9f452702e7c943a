"""What work a solver takes, and what it proves when it is stopped, is a fact of it.

A mistake that costs no optimum may yet cost labels, nodes or steps, or blunt a bound, and no proof
notices.  So every case here has its numbers in work.json: a change that lowers them, or raises
them for a reason, comes with new ones, which `python tests/test_work.py` writes.  A number is
stated as the least and the most that it is when mean errors change in the tenth digit: where ties
decide, machines differ.
"""

import json
import sys
from collections import defaultdict
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from test_instances import FILES, stored
from test_long_horizon import a_long_landing
from test_solvers import known_suite

import modelselect as ms
from modelselect_parts import (
    ahead,
    column_generation,
    dominance,
    label_search,
    local_search,
    long_horizon,
    passes,
    relaxations,
    trellis,
)
from modelselect_parts import problem as problem_part

pytestmark = pytest.mark.no_cover

RECORD = Path(__file__).with_name("work.json")

# ------------------------------------------------------------------------------ what is counted


def of_pass(given, found):
    return [found.labels.sum(), given[4], found.complete, found.least]


def of_form(given, found):
    triangle, steps = found
    ranks, reach = ([getattr(step, name) for step in steps] for name in ("carry", "reach"))
    kept = [triangle.constant, triangle.rounding, triangle.length, sum(map(len, ranks)), sum(reach)]
    return [*kept, np.isfinite(triangle.moves).sum()]


def of_bounds(given, found):
    most = found.most[np.isfinite(found.most)]
    return [found.look, found.far.sum(), found.least.sum(), len(most), most.sum()]


def of_mixture(given, found):
    return [0 if found is None else found.iterations]


# What calls are watched, by the names under which they are called, and what is summed over them.
WATCHED = {
    "label_search.search": ([label_search, ahead], of_pass),
    "label_search.losses": ([label_search, ahead], lambda given, lost: [*lost[1:], lost.budget]),
    "long_horizon.prepared": ([long_horizon], of_form),
    "dominance.undominated": ([label_search], lambda given, kept: [len(kept), kept.sum()]),
    "dominance._apart": ([dominance], lambda given, rho2: [rho2.size]),
    "ahead.bounds_ahead": ([ahead], of_bounds),
    "passes.best_price": ([passes], lambda given, lam: [lam]),
    "interior_point.interior_point": ([relaxations, long_horizon], lambda given, b: [b[1]]),
    "column_generation.columns": ([column_generation], of_mixture),
    "descent.projected_gradient": ([ms], lambda given, found: [found[1]]),
    "local_search.swap": ([local_search], lambda given, found: [found[1]]),
    "local_search.swap_blocks": ([local_search], lambda given, found: [found[1]]),
    "trellis.certificate": ([trellis], lambda given, found: [found.taken, found.base]),
}


def watched(monkeypatch):
    """Count the calls from now on, and sum what they did, by function."""
    counts = defaultdict(lambda: np.zeros(1))

    def counted(name, call, of):
        def counting(*given, **named):
            found = call(*given, **named)
            row = np.array([1, *of(given, found)], dtype=float)
            counts[name] = counts[name] + row
            return found

        return counting

    for name, (modules, of) in WATCHED.items():
        function = name.split(".")[1]
        for module in modules:
            monkeypatch.setattr(module, function, counted(name, getattr(module, function), of))
    return counts


# ------------------------------------------------------------------------------------ the cases


def a_long_problem(H, sensitivity, information="preview", price=50.0):
    task, suite, _ = a_long_landing(H, "step")
    gains = np.tile(0.02 * task.C, (H, 1, 1)) if information == "filter" else None
    given = suite.mean, suite.variance, price * suite.cost, 0.8, 0.2
    return ms.SelectionProblem(sensitivity(task, information, gains=gains), *given)


def tied(problem, seed=0, switching=0.3, **given):
    """Switching costs from 0 to this share of the largest price."""
    W = problem.mean.shape[1]
    toll = np.random.default_rng(seed).random((W, W)) * (1 - np.eye(W))
    toll *= switching * problem.model_cost.max()
    return replace(problem, switch_cost=toll, **given)


STORED = {file.stem: (lambda file=file: stored(file)[0]) for file in FILES}
MADE = {
    "dense": lambda: known_suite(0, 14),
    "pairs": lambda: known_suite(1, 10, 3, 2),
    "flat": lambda: known_suite(2, 40, rank=3),
    "flat pairs": lambda: known_suite(3, 16, 5, 2, 3),
    "two models": lambda: known_suite(4, 24, W=2),
    "dense switching": lambda: tied(known_suite(5, 20, W=3)),
    "flat switching": lambda: tied(known_suite(8, 30, W=6, rank=5), switching=0.05),
    "pairs switching": lambda: tied(known_suite(9, 9, W=4, p=2), initial_model=3),
    "dense both": lambda: tied(known_suite(5, 20, W=3), budget=60.0),
    "dense budget": lambda: replace(known_suite(5, 20, W=3), budget=35.0),
    "hard budget": lambda: replace(known_suite(2, 32, W=3), budget=97.76),
    "tiny both": lambda: tied(known_suite(12, 6, W=3), budget=4.0),
    "pairs both": lambda: tied(known_suite(9, 9, W=4, p=2), budget=15.0),
    "front": lambda: replace(known_suite(10, 8, W=4), model_cost=np.array([0, 2, 3, 7])),
    "long": lambda: a_long_problem(450, ms.sensitivity),
    "long filter": lambda: a_long_problem(450, ms.sensitivity, "filter", 0.2),
    "long matrix": lambda: a_long_problem(300, ms.psi),
}
PROBLEMS = STORED | MADE
SOLVERS = {
    "solve": ms.solve,
    "dynamic_program": lambda problem: ms.dynamic_program(problem, max_labels=100),
    "branch_and_bound": lambda problem: ms.branch_and_bound(problem, max_nodes=12),
    "relax": lambda problem: ms.relax(problem, max_iterations=40),
    "relax_interior_point": lambda problem: ms.relax_interior_point(problem, max_iterations=4),
    "relax_by_columns": lambda problem: ms.relax_by_columns(problem, max_iterations=12),
    "plain_dynamic_program": ms.plain_dynamic_program,
    "pareto_front": ms.pareto_front,
}
FREE = ("relax", "relax_interior_point")  #: know neither switching costs nor a budget


def applies(name, solver):
    if name.startswith("long"):
        return solver == "solve"
    if name == "front" or solver == "pareto_front":
        return name == "front" and solver == "pareto_front"
    if solver == "plain_dynamic_program":
        return name.startswith("tiny")
    return solver not in FREE or not any(word in name for word in ("loaded", "swi", "bud", "both"))


CASES = [(name, solver) for name in PROBLEMS for solver in SOLVERS if applies(name, solver)]


def work(name, solver, seed=None):
    """Solve; return what that took, by function, and what was found, summed."""
    with pytest.MonkeyPatch.context() as monkeypatch:
        monkeypatch.setattr(problem_part, "LONG", 400)
        problem = PROBLEMS[name]()
        if seed is not None:
            noise = np.random.default_rng(seed).normal(size=problem.mean.shape)
            problem = replace(problem, mean=problem.mean * (1 + 1e-10 * noise))
        counts = watched(monkeypatch)
        found = SOLVERS[solver](problem)
    if isinstance(found, list):
        numbers = len(found), sum(schedule.cost for schedule in found)
    elif isinstance(found, ms.Relaxation):
        numbers = found.value, found.bound, found.multiplier
    else:
        numbers = found.cost, found.root_bound, found.cost - found.lower_bound, found.multiplier
    return {**counts, "found": np.array(numbers)}


def write(names):
    """Write work.json anew, of problems of these names or of all."""
    kept = json.loads(RECORD.read_text()) if names else {}
    for name, solver in CASES:
        if names and name not in names:
            continue
        tried = [work(name, solver, seed) for seed in (None, *range(8))]
        record = {}
        for function in sorted(set().union(*tried)):
            numbers = [found.get(function, np.zeros(1)) for found in tried]
            width = max(map(len, numbers))
            numbers = [np.append(row, np.zeros(width - len(row))) for row in numbers]
            record[function] = [np.min(numbers, axis=0).tolist(), np.max(numbers, axis=0).tolist()]
        kept[f"{name}, {solver}"] = record
    lines = (f"{json.dumps(case)}: {json.dumps(record)}" for case, record in kept.items())
    RECORD.write_text("{\n" + ",\n".join(lines) + "\n}\n")


@pytest.mark.parametrize(("name", "solver"), CASES)
def test_a_solver_takes_the_work_that_it_took(name, solver):
    record, found = json.loads(RECORD.read_text())[f"{name}, {solver}"], work(name, solver)
    for function in record.keys() | found.keys():
        least, most = map(np.array, record[function])
        numbers = found.get(function, np.zeros(1))
        room = 5e-3 * np.abs(most) + 2 * (most - least) + 1e-12
        assert len(numbers) in (1, len(least)), function
        least, most = (least - room)[: len(numbers)], (most + room)[: len(numbers)]
        assert ((least <= numbers) & (numbers <= most)).all(), (function, least, numbers, most)


if __name__ == "__main__":
    write(sys.argv[1:])
