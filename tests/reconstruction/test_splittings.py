"""The Fourier and the direct splitting of ADMM."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.sparse
from reconstruction import dense, scenes
from reconstruction.test_admm import case, relaxed

from helpers import finite_difference, quick, relative_l2
from thincam_jax.imaging.operators import CropConvolution, Matrix, Separable, Sparse
from thincam_jax.imaging.operators.crop_convolution import kernel_shape
from thincam_jax.reconstruction.admm import Penalties, consensus, rescaled
from thincam_jax.reconstruction.problem import InverseProblem, gradient
from thincam_jax.reconstruction.splittings import DirectSplitting, NormalInverse, splitting_of
from thincam_jax.reconstruction.total_variation import TotalVariation

RNG = np.random.default_rng(5)
SENSOR, FIELD = (7, 9), (6, 11)


def operators(count, planes, channels=1, window=None):
    shape = (channels, planes, *kernel_shape(SENSOR, FIELD))
    return tuple(
        CropConvolution(
            jax.device_put(RNG.normal(size=shape)), 1.0, SENSOR, FIELD, summed=1, window=window
        )
        for _ in range(count)
    )


def penalties(data=1.3, variation=0.7, image=0.2):
    return Penalties(*(jnp.asarray(p) for p in (data, variation, image)))


def dense_normal(parts, gains, depth_weight, mu, channel, v, u, window):
    """KᴴMK at one frequency: (plane, plane), from the definition."""
    planes = parts[0].spectrum.shape[-3]
    fy, fx = v / window[0], u / window[1]
    slopes = abs(np.exp(2j * np.pi * fy) - 1) ** 2 + abs(np.exp(2j * np.pi * fx) - 1) ** 2
    matrix = (float(mu.variation) * slopes + float(mu.image)) * np.eye(planes, dtype=complex)
    between = np.diff(np.eye(planes), axis=0) * depth_weight  # (planes − 1, planes)
    matrix += float(mu.variation) * between.T @ between
    for operator, gain in zip(parts, gains, strict=True):
        spectrum = np.asarray(operator.spectrum)
        row = spectrum[min(channel, spectrum.shape[0] - 1), :, v, u][None] * float(gain)
        matrix += float(mu.data) * row.conj().T @ row
    return matrix


@pytest.mark.parametrize(
    ("captures", "planes", "channels"), quick(itertools.product((1, 2), (1, 3), (1, 2)), 0, 7)
)
def test_it_inverts_the_dense_system_of_every_frequency(captures, planes, channels):
    """One plane and three, one capture and two, a depth weight; a PSF for all channels or each."""
    window = (15, 20) if planes == 3 else None  # an odd and an even one
    parts = operators(captures, planes, channels, window)
    window = parts[0].window
    gains = tuple(jnp.asarray(g) for g in (0.8, 1.9)[:captures])
    mu = penalties()
    inverse = jax.jit(NormalInverse)(parts, gains, jnp.asarray(0.6))
    shape = (2, 2, planes, window[0], window[1] // 2 + 1)
    given = RNG.normal(size=shape) + 1j * RNG.normal(size=shape)
    value = np.asarray(jax.jit(NormalInverse.__call__)(inverse, given, mu))
    expected = np.empty_like(given)
    for c in range(2):
        for v in range(shape[-2]):
            for u in range(shape[-1]):
                matrix = dense_normal(parts, gains, 0.6, mu, c, v, u, window)
                expected[:, c, :, v, u] = np.linalg.solve(matrix, given[:, c, :, v, u].T).T
    np.testing.assert_allclose(value, expected, rtol=1e-10, atol=1e-12)


@pytest.mark.parametrize("window", [(15, 20), (16, 21)])
def test_mean_power_is_the_energy_of_the_kernel(window):
    """Parseval: mean |H|² over the whole plane is Σ h²; of even and odd windows."""
    kernel = RNG.uniform(size=(2, 3, *kernel_shape(SENSOR, FIELD)))
    operator = CropConvolution(jax.device_put(kernel), 0.5, SENSOR, FIELD, summed=1, window=window)
    expected = np.mean(np.sum((kernel * 0.25) ** 2, axis=(-2, -1)))
    assert float(jax.jit(CropConvolution.mean_power)(operator)) == pytest.approx(
        expected, rel=1e-12
    )


@pytest.mark.parametrize("planes", quick([1, 3], 0))
def test_single_precision_and_gradients(planes):
    parts = operators(2, planes, window=(15, 20))
    shape = (1, planes, 15, 11)
    given = jnp.asarray(RNG.normal(size=shape) + 1j * RNG.normal(size=shape))
    gains = (jnp.asarray(1.0), jnp.asarray(0.5))
    expected = NormalInverse(parts, gains, jnp.asarray(0.6))(given, penalties())

    def small(leaf):
        return leaf.astype(jnp.complex64 if jnp.iscomplexobj(leaf) else jnp.float32)

    inverse = NormalInverse(
        jax.tree.map(small, parts), jax.tree.map(small, gains), jnp.asarray(0.6)
    )
    value = inverse(small(given), jax.tree.map(small, penalties()))
    assert value.dtype == jnp.complex64
    assert relative_l2(value, expected) < 2e-5

    def size(depth, data):
        mu = Penalties(data, jnp.asarray(0.7), jnp.asarray(0.2))
        return jnp.sum(jnp.abs(NormalInverse(parts, gains, depth)(given, mu)) ** 2)

    at = (jnp.asarray(0.6), jnp.asarray(1.3))
    for index in (0, 1):
        slope = jax.grad(size, argnums=index)(*at)
        direction = tuple(jnp.asarray(float(i == index)) for i in range(2))
        difference = finite_difference(lambda x: size(*x), at, direction, 1e-4)
        np.testing.assert_allclose(slope, difference, rtol=1e-7, atol=1e-9)


@jax.jit
def there_and_back(splitting, image):
    return splitting.image(splitting.start(image))


@pytest.mark.parametrize("kind", ["fourier", "direct"])
def test_a_state_stands_for_its_image(kind):
    """`start` and back; negative parts are cut only where f ≥ 0 is required."""
    for nonnegative in (True, False):
        if kind == "direct":
            problem = posed("separable", nonnegative=nonnegative)
        else:
            problem, _ = scenes.problem(planes=2, channels=2, nonnegative=nonnegative)
        splitting = splitting_of(problem)
        image = np.random.default_rng(1).normal(size=problem.image_shape)
        back = there_and_back(splitting, image)
        expected = np.maximum(image, 0) if nonnegative else image
        np.testing.assert_allclose(back, expected, atol=1e-13)


@pytest.mark.thorough
def test_other_penalties_keep_image_and_forces():
    """`rescaled`: z as before, μ(q − z), which are the forces, as before; the same fixed point."""
    given = case("colour")
    splitting = splitting_of(given.problem)
    state = splitting.start(jnp.full(given.problem.image_shape, 0.4))
    state = jax.lax.fori_loop(0, 20, lambda _, s: relaxed(splitting, 1.5, s), state)
    factors = Penalties(*(jnp.asarray(f) for f in (0.3, 2.5, 1.7)))
    other = splitting.with_penalties(jax.tree.map(jnp.multiply, splitting.penalties, factors))
    scaled = rescaled(splitting, state, factors)
    z, still = consensus(splitting, state), consensus(other, scaled)
    force = 0.0
    for part, name in (("data", "data"), ("slopes", "variation"), ("image", "image")):
        old, new = getattr(splitting.penalties, name), getattr(other.penalties, name)
        sides = (getattr(s, part) for s in (state, z, scaled, still))
        for q, a, r, b in zip(*(jax.tree.leaves(s) for s in sides), strict=True):
            np.testing.assert_allclose(b, a, atol=1e-12)
            np.testing.assert_allclose(new * (r - b), old * (q - a), atol=1e-12)
            force = max(force, float(jnp.abs(q - a).max()))
    assert force > 0.1
    np.testing.assert_allclose(other.image(scaled), splitting.image(state), atol=1e-12)


def test_the_reflection_minimises_each_part():
    """z of the data: (w g + μ q)/(w + μ) on the sensor, q beside it; of the image: its field."""
    given = case("one")
    splitting = splitting_of(given.problem).with_penalties(penalties(0.7, 2.0, 3.0))
    rng = np.random.default_rng(4)
    state = jax.eval_shape(splitting.start, jnp.zeros(given.problem.image_shape))
    state = jax.tree.map(lambda q: rng.normal(size=q.shape), state)
    z = jax.jit(consensus)(splitting, state)
    operator = splitting.operators[0]
    (top, left), (rows, columns) = operator.sensor_corner, operator.sensor_shape
    inside = np.zeros(operator.window, bool)
    inside[top : top + rows, left : left + columns] = True
    q = np.asarray(state.data[0])[0]
    w, g = np.asarray(splitting.weights[0])[0], np.asarray(splitting.captures[0])[0]
    expected = q.copy()
    expected[inside] = ((w * g + 0.7 * q[inside].reshape(g.shape)) / (w + 0.7)).ravel()
    np.testing.assert_allclose(np.asarray(z.data[0])[0], expected, rtol=1e-12, atol=1e-12)
    field = np.zeros(operator.window, bool)
    (top, left), (rows, columns) = operator.field_corner, operator.field_shape
    field[top : top + rows, left : left + columns] = True
    q = np.asarray(state.image)[0, 0]
    np.testing.assert_allclose(
        np.asarray(z.image)[0, 0], np.where(field, np.maximum(q, 0), 0), atol=1e-15
    )
    # the last row's difference downwards leaves the field, and costs nothing
    row = top + rows - 1
    np.testing.assert_array_equal(np.asarray(z.slopes[0])[0, 0, row], state.slopes[0][0, 0, row])
    moved = np.asarray(z.slopes[0])[0, 0, row - 1] - state.slopes[0][0, 0, row - 1]
    assert np.abs(moved).max() > 1e-3


SMALL_FIELD = (4, 5)
CHANCE = np.random.default_rng(6)


def convolution(sensor, window=None):
    kernel = CHANCE.uniform(size=kernel_shape(sensor, SMALL_FIELD)) ** 4
    return CropConvolution(jax.device_put(kernel), 0.5, sensor, SMALL_FIELD, window=window)


OPERATORS = {
    "dense": [Matrix(CHANCE.normal(size=(2 * 30, 2 * 20)), (2, *SMALL_FIELD), (2, 30))],
    "separable": [Separable(CHANCE.normal(size=(6, 4)), CHANCE.normal(size=(3, 5)))],
    "sparse": [Sparse(scipy.sparse.random(25, 20, 0.3, random_state=3), SMALL_FIELD, (25,))],
    # Windows that differ, so that no transform makes both diagonal.
    "windows": [convolution((6, 7), (12, 15)), convolution((5, 9), (16, 16))],
}


def posed(name, **settings):
    """Captures (batch, channel, …) of noise, with weights of each pixel but for the separable."""
    operators, captures, weights = OPERATORS[name], [], []
    for operator in operators:
        shape = operator.out_shape
        captures.append(CHANCE.uniform(0.5, 1.5, (3, 1, *shape)))
        weights.append(2.0 if name == "separable" else CHANCE.uniform(0.5, 2.0, shape))
    settings = {"regulariser": TotalVariation(depth_weight=0.6)} | settings
    return InverseProblem(operators, captures, weights=weights, **settings)


def with_penalties(problem, data=0.3, variation=0.7, image=0.2):
    splitting = splitting_of(problem)
    assert isinstance(splitting, DirectSplitting)
    values = (jnp.asarray(p, problem.tau.dtype) for p in (data, variation, image))
    return splitting.with_penalties(Penalties(*values))


def noise_like(state):
    return jax.tree.map(lambda q: jnp.asarray(CHANCE.normal(size=q.shape), q.dtype), state)


@pytest.mark.parametrize("name", quick(OPERATORS, 1))
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


@pytest.mark.parametrize("name", quick(["dense", "separable"], 0))
def test_the_nearest_image_by_least_squares(name):
    """Of one plane and two: K f nearest to a target in the norm of the penalties."""
    problem = posed(name)
    splitting = with_penalties(problem)
    target = noise_like(splitting.start(jnp.zeros(problem.image_shape)))
    found, target = jax.device_get(
        (jax.jit(lambda given: splitting.nearest(given))(target), target)
    )
    planes = problem.image_shape[-3]
    psi = dense.slopes((planes, *SMALL_FIELD), 0.6)[: 3 if planes > 1 else 2]
    size = planes * SMALL_FIELD[0] * SMALL_FIELD[1]
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
