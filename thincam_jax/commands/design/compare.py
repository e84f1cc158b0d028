"""What the simulated designs gain over the reference, over the noise of several seeds."""

from typing import Any

import numpy as np

from thincam_jax.commands.design.simulate import Trials
from thincam_jax.commands.study.config import StudyConfig

_STEPS = 6  # elements of a group of the USAF chart, which is an octave


def compare(study: StudyConfig, trials: dict[str, Trials]) -> dict[str, Any]:
    """For each method and target: PSNR and resolved element, and the gains over the first method.

    `trials` is by target. Means and standard deviations are over seeds; a gain is taken seed by
    seed. Resolution counts in elements of the chart, of which six halve the line pair.
    """
    reference = study.methods[0].name
    return {
        method.name: {
            target.name: _one(
                trials[target.name][method.name],
                None if method.name == reference else trials[target.name][reference],
            )
            for target in study.targets
        }
        for method in study.methods
    }


def _one(metrics: list[dict[str, Any]], reference: list[dict[str, Any]] | None) -> dict[str, Any]:
    found: dict[str, Any] = {
        "object_pixel_mm": metrics[0]["object_pixel_mm"],
        "psnr_db": _spread([m["psnr_db"] for m in metrics]),
        "ssim": _spread([m["ssim"] for m in metrics]),
        "resolved_object_mm": [m["resolved"] and m["resolved"]["object_mm"] for m in metrics],
    }
    if reference is not None:
        pairs = list(zip(metrics, reference, strict=True))
        found["gain_db"] = _spread([_difference(a["psnr_db"], b["psnr_db"]) for a, b in pairs])
        found["gain_elements"] = _spread(
            [_difference(_step(a["resolved"]), _step(b["resolved"])) for a, b in pairs]
        )
    return found


def _step(resolved: dict[str, Any] | None) -> int | None:
    return None if resolved is None else resolved["group"] * _STEPS + resolved["element"]


def _difference(one: float | int | None, other: float | int | None) -> float | int | None:
    return None if one is None or other is None else one - other


def _spread(values: list[Any]) -> dict[str, Any] | None:
    """Mean, standard deviation (n − 1; none of one seed) and the values; None if one is missing."""
    if None in values:
        return None
    return {
        "mean": round(float(np.mean(values)), 4),
        "deviation": round(float(np.std(values, ddof=1)), 4) if len(values) > 1 else None,
        "values": [round(float(v), 4) for v in values],
    }
