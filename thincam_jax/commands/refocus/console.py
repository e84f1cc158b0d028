"""What `thincam run` does with an experiment of `kind: refocus`."""

import rich
import rich.table

from thincam_jax.commands.refocus.build import build_refocus
from thincam_jax.commands.refocus.config import RefocusConfig
from thincam_jax.commands.refocus.run import run_refocus
from thincam_jax.commands.run_folder import RunFolder
from thincam_jax.commands.terminal import counted, told, warn


def refocus(config: RefocusConfig, folder: RunFolder) -> None:
    """Run the experiment with a progress bar and print what was found."""
    with told(lambda: "interrupted; the same command starts anew."):
        study = build_refocus(config)
        warn(study.warnings)
        with counted(config.name) as progress:
            metrics = run_refocus(study, folder, progress)
    _print_objects(metrics["objects"])
    print(f"report: {folder.path / 'report.html'}")


def _print_objects(objects: dict) -> None:
    table = rich.table.Table("object")
    for heading in ("distance mm", "found mm", "error %", "axial resolution mm"):
        table.add_column(heading, justify="right")
    for name, found in objects.items():
        keys = ("distance_mm", "found_mm", "error_percent", "axial_resolution_mm")
        values = [found[key] for key in keys]
        table.add_row(name, *("–" if value is None else f"{value:.1f}" for value in values))
    rich.print(table)
