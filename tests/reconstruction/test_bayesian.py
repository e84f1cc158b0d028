"""Ridge and Poisson through the entry point: what their weights mean, against other formulas."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.signal
from reconstruction import rig, scenes

import thincam_jax as tc
from helpers import relative_l2
from thincam_jax.reconstruction import TotalVariation, psf_problem
from thincam_jax.reconstruction.bayesian import absolute_ridge, counts_problem
from thincam_jax.reconstruction.build import absolute_tau
from thincam_jax.reconstruction.regularised import middle

SENSOR, PSF = (12, 13), (5, 4)
FIELD = (16, 16)
RNG = np.random.default_rng(4)


def psf():
    return RNG.uniform(size=PSF)


def dense(kernel):
    """H of the whole field, one column for each pixel, by scipy."""
    pixels = np.eye(FIELD[0] * FIELD[1]).reshape(-1, *FIELD)
    seen = [scipy.signal.convolve2d(p, kernel, mode="valid").ravel() for p in pixels]
    return np.stack(seen, axis=1)


def ridge(captures, kernel, **settings):
    settings = {"tolerance": 1e-10, "iterations": 3000, "field_shape": FIELD} | settings
    return tc.reconstruct(
        jnp.asarray(captures), jnp.asarray(kernel)[None], method="ridge", **settings
    )


def posterior_mean(matrix, data, noise, mean, variance):
    """Of a Gaussian image given its captures: the conditional mean of their joint distribution."""
    joint = variance * matrix @ matrix.T + noise * np.eye(len(data))
    return mean + variance * matrix.T @ np.linalg.solve(joint, data - matrix @ mean)


@pytest.mark.parametrize("factor", [1.0, 3.0])
def test_ridge_is_the_posterior_mean(factor):
    """Of a white image that varies as much as it is bright; `ridge` divides its variance."""
    kernel, noise = psf(), 0.3
    matrix = dense(kernel)
    truth = RNG.normal(2.0, 2.0, size=matrix.shape[1])
    data = matrix @ truth + RNG.normal(0, noise**0.5, size=len(matrix))
    flat = matrix.sum(axis=1)
    level = flat @ data / (flat @ flat)
    mean = np.full(matrix.shape[1], level)
    expected = posterior_mean(matrix, data, noise, mean, level**2 / factor)
    found = ridge(data.reshape(1, *SENSOR), kernel, noise_variance=noise, ridge=factor)
    assert found.status == "converged" and found.method == "ridge" and found.tau is None
    assert found.iterations > 0 and found.seconds > 0
    np.testing.assert_allclose(found.image, expected.reshape(FIELD), atol=1e-6)


def test_one_is_the_best_ridge_for_a_white_image():
    """The mean squared error of many, with less and with more; one is the default."""
    kernel = psf()
    matrix = dense(kernel)
    truth = RNG.normal(1.0, 1.0, size=(30, matrix.shape[1]))
    data = truth @ matrix.T
    noise = data.var() / 30
    data += RNG.normal(0, noise**0.5, size=data.shape)

    def error(**weight):
        found = ridge(data.reshape(1, 30, *SENSOR), kernel, noise_variance=noise, **weight)
        return float(np.mean((np.asarray(found.image).reshape(truth.shape) - truth) ** 2))

    default = error()
    assert default == error(ridge=1.0)
    assert default < 0.98 * error(ridge=0.2) and default < 0.98 * error(ridge=5.0)


def test_ridge_has_no_units():
    """Captures and PSF in other units: the image in theirs, with the same ridge."""
    kernel = psf()
    data = (dense(kernel) @ RNG.uniform(size=FIELD[0] * FIELD[1])).reshape(1, *SENSOR)
    data += 0.1 * RNG.normal(size=data.shape)
    plain = ridge(data, kernel, ridge=0.5).image
    other = ridge(1e4 * data, 1e-3 * kernel, ridge=0.5).image
    np.testing.assert_allclose(other, 1e7 * plain, rtol=1e-5)


def test_small_brightness_keeps_its_square():
    level = jnp.asarray([1e-25, 3e-25], jnp.float32)
    for wide in (True, False):
        with jax.enable_x64(wide):
            assert float(absolute_ridge(2.0, level)) == pytest.approx(2.0 / 5e-50, rel=1e-6)
    assert float(absolute_ridge(2.0, jnp.zeros(3))) == 2.0


def test_ridge_of_a_difference_knows_the_brightness_of_the_captures():
    """In the sum the even light cancels; the image is upright and has its mean."""
    captures = rig.captures(rig.pair(), rig.picture())
    captures = captures + 1e-4 * captures.max() * jnp.asarray(RNG.normal(size=captures.shape))
    found = tc.reconstruct(
        captures,
        rig.pair(),
        method="ridge",
        object_distance=rig.OBJECT_DISTANCE,
        wavelength=rig.WAVELENGTH,
        field_shape=rig.FIELD,
        synthesis=np.array([[1.0, -1.0]]),
        model="geometric",
        pixel_integration=False,
    )
    assert rig.correlation(found.image, rig.picture()) > 0.95
    assert float(found.image.mean()) == pytest.approx(rig.picture().mean(), rel=0.1)
    assert float(found.pitch) == pytest.approx(rig.OBJECT_PITCH)


@pytest.mark.parametrize("method", ["ridge", "poisson"])
def test_extremes(method):
    """Darkness, nothing trusted, a pixel that is no number; single precision stays."""
    kernel = jnp.asarray(psf())[None]
    bright = jnp.asarray(RNG.poisson(20.0, size=(1, *SENSOR)).astype(float))
    everywhere = jnp.ones(bright.shape, bool)
    for captures, valid in ((0 * bright, everywhere), (bright, ~everywhere), (bright, everywhere)):
        found = tc.reconstruct(captures, kernel, method=method, iterations=30, valid=valid)
        assert found.status in ("converged", "iterations_exhausted")
        assert found.image.shape == SENSOR and bool(jnp.isfinite(found.image).all())
    single = bright.astype(jnp.float32)
    found = tc.reconstruct(single, kernel.astype(jnp.float32), method=method, iterations=5)
    assert found.image.dtype == jnp.float32
    broken = bright.at[0, 3, 4].set(jnp.nan)
    assert tc.reconstruct(broken, kernel, method=method, iterations=30).status == "non_finite"
    masked = tc.reconstruct(
        broken, kernel, method=method, iterations=30, valid=jnp.isfinite(broken)
    )
    assert masked.status in ("converged", "iterations_exhausted")


def counts(mean, background=0.0):
    """Counts of blocks of moderate contrast on a bright ground, the kernel, and the scene."""
    kernel = scenes.spots((9, 8))
    kernel /= kernel.sum()
    truth = 1 + 0.3 * scenes.blocks((38, 41))
    light = scipy.signal.convolve2d(truth, kernel, mode="valid")
    gain = mean / light.mean()
    seen = np.random.default_rng(8).poisson(gain * light + background)
    return jnp.asarray(seen.astype(float))[None], jnp.asarray(kernel)[None], gain * truth


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("mean", "gap"), [pytest.param(400.0, 4e-3, marks=pytest.mark.thorough), (1e4, 2e-3)]
)
def test_poisson_of_many_counts_is_total_variation_of_gaussian_noise(mean, gap):
    """With the variance of the mean count: near to each other, and farther with another τ."""
    background = mean / 5
    captures, kernel, truth = counts(mean, background)
    field = {"field_shape": truth.shape}
    likely = tc.reconstruct(
        captures, kernel, method="poisson", background=[background], tau=2.0, **field
    )
    assert likely.tau == 2.0 and likely.method == "poisson" and likely.status == "converged"
    gaps = {}
    for tau in (1.4, 2.0, 2.8):
        squares = tc.reconstruct(
            captures - background,
            kernel,
            method="admm_tv",
            tau=tau,
            noise_variance=float(captures.mean()),
            iterations=600,
            tolerance=1e-5,
            **field,
        )
        seen = (middle(jnp.asarray(r.image), captures.shape[-2:]) for r in (likely, squares))
        gaps[tau] = relative_l2(*seen)
    assert gaps[2.0] < gap
    assert gaps[2.0] < 0.75 * min(gaps[1.4], gaps[2.8])


def test_the_tau_of_counts_is_that_of_their_mean():
    """Over the pixels that are trusted; their weights are 1."""
    captures, kernel, _ = counts(50.0)
    captures = captures.at[0, 0, 0].set(1e9)
    valid = jnp.ones(captures.shape, bool).at[0, 0, 0].set(False)
    problem = psf_problem(captures, kernel, valid=valid, noise_variance=7.0)
    made = counts_problem(problem, 1.5)
    mean = captures[0].ravel()[1:].mean()
    expected = absolute_tau(1.5, problem.operators, [mean])
    assert float(made.tau) == pytest.approx(float(expected))
    np.testing.assert_array_equal(made.weights[0], valid[0])


def test_poisson_of_few_counts():
    """Three a pixel: never negative, with its background as a frame; goes on from a start."""
    captures, kernel, truth = counts(3.0, background=1.0)
    settings = {"field_shape": truth.shape, "variation": TotalVariation()}
    frame = jnp.ones_like(captures)
    likely = tc.reconstruct(captures, kernel, method="poisson", background=frame, **settings)
    assert float(likely.image.min()) >= 0
    assert likely.status in ("converged", "iterations_exhausted")
    assert relative_l2(likely.image, truth) < 0.15
    again = tc.reconstruct(
        captures, kernel, method="poisson", background=1.0, start=likely.image, **settings
    )
    assert again.history[0].objective < likely.history[0].objective
    with pytest.raises(ValueError, match="negative counts"):
        tc.reconstruct(captures - 50.0, kernel, method="poisson", **settings)


def test_counts_at_two_distances_are_refused():
    cameras = [rig.camera(), rig.camera(distance=2.5)]
    with pytest.raises(ValueError, match="needs all cameras at one distance"):
        tc.reconstruct(
            jnp.ones((2, *rig.SENSOR.shape)),
            cameras,
            method="poisson",
            object_distance=rig.OBJECT_DISTANCE,
            wavelength=rig.WAVELENGTH,
        )


def test_poisson_with_cameras_is_upright():
    """From a start given upright, too: that of the result is left after a step or two."""
    cameras = rig.pair()
    clean = rig.captures(cameras, rig.picture())
    gain = 300.0 / float(clean.mean())
    seen = jnp.asarray(np.random.default_rng(5).poisson(gain * clean).astype(float))
    where = {
        "object_distance": rig.OBJECT_DISTANCE,
        "wavelength": rig.WAVELENGTH,
        "field_shape": rig.FIELD,
        "model": "geometric",
        "pixel_integration": False,
        "method": "poisson",
    }
    found = tc.reconstruct(seen, cameras, **where)
    assert rig.correlation(found.image, rig.picture()) > 0.97
    assert float(found.image.mean()) == pytest.approx(gain * rig.picture().mean(), rel=0.05)
    assert float(found.pitch) == pytest.approx(rig.OBJECT_PITCH)
    again = tc.reconstruct(seen, cameras, start=found.image, iterations=1, **where)
    turned = tc.reconstruct(seen, cameras, start=found.image[::-1, ::-1], iterations=1, **where)
    lowest = found.history[-1].objective
    assert again.history[0].objective == pytest.approx(lowest, rel=1e-3)
    # Most of the lowest one is the noise: half a unit for each of the pixels.
    assert turned.history[0].objective > 1.2 * lowest
