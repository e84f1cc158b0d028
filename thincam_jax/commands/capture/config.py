"""Experiment files of `kind: capture`: the devices of a rig, the plan, and what is seen."""

from typing import Annotated, Any, Literal

import pydantic
from pydantic import Field

from thincam_jax._core.quantity import FieldError
from thincam_jax.commands.schema import Length, Section, Wavelength, section
from thincam_jax.commands.screen.config import (
    ScreenMethodConfig,
    ScreenTargetConfig,
    SeeThroughConfig,
)
from thincam_jax.commands.sections import (
    ExperimentConfig,
    MethodKind,
    Name,
    ObjectConfig,
    VariationConfig,
    check_names,
)
from thincam_jax.hardware.acquisition.request import ANYTHING, MONITOR, PlanRequest
from thincam_jax.hardware.acquisition.taker import Procedure
from thincam_jax.hardware.base import CameraSettings
from thincam_jax.hardware.virtual.rig import Electronics, VirtualRig
from thincam_jax.imaging.sensor import Sensor
from thincam_jax.lensless.masks.fza import FresnelZoneAperture
from thincam_jax.lensless.method import Model

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
    section(Procedure, only=("settle",), defaults={"settle": None}),
):
    """The modulator or monitor; `pitch`: of its pixels; `settle`: left out, it is measured."""

    pitch: Length | None = None


class PlanConfig(section(PlanRequest)):
    """`thincam_jax.hardware.acquisition.PlanRequest`."""


class AcquisitionConfig(section(Procedure, only=("exposure", "timeout", "retries", "saturated"))):
    """Procedure of frames; see `thincam_jax.hardware.acquisition.Procedure`."""


class OpticsConfig(Section):
    """The lensless camera; `distance`: from the modulator to the sensor, with the stage at 0."""

    wavelength: Wavelength
    distance: Length
    object: ObjectConfig
    model: Model = "separable"
    pixel_integration: bool = True


class ReconstructionConfig(Section):
    """Reconstruction of the image; as of a study's methods."""

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
    """Captures of a rig, `rig: real`, or of a simulated one, `rig: virtual`.

    - `display`: a scene needs none; someone covers the camera for dark frames.
    - `targets`: what stands at the object's distance of a virtual rig, or on its screen's cells,
      one; or the pictures of a plan of kind pictures, on its cells.
    - `matrix`: with which such pictures, or a scene, are reconstructed: matrix.zarr of a
      calibration's run, or the store of its captures; by `methods`.
    """

    kind: Literal["capture"]
    rig: Literal["virtual", "real"]
    camera: CameraConfig
    display: DisplayConfig = DisplayConfig(driver="shutter")
    stage: DeviceConfig | None = None
    plan: PlanConfig
    acquisition: AcquisitionConfig = AcquisitionConfig()
    optics: OpticsConfig | None = None
    reconstruction: ReconstructionConfig = ReconstructionConfig()
    virtual: VirtualConfig | None = None
    targets: tuple[ScreenTargetConfig, ...] = ()
    matrix: str | None = None
    methods: tuple[ScreenMethodConfig, ...] = ()
    notes: tuple[str, ...] = ()

    @pydantic.model_validator(mode="after")
    def _fits(self):
        kind, by_cells, optics = self.plan.kind, self.by_cells, self.optics is not None
        if kind in ("method_a", "psf_stack") and self.stage is None:
            raise FieldError(f"a plan of kind {kind} moves a stage; give one", "stage")
        simulated = self.rig == "virtual"
        if self.display.pitch is None and (kind != "scene" or simulated):
            raise FieldError(
                f"a plan of kind {kind} is shown on pixels; give it", "display", "pitch"
            )
        if optics and self.plan.width is None and not by_cells:
            raise FieldError("optics need betas and width of the mask; give them", "plan", "width")
        if by_cells == optics and (by_cells or simulated or kind not in ANYTHING):
            verb = "takes no" if by_cells else "needs"
            raise FieldError(f"a plan of kind {kind} {verb} optics", "optics")
        if kind == "grey_levels" and self.display.options.get("grey_levels"):
            raise FieldError("this plan measures it; drop it", "display", "options", "grey_levels")
        check_names(self, "methods", "targets")
        if (kind == "pictures") != (self.matrix is not None) and kind != "scene":
            verb = "needs it" if kind == "pictures" else "takes none; drop it"
            raise FieldError(f"a plan of kind {kind} {verb}", "matrix")
        if self.matrix is not None:
            for key in ("targets", "methods") if kind == "pictures" else ("methods",):
                if not getattr(self, key):
                    raise FieldError(f"a plan of kind {kind} needs them; give one", key)
        elif self.methods:
            raise FieldError(f"a plan of kind {kind} has 'reconstruction'; drop them", "methods")
        if kind != "pictures" and len(self.targets) > 1:
            raise FieldError(f"a plan of kind {kind} has one; drop the others", "targets")
        if simulated:
            self._check_virtual()
        return self

    @property
    def by_cells(self) -> bool:
        """Whether the camera is one of cells, with a matrix."""
        return self.plan.kind in MONITOR or self.matrix is not None

    @property
    def cells(self) -> tuple[int, int] | None:
        """Of the plan, or those that a virtual rig's scene stands on."""
        seen = self.virtual.screen if self.virtual and self.rig == "virtual" else None
        return self.plan.cells if seen is None else seen.object.cells

    @property
    def drivers(self) -> dict[Any, tuple[str, dict[str, Any]]]:
        """Driver and options of each device, by its role."""
        devices = {"camera": self.camera, "display": self.display, "stage": self.stage}
        return {role: (one.driver, one.options) for role, one in devices.items() if one is not None}

    def _check_virtual(self) -> None:
        plan, virtual = self.plan, self.virtual
        if virtual is None:
            raise FieldError("rig: virtual needs this section", "virtual")
        if plan.kind not in MONITOR and not self.targets:
            raise FieldError("a virtual rig looks at one; give it", "targets")
        if not self.by_cells:
            return
        seen, place = virtual.screen, ("virtual", "screen")
        if seen is None:
            raise FieldError(f"a virtual rig for a plan of kind {plan.kind} needs it", *place)
        if seen.hologram.colours is not None:
            message = f"a plan of kind {plan.kind} takes one colour; give wavelength instead"
            raise FieldError(message, *place, "hologram", "colours")
        if plan.cells not in (None, seen.object.cells):
            raise FieldError(f"the plan shows {plan.cells}; give these", *place, "object", "cells")
        if seen.sensor.shape != virtual.sensor:
            message = f"virtual.sensor is {virtual.sensor}; give this"
            raise FieldError(message, *place, "sensor", "shape")
