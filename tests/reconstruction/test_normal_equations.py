"""Preconditioner of convolutions against the circulant matrix nearest to dense ones."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

from thincam_jax.imaging.operators import CropConvolution
from thincam_jax.reconstruction.normal_equations import mean_powers, normal_equations
from thincam_jax.reconstruction.problem import InverseProblem

RNG = np.random.default_rng(2)
FIELD = (10, 15)  # lengths that transform fast, so that nothing is padded


def gram(operator: CropConvolution) -> np.ndarray:
    count = FIELD[0] * FIELD[1]
    unit = jnp.asarray(np.eye(count).reshape(count, *FIELD))
    columns = np.asarray(operator(unit)).reshape(count, -1)
    return columns @ columns.T


def nearest_circulant(matrix: np.ndarray) -> np.ndarray:
    """Eigenvalues: diagonal of F A F⁻¹ (T. Chan 1988), on the half plane."""
    waves = np.fft.fft2(np.eye(len(matrix)).reshape(-1, *FIELD)).reshape(len(matrix), -1)
    values = np.real(np.einsum("ik,ij,jk->k", waves.conj(), matrix, waves)) / len(matrix)
    return values.reshape(FIELD)[:, : FIELD[1] // 2 + 1]


def powers(operator: CropConvolution) -> np.ndarray:
    found = mean_powers([operator.with_channels_and_planes()], [jnp.ones(())])
    return np.asarray(found)[0, 0, 0].real


def test_it_is_the_nearest_circulant_where_all_light_falls_on_the_sensor():
    kernel = np.random.default_rng(0).random((4, 3))
    operator = CropConvolution(jnp.asarray(kernel), 1.0, (13, 19), FIELD)
    np.testing.assert_allclose(powers(operator), nearest_circulant(gram(operator)), rtol=1e-9)


@pytest.mark.parametrize("sensor", [(8, 9), (21, 18), (10, 15)])
def test_it_keeps_the_trace_where_the_sensor_cuts(sensor):
    """The mean of AᵀA's diagonal; a wide PSF, most of which falls beside the sensor."""
    shape = [s + f - 1 for s, f in zip(sensor, FIELD, strict=True)]
    kernel = np.random.default_rng(1).normal(size=shape)
    operator = CropConvolution(jnp.asarray(kernel), 1.0, sensor, FIELD)
    found, expected = powers(operator), nearest_circulant(gram(operator))
    whole = 2 * found.sum() - found[:, 0].sum()  # of an odd row, the mirrored half too
    assert whole == pytest.approx(np.trace(gram(operator)), rel=1e-6)
    # Lags are weighted by the geometric mean of what both points show.
    assert np.corrcoef(found.ravel(), expected.ravel())[0, 1] > 0.9
    assert found.min() > 0


def test_a_background_takes_no_more_steps():
    """It leaves one image of uniform light with a small eigenvalue, which its own step solves."""
    kernel = RNG.random((25, 31))
    operator = CropConvolution(jnp.asarray(kernel), 1.0, (20, 24), (32, 36))
    captures = [jnp.asarray(RNG.random((1, 20, 24)))]
    columns = operator(jnp.eye(32 * 36).reshape(-1, 32, 36)).reshape(32 * 36, -1)
    shift = 1e-3 * jnp.linalg.norm(columns, 2) ** 2
    steps = {}
    for background in ("known", "unknown"):
        problem = InverseProblem(operator, captures, background=background)
        normal = normal_equations(problem, shift)
        *_, steps[background] = normal.least_squares(problem.captures, 1e-6, 500)
    bare = dataclasses.replace(normal, uniform=None)
    *_, without = bare.least_squares(problem.captures, 1e-6, 500)
    assert steps["unknown"] <= steps["known"] < without
