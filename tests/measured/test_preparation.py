"""The whole preparation against the same steps written out in float64."""

import math

import numpy as np
import pytest

from thincam_jax.measured import MeasurementError, Preparation, Raw, prepare

ROWS, COLUMNS = 24, 36
BLOCKS = Preparation(capture_scale="none", downsample=2)


def measured(*channels, bits=12, seed=11, shape=(ROWS, COLUMNS)):
    """Counts of an image with a dark corner, well below full scale."""
    generator = np.random.default_rng(seed)
    counts = generator.integers(60, 0.8 * 2**bits, (*shape, *channels))
    counts[:16, :16] = generator.integers(40, 60, (16, 16, *channels))
    return counts.astype(np.uint16)


def blocks(image, n):
    """Means of n × n blocks of (y, x), one slice of the rows and columns at a time."""
    return sum(image[i::n, j::n] for i in range(n) for j in range(n)) / n**2


def unit_sum(psf):
    return psf / psf.sum()


def test_one_channel_with_the_corner_as_background():
    psf, capture = measured(), measured(seed=12)
    found = prepare(Raw(psf, 12), Raw(capture, 12), options=Preparation(downsample=4))
    level = psf[5:15, 5:15].astype(float).mean()
    light = blocks(np.maximum(psf - level, 0), 4)
    image = blocks(np.maximum(capture - level, 0), 4) / 4095
    np.testing.assert_allclose(found.psf[0], unit_sum(light), rtol=1e-5, atol=1e-9)
    np.testing.assert_allclose(found.capture[0], image / image.max(), rtol=1e-5, atol=1e-7)
    np.testing.assert_allclose(found.log.capture_divisor, image.max(), rtol=1e-6)
    assert found.psf.dtype == found.capture.dtype == np.float32
    assert found.valid.all() and found.valid.shape == (1, 6, 9)
    np.testing.assert_allclose(found.log.capture.level, [level / 4095], rtol=1e-6)
    clipped = [int((a < level).sum()) for a in (psf, capture)]
    assert [one.clipped for one in (found.log.psf, found.log.capture)] == clipped
    assert min(clipped) > 0


def test_dark_frames_and_numbers():
    psf, capture, dark = measured(), measured(seed=12), measured(seed=13) // 8
    options = Preparation(capture_scale="none")
    found = prepare(Raw(psf, 12), Raw(capture, 12), background=Raw(dark, 12), options=options)
    expected = np.maximum(capture.astype(float) - dark, 0) / 4095
    np.testing.assert_allclose(found.capture[0], expected, rtol=1e-5, atol=1e-7)
    light = np.maximum(psf.astype(float) - dark, 0)
    np.testing.assert_allclose(found.psf[0], unit_sum(light), rtol=1e-5, atol=1e-9)
    found = prepare(
        Raw(psf, 12), Raw(capture, 12), background=50, options=options, psf_background=0
    )
    expected = np.maximum(capture.astype(float) - 50, 0) / 4095
    np.testing.assert_allclose(found.capture[0], expected, rtol=1e-5, atol=1e-7)
    np.testing.assert_allclose(found.psf[0], unit_sum(psf.astype(float)), rtol=1e-5)
    assert found.log.psf.background == "number" and found.log.psf.level == (0.0,)


@pytest.mark.parametrize("psf_sum", ["each", "joint"])
def test_colours_keep_their_places_and_sums(psf_sum):
    psf, capture = measured(3), measured(3, seed=12)
    options = Preparation(psf_sum=psf_sum, capture_scale="norm", downsample=2)
    found = prepare(Raw(psf, 12), Raw(capture, 12), background=40, options=options)
    light = np.stack([blocks(psf[..., c] - 40.0, 2) for c in range(3)])
    image = np.stack([blocks(capture[..., c] - 40.0, 2) for c in range(3)])
    sums = light.sum(axis=(1, 2), keepdims=True)
    light = light / (sums if psf_sum == "each" else sums.mean())
    np.testing.assert_allclose(found.psf, light, rtol=1e-5)
    np.testing.assert_allclose(found.capture, image / math.sqrt((image**2).sum()), rtol=1e-5)


def test_one_psf_for_all_channels():
    psf, capture = measured(3), measured(3, seed=12)
    found = prepare(
        Raw(psf, 12), Raw(capture, 12), background=0, options=Preparation(psf_channels="mean")
    )
    mean = psf.astype(float).mean(axis=2)
    np.testing.assert_allclose(found.psf, unit_sum(mean)[None], rtol=1e-5)
    assert found.capture.shape == (3, ROWS, COLUMNS)
    grey = prepare(Raw(psf[..., 0], 12), Raw(capture, 12))
    assert grey.psf.shape == (1, ROWS, COLUMNS) and grey.capture.shape[0] == 3
    averaged = prepare(
        Raw(psf, 12),
        Raw(capture[..., 0], 12),
        background=0,
        options=Preparation(psf_channels="mean"),
    )
    np.testing.assert_array_equal(averaged.psf, found.psf)
    with pytest.raises(MeasurementError, match="average the PSF's with `psf_channels='mean'`"):
        prepare(Raw(psf, 12), Raw(capture[..., 0], 12))
    advised = prepare(
        Raw(psf, 12),
        Raw(capture[..., 0], 12),
        background=None,
        options=Preparation(psf_channels="mean"),
    )
    assert list(advised.log.capture.level) == [pytest.approx(np.mean(advised.log.psf.level))]


def test_bayer_superpixel_and_blocks_are_plain_means():
    psf, capture = measured(), measured(seed=12)
    options = Preparation(
        bayer="GRBG", demosaicing="superpixel", downsample=3, capture_scale="none"
    )
    found = prepare(Raw(psf, 12), Raw(capture, 12), background=40, options=options)
    image = (capture - 40.0) / 4095
    red, blue = image[::2, 1::2], image[1::2, ::2]
    green = (image[::2, ::2] + image[1::2, 1::2]) / 2
    expected = np.stack([blocks(c, 3) for c in (red, green, blue)])
    np.testing.assert_allclose(found.capture, expected, rtol=1e-5)
    assert found.psf.shape == (3, 4, 6)


def test_saturated_pixels_spoil_all_that_they_enter():
    psf, capture = measured(), measured(seed=12)
    capture[5, 9] = 4095
    found = prepare(Raw(psf, 12), Raw(capture, 12), options=Preparation(downsample=4))
    assert np.argwhere(~found.valid).tolist() == [[0, 1, 2]]
    found = prepare(Raw(psf, 12), Raw(capture, 12), options=Preparation(bayer="RGGB"))
    expected = np.zeros((3, ROWS, COLUMNS), bool)  # (5, 9) is blue
    expected[2, 4:7, 8:11] = True
    np.testing.assert_array_equal(~found.valid, expected)
    assert found.log.capture.saturated == 1
    np.testing.assert_allclose(found.log.valid_share, 1 - 9 / expected.size)


def test_dead_pixels_are_left_out_of_means():
    psf, capture = measured(), measured(seed=12)
    dead = np.zeros((ROWS, COLUMNS), bool)
    dead[4, 8] = True
    dead[8:12, 20:24] = True  # a whole block
    capture[dead] = 4000
    options = Preparation(downsample=4, capture_scale="none")
    found = prepare(Raw(psf, 12), Raw(capture, 12), background=0, options=options, dead=dead)
    assert np.argwhere(~found.valid).tolist() == [[0, 2, 5]]
    block = capture[4:8, 8:12].astype(float)
    np.testing.assert_allclose(found.capture[0, 1, 2] * 4095, (block.sum() - 4000) / 15, rtol=1e-6)
    # The block that nobody measured is the mean of its four neighbours.
    for image in (found.capture[0], found.psf[0]):
        neighbours = [image[place] for place in ((1, 5), (3, 5), (2, 4), (2, 6))]
        assert image[2, 5] == pytest.approx(np.mean(neighbours), rel=1e-6)
    assert found.log.capture.dead == 17


@pytest.mark.parametrize("dtype", [np.float32, np.uint16])
@pytest.mark.parametrize("hole", [np.s_[:10, :10], np.s_[6:8, 8:14], np.s_[:, 7], np.s_[::6]])
def test_no_level_is_that_of_a_hole(dtype, hole):
    """Pixels without a value are between their neighbours: levels are those of the whole image."""
    y, x = np.indices((48, 60)) - 25.5
    psf = (64 + 3000 * np.exp(-(y**2 + x**2) / 90) + (y + x) % 5).astype(dtype)
    whole = Raw(psf, bits=12)
    mask = np.zeros(psf.shape, bool)
    mask[hole] = True
    holed = np.ma.masked_array(psf, mask)
    if dtype == np.float32:
        holed = np.where(mask, np.float32(np.nan), psf)
    found, capture = Raw(holed, bits=12), Raw(psf[::-1].copy(), bits=12)
    assert found.dead is not None and np.array_equal(found.dead, mask)
    levels = [prepare(one, capture).log for one in (whole, found)]
    assert levels[1].psf.level == pytest.approx(levels[0].psf.level, abs=2 / 4095)
    assert levels[1].capture.dead == 0 and levels[1].valid_share == 1
    light = prepare(found, capture).psf
    assert np.abs(light - prepare(whole, capture).psf).max() < 0.05 * light.max()


def test_noise_of_the_corner_sets_the_threshold():
    generator = np.random.default_rng(14)
    psf = np.zeros((96, 120))
    psf[50:60, 70:90] = 0.5
    psf += generator.normal(0.1, 0.01, psf.shape)
    options = Preparation(downsample=2, noise_threshold=5, corner=(0, 40))
    found = prepare(Raw(psf), Raw(psf), options=options)
    # Of 1600 samples: 2 % standard error.
    np.testing.assert_allclose(found.log.noise, [0.005], rtol=0.08)
    assert np.argwhere(found.psf[0]).min(axis=0).tolist() == [25, 35]
    assert np.count_nonzero(found.psf) == 5 * 10
    # A mosaic's colours may differ in level without that being noise.
    psf[::2, ::2] += 0.2
    mosaic = prepare(
        Raw(psf),
        Raw(psf),
        background=0,
        options=Preparation(bayer="RGGB", noise_threshold=5, corner=(0, 40)),
    )
    np.testing.assert_allclose(mosaic.log.noise, [0.01], rtol=0.08)


def test_centring_shifts_all_channels_alike():
    psf = np.full((ROWS, COLUMNS, 3), 10, np.uint16)
    psf[18, 20], psf[19, 20, 2] = 3000, 3500
    capture = measured(3, seed=12)
    found = prepare(
        Raw(psf, 12), Raw(capture, 12), background=10, options=Preparation(centre="peak")
    )
    assert found.log.centring.shift == (-6, -2)
    assert np.argwhere(found.psf[0]).tolist() == [[12, 18]]
    assert np.argwhere(found.psf[2]).tolist() == [[12, 18], [13, 18]]


def refused(message, psf, capture, background=None, options=None, **keywords):
    with pytest.raises(MeasurementError, match=message) as caught:
        prepare(psf, capture, background=background, options=options, **keywords)
    assert "\n" not in str(caught.value)


def test_images_that_do_not_belong_together():
    grey, colour = Raw(measured(), 12), Raw(measured(3), 12)
    small = Raw(measured()[:20], 12)
    refused("the PSF .* has 20×36 pixels and the capture .* 24×36", small, grey)
    refused("the PSF .* has 3 channels and the capture .* 1;", colour, grey)
    pair = Raw(measured(2), 12)
    refused("the PSF .* has 2 channels and the capture .* 3;", pair, colour)
    refused("capture .* has 3 channels, so it is no mosaic", grey, colour, None, bayer("RGGB"))
    tiny = Raw(measured()[:10, :10], 12)
    refused(r"corner = \(5, 15\) lies outside of the PSF of 10×10", tiny, tiny)
    dead = np.zeros((3, 4), bool)
    refused("dead pixels has 3×4 pixels and the capture 24×36", grey, grey, dead=dead)
    odd = Raw(measured()[:-1], 12)
    refused("'superpixel' joins 2×2 pixels and the PSF has 23×36", odd, odd, 0, bayer("GBRG"))
    refused("downsample = 30 is larger", grey, grey, 0, Preparation(downsample=30))


def bayer(pattern):
    return Preparation(bayer=pattern, demosaicing="superpixel")


def test_backgrounds_that_do_not_belong():
    grey = Raw(measured(), 12)
    refused(r"dark frame .* has shape \(20, 36\)", grey, grey, Raw(measured()[:20], 12))
    refused("dark frame .* has 16 bit and the psf 12 bit", grey, grey, Raw(measured()))
    floats = Raw(measured().astype(float))
    message = "PSF has an unknown full scale and the capture 12 bit.*same `bits`"
    refused(message, floats, grey, "corner")
    with pytest.warns(UserWarning, match="whose black may turn grey; a dark frame or a number"):
        log = prepare(floats, grey).log  # each level is its own
    prepare(floats, grey, background=40.0)  # as it advises
    assert (log.psf.background, log.capture.background) == ("corner", "found with the image")
    refused("background = nan: give a finite number", grey, grey, math.nan)


def blob(shape, pitch):
    """Two spots, irradiance at the pixels' centres; `pitch` in units of the larger pixels."""
    y, x = (pitch * (np.arange(n) - (n - 1) / 2) for n in shape)
    y, x = y[:, None], x[None, :]
    spots = np.exp(-((y - 2) ** 2 + x**2) / 8) + 0.5 * np.exp(-((y + 3) ** 2 + (x - 4) ** 2) / 12)
    return Raw(np.round(50_000 * spots).astype(np.uint16))


@pytest.mark.parametrize(("shape", "pitch"), [((50, 70), 0.5), ((30, 20), 1.25), ((24, 36), 1.0)])
def test_psf_of_other_pixels_is_brought_to_the_captures(shape, pitch):
    """Half as large or larger pixels, more or fewer of them: the same PSF on the capture's."""
    options = Preparation(psf_scale=pitch, corner=(0, 2))
    found = prepare(blob(shape, pitch), Raw(measured(bits=16)), background=0, options=options)
    whole = [max(n, int(k * pitch)) for n, k in zip((ROWS, COLUMNS), shape, strict=True)]
    assert found.capture.shape == (1, ROWS, COLUMNS) and found.psf.shape == (1, *whole)
    expected = blob(found.psf.shape[1:], 1.0).pixels.astype(float)
    assert found.log.psf_shape == tuple(whole)
    light = unit_sum(expected)
    assert np.abs(found.psf[0] - light).max() < 0.03 * light.max()


@pytest.mark.parametrize("downsample", [1, 2])
def test_psf_larger_than_the_capture_stays_whole(downsample):
    """A mask of which the sensor holds a seventh: all its open cells are kept, and centred."""
    mask, at = np.zeros((90, 70), np.uint16), np.array([[2, 45, 80], [3, 30, 66]])
    for row, column in at.T:
        mask[row - 1 : row + 2, column - 1 : column + 2] = 4000
    options = Preparation(psf_scale=0.8, corner=(5, 15), downsample=downsample)
    found = prepare(Raw(mask), Raw(measured(bits=16)), background=0, options=options)
    assert found.capture.shape == (1, ROWS // downsample, COLUMNS // downsample)
    assert found.psf.shape == (1, 72 // downsample, 56 // downsample)
    y, x = 0.8 * (at - (np.array([[90], [70]]) - 1) / 2)
    rows, columns = (np.arange(n) - (n - 1) / 2 for n in found.psf.shape[1:])
    near = np.hypot(rows[:, None, None] * downsample - y, columns[:, None] * downsample - x) < 5
    light = [found.psf[0][near[..., k]].sum() for k in range(3)]
    np.testing.assert_allclose(light, 1 / 3, atol=0.03)


def test_crop_leaves_the_psf_whole():
    options = Preparation(crop=((4, 20), (6, 36)), capture_scale="none", downsample=2)
    psf, capture = Raw(measured(), 12), Raw(measured(seed=12), 12)
    dead = np.zeros((ROWS, COLUMNS), bool)
    dead[4:6, 6:8] = True
    found, whole = (
        prepare(psf, capture, background=0, options=o, dead=dead) for o in (options, BLOCKS)
    )
    np.testing.assert_array_equal(found.psf, whole.psf)
    same = np.where(found.valid, whole.capture[:, 2:10, 3:18], found.capture)
    np.testing.assert_array_equal(found.capture, same)
    np.testing.assert_array_equal(found.valid, whole.valid[:, 2:10, 3:18])
    assert not found.valid[0, 0, 0]
    with pytest.raises(MeasurementError, match=r"lies outside of the capture of 24×36 pixels"):
        prepare(psf, capture, background=0, options=Preparation(crop=((0, 25), (0, 36))))


def test_black_images():
    grey, black = Raw(measured(), 12), Raw(np.zeros((ROWS, COLUMNS), np.uint16), 12)
    refused("the PSF is black in channel 0", black, grey, 0)
    refused("the capture is black", grey, black)
    refused("the PSF is black", grey, grey, 4095)
    dead = np.ones((ROWS, COLUMNS), bool)
    refused("the PSF has a channel of dead pixels only", grey, grey, dead=dead)
