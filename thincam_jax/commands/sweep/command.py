"""The command `thincam sweep`."""

from importlib.util import find_spec
from pathlib import Path
from typing import Annotated, Any

import typer

from thincam_jax.commands.terminal import (
    WRONG_INPUT,
    DryRun,
    Overrides,
    progress_bar,
    reported,
    say_result,
    tell,
    warn,
)

_PARTS = ("pyarrow",)
_SCHEDULER_PARTS = ("dask", "distributed", "pyarrow")

Grid = Annotated[
    list[str] | None,
    typer.Option(
        help="Values of one axis: a.b=lo:hi:n, a.b=lo:hi:n:log or a.b=v1,v2,…, with the unit at "
        "the end; * for all entries of a list. Repeat it for further axes."
    ),
]
Out = Annotated[Path | None, typer.Option(help="Folder of the results. Default: runs/NAME-sweep.")]
Scheduler = Annotated[
    str | None, typer.Option(help="Address of a running dask scheduler, tcp://host:port.")
]
Workers = Annotated[
    int | None, typer.Option(help="Worker processes on this machine. Default: one for each core.")
]


def sweep(
    config: Annotated[Path, typer.Argument(help="Experiment file (YAML) of a study.")],
    grid: Grid = None,
    out: Out = None,
    scheduler: Scheduler = None,
    workers: Workers = None,
    set_: Overrides = None,
    dry_run: DryRun = False,
) -> None:
    """Run a study at every point of a grid.

    Writes results.parquet and results.csv, a row for each point, and summary.png. Points that fail
    are kept in failures.jsonl with the reason. However a sweep ends, the same command goes on with
    the points that have no row.
    """
    rows = 0

    def interrupted() -> str:
        kept = f"{rows} points are kept" if rows else "no point is kept yet"
        return f"interrupted; {kept}. The same command goes on from there."

    with reported(interrupted):
        check_workers("sweep", scheduler, workers, _SCHEDULER_PARTS if scheduler else _PARTS)
        from thincam_jax._core.precision import is_double
        from thincam_jax.commands import run
        from thincam_jax.commands.kinds import load_study
        from thincam_jax.commands.sweep.point import doubts, make_points, read_axes
        from thincam_jax.commands.sweep.run import SweepFolder, run_sweep

        study = load_study(config, tuple(set_ or ()), "a sweep takes a study")
        axes = read_axes(grid or [], study.model_dump(mode="json", exclude_none=True))
        points = make_points(study, axes, is_double())
        folder = SweepFolder.chosen(out, f"{study.name}-sweep", study)
        if dry_run:
            run.explain_run(study, f"{len(points)} points; {folder.outcome(study)}")
            return
        folder.claim(study)
        warn(doubts(points))
        with progress_bar("{task.fields[failed]}") as bar:
            task = bar.add_task(study.name, total=len(points), failed="")

            def progress(ended: int, failed: int) -> None:
                nonlocal rows
                rows = ended - failed
                bar.update(task, completed=ended, failed=f"{failed} failed" if failed else "")
                bar.start()

            swept = run_sweep(points, folder, progress, scheduler=scheduler, workers=workers)
    _print(swept, folder.path)


def check_workers(
    command: str, scheduler: str | None, workers: int | None, parts: tuple[str, ...]
) -> None:
    """Refuse numbers of workers, and libraries that are missing. **Errors**: ConfigError."""
    from thincam_jax.commands.config_file import ConfigError

    missing = [name for name in parts if find_spec(name) is None]
    if missing:
        raise ConfigError(
            f"thincam {command} needs {', '.join(missing)}; install them with "
            "pip install 'thincam_jax[sweep]'"
        )
    if workers is not None and workers < 1:
        raise ConfigError(f"--workers {workers}: give at least 1")
    if workers is not None and scheduler is not None:
        raise ConfigError("--workers are local ones; leave it out with --scheduler")


def _print(swept: Any, path: Path) -> None:
    from thincam_jax.commands.sweep.point import described

    table = f"{swept.rows} of {swept.points} points: {path / 'results.parquet'}"
    if swept.rows:
        say_result("results", path / "results.parquet", "\n".join([table, *swept.best]))
    if swept.failures:
        first = swept.failures[0]
        values = described(first["values"])
        tell(
            f"{len(swept.failures)} of {swept.points} points failed; the first ({values}): "
            f"{first['reason']}; all are in {path / 'failures.jsonl'}. "
            "The same command tries them again."
        )
    if not swept.rows:
        raise typer.Exit(WRONG_INPUT)
