"""From an experiment file to what is simulated: cameras, exposures, noise, targets and methods."""

import functools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from thincam_jax.commands.config_file import ConfigError
from thincam_jax.commands.sections import (
    MaskConfig,
    MethodConfig,
    MethodKind,
    NoiseConfig,
    SensorConfig,
    Synthesis,
    TargetConfig,
    VariationConfig,
)
from thincam_jax.commands.study.config import StudyConfig
from thincam_jax.imaging.metrics.image import SSIM_WINDOW
from thincam_jax.imaging.metrics.mtf import MINIMUM_COLUMNS
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
from thincam_jax.lensless.psf import Model, psf
from thincam_jax.reconstruction import (
    FringeScanning,
    Reconstruction,
    TotalVariation,
    WienerSynthesis,
    reconstruct,
)
from thincam_jax.reconstruction import synthesis as syntheses
from thincam_jax.reconstruction.spectra import Prior

_DRAWN: dict[str, Callable] = {
    "usaf1951": usaf1951,
    "slanted_edge": slanted_edge,
    "siemens_star": siemens_star,
    "point_grid": functools.partial(point_grid, count=(9, 9)),
}
# The scene's power is read off frequencies above three cycles a sensor (`spectra.inner_band`).
_MINIMUM_ROWS = 7

Reconstructor = Callable[[Array, Array], Reconstruction]


class Exposure(NamedTuple):
    """One exposure; those that are equal are taken once for all methods.

    - `beta`, `phase`, `width`: of the mask, rad/mm², rad and mm.
    - `distance`: mask to sensor, mm; `wavelength`: mm.
    - `share`: of the sensor's exposure time.
    - `take`: counts the exposures of a method that are equal in all else.
    """

    beta: float
    phase: float
    distance: float
    wavelength: float
    width: float
    share: float = 1.0
    take: int = 1


class Capture(NamedTuple):
    """What was read out (*channel, y, x), and the variance of its noise (*channel,)."""

    image: np.ndarray
    variance: np.ndarray


@dataclass(frozen=True)
class Method:
    """A reconstruction and the exposures that it takes, in the order of its synthesis.

    - `phases`: how many exposures each shot has.
    - `variation`: of admm_tv.
    """

    name: str
    kind: MethodKind
    synthesis: Synthesis
    exposures: tuple[Exposure, ...]
    phases: int
    variation: VariationConfig | None = None

    @property
    def shots(self) -> tuple[Exposure, ...]:
        """The first exposure of each shot."""
        return self.exposures[:: self.phases]

    @property
    def distance(self) -> float:
        """The largest mask-sensor distance, on whose scale the method reconstructs, mm."""
        return max(exposure.distance for exposure in self.exposures)

    @property
    def synthesis_matrix(self) -> np.ndarray:
        """Real weights (channel, exposure)."""
        return synthesis_matrix(self.synthesis, len(self.shots), self.phases)


def synthesis_matrix(synthesis: Synthesis, shots: int, phases: int) -> np.ndarray:
    """Real weights (channel, exposure) of so many shots with so many phases each."""
    if synthesis == "fringe_scanning":
        return syntheses.fringe_scanning(shots)
    if synthesis == "phase_pairs":
        return syntheses.phase_pairs(shots)
    if synthesis == "contrasts":
        return syntheses.contrasts(shots * phases)
    return syntheses.separate(shots * phases)


@dataclass(frozen=True)
class Target:
    """What is seen: its place in the study, on which its noise depends; distance and width in mm.

    `plane` holds the colour channels as a batch: (channel, y, x).
    """

    number: int
    name: str
    kind: str
    distance: float
    width: float
    plane: ImagePlane

    @property
    def is_picture(self) -> bool:
        """Whether it is a photograph or an image file, and not drawn."""
        return self.kind in ("photograph", "file")


@dataclass(frozen=True, eq=False)
class Study:
    """Cameras before targets, and the methods that reconstruct their captures.

    - `config`: the experiment file that it was built from.
    - `sensor`, `mask`: what all cameras share.
    - `noise`: None leaves captures as they are.
    - `reconstructors`: those that were built so far, by method's name and shape of the field.
    """

    config: Any
    sensor: SensorConfig
    mask: MaskConfig
    noise: AbstractNoise | None
    methods: tuple[Method, ...]
    targets: tuple[Target, ...]
    seed: int = 0
    model: Model = "separable"
    pixel_integration: bool = True
    prior: Prior = "inverse_square"
    reconstructors: dict[tuple, Reconstructor] = field(default_factory=dict)

    @functools.cached_property
    def exposures(self) -> tuple[Exposure, ...]:
        """Of all methods, each once, in the order of first use."""
        return tuple(dict.fromkeys(e for m in self.methods for e in m.exposures))

    @property
    def object_distance(self) -> float:
        """Where the targets stand, mm."""
        return self.config.object.distance

    def camera(self, exposure: Exposure) -> LenslessCamera:
        """The camera of an exposure."""
        mask = {**dict(self.mask), "width": exposure.width}
        levels = {name: getattr(self.sensor, name) for name in ("exposure", "electrons")}
        levels = {n: None if v is None else v * exposure.share for n, v in levels.items()}
        return LenslessCamera(
            FresnelZoneAperture(exposure.beta, exposure.phase, **mask),
            Sensor(**{**dict(self.sensor), **levels}),
            exposure.distance,
        )

    def psf(self, exposure: Exposure) -> Array:
        """Of a point on the axis at the distance of the targets, (y, x)."""
        return psf(
            self.camera(exposure),
            wavelength=exposure.wavelength,
            object_distance=self.object_distance,
            model=self.model,
            pixel_integration=self.pixel_integration,
        )


def build_study(config: StudyConfig) -> Study:
    """All that a study needs, images read and everything checked, before the first capture.

    **Errors**: ConfigError, one line for each fault, beginning with the field.
    """
    targets, unread = read_targets(config.targets, config.object.distance, config.object.width)
    study = assemble(config, targets)
    check_study(study, unread)
    return study


def assemble(config: Any, targets: Sequence[Target]) -> Study:
    """From a configuration that names methods, camera and noise as a study's does."""
    return Study(
        config,
        config.sensor,
        config.mask,
        None if config.noise is None else build_noise(config.noise),
        tuple(_method(config, method) for method in config.methods),
        tuple(targets),
        config.seed,
        config.model,
        config.pixel_integration,
        config.prior,
    )


def _method(config: Any, method: MethodConfig) -> Method:
    phases = method.shot_phases()
    exposures = tuple(
        Exposure(
            shot.beta,
            phase,
            shot.distance,
            shot.wavelength or config.wavelength,
            shot.width or config.mask.width,
            shot.exposure,
            shot.take or 1,
        )
        for shot in method.shots
        for phase in phases
    )
    return Method(
        method.name, method.kind, method.synthesis, exposures, len(phases), method.variation
    )


def build_noise(noise: NoiseConfig) -> AbstractNoise:
    if noise.read_noise is not None:
        return PoissonGaussianNoise(noise.read_noise)
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
    if target.kind in _DRAWN:
        return _DRAWN[target.kind]((target.pixels, target.pixels))
    if target.kind == "photograph":
        return sample_image(target.image or "")
    return load_image(target.path or "")


def check_study(study: Study, unread: dict[int, str] | None = None) -> None:
    """Refuse cameras that cannot be built, images that cannot be read, and too few pixels.

    `unread`: why images could not be read, by the target's place.

    **Errors**: ConfigError, one line for each fault, beginning with the field.
    """
    known = {target.number: _target_fault(study, target) for target in study.targets}
    known |= unread or {}
    faults = [f"targets[{number}]: {fault}" for number, fault in sorted(known.items()) if fault]
    camera = _camera_fault(study)
    if camera or faults:
        raise ConfigError("\n".join([*filter(None, [camera]), *faults]))


def _camera_fault(study: Study) -> str:
    """Empty for none."""
    rows, columns = study.sensor.shape
    if rows < _MINIMUM_ROWS or columns < MINIMUM_COLUMNS:
        return (
            f"sensor.shape: {rows}×{columns} pixels are too few for a study; "
            f"give at least {_MINIMUM_ROWS}×{MINIMUM_COLUMNS}"
        )
    try:
        for exposure in study.exposures:
            study.camera(exposure)
        # Traced only: whether the model takes this mask at all.
        jax.eval_shape(lambda: study.psf(study.exposures[0]))
    except (ValueError, TypeError) as error:
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
    """What falls on the sensor, (*channel, y, x)."""
    camera = study.camera(exposure)
    # Without saturation.
    ideal = Sensor(camera.sensor.shape, camera.sensor.pitch)
    return capture(
        LenslessCamera(camera.mask, ideal, camera.distance),
        Scene(planes, exposure.wavelength),
        model=study.model,
        pixel_integration=study.pixel_integration,
    )


def expose(study: Study, exposure: Exposure, clean: Array, number: int, trial: int = 0) -> Capture:
    """What is read out of a noise-free image of the target of a place in the study.

    The noise is that of the image; its random key is the same however a study is interrupted, and
    another one for each further trial.
    """
    seed = jax.random.key((study.seed + trial) % 2**32)
    place = study.exposures.index(exposure)
    key = jax.random.fold_in(jax.random.fold_in(seed, number), place)
    sensor, noise = study.camera(exposure).sensor, study.noise
    if noise is None:
        variance = np.zeros(clean.shape[:-2], clean.dtype)
    else:
        variance = np.asarray(noise.variance(clean, electrons_per_unit(sensor, clean)))
    return Capture(np.asarray(read_out(sensor, clean, noise=noise, key=key)), variance)


def take(study: Study, exposure: Exposure, target: Target) -> Capture:
    """One capture of a target."""
    return expose(study, exposure, noise_free(study, exposure, target.plane), target.number)


def stacked(captures: Sequence[Capture]) -> tuple[Array, Array]:
    """Images (capture, *channel, y, x) and variances (capture, *channel)."""
    images, variances = (np.stack(values) for values in zip(*captures, strict=True))
    return jnp.asarray(images), jnp.asarray(variances)


def build_reconstructor(
    study: Study, method: Method, shape: tuple[int, int], object_distance: float
) -> Reconstructor:
    """A function of the captures (capture, channel, y, x) and variances (capture, channel)."""
    cameras = [study.camera(exposure) for exposure in method.exposures]
    if method.kind == "fringe_scanning":
        scanning = FringeScanning(cameras, object_distance=object_distance, field_shape=shape)
        return lambda captures, variances: scanning(captures)
    wavelength = [exposure.wavelength for exposure in method.exposures]
    if method.kind == "wiener":
        return WienerSynthesis(
            cameras,
            wavelength=wavelength,
            object_distance=object_distance,
            synthesis=method.synthesis_matrix,
            field_shape=shape,
            prior=study.prior,
            model=study.model,
            pixel_integration=study.pixel_integration,
        )
    options = method.variation or VariationConfig()

    def total_variation(captures: Array, variances: Array) -> Reconstruction:
        """On the crop model; without noise in the study it is estimated."""
        variation = TotalVariation(
            options.kind,
            options.coupling_of(captures.shape[1]),
            chroma_weight=options.chroma_weight,
        )
        return reconstruct(
            captures,
            cameras,
            method="admm_tv",
            object_distance=object_distance,
            wavelength=wavelength,
            noise_variance=None if study.noise is None else variances,
            synthesis=method.synthesis_matrix,
            field_shape=shape,
            tau=options.tau,
            variation=variation,
            iterations=options.iterations,
            model=study.model,
            pixel_integration=study.pixel_integration,
        )

    return total_variation
