"""What people hand over, a row each: the default is within 1 dB of what was possible, or says why.

Each row makes its files, gives them to `thincam reconstruct` as a newcomer would, and again with
what the lab knows. Rows that are not as good name the option or the fault that decides.
"""

import json
import warnings
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import PIL.Image
import pytest
import tifffile
from measured.test_containers import WRITERS, packed
from measured.test_examination import cells, counts, diffuser, quality, scene, seen, spots, zones
from raw_files import dng
from skimage.data import chelsea
from typer.testing import CliRunner

import thincam_jax as tc
from helpers import quick
from thincam_jax.commands import cli
from thincam_jax.imaging.encoding import ORIENTATION
from thincam_jax.units import nm, um

SHAPE, DARK, FULL = (96, 128), 64, 4095
TRUE = scene(SHAPE)
WITHIN = 1.0  # dB


@pytest.fixture
def image_of(tmp_path):
    """Image of files by `thincam reconstruct`, with options, and the names of its findings."""

    def reconstruct(*options, **arrays):
        for name, array in arrays.items():
            tifffile.imwrite(tmp_path / f"{name}.tif", array)
        words = {"--psf": tmp_path / "psf.tif", "--capture": tmp_path / "capture.tif"}
        words |= {"--out": tmp_path / "image.npy", "--iterations": 60}
        words |= dict(zip(options[::2], options[1::2], strict=True))
        call = ["reconstruct", *(str(word) for pair in words.items() for word in pair)]
        with warnings.catch_warnings(record=True) as told:
            warnings.simplefilter("always")
            result = CliRunner().invoke(cli.app, call)
        if result.exit_code:
            assert isinstance(result.exception, SystemExit), result.exception
            raise ValueError(result.stderr.strip().splitlines()[-1])
        record = json.loads((tmp_path / "image.json").read_text("utf-8"))
        image = np.atleast_3d(np.load(tmp_path / "image.npy")).mean(axis=2)
        first = [(n - m) // 2 for n, m in zip(image.shape, SHAPE, strict=True)]
        middle = image[first[0] : first[0] + SHAPE[0], first[1] : first[1] + SHAPE[1]]
        said = {one["name"]: one for one in record["examination"]}
        return middle, said | {str(one.message): None for one in told}

    return reconstruct


def pair(light, full=3600.0):
    """Capture of the scene and its PSF, 12 bit above a black level of 64."""
    return {"psf": counts(light, 1), "capture": counts(seen(TRUE, light), 2, full)}


@pytest.mark.thorough
@pytest.mark.parametrize("camera", [zones, diffuser])
def test_light_that_fills_the_sensor(image_of, camera):
    """No corner is dark: the level is found."""
    given = pair(camera(SHAPE))
    best = quality(image_of("--background", DARK, "--bits", 12, **given)[0], TRUE)
    assert quality(image_of()[0], TRUE) > best - WITHIN


@pytest.mark.thorough
@pytest.mark.parametrize("stored", ["low", "high", "float", "other"])
def test_twelve_bits_that_nobody_told(image_of, stored):
    """13 % of the pixels are at the top."""
    light = cells(SHAPE, size=3)
    view = seen(TRUE, light)
    given = pair(light, (FULL - DARK) / np.quantile(view / view.max(), 0.87))
    best = quality(image_of("--background", DARK, "--bits", 12, **given)[0], TRUE)
    scale = {"low": 1, "high": 16, "float": np.float32(1 / FULL), "other": np.float32(0.3)}[stored]
    image, said = image_of(**{name: one * scale for name, one in given.items()})
    assert quality(image, TRUE) > best - WITHIN and "plateau" in said


@pytest.mark.thorough
@pytest.mark.parametrize("bits", [(), ("--bits", 12)])
@pytest.mark.parametrize("share", [0.42, 0.6])
def test_an_overexposed_psf(image_of, share, bits):
    """Of its bright pixels: said; two exposures are merged."""
    light = spots(SHAPE)
    given = pair(light)
    best = quality(image_of("--background", DARK, "--bits", 12, **given)[0], TRUE)
    bright = light[light > 0.1 * light.max()] / light.max()
    full = (FULL - DARK) / np.quantile(bright, 1 - share)
    image, said = image_of(*bits, psf=counts(light, 1, full))
    assert quality(image, TRUE) > best - WITHIN or said["flat"]["severe"]


def test_a_raw_file_says_pattern_and_levels(tmp_path, image_of):
    """Pattern BGGR, black level 256: by default as by its own numbers; others are refused."""
    light, weights = spots(SHAPE), np.array([0.5, 1.0, 0.3])[:, None, None]
    for name, image in (("psf", light), ("capture", seen(TRUE, light))):
        planes = weights * 3000 * image / image.max()
        (tmp_path / f"{name}.dng").write_bytes(dng("BGGR", light=planes))
    files = "--psf", tmp_path / "psf.dng", "--capture", tmp_path / "capture.dng"
    best = quality(image_of(*files, "--bayer", "BGGR", "--background", 256)[0], TRUE)
    assert quality(image_of(*files)[0], TRUE) > best - WITHIN
    assert best > 20 and np.load(tmp_path / "image.npy").shape[-1] == 3
    for wrong in (("--bayer", "RGGB"), ("--background", 64), ("--bits", 14)):
        with pytest.raises(ValueError, match="give BGGR|give 256|leave --bits out"):
            image_of(*files, *wrong)


HOLES = {
    "block": np.s_[40:42, 60:63],
    "square": np.s_[30:42, 60:72],
    "corner": np.s_[:16, :16],
    "column": np.s_[:, 70],
    "columns": np.s_[:, 70:73],
    "stripes": np.s_[::8],
    "border": np.s_[:2],
}


@pytest.mark.thorough
@pytest.mark.parametrize("hole", HOLES)
@pytest.mark.parametrize("camera", [spots, diffuser])
def test_pixels_without_a_value(tmp_path, image_of, camera, hole):
    """NaN in a PSF, a capture or a dark frame were black, and so was the level found there."""
    given = {name: one.astype(np.float32) for name, one in pair(camera(SHAPE)).items()}
    best = quality(image_of(**given)[0], TRUE)
    dark = (DARK + 3 * np.random.default_rng(5).normal(size=SHAPE)).astype(np.float32)
    for name in ("psf", "capture", "dark"):
        holed = {**given, "dark": dark}
        holed[name] = holed[name].copy()
        holed[name][HOLES[hole]] = np.nan
        shown = "--background", tmp_path / "dark.tif"
        image, said = image_of(*(shown if name == "dark" else ()), **holed)
        assert quality(image, TRUE) > best - WITHIN, name
        assert name != "psf" or said["unknown"]["number"] == np.isnan(holed["psf"]).sum()


DEAD = {
    "column": np.s_[:, 61],
    "columns": np.s_[:, 61:63],
    "row": np.s_[47],
    "block": np.s_[47:51, 60:64],
}


@pytest.mark.thorough
@pytest.mark.parametrize("value", [0, FULL])
@pytest.mark.parametrize("part", ["column", "columns", "row", "block"])
@pytest.mark.parametrize("camera", [spots, diffuser])
def test_dead_lines_and_blocks(image_of, camera, part, value):
    """In PSF and capture, that nobody told: 5 to 16 dB."""
    given = pair(camera(SHAPE))
    best = quality(image_of(**given)[0], TRUE)
    for one in given.values():
        one[DEAD[part]] = value
    image, said = image_of(**given)
    assert quality(image, TRUE) > best - WITHIN and {"replaced", "defective"} <= set(said)


@pytest.mark.thorough
@pytest.mark.parametrize("level", [0, DARK])
@pytest.mark.parametrize("camera", [spots, diffuser, zones, lambda s: cells(s, size=3)])
def test_an_inverted_capture(image_of, camera, level):
    """Its image is a negative: said, and the capture inverted again is as good as the right one."""
    taken = np.uint16(DARK - level)
    given = {name: np.maximum(one, taken) - taken for name, one in pair(camera(SHAPE)).items()}
    best = quality(image_of(**given)[0], TRUE)
    inverse = given["capture"].max() - given["capture"]
    image, said = image_of(capture=inverse, psf=given["psf"])
    assert quality(image, TRUE) < best - 10
    assert said["misfit"]["advice"].endswith("give full scale minus captures, as 255 - captures")
    assert said["misfit"]["severe"] and said["misfit"]["where"].endswith("capture.tif")
    mended = image_of(capture=FULL - inverse, psf=given["psf"])[0]
    assert quality(mended, TRUE) > best - WITHIN


NUMBERS = {
    "whole": 26,
    "float": 26.0,
    "half": np.float16(26),
    "byte": np.int8(26),
    "word": np.uint16(26),
    "long": np.longdouble(26),
    "swapped": np.asarray(26, ">f8"),
    "half of JAX": jnp.float16(26),
    "bfloat16": jnp.bfloat16(26),
    "word of JAX": jnp.int16(26),
}


@pytest.mark.parametrize("name", quick(NUMBERS, 0, 2, 4, 5, 6, 8))
def test_numbers_in_place_of_leaves(name):
    """`eqx.tree_at` puts a number of any type where a camera holds an array."""
    mask = tc.FresnelZoneAperture(beta=20.0, width=3.0)
    camera = tc.LenslessCamera(mask, tc.Sensor((6, 8), 480 * um), 4.0)
    same = camera.replace(mask=tc.FresnelZoneAperture(beta=26.0, width=3.0))
    changed = eqx.tree_at(lambda c: c.mask.beta, camera, NUMBERS[name])
    light: Any = {"wavelength": 550 * nm, "object_distance": 200.0}
    with jax.numpy_dtype_promotion("standard"):  # halves become single precision
        found = tc.psf(changed, **light)
    np.testing.assert_allclose(found, tc.psf(same, **light), rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("wrong", [True, np.bool_(True), "26", 26j, np.float16(-26)], ids=repr)
def test_no_numbers_in_place_of_leaves(wrong):
    """What its constructor refuses is refused in the same words."""
    camera = tc.LenslessCamera(
        tc.FresnelZoneAperture(20.0, width=3.0), tc.Sensor((36, 48), 80 * um), 4.0
    )
    changed = eqx.tree_at(lambda c: c.mask.beta, camera, wrong)
    with pytest.raises((TypeError, ValueError), match="beta = .*rad/mm"):
        tc.psf(changed, wavelength=550 * nm, object_distance=200.0)


@pytest.mark.parametrize("suffix", ["jpg", "png", "tif"])
def test_photographs_are_upright_linear_light(tmp_path, suffix):
    """By orientation 6, and by sRGB's curve; displays encode once."""
    codes = chelsea()[:200:4, :300:4]
    turned = PIL.Image.fromarray(np.rot90(codes).copy())
    exif = PIL.Image.Exif()
    exif[ORIENTATION] = 6
    turned.save(tmp_path / f"a.{suffix}", exif=exif, quality=98)
    values = codes / 255
    linear = np.where(values <= 0.04045, values / 12.92, ((values + 0.055) / 1.055) ** 2.4)
    found = tc.load_image(tmp_path / f"a.{suffix}")
    assert np.abs(found - linear).mean() < 0.02
    figure = tc.plot.compare({"photograph": found})
    shown = np.asarray(figure.axes[0].images[0].get_array())[..., :3]
    assert np.abs(shown / shown.max() - values / values.max()).mean() < 0.03


@pytest.mark.thorough
def test_a_scene_wider_than_the_field():
    """Start page's example with distance 3 in place of 2: the field that is given cuts it."""
    mask = tc.SampledMask(np.random.default_rng(0).random((40, 40)) < 0.5, 30 * um)
    camera = tc.LenslessCamera(mask, tc.Sensor((64, 80), 48 * um), 3.0)
    plane = tc.ImagePlane(TRUE[:80, :120] + 0.2, distance=250.0, width=320.0)
    noise, light = tc.GaussianNoise(snr_db=40.0), 550 * nm
    capture = tc.capture(camera, tc.Scene(plane, light), key=0, noise=noise)
    for field in ({}, {"field_shape": (44, 60)}):
        optics = tc.Cameras([camera], wavelength=light, object_distance=250.0, **field)
        result = tc.reconstruct(tc.Recording([capture], optics), tc.AdmmTV())
        pitch = np.asarray(result.pitch)
        truth = plane.sample(tc.Grid(result.image.shape, pitch), magnification=1.0)
        likeness = np.corrcoef(np.ravel(result.image), np.ravel(truth))[0, 1]
        assert likeness > 0.9 or "outside of the field: give field_shape=" in result.reason


@pytest.mark.parametrize("name", [*WRITERS, "a.pgm", "a.raw10", "a.raw12"])
def test_formats_of_a_laboratory(tmp_path, name):
    """The counts, or one line that says how to give their size."""
    array, path = counts(TRUE, full=3000.0) // 4, tmp_path / name
    if name in WRITERS:
        WRITERS[name](path, capture=array)
    elif name == "a.pgm":
        path.write_bytes(b"P5 128 96 4095\n" + array.astype(">u2").tobytes())
    else:
        path.write_bytes(packed(array, int(name[-2:]), 0))
        with pytest.raises(tc.measured.MeasurementError, match="give it as a.raw1.:ROWSxCOLUMNS"):
            tc.measured.read_image(path)
        path = tmp_path / f"{name}:{SHAPE[0]}x{SHAPE[1]}"
    np.testing.assert_array_equal(tc.measured.read_image(path).pixels, array)
