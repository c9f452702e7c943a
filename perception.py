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
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from modelselect import check_array, check_count, check_number, check_semidefinite

Array = npt.NDArray[np.float64]
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
        (check_semidefinite if full else _check_nonnegative)("variance", variance)
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
            _check_nonnegative("standard_error", error)
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
        if unknown := [model for model in models if model not in number]:
            raise ValueError(
                f"models: expected names among {', '.join(self.names)}, or indices, "
                f"found {unknown[0]!r}"
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
        np.cumsum(_check_rng(rng).uniform(0, increments, (H, 8)), axis=1)[:, ::-1, None]
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
    mean = check_array("bias", bias(w, x[:, None]), "H W", (H, W))
    deviation = check_array("spread", spread(w, x[:, None]), "H W", (H, W))
    _check_nonnegative("spread", deviation)
    relative = check_array("jitter", jitter, "2", (2,))
    _check_nonnegative("jitter", relative)
    if signs not in ("same", "model", "step"):
        raise ValueError(f"signs: expected same, model or step, found {signs!r}")
    if relative.any() or signs != "same":
        rng = _check_rng(rng)
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
    z = _check_rng(rng).standard_normal((check_count("trials", trials), *suite.mean.shape))
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
        with open(path, encoding="utf-8-sig", newline="") as file:
            reader = csv.reader(file, strict=True)
            lines = [(reader.line_num, [cell.strip() for cell in row]) for row in reader]
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise ValueError(f"{path}: cannot be read as a CSV file: {error}") from None
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
    with open(path, "w", encoding="utf-8", newline="") as file:
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
    bins : int or array_like
        Number of equal bins over the range of the trajectory, or increasing edges around it.  A
        bin includes its lower edge, the last one its upper edge too; residuals outside the edges
        are not used.

    Raises
    ------
    ValueError
        Bad edges, or a model with fewer than 2 residuals in a bin that the trajectory visits.
    """
    h = check_array("trajectory", trajectory, "H", (None,))
    edges = _bin_edges(bins, h)
    W, r = len(residuals.names), residuals.residual
    bin_of, step = np.digitize(residuals.altitude, edges), np.digitize(h, edges)
    # One cell for each bin and model; the first bin and the last lie outside the edges.
    cell, cells = bin_of * W + residuals.model, (len(edges) + 1) * W
    n = np.bincount(cell, minlength=cells)
    # The maxima keep cells with 0 or 1 residuals finite: below, they are refused or not used.
    m = np.bincount(cell, r, cells) / np.maximum(n, 1)
    v = np.bincount(cell, (r - m[cell]) ** 2, cells) / np.maximum(n - 1, 1)
    size = n.reshape(-1, W)[step]
    mean, variance = (table.reshape(-1, W, 1)[step] for table in (m, v))
    if size.min() < 2:
        t, w = np.argwhere(size < 2)[0]
        raise ValueError(
            f"residuals: expected 2 or more of {residuals.names[w]} at altitudes "
            f"{edges[step[t] - 1]:g} to {edges[step[t]]:g}, found {size[t, w]}; "
            "use fewer bins or measure more"
        )
    price = check_array("cost", cost, "... W", (W,), finite=False)
    error = np.sqrt(variance / size[..., None])
    return PerceptionSuite(residuals.names, mean, variance, price, size, error)


def _bin_edges(bins: int | npt.ArrayLike, h: Array) -> Array:
    """Return the edges of bins around the altitudes h, the last moved up by a rounding step."""
    if np.isscalar(bins):
        edges = np.linspace(h.min(), h.max(), check_count("bins", bins) + 1)
    else:
        edges = check_array("bins", bins, "edges", (None,)).copy()
    if len(edges) < 2 or np.diff(edges).min() <= 0 or h.min() < edges[0] or h.max() > edges[-1]:
        raise ValueError(
            f"bins: expected increasing edges from {h.min():g} or less to {h.max():g} or more, "
            f"found {len(edges)} edges from {edges[0]:g} to {edges[-1]:g}"
        )
    edges[-1] = np.nextafter(edges[-1], np.inf)  # so that the half-open last bin holds its edge
    return edges


# ------------------------------------------------------------------------------------- checkers


def _check_names(names: Sequence[str]) -> tuple[str, ...]:
    """Return distinct names that print on one line and survive a CSV file, or raise ValueError."""
    found = () if isinstance(names, str) or not np.iterable(names) else tuple(names)
    good = all(isinstance(n, str) and n and n == n.strip() and n.isprintable() for n in found)
    if not (found and good and len(set(found)) == len(found)):
        raise ValueError(f"names: expected distinct, non-blank strings, found {names!r}")
    return found


def _check_nonnegative(name: str, array: Array) -> None:
    """Raise ValueError if an entry is negative."""
    if array.min() < 0:
        raise ValueError(f"{name}: expected numbers >= 0, found {array.min():g}")


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


def _check_rng(rng: object) -> np.random.Generator:
    """Return the generator, or raise ValueError if it is something else."""
    if not isinstance(rng, np.random.Generator):
        raise ValueError(f"rng: expected numpy.random.default_rng(seed), found {rng!r}")
    return rng


def _freeze(instance: object, **fields: object) -> None:
    """Set checked fields of a frozen dataclass."""
    for name, value in fields.items():
        object.__setattr__(instance, name, value)
