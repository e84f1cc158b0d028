r"""The plate of a see-through-screen camera by gradient: glass, holograms and lens.

What a plate is worth is the expected error of the best linear reconstruction. About a pixel the
capture is locally the object convolved with the pixel's ghosts, their smear included, so that with
the points :math:`\mathbf P_{is}` and the weights :math:`W_i` of `waveguide.trace_band`

.. math:: H(\pmb\nu) = \sum_i \frac{W_i}{S}\sum_s e^{2\pi j\,\pmb\nu\cdot
    (\mathbf P_{is} - \mathbf P_{00})}, \qquad
    \frac{\epsilon}{\mathrm{var} f} = \Big\langle \frac{\int d^2\nu\,
    [1/\eta_f + |H|^2/\eta_n]^{-1}}{\int d^2\nu\,\eta_f} \Big\rangle

averaged over the field (thesis Eq 3.48, corrected: ERRATA 3.46; one capture). ν is in cycles/mm on
the object. η_n = σ² A, where A is the area of the object that a pixel sees, and σ² the variance of
shot noise: more light makes it larger, but the ratio to the signal better. The borders of the
object, and what changes over a few ghosts' distance, are left out.
"""

import functools
import math
from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from thincam_jax._core import checks
from thincam_jax._core.arguments import checked
from thincam_jax._core.checks import Number
from thincam_jax._core.module import Module
from thincam_jax._core.quantity import quantity
from thincam_jax._core.random import Key, random_key
from thincam_jax.design.search import best_apart, even_samples, on_cube
from thincam_jax.design.setup import PowerLaw
from thincam_jax.design.stochastic import adam
from thincam_jax.imaging.refractive_index import AbstractIndex
from thincam_jax.imaging.sensor import Sensor
from thincam_jax.units import deg, nm, um
from thincam_jax.waveguide import Screen, SeeThroughCamera, VolumeHologram
from thincam_jax.waveguide.rays import bragg_rays
from thincam_jax.waveguide.smear import trace_band

# Points of the field along y, and along x on one side of the axis.
_FIELD = (5, 3)
# Frequencies along y, both signs, and along x.
_FREQUENCIES = (32, 16)
# Of n sin Θ′ above the critical angle's 1, where half of the light counts: a descent feels the end
# of the guided range before it, where the true loss is a step without a slope.
_MARGIN = 0.02
# Of the glass and the film.
_INDEX = 1.5
# Moments of the object's radiance, whose variance a power law spreads.
_MEAN, _VARIANCE = 0.5, 0.08


class Plate(Module):
    """Free parameters of a see-through-screen camera; lengths in mm, the angle in rad.

    The defaults are those of ERRATA.md, for what the thesis does not give.
    """

    glass_thickness: Float[Array, ""] = eqx.field(
        default=5.0, converter=quantity("mm", positive=True)
    )
    reference_angle: Float[Array, ""] = eqx.field(default=61.2 * deg, converter=quantity("rad"))
    film_thickness: Float[Array, ""] = eqx.field(
        default=16 * um, converter=quantity("mm", positive=True)
    )
    index_modulation: Float[Array, ""] = eqx.field(default=0.02, converter=quantity(positive=True))
    lens_distance: Float[Array, ""] = eqx.field(
        default=10.0, converter=quantity("mm", positive=True)
    )
    focal_distance: Float[Array, ""] = eqx.field(
        default=6.0, converter=quantity("mm", positive=True)
    )

    def camera(
        self,
        sensor: Sensor,
        *,
        wavelength: Number = 532 * nm,
        index: AbstractIndex | Number = _INDEX,
    ) -> SeeThroughCamera:
        """The camera with it: object wave along the normal, film and glass of one index."""
        hologram = VolumeHologram.record(
            wavelength,
            0.0,
            self.reference_angle,
            index=index,
            thickness=self.film_thickness,
            index_modulation=self.index_modulation,
        )
        screen = Screen(hologram, self.glass_thickness, index)
        return SeeThroughCamera(screen, sensor, self.focal_distance, self.lens_distance)


@checked
class PlateLimits(eqx.Module):
    """Between which plates can be made; equal ends fix a number."""

    lower: Plate
    upper: Plate

    def plate(self, point: Float[Array, "6"]) -> Plate:
        """Plate at a point of the unit cube, its axes in the order of the attributes of `Plate`."""
        low, high = (jnp.stack(jax.tree.leaves(end)) for end in (self.lower, self.upper))
        values = low + point.astype(low.dtype) * (high - low)
        return jax.tree.unflatten(jax.tree.structure(self.lower), list(values))


@checked
class Viewing(eqx.Module):
    """Requirements on what the plate images.

    - `sensor`: its pixels. `object_distance`, `object_width`: mm. `cell`: the finest detail, mm,
      whose Nyquist frequency ends the integral.
    - `snr_db`: signal-to-noise ratio of the default plate's captures, dB; another's follows from
      its light.
    - `field_of_view`: least one of plates that `find_plate` finds, along y, rad, half of it on
      either side of the axis; 0 for any.

    **Errors**: ValueError, one line, for what is out of range.
    """

    sensor: Sensor
    object_distance: float = 550.0
    object_width: float = 150.0
    cell: float = 150.0 / 64
    snr_db: float = 30.0
    field_of_view: float = 0.0

    def __check_init__(self):
        for name in ("object_distance", "object_width", "cell"):
            checks.positive(name, getattr(self, name), "mm")
        checks.decibels("snr_db", self.snr_db)
        if not 0 <= self.field_of_view < math.pi:
            raise ValueError(
                f"field_of_view = {self.field_of_view:g} rad; give 0 for any, or less than π"
            )


class Judged(Module):
    """A plate's worth.

    - `error`: expected, as a part of the object's variance. `light`: mean weight ∑W_i, mm.
    - `field_of_view`: along y, rad, to the sensor's edges or to where the glass guides no light;
      holograms are as large as that needs.
    - `ghost_light`: part of the light that comes by ghosts.
    """

    error: Float[Array, ""]
    light: Float[Array, ""]
    field_of_view: Float[Array, ""]
    ghost_light: Float[Array, ""]


def noise_variance(viewing: Viewing, light: Float[Array, ""]) -> Float[Array, ""]:
    """σ² of the captures of a plate of that light, in the units of the weights squared, mm²."""
    reference = _light(_rays(Plate(), viewing))
    power = _MEAN**2 + _VARIANCE
    return 10 ** (-viewing.snr_db / 10) * power * reference * light


@checked
@eqx.filter_jit
def judge_plate(plate: Plate, viewing: Viewing) -> Judged:
    """Expected error and what else is asked of a plate; differentiable in all of its numbers."""
    rays = _rays(plate, viewing)
    dtype = rays.weight.dtype
    light = _light(rays)
    pitch = viewing.sensor.pitch
    seen = pitch * (plate.lens_distance + viewing.object_distance) / plate.focal_distance
    noise = noise_variance(viewing, light) * seen**2
    highest = 1 / (2 * viewing.cell)
    v, u = ((np.arange(n) + 0.5) / n for n in _FREQUENCIES)
    grid = np.stack(np.meshgrid(2 * v - 1, u, indexing="ij"), axis=-1).reshape(-1, 2) * highest
    frequencies = jnp.asarray(grid, dtype)
    density = PowerLaw(2.5)(
        jnp.sum(frequencies**2, axis=-1), jnp.asarray(viewing.object_width, dtype)
    )
    # The half plane of u > 0 holds half of the variance.
    element = 2 * highest**2 / len(grid)
    density = density * _VARIANCE / (2 * jnp.sum(density) * element)
    offset = rays.points - rays.points[:1, :, :1]
    phase = jnp.einsum("ipsc,fc->ipsf", offset, frequencies, precision="highest")
    # Reduced to turns before 2π.
    turns = 2 * jnp.pi * (phase - jax.lax.stop_gradient(jnp.round(phase)))
    shares = rays.weight[..., None] / rays.points.shape[2]
    real = jnp.sum(jnp.sum(jnp.cos(turns), axis=2) * shares, axis=0)
    imaginary = jnp.sum(jnp.sum(jnp.sin(turns), axis=2) * shares, axis=0)
    known = density * (real**2 + imaginary**2) / noise
    error = jnp.mean(jnp.sum(density / (1 + known), axis=-1)) / jnp.sum(density)
    behind = jnp.mean(jnp.sum(rays.weight[1:], axis=0)) / light
    return Judged(error, light, _field_of_view(plate, viewing.sensor), behind)


def _field_of_view(plate: Plate, sensor: Sensor) -> Float[Array, ""]:
    """Angle along y within the sensor's edges, the critical angle and 90° in the glass, rad."""
    edge = jnp.sin(jnp.arctan(sensor.pitch * sensor.shape[0] / 2 / plate.focal_distance))
    least = math.asin(1 / _INDEX)
    ends = plate.reference_angle - least, math.pi / 2 - plate.reference_angle
    sines = (jnp.clip(_INDEX * jnp.sin(end), -edge, edge) for end in ends)
    return jnp.maximum(sum(jnp.arcsin(sine) for sine in sines), 0)


def _with_field_of_view(limits: PlateLimits, viewing: Viewing) -> PlateLimits:
    """Limits of plates with at least the field of view of `viewing`.

    **Errors**: ValueError where none has.
    """
    if not viewing.field_of_view:
        return limits
    half = viewing.field_of_view / 2
    farthest = float(viewing.sensor.pitch) * viewing.sensor.shape[0] / 2 / math.tan(half)
    across = math.asin(math.sin(half) / _INDEX)
    lower, upper = limits.lower, limits.upper
    allowed = {
        "focal_distance": (0.0, farthest),
        "reference_angle": (math.asin(1 / _INDEX) + across, math.pi / 2 - across),
    }
    for name, (least, most) in allowed.items():
        low, high = float(getattr(lower, name)), float(getattr(upper, name))
        if max(low, least) > min(high, most):
            unit, scale = ("mm", 1) if name == "focal_distance" else ("deg", deg)
            raise ValueError(
                f"limits of {name} are {low / scale:.4g} to {high / scale:.4g} {unit}; a field of "
                f"view of {viewing.field_of_view / deg:.4g} deg takes {least / scale:.4g} to "
                f"{most / scale:.4g} {unit}; give limits that reach there, or a smaller field"
            )
        dtype = getattr(lower, name).dtype
        lower = replace(lower, **{name: jnp.asarray(max(low, least), dtype)})
        upper = replace(upper, **{name: jnp.asarray(min(high, most), dtype)})
    return PlateLimits(lower, upper)


def _rays(plate: Plate, viewing: Viewing):
    """Rays from pixels over the field: points (order, pixel, sample, 2), weights (order, pixel)."""
    camera = plate.camera(viewing.sensor, index=_INDEX)
    rows, columns = viewing.sensor.shape
    along = [(np.arange(n) + 0.5) / n for n in _FIELD]
    y, x = (2 * along[0] - 1) * rows / 2, along[1] * columns / 2
    places = np.stack(np.meshgrid(y, x, indexing="ij"), axis=-1).reshape(-1, 2)
    pixels = jnp.asarray(places, plate.glass_thickness.dtype) * viewing.sensor.pitch
    rays = trace_band(camera, pixels, viewing.object_distance, 4, 6)
    guided = bragg_rays(camera, pixels).guided
    above = jnp.sqrt(jnp.sum(guided**2, axis=-1)) - 1
    return replace(rays, weight=rays.weight * jax.nn.sigmoid((above - _MARGIN) / (_MARGIN / 4)))


def _light(rays) -> Float[Array, ""]:
    return jnp.mean(jnp.sum(rays.weight, axis=0))


class FoundPlate(Module):
    """The best plate of a search, its error, and that of each step of the descent that met it."""

    plate: Plate
    error: float
    history: np.ndarray


@checked
def find_plate(
    viewing: Viewing,
    limits: PlateLimits,
    *,
    key: Key,
    starts: int = 4,
    samples: int = 32,
    steps: int = 60,
) -> FoundPlate:
    """The plate of least expected error within limits, by Adam from the best of even samples.

    Plates have at least `viewing.field_of_view`: this narrows the limits of focal distance (the
    sensor's edges) and recording angle (light in the glass from the critical angle to 90°).

    **Errors**: ValueError for limits that cross, or within which no plate has that field of view,
    and for counts below 1.
    """
    key = random_key(key)
    checks.at_least_one({"starts": starts, "samples": samples, "steps": steps})
    for name in Plate.__dataclass_fields__:
        low, high = (float(getattr(end, name)) for end in (limits.lower, limits.upper))
        if not 0 < low <= high:
            raise ValueError(
                f"limits of {name} are {low:g} to {high:g}; give the lower one first, above 0"
            )
    limits = _with_field_of_view(limits, viewing)
    dtype = limits.lower.glass_thickness.dtype
    points = even_samples(6, max(samples, starts), key, dtype)
    values = np.asarray(_errors(limits, viewing, points))
    chosen = points[best_apart(np.asarray(points), values, starts)]
    ended, errors, history = (np.asarray(v) for v in _descend(limits, viewing, chosen, key, steps))
    best = int(np.nanargmin(errors))
    plate = limits.plate(jnp.asarray(ended[best], dtype))
    return FoundPlate(plate, float(errors[best]), history[best])


@jax.jit
def _errors(limits: PlateLimits, viewing: Viewing, points):
    return jax.lax.map(lambda point: judge_plate(limits.plate(point), viewing).error, points)


@functools.partial(jax.jit, static_argnames=("steps",))
def _descend(limits: PlateLimits, viewing: Viewing, points, key, steps: int):
    def loss(y, _):
        value = judge_plate(limits.plate(on_cube(y)), viewing).error
        return jnp.log(value), (value, on_cube(y))

    def one(point):
        # A face is a stationary point of sin².
        begun = jnp.arcsin(jnp.sqrt(jnp.clip(point, 1e-2, 1 - 1e-2)))
        _, (history, places), _ = adam(loss, begun, key, jnp.asarray(0.05, point.dtype), steps)
        best = jnp.nanargmin(history)
        return places[best], history[best], history

    return jax.lax.map(one, points)
