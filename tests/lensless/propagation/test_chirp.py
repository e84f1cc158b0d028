"""The finite chirp integral against quadrature, through its singular-looking places and forms."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from lensless.propagation import reference
from lensless.propagation.reference import chirp, chirp_by_quadrature

import thincam_jax as tc
from thincam_jax.lensless.propagation.chirp import chirp_integral
from thincam_jax.lensless.propagation.closed_form import ChirpSum

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


WEIGHTS = np.array([0.4, 0.3 - 0.2j, -0.1 + 0.5j])
CURVATURES = np.array([0.0, 30.0, -55.0])
CENTRE = (0.11, -0.07)
SUM = ChirpSum(jnp.asarray(WEIGHTS + 0j), jnp.asarray(CURVATURES), jnp.asarray(CENTRE))

sample = jax.jit(
    lambda terms, grid, average: terms.sample(grid, pixel_integration=average).image(),
    static_argnums=2,
)
transform = jax.jit(lambda terms, grid: terms.transform(grid))


def image(y, x):
    r2 = (y[:, None] - CENTRE[0]) ** 2 + (x - CENTRE[1]) ** 2
    return sum((w * np.exp(1j * g * r2)).real for w, g in zip(WEIGHTS, CURVATURES, strict=True))


@pytest.mark.parametrize("shape", [(12, 17), (1, 1), (1, 9)])
def test_values(shape):
    grid = tc.Grid(shape, 0.05)
    value = sample(SUM, grid, False)
    expected = image(*(reference.centred(n, 0.05) for n in shape))
    np.testing.assert_allclose(value, expected, rtol=0, atol=1e-13)


def test_pixel_averages():
    """Against 30×30 Gauss-Legendre points a pixel; the average differs from the value by 5 %."""
    shape, pitch = (12, 17), 0.1
    nodes, weights = np.polynomial.legendre.leggauss(30)
    y, x = ((reference.centred(n, pitch)[:, None] + nodes * pitch / 2).ravel() for n in shape)
    fine = image(y, x).reshape(12, 30, 17, 30)
    expected = np.einsum("iajb,a,b->ij", fine, weights / 2, weights / 2)
    value = sample(SUM, tc.Grid(shape, pitch), True)
    np.testing.assert_allclose(value, expected, rtol=0, atol=1e-13)
    assert np.abs(sample(SUM, tc.Grid(shape, pitch), False) - expected).max() > 0.05


@pytest.mark.parametrize("shape", [(6, 9), (7, 4), (1, 5)])
def test_transform(shape):
    """The limit α → 0 of F{e^{(jγ−α)r²}} = π/(α−jγ)·e^{−π²ρ²/(α−jγ)}; Re{w·} adds the conjugate."""
    grid = tc.Grid(shape, 0.05)
    v, u = (np.fft.fftshift(np.fft.fftfreq(n, 0.05)) for n in shape)
    rho2 = v[:, None] ** 2 + u**2
    expected = np.zeros(shape, complex)
    for w, g in zip(WEIGHTS[1:], CURVATURES[1:], strict=True):
        for weight, s in ((w / 2, -1j * g), (np.conj(w) / 2, 1j * g)):
            expected += weight * np.pi / s * np.exp(-(np.pi**2) * rho2 / s)
    expected *= np.exp(-2j * np.pi * (v[:, None] * CENTRE[0] + u * CENTRE[1]))
    expected[shape[0] // 2, shape[1] // 2] += WEIGHTS[0].real * shape[0] * shape[1] * 0.05**2
    np.testing.assert_allclose(transform(SUM, grid), expected, rtol=0, atol=1e-12)
