"""The figure that every plot is drawn on, and images with their place in mm."""

from typing import Any

import matplotlib.figure
import numpy as np
from matplotlib.axes import Axes
from matplotlib.image import AxesImage


class Figure(matplotlib.figure.Figure):
    """A figure of pyplot that a notebook shows once.

    Jupyter shows the open figures of pyplot at the end of a cell, and the value of its last line
    as well. While pyplot will show the figure, its value shows nothing.
    """

    def _ipython_display_(self) -> None:
        from matplotlib import pyplot

        if not pyplot.fignum_exists(getattr(self, "number", -1)):
            raise NotImplementedError  # IPython goes on to the usual picture of a figure


def new_figure(width: float, height: float) -> Figure:
    """An empty figure of a size in inches."""
    # A report's pages draw without pyplot, which looks for a screen when it is imported.
    from matplotlib import pyplot

    figure = pyplot.figure(figsize=(width, height), layout="constrained", FigureClass=Figure)
    assert isinstance(figure, Figure)
    return figure


def show_image(axes: Axes, image: Any, pitch: float, **options: Any) -> AxesImage:
    """Draw an image (y, x) or (y, x, 3) on axes in mm about its middle, +y down.

    - `pitch`: distance of its pixels, mm.
    - `options`: of `matplotlib.axes.Axes.imshow`.
    """
    image = np.asarray(image)
    rows, columns = (n * pitch / 2 for n in image.shape[:2])
    extent = (-columns, columns, rows, -rows)
    shown = axes.imshow(image, extent=extent, **{"cmap": "gray", **options})
    axes.set(xlabel="x (mm)", ylabel="y (mm)")
    return shown
