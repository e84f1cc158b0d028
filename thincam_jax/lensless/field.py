r"""The camera over its field of view: a PSF of its own for every point of the object."""

import math
from collections.abc import Callable

import jax.numpy as jnp
import numpy as np
import scipy
from jaxtyping import Array, Complex, Float

from thincam_jax._core import checks
from thincam_jax._core.arguments import checked
from thincam_jax._core.checks import Number, Shape
from thincam_jax.imaging.operators import (
    CropConvolution,
    LowRank,
    LowRankFit,
    kernel_grid,
    principal_psfs,
)
from thincam_jax.imaging.scene import Spectrum
from thincam_jax.lensless.camera import LenslessCamera
from thincam_jax.lensless.masks.base import zone_orders
from thincam_jax.lensless.method import Model, PsfMethod, as_method
from thincam_jax.lensless.propagation.obliquity import (
    ERROR_PER_RADIAN,
    fall_of_light,
    shift_variance,
)
from thincam_jax.lensless.psf import spectral_psf

# Points of the field along each axis: odd, so that the axis is one of them.
_LEAST_POINTS, _MOST_POINTS = 3, 21


@checked
def field_operator(
    camera: LenslessCamera,
    light: Spectrum | Number,
    object_distance: Number = math.inf,
    *,
    field_shape: Shape,
    tolerance: float = 1e-2,
    model: Model | PsfMethod = "separable",
) -> LowRankFit:
    r"""From a plane of the object to its capture, every point with its own PSF and light.

    The PSFs of a grid of points, each about the ray through the mask's middle, are written as sums
    of the fewest convolutions, :math:`h(\mathbf x; \mathbf u) = \sum_r w_r(\mathbf u)
    p_r(\mathbf x - \mathbf u)` (`LowRank`). The points are Chebyshev's, and polynomials through
    them give the weights of every point of the field. A map of the light, cos⁴θ, multiplies the
    weights (`fall_of_light`).

    **Arguments**

    - `light`: a `Spectrum`, or one wavelength in mm.
    - `object_distance`: t, mm; at infinity the field's points are directions.
    - `field_shape`: (rows, columns) of the field, on the sensor's pitch: its sample at u is the
      object's point at −u·t/d.
    - `tolerance`: relative L2 error of the PSFs over the field, at most half of it by the
      polynomials and the rest by the sum of convolutions.
    - `model`: of the PSFs, averaged over the pixels, see `psf`. Cells off both axes need
      `PsfMethod("angular_spectrum", oversampling=...)`.

    **Returns** the operator and its two errors. Numbers must be known: call it outside of jit.

    **Errors**: ValueError for what is out of range, and where 21 points an axis are too few;
    TypeError for a mask that the model does not have off both axes.

    ```python
    import thincam_jax as tc
    from thincam_jax.units import nm, um

    mask = tc.FresnelZoneAperture(25.0, width=1.0)
    camera = tc.LenslessCamera(mask, tc.Sensor((20, 24), 60 * um), distance=6.5)
    fit = tc.field_operator(camera, 500 * nm, 250.0, field_shape=(16, 20))
    capture = fit.operator(tc.imaging.targets.siemens_star((16, 20)))
    print(capture.shape)  # (20, 24)
    ```

    **See also**: `psf`, `Recording`, `plan`.
    """
    field_shape = checks.shape2d("field_shape", field_shape)
    tolerance = float(checks.positive("tolerance", tolerance, "parts of one"))
    method = as_method(model, pixel_integration=True)
    spectrum = light if isinstance(light, Spectrum) else Spectrum(light)
    tangents = tangents_of(camera, field_shape)
    longest = max(float(w) for w in spectrum.wavelengths)
    counts, between = zip(
        *(_points_needed(camera, longest, t, tolerance / 2) for t in tangents), strict=True
    )
    places = [_lobatto(t, n) for t, n in zip(tangents, counts, strict=True)]
    scale = float(np.asarray(object_distance))
    scale = 1.0 if math.isinf(scale) else scale
    colours = list(zip(spectrum.wavelengths, spectrum.weights, strict=True))
    grid = kernel_grid(camera.sensor.grid, field_shape)

    def psf_at(y: float, x: float) -> Float[Array, "k l"]:
        # The object is turned by 180° on the sensor.
        at = (-scale * y, -scale * x)
        return spectral_psf(camera, colours, object_distance, method, grid, at)

    left = tolerance - max(between)
    maps, kernels, error = principal_psfs(_on_grid(camera, places, psf_at), left)
    for axis, (place, every) in enumerate(zip(places, tangents, strict=True)):
        maps = scipy.interpolate.BarycentricInterpolator(place, maps, axis=axis)(every)
    weights = np.moveaxis(maps, -1, 0) * fall_of_light(*tangents)
    pitch, shape = camera.sensor.pitch, camera.sensor.shape
    convolution = CropConvolution(kernels, pitch, shape, field_shape, summed=1)
    found = LowRank(jnp.asarray(weights, kernels.dtype), convolution)
    return LowRankFit(found, error, max(between))


def tangents_of(
    camera: LenslessCamera, field_shape: tuple[int, int]
) -> tuple[Float[np.ndarray, " m"], Float[np.ndarray, " n"]]:
    """Of the angles of the field's rows and columns, of the rays through the mask's (0, 0)."""
    step = float(camera.sensor.pitch) / float(camera.distance)
    rows, columns = ((np.arange(n) - (n - 1) / 2) * step for n in field_shape)
    return rows, columns


def _points_needed(
    camera: LenslessCamera, wavelength: float, tangents: Float[np.ndarray, " n"], tolerance: float
) -> tuple[int, float]:
    r"""Points of the field along one axis whose polynomial is within the tolerance, and its error.

    From the phase that the field gives the finest light of the mask: ERROR_PER_RADIAN of what the
    polynomial leaves of :math:`e^{j\varphi}`.
    """
    finest = getattr(camera.mask, "finest_frequency", None)
    frequency = 1 / (2 * float(camera.sensor.pitch)) if finest is None else float(finest)
    distance = float(camera.distance)

    def wave(tangents: Float[np.ndarray, " n"]) -> Complex[np.ndarray, " n"]:
        cosines = 1 / np.sqrt(1 + tangents**2)
        return np.exp(1j * shift_variance(wavelength, distance, frequency, cosines))

    fine = np.linspace(-1, 1, 201) * np.abs(tangents).max()
    error = math.inf
    for count in range(_LEAST_POINTS, _MOST_POINTS + 1, 2):
        place = _lobatto(fine, count)
        left = scipy.interpolate.BarycentricInterpolator(place, wave(place))(fine) - wave(fine)
        error = ERROR_PER_RADIAN * float(np.abs(left).max())
        if error <= tolerance:
            return count, error
    angle = math.degrees(math.atan(float(fine[-1])))
    raise ValueError(
        f"the PSF changes too much over a field of ±{angle:.0f}° for {_MOST_POINTS} points an "
        f"axis (left: {error:.1e}); give a larger tolerance or a smaller field"
    )


def _lobatto(tangents: Float[np.ndarray, " n"], count: int) -> Float[np.ndarray, " count"]:
    """Chebyshev's points from the first to the last, ascending; their middle is exactly 0."""
    places = -np.cos(np.pi * np.arange(count) / (count - 1)) * np.abs(tangents).max()
    return (places - places[::-1]) / 2


def _on_grid(
    camera: LenslessCamera,
    places: list[Float[np.ndarray, " n"]],
    psf_at: Callable[[float, float], Float[Array, "k l"]],
) -> Float[Array, "y x k l"]:
    """PSFs at every pair of places; a zone plate on the axis is its own mirror image."""
    mirrored = zone_orders(camera.mask) is not None and not np.asarray(camera.mask.centre).any()
    found: dict[tuple[float, float], Float[Array, "k l"]] = {}

    def at(y: float, x: float) -> Float[Array, "k l"]:
        own = (abs(y), abs(x)) if mirrored else (y, x)
        if own not in found:
            found[own] = psf_at(*own)
        turned = [slice(None, None, -1 if a != b else 1) for a, b in zip(own, (y, x), strict=True)]
        return found[own][turned[0], turned[1]]

    return jnp.stack([jnp.stack([at(y, x) for x in places[1]]) for y in places[0]])
