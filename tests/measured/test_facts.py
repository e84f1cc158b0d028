"""What a raw file says of its sensor is used, and contradictions are refused."""

import logging

import numpy as np
import PIL.Image
import PIL.TiffImagePlugin
import pytest
import rawpy
import tifffile
from raw_files import BLACK, COLOURS, RNG, SHAPE, WHITE, dng

from thincam_jax.commands.reconstruct.options import Sources
from thincam_jax.commands.reconstruct.run import Inputs
from thincam_jax.imaging.encoding import ORIENTATION, upright
from thincam_jax.measured import MeasurementError, Preparation, Raw, prepare, read, read_image
from thincam_jax.measured.bayer import mosaic


@pytest.mark.parametrize("suffix", ["dng", "tif"])
@pytest.mark.parametrize("pattern", ["RGGB", "BGGR", "GRBG", "GBRG"])
@pytest.mark.parametrize("orientation", [1, 3, 6, 8])
def test_pattern_levels_and_orientation(tmp_path, suffix, pattern, orientation):
    path = tmp_path / f"a.{suffix}"
    path.write_bytes(dng(pattern, orientation))
    raw = read_image(path)
    assert (raw.bayer, raw.black_level, raw.white_level) == (pattern, BLACK, WHITE)
    assert (raw.bits, raw.full_scale) == (12, WHITE)
    expected = np.rint(mosaic(COLOURS, pattern)) + BLACK
    np.testing.assert_array_equal(raw.pixels, expected)


@pytest.mark.parametrize("suffix", ["dng", "tif"])
@pytest.mark.parametrize("pattern", ["RGGB", "GBRG"])
def test_black_levels_of_the_colours_are_made_one(tmp_path, suffix, pattern):
    """Pixels are raised to the highest level; saturated ones stay at the white level."""
    levels = np.array([[256, 250], [241, 256]])
    light = np.rint(np.where(COLOURS > 2500, WHITE, COLOURS))
    tile = np.tile(levels, (SHAPE[0] // 2, SHAPE[1] // 2))
    stored = np.minimum(mosaic(light, pattern) + tile, WHITE)
    more = [(50713, 3, 2, (2, 2), True)]
    given = {"black": tuple(levels.ravel().tolist()), "more": more}
    path = tmp_path / f"a.{suffix}"
    path.write_bytes(dng(pattern, light=np.stack([stored] * 3), **given))
    raw = read_image(path)
    assert (raw.bayer, raw.black_level, raw.white_level) == (pattern, 256, WHITE)
    expected = np.minimum(np.where(stored < WHITE, stored - tile + 256, WHITE), WHITE)
    np.testing.assert_array_equal(raw.pixels, expected)


@pytest.mark.parametrize("suffix", ["dng", "tif"])
def test_other_mosaics_are_refused_by_name(tmp_path, suffix):
    sites = (1, 1, 0, 1, 1, 2, 1, 1, 2, 1, 1, 0, 2, 0, 1, 0, 2, 1)
    sites += (1, 1, 2, 1, 1, 0, 1, 1, 0, 1, 1, 2, 0, 2, 1, 2, 0, 1)
    path = tmp_path / f"a.{suffix}"
    light = np.tile(COLOURS, (1, 16, 12))  # of smaller ones LibRaw interpolates no colours
    path.write_bytes(dng("RGGB", sites=sites, light=light))
    with pytest.raises(MeasurementError, match=r"X-Trans, 6×6 pixels.*rawpy\.imread") as caught:
        read_image(path)
    assert "\n" not in str(caught.value)
    if suffix == "dng":
        options = {"gamma": (1, 1), "no_auto_bright": True, "output_bps": 16}
        with rawpy.imread(str(path)) as file:
            np.save(tmp_path / "a.npy", file.postprocess(**options))
        assert read_image(tmp_path / "a.npy").channels == 3


@pytest.fixture
def files(tmp_path):
    point = np.zeros((3, *SHAPE))
    point[:, 14:20, 20:30] = 1500
    for name, light in (("psf", point), ("capture", COLOURS)):
        (tmp_path / f"{name}.dng").write_bytes(dng("BGGR", light=light))
    return tmp_path / "psf.dng", tmp_path / "capture.dng"


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"preparation": Preparation(bayer="RGGB")}, "pattern BGGR, but bayer = 'RGGB'; give BGGR"),
        ({"background": 64.0}, "black level of 256, not background = 64.0; give 256"),
        ({"bits": 14}, "bits = 14, but the file says 12 bit .white level 4095.; leave `bits` out"),
    ],
)
def test_contradictions_are_refused_with_both_values(files, given, message):
    psf, capture = files
    with pytest.raises(MeasurementError, match=message) as caught:
        Inputs(Sources(psf, **given)).prepare(capture)
    assert "\n" not in str(caught.value)


def test_facts_are_not_dropped_in_python(files):
    """`prepare` takes pattern and black level of the files, and refuses what contradicts them."""
    raws = [read_image(path) for path in files]
    with pytest.raises(MeasurementError, match="black level of 256, not a dark corner"):
        prepare(*raws, background="corner")
    found, given = (
        prepare(*raws),
        prepare(*raws, background=BLACK, options=Preparation(bayer="BGGR")),
    )
    assert found.capture.shape == (3, *SHAPE)
    np.testing.assert_array_equal(found.capture, given.capture)


@pytest.mark.parametrize("orientation", [3, 6])
def test_captures_are_turned_upright(tmp_path, orientation):
    pixels = RNG.integers(0, 4000, (24, 40), dtype=np.uint16)
    exif = PIL.Image.Exif()
    exif[ORIENTATION] = orientation
    PIL.Image.fromarray(pixels).save(tmp_path / "a.png", exif=exif)
    tags = [(ORIENTATION, 3, 1, orientation, True)]
    tifffile.imwrite(tmp_path / "a.tif", pixels, photometric="minisblack", extratags=tags)
    for name in ("a.png", "a.tif"):
        np.testing.assert_array_equal(
            read_image(tmp_path / name).pixels, upright(pixels, orientation)
        )


def test_nan_in_a_float_file_are_dead_pixels(tmp_path, caplog):
    pixels = RNG.random(SHAPE).astype(np.float32)
    holed = pixels.copy()
    holed[4, 5] = holed[20, 31] = np.nan
    psf = np.zeros(SHAPE, np.float32)
    psf[16:20, 24:30] = 1
    tifffile.imwrite(tmp_path / "psf.tif", psf)
    tifffile.imwrite(tmp_path / "a.tif", holed)
    np.save(tmp_path / "a.npy", holed)
    for name in ("a.tif", "a.npy"):
        with caplog.at_level(logging.WARNING):
            raw = read_image(tmp_path / name)
        assert f"{name}: 2 pixels are NaN or masked: taken as dead" in caplog.text
        found = Inputs(Sources(tmp_path / "psf.tif")).prepare(tmp_path / name)
        np.testing.assert_array_equal(found.valid[0], ~np.isnan(holed))
        assert found.log.capture.dead == 2
        assert not prepare(read_image(tmp_path / "psf.tif"), raw).valid.all()


def test_masked_arrays_and_infinite_values():
    raw = Raw(np.ma.masked_array(np.ones(SHAPE, np.uint16), np.eye(*SHAPE)))
    assert raw.dead is not None and raw.dead.sum() == 36
    assert (raw.bits, raw.pixels.dtype) == (16, np.uint16)
    for bad in (np.full(SHAPE, np.inf), np.full(SHAPE, np.nan)):
        with pytest.raises(MeasurementError, match="values are NaN or infinite; give finite ones"):
            Raw(bad)


@pytest.mark.parametrize("suffix", ["tif", "exif.tif", "png", "jpg", "dng", "broken.tif"])
@pytest.mark.filterwarnings("ignore::thincam_jax.measured.read.NonlinearWarning")
def test_exposure(tmp_path, suffix):
    """By TIFF's own tag and by EXIF; a number that is none is not taken."""
    path, pixels = tmp_path / f"a.{suffix}", np.full(SHAPE, 1000, np.uint16)
    eight, exif = PIL.Image.fromarray((pixels // 16).astype(np.uint8)), PIL.Image.Exif()
    if suffix == "dng":
        path.write_bytes(dng("RGGB", more=[(33434, 5, 1, (1, 250), True)]))
    elif suffix in ("png", "jpg"):
        exif[34665] = {33434: 0.004}
        eight.save(path, exif=exif)
    elif suffix == "exif.tif":
        tags = PIL.TiffImagePlugin.ImageFileDirectory_v2()
        tags.tagtype[34665], tags[34665] = 4, {33434: PIL.TiffImagePlugin.IFDRational(1, 250)}
        eight.save(path, tiffinfo=tags)
    else:
        time = (1, 0) if suffix == "broken.tif" else (1, 250)
        tifffile.imwrite(path, pixels, extratags=[(33434, 5, 1, time, True)])
    expected = None if suffix == "broken.tif" else pytest.approx(4e-3)
    assert read_image(path).exposure == expected


@pytest.mark.parametrize("card", ["EXPTIME =                4E-3 / s", "EXPOSURE=  0.004"])
def test_exposure_of_fits(monkeypatch, card):
    """Of its header, whatever reads its array."""
    header = b"".join(line.ljust(80).encode() for line in ("SIMPLE  =    T", card, "END"))
    monkeypatch.setattr(read, "read_array", lambda kind, data, key: np.ones(SHAPE))
    assert read._read_container("fits", None, header)[1] == {"exposure": 4e-3}
    assert read._read_container("mat", None, header)[1] == {}


def test_two_patterns(files):
    psf, capture = files
    psf.write_bytes(dng("RGGB"))
    with pytest.raises(MeasurementError, match=r"says the pattern BGGR and the PSF's .* RGGB"):
        Inputs(Sources(psf)).prepare(capture)
