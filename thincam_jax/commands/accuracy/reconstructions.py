"""What a wrong PSF costs a reconstruction, in PSNR."""

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
import scipy

from thincam_jax.commands.accuracy.cameras import (
    Case,
    contrast_error,
    psf_of,
    relative_error,
)
from thincam_jax.commands.accuracy.captures import clean_capture, kernel_reason
from thincam_jax.commands.accuracy.psfs import words
from thincam_jax.commands.study import build
from thincam_jax.commands.study.config import MethodConfig, StudyConfig
from thincam_jax.commands.study.evaluate import evaluate
from thincam_jax.imaging.metrics import psnr
from thincam_jax.lensless.method import MODELS, Model
from thincam_jax.reconstruction import Reconstruction

# What is wrong: the mask's curvature β, or its distance d from the sensor.
QUANTITIES = ("beta", "distance")
LEVELS = (0.003, 0.01, 0.03, 0.1)  # relative errors of the PSF
_TOLERANCE = 0.01  # of the level, within which it is met
# The largest relative change that is looked at, and the one to begin with.
_LARGEST, _FIRST = 0.5, 1e-5
# Relative changes come in these steps: distances of few digits then keep their ratio to the last
# bit in float32, and no reconstruction is compiled anew.
_STEP = 2.0**-20


class Experiment(NamedTuple):
    """Noisy captures by the exact model, and what comes out where the exact model is assumed.

    - `captures` (exposure, channel, y, x) and the `variances` of their noise (exposure, channel).
    - `shape`: of the reconstruction, pixels; `pitch`: of the object, mm.
    - `psfs`: exact, (exposure, y, x).
    - `psnr_db`: with the exact model.
    """

    captures: np.ndarray
    variances: np.ndarray
    shape: tuple[int, int]
    pitch: Any
    psfs: np.ndarray
    psnr_db: float


def make_experiment(case: Case) -> Experiment:
    """Take the captures with the study's noise and reconstruct them with the exact model."""
    known = build.all_settings(case.config)
    exposures = [
        build.take(
            case.config, s, case.plane, build.capture_key(case.config, case.number, known.index(s))
        )
        for s in case.settings
    ]
    experiment = Experiment(
        np.stack([e.image for e in exposures]),
        np.stack([e.variance for e in exposures]),
        build.field_shape(case.config, case.method, case.plane),
        None,
        psfs_of(case.config, case.method),
        float("nan"),
    )
    found = _reconstruct(case, experiment, case.method, "separable")
    experiment = experiment._replace(pitch=found.pitch)
    return experiment._replace(psnr_db=_psnr(case, experiment, found))


def model_rows(
    case: Case, experiment: Experiment, progress: Callable[[str], None]
) -> list[dict[str, Any]]:
    """A row for every model that the reconstruction assumes in place of the exact one.

    - `psf_error`: relative, over the sensor and all the method's exposures.
    - `psnr_db`, `psnr_lost_db`: against the scene, and against what the exact model reaches.
    """
    rows = []
    for model in MODELS:
        progress(f"reconstruction: {words(model)}")
        reasons = [kernel_reason(case, s, model) for s in case.settings]
        reason = next((r for r in reasons if r), None)
        row: dict[str, Any] = {"model": model, "status": "not run", "reason": reason}
        if reason is None:
            psfs = np.stack([psf_of(case.config, s, model, "float32") for s in case.settings])
            error = relative_error(psfs, experiment.psfs)
            row |= {"status": "run", "psf_error": error}
            row |= _lost(case, experiment, _reconstruct(case, experiment, case.method, model))
        rows.append(row)
    return rows


def controlled_rows(
    case: Case, experiment: Experiment, progress: Callable[[str], None]
) -> list[dict[str, Any]]:
    """What a PSF error of 0.3 %, 1 %, 3 % and 10 % costs: rows for a wrong β and a wrong d.

    The reconstruction assumes the exact model of a slightly wrong camera. The scale of the object
    is the true one, so that only the PSF is wrong. `psnr_lost_db` is the worse of a change up and
    down: by chance, one of them can gain a little.
    """
    reference = clean_capture(case, case.settings[0])
    rows = []
    for quantity in QUANTITIES:
        for level in LEVELS:
            progress(f"a PSF error of {100 * level:g} % by a wrong {quantity}")
            part = solve(case.config, case.method, quantity, level)
            row: dict[str, Any] = {"wrong": quantity, "level": level}
            if part is None:
                reason = f"no change of {quantity} of up to a half gives this error"
                rows.append(row | {"status": "not run", "reason": reason})
            else:
                row |= {"status": "run", "reason": None, "change": part}
                rows.append(row | _controlled(case, experiment, reference, quantity, part))
    return rows


def _controlled(case: Case, experiment: Experiment, reference, quantity: str, part: float) -> dict:
    """PSF and capture error of a change, and the PSNR lost by it in the worse direction."""
    up, down = (changed(case.method, quantity, p) for p in (part, -part))
    assumed = build.settings(case.config, up)[0]
    wrong = clean_capture(case, case.settings[0], assumed=assumed)
    both = [
        _lost(case, experiment, _reconstruct(case, experiment, m, "separable")) for m in (up, down)
    ]
    worse = max(both, key=lambda lost: lost["psnr_lost_db"])
    return {
        "psf_error": relative_error(psfs_of(case.config, up), experiment.psfs),
        "capture_error": relative_error(wrong, reference),
        "capture_contrast_error": contrast_error(wrong, reference),
        **worse,
    }


def _lost(case: Case, experiment: Experiment, found: Reconstruction) -> dict[str, float]:
    reached = _psnr(case, experiment, found)
    return {"psnr_db": reached, "psnr_lost_db": experiment.psnr_db - reached}


def _reconstruct(
    case: Case, experiment: Experiment, method: MethodConfig, model: Model
) -> Reconstruction:
    config = case.config.model_copy(update={"model": model})
    reconstructor = build.build_reconstructor(config, method, experiment.shape)
    return reconstructor(jnp.asarray(experiment.captures), jnp.asarray(experiment.variances))


def _psnr(case: Case, experiment: Experiment, found: Reconstruction) -> float:
    """dB, of the same pixels of the object whatever camera was assumed."""
    found = Reconstruction(found.image, experiment.pitch)
    judged = evaluate(case.config, case.method, case.target, case.plane, found)
    return psnr(judged.image, judged.truth)


def changed(method: MethodConfig, quantity: str, part: float) -> MethodConfig:
    """The method with one quantity of all its shots multiplied by 1 + part."""
    shots = tuple(
        shot.model_copy(update={quantity: getattr(shot, quantity) * (1 + part)})
        for shot in method.shots
    )
    return method.model_copy(update={"shots": shots})


def psfs_of(config: StudyConfig, method: MethodConfig) -> np.ndarray:
    """The exact PSFs (exposure, y, x) of a method on the sensor, in float64."""
    return np.stack([psf_of(config, s) for s in build.settings(config, method)])


def solve(config: StudyConfig, method: MethodConfig, quantity: str, level: float) -> float | None:
    """The relative change of a quantity that makes the method's PSFs wrong by `level`.

    By a bracketed search in its logarithm (Brent's), to 1 % of the level. None where no change of
    up to a half does it.
    """
    reference = psfs_of(config, method)

    def excess(logarithm: float) -> float:
        wrong = psfs_of(config, changed(method, quantity, math.exp(logarithm)))
        return math.log(relative_error(wrong, reference) / level)

    first, end = math.log(_FIRST), math.log(_LARGEST)
    guess = min(first - excess(first), end)  # small errors grow in proportion to what is wrong
    for reach in (0.3, 1.0, 3.0, 10.0):
        low, high = guess - reach, min(guess + reach, end)
        if excess(low) < 0 < excess(high):
            found = scipy.optimize.root_scalar(
                excess, bracket=(low, high), method="brentq", xtol=_TOLERANCE / 2, rtol=1e-9
            )
            return max(1, round(math.exp(found.root) / _STEP)) * _STEP
    return None
