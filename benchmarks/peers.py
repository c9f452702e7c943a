"""Our solvers beside SCIP, Gurobi, HiGHS and enumeration: time to proof, gap and memory.

Every run has a process of its own, and solvers take turns on each instance.  Costs are computed
anew from the schedules that the solvers return.  Fails, once all is written, if a schedule is
cheaper than our proved optimum or than our lower bound; never because of a time.

    python benchmarks/peers.py                  # writes benchmarks/results/peers.md and peers.json
    python benchmarks/peers.py --constrained    # switches and budgets: constrained.md and .json
    python benchmarks/peers.py --quick          # either in small, into a temporary folder
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Iterable, Iterator
from itertools import product
from pathlib import Path
from statistics import median
from typing import Any

import families
import numpy as np
from families import (
    FAMILIES,
    KINDS,
    MIXED_SIGNS,
    ONE_SIGN,
    TEXTBOOK,
    arguments,
    constrained,
    instance,
)
from measure import RESULTS, about, by, claim, machine, run_alone, save, seconds, table
from tqdm import tqdm

from modelselect import OPTIMALITY_GAP, SelectionProblem

Row = dict[str, Any]
OURS = ("solve", "round_and_swap", "branch_and_bound")
SCIP = ("SCIP, one cone", "SCIP, split")
MILP = "milp (HiGHS), linearised"
ENUMERABLE = 2**22


def plan(options: argparse.Namespace) -> list[Row]:
    """All measurements in order: the solvers take turns on every instance."""
    if options.constrained:
        return _plan_constrained(options)
    jobs = []
    for family in options.families:
        for seed in range(options.seeds):
            solvers = ["solve", *SCIP] + ["branch_and_bound"] * (family in ONE_SIGN)
            jobs += _jobs("full", "", family, seed, options.horizon, solvers, options.limit)
    for H in options.small_horizons:
        for family in options.families:
            solvers = ["solve", "branch_and_bound", *SCIP, "Gurobi", MILP, *_enumerable(H)]
            jobs += _jobs("small", "", family, 0, H, solvers, options.small_limit)
    return jobs


def _plan_constrained(options: argparse.Namespace) -> list[Row]:
    """SCIP in the form that closes more of the instances without constraints."""
    jobs = []
    for kind, family in product(options.constrained, options.families):
        for seed in range(options.seeds):
            solvers = ["solve", "round_and_swap", SCIP[0]]
            jobs += _jobs("full", kind, family, seed, options.horizon, solvers, options.limit)
    for kind, H, family in product(options.constrained, options.small_horizons, options.families):
        solvers = ["solve", SCIP[0], MILP, *_enumerable(H)]
        jobs += _jobs("small", kind, family, 0, H, solvers, options.small_limit)
    return jobs


def _enumerable(H: int) -> list[str]:
    return ["enumerate_schedules"] * (8**H <= ENUMERABLE)


def _jobs(
    part: str, kind: str, family: str, seed: int, H: int, solvers: Iterable[str], limit: float
) -> list[Row]:
    shared = {"part": part, "kind": kind, "family": family, "seed": seed, "H": H, "W": 8}
    return [shared | {"limit": limit, "solver": solver} for solver in solvers]


def run(jobs: list[Row], repeat: int, folder: str) -> list[Row]:
    """Measure all jobs; our solvers `repeat` times, the others once."""
    rows = []
    for job in tqdm(jobs, disable=None):
        file = Path(folder) / "{kind}-{family}-{seed}-{H}.npz".format_map(job).replace("/", "-")
        if not file.exists():
            np.savez(file, **arguments(draw(job)))
        often = repeat if job["solver"] in OURS else 1
        request = {"file": str(file), "solver": job["solver"], "limit": job["limit"]}
        answer = run_alone(
            "contenders.py", request | {"repeat": often}, often * (2 * job["limit"] + 60)
        )
        rows.append(job | {"closed": False} | answer)
    return rows


def draw(job: Row) -> SelectionProblem:
    family, kind, seed, H = (job[key] for key in ("family", "kind", "seed", "H"))
    return constrained(family, kind, seed, H) if kind else instance(family, seed, H)


def compare(rows: list[Row]) -> None:
    """Add gaps to the rows.

    gap: between the recomputed cost and the solver's own bound.  excess: of the recomputed cost
    over the cost of `solve`.
    """
    for best, row in pairs(rows):
        excess = (row["cost"] - best["cost"]) / abs(best["cost"])
        row["excess"] = excess if abs(excess) > 1e-12 else 0.0  # else rounding
        if "bound" in row:
            largest = max(abs(row["cost"]), abs(row["bound"])) or 1.0
            row["gap"] = (row["cost"] - row["bound"]) / largest


def check(rows: list[Row]) -> None:
    """Hold every schedule found against our proofs."""
    for best, row in pairs(rows):
        rounding = OPTIMALITY_GAP * abs(best["cost"])
        where = (
            f"{row['solver']} on {row['kind']} {row['family']}, seed {row['seed']}, H = {row['H']}"
        )
        assert best["bound"] <= row["cost"] + rounding, f"{where}: below our lower bound"
        proved = best["cost"] if best["closed"] else best["bound"]
        assert proved <= row["cost"] + rounding, f"{where}: below our proved optimum"


def pairs(rows: list[Row]) -> Iterator[tuple[Row, Row]]:
    """Every row with a schedule, beside that of `solve` on the same instance."""
    for group in by(rows, "part", "kind", "family", "seed", "H").values():
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
    cut = min((row["seconds"] for row in rows if was_cut(row)), default=float("inf"))
    shown = [
        ("> " if value >= cut else "") + seconds(value) for value in (median(known), known[-1])
    ]
    return shown[0] if shown[0] == shown[1] else f"{shown[0]} ({shown[1]})"


def was_cut(row: Row) -> bool:
    return not row["closed"] and row.get("seconds", 0) >= 0.9 * row["limit"]


def largest(rows: list[Row], key: str, form: str = "{:.0e}") -> str:
    known = [row[key] for row in rows if key in row]
    missing = "none" if len(known) < len(rows) else ""
    return missing or form.format(max(max(known), 0))


def excess(rows: list[Row]) -> str:
    """The largest excess cost, after the least where that is a schedule better than ours."""
    least = min((row["excess"] for row in rows if "excess" in row), default=0)
    return f"{least:.0e} to " * (least < 0) + largest(rows, "excess")


def solver_row(label: Row, rows: list[Row]) -> dict[str, str]:
    """A line on one solver on one group of instances."""
    return {
        **{key: str(value) for key, value in label.items()},
        "seconds: median (longest)": times(rows),
        "closed": f"{sum(row['closed'] for row in rows)} of {len(rows)}",
        "largest gap": largest(rows, "gap"),
        "largest excess cost": excess(rows),
        "memory, MB": largest(rows, "memory", "{:.0f}"),
        "remark": "; ".join(sorted({remark(row) for row in rows} - {""})),
    }


def remark(row: Row) -> str:
    """Why there is no time or no cost, if there is none."""
    return "" if "seconds" in row and ("cost" in row or "choices" not in row) else row["status"]


def solver_table(rows: list[Row], *keys: str) -> str:
    """A line on every solver, for every family or size."""
    keys = (*keys, "solver")
    groups = by(rows, *keys)
    return table(
        [solver_row(dict(zip(keys, values, strict=True)), rows) for values, rows in groups.items()]
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
    for (kind, family, _), group in by(part(rows, "full"), "kind", "family", "seed").items():
        mine = next(row for row in group if row["solver"] == "solve")
        scip = faster_form(group)
        ratio = scip.get("seconds", float("nan")) / mine["seconds"]
        pair = {"mine": mine, "scip": scip, "ratio": ratio}
        answer.append({"kind": kind, "family": family} | pair)
    return answer


def factor(pairs: list[Row]) -> str:
    """The median ratio; one side cut off leaves a bound on it, both leave nothing."""
    cut = tuple(any(not duel[side]["closed"] for duel in pairs) for side in ("mine", "scip"))
    if all(cut):
        return "-"
    ratio = median(duel["ratio"] for duel in pairs)
    sign = {(False, False): "", (False, True): ">= ", (True, False): "<= "}[cut]
    return sign + (f"{ratio:.0f}" if ratio >= 10 else f"{ratio:.2g}")


def headline(rows: list[Row]) -> str:
    """The table that README quotes: a line a family."""
    lines = []
    for (kind, family), group in by(duels(rows), "kind", "family").items():
        mine, scip = ([duel[side] for duel in group] for side in ("mine", "scip"))
        line = {"kind": kind} if kind else {}
        line |= {
            "family": family,
            "ours, s": times(mine),
            "SCIP, s": times(scip),
            "times faster": factor(group),
            "ours proved": f"{sum(row['closed'] for row in mine)} of {len(mine)}",
            "SCIP closed": f"{sum(row['closed'] for row in scip)} of {len(scip)}",
            "SCIP's gap": largest(scip, "gap"),
            "memory, MB: ours, SCIP": ", ".join(
                largest(side, "memory", "{:.0f}") for side in (mine, scip)
            ),
        }
        if kind:
            line |= {
                "our gap": largest(mine, "gap"),
                "SCIP's excess cost": excess(scip),
                "labels": largest(mine, "labels", "{}"),
                "switches": f"{median(row['switches'] for row in mine):.0f}",
            }
        lines.append(line)
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
    extra = ("kind",) if options.constrained else ()
    if options.constrained:
        opening = [
            "# Switching costs and a budget\n",
            families.__doc__.split("\n\n")[-1],
            CONSTRAINED,
        ]
    else:
        opening = ["# Our solvers beside others\n", "## Claims\n", table(claims(rows, options))]
    opening.insert(1, "Made by `benchmarks/peers.py`; costs are recomputed from the schedules.\n")
    sections = [
        *opening,
        f"## H = {options.horizon}, W = 8, instances a family: {options.seeds}\n",
        headline(rows),
        "Each solver:\n",
        solver_table(part(rows, "full"), *extra, "family"),
        "## Sizes that the others hold, W = 8, one instance of each family\n",
        solver_table(part(rows, "small"), *extra, "H"),
        NOTES.format(repeat=options.repeat, limit=options.limit, small=options.small_limit),
        about(facts) + "\n",
    ]
    return "\n".join(sections)


CONSTRAINED = """\
SCIP takes switches as flows y[t, v, w] >= 0 between the binaries of adjacent steps, milp as its
products of those, and both a budget as one row.  SCIP runs in one form, that which closes more of
the families without constraints.  `round_and_swap`: what `solve` knows before it searches.
*labels*: most that a step of the search kept.  *times faster*: a bound where one of the two was cut
off, none where both were.
"""

NOTES = """\
*seconds*: the call to the solver alone, by the wall clock; median over instances and in brackets
the longest, where each instance counts with the median of {repeat} runs of ours, fewer where they
take the limit together, and one run of the others.  `>`: cut off by the time limit, {limit:g} s
({small:g} s for the smaller sizes).
*closed*: the solver itself claims a proof; ours at a relative gap of 1e-9, the others within their
feasibility tolerance of about 1e-6, hence their larger *gap*, which is the one between recomputed
cost and their bound.  *none*: no schedule was found on some instance.  *excess cost*: over the
cost of `solve`.  *memory*: peak of a process with nothing but this solver.

The others get the problem in units in which our first schedule costs 1 and the largest bias of
every step is 1.  SCIP: binaries b, d = sum b mu, z = U d with Psi = U'U, and min theta + l.b with
either one cone |z|^2 <= theta or a parabola z_k^2 <= theta_k for each row; where both ran, the
first table takes the faster for every instance.  (With d'Psi d written out, SCIP found no schedule
at H = 150 in 20 s.)  Its Ipopt orders matrices by AMD: METIS ends in a crash in pyscipopt 6.3.
Gurobi: d'Psi d + l.b under its free licence, which holds 200 variables.  milp: a variable for every
product of binaries, by Adams and Sherali 1986, which closes more than McCormick's rows.
"""


def parse(arguments: list[str] | None = None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "--constrained",
        nargs="*",
        choices=KINDS,
        metavar="KIND",
        help=f"with switching costs, a budget or both: of {', '.join(KINDS)}, all if none is named",
    )
    parser.add_argument("--families", nargs="+", choices=FAMILIES)
    parser.add_argument("--horizon", type=int, default=150)
    parser.add_argument("--seeds", type=int, default=3, help="instances a family")
    parser.add_argument("--repeat", type=int, default=5, help="runs of our solvers, for a median")
    parser.add_argument("--limit", type=float, default=60, help="seconds, H = 150")
    parser.add_argument("--small-horizons", type=int, nargs="*", help="default: 7 12 and maybe 20")
    parser.add_argument("--small-limit", type=float, default=20, help="seconds, smaller sizes")
    parser.add_argument("--output", type=Path, help="folder; default: results/ beside this script")
    parser.add_argument("--quick", action="store_true", help="a smoke test of under a minute")
    options = parser.parse_args(arguments)
    has_kinds = options.constrained is not None
    if has_kinds:
        options.constrained = options.constrained or KINDS
    if has_kinds and options.families and not set(options.families) <= set(TEXTBOOK):
        parser.error("--constrained: only of the textbook landing's families")
    if options.quick:
        options.families = [MIXED_SIGNS[-1]] if has_kinds else [ONE_SIGN[0], MIXED_SIGNS[-1]]
        options.seeds, options.repeat, options.limit, options.small_limit = 1, 2, 2, 2
        options.small_horizons = [4] if has_kinds else [7]
        options.horizon = 12 if has_kinds else options.horizon
    if options.families is None:
        options.families = TEXTBOOK if has_kinds else FAMILIES
    if options.small_horizons is None:
        options.small_horizons = [7, 12] if has_kinds else [7, 12, 20]
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
    data = {"machine": facts, "rows": rows}
    if not options.constrained:
        data["claims"] = claims(rows, options)
    save(output, "constrained" if options.constrained else "peers", text, data)
    check(rows)


if __name__ == "__main__":
    main()
