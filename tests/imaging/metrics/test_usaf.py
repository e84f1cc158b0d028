"""Contrast and resolution on charts blurred by kernels whose effect is known in closed form."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter, uniform_filter1d
from scipy.special import erf

from thincam_jax.imaging.metrics.usaf import resolved_element, usaf_contrast
from thincam_jax.imaging.targets import usaf1951
from thincam_jax.imaging.targets.usaf import usaf1951_elements

ELEMENTS = usaf1951_elements(3)
ONE_LAYER = usaf1951_elements(1)


def blurred_level(centre, sigma):
    """A Gaussian-blurred set, averaged over half a bar at `centre` and along it; in bar widths."""
    x = centre + np.linspace(-0.25, 0.25, 2001)
    edges = [(-2.5, -1.5), (-0.5, 0.5), (1.5, 2.5)]
    scale = np.sqrt(2) * sigma
    across = sum(np.mean(erf((b - x) / scale) - erf((a - x) / scale)) / 2 for a, b in edges)
    y = np.linspace(-2, 2, 2001)  # 80 % of the length
    return across * np.mean(erf((2.5 - y) / scale) + erf((2.5 + y) / scale)) / 2


def expected(sigma, bar, gain, offset):
    """(contrast, modulation) of a set with bars of `bar` pixels, after the alignment.

    The pixels' width and the linear interpolation between them add to the blur's variance.
    """
    sigma = np.sqrt(sigma**2 + 1 / 12 + 1 / 6) / bar
    levels = gain * np.array([blurred_level(c, sigma) for c in (-2, -1, 0, 1, 2)]) + offset
    bars, gaps = levels[::2], levels[1::2]
    contrast = (bars.mean() - gaps.mean()) / (bars.mean() + gaps.mean())
    return contrast, bars.min() - gaps.max()


def by_label(records):
    return {(r.element.group, r.element.element, r.element.orientation): r for r in records}


@pytest.mark.parametrize("polarity", ["bright_on_dark", "dark_on_bright"])
def test_the_ideal_chart_has_full_contrast_in_any_unit(polarity):
    chart = usaf1951((1000, 930), layers=1, polarity=polarity, pixels_per_chart=900)
    for record in usaf_contrast(300 * chart + 40, ONE_LAYER, 900, polarity=polarity):
        assert record.contrast == pytest.approx(1.0, abs=1e-9)
        assert record.modulation == pytest.approx(1.0, abs=1e-9)


def test_the_ideal_chart_is_resolved_to_nyquist():
    """A bar of exactly one pixel: group 0, element 1 on 128 pixels, an octave finer on 256."""
    for pixels, group in [(128, 0), (256, 1), (512, 2)]:
        chart = usaf1951((pixels, pixels + 38))
        finest = resolved_element(usaf_contrast(chart, ELEMENTS, pixels))
        assert (finest.group, finest.element) == (group, 1)
        assert finest.bar * pixels == pytest.approx(1.0)


@pytest.mark.parametrize("sigma", [4.0, 6.0])
def test_gaussian_blur_gives_the_analytic_contrast(sigma):
    """Sets stay clear of each other while the blur is less than half a bar."""
    width = 512
    chart = usaf1951((width, width + 64), layers=1)
    blurred = gaussian_filter(chart, sigma, truncate=6)
    gain, offset = np.polyfit(blurred.ravel(), chart.ravel(), 1)
    checked = 0
    for record in usaf_contrast(7.0 * blurred + 2.0, ONE_LAYER, width):
        relative = sigma / (record.element.bar * width)
        if relative < 0.5:
            contrast, modulation = expected(sigma, record.element.bar * width, gain, offset)
            assert record.contrast == pytest.approx(contrast, abs=5e-3)
            assert record.modulation == pytest.approx(modulation, abs=5e-3)
            checked += 1
    assert checked >= 6


@pytest.mark.parametrize("sigma", [2.0, 3.0, 4.2, 6.0])
def test_blur_sets_the_finest_element(sigma):
    """The finest element is the last whose analytic modulation is above the threshold."""
    width = 512
    chart = usaf1951((width + 30, width), layers=2)
    blurred = gaussian_filter(chart, sigma, truncate=6)
    gain, offset = np.polyfit(blurred.ravel(), chart.ravel(), 1)
    elements = [e for e in usaf1951_elements(2) if e.orientation == "vertical"]
    above = [e for e in elements if expected(sigma, e.bar * width, gain, offset)[1] >= 0.25]
    predicted = min(above, key=lambda e: e.bar)
    records = usaf_contrast(blurred, usaf1951_elements(2), width)
    assert resolved_element(records, threshold=0.25) == predicted
    assert resolved_element(records, threshold=0.1).bar < predicted.bar


def test_blur_along_one_axis_spoils_the_bars_across_it():
    """Blur along x leaves the horizontal bars alone, up to their ends, and the other way round."""
    chart = usaf1951((256, 300), layers=1)
    for sigma, spoiled, spared in [
        ((0, 5), "vertical", "horizontal"),
        ((5, 0), "horizontal", "vertical"),
    ]:
        records = by_label(usaf_contrast(gaussian_filter(chart, sigma), ONE_LAYER, 256))
        assert records[-1, 1, spoiled].modulation < 0.1
        assert records[-1, 1, spared].modulation > 0.6


def box_blur(image, pixels):
    """Mean along x over a centred box of an even number of pixels: half of both end pixels."""
    wide, narrow = (uniform_filter1d(image, n, axis=1) * n for n in (pixels + 1, pixels - 1))
    return (wide + narrow) / (2 * pixels)


def test_contrast_reversal_is_negative():
    """A box three bars wide: 1/3 at the middle of a bar and 2/3 of a gap, with kinks there.

    Averaged over half a bar, 1/3 + 1/24 at the middle bar, 1/3 + 1/48 at the outer ones, which
    have a slope on one side only, and 2/3 - 1/24 at the gaps.
    """
    chart = usaf1951((512, 640), layers=1)
    blurred = box_blur(chart, 3 * 16)  # group -2, element 1 has bars of 16 pixels
    gain, offset = np.polyfit(blurred.ravel(), chart.ravel(), 1)
    record = by_label(usaf_contrast(blurred, ONE_LAYER, 512))[-2, 1, "vertical"]
    bars, gaps = gain * (1 / 3 + 1 / 36) + offset, gain * (2 / 3 - 1 / 24) + offset
    assert gain > 0
    assert record.modulation == pytest.approx(gain * (1 / 48 + 1 / 24 - 1 / 3), abs=5e-3)
    assert record.contrast == pytest.approx((bars - gaps) / (bars + gaps), abs=5e-3)


def test_a_zero_crossing_ends_the_search():
    """Boxes three and five bars of group 0, element 1 wide: reversed there, or upright again."""
    chart = usaf1951((512, 640), layers=2)
    elements = usaf1951_elements(2)
    for bars, contrast_sign in [(3, -1), (5, +1)]:
        box = 4 * bars  # pixels
        records = usaf_contrast(box_blur(chart, box), elements, 512)
        record = by_label(records)[0, 1, "vertical"]
        assert np.sign(record.contrast) == contrast_sign
        finest = resolved_element(records)
        assert 1 < finest.bar * 512 / (box / 2) < 1.5  # the first zero: the box is a period wide


def test_spurious_resolution_beyond_a_reversal_does_not_count():
    """Group 0 is averaged away, so the sharp group 1 beyond it must not be reported."""
    chart = usaf1951((512, 560), layers=2)
    records = usaf_contrast(chart, usaf1951_elements(2), 512)
    assert resolved_element(records).group == 1
    lost = [
        type(r)(r.element, -0.3, -0.3)
        if (r.element.group, r.element.element, r.element.orientation) == (0, 3, "horizontal")
        else r
        for r in records
    ]
    finest = resolved_element(lost[::-1])  # in any order
    assert (finest.group, finest.element) == (0, 2)


def test_a_negative_image_is_reversed_not_resolved():
    chart = usaf1951((256, 280), layers=1)
    for record in usaf_contrast(1.0 - chart, ONE_LAYER, 256):
        assert record.modulation < -0.6
        assert record.contrast < -0.6
    assert resolved_element(usaf_contrast(1.0 - chart, ONE_LAYER, 256)) is None
    right = usaf_contrast(1.0 - chart, ONE_LAYER, 256, polarity="dark_on_bright")
    assert (resolved_element(right).group, resolved_element(right).element) == (-1, 6)


def test_a_uniform_image_resolves_nothing():
    records = usaf_contrast(np.full((130, 128), 0.7), ELEMENTS, 128)
    assert {(r.contrast, r.modulation) for r in records} == {(0.0, 0.0)}
    assert resolved_element(records) is None


def test_a_wrong_size_of_the_chart_is_noticed():
    chart = usaf1951((300, 340), layers=1, pixels_per_chart=256.0)
    right = resolved_element(usaf_contrast(chart, ONE_LAYER, 256.0))
    wrong = resolved_element(usaf_contrast(chart, ONE_LAYER, 128.0))
    assert right.group == -1
    assert wrong is None
