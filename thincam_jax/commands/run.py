"""The commands `thincam run`, `thincam train` and `thincam bench accuracy`.

As the files `command.py`, it imports nothing at its head that `thincam --help` does not need.
"""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from thincam_jax.commands.terminal import (
    ConfigFile,
    DryRun,
    Overrides,
    counted,
    progress_bar,
    say,
    show,
    told,
    warn,
)

if TYPE_CHECKING:
    from thincam_jax.learn.training import TrainingProgress


def run(
    config: ConfigFile,
    out: Annotated[
        Path | None, typer.Option(help="Run folder; default runs/NAME of the study.")
    ] = None,
    set_: Overrides = None,
    dry_run: DryRun = False,
) -> None:
    """Simulate an experiment and reconstruct it; or reconstruct a store of 'thincam capture'.

    Writes images, metrics.json, figures and report.html. Ctrl-C keeps what is finished; the same
    command goes on from there.
    """
    asked: Any = None
    folder: Any = None

    def interrupted() -> str:
        if getattr(asked, "kind", "study") != "study":
            return "interrupted; the same command starts anew."
        targets = asked.targets if folder else ()
        done = ", ".join(t.name for t in targets if folder.finished(t.name) is not None)
        done = done or "no target yet"
        return f"interrupted; finished: {done}. The same command goes on from there."

    with told(interrupted):
        from thincam_jax.commands import explain
        from thincam_jax.commands.config_file import ConfigError, slug
        from thincam_jax.commands.kinds import kind_of, load_experiment
        from thincam_jax.commands.run_folder import RunFolder

        if config.is_dir():
            from thincam_jax.commands.capture.command import reconstruct_store

            if set_ or dry_run:
                option = "--set" if set_ else "--dry-run"
                raise ConfigError(f"{option} is for experiment files; a store has its own settings")
            say(f"report: {reconstruct_store(config, out) / 'report.html'}")
            return
        asked = load_experiment(config, tuple(set_ or ()))
        folder = RunFolder(out or Path("runs") / slug(asked.name))
        kind = kind_of(asked)
        setup = kind.part(kind.build)(asked)
        warn(getattr(setup, "warnings", []))
        if dry_run:
            explain.dry_run(asked, folder.outcome(asked), setup)
            return
        with counted(asked.name) as progress:
            found = kind.part(kind.run)(setup, folder, progress)
    show(found.table())
    say(f"report: {folder.path / 'report.html'}")


def train(
    config: Annotated[
        Path, typer.Argument(help="Experiment file (YAML) of kind learned or denoiser.")
    ],
    out: Annotated[
        Path | None, typer.Option(help="Folder of the results; default runs/NAME of the network.")
    ] = None,
    resume: Annotated[
        bool, typer.Option("--resume", help="Go on with the training that the folder holds.")
    ] = False,
    set_: Overrides = None,
    dry_run: DryRun = False,
) -> None:
    """Train a network that refocuses the captures of a camera, or a denoiser.

    Writes network.thincam, figures and training.json. Ctrl-C, or a power cut, loses what was done
    since the last check; --resume goes on from there, to the same numbers.
    """
    goes_on = "interrupted; what the last check has written is kept: --resume goes on from there"
    with told(lambda: goes_on):
        from thincam_jax.commands import explain
        from thincam_jax.commands.config_file import slug
        from thincam_jax.commands.kinds import kind_of, load_experiment
        from thincam_jax.commands.learned.run import TrainingFolder, check_resume

        asked = load_experiment(config, tuple(set_ or ()), "train")
        kind = kind_of(asked)
        folder = TrainingFolder(out or Path("runs") / slug(asked.name))
        if dry_run:
            check_resume(folder, resume)
            kind.part(kind.build)(asked)
            explain.dry_run(asked, folder.outcome(asked))
            return
        with progress_bar("{task.fields[loss]}") as bar:
            task = bar.add_task(asked.name, total=asked.training.steps, loss="")

            def tell(progress: "TrainingProgress") -> None:
                score = f", best {progress.score:.3f}" if progress.score == progress.score else ""
                bar.update(task, completed=progress.step, loss=f"loss {progress.loss:.3f}{score}")
                bar.start()

            found = kind.part(kind.run)(asked, folder, tell, resume=resume)
    say(found.line)
    if found.page is not None:
        say(f"report: {found.page}")
    say(f"network: {found.network}")


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
    """Measure every model's error and time.

    And what an error of the PSF costs in PSNR. Writes accuracy.json.
    """
    with told(lambda: "interrupted; nothing is kept."):
        from thincam_jax.commands.accuracy import BenchFolder, Sizes, check, run_accuracy
        from thincam_jax.commands.config_file import slug
        from thincam_jax.commands.study.config import load_config

        study = load_config(config, tuple(set_ or ()))
        plan = check(study, Sizes(tuple(size or ()), capture_size))
        folder = BenchFolder(out or Path("runs") / f"{slug(study.name)}-accuracy")
        with counted(study.name) as progress:
            result = run_accuracy(plan, folder, progress)
    show(result.table())
    say(result.reconstructions.verdict())
    say(f"results: {folder.path / 'accuracy.json'}")
