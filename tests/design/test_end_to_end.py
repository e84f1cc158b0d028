"""The end-to-end objective against dense linear algebra and against differences."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import thincam_jax as tc
from helpers import AS_IN_USE, count_traces
from thincam_jax._core.grids import Grid
from thincam_jax.design import DesignSpace, PhotonNoise, PowerLaw, Setup, SignalNoise, Variable
from thincam_jax.design.design import Design
from thincam_jax.design.end_to_end import end_to_end_error, restore
from thincam_jax.design.problem import DesignProblem
from thincam_jax.design.stochastic import stochastic_descent
from thincam_jax.design.training import ConjugateGradients, TrainedSensor, Training
from thincam_jax.lensless.exposures import Exposures
from thincam_jax.lensless.method import PIXEL_NODES
from thincam_jax.reconstruction.synthesis import phase_pairs

SENSOR, IMAGE = (20, 24), 14
PAIR = (0.0, 1.5 * np.pi)


def setup(noise=None):
    return Setup(
        pitch=0.08,
        sensor_width=1.92,
        object_distance=100.0,
        object_width=20.0,
        noise=noise or SignalNoise(30.0),
        prior=PowerLaw(2.5),
        contrast=0.4,
    )


def pictures(count=2):
    rng = np.random.default_rng(3)
    rough = rng.normal(size=(count, IMAGE, IMAGE)).cumsum(1).cumsum(2)
    return 1 + 0.5 * rough / np.abs(rough).max(axis=(1, 2), keepdims=True)


def training(noise=None, synthesis=None, **settings):
    return Training(
        pictures(),
        setup(noise),
        phase_pairs(2) if synthesis is None else synthesis,
        TrainedSensor(SENSOR, (4.0, 7.0)),
        key=jax.random.key(5),
        solver=ConjugateGradients(**({"tolerance": 1e-12, "steps": 600} | settings)),
    )


def design(beta=(9.0, 7.0), distance=(5.03, 6.41), wavelength=5e-4, width=1.83):
    pairs = [jnp.repeat(jnp.asarray(x), 2) for x in (beta, distance)]
    phases = jnp.asarray(PAIR * len(beta))
    return Design(Exposures(pairs[0], pairs[1], phase=phases, wavelength=wavelength, width=width))


counted_error = count_traces(end_to_end_error)
compiled_error = eqx.filter_jit(counted_error)


def dense(chosen, given):
    """Every linear map as a matrix, made one basis image at a time from `tc.psf` and sums.

    Pixel averages have the nodes of numbers that are traced, as designs are.
    """
    pitch = 1.92 / max(SENSOR)
    sensor = tc.Sensor(SENSOR, pitch)
    rows, columns = given.field_shape
    grid = Grid((SENSOR[0] + rows - 1, SENSOR[1] + columns - 1), jnp.asarray(pitch))
    maps = []
    for k in range(4):
        camera = tc.LenslessCamera(
            tc.FresnelZoneAperture(chosen.beta[k], PAIR[k % 2], width=chosen.width),
            sensor,
            chosen.distance[k],
        )
        kernel = tc.psf(
            camera.on_grid(grid),
            wavelength=chosen.wavelength[k],
            object_distance=100.0,
            model=tc.PsfMethod(nodes=PIXEL_NODES),
        )
        kernel = np.asarray(kernel)[::-1, ::-1] * pitch**2
        project = [
            _overlaps(n, pitch, 20.0 * float(chosen.distance[k]) / 100.0) for n in (rows, columns)
        ]
        matrix = np.empty((*SENSOR, IMAGE, IMAGE))
        for y in range(SENSOR[0]):
            for x in range(SENSOR[1]):
                y0, x0 = SENSOR[0] - 1 - y, SENSOR[1] - 1 - x
                seen = kernel[y0 : y0 + rows, x0 : x0 + columns]
                matrix[y, x] = project[0].T @ seen @ project[1]
        maps.append(matrix.reshape(-1, IMAGE**2))
    return maps


def _overlaps(cells, pitch, width):
    """Averages over cells of an image of IMAGE pixels that is `width` wide."""
    lower = (np.arange(cells) - cells / 2) * pitch
    edges = (np.arange(IMAGE + 1) / IMAGE - 0.5) * width
    low = np.maximum(lower[:, None], edges[:-1])
    high = np.minimum(lower[:, None] + pitch, edges[1:])
    return np.maximum(high - low, 0) / pitch


def prior_matrix():
    """Covariance of the prior, from its spectrum, by the two-dimensional transform's matrix."""
    step = 100.0 / 20.0
    k = np.fft.fftfreq(IMAGE) * IMAGE * step
    power = ((k[:, None] ** 2 + k**2) / step**2 + 1) ** -1.25
    power = 0.4**2 * power / power.mean()
    waves = np.fft.fft(np.eye(IMAGE), norm="ortho")
    both = np.kron(waves, waves)
    return np.real(both.conj().T @ np.diag(power.ravel()) @ both)


def smooth(image, sigma):
    """A denoiser: averages of three rows, the more the noisier; some pixels become negative."""
    rows = (jnp.roll(image, 1, -2) + image + jnp.roll(image, -1, -2)) / 3
    return image + sigma * (rows - image) - 0.3


def dense_plug_and_play(information, right, start, truth):
    brightness, found = (truth**3).sum() / (truth**2).sum(), start

    def step(image, s):
        matrix = information + np.eye(IMAGE**2) / s**2
        return np.linalg.solve(matrix, right + image.ravel() / s**2).reshape(IMAGE, IMAGE)

    for divisor in (6, 10, 15, 24):
        s = brightness / divisor
        found = np.maximum(smooth(step(found, s), s / 2), 0)
    return np.maximum(step(found, s / 4), 0)


@pytest.mark.thorough
@pytest.mark.parametrize("noise", [SignalNoise(25.0), PhotonNoise(3000.0, 5.0)])
def test_restored_are_the_best_linear_estimates(noise):
    given, chosen = training(noise), design()
    maps = dense(chosen, given)
    covariance = prior_matrix()
    found, steps = np.asarray(eqx.filter_jit(restore)(chosen, given)), []
    for image, drawn, restored in zip(given.images, given.noise, found, strict=True):
        flat = np.asarray(image).ravel()
        pairs = [maps[0] - maps[1], maps[2] - maps[3]]
        precision, right = np.linalg.inv(covariance), 0.0
        for c, pair in enumerate(pairs):
            clean = [m @ flat for m in maps[2 * c : 2 * c + 2]]
            variance = sum(float(noise.variance(g.mean(), g.var(), 1.0)) for g in clean)
            captured = pair @ flat + np.sqrt(variance) * np.asarray(drawn[c]).ravel()
            precision = precision + pair.T @ pair / variance
            right = right + pair.T @ captured / variance
        expected = np.linalg.solve(precision, right).reshape(IMAGE, IMAGE)
        np.testing.assert_allclose(restored, expected, rtol=0, atol=1e-7)
        information = precision - np.linalg.inv(covariance)
        steps.append(dense_plug_and_play(information, right, expected, np.asarray(image)))
    images = np.asarray(given.images)
    error = np.mean((found - images) ** 2, axis=(1, 2)) / np.var(images, axis=(1, 2))
    assert float(compiled_error(chosen, given)) == pytest.approx(error.mean(), rel=1e-9)
    denoised = eqx.filter_jit(restore)(chosen, given.with_denoiser(smooth))
    np.testing.assert_allclose(denoised, steps, rtol=0, atol=1e-7)


@pytest.mark.thorough
@pytest.mark.parametrize("denoiser", [None, smooth])
@pytest.mark.parametrize("noise", [SignalNoise(30.0), PhotonNoise(3000.0, 5.0)])
def test_gradient_through_the_solver_by_differences(noise, denoiser):
    given = training(noise) if denoiser is None else training(noise).with_denoiser(denoiser)
    place = jnp.array([9.0, 7.0, 5.03, 6.41, 5e-4, 1.83])

    @functools.partial(jax.jit, compiler_options=AS_IN_USE)
    @jax.value_and_grad
    def error_and_slope(x):
        return end_to_end_error(design(x[:2], x[2:4], x[4], x[5]), given)

    def error(x):
        return error_and_slope(x)[0]

    slope = error_and_slope(place)[1]
    for index, value in enumerate(place):
        # The projection averages over pixels whose borders pass each other: steps are short.
        step = jnp.zeros(6).at[index].set(3e-6 * value)
        difference = (error(place + step) - error(place - step)) / (6e-6 * value)
        assert float(slope[index] / difference) == pytest.approx(1, abs=1e-4)


@pytest.mark.thorough
def test_single_precision_reaches_a_tolerance_near_its_own():
    """The residual that conjugate gradients carry along says so before the true one does."""
    chosen, given = design(), training(SignalNoise(40.0), tolerance=2e-7)
    arrays, rest = eqx.partition((chosen, given), eqx.is_inexact_array)
    single = eqx.combine(jax.tree.map(lambda x: x.astype(jnp.float32), arrays), rest)
    with jax.enable_x64(False):
        error = end_to_end_error(*single)
    assert error.dtype == jnp.float32
    np.testing.assert_allclose(error, compiled_error(chosen, given), rtol=5e-3)


@pytest.mark.thorough
def test_few_steps_suffice_with_the_preconditioner():
    """30 steps, where bare conjugate gradients were 7 % off and had no gradient."""

    def error_and_slope(**solver):
        given = training(SignalNoise(30.0), **solver)
        error = jax.jit(jax.value_and_grad(lambda beta: end_to_end_error(design(beta), given)))
        return error(jnp.array([9.0, 7.0]))

    error, slope = error_and_slope(tolerance=1e-4, steps=30)
    exact, exact_slope = error_and_slope()
    np.testing.assert_allclose(error, exact, rtol=1e-3)
    np.testing.assert_allclose(slope, exact_slope, rtol=0.1)


def test_errors():
    with pytest.raises(ValueError, match="square ones"):
        Training(
            np.ones((1, 4, 5)),
            setup(),
            phase_pairs(1),
            TrainedSensor(SENSOR, (4.0, 7.0)),
            key=jax.random.key(0),
        )

    with pytest.raises(ValueError, match="rows of zeros"):
        training(synthesis=np.zeros((1, 4)))


def quadratic(chosen, target, key):
    """A bowl around a β of 10 and 14, shaken."""
    shaken = target + 0.3 * jax.random.normal(key, target.shape)
    return jnp.sum((chosen.beta[::2] - shaken) ** 2)


def free_betas():
    return DesignSpace(
        design(), (Variable("beta", 5.0, 20.0, (0, 1)), Variable("beta", 5.0, 20.0, (2, 3)))
    )


def test_a_stochastic_descent_step_by_step():
    """Adam as published, with the rate of a cosine; the mean of the second half, in the cube."""
    space, target, start = free_betas(), jnp.array([10.0, 14.0]), jnp.array([0.9, 0.3])
    key, rate, steps = jax.random.key(3), 0.1, 5
    found = stochastic_descent(
        DesignProblem(quadratic, space, target), start, key=key, steps=steps, rate=rate
    )
    y, first, second, path = np.arcsin(np.sqrt(start)), 0.0, 0.0, []
    for n, step_key in enumerate(jax.random.split(key, steps), 1):

        def loss(y, step_key=step_key):
            return quadratic(space.design(jnp.sin(y) ** 2), target, step_key)

        slope = np.asarray(jax.grad(loss)(jnp.asarray(y)))
        first, second = 0.9 * first + 0.1 * slope, 0.999 * second + 0.001 * slope**2
        step = (first / (1 - 0.9**n)) / (np.sqrt(second / (1 - 0.999**n)) + 1e-8)
        y = y - rate * 0.5 * (1 + np.cos(np.pi * (n - 1) / (steps - 1))) * step
        path.append(np.sin(y) ** 2)
    np.testing.assert_allclose(found.point, np.mean(path[2:], axis=0), rtol=1e-9)
    assert found.skipped == 0


def test_a_stochastic_descent_finds_the_mean():
    target = jnp.array([10.0, 14.0])
    found = stochastic_descent(
        DesignProblem(quadratic, free_betas(), target),
        jnp.array([0.9, 0.1]),
        key=jax.random.key(1),
        steps=400,
    )
    np.testing.assert_allclose(found.values, target, atol=0.3)
    assert found.skipped == 0 and found.history.shape == (400,)
    assert float(jnp.mean(found.history[-50:])) < 0.05 * float(found.history[0])
    np.testing.assert_allclose(found.design.beta, jnp.repeat(found.values, 2))


def sometimes_nothing(chosen, target, key):
    value = quadratic(chosen, target, key)
    return jnp.where(jax.random.bernoulli(key, 0.2), jnp.nan, value)


def test_steps_without_a_number_are_skipped_and_counted():
    target = jnp.array([10.0, 14.0])
    found = stochastic_descent(
        DesignProblem(sometimes_nothing, free_betas(), target),
        jnp.array([0.5, 0.5]),
        key=jax.random.key(1),
        steps=200,
    )
    assert found.skipped == int(jnp.sum(jnp.isnan(found.history))) > 10
    np.testing.assert_allclose(found.values, target, atol=0.4)
