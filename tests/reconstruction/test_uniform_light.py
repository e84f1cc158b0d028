"""The start without uniform light: exact on the pixels that are kept, and worth its iterations."""

import math

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.signal
from reconstruction import rig, scenes

import thincam_jax as tc
from helpers import relative_l2
from thincam_jax.imaging.operators import CropConvolution
from thincam_jax.imaging.operators.crop_convolution import kernel_shape
from thincam_jax.reconstruction import regularised, uniform_light
from thincam_jax.reconstruction.problem import objective, residuals
from thincam_jax.reconstruction.uniform_light import (
    full_windows,
    with_uniform_light,
    without_uniform_light,
)
from thincam_jax.units import um

SENSOR, FIELD, LENGTH = (48, 61), (40, 45), 7
SHAPE = kernel_shape(SENSOR, FIELD)
PITCH = 0.2
WIDE = (192, 224)  # pixels of a camera that is biased: an aperture of 224


@pytest.fixture(autouse=True)
def all_pixels_at_once(monkeypatch):
    """The first part of the finest pixels, which else begin with an image of coarser ones."""
    monkeypatch.setattr(regularised, "_COARSER", 0)


@pytest.fixture
def low_bar(monkeypatch):
    """Small cameras are biased, too."""
    monkeypatch.setattr(uniform_light, "_BIASED", 5.0)


def kernels(channels=1, planes=1, phase=0.0):
    """Zone plates (channel, plane, k, l), finer from plane to plane and channel to channel."""
    stack = [
        scenes.zone_plate(SHAPE, phase, 0.01 * (1 + 0.3 * p) * (1 + 0.1 * c))
        for c in range(channels)
        for p in range(planes)
    ]
    return np.reshape(stack, (channels, planes, *SHAPE))


def noisy_problem(*responses, batch=(), channels=1, weights=None):
    """Captures that no image explains, through each of the kernels given."""
    rng = np.random.default_rng(8)
    operators = [CropConvolution(jnp.asarray(k), PITCH, SENSOR, FIELD, summed=1) for k in responses]
    captures = [jnp.asarray(rng.uniform(1, 2, (*batch, channels, *SENSOR))) for _ in responses]
    return scenes.inverse(operators, captures, tau=1e-3, weights=weights)


def hann(length=LENGTH):
    """sin² in both directions, of sum 1, with nothing left out at the rim."""
    line = np.sin(np.pi * np.arange(1, length + 1) / (length + 1)) ** 2
    return np.outer(line, line) / line.sum() ** 2


def without_slow_part(image, length=LENGTH):
    """p ∗ image, (length − 1)/2 fewer pixels at each border."""
    edge = length // 2
    smooth = scipy.signal.convolve(image, hann(length), mode="valid", method="direct")
    return image[edge:-edge, edge:-edge] - smooth


def seen(kernel, image):
    """The crop-convolution by its sum; the kernel covers all differences."""
    return PITCH**2 * scipy.signal.convolve(kernel, image, mode="valid", method="direct")


def inside(capture, length=LENGTH):
    edge = length // 2
    return np.asarray(capture)[..., edge:-edge, edge:-edge]


@pytest.mark.parametrize(
    "batch, channels, own_psfs, planes", [((), 1, True, 1), ((), 1, True, 2), ((2,), 3, False, 1)]
)
@pytest.mark.usefixtures("low_bar")
def test_the_high_pass_commutes_with_the_camera(batch, channels, own_psfs, planes):
    """H′f = p ∗ (Hf) inside, and g′ = p ∗ g, against sums; 48×61 pixels make a window of 7."""
    psfs = kernels(channels if own_psfs else 1, planes)
    problem = noisy_problem(psfs, batch=batch, channels=channels)
    rng = np.random.default_rng(2)
    image = rng.uniform(size=problem.image_shape)
    easier = without_uniform_light(problem)
    assert easier is not None
    capture = problem.captures[0]
    found = inside(easier.operators[0](jnp.asarray(image)))
    left = inside(easier.captures[0])
    for index in np.ndindex(capture.shape[:-2]):
        of_channel = psfs[index[-1] if own_psfs else 0]
        whole = sum(seen(k, f) for k, f in zip(of_channel, image[index], strict=True))
        assert relative_l2(found[index], without_slow_part(whole)) < 1e-10
        assert relative_l2(left[index], without_slow_part(capture[index])) < 1e-10


@pytest.mark.usefixtures("low_bar")
def test_what_is_weighed_are_the_whole_windows():
    """One weight for all, weights of pixels, and those of each image of a batch."""
    rim = np.zeros(SENSOR, bool)
    rim[3:-3, 3:-3] = True
    assert np.array_equal(without_uniform_light(noisy_problem(kernels())).weights[0], rim)
    rng = np.random.default_rng(4)
    each = rng.uniform(0.5, 2, (2, 1, *SENSOR))
    each[1, 0, 20, 30] = 0
    easier = without_uniform_light(
        noisy_problem(kernels(), batch=(2,), weights=[jnp.asarray(each)])
    )
    wanted = np.stack([rim, rim])[:, None]
    wanted[1, 0, 17:24, 27:34] = False
    np.testing.assert_array_equal(easier.weights[0], each * wanted)


@pytest.mark.usefixtures("low_bar")
def test_what_is_not_trusted_does_not_leak():
    """Not even by rounding: a dead pixel may hold anything."""
    weight = np.ones(SENSOR)
    weight[10, 20] = 0
    problem = noisy_problem(kernels(), weights=[jnp.asarray(weight)])
    spoilt = eqx.tree_at(
        lambda p: p.captures, problem, (problem.captures[0].at[0, 10, 20].set(1e30),)
    )
    clean, easier = without_uniform_light(problem), without_uniform_light(spoilt)
    kept = np.asarray(easier.weights[0]) > 0
    np.testing.assert_allclose(
        easier.captures[0][0][kept], clean.captures[0][0][kept], rtol=0, atol=1e-13
    )


@pytest.mark.parametrize("length", [3, 7])
def test_whole_windows_against_a_loop(length):
    rng = np.random.default_rng(3)
    trusted = rng.uniform(size=(2, 3, 23, 31)) > 0.02
    edge, wanted = length // 2, np.zeros_like(trusted)
    for *which, y, x in np.ndindex(trusted.shape):
        if edge <= y < 23 - edge and edge <= x < 31 - edge:
            window = trusted[*which, y - edge : y + edge + 1, x - edge : x + edge + 1]
            wanted[*which, y, x] = window.all()
    np.testing.assert_array_equal(full_windows(trusted, length), wanted)
    np.testing.assert_array_equal(full_windows(trusted[0, 0], length), wanted[0, 0])
    assert 0 < wanted.sum() < trusted.sum()


@pytest.mark.usefixtures("low_bar")
def test_too_few_pixels():
    """A sensor of 31 pixels has no window of 5, and scattered dead pixels leave no window whole."""
    for rows, wanted in ((31, False), (32, True)):
        operator = scenes.convolution((rows, 47), FIELD)
        problem = scenes.inverse([operator], [jnp.ones((1, rows, 47))], tau=1e-3)
        assert (without_uniform_light(problem) is not None) == wanted
    dead = np.ones(SENSOR)
    dead[::6, ::6] = 0
    assert without_uniform_light(noisy_problem(kernels(), weights=[jnp.asarray(dead)])) is None


@pytest.mark.usefixtures("low_bar")
def test_captures_of_other_sizes_and_float32():
    """As those at several distances are; each by its own corner of the window."""
    sizes, window = (SENSOR, (56, 71)), (128, 160)
    image = jnp.asarray(scenes.blocks(FIELD), "float32")[None, None]
    plates = [scenes.zone_plate(kernel_shape(s, FIELD), 0.0, 0.01)[None, None] for s in sizes]
    operators = [
        CropConvolution(jnp.asarray(k, "float32"), PITCH, s, FIELD, summed=1, window=window)
        for k, s in zip(plates, sizes, strict=True)
    ]
    problem = scenes.inverse(operators, [o(image) for o in operators], tau=1e-3)
    easier = without_uniform_light(problem)
    assert {x.dtype for x in (*easier.captures, *easier.weights)} == {jnp.dtype("float32")}
    off = residuals(easier, image)
    for weight, error, capture in zip(easier.weights, off, problem.captures, strict=True):
        assert jnp.max(weight * jnp.abs(error)) < 1e-5 * jnp.max(capture)


@pytest.mark.parametrize("planes, channels, batch", [(1, 1, ()), (2, 3, (2,))])
def test_the_level_is_found_again(planes, channels, batch):
    """Of every image and colour its own; weights of two captures, one of them partly dead."""
    operators = [scenes.convolution(phase=k, planes=planes, channels=channels) for k in (0, 1)]
    rng = np.random.default_rng(6)
    shape = (*batch, channels, planes, *scenes.FIELD)
    image = jnp.asarray(rng.uniform(1, 2, shape))
    mask = jnp.asarray(rng.uniform(size=scenes.SENSOR) > 0.2, float)
    captures = [o(image) for o in operators]
    problem = scenes.inverse(operators, captures, tau=1e-3, weights=[mask, 3.0])
    lost = jnp.asarray(rng.uniform(-0.5, 0.5, (*batch, channels, 1, 1, 1)))
    np.testing.assert_allclose(with_uniform_light(problem, image - lost), image, rtol=1e-10)


def wide(shape=WIDE):
    """A camera with an aperture of as many pixels as its sensor, and a capture of it at 30 dB."""
    sensor = tc.Sensor(shape, 25 * um)
    camera = rig.camera(sensor=sensor, beta=10.0, width=shape[1] * 25 * um)
    clean = rig.captures([camera], scenes.blocks(shape, seed=5, count=9))[:, None]  # one colour
    sigma = float(jnp.std(clean)) / math.sqrt(1000)
    noise = np.random.default_rng(4).normal(size=clean.shape)
    # With a mask both parts of the iterations are the same programs; compiling takes the time here.
    valid = np.ones(clean.shape, bool)
    valid[..., 20, 40:43] = False
    return camera, clean + sigma * noise, sigma**2, valid


@pytest.fixture(scope="module")
def wide_capture():
    return wide()


def solve(capture, *, iterations=60, tolerance=0.0, **settings):
    camera, image, variance, valid = capture
    cameras = tc.Cameras(
        [camera],
        object_distance=rig.OBJECT_DISTANCE,
        wavelength=rig.WAVELENGTH,
        model="geometric",
        pixel_integration=False,
    )
    recording = tc.Recording(image, cameras, noise_variance=variance, valid=valid, background=0.0)
    return tc.reconstruct(
        recording, tc.AdmmTV(iterations=iterations, tolerance=tolerance), **settings
    )


def lowest(result):
    return min(p.objective for p in result.history)


@pytest.mark.thorough
def test_the_start_is_worth_its_iterations(wide_capture, monkeypatch):
    """After 60 iterations E is 33 000 with it and 57 000 without; the minimum is 30 000."""
    better = solve(wide_capture)
    monkeypatch.setattr(uniform_light, "without_uniform_light", lambda problem: None)
    plain = solve(wide_capture)
    assert lowest(better) < 0.7 * lowest(plain)
    truth = scenes.blocks(WIDE, seed=5, count=9)
    assert relative_l2(better.image[0], truth) < 0.8 * relative_l2(plain.image[0], truth)


@pytest.mark.thorough
@pytest.mark.parametrize("ending", ["stopped", "interrupted"])
def test_it_can_end_in_the_first_part(wide_capture, ending):
    """With the image so far, levelled: its objective is the last of the history."""

    def end(progress):
        if progress.iteration == 20 and ending == "interrupted":
            raise KeyboardInterrupt
        return progress.iteration == 20

    problems, images = [], []

    def noted(problem, image):
        problems.append(problem)
        images.append(with_uniform_light(problem, image))
        return images[-1]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(uniform_light, "with_uniform_light", noted)
        result = solve(wide_capture, callback=end)
    assert (result.status, result.iterations) == (ending, 20)
    assert [p.iteration for p in result.history] == [0, 10, 20]
    np.testing.assert_array_equal(result.image, images[-1][:, 0, ::-1, ::-1])
    assert float(objective(problems[-1], images[-1])) == pytest.approx(result.history[-1].objective)
