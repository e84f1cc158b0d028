"""Experiment files of a study: one camera family, several methods, several targets."""

from pathlib import Path
from typing import Annotated

import pydantic
from pydantic import Field

from thincam_jax.commands.checked_config import load_as
from thincam_jax.commands.sections import (
    MaskConfig,
    MethodConfig,
    Name,
    NoiseConfig,
    ObjectConfig,
    Section,
    SensorConfig,
    TargetConfig,
    Wavelength,
    check_methods,
    check_names,
)
from thincam_jax.lensless.psf import Model
from thincam_jax.reconstruction.spectra import Prior


class StudyConfig(Section):
    """A whole study: one camera family, several methods, several targets."""

    name: Name
    title: str = ""
    seed: Annotated[int, Field(ge=0, lt=2**32, strict=True)] = 0
    wavelength: Wavelength
    model: Model = "separable"
    pixel_integration: bool = True
    prior: Prior = "inverse_square"
    sensor: SensorConfig
    mask: MaskConfig
    object: ObjectConfig
    noise: NoiseConfig | None = None
    methods: Annotated[tuple[MethodConfig, ...], Field(min_length=1)]
    targets: Annotated[tuple[TargetConfig, ...], Field(min_length=1)]
    notes: tuple[str, ...] = ()

    @pydantic.model_validator(mode="after")
    def _fits(self):
        check_names(self, "methods", "targets")
        check_methods(self)
        return self


def load_config(path: str | Path, overrides: tuple[str, ...] = ()) -> StudyConfig:
    """Read and check a study; list entries are overridden by number. Errors as of `load_as`."""
    return load_as(StudyConfig, path, overrides)
