"""The command `thincam run`."""

from pathlib import Path
from typing import Annotated, Any

import typer

from thincam_jax.commands.terminal import ConfigFile, DryRun, Overrides, counted, show, told, warn


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
            print(f"report: {reconstruct_store(config, out) / 'report.html'}")
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
    print(f"report: {folder.path / 'report.html'}")
