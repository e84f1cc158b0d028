"""The command `thincam plate`: files of a study's mask for a shop, and what its grid costs.

As the files `command.py`, it imports nothing at its head that `thincam --help` does not need.
"""

from pathlib import Path
from typing import Annotated, Any

import typer

from thincam_jax.commands.kinds import load_study
from thincam_jax.commands.terminal import ConfigFile, Overrides, reported, say_result

_IN_PYTHON = "its tc.lensless.masks.halftone.halftone(mask, cell)"
_LAYOUT, _TABLES = ".gds", (".png", ".tif", ".tiff")


def plate(
    config: ConfigFile,
    out: Annotated[
        Path, typer.Option(help="File: .gds for lithography, .png or .tif for a grey-scale writer.")
    ],
    halftone: Annotated[
        str | None,
        typer.Option(
            help="Open and closed cells of this side, such as 4um; 4um,irradiance: their open "
            "fraction is the irradiance in place of the amplitude."
        ),
    ] = None,
    pixel: Annotated[str | None, typer.Option(help="Pixel of a grey table, such as 1um.")] = None,
    shot: Annotated[int, typer.Option(min=0, help="Exposure of the study, from 0.")] = 0,
    set_: Overrides = None,
) -> None:
    """Write a study's mask for a shop.

    Half-tone cells are compared with the grey mask: the PSF by the exact model, and the image of
    one capture of the first target. A grey table has 16 bits, and its scale beside it as .json.
    """
    with reported(lambda: "interrupted"):
        from thincam_jax.commands.config_file import ConfigError
        from thincam_jax.commands.study.build import build_study
        from thincam_jax.design.grey_files import write_density_map
        from thincam_jax.design.layout import write_gds
        from thincam_jax.lensless.masks import halftone as grid

        suffix = out.suffix.lower()
        if suffix not in (_LAYOUT, *_TABLES):
            raise ConfigError(f"--out {out}: give .gds, or .png or .tif for a grey table")
        if (suffix == _LAYOUT) == (pixel is not None):
            needed = "a grey table needs it, such as 1um" if pixel is None else "a layout has none"
            raise ConfigError(f"--pixel: {needed}")
        study = build_study(load_study(config, tuple(set_ or ()), "a plate is a study's mask"))
        if shot >= len(study.exposures):
            last = len(study.exposures) - 1
            raise ConfigError(f"--shot {shot}: the study has 0 to {last}")
        exposure = study.exposures[shot]
        mask: Any = exposure.mask(study.mask)
        try:
            made, least = mask, None
            if halftone is not None:
                cell, _, density = halftone.partition(",")
                least, how = _length("--halftone", cell), density.strip() or "amplitude"
                made = grid.halftone(mask, least, how)  # pyright: ignore[reportArgumentType]
            if suffix == _LAYOUT:
                write_gds(out, made, smallest_feature=least)
            else:
                write_density_map(out, made, _length("--pixel", str(pixel)))
        except (ValueError, TypeError, ImportError) as error:
            advice = "--halftone with a cell, such as 4um"
            raise ConfigError(f"{config}: {error}".replace(_IN_PYTHON, advice)) from None
        if halftone is not None:
            _say_losses(study, exposure, mask, made)
        say_result("plate", out, f"{out}: exposure {shot}, {_about(exposure)}")


def _length(option: str, text: str) -> float:
    from thincam_jax.commands.config_file import ConfigError
    from thincam_jax.units import parse_quantity

    try:
        return parse_quantity(text, "length")
    except ValueError as error:
        raise ConfigError(f"{option}: {error}") from None


def _about(exposure: Any) -> str:
    zones = f"β {exposure.beta:g} rad/mm², φ {exposure.phase:.2f} rad, " if exposure.beta else ""
    return f"{zones}{exposure.width:g} mm wide"


def _say_losses(study: Any, exposure: Any, mask: Any, made: Any) -> None:
    """Say by how much cells change the PSF, and the image of one capture."""
    from thincam_jax.studies.plates import compare_plates

    found = compare_plates(study, exposure, mask, made)
    say_result("psf_error", found.psf_error, f"PSF: {found.psf_error:.1%} from the grey plate's")
    if found.target:
        loss = found.grey_db - found.plate_db
        sign = "less" if loss >= 0 else "more"
        text = f"{found.plate_db:.2f} dB, {abs(loss):.2f} dB {sign} than by the grey one"
        say_result("image_db", found.plate_db, f"image of {found.target}: {text}")
