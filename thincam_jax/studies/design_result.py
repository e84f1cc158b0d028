"""Result of a design study in memory, and its figures of merit."""

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from thincam_jax._core.table import Table
from thincam_jax.design.design import Shot
from thincam_jax.design.fronts import FrontPoint, non_dominated
from thincam_jax.design.objectives import AbstractObjective
from thincam_jax.design.ranking import RankedDesign
from thincam_jax.design.setup import PhotonNoise, SignalNoise
from thincam_jax.design.space import broken_limits
from thincam_jax.studies.design import DesignStudy, FoundDesigns, Front, Fronts
from thincam_jax.studies.design_scores import (
    COSTS,
    Candidate,
    DesignScores,
    FrontScores,
    FrontsScores,
    ObjectiveScores,
    PointScores,
    SearchScores,
    ShotNumbers,
    TrainingScores,
    Validation,
    digits,
)
from thincam_jax.studies.study import Study
from thincam_jax.studies.trials import Trials, compare_trials

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True, eq=False)
class DesignResult:
    """All that a design study found; `trials`: scores of the simulation, by target."""

    design: DesignStudy
    found: FoundDesigns
    trials: Mapping[str, Trials]
    fronts: Fronts | None = None

    @property
    def simulated(self) -> Study:
        """The designs given and the best of those found, as methods of a study."""
        return self.design.simulated(self.found)

    @property
    def scores(self) -> DesignScores:
        """The figures of merit, without landscapes and levels."""
        return _summary(self)

    def table(self) -> Table:
        """The designs that were simulated, with their gains over the one to beat."""
        return self.scores.table()

    def plot(self) -> "Figure | None":
        """The objective over free numbers, with the design to beat and the best of those found.

        None where the bounds leave no room to draw.
        """
        from thincam_jax.plot import design as plot
        from thincam_jax.plot.frame import new_figure

        if self.found.landscape is None:
            return None
        return plot.draw_objective(self.found, self.design.best, new_figure(1.0, 1.0))


def _summary(result: DesignResult) -> DesignScores:
    design, found, study = result.design, result.found, result.simulated
    objective = found.objective
    plan, trained = design.training, found.training
    training = None
    if plan is not None and trained is not None:
        training = TrainingScores(
            plan.error.reconstruction,
            tuple(plan.images),
            trained.pixels,
            plan.settings.samples,
            plan.settings.starts,
            trained.evaluations,
            trained.failed,
        )
    validation = Validation(
        design.seeds,
        tuple(target.name for target in study.targets if target.is_picture),
        tuple(target.name for target in study.targets if target.kind == "usaf1951"),
        len({method.distance for method in study.methods}) == 1,
        compare_trials(result.trials),
    )
    off = max(
        abs(float(objective.reported(one.searched) - objective.reported(one.exact)))
        for one in found.found
    )
    return DesignScores(
        study.name,
        study.seed,
        ObjectiveScores(
            objective.name,
            "higher" if objective.maximised else "lower",
            objective.label,
            objective.unit,
            getattr(objective, "band", None),
            digits(found.edge),
            digits(found.exponent),
        ),
        SearchScores(
            found.evaluations,
            found.failed,
            design.settings.solver,
            digits(off),
            broken_limits(design.problem.space),
        ),
        training,
        _candidate(objective, found.reference),
        tuple(Candidate(_shots(rival.shots), name) for name, rival in design.rivals.items()),
        tuple(_found(objective, found.reference, one) for one in found.found),
        validation,
        study.warnings,
        None
        if result.fronts is None
        else summarise_fronts(
            result.fronts, design.problem.data.setup.noise, study.object_distance
        ),
        None if found.random is None else _found(objective, found.reference, found.random),
        found.random_designs,
        found.held_out,
        {one.masks: digits(one.decibels) for one in found.limits},
    )


def _candidate(objective: AbstractObjective, one: RankedDesign) -> Candidate:
    sign = -1 if objective.maximised else 1
    return Candidate(
        _shots(one.shots),
        one.name,
        digits(sign * one.searched),
        digits(sign * one.exact),
        digits(float(objective.reported(one.exact))),
        digits(one.trained),
    )


def _found(objective: AbstractObjective, reference: RankedDesign, one: RankedDesign) -> Candidate:
    return replace(
        _candidate(objective, one),
        predicted_gain=digits(objective.gain(reference.exact, one.exact)),
        training_gain_db=_training_gain(reference, one),
        values=tuple(
            replace(v, value=digits(v.value), tolerance=digits(v.tolerance)) for v in one.values
        ),
        status=one.status,
        active_limits=one.active,
    )


def _training_gain(reference: RankedDesign, one: RankedDesign) -> float | None:
    if reference.trained is None or one.trained is None:
        return None
    if not (reference.trained > 0 and one.trained > 0):  # NaN, or a perfect image
        return None
    return digits(10 * math.log10(reference.trained / one.trained))


def summarise_fronts(
    fronts: Fronts, noise: SignalNoise | PhotonNoise, object_distance: float
) -> FrontsScores:
    """Each front with its points in the order of their cost, and which of them count."""
    found: dict[str, FrontScores] = {}
    for name, front in fronts.fronts.items():
        if name == "captures":
            found[name] = _captures(front, fronts, noise, object_distance)
            continue
        beaten = _dominated(front.points, [point.resolution for point in front.points])
        points = tuple(
            _point(point, object_distance, dominated=own)
            for point, own in zip(front.points, beaten, strict=True)
        )
        found[name] = FrontScores(COSTS[name], _point(front.reference, object_distance), points)
    return FrontsScores(digits(fronts.edge), **found)


def _captures(
    front: Front, fronts: Fronts, noise: SignalNoise | PhotonNoise, object_distance: float
) -> FrontScores:
    """Captures against PSNR, predicted and simulated."""
    variance = fronts.picture_variance
    assert variance is not None  # for the type checker

    def level(point: FrontPoint) -> float | None:
        size = point.error * variance
        return digits(-10 * math.log10(size) if size > 0 else math.nan)

    predicted = [level(point) for point in front.points]
    means = [_mean(levels.values()) for levels in fronts.simulated]
    each = zip(
        front.points,
        predicted,
        _dominated(front.points, predicted),
        fronts.simulated,
        means,
        _dominated(front.points, means),
        strict=True,
    )
    points = tuple(
        _point(
            point,
            object_distance,
            predicted_psnr_db=own,
            dominated=beaten,
            simulated_psnr_db=dict(levels),
            simulated_mean_db=mean,
            simulated_dominated=simulated,
        )
        for point, own, beaten, levels, mean, simulated in each
    )
    shared = isinstance(noise, PhotonNoise)
    return FrontScores(
        COSTS["captures"],
        _point(front.reference, object_distance, predicted_psnr_db=level(front.reference)),
        points,
        "that of the reference's captures, divided evenly"
        if shared
        else "the same for each capture, at the SNR given",
        digits(variance),
    )


def _mean(levels: Iterable[float | None]) -> float | None:
    """None where one is missing."""
    known = list(levels)
    if None in known:
        return None
    return digits(float(np.mean(np.asarray(known, float))))


def _dominated(points: Iterable[FrontPoint], worth: Iterable[float | None]) -> list[bool]:
    """Whether each point is dominated, by cost and by worth."""
    pairs = zip((point.cost for point in points), worth, strict=True)
    known = [(cost, math.nan if own is None else own) for cost, own in pairs]
    return (~non_dominated(np.asarray(known, float), larger=(False, True))).tolist()


def _point(point: FrontPoint, object_distance: float, **more: Any) -> PointScores:
    return PointScores(
        _shots(point.shots),
        digits(point.cost),
        digits(point.resolution),
        digits(point.resolution / object_distance),
        point.ends or None,
        digits(point.error),
        **more,
    )


def _shots(shots: Iterable[Shot]) -> tuple[ShotNumbers, ...]:
    return tuple(map(ShotNumbers.of, shots))
