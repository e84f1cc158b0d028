"""Running a sweep: the points that its folder does not hold yet, and the tables of them."""

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
from pyarrow import csv

from thincam_jax._core.files import write_whole
from thincam_jax.commands.run_folder import RunFolder, read_entries
from thincam_jax.commands.sweep.point import GridPoint, Metrics, described, measure_point, one_line
from thincam_jax.commands.sweep.workers import Died, Progress, tried_twice, workers_of

_PLAIN = ("point", "seconds")  # columns that are neither a swept value nor NAME/METHOD…
_MEASURE = "mean_psnr_db/"  # of each method, over all targets


class SweepFolder(RunFolder):
    """Files of one sweep. Every file is written whole or not at all.

    - `study.yaml`: the resolved configuration that every point begins from.
    - `points/KEY.parquet`: the row of a point that succeeded, `points/KEY.failed.json` why one
      failed; written when it ends. KEY stands for the point's configuration: other grids of the
      same study are welcome.
    - `results.parquet`, the same as `results.csv`, and `failures.jsonl`: those of the current grid,
      in its order. `summary.png`: PSNR along its axes, of a sweep that has ended.
    """

    kind, config, folders = "sweep", "study.yaml", ("points",)
    others, result = ("results.parquet",), "results.csv"

    def has(self, point: GridPoint) -> bool:
        """Whether the point has succeeded before; a row that cannot be read does not count."""
        return read_row(self._row(point)) is not None

    def keep(self, point: GridPoint, outcome: Metrics) -> None:
        """Write what became of a point."""
        if outcome.metrics is None:
            record = {"point": point.key, "values": point.values, "reason": outcome.reason}
            if outcome.traceback:
                record["traceback"] = outcome.traceback
            write_whole(self._failure(point), json.dumps(record, ensure_ascii=False) + "\n")
        else:
            row = {**point.values, "point": point.key, **outcome.metrics}
            write_whole(self._row(point), row_bytes(row))
            self._failure(point).unlink(missing_ok=True)

    def collect(self, points: Sequence[GridPoint]) -> tuple[pa.Table | None, list[dict[str, Any]]]:
        """Write the tables of what has ended; that of the rows, and the failures."""
        rows, failures = [], []
        for point in points:
            row = read_row(self._row(point))
            if row is not None:
                rows.append((point.values, row))
            elif failure := read_entries(self._failure(point)):
                failures.append(failure)
        found = joined(rows) if rows else None
        for name, content in (
            ("results.parquet", None if found is None else table_bytes(pq.write_table, found)),
            ("results.csv", None if found is None else table_bytes(csv.write_csv, found)),
            ("failures.jsonl", "".join(json.dumps(f, ensure_ascii=False) + "\n" for f in failures)),
        ):
            if content:
                write_whole(self.path / name, content)
            else:
                (self.path / name).unlink(missing_ok=True)
        return found, failures

    def _row(self, point: GridPoint) -> Path:
        return self.path / "points" / f"{point.key}.parquet"

    def _failure(self, point: GridPoint) -> Path:
        return self.path / "points" / f"{point.key}.failed.json"


def row_bytes(row: dict[str, Any]) -> bytes:
    """One row as a Parquet file, without what helps only with many rows."""
    return table_bytes(
        pq.write_table,
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
    own = [
        row.select([name for name in row.column_names if "/" in name or name in _PLAIN])
        for _, row in rows
    ]
    measured = pa.concat_tables(own, promote_options="permissive")
    columns = {path: _column([values[path] for values, _ in rows]) for path in rows[0][0]}
    for name in sorted(measured.column_names, key=lambda name: name == "seconds"):
        column = measured.column(name)
        # Nothing but missing values, as the PSNR of exact reconstructions: numbers all the same.
        columns[name] = column.cast(pa.float64()) if pa.types.is_null(column.type) else column
    return pa.table(columns)


def table_bytes(write: Callable[..., Any], table: pa.Table, **options: Any) -> bytes:
    """A table as the file that a function of PyArrow writes."""
    sink = pa.BufferOutputStream()
    write(table, sink, **options)
    return sink.getvalue().to_pybytes()


def _column(values: list[Any]) -> pa.Array:
    try:
        return pa.array(values)
    except (pa.ArrowInvalid, pa.ArrowTypeError):  # numbers and texts
        return pa.array([None if value is None else str(value) for value in values])


@dataclass(frozen=True)
class Swept:
    """End of a sweep: points, rows of the table, failures, and the best points in words."""

    points: int
    rows: int
    failures: list[dict[str, Any]]
    best: tuple[str, ...] = ()


def run_sweep(
    points: Sequence[GridPoint],
    folder: SweepFolder,
    progress: Progress,
    *,
    scheduler: str | None = None,
    workers: int | None = None,
    measure: Callable[[str, bool], Metrics] = measure_point,
) -> Swept:
    """Measure every point that has no row in the folder, which must have been claimed.

    Each point is written as it ends, by this process: workers need no access to the folder.
    `progress` is called with the numbers of points that have ended and that have failed. The tables
    are written at the end, and on Ctrl-C, which is passed on; the summary at the end only.

    **Errors**: ConfigError where the scheduler cannot be reached or goes away.
    """
    todo = {point.key: point for point in points if not folder.has(point)}
    done, failed = len(points) - len(todo), 0
    progress(done, failed)

    def keep(point: GridPoint, outcome: Metrics) -> None:
        nonlocal done, failed
        done, failed = done + 1, failed + (outcome.metrics is None)
        progress(done, failed)
        folder.keep(point, outcome)

    runnable = {key: (p.config, p.double) for key, p in todo.items() if p.config is not None}
    try:
        for point in todo.values():
            if point.config is None:
                keep(point, Metrics(None, point.reason))
        if runnable:
            with workers_of(scheduler, workers, len(runnable)) as outcomes:
                for key, result in tried_twice(outcomes, measure, runnable):
                    if not isinstance(result, Metrics):  # a worker died, or lacks the package
                        died = isinstance(result, Died)
                        result = Metrics(None, "worker died" if died else one_line(result))
                    keep(todo[key], result)
    finally:
        table, failures = folder.collect(points)
    if table is None:
        return Swept(len(points), 0, failures)
    best = summarise(folder.path, table, list(points[0].values))
    return Swept(len(points), table.num_rows, failures, best)


def summarise(folder: Path, table: pa.Table, axes: Sequence[str]) -> tuple[str, ...]:
    """Write summary.png, and say in a line for each method where its mean PSNR is best.

    `axes`: the columns of swept values. Nothing where no point has a PSNR.
    """
    from thincam_jax.plot.frame import as_png
    from thincam_jax.plot.sweep import draw_sweep

    rows = table.to_pylist()
    methods = {
        name.removeprefix(_MEASURE): name
        for name in table.column_names
        if name.startswith(_MEASURE) and any(row[name] is not None for row in rows)
    }
    if not methods:
        return ()
    write_whole(folder / "summary.png", as_png(draw_sweep(rows, axes, methods)))
    best = []
    for method, column in methods.items():
        row = max((row for row in rows if row[column] is not None), key=lambda row: row[column])
        at = described({path: row[path] for path in axes})
        best.append(f"best mean PSNR of {method}: {row[column]:.2f} dB at {at}")
    return tuple(best)
