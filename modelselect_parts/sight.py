"""Landing by sight: what a drone sees on its way, and what that does to its way.

At every step a picture is taken from where errors so far have led the drone, and the controller
acts on what the scheduled network reads off it.  Other networks may be shown the same scene, to
note by how much each would have erred.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import numpy.typing as npt

from modelselect_parts.camera import (
    HIGHEST,
    LOWEST,
    Pictures,
    draw_pose,
    draw_scenes,
    photograph,
)
from modelselect_parts.checks import Array, Choices, check_array, check_choices, check_count
from modelselect_parts.observers import kalman_gains
from modelselect_parts.regulator import (
    PATTERNS,
    ControlTask,
    check_information,
    control_cost,
    roll_out,
)
from modelselect_parts.suites import PerceptionSuite

MOST_PITCH = 0.2  # rad that the mount of the camera turns with the drone
UNFORESEEN = 1e-4  # of a gust's variance, that pushes what gusts do not: no plant is known exactly
Shutter = Callable[[int], Pictures]  #: side in pixels -> pictures (N, side, side)


@dataclass(frozen=True, eq=False)
class Aircraft:
    """What lands.  States: altitude less the path, its rate, pitch, its rate."""

    task: ControlTask
    x0: Array  #: (n,), initial state
    prior_mean: Array  #: (H, p), expectation of s: all that a causal controller foresees
    gust: float  #: root of E[s_t^2], from which a filter knows how much it has missed
    path: Array  #: (H+1,), altitude = path + first state
    dt: float  #: seconds a step


def gains_for(landing: Aircraft, information: str, suite: PerceptionSuite) -> Array | None:
    """Return the gains (H, n, 1) of a Kalman filter where a pattern takes gains, or None.

    The filter takes the mean square error of the median model at a step for the noise of that
    measurement, and gusts for the noise of the process.
    """
    check_information(information)
    if not PATTERNS[information].gains:
        return None
    C = landing.task.C
    push = landing.gust**2 * (C @ C.T + UNFORESEEN * np.eye(len(C)))
    square = suite.mean[..., 0] ** 2 + suite.variance[..., 0]
    available = np.isfinite(np.broadcast_to(suite.cost, square.shape))
    noise = np.nanmedian(np.where(available, square, np.nan), axis=1)
    return kalman_gains(landing.task, push, noise[:, None, None])


class Reader(Protocol):
    """What reads altitudes off pictures: a network, or one that was calibrated."""

    @property
    def side(self) -> int:
        """Pixels along a side of its pictures."""

    def altitude(self, pictures: npt.ArrayLike) -> Array:
        """Estimate altitudes (N,) from pictures (N, side, side)."""


def _viewer(landing: Aircraft, N: int, seed: int) -> Callable[[int, Array], tuple[Array, Shutter]]:
    """Return what N drones see: a function of step t and states (N, n), asked from step to step.

    It gives their altitudes (N,), and a shutter.  The scene of a landing stays the same, but for
    what moves and shakes: so errors depend on the state, and on those before.  Beyond its range
    the camera sees what it sees at the end of it, and its mount turns by `MOST_PITCH`.
    """
    rng = np.random.default_rng(seed)
    scene = draw_scenes(N, rng)

    def view(t: int, x: Array) -> tuple[Array, Shutter]:
        h, shaken = landing.path[t] + x[:, 0], scene._replace(pose=draw_pose(N, rng))
        pitch, seconds = np.clip(x[:, 2], -MOST_PITCH, MOST_PITCH), t * landing.dt

        def shoot(side: int) -> Pictures:
            # Noise of its own stream, so that all policies meet the same poses; [seed, 0] would be
            # that of the scenes, as NumPy pads a seed with zeros.
            noise, within = np.random.default_rng([seed, t, 1]), np.clip(h, LOWEST, HIGHEST)
            return photograph(shaken, within, side, noise, pitch=pitch, seconds=seconds)

        return h, shoot

    return view


def fly_by_sight(
    landing: Aircraft,
    readers: Sequence[Reader],
    information: str,
    s: Array,
    choices: Choices,
    seed: int,
    *,
    gains: npt.ArrayLike | None = None,
    label: Sequence[Reader] = (),
) -> tuple[Array, Array, Array]:
    """Land by what the scheduled readers see; return altitude, control cost and errors.

    True inputs s are (N, H, 1) and `choices` (H,); the `seed` of the scenes is the same for all
    policies, and `gains` are those of `psi`; with another N the scenes of all flights are others.
    Altitudes are (N, H+1), costs (N,), and errors s_hat - s (N, H, 1), or (N, H, K) of K others to
    `label`, where they are given.
    """
    check_information(information)
    if PATTERNS[information].foresight:
        raise ValueError(f"information: a flight has no forecast, found {information!r}")
    task = landing.task
    s = check_array("s", s, "trials H p", (None, task.horizon, task.p))
    check_array("choices", choices, "H", (task.horizon,))
    models = check_choices(choices, task.horizon, len(readers))
    view = _viewer(landing, len(s), check_count("seed", seed, minimum=0, top=math.inf))
    errors = np.empty((len(s), task.horizon, len(label) or 1))

    def look(t: int, x: Array) -> Array:
        h, shoot = view(t, x)

        def error(reader: Reader) -> Array:
            return reader.altitude(shoot(reader.side)) - h

        made = error(readers[models[t]])
        errors[:, t] = np.stack([error(reader) for reader in label] or [made], axis=-1)
        return made[:, None]

    expected = landing.prior_mean[None] * PATTERNS[information].now
    x, u = roll_out(task, landing.x0, s, look, information, expected, gains=gains)
    return landing.path + x[..., 0], control_cost(task, x, u), errors
