r"""The error of a sampled PSF, for masks without a short one: from finer samples of its middle.

The mask's central part is propagated with n and with m > n samples a pixel. Its PSF has errors
that fall with the samples as 1/n at worst, that of hard edges, so that (Richardson)

.. math:: \frac{\|h_n - h\|}{\|h\|} \approx \frac{1}{1 - n/m}\, \frac{\|h_n - h_m\|}{\|h_m\|}

The part's rim is an edge which the whole mask has not there, and has more of it: more is predicted
than found.

Of a mask of many terms or of rings the field is exact, and the pixels' average is sampled: on a
lattice of n points, whose error falls as 1/n, too. Some rows and columns of the sensor show that
of the whole.

Samples do not widen the window, whose band limit cuts the waves far behind a small mask: some 0.5 %
of the PSF at a Fresnel number w²/(λd) of 6, 10 % at 1. That is judged by rows and columns of the
mask's middle, propagated each by itself in a window of four times the width, too: to a factor of 3.
"""

from collections.abc import Callable, Iterator
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float

from thincam_jax._core.grids import Grid, SparseGrid
from thincam_jax._core.precision import (
    PRECISIONS,
    RESULT_ROUNDING,
    Precision,
    allow,
    cast,
    precision_of,
    squared_modulus,
)
from thincam_jax.lensless.accuracy.probe import spread
from thincam_jax.lensless.camera import LightPath
from thincam_jax.lensless.masks.base import AbstractFactoredMask, AbstractMask
from thincam_jax.lensless.method import LATTICE_POINTS, PsfMethod, psf_method
from thincam_jax.lensless.propagation.angular_spectrum import (
    PADDING,
    angular_spectrum,
    lit_mask,
    padded_shape,
    planes,
    propagate,
)
from thincam_jax.lensless.propagation.radial import PROFILE_ERROR, profile_samples, radial
from thincam_jax.lensless.propagation.separable import separable_image
from thincam_jax.lensless.resolve import samples_needed

# Of the mask's middle, along each axis; the window of a PSF, and one that cuts nothing of note.
_LINES, _PADDED = 12, (PADDING, 4 * PADDING)
# Points a pixel for its average, Fibonacci numbers.
_POINTS = (LATTICE_POINTS, 55, 144, 377)
# Pixels of the part, along a side; samples as multiples of the fewest that hold the mask.
_PART, _FINER = 48, (1, 3, 5, 7, 9)
# What the part may miss of the whole.
_MARGIN = 1.3
# Relative, of a PSF: transforms and phases add to a result's rounding.
SAMPLED_ROUNDING = {precision: 100 * rounding for precision, rounding in RESULT_ROUNDING.items()}


def sampled_errors(
    mask: AbstractMask,
    grid: Grid,
    path: LightPath,
    pixel_integration: bool,
    norm: Callable[[Float[Array, "y x"]], Float[Array, ""] | float] = jnp.linalg.norm,
) -> Iterator[tuple[PsfMethod, float]]:
    """Methods with ever more samples, and the error predicted of each.

    They are those of `angular_spectrum`, or of the exact model where the mask has one.
    `norm`: in which PSFs of the middle are compared.
    """
    if model := mask.exact_model:
        rounding = _field_rounding(mask, grid, path)
        exact = PsfMethod(model, precision_of(grid.pitch), pixel_integration)
        if model == "radial":
            rounding += PROFILE_ERROR
            many = replace(exact, nodes=LATTICE_POINTS) if pixel_integration else exact
            exact = replace(exact, oversampling=profile_samples(mask, grid, path, many))
        if not pixel_integration:
            yield exact, rounding
            return
        methods = [replace(exact, nodes=n) for n in _POINTS]
        middle = grid.with_shape((min(grid.shape[0], _PART), min(grid.shape[1], _PART)))
        points = _spread_pixels(grid) if norm is jnp.linalg.norm else middle
        for method, off in _richardson(methods, lambda m: _field(mask, points, path, m), norm):
            yield method, off + rounding
        return
    fewest = samples_needed(mask, grid, path, "angular_spectrum")
    fewest = max(fewest, 3 if pixel_integration else 1)
    methods = [
        psf_method(
            mask, grid, PsfMethod("angular_spectrum", oversampling=fewest * n), pixel_integration
        )
        for n in _FINER
    ]
    rounding = SAMPLED_ROUNDING[precision_of(grid.pitch)]
    cut = float(_cut_by_window(mask, grid, path, methods[0]))
    for method, off in _richardson(methods, lambda m: _central(mask, grid, path, m), norm):
        yield method, off + cut + rounding


def _richardson(
    methods: list[PsfMethod],
    psf_of: Callable[[PsfMethod], Float[Array, "y x"]],
    norm: Callable[[Float[Array, "y x"]], Float[Array, ""] | float],
) -> Iterator[tuple[PsfMethod, float]]:
    """All settings but the finest, with the error predicted from the PSF of the next."""
    before = psf_of(methods[0])
    for method, finer in zip(methods, methods[1:], strict=False):
        after = psf_of(finer)
        size = float(norm(after))
        off = float(norm(before - after)) / size if size > 0 else 0.0  # a dark scene
        share = (method.nodes or method.samples) / (finer.nodes or finer.samples)
        yield method, _MARGIN * off / (1 - share)
        before = after


def _field_rounding(mask: AbstractMask, grid: Grid, path: LightPath) -> float:
    """Relative error that the precision leaves in the field's square, from some of its pixels."""
    if precision_of(grid.pitch) == "float64":
        return SAMPLED_ROUNDING["float64"]
    points, method = _spread_pixels(grid), PsfMethod("separable")
    found: dict[Precision, np.ndarray] = {}
    with allow("float64", mask, points, path):
        for kind in PRECISIONS:
            found[kind] = np.asarray(_field(*cast((mask, points, path), kind), method), float)
    size = float(np.linalg.norm(found["float64"])) or 1.0
    return _MARGIN * float(np.linalg.norm(found["float32"] - found["float64"])) / size


def _spread_pixels(grid: Grid) -> SparseGrid:
    """Some rows and columns from all over the sensor."""
    rows, columns = (spread(count, _PART) for count in grid.shape)
    return SparseGrid(rows, columns, grid.pitch)


@jax.jit(static_argnames="method")
def _field(mask: AbstractMask, grid: Grid, path: LightPath, method: PsfMethod):
    if not isinstance(mask, AbstractFactoredMask):
        average = method.nodes is not None
        return radial(mask, grid, path, PsfMethod("radial", None, average, nodes=method.nodes))
    return separable_image(mask, grid, path, nodes=method.nodes)


@jax.jit(static_argnames="method")
def _cut_by_window(mask: AbstractMask, grid: Grid, path: LightPath, method: PsfMethod):
    """Relative difference of lines of the mask's middle from those of a wider window."""
    plane, sensor = planes(grid, method)
    strip, squares = min(_PART * method.samples, *plane.shape), jnp.zeros((), grid.pitch.dtype)
    for axis in (0, 1):
        shape = (strip, plane.shape[1]) if axis else (plane.shape[0], strip)
        field = lit_mask(mask, plane.with_shape(shape), path)
        lines = (field if axis else field.T)[:: max(1, strip // _LINES)]
        narrow, wide = (_lines(lines, sensor.pitch, path, sensor.shape[axis], p) for p in _PADDED)
        size = jnp.linalg.norm(wide)
        off = jnp.linalg.norm(narrow - wide) / jnp.where(size > 0, size, 1.0)
        squares += jnp.where(size > 0, off, 0.0) ** 2
    return jnp.sqrt(squares)


@jax.jit(static_argnames=("count", "padding"))
def _lines(fields: Complex[Array, "line m"], pitch, path: LightPath, count: int, padding: float):
    """Irradiance on the middle `count` samples of each, in a window padded as the PSF's."""
    samples = fields.shape[1]
    window = padded_shape((1, samples), (0, count), padding)[1]

    def one(field):
        ended = propagate(jnp.pad(field, (0, window - samples))[None], pitch, path)
        ended = jnp.roll(ended, (count - samples) // 2, axis=1)[0, :count]
        return squared_modulus(ended)

    return jax.vmap(one)(fields)


class _Part(AbstractMask):
    """The part of a mask that a plane of given sides around the axis holds."""

    whole: AbstractMask
    sides: tuple[Float[Array, ""], Float[Array, ""]]
    centre: Float[Array, "2"]

    @property
    def extent(self):
        return self.sides

    def sample(self, grid, wavelength=None):
        return self.whole.sample(grid, wavelength)


@jax.jit(static_argnames="method")
def _central(mask: AbstractMask, grid: Grid, path: LightPath, method: PsfMethod):
    """The PSF of the middle of the mask on the middle of the sensor."""
    rows, columns = (min(_PART, n) for n in method.mask_shape or grid.shape)
    method = replace(method, mask_shape=(rows, columns))
    sides = rows * grid.pitch, columns * grid.pitch
    part = _Part(whole=mask, sides=sides, centre=jnp.zeros_like(mask.centre))
    return angular_spectrum(part, grid.with_shape((_PART, _PART)), path, method)
