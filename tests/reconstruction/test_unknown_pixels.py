"""Captures of other libraries, byte orders and precisions, with masks and NaN."""

import logging

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.signal

import thincam_jax as tc

RNG = np.random.default_rng(0)
PSFS = tc.Psfs(RNG.random((2, 5, 7)))
CAPTURES = RNG.random((2, 12, 17)).astype(np.float32)
MASK = RNG.random(CAPTURES.shape) < 0.05
SPOILT = np.where(MASK, 1e4, CAPTURES)


class Elsewhere:
    """An array of another library, which has but one of NumPy's or DLPack's methods."""

    def __init__(self, array):
        self.array = array


class ByArray(Elsewhere):
    def __array__(self, dtype=None, copy=None):
        return self.array.astype(dtype or self.array.dtype)


class ByDlpack(Elsewhere):
    def __dlpack__(self, **options):
        return self.array.__dlpack__(**options)

    def __dlpack_device__(self):
        return self.array.__dlpack_device__()


def masked(array, mask):
    return np.ma.masked_array(array, mask)


@pytest.mark.parametrize("kind", ["masked", "list", "nan", "nan jax", "integers"])
def test_masked_pixels_and_nan_are_not_valid(kind, caplog):
    given = {
        "masked": masked(SPOILT, MASK),
        "list": [masked(s, m) for s, m in zip(SPOILT, MASK, strict=True)],
        "nan": np.where(MASK, np.nan, CAPTURES),
        "nan jax": jnp.asarray(np.where(MASK, np.nan, CAPTURES)),
        "integers": masked((1000 * SPOILT).astype(int), MASK),
    }[kind]
    with caplog.at_level(logging.WARNING):
        found = tc.Recording(given, PSFS)
    assert f"{MASK.sum()} pixels are masked or NaN" in caplog.text
    np.testing.assert_array_equal(np.stack(found.valid), ~MASK)
    known = (1000 * SPOILT).astype(int) if kind == "integers" else CAPTURES
    expected = tc.Recording(known, PSFS, valid=~MASK)
    solver = tc.Ridge(0.1)
    image, truth = (tc.reconstruct(one, solver).image for one in (found, expected))
    np.testing.assert_allclose(image, truth, rtol=1e-4, atol=1e-4 * float(truth.max()))


def test_masks_join_those_that_are_given(caplog):
    valid = RNG.random(CAPTURES.shape[1:]) < 0.9
    found = tc.Recording(masked(SPOILT, MASK), PSFS, valid=valid)
    np.testing.assert_array_equal(np.stack(found.valid), valid & ~MASK)
    assert f"{(MASK & valid).sum()} pixels" in caplog.text
    caplog.clear()
    unmasked = tc.Recording(masked(CAPTURES, np.zeros_like(MASK)), PSFS)
    assert unmasked.valid is None and not caplog.records
    with pytest.raises(ValueError, match="valid is False everywhere"):
        tc.Recording(masked(CAPTURES, True), PSFS)


@pytest.mark.parametrize("kind", [">f4", ">f8", "float16", ">u2", "array", "dlpack"])
def test_captures_of_other_makes(kind):
    fine = np.round(1000 * CAPTURES)
    made = {"array": ByArray, "dlpack": ByDlpack}.get(kind, lambda a: a.astype(kind))
    found = tc.Recording(made(fine), PSFS) if kind in (">f4", ">f8", "float16", ">u2") else None
    found = found or tc.Recording([made(one) for one in fine], PSFS)
    np.testing.assert_allclose(np.stack(found.captures), fine, rtol=1e-3)
    assert np.isfinite(tc.reconstruct(found, tc.Ridge(0.1)).image).all()


def test_traced_captures_pass():
    residual = jax.jit(lambda c: tc.Recording(c, PSFS, noise_variance=1.0).captures[0].sum())
    assert float(residual(jnp.asarray(CAPTURES))) == pytest.approx(CAPTURES[0].sum(), rel=1e-5)


def test_saturated_and_hot_pixels_are_found_by_default(caplog):
    """As with the right mask; a mask that is given is not doubted."""
    generator = np.random.default_rng(3)
    scene = np.kron(generator.random((1, 8, 11)), np.ones((5, 5)))
    psf = np.kron(generator.random((1, 5, 5)) < 0.4, np.ones((3, 3)))
    clean = np.stack([scipy.signal.fftconvolve(scene[0], psf[0], "same")] * 2)
    clean = clean + 0.003 * clean.max() * generator.standard_normal(clean.shape)
    limit = np.quantile(clean, 0.9)
    hot = np.zeros(clean.shape[1:], bool)
    hot[[9, 20, 31], [12, 40, 25]] = True
    dirty = np.minimum(clean, limit) + np.where(hot, 2 * limit, 0)
    psfs = tc.Psfs(np.broadcast_to(psf, (2, 15, 15)))
    saturated = (clean >= limit) & ~hot
    found = tc.Recording(dirty, psfs)
    assert found.valid is not None
    np.testing.assert_array_equal(np.stack(found.valid), ~(hot | saturated))
    assert "6 pixels are hot or dead" in caplog.text
    assert f"{saturated.sum()} pixels are saturated" in caplog.text
    caplog.clear()
    assert tc.Recording(clean, psfs).valid is None
    given = tc.Recording(dirty, psfs, valid=~hot)
    np.testing.assert_array_equal(np.stack(given.valid or ()), [~hot] * 2)
    assert not caplog.records


def test_checked_functions_convert_them_too():
    from thincam_jax.measured.bayer import demosaic

    mosaic = CAPTURES[0]
    expected = demosaic(mosaic, "RGGB")
    for make in (ByArray, ByDlpack, lambda a: masked(a, False), lambda a: a.astype(">f4")):
        np.testing.assert_allclose(demosaic(make(mosaic), "RGGB"), expected, rtol=1e-6)
