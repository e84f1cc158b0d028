"""Images from files of every depth, samples without a download, and resampling."""

import gc

import numpy as np
import pytest
import skimage.data
import skimage.io
import tifffile
from raw_files import SRGB, dng

from thincam_jax import load_image
from thincam_jax.imaging.targets import resize, sample_image

RAMP = np.linspace(0.0, 1.0, 24 * 31).reshape(24, 31)


def write(path, pixels):
    skimage.io.imsave(path, pixels, check_contrast=False)
    return path


@pytest.mark.parametrize(
    ("name", "pixels", "step"),
    [
        ("a.png", np.round(RAMP * 255).astype(np.uint8), 1 / 255),
        ("a.png", np.round(RAMP * 65535).astype(np.uint16), 1 / 65535),
        ("a.tif", np.round(RAMP * 65535).astype(np.uint16), 1 / 65535),
        ("a.tif", RAMP.astype(np.float32), 1e-7),
    ],
)
def test_the_full_range_of_every_depth_is_0_to_1(tmp_path, name, pixels, step):
    image = load_image(write(tmp_path / name, pixels), linear=True)
    assert image.dtype == np.float64
    np.testing.assert_allclose(image, RAMP, rtol=0, atol=0.51 * step)
    assert (image.min(), image.max()) == (0.0, 1.0)


def test_alpha_is_dropped_and_channels_keep_their_order(tmp_path):
    pixels = np.zeros((9, 14, 4), np.uint8)
    pixels[2, 3], pixels[4, 5, :3], pixels[8, 13, 2] = (255, 51, 0, 7), 102, 255
    image = load_image(str(write(tmp_path / "a.png", pixels)), linear=True)
    assert image.shape == (9, 14, 3)
    assert image[2, 3] == pytest.approx([1.0, 0.2, 0.0])
    assert image[4, 5] == pytest.approx([0.4, 0.4, 0.4])
    assert image[8, 13].tolist() == [0.0, 0.0, 1.0]
    grey = write(tmp_path / "b.png", pixels[..., :2])
    np.testing.assert_allclose(load_image(grey, linear=True), pixels[..., 0] / 255)


@pytest.mark.parametrize("name", ["a.dng", "a.DNG", "a.tif"])
def test_a_raw_photograph_is_its_colours(tmp_path, name):
    """Black and white level, mosaic and orientation are the file's; sRGB's primaries, linear."""
    left, right = (600, 900, 300), (3400, 3400, 3400)
    light = np.repeat(np.transpose([left, right])[:, None], 24, axis=-1).repeat(32, axis=1)
    path = tmp_path / name
    path.write_bytes(dng("BGGR", 6, light=light, matrix=SRGB))
    image = load_image(path)
    assert image.shape == (32, 48, 3)
    for columns, colour in ((slice(8, 16), left), (slice(32, 40), right)):
        found = image[8:24, columns].mean((0, 1))
        np.testing.assert_allclose(found, np.array(colour) / (4095 - 256), rtol=0.01)
    np.testing.assert_array_equal(load_image(path, linear=True), image)


def test_a_mosaic_is_no_photograph(tmp_path):
    sites = [(33421, 3, 2, (2, 2), True), (33422, 1, 4, (0, 1, 1, 2), True)]
    path = tmp_path / "a.tif"
    tifffile.imwrite(path, np.ones((8, 6), np.uint16), photometric=32803, extratags=sites)
    with pytest.raises(ValueError, match="holds a colour filter's mosaic; save its colours as"):
        load_image(path)


def test_no_file_and_folder(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"none\.png' does not exist"):
        load_image(tmp_path / "none.png")
    with pytest.raises(ValueError, match="is a folder"):
        load_image(tmp_path)


@pytest.mark.filterwarnings("ignore::ResourceWarning")
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
@pytest.mark.parametrize("damage", ["truncated", "text", "no bytes"])
def test_damaged_files_give_one_line(tmp_path, damage):
    path = write(tmp_path / "a.png", np.random.default_rng(0).integers(0, 255, (40, 50), np.uint8))
    whole = path.read_bytes()
    path.write_bytes({"truncated": whole[:700], "text": b"hello\n" * 20, "no bytes": b""}[damage])
    with pytest.raises(ValueError, match=r"a\.png' cannot be read as an image") as caught:
        load_image(path)
    assert "\n" not in str(caught.value)
    del caught
    gc.collect(0)  # the decoders leave the file open; close it while that warning is ignored


@pytest.mark.filterwarnings("ignore:.*zero-size:UserWarning")
@pytest.mark.parametrize(
    ("pixels", "message"),
    [
        (np.zeros((0, 8), np.uint16), "empty image"),
        (np.full((9, 8), 1.5, np.float32), "from 1.5 to 1.5"),
        (np.full((9, 8), np.nan, np.float32), "nan"),
        (np.full((9, 8), -3, np.int16), "int16 from -3"),
        (np.zeros((7, 9, 8), np.uint8), r"shape \(7, 9, 8\)"),
    ],
)
def test_contents_that_are_no_image_in_0_to_1(tmp_path, pixels, message):
    path = tmp_path / "a.tif"
    tifffile.imwrite(path, pixels, photometric="minisblack")
    with pytest.raises(ValueError, match=message):
        load_image(path)


@pytest.mark.parametrize("name", ["astronaut", "chelsea", "coffee", "camera", "rocket", "coins"])
def test_samples_are_those_of_scikit_image(name):
    np.testing.assert_array_equal(
        sample_image(name, linear=True), getattr(skimage.data, name)() / 255
    )


@pytest.mark.parametrize("shape", [(40, 75), (33, 50), (160, 225), (96, 75)])
def test_resize_keeps_the_mean_and_the_places(shape):
    """A blob keeps its centroid as a fraction of the field, along each axis, and its total."""
    y, x = np.mgrid[:80, :150]
    blob = 0.2 + 0.7 * np.exp(-(((y - 24) / 9) ** 2) - ((x - 100) / 20) ** 2)
    small = resize(blob, shape)
    assert small.shape == shape
    assert small.mean() == pytest.approx(blob.mean(), rel=2e-3)
    for image in (blob, small):
        weight = image - 0.2
        rows, columns = (np.arange(n) + 0.5 for n in image.shape)
        assert weight.sum(1) @ rows / weight.sum() / len(rows) == pytest.approx(24.5 / 80, abs=3e-3)
        along_x = weight.sum(0) @ columns / weight.sum() / len(columns)
        assert along_x == pytest.approx(100.5 / 150, abs=3e-3)


def test_resize_removes_what_the_new_pixels_cannot_hold():
    """Stripes of 2.2 pixels, shrunk 4 times, would alias; they become grey."""
    stripes = 0.5 + 0.5 * np.sin(2 * np.pi * np.arange(240) / 2.2)
    image = np.tile(stripes, (80, 1))
    small = resize(image, (20, 60))
    assert np.abs(small[2:-2, 2:-2] - 0.5).max() < 0.02
