r"""Smooth light that the model does not explain: shading, stray light, a scene beyond the field.

An image that must explain it becomes wrong in its fine detail as well, the more so the longer the
solver runs. With the residual r in units of the noise and a Hann window w of an eighth of the
sensor, of sum 1,

.. math:: s = \mathrm{rms}(w * r) \,/\, \|w\|,

is 1 to 2 if noise is all that is left, whatever the image (`benchmarks/test_misfit.py`).
"""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from thincam_jax._core.quick_programs import quickly_compiled
from thincam_jax.imaging.operators.crop_convolution import place
from thincam_jax.reconstruction.problem import InverseProblem, convolutions, or_one, residuals
from thincam_jax.reconstruction.regularisers import Image
from thincam_jax.reconstruction.uniform_light import high_passed, window_length, window_transfer

# s above which low frequencies count less, at least this many times the whole residual. Below, they
# tell more than the misfit costs: up to 1 dB, at s = 11.
_MISFIT, _SMOOTH = 20.0, 4.0
# η = 6/s: of 1, 3 and 10 % of shading behind eight cameras within 1 dB of the best of seven.
_KEPT = 6.0
# The whole residual over the noise from which on it is said.
_TOLD = 3.0
# PSFs that are upside down leave 1.6 and more, of 3 and 6 % more in size 1.2 and 1.6, right ones
# 0.8 to 1.5.
_SUSPECT = 1.15


@dataclass(frozen=True)
class Misfit:
    """Residuals of captures over their noise: `whole`, and `smooth`, of which noise leaves 1."""

    whole: float
    smooth: tuple[float, ...]

    def __str__(self) -> str:
        worst = max(self.smooth)
        if self.is_smooth:
            return (
                f"the residual's smooth part is {worst:.0f} times that of the noise (shading, "
                "stray light or a scene beyond the field)"
            )
        if self.whole > _TOLD:
            return (
                f"the residual is {self.whole:.1f} times the noise: the PSF, the field or the "
                "noise is not that of the captures; see check_psf"
            )
        return ""

    @property
    def is_suspect(self) -> bool:
        """Whether the PSF may be another."""
        return self.whole > _SUSPECT

    @property
    def is_smooth(self) -> bool:
        """Whether the residual is mostly smooth."""
        return max(self.smooth) > max(_MISFIT, _SMOOTH * self.whole)

    def less_smooth(self, problem: InverseProblem) -> InverseProblem | None:
        """The problem whose smooth light counts as much as it is known; None where all does."""
        if not self.is_smooth:
            return None
        return high_passed(problem, [min(1.0, _KEPT / s) for s in self.smooth])


def misfit_of(problem: InverseProblem, image: Image) -> Misfit | None:
    """The misfit that an image leaves; None for operators that are no convolutions."""
    operators = convolutions(problem)
    if operators is None:
        return None
    window = operators[0].window
    transfer = window_transfer(window_length(problem), window)
    norm = np.sqrt(np.sum(np.fft.irfft2(transfer, s=window) ** 2))
    whole, smooth = jax.device_get(_ratios(problem, image, jnp.asarray(transfer), float(norm)))
    return Misfit(float(max(whole)), tuple(float(s) for s in smooth))


@quickly_compiled
def _ratios(problem: InverseProblem, image: Image, transfer, norm) -> tuple[list, list]:
    operators, whole, smooth = convolutions(problem) or (), [], []
    for operator, weight, left in zip(
        operators, problem.weights, residuals(problem, image), strict=True
    ):
        valid = jnp.broadcast_to(weight > 0, left.shape)
        count = or_one(jnp.sum(valid).astype(left.dtype))
        ratio = jnp.where(valid, jnp.sqrt(weight) * left, 0)
        spectrum = jnp.fft.rfft2(place(ratio, operator.sensor_corner, operator.window))
        low = jnp.fft.irfft2(spectrum * transfer.astype(spectrum.dtype), s=operator.window)
        whole.append(_rms(ratio, count))
        smooth.append(_rms(low, count) / jnp.asarray(norm, left.dtype))
    return whole, smooth


def _rms(values: Float[Array, "..."], count: Float[Array, ""]) -> Float[Array, ""]:
    return jnp.sqrt(jnp.sum(values**2) / count)
