"""Gains of designs on photographs that they were not trained on."""

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
import scipy.stats

from thincam_jax.imaging.scene import ImagePlane
from thincam_jax.imaging.targets import resize, sample_image
from thincam_jax.imaging.targets.images import sample_images
from thincam_jax.studies.evaluate import evaluate, field_shape, reconstructor
from thincam_jax.studies.simulate import expose, noise_free, stacked
from thincam_jax.studies.study import Study, Target

_PIXELS = 512  # of a photograph's sides
_DRAWN = "cat", "colorwheel", "logo", "text"  # and what is a part of another
_NOISE = 12_345  # the number of the noise


@dataclass(frozen=True)
class GainOverPhotographs:
    """Gain over the first method, dB: its mean, 95 % interval and value on each photograph.

    - `low`, `high`: by Student's t, of the mean over photographs like these.
    """

    mean: float
    low: float
    high: float
    values: tuple[float, ...]

    @classmethod
    def of(cls, values: Iterable[float]) -> "GainOverPhotographs":
        """Gain from the values on two photographs or more."""
        gains = np.array([*values])
        half = scipy.stats.t.ppf(0.975, len(gains) - 1) * np.std(gains, ddof=1) / len(gains) ** 0.5
        ends = (float(np.mean(gains) + side * half) for side in (0, -1, 1))
        mean, low, high = (round(end, 4) for end in ends)
        return cls(mean, low, high, tuple(round(float(gain), 4) for gain in gains))

    def __str__(self) -> str:
        """Mean and interval."""
        return f"{self.mean:+.2f} dB (95 %: {self.low:+.2f} to {self.high:+.2f})"


@dataclass(frozen=True)
class HeldOut:
    """Photographs, and the gain of each method of a study but the first, by name."""

    photographs: tuple[str, ...]
    gains: dict[str, GainOverPhotographs]


def further_photographs(used: Iterable[str], count: int) -> tuple[str, ...]:
    """At most so many of scikit-image's photographs, without those used."""
    return tuple(n for n in sample_images() if n not in (*_DRAWN, *used))[:count]


def hold_out(study: Study, photographs: tuple[str, ...]) -> HeldOut:
    """The methods of a study on further photographs, each with one noise, grey and square."""
    distance, width = study.object_distance, study.targets[0].width
    images = np.stack([_square(name) for name in photographs]).astype(np.float32)
    # As channels of one target: one program, and one filter of each method, serve all.
    target = Target(_NOISE, "", "photograph", distance, width, ImagePlane(images, distance, width))
    levels = {}
    for method in study.methods:
        captures = [
            expose(study, exposure, noise_free(study, exposure, target.plane), target.number)
            for exposure in method.exposures
        ]
        solve = reconstructor(study, method, field_shape(study, method, target), distance)
        found = solve(*stacked(captures))
        each = []
        for image, restored in zip(images, found.image, strict=True):
            plane = ImagePlane(image[None], distance, width)
            alone = replace(target, plane=plane), replace(found, image=restored[None])
            each.append(evaluate(method, *alone).scores.psnr_db)
        levels[method.name] = np.array(each, float)
    first, *others = levels.values()
    gains = (GainOverPhotographs.of(level - first) for level in others)
    return HeldOut(photographs, dict(zip([*levels][1:], gains, strict=True)))


def _square(name: str) -> np.ndarray:
    """The middle of a photograph, grey."""
    image = np.atleast_3d(sample_image(name, linear=True)).mean(axis=-1)
    side = min(image.shape)
    rows, columns = ((n - side) // 2 for n in image.shape)
    return resize(image[rows : rows + side, columns : columns + side], (_PIXELS, _PIXELS))
