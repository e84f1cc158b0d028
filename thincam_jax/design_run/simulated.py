"""Designs as the methods of a study, which simulates them in full."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from thincam_jax.config import ConfigError, StudyConfig
from thincam_jax.config_design import DesignConfig, ReferenceConfig
from thincam_jax.study.build import all_settings, build_camera, build_plane, imaging
from thincam_jax.study.check import check_study

# The brightest noise-free pixel, as a part of the full well.
_EXPOSURE = 0.9
# Shots that coincide are two exposures of one setting; a study tells exposures apart by setting.
_NUDGE = 1e-9


def build_study(
    config: DesignConfig, found: Sequence[Any] = (), full_well: float | None = None
) -> StudyConfig:
    """The designs that the file gives, and what was found (`name` and `shots`), side by side.

    `full_well`: in electrons, for shot noise; see `full_well`.
    """
    reference = config.reference
    methods = [_method(reference, reference.name, reference.shots)]
    methods += [_method(reference, one.name, one.shots) for one in (*config.compare, *found)]
    sensor: dict[str, Any] = {
        "shape": config.sensor.shape,
        "pitch": f"{config.sensor.pitch!r} mm",
    }
    noise: dict[str, Any] = {"snr_db": config.noise.snr_db, "signal_power": "without_mean"}
    if config.noise.read_noise is not None:
        noise = {"read_noise": config.noise.read_noise}
        # Before the light is known, any full well will do.
        sensor |= {"full_well": full_well or 1e4, "exposure": _EXPOSURE}
    named = ("wavelength", "mask", "object", "targets")
    parts = config.model_dump(mode="json", include=set(named), exclude_none=True)
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


def _method(reference: ReferenceConfig, name: str, shots: Sequence[Any]) -> dict[str, Any]:
    written: list[tuple[float, float]] = []
    for shot in shots:
        beta = shot.beta
        while (beta, shot.distance) in written:
            beta *= 1 - _NUDGE
        written.append((beta, shot.distance))
    return {
        "name": name,
        "kind": "wiener",
        "synthesis": reference.synthesis,
        "shots": [{"beta": f"{b!r} rad/mm^2", "distance": f"{d!r} mm"} for b, d in written],
    }


def check_design(config: DesignConfig) -> None:
    """Refuse what the file alone cannot tell, before the search; errors as of `check_study`."""
    check_study(build_study(config))
    for index, target in enumerate(config.targets):
        image = np.asarray(build_plane(build_study(config), target).image)
        if config.prior.measured and target in config.pictures() and min(image.shape[-2:]) < 32:
            raise ConfigError(
                f"targets[{index}]: {image.shape[-2]}×{image.shape[-1]} pixels are too few to "
                "measure a spectrum; give at least 32×32, or prior.exponent"
            )


def full_well(config: DesignConfig) -> float | None:
    """Electrons of a full well with which a study counts the electrons that the file gives.

    A study lets the brightest pixel of each capture fill the same part of the well. Here that is
    what the electrons of each mm² of open aperture are in the reference's first capture of the
    first target; the light of the others is nearly the same, for they share the mask's width. None
    for noise at an SNR.
    """
    if config.noise.electrons is None:
        return None
    study = build_study(config)
    setting = all_settings(study)[0]
    plane = build_plane(study, study.targets[0])
    brightest = float(np.max(imaging(study, build_camera(study, setting), setting, plane)))
    return config.noise.electrons * brightest / _EXPOSURE
