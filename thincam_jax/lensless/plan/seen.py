r"""A scene as a camera sees it, and the PSF's transfer function, at a few frequencies.

A capture is a linear convolution, so that by Parseval its energy is
:math:`\iint |\sum_t H_t F_t|^2\,dv\,du` over the frequencies of the samples. The integral is taken
at a few hundred random ones, closer together towards zero, where scenes have their light: that
shows how an error of the PSF shows in the image of this scene.
"""

import functools
import math
from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float

from thincam_jax._core.grids import SparseGrid
from thincam_jax._core.memory import Cost
from thincam_jax._core.precision import PRECISIONS, Precision, allow, cast, itemsize_of, product
from thincam_jax.imaging.operators.crop_convolution import convolution_cost, kernel_grid
from thincam_jax.imaging.scene import Scene
from thincam_jax.lensless.camera import LenslessCamera, LightPath
from thincam_jax.lensless.field import points_needed, tangents_of
from thincam_jax.lensless.forward import project, projected_shape
from thincam_jax.lensless.masks.base import AbstractMask, has_few_terms
from thincam_jax.lensless.method import (
    CLOSED,
    LATTICE_POINTS,
    Model,
    PsfMethod,
    models_of,
    psf_method,
    with_nodes,
)
from thincam_jax.lensless.psf import closed_terms, spectral_psf
from thincam_jax.lensless.resolve import held_in_single, psf_cost, samples_needed

Point = tuple[float, float] | None
Transfer = Complex[np.ndarray, " k"]

# Rings of frequencies, and frequencies in each.
_RINGS, _IN_RING = 32, 16


@dataclass(frozen=True, eq=False)
class Frequencies:
    """Frequencies in cycles per sample, and the area that each stands for.

    - `v`, `u`: down and across; of a pair of opposite frequencies one stands for both.
    - `weights`: areas; together 1, the whole band.
    """

    v: Float[np.ndarray, " k"]
    u: Float[np.ndarray, " k"]
    weights: Float[np.ndarray, " k"]


def sample_frequencies(longest: int, seed: int = 0) -> Frequencies:
    """Stratified over rings that grow geometrically from a quarter of 1/`longest`."""
    random = np.random.default_rng(seed)
    edges = [0.0, *np.geomspace(min(0.25 / longest, 0.25), 0.5, _RINGS - 1), math.sqrt(0.5)]
    found = [_ring(random, low, high) for low, high in zip(edges[:-1], edges[1:], strict=True)]
    v, u, weights = (np.concatenate(parts) for parts in zip(*found, strict=True))
    return Frequencies(v, u, weights / weights.sum())


def _ring(random, low: float, high: float):
    """Frequencies of one ring inside the square band, and the ring's area shared among them."""
    tried = 4096 if high > 0.5 else _IN_RING
    radius = np.sqrt(random.uniform(low**2, high**2, tried))
    angle = random.uniform(-np.pi / 2, np.pi / 2, tried)
    v, u = radius * np.sin(angle), radius * np.cos(angle)
    inside = (np.abs(v) < 0.5) & (u < 0.5)
    area = np.pi * (high**2 - low**2) * inside.mean()
    v, u = v[inside][:_IN_RING], u[inside][:_IN_RING]
    return v, u, np.full(len(v), area / len(v))


def waves(
    frequencies: Float[np.ndarray, " k"], indices: Float[np.ndarray, " n"], length: int
) -> Float[np.ndarray, "length k2"]:
    """cos and −sin of the frequencies at centred indices, side by side; zero beyond them."""
    phase = 2 * np.pi * indices[:, None] * frequencies
    filled = np.zeros((length, 2 * len(frequencies)))
    filled[: len(indices)] = np.concatenate([np.cos(phase), -np.sin(phase)], axis=1)
    return filled


def centred(count: int) -> Float[np.ndarray, " n"]:
    return np.arange(count) - (count - 1) / 2


def image_spectrum(
    images: Float[np.ndarray, "batch m n"], frequencies: Frequencies
) -> Complex[np.ndarray, "batch k"]:
    """F(v, u) = Σ f e^{−2πj(vy+ux)} of images about their centres."""
    rows, columns = (centred(n) for n in images.shape[-2:])
    # cos and −sin side by side: one real product, at half the cost of a complex one.
    half = images @ waves(frequencies.u, columns, len(columns))
    cosine, sine = np.split(half, 2, axis=-1)
    down = np.exp(-2j * np.pi * np.outer(rows, frequencies.v))
    return np.einsum("bmk,mk->bk", cosine + 1j * sine, down)


class TransferProbe:
    r"""H(v, u) of a camera with a mask of few terms, at given frequencies.

    A separable sum transforms axis by axis, :math:`H = \sum_f \hat Y_f(v)\hat X_f(u)`: a thousandth
    of the work of an image and its transform. Frequencies are in cycles per sample of the kernel's
    grid, and H is that of its samples, aliasing included: it is what a discrete convolution uses.
    """

    def __init__(
        self, camera: LenslessCamera, kernel_shape: tuple[int, int], frequencies: Frequencies
    ) -> None:
        self.camera = camera
        lengths = [_rounded_up(n) for n in kernel_shape]
        indices = [centred(n) for n in kernel_shape]
        self.places = [
            np.concatenate([i, np.zeros(n - len(i))]) for i, n in zip(indices, lengths, strict=True)
        ]
        both = zip((frequencies.v, frequencies.u), indices, lengths, strict=True)
        found = [waves(*given) for given in both]
        with allow("float64"):
            self.waves = {p: tuple(jnp.asarray(w, p) for w in found) for p in PRECISIONS}

    def exact(
        self, wavelength: float, distance: float, method: PsfMethod, at: Point = None
    ) -> Transfer:
        """H with factors in the model's precision, transformed in double precision.

        `at`: a point on one of the mask's axes; H is then about the middle of its shadow.
        """
        with allow("float64"):
            return self._transfer("float64", self._path(wavelength, distance, at), method)

    def quick(
        self, wavelength: float, distance: float, method: PsfMethod, at: Point = None
    ) -> Transfer:
        """H in single precision, for many PSFs."""
        method = replace(method, precision="float32")
        return self._transfer("float32", self._path(wavelength, distance, at), method)

    def _path(self, wavelength: float, distance: float, at: Point) -> LightPath:
        path = self.camera.path(float(wavelength), float(distance), at)
        return path if at is None else replace(path, follows=True, skew=False)

    def _transfer(self, precision: Precision, path: LightPath, method: PsfMethod) -> Transfer:
        given = self.camera.mask, self.camera.sensor.pitch, path
        mask, pitch, path = cast(given, method.float_type)
        method = with_nodes(method, mask, self.camera.sensor.grid, path)
        points = SparseGrid(self.places[0], self.places[1], pitch)
        return np.asarray(_transfer(mask, points, path, *self.waves[precision], method), complex)


class SampledProbe:
    """H(v, u) of a camera whose mask has no few terms, from its whole PSF, a wavelength a time."""

    def __init__(
        self, camera: LenslessCamera, kernel_shape: tuple[int, int], frequencies: Frequencies
    ) -> None:
        self.camera = camera.on_grid(camera.sensor.grid.with_shape(kernel_shape))
        self.frequencies = frequencies

    def quick(
        self, wavelength: float, distance: float, method: PsfMethod, at: Point = None
    ) -> Transfer:
        """H of the PSF as a plan computes it; with `at`, about the ray of that point."""
        grid = self.camera.sensor.grid
        if method.model in CLOSED:  # compared with each other at the fewest points
            method = replace(method, nodes=method.nodes or LATTICE_POINTS)
        h = spectral_psf(self.camera, [(wavelength, 1.0)], distance, method, grid, at)
        return image_spectrum(np.asarray(h, float)[None], self.frequencies)[0]


@jax.jit(static_argnames="method")
def _transfer(
    mask: AbstractMask,
    points: SparseGrid,
    path: LightPath,
    down: Float[Array, "m k2"],
    across: Float[Array, "n k2"],
    method: PsfMethod,
) -> Complex[Array, " k"]:
    terms = closed_terms(mask, points, path, method)
    spectra = []
    for factor, wave in zip(terms.real_factors(), (down, across), strict=True):
        both = product(factor.astype(wave.dtype), wave)
        real, imaginary = jnp.split(both, 2, axis=-1)
        spectra.append(jax.lax.complex(real, imaginary))
    return jnp.sum(spectra[0] * spectra[1], axis=0)


def _rounded_up(count: int) -> int:
    """The next of a few sizes, so that similar scenes share their compilation."""
    step = max(32, 2 ** (max(count - 1, 1).bit_length() - 3))
    return -(-count // step) * step


# Predictions come from some hundred random frequencies: what they are multiplied with.
_MARGIN = 1.5
# Points across the shadow and the sensor at which the energy is counted.
_POINTS = 96

FULL = PsfMethod("separable", "float64", True)
# For the capture's energy, which fringes hardly change: few nodes of the pixel average.
_ROUGH = PsfMethod("separable", "float32", True, nodes=6)


class SeenScene:
    """A scene as the sensor sees it, at a few frequencies."""

    def __init__(self, camera: LenslessCamera, scene: Scene, tolerance: float) -> None:
        self.camera, self.tolerance = camera, tolerance
        shapes = [projected_shape(camera, p) for p in scene.planes]
        self.field_shape = (max(s[0] for s in shapes), max(s[1] for s in shapes))
        self.distances = tuple(float(p.distance) for p in scene.planes)
        self.wavelengths = tuple(float(w) for w in scene.spectrum.wavelengths)
        self.weights = np.asarray(scene.spectrum.weights, float)
        self.batch = math.prod(scene.planes[0].image.shape[:-2])
        self.kernel_grid = kernel_grid(camera.sensor.grid, self.field_shape)
        shape = self.kernel_grid.shape
        self.frequencies = sample_frequencies(max(shape))
        probe_of = TransferProbe if has_few_terms(camera.mask) else SampledProbe
        self.probe = probe_of(camera, shape, self.frequencies)
        fields = [
            np.asarray(project(camera, p, self.field_shape), float).reshape(-1, *self.field_shape)
            for p in scene.planes
        ]
        # (plane, image, frequency)
        self.spectra = np.stack([image_spectrum(f, self.frequencies) for f in fields])
        self.total = np.sum(fields, axis=0)
        self.crop = crop_factor(camera, min(self.distances), self.total)
        # Tangents of the angles of the field's edges; those of a single sample are 0.
        edges = (max(float(np.abs(t).max()), 1e-9) for t in tangents_of(camera, self.field_shape))
        self.edges = tuple(edges)

    @functools.cached_property
    def power(self) -> Float[np.ndarray, " k"]:
        """Power spectrum of the whole scene, times the area of each frequency."""
        light = np.sum(np.abs(self.spectra.sum(axis=0)) ** 2, axis=0)
        return light * self.frequencies.weights

    def point(self, distance: float, axis: int, part: float = 1.0) -> tuple[float, float]:
        """(y, x) of the point at a part of the field's half width along an axis, mm."""
        away = -part * self.edges[axis] * distance
        return (away, 0.0) if axis == 0 else (0.0, away)

    @functools.cached_property
    def corners(self) -> list[tuple[float, float]]:
        """Nearest and farthest plane at the shortest and longest wavelength."""
        colours = {min(self.wavelengths), max(self.wavelengths)}
        planes = {min(self.distances), max(self.distances)}
        return [(w, t) for t in sorted(planes) for w in sorted(colours)]

    @functools.cached_property
    def references(self) -> list[Complex[np.ndarray, " k"]]:
        assert isinstance(self.probe, TransferProbe)
        return [self.probe.exact(w, t, FULL) for w, t in self.corners]

    @functools.cached_property
    def rough(self) -> PsfMethod:
        """Estimate of the capture's energy."""
        return _ROUGH if self.camera.mask.exact_model else self.sampled(1)

    def sampled(self, least: int) -> PsfMethod:
        """`angular_spectrum` with the samples that hold the mask for all light, or with more."""
        mask, grid, model = self.camera.mask, self.kernel_grid, "angular_spectrum"
        held = [samples_needed(mask, grid, self.camera.path(*c), model) for c in self.corners]
        method = PsfMethod(model, "float32", oversampling=max(3, least, *held))
        return psf_method(mask, grid, method, pixel_integration=True)

    def relative(self, error: Complex[np.ndarray, "*batch k"]) -> float:
        """Norm of an image given by its spectrum, relative to that of the capture."""
        energy = float(np.sum(self.frequencies.weights * np.abs(error) ** 2))
        if energy == 0.0:
            return 0.0
        if self.capture_energy == 0.0 or math.isinf(self.crop):
            return math.inf  # the error is all there is
        return _MARGIN * self.crop * math.sqrt(energy / self.capture_energy)

    def relative_of_all(self, error: Complex[np.ndarray, " k"]) -> float:
        """Relative error of the capture by an error of the PSF that all planes share.

        The planes' errors add up with their signs, or, should these not cancel, by their squares:
        the larger of the two.
        """
        apart = np.sqrt(np.sum(np.abs(self.spectra) ** 2, axis=(0, 1)))
        return max(self.relative(error * self.spectra.sum(axis=0)), self.relative(error * apart))

    @functools.cached_property
    def capture_energy(self) -> float:
        """Energy of the capture, at the wavelength in the middle of the light."""
        middle = float(np.quantile(self.wavelengths, 0.5, method="nearest"))
        capture = sum(
            self.probe.quick(middle, distance, self.rough) * spectrum
            for distance, spectrum in zip(self.distances, self.spectra, strict=True)
        )
        light = self.weights.sum() ** 2
        return light * float(np.sum(self.frequencies.weights * np.abs(capture) ** 2))

    @property
    def models(self) -> tuple[Model, ...]:
        """Closed forms that can represent the mask, and float32 its phases in every plane."""
        mask, path = self.camera.mask, self.camera.path(min(self.wavelengths), max(self.distances))
        closed: list[Model] = [m for m in models_of(mask) if m in CLOSED]
        return tuple(m for m in closed if held_in_single(mask, self.kernel_grid, path, m))

    @property
    def edge_wave(self) -> float:
        """Amplitude of one edge's wave at the other, √(λd)/(πw)."""
        width = min(float(extent) for extent in self.camera.mask.extent)
        zone = math.sqrt(max(self.wavelengths) * float(self.camera.distance))
        return zone / (math.pi * width)

    def _points(self, method: PsfMethod) -> int:
        """Number of field points with PSFs of their own, in a quarter that is mirrored."""
        tolerance = method.field_tolerance
        if tolerance is None or tolerance >= 1:
            return 1
        every, longest = tangents_of(self.camera, self.field_shape), max(self.wavelengths)
        counts = (points_needed(self.camera, longest, t, tolerance / 2)[0] for t in every)
        return math.prod((count + 1) // 2 for count in counts)

    def psf_cost(self, method: PsfMethod) -> Cost:
        return psf_cost(self.camera.mask, self.kernel_grid, method)

    def cost(self, method: PsfMethod, planes: int, colours: int) -> Cost:
        """Cost of a capture from `planes`·`colours` PSFs, for all planes of the scene.

        Over the field, of as many PSFs and convolutions as its points, those off both axes as the
        others, which they are dearer than.
        """
        planes *= self._points(method)
        one, itemsize = self.psf_cost(method), itemsize_of(method.float_type)
        convolution = convolution_cost(
            self.camera.sensor.shape, self.field_shape, self.batch, itemsize
        )
        samples = math.prod(self.field_shape) * self.batch
        projection = 2 * sum(self.field_shape) * samples
        return Cost(
            planes * (colours * one.flops + convolution.flops)
            + len(self.distances) * (projection + 2 * planes * samples),
            one.bytes + convolution.bytes + (len(self.distances) + planes) * samples * itemsize,
        )


def crop_factor(
    camera: LenslessCamera, distance: float, images: Float[np.ndarray, "batch m n"]
) -> float:
    """‖g‖₂ of the whole image over that of its part on the sensor, at least 1.

    Infinite where no light falls on the sensor but what is diffracted there.
    Errors are known for the whole image; this bounds them on the sensor. The mask's shadow without
    its fringes, a box, stands for the PSF: its convolution is a difference of running sums.
    """
    pitch = float(camera.sensor.pitch)
    scale = 1 + float(camera.distance) / distance
    box = [scale * float(extent) / pitch for extent in camera.mask.extent]
    offset = [scale * float(c) / pitch for c in camera.mask.centre]
    kernel = [n + s - 1 for n, s in zip(images.shape[-2:], camera.sensor.shape, strict=True)]
    # The PSF is only known, and only needed, on the kernel's grid.
    low = [max(o - b / 2, -k / 2) for o, b, k in zip(offset, box, kernel, strict=True)]
    high = [min(o + b / 2, k / 2) for o, b, k in zip(offset, box, kernel, strict=True)]
    if any(top <= bottom for bottom, top in zip(low, high, strict=True)):
        return math.inf
    running = np.pad(images.cumsum(axis=-1).cumsum(axis=-2), ((0, 0), (1, 0), (1, 0)))
    sizes = images.shape[-2:]
    whole = [
        np.linspace(bottom - n / 2, top + n / 2, _POINTS)
        for bottom, top, n in zip(low, high, sizes, strict=True)
    ]
    sensor = [np.linspace(-n / 2, n / 2, _POINTS) for n in camera.sensor.shape]
    energies = [_energy(running, points, low, high) for points in (whole, sensor)]
    return max(1.0, math.sqrt(energies[0] / energies[1])) if energies[1] > 0 else math.inf


def _energy(running, points, low, high) -> float:
    """∬ of the squared convolution over the rectangle of the points."""
    sizes = [n - 1 for n in running.shape[-2:]]
    ends = [
        [np.clip(np.round(p - edge + n / 2).astype(int), 0, n) for edge in (top, bottom)]
        for p, bottom, top, n in zip(points, low, high, sizes, strict=True)
    ]
    (first_row, last_row), (first, last) = ends

    def corner(rows, columns):
        return running[:, rows[:, None], columns]

    image = corner(last_row, last) - corner(first_row, last)
    image = image - corner(last_row, first) + corner(first_row, first)
    area = math.prod(float(p[-1] - p[0]) for p in points)
    return float(np.mean(image**2)) * area
