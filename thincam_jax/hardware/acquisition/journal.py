"""Journal of the frames of an acquisition that are on disk, with a record of each.

Each line is a JSON object {"crc32": …, "records": […]}, with the checksum of the records' canonical
JSON: those of the frames that reached the disk together. A line is on disk (fsync) before the next
is begun, so that a power cut can tear only the last: it is discarded, and its frames are retaken.
"""

import json
import math
import os
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from thincam_jax._core.capture_store import CaptureStoreError
from thincam_jax._core.files import read_regular, writing
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
