"""Pairs in Parquet files, as Hugging Face keeps data sets of images.

Columns `lensless` and `lensed` hold images as their files' bytes, {bytes, path}; `mask_label` the
number of the mask, and `ambient` a capture without the scene, where there are such.
"""

import functools
import hashlib
from bisect import bisect_right
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import accumulate
from pathlib import Path
from typing import Any

from thincam_jax._core.text import of_error
from thincam_jax.measured.layouts import chosen_split
from thincam_jax.measured.pairs import Pairs, Stored
from thincam_jax.measured.raw import MeasurementError, Raw
from thincam_jax.measured.read import read_photograph

_IMAGES = ("lensless", "lensed", "ambient")


@dataclass(frozen=True, eq=False)
class ParquetPairs:
    """Rows of the files of a split; a group of rows is read together, and the last one kept."""

    names: Sequence[str]
    groups: Sequence[tuple[Path, int]]
    ends: Sequence[int]  # number of the row after each group

    def _row(self, number: int) -> dict[str, Any]:
        group = bisect_right(self.ends, number)
        first = self.ends[group - 1] if group else 0
        return _rows(*self.groups[group]).slice(number - first, 1).to_pylist()[0]

    def read(self, number: int, bits: int | None) -> Stored:
        row, name = self._row(number), self.names[number]
        depths = zip(_IMAGES, (bits, None, bits), strict=True)
        capture, truth, ambient = (_image(row.get(n), f"{name}, {n}", depth) for n, depth in depths)
        if capture is None or truth is None:
            raise MeasurementError(f"{name}: a column of images is empty")
        return Stored(name, capture, truth, ambient, row.get("mask_label"))

    def digest(self, number: int) -> str:
        row, known = self._row(number), hashlib.sha256()
        for one in _IMAGES:
            known.update(one.encode() + ((row.get(one) or {}).get("bytes") or b""))
        known.update(str(row.get("mask_label")).encode())
        return known.hexdigest()


def open_parquet(path: Path, files: Sequence[Path], split: str | None) -> Pairs:
    """Pairs of a split's files, SPLIT-00000-of-00012.parquet.

    **Errors**: MeasurementError without pyarrow, and for other columns or damaged files.
    """
    parquet = _library()
    opened = {}
    for file in files:
        try:
            opened[file] = parquet.ParquetFile(file)
        except Exception as error:  # of Arrow
            raise MeasurementError(f"{file}: cannot be read ({of_error(error)})") from None
        columns = {field.name: str(field.type) for field in opened[file].schema_arrow}
        wrong = [one for one in _IMAGES[:2] if "bytes: binary" not in columns.get(one, "")]
        if wrong:
            held = ", ".join(f"{name} ({kind})" for name, kind in columns.items())
            raise MeasurementError(
                f"{file}: has no column {wrong[0]!r} of images as bytes; it has {held}"
            )
    counts: Counter[str] = Counter()
    for file, one in opened.items():
        counts[file.stem.split("-")[0]] += one.metadata.num_rows
    split = chosen_split(path, counts, split)
    groups, sizes, names = [], [], []
    for file, one in opened.items():
        name = file.stem.split("-")[0]
        if split not in (name, "all"):
            continue
        groups += [(file, n) for n in range(one.num_row_groups)]
        sizes += [one.metadata.row_group(n).num_rows for n in range(one.num_row_groups)]
        names += [f"{file.stem}-{n}" for n in range(one.metadata.num_rows)]
    storage = ParquetPairs(names, groups, list(accumulate(sizes)))
    return Pairs("Parquet of images", path, storage, split, dict(counts))


@functools.lru_cache(1)
def _rows(file: Path, group: int) -> Any:
    one = _library().ParquetFile(file)
    wanted = [name for name in (*_IMAGES, "mask_label") if name in one.schema_arrow.names]
    try:
        return one.read_row_group(group, columns=wanted)
    except Exception as error:  # of Arrow
        raise MeasurementError(f"{file}: cannot be read ({of_error(error)})") from None


def _image(held: Any, name: str, bits: int | None) -> Raw | None:
    data = held and held.get("bytes")
    return read_photograph(data, name, bits) if data else None


def _library() -> Any:
    try:
        import pyarrow.parquet
    except ImportError:
        raise MeasurementError(
            "Parquet files are read by pyarrow: pip install 'thincam_jax[datasets]'"
        ) from None
    return pyarrow.parquet
