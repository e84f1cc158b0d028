"""From a refocus experiment's file to the study of its scene."""

from dataclasses import dataclass, replace
from typing import Any

from thincam_jax.commands.config_file import ConfigError
from thincam_jax.commands.refocus.config import RefocusConfig
from thincam_jax.commands.study.build import assemble, read_picture
from thincam_jax.imaging.targets import middle_square
from thincam_jax.studies.refocus import RefocusStudy, place


@dataclass(frozen=True, eq=False)
class FileRefocus(RefocusStudy):
    """A study with the file that it was read from."""

    config: Any = None

    @property
    def warnings(self) -> list[str]:
        """What a user should know before it runs."""
        return self.study.warnings


def build_refocus(config: RefocusConfig) -> FileRefocus:
    """Cameras and methods, and the objects as targets at their distances.

    **Errors**: ConfigError, one line for each fault, beginning with the field.
    """
    study, faults, objects = assemble(config, ()), [], []
    try:
        for exposure in study.exposures:
            study.camera(exposure)
    except (ValueError, TypeError) as error:
        faults.append(f"mask, sensor or model: {error}")
    for number, placed in enumerate(config.objects):
        try:
            picture = read_picture(placed)
            if placed.crop < 1:
                picture = middle_square(picture, round(placed.crop * min(picture.shape[:2])))
            seen = placed.build(name=placed.name, picture=picture)
            objects.append(place(study, number, seen))
        except (ValueError, FileNotFoundError) as error:
            faults.append(f"objects[{number}]: {error}")
    if faults:
        raise ConfigError("\n".join(faults))
    return FileRefocus(replace(study, targets=tuple(objects)), config.sweep.build(), config)
