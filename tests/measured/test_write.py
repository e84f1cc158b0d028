import json
import math
import os
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import PIL.Image
import pytest
import tifffile

from thincam_jax.measured import MeasurementError, read_image, to_display, write_image
from thincam_jax.measured.write import log_text

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


@pytest.mark.parametrize("channels", [1, 3])
def test_png_is_what_is_displayed(tmp_path, channels):
    path = write_image(tmp_path / "a.png", IMAGE[:channels], gamma=1.5, percentile=90)
    expected = to_display(IMAGE[:channels], gamma=1.5, percentile=90)
    with PIL.Image.open(path) as file:
        np.testing.assert_array_equal(np.array(file), expected)
    np.testing.assert_array_equal(read_image(path).pixels, expected)


def test_the_log_stands_beside(tmp_path):
    log = {"b": math.nan, "a": {"z": [1, math.inf, 2.5], "y": (True, None)}, "π": "ä"}
    write_image(tmp_path / "deep.name.png", IMAGE, log)
    text = (tmp_path / "deep.name.json").read_text(encoding="utf-8")
    assert json.loads(text) == {"a": {"y": [True, None], "z": [1, None, 2.5]}, "b": None, "π": "ä"}
    assert text.index('"a"') < text.index('"y"') < text.index('"z"') < text.index('"b"')
    assert text == log_text(dict(reversed(log.items())))


def test_numbers_and_arrays_of_numpy_and_jax_are_plain_in_the_log():
    log = {
        "int": np.uint16(7),
        "float": np.float32(0.5),
        "bool": np.bool_(True),
        "array": np.array([[1.0, -np.inf]]),
        "jax": jnp.asarray(3),
        "path": Path("a") / "b",
        3: "key",
    }
    assert json.loads(log_text(log)) == {
        "int": 7,
        "float": 0.5,
        "bool": True,
        "array": [[1.0, None]],
        "jax": 3,
        "path": os.path.join("a", "b"),
        "3": "key",
    }
    with pytest.raises(TypeError, match="a log holds numbers, texts, lists and dicts, not object"):
        log_text({"a": object()})


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
