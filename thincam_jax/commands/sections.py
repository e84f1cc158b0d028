"""Sections of experiment files that several kinds share, with the units of their numbers."""

import math
from collections.abc import Callable, Sequence
from typing import Annotated, Any, ClassVar, Literal, TypeVar

import pydantic
from pydantic import Field

from thincam_jax._core.quantity import FieldError
from thincam_jax._core.text import one_of, slug
from thincam_jax.commands.config_file import ConfigError, Places
from thincam_jax.commands.mask import MaskConfig
from thincam_jax.commands.schema import (
    Angle,
    Curvature,
    Length,
    Position,
    Section,
    Wavelength,
    section,
)
from thincam_jax.imaging.sensor import AbstractNoise, GaussianNoise, PoissonGaussianNoise, Sensor
from thincam_jax.imaging.targets.images import sample_images
from thincam_jax.lensless.exposures import PAIR, QUARTERS, Exposures, Layout
from thincam_jax.lensless.masks.fza import Profile
from thincam_jax.lensless.method import Model
from thincam_jax.reconstruction import TotalVariation
from thincam_jax.reconstruction.fringe_filter import FringeScanning
from thincam_jax.reconstruction.regularised import AdmmTV
from thincam_jax.reconstruction.solver import AbstractSolver
from thincam_jax.reconstruction.wiener import Prior, Wiener
from thincam_jax.studies.study import Method, Published, Synthesis, check_methods

Found = TypeVar("Found")
Name = Annotated[str, Field(min_length=1, max_length=60, pattern=r"^[\w .,()=+\-]+$")]


class SensorConfig(section(Sensor)):
    """`thincam_jax.Sensor`."""


class ObjectConfig(Section):
    """Distance and width of the targets."""

    distance: Length
    width: Length


class MovingObjectConfig(ObjectConfig):
    """Targets that may move.

    - `motion`: motion across (+x) during an exposure of the sensor's own time. A method's captures
      follow each other without a pause, and half way through them the targets are on the axis.
    """

    motion: Position = 0.0


_EITHER = {"snr_db": None, "read_noise": None}


class NoiseConfig(section(GaussianNoise, PoissonGaussianNoise, defaults=_EITHER)):
    """Gaussian noise at an SNR, or shot noise with a read noise in electrons."""

    @pydantic.model_validator(mode="after")
    def _one(self):
        if (self.snr_db is None) == (self.read_noise is None):
            raise ValueError("give either snr_db (Gaussian noise) or read_noise (shot noise too)")
        return self

    def build(self, **others: Any) -> AbstractNoise:
        """The noise that is given."""
        if self.snr_db is None:
            return PoissonGaussianNoise(self.read_noise)
        return GaussianNoise(self.snr_db, self.signal_power)


class ShotConfig(Section):
    """One setting of the camera; the phases of the synthesis are taken at each.

    - `width`, `profile`: width and profile of its masks; default those of the study.
    - `exposure`: exposure of each of its captures, relative to that of the sensor.
    - `take`: 2 for a second exposure of a setting, which has noise of its own; and so on.
    """

    beta: Curvature
    distance: Length
    wavelength: Wavelength | None = None
    width: Length | None = None
    profile: Profile | None = None
    exposure: Annotated[float, Field(gt=0)] = 1.0
    take: Annotated[int, Field(ge=2)] | None = None


class MethodShotConfig(ShotConfig):
    """Setting of the camera in a method; masks other than the zone plate have no β."""

    beta: Curvature | None = None  # pyright: ignore[reportIncompatibleVariableOverride]


class PublishedConfig(Section):
    """Figures that a publication gives for a method, shown beside the study's own."""

    psnr_db: float | None = None
    resolved: Length | None = None
    limit_cycles_per_mm: Annotated[float, Field(gt=0)] | None = None


_VARIATION = {
    "only": ("tau", "iterations", "kind", "coupling", "chroma_weight"),
    "defaults": {"coupling": None, "chroma_weight": 2.0},
}


class VariationConfig(section(AdmmTV, TotalVariation, **_VARIATION)):
    """Total variation of an admm_tv method; see `thincam_jax.reconstruct`."""


class MosaicConfig(section(Layout)):
    """Masks side by side on one sensor, exposed together; see `thincam_jax.Mosaic`."""


MethodKind = Literal["fringe_scanning", "wiener", "admm_tv", "pnp"]
# The mask phases taken at each shot, rad, where the synthesis sets them.
PHASES = {"fringe_scanning": QUARTERS, "phase_pairs": PAIR}


class MethodConfig(Section):
    """A reconstruction and the captures that it takes.

    - `mosaic`: takes all captures in one exposure, each on a part of the sensor.
    - `steps`, `harmonics`: number of phases of a turn that the synthesis harmonics takes at each
      shot, and the m that it keeps.
    """

    name: Name
    kind: MethodKind
    variation: VariationConfig | None = None
    synthesis: Synthesis = "fringe_scanning"
    shots: Annotated[tuple[MethodShotConfig, ...], Field(min_length=1)]
    phases: Annotated[tuple[Angle, ...], Field(min_length=1)] = (0.0,)
    steps: Annotated[int, Field(ge=3, le=64)] = 8
    harmonics: tuple[Annotated[int, Field(ge=1)], ...] = ()
    mosaic: MosaicConfig | None = None
    published: PublishedConfig = PublishedConfig()

    @pydantic.model_validator(mode="after")
    def _fits(self):
        if self.variation is not None and self.kind != "admm_tv":
            raise ValueError(f"kind {self.kind} has no total variation; drop 'variation'")
        if self.synthesis in (*PHASES, "harmonics") and self.phases != (0.0,):
            raise ValueError(f"synthesis {self.synthesis} sets the phases itself; drop 'phases'")
        return self

    def shot_phases(self) -> tuple[float, ...]:
        """The mask phases taken at each shot, rad."""
        if self.synthesis == "harmonics":
            return tuple(2 * math.pi * step / self.steps for step in range(self.steps))
        return PHASES.get(self.synthesis, self.phases)


def check_keys(config: Any, **kinds: str) -> None:
    """Refuse a section without a key that its kind needs, and one with another kind's."""
    for key, kind in kinds.items():
        if (getattr(config, key) is None) == (config.kind == kind):
            verb = "needs" if config.kind == kind else "takes no"
            raise ValueError(f"kind {config.kind} {verb} '{key}'")


class TargetConfig(Section):
    """A scene: a drawn chart or pattern, a photograph of scikit-image, or an image file.

    Charts and patterns are squares of `pixels` × `pixels`. `linear: true` takes an image's codes as
    light; by default files are decoded (`load_image`), and scikit-image's photographs are not.
    """

    name: Name
    kind: Literal["usaf1951", "slanted_edge", "siemens_star", "point_grid", "photograph", "file"]
    image: str | None = None
    path: str | None = None
    linear: bool | None = None
    pixels: Annotated[int, Field(ge=8, le=8192)] = 1700

    @pydantic.model_validator(mode="after")
    def _fits(self):
        check_keys(self, image="photograph", path="file")
        if self.image is not None and self.image not in sample_images():
            able = one_of(self.image, sample_images())
            raise ValueError(f"image {self.image!r} is unknown; {able}")
        return self


class PictureConfig(TargetConfig):
    """A target that fills given cells; by default the codes of a file are their levels.

    - `crop`: takes the middle of a picture, that part of its shorter side; `binary`: black where it
      is below its mean, else white.
    - `width`: width of the picture, and `x`, `y` of its middle, y downwards, in parts of the width
      of the cells, which are black beside it; `rotation`: clockwise.
    """

    crop: Annotated[float, Field(gt=0, le=1)] = 1.0
    binary: bool = False
    width: Annotated[float, Field(gt=0, le=1)] = 1.0
    x: Annotated[float, Field(ge=-1, le=1)] = 0.0
    y: Annotated[float, Field(ge=-1, le=1)] = 0.0
    rotation: Angle = 0.0


class ExperimentConfig(Section):
    """Keys that every kind of experiment file begins with."""

    pictured: ClassVar[str] = "targets"  # the list that has image files, if any
    with_path: ClassVar[tuple[str, ...]] = ()  # further sections that name a file
    name: Name
    title: str = ""
    seed: Annotated[int, Field(ge=0, lt=2**32, strict=True)] = 0
    _places: Places = pydantic.PrivateAttr(default_factory=Places)

    def place_of(self, *location: str | int) -> str:
        """File and line of an entry, or the option that set it, with a colon; else nothing."""
        place = self._places.of(location)
        return f"{place}: " if place else ""

    def read_each(
        self, entries: str, read: Callable[[Any], Found], *key: str
    ) -> tuple[list[Found], list[str]]:
        """Results of a function for each entry of a list, and a line for each that it refuses.

        `key`: the entry's own, which a line blames.
        """
        found, faults = [], []
        for number, entry in enumerate(getattr(self, entries)):
            try:
                found.append(read(entry))
            except (ValueError, OSError) as error:
                faults.append(f"{self.place_of(entries, number, *key)}{entries}[{number}]: {error}")
        return found, faults

    def read_all(self, entries: str, read: Callable[[Any], Found], *key: str) -> list[Found]:
        """Results as of `read_each`; ConfigError, a line for each entry that is refused."""
        found, faults = self.read_each(entries, read, *key)
        if faults:
            raise ConfigError("\n".join(faults))
        return found

    def gives(self, *location: str | int) -> bool:
        """Whether the file or an option has an entry, which is a default otherwise."""
        return self._places.gives(location)


class LenslessConfig(ExperimentConfig):
    """The light of lensless cameras, and how their PSFs are computed."""

    wavelength: Wavelength
    model: Model = "separable"
    pixel_integration: bool = True


class CamerasConfig(section(Wiener, only=("prior",)), LenslessConfig):
    """Cameras and the methods that reconstruct their captures.

    - `field_tolerance`: relative error that the PSFs of points off the axis may have, such as 0.01;
      without it the captures have the PSF and the light of the axis everywhere.
    """

    sensor: SensorConfig
    mask: MaskConfig
    noise: NoiseConfig | None = None
    methods: Annotated[tuple[MethodConfig, ...], Field(min_length=1)]
    field_tolerance: Annotated[float, Field(gt=0, lt=1)] | None = None

    @property
    def motion(self) -> float:
        """Motion of objects during an exposure of the sensor's own time, mm."""
        return 0.0

    @pydantic.model_validator(mode="after")
    def _methods_fit(self):
        check_names(self, "methods", self.pictured)
        _check_family(self)
        sensor, noise = self.sensor.build(), self.noise and self.noise.build()
        methods = []
        for index, method in enumerate(self.methods):
            try:
                methods.append(as_method(self, method))
            except ValueError as error:
                place = getattr(error, "place", ())
                raise FieldError(str(error), "methods", index, *place) from None
            if self.noise is None and method.kind == "wiener":
                message = "wiener weighs noise against signal; give a 'noise' section"
                raise FieldError(message, "methods", index, "kind")
        check_methods(methods, sensor, noise)
        return self


class StudyConfig(CamerasConfig):
    """A whole study: every method on every target."""

    object: MovingObjectConfig
    targets: Annotated[tuple[TargetConfig, ...], Field(min_length=1)]
    notes: tuple[str, ...] = ()

    @property
    def motion(self) -> float:
        return self.object.motion


def check_known(name: str, what: str, names: Sequence[str], *place: Any) -> None:
    """Refuse a name that a list does not have."""
    if name not in names:
        raise FieldError(f"{name!r} is no {what}; {one_of(name, names)}", *place)


def check_names(config: ExperimentConfig, *lists: str) -> None:
    """Refuse two entries of a list whose names give one file name."""
    for what in lists:
        names = [entry.name for entry in getattr(config, what)]
        # Files are named after them, without capitals and signs.
        files = [slug(name) for name in names]
        for index, file in enumerate(files):
            first = files.index(file)
            if first < index:
                message = (
                    f"{names[index]!r} and {names[first]!r} of {what}[{first}] "
                    f"give the same file name {file!r}; choose another name"
                )
                raise FieldError(message, what, index, "name")


def _check_family(config: CamerasConfig) -> None:
    """Refuse methods that need zones where the mask has none, and zones without β."""
    family = config.mask.family
    for index, method in enumerate(config.methods):
        place = "methods", index
        if family != "fza" and (method.kind == "fringe_scanning" or method.synthesis != "separate"):
            message = f"a mask of the family {family} has no phases; give synthesis: separate, with"
            raise FieldError(f"{message} wiener, admm_tv or pnp", *place, "synthesis")
        for number, shot in enumerate(method.shots):
            if family == "fza" and shot.beta is None:
                raise FieldError("missing; this key is needed", *place, "shots", number, "beta")
            for key in ("beta", "width"):
                if family != "fza" and getattr(shot, key) is not None:
                    message = f"is of a zone plate; the mask is of the family {family}: drop it"
                    raise FieldError(message, *place, "shots", number, key)


def as_method(config: CamerasConfig, method: MethodConfig) -> Method:
    """A method of a file, with all of its exposures."""
    published, phases = method.published, method.shot_phases()
    solver = build_solver(method.kind, method.variation, config.prior)
    return Method(
        method.name,
        exposures_of(config, method),
        solver,
        method.synthesis,
        len(phases),
        method.harmonics,
        Published(published.psnr_db, published.resolved, published.limit_cycles_per_mm),
    )


def exposures_of(config: CamerasConfig, method: MethodConfig) -> Exposures:
    """Each shot of a method at each of its phases; one after another where the object moves."""
    shots, phases, motion = method.shots, method.shot_phases(), config.motion
    settings = Exposures(
        [shot.beta or 0.0 for shot in shots],  # 0: of a mask without zones
        [shot.distance for shot in shots],
        wavelength=[shot.wavelength or config.wavelength for shot in shots],
        width=[shot.width or config.mask.width for shot in shots],
        relative_time=[shot.exposure for shot in shots],
        profile=[shot.profile for shot in shots],
        take=[shot.take or 1 for shot in shots],
    )
    exposures = settings.at_phases(phases)
    if method.mosaic is not None:
        try:
            exposures = exposures.at_once(method.mosaic.build())
        except ValueError as error:
            raise FieldError(str(error), "mosaic") from None
    return exposures.of_moving(motion) if motion else exposures


def build_solver(
    kind: str, variation: VariationConfig | None, prior: Prior = "inverse_square"
) -> AbstractSolver:
    """The solver of a method's kind."""
    if kind == "fringe_scanning":
        return FringeScanning()
    if kind == "wiener":
        return Wiener(prior=prior)
    if kind == "pnp":
        # Here: other methods need not wait for the learned parts.
        from thincam_jax.learn.plug_and_play import PlugAndPlay

        return PlugAndPlay()
    asked = variation or VariationConfig()
    total = asked.build(TotalVariation, coupling=asked.coupling or "opponent")
    return asked.build(AdmmTV, variation=total)
