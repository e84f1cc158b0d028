"""Frames at several exposures, merged: against scenes whose light is known."""

import numpy as np
import pytest

from thincam_jax.measured.exposures import ExposedFrames, merge_exposures

SHAPE = 45, 70
FULL, OFFSET, GAIN, READ = 4095, 60.0, 0.3, 2.4  # counts, counts, counts per electron, counts
TIMES = (0.002, 0.02, 0.2)  # s
SCENE = np.geomspace(60, 3e6, SHAPE[0] * SHAPE[1]).reshape(SHAPE)  # counts/s


def taken(exposure, random, frames=6, dark=8, scene=SCENE):
    """Poisson electrons, dark current with hot pixels, Gaussian read noise, whole counts."""
    current = np.where(np.arange(SHAPE[1]) % 50 == 7, 400.0, 20.0)

    def expose(light, count):
        electrons = random.poisson((light + current) * exposure / GAIN, (count, *SHAPE))
        seen = GAIN * electrons + OFFSET + READ * random.standard_normal((count, *SHAPE))
        return np.clip(np.rint(seen), 0, FULL).astype(np.uint16)

    return ExposedFrames(exposure, expose(scene, frames), expose(0.0 * scene, dark))


@pytest.fixture(scope="module")
def series():
    """Repeated merges of new frames: (repetition, y, x) of rate and variance."""
    random = np.random.default_rng(5)
    found = [merge_exposures([taken(t, random) for t in TIMES], FULL) for _ in range(20)]
    return (
        np.stack([one.rate for one in found]),
        np.stack([one.noise_variance for one in found]),
        found,
    )


def test_without_bias_and_with_the_variance_that_it_says(series):
    rate, variance, found = series
    valid = np.isfinite(variance).all(axis=0)
    assert 0.9 < valid.mean() < 0.97  # the brightest are saturated in the shortest, too
    z = ((rate - SCENE) / np.sqrt(variance.mean(axis=0)))[:, valid]
    assert abs(z.mean()) < 0.01 and abs(np.mean(z**2) - 1) < 0.02  # 0.004 and 0.006 by chance
    parts = np.array_split(z, 12, axis=1)  # from dark to bright
    assert max(abs(part.mean()) for part in parts) < 0.06
    assert max(abs(np.mean(part**2) - 1) for part in parts) < 0.08
    assert np.mean([one.gain for one in found]) == pytest.approx(GAIN, rel=0.02)
    current = np.mean(np.where(np.arange(SHAPE[1]) % 50 == 7, 400.0, 20.0)) * np.array(TIMES)
    expected = READ**2 + GAIN * current + 1 / 12
    np.testing.assert_allclose(found[0].dark_variance, expected, rtol=0.05)


def test_it_beats_every_single_exposure(series):
    """Signal over noise, from the scatter of the repetitions, at any brightness."""
    rate, variance, _ = series
    valid = np.isfinite(variance).all(axis=0)
    error = ((rate - SCENE) ** 2)[:, valid].mean(axis=0)
    random = np.random.default_rng(6)
    best = np.full(error.shape, np.inf)
    for exposure in TIMES:
        one = [merge_exposures([taken(exposure, random)], FULL) for _ in range(10)]
        squares = np.stack([np.where(m.valid, (m.rate - SCENE) ** 2, np.inf) for m in one])
        best = np.minimum(best, squares[:, valid].mean(axis=0))
    for ours, theirs in zip(
        *(np.array_split(x / SCENE[valid] ** 2, 8) for x in (error, best)), strict=True
    ):
        assert ours.mean() < 1.02 * theirs[np.isfinite(theirs)].mean()
    decibels = 10 * np.log10(np.mean(best[np.isfinite(best)] / error[np.isfinite(best)]))
    assert decibels > 0.3


def test_saturated_pixels_are_left_out():
    random = np.random.default_rng(7)
    series = [taken(t, random) for t in TIMES]
    merged = merge_exposures(series, FULL)
    full = [np.any(one.frames == FULL, axis=0) for one in series]
    assert 0.01 < full[0].mean() < full[1].mean() < full[2].mean()
    assert np.array_equal(merged.valid, ~full[0])
    only = full[1] & ~full[0]  # the shortest alone remains
    alone = merge_exposures(series[:1], FULL)
    np.testing.assert_allclose(merged.rate[only], alone.rate[only], rtol=1e-12)
    assert np.all(merged.rate[full[0]] > 0.9 * (FULL - OFFSET) / TIMES[0])
    hidden = [ExposedFrames(one.exposure, one.frames.copy(), one.dark) for one in series]
    hidden[2].frames[:, full[2]] = FULL  # whatever a full pixel holds
    np.testing.assert_array_equal(merge_exposures(hidden, FULL).rate, merged.rate)


def test_flicker_of_the_lamp_is_no_noise():
    """Frames of 10 % more and less light: the gain stays that of photon noise."""
    random = np.random.default_rng(11)
    dark = taken(0.02, random, scene=0.0 * SCENE).dark
    lit = [taken(0.02, random, 2, scene=lamp * SCENE).frames for lamp in (0.9, 1.0, 1.1)]
    merged = merge_exposures([ExposedFrames(0.02, np.concatenate(lit), dark)], FULL)
    assert merged.gain == pytest.approx(GAIN, rel=0.04)


def test_one_exposure_is_the_mean_of_its_frames():
    one = taken(0.002, np.random.default_rng(8))
    merged = merge_exposures([one], FULL)
    expected = (one.frames.mean(axis=0) - one.dark.mean(axis=0)) / 0.002
    np.testing.assert_allclose(merged.rate, expected, rtol=1e-12)
