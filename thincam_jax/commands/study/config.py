"""Experiment files of a study: one camera family, several methods, several targets."""

from pathlib import Path
from typing import Annotated

import pydantic
from pydantic import Field

from thincam_jax.commands.checked_config import load_as
from thincam_jax.commands.sections import CamerasConfig, ObjectConfig, TargetConfig, check_names


class StudyConfig(CamerasConfig):
    """A whole study: every method on every target."""

    object: ObjectConfig
    targets: Annotated[tuple[TargetConfig, ...], Field(min_length=1)]
    notes: tuple[str, ...] = ()

    @pydantic.model_validator(mode="after")
    def _targets_fit(self):
        check_names(self, "targets")
        return self


def load_config(path: str | Path, overrides: tuple[str, ...] = ()) -> StudyConfig:
    """Read and check a study; list entries are overridden by number. Errors as of `load_as`."""
    return load_as(StudyConfig, path, overrides)
