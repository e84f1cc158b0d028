"""Methods of a study side by side, over the noise of several seeds."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Array

from thincam_jax.imaging.scene import ImagePlane
from thincam_jax.imaging.targets import resize, sample_image
from thincam_jax.imaging.targets.images import sample_images
from thincam_jax.lensless.exposures import Exposure
from thincam_jax.studies.agreement import half_interval
from thincam_jax.studies.evaluate import (
    Evaluation,
    Resolved,
    Scores,
    evaluate,
    expose,
    field_shape,
    noise_free,
    reconstructor,
    stacked,
)
from thincam_jax.studies.study import Study, Target

_STEPS = 6  # elements of a group of the USAF chart, which is an octave

Trials = dict[str, list[Scores]]  # by method, the scores of each seed


@dataclass(frozen=True)
class Spread:
    """Mean and standard deviation (n − 1; None of one value) of values over the seeds."""

    mean: float
    deviation: float | None
    values: list[float]

    @classmethod
    def of(cls, values: Sequence[float | int | None]) -> "Spread | None":
        """None where a value is missing."""
        known = [value for value in values if value is not None]
        if len(known) < len(values):
            return None
        return cls(
            round(float(np.mean(known)), 4),
            round(float(np.std(known, ddof=1)), 4) if len(known) > 1 else None,
            [round(float(value), 4) for value in known],
        )

    def text(self, digits: int, sign: str = "+") -> str:
        """Mean and deviation, with so many decimals: "+0.46 ± 0.10"."""
        mean = f"{self.mean:{sign}.{digits}f}"
        return mean if self.deviation is None else f"{mean} ± {self.deviation:.{digits}f}"


@dataclass(frozen=True)
class Comparison:
    """A method on a target over the seeds, and its gains over the first method, seed by seed.

    - `gain_elements`: gain in elements of the chart, of which six halve the line pair.

    None: images that are exact, a chart that is not resolved, and gains of the first method.
    """

    object_pixel_mm: float
    psnr_db: Spread | None
    ssim: Spread | None
    resolved_object_mm: list[float | None]
    gain_db: Spread | None = None
    gain_elements: Spread | None = None


def simulate_trials(
    study: Study, target: Target, seeds: int, shown: dict[str, Evaluation] | None = None
) -> Trials:
    """Every method of a study on a target; captures without noise are computed once.

    `shown` is given the reconstructions of the first seed, which is the study's own: a run of the
    study gives the same.
    """
    clean: dict[Exposure, Array] = {}
    trials: Trials = {}
    for number, method in enumerate(study.methods):
        for exposure in method.exposures:
            if exposure not in clean:
                plane = replace(target.plane, moves=exposure.moves)
                clean[exposure] = noise_free(study, exposure, plane)
        shape = field_shape(study, method, target)
        solve = reconstructor(study, method, shape, target.distance)
        trials[method.name] = []
        for trial in range(seeds):
            captures = [expose(study, e, clean[e], target.number, trial) for e in method.exposures]
            found = evaluate(method, target, solve(*stacked(captures)))
            trials[method.name].append(found.scores)
            if shown is not None:
                shown.setdefault(method.name, found)
        later = {exposure for m in study.methods[number + 1 :] for exposure in m.exposures}
        clean = {exposure: image for exposure, image in clean.items() if exposure in later}
    return trials


def compare_trials(trials: Mapping[str, Trials]) -> dict[str, dict[str, Comparison]]:
    """Each method on each target, by their names; `trials` is by target."""
    reference, *others = next(iter(trials.values()))
    compared = {reference: {t: _compared(tried[reference]) for t, tried in trials.items()}}
    for name in others:
        compared[name] = {
            target: _compared(tried[name], tried[reference]) for target, tried in trials.items()
        }
    return compared


def _compared(scores: list[Scores], reference: list[Scores] | None = None) -> Comparison:
    gains = []
    if reference is not None:
        pairs = list(zip(scores, reference, strict=True))
        levels = [_difference(one.psnr_db, other.psnr_db) for one, other in pairs]
        steps = [_difference(_step(one.resolved), _step(other.resolved)) for one, other in pairs]
        gains = [Spread.of(levels), Spread.of(steps)]
    return Comparison(
        scores[0].object_pixel_mm,
        Spread.of([one.psnr_db for one in scores]),
        Spread.of([one.ssim for one in scores]),
        [None if one.resolved is None else one.resolved.object_mm for one in scores],
        *gains,
    )


def _step(resolved: Resolved | None) -> int | None:
    return None if resolved is None else resolved.group * _STEPS + resolved.element


def _difference(one: float | int | None, other: float | int | None) -> float | int | None:
    return None if one is None or other is None else one - other


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
        half = half_interval(gains)
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
