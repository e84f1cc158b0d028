"""The command `thincam`."""

import os
import sys
from pathlib import Path
from typing import Annotated

import rich.progress
import rich.table
import typer

from thincam_jax.commands import accuracy as benches
from thincam_jax.commands import doctor as doctoring
from thincam_jax.commands.accuracy.console import accuracy_table, cost_table, verdict
from thincam_jax.commands.config_file import slug
from thincam_jax.commands.design.command import design
from thincam_jax.commands.photo.command import reconstruct
from thincam_jax.commands.refocus.command import refocus
from thincam_jax.commands.refocus.config import RefocusConfig, load_experiment
from thincam_jax.commands.run_folder import RunFolder
from thincam_jax.commands.study.build import build_study
from thincam_jax.commands.study.config import StudyConfig, load_config
from thincam_jax.commands.study.run import run_study
from thincam_jax.commands.sweep.command import sweep
from thincam_jax.commands.terminal import (
    INTERRUPTED,
    USER_ERRORS,
    Overrides,
    columns,
    console,
    fail,
    tell,
)

app = typer.Typer(
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    help="Simulate and reconstruct thin computational cameras.",
)
bench = typer.Typer(no_args_is_help=True, help="Measure what the models of a study cost.")
app.add_typer(bench, name="bench")
app.command()(reconstruct)
app.command()(sweep)
app.command()(design)

ConfigFile = Annotated[Path, typer.Argument(help="Experiment file (YAML); see configs/.")]


@app.command()
def run(
    config: ConfigFile,
    out: Annotated[
        Path | None, typer.Option(help="Run folder; default runs/NAME of the study.")
    ] = None,
    set_: Overrides = None,
) -> None:
    """Run a study: captures, reconstructions, metrics.json, figures and report.html.

    Ctrl-C keeps what is finished; the same command goes on from there.
    """
    folder, study = None, None
    try:
        study = load_experiment(config, tuple(set_ or ()))
        if isinstance(study, RefocusConfig):
            refocus(study, RunFolder(out or Path("runs") / slug(study.name)))
            return
        built = build_study(study)
        folder = RunFolder(out or Path("runs") / slug(study.name))
        with rich.progress.Progress(*columns(), console=console) as bar:
            task = bar.add_task(study.name, total=None)
            metrics = run_study(
                built,
                folder,
                lambda text, total: bar.update(task, advance=1, total=total, description=text),
            )
    except USER_ERRORS as error:
        fail(error)
    except KeyboardInterrupt:
        targets = study.targets if isinstance(study, StudyConfig) and folder else ()
        finished = [t.name for t in targets if folder and folder.finished(t.name) is not None]
        done = ", ".join(finished) if finished else "no target yet"
        tell(f"interrupted; finished: {done}. The same command goes on from there.")
        raise typer.Exit(INTERRUPTED) from None
    _print_results(metrics)
    console.print(f"report: {folder.path / 'report.html'}", highlight=False, soft_wrap=True)


def _print_results(metrics: dict) -> None:
    table = rich.table.Table("method")
    headings = ("PSNR dB", "published", "resolved mm", "published", "cut-off /mm")
    for heading in headings:
        table.add_column(heading, justify="right")
    for name, method in metrics["methods"].items():
        resolved = [t["resolved"] for t in method["targets"].values() if t["resolved"]]
        published = method["published"]
        table.add_row(
            name,
            _number(method["mean_psnr_of_pictures_db"], 1),
            _number(published["psnr_db"], 1),
            _number(resolved[0]["object_mm"] if resolved else None, 2),
            _number(published["resolved_object_mm"], 2),
            _number(method["limits"]["cut_off_cycles_per_mm"], 1),
        )
    console.print(table)


def _number(value: float | None, digits: int) -> str:
    return "–" if value is None else f"{value:.{digits}f}"


@bench.command()
def accuracy(
    config: ConfigFile,
    out: Annotated[
        Path | None, typer.Option(help="Folder of the results; default runs/NAME-accuracy.")
    ] = None,
    size: Annotated[
        list[int] | None,
        typer.Option(help="Pixels along the sensor's longer side; give it once for each size."),
    ] = None,
    capture_size: Annotated[
        int | None, typer.Option(help="The same for captures and reconstructions; default 256.")
    ] = None,
    set_: Overrides = None,
) -> None:
    """Every model's error and time, and what an error of the PSF costs in PSNR.

    Writes accuracy.json and accuracy.png.
    """
    try:
        study = load_config(config, tuple(set_ or ()))
        plan = benches.check(study, benches.Options(tuple(size or ()), capture_size))
        folder = benches.BenchFolder(out or Path("runs") / f"{slug(study.name)}-accuracy")
        with rich.progress.Progress(*columns(), console=console) as bar:
            task = bar.add_task(study.name, total=benches.steps(study, plan))
            results = benches.run_accuracy(
                study, plan, folder, lambda text: bar.update(task, advance=1, description=text)
            )
    except USER_ERRORS as error:
        fail(error)
    except KeyboardInterrupt:
        tell("interrupted; nothing is kept.")
        raise typer.Exit(INTERRUPTED) from None
    console.print(accuracy_table(results))
    console.print(cost_table(results))
    for line in (*verdict(results), f"figure: {folder.path / 'accuracy.png'}"):
        console.print(line, highlight=False, soft_wrap=True)


@app.command()
def doctor() -> None:
    """Print versions, devices, supported precisions and missing optional parts."""
    found = doctoring.environment()
    console.print(f"Python {found['python']} on {found['platform']}", highlight=False)
    console.print("devices: " + ", ".join(found["devices"]), highlight=False)
    for name, support in doctoring.dtype_support().items():
        console.print(f"  {name}: {support}", highlight=False)
    console.print(f"  compiled sums: {doctoring.compiled_sums()}", highlight=False)
    for name, version in found["versions"].items():
        console.print(f"{name} {version or 'NOT INSTALLED'}", highlight=False)
    for name, purpose in doctoring.missing_parts().items():
        console.print(f"optional {name} is missing: {purpose}", highlight=False)


def main() -> None:
    """Entry point of the command `thincam`."""
    try:
        app()
    except SystemExit as end:
        if end.code == INTERRUPTED:
            # Not by way of the interpreter's end: threads that still compile may crash there.
            sys.stdout.flush()
            sys.stderr.flush()
            os._exit(INTERRUPTED)
        raise


if __name__ == "__main__":
    sys.exit(main())
