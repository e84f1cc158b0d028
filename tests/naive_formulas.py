"""Formulas as textbooks have them, which fail at extremes where the package's do not."""

import extremes
import jax
import jax.numpy as jnp
import numpy as np
import scipy.special
from extremes import PARAMETERS, Extreme

from thincam_jax._core.precision import phasor
from thincam_jax.lensless.masks.base import require_zone_orders


def axes(extreme: Extreme, dtype):
    """The camera's numbers and the coordinates of rows and columns, in that precision."""
    camera = {name: dtype(getattr(extreme, name)) for name in PARAMETERS}
    scale = 1 + camera["distance"] / camera["object_distance"]
    y, x = (
        (np.arange(n, dtype=dtype) - dtype((n - 1) / 2)) * dtype(extreme.pitch) - scale * dtype(c)
        for n, c in zip(extreme.shape, extreme.centre, strict=True)
    )
    return camera, scale, y, x


def irradiance(axis_field, camera, scale, y, x):
    """|Σ c_k A_k(y) A_k(x)|² of unscaled factors, φ on the rows."""
    field = sum(
        c * np.outer(axis_field(k, y, k * camera["phase"]), axis_field(k, x, 0 * camera["phase"]))
        for k, c in extremes.COSINE.items()
    )
    return np.abs(field * (scale / (camera["wavelength"] * camera["distance"]))) ** 2


def square(g, b, points, width, phase):
    """e^{j(g b x²/a + φ)} times Fresnel integrals of √(2|a|/π)(ξ − bx/a), as in the textbooks."""
    a = g + b
    root = np.sqrt(2 * abs(a) / np.pi)
    ends = [root * (side * width / 2 - b * points / a) for side in (-1, 1)]
    (s_low, c_low), (s_high, c_high) = (scipy.special.fresnel(end) for end in ends)
    integral = ((c_high - c_low) + 1j * np.sign(a) * (s_high - s_low)) / root
    return np.exp(1j * (g * b * points**2 / a + phase)) * integral


def completed_square(extreme: Extreme, dtype):
    """The square with the source's curvature in g."""
    camera, scale, y, x = axes(extreme, dtype)
    b, s = (np.pi / (camera["wavelength"] * camera[z]) for z in ("distance", "object_distance"))

    def axis_field(k, points, phase):
        return square(k * camera["beta"] + s, b, points, camera["width"], phase)

    return irradiance(axis_field, camera, scale, y, x)


def sampled_mask(extreme: Extreme, dtype, samples=1024, piston=False):
    """A midpoint sum over the mask; with `piston` under the full phase k(d + √(t² + ξ²))."""
    camera, scale, y, x = axes(extreme, dtype)
    b, s = (np.pi / (camera["wavelength"] * camera[z]) for z in ("distance", "object_distance"))
    cell = camera["width"] / samples
    xi = (np.arange(samples, dtype=dtype) - dtype((samples - 1) / 2)) * cell
    way = s * xi**2
    if piston:
        t = camera["object_distance"]
        source = np.sqrt(t**2 + xi**2) if np.isfinite(t) else 0 * xi
        way = 2 * np.pi / camera["wavelength"] * (camera["distance"] + source)

    def axis_field(k, points, phase):
        mask = way + (k * camera["beta"] * xi**2 + phase)
        return np.array([np.exp(1j * (mask + b * (p - xi) ** 2)).sum() * cell for p in points])

    return irradiance(axis_field, camera, scale, y, x)


def whole_path(extreme: Extreme, dtype):
    """As `sampled_mask`, with the piston, and fine enough for every extreme that names it."""
    return sampled_mask(extreme, dtype, samples=2**15, piston=True)


def one_lens(extreme: Extreme, dtype):
    """A plane wave over td/(t + d), seen on the scale (t + d)/t."""
    camera, _, y, x = axes(extreme, dtype)
    t, d = camera["object_distance"], camera["distance"]
    scale = (t + d) / t
    camera = {**camera, "distance": t * d / (t + d)}
    b = np.pi / (camera["wavelength"] * camera["distance"])

    def axis_field(k, points, phase):
        return square(k * camera["beta"], b, points / scale, camera["width"], phase)

    return irradiance(axis_field, camera, dtype(1), y, x)


def added_phase(extreme: Extreme, dtype):
    """The shadow ¼(1 + cos(βr²/M² + φ))², the phase added before the cosine."""
    camera, scale, y, x = axes(extreme, dtype)
    inside = np.outer(*(abs(p) <= scale * camera["width"] / 2 for p in (y, x)))
    r2 = (y[:, None] ** 2 + x**2) / scale**2
    return inside * ((1 + np.cos(camera["beta"] * r2 + camera["phase"])) / 2) ** 2


def pixel_ends(extreme: Extreme, dtype):
    """The shadow's averages from Fresnel integrals at a pixel's two ends, on the mask's scale."""
    camera, scale, *both = axes(extreme, dtype)
    pitch = dtype(extreme.pitch)
    total = dtype(3 / 8) * np.outer(*(average(0, p, pitch, scale, camera) for p in both))
    for m, weight in ((1, 1 / 2), (2, 1 / 8)):
        rows, columns = (average(m * camera["beta"], p, pitch, scale, camera) for p in both)
        phase = np.exp(1j * m * camera["phase"])
        total = total + dtype(weight) * (phase * np.outer(rows, columns)).real
    return total


def average(g, points, pitch, scale, camera):
    """e^{jgξ²} averaged between a pixel's ends."""
    half = camera["width"] / 2
    low, high = (np.clip((points + s * pitch / 2) / scale, -half, half) for s in (-1, 1))
    if g == 0:
        return (high - low) * scale / pitch
    root = np.sqrt(2 * g / np.pi)
    (s_low, c_low), (s_high, c_high) = (scipy.special.fresnel(root * end) for end in (low, high))
    return ((c_high - c_low) + 1j * (s_high - s_low)) / root * scale / pitch


NAIVE = {
    "completed square": completed_square,
    "sampled mask": sampled_mask,
    "whole path": whole_path,
    "one lens": one_lens,
    "added phase": added_phase,
    "pixel's ends": pixel_ends,
}


def harmonic_response(mask, path, harmonic: int, frequency_squared):
    r"""Response of a harmonic m > 0 of the captures over the mask's phase (`harmonic_otf`), mm².

    For ρ² in cycles²/mm² on the sensor. The pairs of orders that differ by m share a carrier, with
    X = π²ρ²/β, ε = βλd/π (and β/M² for β, ε/M for ε from a near point):

    .. math::
        H_m = \frac{j\pi}{m\beta} \sum_{k-l=m} c_k c_l^*\, e^{-j(X/m)(1+k\epsilon)(1+l\epsilon)}

    with the mask's own phase in the c_k; exact for the unbounded mask. Behind a finite one it ends
    at mβR/π, R half its width. To first order in ε the sum is that of two copies of the mask
    shifted apart; for the binary profile

    .. math::
        H_m \approx \frac{j}{m^2\beta}\, e^{-jX/m} \times \begin{cases}
            \sin(m\pi/2)\,\cos(\pi\lambda d\rho^2) & m\ \text{odd}\\
            -\cos(m\pi/2)\,\sin(\pi\lambda d\rho^2) & m\ \text{even},\
                \lambda d\rho^2 < m/2
        \end{cases}

    The odd ones are so to all orders, since 0 is the only even order of the binary profile, and
    share their zeros. The even ones, which the geometric shadow lacks, are largest there.
    """
    zones = require_zone_orders(mask, "closed_form")
    orders = zones.orders
    found = [
        (orders.index(low + harmonic), place)
        for place, low in enumerate(orders)
        if low + harmonic in orders
    ]
    if harmonic < 1:
        raise ValueError(f"harmonic = {harmonic}; give a whole number from 1 on")
    squared = jnp.asarray(frequency_squared, zones.beta.dtype)[..., None]
    first, second = np.asarray(found, int).reshape(-1, 2).T
    k = jnp.asarray(orders, dtype=zones.beta.dtype)
    gain = 1 + k * path.epsilon(zones.beta)
    beta = harmonic * zones.beta / path.magnification**2
    phases = phasor(-(jnp.pi**2) * squared / beta * gain[first] * gain[second])
    weights = zones.coefficients[first] * zones.coefficients[second].conj()
    quadrature = jax.lax.complex(jnp.zeros_like(beta), jnp.pi / beta)
    return jnp.sum(weights * phases, axis=-1) * quadrature
