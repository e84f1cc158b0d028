"""Experiment files of a study: one camera family, several methods, several targets."""

from pathlib import Path
from typing import Annotated

import pydantic
from pydantic import Field

from thincam_jax.commands.checked_config import load_as
from thincam_jax.commands.sections import (
    CamerasConfig,
    ObjectConfig,
    Position,
    TargetConfig,
    check_names,
)


class PictureConfig(TargetConfig):
    """A target that fills given cells.

    - `crop`: takes the middle of a picture, that part of its shorter side; `binary`: black where it
      is below its mean, else white.
    """

    crop: Annotated[float, Field(gt=0, le=1)] = 1.0
    binary: bool = False


class MovingObjectConfig(ObjectConfig):
    """Targets that may move.

    - `motion`: how far across (+x) during an exposure of the sensor's own time. A method's captures
      follow each other without a pause, and half way through them the targets are on the axis.
    """

    motion: Position = 0.0


class StudyConfig(CamerasConfig):
    """A whole study: every method on every target."""

    object: MovingObjectConfig
    targets: Annotated[tuple[TargetConfig, ...], Field(min_length=1)]
    notes: tuple[str, ...] = ()

    @property
    def motion(self) -> float:
        return self.object.motion

    @pydantic.model_validator(mode="after")
    def _targets_fit(self):
        check_names(self, "targets")
        return self


def load_config(path: str | Path, overrides: tuple[str, ...] = ()) -> StudyConfig:
    """Read and check a study; list entries are overridden by number. Errors as of `load_as`."""
    return load_as(StudyConfig, path, overrides)
