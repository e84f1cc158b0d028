r"""Responses of synthesised captures: what their sum carries of each frequency."""

import math

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Complex

from thincam_jax._core.checks import Number
from thincam_jax._core.grids import Grid
from thincam_jax.lensless.camera import LenslessCamera
from thincam_jax.lensless.masks.fza import FresnelZoneAperture
from thincam_jax.lensless.method import Model
from thincam_jax.lensless.psf import otf


def fringe_scanned_otf(
    camera: LenslessCamera,
    *,
    wavelength: Number,
    object_distance: Number = math.inf,
    model: Model = "separable",
    pixel_integration: bool = False,
    grid: Grid | None = None,
) -> Complex[Array, "v u"]:
    r"""Fringe-scanned response of a camera with a Fresnel zone aperture, mm².

    .. math::
        H_{FS} = \{H(3\pi/2) - H(\pi/2)\} + j\{H(0) - H(\pi)\}
        \approx \frac{\pi}{\beta} e^{j\pi^2\rho^2/\beta} \cos(\pi\lambda d\rho^2)

    (thesis Eq 3.14 and 3.31, corrected; the right side for weak diffraction, an unbounded mask and
    t → ∞): the constant and the second harmonic cancel. The phase of the camera's mask is not used.
    Arguments and errors as for `otf`; TypeError for masks that have no phase.
    """
    given = (wavelength, object_distance, model, pixel_integration, grid)
    h = [_otf(_with_phase(camera, turns), *given) for turns in (0.0, 0.25, 0.5, 0.75)]
    quadrature = h[0] - h[2]
    return (h[3] - h[1]) + jnp.asarray(1j, dtype=quadrature.dtype) * quadrature


def phase_pair_otf(
    camera: LenslessCamera,
    *,
    wavelength: Number,
    object_distance: Number = math.inf,
    model: Model = "separable",
    pixel_integration: bool = False,
    grid: Grid | None = None,
) -> Complex[Array, "v u"]:
    r"""Response of the difference of two captures with the phases 0 and 3π/2, mm².

    .. math::
        H(0) - H(3\pi/2) \approx \frac{\pi}{2\beta}\cos(\pi\lambda d\rho^2)[\sin X - \cos X]
        + \frac{\pi}{8\beta}\sin(X/2), \qquad X = \pi^2\rho^2/\beta

    (thesis Eq 3.49, corrected): the constant cancels, the second harmonic stays. Arguments and
    errors as for `fringe_scanned_otf`.
    """
    given = (wavelength, object_distance, model, pixel_integration, grid)
    return _otf(_with_phase(camera, 0.0), *given) - _otf(_with_phase(camera, 0.75), *given)


def _otf(camera, wavelength, object_distance, model, pixel_integration, grid):
    return otf(
        camera,
        wavelength=wavelength,
        object_distance=object_distance,
        model=model,
        pixel_integration=pixel_integration,
        grid=grid,
    )


def _with_phase(camera: LenslessCamera, turns: float) -> LenslessCamera:
    """The camera with another phase of its mask, in turns."""
    mask = camera.mask
    if not isinstance(mask, FresnelZoneAperture):
        raise TypeError(
            f"phases are those of a FresnelZoneAperture; the camera has a {type(mask).__name__}"
        )
    phase = jnp.full_like(mask.phase, 2 * jnp.pi * turns)
    return eqx.tree_at(lambda c: c.mask.phase, camera, phase)
