r"""The finite chirp integral: the one closed form on which the exact models rest.

Every field behind a square Fresnel zone aperture, and every pixel average of a chirp, is a
product of two one-dimensional integrals

.. math::
    I(x) = \int_{\xi_1}^{\xi_2} \exp\{ j [ g \xi^2 + b (x - \xi)^2 ] \} \, d\xi .

:math:`g` (rad/mm²) collects what acts at the mask, a zone order :math:`k\beta` and a spherical wave
:math:`\pi/(\lambda t)`; :math:`b = \pi/(\lambda d)` is the Fresnel propagation over :math:`d`.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float
from numpy.polynomial.legendre import leggauss

from thincam_jax._core.precision import as_complex, phasor

# The phase across the interval, in rad, below which quadrature is used instead of edge terms.
# Edge terms diverge like 1/phase as the interval's phase goes to zero and then cancel; at 3 rad the
# cancellation costs under a digit and 16 Gauss-Legendre nodes are exact to 1e-16.
_SLOW_PHASE = 3.0
SLOW_NODES = 16

# Beyond |z| = 5 the asymptotic series of the auxiliary Fresnel functions (DLMF 7.12.2, 7.12.3) is
# exact to 1e-15 with these numbers of terms; it stays regular where z itself overflows.
_FAR = 5.0
_SERIES_F = tuple((-1.0) ** m * float(np.prod(np.arange(4 * m - 1, 0, -2.0))) for m in range(10))
_SERIES_G = tuple((-1.0) ** m * float(np.prod(np.arange(4 * m + 1, 0, -2.0))) for m in range(10))


def chirp_integral(
    g: Float[Array, "..."],
    b: Float[Array, "..."],
    x: Float[Array, "..."],
    lower: Float[Array, "..."],
    upper: Float[Array, "..."],
) -> Complex[Array, "..."]:
    r"""Integral of :math:`\exp\{j[g\xi^2 + b(x-\xi)^2]\}` over ``lower`` ≤ ξ ≤ ``upper``, in mm.

    With :math:`a = g + b`, completing the square gives Fresnel integrals of
    :math:`z = \sqrt{2/(\pi|a|)}\,(a\xi - bx)` (DLMF 7.2.7, 7.2.8). That form is singular at
    :math:`a = 0`, where the order focuses on the sensor and the integral is a sinc. Three forms,
    each used where it loses no digits, cover all cases:

    - phase across the interval under 3 rad: Gauss-Legendre quadrature;
    - an end with \|z\| < 5: ``jax.scipy.special.fresnel``;
    - an end with \|z\| ≥ 5: the asymptotic edge wave, written in
      :math:`y = a / (2 (a\xi - bx)^2)` so that it is regular at :math:`a = 0`, plus the
      stationary-point wave :math:`e^{j g b x^2/a}` when that point lies between the ends.

    No piston or large phase is formed and divided out again. The error grows with the phases that
    the result itself contains: about eps times \|g b x²/a\| for the stationary wave.

    **Arguments** (broadcast against each other, all real, one dtype)

    - `g`: curvature at the mask, rad/mm², any sign.
    - `b`: Fresnel curvature π/(λd), rad/mm²; 0 gives the plain chirp integral.
    - `x`: observation coordinate, mm.
    - `lower`, `upper`: ends of the interval, mm.

    **Returns** the complex integral, mm. Differentiable in every argument.
    """
    return _integral(g, b, x, 0.5 * (lower + upper), 0.5 * (upper - lower), lower, upper)


def chirp_average(
    g: Float[Array, "..."], middle: Float[Array, "..."], half: Float[Array, "..."]
) -> Complex[Array, "..."]:
    r"""Integral of :math:`e^{jg\xi^2}` over ``middle`` ± ``half``, in mm.

    As `chirp_integral` without propagation, for intervals that are short against their distance
    from the axis, such as pixels: their width is not formed as a difference of their ends.
    """
    none = jnp.zeros_like(middle)
    return _integral(g, none, none, middle, half, middle - half, middle + half)


def _integral(g, b, x, middle, half, lower, upper) -> Complex[Array, "..."]:
    g, b, x, middle, half, lower, upper = jnp.broadcast_arrays(g, b, x, middle, half, lower, upper)
    slope = g * middle + b * (middle - x)
    slow = jnp.abs(g + b) * half**2 + 2 * jnp.abs(slope * half) < _SLOW_PHASE
    edges = _by_edges(g, b, x, lower, upper, slow)
    return jax.lax.cond(
        jnp.any(slow),
        lambda: jnp.where(slow, _by_quadrature(g, b, x, middle, half, slow), edges),
        lambda: edges,
    )


def _by_quadrature(g, b, x, middle, half, used) -> Complex[Array, "..."]:
    """Gauss-Legendre, for intervals over which the phase hardly turns."""
    nodes, weights = leggauss(SLOW_NODES)
    nodes, weights = (jnp.asarray(v, dtype=x.dtype)[:, None] for v in (nodes, weights))
    # Where this form is not used its phase may be anything: keep it, and its gradient, finite.
    half_used = jnp.where(used, half, 0.0).ravel()
    s = nodes * half_used
    slope = (g * middle + b * (middle - x)).ravel()
    relative = phasor(2 * slope * s + (g + b).ravel() * s**2)
    centre = phasor(g * middle**2 + b * (x - middle) ** 2)
    total = as_complex(half_used) * jnp.sum(as_complex(weights) * relative, axis=0)
    return centre * total.reshape(x.shape)


def _by_edges(g, b, x, lower, upper, unused) -> Complex[Array, "..."]:
    a = g + b
    sign = jnp.where(a < 0, -1.0, 1.0).astype(x.dtype)
    magnitude = jnp.where(unused | (a == 0), 1.0, jnp.abs(a))
    amplitude = jnp.sqrt(0.5 * jnp.pi / magnitude)

    def edge(end):
        """The edge's wave, and which side of it the stationary point lies on (0 if included)."""
        slope = g * end + b * (end - x)
        phase = g * end**2 + b * (x - end) ** 2
        near = slope**2 < (0.5 * jnp.pi * _FAR**2) * jnp.abs(a)

        near = near & ~unused
        slope_near = jnp.where(near, slope, 0.0)
        z = sign * slope_near * jnp.sqrt(2 / (jnp.pi * magnitude))
        sine, cosine = jax.scipy.special.fresnel(z)
        stationary = phasor(phase - sign * slope_near**2 / magnitude)
        wave_near = as_complex(amplitude) * stationary * jax.lax.complex(cosine, sign * sine)

        far = ~near & ~unused
        slope_far = jnp.where(far, slope, 1.0)
        y = jnp.where(far, 0.5 * a / slope_far**2, 0.0)
        f, h = _polynomial(_SERIES_F, y**2), y * _polynomial(_SERIES_G, y**2)
        wave_far = -phasor(phase) * jax.lax.complex(h / (2 * slope_far), f / (2 * slope_far))

        side = jnp.where(far, sign * jnp.sign(slope), 0.0)
        wave = jnp.where(near, wave_near, jnp.where(far, wave_far, 0.0))
        # Kept apart: fused, the compiler evaluates an end's Fresnel integrals more than once.
        return jax.lax.optimization_barrier((wave, side))

    wave_lower, side_lower = edge(lower)
    wave_upper, side_upper = edge(upper)
    inside = (side_upper - side_lower) / 2
    # The stationary phase g b x²/a is meaningful only if the stationary point b x/a is in reach.
    signed = sign * magnitude
    phase = jnp.where(inside != 0, (b / signed) * g * jnp.where(inside != 0, x, 0.0) ** 2, 0.0)
    stationary = (
        as_complex(amplitude * inside) * phasor(phase) * jax.lax.complex(jnp.ones_like(sign), sign)
    )
    return wave_upper - wave_lower + stationary


def _polynomial(coefficients: tuple[float, ...], t: Float[Array, "..."]) -> Float[Array, "..."]:
    value = jnp.full_like(t, coefficients[-1])
    for c in reversed(coefficients[:-1]):
        value = value * t + c
    return value
