"""Landing a drone with eight perception models: the paper's two experiments, end to end.

At every step an aircraft runs one of the models b0 (free, far off) to b7 (dear, nearly right) to
estimate the input s_t that disturbs it.  The arrays flow one way:

    preset -> Psi -> problem -> schedules of eight policies -> trials -> report, JSON, figures.

A schedule is chosen from means and variances, but judged in flight: every trial draws the true
input and the errors of all models, the same for all policies, the controller acts on the estimates
of the scheduled models, and the costs are those of the roll-out.  Model w costs w * Upsilon
(``eq:perceptionCost``); the authors' code charges (w + 1) * Upsilon, which adds H * Upsilon to
every schedule: it changes percentages, but not the optimum.

In ``--experiment trained`` the models are networks that learned from rendered pictures, their
errors are measured on other pictures, and the drone also lands by what they see on the way.  What
it knows of them may grow by stages: ``--calibrate``, ``--rounds`` of landings that are labelled.

From the shell, ``python landing.py --help``; from a notebook::

    result = run_experiment(Settings(preset="textbook", trials=20))
    print(report(result))
    plot_schedule(result)
"""

from __future__ import annotations

import os
import signal

if __name__ == "__main__":  # before NumPy: threads slow down small matrices, tenfold if busy
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    signal.signal(signal.SIGINT, lambda *_: os._exit(130))  # nothing is begun while we import

import argparse
import hashlib
import math
import sys
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from json import dumps
from pathlib import Path
from time import perf_counter
from typing import Any, NamedTuple

import numpy as np
from scipy.signal import cont2discrete

import modelselect as ms
import perception
from modelselect import Array, Choices, ControlTask, Schedule, SelectionProblem
from modelselect_parts import figures, flights, learning, measured, options, pooling, prices, tables
from modelselect_parts.checks import check_class, check_count, check_name, check_number, shown
from modelselect_parts.figures import STYLE
from modelselect_parts.files import check_targets, write_atomically
from modelselect_parts.flights import (
    FRESH,
    Regret,
    fit_landing,
    fly,
    half_width,
    root_mean_square,
)
from modelselect_parts.plots import (
    plot_accuracy,
    plot_costs,
    plot_distribution,
    plot_efficientnet,
    plot_front,
    plot_gallery,
    plot_landing,
    plot_pareto,
    plot_psi,
    plot_quantiles,
    plot_rewards,
    plot_schedule,
    plot_stages,
    plot_training,
    write_figures,
)
from modelselect_parts.prices import COSTS, UNITS, model_cost
from modelselect_parts.published import COMPARISONS, EXPERIMENT_1, EXPERIMENT_2
from modelselect_parts.rivals import Front, pareto, policies, whole_front
from modelselect_parts.sight import gains_for
from perception import MOUNT, PerceptionSuite, Trained

Rng = np.random.Generator
LOOK, PRICE = figures.POLICY_STYLE, figures.PERCEPTION_AXIS  # their older names

# -------------------------------------------------------------------------------- two aircraft


@dataclass(frozen=True, eq=False)
class Preset(flights.Aircraft):
    """An aircraft, and how the world and the models are drawn; the elevator controls it.

    Of an `Aircraft` it has the `task`, `x0`, `prior_mean`, `gust`, `path` and `dt`.
    """

    draw_inputs: Callable[[Rng, int], Array]  #: generator, trials -> true s (trials, H, p)
    draw_suite: Callable[[Rng], PerceptionSuite]  #: at the price Upsilon = 1
    upsilon: float | None  #: price of one model up; None: by `cost_scale`
    unit: str  #: of altitude


K_S, T_S, ZETA, OMEGA = -0.95, 2.5, 0.5, 1.0


def _aircraft(V: float, a22: float, a42: float, b4: float) -> tuple[Array, Array]:
    """Continuous dynamics x' = F x + G u at speed V; sources differ on a22, a42 and b4."""
    a43, a44 = 2 * ZETA * OMEGA / T_S - OMEGA**2 - 1 / T_S**2, 1 / T_S - 2 * ZETA * OMEGA
    F = [[0, 1, 0, 0], [0, a22, V / T_S, 0], [0, 0, 0, 1], [0, a42, a43, a44]]
    return np.array(F), np.array([[0], [0], [0], [b4]])


def _published(H: int) -> Preset:
    """Return the aircraft of the authors' code: forward Euler, C not scaled by dt."""
    V, dt = 20.0, 0.01
    a42 = (1 - 2 * ZETA * OMEGA) / (V * T_S) + OMEGA**2 / V
    F, G = _aircraft(V, 1 / T_S, a42, OMEGA**2 / K_S)
    A, B, C = np.eye(4) + dt * F, dt * G, np.array([[0], [0], [1], [0]])
    return Preset(
        task=ControlTask(A, B, C, np.diag([1e8, 1, 1e8, 1]), np.eye(1), H),
        x0=np.array([1000, 2, 2, 0.2]),
        draw_inputs=lambda rng, trials: rng.uniform(0, 0.002, (trials, H, 1)),
        prior_mean=np.full((H, 1), 0.001),
        gust=0.002 / math.sqrt(3),
        draw_suite=lambda rng: perception.published_suite(H, rng, upsilon=1.0),
        upsilon=1e14,
        path=np.zeros(H + 1),
        dt=dt,
        unit="unit of the authors' code",
    )


def _textbook(H: int) -> Preset:
    """Return the aircraft of Ellert and Merriam 1963, in deviations from its glide path.

    20 s from 100 ft in H steps, discretised exactly; gusts and a moving pad displace the altitude.
    """
    V, dt = 256.0, 20 / H
    a42 = 1 / (V * T_S**2) - 2 * ZETA * OMEGA / (V * T_S) + OMEGA**2 / V
    F, G = _aircraft(V, -1 / T_S, a42, OMEGA**2 * K_S * T_S)
    A, B, *_ = cont2discrete((F, G, np.eye(4), np.zeros((4, 1))), dt, method="zoh")
    time = dt * np.arange(H + 1)
    path = np.where(time < 15, 100 * np.exp(-time / 5), 20 - time)
    return Preset(
        task=ControlTask(A, B, np.eye(4)[:, :1], np.diag([1, 1, 100, 100]), 10 * np.eye(1), H),
        x0=np.array([5.0, 0, 0, 0]),
        draw_inputs=lambda rng, trials: rng.normal(0, 0.3, (trials, H, 1)),
        prior_mean=np.zeros((H, 1)),
        gust=0.3,
        draw_suite=lambda rng: perception.textbook_suite(path[:-1], rng),
        upsilon=None,
        path=path,
        dt=dt,
        unit="ft",
    )


PRESETS = {"published": _published, "textbook": _textbook}


def preset(name: str = "published", horizon: int = 150) -> Preset:
    """Return the aircraft `name` of `PRESETS`, which lands in `horizon` steps."""
    check_name("preset", name, PRESETS)
    return PRESETS[name](check_count("horizon", horizon))


# ------------------------------------------------------------------------------ the experiment


def cost_scale(Psi: Array, suite: PerceptionSuite) -> float:
    """Return Upsilon for a Psi (pH, pH) by a rule that was fixed before any result was seen.

    The rule is beta Upsilon (W-1) H = 0.2 alpha (expected control term of All Small) at
    alpha = 0.8 and beta = 0.2, whatever the weights in use, so that sweeping those means something.
    """
    check_class("suite", suite, "PerceptionSuite")
    H, W, _ = suite.mean.shape
    if W < 2:
        raise ValueError("suite: expected 2 or more models to put a price on, found 1")
    problem = SelectionProblem(Psi, suite.mean, suite.variance, suite.cost)
    return float(0.2 * 0.8 * problem.control_term(np.zeros(H)) / (0.2 * (W - 1) * H))


def _simulated(landing: Preset, run: Settings, rng: Rng, _: Trained | None) -> PerceptionSuite:
    """Draw the preset's suite (``subsec:expSimulation``)."""
    suite = landing.draw_suite(rng)
    return replace(suite, cost=prices.latency(suite.names)) if run.cost == "latency" else suite


def _trained(landing: Preset, run: Settings, rng: Rng, trained: Trained) -> PerceptionSuite:
    """Fit what the models did on held-out pictures along the landing (``subsec:expAirsim``)."""
    return _fitted(landing, run, rng, learning.of_held_out(trained))


def _fitted(landing: Preset, run: Settings, rng: Rng, able: learning.Skill) -> PerceptionSuite:
    cost = model_cost(able.networks, run.cost)
    return fit_landing(landing, able.seen, cost, FITS[run.fit], rng=rng)


def _measured(landing: Preset, run: Settings, rng: Rng, _: Trained | None) -> PerceptionSuite:
    """Fit what real programs did on half of the views of a file of residuals."""
    table = measured.read(run.residuals)
    fitted = measured.halves(table, rng)[0]
    return measured.suite_along(fitted, landing.path[:-1], measured.latencies(table))


EXPERIMENTS: Any = {"simulated": _simulated, "trained": _trained, "measured": _measured}
#: What an experiment takes by default instead; a drone has no forecast.
DEFAULTS: dict[str, dict[str, Any]] = {
    "trained": {"preset": "textbook", "information": "measurement", "cost": "counted"}
    | {"alpha": 0.6, "beta": 0.4},
    "measured": {"preset": "textbook", "information": "preview", "cost": "latency"}
    | {"trials": 20},  # Clairvoyant's problems are hard ones
}
MEASURED_FLIGHTS = 1000
LABELLED = 20  # landings of a round that is labelled
#: How errors are pooled along the way, and in how many bins.
FITS = {"kernel": None, "bins": flights.BINS}
#: Settings beyond the paper: limits, and what networks learn after their training.
LIMITS = ("switch_cost", "budget")
LEARNING = ("fit", "calibrate", "rounds")


def _names() -> dict[str, Any]:
    """Return what those settings may be that are names."""
    known = EXPERIMENTS, PRESETS, ms.PATTERNS, COSTS, FITS
    return dict(zip(("experiment", "preset", "information", "cost", "fit"), known, strict=True))


@dataclass(frozen=True)
class Settings:
    """What a run is made of: the options of the command line.  ValueError names a wrong one."""

    experiment: str = "simulated"  #: one of `EXPERIMENTS`
    preset: str = "published"  #: one of `PRESETS`
    information: str = "open_loop"  #: one of `modelselect.PATTERNS`, with gains of a Kalman filter
    horizon: int = 150  #: steps of a landing
    trials: int = 100  #: landings
    alpha: float = 0.8  #: weight of control cost (``eq:jtot``)
    beta: float = 0.2  #: weight of perception cost
    upsilon: float | None = None  #: price of one model up; None: as the preset says
    cost: str = "linear"  #: of model w: w * upsilon, or counted operations or ms, with the same top
    seed: int = 0  #: of everything random
    switch_cost: float = 0.0  #: perception cost (ms, if that is latency) of changing models
    budget: float | None = None  #: the most that perception may cost on a landing, with switches
    residuals: str | None = None  #: a file of experiment ``measured``; None: that of a tag detector
    fit: str = "kernel"  #: how errors of networks are pooled, one of `FITS`
    calibrate: bool = False  #: whether networks report E[z | z_hat], by held-out pictures
    rounds: int = 0  #: of `LABELLED` landings that networks are labelled on, with what is best then

    def __post_init__(self) -> None:
        for name, known in _names().items():
            check_name(name, getattr(self, name), known)
        counts = {name: check_count(name, getattr(self, name)) for name in ("horizon", "trials")}
        counts["seed"] = check_count("seed", self.seed, minimum=0, top=math.inf)
        counts["rounds"] = check_count("rounds", self.rounds, minimum=0)
        for name, count in counts.items():
            object.__setattr__(self, name, count)
        for name in ("alpha", "beta", "upsilon", *LIMITS):
            value = getattr(self, name)
            if value is not None or name not in ("upsilon", "budget"):
                object.__setattr__(self, name, check_number(name, value, minimum=0))
        if self.experiment in ("trained", "measured") and self.preset != "textbook":
            raise ValueError(f"preset: the cameras need textbook altitudes, found {self.preset!r}")
        if self.experiment == "measured" and self.cost != "latency":
            raise ValueError(f"cost: measured models cost their latency, found {self.cost!r}")
        if self.residuals is not None and self.experiment != "measured":
            raise ValueError(f"residuals: used by experiment measured, found {self.experiment!r}")
        if self.experiment == "simulated" and self.cost == "counted":
            raise ValueError("cost: simulated models have linear cost or latency, found 'counted'")
        if not isinstance(self.calibrate, bool):
            raise ValueError(f"calibrate: expected True or False, found {shown(self.calibrate)}")
        for name in LEARNING:
            if self.experiment != "trained" and getattr(self, name) != getattr(Settings, name):
                raise ValueError(f"{name}: of experiment trained, found {self.experiment!r}")
        if self.rounds and ms.PATTERNS[self.information].foresight:
            raise ValueError(f"rounds: a flight has no forecast, found {self.information!r}")


class Flights(NamedTuple):
    """What one policy did in the trials, and what came of it."""

    choices: Choices | None  #: (H,), or (trials, H); None for Oracle, which runs no model
    altitude: Array  #: (trials, H+1)
    control_cost: Array  #: (trials,), of the roll-out
    perception_cost: Array  #: (trials,)
    reward: Array  #: (trials,), -alpha control_cost - beta perception_cost


QUANTITIES = Flights._fields[2:]


@dataclass(frozen=True, eq=False)
class Result:
    """A run: its settings with the Upsilon that was used, the problem, its optimum, the trials."""

    settings: Settings
    landing: Preset
    suite: PerceptionSuite
    problem: SelectionProblem
    optimal: Schedule
    seconds: float  #: that `modelselect.solve` took
    flights: dict[str, Flights]  #: by policy
    trained: Trained | None = None  #: the networks of experiment ``trained``
    front: Front | None = None  #: all Pareto points, where they were asked for
    stages: tuple[learning.Stage, ...] = ()  #: of which the last one is posed, solved and flown
    flown: dict[str, learning.Flown] | None = None  #: by sight at every stage: `fly_stages`

    def means(self) -> dict[str, Array]:
        """Means over trials (3,) of control cost, perception cost and reward, by policy."""
        return {policy: np.mean(flown[2:], axis=1) for policy, flown in self.flights.items()}


def _posed(
    name: str,
    run: Settings,
    landing: Preset,
    suite: PerceptionSuite,
    skill: Any = None,
) -> tuple[Settings, learning.Stage]:
    """Price a suite, pose its problem and solve it; return the Upsilon that was used, too."""
    gains = gains_for(landing, run.information, suite)
    Psi = ms.psi(landing.task, run.information, gains=gains)
    upsilon = landing.upsilon if run.upsilon is None else run.upsilon
    upsilon = cost_scale(Psi, suite) if upsilon is None else upsilon
    dearest = suite.cost[np.isfinite(suite.cost)].max()
    sums = ("upsilon", upsilon, dearest), ("switch_cost", run.switch_cost, run.horizon)
    for setting, price, times in sums:
        if not math.isfinite(price * float(times)):
            raise ValueError(f"{setting}: the costs overflow, found {price:g}")
    suite, weight = prices.priced(suite, upsilon, run.cost)
    posed = (Psi, suite.mean, suite.variance, suite.cost, run.alpha, run.beta * weight)
    switch_cost = run.switch_cost * (1 - np.eye(len(suite.names))) if run.switch_cost else None
    problem = SelectionProblem(*posed, switch_cost=switch_cost, budget=run.budget)
    started = perf_counter()
    optimal = ms.solve(problem)
    seconds = perf_counter() - started
    stage = learning.Stage(name, suite, gains, problem, optimal, seconds, skill)
    return replace(run, upsilon=upsilon), stage


def _learning(
    run: Settings, landing: Preset, first: learning.Stage, rng: Rng
) -> list[learning.Stage]:
    """Return the stages in which networks learn more: calibrated, then round by round."""
    known, rounds = [first], rng.spawn(run.rounds + 1)  # the same, whatever a fit has drawn
    for k in range(0 if run.calibrate else 1, run.rounds + 1):
        able, last = first.skill, known[-1]
        if k > 0:
            able, s = last.skill, landing.draw_inputs(rounds[k], LABELLED)
            given = (able, run.information, last.optimal.choices, rounds[k], s, last.gains)
            able = able._replace(pictures=learning.label_landings(landing, *given))
        able = learning.skill(able.networks, able.pictures, run.calibrate)
        suite = _fitted(landing, run, rng, able)
        known += [_posed(f"round {k}" if k else "calibrated", run, landing, suite, able)[1]]
    return known


def _known(
    run: Settings, landing: Preset, trained: Any, rng: Rng
) -> tuple[Settings, list[learning.Stage]]:
    """Return the stages of a run, one unless networks learn, and the Upsilon of the first."""
    suite = EXPERIMENTS[run.experiment](landing, run, rng, trained)
    able = learning.of_held_out(trained) if run.experiment == "trained" else None
    run, stage = _posed(run.fit, run, landing, suite, able)
    return run, _learning(run, landing, stage, rng) if able else [stage]


def run_experiment(
    settings: Settings | None = None, *, trained: Trained | None = None, progress: bool = False
) -> Result:
    """Draw a suite, solve, and fly all policies; by default the published experiment.

    Suite, inputs, errors and Random draw from streams of their own, so that further trials
    change neither the problem nor the first trials.  Networks that are not given are trained.
    """
    run = Settings() if settings is None else settings
    for name, given, kind in (("settings", settings, Settings), ("trained", trained, Trained)):
        if not isinstance(given, kind | None):
            raise ValueError(f"{name}: expected {kind.__name__}, found {shown(given)}")
    streams = np.random.default_rng(run.seed).spawn(6)  # by `learn`, judges: first, fifth
    landing = preset(run.preset, run.horizon)
    if run.experiment == "trained" and trained is None:
        trained = learn(run.seed, progress=progress)
    run, known = _known(run, landing, trained, streams[5 if run.experiment == "trained" else 0])
    _, suite, gains, problem, optimal, seconds, _ = known[-1]

    s = landing.draw_inputs(streams[1], run.trials)
    errors = perception.sample_errors(suite, run.trials, streams[2])
    bar = perception.with_bar(errors, "Clairvoyant", progress)
    flown = {}
    for policy, choices in policies(problem, optimal.choices, bar, streams[3]).items():
        altitude, control = fly(landing, run.information, s, errors, choices, gains)
        paid = np.zeros(run.trials) + (0 if choices is None else problem.perception_term(choices))
        reward = -run.alpha * control - problem.beta * paid
        flown[policy] = Flights(choices, altitude, control, paid, reward)
    posed = run, landing, suite, problem, optimal, seconds
    return Result(*posed, flown, trained, stages=tuple(known))


# --------------------------------------------------------------------- models trained on pictures


def learn(
    seed: int, folder: Path | None = None, *, progress: bool = False, **options: Any
) -> Trained:
    """Train the models of a `seed`, or load those that are in the folder; else save them there.

    The `options` are those of `train_models`; no file is overwritten.
    """
    seed = check_count("seed", seed, minimum=0, top=math.inf)
    sizes = options.get("architecture", perception.ARCHITECTURE)
    scales = (MOUNT, perception.LOWEST, perception.HIGHEST)
    made_of = repr((1, seed, sizes, sorted(options.items()), *scales))
    key = hashlib.sha256(made_of.encode()).hexdigest()[:16]
    if folder is not None:
        check_class("folder", folder, "Path")
    path = None if folder is None else folder / f"models-{key}.npz"
    if path is not None and path.exists():
        return perception.load_models(path, key, sizes)
    stream = np.random.default_rng(seed).spawn(1)[0]
    trained = perception.train_models(stream, progress=progress, **options)
    if path is not None:
        write_atomically(path, perception.pack_models(trained, key))
    return trained


def _learned(result: Result) -> Trained:
    if result.trained is None or result.settings.experiment != "trained":
        raise ValueError("result: expected one of experiment trained, found no networks in use")
    return result.trained


def fly_on_pictures(result: Result, s: Array, choices: Choices, seed: int) -> tuple[Array, ...]:
    """Land by sight, with the aircraft, networks and pattern of a result: see `fly_by_sight`.

    True inputs s are (trials, H, 1), `choices` (H,), and the `seed` is that of the scenes.  Returns
    altitude (trials, H+1), control cost (trials,), error s_hat - s (trials, H, 1).
    """
    check_class("result", result, "Result")
    _learned(result)
    stage, information = result.stages[-1], result.settings.information
    given = (result.landing, stage.skill.readers, information, s, choices, seed)
    return flights.fly_by_sight(*given, gains=stage.gains)


FLOWN = ("Optimal", "Guarded", "Best Single", "Greedy", "Random", "All Large", "All Small")


def judge_on_pictures(
    result: Result, information: str, policies: Sequence[str] = FLOWN, *, progress: bool = False
) -> tuple[Result, dict[str, Regret]]:
    """Solve under a pattern without forecast, and fly policies of `FLOWN` in three ways.

    Guarded is optimal for the suite of `guard_suite`.  Inputs and Gaussian errors are those of
    `run_experiment`, and Upsilon follows the rule for the Psi of the pattern `information`, to
    which switching cost and budget keep their ratio.
    """
    check_class("result", result, "Result")
    for policy in policies:
        check_name("policies", policy, FLOWN)
    trained, run, limits = _learned(result), result.settings, {}
    if run.upsilon and run.cost != "latency":  # milliseconds stay what they are
        first = result.stages[0].suite
        gains = gains_for(result.landing, information, first)
        rule = cost_scale(ms.psi(result.landing.task, information, gains=gains), first)
        limits = {k: v and v * (rule / run.upsilon) for k, v in asdict(run).items() if k in LIMITS}
    run = replace(run, information=information, upsilon=None, **limits)
    result = run_experiment(replace(run, trials=1), trained=trained)  # few for Clairvoyant to solve
    result = replace(result, settings=replace(result.settings, trials=run.trials))
    landing, problem, suite = result.landing, result.problem, result.suite
    gains, able = result.stages[-1].gains, result.stages[-1].skill
    _, inputs, gaussian, _, bootstrap = np.random.default_rng(run.seed).spawn(5)
    s = landing.draw_inputs(inputs, run.trials)
    given = (able.seen, landing.path[:-1], run.trials, bootstrap, FITS[run.fit])
    drawn = perception.sample_errors(suite, run.trials, gaussian), pooling.redraw(*given)
    choices = {policy: np.asarray(flown.choices) for policy, flown in result.flights.items()}
    choices["Guarded"] = ms.solve(flights.pose(problem, perception.guard_suite(suite))).choices
    bar = perception.with_bar(policies, f"Flights ({information})", progress)
    plan = (landing, able.readers, information, problem)
    way = (s, drawn, run.seed, gains)
    judged = (k for k in bar if k in choices)  # a budget leaves some out
    return result, {k: flights.judge(*plan, choices[k], *way) for k in judged}


RIVALS = ("Optimal", "Best Single", "Greedy")


def fly_stages(
    result: Result, trials: int | None = None, *, progress: bool = False
) -> dict[str, learning.Flown]:
    """Fly what is best at every stage of a run, and its `RIVALS`, by sight and in as many `trials`.

    By default they are those of the run, through its inputs; scenes are the same at every stage.
    """
    check_class("result", result, "Result")
    run, landing, found = result.settings, result.landing, {}
    held_out = len(pooling.labelled(_learned(result).residuals).altitude)
    N = run.trials if trials is None else check_count("trials", trials)
    s = landing.draw_inputs(np.random.default_rng(run.seed).spawn(2)[1], N)
    for stage in perception.with_bar(result.stages, "Stages", progress):
        best, problem = stage.optimal.choices, stage.problem
        chosen: Any = policies(problem, best, [], np.random.default_rng(run.seed))
        chosen = {k: np.asarray(c) for k, c in chosen.items() if k in RIVALS}
        given = (landing, stage.skill.readers, run.information, problem, chosen, s, run.seed)
        flown = learning.fly_rivals(*given, stage.gains)
        labels = stage.skill.seen, held_out, np.asarray(problem.psi), best
        found[stage.name] = flown._replace(labelled=learning.regret_of_labels(*labels))
    return found


SIZES = (50, 100, 400, 897)


def sample_sizes(
    result: Result, sizes: Sequence[int] = SIZES, *, repeats: int = 40, fresh: int = FRESH
) -> Array:
    """Return the regret (sizes, 2, repeats) of schedules fitted on few of a result's residuals.

    The `sizes`, `repeats` and `fresh` pictures are those of `regret_of_few`.
    """
    check_class("result", result, "Result")
    given = (result.landing, _learned(result), result.problem, ms.solve)
    rng = np.random.default_rng([result.settings.seed, 1])
    return flights.regret_of_few(*given, rng, sizes, repeats, fresh, FITS[result.settings.fit])


# ---------------------------------------------------------------------------------- the report

#: Settings of the runs that the authors logged, and what they logged.
PUBLISHED = {
    "simulated": (Settings(upsilon=1e14), EXPERIMENT_1),
    "trained": (Settings(upsilon=1e10, alpha=0.6, beta=0.4), EXPERIMENT_2),
}


def published_log(settings: Settings, offset: int = 0) -> dict[str, Array]:
    """Return the logged means, like `Result.means`, if there are any to set beside these settings.

    Model w costs (w + offset) * Upsilon: 1 is as logged, 0 converts to the convention of the text.
    """
    check_class("settings", settings, "Settings")
    offset = check_count("offset", offset, minimum=0)
    logged, table = PUBLISHED.get(settings.experiment, (None, {}))
    simulated = settings.experiment == "simulated"
    most = 7 * settings.horizon * (settings.upsilon or 0)  # a budget of that never binds
    limited = settings.switch_cost or (settings.budget is not None and settings.budget < most)
    limited = limited or settings.cost == "latency"
    settings = replace(settings, trials=100, seed=0, budget=None)
    if logged is None or limited or (simulated and settings != logged):
        return {}
    means = {}
    for policy, (control, units) in table.items():
        units += 0 if policy == "Oracle" else logged.horizon * (offset - 1)
        paid = (logged.upsilon or 0) * units
        means[policy] = np.array([control, paid, -logged.alpha * control - logged.beta * paid])
    return means


def report(result: Result) -> str:
    """Return the costs of a run's policies and the certificate of its optimum, as text.

    Below a policy stands what the authors logged of it under the same settings; below all, what is
    proved of Optimal, how often it runs each model, and how good those are.
    """
    check_class("result", result, "Result")
    run, best, suite = result.settings, result.optimal, result.suite
    ours = result.flights["Optimal"].reward
    rows = [flights.estimate(*flown[2:], ours - flown.reward) for flown in result.flights.values()]
    log = published_log(run)
    log = log if log and run.preset == PUBLISHED[run.experiment][0].preset else {}
    unit, after = UNITS[run.cost], f" {UNITS[run.cost]}".rstrip()
    price = "median ms" if run.experiment == "measured" else COSTS[run.cost]
    price += f", {run.switch_cost:g}{after} a switch" if run.switch_cost else ""
    given = (np.array(rows), log, run.trials, price, unit)
    lines = tables.table_of_policies(list(result.flights), *given)
    if unit:
        weight = f"{run.beta:g} * {result.problem.beta / run.beta if run.beta else 0:.4g}"
        lines += [f"Reward: -{run.alpha:g} control cost - {weight} a {unit} of perception."]
    lines += [
        "",
        f"Optimal: expected total {best.cost:.6e} (less alpha J(u*)), lower bound "
        f"{best.lower_bound:.6e},",
        f"gap {best.gap:.0e}, {'' if best.is_optimal else 'not '}proved optimal by {best.solver} "
        f"in {result.seconds:.2f} s.",
    ]
    if run.budget is not None:
        spent = result.problem.perception_term(best.choices)
        lines += [f"It spends {spent:.6g}{after} of a budget of {run.budget:.6g}{after}."]
        missing = ", ".join(policy for policy in LOOK if policy not in result.flights)
        lines += [f"Left out, as beyond the budget: {missing}."] if missing else []
    lines += tables.table_of_models(suite.names, best.choices, suite.mean, suite.variance)
    if run.switch_cost:
        lines += [f"It switches {np.count_nonzero(np.diff(best.choices))} times."]
    lines += tables.table_of_front(result.front, after) if result.front else []
    return "\n".join(lines)


def percentages(result: Result) -> list[dict[str, Any]]:
    """Return the comparisons of the paper in percent, from this run and from the authors' log.

    The log, and what the paper prints, stand only beside settings that they belong to.
    """
    check_class("result", result, "Result")
    log = published_log(result.settings)
    sources = {"this run": result.means(), "log at w*Upsilon": log}
    sources["log at (w+1)*Upsilon"] = published_log(result.settings, 1)
    said = 3 + list(PUBLISHED).index(result.settings.experiment) if log else 0
    compared = [(*row[:3], row[said] if log else "") for row in COMPARISONS]
    return tables.table_of_percentages(compared, QUANTITIES, sources)


def report_pictures(result: Result, *, progress: bool = False) -> str:
    """Return what became of the models: errors, landings on pictures, sample sizes, as text.

    Landings are flown under every pattern without forecast, in full under that of the run.
    """
    check_class("result", result, "Result")
    run, (networks, _, residuals) = result.settings, _learned(result)
    altitude, errors = flights.by_network(residuals)
    rms, edges, by_altitude = flights.errors_by_altitude(altitude, errors)
    sizes = np.array([(network.parameters, network.multiply_adds) for network in networks])
    parts = [tables.table_of_errors(residuals.names, sizes, rms, edges, by_altitude)]
    rows, within_reach = ms.PATTERNS.items(), flights.sensitivities(result.landing.task)
    patterns = [k for k, row in rows if not row.foresight and (row.gains or k in within_reach)]
    for information in sorted(patterns, key=lambda name: name != run.information):
        shown = ("Optimal", "All Large", "All Small") if len(parts) > 1 else FLOWN
        judged, found = judge_on_pictures(result, information, shown, progress=progress)
        compared = flights.compare(found, run.alpha, judged.problem.beta)
        parts += [tables.table_of_regrets(information, list(found), *compared, UNITS[run.cost])]
    if not ms.PATTERNS[run.information].foresight:
        flown = result.flown or fly_stages(result, progress=progress)
        parts += [tables.table_of_stages(*learning.by_stage(flown), run.trials)]
    counts = [n for n in SIZES if n <= len(altitude)]
    regret = sample_sizes(result, counts)
    shares = np.array([flights.estimate(*pair) for pair in regret])
    parts += [tables.table_of_sizes(counts, shares, regret.shape[2], FRESH)]
    return "\n\n".join("\n".join(lines) for lines in parts)


def report_measured(result: Result) -> str:
    """Return what flights on views that no fit has seen make of the schedules, as text.

    Errors are those of views near the aircraft; totals are alpha regret + beta perception cost.
    """
    check_class("result", result, "Result")
    run, problem, landing = result.settings, result.problem, result.landing
    if run.experiment != "measured":
        raise ValueError(f"result: expected one of experiment measured, found {run.experiment}")
    first, inputs, *_ = np.random.default_rng(run.seed).spawn(4)
    sights = measured.halves(measured.read(run.residuals), first)[1]
    s = landing.draw_inputs(inputs, MEASURED_FLIGHTS)
    kept = ("Optimal", "Best Single", "Greedy")
    chosen = {k: np.asarray(result.flights[k].choices) for k in kept if k in result.flights}
    given = (landing, run.information, result.stages[-1].gains, sights)
    lost = {k: measured.regret(*given, c, s, run.seed) for k, c in chosen.items()}
    paid = {k: problem.beta * float(problem.perception_term(c)) for k, c in chosen.items()}
    totals = {k: run.alpha * lost[k] + paid[k] for k in chosen}
    promised = {k: float(problem.control_term(c)) for k, c in chosen.items()}
    return "\n".join(tables.table_of_measured(promised, lost, totals, flights.leads(totals)))


def summary(result: Result) -> dict[str, Any]:
    """Return what ``--json`` writes: means, 95% intervals (None for one trial), certificate."""
    check_class("result", result, "Result")
    policies: dict[str, dict[str, Any]] = {policy: {} for policy in result.flights}
    for policy, flown in result.flights.items():
        rows = flights.estimate(*flown[2:]).tolist()
        for quantity, (mean, half) in zip(QUANTITIES, rows, strict=True):
            interval = None if math.isnan(half) else [mean - half, mean + half]
            policies[policy] |= {quantity: mean, f"{quantity}_interval": interval}
    used, kept = asdict(result.settings).items(), (*LIMITS, *LEARNING)
    front = result.front and {k: np.asarray(v).tolist() for k, v in result.front._asdict().items()}
    more = {"front": front, "stages": result.flown and learning.in_numbers(result.flown)}
    return {
        "policies": policies,
        "schedule": result.optimal.choices.tolist(),
        "lower_bound": result.optimal.lower_bound,
        "gap": result.optimal.gap,
        "solve_seconds": result.seconds,
        "settings": {k: v for k, v in used if k not in kept or v != getattr(Settings, k)},
    } | {k: v for k, v in more.items() if v}


# -------------------------------------------------------------------------------- command line


def write_percentages(result: Result, path: Path) -> None:
    """Write the rows of `percentages` to the file `path` as CSV, below their names."""
    check_class("result", result, "Result")
    write_atomically(path, tables.as_csv(percentages(result)).encode())


def _parser() -> options.Parser:
    """Make a parser of the fields of `Settings`, and of where to write what."""
    fields = {k: v for k, v in asdict(Settings()).items() if k != "residuals"}
    return options.of_landings(fields, _names())


@options.plain_warnings("landing.py")
def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line.

    Returns 0, or 130 after Ctrl-C; bad input in `argv` ends it with status 2 and a line on why.
    """
    parser = _parser()
    parser.set_defaults(**DEFAULTS.get(parser.parse_known_args(argv)[0].experiment, {}))
    given = vars(parser.parse_args(argv))
    out, path, bare, quiet = (given.pop(key) for key in ("out", "json", "no_figures", "quiet"))
    seconds = given.pop("front")
    try:
        given["residuals"] = given["residuals"] and str(given["residuals"])
        settings = Settings(**given)
        learns = settings.experiment == "trained"
        seconds is None or check_number("front", seconds, minimum=0)
        check_targets(None if bare and not learns else out, path)
        trained = learn(settings.seed, out, progress=not quiet) if learns else None
        result = run_experiment(settings, trained=trained, progress=not quiet)
        if seconds is not None:
            front = whole_front(result.problem, seconds, progress=not quiet)
            result = replace(result, front=front)
        sighted = trained and not ms.PATTERNS[settings.information].foresight
        if sighted and (path or not (bare and quiet)):
            result = replace(result, flown=fly_stages(result, progress=not quiet))
        if not quiet:
            print(report(result))
        if settings.experiment == "measured" and not quiet:
            print("\n" + report_measured(result))
        if trained:
            perception.write_residuals(out / "residuals.csv", trained.residuals)
            if not quiet:
                print("\n" + report_pictures(result, progress=True))
        if not bare:
            write_figures(result, out, progress=not quiet)
            write_percentages(result, out / "percentages.csv")
        if path:
            write_atomically(path, dumps(summary(result), indent=1).encode())
        sys.stdout.flush()  # a full disk or a closed pipe shows here
    except (ValueError, OSError, MemoryError, OverflowError) as error:
        parser.error(error)
    except KeyboardInterrupt:
        return parser.interrupted()
    return 0


if __name__ == "__main__":
    signal.signal(signal.SIGINT, signal.default_int_handler)
    sys.exit(main())
