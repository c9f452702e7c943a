"""Our solvers beside SCIP, Gurobi, HiGHS and enumeration: time to proof, gap and memory.

Every run has a process of its own, and solvers take turns on each instance.  Costs are computed
anew from the schedules that the solvers return.  Fails, once all is written, if a schedule is
cheaper than our proved optimum or than our lower bound; never because of a time.

    python benchmarks/peers.py            # writes benchmarks/results/peers.md and peers.json
    python benchmarks/peers.py --quick    # the same in small, into a temporary folder
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Iterable, Iterator
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
from families import FAMILIES, MIXED_SIGNS, ONE_SIGN, arguments, instance
from measure import RESULTS, about, by, claim, machine, run_alone, save, seconds, table
from tqdm import tqdm

from modelselect import OPTIMALITY_GAP

Row = dict[str, Any]
SCIP = ("SCIP, one cone", "SCIP, split")
ENUMERABLE = 2**22


def plan(options: argparse.Namespace) -> list[Row]:
    """All measurements in order: the solvers take turns on every instance."""
    jobs = []
    for family in options.families:
        for seed in range(options.seeds):
            solvers = ["solve", *SCIP] + ["branch_and_bound"] * (family in ONE_SIGN)
            jobs += _jobs("full", family, seed, options.horizon, solvers, options.limit)
    for H in options.small_horizons:
        for family in options.families:
            solvers = ["solve", "branch_and_bound", *SCIP, "Gurobi", "milp (HiGHS), linearised"]
            solvers += ["enumerate_schedules"] * (8**H <= ENUMERABLE)
            jobs += _jobs("small", family, 0, H, solvers, options.small_limit)
    return jobs


def _jobs(
    part: str, family: str, seed: int, H: int, solvers: Iterable[str], limit: float
) -> list[Row]:
    shared = {"part": part, "family": family, "seed": seed, "H": H, "W": 8, "limit": limit}
    return [shared | {"solver": solver} for solver in solvers]


def run(jobs: list[Row], repeat: int, folder: str) -> list[Row]:
    """Measure all jobs; our solvers `repeat` times, the others once."""
    rows = []
    for job in tqdm(jobs, disable=None):
        file = Path(folder) / "{family}-{seed}-{H}.npz".format_map(job).replace("/", "-")
        if not file.exists():
            np.savez(file, **arguments(instance(job["family"], job["seed"], job["H"])))
        often = repeat if job["solver"] in ("solve", "branch_and_bound") else 1
        request = {"file": str(file), "solver": job["solver"], "limit": job["limit"]}
        answer = run_alone(
            "contenders.py", request | {"repeat": often}, often * (2 * job["limit"] + 60)
        )
        rows.append(job | {"closed": False} | answer)
    return rows


def compare(rows: list[Row]) -> None:
    """Add gaps to the rows.

    gap: between the recomputed cost and the solver's own bound.  excess: of the recomputed cost
    over the cost of `solve`.
    """
    for best, row in pairs(rows):
        row["excess"] = (row["cost"] - best["cost"]) / abs(best["cost"])
        if "bound" in row:
            largest = max(abs(row["cost"]), abs(row["bound"])) or 1.0
            row["gap"] = (row["cost"] - row["bound"]) / largest


def check(rows: list[Row]) -> None:
    """Hold every schedule found against our proofs."""
    for best, row in pairs(rows):
        rounding = OPTIMALITY_GAP * abs(best["cost"])
        where = f"{row['solver']} on {row['family']}, seed {row['seed']}, H = {row['H']}"
        assert best["bound"] <= row["cost"] + rounding, f"{where}: below our lower bound"
        proved = best["cost"] if best["closed"] else best["bound"]
        assert proved <= row["cost"] + rounding, f"{where}: below our proved optimum"


def pairs(rows: list[Row]) -> Iterator[tuple[Row, Row]]:
    """Every row with a schedule, beside that of `solve` on the same instance."""
    for group in by(rows, "part", "family", "seed", "H").values():
        best = next(row for row in group if row["solver"] == "solve")
        yield from ((best, row) for row in group if "cost" in row)


def part(rows: list[Row], name: str) -> list[Row]:
    return [row for row in rows if row["part"] == name]


# ------------------------------------------------------------------------------- the tables


def times(rows: list[Row]) -> str:
    """Median and largest time; "> 60" where the time limit cut it off."""
    known = sorted(row["seconds"] for row in rows if "seconds" in row)
    if not known:
        return "-"
    cut = any(not row["closed"] for row in rows)
    shown = [seconds(value) for value in (median(known), known[-1])]
    return shown[0] if shown[0] == shown[1] else f"{shown[0]} ({'>' * cut}{shown[1]})"


def largest(rows: list[Row], key: str, form: str = "{:.0e}") -> str:
    known = [row[key] for row in rows if key in row]
    missing = "none" if len(known) < len(rows) else ""
    return missing or form.format(max(max(known), 0))


def solver_row(label: Row, rows: list[Row]) -> dict[str, str]:
    """A line on one solver on one group of instances."""
    return {
        **{key: str(value) for key, value in label.items()},
        "seconds: median (longest)": times(rows),
        "closed": f"{sum(row['closed'] for row in rows)} of {len(rows)}",
        "largest gap": largest(rows, "gap"),
        "largest excess cost": largest(rows, "excess"),
        "memory, MB": largest(rows, "memory", "{:.0f}"),
        "remark": "; ".join(sorted({remark(row) for row in rows} - {""})),
    }


def remark(row: Row) -> str:
    """Why there is no time, if there is none."""
    return "" if "seconds" in row else row["status"]


def solver_table(rows: list[Row], key: str) -> str:
    """A line on every solver, for every family or size."""
    groups = by(rows, key, "solver")
    return table(
        [solver_row({key: value, "solver": s}, group) for (value, s), group in groups.items()]
    )


# ------------------------------------------------------------------------------- the claims


def faster_form(group: list[Row]) -> Row:
    """SCIP's better run on an instance: closed before open, then by time, then by gap."""
    forms = [row for row in group if row["solver"] in SCIP]
    return min(
        forms,
        key=lambda row: (
            not row["closed"],
            row["seconds"] if row["closed"] else row.get("gap", float("inf")),
        ),
    )


def duels(rows: list[Row]) -> list[Row]:
    """Ours against SCIP's better form on every full-size instance.

    Where SCIP was cut off it counts with the time it had: the ratio is then a lower bound.
    """
    answer = []
    for (family, _), group in by(part(rows, "full"), "family", "seed").items():
        mine = next(row for row in group if row["solver"] == "solve")
        scip = faster_form(group)
        ratio = scip.get("seconds", float("nan")) / mine["seconds"]
        answer.append({"family": family, "mine": mine, "scip": scip, "ratio": ratio})
    return answer


def headline(rows: list[Row]) -> str:
    """The table that README quotes: a line a family."""
    lines = []
    for (family,), group in by(duels(rows), "family").items():
        mine, scip = ([duel[side] for duel in group] for side in ("mine", "scip"))
        cut = ">= " * any(not row["closed"] for row in scip)
        lines.append(
            {
                "family": family,
                "ours, s": times(mine),
                "SCIP, s": times(scip),
                "times faster": f"{cut}{median(duel['ratio'] for duel in group):.0f}",
                "ours proved": f"{sum(row['closed'] for row in mine)} of {len(mine)}",
                "SCIP closed": f"{sum(row['closed'] for row in scip)} of {len(scip)}",
                "SCIP's gap": largest(scip, "gap"),
                "memory, MB: ours, SCIP": ", ".join(
                    largest(side, "memory", "{:.0f}") for side in (mine, scip)
                ),
            }
        )
    return table(lines)


def speed_claims(rows: list[Row], limit: float) -> list[dict[str, str]]:
    """How many times faster than SCIP; undecided where only a lower bound is known."""
    all_duels = duels(rows)
    family = {
        name: median(duel["ratio"] for duel in group)
        for (name,), group in by(all_duels, "family").items()
    }
    slowest = min(family, key=lambda name: family[name])
    least, settled = (
        family[slowest],
        all(d["scip"]["closed"] for d in all_duels if d["family"] == slowest),
    )
    unsolved = [duel["ratio"] for duel in all_duels if not duel["scip"]["closed"]]
    return [
        claim(
            "at least 10 times faster than SCIP (the faster of two forms) on every family",
            f"{least:.0f} times ({slowest})",
            least >= 10 if least >= 10 or settled else None,
        ),
        claim(
            f"at least 100 times where SCIP has not closed at {limit:g} s",
            f"{min(unsolved):.0f} times ({len(unsolved)} instances)" if unsolved else "closed all",
            min(unsolved) >= 100 if unsolved and limit >= 60 else None,
        ),
    ]


def claims(rows: list[Row], options: argparse.Namespace) -> list[dict[str, str]]:
    """What issue 3 promises, beside what was measured."""
    full = part(rows, "full")
    mine = [row for row in full if row["solver"] == "solve"]
    tree = [row for row in full if row["solver"] == "branch_and_bound"]
    longest = max(value for row in mine for value in row["all_seconds"])
    middle = max(median(row["seconds"] for row in group) for group in by(mine, "family").values())
    proved = sum(row["closed"] for row in mine)
    lines = [
        claim(
            f"H = {options.horizon}, W = 8: proof, relative gap at most 1e-9, on every instance",
            f"{proved} of {len(mine)}",
            proved == len(mine),
        ),
        claim("every family's median under 0.2 s", f"{seconds(middle)} s", middle < 0.2),
        claim("no run over 0.6 s", f"{seconds(longest)} s", longest <= 0.6),
        *speed_claims(rows, options.limit),
    ]
    if tree:
        slow = max(value for row in tree for value in row["all_seconds"])
        proved = sum(row["closed"] for row in tree)
        lines.append(
            claim(
                "branch and bound proves the one-sign instances, each under 30 s",
                f"{proved} of {len(tree)}, {seconds(slow)} s",
                proved == len(tree) and slow < 30,
            )
        )
    return lines


# --------------------------------------------------------------------------------- the report


def report(rows: list[Row], options: argparse.Namespace, facts: Row) -> str:
    sections = [
        "# Our solvers beside others\n",
        "Made by `benchmarks/peers.py`; costs are recomputed from the schedules.\n",
        "## Claims\n",
        table(claims(rows, options)),
        f"## H = {options.horizon}, W = 8, instances a family: {options.seeds}\n",
        headline(rows),
        "Each solver:\n",
        solver_table(part(rows, "full"), "family"),
        "## Sizes that the others hold, W = 8, one instance of each family\n",
        solver_table(part(rows, "small"), "H"),
        NOTES.format(repeat=options.repeat, limit=options.limit, small=options.small_limit),
        about(facts) + "\n",
    ]
    return "\n".join(sections)


NOTES = """\
*seconds*: the call to the solver alone, by the wall clock; median over instances and in brackets
the longest, where each instance counts with the median of {repeat} runs of ours and one run of
the others.  `>`: cut off by the time limit, {limit:g} s ({small:g} s for the smaller sizes).
*closed*: the solver itself claims a proof; ours at a relative gap of 1e-9, the others within their
feasibility tolerance of about 1e-6, hence their larger *gap*, which is the one between recomputed
cost and their bound.  *none*: no schedule was found on some instance.  *excess cost*: over the
cost of `solve`.  *memory*: peak of a process with nothing but this solver.

The others get the problem in units in which our first schedule costs 1 and the largest bias of
every step is 1.  SCIP: binaries b, d = sum b mu, z = U d with Psi = U'U, and min theta + l.b with
either one cone |z|^2 <= theta or a parabola z_k^2 <= theta_k for each row; the first table takes
the faster for every instance.  (With d'Psi d written out, SCIP found no schedule at H = 150 in
20 s.)  Gurobi: d'Psi d + l.b under its free licence, which holds 200 variables.  milp: a variable
for every product of binaries, by Adams and Sherali 1986, which closes more than McCormick's rows.
"""


def parse(arguments: list[str] | None = None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--families", nargs="+", choices=FAMILIES, default=FAMILIES)
    parser.add_argument("--horizon", type=int, default=150)
    parser.add_argument("--seeds", type=int, default=3, help="instances a family")
    parser.add_argument("--repeat", type=int, default=5, help="runs of our solvers, for a median")
    parser.add_argument("--limit", type=float, default=60, help="seconds, H = 150")
    parser.add_argument("--small-horizons", type=int, nargs="*", default=[7, 12, 20])
    parser.add_argument("--small-limit", type=float, default=20, help="seconds, smaller sizes")
    parser.add_argument("--output", type=Path, help="folder; default: results/ beside this script")
    parser.add_argument("--quick", action="store_true", help="a smoke test of under a minute")
    options = parser.parse_args(arguments)
    if options.quick:
        options.families = [ONE_SIGN[0], MIXED_SIGNS[-1]]
        options.seeds, options.repeat, options.limit, options.small_limit = 1, 2, 2, 2
        options.small_horizons = [7]
    return options


def main() -> None:
    options = parse()
    with tempfile.TemporaryDirectory() as folder:
        rows = run(plan(options), options.repeat, folder)
    compare(rows)
    facts = machine()
    text = report(rows, options, facts)
    print(text)
    quick = Path(tempfile.gettempdir()) / "modelselect-quick"
    output = options.output or (quick if options.quick else RESULTS)
    data = {"machine": facts, "claims": claims(rows, options), "rows": rows}
    save(output, "peers", text, data)
    check(rows)


if __name__ == "__main__":
    main()
