"""The command `thincam train`."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from thincam_jax.commands.terminal import DryRun, Overrides, progress_bar, reported, say, say_result

if TYPE_CHECKING:
    from thincam_jax.learn.training import TrainingProgress


def train(
    config: Annotated[
        Path, typer.Argument(help="Experiment file (YAML) of kind 'denoiser' or 'trained'.")
    ],
    out: Annotated[
        Path | None, typer.Option(help="Folder of the results. Default: runs/NAME.")
    ] = None,
    resume: Annotated[
        bool, typer.Option("--resume", help="Continue the training in the folder.")
    ] = False,
    set_: Overrides = None,
    dry_run: DryRun = False,
) -> None:
    """Train a denoiser or a reconstruction.

    Writes network.thincam, figures and training.json. Ctrl-C, or a power cut, loses what was done
    since the last check; --resume goes on from there, to the same numbers.
    """
    goes_on = "interrupted; what the last check has written is kept: --resume goes on from there"
    with reported(lambda: goes_on):
        from thincam_jax.commands import run
        from thincam_jax.commands.kinds import kind_of, load_experiment
        from thincam_jax.learn.commands.training import InFolder, TrainingFolder

        asked = load_experiment(config, tuple(set_ or ()), "train")
        kind = kind_of(asked)
        folder = TrainingFolder.chosen(out, asked.name, asked)
        if dry_run:
            InFolder(folder, lambda _: None, resume).check(asked)
            kind.part(kind.build)(asked)
            run.explain_run(asked, folder.outcome(asked))
            return
        with progress_bar("{task.fields[loss]}") as bar:
            task = bar.add_task(asked.name, total=asked.training.steps, loss="")

            def tell(progress: "TrainingProgress") -> None:
                score = f", best {progress.score:.3f}" if progress.score == progress.score else ""
                bar.update(task, completed=progress.step, loss=f"loss {progress.loss:.3f}{score}")
                bar.start()

            found = kind.part(kind.run)(asked, InFolder(folder, tell, resume))
    say(found.line)
    if found.page is not None:
        say_result("report", found.page)
    say_result("network", found.network)


COMMANDS = ((train, "train denoiser.yaml", "train denoiser.yaml --resume"),)
