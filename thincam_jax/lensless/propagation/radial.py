r"""`radial`: the exact Fresnel field of a mask of concentric rings."""

import functools
import math

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from numpy.polynomial.hermite import hermgauss

from thincam_jax._core import checks
from thincam_jax._core.grids import Grid
from thincam_jax._core.precision import as_complex, flat_root, phasor, squared_modulus
from thincam_jax.lensless.camera import LightPath
from thincam_jax.lensless.masks.base import AbstractMask, other_models
from thincam_jax.lensless.masks.openings import RadialMask
from thincam_jax.lensless.method import LATTICE_POINTS, PsfMethod
from thincam_jax.lensless.propagation.chirp import edge_wave
from thincam_jax.lensless.propagation.separable import pixel_mean

# From this v on the rim's waves are those of its nearest and its farthest point.
_TWO_WAVES = 8.0
# Nodes on half of the rim below it, and of Gauss-Hermite above: 1e-9 of the open aperture.
_ON_RIM = 12
_ANGLES = (np.arange(_ON_RIM) + 0.5) * np.pi / _ON_RIM
_NODES = np.stack(hermgauss(8), axis=-1)[4:]
# Samples of the profile for its finest fringe, 6 of which are interpolated, and what that leaves.
_PER_FRINGE, _STENCIL, PROFILE_ERROR = 14, range(-2, 4), 1e-6


def radial(
    mask: AbstractMask, grid: Grid, path: LightPath, method: PsfMethod
) -> Float[Array, "y x"]:
    r"""PSF of rings, exact within the Fresnel approximation: |Σ_i (t_i − t_{i+1}) U_i(ρ)|².

    The field of a disc of radius a at ρ from its middle is an integral over its rim, at the
    distances S from the point, without special functions (Green's theorem):

    .. math::
        U(\rho) = \frac{b}{j\pi} \iint_{r<a} e^{jbs^2} d^2s
        = -\frac{1}{2\pi} \oint (e^{jbS^2} - 1)\,d\alpha
        = [\rho < a] - \frac{1}{2\pi} \int_{p^2}^{q^2}
          \frac{(1 + pq/\sigma)\,e^{jb\sigma}}{\sqrt{(\sigma - p^2)(q^2 - \sigma)}}\,d\sigma,

    p = a − ρ, q = a + ρ, b of the path. Where v = 2abρ is small, the trapezoidal rule over the
    rim's angle converges exponentially. Elsewhere both ends are followed along steepest descent,
    σ = p² + jx²/b, by Gauss-Hermite quadrature, without the pole at σ = 0, which is the wave of a
    straight edge (`edge_wave`). Either takes as long for any numbers: no sampling condition.

    A pixel's average is the mean over `nodes` points of it (`lattice`). With `oversampling`, the
    profile is computed at so many samples a pixel and interpolated, with an error below
    `PROFILE_ERROR` where `profile_samples` chose them; with None it is computed at every point.

    **Errors**: TypeError for another mask.
    """
    if not isinstance(mask, RadialMask):
        raise TypeError(
            f"model 'radial' needs a RadialMask; for a {type(mask).__name__} use "
            f"{other_models(mask)}"
        )
    oversampling = method.oversampling
    y, x = path.on_mask(grid, mask.centre)
    pitch = grid.pitch / path.magnification
    value = functools.partial(irradiance, mask, path)
    if oversampling is not None:
        step = pitch / oversampling
        nearest = flat_root(sum(jnp.min(jnp.abs(axis)) ** 2 for axis in (y, x)))
        first = jnp.maximum(nearest - pitch, 0)
        places = jnp.arange(profile_length(grid.shape, oversampling), dtype=x.dtype)
        profile = value(jnp.abs(first + (places + _STENCIL[0]) * step))
        value = lambda rho: _interpolated(profile, (rho - first) / step)  # noqa: E731

    def at(place: Float[Array, "2"]) -> Float[Array, "y x"]:
        down, across = y + place[0] * pitch, x + place[1] * pitch
        return value(flat_root(down[:, None] ** 2 + across**2))

    if not method.pixel_integration:
        return at(jnp.zeros(2, x.dtype))
    nodes = method.nodes or LATTICE_POINTS
    return pixel_mean(at, nodes, jnp.zeros(grid.shape, x.dtype))


def profile_samples(
    mask: AbstractMask, grid: Grid, path: LightPath, method: PsfMethod
) -> int | None:
    """Samples a pixel, a power of two; None where the profile saves nothing or numbers are traced.

    The band of the irradiance ends at 2a/(λd), a the outer radius: so many fringes there are.
    """
    numbers = (*mask.extent, grid.pitch, path.wavelength, path.distance)
    if any(checks.is_traced(number) for number in numbers):
        return None
    width, _, pitch, wavelength, distance = (float(np.asarray(n)) for n in numbers)
    samples = _PER_FRINGE * pitch * width / (wavelength * distance)
    if samples > max(grid.shape) * LATTICE_POINTS:  # longer than any that saves time
        return None
    samples = 2 ** math.ceil(math.log2(max(samples, 4)))
    points = math.prod(grid.shape) * (method.nodes or 1)
    return samples if profile_length(grid.shape, samples) < points else None


def profile_length(shape: tuple[int, int], oversampling: int) -> int:
    """Samples of the profile, from the nearest point of a grid to the farthest."""
    return math.ceil((math.hypot(*shape) + 2) * oversampling) + len(_STENCIL)


def irradiance(mask: RadialMask, path: LightPath, rho: Float[Array, "*at"]) -> Float[Array, "*at"]:
    """|U|² at the distances ρ from the middle, mm, on the mask's scale."""

    @jax.checkpoint
    def added(field, disc):
        radius, step = disc
        return field + as_complex(step) * _disc_field(radius, path.fresnel_curvature, rho), None

    discs = mask.radii, -jnp.diff(mask.rings, append=0)
    field, _ = jax.lax.scan(added, as_complex(jnp.zeros_like(rho)), discs)
    return squared_modulus(field)


def _disc_field(a: Float[Array, ""], b: Float[Array, ""], rho: Float[Array, "*at"]):
    p, q, few = a - rho, a + rho, 2 * a * b * rho < _TWO_WAVES
    # Where a form is not used, keep it, and its gradient, finite.
    within = jnp.where(few, rho, 0.0)
    apart = jnp.where(few, 2 * _TWO_WAVES / b, 4 * a * rho)
    angles, nodes = jnp.asarray(_ANGLES, rho.dtype), jnp.asarray(_NODES, rho.dtype)
    none = jnp.zeros_like(rho)

    def on_rim(total, angle):
        sine = jnp.sin(angle / 2) ** 2
        half = b / 2 * ((a - within) ** 2 + 4 * a * within * sine)
        wave, safe = phasor(half), jnp.where(half == 0, 1.0, half)
        size = b * a * (a - within + 2 * within * sine)
        size = size * jnp.where(half == 0, 1.0, wave.imag / safe)
        return (total[0] + wave.imag * size, total[1] - wave.real * size), None

    def descending(total, node):
        tau, weight = node[0] ** 2 / b, node[1]
        size = jnp.sqrt(apart**2 + tau**2)
        real = jnp.sqrt((size + apart) / 2)  # real ∓ j imaginary = Q = √(Δ ∓ jτ), Δ = 4aρ
        imaginary = tau / (2 * real)
        # 1/Q + p/(Q(q + Q)) at the near end
        beyond = p / ((q + real) ** 2 + imaginary**2)
        u, w = 1 + beyond * (q + real), beyond * imaginary
        near = u * real - w * imaginary, u * imaginary + w * real
        # (1 + pq/(q² + jτ))/Q at the far one
        beyond = p * q / (q**4 + tau**2)
        u, w = 1 + beyond * q**2, -beyond * tau
        far = u * real + w * imaginary, w * real - u * imaginary
        parts = zip(total, (*near, *far), strict=True)
        return tuple(t + part * weight / size for t, part in parts), None

    rim, _ = jax.lax.scan(on_rim, (none, none), angles, unroll=4)
    waves, _ = jax.lax.scan(descending, (none,) * 4, nodes, unroll=4)
    eighth = jnp.sqrt(0.5) / (jnp.pi * jnp.sqrt(b))
    near, far = (
        phasor(b * end**2) * jax.lax.complex(*(part * eighth for part in wave))
        for end, wave in ((p, waves[:2]), (q, waves[2:]))
    )
    turned = jnp.asarray([1 + 1j, 1 - 1j, 0.5 - 0.5j], near.dtype)
    edges = turned[0] * near + turned[1] * far + turned[2] * edge_wave(b, p)
    shadow = as_complex((p >= 0).astype(rho.dtype)) - edges
    return jnp.where(few, jax.lax.complex(*rim) / _ON_RIM, shadow)


def _interpolated(values: Float[Array, " n"], place: Float[Array, "*at"]) -> Float[Array, "*at"]:
    """Values between samples, of degree 5; the first of a place's six samples is its whole part."""
    whole = jnp.floor(place)
    part, index = place - whole, whole.astype(jnp.int32)
    total = jnp.zeros_like(place)
    for k in _STENCIL:
        weight = math.prod((part - m) * (1 / (k - m)) for m in _STENCIL if m != k)
        total = total + weight * values[index + k - _STENCIL[0]]
    return total
