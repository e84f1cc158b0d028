"""The captures of a Hadamard calibration on disk: written frame by frame, read by sensor rows.

A chunk of the store holds 16 frames of some rows, a compromise between writing single frames and
reading all frames of some rows.
"""

import dataclasses
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Real

from thincam_jax._core import checks
from thincam_jax._core.capture_store import (
    CALIBRATION,
    TOGETHER,
    CaptureStore,
    CaptureStoreError,
    dtype_of_bits,
    frame_digest,
    listed,
)
from thincam_jax._core.checks import Shape
from thincam_jax._core.random import Key, random_key
from thincam_jax.imaging.operators import AbstractOperator
from thincam_jax.imaging.operators.base import dtype_of
from thincam_jax.measured.calibration.hadamard import HadamardSeries


@dataclasses.dataclass(frozen=True)
class HadamardCaptures:
    """A complete set of captures on disk.

    - `series`: the patterns shown.
    - `sensor_shape`: (rows, columns).
    - `bits`: bits of the camera; None: any numbers.
    - `exposure`: time, s, if known.
    - `stored_at`: place in the store of each frame of the series; None: the same order.
    - `frames`: kept in memory, in place of the store at `path`.
    """

    path: Path
    series: HadamardSeries
    sensor_shape: tuple[int, int]
    bits: int | None
    exposure: float | None
    stored_at: tuple[int, ...] | None = None
    frames: Real[np.ndarray, "frame y x"] | None = dataclasses.field(default=None, compare=False)

    @staticmethod
    def create(
        path: str | Path,
        series: HadamardSeries,
        sensor_shape: Shape,
        *,
        bits: int | None = None,
        exposure: float | None = None,
    ) -> "CaptureWriter":
        """Create a store for the captures of a calibration.

        - `bits`: bits of the camera, up to 16, for whole counts; None: any numbers, in float32.
        - `exposure`: time, s, for the record.

        **Errors**: CaptureStoreError where something is at `path` already.
        """
        path, shape = Path(path), checks.shape2d("sensor_shape", sensor_shape)
        if bits is not None and not 1 <= bits <= 16:
            raise ValueError(f"bits = {bits}; give 1 to 16, or None for any numbers")
        if path.exists():
            known = "give another name, or go on by HadamardCaptures.resume"
            raise CaptureStoreError(f"{path} exists; {known}")
        CaptureStore.create(
            path,
            (series.frame_count, *shape),
            dtype_of_bits(bits),
            {
                "kind": CALIBRATION,
                **dataclasses.asdict(series),
                "sensor_shape": shape,
                "bits": bits,
                "exposure": exposure,
            },
        )
        return CaptureWriter(path)

    @staticmethod
    def resume(path: str | Path) -> "CaptureWriter":
        """Continue an incomplete store with its `missing` frames."""
        return CaptureWriter(Path(path))

    @classmethod
    def load(cls, path: str | Path) -> "HadamardCaptures":
        """Open the complete captures of a calibration.

        **Errors**: CaptureStoreError, one line, which names the frames that are missing, truncated
        or identical. Damage within a chunk is detected by its checksum when it is read.
        """
        path = Path(path)
        store = _opened(path)
        captures, digests = _described(store), store.digests
        lost, cut = store.lost(), store.lost(truncated=True)
        missing = sorted(set(np.flatnonzero(digests == 0).tolist()) | (lost - cut))
        if missing:
            raise CaptureStoreError(
                f"{path}: {len(missing)} of {len(digests)} frames are missing: {listed(missing)}; "
                "capture them (HadamardCaptures.resume, or the same acquisition again)"
            )
        if cut:
            raise CaptureStoreError(
                f"{path}: {len(cut)} of {len(digests)} frames are truncated: {listed(sorted(cut))}"
                "; capture them (HadamardCaptures.resume, or the same acquisition) or copy it again"
            )
        if captures.stored_at is not None:
            digests = digests[list(captures.stored_at)]
        shown = digests[: captures.series.pattern_frames]
        _, first, counts = np.unique(shown, return_index=True, return_counts=True)
        for index in np.sort(first[counts > 1])[:1]:
            same = np.flatnonzero(shown == shown[index]).tolist()
            raise CaptureStoreError(
                f"{path}: frames {listed(same)} are the same capture, digit for digit: the camera "
                "has sent an image twice, or sees nothing of the monitor; measure again"
            )
        return captures

    @property
    def block_rows(self) -> int:
        """Sensor rows of a chunk, best read at once."""
        in_memory = self.frames is not None
        return self.sensor_shape[0] if in_memory else _opened(self.path).frames.chunks[1]

    def rows(self, start: int, stop: int) -> Real[np.ndarray, "frame y x"]:
        """All frames of some sensor rows, in the order of the series."""
        if self.frames is not None:
            return self.frames[:, start:stop]
        frames = _opened(self.path).read(slice(None), slice(start, stop))
        return frames if self.stored_at is None else frames[list(self.stored_at)]


class CaptureWriter(AbstractContextManager["CaptureWriter"]):
    """Writer of a calibration's frames in any order; a context manager.

    Complete chunks of 16 frames are written at once, the others when it is closed.
    """

    def __init__(self, path: Path):
        self._store = _opened(path, "r+")
        if "acquisition" in self._store.attributes:
            raise CaptureStoreError(
                f"{path} was made by an acquisition; run the same acquisition again to go on"
            )
        self.captures = _described(self._store)
        self._digests = self._store.digests.copy()
        self._digests[sorted(self._store.lost())] = 0
        self._waiting: dict[int, np.ndarray] = {}

    @property
    def missing(self) -> list[int]:
        """Numbers of the frames not yet written."""
        return [int(n) for n in np.flatnonzero(self._digests == 0)]

    def write(self, number: int | np.integer, image: Real[np.ndarray, "y x"] | Array) -> None:
        """Store the capture of frame `number`, in counts of the camera.

        **Errors**: CaptureStoreError, one line, for a number out of range or written before,
        another shape, and values outside the camera's range.
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
        self._digests[number] = frame_digest(pixels)
        if all(n in self._waiting for n in self._store.chunk(number)):
            self._write_out(number)

    def close(self) -> None:
        """Write the frames of incomplete chunks."""
        while self._waiting:
            self._write_out(min(self._waiting))

    def __exit__(self, *error: object) -> None:
        self.close()

    def _write_out(self, number: int) -> None:
        """Write the available frames of a frame's chunk."""
        ready = [n for n in self._store.chunk(number) if n in self._waiting]
        self._store.write({n: self._waiting[n] for n in ready})
        for n in ready:
            del self._waiting[n]
        # After the frames, so that every announced frame is there.
        written = self._digests.copy()
        written[list(self._waiting)] = 0
        self._store.announce(written)

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
        return pixels.astype(self._store.frames.dtype)


def simulate_captures(
    writer: CaptureWriter | HadamardSeries,
    operator: AbstractOperator,
    key: Key,
    *,
    noise_std: float = 0.0,
    offset: float = 0.0,
) -> HadamardCaptures:
    """Simulate the captures of a known camera and write them to a store, or keep them in memory.

    - `writer`: by `HadamardCaptures.create`; or the series alone, whose frames stay in memory.
    - `operator`: from the cells, 1 is white, to the sensor, in counts (`Scaled` sets the exposure).
    - `noise_std`: standard deviation of white noise, and `offset`: the dark level, in counts. For a
      writer with `bits` the counts are rounded and clipped.

    **Errors**: ValueError where the operator's shapes are not those of the cells and the sensor.
    """
    key, kept = random_key(key), []
    if isinstance(writer, HadamardSeries):
        sensor = checks.shape2d("out_shape", operator.out_shape)
        store, captures = None, HadamardCaptures(Path(), writer, sensor, None, None)
    else:
        store, captures = writer, writer.captures
    series, shape = captures.series, captures.sensor_shape
    given, wanted = (operator.in_shape, operator.out_shape), (series.object_shape, shape)
    if given != wanted:
        raise ValueError(f"the operator goes from {given[0]} to {given[1]}; give {wanted}")
    kind = dtype_of(operator)
    for start in range(0, series.frame_count, TOGETHER):
        numbers = range(start, min(start + TOGETHER, series.frame_count))
        cells = np.stack([series.frame(number) for number in numbers]).astype(kind)
        noise = jax.random.normal(jax.random.fold_in(key, start), (len(numbers), *shape), kind)
        images = np.asarray(operator(jnp.asarray(cells)) + noise_std * noise + offset)
        if captures.bits is not None:
            images = np.clip(np.rint(images), 0, 2**captures.bits - 1)
        for number, image in zip(numbers, images, strict=True):
            store.write(number, image) if store else kept.append(image)
    if store is None:
        return dataclasses.replace(captures, frames=np.stack(kept).astype(np.float32))
    store.close()
    return HadamardCaptures.load(captures.path)


def _opened(path: Path, mode: str = "r") -> CaptureStore:
    return CaptureStore(path, mode, (CALIBRATION,))


def _described(store: CaptureStore) -> HadamardCaptures:
    """Captures as the attributes describe them, checked against the arrays."""
    path, attributes = store.path, store.attributes
    try:
        names = [field.name for field in dataclasses.fields(HadamardSeries)]
        values: dict[str, Any] = {name: attributes[name] for name in names}
        values["object_shape"] = tuple(values["object_shape"])
        series = HadamardSeries(**values)
        rows, columns = attributes["sensor_shape"]
        shapes = [store.frames.shape, store.digests.shape]
        expected = [(series.frame_count, rows, columns), (series.frame_count,)]
        if shapes != expected:
            raise ValueError(f"arrays of shapes {shapes}, but the series has {expected}")
        bits, exposure = attributes["bits"], attributes["exposure"]
        stored_at = attributes.get("stored_at")
        if stored_at is not None and sorted(stored_at) != list(range(series.frame_count)):
            raise ValueError(f"stored_at does not name each of {series.frame_count} frames once")
    except (KeyError, TypeError, ValueError) as error:
        raise CaptureStoreError(f"{path} contradicts itself: {error}; measure again") from error
    stored_at = None if stored_at is None else tuple(stored_at)
    return HadamardCaptures(path, series, (rows, columns), bits, exposure, stored_at)
