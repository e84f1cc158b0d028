"""What goes into design.json."""

from typing import Any

from thincam_jax.config import StudyConfig
from thincam_jax.config_design import DesignConfig
from thincam_jax.design_run.problem import broken_limits
from thincam_jax.design_run.ranking import Candidate, FreeValue, Result, Shot

UNITS = {"beta": "rad/mm^2", "distance": "mm"}


def record(config: DesignConfig, result: Result, study: StudyConfig, validation: dict) -> dict:
    """The designs, best first, and the validation of those of them that were simulated."""
    goal = result.goal
    return {
        "design": config.name,
        "seed": config.seed,
        "objective": {
            "name": goal.name,
            "better": "higher" if goal.wants_more else "lower",
            "told": goal.label,
            "band": list(goal.band) if goal.name in ("worst_ratio", "unevenness") else None,
            "highest_cycles_per_rad": _round(result.edge),
            "prior_exponent": _round(result.exponent),
        },
        "search": {
            "evaluations": result.evaluations,
            "failed_starts": result.failed,
            "solver": config.search.solver,
        },
        "reference": {
            **_candidate(result, result.reference),
            "broken_limits": list(broken_limits(config)),
        },
        "found": [_found(result, candidate) for candidate in result.found],
        "validation": {
            "seeds": config.validation.seeds,
            "pictures": [t.name for t in config.pictures()],
            "charts": [t.name for t in config.targets if t.kind == "usaf1951"],
            "one_object_grid": len({max(s.distance for s in m.shots) for m in study.methods}) == 1,
            "methods": validation,
        },
    }


def _candidate(result: Result, one: Candidate) -> dict[str, Any]:
    sign = -1 if result.goal.wants_more else 1
    return {
        "name": one.name,
        "shots": [_shot(shot) for shot in one.shots],
        "objective": _round(sign * one.searched),
        "objective_exact": _round(sign * one.exact),
        "told": _round(float(result.goal.told(one.exact))),
    }


def _found(result: Result, one: Candidate) -> dict[str, Any]:
    return {
        **_candidate(result, one),
        "predicted_gain": _round(result.goal.gain(result.reference.exact, one.exact)),
        "values": [_value(value) for value in one.values],
        "status": one.status,
        "active_limits": list(one.active),
    }


def _shot(shot: Shot) -> dict[str, float]:
    return {"beta_rad_per_mm2": _round(shot.beta), "distance_mm": _round(shot.distance)}


def _value(value: FreeValue) -> dict[str, Any]:
    return {
        "variable": value.variable,
        "shots": list(value.shots),
        "value": _round(value.value),
        "tolerance": None if value.tolerance is None else _round(value.tolerance),
        "unit": UNITS[value.variable],
    }


def _round(value: float) -> float:
    return float(f"{value:.7g}")
