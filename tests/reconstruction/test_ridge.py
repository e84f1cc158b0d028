"""Ridge regression: against dense solvers and the posterior mean, in float32, extremes."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.signal
from reconstruction import extremes, rig, scenes

import thincam_jax as tc
from helpers import quick, relative_l2
from thincam_jax.reconstruction import ridge as module
from thincam_jax.reconstruction.ridge import image_precision, solve_ridge

few = functools.partial(solve_ridge, precision=0.1)
SENSOR, PSF = (12, 13), (5, 4)
FIELD = (16, 16)
RNG = np.random.default_rng(4)


def dense(problem, precision, mean):
    """The image by normal equations, written out."""
    count = int(np.prod(problem.image_shape))
    pixels = jnp.eye(count).reshape(count, *problem.image_shape)
    left, right = precision * np.eye(count), precision * np.ravel(mean)
    for o, g, w in zip(problem.operators, problem.captures, problem.weights, strict=True):
        matrix = np.asarray(o(pixels)).reshape(count, -1).T
        weight = np.broadcast_to(w, g.shape).ravel()
        left += matrix.T @ (weight[:, None] * matrix)
        right += matrix.T @ (weight * np.ravel(g))
    return np.linalg.solve(left, right).reshape(problem.image_shape)


@pytest.mark.parametrize(
    "more", quick([{}, {"channels": 2, "planes": 2}], 1), ids=["grey", "planes"]
)
def test_it_is_the_dense_solution(more):
    problem, _ = scenes.problem((11, 9), (7, 8), **more)
    weights = tuple(
        jnp.asarray(np.random.default_rng(3).integers(0, 3, c.shape).astype(float))
        for c in problem.captures
    )
    problem = eqx.tree_at(lambda p: p.weights, problem, weights)
    for precision in (1e-3, 1.0):
        mean = jnp.asarray(np.random.default_rng(1).normal(size=problem.image_shape))
        found = solve_ridge(
            problem, precision=precision, mean=mean, tolerance=1e-9, iterations=5000
        )
        assert found.status == "converged"
        np.testing.assert_allclose(found.image, dense(problem, precision, mean), atol=1e-6)


@pytest.mark.thorough
def test_a_strong_ridge_gives_the_mean_and_a_weak_one_the_truth():
    problem, truth = scenes.problem((20, 21), (9, 8), noise=0.0, kernel=scenes.spots)
    mean = jnp.full(problem.image_shape, 0.25)
    np.testing.assert_allclose(few(problem, precision=1e8, mean=mean).image, 0.25, atol=1e-5)
    exact = few(problem, precision=1e-9, mean=mean, tolerance=1e-10, iterations=2000)
    assert relative_l2(exact.image, truth) < 1e-4


def test_too_few_iterations_have_a_status_and_yet_a_lower_objective():
    problem, _ = scenes.problem()
    outcome = few(problem, iterations=3)
    assert outcome.status == "iterations_exhausted" and outcome.iterations == 3
    assert outcome.history[-1].objective < 0.3 * outcome.history[0].objective


@pytest.mark.thorough
def test_float32_of_many_pixels_does_not_break_down():
    """lineax takes curvatures below 100·eps·(unknowns) for zero unless they are scaled."""
    problem, _ = scenes.problem((150, 160), (140, 131), captures=1)
    found = solve_ridge(scenes.single(problem), precision=10.0, tolerance=1e-4)
    assert found.status == "converged"
    double = solve_ridge(problem, precision=10.0, tolerance=1e-6)
    assert relative_l2(found.image, double.image) < 1e-2


@pytest.mark.thorough
def test_it_stands_extremes():
    extremes.check_darkness(few)
    extremes.check_scale(few)
    extremes.check_shapes(few)


def test_new_values_are_not_compiled_anew_and_wrong_ones_are_refused():
    problem, _ = scenes.problem()
    few(problem)
    before = module._solve._cache_size()
    few(scenes.rescaled(problem, 2.0), precision=0.3, tolerance=1e-3)
    assert module._solve._cache_size() == before
    rig.refused("precision = 0.0 .* is not positive", lambda: few(problem, precision=0.0))
    rig.refused("ridge = 0.0 .* is not positive", lambda: tc.Ridge(0.0))


def test_nan_has_a_status():
    problem, _ = scenes.problem()
    broken = (problem.captures[0].at[0, 0, 0].set(jnp.nan), problem.captures[1])
    broken = eqx.tree_at(lambda p: p.captures, problem, broken)
    outcome = few(broken, mean=jnp.zeros(problem.image_shape))
    assert outcome.status == "non_finite" and bool(jnp.isfinite(outcome.image).all())


def psf():
    return RNG.uniform(size=PSF)


def matrix_of(kernel):
    """H of the whole field, one column for each pixel, by scipy."""
    pixels = np.eye(FIELD[0] * FIELD[1]).reshape(-1, *FIELD)
    seen = [scipy.signal.convolve2d(p, kernel, mode="valid").ravel() for p in pixels]
    return np.stack(seen, axis=1)


def ridge(captures, kernel, weight=1.0, noise_variance=None):
    """Through the entry point, by measured PSFs, to many digits."""
    psfs = tc.Psfs(jnp.asarray(kernel)[None], field_shape=FIELD)
    recording = tc.Recording(jnp.asarray(captures), psfs, noise_variance=noise_variance)
    return tc.reconstruct(recording, tc.Ridge(weight, tolerance=1e-10, iterations=3000))


def posterior_mean(matrix, data, noise, mean, variance):
    """Of a Gaussian image given its captures: the conditional mean of their joint distribution."""
    joint = variance * matrix @ matrix.T + noise * np.eye(len(data))
    return mean + variance * matrix.T @ np.linalg.solve(joint, data - matrix @ mean)


@pytest.mark.parametrize("factor", [1.0, 3.0])
def test_ridge_is_the_posterior_mean(factor):
    """Of a white image that varies as much as it is bright; `ridge` divides its variance."""
    kernel, noise = psf(), 0.3
    matrix = matrix_of(kernel)
    truth = RNG.normal(2.0, 2.0, size=matrix.shape[1])
    data = matrix @ truth + RNG.normal(0, noise**0.5, size=len(matrix))
    flat = matrix.sum(axis=1)
    level = flat @ data / (flat @ flat)
    mean = np.full(matrix.shape[1], level)
    expected = posterior_mean(matrix, data, noise, mean, level**2 / factor)
    found = ridge(data.reshape(1, *SENSOR), kernel, factor, noise)
    assert found.status == "converged" and found.method == "ridge" and found.tau is None
    assert found.iterations > 0 and found.seconds > 0
    np.testing.assert_allclose(found.image, expected.reshape(FIELD), atol=1e-6)


@pytest.mark.thorough
def test_one_is_the_best_ridge_for_a_white_image():
    """The mean squared error of many, with less and with more; one is the default."""
    kernel = psf()
    matrix = matrix_of(kernel)
    truth = RNG.normal(1.0, 1.0, size=(30, matrix.shape[1]))
    data = truth @ matrix.T
    noise = data.var() / 30
    data += RNG.normal(0, noise**0.5, size=data.shape)

    def error(weight):
        found = ridge(data.reshape(1, 30, *SENSOR), kernel, weight, noise)
        return float(np.mean((np.asarray(found.image).reshape(truth.shape) - truth) ** 2))

    assert tc.Ridge().ridge == 1.0
    assert error(1.0) < 0.98 * error(0.2) and error(1.0) < 0.98 * error(5.0)


def test_ridge_has_no_units():
    """Captures and PSF in other units: the image in theirs, with the same ridge."""
    kernel = psf()
    data = (matrix_of(kernel) @ RNG.uniform(size=FIELD[0] * FIELD[1])).reshape(1, *SENSOR)
    data += 0.1 * RNG.normal(size=data.shape)
    plain = ridge(data, kernel, 0.5).image
    other = ridge(1e4 * data, 1e-3 * kernel, 0.5).image
    np.testing.assert_allclose(other, 1e7 * plain, rtol=1e-5)


def test_small_brightness_keeps_its_square():
    level = jnp.asarray([1e-25, 3e-25], jnp.float32)
    for wide in (True, False):
        with jax.enable_x64(wide):
            assert image_precision(level) == pytest.approx(1 / 5e-50, rel=1e-6)
    assert image_precision(jnp.zeros(3)) == 1.0


def test_ridge_of_a_difference_knows_the_brightness_of_the_captures():
    """In the sum the uniform light cancels; the image is upright and has its mean."""
    captures = rig.captures(rig.pair(), rig.picture())
    captures = captures + 1e-4 * captures.max() * jnp.asarray(RNG.normal(size=captures.shape))
    recording = tc.Recording(captures, rig.seen_by(rig.pair()))
    found = tc.reconstruct(recording, tc.Ridge(synthesis=np.array([[1.0, -1.0]])))
    assert rig.correlation(found.image, rig.picture()) > 0.95
    assert float(found.image.mean()) == pytest.approx(rig.picture().mean(), rel=0.1)
    assert float(found.pitch) == pytest.approx(rig.OBJECT_PITCH)


@pytest.mark.thorough
def test_extremes():
    """Darkness, nothing trusted, a NaN pixel; single precision stays."""
    extremes.check_recordings(tc.Ridge(iterations=30))
