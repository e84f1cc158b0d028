"""The command `thincam design`."""

from pathlib import Path
from typing import Annotated

import typer

from thincam_jax.commands.terminal import DryRun, Overrides, counted, show, told, warn


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
        from thincam_jax.commands.design.config import load_design
        from thincam_jax.commands.design.run import DesignFolder, run_design
        from thincam_jax.commands.design.simulation import build_designs

        wanted = load_design(config, tuple(set_ or ()))
        study = build_designs(wanted)
        warn(study.warnings)
        folder = DesignFolder(out or Path("runs") / slug(wanted.name))
        if dry_run:
            from thincam_jax.commands import explain

            explain.dry_run(wanted, folder.outcome(wanted))
            return
        with counted(wanted.name) as progress:
            found = run_design(study, folder, progress)
    _print(found)
    print(f"report: {folder.path / 'report.html'}")


def _print(found: dict) -> None:
    from thincam_jax._core.table import Table
    from thincam_jax.commands.design.report import in_words, objective_unit, reported_names

    validation = found["validation"]
    designs = (found["reference"], *found["compare"], *found["found"])
    names = reported_names(designs)
    unit = objective_unit(found)
    pictures = (f"{target}\ngain, dB" for target in validation["pictures"])
    charts = (f"{target}\ngain, elements" for target in validation["charts"])
    rows = []
    for one in designs:
        simulated = validation["methods"].get(one["name"])
        if simulated is None:
            continue
        predicted = f"{one['predicted_gain']:+.2f}" if "predicted_gain" in one else None
        gains = [_gain(simulated[name], "gain_db") for name in validation["pictures"]]
        gains += [_gain(simulated[name], "gain_elements") for name in validation["charts"]]
        rows.append(["\n".join([one["name"], *in_words(one, names)]), predicted, *gains])
    show(Table(("design", f"predicted\ngain, {unit}", *pictures, *charts), rows))
    name = found["reference"]["name"]
    levels = {t: validation["methods"][name][t]["psnr_db"] for t in validation["pictures"]}
    known = [f"{target} {psnr['mean']:.2f} dB" for target, psnr in levels.items() if psnr]
    print(f"gains are over {name}, whose PSNR is: {', '.join(known) or 'that of exact images'}")


def _gain(simulated: dict, key: str) -> str | None:
    gain = simulated.get(key)
    return f"{gain['mean']:+.2f}" if gain else None
