"""The direct sum, against a quadrature of its integral and against the exact Fresnel model."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import thincam_jax as tc
from thincam_jax.lensless import LightPath
from thincam_jax.lensless.propagation.rayleigh_sommerfeld import rayleigh_sommerfeld
from thincam_jax.lensless.propagation.separable import separable

WAVELENGTH = 500e-6
MASK = tc.FresnelZoneAperture(200.0, 0.3, width=0.5, centre=(0.02, -0.03))

direct = jax.jit(
    lambda mask, grid, path, **settings: rayleigh_sommerfeld(
        mask,
        grid,
        path,
        tc.PsfMethod("rayleigh_sommerfeld", **{"pixel_integration": False} | settings),
    ),
    static_argnames=("mask_shape", "oversampling", "pixel_integration"),
)

exact = jax.jit(
    lambda *a, average=False: separable(*a, pixel_integration=average).image(),
    static_argnames="average",
)


def test_against_quadrature():
    """(1/2π)∬ U₀ (d/R)(1/R − jk) e^{jkR}/R by 200×200 Gauss-Legendre points, at 60° and on axis.

    The plane is 20 wavelengths wide and 40 µm off: nothing here is paraxial.
    """
    width, d, t = 0.01, 0.01, 0.03
    mask = tc.FresnelZoneAperture(2e4, 0.3, width=width)
    grid = tc.Grid((2, 3), 0.02)
    value = direct(mask, grid, LightPath(WAVELENGTH, d, t), mask_shape=(1, 1), oversampling=601)
    nodes, weights = np.polynomial.legendre.leggauss(200)
    xi, k = nodes * width / 2, 2 * np.pi / WAVELENGTH
    rho2 = xi[:, None] ** 2 + xi**2
    source = np.sqrt(t**2 + rho2)
    field = t * np.exp(1j * k * source) / source * 0.5 * (1 + np.cos(2e4 * rho2 + 0.3))
    expected = np.empty((2, 3))
    for i, y in enumerate((-0.01, 0.01)):
        for j, x in enumerate((-0.02, 0.0, 0.02)):
            r = np.sqrt(d**2 + (y - xi[:, None]) ** 2 + (x - xi) ** 2)
            kernel = d / r * (1 / r - 1j * k) * np.exp(1j * k * r) / r / (2 * np.pi)
            wave = np.einsum("ij,i,j", field * kernel, weights, weights) * width**2 / 4
            expected[i, j] = abs(wave) ** 2 * (1 + d / t) ** 2
    # Samples of λ/15: the midpoint sum is off by up to (k·pitch)²/24 = 0.7 %.
    np.testing.assert_allclose(value[:, 1], expected[:, 1], rtol=2e-3)
    np.testing.assert_allclose(value[:, ::2], expected[:, ::2], rtol=2e-2)


def test_refuses_a_mask_wider_than_its_plane():
    with pytest.raises(Exception, match="wider than the plane that samples it"):
        jnp.sum(
            direct(MASK, tc.Grid((4, 5), 0.04), LightPath(WAVELENGTH, 20.0))
        ).block_until_ready()
