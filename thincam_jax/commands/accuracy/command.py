"""The command `thincam bench accuracy`."""

from pathlib import Path
from typing import Annotated

import typer

from thincam_jax.commands.terminal import ConfigFile, Overrides, counted, show, told


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
        from thincam_jax.commands.accuracy.run import (
            BenchFolder,
            Sizes,
            check,
            run_accuracy,
            table,
            verdict,
        )
        from thincam_jax.commands.config_file import slug
        from thincam_jax.commands.study.config import load_config

        study = load_config(config, tuple(set_ or ()))
        plan = check(study, Sizes(tuple(size or ()), capture_size))
        folder = BenchFolder(out or Path("runs") / f"{slug(study.name)}-accuracy")
        with counted(study.name) as progress:
            result = run_accuracy(plan, folder, progress)
    show(table(result))
    print(verdict(result.reconstructions))
    print(f"results: {folder.path / 'accuracy.json'}")
