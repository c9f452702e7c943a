"""Choose among the settings of a real detector, and fly: does choosing pay?

    python benchmarks/detectors.py            # writes results/detectors.md, .csv and .png
    python benchmarks/detectors.py --quick    # a smoke test

Errors are those of notebooks/data/tags.csv: fitted on a random half of the views, flown on the
other half, in several splits; each split flies all policies through the same inputs.
"""

from __future__ import annotations

import argparse
import csv
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from measure import about, machine, table
from tqdm import tqdm

import landing
import modelselect as ms
import perception
from modelselect_parts import measured
from modelselect_parts.flights import estimate
from modelselect_parts.rivals import policies
from modelselect_parts.sight import gains_for
from modelselect_parts.tables import undecided

HERE = Path(__file__).resolve().parent
FILE = HERE.parent / "notebooks" / "data" / "tags.csv"
PATTERNS = ("filter", "preview", "measurement", "open_loop")
LEVELS = (0.3, 1.0, 3.0)
POLICIES = ("Optimal", "Best Single", "Greedy")


def flown(information: str, level: float, split: int, trials: int) -> dict[str, Any]:
    """Fit on half of the views, choose, and fly on the others."""
    rng = np.random.default_rng([split, 7])
    aircraft = landing.preset("textbook")
    table_of_views = perception.read_residuals(FILE, NAMES)
    fitted, sights = measured.halves(table_of_views, rng)
    suite = measured.suite_along(fitted, aircraft.path[:-1], measured.latencies(table_of_views))
    gains = gains_for(aircraft, information, suite)
    Psi = ms.psi(aircraft.task, information, gains=gains)
    beta = level * one_to_one(Psi, suite)
    problem = ms.SelectionProblem.from_suite(Psi, suite, beta=beta)
    s = aircraft.draw_inputs(rng, trials)
    optimal = ms.solve(problem, time_limit=60).choices
    chosen = policies(problem, optimal, [], rng)
    chosen, totals, ratio = {k: chosen[k] for k in POLICIES}, {}, 0.0
    for policy, c in chosen.items():
        cost = measured.regret(aircraft, information, gains, sights, c, s, split)
        totals[policy] = cost + beta * float(problem.perception_term(c))
        if policy == "Optimal":
            ratio = float(problem.control_term(c)) / cost.mean()
    predicted = {k: float(problem.total_cost(c)) for k, c in chosen.items()}
    row = {"information": information, "level": level, "split": split, "predicted/flown": ratio}
    row["switches"] = int(np.count_nonzero(np.diff(chosen["Optimal"])))
    row["models"] = len(set(chosen["Optimal"].tolist()))
    for policy, total in totals.items():
        if policy != "Optimal":
            row[f"promised {policy}"] = 1 - predicted["Optimal"] / predicted[policy]
            row[f"saved {policy}"] = 1 - totals["Optimal"].mean() / total.mean()
    return row


NAMES = ["0.25 none", "0.5 subpixel", "0.5 apriltag", "1 none", "1 subpixel", "1 apriltag"]


def one_to_one(Psi: np.ndarray, suite: perception.PerceptionSuite) -> float:
    """Return the weight beta at which looking costs as much as erring.

    Of the constant schedules: the mean of what they pay, the median of what their errors cost.
    """
    problem = ms.SelectionProblem.from_suite(Psi, suite)
    H, W, _ = problem.mean.shape
    constant = np.repeat(np.arange(W)[:, None], H, axis=1)
    paid, lost = problem.perception_term(constant), problem.control_term(constant)
    return float(np.median(lost) / paid[np.isfinite(paid)].mean())


def interval(rows: list[dict[str, Any]], name: str, unit: float = 100.0) -> str:
    """Return the mean over splits and half of its 95% t-interval, or what it leaves undecided."""
    mean, half = estimate(unit * np.array([row[name] for row in rows]))[0]
    mark = " undecided" if unit == 100 and undecided(mean, half) else ""
    return f"{mean:.{1 if unit == 100 else 2}f} ± {half:.{1 if unit == 100 else 2}f}{mark}"


def lines(rows: list[dict[str, Any]]) -> list[dict[str, str]]:
    """A line for every pattern and level of price."""
    found = []
    for information in PATTERNS:
        for level in LEVELS:
            group = [r for r in rows if (r["information"], r["level"]) == (information, level)]
            if group:
                line = {"pattern": information, "price level": f"{level:g}"}
                for policy in ("Best Single", "Greedy"):
                    line[f"below {policy}, promised, %"] = interval(group, f"promised {policy}")
                    line[f"below {policy}, flown, %"] = interval(group, f"saved {policy}")
                line["promised / flown regret"] = interval(group, "predicted/flown", 1.0)
                for name in ("models", "switches"):
                    line[name] = f"{np.mean([row[name] for row in group]):.1f}"
                found.append(line)
    return found


def picture(rows: list[dict[str, Any]]) -> plt.Figure:
    """Draw what Optimal's flown total lies below the others', with intervals over splits."""
    figure, axes = plt.subplots(1, 2, figsize=(10, 4.2), sharey=True, constrained_layout=True)
    place = {p: i for i, p in enumerate(PATTERNS)}
    for ax, policy in zip(axes, ("Best Single", "Greedy"), strict=True):
        for k, (level, marker) in enumerate(zip(LEVELS, "so^", strict=True)):
            for information, i in place.items():
                group = [r for r in rows if (r["information"], r["level"]) == (information, level)]
                if group:
                    saved = np.array([100 * r[f"saved {policy}"] for r in group])
                    mean, half = estimate(saved)[0]
                    label = f"price level {level:g}" if i == 0 else None
                    style = {"fmt": marker, "color": f"C{k}", "capsize": 4, "label": label}
                    ax.errorbar(i + 0.18 * (k - 1), mean, half, **style)
        ax.axhline(0, color="0.5", lw=1)
        ax.set_xticks(range(len(PATTERNS)), PATTERNS)
        ax.set_title(f"Optimal beside {policy}")
        ax.grid(axis="y", alpha=0.3)
    axes[0].set_ylabel("total cost saved in flight, %")
    axes[0].legend()
    return figure


NOTES = """\
OpenCV's AprilTag detector at six settings on {views} rendered views of a pad
(notebooks/data/tags.py), fitted by a kernel on half of the views and flown by {trials} landings of
the textbook aircraft on the others, in {splits} random splits.  Errors are those of views near
where the aircraft is, so they act back on its state; patterns with a forecast get theirs
beforehand.  Where nothing is detected a prior of {prior:g} ft acts.  Prices are the median
milliseconds; at level 1 the constant schedules pay on average as much for looking as the median one
loses by erring.

*below*: by what share Optimal's total is lower, of what errors cost the controller and what looking
costs; mean over splits and 95% t-interval.  *undecided*: it contains 0.
"""


def main() -> None:
    parser = argparse.ArgumentParser(description="Fly on a detector's errors.")
    parser.add_argument("--splits", type=int, default=8)
    parser.add_argument("--trials", type=int, default=1000)
    parser.add_argument("--quick", action="store_true", help="a smoke test of seconds")
    parser.add_argument("--output", type=Path, default=HERE / "results")
    options = parser.parse_args()
    splits, trials = (2, 50) if options.quick else (options.splits, options.trials)
    levels = LEVELS[1:2] if options.quick else LEVELS
    work = [(p, level, k) for p in PATTERNS for level in levels for k in range(splits)]
    rows = [flown(*which, trials) for which in tqdm(work, disable=None)]
    options.output.mkdir(parents=True, exist_ok=True)
    with open(options.output / "detectors.csv", "w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, list(rows[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
    given = {"views": 1600, "trials": trials, "splits": splits, "prior": measured.PRIOR}
    parts = [
        "# Choosing among the settings of a real detector",
        "Made by `benchmarks/detectors.py`.",
    ]
    parts += [table(lines(rows)), NOTES.format(**given).rstrip(), about(machine())]
    (options.output / "detectors.md").write_text("\n\n".join(parts) + "\n", encoding="utf-8")
    picture(rows).savefig(options.output / "detectors.png", dpi=110)


if __name__ == "__main__":
    main()
