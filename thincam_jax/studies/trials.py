"""Methods of a study side by side, over the noise of several seeds."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Array

from thincam_jax.lensless.exposures import Exposure
from thincam_jax.studies.evaluate import (
    Evaluation,
    Resolved,
    Scores,
    evaluate,
    field_shape,
    reconstructor,
)
from thincam_jax.studies.simulate import expose, noise_free, stacked
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
                clean[exposure] = noise_free(study, exposure, target.plane)
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
