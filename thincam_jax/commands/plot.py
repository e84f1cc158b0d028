"""Plots of PSFs and images, as `tc.plot`: figures of matplotlib, which is imported here only.

They are figures of pyplot: a notebook shows them by itself, a script by `matplotlib.pyplot.show()`.
"""

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from thincam_jax._core.checks import Number
from thincam_jax._core.grids import Grid
from thincam_jax.imaging.display import eight_bit, pictures
from thincam_jax.lensless import psf as psfs
from thincam_jax.lensless.camera import LenslessCamera
from thincam_jax.lensless.method import Model
from thincam_jax.reconstruction import Reconstruction

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def psf(
    camera: LenslessCamera,
    *,
    wavelength: Number,
    object_distance: Number = math.inf,
    model: Model = "separable",
    pixel_integration: bool = True,
) -> "Figure":
    """A camera's PSF, as an image and along a line through its middle; arguments as of `tc.psf`."""
    from matplotlib import pyplot

    image = psfs.psf(
        camera,
        wavelength=wavelength,
        object_distance=object_distance,
        model=model,
        pixel_integration=pixel_integration,
    )
    figure = pyplot.figure(figsize=(8.5, 3.4), layout="constrained")
    draw_psf(figure, np.asarray(image), camera.sensor.grid, str(camera.mask))
    return figure


def draw_psf(figure: "Figure", image: np.ndarray, grid: Grid, title: str) -> None:
    """The PSF on a grid, and a line through its middle."""
    whole, line = figure.subplots(1, 2, gridspec_kw={"width_ratios": (1, 1.6)})
    x, y, half = np.asarray(grid.x), np.asarray(grid.y), float(grid.pitch) / 2
    extent = (x[0] - half, x[-1] + half, y[-1] + half, y[0] - half)
    shown = whole.imshow(image, cmap="gray", extent=extent)
    figure.colorbar(shown, ax=whole, label="irradiance / open aperture")
    whole.set(xlabel="x (mm)", ylabel="y (mm)")
    line.plot(x, image[image.shape[0] // 2], color="black", linewidth=0.7)
    line.set(xlabel="x (mm), through the middle", ylabel="irradiance / open aperture")
    line.set_title(title, fontsize=9)


def compare(images: Mapping[str, Any], *, truth: str | None = None) -> "Figure":
    """Images side by side, each from black to its own white, with gamma 2.2.

    - `images`: by name, (y, x) or (3, y, x), or what `tc.reconstruct` returns. Of several in a
      batch the first is shown.
    - `truth`: the name of the one that the others' PSNR is told against, after the best gain and
      offset.

    **Errors**: ValueError for no image, and a `truth` that is not among them or of other pixels.
    """
    from matplotlib import pyplot

    from thincam_jax.imaging.metrics import psnr

    if not images or (truth is not None and truth not in images):
        raise ValueError(
            f"truth = {truth!r} with the images {list(images)}: give images by name, and the name "
            "of one of them"
        )
    arrays = {
        name: pictures(getattr(one, "image", one), planes=_has_planes(one))[0]
        for name, one in images.items()
    }
    figure, axes = pyplot.subplots(
        1, len(arrays), figsize=(3.2 * len(arrays), 3.4), layout="constrained", squeeze=False
    )
    for ax, (name, image) in zip(axes[0], arrays.items(), strict=True):
        ax.imshow(eight_bit(image), cmap="gray", interpolation="nearest")
        ax.set(xticks=[], yticks=[])
        title = name
        if truth is not None and name != truth:
            target = arrays[truth]
            if target.shape != image.shape:
                pyplot.close(figure)
                raise ValueError(
                    f"{name!r} has shape {image.shape}, the truth {target.shape}; give the truth "
                    "on the same pixels, as by ImagePlane.sample"
                )
            title += f", {psnr(image, target, float(np.ptp(target))):.1f} dB"
        ax.set_title(title, fontsize=9)
    return figure


def _has_planes(one: Any) -> bool:
    return isinstance(one, Reconstruction) and one.has_planes
