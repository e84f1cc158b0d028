"""Which frames of an acquisition are on disk, and how each was taken.

Each line is a JSON object {"crc32": …, "records": […]}, with the checksum of the records' canonical
JSON: those of the frames that reached the disk together. A line is on disk (fsync) before the next
one is begun, so that a power cut can only tear the last: it is discarded, and its frames are taken
again.
"""

import json
import os
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from thincam_jax._core.capture_store import CaptureStoreError
from thincam_jax._core.files import read_regular
from thincam_jax.hardware.acquisition.plan import canonical_json


class Journal:
    """A journal that is open for writing; what was torn off at its end is cut away first."""

    def __init__(self, path: Path):
        self.records, whole = _parsed(path)
        self._file = os.open(path, os.O_RDWR | os.O_CREAT, 0o644)
        os.ftruncate(self._file, whole)
        os.lseek(self._file, 0, os.SEEK_END)

    def append(self, records: Sequence[Any]) -> None:
        """Write a line; it is on disk once this returns."""
        text = canonical_json(list(records))
        line = {"crc32": zlib.crc32(text.encode()), "records": list(records)}
        data = canonical_json(line).encode() + b"\n"
        while data:
            data = data[os.write(self._file, data) :]
        os.fsync(self._file)

    def close(self) -> None:
        os.close(self._file)


def read_journal(path: Path) -> list[Any]:
    """The records of a journal, without a last line that is torn.

    **Errors**: CaptureStoreError for a damaged line before the last one.
    """
    return _parsed(path)[0]


def sync_path(path: Path) -> None:
    """Have a file, or the names in a folder, on disk before this returns."""
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def _parsed(path: Path) -> tuple[list[Any], int]:
    """The records of all whole lines, and how many bytes of the file these take."""
    data = read_regular(path) if path.exists() else b""
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
    """The records of a line that is whole."""
    try:
        held = json.loads(line)
        records = held["records"]
        return records if held["crc32"] == zlib.crc32(canonical_json(records).encode()) else None
    except (ValueError, KeyError, TypeError):
        return None
