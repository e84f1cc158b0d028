"""Names beside the points of a graph, where they cover nothing."""

import itertools
import math
from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.text import Annotation, Text
from matplotlib.transforms import Bbox

# Distances (points) and directions in which a label is tried, the most usual first.
_DISTANCES = (6.0, 11.0, 18.0, 27.0, 38.0, 52.0, 70.0, 90.0)
_DIRECTIONS = (45.0, -45.0, 135.0, -135.0, 0.0, 180.0, 90.0, -90.0, -20.0, 20.0, -160.0, 160.0)
# A leader joins a label to its point from here on.
_FAR = 15.0


def place_labels(
    ax: Axes,
    points: Sequence[tuple[float, float]],
    names: Sequence[str],
    *,
    lines: Sequence[Sequence[tuple[float, float]]] = (),
    fontsize: float = 8.5,
) -> None:
    """Write each name beside its point, clear of all points, of lines and of other names.

    `lines` are paths in data coordinates. The axes must have their
    final limits and place: draw the figure first.
    """
    legend = ax.get_legend()
    taken = [legend.get_window_extent()] if legend else []
    taken += [text.get_window_extent() for text in ax.texts]
    taken += [_around(p) for p in _pixels(ax, points)]
    for path in lines:
        taken += [_around(p, 3.0) for p in _along(_pixels(ax, path))]
    for point, name in zip(points, names, strict=True):
        taken.append(_place(ax, point, name, taken, fontsize))


def _place(ax: Axes, point, name: str, taken: list[Bbox], fontsize: float) -> Bbox:
    """The label's box at the first free place, else at the one that covers least."""
    best = None
    for distance, direction in itertools.product(_DISTANCES, _DIRECTIONS):
        label = _annotate(ax, point, name, distance, direction, fontsize)
        box = _box(label)
        cost = sum(_overlap(box, other) for other in taken)
        inside = _overlap(box, ax.get_window_extent().padded(-3))
        cost += 10 * (box.width * box.height - inside)
        label.remove()
        if best is None or cost < best[0] - 1e-6:
            best = cost, distance, direction
        if cost < 1e-6:
            break
    assert best is not None
    label = _annotate(ax, point, name, *best[1:], fontsize)
    return _box(label).padded(2)


def _annotate(ax: Axes, point, name: str, distance: float, direction: float, fontsize: float):
    right, up = math.cos(math.radians(direction)), math.sin(math.radians(direction))
    return ax.annotate(
        name,
        point,
        xytext=(distance * right, distance * up),
        textcoords="offset points",
        ha="left" if right > 0.1 else "right" if right < -0.1 else "center",
        va="bottom" if up > 0.1 else "top" if up < -0.1 else "center",
        fontsize=fontsize,
        arrowprops={"arrowstyle": "-", "linewidth": 0.5} if distance > _FAR else None,
    )


def _box(label: Annotation) -> Bbox:
    """Where the text stands, without its leader."""
    canvas = label.get_figure(root=True).canvas  # pyright: ignore[reportOptionalMemberAccess]
    label.update_positions(canvas.get_renderer())  # pyright: ignore[reportAttributeAccessIssue]
    return Text.get_window_extent(label)


def _pixels(ax: Axes, points) -> np.ndarray:
    return ax.transData.transform(np.reshape(np.asarray(points, float), (-1, 2)))


def _along(path: np.ndarray) -> list[np.ndarray]:
    """Points some pixels apart on a path."""
    steps = [
        first + (second - first) * t
        for first, second in itertools.pairwise(path)
        for t in np.linspace(0, 1, max(2, int(np.hypot(*(second - first)) / 4)))
    ]
    return steps


def _around(point: np.ndarray, half: float = 6.0) -> Bbox:
    x, y = point
    return Bbox.from_extents(x - half, y - half, x + half, y + half)


def _overlap(first: Bbox, second: Bbox) -> float:
    common = Bbox.intersection(first, second)
    return 0.0 if common is None else common.width * common.height
