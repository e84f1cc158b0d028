"""Sums of unbounded chirps: values, pixel averages and transforms."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from lensless.propagation import reference

import thincam_jax as tc
from thincam_jax.lensless.propagation.closed_form import ChirpSum

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


def test_transform_by_summation():
    """A direct sum over the plane, faded out by e^{−αr²}; what the fading costs falls with α."""
    chirp = ChirpSum(jnp.asarray([0.3 - 0.2j]), jnp.asarray([30.0]), jnp.asarray(CENTRE))
    grid = tc.Grid((5, 8), 0.1)
    value = np.asarray(transform(chirp, grid))
    v, u = (np.fft.fftshift(np.fft.fftfreq(n, 0.1)) for n in grid.shape)
    x = reference.centred(1200, 0.01)
    r2 = (x[:, None] - CENTRE[0]) ** 2 + (x - CENTRE[1]) ** 2
    errors = []
    for alpha in (0.6, 0.3):
        faded = ((0.3 - 0.2j) * np.exp((30j - alpha) * r2)).real
        kernels = [np.exp(-2j * np.pi * np.outer(f, x)) for f in (v, u)]
        expected = kernels[0] @ faded @ kernels[1].T * 0.01**2
        errors.append(np.abs(value - expected).max() / np.abs(value).max())
    assert errors[1] < 0.3 and 1.6 < errors[0] / errors[1] < 2.4
