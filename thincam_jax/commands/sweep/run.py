"""Running a sweep: the points that the folder does not hold yet, into the folder."""

import contextlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from thincam_jax.commands.sweep.folder import SweepFolder
from thincam_jax.commands.sweep.measure import Outcome, measure_point, one_line
from thincam_jax.commands.sweep.point import GridPoint
from thincam_jax.commands.sweep.summary import summarise
from thincam_jax.commands.sweep.workers import Died, Outcomes, local_workers

Progress = Callable[[int, int], object]


@dataclass(frozen=True)
class Swept:
    """How a sweep ended: points, rows of the table, what failed, and the best points in words."""

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
    measure: Callable[[str, bool], Outcome] = measure_point,
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

    def keep(point: GridPoint, outcome: Outcome) -> None:
        nonlocal done, failed
        done, failed = done + 1, failed + (outcome.metrics is None)
        progress(done, failed)
        folder.keep(point, outcome)

    runnable = {key: (p.config, p.double) for key, p in todo.items() if p.config is not None}
    try:
        for point in todo.values():
            if point.config is None:
                keep(point, Outcome(None, point.reason))
        if runnable:
            with connected(scheduler, workers, len(runnable)) as outcomes:
                for key, result in _tried_twice(outcomes, measure, runnable):
                    keep(todo[key], _outcome(result))
    finally:
        table, failures = folder.collect(points)
    if table is None:
        return Swept(len(points), 0, failures)
    best = summarise(folder.path, table, list(points[0].values))
    return Swept(len(points), table.num_rows, failures, best)


def connected(
    scheduler: str | None, workers: int | None, tasks: int
) -> contextlib.AbstractContextManager[Outcomes]:
    """The scheduler's workers, or that many new ones here."""
    if scheduler is None:
        return local_workers(workers, tasks)
    from thincam_jax.commands.sweep.scheduler import scheduled_workers  # needs dask

    return scheduled_workers(scheduler)


def _tried_twice(
    outcomes: Outcomes, measure: Callable, tasks: Mapping[str, tuple]
) -> Iterator[tuple[str, Any]]:
    """A task whose worker died is done once more when no other is under way.

    If that dies too, the death is the task's own: not of a memory that others had filled.
    """
    suspects = []
    for name, result in outcomes(measure, tasks):
        if isinstance(result, Died):
            suspects.append(name)
        else:
            yield name, result
    for name in suspects:
        yield from outcomes(measure, {name: tasks[name]})


def _outcome(result: Any) -> Outcome:
    """A worker that dies and a worker without the package have their reasons too."""
    if isinstance(result, Outcome):
        return result
    return Outcome(None, "worker died" if isinstance(result, Died) else one_line(result))
