"""From an experiment file to a see-through camera, its targets, and the models of it."""

from dataclasses import dataclass
from typing import Any

import jax.numpy as jnp
import numpy as np

from thincam_jax import waveguide as wg
from thincam_jax.commands.config_file import ConfigError
from thincam_jax.commands.screen.config import (
    RectangleConfig,
    ScreenConfig,
    ScreenMethodConfig,
    SeeThroughConfig,
)
from thincam_jax.commands.sections import VariationConfig
from thincam_jax.commands.study.build import build_noise, picture
from thincam_jax.reconstruction import AbstractSolver, AdmmTV, Ridge, TotalVariation
from thincam_jax.studies.screen import ScreenStudy


@dataclass(frozen=True, eq=False)
class FileScreen(ScreenStudy):
    """A study with the file that it was read from."""

    config: Any = None


def build_screen(config: ScreenConfig) -> FileScreen:
    """The study of a file, everything checked and images read.

    **Errors**: ConfigError, one line for each fault, beginning with its place.
    """
    targets, faults = {}, []
    channels = len(config.hologram.colours or ())
    for number, target in enumerate(config.targets):
        try:
            targets[target.name] = picture(target, config.object.cells, channels)
        except (ValueError, FileNotFoundError) as error:
            place = config.place_of("targets", number, "path")
            faults.append(f"{place}targets[{number}]: {error}")
    noise = build_noise(config.noise)
    assert noise is not None  # the section is needed
    study = FileScreen(
        build_cameras(config),
        build_plane(config),
        targets,
        noise,
        {method.name: build_solver(method) for method in config.methods},
        tuple(model.build(name=model.name) for model in config.models),
        config.orders,
        config.band_samples,
        (config.hologram.object_angle, config.hologram.reference_angle),
        config.seed,
        config.name,
        config,
    )
    try:
        study.check()
    except ValueError as error:
        faults.append(f"{config.place_of('screen')}screen: {error}")
    if faults:
        raise ConfigError("\n".join(faults))
    return study


def build_plane(config: SeeThroughConfig) -> wg.ObjectPlane:
    """The cells before the camera."""
    seen = config.object
    return wg.ObjectPlane(seen.cells, seen.distance, seen.width, jnp.asarray([seen.x, seen.y]))


def build_cameras(config: SeeThroughConfig) -> tuple[wg.SeeThroughCamera, ...]:
    """The camera of each colour."""
    return tuple(_camera(config, wavelength) for wavelength in config.hologram.recorded)


def _camera(config: SeeThroughConfig, wavelength: float) -> wg.SeeThroughCamera:
    film, plate = config.hologram, config.screen
    hologram = film.build(wavelength=wavelength).processed(film.shrinkage)
    screen = wg.Screen(
        hologram,
        plate.glass_thickness,
        plate.glass_index,
        _rectangle(plate.top),
        _rectangle(plate.bottom),
    )
    lens = config.lens
    sensor = config.sensor.build()
    distances = lens.focal_distance, lens.lens_distance
    return wg.SeeThroughCamera(screen, sensor, *distances, tilt=np.asarray(plate.tilt))


def _rectangle(part: RectangleConfig | None) -> wg.Rectangle | None:
    if part is None:
        return None
    return wg.Rectangle(jnp.asarray([part.x, part.y]), jnp.asarray([part.width, part.height]))


def build_solver(method: ScreenMethodConfig) -> AbstractSolver:
    """The solver of a method of a file."""
    if method.kind == "ridge":
        return Ridge(method.ridge or 1.0)
    options = method.variation or VariationConfig()
    variation = TotalVariation(options.kind)
    return AdmmTV(options.tau, variation=variation, iterations=options.iterations)
