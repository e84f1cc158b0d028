r"""Field model that a scene requires: PSF and light of the axis, or of every point.

What the axis leaves out is a change of the transfer function that grows with the angle,
:math:`H(\mathbf k; \mathbf u) - H(\mathbf k) \approx \sum_i \sum_{n=1}^4 u_i^n A_{in}(\mathbf k)`
along the two axes i, and the fall of light w (`light_over_field`). The captured error of a scene f
is then that of a few weighted scenes: with F their spectra,
:math:`\sum_{in} A_{in} F[u_i^n w f] + H\,(F[wf] - F[f])`. The change is taken from the PSFs of four
points along each axis, by the same model as that of the axis.
"""

import functools
import math
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Complex

from thincam_jax.lensless.field import points_needed, tangents_of
from thincam_jax.lensless.light import light_over_field
from thincam_jax.lensless.masks.base import (
    AbstractFactoredMask,
    AbstractMask,
    term_count,
    zone_orders,
)
from thincam_jax.lensless.method import PsfMethod
from thincam_jax.lensless.plan.seen import FULL, SeenScene
from thincam_jax.lensless.plan.transfer import TransferProbe, image_spectrum

# Parts of the field's half width where the change is looked at, and the powers of its polynomial.
_PARTS = (-1.0, -math.sqrt(0.5), math.sqrt(0.5), 1.0)
_POWERS = (1, 2, 3, 4)
# Errors of the PSFs between which the tolerance is kept.
_SMALLEST, _LARGEST = 3e-3, 0.3
# Error of the PSFs of cells off both axes, which are sampled.
_CELLS = 0.03
# What the two axes tell of the corners' changes behind masks without zones.
_CORNERS = 2.0
# Error in parts of the sum of the errors allowed: at least that of 198 of 200 random cameras.
_FOUND = 1 / 2


@dataclass(frozen=True, eq=False)
class _Change:
    """H of the axis, and A of its change in parts of the field's edge."""

    middle: Complex[np.ndarray, " k"]
    powers: Complex[np.ndarray, "2 4 k"]


def knows_field(seen: SeenScene) -> bool:
    """Whether the model has the mask's PSF along the field's axes: of all but rings."""
    return seen.camera.mask.exact_model != "radial"


def choose_field(seen: SeenScene, method: PsfMethod, tolerance: float) -> tuple[PsfMethod, float]:
    """The method with the PSF and the light of the axis, the light or both of every point.

    The first that is within the tolerance.
    """
    # Of cells and of samples, those of the farthest plane and the longest wavelength.
    corners = seen.corners if _has_chirps(seen.camera.mask) else seen.corners[-1:]
    changes = [_change(seen, method, *corner) for corner in corners]
    error, of_psf = _errors(seen, changes)
    if error <= tolerance:
        return method, error
    spread = _FOUND * max(map(functools.partial(_spread, seen), changes))
    light = replace(method, field_tolerance=1.0)
    own, share = _own(seen, light, tolerance / spread)
    if of_psf <= max(tolerance, spread * share):
        return light, of_psf
    assert own.field_tolerance is not None
    try:
        for tangents in tangents_of(seen.camera, seen.field_shape):
            points_needed(seen.camera, max(seen.wavelengths), tangents, own.field_tolerance / 2)
    except ValueError:  # the field is too wide for its operator
        return light, of_psf
    return own, spread * share


def _own(seen: SeenScene, method: PsfMethod, share: float) -> tuple[PsfMethod, float]:
    """The method of every point's own PSF, and its relative error; infinite of lenses."""
    mask = seen.camera.mask
    if zone_orders(mask) is not None:
        share = min(max(share, _SMALLEST), _LARGEST)
        own = PsfMethod("separable", method.precision, True, field_tolerance=share / 2)
        return own, share
    if _has_chirps(mask):
        return method, math.inf
    if isinstance(mask, AbstractFactoredMask):
        share = min(max(share, 2 * _CELLS), _LARGEST)
        own = PsfMethod("separable", method.precision, True, nodes=method.nodes)
        return replace(own, field_tolerance=share - _CELLS), share
    share = min(max(share, _CELLS), _LARGEST)
    return replace(method, field_tolerance=share), share


def _has_chirps(mask: AbstractMask) -> bool:
    return isinstance(mask, AbstractFactoredMask) and term_count(mask).chirped


def _change(seen: SeenScene, method: PsfMethod, wavelength: float, distance: float) -> _Change:
    """Change of H over the field at one wavelength and distance, by four points an axis."""
    probe = seen.probe

    def transfer(at: tuple[float, float] | None = None) -> Complex[np.ndarray, " k"]:
        if isinstance(probe, TransferProbe):
            return probe.exact(wavelength, distance, FULL, at)
        return probe.quick(wavelength, distance, method, at)

    middle = transfer()
    powers = np.array([[part**n for n in _POWERS] for part in _PARTS])
    found = [
        np.linalg.solve(
            powers, np.stack([transfer(seen.point(distance, axis, p)) for p in _PARTS]) - middle
        )
        for axis in (0, 1)
    ]
    corners = 1.0 if zone_orders(seen.camera.mask) is not None else _CORNERS
    return _Change(middle, corners * np.stack(found))


def _errors(seen: SeenScene, changes: list[_Change]) -> tuple[float, float]:
    """Relative errors of the capture with the axis' PSF and light, and with its PSF alone."""
    tangents = tangents_of(seen.camera, seen.field_shape)
    lit = seen.total * np.asarray(light_over_field(seen.camera.sensor, *tangents))
    dimmed = image_spectrum(lit - seen.total, seen.frequencies)
    edges = zip((tangents[0][:, None], tangents[1]), seen.edges, strict=True)
    parts = [t / edge for t, edge in edges]
    weighted = [[image_spectrum(lit * p**n, seen.frequencies) for n in _POWERS] for p in parts]
    both, of_psf = 0.0, 0.0
    for change in changes:
        error = np.einsum("apk,apbk->bk", change.powers, np.array(weighted)) * seen.weights.sum()
        of_psf = max(of_psf, seen.relative(error))
        both = max(both, seen.relative(error + change.middle * dimmed * seen.weights.sum()))
    return both, of_psf


def _spread(seen: SeenScene, change: _Change) -> float:
    """Relative error of the capture for one of the PSFs, at the frequencies of their change."""
    power, weights = np.abs(change.powers.sum(axis=1)) ** 2, seen.frequencies.weights
    profile = np.sqrt(power.sum(axis=0) / np.sum(weights * power))
    light = math.sqrt(float(np.sum(weights * np.abs(change.middle) ** 2)))
    return seen.relative_of_all((profile * light * seen.weights.sum()).astype(complex))
