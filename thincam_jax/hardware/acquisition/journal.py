"""Which frames of an acquisition are on disk and how each was taken, a line for each.

A line is a JSON object {"crc32": …, "record": …}; the checksum is that of the record's canonical
JSON. A line is on disk (fsync) before the acquisition counts its frame as taken. After a power cut
the last line may be torn: it is discarded, and its frame is taken again.
"""

import json
import os
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from thincam_jax._core.capture_store import CaptureStoreError
from thincam_jax.hardware.acquisition.plan import canonical_json


class Journal:
    """A journal that is open for writing; what was torn off at its end is cut away first."""

    def __init__(self, path: Path):
        self.records, whole = _parsed(path)
        self._file = os.open(path, os.O_RDWR | os.O_CREAT, 0o644)
        os.ftruncate(self._file, whole)
        os.lseek(self._file, 0, os.SEEK_END)

    def append(self, records: Sequence[Any]) -> None:
        """Write lines; they are on disk once this returns."""
        data = b"".join(_line(record) for record in records)
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


def _line(record: Any) -> bytes:
    text = canonical_json(record)
    return canonical_json({"crc32": zlib.crc32(text.encode()), "record": record}).encode() + b"\n"


def _parsed(path: Path) -> tuple[list[Any], int]:
    """The records, and how many bytes of the file they take."""
    data = path.read_bytes() if path.exists() else b""
    records, whole = [], 0
    for number, line in enumerate(data.splitlines(keepends=True), 1):
        record = _record(line)
        if record is None:
            if whole + len(line) < len(data):
                raise CaptureStoreError(
                    f"{path}: line {number} is damaged, and it is not the last one; restore the "
                    "file from a copy, or start another store"
                )
            break
        records.append(record)
        whole += len(line)
    return records, whole


def _record(line: bytes) -> Any:
    """The record of a line that is whole, else None."""
    try:
        held = json.loads(line)
        record = held["record"]
        fits = line.endswith(b"\n") and held["crc32"] == zlib.crc32(canonical_json(record).encode())
        return record if fits else None
    except (ValueError, KeyError, TypeError):
        return None
