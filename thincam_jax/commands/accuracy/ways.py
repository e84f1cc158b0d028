"""The ways of computing a PSF that are compared, and why some are not run."""

from typing import NamedTuple

from thincam_jax._core.memory import available_bytes, readable
from thincam_jax._core.precision import PRECISIONS, Precision, itemsize_of
from thincam_jax.commands.accuracy.cameras import Conditions
from thincam_jax.lensless.camera import LenslessCamera
from thincam_jax.lensless.cost import Cost, psf_cost
from thincam_jax.lensless.propagation.closed_form import in_focus
from thincam_jax.lensless.psf import MODELS, SAMPLED, Model, sampling_of

OVERSAMPLINGS = (1, 3)
# Operations of a direct sum that take some seconds; it is not run beyond.
DIRECT_SUM_LIMIT = 2e10


class Way(NamedTuple):
    """One way of computing a PSF.

    - `model`, `precision`, `oversampling`, `mask_shape`: as `psf` takes them; the last two are None
      for the closed forms.
    - `cost`: predicted operations and memory.
    """

    model: Model
    precision: Precision
    oversampling: int | None
    mask_shape: tuple[int, int] | None
    cost: Cost


def all_ways(camera: LenslessCamera, pixel_integration: bool) -> list[Way]:
    """Every model in both precisions, the sampled ones at each oversampling."""
    grid = camera.sensor.grid
    found = []
    for model in MODELS:
        for oversampling in OVERSAMPLINGS if model in SAMPLED else (None,):
            shape, samples = sampling_of(camera, grid, model, pixel_integration, oversampling, None)
            for precision in PRECISIONS:
                cost = psf_cost(
                    camera.mask,
                    grid,
                    model,
                    pixel_integration=pixel_integration,
                    mask_shape=shape,
                    oversampling=samples,
                    itemsize=itemsize_of(precision),
                )
                found.append(Way(model, precision, oversampling, shape, cost))
    return found


def why_not(model: Model, cost: Cost, given: Conditions) -> str | None:
    """Why a model is not run under given conditions; None where it is."""
    if model == "rayleigh_sommerfeld" and cost.flops > DIRECT_SUM_LIMIT:
        return f"a direct sum of {cost.flops:.1e} operations, above {DIRECT_SUM_LIMIT:.0e}"
    free = available_bytes()
    if free is not None and cost.bytes > free:
        return f"needs about {readable(cost.bytes)}, {readable(free)} are free"
    path = given.camera.path(given.wavelength, given.object_distance)
    if model == "closed_form" and in_focus(given.camera.mask, path):
        return "has no PSF: an order of the mask focuses on the sensor"
    return None
