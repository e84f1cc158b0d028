"""The folder of a sweep: a file for every finished point, and the tables made of them."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from thincam_jax._core.files import read_regular, write_whole
from thincam_jax.commands.checked_config import dump_config
from thincam_jax.commands.run_folder import claim_folder
from thincam_jax.commands.study.config import StudyConfig
from thincam_jax.commands.sweep import table
from thincam_jax.commands.sweep.measure import Outcome
from thincam_jax.commands.sweep.point import GridPoint


class SweepFolder:
    """Files of one sweep. Every file is written whole or not at all.

    - `study.yaml`: the resolved configuration that every point begins from.
    - `points/KEY.parquet`: the row of a point that succeeded, `points/KEY.failed.json` why one
      failed; written when it ends. KEY stands for the point's configuration.
    - `results.parquet`, the same as `results.csv`, and `failures.jsonl`: those of the current grid,
      in its order. `summary.png`: PSNR along its axes, of a sweep that has ended.
    """

    def __init__(self, path: str | Path):
        self.path = Path(path)

    def claim(self, base: StudyConfig) -> None:
        """Make the folder; refuse one of another study, or of other things.

        Another grid of the same study is welcome: points are recognised by their configuration.
        """
        claim_folder(self.path, "study.yaml", dump_config(base), "sweep", ("points",))

    def has(self, point: GridPoint) -> bool:
        """Whether the point has succeeded before; a row that cannot be read does not count."""
        return table.read_row(self._row(point)) is not None

    def keep(self, point: GridPoint, outcome: Outcome) -> None:
        """Write what became of a point."""
        if outcome.metrics is None:
            told = {"point": point.key, "values": point.values, "reason": outcome.reason}
            if outcome.traceback:
                told["traceback"] = outcome.traceback
            write_whole(self._failure(point), json.dumps(told, ensure_ascii=False) + "\n")
        else:
            row = {**point.values, "point": point.key, **outcome.metrics}
            write_whole(self._row(point), table.row_bytes(row))
            self._failure(point).unlink(missing_ok=True)

    def collect(
        self, points: Sequence[GridPoint]
    ) -> tuple[table.pa.Table | None, list[dict[str, Any]]]:
        """Write the tables of what has ended; that of the rows, and the failures."""
        rows, failures = [], []
        for point in points:
            row = table.read_row(self._row(point))
            if row is not None:
                rows.append((point.values, row))
            elif self._failure(point).exists():
                failures.append(json.loads(read_regular(self._failure(point))))
        found = table.joined(rows) if rows else None
        for name, content in (
            ("results.parquet", None if found is None else table.parquet_bytes(found)),
            ("results.csv", None if found is None else table.csv_bytes(found)),
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
