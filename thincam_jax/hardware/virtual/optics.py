"""Optics of a virtual camera: a scene through a light modulator, or a monitor's cells."""

import functools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np
import scipy
import skimage
from jaxtyping import Array, Complex, Float, UInt8
from numpy.polynomial.legendre import leggauss
from scipy.spatial.transform import Rotation

from thincam_jax._core.grids import Grid, block_mean, centred_indices
from thincam_jax._core.precision import as_complex, product
from thincam_jax._core.quantity import check_fields, quantity, whole
from thincam_jax.hardware.displays.levels import PhaseLevels
from thincam_jax.imaging.operators import AbstractOperator, CropConvolution, Sparse
from thincam_jax.imaging.operators.base import dtype_of
from thincam_jax.imaging.operators.crop_convolution import kernel_grid
from thincam_jax.imaging.scene import Scene
from thincam_jax.imaging.sensor import Sensor
from thincam_jax.lensless.camera import LenslessCamera, LightPath
from thincam_jax.lensless.capture import warn_if_unseen
from thincam_jax.lensless.forward import project, projected_shape
from thincam_jax.lensless.masks.sampled import SampledMask
from thincam_jax.lensless.method import pixel_nodes
from thincam_jax.lensless.mosaic import Mosaic
from thincam_jax.lensless.propagation.chirp import chirp_integral
from thincam_jax.lensless.propagation.separable import SeparableSum
from thincam_jax.measured.bayer import Pattern, mosaic
from thincam_jax.measured.calibration.alignment import to_indices

_TERMS = 4  # singular terms of a pattern that are averaged exactly
_POINTS = 4  # along a pixel, for the remainder of real amplitudes
_FINE = 4  # samples of a monitor along a cell


@runtime_checkable
class Optics(Protocol):
    """Light on the sensor, (y, x), in electrons per second, for the pixels shown."""

    @property
    def sensor_shape(self) -> tuple[int, int]: ...

    def __call__(
        self, shown: UInt8[np.ndarray, "v u"], position: float
    ) -> Float[np.ndarray, "y x"]: ...


@dataclass(frozen=True)
class StageErrors:
    """Differences of a stage's true places from those that it reports, but at position 0.

    - `axial`, `sideways`: their standard deviations along the axis, and across it along y and x.
    - `seed`: seed of the errors, which are the same whenever a position is reached, to 1 µm.
    """

    axial: Annotated[float, quantity("mm", non_negative=True)] = 0.0
    sideways: Annotated[float, quantity("mm", non_negative=True)] = 0.0
    seed: Annotated[int, whole(0, 2**32 - 1)] = 0

    def __post_init__(self):
        check_fields(self)

    def at(self, position: float) -> Float[np.ndarray, "3"]:
        """Errors (z, y, x) at a position, mm."""
        place = round(1000 * position)
        random = np.random.default_rng([self.seed, place + 2**31])
        scale = np.array([self.axial, self.sideways, self.sideways])
        return (place != 0) * scale * random.standard_normal(3)


@dataclass(frozen=True, eq=False)
class ModulatorOptics:
    """A scene through a light modulator, whose pixels are the mask, on a sensor on a stage.

    A pixel of level g transmits g/255 of the irradiance, the amplitude √(g/255), or turns the phase
    by the table `phases`, of which no light is left where all levels are 0: the camera is covered.
    The PSF of the pixels is `pixelated_psf`.

    - `pixel_pitch`: pixel pitch of the modulator, mm; its middle is on the axis.
    - `distance`: from modulator to sensor, mm, at the stage's position 0.
    - `electrons`: per second and pixel for each mm² of open aperture before a white scene.
    - `fill_factor`: open fraction of a modulator pixel's area.
    - `phases`: phases of a phase modulator's levels, and its dead space.
    - `aperture`: rows and columns in the middle of a phase modulator that are lit; None: all.
    - `stage`: errors of the stage that carries the sensor.
    """

    scene: Scene
    sensor: Sensor
    pixel_pitch: float
    distance: float
    electrons: float
    fill_factor: float = 1.0
    phases: PhaseLevels | None = None
    aperture: tuple[int, int] | None = None
    stage: StageErrors = StageErrors()

    def __post_init__(self):
        warn_if_unseen(self.scene, self.distance, float(self.sensor.pitch))

    @property
    def sensor_shape(self) -> tuple[int, int]:
        return self.sensor.shape

    def __call__(
        self, shown: UInt8[np.ndarray, "v u"], position: float
    ) -> Float[np.ndarray, "y x"]:
        image = np.zeros(self.sensor.shape, np.float32)
        if not shown.any():
            return image
        if self.phases is None:
            shown = _middle(shown)
        elif self.aperture is not None:
            top, left = ((n - k) // 2 for n, k in zip(shown.shape, self.aperture, strict=True))
            shown = shown[top : top + self.aperture[0], left : left + self.aperture[1]]
        field = self.phases.field if self.phases else lambda shown, _: np.sqrt(shown / 255)
        # Only the size of this mask is used; its transmittances act in the PSF.
        mask = SampledMask(shown / 255, self.pixel_pitch)
        along, *aside = self.stage.at(position).tolist()
        camera = LenslessCamera(mask, self.sensor, self.distance + position + along)
        grid, spectrum = self.sensor.grid, self.scene.spectrum
        for plane in self.scene.planes:
            shape = projected_shape(camera, plane)
            if any(aside):  # as if its shadow fell from beside the axis
                lever = -float(plane.distance) / float(camera.distance)
                camera = camera.replace(place=[lever * side for side in aside])
            kernels = [
                weight
                * pixelated_psf(
                    field(shown, float(wavelength)),
                    kernel_grid(grid, shape),
                    camera.path(wavelength, plane.distance),
                    pixel_pitch=self.pixel_pitch,
                    fill_factor=self.fill_factor,
                    gap=0.0 if self.phases is None else self.phases.gap,
                )
                for wavelength, weight in spectrum.colours
            ]
            kernel = functools.reduce(jnp.add, kernels)
            convolution = CropConvolution(kernel, grid.pitch, grid.shape, shape)
            image = image + np.asarray(convolution(project(camera, plane, shape)))
        return (self.electrons * image).astype(np.float32)


@dataclass(frozen=True, eq=False)
class WalledOptics:
    """Masks side by side on one display, with walls from between them to the sensor.

    - `optics`: display and scene without the walls, a `ModulatorOptics`.
    - `mosaic`: the parts; of its masks only the places count.
    """

    optics: ModulatorOptics
    mosaic: Mosaic

    @property
    def sensor_shape(self) -> tuple[int, int]:
        return self.optics.sensor_shape

    def __call__(
        self, shown: UInt8[np.ndarray, "v u"], position: float
    ) -> Float[np.ndarray, "y x"]:
        parts = []
        for number, mask in enumerate(self.mosaic.placed):
            alone = np.zeros_like(shown)
            reach = zip(shown.shape, np.asarray(mask.centre), mask.extent, strict=True)
            rows, columns = (_pixels(*one, self.optics.pixel_pitch) for one in reach)
            alone[rows, columns] = shown[rows, columns]
            parts.append(self.mosaic.split(self.optics(alone, position))[number])
        return np.asarray(self.mosaic.join(parts))


def _pixels(count: int, middle: Any, side: Any, pitch: float) -> slice:
    """Pixels of a display that lie in a part of its width, mm."""
    ends = ((float(middle) + sign * float(side) / 2) / pitch for sign in (-1, 1))
    first, last = (round(count / 2 + end) for end in ends)
    return slice(max(first, 0), last)


@dataclass(frozen=True, eq=False)
class MosaicOptics:
    """Light on a colour sensor, whose pixels each see red, green or blue alone.

    - `colours`: light on the whole sensor of each of these.
    - `pattern`: Bayer pattern of the whole sensor.
    """

    colours: Sequence[Optics]
    pattern: Pattern

    @property
    def sensor_shape(self) -> tuple[int, int]:
        return self.colours[0].sensor_shape

    def __call__(
        self, shown: UInt8[np.ndarray, "v u"], position: float
    ) -> Float[np.ndarray, "y x"]:
        return mosaic(np.stack([one(shown, position) for one in self.colours]), self.pattern)


def _middle(shown: np.ndarray) -> np.ndarray:
    """Smallest centred part that contains all pixels that are not black."""
    sides = []
    for axis, count in enumerate(shown.shape):
        lit = np.flatnonzero(shown.any(axis=1 - axis))
        margin = min(lit[0], count - 1 - lit[-1]) if len(lit) else 0
        sides.append(slice(margin, count - margin))
    return shown[sides[0], sides[1]]


def pixelated_psf(
    amplitude: Float[np.ndarray, "v u"] | Complex[np.ndarray, "v u"],
    grid: Grid,
    path: LightPath,
    *,
    pixel_pitch: float,
    fill_factor: float = 1.0,
    gap: float = 0.0,
) -> Float[Array, "y x"]:
    r"""Pixel averages of the PSF of a display of square pixels with given amplitudes.

    .. math::
        U(x, y) = \sum_{vu} A_{vu} S_v(y) S_u(x), \qquad A = \sum_r \sigma_r a_r b_r^T

    S_u is the Fresnel integral over the open part of pixel u, a slit: exact within the Fresnel
    approximation. By singular value decomposition of A the field is a sum of separable terms, three
    for a grey Fresnel zone aperture, and so is the irradiance of the largest ones, whose pixel
    averages are one-dimensional. The remainder, such as the rounding to 8 bits, is averaged over a
    few points of each pixel; that of phases, which is more, over as many as its fringes need.

    `gap`: amplitude between the open parts, that of a slit over all pixels less these.
    """
    dtype = grid.pitch.dtype
    mask = SampledMask(amplitude, pixel_pitch)
    amplitude = scipy.linalg.block_diag(amplitude - gap, gap)  # of the pixels and of the whole
    left, strength, right = np.linalg.svd(amplitude, full_matrices=False)
    down, across = left[:, :_TERMS] * strength[:_TERMS], right[:_TERMS].T
    nodes = pixel_nodes(mask, grid, path, "float64" if dtype == jnp.float64 else "float32")
    points = nodes if np.iscomplexobj(amplitude) else _POINTS
    places = np.concatenate([leggauss(nodes)[0], leggauss(points)[0]]) / 2
    offsets = grid.pitch * jnp.asarray(places, dtype)[:, None]
    slit = jnp.asarray(pixel_pitch, dtype), jnp.asarray(fill_factor, dtype)
    y, x = grid.y, grid.x
    if path.place is not None:  # the shadow moves
        aside = path.distance * path.place / path.object_distance
        y, x = y - aside[0], x - aside[1]
    x = jnp.concatenate([y + offsets, x + offsets], axis=1)
    if down.shape[0] == across.shape[0]:  # both at once: half as much to compile
        fields = _slit_fields(x, len(down) - 1, slit, path)
        along = fields[:, : grid.shape[0]], fields[:, grid.shape[0] :]
    else:
        rows, columns = x[:, : grid.shape[0]], x[:, grid.shape[0] :]
        along = (
            _slit_fields(rows, len(down) - 1, slit, path),
            _slit_fields(columns, len(across) - 1, slit, path),
        )
    waves = np.result_type(dtype, np.complex64)
    terms = jnp.asarray(down, waves), jnp.asarray(across, waves)
    rest = jnp.asarray(amplitude - down @ across.T, waves)
    return _averaged(along, terms, rest, grid, points)


@functools.partial(jax.jit, static_argnames="count")
def _slit_fields(
    x: Float[Array, "node n"],
    count: int,
    slit: tuple[Float[Array, ""], Float[Array, ""]],
    path: LightPath,
) -> Complex[Array, "node n cell"]:
    """One-dimensional field at x behind each of the display's open pixels, and behind all of it.

    `slit`: the display's pitch and fill factor.
    """
    b, scale = path.fresnel_curvature, path.magnification
    sites = centred_indices(count, x.dtype) * slit[0]
    half = slit[0] * jnp.sqrt(slit[1]) / 2
    at = x[..., None] / scale
    ends = jnp.append(sites - half, sites[0] - half), jnp.append(sites + half, sites[-1] + half)
    cells = chirp_integral(jnp.zeros_like(b), b, at, *ends)
    return cells * as_complex(jnp.sqrt(scale / (path.wavelength * path.distance)))


@functools.partial(jax.jit, static_argnames="points")
def _averaged(
    along: tuple[Complex[Array, "node y v"], Complex[Array, "node x u"]],
    terms: tuple[Complex[Array, "v term"], Complex[Array, "u term"]],
    rest: Complex[Array, "v u"],
    grid: Grid,
    points: int,
) -> Float[Array, "y x"]:
    """`along`: the slits' fields at the nodes of the exact averages, then of the remainder."""
    nodes = len(along[0]) - points
    lower, upper = np.triu_indices(terms[0].shape[1])
    shares, few = (jnp.asarray(leggauss(n)[1] / 2, grid.pitch.dtype) for n in (nodes, points))

    def pairs(fields, profiles):
        """Averages of F_r conj(F_s), r ≤ s, of the terms' one-dimensional fields."""
        one = product(fields[:nodes], profiles)
        products = one[..., lower] * jnp.conj(one[..., upper])
        return jnp.tensordot(as_complex(shares), products, axes=1, precision="highest").T

    rows, columns = (pairs(f, p) for f, p in zip(along, terms, strict=True))
    weights = as_complex(jnp.asarray(np.where(lower == upper, 1.0, 2.0), grid.pitch.dtype))
    largest = SeparableSum(weights[:, None] * rows, columns, grid).image()
    down, across = terms

    def add_row(total, node):
        main, other = product(node[0], down), product(node[0], rest)

        def add(total, inner):
            field = product(main, product(inner[0], across).T)
            both = field + product(other, inner[0].T)
            change = both.real**2 + both.imag**2 - field.real**2 - field.imag**2
            return total + node[1] * inner[1] * change, None

        return jax.lax.scan(add, total, (along[1][nodes:], few))[0], None

    return jax.lax.scan(add_row, largest, (along[0][nodes:], few))[0]


@dataclass(frozen=True, eq=False)
class MonitorOptics:
    """Cells on a monitor in front of a camera with a known operator.

    The cells are the largest squares of monitor pixels that fit, centred, without a `place`; a
    cell's radiance is the mean of its pixels' levels over 255.

    - `operator`: from the cells, 1 is white, to the sensor.
    - `electrons`: per second for each unit of the operator's output.
    - `transmission`: levels over 255 of what stands before the cells, which the monitor lights.
    - `place`: homography from the monitor's pixels to cells, (x, y) from the middle of either.
    - `background`: light that is always there, (y, x), in the unit of the operator's output.
    """

    operator: AbstractOperator
    electrons: float
    transmission: UInt8[np.ndarray, "y x"] | None = None
    place: Float[np.ndarray, "3 3"] | None = None
    background: Float[np.ndarray, "y x"] | float = 0.0

    @functools.cached_property
    def _by_rows(self) -> Any:
        """Matrix of a `Sparse` operator, sorted by rows, which is ten times faster."""
        return self.operator.by_rows() if isinstance(self.operator, Sparse) else None

    @property
    def sensor_shape(self) -> tuple[int, int]:
        rows, columns = self.operator.out_shape
        return rows, columns

    def __call__(
        self, shown: UInt8[np.ndarray, "v u"], position: float
    ) -> Float[np.ndarray, "y x"]:
        rows, columns = self.operator.in_shape
        cells = cells_seen(shown, (rows, columns), self.place).astype(np.float32)
        if self.transmission is not None:
            cells *= self.transmission / np.float32(255)
        if self._by_rows is not None:
            image = (self._by_rows @ cells.ravel()).reshape(self.sensor_shape)
        else:
            image = np.asarray(self.operator(jnp.asarray(cells, dtype_of(self.operator))))
        return (self.electrons * (image + self.background)).astype(np.float32)


def cells_shown(
    shown: UInt8[np.ndarray, "v u"], cells: tuple[int, int]
) -> Float[np.ndarray, "y x"]:
    """Mean level over 255 of each cell: centred squares of the monitor's pixels."""
    side = min(have // want for have, want in zip(shown.shape, cells, strict=True))
    if side < 1:
        raise ValueError(f"{cells} cells do not fit a display of {shown.shape} pixels")
    top, left = ((have - side * want) // 2 for have, want in zip(shown.shape, cells, strict=True))
    part = shown[top : top + side * cells[0], left : left + side * cells[1]]
    blocks = part.reshape(cells[0], side, cells[1], side)
    return blocks.mean(axis=(1, 3), dtype=np.float64) / 255


def cells_seen(
    shown: UInt8[np.ndarray, "v u"], cells: tuple[int, int], place: Float[np.ndarray, "3 3"] | None
) -> Float[np.ndarray, "y x"]:
    """Mean level over 255 of each cell; see `MonitorOptics.place`."""
    if place is None:
        return cells_shown(shown, cells)
    fine = _FINE * cells[0], _FINE * cells[1]
    inverse = to_indices(shown.shape) @ np.linalg.inv(to_indices(fine, 1 / _FINE) @ place)
    return block_mean(skimage.transform.warp(shown / 255, inverse, output_shape=fine), _FINE)


@dataclass(frozen=True)
class MonitorPose:
    """Pose of a monitor about the middle of the object's plane.

    - `x`, `y`, `z`: place of its middle, mm; z is away from the camera.
    - `rotation`: clockwise as seen; `turn`: its right side, `tilt`: its lower side is farther.
    """

    x: Annotated[float, quantity("mm")] = 0.0
    y: Annotated[float, quantity("mm")] = 0.0
    z: Annotated[float, quantity("mm")] = 0.0
    rotation: Annotated[float, quantity("rad")] = 0.0
    turn: Annotated[float, quantity("rad", least=-1.0, most=1.0)] = 0.0
    tilt: Annotated[float, quantity("rad", least=-1.0, most=1.0)] = 0.0

    def __post_init__(self):
        check_fields(self)

    def homography(
        self, distance: float, pixel: float = 1.0, cell: float = 1.0
    ) -> Float[np.ndarray, "3 3"]:
        """Homography from the monitor's pixels to cells of a plane, (x, y) from the middles.

        - `pixel`, `cell`: their sides, mm; negative for an image that is turned by 180°.

        Projection through a pinhole in the mask's middle: the PSF's own change with the depth is
        left out.
        """
        angles = self.rotation, self.tilt, -self.turn
        turned = Rotation.from_euler("zxy", angles).as_matrix()
        where = np.array([self.x, self.y, distance + self.z])
        both = np.column_stack([turned[:, :2], where]) @ np.diag([pixel, pixel, 1])
        return np.diag([1 / cell, 1 / cell, 1 / distance]) @ both
