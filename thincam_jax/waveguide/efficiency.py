r"""Diffraction efficiency of a volume hologram.

Kogelnik's coupled waves (Bell Syst. Tech. J. 48, 2909, 1969).

For a lossless reflection hologram and light of direction s in the film (β = 2πn/λ),

.. math:: \eta = \Big[1 + \frac{1 - \xi^2/\nu^2}{\sinh^2\sqrt{\nu^2-\xi^2}}\Big]^{-1}, \quad
    \nu = \frac{\pi\,\Delta n\,T\,p}{\lambda\sqrt{c_R|c_S|}}, \quad
    \xi = \frac{\vartheta T}{2|c_S|}, \quad
    \vartheta = \mathbf s\cdot\mathbf K - |\mathbf K|^2/2\beta

with c_R = s_z, c_S = s_z − K_z/β, and p = 1 for light polarised across the plane of incidence (TE)
or |s·s′| within it (TM). It holds for films of many fringes, as long as only one order is near to
the Bragg condition.

For TM, s′ is the ray mirrored at the fringes also off the Bragg condition, where the wave vector
βs − K of the diffracted wave has another direction. With that direction η differs by up to 0.007 at
Δn = 0.02 and 0.015 at 0.03 (film of 16 µm, rays within 10° in air); ghost weights by 0.1 %.

Off the Bragg condition ϑ is of first order. Against rigorous coupled waves (TE, four orders, the
same film and rays) η differs by up to 0.03, 0.08, 0.17 at Δn = 0.012, 0.02, 0.03, its integral over
the band by 0.7 % at most. The diffracted wave that leaves the film along :math:`\mathbf s_d`, with
the tangential part of βs − K, has the exact phase

.. math:: \xi = \tfrac T2\,(\beta s_z + \beta |s_{d,z}| - K_z), \qquad c_S = s_{d,z}

("exact"): 0.0013, 0.007, 0.027, and 0.14 %.
"""

import math
import warnings
from collections.abc import Callable
from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from thincam_jax._core import checks
from thincam_jax._core.arguments import checked
from thincam_jax._core.precision import AccuracyWarning, phasor
from thincam_jax.waveguide.hologram import VolumeHologram, directions

Polarisation = Literal["TE", "TM"]
Phase = Literal["kogelnik", "exact"]

# Difference of the two phases from which single rays are warned of.
_OFF = 0.033
_STRONG = (
    "η by Kogelnik's phase is {:.2f} off at an index modulation of {:.3g}: give phase='exact' for "
    "single rays; integrals over the band hold to 1 %"
)
# Rays whose bands are in memory together.
_RAYS = 384


@checked
def diffraction_efficiency(
    hologram: VolumeHologram,
    tangential: Float[Array, "*ray 2"],
    wavelength: Float[Array, "*ray"],
    polarisation: Polarisation = "TE",
    phase: Phase = "kogelnik",
) -> Float[Array, "*ray"]:
    """η of light from air with direction cosines (x, y), at a wavelength in mm: from 0 to 1.

    0 where no wave is diffracted back (c_S ≥ 0): there it would be a transmission hologram.

    - `phase`: "kogelnik", as bands and ghost weights have it: within 0.03 of rigorous coupled waves
      at Δn = 0.012, 0.08 at 0.02, 0.17 at 0.03, integrals within 0.7 %. "exact", of the diffracted
      wave's own direction, for single rays: 0.0013, 0.007, 0.027 (TE; a film of 16 µm). Where the
      two differ by over 0.033, a `lensless.AccuracyWarning` says so, but of traced rays.
    """
    checks.choice("polarisation", polarisation, ("TE", "TM"))
    exact = checks.choice("phase", phase, ("kogelnik", "exact")) == "exact"
    strength, detuning, overlap, reflected = _coupling(hologram, tangential, wavelength, exact)
    overlap = overlap if polarisation == "TM" else 1.0
    found = _efficiency(strength * overlap, detuning, reflected)
    if not exact and not checks.holds_traced((hologram, tangential, wavelength)):
        other = diffraction_efficiency(hologram, tangential, wavelength, polarisation, "exact")
        if (off := float(jnp.max(jnp.abs(found - other), initial=0.0))) > _OFF:
            text = _STRONG.format(off, float(jnp.max(hologram.index_modulation)))
            warnings.warn(text, AccuracyWarning, stacklevel=4)
    return found


@checked
def ghost_weights(
    hologram: VolumeHologram, tangential: Float[Array, "*ray 2"], orders: int
) -> Float[Array, "order *ray"]:
    r"""Bandwidth, mm, of white light that reaches a pixel after i undiffracted contacts.

    .. math:: W_i = \int \eta^2 (1-\eta)^i\,d\lambda

    for light that both holograms diffract, unpolarised: the mean of TE and TM, each kept through.
    (Rays out of the plane of the recording mix the two a little.) The weight at the peak is not it:
    there 1 − η is near 0. By the trapezoidal rule in ξ, up to |ξ| = 10π, beyond which there is less
    than 1e-3. Its own error grows with the peaks of 1 − η, which are narrow in strong films: of W₁
    1e-6 at ν = 3, 1e-4 at ν = 7, 2e-3 at ν = 14.
    """
    checks.at_least_one({"orders": orders})
    centre, found = hologram.bragg_wavelength(tangential)
    return jnp.where(found, weights_about(hologram, tangential, centre, orders), 0.0)


def weights_about(
    hologram: VolumeHologram,
    tangential: Float[Array, "*ray 2"],
    centre: Float[Array, "*ray"],
    orders: int,
) -> Float[Array, "order *ray"]:
    """`ghost_weights` of rays whose Bragg wavelength is known.

    Node by node for all rays, TE and TM separately: sums over nodes and stacks of the two in a loop
    take XLA nine times as long on a CPU.
    """
    slope, nodes = _band_slope(hologram, tangential, centre), least_nodes(orders)

    @jax.checkpoint  # or derivatives would keep every node of every ray
    def contributions(offset):
        te, tm = unpolarised(hologram, tangential, centre + offset / slope)
        parts = [0.5 * (te**2 * (1 - te) ** k + tm**2 * (1 - tm) ** k) for k in range(orders)]
        return tuple(parts)

    def added(totals, offset):
        return tuple(t + p for t, p in zip(totals, contributions(offset), strict=True)), None

    zero = (jnp.zeros_like(slope),) * orders
    totals, _ = jax.lax.scan(added, zero, _offsets(nodes, slope.dtype))
    return jnp.stack(totals) * _step(slope, nodes)


def least_nodes(orders: int) -> int:
    """Nodes of a band: equal up to 32 orders, so that fewer of them change nothing else."""
    return max(20 * (4 + orders), 720)


def in_blocks(function: Callable[..., Any], *rays: Float[Array, "ray ..."]):
    """A function of one ray for all, (ray, …), some hundreds at a time for the memory."""
    count = rays[0].shape[0]
    blocks = max(1, math.ceil(count / _RAYS))
    size = math.ceil(count / blocks)

    def divided(array):
        ends = [(0, blocks * size - count)] + [(0, 0)] * (array.ndim - 1)
        return jnp.pad(array, ends, mode="edge").reshape(blocks, size, *array.shape[1:])

    found = jax.lax.map(lambda block: jax.vmap(function)(*block), tuple(map(divided, rays)))
    return jax.tree.map(lambda array: array.reshape(-1, *array.shape[2:])[:count], found)


class Band(eqx.Module):
    """The light that both holograms diffract towards a pixel, sampled evenly in wavelength.

    - `wavelengths`: (*ray, node), mm. `step`: between neighbours, mm, (*ray).
    - `eta`: the efficiency for TE and for TM, (2, *ray, node).
    """

    wavelengths: Float[Array, "*ray node"]
    step: Float[Array, "*ray"]
    eta: Float[Array, "2 *ray node"]


def band_about(
    hologram: VolumeHologram,
    tangential: Float[Array, "*ray 2"],
    centre: Float[Array, "*ray"],
    nodes: int,
) -> Band:
    """Band about the Bragg wavelengths, from ξ = −10π to 10π in `nodes` even steps."""
    slope = _band_slope(hologram, tangential, centre)
    wavelengths = centre[..., None] + _offsets(nodes, slope.dtype) / slope[..., None]
    eta = jnp.stack(unpolarised(hologram, tangential[..., None, :], wavelengths))
    return Band(wavelengths, _step(slope, nodes), eta)


def _offsets(nodes: int, dtype):
    """ξ of the nodes, which is linear in λ but for dispersion and the change of c_S."""
    return jnp.linspace(-10 * math.pi, 10 * math.pi, nodes + 1, dtype=dtype)


def _step(slope, nodes: int):
    return 20 * math.pi / nodes / jnp.abs(slope)


def unpolarised(hologram: VolumeHologram, tangential: Array, wavelength: Array) -> list[Array]:
    """η for TE and for TM, as of `diffraction_efficiency`."""
    strength, detuning, overlap, reflected = _coupling(hologram, tangential, wavelength)
    return [_efficiency(nu, detuning, reflected) for nu in (strength, strength * overlap)]


def _coupling(hologram, tangential, wavelength, exact=False):
    """ν of TE, ξ, the factor |s·s′| of ν for TM, and whether a wave is diffracted back."""
    index, power = hologram.index(wavelength), jnp.sum(hologram.grating**2)
    upright = jnp.sqrt(index**2 - jnp.sum(tangential**2, axis=-1))
    incident = upright / index
    level = jnp.sum(tangential * hologram.grating[:2], axis=-1)
    along = (level + upright * hologram.grating[2]) / index  # s·K
    wavenumber = 2 * jnp.pi * index / wavelength
    back = hologram.grating[2] / wavenumber - incident  # −c_S
    reflected = back > 0
    detuning = along - power / (2 * wavenumber)
    if exact:
        leaving = wavenumber[..., None] / index[..., None] * tangential - hologram.grating[:2]
        squared = 1 - jnp.sum((leaving / wavenumber[..., None]) ** 2, axis=-1)
        reflected &= squared > 0
        back = jnp.sqrt(jnp.where(reflected, squared, 1.0))
        detuning = (wavenumber * (incident + back) - hologram.grating[2]) * back
    back = jnp.where(reflected, back, 1.0)
    strength = jnp.pi * hologram.index_modulation * hologram.thickness / wavelength
    overlap = jnp.abs(1 - 2 * along**2 / jnp.where(power > 0, power, 1))
    return (
        strength / jnp.sqrt(incident * back),
        detuning * hologram.thickness / (2 * back),
        overlap,
        reflected,
    )


def _band_slope(hologram, tangential, wavelength):
    """dξ/dλ at a Bragg wavelength, without the slope of the index; infinite without fringes."""
    index = hologram.index(wavelength)
    direction = directions(tangential, index)
    back = jnp.abs(hologram.diffracted(direction)[..., 2])
    slope = -jnp.sum(hologram.grating**2) / (4 * jnp.pi * index)
    slope = slope * hologram.thickness / (2 * back)
    return jnp.where(slope == 0, jnp.inf, slope)


def axial_band(hologram: VolumeHologram) -> tuple[float, float]:
    """Bragg wavelength along the normal and width of its band from zero to zero, mm; 0 if none."""
    axis, power = jnp.zeros(2, hologram.grating.dtype), float(jnp.sum(hologram.grating**2))
    tilt = 4 * math.pi * float(hologram.grating[2]) / power if power > 0 else 0.0
    if tilt <= 0:
        return 0.0, 0.0
    wave = jnp.asarray(1.5 * tilt, axis.dtype)
    for _ in range(3):  # the index changes little within its band
        wave = tilt * hologram.index(wave)
    strength = _coupling(hologram, axis, wave)[0]  # η is 0 where ξ² = ν² + π²
    width = 2 * jnp.sqrt(strength**2 + math.pi**2) / jnp.abs(_band_slope(hologram, axis, wave))
    return float(wave), float(width)


def _efficiency(strength, detuning, reflected):
    """η = ν²g/(1 + ν²g) with g = sinh²(√x)/x, x = ν² − ξ²: one expression for all x."""
    x = strength**2 - detuning**2
    x = jnp.minimum(x, 1e3)  # beyond it η is 1 to all digits, and sinh² overflows
    small = jnp.abs(x) < 1e-4
    root = jnp.sqrt(jnp.where(small, 1.0, jnp.abs(x)))
    grown = jnp.exp(jnp.minimum(root, 32.0))
    ratio = jnp.where(x > 0, (grown - 1 / grown) / 2, phasor(root).imag) / root
    ratio = jnp.where(small, 1 + x / 6, ratio)
    coupled = strength**2 * ratio**2
    return jnp.where(reflected, coupled / (1 + coupled), 0.0)
