"""What examination says of dirty captures and PSFs, that its advice gains, and of clean ones."""

from dataclasses import replace

import numpy as np
import pytest
import scipy.ndimage
import scipy.signal

import thincam_jax as tc
from helpers import quick
from thincam_jax.imaging.defects import stuck
from thincam_jax.measured import Preparation, Raw, prepare
from thincam_jax.measured.bayer import mosaic
from thincam_jax.measured.examination import defective_pixels, examine
from thincam_jax.studies.prepared import pixel_noise, reconstruct_prepared

SHAPE, DARK = (90, 116), 64


def zones(shape=SHAPE, seed=0):
    """A zone plate that fills the sensor."""
    y, x = (np.arange(n) - (n - 1) / 2 for n in shape)
    return 0.5 + 0.5 * np.cos(0.012 * (y[:, None] ** 2 + x**2) + seed)


def cells(shape=SHAPE, seed=0, share=0.5, size=1, border=16):
    """Random cells, down to one pixel."""
    sides = [-(-n // size) for n in shape]
    open_ = (np.random.default_rng(seed).random(sides) < share).astype(float)
    whole = np.kron(open_, np.ones((size, size)))[: shape[0], : shape[1]]
    return np.pad(whole[border:-border, border:-border], border)


def spots(shape=SHAPE, seed=0, blur=1.0):
    """Points of light in the middle half, blurred or as fine as a pixel."""
    generator = np.random.default_rng(seed)
    points = np.zeros(shape)
    places = tuple(generator.integers(n // 4, 3 * n // 4, 24) for n in shape)
    points[places] = generator.uniform(0.5, 1, 24)
    return scipy.ndimage.gaussian_filter(points, blur) if blur else points


def diffuser(shape=SHAPE, seed=0):
    """Caustics of a smooth random surface."""
    height = scipy.ndimage.gaussian_filter(np.random.default_rng(seed).normal(size=shape), 4)
    slopes = np.gradient(height / height.std())
    light = np.zeros(shape)
    for shift in np.linspace(-0.5, 0.5, 8):
        rays = [n + shift + 25 * s for n, s in zip(np.indices(shape), slopes, strict=True)]
        places = [np.round(r).astype(int) % n for r, n in zip(rays, shape, strict=True)]
        np.add.at(light, tuple(places), 1)
    return scipy.ndimage.gaussian_filter(light, 0.7)


CAMERAS = {
    "zones": zones,
    "fine cells": cells,
    "sparse cells": lambda s, n: cells(s, n, 0.1),
    "coarse cells": lambda s, n: cells(s, n, 0.5, 3),
    "spots": spots,
    "sharp spots": lambda s, n: spots(s, n, 0.5),
    "pinholes": lambda s, n: spots(s, n, 0.0),
    "diffuser": diffuser,
}


def scene(shape=SHAPE, seed=0):
    """Discs and fine bars, or points."""
    generator, (y, x) = np.random.default_rng(100 + seed), np.indices(shape)
    image = np.zeros(shape)
    if seed % 3 == 2:
        image[tuple(generator.integers(0, n, 15) for n in shape)] = generator.uniform(0.2, 1, 15)
        return image
    for _ in range(5):
        row, column = (generator.uniform(0.3, 0.7) * n for n in shape)
        image += ((y - row) ** 2 + (x - column) ** 2 < generator.uniform(4, 14) ** 2) / 3
    return image + 0.4 * ((x // 3) % 2) * (abs(y - shape[0] // 2) < 9) * (x > 30) * (x < 80)


def seen(image, psf):
    first = [n // 2 for n in psf.shape]
    light = scipy.signal.fftconvolve(image, psf / psf.sum())
    return light[first[0] : first[0] + image.shape[0], first[1] : first[1] + image.shape[1]]


def counts(light, seed=0, full=3600.0, noise=3.0, bits=12, gain=1.0):
    """Photon and read noise of a camera; `full`: brightest count above the dark level."""
    generator = np.random.default_rng(seed)
    light = generator.poisson(np.maximum(light / light.max(), 0) * full / gain) * gain
    light = np.round(DARK * 2.0 ** (bits - 12) + light + noise * generator.normal(size=light.shape))
    return np.clip(light, 0, 2**bits - 1).astype(np.uint16)


def names(examination):
    return {one.name for one in examination.findings}


def image_of(psf, capture, background: float = DARK, options=None, iterations=40):
    """The command's image: examined, mended, prepared, reconstructed."""
    examined = examine([capture], psf, options)
    assert examined.psf is not None
    return plain_image(examined.psf, examined.captures[0], background, options, iterations)


def plain_image(psf, capture, background: float = DARK, options=None, iterations=40):
    ready = prepare(psf, capture, background=background, options=options)
    solver = tc.AdmmTV(iterations=iterations)
    return reconstruct_prepared(ready, solver, pixel_noise(ready)).image()


def quality(image, true):
    """PSNR at the best scale, dB."""
    image = image * np.vdot(image, true) / np.vdot(image, image)
    return 10 * np.log10(true.max() ** 2 / np.mean((image - true) ** 2))


@pytest.mark.parametrize("camera", list(CAMERAS))
def test_clean_captures(camera):
    """104 of eight cameras, three depths, colours: at most that a PSF is cut, as some are."""
    for n in range(13):
        shape, bits = ((90, 116), (84, 131))[n % 2], (8, 10, 12)[n % 3]
        full = (2**bits - 1) * (0.9, 0.4, 0.1)[n // 2 % 3]
        how = {"bits": bits, "noise": 2**bits * (3e-4, 1e-3, 4e-3)[n // 3 % 3]}
        how["gain"] = 2 ** (bits - 12) * (1.0, 3.0)[n % 2]
        psf, options = CAMERAS[camera](shape, n), None
        light = seen(scene(shape, n), psf)
        if n % 4 == 3:
            options = Preparation(bayer="RGGB")
            light = mosaic(np.stack([0.5 * light, light, 0.7 * light]), "RGGB")
            psf = mosaic(np.stack([0.6 * psf, psf, 0.8 * psf]), "RGGB")
        pair = counts(light, n, full, **how), counts(psf, 50 + n, full, **how)
        capture, psf = (Raw(image, bits) for image in pair)
        assert names(examine([capture], psf, options)) <= {"cut"}, (camera, n)


@pytest.mark.parametrize(
    ("scale", "images"),
    [
        *((1, False), (16, False), (1 / 4095, False), (0.3, True)),
        *(pytest.param(s, True, marks=pytest.mark.thorough) for s in (1, 16, 1 / 4095)),
    ],
)
def test_saturation_at_any_value(scale, images):
    """12 bits at the lower or upper end of 16, floats that end at 1 or anywhere: as `bits=12`."""
    true, psf = scene(), cells(size=3)
    light = seen(true, psf)
    level = 4031 / np.quantile(light / light.max(), 0.87)
    capture, psf = counts(light, full=level), counts(psf, 1)
    assert 0.1 < np.mean(capture == 4095) < 0.15
    kind = np.uint16 if scale >= 1 else np.float32
    given = [Raw((image * scale).astype(kind)) for image in (psf, capture)]
    found = examine(given[1:], given[0])
    (one,) = (one for one in found.findings if one.name == "plateau")
    assert one.number == pytest.approx(100 * np.mean(capture == 4095), rel=1e-3)
    assert "overexposed" in names(found)
    # The advice, followed, gives the same.
    words = one.advice.removesuffix(" to say so").split()[1:]
    said = dict(zip(words[::2], words[1::2], strict=True))
    bits = int(said["--bits"]) if "--bits" in said else None
    share = float(said["--saturation"]) if "--saturation" in said else None
    advised = [Raw(raw.pixels, bits) for raw in given]
    options = Preparation(saturation=share)
    assert "plateau" not in names(examine(advised[1:], advised[0], options))
    if not images:
        return
    best = quality(plain_image(Raw(psf, 12), Raw(capture, 12))[0], true)
    mended = quality(image_of(*given, background=DARK * scale)[0], true)
    ignored = quality(plain_image(*given, background=DARK * scale)[0], true)
    assert mended > best - 0.1 and mended > ignored + 1.5
    image = plain_image(*advised, background=DARK * scale, options=options)[0]
    assert quality(image, true) == pytest.approx(mended, abs=0.05)


def test_overexposed_psf():
    """Its plateau is severe; one that was exposed less has none and gives a better image."""
    true, light = scene(), spots()
    capture = Raw(counts(seen(true, light)), 12)
    flat, right = (Raw(counts(light, 1, full), 12) for full in (20_000, 3600))
    assert not examine([capture], right).findings
    for given in (flat, Raw(flat.pixels)):  # at full scale, announced or not
        said = examine([replace(capture, bits=given.bits)], given).findings
        (one,) = (one for one in said if one.name == "flat")
        assert one.severe and "expose less" in one.advice
    assert (
        quality(image_of(right, capture)[0], true) > quality(image_of(flat, capture)[0], true) + 1
    )


@pytest.mark.parametrize("camera", quick(["spots", "coarse cells", "diffuser", "zones"], 0, 3))
def test_hot_pixels(camera):
    """15 in PSF and capture: within 0.3 dB of none, of those that matter."""
    true, light = scene(), CAMERAS[camera](SHAPE, 1)
    psf, capture = counts(light, 1), counts(seen(true, light), 2)
    places = np.random.default_rng(3).choice(psf.size, 15, replace=False)
    hot = [image.copy() for image in (psf, capture)]
    for image in hot:
        image.flat[places] = 4095
    clean = quality(image_of(Raw(psf, 12), Raw(capture, 12))[0], true)
    given = Raw(hot[0], 12), Raw(hot[1], 12)
    assert quality(image_of(*given)[0], true) > clean - 0.3
    found = examine(given[1:], given[0])
    (one,) = (one for one in found.findings if one.name == "defective")
    # Of light that fills the sensor some are within the noise of their neighbours.
    assert one.number >= (9 if camera == "zones" else 14) and found.captures[0].dead is not None
    assert not found.captures[0].dead.ravel()[np.delete(np.arange(psf.size), places)].any()
    if camera == "spots":
        assert "replaced" in names(found)
        assert quality(plain_image(*given)[0], true) < clean - 2


def test_defects_of_several_captures_and_of_a_mosaic():
    """At one place in most of them; in a mosaic among the pixels of one colour."""
    captures = [counts(seen(scene(seed=n), spots()), n) for n in (0, 1, 3)]
    for image in captures:
        image[70, 20] = 4095
    captures[0][75, 100] = 4095  # a cosmic ray
    dead = [raw.dead for raw in examine([Raw(image, 12) for image in captures]).captures]
    for one in dead:
        assert one is not None and np.argwhere(one).tolist() == [[70, 20]]
    light = seen(scene(), spots())
    raw = counts(mosaic(np.stack([0.2 * light, light, 0.5 * light]), "RGGB"))
    raw[40, 50], raw[41, 51] = 3000, 0
    found = examine([Raw(raw, 12)], options=Preparation(bayer="RGGB")).captures[0].dead
    assert found is not None and found[40, 50]
    colours = np.stack([captures[1]] * 3, axis=-1)
    colours[40, 50, 1:] = 60
    assert defective_pixels(Raw(colours, 12))[40, 50]


def test_mosaic_that_nobody_told_of():
    """Told without and with a pattern; the advice takes the grid away."""
    true, psf = scene(), cells(size=3)
    colours = np.stack([0.5 * true, true, 0.7 * true])
    capture = Raw(counts(mosaic(np.stack([seen(c, psf) for c in colours]), "GRBG")), 12)
    light = Raw(counts(mosaic(np.stack([0.5 * psf, psf, 0.7 * psf]), "GRBG"), 1), 12)
    found = examine([capture], light)
    (one,) = (o for o in found.findings if o.name == "mosaic" and o.where.startswith("capture"))
    assert one.severe and one.advice == "give --bayer GRBG or GBRG"
    given = Preparation(bayer="GRBG")
    assert not names(examine([capture], light, given)) & {"mosaic", "no mosaic"}
    coloured = image_of(light, capture, options=given).mean(axis=0)
    assert quality(coloured, true) > quality(image_of(light, capture)[0], true) + 0.3
    grey = Raw(counts(seen(true, psf)), 12)
    found = examine([grey], Raw(counts(psf, 1), 12), given)
    assert [one.advice for one in found.findings] == ["leave --bayer out"]
    assert not examine([grey], Raw(counts(psf, 1), 12)).findings


@pytest.mark.parametrize("camera", list(CAMERAS))
def test_swapped(camera):
    """Severe, and not the other way round."""
    light = CAMERAS[camera](SHAPE, 2)
    psf, capture = Raw(counts(light, 1), 12), Raw(counts(seen(scene(), light)), 12)
    (one,) = (one for one in examine([psf], capture).findings if one.name == "swapped")
    assert one.severe and one.advice == "exchange --psf and --capture"
    assert not names(examine([capture], psf)) & {"swapped", "same"}
    (one,) = (one for one in examine([psf], psf).findings if one.name == "same")
    assert one.severe


def test_a_map_that_marks_nothing():
    psf, capture = (Raw(counts(spots(), n), 12, dead=np.zeros(SHAPE, bool)) for n in (1, 2))
    assert not names(examine([capture], psf))


def test_lines_of_one_value():
    """Columns at 0 and a row at full scale are found; dark borders and rows of a code are not."""
    rng = np.random.default_rng(3)
    code = np.kron(rng.random((12, 15)) < 0.5, np.ones((4, 4)))
    code[20:24] = 0
    image = np.pad(100.0 * code, 6)
    assert not stuck(image).any()
    light = 50 + 20 * rng.random((60, 72))
    light[:, 30:32], light[41] = 0, 255
    light[41, 30:32] = 0
    marked = stuck(light)
    expected = np.zeros_like(marked)
    expected[:, 30:32] = True
    np.testing.assert_array_equal(marked, expected)
    light[41, 30:32] = 255
    light[41:42, 30:32] = 255
    assert stuck(light)[41].all()


@pytest.mark.parametrize("level", [DARK, 0])
@pytest.mark.parametrize("value", [0, 4095])
@pytest.mark.parametrize("camera", ["spots", "sharp spots", "coarse cells", "diffuser", "zones"])
def test_blocks_of_one_value(camera, value, level):
    """4×4 pixels that nobody told, in captures above any black level."""
    light = seen(scene(), CAMERAS[camera](SHAPE, 1))
    image = np.maximum(counts(light, 1).astype(int) - DARK + level, 0).astype(np.uint16)
    assert not defective_pixels(Raw(image, 12)).any()
    image[30:34, 40:44], expected = value, np.zeros(SHAPE, bool)
    expected[30:34, 40:44] = True
    np.testing.assert_array_equal(defective_pixels(Raw(image, 12)), expected)


@pytest.mark.parametrize("camera", quick(["spots", "sharp spots", "diffuser"], 1))
def test_a_bright_block_in_a_psf(camera):
    """It is filled: within 0.3 dB, from up to 12. Spots that saturate are none."""
    true, light = scene(), CAMERAS[camera](SHAPE, 1)
    psf, capture = counts(light, 1), Raw(counts(seen(true, light), 2), 12)
    clean = quality(image_of(Raw(psf, 12), capture)[0], true)
    psf[45:49, 60:64] = 4095
    assert quality(image_of(Raw(psf, 12), capture)[0], true) > clean - 0.3
    for full in (4000, 6000, 10_000, 40_000):
        assert not stuck(counts(light, 1, full).astype(float), 1.0).any()


def test_exposure_and_border():
    light = seen(scene(), zones())
    dim = Raw(counts(light, full=40), 12)
    right, psf = Raw(counts(light), 12), Raw(counts(zones(), 1), 12)
    assert names(examine([dim])) == {"underexposed"} and not examine([right]).findings
    (one,) = examine([right], psf).findings
    assert one.name == "cut" and one.where == "PSF the array" and not one.severe
    computed = replace(psf, sensor_shape=SHAPE)
    assert not examine([right], computed).findings
    small = Raw(psf.pixels[:5, :5], 12)
    assert not names(examine([small], small)) & {"defective", "mosaic", "swapped"}
