"""Writing a store: frames first, then the lines of the journal that announce them.

A thread writes and waits for the disk while the next frame is exposed. Frames reach the disk before
their lines, so that every announced frame is there; a frame without a line is retaken.
"""

import os
import platform
import shutil
from collections.abc import Iterator, Mapping
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
from thincam_jax._core.files import write_whole, writing
from thincam_jax.hardware.acquisition.journal import Journal, frame_records, sync_path

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

    `missing` are the steps not yet taken. Leaving the context writes the frames still queued.
    """

    def __init__(self, path: Path):
        self.store = CaptureStore(path, "r+")
        self._journal = Journal(path / JOURNAL)
        digests = np.zeros_like(self.store.digests)
        taken = frame_records(path / JOURNAL, self._journal.records, len(digests))
        for step, record in taken.items():
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
