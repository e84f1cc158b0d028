"""The captures of a Hadamard calibration, on disk: written frame by frame, read by sensor rows.

A Zarr store (version 3) with the array `frames` (frame, y, x) and, for each frame, a 64 bit digest
of its pixels, 0 where it has not been captured. A chunk holds some frames of some rows, with a
checksum of its own, so that both the rig, which writes a frame, and the recovery of the matrix,
which reads all frames of some rows, touch few bytes too many. No compression: the last bits of a
camera are noise.
"""

import dataclasses
import hashlib
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, PRNGKeyArray, Real

from thincam_jax._core import checks
from thincam_jax._core.checks import Shape
from thincam_jax.imaging.operators import AbstractOperator
from thincam_jax.imaging.operators.base import dtype_of
from thincam_jax.measured.calibration.hadamard import HadamardSeries
from thincam_jax.measured.raw import MeasurementError

_KIND, _VERSION = "Hadamard captures", 1
_TOGETHER = 16  # frames of a chunk, held until they are complete
_CHUNK = 2**18  # bytes
_NAMED = 8  # frames that a message lists


class CaptureStoreError(MeasurementError):
    """A store of captures that cannot be used; one line says which frames and what to do."""


@dataclasses.dataclass(frozen=True)
class HadamardCaptures:
    """All captures of a calibration, found complete by `open_captures`.

    - `series`: what was shown.
    - `sensor_shape`: (rows, columns).
    - `bits`: of the camera; None: any numbers.
    - `exposure`: time, s, if known.
    """

    path: Path
    series: HadamardSeries
    sensor_shape: tuple[int, int]
    bits: int | None
    exposure: float | None

    @property
    def block_rows(self) -> int:
        """Sensor rows that are stored together, good to read at once."""
        return self._frames.chunks[1]

    def rows(self, start: int, stop: int) -> Real[np.ndarray, "frame y x"]:
        """All frames of some sensor rows."""
        try:
            return np.asarray(self._frames[:, start:stop])
        except (ValueError, OSError) as error:  # a checksum or a length that does not fit
            raise CaptureStoreError(
                f"{self.path}: frames {', '.join(_damaged(self._frames))} are damaged "
                f"({error}); capture them again"
            ) from error

    @property
    def _frames(self) -> Any:
        return _opened(self.path, "r")["frames"]


class CaptureWriter:
    """Takes the frames of a calibration in any order; a context manager.

    Frames are written out when the 16 of a chunk are there, the others when it is closed.
    """

    def __init__(self, path: Path):
        self._group = _opened(path, "r+")
        # A chunk of black frames is written, too: one that is not there is missing.
        self._frames = self._group["frames"].with_config({"write_empty_chunks": True})
        self.captures = _described(path, self._group)
        self._digests = np.asarray(self._group["digests"][:])
        self._digests[sorted(_lost(path, self._frames))] = 0
        self._waiting: dict[int, np.ndarray] = {}

    @property
    def missing(self) -> list[int]:
        """Numbers of the frames that are still to be written."""
        return [int(n) for n in np.flatnonzero(self._digests == 0)]

    def write(self, number: int | np.integer, image: Real[np.ndarray, "y x"] | Array) -> None:
        """Store the capture of frame `number`, in counts of the camera.

        **Errors**: CaptureStoreError, one line, for a number that there is not or that was written
        before, another shape, and values that the camera cannot give.
        """
        number = int(number)
        if not 0 <= number < len(self._digests):
            raise CaptureStoreError(
                f"{self.captures.path}: there is no frame {number}; give 0 … "
                f"{len(self._digests) - 1}"
            )
        if self._digests[number]:
            raise CaptureStoreError(
                f"{self.captures.path}: frame {number} was captured before; each is written once, "
                "so start another store to measure again"
            )
        pixels = self._checked(number, np.asarray(image))
        self._waiting[number] = pixels
        self._digests[number] = _digest(pixels)
        chunk = number // _TOGETHER
        together = range(chunk * _TOGETHER, min((chunk + 1) * _TOGETHER, len(self._digests)))
        if all(n in self._waiting for n in together):
            self._write_out(together)

    def close(self) -> None:
        """Write out what waits for the rest of its chunk."""
        for chunk in sorted({number // _TOGETHER for number in self._waiting}):
            self._write_out(range(chunk * _TOGETHER, (chunk + 1) * _TOGETHER))

    def __enter__(self) -> "CaptureWriter":
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def _write_out(self, together: range) -> None:
        ready = [n for n in together if n in self._waiting]
        block = np.stack([self._waiting[n] for n in ready])
        if ready == list(range(ready[0], ready[-1] + 1)):
            self._frames[ready[0] : ready[-1] + 1] = block
        else:
            self._frames.oindex[np.array(ready)] = block
        for number in ready:
            del self._waiting[number]
        # After the frames: what a digest announces is there.
        written = self._digests.copy()
        written[list(self._waiting)] = 0
        self._group["digests"][:] = written

    def _checked(self, number: int, pixels: np.ndarray) -> np.ndarray:
        bits = self.captures.bits
        where = f"{self.captures.path}: frame {number}"
        if pixels.shape != self.captures.sensor_shape:
            raise CaptureStoreError(
                f"{where} has shape {pixels.shape}; the sensor's is {self.captures.sensor_shape}"
            )
        if pixels.dtype.kind not in "fiu" or not np.isfinite(pixels).all():
            raise CaptureStoreError(f"{where} holds numbers that are not finite and real")
        if bits is not None:
            whole = np.rint(pixels)
            if (whole != pixels).any() or pixels.min() < 0 or pixels.max() > 2**bits - 1:
                raise CaptureStoreError(
                    f"{where} goes from {pixels.min():g} to {pixels.max():g}; a camera of {bits} "
                    f"bits gives whole numbers from 0 to {2**bits - 1}"
                )
        return pixels.astype(self._frames.dtype)


def create_captures(
    path: str | Path,
    series: HadamardSeries,
    sensor_shape: Shape,
    *,
    bits: int | None = None,
    exposure: float | None = None,
) -> CaptureWriter:
    """A new store for the captures of a calibration.

    - `bits`: of the camera, up to 16, whose counts are stored as they are; None: any numbers, in
      float32. `exposure`: time, s, kept for the record.

    **Errors**: CaptureStoreError where something is at `path` already.
    """
    path, shape = Path(path), checks.shape2d("sensor_shape", sensor_shape)
    if bits is not None and not 1 <= bits <= 16:
        raise ValueError(f"bits = {bits}; give 1 to 16, or None for any numbers")
    if path.exists():
        raise CaptureStoreError(f"{path} exists; give another name, or resume_captures to go on")
    kind = "float32" if bits is None else "uint8" if bits <= 8 else "uint16"
    row = _TOGETHER * shape[1] * np.dtype(kind).itemsize
    import zarr  # a second
    from zarr.codecs import Crc32cCodec

    group = zarr.create_group(
        path,
        attributes={
            "kind": _KIND,
            "version": _VERSION,
            **dataclasses.asdict(series),
            "sensor_shape": shape,
            "bits": bits,
            "exposure": exposure,
        },
    )
    group.create_array(
        "frames",
        shape=(series.frame_count, *shape),
        dtype=kind,
        chunks=(_TOGETHER, min(shape[0], max(1, _CHUNK // row)), shape[1]),
        compressors=[Crc32cCodec()],
        dimension_names=("frame", "y", "x"),
    )
    digests = group.create_array("digests", shape=(series.frame_count,), dtype="uint64")
    digests[:] = np.zeros(series.frame_count, np.uint64)
    return CaptureWriter(path)


def resume_captures(path: str | Path) -> CaptureWriter:
    """Go on with a store that is not complete; `missing` says with which frames."""
    return CaptureWriter(Path(path))


def open_captures(path: str | Path) -> HadamardCaptures:
    """The captures of a calibration, once all are there.

    **Errors**: CaptureStoreError, one line, which names the frames that are missing, truncated, or
    the same as another; none is guessed. Damage within a chunk is found by its checksum when it is
    read.
    """
    path = Path(path)
    group = _opened(path, "r")
    captures = _described(path, group)
    digests = np.asarray(group["digests"][:])
    lost, cut = _lost(path, group["frames"]), _lost(path, group["frames"], truncated=True)
    missing = sorted(set(np.flatnonzero(digests == 0).tolist()) | (lost - cut))
    if missing:
        raise CaptureStoreError(
            f"{path}: {len(missing)} of {len(digests)} frames are missing: {_listed(missing)}; "
            "capture them (resume_captures) or measure again"
        )
    if cut:
        raise CaptureStoreError(
            f"{path}: {len(cut)} of {len(digests)} frames are truncated: {_listed(sorted(cut))}; "
            "capture them again (resume_captures) or copy the store again"
        )
    shown = digests[: captures.series.pattern_frames]
    _, first, counts = np.unique(shown, return_index=True, return_counts=True)
    for index in np.sort(first[counts > 1])[:1]:
        same = np.flatnonzero(shown == shown[index]).tolist()
        raise CaptureStoreError(
            f"{path}: frames {_listed(same)} are the same capture, digit for digit: the camera has "
            "sent an image twice, or sees nothing of the monitor; measure again"
        )
    return captures


def simulate_captures(
    writer: CaptureWriter,
    operator: AbstractOperator,
    key: PRNGKeyArray,
    *,
    deviation: float = 0.0,
    offset: float = 0.0,
) -> HadamardCaptures:
    """The captures of a camera that is known, written as the rig writes them.

    - `operator`: from the cells, 1 is white, to the sensor, in counts (`Scaled` sets the exposure).
    - `deviation`: of white noise, and `offset`: the dark level, in counts. A writer with `bits`
      rounds and clips.

    **Errors**: ValueError where the operator's shapes are not those of the cells and the sensor.
    """
    captures = writer.captures
    series, shape = captures.series, captures.sensor_shape
    given, wanted = (operator.in_shape, operator.out_shape), (series.object_shape, shape)
    if given != wanted:
        raise ValueError(f"the operator goes from {given[0]} to {given[1]}; give {wanted}")
    kind = dtype_of(operator)
    for start in range(0, series.frame_count, _TOGETHER):
        numbers = range(start, min(start + _TOGETHER, series.frame_count))
        cells = np.stack([series.frame(number) for number in numbers]).astype(kind)
        noise = jax.random.normal(jax.random.fold_in(key, start), (len(numbers), *shape), kind)
        images = np.asarray(operator(jnp.asarray(cells)) + deviation * noise + offset)
        if captures.bits is not None:
            images = np.clip(np.rint(images), 0, 2**captures.bits - 1)
        for number, image in zip(numbers, images, strict=True):
            writer.write(number, image)
    writer.close()
    return open_captures(captures.path)


def _opened(path: Path, mode: str) -> Any:
    import zarr

    try:
        group = zarr.open_group(path, mode=mode)  # pyright: ignore[reportArgumentType]
        if group.attrs["kind"] != _KIND or group.attrs["version"] != _VERSION:
            raise ValueError(f"{group.attrs['kind']}, version {group.attrs['version']}")
        return group
    except (OSError, ValueError, KeyError) as error:
        raise CaptureStoreError(
            f"{path} is no store of Hadamard captures ({type(error).__name__}: {error}); give one "
            "that create_captures made"
        ) from error


def _described(path: Path, group: Any) -> HadamardCaptures:
    """What the attributes say, once the arrays agree with it."""
    attributes = dict(group.attrs)
    try:
        names = [field.name for field in dataclasses.fields(HadamardSeries)]
        values: dict[str, Any] = {name: attributes[name] for name in names}
        values["object_shape"] = tuple(values["object_shape"])
        series = HadamardSeries(**values)
        rows, columns = attributes["sensor_shape"]
        shapes = [group[name].shape for name in ("frames", "digests")]
        expected = [(series.frame_count, rows, columns), (series.frame_count,)]
        if shapes != expected:
            raise ValueError(f"arrays of shapes {shapes}, but the series has {expected}")
        bits, exposure = attributes["bits"], attributes["exposure"]
    except (KeyError, TypeError, ValueError) as error:
        raise CaptureStoreError(f"{path} contradicts itself: {error}; measure again") from error
    return HadamardCaptures(path, series, (rows, columns), bits, exposure)


def _lost(path: Path, frames: Any, *, truncated: bool = False) -> set[int]:
    """The frames of chunks that are not there or not whole; or only those of the latter."""
    # A chunk at the edge is stored as large as the others; 4 bytes are the checksum.
    whole = int(np.prod(frames.chunks)) * frames.dtype.itemsize + 4
    counts = [-(-size // part) for size, part in zip(frames.shape, frames.chunks, strict=True)]
    found = set()
    for chunk, row in np.ndindex(*counts[:2]):
        file = path / "frames" / "c" / str(chunk) / str(row) / "0"
        there = file.is_file()
        if there and file.stat().st_size != whole or not there and not truncated:
            found.update(range(chunk * _TOGETHER, min((chunk + 1) * _TOGETHER, frames.shape[0])))
    return found


def _damaged(frames: Any) -> list[str]:
    """The frames of each chunk that cannot be read."""
    found = []
    for first in range(0, frames.shape[0], _TOGETHER):
        try:
            _ = frames[first : first + _TOGETHER]
        except (ValueError, OSError):
            found.append(f"{first} … {min(first + _TOGETHER, frames.shape[0]) - 1}")
    return found


def _digest(pixels: np.ndarray) -> int:
    """64 bits of the pixels' hash, never 0."""
    digest = hashlib.blake2b(pixels.tobytes(), digest_size=8).digest()
    return int.from_bytes(digest, "little") or 1


def _listed(numbers: list[int]) -> str:
    more = f" and {len(numbers) - _NAMED} more" if len(numbers) > _NAMED else ""
    return ", ".join(map(str, numbers[:_NAMED])) + more
