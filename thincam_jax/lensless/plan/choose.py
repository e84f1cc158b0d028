"""The decisions of a plan: which model, which wavelengths, which planes."""

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import scipy.linalg
from jaxtyping import Complex, Float

from thincam_jax._core.precision import Precision, allow, cast
from thincam_jax.lensless.accuracy.sampled import SAMPLED_ROUNDING, sampled_errors
from thincam_jax.lensless.accuracy.select import until_met
from thincam_jax.lensless.method import PIXEL_NODES, PsfMethod
from thincam_jax.lensless.plan.seen import FULL, SeenScene
from thincam_jax.lensless.plan.transfer import SampledProbe, TransferProbe, image_spectrum

# Nodes of the pixel average where PSFs are compared with each other, and how far the tolerance must
# be above the far edge's wave, √(λd)/(πw) of the light, whose fringes these nodes do not follow.
_FEW_NODES, _ABOVE_EDGES = 6, 2.5
# What float32's convolution leaves of a capture.
_CONVOLUTION_ROUNDING = 1.5e-6
# Below this tolerance nearly every PSF is needed, and finding which costs more than it saves.
_EVERYTHING = 3e-5


def choose_psf(seen: SeenScene, tolerance: float) -> tuple[PsfMethod, float]:
    """The cheapest model, precision and pixel average within the tolerance at the corners."""
    if isinstance(seen.probe, SampledProbe):
        return _choose_samples(seen, tolerance)
    # Double precision is for where single cannot serve: a cheaper model would not help there.
    methods = [
        PsfMethod(model, "float32", average)
        for model in seen.models
        for average in (False, True)
        if seen.held_in_single(model)
    ]
    methods += [PsfMethod("separable", "float64", average) for average in (False, True)]
    if _method_error(seen, PsfMethod("separable", "float32", False)) > max(tolerance, 1e-3):
        methods = [method for method in methods if method.pixel_integration]

    def work(method: PsfMethod) -> float:
        return seen.psf_cost(method).flops * (2.0 if method.precision == "float64" else 1.0)

    ordered = sorted(methods, key=work)
    method, error = until_met(((m, _method_error(seen, m)) for m in ordered), tolerance)[-1]
    return (method, error) if error <= tolerance else (FULL, 0.0)


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
        return 0.0
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
    own = replace(method, nodes=_FEW_NODES if few else PIXEL_NODES, field_tolerance=None)
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
