"""Matrices recovered from simulated Hadamard captures."""

import os

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import thincam_jax as tc
from helpers import full_disk
from thincam_jax._core.files import WriteError
from thincam_jax.imaging.operators import Matrix
from thincam_jax.measured.calibration import (
    HadamardCaptures,
    HadamardSeries,
    recover_matrix,
    simulate_captures,
)
from thincam_jax.measured.calibration.captures import CaptureStoreError
from thincam_jax.measured.calibration.system_matrix import (
    matrix_blocks,
    read_matrix,
    stored_blocks,
    write_matrix,
)

CELLS, SHAPE = (4, 8), (12, 10)
TRUTH = np.random.default_rng(2).uniform(size=(120, 32))
SERIES = [
    HadamardSeries(CELLS, order, display, dark_frames=dark)
    for order in ("natural", "sequency")
    for display, dark in (("binary", 3), ("complementary", 0))
]


def simulated(folder, series, dtype=np.float64, bits=None, **noise):
    operator = Matrix(TRUTH.astype(dtype), CELLS, SHAPE)
    writer = HadamardCaptures.create(folder / "captures.zarr", series, SHAPE, bits=bits)
    return simulate_captures(writer, operator, jax.random.key(5), **noise)


@pytest.mark.parametrize("series", SERIES, ids=lambda s: f"{s.order}-{s.display}")
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_the_matrix_comes_back(series, dtype, tmp_path):
    """Whatever the order and the dark level; ERRATA's N of Eq 5.17 is in it."""
    captures = simulated(tmp_path, series, dtype, offset=3.0)
    found = recover_matrix(captures)
    assert (found.in_shape, found.out_shape) == (CELLS, SHAPE)
    assert found.matrix.dtype == np.float32
    np.testing.assert_allclose(found.matrix, TRUTH, atol=1e-5)


@pytest.mark.parametrize("series", SERIES, ids=lambda s: f"{s.order}-{s.display}")
def test_captures_of_a_series_alone_stay_in_memory(series, tmp_path):
    """The frames, and so the matrix, are those that a store would have had."""
    operator, noise = Matrix(TRUTH, CELLS, SHAPE), {"noise_std": 0.1, "offset": 3.0}
    kept = simulate_captures(series, operator, jax.random.key(5), **noise)
    stored = simulated(tmp_path, series, **noise)
    np.testing.assert_array_equal(kept.rows(3, 7), stored.rows(3, 7))
    np.testing.assert_array_equal(recover_matrix(kept).matrix, recover_matrix(stored).matrix)


def test_without_dark_frames_the_offset_is_in_the_first_cell(tmp_path):
    captures = simulated(tmp_path, HadamardSeries(CELLS, display="binary"), offset=3.0)
    expected = TRUTH + 3.0 * (np.arange(32) == 0)
    np.testing.assert_allclose(recover_matrix(captures).matrix, expected, atol=3e-6)


@pytest.mark.parametrize(("display", "gain"), [("binary", 4), ("complementary", 2)])
def test_noise_is_averaged_over_the_patterns(display, gain, tmp_path):
    """Of a cell: 4σ²/N, or 2σ²/N with complements."""
    captures = simulated(tmp_path, HadamardSeries(CELLS, display=display), noise_std=0.1)
    error = np.asarray(recover_matrix(captures).matrix)[:, 1:] - TRUTH[:, 1:]
    assert np.mean(error**2) == pytest.approx(gain * 0.1**2 / 32, rel=0.1)


def test_a_stored_matrix_is_that_in_memory(tmp_path, monkeypatch):
    monkeypatch.setattr("thincam_jax._core.capture_store._CHUNK", 16 * 4 * 10 * 5)
    monkeypatch.setattr("thincam_jax.measured.calibration.system_matrix._BLOCK", 4 * 32 * 33)
    captures = simulated(tmp_path, SERIES[0])
    assert [pixels.stop for pixels, _ in matrix_blocks(captures)] == [50, 100, 120]
    expected = np.asarray(recover_matrix(captures).matrix)
    path = write_matrix(captures, tmp_path / "matrix.zarr")
    blocks = list(stored_blocks(path))
    assert [pixels.stop for pixels, _ in blocks] == [33, 66, 99, 120]
    np.testing.assert_array_equal(np.concatenate([block for _, block in blocks]), expected)
    found = read_matrix(path)
    np.testing.assert_array_equal(found.matrix, expected)
    assert (found.in_shape, found.out_shape) == (CELLS, SHAPE)
    with pytest.raises(CaptureStoreError, match="exists; give another name"):
        write_matrix(captures, path)
    chunk = path / "matrix" / "c" / "1" / "0"
    chunk.write_bytes(b"cut")
    with pytest.raises(CaptureStoreError, match="pixels 33 … 65 are damaged"):
        read_matrix(path)
    chunk.unlink()
    os.mkfifo(chunk)
    with pytest.raises(CaptureStoreError, match="is a device, a pipe or too large"):
        read_matrix(path)
    with pytest.raises(CaptureStoreError, match="no finished system matrix"):
        read_matrix(captures.path)
    full = r"other\.zarr: cannot be written \(File too large\); make room"
    with full_disk(1_500), pytest.raises(WriteError, match=full):
        write_matrix(captures, tmp_path / "other.zarr")
    with full_disk(100), pytest.raises(WriteError, match=full):
        HadamardCaptures.create(tmp_path / "an-other.zarr", SERIES[0], SHAPE)


def test_an_image_comes_back_by_the_measured_matrix(tmp_path):
    """A matrix in counts of a camera of 12 bits gives images in the unit of the cells."""
    operator = Matrix(TRUTH.astype(np.float32) * 150, CELLS, SHAPE)
    writer = HadamardCaptures.create(
        tmp_path / "captures.zarr", HadamardSeries(CELLS), SHAPE, bits=12
    )
    captures = simulate_captures(writer, operator, jax.random.key(5), noise_std=5.0, offset=40.0)
    image = jnp.linspace(0, 1, 32, dtype=jnp.float32).reshape(CELLS)
    recording = tc.Recording(operator(image), recover_matrix(captures), noise_variance=1e-4)
    found = tc.reconstruct(recording, tc.Ridge(1e-6))
    np.testing.assert_allclose(np.squeeze(found.image), image, atol=0.03)
