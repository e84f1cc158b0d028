"""The closed forms as sums of separable terms, on any rows and columns."""

import jax

from thincam_jax._core.grids import Grid
from thincam_jax.lensless.masks.base import AbstractMask
from thincam_jax.lensless.propagation.chirps import ChirpSum
from thincam_jax.lensless.propagation.closed_form import closed_form
from thincam_jax.lensless.propagation.geometric import geometric
from thincam_jax.lensless.propagation.paraxial import paraxial
from thincam_jax.lensless.propagation.path import Path
from thincam_jax.lensless.propagation.separable import PIXEL_NODES, separable
from thincam_jax.lensless.propagation.separable_sum import SeparableSum
from thincam_jax.lensless.psf import MODELS, SAMPLED, Model

CLOSED: tuple[Model, ...] = tuple(model for model in MODELS if model not in SAMPLED)


@jax.jit(static_argnames=("model", "pixel_integration", "nodes"))
def closed_terms(
    mask: AbstractMask,
    grid: Grid,
    path: Path,
    model: str,
    pixel_integration: bool,
    nodes: int = PIXEL_NODES,
) -> SeparableSum:
    """The PSF of a mask with zone orders by one of the closed forms."""
    if model == "geometric":
        shadow = geometric(mask, grid, path, pixel_integration=pixel_integration)
        assert isinstance(shadow, SeparableSum)  # of a mask with zone orders
        return shadow
    if model == "separable":
        return separable(mask, grid, path, pixel_integration=pixel_integration, nodes=nodes)
    unbounded: ChirpSum = (paraxial if model == "paraxial" else closed_form)(mask, path)
    return unbounded.sample(grid, pixel_integration=pixel_integration)
