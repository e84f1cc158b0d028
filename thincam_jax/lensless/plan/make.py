r"""Making a plan: the cheapest computation of a scene's capture within a tolerance.

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

import jax
import numpy as np
from jaxtyping import Complex

from thincam_jax._core import checks
from thincam_jax._core.arguments import checked
from thincam_jax._core.grids import fast_shape
from thincam_jax._core.precision import RESULT_ROUNDING, precision_of
from thincam_jax._core.progress import watched
from thincam_jax.imaging.operators.crop_convolution import kernel_shape
from thincam_jax.imaging.scene import Scene
from thincam_jax.lensless.accuracy.select import tolerance_of
from thincam_jax.lensless.camera import LenslessCamera
from thincam_jax.lensless.field import light_over_field, points_needed, tangents_of
from thincam_jax.lensless.masks.base import (
    AbstractFactoredMask,
    AbstractMask,
    has_few_terms,
    term_count,
    zone_orders,
)
from thincam_jax.lensless.method import PsfMethod
from thincam_jax.lensless.plan.choose import choose_planes, choose_psf, choose_wavelengths
from thincam_jax.lensless.plan.run import CapturePlan, effects_of
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


def choose_field(seen: SeenScene, method: PsfMethod, tolerance: float) -> tuple[PsfMethod, float]:
    """The model with the PSF and light of the axis, or with the light or both of every point.

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
    """The model with each point's own PSF, and its relative error; infinite for lenses."""
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


# Parts of the tolerance that the decisions may use, in the order in which they are taken. What one
# leaves over is the next one's.
_MODEL_SHARE, _FIELD_SHARE, _WAVELENGTH_SHARE = 0.3, 0.3, 0.6


@checked
@watched("planning the capture")
def plan_capture(
    camera: LenslessCamera, scene: Scene, *, tolerance: float, over_field: bool = True
) -> CapturePlan:
    r"""Plan the capture of a scene to a relative error at the least cost.

    The error is ‖g − g₀‖₂/‖g₀‖₂ of the noise-free capture, against every plane and wavelength
    computed by `separable` in double precision, averaged over the pixels, at every point of the
    field, or by endlessly many
    samples of `angular_spectrum` for masks without few separable terms. What is decided, from the
    PSFs' transfer functions at a few hundred frequencies, weighted with the scene's own spectrum:

    - the model, the precision and whether pixels must be averaged, or the samples a pixel;
    - whether every point of the field needs its own PSF and light (`field_operator`; not of
      lenses), or the PSF and the light of the axis suffice;
    - how many wavelengths: some of the spectrum's, with weights that reproduce its sum;
    - how many PSFs for the planes: each plane's PSF is a weighted sum of a few planes'
      (interpolative decomposition), and planes are added up with these weights *before* they are
      convolved. Planes with nearly equal PSFs merge into one.

    With `over_field` False the capture is that of the axis' PSF and light, as solvers that are
    given cameras assume it, and the error is against that; so it is for rings. Then
    `CapturePlan.effects` lists what changes over the field, with its size, and always shot noise
    and what Fresnel's approximation leaves out.

    **Errors**: ValueError for a tolerance that is not positive; TypeError for traced numbers.

    ```python
    import thincam_jax as tc
    from thincam_jax.units import nm, um

    mask = tc.FresnelZoneAperture(25.0, width=1.6)
    camera = tc.LenslessCamera(mask, tc.Sensor((24, 32), 50 * um), distance=5.0)
    planes = [tc.ImagePlane([[0.0, 1.0]], d, width=0.2 * d) for d in (200.0, 210.0)]
    plan = tc.plan_capture(camera, tc.Scene(planes, 500 * nm), tolerance=0.05)
    print(plan.predicted_error < 0.05)  # True
    ```

    **See also**: `choose_model`, `capture`.
    """
    tolerance = tolerance_of(tolerance)
    if any(checks.is_traced(leaf) for leaf in jax.tree.leaves((camera, scene))):
        raise TypeError("plan_capture needs known numbers: call it outside of jit and grad")
    seen = SeenScene(camera, scene, tolerance)
    method, model_error = choose_psf(seen, tolerance * _MODEL_SHARE)
    model_error += RESULT_ROUNDING[precision_of(camera.sensor.pitch)]
    field_error, over_field = 0.0, over_field and camera.mask.exact_model != "radial"
    if over_field:
        method, field_error = choose_field(seen, method, tolerance * _FIELD_SHARE)
    left = max(tolerance - model_error - field_error, 0.0)
    colours, weights, colour_error = choose_wavelengths(seen, method, left * _WAVELENGTH_SHARE)
    left = max(left - colour_error, 0.0)
    planes, mixing, plane_error = choose_planes(seen, method, colours, weights, left)
    in_full = replace(FULL, nodes=method.nodes, field_tolerance=method.field_tolerance)
    full = in_full if has_few_terms(camera.mask) else method
    shares = {"model": model_error, "field": field_error}
    shares |= {"wavelengths": colour_error, "planes": plane_error}
    window = fast_shape(kernel_shape(camera.sensor.shape, seen.field_shape), real=True)
    return CapturePlan(
        camera=camera,
        tolerance=tolerance,
        predicted_error=sum(shares.values()),
        method=method,
        distances=tuple(seen.distances[p] for p in planes),
        mixing=mixing,
        wavelengths=tuple(seen.wavelengths[c] for c in colours),
        weights=tuple(float(w) for w in weights),
        scene_distances=seen.distances,
        scene_wavelengths=seen.wavelengths,
        scene_weights=tuple(float(w) for w in seen.weights),
        field_shape=seen.field_shape,
        padded_shape=window,
        cost=seen.cost(method, len(planes), len(colours)),
        full_cost=seen.cost(full, len(seen.distances), len(seen.wavelengths)),
        shares=shares,
        effects=effects_of(camera, scene, tolerance, over_field),
    )
