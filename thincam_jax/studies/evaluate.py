"""Captures of a study and their reconstructions: agreement with the scene, and resolution."""

import functools
import math
import operator
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, PRNGKeyArray

from thincam_jax._core import checks
from thincam_jax._core.grids import Grid
from thincam_jax._core.quantity import FieldError
from thincam_jax.imaging.encoding import as_picture
from thincam_jax.imaging.metrics import align, psnr, ssim
from thincam_jax.imaging.metrics.image import SSIM_WINDOW
from thincam_jax.imaging.metrics.mtf import MINIMUM_COLUMNS
from thincam_jax.imaging.metrics.usaf import resolved_element, usaf_contrast
from thincam_jax.imaging.scene import ImagePlane
from thincam_jax.imaging.sensor import electrons_per_unit, read_out
from thincam_jax.imaging.targets.usaf import line_pair, usaf1951_elements
from thincam_jax.lensless import forward
from thincam_jax.lensless.exposures import Exposure
from thincam_jax.lensless.field import light_over_field, tangents_of
from thincam_jax.lensless.method import PsfMethod
from thincam_jax.reconstruction.fringe_filter import FringeScanning
from thincam_jax.reconstruction.imaging_model import Cameras
from thincam_jax.reconstruction.methods import reconstruct
from thincam_jax.reconstruction.noise import estimate_variance
from thincam_jax.reconstruction.recording import Recording
from thincam_jax.reconstruction.regularised import AdmmTV
from thincam_jax.reconstruction.result import Reconstruction
from thincam_jax.reconstruction.solver import AbstractSolver
from thincam_jax.reconstruction.wiener import Wiener
from thincam_jax.studies.study import Method, Study, Target


@dataclass(frozen=True, eq=False)
class Capture:
    """Image read out (*channel, y, x), and the variance of its noise (*channel,)."""

    image: np.ndarray
    variance: np.ndarray


def noise_free(study: Study, exposure: Exposure, *planes: ImagePlane) -> Array:
    """Light of the planes on the sensor, (*channel, y, x), without saturation."""
    light, pixels = ((exposure.wavelength, 1.0),), study.pixel_integration
    method = PsfMethod(study.model, None, pixels, field_tolerance=study.field_tolerance)
    camera = study.camera(exposure)
    images = (forward.expose(camera, plane, light, method) for plane in planes)
    return functools.reduce(operator.add, images)


def expose(study: Study, exposure: Exposure, clean: Array, number: int, trial: int = 0) -> Capture:
    """Capture from a noise-free image of the target of a number.

    The noise is that of the image; its random key is the same however a study is interrupted, and
    another one for each further trial.
    """
    place = study.exposures.index(exposure)
    key = _noise_key(np.uint32((study.seed + trial) % 2**32), number, place)
    sensor, noise = study.camera(exposure).sensor, study.noise
    if noise is None:
        variance = np.zeros(clean.shape[:-2], clean.dtype)
    else:
        variance = np.asarray(noise.variance(clean, electrons_per_unit(sensor, clean)))
    return Capture(np.asarray(read_out(sensor, clean, noise=noise, key=key)), variance)


@jax.jit
def _noise_key(seed, number, place) -> PRNGKeyArray:
    return jax.random.fold_in(jax.random.fold_in(jax.random.key(seed), number), place)


def take(study: Study, exposure: Exposure, target: Target) -> Capture:
    """One capture of a target, which may move meanwhile."""
    plane = ImagePlane(target.plane.image, target.distance, target.width, exposure.moves)
    return expose(study, exposure, noise_free(study, exposure, plane), target.number)


def stacked(captures: Sequence[Capture]) -> tuple[np.ndarray, np.ndarray]:
    """Images (capture, *channel, y, x) and variances (capture, *channel)."""
    return np.stack([c.image for c in captures]), np.stack([c.variance for c in captures])


# The scene's power is read off frequencies above three cycles a sensor (`spectra.inner_band`).
_MINIMUM_ROWS = 7

Reconstructor = Callable[[np.ndarray, np.ndarray], Reconstruction]
Contrasts = list[tuple[float, str, float]]


@dataclass(frozen=True)
class Resolved:
    """The finest chart element that is resolved in both directions."""

    group: int
    element: int
    object_mm: float
    sensor_cycles_per_mm: float


@dataclass(frozen=True)
class Scores:
    """Figures of merit of a reconstruction; None for the PSNR of an exact one.

    - `object_pixel_mm`: its pixels on the object. `resolved`: finest element resolved of a chart.
    """

    psnr_db: float | None
    ssim: float
    object_pixel_mm: float
    resolved: Resolved | None = None

    @property
    def words(self) -> str:
        """PSNR, SSIM and line pair in a few words."""
        exact = self.psnr_db is None
        text = "exact" if exact else f"{self.psnr_db:.1f} dB, SSIM {self.ssim:.2f}"
        resolved = "" if self.resolved is None else f"; resolves {self.resolved.object_mm:.2f} mm"
        return text + resolved


@dataclass(frozen=True, eq=False)
class Evaluation:
    """A reconstruction beside its scene, both (y, x) or (y, x, channel) on one grid.

    - `image`: the reconstruction after the least-squares gain and offset.
    - `truth`: the scene averaged over the same pixels.
    - `contrast`: (period in mm, direction, contrast) of every chart element; None without a chart.
    """

    image: np.ndarray
    truth: np.ndarray
    scores: Scores
    contrast: Contrasts | None


def field_shape(study: Study, method: Method, target: Target) -> tuple[int, int]:
    """Pixels of the reconstruction: what covers the target at the object pitch."""
    scale = method.distance / target.distance / study.pitch
    rows, columns = (
        max(1, math.ceil(float(size) * scale - 1e-3))
        for size in (target.plane.height, target.plane.width)
    )
    return rows, columns


def check_cameras(study: Study) -> None:
    """Build every camera of a study, and try whether its model takes the mask.

    **Errors**: FieldError of "sensor.shape" for too few pixels to be scored; MemoryError for too
    many; ValueError, TypeError and FileNotFoundError of the mask, the sensor and the model.
    """
    rows, columns = study.sensor.shape
    if rows < _MINIMUM_ROWS or columns < MINIMUM_COLUMNS:
        raise FieldError(
            f"{rows}×{columns} pixels are too few for a study; "
            f"give at least {_MINIMUM_ROWS}×{MINIMUM_COLUMNS}",
            "sensor.shape",
        )
    for exposure in study.exposures:
        study.camera(exposure)
    jax.eval_shape(lambda: study.psf(study.exposures[0]))  # traced only


def check_target(study: Study, target: Target) -> None:
    """Refuse a target that no method can be scored on.

    **Errors**: ValueError for a uniform image, or one that covers too few pixels.
    """
    if np.ptp(np.asarray(target.plane.image)) == 0:
        raise ValueError("the image is uniform: there is nothing to reconstruct; give another one")
    for method in study.methods:
        shape = field_shape(study, method, target)
        if min(shape) < SSIM_WINDOW:
            raise ValueError(
                f"{method.name!r} reconstructs it on {shape[0]}×{shape[1]} pixels, at least "
                f"{SSIM_WINDOW}×{SSIM_WINDOW} are needed; give a larger object.width or a "
                "smaller sensor.pitch"
            )


def reconstructor(
    study: Study, method: Method, shape: tuple[int, int], object_distance: float
) -> Reconstructor:
    """A function of the captures (capture, channel, y, x) and variances (capture, channel)."""
    solve = _solver(study, method, shape, object_distance)
    if study.field_tolerance is None:
        return solve
    camera = study.camera(max(method.exposures, key=lambda exposure: float(exposure.distance)))

    def even(captures: np.ndarray, variances: np.ndarray) -> Reconstruction:
        found = solve(captures, variances)
        rows, columns = found.image.shape[-2:]
        fall = light_over_field(study.sensor, *tangents_of(camera, (rows, columns)))
        return replace(found, image=found.image / fall.astype(found.image.dtype))

    return even


def cameras_of(
    study: Study, method: Method, shape: tuple[int, int], object_distance: float
) -> Cameras:
    """Cameras of a method's exposures."""
    return Cameras(
        [study.camera(exposure) for exposure in method.exposures],
        wavelength=[exposure.wavelength for exposure in method.exposures],
        object_distance=object_distance,
        field_shape=shape,
        model=study.model,
        pixel_integration=study.pixel_integration,
    )


def _solver(
    study: Study, method: Method, shape: tuple[int, int], object_distance: float
) -> Reconstructor:
    """Reconstruction of captures, with the PSF of the axis everywhere."""
    cameras = cameras_of(study, method, shape, object_distance)
    if isinstance(method.solver, FringeScanning):
        scanning = method.solver.prepare(cameras)
        return lambda captures, variances: scanning(captures)
    solver: Any = method.solver
    if hasattr(solver, "synthesis"):
        solver = replace(solver, synthesis=method.synthesis_matrix)
    if isinstance(solver, Wiener):
        wiener = solver.prepare(cameras)
        if study.noise is None:
            return lambda seen, _: wiener(seen, estimate_variance(checks.as_array(seen)))
        return wiener

    def solved(captures: np.ndarray, variances: np.ndarray) -> Reconstruction:
        """Reconstruction on the crop model; without noise in the study it is estimated."""
        noise_variance = None if study.noise is None else variances
        recording = Recording(captures, cameras, noise_variance=noise_variance, background=0.0)
        return reconstruct(recording, coupled(solver, captures.shape[1]))

    return solved


def coupled(solver: AbstractSolver, channels: int) -> AbstractSolver:
    """The solver with its total variation coupled as suits so many colour channels."""
    if not isinstance(solver, AdmmTV):
        return solver
    coupling = solver.variation.coupling
    if channels == 1:
        coupling = "none"
    elif coupling == "opponent" and channels != 3:
        coupling = "joint"
    return replace(solver, variation=replace(solver.variation, coupling=coupling))


def evaluate_method(
    study: Study, method: Method, target: Target, captures: Mapping[Exposure, Capture]
) -> Evaluation:
    """Reconstruct a target from the method's captures, and judge what comes out."""
    shape, prepared = field_shape(study, method, target), study._reconstructors
    key = (method.name, shape, target.distance)
    if key not in prepared:
        prepared[key] = reconstructor(study, method, shape, target.distance)
    used = stacked([captures[exposure] for exposure in method.exposures])
    return evaluate(method, target, prepared[key](*used))


def evaluate(method: Method, target: Target, reconstruction: Reconstruction) -> Evaluation:
    """PSNR and SSIM after alignment, over the target's area; the resolved element of a chart."""
    image = np.asarray(reconstruction.image, dtype=float)
    rows, columns = image.shape[-2:]
    assert reconstruction.pitch is not None  # those of a study's cameras have one
    grid = Grid((rows, columns), reconstruction.pitch)
    truth = np.asarray(sample(target.plane, grid), dtype=float)
    image, truth = (as_picture(i) for i in (image, truth))
    resolved, contrast = None, None
    if target.kind == "usaf1951":
        resolved, contrast = _resolution(method, target, image, float(grid.pitch))
    aligned = align(image, truth)
    scores = Scores(
        rounded(psnr(aligned, truth, aligned=False), 4),
        round(ssim(aligned, truth, aligned=False), 5),
        round(float(grid.pitch), 6),
        resolved,
    )
    return Evaluation(aligned, truth, scores, contrast)


def rounded(score: float, digits: int = 3) -> float | None:
    """A PSNR, dB, for metrics; None where nothing differs, which JSON has no number for."""
    return round(score, digits) if math.isfinite(score) else None


@eqx.filter_jit
def sample(plane: ImagePlane, grid: Grid) -> Array:
    """The scene averaged over the pixels of an upright reconstruction."""
    return plane.sample(grid, magnification=1.0)


def _resolution(
    method: Method, target: Target, image: np.ndarray, pitch: float
) -> tuple[Resolved | None, Contrasts]:
    """The finest element resolved in both directions, and the contrast of all."""
    records = usaf_contrast(image, usaf1951_elements(), target.width / pitch)
    contrast = [
        (line_pair(r.element, target.width), r.element.orientation, float(r.contrast))
        for r in records
    ]
    element = resolved_element(records)
    if element is None:
        return None, contrast
    period = line_pair(element, target.width)
    magnification = target.distance / method.distance
    on_the_sensor = round(magnification / period, 3)
    return Resolved(element.group, element.element, round(period, 4), on_the_sensor), contrast
