"""Light off the axis: what the models of the PSF hold of it, and how it changes."""

import math
import warnings

import jax
import numpy as np
from jaxtyping import Float

from thincam_jax._core import checks
from thincam_jax.lensless.masks.base import AbstractMask, other_models
from thincam_jax.lensless.method import SAMPLED, AccuracyWarning, Model
from thincam_jax.lensless.propagation.path import LightPath

# Relative L2 error of a zone plate's PSF for a radian of phase left out at the mask's edge.
ERROR_PER_RADIAN = 0.22
_LARGEST_ERROR = 0.05


def require_off_axis(mask: AbstractMask, path: LightPath, model: Model) -> None:
    """ValueError for a model on the axis only; AccuracyWarning where the ray is too steep for it.

    Known numbers only: of traced ones, the model alone is looked at.
    """
    if path.at is None or model in (*SAMPLED, "geometric"):
        return
    if model != "separable":
        raise ValueError(
            f"model {model!r} is for points on the axis: leave `at` out, or use "
            + (other_models(mask) if model != "radial" else "'angular_spectrum'")
        )
    if checks.holds_traced(mask, path):
        return
    with jax.ensure_compile_time_eval():
        finest = mask.finest_frequency
        if finest is None:
            return
        ray = path.chief_ray(mask.centre)
        assert ray is not None
        cosine, distance = float(ray.cosine), float(path.distance / path.magnification)
    phase = third_order(float(path.wavelength), distance, float(np.asarray(finest)), cosine)
    if ERROR_PER_RADIAN * phase > _LARGEST_ERROR:
        angle = math.degrees(math.acos(cosine))
        warnings.warn(
            f"at {angle:.0f}° waves of third order about the ray, which 'separable' leaves out, "
            f"turn by up to {phase:.2g} rad; 'angular_spectrum' has them",
            AccuracyWarning,
            stacklevel=5,
        )


def third_order(wavelength: float, distance: float, frequency: float, cosine: float) -> float:
    r"""Phase of third order about the chief ray, rad, at a frequency ν of the mask's light.

    :math:`\tfrac{\pi}{\lambda D^2}\,s\,c^2 u^3` with D = d/c at u = λDν/c², where that light
    meets the plane of incidence: :math:`\pi s \lambda^2 d \nu^3 / c^5`.
    """
    sine = math.sqrt(1 - cosine**2)
    return math.pi * sine * wavelength**2 * distance * frequency**3 / cosine**5


def shift_variance(
    wavelength: float, distance: float, frequency: float, cosine: float | Float[np.ndarray, "..."]
):
    r"""Phase by which the PSF's change over the field turns the light of a frequency ν, rad.

    In the plane of incidence the light travels d/c³ in place of d: :math:`\pi\lambda d\nu^2
    (c^{-3} - 1)`.
    """
    return math.pi * wavelength * distance * frequency**2 * (cosine**-3 - 1)


def psf_change(wavelength: float, distance: float, frequency: float, cosine: float) -> float:
    r"""Relative L2 error, about, of taking the PSF of the axis off it.

    :math:`2 \cdot 0.22 \sin(\varphi/2)` of the phase φ by which the finest light of the mask
    differs (`shift_variance`), at most π; the edges of a small mask add some percent of their own.
    """
    phase = shift_variance(wavelength, distance, frequency, cosine)
    return 2 * ERROR_PER_RADIAN * math.sin(min(phase, math.pi) / 2)
