"""From a study's configuration to cameras, scenes and reconstructions."""

import functools
import math
from collections.abc import Callable
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Array

from thincam_jax.commands.study.config import (
    MethodConfig,
    StudyConfig,
    TargetConfig,
    VariationConfig,
)
from thincam_jax.imaging.scene import ImagePlane, Scene
from thincam_jax.imaging.sensor import (
    AbstractNoise,
    GaussianNoise,
    PoissonGaussianNoise,
    Sensor,
    electrons_per_unit,
    read_out,
)
from thincam_jax.imaging.targets import (
    load_image,
    point_grid,
    sample_image,
    siemens_star,
    slanted_edge,
    usaf1951,
)
from thincam_jax.lensless.camera import LenslessCamera
from thincam_jax.lensless.capture import capture
from thincam_jax.lensless.masks.fza import FresnelZoneAperture
from thincam_jax.reconstruction import (
    AdmmTV,
    Cameras,
    FringeScanning,
    Reconstruction,
    Recording,
    TotalVariation,
    Wiener,
    reconstruct,
)
from thincam_jax.reconstruction import synthesis as syntheses

_DRAWN: dict[str, Callable] = {
    "usaf1951": usaf1951,
    "slanted_edge": slanted_edge,
    "siemens_star": siemens_star,
    "point_grid": functools.partial(point_grid, count=(9, 9)),
}


class Setting(NamedTuple):
    """One exposure: what a capture is identified by."""

    beta: float
    phase: float
    distance: float
    wavelength: float
    width: float
    exposure: float


def settings(config: StudyConfig, method: MethodConfig) -> list[Setting]:
    """The exposures of a method, in the order of its synthesis."""
    return [
        Setting(
            shot.beta,
            phase,
            shot.distance,
            shot.wavelength or config.wavelength,
            shot.width or config.mask.width,
            shot.exposure,
        )
        for shot in method.shots
        for phase in method.shot_phases()
    ]


def all_settings(config: StudyConfig) -> list[Setting]:
    """Every exposure of the study once, in order of first use."""
    return list(dict.fromkeys(s for m in config.methods for s in settings(config, m)))


def build_camera(config: StudyConfig, setting: Setting) -> LenslessCamera:
    mask = FresnelZoneAperture(
        setting.beta,
        setting.phase,
        width=setting.width,
        profile=config.mask.profile,
        harmonics=config.mask.harmonics,
        pixel_pitch=config.mask.pixel_pitch,
        fill_factor=config.mask.fill_factor,
    )
    sensor = Sensor(
        config.sensor.shape,
        config.sensor.pitch,
        full_well=config.sensor.full_well,
        exposure=_times(config.sensor.exposure, setting.exposure),
        electrons=_times(config.sensor.electrons, setting.exposure),
        bit_depth=config.sensor.bit_depth,
    )
    return LenslessCamera(mask, sensor, setting.distance)


def _times(level: float | None, share: float) -> float | None:
    return None if level is None else level * share


def build_noise(config: StudyConfig) -> AbstractNoise | None:
    if config.noise is None:
        return None
    if config.noise.read_noise is not None:
        return PoissonGaussianNoise(config.noise.read_noise)
    assert config.noise.snr_db is not None  # one of the two is given
    return GaussianNoise(config.noise.snr_db, config.noise.signal_power)


def build_plane(config: StudyConfig, target: TargetConfig) -> ImagePlane:
    """The target in front of the camera, with its colour channels as a batch: (channel, y, x)."""
    if target.kind in _DRAWN:
        image = _DRAWN[target.kind]((target.pixels, target.pixels))
    elif target.kind == "photograph":
        image = sample_image(target.image or "")
    else:
        image = load_image(target.path or "")
    image = np.moveaxis(np.atleast_3d(image), -1, 0)
    return ImagePlane(image.astype(np.float32), config.object.distance, config.object.width)


class Exposure(NamedTuple):
    """A capture (channel, y, x) and the variance of each channel's noise (channel,)."""

    image: np.ndarray
    variance: np.ndarray


def take(config: StudyConfig, setting: Setting, plane: ImagePlane, key: Array) -> Exposure:
    """One capture of a target; its noise is that of the noise-free image."""
    camera = build_camera(config, setting)
    return expose(config, camera, imaging(config, camera, setting, plane), key)


def expose(config: StudyConfig, camera: LenslessCamera, clean: Array, key: Array) -> Exposure:
    """What the sensor reads out of a noise-free image (channel, y, x)."""
    noise = build_noise(config)
    if noise is None:
        variance = np.zeros(clean.shape[0], clean.dtype)
    else:
        variance = np.asarray(noise.variance(clean, electrons_per_unit(camera.sensor, clean)))
    return Exposure(np.asarray(read_out(camera.sensor, clean, noise=noise, key=key)), variance)


def imaging(
    config: StudyConfig, camera: LenslessCamera, setting: Setting, plane: ImagePlane
) -> Array:
    """What falls on the sensor, (channel, y, x)."""
    ideal = LenslessCamera(
        camera.mask, Sensor(config.sensor.shape, config.sensor.pitch), camera.distance
    )
    return capture(
        ideal,
        Scene(plane, setting.wavelength),
        model=config.model,
        pixel_integration=config.pixel_integration,
    )


def capture_key(config: StudyConfig, target: int, exposure: int) -> Array:
    """The random key of one capture: the same however the study is interrupted."""
    return jax.random.fold_in(jax.random.fold_in(jax.random.key(config.seed), target), exposure)


def synthesis_matrix(method: MethodConfig) -> np.ndarray:
    shots = len(method.shots)
    if method.synthesis == "fringe_scanning":
        return syntheses.fringe_scanning(shots)
    if method.synthesis == "phase_pairs":
        return syntheses.phase_pairs(shots)
    if method.synthesis == "contrasts":
        return syntheses.contrasts(shots * len(method.phases))
    return syntheses.separate(shots * len(method.phases))


def reference_distance(method: MethodConfig) -> float:
    """The largest mask-sensor distance, on whose scale a method reconstructs, mm."""
    return max(shot.distance for shot in method.shots)


def field_shape(config: StudyConfig, method: MethodConfig, plane: ImagePlane) -> tuple[int, int]:
    """Pixels of the reconstruction: what covers the target at the object pitch."""
    scale = reference_distance(method) / config.object.distance / config.sensor.pitch
    rows, columns = (
        max(1, math.ceil(float(size) * scale - 1e-3)) for size in (plane.height, plane.width)
    )
    return rows, columns


def build_reconstructor(
    config: StudyConfig, method: MethodConfig, shape: tuple[int, int]
) -> Callable[[Array, Array], Reconstruction]:
    """A function of the captures (capture, channel, y, x) and variances (capture, channel)."""
    used = settings(config, method)
    cameras = Cameras(
        [build_camera(config, s) for s in used],
        wavelength=[s.wavelength for s in used],
        object_distance=config.object.distance,
        field_shape=shape,
        model=config.model,
        pixel_integration=config.pixel_integration,
    )
    if method.kind == "fringe_scanning":
        scanning = FringeScanning().prepare(cameras)
        return lambda captures, variances: scanning(captures)
    if method.kind == "admm_tv":
        return functools.partial(_admm_tv, config, method, cameras)
    return Wiener(synthesis=synthesis_matrix(method), prior=config.prior).prepare(cameras)


def _admm_tv(
    config: StudyConfig, method: MethodConfig, cameras: Cameras, captures: Array, variances: Array
) -> Reconstruction:
    """Total variation on the crop model; without noise in the study it is estimated."""
    recording = Recording(
        captures, cameras, noise_variance=None if config.noise is None else variances
    )
    options = method.variation or VariationConfig()
    variation = TotalVariation(
        options.kind,
        options.coupling_of(captures.shape[1]),
        chroma_weight=options.chroma_weight,
    )
    solver = AdmmTV(
        options.tau,
        variation=variation,
        synthesis=synthesis_matrix(method),
        iterations=options.iterations,
    )
    return reconstruct(recording, solver)
