"""The pictures of a run: which of its arrays each of them takes.

A run is a `landing.Result`, or whatever has the same attributes; a picture is a Figure, which the
caller saves and closes, or `write_figures` does with all of them.
"""

from __future__ import annotations

import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any, TypeAlias

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure

import modelselect as ms
import perception
from modelselect import Array, ControlTask, Schedule
from modelselect_parts import figures, flights
from modelselect_parts.checks import check_class, check_classes, check_count
from modelselect_parts.files import write_atomically
from modelselect_parts.flights import root_mean_square
from modelselect_parts.rivals import Front, pareto
from perception import MOUNT, SPREAD, Trained

Result: TypeAlias = Any  #: of landing.py, which stands above


def _estimates(result: Result, quantity: str) -> Array:
    """Mean and half of its 95% interval (policies, 2) of one of `QUANTITIES`."""
    return flights.estimate(*(getattr(flown, quantity) for flown in result.flights.values()))


def plot_schedule(result: Result) -> Figure:
    """Draw the optimal schedule, and how much each step matters (``fig:simulation_ms``)."""
    check_class("result", result, "Result")
    choices, title = result.optimal.choices, f"Optimal schedule ({result.settings.information})"
    matters = result.problem.psi.diagonal().reshape(len(choices), -1).sum(axis=1)
    return figures.draw_schedule(choices, result.suite.names, matters, title, result.landing.dt)


def _axis(result: Result) -> str:
    """Name perception cost, with what it is the sum of."""
    label = figures.PERCEPTION_AXIS[result.settings.cost]
    return label.replace(")", " and switches)") if result.settings.switch_cost else label


def plot_costs(result: Result) -> Figure:
    """Draw perception against control cost, with 95% intervals (``fig:simulation_CvL``)."""
    check_class("result", result, "Result")
    paid, control = _estimates(result, "perception_cost"), _estimates(result, "control_cost")
    return figures.draw_costs(list(result.flights), paid, control, _axis(result))


def plot_rewards(result: Result) -> Figure:
    """Draw the rewards with 95% intervals, the best on top (``fig:simulation_rwd``)."""
    check_class("result", result, "Result")
    return figures.draw_rewards(list(result.flights), _estimates(result, "reward"))


def plot_pareto(result: Result, optima: Sequence[Schedule] | None = None) -> Figure:
    """Draw the front of all alpha : beta, and the policies (``fig:simulation_pareto``).

    In expectation, as control cost beyond that of perfect perception; `optima` are of `pareto`.
    """
    check_class("result", result, "Result")
    problem = result.problem
    optima = pareto(problem)[1] if optima is None else optima
    check_classes("optima", optima, "Schedule")
    fixed = {k: f.choices for k, f in result.flights.items() if k not in ("Oracle", "Clairvoyant")}
    terms = (problem.perception_term, problem.control_term)
    schedules = ([optimum.choices for optimum in optima], [np.asarray(c) for c in fixed.values()])
    front, points = (np.transpose([term(c) for term in terms]) for c in schedules)
    proved = sum(optimum.is_optimal for optimum in optima)
    return figures.draw_front(front, proved, list(fixed), points, _axis(result))


def plot_front(result: Result) -> Figure:
    """Draw all Pareto points of a result that has them, and the constant schedules."""
    check_class("result", result, "Result")
    front: Front | None = result.front
    if front is None:
        raise ValueError("result: expected one with a front, found none")
    problem, (H, W, _) = result.problem, result.problem.mean.shape
    always = np.repeat(np.arange(W)[:, None], H, axis=1)
    constant = np.array([problem.perception_term(always), problem.control_term(always)]).T
    given = (result.suite.names, constant, _axis(result))
    return figures.draw_all_points(*front, *given)


def plot_landing(result: Result) -> Figure:
    """Draw altitude over time: mean, and band of 90% of trials (``fig:simulation_traj_h``)."""
    check_class("result", result, "Result")
    altitude = {policy: flown.altitude for policy, flown in result.flights.items()}
    time = result.landing.dt * np.arange(result.settings.horizon + 1)
    return figures.draw_landings(time, altitude, result.landing.unit)


def plot_efficientnet() -> Figure:
    """Draw accuracy against operations and parameters of EfficientNet (Tan and Le 2019)."""
    names, parameters, operations, top1, _ = perception.EFFICIENTNET
    return figures.draw_published_models(names, operations, parameters, top1)


def plot_psi(task: ControlTask) -> Figure:
    """Draw |Psi| of a task under all information patterns, on one logarithmic scale of colours."""
    check_class("task", task, "ControlTask")
    return figures.draw_sensitivities(ms.INFORMATION, flights.sensitivities(task))


def plot_gallery(seed: int = 0) -> Figure:
    """Draw three landings of a `seed`, as seen (``fig:airsim_env``, ``fig:airsim_dataset``)."""
    altitude, pictures = flights.photograph_landings(seed)
    heading = "Three landings; below, the third as b7 sees it"
    return figures.draw_gallery(pictures, [f"{h:g} ft" for h in altitude], heading)


def plot_accuracy(trained: Trained) -> Figure:
    """Draw held-out error against size, with 95% intervals (``fig:all_mod_acc``)."""
    check_class("trained", trained, "Trained")
    error = np.array(list(map(root_mean_square, flights.by_network(trained.residuals)[1])))
    parameters = np.array([network.parameters for network in trained.networks])
    return figures.draw_accuracy(trained.residuals.names, parameters, error)


def plot_distribution(trained: Trained, model: int = -1) -> Figure:
    """Draw the errors of a `model` against altitude (``fig:airsim_distro_b7``)."""
    check_class("trained", trained, "Trained")
    names, (altitude, errors) = trained.residuals.names, flights.by_network(trained.residuals)
    if not check_count("model", model, minimum=-len(names)) < len(names):
        raise ValueError(f"model: expected one of {len(names)}, found {model}")
    return figures.draw_distribution(names[model], altitude + MOUNT, errors[model])


def plot_training(trained: Trained) -> Figure:
    """Draw the training error of each model by epoch (``fig:b7_training_plot``)."""
    check_class("trained", trained, "Trained")
    return figures.draw_training(trained.residuals.names, SPREAD * np.sqrt(trained.losses))


def plot_quantiles(trained: Trained) -> Figure:
    """Draw quantiles of standardised errors against normal ones: straight if normal."""
    check_class("trained", trained, "Trained")
    return figures.draw_quantiles(trained.residuals.names, *flights.by_network(trained.residuals))


def plot_stages(result: Result) -> Figure:
    """Draw what flights by sight cost at each stage, and what tables promised."""
    check_class("result", result, "Result")
    if not result.flown:
        raise ValueError("result: expected what `fly_stages` found in its flown, found nothing")
    flown = list(result.flown.values())
    policies = [k for k in flown[0].lost if all(k in each.lost for each in flown)]
    of_policy = {
        k: np.array([flights.estimate(each.lost[k], each.totals[k]) for each in flown])
        for k in policies
    }
    promised = np.array([each.promised for each in flown])
    return figures.draw_stages(list(result.flown), promised, of_policy)


def write_figures(result: Result, folder: Path, *, progress: bool = False) -> None:
    """Write every figure to `folder` as PNG; the same run gives the same bytes."""
    check_class("result", result, "Result")
    drawn = {
        "schedule": plot_schedule(result),
        "costs": plot_costs(result),
        "rewards": plot_rewards(result),
        "pareto": plot_pareto(result, pareto(result.problem, progress=progress)[1]),
        "landing": plot_landing(result),
        "efficientnet": plot_efficientnet(),
        "psi": plot_psi(result.landing.task),
    }
    if result.front:
        drawn["front"] = plot_front(result)
    if result.trained:
        drawn |= {
            "gallery": plot_gallery(result.settings.seed),
            "accuracy": plot_accuracy(result.trained),
            "distribution": plot_distribution(result.trained),
            "training": plot_training(result.trained),
            "quantiles": plot_quantiles(result.trained),
        }
    if result.flown:
        drawn["stages"] = plot_stages(result)
    for name, figure in drawn.items():
        picture = io.BytesIO()
        figure.savefig(picture, metadata={"Software": None})
        plt.close(figure)
        write_atomically(folder / f"{name}.png", picture.getvalue())
