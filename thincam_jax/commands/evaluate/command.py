"""The commands `thincam evaluate` and `thincam dataset info`."""

from pathlib import Path
from typing import Annotated, Literal

import typer
from typer import Argument, Option

from thincam_jax.commands.reconstruct import METHODS
from thincam_jax.commands.reconstruct.command import Bits, ImageOptions, SolverOptions, grouped
from thincam_jax.commands.sweep.command import Scheduler, Workers, check_workers
from thincam_jax.commands.terminal import (
    WRONG_INPUT,
    progress_bar,
    reported,
    say_result,
    show,
    tell,
    warn,
)

DataSet = Annotated[Path, Argument(help="Folder of a data set, or a Parquet file.")]
Split = Annotated[str | None, Option(help="Split, or all. Default: test where there is one.")]
Area = Annotated[
    str | None,
    Option(help="Rows and columns of the image that truths cover, such as 45:295,95:428."),
]
Truth = Annotated[
    Literal["linear", "srgb"] | None,
    Option(help="Encoding of truths. Default: sRGB for 8 bit, linear for 16 and floats."),
]


def info(path: DataSet, split: Split = None, bits: Bits = None) -> None:
    """Show layout, splits, PSF, alignment and licence of a data set."""
    with reported(lambda: "interrupted"):
        from thincam_jax.commands.evaluate.page import facts_table
        from thincam_jax.measured.layouts import open_pairs

        table = facts_table(open_pairs(path, split, bits=bits))
    show(table)


@grouped
def evaluate(
    path: DataSet,
    method: Annotated[
        list[str] | None,
        Option(
            help=f"Reconstruction method: {', '.join(METHODS)}, or a file of 'thincam train'. "
            "Repeat it to compare several.",
            autocompletion=lambda: METHODS,
        ),
    ] = None,
    split: Split = None,
    limit: Annotated[int | None, Option(help="First pairs of the split only.")] = None,
    out: Annotated[
        Path | None, Option(help="Folder of the results. Default: runs/NAME-SPLIT.")
    ] = None,
    psf: Annotated[
        Path | None,
        Option(help="PSF, or a folder of one for each mask. Default: that beside the captures."),
    ] = None,
    *,
    files: ImageOptions,
    psf_channels: Annotated[
        Literal["each", "mean"] | None,
        Option(help="each: one PSF for each colour; mean: their mean. Default: as published."),
    ] = None,
    solver: SolverOptions,
    truth: Truth = None,
    truth_area: Area = None,
    flip: Annotated[bool, Option("--flip", help="Turn images by 180° before.")] = False,
    fit: Annotated[
        Literal["levels", "gain", "maximum", "none"],
        Option(help="What is fitted to the truth: gain and offset, gain, maxima, or nothing."),
    ] = "levels",
    shift: Annotated[
        int, Option(help="Most pixels that an image is moved to where it fits its truth.")
    ] = 0,
    published: Annotated[
        Path | None, Option(help="Figures of others (YAML) to show beside, with their sources.")
    ] = None,
    scheduler: Scheduler = None,
    workers: Workers = None,
) -> None:
    """Score solvers over a data set of captures and truths.

    Writes table.csv, metrics.json and report.html with the worst, median and best image. However an
    evaluation ends, the same command goes on with the pairs that are missing; further methods and
    pairs join those that are there.
    """
    kept = 0

    def interrupted() -> str:
        held = f"{kept} images are kept" if kept else "nothing is kept yet"
        return f"interrupted; {held}. The same command goes on from there."

    with reported(interrupted):
        check_workers("evaluate", scheduler, workers, ("dask", "distributed") if scheduler else ())
        from thincam_jax._core.text import slug
        from thincam_jax.commands.config_file import ConfigError
        from thincam_jax.commands.evaluate.config import EvaluationConfig
        from thincam_jax.commands.evaluate.run import (
            EvaluationFolder,
            Work,
            run_evaluation,
            tasks_of,
        )
        from thincam_jax.commands.reconstruct import options
        from thincam_jax.measured.layouts import open_pairs
        from thincam_jax.studies.agreement import scores_table

        if limit is not None and limit < 1:
            raise ConfigError(f"--limit {limit}: give at least 1")
        area = options.read_crop(truth_area, "--truth-area") or (None, None)
        found = open_pairs(path, split, bits=files.bits)
        config = EvaluationConfig(
            name=slug(f"{path.resolve().name}-{found.split}"),
            title=f"Solvers over {path.resolve().name}, {found.split}",
            path=str(path.resolve()),
            split=found.split,
            psf=None if psf is None else str(psf.resolve()),
            background=options.resolved(files.background),
            psf_background=options.resolved(files.psf_background),
            dead=None if files.dead is None else str(files.dead.resolve()),
            bits=files.bits,
            psf_bits=files.psf_bits,
            preparation=files.preparation(psf_channels=psf_channels or found.psf_channels),
            **vars(solver),
            truth=truth,
            rows=area[0],
            columns=area[1],
            flip=flip,
            fit=fit,
            shift=shift,
        )
        methods = tuple(options.read_method(one) for one in method or ("admm-tv",))
        config.check(methods)
        pairs = config.pairs()
        warn([f"{path}: {note}" for note in pairs.notes if "no PSF" not in note])
        tasks = tasks_of(pairs, methods, limit)
        folder = EvaluationFolder.chosen(out, config.name, config)
        folder.claim(config)
        with progress_bar("{task.fields[failed]}") as bar:
            task = bar.add_task(config.name, total=len(tasks), failed="")

            def progress(ended: int, failed: int) -> None:
                nonlocal kept
                kept = ended - failed
                bar.update(task, completed=ended, failed=f"{failed} failed" if failed else "")
                bar.start()

            work = Work(scheduler, workers, published)
            evaluated = run_evaluation(config, tasks, folder, progress, work)
    show(scores_table(evaluated.scores, brief=True))
    say_result("report", folder.path / "report.html")
    if evaluated.failures:
        first, reason = next(iter(evaluated.failures.items()))
        tell(
            f"{len(evaluated.failures)} of {len(tasks)} images failed; the first ({first}): "
            f"{reason}. The same command tries them again."
        )
    if not any(one.images for one in evaluated.scores):
        raise typer.Exit(WRONG_INPUT)
