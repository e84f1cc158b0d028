"""Scores of images beside their truths, and of methods over images."""

import numpy as np
import pytest

from thincam_jax.studies.agreement import FITS, Mean, agreement, mean_of, scores_table, summarised

TRUTH = np.random.default_rng(0).uniform(size=(3, 20, 26)).astype(np.float32)


@pytest.mark.parametrize(
    ("fit", "change", "exact"),
    [
        ("levels", lambda t: 0.4 * t + 0.2, True),
        ("gain", lambda t: 0.4 * t, True),
        ("gain", lambda t: 0.4 * t + 0.2, False),
        ("maximum", lambda t: 7 * t, True),
        ("none", lambda t: t, True),
        ("none", lambda t: 1.01 * t, False),
    ],
)
def test_what_is_fitted(fit, change, exact):
    found = agreement(change(TRUTH), TRUTH, fit=fit)
    assert (found.psnr_db is None or found.psnr_db > 100) == exact
    assert len(found.gain) == len(found.offset) == 3 and fit in FITS


def test_psnr_of_known_noise():
    """10 log₁₀(1/σ²), by hand; SSIM of the same is scikit-image's."""
    noise = np.random.default_rng(1).normal(size=TRUTH.shape).astype(np.float32)
    noise *= 0.05 / np.sqrt(np.mean(noise**2))
    found = agreement(TRUTH + noise, TRUTH, fit="none")
    assert found.psnr_db == pytest.approx(20 * np.log10(20), abs=1e-3)
    assert found.ssim is not None and 0.9 < found.ssim < 1


@pytest.mark.parametrize("moved", [(2, -3), (0, 0), (-3, 1)])
def test_shift(moved):
    """Found to the pixel; the same pixels are scored whatever the move."""
    found = agreement(np.roll(TRUTH, moved, axis=(1, 2)), TRUTH, shift=3)
    assert found.shift == (-moved[0], -moved[1])
    assert found.psnr_db is None or found.psnr_db > 100
    np.testing.assert_allclose(found.truth, TRUTH[:, 3:-3, 3:-3])
    still = agreement(np.full_like(TRUTH, 0.5), TRUTH, shift=2)
    assert still.shift == (0, 0)


def test_wrong_shapes():
    with pytest.raises(ValueError, match="larger than twice the shift"):
        agreement(TRUTH, TRUTH, shift=10)
    assert agreement(TRUTH[:, :5], TRUTH[:, :5]).ssim is None


def test_interval():
    """t(0.975, 3) = 3.182; it holds the mean of 95 % of such draws."""
    found = mean_of([1.0, 2.0, None, 3.0, 4.0])
    assert found is not None and found.mean == 2.5
    assert found.half == pytest.approx(3.18245 * np.sqrt(5 / 3) / 2, rel=1e-5)
    assert mean_of([None]) is None and mean_of([2.0]) == Mean(2.0, None)
    draws = np.random.default_rng(2).normal(3.0, 1.0, (2000, 8))
    means = [mean_of(list(draw)) for draw in draws]
    held = np.mean([abs(one.mean - 3) < one.half for one in means if one and one.half])
    assert held == pytest.approx(0.95, abs=0.015)


def test_methods_are_compared_image_by_image():
    def row(number, method, psnr):
        scores = {"psnr_db": psnr, "ssim": 0.5, "residual": 0.1, "seconds": 1.0}
        return {"number": number, "method": method, **scores}

    rows = [row(n, "ridge", 20.0 + 5 * n) for n in range(4)]
    rows += [row(n, "pnp", 21.0 + 5 * n + 0.1 * (n % 2)) for n in range(3)]
    ridge, pnp = summarised(rows, {"pnp": 1})
    assert (ridge.images, pnp.images, pnp.failed) == (4, 3, 1)
    assert (ridge.worst, ridge.median, ridge.best) == (20.0, 27.5, 35.0)
    # Images differ by 5 dB, the methods by 1.03 ± 0.14 in each.
    assert pnp.beside is not None and pnp.psnr_db is not None and pnp.psnr_db.half is not None
    assert pnp.beside.mean == pytest.approx(1.0333, abs=1e-3)
    assert pnp.beside.half == pytest.approx(0.1434, abs=1e-3) and pnp.psnr_db.half > 12
    assert "1.03 ± 0.14" in str(scores_table((ridge, pnp), brief=True))
    (failed,) = summarised([], {"pnp": 2})
    assert (failed.images, failed.failed, failed.psnr_db) == (0, 2, None)
    assert "–" in str(scores_table((failed,)))
