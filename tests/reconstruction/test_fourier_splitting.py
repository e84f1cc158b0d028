"""The splitting for convolutions: its linear step against dense systems, its parts by formulas."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from reconstruction import scenes
from reconstruction.test_admm import case, iterate

from helpers import finite_difference, relative_l2
from thincam_jax.imaging.operators import CropConvolution
from thincam_jax.imaging.operators.crop_convolution import kernel_shape
from thincam_jax.reconstruction.admm import splitting_of
from thincam_jax.reconstruction.fourier_splitting import NormalInverse, difference_symbol
from thincam_jax.reconstruction.splitting import Penalties, consensus, rescaled

RNG = np.random.default_rng(5)
SENSOR, FIELD = (7, 9), (6, 11)


def operators(count, planes, channels=1, window=None):
    shape = (channels, planes, *kernel_shape(SENSOR, FIELD))
    return tuple(
        CropConvolution(
            jnp.asarray(RNG.normal(size=shape)), 1.0, SENSOR, FIELD, summed=1, window=window
        )
        for _ in range(count)
    )


def penalties(data=1.3, variation=0.7, image=0.2):
    return Penalties(*(jnp.asarray(p) for p in (data, variation, image)))


def dense(parts, gains, depth_weight, mu, channel, v, u, window):
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


@pytest.mark.parametrize("captures", [1, 2])
@pytest.mark.parametrize("planes", [1, 3])
@pytest.mark.parametrize("channels", [1, 2])
def test_it_inverts_the_dense_system_of_every_frequency(captures, planes, channels):
    """One plane and three, one capture and two, a depth weight; a PSF for all channels or each."""
    window = (15, 20) if planes == 3 else None  # an odd and an even one
    parts = operators(captures, planes, channels, window)
    window = parts[0].window
    gains = tuple(jnp.asarray(g) for g in (0.8, 1.9)[:captures])
    mu = penalties()
    inverse = NormalInverse(parts, gains, jnp.asarray(0.6))
    shape = (2, 2, planes, window[0], window[1] // 2 + 1)
    given = RNG.normal(size=shape) + 1j * RNG.normal(size=shape)
    value = np.asarray(inverse(jnp.asarray(given), mu))
    expected = np.empty_like(given)
    for c in range(2):
        for v in range(shape[-2]):
            for u in range(shape[-1]):
                matrix = dense(parts, gains, 0.6, mu, c, v, u, window)
                expected[:, c, :, v, u] = np.linalg.solve(matrix, given[:, c, :, v, u].T).T
    np.testing.assert_allclose(value, expected, rtol=1e-10, atol=1e-12)


def test_the_symbol_is_that_of_the_differences():
    """ΨᵀΨ of a picture by rolls, and by the symbol in the Fourier domain."""
    image = RNG.normal(size=(9, 14))
    symbol = difference_symbol((9, 14), jnp.float64)
    value = np.fft.irfft2(np.fft.rfft2(image) * np.asarray(symbol), s=(9, 14))
    expected = sum(
        2 * image - np.roll(image, 1, axis) - np.roll(image, -1, axis) for axis in (0, 1)
    )
    np.testing.assert_allclose(value, expected, atol=1e-13)


@pytest.mark.parametrize("window", [(15, 20), (16, 21)])
def test_mean_power_is_the_energy_of_the_kernel(window):
    """Parseval: mean |H|² over the whole plane is Σ h²; of even and odd windows."""
    kernel = RNG.uniform(size=(2, 3, *kernel_shape(SENSOR, FIELD)))
    operator = CropConvolution(jnp.asarray(kernel), 0.5, SENSOR, FIELD, summed=1, window=window)
    expected = np.mean(np.sum((kernel * 0.25) ** 2, axis=(-2, -1)))
    assert float(operator.mean_power()) == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize("planes", [1, pytest.param(3, marks=pytest.mark.thorough)])
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


def test_a_state_stands_for_its_image():
    """`start` and back; negative parts are cut only if that is asked."""
    for nonnegative in (True, False):
        problem, _ = scenes.problem(planes=2, channels=2, nonnegative=nonnegative)
        splitting = splitting_of(problem)
        image = jnp.asarray(np.random.default_rng(1).normal(size=problem.image_shape))
        back = splitting.image(splitting.start(image))
        expected = jnp.maximum(image, 0) if nonnegative else image
        np.testing.assert_allclose(back, expected, atol=1e-13)


def test_other_penalties_keep_image_and_forces():
    """`rescaled`: z as before, μ(q − z), which are the forces, as before; the same fixed point."""
    given = case("colour")
    splitting = splitting_of(given.problem)
    state = splitting.start(jnp.full(given.problem.image_shape, 0.4))
    state = iterate(splitting, jnp.asarray(1.5), state, 20)
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
    state = splitting.start(jnp.zeros(given.problem.image_shape))
    state = jax.tree.map(lambda q: jnp.asarray(rng.normal(size=q.shape)), state)
    z = consensus(splitting, state)
    operator = splitting.operators[0]
    (top, left), (rows, columns) = operator.sensor_corner, operator.sensor_shape
    inside = np.zeros(operator.window, bool)
    inside[top : top + rows, left : left + columns] = True
    q = np.asarray(state.data[0])[0]
    w, g = np.asarray(splitting.weights[0])[0], np.asarray(splitting.captures[0])[0]
    expected = q.copy()
    expected[inside] = ((w * g + 0.7 * q[inside].reshape(g.shape)) / (w + 0.7)).ravel()
    np.testing.assert_allclose(z.data[0][0], expected, rtol=1e-12, atol=1e-12)
    field = np.zeros(operator.window, bool)
    (top, left), (rows, columns) = operator.field_corner, operator.field_shape
    field[top : top + rows, left : left + columns] = True
    q = np.asarray(state.image)[0, 0]
    np.testing.assert_allclose(z.image[0, 0], np.where(field, np.maximum(q, 0), 0), atol=1e-15)
    # the last row's difference downwards leaves the field, and costs nothing
    row = top + rows - 1
    np.testing.assert_array_equal(z.slopes[0][0, 0, row], state.slopes[0][0, 0, row])
    assert jnp.abs(z.slopes[0][0, 0, row - 1] - state.slopes[0][0, 0, row - 1]).max() > 1e-3
