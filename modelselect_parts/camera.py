"""Pictures of a helipad, as a drone that lands on it sees them (``fig:airsim_env``).

A pinhole camera looks down from z = altitude + `MOUNT` feet.  It is held as a pose says, over
ground with texture, moving clutter and a disc that is no pad; near the ground, rotor wash shakes
it and raises dust.  All that differs from picture to picture is drawn beforehand, in a `Scene`.
"""

from __future__ import annotations

import math
from functools import reduce
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from modelselect_parts.checks import (
    Array,
    as_numbers,
    check_array,
    check_class,
    check_count,
    check_number,
    check_range,
    check_rng,
)

Pictures = npt.NDArray[np.float32]

#: Feet: height of the camera on the landed drone, radius of the pad, lowest and highest altitude.
MOUNT, PAD, LOWEST, HIGHEST = 5.0, 14.0, -2.0, 135.0
#: Half the width of the view over the distance: a field of view of 74 degrees.
TANGENT = 0.75
LARGEST = 1e15  # squares of numbers up to here do not overflow in single precision


class Scene(NamedTuple):
    """What N pictures show beside the pad, and how the camera is held."""

    light: Array  #: (N, 6), exposure and its two slopes, greys of ground, pad and paint
    waves: Array  #: (N, 6, 4), texture: wave vector in rad/ft, phase, size
    boxes: Array  #: (N, 5, 7), moving clutter: place and half-sides in ft, turn, grey, ft/s
    decoy: Array  #: (N, 4), a disc that is no pad: place and radius in ft, grey
    pose: Array  #: (N, 8), of `draw_pose`


# ------------------------------------------------------------------------------ what is drawn


def draw_pose(count: int, rng: np.random.Generator) -> Array:
    """Draw how the camera is held, (count, 8): normal numbers with mean 0.

    Pitch, roll (rad), offset to the right and ahead (ft per ft of distance), heading (rad), blur
    and shake (share of the view), dust (share of the light).
    """
    pose = check_rng(rng).standard_normal((check_count("count", count), 8))
    pose *= [0.05, 0.05, 0.05, 0.05, 0.6, 0.015, 0.15, 0.3]
    return pose


def draw_scenes(count: int, rng: np.random.Generator) -> Scene:
    """Draw `count` independent scenes: all but the pose is uniform, or so in its logarithm."""
    pose, draw = draw_pose(count, rng), rng.uniform
    N = len(pose)
    turn, phase = draw(0, 2 * np.pi, (2, N, 6))
    far = draw([14] * 5 + [30], [50] * 5 + [60], (N, 6))
    place = far[..., None] * np.stack([np.cos(turn), np.sin(turn)], -1)
    k = 2 * np.pi * np.exp(-draw(0, np.log(60), (N, 6)))  # waves of 1 to 60 ft
    size = draw(0.01, 0.03, (N, 6))
    box = draw([0.7, 0.7, 0, 0, -3], [7, 3, np.pi, 1, 3], (N, 5, 5))
    return Scene(
        draw([0.55, -0.25, -0.25, 0.3, 0.12, 0.75], [1, 0.25, 0.25, 0.55, 0.3, 1], (N, 6)),
        np.stack([k * np.cos(turn), k * np.sin(turn), phase, size], -1),
        np.concatenate([place[:, :5], box], -1),
        np.concatenate([place[:, 5], draw([3, 0.1], [14, 0.9], (N, 2))], -1),
        pose,
    )


def draw_views(count: int, rng: np.random.Generator) -> tuple[Scene, Array, Array]:
    """Draw `count` scenes, altitudes in ft, and pitch in rad: a Scene and two arrays (count,).

    The logarithm of the distance is uniform, the pitch of the drone N(0, 0.08^2).
    """
    scene, low, high = draw_scenes(count, rng), LOWEST + MOUNT, HIGHEST + MOUNT
    N = len(scene.pose)
    z = np.exp(rng.uniform(math.log(low), math.log(high), N))
    return scene, np.clip(z - MOUNT, LOWEST, HIGHEST), rng.normal(0, 0.08, N)


# ----------------------------------------------------------------------------- what is seen


def photograph(
    scene: Scene,
    altitude: npt.ArrayLike,
    side: int,
    rng: np.random.Generator,
    *,
    pitch: npt.ArrayLike = 0.0,
    seconds: float = 0.0,
) -> Pictures:
    """Take pictures (N, side, side), greys from 0 to 1, looking down on the pad.

    At a distance z = altitude + `MOUNT`, a length l covers side * l / (2 `TANGENT` z) pixels.  An
    edge is as soft as a pixel or the blur is wide, so that all sizes show the same scene.

    The altitude (N,) lies between `LOWEST` and `HIGHEST`; pitch (N,) or () in rad is that of the
    drone, to which the pose adds vibration; the clutter has moved for so many seconds; `rng`
    draws the noise of the sensor.
    """
    scene, N, S = _check_scene(scene), len(scene.pose), check_count("side", side)
    h, seconds = _check_altitude(altitude, N), check_number("seconds", seconds)
    single = as_numbers("pitch", pitch).ndim == 0
    pitch = check_array("pitch", np.full(N, pitch) if single else pitch, "N", (N,))
    check_range("pitch", abs(pitch), LARGEST)
    check_range("seconds", np.array(abs(seconds)), LARGEST)
    check_rng(rng)
    size = max(1, 40_000 // S**2)  # pictures at a time, which fit a processor's cache
    blocks = [slice(i, i + size) for i in range(0, N, size)]
    parts = [(Scene(*(table[b] for table in scene)), h[b], pitch[b]) for b in blocks]
    return np.concatenate([_expose(*part, S, rng, seconds) for part in parts])


def _expose(
    scene: Scene, h: Array, pitch: Array, S: int, rng: np.random.Generator, seconds: float
) -> Pictures:
    """Take the pictures of one block: see `photograph`."""
    z, tilt = _columns(np.stack([h + MOUNT, pitch], -1))
    *_, blur, shake, dust = _columns(scene.pose)
    u = ((2 * np.arange(S) + 1) / S - 1).astype(np.float32)  # from -1 at the left to 1
    x, y = _meet_the_ground(scene.pose, z, tilt, TANGENT * u, -TANGENT * u[:, None])
    wash = np.exp((MOUNT - z) / 8)
    foot = z * TANGENT * np.hypot(2 / S, abs(blur) + wash * abs(shake))
    picture = _paint(scene, x, y, foot, seconds)
    picture += wash * np.minimum(abs(dust), 0.5) * (0.6 - picture)
    bright, across, along, *_ = _columns(scene.light)
    picture *= bright * (1 + across * u - along * u[:, None])
    picture += 0.02 * rng.standard_normal(picture.shape, dtype=np.float32)
    return np.clip(picture, 0, 1)


def _meet_the_ground(
    pose: Array, z: Pictures, tilt: Pictures, a: Pictures, b: Pictures
) -> tuple[Pictures, Pictures]:
    """Places in ft, the pad at 0, where the rays (a, b, -1) of the pixels meet the ground.

    With c, s = cos, sin of its tilt, a ray that falls by c - b s moves a to the right and
    b c + s ahead; after a fall of z it is at

        p = z ((a + roll) / (c - b s) + right),    q = z ((b c + s) / (c - b s) + ahead),

    seen from the camera, and the heading turns (p, q) to (x, y).
    """
    pitch, roll, right, ahead, heading, *_ = _columns(pose)
    c, s = np.cos(pitch + tilt), np.sin(pitch + tilt)
    fall = c - b * s
    p, q = z * ((a + roll) / fall + right), z * ((b * c + s) / fall + ahead)
    c, s = np.cos(heading), np.sin(heading)
    return p * c - q * s, p * s + q * c


def _paint(scene: Scene, x: Pictures, y: Pictures, foot: Pictures, seconds: float) -> Pictures:
    """Grey of what lies at (x, y) ft, seen by pixels `foot` ft wide, from the ground up."""

    def cover(tone: Any, *inside: Any) -> None:
        """Paint where all `inside`, the depths in ft behind an edge, are positive."""
        shares = [np.clip(depth / foot + np.float32(0.5), 0, 1) for depth in inside]
        picture[...] += reduce(np.multiply, shares) * (tone - picture)

    *_, ground, asphalt, paint = _columns(scene.light)
    texture = np.zeros_like(x)
    for k1, k2, phase, size in map(_columns, np.swapaxes(scene.waves, 0, 1)):
        fade = np.exp(-(k1**2 + k2**2) * foot**2 / 8)  # fine waves average out in a pixel
        texture += size * fade * np.sin(k1 * x + k2 * y + phase)
    picture, X, Y, r = ground + texture, abs(x) / PAD, abs(y) / PAD, np.hypot(x, y) / PAD
    cx, cy, radius, grey = _columns(scene.decoy)
    cover(grey, radius - np.hypot(x - cx, y - cy))
    cover((ground + paint) / 2 + texture, PAD * (2.4 - X), PAD * (2.4 - Y))  # the apron
    cover(asphalt + texture / 2, PAD * (1 - r))
    cover(paint, PAD * (0.07 - abs(r - 0.88)))  # ring, legs and bar of the H
    cover(paint, PAD * (0.07 - abs(X - 0.26)), PAD * (0.45 - Y))
    cover(paint, PAD * (0.26 - X), PAD * (0.07 - Y))
    for cx, cy, a, b, turn, grey, speed in map(_columns, np.swapaxes(scene.boxes, 0, 1)):
        c, s = np.cos(turn), np.sin(turn)
        p, q = x - cx - seconds * speed * c, y - cy - seconds * speed * s
        for shift, tone in ((1, picture / 2), (0, grey)):  # the shadow, then the thing
            dx, dy = p - shift, q + shift
            cover(tone, a - abs(dx * c + dy * s), b - abs(dy * c - dx * s))
    return picture


def _columns(table: Array) -> list[Pictures]:
    """Return the columns of a table (N, k), each to act on pictures (N, side, side)."""
    return list(table.T.astype(np.float32)[..., None, None])


# --------------------------------------------------------------------------------- its checkers


def _check_altitude(altitude: npt.ArrayLike, count: int) -> Array:
    """Return altitudes (count,) in ft that the camera can see."""
    h = check_array("altitude", altitude, "N", (count,))
    if h.min() < LOWEST or h.max() > HIGHEST:
        found = f"{h.min():g} to {h.max():g}"
        raise ValueError(f"altitude: expected {LOWEST:g} to {HIGHEST:g} ft, found {found}")
    return h


def _check_scene(scene: Scene) -> Scene:
    """Return the scene with its tables checked."""
    check_class("scene", scene, "Scene")
    shapes, checked = ((6,), (6, 4), (5, 7), (4,), (8,)), []
    for name, table, shape in zip(Scene._fields, scene, shapes, strict=True):
        axes, sizes = " ".join(["N", *map(str, shape)]), (len(scene.pose), *shape)
        checked.append(check_array(f"scene.{name}", table, axes, sizes))
        check_range(f"scene.{name}", abs(checked[-1]), LARGEST)
    return Scene(*checked)
