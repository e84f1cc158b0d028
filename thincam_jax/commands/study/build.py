"""From an experiment file to a study: cameras, exposures, noise, targets and methods."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import jax
import numpy as np

from thincam_jax import reconstruction
from thincam_jax.commands.config_file import ConfigError
from thincam_jax.commands.sections import (
    CamerasConfig,
    MaskConfig,
    MethodConfig,
    NoiseConfig,
    SensorConfig,
    TargetConfig,
    VariationConfig,
)
from thincam_jax.commands.study.config import PictureConfig, StudyConfig
from thincam_jax.commands.study.mask import built_mask
from thincam_jax.imaging import targets as drawn
from thincam_jax.imaging.metrics.image import SSIM_WINDOW
from thincam_jax.imaging.metrics.mtf import MINIMUM_COLUMNS
from thincam_jax.imaging.sensor import AbstractNoise, Sensor
from thincam_jax.lensless import masks
from thincam_jax.lensless.exposures import Exposure, Exposures
from thincam_jax.reconstruction.solver import AbstractSolver
from thincam_jax.reconstruction.wiener import Prior
from thincam_jax.studies.evaluate import field_shape
from thincam_jax.studies.study import Method, Published, Study, Target

# The scene's power is read off frequencies above three cycles a sensor (`spectra.inner_band`).
_MINIMUM_ROWS = 7


@dataclass(frozen=True, eq=False)
class FileStudy(Study):
    """A study with the file that it was read from."""

    config: Any = None


def build_study(config: StudyConfig) -> FileStudy:
    """All that a study needs, images read and everything checked, before the first capture.

    **Errors**: ConfigError, one line for each fault, beginning with the field.
    """
    targets, unread = read_targets(config.targets, config.object.distance, config.object.width)
    try:
        study = assemble(config, targets)
    except ConfigError as error:
        raise ConfigError("\n".join([str(error), *_lines(config, unread)])) from None
    check_study(study, unread)
    return study


def assemble(config: CamerasConfig, targets: Sequence[Target]) -> FileStudy:
    """Cameras, noise and methods of a file, before targets.

    **Errors**: ConfigError for a mask or a sensor that cannot be built.
    """
    methods = tuple(as_method(config, method) for method in config.methods)
    mask, sensor = build_optics(config.mask, config.sensor, methods[0].exposures[0])
    return FileStudy(
        mask,
        sensor,
        methods,
        tuple(targets),
        object_distance=config.object.distance if isinstance(config, StudyConfig) else math.inf,
        noise=build_noise(config.noise),
        model=config.model,
        pixel_integration=config.pixel_integration,
        seed=config.seed,
        name=config.name,
        mask_name=config.mask.label,
        config=config,
    )


def build_optics(
    mask: MaskConfig, sensor: SensorConfig, exposure: Exposure
) -> tuple[masks.AbstractMask, Sensor]:
    """The mask of an exposure, and the sensor. **Errors**: ConfigError where one is none."""
    try:
        return built_mask(mask, exposure), sensor.build()
    except (ValueError, TypeError, FileNotFoundError) as error:
        raise ConfigError(f"mask, sensor or model: {error}") from None


def as_method(config: CamerasConfig, method: MethodConfig) -> Method:
    """A method of a file, with all of its exposures."""
    published = method.published
    return Method(
        method.name,
        exposures_of(config, method),
        build_solver(method.kind, method.variation, config.prior),
        method.synthesis,
        len(method.shot_phases()),
        method.harmonics,
        Published(published.psnr_db, published.resolved, published.limit_cycles_per_mm),
    )


def exposures_of(config: CamerasConfig, method: MethodConfig) -> Exposures:
    """Each shot of a method at each of its phases; one after another where the object moves."""
    shots = method.shots
    settings = Exposures(
        [shot.beta or 0.0 for shot in shots],  # 0: of a mask without zones
        [shot.distance for shot in shots],
        wavelength=[shot.wavelength or config.wavelength for shot in shots],
        width=[shot.width or config.mask.width for shot in shots],
        relative_time=[shot.exposure for shot in shots],
        profile=[shot.profile for shot in shots],
        take=[shot.take or 1 for shot in shots],
    )
    exposures = settings.at_phases(method.shot_phases())
    return exposures.of_moving(config.motion) if config.motion else exposures


def build_solver(
    kind: str, variation: VariationConfig | None, prior: Prior = "inverse_square"
) -> AbstractSolver:
    """The solver of a method's kind."""
    if kind == "fringe_scanning":
        return reconstruction.FringeScanning()
    if kind == "wiener":
        return reconstruction.Wiener(prior=prior)
    asked = variation or VariationConfig()
    total = reconstruction.TotalVariation(
        asked.kind, asked.coupling or "opponent", chroma_weight=asked.chroma_weight
    )
    return reconstruction.AdmmTV(asked.tau, variation=total, iterations=asked.iterations)


def build_noise(noise: NoiseConfig | None) -> AbstractNoise | None:
    return None if noise is None else noise.build()


def read_targets(
    entries: Sequence[TargetConfig], distance: float, width: float
) -> tuple[list[Target], dict[int, str]]:
    """The targets at one distance, and by its place why another cannot be read."""
    targets, unread = [], {}
    for number, entry in enumerate(entries):
        try:
            image = read_picture(entry)
        except (ValueError, FileNotFoundError) as error:
            unread[number] = str(error)
            continue
        target = Target.of_image(entry.name, image, distance, width, entry.kind)
        targets.append(replace(target, number=number))
    return targets, unread


def read_picture(target: TargetConfig) -> np.ndarray:
    """Drawn, a photograph or a file: (y, x) or (y, x, channel)."""
    if target.kind == "photograph":
        return drawn.sample_image(target.image or "")
    if target.kind == "file":
        return drawn.load_image(target.path or "")
    shape = (target.pixels, target.pixels)
    if target.kind == "point_grid":
        return drawn.point_grid(shape, count=(9, 9))
    return getattr(drawn, target.kind)(shape)


def picture(target: PictureConfig, cells: tuple[int, int], channels: int = 0) -> np.ndarray:
    """A target on cells, radiance 0 to 1: (y, x), or with so many channels (y, x, channel).

    **Errors**: ValueError for a uniform picture, FileNotFoundError where there is none.
    """
    picture = np.atleast_3d(read_picture(target))
    if target.crop < 1:
        picture = drawn.middle_square(picture, round(target.crop * min(picture.shape[:2])))
    picture = drawn.resize(picture if channels else picture.mean(axis=-1), cells)
    if channels:
        picture = np.broadcast_to(picture, (*cells, channels))
    if target.binary:
        picture = (picture > picture.mean()).astype(float)
    if picture.min() == picture.max():
        raise ValueError("the image is uniform: there is nothing to reconstruct; give another one")
    return picture


def check_study(study: FileStudy, unread: dict[int, str] | None = None) -> None:
    """Refuse cameras that cannot be built, images that cannot be read, and too few pixels.

    `unread`: why images could not be read, by the target's place.

    **Errors**: ConfigError, one line for each fault, beginning with the field.
    """
    known = {target.number: _target_fault(study, target) for target in study.targets}
    known |= unread or {}
    faults = _lines(study.config, known)
    camera = _camera_fault(study)
    if camera or faults:
        raise ConfigError("\n".join([*filter(None, [camera]), *faults]))


def _lines(config: Any, faults: dict[int, str]) -> list[str]:
    """Faults of targets, by their place."""
    return [
        f"{config.place_of('targets', number, 'path')}targets[{number}]: {fault}"
        for number, fault in sorted(faults.items())
        if fault
    ]


def _camera_fault(study: FileStudy) -> str:
    """Empty for none."""
    rows, columns = study.sensor.shape
    place = study.config.place_of("sensor", "shape")
    if rows < _MINIMUM_ROWS or columns < MINIMUM_COLUMNS:
        return (
            f"{place}sensor.shape: {rows}×{columns} pixels are too few for a study; "
            f"give at least {_MINIMUM_ROWS}×{MINIMUM_COLUMNS}"
        )
    try:
        for exposure in study.exposures:
            study.camera(exposure)
        # Traced only: whether the model takes this mask at all.
        jax.eval_shape(lambda: study.psf(study.exposures[0]))
    except MemoryError as error:
        return f"{place}sensor.shape: {error}"
    except (ValueError, TypeError, FileNotFoundError) as error:
        return f"mask, sensor or model: {error}"
    return ""


def _target_fault(study: Study, target: Target) -> str:
    """Empty for none."""
    if target.plane.image.min() == target.plane.image.max():
        return "the image is uniform: there is nothing to reconstruct; give another one"
    for method in study.methods:
        shape = field_shape(study, method, target)
        if min(shape) < SSIM_WINDOW:
            return (
                f"{method.name!r} reconstructs it on {shape[0]}×{shape[1]} pixels, at least "
                f"{SSIM_WINDOW}×{SSIM_WINDOW} are needed; give a larger object.width or a "
                "smaller sensor.pitch"
            )
    return ""
