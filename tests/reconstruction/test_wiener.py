"""The Wiener synthesis, and the spectra that it weighs."""

import math

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.signal
from reconstruction import rig

import thincam_jax as tc
from helpers import finite_difference, quick, relative_l2
from thincam_jax.imaging.operators.crop_convolution import kernel_grid
from thincam_jax.reconstruction import fringe_scanning, phase_pairs
from thincam_jax.reconstruction.imaging_model import register
from thincam_jax.reconstruction.synthesis import separate
from thincam_jax.reconstruction.wiener import (
    WienerSynthesis,
    crop_noise,
    inner_band,
    prior_spectrum,
    scene_power,
)
from thincam_jax.units import um

# Scenes of this size leave their whole shadow of a mask of 1.2 mm on the sensor.
SMALL = (30, 33)


def synthesis(cameras, matrix, prior="inverse_square", **settings):
    return WienerSynthesis(rig.imaging_model(cameras, **settings), synthesis=matrix, prior=prior)


def two_pairs(**settings):
    return rig.pair(beta=30.0, **settings) + rig.pair(beta=25.0, **settings)


def point(row=9, column=30):
    image = np.zeros(rig.FIELD)
    image[row, column] = 1.0
    return image, np.array([row - 19.5, column - 23.0]) * rig.OBJECT_PITCH


@pytest.mark.parametrize("prior", quick(["flat", "inverse_square"], 1))
def test_it_solves_the_normal_equations(prior):
    """A tiny case against a dense solver in real space: (ΣHᵀH/η + C⁻¹)f = ΣHᵀg/η, circular.

    Only the prior is made of frequencies here, by its definition.
    """
    sensor, field = (9, 8), (5, 6)
    own = tc.Sensor(sensor, 100 * um)
    cameras = [
        rig.camera(phase, beta=beta, width=0.7, sensor=own)
        for beta in (30.0, 25.0)
        for phase in (0.0, 1.5 * math.pi)
    ]
    variance = np.array([1e-6, 2e-6, 5e-6, 3e-6])
    method = synthesis(cameras, phase_pairs(2), field_shape=field, prior=prior)
    captures = 0.01 * np.random.default_rng(1).uniform(0.5, 1.5, (4, *sensor))
    value = method(jnp.asarray(captures), jnp.asarray(variance))

    grid = kernel_grid(own.grid, field)
    where = {"wavelength": rig.WAVELENGTH, "object_distance": rig.OBJECT_DISTANCE}
    wide = [camera.on_grid(grid) for camera in cameras]
    kernels = [
        0.01 * np.asarray(tc.psf(c, model="geometric", **where, pixel_integration=False))
        for c in wide
    ]
    uniform = np.stack([scipy.signal.convolve(k, np.ones(field), mode="valid") for k in kernels])
    mean = np.sum(captures * uniform) / np.sum(uniform**2)
    contrast = captures - mean * uniform

    shape = method.padded
    index = np.stack(np.meshgrid(*map(np.arange, shape), indexing="ij"), -1).reshape(-1, 2)

    def window(image):
        whole = np.zeros(shape)
        for (i, j), entry in np.ndenumerate(image):
            half = (np.array(image.shape) - 1) // 2
            whole[(i - half[0]) % shape[0], (j - half[1]) % shape[1]] = entry
        return whole

    def circulant(kernel):
        difference = (index[:, None] - index[None]) % np.array(shape)
        return kernel[difference[..., 0], difference[..., 1]]

    channels = [window(contrast[i] - contrast[i + 1]) for i in (0, 2)]
    operators = [window(kernels[i] - kernels[i + 1]) for i in (0, 2)]
    noise = [variance[i] + variance[i + 1] for i in (0, 2)]

    v, u = np.fft.fftfreq(shape[0], 0.1)[:, None], np.fft.fftfreq(shape[1], 0.1)
    power = np.ones(shape) if prior == "flat" else 1 / (u**2 + v**2 + 1 / (6 * 0.1) ** 2)
    power /= power.mean()
    # the scene's variance, fitted to the captures away from the axes
    half = np.s_[:, : shape[1] // 2 + 1]
    inner = ((np.abs(v) * 0.1 * 9 > 3) & (np.abs(u) * 0.1 * 8 > 3))[half]
    fitted, weights = 0.0, 0.0
    for channel, operator, eta in zip(channels, operators, noise, strict=True):
        measured = np.abs(np.fft.fft2(channel)) ** 2 / (9 * 8) - eta
        expected = np.abs(np.fft.fft2(operator)) ** 2 * power
        fitted += np.sum((measured * expected)[half][inner])
        weights += np.sum((expected**2)[half][inner])
    assert fitted > 0
    power *= fitted / weights

    matrix = circulant(np.real(np.fft.ifft2(1 / power)))
    right = np.zeros(len(index))
    for channel, operator, eta in zip(channels, operators, noise, strict=True):
        dense = circulant(operator)
        matrix = matrix + dense.T @ dense / eta
        right += dense.T @ channel.ravel() / eta
    solution = np.linalg.solve(matrix, right).reshape(shape)
    rows, columns = (np.arange(n) - (n - 1) // 2 for n in field)
    expected = solution[np.ix_(rows % shape[0], columns % shape[1])][::-1, ::-1] + mean
    assert np.ptp(expected) > 0.1 * mean
    assert relative_l2(value.image, expected) < 1e-9


def test_without_noise_the_scene_comes_back():
    image = rig.picture(SMALL)
    cameras = two_pairs(width=1.2)
    method = synthesis(cameras, phase_pairs(2), field_shape=SMALL)
    captures = rig.captures(cameras, image)
    errors = [relative_l2(method(captures, v).image, image) for v in (1e-5, 1e-7, 1e-9, 1e-14)]
    assert errors[0] > errors[1] > errors[2] > errors[3] and errors[3] < 1e-3


@pytest.mark.parametrize(
    ("groups", "prior"), quick([("near", "flat"), ("far", "inverse_square"), ("both", "flat")], 2)
)
def test_a_uniform_scene_is_itself(groups, prior):
    """Whatever the noise: the mean is estimated from the raw captures and put back."""
    near, far = rig.phases(), rig.phases(distance=1.3 * rig.DISTANCE)
    cameras = {"near": near, "far": far, "both": near + far}[groups]
    pitch = 25 * um * rig.OBJECT_DISTANCE / float(cameras[-1].distance)
    captures = rig.captures(cameras, np.full(rig.FIELD, 0.7), pitch=pitch)
    method = synthesis(cameras, fringe_scanning(len(cameras) // 4), prior=prior)
    for variance in (1e-6, 1.0):
        np.testing.assert_allclose(method(captures, variance).image, 0.7, rtol=2e-3)


def test_the_mean_is_unbiased(key):
    """64 draws of noise: their spread is σ/‖u‖, u the response to a uniform scene."""
    cameras = rig.pair()
    method = synthesis(cameras, phase_pairs(1))
    uniform = rig.captures(cameras, np.ones(rig.FIELD))
    sigma = 0.2 * float(uniform.mean())
    noise = sigma * jax.random.normal(key, (2, 64, *rig.SENSOR.shape))
    # a variance so large that nothing but the mean is left
    means = np.asarray(method(0.7 * uniform[:, None] + noise, 1e3).image[:, 0, 0])
    spread = sigma / float(jnp.linalg.norm(uniform))
    assert abs(means.mean() - 0.7) < 3 * spread / 8
    assert abs(means.std() / spread - 1) < 0.3


def test_more_captures_are_never_worse(key):
    """Expected error 1/(1/η_f + Σ|H|²/η): at every frequency, and measured on a white scene.

    The scene fills a part of the field only, so that its power, spread over the sensor's pixels, is
    that much smaller; all of the error that noise makes is then counted.
    """
    scene_variance, sigma, pixels = 0.04, 2e-4, 96 * 85
    image = np.sqrt(scene_variance) * np.random.default_rng(3).normal(size=SMALL)
    image -= image.mean()
    whole = np.zeros(rig.SENSOR.shape)
    whole[33:63, 26:59] = image
    cameras = two_pairs(width=1.2)
    captures = rig.captures(cameras, image)
    captures = captures + sigma * jax.random.normal(key, captures.shape)
    errors, predicted = [], []
    for count in (1, 2):
        method = synthesis(
            cameras[: 2 * count], phase_pairs(count), field_shape=rig.SENSOR.shape, prior="flat"
        )
        value = np.asarray(method(captures[: 2 * count], sigma**2).image)
        errors.append(np.sum((value - whole) ** 2) / pixels)
        gain = np.sum(np.abs(np.asarray(method.spectra)) ** 2, axis=0) / (2 * sigma**2)
        predicted.append(1 / (pixels / (scene_variance * image.size) + gain))
    assert (predicted[1] <= predicted[0]).all() and errors[1] < 0.9 * errors[0]
    for measured, expected in zip(errors, predicted, strict=True):
        # over all frequencies: those between the first and the last column count twice
        mean = np.average(expected, axis=1, weights=[1, *[2] * (expected.shape[1] - 1)]).mean()
        assert abs(measured / mean - 1) < 0.1


@pytest.mark.parametrize("groups", quick(["near", "far", "both"], 1))
def test_registration_puts_points_in_their_place(groups):
    """From captures at d, at 1.3 d, and from both: the same place on the object, off the axis."""
    image, expected = point()
    near, far = rig.phases(), rig.phases(distance=1.3 * rig.DISTANCE)
    cameras = {"near": near, "far": far, "both": near + far}[groups]
    method = synthesis(cameras, fringe_scanning(len(cameras) // 4))
    value = method(rig.captures(cameras, image), 1e-9)
    largest = float(cameras[-1].distance)
    assert float(value.pitch) == pytest.approx(25 * um * rig.OBJECT_DISTANCE / largest)
    np.testing.assert_allclose(rig.centroid(value), expected, atol=0.15 * rig.OBJECT_PITCH)


@pytest.mark.thorough
def test_noise_of_an_enlarged_capture(key):
    """Enlarging by r packs the noise of a channel into 1/r² of the band: the density is r²σ²."""
    ratio, variance = 1.3, 0.04
    cameras = rig.pair() + rig.pair(distance=ratio * rig.DISTANCE)
    method = synthesis(cameras, phase_pairs(2))
    noise = np.sqrt(2 * variance) * jax.random.normal(key, rig.SENSOR.shape)
    channels = [register(noise, ratio), noise]
    pads = [[(0, p - n) for p, n in zip(method.padded, c.shape, strict=True)] for c in channels]
    spectra = jnp.stack([jnp.fft.rfft2(jnp.pad(c, p)) for c, p in zip(channels, pads, strict=True)])
    density, _ = method._noise_and_scene(spectra, jnp.full(2, 2 * variance), noise.size)
    v, u = np.fft.fftfreq(method.padded[0])[:, None], np.fft.rfftfreq(method.padded[1])
    low = (np.abs(v) < 0.3) & (u < 0.3)  # cycles/pixel, within the enlarged band 0.5/1.3
    for channel, spectrum, expected in zip(channels, spectra, density, strict=True):
        measured = np.mean(np.abs(np.asarray(spectrum))[low] ** 2) / channel.size
        assert abs(float(expected[0, 0]) / measured - 1) < 0.1
    np.testing.assert_allclose(density[0] / density[1], ratio**2)


def test_batches_equal_one_by_one():
    """And each capture and image has its own noise variance."""
    cameras = two_pairs()
    method = synthesis(cameras, phase_pairs(2))
    images = np.stack([rig.picture(), 2 * rig.picture()[::-1]])
    captures = rig.captures(cameras, images)
    variance = 1e-8 * jnp.asarray([[1.0, 2.0], [3.0, 5.0], [2.0, 9.0], [1.0, 4.0]])
    whole = method(captures, variance).image
    assert whole.shape == (2, *rig.FIELD)
    for i in range(2):
        single = method(captures[:, i], variance[:, i]).image
        assert relative_l2(whole[i], single) < 1e-12
    assert relative_l2(method(captures[:, 1], variance[:, 0]).image, whole[1]) > 1e-4


def test_one_capture_alone_and_its_steps_at_the_border():
    """With the bias left in: upright, in place; coarser than what the synthesis gives."""
    image = rig.picture()
    cameras = rig.pair(width=1.2)
    captures = rig.captures(cameras, image)
    alone = synthesis(cameras[:1], separate(1))(captures[:1], 1e-8).image
    paired = synthesis(cameras, phase_pairs(1))(captures, 1e-8).image
    assert 0.8 < rig.correlation(alone, image) < rig.correlation(paired, image)


@pytest.mark.thorough
def test_gradient_in_beta_wavelength_and_variance():
    """The image in the β that is assumed; 2β(width/2)² = 60 rad is 2 rad per rad/mm² there."""
    sensor = tc.Sensor((24, 21), 100 * um)
    taken = rig.pair(sensor=sensor)
    captures = jnp.stack(
        [
            tc.capture(c, rig.scene(rig.picture((10, 11)), 4 * rig.OBJECT_PITCH), model="geometric")
            for c in taken
        ]
    )
    weights = np.random.default_rng(0).normal(size=(10, 11))

    def loss(numbers):
        cameras = [eqx.tree_at(lambda c: c.mask.beta, c, numbers["beta"]) for c in taken]
        method = synthesis(
            cameras,
            phase_pairs(1),
            field_shape=(10, 11),
            model="closed_form",
            wavelength=numbers["wavelength"],
        )
        return jnp.sum(weights * method(captures, 1e-9 * numbers["variance"]).image)

    at = {"beta": 30.0, "wavelength": 5e-4, "variance": 2.0}
    at = {name: jnp.asarray(value) for name, value in at.items()}
    both = jax.jit(jax.value_and_grad(loss))
    slopes = both(at)[1]
    for name, step in {"beta": 1e-3, "wavelength": 1e-7, "variance": 1e-2}.items():
        direction = {other: jnp.asarray(float(other == name)) for other in at}
        expected = finite_difference(lambda x: both(x)[0], at, direction, step)
        np.testing.assert_allclose(slopes[name], expected, rtol=1e-5, err_msg=name)


def test_what_is_refused():
    near, far = rig.pair(), rig.pair(distance=3.9)
    with pytest.raises(ValueError, match=r"synthesis has shape \(1, 3\); give \(channels, 2\)"):
        synthesis(near, np.ones((1, 3)))
    with pytest.raises(ValueError, match="row of zeros"):
        synthesis(near, np.array([[1.0, 0.0], [0.0, 0.0]]))
    with pytest.raises(ValueError, match="channels share noise.*orthogonal"):
        synthesis(near, np.array([[1.0, -1.0], [1.0, 0.0]]))
    with pytest.raises(ValueError, match="captures at different distances"):
        synthesis([near[0], far[1]], phase_pairs(1))
    other = rig.camera(sensor=tc.Sensor((96, 85), 24 * um))
    with pytest.raises(ValueError, match="different sensors.*use one sensor"):
        synthesis([near[0], other], separate(2))
    with pytest.raises(TypeError, match="distances are traced.*known numbers"):
        jax.jit(lambda d: synthesis(rig.pair(distance=d), phase_pairs(1)).spectra)(3.0)

    method = synthesis(near, phase_pairs(1))
    with pytest.raises(ValueError, match=r"captures have shape .*give \(2, …, 96, 85\)"):
        method(jnp.ones((2, 85, 96)), 1e-6)
    with pytest.raises(ValueError, match="noise_variance .* must be positive"):
        method(jnp.ones((2, 96, 85)), np.array([1e-6, 0.0]))


SHAPE, PITCH = (54, 60), 0.025


def test_the_prior_falls_with_the_square_of_the_frequency():
    """Along both axes of a grid that is not square; the corner is one cycle per field."""
    value = prior_spectrum("inverse_square", SHAPE, (20, 40), float)
    assert value.shape == (54, 31)
    for row, column in ((0, 0), (3, 0), (0, 3), (-20, 25)):
        v = np.fft.fftfreq(54, PITCH)[row]
        u = np.fft.rfftfreq(60, PITCH)[column]
        corner = 1 / (40 * PITCH)
        ratio = (v**2 + u**2 + corner**2) / corner**2
        assert value[row, column] == pytest.approx(value[0, 0] / ratio)


@pytest.mark.parametrize("prior", ["flat", "inverse_square"])
def test_the_prior_has_variance_one(prior):
    """The mean over all frequencies, the half that a real DFT leaves out counted too."""
    value = prior_spectrum(prior, SHAPE, (20, 40), float)
    doubled = value.sum() + value[:, 1:-1].sum()
    assert doubled / (54 * 60) == pytest.approx(1.0)


def test_scene_power_is_found_in_noise():
    rng = np.random.default_rng(0)
    expected = rng.uniform(0.0, 1.0, (2, 54, 31)) ** 2
    inner = inner_band(SHAPE, (40, 44))
    signal = 0.37 * expected * rng.exponential(size=expected.shape) + 0.01 * rng.normal(
        size=expected.shape
    )
    found = scene_power(jnp.asarray(signal), jnp.asarray(expected), inner)
    assert float(found) == pytest.approx(0.37, rel=0.08)
    # noise alone: next to nothing, but never negative
    assert 0 < float(scene_power(jnp.asarray(-signal), jnp.asarray(expected), inner)) < 1e-5


def test_steps_at_the_border_are_counted_as_noise():
    """What is found on one axis falls off like 1/(1 + f²) from it, f in cycles over the sensor."""
    sensor = (27, 20)
    v, u = np.abs(np.fft.fftfreq(54))[:, None] * 27, np.fft.rfftfreq(60)[None] * 20
    strength = np.random.default_rng(0).uniform(0.5, 1.0, (54, 31))
    on_v = np.where((u <= 1) & (v > 1), strength.mean(axis=1, keepdims=True), 0.0)
    on_u = np.where((v <= 1) & (u > 1), strength.mean(axis=0, keepdims=True), 0.0)
    expected_v = np.where(v > 1, strength.mean(axis=1, keepdims=True), 0.0) / (1 + u**2)
    expected_u = np.where(u > 1, strength.mean(axis=0, keepdims=True), 0.0) / (1 + v**2)
    for periodogram, expected in (
        (on_v, expected_v),
        (on_u, expected_u),
        (on_v + on_u, expected_v + expected_u),
    ):
        noise = crop_noise(jnp.asarray(periodogram)[None], SHAPE, sensor)[0]
        np.testing.assert_allclose(noise, expected, rtol=1e-12)


def test_phases_of_the_cameras_imply_the_synthesis():
    """Without one, a constant background is no longer kept by the captures of a quadrature pair."""
    cameras, image = rig.pair(beta=30.0), rig.picture()
    recording = tc.Recording(rig.captures(cameras, image), rig.imaging_model(cameras))
    found, kept = (
        rig.correlation(tc.reconstruct(recording, solver).image, image)
        for solver in (tc.Wiener(), tc.Wiener(synthesis=separate(2)))
    )
    assert found > 0.97 > kept
