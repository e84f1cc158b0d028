"""Errors of noise-free captures."""

from functools import cached_property, partial
from typing import Any

import jax.numpy as jnp
import numpy as np

from thincam_jax._core.grids import Grid
from thincam_jax._core.precision import Precision, allow, cast
from thincam_jax.commands.accuracy.cameras import (
    Case,
    conditions_of,
    contrast_error,
    psf_of,
    relative_error,
)
from thincam_jax.commands.accuracy.psfs import why_not, words
from thincam_jax.commands.run_folder import Step
from thincam_jax.imaging.scene import Spectrum
from thincam_jax.lensless.cost import psf_cost
from thincam_jax.lensless.exposures import Exposure
from thincam_jax.lensless.forward import imaging_operator, project, projected_shape
from thincam_jax.lensless.method import MODELS, Model, psf_method


class CaptureErrors:
    """A row for every model, in float32, of the method's first exposure.

    - `psf_error`: of the PSF over the sensor.
    - `kernel_error`: over all that the capture takes of the PSF, which reaches beyond the sensor by
      the projected target.
    - `error`, `contrast_error`: of the capture, with its mean and without.

    All are relative to separable in float64. `work` fills `rows`.
    """

    def __init__(self, case: Case):
        self.case, self.rows = case, []
        self.work = [
            Step(f"capture: {words(model)}", partial(self._add, model)) for model in MODELS
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
        row: dict[str, Any] = {"model": model, "status": "not run", "reason": reason}
        if reason is None:
            reference, exact = self._exact
            image = clean_capture(self.case, exposure, model, "float32")
            psfs = [psf_of(self.case.study, exposure, model, "float32", s) for s in (None, reach)]
            errors = [relative_error(h, h0) for h, h0 in zip(psfs, exact, strict=True)]
            row |= {
                "status": "run",
                "psf_error": errors[0],
                "kernel_error": errors[1],
                "error": relative_error(image, reference),
                "contrast_error": contrast_error(image, reference),
            }
        self.rows.append(row)


def clean_capture(
    case: Case,
    exposure: Exposure,
    model: Model = "separable",
    precision: Precision = "float64",
    assumed: Exposure | None = None,
) -> np.ndarray:
    """What falls on the sensor, (channel, y, x), without noise or saturation.

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
        whole = case.study.pixel_integration
        grid = Grid(case.kernel_shape, jnp.asarray(given.camera.sensor.pitch))
        method = psf_method(given.camera.mask, grid, model, whole, "float32")
        return why_not(model, psf_cost(given.camera.mask, grid, method), given)
