r"""The band of colours of each pixel, and the object points that they come from.

A film diffracts a band of wavelengths. The boundary conditions at its plane surfaces keep the
tangential component of the wave vector up to that of the fringes, so that light of the wavelength
λ, on or off the Bragg condition, is guided with

.. math:: \mathbf p(\lambda) = \mathbf t - \frac{\lambda}{2\pi}\mathbf K_{xy}

The second hologram gives K back: all colours of a pixel leave in the same direction **t**, but
from other places. A pixel's ghost is smeared along the screen by what the path (2i + 1) w p/√(n² −
p²) changes over the band, with the weight η²(1−η)^i of each wavelength.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from thincam_jax._core import checks
from thincam_jax._core.checks import Number
from thincam_jax.waveguide.camera import Rectangle, SeeThroughCamera
from thincam_jax.waveguide.efficiency import band_about, in_blocks, least_nodes
from thincam_jax.waveguide.rays import RayStatus, at_rear, bragg_rays, on_object, shift, straight_on


class SmearedRays(eqx.Module):
    """Object points of a pixel's light, by order.

    - `points`: (y, x) on the object's plane, mm, of equal parts of the light, (order, *pixel,
      sample, 2).
    - `weight`: ∫ η²(1−η)^m dλ over the guided light that meets the holograms, (order, *pixel), mm;
      where samples have colours, as many times that of each.
    """

    points: Float[Array, "order *pixel sample 2"]
    weight: Float[Array, "order ..."]


@eqx.filter_jit
def trace_band(
    camera: SeeThroughCamera,
    pixels: Float[Array, "*pixel 2"],
    object_distance: Number,
    orders: int = 4,
    samples: int = 8,
) -> SmearedRays:
    """Trace the whole band of each pixel in place of its Bragg wavelength.

    The light of a pixel and order is divided into `samples` equal parts from one end of the band to
    the other, each at the mean of where it comes from: the mean over the band is exact with one
    sample already. Every wavelength is held to the critical angle and to the holograms' extents by
    itself, so that a pixel may lose a part of its band.
    """
    checks.at_least_one({"orders": orders, "samples": samples})
    distance = checks.positive("object_distance", object_distance, "mm")
    nodes = max(least_nodes(orders), 8 * samples)
    centres, parts, weight = in_blocks(
        lambda pixel: _one(camera, pixel, distance, (orders, samples, nodes)), pixels.reshape(-1, 2)
    )
    points, shape = centres[:, None, None, :] + parts, pixels.shape[:-1]
    return SmearedRays(
        jnp.moveaxis(points, 1, 0).reshape(orders, *shape, samples, 2),
        weight.T.reshape(orders, *shape),
    )


@eqx.filter_jit
def direct_rays(
    camera: SeeThroughCamera, pixels: Float[Array, "*pixel 2"], object_distance: Number
) -> SmearedRays:
    """Light that comes straight through the plate past its cover, as if it were one ghost.

    It has the weight `direct_band`: the nanometres that the top hologram diffracts are not missing.
    """
    distance = checks.positive("object_distance", object_distance, "mm")
    screen, rays = camera.screen, bragg_rays(camera, pixels)
    across = screen.glass_thickness * shift(rays.across, screen.glass_index(rays.wavelength))
    ends = straight_on(camera, rays.slope, distance) + on_object(camera, rays.slope, across)
    weight = jnp.broadcast_to(camera.direct_band, rays.wavelength.shape)
    if screen.cover is not None:
        stopped = screen.cover.holds((at_rear(camera, rays.slope) + across)[..., ::-1])
        weight = jnp.where(stopped, 0, weight)
    return SmearedRays(ends[None, ..., None, ::-1], weight[None])


def _one(camera, pixel, distance, counts):
    """The centre (2) of a pixel's samples, their offsets (order, sample, 2), and weights."""
    orders, samples, nodes = counts
    rays, band, (_, bounce, crossing, top, sound) = guided_band(camera, pixel, nodes)

    def contact(passed, odd):
        met = meets(camera.screen.bottom, top + odd * bounce)
        light = jnp.mean(band.eta**2 * passed, axis=0) * met * sound
        ends = on_object(camera, rays.slope, odd * bounce + 2 * crossing)[..., ::-1]
        return (1 - met * band.eta) * passed, equal_parts(light, ends, samples)

    odd = 2 * jnp.arange(orders, dtype=sound.dtype) + 1
    _, (parts, weight) = jax.lax.scan(contact, jnp.ones_like(band.eta), odd)
    return straight_on(camera, rays.slope, distance)[::-1], parts, weight * band.step


def guided_band(camera: SeeThroughCamera, pixel: Float[Array, "2"], nodes: int):
    """The Bragg ray of a pixel, its band, and of each node of that: **p**, the paths along the
    plate of guided light and of that before it, the place on the top hologram, and its share that
    is guided and meets that."""
    screen = camera.screen
    hologram, width = screen.hologram, screen.glass_thickness
    rays = bragg_rays(camera, pixel)
    across, centre, guided = rays.across, rays.wavelength, rays.guided
    band = band_about(hologram, across, centre, nodes)
    away = (centre - band.wavelengths)[:, None] * hologram.grating[:2] / (2 * jnp.pi)
    glass, at_centre = screen.glass_index(band.wavelengths), screen.glass_index(centre)
    tangential = guided + away
    # n_g² − p² from that of the Bragg wavelength, whose digits are not cancelled.
    left = rays.left + (glass - at_centre) * (glass + at_centre)
    left = left - jnp.sum(away * (tangential + guided), axis=-1)
    carried = left > 0
    bounce = width * tangential / jnp.sqrt(jnp.where(carried, left, 1))[:, None]
    crossing = width * shift(across, glass)
    top = at_rear(camera, rays.slope) + crossing
    sound = _covered(left) * _covered(jnp.sum(tangential**2, -1) - 1) * meets(screen.top, top)
    sound = jnp.where(carried & (rays.fault != RayStatus.NO_BRAGG_MATCH), sound, 0)
    return rays, band, (tangential, bounce, crossing, top, sound)


def meets(hologram: Rectangle | None, places: Float[Array, "node 2"]) -> Float[Array, " node"]:
    """Share of the light about each node, at (x, y), that meets a hologram."""
    if hologram is None:
        return jnp.ones(places.shape[0], places.dtype)
    away = jnp.abs(places[:, ::-1] - hologram.centre)
    return _covered(jnp.min(hologram.size / 2 - away, axis=-1))


def _covered(margin):
    """Share of each node's step with a positive margin: an edge between two nodes is halved.

    Without it an edge would jump from node to node, and no small number of nodes would do.
    """
    change = jnp.abs(jnp.asarray(jnp.gradient(margin)))
    part = jnp.clip(0.5 + margin / jnp.where(change > 0, change, 1), 0, 1)
    return jnp.where(change > 0, part, (margin > 0).astype(margin.dtype))


def equal_parts(light: Array, ends: Array, samples: int):
    """Means of `ends` in `samples` equal parts of a distribution, (sample, n), and its sum."""
    total = jnp.sum(light)
    share = light / jnp.where(total > 0, total, 1)
    middle = jnp.matmul(share, ends, precision="highest")
    below = jnp.concatenate([jnp.zeros(1, share.dtype), jnp.cumsum(share)])
    moments = jnp.cumsum(share[:, None] * (ends - middle), axis=0)
    moments = jnp.concatenate([jnp.zeros_like(moments[:1]), moments])
    marks = jnp.linspace(0, 1, samples + 1, dtype=share.dtype) * below[-1]
    at = jax.vmap(jnp.interp, (None, None, 1), 1)(marks, below, moments)
    return middle + samples * jnp.diff(at, axis=0), total
