"""The decisions of a plan: which model, which wavelengths, which planes."""

import math

import numpy as np

from thincam_jax.lensless.plan.compress import fit, order_of_columns
from thincam_jax.lensless.plan.view import FULL, View, Way
from thincam_jax.lensless.propagation.separable import PIXEL_NODES

# Nodes of the pixel average where PSFs are compared with each other, and how far the tolerance must
# be above the far edge's wave, √(λd)/(πw) of the light, whose fringes these nodes do not follow.
_FEW_NODES, _ABOVE_EDGES = 6, 2.5
# What float32's convolution leaves of a capture.
_CONVOLUTION_ROUNDING = 1.5e-6
# Below this tolerance nearly every PSF is needed, and finding which costs more than it saves.
_EVERYTHING = 3e-5


def choose_way(view: View, tolerance: float) -> tuple[Way, float]:
    """The cheapest model, precision and pixel average within the tolerance at the corners."""
    # Double precision is for where single cannot serve: a cheaper model would not help there.
    ways = [
        Way(model, "float32", average)
        for model in view.models
        for average in (False, True)
        if view.held_in_single(model)
    ]
    ways += [Way("separable", "float64", average) for average in (False, True)]
    if _way_error(view, Way("separable", "float32", False)) > max(tolerance, 1e-3):
        ways = [way for way in ways if way.pixel_integration]
    best: tuple[Way, float] = (FULL, 0.0)
    for way in sorted(ways, key=lambda w: _speed(view, w)):
        error = _way_error(view, way)
        if error <= tolerance:
            return way, error
    return best


def _speed(view: View, way: Way) -> float:
    double = way.precision == "float64"
    return view.psf_cost(way).flops * (2.0 if double else 1.0)


def _way_error(view: View, way: Way) -> float:
    if way == FULL:
        return 0.0
    worst = 0.0
    for (wavelength, distance), exact in zip(view.corners, view.references, strict=True):
        found = view.probe.exact(
            wavelength, distance, way.model, way.precision, way.pixel_integration
        )
        error = view.relative_of_all((found - exact) * view.weights.sum())
        worst = max(worst, error if math.isfinite(error) else math.inf)
    rounding = _CONVOLUTION_ROUNDING * view.crop if way.precision == "float32" else 0.0
    return worst + rounding


def choose_wavelengths(view: View, way: Way, tolerance: float):
    """Some wavelengths and their weights, that reproduce the sum over all for three planes."""
    count = len(view.wavelengths)
    if count == 1 or view.tolerance < _EVERYTHING:
        return list(range(count)), view.weights, 0.0
    some = sorted(set(np.quantile(view.distances, [0, 0.5, 1], method="nearest").tolist()))
    columns = np.concatenate(
        [np.stack([_quick(view, way, w, t) for w in view.wavelengths], axis=-1) for t in some]
    )
    power = np.tile(np.sqrt(view.power), len(some))[:, None]
    target = columns @ view.weights
    order = order_of_columns((columns * power)[::2])
    for few in range(1, count):
        picked = sorted(order[:few])
        weights = fit((columns[:, picked] * power)[::2], (target * power[:, 0])[::2])
        error = columns[:, picked] @ weights - target
        size = max(view.relative_of_all(part) for part in np.split(error, len(some)))
        if size <= tolerance:
            return picked, weights, size
    return list(range(count)), view.weights, 0.0


def _quick(view: View, way: Way, wavelength: float, distance: float):
    few = view.tolerance > _ABOVE_EDGES * view.edge_wave
    nodes = _FEW_NODES if few else PIXEL_NODES
    return view.probe.quick(wavelength, distance, way.model, way.pixel_integration, nodes)


def choose_planes(view: View, way: Way, colours, weights, tolerance: float):
    """Some planes whose PSFs stand for all, and the weights with which they do."""
    count = len(view.distances)
    if count == 1 or view.tolerance < _EVERYTHING:
        return list(range(count)), np.eye(count), 0.0
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
    order = order_of_columns((columns * light)[::2])
    for few in range(1, count):
        picked = sorted(order[:few])
        chosen = columns[:, picked]
        mixing = np.stack(
            [
                fit((chosen * light[:, [p]])[::2], (columns[:, p] * light[:, p])[::2])
                for p in range(count)
            ],
            axis=-1,
        )
        error = np.einsum("kp,pbk->bk", chosen @ mixing - columns, view.spectra)
        size = view.relative(error)
        if size <= tolerance:
            return picked, mixing, size
    return list(range(count)), np.eye(count), 0.0
