"""Values that measure no light: a plateau where light is cut off, defective, unknown pixels."""

import functools
import math
from dataclasses import dataclass

import numpy as np
import scipy
from jaxtyping import Bool, Float, Shaped

from thincam_jax._core.grids import block_sum, central_blocks

_FEW = 20  # pixels at one value that a clean image may have
_STEEP = 3.0  # times as many pixels as at each of the values below
_ISOLATED = 3.0  # times the range of the neighbours, by which a defective pixel exceeds them
_CERTAIN = 8.0  # standard deviations of the noise, or counts
_SPREAD = 0.1  # share of a point of light that its neighbours have at least
_OUTER = np.flatnonzero(np.pad(np.zeros((3, 3)), 1, constant_values=1))  # of 5×5 pixels
# 16 bit as signed: numbers around 0, their least share, and different ones on each side.
_SIGNED, _NEAR, _OFTEN, _SIDES = 2**15, 12, 1e-3, 3
RING = np.array([[1, 1, 1], [1, 0, 1], [1, 1, 1]], bool)
_SWEEPS = 30  # of a relaxation, from means of blocks
_MOST, _WIDE = 0.1, 4  # share of pixels at one value, and width of lines, that are stuck
_APART = 4.0  # times the range of the `_FEW` next values, by which a lowest value is apart
_BLOCKS, _LARGE = 4, 9  # blocks at one value, and pixels of one that is no shadow
_SQUARE = np.ones((3, 3), bool)
_LIT = 0.15  # largest part of the mean light that a dark place may hold
# Image over the side of a corner, pixels of one at least, the largest difference of its quarters
# over its level, and the least level over the mean light above it, which costs 0.4 to 0.9 dB.
_CORNER, _SMALL, _EVEN, _PEDESTAL = 8, 4, 0.1, 0.05


def plateau(pixels: Shaped[np.ndarray, "*shape"]) -> int:
    """Count the pixels at the largest value where more than noise puts there, else 0."""
    below = pixels[pixels < pixels.max()]
    count = pixels.size - below.size
    if count < _FEW or below.size < _FEW:
        return 0
    kept = min(below.size, below.size // 8 + 1000)
    _, counts = np.unique(np.partition(below, -kept)[-kept:], return_counts=True)
    return count if counts.size >= 16 and count > _STEEP * counts[-8:].max() else 0


def wrapped(pixels: np.ndarray) -> float:
    """Share of 16-bit counts that are negative numbers, 65535 for −1; 0 where they are none.

    The numbers on both sides of 0 are then taken as often; counts spread over more of the range,
    or are one value where they are cut off.
    """
    if pixels.dtype != np.uint16 or pixels.size == 0 or int(pixels.max()) < _SIGNED:
        return 0.0
    signed = pixels.astype("=u2").view(np.int16)
    near = signed[np.abs(signed.astype(np.int32)) <= _NEAR]
    sides = [near[near < 0], near[near > 0]]
    if min(one.size for one in sides) <= max(_SIDES, _OFTEN * pixels.size):
        return 0.0
    is_wrapped = min(np.unique(one).size for one in sides) >= _SIDES
    return float(np.mean(signed < 0)) if is_wrapped else 0.0


def wrapped_words(share: float) -> str:
    """Words for such a share, and what to do."""
    return (
        f"{100 * share:.2g} % of the counts are negative numbers in uint16, 65535 for -1; subtract "
        "from image.astype(float), or give the background"
    )


def defects(plane: Float[np.ndarray, "y x"], step: float = 0.0) -> Bool[np.ndarray, "y x"]:
    """Map of single pixels of one colour that differ from all neighbours as no light does.

    - `step`: step between values, 1 for counts.
    """
    if min(plane.shape) < 8:
        return np.zeros(plane.shape, bool)
    # Without scipy's filters, whose import takes longer than a whole check, where nothing is found.
    padded, (rows, columns) = np.pad(plane, 1, mode="reflect"), plane.shape
    beside = [padded[y : y + rows, x : x + columns] for y, x in np.argwhere(RING)]
    high, low = (functools.reduce(one, beside) for one in (np.maximum, np.minimum))
    beyond = np.maximum(plane - high, low - plane)
    middle, top = np.percentile(plane, [50, 99.5])
    floor = max(_CERTAIN * max(fine_noise(plane), step), 0.01 * (top - middle))
    odd = beyond > np.maximum(_ISOLATED * (high - low), floor)
    rows, columns = np.nonzero(odd)
    if not 0 < rows.size <= max(_FEW, odd.size // 100):
        return np.zeros_like(odd)
    # Light of a point reaches the neighbours; a defect does not raise them above what is around.
    padded = np.pad(plane, 2, mode="reflect")
    squares = np.lib.stride_tricks.sliding_window_view(padded, (5, 5))[rows, columns]
    cross = squares[:, [1, 2, 2, 3], [2, 1, 3, 2]].mean(axis=1)
    outer = np.median(squares.reshape(-1, 25)[:, _OUTER], axis=1)
    sign = np.sign(plane[rows, columns] - cross)
    odd[rows, columns] = sign * (cross - outer) <= _SPREAD * beyond[rows, columns]
    # A mask as fine as a pixel, or points that are all the light there is, are no defects.
    around = scipy.ndimage.binary_dilation(odd, np.ones((5, 5), bool))
    base = scipy.ndimage.minimum_filter(plane, 5, mode="mirror")
    mean = (9 * scipy.ndimage.uniform_filter(plane, 3, mode="mirror") - plane) / 8
    sharp = (plane - base > floor) & (mean - base < 0.25 * (plane - base)) & ~around
    light = np.maximum(np.abs(plane - middle) - floor / 2, 0)
    is_structure = 2 * sharp.sum() > odd.sum() or light[odd].sum() > 0.3 * light.sum()
    return odd & ~is_structure


def stuck(plane: Float[np.ndarray, "y x"], step: float = 0.0) -> Bool[np.ndarray, "y x"]:
    """Map of pixels at a lowest value that none comes near, and of lines and blocks of one value.

    A sensor's black level lies above 0 by more than its noise: blocks and padding at 0 do not. Up
    to `_WIDE` lines that are one value throughout, beside others that are not: the lowest or
    highest, or any where a background was subtracted and no more lines are.
    Up to `_BLOCKS` blocks of the lowest or highest value, without the blur of light around them.

    - `step`: step between values, 1 for counts.
    """
    low, high = plane.min(), plane.max()
    found, others = np.zeros(plane.shape, bool), plane[plane > low]
    if min(plane.shape) < 8 or others.size <= _FEW:
        return found
    darkest = np.partition(others, _FEW)[: _FEW + 1]
    floor = max(_APART * float(np.ptp(darkest)), _CERTAIN * step, 0.01 * float(high - low))
    if 1 < plane.size - others.size < _MOST * plane.size and darkest.min() - low > floor:
        found |= plane == low
    for lines, marked in ((plane, found), (plane.T, found.T)):
        flat = np.flatnonzero(np.ptp(lines, axis=1) == 0)
        few = lines[flat, 0] if flat.size <= _WIDE else ()
        for value, most in {**dict.fromkeys(few, 0.5), low: _MOST, high: _MOST}.items():
            share = np.pad((lines == value).mean(axis=1), 1)
            edges = np.flatnonzero(np.diff(np.pad(share[1:-1] == 1, 1).astype(int)))
            for first, last in edges.reshape(-1, 2):
                alone = max(share[first], share[last + 1]) < most
                marked[first:last] |= bool(alone) and last - first <= _WIDE
    for value in (low, high):
        same = (plane == value) & ~found
        found |= _blocks(plane, same, step)
    return found


@dataclass(frozen=True)
class _Block:
    """Connected pixels at one value; `edge`: differences of the pixels around from it."""

    number: int
    size: int
    is_rectangle: bool
    edge: np.ndarray

    def is_sharp(self, least: float, usual: float) -> bool:
        """Steps at all its edges are twice those between neighbours elsewhere."""
        return bool(self.edge.min() > max(2 * usual, least))

    def is_whole(self, spread: float) -> bool:
        """A rectangle with an eighth of the plane's range at all its edges."""
        return self.is_rectangle and bool(self.edge.min() > spread / 8)

    def is_deep(self, least: float) -> bool:
        """Large, amid light that is even: noise would lift some pixels of a shadow."""
        rise = max(least, float(np.median(self.edge)) / 2)
        return self.is_large and bool(self.edge.min() > rise)

    @property
    def is_large(self) -> bool:
        return self.is_rectangle and self.size >= _LARGE


def _blocks(plane: np.ndarray, same: np.ndarray, step: float) -> np.ndarray:
    """Blocks of at least 2×2 pixels at the `same` extreme value, with steps at all their edges.

    A few that are sharp, or whole where no other pixel comes near their value; deep ones that are
    dark where there is noise.
    """
    seeds = np.zeros_like(same)
    seeds[1:, 1:] = same[1:, 1:] & same[1:, :-1] & same[:-1, 1:] & same[:-1, :-1]
    if not seeds.any():
        return seeds
    labels, count = scipy.ndimage.label(same, _SQUARE)
    numbers = np.unique(labels[seeds])
    value, spread = float(plane[same][0]), float(np.ptp(plane))
    least = max(_CERTAIN * step, 0.02 * spread)
    few = numbers.size <= _BLOCKS and same.sum() < _MOST * plane.size
    gap = float(np.abs(plane[~same] - value).min())
    is_alone = few and count == numbers.size and gap > least
    is_noisy = fine_noise(plane) > 0 and value == plane.min()
    usual = _usual_step(plane, np.isin(labels, numbers)) if few else np.inf
    found = _each_block(plane, labels, numbers, value)
    rules = (
        (0.3, [one for one in found if few and one.is_sharp(least, usual)]),
        (0.6, [one for one in found if is_alone and one.is_whole(spread)]),
        (0.3, [one for one in found if is_noisy and one.is_deep(least)]),
    )
    light, marked = np.abs(plane - float(np.median(plane))), np.zeros_like(same)
    for most, blocks in rules:
        some = np.isin(labels, [one.number for one in blocks])
        if len(blocks) <= _BLOCKS and light[some].sum() < most * light.sum():
            marked |= some
    return marked


def _usual_step(plane: np.ndarray, blocks: np.ndarray) -> float:
    """The largest step between neighbours but for one in a thousand, away from blocks."""
    away = np.where(scipy.ndimage.binary_dilation(blocks, _SQUARE), np.nan, plane)
    steps = np.concatenate([np.abs(np.diff(away, axis=axis)).ravel() for axis in (0, 1)])
    return float(np.quantile(np.append(steps[np.isfinite(steps)], 0.0), 0.999))


def _each_block(
    plane: np.ndarray, labels: np.ndarray, numbers: np.ndarray, value: float
) -> list[_Block]:
    """The labelled blocks; of many only the large ones, since each takes time."""
    places, sizes, found = scipy.ndimage.find_objects(labels), np.bincount(labels.ravel()), []
    for number in numbers:
        sides = places[number - 1]
        is_rectangle = bool(sizes[number] == math.prod(one.stop - one.start for one in sides))
        if numbers.size > _BLOCKS and not (is_rectangle and sizes[number] >= _LARGE):
            continue
        part = tuple(slice(max(one.start - 1, 0), one.stop + 1) for one in sides)
        own = labels[part] == number
        around = scipy.ndimage.binary_dilation(own, _SQUARE) & ~own
        edge = np.abs(plane[part][around] - value)
        found.append(_Block(int(number), int(sizes[number]), is_rectangle, edge))
    return found


def filled_by_neighbours(
    plane: Shaped[np.ndarray, "y x"], unknown: Bool[np.ndarray, "y x"]
) -> Shaped[np.ndarray, "y x"]:
    """An image of one colour whose unknown pixels are the means of the four around them.

    So are soap films (Laplace's equation): none is above or below all known pixels. The start,
    means of ever larger blocks, and few sweeps bring near pixels there, and far ones close to it.
    """
    rows, columns = np.nonzero(unknown)
    if rows.size in (0, plane.size):
        return plane
    values = _means_of_blocks(plane.astype(np.float64), ~unknown)
    (height, width), beside = plane.shape, []
    for y, x in ((-1, 0), (1, 0), (0, -1), (0, 1)):
        near = (
            height - 1 - abs(height - 1 - abs(rows + y)),
            width - 1 - abs(width - 1 - abs(columns + x)),
        )
        beside.append(near)
    for _ in range(_SWEEPS):
        values[rows, columns] = np.mean([values[one] for one in beside], axis=0)
    values = np.rint(values) if plane.dtype.kind in "iu" else values
    return np.where(unknown, values, plane).astype(plane.dtype)


def _means_of_blocks(values: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Values, and where they are not known the mean of the smallest block of 2ⁿ that has one."""
    if known.all() or max(values.shape) == 1:
        return values
    odd = [(0, n % 2) for n in values.shape]
    shape = [-(-n // 2) for n in values.shape]
    counts, sums = (
        np.pad(one, odd).reshape(shape[0], 2, shape[1], 2).sum(axis=(1, 3))
        for one in (known.astype(float), np.where(known, values, 0))
    )
    coarse = _means_of_blocks(sums / np.maximum(counts, 1), counts > 0)
    whole = coarse.repeat(2, axis=0).repeat(2, axis=1)[: values.shape[0], : values.shape[1]]
    return np.where(known, values, whole)


def fine_noise(plane: np.ndarray) -> float:
    """Standard deviation of noise, by the median of second differences along rows."""
    bend = plane[:, 1:-1] - (plane[:, 2:] + plane[:, :-2]) / 2
    return 1.21 * float(np.median(np.abs(bend)))


def is_dark(image: np.ndarray, level: np.ndarray, side: int) -> bool:
    """Whether a level is as low as the darkest square of an image (channel, y, x).

    Above the darkest of all squares of `side` pixels, it lies by at most 15 % of what the mean of
    the image does.
    """
    side = min(side, *image.shape[1:])
    kept = image[:, *central_blocks(image.shape[1:], side)]
    means = block_sum(kept, side, np.float64) / side**2
    lowest = means.min(axis=(1, 2), keepdims=True)
    light = means.mean(axis=(1, 2), keepdims=True) - lowest
    return bool((level - lowest <= _LIT * light).all())


def pedestal(images: Shaped[np.ndarray, "*batch y x"]) -> tuple[float, float]:
    """Furthest level from 0 of images whose darkest corner is dark and uniform.

    With it, its part of the mean, of the light above where it is negative. Both are 0 where light
    reaches all corners, or for less than 5 % of the mean light above it.
    """
    planes = images.reshape(-1, *images.shape[-2:])
    side = min(planes.shape[1:]) // _CORNER // 2 * 2
    if side < _SMALL:
        return 0.0, 0.0
    ends, found = (slice(None, side), slice(-side, None)), [(0.0, 0.0)]
    for plane in planes:
        dark = min((plane[row, column] for row in ends for column in ends), key=np.mean)
        level, mean = dark.mean(dtype=float), plane.mean(dtype=float)
        quarters = block_sum(dark, side // 2, float) * 4 / side**2
        size, light = abs(level), mean - level
        if size <= _PEDESTAL * light or np.ptp(quarters) > _EVEN * size:
            continue
        if is_dark(plane[None], level.reshape(1, 1, 1), side):
            found.append((float(level), float(level / (light if level < 0 else mean))))
    return max(found, key=lambda one: abs(one[0]))
