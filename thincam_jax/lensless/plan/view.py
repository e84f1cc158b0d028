"""A scene as a camera sees it, at a few hundred frequencies."""

import functools
import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Complex, Float

from thincam_jax._core.precision import Precision, itemsize_of
from thincam_jax.imaging.operators import kernel_grid, kernel_shape
from thincam_jax.imaging.scene import Scene
from thincam_jax.lensless.accuracy.terms import CLOSED
from thincam_jax.lensless.camera import LenslessCamera
from thincam_jax.lensless.cost import Cost, convolution_cost, psf_cost
from thincam_jax.lensless.digits import held_in_single
from thincam_jax.lensless.exposure import project, projected_shape
from thincam_jax.lensless.plan.crop import crop_factor
from thincam_jax.lensless.plan.spectrum import image_spectrum, sample_frequencies
from thincam_jax.lensless.plan.transfer import TransferProbe
from thincam_jax.lensless.psf import UNBOUNDED, Model

# Predictions come from some hundred random frequencies: what they are multiplied with.
_MARGIN = 1.5
# Nodes of the pixel average for the capture's energy, which fringes hardly change.
_ENERGY_NODES = 6


class Way(NamedTuple):
    """One way of computing a PSF."""

    model: Model
    precision: Precision
    pixel_integration: bool

    @property
    def itemsize(self) -> int:
        return itemsize_of(self.precision)


FULL = Way("separable", "float64", True)


class View:
    """A scene as the sensor sees it, at a few frequencies."""

    def __init__(self, camera: LenslessCamera, scene: Scene, tolerance: float) -> None:
        self.camera, self.tolerance = camera, tolerance
        shapes = [projected_shape(camera, p) for p in scene.planes]
        self.field_shape = (max(s[0] for s in shapes), max(s[1] for s in shapes))
        self.distances = tuple(float(p.distance) for p in scene.planes)
        self.wavelengths = tuple(float(w) for w in scene.spectrum.wavelengths)
        self.weights = np.asarray(scene.spectrum.weights, float)
        self.batch = math.prod(scene.planes[0].image.shape[:-2])
        shape = kernel_shape(camera.sensor.shape, self.field_shape)
        self.frequencies = sample_frequencies(max(shape))
        self.probe = TransferProbe(camera, shape, self.frequencies)
        fields = [
            np.asarray(project(camera, p, self.field_shape), float).reshape(-1, *self.field_shape)
            for p in scene.planes
        ]
        # (plane, member, frequency)
        self.spectra = np.stack([image_spectrum(f, self.frequencies) for f in fields])
        total = np.sum(fields, axis=0)
        self.crop = crop_factor(camera, min(self.distances), total)

    @functools.cached_property
    def power(self) -> Float[np.ndarray, " k"]:
        """Of the whole scene, times the area of each frequency."""
        light = np.sum(np.abs(self.spectra.sum(axis=0)) ** 2, axis=0)
        return light * self.frequencies.weights

    @functools.cached_property
    def corners(self) -> list[tuple[float, float]]:
        """Nearest and farthest plane at the shortest and longest wavelength."""
        colours = {min(self.wavelengths), max(self.wavelengths)}
        planes = {min(self.distances), max(self.distances)}
        return [(w, t) for t in sorted(planes) for w in sorted(colours)]

    @functools.cached_property
    def references(self) -> list[Complex[np.ndarray, " k"]]:
        return [
            self.probe.exact(w, t, FULL.model, FULL.precision, FULL.pixel_integration)
            for w, t in self.corners
        ]

    def relative(self, error: Complex[np.ndarray, "*member k"]) -> float:
        """Norm of an image given by its spectrum, relative to that of the capture."""
        energy = float(np.sum(self.frequencies.weights * np.abs(error) ** 2))
        if energy == 0.0:
            return 0.0
        if self.capture_energy == 0.0 or math.isinf(self.crop):
            return math.inf  # the error is all there is
        return _MARGIN * self.crop * math.sqrt(energy / self.capture_energy)

    def relative_of_all(self, error: Complex[np.ndarray, " k"]) -> float:
        """The same for an error of the PSF that all planes share.

        They add up, or, where they cancel, may do so no longer: the larger of the two.
        """
        apart = np.sqrt(np.sum(np.abs(self.spectra) ** 2, axis=(0, 1)))
        return max(self.relative(error * self.spectra.sum(axis=0)), self.relative(error * apart))

    @functools.cached_property
    def capture_energy(self) -> float:
        """Of the capture, at the wavelength in the middle of the light."""
        middle = float(np.quantile(self.wavelengths, 0.5, method="nearest"))
        capture = sum(
            self.probe.quick(middle, distance, "separable", True, _ENERGY_NODES) * spectrum
            for distance, spectrum in zip(self.distances, self.spectra, strict=True)
        )
        light = self.weights.sum() ** 2
        return light * float(np.sum(self.frequencies.weights * np.abs(capture) ** 2))

    @property
    def models(self) -> tuple[Model, ...]:
        """Closed forms that can hold the mask."""
        displayed = getattr(self.camera.mask, "pixels", None) is not None
        return tuple(m for m in CLOSED if not displayed or m not in UNBOUNDED)

    def held_in_single(self, model: str) -> bool:
        """Whether float32 holds the zones' phases, on the kernel's grid, for every plane."""
        grid = kernel_grid(self.camera.sensor.grid, self.field_shape)
        path = self.camera.path(min(self.wavelengths), max(self.distances))
        return held_in_single(self.camera.mask, grid, path, model)

    @property
    def edge_wave(self) -> float:
        """Amplitude of one edge's wave at the other, √(λd)/(πw)."""
        width = min(float(extent) for extent in self.camera.mask.extent)
        zone = math.sqrt(max(self.wavelengths) * float(self.camera.distance))
        return zone / (math.pi * width)

    def psf_cost(self, way: Way) -> Cost:
        return psf_cost(
            self.camera.mask,
            kernel_grid(self.camera.sensor.grid, self.field_shape),
            way.model,
            pixel_integration=way.pixel_integration,
            itemsize=way.itemsize,
        )

    def cost(self, way: Way, planes: int, colours: int) -> Cost:
        """Of a capture from so many PSFs, for all planes of the scene."""
        one = self.psf_cost(way)
        convolution = convolution_cost(
            self.camera.sensor.shape, self.field_shape, self.batch, way.itemsize
        )
        samples = math.prod(self.field_shape) * self.batch
        projection = 2 * sum(self.field_shape) * samples
        return Cost(
            planes * (colours * one.flops + convolution.flops)
            + len(self.distances) * (projection + 2 * planes * samples),
            one.bytes + convolution.bytes + (len(self.distances) + planes) * samples * way.itemsize,
        )
