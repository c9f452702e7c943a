"""Switching costs and a budget at H = 150, W = 8: what `solve` proves, and in what time.

Prices are EfficientNet's measured latencies on an i7-12700H (pytorch-image-models), weighed so that
the largest model costs what it costs in its family.  A switch costs 2% of the family's optimum;
the budget lies half-way between what the cheapest schedule and the optimum without one spend.

    python benchmarks/constrained.py            # writes benchmarks/results/constrained.md and .json
    python benchmarks/constrained.py --quick    # the same in small, printed only
"""

from __future__ import annotations

import argparse
from statistics import median
from time import perf_counter
from typing import Any

import numpy as np
from families import KINDS, TEXTBOOK, constrained
from measure import RESULTS, about, by, machine, save, seconds, table
from tqdm import tqdm

from modelselect import check_certificate, round_and_swap, solve


def run(seeds: int, H: int, limit: float) -> list[dict[str, Any]]:
    """Solve every instance once."""
    jobs = [(kind, family, seed) for kind in KINDS for family in TEXTBOOK for seed in range(seeds)]
    rows = []
    for kind, family, seed in tqdm(jobs, disable=None):
        problem = constrained(family, kind, seed, H)
        started = perf_counter()
        root = round_and_swap(problem)
        halfway = perf_counter()
        found = solve(problem, time_limit=limit)
        ended = perf_counter()
        check_certificate(problem, found)
        row = {"kind": kind, "family": family, "seed": seed, "proved": found.is_optimal}
        row |= {"root": halfway - started, "seconds": ended - halfway}
        row |= {"root_gap": root.gap, "gap": found.gap, "cost": found.cost}
        row |= {"switches": int(np.count_nonzero(np.diff(found.choices)))}
        rows.append(row | {"labels": int(np.max(found.work.get("labels", 0)))})
    return rows


def report(rows: list[dict[str, Any]], options: argparse.Namespace) -> str:
    """The table by kind and family."""
    lines = []
    for (kind, family), group in by(rows, "kind", "family").items():
        times = [row["seconds"] for row in group]
        lines.append(
            {
                "kind": kind,
                "family": family,
                "root, s": seconds(median(row["root"] for row in group)),
                "root gap": f"{max(row['root_gap'] for row in group):.0e}",
                "solve, s": f"{seconds(median(times))} ({seconds(max(times))})",
                "proved": f"{sum(row['proved'] for row in group)} of {len(group)}",
                "largest gap": f"{max(row['gap'] for row in group):.0e}",
                "labels": f"{max(row['labels'] for row in group)}",
                "switches": f"{median(row['switches'] for row in group):.0f}",
            }
        )
    return f"""# Switching costs and a budget

{__doc__.split("    python")[0].strip()}

H = {options.horizon}, {options.seeds} instances a row, limit {options.limit:g} s; seconds are
medians (longest in brackets).

{table(lines)}
{about(machine())}
"""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="H = 20, one seed, printed only")
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--horizon", type=int, default=150)
    parser.add_argument("--limit", type=float, default=20.0, help="seconds a solve may take")
    options = parser.parse_args()
    if options.quick:
        options.seeds, options.horizon = 1, 20
    rows = run(options.seeds, options.horizon, options.limit)
    text = report(rows, options)
    print(text)
    if not options.quick:
        save(RESULTS, "constrained", text, {"machine": machine(), "rows": rows})


if __name__ == "__main__":
    main()
