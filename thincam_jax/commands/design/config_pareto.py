"""The section `pareto` of a design's file: what is traded against what, and how long to search."""

import math
from collections.abc import Hashable
from typing import Annotated, Any, TypeVar

import numpy as np
import pydantic
from pydantic import AfterValidator, Field

from thincam_jax._core.quantity import FieldError
from thincam_jax.commands.schema import Length, Section, section
from thincam_jax.design import SearchSettings

Entry = TypeVar("Entry", bound=Hashable)
LENGTH = ("starts", "samples", "steps", "solver")  # of a search
Count = Annotated[int, Field(ge=1, le=8, strict=True)]
Electrons = Annotated[float, Field(gt=0)]
Points = Annotated[int, Field(ge=2, le=100)]


def _once(entries: tuple[Entry, ...]) -> tuple[Entry, ...]:
    if len(set(entries)) < len(entries):
        raise ValueError("holds an entry twice; give each once")
    return entries


ONCE = AfterValidator(_once)
_SORTED = AfterValidator(lambda shots: tuple(sorted(shots)))


def _rising(unit: str) -> AfterValidator:
    def check(bounds: tuple[float, float]) -> tuple[float, float]:
        lower, upper = bounds
        if not lower < upper:
            raise ValueError(f"bounds cross: {lower:g} to {upper:g}{unit}; give the lower first")
        return bounds

    return AfterValidator(check)


class ThicknessConfig(Section):
    """Thickness against resolution: no distance is longer than each of `points` thicknesses."""

    bounds: Annotated[tuple[Length, Length], _rising(" mm")]
    points: Points = 8

    def costs(self) -> list[float]:
        """The thicknesses, mm, evenly apart."""
        return np.linspace(*self.bounds, self.points).tolist()


class CapturesConfig(Section):
    """Captures against PSNR: how many settings, each with the phases of the synthesis."""

    shots: Annotated[tuple[Count, ...], Field(min_length=1), ONCE, _SORTED]


class LightConfig(Section):
    """Light against resolution: electrons of a pixel from each mm² of open aperture."""

    bounds: Annotated[tuple[Electrons, Electrons], _rising(" electrons")]
    points: Points = 6

    def costs(self) -> list[float]:
        """The electrons, each by the same factor more than the one before."""
        return np.geomspace(*self.bounds, self.points).tolist()


_SHORT = {"starts": 4, "samples": 128, "steps": 40}


class ParetoConfig(section(SearchSettings, only=LENGTH, defaults=_SHORT)):
    """Fronts of designs; every point of them is a search over all that is free.

    `samples`, `starts`, `steps`, `solver`: settings of each of the searches, see `search`.
    """

    thickness: ThicknessConfig | None = None
    captures: CapturesConfig | None = None
    light: LightConfig | None = None

    @pydantic.model_validator(mode="after")
    def _some(self):
        if self.thickness is None and self.captures is None and self.light is None:
            raise ValueError("no front is requested; give thickness, captures or light")
        return self

    def costs(self, phases: int) -> dict[str, list[float]]:
        """Costs of each front: mm; captures, so many phases a shot; electrons."""
        lines = {"thickness": self.thickness, "light": self.light}
        found = {name: line.costs() for name, line in lines.items() if line is not None}
        if self.captures is not None:
            found["captures"] = [float(count * phases) for count in self.captures.shots]
        return {name: found[name] for name in ("thickness", "captures", "light") if name in found}


def check_pareto(config: Any) -> None:
    """Refuse fronts that the rest of a design's file has no designs for."""
    fronts = config.pareto
    if fronts.thickness is not None:
        _check_thickness(config, fronts.thickness)
    if fronts.captures is not None:
        _check_captures(config, fronts.captures)
    if fronts.light is not None and config.noise.electrons is None:
        message = (
            "light needs noise that counts electrons, and snr_db is the same at any light; give "
            "noise.read_noise and noise.electrons, or drop this front"
        )
        raise FieldError(message, "pareto", "light")


def _check_thickness(config: Any, front: ThicknessConfig) -> None:
    place = ("pareto", "thickness")
    bounds = [free.bounds for free in config.search.free if free.variable == "distance"]
    if not bounds:
        message = "no distance is free; give search.free a distance, or drop this front"
        raise FieldError(message, *place)
    thinnest, thickest = front.bounds
    try:
        config.space(thickness=thinnest)
    except FieldError as error:
        raise FieldError(str(error), *place, "bounds") from None
    limit = config.search.limits.thickness or math.inf
    longest = min(limit, max(upper for _, upper in bounds))
    if thickest > longest * (1 + 1e-9):
        raise FieldError(
            f"bounds reach to {thickest:g} mm, and no free distance beyond {longest:g} mm; end "
            "there, or raise search.free and search.limits.thickness",
            *place,
            "bounds",
        )


def _check_captures(config: Any, front: CapturesConfig) -> None:
    place = ("pareto", "captures")
    phases = len(config.reference.phases)
    allowed = config.search.limits.captures
    most = front.shots[-1]
    if most * phases > allowed:
        raise FieldError(
            f"{most} shots take {most * phases} captures, and search.limits.captures allows "
            f"{allowed}; give at most {allowed // phases} shots",
            *place,
            "shots",
        )
    if config.frees("exposure"):
        message = (
            "the captures of this front share the exposure evenly, and search.free has it; drop one"
        )
        raise FieldError(message, *place)
    if all(min(free.shots or (1,)) > front.shots[0] for free in config.search.free):
        message = f"of the first shots, {front.shots[0]}, nothing is free; give more, or free them"
        raise FieldError(message, *place, "shots")
    if not config.pictures():
        message = "PSNR needs a photograph among the targets; give one, or drop this front"
        raise FieldError(message, *place)
