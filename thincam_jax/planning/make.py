"""Making a plan: the cheapest computation of a scene's capture within a tolerance."""

import functools
import math
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Complex, Float

from thincam_jax import _checks
from thincam_jax._precision import Precision
from thincam_jax.camera import LenslessCamera
from thincam_jax.cost import Cost, convolution_cost, psf_cost
from thincam_jax.grids import Grid, fast_shape
from thincam_jax.imaging import project, projected_shape
from thincam_jax.operators import kernel_grid, kernel_shape
from thincam_jax.planning.compress import fit, order_of_columns
from thincam_jax.planning.crop import crop_factor
from thincam_jax.planning.effects import effects_of
from thincam_jax.planning.plan import Plan
from thincam_jax.planning.spectrum import image_spectrum, sample_frequencies
from thincam_jax.planning.transfer import TransferProbe
from thincam_jax.propagation.orders import require_zone_orders
from thincam_jax.propagation.separable import PIXEL_NODES
from thincam_jax.psf import Model
from thincam_jax.scene import Scene
from thincam_jax.selection.select import tolerance_of
from thincam_jax.selection.terms import CLOSED

# Parts of the tolerance that the decisions may use, in the order in which they are taken. What one
# leaves over is the next one's.
_MODEL_SHARE, _WAVELENGTH_SHARE = 0.35, 0.6
# Predictions come from some hundred random frequencies: what they are multiplied with.
_MARGIN = 1.5
# Nodes of the pixel average where PSFs are compared with each other, at tolerances down to `_FINE`:
# the fringes of the far edges, which need more, are a few parts in a thousand of a PSF. From
# `_FINEST` on single precision would show.
_FEW_NODES, _FINE, _FINEST = 6, 1e-3, 1e-5
# Members of a batch of images that are looked at.
_MEMBERS = 3


class Way(NamedTuple):
    """One way of computing a PSF."""

    model: Model
    precision: Precision
    pixel_integration: bool


def plan(camera: LenslessCamera, scene: Scene, *, tolerance: float) -> Plan:
    r"""How to compute the capture of a scene to a relative error, at the least cost.

    The error is ‖g − g₀‖₂/‖g₀‖₂ of the noise-free capture, against every plane and wavelength
    computed by `separable` in double precision, averaged over the pixels. What is decided, from the
    PSFs' transfer functions at a few hundred frequencies, weighted with the scene's own spectrum:

    - the model, the precision and whether pixels must be averaged;
    - how many wavelengths: some of the spectrum's, with weights that reproduce its sum;
    - how many PSFs for the planes: each plane's PSF is a weighted sum of a few planes'
      (interpolative decomposition), and planes are added up with these weights *before* they are
      convolved. Planes with nearly equal PSFs merge into one.

    Obliquity, shot noise and what Fresnel's approximation leaves out are told with their sizes in
    `Plan.effects`.

    **Errors**: ValueError for a tolerance that is not positive; TypeError for a mask without zone
    orders, and for traced numbers.
    """
    tolerance = tolerance_of(tolerance)
    require_zone_orders(camera.mask, "plan")
    if any(_checks.is_traced(leaf) for leaf in jax.tree.leaves((camera, scene))):
        raise TypeError("plan needs known numbers: call it outside of jit and grad")
    view = _View(camera, scene, tolerance)
    way, model_error = _choose_way(view, tolerance * _MODEL_SHARE)
    left = max(tolerance - model_error, 0.0)
    colours, weights, colour_error = _choose_wavelengths(view, way, left * _WAVELENGTH_SHARE)
    left = max(tolerance - model_error - colour_error, 0.0)
    planes, mixing, plane_error = _choose_planes(view, way, colours, weights, left)
    shares = {"model": model_error, "wavelengths": colour_error, "planes": plane_error}
    kernel = kernel_grid(camera.sensor.grid, view.field_shape)
    return Plan(
        tolerance=tolerance,
        predicted_error=sum(shares.values()),
        model=way.model,
        precision=way.precision,
        pixel_integration=way.pixel_integration,
        distances=tuple(view.distances[p] for p in planes),
        mixing=mixing,
        wavelengths=tuple(view.wavelengths[c] for c in colours),
        weights=tuple(float(w) for w in weights),
        scene_distances=view.distances,
        scene_wavelengths=view.wavelengths,
        field_shape=view.field_shape,
        padded_shape=fast_shape(kernel.shape, real=True),
        cost=_cost(view, kernel, way, len(planes), len(colours)),
        full_cost=_cost(view, kernel, _FULL, len(view.distances), len(view.wavelengths)),
        shares=shares,
        effects=effects_of(camera, scene, tolerance),
    )


_FULL = Way("separable", "float64", True)


class _View:
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
        members = np.unique(np.linspace(0, self.batch - 1, min(self.batch, _MEMBERS)).astype(int))
        fields = [
            np.asarray(project(camera, p, self.field_shape), float).reshape(-1, *self.field_shape)[
                members
            ]
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
            self.probe.exact(w, t, _FULL.model, _FULL.precision, _FULL.pixel_integration)
            for w, t in self.corners
        ]

    def relative(self, error: Complex[np.ndarray, "*member k"]) -> float:
        """Norm of an image given by its spectrum, relative to that of the capture."""
        energy = np.sum(self.frequencies.weights * np.abs(error) ** 2)
        return _MARGIN * self.crop * math.sqrt(energy / self.capture_energy)

    @functools.cached_property
    def capture_energy(self) -> float:
        """Of the capture, taking the PSF of one corner for all; the smallest of them."""
        light = self.weights.sum() ** 2
        energies = [light * float(np.sum(self.power * np.abs(h) ** 2)) for h in self.references]
        return min(energies) or 1.0


def _choose_way(view: _View, tolerance: float) -> tuple[Way, float]:
    """The cheapest model, precision and pixel average within the tolerance at the corners."""
    kernel = kernel_grid(view.camera.sensor.grid, view.field_shape)
    # Double precision is for where single cannot serve: a cheaper model would not help there.
    ways = [Way(model, "float32", average) for model in CLOSED for average in (False, True)]
    ways += [Way("separable", "float64", average) for average in (False, True)]
    if _way_error(view, Way("separable", "float32", False)) > max(tolerance, 1e-3):
        ways = [way for way in ways if way.pixel_integration]
    best: tuple[Way, float] = (_FULL, 0.0)
    for way in sorted(ways, key=lambda w: _speed(view, kernel, w)):
        error = _way_error(view, way)
        if error <= tolerance:
            return way, error
    return best


def _speed(view: _View, kernel: Grid, way: Way) -> float:
    double = way.precision == "float64"
    return _psf_cost(view, kernel, way).flops * (2.0 if double else 1.0)


def _way_error(view: _View, way: Way) -> float:
    if way == _FULL:
        return 0.0
    total = view.spectra.sum(axis=0) * view.weights.sum()
    worst = 0.0
    for (wavelength, distance), exact in zip(view.corners, view.references, strict=True):
        found = view.probe.exact(
            wavelength, distance, way.model, way.precision, way.pixel_integration
        )
        error = view.relative((found - exact) * total)
        worst = max(worst, error if math.isfinite(error) else math.inf)
    return worst


def _choose_wavelengths(view: _View, way: Way, tolerance: float):
    """Some wavelengths and their weights, that reproduce the sum over all at both depth ends."""
    count = len(view.wavelengths)
    if count == 1:
        return [0], view.weights, 0.0
    ends = sorted({min(view.distances), max(view.distances)})
    columns = np.concatenate(
        [np.stack([_quick(view, way, w, t) for w in view.wavelengths], axis=-1) for t in ends]
    )
    power = np.tile(np.sqrt(view.power), len(ends))[:, None]
    target = columns @ view.weights
    order = order_of_columns(columns * power)
    total = np.tile(view.spectra.sum(axis=0), len(ends))
    for few in range(1, count):
        picked = sorted(order[:few])
        weights = fit(columns[:, picked] * power, target * power[:, 0])
        error = (columns[:, picked] @ weights - target) * total
        size = max(view.relative(part) for part in np.split(error, len(ends), axis=-1))
        if size <= tolerance:
            return picked, weights, size
    return list(range(count)), view.weights, 0.0


def _quick(view: _View, way: Way, wavelength: float, distance: float):
    nodes = _FEW_NODES if view.tolerance >= _FINE else PIXEL_NODES
    if view.tolerance < _FINEST:
        return view.probe.exact(wavelength, distance, *way)
    return view.probe.quick(wavelength, distance, way.model, way.pixel_integration, nodes)


def _choose_planes(view: _View, way: Way, colours, weights, tolerance: float):
    """Some planes whose PSFs stand for all, and the weights with which they do."""
    count = len(view.distances)
    if count == 1:
        return [0], np.eye(1), 0.0
    columns = np.stack(
        [
            sum(
                w * _quick(view, way, view.wavelengths[c], t)
                for c, w in zip(colours, weights, strict=True)
            )
            for t in view.distances
        ],
        axis=-1,
    )
    area = np.sqrt(view.frequencies.weights)
    light = np.sqrt(np.sum(np.abs(view.spectra) ** 2, axis=1)).T * area[:, None]
    order = order_of_columns(columns * light)
    for few in range(1, count):
        picked = sorted(order[:few])
        chosen = columns[:, picked]
        mixing = np.stack(
            [fit(chosen * light[:, [p]], columns[:, p] * light[:, p]) for p in range(count)],
            axis=-1,
        )
        error = np.einsum("kp,pbk->bk", chosen @ mixing - columns, view.spectra)
        size = view.relative(error)
        if size <= tolerance:
            return picked, mixing, size
    return list(range(count)), np.eye(count), 0.0


def _psf_cost(view: _View, kernel: Grid, way: Way) -> Cost:
    return psf_cost(
        view.camera.mask,
        kernel,
        way.model,
        pixel_integration=way.pixel_integration,
        itemsize=8 if way.precision == "float64" else 4,
    )


def _cost(view: _View, kernel: Grid, way: Way, planes: int, colours: int) -> Cost:
    itemsize = 8 if way.precision == "float64" else 4
    one = _psf_cost(view, kernel, way)
    convolution = convolution_cost(view.camera.sensor.shape, view.field_shape, view.batch, itemsize)
    fields = math.prod(view.field_shape) * view.batch * itemsize
    projections = 2 * sum(view.field_shape) * math.prod(view.field_shape) * view.batch
    return Cost(
        planes * (colours * one.flops + convolution.flops)
        + len(view.distances) * (projections + 2 * planes * math.prod(view.field_shape)),
        one.bytes + convolution.bytes + (len(view.distances) + planes) * fields,
    )
