r"""Transfer functions of whole methods: what a synthesis of captures carries of each frequency."""

from dataclasses import dataclass

import numpy as np

from thincam_jax._core.arguments import checked
from thincam_jax.imaging.metrics.mtf import cut_off, first_common_zero
from thincam_jax.lensless.exposures import Exposure
from thincam_jax.lensless.phase_shift import without_carrier
from thincam_jax.lensless.psf import otf
from thincam_jax.studies.study import Method, Study


@dataclass(frozen=True)
class ResponseLimits:
    """Where a response has its first zero crossing (None: it has none) and where it ends."""

    first_zero_cycles_per_mm: float | None
    first_zero_object_mm: float | None
    cut_off_cycles_per_mm: float
    cut_off_object_mm: float


@dataclass(frozen=True, eq=False)
class Response:
    """A method's transfer function along u, v = 0, on its reference plane.

    - `frequency`: cycles/mm, ≥ 0.
    - `magnitude`: root of the mean over the shots of Σ|H|² of a shot's channels, mm²; contrasts
      belong to all shots together.
    """

    frequency: np.ndarray
    magnitude: np.ndarray
    limits: ResponseLimits


@checked
def method_response(study: Study, method: Method) -> Response:
    """The response with the finite mask, for a point on the axis, and its limits.

    - First zero crossing: the lowest frequency that no shot of the method carries. A fringe-scanned
      response is real once its carrier e^{jX} is taken off, and so is a harmonic's without its
      e^{jX/m}. Every other response swings with its
      carrier, sin X − cos X for a phase pair: its notches are narrower than the sensor can tell
      apart, no frequency band is missing, and there is no first zero (None).
    - Cut-off: where the magnitude stays under 5 % of its low-frequency value.
    """
    reference = method.distance
    columns = study.sensor.shape[1]
    frequency = np.arange(columns - columns // 2) / (columns * study.pitch)
    signed, powers = [], []
    for shot, channels in _groups(study, method):
        ratio = reference / shot.distance
        # A frequency on the reference plane is ratio times higher on this shot's sensor.
        power = np.sum(np.abs(channels) ** 2, axis=0)
        powers.append(np.interp(frequency * ratio, frequency, power, right=0.0))
        orders = (1,) if method.synthesis == "fringe_scanning" else method.harmonics
        parts = channels[0::2] + 1j * channels[1::2] if orders else ()
        for order, part in zip(orders, parts, strict=True):
            shadow = 1 + shot.distance / study.object_distance
            response = without_carrier(frequency, part, shot.beta, shadow, order)
            signed.append(np.interp(frequency * ratio, frequency, response, right=0.0))
    magnitude = np.sqrt(np.mean(powers, axis=0))
    limit = cut_off(frequency, magnitude)
    zero = first_common_zero(frequency, signed) if signed else None
    magnification = study.object_distance / reference
    return Response(
        frequency,
        magnitude,
        ResponseLimits(
            None if zero is None else round(zero, 3),
            None if zero is None else round(magnification / zero, 3),
            round(limit, 3),
            round(magnification / limit, 3),
        ),
    )


def _groups(study: Study, method: Method) -> list[tuple[Exposure, np.ndarray]]:
    """Shots with the responses (channel, u) of their channels; contrasts are one group."""
    profiles = np.stack([_profile(study, exposure) for exposure in method.exposures])
    if method.synthesis == "contrasts":
        return [(method.shots[0], method.synthesis_matrix @ profiles)]
    single = method.weights(1)
    each = profiles.reshape(len(method.shots), method.phases, -1)
    return [(shot, single @ own) for shot, own in zip(method.shots, each, strict=True)]


def _profile(study: Study, exposure: Exposure) -> np.ndarray:
    """The OTF of one exposure along u ≥ 0, v = 0."""
    light = {"wavelength": exposure.wavelength, "object_distance": study.object_distance}
    how = {"model": study.model, "pixel_integration": study.pixel_integration}
    response = otf(study.camera(exposure), **light, **how)
    rows, columns = study.sensor.shape
    return np.asarray(response[rows // 2, columns // 2 :])
