"""Small convolutional networks that read the altitude off a picture, written out by hand.

A layer cuts its input into windows, and takes the same weighted sums of each:

    Y = X W + b,    X: one row a window, W: (window^2 * channels, width), b: (width,)

Four of them read a picture, with max(0, Y) after all but the last:

    (N, side, side) -> windows of 4 x 4 -> windows of 3 x 3 -> one window of all -> one number

`forward` runs them, `gradients` runs them backwards, and `train_network` descends by Adam.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from modelselect_parts.checks import (
    Array,
    check_array,
    check_class,
    check_classes,
    check_count,
    check_range,
    check_rng,
)

Single = npt.NDArray[np.float32]
LARGEST = 1e15  # squares of numbers up to here do not overflow in single precision

#: Networks b0 to b7: side of the picture, filters in the first layer, width of the third.
ARCHITECTURE = (
    *((12, 2, 8), (16, 3, 12), (20, 4, 16), (24, 6, 24)),
    *((28, 8, 32), (32, 10, 32), (36, 14, 40), (40, 20, 48)),
)


class ModelTable(NamedTuple):
    """What W image models need and achieve: the columns of `EFFICIENTNET`."""

    names: tuple[str, ...]  #: (W,)
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


class Layer(NamedTuple):
    """Every second window of window^2 pixels, times weights, plus bias."""

    weight: Single  #: (window^2 * channels, width)
    bias: Single  #: (width,)
    window: int


class Reach(NamedTuple):
    """The altitudes h that a camera sees, and the numbers y that networks take them for.

        y = (log z - m) / d,    z = h + mount

    Pictures depend on ratios of the distance z, and errors that grow with z are equal in log z.
    Where log z is uniform, m and d are its mean and deviation, so that y has mean 0, variance 1.
    """

    mount: float  #: height of the camera on the landed drone, in ft as all three
    lowest: float
    highest: float

    @property
    def log_mean(self) -> float:
        """The middle m of log z."""
        return math.log((self.lowest + self.mount) * (self.highest + self.mount)) / 2

    @property
    def log_deviation(self) -> float:
        """Its standard deviation d: that of a uniform number, its range over sqrt(12)."""
        return math.log((self.highest + self.mount) / (self.lowest + self.mount)) / math.sqrt(12)

    def encode(self, altitude: npt.ArrayLike, count: int) -> Single:
        """Return y of `altitude` (count,), all of it within reach."""
        h = check_array("altitude", altitude, "N", (count,))
        if h.min() < self.lowest or h.max() > self.highest:
            wanted, found = f"{self.lowest:g} to {self.highest:g}", f"{h.min():g} to {h.max():g}"
            raise ValueError(f"altitude: expected {wanted} ft, found {found}")
        y: Array = (np.log(h + self.mount) - self.log_mean) / self.log_deviation
        return y.astype(np.float32)

    def decode(self, y: Single) -> Array:
        """Return the altitude of y, or the end of the reach beyond which it lies."""
        log = self.log_mean + self.log_deviation * y.astype(np.float64)
        return np.clip(np.exp(log) - self.mount, self.lowest, self.highest)


class Network(NamedTuple):
    """A small convolutional network that reads the altitude off a picture."""

    side: int  #: of its pictures, in pixels
    layers: list[Layer]
    reach: Reach  #: what its output stands for

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
        """Estimate altitudes (N,) in feet, within reach, from pictures (N, side, side)."""
        checked = _check_pictures(pictures, self.side)
        return self.reach.decode(_forward(self.layers, checked)[0])


def draw_network(shape: tuple[int, int, int], reach: Reach, rng: np.random.Generator) -> Network:
    """Draw a network with N(0, 2 / inputs) weights (He et al. 2015).

    Its `shape` is a row of `ARCHITECTURE`: side of the picture, filters, width.
    """
    sizes = check_array("shape", shape, "3", (3,))
    side, filters, width = (check_count("shape", k) for k in sizes)
    if side < 8:
        raise ValueError(f"shape: expected pictures of 8 pixels or more a side, found {side}")
    check_rng(rng)
    layers, S, channels = [], side, 1
    for window, out in ((4, filters), (3, 2 * filters), (0, width), (1, 1)):
        k = window or S  # the third layer has one window, the whole picture
        inputs = k * k * channels
        size = math.sqrt(2 / inputs) * (0.1 if k == 1 else 1)  # estimates start close to the mean
        weight = (size * rng.standard_normal((inputs, out))).astype(np.float32)
        layers.append(Layer(weight, np.zeros(out, np.float32), k))
        S, channels = (S - k) // 2 + 1, out
    return Network(side, layers, reach)


def named_arrays(networks: Sequence[Network]) -> dict[str, Single]:
    """Weights and biases by the names of a file: network.layer.0 and network.layer.1."""
    return {
        f"{w}.{i}.{j}": array
        for w, network in enumerate(networks)
        for i, layer in enumerate(network.layers)
        for j, array in enumerate(layer[:2])
    }


# ------------------------------------------------------------------- forwards, and backwards


def forward(layers: Sequence[Layer], pictures: npt.ArrayLike) -> tuple[Single, list[Any]]:
    """Return outputs (N,) of `pictures` (N, side, side), and input and windows of every layer.

    Light and contrast are removed first: each picture gets mean 0 and deviation about 1.
    """
    check_classes("layers", layers, "Layer")
    return _forward(layers, _check_pictures(pictures))


def _forward(layers: Sequence[Layer], pictures: npt.NDArray[Any]) -> tuple[Single, list[Any]]:
    """Run the layers: `forward` behind its door."""
    x = np.asarray(pictures, dtype=layers[0].weight.dtype)
    x = x - x.mean(axis=(1, 2), keepdims=True)
    x = (x / (x.std(axis=(1, 2), keepdims=True) + np.float32(0.05)))[..., None]
    seen = []
    for layer in layers:
        if min(x.shape[1:3]) < layer.window:
            raise ValueError(f"pictures: expected larger ones, found {pictures.shape}")
        cut = cut_windows(x, layer.window)
        seen.append((x, cut))
        x = cut @ layer.weight + layer.bias
        if layer is not layers[-1]:
            x = np.maximum(x, 0)
    if x.size != len(x):
        raise ValueError(f"pictures: expected smaller ones, found {pictures.shape}")
    return x.ravel(), seen


def gradients(
    layers: Sequence[Layer], pictures: npt.ArrayLike, target: npt.ArrayLike
) -> tuple[float, list[Single]]:
    """Return the mean squared error, and its derivatives by each weight and bias in turn.

    The `pictures` are (N, side, side), outputs and `target` (N,).  Backpropagation: of a layer
    Y = X W + b, let D be the derivative by Y; then

        X'D  is that by W,   the column sums of D  that by b,   D W'  that by X,

    which adds up where windows overlap, and max(0, x) passes on what was positive.
    """
    check_classes("layers", layers, "Layer")
    output, seen = forward(layers, pictures)
    wanted = check_array("target", target, "N", output.shape)
    check_range("target", abs(wanted), LARGEST)
    return _backward(layers, output, seen, wanted)


def _backward(
    layers: Sequence[Layer], output: Single, seen: list[Any], target: npt.NDArray[Any]
) -> tuple[float, list[Single]]:
    """Run the layers backwards: `gradients` behind its door."""
    error = output - target.astype(output.dtype)
    D: Single = (error * np.float32(2 / len(error)))[:, None, None, None]
    slopes: list[Single] = []
    for (x, X), layer in reversed(list(zip(seen, layers, strict=True))):
        rows = D.reshape(-1, D.shape[-1])
        slopes = [X.reshape(len(rows), -1).T @ rows, rows.sum(axis=0), *slopes]
        D = add_windows(D @ layer.weight.T, layer.window, x.shape) * (x > 0)
    return float((error**2).mean()), slopes


def _check_pictures(pictures: npt.ArrayLike, side: int | None = None) -> Array:
    """Return pictures (N, side, side) whose squares do not overflow in single precision."""
    checked = check_array("pictures", pictures, "N side side", (None, side, side))
    check_range("pictures", abs(checked), LARGEST)
    return checked


def cut_windows(x: Single, k: int) -> Single:
    """Cut (N, S, S, C) into windows (N, P, P, C k k) of side k, two pixels apart."""
    cut = np.lib.stride_tricks.sliding_window_view(x, (k, k), axis=(1, 2))[:, ::2, ::2]
    return cut.reshape(*cut.shape[:3], -1)


def add_windows(D: Single, k: int, shape: tuple[int, ...]) -> Single:
    """Add windows up where they were cut from: the transpose of `cut_windows`."""
    x, P = np.zeros(shape, D.dtype), D.shape[1]
    D = D.reshape(*D.shape[:3], shape[-1], k, k)
    for i, j in np.ndindex(k, k):
        x[:, i : i + 2 * P - 1 : 2, j : j + 2 * P - 1 : 2] += D[..., i, j]
    return x


# -------------------------------------------------------------------------------- learning


def train_network(
    network: Network,
    pictures: npt.ArrayLike,
    altitude: npt.ArrayLike,
    epochs: int,
    rng: np.random.Generator,
) -> Array:
    """Train a network in place by Adam, and return the loss (epochs,): mean (output - y)^2.

    The `pictures` (N, side, side) are seen from `altitude` (N,) in ft, which `Reach` makes y.
    Batches of about 32 are turned or mirrored at random, as the ground has no upright; the step
    rises to 0.003 in the first epoch, and falls to 0 along a cosine.
    """
    check_class("network", network, "Network")
    passes, pictures = check_count("epochs", epochs), _check_pictures(pictures, network.side)
    target = network.reach.encode(altitude, len(pictures))
    check_rng(rng)
    arrays = [array for layer in network.layers for array in layer[:2]]
    mean, square = ([np.zeros_like(array) for array in arrays] for _ in range(2))
    batches = -(-len(target) // 32)
    steps, losses = passes * batches, np.zeros(passes)
    for t in range(steps):
        if t % batches == 0:
            order = rng.permutation(len(target))
        batch = order[t % batches :: batches]
        turned = np.rot90(pictures[batch], int(rng.integers(4)), (1, 2))[:, :: rng.choice([-1, 1])]
        loss, slopes = _backward(network.layers, *_forward(network.layers, turned), target[batch])
        losses[t // batches] += loss / batches
        rate = 0.003 * min((t + 1) / batches, (1 + math.cos(math.pi * t / steps)) / 2)
        for array, slope, m, v in zip(arrays, slopes, mean, square, strict=True):
            adam(array, slope, m, v, t + 1, rate)
    return losses


def adam(w: Single, slope: Single, m: Single, v: Single, t: int, rate: float) -> None:
    """Take step t = 1, 2, ... of Adam in w, m and v (Kingma and Ba 2015, algorithm 1).

        m <- 0.9 m + 0.1 slope,   v <- 0.999 v + 0.001 slope^2,
        w <- w - rate * m / (1 - 0.9^t) / (sqrt(v / (1 - 0.999^t)) + 1e-8)

    All four arrays have the shape of the weights w; m and v start at 0.
    """
    m += 0.1 * (slope - m)
    v += 0.001 * (slope**2 - v)
    w -= rate * m / (1 - 0.9**t) / (np.sqrt(v / (1 - 0.999**t)) + 1e-8)
