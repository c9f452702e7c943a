"""How wrong is each perception model, and when?  Error models: simulated, or measured.

At step t a perception model w looks at the world and reports s_hat where the truth is s.  A
schedule need not know why it errs.  All that it needs is

    mean[t, w]     = E[s_hat - s]      (``eq:perModelExp``), the *bias*
    variance[t, w] = Var[s_hat - s]    (``eq:perModelVar``)
    cost[t, w]     of one invocation   (``eq:perceptionCostDistro``)

These tables are a `PerceptionSuite`.  Some are simulated: `published_suite` draws that of the
paper's first experiment, `gaussian_suite` makes one of two formulas.  Others are measured, by
`fit_suite`, on data new to the models.  What models do besides erring, giving nothing or answering
late, makes another suite of one (`with_dropouts`, `with_latency`).  At the end, we train some that
read altitudes off pictures.

Two models on the way down, one small, one large and half as wrong:

>>> h = np.array([40.0, 20.0, 10.0])
>>> bias, spread = lambda w, h: h / 10 / (1 + w), lambda w, h: h / 20 / (1 + w)
>>> suite = gaussian_suite(bias, spread, cost=[1, 4], at=h)
>>> suite.mean[..., 0]  # a row a step, a column a model
array([[4. , 2. ], [2. , 1. ], [1. , 0.5]])

Of a real robot, nobody knows these numbers.  One measures errors, and estimates them:

>>> errors = sample_errors(suite, 30, np.random.default_rng(1))[..., 0]
>>> _, step, model = (index.ravel() for index in np.indices(errors.shape))
>>> residuals = Residuals(suite.names, model, h[step], errors.ravel())
>>> fitted = fit_suite(residuals, trajectory=h, cost=suite.cost, bins=[0, 15, 30, 50])
>>> fitted.mean[..., 0].round(2)
array([[3.89, 1.88], [1.64, 1.02], [1.08, 0.47]])

A guard against luck with so few: each bias is at most this large, with a chance of 95%.

>>> guard_suite(fitted).mean[..., 0].round(2)
array([[4.52, 2.13], [1.9 , 1.14], [1.23, 0.54]])
"""

from __future__ import annotations

import io
import pathlib
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from modelselect_parts import networks as nets
from modelselect_parts.camera import (
    HIGHEST,
    LOWEST,
    MOUNT,
    PAD,
    TANGENT,
    Pictures,
    Scene,
    draw_pose,
    draw_scenes,
    draw_views,
    photograph,
)
from modelselect_parts.checks import (
    Array,
    Frozen,
    as_numbers,
    check_array,
    check_class,
    check_classes,
    check_count,
    check_function,
    check_name,
    check_number,
    check_range,
    check_rng,
    frozen,
    shown,
)
from modelselect_parts.checks import Choices as Indices
from modelselect_parts.files import told
from modelselect_parts.kernels import Kernel
from modelselect_parts.matrices import check_semidefinite
from modelselect_parts.measurements import PathLike, Residuals
from modelselect_parts.networks import (
    ARCHITECTURE,
    EFFICIENTNET,
    Layer,
    ModelTable,
    Network,
    forward,
    gradients,
    train_network,
)
from modelselect_parts.residual_files import read_residuals, write_residuals
from modelselect_parts.residuals import (
    altitude_bins,
    bootstrap_errors,
    fit_suite,
    guard_suite,
)
from modelselect_parts.suites import (
    LARGEST,
    PerceptionSuite,
    Rng,
    measured_latency,
    priced,
    sample_errors,
    with_dropouts,
    with_latency,
)

Sizes = Sequence[tuple[int, int, int]]  #: see `ARCHITECTURE`

# ---------------------------------------------------------------------------- simulated suites


def published_suite(horizon: int, rng: Rng, upsilon: float = 1e14) -> PerceptionSuite:
    """Draw the suite of experiment 1: b0 to b7, p = 1, b7 the best at every step.

    At each of H = `horizon` steps, from b7 down to b0, a model adds uniform draws to the mean and
    the variance of the one before it; their upper ends are the constants of the authors' public
    code.  Model w costs w * `upsilon` (``eq:perceptionCostDistro``; the code charges one more).
    """
    H, step = check_count("horizon", horizon), check_number("upsilon", upsilon, minimum=0)
    mean, variance = (
        np.cumsum(check_rng(rng).uniform(0, increments, (H, 8)), axis=1)[:, ::-1, None]
        for increments in (
            [0.05, 0.1, 1, 4, 8, 12, 16, 16],
            [0.3, 0.06, 0.08, 0.01, 0.02, 0.02, 0.03, 0.03],
        )
    )
    return PerceptionSuite(EFFICIENTNET.names, mean, variance, step * np.arange(8.0))


def gaussian_suite(
    bias: Callable[[Array, Array], ArrayLike],
    spread: Callable[[Array, Array], ArrayLike],
    cost: ArrayLike | Mapping[str, ArrayLike],
    at: ArrayLike,
    *,
    names: Sequence[str] | None = None,
    jitter: tuple[float, float] = (0.0, 0.0),
    signs: str = "same",
    rng: Rng | None = None,
) -> PerceptionSuite:
    """Make a suite (p = 1) of a formula for the bias and one for the standard deviation.

    Both are functions of w (W,), the numbers of the models, and of x (H, 1), which is `at`: the
    steps, or the altitudes on the way; they return (H, W).  The `cost` (W,) or (H, W), or by name,
    sets W.

        mean = ± bias(w, x) (1 + jitter[0] z),   variance = (spread(w, x) (1 + jitter[1] z))^2

    with z standard normal, new for each entry.  The `signs` stay the ``same``, or are drawn, one
    for each ``model``, or for each ``step`` and model; a seed gives the same magnitudes in all.
    The `names` are b0, b1, ... unless given; jitter and random signs need an `rng`.
    """
    check_function("bias", bias)
    check_function("spread", spread)
    x = check_array("at", at, "H", (None,))
    if names is None and isinstance(cost, Mapping):
        names = list(cost)
    known = () if names is None else names
    price = check_array("cost", priced(cost, known), "... W", (None,), finite=False)
    H, W = len(x), price.shape[-1]
    w = np.arange(W, dtype=np.float64)
    with np.errstate(all="ignore"):
        mean = check_array("bias", bias(w, x[:, None]), "H W", (H, W))
        deviation = check_array("spread", spread(w, x[:, None]), "H W", (H, W))
    check_range("spread", deviation, LARGEST)
    relative = check_array("jitter", jitter, "2", (2,))
    check_range("jitter", relative, LARGEST)
    check_name("signs", signs, ("same", "model", "step"))
    if relative.any() or signs != "same":
        rng = check_rng(rng)
        factor = 1 + relative[:, None, None] * rng.standard_normal((2, H, W))
        mean, deviation = mean * factor[0], deviation * factor[1]
        if signs != "same":
            mean = mean * rng.choice([-1, 1], (H if signs == "step" else 1, W))
    names = [f"b{i}" for i in range(W)] if names is None else names
    return PerceptionSuite(names, mean[..., None], deviation[..., None] ** 2, price)


def textbook_suite(
    altitude: ArrayLike, rng: Rng, signs: str = "same", upsilon: float = 1.0
) -> PerceptionSuite:
    """Draw the suite of the textbook aircraft: eight models, all better near the ground.

    At `altitude` h (H,) in feet, model w has bias 1.5 * 0.6^w * (0.3 + h/100) ft and standard
    deviation 2 * 0.65^w * (0.3 + h/100) ft, with 20% and 10% of jitter, `signs` as in
    `gaussian_suite`, and costs w * `upsilon`.
    """
    return gaussian_suite(
        lambda w, h: 1.5 * 0.6**w * (0.3 + h / 100),
        lambda w, h: 2.0 * 0.65**w * (0.3 + h / 100),
        check_number("upsilon", upsilon, minimum=0) * np.arange(8),
        check_array("altitude", altitude, "H", (None,)),
        jitter=(0.2, 0.1),
        signs=signs,
        rng=rng,
    )


# ---------------------------------------------------------------------------- models that learn

#: What the networks read: altitudes that the camera sees.
REACH = nets.Reach(MOUNT, LOWEST, HIGHEST)
LOG_MEAN, LOG_DEVIATION = REACH.log_mean, REACH.log_deviation
CENTRE, SPREAD = LOG_MEAN, LOG_DEVIATION  # their old names


def new_network(shape: tuple[int, int, int], rng: Rng) -> Network:
    """Draw a network for the camera, with random weights; `shape` is a row of `ARCHITECTURE`."""
    return nets.draw_network(shape, REACH, rng)


class Trained(NamedTuple):
    """W networks, how they learned, and how they err on pictures that they never saw."""

    networks: list[Network]
    losses: Array  #: (W, epochs), mean squared error in training, in units of LOG_DEVIATION^2
    residuals: Residuals  #: on the M held-out pictures, all those of the first network first


def train_models(
    rng: Rng,
    *,
    architecture: Sizes = ARCHITECTURE,
    training: int = 2093,
    held_out: int = 897,
    epochs: int = 30,
    progress: bool = False,
) -> Trained:
    """Photograph, train, and measure on pictures held out: ``subsec:expAirsim`` in small.

    All networks, one a row of `architecture`, see the same scenes, each at its own resolution:
    `training` pictures in so many `epochs`, and then, once, the `held_out` ones.
    """
    sizes = check_array("architecture", architecture, "W 3", (None, 3))
    n, M = check_count("training", training), check_count("held_out", held_out)
    scenes, h, pitch = draw_views(n + M, rng)
    networks = [new_network(size, rng) for size in sizes]
    losses, errors = [], []
    for network in with_bar(networks, "Training", progress):
        pictures = photograph(scenes, h, network.side, rng, pitch=pitch)
        losses.append(train_network(network, pictures[:n], h[:n], epochs, rng))
        errors.append(network.altitude(pictures[n:]) - h[n:])
    W = len(networks)
    measured = _name_models(np.tile(h[n:], W), np.concatenate(errors), W)
    return Trained(networks, np.array(losses), measured)


def measure_models(networks: Sequence[Network], count: int, rng: Rng) -> Residuals:
    """Measure networks on `count` new pictures: fresh data, for a second opinion."""
    check_classes("networks", networks, "Network")
    scene, h, pitch = draw_views(count, rng)
    seen = [n.altitude(photograph(scene, h, n.side, rng, pitch=pitch)) - h for n in networks]
    return _name_models(np.tile(h, len(seen)), np.concatenate(seen), len(seen))


def _name_models(altitude: Array, residual: Array, W: int) -> Residuals:
    """Residuals of b0, b1, ..., which come in W blocks of equal length."""
    model = np.repeat(np.arange(W), len(residual) // W)
    check_array("residual", residual, "N", (None,))
    return Residuals([f"b{w}" for w in range(W)], model, altitude, residual)


def pack_models(trained: Trained, key: str) -> bytes:
    """Return the .npz file from which `load_models` restores `trained`, marked with `key`."""
    check_class("trained", trained, "Trained")
    file, found = io.BytesIO(), trained.residuals
    arrays: dict[str, Any] = {"key": np.array(key), "losses": trained.losses}
    arrays |= {"altitude": found.altitude, "residual": found.residual}
    np.savez(file, **arrays | nets.named_arrays(trained.networks))
    return file.getvalue()


def load_models(path: PathLike, key: str, architecture: Sizes = ARCHITECTURE) -> Trained:
    """Read a file of `pack_models`; ``allow_pickle=False``, so no code in it can run.

    The file at `path` must bear the mark `key`, such as a hash of all settings that the models
    depend on, and hold networks of this `architecture`.
    """
    sizes = check_array("architecture", architecture, "W 3", (None, 3))
    networks = [new_network(size, np.random.default_rng(0)) for size in sizes]
    W, where = len(networks), told(path)
    try:
        raw = pathlib.Path(path).read_bytes()
    except (OSError, TypeError, ValueError) as error:
        why = getattr(error, "strerror", None) or error
        raise ValueError(f"path: expected a file of models, found {where!r}: {why}") from None
    try:
        with np.load(io.BytesIO(raw), allow_pickle=False) as file:
            found = dict(file)
        if str(found["key"]) != key:
            raise ValueError(f"expected the key {key}, found {str(found['key'])[:40]}")
        for name, array in nets.named_arrays(networks).items():
            axes = "n k" if array.ndim == 2 else "k"
            array[...] = check_array(name, found[name], axes, array.shape)
        losses = check_array("losses", found["losses"], "W epochs", (W, None))
        return Trained(networks, losses, _name_models(found["altitude"], found["residual"], W))
    except Exception as error:  # damage can surface as almost any of them
        why = told(error).split(". ")[0][:150]
        raise ValueError(f"{where}: no file of these models, delete or move it: {why}") from None


def with_bar(items: Iterable[Any], title: str, progress: bool) -> Any:
    """Go through `items` with a bar and its `title`, if tqdm is installed, at a terminal."""
    try:
        from tqdm import tqdm
    except ImportError:
        return items
    return tqdm(items, title, leave=False, disable=not progress or None)
