r"""Transfer functions of whole methods: what a synthesis of captures carries of each frequency."""

import math
from typing import Any, NamedTuple

import numpy as np

from thincam_jax.commands.study.build import (
    Setting,
    build_camera,
    reference_distance,
    settings,
    synthesis_matrix,
)
from thincam_jax.commands.study.config import MethodConfig, ShotConfig, StudyConfig
from thincam_jax.imaging.metrics import cut_off, first_common_zero
from thincam_jax.lensless.psf import otf


class Response(NamedTuple):
    """A method's transfer function along u, v = 0, on its reference plane.

    - `frequency`: cycles/mm, ≥ 0.
    - `magnitude`: root of the mean over the shots of Σ|H|² of a shot's channels, mm²; contrasts
      belong to all shots together.
    - `metrics`: its two limits, for metrics.json.
    """

    frequency: np.ndarray
    magnitude: np.ndarray
    metrics: dict[str, Any]


def method_response(config: StudyConfig, method: MethodConfig) -> Response:
    """The response with the finite mask, for a point on the axis, and its limits.

    - First zero crossing: the lowest frequency that no shot of the method carries. A fringe-scanned
      response is real once its carrier e^{jX} is taken off. Every other response swings with its
      carrier, sin X − cos X for a phase pair: its notches are narrower than the sensor can tell
      apart, no frequency band is missing, and there is no first zero (None).
    - Cut-off: where the magnitude stays under 5 % of its low-frequency value.
    """
    reference = reference_distance(method)
    frequency = _frequencies(config)
    signed, powers = [], []
    for shot, channels in _groups(config, method):
        ratio = reference / shot.distance
        # A frequency on the reference plane is ratio times higher on this shot's sensor.
        power = np.sum(np.abs(channels) ** 2, axis=0)
        powers.append(np.interp(frequency * ratio, frequency, power, right=0.0))
        if method.synthesis == "fringe_scanning":
            response = _without_carrier(config, shot, frequency, channels)
            signed.append(np.interp(frequency * ratio, frequency, response, right=0.0))
    magnitude = np.sqrt(np.mean(powers, axis=0))
    limit = cut_off(frequency, magnitude)
    zero = first_common_zero(frequency, signed) if signed else None
    magnification = config.object.distance / reference
    return Response(
        frequency,
        magnitude,
        {
            "first_zero_cycles_per_mm": None if zero is None else round(zero, 3),
            "first_zero_object_mm": None if zero is None else round(magnification / zero, 3),
            "cut_off_cycles_per_mm": round(limit, 3),
            "cut_off_object_mm": round(magnification / limit, 3),
        },
    )


def _frequencies(config: StudyConfig) -> np.ndarray:
    """Frequencies ≥ 0 of the sensor's columns, cycles/mm."""
    columns = config.sensor.shape[1]
    return np.arange(columns - columns // 2) / (columns * config.sensor.pitch)


def _groups(config: StudyConfig, method: MethodConfig) -> list[tuple[ShotConfig, np.ndarray]]:
    """Shots with the responses (channel, u) of their channels; one distance is one group."""
    profiles = np.stack([_profile(config, s) for s in settings(config, method)])
    if method.synthesis == "contrasts":
        return [(method.shots[0], synthesis_matrix(method) @ profiles)]
    phases = len(method.shot_phases())
    single = synthesis_matrix(method.model_copy(update={"shots": method.shots[:1]}))
    return [
        (shot, single @ profiles[index * phases : (index + 1) * phases])
        for index, shot in enumerate(method.shots)
    ]


def _profile(config: StudyConfig, setting: Setting) -> np.ndarray:
    """The OTF of one exposure along u ≥ 0, v = 0."""
    response = otf(
        build_camera(config, setting),
        wavelength=setting.wavelength,
        object_distance=config.object.distance,
        model=config.model,
        pixel_integration=config.pixel_integration,
    )
    rows, columns = config.sensor.shape
    return np.asarray(response[rows // 2, columns // 2 :])


def _without_carrier(
    config: StudyConfig, shot: ShotConfig, u: np.ndarray, channels: np.ndarray
) -> np.ndarray:
    """A fringe-scanned response over e^{jX}, X = π²u²/β on the sensor: real, cos(πλdu²)."""
    magnification = 1 + shot.distance / config.object.distance
    beta = shot.beta / magnification**2
    scanned = channels[0] + 1j * channels[1]
    return (scanned * np.exp(-1j * math.pi**2 * u**2 / beta)).real
