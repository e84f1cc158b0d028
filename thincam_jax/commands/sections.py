"""Sections of experiment files that several kinds share, with the units of their numbers."""

import math
from collections.abc import Sequence
from typing import Annotated, Any, ClassVar, Literal

import pydantic
from pydantic import AfterValidator, Field

from thincam_jax._core import checks
from thincam_jax._core.quantity import FieldError, quantity
from thincam_jax.commands.config_file import Places, slug
from thincam_jax.commands.schema import Section, section, written
from thincam_jax.imaging.sensor import AbstractNoise, GaussianNoise, PoissonGaussianNoise, Sensor
from thincam_jax.imaging.targets import sample_images
from thincam_jax.lensless import masks
from thincam_jax.lensless.masks.fza import Profile
from thincam_jax.lensless.method import Model
from thincam_jax.reconstruction import AdmmTV, TotalVariation, Wiener

LIGHT = (1e-5, 1.0)  # the wavelengths that are taken for light, mm


def _optical(value: float) -> float:
    if not LIGHT[0] <= value <= LIGHT[1]:
        raise ValueError(f"{value:g} mm is no wavelength of light; give 10 nm to 1 mm")
    return value


Length = Annotated[float, *written(quantity("mm", positive=True))]
Position = Annotated[float, *written(quantity("mm"))]
Wavelength = Annotated[
    float, *written(quantity("mm", check=checks.wavelength)), AfterValidator(_optical)
]
Curvature = Annotated[float, *written(quantity("rad/mm^2", positive=True))]
Angle = Annotated[float, *written(quantity("rad"))]
Time = Annotated[float, *written(quantity("s", positive=True))]
Name = Annotated[str, Field(min_length=1, max_length=60, pattern=r"^[\w .,()=+\-]+$")]


class SensorConfig(section(Sensor)):
    """`thincam_jax.Sensor`."""

    @property
    def counts(self) -> bool:
        """Whether it is known how many electrons a pixel holds."""
        return self.exposure is not None or self.electrons is not None


APERTURE = ("width", "profile", "pixel_pitch", "fill_factor")


class ApertureConfig(section(masks.FresnelZoneAperture, only=APERTURE)):
    """What all Fresnel zone apertures share; `pixel_pitch`, `fill_factor`: of a display."""

    @pydantic.model_validator(mode="after")
    def _display(self):
        if self.pixel_pitch is None and self.fill_factor != 1:
            raise FieldError("is of a display's pixels; give their pixel_pitch, too", "fill_factor")
        return self


_WIDEST = 300.0  # mask of a thin camera, mm
Relief = Literal["diffuser", "voronoi_fresnel", "contours"]
Cells = Literal["mura", "ura", "mls", "random"]
Family = Literal["fza", Cells, "pinhole", "lenslets", "file", Relief]
_DISPLAY = ("pixel_pitch", "fill_factor")  # of any mask that a display shows
# What a mask of each family is made of, and what may be given besides.
_NUMBERS: dict[Family, tuple[tuple[str, ...], tuple[str, ...]]] = {
    "fza": (("width",), ("height", "profile", "harmonics")),
    "mura": (("order", "cell"), ("tiles",)),
    "ura": (("orders", "cell"), ("tiles",)),
    "mls": (("length", "cell"), ("combine",)),
    "random": (("width", "cell"), ("height", "seed")),
    "pinhole": (("width",), ("height",)),
    "lenslets": (("focal_length", "cell", "lenses"), ()),
    "file": (("path", "width"), ()),
    "diffuser": (("width", "cell", "correlation_length", "rms_slope"), ("seed", "index")),
    "voronoi_fresnel": (("width", "cell", "focal_length", "sites"), ("seed", "index")),
    "contours": (("width", "cell", "feature", "line_width"), ("seed", "index")),
}


_ARRAYS = (
    *(masks.ModifiedUniformlyRedundantArray, masks.UniformlyRedundantArray),
    *(masks.LensletArray, masks.SeparableMask),
)
# Left out where the family has none.
_OTHERS = dict.fromkeys(("order", "orders", "focal_length", "cell")) | {"combine": "xor"}


class MaskConfig(
    section(*_ARRAYS, only=tuple(_OTHERS), defaults=_OTHERS),
    section(masks.FresnelZoneAperture, only=("height", "harmonics")),
    ApertureConfig,  # the keys of the last come first
):
    """The mask of a study: a Fresnel zone aperture, or of another `family` with its numbers.

    - `height`, `harmonics`: of a rectangle, and which orders of a zone plate are computed.
    - `cell`: side of a cell or of a lens. Arrays have the `width` of their cells.
    - `order`: p of a "mura"; `orders`: (r, s) of a "ura"; `length`: 2^m − 1 of an "mls", whose code
      and itself `combine`; `tiles`: how often an array is repeated along each axis.
    - `seed`: of what is random; `focal_length`, `lenses` (down, across): of "lenslets".
    - `path`: of a grey image, a "file", whose pixels make up the `width`.
    - `correlation_length`, `rms_slope`: of a "diffuser"; `sites`: lenses of "voronoi_fresnel", made
      for the wavelength; `feature`, `line_width`: of the "contours" that are the PSF far away, at
      the wavelength and distance of the first shot. `index`: of refraction, of all three, whose
      PSFs are by "angular_spectrum".
    """

    width: Length = 0.0
    family: Family = "fza"
    length: int | None = None
    tiles: Annotated[int, Field(ge=1)] | None = None
    seed: Annotated[int, Field(ge=0, lt=2**32)] | None = None
    lenses: tuple[Annotated[int, Field(ge=1)], Annotated[int, Field(ge=1)]] | None = None
    path: str | None = None
    correlation_length: Length | None = None
    rms_slope: Annotated[float, Field(gt=0, le=1)] | None = None
    sites: Annotated[int, Field(ge=1)] | None = None
    feature: Length | None = None
    line_width: Length | None = None
    index: Annotated[float, Field(gt=1, le=4)] = 1.52

    @pydantic.model_validator(mode="after")
    def _family_fits(self):
        needed, also = _NUMBERS[self.family]
        for key in needed:
            if key not in self.model_fields_set:
                raise FieldError("missing; this key is needed", key)
        known = {*needed, *also, *_DISPLAY, "family", "width"}
        for key in sorted(self.model_fields_set - known):
            if getattr(self, key) != type(self).model_fields[key].default:
                raise FieldError(
                    f"is no number of a mask of the family {self.family}; drop it", key
                )
        across = self._cells_across()
        if across is not None and self.cell is not None:
            width = across * (self.tiles or 1) * self.cell
            # A resolved file has the width too.
            if "width" in self.model_fields_set and abs(self.width - width) > 1e-9:
                raise FieldError(f"the cells make {width:g} mm; drop it", "width")
            object.__setattr__(self, "width", width)
        if self.width > _WIDEST:
            key = "width" if across is None else "cell"
            message = f"makes a mask of {self.width:g} mm, which is none; give at most {_WIDEST:g}"
            raise FieldError(message, key)
        return self

    def _cells_across(self) -> int | None:
        """Of one array, where they are known by its numbers."""
        if self.orders is not None or self.lenses is not None:
            return (self.orders or self.lenses or (0, 0))[1]
        return self.order or self.length

    @property
    def label(self) -> str:
        """In a line of a report: size and kind."""
        if self.family == "fza":
            height = f"×{self.height:g}" if self.height else ""
            return f"{self.width:g}{height} mm ({self.profile})"
        order = self.order or self.length or self.orders or self.lenses
        numbers = [] if order is None else [str(order)]
        cells = [] if self.cell is None else [f"cells of {1e3 * self.cell:g} µm"]
        return ", ".join([" ".join([self.family, *numbers]), *cells, f"{self.width:g} mm wide"])


class ObjectConfig(Section):
    """Where the targets stand and how wide they are."""

    distance: Length
    width: Length


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

    - `width`, `profile`: of its masks; default those of the study.
    - `exposure`: of each of its captures, relative to that of the sensor.
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
    """The same of a method; masks of other families than the zone plate have no β."""

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


MethodKind = Literal["fringe_scanning", "wiener", "admm_tv"]
Synthesis = Literal["fringe_scanning", "phase_pairs", "harmonics", "contrasts", "separate"]
# The mask phases taken at each shot, rad, where the synthesis sets them.
PHASES = {
    "fringe_scanning": (0.0, math.pi / 2, math.pi, 3 * math.pi / 2),
    "phase_pairs": (0.0, 3 * math.pi / 2),
}


class MethodConfig(Section):
    """A reconstruction and the captures that it takes.

    - `steps`, `harmonics`: of the synthesis harmonics, how many phases of a turn it takes at each
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
    published: PublishedConfig = PublishedConfig()

    @pydantic.model_validator(mode="after")
    def _fits(self):
        if self.kind == "fringe_scanning" and (
            len(self.shots) != 1 or self.synthesis not in PHASES
        ):
            raise ValueError(
                f"kind fringe_scanning takes one shot, at the phases of {' or '.join(PHASES)}"
            )
        if self.variation is not None and self.kind != "admm_tv":
            raise ValueError(f"kind {self.kind} has no total variation; drop 'variation'")
        if self.synthesis in (*PHASES, "harmonics") and self.phases != (0.0,):
            raise ValueError(f"synthesis {self.synthesis} sets the phases itself; drop 'phases'")
        self._check_harmonics()
        if self.synthesis == "contrasts":
            self._check_contrasts()
        return self

    def _check_harmonics(self) -> None:
        if self.synthesis != "harmonics":
            if self.harmonics:
                raise FieldError(f"synthesis {self.synthesis} has none; drop it", "harmonics")
            return
        most = (self.steps - 1) // 2
        sound = self.harmonics and max(self.harmonics) <= most
        if not sound or len(set(self.harmonics)) < len(self.harmonics):
            message = f"{self.steps} steps tell 1 to {most} apart; give some of them, each once"
            raise FieldError(message, "harmonics")

    def _check_contrasts(self) -> None:
        if len(self.shots) * len(self.phases) < 2:
            raise ValueError("synthesis contrasts compares captures; give two phases or shots")
        if len({shot.distance for shot in self.shots}) > 1:
            raise ValueError(
                "synthesis contrasts needs shots at one distance, where they share a background; "
                "use phase_pairs or fringe_scanning"
            )

    def shot_phases(self) -> tuple[float, ...]:
        """The mask phases taken at each shot, rad."""
        if self.synthesis == "harmonics":
            return tuple(2 * math.pi * step / self.steps for step in range(self.steps))
        return PHASES.get(self.synthesis, self.phases)


class TargetConfig(Section):
    """A scene: a drawn chart or pattern, a photograph of scikit-image, or an image file.

    Charts and patterns are squares of `pixels` × `pixels`.
    """

    name: Name
    kind: Literal["usaf1951", "slanted_edge", "siemens_star", "point_grid", "photograph", "file"]
    image: str | None = None
    path: str | None = None
    pixels: Annotated[int, Field(ge=8, le=8192)] = 1700

    @pydantic.model_validator(mode="after")
    def _fits(self):
        needed = {"photograph": "image", "file": "path"}.get(self.kind)
        for key in ("image", "path"):
            if (getattr(self, key) is None) == (key == needed):
                verb = "needs" if key == needed else "takes no"
                raise ValueError(f"kind {self.kind} {verb} '{key}'")
        if self.image is not None and self.image not in sample_images():
            listed = ", ".join(sample_images())
            raise ValueError(f"image {self.image!r} is unknown; choose one of {listed}")
        return self


class ExperimentConfig(Section):
    """What every kind of experiment file begins with."""

    pictured: ClassVar[str] = "targets"  # the list that has image files
    name: Name
    title: str = ""
    seed: Annotated[int, Field(ge=0, lt=2**32, strict=True)] = 0
    _places: Places = pydantic.PrivateAttr(default_factory=Places)

    def place_of(self, *location: str | int) -> str:
        """File and line of an entry, or the option that set it, with a colon; else nothing."""
        place = self._places.of(location)
        return f"{place}: " if place else ""

    def gives(self, *location: str | int) -> bool:
        """Whether the file or an option has an entry, which is a default otherwise."""
        return self._places.gives(location)


class LenslessConfig(ExperimentConfig):
    """The light of lensless cameras, and how their PSFs are computed."""

    wavelength: Wavelength
    model: Model = "separable"
    pixel_integration: bool = True


class CamerasConfig(section(Wiener, only=("prior",)), LenslessConfig):
    """Cameras and the methods that reconstruct their captures."""

    sensor: SensorConfig
    mask: MaskConfig
    noise: NoiseConfig | None = None
    methods: Annotated[tuple[MethodConfig, ...], Field(min_length=1)]

    @property
    def motion(self) -> float:
        """How far objects move during an exposure of the sensor's own time, mm."""
        return 0.0

    @pydantic.model_validator(mode="after")
    def _methods_fit(self):
        check_names(self, "methods")
        check_methods(self)
        return self


def check_known(name: str, what: str, names: Sequence[str], *place: Any) -> None:
    """Refuse a name that is none of those of a list."""
    if name not in names:
        raise FieldError(f"{name!r} is no {what}; choose one of {', '.join(names)}", *place)


def check_noise(config: Any) -> None:
    """Refuse noise that counts electrons, where it is not known how many there are."""
    if config.noise and config.noise.read_noise is not None and not config.sensor.counts:
        message = "read_noise counts electrons; give sensor.exposure, such as 0.9, or electrons"
        raise FieldError(message, "noise", "read_noise")


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
            raise FieldError(f"{message} wiener or admm_tv", *place, "synthesis")
        for number, shot in enumerate(method.shots):
            if family == "fza" and shot.beta is None:
                raise FieldError("missing; this key is needed", *place, "shots", number, "beta")
            for key in ("beta", "width"):
                if family != "fza" and getattr(shot, key) is not None:
                    message = f"is of a zone plate; the mask is of the family {family}: drop it"
                    raise FieldError(message, *place, "shots", number, key)


def check_methods(config: CamerasConfig) -> None:
    """Refuse methods whose captures or noise do not fit."""
    _check_family(config)
    # A capture that is used twice would count its noise as two independent ones.
    for index, method in enumerate(config.methods):
        # To the picometre: 5600 um and 5.6 mm differ by rounding.
        widths = [round(s.width or config.mask.width, 9) for s in method.shots]
        shots = [
            (s.beta, s.distance, s.wavelength or config.wavelength, width, s.profile)
            # Between two exposures of one setting there is no contrast.
            + (() if method.synthesis == "contrasts" else (s.exposure, s.take))
            for s, width in zip(method.shots, widths, strict=True)
        ]
        if method.synthesis == "contrasts" and len(set(widths)) > 1:
            message = (
                "synthesis contrasts needs masks of one width, which share a background; use "
                "phase_pairs or fringe_scanning"
            )
            raise FieldError(message, "methods", index, "shots")
        for what, entries in (("shots", shots), ("phases", method.phases)):
            if len(set(entries)) < len(entries):
                message = f"{what} hold an entry twice; give each once"
                raise FieldError(message, "methods", index, what)
    for index, method in enumerate(config.methods):
        if config.noise is None and method.kind == "wiener":
            message = "wiener weighs noise against signal; give a 'noise' section"
            raise FieldError(message, "methods", index, "kind")
        for number, shot in enumerate(method.shots):
            if shot.exposure != 1 and not config.sensor.counts:
                message = (
                    "this is relative to the sensor's; give sensor.exposure or sensor.electrons"
                )
                raise FieldError(message, "methods", index, "shots", number, "exposure")
    check_noise(config)
