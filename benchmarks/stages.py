"""Learn by stages, and fly: which of them help, and is what a table promises kept?

    python benchmarks/stages.py --jobs 2      # writes results/stages.md, .csv and .png
    python benchmarks/stages.py --quick       # a smoke test

Networks are trained anew for each seed; each stage adds to the one before it: errors of held-out
pictures in bins, pooled by a kernel, calibrated networks, two rounds of labelled landings, a Kalman
filter on top.  All stages and policies of a seed fly through the same inputs and scenes.
"""

from __future__ import annotations

import argparse
import csv
from pathlib import Path
from time import perf_counter
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from joblib import Parallel, delayed
from measure import about, machine, table
from tqdm import tqdm

import landing
import perception
from landing import Settings, run_experiment
from modelselect_parts import flights, pooling
from modelselect_parts.tables import undecided

HERE = Path(__file__).resolve().parent
LEARNED: dict[str, Any] = {"calibrate": True, "rounds": 2}
#: A run for each stage of the table: which of its stages is flown is the last.
STAGES: dict[str, dict[str, Any]] = {
    "bins": {"fit": "bins"},
    "kernel": {},
    "calibrated": {"calibrate": True},
    "on-policy": LEARNED,
    "filter": LEARNED | {"information": "filter"},
}
TINY = {"architecture": perception.ARCHITECTURE[:3], "training": 320, "held_out": 300, "epochs": 4}
RIVALS = ("Best Single", "Greedy")


def flown(seed: int, trials: int, quick: bool = False) -> list[dict[str, Any]]:
    """Train the networks of a seed, and fly what is best at every stage: a row for each."""
    trained = landing.learn(seed, **TINY if quick else {})
    steps = 8 if quick else 150
    base = Settings("trained", horizon=steps, seed=seed, **landing.DEFAULTS["trained"])
    price: dict[str, float] = {}  # that of the kernel's suite, at all stages of a pattern
    rows = []
    for stage, changes in STAGES.items():
        run = Settings(**vars(base) | changes | {"trials": 1})  # Clairvoyant solves each
        if run.information not in price:
            plain = Settings(**vars(run) | {"fit": "kernel", "calibrate": False, "rounds": 0})
            price[run.information] = run_experiment(plain, trained=trained).settings.upsilon
        run = Settings(**vars(run) | {"upsilon": price[run.information]})
        rows.append({"seed": seed, "stage": stage, **measured(run, trained, trials)})
    return rows


def measured(run: Settings, trained: perception.Trained, trials: int) -> dict[str, Any]:
    """Return what a run promises, and what comes of it in four ways."""
    result = run_experiment(run, trained=trained)
    last = result.stages[-1]
    result = landing.replace(result, stages=(last,))
    (by_sight,) = landing.fly_stages(result, trials).values()
    _, inputs, gaussian, _, bootstrap = np.random.default_rng(run.seed).spawn(5)
    s = result.landing.draw_inputs(inputs, trials)
    seen, path = last.skill.seen, result.landing.path[:-1]
    drawn = (
        perception.sample_errors(result.suite, trials, gaussian),
        pooling.redraw(seen, path, trials, bootstrap, landing.FITS[run.fit]),
    )
    given = result.landing, run.information, s
    ideal = landing.fly(*given, drawn[0], None, last.gains)[1]
    by_table, by_pictures = (
        (landing.fly(*given, errors, result.optimal.choices, last.gains)[1] - ideal).mean()
        for errors in drawn
    )
    row = {"promised": by_sight.promised, "Gaussian": by_table, "bootstrap": by_pictures}
    row["labelled"] = by_sight.labelled.mean() if len(by_sight.labelled) else ""
    row["flown"] = by_sight.lost["Optimal"].mean()
    row["flown/promised"] = row["flown"] / row["promised"]
    row["total"] = by_sight.totals["Optimal"].mean()
    for policy, (lead, half) in flights.leads(by_sight.totals).items():
        row |= {f"below {policy}": lead, f"half of its interval, {policy}": half}
        row[f"total of {policy}"] = by_sight.totals[policy].mean()
    return row


def over_seeds(rows: list[dict[str, Any]], name: str, unit: float = 1.0, digits: int = 0) -> str:
    """Return the mean over seeds and half of its 95% t-interval."""
    mean, half = flights.estimate(unit * np.array([float(row[name]) for row in rows]))[0]
    mark = " undecided" if name.startswith("below") and undecided(mean, half) else ""
    return f"{mean:.{digits}f} ± {half:.{digits}f}{mark}"


def lines(rows: list[dict[str, Any]]) -> list[dict[str, str]]:
    """A line for every stage."""
    found = []
    for stage in STAGES:
        group = [row for row in rows if row["stage"] == stage]
        line = {"stage": stage}
        line |= {k: over_seeds(group, k) for k in ("promised", "Gaussian", "bootstrap")}
        line["labelled"] = over_seeds(group, "labelled") if group[0]["labelled"] != "" else ""
        line["flown"] = over_seeds(group, "flown")
        line["flown / promised"] = over_seeds(group, "flown/promised", digits=2)
        line["total"] = over_seeds(group, "total")
        for policy in RIVALS:
            line[f"below {policy}, %"] = over_seeds(group, f"below {policy}", 100, 1)
        found.append(line)
    return found


def one_by_one(rows: list[dict[str, Any]]) -> list[dict[str, str]]:
    """A line for every stage and rival: the lead in each seed, with its paired interval."""
    found = []
    for stage in STAGES:
        for policy in RIVALS:
            line = {"stage": stage, "Optimal below": policy}
            for row in rows:
                if row["stage"] == stage:
                    mean = 100 * row[f"below {policy}"]
                    half = 100 * row[f"half of its interval, {policy}"]
                    mark = " undecided" if undecided(mean, half) else ""
                    line[f"seed {row['seed']}"] = f"{mean:.1f} ± {half:.1f}{mark}"
            found.append(line)
    return found


def picture(rows: list[dict[str, Any]]) -> plt.Figure:
    """Draw what was promised and flown, the total, and the lead over the best single model."""
    figure, axes = plt.subplots(1, 3, figsize=(12.5, 4.2), constrained_layout=True)
    place = np.arange(len(STAGES))

    def draw(ax: Any, name: str, label: str, marker: str, shift: float = 0.0) -> None:
        groups = [[float(r[name]) for r in rows if r["stage"] == stage] for stage in STAGES]
        for seed in range(len(groups[0])):
            values = [group[seed] for group in groups]
            style = {"color": marker[0] + marker[1], "alpha": 0.35, "ms": 4}
            ax.plot(place + shift, values, marker[2], **style)
        means, halves = np.array([flights.estimate(np.array(group))[0] for group in groups]).T
        style = {"color": marker[:2], "capsize": 4, "label": label, "lw": 1.5}
        ax.errorbar(place + shift, means, halves, fmt=marker[2], **style)

    draw(axes[0], "promised", "promised", "C7s", -0.1)
    draw(axes[0], "flown", "flown", "C0o", 0.1)
    axes[0].set(yscale="log", title="Regret of Optimal", ylabel="control cost beyond no error")
    for policy, marker, shift in (("Best Single", "C1^", 0.15), ("Greedy", "C2D", 0.0)):
        draw(axes[1], f"total of {policy}", policy, marker, shift)
    draw(axes[1], "total", "Optimal", "C0o", -0.15)
    axes[1].set(yscale="log", title="Total cost in flight", ylabel="α regret + β perception")
    for policy, marker, shift in (("Best Single", "C1^", 0.1), ("Greedy", "C2D", -0.1)):
        leads = [dict(row) | {"lead": 100 * row[f"below {policy}"]} for row in rows]
        groups = [[r["lead"] for r in leads if r["stage"] == stage] for stage in STAGES]
        means, halves = np.array([flights.estimate(np.array(group))[0] for group in groups]).T
        style = {"color": marker[:2], "capsize": 4, "label": f"below {policy}", "lw": 1.5}
        axes[2].errorbar(place + shift, means, halves, fmt=marker[2], **style)
    axes[2].axhline(0, color="0.5", lw=1)
    axes[2].set(title="How far Optimal's total lies below", ylabel="%")
    for ax in axes:
        ax.set_xticks(place, list(STAGES), rotation=20)
        ax.grid(axis="y", alpha=0.3)
        ax.legend()
    return figure


NOTES = """\
{seeds} training seeds, {trials} landings each by sight; {minutes:.0f} minutes in {jobs} processes.
Means over seeds ± 95% t-intervals.

*promised*: regret of Optimal by its table.  *Gaussian*, *bootstrap*: flown with errors drawn from
that table, and from the pictures it was made of.  *labelled*: e'Psi e of the errors noted in
labelled landings, whose scene stays the same all the way.  *flown*: by sight.  *total*: alpha
regret + beta perception cost, at prices that are the same at all stages of a pattern.  *below*: by
what share Optimal's flown total is lower; *undecided*: the interval contains 0.  The last stage has
a pattern of its own (`filter` instead of `measurement`), so its prices are others, too.
"""


def main() -> None:
    parser = argparse.ArgumentParser(description="Learn by stages, and fly.")
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--trials", type=int, default=1000)
    parser.add_argument("--jobs", type=int, default=1, help="processes; the digits are the same")
    parser.add_argument("--quick", action="store_true", help="a smoke test of seconds")
    parser.add_argument("--output", type=Path, default=HERE / "results")
    options = parser.parse_args()
    seeds, trials = (2, 4) if options.quick else (options.seeds, options.trials)
    started = perf_counter()
    work = (delayed(flown)(seed, trials, options.quick) for seed in range(seeds))
    done = Parallel(n_jobs=options.jobs, return_as="generator")(work)
    rows = [row for group in tqdm(done, total=seeds, disable=None) for row in group]
    minutes = (perf_counter() - started) / 60
    options.output.mkdir(parents=True, exist_ok=True)
    with open(options.output / "stages.csv", "w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, list(rows[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
    given = {"seeds": seeds, "trials": trials, "jobs": options.jobs, "minutes": minutes}
    parts = ["# Learning by stages, and what is kept of it in flight"]
    parts += ["Made by `benchmarks/stages.py`.", table(lines(rows)), NOTES.format(**given).rstrip()]
    parts += ["Optimal's lead in every seed, with the interval of its paired flights, in %:"]
    parts += [table(one_by_one(rows)), about(machine())]
    (options.output / "stages.md").write_text("\n\n".join(parts) + "\n", encoding="utf-8")
    picture(rows).savefig(options.output / "stages.png", dpi=110)


if __name__ == "__main__":
    main()
