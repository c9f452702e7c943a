"""Time Psi, the relaxation and `solve` on one problem, in a process of its own, for scaling.py.

    python benchmarks/point.py '{"family": "published", "seed": 0, "H": 150, "W": 8, "p": 1, \
"limit": 60, "repeat": 3}'
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from statistics import median
from time import perf_counter
from typing import Any, NamedTuple

from families import built, instance
from measure import peak_memory

from modelselect import Schedule, relax_interior_point, solve

LONG = 10.0  # seconds of `solve` after which a point is not repeated


class Times(NamedTuple):
    """Seconds of one run."""

    psi: float
    relax: float
    solve: float


def timed(call: Callable[[], Any]) -> tuple[Any, float]:
    started = perf_counter()
    answer = call()
    return answer, perf_counter() - started


def run(request: dict[str, Any]) -> tuple[Schedule, Times]:
    """Draw the problem and go through all stages; nothing is kept from one run to the next."""
    family, H, W, p = (request[key] for key in ("family", "H", "W", "p"))
    Psi, for_psi = timed(lambda: built(family, H, p))
    problem = instance(family, request["seed"], H, W, p, Psi)
    schedule, for_solve = timed(lambda: solve(problem, time_limit=request["limit"]))
    _, for_relax = timed(lambda: relax_interior_point(problem))
    return schedule, Times(for_psi, for_relax, for_solve)


def main() -> None:
    request = json.loads(sys.argv[1])
    before, runs = peak_memory(), []
    while len(runs) < request["repeat"] and sum(times.solve for times in runs) < LONG:
        schedule, times = run(request)
        runs.append(times)
    middle = Times(*(median(column) for column in zip(*runs, strict=True)))
    answer = middle._asdict() | {"longest": max(times.solve for times in runs), "runs": len(runs)}
    labels = schedule.work.get("labels", [1])
    answer |= {"labels": int(max(labels)), "labels a step": sum(map(int, labels)) / len(labels)}
    answer["solver"] = schedule.solver
    answer |= {"proved": bool(schedule.is_optimal), "gap": float(schedule.gap)}
    answer |= {"cost": schedule.cost, "root_bound": schedule.root_bound}
    print(json.dumps(answer | {"memory": peak_memory(), "before": before}))


if __name__ == "__main__":
    main()
