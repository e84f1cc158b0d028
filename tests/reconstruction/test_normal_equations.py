"""Preconditioner of convolutions against the circulant matrix nearest to dense ones."""

import jax.numpy as jnp
import numpy as np
import pytest

from thincam_jax.imaging.operators import CropConvolution
from thincam_jax.reconstruction.normal_equations import less_uniform, mean_powers
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


def test_a_background_takes_the_uniform_light_of_the_sensor():
    """The nearest circulant of AᵀA − Aᵀ1 1ᵀA/N, of which a hundredth of AᵀA's is kept."""
    operator = CropConvolution(jnp.asarray(RNG.random((4, 3))), 1.0, (13, 19), FIELD)
    captures = [jnp.zeros((1, 13, 19))]
    problem = InverseProblem(operator, captures, background="unknown")
    whole, light = gram(operator), np.asarray(operator.adjoint(jnp.ones((13, 19)))).ravel()
    left = nearest_circulant(whole - np.outer(light, light) / (13 * 19))
    expected = np.maximum(left, 0.01 * nearest_circulant(whole))
    assert expected[0, 0] < 0.6 * nearest_circulant(whole)[0, 0]
    found = less_uniform(problem, mean_powers(problem.operators, problem.weights))
    np.testing.assert_allclose(found[0, 0, 0].real, expected, rtol=1e-9)
