"""The command `thincam design`."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from thincam_jax.commands.terminal import DryRun, Overrides, counted, say, show, told, warn

if TYPE_CHECKING:
    from thincam_jax.studies.design_scores import DesignScores


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
    with told(lambda: goes_on):
        from thincam_jax.commands.config_file import slug
        from thincam_jax.commands.design.build import build_design
        from thincam_jax.commands.design.run import DesignFolder, run_design
        from thincam_jax.commands.kinds import load_experiment

        wanted = load_experiment(config, tuple(set_ or ()), "design")
        study = build_design(wanted)
        warn(study.warnings)
        folder = DesignFolder(out or Path("runs") / slug(wanted.name))
        if dry_run:
            from thincam_jax.commands import explain

            explain.dry_run(wanted, folder.outcome(wanted))
            return
        with counted(wanted.name) as progress:
            found = run_design(study, folder, progress)
    show(found.table())
    say(_levels(found))
    say(f"report: {folder.path / 'report.html'}")


def _levels(found: "DesignScores") -> str:
    """What the gains are over, in a sentence."""
    name = found.reference.name
    of_pictures = found.validation.methods[name]
    levels = {target: of_pictures[target].psnr_db for target in found.validation.pictures}
    known = [f"{target} {psnr.mean:.2f} dB" for target, psnr in levels.items() if psnr]
    return f"gains are over {name}, whose PSNR is: {', '.join(known) or 'that of exact images'}"
