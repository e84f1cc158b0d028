"""Ridge regression against dense matrices; its closed form and rules for separable cameras."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.signal
from reconstruction import extremes, scenes

import thincam_jax as tc
from helpers import finite_difference, quick, relative_l2
from thincam_jax.imaging.operators import CropConvolution, Matrix, Separable
from thincam_jax.reconstruction.normal_equations import IterativeNormal, normal_equations
from thincam_jax.reconstruction.problem import InverseProblem, misfit
from thincam_jax.reconstruction.ridge import choose_precision, ridge_by_modes, solve_ridge

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


def ill_conditioned(snr, captures=2, shape=(13, 17), seed=0):
    """A recording of random PSFs, which leave much of the field all but unseen."""
    rng = np.random.default_rng(seed)
    psfs = rng.random((captures, 9, 9)) / 20
    scene = scenes.blocks(shape, seed)
    clean = np.stack([scipy.signal.fftconvolve(scene, one, "same") for one in psfs])
    deviation = clean.std() * 10 ** (-snr / 20)
    seen = clean + deviation * rng.standard_normal(clean.shape)
    return tc.Recording(seen, tc.Psfs(psfs), noise_variance=deviation**2, background=0.0)


def as_precise(problem, dtype):
    """The problem in another precision."""
    numbers = {"f": dtype, "c": np.result_type(dtype, np.complex64)}
    return jax.tree.map(
        lambda a: a.astype(numbers[a.dtype.kind]) if a.dtype.kind in numbers else a, problem
    )


CONDITIONS = [(40, 2, 0.01), (40, 2, 1.0), (30, 1, 0.01), (20, 3, 0.1)]


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize(("snr", "captures", "strength"), quick(CONDITIONS, 0))
def test_the_tolerance_is_the_distance_from_the_minimiser(snr, captures, strength, dtype):
    """Down to 1/μ = 8e6, where residuals of 1e-4 had left an error of 97 %, said to converge."""
    solver = tc.Ridge(strength)
    _, problem, mean, _, precision = solver._posed(ill_conditioned(snr, captures))
    exact = dense(problem, precision, np.broadcast_to(mean, problem.image_shape))
    found = solve_ridge(
        as_precise(problem, dtype),
        precision=precision,
        mean=mean.astype(dtype),
        iterations=solver.iterations,
        tolerance=solver.tolerance,
    )
    assert found.status == "converged" and found.image.dtype == dtype
    away = np.linalg.norm(exact - np.asarray(mean))
    assert np.linalg.norm(np.asarray(found.image, float) - exact) < 2 * solver.tolerance * away
    assert found.history[-1].primal < solver.tolerance


def test_what_was_not_reached_is_said_and_its_advice_helps():
    recording = ill_conditioned(40)
    found = tc.reconstruct(recording, tc.Ridge(0.01, iterations=100))
    assert found.status == "iterations_exhausted" and found.history[-1].primal > 1e-3
    assert "of it, after 100 iterations: give more, a larger ridge, or double" in found.reason
    for better in (tc.Ridge(0.01), tc.Ridge(10.0, iterations=100)):
        settled = tc.reconstruct(recording, better)
        assert settled.status == "converged" and not settled.reason


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


@pytest.mark.parametrize("iterations", [3, 5000])
def test_objectives_are_those_of_the_images(iterations):
    """They follow from the right-hand side, for iterates before convergence, too."""
    problem, _ = scenes.problem()
    mean = jnp.asarray(np.random.default_rng(1).normal(size=problem.image_shape))
    found = few(problem, mean=mean, iterations=iterations, tolerance=1e-10)
    for image, progress in zip((mean, found.image), found.history, strict=True):
        direct = misfit(problem, image).sum() + 0.05 * jnp.sum((image - mean) ** 2)
        assert progress.objective == pytest.approx(float(direct), rel=1e-6)


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
    known = {"noise_variance": noise_variance, "background": 0.0}
    recording = tc.Recording(jnp.asarray(captures), psfs, **known)
    return tc.reconstruct(recording, tc.Ridge(weight, tolerance=1e-10, iterations=3000))


def posterior_mean(matrix, data, noise, mean, variance):
    """Of a Gaussian image given its captures: the conditional mean of their joint distribution."""
    joint = variance * matrix @ matrix.T + noise * np.eye(len(data))
    return mean + variance * matrix.T @ np.linalg.solve(joint, data - matrix @ mean)


@pytest.mark.parametrize("factor", quick([1.0, 3.0], 1))
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
    assert found.iterations > 0 and found.seconds > 0 and tc.Ridge().ridge == 1.0
    np.testing.assert_allclose(found.image, expected.reshape(FIELD), atol=1e-6)


@pytest.mark.thorough
def test_extremes():
    """Darkness, nothing trusted, a NaN pixel; single precision stays."""
    extremes.check_recordings(tc.Ridge(iterations=30))


FLAT_SENSOR, FLAT_FIELD = (26, 30), (12, 15)
CHANCE = np.random.default_rng(8)


@functools.cache
def flatcam(terms=1, dtype=np.float64, sensor=FLAT_SENSOR, field=FLAT_FIELD):
    """Shadows of binary codes, each weaker than the one before; its modes are kept."""

    def shadows(size, scene, seed):
        codes = np.random.default_rng(seed).integers(0, 2, (terms, size + scene)) / size**0.5
        codes = codes * 0.2 ** (0.5 * np.arange(terms)[:, None])
        return codes[:, np.arange(size)[:, None] - np.arange(scene) + scene].astype(dtype)

    return Separable(shadows(sensor[0], field[0], 1), shadows(sensor[1], field[1], 2)).with_modes()


def dense_camera(operator):
    pixels = jnp.eye(int(np.prod(FLAT_FIELD))).reshape(-1, *FLAT_FIELD)
    return np.asarray(operator(pixels)).reshape(len(pixels), -1).T


def captured(operator, noise=0.02, batch=(), seed=3):
    """Blocks through the camera."""
    truth = np.broadcast_to(scenes.blocks(FLAT_FIELD, seed=seed), (*batch, *FLAT_FIELD))
    clean = operator(jnp.asarray(truth))
    return clean + noise * np.random.default_rng(seed).normal(size=clean.shape), truth


def solved(matrix, captures, precision):
    """(AᵀA + ρ)⁻¹ Aᵀg."""
    normal = matrix.T @ matrix + precision * np.eye(matrix.shape[1])
    flat = np.asarray(captures).reshape(-1, matrix.shape[0])
    return np.linalg.solve(normal, matrix.T @ flat.T).T.reshape(-1, *FLAT_FIELD)


def test_ridge_by_modes_is_the_dense_solution():
    """Of channels, in either precision, mapped and differentiated."""
    operator, captures = flatcam(), captured(flatcam(), batch=(3,))[0]
    found = ridge_by_modes(operator.modes, captures, jnp.asarray(0.01))
    np.testing.assert_allclose(found, solved(dense_camera(operator), captures, 0.01), atol=1e-10)
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


def test_float32_keeps_its_digits_under_bright_light():
    """The uniform light is subtracted from captures; subtracted from modes it costs a digit."""
    chance = np.random.default_rng(5)
    sizes = zip((150, 180), FLAT_FIELD, strict=True)
    left, right = (chance.integers(0, 2, size).astype(float) for size in sizes)
    truth = 1 + 0.01 * chance.uniform(-1, 1, FLAT_FIELD)
    seen, images = left @ truth @ right.T, {}
    for dtype in (np.float32, np.float64):
        camera = Separable(left.astype(dtype), right.astype(dtype)).with_modes()
        # The same numbers for both: the captures' own rounding is none of the solver's.
        given = seen.astype(np.float32).astype(dtype)
        recording = tc.Recording(given, camera, noise_variance=1e-4, background=0.0)
        images[dtype] = np.asarray(tc.reconstruct(recording, tc.Ridge(1.0)).image, np.float64)
    error = np.abs(images[np.float32] - images[np.float64]).max()
    assert error < 4e-5 * truth.std(), error / truth.std()


@pytest.mark.parametrize("terms", quick([1, 3], 0))
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
    return Matrix(dense_camera(operator), FLAT_FIELD, FLAT_SENSOR)


@pytest.mark.thorough
def test_the_modes_of_all_terms_precondition_conjugate_gradients():
    """Also those of one term with weights of each pixel, as of dead ones."""
    right = jnp.asarray(CHANCE.normal(size=(1, 1, *FLAT_FIELD)))
    dead = jnp.ones(FLAT_SENSOR).at[3, 4].set(0.0)
    for operator, weights in ((flatcam(3), jnp.ones((1, 1))), (flatcam(), dead)):
        problem = InverseProblem(operator, [jnp.zeros((1, *FLAT_SENSOR))], weights=[weights])
        normal = normal_equations(problem, jnp.asarray(0.01))
        plain = IterativeNormal(problem, jnp.asarray(0.01))
        assert isinstance(normal, IterativeNormal)
        start = jnp.zeros_like(right)
        quick, slow = (n.solution(right, start, 1e-8, 500) for n in (normal, plain))
        assert relative_l2(normal.applied(quick.value), right) < 1e-6
        assert 3 * int(quick.stats["num_steps"]) < int(slow.stats["num_steps"])
        seen = (operator(right[:, 0]),)
        few, many = (n.least_squares(seen, 1e-6, 500)[3] for n in (normal, plain))
        assert 3 * few < many


def test_planes_are_preconditioned_together():
    """Two planes behind one capture; each by itself takes more than 500 steps."""
    y, x = np.indices((65, 73)) - np.array([32, 36])[:, None, None]
    zones = [
        (1 + np.cos(beta * (y**2 + x**2))) * (np.maximum(abs(y), abs(x)) < 9)
        for beta in (0.12, 0.2)
    ]
    kernels = jnp.asarray(np.stack(zones)[None] / 30)
    camera = CropConvolution(kernels, 1.0, (38, 42), (28, 32), summed=1)
    problem = InverseProblem([camera], [jnp.zeros((1, 38, 42))])
    normal = normal_equations(problem, jnp.asarray(1e-2))
    right = jnp.asarray(np.random.default_rng(4).normal(size=(1, 2, 28, 32)))
    assert isinstance(normal, IterativeNormal)
    found = normal.solution(right, jnp.zeros_like(right), 1e-8, 500)
    assert relative_l2(normal.applied(found.value), right) < 1e-6
    assert int(found.stats["num_steps"]) < 200


@pytest.mark.parametrize("rule", quick(["gcv", "sure", "likelihood"], 0))
def test_rules_find_the_least_of_their_criterion(rule):
    """By A(AᵀA + ρ)⁻¹Aᵀ = A V (Λ + ρ)⁻¹VᵀAᵀ; the image of gcv and sure is nearly the best."""
    operator, noise = flatcam(), 0.02
    captures, truth = captured(operator, noise)
    problem = InverseProblem(operator, [captures[None]], weights=[1 / noise**2])
    mean = jnp.full(problem.image_shape, 0.3)
    matrix = dense_camera(operator) / noise
    data = np.ravel(captures) / noise - matrix @ np.full(matrix.shape[1], 0.3)
    count, (powers, v) = data.size, np.linalg.eigh(matrix.T @ matrix)
    seen = v.T @ (matrix.T @ data)

    def value(rho):
        if rule == "likelihood":  # dᵀ(1 + AAᵀ/ρ)⁻¹d + log det(1 + AAᵀ/ρ)
            return data @ data - np.sum(seen**2 / (powers + rho) - np.log1p(powers / rho))
        kept = powers / (powers + rho)
        residual = data @ data - np.sum(seen**2 / (powers + rho) * (2 - kept))
        if rule == "gcv":
            return count * residual / (count - kept.sum()) ** 2
        return residual - count + 2 * kept.sum()

    found = float(choose_precision(problem, mean, rule)[0])
    tried = np.geomspace(1e-2, 1e4, 400)
    assert value(found) <= min(map(value, tried)) * (1 + 1e-6)
    images = (0.3 + v @ (seen / (powers + rho)) for rho in tried[::10])
    best = min(np.sum((image.reshape(truth.shape) - truth) ** 2) for image in images)
    image = tc.reconstruct(
        tc.Recording(captures, operator, noise_variance=noise**2), tc.Ridge(rule)
    ).image
    assert rule == "likelihood" or float(jnp.sum((image - truth) ** 2)) < 1.15 * best


def with_level(operator, captures, background):
    """Matrix, captures and brightness of the image; a background to find is one more unknown."""
    matrix, data = dense_camera(operator), np.ravel(captures)
    flat = matrix.sum(axis=1)
    if background is None:
        uneven = flat - flat.mean()
        level = min(uneven @ data / (uneven @ uneven), flat @ data / (flat @ flat))
        return np.c_[matrix, np.ones(len(matrix))], data, level
    return matrix, data, flat @ data / (flat @ flat)


def inverse_of(matrix, inverse_prior):
    """Of the normal equations; a background has no prior."""
    more = matrix.shape[1] - len(inverse_prior)
    return np.linalg.inv(matrix.T @ matrix / 4e-4 + np.pad(inverse_prior, (0, more)))


@pytest.mark.parametrize("background", [0.0, None])
def test_error_bars_are_the_diagonal_of_the_dense_inverse(background):
    """Of the separable, the dense_camera and the reduced camera."""
    operator = flatcam()
    captures, _ = captured(operator)
    given = {"noise_variance": 4e-4, "background": background}
    recording = tc.Recording(captures, operator, **given)
    sigma = tc.Ridge(0.5).deviation(recording)
    matrix, _, level = with_level(operator, captures, background)
    covariance = inverse_of(matrix, 0.5 / level**2 * np.eye(180))
    np.testing.assert_allclose(sigma.ravel(), np.sqrt(np.diag(covariance))[:180], rtol=1e-8)
    other = tc.Recording(captures, whole(operator), **given)
    np.testing.assert_allclose(tc.Ridge(0.5).deviation(other), sigma, rtol=1e-8)


@pytest.mark.parametrize("background", [0.0, None])
@pytest.mark.parametrize("terms", [1, pytest.param(2, marks=pytest.mark.thorough)])
def test_a_correlated_image(terms, background):
    """Against the posterior of a Gaussian image with that covariance, written out."""
    operator = flatcam(terms)
    captures, _ = captured(operator)
    near = [np.exp(-np.abs(np.subtract.outer(np.arange(n), np.arange(n))) / 3) for n in FLAT_FIELD]
    matrix, data, level = with_level(operator, captures, background)
    posterior = inverse_of(matrix, np.linalg.inv(level**2 * np.kron(*near)))
    mean = np.full(matrix.shape[1], level)
    mean[180:] = 0
    mean += posterior @ matrix.T @ (data - matrix @ mean) / 4e-4
    recording = tc.Recording(captures, operator, noise_variance=4e-4, background=background)
    solver = tc.Ridge(correlation=3.0, tolerance=1e-9)
    found = tc.reconstruct(recording, solver).image.ravel()
    np.testing.assert_allclose(found, mean[:180], atol=1e-6)
    if terms == 1:
        sigma = solver.deviation(recording)
        np.testing.assert_allclose(sigma.ravel(), np.sqrt(np.diag(posterior))[:180], rtol=1e-8)


@pytest.mark.parametrize("rule", quick(["gcv", "sure", "likelihood"], 0))
def test_rules_find_the_background_with_the_image(rule):
    """Of the image and a level without a prior, solved for together, which is several times it."""
    operator, noise = flatcam(), 0.02
    captures, _ = captured(operator, noise)
    captures = captures + 3 * np.mean(captures)
    given = {"weights": [1 / noise**2], "background": "unknown"}
    problem = InverseProblem(operator, [captures[None]], **given)
    matrix = np.c_[dense_camera(operator), np.ones(captures.size)] / noise
    data, count = np.ravel(captures) / noise, captures.size
    powers = np.linalg.eigvalsh(matrix[:, :-1].T @ matrix[:, :-1])

    def value(rho):
        prior = np.diag([rho] * 180 + [0])
        found = np.linalg.solve(matrix.T @ matrix + prior, matrix.T @ data)
        left, freedom = np.sum((data - matrix @ found) ** 2), np.sum(powers / (powers + rho))
        if rule == "likelihood":
            return left + found @ prior @ found + np.sum(np.log1p(powers / rho))
        return count * left / (count - freedom) ** 2 if rule == "gcv" else left + 2 * freedom

    found = float(choose_precision(problem, jnp.zeros(problem.image_shape), rule)[0])
    assert value(found) <= min(map(value, np.geomspace(1e-2, 1e4, 200))) + 1e-6 * abs(value(found))


@pytest.mark.parametrize("dead", quick([3, 9], 0))
def test_few_dead_pixels_change_rules_and_error_bars_little(dead):
    """Deviations by 5 % at most, the image by less than half of them; they read nonsense."""
    operator = flatcam()
    captures, _ = captured(operator)
    valid = np.ones(FLAT_SENSOR, bool)
    valid.flat[CHANCE.choice(valid.size, dead, replace=False)] = False
    given, solver = {"noise_variance": 4e-4}, tc.Ridge("sure")
    whole = tc.Recording(captures, operator, **given)
    masked = tc.Recording(np.where(valid, captures, 1e4), operator, valid=valid, **given)
    sigmas = [np.asarray(solver.deviation(one)) for one in (masked, whole)]
    np.testing.assert_allclose(*sigmas, rtol=0.05)
    images = [np.asarray(tc.reconstruct(one, solver).image) for one in (masked, whole)]
    assert np.std(images[0] - images[1]) < 0.5 * np.mean(sigmas[1])
