r"""Full-colour screens: several gratings, a sensor of several colours, and their cross-talk.

Grating g couples light of the tangential direction cosines **t** into the glass as **p** = **t** −
λ**K**_g/2π, and guided light out again in the directions **t**_k = **p** + λ**K**_k/2π of all
gratings k. With η_k(**t**) of Kogelnik (`efficiency`), the efficiency of g beside the others is

.. math:: C_g = \eta_g \int_0^1 \prod_{k \ne g} (1 - u\,L_k)\,du, \qquad
    1 - L_k = (1 - \eta_k(\mathbf t_g))\,(1 - \eta_k(\mathbf t_k))

the mean over the orders in which light may meet the gratings of one film: what they take together
is 1 − Π(1 − η), no more than there is. Of films one on the other light passes those before g twice,
and C_g = η_g Π_{k<g}(1 − L_k). At each contact on the way Π(1 − η_k(**t**_k)) stays guided, and the
light of the object's primary c′ that the channel c of the pixel **t** gets by order i is

.. math:: W_i = \int r_c\,s_{c'}\, C_g\,C_h \Big[\prod_k (1 - \eta_k(\mathbf t_k))\Big]^i d\lambda

by the grating g into the glass and h out of it. With g = h it comes from the pixel's own direction,
of the band about the Bragg wavelength of g there, and is cross-talk where the channel is another
grating's. With g ≠ h it comes from **t** + λ(**K**_g − **K**_h)/2π: another ghost.

Independent gratings are an approximation of coupled waves: exact without and for complete overlap
of strong or weak gratings, else `tests/waveguide/test_colours.py` says how near.
"""

from collections.abc import Sequence
from typing import Any, Literal, get_args

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy
from jaxtyping import Array, Float, Int

from thincam_jax._core import checks
from thincam_jax._core.checks import Number, Numbers
from thincam_jax._core.module import Module
from thincam_jax._core.precision import product
from thincam_jax._core.quantity import choice, quantity
from thincam_jax.imaging.operators import Sparse
from thincam_jax.waveguide.camera import SeeThroughCamera
from thincam_jax.waveguide.efficiency import in_blocks, least_nodes, unpolarised
from thincam_jax.waveguide.hologram import VolumeHologram
from thincam_jax.waveguide.rays import pixel_centres, shift
from thincam_jax.waveguide.smear import SmearedRays, equal_parts, guided_band
from thincam_jax.waveguide.system import ObjectPlane, seen_size, system_matrix

Profile = Literal["gaussian", "box"]
Crosstalk = Literal["none", "bands", "all"]
CROSSTALK: tuple[Crosstalk, ...] = get_args(Crosstalk)
# Gauss's places and weights of the mean over orders, exact for eight gratings; of films, one order.
_MEAN = tuple(
    (part + shift) / 2
    for part, shift in zip(np.polynomial.legendre.leggauss(4), (1, 0), strict=True)
)
_SEPARATE = ((1.0,), (1.0,))


class ColourBand(Module):
    """A band of the spectrum, 1 at its centre: a sensor's channel or a monitor's primary.

    - `centre`, `width`: of half the height, mm.
    """

    centre: Float[Array, ""] = eqx.field(converter=quantity("mm", check=checks.wavelength))
    width: Float[Array, ""] = eqx.field(converter=quantity("mm", positive=True))
    profile: Profile = eqx.field(
        default="gaussian", converter=choice(get_args(Profile)), static=True
    )

    def __call__(self, wavelength: Float[Array, "*wave"]) -> Float[Array, "*wave"]:
        away = 2 * (wavelength - self.centre) / self.width
        if self.profile == "box":
            return (jnp.abs(away) <= 1).astype(away.dtype)
        return jnp.exp2(-(away**2))


def _bands(name: str, given: Any) -> tuple[ColourBand, ...]:
    if not isinstance(given, list | tuple) or not all(isinstance(b, ColourBand) for b in given):
        raise TypeError(f"{name} is {checks.shown(given)}; give a list of waveguide.ColourBand")
    if not given:
        raise ValueError(f"{name} is empty; give a waveguide.ColourBand for each channel")
    return tuple(given)


def _cameras(name: str, given: Any) -> tuple[SeeThroughCamera, ...]:
    cameras = tuple(given) if isinstance(given, list | tuple) else ()
    if not cameras or not all(isinstance(one, SeeThroughCamera) for one in cameras):
        shown = checks.shown(given)
        raise TypeError(f"{name} is {shown}; give a list of waveguide.SeeThroughCamera")
    first = cameras[0]
    for one in cameras[1:]:
        same = eqx.tree_at(lambda c: c.screen.hologram, one, first.screen.hologram)
        if not checks.holds_traced(given) and not eqx.tree_equal(same, first):
            raise ValueError(
                f"{name} differ in more than their hologram; give one camera, with each"
            )
    return cameras


class ColourCamera(Module):
    """A see-through camera of several gratings, and the colours that its sensor tells apart.

    - `cameras`: one for each grating, which differ in their hologram alone.
    - `responses`: of the sensor's channels. `primaries`: spectra of the object's channels, as those
      of a monitor; None for those of the sensor.
    - `separate`: each grating in a film of its own, the first one next to the glass. False: all in
      one film, each with its own index modulation.

    ```python
    import thincam_jax as tc
    from thincam_jax import waveguide as wg
    from thincam_jax.units import deg, nm, um

    made = {"index": 1.5, "thickness": 16 * um, "index_modulation": 0.012}
    lasers = (633 * nm, 532 * nm, 473 * nm)
    gratings = [wg.VolumeHologram.record(c, 0.0, 61.2 * deg, **made) for c in lasers]
    sensor = tc.Sensor((22, 30), 70.4 * um)
    cameras = [wg.SeeThroughCamera(wg.Screen(g, 5.0, 1.5), sensor, 6.0, 10.0) for g in gratings]
    bands = [wg.ColourBand(c, 70 * nm) for c in (610 * nm, 535 * nm, 465 * nm)]
    camera = wg.ColourCamera(cameras, bands)
    print(camera.efficiencies([0.0, 0.0], 532 * nm))  # of red, green and blue: 0, 0.74, 0
    ```
    """

    cameras: tuple[SeeThroughCamera, ...] = eqx.field(converter=quantity(check=_cameras))
    responses: tuple[ColourBand, ...] = eqx.field(converter=quantity(check=_bands))
    primaries: tuple[ColourBand, ...] | None = eqx.field(
        default=None, converter=quantity(check=_bands, optional=True)
    )
    separate: bool = eqx.field(default=False, static=True)

    @property
    def channels(self) -> tuple[int, int]:
        """Numbers of them, of captures and of the object."""
        return len(self.responses), len(self.primaries or self.responses)

    @property
    def gratings(self) -> VolumeHologram:
        """All in one, with a first axis for the gratings."""
        films = [camera.screen.hologram for camera in self.cameras]
        return jax.tree.map(lambda *parts: jnp.stack(parts), *films)

    def efficiencies(
        self, tangential: Numbers, wavelength: Numbers
    ) -> Float[Array, "grating *ray"]:
        """C of each, unpolarised, for light from air with direction cosines (x, y)."""
        across = checks.points("tangential", tangential)
        wave = jnp.asarray(checks.wavelengths("wavelength", wavelength), across.dtype)

        def one(number, grating):
            guided = across - wave[..., None] / (2 * jnp.pi) * grating[:2]
            return self.coupled(number, guided, wave)[0].mean(axis=0)

        return jax.vmap(one)(jnp.arange(len(self.cameras)), self.gratings.grating)

    def coupled(
        self,
        number: Int[Array, ""],
        guided: Float[Array, "*ray 2"],
        wavelength: Float[Array, "*ray"],
    ) -> tuple[Float[Array, "2 *ray"], Float[Array, "2 *ray"], Float[Array, "*ray 2"]]:
        """C of a grating and what stays guided at a contact, for TE and TM, and **t** outside."""
        films, turns = self.gratings, wavelength[..., None] / (2 * jnp.pi)
        outside = jax.vmap(lambda grating: guided + turns * grating[:2])(films.grating)
        own = jax.vmap(_eta, (0, 0, None))(films, outside, wavelength)
        lost = jax.vmap(_eta, (0, None, None))(films, outside[number], wavelength)
        lost = 1 - (1 - lost) * (1 - own)
        numbers = jnp.arange(len(self.cameras)).reshape(-1, *(1,) * (own.ndim - 1))
        lost = jnp.where(numbers < number if self.separate else numbers != number, lost, 0)
        places, weights = _SEPARATE if self.separate else _MEAN
        share = sum(
            w * jnp.prod(1 - u * lost, axis=0) for u, w in zip(places, weights, strict=True)
        )
        return own[number] * share, jnp.prod(1 - own, axis=0), outside[number]


def _eta(hologram, tangential, wavelength) -> Float[Array, "2 *ray"]:
    """η for TE and TM; 0 where no light of such direction cosines is in the film."""
    inside = jnp.sum(tangential**2, axis=-1) < 0.998 * hologram.index(wavelength) ** 2
    safe = jnp.where(inside[..., None], tangential, 0)
    return jnp.where(inside, jnp.stack(unpolarised(hologram, safe, wavelength)), 0)


class ColourRays(eqx.Module):
    """Rays out of the glass by one grating, for each `grating` that brings them in.

    - `points`: (x, y) on the object's plane, mm, of parts of the light without its colours.
    - `weight`: W of each, mm, times the number of parts.
    """

    points: Float[Array, "grating order *pixel sample 2"]
    weight: Float[Array, "grating channel primary order *pixel sample"]


@eqx.filter_jit
def trace_colours(
    camera: ColourCamera,
    pixels: Float[Array, "*pixel 2"],
    object_distance: Number,
    out: Int[Array, ""],
    counts: tuple[int, int],
    crossed: bool = True,
) -> ColourRays:
    """As `trace_band`, for all colours and gratings.

    - `out`: number of the grating that brings the light out of the glass.
    - `counts`: orders, and samples.
    - `crossed`: into the glass by each of the gratings; False: by that one alone.
    """
    checks.at_least_one(dict(zip(("orders", "samples"), counts, strict=True)))
    distance = checks.positive("object_distance", object_distance, "mm")
    points, weight = in_blocks(
        lambda pixel: _one(camera, pixel, distance, out, (*counts, crossed)), pixels.reshape(-1, 2)
    )
    rays = counts[0], *pixels.shape[:-1], counts[1]
    return ColourRays(
        jnp.moveaxis(points, 0, 2).reshape(-1, *rays, 2),
        jnp.moveaxis(weight, 0, 3).reshape(-1, *camera.channels, *rays),
    )


def _one(camera, pixel, distance, out, counts):
    """Of a pixel, points (in, order, sample, 2) and weights (in, colours, order, sample)."""
    orders, samples, crossed = counts
    film = jax.tree.map(lambda part: part[out], camera.gratings)
    own = eqx.tree_at(lambda c: c.screen.hologram, camera.cameras[0], film)
    light = guided_band(own, pixel, max(least_nodes(orders), 8 * samples))
    wave, width = light.band.wavelengths, own.screen.glass_thickness
    numbers = jnp.arange(len(camera.cameras)) if crossed else out[None]
    coupled, kept, outside = jax.vmap(
        lambda number: camera.coupled(number, light.tangential, wave), out_axes=(0, None, 0)
    )(numbers)
    coupled = coupled * (coupled[out] if crossed else coupled[0])
    primaries = [band(wave) for band in camera.primaries or camera.responses]
    colours = [band(wave) * primary for band in camera.responses for primary in primaries]
    colours = jnp.stack(colours, axis=-1)
    # From the plate's front surface, at (x, y) on it, along the ray in air to the object's plane.
    air = jnp.sum(outside**2, axis=-1, keepdims=True)
    outside = jnp.where(air < 1, outside, 0)
    axes, upright = own.plate_axes, jnp.sqrt(jnp.where(air < 1, 1 - air, 1))
    ray = product(jnp.concatenate([outside, upright], axis=-1), axes.T)
    forward = (air < 1) & (ray[..., 2:] > 0)
    slope = ray[..., :2] / jnp.where(forward, ray[..., 2:], 1)
    crossing = width * shift(outside, own.screen.glass_index(wave))
    sound = jnp.where(forward[..., 0], light.sound, 0)

    def contact(passed, odd):
        met = light.on_bottom(own, odd)
        front = product(light.top + odd * light.bounce + crossing, axes[:, :2].T)
        front = front + width * axes[:, 2]
        ends = front[..., :2] + (width + distance - front[..., 2:]) * slope
        arrives = jnp.mean(coupled * passed, axis=1) * met * sound
        # The colours of each part are means as its place is.
        of_all = jnp.broadcast_to(colours, (*ends.shape[:-1], colours.shape[-1]))
        columns = jnp.concatenate([ends, of_all], axis=-1)
        parts, total = jax.vmap(equal_parts, (0, 0, None))(arrives, columns, samples)
        return (1 - met * (1 - kept)) * passed, (parts, total[:, None, None])

    odd = 2 * jnp.arange(orders, dtype=wave.dtype) + 1
    _, (parts, total) = jax.lax.scan(contact, jnp.ones_like(kept), odd)
    weight = jnp.moveaxis(parts[..., 2:] * total * light.band.step, (1, 3), (0, 1))
    return jnp.moveaxis(parts[..., :2], 1, 0), weight


def require_channels(camera: ColourCamera, crosstalk: Crosstalk) -> None:
    """Refuse to separate colours that are not those of the gratings."""
    checks.choice("crosstalk", crosstalk, CROSSTALK)
    count = len(camera.cameras)
    if crosstalk == "none" and camera.channels != (count, count):
        raise ValueError(
            f"crosstalk = 'none' needs as many gratings ({count}) as channels of the sensor and of "
            f"the object {camera.channels}; take 'bands'"
        )


def colour_system(
    camera: ColourCamera,
    plane: ObjectPlane,
    orders: int = 4,
    samples: int = 8,
    crosstalk: Crosstalk = "all",
    levels: Sequence[float] | None = None,
) -> Sparse:
    """The capture (channel, y, x) of a lit object (channel, 1, y, x) in its colours.

    As `system_operator`, which takes a list of cameras whose colours the sensor separates.

    - `crosstalk`: "none": each channel has the light of its own grating and primary alone; "bands":
      whatever each grating diffracts into the glass and out of it; "all": what comes in by one
      grating and out by another, too.
    - `levels`: what weight, mm, is 1 in each channel; by default the mean of its pixels, so that a
      white object that fills the field gives captures about 1.
    """
    require_channels(camera, crosstalk)
    first, shape = camera.cameras[0], camera.channels
    pixels, size = pixel_centres(first), float(seen_size(first, plane))
    blocks: list[list[Any]] = [[0.0] * shape[1] for _ in range(shape[0])]
    found = np.zeros(shape[0])
    for out in range(len(camera.cameras)):
        crossed = crosstalk == "all"
        counts = orders, samples
        rays = trace_colours(camera, pixels, plane.distance, jnp.asarray(out), counts, crossed)
        for way, c, p in np.ndindex(rays.weight.shape[:3]):
            if crosstalk == "none" and not c == p == out:
                continue
            one = SmearedRays(rays.points[way], rays.weight[way, c, p])
            found[c] += float(jnp.mean(jnp.sum(one.weight, axis=0)))
            blocks[c][p] += system_matrix(one, plane, size, 1.0)
    levels = found if levels is None else levels
    if not min(levels) > 0:
        dark = [c for c, level in enumerate(levels) if not level > 0]
        raise ValueError(
            f"no light reaches the channels {dark} of the sensor; give responses about the "
            "gratings' wavelengths"
        )
    for row, level in zip(blocks, levels, strict=True):
        row[:] = [part / part.dtype.type(level) if np.ndim(part) else None for part in row]
    whole = (shape[0], *first.sensor.shape)
    return Sparse(scipy.sparse.block_array(blocks), (shape[1], 1, *plane.shape), whole)
