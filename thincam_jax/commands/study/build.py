"""From an experiment file to a study: cameras, exposures, noise, targets and methods."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, get_args

import numpy as np

from thincam_jax import reconstruction
from thincam_jax._core import checks
from thincam_jax.commands.config_file import ConfigError
from thincam_jax.commands.sections import (
    CamerasConfig,
    MaskConfig,
    MethodConfig,
    NoiseConfig,
    Relief,
    SensorConfig,
    TargetConfig,
    VariationConfig,
)
from thincam_jax.commands.study.config import PictureConfig, StudyConfig
from thincam_jax.imaging import targets as drawn
from thincam_jax.imaging.sensor import AbstractNoise, Sensor
from thincam_jax.lensless import masks
from thincam_jax.lensless.exposures import Exposure, Exposures
from thincam_jax.lensless.propagation.path import Path
from thincam_jax.reconstruction.solver import AbstractSolver
from thincam_jax.reconstruction.wiener import Prior
from thincam_jax.studies.evaluate import check_cameras, check_target
from thincam_jax.studies.study import Method, Published, Study, Target


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


def built_mask(config: MaskConfig, exposure: Exposure) -> masks.AbstractMask:
    """The mask of an exposure but for a profile of its own, on its display.

    **Errors**: ValueError for numbers that make none.
    """
    if config.family == "fza":
        return masks.FresnelZoneAperture(
            exposure.beta,
            exposure.phase,
            width=exposure.width,
            height=config.height,
            profile=config.profile,
            pixel_pitch=config.pixel_pitch,
            fill_factor=config.fill_factor,
            harmonics=config.harmonics,
        )
    printed = _printed(config, exposure)
    if config.pixel_pitch is None:
        return printed
    return masks.on_display(printed, config.pixel_pitch, config.fill_factor)


def _printed(config: MaskConfig, exposure: Exposure) -> masks.AbstractMask:
    """Of the families without zones."""
    cell, tiles, height = config.cell or 0.0, config.tiles or 1, config.height
    family = config.family
    if family == "mura":
        return masks.ModifiedUniformlyRedundantArray(config.order or 0, cell, tiles=tiles)
    if family == "ura":
        return masks.UniformlyRedundantArray(config.orders or (0, 0), cell, tiles=tiles)
    if family == "mls":
        code = masks.maximum_length_sequence(config.length or 0)
        return masks.SeparableMask(code, code, cell, combine=config.combine)
    if family == "random":
        return masks.random_cells(config.seed or 0, config.width, cell, height=height)
    if family == "pinhole":
        return masks.Pinhole(config.width, height)
    if family == "lenslets":
        return masks.LensletArray(config.focal_length or 0.0, cell, config.lenses or (1, 1))
    if family in get_args(Relief):
        return _relief(config, exposure.wavelength, exposure.distance)
    amplitude = masks.read_mask(config.path or "", 1.0).amplitude
    return masks.SampledMask(amplitude, config.width / amplitude.shape[1])


def _relief(config: MaskConfig, wavelength: float, distance: float) -> masks.PhaseMask:
    """A phase mask for objects far away."""
    cell, seed = config.cell or 0.0, config.seed or 0
    count = checks.whole_cells("width", config.width, "cell", cell)
    blank = masks.MaskBlank((count, count), cell, config.index)
    if config.family == "diffuser":
        length, slope = config.correlation_length or 0.0, config.rms_slope or 0.0
        return masks.diffuser(seed, blank, correlation_length=length, rms_slope=slope)
    if config.family == "voronoi_fresnel":
        lens = {"focal_length": config.focal_length or 0.0, "wavelength": wavelength}
        return masks.voronoi_fresnel(seed, blank, sites=config.sites or 0, **lens)
    from thincam_jax.design import contour_mask  # slow, and not needed by other masks

    lines = {"feature": config.feature or 0.0, "line_width": config.line_width or 0.0}
    return contour_mask(seed, blank, Path(wavelength, distance), **lines)


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
    try:
        check_cameras(study)
    except (ValueError, TypeError, FileNotFoundError, MemoryError) as error:
        if isinstance(error, MemoryError) or getattr(error, "field", "") == "sensor.shape":
            return f"{study.config.place_of('sensor', 'shape')}sensor.shape: {error}"
        return f"mask, sensor or model: {error}"
    return ""


def _target_fault(study: Study, target: Target) -> str:
    """Empty for none."""
    try:
        check_target(study, target)
    except ValueError as error:
        return str(error)
    return ""
