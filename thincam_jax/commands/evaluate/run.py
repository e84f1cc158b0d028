"""Running an evaluation: the pairs that its folder does not hold yet, and the table of all."""

import csv
import io
import json
import time
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from thincam_jax._core.environment import environment
from thincam_jax._core.precision import is_double
from thincam_jax._core.text import slug
from thincam_jax.commands.evaluate import page
from thincam_jax.commands.evaluate.config import EvaluationConfig, label_of
from thincam_jax.commands.evaluate.pair import Scored, key_of, opened, score_pair
from thincam_jax.commands.report import render_report
from thincam_jax.commands.run_folder import RunFolder, to_json
from thincam_jax.commands.sweep.workers import Died, Outcomes, Progress, tried_twice, workers_of
from thincam_jax.measured.pairs import Pairs
from thincam_jax.studies.agreement import MethodSummary, summarised
from thincam_jax.studies.intervals import Intervals, PixelSample

_COLUMNS = (
    *("number", "name", "method", "psnr_db", "ssim", "residual", "status", "gain", "offset"),
    *("shift", "seconds"),
)


class EvaluationFolder(RunFolder):
    """Files of one comparison. Every file is written whole or not at all.

    - `evaluation.yaml`: the options. `pairs/METHOD/NUMBER-NAME.json`: scores of a pair, with a
      digest of all that they depend on, or why there are none. Other methods and more pairs with
      the same options join them.
    - `table.csv`: a row for each pair and method. `images/`: worst, median and best.
    - `intervals/METHOD.json`: see `studies.intervals`; of twelve pairs or more.
    - `report.html` and, last, `metrics.json`.
    """

    kind, config, pictures = "comparison", "evaluation.yaml", "images"
    folders = ("pairs", "images", "intervals")
    others = ("table.csv", "report.html")

    def claim(self, config: Any) -> None:
        """Make the folder; what it holds of the same options stays."""
        self.make(config)
        for cut_off in self.path.glob("pairs/*/.*.partial"):  # of a process that was killed
            cut_off.unlink(missing_ok=True)

    def keep(self, name: str, found: Scored) -> None:
        """Write the scores of a pair, with their sum."""
        held = {"key": found.key, "scores": found.scores, "seconds": found.seconds}
        if found.reason is not None:
            held = {"key": found.key, "reason": found.reason, "traceback": found.traceback}
        (self.path / "pairs" / name).parent.mkdir(exist_ok=True)
        self.write_entries(f"pairs/{name}.json", json.loads(json.dumps(held)))

    def held(self, name: str) -> dict[str, Any]:
        """Entries kept of a pair; none where its file is missing or damaged."""
        return self.entries(f"pairs/{name}.json") or {}


@dataclass(frozen=True)
class PairTask:
    """A pair and a method, and its `label`. `file`: name of its scores in the folder."""

    method: str
    number: int
    name: str

    @property
    def label(self) -> str:
        return label_of(self.method)

    @property
    def file(self) -> str:
        return f"{self.label}/{self.number:06d}-{slug(self.name)[:60]}"


@dataclass(frozen=True)
class Evaluated:
    """End of an evaluation: scores of each method, why others have none, and findings."""

    scores: tuple[MethodSummary, ...]
    failures: dict[str, str]
    findings: dict[str, list[str]]


@dataclass(frozen=True)
class Work:
    """Workers of an evaluation, and a file of published figures for its page.

    - `scheduler`: address of a dask scheduler; None: `workers` local processes.
    """

    scheduler: str | None = None
    workers: int | None = None
    published: Path | None = None


def tasks_of(pairs: Pairs, methods: Sequence[str], limit: int | None) -> list[PairTask]:
    """Every method for each of the first `limit` pairs."""
    names = enumerate(list(pairs.names)[:limit])
    return [PairTask(method, number, name) for number, name in names for method in methods]


def run_evaluation(
    config: EvaluationConfig,
    tasks: Sequence[PairTask],
    folder: EvaluationFolder,
    progress: Progress,
    work: Work = Work(),
) -> Evaluated:
    """Score every pair that the folder, which must have been claimed, does not hold; write all.

    Workers read the pairs: those of a scheduler need the files at the same place. Each score is
    written as it ends, by this process. `progress` is called with the numbers of scores that have
    ended and that have failed.

    **Errors**: ConfigError where the scheduler cannot be reached or goes away.
    """
    text, double, began = config.model_dump_json(), is_double(), time.time()
    beside = page.read_published(work.published)  # before all else
    todo = [task for task in tasks if not _is_done(folder, text, task, double)]
    done, failed = len(tasks) - len(todo), 0
    progress(done, failed)
    with workers_of(work.scheduler, work.workers, len(tasks)) as outcomes:
        for task, scored in _scored(outcomes, text, todo, double):
            done, failed = done + 1, failed + (scored.reason is not None)
            folder.keep(task.file, scored)
            progress(done, failed)
        rows, failures = _collect(folder, tasks)
        folder.write("table.csv", _csv(rows))
        ranked = _ranked(rows)
        chosen = [task for task in tasks if task.number in ranked.values()]
        shown = {task: one.shown for task, one in _scored(outcomes, text, chosen, double, True)}
    scores = {(row["number"], row["method"]): row for row in rows}
    parts = []
    for word, number in ranked.items():
        one = {t.label: held for t, held in shown.items() if t.number == number}
        psnrs = {m: scores.get((number, m), {}).get("psnr_db") for m in one}
        name = next(task.name for task in chosen if task.number == number)
        parts.append(page.pictures(folder, word, name, one, psnrs))
    counts = Counter(task.label for task in failures)
    reasons = {task.file: reason for task, reason in failures.items()}
    findings = {f"{r['method']}, {r['name']}": r["findings"] for r in rows if r["findings"]}
    found = Evaluated(summarised(rows, counts), reasons, findings)
    for method in (one.method for one in found.scores if one.covered):
        samples = PixelSample.of_rows(row for row in rows if row["method"] == method)
        folder.write(f"intervals/{method}.json", Intervals.calibrated(samples).as_json())
    whole = page.whole_page(config, opened(text)[1], found, parts, beside)
    surroundings = environment(time.time() - began)
    folder.write("report.html", render_report(whole, config, folder.path, surroundings, "images"))
    folder.write(
        folder.result, to_json({**asdict(found), "fit": config.fit, "shift": config.shift})
    )
    return found


def _is_done(folder: EvaluationFolder, config: str, task: PairTask, double: bool) -> bool:
    """Whether the folder has its scores, of the same files and options. Failures are tried anew."""
    held = folder.held(task.file)
    return "scores" in held and held["key"] == key_of(config, task.method, task.number, double)


def _scored(
    outcomes: Outcomes, config: str, tasks: Sequence[PairTask], double: bool, images: bool = False
) -> Iterator[tuple[PairTask, Scored]]:
    """Tasks in the order in which they end; a worker that dies is a score that failed."""
    named = {task.file: task for task in tasks}
    arguments = {n: (config, t.method, t.number, double, images) for n, t in named.items()}
    for name, result in tried_twice(outcomes, score_pair, arguments):
        why = "worker died" if isinstance(result, Died) else str(result)
        yield named[name], result if isinstance(result, Scored) else Scored("", reason=why)


def _collect(
    folder: EvaluationFolder, tasks: Sequence[PairTask]
) -> tuple[list[dict[str, Any]], dict[PairTask, str]]:
    rows, failures = [], {}
    for task in tasks:
        held = folder.held(task.file)
        if "scores" in held:
            rows.append(
                {**asdict(task), "method": task.label, **held["scores"], "seconds": held["seconds"]}
            )
        else:
            failures[task] = held.get("reason", "nothing was kept")
    return rows, failures


def _csv(rows: Sequence[Mapping[str, Any]]) -> str:
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(_COLUMNS)
    for row in rows:
        values = (row[name] for name in _COLUMNS)
        writer.writerow([" ".join(map(str, v)) if isinstance(v, list) else v for v in values])
    return text.getvalue()


def _ranked(rows: Sequence[Mapping[str, Any]]) -> dict[str, int]:
    """Pairs with the lowest, middle and highest PSNR of the first method."""
    first = [row for row in rows if row["method"] == rows[0]["method"]]
    order = sorted((r["psnr_db"], r["number"]) for r in first if r["psnr_db"] is not None)
    places = {"worst": 0, "median": (len(order) - 1) // 2, "best": len(order) - 1}
    return {word: order[place][1] for word, place in places.items() if order}
