"""Registration against scenes that are drawn, in closed form, at another scale and place."""

import numpy as np
import pytest

from thincam_jax.measured.calibration import estimate_registration

SHAPE = (150, 181)


def blobs(scale=1.0, shift=(0.0, 0.0), seed=0):
    """Gaussian blobs of 1.5 to 10 pixels, enlarged about the middle and moved."""
    rng = np.random.default_rng(seed)
    y, x = ((np.arange(n) - (n - 1) / 2 - a) / scale for n, a in zip(SHAPE, shift, strict=True))
    image = np.zeros(SHAPE)
    for _ in range(60):
        y0, x0 = rng.uniform(-105, 105, 2)
        size, height = rng.uniform(1.5, 10.0), rng.uniform(-1, 1)
        down, across = (np.exp(-((r - c) ** 2) / (2 * size**2)) for r, c in ((y, y0), (x, x0)))
        image += height * down[:, None] * across
    return image


def noisy(image, part, seed):
    return image + part * image.std() * np.random.default_rng(seed).normal(size=image.shape)


@pytest.mark.parametrize(
    ("scale", "shift"), [(1.08, (3.3, -2.7)), (0.91, (-13.3, 7.7)), (1.0, (0.5, 0.0))]
)
@pytest.mark.thorough
def test_scale_and_shift(scale, shift):
    """30 dB: the scale to 1e-4, the shift to 0.05 pixel, and within the errors claimed."""
    capture = noisy(5.0 + 2.0 * blobs(scale, shift), 0.03, 1)
    found = estimate_registration(capture, noisy(blobs(), 0.03, 2))
    assert (found.status, found.reasons) == ("ok", ())
    assert abs(float(found.scale) - scale) < min(2e-4, 4.5 * float(found.scale_error))
    assert abs(float(found.scale) - scale) < 1e-4
    off = np.abs(np.asarray(found.shift) - shift)
    assert np.all(off < 0.05)
    assert np.all(off < 4.5 * np.asarray(found.shift_error))
    assert float(found.shift_error.max()) < 0.02


@pytest.mark.thorough
def test_the_registered_reference_lies_on_the_capture():
    capture = blobs(1.05, (2.0, -3.0))
    found = estimate_registration(capture, blobs())
    inner = (slice(30, -30), slice(30, -30))
    np.testing.assert_allclose(found.registered[inner], capture[inner], atol=0.01)


@pytest.mark.thorough
def test_different_scenes_are_told():
    found = estimate_registration(blobs(seed=1), blobs(seed=2))
    assert found.status in ("poor_fit", "not_converged")
    assert any("correlate" in line for line in found.reasons)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"reference": np.ones((9, 9))}, "the capture"),
        ({"capture": np.ones(SHAPE)}, "1 in every pixel"),
        ({"capture": np.full(SHAPE, np.inf)}, "not finite"),
        ({"search": 0.7}, "too wide"),
        ({"scale": 0.0}, "not positive"),
        ({"capture": blobs()[:20], "reference": blobs()[:20]}, "at least 32"),
    ],
)
def test_refusals_take_one_line(change, message):
    with pytest.raises(ValueError, match=message) as caught:
        estimate_registration(**({"capture": blobs(), "reference": blobs()} | change))
    assert "\n" not in str(caught.value)
