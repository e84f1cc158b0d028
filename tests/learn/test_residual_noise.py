"""Noise of captures, found from what data steps leave, against noise that was drawn."""

import jax.numpy as jnp
import numpy as np
import pytest

import thincam_jax as tc
from thincam_jax.imaging.operators import CropConvolution, Matrix, Separable
from thincam_jax.imaging.targets import resize, sample_image
from thincam_jax.learn.residual_noise import detail_variances, residual_noise
from thincam_jax.reconstruction.normal_equations import normal_equations
from thincam_jax.reconstruction.problem import back_projected
from thincam_jax.reconstruction.scaled_problem import ScaledProblem

SIGMA = 0.05


def noise_of(seen: tc.Recording, shift: float):
    """What a data step from a dark image finds."""
    scaled = ScaledProblem(seen.problem())
    precision = scaled.curvature * scaled.image_unit**2
    normal = normal_equations(scaled.problem, jnp.asarray(shift, precision.dtype))
    found = normal.solve(back_projected(normal.problem, normal.problem.captures))
    return residual_noise(normal, found, normal.shift, precision)


@pytest.mark.parametrize("wrong", [0.5, 1.0, 2.0])
def test_noise_that_was_told_wrongly_is_found(wrong):
    rng = np.random.default_rng(3)
    modes = np.linalg.svd(rng.normal(size=(238, 180)), full_matrices=False)
    matrix = modes[0] * np.geomspace(3.0, 0.01, 180) @ modes[2]
    capture = matrix @ rng.random(180) + wrong * SIGMA * rng.normal(size=238)
    operator = Matrix(matrix, (12, 15), (14, 17))
    seen = tc.Recording(capture.reshape(14, 17), operator, noise_variance=SIGMA**2)
    assert abs(float(noise_of(seen, 1e-4).mistake) / wrong - 1) < 0.2


def zone_aperture(share: float = 1.0):
    y, x = np.indices((63, 71)) - np.array([31, 35])[:, None, None]
    psf = (1 + np.cos(0.04 * (y**2 + x**2))) * (np.hypot(y, x) < 31)
    return CropConvolution(jnp.asarray(share * psf / psf.sum()), 1.0, (130, 142), (64, 70))


def scene():
    picture = np.asarray(sample_image("coffee", linear=True), float)
    return resize(picture.mean(axis=-1) if picture.ndim == 3 else picture, (64, 70))


def light(A):
    return np.maximum(np.asarray(A(jnp.asarray(scene(), float))), 0)  # but for rounding


@pytest.mark.parametrize("background", [0.0, 0.2])
def test_noise_that_grows_with_the_light_is_found_for_each_pixel(background):
    """Of 100 electrons in the mean pixel, with that of a background which was subtracted."""
    A = zone_aperture()
    clean = light(A)
    variance = (clean + background * clean.mean()) * clean.mean() / 100
    capture = clean + np.sqrt(variance) * np.random.default_rng(7).normal(size=clean.shape)
    seen = tc.Recording(capture, A, noise_variance=float(variance.mean()))
    noise = noise_of(seen, 1e-3)
    assert noise.grows
    (found,) = np.asarray(noise.variances[0])
    expected = (clean + background * clean.mean()) / ((1 + background) * clean.mean())
    bright = expected > 0.3
    np.testing.assert_allclose(found[bright].mean(), expected[bright].mean(), rtol=0.05)
    assert np.std(found[bright] / expected[bright]) < 0.1
    assert found.min() >= 0.1 - 1e-12


def focused():
    """A lens' PSF, a few pixels wide: an image explains its captures, their noise included."""
    y, x = np.indices((63, 71)) - np.array([31, 35])[:, None, None]
    psf = np.exp(-(y**2 + x**2) / 0.5)
    return CropConvolution(jnp.asarray(psf / psf.sum()), 1.0, (64, 70), (64, 70))


def lit(texture=0.0):
    """Four squares of light in a dim room, blurred; `texture` differs from pixel to pixel."""
    y, x = np.indices((64, 70))
    room = 0.05 + 0.3 * (y // 16 % 2) * (x // 18 % 2) + 0.002 * (x + y)
    return room * (1 + texture * np.random.default_rng(6).normal(size=room.shape))


@pytest.mark.parametrize("black", [0.0, 0.5])
def test_behind_a_lens_the_noise_is_found_from_the_captures_detail(black):
    """Above a black level that was left in, too."""
    A = focused()
    clean = np.asarray(A(jnp.asarray(lit(), float)))
    variance = clean * clean.mean() / 2000
    capture = clean + np.sqrt(variance) * np.random.default_rng(7).normal(size=clean.shape)
    seen = tc.Recording(capture, A, noise_variance=float(variance.mean()))
    noise = noise_of(seen, 1e-3)
    assert not noise.tells and not noise.grows
    raised = tc.Recording(capture + black * capture.mean(), A)
    (found,) = np.asarray(detail_variances(raised.problem())[0])
    expected = np.maximum(clean / clean.mean(), 0.1)
    assert abs(np.mean(found / expected) - 1) < 0.1
    assert np.std(found / expected) < 0.2


@pytest.mark.parametrize("texture, noise", [(0.0, 1e-3), (0.3, 1e-4)])
def test_even_noise_and_fine_texture_are_not_taken_for_that_of_light(texture, noise):
    A = focused()
    clean = np.asarray(A(jnp.asarray(lit(texture), float)))
    capture = clean + noise * np.random.default_rng(7).normal(size=clean.shape)
    assert detail_variances(tc.Recording(capture, A).problem()) == ()


def test_behind_a_lens_photon_noise_does_not_stay_in_bright_parts():
    """It stayed where the noise was taken for even: twice the strength gained 0.8 dB."""
    A = focused()
    clean = np.asarray(A(jnp.asarray(lit(), float)))
    electrons = clean * 100 / clean.mean()
    capture = np.random.default_rng(8).poisson(electrons) / electrons.mean() * clean.mean()

    def error(strength):
        image = tc.reconstruct(tc.Recording(capture, A), tc.PlugAndPlay(strength=strength)).image
        return 10 * np.log10(np.mean((np.asarray(image).reshape(clean.shape) - lit()) ** 2))

    assert error(1.0) < error(2.0) - 0.5


def test_a_capture_of_more_light_keeps_its_own_noise():
    """Given for each capture, the noise of the brighter one is not taken for more than that."""
    one, bright = zone_aperture(), zone_aperture(3.0)
    captures, given = [], []
    for seed, A in enumerate((one, bright)):
        variance = light(A) * light(one).mean() / 100
        drawn = np.random.default_rng(seed).normal(size=variance.shape)
        captures.append(light(A) + np.sqrt(variance) * drawn)
        given.append(float(variance.mean()))
    noise = noise_of(tc.Recording(captures, [one, bright], noise_variance=given), 1e-3)
    assert noise.grows
    for found in noise.variances:
        np.testing.assert_allclose(float(found.mean()), 1, atol=0.1)


@pytest.mark.thorough
def test_in_the_light_of_a_hundred_electrons_it_beats_total_variation_by_a_decibel():
    """At its best τ of 0.5, 1, 2, 4. With one variance for all pixels it gains 0.4 dB."""
    A, truth = zone_aperture(), scene()
    electrons = light(A) * 100 / light(A).mean()
    capture = np.random.default_rng(8).poisson(electrons) / electrons.mean() * light(A).mean()
    seen = tc.Recording(capture, A)

    def error(solver):
        image = np.asarray(tc.reconstruct(seen, solver).image).reshape(truth.shape)
        return 10 * np.log10(np.mean((image - truth) ** 2))

    assert error(tc.PlugAndPlay()) < error(tc.AdmmTV(1.0, iterations=100)) - 1


def test_the_noise_is_that_of_the_noisiest_part():
    """Shot noise is three times as strong in the middle; the mean would say 1.4."""
    rng = np.random.default_rng(4)
    A = Separable(*(rng.normal(size=n) / 8 for n in ((144, 24), (156, 26))))
    deviation = np.full((144, 156), SIGMA)
    deviation[48:96, 52:104] *= 3
    noise = deviation * rng.normal(size=deviation.shape)
    capture = np.asarray(A(jnp.asarray(rng.random((24, 26))))) + noise
    noise = noise_of(tc.Recording(jnp.asarray(capture), A, noise_variance=SIGMA**2), 1e-3)
    assert abs(float(noise.mistake) / 3 - 1) < 0.1
    assert not noise.grows


@pytest.mark.thorough
def test_the_noise_of_enlarged_captures_is_found():
    """Captures of two distances, one of them interpolated; all frequencies would say 0.8."""
    rng, sensor = np.random.default_rng(5), tc.Sensor((64, 72), 0.04)
    mask = tc.FresnelZoneAperture(40.0, width=1.4)
    cameras = [tc.LenslessCamera(mask, sensor, d) for d in (4.0, 6.5)]
    model = tc.Cameras(cameras, wavelength=5e-4, object_distance=200.0, field_shape=(24, 28))
    noise = rng.normal(size=(2, *sensor.shape))
    seen = tc.Recording(list(SIGMA * noise), model, noise_variance=SIGMA**2)
    assert 0.97 < float(noise_of(seen, 0.1).mistake) < 1.1
