"""What the sampled models share: the mask plane's samples and the wave that lights them."""

import jax.numpy as jnp
from jaxtyping import Array, Complex

from thincam_jax._core.grids import Grid
from thincam_jax._core.precision import as_complex, turn_phasor
from thincam_jax.lensless.masks.base import AbstractMask
from thincam_jax.lensless.propagation.path import Path


def lit_mask(mask: AbstractMask, plane: Grid, path: Path) -> Complex[Array, "y x"]:
    """Field just behind the mask under the exact spherical wave, 1 on the axis, piston dropped."""
    lit = spherical_wave(plane, path)
    return lit * mask.sample(plane).astype(lit.dtype)


def spherical_wave(plane: Grid, path: Path) -> Complex[Array, "y x"]:
    """The wave of the point at t in the mask's plane, 1 on the axis, piston dropped."""
    rho2 = plane.y[:, None] ** 2 + plane.x**2
    nearness = 1 / path.object_distance  # zero for a plane wave
    stretch = jnp.sqrt(1 + rho2 * nearness**2)
    # sqrt(t² + ρ²) − t without cancellation.
    detour = rho2 * nearness / (1 + stretch)
    return turn_phasor(detour / path.wavelength) * as_complex(1 / stretch)
