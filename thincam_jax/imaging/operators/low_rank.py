"""A camera whose PSF changes slowly over the field."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy
from jaxtyping import Array, Float, PyTree

from thincam_jax._core import checks
from thincam_jax._core.checks import Number, Numbers, Shape
from thincam_jax._core.precision import product
from thincam_jax.imaging.operators.base import AbstractOperator, Shapes, real_numbers, require_shape
from thincam_jax.imaging.operators.crop_convolution import (
    CropConvolution,
    cut,
    kernel_shape,
    place,
    plane_mean,
)

# Of the power method.
POSITIVE_ITERATIONS = 12


class LowRank(AbstractOperator):
    r"""A sum of convolutions of the field, each weighted by a map of its own.

    .. math:: g = \sum_r p_r * (w_r f), \qquad h(\mathbf x; \mathbf u) = \sum_r
        w_r(\mathbf u)\, p_r(\mathbf x - \mathbf u)

    (Flicker and Rigaut, J. Opt. Soc. Am. A 22, 504, 2005). `low_rank_psf` makes it of measured
    PSFs.

    - `weights`: w_r, (r, m, n). `convolution`: with all p_r, summed over them.
    """

    weights: Float[Array, "r m n"]
    convolution: CropConvolution

    @property
    def in_shape(self) -> tuple[int, ...]:
        return self.weights.shape[1:]

    @property
    def out_shape(self) -> tuple[int, ...]:
        return self.convolution.sensor_shape

    def __call__(self, image: Float[Array, "..."]) -> Float[Array, "..."]:
        require_shape("image", image, self.in_shape)
        return _captured(self, image)

    def adjoint(self, capture: Float[Array, "..."]) -> Float[Array, "..."]:
        require_shape("capture", capture, self.out_shape)
        return _back_projected(self, capture)

    def mean_power(self) -> Float[Array, ""]:
        """Mean over the field of Σh² of its PSF without the crop, as of `CropConvolution`."""
        return _mean_power(self)

    def _norm(self, iterations, key, dtype):
        # PSFs are positive, so that a positive start image is near the top singular vector.
        return super()._norm(min(iterations, POSITIVE_ITERATIONS), key, dtype)


class Resampled(AbstractOperator):
    """An operator A of an image that is interpolated first: A (Y f Xᵀ).

    - `operator`: A. `rows`, `columns`: Y and X.
    """

    operator: AbstractOperator
    rows: Float[Array, "i m"]
    columns: Float[Array, "j n"]

    @property
    def in_shape(self) -> tuple[int, ...]:
        return self.rows.shape[1], self.columns.shape[1]

    @property
    def out_shape(self) -> Shapes:
        return self.operator.out_shape

    def __call__(self, image: Float[Array, "..."]) -> PyTree[Float[Array, "..."]]:
        require_shape("image", image, self.in_shape)
        return self.operator(product(product(self.rows, image), self.columns.T))

    def adjoint(self, capture: PyTree[Float[Array, "..."]]) -> Float[Array, "..."]:
        return product(product(self.rows.T, self.operator.adjoint(capture)), self.columns)


# Term by term: transforms of one window stay in a processor's cache, which is twice as fast.
@jax.jit
def _captured(operator: LowRank, image: Float[Array, "*batch m n"]):
    convolution = operator.convolution

    def add(total, term):
        weight, spectrum = term
        field = place(image * weight, convolution.field_corner, convolution.window)
        return total + jnp.fft.rfft2(field) * spectrum, None

    spectra = convolution.spectrum
    shape = (*image.shape[:-2], *spectra.shape[1:])
    dark = jnp.zeros(shape, np.promote_types(image.dtype, spectra.dtype))
    total, _ = jax.lax.scan(add, dark, (operator.weights, spectra))
    whole = jnp.fft.irfft2(total, s=convolution.window)
    return cut(whole, convolution.sensor_corner, convolution.sensor_shape)


@jax.jit
def _back_projected(operator: LowRank, capture: Float[Array, "*batch y x"]):
    convolution = operator.convolution
    placed = place(capture, convolution.sensor_corner, convolution.window)
    light = jnp.fft.rfft2(placed)

    def add(total, term):
        weight, spectrum = term
        whole = jnp.fft.irfft2(light * spectrum.conj(), s=convolution.window)
        return total + weight * cut(whole, convolution.field_corner, operator.in_shape), None

    shape = (*capture.shape[:-2], *operator.in_shape)
    dark = jnp.zeros(shape, np.promote_types(capture.dtype, operator.weights.dtype))
    return jax.lax.scan(add, dark, (operator.weights, convolution.spectrum))[0]


@jax.jit
def _mean_power(operator: LowRank):
    """Σ_rs ⟨w_r w_s⟩ ⟨p_r, p_s⟩."""
    maps = operator.weights.reshape(len(operator.weights), -1)
    spectra, columns = operator.convolution.spectrum, operator.convolution.window[1]
    joined = product(maps, maps.T) / maps.shape[1]
    mixed = jnp.tensordot(joined.astype(spectra.dtype), spectra, 1, precision="highest")
    return jnp.sum(plane_mean((spectra.conj() * mixed).real, columns))


class LowRankFit(eqx.Module):
    """An operator for a grid of PSFs, and its errors.

    - `truncation_error`: error of the PSFs at the grid's points, ‖difference‖₂/‖PSFs‖₂.
    - `interpolation_error`: an estimate of the same between the points. Of measured PSFs a quarter
      of the error where every other point is omitted and interpolated, infinite for grids too small
      for it; of a camera's field, what the polynomials leave of the finest zones' phase, and
      what few nodes leave of averages over pixels.
    """

    operator: LowRank
    truncation_error: float
    interpolation_error: float


def low_rank_psf(
    psfs: Numbers,
    pitch: Number,
    sensor_shape: Shape,
    field_shape: Shape,
    *,
    tolerance: float,
    positions: tuple[Numbers, Numbers] | None = None,
) -> LowRankFit:
    """The sum of fewest convolutions whose PSFs are within a tolerance of a measured grid of them.

    **Arguments**

    - `psfs`: (grid y, grid x, k, l): PSFs of a grid of points, each centred on the field sample's
      position on the sensor: its pixel k//2, l//2.
    - `pitch`, `sensor_shape`, `field_shape`: arguments of `CropConvolution`. Where k or l does not
      fit them, a row or column of zeros is appended.
    - `tolerance`: error of the truncation that is allowed, relative L2 over the whole grid.
    - `positions`: rows and columns of the field that the points lie on, increasing, also between
      its samples; by default spread evenly from the field's first to its last. Beyond the
      outermost points their PSFs are kept.

    The p_r are the singular vectors of the PSFs; their weights are interpolated linearly.

    **Errors**: ValueError for a grid of fewer than 2×2 points, PSFs that are all zero, positions
    that are not increasing, and a tolerance that is not between 0 and 1.
    """
    grid = real_numbers("psfs", psfs)
    field_shape = checks.shape2d("field_shape", field_shape)
    tolerance = float(checks.positive("tolerance", tolerance, "parts of one"))
    if tolerance >= 1:
        raise ValueError(f"tolerance = {tolerance:g} is relative: give less than 1 (0.01 is 1 %)")
    if grid.ndim != 4 or min(grid.shape[:2]) < 2:
        raise ValueError(
            f"psfs has shape {grid.shape}; give (grid y, grid x, k, l) with at least 2×2 points"
        )
    points, sensor_shape = grid.shape[:2], checks.shape2d("sensor_shape", sensor_shape)
    places = _places(positions, points, field_shape)
    sizes = zip(grid.shape[2:], kernel_shape(sensor_shape, field_shape), strict=True)
    grid = jnp.pad(grid, ((0, 0), (0, 0), *((0, (k - n) % 2) for k, n in sizes)))
    maps, kernels, error = principal_psfs(grid, tolerance)
    weights = _interpolated(maps, places, [np.arange(n) for n in field_shape])
    estimate = np.inf
    if all(n >= 3 and n % 2 for n in points):
        between = _interpolated(maps[::2, ::2], [p[::2] for p in places], places)
        # The p_r are orthonormal, so that lengths of weights are those of PSFs.
        difference = np.linalg.norm(between - np.moveaxis(maps, -1, 0))
        estimate = float(difference / np.linalg.norm(grid)) / 4
    convolution = CropConvolution(kernels, pitch, sensor_shape, field_shape, summed=1)
    return LowRankFit(LowRank(jnp.asarray(weights, grid.dtype), convolution), error, estimate)


def principal_psfs(
    grid: Float[Array, "y x k l"], tolerance: float
) -> tuple[Float[np.ndarray, "y x r"], Float[Array, "r k l"], float]:
    """Weights at a grid's points, the fewest orthonormal PSFs, and the relative error they leave.

    From the PSFs' products with each other, whose rounding ends at errors of some 1e-8.

    **Errors**: ValueError for PSFs that are all zero.
    """
    points, size = grid.shape[:2], grid.shape[2:]
    flat = np.asarray(grid, float).reshape(points[0] * points[1], -1)
    powers, left = np.linalg.eigh(flat @ flat.T)
    values, left = np.sqrt(np.maximum(powers[::-1], 0)), left[:, ::-1]
    whole = np.linalg.norm(values)
    if whole == 0:
        raise ValueError("psfs are zero everywhere; give PSFs with light")
    # Relative error of the first 0, 1, 2, … terms.
    tails = np.sqrt(np.append(np.cumsum(values[::-1] ** 2)[::-1], 0)) / whole
    rank = max(1, int(np.argmax(tails <= tolerance)))
    maps = (left[:, :rank] * values[:rank]).reshape(*points, rank)
    right = left[:, :rank].T @ flat / np.maximum(values[:rank, None], np.finfo(float).tiny)
    kernels = jnp.asarray(right.reshape(rank, *size), grid.dtype)
    return maps, kernels, float(tails[rank])


def _places(positions, points, field_shape) -> list[np.ndarray]:
    """Rows and columns of the grid's points on the field."""
    if positions is None:
        if min(field_shape) < 2:
            raise ValueError(
                f"field_shape = {field_shape} has one line for several PSFs; give 2×2 or more"
            )
        pairs = zip(field_shape, points, strict=True)
        return [np.linspace(0, n - 1, count) for n, count in pairs]
    both = positions if isinstance(positions, tuple | list) else [positions]
    places = [np.asarray(real_numbers("positions", p), float) for p in both]
    if [p.shape for p in places] != [(n,) for n in points] or any(
        not (np.diff(p) > 0).all() for p in places
    ):
        raise ValueError(
            f"positions have shapes {[p.shape for p in places]}; give {points[0]} rows and "
            f"{points[1]} columns of the field, increasing"
        )
    return places


def _interpolated(maps, places, to) -> np.ndarray:
    """Maps (grid y, grid x, r) at `places`, on the rows and columns `to`: (r, rows, columns)."""
    inside = [np.clip(t, p[0], p[-1]) for t, p in zip(to, places, strict=True)]
    y, x = np.meshgrid(*inside, indexing="ij")
    found = scipy.interpolate.RegularGridInterpolator(places, maps)(np.stack([y, x], axis=-1))
    return np.moveaxis(found, -1, 0)
