"""Hadamard patterns, and the store of their captures."""

import sys

import numpy as np
import pytest
import scipy
import zarr
from ome_zarr_models.v05.image import Image

from thincam_jax.measured.calibration import HadamardCaptures, HadamardSeries, recover_matrix
from thincam_jax.measured.calibration.captures import CaptureStoreError
from thincam_jax.measured.calibration.hadamard import hadamard_pattern, walsh_hadamard


def patterns(shape, order):
    rows = [hadamard_pattern(i, shape, order).ravel() for i in range(np.prod(shape))]
    return np.array(rows, int)


@pytest.mark.parametrize("shape", [(1, 1), (1, 2), (2, 4), (8, 4)])
def test_both_orders_hold_every_row_once(shape):
    count = np.prod(shape)
    natural, sequency = (patterns(shape, order) for order in ("natural", "sequency"))
    np.testing.assert_array_equal(natural, scipy.linalg.hadamard(count))
    np.testing.assert_array_equal((np.diff(sequency) != 0).sum(axis=1), np.arange(count))
    # ERRATA on Eq 5.15: N times the unit matrix.
    np.testing.assert_array_equal(sequency @ sequency.T, count * np.eye(count))


@pytest.mark.parametrize("count", [1, 2, 32, 64])
@pytest.mark.parametrize("kind", [np.uint16, np.float32, np.float64])
def test_transform_is_the_product_with_the_matrix(count, kind):
    values = np.random.default_rng(count).integers(0, 4096, (count, 300)).astype(kind)
    found = walsh_hadamard(values)
    assert found.dtype == (np.float64 if kind is np.float64 else np.float32)
    np.testing.assert_array_equal(found, (scipy.linalg.hadamard(count) @ values.astype(float)).T)


def test_frames_of_a_series():
    binary = HadamardSeries((2, 4), display="binary", dark_frames=2)
    assert binary.frame_count == 10
    np.testing.assert_array_equal(binary.frame(0), np.ones((2, 4)))
    np.testing.assert_array_equal(2 * binary.frame(3) - 1.0, hadamard_pattern(3, (2, 4)))
    np.testing.assert_array_equal(binary.frame(9), np.zeros((2, 4)))
    both = HadamardSeries((2, 4), order="natural")
    assert both.frame_count == 16
    difference = both.frame(6).astype(int) - both.frame(7)
    np.testing.assert_array_equal(difference, hadamard_pattern(3, (2, 4), "natural"))


def test_what_is_no_power_of_two_is_refused():
    with pytest.raises(ValueError, match="60 × 64 = 3840 cells are no power of two.*such as 4096"):
        HadamardSeries((60, 64))
    with pytest.raises(ValueError, match="no power of two"):
        walsh_hadamard(np.ones((12, 2)))


SERIES = HadamardSeries((4, 8), "natural", "binary", dark_frames=3)
SHAPE = (5, 7)
FRAMES = np.random.default_rng(0).integers(0, 1024, (SERIES.frame_count, *SHAPE))


def filled(path, numbers=range(SERIES.frame_count)):
    with HadamardCaptures.create(path, SERIES, SHAPE, bits=10, exposure=0.02) as writer:
        for number in numbers:
            writer.write(number, FRAMES[number])
    return path


def test_frames_come_back_in_any_order(tmp_path):
    shuffled = np.random.default_rng(1).permutation(SERIES.frame_count)
    captures = HadamardCaptures.load(filled(tmp_path / "a.zarr", shuffled))
    assert captures.series == SERIES
    assert (captures.sensor_shape, captures.bits, captures.exposure) == (SHAPE, 10, 0.02)
    np.testing.assert_array_equal(captures.rows(2, 5), FRAMES[:, 2:5])


def test_missing_frames_are_named_and_can_be_written_later(tmp_path):
    path = filled(tmp_path / "a.zarr", [n for n in range(SERIES.frame_count) if n not in (5, 30)])
    with pytest.raises(CaptureStoreError, match="2 of 35 frames are missing: 5, 30; capture them"):
        HadamardCaptures.load(path)
    with HadamardCaptures.resume(path) as writer:
        assert writer.missing == [5, 30]
        for number in writer.missing:
            writer.write(number, FRAMES[number])
    np.testing.assert_array_equal(HadamardCaptures.load(path).rows(0, 5), FRAMES)


def test_a_lost_and_a_truncated_chunk_are_named(tmp_path):
    """Zarr itself reads a chunk that is not there as zeros."""
    path = filled(tmp_path / "a.zarr")
    chunk = path / "frames" / "c" / "2" / "0" / "0"
    whole = chunk.read_bytes()
    chunk.write_bytes(whole[:-9])
    with pytest.raises(CaptureStoreError, match="3 of 35 frames are truncated: 32, 33, 34; "):
        HadamardCaptures.load(path)
    chunk.unlink()
    with pytest.raises(CaptureStoreError, match="3 of 35 frames are missing: 32, 33, 34; "):
        HadamardCaptures.load(path)
    with HadamardCaptures.resume(path) as writer:
        for number in writer.missing:
            writer.write(number, FRAMES[number])
    assert chunk.read_bytes() == whole
    damaged = bytearray(whole)
    damaged[3] ^= 1
    chunk.write_bytes(damaged)
    with pytest.raises(CaptureStoreError, match="frames 32 … 34 are damaged"):
        recover_matrix(HadamardCaptures.load(path))


def test_other_programs_read_a_store_as_ome_zarr(tmp_path):
    """By the models of the format's own Python package."""
    group = zarr.open_group(filled(tmp_path / "a.zarr"), mode="r")
    image = Image.from_zarr(group)
    assert [axis.name for axis in image.ome_attributes.multiscales[0].axes] == ["frame", "y", "x"]
    (path,) = (one.path for one in image.ome_attributes.multiscales[0].datasets)
    np.testing.assert_array_equal(np.sort(group[path][:, 0, 0]), np.sort(FRAMES[:, 0, 0]))


def test_the_same_image_twice_is_named(tmp_path):
    with HadamardCaptures.create(tmp_path / "a.zarr", SERIES, SHAPE) as writer:
        for number, image in enumerate(FRAMES):
            writer.write(number, FRAMES[16] if number == 17 else image)
    with pytest.raises(CaptureStoreError, match="frames 16, 17 are the same capture"):
        HadamardCaptures.load(tmp_path / "a.zarr")


def test_a_frame_of_another_kind_is_refused(tmp_path):
    with HadamardCaptures.create(tmp_path / "a.zarr", SERIES, SHAPE, bits=10) as writer:
        writer.write(4, FRAMES[4])
        for number, image, message in (
            (4, FRAMES[4], "frame 4 was captured before"),
            (35, FRAMES[4], "there is no frame 35; give 0 … 34"),
            (5, FRAMES[4].T, r"frame 5 has shape \(7, 5\); the sensor's is \(5, 7\)"),
            (5, FRAMES[4] + 1000, "a camera of 10 bits gives whole numbers from 0 to 1023"),
            (5, FRAMES[4] + 0.5, "a camera of 10 bits gives whole numbers"),
            (5, FRAMES[4] * np.nan, "not finite"),
        ):
            with pytest.raises(CaptureStoreError, match=message):
                writer.write(number, image)
    with pytest.raises(CaptureStoreError, match="34 of 35 frames are missing: 0, 1, 2, 3, 5"):
        HadamardCaptures.load(tmp_path / "a.zarr")


def test_what_is_no_store_is_refused(tmp_path):
    path = filled(tmp_path / "a.zarr")
    with pytest.raises(CaptureStoreError, match="exists; give another name"):
        HadamardCaptures.create(path, SERIES, SHAPE)
    with pytest.raises(CaptureStoreError, match="is no store of Hadamard captures"):
        HadamardCaptures.load(tmp_path / "b.zarr")
    about = path / "zarr.json"
    text = about.read_text("utf-8")
    about.write_text(text.replace('"dark_frames": 3', '"dark_frames": 4'))
    with pytest.raises(CaptureStoreError, match="contradicts itself: arrays of shapes"):
        HadamardCaptures.load(path)
    about.write_text(text[:100])
    with pytest.raises(CaptureStoreError, match="is no store of Hadamard captures"):
        HadamardCaptures.load(path)
    with pytest.raises(ValueError, match="bits = 24; give 1 to 16"):
        HadamardCaptures.create(tmp_path / "c.zarr", SERIES, SHAPE, bits=24)


def test_stores_need_zarr(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "zarr", None)  # as where it is not installed
    for use in (HadamardCaptures.load, lambda path: HadamardCaptures.create(path, SERIES, SHAPE)):
        with pytest.raises(CaptureStoreError, match=r"pip install 'thincam_jax\[stores\]'"):
            use(tmp_path / "a.zarr")
