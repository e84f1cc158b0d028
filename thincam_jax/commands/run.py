"""The commands `thincam run` and `design`.

As the files `command.py`, it imports nothing at its head that `thincam --help` does not need.
"""

from pathlib import Path
from typing import Annotated, Any

import typer

from thincam_jax.commands.terminal import (
    ConfigFile,
    DryRun,
    Overrides,
    counted,
    reported,
    say,
    say_result,
    show,
    warn,
)


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

    with reported(interrupted):
        from thincam_jax.commands import explain
        from thincam_jax.commands.config_file import ConfigError
        from thincam_jax.commands.kinds import kind_of, load_experiment
        from thincam_jax.commands.run_folder import RunFolder

        if config.is_dir():
            from thincam_jax.hardware.commands.command import reconstruct_store

            if set_ or dry_run:
                option = "--set" if set_ else "--dry-run"
                raise ConfigError(f"{option} is for experiment files; a store has its own settings")
            say_result("report", reconstruct_store(config, out) / "report.html")
            return
        asked = load_experiment(config, tuple(set_ or ()))
        folder = RunFolder.chosen(out, asked.name, asked)
        kind = kind_of(asked)
        setup = kind.part(kind.build)(asked)
        outcome = folder.outcome(asked)
        warn(getattr(getattr(setup, "study", setup), "warnings", []))
        if dry_run:
            explain.dry_run(asked, outcome, setup)
            return
        with counted(asked.name) as progress:
            found = kind.part(kind.run)(setup, folder, progress)
    show(found.table())
    say_result("report", folder.path / "report.html")


def design(
    config: Annotated[Path, typer.Argument(help="Experiment file (YAML) of kind design.")],
    out: Annotated[
        Path | None, typer.Option(help="Folder of the results; default runs/NAME of the design.")
    ] = None,
    set_: Overrides = None,
    dry_run: DryRun = False,
) -> None:
    """Search for the best design.

    Simulates it beside the design to beat; writes design.json, found.yaml, figures and report.html.
    Ctrl-C keeps the targets that are finished; the same command goes on from there.
    """
    goes_on = "interrupted; the same command goes on with the targets that are not finished."
    with reported(lambda: goes_on):
        from thincam_jax.commands import explain
        from thincam_jax.commands.design.build import build_design
        from thincam_jax.commands.design.run import DesignFolder, run_design
        from thincam_jax.commands.kinds import load_experiment

        wanted = load_experiment(config, tuple(set_ or ()), "design")
        study = build_design(wanted)
        warn(study.warnings)
        folder = DesignFolder.chosen(out, wanted.name, wanted)
        if dry_run:
            explain.dry_run(wanted, folder.outcome(wanted))
            return
        with counted(wanted.name) as progress:
            found = run_design(study, folder, progress)
    show(found.table())
    say(found.levels())
    say_result("report", folder.path / "report.html")
