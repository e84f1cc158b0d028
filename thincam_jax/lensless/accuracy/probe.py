r"""PSF of each model on a few rows and columns, and its distance from the best model's.

With real factors R (term × row) and C (term × column) an image is RᵀC and
:math:`\|R^TC\|_F^2 = \sum (RR^T)\circ(CC^T)`: the error of a whole PSF costs what its axes cost.
"""

import functools
import math
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Complex, Float, Int

from thincam_jax._core.grids import (
    Grid,
    SparseGrid,
    block_mean,
    centred_frequencies,
    centred_indices,
)
from thincam_jax._core.precision import (
    PRECISIONS,
    Precision,
    allow,
    as_complex,
    cast,
    squared_modulus,
    turn_phasor,
)
from thincam_jax.lensless.camera import LightPath
from thincam_jax.lensless.masks.base import AbstractFactoredMask, pairs
from thincam_jax.lensless.method import PIXEL_NODES, Model, PsfMethod, pixel_nodes
from thincam_jax.lensless.propagation.angular_spectrum import (
    lit_mask,
    padded_shape,
    planes,
    propagate,
    spherical_wave,
)
from thincam_jax.lensless.propagation.closed_form import in_focus
from thincam_jax.lensless.propagation.rayleigh_sommerfeld import rayleigh_sommerfeld_field
from thincam_jax.lensless.propagation.separable import SeparableSum
from thincam_jax.lensless.psf import closed_terms

# Rows and columns that are looked at. All sizes have this many, so that nothing recompiles.
COUNT = 256
# Share of them that may lie at the shadow's two edges, where the fields change fastest.
_AT_EDGES = 0.5


def chosen(
    count: int, edges: tuple[float, float], zone: float, seed: int
) -> tuple[Int[np.ndarray, " chosen"], Float[np.ndarray, " chosen"]]:
    """Indices out of `count`, and how many of them each stands for.

    Everything if it is few enough; else a stratified random choice that is denser within `zone`
    (in samples) of the `edges` (indices, which may lie outside). Filled up with weight zero.
    """
    if count <= COUNT:
        filled = np.zeros(COUNT, int)
        filled[:count] = np.arange(count)
        return filled, (np.arange(COUNT) < count).astype(float)
    indices = np.arange(count)
    distance = np.min([np.abs(indices - edge) for edge in edges], axis=0)
    near = distance <= max(zone, 4.0)
    density = np.full(count, COUNT * (1 - _AT_EDGES) / count)
    if near.any():
        density[near] = np.minimum(1.0, density[near] + COUNT * _AT_EDGES / near.sum())
    density *= COUNT / density.sum()
    density = np.minimum(density, 1.0)
    # One of each stratum of equal total density.
    total = np.cumsum(density)
    offsets = np.random.default_rng(seed).uniform(size=COUNT)
    strata = (np.arange(COUNT) + offsets) * total[-1] / COUNT
    found = np.minimum(np.searchsorted(total, strata), count - 1)
    return found, total[-1] / (COUNT * density[found])


@jax.jit(static_argnames=("shape", "method"))
def angular_spectrum_terms(
    mask: AbstractFactoredMask,
    points: SparseGrid,
    path: LightPath,
    shape: tuple[int, int],
    method: PsfMethod,
) -> SeparableSum:
    """The PSF of `angular_spectrum` at some rows and columns of a grid of `shape`, as a product.

    In the Fresnel approximation the field of a separable mask stays separable, so that a sampled
    propagation is, but for the cross term of the exact phase, one along each axis: the same
    samples, window, band limit and rounding.
    """
    terms = mask.terms(path.wavelength)
    lower, upper, weights = pairs(terms.coefficients)
    plane, sensor = planes(Grid(shape, points.pitch), method)
    half = method.samples // 2 if method.pixel_integration else 0
    factors = []
    both = (terms.rows, points.row_indices), (terms.columns, points.column_indices)
    for axis, (along, indices) in enumerate(both):
        samples, line = plane.shape[axis], Grid((1, plane.shape[axis]), plane.pitch)
        values = along.samples(line.x - mask.centre[axis], line.pitch)
        lit = values * spherical_wave(line, path)
        # Sensor samples of the chosen pixels, counted from the axis.
        fine = indices[:, None] * method.samples + jnp.arange(-half, half + 1, dtype=indices.dtype)
        across = sensor.shape[axis]
        size = padded_shape((samples, samples), (across, across), 2.0)[0]
        fields = _by_transform(lit, plane.pitch, path, size, fine.ravel())
        fields = fields.reshape(-1, *fine.shape)
        fields = fields * as_complex(jnp.sqrt(path.magnification))
        factors.append(jnp.mean(fields[lower, :] * jnp.conj(fields[upper, :]), axis=-1))
    return SeparableSum(weights[:, None] * factors[0], factors[1], points)


def _by_transform(lit, pitch, path: LightPath, size: int, fine) -> Complex[Array, "order n"]:
    """Propagated on a window of `size` samples, taken where `fine` samples lie."""
    count = lit.shape[-1]
    padded = jnp.pad(lit, ((0, 0), (0, size - count)))
    window = jax.vmap(lambda line: propagate(line[None], pitch, path)[0])(padded)
    position = jnp.round(fine + (count - 1) / 2).astype(jnp.int32) % size
    return window[:, position]


@functools.partial(jax.jit, static_argnames=("samples", "axis"))
def fine_fields(
    mask: AbstractFactoredMask,
    path: LightPath,
    reach: Float[Array, ""],
    exact: Bool[Array, ""],
    samples: int,
    axis: int = 1,
) -> Complex[Array, "order n"]:
    r"""Fields of the terms on a line along x (or y, axis 0), finely sampled, over ±`reach`.

    `exact` takes the exact phases of the spherical wave and of the propagation, which Fresnel's
    approximation replaces by :math:`\pi\xi^2/(\lambda t)` and :math:`-\pi\lambda d u^2`; the
    difference of the two is what the approximation costs, while the sampling is common to both.
    """
    terms = mask.terms(path.wavelength)
    factors = terms.columns if axis else terms.rows
    pitch = 4 * reach / samples  # as much again on both sides, so that nothing wraps round
    x = centred_indices(samples, pitch.dtype) * pitch
    values = factors.samples(x, pitch)
    parabolic = turn_phasor(x**2 / (2 * path.wavelength * path.object_distance))
    wave = jnp.where(exact, spherical_wave(Grid((1, samples), pitch), path)[0], parabolic)
    u = jnp.fft.ifftshift(centred_frequencies(samples, pitch))
    s = (path.wavelength * u) ** 2
    carried = s < 1
    bent = 1 + jnp.where(exact, jnp.sqrt(jnp.where(carried, 1 - s, 1.0)), 1.0)
    turns = -(path.distance / path.wavelength) * jnp.where(carried, s, 0.0) / bent
    transfer = jnp.where(carried, turn_phasor(turns), 0.0)
    fields = jnp.fft.ifft(jnp.fft.fft(values * wave, axis=-1) * transfer, axis=-1)
    return fields[:, samples // 4 : samples - samples // 4]


# Samples of the line on which the exact phases are compared with Fresnel's.
_FINE_SAMPLES = 2**16
# Nodes of the reference's pixel average: few different ones, each is compiled.
_NODES = (2 * PIXEL_NODES, 128, 320, 960)
# Samples across a pixel for its average there.
_IN_PIXEL = 33
# Rows and columns of pixels at which the direct sum is tried.
_FEW = 14
# What a product of two float32 factors and the sum of a few leave, relative to the image.
_PRODUCT_ROUNDING: dict[Precision, float] = {"float32": 2e-7, "float64": 5e-16}
_EPSILON: dict[Precision, float] = {"float32": 2.0**-24, "float64": 2.0**-53}


# Along y and along x: indices, and what each stands for.
Both = tuple[Float[np.ndarray, " row"], Float[np.ndarray, " column"]]


@dataclass(frozen=True)
class Numbers:
    """Sizes of the effects of a camera.

    - `epsilon`: |k|ε of the highest order k.
    - `first_order`, `second_order`: phases kε·kβ(w/2)² and (kε)²·kβ(w/2)² at the edge, rad.
    - `edge_zone`: √(λd/M), mm.
    - `largest_phase`: largest phase of the zones and of the edge waves on the sensor, rad.
    """

    epsilon: float
    first_order: float
    second_order: float
    edge_zone: float
    largest_phase: float


def lines_of(mask: AbstractFactoredMask, grid: Grid, path: LightPath) -> tuple[Both, Both]:
    """Centred indices of rows and columns of the grid, denser at the shadow's edges; weights."""
    pitch, scale = float(grid.pitch), float(path.magnification)
    # Of the whole grid the sum would be compiled for each of its shapes.
    top, left = (np.array([(1 - count) / 2]) for count in grid.shape)
    shadow = path.on_mask(SparseGrid(top, left, grid.pitch), mask.centre)
    zone = 3 * math.sqrt(float(path.wavelength * path.distance) * scale) / pitch
    found = []
    for axis, count in enumerate(grid.shape):
        middle = -scale * float(shadow[axis][0]) / pitch
        half = scale * float(mask.extent[axis]) / 2 / pitch
        indices, weights = chosen(count, (middle - half, middle + half), zone, seed=axis)
        found.append((indices - (count - 1) / 2, weights))
    (rows, row_weights), (columns, column_weights) = found
    return (rows, columns), (row_weights, column_weights)


@jax.jit(static_argnames=("shape", "method"))
def _direct_sum(
    mask, points: SparseGrid, path: LightPath, shape: tuple[int, int], method: PsfMethod
) -> Float[Array, "row column"]:
    """`rayleigh_sommerfeld` at some pixels."""
    plane, _ = planes(Grid(shape, points.pitch), method)
    lit = lit_mask(mask, plane, path)
    sensor = points.refined(method.samples) if method.pixel_integration else points
    field = rayleigh_sommerfeld_field(lit, plane, sensor, path)
    irradiance = squared_modulus(field) * path.magnification**2
    return block_mean(irradiance, method.samples) if method.pixel_integration else irradiance


@jax.jit
def _fine_lines(mask: AbstractFactoredMask, half_sensor: Array, path: LightPath, exact: Array):
    """Fields on lines through the axis, their half length, and the pairs of their orders.

    One line stands for both axes where the mask's factors are the same.
    """
    terms = mask.terms(path.wavelength)
    axes = (1,) if terms.rows is terms.columns else (0, 1)
    half_mask = jnp.max(jnp.stack(mask.extent)) / 2 + jnp.max(jnp.abs(mask.centre))
    reach = jnp.maximum(half_sensor, half_mask * path.magnification)
    fields = [fine_fields(mask, path, reach, exact, _FINE_SAMPLES, axis) for axis in axes]
    return fields, reach, pairs(terms.coefficients)


def spread(count: int, most: int) -> Float[np.ndarray, " chosen"]:
    """At most `most` centred indices out of `count`, one of each of equal strata."""
    edges = np.linspace(0, count, min(count, most) + 1)
    inside = np.random.default_rng(2).uniform(size=len(edges) - 1)
    return np.floor(edges[:-1] + inside * np.diff(edges)) - (count - 1) / 2


@dataclass(frozen=True, eq=False)
class Factors:
    """Real factors of an image on chosen rows and columns, each scaled by the root of its weight.

    - `rows`, `columns`: factor × sample, in double precision.
    """

    rows: Float[np.ndarray, "factor row"]
    columns: Float[np.ndarray, "factor column"]


def factors(
    rows: Complex[ArrayLike, "term row"], columns: Complex[ArrayLike, "term column"], weights: Both
) -> Factors:
    """Factors of Σ Re{Y X} whose samples stand for `weights` samples each."""
    both = zip((rows, columns), weights, strict=True)
    down, across = (np.asarray(factor, complex) * np.sqrt(weight) for factor, weight in both)
    # Re{YX} = Re Y Re X − Im Y Im X.
    return Factors(
        np.concatenate([np.real(down), -np.imag(down)]),
        np.concatenate([np.real(across), np.imag(across)]),
    )


def norm(image: Factors) -> float:
    """‖h‖₂ over the grid."""
    square = np.sum((image.rows @ image.rows.T) * (image.columns @ image.columns.T))
    return float(np.sqrt(max(square, 0.0)))


def distance(first: Factors, second: Factors) -> float:
    """‖h₁ − h₂‖₂ for sums of different terms; what cancels leaves 1e-8 of their norms."""
    return norm(
        Factors(
            np.concatenate([first.rows, second.rows]),
            np.concatenate([first.columns, -second.columns]),
        )
    )


def rounding_distance(first: Factors, second: Factors) -> float:
    """‖h₁ − h₂‖₂ for sums of the same terms, nearly equal: no digits cancel."""
    return norm(
        Factors(
            np.concatenate([first.rows - second.rows, second.rows]),
            np.concatenate([first.columns, first.columns - second.columns]),
        )
    )


class MaskProbe:
    """Errors of all models for one camera with a mask of terms, by one-dimensional probes.

    The reference is `separable` in double precision, exact in the Fresnel approximation. Nothing
    two-dimensional is evaluated.
    """

    def __init__(
        self, mask: AbstractFactoredMask, grid: Grid, path: LightPath, *, pixel_integration: bool
    ) -> None:
        self.shape, self.pixel_integration, self.path = grid.shape, pixel_integration, path
        self.lines, self.weights = lines_of(mask, grid, path)
        # Those of few fringes differ by rounding, and each count is compiled; points take none.
        counted = pixel_nodes(mask, grid, path, "float64") if pixel_integration else 0
        self.nodes = max(PIXEL_NODES, counted)
        self.given: dict[Precision, tuple[AbstractFactoredMask, SparseGrid, LightPath]]
        with allow("float64", mask, grid, path):
            points = SparseGrid(*self.lines, jnp.asarray(grid.pitch))
            self.given = {p: cast((mask, points, path), p) for p in PRECISIONS}
        self._cache: dict[tuple[Model, Precision, int | None], Factors] = {}

    @functools.cached_property
    def scale(self) -> float:
        """‖h‖₂ of the reference; where no light falls on the sensor, errors count as they are."""
        return norm(self.reference) or 1.0

    def closed(self, model: Model, precision: Precision, nodes: int | None = None) -> Factors:
        """Factors of one of the closed forms, averages by default as `psf` has them."""
        # Other models take none, and would be compiled for each number.
        nodes = (nodes or self.nodes) if model == "separable" else None
        key = model, precision, nodes
        if key not in self._cache:
            method = PsfMethod(model, precision, self.pixel_integration, nodes=nodes)
            with allow(precision):
                terms = closed_terms(*self.given[precision], method)
                self._cache[key] = factors(terms.rows, terms.columns, self.weights)
        return self._cache[key]

    @property
    def reference(self) -> Factors:
        """`separable` in double precision, pixels averaged with as many nodes as the fringes ask.

        Where a pixel holds more than some 200 fringes of the far edge, those of `psf` alias them.
        """
        return self.closed("separable", "float64", self._nodes)

    @functools.cached_property
    def _nodes(self) -> int:
        if not self.pixel_integration:
            return PIXEL_NODES
        with allow("float64"):
            mask, points, path = self.given["float64"]
            # The irradiance's band ends at width/(λd).
            width = max(float(extent) for extent in mask.extent)
            fringes = float(points.pitch) * width / float(path.wavelength * path.distance)
        enough = [n for n in _NODES if n >= fringes * math.pi / 2 + 10]
        return enough[0] if enough else _NODES[-1]

    def model_error(self, model: Model, nodes: int | None = None) -> float:
        """Relative distance of a closed form from the reference, without rounding."""
        found = self.closed(model, "float64", nodes)
        if model == "separable":
            return rounding_distance(found, self.reference) / self.scale
        return distance(found, self.reference) / self.scale

    def difference(self, model: Model, other: Model) -> float:
        """Relative distance of two closed forms, without rounding."""
        first, second = (self.closed(m, "float64") for m in (model, other))
        return distance(first, second) / self.scale

    def rounding(self, model: Model, precision: Precision) -> float:
        """Error of a closed form by its precision; in float64, scaled from that of float32."""
        single, double = (self.closed(model, p) for p in PRECISIONS)
        measured = rounding_distance(single, double) / self.scale
        size = norm(double) / self.scale
        scaled = measured * _EPSILON[precision] / _EPSILON["float32"]
        if precision == "float64":
            # Phases that float32 has lost altogether cost it no more than their waves' amplitude.
            scaled *= max(1.0, 3 * self.numbers().largest_phase * _EPSILON["float32"])
        return scaled + size * _PRODUCT_ROUNDING[precision]

    def angular_spectrum(self, method: PsfMethod) -> float:
        """Relative distance of the angular spectrum from the reference, rounding included."""
        with allow(method.float_type):
            terms = angular_spectrum_terms(*self.given[method.float_type], self.shape, method)
            found = factors(terms.rows, terms.columns, self.weights)
        return distance(found, self.reference) / self.scale

    def rayleigh_sommerfeld(self, method: PsfMethod) -> float:
        """Relative error of the direct sum, from a few pixels: no line shows where it aliases."""
        rows, columns = (spread(count, _FEW) for count in self.shape)
        with allow("float64"):
            mask, points, path = self.given["float64"]
            points = SparseGrid(rows, columns, points.pitch)
            averaged = self.pixel_integration
            separable = PsfMethod("separable", "float64", averaged, nodes=self.nodes)
            exact = np.asarray(closed_terms(mask, points, path, separable).image())
        with allow(method.float_type):
            mask, points, path = self.given[method.float_type]
            points = SparseGrid(rows, columns, points.pitch)
            found = np.asarray(_direct_sum(mask, points, path, self.shape, method), float)
        share = exact.size / math.prod(self.shape)
        return float(np.linalg.norm(found - exact)) / math.sqrt(share) / self.scale

    def numbers(self) -> "Numbers":
        """Sizes of the effects that the reasons name."""
        with allow("float64"):
            mask, points, path = self.given["float64"]
            zones = getattr(mask, "zone_orders", None)
            epsilon, phase, radius = 0.0, 0.0, max(float(extent) for extent in mask.extent) / 2
            if zones is not None:
                order, beta = max(abs(k) for k in zones().orders), zones().beta
                epsilon, phase = order * float(path.epsilon(beta)), order * float(beta) * radius**2
            reach = max(self.shape) * float(points.pitch) / 2 / float(path.magnification) + radius
            return Numbers(
                epsilon=epsilon,
                first_order=epsilon * phase,
                second_order=epsilon**2 * phase,
                edge_zone=math.sqrt(
                    float(path.wavelength * path.distance) / float(path.magnification)
                ),
                largest_phase=max(2 * phase, float(path.fresnel_curvature) * reach**2),
            )

    def in_focus(self) -> bool:
        """Whether an order focuses on the sensor, where `psf` refuses the closed form."""
        with allow("float64"):
            mask, _, path = self.given["float64"]
            return bool(in_focus(mask, path))

    def paraxial_error(self) -> float:
        """Relative distance of the Fresnel approximation from exact scalar diffraction.

        From fields on lines through the axis, point-sampled, with exact and with Fresnel's phases.
        The cross term of the two axes is left out: an estimate, not a bound.
        """
        with allow("float64"):
            mask, points, path = self.given["float64"]
            pitch, which = points.pitch, map(jnp.asarray, (True, False))
            found = [_fine_lines(mask, max(self.shape) * pitch / 2, path, one) for one in which]
        exact, fresnel = (
            self._line_factors((fields[0], fields[-1]), float(reach), float(pitch), weighted_pairs)
            for fields, reach, weighted_pairs in jax.device_get(found)
        )
        size = norm(fresnel)
        return rounding_distance(exact, fresnel) / size if size else 0.0

    def _line_factors(self, fields, reach, pitch, weighted_pairs) -> Factors:
        """Pair products of fine lines' fields at the chosen pixels, averaged if pixels are."""
        lower, upper, weights = weighted_pairs
        count = fields[0].shape[-1]
        step = 2 * reach / count
        half = round(pitch / step / 2) if self.pixel_integration else 0
        inside = np.unique(np.linspace(-half, half, _IN_PIXEL).round()).astype(int)
        picked = []
        for field, indices in zip(fields, self.lines, strict=True):
            position = np.round(indices * pitch / step + (count - 1) / 2).astype(int)
            found = field[:, np.clip(position[:, None] + inside, 0, count - 1)]
            picked.append(np.mean(found[lower] * found[upper].conj(), axis=-1))
        return factors(weights[:, None] * picked[0], picked[1], self.weights)
