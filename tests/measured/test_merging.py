"""One image of several exposures: as good as one that no exposure could show, or refused."""

from dataclasses import replace

import numpy as np
import pytest
from measured.test_examination import CAMERAS, DARK, SHAPE, counts, scene, seen

from thincam_jax.measured import MeasurementError, Raw
from thincam_jax.measured.merging import merge_images

TIMES = (1e-3, 4e-3, 16e-3)


def exposures(light, brightest, **how):
    """At `TIMES`; `brightest`: counts of the shortest."""
    return [counts(light, n, brightest * 4**n, **how) for n in range(3)]


def raws(images, times=TIMES, **facts):
    pairs = enumerate(zip(images, times, strict=True))
    return [Raw(image, 12, name=f"{n}.tif", exposure=t, **facts) for n, (image, t) in pairs]


def test_rate_of_each_pixel_and_what_all_saturate():
    """Unbiased to the brightest, with less noise than any one; order and names do not matter."""
    light = np.geomspace(1, 10_000, 90 * 116).reshape(SHAPE)
    images = exposures(light, 4500.0)
    merged = merge_images(raws(images)[::-1])
    full = np.all([image == 4095 for image in images], axis=0)
    assert full.any()
    np.testing.assert_array_equal(merged.pixels == 4095, full)
    expected = DARK + 4500 * light / light.max()
    error = (merged.pixels - expected)[~full & (expected < 3900)] / np.sqrt(
        9 + expected[~full & (expected < 3900)] - DARK
    )
    assert abs(error.mean()) < 0.02 and error.std() < 0.9
    assert (merged.pixels - expected)[:20].std() < 0.3 * (images[0] - expected)[:20].std()
    # The same counts in 16 bits that nobody told of: the plateau is saturation.
    untold = merge_images([replace(one, bits=None) for one in raws(images)])
    np.testing.assert_allclose(untold.pixels, merged.pixels)
    assert untold.saturation == 4095


def test_dark_frames_and_dead_pixels():
    """Each exposure has its own dark frame; pixels that are dead in one are so in the result."""
    light = CAMERAS["spots"](SHAPE, 1)
    current = np.zeros(SHAPE)
    current[::7, ::5] = 200.0  # counts in the shortest
    images = exposures(light, 900.0)
    dark = [Raw(np.minimum(DARK + current * 4**n, 4095).astype("u2"), 12) for n in range(3)]
    lit = [np.uint16(np.minimum(one + current * 4**n, 4095)) for n, one in enumerate(images)]
    holes = np.zeros(SHAPE, bool)
    holes[3, 4] = True
    given = raws(lit)
    given[1] = replace(given[1], dead=holes)
    plain = merge_images(raws(images), [float(DARK)] * 3)
    found = merge_images(given[::-1], dark[::-1])
    level = found.black_level
    assert level == pytest.approx(np.mean(dark[0].pixels))
    difference = (found.pixels - level) - (plain.pixels - DARK)
    assert np.abs(difference).max() < 12 and found.dead is not None
    np.testing.assert_array_equal(found.dead, holes)
    by_file = merge_images(raws(images, black_level=float(DARK)))
    np.testing.assert_array_equal(by_file.pixels, plain.pixels)


def test_equal_exposures_are_averaged():
    """They tell no black level, which is then found as of one image."""
    light = CAMERAS["spots"](SHAPE, 1)
    images = [counts(light, n, 3000.0) for n in range(4)]
    merged = merge_images(raws(images, (2e-3,) * 4))
    np.testing.assert_allclose(merged.pixels, np.mean(images, axis=0), rtol=1e-6)
    assert merged.black_level is None
    known = merge_images(raws(images, (2e-3,) * 4), [0.0] * 4)
    np.testing.assert_array_equal(known.pixels, merged.pixels)
    assert known.black_level == 0 and merged.exposure == 2e-3
    colours = zip(exposures(light, 900.0), exposures(light, 450.0), strict=True)
    two = merge_images(raws([np.stack(pair, -1) for pair in colours]))
    assert two.pixels.shape == (*SHAPE, 2) and two.black_level == pytest.approx(64, abs=0.5)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ("times", r"1.tif is 3\.\d+ times as bright as 0.tif.*exposed 2 times as long"),
        ("scene", r"alike by 0\.\d+, .*give linear images of one"),
        ("size", r"and .pixels, bits, pattern. .*; merge equal images"),
        ("zero", "have the exposures .0.0, .* whose files or `exposure`, as 4ms, say"),
    ],
)
def test_what_contradicts(change, message):
    light, times = CAMERAS["diffuser"](SHAPE, 1), list(TIMES)
    images = exposures(light, 200.0)
    if change == "scene":
        images[1] = counts(seen(scene(), light), 5, 800.0)
    elif change == "size":
        images[1] = images[1][:-2]
    else:
        times[1 if change == "times" else 0] = 2e-3 if change == "times" else 0.0
    with pytest.raises(MeasurementError, match=message):
        merge_images(raws(images, times))
