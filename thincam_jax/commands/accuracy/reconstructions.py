"""What a wrong PSF costs a reconstruction, in PSNR."""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Array

from thincam_jax.commands.accuracy.cameras import psf_of
from thincam_jax.commands.accuracy.captures import clean_capture, kernel_reason
from thincam_jax.commands.accuracy.norms import contrast_error, relative_error
from thincam_jax.commands.accuracy.perturb import LEVELS, QUANTITIES, changed, psfs_of, solve
from thincam_jax.commands.accuracy.psfs import words
from thincam_jax.commands.accuracy.rig import Rig
from thincam_jax.commands.study.build import build_reconstructor, field_shape, stacked, take
from thincam_jax.commands.study.evaluate import evaluate
from thincam_jax.commands.study.study import Method
from thincam_jax.imaging.metrics import psnr
from thincam_jax.lensless.psf import MODELS, Model
from thincam_jax.reconstruction import Reconstruction


class Experiment(NamedTuple):
    """Noisy captures by the exact model, and what comes out where the exact model is assumed.

    - `captures` (exposure, channel, y, x) and the `variances` of their noise (exposure, channel).
    - `shape`: of the reconstruction, pixels; `pitch`: of the object, mm.
    - `psfs`: exact, (exposure, y, x).
    - `psnr_db`: with the exact model.
    """

    captures: Array
    variances: Array
    shape: tuple[int, int]
    pitch: Any
    psfs: np.ndarray
    psnr_db: float


def make_experiment(rig: Rig) -> Experiment:
    """Take the captures with the study's noise and reconstruct them with the exact model."""
    experiment = Experiment(
        *stacked([take(rig.study, exposure, rig.target) for exposure in rig.exposures]),
        field_shape(rig.study, rig.method, rig.target),
        None,
        psfs_of(rig.study, rig.method),
        float("nan"),
    )
    found = _reconstruct(rig, experiment, rig.method, "separable")
    experiment = experiment._replace(pitch=found.pitch)
    return experiment._replace(psnr_db=_psnr(rig, experiment, found))


def model_rows(
    rig: Rig, experiment: Experiment, progress: Callable[[str], None]
) -> list[dict[str, Any]]:
    """A row for every model that the reconstruction assumes in place of the exact one.

    - `psf_error`: relative, over the sensor and all the method's exposures.
    - `psnr_db`, `psnr_lost_db`: against the scene, and against what the exact model reaches.
    """
    rows = []
    for model in MODELS:
        progress(f"reconstruction: {words(model)}")
        reasons = [kernel_reason(rig, s, model) for s in rig.exposures]
        reason = next((r for r in reasons if r), None)
        row: dict[str, Any] = {"model": model, "status": "not run", "reason": reason}
        if reason is None:
            psfs = np.stack([psf_of(rig.study, s, model, "float32") for s in rig.exposures])
            error = relative_error(psfs, experiment.psfs)
            row |= {"status": "run", "psf_error": error}
            row |= _lost(rig, experiment, _reconstruct(rig, experiment, rig.method, model))
        rows.append(row)
    return rows


def controlled_rows(
    rig: Rig, experiment: Experiment, progress: Callable[[str], None]
) -> list[dict[str, Any]]:
    """What a PSF error of 0.3 %, 1 %, 3 % and 10 % costs: rows for a wrong β and a wrong d.

    The reconstruction assumes the exact model of a slightly wrong camera. The scale of the object
    is the true one, so that only the PSF is wrong. `psnr_lost_db` is the worse of a change up and
    down: by chance, one of them can gain a little.
    """
    reference = clean_capture(rig, rig.exposures[0])
    rows = []
    for quantity in QUANTITIES:
        for level in LEVELS:
            progress(f"a PSF error of {100 * level:g} % by a wrong {quantity}")
            part = solve(rig.study, rig.method, quantity, level)
            row: dict[str, Any] = {"wrong": quantity, "level": level}
            if part is None:
                reason = f"no change of {quantity} of up to a half gives this error"
                rows.append(row | {"status": "not run", "reason": reason})
            else:
                row |= {"status": "run", "reason": None, "change": part}
                rows.append(row | _controlled(rig, experiment, reference, quantity, part))
    return rows


def _controlled(rig: Rig, experiment: Experiment, reference, quantity: str, part: float) -> dict:
    """PSF and capture error of a change, and the PSNR lost by it in the worse direction."""
    up, down = (changed(rig.method, quantity, p) for p in (part, -part))
    wrong = clean_capture(rig, rig.exposures[0], assumed=up.exposures[0])
    both = [
        _lost(rig, experiment, _reconstruct(rig, experiment, m, "separable")) for m in (up, down)
    ]
    worse = max(both, key=lambda lost: lost["psnr_lost_db"])
    return {
        "psf_error": relative_error(psfs_of(rig.study, up), experiment.psfs),
        "capture_error": relative_error(wrong, reference),
        "capture_contrast_error": contrast_error(wrong, reference),
        **worse,
    }


def _lost(rig: Rig, experiment: Experiment, found: Reconstruction) -> dict[str, float]:
    reached = _psnr(rig, experiment, found)
    return {"psnr_db": reached, "psnr_lost_db": experiment.psnr_db - reached}


def _reconstruct(rig: Rig, experiment: Experiment, method: Method, model: Model) -> Reconstruction:
    study = dataclasses.replace(rig.study, model=model)
    reconstructor = build_reconstructor(study, method, experiment.shape, rig.target.distance)
    return reconstructor(experiment.captures, experiment.variances)


def _psnr(rig: Rig, experiment: Experiment, found: Reconstruction) -> float:
    """dB, of the same pixels of the object whatever camera was assumed."""
    found = Reconstruction(found.image, experiment.pitch)
    judged = evaluate(rig.method, rig.target, found)
    return psnr(judged.image, judged.truth)
