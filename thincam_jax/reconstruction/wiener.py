r"""Wiener synthesis of K captures into one image (thesis Eq 3.44, corrected); where it suffices.

Spectra of scene and noise are per sample: a white image of variance σ² has the spectrum σ² at every
frequency. They lie on the half plane of a real DFT of the padded window.
"""

import functools
import math
from collections.abc import Callable, Sequence
from typing import ClassVar, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import DTypeLike
from jaxtyping import Array, Bool, Complex, Float

from thincam_jax._core import checks
from thincam_jax._core.checks import Numbers
from thincam_jax._core.grids import fast_shape, same_parity
from thincam_jax._core.precision import as_complex, scaled, squared_modulus
from thincam_jax._core.quantity import choice
from thincam_jax.imaging.operators import CropConvolution
from thincam_jax.imaging.operators.crop_convolution import kernel_shape
from thincam_jax.lensless.camera import LenslessCamera
from thincam_jax.reconstruction.imaging_model import (
    Cameras,
    Psfs,
    distance_ratios,
    own_field,
    register,
    registered_shape,
)
from thincam_jax.reconstruction.noise import estimate_variance, given_variances
from thincam_jax.reconstruction.recording import Recording
from thincam_jax.reconstruction.result import Reconstruction
from thincam_jax.reconstruction.solver import AbstractSolver, Synthesis, as_synthesis
from thincam_jax.reconstruction.synthesis import keep_bias, phase_contrasts, synthesis_matrix

Prior = Literal["inverse_square", "flat"]

# Contrast of a channel over its noise from which a filter suffices. A judgement: total variation
# gains 0.5 to 2.5 dB at 1 to 3 (configs/fza_admm_tv.yaml), and next to nothing without noise.
_CLEAN = 30.0


class WienerSynthesis(eqx.Module):
    r"""The best linear reconstruction from several captures, as a function of the captures.

    With the channels :math:`G_c = H_c F + N_c` (sums of captures, see
    `thincam_jax.reconstruction.synthesis`), noise spectra η_c and scene spectrum η_f,

    .. math:: \hat F = \frac{\sum_c (H_c^*/\eta_c)\, G_c}{\sum_c |H_c|^2/\eta_c + 1/\eta_f}

    minimises the expected squared error (ERRATA 3.44; the error is ∫ 1/(1/η_f + Σ|H_c|²/η_c),
    3.46). One channel is a single capture's Wiener filter; channels at several distances are the
    thesis' method A, pairs of β its method B, wavelengths its colour synthesis.

    The scene's mean is estimated from the raw captures by least squares; its response is subtracted
    before the filter and the mean added after it, so that the prior is one of contrast only. The
    prior's strength is estimated from the power of the captures. Captures at other distances than
    the largest are enlarged to its scale, and their responses with them.

    The filter treats captures as if nothing had been cropped. Where a channel keeps the bias of the
    captures, the steps at the sensor's borders are counted as noise (`crop_noise`); a
    single capture therefore loses its lowest frequencies, which synthesised ones do not.

    With a `field_tolerance` the image is divided by the light of every point; the PSF stays that of
    the axis.

    Differentiable in all numbers of the cameras but the distances, which set array sizes.

    **Arguments**

    - `cameras`: one for each capture, all with the same sensor, at one distance t; their
      `field_shape` is that of the result, at the object pitch p·t/d. The scene is taken as black
      outside.
    - `synthesis`: real matrix (channel × capture); a channel combines captures at one distance, and
      channels must not share noise (rows orthogonal). Default: the `contrasts` of captures that
      differ in the phase of their mask only, so that their background cancels; every other capture
      is a channel (`phase_contrasts`).
    - `prior`: "inverse_square", η_f ∝ 1/(ρ² + ρ₀²) with ρ₀ one cycle per field, or "flat".
    """

    spectra: Complex[Array, "channel v u"]
    uniform: Float[Array, "capture y x"]
    prior: Float[Array, "v u"]
    synthesis: Float[Array, "channel capture"]
    light: Float[Array, "m n"]
    object_pitch: Float[Array, ""]
    ratios: tuple[float, ...] = eqx.field(static=True)
    weights: tuple[tuple[float, ...], ...] = eqx.field(static=True)
    sensor_shape: tuple[int, int] = eqx.field(static=True)
    field_shape: tuple[int, int] = eqx.field(static=True)
    padded: tuple[int, int] = eqx.field(static=True)

    def __init__(
        self,
        cameras: Cameras,
        *,
        synthesis: Synthesis | None = None,
        prior: Prior = "inverse_square",
    ):
        checks.choice("prior", prior, ("inverse_square", "flat"))
        cameras.require("wavelength", "object_distance")
        if np.ndim(cameras.object_distance) > 0:
            raise ValueError(
                "object_distance has several planes, which a filter does not separate; give "
                "'admm_tv' as solver, or one distance"
            )
        each = cameras.cameras
        capture_ratios = distance_ratios(each)
        if synthesis is None:
            synthesis = phase_contrasts(each, cameras.wavelengths)
        matrix = synthesis_matrix(synthesis, each, capture_ratios)
        sensor = each[0].sensor.grid
        self.sensor_shape = sensor.shape
        self.field_shape = same_parity(cameras.pixels or sensor.shape, sensor.shape)
        self.ratios = tuple(
            next(r for w, r in zip(row, capture_ratios, strict=True) if w) for row in matrix
        )
        object_distance = cameras.object_distance
        kernels, uniform = [], []
        for number, ratio in enumerate(capture_ratios):
            own = own_field(self.field_shape, ratio)
            h = cameras.own_psf(number, own, object_distance)
            kernels.append(h)
            cover = checks.as_array(_coverage(own, self.field_shape, ratio).astype(h.dtype))
            uniform.append(_convolve(CropConvolution(h, sensor.pitch, sensor.shape, own), cover))
        self.uniform = checks.stacked(uniform)
        self.padded = _padded(sensor.shape, self.field_shape, max(self.ratios))
        self.spectra = checks.stacked(
            [
                _channel_spectrum(*_used(row, kernels), sensor.pitch, ratio, self.padded)
                for row, ratio in zip(matrix, self.ratios, strict=True)
            ]
        )
        dtype = self.uniform.dtype
        self.prior = checks.as_array(prior_spectrum(prior, self.padded, self.field_shape, dtype))
        self.synthesis = checks.as_array(matrix.astype(dtype))
        self.light = cameras.light(self.field_shape).astype(dtype)
        self.weights = tuple(map(tuple, matrix.tolist()))
        self.object_pitch = cameras.pitch

    def __call__(self, captures: Numbers, noise_variance: Numbers) -> Reconstruction:
        """The reconstruction of captures (capture, *batch, y, x).

        `noise_variance`: that of a pixel, > 0, one number, one for each capture or (capture,
        *batch).
        """
        known = checks.at_hand(captures, self.uniform.dtype)
        require_captures(known.shape, (len(self.uniform), *self.sensor_shape))
        count, *batch, rows, columns = known.shape
        variance = checks.positive_all("noise_variance", jnp.asarray(noise_variance), "units²")
        if variance.shape != (count, *batch)[: variance.ndim]:
            raise ValueError(
                f"noise_variance has shape {variance.shape}; give one number, {count} (one for "
                f"each capture) or {(count, *batch)}"
            )
        variance = variance.astype(known.dtype)
        variance = variance.reshape(variance.shape + (1,) * (1 + len(batch) - variance.ndim))
        variance = jnp.broadcast_to(variance, (count, *batch)).reshape(count, -1)
        image = each_image(self._image, known.reshape(count, -1, rows, columns), variance)
        return Reconstruction(image.reshape(*batch, *self.field_shape), self.object_pitch, "wiener")

    @eqx.filter_jit
    def _image(self, captures: Float[Array, "capture y x"], variance: Float[Array, " capture"]):
        mean = jnp.sum(captures * self.uniform) / jnp.sum(self.uniform**2)
        contrast = captures - mean * self.uniform
        channels = jnp.tensordot(self.synthesis, contrast, axes=1, precision="highest")
        noise = self.synthesis**2 @ variance
        spectra = jnp.stack(
            [
                _embedded_spectrum(register(channel, ratio), self.padded)
                for channel, ratio in zip(channels, self.ratios, strict=True)
            ]
        )
        density, scene = self._noise_and_scene(spectra, noise, captures[0].size)
        gain = jnp.sum(squared_modulus(self.spectra) / density, axis=0) + 1 / scene
        merged = jnp.sum(self.spectra.conj() * scaled(spectra, 1 / density), axis=0)
        full = jnp.fft.irfft2(scaled(merged, 1 / gain), s=self.padded)
        return (crop_field(full, self.field_shape)[::-1, ::-1] + mean) / self.light

    def _noise_and_scene(self, spectra, noise, pixels: int):
        """η_c of every channel and η_f, from the noise's variance and the channels' own power."""
        # Enlarging by r keeps the noise's variance and concentrates it in 1/r² of the band.
        squared = jnp.asarray(np.square(self.ratios), dtype=noise.dtype)[:, None, None]
        density = noise[:, None, None] * squared
        periodogram = squared_modulus(spectra) / (squared * pixels)
        expected = squared_modulus(self.spectra) * self.prior
        inner = inner_band(self.padded, self.sensor_shape)
        # Per captured sample, though the scene may cover fewer: per scene sample the power is
        # higher and the result 0.3 dB worse, because the crop adds noise that is not modelled.
        scene = self.prior * scene_power(periodogram - density, expected, inner)
        biased = keep_bias(np.asarray(self.weights))
        if biased.any():
            steps = crop_noise(periodogram, self.padded, self.sensor_shape)
            density = density + jnp.where(biased[:, None, None], steps, 0.0)
        return density, scene


class Wiener(AbstractSolver):
    """The Wiener synthesis of all captures, in closed form; see `WienerSynthesis`.

    It needs `Cameras`. Captures at several phases of one zone aperture are combined so that their
    background cancels. The noise is estimated if the recording has no variance. To reconstruct many
    scenes with the same cameras call `prepare(cameras)` once, and its result on each.

    - `synthesis`, `prior`: weights of the captures and spectrum of the scene, see
      `WienerSynthesis`.

    ```python
    import thincam_jax as tc
    from thincam_jax.units import nm, um

    masks = [tc.FresnelZoneAperture(25.0, phase, width=1.6) for phase in (0.0, 4.712)]
    cameras = [tc.LenslessCamera(mask, tc.Sensor((24, 32), 50 * um), 5.0) for mask in masks]
    scene = tc.Scene(tc.ImagePlane([[0.0, 1.0]], distance=250.0, width=40.0), 500 * nm)
    optics = tc.Cameras(cameras, wavelength=500 * nm, object_distance=250.0)
    recording = tc.Recording([tc.capture(camera, scene) for camera in cameras], optics)
    result = tc.reconstruct(recording, tc.Wiener())
    ```

    **See also**: `reconstruct`, `FringeScanning`, `AdmmTV`.
    """

    name: ClassVar[str] = "wiener"
    synthesis: np.ndarray | None = eqx.field(default=None, converter=as_synthesis, kw_only=True)
    prior: Prior = eqx.field(
        default="inverse_square",
        converter=choice(("inverse_square", "flat")),
        static=True,
        kw_only=True,
    )

    def prepare(self, cameras: Cameras) -> WienerSynthesis:
        """The filter of these cameras, a function of captures and noise variance."""
        return WienerSynthesis(cameras, synthesis=self.synthesis, prior=self.prior)

    def solve(self, recording: Recording):
        cameras = require_cameras(recording, self.name)
        captures = jnp.stack(recording.light)
        variance = recording.noise_variance
        if variance is None:
            variance = estimate_variance(captures)
        return self.prepare(cameras)(captures, variance)


def require_cameras(recording: Recording, method: str) -> Cameras:
    """The cameras of a recording, required by filters."""
    if not isinstance(recording.imaging_model, Cameras):
        raise ValueError(
            f"method {method!r} needs cameras; with measured PSFs or operators use AdmmTV, Fista, "
            "Ridge or PoissonTV"
        )
    if recording.valid is not None:
        raise ValueError(
            f"method {method!r} cannot leave out pixels that are not valid; use AdmmTV, Fista, "
            "Ridge or PoissonTV"
        )
    return recording.imaging_model


def each_image(filtered: Callable[..., Array], *numbers: Numbers) -> Float[Array, "image m n"]:
    """A filter's images, one after the other, of `numbers` (capture, image, …)."""
    parts = (checks.each(part, axis=1) for part in numbers)
    return checks.stacked([filtered(*part) for part in zip(*parts, strict=True)])


def require_captures(shape: tuple[int, ...], wanted: tuple[int, int, int]) -> None:
    """Require (capture, …, y, x) of the filter's numbers."""
    if (shape[0], *shape[-2:]) != wanted:
        count, rows, columns = wanted
        raise ValueError(
            f"captures have shape {shape}; give ({count}, …, {rows}, {columns}), in the "
            "order of the cameras"
        )


def _coverage(own_field, field_shape, ratio: float) -> np.ndarray:
    """Share of each own sample that the field covers: the outermost lie partly outside."""
    sides = []
    for count, whole in zip(own_field, field_shape, strict=True):
        distance = np.abs(np.arange(count) - (count - 1) / 2)
        sides.append(np.clip(whole / ratio / 2 - distance + 0.5, 0.0, 1.0))
    return np.outer(*sides)


def _padded(sensor_shape, field_shape, ratio: float) -> tuple[int, int]:
    """A window without wrap-around of the enlarged captures and kernels."""
    largest = registered_shape(kernel_shape(sensor_shape, own_field(field_shape, ratio)), ratio)
    return fast_shape(largest, real=True)


def _used(row: np.ndarray, kernels: list[Array]) -> tuple[Array, Array]:
    """Weights and kernels of a channel."""
    used = [(w, k) for w, k in zip(row, kernels, strict=True) if w]
    stacked = checks.stacked([k for _, k in used])
    return checks.as_array(np.asarray([w for w, _ in used], stacked.dtype)), stacked


@eqx.filter_jit
def _convolve(convolution: CropConvolution, field: Float[Array, "m n"]) -> Float[Array, "y x"]:
    return convolution(field)


@functools.partial(jax.jit, static_argnames=("ratio", "padded"))
def _channel_spectrum(weights, kernels, pitch, ratio: float, padded: tuple[int, int]):
    """Response of a channel on the reference scale."""
    kernel = register(jnp.tensordot(weights, kernels, axes=1, precision="highest"), ratio)
    # Enlarged, a kernel spreads the same light over ratio² of its area.
    area = pitch.astype(kernel.dtype) ** 2 / ratio**2
    return _embedded_spectrum(kernel, padded) * as_complex(area)


def _embedded_spectrum(image: Float[Array, "y x"], padded) -> Complex[Array, "v u"]:
    """Real DFT of an image on the padded window with its centre at sample 0 (or half before)."""
    rows, columns = image.shape
    canvas = jnp.pad(image, ((0, padded[0] - rows), (0, padded[1] - columns)))
    canvas = jnp.roll(canvas, (-((rows - 1) // 2), -((columns - 1) // 2)), axis=(0, 1))
    return jnp.fft.rfft2(canvas)


def crop_field(full: Float[Array, "v u"], field_shape: tuple[int, int]) -> Float[Array, "y x"]:
    """The field around sample 0, centred."""
    rows, columns = field_shape
    rolled = jnp.roll(full, ((rows - 1) // 2, (columns - 1) // 2), axis=(0, 1))
    return rolled[:rows, :columns]


def prior_spectrum(
    prior: Prior, padded: tuple[int, int], field_shape: tuple[int, int], dtype: DTypeLike
) -> Float[np.ndarray, "v u"]:
    """Scene spectrum with a mean of 1 over all frequencies; in NumPy, with nothing to compile."""
    v, u = (np.fft.fftfreq(n, 1 / max(field_shape)).astype(dtype) for n in padded)
    corner = 1 if prior == "inverse_square" else math.inf
    spectrum = 1 / (1 + (u**2 + v[:, None] ** 2) / corner)
    return (spectrum / spectrum.mean())[:, : padded[1] // 2 + 1]


def _axis_distance(padded, sensor_shape) -> tuple[np.ndarray, np.ndarray]:
    """|v| and |u| in units of the frequency of one cycle over the sensor."""
    v = np.abs(np.fft.fftfreq(padded[0])) * sensor_shape[0]
    u = np.fft.rfftfreq(padded[1]) * sensor_shape[1]
    return v[:, None], u[None, :]


def inner_band(padded: Sequence[int], sensor_shape: Sequence[int | float]) -> np.ndarray:
    """Frequencies off both axes, which the sensor's edges do not affect."""
    v, u = _axis_distance(padded, sensor_shape)
    inner = (v > 3) & (u > 3)
    return inner if inner.any() else np.ones_like(inner)  # a sensor of a few rows has none


def scene_power(
    signal: Float[Array, "channel v u"],
    expected: Float[Array, "channel v u"],
    inner: Bool[np.ndarray, "v u"],
) -> Float[Array, ""]:
    """Variance of the scene: least-squares fit of its expected power to that of the captures.

    Weighted by the expected power, and so by frequencies at which the scene exceeds the noise.
    """
    weight = jnp.where(inner, expected, 0.0)
    # All sums at once: half as much to compile.
    parts = weight * jnp.stack([signal, jnp.abs(signal), expected])
    power, size, wanted = jnp.sum(parts, axis=tuple(range(1, parts.ndim)))
    return jnp.maximum(power, 1e-6 * size) / wanted


def crop_noise(
    periodogram: Float[Array, "channel v u"],
    padded: Sequence[int],
    sensor_shape: Sequence[int | float],
) -> Float[Array, "channel v u"]:
    """Noise spectrum of the steps of a bright background at the sensor's borders.

    A step across the border x = const has a spectrum that falls like 1/u² from the v axis; its
    strength is read off that axis, row by row, and so for the other border.
    """
    v, u = _axis_distance(padded, sensor_shape)
    on_v = jnp.mean(periodogram[..., u[0] <= 1], axis=-1, keepdims=True)
    on_u = jnp.mean(periodogram[..., v[:, 0] <= 1, :], axis=-2, keepdims=True)
    across, down = (jnp.asarray(1 / (1 + f**2), dtype=periodogram.dtype) for f in (u, v))
    return on_v * across + on_u * down


def filter_suffices(recording: Recording, synthesis: Synthesis | None) -> tuple[bool, str]:
    """Whether the Wiener synthesis is as good as total variation, and the reason in a sentence.

    The filter does not model the crop of the sensor, which matters if the captures keep a bright
    background or a PSF is as large as the sensor, and does not distinguish noise from edges.
    """
    model = recording.imaging_model
    if isinstance(model, Psfs):
        return False, "PSFs were measured: light falls beside the sensor, which it models"
    if not isinstance(model, Cameras):
        return False, "operators were given, and a filter is made of cameras"
    if recording.valid is not None:
        return False, "some pixels are not to be trusted, which a filter cannot leave out"
    if np.ndim(model.object_distance) > 0:
        return False, "several planes are requested, which a filter does not separate"
    cameras, noise_variance = model.cameras, recording.noise_variance
    captures = jnp.stack(recording.light)
    matrix = synthesis_matrix(synthesis, cameras, distance_ratios(cameras))
    biased = keep_bias(matrix)
    biased |= np.array([_backgrounds_differ(row, cameras) for row in matrix])
    if biased.any():
        return False, (
            f"{int(biased.sum())} of {len(matrix)} channels keep the bright background of their "
            "captures, which the sensor crops; a filter would ring at its borders"
        )
    contrast = _contrast(captures, matrix, noise_variance)
    if not contrast >= _CLEAN:
        return False, (
            f"the channels' contrast is {contrast:.2g} times their noise; total variation "
            "separates edges from noise, a filter cannot"
        )
    return True, (
        f"no channel keeps a background and their contrast is {contrast:.2g} times the noise: the "
        "Wiener synthesis is as good, in closed form"
    )


def _backgrounds_differ(row: np.ndarray, cameras: Sequence[LenslessCamera]) -> bool:
    """Whether a row combines apertures of different widths, whose backgrounds do not cancel."""
    used = [camera.mask for weight, camera in zip(row, cameras, strict=True) if weight]
    return len({float(getattr(mask, "width", 0)) for mask in used}) > 1


def _contrast(captures, matrix: np.ndarray, noise_variance) -> float:
    """Root mean square over the noise of the channel with the most contrast."""
    flat = captures.reshape(captures.shape[0], -1, *captures.shape[-2:])
    if noise_variance is None:
        variances = estimate_variance(flat)
    else:
        variances = given_variances(noise_variance, flat)
    ratios = []
    for row in matrix:
        channel = jnp.tensordot(jnp.asarray(row, flat.dtype), flat, axes=1, precision="highest")
        noise = jnp.sum(jnp.asarray(row**2, flat.dtype) * variances)
        power = jnp.maximum(jnp.mean(channel**2) - noise, 0)
        ratios.append(float(jnp.sqrt(power / noise)) if noise > 0 else float("inf"))
    return max(ratios)
