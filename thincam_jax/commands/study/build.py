"""Study of an experiment file: cameras, exposures, noise, targets and methods."""

import math
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from thincam_jax._core.memory import readable
from thincam_jax.commands.config_file import ConfigError
from thincam_jax.commands.mask import MaskConfig, built_mask
from thincam_jax.commands.sections import (
    CamerasConfig,
    PictureConfig,
    SensorConfig,
    StudyConfig,
    TargetConfig,
    as_method,
)
from thincam_jax.imaging import targets as drawn
from thincam_jax.imaging.sensor import Sensor
from thincam_jax.imaging.targets.images import load_image, placed
from thincam_jax.imaging.targets.patterns import point_grid
from thincam_jax.lensless.accuracy.select import predict_cost
from thincam_jax.lensless.exposures import Exposure
from thincam_jax.lensless.masks.base import AbstractMask
from thincam_jax.studies.evaluate import check_cameras, check_target
from thincam_jax.studies.study import Study, Target


def build_study(config: StudyConfig) -> Study:
    """All that a study needs, images read and everything checked, before the first capture.

    **Errors**: ConfigError, one line for each fault, beginning with the field.
    """
    return with_targets(config, lambda: assemble(config))


def with_targets(config: Any, make: Callable[[], Study], read: Any = None) -> Study:
    """The study that a function makes, with the targets of a file.

    `read`: a target of the study, None where that cannot be built, and of an entry; by default
    where the file's object stands.

    **Errors**: ConfigError, one line for each fault, beginning with the field: cameras that cannot
    be built, images that cannot be read or that no method can be scored on.
    """
    study, wrong = None, []
    try:
        study = make()
        check_optics(study)
    except ConfigError as error:
        wrong.append(str(error))

    def standing(study: Study | None, entry: TargetConfig) -> Target:
        seen, image = config.object, read_picture(entry)
        target = Target.of_image(entry.name, image, seen.distance, seen.width, entry.kind)
        if study is not None:
            check_target(study, target)
        return target

    read = partial(read or standing, study)
    targets, faults = config.read_each(config.pictured, read, "path")
    if study is None or wrong or faults:
        raise ConfigError("\n".join([*wrong, *faults]))
    return replace(study, targets=tuple(targets))


def assemble(config: CamerasConfig) -> Study:
    """Cameras, noise and methods of a file, before targets.

    **Errors**: ConfigError for a mask or a sensor that cannot be built.
    """
    methods = tuple(as_method(config, method) for method in config.methods)
    mask, sensor = build_optics(config.mask, config.sensor, methods[0].exposures[0])
    return Study(
        mask,
        sensor,
        methods,
        object_distance=config.object.distance if isinstance(config, StudyConfig) else math.inf,
        noise=config.noise and config.noise.build(),
        model=config.model,
        pixel_integration=config.pixel_integration,
        field_tolerance=config.field_tolerance,
        seed=config.seed,
        name=config.name,
        mask_name=config.mask.label,
        config=config,
    )


def build_optics(
    mask: MaskConfig, sensor: SensorConfig, exposure: Exposure
) -> tuple[AbstractMask, Sensor]:
    """The mask of an exposure, and the sensor. **Errors**: ConfigError where one is none."""
    try:
        return built_mask(mask, exposure), sensor.build()
    except (ValueError, TypeError, FileNotFoundError) as error:
        raise ConfigError(f"mask, sensor or model: {error}") from None


def read_picture(target: TargetConfig) -> np.ndarray:
    """Drawn, a photograph or a file: (y, x) or (y, x, channel)."""
    codes = target.kind == "photograph" or isinstance(target, PictureConfig)
    linear = codes if target.linear is None else target.linear
    if target.kind == "photograph":
        return drawn.sample_image(target.image or "", linear=linear)
    if target.kind == "file":
        return load_image(target.path or "", linear=linear)
    shape = (target.pixels, target.pixels)
    if target.kind == "point_grid":
        return point_grid(shape, count=(9, 9))
    return getattr(drawn, target.kind)(shape)


def cropped(target: Any) -> np.ndarray:
    """The middle of a picture, `crop` of its shorter side."""
    picture = read_picture(target)
    if target.crop == 1:
        return picture
    return drawn.middle_square(picture, round(target.crop * min(picture.shape[:2])))


def picture(
    target: PictureConfig, cells: tuple[int, int] | None = None, channels: int = 0
) -> np.ndarray:
    """A target on cells, radiance 0 to 1: (y, x), or with so many channels (y, x, channel).

    Without cells, on its own pixels.

    **Errors**: ValueError for a uniform picture, FileNotFoundError where there is none.
    """
    picture = np.atleast_3d(cropped(target))
    picture = picture if channels else picture.mean(axis=-1)
    picture = drawn.resize(picture, cells or (picture.shape[0], picture.shape[1]))
    if channels:
        picture = np.broadcast_to(picture, (*picture.shape[:2], channels))
    if target.binary:
        picture = (picture > picture.mean()).astype(float)
    picture = placed(picture, target.width, (target.y, target.x), target.rotation)
    if picture.min() == picture.max():
        raise ValueError("the image is uniform: there is nothing to reconstruct; give another one")
    return picture


def check_optics(study: Study) -> None:
    """Refuse cameras that cannot be built. **Errors**: ConfigError, one line."""
    try:
        check_cameras(study)
    except (ValueError, TypeError, FileNotFoundError, MemoryError) as error:
        if isinstance(error, MemoryError) or getattr(error, "field", "") == "sensor.shape":
            place = study.config.place_of("sensor", "shape")
            raise ConfigError(f"{place}sensor.shape: {error}") from None
        raise ConfigError(f"mask, sensor or model: {error}") from None


def psfs(asked: Any, setup: Any) -> Iterator[str]:
    """PSFs of a study."""
    study = assemble(asked) if setup is None else getattr(setup, "study", setup)
    cameras = [(study.camera(e), e, study.mask_of(e)) for e in study.exposures]
    return psf_costs(asked, cameras, study.object_distance)


def psf_costs(asked: Any, cameras: list[Any], object_distance: float) -> Iterator[str]:
    """A line for each PSF of (camera, exposure, words): model, predicted error, memory, work."""
    how = {"model": asked.model, "pixel_integration": asked.pixel_integration}
    alike = {
        (e.beta, e.distance, e.wavelength, e.width): one for one in cameras[::-1] for e in one[1:2]
    }
    for camera, exposure, words in [*alike.values()][::-1]:
        seen = {"wavelength": exposure.wavelength, "object_distance": object_distance}
        cost, error = predict_cost(camera, **seen, **how)
        predicted = "" if error is None else f", predicted error {error:.1g}"
        yield (
            f"PSF at {exposure.distance:g} mm of {words}: {asked.model}{predicted}, "
            f"{readable(cost.bytes)}, {cost.flops / 1e9:.2g} billion operations"
        )
