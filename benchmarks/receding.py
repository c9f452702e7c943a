"""Planning anew at every step: how long a plan of H steps takes, and what a limit leaves unproved.

A landing of the textbook aircraft in 150 steps, planned anew at every second one over the next H,
with the models that `families.textbook_suite` draws.

    python benchmarks/receding.py            # writes benchmarks/results/receding.{md,json}
    python benchmarks/receding.py --quick    # the same in small, into a temporary folder
"""

from __future__ import annotations

import argparse
import tempfile
from dataclasses import replace
from itertools import product
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np
from families import ALPHA, BETA, SIGNS, task, textbook_suite
from measure import RESULTS, about, by, machine, save, table
from tqdm import tqdm

from landing import cost_scale
from modelselect import SelectionProblem, psi, receding_horizon, solve

Row = dict[str, Any]
KNOWN = ("open_loop", "preview")
LIMITS = (20, 50)  # milliseconds
STEPS = 150


def windows(family: str, p: int, switching: bool, H: int, W: int) -> list[SelectionProblem]:
    """The problems of the next H steps, at every second step of a landing."""
    landing, known = task(family, STEPS, p)
    Psi = psi(replace(landing, horizon=H), known)
    suite = textbook_suite(family.split("/")[1], np.random.default_rng(0), STEPS, W, p)
    head = replace(suite, mean=suite.mean[:H], variance=suite.variance[:H])
    price = cost_scale(Psi, head) * suite.cost
    first = SelectionProblem(Psi, head.mean, head.variance, price, ALPHA, BETA)
    if switching:
        cost = 0.02 * solve(first).cost / BETA
        first = replace(first, switch_cost=cost * (1 - np.eye(W)), initial_model=0)
    parts = (slice(t, t + H) for t in range(0, STEPS - H + 1, 2))
    return [replace(first, mean=suite.mean[k], variance=suite.variance[k]) for k in parts]


def measured(family: str, p: int, switching: bool, H: int, W: int, plans: int) -> Row:
    """Fly a landing: milliseconds of every plan, and how many of them limits leave unproved."""
    problems = windows(family, p, switching, H, W)[:plans]
    times, proved = flown(problems, None)
    if not proved.all():
        raise AssertionError(f"{family}: a plan without a limit is not proved")
    row: Row = {"family": family, "p": p, "switching": switching, "milliseconds": times.tolist()}
    for limit in LIMITS:
        times, proved = flown(problems, limit / 1e3)
        row[f"limit {limit} ms"] = [int(proved.sum()), int((proved & (times <= limit)).sum())]
    return row


def flown(problems: list[SelectionProblem], limit: float | None) -> tuple[np.ndarray, np.ndarray]:
    """Return how many milliseconds every plan takes, and whether it is proved."""
    plans = receding_horizon(problems.__getitem__, len(problems), time_limit=limit)
    times, proved = [], []
    for _ in problems:
        started = perf_counter()
        proved.append(next(plans).is_optimal)
        times.append(1e3 * (perf_counter() - started))
    return np.array(times), np.array(proved)


def lines(rows: list[Row]) -> list[dict[str, str]]:
    """A line for p, switching, and whether signs are mixed: all plans of its families."""
    answer = []
    mixed = [row | {"signs": "same" if "same" in row["family"] else "mixed"} for row in rows]
    for (p, switching, signs), group in by(mixed, "p", "switching", "signs").items():
        times = np.concatenate([row["milliseconds"] for row in group])
        line = {"p": str(p), "switching": "yes" if switching else "no", "signs": signs}
        line["plans"] = str(len(times))
        marks = {"median, ms": 50, "90%, ms": 90, "longest, ms": 100}
        line |= {name: f"{np.percentile(times, q):.1f}" for name, q in marks.items()}
        for limit in LIMITS:
            proved, in_time = np.sum([row[f"limit {limit} ms"] for row in group], axis=0)
            line[f"proved at a limit of {limit} ms"] = f"{100 * proved / len(times):.0f}%"
            line[f"and within {limit} ms"] = f"{100 * in_time / len(times):.0f}%"
        answer.append(line)
    return answer


NOTES = """\
H = {H} steps, W = {W} models; the textbook landing in 150 steps, planned anew at every second one,
with open_loop and preview, all signs; switching costs 2% of the first plan's cost.  Times of whole
plans without a limit, relaxation included, Psi given; all of them are proved.  A limit is looked at
between steps of the search, which finishes on a narrow beam: some plans are proved a little late.
"""


def parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--horizon", dest="H", type=int, default=50)
    parser.add_argument("--models", dest="W", type=int, default=5)
    parser.add_argument("--components", type=int, nargs="+", choices=(1, 2, 3), default=(1, 2))
    parser.add_argument("--plans", type=int, default=STEPS, help="at most, a landing")
    parser.add_argument("--output", type=Path, help="folder; default: results/ beside this script")
    parser.add_argument("--quick", action="store_true", help="a smoke test of some seconds")
    options = parser.parse_args()
    if options.quick:
        options.H, options.W, options.components, options.plans = 10, 3, [2], 2
    return options


def main() -> None:
    options = parse()
    families = [f"{known}/{signs}" for known in KNOWN for signs in SIGNS]
    points = list(product(families, options.components, (False, True)))
    limits = (options.H, options.W, options.plans)
    rows = [measured(*point, *limits) for point in tqdm(points, disable=None)]
    facts = machine()
    sections = ["# Planning anew\n", "Made by `benchmarks/receding.py`.\n", table(lines(rows))]
    text = "\n".join([*sections, NOTES.format(**vars(options)), about(facts) + "\n"])
    print(text)
    quick = Path(tempfile.gettempdir()) / "modelselect-quick"
    output = options.output or (quick if options.quick else RESULTS)
    save(output, "receding", text, {"machine": facts, "rows": rows})


if __name__ == "__main__":
    main()
