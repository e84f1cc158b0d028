"""Experiment files of `kind: design`: what is free, what is wanted, and the design to beat."""

import math
from dataclasses import fields
from typing import Annotated, Any, Literal, get_args

import pydantic
from pydantic import Field

from thincam_jax._core.quantity import FieldError
from thincam_jax._core.text import slug
from thincam_jax.commands.design.config_pareto import LENGTH, ONCE, ParetoConfig, check_pareto
from thincam_jax.commands.mask import ApertureConfig
from thincam_jax.commands.schema import LIGHT, Section, form_of, section
from thincam_jax.commands.sections import (
    PHASES,
    LenslessConfig,
    Name,
    NoiseConfig,
    ObjectConfig,
    ShotConfig,
    TargetConfig,
    check_known,
    check_names,
)
from thincam_jax.design import (
    DesignSpace,
    FrequencyCounts,
    PhotonNoise,
    SearchSettings,
    SignalNoise,
    Variable,
    shots,
)
from thincam_jax.design.design import Design
from thincam_jax.design.objectives import Tolerances
from thincam_jax.design.ranking import found_name
from thincam_jax.design.space import QUANTITIES, Limits
from thincam_jax.design.training_search import TrainingError, TrainingSettings
from thincam_jax.imaging.sensor import Sensor
from thincam_jax.imaging.targets.images import sample_images
from thincam_jax.units import parse_quantity

ObjectiveName = Literal["bayes_error", "robust_error", "worst_ratio", "limit", "unevenness"]
Part = Annotated[float, Field(ge=0, le=1)]
Free = Literal["beta", "distance", "wavelength", "width", "exposure"]
# A band has to hold some of the 64 rings that the objectives average over.
_NARROWEST_BAND = 1 / 16


class PixelsConfig(section(Sensor, only=("shape", "pitch"))):
    """The sensor; of its two sides the search takes the shorter one."""


_EITHER = {"snr_db": None, "read_noise": None, "electrons": None}


class DesignNoiseConfig(section(SignalNoise, PhotonNoise, defaults=_EITHER)):
    """Gaussian noise at an SNR of the captures' variance, or shot and read noise.

    `electrons` are those of a pixel from each mm² of open aperture, before a white scene.
    """

    @pydantic.model_validator(mode="after")
    def _one(self):
        if (self.snr_db is None) == (self.read_noise is None):
            raise ValueError("give either snr_db (Gaussian noise) or read_noise (shot noise too)")
        if (self.read_noise is None) != (self.electrons is None):
            raise ValueError("read_noise and electrons belong together; give both, or snr_db")
        return self

    def simulated(self) -> NoiseConfig:
        """This noise in a study."""
        if self.read_noise is not None:
            return NoiseConfig(read_noise=self.read_noise)
        return NoiseConfig(snr_db=self.snr_db, signal_power="without_mean")


class PriorConfig(Section):
    """The scene's spectrum: a power law, its exponent given or measured on the photographs.

    `contrast`: standard deviation of the scene over its mean; shot noise depends on it.
    """

    exponent: Annotated[float, Field(ge=0, le=6)] | None = None
    measured: bool = False
    contrast: Annotated[float, Field(gt=0, le=10)] = 0.5

    @pydantic.model_validator(mode="after")
    def _one(self):
        if (self.exponent is None) != self.measured:
            raise ValueError("give either exponent, such as 2.8, or measured: true")
        return self


class ReferenceConfig(Section):
    """The design to beat; found designs take as many shots, with the same synthesis."""

    name: Name = "reference"
    synthesis: Literal["phase_pairs", "fringe_scanning"]
    shots: Annotated[tuple[ShotConfig, ...], Field(min_length=1)]

    @property
    def phases(self) -> tuple[float, ...]:
        """Taken at each shot, rad."""
        return PHASES[self.synthesis]


class RivalConfig(Section):
    """Another design that is simulated beside the reference, at the same budget."""

    name: Name
    shots: Annotated[tuple[ShotConfig, ...], Field(min_length=1)]


class FreeConfig(Section):
    """One variable that is free, at every shot for itself, or as one number that they share.

    - `bounds`: those of the exposure are parts of what each of the reference's captures has.
    - `shots`: at which of them, counted from 1; default all. All masks share the width.
    """

    variable: Free
    bounds: tuple[float, float]
    shared: bool = False
    shots: Annotated[tuple[Annotated[int, Field(ge=1)], ...], Field(min_length=1), ONCE] | None = (
        None
    )

    @pydantic.field_validator("bounds", mode="before")
    @classmethod
    def _read(cls, given: Any, info: Any) -> Any:
        if "variable" not in info.data:  # reported by itself; of which kind these are is not known
            return (1.0, 1.0)
        if not isinstance(given, list | tuple) or len(given) != 2:
            raise ValueError(f"{given!r} is no pair; give [lowest, highest]")
        variable = info.data["variable"]
        unit = QUANTITIES[variable].unit
        lower, upper = (_number(variable, text) for text in given)
        if not (math.isfinite(lower) and math.isfinite(upper) and lower > 0):
            raise ValueError(f"{lower:g} to {upper:g} {unit}; give bounds above zero")
        if not lower < upper:
            raise ValueError(f"bounds cross: {lower:g} to {upper:g} {unit}; give the lower first")
        if variable == "wavelength" and not LIGHT[0] <= lower < upper <= LIGHT[1]:
            raise ValueError(f"{lower:g} to {upper:g} mm; give bounds from 10 nm to 0.1 mm")
        return (lower, upper)

    @classmethod
    def __get_pydantic_json_schema__(cls, core_schema: Any, handler: Any) -> dict[str, Any]:
        form = super().__get_pydantic_json_schema__(core_schema, handler)
        form["properties"]["bounds"] |= {"prefixItems": [{}, {}]}
        form["allOf"] = [
            {
                "if": {"properties": {"variable": {"const": variable}}},
                "then": {"properties": {"bounds": {"items": form_of(QUANTITIES[variable].kind)}}},
            }
            for variable in get_args(Free)
        ]
        return form

    @pydantic.field_serializer("bounds")
    def _write(self, bounds: tuple[float, float]) -> list[str | float]:
        if not QUANTITIES[self.variable].kind:
            return list(bounds)
        return [f"{value!r} {QUANTITIES[self.variable].unit}" for value in bounds]

    @pydantic.model_validator(mode="after")
    def _belongs(self):
        if self.variable == "width" and (self.shared or self.shots is not None):
            raise ValueError("all masks share the width; drop 'shared' and 'shots'")
        return self


def _number(variable: str, given: Any) -> float:
    """Value in the package's unit."""
    if QUANTITIES[variable].kind:  # a share of the exposure stands alone
        return parse_quantity(given, QUANTITIES[variable].kind)
    if isinstance(given, bool) or not isinstance(given, int | float):
        raise ValueError(f"{given!r} is no number; give parts of the reference's, such as 0.5")
    return float(given)


# How all captures divide their exposure follows from what is free.
LimitsConfig = section(Limits, without=("exposure",))
_EXACT = dict.fromkeys(field.name for field in fields(Tolerances))


class TolerancesConfig(section(Tolerances, defaults=_EXACT)):
    """Errors of what the reconstruction assumes, for `robust_error`; see `design.Tolerances`.

    `beta`: deviation as a part of β; `how`: the mean over the tolerances, or the worst of them.
    """

    how: Literal["mean", "worst"] = "mean"

    @pydantic.model_validator(mode="after")
    def _some(self):
        if not any(getattr(self, name) for name in self.parameters):
            raise ValueError("no tolerance is given; give at least one, such as distance: 20 um")
        return self


class SearchConfig(section(SearchSettings, only=LENGTH)):
    """Free numbers and their limits, the objective, and the length of the search.

    `band`: band of `worst_ratio` and `unevenness`, as parts of half of the pixels' Nyquist
    frequency. `grid`: points along each side of the landscape.
    """

    free: Annotated[tuple[FreeConfig, ...], Field(min_length=1)]
    limits: LimitsConfig = LimitsConfig()  # pyright: ignore[reportInvalidTypeForm]
    objective: ObjectiveName = "bayes_error"
    band: tuple[Part, Part] | None = None
    tolerances: TolerancesConfig | None = None
    grid: Annotated[int, Field(ge=5, le=501)] = 61
    frequencies: section(FrequencyCounts) = section(FrequencyCounts)()  # pyright: ignore

    @pydantic.model_validator(mode="after")
    def _belongs(self):
        if (self.objective == "robust_error") != (self.tolerances is not None):
            raise ValueError("objective robust_error and tolerances belong together; give both")
        if self.objective not in ("worst_ratio", "unevenness"):
            if self.band is not None:
                raise ValueError(f"objective {self.objective} has no band; drop 'band'")
        elif self.band is not None and not self.band[1] - self.band[0] >= _NARROWEST_BAND:
            raise ValueError(
                f"band {self.band[0]:g} to {self.band[1]:g} is too narrow; give the lower first "
                f"and one at least {_NARROWEST_BAND:g} wide"
            )
        return self


class ValidateConfig(Section):
    """The full simulation: seeds of the noise, designs found, and `photographs` beside targets."""

    seeds: Annotated[int, Field(ge=1, le=100)] = 5
    best: Annotated[int, Field(ge=1, le=10)] = 3
    photographs: Annotated[int, Field(ge=0, le=16)] = 12
    reconstruction: Literal["wiener", "admm_tv", "pnp"] = "wiener"


class DesignTrainingConfig(section(TrainingError, TrainingSettings, without=("grid",))):
    """Designs improved by the error of an actual reconstruction.

    - `images`: photographs of scikit-image; their middle square is taken.
    - `reconstruction`: `wiener`, the Wiener synthesis as in the simulation; `linear`, the best
      linear estimate, which knows of the crop; `pnp`, plug and play with the shipped denoiser.
    - `pixels`: number of pixels of the sensor's shorter side in training; by default as many as the
      finest fringes need, and no more than the sensor has.
    - `samples`: even ones over the bounds; descents begin at the best `starts` of these, of the
      search's designs and the reference; `steps` of each.
    """

    images: Annotated[tuple[str, ...], Field(min_length=1), ONCE]
    pixels: Annotated[int, Field(ge=32, le=4096)] | None = None

    @pydantic.model_validator(mode="after")
    def _known(self):
        for image in self.images:
            check_known(image, "image", sample_images(), "images")
        return self


class DesignConfig(LenslessConfig):
    """A search for the best design, and its simulation beside the design to beat."""

    kind: Literal["design"]
    sensor: PixelsConfig
    mask: ApertureConfig
    object: ObjectConfig
    noise: DesignNoiseConfig
    prior: PriorConfig = PriorConfig(measured=True)
    reference: ReferenceConfig
    compare: tuple[RivalConfig, ...] = ()
    search: SearchConfig
    train: DesignTrainingConfig | None = None
    pareto: ParetoConfig | None = None
    targets: Annotated[tuple[TargetConfig, ...], Field(min_length=1)]
    # Not `validate`, which pydantic has for itself.
    validation: ValidateConfig = Field(default=ValidateConfig(), alias="validate")
    notes: tuple[str, ...] = ()

    @pydantic.model_validator(mode="after")
    def _fits(self):
        check_names(self, "targets")
        _check_given(self)
        _check_search(self)
        if self.prior.measured and not self.pictures():
            message = "measured needs a photograph among the targets; give prior.exponent instead"
            raise FieldError(message, "prior", "measured")
        try:
            self.space()
        except FieldError as error:
            raise FieldError(str(error), *_PLACES[error.field]) from None
        if self.pareto is not None:
            check_pareto(self)
        return self

    def pictures(self) -> tuple[TargetConfig, ...]:
        """The targets that are photographs or image files."""
        return tuple(t for t in self.targets if t.kind in ("photograph", "file"))

    def design(self, given: ReferenceConfig | RivalConfig) -> Design:
        """One of the designs that the file gives."""
        return shots(
            [s.beta for s in given.shots],
            [s.distance for s in given.shots],
            self.reference.phases,
            wavelength=self.wavelength,
            width=self.mask.width,
            profile=self.mask.profile,
        )

    def space(self, **limits: float) -> DesignSpace:
        """Space that is searched; `limits` in place of the file's.

        **Errors**: FieldError where no design keeps the limits.
        """
        base = self.design(self.reference)
        # The reference's captures have a share of 1 each; what is found shares the same.
        total = float(base.captures) if self.frees("exposure") else None
        kept = self.search.limits.build(exposure=total, **limits)
        return DesignSpace(base, tuple(_variables(self)), kept)

    def frees(self, variable: Free) -> bool:
        """Whether the search chooses it, of some shot."""
        return any(free.variable == variable for free in self.search.free)


# Where the file has what a design and its space are made of.
_PLACES = {
    "exposures": ("reference", "shots"),
    "variables": ("search", "free"),
    "limits": ("search", "limits"),
}


def _variables(config: DesignConfig):
    """The free numbers, each with the captures it belongs to."""
    phases = len(config.reference.phases)
    for free in config.search.free:
        lower, upper = free.bounds
        if free.variable == "width":
            yield Variable("width", lower, upper)
            continue
        chosen = free.shots or tuple(range(1, len(config.reference.shots) + 1))
        groups = [tuple((s - 1) * phases + p for p in range(phases)) for s in chosen]
        if free.shared:
            groups = [tuple(c for group in groups for c in group)]
        for group in groups:
            yield Variable(free.variable, lower, upper, group)


def _check_given(config: DesignConfig) -> None:
    """The designs that the file itself gives."""
    taken = {slug(found_name(rank)) for rank in range(1, config.validation.best + 1)}
    _check_shots(config, config.reference, taken, ("reference",))
    for index, rival in enumerate(config.compare):
        place = ("compare", index)
        taken.add(slug(config.reference.name))
        _check_shots(config, rival, taken, place)
        taken.add(slug(rival.name))
        count = len(config.reference.shots)
        if len(rival.shots) != count:
            message = f"{len(rival.shots)} shots, and the reference has {count}; give as many"
            raise FieldError(message, *place, "shots")


def _check_shots(
    config: DesignConfig, given: ReferenceConfig | RivalConfig, taken: set[str], place
) -> None:
    shots = [(s.beta, s.distance) for s in given.shots]
    if len(set(shots)) < len(shots):
        raise FieldError("shots hold an entry twice; give each once", *place, "shots")
    for index, shot in enumerate(given.shots):
        shared = {
            "wavelength": config.wavelength,
            "width": config.mask.width,
            "exposure": 1.0,
            "take": None,
        }
        for key, own in shared.items():
            if getattr(shot, key) not in (None, own):
                message = f"the {key} is that of the whole file; drop this one"
                raise FieldError(message, *place, "shots", index, key)
    if slug(given.name) in taken:
        message = f"{given.name!r} is what another or a found design is called; choose another name"
        raise FieldError(message, *place, "name")


def _check_search(config: DesignConfig) -> None:
    """Check the search against the rest of the file."""
    pixel, finest = config.mask.pixel_pitch, config.search.limits.mask_pixel
    if pixel is not None and finest is not None and finest < pixel * (1 - 1e-6):
        message = (
            f"{finest:g} mm is finer than the display's pixels of {pixel:g} mm (mask.pixel_pitch); "
            "give at least these"
        )
        raise FieldError(message, "search", "limits", "mask_pixel")
    if config.frees("exposure") and config.noise.electrons is None:
        message = (
            "how the exposure is divided matters to noise that counts electrons; give "
            "noise.read_noise and noise.electrons, or do not free it"
        )
        raise FieldError(message, "search", "free")
