"""How fast schedules are found and proved where errors correlate over time.

The textbook aircraft plans once (`open_loop`).  Model w has white errors of variance 0.49^w ft^2
and a bias of variance tau_w^2 = 2.25 x 0.49^w ft^2 that nobody knows (`persistent`), or errors of
both variances together that follow AR(1) with rho = 0.9.  Seed 0 has just these tau, others each
tau up to 20% off.  The dearest model costs 6% of what white errors of 1 ft^2 throughout cost.

    python benchmarks/correlated.py            # writes benchmarks/results/correlated.{md,json}
    python benchmarks/correlated.py --quick    # the same in small, into a temporary folder
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Sequence
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np
from measure import RESULTS, about, by, claim, machine, save, seconds, table
from tqdm import tqdm

from landing import preset
from modelselect import (
    SelectionProblem,
    autoregressive_errors,
    correlated_cost,
    correlated_problem,
    persistent_bias,
    psi,
    round_and_swap,
    solve,
)

Row = dict[str, Any]
KINDS = ("persistent", "AR(1)")


def instance(kind: str, seed: int, H: int, W: int) -> tuple[SelectionProblem, np.ndarray]:
    """The problem as it is if errors were independent, and their covariance."""
    off = np.random.default_rng(seed).uniform(0.8, 1.2, W) if seed else np.ones(W)
    lasting = 2.25 * 0.49 ** np.arange(W) * off**2
    white = np.tile(0.49 ** np.arange(W)[:, None], (H, 1, 1))
    Psi, variance = psi(preset("textbook", H).task, "open_loop"), white + lasting[:, None]
    price = 0.06 * Psi.trace() * (np.arange(W) / (W - 1)) ** 1.5
    problem = SelectionProblem(Psi, 0 * white, variance, price)
    if kind == "persistent":
        return problem, persistent_bias(lasting, white)
    return problem, autoregressive_errors(variance, 0.9)


def run(kind: str, seed: int, H: int, W: int, limit: float) -> Row:
    problem, Cov = instance(kind, seed, H, W)
    started = perf_counter()
    lifted = correlated_problem(problem, Cov)
    posed = perf_counter()
    quick = round_and_swap(lifted)
    swapped = perf_counter()
    schedule = solve(lifted, time_limit=limit)
    solved = perf_counter()
    always = np.repeat(np.arange(W)[:, None], H, axis=1)
    single = correlated_cost(problem, always, Cov).min()
    believed = correlated_cost(problem, solve(problem).choices, Cov)
    row = {"kind": kind, "seed": seed, "H": H, "W": W, "pose": posed - started}
    row |= {"swap": swapped - posed, "swapped gap": quick.gap, "solve": solved - swapped}
    row |= {"proved": schedule.is_optimal, "gap": schedule.gap, "cost": schedule.cost}
    row |= {"root gap": (schedule.cost - schedule.root_bound) / schedule.cost}
    row |= {"single": single / schedule.cost, "believed": believed / schedule.cost}
    return row | {"models": len(set(schedule.choices.tolist()))}


def printed(row: Row) -> dict[str, str]:
    gap = "proved" if row["proved"] else f"{row['gap']:.2%}"
    return {
        "errors": row["kind"],
        "H, W": f"{row['H']}, {row['W']}",
        "seed": str(row["seed"]),
        "pose, s": seconds(row["pose"]),
        "round and swap, s": seconds(row["swap"]),
        "its gap": f"{row['swapped gap']:.2%}",
        "solve, s": seconds(row["solve"]),
        "gap": gap,
        "gap at the root": f"{row['root gap']:.2%}",
        "models used": str(row["models"]),
        "best single model": f"{row['single']:.2f}",
        "optimum for independent errors": f"{row['believed']:.2f}",
    }


def claims(rows: list[Row]) -> list[dict[str, str]]:
    """What we set out to reach with persistent biases; sizes that were not run cannot tell."""
    lasting = by([row for row in rows if row["kind"] == "persistent"], "H", "W")
    small, large = lasting.get((50, 3), []), lasting.get((150, 8), [])
    sizes = {"just these tau": small[:1], "tau up to 20% off": small[1:]}
    return [
        claim(
            f"persistent bias, H = 50, W = 3, {name}: proved in under 1 s",
            ", ".join(f"{row['solve']:.2g} s" for row in found),
            all(row["proved"] and row["solve"] < 1 for row in found) if found else None,
        )
        for name, found in sizes.items()
    ] + [
        claim(
            "persistent bias, H = 150, W = 8: a gap below 0.1% in 30 s",
            ", ".join(f"{row['gap']:.2%}" for row in large),
            all(row["gap"] < 1e-3 for row in large) if large else None,
        ),
    ]


def written(rows: list[Row], facts: dict[str, Any]) -> str:
    """The tables."""
    text = "# Errors that correlate over time\n\n" + table([printed(row) for row in rows])
    text += "\nThe last two columns are costs, by that of the best schedule found.\n\n"
    return text + table(claims(rows)) + "\n" + about(facts) + "\n"


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--quick", action="store_true", help="small sizes, a temporary folder")
    parser.add_argument("--limit", type=float, default=30.0, help="seconds of solve")
    parser.add_argument("--output", type=Path, help="folder for the tables")
    options = parser.parse_args(arguments)
    points = [(kind, seed, 50, 3) for kind in KINDS for seed in range(3)]
    points += [(kind, 0, 150, 8) for kind in KINDS]
    if options.quick:
        points = [(kind, 0, 12, 2) for kind in KINDS]
    rows = [run(*point, options.limit) for point in tqdm(points, disable=None)]
    folder = options.output or (Path(tempfile.mkdtemp()) if options.quick else RESULTS)
    facts = machine()
    save(folder, "correlated", written(rows, facts), {"machine": facts, "rows": rows})
    print(f"wrote {folder / 'correlated.md'}")


if __name__ == "__main__":
    main()
