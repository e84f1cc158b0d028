r"""Phase retrieval by Gerchberg and Saxton: from a target PSF to the phase of a mask.

`contour_target` draws such a target: thin closed lines in all directions.
"""

import functools

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from thincam_jax._core import checks
from thincam_jax._core.arguments import checked
from thincam_jax._core.checks import Number, Shape
from thincam_jax._core.grids import Grid
from thincam_jax._core.module import Module
from thincam_jax._core.precision import as_complex, phasor, squared_modulus
from thincam_jax._core.random import Key, random_key
from thincam_jax.imaging.operators.crop_convolution import cut, middle_corner, place
from thincam_jax.lensless.camera import LightPath
from thincam_jax.lensless.propagation.angular_spectrum import (
    padded_shape,
    propagate,
    spherical_wave,
)


class Retrieval(Module):
    """Result of `retrieve_phase`.

    - `phase`: phase of each cell of the mask, rad, from 0 to 2π.
    - `error`: `match_error` of the PSF at the beginning of every step.
    """

    phase: Float[Array, "y x"]
    error: Float[Array, " step"]


@checked
def retrieve_phase(
    target: Float[Array, "y x"],
    grid: Grid,
    path: LightPath,
    *,
    shape: Shape,
    key: Key,
    steps: int = 100,
) -> Retrieval:
    r"""The phase of a transparent mask whose PSF is near to a target (Gerchberg and Saxton 1972).

    Light goes to and fro between the mask and the sensor, on a window that holds both with room, so
    that nothing wraps round. At the sensor it keeps its phase and gets the amplitude √target, none
    beyond; at the mask it keeps its phase and gets the amplitude of the source's wave in the
    aperture, none beyond. Back is the adjoint of `propagate`.

    - `target`: irradiance on `grid`, in any unit, ≥ 0. `path`: wavelength and distances.
    - `shape`: cells (rows, columns) of the mask, as large as the samples of `grid`; even where its
      are, and odd where they are odd, so that their centres agree.
    - `key`: key of the random phase to begin with. `steps`: number of turns to the sensor and back.

    **Errors**: ValueError for a target that is negative, not finite or without light.
    """
    key = random_key(key)
    cells = checks.shape2d("shape", shape)
    if target.shape != grid.shape:
        raise ValueError(f"target has shape {target.shape} and its grid {grid.shape}")
    if any((m - n) % 2 for m, n in zip(cells, grid.shape, strict=True)):
        raise ValueError(
            f"shape = {cells} and a target of {grid.shape} have no common centre; give numbers of "
            "cells that are even or odd as the target's"
        )
    if not checks.is_traced(target):
        lowest, total = float(jnp.min(target)), float(jnp.sum(target))
        if not (lowest >= 0 and 0 < total < float("inf")):
            raise ValueError(
                f"target reaches from {lowest:.3g} and has the sum {total:.3g}; give irradiances "
                ">= 0, not all 0"
            )
    checks.at_least_one({"steps": steps})
    return Retrieval(*_to_and_fro(target, grid, path, cells, key, steps))


@checked
def match_error(psf: Float[Array, "y x"], target: Float[Array, "y x"]) -> Float[Array, ""]:
    """Difference of two PSFs in shape: 1 − ⟨h, T⟩²/(‖h‖²‖T‖²), 0 where one is a multiple."""
    both = jnp.sum(psf * target) ** 2
    return 1 - both / (jnp.sum(psf**2) * jnp.sum(target**2))


@functools.partial(jax.jit, static_argnames=("cells", "steps"))
def _to_and_fro(target, grid: Grid, path: LightPath, cells: tuple[int, int], key, steps: int):
    window = padded_shape(cells, grid.shape, 1.0)
    # One more where halves would not agree.
    window = tuple(w + (w - m) % 2 for w, m in zip(window, cells, strict=True))
    corner, seen_corner = (middle_corner(shape, window) for shape in (cells, grid.shape))
    amplitude = jnp.sqrt(target * (cells[0] * cells[1] / jnp.sum(target)))
    lit = spherical_wave(grid.with_shape(cells), path)

    def to_sensor(phase):
        return propagate(place(lit * phasor(phase), corner, window), grid.pitch, path)

    def step(phase, _):
        field = to_sensor(phase)
        seen = cut(field, seen_corner, grid.shape)
        error = match_error(squared_modulus(seen), target)
        wanted = as_complex(amplitude) * phasor(jnp.angle(seen))
        # The adjoint of `propagate` runs light backwards: the conjugate of its conjugate's.
        back = propagate(place(wanted, seen_corner, window).conj(), grid.pitch, path).conj()
        return jnp.angle(cut(back, corner, cells) * lit.conj()), error

    first = jax.random.uniform(key, cells, target.dtype, maxval=2 * jnp.pi)
    phase, errors = jax.lax.scan(step, first, None, length=steps)
    return phase % (2 * jnp.pi), errors


# Of unit gradients the noise lies within ±0.7. Zero itself is taken at every node of the lattice,
# where its contours would meet in a regular pattern.
_LEVELS = (-0.12, 0.12)


@checked
def contour_target(
    key: Key,
    grid: Grid,
    *,
    feature: Number,
    line_width: Number,
    levels: tuple[float, ...] = _LEVELS,
) -> Float[Array, "y x"]:
    r"""A PSF of thin lines: iso-contours of gradient noise (Perlin 1985), of the sum 1.

    Its lines run in all directions and are sparse and sharp, so that its spectrum falls slowly and
    has no zeros: the target of PhlatCam (Boominathan et al., IEEE PAMI 42, 1618 (2020)). Lines of
    even width are those where :math:`|N - c| < \tfrac w2 |\nabla N|`.

    - `grid`: grid of the PSF; beyond it there is no light.
    - `feature`: distance of the noise's nodes, mm: how far lines are apart. At least four samples.
    - `line_width`: w, mm, from a sample to `feature`.
    - `levels`: the c; the noise has a standard deviation of about 0.25.
    """
    key = random_key(key)
    feature = checks.positive("feature", feature, "mm")
    width = checks.positive("line_width", line_width, "mm")
    pitch = float(grid.pitch)
    if float(feature) < 4 * pitch or not pitch <= float(width) <= float(feature):
        raise ValueError(
            f"feature = {float(feature):g} mm and line_width = {float(width):g} mm on samples of "
            f"{pitch:g} mm; give at least {4 * pitch:g} and {pitch:g} mm, lines within the feature"
        )
    noise, (down, across) = _noise(key, grid, feature)
    slope = jnp.sqrt(down**2 + across**2) + jnp.finfo(noise.dtype).eps
    lines = jnp.zeros_like(noise)
    for level in levels:
        beyond = width / 2 - jnp.abs(noise - level) / slope
        # The part of a sample that a line through it covers, across the line.
        lines = jnp.maximum(lines, jnp.clip(beyond / grid.pitch + 0.5, 0.0, 1.0))
    total = jnp.sum(lines)
    if not float(total) > 0:
        raise ValueError(
            f"no contour of the levels {levels} lies on the grid; give a smaller feature or levels "
            "nearer to 0"
        )
    return lines / total


def _noise(key: PRNGKeyArray, grid: Grid, feature):
    """Gradient noise on the grid, and its derivatives along y and x, 1/mm."""
    nodes = tuple(int(n * float(grid.pitch) / float(feature)) + 3 for n in grid.shape)
    angle = jax.random.uniform(key, nodes, feature.dtype, maxval=2 * jnp.pi)
    y, x = (a / feature + (n - 1) / 2 for a, n in zip((grid.y, grid.x), nodes, strict=True))

    def value(y, x):
        row, column = jnp.floor(y).astype(int), jnp.floor(x).astype(int)
        v, u = y - jnp.floor(y), x - jnp.floor(x)
        fade_v, fade_u = (t**3 * (t * (6 * t - 15) + 10) for t in (v, u))
        total = jnp.zeros_like(y)
        for i in (0, 1):
            for j in (0, 1):
                turn = angle[row + i, column + j]
                ramp = jnp.sin(turn) * (v - i) + jnp.cos(turn) * (u - j)
                weight = (fade_v if i else 1 - fade_v) * (fade_u if j else 1 - fade_u)
                total = total + weight * ramp
        return total

    field = jax.vmap(jax.vmap(jax.value_and_grad(value, (0, 1)), (None, 0)), (0, None))
    noise, slopes = jax.jit(field)(y, x)
    return noise, tuple(slope / feature for slope in slopes)
