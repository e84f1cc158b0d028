"""What is compared: a study's camera with binned pixels in both precisions, and one target."""

import dataclasses
from dataclasses import dataclass

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Num

from thincam_jax._core.grids import Grid
from thincam_jax._core.precision import PRECISIONS, Precision, allow, cast
from thincam_jax.commands.config_file import ConfigError
from thincam_jax.commands.sections import SensorConfig
from thincam_jax.commands.study.build import FileStudy, check_study
from thincam_jax.imaging.operators import kernel_shape
from thincam_jax.lensless.camera import LenslessCamera
from thincam_jax.lensless.exposures import Exposure
from thincam_jax.lensless.forward import projected_shape
from thincam_jax.lensless.method import Model
from thincam_jax.lensless.psf import psf
from thincam_jax.studies.study import Method, Study, Target

DEFAULT_SIZES = (128, 256, 512)  # pixels along the longer side
DEFAULT_CAPTURE_SIZE = 256


def sizes_of(sensor: SensorConfig, asked: tuple[int, ...]) -> tuple[int, ...]:
    """The sizes asked for, or the default ones and the study's own; each once, smallest first.

    **Errors**: ConfigError for a size that is not positive or above the study's own.
    """
    own = max(sensor.shape)
    for size in asked:
        _check("--size", size, own)
    wanted = asked or (*(s for s in DEFAULT_SIZES if s < own), own)
    return tuple(sorted(set(wanted)))


def capture_size_of(sensor: SensorConfig, asked: int | None) -> int:
    """The size for captures and reconstructions; errors as for `sizes_of`."""
    if asked is None:
        return min(DEFAULT_CAPTURE_SIZE, max(sensor.shape))
    _check("--capture-size", asked, max(sensor.shape))
    return asked


def binned(study: FileStudy, size: int) -> FileStudy:
    """The study with its pixels binned so that the sensor's longer side has `size` of them.

    The pitch grows by the same ratio, so that the sensor keeps its area: along the longer side
    exactly, along the shorter one to half a pixel. The mask stays as it is.
    """
    ratio = max(study.sensor.shape) / size
    rows, columns = (max(1, round(n / ratio)) for n in study.sensor.shape)
    sensor = dataclasses.replace(study.sensor, shape=(rows, columns), pitch=study.pitch * ratio)
    return dataclasses.replace(study, sensor=sensor)


def _check(option: str, size: int, own: int) -> None:
    if size < 1:
        raise ConfigError(f"{option} {size}: give a number of pixels above zero")
    if size > own:
        raise ConfigError(
            f"{option} {size}: the study's own sensor has {own} pixels; give at most {own}"
        )


class Conditions(eqx.Module):
    """Camera, wavelength (mm) and object distance (mm) in one precision."""

    camera: LenslessCamera
    wavelength: Array
    object_distance: Array


def conditions_of(study: Study, exposure: Exposure) -> dict[Precision, Conditions]:
    """One exposure in each precision. The numbers are those of float32 in both.

    So a difference between the two is what the arithmetic leaves, not how the numbers are stored.
    """
    found: dict[Precision, Conditions] = {}
    with allow("float64"):
        numbers = (exposure.wavelength, study.object_distance)
        wavelength, distance = (jnp.asarray(np.float32(n)) for n in numbers)
        single = cast(study.camera(exposure), "float32")
        for precision in PRECISIONS:
            found[precision] = Conditions(*cast((single, wavelength, distance), precision))
    return found


def psf_of(
    study: Study,
    exposure: Exposure,
    model: Model = "separable",
    precision: Precision = "float64",
    shape: tuple[int, int] | None = None,
) -> np.ndarray:
    """PSF on the sensor, or on `shape` of its pixels; by default the one that errors count from."""
    with allow(precision):
        given = conditions_of(study, exposure)[precision]
        grid = given.camera.sensor.grid
        h = psf(
            given.camera,
            wavelength=given.wavelength,
            object_distance=float(given.object_distance),
            model=model,
            pixel_integration=study.pixel_integration,
            grid=Grid(shape, grid.pitch) if shape else grid,
            precision=precision,
        )
    return np.asarray(h)


def relative_error(image: Num[ArrayLike, "..."], reference: Num[ArrayLike, "..."]) -> float:
    """‖image − reference‖₂ / ‖reference‖₂ over all numbers, real or complex."""
    image, reference = np.asarray(image, complex), np.asarray(reference, complex)
    return float(np.linalg.norm(image - reference) / np.linalg.norm(reference))


def contrast_error(
    image: Num[ArrayLike, "*batch y x"], reference: Num[ArrayLike, "*batch y x"]
) -> float:
    """The same without the mean of each (y, x) image: the bias of a capture carries no picture."""
    contrasts = (np.asarray(a, float) for a in (image, reference))
    return relative_error(*(c - c.mean(axis=(-2, -1), keepdims=True) for c in contrasts))


@dataclass(frozen=True, eq=False)
class Case:
    """A target in front of a study's camera with binned pixels.

    - `study`: the binned study, with the exact model.
    - `method`: the method that reconstructs; its first exposure is the one captured.
    - `target`: what is seen.
    - `skipped`: why nothing is reconstructed; None where something is.
    """

    study: FileStudy
    method: Method
    target: Target
    skipped: str | None

    @property
    def kernel_shape(self) -> tuple[int, int]:
        """Pixels of the PSF that the first capture takes: more than the sensor's by the scene's."""
        camera = self.study.camera(self.method.exposures[0])
        return kernel_shape(camera.sensor.shape, projected_shape(camera, self.target.plane))


def make_case(study: FileStudy, size: int) -> Case:
    """The first picture (else the first target) and the first Wiener method (else the first).

    **Errors**: ConfigError where the size is too small to reconstruct.
    """
    study = dataclasses.replace(binned(study, size), model="separable")
    try:
        check_study(study)
    except ConfigError as error:
        raise ConfigError(f"--capture-size {size}: {str(error).splitlines()[0]}") from None
    pictures = [target for target in study.targets if target.is_picture]
    wiener = [method for method in study.methods if method.solver.name == "wiener"]
    method = (wiener or study.methods)[0]
    skipped = None if wiener else f"{method.name}: fringe scanning assumes no PSF"
    return Case(study, method, (pictures or list(study.targets))[0], skipped)
