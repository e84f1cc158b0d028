"""Figures of pictures on a monitor's cells: targets beside reconstructions, columns of a matrix."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import PowerNorm
from matplotlib.figure import Figure

from thincam_jax.plot.frame import drawing

if TYPE_CHECKING:
    from thincam_jax.studies.pictures import Reconstructed


def draw_columns(
    pitch: float,
    cells: list[tuple[int, int]],
    images: Mapping[str, np.ndarray],
    unit: str = "counts for a white cell",
) -> Figure:
    """Captures (cell, y, x) of some cells (row, column) alone, in a unit, on pixels of a pitch, mm.

    The grey goes with the square root, so that ghosts are seen beside the image.
    """
    y, x = (n * pitch / 2 for n in next(iter(images.values())).shape[1:])
    most = max(stack.max() for stack in images.values())
    size, count = (3.0 * len(cells) + 1, 3.0 * len(images)), (len(images), len(cells))
    figure, grid = drawing(size, *count, sharex=True, sharey=True, squeeze=False)
    for line, (name, stack) in zip(grid, images.items(), strict=True):
        for (row, column), ax, image in zip(cells, line, stack, strict=True):
            norm = PowerNorm(0.5, 0, most)
            ax.imshow(image, cmap="gray_r", norm=norm, extent=(-x, x, y, -y))
            ax.set_title(f"cell ({row}, {column}), {name}", fontsize=10)
        line[0].set_ylabel("y on the sensor (mm)")
    for ax in grid[-1]:
        ax.set_xlabel("x on the sensor (mm)")
    figure.colorbar(grid[0, 0].images[0], ax=grid, label=unit)
    return figure


def labels(found: "Reconstructed") -> list[str]:
    scores = [decibels(score.psnr_db) for score in found.scores.targets.values()]
    return scores or [""] * len(found.images)


def decibels(score: float | None) -> str:
    return "" if score is None else f"{score:.1f} dB"


def draw_beside(
    targets: Mapping[str, np.ndarray],
    columns: Sequence[tuple[str, list[np.ndarray], list[str]]],
    figure: Figure | None = None,
) -> Figure:
    """A row for each target; columns of a title, images and their labels beside it."""
    size = (1.75 * (len(columns) + 1), 1.95 * len(targets))
    shape = len(targets), len(columns) + 1
    drawn, rows = drawing(size, *shape, figure=figure, squeeze=False)
    for number, ((target, truth), axes) in enumerate(zip(targets.items(), rows, strict=True)):
        show_panel(axes[0], truth, target, "" if number else "target")
        for ax, (title, images, labels) in zip(axes[1:], columns, strict=True):
            show_panel(ax, images[number], labels[number], "" if number else title)
    return drawn


def show_panel(ax: Axes, image: np.ndarray, label: str, title: str) -> None:
    ax.imshow(np.clip(image, 0, 1), cmap="gray", vmin=0, vmax=1)
    ax.set(xticks=[], yticks=[])
    ax.set_xlabel(label, fontsize=9)
    ax.set_title(title, fontsize=9)
