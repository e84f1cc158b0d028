"""The command `thincam design`."""

from pathlib import Path
from typing import Annotated

import typer

from thincam_jax.commands.terminal import Overrides, counted, numbers, told, warn


def design(
    config: Annotated[
        Path, typer.Argument(help="Experiment file (YAML) of kind design or screen_design.")
    ],
    out: Annotated[
        Path | None, typer.Option(help="Folder of the results; default runs/NAME of the design.")
    ] = None,
    set_: Overrides = None,
) -> None:
    """Search for the best design.

    Simulates it beside the design to beat; writes design.json, found.yaml, figures and report.html.
    Ctrl-C keeps the targets that are finished; the same command goes on from there.
    """
    goes_on = "interrupted; the same command goes on with the targets that are not finished."
    with told(lambda: goes_on):
        from thincam_jax.commands.config_file import read_raw, slug

        if read_raw(config)[0].get("kind") == "screen_design":
            _design_plate(config, out, tuple(set_ or ()))
            return
        from thincam_jax.commands.design.config import load_design
        from thincam_jax.commands.design.run import DesignFolder, run_design
        from thincam_jax.commands.design.simulation import build_designs

        wanted = load_design(config, tuple(set_ or ()))
        study = build_designs(wanted)
        warn(study.warnings)
        folder = DesignFolder(out or Path("runs") / slug(wanted.name))
        with counted(wanted.name) as progress:
            found = run_design(study, folder, progress)
    _print(found)
    print(f"report: {folder.path / 'report.html'}")


def _design_plate(path: Path, out: Path | None, overrides: tuple[str, ...]) -> None:
    import rich
    import rich.table

    from thincam_jax.commands.checked_config import load_as
    from thincam_jax.commands.config_file import slug
    from thincam_jax.commands.plate.config import PlateDesignConfig
    from thincam_jax.commands.plate.run import NUMBERS, PlateFolder, design_plate

    wanted = load_as(PlateDesignConfig, path, overrides)
    folder = PlateFolder(out or Path("runs") / slug(wanted.name))
    with counted(wanted.name) as progress:
        found = design_plate(wanted, folder, progress)
    plates = found["plates"]
    table = rich.table.Table("", *plates)
    for name, (_, label) in NUMBERS.items():
        table.add_row(label, *(f"{plate['numbers'][name]:.4g}" for plate in plates.values()))
    table.add_row("expected error", *(f"{plate['error']:.3g}" for plate in plates.values()))
    for target in wanted.targets:
        scores = [plate["targets"][target.name]["psnr_db"] for plate in plates.values()]
        table.add_row(f"{target.name}, dB", *(f"{s:.1f}" if s else "exact" for s in scores))
    rich.print(table)
    print(f"report: {folder.path / 'report.html'}")


def _print(found: dict) -> None:
    import rich

    from thincam_jax.commands.design.words import in_words, told_of

    validation = found["validation"]
    designs = (found["reference"], *found["compare"], *found["found"])
    names = told_of(designs)
    unit = found["objective"]["told"].rpartition("(")[2].rstrip(")")
    pictures = (f"{target}\ngain, dB" for target in validation["pictures"])
    charts = (f"{target}\ngain, elements" for target in validation["charts"])
    rows = [["design", f"predicted\ngain, {unit}", *pictures, *charts]]
    for one in designs:
        simulated = validation["methods"].get(one["name"])
        if simulated is None:
            continue
        predicted = f"{one['predicted_gain']:+.2f}" if "predicted_gain" in one else "–"
        gains = [_gain(simulated[name], "gain_db") for name in validation["pictures"]]
        gains += [_gain(simulated[name], "gain_elements") for name in validation["charts"]]
        rows.append(["\n".join([one["name"], *in_words(one, names)]), predicted, *gains])
    rich.print(numbers(rows, show_lines=True))
    name = found["reference"]["name"]
    levels = {t: validation["methods"][name][t]["psnr_db"] for t in validation["pictures"]}
    known = [f"{target} {psnr['mean']:.2f} dB" for target, psnr in levels.items() if psnr]
    print(f"gains are over {name}, whose PSNR is: {', '.join(known) or 'that of exact images'}")


def _gain(simulated: dict, key: str) -> str:
    gain = simulated.get(key)
    return f"{gain['mean']:+.2f}" if gain else "–"
