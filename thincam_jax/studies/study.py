"""Studies: cameras before targets, and the methods that reconstruct their captures."""

import functools
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from jaxtyping import Array

from thincam_jax._core.arguments import checked
from thincam_jax._core.precision import decimal_value
from thincam_jax._core.quantity import FieldError
from thincam_jax.imaging import targets as drawn
from thincam_jax.imaging.encoding import encode_srgb
from thincam_jax.imaging.scene import ImagePlane
from thincam_jax.imaging.sensor import AbstractNoise, PoissonGaussianNoise, Sensor
from thincam_jax.lensless.camera import LenslessCamera, psf_change
from thincam_jax.lensless.exposures import Exposure, Exposures
from thincam_jax.lensless.masks.base import AbstractMask
from thincam_jax.lensless.masks.fza import FresnelZoneAperture, edge_frequency
from thincam_jax.lensless.method import Model
from thincam_jax.lensless.psf import psf
from thincam_jax.lensless.resolve import unresolved
from thincam_jax.reconstruction import synthesis as syntheses
from thincam_jax.reconstruction.fringe_filter import FringeScanning
from thincam_jax.reconstruction.solver import AbstractSolver

if TYPE_CHECKING:
    from thincam_jax.studies.result import StudyResult

# Change of the PSF over the field, relative, from which a study mentions it.
_LEAST_CHANGE = 0.05

Synthesis = Literal["fringe_scanning", "phase_pairs", "harmonics", "contrasts", "separate"]
# The mask phases at each shot where the synthesis sets their number.
_PHASES = {"fringe_scanning": 4, "phase_pairs": 2}


def synthesis_matrix(synthesis: Synthesis, shots: int, phases: int) -> np.ndarray:
    """Real weights (channel, exposure) of so many shots with so many phases each."""
    # Those that set the phases themselves treat each shot alike.
    return getattr(syntheses, synthesis)(shots if synthesis in _PHASES else shots * phases)


@checked
@dataclass(frozen=True)
class Published:
    """Figures that a publication gives for a method; None where it gives none."""

    psnr_db: float | None = None
    resolved_object_mm: float | None = None
    limit_cycles_per_mm: float | None = None


@checked
@dataclass(frozen=True, eq=False)
class Method:
    """A reconstruction and the exposures that it takes.

    - `exposures`: in the order of the synthesis, phase by phase and shot by shot.
    - `solver`: `FringeScanning`, `Wiener`, `AdmmTV` or another one. With "opponent" total variation
      grey targets have no coupling, and colours of another number than three a joint one.
    - `synthesis`: the sums of captures that are reconstructed, by the name of the function in
      `thincam_jax.reconstruction.synthesis`.
    - `phases`: exposures of each shot; 4 for fringe scanning, 2 for phase pairs.
    - `harmonics`: harmonics of the synthesis of that name.

    **Errors**: ValueError for exposures, phases or a solver that do not suit the synthesis, and for
    one exposure twice; FieldError where one key is to blame.
    """

    name: str
    exposures: Exposures
    solver: AbstractSolver
    synthesis: Synthesis = "separate"
    phases: int = 1
    harmonics: tuple[int, ...] = ()
    published: Published = Published()

    def __post_init__(self):
        object.__setattr__(self, "phases", _PHASES.get(self.synthesis, self.phases))
        if len(self.exposures) % self.phases:
            raise ValueError(
                f"method {self.name!r} has {len(self.exposures)} exposures; its synthesis "
                f"{self.synthesis} takes {self.phases} at each shot: give a multiple"
            )
        if getattr(self.solver, "synthesis", None) is not None:
            raise ValueError(
                f"the solver of method {self.name!r} has a synthesis of its own; give its name to "
                "the Method, such as synthesis='phase_pairs'"
            )
        if self.synthesis != "separate" and not hasattr(self.solver, "synthesis"):
            if not isinstance(self.solver, FringeScanning):
                raise ValueError(
                    f"{type(self.solver).__name__} of method {self.name!r} takes no sums of "
                    "captures; leave out the synthesis, or use Wiener, AdmmTV or Fista"
                )
        if isinstance(self.solver, FringeScanning) and (
            len(self.shots) != 1 or self.synthesis not in _PHASES
        ):
            raise ValueError(
                f"kind fringe_scanning takes one shot, at the phases of {' or '.join(_PHASES)}"
            )
        layout = self.exposures.layout
        if isinstance(self.solver, FringeScanning) and layout is not None and layout.wall is None:
            raise ValueError(
                "kind fringe_scanning knows the shadow of one mask alone; give the mosaic a wall, "
                "or use kind wiener"
            )
        self._check_harmonics()
        self._check_shots()

    def _check_harmonics(self) -> None:
        if self.synthesis != "harmonics":
            if self.harmonics:
                raise FieldError(f"synthesis {self.synthesis} has none; drop it", "harmonics")
            return
        most, given = (self.phases - 1) // 2, set(self.harmonics)
        if not given or not given <= set(range(1, most + 1)) or len(given) < len(self.harmonics):
            message = f"{self.phases} steps tell 1 to {most} apart; give some of them, each once"
            raise FieldError(message, "harmonics")

    def _check_shots(self) -> None:
        """A capture that is used twice would count its noise as two independent ones."""
        others = "use phase_pairs or fringe_scanning"
        # To the picometre: 5600 um and 5.6 mm differ by rounding.
        widths = [round(shot.width, 9) for shot in self.shots]
        contrasts = self.synthesis == "contrasts"
        if contrasts and len(self.exposures) < 2:
            raise ValueError("synthesis contrasts compares captures; give two phases or shots")
        if contrasts and len({shot.distance for shot in self.shots}) > 1:
            raise ValueError(
                "synthesis contrasts needs shots at one distance, where they share a background; "
                f"{others}"
            )
        if contrasts and len(set(widths)) > 1:
            message = "synthesis contrasts needs masks of one width, which share a background"
            raise FieldError(f"{message}; {others}", "shots")
        shots = [
            (shot.beta, shot.distance, shot.wavelength, width, shot.profile)
            # Between two exposures of one setting there is no contrast.
            + (() if contrasts else (shot.relative_time, shot.take))
            for shot, width in zip(self.shots, widths, strict=True)
        ]
        phases = [exposure.phase for exposure in tuple(self.exposures)[: self.phases]]
        for what, entries in (("shots", shots), ("phases", phases)):
            if len(set(entries)) < len(entries):
                raise FieldError(f"{what} hold an entry twice; give each once", what)

    @property
    def shots(self) -> tuple[Exposure, ...]:
        """The first exposure of each shot."""
        return tuple(self.exposures)[:: self.phases]

    @property
    def distance(self) -> float:
        """The largest mask-sensor distance, on whose scale the method reconstructs, mm."""
        return max(float(exposure.distance) for exposure in self.exposures)

    @property
    def synthesis_matrix(self) -> np.ndarray:
        """Real weights (channel, exposure)."""
        return self.weights(len(self.exposures) // self.phases)

    def weights(self, shots: int) -> np.ndarray:
        """Real weights (channel, exposure) of so many of its shots."""
        if self.synthesis == "harmonics":
            return syntheses.harmonics(shots, self.phases, self.harmonics)
        return synthesis_matrix(self.synthesis, shots, self.phases)


@checked
@dataclass(frozen=True, eq=False)
class Target:
    """A scene at one distance, in mm as its width.

    - `number`: number of its noise, its place in a study.
    - `kind`: "usaf1951", whose resolved element is found, "photograph" or "file", whose PSNR is
      averaged, or another word.
    - `plane`: the colour channels are a batch, (channel, y, x).
    """

    number: int
    name: str
    kind: str
    distance: float
    width: float
    plane: ImagePlane

    @classmethod
    def of_image(
        cls, name: str, image: Any, distance: float, width: float, kind: str = "file"
    ) -> "Target":
        """A target from an image (y, x) or (y, x, channel)."""
        channels = np.moveaxis(np.atleast_3d(np.asarray(image)), -1, 0).astype(np.float32)
        return cls(0, name, kind, distance, width, ImagePlane(channels, distance, width))

    @classmethod
    def usaf1951(cls, distance: float, width: float, pixels: int = 1700) -> "Target":
        """The USAF-1951 chart, drawn on a square of so many pixels."""
        image = drawn.usaf1951((pixels, pixels))
        return cls.of_image("USAF-1951", image, distance, width, "usaf1951")

    @classmethod
    def photograph(cls, name: str, distance: float, width: float) -> "Target":
        """A photograph of scikit-image, such as "astronaut"."""
        return cls.of_image(
            name, drawn.sample_image(name, linear=True), distance, width, "photograph"
        )

    def shown(self, image: np.ndarray) -> np.ndarray:
        """An image of it for a page: that of a decoded file is encoded by sRGB."""
        return encode_srgb(np.clip(image, 0, 1)) if self.kind == "file" else image

    @property
    def is_picture(self) -> bool:
        """Whether it is a photograph or an image file, and not drawn."""
        return self.kind in ("photograph", "file")


def numbered(targets: Iterable[Target]) -> tuple[Target, ...]:
    """The targets, numbered by their place where two have one number."""
    targets = tuple(targets)
    if len({target.number for target in targets}) == len(targets):
        return targets
    return tuple(replace(target, number=place) for place, target in enumerate(targets))


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


def check_noise(sensor: Sensor, noise: AbstractNoise | None) -> None:
    """Refuse noise that counts electrons where it is not known how many there are."""
    if isinstance(noise, PoissonGaussianNoise) and not sensor.counts:
        message = "read_noise counts electrons; give sensor.exposure, such as 0.9, or electrons"
        raise FieldError(message, "noise", "read_noise")


def check_methods(methods: Sequence[Method], sensor: Sensor, noise: AbstractNoise | None) -> None:
    """Refuse methods that do not suit the sensor and the noise.

    **Errors**: FieldError with the place of the fault in a study.
    """
    for index, method in enumerate(methods):
        for number, shot in enumerate(method.shots):
            if shot.relative_time != 1 and not sensor.counts:
                message = (
                    "this is relative to the sensor's; give sensor.exposure or sensor.electrons"
                )
                raise FieldError(message, "methods", index, "shots", number, "exposure")
    check_noise(sensor, noise)


@checked
@dataclass(frozen=True, eq=False)
class Study:
    """Cameras before targets, and the methods that reconstruct their captures.

    - `mask`: properties that the masks of all exposures share, see `Exposures.cameras`.
    - `object_distance`: distance of the point whose PSF and transfer functions are shown, mm.
    - `noise`: None leaves captures as they are.
    - `model`, `pixel_integration`: settings of the PSFs, see `thincam_jax.psf`.
    - `field_tolerance`: tolerance of the captures, see `PsfMethod`. Reconstructions take the PSF of
      the axis, and are divided by the light's fall.
    - `seed`: seed of the noise: each capture of each target has a random key of its own.
    - `mask_name`: name of a mask without zones, in figures.
    - `config`: the sections of the file that it was read from, if any.
    """

    mask: AbstractMask
    sensor: Sensor
    methods: tuple[Method, ...]
    targets: tuple[Target, ...] = ()
    object_distance: float = math.inf
    noise: AbstractNoise | None = None
    model: Model = "separable"
    pixel_integration: bool = True
    field_tolerance: float | None = None
    seed: int = 0
    name: str = "study"
    mask_name: str = ""
    config: Any = field(default=None, repr=False)
    # Filters of methods by the method's name and the shape of the field.
    _reconstructors: dict[tuple, Any] = field(default_factory=dict, init=False, repr=False)

    def __post_init__(self):
        object.__setattr__(self, "targets", numbered(self.targets))
        for what, names in (
            ("methods", [method.name for method in self.methods]),
            ("targets", [target.name for target in self.targets]),
        ):
            if len(set(names)) < len(names):
                raise ValueError(f"two of the {what} {names} have one name; give each its own")
        check_methods(self.methods, self.sensor, self.noise)

    def run(self, targets: Sequence[Target] | None = None) -> "StudyResult":
        """Every method on every target, by default on the study's own."""
        from thincam_jax.studies.result import run

        return run(self, self.targets if targets is None else numbered(targets))

    @functools.cached_property
    def exposures(self) -> tuple[Exposure, ...]:
        """Exposures of all methods, each once, in the order of first use."""
        return tuple(dict.fromkeys(e for m in self.methods for e in m.exposures))

    @functools.cached_property
    def pitch(self) -> float:
        """Pitch of the pixels, mm."""
        return decimal_value(self.sensor.pitch)

    @property
    def warnings(self) -> list[str]:
        """Warnings before it runs, and in the report."""
        return [*self._unresolved(), *self._changes()]

    def _changes(self) -> list[str]:
        """Error of the PSF of the axis at the corner of the widest target."""
        if self.field_tolerance is not None or not self.targets:
            return []
        if self.sensor.angular_response is not None:
            return ["angular_response counts with a field_tolerance only, such as 0.01"]
        slope = max(math.hypot(t.plane.height, t.width) / 2 / t.distance for t in self.targets)
        angle, change = math.atan(slope), 0.0
        for exposure in self.exposures:
            finest = self.camera(exposure).mask.finest_frequency
            if finest is not None:
                path = exposure.wavelength, exposure.distance
                change = max(change, psf_change(*path, float(finest), math.cos(angle)))
        if change < _LEAST_CHANGE:
            return []
        return [
            f"at {math.degrees(angle):.0f}°, the corner of the field, the PSF is some "
            f"{100 * change:.0f} % off that of the axis, which all points of the captures have; "
            "field_tolerance: 0.01 gives each its own"
        ]

    def _unresolved(self) -> list[str]:
        farthest = max((target.distance for target in self.targets), default=math.inf)
        if isinstance(self.mask, FresnelZoneAperture):
            height = None if self.mask.height is None else decimal_value(self.mask.height)
            return unresolved_zones(self.exposures, self.pitch, farthest, height)
        finest = self.mask.finest_frequency or 0.0
        nearest = min(float(exposure.distance) for exposure in self.exposures)
        fault = unresolved(float(finest) / (1 + nearest / farthest), self.pitch)
        return [fault] if fault else []

    def camera(self, exposure: Exposure) -> LenslessCamera:
        """The camera of an exposure."""
        return exposure.camera(self.sensor, self.mask)

    def mask_of(self, exposure: Exposure) -> str:
        """The mask in a figure's words."""
        if not isinstance(self.mask, FresnelZoneAperture):
            return self.mask_name or type(self.mask).__name__
        return f"β {exposure.beta:.4g} rad/mm², φ {exposure.phase:.2f} rad"

    def psf(self, exposure: Exposure) -> Array:
        """PSF of a point on the axis at the distance of the targets, (y, x)."""
        light = {"wavelength": exposure.wavelength, "object_distance": self.object_distance}
        how = {"model": self.model, "pixel_integration": self.pixel_integration}
        return psf(self.camera(exposure), **light, **how)
