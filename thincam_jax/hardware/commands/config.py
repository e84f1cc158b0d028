"""Experiment files of `kind: capture`: the devices of a rig, the plan, and what is seen."""

import functools
from collections.abc import Iterator
from dataclasses import asdict
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
import pydantic
from pydantic import BeforeValidator, Field

from thincam_jax._core.files import photograph_files
from thincam_jax._core.quantity import FieldError
from thincam_jax._core.text import slug
from thincam_jax.commands.kinds import section_of
from thincam_jax.commands.mask import MaskConfig
from thincam_jax.commands.pictures import ScreenMethodConfig, ScreenTargetConfig
from thincam_jax.commands.schema import Length, Section, Wavelength, section
from thincam_jax.commands.sections import (
    ExperimentConfig,
    MethodKind,
    Name,
    ObjectConfig,
    VariationConfig,
    check_names,
)
from thincam_jax.hardware.acquisition.request import MONITOR, PlanRequest
from thincam_jax.hardware.acquisition.taker import Procedure
from thincam_jax.hardware.base import CameraSettings
from thincam_jax.hardware.cameras.features import BIT_DEPTHS
from thincam_jax.hardware.displays.levels import PhaseLevels
from thincam_jax.hardware.virtual.optics import MonitorPose, StageErrors
from thincam_jax.hardware.virtual.rig import Electronics, VirtualRig
from thincam_jax.imaging.sensor import Sensor
from thincam_jax.lensless.masks.fza import FresnelZoneAperture
from thincam_jax.lensless.method import Model

if TYPE_CHECKING:
    from thincam_jax.waveguide.commands.config import SeeThroughConfig
else:
    SeeThroughConfig = section_of("waveguide", "config:SeeThroughConfig")

Count = Annotated[int, Field(ge=1, le=65536)]


class DeviceConfig(Section):
    """A device by the name of its driver (`thincam doctor --all` lists them), and its options."""

    driver: Name
    options: dict[str, Any] = {}


class CameraConfig(DeviceConfig, section(CameraSettings), section(Sensor, only=("pitch",))):
    """The camera and its settings; `pitch`: side of its pixels."""

    pixel_format: Literal[tuple(BIT_DEPTHS)] = "Mono12"  # pyright: ignore[reportInvalidTypeForm]


class PhaseLevelsConfig(section(PhaseLevels)):
    """`thincam_jax.hardware.displays.PhaseLevels`; or the path of its JSON file."""


def _read(given: Any) -> Any:
    if not isinstance(given, str):
        return given
    return PhaseLevelsConfig.model_construct(**asdict(PhaseLevels.load(given)))


PhaseTable = Annotated[
    PhaseLevelsConfig, BeforeValidator(_read, json_schema_input_type=PhaseLevelsConfig | str)
]


class DisplayConfig(
    DeviceConfig,
    section(FresnelZoneAperture, only=("fill_factor",)),
    section(Procedure, only=("settle",), defaults={"settle": None}),
):
    """The modulator or monitor; `pitch`: side of its pixels; `settle`: measured if left out.

    - `phase_levels`: levels of a phase modulator, which shows the file's `mask`.
    """

    pitch: Length | None = None
    phase_levels: PhaseTable | None = None


class PlanConfig(section(PlanRequest)):
    """`thincam_jax.hardware.acquisition.PlanRequest`."""


class AcquisitionConfig(section(Procedure, only=("exposure", "timeout", "retries", "saturated"))):
    """Procedure of frames; see `thincam_jax.hardware.acquisition.Procedure`."""


class OpticsConfig(Section):
    """The lensless camera; `distance`: from the modulator to the sensor, with the stage at 0.

    - `colours`: wavelengths of red, green and blue of a Bayer format in place of `wavelength`.
    """

    wavelength: Wavelength | None = None
    colours: tuple[Wavelength, Wavelength, Wavelength] | None = None
    distance: Length
    object: ObjectConfig
    model: Model = "separable"
    pixel_integration: bool = True


class ReconstructionConfig(Section):
    """Reconstruction of the image; as of a study's methods.

    - `registration`: whether images of the single shots tell where the sensor stood; by default
      those of a manual stage do.
    """

    kind: MethodKind = "wiener"
    variation: VariationConfig | None = None
    registration: bool | None = None


class StageErrorsConfig(section(StageErrors)):
    """Errors of the stage's positions, but at 0."""


class MonitorConfig(section(MonitorPose)):
    """Pose of a monitor beside the middle of the object's plane."""


_RIG = ("full_well", "read_noise", "offset", "response", "fiducial")


class VirtualConfig(section(Electronics, VirtualRig, only=_RIG, defaults={"response": None})):
    """A rig that is simulated, for `rig: virtual`.

    - `sensor`, `display`: (rows, columns).
    - `electrons`: per second, of a pixel from each mm² of open aperture before a white scene; with
      a screen, of the brightest pixel before a white monitor.
    - `screen`: a see-through camera before a monitor, for a Hadamard plan.
    - `monitor`: its true pose before a lensless camera. `stage`: errors of the stage's positions.
    - `phase_levels`: true levels of a phase modulator; default those of the display.
    """

    sensor: tuple[Count, Count]
    display: tuple[Count, Count]
    electrons: Annotated[float, Field(gt=0)]
    screen: SeeThroughConfig | None = None
    monitor: MonitorConfig = MonitorConfig()
    stage: StageErrorsConfig | None = None
    phase_levels: PhaseTable | None = None


class CaptureConfig(ExperimentConfig):
    """Captures of a rig, `rig: real`, or of a simulated one, `rig: virtual`.

    - `display`: a scene needs none; someone covers the camera for dark frames.
    - `targets`: targets at the object's distance of a virtual rig, or on its screen's cells, one;
      or the pictures of a plan of kind pictures, on its cells.
    - `photographs`: a folder of image files, which become targets, each named after its file;
      `licence`: theirs, which a data set of them states; `held_out`: how many of the last ones are
      its split "test".
    - `matrix`: with which such pictures, or a scene, are reconstructed: matrix.zarr of a
      calibration's run, or the store of its captures; by `methods`.
    - `mask`: on a phase modulator, in pixels of the display.
    - `alignment`: alignment.json of such a plan: shows pictures where a lensless model has them.
    """

    kind: Literal["capture"]
    rig: Literal["virtual", "real"]
    camera: CameraConfig
    display: DisplayConfig = DisplayConfig(driver="shutter")
    stage: DeviceConfig | None = None
    plan: PlanConfig
    mask: MaskConfig | None = None
    acquisition: AcquisitionConfig = AcquisitionConfig()
    optics: OpticsConfig | None = None
    reconstruction: ReconstructionConfig = ReconstructionConfig()
    virtual: VirtualConfig | None = None
    targets: tuple[ScreenTargetConfig, ...] = ()
    photographs: str | None = None
    licence: str | None = None
    held_out: Count | None = None
    matrix: str | None = None
    alignment: str | None = None
    methods: tuple[ScreenMethodConfig, ...] = ()
    notes: tuple[str, ...] = ()

    @pydantic.model_validator(mode="before")
    @classmethod
    def _with_photographs(cls, given: Any):
        """The file with a target for each photograph: a resolved file names them."""
        folder = given.get("photographs") if isinstance(given, dict) else None
        if not folder or not isinstance(folder, str):
            return given
        try:
            files = photograph_files(folder)
        except ValueError as error:
            raise FieldError(str(error), "photographs") from None
        found = [{"name": slug(one.stem), "kind": "file", "path": str(one)} for one in files]
        return {**given, "targets": [*given.get("targets", ()), *found], "photographs": None}

    @pydantic.model_validator(mode="after")
    def _fits(self):
        check_names(self, "methods", "targets")
        for broken, message, *place in self._rules():
            if broken:
                raise FieldError(message, *place)
        return self

    def _rules(self) -> Iterator[tuple[Any, ...]]:
        """Whether each rule is broken, what is wrong then, and where; the first one counts."""
        kind, simulated, virtual = self.plan.kind, self.rig == "virtual", self.virtual
        plan, camera = self.plan.build(), self.camera.build(CameraSettings)
        given = {name for part in (self, self.optics or ()) for name, value in part if value}
        yield from plan.rules(given, camera, self.display.pitch, len(self.targets), simulated)
        pairs = len(self.targets) if self.makes_pairs else 0
        fault = f"this file makes {pairs} pairs; give fewer, or drop it"
        yield self.held_out is not None and self.held_out >= pairs, fault, "held_out"
        corrected = kind == "grey_levels" and self.display.options.get("grey_levels")
        yield corrected, "this plan measures it; drop it", "display", "options", "grey_levels"
        unpaired = (self.display.phase_levels is None) != (self.mask is None)
        yield unpaired, "and 'mask' belong together; give both", "display", "phase_levels"
        yield (
            self.mask and "colours" in given,
            "a phase mask has one wavelength",
            "optics",
            "colours",
        )
        yield simulated and virtual is None, "rig: virtual needs this section", "virtual"
        if simulated and virtual is not None:
            unseen = kind not in MONITOR and not self.targets
            yield unseen, "a virtual rig looks at one; give it", "targets"
            if plan.by_cells("matrix" in given, "optics" in given):
                screen, place = virtual.screen, ("virtual", "screen")
                yield screen is None, f"a virtual rig for a plan of kind {kind} needs it", *place
                assert screen is not None
                coloured = screen.hologram.colours is not None
                fault = f"a plan of kind {kind} takes one colour; give wavelength instead"
                yield coloured, fault, *place, "hologram", "colours"
                fault = f"the plan shows {self.plan.cells}; give these"
                other = self.plan.cells not in (None, screen.object.cells)
                yield other, fault, *place, "object", "cells"
                fault = f"virtual.sensor is {virtual.sensor}; give this"
                yield screen.sensor.shape != virtual.sensor, fault, *place, "sensor", "shape"

    @property
    def makes_pairs(self) -> bool:
        """Whether its pictures, on an aligned monitor, make a data set of captures and truths."""
        return self.alignment is not None and len(self.targets) > 1

    @functools.cached_property
    def shown(self) -> dict[str, np.ndarray]:
        """Levels of its pictures by name, see `picture_levels`, read once."""
        from thincam_jax.hardware.commands.run import picture_levels

        return picture_levels(self)

    @property
    def cells(self) -> tuple[int, int] | None:
        """Cells of the plan, or those that a virtual rig's scene stands on."""
        seen = self.virtual.screen if self.virtual and self.rig == "virtual" else None
        return self.plan.cells if seen is None else seen.object.cells

    @property
    def drivers(self) -> dict[Any, tuple[str, dict[str, Any]]]:
        """Driver and options of each device, by its role."""
        devices = {"camera": self.camera, "display": self.display, "stage": self.stage}
        return {role: (one.driver, one.options) for role, one in devices.items() if one is not None}
