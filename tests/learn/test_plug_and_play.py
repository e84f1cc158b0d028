"""Plug and play against dense algebra, and what a denoiser gains over its start."""

import math

import jax.numpy as jnp
import numpy as np
import pytest

import thincam_jax as tc
from helpers import quick, relative_l2
from thincam_jax.imaging.operators import CropConvolution, Matrix, Separable
from thincam_jax.imaging.targets import resize, sample_image
from thincam_jax.learn.plug_and_play import largest_noise
from thincam_jax.reconstruction.normal_equations import normal_equations
from thincam_jax.reconstruction.problem import back_projected
from thincam_jax.reconstruction.scaled_problem import ScaledProblem

FIELD, SENSOR = (12, 15), (14, 17)
SIGMA = 0.05


def smooth(image, sigma):
    """Linear: each pixel drawn halfway to its four neighbours, cyclic, whatever the noise."""
    around = sum(jnp.roll(image, s, a) for a in (-1, -2) for s in (-1, 1)) / 4
    return image / 2 + around / 2


def operator(seed: int = 0) -> Matrix:
    rng = np.random.default_rng(seed)
    modes = np.linalg.svd(rng.normal(size=(238, 180)), full_matrices=False)
    matrix = modes[0] * np.geomspace(3.0, 0.01, 180) @ modes[2]
    return Matrix(matrix, FIELD, SENSOR)


def scene(batch: int = 1):
    y, x = np.mgrid[: FIELD[0], : FIELD[1]] / 10
    return np.stack([0.5 + 0.4 * np.sin(3 * y + k) * (x > 0.6) for k in range(batch)])


def recording(batch: int = 1, noise: float = SIGMA, told: float = SIGMA) -> tc.Recording:
    A, rng = operator(), np.random.default_rng(3)
    captures = np.asarray(A(jnp.asarray(scene(batch))))
    captures = captures + noise * rng.normal(size=captures.shape)
    return tc.Recording(jnp.asarray(captures), A, noise_variance=told**2)


def test_a_denoiser_is_given_the_largest_noise_of_a_mode():
    """σ = s/2, the most that the dense inverse has of any mode; s falls to a 48th."""
    matrix, told = np.asarray(operator().matrix) / SIGMA, []

    def watched(image, sigma):
        told.append(float(jnp.ravel(sigma)[0]))
        return image

    tc.reconstruct(recording(), tc.PlugAndPlay(watched, iterations=3, tolerance=0.0))
    np.testing.assert_allclose(told[1] / np.array(told[1:]), [1, 48**0.5, 48], rtol=1e-6)
    unit = float(ScaledProblem(recording().problem(), iterations=4).image_unit)
    for sigma in unit * np.array(told[1:]):
        inverse = np.linalg.inv(matrix.T @ matrix + np.eye(180) / (2 * sigma) ** 2)
        noise = np.linalg.eigvalsh(inverse @ matrix.T @ matrix @ inverse)
        assert 0.8 * sigma < noise[-1] ** 0.5 <= sigma * (1 + 1e-9)


@pytest.mark.parametrize("shift", [0.003, 0.1])
def test_the_noise_of_convolutions_is_the_largest_of_a_ring_of_frequencies(shift):
    """Against the spectra of solutions for drawn noise: below s/2 behind a zone aperture."""
    y, x = np.indices((61, 65)) - np.array([30, 32])[:, None, None]
    psf = (1 + np.cos(0.05 * (y**2 + x**2))) * (np.hypot(y, x) < 28) / 2500
    shape, sensor = (90, 95), (146, 151)
    A = CropConvolution(jnp.asarray(psf), 1.0, sensor, shape)
    drawn = np.random.default_rng(1).normal(size=(8, 1, *sensor))
    problem = tc.Recording(jnp.asarray(drawn), A, noise_variance=1.0).problem()
    normal = normal_equations(problem, jnp.asarray(shift))
    image = normal.solve(back_projected(problem, problem.captures))
    radius = np.hypot(*np.meshgrid(*map(np.fft.fftfreq, shape), indexing="ij"))

    def rings(image):
        power = np.mean(np.abs(np.fft.fft2(image)) ** 2, axis=(0, 1, 2)) / math.prod(shape)
        return np.array([np.mean(power[np.floor(64 * radius) == k]) for k in range(32)])

    sigma = largest_noise(normal, normal.shift, jnp.ones(())).item()
    assert abs(sigma / max(rings(image)) ** 0.5 - 1) < 0.1
    assert sigma < 0.48 / shift**0.5
    least = largest_noise(normal, jnp.asarray(3.0), jnp.ones(()))
    np.testing.assert_allclose(least, 0.4 / 3**0.5)


def test_the_first_image_is_denoised_with_the_noise_that_was_found():
    """Told half of it, the first data step leaves twice the noise that it would say."""
    first = {}
    for told in (SIGMA, SIGMA / 2):

        def watched(image, sigma, told=told):
            first.setdefault(told, float(jnp.ravel(sigma)[0]))
            return image

        tc.reconstruct(recording(told=told), tc.PlugAndPlay(watched, iterations=1))
    assert abs(first[SIGMA / 2] / first[SIGMA] / 2 - 1) < 0.2


@pytest.mark.thorough
def test_captures_of_little_noise_are_solved_in_single_precision():
    """At 52 dB, most of a PSF beside the sensor: without a least shift the image exploded."""
    y, x = np.indices((63, 63)) - 31
    psf = np.float32((1 + np.cos(0.02 * (y**2 + x**2))) * (np.hypot(y, x) < 31))
    A = CropConvolution(jnp.asarray(psf / psf.sum()), 1.0, (32, 32), (32, 32))
    truth = np.float32(resize(sample_image("camera", linear=True), (32, 32)))
    capture = np.asarray(A(jnp.asarray(truth)))
    deviation = np.float32(capture.std() * 10 ** (-52 / 20))
    noise = deviation * np.random.default_rng(0).standard_normal(capture.shape, np.float32)
    seen = tc.Recording(capture + noise, A, noise_variance=float(deviation**2))
    image = tc.reconstruct(seen, tc.PlugAndPlay()).image
    assert relative_l2(image.reshape(truth.shape), truth) < 0.12


@pytest.mark.thorough
def test_with_a_linear_denoiser_it_ends_in_the_fixed_point_of_a_quadratic_problem():
    """f = D M⁻¹(Aᵀwg + μf), for the last s of a long run; then one data step with s/4."""
    found: list[tuple[float, np.ndarray]] = []

    def watched(image, sigma):
        smoothed = smooth(image, sigma)
        found.append((2 * float(jnp.ravel(sigma)[0]), smoothed))
        return smoothed

    seen, matrix = recording(), np.asarray(operator().matrix)
    solver = tc.PlugAndPlay(watched, nonnegative=False, iterations=300, tolerance=0.0)
    result = tc.reconstruct(seen, solver)
    assert result.status == "iterations_exhausted" and len(found) == 301
    pixels = np.eye(180).reshape(180, *FIELD)
    denoiser = np.asarray(smooth(jnp.asarray(pixels), 0.0)).reshape(180, 180).T
    unit = float(ScaledProblem(seen.problem(), iterations=4).image_unit)
    capture, s, image = np.ravel(seen.captures[0]), unit * found[-1][0], unit * found[-1][1]

    def step(s):
        """By the dense matrices, for the noise that was told."""
        system = matrix.T @ matrix + (SIGMA / s) ** 2 * np.eye(180)
        return np.linalg.solve(system, matrix.T @ capture + (SIGMA / s) ** 2 * np.ravel(image))

    assert relative_l2(denoiser @ step(s), np.ravel(image)) < 5e-3
    assert relative_l2(np.ravel(result.image), step(s / 4)) < 1e-3


@pytest.mark.parametrize("kind", quick(["dense", "separable"], 1))
def test_the_shipped_denoiser_beats_a_linear_estimate(kind):
    rng = np.random.default_rng(5)
    truth = np.zeros((32, 27))
    truth[5:20, 4:15], truth[12:28, 10:24] = 0.9, 0.5
    if kind == "dense":
        matrix = np.float32(rng.normal(size=(1000, truth.size)) / 30)
        A = Matrix(matrix, truth.shape, (40, 25))
    else:
        left, right = (np.float32(rng.normal(size=n) / 6) for n in ((40, 32), (36, 27)))
        A = Separable(left, right)
    capture = np.asarray(A(jnp.asarray(truth, jnp.float32)))
    capture = capture + 0.1 * rng.normal(size=capture.shape)
    seen = tc.Recording(jnp.asarray(capture, jnp.float32), A, noise_variance=0.01)
    found = tc.reconstruct(seen, tc.PlugAndPlay())
    linear = tc.reconstruct(seen, tc.Ridge())
    errors = [relative_l2(r.image, truth) for r in (found, linear)]
    assert errors[0] < 0.7 * errors[1] and float(found.image.min()) >= 0
    assert found.image.dtype == jnp.float32 and found.method == "pnp"
    assert found.status in ("converged", "iterations_exhausted")


def dark_field(noise: float):
    """A picture in a dark field larger than the sensor, and a capture, noise, and their camera."""
    rng, sensor, field = np.random.default_rng(2), (48, 52), (95, 103)
    y, x = np.indices((142, 154)) - np.array([70.5, 76.5])[:, None, None]
    psf = (1 + np.cos(0.04 * (y**2 + x**2))) * (abs(y) < 24) * (abs(x) < 26) / 600
    A = CropConvolution(jnp.asarray(psf, jnp.float32), 1.0, sensor, field)
    truth = np.zeros(field, np.float32)
    truth[32:64, 34:68] = resize(sample_image("camera", linear=True), (32, 34))
    capture = np.asarray(A(jnp.asarray(truth)))
    noise = noise * capture.std()
    return truth, capture + noise * rng.standard_normal(sensor, np.float32), noise, A


@pytest.mark.thorough
def test_a_dark_field_larger_than_the_sensor_begins_with_total_variation():
    """At 40 dB, in single precision, where data steps alone leave twice the error."""
    truth, noisy, noise, A = dark_field(0.01)
    seen = tc.Recording(noisy, A, noise_variance=noise**2)
    methods = tc.PlugAndPlay(), tc.AdmmTV(1.0, iterations=150)
    errors = [relative_l2(tc.reconstruct(seen, one).image, truth) for one in methods]
    assert errors[0] < 1.01 * errors[1]


@pytest.mark.thorough
@pytest.mark.parametrize("mistake", [0.5, 2.0])
def test_a_field_as_large_as_the_sensor_takes_a_wrong_noise(mistake):
    """Total variation, from which it begins, is made again with the noise that was found."""
    truth, noisy, noise, A = dark_field(0.1)
    images = [
        tc.reconstruct(tc.Recording(noisy, A, noise_variance=(m * noise) ** 2), tc.PlugAndPlay())
        for m in (1.0, mistake)
    ]
    errors = [relative_l2(result.image, truth) for result in images]
    assert errors[1] < 1.1 * errors[0]


def test_start_callback_and_status():
    seen, solver = recording(), tc.PlugAndPlay(smooth, iterations=5, tolerance=0.0)
    done = []
    stopped = tc.reconstruct(seen, solver, callback=lambda p: done.append(p) or p.iteration == 2)
    assert stopped.status == "stopped" and stopped.iterations == 2 == done[-1].iteration
    # Documents, bright all over, change little while s is large: that is no end.
    easy = tc.PlugAndPlay(smooth, iterations=5, tolerance=0.9)
    ended = tc.reconstruct(seen, easy, start=jnp.asarray(scene()))
    assert ended.status == "converged" and ended.iterations == 5
    # A dark start tells nothing: none of its steps are smaller for it.
    begun, alone = (tc.reconstruct(seen, solver, start=s) for s in (jnp.zeros((1, *FIELD)), None))
    np.testing.assert_array_equal(begun.image, alone.image)

    # What a denoiser takes from a bright capture is given back by further steps.
    def less(image, sigma):
        return image + jnp.minimum(sigma[..., None, None], 1) * (smooth(image, sigma) - image)

    solver = tc.PlugAndPlay(less, iterations=5)
    bright = tc.reconstruct(recording(noise=1e-4, told=1e-4), solver)
    misfits = [2 * progress.objective / 238 for progress in bright.history]
    assert 5 < bright.iterations < 10 and misfits[-1] < 10 < misfits[-2] < misfits[5]
    broken = tc.PlugAndPlay(lambda image, sigma: image * jnp.nan, iterations=3)
    result = tc.reconstruct(seen, broken)
    assert result.status == "non_finite" and bool(jnp.isfinite(result.image).all())
    dark = tc.Recording(jnp.zeros(SENSOR), operator(), noise_variance=SIGMA**2)
    assert float(jnp.abs(tc.reconstruct(dark, solver).image).max()) == 0


def test_light_beside_the_sensors_view_stays_in_the_image_that_it_begins_with():
    """Of the default field as of the same field that is given, whose image is not cut."""
    rng = np.random.default_rng(2)
    psf, scene = rng.random((1, 9, 11)) ** 4, rng.random((32, 42))
    A = CropConvolution(jnp.asarray(psf[0]), 1.0, (24, 32), scene.shape)
    capture = A(jnp.asarray(scene)[None])
    capture = capture + 1e-2 * jnp.std(capture) * jnp.asarray(rng.normal(size=capture.shape))
    shown, whole = (
        tc.reconstruct(
            tc.Recording(capture, tc.Psfs(psf, field_shape=field), background=0.0),
            tc.PlugAndPlay(smooth, iterations=2),
        ).image
        for field in (None, scene.shape)
    )
    np.testing.assert_allclose(shown, whole[4:-4, 5:-5], rtol=1e-5)
