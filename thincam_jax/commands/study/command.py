"""The command `thincam run`."""

from pathlib import Path
from typing import Annotated

import typer

from thincam_jax.commands.terminal import ConfigFile, Overrides, counted, told, warn


def run(
    config: ConfigFile,
    out: Annotated[
        Path | None, typer.Option(help="Run folder; default runs/NAME of the study.")
    ] = None,
    set_: Overrides = None,
) -> None:
    """Simulate an experiment and reconstruct it; or reconstruct a store of 'thincam capture'.

    Writes images, metrics.json, figures and report.html. Ctrl-C keeps what is finished; the same
    command goes on from there.
    """
    folder, targets = None, ()

    def finished() -> str:
        names = [t.name for t in targets if folder and folder.finished(t.name) is not None]
        done = ", ".join(names) if names else "no target yet"
        return f"interrupted; finished: {done}. The same command goes on from there."

    with told(finished):
        from thincam_jax.commands.config_file import ConfigError, slug
        from thincam_jax.commands.kinds import load_experiment
        from thincam_jax.commands.masks.config import MasksConfig
        from thincam_jax.commands.refocus.config import RefocusConfig
        from thincam_jax.commands.refocus.console import refocus
        from thincam_jax.commands.run_folder import RunFolder
        from thincam_jax.commands.screen.config import ScreenConfig
        from thincam_jax.commands.study.build import build_study
        from thincam_jax.commands.study.run import run_study

        if config.is_dir():
            from thincam_jax.commands.capture.command import reconstruct_store

            if set_:
                raise ConfigError("--set is for experiment files; a store has its own settings")
            print(f"report: {reconstruct_store(config, out) / 'report.html'}")
            return
        asked = load_experiment(config, tuple(set_ or ()))
        folder = RunFolder(out or Path("runs") / slug(asked.name))
        if isinstance(asked, RefocusConfig):
            refocus(asked, folder)
            return
        if isinstance(asked, ScreenConfig):
            from thincam_jax.commands.screen.run import screen

            screen(asked, folder)
            return
        if isinstance(asked, MasksConfig):
            from thincam_jax.commands.masks.run import compare_masks

            compare_masks(asked, folder)
            return
        study = build_study(asked)
        warn(study.warnings)
        targets = asked.targets
        with counted(asked.name) as progress:
            metrics = run_study(study, folder, progress)
    _print_results(metrics)
    print(f"report: {folder.path / 'report.html'}")


def _print_results(metrics: dict) -> None:
    import rich
    import rich.table

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
    rich.print(table)


def _number(value: float | None, digits: int) -> str:
    return "–" if value is None else f"{value:.{digits}f}"
