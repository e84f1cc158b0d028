"""Images that are written, listed and displayed."""

import os

import numpy as np
import PIL.Image
import pytest
import tifffile

from thincam_jax.measured import MeasurementError, read_image, to_display, write_image
from thincam_jax.measured.raw import CaptureFileError
from thincam_jax.measured.read import list_captures

IMAGE = np.random.default_rng(17).normal(size=(3, 6, 9)).astype(np.float32)


@pytest.mark.parametrize("suffix", [".npy", ".tif", ".TIFF"])
@pytest.mark.parametrize("channels", [1, 2, 3])
def test_linear_images_come_back_bit_for_bit(tmp_path, suffix, channels):
    image = IMAGE[:channels]
    path = write_image(tmp_path / f"a{suffix}", image)
    expected = image[0] if channels == 1 else np.moveaxis(image, 0, -1)
    other = np.load(path) if suffix == ".npy" else tifffile.imread(path)
    np.testing.assert_array_equal(other, expected)
    assert other.dtype == np.float32
    np.testing.assert_array_equal(read_image(path).pixels, expected)
    assert [p.name for p in tmp_path.iterdir()] == [f"a{suffix}"]


@pytest.mark.filterwarnings("ignore::thincam_jax.measured.read.NonlinearWarning")
@pytest.mark.parametrize("channels", [1, 3])
def test_png_is_what_is_displayed(tmp_path, channels):
    path = write_image(tmp_path / "a.png", IMAGE[:channels], gamma=1.5, percentile=90)
    expected = to_display(IMAGE[:channels], gamma=1.5, percentile=90)
    with PIL.Image.open(path) as file:
        np.testing.assert_array_equal(np.array(file), expected)
    np.testing.assert_array_equal(read_image(path).pixels, expected)


@pytest.mark.parametrize("suffix", [".png", ".npy", ".tif"])
def test_ctrl_c_before_the_rename_leaves_the_old_image(tmp_path, monkeypatch, suffix):
    path = write_image(tmp_path / f"a{suffix}", IMAGE)
    old = path.read_bytes()

    def stop(source, target):
        raise KeyboardInterrupt

    monkeypatch.setattr(os, "replace", stop)
    with pytest.raises(KeyboardInterrupt):
        write_image(path, IMAGE[::-1], {"step": 1})
    assert path.read_bytes() == old
    assert [p.name for p in tmp_path.iterdir()] == [path.name]


def test_nothing_is_written_where_something_is_wrong(tmp_path):
    with pytest.raises(MeasurementError, match=r"a\.jpg: images are written as \.png"):
        write_image(tmp_path / "a.jpg", IMAGE, {})
    with pytest.raises(MeasurementError, match="cannot be displayed"):
        write_image(tmp_path / "a.png", IMAGE[:2], {})
    with pytest.raises(TypeError):
        write_image(tmp_path / "a.npy", IMAGE, {"a": object()})
    assert list(tmp_path.iterdir()) == []


def save(path, shape=(4, 6)):
    with path.open("wb") as file:  # numpy.save would add a suffix
        np.save(file, np.full(shape, 2000, np.uint16))


def test_captures_in_the_order_of_their_numbers(tmp_path):
    for name in ("b_10.npy", "b_9.NPY", "a_2_x.tif", "a_11.png", "a_2.tiff"):
        save(tmp_path / name)
    (tmp_path / "notes.txt").touch()
    (tmp_path / "._b_9.npy").touch()
    (tmp_path / "folder.png").mkdir()
    found = list_captures(str(tmp_path))
    names = ["a_2.tiff", "a_2_x.tif", "a_11.png", "b_9.NPY", "b_10.npy"]
    assert sorted(p.name for p in found) == sorted(names)
    numbered = [p.name for p in found]
    assert numbered.index("b_9.NPY") < numbered.index("b_10.npy")
    assert numbered.index("a_2.tiff") < numbered.index("a_11.png") < numbered.index("b_9.NPY")
    assert list_captures(tmp_path) == found


def refused(folder, message, *arguments):
    with pytest.raises(CaptureFileError, match=message) as caught:
        list_captures(folder, *arguments)
    assert "\n" not in str(caught.value)


def test_the_odd_one_out_is_named(tmp_path):
    for name in ("a.npy", "b.npy", "c.npy"):
        save(tmp_path / name)
    save(tmp_path / "a0.npy", (6, 4))
    refused(tmp_path, r"a0\.npy: has shape \(6, 4\), others, as .\.npy, have \(4, 6\)")
    save(tmp_path / "a0.npy", (4, 6, 3))
    refused(tmp_path, r"a0\.npy: has shape \(4, 6, 3\)")


def test_what_cannot_be_listed(tmp_path):
    refused(tmp_path / "absent", "cannot be read as a folder")
    refused(tmp_path, "holds no capture; give a folder of TIFF, PNG, NPY or raw files")
    save(tmp_path / "a.npy")
    refused(tmp_path / "a.npy", "cannot be read as a folder")
    refused(tmp_path, r"a\.npy: holds values up to 2000, above the 1023 of 10 bit", 10)
    (tmp_path / "b.png").write_bytes(b"\x89PNG")
    refused(tmp_path, r"b\.png: is empty or cut short")


def test_grey_values_by_the_formula():
    image = np.array([[[0.0, 0.25, 1.0], [-3.0, 0.5, 0.01]]])
    found = to_display(image, percentile=100)
    expected = [[round(255 * max(v, 0.0) ** (1 / 2.2)) for v in row] for row in image[0].tolist()]
    assert found.dtype == np.uint8
    np.testing.assert_array_equal(found, expected)
    np.testing.assert_array_equal(
        to_display(8 * image, percentile=100, gamma=1),
        [[0, 64, 255], [0, 128, 3]],  # 63.75, 127.5 to even, 2.55
    )


def test_a_few_bright_pixels_do_not_darken_the_rest():
    image = np.full((1, 40, 50), 0.5)
    image[0, 3, 4] = 100.0  # one of 2000; two would be 0.1 %
    found = to_display(image, gamma=1)
    assert (found == 255).all()
    assert to_display(image, gamma=1, percentile=100)[0, 0] == 1
    # A percentile of 0 is no white: the maximum is.
    image = np.zeros((1, 80, 100))
    image[0, 3, 4], image[0, 5, 6] = 2.0, 1.0
    found = to_display(image, gamma=1)
    assert found[3, 4] == 255 and found[5, 6] == 128


def test_colours_go_last_and_are_balanced():
    image = np.random.default_rng(16).random((3, 20, 30)).astype(np.float32)
    image *= np.array([1.0, 2.0, 0.5], np.float32)[:, None, None]
    gains = to_display(image, white_balance=(2, 1, 4), gamma=1, percentile=100)
    scaled = np.moveaxis(image.astype(float) * np.array([2, 1, 4])[:, None, None], 0, -1)
    np.testing.assert_array_equal(gains, np.round(255 * scaled / scaled.max()))
    grey = to_display(image, white_balance="grey_world", gamma=1, percentile=100)
    means = grey.reshape(-1, 3).mean(axis=0)
    np.testing.assert_allclose(means, means.mean(), rtol=2e-3)
    assert np.ptp(to_display(image, gamma=1).reshape(-1, 3).mean(axis=0)) > 50
