"""Experiment files of `kind: refocus`: objects at several distances, and a sweep of the focus."""

from typing import Annotated, Literal

import pydantic
from pydantic import Field

from thincam_jax.commands.sections import (
    CamerasConfig,
    Length,
    Name,
    Position,
    Section,
    TargetConfig,
    check_known,
    check_names,
    misfit,
)
from thincam_jax.reconstruction.depth.focus import Measure


class PlacedConfig(TargetConfig):
    """A picture that stands at a distance, its middle at (x, y), on a dark ground.

    Colours are averaged. `crop` takes the middle of a picture, that part of its shorter side.
    """

    distance: Length
    width: Length
    x: Position = 0.0
    y: Position = 0.0
    crop: Annotated[float, Field(gt=0, le=1)] = 1.0


class RangeConfig(Section):
    """Distances of objects."""

    nearest: Length
    farthest: Length

    @pydantic.model_validator(mode="after")
    def _ordered(self):
        if not self.nearest < self.farthest:
            raise ValueError("nearest is not below farthest; swap them")
        return self


class SweepConfig(RangeConfig):
    """Over which distances, by which method, and what is called sharp."""

    count: Annotated[int, Field(ge=5, le=200)] = 25
    method: Name
    measure: Measure = "laplacian_variance"
    smoothing: Annotated[float, Field(ge=0, le=50)] = 1.0
    window: Annotated[float, Field(ge=0.5, le=100)] = 6.0


class RefocusConfig(CamerasConfig):
    """A scene of several objects, captured once, and focused afterwards."""

    pictured = "objects"
    kind: Literal["refocus"]
    objects: Annotated[tuple[PlacedConfig, ...], Field(min_length=1)]
    sweep: SweepConfig
    notes: tuple[str, ...] = ()

    @pydantic.model_validator(mode="after")
    def _objects_fit(self):
        check_names(self, "objects")
        names = [method.name for method in self.methods]
        check_known(self.sweep.method, "method", names, "sweep", "method")
        for index, placed in enumerate(self.objects):
            if not self.sweep.nearest < placed.distance < self.sweep.farthest:
                message = (
                    f"{placed.distance:g} mm lies outside of the sweep; give a distance between "
                    f"{self.sweep.nearest:g} and {self.sweep.farthest:g} mm, or a wider sweep"
                )
                raise misfit(message, "objects", index, "distance")
        return self
