"""Experiment files of `kind: refocus`: objects at several distances, and a sweep of the focus."""

from typing import Annotated, Literal

import pydantic
from pydantic import Field

from thincam_jax._core.quantity import FieldError
from thincam_jax.commands.schema import section
from thincam_jax.commands.sections import (
    CamerasConfig,
    Name,
    TargetConfig,
    check_known,
    check_names,
)
from thincam_jax.studies.refocus import FocusRange, SceneObject

_PLACE = ("distance", "width", "x", "y")


class PlacedConfig(section(SceneObject, only=_PLACE), TargetConfig):
    """A picture that stands at a distance, its middle at (x, y), on a dark ground.

    Colours are averaged. `crop` takes the middle of a picture, that part of its shorter side.
    """

    crop: Annotated[float, Field(gt=0, le=1)] = 1.0


class SweepConfig(section(FocusRange)):
    """Over which distances, by which method, and what is called sharp."""

    method: Name


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
                raise FieldError(message, "objects", index, "distance")
        return self
