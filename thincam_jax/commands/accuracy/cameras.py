"""What is compared: a study's camera with binned pixels in both precisions, and one target."""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Num

from thincam_jax._core.grids import Grid
from thincam_jax._core.precision import PRECISIONS, Precision, allow, cast
from thincam_jax.commands.study import build
from thincam_jax.commands.study.check import check_study
from thincam_jax.commands.study.config import ConfigError, MethodConfig, StudyConfig, TargetConfig
from thincam_jax.imaging.operators import kernel_shape
from thincam_jax.imaging.scene import ImagePlane
from thincam_jax.lensless.camera import LenslessCamera
from thincam_jax.lensless.forward import projected_shape
from thincam_jax.lensless.method import Model
from thincam_jax.lensless.psf import psf

DEFAULT_SIZES = (128, 256, 512)  # pixels along the longer side
DEFAULT_CAPTURE_SIZE = 256


def own_size(config: StudyConfig) -> int:
    """Pixels along the longer side of the study's own sensor."""
    return max(config.sensor.shape)


def sizes_of(config: StudyConfig, asked: tuple[int, ...]) -> tuple[int, ...]:
    """The sizes asked for, or the default ones and the study's own; each once, smallest first.

    **Errors**: ConfigError for a size that is not positive or above the study's own.
    """
    for size in asked:
        _check("--size", size, own_size(config))
    own = own_size(config)
    wanted = asked or (*(s for s in DEFAULT_SIZES if s < own), own)
    return tuple(sorted(set(wanted)))


def capture_size_of(config: StudyConfig, asked: int | None) -> int:
    """The size for captures and reconstructions; errors as for `sizes_of`."""
    if asked is None:
        return min(DEFAULT_CAPTURE_SIZE, own_size(config))
    _check("--capture-size", asked, own_size(config))
    return asked


def binned(config: StudyConfig, size: int) -> StudyConfig:
    """The study with its pixels binned so that the sensor's longer side has `size` of them.

    The pitch grows by the same ratio, so that the sensor keeps its area: along the longer side
    exactly, along the shorter one to half a pixel. The mask stays as it is.
    """
    ratio = own_size(config) / size
    rows, columns = (max(1, round(n / ratio)) for n in config.sensor.shape)
    sensor = config.sensor.model_copy(
        update={"shape": (rows, columns), "pitch": config.sensor.pitch * ratio}
    )
    return config.model_copy(update={"sensor": sensor})


def _check(option: str, size: int, own: int) -> None:
    if size < 1:
        raise ConfigError(f"{option} {size}: give a number of pixels above zero")
    if size > own:
        raise ConfigError(
            f"{option} {size}: the study's own sensor has {own} pixels; give at most {own}"
        )


class Conditions(NamedTuple):
    """Camera, wavelength (mm) and object distance (mm) in one precision."""

    camera: LenslessCamera
    wavelength: Array
    object_distance: Array


def conditions_of(config: StudyConfig, setting: build.Setting) -> dict[Precision, Conditions]:
    """One setting in each precision. The numbers are those of float32 in both.

    So a difference between the two is what the arithmetic leaves, not how the numbers are stored.
    """
    found: dict[Precision, Conditions] = {}
    with allow("float64"):
        numbers = (setting.wavelength, config.object.distance)
        wavelength, distance = (jnp.asarray(np.float32(n)) for n in numbers)
        single = cast(build.build_camera(config, setting), "float32")
        for precision in PRECISIONS:
            found[precision] = Conditions(*cast((single, wavelength, distance), precision))
    return found


def psf_of(
    config: StudyConfig,
    setting: build.Setting,
    model: Model = "separable",
    precision: Precision = "float64",
    shape: tuple[int, int] | None = None,
) -> np.ndarray:
    """PSF on the sensor, or on `shape` of its pixels; by default the one that errors count from."""
    with allow(precision):
        camera, wavelength, distance = conditions_of(config, setting)[precision]
        grid = camera.sensor.grid
        h = psf(
            camera,
            wavelength=wavelength,
            object_distance=float(distance),
            model=model,
            pixel_integration=config.pixel_integration,
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


class Case(NamedTuple):
    """A target in front of a study's camera with binned pixels.

    - `config`: the binned study, with the exact model.
    - `method`: the method that reconstructs; its first exposure is the one captured.
    - `target`, `plane`: what is seen; `number` is the target's place in the study.
    - `skipped`: why nothing is reconstructed; None where something is.
    """

    config: StudyConfig
    method: MethodConfig
    target: TargetConfig
    plane: ImagePlane
    number: int
    skipped: str | None

    @property
    def settings(self) -> list[build.Setting]:
        """The method's exposures."""
        return build.settings(self.config, self.method)

    @property
    def kernel_shape(self) -> tuple[int, int]:
        """Pixels of the PSF that the first capture takes: more than the sensor's by the scene's."""
        camera = build.build_camera(self.config, self.settings[0])
        return kernel_shape(camera.sensor.shape, projected_shape(camera, self.plane))


def make_case(config: StudyConfig, size: int) -> Case:
    """The first picture (else the first target) and the first Wiener method (else the first).

    **Errors**: ConfigError where the size is too small to reconstruct.
    """
    config = binned(config, size).model_copy(update={"model": "separable"})
    try:
        check_study(config)
    except ConfigError as error:
        raise ConfigError(f"--capture-size {size}: {str(error).splitlines()[0]}") from None
    pictures = [t for t in config.targets if t.kind in ("photograph", "file")]
    target = (pictures or list(config.targets))[0]
    wiener = [m for m in config.methods if m.kind == "wiener"]
    method = (wiener or list(config.methods))[0]
    skipped = None if wiener else f"{method.name}: fringe scanning assumes no PSF"
    number = config.targets.index(target)
    return Case(config, method, target, build.build_plane(config, target), number, skipped)
