"""The finite chirp integral against quadrature, through its singular-looking places and forms."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from lensless.propagation.reference import chirp, chirp_by_quadrature

from helpers import finite_difference
from thincam_jax.lensless.propagation.chirp import chirp_integral

compiled = jax.jit(chirp_integral)
B = float(np.pi / (500e-6 * 6.5))  # Fresnel curvature of the thesis' camera, 967 rad/mm²


def edge_at(z, g, b, upper):
    """The x for which the upper end lies at z on the Fresnel integrals' scale."""
    a = g + b
    return (a * upper - z * np.sqrt(np.pi * abs(a) / 2)) / b


def points():
    """(g, b, x, lower, upper): seeded random ones, then every place where the form changes."""
    rng = np.random.default_rng(7)
    for width in np.geomspace(0.01, 5.6, 9):
        middle = rng.uniform(-0.3, 0.3) * width
        b = rng.uniform(0.5, 1.0) * min(B, 150 / width**2)  # bounds the cost of the quadrature
        g = rng.uniform(-2.5, 2.5) * b
        yield g, b, rng.uniform(-1, 1) * width, middle - width / 2, middle + width / 2
    b = 150.0
    for a in (0.0, 1e-12, -1e-12, 1e-6, -1e-3, 1.0):  # the order focuses on the sensor
        yield a - b, b, 0.21, -0.4, 0.6
    yield -b, b, 0.0, -0.4, 0.6  # the middle of the sinc
    for g in (70.0, -400.0):  # a > 0 and a < 0
        for z in (0.0, 4.999, 5.001, -4.999, -5.001):  # the shadow's edge; from series to series
            yield g, b, edge_at(z, g, b, 0.6), -0.4, 0.6
    yield 25.0, 0.0, 0.3, -0.5, 2.5  # no propagation
    yield -25.0, 0.0, 0.3, -0.5, 2.5
    yield 0.0, b, 3.0, -0.4, 0.6  # a slit, far outside its shadow
    for half in (0.0707, 0.0708):  # from power series to edge waves: a·half² = 3 rad
        yield 450.0, b, 0.0, -half, half
    yield 25.0, B, 1.234, -2.816, 2.816  # the thesis' aperture


def scale_of(g, b, x, lower, upper):
    with np.errstate(divide="ignore"):
        return np.minimum(upper - lower, np.sqrt(np.pi / np.abs(g + b)))


def test_against_quadrature():
    """Within 1e-8 of min(width, √(π/|a|)), the integral's natural size; measured 3e-14."""
    cases = list(points())
    assert len(cases) > 30
    expected = np.array([chirp_by_quadrature(*case) for case in cases])
    value = np.asarray(compiled(*jnp.asarray(cases).T))
    error = np.abs(value - expected) / scale_of(*np.asarray(cases).T)
    assert error.max() < 1e-12, cases[int(error.argmax())]


def test_single_precision():
    """At the thesis' aperture phases reach 8e3 rad; they are formed so that 1e-3 rad are kept."""
    x = np.linspace(-2.8, 2.8, 401)
    for g in (25.1, 0.0, -24.9):
        single = [np.asarray(v, np.float32) for v in (g, B, x, -2.816, 2.816)]
        value = np.asarray(compiled(*map(jnp.asarray, single)))
        assert value.dtype == np.complex64
        exact = chirp(*(v.astype(float) for v in single))
        assert np.abs(value - exact).max() / np.sqrt(np.pi / (g + B)) < 1e-3


def weighted(*arguments):
    """A real number from the complex integral in which both parts count."""
    value = chirp_integral(*arguments)
    return 0.6 * value.real - 0.8 * value.imag


def at_64_points(function):
    """Compile once for any number of points up to 64: the rest are filled with the first."""
    compiled = jax.jit(function)

    def call(*arguments):
        count = len(arguments[0])
        filled = [jnp.concatenate([v, jnp.full(64 - count, v[0])]) for v in arguments]
        return jax.tree.map(lambda v: v[:count], compiled(*filled))

    return call


gradient = at_64_points(jax.vmap(jax.grad(weighted, argnums=(0, 1, 2, 3, 4))))
values = at_64_points(weighted)


@pytest.mark.thorough
@pytest.mark.parametrize("x", [0.0, 0.21])
def test_smooth_through_focus(x):
    """Value and gradient do not feel a = 0; the slope there is that of differences across it."""
    b, ends = 150.0, (-0.4, 0.6)
    a = np.array([0.0, 1e-13, -1e-13, 1e-9, -1e-9, 1e-7, -1e-7])

    def at(a):
        return values(a - b, *(jnp.full(a.shape, v) for v in (b, x, *ends)))

    value = np.asarray(at(jnp.asarray(a)))
    across = finite_difference(at, jnp.zeros(1), jnp.ones(1), 0.02)[0]  # ξ² ≤ 0.36 rad per unit
    np.testing.assert_allclose(value - value[0], across * a, rtol=0, atol=1e-11)
    slopes = gradient(jnp.asarray(a) - b, *(jnp.full(a.shape, v) for v in (b, x, *ends)))
    assert abs(across) > 1e-3
    np.testing.assert_allclose(slopes[0], np.full(a.shape, across), rtol=1e-5 if x else 1e-6)
    for slope in slopes:
        np.testing.assert_allclose(slope, np.full(a.shape, slope[0]), rtol=1e-5)


@pytest.mark.thorough
def test_gradient_in_every_argument():
    """Against differences, with z = 0 (the shadow's edge), a = 0 and every form among the points.

    Each point has its own step: `rate` is how fast the phase under the integral turns with the
    argument, so that rate·step = 0.003 for all (phases here stay under 1e3 rad: see
    `finite_difference`). At z = 0 exactly the integral is smooth, and so is its Fresnel form.
    """
    cases = np.array([c for c in points() if c[1] < B])
    g, b, x, lower, upper = cases.T
    far = np.maximum(np.abs(lower), np.abs(upper))
    reach = np.maximum(np.abs(x - lower), np.abs(x - upper))
    size = scale_of(*cases.T)
    end_rate = [2 * np.abs(g * e + b * (e - x)) + 1 / size for e in (lower, upper)]
    rates = [far**2, reach**2, 2 * b * reach + 1.0, *end_rate]
    exact = gradient(*jnp.asarray(cases).T)
    for i, rate in enumerate(rates):
        direction = [jnp.zeros(len(cases))] * 5
        direction[i] = jnp.asarray(1 / rate)
        slope = finite_difference(
            lambda p: values(*p), tuple(jnp.asarray(v) for v in cases.T), tuple(direction), 0.003
        )
        error = np.abs(slope - exact[i] / rate) / size
        assert error.max() < 2e-9, (i, cases[int(error.argmax())])


@pytest.mark.thorough
def test_jit_and_vmap_are_eager():
    cases = jnp.asarray(list(points()))[::5]
    together = chirp_integral(*cases.T)
    np.testing.assert_allclose(together, compiled(*cases.T), rtol=0, atol=1e-15)
    one_by_one = jax.jit(jax.vmap(chirp_integral))(*cases.T)
    np.testing.assert_allclose(one_by_one, together, rtol=0, atol=1e-15)


def test_broadcasts():
    """(order, 1, 1) × (x, 1) × cell, as the models call it; each entry is its own integral."""
    g = jnp.array([20.0, -30.0])[:, None, None]
    x = jnp.array([-0.2, 0.1, 0.5])[:, None]
    ends = jnp.array([-0.3, 0.05, 0.2, 0.4])
    value = compiled(g, jnp.asarray(80.0), x, ends, ends + 0.1)
    assert value.shape == (2, 3, 4)
    expected = chirp(-30.0, 80.0, 0.5, 0.2, 0.3)
    np.testing.assert_allclose(value[1, 2, 2], expected, rtol=0, atol=1e-14)


def test_no_branch():
    """Under `vmap` a `lax.cond` becomes a select that computes both sides at every place."""
    traced = str(jax.make_jaxpr(jax.vmap(chirp_integral))(*jnp.asarray(list(points())).T))
    assert "cond[" not in traced
    assert "select_n" in traced
