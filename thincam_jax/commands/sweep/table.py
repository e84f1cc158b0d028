"""Rows of a sweep as Parquet, and one table of many."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
from pyarrow import csv

_PLAIN = ("point", "seconds")  # columns that are neither a swept value nor NAME/METHOD…


def row_bytes(row: dict[str, Any]) -> bytes:
    """One row as a Parquet file, without what helps only with many rows."""
    return _to_bytes(
        pa.Table.from_pylist([row]),
        write_statistics=False,
        store_schema=False,
        use_dictionary=False,
        compression="none",
    )


def read_row(path: Path) -> pa.Table | None:
    """A row that `row_bytes` made; None where there is none that can be read."""
    try:
        return pq.ParquetFile(path, memory_map=False).read()
    except (OSError, pa.ArrowException):
        return None


def joined(rows: Sequence[tuple[dict[str, Any], pa.Table]]) -> pa.Table:
    """One table of rows, each with its swept values.

    The values are those given here: the row may have been written for a grid of other axes.
    """
    measured = pa.concat_tables(
        [row.select(_measured(row)) for _, row in rows], promote_options="permissive"
    )
    columns = {path: _column([values[path] for values, _ in rows]) for path in rows[0][0]}
    for name in sorted(measured.column_names, key=lambda name: name == "seconds"):
        column = measured.column(name)
        # Nothing but missing values, as the PSNR of exact reconstructions: numbers all the same.
        columns[name] = column.cast(pa.float64()) if pa.types.is_null(column.type) else column
    return pa.table(columns)


def parquet_bytes(table: pa.Table) -> bytes:
    """A table as a Parquet file."""
    return _to_bytes(table)


def csv_bytes(table: pa.Table) -> bytes:
    """A table as comma-separated values with a line of headings."""
    sink = pa.BufferOutputStream()
    csv.write_csv(table, sink)
    return sink.getvalue().to_pybytes()


def _measured(row: pa.Table) -> list[str]:
    return [name for name in row.column_names if "/" in name or name in _PLAIN]


def _column(values: list[Any]) -> pa.Array:
    try:
        return pa.array(values)
    except (pa.ArrowInvalid, pa.ArrowTypeError):  # numbers and texts
        return pa.array([None if value is None else str(value) for value in values])


def _to_bytes(table: pa.Table, **options: Any) -> bytes:
    sink = pa.BufferOutputStream()
    pq.write_table(table, sink, **options)
    return sink.getvalue().to_pybytes()
