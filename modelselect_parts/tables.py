"""Every table, from arrays: numbers, names and labels, and nothing of ours.

An estimate is a row (mean, half of its 95% interval); of a single trial the half is NaN, and left
out.  A table is a list of lines, or of rows.
"""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from modelselect_parts.checks import Array


def as_csv(rows: Sequence[Mapping[str, Any]]) -> str:
    """Return rows, one or more, as CSV below their names."""
    text = io.StringIO()
    table = csv.DictWriter(text, list(rows[0]), lineterminator="\n")
    table.writeheader()
    table.writerows(rows)
    return text.getvalue()


def undecided(mean: float, half: float) -> bool:
    """Whether the 95% interval `mean` ± `half` of a difference leaves open which side is better.

    It does if it contains 0, or is unknown (NaN); not if there is no difference in any trial.
    """
    return not (abs(mean) > half or mean == half == 0)


def line_of_undecided(policies: Sequence[str], gain: Array, when: str = "") -> list[str]:
    """Name the policies that may be better than Optimal, by estimates (policies, 2) of its gain.

    The text of `when` says of which gain, if there are several.
    """
    pairs = zip(policies, gain, strict=True)
    left = [policy for policy, pair in pairs if policy != "Optimal" and undecided(*pair)]
    why = "a single trial" if np.isnan(gain).any() else "0 is in the interval"
    return [f"Undecided{when} ({why}): {', '.join(left)}."] if left else []


def table_of_policies(
    policies: Sequence[str],
    estimates: Array,
    log: Mapping[str, Array],
    trials: int,
    price: str,
    unit_of_price: str = "",
) -> list[str]:
    """Tabulate estimates (policies, 4, 2) of costs, reward and what Optimal gains on each policy.

    Means (3,) of the `log` stand below those of the same policy, all in a power of a thousand, but
    perception costs with a `unit_of_price` in that; `price` says in words what they are.
    """
    size = estimates[list(policies).index("Optimal"), 0, 0]
    unit = 1000.0 ** math.floor(math.log10(size) / 3) if size > 0 else 1.0

    units = [unit, 1.0 if unit_of_price else unit, unit, unit]

    def cell(estimate: Array, unit: float) -> str:
        mean, half = estimate
        half_width = f"± {half / unit:.3f}".replace("nan", "-") if half != 0 else ""
        return f"{mean / unit:12.3f} {half_width:10}"

    heading = f"Means of {trials} trials ± 95% t-intervals, in units of {unit:.0e}"
    heads = ("control cost", "perception cost", "reward", "Optimal gains")
    if unit_of_price:
        heads = (heads[0], f"perception ({unit_of_price})", *heads[2:])
    lines = [f"{heading}; perception costs are {price}"]
    lines += [" " * 12 + "".join(f"{head:>17}      " for head in heads)]
    for policy, row in zip(policies, estimates, strict=True):
        lines += [f"{policy:12}" + "".join(map(cell, row, units))]
        if policy in log:
            means = "".join(f"{mean / unit:12.3f}{'':11}" for mean in log[policy])
            lines += ["  published " + means]
    lines += ["Oracle (no error) and Clairvoyant (knows all errors beforehand) are infeasible."]
    lines += ["Optimal gains: its reward less that of the policy, in the same trials."]
    lines += line_of_undecided(policies, estimates[:, 3])
    return [line.rstrip() for line in lines]


def table_of_models(
    names: Sequence[str], choices: npt.NDArray[np.intp], mean: Array, variance: Array
) -> list[str]:
    """Count the steps (H,) of each model, and how often the next larger is the better (H, W, p)."""
    used = np.bincount(choices, minlength=len(names))
    steps = ", ".join(f"{model} {n}" for model, n in zip(names, used, strict=True))
    closer, steadier = (100 * (np.diff(x, axis=1) <= 0).mean() for x in (abs(mean), variance))
    return [
        f"Its steps: {steps}.",
        f"The next larger model has the smaller |mean error| in {closer:.1f}%, the smaller "
        f"variance in {steadier:.1f}% of cases.",
    ]


def table_of_front(
    front: tuple[Array, npt.NDArray[np.bool_], Array, str], unit: str = ""
) -> list[str]:
    """Count Pareto points (n, 2) and corners (n,); say what corners miss (n,) and what is open.

    A budget has a `unit`, with a space before it, or none.
    """
    points, corner, missed, left = front
    reached = f"{corner.sum()} of them corners, which weights alpha : beta reach"
    lines = [
        f"Pareto points: {len(points)} proved, {reached}.",
        *([f"Open: {left}; this is of what is above."] if left else []),
    ]
    if len(points):
        worst = missed.argmax()
        where = f"within a budget of {points[worst, 0]:.6g}{unit}"
        lines += [f"The best corner costs control up to {100 * missed[worst]:.2g}% more, {where}."]
    return lines


def table_of_errors(
    names: Sequence[str], sizes: Array, error: Array, edges: Array, by_altitude: Array
) -> list[str]:
    """Tabulate parameters and operations (W, 2), estimates of error (W, 2), errors by altitude."""
    lines = ["Held-out errors (ft): parameters, multiply-adds, root mean square ± 95%, by altitude"]
    lines += [" " * 46 + "".join(f"{f'to {top:g}':>9}" for top in edges[1:])]
    for name, size, (rms, half), parts in zip(names, sizes, error, by_altitude, strict=True):
        row = f"{name} {size[0]:9,} {size[1]:10,} {rms:8.2f} ± {half:.2f}"
        lines += [row.ljust(46) + "".join(f"{value:9.2f}" for value in parts)]
    return lines


def table_of_regrets(
    information: str,
    policies: Sequence[str],
    expected: Array,
    regret: Array,
    gain: Array,
    unit_of_price: str = "",
) -> list[str]:
    """Tabulate predicted regret and perception cost (policies, 2), and estimates.

    Of regret (policies, 3, 2): with Gaussian errors, with resampled ones, by sight; and of what
    Optimal gains in reward (policies, 2, 2): in the first way, and by sight.  Perception costs may
    have a `unit_of_price`.
    """
    paid_head = f"perception ({unit_of_price})" if unit_of_price else "perception cost"
    heads = ("predicted", "Gaussian errors", "bootstrap", "flown on pictures", paid_head)
    lines = [f"Regret under {information}, where the drone acts on what it sees as it lands"]
    lines += [" " * 12 + "".join(f"{head:>19}" for head in (*heads, "Optimal gains", "flown"))]

    def cells(estimates: Array) -> str:
        return "".join(f"{mean:10.1f} ± {half:6.1f}" for mean, half in estimates)

    for policy, (predicted, paid), ways, gains in zip(
        policies, expected, regret, gain, strict=True
    ):
        row = f"{policy:12}{predicted:19.1f}" + cells(ways) + f"{paid:19.1f}"
        lines += [row + cells(gains) * (policy != "Optimal")]
    return lines + line_of_undecided(policies, gain[:, 1], " when flown")


def table_of_sizes(sizes: Sequence[int], regret: Array, draws: int, fresh: int) -> list[str]:
    """Tabulate estimates (sizes, 2, 2) of relative regret, as fitted and guarded, in percent."""
    lines = [f"Total cost of schedules fitted on n residuals, judged on {fresh} new pictures:"]
    heads = f"{'n':>5}{'beyond the optimum':>24}{'with guard_suite':>24}"
    lines += [f"{heads}  (mean ± 95%, {draws} draws)"]
    for n, pair in zip(sizes, 100 * regret, strict=True):
        lines += [f"{n:5}" + "".join(f"{mean:15.2f} ± {half:5.2f}%" for mean, half in pair)]
    return lines


def table_of_stages(
    stages: Sequence[str],
    promised: Array,
    came: Array,
    leads: Sequence[Mapping[str, tuple[float, float]]],
    trials: int,
) -> list[str]:
    """Lines on what each stage promised (stages,), and what came of it in `trials` by sight.

    What `came` are estimates (stages, 3, 2) of regret by labelled landings, NaN without, and of
    regret and total in flight; `leads` say by what share Optimal's total lies below the others'.
    """
    heads = ["promised", "by labels", "flown regret", "flown total"]
    heads += [f"below {policy}, %" for policy in leads[0]]
    lines = [f"Optimal at every stage, flown on pictures in {trials} trials, the same for all"]
    lines += [" " * 12 + "".join(f"{head:>24}" for head in heads)]

    def cell(mean: float, half: float, digits: int = 1) -> str:
        known = "-" if math.isnan(mean) else f"{mean:.{digits}f} ± {half:.{digits}f}"
        return known.replace("nan", "-")

    for stage, promise, row, ahead in zip(stages, promised, came, leads, strict=True):
        cells = [f"{promise:.1f}", *(cell(*pair) for pair in row)]
        for mean, half in ahead.values():
            mark = "?" if undecided(mean, half) else ""
            cells.append(cell(100 * mean, 100 * half) + mark)
        lines.append(f"{stage:12}" + "".join(f"{text:>24}" for text in cells))
    left = any(undecided(*pair) for ahead in leads for pair in ahead.values())
    return lines + ["? undecided: 0 is in the interval, or it is one of a single trial."] * left


def table_of_percentages(
    compared: Sequence[tuple[str, str, str, str]],
    quantities: Sequence[str],
    sources: Mapping[str, Mapping[str, Array]],
) -> list[dict[str, Any]]:
    """Tabulate 100 (new - old) / |old| of (quantity, new, old, what the paper prints of it).

    By the means of several sources, which hold the `quantities` of a policy in this order.  Where a
    source is empty, or the old value next to nothing, there is no number: None.
    """
    rows = []
    for quantity, new, old, printed in compared:
        row: dict[str, Any] = {"quantity": quantity.replace("_", " "), "new": new, "old": old}
        row["formula"] = f"100 ({new} - {old}) / |{old}|"
        for name, means in sources.items():
            q, nothing = quantities.index(quantity), [0.0] * len(quantities)
            to, base = (float(means.get(policy, nothing)[q]) for policy in (new, old))
            number = abs(to - base) < 1e300 * abs(base)
            row[name] = 100 * (to - base) / abs(base) if number else None
        rows += [row | {"what the paper prints": printed}]
    return rows


def table_of_measured(
    promised: Mapping[str, float],
    lost: Mapping[str, Array],
    totals: Mapping[str, Array],
    leads: Mapping[str, tuple[float, float]],
) -> list[str]:
    """Lines on flights that were not fitted to: regret (trials,), totals, Optimal's lead."""
    heads = ("promised regret", "flown regret", "flown total", "Optimal lies below by, %")
    lines = [f"{len(totals['Optimal'])} flights each on views that no fit has seen; means"]
    lines += [" " * 12 + "".join(f"{head:>26}" for head in heads)]
    for policy, total in totals.items():
        numbers = (promised[policy], lost[policy].mean(), total.mean())
        line = f"{policy:12}" + "".join(f"{number:26.4g}" for number in numbers)
        if policy in leads:
            mean, half = (100 * number for number in leads[policy])
            line += f"{mean:17.1f} ± {half:.1f}" + (" undecided" if undecided(mean, half) else "")
        lines.append(line)
    return lines
