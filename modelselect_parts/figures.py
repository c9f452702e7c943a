"""Every picture, from arrays: numbers, names and labels, and nothing of ours.

An estimate is a row (mean, half of its 95% interval); of a single trial the half is NaN, and left
out.  A picture is a Figure drawn in `STYLE`, which the caller saves.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from scipy.special import ndtri

Array = npt.NDArray[np.float64]

#: One style for all figures, readable from the last row.
STYLE: Any = {
    "axes.grid": True,
    "figure.constrained_layout.use": True,
    "figure.dpi": 110,
    "figure.figsize": (10, 5.6),
    "font.size": 15,
    "grid.alpha": 0.3,
    "legend.frameon": False,
    "lines.markersize": 11,
    "mathtext.fontset": "cm",
}


@contextmanager
def in_our_style() -> Iterator[None]:
    """Draw in `STYLE` what is drawn inside."""
    with plt.rc_context(STYLE):
        yield


#: Colours of Okabe and Ito, which the colour-blind tell apart, and markers, hollow if infeasible.
POLICY_STYLE: dict[str, dict[str, Any]] = {
    "Oracle": {"color": "#000000", "marker": "o", "fillstyle": "none"},
    "Clairvoyant": {"color": "#000000", "marker": "s", "fillstyle": "none"},
    "Optimal": {"color": "#D55E00", "marker": "o"},
    "Best Single": {"color": "#0072B2", "marker": "s"},
    "Greedy": {"color": "#009E73", "marker": "D"},
    "Random": {"color": "#CC79A7", "marker": "X"},
    "All Large": {"color": "#E69F00", "marker": "^"},
    "All Small": {"color": "#56B4E9", "marker": "v"},
}
#: The axis of perception costs that are w * Upsilon, counted operations, or measured times.
PERCEPTION_AXIS = {
    "linear": "perception cost (sum of $w \\Upsilon$)",
    "counted": "perception cost (operations)",
    "latency": "perception cost (ms of models)",
}
ACCENT = POLICY_STYLE["Optimal"]["color"]
ALTITUDE_PARTS = 20  # of equally many errors, for what depends on altitude


def _draw_estimate(axes: Axes, policy: str, x: Array, y: Array) -> None:
    """Draw the marker of a policy at two estimates (2,), with their intervals."""
    axes.plot(x[0], y[0], ls="", label=policy, **POLICY_STYLE[policy])
    dx, dy = np.nan_to_num([x[1], y[1]])
    axes.errorbar(x[0], y[0], dy, dx, fmt="none", ecolor=POLICY_STYLE[policy]["color"])


def _log_if_positive(values: Array) -> str:
    return "log" if np.min(values) > 0 else "linear"


# ------------------------------------------------------------------------- schedules and costs


@in_our_style()
def draw_schedule(
    choices: npt.NDArray[np.intp], names: Sequence[str], sensitivity: Array, title: str, dt: float
) -> Figure:
    """Draw the model of every step (H,) over how much the step matters (H,), steps of dt s."""
    figure, (top, bottom) = plt.subplots(2, sharex=True, height_ratios=[3, 1])
    top.step(range(len(choices)), choices, where="mid", color="#999999", linewidth=0.7)
    top.plot(choices, "o", color=ACCENT, markersize=6)
    top.set(ylabel="model", yticks=range(len(names)), yticklabels=names)
    top.set_title(title)
    bottom.plot(sensitivity, "k.-", ms=3)
    bottom.set(xlabel=f"step (of {dt:.3g} s)", ylabel="$\\Psi_{tt}$")
    return figure


@in_our_style()
def draw_costs(policies: Sequence[str], perception: Array, control: Array, axis: str) -> Figure:
    """Draw estimates (policies, 2) of perception cost, which `axis` names, against control."""
    figure, axes = plt.subplots()
    for policy, x, y in zip(policies, perception, control, strict=True):
        _draw_estimate(axes, policy, x, y)
    axes.set(xlabel=axis, ylabel="control cost")
    axes.set_title("Lower left is better")
    axes.set(yscale=_log_if_positive(control[:, 0]))
    figure.legend(loc="outside right upper")
    return figure


@in_our_style()
def draw_rewards(policies: Sequence[str], reward: Array) -> Figure:
    """Draw estimates (policies, 2) of reward as losses, the best on top."""
    figure, axes = plt.subplots()
    loss = reward * [-1, 1]
    ranked = np.argsort(-loss[:, 0], kind="stable")
    for row, k in enumerate(ranked):
        _draw_estimate(axes, policies[k], loss[k], np.array([row, 0.0]))
        axes.annotate(f"{reward[k, 0]:.3g}", (loss[k, 0], row + 0.25), ha="center", size=13)
    axes.set(yticks=range(len(ranked)), yticklabels=[policies[k] for k in ranked])
    axes.set(ylim=(-0.5, len(ranked) - 0.3))
    axes.set(xlabel="minus reward (left is better)", title="Rewards (hollow: infeasible)")
    axes.set(xscale=_log_if_positive(loss[:, 0]), xmargin=0.1)
    return figure


@in_our_style()
def draw_front(
    front: Array, proved: int, policies: Sequence[str], points: Array, axis: str
) -> Figure:
    """Draw a front (n, 2) of perception and extra control cost, and policies (policies, 2).

    The title claims something only if all n points are `proved` to be optimal.
    """
    figure, axes = plt.subplots()
    label = f"optimal at {len(front)} $\\alpha:\\beta$\n({proved} proved)"
    axes.plot(*front.T, "k.-", label=label)
    for policy, (x, y) in zip(policies, points, strict=True):
        axes.plot(x, y, ls="", label=policy, **POLICY_STYLE[policy])
    axes.set(xlabel=axis, ylabel="extra control cost")
    axes.set(yscale=_log_if_positive(front[:, 1]))
    claim = "No schedule beats the front in both costs"
    axes.set_title(claim if proved == len(front) else "The best schedules found")
    figure.legend(loc="outside right upper")
    return figure


@in_our_style()
def draw_all_points(
    points: Array,
    corner: npt.NDArray[np.bool_],
    missed: Array,
    left: str,
    names: Sequence[str],
    constant: Array,
    axis: str,
) -> Figure:
    """Draw Pareto points (n, 2), corners of their hull apart, and each model throughout (W, 2).

    Below, by what share (n,) the best corner that spends no more is dearer: `missed`.  The title
    says what is `left` open.
    """
    figure, (top, bottom) = plt.subplots(2, sharex=True, height_ratios=[5, 2])
    label = f"{corner.sum()} corners: optimal\nat some $\\alpha:\\beta$"
    top.plot(*points[corner].T, "o", color=ACCENT, ms=7, label=label)
    top.plot(
        *points[~corner].T, "k.", ms=4, label=f"{(~corner).sum()} points between:\nby budgets only"
    )
    top.plot(*constant.T, ls="", **POLICY_STYLE["Best Single"], label="one model\nthroughout")
    for name, *point in zip(names, constant[:, 0], constant[:, 1], strict=True):
        top.annotate(name, tuple(point), (10, 4), textcoords="offset points")
    top.set(ylabel="extra control cost", xmargin=0.1, ymargin=0.1)
    top.set(yscale=_log_if_positive(np.concatenate([points, constant])[:, 1]))
    title = f"Weights reach {corner.sum()} of {len(points)} Pareto points"
    top.set_title(f"{title}\n({left})" if left else title)
    bottom.plot(points[:, 0], 100 * missed, "k-", lw=1)
    bottom.set(xlabel=axis, ylabel="weights\ndearer (%)")
    bottom.locator_params(axis="x", nbins=6)
    figure.legend(loc="outside right upper")
    return figure


# ------------------------------------------------------------------------ landings and patterns


@in_our_style()
def draw_landings(time: Any, altitude: Mapping[str, Array], unit: str) -> Figure:
    """Draw mean and 90% band of altitudes (trials, H+1) by policy, beside the mean of Oracle."""
    figure, panels = plt.subplots(2, 4, sharex=True, figsize=(15, 7.5))
    ideal = altitude["Oracle"].mean(axis=0)
    for axes in panels.flat[len(altitude) :]:
        axes.set_visible(False)
    for axes, (policy, flown) in zip(panels.flat, altitude.items(), strict=False):
        colour, band = POLICY_STYLE[policy]["color"], np.quantile(flown, (0.05, 0.95), axis=0)
        axes.fill_between(time, *band, color=colour, alpha=0.35)
        axes.plot(time, flown.mean(axis=0), color=colour)
        axes.plot(time, ideal, "k:")
        axes.set_title(policy)
    figure.suptitle("Mean and 90% band of trials; dotted: Oracle; note the scales")
    figure.supxlabel("time (s)")
    figure.supylabel(f"altitude ({unit})")
    return figure


@in_our_style()
def draw_sensitivities(patterns: Sequence[str], found: Mapping[str, Array]) -> Figure:
    """Draw |Psi| of information patterns on one logarithmic scale; some may be missing."""
    W = len(patterns)
    figure, panels = plt.subplots(1, W, sharey=True, figsize=(3.75 * W, 4.2), squeeze=False)
    largest = max((np.abs(Psi).max() for Psi in found.values()), default=1) or 1
    scale = LogNorm(1e-8 * largest, largest)
    for axes, pattern in zip(panels.flat, patterns, strict=True):
        axes.set(title=f"{pattern}\nnot available", xlabel="step $k$")
        if pattern in found:
            Psi = found[pattern]
            axes.imshow(np.abs(Psi), norm=scale, cmap="cividis")
            negative = 100 * (Psi < -1e-8 * largest).mean()
            axes.set_title(f"{pattern}\n{negative:.0f}% negative")
        axes.grid(False)
    panels[0, 0].set_ylabel("step $t$")
    colours, label = ScalarMappable(scale, "cividis"), "$|\\Psi_{tk}|$ (white: 0)"
    figure.colorbar(colours, ax=panels, label=label, shrink=0.7)
    return figure


# ---------------------------------------------------------------------------- models that see


@in_our_style()
def draw_published_models(
    names: Sequence[str], operations: Array, parameters: Array, top1: Array
) -> Figure:
    """Draw accuracy (W,) in percent against operations (W,) and parameters (W,)."""
    figure, panels = plt.subplots(1, 2, sharey=True)
    for axes, x in zip(panels, (operations / 1e9, parameters / 1e6), strict=True):
        axes.semilogx(x, top1, "o-", color=ACCENT)
        axes.margins(0.15, 0.1)
        axes.xaxis.set(major_formatter="{x:g}", minor_formatter="")
        for name, *point in zip(names, x, top1, strict=True):
            axes.annotate(name, point, (6, -16), textcoords="offset points")
    panels[0].set(xlabel="operations per picture (billions)", ylabel="ImageNet top-1 accuracy (%)")
    panels[1].set(xlabel="parameters (millions)", xticks=(5, 10, 20, 50))
    return figure


@in_our_style()
def draw_gallery(
    rows: Sequence[npt.NDArray[np.float32]], titles: Sequence[str], heading: str
) -> Figure:
    """Draw rows of pictures (columns, side, side), greys from 0 to 1."""
    figure, panels = plt.subplots(len(rows), len(titles), figsize=(16, 8.6))
    for axes, title in zip(panels[0], titles, strict=True):
        axes.set_title(title)
    for axes, picture in zip(panels.flat, (p for row in rows for p in row), strict=True):
        axes.imshow(picture, cmap="gray", vmin=0, vmax=1)
        axes.set(xticks=[], yticks=[])
    figure.suptitle(heading)
    return figure


@in_our_style()
def draw_accuracy(names: Sequence[str], parameters: Array, error: Array) -> Figure:
    """Draw estimates (W, 2) of the root mean square error against the numbers of parameters."""
    figure, axes = plt.subplots()
    axes.errorbar(parameters, error[:, 0], error[:, 1], fmt="o-", color=ACCENT, capsize=5)
    for name, *point in zip(names, parameters, error[:, 0], strict=True):
        axes.annotate(name, tuple(point), (8, 8), textcoords="offset points")
    axes.set(xscale="log", xlabel="parameters", ylabel="root mean square error (ft)")
    return figure


@in_our_style()
def draw_distribution(name: str, distance: Array, error: Array) -> Figure:
    """Draw errors (M,) of a model against distance (M,), with mean and deviation by distance."""
    figure, axes = plt.subplots()
    parts = np.array_split(np.argsort(distance), ALTITUDE_PARTS)
    x, mean, deviation = np.array(
        [(distance[part].mean(), error[part].mean(), error[part].std()) for part in parts]
    ).T
    axes.plot(distance, error, "k.", ms=4, alpha=0.5, label="held-out pictures")
    axes.plot(x, mean, "-", color=ACCENT, label="mean")
    axes.fill_between(
        x, mean - deviation, mean + deviation, alpha=0.3, label="± standard deviation"
    )
    axes.set(xscale="log", yscale="symlog", xlabel="distance of the camera (ft)")
    axes.set(ylabel="error (ft)", title=f"Errors of {name}")
    axes.legend()
    return figure


@in_our_style()
def draw_training(names: Sequence[str], error: Array) -> Figure:
    """Draw the training error (W, epochs) of every model."""
    figure, axes = plt.subplots()
    for w, (name, curve) in enumerate(zip(names, error, strict=True)):
        colour, line = plt.get_cmap("viridis")(w / len(error)), ("-", "--", ":")[w % 3]
        axes.plot(np.arange(1, len(curve) + 1), curve, line, color=colour, label=name)
    axes.set(yscale="log", xlabel="epoch", ylabel="training error of log distance")
    figure.legend(loc="outside right upper")
    return figure


@in_our_style()
def draw_quantiles(names: Sequence[str], altitude: Array, error: Array) -> Figure:
    """Draw quantiles of errors (W, M) against normal ones: a straight line if they are normal.

    Each error is taken relative to the mean and deviation of its part of the altitudes (M,).
    """
    figure, panels = plt.subplots(2, 4, sharex=True, sharey=True, figsize=(15, 7.5))
    M, parts = len(altitude), np.array_split(np.argsort(altitude), ALTITUDE_PARTS)
    normal = ndtri((np.arange(M) + 0.5) / M)
    for axes, name, e in zip(panels.flat, names, error, strict=False):
        z = np.concatenate([(e[part] - e[part].mean()) / e[part].std(ddof=1) for part in parts])
        axes.plot(normal, np.sort(z), ".", color=ACCENT, ms=5)
        axes.plot(normal, normal, "k:")
        axes.set(title=name)
    figure.supxlabel("normal quantile")
    figure.supylabel("standardised error")
    return figure


@in_our_style()
def draw_stages(stages: Sequence[str], promised: Array, flown: Mapping[str, Array]) -> Figure:
    """Draw regret and total in flight by stage, estimates (stages, 2, 2) of each policy.

    The regret of Optimal that its table `promised` (stages,) stands beside that in flight.
    """
    figure, axes = plt.subplots(1, 2, figsize=(11.5, 4.8))
    place = np.arange(len(stages))
    axes[0].plot(place, promised, ls="", marker="_", ms=26, color=ACCENT, label="promised")
    for k, (policy, estimates) in enumerate(flown.items()):
        style = POLICY_STYLE[policy] | {"capsize": 3, "ls": "", "label": policy}
        for panel, pair in zip(axes, np.moveaxis(estimates, 1, 0), strict=True):
            mean, half = pair.T
            panel.errorbar(place + 0.12 * k, mean, np.nan_to_num(half), **style)
    titles = ("Regret", "α regret + β perception cost")
    for panel, title in zip(axes, titles, strict=True):
        panel.set(title=f"{title}, in flight", yscale="log", xlim=(-0.4, len(stages) - 0.2))
        panel.set_xticks(place, stages)
    entries = axes[0].get_legend_handles_labels()
    figure.legend(*entries, loc="outside lower center", ncols=len(flown) + 1)  # hides no promise
    return figure
