r"""The system matrix of a camera from its Hadamard captures (thesis Eq 5.17, times 1/N).

.. math:: \mathbf H = \mathbf V'\mathbf U'^T/N

The transform is linear, so that a common offset need not be subtracted from each capture: it
appears only in the first cell's column, where the white frame and the dark frames correct it.

The captures are read in blocks of sensor rows, each finished before the next is read: memory holds
one block and, if wanted, H.
"""

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jaxtyping import Float

from thincam_jax._core.arguments import checked
from thincam_jax._core.capture_store import VERSION, opened, stored_array, zarr_library
from thincam_jax._core.files import writing
from thincam_jax._core.memory import refuse_if_too_large
from thincam_jax._core.progress import watched
from thincam_jax.imaging.operators import Matrix
from thincam_jax.measured.calibration.captures import CaptureStoreError, HadamardCaptures
from thincam_jax.measured.calibration.hadamard import natural_rows, walsh_hadamard

_KIND = "system matrix"
_BLOCK = 2**22  # bytes of a chunk of a stored matrix
_ALIGNED = 64  # bytes: JAX takes an array at a multiple of it without a copy

Block = tuple[slice, Float[np.ndarray, "pixel cell"]]


def matrix_blocks(captures: HadamardCaptures) -> Iterator[Block]:
    """Iterate over blocks of sensor rows: their pixels, numbered row by row, and their part of H.

    In counts of the camera for a white cell. Each is a new float32 array.
    """
    for pixels, fill in _pending(captures):
        block = np.empty((pixels.stop - pixels.start, captures.series.cell_count), np.float32)
        fill(block)
        yield pixels, block


@checked
@watched("recovering the matrix")
def recover_matrix(captures: HadamardCaptures) -> Matrix:
    """H as an operator, in float32, for `Recording`: 3.2 GB for 64² cells and 440² pixels.

    **Errors**: CaptureStoreError for damaged captures; MemoryError, one line, where memory lacks.
    """
    series, count = captures.series, math.prod(captures.sensor_shape)
    matrix = _aligned(count, series.cell_count)
    for pixels, fill in _pending(captures):
        fill(matrix[pixels])
    return _operator(matrix, series.object_shape, captures.sensor_shape)


def write_matrix(captures: HadamardCaptures, path: str | Path) -> Path:
    """Write H to a Zarr store for `read_matrix`, block by block, never whole in memory.

    **Errors**: CaptureStoreError, one line, where something is at `path` already; WriteError for
    a full disk.
    """
    path, series = Path(path), captures.series
    if path.exists():
        raise CaptureStoreError(f"{path} exists; give another name")
    zarr = zarr_library()
    count, cells = math.prod(captures.sensor_shape), series.cell_count
    with writing(path):
        group = zarr.create_group(path)
        array = group.create_array(
            "matrix",
            shape=(count, cells),
            dtype="float32",
            chunks=(min(count, max(1, _BLOCK // (4 * cells))), cells),
            compressors=[zarr.codecs.Crc32cCodec()],
            config={"write_empty_chunks": True},
            dimension_names=("pixel", "cell"),
        )
        # Written in whole chunks; the remainder of a block goes with the next.
        left, start = np.empty((0, cells), np.float32), 0
        for _, block in matrix_blocks(captures):
            left = np.concatenate([left, block])
            whole = len(left) - len(left) % array.chunks[0]
            array[start : start + whole] = left[:whole]
            left, start = left[whole:], start + whole
        array[start:] = left
        # Last: they mark a finished matrix.
        group.attrs.update(
            kind=_KIND,
            version=VERSION,
            object_shape=series.object_shape,
            sensor_shape=captures.sensor_shape,
        )
    return path


def open_matrix(path: str | Path) -> Any:
    """Open a stored matrix as a Zarr array (pixel, cell), unread, as for `ReducedMatrix`."""
    return _stored(path)[1]


def stored_blocks(path: str | Path) -> Iterator[Block]:
    """Iterate over a stored matrix in blocks of its pixels, never whole in memory."""
    array = open_matrix(path)
    step = array.chunks[0]
    for start in range(0, array.shape[0], step):
        pixels = slice(start, min(start + step, array.shape[0]))
        yield pixels, _read(path, array, pixels)


def read_matrix(path: str | Path) -> Matrix:
    """Read a stored matrix as an operator.

    **Errors**: CaptureStoreError, one line, for no matrix, an unfinished or a damaged one.
    """
    attributes, array = _stored(path)
    matrix = _aligned(*array.shape)
    for pixels, block in stored_blocks(path):
        matrix[pixels] = block
    return _operator(matrix, attributes["object_shape"], attributes["sensor_shape"])


def _pending(captures: HadamardCaptures) -> Iterator[tuple[slice, Any]]:
    """Pixels of each block, and a function that writes their part of H into an array."""
    series, (rows, columns) = captures.series, captures.sensor_shape
    shown_at = np.argsort(natural_rows(series.cell_count, series.order))
    for start in range(0, rows, captures.block_rows):
        stop = min(start + captures.block_rows, rows)
        frames = captures.rows(start, stop).reshape(series.frame_count, -1)

        def fill(out: np.ndarray, frames: np.ndarray = frames) -> None:
            if series.display == "complementary":
                shown = frames[: series.pattern_frames]
                signed = np.subtract(shown[::2], shown[1::2], dtype=np.float32)
                walsh_hadamard(signed[shown_at], out)
                out /= series.cell_count
                return
            walsh_hadamard(frames[shown_at], out)
            out *= 2 / series.cell_count
            # v′ = 2(v − dark) − (v₀ − dark)
            dark = frames[series.pattern_frames :]
            out[:, 0] -= frames[0]
            if len(dark):
                out[:, 0] -= dark.mean(axis=0, dtype=np.float32)

        yield slice(start * columns, stop * columns), fill


def _aligned(count: int, cells: int) -> Float[np.ndarray, "pixel cell"]:
    size = 4 * count * cells
    # Its later validation takes one byte for each number.
    refuse_if_too_large(
        f"a matrix of {count} × {cells}", size * 5 // 4, "write it to a store (write_matrix)"
    )
    room = np.empty(size + _ALIGNED, np.uint8)
    start = -room.ctypes.data % _ALIGNED
    return room[start : start + size].view(np.float32).reshape(count, cells)


def _operator(matrix: np.ndarray, object_shape, sensor_shape) -> Matrix:
    return Matrix(jax.device_put(matrix, may_alias=True), object_shape, sensor_shape)


def _stored(path: str | Path) -> tuple[dict[str, Any], Any]:
    with opened(path, (_KIND,), ("finished system matrix", "write_matrix")) as (group, attributes):
        array = stored_array(group, "matrix", 2, ("float32",))
        shape = tuple(math.prod(attributes[name]) for name in ("sensor_shape", "object_shape"))
        if array.shape != shape:
            raise ValueError(f"the matrix has another shape than {shape}")
    return attributes, array


def _read(path, array: Any, pixels: slice) -> np.ndarray:
    try:
        return np.asarray(array[pixels])
    except (ValueError, OSError) as error:
        raise CaptureStoreError(
            f"{path}: pixels {pixels.start} … {pixels.stop - 1} are damaged ({error}); write the "
            "matrix again"
        ) from error
