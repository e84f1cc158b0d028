"""Experiment files of `kind: screen`: a camera behind a glass plate with two holograms."""

import math
from typing import Annotated, Any, Literal

import pydantic
from pydantic import Field

from thincam_jax import waveguide as wg
from thincam_jax._core.quantity import FieldError
from thincam_jax.commands.schema import Angle, Length, Section, Wavelength, section
from thincam_jax.commands.sections import (
    ExperimentConfig,
    Name,
    NoiseConfig,
    PictureConfig,
    SensorConfig,
    VariationConfig,
    check_known,
    check_names,
)
from thincam_jax.measured.calibration.hadamard import HadamardSeries
from thincam_jax.reconstruction import Ridge
from thincam_jax.studies.pictures import PublishedImage
from thincam_jax.studies.refocus import SceneObject
from thincam_jax.studies.screen import ScreenModel
from thincam_jax.studies.screen_calibration import MEASURED, Calibration
from thincam_jax.studies.study import check_noise

Acute = Annotated[Angle, Field(gt=-math.pi / 2, lt=math.pi / 2)]


_HOLOGRAM = {"wavelength": None, "object_angle": 0.0, "index": 1.5}


class HologramConfig(section(wg.VolumeHologram.record, defaults=_HOLOGRAM)):
    """Recording of both holograms; angles are in the film, from its normal.

    - `colours`: of a full-colour hologram, the wavelengths of red, green and blue in place of
      `wavelength`, recorded one after the other at the same angles.
    """

    colours: tuple[Wavelength, Wavelength, Wavelength] | None = None
    shrinkage: Annotated[float, Field(gt=-1, lt=1)] = 0.0

    @pydantic.model_validator(mode="after")
    def _fits(self):
        if (self.wavelength is None) == (self.colours is None):
            raise FieldError("give it, such as 532 nm, or three colours in its place", "wavelength")
        return self

    @property
    def recorded(self) -> tuple[float, ...]:
        """Wavelengths, one for each channel of the captures."""
        return self.colours or (self.wavelength or 0.0,)


class RectangleConfig(section(SceneObject, only=("width", "x", "y"))):
    """Where a hologram is: its size, and its middle from the camera's axis, y downwards."""

    height: Length

    def build(self, **others: Any) -> wg.Rectangle:
        return wg.Rectangle((self.x, self.y), (self.width, self.height))


_GLASS = {"glass_index": 1.5}


class PlateConfig(section(wg.Screen, only=("glass_thickness", "glass_index"), defaults=_GLASS)):
    """The glass plate; a hologram without an outline covers its whole surface.

    - `tilt`: against the camera, about x and then about y.
    """

    tilt: tuple[Acute, Acute] = (0.0, 0.0)
    top: RectangleConfig | None = None
    bottom: RectangleConfig | None = None


class LensConfig(section(wg.SeeThroughCamera, only=("focal_distance", "lens_distance"))):
    """From sensor to lens (d0), and from lens to the plate (d1)."""


def check_cells(cells: tuple[int, int], *place: str) -> None:
    """Refuse cells that there are no Hadamard patterns of."""
    try:
        HadamardSeries(cells)
    except ValueError as error:
        raise FieldError(str(error), *place) from None


class CellsConfig(section(SceneObject, only=("distance", "width", "x", "y"))):
    """The object: square cells (rows, columns) of a monitor of that width, its middle at (x, y)."""

    cells: tuple[Annotated[int, Field(ge=7, le=512)], Annotated[int, Field(ge=7, le=512)]]


class ScreenMethodConfig(section(Ridge, only=("ridge",), defaults={"ridge": None})):
    """A reconstruction: ridge regression by conjugate gradients, or total variation by ADMM."""

    name: Name
    kind: Literal["ridge", "admm_tv"]
    variation: VariationConfig | None = None

    @pydantic.model_validator(mode="after")
    def _fits(self):
        other = "variation" if self.kind == "ridge" else "ridge"
        if getattr(self, other) is not None:
            raise FieldError(f"kind {self.kind} does not take it; drop {other!r}", other)
        return self


class ModelConfig(section(ScreenModel, without=("name",))):
    """`thincam_jax.studies.screen.ScreenModel`."""

    name: Name


class PublishedConfig(section(PublishedImage, defaults={"psnr_db": ..., "seconds": ...})):
    """Published figures of a target."""


class ScreenTargetConfig(PictureConfig):
    """A picture on the monitor's cells, in grey before a hologram of one colour.

    - `published`: by the method's name.
    """

    published: dict[str, PublishedConfig] = {}


class CalibrationConfig(section(Calibration)):
    """`thincam_jax.studies.screen_calibration.Calibration`."""


class SeeThroughConfig(Section):
    """A see-through camera and the cells before it.

    - `orders`: of ghosts; `band_samples`: of the colours about each pixel's Bragg wavelength, None
      for that one alone.
    """

    hologram: HologramConfig
    screen: PlateConfig
    lens: LensConfig
    sensor: SensorConfig
    object: CellsConfig
    orders: Annotated[int, Field(ge=1, le=16)] = 4
    band_samples: Annotated[int, Field(ge=1, le=64)] | None = None


class ScreenConfig(SeeThroughConfig, ExperimentConfig):
    """Captures through a see-through screen, undone with right and wrong models of it.

    - `calibration`: measures the camera of the first model, and reconstructs with that matrix too.
    """

    kind: Literal["screen"]
    noise: NoiseConfig
    methods: Annotated[tuple[ScreenMethodConfig, ...], Field(min_length=1)]
    models: Annotated[tuple[ModelConfig, ...], Field(min_length=1)]
    calibration: CalibrationConfig | None = None
    targets: Annotated[tuple[ScreenTargetConfig, ...], Field(min_length=1)]
    notes: tuple[str, ...] = ()

    @pydantic.model_validator(mode="after")
    def _fits(self):
        check_names(self, "methods", "models", "targets")
        if self.calibration is not None:
            if self.hologram.colours is not None:
                message = "takes a hologram of one colour; drop hologram.colours"
                raise FieldError(message, "calibration")
            check_cells(self.object.cells, "object", "cells")
            for number, model in enumerate(self.models):
                if model.name == MEASURED:
                    message = f"{MEASURED!r} is the name of the calibration's; give another"
                    raise FieldError(message, "models", number, "name")
        methods = [method.name for method in self.methods]
        for number, target in enumerate(self.targets):
            for name in target.published:
                check_known(name, "method", methods, "targets", number, "published", name)
        check_noise(self.sensor.build(), self.noise.build())
        return self
