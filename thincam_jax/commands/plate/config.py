"""Experiment files of `kind: screen_design`: the plate of a see-through screen, within limits."""

import math
from typing import Annotated, Any, Literal

import pydantic
from pydantic import BeforeValidator, Field

from thincam_jax.commands.screen.config import (
    HologramConfig,
    LensConfig,
    PlateConfig,
    ScreenMethodConfig,
    ScreenTargetConfig,
    SeenConfig,
)
from thincam_jax.commands.sections import (
    Angle,
    ExperimentConfig,
    Length,
    Section,
    SensorConfig,
    check_names,
    misfit,
)

Modulation = Annotated[float, Field(gt=0, le=0.5)]
Guided = Annotated[Angle, Field(gt=0, lt=math.pi / 2)]


def _pair(value: Any) -> Any:
    return value if isinstance(value, list | tuple) else (value, value)


class LimitsConfig(Section):
    """Between which plates can be made, [least, most]; a single value fixes a number."""

    glass_thickness: Annotated[tuple[Length, Length], BeforeValidator(_pair)]
    reference_angle: Annotated[tuple[Guided, Guided], BeforeValidator(_pair)]
    film_thickness: Annotated[tuple[Length, Length], BeforeValidator(_pair)]
    index_modulation: Annotated[tuple[Modulation, Modulation], BeforeValidator(_pair)]
    lens_distance: Annotated[tuple[Length, Length], BeforeValidator(_pair)]
    focal_distance: Annotated[tuple[Length, Length], BeforeValidator(_pair)]

    @pydantic.model_validator(mode="after")
    def _fits(self):
        for name, (low, high) in self:
            if low > high:
                raise misfit(f"[{low:g}, {high:g}] crosses; give the lower limit first", name)
        return self


class SearchConfig(Section):
    """Descents of so many `steps` from the best `starts` of even `samples`."""

    starts: Annotated[int, Field(ge=1, le=64)] = 3
    samples: Annotated[int, Field(ge=1, le=10000)] = 64
    steps: Annotated[int, Field(ge=1, le=10000)] = 40


class PlateDesignConfig(ExperimentConfig):
    """The plate of least expected error, beside that of ERRATA's defaults.

    - `snr_db`: of captures through the default plate; another's follows from its light.
    - `focal_distances`: at each the search is done anew, for field of view against error.
    """

    kind: Literal["screen_design"]
    sensor: SensorConfig
    object: SeenConfig
    snr_db: Annotated[float, Field(ge=-60, le=200)] = 30.0
    plate: LimitsConfig
    search: SearchConfig = SearchConfig()
    focal_distances: tuple[Length, ...] = ()
    method: ScreenMethodConfig
    targets: Annotated[tuple[ScreenTargetConfig, ...], Field(min_length=1)]
    notes: tuple[str, ...] = ()

    @pydantic.model_validator(mode="after")
    def _fits(self):
        check_names(self, "targets")
        if self.sensor.counts:
            message = "is in parts of the light of white; drop exposure, electrons and bit_depth"
            raise misfit(message, "sensor")
        return self


class FoundConfig(Section):
    """The plate found, as the sections of a file of kind screen."""

    hologram: HologramConfig
    screen: PlateConfig
    lens: LensConfig
