"""Captures of masks in equal light, and two reconstructions of these."""

import math
import time
from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from thincam_jax._core.precision import squared_modulus
from thincam_jax.imaging.operators import CropConvolution
from thincam_jax.imaging.operators.crop_convolution import cut, kernel_grid, place
from thincam_jax.imaging.sensor import PoissonGaussianNoise, Sensor, read_out
from thincam_jax.lensless.camera import LenslessCamera
from thincam_jax.lensless.masks.base import AbstractMask
from thincam_jax.lensless.method import PsfMethod
from thincam_jax.lensless.psf import spectral_psf
from thincam_jax.reconstruction.recording import Recording
from thincam_jax.reconstruction.regularised import AdmmTV
from thincam_jax.reconstruction.splittings import difference_symbol
from thincam_jax.reconstruction.total_variation import TotalVariation
from thincam_jax.studies.study import Synthesis, synthesis_matrix

# Of conjugate gradients: relative residual, and at most so many.
_TOLERANCE, _STEPS = 1e-3, 400


@dataclass(frozen=True, eq=False)
class ComparedMask:
    """One mask, or the several that a camera takes one after the other.

    - `masks`: one for each capture; the captures share the light.
    - `synthesis`: sums that are made of the captures; "fringe_scanning" takes the phases 0, π/2, π,
      3π/2.
    - `sort`: sort of mask; plots draw each by a dash and a grey of its own.
    """

    masks: tuple[AbstractMask, ...]
    sort: str = "mask"
    synthesis: Synthesis = "separate"

    @property
    def weights(self) -> np.ndarray:
        """Weights (channel, capture) of the captures."""
        return synthesis_matrix(self.synthesis, 1, 1)


@dataclass(frozen=True, eq=False)
class Setting:
    """Setting that all masks share.

    - `sensor`: shape and pitch; how long it is exposed follows from the light.
    - `distance`: mask to sensor, mm; `field`: pixels (rows, columns) that the scene covers there.
    - `width`: width of the masks, mm; pinholes are smaller.
    - `read_noise`: electrons.
    """

    sensor: Sensor
    distance: float
    field: tuple[int, int]
    width: float
    read_noise: float = 3.0

    @property
    def pitch(self) -> float:
        """Pixel pitch of the sensor, mm."""
        return float(self.sensor.pitch)


class Seen(eqx.Module):
    """Statistics of scenes from their captures.

    - `channels`: sums of captures; `variance`: variance of their noise, for each scene.
    - `level`: brightness of the uniform scene that explains the captures best, which sums that
      cancel the uniform light do not tell.
    """

    channels: Float[Array, "scene channel y x"]
    variance: Float[Array, " scene"]
    level: Float[Array, " scene"]


def kernels(
    setting: Setting, compared: ComparedMask, light: tuple[float, ...], object_distance: float
) -> Float[Array, "capture k l"]:
    """The PSF of each capture in light of several wavelengths of equal weight."""

    def one(mask: AbstractMask):
        camera = LenslessCamera(mask, setting.sensor, setting.distance)
        model = mask.exact_model or "angular_spectrum"
        return spectral_psf(
            camera,
            [(wavelength, 1 / len(light)) for wavelength in light],
            object_distance,
            PsfMethod(model, pixel_integration=True),
            kernel_grid(camera.sensor.grid, setting.field),
        )

    return jnp.stack([one(mask) for mask in compared.masks])


def channels_of(
    setting: Setting, compared: ComparedMask, psfs: Float[Array, "capture k l"]
) -> list[CropConvolution]:
    """The camera of each sum of captures."""
    sums = jnp.tensordot(
        jnp.asarray(compared.weights, psfs.dtype), psfs, axes=1, precision="highest"
    )
    shape = setting.sensor.shape
    return [CropConvolution(h[None], setting.pitch, shape, setting.field) for h in sums]


def capture(
    setting: Setting,
    compared: ComparedMask,
    psfs: Float[Array, "capture k l"],
    scenes: Float[Array, "scene m n"],
    electrons: float,
    key: PRNGKeyArray,
) -> Seen:
    """Captures of scenes; several of a mask share the light.

    Before a white scene the bare sensor gets Σf Δ² of the field. Pixels never saturate: strong
    light is that of many exposures.
    """
    shape, pitch, field = setting.sensor.shape, setting.pitch, setting.field
    area = field[0] * field[1] * pitch**2
    counted = electrons / area / len(psfs)
    exposed = Sensor(shape, pitch, electrons=counted, full_well=1e3 * electrons)
    noise = PoissonGaussianNoise(setting.read_noise)
    camera = CropConvolution(psfs, pitch, shape, field)
    clean = camera(jnp.broadcast_to(scenes[:, None], (len(scenes), len(psfs), *field)))
    images = read_out(exposed, clean, noise=noise, key=key)
    each = noise.variance(clean, jnp.full((*clean.shape[:2], 1, 1), counted, clean.dtype))
    matrix = jnp.asarray(compared.weights, images.dtype)
    variance = jnp.mean(each @ matrix.T**2, axis=-1)
    even = camera(jnp.ones((len(psfs), *field), images.dtype))
    level = jnp.einsum("kyx,skyx->s", even, images, precision="highest") / jnp.sum(even**2)
    return Seen(jnp.einsum("ck,skyx->scyx", matrix, images, precision="highest"), variance, level)


def best_linear(
    cameras: list[CropConvolution], seen: Seen, precision: Float[Array, "scene 2"]
) -> Float[Array, "scene m n"]:
    r"""The best linear estimate, which knows noise, crop, and the prior of `ComparedScene`.

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
    power = jnp.sum(squared_modulus(spectra), axis=0)
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
    captures = [c[:, None] for c in channels]
    recording = Recording(captures, cameras, noise_variance=1.0, background=0.0)
    solver = AdmmTV(tau, iterations=iterations)
    result = solver.solve(recording, start=(start / unit)[:, None])
    return result.image.reshape(start.shape) * unit


@dataclass(frozen=True)
class Strength:
    """Light and response of a mask, from its PSF: parts of one; `weakest_at` in cycles/mm.

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
    setting: Setting,
    compared: ComparedMask,
    psfs: Float[Array, "capture k l"],
    wavelength: float,
    object_distance: float,
) -> Strength:
    """Strength of a mask; of captures that share the light, the sums made of them count."""
    pitch = setting.pitch
    open_light = (setting.width * (1 + setting.distance / object_distance)) ** 2
    light = float(jnp.mean(jnp.sum(psfs, axis=(-2, -1)))) * pitch**2
    cameras = channels_of(setting, compared, psfs)
    spectra = np.stack([np.abs(np.asarray(camera.spectrum[0])) for camera in cameras])
    # A capture has 1/K of the light; W of them are summed, of which noise grows as the root.
    share = float(np.mean(np.sum(compared.weights**2, axis=1))) * len(psfs)
    response = np.sqrt(np.sum(spectra**2, axis=0) / share)
    v, u = np.fft.fftfreq(cameras[0].window[0]), np.fft.rfftfreq(cameras[0].window[1])
    frequency = np.hypot(v[:, None], u)
    band = (frequency >= 1 / max(setting.field)) & (frequency <= 0.25)
    inside, at = response[band], frequency[band]
    size = float(np.sqrt(np.mean(inside**2)))
    began = time.perf_counter()
    kernels(setting, compared, (wavelength,), object_distance).block_until_ready()
    return Strength(
        light / open_light,
        size / light,
        float(np.exp(np.mean(np.log(np.maximum(inside, 1e-12))))) / size,
        float(inside.min()) / size,
        float(at[inside.argmin()]) / pitch,
        (time.perf_counter() - began) / len(psfs),
    )
