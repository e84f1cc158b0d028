"""Wavelets: orthonormal for every size, with the moments their filters promise."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from thincam_jax.reconstruction.regularisers import Cosines, Sparsity
from thincam_jax.reconstruction.wavelet import FILTERS, Wavelet

SIZES = [(1, 1), (2, 7), (13, 16)]


def matrix(basis, shape):
    """The transform, dense: (coefficient, pixel)."""
    pixels = jnp.eye(shape[0] * shape[1]).reshape(-1, *shape)
    return np.asarray(jax.jit(type(basis).analyse)(basis, pixels)).reshape(len(pixels), -1).T


@pytest.mark.parametrize("shape", SIZES)
@pytest.mark.parametrize(
    "basis",
    [
        pytest.param(Wavelet("haar", 2), marks=pytest.mark.thorough),
        Wavelet("daubechies4", 3),
        pytest.param(Wavelet("daubechies8", 2), marks=pytest.mark.thorough),
        Cosines(),
    ],
)
def test_it_is_orthonormal_and_synthesis_undoes_it(basis, shape):
    dense = matrix(basis, shape)
    np.testing.assert_allclose(dense @ dense.T, np.eye(len(dense)), atol=1e-12)
    image = jnp.asarray(np.random.default_rng(1).normal(size=(2, *shape)))
    there = jax.jit(type(basis).analyse)(basis, image)
    back = jax.jit(type(basis).synthesise)(basis, there)
    np.testing.assert_allclose(back, image, atol=1e-12)


def test_haar_of_two_by_two_pixels_by_hand():
    coefficients = Wavelet("haar", 1).analyse(jnp.array([[1.0, 2.0], [3.0, 5.0]]))
    np.testing.assert_allclose(coefficients, [[5.5, -1.5], [-2.5, 0.5]], atol=1e-15)


@pytest.mark.parametrize("family", FILTERS)
def test_details_of_a_polynomial_vanish_away_from_the_border(family):
    """A filter of 2m numbers has m vanishing moments: it sees no polynomial below degree m."""
    taps = len(FILTERS[family])
    x = np.arange(64.0)
    line = jnp.asarray((x / 64) ** (taps // 2 - 1))[None]
    details = Wavelet(family, 1).analyse(line)[0, 32:]
    np.testing.assert_allclose(details[: 32 - taps], 0, atol=1e-12)
    steeper = jnp.asarray((x / 64) ** (taps // 2))[None]
    assert float(jnp.abs(Wavelet(family, 1).analyse(steeper)[0, 32 : 64 - taps]).max()) > 1e-9


@pytest.mark.thorough
def test_the_sparsity_of_an_even_image_is_nothing_and_of_a_pixel_is_known():
    even = jnp.full((1, 1, 8, 16), 3.0)
    pixel = jnp.zeros((1, 1, 4, 4)).at[0, 0, 1, 2].set(1.0)
    for basis in (Wavelet("haar", 2), Cosines()):
        assert float(Sparsity(basis)(even)) < 1e-12
    # Haar, two levels: 3 details of 1/2, 3 of 1/4.
    np.testing.assert_allclose(Sparsity(Wavelet("haar", 2))(pixel), 2.25, atol=1e-12)


def test_float32_stays_float32_and_gradients_are_the_transpose():
    wavelet = Wavelet(levels=2)
    image = jnp.asarray(np.random.default_rng(2).normal(size=(11, 14)), jnp.float32)
    assert wavelet.analyse(image).dtype == jnp.float32
    assert Cosines().analyse(image).dtype == jnp.float32
    _, pull = jax.vjp(wavelet.analyse, image)
    np.testing.assert_allclose(pull(image)[0], wavelet.synthesise(image), atol=1e-5)


def test_wrong_levels_are_refused():
    with pytest.raises(ValueError, match="at least 1"):
        Wavelet("haar", 0)
