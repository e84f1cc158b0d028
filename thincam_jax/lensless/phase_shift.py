r"""Responses of synthesised captures: what their sum carries of each frequency."""

import functools
import math
import operator

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex

from thincam_jax._core.arguments import checked
from thincam_jax._core.checks import Number
from thincam_jax.lensless.camera import LenslessCamera
from thincam_jax.lensless.masks.fza import FresnelZoneAperture
from thincam_jax.lensless.method import Model, PsfMethod
from thincam_jax.lensless.psf import otf


@checked
def harmonic_otf(
    camera: LenslessCamera,
    harmonic: int,
    *,
    wavelength: Number,
    object_distance: Number = math.inf,
    model: Model | PsfMethod = "separable",
    pixel_integration: bool = True,
) -> Complex[Array, "v u"]:
    r"""Response of the m-th harmonic of the captures over the phase of a zone aperture, mm².

    .. math::
        H(\varphi) = \sum_m H_m e^{jm\varphi}, \qquad
        H_m = \tfrac1K \sum_{q<K} H(2\pi q/K)\, e^{-2\pi jmq/K}

    exact for K above the mask's highest difference of orders plus m; so many are computed. Fewer
    captures fold the harmonics m ± K into it, with responses that are known as well
    (`thincam_jax.reconstruction.synthesis.harmonics`).

    The phase of the camera's mask is not used. Other arguments and errors as for `otf`; TypeError
    for masks that have no phase, ValueError for a harmonic below 0.

    ```python
    import thincam_jax as tc
    from thincam_jax.lensless.phase_shift import harmonic_otf
    from thincam_jax.units import nm, um

    mask = tc.FresnelZoneAperture(25.0, width=1.6, profile="binary")
    camera = tc.LenslessCamera(mask, tc.Sensor((24, 32), 50 * um), distance=5.0)
    second = harmonic_otf(camera, 2, wavelength=500 * nm, object_distance=250.0)
    ```

    **See also**: `lensless.phase_shift.fringe_scanned_otf`.
    """
    if int(harmonic) != harmonic or harmonic < 0:
        raise ValueError(f"harmonic = {harmonic!r}; give a whole number from 0 on")
    orders = _zone_plate(camera).orders
    steps = max(orders) - min(orders) + int(harmonic) + 1
    how = {"wavelength": wavelength, "object_distance": object_distance, "model": model}
    how["pixel_integration"] = pixel_integration
    turns = np.arange(steps) / steps
    weights = np.exp(-2j * np.pi * harmonic * turns) / steps
    responses = (otf(with_phase(camera, turn), **how) for turn in turns)
    terms = (h * h.dtype.type(w) for h, w in zip(responses, weights, strict=True))
    return functools.reduce(operator.add, terms)


@checked
def fringe_scanned_otf(
    camera: LenslessCamera,
    *,
    wavelength: Number,
    object_distance: Number = math.inf,
    model: Model | PsfMethod = "separable",
    pixel_integration: bool = True,
) -> Complex[Array, "v u"]:
    r"""Fringe-scanned response of a camera with a Fresnel zone aperture, mm².

    .. math::
        H_{FS} = \{H(3\pi/2) - H(\pi/2)\} + j\{H(0) - H(\pi)\}
        \approx \frac{\pi}{\beta} e^{j\pi^2\rho^2/\beta} \cos(\pi\lambda d\rho^2)

    (thesis Eq 3.14 and 3.31, corrected; the right side for weak diffraction, an unbounded mask and
    t → ∞): the constant and the second harmonic cancel. The phase of the camera's mask is not used.
    Arguments and errors as for `otf`; TypeError for masks that have no phase.

    ```python
    import thincam_jax as tc
    from thincam_jax.lensless.phase_shift import fringe_scanned_otf
    from thincam_jax.units import nm, um

    mask = tc.FresnelZoneAperture(25.0, width=1.6)
    camera = tc.LenslessCamera(mask, tc.Sensor((24, 32), 50 * um), distance=5.0)
    h = fringe_scanned_otf(camera, wavelength=500 * nm, object_distance=250.0)
    print(h.shape)  # (24, 32)
    ```

    **See also**: `lensless.phase_shift.phase_pair_otf`, `lensless.phase_shift.harmonic_otf`.
    """
    how = {"wavelength": wavelength, "object_distance": object_distance, "model": model}
    how["pixel_integration"] = pixel_integration
    h = [otf(with_phase(camera, turns), **how) for turns in (0.0, 0.25, 0.5, 0.75)]
    quadrature = h[0] - h[2]
    return (h[3] - h[1]) + jnp.asarray(1j, dtype=quadrature.dtype) * quadrature


@checked
def phase_pair_otf(
    camera: LenslessCamera,
    *,
    wavelength: Number,
    object_distance: Number = math.inf,
    model: Model | PsfMethod = "separable",
    pixel_integration: bool = True,
) -> Complex[Array, "v u"]:
    r"""Response of the difference of two captures with the phases 0 and 3π/2, mm².

    .. math::
        H(0) - H(3\pi/2) \approx \frac{\pi}{2\beta}\cos(\pi\lambda d\rho^2)[\sin X - \cos X]
        + \frac{\pi}{8\beta}\sin(X/2), \qquad X = \pi^2\rho^2/\beta

    (thesis Eq 3.49, corrected): the constant cancels, the second harmonic stays. Arguments and
    errors as for `fringe_scanned_otf`.

    ```python
    import thincam_jax as tc
    from thincam_jax.lensless.phase_shift import phase_pair_otf
    from thincam_jax.units import nm, um

    mask = tc.FresnelZoneAperture(25.0, width=1.6)
    camera = tc.LenslessCamera(mask, tc.Sensor((24, 32), 50 * um), distance=5.0)
    h = phase_pair_otf(camera, wavelength=500 * nm, object_distance=250.0)
    print(h.shape)  # (24, 32)
    ```

    **See also**: `lensless.phase_shift.fringe_scanned_otf`, `lensless.phase_shift.harmonic_otf`.
    """
    how = {"wavelength": wavelength, "object_distance": object_distance, "model": model}
    how["pixel_integration"] = pixel_integration
    return otf(with_phase(camera, 0.0), **how) - otf(with_phase(camera, 0.75), **how)


def with_phase(camera: LenslessCamera, turns: float) -> LenslessCamera:
    """The camera with another phase of its mask, in turns."""
    phase = jnp.full_like(_zone_plate(camera).phase, 2 * jnp.pi * turns)
    return eqx.tree_at(lambda c: c.mask.phase, camera, phase)


def _zone_plate(camera: LenslessCamera) -> FresnelZoneAperture:
    """The camera's mask, which has a phase."""
    mask = camera.mask
    if not isinstance(mask, FresnelZoneAperture):
        raise TypeError(
            f"phases are those of a FresnelZoneAperture; the camera has a {type(mask).__name__}"
        )
    return mask


def without_carrier(
    frequency: np.ndarray,
    response: np.ndarray,
    beta: float,
    magnification: float,
    harmonic: int = 1,
) -> np.ndarray:
    """A harmonic's response over its carrier e^{jX/m}, X = π²u²M²/β: real, cos(πλdu²) for m = 1.

    - `frequency`: u on the sensor, cycles/mm; `response`: there, at v = 0.
    - `beta`: rad/mm². `magnification`: M = 1 + d/t of the shadow.
    """
    beta = beta / magnification**2
    return np.real(response * np.exp(-1j * math.pi**2 * frequency**2 / (harmonic * beta)))
