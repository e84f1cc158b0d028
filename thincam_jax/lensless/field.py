"""The camera over its field of view: a PSF of its own for every point of the object."""

import math
from collections.abc import Callable, Sequence
from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import scipy
from jaxtyping import Array, Complex, Float

from thincam_jax._core import checks
from thincam_jax._core.arguments import checked
from thincam_jax._core.checks import Number, Numbers, Shape
from thincam_jax._core.grids import Grid
from thincam_jax._core.progress import watched
from thincam_jax.imaging.operators import CropConvolution
from thincam_jax.imaging.operators.crop_convolution import kernel_grid
from thincam_jax.imaging.operators.low_rank import LowRank, LowRankFit, principal_psfs
from thincam_jax.imaging.scene import Spectrum
from thincam_jax.imaging.sensor import Sensor
from thincam_jax.lensless.camera import ERROR_PER_RADIAN, LenslessCamera, shift_variance
from thincam_jax.lensless.masks.base import has_few_terms, zone_orders
from thincam_jax.lensless.method import Model, PsfMethod, as_method, average_error, pixel_nodes
from thincam_jax.lensless.psf import spectral_psf


def light_over_field(
    sensor: Sensor, down: Float[np.ndarray, " m"], across: Float[np.ndarray, " n"]
) -> Float[np.ndarray, "m n"] | Float[Array, "m n"]:
    r"""Relative light of the field's points at the tangents of two angles: 1 on the axis.

    cos⁴θ (`fall_of_light`) times the sensor's `angular_response`: its pixels see a point's light
    under the angle θ, whatever the mask did to it, as it turns light by λν ≪ 1 only. Micro-lenses
    whose chief ray changes over the sensor are not modelled: for those, take the mean response.
    """
    fall, given = fall_of_light(down, across), sensor.angular_response
    if given is None:
        return fall
    if given.ndim == 0:
        return fall * fall ** (given / 4)
    angles = np.arctan(np.hypot(down[:, None], across))
    return fall * jnp.interp(jnp.asarray(angles, given.dtype), given[:, 0], given[:, 1])


def fall_of_light(
    down: Float[np.ndarray, " m"], across: Float[np.ndarray, " n"]
) -> Float[np.ndarray, "m n"]:
    r"""cos⁴θ at the tangents of two angles: the light of a plane of equal radiance on the sensor.

    A patch dA of the plane sends :math:`L\,dA\cos\theta` per solid angle towards the mask, over
    the way :math:`t/\cos\theta` onto pixels tilted by θ: :math:`L\,dA\cos^4\theta/t^2`. The same
    holds for a scene at infinity, where the solid angle of a step of the tangents is
    :math:`\cos^3\theta`. A display or a lamp that is brighter along its normal falls faster;
    multiply the scene with the rest.
    """
    return (1 + down[:, None] ** 2 + across**2) ** -2


@checked
def shading(
    down: Numbers, across: Numbers, *, depth: Number, opening: Number, width: Number | None = None
) -> Float[np.ndarray, "m n"]:
    r"""Part of a square opening that is lit past an edge before it: of walls and of baffles.

    Light at the tangents :math:`u_i` shifts the edge's shadow by :math:`h u_i` over a depth h. Of
    an opening of width w behind one of width a it leaves, along each axis,

    .. math:: \frac1w \max\bigl(0,\ \min(\tfrac w2, \tfrac a2 + h u_i)
        - \max(-\tfrac w2, -\tfrac a2 + h u_i)\bigr).

    It is a factor of the scene, which is multiplied with it; PSFs keep their shape, of which a
    baffle that shades a part of the mask takes that part's light, too.

    - `down`, `across`: tangents of the angles of the scene's rows and columns, (y, x)/t.
    - `depth`: depth of the walls of a mask's openings (its thickness), or distance from a baffle to
      the mask, mm.
    - `opening`: width of the first edge, mm: of a mask's openings, or of the baffle.
    - `width`: width of the area behind, mm: the mask, for a baffle; by default that of the opening.

    ```python
    import numpy as np
    from thincam_jax.lensless.field import shading

    slopes = np.linspace(-90, 90, 5) / 250  # a scene 180 mm wide at 250 mm
    part = shading(slopes, slopes, depth=0.03, opening=0.06)  # openings of 60 µm in 30 µm
    print(part[2].round(2))  # [0.82 0.91 1.   0.91 0.82]
    ```

    **See also**: `ImagePlane`, `Sensor`.
    """
    depth = float(checks.non_negative("depth", depth, "mm"))
    opening = float(checks.positive("opening", opening, "mm"))
    behind = opening if width is None else float(checks.positive("width", width, "mm"))
    rows, columns = (
        _overlap(depth * checks.numbers(name, given), opening / 2, behind / 2)
        for name, given in (("down", down), ("across", across))
    )
    return rows[:, None] * columns


def _overlap(moved: Float[np.ndarray, " n"], edge: float, half: float) -> Float[np.ndarray, " n"]:
    lit = np.minimum(half, edge + moved) - np.maximum(-half, -edge + moved)
    return np.maximum(lit, 0.0) / (2 * half)


# Points of the field along each axis: odd, so that the axis is one of them.
_LEAST_POINTS, _MOST_POINTS = 3, 21


@checked
@watched("computing PSFs over the field")
def field_operator(
    camera: LenslessCamera,
    light: Spectrum | Number,
    *,
    object_distance: Number = math.inf,
    field_shape: Shape,
    tolerance: float = 1e-2,
    model: Model | PsfMethod = "separable",
) -> LowRankFit:
    r"""Operator from a plane of the object to its capture: each point has its own PSF and light.

    The PSFs of a grid of points, each about the ray through the mask's middle, are written as that
    of the axis and the fewest convolutions for its changes, :math:`h(\mathbf x; \mathbf u) =
    \sum_r w_r(\mathbf u) p_r(\mathbf x - \mathbf u)` (`LowRank`). The points are Chebyshev's, and
    polynomials through them give the weights of every point of the field. A map of the light,
    cos⁴θ and the pixels' angular response, multiplies the weights (`light_over_field`).

    **Arguments**

    - `light`: a `Spectrum`, or one wavelength in mm.
    - `object_distance`: t, mm; at infinity the field's points are directions.
    - `field_shape`: (rows, columns) of the field, on the sensor's pitch: its sample at u is the
      object's point at −u·t/d.
    - `tolerance`: relative L2 error of the PSFs over the field, at most half of it by the
      polynomials, a quarter by the averages over pixels and the rest by the sum of convolutions.
      Where pixels hold some 200 fringes, averages leave more, which is reported. With 1 the PSF is
      that of the axis, and the light that of every point, as most captures allow (`plan_capture`).
    - `model`: model of the PSFs, averaged over the pixels, see `psf`. Cells off both axes are
      sampled, with more samples by `PsfMethod("angular_spectrum", oversampling=...)`.

    **Returns** the operator and its two errors. Numbers must be known: call it outside of jit.

    **Errors**: ValueError for what is out of range, and where 21 points an axis are too few;
    TypeError for lenses, which "separable" does not have off both axes.

    ```python
    import jax.numpy as jnp
    import thincam_jax as tc
    from thincam_jax.units import nm, um

    mask = tc.FresnelZoneAperture(25.0, width=1.0)
    camera = tc.LenslessCamera(mask, tc.Sensor((20, 24), 60 * um), distance=6.5)
    fit = tc.field_operator(camera, 500 * nm, object_distance=250.0, field_shape=(16, 20))
    capture = fit.operator(jnp.ones((16, 20)))
    print(capture.shape)  # (20, 24)
    ```

    **See also**: `psf`, `Recording`, `plan_capture`.
    """
    field_shape = checks.shape2d("field_shape", field_shape)
    tolerance = float(checks.positive("tolerance", tolerance, "parts of one"))
    method = replace(as_method(model, pixel_integration=True), field_tolerance=tolerance)
    spectrum = light if isinstance(light, Spectrum) else Spectrum(light)
    colours = spectrum.colours
    return field_fit(camera, colours, object_distance, field_shape, method)


def field_fit(
    camera: LenslessCamera,
    colours: Sequence[tuple[Number, Number]],
    object_distance: Number,
    field_shape: tuple[int, int],
    method: PsfMethod,
) -> LowRankFit:
    """`field_operator` of (wavelength, weight) pairs; `method` has a `field_tolerance`."""
    assert method.field_tolerance is not None
    tolerance, tangents = method.field_tolerance, tangents_of(camera, field_shape)
    sensor, grid = camera.sensor, kernel_grid(camera.sensor.grid, field_shape)
    place = camera.place  # a camera beside the scene's axis sees it turned
    aside = (0.0, 0.0) if place is None else np.asarray(place / object_distance)
    fall = light_over_field(sensor, *(t + n for t, n in zip(tangents, aside, strict=True)))
    if tolerance >= 1:
        own = spectral_psf(camera, colours, object_distance, method, grid)
        axis = CropConvolution(own[None], sensor.pitch, sensor.shape, field_shape, summed=1)
        return LowRankFit(LowRank(jnp.asarray(fall[None], own.dtype), axis), 1.0, 0.0)
    if checks.holds_traced(camera, colours, object_distance):
        raise TypeError(
            "the PSFs of every point of the field need known numbers: call it outside of jit and "
            "grad, or give field_tolerance = 1 (the light of every point, the PSF of the axis)"
        )
    longest = max(float(np.asarray(w)) for w, _ in colours)
    counts, between = zip(
        *(points_needed(camera, longest, t, tolerance / 2) for t in tangents), strict=True
    )
    places = [_lobatto(t, n) for t, n in zip(tangents, counts, strict=True)]
    scale = float(np.asarray(object_distance))
    scale = 1.0 if math.isinf(scale) else scale

    def psf_at(y: float, x: float) -> Float[Array, "k l"]:
        # The object is turned by 180° on the sensor.
        at = (-scale * y, -scale * x) if y or x or camera.place is not None else None
        return spectral_psf(camera, colours, object_distance, method, grid, at)

    between = max(between) + _averages(camera, colours, object_distance, grid, method)
    left = max(tolerance - between, tolerance / 8)
    maps, kernels, error = _axis_and_changes(_on_grid(camera, places, psf_at), left)
    for axis, (place, every) in enumerate(zip(places, tangents, strict=True)):
        maps = scipy.interpolate.BarycentricInterpolator(place, maps, axis=axis)(every)
    weights = np.moveaxis(maps, -1, 0) * fall
    convolution = CropConvolution(kernels, sensor.pitch, sensor.shape, field_shape, summed=1)
    found = LowRank(jnp.asarray(weights, kernels.dtype), convolution)
    return LowRankFit(found, error, between)


def _averages(
    camera: LenslessCamera, colours, object_distance: Number, grid: Grid, method: PsfMethod
) -> float:
    """Relative error of the averages over pixels that `psf` takes; 0 of samples."""
    if method.model != "separable" or not has_few_terms(camera.mask):
        return 0.0
    path = camera.path(min(float(np.asarray(w)) for w, _ in colours), object_distance)
    tolerance = method.averages_tolerance
    nodes = pixel_nodes(camera.mask, grid, path, method.float_type, tolerance)
    return average_error(camera.mask, grid, path, method.nodes or nodes)


def tangents_of(
    camera: LenslessCamera, field_shape: tuple[int, int]
) -> tuple[Float[np.ndarray, " m"], Float[np.ndarray, " n"]]:
    """Tangents of the angles of the field's rows and columns, of rays through the mask's origin."""
    step = float(camera.sensor.pitch) / float(camera.distance)
    rows, columns = ((np.arange(n) - (n - 1) / 2) * step for n in field_shape)
    return rows, columns


def points_needed(
    camera: LenslessCamera, wavelength: float, tangents: Float[np.ndarray, " n"], tolerance: float
) -> tuple[int, float]:
    r"""Points of the field along one axis whose polynomial is within the tolerance, and its error.

    From the phase that the field gives the finest light of the mask: ERROR_PER_RADIAN of what the
    polynomial leaves of :math:`e^{j\varphi}`.
    """
    finest = camera.mask.finest_frequency
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


def _axis_and_changes(
    grid: Float[Array, "y x k l"], tolerance: float
) -> tuple[Float[np.ndarray, "y x r"], Float[Array, "r k l"], float]:
    """The PSF of the axis and the fewest that its changes are sums of; else as `principal_psfs`.

    The axis' own has the weight 1 everywhere: changes move light and add none, so that what is
    left out of them does not dim the image.
    """
    rows, columns = grid.shape[:2]
    axis = grid[rows // 2, columns // 2]
    changes = grid - axis
    whole, part = (max(float(jnp.linalg.norm(n)), 1e-30) for n in (grid, changes))
    if part <= tolerance * whole:
        return np.ones((rows, columns, 1)), axis[None], part / whole
    maps, kernels, error = principal_psfs(changes, tolerance * whole / part)
    maps = np.concatenate([np.ones((rows, columns, 1)), maps], axis=-1)
    return maps, jnp.concatenate([axis[None], kernels]), error * part / whole


def _on_grid(
    camera: LenslessCamera,
    places: list[Float[np.ndarray, " n"]],
    psf_at: Callable[[float, float], Float[Array, "k l"]],
) -> Float[Array, "y x k l"]:
    """PSFs at every pair of places; a zone plate on the axis is its own mirror image."""
    on_axis = camera.place is None and not np.asarray(camera.mask.centre).any()
    mirrored = zone_orders(camera.mask) is not None and on_axis
    found: dict[tuple[float, float], Float[Array, "k l"]] = {}

    def at(y: float, x: float) -> Float[Array, "k l"]:
        own = (abs(y), abs(x)) if mirrored else (y, x)
        if own not in found:
            found[own] = psf_at(*own)
        turned = [slice(None, None, -1 if a != b else 1) for a, b in zip(own, (y, x), strict=True)]
        return found[own][turned[0], turned[1]]

    return jnp.stack([jnp.stack([at(y, x) for x in places[1]]) for y in places[0]])
