"""Photographs as linear light and upright, by what their files say."""

import logging
import struct

import numpy as np
import PIL.Image
import PIL.ImageCms
import pytest
import tifffile
from PIL.ImageOps import exif_transpose

import thincam_jax as tc
from thincam_jax.imaging import encoding
from thincam_jax.imaging.encoding import decode_srgb, eight_bit, encode_srgb, png_bytes, upright

CODES = np.random.default_rng(0).integers(0, 256, (9, 14), dtype=np.uint8)
CODES[0, :2] = 0, 255
LIGHT = decode_srgb(CODES / 255)


def test_srgb_there_and_back():
    values = np.linspace(0, 1, 500)
    np.testing.assert_allclose(decode_srgb(encode_srgb(values)), values, atol=1e-6)
    assert decode_srgb(np.array(0.5)) == pytest.approx(0.214041, abs=1e-6)


@pytest.mark.parametrize("name", ["a.png", "a.bmp", "a.tif"])
def test_photographs_are_decoded_once(tmp_path, name, caplog):
    PIL.Image.fromarray(CODES).save(tmp_path / name)
    encoding.say_once.cache_clear()
    with caplog.at_level(logging.INFO, logger="thincam_jax"):
        np.testing.assert_allclose(tc.load_image(tmp_path / name), LIGHT, atol=1e-12)
        tc.load_image(tmp_path / name)
    assert [record.getMessage()[:30] for record in caplog.records] == [
        "photographs of 8 bit are decod"
    ]
    np.testing.assert_array_equal(tc.load_image(tmp_path / name, linear=True), CODES / 255)


def test_sixteen_bits_and_floats_are_linear(tmp_path):
    PIL.Image.fromarray(CODES.astype(np.uint16) * 257).save(tmp_path / "a.png")
    tifffile.imwrite(tmp_path / "a.tif", (CODES / 255).astype(np.float32))
    np.testing.assert_allclose(tc.load_image(tmp_path / "a.png"), CODES / 255)
    np.testing.assert_allclose(tc.load_image(tmp_path / "a.tif"), CODES / 255, rtol=1e-6)
    tifffile.imwrite(tmp_path / "b.tif", CODES, photometric="miniswhite")
    np.testing.assert_allclose(tc.load_image(tmp_path / "b.tif", linear=True), 1 - CODES / 255)


def profile(curve):
    """The smallest ICC profile that has a curve of grey."""
    return bytes(128) + struct.pack(">I4sII", 1, b"kTRC", 144, len(curve)) + curve


def fixed(*numbers):
    return struct.pack(f">{len(numbers)}i", *(round(65536 * n) for n in numbers))


SRGB = (2.4, 1 / 1.055, 0.055 / 1.055, 1 / 12.92, 0.04045)
CURVES = {
    "identity": (b"curv" + bytes(8), lambda x: x),
    "power": (b"curv" + bytes(4) + struct.pack(">IH", 1, 512), lambda x: x**2),
    "table": (b"curv" + bytes(4) + struct.pack(">I3H", 3, 0, 13107, 65535), None),
    "srgb": (b"para" + bytes(4) + struct.pack(">HH", 3, 0) + fixed(*SRGB), decode_srgb),
    "endless": (b"para" + bytes(4) + struct.pack(">HH", 0, 0) + fixed(-2.0), decode_srgb),
    "damaged": (b"para" + bytes(4) + struct.pack(">HH", 900, 0), decode_srgb),
}


@pytest.mark.parametrize("name", CURVES)
def test_curves_of_profiles(tmp_path, name):
    data, curve = CURVES[name]
    PIL.Image.fromarray(CODES).save(tmp_path / "a.png", icc_profile=profile(data))
    codes = CODES / 255
    expected = np.interp(codes, [0, 0.5, 1], [0, 0.2, 1]) if curve is None else curve(codes)
    np.testing.assert_allclose(tc.load_image(tmp_path / "a.png"), expected, atol=1e-4)


def test_the_profile_of_srgb_that_others_write(tmp_path):
    known = PIL.ImageCms.ImageCmsProfile(PIL.ImageCms.createProfile("sRGB")).tobytes()
    pixels = np.stack([CODES] * 3, axis=-1)
    for name in ("a.tif", "a.png"):
        PIL.Image.fromarray(pixels).save(tmp_path / name, icc_profile=known)
        np.testing.assert_allclose(tc.load_image(tmp_path / name)[..., 0], LIGHT, atol=2e-3)


def test_a_png_says_its_gamma(tmp_path):
    """What is written for looking at is read back as the light that it was."""
    light = np.random.default_rng(1).random((1, 9, 14))
    light /= light.max()
    tc.measured.write_image(tmp_path / "a.png", light, gamma=1.8, percentile=100)
    assert np.abs(tc.load_image(tmp_path / "a.png") - light[0]).max() < 0.006
    (tmp_path / "b.png").write_bytes(png_bytes(eight_bit(light[0], percentile=100)))
    assert np.abs(tc.load_image(tmp_path / "b.png") - light[0]).max() < 0.006


@pytest.mark.parametrize("orientation", range(1, 9))
@pytest.mark.parametrize("name", ["a.jpg", "a.png", "a.tif"])
def test_photographs_stand_upright(tmp_path, orientation, name):
    """As Pillow turns them by the same tag."""
    smooth = np.add.outer(np.arange(24) * 4, np.arange(40) * 2).astype(np.uint8)
    picture = PIL.Image.fromarray(smooth)
    exif = PIL.Image.Exif()
    exif[encoding.ORIENTATION] = orientation
    options = {"tiffinfo": exif} if name == "a.tif" else {"exif": exif}
    picture.save(tmp_path / name, **options)
    with PIL.Image.open(tmp_path / name) as stored:
        turned = np.asarray(exif_transpose(stored))
    if name == "a.tif":  # which Pillow 13 has turned before
        turned = upright(smooth, orientation)
    found = tc.load_image(tmp_path / name, linear=True)
    assert found.shape == turned.shape
    assert np.abs(found - turned / 255).max() < 0.02
    np.testing.assert_array_equal(upright(smooth, orientation).shape, turned.shape)


def test_codes_as_data_where_the_file_is_a_mask(tmp_path):
    PIL.Image.fromarray(np.maximum(CODES, 1)).save(tmp_path / "mask.png")
    mask = tc.read_mask(tmp_path / "mask.png", 0.03)
    np.testing.assert_allclose(mask.amplitude**2, np.maximum(CODES, 1) / 255, rtol=1e-6)
