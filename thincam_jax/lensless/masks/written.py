"""A mask of open and closed cells as it leaves the writer: corners round, edges moved."""

from typing import Annotated

import numpy as np
import scipy

from thincam_jax._core.arguments import checked
from thincam_jax._core.checks import Number
from thincam_jax._core.memory import refuse_if_too_large
from thincam_jax._core.quantity import quantity, whole
from thincam_jax.lensless.masks.sampled import SampledMask

# Radius over σ of the circle that cuts as much off a corner: √2 Φ⁻¹(1/√2) / (√2 − 1).
_RADIUS = float(2**0.5 * scipy.special.ndtri(0.5**0.5) / (2**0.5 - 1))
_FARTHEST = 7.0  # σ within which float64 tells how far an edge is


@checked
def as_written(
    mask: SampledMask,
    *,
    radius: Annotated[Number, quantity("mm", positive=True)],
    bias: Annotated[Number, quantity("mm")] = 0.0,
    samples: Annotated[int, whole(1, 64)] = 6,
) -> SampledMask:
    r"""A binary mask of cells as a writer with a beam of finite width makes it.

    The cells are blurred by a Gaussian of width σ and cut at half height. An edge lies where

    .. math:: \sigma\,\Phi^{-1}\!\big((G_\sigma * t)(x, y)\big) + b = 0

    with the normal distribution Φ: straight edges stay but for the bias b, and corners lose what a
    circle of `radius` cuts off them, 1.86 σ. Cells and holes of less than some 2.5 σ vanish, and
    diagonal neighbours join where b > 0.

    - `mask`: cells of 0 and 1, without gaps. `radius`: radius of the corners, mm.
    - `bias`: b, by which edges move, mm: positive where openings grow.
    - `samples`: along a side of a cell; each holds its open part.

    **Returns** the mask in samples, as large as given: what grows beyond it is cut off.

    **Errors**: ValueError, one line, for other masks, and for a bias or samples that are so large
    against the radius that the blur does not tell where an edge lies.

    ```python
    import thincam_jax as tc
    from thincam_jax.lensless.masks.written import as_written
    from thincam_jax.units import um

    mask = tc.lensless.masks.random_cells(0, width=0.22, cell=11 * um)
    made = as_written(mask, radius=1 * um, bias=0.2 * um)
    ```

    **See also**: `halftone`, `tc.design.write_gds`.
    """
    cells = np.asarray(mask.amplitude)
    if mask.fill_factor is not None or not np.isin(cells, (0, 1)).all():
        raise ValueError("as_written takes cells of 0 and 1 without gaps; give such a mask")
    count = max(cells.shape) * samples
    refuse_if_too_large(f"a mask of {count}² samples", 40 * count**2, "give fewer samples")
    cell, width, bias = (float(np.asarray(n)) for n in (mask.pitch, radius, bias))
    step, sigma = cell / samples, width / _RADIUS
    if abs(bias) + step / 2 > _FARTHEST * sigma:
        raise ValueError(
            f"a radius of {width:g} mm does not tell edges {abs(bias) + step / 2:.3g} mm away; "
            "give a larger radius, a smaller bias or more samples"
        )
    down, across = (_blur(n, samples, cell / sigma) for n in cells.shape)
    edge = sigma * scipy.special.ndtri(np.clip(down @ cells @ across.T, 0, 1)) + bias
    opened = np.clip(edge / step + 0.5, 0, 1)
    return SampledMask(opened.astype(mask.pitch.dtype), step, centre=mask.centre)


def _blur(cells: int, samples: int, cell: float) -> np.ndarray:
    """Part of each cell in the blur of each sample; `cell`: side over σ."""
    places = (np.arange(cells * samples) + 0.5) / samples
    edges = scipy.special.ndtr((np.arange(cells + 1) - places[:, None]) * cell)
    return np.diff(edges)
