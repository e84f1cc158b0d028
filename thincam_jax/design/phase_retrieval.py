r"""From the PSF that is wanted to the phase of a mask: the algorithm of Gerchberg and Saxton."""

import functools

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from thincam_jax._core import checks
from thincam_jax._core.checks import Shape
from thincam_jax._core.grids import Grid
from thincam_jax._core.module import Module
from thincam_jax._core.precision import as_complex, phasor
from thincam_jax.imaging.operators.crop_convolution import cut, middle_corner, place
from thincam_jax.lensless.propagation.angular_spectrum import (
    padded_shape,
    propagate,
    spherical_wave,
)
from thincam_jax.lensless.propagation.path import Path


class Retrieval(Module):
    """What `retrieve_phase` found.

    - `phase`: of each cell of the mask, rad, from 0 to 2π.
    - `error`: `match_error` of the PSF at the beginning of every step.
    """

    phase: Float[Array, "y x"]
    error: Float[Array, " step"]


def retrieve_phase(
    target: Float[Array, "y x"],
    grid: Grid,
    path: Path,
    *,
    shape: Shape,
    key: PRNGKeyArray,
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
    - `key`: of the random phase to begin with. `steps`: of to and fro.

    **Errors**: ValueError for a target that is negative, not finite or without light.
    """
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


def match_error(psf: Float[Array, "y x"], target: Float[Array, "y x"]) -> Float[Array, ""]:
    """How far two PSFs differ in shape: 1 − ⟨h, T⟩²/(‖h‖²‖T‖²), 0 where one is a multiple."""
    both = jnp.sum(psf * target) ** 2
    return 1 - both / (jnp.sum(psf**2) * jnp.sum(target**2))


@functools.partial(jax.jit, static_argnames=("cells", "steps"))
def _to_and_fro(target, grid: Grid, path: Path, cells: tuple[int, int], key, steps: int):
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
        error = match_error(seen.real**2 + seen.imag**2, target)
        wanted = as_complex(amplitude) * phasor(jnp.angle(seen))
        # The adjoint of `propagate` runs light backwards: the conjugate of its conjugate's.
        back = propagate(place(wanted, seen_corner, window).conj(), grid.pitch, path).conj()
        return jnp.angle(cut(back, corner, cells) * lit.conj()), error

    first = jax.random.uniform(key, cells, target.dtype, maxval=2 * jnp.pi)
    phase, errors = jax.lax.scan(step, first, None, length=steps)
    return phase % (2 * jnp.pi), errors
