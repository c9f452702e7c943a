"""How wrong is each perception model, and when?  Error models: simulated, or measured.

At step t a perception model w looks at the world and reports s_hat where the truth is s.  A
schedule need not know why it errs: all that enters the expected cost of control is the mean of
s_hat - s, the *bias* of the model (``eq:perModelExp``), and its *variance* (``eq:perModelVar``),
at every step and for every model.  These two tables, with the cost of one invocation of each
model (``eq:perceptionCostDistro``), are a `PerceptionSuite`.

Suites come from three places.  `published_suite` draws the one of the paper's first experiment;
`gaussian_suite` makes one of two formulas, to learn from; `fit_suite` estimates one from
residuals measured on data that the models have never seen, and says how well it knows them.
"""

from __future__ import annotations

import csv
import io
import math
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.special import chdtri, stdtrit
from tqdm import tqdm

from modelselect_parts import camera
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
    as_numbers,
    check_array,
    check_count,
    check_number,
    check_range,
    check_rng,
    check_semidefinite,
    shown,
)
from modelselect_parts.networks import ARCHITECTURE, Layer, forward, gradients

Indices = npt.NDArray[np.intp]


# ----------------------------------------------------------------------------- the error model


@dataclass(frozen=True, eq=False)
class PerceptionSuite:
    """Mean and variance of the error s_hat - s of W models at H steps, and what each costs.

    ``dataclasses.replace(suite, cost=...)`` is the same suite at another price.

    Parameters
    ----------
    names : sequence of str, (W,)
        Distinct names.
    mean : array_like, (H, W, p)
        Mean error, in units of perception (``eq:perModelExp``).
    variance : array_like, (H, W, p) or (H, W, p, p)
        Variance of each component, or covariance within a step (``eq:perModelVar``).
    cost : array_like, (W,) or (H, W)
        Cost of one invocation; ``inf`` where a model is not available.
    sample_size, standard_error : array_like, (H, W) and (H, W, p), optional
        Of a measured suite: how many residuals each mean rests on, and its standard error.

    Raises
    ------
    ValueError
        A wrong shape, a NaN, a negative variance, or a step at which no model is available.
    """

    names: Sequence[str]
    mean: Array
    variance: Array
    cost: Array
    sample_size: Indices | None = None
    standard_error: Array | None = None

    def __post_init__(self) -> None:
        names = _check_names(self.names)
        mean = check_array("mean", self.mean, "H W p", (None, len(names), None))
        H, W, p = mean.shape
        full = check_array("variance", self.variance, "...", ()).ndim == 4
        axes, sizes = ("H W p p", [H, W, p, p]) if full else ("H W p", [H, W, p])
        variance = check_array("variance", self.variance, axes, sizes)
        (check_semidefinite if full else check_range)("variance", variance)
        timed = check_array("cost", self.cost, "...", (), finite=False).ndim == 2
        axes, sizes = ("H W", [H, W]) if timed else ("W", [W])
        cost = check_array("cost", self.cost, axes, sizes, finite=False)
        if np.isneginf(cost).any() or np.isinf(np.atleast_2d(cost)).all(axis=1).any():
            raise ValueError("cost: expected a finite cost at every step, found none or -inf")
        size, error = self.sample_size, self.standard_error
        if size is not None:
            size = _check_integers("sample_size", size, "H W", (H, W), top=2**53)
        if error is not None:
            error = check_array("standard_error", error, "H W p", (H, W, p))
            check_range("standard_error", error)
        _freeze(self, names=names, mean=mean, variance=variance, cost=cost)
        _freeze(self, sample_size=size, standard_error=error)

    def pick(self, models: Sequence[str | int]) -> PerceptionSuite:
        """Return the suite of only these models, in this order.

        Parameters
        ----------
        models : sequence of str or int
            Names or indices, each at most once; anything else raises ValueError.
        """
        number = {key: w for w, name in enumerate(self.names) for key in (name, w)}
        # A mask of truths would pass for the indices 0 and 1.
        unknown = [w for w in models if isinstance(w, bool | np.bool_) or w not in number]
        if unknown or isinstance(models, str):
            raise ValueError(
                f"models: expected names among {', '.join(self.names)}, or indices, "
                f"found {shown([*unknown, models][0])}"
            )
        w = [number[model] for model in models]
        tables = {
            field: table[..., w] if field == "cost" else table[:, w]
            for field, table in vars(self).items()
            if isinstance(table, np.ndarray)
        }
        return replace(self, names=[self.names[i] for i in w], **tables)


# ---------------------------------------------------------------------------- simulated suites


def published_suite(
    horizon: int, rng: np.random.Generator, upsilon: float = 1e14
) -> PerceptionSuite:
    """Draw the suite of experiment 1: b0 to b7, p = 1, b7 the best at every step.

    At every step, from b7 down to b0, each model adds uniform draws to the mean and the variance
    of the one before it; their upper ends are the constants of the authors' public code.

    Parameters
    ----------
    horizon : int
        Number of steps H >= 1.
    rng : numpy.random.Generator
        Source of randomness.
    upsilon : float
        Model w costs w * upsilon (``eq:perceptionCostDistro``; the code charges one more), >= 0.
    """
    H, step = check_count("horizon", horizon), check_number("upsilon", upsilon, minimum=0)
    mean, variance = (
        np.cumsum(check_rng(rng).uniform(0, increments, (H, 8)), axis=1)[:, ::-1, None]
        for increments in (
            (0.05, 0.1, 1, 4, 8, 12, 16, 16),
            (0.3, 0.06, 0.08, 0.01, 0.02, 0.02, 0.03, 0.03),
        )
    )
    return PerceptionSuite(EFFICIENTNET.names, mean, variance, step * np.arange(8.0))


def gaussian_suite(
    bias: Callable[[Array, Array], npt.ArrayLike],
    spread: Callable[[Array, Array], npt.ArrayLike],
    cost: npt.ArrayLike,
    at: npt.ArrayLike,
    *,
    names: Sequence[str] | None = None,
    jitter: tuple[float, float] = (0.0, 0.0),
    signs: str = "same",
    rng: np.random.Generator | None = None,
) -> PerceptionSuite:
    """Make a suite (p = 1) of a formula for the bias and one for the standard deviation.

    Parameters
    ----------
    bias, spread : callable
        Functions of w (W,), the numbers of the models, and of x (H, 1), which is `at`, to (H, W).
    cost : array_like, (W,) or (H, W)
        Cost of one invocation; sets the number of models.
    at : array_like, (H,)
        The steps, or the altitudes along a trajectory.
    jitter : pair of float
        Every bias, and every standard deviation, is multiplied by its own 1 + jitter * N(0, 1).
    signs : str
        Leaves the signs of the biases as they are (``same``), or draws one for each ``model``,
        or for each ``step`` and model.  One seed gives the same magnitudes in all three.
    names, rng : optional
        b0, b1, ... by default; the Generator that jitter and random signs require.

    Raises
    ------
    ValueError
        A wrong shape, a negative spread or jitter, unknown `signs`, or a missing `rng`.
    """
    x = check_array("at", at, "H", (None,))
    price = check_array("cost", cost, "... W", (None,), finite=False)
    H, W = len(x), price.shape[-1]
    w = np.arange(W, dtype=np.float64)
    with np.errstate(over="ignore", invalid="ignore"):
        mean = check_array("bias", bias(w, x[:, None]), "H W", (H, W))
        deviation = check_array("spread", spread(w, x[:, None]), "H W", (H, W))
    check_range("spread", deviation, top=1e150)  # its square must not overflow
    relative = check_array("jitter", jitter, "2", (2,))
    check_range("jitter", relative, top=1e150)
    if not isinstance(signs, str) or signs not in ("same", "model", "step"):
        raise ValueError(f"signs: expected same, model or step, found {shown(signs)}")
    if relative.any() or signs != "same":
        rng = check_rng(rng)
        factor = 1 + relative[:, None, None] * rng.standard_normal((2, H, W))
        # A deviation below zero counts by its size, as only its square is used.
        mean, deviation = mean * factor[0], deviation * factor[1]
        if signs != "same":
            mean = mean * rng.choice([-1, 1], (H if signs == "step" else 1, W))
    labels = [f"b{i}" for i in range(W)] if names is None else names
    return PerceptionSuite(labels, mean[..., None], deviation[..., None] ** 2, price)


def textbook_suite(
    altitude: npt.ArrayLike, rng: np.random.Generator, signs: str = "same", upsilon: float = 1.0
) -> PerceptionSuite:
    """Draw the suite of the textbook aircraft: eight models, all better near the ground.

    At altitude h, model w has bias 1.5 * 0.6^w * (0.3 + h/100) ft and standard deviation
    2 * 0.65^w * (0.3 + h/100) ft, with 20% and 10% of jitter.

    Parameters
    ----------
    altitude : array_like, (H,)
        Altitude at every step, in feet.
    rng, signs : numpy.random.Generator and str
        As in `gaussian_suite`, with its errors.
    upsilon : float
        Model w costs w * upsilon, >= 0.
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


def sample_errors(suite: PerceptionSuite, trials: int, rng: np.random.Generator) -> Array:
    """Draw Gaussian errors (trials, H, W, p) of all models, independent across steps and models.

    e = mean + F z with z standard normal and F F' the covariance within a step.  F is its
    symmetric square root, which exists for a singular covariance as well.

    Parameters
    ----------
    suite : PerceptionSuite
        The models.
    trials : int
        Number of draws, >= 1; anything else raises ValueError.
    rng : numpy.random.Generator
        Source of randomness.
    """
    N = check_count("trials", trials)
    z = check_rng(rng).standard_normal((N, *suite.mean.shape))
    if suite.variance.ndim == 3:
        return suite.mean + np.sqrt(suite.variance) * z
    values, V = np.linalg.eigh(suite.variance)
    # Rounding may leave a zero eigenvalue below zero.
    F: Array = V * np.sqrt(np.maximum(values, 0))[..., None, :] @ np.swapaxes(V, -1, -2)
    return suite.mean + (F @ z[..., None])[..., 0]


class ModelTable(NamedTuple):
    """What W image models need and achieve: the columns of `EFFICIENTNET`."""

    names: tuple[str, ...]
    parameters: Array  #: (W,), trained weights
    flops: Array  #: (W,), operations per picture: a cost vector
    top1: Array  #: (W,), ImageNet top-1 accuracy in percent
    pixels: Array  #: (W,), side of the square input picture


#: Tan and Le 2019, Table 2; the picture sizes are those of their code.
EFFICIENTNET = ModelTable(
    ("b0", "b1", "b2", "b3", "b4", "b5", "b6", "b7"),
    check_array("parameters", [5.3e6, 7.8e6, 9.2e6, 12e6, 19e6, 30e6, 43e6, 66e6], "W", (8,)),
    check_array("flops", [0.39e9, 0.70e9, 1.0e9, 1.8e9, 4.2e9, 9.9e9, 19e9, 37e9], "W", (8,)),
    check_array("top1", [77.1, 79.1, 80.1, 81.6, 82.9, 83.6, 84.0, 84.3], "W", (8,)),
    check_array("pixels", [224, 240, 260, 300, 380, 456, 528, 600], "W", (8,)),
)


# ------------------------------------------------------------------------------ measured suites


@dataclass(frozen=True, eq=False)
class Residuals:
    """N measured errors s_hat - s, each with the model that made it and the altitude.

    Parameters
    ----------
    names : sequence of str, (W,)
        Distinct names of the models.
    model : array_like of int, (N,)
        Index of the model in `names`.
    altitude, residual : array_like, (N,)
        In the unit of the trajectory, and of perception.

    Raises
    ------
    ValueError
        Lengths that differ, a number that is not finite, an index of no model.
    """

    names: Sequence[str]
    model: Indices
    altitude: Array
    residual: Array

    def __post_init__(self) -> None:
        names = _check_names(self.names)
        residual = check_array("residual", self.residual, "N", (None,))
        altitude = check_array("altitude", self.altitude, "N", residual.shape)
        model = _check_integers("model", self.model, "N", residual.shape, top=len(names) - 1)
        _freeze(self, names=names, model=model, altitude=altitude, residual=residual)


HEADER = ["model", "altitude", "residual"]


def read_residuals(path: str | os.PathLike[str], names: Sequence[str] | None = None) -> Residuals:
    """Read a CSV file with the header ``model,altitude,residual`` and one residual a line.

    The columns keep this order, as an altitude taken for a residual would pass for one; blanks
    around cells and empty lines do no harm.

    Parameters
    ----------
    path : str or path
        The file, in UTF-8.
    names : sequence of str, optional
        The models in the order of the suite; that of the file if left out.

    Raises
    ------
    ValueError
        Any fault, with the file, the line, what was expected and what was found.
    """
    try:
        # Spreadsheets put a byte order mark before UTF-8 text: "-sig" skips it.
        with open(os.fspath(path), encoding="utf-8-sig", newline="") as file:
            reader = csv.reader(file, strict=True)
            lines = [(reader.line_num, [cell.strip() for cell in row]) for row in reader]
    except (OSError, ValueError, csv.Error) as error:
        why = f"{path}: cannot be read as a CSV file: {error}"
        raise ValueError(" ".join(why.split())) from None
    (line, header), *rows = [(i, row) for i, row in lines if any(row)] or [(1, [])]
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


def write_residuals(path: str | os.PathLike[str], residuals: Residuals) -> None:
    """Write the file from which `read_residuals` restores the residuals to the last digit.

    Parameters
    ----------
    path : str or path
        The file, overwritten if it exists; OSError if it cannot be written.
    residuals : Residuals
        What to write.
    """
    names = [residuals.names[w] for w in residuals.model]
    columns = (names, residuals.altitude.tolist(), residuals.residual.tolist())
    with open(os.fspath(path), "w", encoding="utf-8", newline="") as file:
        csv.writer(file).writerows([HEADER, *zip(*columns, strict=True)])


def fit_suite(
    residuals: Residuals,
    trajectory: npt.ArrayLike,
    cost: npt.ArrayLike,
    *,
    bins: int | npt.ArrayLike = 10,
) -> PerceptionSuite:
    """Estimate a suite (p = 1): moments of the residuals by altitude, laid along a trajectory.

    Of the n residuals r_i of a model in a bin of altitudes, m = sum r_i / n is the mean,
    v = sum (r_i - m)^2 / (n - 1) the unbiased variance, and sqrt(v / n) the standard error of m.
    Step t takes those of the bin that `trajectory[t]` falls into.

    Parameters
    ----------
    residuals : Residuals
        Measured on data that no model was trained on.
    trajectory : array_like, (H,)
        Altitude at every step.
    cost : array_like, (W,) or (H, W)
        Cost of one invocation.
    bins : int or array_like, (edges,)
        Number of equal bins over the range of the trajectory, or increasing edges around it.  A
        bin includes its lower edge, the last one its upper edge too; residuals outside the edges
        are not used.

    Raises
    ------
    ValueError
        Bad edges, or a model with fewer than 2 residuals in a bin that the trajectory visits.
    """
    h = _check_trajectory(trajectory)
    W, r = len(residuals.names), residuals.residual
    cell, step, cells = _cells(residuals, h, bins)
    n = np.bincount(cell, minlength=cells)
    # The maxima keep cells with 0 or 1 residuals finite: below, they are refused or not used.
    m = np.bincount(cell, r, cells) / np.maximum(n, 1)
    v = np.bincount(cell, (r - m[cell]) ** 2, cells) / np.maximum(n - 1, 1)
    size = n.reshape(-1, W)[step]
    mean, variance = (table.reshape(-1, W, 1)[step] for table in (m, v))
    price = check_array("cost", cost, "... W", (W,), finite=False)
    error = np.sqrt(variance / size[..., None])
    return PerceptionSuite(residuals.names, mean, variance, price, size, error)


def bootstrap_errors(
    residuals: Residuals,
    trajectory: npt.ArrayLike,
    trials: int,
    rng: np.random.Generator,
    *,
    bins: int | npt.ArrayLike = 10,
) -> Array:
    """Draw errors (trials, H, W, 1) from the residuals themselves, instead of `sample_errors`.

    Step t and model w draw, with equal chances, from the n residuals that `fit_suite` would use;
    their mean is that of the suite, their variance (n - 1) / n of its own.

    Parameters
    ----------
    residuals, trajectory, bins : Residuals, array_like (H,), int or array_like
        As in `fit_suite`, with its errors.
    trials : int
        Number of draws, >= 1; anything else raises ValueError.
    rng : numpy.random.Generator
        Source of randomness.
    """
    h, W = _check_trajectory(trajectory), len(residuals.names)
    N = check_count("trials", trials)
    cell, step, cells = _cells(residuals, h, bins)
    n = np.bincount(cell, minlength=cells).reshape(-1, W)
    first = np.cumsum(n).reshape(-1, W) - n
    pick = first[step] + check_rng(rng).integers(n[step], size=(N, len(step), W))
    return np.asarray(residuals.residual[np.argsort(cell, kind="stable")][pick][..., None])


def guard_suite(suite: PerceptionSuite, level: float = 0.95) -> PerceptionSuite:
    """Replace moments measured on n residuals by upper confidence bounds of the given level.

    The bias moves away from 0 by t_{level, n-1} standard errors, and the variance becomes
    (n - 1) v / (chi-square quantile of 1 - level, n - 1): each bound holds with at least this
    chance if errors are normal.  A schedule then trusts no model because of luck with few
    residuals.  Where Psi couples steps, a larger bias may cancel another: no bound on the cost.

    Parameters
    ----------
    suite : PerceptionSuite
        Of `fit_suite`.
    level : float
        Between 1/2 and 1; ValueError if not, or if the suite is not measured.
    """
    if suite.sample_size is None or suite.standard_error is None or suite.sample_size.min() < 2:
        raise ValueError("suite: expected one measured on 2 residuals or more, found another")
    if not 0.5 <= (chance := check_number("level", level)) < 1:
        raise ValueError(f"level: expected a number from 0.5 to below 1, found {chance:g}")
    freedom = suite.sample_size[..., None] - 1.0
    away = np.where(suite.mean < 0, -1, 1) * stdtrit(freedom, chance) * suite.standard_error
    variance = suite.variance * freedom / chdtri(freedom, chance)
    return replace(suite, mean=suite.mean + away, variance=variance)


def altitude_bins(altitude: npt.ArrayLike, trajectory: npt.ArrayLike, count: int) -> Array:
    """Return count + 1 edges around a trajectory, with equally many altitudes in every bin.

    Parameters
    ----------
    altitude : array_like, (N,)
        Altitudes of residuals; those beyond the trajectory do not count.
    trajectory : array_like, (H,)
        Altitude at every step.
    count : int
        Number of bins, >= 1; ValueError if there are fewer altitudes.
    """
    h = _check_trajectory(trajectory)
    near = check_array("altitude", altitude, "N", (None,))
    near, bins = near[(near > h.min()) & (near < h.max())], check_count("count", count)
    if len(near) < bins:
        raise ValueError(f"altitude: expected {bins} or more along the way, found {len(near)}")
    inner = np.linspace(0, 1, bins + 1)[1:-1]
    return np.array([h.min(), *np.quantile(near, inner), h.max()])


def _cells(
    residuals: Residuals, h: Array, bins: int | npt.ArrayLike
) -> tuple[Indices, Indices, int]:
    """Sort residuals into cells, one a bin and model; ValueError if one along h has below 2.

    Return the cell of every residual, the bin of every step, and the number of cells; the first
    bin and the last lie outside the edges.
    """
    edges, W = _bin_edges(bins, h), len(residuals.names)
    check_range("residuals", abs(residuals.residual), top=1e150)  # squares must not overflow
    step = np.digitize(h, edges)
    cell = np.digitize(residuals.altitude, edges) * W + residuals.model
    cells = (len(edges) + 1) * W
    size = np.bincount(cell, minlength=cells).reshape(-1, W)[step]
    if size.min() < 2:
        t, w = np.argwhere(size < 2)[0]
        raise ValueError(
            f"residuals: expected 2 or more of {residuals.names[w]} at altitudes "
            f"{edges[step[t] - 1]:g} to {edges[step[t]]:g}, found {size[t, w]}; "
            "use fewer bins or measure more"
        )
    return cell, step, cells


def _bin_edges(bins: int | npt.ArrayLike, h: Array) -> Array:
    """Return the edges of bins around the altitudes h, the last moved up by a rounding step."""
    if as_numbers("bins", bins).ndim == 0:
        edges = np.linspace(h.min(), h.max(), check_count("bins", bins) + 1)
    else:
        edges = check_array("bins", bins, "edges", (None,)).copy()
        check_range("bins", abs(edges), top=1e150)
    if len(edges) < 2 or np.diff(edges).min() <= 0 or h.min() < edges[0] or h.max() > edges[-1]:
        raise ValueError(
            f"bins: expected increasing edges from {h.min():g} or less to {h.max():g} or more, "
            f"found {len(edges)} edges from {edges[0]:g} to {edges[-1]:g}"
        )
    edges[-1] = np.nextafter(edges[-1], np.inf)  # so that the half-open last bin holds its edge
    return edges


# ---------------------------------------------------------------------------- models that learn


class Network(NamedTuple):
    """A small convolutional network that reads the altitude off a picture.

    (N, side, side) -> windows of 4^2 -> windows of 3^2 -> one window of all -> one number, with
    max(0, x) after all but the last.
    """

    side: int  #: of its pictures, in pixels
    layers: list[Layer]

    @property
    def parameters(self) -> int:
        """Number of trained weights, counted from the arrays."""
        return sum(layer.weight.size + layer.bias.size for layer in self.layers)

    @property
    def multiply_adds(self) -> int:
        """Multiplications a picture, counted from the arrays: each weight once a window."""
        S, total = self.side, 0
        for layer in self.layers:
            S = (S - layer.window) // 2 + 1
            total += S**2 * layer.weight.size
        return total

    def altitude(self, pictures: npt.ArrayLike) -> Array:
        """Estimate altitudes (N,) in feet, within range, from pictures (N, side, side)."""
        S = self.side
        checked = check_array("pictures", pictures, "N side side", (None, S, S))
        log = CENTRE + SPREAD * forward(self.layers, checked)[0].astype(np.float64)
        return np.clip(np.exp(log) - MOUNT, LOWEST, HIGHEST)


#: Networks learn (log z - CENTRE) / SPREAD of the distance z, which has mean 0 and variance 1:
#: pictures depend on ratios of distances, and errors that grow with z are equal in log z.
CENTRE = math.log((LOWEST + MOUNT) * (HIGHEST + MOUNT)) / 2
SPREAD = math.log((HIGHEST + MOUNT) / (LOWEST + MOUNT)) / math.sqrt(12)


def new_network(shape: tuple[int, int, int], rng: np.random.Generator) -> Network:
    """Draw a network with N(0, 2 / inputs) weights (He et al. 2015).

    Its `shape` (3,) is a row of `ARCHITECTURE`, of 8 pixels a side or more; else ValueError.
    """
    layers = nets.new_layers(shape, rng)
    return Network(check_count("shape", shape[0]), layers)


def train_network(
    network: Network,
    pictures: npt.ArrayLike,
    altitude: npt.ArrayLike,
    epochs: int,
    rng: np.random.Generator,
) -> Array:
    """Train a network in place by Adam (Kingma and Ba 2015); return the loss (epochs,).

    The `pictures` (N, side, side) are seen from `altitude` (N,) in ft; ValueError if not.
    Batches of about 32 pictures, turned or mirrored at random, as the ground has no upright; the
    step rises to 0.003 in the first epoch, and falls to 0 along a cosine.  The unit of the loss
    is `SPREAD` squared.
    """
    S, passes = network.side, check_count("epochs", epochs)
    pictures = check_array("pictures", pictures, "N side side", (None, S, S))
    altitude = camera.check_altitude(altitude, len(pictures))
    check_rng(rng)
    target = ((np.log(altitude + MOUNT) - CENTRE) / SPREAD).astype(np.float32)
    return nets.train(network.layers, pictures, target, passes, rng)


class Trained(NamedTuple):
    """W networks, how they learned, and how they err on pictures that they never saw."""

    networks: list[Network]
    losses: Array  #: (W, epochs), mean squared error in training, in units of SPREAD^2
    residuals: Residuals  #: of the M held-out pictures, all those of the first network first


def train_models(
    rng: np.random.Generator,
    *,
    architecture: Sequence[tuple[int, int, int]] = ARCHITECTURE,
    training: int = 2093,
    held_out: int = 897,
    epochs: int = 30,
    progress: bool = False,
) -> Trained:
    """Photograph, train, and measure on pictures held out: ``subsec:expAirsim`` in small.

    All networks see the same scenes, each at its own resolution.

    Parameters
    ----------
    rng : numpy.random.Generator
        Source of randomness.
    architecture : sequence of (int, int, int)
        Sizes of the networks, as in `ARCHITECTURE`.
    training, held_out, epochs : int
        Numbers of pictures, and of passes through the former, all >= 1; else ValueError.
    progress : bool
        Whether to show a bar, if the output is a terminal.
    """
    n, M = check_count("training", training), check_count("held_out", held_out)
    passes, sizes = check_count("epochs", epochs), _check_architecture(architecture)
    W = len(sizes)
    scenes, h, pitch = draw_views(n + M, rng)
    networks, losses = [new_network(size, rng) for size in sizes], []
    residuals = np.empty((W, M))
    for w in tqdm(range(W), "Training", leave=False, disable=not progress or None):
        pictures = photograph(scenes, h, networks[w].side, rng, pitch=pitch)
        losses.append(train_network(networks[w], pictures[:n], h[:n], passes, rng))
        residuals[w] = networks[w].altitude(pictures[n:]) - h[n:]
    return Trained(networks, np.array(losses), _measured(np.tile(h[n:], W), residuals.ravel(), W))


def measure_models(networks: Sequence[Network], count: int, rng: np.random.Generator) -> Residuals:
    """Measure networks on `count` >= 1 new pictures: fresh data, for a second opinion.

    ValueError without networks, and as in `sample_errors`.
    """
    if not len(networks):
        raise ValueError("networks: expected one or more, found none")
    scene, h, pitch = draw_views(count, rng)
    seen = [n.altitude(photograph(scene, h, n.side, rng, pitch=pitch)) - h for n in networks]
    return _measured(np.tile(h, len(seen)), np.concatenate(seen), len(seen))


def _check_architecture(architecture: npt.ArrayLike) -> list[tuple[int, int, int]]:
    """Return the sizes of networks, or raise ValueError."""
    table = check_array("architecture", architecture, "W 3", (None, 3))
    side, filters, width = ([check_count("architecture", k) for k in column] for column in table.T)
    return list(zip(side, filters, width, strict=True))


def _measured(altitude: Array, residual: Array, W: int) -> Residuals:
    """Name the models of residuals that come in W blocks of equal length."""
    model = np.repeat(np.arange(W), len(residual) // W)
    return Residuals([f"b{w}" for w in range(W)], model, altitude, residual)


def pack_models(trained: Trained, key: str) -> bytes:
    """Return the .npz file from which `load_models` restores `trained`, marked with `key`."""
    file, found = io.BytesIO(), trained.residuals
    arrays: dict[str, Any] = {
        "losses": trained.losses,
        "altitude": found.altitude,
        "residual": found.residual,
    }
    for w, network in enumerate(trained.networks):
        for i, layer in enumerate(network.layers):
            arrays |= {f"{w}.{i}.0": layer.weight, f"{w}.{i}.1": layer.bias}
    np.savez(file, key=np.array(key), **arrays)
    return file.getvalue()


def load_models(
    path: str | os.PathLike[str],
    key: str,
    architecture: Sequence[tuple[int, int, int]] = ARCHITECTURE,
) -> Trained:
    """Read a file of `pack_models`; ``allow_pickle=False``, so no code in it can run.

    Parameters
    ----------
    path : str or path
        The file.
    key : str
        The mark that it must bear, such as a hash of all settings that the models depend on.
    architecture : sequence of (int, int, int)
        Sizes of the networks that it must hold.

    Raises
    ------
    ValueError
        A file that is missing, damaged, foreign, or of other settings, in one line.
    """
    sizes = _check_architecture(architecture)
    networks = [new_network(size, np.random.default_rng(0)) for size in sizes]
    W = len(networks)
    try:
        with open(os.fspath(path), "rb") as raw, np.load(raw, allow_pickle=False) as file:
            found = dict(file)
        if str(found["key"]) != key:
            raise ValueError(f"expected the key {key}, found {str(found['key'])[:40]}")
        for w, network in enumerate(networks):
            for i, layer in enumerate(network.layers):
                for j, (axes, array) in enumerate(zip(("n k", "k"), layer[:2], strict=True)):
                    name = f"{w}.{i}.{j}"
                    array[...] = check_array(name, found[name], axes, array.shape)
        losses = check_array("losses", found["losses"], "W epochs", (W, None))
        return Trained(networks, losses, _measured(found["altitude"], found["residual"], W))
    except Exception as error:  # damage can surface as almost any of them
        why = " ".join(str(error).split()).split(". ")[0][:150]
        where = " ".join(str(path).split())
        raise ValueError(f"{where}: no file of these models, delete or move it: {why}") from None


# ------------------------------------------------------------------------------------- checkers


def _check_names(names: Sequence[str]) -> tuple[str, ...]:
    """Return distinct names that print on one line and survive a CSV file, or raise ValueError."""
    found = () if isinstance(names, str) or not np.iterable(names) else tuple(names)
    good = all(isinstance(n, str) and n and n == n.strip() and n.isprintable() for n in found)
    if not (found and good and len(set(found)) == len(found)):
        raise ValueError(f"names: expected distinct, non-blank strings, found {shown(names)}")
    return found


def _check_trajectory(trajectory: npt.ArrayLike) -> Array:
    """Return the altitudes (H,) of a trajectory, or raise ValueError."""
    h = check_array("trajectory", trajectory, "H", (None,))
    check_range("trajectory", abs(h), top=1e150)
    return h


def _check_integers(
    name: str, value: npt.ArrayLike, axes: str, sizes: tuple[int, ...], *, top: int
) -> Indices:
    """Return read-only integers from 0 to top in the given shape, or raise ValueError."""
    array = check_array(name, value, axes, sizes)
    bad = (array < 0) | (array > top) | (array != np.floor(array))
    if bad.any():
        raise ValueError(f"{name}: expected integers from 0 to {top}, found {array[bad][0]:g}")
    integers = array.astype(np.intp)
    integers.flags.writeable = False
    return integers


def _freeze(instance: object, **fields: object) -> None:
    """Set checked fields of a frozen dataclass."""
    for name, value in fields.items():
        object.__setattr__(instance, name, value)
