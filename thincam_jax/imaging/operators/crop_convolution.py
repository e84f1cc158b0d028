"""Linear convolution with a PSF, cropped to the sensor."""

import functools
import math
from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Complex, Float, Num

from thincam_jax._core import checks
from thincam_jax._core.checks import Number, Shape
from thincam_jax._core.grids import Grid, fast_shape
from thincam_jax._core.memory import Cost
from thincam_jax._core.precision import squared_modulus
from thincam_jax.imaging.operators.base import AbstractOperator


class CropConvolution(AbstractOperator):
    r"""Linear convolution of a field with a PSF, cropped to the sensor; nothing wraps round.

    .. math:: g(\mathbf r_i) = \Delta^2 \sum_p \sum_j
        h_p(\mathbf r_i - \mathbf r'_j) f_p(\mathbf r'_j)

    Sensor pixels r and field samples r′ share the pitch Δ and the optical axis as their centre;
    their numbers may differ, also in parity. The sum over p is over planes at different depths, or
    wavelengths. The spectrum of the PSF is computed once, here.

    **Arguments**

    - `kernel`: PSF (*channel, *summed, k, l), best on `kernel_grid(sensor_shape, field_shape)`,
      which covers every difference r − r′. A larger one is cut to that, a smaller one (a measured
      PSF) is zero outside; its centre is the centre of its samples, so their number must be
      that of `kernel_shape` or differ from it by even numbers.
    - `pitch`: Δ, mm.
    - `sensor_shape`, `field_shape`: (rows, columns).
    - `summed`: number of the kernel's axes before its last two that are summed over. Those before
      them are channels: each of the field's convolved with its own. A channel axis of length 1
      is one PSF for any number of channels.
    - `window`: shape of the transforms, at least `window_shape(…)`, the default.

    Field and sensor lie in the middle of the window: their first samples at `field_corner` and
    `sensor_corner`.
    """

    spectrum: Complex[Array, "*planes v u"]
    sensor_shape: tuple[int, int] = eqx.field(static=True)
    field_shape: tuple[int, int] = eqx.field(static=True)
    window: tuple[int, int] = eqx.field(static=True)
    summed: int = eqx.field(static=True)

    def __init__(
        self,
        kernel: Float[Array, "*planes k l"],
        pitch: Number,
        sensor_shape: Shape,
        field_shape: Shape,
        *,
        summed: int = 0,
        window: tuple[int, int] | None = None,
    ):
        self.sensor_shape = checks.shape2d("sensor_shape", sensor_shape)
        self.field_shape = checks.shape2d("field_shape", field_shape)
        kernel = checks.as_array(checks.array("kernel", kernel), floating=True)
        pitch = checks.positive("pitch", pitch, "mm")
        if kernel.ndim < 2:
            raise ValueError(f"kernel has shape {kernel.shape}; give rows and columns of a PSF")
        self.summed = checks.whole("summed", summed, 0, kernel.ndim - 2)
        kernel = _fit(kernel, kernel_shape(self.sensor_shape, self.field_shape))
        smallest = window_shape(self.sensor_shape, self.field_shape, kernel.shape[-2:])
        self.window = smallest if window is None else checks.shape2d("window", window)
        if any(w < s for w, s in zip(self.window, smallest, strict=True)):
            raise ValueError(
                f"window is {self.window}; in fewer than {smallest} samples light wraps round"
            )
        corners = zip(self.sensor_corner, self.field_corner, strict=True)
        sizes = zip(kernel.shape[-2:], self.sensor_shape, self.field_shape, strict=True)
        shift = [
            s0 - f0 - (k - 1 - s + f) // 2
            for (s0, f0), (k, s, f) in zip(corners, sizes, strict=True)
        ]
        self.spectrum = _spectrum(kernel, pitch, self.window, (shift[0], shift[1]))

    @property
    def in_shape(self) -> tuple[int, ...]:
        return (*self.spectrum.shape[:-2], *self.field_shape)

    @property
    def out_shape(self) -> tuple[int, ...]:
        leading = self.spectrum.shape[:-2]
        return (*leading[: len(leading) - self.summed], *self.sensor_shape)

    @property
    def field_corner(self) -> tuple[int, int]:
        """Window sample of the field's first one."""
        return middle_corner(self.field_shape, self.window)

    @property
    def sensor_corner(self) -> tuple[int, int]:
        """Window sample of the sensor's first pixel."""
        return middle_corner(self.sensor_shape, self.window)

    def __call__(self, field: Float[Array, "*batch m n"]) -> Float[Array, "*channels y x"]:
        """The capture of a field (*batch, *channel, *summed, m, n)."""
        _require_shape("field", field, self.in_shape, self.summed)
        return _captured(self, field)

    def adjoint(self, capture: Float[Array, "*channels y x"]) -> Float[Array, "*batch m n"]:
        """The transposed operator: correlation of a capture with the PSF."""
        _require_shape("capture", capture, self.out_shape, 0)
        return _back_projected(self, capture)

    def mean_power(self) -> Float[Array, ""]:
        """Mean of |H|² over all frequencies, channels and planes: Σh² of the PSF without the crop.

        Pixels from which no light reaches the sensor count like the others.
        """
        return jnp.mean(plane_mean(squared_modulus(self.spectrum), self.window[1]))

    def with_channels_and_planes(self) -> "CropConvolution":
        """This map on images (…, channel, plane, m, n), its planes summed."""
        leading = self.spectrum.ndim - 2
        if leading == 2 and self.summed == 1:
            return self
        if leading > 2 or self.summed > 1 or leading - self.summed > 1:
            raise ValueError(
                f"a convolution has {leading} axes before its rows, {self.summed} of them summed; "
                "give kernels (channel, plane, k, l), with the planes summed"
            )
        planes = self.spectrum.shape[-3] if self.summed else 1
        spectrum = self.spectrum.reshape(-1, planes, *self.spectrum.shape[-2:])
        other = eqx.tree_at(lambda o: o.spectrum, self, spectrum)
        object.__setattr__(other, "summed", 1)  # of the copy: a static field is no leaf
        return other

    def combine(self, fields: Complex[Array, "*batch v u"]) -> Complex[Array, "*channels v u"]:
        """Spectrum of the whole image on the window, from the fields' spectra."""
        product = fields * self.spectrum
        return jnp.sum(product, axis=tuple(range(-2 - self.summed, -2)))

    def spread(self, capture: Complex[Array, "*channels v u"]) -> Complex[Array, "*batch v u"]:
        """The adjoint of `combine`."""
        rows, columns = capture.shape[-2:]
        leading = capture.shape[:-2] + (1,) * self.summed
        # A gradient keeps the factor and the capture: its conjugate would be one more copy.
        return (capture.conj().reshape(*leading, rows, columns) * self.spectrum).conj()


# Compiled, so that each is one program also when called eagerly.
@jax.jit
def _captured(operator: CropConvolution, field):
    # The field's place in the window only adds a phase, which cutting at the corner undoes.
    padded = place(field, operator.field_corner, operator.window)
    image = jnp.fft.irfft2(operator.combine(jnp.fft.rfft2(padded)), s=operator.window)
    return cut(image, operator.sensor_corner, operator.sensor_shape)


@jax.jit
def _back_projected(operator: CropConvolution, capture):
    padded = place(capture, operator.sensor_corner, operator.window)
    image = jnp.fft.irfft2(operator.spread(jnp.fft.rfft2(padded)), s=operator.window)
    return cut(image, operator.field_corner, operator.field_shape)


@functools.partial(jax.jit, static_argnames="columns")
def plane_mean(power: Float[Array, "*planes v u"], columns: int) -> Float[Array, "*planes"]:
    """Mean over all frequencies, given on the half plane of a real transform."""
    # The half plane leaves out the mirror images of its inner columns.
    whole = 2 * jnp.sum(power, axis=-1) - power[..., 0]
    if columns % 2 == 0:
        whole = whole - power[..., -1]
    return jnp.mean(whole, axis=-1) / columns


def place(
    image: Num[Array, "*batch y x"], corner: Sequence[int], window: Sequence[int]
) -> Num[Array, "*batch v u"]:
    """An image on a window of zeros."""
    sizes = zip(corner, image.shape[-2:], window, strict=True)
    margins = [(c, w - n - c) for c, n, w in sizes]
    return jnp.pad(image, [(0, 0)] * (image.ndim - 2) + margins)


def cut(
    window: Num[Array, "*batch v u"], corner: Sequence[int], shape: Sequence[int]
) -> Num[Array, "*batch y x"]:
    """The part of a window that starts at a corner."""
    (top, left), (rows, columns) = corner, shape
    return window[..., top : top + rows, left : left + columns]


def middle_corner(shape: Sequence[int], window: Sequence[int]) -> tuple[int, int]:
    """Offset of a centred crop."""
    rows, columns = ((w - n) // 2 for n, w in zip(shape, window, strict=True))
    return rows, columns


def _fit(kernel: Float[Array, "*planes k l"], shape: tuple[int, int]):
    """A kernel cut to all differences of sensor and field; a smaller one is unchanged."""
    given = kernel.shape[-2:]
    if any((n - s) % 2 for n, s in zip(given, shape, strict=True)):
        raise ValueError(
            f"kernel has shape {given}; its centre fits the sensor and the field if it has "
            f"{shape} samples (see kernel_grid) or an even number more or less"
        )
    surplus = [max(0, (n - s) // 2) for n, s in zip(given, shape, strict=True)]
    sizes = [min(n, s) for n, s in zip(given, shape, strict=True)]
    return cut(kernel, surplus, sizes)


def _require_shape(name: str, image: Array, shape: tuple[int, ...], summed: int) -> None:
    """Require the shape of an image that would otherwise be cut, shifted or repeated silently.

    A channel axis of length 1 is one PSF for any number of channels.
    """
    given = image.shape[max(0, image.ndim - len(shape)) :]
    exact = 2 + summed
    channels = zip(given[:-exact], shape[:-exact], strict=False)
    fits = len(given) == len(shape) and all(s in (1, n) for n, s in channels)
    if not fits or given[-exact:] != shape[-exact:]:
        axes = ", ".join(["…", *["plane"] * (len(shape) - 2), "y", "x"])
        raise ValueError(f"{name} has shape {image.shape}; the operator takes ({axes}) = {shape}")


@functools.partial(jax.jit, static_argnames=("window", "shift"))
def _spectrum(kernel, pitch, window, shift):
    scaled = kernel * jnp.asarray(pitch, dtype=kernel.dtype) ** 2
    placed = jnp.roll(place(scaled, (0, 0), window), shift, axis=(-2, -1))
    return jnp.fft.rfft2(placed)


def centred_crop(
    image: Float[Array, "*batch y x"], shape: Sequence[int]
) -> Float[Array, "*batch v u"]:
    """The central part of an image, of this shape."""
    corner = [(n - s) // 2 for n, s in zip(image.shape[-2:], shape, strict=True)]
    return cut(image, corner, shape)


def kernel_shape(sensor_shape: tuple[int, int], field_shape: tuple[int, int]) -> tuple[int, int]:
    """Samples of all differences between a sensor pixel and a field sample."""
    rows, columns = (s + f - 1 for s, f in zip(sensor_shape, field_shape, strict=True))
    return rows, columns


def window_shape(
    sensor_shape: tuple[int, int], field_shape: tuple[int, int], kernel: tuple[int, ...]
) -> tuple[int, int]:
    """The fastest window in which a kernel of this shape does not wrap onto the sensor.

    A difference r − r′ outside of the kernel must not alias into it, so that half of all
    differences and half of the kernel, of what reaches the sensor, have to fit side by side.
    """
    sizes = zip(sensor_shape, field_shape, kernel, strict=True)
    reach = ((s, f, min(k, s + f - 1)) for s, f, k in sizes)
    rows, columns = (max(s, f, math.ceil((s + f + k - 2) / 2)) for s, f, k in reach)
    return fast_shape((rows, columns), real=True)


def kernel_grid(sensor: Grid, field_shape: tuple[int, int]) -> Grid:
    """The grid of the PSF for `CropConvolution`."""
    return sensor.with_shape(kernel_shape(sensor.shape, field_shape))


def convolution_cost(
    sensor_shape: tuple[int, int], field_shape: tuple[int, int], images: int, itemsize: int
) -> Cost:
    """Cost of a `CropConvolution` of `images` fields with a PSF that is given."""
    whole = kernel_shape(sensor_shape, field_shape)
    window = math.prod(window_shape(sensor_shape, field_shape, whole))
    transforms = 2 * images + 1
    flops = transforms * 2.5 * window * math.log2(window + 1) + 6 * images * window
    return Cost(flops, int(itemsize * window * (3 * images + 4)))
