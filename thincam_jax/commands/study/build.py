"""From an experiment file to what is simulated: cameras, exposures, noise, targets and methods."""

import functools
import itertools
import math
import operator
from collections.abc import Sequence
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from thincam_jax import reconstruction
from thincam_jax.commands.config_file import ConfigError
from thincam_jax.commands.sections import (
    CamerasConfig,
    MethodConfig,
    NoiseConfig,
    TargetConfig,
    VariationConfig,
)
from thincam_jax.commands.study.config import PictureConfig, StudyConfig
from thincam_jax.commands.study.study import Capture, Exposure, Method, Reconstructor, Study, Target
from thincam_jax.imaging import targets as drawn
from thincam_jax.imaging.metrics.image import SSIM_WINDOW
from thincam_jax.imaging.metrics.mtf import MINIMUM_COLUMNS
from thincam_jax.imaging.scene import ImagePlane, Scene
from thincam_jax.imaging.sensor import (
    AbstractNoise,
    GaussianNoise,
    PoissonGaussianNoise,
    electrons_per_unit,
    read_out,
)
from thincam_jax.lensless import forward

# The scene's power is read off frequencies above three cycles a sensor (`spectra.inner_band`).
_MINIMUM_ROWS = 7


def build_study(config: StudyConfig) -> Study:
    """All that a study needs, images read and everything checked, before the first capture.

    **Errors**: ConfigError, one line for each fault, beginning with the field.
    """
    targets, unread = read_targets(config.targets, config.object.distance, config.object.width)
    study = assemble(config, targets)
    check_study(study, unread)
    return study


def assemble(config: CamerasConfig, targets: Sequence[Target]) -> Study:
    """Cameras, noise and methods of a file, before targets."""
    return Study(
        config,
        config.sensor,
        config.mask,
        build_noise(config.noise),
        tuple(as_method(config, method) for method in config.methods),
        tuple(targets),
        config.model,
        config.prior,
    )


def as_method(config: CamerasConfig, method: MethodConfig) -> Method:
    """A method of a file, with all of its exposures."""
    phases = method.shot_phases()
    exposures = tuple(
        Exposure(
            shot.beta or 0.0,  # of a mask without zones
            phase,
            shot.distance,
            shot.wavelength or config.wavelength,
            shot.width or config.mask.width,
            shot.exposure,
            shot.take or 1,
            shot.profile,
        )
        for shot in method.shots
        for phase in phases
    )
    if config.motion:
        ends = np.cumsum([0.0, *(exposure.share for exposure in exposures)])
        ends = config.motion * (ends - ends[-1] / 2)
        ways = itertools.pairwise(ends.tolist())
        exposures = tuple(replace(e, moves=w) for e, w in zip(exposures, ways, strict=True))
    return Method(
        method.name,
        method.kind,
        method.synthesis,
        exposures,
        len(phases),
        method.variation,
        method.harmonics,
    )


def build_noise(noise: NoiseConfig | None) -> AbstractNoise | None:
    if noise is None:
        return None
    if noise.read_noise is not None:
        return PoissonGaussianNoise(noise.read_noise)
    assert noise.snr_db is not None  # one of the two is given
    return GaussianNoise(noise.snr_db, noise.signal_power)


def read_targets(
    entries: Sequence[TargetConfig], distance: float, width: float
) -> tuple[list[Target], dict[int, str]]:
    """The targets at one distance, and by its place why another cannot be read."""
    targets, unread = [], {}
    for number, entry in enumerate(entries):
        try:
            image = np.moveaxis(np.atleast_3d(read_picture(entry)), -1, 0)
        except (ValueError, FileNotFoundError) as error:
            unread[number] = str(error)
            continue
        plane = ImagePlane(image.astype(np.float32), distance, width)
        targets.append(Target(number, entry.name, entry.kind, distance, width, plane))
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


def check_study(study: Study, unread: dict[int, str] | None = None) -> None:
    """Refuse cameras that cannot be built, images that cannot be read, and too few pixels.

    `unread`: why images could not be read, by the target's place.

    **Errors**: ConfigError, one line for each fault, beginning with the field.
    """
    known = {target.number: _target_fault(study, target) for target in study.targets}
    known |= unread or {}
    place_of = study.config.place_of
    faults = [
        f"{place_of('targets', number, 'path')}targets[{number}]: {fault}"
        for number, fault in sorted(known.items())
        if fault
    ]
    camera = _camera_fault(study)
    if camera or faults:
        raise ConfigError("\n".join([*filter(None, [camera]), *faults]))


def _camera_fault(study: Study) -> str:
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


def field_shape(study: Study, method: Method, target: Target) -> tuple[int, int]:
    """Pixels of the reconstruction: what covers the target at the object pitch."""
    scale = method.distance / target.distance / study.sensor.pitch
    rows, columns = (
        max(1, math.ceil(float(size) * scale - 1e-3))
        for size in (target.plane.height, target.plane.width)
    )
    return rows, columns


def noise_free(study: Study, exposure: Exposure, planes: ImagePlane | list[ImagePlane]) -> Array:
    """What falls on the sensor, (*channel, y, x): without saturation."""
    scene = Scene(planes, exposure.wavelength)
    images = (
        forward.expose(
            study.camera(exposure),
            plane,
            scene.spectrum,
            model=study.model,
            pixel_integration=study.config.pixel_integration,
        )
        for plane in scene.planes
    )
    return functools.reduce(operator.add, images)


def expose(study: Study, exposure: Exposure, clean: Array, number: int, trial: int = 0) -> Capture:
    """What is read out of a noise-free image of the target of a place in the study.

    The noise is that of the image; its random key is the same however a study is interrupted, and
    another one for each further trial.
    """
    seed = jax.random.key((study.config.seed + trial) % 2**32)
    place = study.exposures.index(exposure)
    key = jax.random.fold_in(jax.random.fold_in(seed, number), place)
    sensor, noise = study.camera(exposure).sensor, study.noise
    if noise is None:
        variance = np.zeros(clean.shape[:-2], clean.dtype)
    else:
        variance = np.asarray(noise.variance(clean, electrons_per_unit(sensor, clean)))
    return Capture(np.asarray(read_out(sensor, clean, noise=noise, key=key)), variance)


def take(study: Study, exposure: Exposure, target: Target) -> Capture:
    """One capture of a target, which may move meanwhile."""
    plane = ImagePlane(target.plane.image, target.distance, target.width, exposure.moves)
    return expose(study, exposure, noise_free(study, exposure, plane), target.number)


def stacked(captures: Sequence[Capture]) -> tuple[Array, Array]:
    """Images (capture, *channel, y, x) and variances (capture, *channel)."""
    images, variances = [c.image for c in captures], [c.variance for c in captures]
    return jnp.asarray(np.stack(images)), jnp.asarray(np.stack(variances))


def build_reconstructor(
    study: Study, method: Method, shape: tuple[int, int], object_distance: float
) -> Reconstructor:
    """A function of the captures (capture, channel, y, x) and variances (capture, channel)."""
    cameras = reconstruction.Cameras(
        [study.camera(exposure) for exposure in method.exposures],
        wavelength=[exposure.wavelength for exposure in method.exposures],
        object_distance=object_distance,
        field_shape=shape,
        model=study.model,
        pixel_integration=study.config.pixel_integration,
    )
    synthesis = method.synthesis_matrix
    if method.kind == "fringe_scanning":
        scanning = reconstruction.FringeScanning().prepare(cameras)
        return lambda captures, variances: scanning(captures)
    if method.kind == "wiener":
        return reconstruction.Wiener(synthesis=synthesis, prior=study.prior).prepare(cameras)
    options = method.variation or VariationConfig()

    def total_variation(captures: Array, variances: Array) -> reconstruction.Reconstruction:
        """On the crop model; without noise in the study it is estimated."""
        variation = reconstruction.TotalVariation(
            options.kind,
            options.coupling_of(captures.shape[1]),
            chroma_weight=options.chroma_weight,
        )
        noise_variance = None if study.noise is None else variances
        return reconstruction.reconstruct(
            reconstruction.Recording(captures, cameras, noise_variance=noise_variance),
            reconstruction.AdmmTV(
                options.tau,
                variation=variation,
                synthesis=synthesis,
                iterations=options.iterations,
            ),
        )

    return total_variation
