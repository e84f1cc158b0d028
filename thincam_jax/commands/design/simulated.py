"""Designs as the methods of a study, which simulates them in full."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from thincam_jax.commands.design.config import DesignConfig
from thincam_jax.commands.study.build import build_plane
from thincam_jax.commands.study.check import check_study
from thincam_jax.commands.study.config import ConfigError, StudyConfig

# Electrons of a full well that no pixel fills: the search knows of no saturation.
_FULL_WELL = 1e9
# Shots that coincide are two exposures of one setting; a study tells exposures apart by setting.
_NUDGE = 1e-9


def build_study(config: DesignConfig, found: Sequence[Any] = ()) -> StudyConfig:
    """The designs that the file gives, and what was found (`name` and `shots`), side by side."""
    named = (config.reference, *config.compare, *found)
    methods = [_method(config, one.name, one.shots) for one in named]
    sensor: dict[str, Any] = {
        "shape": config.sensor.shape,
        "pitch": f"{config.sensor.pitch!r} mm",
    }
    noise: dict[str, Any] = {"snr_db": config.noise.snr_db, "signal_power": "without_mean"}
    if config.noise.read_noise is not None:
        noise = {"read_noise": config.noise.read_noise}
        sensor |= {"full_well": _FULL_WELL, "electrons": config.noise.electrons}
    shared = {"wavelength", "mask", "object", "targets"}
    parts = config.model_dump(mode="json", include=shared, exclude_none=True)
    return StudyConfig.model_validate(
        {
            "name": f"{config.name} found"[:60],
            "title": f"{config.title or config.name}: the designs found",
            "seed": config.seed,
            "model": config.model,
            "pixel_integration": config.pixel_integration,
            "sensor": sensor,
            "noise": noise,
            "methods": methods,
            **parts,
        }
    )


def _method(config: DesignConfig, name: str, shots: Sequence[Any]) -> dict[str, Any]:
    written: list[dict[str, Any]] = []
    for shot in shots:
        beta = shot.beta
        while (entry := _shot(config, shot, beta)) in written:
            beta *= 1 - _NUDGE
        written.append(entry)
    return {
        "name": name,
        "kind": "wiener",
        "synthesis": config.reference.synthesis,
        "shots": written,
    }


def _shot(config: DesignConfig, shot: Any, beta: float) -> dict[str, Any]:
    """As a study has it; what all share is left out."""
    entry: dict[str, Any] = {"beta": f"{beta!r} rad/mm^2", "distance": f"{shot.distance!r} mm"}
    if shot.wavelength not in (None, config.wavelength):
        entry["wavelength"] = f"{shot.wavelength!r} mm"
    if shot.width not in (None, config.mask.width):
        entry["width"] = f"{_shown(shot.width, config.mask.pixel_pitch)!r} mm"
    if shot.exposure != 1:
        entry["exposure"] = shot.exposure
    return entry


def _shown(width: float, pixel: float | None) -> float:
    """A display shows whole pixels."""
    return width if pixel is None else max(1, math.floor(width / pixel + 1e-6)) * pixel


def check_design(config: DesignConfig) -> None:
    """Refuse what the file alone cannot tell, before the search; errors as of `check_study`."""
    study = build_study(config)
    check_study(study)
    for index, target in enumerate(config.targets):
        image = np.asarray(build_plane(study, target).image)
        if config.prior.measured and target in config.pictures() and min(image.shape[-2:]) < 32:
            raise ConfigError(
                f"targets[{index}]: {image.shape[-2]}×{image.shape[-1]} pixels are too few to "
                "measure a spectrum; give at least 32×32, or prior.exponent"
            )
