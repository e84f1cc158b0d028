r"""Focus measures: how sharp an image is, as a whole, in a region, or around each pixel.

All are made of local averages ⟨·⟩ of the picture's derivatives, taken after a slight smoothing that
keeps the noise of single pixels out. Images of one sweep share a grid of directions, so that their
derivatives are directly comparable.
"""

from collections.abc import Callable
from typing import Literal, get_args

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from thincam_jax._core import checks
from thincam_jax._core.arguments import checked
from thincam_jax._core.precision import flat_root, product

Measure = Literal["laplacian_variance", "gradient_energy", "gradient_sparsity"]
MEASURES: tuple[Measure, ...] = get_args(Measure)


@checked
def focus_measure(
    image: Float[Array, "*batch y x"] | Float[np.ndarray, "*batch y x"],
    measure: Measure = "laplacian_variance",
    *,
    smoothing: float | int = 1.0,
    window: float | int | None = None,
    region: Bool[Array, "y x"] | Bool[np.ndarray, "y x"] | None = None,
) -> Float[Array, "..."]:
    r"""Sharpness of an image; the larger, the sharper.

    - "laplacian_variance": :math:`\langle (\Delta f)^2\rangle - \langle \Delta f\rangle^2`, the
      power of the finest detail, which has the most parallax: the narrowest curve.
    - "gradient_energy": :math:`\langle |\nabla f|^2\rangle` by Sobel differences (Tenengrad).
      Coarse detail weighs more; with a smoothing above a pixel it draws the maximum to larger t.
    - "gradient_sparsity": :math:`\langle |\nabla f|^2\rangle^{1/2} / \langle |\nabla f|\rangle`, at
      least 1: few steep edges in place of many shallow ones. Free of the picture's scale, so that
      regions of different brightness compare. For pictures with edges; blurred noise is as sparse.

    **Arguments**

    - `image`: (*batch, y, x), each measured separately.
    - `smoothing`: standard deviation of the Gaussian taken first, pixels; 0 for none.
    - `window`: standard deviation in pixels of the Gaussian average around each pixel; gives a map
      (*batch, y, x). Without, the average is over the image or over `region`: (*batch).
    - `region`: mask (y, x), true where to measure.

    **Errors**: ValueError for an unknown measure, a negative width, an empty region or both a
    window and a region.
    """
    checks.choice("measure", measure, MEASURES)
    image = checks.as_array(image, floating=True)
    average = _average(image.shape[-2:], image.dtype, window, region)
    smooth = gaussian_average(image, smoothing) if _width("smoothing", smoothing) else image
    if measure == "laplacian_variance":
        laplacian = _laplacian(smooth)
        return average(laplacian**2) - average(laplacian) ** 2
    squared = _squared_gradient(smooth)
    if measure == "gradient_energy":
        return average(squared)
    energy, length = average(squared), average(flat_root(squared))
    flat = length == 0
    return jnp.where(flat, 1, flat_root(energy) / jnp.where(flat, 1, length))


def gaussian_average(
    image: Float[Array, "*batch y x"], width: float | int
) -> Float[Array, "*batch y x"]:
    """Gaussian average around each pixel; at the border over the pixels there are.

    A `width` of 0 leaves the image unchanged.
    """
    if not _width("width", width):
        return image
    down, across = (jnp.asarray(_weights(n, width), image.dtype) for n in image.shape[-2:])
    return product(product(down, image), across.T)


def _weights(count: int, width: float | int) -> np.ndarray:
    distance = np.subtract.outer(np.arange(count), np.arange(count))
    weights = np.exp(-0.5 * (distance / width) ** 2)
    return weights / weights.sum(axis=1, keepdims=True)


def _average(shape, dtype, window, region) -> Callable[[Array], Array]:
    """The average ⟨·⟩: over a window, a region or the whole image."""
    if window is not None:
        if region is not None:
            raise ValueError("give a window (for a map) or a region (for a number), not both")
        if not _width("window", window):
            raise ValueError("window = 0 holds no pixels; give a width of at least 0.5 pixels")
        return lambda values: gaussian_average(values, window)
    if region is None:
        return lambda values: jnp.mean(values, axis=(-2, -1))
    if region.shape != shape:
        raise ValueError(f"region has shape {region.shape}; give a mask of {shape} pixels")
    if not checks.is_traced(region) and not np.asarray(region).any():
        raise ValueError("region holds no pixel; mark with true where to measure")
    inside = jnp.asarray(region).astype(dtype)
    return lambda values: jnp.sum(values * inside, axis=(-2, -1)) / jnp.sum(inside)


def _width(name: str, value: float | int) -> float:
    if not 0 <= value < np.inf:
        raise ValueError(f"{name} = {value} pixels; give a width of at least 0")
    return float(value)


def _padded(image):
    """One pixel more on every side, a copy of its neighbour: no edge at the image's border."""
    return jnp.pad(image, [(0, 0)] * (image.ndim - 2) + [(1, 1), (1, 1)], mode="edge")


@jax.jit
def _laplacian(image):
    f = _padded(image)
    rows = f[..., :-2, 1:-1] + f[..., 2:, 1:-1]
    columns = f[..., 1:-1, :-2] + f[..., 1:-1, 2:]
    return rows + columns - 4 * image


@jax.jit
def _squared_gradient(image):
    """|∇f|² by Sobel's differences, per pixel."""
    f = _padded(image)
    across = (f[..., 2:] - f[..., :-2]) / 2
    down = (f[..., 2:, :] - f[..., :-2, :]) / 2
    across = (across[..., :-2, :] + 2 * across[..., 1:-1, :] + across[..., 2:, :]) / 4
    down = (down[..., :-2] + 2 * down[..., 1:-1] + down[..., 2:]) / 4
    return across**2 + down**2
