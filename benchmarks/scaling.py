"""How time and memory grow with the horizon H, the models W and the components p.

Every point has a process of its own, which draws the problem and times Psi, the relaxation and
`solve` (Psi given, relaxation included).

    python benchmarks/scaling.py            # writes benchmarks/results/scaling.{md,json,png}
    python benchmarks/scaling.py --quick    # the same in small, into a temporary folder
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Sequence
from pathlib import Path
from statistics import median
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from families import FAMILIES, LONG, MIXED_SIGNS
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from measure import (
    RESULTS,
    about,
    by,
    claim,
    machine,
    run_alone,
    save,
    seconds,
    table,
)
from tqdm import tqdm

from modelselect import WIDTHS

Row = dict[str, Any]
STAGES = {"psi": "Ψ", "relax": "relaxation", "solve": "solve"}
HORIZONS = (25, 50, 100, 150, 300, 600, 1000, 2000)
LONG_HORIZONS = (1200, 2500, 5000, 10_000)  # without a matrix
FLAT = 1.5  # what grows less over these is called flat; instances of one size differ by more
MODELS = (2, 4, 8, 16, 32)
COMPONENTS = (1, 2, 3)
HARDEST = "preview/model"  # of the families at H = 150: its root gap is the largest
PUBLISHED_LIMIT = 1000  # longer, the published aircraft is too unstable for doubles


# ------------------------------------------------------------------------------- the points


def plan(options: argparse.Namespace) -> list[Row]:
    """All points: H by family at W = 8, p = 1; then W by p at H = 150."""
    points = [
        {"family": family, "H": H, "W": 8, "p": 1}
        for family in options.families
        for H in options.horizons
        if family != "published" or H <= PUBLISHED_LIMIT
    ]
    points += [
        {"family": HARDEST, "H": options.middle, "W": W, "p": p}
        for p in options.components
        for W in options.models
    ]
    unique = {tuple(point.values()): point for point in points}
    limits = {"limit": options.limit, "repeat": options.repeat}
    points = [
        point | {"seed": seed} | limits
        for point in unique.values()
        for seed in range(options.seeds)
    ]
    return points + [
        {"family": family, "H": H, "W": 8, "p": 1, "seed": seed} | limits | {"repeat": 1}
        for family in LONG
        for H in options.long_horizons
        for seed in range(options.long_seeds)
    ]


def run(points: list[Row]) -> list[Row]:
    rows = []
    for point in tqdm(points, disable=None):
        timeout = point["repeat"] * (3 * point["limit"] + 60)
        rows.append(point | {"proved": False} | run_alone("point.py", point, timeout))
    return rows


# -------------------------------------------------------------------------------- the table


def middle(rows: list[Row], key: str) -> float:
    return median(row[key] for row in rows if key in row)


def lines(rows: list[Row]) -> list[dict[str, str]]:
    """A line a point: medians over seeds, but the largest of labels and memory."""
    answer = []
    for (family, H, W, p), points in by(rows, "family", "H", "W", "p").items():
        line = {"family": family, "H": str(H), "W": str(W), "p": str(p)}
        measured = [row for row in points if "solve" in row]
        if measured:
            line |= {f"{name}, s": seconds(middle(measured, s)) for s, name in STAGES.items()}
            line["longest solve, s"] = seconds(max(row["longest"] for row in measured))
            line["labels"] = str(max(row["labels"] for row in measured))
            line["labels a step"] = f"{middle(measured, 'labels a step'):.0f}"
            line["memory, MB"] = f"{max(row['memory'] for row in measured):.0f}"
            line["proved"] = f"{sum(row['proved'] for row in points)} of {len(points)}"
        else:
            line["Ψ, s"] = points[0]["status"]
        answer.append(line)
    header = max(answer, key=len)
    return [{key: line.get(key, "") for key in header} for line in answer]


def claims(rows: list[Row]) -> list[dict[str, str]]:
    """What is asked of long horizons."""

    def worst(H: int, families: tuple[str, ...], key: str) -> float:
        here = [row for row in rows if row["H"] == H and row["family"] in families]
        return max((row[key] for row in here if key in row), default=float("nan"))

    def line(text: str, value: float, shown: str, limit: float) -> dict[str, str]:
        return claim(text, "-", None) if np.isnan(value) else claim(text, shown, value <= limit)

    def growth(key: str, counts_from: int = 0) -> float:
        """By how much the medians of a family grow from the least long horizon to the longest."""
        found = by([row for row in rows if key in row], "family", "H")
        ends = [[found.get((family, H), []) for H in (least, most)] for family in LONG]
        medians = [
            [max(middle(end, key), counts_from) for end in pair] for pair in ends if all(pair)
        ]
        return max((end / start for start, end in medians), default=float("nan"))

    slow, slower = worst(600, MIXED_SIGNS, "longest"), worst(2000, FAMILIES, "longest")
    memory, least, most = worst(2000, FAMILIES, "memory"), LONG_HORIZONS[0], LONG_HORIZONS[-1]
    slowest, larger = worst(most, LONG, "longest"), worst(most, LONG, "memory")
    times, labels = growth("solve") * least / most, growth("labels a step", WIDTHS[0])
    proved = [row["proved"] for row in rows]
    return [
        line("H = 600, mixed signs: under 2 s", slow, f"{seconds(slow)} s", 2),
        line("H = 2000: under 20 s", slower, f"{seconds(slower)} s", 20),
        line("H = 2000: under 2 GB", memory, f"{memory / 1024:.2f} GB", 2048),
        line(f"long, H = {most}: under 60 s", slowest, f"{seconds(slowest)} s", 60),
        line(f"long, H = {most}: under 0.5 GB", larger, f"{larger / 1024:.2f} GB", 512),
        line(f"long: time a step, {least} to {most}: flat", times, f"{times:.2f}-fold", FLAT),
        line("long: labels a step, from 64 on: flat", labels, f"{labels:.2f}-fold", FLAT),
        claim("every point proved", f"{sum(proved)} of {len(proved)}", all(proved)),
    ]


NOTES = """\
One landing of 20 s (published: 0.01 s a step) in H steps; W models share the range of quality of
the eight, and p of altitude, its rate and pitch are perceived.  Seeds: {seeds}; runs of each:
{repeat}, fewer if `solve` takes over 10 s.  Times by the wall clock: medians, and the longest
`solve` of all.  *solve* is given Ψ and includes a relaxation; *labels*: most labels kept at a step
in the last pass (1: none were needed).  *memory*: peak of the process, of which {before:.0f} MB
are Python and its libraries.  Time limit of `solve`: {limit:g} s.  The published aircraft is
unstable: beyond about 1000 steps its open-loop Ψ is out of reach of double precision.

long: steps of 2/15 s, up and down between 0 and 100 ft every 700 of them, with preview; Ψ is a
linear system, {long_seeds} seeds, one run each.
"""


def report(rows: list[Row], options: argparse.Namespace, facts: Row) -> str:
    before = max((row["before"] for row in rows if "before" in row), default=0)
    notes = NOTES.format(before=before, **vars(options))
    sections = ["# How time and memory grow\n", "Made by `benchmarks/scaling.py`.\n"]
    sections += ["## Claims\n", table(claims(rows)), "## Points\n", table(lines(rows))]
    sections += ["![Time against H, W and p](scaling.png)\n"]
    sections += ["![Time and labels of a step against H](long.png)\n", notes, about(facts) + "\n"]
    return "\n".join(sections)


# ------------------------------------------------------------------------------- the figure

STYLE = {
    "font.size": 12,
    "axes.grid": True,
    "grid.alpha": 0.3,
    "lines.linewidth": 2,
    "lines.markersize": 7,
    "legend.frameon": False,
    "legend.fontsize": 10,
}
# Okabe and Ito's palette, told apart by marker and line style as well.
LOOKS: list[dict[str, Any]] = [
    {"color": color, "marker": marker, "linestyle": line}
    for color, marker, line in zip(
        ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000"),
        "osD^vPX",
        ("-", "--", "-.", ":", "-", "--", "-."),
        strict=True,
    )
]


def figure(rows: list[Row], options: argparse.Namespace) -> Figure:
    """Three panels: the stages against H, `solve` against H by family, `solve` against W by p."""
    by_H = [row for row in rows if "solve" in row and (row["W"], row["p"]) == (8, 1)]
    by_W = [
        row
        for row in rows
        if "solve" in row and row["family"] == HARDEST and row["H"] == options.middle
    ]
    with plt.rc_context(STYLE):
        drawing, (left, centre, right) = plt.subplots(1, 3, figsize=(15, 5), layout="constrained")
        stages = [row for row in by_H if row["family"] == HARDEST]
        for look, (stage, name) in zip(LOOKS, STAGES.items(), strict=False):
            draw(left, stages, "H", stage, name, look)
        guide(left, [row["H"] for row in stages], middle(stages[:1], "psi"))
        for look, ((family,), points) in zip(LOOKS, by(by_H, "family").items(), strict=False):
            draw(centre, points, "H", "solve", family, look)
        for look, ((p,), points) in zip(LOOKS, by(by_W, "p").items(), strict=False):
            draw(right, points, "W", "solve", f"p = {p}", look)
        finish(left, f"Stages, {HARDEST}", "horizon H, steps", options.horizons)
        finish(centre, "solve, W = 8, p = 1", "horizon H, steps", options.horizons)
        finish(right, f"solve, {HARDEST}, H = {options.middle}", "models W", options.models)
    return drawing


def long_figure(rows: list[Row]) -> Figure:
    """Time and labels of a step, against H: of a linear system, and of the matrix (hollow)."""
    families = [*LONG, *(family for family in FAMILIES if family.startswith("preview"))]
    with plt.rc_context(STYLE):
        drawing, (left, right) = plt.subplots(1, 2, figsize=(12, 5), layout="constrained")
        for look, family in zip(LOOKS[:3] + LOOKS[:3], families, strict=True):
            points = [
                row | {"step": 1e3 * row["solve"] / row["H"]}
                for row in rows
                if "solve" in row and (row["family"], row["W"], row["p"]) == (family, 8, 1)
            ]
            look = look if family in LONG else look | {"markerfacecolor": "white", "alpha": 0.6}
            if points:
                draw(left, points, "H", "step", family, look)
                draw(right, points, "H", "labels a step", family, look)
        ticks = (25, 100, 600, 2000, 10_000)
        finish(left, "solve", "horizon H, steps", ticks)
        finish(right, "labels of the last pass", "horizon H, steps", ticks)
        left.set_ylabel("time a step, ms")
        right.set_ylabel("labels a step, mean")
    return drawing


def draw(axes: Axes, rows: list[Row], x: str, y: str, label: str, look: dict[str, Any]) -> None:
    points = sorted((key, middle(points, y)) for (key,), points in by(rows, x).items())
    axes.plot(*zip(*points, strict=True), label=label, **look)


def guide(axes: Axes, horizons: list[int], height: float) -> None:
    """A grey line that grows with the square of H."""
    ends = np.array([min(horizons), max(horizons)])
    axes.plot(ends, height * (ends / ends[0]) ** 2, color="0.6", lw=1, label="∝ H²")


def finish(axes: Axes, title: str, x: str, ticks: Sequence[int]) -> None:
    axes.set(title=title, xlabel=x, ylabel="time, s", xscale="log", yscale="log")
    axes.set_xticks(ticks, [str(tick) for tick in ticks])
    axes.minorticks_off()
    axes.legend()


# ------------------------------------------------------------------------------ command line


def parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--families", nargs="+", choices=FAMILIES, default=FAMILIES)
    parser.add_argument("--horizons", type=int, nargs="+", default=HORIZONS)
    parser.add_argument("--models", type=int, nargs="+", default=MODELS, help="W, at --middle")
    parser.add_argument("--components", type=int, nargs="+", choices=(1, 2, 3), default=COMPONENTS)
    parser.add_argument("--middle", type=int, default=150, help="H where W and p vary")
    parser.add_argument("--seeds", type=int, default=2, help="instances a point")
    parser.add_argument("--long-horizons", type=int, nargs="*", default=LONG_HORIZONS)
    parser.add_argument("--long-seeds", type=int, default=3, help="instances a long point")
    parser.add_argument("--repeat", type=int, default=3, help="runs of an instance, for a median")
    parser.add_argument("--limit", type=float, default=120, help="seconds a solve")
    parser.add_argument("--output", type=Path, help="folder; default: results/ beside this script")
    parser.add_argument("--quick", action="store_true", help="a smoke test of under a minute")
    options = parser.parse_args()
    if options.quick:
        options.families, options.horizons = ["published", HARDEST], [25, 50, 100]
        options.models, options.components, options.middle = [2, 8], [1, 2], 50
        options.seeds, options.repeat, options.limit = 1, 1, 60
        options.long_horizons, options.long_seeds = [1200], 1
    return options


def main() -> None:
    options = parse()
    rows = run(plan(options))
    facts = machine()
    text = report(rows, options, facts)
    print(text)
    quick = Path(tempfile.gettempdir()) / "modelselect-quick"
    output = options.output or (quick if options.quick else RESULTS)
    save(output, "scaling", text, {"machine": facts, "claims": claims(rows), "rows": rows})
    figure(rows, options).savefig(output / "scaling.png", dpi=150)
    long_figure(rows).savefig(output / "long.png", dpi=150)


if __name__ == "__main__":
    main()
