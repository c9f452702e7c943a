"""The camera, the networks that learn from it, their file, and what is made of their residuals."""

import io
import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import kstest

import perception
from modelselect_parts import networks
from perception import (
    ARCHITECTURE,
    CENTRE,
    HIGHEST,
    LOWEST,
    MOUNT,
    PAD,
    SPREAD,
    TANGENT,
    PerceptionSuite,
    Residuals,
    Scene,
    altitude_bins,
    bootstrap_errors,
    draw_pose,
    draw_scenes,
    draw_views,
    fit_suite,
    forward,
    gradients,
    guard_suite,
    load_models,
    measure_models,
    new_network,
    pack_models,
    photograph,
    train_models,
    train_network,
)

SMALL = {"architecture": ARCHITECTURE[:3], "training": 96, "held_out": 40, "epochs": 2}


def generator(seed=0):
    return np.random.default_rng(seed)


@pytest.fixture(scope="module")
def trained():
    return train_models(generator(1), **SMALL)


def empty_scene(count):
    """Looks straight down on the pad: no texture, clutter or blur, and black ground around."""
    scene = draw_scenes(count, generator())
    light = np.tile([1, 0, 0, 0, 1, 1], (count, 1))
    return scene._replace(
        light=light,
        waves=np.zeros_like(scene.waves),
        boxes=np.full_like(scene.boxes, 1e4),
        decoy=np.full_like(scene.decoy, 1e4) * [1, 1, 0, 0],
        pose=np.zeros_like(scene.pose),
    )


# ---------------------------------------------------------------------------------- the camera


@pytest.mark.parametrize("side", [12, 33])
def test_pictures_are_greys_and_repeat(side):
    scene, h, pitch = draw_views(7, generator(3))
    first, again, other = (
        photograph(scene, h, side, generator(seed), pitch=pitch) for seed in (5, 5, 6)
    )
    assert first.shape == (7, side, side) and first.dtype == np.float32
    assert first.min() >= 0 and first.max() <= 1 and first.std() > 0.05
    np.testing.assert_array_equal(first, again)
    assert 0 < np.abs(first - other).max() < 0.3  # only the noise of the sensor differs


def test_draws_are_within_range_and_repeat():
    scene, h, _ = draw_views(3000, generator(1))
    for a, b in zip(scene, draw_views(3000, generator(1))[0], strict=True):
        np.testing.assert_array_equal(a, b)
    assert h.min() >= LOWEST and h.max() <= HIGHEST
    log = (np.log(h + MOUNT) - CENTRE) / SPREAD  # uniform: mean 0, variance 1
    assert abs(log.mean()) < 6 / math.sqrt(3000)
    assert abs(log.var() - 1) < 6 * math.sqrt(0.8 / 3000)  # var of the square of such a uniform
    assert draw_pose(4, generator()).shape == (4, 8)


def uniform(low, high):
    return "uniform", (low, high - low)


#: What is drawn for every scene, in the order of the fields of `Scene` and the text beside them.
DRAWN = {
    "exposure": (lambda s: s.light[:, 0], *uniform(0.55, 1)),
    "slope across": (lambda s: s.light[:, 1], *uniform(-0.25, 0.25)),
    "slope along": (lambda s: s.light[:, 2], *uniform(-0.25, 0.25)),
    "ground": (lambda s: s.light[:, 3], *uniform(0.3, 0.55)),
    "pad": (lambda s: s.light[:, 4], *uniform(0.12, 0.3)),
    "paint": (lambda s: s.light[:, 5], *uniform(0.75, 1)),
    "log of wave length": (
        lambda s: np.log(2 * np.pi / np.hypot(*s.waves[:, 0, :2].T)),
        *uniform(0, math.log(60)),
    ),
    "direction of waves": (lambda s: np.arctan2(*s.waves[:, 1, 1::-1].T), *uniform(-np.pi, np.pi)),
    "phase": (lambda s: s.waves[:, 2, 2], *uniform(0, 2 * np.pi)),
    "size of waves": (lambda s: s.waves[:, 3, 3], *uniform(0.01, 0.03)),
    "distance of boxes": (lambda s: np.hypot(*s.boxes[:, 0, :2].T), *uniform(14, 50)),
    "direction of boxes": (lambda s: np.arctan2(*s.boxes[:, 1, 1::-1].T), *uniform(-np.pi, np.pi)),
    "half length": (lambda s: s.boxes[:, 2, 2], *uniform(0.7, 7)),
    "half width": (lambda s: s.boxes[:, 3, 3], *uniform(0.7, 3)),
    "turn": (lambda s: s.boxes[:, 4, 4], *uniform(0, np.pi)),
    "grey of boxes": (lambda s: s.boxes[:, 0, 5], *uniform(0, 1)),
    "speed": (lambda s: s.boxes[:, 1, 6], *uniform(-3, 3)),
    "distance of the decoy": (lambda s: np.hypot(*s.decoy[:, :2].T), *uniform(30, 60)),
    "radius of the decoy": (lambda s: s.decoy[:, 2], *uniform(3, 14)),
    "grey of the decoy": (lambda s: s.decoy[:, 3], *uniform(0.1, 0.9)),
    **{
        name: (lambda s, k=k: s.pose[:, k], "norm", (0, size))
        for k, (name, size) in enumerate(
            zip(
                ("pitch", "roll", "right", "ahead", "heading", "blur", "shake", "dust"),
                (0.05, 0.05, 0.05, 0.05, 0.6, 0.015, 0.15, 0.3),
                strict=True,
            )
        )
    },
}


@pytest.mark.parametrize("name", DRAWN)
def test_scenes_are_drawn_from_the_stated_distributions(name):
    """By Kolmogorov and Smirnov: a right draw fails for one seed in 10^6, and these are fixed."""
    column, law, arguments = DRAWN[name]
    scene = draw_scenes(3000, generator(11))
    assert kstest(column(scene), law, arguments).pvalue > 1e-6
    if law == "norm":
        pose = scene._replace(pose=draw_pose(3000, generator(12)))
        assert kstest(column(pose), law, arguments).pvalue > 1e-6


def test_views_are_spread_evenly_over_the_logarithm_of_distance():
    _, h, pitch = draw_views(3000, generator(13))
    log = math.log(3), math.log(140 / 3)  # 3 to 140 ft between camera and ground
    assert kstest(np.log(h + 5), "uniform", log).pvalue > 1e-6
    assert kstest(pitch, "norm", (0, 0.08)).pvalue > 1e-6
    assert abs(np.corrcoef(h, pitch)[0, 1]) < 6 / math.sqrt(3000)


def ray_traced(scene, i, h, side, pitch, seconds):
    """Picture i of a scene without noise, one ray a pixel; soft edges are as wide as its foot."""
    tilt, roll, right, ahead, heading, blur, shake, dust = scene.pose[i]
    bright, across, along, ground, asphalt, paint = scene.light[i]
    nod, turn = (Rotation.from_euler(*angle) for angle in (("x", tilt + pitch), ("z", heading)))
    wash = math.exp(-h / 8)
    unsharp = abs(blur) + wash * abs(shake)  # as a share of half the view
    foot = 0.75 * (h + 5) * math.hypot(2 / side, unsharp)  # in ft
    waves = [
        (a, b, c, size * math.exp(-(a * a + b * b) * foot**2 / 8))
        for a, b, c, size in scene.waves[i]
    ]
    picture = np.empty((side, side))

    def over(grey, tone, *depths):
        """Grey where what has this tone lies so deep within each of its edges."""
        return grey + math.prod(min(max(d / foot + 0.5, 0), 1) for d in depths) * (tone - grey)

    for row, column in np.ndindex(side, side):
        u, v = (2 * column + 1) / side - 1, 1 - (2 * row + 1) / side  # to the right, upwards
        ray = nod.apply([0.75 * u + roll, 0.75 * v, -1])
        x, y, _ = turn.apply((h + 5) * (ray / -ray[2] + [right, ahead, 0]))
        texture = sum(size * math.sin(a * x + b * y + c) for a, b, c, size in waves)
        grey, X, Y, r = ground + texture, abs(x), abs(y), math.hypot(x, y)
        cx, cy, radius, tone = scene.decoy[i]
        grey = over(grey, tone, radius - math.hypot(x - cx, y - cy))
        grey = over(grey, (ground + paint) / 2 + texture, 33.6 - X, 33.6 - Y)  # the apron
        grey = over(grey, asphalt + texture / 2, 14 - r)  # a pad of 14 ft, with a ring and an H
        for depths in (
            [0.98 - abs(r - 12.32)],
            [0.98 - abs(X - 3.64), 6.3 - Y],
            [3.64 - X, 0.98 - Y],
        ):
            grey = over(grey, paint, *depths)
        for cx, cy, a, b, angle, tone, speed in scene.boxes[i]:
            c, s = math.cos(angle), math.sin(angle)
            px, py = x - cx - seconds * speed * c, y - cy - seconds * speed * s
            for dx, dy, colour in ((px - 1, py + 1, grey / 2), (px, py, tone)):  # shadow, thing
                grey = over(grey, colour, a - abs(dx * c + dy * s), b - abs(dy * c - dx * s))
        grey += wash * min(abs(dust), 0.5) * (0.6 - grey)
        picture[row, column] = grey * bright * (1 + across * u + along * v)
    return picture


def test_pictures_are_those_of_a_ray_tracer():
    side, h, pitch, seconds = 32, np.array([4.0, 25, 70, 120]), [0.1, -0.15, 0.05, 0], 2.0
    scene = draw_scenes(4, generator(6))
    scene.boxes[:, :2, :2] = 3 * scene.boxes[:, :2, 2:4]  # two of the clutter near the pad
    scene.pose[:2, 7] = 0.9, -0.7  # more dust than there can be
    found = photograph(scene, h, side, generator(7), pitch=pitch, seconds=seconds)
    noise = 0.02 * generator(7).standard_normal(found.shape, dtype=np.float32)
    for i in range(4):
        traced = ray_traced(scene, i, h[i], side, pitch[i], seconds)
        np.testing.assert_allclose(found[i], np.clip(traced + noise[i], 0, 1), atol=1e-4)


def test_pictures_are_the_same_in_however_many_parts_they_are_taken():
    scene, h, pitch = draw_views(70, generator(2))  # of 36 pixels a side, 30 at a time
    one, rng = generator(3), generator(3)
    singly = [
        photograph(Scene(*(table[[i]] for table in scene)), h[[i]], 36, one, pitch=pitch[[i]])
        for i in range(70)
    ]
    together = photograph(scene, h, 36, rng, pitch=pitch)
    np.testing.assert_allclose(together, np.concatenate(singly), atol=1e-5)


def test_the_pad_measures_focal_length_times_size_over_distance():
    """Apron and pad are painted white, the ground is black, so brightness is a measured area."""
    h, side = np.array([60.0, 80, 100, 130]), 400
    scene = empty_scene(4)
    scene.light[:, 3:] = [0, 1, 0]  # ground and paint black: the disc less ring and H, and apron
    picture = photograph(scene, h, side, generator())
    middle = picture[:, side // 2]
    inside = (middle[:, :] > 0.5).sum(axis=1) + 0.0
    pixels = side / (2 * TANGENT * (h + MOUNT))
    # Along the middle row lie the disc, less two cuts of the ring, two legs and the bar.
    white = 2 * PAD - 4 * 0.07 * PAD - 2 * (0.26 + 0.07) * PAD
    assert np.all(np.abs(inside - white * pixels) <= 6)
    assert np.all(np.diff(inside) < 0)


def test_the_pad_fills_less_of_the_picture_from_higher_up():
    h = np.linspace(30, HIGHEST, 12)
    share = photograph(empty_scene(12), h, 48, generator()).mean(axis=(1, 2))
    assert np.all(np.diff(share) < 0)


def test_all_sizes_show_the_same_scene():
    """A small picture is the average of a large one, up to soft edges and the noise."""
    scene, h, pitch = draw_views(30, generator(2))
    large = photograph(scene, h, 96, generator(), pitch=pitch)
    small = photograph(scene, h, 24, generator(), pitch=pitch)
    mean = large.reshape(30, 24, 4, 24, 4).mean(axis=(2, 4))
    assert np.abs(small - mean).mean() < 0.03
    assert np.corrcoef(small.ravel(), mean.ravel())[0, 1] > 0.97


def test_clutter_moves_with_time_and_pitch_moves_the_view():
    scene, h = draw_scenes(5, generator(4)), np.full(5, 90.0)
    still, moved, tilted = (
        photograph(scene, h, 40, generator(), **options)
        for options in ({}, {"seconds": 4.0}, {"pitch": 0.2})
    )
    changed = (np.abs(still - moved) > 0.05).mean()
    assert 0 < changed < 0.2
    assert (np.abs(still - tilted) > 0.05).mean() > changed


@pytest.mark.parametrize(
    ("call", "start"),
    [
        (lambda s: photograph(s, [1.0], 8, generator()), "altitude: expected shape (N,) = (2,)"),
        (lambda s: photograph(s, [0, 200], 8, generator()), "altitude: expected -2 to 135 ft"),
        (lambda s: photograph(s, [0, -3], 8, generator()), "altitude: expected -2 to 135 ft"),
        (lambda s: photograph(s, [0, np.nan], 8, generator()), "altitude: expected finite"),
        (lambda s: photograph(s, [0, 1], 0, generator()), "side: expected an integer >= 1"),
        (lambda s: photograph(s, [0, 1], 8, 5), "rng: expected numpy.random.default_rng"),
        (lambda s: photograph(s, [0, 1], 8, generator(), pitch=np.nan), "pitch: expected finite"),
        (lambda s: draw_scenes(0, generator()), "count: expected an integer >= 1"),
        (lambda s: draw_scenes(3, None), "rng: expected numpy.random.default_rng"),
    ],
)
def test_the_camera_refuses(call, start):
    with pytest.raises(ValueError) as caught:
        call(draw_scenes(2, generator()))
    assert str(caught.value).startswith(start) and "\n" not in str(caught.value)


# -------------------------------------------------------------------------------- the networks


@pytest.mark.parametrize("size", ARCHITECTURE)
def test_parameters_and_operations_are_those_of_the_arrays(size):
    network = new_network(size, generator())
    side, filters, width = size
    arrays = [a for layer in network.layers for a in layer[:2]]
    assert network.parameters == sum(a.size for a in arrays)
    p1 = (side - 4) // 2 + 1
    p2 = (p1 - 3) // 2 + 1
    plain = p1**2 * 16 * filters + p2**2 * 9 * filters * 2 * filters
    assert network.multiply_adds == plain + p2**2 * 2 * filters * width + width


@pytest.mark.parametrize("size", ARCHITECTURE)
def test_new_weights_are_normal_with_variance_two_over_inputs(size):
    side, filters, width = size
    S = ((side - 4) // 2 + 1 - 3) // 2 + 1
    inputs = [16, 9 * filters, S * S * 2 * filters, width]
    layers = new_network(size, generator(4)).layers
    assert [layer.window for layer in layers] == [4, 3, S, 1]
    for layer, n, scale in zip(layers, inputs, (1, 1, 1, 0.1), strict=True):
        assert layer.weight.shape == (n, len(layer.bias)) and not layer.bias.any()
        z = layer.weight.ravel() / (scale * math.sqrt(2 / n))
        assert kstest(z, "norm").pvalue > 1e-6
        assert layer.weight.dtype == layer.bias.dtype == np.float32


def test_larger_models_cost_more():
    networks = [new_network(size, generator()) for size in ARCHITECTURE]
    assert np.all(np.diff([n.parameters for n in networks]) > 0)
    assert np.all(np.diff([n.multiply_adds for n in networks]) > 0)


def plain_output(network, picture):
    """The network as loops over windows, in double precision."""
    x = ((picture - picture.mean()) / (picture.std() + 0.05))[..., None].astype(float)
    for i, layer in enumerate(network.layers):
        k = layer.window
        P = (len(x) - k) // 2 + 1
        out = np.empty((P, P, layer.weight.shape[1]))
        for r in range(P):
            for c in range(P):
                window = x[2 * r : 2 * r + k, 2 * c : 2 * c + k]
                out[r, c] = window.transpose(2, 0, 1).ravel() @ layer.weight + layer.bias
        x = out if i == 3 else np.maximum(out, 0)
    return x.item()


def test_forward_equals_plain_loops():
    network, rng = new_network((17, 3, 5), generator(2)), generator(3)
    pictures = rng.random((4, 17, 17)).astype(np.float32)
    expected = [plain_output(network, picture) for picture in pictures]
    np.testing.assert_allclose(forward(network.layers, pictures)[0], expected, atol=1e-5)


#: Of log distances spread evenly from 3 to 140 ft: their mean and their standard deviation.
MIDDLE, WIDTH = math.log(3 * 140) / 2, math.log(140 / 3) / math.sqrt(12)


def plain_altitudes(network, pictures):
    """What a network makes of pictures, in ft, by loops."""
    logs = [MIDDLE + WIDTH * plain_output(network, picture) for picture in pictures]
    return np.array([min(max(math.exp(log) - 5, -2), 135) for log in logs])


def test_altitudes_are_those_of_plain_loops():
    network, rng = new_network((17, 3, 5), generator(2)), generator(3)
    network.layers[-1].weight[...] *= 20  # so that some estimates leave the range
    pictures = rng.random((40, 17, 17)).astype(np.float32)
    found = network.altitude(pictures)
    np.testing.assert_allclose(found, plain_altitudes(network, pictures), rtol=1e-4)
    assert 0 < np.mean((found > LOWEST) & (found < HIGHEST)) < 1


def test_gradients_equal_finite_differences():
    network, rng = new_network((13, 2, 4), generator(2)), generator(3)
    layers = [
        type(x)(x.weight.astype(float), x.bias + rng.normal(size=x.bias.shape), x.window)
        for x in network.layers
    ]
    pictures, target = rng.random((5, 13, 13)), rng.normal(size=5)
    loss, slopes = gradients(layers, pictures, target)
    assert loss == pytest.approx(((forward(layers, pictures)[0] - target) ** 2).mean())
    arrays = [a for layer in layers for a in layer[:2]]
    for array, slope in zip(arrays, slopes, strict=True):
        direction, step = rng.normal(size=array.shape), 1e-6
        array += step * direction
        up = gradients(layers, pictures, target)[0]
        array -= 2 * step * direction
        down = gradients(layers, pictures, target)[0]
        array += step * direction
        assert (up - down) / (2 * step) == pytest.approx(
            (slope * direction).sum(), rel=2e-3, abs=2e-5
        )


def test_folding_is_the_transpose_of_cutting():
    rng = generator()
    x = rng.normal(size=(2, 9, 9, 3))
    cut = networks.cut_windows(x, 4)
    d = rng.normal(size=cut.shape)
    assert (cut * d).sum() == pytest.approx((x * networks.add_windows(d, 4, x.shape)).sum())


@pytest.mark.parametrize("number", [np.float32, np.float64])
def test_sums_forth_and_back_keep_the_precision_of_the_weights(number):
    network, rng = new_network((12, 2, 3), generator(2)), generator(3)
    layers = [
        type(x)(x.weight.astype(number), x.bias.astype(number), x.window) for x in network.layers
    ]
    pictures = rng.random((3, 12, 12))
    output, seen = forward(layers, pictures)
    found = [output, *(array for pair in seen for array in pair)]
    found += gradients(layers, pictures, rng.normal(size=3))[1]
    assert {array.dtype for array in found} == {np.dtype(number)}


@pytest.mark.no_cover
def test_the_last_layer_alone_learns_like_least_squares():
    """On features that stay as they are, many small steps reach the solution of lstsq."""
    rng = generator(5)
    network = new_network((12, 2, 3), rng)
    pictures = rng.random((40, 12, 12)).astype(np.float32)
    target = rng.normal(size=40)
    layers = [
        type(x)(x.weight.astype(float), x.bias.astype(float) + 0.5, x.window)
        for x in network.layers
    ]
    for _ in range(4000):
        slopes = gradients(layers, pictures, target)[1]
        layers[-1].weight[...] -= 0.05 * slopes[-2]
        layers[-1].bias[...] -= 0.05 * slopes[-1]
    features = forward(layers, pictures)[1][-1][1].reshape(40, -1)
    X = np.column_stack([features, np.ones(40)])
    least = np.linalg.lstsq(X, target, rcond=None)[0]
    assert ((X @ least - target) ** 2).mean() == pytest.approx(
        gradients(layers, pictures, target)[0], rel=1e-3
    )


def adam(network, picture, altitude, epochs, batches):
    """Kingma and Ba's algorithm 1 in double precision, slopes by differences of `plain_output`."""
    layers = [type(x)(x[0].astype(float), x[1].astype(float), x.window) for x in network.layers]
    arrays = [array for layer in layers for array in layer[:2]]
    goal, losses = (math.log(altitude + 5) - MIDDLE) / WIDTH, []

    def loss():
        return (plain_output(network._replace(layers=layers), picture) - goal) ** 2

    def slope(array, place):
        kept, found = array[place], []
        for array[place] in (kept + 1e-6, kept - 1e-6):
            found.append(loss())
        array[place] = kept
        return (found[0] - found[1]) / 2e-6

    places = [(array, place) for array in arrays for place in np.ndindex(array.shape)]
    m, v = np.zeros((2, len(places)))
    for t in range(1, epochs * batches + 1):
        losses.append(loss())
        g = np.array([slope(*place) for place in places])
        m, v = 0.9 * m + 0.1 * g, 0.999 * v + 0.001 * g**2
        cosine = (1 + math.cos(math.pi * (t - 1) / (epochs * batches))) / 2
        move = 0.003 * min(t / batches, cosine) * (m / (1 - 0.9**t))
        move /= np.sqrt(v / (1 - 0.999**t)) + 1e-8
        for (array, place), step in zip(places, move, strict=True):
            array[place] -= step
    return arrays, np.mean(np.reshape(losses, (epochs, batches)), axis=1)


def test_training_is_adam_by_differences():
    # One picture forty times, the same however it is turned: two batches an epoch, all alike.
    network, side = new_network((8, 2, 3), generator(1)), np.arange(8)
    ring = np.maximum.outer(abs(side - 3.5), abs(side - 3.5)).astype(int)
    picture = generator(3).random(4)[ring].astype(np.float32)
    for layer in network.layers:
        layer.bias[...] = 0.1
    arrays, losses = adam(network, picture, 50.0, 3, 2)
    found = train_network(network, np.tile(picture, (40, 1, 1)), np.full(40, 50.0), 3, generator(2))
    np.testing.assert_allclose(found, losses, rtol=1e-4)
    for ours, theirs in zip((a for x in network.layers for a in x[:2]), arrays, strict=True):
        np.testing.assert_allclose(ours, theirs, atol=2e-5)


def test_training_lowers_the_loss_and_beats_the_mean():
    scene, h, pitch = draw_views(400, generator(7))
    network = new_network((16, 3, 12), generator(8))
    pictures = photograph(scene, h, 16, generator(9), pitch=pitch)
    losses = train_network(network, pictures[:300], h[:300], 30, generator(10))
    assert losses.shape == (30,)
    assert losses[-1] < 0.6 * losses[0]
    seen = np.log(network.altitude(pictures[300:]) + MOUNT)
    true = np.log(h[300:] + MOUNT)
    assert ((seen - true) ** 2).mean() < 0.6 * true.var()


def test_estimates_stay_within_range():
    network = new_network((12, 2, 4), generator())
    for bias, expected in ((100, HIGHEST), (-100, LOWEST)):
        network.layers[-1].bias[...] = bias
        np.testing.assert_allclose(network.altitude(np.zeros((3, 12, 12), np.float32)), expected)


def test_models_repeat_and_are_measured_on_pictures_that_they_never_saw(trained, monkeypatch):
    seen = []
    original = train_network

    def spy(network, pictures, altitude, epochs, rng):
        seen.append((pictures.copy(), altitude.copy()))
        return original(network, pictures, altitude, epochs, rng)

    monkeypatch.setattr(perception, "train_network", spy)
    again = train_models(generator(1), **SMALL)
    np.testing.assert_array_equal(again.losses, trained.losses)
    np.testing.assert_array_equal(again.residuals.residual, trained.residuals.residual)
    W, M = 3, SMALL["held_out"]
    held = trained.residuals.altitude.reshape(W, M)
    np.testing.assert_array_equal(held, held[:1].repeat(W, axis=0))
    for pictures, altitude in seen:
        assert len(pictures) == SMALL["training"]
        assert not np.isin(held[0], altitude).any()
    np.testing.assert_array_equal(trained.residuals.model, np.repeat(np.arange(W), M))
    assert trained.residuals.names == ("b0", "b1", "b2")
    assert trained.losses.shape == (W, SMALL["epochs"])


def test_residuals_are_what_loops_see_in_pictures_that_were_held_out(monkeypatch):
    taken = []

    def keep(scene, altitude, *arguments, **options):
        taken.append((photograph(scene, altitude, *arguments, **options), altitude))
        return taken[-1][0]

    monkeypatch.setattr(perception, "photograph", keep)
    models = train_models(generator(1), **SMALL)
    fresh = measure_models(models.networks, 9, generator(2))
    for measured, first, n in ((models.residuals, SMALL["training"], 40), (fresh, 0, 9)):
        for w, network in enumerate(models.networks):
            pictures, h = (part[first:] for part in taken.pop(0))
            rows = slice(w * n, w * n + n)
            np.testing.assert_array_equal(measured.altitude[rows], h)
            expected = plain_altitudes(network, pictures) - h
            np.testing.assert_allclose(measured.residual[rows], expected, atol=1e-3)


def test_fresh_measurements_are_those_of_the_models(trained):
    fresh = measure_models(trained.networks, 9, generator(3))
    rng = generator(3)
    scene, h, pitch = draw_views(9, rng)
    np.testing.assert_array_equal(fresh.altitude, np.tile(h, 3))
    picture = photograph(scene, h, trained.networks[0].side, rng, pitch=pitch)
    expected = trained.networks[0].altitude(picture) - h
    np.testing.assert_array_equal(fresh.residual[:9], expected)


@pytest.mark.parametrize("name", ["training", "held_out", "epochs"])
def test_train_models_refuses(name):
    with pytest.raises(ValueError, match=f"{name}: expected an integer >= 1, found 0"):
        train_models(generator(), **(SMALL | {name: 0}))


# -------------------------------------------------------------------------------------- the file


def test_models_survive_a_file(trained, tmp_path):
    path = tmp_path / "models.npz"
    path.write_bytes(pack_models(trained, "key"))
    back = load_models(path, "key", SMALL["architecture"])
    for old, new in zip(trained.networks, back.networks, strict=True):
        assert old.side == new.side
        for a, b in zip(old.layers, new.layers, strict=True):
            np.testing.assert_array_equal(a.weight, b.weight)
            np.testing.assert_array_equal(a.bias, b.bias)
            assert a.window == b.window and b.weight.dtype == np.float32
    np.testing.assert_array_equal(trained.losses, back.losses)
    for field in ("names", "model", "altitude", "residual"):
        np.testing.assert_array_equal(
            getattr(trained.residuals, field), getattr(back.residuals, field)
        )


def test_the_file_is_a_plain_npz_of_named_arrays(trained, tmp_path):
    table = dict(np.load(io.BytesIO(pack_models(trained, "key"))))
    assert str(table.pop("key")) == "key"
    np.testing.assert_array_equal(table.pop("altitude"), trained.residuals.altitude)
    np.testing.assert_array_equal(table.pop("residual"), trained.residuals.residual)
    np.testing.assert_array_equal(table.pop("losses"), trained.losses)
    assert len(table) == 3 * 4 * 2
    for name, array in table.items():
        w, layer, part = map(int, name.split("."))
        np.testing.assert_array_equal(array, trained.networks[w].layers[layer][part])
    shapes = {"0.0": (16, 2), "0.1": (2,), "1.0": (18, 4), "1.1": (4,)}
    shapes |= {"2.0": (4, 3), "2.1": (3,), "3.0": (3, 1), "3.1": (1,)}  # one window of 1^2 * 4
    arrays = {f"0.{k}": np.arange(np.prod(s)).reshape(s) / 8 for k, s in shapes.items()}
    arrays |= {"losses": [[2.0, 1.0]], "altitude": [3.0, 4.0], "residual": [0.5, -0.5]}
    np.savez(tmp_path / "by_hand.npz", key=np.array("k"), **arrays)
    back = load_models(tmp_path / "by_hand.npz", "k", [(8, 2, 3)])
    for k in shapes:
        layer, part = map(int, k.split("."))
        np.testing.assert_array_equal(back.networks[0].layers[layer][part], arrays[f"0.{k}"])
    assert back.losses.tolist() == [[2, 1]] and back.residuals.names == ("b0",)
    assert back.residuals.altitude.tolist() == [3, 4] and back.residuals.residual[1] == -0.5


def repacked(content, **changes):
    """The same file with arrays changed, or left out where they are None."""
    table = dict(np.load(io.BytesIO(content))) | changes
    file = io.BytesIO()
    np.savez(file, **{name: array for name, array in table.items() if array is not None})
    return file.getvalue()


def a_pickle():
    file = io.BytesIO()
    np.savez(file, key=np.array([{"run": "me"}], dtype=object))
    return file.getvalue()


def one_array():
    file = io.BytesIO()
    np.save(file, np.zeros(3))
    return file.getvalue()


@pytest.mark.parametrize(
    ("damage", "why"),
    [
        (lambda c: b"", ""),
        (lambda c: b"model,altitude,residual\n", ""),
        (lambda c: c[: len(c) // 2], ""),
        (lambda c: c[:2000] + b"\x00" * 200 + c[2200:], ""),
        (lambda c: a_pickle(), "Object arrays cannot be loaded"),
        (lambda c: one_array(), ""),
        (lambda c: repacked(c, key=np.array("other")), "expected the key key, found other"),
        (lambda c: repacked(c, key=None), "key"),
        (lambda c: repacked(c, losses=None), "losses"),
        (lambda c: repacked(c, losses=np.zeros((1, 2))), "losses: expected shape"),
        (lambda c: repacked(c, **{"1.2.0": None}), "1.2.0"),
        (lambda c: repacked(c, **{"1.2.0": np.zeros((3, 3))}), "1.2.0: expected shape (n, k)"),
        (lambda c: repacked(c, **{"0.3.1": np.array([np.nan])}), "0.3.1: expected finite"),
        (lambda c: repacked(c, residual=np.full(120, np.nan)), "residual: expected finite"),
        (lambda c: repacked(c, altitude=np.zeros(7)), "altitude: expected shape"),
    ],
)
def test_a_bad_file_gives_one_line_and_stays(trained, tmp_path, damage, why):
    path = tmp_path / "models.npz"
    path.write_bytes(bad := damage(pack_models(trained, "key")))
    with pytest.raises(ValueError) as caught:
        load_models(path, "key", SMALL["architecture"])
    message = str(caught.value)
    assert message.startswith(f"{path}: no file of these models, delete or move it: ")
    assert why in message and "\n" not in message
    assert path.read_bytes() == bad


def test_a_file_of_other_sizes_is_refused(trained, tmp_path):
    path = tmp_path / "models.npz"
    path.write_bytes(pack_models(trained, "key"))
    for sizes in (ARCHITECTURE[1:4], ARCHITECTURE[:4]):
        with pytest.raises(ValueError, match="no file of these models"):
            load_models(path, "key", sizes)
    for place, why in (("missing.npz", "No such file or directory"), ("", "Is a directory")):
        with pytest.raises(ValueError, match=f"^path: expected a file of models, found .*: {why}$"):
            load_models(tmp_path / place, "key")  # there is nothing to delete or move
    for other in (path / "below", "a\0b", None, 5):
        with pytest.raises(ValueError, match=r"^path: expected a file of models, found '"):
            load_models(other, "key")


# ---------------------------------------------------------------------------- what is made of them


def some_residuals(rng, size=60):
    altitude = rng.uniform(0, 10, 2 * size)
    model = np.repeat([0, 1], size)
    return Residuals(["a", "b"], model, altitude, rng.exponential(1 + model + altitude))


def test_bootstrapped_errors_are_residuals_of_their_bin_with_their_moments():
    residuals, h, bins = some_residuals(generator(1)), np.array([9.0, 4.0, 0.5, 4.5]), [0, 3, 6, 10]
    trials, mean, spread = 40_000, np.empty((4, 2, 1)), np.empty((4, 2, 1))
    errors = bootstrap_errors(residuals, h, trials, generator(2), bins=bins)
    assert errors.shape == (trials, 4, 2, 1)
    for t in range(4):
        b = np.digitize(h[t], bins)
        for w in range(2):
            mine = (np.digitize(residuals.altitude, bins) == b) & (residuals.model == w)
            r = residuals.residual[mine]
            assert set(errors[:, t, w, 0]) == set(r)
            mean[t, w], spread[t, w] = sum(r) / len(r), sum((r - sum(r) / len(r)) ** 2) / len(r)
    assert np.all(np.abs(errors.mean(0) - mean) <= 6 * np.sqrt(spread / trials))
    fourth = ((errors - mean) ** 4).mean(0)
    assert np.all(np.abs(errors.var(0) - spread) <= 6 * np.sqrt(fourth / trials))
    pairs = np.corrcoef(errors.reshape(trials, -1), rowvar=False) - np.eye(8)
    assert np.abs(pairs).max() <= 6 / math.sqrt(trials - 1)
    np.testing.assert_array_equal(
        errors, bootstrap_errors(residuals, h, trials, generator(2), bins=bins)
    )


def test_bootstrap_refuses_as_fitting_does():
    residuals = some_residuals(generator(1), 2)
    with pytest.raises(ValueError, match="residuals: expected 2 or more of"):
        bootstrap_errors(residuals, [1.0, 9.0], 3, generator(), bins=[0, 5, 10])
    with pytest.raises(ValueError, match="trials: expected an integer >= 1"):
        bootstrap_errors(residuals, [1.0, 9.0], 0, generator(), bins=1)
    with pytest.raises(ValueError, match="rng: expected"):
        bootstrap_errors(residuals, [0.0, 10.0], 3, 0, bins=1)


@pytest.mark.parametrize("level", [0.5, 0.8, 0.95])
@pytest.mark.parametrize("true_mean", [0.7, -0.1, 0.0])
def test_guarded_bounds_hold_as_often_as_they_say(level, true_mean):
    """One suite of 4000 steps, each measured on five residuals of its own."""
    H, n = 4000, 5
    r = generator(6).normal(true_mean, 2.0, (H, n))
    v = r.var(axis=1, ddof=1)
    size, error = np.full((H, 1), n), np.sqrt(v / n)[:, None, None]
    suite = PerceptionSuite(["a"], r.mean(1)[:, None, None], v[:, None, None], [1], size, error)
    guarded = guard_suite(suite, level)
    tolerance = 4 * math.sqrt(level * (1 - level) / H)
    holds = (guarded.variance >= 4.0).mean()
    assert abs(holds - level) <= tolerance
    assert (np.abs(guarded.mean) >= abs(true_mean)).mean() >= level - tolerance
    assert np.all(np.abs(guarded.mean) >= np.abs(suite.mean))
    assert np.all(guarded.mean * suite.mean >= 0)
    np.testing.assert_array_equal(guarded.sample_size, suite.sample_size)


def test_guards_fade_with_many_residuals_and_have_the_textbook_factors():
    def guarded(n):
        one = np.ones((1, 1, 1))
        suite = PerceptionSuite(["a"], one, 4 * one, [1], [[n]], np.sqrt(4 / n) * one)
        return guard_suite(suite, 0.9)

    # From printed tables, 9 degrees of freedom: t at 0.9, chi-square at 0.1.
    assert guarded(10).mean.item() == pytest.approx(1 + 1.383029 * math.sqrt(0.4), rel=1e-6)
    assert guarded(10).variance.item() == pytest.approx(4 * 9 / 4.168159, rel=1e-6)
    assert guarded(10**7).mean.item() == pytest.approx(1, abs=2e-3)
    assert guarded(10**7).variance.item() == pytest.approx(4, rel=2e-3)


def test_guard_refuses():
    suite = fit_suite(some_residuals(generator(1)), [1.0, 9.0], [1, 1], bins=1)
    for bad in (
        replace(suite, sample_size=None),
        replace(suite, standard_error=None),
        replace(suite, sample_size=np.ones((2, 2))),
    ):
        with pytest.raises(ValueError, match="suite: expected one measured"):
            guard_suite(bad)
    for level in (0.4, 1.0, np.nan):
        with pytest.raises(ValueError, match="level: expected"):
            guard_suite(suite, level)


@pytest.mark.parametrize("count", [1, 4, 20])
def test_bins_hold_equally_many_altitudes(count):
    altitude, h = generator(3).exponential(20, 900), np.linspace(100, 1, 50)
    edges = altitude_bins(altitude, h, count)
    assert edges[0] == 1 and edges[-1] == 100 and len(edges) == count + 1
    held = np.histogram(altitude[(altitude > 1) & (altitude < 100)], edges)[0]
    assert np.ptp(held) <= 2
    with pytest.raises(ValueError, match="altitude: expected 5 or more along the way, found 2"):
        altitude_bins([2.0, 3.0, 200.0], h, 5)
