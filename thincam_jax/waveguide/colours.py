r"""Full-colour screens: several gratings, a sensor of several colours, and their cross-talk.

Grating g couples light of the tangential direction cosines **t** into the glass as **p** = **t** −
λ**K**_g/2π, and guided light out again in the directions **t**_k = **p** + λ**K**_k/2π of all
gratings k. With η_k(**t**) of Kogelnik (`efficiency`), the efficiency of g beside the others is

.. math:: C_g = \eta_g \int_0^1 \prod_{k \ne g} (1 - u\,L_k)\,du, \qquad
    1 - L_k = (1 - \eta_k(\mathbf t_g))\,(1 - \eta_k(\mathbf t_k))

the mean over the orders in which light meets the gratings of one film, or of films one on the
other. At each contact on the way Π(1 − η_k(**t**_k)) stays guided, and the channel c of a pixel
gets of the object's primary c′ by order i

.. math:: W_i = \int r_c\,s_{c'}\, C_g\,C_h \Big[\prod_k (1 - \eta_k(\mathbf t_k))\Big]^i d\lambda

by the grating g into the glass and h out of it. With g = h this is light of the pixel's direction
**t**, about the Bragg wavelength of g there: cross-talk where the channel is another grating's.
With g ≠ h it comes from **t** + λ(**K**_g − **K**_h)/2π, a ghost elsewhere on the object.

Independent gratings approximate coupled waves: ∫η² to 0.4 % for lasers 59 nm apart; for 12 and 6
nm, where bands of 9 nm overlap, to 1.4–11 and 11–13 %; without losses it is 8 and 41 % off.
"""

import itertools
import warnings
from typing import Any, Literal, get_args

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy
from jaxtyping import Array, Float, Int

from thincam_jax._core import checks
from thincam_jax._core.module import Module
from thincam_jax._core.precision import AccuracyWarning, product
from thincam_jax._core.quantity import quantity
from thincam_jax.imaging.operators import Sparse
from thincam_jax.units import nm
from thincam_jax.waveguide.camera import ObjectPlane, SeeThroughCamera, seen_size
from thincam_jax.waveguide.efficiency import axial_band, in_blocks, least_nodes, unpolarised
from thincam_jax.waveguide.hologram import VolumeHologram
from thincam_jax.waveguide.lens import lens_views
from thincam_jax.waveguide.rays import at_rear, on_object, pixel_centres, shift, straight_on
from thincam_jax.waveguide.smear import SmearedRays, equal_parts, guided_band, meets
from thincam_jax.waveguide.system import bandwidth, system_matrix

# Neighbouring gratings nearer than so many widths of a band: at Δn of 0.006 to 0.03 and 6 to 24 nm
# apart integrals are up to 15 % off below it, at most 2 % above.
_BANDS = 1.6
_NEAR = (
    "two gratings {:.2g} nm apart, with bands of {:.2g} nm, count as independent: integrals of "
    "their light are up to 15 % off; record them {:.2g} nm apart or more"
)
Crosstalk = Literal["none", "bands", "all"]


class ColourBand(Module):
    """A Gaussian, 1 at its centre: the response of a channel, or the spectrum of a primary.

    - `centre`, `width`: wavelength of the maximum and full width at half of it, mm.
    """

    centre: Float[Array, ""] = eqx.field(converter=quantity("mm", check=checks.wavelength))
    width: Float[Array, ""] = eqx.field(converter=quantity("mm", positive=True))

    def __call__(self, wavelength: Float[Array, "*wave"]) -> Float[Array, "*wave"]:
        return jnp.exp2(-((2 * (wavelength - self.centre) / self.width) ** 2))


def several(kind: type) -> Any:
    """Check of an attribute: a tuple of one or more objects of a kind."""

    def check(name: str, given: Any) -> tuple:
        sound = isinstance(given, list | tuple) and all(isinstance(one, kind) for one in given)
        if not sound or not given:
            shown = checks.shown(given)
            raise TypeError(f"{name} is {shown}; give a list of waveguide.{kind.__name__}")
        return tuple(given)

    return check


class ColourCamera(Module):
    """A see-through camera of several gratings, and the colours that its sensor tells apart.

    - `cameras`: one for each grating, which differ in their hologram alone: in one film, each with
      its own index modulation, or in films one on the other. They count as independent:
      nearer than 1.6 times the width of a band, as 12 nm, integrals are up to 15 % off, and there
      is a `lensless.AccuracyWarning`.
    - `responses`: responses of the sensor's channels. `primaries`: spectra of the object's
      channels, as those of a monitor; None for those of the sensor.
    """

    cameras: tuple[SeeThroughCamera, ...] = eqx.field(
        converter=quantity(check=several(SeeThroughCamera))
    )
    responses: tuple[ColourBand, ...] = eqx.field(converter=quantity(check=several(ColourBand)))
    primaries: tuple[ColourBand, ...] | None = eqx.field(
        default=None, converter=quantity(check=several(ColourBand), optional=True)
    )

    def __check_init__(self):
        first, *others = (eqx.tree_at(lambda c: c.screen.hologram, c, 0) for c in self.cameras)
        if not all(checks.is_traced(c.sensor.pitch) or eqx.tree_equal(c, first) for c in others):
            raise ValueError("cameras differ in more than their hologram; give one, with each")
        if not checks.is_traced(first.direct_band) and first.direct_band > 0:
            raise ValueError(
                "direct light has no colours here; give direct_band=0, or system_operator a list "
                "of cameras whose colours the sensor separates"
            )
        if checks.holds_traced(self.cameras):
            return
        bands = sorted(axial_band(one.screen.hologram) for one in self.cameras)
        for (low, narrow), (high, wide) in itertools.pairwise(bands):
            apart, band = (high - low) / nm, (narrow + wide) / 2 / nm
            if 0 < low and apart < _BANDS * band:
                text = _NEAR.format(apart, band, _BANDS * band)
                warnings.warn(text, AccuracyWarning, stacklevel=4)

    @property
    def channels(self) -> tuple[int, int]:
        """Numbers of them, of captures and of the object."""
        return len(self.responses), len(self.primaries or self.responses)

    @property
    def crosstalk(self) -> tuple[Crosstalk, ...]:
        """Cross-talk that `colour_system` models: "none" with a grating for each channel alone."""
        return get_args(Crosstalk)[{len(self.cameras)} != set(self.channels) :]

    @property
    def gratings(self) -> VolumeHologram:
        """All in one, with a first axis for the gratings."""
        return jax.tree.map(lambda *p: jnp.stack(p), *(c.screen.hologram for c in self.cameras))

    def at(self, lens_point: Float[Array, "2"]) -> "ColourCamera":
        """The camera whose rays cross the lens there."""
        places = [lens_point] * len(self.cameras)
        return eqx.tree_at(lambda c: [one.lens_point for one in c.cameras], self, places)

    @eqx.filter_jit
    def trace(
        self,
        pixels: Float[Array, "*pixel 2"],
        distance: Float[Array, ""],
        out: Int[Array, ""],
        counts: tuple[int, int],
    ) -> tuple[Float[Array, "grating ... 2"], Float[Array, "grating ..."]]:
        """Trace the band of each pixel by each of the gratings that bring the light in.

        Points (grating, order, *pixel, sample, 2) are those of light without its colours, which
        have weights in each sample, (grating, channel, primary, order, *pixel, sample).

        - `out`: number of the grating that brings the light out of the glass.
        - `counts`: orders, and samples.
        """
        points, weight = in_blocks(
            lambda pixel: _one(self, pixel, distance, out, counts), pixels.reshape(-1, 2)
        )
        rays = counts[0], *pixels.shape[:-1], counts[1]
        points = jnp.moveaxis(points, 0, 2).reshape(-1, *rays, 2)
        return points, jnp.moveaxis(weight, 0, 3).reshape(-1, *self.channels, *rays)

    def coupled(self, guided: Float[Array, "*ray 2"], wavelength: Float[Array, "*ray"]):
        """C of each, (grating, 2, *ray) for TE and TM, what stays guided, and directions t_k."""
        films, turns = self.gratings, wavelength[..., None] / (2 * jnp.pi)
        outside = jax.vmap(lambda grating: guided + turns * grating[:2])(films.grating)
        own = jax.vmap(_eta, (0, 0, None))(films, outside, wavelength)
        crossed = jax.vmap(jax.vmap(_eta, (0, None, None)), (None, 0, None))
        lost = 1 - (1 - crossed(films, outside, wavelength)) * (1 - own)
        same = np.eye(len(own), dtype=bool).reshape(*own.shape[:1] * 2, *(1,) * (own.ndim - 1))
        lost = jnp.where(same, 0, lost)
        # The integral by Gauss, exact for eight gratings.
        parts = np.transpose(np.polynomial.legendre.leggauss(4)).tolist()
        share = sum(w / 2 * jnp.prod(1 - (u + 1) / 2 * lost, axis=1) for u, w in parts)
        return own * share, jnp.prod(1 - own, axis=0), outside


def _eta(hologram, tangential, wavelength) -> Float[Array, "2 *ray"]:
    """η for TE and TM; 0 where no light of such direction cosines is in the film."""
    inside = jnp.sum(tangential**2, axis=-1) < 0.998 * hologram.index(wavelength) ** 2
    safe = jnp.where(inside[..., None], tangential, 0)
    return jnp.where(inside, jnp.stack(unpolarised(hologram, safe, wavelength)), 0)


def _one(camera, pixel, distance, out, counts):
    """Points (in, order, sample, 2) and weights (in, colours, order, sample) of one pixel."""
    orders, samples = counts
    film = jax.tree.map(lambda part: part[out], camera.gratings)
    own = eqx.tree_at(lambda c: c.screen.hologram, camera.cameras[0], film)
    nodes = max(least_nodes(orders), 8 * samples)
    _, band, (guided, bounce, _, top, sound) = guided_band(own, pixel, nodes)
    wave = band.wavelengths
    coupled, kept, outside = camera.coupled(guided, wave)
    coupled = coupled * coupled[out]
    primaries = [primary(wave) for primary in camera.primaries or camera.responses]
    colours = [response(wave) * one for response in camera.responses for one in primaries]
    # The rays in air, (x/z, y/z) against the camera, and their displacement along the plate.
    air = jnp.sum(outside**2, axis=-1, keepdims=True)
    outside = jnp.where(air < 1, outside, 0)
    upright = jnp.sqrt(jnp.where(air < 1, 1 - air, 1))
    ray = product(jnp.concatenate([outside, upright], axis=-1), own.plate_axes.T)
    forward = (air < 1) & (ray[..., 2:] > 0)
    slope = ray[..., :2] / jnp.where(forward, ray[..., 2:], 1)
    sound = jnp.where(forward[..., 0], sound, 0)
    glass = own.screen.glass_index(wave)
    start = top - at_rear(own, slope) + own.screen.glass_thickness * shift(outside, glass)
    straight = straight_on(own, slope, distance)
    of_all = jnp.broadcast_to(jnp.stack(colours, axis=-1), (*slope.shape[:-1], len(colours)))

    def contact(passed, odd):
        met = meets(own.screen.bottom, top + odd * bounce)
        arrives = jnp.mean(coupled * passed, axis=1) * met * sound
        ends = straight + on_object(own, slope, start + odd * bounce)
        # The colours of each part are means as its place is.
        columns = jnp.concatenate([ends[..., ::-1], of_all], axis=-1)
        parts, total = jax.vmap(equal_parts, (0, 0, None))(arrives, columns, samples)
        return (1 - met * (1 - kept)) * passed, (parts, total[:, None, None])

    odd = 2 * jnp.arange(orders, dtype=wave.dtype) + 1
    _, (parts, total) = jax.lax.scan(contact, jnp.ones_like(kept), odd)
    weight = jnp.moveaxis(parts[..., 2:] * total * band.step, (1, 3), (0, 1))
    return jnp.moveaxis(parts[..., :2], 1, 0), weight


def colour_system(
    camera: ColourCamera,
    plane: ObjectPlane,
    orders: int = 4,
    samples: int = 8,
    crosstalk: Crosstalk = "all",
    levels: tuple[float, ...] | None = None,
) -> Sparse:
    """The capture (channel, y, x) of a lit object (channel, 1, y, x) in its colours.

    As `system_operator`, which takes a list of cameras whose colours the sensor separates.

    - `crosstalk`: "none": each channel has the light of its own grating and primary alone; "bands":
      whatever each grating diffracts into the glass and out of it; "all": what comes in by one
      grating and out by another, too.
    - `levels`: weight, mm, that counts as 1 in each channel; by default the mean of its pixels, so
      that a white object that fills the field gives captures about 1.
    """
    checks.choice("crosstalk", crosstalk, camera.crosstalk)
    first, shape = camera.cameras[0], camera.channels
    pixels, size = pixel_centres(first), float(seen_size(first, plane))
    blocks: list[list[Any]] = [[None] * shape[1] for _ in range(shape[0])]
    found, counts = np.zeros(shape[0]), (orders, samples)
    views = lens_views(first, [plane], orders)
    for out, view in itertools.product(range(len(camera.cameras)), views):
        seen = camera.at(view.camera.lens_point)
        points, weight = seen.trace(pixels, plane.distance, jnp.asarray(out), counts)
        weight = weight * view.share
        for way, c, p in np.ndindex(weight.shape[:3]):
            if modelled(crosstalk, way, c, p, out):
                rays = SmearedRays(points[way], weight[way, c, p])
                found[c] += bandwidth(rays)
                one = system_matrix(rays, plane, size, 1.0)
                blocks[c][p] = one if blocks[c][p] is None else blocks[c][p] + one
    levels = tuple(found.tolist()) if levels is None else levels
    if not min(levels) > 0:
        raise ValueError(f"channels get {found} mm of bandwidth; give others of some light")
    for row, level in zip(blocks, levels, strict=True):
        row[:] = [None if part is None else part * part.dtype.type(1 / level) for part in row]
    whole = (shape[0], *first.sensor.shape)
    return Sparse(scipy.sparse.block_array(blocks), (shape[1], 1, *plane.shape), whole)


def modelled(crosstalk: Crosstalk, way: Any, channel: Any, primary: int, out: int) -> Any:
    """Whether a channel has the light of a primary that comes in by `way` and goes `out`."""
    own = (channel == out) & (primary == out) | (crosstalk != "none")
    return own & ((way == out) | (crosstalk == "all"))
