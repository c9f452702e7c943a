"""How W models err at H steps, as a table; and what models do besides erring.

A model may give nothing (`with_dropouts`) or answer late (`with_latency`); either is again a suite
of means and variances, which any solver takes.  `measured_latency` has milliseconds for prices.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any
from weakref import WeakValueDictionary

import numpy as np
from numpy.typing import ArrayLike

from modelselect_parts.checks import (
    Array,
    Frozen,
    as_numbers,
    check_array,
    check_class,
    check_count,
    check_name,
    check_number,
    check_range,
    check_rng,
    frozen,
    shown,
)
from modelselect_parts.checks import Choices as Indices
from modelselect_parts.matrices import check_semidefinite

Rng = np.random.Generator
LARGEST = 1e150  # squares of numbers up to here do not overflow


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
    cost: Array  #: (W,) or (H, W), of one invocation; inf where not available; or {name: cost}
    sample_size: Indices | None = None  #: (H, W)
    standard_error: Array | None = None  #: (H, W, p)
    miss_rate: Array | None = None  #: (H, W), the share of looks that gave nothing
    used: float = 1.0  #: the share of the residuals that count anywhere

    def __post_init__(self) -> None:
        names = check_names("names", self.names)
        known = f" (W = {len(names)} as of names)"
        mean = check_array("mean", self.mean, "H W p", (None, len(names), None), known=known)
        H, W, p = mean.shape
        full = as_numbers("variance", self.variance).ndim == 4
        shape = ("H W p p", (H, W, p, p)) if full else ("H W p", (H, W, p))
        variance = check_array("variance", self.variance, *shape)
        if full:
            variance = check_semidefinite("variance", variance, given=self.variance)
        else:
            check_range("variance", variance)
        price = priced(self.cost, names)
        width = ("H W", (H, W)) if as_numbers("cost", price).ndim == 2 else ("W", (W,))
        cost = check_array("cost", price, *width, finite=False)
        if np.isneginf(cost).any() or (none := np.isinf(np.atleast_2d(cost)).all(axis=1)).any():
            found = "-inf" if np.isneginf(cost).any() else f"none at step {none.argmax()}"
            raise ValueError(f"cost: expected a finite cost at every step, found {found}")
        self._set(names=names, mean=mean, variance=variance, cost=cost)
        if self.sample_size is not None:
            size = check_whole("sample_size", self.sample_size, "H W", (H, W), 2**53)
            self._set(sample_size=size)
        if self.standard_error is not None:
            error = check_array("standard_error", self.standard_error, "H W p", mean.shape)
            check_range("standard_error", error)
            self._set(standard_error=error)
        if self.miss_rate is not None:
            rate = check_array("miss_rate", self.miss_rate, "H W", (H, W))
            check_range("miss_rate", rate, 1)
            self._set(miss_rate=rate)
        self._set(used=check_number("used", self.used, minimum=0))

    def pick(self, models: Sequence[str | int]) -> PerceptionSuite:
        """Return the suite of these `models` only, by name or by index, in this order."""
        given = models if np.iterable(models) and not isinstance(models, str) else ()
        w = [_index_of("models", model, self.names) for model in given]
        if not w or len(set(w)) < len(w):
            expected = f"different {_choice(self.names)}"
            raise ValueError(f"models: expected {expected}, found {shown(models)}")
        arrays = {k: table for k, table in vars(self).items() if isinstance(table, np.ndarray)}
        tables: dict[str, Any] = {
            k: x[..., w] if k == "cost" else x[:, w] for k, x in arrays.items()
        }
        return replace(self, names=[self.names[i] for i in w], **tables)


def sample_errors(suite: PerceptionSuite, trials: int, rng: Rng) -> Array:
    """Draw Gaussian errors (trials, H, W, p) of all models, independent across steps and models.

    e = mean + F z with z standard normal and F F' the covariance within a step.  F is its
    symmetric square root, which exists for a singular covariance as well.
    """
    check_class("suite", suite, "PerceptionSuite")
    N = check_count("trials", trials)
    z = check_rng(rng).standard_normal((N, *suite.mean.shape))
    if suite.variance.ndim == 3:
        return suite.mean + np.sqrt(suite.variance) * z
    values, V = np.linalg.eigh(suite.variance)
    # Rounding may leave a zero eigenvalue below zero.
    F: Array = V * np.sqrt(np.maximum(values, 0))[..., None, :] @ np.swapaxes(V, -1, -2)
    return suite.mean + (F @ z[..., None])[..., 0]


# ------------------------------------------------------------------- what models do besides erring


def with_dropouts(
    suite: PerceptionSuite,
    probability: ArrayLike,
    fallback: str | int | tuple[ArrayLike, ArrayLike],
) -> PerceptionSuite:
    """Return the suite of models that sometimes give nothing, so that a fallback acts.

    With `probability` q, one number, (W,) or (H, W), model w drops out and a `fallback` errs in
    its place with mean mu_f and covariance S_f.  The error is then a mixture of the two:

        mean        (1 - q) mu + q mu_f
        covariance  (1 - q) S + q S_f + q (1 - q) (mu - mu_f)(mu - mu_f)'

    within a step, (H, W, p, p) where p > 1: that one acts and not the other moves all components at
    once.  The fallback is another model of the suite, by name or index, paid for where it acts (the
    cost grows by q times its own, an expectation, and so does what a budget bounds); or a pair
    (mean, variance), free: (p,) or (H, p), and (p,), (H, p) or (H, p, p).

    Expected costs are exact if dropouts are independent across steps and of the errors, and the
    fallback has no memory.  To *hold* the last estimate is no such fallback: then errors correlate
    across steps, which no suite can say.  Guard first: the result is no longer a measured one.
    """
    check_class("suite", suite, "PerceptionSuite")
    mu, (H, W, p) = suite.mean, suite.mean.shape
    q = _of_models("probability", probability, H, W)
    check_range("probability", q, 1)
    cost = suite.cost
    if isinstance(fallback, tuple | list):
        if len(fallback) != 2:
            raise ValueError(f"fallback: expected (mean, variance), found {shown(fallback)}")
        mu_f = _of_steps("fallback.mean", fallback[0], H, p)
        S_f = _spread("fallback.variance", fallback[1], H, p)
    else:
        f = _index_of("fallback", fallback, suite.names)
        mu_f, S_f = mu[:, [f]], suite.variance[:, [f]]
        cost = _price_with_fallback(cost, q, f)
    q1, q2 = q[..., None], q[..., None, None]
    with np.errstate(all="ignore"):  # what overflows, the suite refuses
        gap = mu - mu_f
        between = q2 * (1 - q2) * (gap[..., None] * gap[..., None, :])
        S = (1 - q2) * _full(suite.variance) + q2 * _full(S_f) + between
        mean = (1 - q1) * mu + q1 * mu_f
    return PerceptionSuite(suite.names, mean, S if p > 1 else S[..., 0], cost)


def _price_with_fallback(cost: Array, q: Array, f: int) -> Array:
    """Return the expected price where model f is run in the place of others that drop out."""
    chance = q * (np.arange(q.shape[1]) != f)
    # Where nothing drops out, it may be unavailable: 0 inf would be NaN.
    price: Array = cost + chance * np.where(chance > 0, cost[..., [f]], 0)
    return price[0] if len(price) == 1 else price


def with_latency(
    suite: PerceptionSuite,
    delay: ArrayLike,
    variance: ArrayLike,
    drift: ArrayLike | None = None,
) -> PerceptionSuite:
    """Return the suite of models that answer late, while the input moves on.

    An estimate of s_{t-delta} that is used at t errs in addition by s_{t-delta} - s_t.  The `delay`
    delta >= 0 of each model, in steps, is one number, (W,) or (H, W).  If the input walks at random
    with the given `variance` v per step, (p,), (H, p) or (H, p, p), about a known `drift` d per
    step, (p,) or (H, p), 0 if left out, this adds

        mean  -delta d,   variance  delta v,

    at the rates of step t throughout the delay.  The suite's own rows t are those of the picture
    that is used at t.  Prices stay as they are.

    Exact for each step alone.  Errors of steps less than delta apart share a part of the walk and
    correlate: by v times the overlap of their delays, which a suite cannot say and this ignores
    (`correlated_cost` takes it).  Guard first: the result is no longer a measured one.
    """
    check_class("suite", suite, "PerceptionSuite")
    H, W, p = suite.mean.shape
    delta = _of_models("delay", delay, H, W)
    check_range("delay", delta)
    d = _of_steps("drift", np.zeros(p) if drift is None else drift, H, p)
    S, v = suite.variance, _spread("variance", variance, H, p)
    if S.ndim != v.ndim:
        S, v = _full(S), _full(v)
    with np.errstate(all="ignore"):
        mean = suite.mean - delta[..., None] * d
        S = S + delta.reshape(*delta.shape, *[1] * (S.ndim - 2)) * v
    return PerceptionSuite(suite.names, mean, S, suite.cost)


#: Milliseconds a picture, one at a time; `measured_latency` says of what.
LATENCIES = {
    "efficientnet-i7-12700H": [12.9, 18.4, 24.0, 34.0, 68.3, 143.8, 256.0, 465.8],
    "efficientnet-i9-10940X": [11.3, 15.1, 16.6, 21.6, 32.8, 57.5, 99.0, 166.8],
    "resnet-jetson-nano": [11.4, 20.2, 29.8, 51.1, 72.3],
    "resnet-jetson-xavier": [1.64, 2.79, 3.37, 6.04, 8.57],
    "efficientnet-lite-pixel-4": [6.5, 9.1, 12.0, 18.0, 30.0],
}


def measured_latency(table: str) -> Array:
    """Return what models of the named `table` take in ms, (W,), to be used as model costs.

    ========================= ===================== ===============================================
    efficientnet-i7-12700H    b0 to b7              32 bit, compiled: pytorch-image-models,
    efficientnet-i9-10940X    b0 to b7              results/benchmark-infer-fp32-nchw-pt240-cpu-*
    resnet-jetson-nano        18, 34, 50, 101, 152  TensorRT, 16 bit: torch2trt, docs/benchmarks
    resnet-jetson-xavier      18, 34, 50, 101, 152  the same
    efficientnet-lite-pixel-4 lite0 to lite4        8 bit, four threads of the CPU: tensorflow/tpu,
                                                    models/official/efficientnet/lite
    ========================= ===================== ===============================================

    The last step up takes 2 to 38 times as long as the first: what hardware charges is not w times
    a constant.
    """
    check_name("table", table, LATENCIES)
    return check_array("table", LATENCIES[table], "W", (None,))


# ------------------------------------------------------------------------------------- checkers


def check_names(argument: str, names: Sequence[str]) -> tuple[str, ...]:
    """Return distinct names that print on one line and survive a CSV file."""
    found = () if isinstance(names, str) or not np.iterable(names) else tuple(names)
    good = all(isinstance(n, str) and n and n == n.strip() and n.isprintable() for n in found)
    good = good and not any(n.startswith("#") for n in found)  # a comment in a file
    if not (found and good and len(set(found)) == len(found)):
        raise ValueError(f"{argument}: expected distinct, non-blank strings, found {shown(names)}")
    return found


def priced(cost: ArrayLike | Mapping[str, ArrayLike], names: Sequence[str]) -> ArrayLike:
    """Return prices in the order of the models, if they are given by name."""
    if not isinstance(cost, Mapping):
        return cost
    if set(cost) != set(names):
        raise ValueError(f"cost: expected one for each of {', '.join(names)}, found {shown(cost)}")
    each = [check_array(f"cost[{name!r}]", cost[name], "...", (), finite=False) for name in names]
    try:
        return np.stack(np.broadcast_arrays(*each), axis=-1)
    except ValueError:
        raise ValueError(f"cost: expected numbers, or all (H,), found {shown(cost)}") from None


_WHOLE: WeakValueDictionary[int, Indices] = WeakValueDictionary()  # what was checked, by its id


def check_whole(
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


def _choice(names: Collection[str]) -> str:
    return f"names among {', '.join(names)}, or indices"


def _index_of(argument: str, model: str | int, names: Sequence[str]) -> int:
    """Return the index of a model that is given by name or by index."""
    known = {key: w for w, name in enumerate(names) for key in (name, w)}
    # A mask of truths would pass for the indices 0 and 1.
    if isinstance(model, bool | np.bool_) or not np.isscalar(model) or model not in known:
        raise ValueError(f"{argument}: expected {_choice(names)}, found {shown(model)}")
    return known[model]


def _of_models(name: str, value: ArrayLike, H: int, W: int) -> Array:
    """Return a number of each model, (1, W) or (H, W): given once, or (W,), or (H, W)."""
    axes, sizes = [("", ()), ("W", (W,)), ("H W", (H, W))][min(as_numbers(name, value).ndim, 2)]
    return check_array(name, value, axes, sizes) + np.zeros((1, W))


def _of_steps(name: str, value: ArrayLike, H: int, p: int) -> Array:
    """Return p numbers of each step, (1, 1, p) or (H, 1, p): given once, (p,), or (H, p)."""
    axes, sizes = ("H p", (H, p)) if as_numbers(name, value).ndim == 2 else ("p", (p,))
    return check_array(name, value, axes, sizes).reshape(-1, 1, p)


def _spread(name: str, value: ArrayLike, H: int, p: int) -> Array:
    """Return variances as `_of_steps` does, or covariances (H, 1, p, p) given as (H, p, p)."""
    if as_numbers(name, value).ndim == 3:
        full = check_array(name, value, "H p p", (H, p, p))
        return check_semidefinite(name, full, given=value)[:, None]
    variance = _of_steps(name, value, H, p)
    check_range(name, variance)
    return variance


def _full(variance: Array) -> Array:
    """Return covariances (..., p, p) of variances (H, W, p); covariances as they are."""
    return variance if variance.ndim == 4 else variance[..., None] * np.eye(variance.shape[-1])
