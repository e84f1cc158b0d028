"""A plate as a shop makes it beside the mask that was meant: PSF and image."""

import warnings
from dataclasses import dataclass, replace

import numpy as np

from thincam_jax._core.precision import AccuracyWarning
from thincam_jax.lensless.exposures import Exposure, Exposures
from thincam_jax.lensless.masks.base import AbstractMask
from thincam_jax.lensless.method import PsfMethod
from thincam_jax.lensless.psf import psf
from thincam_jax.reconstruction.regularised import AdmmTV
from thincam_jax.studies.evaluate import evaluate_method, take
from thincam_jax.studies.study import Method, Study

_NODES = 144  # of a pixel, for cells that are finer


@dataclass(frozen=True)
class PlateComparison:
    """Differences of a made plate from the grey mask.

    - `psf_error`: relative L2 difference of the PSFs on the sensor's pixels.
    - `target`: name of the scene of both images, "" without; `plate_db`, `grey_db`: their PSNR,
      each by its own PSF, of one capture with the study's noise.
    """

    psf_error: float
    target: str = ""
    plate_db: float = 0.0
    grey_db: float = 0.0


def compare_plates(
    study: Study, exposure: Exposure, mask: AbstractMask, plate: AbstractMask
) -> PlateComparison:
    """Compare a plate with the mask of one exposure of a study.

    The first picture among its targets is reconstructed with both, by `AdmmTV`.
    """
    kernels = []
    for one in (mask, plate):
        camera = exposure.camera(study.sensor, study.mask).replace(mask=one)
        light, method = exposure.wavelength, PsfMethod("separable", nodes=_NODES)
        found = psf(camera, wavelength=light, object_distance=study.object_distance, model=method)
        kernels.append(np.asarray(found, float))
    error = float(np.linalg.norm(kernels[1] - kernels[0]) / np.linalg.norm(kernels[0]))
    seen = [target for target in study.targets if target.is_picture]
    if not seen:
        return PlateComparison(error)
    scores = []
    for name, one in (("grey", mask), ("plate", plate)):
        alone = Exposures.of([replace(exposure, moves=None)])
        method = Method(name, alone, AdmmTV())
        made = replace(study, mask=one, methods=(method,), targets=())
        with warnings.catch_warnings():
            # Capture and image are of one PSF: 144 points a pixel change neither PSNR by 0.01 dB.
            warnings.simplefilter("ignore", AccuracyWarning)
            captures = {alone[0]: take(made, alone[0], seen[0])}
            scores.append(evaluate_method(made, method, seen[0], captures).scores.psnr_db)
    return PlateComparison(error, seen[0].name, scores[1], scores[0])
