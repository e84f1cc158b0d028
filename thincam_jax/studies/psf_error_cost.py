"""Cost of a wrong PSF: errors of captures, and PSNR of reconstructions that assume it."""

import dataclasses
import math
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any

import jax.numpy as jnp
import numpy as np
import scipy

from thincam_jax._core.grids import Grid
from thincam_jax._core.precision import Precision, allow, cast
from thincam_jax._core.steps import Progress, Step, carry_out
from thincam_jax._core.table import Table
from thincam_jax.imaging.metrics import psnr
from thincam_jax.imaging.operators.crop_convolution import kernel_shape
from thincam_jax.imaging.scene import Spectrum
from thincam_jax.lensless.cost import psf_cost
from thincam_jax.lensless.exposures import Exposure
from thincam_jax.lensless.forward import imaging_operator, project, projected_shape
from thincam_jax.lensless.method import Model, PsfMethod, models_of, psf_method
from thincam_jax.reconstruction.result import Reconstruction
from thincam_jax.studies.evaluate import evaluate, field_shape, reconstructor
from thincam_jax.studies.psf_accuracy import (
    PsfAccuracy,
    PsfErrors,
    binned,
    conditions_of,
    contrast_error,
    label,
    psf_of,
    relative_error,
    why_not,
    words,
)
from thincam_jax.studies.simulate import stacked, take
from thincam_jax.studies.study import Method, Study, Target

# What is wrong: the mask's curvature β, or its distance d from the sensor.
QUANTITIES = ("beta", "distance")
LEVELS = (0.003, 0.01, 0.03, 0.1)  # relative errors of the PSF
_NAMES = {"beta": "β", "distance": "d"}
_TOLERANCE = 0.01  # of the level, within which it is met
# The largest relative change that is looked at, and the one to begin with.
_LARGEST, _FIRST = 0.5, 1e-5
# Relative changes come in these steps: distances of few digits then keep their ratio to the last
# bit in float32, and no reconstruction is compiled anew.
_STEP = 2.0**-20


@dataclass(frozen=True, eq=False)
class Case:
    """A target before a study's camera with binned pixels.

    - `study`: the binned study, with the exact model.
    - `method`: the method that reconstructs; its first exposure is the one captured.
    - `target`: target that is seen.
    - `skipped`: why nothing is reconstructed; None where something is.
    """

    study: Study
    method: Method
    target: Target
    skipped: str | None

    @property
    def kernel_shape(self) -> tuple[int, int]:
        """Pixels of the PSF that the first capture takes: more than the sensor's by the scene's."""
        camera = self.study.camera(self.method.exposures[0])
        return kernel_shape(camera.sensor.shape, projected_shape(camera, self.target.plane))


def make_case(study: Study, size: int) -> Case:
    """The first picture (else the first target) and the first Wiener method (else the first).

    `size`: pixels along the sensor's longer side.
    """
    study = dataclasses.replace(binned(study, size), model="separable")
    pictures = [target for target in study.targets if target.is_picture]
    wiener = [method for method in study.methods if method.solver.name == "wiener"]
    method = (wiener or study.methods)[0]
    skipped = None if wiener else f"{method.name}: fringe scanning assumes no PSF"
    return Case(study, method, (pictures or list(study.targets))[0], skipped)


@dataclass(frozen=True)
class CaptureError:
    """Errors of a capture by a model, relative to separable in float64; None where it is not run.

    - `psf_error`: error of the PSF over the sensor.
    - `kernel_error`: over all that the capture takes of the PSF, which reaches beyond the sensor by
      the projected target.
    - `error`, `contrast_error`: errors of the capture, with its mean and without.
    """

    model: Model
    status: str
    reason: str | None
    psf_error: float | None = None
    kernel_error: float | None = None
    error: float | None = None
    contrast_error: float | None = None


class CaptureErrors:
    """Noise-free captures of the method's first exposure in float32: `work` fills `rows`."""

    def __init__(self, case: Case):
        self.case, self.rows = case, list[CaptureError]()
        self.work = [
            Step(f"capture: {words(model)}", partial(self._add, model))
            for model in models_of(case.study.mask)
        ]

    @cached_property
    def _exact(self) -> tuple[np.ndarray, list[np.ndarray]]:
        """The capture, and the PSF over the sensor and over all that the capture takes."""
        exposure = self.case.method.exposures[0]
        shapes = (None, self.case.kernel_shape)
        psfs = [psf_of(self.case.study, exposure, shape=shape) for shape in shapes]
        return clean_capture(self.case, exposure), psfs

    def _add(self, model: Model) -> None:
        exposure, reach = self.case.method.exposures[0], self.case.kernel_shape
        reason = kernel_reason(self.case, exposure, model)
        if reason is not None:
            self.rows.append(CaptureError(model, "not run", reason))
            return
        reference, exact = self._exact
        image = clean_capture(self.case, exposure, model, "float32")
        psfs = [psf_of(self.case.study, exposure, model, "float32", s) for s in (None, reach)]
        of_psf, of_kernel = (relative_error(h, h0) for h, h0 in zip(psfs, exact, strict=True))
        of_capture = relative_error(image, reference), contrast_error(image, reference)
        self.rows.append(CaptureError(model, "run", None, of_psf, of_kernel, *of_capture))


def clean_capture(
    case: Case,
    exposure: Exposure,
    model: Model = "separable",
    precision: Precision = "float64",
    assumed: Exposure | None = None,
) -> np.ndarray:
    """Light on the sensor, (channel, y, x), without noise or saturation.

    With `assumed`, the PSF is that of another camera; where the scene falls stays as it is.
    """
    with allow(precision):
        camera = conditions_of(case.study, exposure)[precision].camera
        blurring = conditions_of(case.study, assumed or exposure)[precision]
        plane = cast(case.target.plane, precision)
        shape = projected_shape(camera, plane)
        convolution = imaging_operator(
            blurring.camera,
            cast(Spectrum(blurring.wavelength), precision),
            blurring.object_distance,
            field_shape=shape,
            model=model,
            pixel_integration=case.study.pixel_integration,
        )
        return np.asarray(convolution(project(camera, plane, shape)))


def kernel_reason(case: Case, exposure: Exposure, model: Model) -> str | None:
    """Why a model is not run for a capture; None where it is."""
    with allow("float64"):
        given = conditions_of(case.study, exposure)["float64"]
        single = PsfMethod(model, "float32", case.study.pixel_integration)
        grid = Grid(case.kernel_shape, jnp.asarray(given.camera.sensor.pitch))
        method = psf_method(given.camera.mask, grid, single)
        return why_not(model, psf_cost(given.camera.mask, grid, method), given)


@dataclass(frozen=True)
class ModelCost:
    """Loss of a reconstruction that assumes a model in place of the exact one.

    - `psf_error`: relative, over the sensor and all the method's exposures.
    - `psnr_db`: against the scene; `psnr_lost_db`: against what the exact model reaches.
    """

    model: Model
    status: str
    reason: str | None
    psf_error: float | None = None
    psnr_db: float | None = None
    psnr_lost_db: float | None = None


@dataclass(frozen=True)
class ControlledCost:
    """Cost of a PSF error of a `level`: the exact model of a slightly wrong camera.

    - `wrong`: "beta" or "distance", whose relative `change` gives that error.
    - `psnr_lost_db`: the worse of a change up and down: by chance, one of them can gain a little.

    The scale of the object is the true one, so that only the PSF is wrong.
    """

    wrong: str
    level: float
    status: str
    reason: str | None
    change: float | None = None
    psf_error: float | None = None
    capture_error: float | None = None
    capture_contrast_error: float | None = None
    psnr_db: float | None = None
    psnr_lost_db: float | None = None


@dataclass(frozen=True)
class ReconstructionCosts:
    """The PSNR that a method reaches with the exact PSFs, and what it loses by wrong ones."""

    method: str
    skipped: str | None
    exact_psnr_db: float | None
    models: tuple[ModelCost, ...]
    controlled: tuple[ControlledCost, ...]

    def verdict(self) -> str:
        """Cost of a PSF error of 1 %, or why nothing was reconstructed."""
        if self.skipped:
            return f"no reconstruction: {self.skipped}"
        lost = [
            f"{row.psnr_lost_db:.4f}".replace("-", "−") + f" dB by a wrong {_NAMES[row.wrong]}"
            for row in self.controlled
            if row.level == 0.01 and row.status == "run"
        ]
        text = " and ".join(lost) if lost else "an unknown amount"
        return f"a PSF error of 1 % costs {self.method} {text}"


class ReconstructionErrors:
    """Noisy captures by the exact model, reconstructed with wrong PSFs: `work` fills `costs`."""

    def __init__(self, case: Case):
        self.case, self.exact_psnr_db = case, None
        self.models, self.controlled = list[ModelCost](), list[ControlledCost]()
        self.work: list[Step] = []
        if case.skipped is None:
            self.work.append(Step(f"captures for {case.method.name}", self._capture))
            for model in models_of(case.study.mask):
                step = partial(self._add_model, model)
                self.work.append(Step(f"reconstruction: {words(model)}", step))
            for quantity in QUANTITIES:
                for level in LEVELS:
                    text = f"a PSF error of {100 * level:g} % by a wrong {quantity}"
                    step = partial(self._add_controlled, quantity, level)
                    self.work.append(Step(text, step))

    @property
    def costs(self) -> ReconstructionCosts:
        """All that is done."""
        rows = tuple(self.models), tuple(self.controlled)
        name, skipped = self.case.method.name, self.case.skipped
        return ReconstructionCosts(name, skipped, self.exact_psnr_db, *rows)

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
        if reason is not None:
            self.models.append(ModelCost(model, "not run", reason))
            return
        psfs = [psf_of(self.case.study, exposure, model, "float32") for exposure in exposures]
        error = relative_error(np.stack(psfs), self.psfs)
        lost = self._lost(self._reconstruct(self.case.method, model))
        self.models.append(ModelCost(model, "run", None, error, *lost))

    def _add_controlled(self, quantity: str, level: float) -> None:
        case = self.case
        part = solve(case.study, case.method, quantity, level)
        if part is None:
            reason = f"no change of {quantity} of up to a half gives this error"
            self.controlled.append(ControlledCost(quantity, level, "not run", reason))
            return
        up, down = (changed(case.method, quantity, p) for p in (part, -part))
        wrong = clean_capture(case, case.method.exposures[0], assumed=up.exposures[0])
        both = [self._lost(self._reconstruct(method, "separable")) for method in (up, down)]
        errors = (
            relative_error(psfs_of(case.study, up), self.psfs),
            relative_error(wrong, self.clean),
            contrast_error(wrong, self.clean),
        )
        worse = max(both, key=lambda lost: lost[1])
        self.controlled.append(ControlledCost(quantity, level, "run", None, part, *errors, *worse))

    def _lost(self, found: Reconstruction) -> tuple[float, float]:
        """PSNR, and what is lost of it, dB."""
        assert self.exact_psnr_db is not None  # the captures come first
        reached = self._psnr(found)
        return reached, self.exact_psnr_db - reached

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


@dataclass(frozen=True)
class AccuracyResult:
    """Errors and times of the PSFs at all sizes, errors of captures, and costs in PSNR."""

    psfs: tuple[PsfAccuracy, ...]
    captures: tuple[CaptureError, ...]
    reconstructions: ReconstructionCosts

    def table(self) -> Table:
        """PSF models at the largest size, the fastest first; those worth choosing are marked."""
        largest = max((row.shape for row in self.psfs), key=max)
        rows = [row for row in self.psfs if row.shape == largest]
        shown = []
        for row in sorted(rows, key=lambda row: row.seconds or float("inf")):
            name = label(row.model, row.precision, row.oversampling)
            numbers_of = row.true_error, row.predicted_error, row.seconds, row.compile_seconds
            if None in numbers_of:
                shown.append([name, "not run", *[None] * 4])
                continue
            error, predicted, seconds, compiling = (float(number or 0) for number in numbers_of)
            error_text = "reference" if error == 0 else f"{error:.1e}"
            worth = "yes" if row.worth_choosing else ""
            times = f"{1000 * seconds:.2f}", f"{compiling:.1f}"
            shown.append([name, error_text, f"{predicted:.1e}", *times, worth])
        headings = ("PSF", "error", "predicted", "time ms", "compile s", "worth it")
        return Table(headings, shown, title=f"{largest[0]}×{largest[1]} pixels")


class AccuracyRun:
    """The models of a study's first exposure, step by step: `work` fills what `result` holds.

    - `sizes`: pixels along the sensor's longer side, for the PSFs. `case`: target and camera of the
      captures.
    """

    def __init__(self, study: Study, sizes: Sequence[int], case: Case):
        self.study, self.sizes, self.case = study, sizes, case
        self.psfs = [PsfErrors(study, study.exposures[0], size) for size in sizes]
        self.captures, self.reconstructions = CaptureErrors(case), ReconstructionErrors(case)
        parts = (*self.psfs, self.captures, self.reconstructions)
        self.work = [step for part in parts for step in part.work]

    @property
    def result(self) -> AccuracyResult:
        """All that is done."""
        psfs = tuple(row for errors in self.psfs for row in errors.rows)
        return AccuracyResult(psfs, tuple(self.captures.rows), self.reconstructions.costs)

    def record(self) -> dict[str, Any]:
        """The result as numbers, with its settings."""
        study, found = self.study, dataclasses.asdict(self.result)
        costs = found["reconstructions"]
        for rows in (found["captures"], costs["models"], costs["controlled"]):
            for row in rows:  # without the figures of one that was not run
                for key in [key for key, value in row.items() if value is None and key != "reason"]:
                    del row[key]
        settings = {
            "study": study.name,
            "reference": "separable, float64",
            "sizes": list(self.sizes),
            "camera": _numbers(study.exposures[0]),
            "object_distance_mm": study.object_distance,
            "pixel_integration": study.pixel_integration,
            "capture_shape": list(self.case.study.sensor.shape),
            "target": self.case.target.name,
            "captured": _numbers(self.case.method.exposures[0]),
        }
        return {"settings": settings} | found


def _numbers(exposure: Exposure) -> dict[str, Any]:
    names = "beta_rad_per_mm2", "phase_rad", "distance_mm", "wavelength_mm"
    numbers = exposure.beta, exposure.phase, exposure.distance, exposure.wavelength
    return dict(zip(names, numbers, strict=True))


def measure_accuracy(
    study: Study, sizes: Sequence[int], capture_size: int, progress: Progress | None = None
) -> AccuracyResult:
    """Error and time of every PSF model of a study's camera, and what errors cost its images.

    - `sizes`, `capture_size`: pixels along the sensor's longer side, to which it is binned, of the
      PSFs and of captures and reconstructions.

    The camera is that of the first exposure. Captured is the first picture, and reconstructed by
    the first Wiener method.
    """
    run = AccuracyRun(study, sizes, make_case(study, capture_size))
    carry_out(run.work, progress)
    return run.result
