"""Experiment files of `kind: screen`: a camera behind a glass plate with two holograms."""

import itertools
import math
from typing import Annotated, Any, ClassVar, Literal

import pydantic
from pydantic import Field

from thincam_jax import waveguide as wg
from thincam_jax._core.quantity import FieldError
from thincam_jax.commands.mask import MaskConfig
from thincam_jax.commands.pictures import ScreenMethodConfig, ScreenTargetConfig
from thincam_jax.commands.schema import Angle, Curvature, Length, Section, Wavelength, section
from thincam_jax.commands.sections import (
    ExperimentConfig,
    Name,
    NoiseConfig,
    SensorConfig,
    check_known,
    check_names,
)
from thincam_jax.measured.calibration.hadamard import HadamardSeries
from thincam_jax.measured.read import read_image
from thincam_jax.studies.refocus import SceneObject
from thincam_jax.studies.study import check_noise
from thincam_jax.waveguide.display import DisplayLight
from thincam_jax.waveguide.studies.calibration import MEASURED, Calibration
from thincam_jax.waveguide.studies.mask import ScreenMask, require_mask_fits
from thincam_jax.waveguide.studies.screen import ScreenModel, require_display_fits

Acute = Annotated[Angle, Field(gt=-math.pi / 2, lt=math.pi / 2)]

_HOLOGRAM = {"wavelength": None, "object_angle": 0.0, "index": 1.5}


class ResponseConfig(section(wg.ColourBand)):
    """The band of a channel of a colour sensor."""


class HologramConfig(section(wg.VolumeHologram.record, defaults=_HOLOGRAM)):
    """Recording of both holograms; angles are in the film, from its normal.

    - `colours`: wavelengths of red, green and blue of a full-colour hologram, in place of
      `wavelength`, recorded one after the other at the same angles.
    - `responses`: to these of a sensor whose colours have cross-talk; None where it has none.
    """

    colours: tuple[Wavelength, Wavelength, Wavelength] | None = None
    responses: tuple[ResponseConfig, ResponseConfig, ResponseConfig] | None = None
    shrinkage: Annotated[float, Field(gt=-1, lt=1)] = 0.0

    @pydantic.model_validator(mode="after")
    def _fits(self):
        if (self.wavelength is None) == (self.colours is None):
            raise FieldError("give it, such as 532 nm, or three colours in its place", "wavelength")
        if self.responses and not self.colours:
            raise FieldError("are to three colours; give colours, or drop responses", "responses")
        return self

    @property
    def recorded(self) -> tuple[float, ...]:
        """Wavelengths, one for each channel of the captures."""
        return self.colours or (self.wavelength or 0.0,)


class RectangleConfig(section(SceneObject, only=("width", "x", "y"))):
    """Size of a hologram, and its middle from the camera's axis, y downwards."""

    height: Length

    def build(self, **others: Any) -> wg.Rectangle:
        return wg.Rectangle((self.y, self.x), (self.height, self.width))


class PlateConfig(section(wg.Screen, without=("hologram",), defaults={"glass_index": 1.5})):
    """The glass plate; a hologram without an outline covers its whole surface.

    - `tilt`: against the camera, about x and then about y.
    """

    tilt: tuple[Acute, Acute] = (0.0, 0.0)
    top: RectangleConfig | None = None
    bottom: RectangleConfig | None = None
    cover: RectangleConfig | None = None


_LENS = ("focal_distance", "lens_distance", "aperture", "focus_distance", "direct_band")


class LensConfig(
    section(wg.SeeThroughCamera, only=_LENS, defaults={"aperture": None, "direct_band": None})
):
    """Distances from sensor to lens (d0) and from there to the plate (d1), focus, stray light."""


class ScreenMaskConfig(section(ScreenMask, without=("mask",)), MaskConfig):
    """A mask before a bare sensor, in place of the lens, and how its PSFs are computed.

    - `beta`: curvature of a zone plate. `distance`: from sensor to mask; `gap`: from the mask to
      the plate.
    """

    beside: ClassVar[tuple[str, ...]] = ("distance", "gap", "model", "points", "tolerance")
    beta: Curvature | None = None
    distance: Length
    gap: Length


Fraction = Annotated[float, Field(ge=0, le=1)]


class DisplayLightConfig(section(DisplayLight, only=("radiance",))):
    """Light of a display behind the plate, as measured: see `waveguide.display.DisplayLight`.

    - `leak`: rows of a wavelength and the fraction of that light that reaches the sensor.
    - `primaries`: spectra of its colours. `path`: picture of its light on the sensor; without
      one it is uniform.
    """

    leak: Annotated[tuple[tuple[Wavelength, Fraction], ...], Field(min_length=2)]
    primaries: Annotated[tuple[ResponseConfig, ...], Field(min_length=1)]
    path: str | None = None

    @pydantic.model_validator(mode="after")
    def _rises(self):
        light = [row[0] for row in self.leak]
        if any(a >= b for a, b in itertools.pairwise(light)):
            raise FieldError("has wavelengths that do not rise; sort them", "leak")
        return self

    def build(self, *_: Any, **others: Any) -> DisplayLight:
        """The light.

        **Errors**: OSError or ValueError for a pattern that is no picture of light.
        """
        pattern = None if self.path is None else read_image(self.path).pixels
        primaries = [one.build() for one in self.primaries]
        return DisplayLight(self.leak, primaries, self.radiance, pattern)


def check_cells(cells: tuple[int, int], *place: str) -> None:
    """Refuse cells that there are no Hadamard patterns of."""
    try:
        HadamardSeries(cells)
    except ValueError as error:
        raise FieldError(str(error), *place) from None


class CellsConfig(section(SceneObject, only=("distance", "width", "x", "y"))):
    """The object: square cells (rows, columns) of a monitor of that width, its middle at (x, y)."""

    cells: tuple[Annotated[int, Field(ge=7, le=512)], Annotated[int, Field(ge=7, le=512)]]


class ModelConfig(section(ScreenModel, without=("name",))):
    """`thincam_jax.waveguide.studies.screen.ScreenModel`."""

    name: Name


class CalibrationConfig(section(Calibration)):
    """`thincam_jax.waveguide.studies.calibration.Calibration`."""


class SeeThroughConfig(Section):
    """A see-through camera and the cells before it.

    - `orders`: number of ghosts; `band_samples`: samples of the colours about each pixel's Bragg
      wavelength, None for that one alone.
    - `display_light`: that of a display behind the plate which reaches the camera, in every frame.
    """

    hologram: HologramConfig
    screen: PlateConfig
    lens: LensConfig
    sensor: SensorConfig
    object: CellsConfig
    orders: Annotated[int, Field(ge=1, le=16)] = 4
    band_samples: Annotated[int, Field(ge=1, le=64)] | None = None
    display_light: DisplayLightConfig | None = None

    @property
    def optics(self) -> dict[str, Any]:
        """Lens or mask, as parameters of `waveguide.SeeThroughCamera`."""
        return {name: value for name, value in self.lens if value is not None}


class ScreenConfig(SeeThroughConfig, ExperimentConfig):
    """Captures through a see-through screen, undone with right and wrong models of it.

    - `mask`: in place of the lens.
    - `calibration`: measures the camera of the first model, and reconstructs with that matrix too.
    - `display_frames`: exposures of the display before a dark scene, whose mean is subtracted from
      each capture; with 0 its light stays.
    """

    with_path: ClassVar[tuple[str, ...]] = ("display_light",)
    kind: Literal["screen"]
    lens: LensConfig | None = None  # pyright: ignore[reportIncompatibleVariableOverride]
    mask: ScreenMaskConfig | None = None
    noise: NoiseConfig
    methods: Annotated[tuple[ScreenMethodConfig, ...], Field(min_length=1)]
    models: Annotated[tuple[ModelConfig, ...], Field(min_length=1)]
    calibration: CalibrationConfig | None = None
    display_frames: Annotated[int, Field(ge=0, le=1000)] = 1
    targets: Annotated[tuple[ScreenTargetConfig, ...], Field(min_length=1)]
    notes: tuple[str, ...] = ()

    @pydantic.model_validator(mode="after")
    def _fits(self):
        check_names(self, "methods", "models", "targets")
        if (self.lens is None) == (self.mask is None):
            raise FieldError("give a lens, or a mask in its place", "mask")
        if self.mask is not None:
            if self.calibration is not None:
                raise FieldError("measures a camera with a lens; drop it", "calibration")
            mistakes, colours = [model.mistake for model in self.models], self.hologram.recorded
            require_mask_fits(mistakes, len(colours), self.band_samples, self.screen.tilt)
        if self.display_light is not None:
            if self.calibration is not None:
                raise FieldError("is of captures without a calibration; drop one", "display_light")
            noise, colours = self.noise.build(), len(self.hologram.recorded)
            require_display_fits(noise, colours, self.mask is not None)
        if self.calibration is not None:
            if self.hologram.colours is not None and self.calibration.distances:
                message = "need a hologram of one colour; drop them or hologram.colours"
                raise FieldError(message, "calibration", "distances")
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

    @property
    def optics(self) -> dict[str, Any]:
        if self.mask is None:
            return super().optics
        return {"focal_distance": self.mask.distance, "lens_distance": self.mask.gap}
