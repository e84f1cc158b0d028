"""Coded apertures' theory: correlations, spectra, noise of the decoded image, refusals."""

import numpy as np
import pytest
from lensless.masks.families import redundant

import thincam_jax as tc
from thincam_jax.lensless.masks import UniformlyRedundantArray, maximum_length_sequence

CELL = 0.03


def correlation(first, second):
    """Periodic, Σ_r first(r) second(r + s)."""
    transforms = np.fft.fft2(first).conj() * np.fft.fft2(second)
    return np.fft.ifft2(transforms).real


@pytest.mark.parametrize("p", [5, 7, 11, 13])
def test_mura_is_an_ideal_code(p):
    """A ⋆ G = (p² − 1)/2 δ; |Â| = (p ± 1)/2 off zero frequency; (p² − 1)/2 open cells."""
    mask = tc.ModifiedUniformlyRedundantArray(p, CELL)
    a, g = np.asarray(mask.cells), np.asarray(mask.decoder)
    np.testing.assert_array_equal(a, redundant(p, p))
    assert a.sum() == (p * p - 1) / 2
    expected = np.zeros((p, p))
    expected[0, 0] = (p * p - 1) / 2
    np.testing.assert_allclose(correlation(a, g), expected, atol=1e-9)
    levels = np.unique(np.abs(np.fft.fft2(a)).ravel()[1:].round(9))
    np.testing.assert_allclose(levels, [(p - 1) / 2, (p + 1) / 2], atol=1e-8)


@pytest.mark.parametrize("orders", [(5, 3), (7, 5), (13, 11)])
def test_ura_has_even_sidelobes(orders):
    mask = UniformlyRedundantArray(orders, CELL)
    a, rs = np.asarray(mask.cells), orders[0] * orders[1]
    np.testing.assert_array_equal(a, redundant(*orders))
    expected = np.full(orders, (rs + 1) / 4)
    expected[0, 0] = (rs + 1) / 2
    np.testing.assert_allclose(correlation(a, a), expected, atol=1e-9)
    decoded = correlation(a, np.asarray(mask.decoder))
    np.testing.assert_allclose(decoded.ravel()[1:], 0.0, atol=1e-9)


@pytest.mark.parametrize("length", [3, 31, 255])
def test_maximum_length_sequence(length):
    code = maximum_length_sequence(length)
    assert set(code) == {0.0, 1.0} and code.sum() == (length + 1) / 2
    s = 2 * code - 1
    expected = np.full(length, -1.0)
    expected[0] = length
    np.testing.assert_allclose(correlation(s[None], s[None])[0], expected, atol=1e-9)


@pytest.mark.parametrize("length", [31, 255])
def test_xor_of_codes_inverts_with_little_noise(length):
    """Mean of 1/|Â|² → 12/N², two thirds of it on the frequency axes."""
    code = maximum_length_sequence(length)
    mask = tc.SeparableMask(code, code, CELL, combine="xor")
    noise = 1 / np.abs(np.fft.fft2(np.asarray(mask.cells))) ** 2
    noise[0, 0] = 0.0
    total = noise.sum()
    assert total / length**2 == pytest.approx(12 / length**2, rel=6 / length)
    axes = noise[0].sum() + noise[:, 0].sum()
    assert axes / total == pytest.approx(2 / 3, abs=2 / length)


def test_tiles():
    mask = tc.ModifiedUniformlyRedundantArray(5, CELL, tiles=(2, 3))
    np.testing.assert_array_equal(mask.cells, np.tile(redundant(5, 5), (2, 3)))
    np.testing.assert_allclose([float(side) for side in mask.extent], [10 * CELL, 15 * CELL])
    assert mask.decoder.shape == (5, 5)
    assert float(mask.finest_frequency) == pytest.approx(1 / 0.06)
