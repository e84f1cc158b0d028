"""Typed experiment files: YAML with units, checked before anything runs."""

import math
import re
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar, get_args

import pydantic
import yaml
from pydantic import AfterValidator, BeforeValidator, ConfigDict, Field, PlainSerializer
from pydantic_core import PydanticCustomError

from thincam_jax.commands.config_file import ConfigError as ConfigError
from thincam_jax.commands.config_file import override, read_raw
from thincam_jax.imaging.targets import sample_images
from thincam_jax.lensless.method import Model
from thincam_jax.reconstruction.spectra import Prior
from thincam_jax.units import parse_quantity


def slug(name: str) -> str:
    """A name as a file name."""
    return re.sub(r"[^a-z0-9.]+", "-", name.lower()).strip("-.") or "unnamed"


def misfit(message: str, *place: str | int) -> PydanticCustomError:
    """A fault between entries, reported at one of them."""
    return PydanticCustomError("misfit", "{message}", {"message": message, "place": place})


def _positive(value: float) -> float:
    if not value > 0:
        raise ValueError(f"{value:g} is not positive; give a value above zero")
    return value


LIGHT = (1e-5, 1.0)  # the wavelengths that are taken for light, mm


def _optical(value: float) -> float:
    if not LIGHT[0] <= value <= LIGHT[1]:
        raise ValueError(f"{value:g} mm is no wavelength of light; give 10 nm to 1 mm")
    return value


def quantity(kind: str, unit: str):
    # A resolved file is read back, so it is written in the unit of the package, with every digit.
    return (
        BeforeValidator(lambda text: parse_quantity(text, kind)),
        PlainSerializer(lambda value: f"{value!r} {unit}"),
    )


Length = Annotated[float, *quantity("length", "mm"), AfterValidator(_positive)]
Wavelength = Annotated[float, *quantity("length", "mm"), AfterValidator(_optical)]
Curvature = Annotated[float, *quantity("curvature", "rad/mm^2"), AfterValidator(_positive)]
Angle = Annotated[float, *quantity("angle", "rad")]
Name = Annotated[str, Field(min_length=1, max_length=60, pattern=r"^[\w .,()=+\-]+$")]


class Section(pydantic.BaseModel):
    """A part of an experiment file: unknown keys are refused."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class SensorConfig(Section):
    """`thincam_jax.Sensor`."""

    shape: tuple[Annotated[int, Field(ge=1)], Annotated[int, Field(ge=1)]]
    pitch: Length
    full_well: Annotated[float, Field(gt=0)] = 13_500.0
    exposure: Annotated[float, Field(gt=0)] | None = None
    electrons: Annotated[float, Field(gt=0)] | None = None
    bit_depth: Annotated[int, Field(ge=1, le=24)] | None = None

    @pydantic.model_validator(mode="after")
    def _one(self):
        if self.exposure is not None and self.electrons is not None:
            message = "both this and exposure say how long the sensor is exposed; give one"
            raise misfit(message, "electrons")
        if self.bit_depth is not None and not self.counts:
            message = "needs an exposure, such as 0.9; give it, or electrons"
            raise misfit(message, "bit_depth")
        return self

    @property
    def counts(self) -> bool:
        """Whether it is known how many electrons a pixel holds."""
        return self.exposure is not None or self.electrons is not None


class ApertureConfig(Section):
    """What all Fresnel zone apertures share.

    - `pixel_pitch`, `fill_factor`: of a display that shows them.
    """

    width: Length
    profile: Literal["cosine", "binary"] = "cosine"
    pixel_pitch: Length | None = None
    fill_factor: Annotated[float, Field(gt=0, le=1)] = 1.0

    @pydantic.model_validator(mode="after")
    def _display(self):
        if self.pixel_pitch is None and self.fill_factor != 1:
            raise misfit("is of a display's pixels; give their pixel_pitch, too", "fill_factor")
        return self


class MaskConfig(ApertureConfig):
    """The same of a study, with the orders of binary masks that are computed."""

    harmonics: Annotated[int, Field(ge=1, le=99)] = 9


class ObjectConfig(Section):
    """Where the targets stand and how wide they are."""

    distance: Length
    width: Length


class NoiseConfig(Section):
    """Gaussian noise at an SNR, or shot noise with a read noise in electrons."""

    snr_db: Annotated[float, Field(ge=-60, le=200)] | None = None
    signal_power: Literal["total", "without_mean"] = "total"
    read_noise: Annotated[float, Field(ge=0)] | None = None

    @pydantic.model_validator(mode="after")
    def _one(self):
        if (self.snr_db is None) == (self.read_noise is None):
            raise ValueError("give either snr_db (Gaussian noise) or read_noise (shot noise too)")
        return self


class ShotConfig(Section):
    """One setting of the camera; the phases of the synthesis are taken at each.

    - `width`: of its masks; default that of the study.
    - `exposure`: of each of its captures, relative to that of the sensor.
    """

    beta: Curvature
    distance: Length
    wavelength: Wavelength | None = None
    width: Length | None = None
    exposure: Annotated[float, Field(gt=0)] = 1.0


class PublishedConfig(Section):
    """Figures that a publication gives for a method, shown beside the study's own."""

    psnr_db: float | None = None
    resolved: Length | None = None
    limit_cycles_per_mm: Annotated[float, Field(gt=0)] | None = None


class VariationConfig(Section):
    """Total variation of an admm_tv method; see `thincam_jax.reconstruct`."""

    tau: Annotated[float, Field(ge=0)] = 2.0
    iterations: Annotated[int, Field(ge=1, le=100_000)] = 100
    kind: Literal["isotropic", "anisotropic"] = "isotropic"
    coupling: Literal["none", "joint", "opponent"] | None = None
    chroma_weight: Annotated[float, Field(ge=0)] = 2.0

    def coupling_of(self, channels: int) -> Literal["none", "joint", "opponent"]:
        """As given; else what suits the number of colour channels."""
        if channels == 1:
            return "none"
        return self.coupling or ("opponent" if channels == 3 else "joint")


class MethodConfig(Section):
    """A reconstruction and the captures that it takes."""

    name: Name
    kind: Literal["fringe_scanning", "wiener", "admm_tv"]
    variation: VariationConfig | None = None
    synthesis: Literal["fringe_scanning", "phase_pairs", "contrasts", "separate"] = (
        "fringe_scanning"
    )
    shots: Annotated[tuple[ShotConfig, ...], Field(min_length=1)]
    phases: Annotated[tuple[Angle, ...], Field(min_length=1)] = (0.0,)
    published: PublishedConfig = PublishedConfig()

    @pydantic.model_validator(mode="after")
    def _fits(self):
        if self.kind == "fringe_scanning" and (
            len(self.shots) != 1 or self.synthesis != "fringe_scanning"
        ):
            raise ValueError("kind fringe_scanning takes one shot and its own synthesis")
        if self.variation is not None and self.kind != "admm_tv":
            raise ValueError(f"kind {self.kind} has no total variation; drop 'variation'")
        if self.synthesis not in ("contrasts", "separate") and self.phases != (0.0,):
            raise ValueError(f"synthesis {self.synthesis} sets the phases itself; drop 'phases'")
        if self.synthesis == "contrasts":
            self._check_contrasts()
        return self

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
        if self.synthesis == "fringe_scanning":
            return (0.0, math.pi / 2, math.pi, 3 * math.pi / 2)
        return (0.0, 3 * math.pi / 2) if self.synthesis == "phase_pairs" else self.phases


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


class StudyConfig(Section):
    """A whole study: one camera family, several methods, several targets."""

    name: Name
    title: str = ""
    seed: Annotated[int, Field(ge=0, lt=2**32, strict=True)] = 0
    wavelength: Wavelength
    model: Model = "separable"
    pixel_integration: bool = True
    prior: Prior = "inverse_square"
    sensor: SensorConfig
    mask: MaskConfig
    object: ObjectConfig
    noise: NoiseConfig | None = None
    methods: Annotated[tuple[MethodConfig, ...], Field(min_length=1)]
    targets: Annotated[tuple[TargetConfig, ...], Field(min_length=1)]
    notes: tuple[str, ...] = ()

    @pydantic.model_validator(mode="after")
    def _fits(self):
        check_names(self, "methods", "targets")
        check_methods(self)
        return self


def check_names(config: Any, *lists: str) -> None:
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
                raise misfit(message, what, index, "name")


def check_methods(config: Any) -> None:
    """Refuse methods whose captures or noise do not fit."""
    # A capture that is used twice would count its noise as two independent ones.
    for index, method in enumerate(config.methods):
        # To the picometre: 5600 um and 5.6 mm differ by rounding.
        widths = [round(s.width or config.mask.width, 9) for s in method.shots]
        # Between two exposures of one setting there is no contrast.
        shares = [1.0 if method.synthesis == "contrasts" else s.exposure for s in method.shots]
        shots = [
            (s.beta, s.distance, s.wavelength or config.wavelength, width, share)
            for s, width, share in zip(method.shots, widths, shares, strict=True)
        ]
        if method.synthesis == "contrasts" and len(set(widths)) > 1:
            message = (
                "synthesis contrasts needs masks of one width, which share a background; use "
                "phase_pairs or fringe_scanning"
            )
            raise misfit(message, "methods", index, "shots")
        for what, entries in (("shots", shots), ("phases", method.phases)):
            if len(set(entries)) < len(entries):
                message = f"{what} hold an entry twice; give each once"
                raise misfit(message, "methods", index, what)
    for index, method in enumerate(config.methods):
        if config.noise is None and method.kind == "wiener":
            message = "wiener weighs noise against signal; give a 'noise' section"
            raise misfit(message, "methods", index, "kind")
        for number, shot in enumerate(method.shots):
            if shot.exposure != 1 and not config.sensor.counts:
                message = (
                    "this is relative to the sensor's; give sensor.exposure or sensor.electrons"
                )
                raise misfit(message, "methods", index, "shots", number, "exposure")
    if config.noise and config.noise.read_noise is not None and not config.sensor.counts:
        message = "read_noise counts electrons; give sensor.exposure, such as 0.9, or electrons"
        raise misfit(message, "noise", "read_noise")


def load_config(path: str | Path, overrides: tuple[str, ...] = ()) -> StudyConfig:
    """Read and check a study; `overrides` are "a.b=value" texts, list entries by number.

    **Errors**: ConfigError with one line for each fault: file and line, field, what was given,
    what is allowed. FileNotFoundError where there is no such file.
    """
    return in_folder(load_as(StudyConfig, path, overrides), path, "targets")


Config = TypeVar("Config", bound=pydantic.BaseModel)


def load_as(model: type[Config], path: str | Path, overrides: tuple[str, ...] = ()) -> Config:
    """Read an experiment file of the given sections, as `load_config` does a study."""
    path = Path(path)
    raw, places = read_raw(path)
    asked = {override(raw, text): f"--set {text}" for text in overrides}
    return check_as(model, raw, places, asked, f"{path}:1")


def check_as(
    model: type[Config], raw: dict, places: dict[tuple, str], asked: dict[tuple, str], top: str
) -> Config:
    """Check raw data; a fault names the setting that asked for it, else the place in the file.

    `places` and `asked` are by location; `top` is the place of what has none.
    """
    try:
        return model.model_validate(raw)
    except pydantic.ValidationError as error:
        faults = [_fault(e, places, asked, top, model) for e in _own(error.errors())]
        raise ConfigError("\n".join(faults)) from None


def in_folder(config: Config, path: str | Path, entries: str) -> Config:
    """The configuration with its image files named from the folder of the experiment file."""
    folder = Path(path).resolve().parent
    named = tuple(
        entry.model_copy(update={"path": str(folder / entry.path)}) if entry.path else entry
        for entry in getattr(config, entries)
    )
    return config.model_copy(update={entries: named})


def dump_config(config: pydantic.BaseModel) -> str:
    """The resolved study as YAML that `load_config` reads back to the same values."""
    data = config.model_dump(mode="json", exclude_none=True, by_alias=True)
    return yaml.safe_dump(data, sort_keys=False, allow_unicode=True, width=100)


def _place(location: tuple, places: dict, asked: dict, top: str) -> str:
    """The override or the file's line that holds a location, or what is nearest to it."""
    parts = [location[:end] for end in range(len(location), 0, -1)]
    for part in parts:  # an override stands in for whatever the file has there
        if part in asked:
            return asked[part]
    if location not in places:
        for path, override in asked.items():
            if location and path[: len(location)] == location:
                return override
    for part in parts:
        for known in ((*part, "(key)"), part):
            if known in places:
                return places[known]
    return top


def _own(errors: list[Any]) -> list[Any]:
    """Without the lists that pydantic calls too short because it dropped a faulty entry."""
    return [
        error
        for error in errors
        if error["type"] != "too_short"
        or not any(e["loc"][:-1][: len(error["loc"])] == error["loc"] for e in errors)
    ]


def _fault(error: Any, places: dict, asked: dict, top: str, model: Any) -> str:
    """One line: place, field, what is wrong and what is allowed."""
    location = (*error["loc"], *error.get("ctx", {}).get("place", ()))
    if error["type"] == "invalid_key":
        location = (*location[:-1], str(location[-1]))
    field = _dotted(location) or "the file"
    place = _place(location, places, asked, top)
    return f"{place}: {field}: {_message(error, location, model)}"


def _message(error: Any, location: tuple, model: Any) -> str:
    """What is wrong and what is allowed, in the words of an experiment file."""
    kind, given, context = error["type"], error.get("input"), error.get("ctx", {})
    if kind == "extra_forbidden":
        return f"unknown key; allowed here: {', '.join(_allowed(location[:-1], model))}"
    if kind == "missing" and isinstance(location[-1], int):
        return "missing; the list needs this entry"
    if kind == "literal_error":
        return f"{given!r} is unknown; choose one of {context['expected']}"
    if kind in ("too_short", "too_long"):
        limit = context.get("min_length", context.get("max_length"))
        word = "at least" if kind == "too_short" else "at most"
        return f"{given!r} has {len(given)} entries; give {word} {limit}"
    if kind in _WORDS:
        return _WORDS[kind].format(given=given)
    message = error["msg"].removeprefix("Value error, ")
    if kind in ("value_error", "misfit"):
        return message
    return f"{given!r}: {message[0].lower()}{message[1:]}"


_WORDS = {
    "missing": "missing; this key is needed",
    "model_type": "{given!r} is not a section; give lines of 'key: value'",
    "tuple_type": "{given!r} is not a list; write it as [a, b] or as lines beginning with '- '",
    "invalid_key": "a key must be a text; put it in quotes",
}


def _dotted(location: tuple) -> str:
    text = ""
    for part in location:
        text += f"[{part}]" if isinstance(part, int) else f".{part}" if text else str(part)
    return text


def _allowed(location: tuple, model: Any) -> list[str]:
    """Keys of the section at a location."""
    section: Any = model
    for part in location:
        if isinstance(part, int):
            continue
        section = _section_of(_keys(section)[part].annotation)
    return list(_keys(section))


def _keys(section: Any) -> dict[str, Any]:
    """The fields of a section by what they are called in a file."""
    return {field.alias or name: field for name, field in section.model_fields.items()}


def _section_of(annotation: Any) -> Any:
    if isinstance(annotation, type) and issubclass(annotation, pydantic.BaseModel):
        return annotation
    for inner in get_args(annotation):
        found = _section_of(inner)
        if found is not None:
            return found
    return None
