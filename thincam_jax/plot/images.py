"""Figures of images: a capture, and reconstructions beside each other."""

from collections.abc import Mapping
from itertools import cycle
from typing import TYPE_CHECKING, Any

import matplotlib.figure
import numpy as np
from matplotlib.ticker import MaxNLocator

from thincam_jax._core.arguments import checked
from thincam_jax._core.checks import Number, pixel_pitch
from thincam_jax.imaging.encoding import eight_bit, pictures
from thincam_jax.imaging.metrics import psnr
from thincam_jax.imaging.sensor import Sensor
from thincam_jax.plot.frame import Figure, drawing, new_figure, sheet, show_image

if TYPE_CHECKING:
    from thincam_jax.reconstruction.result import Reconstruction

_BESIDE, _MOST = 4, 16  # images in a row, and in all, that a result shows of itself


@checked
def capture(image: Any, sensor: Sensor | Number) -> Figure:
    """A capture on its sensor, from zero to its own maximum.

    - `image`: (y, x) or (3, y, x); of a batch the first is shown.
    - `sensor`: the sensor, or the pitch of its pixels in mm.
    """
    pitch = sensor.pitch if isinstance(sensor, Sensor) else pixel_pitch("pitch", sensor)
    shown = pictures(image)[0]
    figure = new_figure(5.0, 4.0)
    axes = figure.subplots()
    if shown.ndim == 3:
        show_image(axes, eight_bit(shown, percentile=100), float(pitch))
    else:
        grey = show_image(axes, shown, float(pitch), vmin=min(0.0, shown.min()))
        figure.colorbar(grey, ax=axes, label="pixel value")
    return figure


@checked
def compare(images: Mapping[str, Any], *, truth: str | None = None) -> Figure:
    """Images beside each other, each from black to its own white, encoded by sRGB once.

    They are light: a photograph by `load_image`, not its codes.

    Axes are in mm on the object where a reconstruction knows its pitch.

    - `images`: by name, (y, x), (3, y, x) or a photograph (y, x, 3), or what `tc.reconstruct`
      returns. Of several in a batch the first is shown.
    - `truth`: the name of the reference; the others' PSNR is reported against it, after the best
      gain and offset.

    **Errors**: ValueError for no image, and a `truth` that is not among them or of other pixels.
    """
    if not images or (truth is not None and truth not in images):
        raise ValueError(
            f"truth = {truth!r} with the images {list(images)}: give images by name, and the name "
            "of one of them"
        )
    arrays = {
        name: pictures(getattr(one, "image", one), planes=getattr(one, "has_planes", False))[0]
        for name, one in images.items()
    }
    for name, image in arrays.items():
        if truth is not None and image.shape != arrays[truth].shape:
            raise ValueError(
                f"{name!r} has shape {image.shape}, the truth {arrays[truth].shape}; give the "
                "truth on the same pixels, as by ImagePlane.sample"
            )
    # Images of one height; constrained layout alone cuts the titles of square ones.
    widths = [np.clip(image.shape[1] / image.shape[0], 0.4, 2.5) for image in arrays.values()]
    labels = 0.7 * sum(getattr(one, "pitch", None) is not None for one in images.values())
    height = min(3.2 * len(widths) / sum(widths), 4.0)
    figure = new_figure(height * sum(widths) + labels + 0.1 * len(widths), height + 0.8)
    figure.set_layout_engine("compressed")
    panels = figure.subplots(1, len(widths), squeeze=False, width_ratios=widths)[0]
    for ax, (name, image) in zip(panels, arrays.items(), strict=True):
        pitch = getattr(images[name], "pitch", None)
        if pitch is None:
            ax.imshow(eight_bit(image), cmap="gray", interpolation="nearest")
            ax.set(xticks=[], yticks=[])
        else:
            show_image(ax, eight_bit(image), float(np.ravel(pitch)[0]))
        title = name
        if truth is not None and name != truth:
            target = arrays[truth]
            title += f", {psnr(image, target, data_range=float(np.ptp(target))):.1f} dB"
        ax.set_title(title, fontsize=9)
    return figure


def draw_result(result: "Reconstruction") -> matplotlib.figure.Figure:
    """A reconstruction on axes in mm on the object, or in pixels where its pitch is unknown.

    Of a batch and of planes the first images, beside each other and with one white.
    """
    every = pictures(result.image, planes=result.has_planes)
    images = every[:_MOST]
    pitches = [None] if result.pitch is None else np.ravel(result.pitch).tolist()
    aspect = np.clip(images[0].shape[0] / images[0].shape[1], 0.25, 2.0)
    figure, panels = sheet(len(images), _BESIDE, max(5.0 / len(images), 2.5), aspect, 0.2)
    for ax, image, pitch in zip(panels, eight_bit(np.stack(images)), cycle(pitches), strict=False):
        show_image(ax, image, pitch, vmin=0, vmax=255)
        ax.set_axis_on()
        for axis in (ax.xaxis, ax.yaxis):
            axis.set_major_locator(MaxNLocator(4 if len(images) > 1 else "auto"))
    if len(every) > _MOST:
        figure.suptitle(f"the first {_MOST} of {len(every)} images")
    return figure


def draw_widths(width: np.ndarray) -> matplotlib.figure.Figure:
    """Widths of intervals about the pixels of an image (channel, y, x), colours averaged."""
    figure, ax = drawing((5, 5 * width.shape[-2] / width.shape[-1] + 0.4))
    shown = show_image(ax, width.mean(axis=0), None, vmin=0)
    figure.colorbar(shown, ax=ax, label="width of the intervals")
    return figure
