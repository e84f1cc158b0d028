"""From an experiment file to a camera with two holograms, its targets, and models of it."""

import math
from dataclasses import dataclass, replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from thincam_jax import waveguide as wg
from thincam_jax.commands.config_file import ConfigError
from thincam_jax.commands.screen.config import (
    Mistake,
    ModelConfig,
    RectangleConfig,
    ScreenConfig,
    ScreenMethodConfig,
    SeeThroughConfig,
)
from thincam_jax.commands.sections import VariationConfig
from thincam_jax.commands.study.build import build_noise, picture
from thincam_jax.imaging.operators import AbstractOperator, Sparse
from thincam_jax.imaging.sensor import Sensor, electrons_per_unit, read_out
from thincam_jax.reconstruction import (
    AdmmTV,
    Reconstruction,
    Recording,
    Ridge,
    TotalVariation,
    reconstruct,
)
from thincam_jax.waveguide.efficiency import directions
from thincam_jax.waveguide.rays import bragg_rays
from thincam_jax.waveguide.system import (
    colour_operator,
    seen_size,
    smeared_rays,
    system_matrix,
)

# Wrong models, and what is wrong with them.
MISTAKES = {
    "none": "as the camera is",
    "grating": "K as printed in thesis Eq 5.4, with cos Θ_O − cos Θ_R: a transmission hologram",
    "ghost_index": "i of thesis Eq 5.9 counted from 0, as its text has it",
    "shift_invariant": "the ghosts of the axis everywhere: a convolution",
    "no_ghosts": "the first image alone",
    "no_smear": "each pixel's Bragg wavelength alone, without the band about it",
}


@dataclass(frozen=True)
class Setup:
    """What is simulated: the camera of each colour, the monitor before it, and what it shows.

    - `targets`: by name, radiance 0 to 1 on the cells of the monitor, (y, x) or (y, x, channel).
    """

    config: ScreenConfig
    cameras: tuple[wg.SeeThroughCamera, ...]
    plane: wg.ObjectPlane
    targets: dict[str, np.ndarray]

    @property
    def camera(self) -> wg.SeeThroughCamera:
        """Of the middle colour, green."""
        return self.cameras[len(self.cameras) // 2]

    def rays(self, camera: wg.SeeThroughCamera | None = None) -> wg.Rays:
        """Of every pixel and order; by default of `camera`."""
        camera = camera or self.camera
        pixels = wg.pixel_centres(camera)
        return wg.trace(camera, pixels, self.plane.distance, self.config.orders)

    @property
    def wavelengths(self) -> np.ndarray:
        """Of each pixel's image, mm, (y, x) or (channel, y, x)."""
        found = np.stack([np.asarray(self.rays(camera).wavelength) for camera in self.cameras])
        return found if self.config.hologram.colours else found[0]


def build_setup(config: ScreenConfig) -> Setup:
    """Everything checked, images read.

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
    cameras = build_cameras(config)
    setup = Setup(config, cameras, build_plane(config), targets)
    try:
        for camera in cameras:
            wg.check_screen(camera)
    except ValueError as error:
        raise ConfigError(
            "\n".join([*faults, f"{config.place_of('screen')}screen: {error}"])
        ) from None
    status = np.asarray(setup.rays().status)
    if not (status == wg.RayStatus.OK).any():
        most = wg.RayStatus(int(np.bincount(status.ravel()).argmax())).name.lower()
        faults.append(
            f"{config.place_of('screen')}screen: no ray from the sensor reaches the object's plane "
            f"(most: {most.replace('_', ' ')}); see docs/screen.md for what a status means"
        )
    if faults:
        raise ConfigError("\n".join(faults))
    return setup


def build_plane(config: SeeThroughConfig) -> wg.ObjectPlane:
    """The cells before the camera."""
    seen = config.object
    return wg.ObjectPlane(seen.cells, seen.distance, seen.width, jnp.asarray([seen.x, seen.y]))


def build_cameras(
    config: SeeThroughConfig, glass_thickness: float | None = None
) -> tuple[wg.SeeThroughCamera, ...]:
    """The camera of each colour, or those with another glass, mm."""
    return tuple(
        _camera(config, wavelength, glass_thickness or config.screen.glass_thickness)
        for wavelength in config.hologram.recorded
    )


def _camera(config: SeeThroughConfig, wavelength: float, thickness: float) -> wg.SeeThroughCamera:
    film, plate = config.hologram, config.screen
    hologram = wg.VolumeHologram.record(
        wavelength,
        film.object_angle,
        film.reference_angle,
        index=film.index,
        thickness=film.thickness,
        index_modulation=film.index_modulation,
    ).processed(film.shrinkage)
    screen = wg.Screen(
        hologram,
        thickness,
        plate.glass_index,
        _rectangle(plate.top),
        _rectangle(plate.bottom),
    )
    lens = config.lens
    sensor = Sensor(**dict(config.sensor))
    distances = lens.focal_distance, lens.lens_distance
    return wg.SeeThroughCamera(screen, sensor, *distances, tilt=np.asarray(plate.tilt))


def _rectangle(part: RectangleConfig | None) -> wg.Rectangle | None:
    if part is None:
        return None
    return wg.Rectangle(jnp.asarray([part.x, part.y]), jnp.asarray([part.width, part.height]))


def build_models(setup: Setup) -> list[Sparse]:
    """What reconstructions take the camera for; the first one takes the captures, too.

    All have as many entries as the largest, the others in no pixel, for one compiled program.
    """
    models = [build_model(setup, model) for model in setup.config.models]
    most = max(model.values.size for model in models)
    outside = math.prod(models[0].out_shape), math.prod(models[0].in_shape)

    def padded(model: Sparse) -> Sparse:
        entries = model.values, model.rows, model.columns
        longer = [
            jnp.pad(entry, (0, most - entry.size), constant_values=value)
            for entry, value in zip(entries, (0, *outside), strict=True)
        ]
        return eqx.tree_at(lambda m: (m.values, m.rows, m.columns), model, longer)

    return [padded(model) for model in models]


def build_model(setup: Setup, model: ModelConfig) -> Sparse:
    """One of them alone."""
    cameras = setup.cameras
    if model.glass_thickness is not None:
        cameras = build_cameras(setup.config, model.glass_thickness)
    channels = [_model(setup, camera, model.mistake) for camera in cameras]
    return colour_operator(channels) if setup.config.hologram.colours else channels[0]


def _model(setup: Setup, camera: wg.SeeThroughCamera, mistake: Mistake) -> Sparse:
    plane = setup.plane
    rays = mistaken_rays(setup, camera, mistake)
    level = float(jnp.mean(jnp.sum(rays.weight, axis=0)))
    matrix = system_matrix(rays, plane, float(seen_size(camera, plane)), level)
    return Sparse(matrix, plane.shape, camera.sensor.shape)


def mistaken_rays(setup: Setup, camera: wg.SeeThroughCamera, mistake: Mistake) -> wg.SmearedRays:
    """The rays of a camera, followed with one of `MISTAKES`."""
    config, plane, pixels = setup.config, setup.plane, wg.pixel_centres(camera)
    samples = None if mistake == "no_smear" else config.band_samples
    rays = smeared_rays(camera, pixels, plane, config.orders, samples)
    if mistake == "no_ghosts":
        return wg.SmearedRays(rays.points[:1], rays.weight[:1])
    if mistake == "shift_invariant":
        middle = jnp.zeros((1, 1, 2), pixels.dtype)
        axis = smeared_rays(camera, middle, plane, config.orders, samples)
        scale = (camera.lens_distance + plane.distance) / camera.focal_distance
        points = axis.points - scale * pixels[..., None, :]
        return wg.SmearedRays(points, jnp.broadcast_to(axis.weight, rays.weight.shape))
    if mistake not in ("ghost_index", "grating"):
        return rays
    found = bragg_rays(camera, pixels)
    width, index = camera.screen.glass_thickness, camera.screen.glass_index(found.wavelength)
    bounce = _bounce(found.guided, index)
    if mistake == "ghost_index":
        return replace(rays, points=rays.points - 2 * width * bounce[..., None, :])
    hologram, angles = camera.screen.hologram, config.hologram
    film = hologram.index(found.wavelength)
    toward, reference = math.cos(angles.object_angle), math.cos(angles.reference_angle)
    along = hologram.grating.at[2].multiply((toward - reference) / (toward + reference))
    printed = eqx.tree_at(lambda h: h.grating, hologram, along)
    guided = film[..., None] * printed.diffracted(directions(found.across, film))[..., :2]
    odd = (2 * jnp.arange(config.orders, dtype=pixels.dtype) + 1)[:, None, None, None]
    moved = odd * width * (_bounce(guided, index) - bounce)
    return replace(rays, points=rays.points + moved[..., None, :])


def _bounce(guided: Array, index: Array) -> Array:
    """How far guided light goes in a glass of thickness 1."""
    left = index**2 - jnp.sum(guided**2, axis=-1)
    return guided / jnp.sqrt(jnp.maximum(left, 1e-6))[..., None]


class Captured(eqx.Module):
    """Captures (target, y, x), or (target, channel, y, x), or what is left of them, and the
    variance of their noise."""

    images: Array
    variance: Array


def capture(setup: Setup, system: Sparse) -> Captured:
    """Every target as the sensor reads it; each has noise of its own key."""
    images = np.stack(list(setup.targets.values()))
    images = np.moveaxis(images, -1, 1) if images.ndim == 4 else images
    images = jnp.asarray(images.reshape(-1, *system.in_shape), system.values.dtype)
    clean, sensor = system(images), setup.camera.sensor
    noise = build_noise(setup.config.noise)
    assert noise is not None  # the section is needed
    keys = [jax.random.fold_in(jax.random.key(setup.config.seed), n) for n in range(len(images))]
    read = [
        read_out(sensor, one, noise=noise, key=key) for one, key in zip(clean, keys, strict=True)
    ]
    return Captured(jnp.stack(read), noise.variance(clean, electrons_per_unit(sensor, clean)))


def undo(model: AbstractOperator, method: ScreenMethodConfig, captured: Captured) -> Reconstruction:
    """All targets at once, (target, y, x) or (target, channel, y, x)."""
    options = method.variation or VariationConfig()
    solver = Ridge(method.ridge or 1.0)
    if method.kind == "admm_tv":
        variation = TotalVariation(options.kind)
        solver = AdmmTV(options.tau, variation=variation, iterations=options.iterations)
    variance = captured.variance[None]
    return reconstruct(Recording(captured.images[None], [model], noise_variance=variance), solver)
