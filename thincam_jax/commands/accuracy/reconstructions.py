"""What a wrong PSF costs a reconstruction, in PSNR."""

import dataclasses
import math
import sys
from functools import partial
from typing import Any

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
from thincam_jax.commands.run_folder import Step
from thincam_jax.imaging.metrics import psnr
from thincam_jax.lensless.method import MODELS, Model
from thincam_jax.reconstruction import Reconstruction
from thincam_jax.studies.evaluate import evaluate, field_shape, reconstructor
from thincam_jax.studies.simulate import stacked, take
from thincam_jax.studies.study import Method, Study

# What is wrong: the mask's curvature β, or its distance d from the sensor.
QUANTITIES = ("beta", "distance")
LEVELS = (0.003, 0.01, 0.03, 0.1)  # relative errors of the PSF
_TOLERANCE = 0.01  # of the level, within which it is met
# The largest relative change that is looked at, and the one to begin with.
_LARGEST, _FIRST = 0.5, 1e-5
# Relative changes come in these steps: distances of few digits then keep their ratio to the last
# bit in float32, and no reconstruction is compiled anew.
_STEP = 2.0**-20


class ReconstructionErrors:
    """Noisy captures by the exact model, reconstructed with PSFs that are wrong.

    `work` takes the captures with the study's noise, and fills

    - `exact_psnr_db`: with the exact model.
    - `models`: a row for every model that the reconstruction assumes in place of the exact one,
      with `psf_error` (relative, over the sensor and all the method's exposures), `psnr_db` against
      the scene and `psnr_lost_db` against what the exact model reaches.
    - `controlled`: what a PSF error of 0.3 %, 1 %, 3 % and 10 % costs, by a wrong β and a wrong d:
      the exact model of a slightly wrong camera. The scale of the object is the true one, so that
      only the PSF is wrong. `psnr_lost_db` is the worse of a change up and down: by chance, one of
      them can gain a little.
    """

    def __init__(self, case: Case):
        self.case = case
        self.exact_psnr_db, self.models, self.controlled = None, [], []
        self.work = []
        if case.skipped is None:
            self.work.append(Step(f"captures for {case.method.name}", self._capture))
            for model in MODELS:
                step = partial(self._add_model, model)
                self.work.append(Step(f"reconstruction: {words(model)}", step))
            for quantity in QUANTITIES:
                for level in LEVELS:
                    text = f"a PSF error of {100 * level:g} % by a wrong {quantity}"
                    step = partial(self._add_controlled, quantity, level)
                    self.work.append(Step(text, step))

    def _capture(self) -> None:
        case = self.case
        self.captures = stacked([take(case.study, e, case.target) for e in case.method.exposures])
        self.psfs = psfs_of(case.study, case.method)  # exact
        self.clean = clean_capture(case, case.method.exposures[0])
        exact = self._reconstruct(case.method, "separable")
        self.pitch = exact.pitch
        self.exact_psnr_db = self._psnr(exact)

    def _add_model(self, model: Model) -> None:
        exposures = self.case.method.exposures
        reasons = [kernel_reason(self.case, exposure, model) for exposure in exposures]
        reason = next((r for r in reasons if r), None)
        row: dict[str, Any] = {"model": model, "status": "not run", "reason": reason}
        if reason is None:
            psfs = [psf_of(self.case.study, exposure, model, "float32") for exposure in exposures]
            row |= {"status": "run", "psf_error": relative_error(np.stack(psfs), self.psfs)}
            row |= self._lost(self._reconstruct(self.case.method, model))
        self.models.append(row)

    def _add_controlled(self, quantity: str, level: float) -> None:
        part = solve(self.case.study, self.case.method, quantity, level)
        row: dict[str, Any] = {"wrong": quantity, "level": level, "status": "not run"}
        if part is None:
            row["reason"] = f"no change of {quantity} of up to a half gives this error"
        else:
            row |= {"status": "run", "reason": None, "change": part}
            row |= self._changed(quantity, part)
        self.controlled.append(row)

    def _changed(self, quantity: str, part: float) -> dict[str, Any]:
        """PSF and capture error of a change, and the PSNR lost by it in the worse direction."""
        case = self.case
        up, down = (changed(case.method, quantity, p) for p in (part, -part))
        wrong = clean_capture(case, case.method.exposures[0], assumed=up.exposures[0])
        both = [self._lost(self._reconstruct(method, "separable")) for method in (up, down)]
        worse = max(both, key=lambda lost: lost["psnr_lost_db"])
        return {
            "psf_error": relative_error(psfs_of(case.study, up), self.psfs),
            "capture_error": relative_error(wrong, self.clean),
            "capture_contrast_error": contrast_error(wrong, self.clean),
            **worse,
        }

    def _lost(self, found: Reconstruction) -> dict[str, float]:
        assert self.exact_psnr_db is not None  # the captures come first
        reached = self._psnr(found)
        return {"psnr_db": reached, "psnr_lost_db": self.exact_psnr_db - reached}

    def _reconstruct(self, method: Method, model: Model) -> Reconstruction:
        study, target = dataclasses.replace(self.case.study, model=model), self.case.target
        shape = field_shape(study, self.case.method, target)
        return reconstructor(study, method, shape, target.distance)(*self.captures)

    def _psnr(self, found: Reconstruction) -> float:
        """dB, of the same pixels of the object whatever camera was assumed."""
        same = Reconstruction(found.image, self.pitch)
        judged = evaluate(self.case.method, self.case.target, same)
        return psnr(judged.image, judged.truth)


def changed(method: Method, quantity: str, part: float) -> Method:
    """The method with one quantity of all its exposures multiplied by 1 + part."""
    other = {quantity: getattr(method.exposures, quantity) * (1 + part)}
    return dataclasses.replace(method, exposures=dataclasses.replace(method.exposures, **other))


def psfs_of(study: Study, method: Method) -> np.ndarray:
    """The exact PSFs (exposure, y, x) of a method on the sensor, in float64."""
    return np.stack([psf_of(study, exposure) for exposure in method.exposures])


def solve(study: Study, method: Method, quantity: str, level: float) -> float | None:
    """The relative change of a quantity that makes the method's PSFs wrong by `level`.

    By a bracketed search in its logarithm (Brent's), to 1 % of the level. None where no change of
    up to a half does it.
    """
    reference = psfs_of(study, method)

    def excess(logarithm: float) -> float:
        wrong = psfs_of(study, changed(method, quantity, math.exp(logarithm)))
        # A change may be too small to be seen.
        error = max(relative_error(wrong, reference), sys.float_info.min)
        return math.log(error / level)

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
