"""Record of a design: design.json."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from thincam_jax.commands.design.config import DesignConfig
from thincam_jax.commands.sections import ShotConfig
from thincam_jax.commands.study.build import FileStudy
from thincam_jax.design import (
    AbstractObjective,
    FrontPoint,
    Landscape,
    ModulationTransfer,
    RankedDesign,
    Shot,
    TrainedDesigns,
    non_dominated,
)
from thincam_jax.design.space import REPORTED

# Keys of the numbers of a shot in design.json, in the units of reports.
SHOT_KEYS = {
    "beta": "beta_rad_per_mm2",
    "distance": "distance_mm",
    "wavelength": "wavelength_nm",
    "width": "width_mm",
    "exposure": "exposure",
}
# Name of the cost of each front, and its key in design.json.
COSTS = {
    "thickness": ("thickness, mm", "thickness_mm"),
    "captures": ("captures", "captures"),
    "light": ("electrons from each mm²", "electrons_per_mm2"),
}


@dataclass(frozen=True, eq=False)
class FoundDesigns:
    """Result of a search.

    - `edge`: of the frequencies looked at, cycles/rad; `exponent`: of the prior.
    - `transfers`: of the reference and of the best design.
    - `training`: the trained designs; None without training.
    """

    objective: AbstractObjective
    reference: RankedDesign
    found: tuple[RankedDesign, ...]
    evaluations: int
    failed: int
    exponent: float
    edge: float
    landscape: Landscape | None
    transfers: tuple[ModulationTransfer, ...] = ()
    training: TrainedDesigns | None = None


@dataclass(frozen=True, eq=False)
class Front:
    """The points in the order of their cost, and the design to beat at its own."""

    points: tuple[FrontPoint, ...]
    reference: FrontPoint


@dataclass(frozen=True, eq=False)
class Fronts:
    """Those that were asked for: thickness, captures, light.

    - `edge`: the highest frequency of all, cycles/rad.
    - `picture_variance`: geometric mean over the pictures, whose values end at 1; of captures.
    - `simulated`: PSNR of each picture, dB, of each point of captures.
    """

    fronts: dict[str, Front]
    edge: float
    picture_variance: float | None
    simulated: tuple[tuple[tuple[str, float | None], ...], ...] = ()


def record(result: FoundDesigns, study: FileStudy, validation: dict) -> dict:
    """The designs, best first, and the validation of those of them that were simulated."""
    config, objective = study.config, result.objective
    return {
        "design": config.name,
        "seed": config.seed,
        "objective": {
            "name": objective.name,
            "better": "higher" if objective.maximised else "lower",
            "told": objective.label,
            "band": _band(objective),
            "highest_cycles_per_rad": _round(result.edge),
            "prior_exponent": _round(result.exponent),
        },
        "search": {
            "evaluations": result.evaluations,
            "failed_starts": result.failed,
            "solver": config.search.solver,
            "approximation_off": _round(_approximation_off(result)),
        },
        "training": _training(config, result),
        "reference": {
            **_candidate(result, result.reference),
            "broken_limits": list(broken_limits(config)),
        },
        "compare": [
            {"name": rival.name, "shots": [_given(config, shot) for shot in rival.shots]}
            for rival in config.compare
        ],
        "found": [_found(result, candidate) for candidate in result.found],
        "validation": {
            "seeds": config.validation.seeds,
            "pictures": [t.name for t in config.pictures()],
            "charts": [t.name for t in config.targets if t.kind == "usaf1951"],
            "one_object_grid": len({method.distance for method in study.methods}) == 1,
            "methods": validation,
        },
    }


def _band(objective: AbstractObjective) -> list[float] | None:
    band = getattr(objective, "band", None)
    return None if band is None else list(band)


def _approximation_off(result: FoundDesigns) -> float:
    """How far the value as searched lies from the exact one at most, in the reported unit."""
    reported = result.objective.reported
    return max(abs(float(reported(one.searched) - reported(one.exact))) for one in result.found)


def _training(config: DesignConfig, result: FoundDesigns) -> dict[str, Any] | None:
    if config.train is None or result.training is None:
        return None
    return {
        "reconstruction": config.train.reconstruction,
        "images": list(config.train.images),
        "pixels": result.training.pixels,
        "samples": config.train.samples,
        "starts": config.train.starts,
        "evaluations": result.training.evaluations,
        "failed_descents": result.training.failed,
    }


def _candidate(result: FoundDesigns, one: RankedDesign) -> dict[str, Any]:
    sign = -1 if result.objective.maximised else 1
    return {
        "name": one.name,
        "shots": [_shot(shot) for shot in one.shots],
        "objective": _round(sign * one.searched),
        "objective_exact": _round(sign * one.exact),
        "told": _round(float(result.objective.reported(one.exact))),
        "training_error": _round(one.trained),
    }


def _found(result: FoundDesigns, one: RankedDesign) -> dict[str, Any]:
    return {
        **_candidate(result, one),
        "predicted_gain": _round(result.objective.gain(result.reference.exact, one.exact)),
        "training_gain_db": _training_gain(result.reference, one),
        "values": [
            {
                "variable": value.variable,
                "shots": list(value.shots),
                "value": _round(value.value),
                "tolerance": _round(value.tolerance),
                "unit": value.unit,
            }
            for value in one.values
        ],
        "status": one.status,
        "active_limits": list(one.active),
    }


def _training_gain(reference: RankedDesign, one: RankedDesign) -> float | None:
    if reference.trained is None or one.trained is None:
        return None
    if not (reference.trained > 0 and one.trained > 0):  # NaN, or a perfect image
        return None
    return _round(10 * math.log10(reference.trained / one.trained))


def record_fronts(config: DesignConfig, fronts: Fronts) -> dict[str, Any]:
    """The fronts, each with its points in the order of their cost, and which of them count."""
    recorded: dict[str, Any] = {"highest_cycles_per_rad": _round(fronts.edge)}
    for name, front in fronts.fronts.items():
        if name == "captures":
            assert fronts.picture_variance is not None  # for the type checker
            recorded[name] = _captures(config, front, fronts.picture_variance, fronts.simulated)
        else:
            recorded[name] = _front(config, front, COSTS[name][1])
    return recorded


def _front(config: DesignConfig, front: Front, cost: str) -> dict[str, Any]:
    """Cost against resolution."""
    worth = [(p.cost, p.resolution) for p in front.points]
    beaten = ~non_dominated(np.asarray(worth), larger=(False, True))
    points = [_point(config, p, cost) for p in front.points]
    return {
        "reference": _point(config, front.reference, cost),
        "points": [{**p, "dominated": bool(b)} for p, b in zip(points, beaten, strict=True)],
    }


def _captures(
    config: DesignConfig,
    front: Front,
    variance: float,
    simulated: Sequence[tuple[tuple[str, float | None], ...]],
) -> dict[str, Any]:
    """Captures against PSNR, predicted and simulated."""

    def predicted(point: FrontPoint) -> dict[str, Any]:
        size = point.error * variance
        level = -10 * math.log10(size) if size > 0 else math.nan
        own = _point(config, point, "captures")
        return {**own, "captures": round(point.cost), "predicted_psnr_db": _round(level)}

    points = []
    for point, levels in zip(front.points, simulated, strict=True):
        known = [psnr for _, psnr in levels if psnr is not None]
        whole = len(known) == len(levels)
        points.append(
            {
                **predicted(point),
                "simulated_psnr_db": dict(levels),
                "simulated_mean_db": _round(float(np.mean(known))) if whole else None,
            }
        )
    for name in ("predicted_psnr_db", "simulated_mean_db"):
        worth = [(p["captures"], math.nan if p[name] is None else p[name]) for p in points]
        beaten = ~non_dominated(np.asarray(worth, float), larger=(False, True))
        key = "dominated" if name == "predicted_psnr_db" else "simulated_dominated"
        for point, is_beaten in zip(points, beaten, strict=True):
            point[key] = bool(is_beaten)
    return {
        "exposure": "the same for each capture, at the SNR given"
        if config.noise.electrons is None
        else "that of the reference's captures, divided evenly",
        "picture_variance": _round(variance),
        "reference": predicted(front.reference),
        "points": points,
    }


def _point(config: DesignConfig, point: FrontPoint, cost: str) -> dict[str, Any]:
    return {
        cost: _round(point.cost),
        "shots": [_shot(shot) for shot in point.shots],
        "resolution_cycles_per_rad": _round(point.resolution),
        "resolution_line_pairs_per_mm": _round(point.resolution / config.object.distance),
        "resolution_ends": point.ends or None,
        "bayes_error": _round(point.error),
    }


def _given(config: DesignConfig, shot: ShotConfig) -> dict[str, float | None]:
    return _shot(Shot(shot.beta, shot.distance, config.wavelength, config.mask.width))


def _shot(shot: Shot) -> dict[str, float | None]:
    return {
        key: _round(getattr(shot, name) * REPORTED[name].scale) for name, key in SHOT_KEYS.items()
    }


def _round(value: float | None) -> float | None:
    """Seven digits; None for NaN and infinity, which JSON does not know."""
    return float(f"{value:.7g}") if value is not None and math.isfinite(value) else None


def broken_limits(config: DesignConfig) -> tuple[str, ...]:
    """Which limits of the search the reference itself does not keep, in words."""
    words = []
    limits = config.search.limits
    for number, shot in enumerate(config.reference.shots, 1):
        if limits.mask_pixel is not None:
            finest = math.pi / limits.mask_pixel / config.mask.width
            if shot.beta > finest * (1 + 1e-6):
                words.append(
                    f"β of shot {number}, {shot.beta:g} rad/mm², is more than the "
                    f"{finest:.4g} rad/mm² that mask pixels of {1000 * limits.mask_pixel:g} µm show"
                )
        if limits.thickness is not None and shot.distance > limits.thickness * (1 + 1e-6):
            words.append(
                f"the distance of shot {number}, {shot.distance:g} mm, is more than the thickness "
                f"of {limits.thickness:g} mm"
            )
    return tuple(words)
