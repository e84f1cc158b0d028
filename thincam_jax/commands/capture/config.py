"""Experiment files of `kind: capture`: the devices of a rig, the plan, and what is seen."""

from typing import Annotated, Any, Literal

import pydantic
from pydantic import Field

from thincam_jax.commands.screen.config import SeeThroughConfig, check_cells
from thincam_jax.commands.sections import (
    Angle,
    Curvature,
    ExperimentConfig,
    Length,
    MethodKind,
    Name,
    ObjectConfig,
    Section,
    TargetConfig,
    Time,
    VariationConfig,
    Wavelength,
    misfit,
)
from thincam_jax.lensless.masks.fza import Profile
from thincam_jax.lensless.method import Model
from thincam_jax.measured.calibration.hadamard import Display, HadamardSeries, Order

Count = Annotated[int, Field(ge=1, le=65536)]


class RegionConfig(Section):
    """Part of the sensor, in pixels; an image is that of a part about the axis."""

    top: Annotated[int, Field(ge=0)] = 0
    left: Annotated[int, Field(ge=0)] = 0
    height: Count
    width: Count


class DeviceConfig(Section):
    """A device by the name of its driver (`thincam doctor` lists them), and its options."""

    driver: Name
    options: dict[str, Any] = {}


class CameraConfig(DeviceConfig):
    """The camera and its settings; `pitch`: of its pixels."""

    exposure: Time
    pixel_format: Literal["Mono8", "Mono10", "Mono12", "Mono16"] = "Mono12"
    gain: float = 0.0
    region: RegionConfig | None = None
    pitch: Length


class DisplayConfig(DeviceConfig):
    """The modulator or monitor; `pitch`: of its pixels; `settle`: until it shows a pattern."""

    pitch: Length
    fill_factor: Annotated[float, Field(gt=0, le=1)] = 1.0
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


class PlanConfig(Section):
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
    width: Length | None = None
    profile: Profile = "cosine"
    phase: Angle = 0.0
    distances: tuple[Length, ...] = ()
    cells: tuple[Count, Count] | None = None
    order: Order = "sequency"
    display: Display = "complementary"
    dark_frames: Annotated[int, Field(ge=0, le=4096)] = 0

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
                raise misfit(f"a plan of kind {self.kind} needs it", key)
        for key in sorted(given.difference(allowed)):
            raise misfit(f"a plan of kind {self.kind} takes {', '.join(allowed)}; drop it", key)
        if self.kind == "method_b" and len(self.betas) < 2:
            raise misfit("method_b compares two β or more; give another", "betas")
        if self.kind not in ("method_b", "hadamard") and len(self.betas) != 1:
            raise misfit(f"a plan of kind {self.kind} has one β; give one", "betas")
        if len(set(self.betas)) < len(self.betas) or len(set(self.distances)) < len(self.distances):
            raise misfit("an entry stands twice; give each once", "betas")
        if self.cells is not None:
            check_cells(self.cells, "cells")
        return self

    @property
    def series(self) -> HadamardSeries:
        """Of a plan of kind hadamard."""
        assert self.cells is not None  # checked above
        return HadamardSeries(self.cells, self.order, self.display, self.dark_frames)


class AcquisitionConfig(Section):
    """How frames are taken.

    - `timeout`: until a frame is there, beyond its exposure.
    - `retries`: how often a frame that did not come, or not whole, is taken again.
    - `saturated`: largest part of the pixels that may be at the largest count.
    """

    timeout: Time = 2.0
    retries: Annotated[int, Field(ge=0, le=100)] = 3
    saturated: Annotated[float, Field(ge=0, le=1)] = 0.01


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


class VirtualConfig(Section):
    """A rig that is simulated, for `rig: virtual`.

    - `sensor`, `display`: (rows, columns).
    - `electrons`: per second, of a pixel from each mm² of open aperture before a white scene; with
      a screen, of the brightest pixel before a white monitor.
    - `full_well`, `read_noise`: in electrons; `offset`: counts of a dark frame in those of 12 bits.
    - `response`: of the display; before, the pattern before is seen.
    - `fiducial`: each frame says in its corner what it was exposed of.
    - `screen`: a see-through camera before a monitor, for a Hadamard plan.
    """

    sensor: tuple[Count, Count]
    display: tuple[Count, Count]
    electrons: Annotated[float, Field(gt=0)]
    full_well: Annotated[float, Field(gt=0)] = 13_500.0
    read_noise: Annotated[float, Field(ge=0)] = 8.0
    offset: Annotated[float, Field(ge=0, lt=2048)] = 60.0
    response: Time | None = None
    fiducial: bool = False
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
            raise misfit(f"a plan of kind {kind} moves a stage; give one", "stage")
        if (kind == "hadamard") == (self.optics is not None):
            verb = "takes no" if kind == "hadamard" else "needs"
            raise misfit(f"a plan of kind {kind} {verb} optics", "optics")
        if self.rig == "virtual":
            self._check_virtual()
        return self

    def _check_virtual(self) -> None:
        plan, virtual = self.plan, self.virtual
        if virtual is None:
            raise misfit("rig: virtual needs this section", "virtual")
        if plan.kind != "hadamard":
            if not self.targets:
                raise misfit("a virtual rig looks at one; give it", "targets")
            return
        seen = virtual.screen
        if seen is None:
            raise misfit("a virtual rig for a plan of kind hadamard needs it", "virtual", "screen")
        if seen.hologram.colours is not None:
            message = "a plan of kind hadamard takes one colour; give wavelength in their place"
            raise misfit(message, "virtual", "screen", "hologram", "colours")
        if seen.object.cells != plan.cells:
            message = f"the plan shows {plan.cells}; give these"
            raise misfit(message, "virtual", "screen", "object", "cells")
        if seen.sensor.shape != virtual.sensor:
            message = f"virtual.sensor is {virtual.sensor}; give this"
            raise misfit(message, "virtual", "screen", "sensor", "shape")
