"""What is simulated: exposures of cameras, targets, and the methods that reconstruct them."""

import functools
import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import Any, get_args

import jax
import numpy as np
from jaxtyping import Array

from thincam_jax._core import checks
from thincam_jax.commands.sections import (
    PHASES,
    MaskConfig,
    MethodKind,
    Relief,
    SensorConfig,
    Synthesis,
    VariationConfig,
)
from thincam_jax.imaging.scene import ImagePlane
from thincam_jax.imaging.sensor import AbstractNoise, Sensor
from thincam_jax.lensless import masks
from thincam_jax.lensless.camera import LenslessCamera
from thincam_jax.lensless.masks.fza import Profile, edge_frequency
from thincam_jax.lensless.method import Model
from thincam_jax.lensless.propagation.path import Path
from thincam_jax.lensless.psf import psf
from thincam_jax.lensless.sampling import unresolved
from thincam_jax.reconstruction import Reconstruction
from thincam_jax.reconstruction import synthesis as syntheses
from thincam_jax.reconstruction.wiener import Prior

Reconstructor = Callable[[Array, Array], Reconstruction]


@dataclass(frozen=True)
class Exposure:
    """One exposure; those that are equal are taken once for all methods.

    - `beta`, `phase`, `width`: of the mask, rad/mm², rad and mm.
    - `distance`: mask to sensor, mm; `wavelength`: mm.
    - `share`: of the sensor's exposure time.
    - `take`: counts the exposures of a method that are equal in all else.
    - `profile`: of the mask; None is that of the study.
    - `moves`: of the target meanwhile, see `ImagePlane`.
    """

    beta: float
    phase: float
    distance: float
    wavelength: float
    width: float
    share: float = 1.0
    take: int = 1
    profile: Profile | None = None
    moves: tuple[float, float] | None = None


@dataclass(frozen=True, eq=False)
class Capture:
    """What was read out (*channel, y, x), and the variance of its noise (*channel,)."""

    image: np.ndarray
    variance: np.ndarray


@dataclass(frozen=True)
class Method:
    """A reconstruction and the exposures that it takes, in the order of its synthesis.

    - `phases`: how many exposures each shot has.
    - `variation`: of admm_tv. `harmonics`: of the synthesis of that name.
    """

    name: str
    kind: MethodKind
    synthesis: Synthesis
    exposures: tuple[Exposure, ...]
    phases: int
    variation: VariationConfig | None = None
    harmonics: tuple[int, ...] = ()

    @property
    def shots(self) -> tuple[Exposure, ...]:
        """The first exposure of each shot."""
        return self.exposures[:: self.phases]

    @property
    def distance(self) -> float:
        """The largest mask-sensor distance, on whose scale the method reconstructs, mm."""
        return max(exposure.distance for exposure in self.exposures)

    @property
    def synthesis_matrix(self) -> np.ndarray:
        """Real weights (channel, exposure)."""
        return self.weights(len(self.shots))

    def weights(self, shots: int) -> np.ndarray:
        """Real weights (channel, exposure) of so many of its shots."""
        if self.synthesis == "harmonics":
            return syntheses.harmonics(shots, self.phases, self.harmonics)
        return synthesis_matrix(self.synthesis, shots, self.phases)


def synthesis_matrix(synthesis: Synthesis, shots: int, phases: int) -> np.ndarray:
    """Real weights (channel, exposure) of so many shots with so many phases each."""
    # Those that set the phases themselves treat each shot alike.
    return getattr(syntheses, synthesis)(shots if synthesis in PHASES else shots * phases)


def unresolved_zones(
    exposures: Iterable[Exposure], pitch: float, object_distance: float, height: float | None
) -> list[str]:
    """A warning where pixels of a pitch, mm, do not resolve the finest zones of masks that may have
    a height."""
    finest = max(
        edge_frequency(e.beta, max(e.width, height or 0)) / (1 + e.distance / object_distance)
        for e in exposures
    )
    fault = unresolved(finest, pitch)
    return [fault] if fault else []


def built_mask(config: MaskConfig, exposure: Exposure) -> masks.AbstractMask:
    """The mask of an exposure, on its display; ValueError for numbers that make none."""
    if config.family == "fza":
        return masks.FresnelZoneAperture(
            exposure.beta,
            exposure.phase,
            width=exposure.width,
            height=config.height,
            profile=exposure.profile or config.profile,
            pixel_pitch=config.pixel_pitch,
            fill_factor=config.fill_factor,
            harmonics=config.harmonics,
        )
    printed = _printed(config, exposure)
    if config.pixel_pitch is None:
        return printed
    return masks.on_display(printed, config.pixel_pitch, config.fill_factor)


def _printed(config: MaskConfig, exposure: Exposure) -> masks.AbstractMask:
    """Of the families without zones."""
    cell, tiles, height = config.cell or 0.0, config.tiles or 1, config.height
    family = config.family
    if family == "mura":
        return masks.ModifiedUniformlyRedundantArray(config.order or 0, cell, tiles=tiles)
    if family == "ura":
        return masks.UniformlyRedundantArray(config.orders or (0, 0), cell, tiles=tiles)
    if family == "mls":
        code = masks.maximum_length_sequence(config.length or 0)
        return masks.SeparableMask(code, code, cell, combine=config.combine)
    if family == "random":
        key = jax.random.key(config.seed or 0)
        return masks.random_cells(key, config.width, cell, height=height)
    if family == "pinhole":
        return masks.Pinhole(config.width, height)
    if family == "lenslets":
        return masks.LensletArray(config.focal_length or 0.0, cell, config.lenses or (1, 1))
    if family in get_args(Relief):
        smooth = family == "diffuser"
        heights = _heights(config, exposure.wavelength, exposure.distance)
        how = "bilinear" if smooth else "cells"
        return masks.PhaseMask(heights, cell, config.index, interpolation=how)
    amplitude = masks.read_mask(config.path or "", 1.0).amplitude
    return masks.SampledMask(amplitude, config.width / amplitude.shape[1])


def _heights(config: MaskConfig, wavelength: float, distance: float) -> Array:
    """Of a phase mask for objects far away, mm."""
    from thincam_jax import design

    cell = config.cell or 0.0
    count = checks.whole_cells("width", config.width, "cell", cell)
    blank = masks.MaskBlank((count, count), cell, config.index)
    key = jax.random.key(config.seed or 0)
    if config.family == "diffuser":
        length, slope = config.correlation_length or 0.0, config.rms_slope or 0.0
        mask = masks.diffuser(key, blank, correlation_length=length, rms_slope=slope)
    elif config.family == "voronoi_fresnel":
        focal_length, sites = config.focal_length or 0.0, config.sites or 0
        mask = masks.voronoi_fresnel(
            key, blank, sites=sites, focal_length=focal_length, wavelength=wavelength
        )
    else:
        feature, line_width = config.feature or 0.0, config.line_width or 0.0
        lines = design.contour_target(key, blank.grid, feature=feature, line_width=line_width)
        path = Path(*(np.asarray(n, lines.dtype) for n in (wavelength, distance, math.inf)))
        found = design.retrieve_phase(lines, blank.grid, path, shape=blank.shape, key=key)
        any_height = design.one_turn(blank, wavelength)
        mask = design.mask_of_phase(found.phase, blank, wavelength, any_height)
    return mask.height


@dataclass(frozen=True)
class Target:
    """What is seen: its place in the study, on which its noise depends; distance and width in mm.

    `plane` holds the colour channels as a batch: (channel, y, x).
    """

    number: int
    name: str
    kind: str
    distance: float
    width: float
    plane: ImagePlane

    @property
    def is_picture(self) -> bool:
        """Whether it is a photograph or an image file, and not drawn."""
        return self.kind in ("photograph", "file")


@dataclass(frozen=True, eq=False)
class Study:
    """Cameras before targets, and the methods that reconstruct their captures.

    - `config`: the experiment file that it was built from.
    - `sensor`, `mask`: what all cameras share.
    - `noise`: None leaves captures as they are.
    - `reconstructors`: those that were built so far, by method's name and shape of the field.
    """

    config: Any
    sensor: SensorConfig
    mask: MaskConfig
    noise: AbstractNoise | None
    methods: tuple[Method, ...]
    targets: tuple[Target, ...]
    model: Model
    prior: Prior = "inverse_square"
    reconstructors: dict[tuple, Reconstructor] = field(default_factory=dict, init=False)

    @functools.cached_property
    def exposures(self) -> tuple[Exposure, ...]:
        """Of all methods, each once, in the order of first use."""
        return tuple(dict.fromkeys(e for m in self.methods for e in m.exposures))

    @functools.cached_property
    def _same_mask(self) -> masks.AbstractMask:
        """That of all exposures, where it is no zone plate; its file is read once."""
        return built_mask(self.mask, self.exposures[0])

    @property
    def warnings(self) -> list[str]:
        """What a user is told before it runs, and in the report."""
        farthest = max((target.distance for target in self.targets), default=math.inf)
        if self.mask.family == "fza":
            return unresolved_zones(self.exposures, self.sensor.pitch, farthest, self.mask.height)
        finest = getattr(self._same_mask, "finest_frequency", 0.0)
        nearest = min(exposure.distance for exposure in self.exposures)
        fault = unresolved(float(finest) / (1 + nearest / farthest), self.sensor.pitch)
        return [fault] if fault else []

    @property
    def object_distance(self) -> float:
        """Where the targets stand, mm."""
        return self.config.object.distance

    def camera(self, exposure: Exposure) -> LenslessCamera:
        """The camera of an exposure."""
        sensor = dict(self.sensor)
        for level in ("exposure", "electrons"):
            sensor[level] = sensor[level] and sensor[level] * exposure.share
        is_zone_plate = self.mask.family == "fza"
        mask = built_mask(self.mask, exposure) if is_zone_plate else self._same_mask
        return LenslessCamera(mask, Sensor(**sensor), exposure.distance)

    def mask_of(self, exposure: Exposure) -> str:
        """The mask in a figure's words."""
        if self.mask.family != "fza":
            return self.mask.label
        return f"β {exposure.beta:.4g} rad/mm², φ {exposure.phase:.2f} rad"

    def psf(self, exposure: Exposure) -> Array:
        """Of a point on the axis at the distance of the targets, (y, x)."""
        return psf(
            self.camera(exposure),
            wavelength=exposure.wavelength,
            object_distance=self.object_distance,
            model=self.model,
            pixel_integration=self.config.pixel_integration,
        )
