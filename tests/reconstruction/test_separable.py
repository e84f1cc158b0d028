"""FlatCam: closed forms in the modes against dense matrices, error bars, sums of several terms."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from reconstruction import scenes

import thincam_jax as tc
from helpers import finite_difference, relative_l2
from thincam_jax.imaging.operators import Matrix, Separable
from thincam_jax.imaging.targets.images import resize, sample_image
from thincam_jax.reconstruction.normal_equations import IterativeNormal, normal_equations
from thincam_jax.reconstruction.problem import InverseProblem
from thincam_jax.reconstruction.separable import choose_precision, ridge_by_modes

SENSOR, FIELD = (26, 30), (12, 15)
RNG = np.random.default_rng(8)


@functools.cache
def flatcam(terms=1, dtype=np.float64, sensor=SENSOR, field=FIELD):
    """Shadows of binary codes, each weaker than the one before; its modes are kept."""

    def shadows(size, scene, seed):
        codes = np.random.default_rng(seed).integers(0, 2, (terms, size + scene)) / size**0.5
        codes = codes * 0.2 ** (0.5 * np.arange(terms)[:, None])
        return codes[:, np.arange(size)[:, None] - np.arange(scene) + scene].astype(dtype)

    return Separable(shadows(sensor[0], field[0], 1), shadows(sensor[1], field[1], 2)).with_modes()


def dense(operator):
    pixels = jnp.eye(int(np.prod(FIELD))).reshape(-1, *FIELD)
    return np.asarray(operator(pixels)).reshape(len(pixels), -1).T


def captured(operator, noise=0.02, batch=(), seed=3):
    """Blocks through the camera."""
    truth = np.broadcast_to(scenes.blocks(FIELD, seed=seed), (*batch, *FIELD))
    clean = operator(jnp.asarray(truth))
    return clean + noise * np.random.default_rng(seed).normal(size=clean.shape), truth


def solved(matrix, captures, precision):
    """(AᵀA + ρ)⁻¹ Aᵀg."""
    normal = matrix.T @ matrix + precision * np.eye(matrix.shape[1])
    flat = np.asarray(captures).reshape(-1, matrix.shape[0])
    return np.linalg.solve(normal, matrix.T @ flat.T).T.reshape(-1, *FIELD)


def test_ridge_by_modes_is_the_dense_solution():
    """Of channels, in either precision, mapped and differentiated."""
    operator, captures = flatcam(), captured(flatcam(), batch=(3,))[0]
    found = ridge_by_modes(operator.modes, captures, jnp.asarray(0.01))
    np.testing.assert_allclose(found, solved(dense(operator), captures, 0.01), atol=1e-10)
    single = flatcam(dtype=np.float32).modes
    near = ridge_by_modes(single, captures.astype(jnp.float32), jnp.float32(0.01))
    assert near.dtype == jnp.float32 and relative_l2(near, found) < 1e-5
    each = jax.vmap(ridge_by_modes, (None, 0, 0))(
        operator.modes, captures, jnp.array([0.01, 0.1, 1.0])
    )
    np.testing.assert_allclose(each[0], found[0], atol=1e-12)

    def length(precision):
        return jnp.sum(ridge_by_modes(operator.modes, captures, precision) ** 2)

    at = jnp.asarray(0.01)
    change = finite_difference(length, at, jnp.asarray(1.0), 1e-4)
    assert float(jax.grad(length)(at)) == pytest.approx(float(change), rel=1e-6)


@pytest.mark.parametrize("terms", [1, pytest.param(3, marks=pytest.mark.thorough)])
def test_ridge_takes_the_modes_that_are_kept(terms):
    """The same image as without, and as of the whole matrix."""
    operator = flatcam(terms)
    captures, _ = captured(operator)
    images = [
        tc.reconstruct(tc.Recording(captures, o, noise_variance=4e-4), tc.Ridge(tolerance=1e-9))
        for o in (operator, Separable(operator.left, operator.right), whole(operator))
    ]
    for image in images:
        assert image.status == "converged"
        np.testing.assert_allclose(image.image, images[-1].image, atol=1e-6)


def whole(operator):
    return Matrix(dense(operator), FIELD, SENSOR)


@pytest.mark.thorough
def test_the_modes_of_all_terms_precondition_conjugate_gradients():
    """Also those of one term with weights of each pixel, as of dead ones."""
    right = jnp.asarray(RNG.normal(size=(1, 1, *FIELD)))
    dead = jnp.ones(SENSOR).at[3, 4].set(0.0)
    for operator, weights in ((flatcam(3), jnp.ones((1, 1))), (flatcam(), dead)):
        problem = InverseProblem(operator, [jnp.zeros((1, *SENSOR))], weights=[weights])
        normal = normal_equations(problem, jnp.asarray(0.01))
        plain = IterativeNormal(problem, jnp.asarray(0.01))
        assert isinstance(normal, IterativeNormal)
        start = jnp.zeros_like(right)
        quick, slow = (n.solution(right, start, 1e-8, 500) for n in (normal, plain))
        assert relative_l2(normal.applied(quick.value), right) < 1e-6
        assert 3 * int(quick.stats["num_steps"]) < int(slow.stats["num_steps"])


@pytest.mark.parametrize("rule", ["gcv", pytest.param("sure", marks=pytest.mark.thorough)])
def test_rules_find_the_least_of_their_criterion(rule):
    """By the influence matrix A(AᵀA + ρ)⁻¹Aᵀ itself; the image is nearly the best of all."""
    operator, noise = flatcam(), 0.02
    captures, truth = captured(operator, noise)
    problem = InverseProblem(operator, [captures[None]], weights=[1 / noise**2])
    mean = jnp.full(problem.image_shape, 0.3)
    matrix = dense(operator) / noise
    data = np.ravel(captures) / noise - matrix @ np.full(matrix.shape[1], 0.3)
    count, (u, s, _) = data.size, np.linalg.svd(matrix, full_matrices=False)

    def value(rho):
        kept = s**2 / (s**2 + rho)
        residual = np.sum((data - u @ (kept * (u.T @ data))) ** 2)
        if rule == "gcv":
            return count * residual / (count - kept.sum()) ** 2
        return residual - count + 2 * kept.sum()

    found = float(choose_precision(problem, mean, rule)[0])
    tried = np.geomspace(1e-2, 1e4, 400)
    assert value(found) <= min(map(value, tried)) * (1 + 1e-6)
    best = min(np.sum((0.3 + solved(matrix, data, rho) - truth) ** 2) for rho in tried[::10])
    image = tc.reconstruct(
        tc.Recording(captures, operator, noise_variance=noise**2), tc.Ridge(rule)
    ).image
    assert float(jnp.sum((image - truth) ** 2)) < 1.15 * best


def test_error_bars_are_the_diagonal_of_the_dense_inverse():
    """Of the separable, the dense and the reduced camera."""
    operator = flatcam()
    captures, _ = captured(operator)
    recording = tc.Recording(captures, operator, noise_variance=4e-4)
    sigma = tc.Ridge(0.5).deviation(recording)
    matrix = dense(operator)
    flat = matrix.sum(axis=1)
    level = flat @ np.ravel(captures) / (flat @ flat)
    covariance = np.linalg.inv(matrix.T @ matrix / 4e-4 + 0.5 / level**2 * np.eye(180))
    np.testing.assert_allclose(sigma.ravel(), np.sqrt(np.diag(covariance)), rtol=1e-8)
    other = tc.Recording(captures, whole(operator), noise_variance=4e-4)
    np.testing.assert_allclose(tc.Ridge(0.5).deviation(other), sigma, rtol=1e-8)


@pytest.mark.parametrize("terms", [1, pytest.param(2, marks=pytest.mark.thorough)])
def test_a_correlated_image(terms):
    """Against the posterior of a Gaussian image with that covariance, written out."""
    operator = flatcam(terms)
    captures, _ = captured(operator)
    near = [np.exp(-np.abs(np.subtract.outer(np.arange(n), np.arange(n))) / 3) for n in FIELD]
    matrix = dense(operator)
    flat = matrix.sum(axis=1)
    level = flat @ np.ravel(captures) / (flat @ flat)
    prior = level**2 * np.kron(*near)
    posterior = np.linalg.inv(matrix.T @ matrix / 4e-4 + np.linalg.inv(prior))
    mean = level + posterior @ matrix.T @ (np.ravel(captures) - level * flat) / 4e-4
    recording = tc.Recording(captures, operator, noise_variance=4e-4)
    solver = tc.Ridge(correlation=3.0, tolerance=1e-9)
    np.testing.assert_allclose(tc.reconstruct(recording, solver).image.ravel(), mean, atol=1e-6)
    if terms == 1:
        sigma = solver.deviation(recording)
        np.testing.assert_allclose(sigma.ravel(), np.sqrt(np.diag(posterior)), rtol=1e-8)


@pytest.mark.thorough
@pytest.mark.parametrize("count", [80, 200])
def test_error_bars_cover_the_truth(count):
    """95 % intervals hold 93 to 97 % of the pixels of a photograph, over draws of the noise.

    A white prior takes its errors for larger, and makes larger ones.
    """
    sensor, field = (80, 90), (40, 50)
    operator, noise = flatcam(sensor=sensor, field=field), 0.1
    truth = resize(sample_image("camera")[60:300, 150:450], field)
    draws = np.random.default_rng(1).normal(size=(count, *sensor))
    captures = operator(jnp.asarray(truth)) + noise * jnp.asarray(draws)
    recording = tc.Recording(captures, operator, noise_variance=noise**2)
    covered, errors = [], []
    for correlation in ((0.5, 1, 2, 4, 8, 16), 0.0):
        solver = tc.Ridge("sure", correlation=correlation)
        gap = np.abs(tc.reconstruct(recording, solver).image - truth)
        covered.append(np.mean(gap < 1.96 * solver.deviation(recording)))
        errors.append(np.mean(gap**2))
    assert 0.93 < covered[0] < 0.97 and covered[1] > covered[0] and errors[0] < 0.7 * errors[1]


@pytest.mark.thorough
def test_total_variation_of_several_terms():
    """The same image as with the whole matrix."""
    operator = flatcam(3)
    captures, _ = captured(operator)
    solver = tc.AdmmTV(iterations=200, tolerance=1e-5)
    images = [
        tc.reconstruct(tc.Recording(captures, o, noise_variance=4e-4), solver).image
        for o in (operator, whole(operator))
    ]
    assert relative_l2(*images) < 1e-3


@pytest.mark.thorough
def test_what_has_no_closed_form_is_refused():
    several = flatcam(3)
    captures, _ = captured(several)
    recording = tc.Recording(captures, several, noise_variance=4e-4)
    with pytest.raises(ValueError, match="'gcv' needs the modes of one separable term"):
        tc.reconstruct(recording, tc.Ridge("gcv"))
    with pytest.raises(ValueError, match="closed form for dense matrices"):
        tc.Ridge().deviation(recording)
    with pytest.raises(ValueError, match="modes of several terms"):
        ridge_by_modes(several.modes, captures, jnp.asarray(1.0))
    with pytest.raises(ValueError, match="ridge = 'gvc'"):
        tc.Ridge("gvc")
    with pytest.raises(ValueError, match="give one length, or several and ridge="):
        tc.Ridge(correlation=(1, 2))
    dense_one = tc.Recording(captures, whole(several), noise_variance=4e-4)
    with pytest.raises(ValueError, match="correlation = 2 needs one separable camera"):
        tc.reconstruct(dense_one, tc.Ridge(correlation=2))
