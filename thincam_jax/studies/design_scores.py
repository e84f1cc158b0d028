"""Figures of merit of a design study as records, which a file keeps, and as a table."""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, fields
from typing import Any

from thincam_jax._core.table import Table, number
from thincam_jax.design.design import Shot
from thincam_jax.design.sensitivity import FreeValue
from thincam_jax.design.space import REPORTED
from thincam_jax.studies.trials import Comparison, HeldOut, Spread

_ALWAYS = ("beta", "distance")  # are reported of every shot
_ONE_PER_CENT_DB = 10 * math.log10(1.01)  # the change of the error that tolerances are of


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
    """Objective of a search.

    - `label`: quantity and unit of the reported values. `unit`: unit of gains.
    - `prior_exponent`: exponent of the scene's spectrum.
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
    """Course of a search.

    - `approximation_off`: largest difference of searched and exact values, as reported.
    - `broken_limits`: limits that the design to beat does not keep, in words.
    """

    evaluations: int
    failed_starts: int
    solver: str
    approximation_off: float | None
    broken_limits: tuple[str, ...]


@dataclass(frozen=True)
class TrainingScores:
    """Course of a training."""

    reconstruction: str
    images: tuple[str, ...]
    pixels: int
    samples: int
    starts: int
    evaluations: int
    failed_descents: int


@dataclass(frozen=True)
class Candidate(WithShots):
    """A design with the values of its objective: as searched, exact, and exact as reported.

    Of one that is only simulated, shots alone.

    - `training_error`: None without training.
    - `predicted_gain` and all below: numbers of a design found; gains over the one to beat.
    """

    name: str
    objective: float | None = None
    objective_exact: float | None = None
    reported: float | None = None
    training_error: float | None = None
    predicted_gain: float | None = None
    training_gain_db: float | None = None
    values: tuple[FreeValue, ...] = ()
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

    def table(self) -> Table:
        """PSNR, resolution and gain of each design on each target."""
        names = list(next(iter(self.methods.values())))
        headings = ["design"]
        for target in names:
            headings.append(f"{target}\nPSNR, gain, dB")
            headings += ["resolved mm,\ngain, elements"] if target in self.charts else []
        rows = []
        for number_of, (name, targets) in enumerate(self.methods.items()):
            row = [name]
            for target in names:
                found = targets[target]
                texts = [_spread(found.psnr_db, 2, ""), _spread(found.gain_db, 2)]
                row.append("\n".join(texts[: 2 if number_of else 1]))
                if target in self.charts:
                    texts = [_resolved(found.resolved_object_mm), _spread(found.gain_elements, 1)]
                    row.append("\n".join(texts[: 2 if number_of else 1]))
            rows.append([*row, number(targets[names[0]].object_pixel_mm, 4)])
        return Table([*headings, "object\npixel mm"], rows)


@dataclass(frozen=True)
class PointScores(WithShots):
    """A point of a front.

    - `resolution_ends`: cause other than the signal that ends it, in words.
    - `bayes_error`: error of the best linear reconstruction, as a part of the scene's variance.
    - `dominated`: whether another point dominates it; by the simulated mean, `simulated_dominated`.
      None for the design to beat.
    - `predicted_psnr_db` and the simulated figures: of the front of captures only.
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

    - `label`: label of the cost, with its unit.
    - `exposure`: division among captures, in words; `picture_variance`: variance of pictures, for
      the front of captures.
    """

    label: str
    reference: PointScores
    points: tuple[PointScores, ...]
    exposure: str | None = None
    picture_variance: float | None = None

    def table(self, name: str, reference: str) -> Table:
        """Table of the points and the design to beat; `name`: the front's in `FrontsScores`."""
        names = reported_names([*self.points, self.reference])
        labels = [REPORTED[name].label for name in names]
        points = [(_cost(point.cost), point) for point in self.points]
        points.append((f"{reference}: {_cost(self.reference.cost)}", self.reference))
        pictures = tuple(self.points[0].simulated_psnr_db or ())

        def cells(point: PointScores) -> tuple[str, ...]:
            if name == "captures":
                simulated = point.simulated_psnr_db or {}
                levels = (number(simulated.get(picture), 2) for picture in pictures)
                return (f"{point.predicted_psnr_db:.2f}", *levels)
            return (
                f"{point.resolution_cycles_per_rad:.1f}",
                f"{point.resolution_line_pairs_per_mm:.3f}",
                point.resolution_ends or "",
            )

        kept = {True: "no", False: "yes", None: ""}
        rows = [(text, *p.cells(names), *cells(p), kept[p.dominated]) for text, p in points]
        if name != "captures":
            headings = ("cycles/rad", "line pairs/mm on the object", "", "front")
            title = f"{name.capitalize()} against resolution"
            return Table((self.label, *labels, *headings), rows, title=title)
        headings = ("predicted, dB", *(f"{picture}, dB" for picture in pictures), "front")
        return Table((self.label, *labels, *headings), rows, title="Captures against PSNR")


@dataclass(frozen=True)
class FrontsScores:
    """The fronts requested; `highest_cycles_per_rad`: highest frequency evaluated."""

    highest_cycles_per_rad: float
    thickness: FrontScores | None = None
    captures: FrontScores | None = None
    light: FrontScores | None = None

    @property
    def fronts(self) -> dict[str, FrontScores]:
        """Fronts by name."""
        given = {name: getattr(self, name) for name in COSTS}
        return {name: front for name, front in given.items() if front is not None}


# Label of the cost of each front.
COSTS = {"thickness": "thickness, mm", "captures": "captures", "light": "electrons from each mm²"}


@dataclass(frozen=True)
class DesignScores:
    """The figures of merit of a design study: designs, best first, their simulation and fronts.

    - `random`: the best of `random_designs` random ones, at the cost of the search.
    - `limits_db`: least error of any masks of a kind, by its name, as reported.
    """

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
    random: Candidate | None = None
    random_designs: int = 0
    held_out: HeldOut | None = None
    limits_db: dict[str, float] = field(default_factory=dict)

    def levels(self) -> str:
        """Design and photographs that the gains refer to, in a sentence."""
        name = self.reference.name
        of_pictures = self.validation.methods[name]
        levels = {target: of_pictures[target].psnr_db for target in self.validation.pictures}
        known = [f"{target} {psnr.mean:.2f} dB" for target, psnr in levels.items() if psnr]
        return f"gains are over {name}, whose PSNR is: {', '.join(known) or 'that of exact images'}"

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

    def designs_table(self) -> Table:
        """The reference, and the designs found with the tolerances of their numbers."""
        trained, reference = self.training is not None, self.reference
        free = [(value.variable, value.shots) for value in self.found[0].values]

        def row(one: Candidate, numbers: list[str]) -> list[str]:
            gains = [one.predicted_gain, *([one.training_gain_db] if trained else [])]
            reported = [number(one.reported, 3), *(signed(gain, 3) for gain in gains)]
            end = one.status.replace("iterations_exhausted", "stopped").replace("_", " ")
            return [one.name, *numbers, *reported, end or "–", "; ".join(one.active_limits) or "–"]

        rows = [row(reference, [reference.text(*each) for each in free])]
        rows += [row(one, [str(value) for value in one.values]) for one in self.found]
        labels = (f"{REPORTED[name].of_shots(shots)}\n(tolerance)" for name, shots in free)
        gains = ("gain", *(("training\ngain, dB",) if trained else ()))
        headings = ("design", *labels, self.objective.label, *gains, "descent", "against limits")
        return Table(headings, rows, words=(len(headings) - 1,))

    def findings(self) -> list[str]:
        """Findings in sentences."""
        best, reference, validation = self.found[0], self.reference, self.validation
        names = reported_names([best, reference])
        by = "training" if self.training else self.objective.name
        sentences = [
            f"The best design by {by} is {' and '.join(best.words(names))}. The objective "
            f"predicts {best.predicted_gain:+.3g} {self.objective.unit} over {reference.name} "
            f"({' and '.join(reference.words(names))})."
        ]
        if best.training_gain_db is not None:
            sentences.append(f"On the training images it gains {best.training_gain_db:+.2f} dB.")
        if self.limits_db:
            sentences.append(self._beside_the_limit())
        broken = self.search.broken_limits
        sentences += [f"The reference breaks a limit: {why}." for why in broken]
        if best.active_limits:
            sentences.append(f"It lies against a limit: {'; '.join(best.active_limits)}.")
        for name, targets in validation.methods.items():
            gains = [
                f"{_worth(t.gain_db)} on {target}"
                for target, t in targets.items()
                if target in validation.pictures and t.gain_db
            ]
            if gains:
                sentences.append(f"Simulated, {name} gains {', '.join(gains)}.")
            for target, found in targets.items():
                if target in validation.charts and found.gain_elements:
                    steps = _spread(found.gain_elements, 1)
                    psnr = _worth(found.gain_db) if found.gain_db else "an exact image"
                    words = f"{name} resolves {steps} elements more, at {psnr}"
                    sentences.append(f"On {target}, {words}.")
        sentences += self._beside_others()
        if not validation.one_object_grid:
            sentences.append(
                "The designs' largest distances differ, and with them the object's pixels (in the "
                "table below): their PSNR is not on one grid and compares to some tenths of a dB "
                "only."
            )
        return sentences

    def _beside_the_limit(self) -> str:
        kinds = {"shadow": "that cast shadows", "amplitude": "with diffraction"}

        def above(one: Candidate, least: float) -> str:
            return f"{(math.nan if one.reported is None else one.reported) - least:.1f} dB"

        words = [
            f"{above(self.found[0], least)} above the limit that no masks {kinds[masks]} pass "
            f"({self.reference.name} {above(self.reference, least)})"
            for masks, least in self.limits_db.items()
        ]
        return f"{self.found[0].name} is {' and '.join(words)}."

    def _beside_others(self) -> list[str]:
        """Random designs beside the found ones, and the gain on further photographs."""
        best, random, held_out = self.found[0].name, self.random, self.held_out
        sentences = []
        if random is not None:
            sentences.append(
                f"The best of {self.random_designs} random designs, which cost as much as the "
                f"search, is predicted {random.predicted_gain:+.3g} {self.objective.unit}."
            )
        if held_out is not None:
            gain, count = held_out.gains[best], len(held_out.photographs)
            sentences.append(f"On {count} further photographs {best} gains {gain}")
            if random is not None:
                sentences[-1] += f", the random one {held_out.gains[random.name]}"
            sentences[-1] += "."
            if gain.low <= 0 or gain.mean < _ONE_PER_CENT_DB:
                name = self.reference.name
                sentences.append(
                    f"That is within the tolerance of {name}: no new mask is worth making."
                )
        return sentences


def _resolved(values: Sequence[float | None]) -> str:
    known = [value for value in values if value is not None]
    if len(known) < len(values):
        return "–"
    ends = [f"{end:.2f}" for end in (min(known), max(known))]
    return " to ".join(ends if min(known) < max(known) else ends[:1])


def _cost(value: float) -> str:
    return f"{value:.0f}" if value >= 1000 else f"{value:.4g}"


def _worth(gain: Spread) -> str:
    """A gain of PSNR, and the change of the error: "−1.06 dB (28 % more squared error)"."""
    change = 100 * (10 ** (-gain.mean / 10) - 1)
    word = "more" if change > 0 else "less"
    return f"{gain.text(2)} dB ({abs(change):.0f} % {word} squared error)"


def _spread(spread: Spread | None, digits: int, sign: str = "+") -> str:
    """Mean and standard deviation over the seeds; a dash where the images were exact."""
    return "–" if spread is None else spread.text(digits, sign)


def signed(value: float | None, digits: int) -> str:
    """Text of a value with its sign and so many decimals; a dash for none."""
    return "–" if value is None else f"{value:+.{digits}f}"


def _gain(gain: Spread | None) -> str:
    return signed(None if gain is None else gain.mean, 2)


def digits(value: float | None) -> Any:
    """Seven digits; None for NaN and infinity, which JSON does not know."""
    return float(f"{value:.7g}") if value is not None and math.isfinite(value) else None
