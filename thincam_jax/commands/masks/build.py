"""Cameras of all masks, their captures in equal light, and two reconstructions of these."""

import math
import time
from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from thincam_jax.commands.config_file import ConfigError
from thincam_jax.commands.masks.config import ComparedMaskConfig, MasksConfig, SceneConfig
from thincam_jax.commands.sections import PHASES
from thincam_jax.commands.study.build import picture
from thincam_jax.commands.study.mask import built_mask
from thincam_jax.imaging.operators import CropConvolution, kernel_grid
from thincam_jax.imaging.operators.crop_convolution import cut, place
from thincam_jax.imaging.sensor import PoissonGaussianNoise, Sensor, read_out
from thincam_jax.lensless.camera import LenslessCamera
from thincam_jax.lensless.exposures import Exposure
from thincam_jax.lensless.forward import spectral_psf
from thincam_jax.lensless.method import has_few_terms
from thincam_jax.reconstruction import AdmmTV, Recording
from thincam_jax.reconstruction.splittings import difference_symbol
from thincam_jax.reconstruction.total_variation import TotalVariation
from thincam_jax.studies.study import synthesis_matrix

# Of conjugate gradients: relative residual, and at most so many.
_TOLERANCE, _STEPS = 1e-3, 400


@dataclass(frozen=True)
class Scene:
    """A scene on the field's pixels (y, x), 0 to 1, as it is cast on the sensor.

    `precision`: a and b of its prior exp{−½(a‖∇f‖² + b‖f − f̄‖²)}, which fits its own mean square
    of differences or, of a flat spectrum, its variance.
    """

    config: SceneConfig
    image: np.ndarray
    precision: tuple[float, float]


@dataclass(frozen=True)
class Setup:
    """All that is known before the first capture; `cameras`: one for each phase of a mask."""

    config: MasksConfig
    cameras: dict[str, tuple[LenslessCamera, ...]]
    scenes: dict[str, Scene]


class Seen(eqx.Module):
    """What is known of scenes from their captures.

    - `channels`: sums of captures; `variance`: of their noise, for each scene.
    - `level`: brightness of the uniform scene that explains the captures best, which sums that
      cancel the uniform light do not tell.
    """

    channels: Float[Array, "scene channel y x"]
    variance: Float[Array, " scene"]
    level: Float[Array, " scene"]


def build_setup(config: MasksConfig) -> Setup:
    """Masks and scenes. **Errors**: ConfigError, a line for each that cannot be made."""
    cameras, scenes, faults = {}, {}, []
    for index, entry in enumerate(config.masks):
        try:
            cameras[entry.name] = _cameras(config, entry)
        except (ValueError, TypeError, FileNotFoundError) as error:
            faults.append(f"masks[{index}]: {error}")
    for index, scene in enumerate(config.scenes):
        try:
            scenes[scene.name] = _scene(scene, config.field)
        except (ValueError, FileNotFoundError) as error:
            faults.append(f"scenes[{index}]: {error}")
    if faults:
        raise ConfigError("\n".join(faults))
    return Setup(config, cameras, scenes)


def _cameras(config: MasksConfig, entry: ComparedMaskConfig) -> tuple[LenslessCamera, ...]:
    sensor, mask = Sensor(config.sensor.shape, config.sensor.pitch), entry.mask
    beta, given = entry.beta or 0.0, (config.distance, config.wavelength, mask.width)
    phases = PHASES.get(entry.synthesis, (0.0,))
    masks = (built_mask(mask, Exposure(beta, phase, *given)) for phase in phases)
    return tuple(LenslessCamera(one, sensor, config.distance) for one in masks)


def _scene(config: SceneConfig, field: tuple[int, int]) -> Scene:
    image = picture(config, field)
    squares = sum(np.sum(np.diff(image, axis=axis) ** 2) for axis in (0, 1))
    if config.prior == "flat":
        precision = 0.0, 1 / float(image.var())
    else:
        slope = image.size / float(squares)
        precision = slope, slope * (2 * math.pi / max(field)) ** 2
    return Scene(config, image, precision)


def kernels(
    setup: Setup, name: str, light: tuple[float, ...], object_distance: float
) -> Float[Array, "capture k l"]:
    """The PSF of each capture in light of several wavelengths of equal weight."""
    config = setup.config

    def one(camera: LenslessCamera):
        return spectral_psf(
            camera,
            [(wavelength, 1 / len(light)) for wavelength in light],
            object_distance,
            model="separable" if has_few_terms(camera.mask) else "angular_spectrum",
            pixel_integration=True,
            grid=kernel_grid(camera.sensor.grid, config.field),
        )

    return jnp.stack([one(camera) for camera in setup.cameras[name]])


def synthesis_of(entry: ComparedMaskConfig) -> np.ndarray:
    """Weights (channel, capture) of the captures of a mask."""
    return synthesis_matrix(entry.synthesis, 1, 1)


def channels_of(setup: Setup, entry: ComparedMaskConfig, psfs: Array) -> list[CropConvolution]:
    """The camera of each sum of captures."""
    config = setup.config
    sums = jnp.tensordot(jnp.asarray(synthesis_of(entry), psfs.dtype), psfs, axes=1)
    pitch = config.sensor.pitch
    return [CropConvolution(h[None], pitch, config.sensor.shape, config.field) for h in sums]


def capture(
    setup: Setup,
    entry: ComparedMaskConfig,
    psfs: Float[Array, "capture k l"],
    scenes: Float[Array, "scene m n"],
    electrons: float,
    key: PRNGKeyArray,
) -> Seen:
    """Captures of scenes; several of a mask share the light.

    Before a white scene the bare sensor gets Σf Δ² of the field. Pixels never saturate: strong
    light is that of many exposures.
    """
    config = setup.config
    sensor, pitch = config.sensor, config.sensor.pitch
    area = config.field[0] * config.field[1] * pitch**2
    counted = electrons / area / len(psfs)
    exposed = Sensor(sensor.shape, pitch, electrons=counted, full_well=1e3 * electrons)
    noise = PoissonGaussianNoise(config.read_noise)
    camera = CropConvolution(psfs, pitch, sensor.shape, config.field)
    clean = camera(jnp.broadcast_to(scenes[:, None], (len(scenes), len(psfs), *config.field)))
    images = read_out(exposed, clean, noise=noise, key=key)
    each = noise.variance(clean, jnp.full((*clean.shape[:2], 1, 1), counted, clean.dtype))
    matrix = jnp.asarray(synthesis_of(entry), images.dtype)
    variance = jnp.mean(each @ matrix.T**2, axis=-1)
    even = camera(jnp.ones((len(psfs), *config.field), images.dtype))
    level = jnp.einsum("kyx,skyx->s", even, images) / jnp.sum(even**2)
    return Seen(jnp.einsum("ck,skyx->scyx", matrix, images), variance, level)


def best_linear(
    cameras: list[CropConvolution], seen: Seen, precision: Float[Array, "scene 2"]
) -> Float[Array, "scene m n"]:
    r"""The best linear estimate, which knows noise, crop, and the prior of `Scene`.

    .. math:: \Big(\sum_c A_c^T A_c/\sigma^2 + a \nabla^T\nabla + b\Big)(f - \bar f)
        = \sum_c A_c^T (g_c - A_c \bar f)/\sigma^2

    with f̄ the `level` of what was seen: a Wiener filter whose image ends at its borders. By
    conjugate gradients, preconditioned by the filter without crop and borders.
    """
    spectra = jnp.stack([camera.spectrum[0] for camera in cameras])
    return _best_linear(cameras[0], spectra, seen, precision)


@jax.jit
def _best_linear(camera: CropConvolution, spectra, seen: Seen, precision):
    corner, window = camera.field_corner, camera.window
    variation = TotalVariation()

    def see(image):
        padded = jnp.fft.rfft2(place(image, corner, window))
        whole = jnp.fft.irfft2(padded * spectra, s=window)
        return cut(whole, camera.sensor_corner, camera.sensor_shape)

    def filtered(image, transfer):
        spectrum = jnp.fft.rfft2(place(image, corner, window)) * transfer.astype(spectra.dtype)
        return cut(jnp.fft.irfft2(spectrum, s=window), corner, camera.field_shape)

    back = jax.linear_transpose(see, jax.ShapeDtypeStruct(camera.field_shape, seen.channels.dtype))
    power = jnp.sum(spectra.real**2 + spectra.imag**2, axis=0)
    symbol = difference_symbol(window, seen.channels.dtype)
    uniform = see(jnp.ones(camera.field_shape, seen.channels.dtype))

    def one(measured, noise, mean, prior):
        slope, level = prior

        def normal(image):
            rough = variation.synthesise(variation.analyse(image[None, None]))[0, 0]
            return back(see(image))[0] / noise + slope * rough + level * image

        inverse = 1 / (power / noise + slope * symbol + level)
        found, _ = jax.scipy.sparse.linalg.cg(
            normal,
            back(measured - mean * uniform)[0] / noise,
            M=lambda image: filtered(image, inverse),
            tol=_TOLERANCE,
            maxiter=_STEPS,
        )
        return found + mean

    return jax.vmap(one)(seen.channels, seen.variance, seen.level, precision)


def total_variation(
    cameras: list[CropConvolution],
    seen: Seen,
    start: Float[Array, "scene m n"],
    tau: float,
    iterations: int,
) -> Float[Array, "scene m n"]:
    """ADMM-TV from a first image; one compiled program for all masks of as many channels.

    In units of the noise, which is then the same for all scenes, and so is τ.
    """
    unit = jnp.sqrt(seen.variance)[:, None, None]
    channels = jnp.moveaxis(seen.channels / unit[:, None], 1, 0)
    recording = Recording([c[:, None] for c in channels], cameras, noise_variance=1.0)
    solver = AdmmTV(tau, iterations=iterations)
    result = solver.solve(recording, start=(start / unit)[:, None])
    return result.image.reshape(start.shape) * unit


@dataclass(frozen=True)
class Strength:
    """What a mask does with the light, from its PSF: parts of one; `weakest_at` in cycles/mm.

    - `throughput`: light of the open width that falls on sensor and surroundings.
    - `detail`: root mean square of |H| over H(0), from one cycle a field to half of Nyquist.
    - `flatness`: geometric mean of |H| over its root mean square; 1 is flat.
    - `weakest`: the least |H| over the root mean square.
    - `seconds`: for one PSF, compiled already.
    """

    throughput: float
    detail: float
    flatness: float
    weakest: float
    weakest_at: float
    seconds: float

    @property
    def in_shot_noise(self) -> float:
        """Detail over the root of the light: what an image rises from the noise of light by."""
        return self.detail * math.sqrt(self.throughput)

    @property
    def in_read_noise(self) -> float:
        """Detail times light: the same where read noise is all there is."""
        return self.detail * self.throughput


def strength(
    setup: Setup, entry: ComparedMaskConfig, psfs: Float[Array, "capture k l"]
) -> Strength:
    """Of captures that share the light, the sums that are made of them count."""
    config = setup.config
    pitch, distance = config.sensor.pitch, config.object_distances[0]
    open_light = (config.width * (1 + config.distance / distance)) ** 2
    light = float(jnp.mean(jnp.sum(psfs, axis=(-2, -1)))) * pitch**2
    cameras = channels_of(setup, entry, psfs)
    spectra = np.stack([np.abs(np.asarray(camera.spectrum[0])) for camera in cameras])
    # A capture has 1/K of the light; W of them are summed, of which noise grows as the root.
    share = float(np.mean(np.sum(synthesis_of(entry) ** 2, axis=1))) * len(psfs)
    response = np.sqrt(np.sum(spectra**2, axis=0) / share)
    v, u = np.fft.fftfreq(cameras[0].window[0]), np.fft.rfftfreq(cameras[0].window[1])
    frequency = np.hypot(v[:, None], u)
    band = (frequency >= 1 / max(config.field)) & (frequency <= 0.25)
    inside, at = response[band], frequency[band]
    size = float(np.sqrt(np.mean(inside**2)))
    began = time.perf_counter()
    kernels(setup, entry.name, (config.wavelength,), distance).block_until_ready()
    seconds = (time.perf_counter() - began) / len(psfs)
    return Strength(
        light / open_light,
        size / light,
        float(np.exp(np.mean(np.log(np.maximum(inside, 1e-12))))) / size,
        float(inside.min()) / size,
        float(at[inside.argmin()]) / pitch,
        seconds,
    )
