"""The splitting for operators of any structure: each of its steps against dense systems."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.sparse
from reconstruction import dense, scenes

from helpers import relative_l2
from thincam_jax.imaging.operators import CropConvolution, Matrix, Separable, Sparse, kernel_shape
from thincam_jax.reconstruction.admm import AdmmMethod, splitting_of
from thincam_jax.reconstruction.direct_splitting import DirectSplitting
from thincam_jax.reconstruction.drive import drive
from thincam_jax.reconstruction.problem import InverseProblem, gradient, uniform_image
from thincam_jax.reconstruction.splitting import Penalties, admm_map, consensus
from thincam_jax.reconstruction.total_variation import TotalVariation

FIELD = (4, 5)
RNG = np.random.default_rng(6)


def convolution(sensor, window=None):
    kernel = RNG.uniform(size=kernel_shape(sensor, FIELD)) ** 4
    return CropConvolution(jnp.asarray(kernel), 0.5, sensor, FIELD, window=window)


OPERATORS = {
    "dense": [Matrix(RNG.normal(size=(2 * 30, 2 * 20)), (2, *FIELD), (2, 30))],
    "separable": [Separable(RNG.normal(size=(6, 4)), RNG.normal(size=(3, 5)))],
    "sparse": [Sparse(scipy.sparse.random(25, 20, 0.3, random_state=3), FIELD, (25,))],
    # Windows that differ, so that no transform makes both diagonal.
    "windows": [convolution((6, 7), (12, 15)), convolution((5, 9), (16, 16))],
}


def posed(name, **settings):
    """Captures (batch, channel, …) of noise, with weights of each pixel but for the separable."""
    operators, captures, weights = OPERATORS[name], [], []
    for operator in operators:
        shape = operator.out_shape
        captures.append(jnp.asarray(RNG.uniform(0.5, 1.5, (3, 1, *shape))))
        weights.append(2.0 if name == "separable" else RNG.uniform(0.5, 2.0, shape))
    settings = {"regulariser": TotalVariation(depth_weight=0.6)} | settings
    return InverseProblem(operators, captures, weights=weights, **settings)


def with_penalties(problem, data=0.3, variation=0.7, image=0.2):
    splitting = splitting_of(problem)
    assert isinstance(splitting, DirectSplitting)
    values = (jnp.asarray(p, problem.tau.dtype) for p in (data, variation, image))
    return splitting.with_penalties(Penalties(*values))


def noise_like(state):
    return jax.tree.map(lambda q: jnp.asarray(RNG.normal(size=q.shape), q.dtype), state)


@pytest.mark.parametrize(
    "name",
    [pytest.param(n, marks=[pytest.mark.thorough] * (n != "separable")) for n in OPERATORS],
)
def test_the_consensus_minimises_each_part(name):
    """Of the data: no slope of ½ Σ w (Az − g)² + μ/2 ‖z − q‖² is left; of the image: z ≥ 0."""
    splitting = with_penalties(posed(name))
    q = noise_like(splitting.start(jnp.zeros(posed(name).image_shape)))
    z = consensus(splitting, q)
    slope = gradient(splitting.problem, z.data[0]) + 0.3 * (z.data[0] - q.data[0])
    scale = float(jnp.abs(gradient(splitting.problem, q.data[0])).max())
    np.testing.assert_allclose(slope, 0, atol=1e-8 * scale)
    np.testing.assert_allclose(z.image, jnp.maximum(q.image, 0), atol=1e-15)
    shrunk = splitting.variation.shrink(q.slopes, splitting.tau / 0.7)
    for found, wanted in zip(z.slopes, shrunk, strict=True):
        np.testing.assert_allclose(found, wanted, atol=1e-14)


@pytest.mark.parametrize("name", ["dense", pytest.param("separable", marks=pytest.mark.thorough)])
def test_the_nearest_image_by_least_squares(name):
    """Of one plane and two: K f nearest to a target in the norm of the penalties."""
    problem = posed(name)
    splitting = with_penalties(problem)
    target = noise_like(splitting.start(jnp.zeros(problem.image_shape)))
    found = splitting.nearest(target)
    planes = problem.image_shape[-3]
    psi = dense.slopes((planes, *FIELD), 0.6)[: 3 if planes > 1 else 2]
    size = planes * FIELD[0] * FIELD[1]
    table = np.vstack(
        [np.eye(size) * 0.3**0.5, np.eye(size) * 0.2**0.5, *(p * 0.7**0.5 for p in psi)]
    )
    for n in range(3):
        flat = [np.asarray(x[n]).ravel() for x in (*target.data, target.image, *target.slopes)]
        roots = [0.3**0.5, 0.2**0.5, *(0.7**0.5 for _ in psi)]
        right = np.concatenate([r * x for r, x in zip(roots, flat, strict=True)])
        image = np.linalg.lstsq(table, right)[0]
        np.testing.assert_allclose(found.data[0][n].ravel(), image, atol=1e-12)
        np.testing.assert_allclose(found.image[n].ravel(), image, atol=1e-12)
        for slopes, difference in zip(found.slopes, psi, strict=True):
            np.testing.assert_allclose(slopes[n].ravel(), difference @ image, atol=1e-12)


@pytest.mark.parametrize("background", [0.0, 0.5])
def test_a_uniform_background_costs_no_iterations(background):
    """Of a random matrix with one eigenvalue 500 times the others, or none."""
    rng = np.random.default_rng(8)
    matrix = Matrix(rng.uniform(size=(300, 144)) - 0.5 + background, (12, 12), (15, 20))
    scene = np.zeros((1, 1, 12, 12))
    scene[..., 3:8, 4:10] = 1
    capture = matrix(jnp.asarray(scene[:, 0])) + 0.1 * rng.normal(size=(1, 15, 20))
    problem = InverseProblem(matrix, capture, weights=[100.0], tau=1.0)
    method, start = AdmmMethod(problem), uniform_image(problem)
    ends = [
        drive(method, start, iterations=n, tolerance=0.0, adapt_until=25).history[-1].objective
        for n in (50, 500)
    ]
    assert ends[0] == pytest.approx(ends[1], rel=1e-2)


def test_a_state_stands_for_its_image():
    for nonnegative in (True, False):
        problem = posed("windows", nonnegative=nonnegative)
        splitting = splitting_of(problem)
        image = jnp.asarray(RNG.normal(size=problem.image_shape))
        expected = jnp.maximum(image, 0) if nonnegative else image
        np.testing.assert_allclose(splitting.image(splitting.start(image)), expected, atol=1e-14)


@pytest.mark.thorough
@pytest.mark.parametrize("name", OPERATORS)
def test_single_precision_stays_and_is_near_to_double(name):
    """Also with the settings of total variation in double precision, their default here.

    The unit of the operator comes from another random start in each precision.
    """
    problem = posed(name)
    expected, found = (
        splitting.image(admm_map(splitting.start(jnp.ones(p.image_shape, p.tau.dtype)), splitting))
        for p in (problem, single(problem))
        for splitting in [splitting_of(p)]
    )
    assert found.dtype == jnp.float32 and relative_l2(found, expected) < 1e-3


def single(problem):
    """In float32, but for the regulariser."""
    small = scenes.single(problem)
    return InverseProblem(
        small.operators,
        small.captures,
        weights=small.weights,
        tau=float(problem.tau),
        regulariser=problem.regulariser,
    )
