"""How wrong is each perception model, and when?  Error models: simulated, or measured.

At step t a perception model w looks at the world and reports s_hat where the truth is s.  A
schedule need not know why it errs.  All that it needs is

    mean[t, w]     = E[s_hat - s]      (``eq:perModelExp``), the *bias*
    variance[t, w] = Var[s_hat - s]    (``eq:perModelVar``)
    cost[t, w]     of one invocation   (``eq:perceptionCostDistro``)

These tables are a `PerceptionSuite`.  Some are simulated: `published_suite` draws that of the
paper's first experiment, `gaussian_suite` makes one of two formulas.  Others are measured, by
`fit_suite`, on data new to the models.  At the end, we train some that read altitudes off pictures.

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

import csv
import io
import os
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple
from weakref import WeakValueDictionary

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import chdtri, stdtrit

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
    check_count,
    check_name,
    check_number,
    check_range,
    check_rng,
    check_semidefinite,
    frozen,
    shown,
)
from modelselect_parts.checks import Choices as Indices
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

Rng = np.random.Generator
PathLike = str | os.PathLike[str]
Sizes = Sequence[tuple[int, int, int]]  #: see `ARCHITECTURE`
LARGEST = 1e150  # squares of numbers up to here do not overflow

# ----------------------------------------------------------------------------- the error model


@dataclass(frozen=True, eq=False)
class PerceptionSuite(Frozen):
    """Mean and variance of the error s_hat - s of W models at H steps, and what each costs.

    The variance is that of each component, or the covariance within a step.  A suite that was
    measured knows on how many residuals each mean rests, and its standard error.  With
    ``dataclasses.replace(suite, cost=...)`` it is the same suite at another price.
    """

    names: Sequence[str]  #: (W,), distinct
    mean: Array  #: (H, W, p), in units of perception
    variance: Array  #: (H, W, p) or (H, W, p, p)
    cost: Array  #: (W,) or (H, W), of one invocation; inf where a model is not available
    sample_size: Indices | None = None  #: (H, W)
    standard_error: Array | None = None  #: (H, W, p)

    def __post_init__(self) -> None:
        names = _check_names(self.names)
        mean = check_array("mean", self.mean, "H W p", (None, len(names), None))
        H, W, p = mean.shape
        variance = check_array("variance", self.variance, "...", ())
        shape = ("H W p p", (H, W, p, p)) if variance.ndim == 4 else ("H W p", (H, W, p))
        variance = check_array("variance", variance, *shape)
        if variance.ndim == 4:
            variance = check_semidefinite("variance", variance)
        else:
            check_range("variance", variance)
        cost = check_array("cost", self.cost, "...", (), finite=False)
        width = ("H W", (H, W)) if cost.ndim == 2 else ("W", (W,))
        cost = check_array("cost", cost, *width, finite=False)
        if np.isneginf(cost).any() or np.isinf(np.atleast_2d(cost)).all(axis=1).any():
            raise ValueError("cost: expected a finite cost at every step, found none or -inf")
        self._set(names=names, mean=mean, variance=variance, cost=cost)
        if self.sample_size is not None:
            size = _check_whole("sample_size", self.sample_size, "H W", (H, W), 2**53)
            self._set(sample_size=size)
        if self.standard_error is not None:
            error = check_array("standard_error", self.standard_error, "H W p", mean.shape)
            check_range("standard_error", error)
            self._set(standard_error=error)

    def pick(self, models: Sequence[str | int]) -> PerceptionSuite:
        """Return the suite of these `models` only, by name or by index, in this order."""
        number = {key: w for w, name in enumerate(self.names) for key in (name, w)}
        # A mask of truths would pass for the indices 0 and 1.
        unknown = [w for w in models if isinstance(w, bool | np.bool_) or w not in number]
        if unknown or isinstance(models, str):
            raise ValueError(
                f"models: expected names among {', '.join(self.names)}, or indices, "
                f"found {shown([*unknown, models][0])}"
            )
        w = [number[model] for model in models]
        given = {k: table for k, table in vars(self).items() if isinstance(table, np.ndarray)}
        tables = {k: table[..., w] if k == "cost" else table[:, w] for k, table in given.items()}
        return replace(self, names=[self.names[i] for i in w], **tables)


def sample_errors(suite: PerceptionSuite, trials: int, rng: Rng) -> Array:
    """Draw Gaussian errors (trials, H, W, p) of all models, independent across steps and models.

    e = mean + F z with z standard normal and F F' the covariance within a step.  F is its
    symmetric square root, which exists for a singular covariance as well.
    """
    N = check_count("trials", trials)
    z = check_rng(rng).standard_normal((N, *suite.mean.shape))
    if suite.variance.ndim == 3:
        return suite.mean + np.sqrt(suite.variance) * z
    values, V = np.linalg.eigh(suite.variance)
    # Rounding may leave a zero eigenvalue below zero.
    F: Array = V * np.sqrt(np.maximum(values, 0))[..., None, :] @ np.swapaxes(V, -1, -2)
    return suite.mean + (F @ z[..., None])[..., 0]


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
    cost: ArrayLike,
    at: ArrayLike,
    *,
    names: Sequence[str] | None = None,
    jitter: tuple[float, float] = (0.0, 0.0),
    signs: str = "same",
    rng: Rng | None = None,
) -> PerceptionSuite:
    """Make a suite (p = 1) of a formula for the bias and one for the standard deviation.

    Both are functions of w (W,), the numbers of the models, and of x (H, 1), which is `at`: the
    steps, or the altitudes on the way; they return (H, W).  The `cost` (W,) or (H, W) sets W.

        mean = ± bias(w, x) (1 + jitter[0] z),   variance = (spread(w, x) (1 + jitter[1] z))^2

    with z standard normal, new for each entry.  The `signs` stay the ``same``, or are drawn, one
    for each ``model``, or for each ``step`` and model; a seed gives the same magnitudes in all.
    The `names` are b0, b1, ... unless given; jitter and random signs need an `rng`.
    """
    x = check_array("at", at, "H", (None,))
    price = check_array("cost", cost, "... W", (None,), finite=False)
    H, W = len(x), price.shape[-1]
    w = np.arange(W, dtype=np.float64)
    with np.errstate(over="ignore", invalid="ignore"):
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
        altitude,
        jitter=(0.2, 0.1),
        signs=signs,
        rng=rng,
    )


# ------------------------------------------------------------------------------ measured suites


@dataclass(frozen=True, eq=False)
class Residuals(Frozen):
    """N measured errors s_hat - s, each with the model that made it and the altitude."""

    names: Sequence[str]  #: (W,), distinct
    model: Indices  #: (N,), index in `names`
    altitude: Array  #: (N,), in the unit of the trajectory
    residual: Array  #: (N,), in the unit of perception

    def __post_init__(self) -> None:
        names = _check_names(self.names)
        residual = check_array("residual", self.residual, "N", (None,))
        altitude = check_array("altitude", self.altitude, "N", residual.shape)
        model = _check_whole("model", self.model, "N", residual.shape, len(names) - 1)
        self._set(names=names, model=model, altitude=altitude, residual=residual)


HEADER = ["model", "altitude", "residual"]


def read_residuals(path: PathLike, names: Sequence[str] | None = None) -> Residuals:
    """Read a CSV file with the header ``model,altitude,residual`` and one residual a line.

    The columns keep this order, as an altitude taken for a residual would pass for one; blanks
    around cells and empty lines do no harm.

    Parameters
    ----------
    path : str or path
        The file, in UTF-8.
    names : sequence of str, optional
        The models in the order of the suite; that of the file if left out.

    Returns
    -------
    Residuals
        In the order of the file.

    Raises
    ------
    ValueError
        Any fault, with the file, the line, what was expected and what was found.
    """
    (line, header), *rows = _read_rows(path) or [(1, [])]
    if header != HEADER:
        wanted, found = ",".join(HEADER), ",".join(header)[:60]
        raise ValueError(f"{path}, line {line}: expected the header {wanted}, found {found!r}")
    if not rows:
        raise ValueError(f"{path}: expected residuals below the header, found none")
    number = {} if names is None else {name: w for w, name in enumerate(_check_names(names))}
    wanted = f"{' or '.join(number) or 'a model'} and two finite numbers"
    records = []
    for line, row in rows:
        try:
            (model,) = _check_names(row[:1])
            pair = check_array("", [float(cell) for cell in row[1:]], "2", (2,))
            w = number.setdefault(model, len(number)) if names is None else number[model]
        except (ValueError, KeyError):
            found = ",".join(row)[:60]
            raise ValueError(f"{path}, line {line}: expected {wanted}, found {found!r}") from None
        records.append((w, *pair))
    w, altitude, residual = np.array(records).T
    return Residuals(list(number), w, altitude, residual)


def _read_rows(path: PathLike) -> list[tuple[int, list[str]]]:
    """Line number and stripped cells of all rows of a CSV file that are not blank."""
    try:
        # Spreadsheets put a byte order mark before UTF-8 text: "-sig" skips it.
        with open(os.fspath(path), encoding="utf-8-sig", newline="") as file:
            reader = csv.reader(file, strict=True)
            lines = [(reader.line_num, [cell.strip() for cell in row]) for row in reader]
    except (OSError, ValueError, csv.Error) as error:
        why = f"{path}: cannot be read as a CSV file: {error}"
        raise ValueError(" ".join(why.split())) from None
    return [(line, row) for line, row in lines if any(row)]


def write_residuals(path: PathLike, residuals: Residuals) -> None:
    """Write the file at `path` from which `read_residuals` restores them to the last digit."""
    names = [residuals.names[w] for w in residuals.model]
    columns = (names, residuals.altitude.tolist(), residuals.residual.tolist())
    with open(os.fspath(path), "w", encoding="utf-8", newline="") as file:
        csv.writer(file).writerows([HEADER, *zip(*columns, strict=True)])


def fit_suite(
    residuals: Residuals, trajectory: ArrayLike, cost: ArrayLike, *, bins: ArrayLike = 10
) -> PerceptionSuite:
    """Estimate a suite (p = 1): moments of the residuals by altitude, laid along a trajectory.

    Of the n >= 2 residuals r_i of a model in a bin of altitudes,

        m = sum r_i / n,   v = sum (r_i - m)^2 / (n - 1),   sqrt(v / n)

    are the mean, the unbiased variance, and the standard error of m.  Step t takes those of the
    bin that `trajectory[t]` (H,) falls into; `cost` is (W,) or (H, W).

    `bins` are a number of bins of equal width, or increasing edges around the trajectory.  A bin
    includes its lower edge, the last one its upper edge too; residuals outside are not used.
    """
    cell, visited, n = _sort_into_bins(residuals, _check_trajectory(trajectory), bins)
    r, W = residuals.residual, len(residuals.names)
    # The maxima keep cells with 0 or 1 residuals finite, which no step visits.
    m = np.bincount(cell, r, n.size) / np.maximum(n.ravel(), 1)
    v = np.bincount(cell, (r - m[cell]) ** 2, n.size) / np.maximum(n.ravel() - 1, 1)
    mean, variance = (table.reshape(-1, W, 1)[visited] for table in (m, v))
    price = check_array("cost", cost, "... W", (W,), finite=False)
    error = np.sqrt(variance / n[visited][..., None])
    return PerceptionSuite(residuals.names, mean, variance, price, n[visited], error)


def bootstrap_errors(
    residuals: Residuals, trajectory: ArrayLike, trials: int, rng: Rng, *, bins: ArrayLike = 10
) -> Array:
    """Draw errors (trials, H, W, 1) from the residuals themselves, instead of `sample_errors`.

    Step t and model w draw, with equal chances, from the n residuals that `fit_suite` would use
    with this `trajectory` and these `bins`; their mean is that of the suite, their variance
    (n - 1) / n of its own.
    """
    N = check_count("trials", trials)
    cell, visited, n = _sort_into_bins(residuals, _check_trajectory(trajectory), bins)
    first = np.cumsum(n).reshape(n.shape) - n  # where each cell starts, once they are in order
    shape = (N, len(visited), len(residuals.names))
    pick = first[visited] + check_rng(rng).integers(n[visited], size=shape)
    return np.asarray(residuals.residual[np.argsort(cell, kind="stable")][pick][..., None])


def guard_suite(suite: PerceptionSuite, level: float = 0.95) -> PerceptionSuite:
    """Replace moments measured on n residuals by upper confidence bounds of the given level.

    With the quantiles of Student's t and of chi-square at n - 1 degrees of freedom,

        bias away from 0 by t(level) sqrt(v / n),   v (n - 1) / chi-square(1 - level).

    Each bound holds with at least this chance, from 1/2 to below 1, if errors are normal.  A
    schedule then trusts no model because of luck with few residuals.  Where Psi couples steps, a
    larger bias may cancel another: no bound on the cost.
    """
    if suite.sample_size is None or suite.standard_error is None or suite.sample_size.min() < 2:
        raise ValueError("suite: expected one measured on 2 residuals or more, found another")
    if not 0.5 <= (chance := check_number("level", level)) < 1:
        raise ValueError(f"level: expected a number from 0.5 to below 1, found {chance:g}")
    freedom = suite.sample_size[..., None] - 1.0
    away = np.where(suite.mean < 0, -1, 1) * stdtrit(freedom, chance) * suite.standard_error
    variance = suite.variance * freedom / chdtri(freedom, chance)
    return replace(suite, mean=suite.mean + away, variance=variance)


def altitude_bins(altitude: ArrayLike, trajectory: ArrayLike, count: int) -> Array:
    """Return count + 1 edges around a trajectory, with equally many altitudes in every bin.

    Of the `altitude` (N,) of residuals, those beyond the `trajectory` (H,) do not count.
    """
    h = _check_trajectory(trajectory)
    near = check_array("altitude", altitude, "N", (None,))
    near, bins = near[(near > h.min()) & (near < h.max())], check_count("count", count)
    if len(near) < bins:
        raise ValueError(f"altitude: expected {bins} or more along the way, found {len(near)}")
    inner = np.linspace(0, 1, bins + 1)[1:-1]
    return np.array([h.min(), *np.quantile(near, inner), h.max()])


def _sort_into_bins(residuals: Residuals, h: Array, bins: ArrayLike) -> tuple[Indices, ...]:
    """Sort residuals into cells, one a bin and model, of 2 or more where h (H,) passes.

    Return the cell of every residual (N,), the bin that every step visits (H,), and the number of
    residuals (bins + 2, W) of every cell; the first bin and the last lie outside the edges.
    """
    edges, W = _bin_edges(bins, h), len(residuals.names)
    check_range("residuals", abs(residuals.residual), LARGEST)
    visited = np.digitize(h, edges)
    cell = np.digitize(residuals.altitude, edges) * W + residuals.model
    n = np.bincount(cell, minlength=(len(edges) + 1) * W).reshape(-1, W)
    if n[visited].min() < 2:
        t, w = np.argwhere(n[visited] < 2)[0]
        low, high = edges[visited[t] - 1], edges[visited[t]]
        raise ValueError(
            f"residuals: expected 2 or more of {residuals.names[w]} at altitudes "
            f"{low:g} to {high:g}, found {n[visited[t], w]}; use fewer bins or measure more"
        )
    return cell, visited, n


def _bin_edges(bins: ArrayLike, h: Array) -> Array:
    """Return the edges of bins around the altitudes h, the last moved up by a rounding step."""
    if as_numbers("bins", bins).ndim == 0:
        edges = np.linspace(h.min(), h.max(), check_count("bins", bins) + 1)
    else:
        edges = check_array("bins", bins, "edges", (None,)).copy()
        check_range("bins", abs(edges), LARGEST)
    if len(edges) < 2 or np.diff(edges).min() <= 0 or h.min() < edges[0] or h.max() > edges[-1]:
        raise ValueError(
            f"bins: expected increasing edges from {h.min():g} or less to {h.max():g} or more, "
            f"found {len(edges)} edges from {edges[0]:g} to {edges[-1]:g}"
        )
    edges[-1] = np.nextafter(edges[-1], np.inf)  # so that the half-open last bin holds its edge
    return edges


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
    if not len(networks):
        raise ValueError("networks: expected one or more, found none")
    scene, h, pitch = draw_views(count, rng)
    seen = [n.altitude(photograph(scene, h, n.side, rng, pitch=pitch)) - h for n in networks]
    return _name_models(np.tile(h, len(seen)), np.concatenate(seen), len(seen))


def _name_models(altitude: Array, residual: Array, W: int) -> Residuals:
    """Residuals of b0, b1, ..., which come in W blocks of equal length."""
    model = np.repeat(np.arange(W), len(residual) // W)
    return Residuals([f"b{w}" for w in range(W)], model, altitude, residual)


def pack_models(trained: Trained, key: str) -> bytes:
    """Return the .npz file from which `load_models` restores `trained`, marked with `key`."""
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
    W = len(networks)
    try:
        with open(os.fspath(path), "rb") as raw, np.load(raw, allow_pickle=False) as file:
            found = dict(file)
        if str(found["key"]) != key:
            raise ValueError(f"expected the key {key}, found {str(found['key'])[:40]}")
        for name, array in nets.named_arrays(networks).items():
            axes = "n k" if array.ndim == 2 else "k"
            array[...] = check_array(name, found[name], axes, array.shape)
        losses = check_array("losses", found["losses"], "W epochs", (W, None))
        return Trained(networks, losses, _name_models(found["altitude"], found["residual"], W))
    except Exception as error:  # damage can surface as almost any of them
        why = " ".join(str(error).split()).split(". ")[0][:150]
        where = " ".join(str(path).split())
        raise ValueError(f"{where}: no file of these models, delete or move it: {why}") from None


def with_bar(items: Iterable[Any], title: str, progress: bool) -> Any:
    """Go through `items` with a bar and its `title`, if tqdm is installed, at a terminal."""
    try:
        from tqdm import tqdm
    except ImportError:
        return items
    return tqdm(items, title, leave=False, disable=not progress or None)


# ------------------------------------------------------------------------------------- checkers


def _check_names(names: Sequence[str]) -> tuple[str, ...]:
    """Return distinct names that print on one line and survive a CSV file."""
    found = () if isinstance(names, str) or not np.iterable(names) else tuple(names)
    good = all(isinstance(n, str) and n and n == n.strip() and n.isprintable() for n in found)
    if not (found and good and len(set(found)) == len(found)):
        raise ValueError(f"names: expected distinct, non-blank strings, found {shown(names)}")
    return found


def _check_trajectory(trajectory: ArrayLike) -> Array:
    """Return the altitudes (H,) of a trajectory."""
    h = check_array("trajectory", trajectory, "H", (None,))
    check_range("trajectory", abs(h), LARGEST)
    return h


_WHOLE: WeakValueDictionary[int, Indices] = WeakValueDictionary()  # what was checked, by its id


def _check_whole(
    name: str, value: ArrayLike, axes: str, sizes: tuple[int, ...], top: int
) -> Indices:
    """Return frozen integers from 0 to `top`; what it returned before is not copied."""
    array = check_array(name, value, axes, sizes)
    bad = (array < 0) | (array > top) | (array != np.floor(array))
    if bad.any():
        raise ValueError(f"{name}: expected integers from 0 to {top}, found {array[bad][0]:g}")
    known = _WHOLE.get(id(value))
    whole = known if known is value else frozen(array.astype(np.intp))
    _WHOLE[id(whole)] = whole
    return whole
