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
from collections.abc import Callable
from dataclasses import dataclass, replace

import jax
import numpy as np
import scipy.linalg
from jaxtyping import Complex, Float

from thincam_jax._core import checks
from thincam_jax._core.arguments import checked
from thincam_jax._core.grids import fast_shape
from thincam_jax._core.precision import RESULT_ROUNDING, Precision, allow, cast, precision_of
from thincam_jax._core.progress import watched
from thincam_jax.imaging.operators.crop_convolution import kernel_shape
from thincam_jax.imaging.scene import Scene
from thincam_jax.lensless.accuracy.sampled import SAMPLED_ROUNDING, sampled_errors
from thincam_jax.lensless.accuracy.select import until_met
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
from thincam_jax.lensless.plan.run import CapturePlan, effects_of
from thincam_jax.lensless.plan.seen import (
    FULL,
    SampledProbe,
    SeenScene,
    TransferProbe,
    image_spectrum,
)

# Nodes of the pixel average where PSFs are compared with each other, and how far the tolerance must
# be above the far edge's wave, √(λd)/(πw) of the light, whose fringes these nodes do not follow.
_FEW_NODES, _ABOVE_EDGES = 6, 2.5
# What float32's convolution leaves of a capture.
_CONVOLUTION_ROUNDING = 1.5e-6
# What double precision leaves of it, also where no light but what is diffracted meets the sensor.
_DOUBLE_ROUNDING = 1e-11
# Below this tolerance nearly every PSF is needed, and finding which costs more than it saves.
_EVERYTHING = 3e-5


def choose_psf(seen: SeenScene, tolerance: float) -> tuple[PsfMethod, float]:
    """The cheapest model, precision and pixel average within the tolerance at the corners."""
    if isinstance(seen.probe, SampledProbe):
        return _choose_samples(seen, tolerance)
    # Double precision is for where single cannot serve: a cheaper model would not help there.
    both = (False, True)
    methods = [PsfMethod(m, "float32", average) for m in seen.models for average in both]
    methods += [PsfMethod("separable", "float64", average) for average in both]
    if _method_error(seen, PsfMethod("separable", "float32", False)) > max(tolerance, 1e-3):
        methods = [method for method in methods if method.pixel_integration]

    def work(method: PsfMethod) -> float:
        return seen.psf_cost(method).flops * (2.0 if method.precision == "float64" else 1.0)

    ordered = sorted(methods, key=work)
    method, error = until_met(((m, _method_error(seen, m)) for m in ordered), tolerance)[-1]
    return (method, error) if error <= tolerance else (FULL, _DOUBLE_ROUNDING)


def _choose_samples(seen: SeenScene, tolerance: float) -> tuple[PsfMethod, float]:
    """The fewest samples of a mask of many or no terms, in the precision that rounding allows."""
    single = 2 * seen.crop * SAMPLED_ROUNDING["float32"] <= tolerance
    precision: Precision = "float32" if single else "float64"
    tried = [_samples_at(seen, corner, precision, tolerance) for corner in seen.corners]
    method = max((method for method, _ in tried), key=lambda m: (m.nodes or 0, m.samples))
    if method.oversampling:
        most = max(method.samples for method, _ in tried)
        sampled = method.model == "angular_spectrum"
        method = seen.sampled(most) if sampled else replace(method, oversampling=most)
    return replace(method, precision=precision), max(error for _, error in tried)


def _samples_at(
    seen: SeenScene, corner: tuple[float, float], precision: Precision, tolerance: float
) -> tuple[PsfMethod, float]:
    """The fewest samples that serve one wavelength and distance, or the most, and their error.

    Errors are those of this scene's capture, weighted with its spectrum.
    """

    def norm(psf) -> float:
        spectrum = image_spectrum(np.asarray(psf, float)[None], seen.frequencies)[0]
        return math.sqrt(float(np.sum(seen.power * np.abs(spectrum) ** 2)))

    mask, grid, path = seen.camera.mask, seen.kernel_grid, seen.camera.path(*corner)
    with allow(precision, mask, grid, path):
        mask, grid, path = cast((mask, grid, path), precision)
        found = sampled_errors(mask, grid, path, True, norm)
        return until_met(((method, seen.crop * error) for method, error in found), tolerance)[-1]


def _method_error(seen: SeenScene, method: PsfMethod) -> float:
    if method == FULL:
        return _DOUBLE_ROUNDING
    worst = 0.0
    for (wavelength, distance), exact in zip(seen.corners, seen.references, strict=True):
        assert isinstance(seen.probe, TransferProbe)
        found = seen.probe.exact(wavelength, distance, method)
        error = seen.relative_of_all((found - exact) * seen.weights.sum())
        worst = max(worst, error if math.isfinite(error) else math.inf)
    rounding = _CONVOLUTION_ROUNDING * seen.crop if method.precision == "float32" else 0.0
    return worst + rounding


def choose_wavelengths(
    seen: SeenScene, method: PsfMethod, tolerance: float
) -> tuple[list[int], Float[np.ndarray, " colour"], float]:
    """Some wavelengths and their weights, that reproduce the sum over all for three planes."""
    count = len(seen.wavelengths)
    if count == 1 or seen.tolerance < _EVERYTHING:
        return list(range(count)), seen.weights, 0.0
    some = sorted(set(np.quantile(seen.distances, [0, 0.5, 1], method="nearest").tolist()))
    columns = np.concatenate(
        [np.stack([_quick(seen, method, w, t) for w in seen.wavelengths], axis=-1) for t in some]
    )
    target, light = (columns @ seen.weights)[:, None], np.sqrt(seen.power)[:, None]
    found = _fewest(columns, target, light, lambda e: seen.relative_of_all(e[:, 0]), tolerance)
    if found is None:
        return list(range(count)), seen.weights, 0.0
    picked, mixing, size = found
    return picked, mixing[:, 0], size


def _fewest(
    columns: Complex[np.ndarray, "k n"],
    targets: Complex[np.ndarray, "k target"],
    light: Float[np.ndarray, "part target"],
    size_of: Callable[[Complex[np.ndarray, "part target"]], float],
    tolerance: float,
) -> tuple[list[int], Float[np.ndarray, "few target"], float] | None:
    """The fewest columns, mixed to the targets so that each part's error is within the tolerance.

    None where it takes all. `light` weights the frequencies of each part of the columns.
    """
    parts = len(columns) // len(light)
    light = np.tile(light, (parts, 1))
    order = order_of_columns((columns * light)[::2])
    for few in range(1, len(order)):
        picked = sorted(order[:few])
        chosen = columns[:, picked]
        weighted = zip(targets.T, light.T, strict=True)
        mixing = [fit((chosen * w[:, None])[::2], (target * w)[::2]) for target, w in weighted]
        errors = np.split(chosen @ np.stack(mixing, axis=-1) - targets, parts)
        if (size := max(map(size_of, errors))) <= tolerance:
            return picked, np.stack(mixing, axis=-1), size
    return None


def _quick(seen: SeenScene, method: PsfMethod, wavelength: float, distance: float):
    """H; and, where every point has its own PSF, those of the field's edges after it."""
    few = seen.tolerance > _ABOVE_EDGES * seen.edge_wave
    own = replace(method, nodes=_FEW_NODES if few else None, field_tolerance=None)
    probe = seen.probe
    found = [probe.quick(wavelength, distance, own)]
    if method.field_tolerance is not None:
        edges = (seen.point(distance, axis) for axis in (0, 1))
        found += [probe.quick(wavelength, distance, own, at) for at in edges]
    return np.concatenate(found)


def choose_planes(
    seen: SeenScene,
    method: PsfMethod,
    colours: list[int],
    weights: Float[np.ndarray, " colour"],
    tolerance: float,
) -> tuple[list[int], Float[np.ndarray, "distance plane"], float]:
    """Some planes whose PSFs stand for all, and the weights with which they do."""
    count = len(seen.distances)
    if count == 1 or seen.tolerance < _EVERYTHING:
        return list(range(count)), np.eye(count), 0.0
    columns = np.stack(
        [
            sum(
                w * _quick(seen, method, seen.wavelengths[c], t)
                for c, w in zip(colours, weights, strict=True)
            )
            for t in seen.distances
        ],
        axis=-1,
    )
    area = np.sqrt(seen.frequencies.weights)
    light = np.sqrt(np.sum(np.abs(seen.spectra) ** 2, axis=1)).T * area[:, None]

    def size(error: Complex[np.ndarray, "k plane"]) -> float:
        return seen.relative(np.einsum("kp,pbk->bk", error, seen.spectra))

    every = list(range(count)), np.eye(count), 0.0
    return _fewest(columns, columns, light, size, tolerance) or every


def order_of_columns(columns: Complex[np.ndarray, "k n"]) -> list[int]:
    """Columns in the order in which they add most to those before (QR with pivoting)."""
    stacked = np.concatenate([np.real(columns), np.imag(columns)])
    decomposition = scipy.linalg.qr(stacked, mode="r", pivoting=True)
    return [int(p) for p in decomposition[-1]]


def fit(
    columns: Complex[np.ndarray, "k few"], target: Complex[np.ndarray, " k"]
) -> Float[np.ndarray, " few"]:
    """Real weights of the columns that come closest to the target."""
    stacked = np.concatenate([np.real(columns), np.imag(columns)])
    aim = np.concatenate([np.real(target), np.imag(target)])
    return np.linalg.lstsq(stacked, aim, rcond=1e-12)[0]


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
    tolerance = checks.relative_tolerance(tolerance)
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
