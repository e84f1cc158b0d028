"""The figure that every plot is drawn on: its axes, lines, grey levels and PNG file."""

import io
import math
import re
import textwrap
from typing import Any

import matplotlib.figure
import numpy as np
import PIL.Image
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.image import AxesImage
from matplotlib.text import Text


class Figure(matplotlib.figure.Figure):
    """A figure of pyplot that a notebook shows once.

    Jupyter shows the value of a cell's last line, and then all figures that are open. So a figure
    that is shown is open no longer.
    """

    def _ipython_display_(self) -> None:
        from matplotlib import pyplot

        if "inline" in matplotlib.get_backend():
            pyplot.close(self)
        raise NotImplementedError  # IPython goes on to the picture

    def _repr_png_(self) -> bytes:
        return as_png(self)  # until IPython knows how pyplot's are drawn


def new_figure(width: float, height: float) -> Figure:
    """An empty figure of a size in inches."""
    # A report's pages draw without pyplot, which looks for a screen when it is imported.
    from matplotlib import pyplot

    figure = pyplot.figure(figsize=(width, height), layout="constrained", FigureClass=Figure)
    assert isinstance(figure, Figure)
    return figure


def show_image(axes: Axes, image: Any, pitch: float | None, **options: Any) -> AxesImage:
    """Draw an image (y, x) or (y, x, 3) on axes in mm about its middle, +y down.

    - `pitch`: distance of its pixels, mm; None: axes count pixels.
    - `options`: options of `matplotlib.axes.Axes.imshow`.
    """
    image = np.asarray(image)
    rows, columns = (n * (pitch or 1) / 2 for n in image.shape[:2])
    extent = (-columns, columns, rows, -rows) if pitch else None
    shown = axes.imshow(image, extent=extent, **{"cmap": "gray", **options})
    unit = "mm" if pitch else "pixels"
    axes.set(xlabel=f"x ({unit})", ylabel=f"y ({unit})")
    return shown


def grey_levels(image: np.ndarray, white: float) -> np.ndarray:
    """Radiance as 0…1: black stays black, `white` and above are white."""
    return np.clip(np.asarray(image, dtype=float) / (white if white > 0 else 1.0), 0.0, 1.0)


def white_level(images: np.ndarray) -> float:
    """The radiance shown white: all but the brightest two in a thousand pixels."""
    return float(np.percentile(images, 99.8))


# Told apart by dash and marker as well as by colour, so that they read in grey.
_LINES = (
    {"color": "#9a9a9a", "linestyle": "-", "marker": "o"},
    {"color": "#d08020", "linestyle": "--", "marker": "s"},
    {"color": "#1060a0", "linestyle": "-", "marker": "^"},
    {"color": "#000000", "linestyle": ":", "marker": "D"},
    {"color": "#7030a0", "linestyle": "-.", "marker": "v"},
)


def line_style(index: int) -> dict:
    """Colour, dash and marker of the curve of that number."""
    return dict(_LINES[index % len(_LINES)])


def drawing(
    size: tuple[float | int, float | int],
    rows: int = 1,
    columns: int = 1,
    *,
    figure: matplotlib.figure.Figure | None = None,
    **how: Any,
) -> Any:
    """A figure of a size in inches, the one given or a new one, and its axes.

    `how`: options of `Figure.subplots`.
    """
    figure = matplotlib.figure.Figure() if figure is None else figure
    figure.set_size_inches(*size)
    figure.set_layout_engine("constrained")
    return figure, figure.subplots(rows, columns, **how)


def sheet(
    count: int, most: int, side: float, aspect: float, room: float
) -> tuple[matplotlib.figure.Figure, list[Axes]]:
    """A figure with so many places for pictures, at most `most` beside each other, without axes.

    `side`: width of a place; `aspect`: height of its picture over that; `room`: above it.
    """
    columns = min(most, count)
    rows = math.ceil(count / columns)
    size = (side * columns, rows * (side * aspect + room))
    figure, axes = drawing(size, rows, columns, squeeze=False)
    axes = axes.ravel()
    for ax in axes:
        ax.set(xticks=[], yticks=[])  # ticks take time where they are not seen, too
        ax.set_axis_off()
    return figure, list(axes[:count])


def as_png(figure: matplotlib.figure.Figure) -> bytes:
    """Content of a PNG file of a figure, no letters below 12 pixels where it is 850 pixels wide.

    Titles and labels wider than their panel are broken, after commas.
    """
    width = figure.get_figwidth()
    least = 72 * 12 / min(110, 850 / width)
    for text in figure.findobj(Text):
        text.set_fontsize(max(text.get_fontsize(), least))
    for ax in figure.axes:
        ax.tick_params(labelsize=max(10, least))
        if (place := ax.get_subplotspec()) is not None:
            inches = width * len(place.colspan) / place.get_gridspec().ncols
            for text in (ax.title, ax.xaxis.label):
                most = max(1, int(72 * inches / (0.58 * float(text.get_fontsize()))))
                lines = re.sub("(?<!,) ", "\xa0", text.get_text()).splitlines()
                text.set_text("\n".join(textwrap.fill(line, most) for line in lines))
    shown, dpi, buffer = figure.canvas, figure.dpi, io.BytesIO()
    figure.set_dpi(110)
    canvas = FigureCanvasAgg(figure)
    canvas.draw()  # once; savefig draws, and resamples each picture, twice
    pixels = PIL.Image.fromarray(np.asarray(canvas.buffer_rgba())[..., :3])  # none is transparent
    pixels.save(buffer, "png", dpi=(110, 110), compress_level=2)  # half the time, and no larger
    figure.set_canvas(shown)
    figure.set_dpi(dpi)
    return buffer.getvalue()
