"""One point of a sweep, as a worker evaluates it."""

import time
import traceback
from dataclasses import asdict, dataclass
from typing import Any

import jax
import numpy as np

from thincam_jax.commands.config_file import ConfigError
from thincam_jax.commands.study.build import build_study
from thincam_jax.commands.study.config import StudyConfig
from thincam_jax.studies.evaluate import Scores
from thincam_jax.studies.result import evaluate_target, mean_psnr_of_pictures

# What a user can put right: the message says all.
_USER_ERRORS = (ConfigError, FileNotFoundError, PermissionError, MemoryError)


@dataclass(frozen=True)
class Outcome:
    """The metrics of a point by column; or why there are none, in one line, and the traceback."""

    metrics: dict[str, Any] | None
    reason: str | None = None
    traceback: str | None = None


def measure_point(config: str, double: bool) -> Outcome:
    """The metrics of a resolved study, given as JSON; an error is an outcome too."""
    try:
        with jax.enable_x64(double):
            return Outcome(_measure(StudyConfig.model_validate_json(config)))
    except _USER_ERRORS as error:
        return Outcome(None, "; ".join(str(error).splitlines()))
    except Exception as error:  # a sweep goes on without a point that shows a defect
        return Outcome(None, one_line(error), traceback.format_exc())


def one_line(error: BaseException) -> str:
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    return ": ".join([type(error).__name__, *lines[:1]])


def _measure(config: StudyConfig) -> dict[str, Any]:
    started, row = time.perf_counter(), {}
    study = build_study(config)
    found: dict[str, dict[str, Scores]] = {method.name: {} for method in study.methods}
    for target in study.targets:
        for method, evaluation in evaluate_target(study, target).items():
            found[method][target.name] = evaluation.scores
            row |= _columns(f"{method}/{target.name}", asdict(evaluation.scores))
    for method, targets in found.items():
        psnr_db = [scores.psnr_db for scores in targets.values()]
        known = [value for value in psnr_db if value is not None]
        row[f"mean_psnr_db/{method}"] = round(float(np.mean(known)), 4) if known else None
        pictures = mean_psnr_of_pictures(study.targets, targets)
        if pictures is not None:
            row[f"mean_psnr_of_pictures_db/{method}"] = pictures
    return {**row, "seconds": round(time.perf_counter() - started, 4)}


def _columns(place: str, metrics: dict[str, Any]) -> dict[str, Any]:
    """Flat: `psnr_db/METHOD/TARGET`, and `resolved_object_mm/METHOD/TARGET` of an inner number."""
    flat = {}
    for name, value in metrics.items():
        if isinstance(value, dict):
            flat |= {f"{name}_{inner}": number for inner, number in value.items()}
        elif value is not None or name != "resolved":
            flat[name] = value
    return {f"{name}/{place}": value for name, value in flat.items()}
