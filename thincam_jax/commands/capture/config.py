"""Experiment files of `kind: capture`: the devices of a rig, the plan, and what is seen."""

from typing import Annotated, Any, Literal

import pydantic
from pydantic import Field

from thincam_jax._core.quantity import FieldError
from thincam_jax.commands.schema import Curvature, Length, Section, Time, Wavelength, section
from thincam_jax.commands.screen.config import SeeThroughConfig, check_cells
from thincam_jax.commands.sections import (
    ExperimentConfig,
    MethodKind,
    Name,
    ObjectConfig,
    TargetConfig,
    VariationConfig,
)
from thincam_jax.hardware.acquisition.taker import Procedure
from thincam_jax.hardware.base import CameraSettings
from thincam_jax.hardware.virtual.rig import Electronics, VirtualRig
from thincam_jax.imaging.sensor import Sensor
from thincam_jax.lensless.masks.fza import FresnelZoneAperture
from thincam_jax.lensless.method import Model
from thincam_jax.measured.calibration.hadamard import HadamardSeries

Count = Annotated[int, Field(ge=1, le=65536)]


class DeviceConfig(Section):
    """A device by the name of its driver (`thincam doctor` lists them), and its options."""

    driver: Name
    options: dict[str, Any] = {}


class CameraConfig(DeviceConfig, section(CameraSettings), section(Sensor, only=("pitch",))):
    """The camera and its settings; `pitch`: of its pixels."""

    pixel_format: Literal["Mono8", "Mono10", "Mono12", "Mono16"] = "Mono12"


class DisplayConfig(
    DeviceConfig,
    section(FresnelZoneAperture, only=("fill_factor",)),
    section(Procedure, only=("settle",)),
):
    """The modulator or monitor; `pitch`: of its pixels; `settle`: until it shows a pattern."""

    pitch: Length
    settle: Time


PlanKind = Literal["fringe_scan", "method_a", "method_b", "psf_stack", "hadamard"]
# What each kind needs, and what it may have beside the dark frames.
_ZONES = ("betas", "width")
_NUMBERS: dict[PlanKind, tuple[tuple[str, ...], tuple[str, ...]]] = {
    "fringe_scan": (_ZONES, ("profile",)),
    "method_a": ((*_ZONES, "distances"), ("profile",)),
    "method_b": (_ZONES, ("profile",)),
    "psf_stack": ((*_ZONES, "distances"), ("profile", "phase")),
    "hadamard": (("cells",), ("order", "display")),
}


_PATTERNS, _SHOWN = ("order", "display", "dark_frames"), ("width", "profile", "phase")
_Plate = section(FresnelZoneAperture, only=_SHOWN, defaults={"width": None})


class PlanConfig(section(HadamardSeries, only=_PATTERNS), _Plate):
    """What is captured.

    - `betas`: β of the Fresnel zone apertures, two or more for method_b, else one; `width`,
      `profile`, `phase`: of all of them.
    - `distances`: mask-sensor distances (method_a) or those of
      what the stage carries (psf_stack; the stage of a virtual rig carries the sensor).
    - `cells`, `order`, `display`: of the Hadamard patterns.
    - `dark_frames`: in all; they are spread over the plan.
    """

    kind: PlanKind
    betas: tuple[Curvature, ...] = ()
    distances: tuple[Length, ...] = ()
    cells: tuple[Count, Count] | None = None

    @pydantic.model_validator(mode="after")
    def _fits(self):
        # A resolved file names the defaults, too.
        fields = {key: field.default for key, field in type(self).model_fields.items()}
        given = {key for key, usual in fields.items() if getattr(self, key) != usual}
        given -= {"kind", "dark_frames"}
        needed, also = _NUMBERS[self.kind]
        allowed = (*needed, *also)
        for key in needed:
            if not getattr(self, key):
                raise FieldError(f"a plan of kind {self.kind} needs it", key)
        for key in sorted(given.difference(allowed)):
            raise FieldError(f"a plan of kind {self.kind} takes {', '.join(allowed)}; drop it", key)
        if self.kind == "method_b" and len(self.betas) < 2:
            raise FieldError("method_b compares two β or more; give another", "betas")
        if self.kind not in ("method_b", "hadamard") and len(self.betas) != 1:
            raise FieldError(f"a plan of kind {self.kind} has one β; give one", "betas")
        if len(set(self.betas)) < len(self.betas) or len(set(self.distances)) < len(self.distances):
            raise FieldError("an entry stands twice; give each once", "betas")
        if self.cells is not None:
            check_cells(self.cells, "cells")
        return self

    @property
    def series(self) -> HadamardSeries:
        """Of a plan of kind hadamard."""
        assert self.cells is not None  # checked above
        return self.build(HadamardSeries, object_shape=self.cells)


class AcquisitionConfig(
    section(Procedure, only=("timeout", "retries", "saturated"), defaults={"saturated": 0.01})
):
    """How frames are taken; see `thincam_jax.hardware.acquisition.Procedure`."""


class OpticsConfig(Section):
    """The lensless camera; `distance`: from the modulator to the sensor, with the stage at 0."""

    wavelength: Wavelength
    distance: Length
    object: ObjectConfig
    model: Model = "separable"
    pixel_integration: bool = True


class ReconstructionConfig(Section):
    """How the image is made; as of a study's methods."""

    kind: MethodKind = "wiener"
    variation: VariationConfig | None = None


_RIG = ("full_well", "read_noise", "offset", "response", "fiducial")


class VirtualConfig(section(Electronics, VirtualRig, only=_RIG, defaults={"response": None})):
    """A rig that is simulated, for `rig: virtual`.

    - `sensor`, `display`: (rows, columns).
    - `electrons`: per second, of a pixel from each mm² of open aperture before a white scene; with
      a screen, of the brightest pixel before a white monitor.
    - `screen`: a see-through camera before a monitor, for a Hadamard plan.
    """

    sensor: tuple[Count, Count]
    display: tuple[Count, Count]
    electrons: Annotated[float, Field(gt=0)]
    screen: SeeThroughConfig | None = None


class CaptureConfig(ExperimentConfig):
    """What a rig captures, `rig: real`, or one that is simulated, `rig: virtual`.

    - `targets`: what stands at the object's distance of a virtual rig, one.
    """

    kind: Literal["capture"]
    rig: Literal["virtual", "real"]
    camera: CameraConfig
    display: DisplayConfig
    stage: DeviceConfig | None = None
    plan: PlanConfig
    acquisition: AcquisitionConfig = AcquisitionConfig()
    optics: OpticsConfig | None = None
    reconstruction: ReconstructionConfig = ReconstructionConfig()
    virtual: VirtualConfig | None = None
    targets: Annotated[tuple[TargetConfig, ...], Field(max_length=1)] = ()
    notes: tuple[str, ...] = ()

    @pydantic.model_validator(mode="after")
    def _fits(self):
        kind = self.plan.kind
        if kind in ("method_a", "psf_stack") and self.stage is None:
            raise FieldError(f"a plan of kind {kind} moves a stage; give one", "stage")
        if (kind == "hadamard") == (self.optics is not None):
            verb = "takes no" if kind == "hadamard" else "needs"
            raise FieldError(f"a plan of kind {kind} {verb} optics", "optics")
        if self.rig == "virtual":
            self._check_virtual()
        return self

    @property
    def drivers(self) -> dict[Any, tuple[str, dict[str, Any]]]:
        """Driver and options of each device, by its role."""
        devices = {"camera": self.camera, "display": self.display, "stage": self.stage}
        return {role: (one.driver, one.options) for role, one in devices.items() if one is not None}

    def _check_virtual(self) -> None:
        plan, virtual = self.plan, self.virtual
        if virtual is None:
            raise FieldError("rig: virtual needs this section", "virtual")
        if plan.kind != "hadamard":
            if not self.targets:
                raise FieldError("a virtual rig looks at one; give it", "targets")
            return
        seen = virtual.screen
        if seen is None:
            message = "a virtual rig for a plan of kind hadamard needs it"
            raise FieldError(message, "virtual", "screen")
        if seen.hologram.colours is not None:
            message = "a plan of kind hadamard takes one colour; give wavelength in their place"
            raise FieldError(message, "virtual", "screen", "hologram", "colours")
        if seen.object.cells != plan.cells:
            message = f"the plan shows {plan.cells}; give these"
            raise FieldError(message, "virtual", "screen", "object", "cells")
        if seen.sensor.shape != virtual.sensor:
            message = f"virtual.sensor is {virtual.sensor}; give this"
            raise FieldError(message, "virtual", "screen", "sensor", "shape")
