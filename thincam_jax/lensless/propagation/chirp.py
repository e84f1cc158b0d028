r"""The finite chirp integral: the one closed form on which the exact models rest.

Every field behind a square Fresnel zone aperture, and every pixel average of a chirp, is a
product of two one-dimensional integrals

.. math::
    I(x) = \int_{\xi_1}^{\xi_2} \exp\{ j [ g \xi^2 + b (x - \xi)^2 ] \} \, d\xi .

:math:`g` (rad/mm²) collects what acts at the mask, a zone order :math:`k\beta` and a spherical wave
:math:`\pi/(\lambda t)`; :math:`b = \pi/(\lambda d)` is the Fresnel propagation over :math:`d`.
"""

import functools
import math
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float
from numpy.polynomial import Chebyshev, Polynomial
from numpy.polynomial.legendre import leggauss

from thincam_jax._core.precision import Precision, phasor, precision_of

# Beyond |z| = 5 the asymptotic series of the auxiliary Fresnel functions (DLMF 7.12.2, 7.12.3) is
# exact to 1e-15 with ten terms and to 1e-8 with four; it stays regular where z itself overflows.
_FAR = 5.0
_SERIES_F = tuple((-1.0) ** m * float(np.prod(np.arange(4 * m - 1, 0, -2.0))) for m in range(10))
_SERIES_G = tuple((-1.0) ** m * float(np.prod(np.arange(4 * m + 1, 0, -2.0))) for m in range(10))
# Below it they are polynomials in t = (z − c)/(z + c), divided by z + c.
_CENTRE = 2.0
# The phase across the interval, in rad, below which a power series is used in place of edge waves,
# which diverge like 1/phase as it goes to zero and then cancel.
_SLOW_PHASE = 3.0


@dataclass(frozen=True)
class _Degrees:
    """Degrees of the polynomials and series, enough for a precision."""

    near: int
    far: int
    slow: int


_DEGREES = {"float32": _Degrees(15, 4, 18), "float64": _Degrees(29, 10, 29)}


def _auxiliary_polynomials(degree: int) -> tuple[tuple[float, ...], tuple[float, ...]]:
    r"""Coefficients of (z + c) f and (z + c) g in t = (z − c)/(z + c) over 0 ≤ z ≤ 5.

    :math:`g + jf = \int_0^\infty e^{j\pi(s^2/2 + zs)}\,ds` along s = r e^{jπ/4}, where it decays.
    """
    top = (_FAR - _CENTRE) / (_FAR + _CENTRE)
    t = (top - 1) / 2 + (top + 1) / 2 * np.cos(np.pi * (np.arange(80) + 0.5) / 80)
    z = _CENTRE * (1 + t) / (1 - t)
    nodes, weights = leggauss(80)
    turn, r = np.exp(0.25j * np.pi), 2.75 * (nodes + 1)
    values = np.exp(-0.5 * np.pi * r**2 + 1j * np.pi * turn * z[:, None] * r) @ weights
    fit = Chebyshev.fit(t, 2.75 * turn * values * (z + _CENTRE), degree, domain=(-1.0, top))
    coefficients = fit.convert(kind=Polynomial).coef
    return tuple(coefficients.imag.tolist()), tuple(coefficients.real.tolist())


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
    :math:`a = 0`, where the order focuses on the sensor and the integral is a sinc. So it is
    written as the wave of each edge, by the auxiliary Fresnel functions (DLMF 7.5.3, 7.5.4), plus
    the stationary-point wave :math:`e^{j g b x^2/a}` when that point lies between the ends:

    - an end with \|z\| < 5: polynomials in z;
    - an end with \|z\| ≥ 5: the asymptotic series, written in
      :math:`y = a / (2 (a\xi - bx)^2)` so that it is regular at :math:`a = 0`;
    - phase across the interval under 3 rad: its power series in place of both edges.

    All are short polynomials, computed everywhere: no branch, so that `jax.vmap` costs nothing.

    No piston or large phase is formed and divided out again. The error grows with the phases that
    the result itself contains: about eps times \|g b x²/a\| for the stationary wave.

    **Arguments** (broadcast against each other, all real, one dtype)

    - `g`: curvature at the mask, rad/mm², any sign.
    - `b`: Fresnel curvature π/(λd), rad/mm²; 0 gives the plain chirp integral.
    - `x`: observation coordinate, mm.
    - `lower`, `upper`: ends of the interval, mm.

    **Returns** the complex integral, mm. Differentiable in every argument.
    """
    return _integral(g, b, x, 0.5 * (lower + upper), 0.5 * (upper - lower), (lower, upper))


def chirp_average(
    g: Float[Array, "..."], middle: Float[Array, "..."], half: Float[Array, "..."]
) -> Complex[Array, "..."]:
    r"""Integral of :math:`e^{jg\xi^2}` over ``middle`` ± ``half``, in mm.

    As `chirp_integral` without propagation, for intervals that are short against their distance
    from the axis, such as pixels: their width is not formed as a difference of their ends.
    """
    none = jnp.zeros_like(middle)
    return _integral(g, none, none, middle, half, (middle - half, middle + half))


@jax.custom_jvp
@jax.jit
def edge_wave(b: Float[Array, ""], s: Float[Array, "..."]) -> Complex[Array, "..."]:
    r"""The wave W(s) of an opaque edge at the distance s, mm, of either sign; b > 0.

    .. math::
        \int_{s_1}^{s_2} e^{jb\sigma^2} d\sigma = \sqrt{\frac{\pi}{2b}}
            \Big[ \frac{1+j}{2} (\mathrm{sgn}\,s_2 - \mathrm{sgn}\,s_1) + W(s_1) - W(s_2) \Big]

    W = sgn(s) (g + jf)(\|s\|√(2b/π)) e^{jbs²} in the auxiliary Fresnel functions (DLMF 7.5.3,
    7.5.4). Its own step at s = 0 and that of the sign cancel, and the slopes count neither.
    """
    precision = precision_of(s)
    z = jnp.abs(s) * jnp.sqrt(2 / jnp.pi * b)
    near = z < _FAR
    f_near, g_near = _near(jnp.where(near, z, 0.0), precision)
    steep = jnp.where(near, _FAR, z)
    f_far, g_far = _far(1 / (jnp.pi * steep**2), precision)
    direction = jnp.where(s < 0, -1.0, 1.0).astype(s.dtype)
    scale = direction / (jnp.pi * steep)
    in_phase = jnp.where(near, direction * g_near, scale * g_far)
    quadrature = jnp.where(near, direction * f_near, scale * f_far)
    return jax.lax.complex(in_phase, quadrature) * phasor(b * s**2)


@edge_wave.defjvp
def _edge_wave_slope(primals, tangents):
    """−e^{jbs²} √(2b/π), per s; b acts as a scale of s."""
    (b, s), (b_dot, s_dot) = primals, tangents
    slope = -jnp.sqrt(2 / jnp.pi * b) * (s_dot + s * b_dot / (2 * b))
    return edge_wave(b, s), phasor(b * s**2) * jax.lax.complex(slope, jnp.zeros_like(slope))


_NEAR = {p: _auxiliary_polynomials(d.near) for p, d in _DEGREES.items()}


@jax.jit  # traced once for each shape, as the parts below
def _integral(g, b, x, middle, half, ends) -> Complex[Array, "..."]:
    g, b, x, middle, half, lower, upper = jnp.broadcast_arrays(g, b, x, middle, half, *ends)
    precision = precision_of(x)
    a = g + b
    slope, bend = 2 * (g * middle + b * (middle - x)) * half, a * half**2
    slow = jnp.abs(bend) + jnp.abs(slope) < _SLOW_PHASE
    # Where a form is not used its arguments may be anything: keep it, and its gradient, finite.
    slope, bend = jnp.where(slow, slope, 0.0), jnp.where(slow, bend, 0.0)
    even, odd = (half * part for part in _slow_waves(bend, slope**2, precision))
    sign = jnp.where(a < 0, -1.0, 1.0).astype(x.dtype)
    magnitude = jnp.where(slow | (a == 0), 1.0, jnp.abs(a))
    amplitude = jnp.sqrt(0.5 * jnp.pi / magnitude)

    def edge(end):
        """Phase and amplitude of the edge's wave, and its side of the stationary point."""
        slope = g * end + b * (end - x)
        direction = jnp.where(slope < 0, -1.0, 1.0).astype(x.dtype)
        near = (slope**2 < (0.5 * jnp.pi * _FAR**2) * jnp.abs(a)) & ~slow
        far = ~near & ~slow
        z = jnp.where(near, direction * slope, 0.0) * jnp.sqrt(2 / (jnp.pi * magnitude))
        f_near, g_near = _near(z, precision)
        steep = jnp.where(far, slope, 1.0)
        y = jnp.where(far, 0.5 * a / steep**2, 0.0)
        f_far, g_far = _far(y, precision)
        in_phase = jnp.where(near, sign * direction * amplitude * g_near, 0.5 * g_far / steep)
        quadrature = jnp.where(near, direction * amplitude * f_near, 0.5 * f_far / steep)
        return g * end**2 + b * (x - end) ** 2, in_phase, quadrature, sign * direction

    phase_lower, in_phase_lower, quadrature_lower, side_lower = edge(lower)
    phase_upper, in_phase_upper, quadrature_upper, side_upper = edge(upper)
    wave_lower = jnp.where(slow, 0.0, in_phase_lower), jnp.where(slow, 0.0, quadrature_lower)
    wave_upper = jnp.where(slow, even, -in_phase_upper), jnp.where(slow, odd, -quadrature_upper)
    centre = g * middle**2 + b * (x - middle) ** 2
    phase_upper = jnp.where(slow, centre, phase_upper)
    # The stationary phase g b x²/a is meaningful only if the stationary point b x/a is in reach.
    inside = jnp.where(slow, 0.0, (side_upper - side_lower) / 2)
    phase = jnp.where(inside != 0, (b / (sign * magnitude)) * g * x**2, 0.0)
    stationary = inside * amplitude, inside * sign * amplitude
    return (
        jax.lax.complex(*wave_upper) * phasor(phase_upper)
        + jax.lax.complex(*wave_lower) * phasor(phase_lower)
        + jax.lax.complex(*stationary) * phasor(phase)
    )


@functools.partial(jax.custom_jvp, nondiff_argnums=(1,))
@functools.partial(jax.jit, static_argnums=1)
def _near(z, precision: Precision):
    """Auxiliary Fresnel functions f(z), g(z) for 0 ≤ z ≤ 5."""
    t = (z - _CENTRE) / (z + _CENTRE)
    f, g = (_polynomial(coefficients, t) / (z + _CENTRE) for coefficients in _NEAR[precision])
    return f, g


@_near.defjvp
def _near_slope(precision, primals, tangents):
    """f' = −πzg, g' = πzf − 1 (DLMF 7.10.2)."""
    (z,), (z_dot,) = primals, tangents
    f, g = _near(z, precision)
    return (f, g), (-jnp.pi * z * g * z_dot, (jnp.pi * z * f - 1) * z_dot)


@functools.partial(jax.jit, static_argnums=1)
def _far(y, precision: Precision):
    """Auxiliary Fresnel functions f, g for large z, times πz, in y = 1/(πz²)."""
    terms = _DEGREES[precision].far
    f, g = (_polynomial(series[:terms], y**2) for series in (_SERIES_F, _SERIES_G))
    return f, y * g


@functools.partial(jax.jit, static_argnums=2)
def _slow_waves(q, p_squared, precision: Precision):
    r"""Real and imaginary part of :math:`\int_{-1}^1 e^{j(ps + qs^2)}\,ds`, by its power series.

    The sum of :math:`2 (jp)^{2m} (jq)^n / [(2m)!\,n!\,(2m + 2n + 1)]`.
    """
    parts = [jnp.zeros_like(q), jnp.zeros_like(q)]
    degree = _DEGREES[precision].slow
    for m in reversed(range(degree // 2 + 1)):
        for parity in (0, 1):
            row = tuple(
                (-1.0) ** (m + n // 2)
                * 2
                / (math.factorial(2 * m) * math.factorial(n) * (2 * m + 2 * n + 1))
                for n in range(parity, degree - 2 * m + 1, 2)
            )
            parts[parity] = parts[parity] * p_squared + (_polynomial(row, q**2) if row else 0.0)
    return parts[0], parts[1] * q


def _polynomial(coefficients: tuple[float, ...], t: Float[Array, "..."]) -> Float[Array, "..."]:
    value = jnp.full_like(t, coefficients[-1])
    for c in reversed(coefficients[:-1]):
        value = value * t + c
    return value
