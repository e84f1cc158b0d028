"""A camera known by its numbers, and its PSF."""

from collections.abc import Sequence
from pathlib import Path

import equinox as eqx
import numpy as np

from thincam_jax.commands.config_file import ConfigError
from thincam_jax.commands.kinds import KINDS, load_experiment, read_kind
from thincam_jax.commands.study.build import assemble, check_study
from thincam_jax.commands.study.config import StudyConfig
from thincam_jax.lensless.psf import psf
from thincam_jax.measured import Raw
from thincam_jax.reconstruction import Cameras


def read_camera(config: Path, overrides: Sequence[str], distance: float | None) -> Cameras:
    """The camera of a study's first shot, or of a file of kind learned, and its object's distance.

    `distance`: in place of that of a study's object, mm.

    **Errors**: ConfigError, as of `load_experiment`, and for a file of another kind or without
    a distance.
    """
    if read_kind(config) is KINDS["learned"]:
        # Here: other captures need not wait for the learned parts.
        from thincam_jax.commands.learned.build import build_camera

        whole = build_camera(load_experiment(config, tuple(overrides), "train"))
        if distance is None:
            raise ConfigError(f"{config}: tells no object's distance; give a --distance")
        light = {"wavelength": float(whole.light.wavelengths[0]), "model": whole.model}
        return Cameras([whole.camera], object_distance=distance, **light)
    experiment = load_experiment(config, tuple(overrides))
    if not isinstance(experiment, StudyConfig):
        raise ConfigError(f"{config}: is of kind {experiment.kind}; a camera is read from a study")
    study = assemble(experiment, ())
    check_study(study)
    shot = study.exposures[0]
    return Cameras(
        [study.camera(shot)],
        wavelength=shot.wavelength,
        object_distance=study.object_distance if distance is None else distance,
        model=study.model,
        pixel_integration=experiment.pixel_integration,
    )


def computed_psf(config: Path, cameras: Cameras) -> Raw:
    """The PSF of the camera of a file."""
    (camera,), wavelength, distance = cameras.cameras, cameras.wavelength, cameras.object_distance
    how = {"model": cameras.model, "pixel_integration": cameras.pixel_integration}
    image = psf(camera, wavelength=wavelength, object_distance=distance, **how)
    numbers = eqx.tree_pformat(camera, width=10_000)  # in one line
    light = f"wavelength {wavelength * 1e6:g} nm, object at {distance:g} mm"
    name = f"camera of {config}: {numbers}, {light}"
    return Raw(np.asarray(image), name=name)
