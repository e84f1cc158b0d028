"""Frames of a camera on disk, written frame by frame and read by sensor rows.

A Zarr store (version 3) with the array `frames` (frame, y, x) and, for each frame, a 64 bit digest
of its pixels, 0 where it has not been captured. Its metadata are OME-Zarr's too, version 0.5, by
which viewers such as napari open the frames as a series. A chunk holds some frames of some rows,
with a checksum of its own. No compression: the last bits of a camera are noise.
"""

import contextlib
import hashlib
import math
import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from thincam_jax._core.files import MeasurementError, writing
from thincam_jax._core.text import of_error

CALIBRATION = "Hadamard captures"  # a store whose frames are those of a `HadamardSeries`
CAPTURES = "captures"  # any other
VERSION = 1
TOGETHER = 16  # frames of a chunk, where all frames of some rows are to be read
_CHUNK = 2**18  # bytes
_NAMED = 8  # frames that a message lists
_LARGEST = 2**30  # bytes of a frame, and of a chunk
_MOST = 2**20  # frames
_DESCRIBED = 2**24  # bytes of a file of metadata, of digests, and of a chunk of a matrix
# OME-Zarr's description of the frames: one after the other, in pixels.
_SERIES = {
    "version": "0.5",
    "multiscales": [
        {
            "name": "frames",
            "axes": [
                {"name": "frame", "type": "time"},
                {"name": "y", "type": "space"},
                {"name": "x", "type": "space"},
            ],
            "datasets": [
                {
                    "path": "frames",
                    "coordinateTransformations": [{"type": "scale", "scale": [1.0, 1.0, 1.0]}],
                }
            ],
        }
    ],
}


class CaptureStoreError(MeasurementError):
    """A store of captures that cannot be used; one line says which frames and what to do."""


def zarr_library() -> Any:
    """Zarr, which takes a second to import."""
    try:
        import zarr.codecs
    except ImportError:
        raise CaptureStoreError(
            "stores of frames and matrices need Zarr: pip install 'thincam_jax[stores]'"
        ) from None
    return zarr


@contextlib.contextmanager
def opened(
    path: str | Path, kinds: Sequence[str], wanted: tuple[str, str], mode: str = "r"
) -> Iterator[tuple[Any, dict[str, Any]]]:
    """The Zarr group at `path` and its attributes, for a block that takes its arrays.

    - `wanted`: kind that it has to be, and what makes one.

    **Errors**: CaptureStoreError, one line, where it is of none of the `kinds` or of another
    version, or where the block finds something missing or wrong.
    """
    zarr = zarr_library()
    try:
        for pattern in ("*", "*/*", "digests/c/*", "matrix/c/*", "matrix/c/*/*"):
            _refuse_links(Path(path).glob(pattern))
        for pattern in ("zarr.json", "*/zarr.json", "digests/c/*", "matrix/c/*/*"):
            for file in Path(path).glob(pattern):
                if not file.is_file() or file.stat().st_size > _DESCRIBED:
                    raise ValueError(f"{file} is a device, a pipe or too large")
        group: Any = zarr.open_group(path, mode=mode, zarr_format=3)
        attributes: dict[str, Any] = dict(group.attrs)
        kind, version = attributes["kind"], attributes["version"]
        if kind not in kinds or version != VERSION:
            raise ValueError(f"{kind}, version {version}")
        yield group, attributes
    except CaptureStoreError:
        raise
    except Exception as error:  # whatever Zarr makes of another's metadata
        raise CaptureStoreError(
            f"{path} is no {wanted[0]} ({of_error(error)}); give one that {wanted[1]} made"
        ) from error


def stored_array(group: Any, name: str, axes: int, dtypes: Sequence[str]) -> Any:
    """An array of a group, as it is written here; ValueError for another, too large or packed."""
    array = group[name]
    size = math.prod(array.chunks) * array.dtype.itemsize
    codecs = {codec.to_dict()["name"] for codec in array.metadata.codecs}
    packed = codecs - {"bytes", "crc32c"} and name != "digests"  # once written with zstd
    if array.ndim != axes or str(array.dtype) not in dtypes or size > _LARGEST or packed:
        raise ValueError(f"{name} has {array.shape} {array.dtype}, {array.chunks}, {codecs}")
    return array


class CaptureStore:
    """The arrays of a store that is open; `path` is its folder.

    **Errors**: CaptureStoreError where there is no such store at `path`.
    """

    def __init__(self, path: Path, mode: str = "r", kinds: Sequence[str] = (CALIBRATION, CAPTURES)):
        self.path, self._chunks = path, path / "frames" / "c"
        wanted = f"store of {kinds[-1]}", "an acquisition or HadamardCaptures.create"
        with opened(path, kinds, wanted, mode) as (self.group, self.attributes):
            # A chunk of black frames is written, too: one that is not there is missing.
            dtype, shape = dtype_of_bits(self.attributes["bits"]), self.attributes["sensor_shape"]
            frames = stored_array(self.group, "frames", 3, (dtype,))
            self.frames = frames.with_config({"write_empty_chunks": True})
            digests = stored_array(self.group, "digests", 1, ("uint64",))
            count = digests.shape[0]
            if frames.shape != (count, *shape) or count > _MOST or self.frame_bytes > _LARGEST:
                raise ValueError(f"frames {frames.shape}, digests {count}, sensor {shape}")
            self.digests = np.asarray(digests[:])

    @classmethod
    def create(
        cls,
        path: Path,
        shape: tuple[int, int, int],
        dtype: str,
        attributes: Mapping[str, Any],
        *,
        together: int = TOGETHER,
    ) -> "CaptureStore":
        """A new store for frames of `shape` (frame, y, x) that says `attributes` of itself.

        - `together`: frames of a chunk. With 1 a chunk is a whole frame, with more it is some rows.
        """
        zarr = zarr_library()
        row = together * shape[2] * np.dtype(dtype).itemsize
        rows = shape[1] if together == 1 else min(shape[1], max(1, _CHUNK // row))
        with writing(path):
            known = {"version": VERSION, "ome": _SERIES, **attributes}
            group = zarr.create_group(path, attributes=known)
            group.create_array(
                "frames",
                shape=shape,
                dtype=dtype,
                chunks=(together, rows, shape[2]),
                compressors=[zarr.codecs.Crc32cCodec()],
                dimension_names=("frame", "y", "x"),
            )
            digests = group.create_array("digests", shape=shape[:1], dtype="uint64")
            digests[:] = np.zeros(shape[0], np.uint64)
        return cls(path, "r+")

    @property
    def together(self) -> int:
        """Frames of a chunk."""
        return self.frames.chunks[0]

    @property
    def frame_bytes(self) -> int:
        """Bytes of a frame on the disk."""
        return math.prod(self.frames.shape[1:]) * self.frames.dtype.itemsize

    def chunk(self, number: int) -> range:
        """The frames that share a chunk with frame `number`."""
        first = number - number % self.together
        return range(first, min(first + self.together, len(self.digests)))

    def write(self, images: Mapping[int, np.ndarray]) -> None:
        """Write frames by their numbers. **Errors**: WriteError, one line."""
        numbers = sorted(images)
        first = images[numbers[0]]
        block = first[None] if len(images) == 1 else np.stack([images[n] for n in numbers])
        with writing(self.path):
            if numbers == list(range(numbers[0], numbers[-1] + 1)):
                self.frames[numbers[0] : numbers[-1] + 1] = block
            else:
                self.frames.oindex[np.array(numbers)] = block

    def announce(self, digests: np.ndarray) -> None:
        """Write the digests: what they announce has to be there."""
        self.digests = digests.copy()
        with writing(self.path):
            self.group["digests"][:] = digests

    def tidy(self, numbers: Iterable[int]) -> None:
        """Remove frames that a killed process left half written in their chunks."""
        for chunk in sorted({number // self.together for number in numbers}):
            for partial in (self._chunks / str(chunk)).rglob("*.partial"):
                partial.unlink()

    def files(self, numbers: Iterable[int]) -> list[Path]:
        """The files that hold frames, and their folders, as they have to reach the disk."""
        chunks = sorted({number // self.together for number in numbers})
        folders = [self._chunks / str(chunk) for chunk in chunks]
        rows = range(-(-self.frames.shape[1] // self.frames.chunks[1]))
        files = [folder / str(row) / "0" for folder in folders for row in rows]
        return [*files, *(file.parent for file in files), *folders, self._chunks]

    def lost(self, *, truncated: bool = False) -> set[int]:
        """The frames of chunks that are not there or not whole; or only those of the latter.

        **Errors**: CaptureStoreError for a chunk that is a link.
        """
        _refuse_links(self._chunks.rglob("*"))
        # A chunk at the edge is stored as large as the others; 4 bytes are the checksum.
        whole = math.prod(self.frames.chunks) * self.frames.dtype.itemsize + 4
        rows, root, found = -(-self.frames.shape[1] // self.frames.chunks[1]), self._chunks, set()
        there = {int(one) for one in os.listdir(root) if one.isdigit()} if root.is_dir() else set()
        for number in range(-(-len(self.digests) // self.together)):
            files = (root / str(number)).glob("[0-9]*/0") if number in there else ()
            sizes = [os.stat(file).st_size for file in files]
            if (len(sizes) < rows and not truncated) or any(size != whole for size in sizes):
                found.update(self.chunk(number * self.together))
        return found

    def damaged(self) -> list[str]:
        """The frames of each chunk that cannot be read."""
        found = []
        for first in range(0, len(self.digests), self.together):
            together = self.chunk(first)
            try:
                _ = self.frames[first : together.stop]
            except (ValueError, OSError):
                found.append(f"{first} … {together.stop - 1}" if len(together) > 1 else f"{first}")
        return found

    def read(self, frames: slice | int, rows: slice = slice(None)) -> np.ndarray:
        """Frames, or some of their rows; CaptureStoreError where they are damaged."""
        try:
            return np.asarray(self.frames[frames, rows])
        except (ValueError, OSError) as error:  # a checksum or a length that does not fit
            raise CaptureStoreError(
                f"{self.path}: frames {listed(self.damaged())} are damaged ({error}); capture "
                "them again"
            ) from error


def _refuse_links(files: Iterable[Path]) -> None:
    """Refuse a store that leads out of its folder, as one made by others may."""
    for file in files:
        if file.is_symlink():
            raise CaptureStoreError(
                f"{file} is a link, which is not followed; copy the store with what it leads to"
            )


def frame_digest(pixels: np.ndarray) -> int:
    """64 bits of the pixels' hash, never 0."""
    digest = hashlib.blake2b(np.ascontiguousarray(pixels).data, digest_size=8).digest()
    return int.from_bytes(digest, "little") or 1


def dtype_of_bits(bits: int | None) -> str:
    """Integer type for the counts of a camera of that many bits; None: any numbers."""
    return "float32" if bits is None else "uint8" if bits <= 8 else "uint16"


def listed(numbers: Sequence[int | str]) -> str:
    """Numbers of frames for a message: the first ones and how many more."""
    more = f" and {len(numbers) - _NAMED} more" if len(numbers) > _NAMED else ""
    return ", ".join(map(str, numbers[:_NAMED])) + more
