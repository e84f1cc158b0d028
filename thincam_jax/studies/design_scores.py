"""Figures of merit of a design study as records, which a file keeps, and as a table."""

import math
from collections.abc import Iterable
from dataclasses import dataclass, fields
from typing import Any

from thincam_jax._core.table import Table
from thincam_jax.design import FreeValue, Shot
from thincam_jax.design.space import REPORTED
from thincam_jax.studies.trials import Comparison, Spread

_ALWAYS = ("beta", "distance")  # are reported of every shot


@dataclass(frozen=True)
class ShotNumbers:
    """Numbers of a shot, in the units of reports."""

    beta_rad_per_mm2: float
    distance_mm: float
    wavelength_nm: float
    width_mm: float
    exposure: float

    @classmethod
    def of(cls, shot: Shot) -> "ShotNumbers":
        """Rounded to seven digits."""
        names = (field.name for field in fields(Shot))
        return cls(*(digits(getattr(shot, name) * REPORTED[name].scale) for name in names))

    def text(self, name: str) -> str:
        """A number, by its name in `Shot`."""
        return f"{_number_of(self, name):{REPORTED[name].form}}"


# By the names of `Shot`.
_FIELDS = {
    own.name: field.name for own, field in zip(fields(Shot), fields(ShotNumbers), strict=True)
}


def _number_of(shot: ShotNumbers, name: str) -> float:
    return getattr(shot, _FIELDS[name])


@dataclass(frozen=True)
class WithShots:
    """Anything that has shots."""

    shots: tuple[ShotNumbers, ...]

    def text(self, name: str, shots: tuple[int, ...] = ()) -> str:
        """A number shared by `shots`, which count from 1; by all shots where none are given."""
        return self.shots[shots[0] - 1 if shots else 0].text(name)

    def cells(self, names: Iterable[str]) -> list[str]:
        """Each number of all shots; one that all share stands once, but for β."""
        row = []
        for name in names:
            texts = [shot.text(name) for shot in self.shots]
            row.append(", ".join(texts if len(set(texts)) > 1 or name == "beta" else texts[:1]))
        return row

    def words(self, names: Iterable[str]) -> list[str]:
        """Each shot: "β 25.00 at 5.00 mm", "β 21.00 at 6.50 mm"."""
        each = []
        for shot in self.shots:
            words = f"β {shot.text('beta')} at {shot.text('distance')} mm"
            for name in names:
                if name not in _ALWAYS:
                    number = REPORTED[name]
                    words += f", {number.name} {shot.text(name)} {number.unit}".rstrip()
            each.append(words)
        return each


def reported_names(designs: Iterable[WithShots]) -> tuple[str, ...]:
    """β and distance, and what else is not the same in all shots of all designs."""
    every = [shot for one in designs for shot in one.shots]
    return tuple(
        name
        for name in _FIELDS
        if name in _ALWAYS or len({_number_of(shot, name) for shot in every}) > 1
    )


@dataclass(frozen=True)
class ObjectiveScores:
    """What a search minimised.

    - `label`: quantity and unit of the reported values. `unit`: of gains.
    - `prior_exponent`: of the scene's spectrum.
    """

    name: str
    better: str
    label: str
    unit: str
    band: tuple[float, float] | None
    highest_cycles_per_rad: float
    prior_exponent: float


@dataclass(frozen=True)
class SearchScores:
    """How a search went.

    - `approximation_off`: how far values as searched are from the exact ones at most, as reported.
    - `broken_limits`: that the design to beat does not keep, in words.
    """

    evaluations: int
    failed_starts: int
    solver: str
    approximation_off: float | None
    broken_limits: tuple[str, ...]


@dataclass(frozen=True)
class TrainingScores:
    """How a training went."""

    reconstruction: str
    images: tuple[str, ...]
    pixels: int
    samples: int
    starts: int
    evaluations: int
    failed_descents: int


@dataclass(frozen=True)
class FreeNumber:
    """A free number of a design found; see `FreeValue`."""

    variable: str
    shots: tuple[int, ...]
    value: float
    tolerance: float | None
    unit: str

    def __str__(self) -> str:
        """With its tolerance."""
        return str(FreeValue(self.variable, (), self.value, self.tolerance))


@dataclass(frozen=True)
class Candidate(WithShots):
    """A design with the values of its objective: as searched, exact, and exact as reported.

    Of one that is only simulated, shots alone.

    - `training_error`: None without training.
    - `predicted_gain` and all below: of a design found; gains over the one to beat.
    """

    name: str
    objective: float | None = None
    objective_exact: float | None = None
    reported: float | None = None
    training_error: float | None = None
    predicted_gain: float | None = None
    training_gain_db: float | None = None
    values: tuple[FreeNumber, ...] = ()
    status: str = ""
    active_limits: tuple[str, ...] = ()


@dataclass(frozen=True)
class Validation:
    """The full simulation, by method and target.

    - `pictures`, `charts`: names of targets.
    - `one_object_grid`: whether all designs reconstruct on the same pixels of the object.
    """

    seeds: int
    pictures: tuple[str, ...]
    charts: tuple[str, ...]
    one_object_grid: bool
    methods: dict[str, dict[str, Comparison]]


@dataclass(frozen=True)
class PointScores(WithShots):
    """A point of a front.

    - `resolution_ends`: what ends it other than the signal, in words.
    - `bayes_error`: of the best linear reconstruction, as a part of the scene's variance.
    - `dominated`: by another point; by the simulated mean, `simulated_dominated`. None: of the
      design to beat.
    - `predicted_psnr_db` and what is simulated: of captures.
    """

    cost: float
    resolution_cycles_per_rad: float
    resolution_line_pairs_per_mm: float
    resolution_ends: str | None
    bayes_error: float | None
    dominated: bool | None = None
    predicted_psnr_db: float | None = None
    simulated_psnr_db: dict[str, float | None] | None = None
    simulated_mean_db: float | None = None
    simulated_dominated: bool | None = None


@dataclass(frozen=True)
class FrontScores:
    """A front: its points in the order of their cost, and the design to beat.

    - `label`: of the cost, with its unit.
    - `exposure`: how captures share it, in words; `picture_variance`: of captures.
    """

    label: str
    reference: PointScores
    points: tuple[PointScores, ...]
    exposure: str | None = None
    picture_variance: float | None = None


@dataclass(frozen=True)
class FrontsScores:
    """The fronts that were asked for; `highest_cycles_per_rad`: that was looked at."""

    highest_cycles_per_rad: float
    thickness: FrontScores | None = None
    captures: FrontScores | None = None
    light: FrontScores | None = None

    @property
    def fronts(self) -> dict[str, FrontScores]:
        """By name."""
        given = {name: getattr(self, name) for name in COSTS}
        return {name: front for name, front in given.items() if front is not None}


# Label of the cost of each front.
COSTS = {
    "thickness": "thickness, mm",
    "captures": "captures",
    "light": "electrons from each mm²",
}


@dataclass(frozen=True)
class DesignScores:
    """The figures of merit of a design study: designs, best first, their simulation and fronts."""

    design: str
    seed: int
    objective: ObjectiveScores
    search: SearchScores
    training: TrainingScores | None
    reference: Candidate
    compare: tuple[Candidate, ...]
    found: tuple[Candidate, ...]
    validation: Validation
    warnings: list[str]
    pareto: FrontsScores | None = None

    def table(self) -> Table:
        """The designs that were simulated, with their gains over the one to beat."""
        validation = self.validation
        designs = (self.reference, *self.compare, *self.found)
        names = reported_names(designs)
        pictures = (f"{target}\ngain, dB" for target in validation.pictures)
        charts = (f"{target}\ngain, elements" for target in validation.charts)
        rows = []
        for one in designs:
            simulated = validation.methods.get(one.name)
            if simulated is None:
                continue
            gains = [_gain(simulated[name].gain_db) for name in validation.pictures]
            gains += [_gain(simulated[name].gain_elements) for name in validation.charts]
            name = "\n".join([one.name, *one.words(names)])
            rows.append([name, signed(one.predicted_gain, 2), *gains])
        headings = ("design", f"predicted\ngain, {self.objective.unit}", *pictures, *charts)
        return Table(headings, rows)


def signed(value: float | None, digits: int) -> str:
    """With its sign and so many decimals; a dash for none."""
    return "–" if value is None else f"{value:+.{digits}f}"


def _gain(gain: Spread | None) -> str:
    return signed(None if gain is None else gain.mean, 2)


def digits(value: float | None) -> Any:
    """Seven digits; None for NaN and infinity, which JSON does not know."""
    return float(f"{value:.7g}") if value is not None and math.isfinite(value) else None
