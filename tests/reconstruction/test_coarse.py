"""The coarser problem that gives AdmmTV its start."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
import skimage

import thincam_jax as tc
from helpers import relative_l2
from thincam_jax._core.grids import block_mean, block_sum
from thincam_jax.imaging.metrics import psnr
from thincam_jax.imaging.operators import CropConvolution
from thincam_jax.imaging.targets import resize
from thincam_jax.reconstruction import InverseProblem
from thincam_jax.reconstruction.coarse import coarser

SENSOR, FIELD = (98, 121), (103, 110)
RNG = np.random.default_rng(0)


def small_problem(kernel=(31, 38), sensor=SENSOR):
    """Two captures with weights, of PSFs smaller than the field."""
    parity = [(s + f - 1 - k) % 2 for s, f, k in zip(sensor, FIELD, kernel, strict=True)]
    shape = tuple(k + p for k, p in zip(kernel, parity, strict=True))
    kernels = [jnp.asarray(RNG.random((1, 1, *shape))) for _ in range(2)]
    operators = [CropConvolution(k, 0.1, sensor, FIELD, summed=1) for k in kernels]
    captures = [RNG.random((1, *sensor)) for _ in operators]
    weights = [(RNG.random(sensor) > 0.3) * RNG.random(sensor) for _ in operators]
    return InverseProblem(operators, captures, weights=weights, background="nonnegative")


@pytest.mark.parametrize("kernel", [(31, 38), (400, 400)])
def test_the_coarse_operator_is_that_of_repeated_pixels(kernel):
    """Against the fine one, of an image whose pixels are repeated, and blocks of its capture."""
    problem = small_problem(kernel)
    found = coarser(problem, jnp.zeros(problem.image_shape))
    assert found is not None
    coarse, start = found
    assert coarse.field_shape == (52, 55) and start.shape == coarse.image_shape
    image = np.array(RNG.random(coarse.image_shape))
    # The last block of an odd field is half outside.
    image[..., -1, :] = 0
    repeated = image.repeat(2, axis=-2).repeat(2, axis=-1)[..., : FIELD[0], : FIELD[1]]
    for fine, own in zip(problem.operators, coarse.operators, strict=True):
        expected = block_mean(fine(jnp.asarray(repeated))[..., :98, :120], 2)
        assert relative_l2(own(jnp.asarray(image)), expected) < 1e-12
    assert coarse.background == "nonnegative"
    assert float(coarse.absolute_tau) == pytest.approx(2 * float(problem.absolute_tau))


def test_captures_are_means_by_weight():
    """The weight of a block is the sum, so that its mean is as certain as all of its pixels."""
    problem = small_problem()
    coarse, _ = coarser(problem, jnp.zeros(problem.image_shape))
    for k in range(2):
        weight, capture = (x[k][..., :98, :120] for x in (problem.weights, problem.captures))
        np.testing.assert_allclose(coarse.weights[k], block_sum(weight, 2))
        total = block_sum(weight * capture, 2)
        np.testing.assert_allclose(coarse.captures[k] * coarse.weights[k], total)


def test_what_is_too_small_or_no_convolution_has_none():
    problem = small_problem(sensor=(95, 121))
    assert coarser(problem, jnp.zeros(problem.image_shape)) is None
    matrix = tc.imaging.operators.Matrix(jnp.asarray(RNG.random((9, 12))), (3, 4), (9,))
    plain = InverseProblem([matrix], [RNG.random((1, 9))])
    assert coarser(plain, jnp.zeros(plain.image_shape)) is None


@pytest.mark.thorough
@pytest.mark.parametrize("dark", [False, True])
def test_some_30_iterations_after_coarse_ones_do_what_1000_do(dark):
    """A zone aperture's capture in a bright field, and a random PSF's in the dark, at 30 dB.

    They end by a change of 1 % of the image. The objective is then up to 2 % above the lowest: a
    penalty of ADMM that suits the image leaves it noise of less than a hundredth.
    """
    picture = resize(skimage.img_as_float(skimage.data.camera()), (96, 112))
    if dark:
        pixels = RNG.random((24, 28)) < 0.3
        optics = tc.Psfs(np.kron(pixels, np.ones((4, 4)))[None] / 1000, field_shape=(191, 223))
        picture = np.pad(picture[16:80, 24:88], [(63, 64), (79, 80)])
    else:
        mask = tc.FresnelZoneAperture(13.0, width=4.2)
        camera = tc.LenslessCamera(mask, tc.Sensor((96, 112), 0.044), 7.5)
        optics = tc.Cameras([camera], wavelength=5e-4, object_distance=100.0)
    blank = tc.Recording(np.zeros((1, 96, 112)), optics, noise_variance=1.0)
    capture = np.asarray(blank.problem().operators[0](jnp.asarray(picture)[None, None]))
    capture = capture + capture.std() * 10**-1.5 * RNG.standard_normal(capture.shape)
    recording = tc.Recording(capture.reshape(1, 96, 112), optics)
    default, best = tc.AdmmTV(), tc.AdmmTV(iterations=1000, tolerance=1e-6)
    minimiser = tc.reconstruct(recording, best)
    lowest = min(p.objective for p in minimiser.history)
    result = tc.reconstruct(recording, default)
    assert result.status == "converged" and result.iterations <= 60
    assert min(p.objective for p in result.history) < 1.02 * lowest
    assert relative_l2(result.image, minimiser.image) < 0.015
    scores = [psnr(np.asarray(one.image), picture) for one in (result, minimiser)]
    assert scores[0] > scores[1] - 0.1  # dB
    # From an image that is given all pixels take their iterations, black as before.
    cold = jnp.full(result.image.shape, 0.0 if dark else 0.5)
    short = dataclasses.replace(default, iterations=30)
    begun = tc.reconstruct(recording, short, start=cold).history[-1].objective
    assert tc.reconstruct(recording, short).history[-1].objective - lowest < (begun - lowest) / 3


@pytest.mark.parametrize("exactly", [False, pytest.param(True, marks=pytest.mark.thorough)])
def test_smooth_misfit_does_not_end_the_iterations_at_the_coarse_image(exactly):
    """2 % of shading, a zone aperture's strong uniform light: the objective rises at first.

    The coarse image's is 0.7 % above the lowest, which a long run from any image finds.
    """
    picture = resize(skimage.img_as_float(skimage.data.camera()), (96, 98))
    camera = tc.LenslessCamera(
        tc.FresnelZoneAperture(25.0, width=5.6), tc.Sensor((192, 196), 0.029), 6.5
    )
    optics = tc.Cameras([camera], wavelength=5e-4, object_distance=250.0, field_shape=(96, 98))
    blank = tc.Recording(np.zeros((1, 192, 196)), optics, noise_variance=1.0)
    (light,) = np.asarray(blank.problem().operators[0](jnp.asarray(picture)[None, None]))
    y, x = np.meshgrid(np.linspace(-1, 1, 192), np.linspace(-1, 1, 196), indexing="ij")
    shading = 0.02 * (np.sin(1.7 * y + 0.3) + 0.7 * np.cos(2.9 * x - 1))
    noise = light.std() * 10**-1.5 * np.random.default_rng(0).standard_normal(light.shape)
    recording = tc.Recording([light * (1 + shading) + noise], optics)
    result = tc.reconstruct(recording, tc.AdmmTV())
    first, *objectives = [p.objective for p in result.history]
    assert result.status == "converged" and max(objectives) > first > 1.005 * min(objectives)
    if exactly:
        grey = jnp.full(result.image.shape, 0.5)
        exact = tc.reconstruct(recording, tc.AdmmTV(iterations=400, tolerance=1e-7), start=grey)
        assert min(objectives) < 1.001 * min(p.objective for p in exact.history)
    short = tc.reconstruct(recording, tc.AdmmTV(iterations=20))  # it rises at the last one
    assert short.status == "iterations_exhausted" and short.iterations == 20
