"""Errors of noise-free captures."""

from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
import numpy as np

from thincam_jax._core.grids import Grid
from thincam_jax._core.precision import Precision, allow, cast
from thincam_jax.commands.accuracy.cameras import conditions_of, psf_of
from thincam_jax.commands.accuracy.norms import contrast_error, relative_error
from thincam_jax.commands.accuracy.psfs import words
from thincam_jax.commands.accuracy.rig import Rig
from thincam_jax.commands.accuracy.ways import why_not
from thincam_jax.commands.study.study import Exposure
from thincam_jax.imaging.scene import Spectrum
from thincam_jax.lensless.cost import psf_cost
from thincam_jax.lensless.exposure import imaging_operator, project, projected_shape
from thincam_jax.lensless.psf import MODELS, Model, sampling_of


def capture_rows(rig: Rig, progress: Callable[[str], None]) -> list[dict[str, Any]]:
    """A row for every model, in float32, of the method's first exposure.

    - `psf_error`: of the PSF over the sensor.
    - `kernel_error`: over all that the capture takes of the PSF, which reaches beyond the sensor by
      the projected target.
    - `error`, `contrast_error`: of the capture, with its mean and without.

    All are relative to separable in float64.
    """
    exposure, reach = rig.exposures[0], rig.kernel_shape
    reference = clean_capture(rig, exposure)
    exact = [psf_of(rig.study, exposure, shape=shape) for shape in (None, reach)]
    rows = []
    for model in MODELS:
        progress(f"capture: {words(model)}")
        reason = kernel_reason(rig, exposure, model)
        row: dict[str, Any] = {"model": model, "status": "not run", "reason": reason}
        if reason is None:
            image = clean_capture(rig, exposure, model, "float32")
            psfs = [psf_of(rig.study, exposure, model, "float32", s) for s in (None, reach)]
            errors = [relative_error(h, h0) for h, h0 in zip(psfs, exact, strict=True)]
            row |= {
                "status": "run",
                "psf_error": errors[0],
                "kernel_error": errors[1],
                "error": relative_error(image, reference),
                "contrast_error": contrast_error(image, reference),
            }
        rows.append(row)
    return rows


def clean_capture(
    rig: Rig,
    exposure: Exposure,
    model: Model = "separable",
    precision: Precision = "float64",
    assumed: Exposure | None = None,
) -> np.ndarray:
    """What falls on the sensor, (channel, y, x), without noise or saturation.

    With `assumed`, the PSF is that of another camera; where the scene falls stays as it is.
    """
    with allow(precision):
        camera = conditions_of(rig.study, exposure)[precision].camera
        blurring = conditions_of(rig.study, assumed or exposure)[precision]
        plane = cast(rig.target.plane, precision)
        shape = projected_shape(camera, plane)
        convolution = imaging_operator(
            blurring.camera,
            cast(Spectrum(blurring.wavelength), precision),
            blurring.object_distance,
            field_shape=shape,
            model=model,
            pixel_integration=rig.study.config.pixel_integration,
        )
        return np.asarray(convolution(project(camera, plane, shape)))


def kernel_reason(rig: Rig, exposure: Exposure, model: Model) -> str | None:
    """Why a model is not run for a capture; None where it is."""
    with allow("float64"):
        given = conditions_of(rig.study, exposure)["float64"]
        whole = rig.study.config.pixel_integration
        grid = Grid(rig.kernel_shape, jnp.asarray(given.camera.sensor.pitch))
        shape, samples = sampling_of(given.camera, grid, model, whole, None, None)
        cost = psf_cost(
            given.camera.mask,
            grid,
            model,
            pixel_integration=whole,
            mask_shape=shape,
            oversampling=samples,
        )
        return why_not(model, cost, given)
