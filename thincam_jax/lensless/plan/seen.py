"""A scene as a camera sees it, at a few hundred frequencies."""

import functools
import math

import numpy as np
from jaxtyping import Complex, Float

from thincam_jax._core.precision import itemsize_of
from thincam_jax.imaging.operators.crop_convolution import kernel_grid
from thincam_jax.imaging.scene import Scene
from thincam_jax.lensless.camera import LenslessCamera
from thincam_jax.lensless.field import points_needed, tangents_of
from thincam_jax.lensless.forward import project, projected_shape
from thincam_jax.lensless.masks.base import has_few_terms
from thincam_jax.lensless.method import CLOSED, Model, PsfMethod, models_of, psf_method
from thincam_jax.lensless.plan.transfer import (
    SampledProbe,
    TransferProbe,
    image_spectrum,
    sample_frequencies,
)
from thincam_jax.lensless.resolve import (
    Cost,
    convolution_cost,
    held_in_single,
    psf_cost,
    samples_needed,
)

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
        """Closed forms that can represent the mask."""
        return tuple(m for m in models_of(self.camera.mask) if m in CLOSED)

    def held_in_single(self, model: str) -> bool:
        """Whether float32 can represent the zones' phases on the kernel's grid for every plane."""
        path = self.camera.path(min(self.wavelengths), max(self.distances))
        return held_in_single(self.camera.mask, self.kernel_grid, path, model)

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
