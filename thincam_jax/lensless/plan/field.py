r"""Field model that a scene requires: PSF and light of the axis, or of every point.

What the axis leaves out is a change of the transfer function that grows with the angle,
:math:`H(\mathbf k; \mathbf u) - H(\mathbf k) \approx \sum_i u_i^2 A_i(\mathbf k) + u_i^4
B_i(\mathbf k)` along the two axes i, and the fall of light w (`light_over_field`). The captured
error of a scene f is then that of a few weighted scenes: with F their spectra,
:math:`\sum_i A_i F[u_i^2 w f] + B_i F[u_i^4 w f] + H\,(F[wf] - F[f])`.
"""

import functools
import math
from dataclasses import replace

import numpy as np
from jaxtyping import Complex

from thincam_jax.lensless.field import points_needed, tangents_of
from thincam_jax.lensless.light import light_over_field
from thincam_jax.lensless.masks.base import zone_orders
from thincam_jax.lensless.method import PsfMethod
from thincam_jax.lensless.plan.seen import FULL, SeenScene
from thincam_jax.lensless.plan.transfer import TransferProbe, image_spectrum
from thincam_jax.lensless.propagation.skew import PIXEL_POINTS

# Parts of the field's half width where the change is looked at.
_PARTS = math.sqrt(0.5), 1.0
# Error of a pixel's average by n points is this over n, where a pixel holds many fringes.
_LATTICE = 0.35
_MOST_POINTS, _LARGEST = 233, 0.3
# The largest error found over random cameras, in parts of the sum of the errors allowed.
_FOUND = 1 / 3


def knows_field(seen: SeenScene) -> bool:
    """Whether the model has the mask's PSF at every point of the field."""
    return isinstance(seen.probe, TransferProbe) and zone_orders(seen.camera.mask) is not None


def choose_field(seen: SeenScene, method: PsfMethod, tolerance: float) -> tuple[PsfMethod, float]:
    """The method with the PSF and the light of the axis, the light or both of every point.

    The first that is within the tolerance.
    """
    changes = [_changes(seen, *corner) for corner in seen.corners]
    error, of_psf = _errors(seen, changes)
    if error <= tolerance:
        return method, error
    if of_psf <= tolerance:
        return replace(method, field_tolerance=1.0), of_psf
    spread = _FOUND * max(map(functools.partial(_spread, seen), changes, seen.references))
    least = 2 * _LATTICE / _MOST_POINTS
    share = min(max(tolerance / spread, least), _LARGEST)
    nodes = max(PIXEL_POINTS, math.ceil(2 * _LATTICE / share))
    own = PsfMethod("separable", method.precision, True, nodes=nodes, field_tolerance=share / 2)
    try:
        for tangents in tangents_of(seen.camera, seen.field_shape):
            points_needed(seen.camera, max(seen.wavelengths), tangents, share / 4)
    except ValueError:  # the field is too wide for its operator
        return replace(method, field_tolerance=1.0), of_psf
    return own, spread * share


def _changes(seen: SeenScene, wavelength: float, distance: float) -> Complex[np.ndarray, "2 2 k"]:
    """A and B of the change along each axis, in parts of the field's edge, from two points."""
    assert isinstance(seen.probe, TransferProbe)
    powers = np.array([[part**2, part**4] for part in _PARTS])
    found = []
    for axis in (0, 1):
        middle, *others = (
            seen.probe.exact(wavelength, distance, FULL, seen.point(distance, axis, part))
            for part in (0.0, *_PARTS)
        )
        found.append(np.linalg.solve(powers, np.stack(others) - middle))
    return np.stack(found)


def _errors(seen: SeenScene, changes: list[Complex[np.ndarray, "2 2 k"]]) -> tuple[float, float]:
    """Of the capture with the PSF and the light of the axis, and with its PSF alone."""
    tangents = tangents_of(seen.camera, seen.field_shape)
    lit = seen.total * np.asarray(light_over_field(seen.camera.sensor, *tangents))
    dimmed = image_spectrum(lit - seen.total, seen.frequencies)
    edges = zip((tangents[0][:, None], tangents[1]), seen.edges, strict=True)
    parts = [t / edge for t, edge in edges]
    weighted = [[image_spectrum(lit * p**n, seen.frequencies) for n in (2, 4)] for p in parts]
    both, of_psf = 0.0, 0.0
    for middle, change in zip(seen.references, changes, strict=True):
        error = np.einsum("apk,apbk->bk", change, np.array(weighted)) * seen.weights.sum()
        of_psf = max(of_psf, seen.relative(error))
        both = max(both, seen.relative(error + middle * dimmed * seen.weights.sum()))
    return both, of_psf


def _spread(
    seen: SeenScene, change: Complex[np.ndarray, "2 2 k"], middle: Complex[np.ndarray, " k"]
) -> float:
    """Relative error of the capture for one of the PSFs, at the frequencies of their change."""
    power, weights = np.abs(change.sum(axis=1)) ** 2, seen.frequencies.weights
    profile = np.sqrt(power.sum(axis=0) / np.sum(weights * power))
    light = math.sqrt(float(np.sum(weights * np.abs(middle) ** 2)))
    return seen.relative_of_all((profile * light * seen.weights.sum()).astype(complex))
