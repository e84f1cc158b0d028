r"""Wiener synthesis of K captures into one image (thesis Eq 3.44, corrected)."""

import functools
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float

from thincam_jax._core import checks
from thincam_jax._core.checks import Numbers
from thincam_jax._core.grids import Grid, fast_shape, same_parity
from thincam_jax._core.precision import as_complex
from thincam_jax._core.quantity import choice
from thincam_jax.imaging.operators import CropConvolution, kernel_grid, kernel_shape
from thincam_jax.lensless.psf import psf
from thincam_jax.reconstruction.noise import estimate_variance
from thincam_jax.reconstruction.recording import Recording
from thincam_jax.reconstruction.registration import (
    distance_ratios,
    own_field,
    register,
    registered_shape,
)
from thincam_jax.reconstruction.seen_by import Cameras
from thincam_jax.reconstruction.solver import (
    AbstractSolver,
    Reconstruction,
    Synthesis,
    as_synthesis,
)
from thincam_jax.reconstruction.spectra import (
    Prior,
    crop_noise,
    inner_band,
    prior_spectrum,
    scene_power,
)
from thincam_jax.reconstruction.synthesis import check_synthesis, keep_bias, separate


class WienerSynthesis(eqx.Module):
    r"""The best linear reconstruction from several captures, ready to be applied.

    With the channels :math:`G_c = H_c F + N_c` (sums of captures, see
    `thincam_jax.reconstruction.synthesis`), noise spectra η_c and scene spectrum η_f,

    .. math:: \hat F = \frac{\sum_c (H_c^*/\eta_c)\, G_c}{\sum_c |H_c|^2/\eta_c + 1/\eta_f}

    minimises the expected squared error (ERRATA 3.44; the error is ∫ 1/(1/η_f + Σ|H_c|²/η_c),
    3.46). One channel is a single capture's Wiener filter; channels at several distances are the
    thesis' method A, pairs of β its method B, wavelengths its colour synthesis.

    The scene's mean is estimated from the raw captures by least squares, and its response is taken
    away before the filter and given back after, so that the prior concerns the contrast only. The
    prior's strength is found from the captures' own power. Captures at other distances than the
    largest are enlarged to its scale, and their responses with them.

    The filter treats captures as if nothing had been cropped. Where a channel keeps the bias of the
    captures, the steps at the sensor's borders are counted as noise (`spectra.crop_noise`); a
    single capture therefore loses its lowest frequencies, which synthesised ones do not.

    Differentiable in all numbers of the cameras but the distances, which set array sizes.

    **Arguments**

    - `cameras`: one for each capture, all with the same sensor, at one distance t; their
      `field_shape` is that of the result, at the object pitch p·t/d. The scene is taken as black
      outside.
    - `synthesis`: real matrix (channel × capture); a channel combines captures at one distance, and
      channels must not share noise (rows orthogonal). Default: every capture a channel.
    - `prior`: "inverse_square", η_f ∝ 1/(ρ² + ρ₀²) with ρ₀ one cycle per field, or "flat".
    """

    spectra: Complex[Array, "channel v u"]
    uniform: Float[Array, "capture y x"]
    prior: Float[Array, "v u"]
    synthesis: Float[Array, "channel capture"]
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
        each, count = cameras.cameras, cameras.count
        synthesis = separate(count) if synthesis is None else np.asarray(synthesis, dtype=float)
        capture_ratios = distance_ratios(each)
        check_synthesis(synthesis, each, capture_ratios)
        sensor = each[0].sensor.grid
        self.sensor_shape = sensor.shape
        self.field_shape = same_parity(cameras.field_shape or sensor.shape, sensor.shape)
        self.ratios = tuple(
            next(r for w, r in zip(row, capture_ratios, strict=True) if w) for row in synthesis
        )
        object_distance = cameras.object_distance
        how = {"model": cameras.model, "pixel_integration": cameras.pixel_integration}
        wavelengths = jnp.broadcast_to(jnp.asarray(cameras.wavelength), (count,))
        kernels, uniform = [], []
        for camera, w, ratio in zip(each, wavelengths, capture_ratios, strict=True):
            own = own_field(self.field_shape, ratio)
            grid = kernel_grid(sensor, own)
            h = psf(camera, wavelength=w, object_distance=object_distance, grid=grid, **how)
            kernels.append(h)
            cover = jnp.asarray(_coverage(own, self.field_shape, ratio), dtype=h.dtype)
            uniform.append(_convolve(CropConvolution(h, sensor.pitch, sensor.shape, own), cover))
        self.uniform = jnp.stack(uniform)
        self.padded = _padded(sensor.shape, self.field_shape, max(self.ratios))
        self.spectra = jnp.stack(
            [
                _channel_spectrum(*_used(row, kernels), sensor.pitch, ratio, self.padded)
                for row, ratio in zip(synthesis, self.ratios, strict=True)
            ]
        )
        self.prior = prior_spectrum(prior, Grid(self.padded, sensor.pitch), self.field_shape)
        self.synthesis = jnp.asarray(synthesis, dtype=self.uniform.dtype)
        self.weights = tuple(map(tuple, synthesis.tolist()))
        self.object_pitch = cameras.pitch

    def __call__(
        self, captures: Float[Array, "capture *batch y x"], noise_variance: Numbers
    ) -> Reconstruction:
        """The reconstruction of captures (capture, *batch, y, x).

        `noise_variance`: of a pixel, one number, one for each capture or (capture, *batch); > 0.
        """
        captures = jnp.asarray(captures, dtype=self.uniform.dtype)
        count, *batch, rows, columns = captures.shape
        if (rows, columns) != self.sensor_shape or count != self.uniform.shape[0]:
            raise ValueError(
                f"captures have shape {captures.shape}; give ({self.uniform.shape[0]}, …, "
                f"{self.sensor_shape[0]}, {self.sensor_shape[1]})"
            )
        variance = checks.positive_all("noise_variance", jnp.asarray(noise_variance), "units²")
        if variance.shape != (count, *batch)[: variance.ndim]:
            raise ValueError(
                f"noise_variance has shape {variance.shape}; give one number, {count} (one for "
                f"each capture) or {(count, *batch)}"
            )
        variance = variance.astype(captures.dtype)
        variance = variance.reshape(variance.shape + (1,) * (1 + len(batch) - variance.ndim))
        variance = jnp.broadcast_to(variance, (count, *batch)).reshape(count, -1)
        flat = captures.reshape(count, -1, rows, columns)
        images = [self._image(flat[:, i], variance[:, i]) for i in range(flat.shape[1])]
        image = jnp.stack(images).reshape(*batch, *self.field_shape)
        return Reconstruction(image, self.object_pitch, "wiener")

    @eqx.filter_jit
    def _image(self, captures: Float[Array, "capture y x"], variance: Float[Array, " capture"]):
        mean = jnp.sum(captures * self.uniform) / jnp.sum(self.uniform**2)
        contrast = captures - mean * self.uniform
        channels = jnp.tensordot(self.synthesis, contrast, axes=1)
        noise = self.synthesis**2 @ variance
        spectra = jnp.stack(
            [
                _embedded_spectrum(register(channel, ratio), self.padded)
                for channel, ratio in zip(channels, self.ratios, strict=True)
            ]
        )
        density, scene = self._noise_and_scene(spectra, noise, captures[0].size)
        gain = jnp.sum(jnp.abs(self.spectra) ** 2 / density, axis=0) + 1 / scene
        merged = jnp.sum(self.spectra.conj() * spectra / density.astype(spectra.dtype), axis=0)
        full = jnp.fft.irfft2(merged / gain.astype(merged.dtype), s=self.padded)
        return crop_field(full, self.field_shape)[::-1, ::-1] + mean

    def _noise_and_scene(self, spectra, noise, pixels: int):
        """η_c of every channel and η_f, from the noise's variance and the channels' own power."""
        # Enlarging by r keeps the noise's variance and concentrates it in 1/r² of the band.
        squared = jnp.asarray(np.square(self.ratios), dtype=noise.dtype)[:, None, None]
        density = noise[:, None, None] * squared
        periodogram = jnp.abs(spectra) ** 2 / (squared * pixels)
        expected = jnp.abs(self.spectra) ** 2 * self.prior
        inner = inner_band(self.padded, self.sensor_shape)
        # Per captured sample, though the scene may cover fewer: taken per scene sample the power is
        # higher and the result 0.3 dB worse, because what the crop hides is noise left uncounted.
        scene = self.prior * scene_power(periodogram - density, expected, inner)
        biased = keep_bias(np.asarray(self.weights))
        if biased.any():
            steps = crop_noise(periodogram, self.padded, self.sensor_shape)
            density = density + jnp.where(biased[:, None, None], steps, 0.0)
        return density, scene


class Wiener(AbstractSolver):
    """The Wiener synthesis of all captures, in closed form; see `WienerSynthesis`.

    It needs `Cameras`. Noise that the recording does not tell is estimated. To reconstruct many
    scenes with the same cameras call `prepare(cameras)` once, and its result on each.

    - `synthesis`, `prior`: as of `WienerSynthesis`.
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
        cameras = filtered_cameras(recording, self.name)
        captures = jnp.stack(recording.captures)
        variance = recording.noise_variance
        if variance is None:
            variance = estimate_variance(captures)
        return self.prepare(cameras)(captures, variance)


def filtered_cameras(recording: Recording, method: str) -> Cameras:
    """What a filter is made of, or one line on why this recording has none."""
    if not isinstance(recording.seen_by, Cameras):
        raise ValueError(
            f"method {method!r} needs cameras; with measured PSFs or operators use AdmmTV, Fista, "
            "Ridge or PoissonTV"
        )
    if recording.valid is not None:
        raise ValueError(
            f"method {method!r} cannot leave out pixels that are not valid; use AdmmTV, Fista, "
            "Ridge or PoissonTV"
        )
    return recording.seen_by


def _coverage(own_field, field_shape, ratio: float) -> np.ndarray:
    """How much of each own sample the field covers: the outermost ones lie partly outside."""
    sides = []
    for count, whole in zip(own_field, field_shape, strict=True):
        distance = np.abs(np.arange(count) - (count - 1) / 2)
        sides.append(np.clip(whole / ratio / 2 - distance + 0.5, 0.0, 1.0))
    return np.outer(*sides)


def _padded(sensor_shape, field_shape, ratio: float) -> tuple[int, int]:
    """A window in which neither the enlarged captures nor the enlarged kernels wrap round."""
    largest = registered_shape(kernel_shape(sensor_shape, own_field(field_shape, ratio)), ratio)
    return fast_shape(largest, real=True)


def _used(row: np.ndarray, kernels: list[Array]) -> tuple[Array, Array]:
    """The kernels that a channel uses, and their weights."""
    used = [(w, k) for w, k in zip(row, kernels, strict=True) if w]
    stacked = jnp.stack([k for _, k in used])
    return jnp.asarray([w for w, _ in used], dtype=stacked.dtype), stacked


@eqx.filter_jit
def _convolve(convolution: CropConvolution, field: Float[Array, "m n"]) -> Float[Array, "y x"]:
    return convolution(field)


@functools.partial(jax.jit, static_argnames=("ratio", "padded"))
def _channel_spectrum(weights, kernels, pitch, ratio: float, padded: tuple[int, int]):
    """Response of a channel on the reference scale."""
    kernel = register(jnp.tensordot(weights, kernels, axes=1), ratio)
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
    """The field around sample 0, in the order of the image."""
    rows, columns = field_shape
    rolled = jnp.roll(full, ((rows - 1) // 2, (columns - 1) // 2), axis=(0, 1))
    return rolled[:rows, :columns]
