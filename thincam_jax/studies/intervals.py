r"""Intervals about an image's pixels that hold the truth with a given probability.

Captures with truths calibrate them (conformal risk control: Angelopoulos et al., Conformal risk
control, ICLR 2024, theorem 1). An image f has the interval f ± λ s with the expected error

.. math:: s = a + b \sqrt{\max(f, 0)} + c\, d

for the local contrast d, the standard deviation of f about each pixel. The three parts are fitted,
and λ is the smallest number with

.. math:: \frac{n}{n+1} R(\lambda) + \frac{1}{n+1} \le 1 - p

where R is the share of pixels outside, mean over the n pictures. Then a new picture taken in the
same way has at most 1 − p of its pixels outside, on average over pictures. Single pictures have
more, and nothing holds for other scenes, cameras or exposures than those of the calibration.

Many cameras leave the level of uniform light open. By default f is therefore each image in its own
unit, 0 its first and 1 its 99th percentile, and intervals hold for a truth of any gain and offset.
With common levels f = g x + o is the image in the truths' unit, by one gain and offset for all.
"""

import json
import math
import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Float
from scipy import ndimage, optimize

from thincam_jax._core.files import read_regular

_PARTS = ("image", "contrast", "truth")
_REACH = 2.0  # pixels: standard deviation of the window of the local contrast
_FOLDS = 5
_ROUNDS = 4  # of the fit of the parts, each with weights by the last one
_LEAST = 1e-3  # of the truths' mean: a smaller expected error counts as this

Image = Float[np.ndarray, "channel y x"]
Levels = Literal["own", "common"]


@dataclass(frozen=True, eq=False)
class PixelSample:
    """Pixels of a picture, (channel, pixel): image, its local contrast, and truth.

    `levels`: see the module; by its "own" all are in the image's own unit.
    """

    image: Float[np.ndarray, "channel pixel"]
    contrast: Float[np.ndarray, "channel pixel"]
    truth: Float[np.ndarray, "channel pixel"]
    levels: Levels = "own"

    @classmethod
    def of(
        cls, image: Image, truth: Image, count: int | None = None, levels: Levels = "own"
    ) -> "PixelSample":
        """All pixels, or `count` at random places, the same for images of one shape."""
        chosen = slice(None)
        if levels == "own":
            black, unit = _own_levels(image)
            image = (image - black) / unit
            lines = [_line(t.ravel(), i.ravel()) for t, i in zip(truth, image, strict=True)]
            truth = np.stack([g * t + o for t, (g, o) in zip(truth, lines, strict=True)])
        if count is not None and count < image[0].size:
            chosen = np.random.default_rng(0).choice(image[0].size, count, replace=False)
        parts = image, _contrast(image), truth
        seen, contrast, known = (np.reshape(one, (len(image), -1))[:, chosen] for one in parts)
        return cls(seen, contrast, known, levels)

    def as_lists(self) -> dict[str, Any]:
        """Numbers of six digits by name, for JSON."""
        parts = {name: getattr(self, name).tolist() for name in _PARTS}
        short = {n: [[float(f"{x:.6g}") for x in row] for row in part] for n, part in parts.items()}
        return {**short, "levels": self.levels}

    @staticmethod
    def of_rows(rows: Iterable[Mapping[str, Any]]) -> list["PixelSample"]:
        """Samples of rows of scores, which hold them as `pixels`, by `as_lists`."""
        held = [row["pixels"] for row in rows if "pixels" in row]
        parts = [{name: np.asarray(one[name]) for name in _PARTS} for one in held]
        pairs = zip(parts, held, strict=True)
        return [PixelSample(**part, levels=one["levels"]) for part, one in pairs]


def _own_levels(image: Image) -> tuple[np.ndarray, np.ndarray]:
    """First percentile of each channel, and from there to the 99th."""
    black, white = np.percentile(image, (1, 99), axis=(1, 2), keepdims=True)
    return black, np.where(white > black, white - black, 1.0)


def _contrast(image: Image) -> Image:
    """Standard deviation within a Gaussian window about each pixel."""
    reach = (0.0, _REACH, _REACH)
    image = np.asarray(image, float)
    mean, square = (ndimage.gaussian_filter(one, reach) for one in (image, image**2))
    return np.sqrt(np.maximum(square - mean**2, 0))


@dataclass(frozen=True)
class Intervals:
    """Calibrated intervals of the images of one camera and one method; see the module.

    - `probability`: that of a pixel to be inside. `pictures`: number of those that calibrated it.
    - `levels`: "own" or "common"; of these `gain`, `offset`: g and o of each channel.
    - `parts`: a, b, c. `factor`: λ.

    ```python
    import numpy as np
    from thincam_jax.studies.intervals import Intervals, PixelSample

    random = np.random.default_rng(0)
    truths = random.uniform(size=(30, 1, 20, 24))
    images = 5 * truths + random.normal(size=truths.shape)
    pairs = [PixelSample.of(*pair) for pair in zip(images, truths)]
    intervals = Intervals.calibrated(pairs[:20])
    lower, upper = intervals.of(images[25])  # in the unit of the image
    inside = (lower <= 5 * truths[25]) & (5 * truths[25] <= upper)
    print(0.85 < inside.mean() < 0.97)  # True
    ```
    """

    probability: float
    pictures: int
    levels: Levels
    gain: tuple[float, ...]
    offset: tuple[float, ...]
    parts: tuple[float, float, float]
    factor: float

    @classmethod
    def calibrated(cls, samples: Sequence[PixelSample], probability: float = 0.9) -> "Intervals":
        """Intervals by pictures with truths, one sample each.

        **Errors**: ValueError for a probability that is not between 0 and 1, and for fewer than
        p/(1 − p) pictures, 9 for 90 %.
        """
        if not 0 < probability < 1:
            raise ValueError(f"probability = {probability}: give one between 0 and 1")
        least, count = least_pictures(probability), len(samples)
        if count < least:
            raise ValueError(f"{count} pictures; {probability:.0%} take at least {least}")
        images, truths = ([getattr(s, name) for s in samples] for name in ("image", "truth"))
        images, truths = (np.concatenate(one, axis=1).astype(float) for one in (images, truths))
        levels, lines = samples[0].levels, [(1.0, 0.0)] * len(images)
        if levels == "common":
            lines = [_line(*one) for one in zip(images, truths, strict=True)]
        gain, offset = (tuple(one) for one in zip(*lines, strict=True))
        made = cls(probability, count, levels, gain, offset, (1.0, 0.0, 0.0), math.inf)
        made = replace(made, parts=made._fitted_parts(samples))
        ratios = [np.sort(made._ratios(sample).ravel()) for sample in samples]
        return replace(made, factor=_factor(ratios, probability))

    def of(self, image: Image) -> tuple[Image, Image]:
        """Lower and upper ends, in the image's unit or by common levels in the truths'."""
        black, unit = _own_levels(image) if self.levels == "own" else (0.0, 1.0)
        image = (image - black) / unit
        light, half = self._light(image), self._half(image, _contrast(image))
        return black + unit * (light - half), black + unit * (light + half)

    def coverage(self, sample: PixelSample) -> float:
        """Share of a picture's pixels whose truth is inside."""
        return float(np.mean(self._ratios(sample) <= self.factor))

    def width(self, sample: PixelSample) -> float:
        """Mean width of a picture's intervals, in the unit of its sample."""
        return 2 * float(np.mean(self._half(sample.image, sample.contrast)))

    def as_json(self) -> str:
        """The numbers, which `load` reads."""
        return json.dumps(asdict(self), indent=1) + "\n"

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> "Intervals":
        """Read a file of `as_json`; ValueError for anything else."""
        try:
            held = json.loads(read_regular(Path(path)))
            lists = {name: tuple(held[name]) for name in ("gain", "offset", "parts")}
            return cls(**{**held, **lists})
        except (KeyError, TypeError, ValueError):
            raise ValueError(
                f"{path}: holds no intervals; give a file of 'thincam evaluate'"
            ) from None

    def _light(self, image: np.ndarray) -> np.ndarray:
        return _over(self.gain, image) * image + _over(self.offset, image)

    def _terms(self, image: np.ndarray, contrast: np.ndarray) -> np.ndarray:
        """Terms of the expected error, whose sum by `parts` it is."""
        spread, light = np.abs(_over(self.gain, contrast)) * contrast, self._light(image)
        return np.stack([np.ones_like(spread), np.sqrt(np.maximum(light, 0)), spread])

    def _half(self, image: np.ndarray, contrast: np.ndarray) -> np.ndarray:
        return self.factor * np.tensordot(self.parts, self._terms(image, contrast), 1)

    def _ratios(self, sample: PixelSample) -> np.ndarray:
        """Errors over the expected ones."""
        expected = np.tensordot(self.parts, self._terms(sample.image, sample.contrast), 1)
        return np.abs(self._light(sample.image) - sample.truth) / expected

    def _fitted_parts(self, samples: Sequence[PixelSample]) -> tuple[float, float, float]:
        """Not negative a, b, c by least squares of the errors, weighed by what is expected."""
        terms = [self._terms(one.image, one.contrast).reshape(3, -1) for one in samples]
        table = np.concatenate(terms, axis=1).T
        known = np.concatenate([self._ratios(one).ravel() for one in samples])
        least = max(_LEAST * float(np.mean([np.mean(np.abs(s.truth)) for s in samples])), 1e-30)
        parts, weight = np.zeros(3), np.ones(len(known))
        for _ in range(_ROUNDS):
            parts, _ = optimize.nnls(table * weight[:, None], known * weight)
            weight = 1 / np.maximum(table @ parts, least)
        constant, by_root, by_contrast = parts.tolist()
        return max(constant, least), by_root, by_contrast


def least_pictures(probability: float) -> int:
    """Number of pictures, from which on λ is finite."""
    return math.ceil(probability / (1 - probability) - 1e-9)


def cross_validated(
    samples: Sequence[PixelSample], probability: float = 0.9
) -> tuple[list[float], list[float]]:
    """Coverage and mean width of each picture by intervals of others, a fifth left out at a time.

    Empty where the others are fewer than `least_pictures`, or pictures have other channels.
    """
    if len({len(sample.image) for sample in samples}) > 1:
        return [], []
    covered, width = ([0.0] * len(samples) for _ in range(2))
    for fold in range(_FOLDS):
        kept = [one for n, one in enumerate(samples) if n % _FOLDS != fold]
        if len(kept) < least_pictures(probability):
            return [], []
        made = Intervals.calibrated(kept, probability)
        for n in range(fold, len(samples), _FOLDS):
            covered[n], width[n] = made.coverage(samples[n]), made.width(samples[n])
    return covered, width


def _factor(ratios: Sequence[np.ndarray], probability: float) -> float:
    """λ, the smallest of all ratios at which few enough pixels are outside; each is sorted."""
    count = len(ratios)
    most = ((1 - probability) * (count + 1) - 1) / count
    tried = np.sort(np.concatenate(ratios))
    low, high = 0, len(tried) - 1
    while low < high:
        middle = (low + high) // 2
        inside = [np.searchsorted(one, tried[middle], "right") / len(one) for one in ratios]
        low, high = (low, middle) if 1 - np.mean(inside) <= most + 1e-12 else (middle + 1, high)
    return float(tried[low])


def _line(image: np.ndarray, truth: np.ndarray) -> tuple[float, float]:
    """Gain and offset that bring an image closest to the truth."""
    design = np.stack([image, np.ones_like(image)], axis=1)
    gain, offset = np.linalg.lstsq(design, truth)[0]
    return float(gain), float(offset)


def _over(numbers: tuple[float, ...], image: np.ndarray) -> np.ndarray:
    """A number for each channel, beside the image's other axes."""
    return np.reshape(numbers, (-1, *(1,) * (image.ndim - 1)))
