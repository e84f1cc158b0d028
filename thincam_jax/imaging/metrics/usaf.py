"""Resolution read off an image of the USAF-1951 chart: contrast of each set, finest one resolved.

Eager NumPy, not differentiable.
"""

import math
from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import ArrayLike, Num

from thincam_jax._core import checks
from thincam_jax._core.arguments import checked
from thincam_jax.imaging.metrics.image import fit_levels
from thincam_jax.imaging.targets.usaf import POLARITIES, UsafElement, usaf1951, usaf1951_elements

_INNER_LENGTH = 0.8  # of the bars' length, averaged
_INNER_WIDTH = 0.5  # of a bar or gap, averaged
_SAMPLES = 16  # of the profile within that


@dataclass(frozen=True)
class UsafContrast:
    """Reading of one three-bar set, on a scale where the chart's dark is 0 and its bright is 1.

    - `element`: the set.
    - `contrast`: (mean of bars − mean of gaps)/(mean of bars + mean of gaps), in [−1, 1]; negative
      where the contrast is reversed.
    - `modulation`: lowest bar − highest gap, the strict three-bar criterion: positive only where
      three bars stand clear of both gaps.
    """

    element: UsafElement
    contrast: float
    modulation: float


@checked
def usaf_contrast(
    image: Num[ArrayLike, "..."],
    elements: Iterable[UsafElement],
    pixels_per_chart: float | int,
    *,
    polarity: str = "bright_on_dark",
) -> list[UsafContrast]:
    """The contrast of each of `elements` in an image (y, x) of the chart.

    - `image`: the chart upright at the centre of the image, in any linear unit of light.
    - `elements`: from `usaf1951_elements`.
    - `pixels_per_chart`: the width of the whole chart in pixels, margin included, not rounded.
    - `polarity`: polarity of the chart that was imaged, as for `usaf1951`. Bars count as 1 and the
      ground as 0 for both, so a resolved dark bar has positive contrast too.

    The image is first brought to the ideal chart's scale by the magnitude of the least-squares gain
    of `align`. An image that is a negative of its chart keeps its reversed contrast. Noise shrinks
    that gain, so that pure noise has almost no modulation. Then each set is averaged along the
    inner 80 % of its bars, and the profile across them, interpolated linearly, over the inner half
    of each bar and gap. For the contrast, levels below the chart's dark count as dark.

    An element whose bars are narrower than a pixel is beyond the Nyquist frequency.

    Raises ValueError for an image that is not (y, x) or not finite, or a set outside the image.
    """
    pixels = checks.numbers("image", image)
    elements = tuple(elements)
    checks.choice("polarity", polarity, POLARITIES)
    if pixels.ndim != 2:
        raise ValueError(f"image has shape {pixels.shape}; give one channel (y, x)")
    _check_inside(elements, pixels.shape, pixels_per_chart)
    if not elements:
        return []
    scaled = _chart_scale(pixels, _layer_count(elements), float(pixels_per_chart), polarity)
    return [_measure(scaled, element, float(pixels_per_chart)) for element in elements]


@checked
def resolved_element(
    records: Sequence[UsafContrast], threshold: float | int = 0.1
) -> UsafElement | None:
    """The finest element that is resolved along x and y, as its set of vertical bars; or None.

    An element is resolved if both of its sets have a modulation of at least `threshold`. Going from
    coarse to fine, the first one that is not ends the search: what looks resolved beyond it is
    spurious resolution with reversed phase, or chance. None if not even the coarsest is resolved.

    Raises ValueError for no records, an element without both of its sets, or a threshold that is
    not positive.
    """
    checks.positive("threshold", threshold, "")
    if not records:
        raise ValueError("records is empty; give those of usaf_contrast")
    sets: dict[tuple[int, int], dict[str, UsafContrast]] = defaultdict(dict)
    for record in records:
        key = (record.element.group, record.element.element)
        sets[key][record.element.orientation] = record
    finest = None
    for group, element in sorted(sets):
        pair = sets[group, element]
        if pair.keys() != {"vertical", "horizontal"}:
            raise ValueError(
                f"group {group}, element {element} has only {', '.join(pair)} bars; give the "
                "records of both orientations"
            )
        if min(record.modulation for record in pair.values()) < threshold:
            break
        finest = pair["vertical"].element
    return finest


def _chart_scale(
    image: np.ndarray, layers: int, pixels_per_chart: float, polarity: str
) -> np.ndarray:
    """The image on the scale where the ideal chart's ground is 0 and its bars are 1."""
    bright = usaf1951(image.shape, layers=layers, pixels_per_chart=pixels_per_chart)
    pixels = image.astype(np.float64) * (1 if polarity == "bright_on_dark" else -1)
    _, gain, _ = fit_levels(pixels, bright)
    return bright.mean() + abs(gain) * (pixels - pixels.mean())


def _measure(scaled: np.ndarray, element: UsafElement, pixels_per_chart: float) -> UsafContrast:
    levels = _levels(scaled, element, pixels_per_chart)
    bars, gaps = levels[::2], levels[1::2]
    bright, dark = max(bars.mean(), 0.0), max(gaps.mean(), 0.0)
    contrast = (bright - dark) / (bright + dark) if bright + dark > 0 else 0.0
    return UsafContrast(element, float(contrast), float(bars.min() - gaps.max()))


def _levels(scaled: np.ndarray, element: UsafElement, pixels_per_chart: float) -> np.ndarray:
    """Levels of bar, gap, bar, gap, bar, from left to right or from top to bottom."""
    if element.orientation == "vertical":
        along, across = element.centre
    else:
        across, along = element.centre
        scaled = scaled.T
    bar = element.bar * pixels_per_chart
    length = 5 * bar * _INNER_LENGTH
    centre = along * pixels_per_chart + scaled.shape[0] / 2  # from the first pixel's border
    low, high = centre - length / 2, centre + length / 2
    edges = np.arange(math.floor(low), math.ceil(high))
    weights = np.minimum(edges + 1, high) - np.maximum(edges, low)
    profile = weights @ scaled[edges] / weights.sum()
    inside = ((np.arange(_SAMPLES) + 0.5) / _SAMPLES - 0.5) * _INNER_WIDTH
    middle = across * pixels_per_chart + (scaled.shape[1] - 1) / 2  # from the first pixel centre
    position = middle + bar * (np.arange(-2, 3)[:, None] + inside)
    return np.interp(position, np.arange(scaled.shape[1]), profile).mean(axis=1)


def _layer_count(elements: tuple[UsafElement, ...]) -> int:
    """Number of layers that the chart needs to hold the finest of the elements."""
    coarsest = usaf1951_elements(layers=1)[0].bar
    octaves = np.log2(coarsest / min(element.bar for element in elements))
    return int(octaves + 1e-6) // 2 + 1


def _check_inside(
    elements: tuple[UsafElement, ...], shape: tuple[int, ...], pixels_per_chart: float | int
) -> None:
    checks.positive("pixels_per_chart", pixels_per_chart, "pixels")
    for element in elements:
        reach = np.abs(element.centre) + 2.5 * element.bar
        if np.any(reach * pixels_per_chart > np.asarray(shape) / 2 + 1e-6):
            raise ValueError(
                f"group {element.group}, element {element.element} of a chart {pixels_per_chart} "
                f"pixels wide lies outside the image of shape {shape}; give a smaller "
                "pixels_per_chart or the elements inside"
            )
