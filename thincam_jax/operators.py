"""Linear operators of a camera, with their adjoints."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Complex, Float

from thincam_jax.grids import Grid, fast_shape


class CropConvolution(eqx.Module):
    r"""Linear convolution of a field with a PSF, cropped to the sensor; nothing wraps round.

    .. math:: g(\mathbf r_i) = \Delta^2 \sum_j h(\mathbf r_i - \mathbf r'_j) f(\mathbf r'_j)

    Sensor pixels r and field samples r′ share the pitch Δ and the optical axis as their centre;
    their numbers may differ, also in parity. The PSF must be given on `kernel_grid`, which covers
    every difference r − r′. The PSF's spectrum is computed once, here.

    **Arguments**

    - `kernel`: PSF on `kernel_grid(sensor_shape, field_shape)`.
    - `pitch`: Δ, mm.
    - `sensor_shape`, `field_shape`: (rows, columns).
    """

    spectrum: Complex[Array, "v u"]
    sensor_shape: tuple[int, int] = eqx.field(static=True)
    field_shape: tuple[int, int] = eqx.field(static=True)
    padded: tuple[int, int] = eqx.field(static=True)

    def __init__(self, kernel: Float[Array, "k l"], pitch, sensor_shape, field_shape):
        self.sensor_shape, self.field_shape = tuple(sensor_shape), tuple(field_shape)
        expected = kernel_shape(self.sensor_shape, self.field_shape)
        if kernel.shape != expected:
            raise ValueError(
                f"kernel has shape {kernel.shape}; a sensor of {self.sensor_shape} and a field of "
                f"{self.field_shape} need the PSF on {expected} samples (see kernel_grid)"
            )
        self.padded = fast_shape(expected, real=True)
        self.spectrum = _spectrum(kernel, pitch, self.padded)

    def __call__(self, field: Float[Array, "*batch m n"]) -> Float[Array, "*batch y x"]:
        """The capture of a field."""
        _require_shape("field", field, self.field_shape)
        product = jnp.fft.rfft2(field, s=self.padded) * self.spectrum
        full = jnp.fft.irfft2(product, s=self.padded)
        top, left = (n - 1 for n in self.field_shape)
        rows, columns = self.sensor_shape
        return full[..., top : top + rows, left : left + columns]

    def adjoint(self, capture: Float[Array, "*batch y x"]) -> Float[Array, "*batch m n"]:
        """The transposed operator: correlation of a capture with the PSF."""
        _require_shape("capture", capture, self.sensor_shape)
        margins = [
            (n - 1, p - s - n + 1)
            for n, s, p in zip(self.field_shape, self.sensor_shape, self.padded, strict=True)
        ]
        padded = jnp.pad(capture, [(0, 0)] * (capture.ndim - 2) + margins)
        product = jnp.fft.rfft2(padded) * self.spectrum.conj()
        full = jnp.fft.irfft2(product, s=self.padded)
        return full[..., : self.field_shape[0], : self.field_shape[1]]


def _require_shape(name: str, image: Array, shape: tuple[int, int]) -> None:
    """A larger image would be cut and a smaller one shifted, without a word."""
    if image.shape[-2:] != shape:
        raise ValueError(f"{name} has shape {image.shape}; the operator takes (…, y, x) = {shape}")


@functools.partial(jax.jit, static_argnames="padded")
def _spectrum(kernel, pitch, padded):
    return jnp.fft.rfft2(kernel * jnp.asarray(pitch, dtype=kernel.dtype) ** 2, s=padded)


def kernel_shape(sensor_shape: tuple[int, int], field_shape: tuple[int, int]) -> tuple[int, int]:
    """Samples of all differences between a sensor pixel and a field sample."""
    rows, columns = (s + f - 1 for s, f in zip(sensor_shape, field_shape, strict=True))
    return rows, columns


def kernel_grid(sensor: Grid, field_shape: tuple[int, int]) -> Grid:
    """Where `CropConvolution` wants the PSF."""
    return sensor.with_shape(kernel_shape(sensor.shape, field_shape))
