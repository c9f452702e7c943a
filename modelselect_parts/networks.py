"""Small convolutional networks that learn a number from a picture, written out by hand.

A layer cuts its input into windows, and takes the same weighted sums of each:

    Y = X W + b,    X: one row a window, W: (window^2 * channels, width), b: (width,)

Four of them read a picture, with max(0, Y) after all but the last:

    (N, side, side) -> windows of 4 x 4 -> windows of 3 x 3 -> one window of all -> one number

`forward` runs them, `gradients` runs them backwards, and `train` descends by Adam.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from modelselect_parts.checks import Array, check_array, check_count, check_range, check_rng

Single = npt.NDArray[np.float32]
LARGEST = 1e15  # squares of numbers up to here do not overflow in single precision

#: Networks b0 to b7: side of the picture, filters in the first layer, width of the third.
ARCHITECTURE = (
    *((12, 2, 8), (16, 3, 12), (20, 4, 16), (24, 6, 24)),
    *((28, 8, 32), (32, 10, 32), (36, 14, 40), (40, 20, 48)),
)


class Layer(NamedTuple):
    """Every second window of window^2 pixels, times weights, plus bias."""

    weight: Single  #: (window^2 * channels, width)
    bias: Single  #: (width,)
    window: int


def new_layers(shape: tuple[int, int, int], rng: np.random.Generator) -> list[Layer]:
    """Draw four layers with N(0, 2 / inputs) weights (He et al. 2015).

    Their `shape` is a row of `ARCHITECTURE`: side >= 8 of the picture, filters, width.
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
    return layers


# ------------------------------------------------------------------- forwards, and backwards


def forward(layers: Sequence[Layer], pictures: npt.ArrayLike) -> tuple[Single, list[Any]]:
    """Return outputs (N,) of `pictures` (N, side, side), and input and windows of every layer.

    Light and contrast are removed first: each picture gets mean 0 and deviation about 1.
    """
    checked = check_array("pictures", pictures, "N side side", (None, None, None))
    check_range("pictures", abs(checked), LARGEST)
    return _forward(layers, checked)


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


def train(
    layers: Sequence[Layer],
    pictures: npt.NDArray[Any],
    target: npt.NDArray[Any],
    epochs: int,
    rng: np.random.Generator,
) -> Array:
    """Fit outputs to `target` (N,) in place by Adam, and return the loss (epochs,).

    Batches of about 32 `pictures` (N, side, side), turned or mirrored at random, as the ground
    has no upright; the step rises to 0.003 in the first epoch, and falls to 0 along a cosine.
    """
    arrays = [array for layer in layers for array in layer[:2]]
    mean, square = ([np.zeros_like(array) for array in arrays] for _ in range(2))
    batches = -(-len(target) // 32)
    steps, losses = epochs * batches, np.zeros(epochs)
    for t in range(steps):
        if t % batches == 0:
            order = rng.permutation(len(target))
        batch = order[t % batches :: batches]
        turned = np.rot90(pictures[batch], int(rng.integers(4)), (1, 2))[:, :: rng.choice([-1, 1])]
        loss, slopes = _backward(layers, *_forward(layers, turned), target[batch])
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
