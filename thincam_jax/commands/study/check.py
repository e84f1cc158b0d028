"""What a study's file alone cannot tell, found before the first capture."""

import jax

from thincam_jax.commands.study.build import all_settings, build_camera, build_plane, field_shape
from thincam_jax.commands.study.config import ConfigError, StudyConfig, TargetConfig
from thincam_jax.imaging.metrics.image import SSIM_WINDOW
from thincam_jax.imaging.metrics.mtf import MINIMUM_COLUMNS
from thincam_jax.lensless.psf import psf

# The scene's power is read off frequencies above three cycles a sensor (`spectra.inner_band`).
_MINIMUM_ROWS = 7


def check_study(config: StudyConfig) -> None:
    """Refuse cameras that cannot be built, images that cannot be read, and too few pixels.

    **Errors**: ConfigError, one line for each fault, beginning with the field.
    """
    faults = _camera_faults(config)
    for index, target in enumerate(config.targets):
        faults += [f"targets[{index}]: {fault}" for fault in _target_faults(config, target)]
    if faults:
        raise ConfigError("\n".join(faults))


def _camera_faults(config: StudyConfig) -> list[str]:
    rows, columns = config.sensor.shape
    if rows < _MINIMUM_ROWS or columns < MINIMUM_COLUMNS:
        return [
            f"sensor.shape: {rows}×{columns} pixels are too few for a study; "
            f"give at least {_MINIMUM_ROWS}×{MINIMUM_COLUMNS}"
        ]
    try:
        cameras = [build_camera(config, setting) for setting in all_settings(config)]
        # Traced only: whether the model takes this mask at all.
        jax.eval_shape(
            lambda: psf(
                cameras[0],
                wavelength=config.wavelength,
                object_distance=config.object.distance,
                model=config.model,
                pixel_integration=config.pixel_integration,
            )
        )
    except (ValueError, TypeError) as error:
        return [f"mask, sensor or model: {error}"]
    return []


def _target_faults(config: StudyConfig, target: TargetConfig) -> list[str]:
    try:
        plane = build_plane(config, target)
    except (ValueError, FileNotFoundError) as error:
        return [str(error)]
    if plane.image.min() == plane.image.max():
        return ["the image is uniform: there is nothing to reconstruct; give another one"]
    for method in config.methods:
        shape = field_shape(config, method, plane)
        if min(shape) < SSIM_WINDOW:
            return [
                f"{method.name!r} reconstructs it on {shape[0]}×{shape[1]} pixels, at least "
                f"{SSIM_WINDOW}×{SSIM_WINDOW} are needed; give a larger object.width or a "
                "smaller sensor.pitch"
            ]
    return []
