"""Some rows and columns of a grid, that stand for all of them."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from thincam_jax._core.grids import Grid

# Rows and columns that are looked at. All sizes have this many, so that nothing recompiles.
COUNT = 256
# Share of them that may lie at the shadow's two edges, where the fields change fastest.
_AT_EDGES = 0.5


class Points(Grid):
    """A grid's rows and columns at some of its indices; stands in for a grid in the models.

    - `row_indices`, `column_indices`: i − (n−1)/2, exact.
    """

    row_indices: Float[Array, " rows"]
    column_indices: Float[Array, " columns"]

    def __init__(self, row_indices, column_indices, pitch):
        self.shape = (len(row_indices), len(column_indices))
        self.pitch = pitch
        self.row_indices = jnp.asarray(row_indices, pitch.dtype)
        self.column_indices = jnp.asarray(column_indices, pitch.dtype)

    def refined(self, factor: int) -> "Points":
        """The `factor` (odd) samples by `factor` of every pixel."""
        inside = np.arange(factor) - factor // 2

        def fine(indices):
            return (indices[:, None] * factor + inside.astype(indices.dtype)).ravel()

        return Points(fine(self.row_indices), fine(self.column_indices), self.pitch / factor)

    @property
    def y(self) -> Float[Array, " rows"]:
        return self.row_indices * self.pitch

    @property
    def x(self) -> Float[Array, " columns"]:
        return self.column_indices * self.pitch


def chosen(
    count: int, edges: tuple[float, float], zone: float, seed: int
) -> tuple[Int[np.ndarray, " chosen"], Float[np.ndarray, " chosen"]]:
    """Indices out of `count`, and how many of them each stands for.

    Everything if it is few enough; else a stratified random choice that is denser within `zone`
    (in samples) of the `edges` (indices, which may lie outside). Filled up with weight zero.
    """
    if count <= COUNT:
        filled = np.zeros(COUNT, int)
        filled[:count] = np.arange(count)
        return filled, (np.arange(COUNT) < count).astype(float)
    indices = np.arange(count)
    distance = np.min([np.abs(indices - edge) for edge in edges], axis=0)
    near = distance <= max(zone, 4.0)
    density = np.full(count, COUNT * (1 - _AT_EDGES) / count)
    if near.any():
        density[near] = np.minimum(1.0, density[near] + COUNT * _AT_EDGES / near.sum())
    density *= COUNT / density.sum()
    density = np.minimum(density, 1.0)
    # One of each stratum of equal total density.
    total = np.cumsum(density)
    offsets = np.random.default_rng(seed).uniform(size=COUNT)
    strata = (np.arange(COUNT) + offsets) * total[-1] / COUNT
    found = np.minimum(np.searchsorted(total, strata), count - 1)
    return found, total[-1] / (COUNT * density[found])
