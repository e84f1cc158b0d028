r"""Captures of a design: their responses at the object's frequencies, their light and variance.

Two models, both within the Fresnel approximation:

- on a `Quadrant`, exact: the closed form of the square aperture (`overlaps_of`);
- on `Polar` frequencies, by stationary phase: each pair of orders k > l of the unbounded mask is a
  ring pattern in closed form,

  .. math:: 2\,\mathrm{Re}\Big\{ c_k c_l^*\, \frac{j\pi M^2}{(k-l)\beta}\,
      e^{j\phi(\rho)} \Big\},\qquad
      \phi = \frac{(k-l)\beta s^2}{4} - \frac{[(k+l)\beta s + 2\pi M\rho]^2}{4(k-l)\beta},
      \quad s = \lambda d\rho

  cut off along either axis where the point of the mask that sends light there lies beyond the
  aperture, the edge smoothed over one zone. The uniform background, a peak at
  zero, is left out.

**Crop.** Light of the frequency u of a pair of orders comes from one point of the mask,
M ζ(u) from the shadow's centre, and reaches the sensor for a part q(u) of the object's points only.
What is seen of it is q H; what is cut off, q(1 − q) |H|² η_f, is noise to a reconstruction that is
the same for every point of the object. It is what makes small β worse than their response promises.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float
from numpy.polynomial.legendre import leggauss

from thincam_jax._core.precision import as_complex, phasor
from thincam_jax.design.design import Design
from thincam_jax.design.setup import Frequencies, Polar, Quadrant, Setup
from thincam_jax.lensless.camera import LightPath
from thincam_jax.lensless.masks.base import ZoneOrders, pairs
from thincam_jax.lensless.propagation.separable_transfer import TransferFactors, overlaps_of


class Responses(eqx.Module):
    """Transfer functions of a capture, or of each of many, at each frequency, mm².

    - `whole`: response H(ν/d) of a sensor without end.
    - `seen`: q H, what falls on the sensor on average over the object.
    """

    whole: Float[Array, "*capture row column"]
    seen: Float[Array, "*capture row column"]


@jax.jit  # traced once for the search, its gradient, the ranking and the figures
def responses(design: Design, setup: Setup, frequencies: Frequencies) -> Responses:
    """Real, for the masks are centred."""

    def one(beta, phase, distance, wavelength, factors):
        mask = design.mask(beta, phase)
        path = LightPath(wavelength, distance, setup.object_distance)
        if isinstance(frequencies, Quadrant):
            return _exact(mask.zone_orders(), path, setup, frequencies, factors)
        return _rings(mask.zone_orders(), path, setup, frequencies)

    factors = _factors(design, setup, frequencies) if isinstance(frequencies, Quadrant) else None
    return jax.vmap(one)(design.beta, design.phase, design.distance, design.wavelength, factors)


def _factors(
    design: Design, setup: Setup, frequencies: Quadrant
) -> Complex[Array, "capture pair n"]:
    """One-dimensional factors of the transfer functions of all captures."""
    mask = design.mask(design.beta[0], design.phase[0])
    u = frequencies.axis / design.distance[:, None]
    shift = design.wavelength[:, None] * frequencies.axis
    magnification = (1 + design.distance / setup.object_distance)[:, None]
    factors = overlaps_of(
        mask.zone_orders().orders, design.beta[:, None], design.width, shift, magnification * u
    )
    if setup.pixel_integration:
        magnification = magnification * jnp.sinc(setup.pitch * u)
    factors = jnp.moveaxis(factors * as_complex(magnification), 0, 1)
    # Kept apart: fused into each of the products, they would be computed for each.
    return jax.lax.optimization_barrier(factors)


def _exact(
    zones: ZoneOrders,
    path: LightPath,
    setup: Setup,
    frequencies: Quadrant,
    factors: Complex[Array, "pair n"],
) -> Responses:
    u = frequencies.axis / path.distance
    first, second, weights = pairs(zones.coefficients)
    whole = _product(weights, factors)
    if not setup.crop:
        return Responses(whole, whole)
    orders = np.asarray(zones.orders, u.dtype)
    k, m = (orders[n][:, None] for n in (first, second))
    places = _place(zones, k, np.where(k == m, k + 1, m), path, u)
    parts = jnp.where(k == m, 1.0, seen_part(places, path, setup))
    return Responses(whole, _product(weights, factors * as_complex(parts)))


def _product(weights, factors: Complex[Array, "pair n"]) -> Float[Array, "n n"]:
    return TransferFactors(weights[:, None] * factors, factors).response()


def _rings(zones: ZoneOrders, path: LightPath, setup: Setup, frequencies: Polar) -> Responses:
    rho = frequencies.radius / path.distance
    along = [jnp.abs(f[:, None] * rho) for f in (frequencies.sine, frequencies.cosine)]
    first, second = np.triu_indices(len(zones.orders), 1)
    products = zones.coefficients[first] * zones.coefficients[second].conj()

    @jax.vmap  # one program for all pairs of orders
    def of_pair(k, m, product):
        places = [_place(zones, k, m, path, u) for u in along]
        whole = _ring(zones, k, m, product, path, rho)
        for u, place in zip(along, places, strict=True):
            whole = whole * _open(zones, k, m, path, u, place)
        seen = whole
        for place in places if setup.crop else ():
            seen = seen * seen_part(place, path, setup)
        return whole, seen

    orders = np.asarray(zones.orders, rho.dtype)
    whole, seen = (
        jnp.sum(part, axis=0) for part in of_pair(orders[first], orders[second], products)
    )
    if setup.pixel_integration:
        average = jnp.sinc(setup.pitch * along[0]) * jnp.sinc(setup.pitch * along[1])
        whole, seen = whole * average, seen * average
    return Responses(whole, seen)


def _ring(zones: ZoneOrders, k, m, product, path: LightPath, rho) -> Float[Array, " n"]:
    """The ring pattern of two orders without an edge, of the product of their coefficients."""
    curvature = (k - m) * zones.beta
    s = path.wavelength * path.distance
    tilt = (k + m) * zones.beta * s + 2 * jnp.pi * path.magnification
    phase = (curvature * s**2 / 4 - tilt**2 / (4 * curvature)) * rho**2
    wave = product * phasor(phase)
    # 2 Re{j w π M²/a} = −2 π M²/a · Im w
    return -2 * jnp.pi * path.magnification**2 / curvature * jnp.imag(wave)


def _place(zones: ZoneOrders, k, m, path: LightPath, u):
    """ζ(u): where on the mask, mm from its centre, the light of frequency u ≥ 0 comes from."""
    s = path.wavelength * path.distance * u
    tilt = (k + m) * zones.beta * s + 2 * jnp.pi * path.magnification * u
    return jnp.abs(tilt / (2 * (k - m) * zones.beta))


def _open(zones: ZoneOrders, k, m, path: LightPath, u, place):
    """1 where that point lies in the aperture's overlap with itself, 0 beyond, over one zone."""
    half = (zones.width - path.wavelength * path.distance * u) / 2
    zone = jnp.sqrt(jnp.pi / (jnp.abs(k - m) * zones.beta)) / 4
    return jax.nn.sigmoid((half - place) / zone)


def seen_part(place: Float[Array, "*place"], path: LightPath, setup: Setup):
    """q: the part of the object's width from which that light falls on the sensor."""
    middle = path.magnification * place
    shadow = setup.field * path.distance
    upper = jnp.minimum(setup.sensor_width / 2, middle + shadow / 2)
    lower = jnp.maximum(-setup.sensor_width / 2, middle - shadow / 2)
    return jnp.clip((upper - lower) / shadow, 0.0, 1.0)


# The peak of the uniform background at zero frequency: its lobes, and quadrature nodes over them.
_LOBES, _NODES = 4.0, 48


def spectral_density(setup: Setup, frequencies: Frequencies) -> Float[Array, "*point"]:
    """η_f(ν) of the scene, rad², with the variance `contrast`² over these frequencies."""
    shape = setup.prior(frequencies.squared, setup.field)
    return shape * _unit(setup, frequencies)


def _unit(setup: Setup, frequencies: Frequencies) -> Float[Array, ""]:
    shape = setup.prior(frequencies.squared, setup.field)
    return setup.contrast**2 / jnp.sum(shape * frequencies.weight)


def capture_light(design: Design, setup: Setup) -> Float[Array, " capture"]:
    """Mean of each capture of a scene of mean 1, mm²: light through the object's shadow."""
    shadow = design.width * (1 + design.distance / setup.object_distance)
    return _evenness(design) * jnp.minimum(shadow, setup.field * design.distance) ** 2


def signal_variance(
    design: Design,
    setup: Setup,
    frequencies: Frequencies,
    whole: Float[Array, "capture *point"],
    density: Float[Array, "*point"],
) -> Float[Array, " capture"]:
    r"""Variance of each capture over the sensor, mm⁴.

    :math:`\int \eta_f|H|^2 (1 - \mathrm{sinc}^2 L u\ \mathrm{sinc}^2 L v)`: variation over more
    than the sensor's width L is no variance on it. `density`: η_f, by `spectral_density`.
    """
    power = whole**2 * density * frequencies.weight
    if isinstance(frequencies, Quadrant):
        window = _window(setup, frequencies.axis / design.distance[:, None])
        return jnp.sum(power * (1 - window[:, :, None] * window[:, None, :]), axis=(-2, -1))
    # The rings lie at higher frequencies; the uniform background, which they lack, varies slowly.
    even = jax.vmap(lambda d: _even_variance(design, setup, d))(design.distance)
    return jnp.sum(power, axis=(-2, -1)) + _unit(setup, frequencies) * even


def _even_variance(design: Design, setup: Setup, distance) -> Float[Array, ""]:
    """Response to the uniform background: the object through a square opening, without its mean."""
    shadow = design.width * (1 + distance / setup.object_distance)
    end = _LOBES / shadow
    nodes, weights = leggauss(_NODES)
    u = 0.5 * end * jnp.asarray(nodes + 1, end.dtype)
    both_signs = end * jnp.asarray(weights, end.dtype)
    lobe, window = jnp.sinc(shadow * u), _window(setup, u)
    power = (_evenness(design) * shadow**2 * lobe[:, None] * lobe) ** 2
    power = power * (1 - window[:, None] * window)
    prior = setup.prior((u[:, None] ** 2 + u**2) * distance**2, setup.field)
    return distance**2 * jnp.sum(power * prior * both_signs[:, None] * both_signs)


def _evenness(design: Design) -> Float[Array, ""]:
    """Σ|c_k|²: the irradiance behind the mask without its fringes."""
    mask = design.mask(design.beta[0], design.phase[0])
    return jnp.sum(jnp.abs(mask.zone_orders().coefficients) ** 2)


def _window(setup: Setup, u):
    return jnp.sinc(setup.sensor_width * u) ** 2
