"""The USAF-1951 three-bar resolution chart (MIL-STD-150A), drawn by exact area coverage.

An element is a pair of three-bar sets, one with vertical bars (it tests the resolution along x) and
one with horizontal bars (along y). A set is a square of 5 by 5 bar widths: three bars, 5 bar widths
long, and two gaps as wide as a bar. Element e of group g has the spatial frequency

    f = 2^(g + (e − 1)/6) · f₀,       bar width = 1/(2f)

with f₀ = 1 line pair/mm on a chart of the standard size. Six elements make an octave.

A layer of the chart holds an even group (element 1 at the lower right, 2 to 6 down the left side)
and the next odd group (1 to 6 down the right side), with a solid square as large as one set of
element 1 to the left of that element. The next layer is the same a quarter as large, in the free
space in the middle. The standard fixes the bars and this order; the spaces between the elements are
chosen here. The numerals that label groups and elements on a printed chart are not drawn.

Lengths in this file are fractions of the chart's width, or bar widths of the layer's element 1.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float64

from thincam_jax._core import checks
from thincam_jax._core.arguments import checked

Orientation = Literal["vertical", "horizontal"]
POLARITIES = ("bright_on_dark", "dark_on_bright")
Rectangle = tuple[float, float, float, float]  # top, bottom, left, right

# One layer, in bar widths of its element 1, from the layer's centre.
_CHART = 32.0  # side of the square chart, margin included
_BOTTOM, _RIGHT = 12.0, 14.0  # half the height and half the width of the drawing
_SQUARE = (7.0, 12.0, -4.5, 0.5)  # the solid square
_NEXT_LAYER = (-2.5, 2.25)  # where the centre of the next layer lies
_NEXT_SCALE = 1 / 4


@dataclass(frozen=True)
class UsafElement:
    """One three-bar set of the chart.

    - `group`, `element`: the labels, element from 1 to 6.
    - `orientation`: "vertical" bars test the resolution along x, "horizontal" bars along y.
    - `centre`: (y, x) of the set from the chart's centre, +y down, in fractions of its width.
    - `bar`: width of a bar, in fractions of the chart's width; a line pair is two of them.
    """

    group: int
    element: int
    orientation: Orientation
    centre: tuple[float, float]
    bar: float


def usaf1951_elements(layers: int = 3, first_group: int = -2) -> tuple[UsafElement, ...]:
    """All three-bar sets of the chart, from the coarsest layer in: 24 in each layer.

    `first_group` only labels the outermost even group; −2 is the standard chart's, and there a
    chart 64 mm wide has 2^(group + (element − 1)/6) line pairs/mm. The bar of its element 1 is 1/32
    of the chart's width, whatever its label.

    Raises ValueError for less than one layer or an odd `first_group`.
    """
    layers = checks.whole("layers", layers, 1, 100)
    if checks.whole("first_group", first_group, -100, 100) % 2:
        raise ValueError(
            f"first_group = {first_group!r} is not an even whole number; a layer begins with an "
            "even group, such as -2 or 0"
        )
    return tuple(
        UsafElement(
            group=int(first_group) + 2 * layer + step,
            element=element,
            orientation=orientation,
            centre=((y0 + scale * y) / _CHART, (x0 + scale * (x + shift * bar)) / _CHART),
            bar=scale * bar / _CHART,
        )
        for layer, (scale, y0, x0) in enumerate(_layers(layers))
        for step, element, y, x in _pairs()
        for bar in (_bar(step, element),)
        for orientation, shift in _SETS
    )


def usaf1951(
    shape: tuple[int, int],
    *,
    layers: int = 3,
    polarity: str = "bright_on_dark",
    pixels_per_chart: float | int | None = None,
) -> Float64[np.ndarray, "y x"]:
    """The chart as an image in [0, 1], centred, each pixel holding its exact area coverage.

    - `shape`: (rows, columns) of the image.
    - `layers`: number of pairs of groups; the n-th layer's bars are 4^(1−n) as wide as the first's.
    - `polarity`: "bright_on_dark" for bright bars, or its negative "dark_on_bright".
    - `pixels_per_chart`: side of the square chart in pixels; by default the smaller side of
      `shape`. What does not fit into the image is cut off.

    A pixel's value is the fraction of its area that a bar covers, which for an upright rectangle is
    the product of two overlaps of intervals; nothing is supersampled. So the sum over the image is
    the bars' area in pixels at any size. Bars narrower than a pixel fade to grey. In an image with
    even sides and `pixels_per_chart` = 32·2ⁿ, the bars of element 1 lie on whole pixels, as long as
    they are not narrower than one.

    Raises ValueError for a shape, layers, polarity or size that makes no chart.
    """
    rows, columns = checks.shape2d("shape", shape)
    layers = checks.whole("layers", layers, 1, 100)
    checks.choice("polarity", polarity, POLARITIES)
    width = min(rows, columns) if pixels_per_chart is None else pixels_per_chart
    checks.positive("pixels_per_chart", width, "pixels")
    image = np.zeros((rows, columns))
    for top, bottom, left, right in _rectangles(layers):
        _add_coverage(
            image,
            (top * width + rows / 2, bottom * width + rows / 2),
            (left * width + columns / 2, right * width + columns / 2),
        )
    image = np.clip(image, 0.0, 1.0)  # rounding only: no two rectangles overlap
    return image if polarity == "bright_on_dark" else 1.0 - image


@checked
def line_pair(element: UsafElement, width: float | int) -> float:
    """The period of an element, one bar and one gap, in mm, on a chart `width` mm wide.

    Its inverse is the spatial frequency in cycles/mm. Raises ValueError unless `width` > 0.
    """
    checks.positive("width", width, "mm")
    return 2 * element.bar * float(width)


# The two sets of an element stand side by side, two bar widths apart: (orientation, shift of x).
_SETS: tuple[tuple[Orientation, float], ...] = (("vertical", -3.5), ("horizontal", 3.5))


def _bar(step: int, element: int) -> float:
    """Bar width relative to element 1 of the even group; `step` is 1 in the odd group."""
    return 2.0 ** -(step + (element - 1) / 6)


def _pairs() -> Iterator[tuple[int, int, float, float]]:
    """(step, element, y, x): the centres of the elements of one layer, 12 by 5 bar widths each."""
    yield 0, 1, _BOTTOM - 2.5, _RIGHT - 6.0
    for step, first, side in ((0, 2, -1), (1, 1, +1)):
        top = -_BOTTOM
        for element in range(first, 7):
            bar = _bar(step, element)
            yield step, element, top + 2.5 * bar, side * (_RIGHT - 6.0 * bar)
            top += 7.0 * bar  # the set, and two bar widths free below it


def _layers(layers: int) -> Iterator[tuple[float, float, float]]:
    """(scale, y, x) of each layer, in bar widths of the outermost element 1."""
    scale, y, x = 1.0, 0.0, 0.0
    for _ in range(layers):
        yield scale, y, x
        y, x = y + scale * _NEXT_LAYER[0], x + scale * _NEXT_LAYER[1]
        scale *= _NEXT_SCALE


def _rectangles(layers: int) -> Iterator[Rectangle]:
    """All rectangles, as fractions of the chart's width from its centre."""
    for scale, y, x in _layers(layers):
        top, bottom, left, right = _SQUARE
        yield (
            (y + scale * top) / _CHART,
            (y + scale * bottom) / _CHART,
            (x + scale * left) / _CHART,
            (x + scale * right) / _CHART,
        )
    for element in usaf1951_elements(layers):
        yield from _bars(element)


def _bars(element: UsafElement) -> Iterator[Rectangle]:
    """The three bars of a set."""
    (y, x), w = element.centre, element.bar
    for shift in (-2 * w, 0.0, 2 * w):
        if element.orientation == "vertical":
            yield y - 2.5 * w, y + 2.5 * w, x + shift - 0.5 * w, x + shift + 0.5 * w
        else:
            yield y + shift - 0.5 * w, y + shift + 0.5 * w, x - 2.5 * w, x + 2.5 * w


def _add_coverage(image: np.ndarray, y: tuple[float, float], x: tuple[float, float]) -> None:
    """Add to each pixel the fraction that the rectangle y by x covers; pixel i spans i to i + 1."""
    (rows, in_y), (columns, in_x) = _overlap(*y, image.shape[0]), _overlap(*x, image.shape[1])
    image[rows, columns] += np.outer(in_y, in_x)


def _overlap(low: float, high: float, count: int) -> tuple[slice, np.ndarray]:
    """The pixels that the interval touches, and the length of each that lies inside it."""
    start = min(max(int(np.floor(low)), 0), count)
    stop = min(max(int(np.ceil(high)), start), count)
    edges = np.arange(start, stop)
    return slice(start, stop), np.minimum(edges + 1, high) - np.maximum(edges, low)
