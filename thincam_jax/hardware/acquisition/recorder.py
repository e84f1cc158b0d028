"""Writing a store: frames first, then the lines of the journal that announce them.

Each line is a JSON object {"crc32": …, "records": […]}, with the checksum of the records' canonical
JSON: those of the frames that reached the disk together. A line is on disk (fsync) before the next
is begun, so that a power cut can tear only the last: it is discarded, and its frames are retaken.

A thread writes and waits for the disk while the next frame is exposed. Frames reach the disk before
their lines, so that every announced frame is there; a frame without a line is retaken.
"""

import json
import math
import os
import platform
import shutil
import zlib
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import AbstractContextManager, contextmanager
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from filelock import FileLock
from filelock import Timeout as LockTimeout

from thincam_jax._core.capture_store import CaptureStore, CaptureStoreError, frame_digest
from thincam_jax._core.files import read_regular, write_whole, writing
from thincam_jax._core.text import of_error
from thincam_jax.hardware.acquisition.plan import canonical_json


class Journal:
    """A journal open for writing; a torn last line is removed first."""

    def __init__(self, path: Path):
        self.records, whole = _parsed(path)
        with writing(path):
            self._file = os.open(path, os.O_RDWR | os.O_CREAT, 0o644)
        os.ftruncate(self._file, whole)
        os.lseek(self._file, 0, os.SEEK_END)

    def append(self, records: Sequence[Any]) -> None:
        """Write a line and wait until it is on disk."""
        text = canonical_json(list(records))
        line = {"crc32": zlib.crc32(text.encode()), "records": list(records)}
        data = canonical_json(line).encode() + b"\n"
        while data:
            data = data[os.write(self._file, data) :]
        os.fsync(self._file)

    def close(self) -> None:
        os.close(self._file)


def read_journal(path: Path) -> list[Any]:
    """Records of a journal, without a torn last line.

    **Errors**: CaptureStoreError for a damaged line before the last one.
    """
    return _parsed(path)[0]


def frame_records(path: Path, records: Sequence[Any], steps: int) -> dict[int, Any]:
    """Records of frames by the number of their step, the last of each.

    **Errors**: CaptureStoreError for what no acquisition of so many steps wrote.
    """
    found = {}
    try:
        for record in (one for one in map(dict, records) if "step" in one):
            step, place = record["step"], record["position"]
            known = type(step) is int and 0 <= step < steps and len(bytes.fromhex(record["digest"]))
            if known != 8 or not (place is None or math.isfinite(place)):
                raise ValueError(f"step {step}, digest {record['digest']}, position {place}")
            found[step] = record
    except (TypeError, ValueError, KeyError, OverflowError) as error:
        cause = f"{path}: holds a record that is none of a frame ({of_error(error)})"
        raise CaptureStoreError(f"{cause}; restore a copy, or begin another store") from error
    return found


def sync_path(path: Path) -> None:
    """Wait until a file, or the names in a folder, are on disk."""
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def _parsed(path: Path) -> tuple[list[Any], int]:
    """Records of all complete lines, and their length in bytes."""
    try:
        data = read_regular(path) if path.exists() else b""
    except OSError as error:
        raise CaptureStoreError(f"{path}: cannot be read ({error.strerror})") from error
    records, whole = [], 0
    for number, line in enumerate(data.split(b"\n")[:-1], 1):
        found = _records(line)
        end = whole + len(line) + 1
        if found is None and end < len(data):
            raise CaptureStoreError(
                f"{path}: line {number} is damaged, and it is not the last one; restore the file "
                "from a copy, or begin another store"
            )
        if found is None:
            break
        records += found
        whole = end
    return records, whole


def _records(line: bytes) -> list[Any] | None:
    """Records of a line; None for a damaged one."""
    try:
        held = json.loads(line)
        records = held["records"]
        sound = held["crc32"] == zlib.crc32(canonical_json(records).encode())
        return records if sound and isinstance(records, list) else None
    except (ValueError, KeyError, TypeError, RecursionError):
        return None


JOURNAL, PLAN = "journal.jsonl", "plan.json"
_HELD = 2**26  # bytes of frames that may wait for the disk
_AT_ONCE = 8  # files that are synced at once: the disk writes its own journal once for all of them


@contextmanager
def locked(path: Path) -> Iterator[None]:
    """Keep other runs from writing the same store meanwhile."""
    lock = FileLock(path.with_name(f".{path.name}.lock"))
    with writing(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            lock.acquire(timeout=0)
        except LockTimeout as error:
            raise CaptureStoreError(
                f"{path} is being written by another run; wait for it, or give another name"
            ) from error
    try:
        yield
    finally:
        lock.release()


def create_store(path: Path, plan: str, *layout: Any, together: int) -> None:
    """Create a store atomically; `layout` as in `CaptureStore.create`."""
    partial = path.with_name(f".{path.name}.partial")
    shutil.rmtree(partial, ignore_errors=True)  # of a run that was killed at this point
    with writing(path):
        CaptureStore.create(partial, *layout, together=together)
        write_whole(partial / PLAN, plan)
        for file in (*partial.rglob("*"), partial):
            sync_path(file)
        os.rename(partial, path)
        sync_path(path.parent)


def require_space(path: Path, size: int) -> None:
    """Raise CaptureStoreError where the disk has no room for so many bytes."""
    free = shutil.disk_usage(path.parent).free
    if size > free:
        raise CaptureStoreError(
            f"{path} needs {size / 1e9:.3g} GB more and {free / 1e9:.3g} GB are free; make room, "
            "or give another folder"
        )


def versions() -> dict[str, str]:
    """Versions of Python and of the packages that take the frames."""
    names = ("thincam_jax", "numpy", "zarr")
    return {"python": platform.python_version(), **{name: version(name) for name in names}}


def now() -> str:
    """Present time in UTC, ISO 8601."""
    return datetime.now(UTC).isoformat(timespec="milliseconds")


class Recorder(AbstractContextManager["Recorder"]):
    """Writer of a store's frames in the order of its steps; a context manager.

    `missing` are the steps not yet taken, `taken` the records of the others by step. Leaving the
    context writes the frames still queued.
    """

    def __init__(self, path: Path):
        self.store = CaptureStore(path, "r+")
        self._journal = Journal(path / JOURNAL)
        digests = np.zeros_like(self.store.digests)
        self.taken = frame_records(path / JOURNAL, self._journal.records, len(digests))
        for step, record in self.taken.items():
            digests[step] = int(record["digest"], 16)
        digests[sorted(self.store.lost())] = 0
        self._digests = digests
        self.missing = [int(step) for step in np.flatnonzero(digests == 0)]
        self.store.tidy(self.missing)
        self._waiting: dict[int, tuple[np.ndarray, dict[str, Any]]] = {}
        self._thread = ThreadPoolExecutor(1, "frames to disk")
        self._helpers = ThreadPoolExecutor(_AT_ONCE, "digests and fsync")
        self._saving: Future[None] | None = None

    def note(self, record: Mapping[str, Any]) -> None:
        """Write a line that is no frame, as at the begin of a run."""
        self._wait()
        self._journal.append([record])

    def add(self, step: int, pixels: np.ndarray, facts: Mapping[str, Any]) -> None:
        """Queue a frame, not to be changed afterwards; `facts` go to its line in the journal.

        **Errors**: WriteError for an earlier frame that could not be written.
        """
        kept = pixels.astype(self.store.frames.dtype, copy=False)
        self._waiting[step] = kept, {"step": step, "taken": now(), **facts}
        whole = step == self.store.chunk(step)[-1]
        full = len(self._waiting) * kept.nbytes >= _HELD
        idle = self._saving is None or self._saving.done()
        if whole and (idle or full):
            self._save()

    def __exit__(self, *_: object) -> None:
        try:
            if self._waiting:
                self._save()
            self._wait()
            self.store.announce(self._digests)
        finally:
            self._thread.shutdown()
            self._helpers.shutdown()
            self._journal.close()

    def _wait(self) -> None:
        if self._saving is not None:
            saving, self._saving = self._saving, None
            with writing(self.store.path):
                saving.result()

    def _save(self) -> None:
        self._wait()
        waiting, self._waiting = self._waiting, {}
        self._saving = self._thread.submit(self._write, waiting)

    def _write(self, waiting: dict[int, tuple[np.ndarray, dict[str, Any]]]) -> None:
        images = {step: pixels for step, (pixels, _) in waiting.items()}
        digests = self._helpers.map(frame_digest, images.values())  # while the frames are written
        self.store.write(images)
        list(self._helpers.map(sync_path, self.store.files(waiting)))
        records = [
            {**record, "digest": f"{digest:016x}"}
            for digest, (_, record) in zip(digests, waiting.values(), strict=True)
        ]
        self._journal.append(records)
        for record in records:
            self._digests[record["step"]] = int(record["digest"], 16)
