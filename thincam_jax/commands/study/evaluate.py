"""How good a reconstruction is: agreement with the scene, and what it resolves."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import equinox as eqx
import numpy as np
from jaxtyping import Array

from thincam_jax._core.grids import Grid
from thincam_jax.commands.study import build
from thincam_jax.commands.study.study import Capture, Exposure, Method, Study, Target
from thincam_jax.imaging.metrics import align, psnr, resolved_element, ssim, usaf_contrast
from thincam_jax.imaging.scene import ImagePlane
from thincam_jax.imaging.targets import line_pair, usaf1951_elements
from thincam_jax.reconstruction import Reconstruction


@dataclass(frozen=True, eq=False)
class Evaluation:
    """A reconstruction beside its scene, both (y, x) or (y, x, channel) on one grid.

    - `image`: the reconstruction after the least-squares gain and offset.
    - `truth`: the scene averaged over the same pixels.
    - `metrics`: what goes into metrics.json.
    - `contrast`: (period in mm, direction, contrast) of every chart element; None without a chart.
    """

    image: np.ndarray
    truth: np.ndarray
    metrics: dict[str, Any]
    contrast: list[tuple[float, str, float]] | None


def evaluate_targets(study: Study) -> dict[str, dict[str, dict[str, Any]]]:
    """The metrics of every method by method's and target's name, without a folder or figures."""
    found: dict[str, dict[str, dict[str, Any]]] = {m.name: {} for m in study.methods}
    for target in study.targets:
        captures = {exposure: build.take(study, exposure, target) for exposure in study.exposures}
        for method in study.methods:
            metrics = evaluate_method(study, method, target, captures).metrics
            found[method.name][target.name] = metrics
    return found


def evaluate_method(
    study: Study,
    method: Method,
    target: Target,
    captures: Mapping[Exposure, Capture],
) -> Evaluation:
    """Reconstruct a target from the method's captures, and judge what comes out."""
    shape = build.field_shape(study, method, target)
    key = (method.name, shape)
    if key not in study.reconstructors:
        study.reconstructors[key] = build.build_reconstructor(study, method, shape, target.distance)
    used = build.stacked([captures[exposure] for exposure in method.exposures])
    return evaluate(method, target, study.reconstructors[key](*used))


def mean_psnr_of_pictures(study: Study, metrics: dict[str, dict[str, Any]]) -> float | None:
    """The mean over photographs and files, dB, from metrics by target; None without any.

    Drawn targets are left out, and exact reconstructions, which have no PSNR.
    """
    pictures = [metrics[t.name]["psnr_db"] for t in study.targets if t.is_picture]
    known = [value for value in pictures if value is not None]
    return round(float(np.mean(known)), 4) if known else None


def evaluate(method: Method, target: Target, reconstruction: Reconstruction) -> Evaluation:
    """PSNR and SSIM after alignment, over the target's area; the resolved element of a chart."""
    image = np.asarray(reconstruction.image, dtype=float)
    rows, columns = image.shape[-2:]
    assert reconstruction.pitch is not None  # those of a study's cameras have one
    grid = Grid((rows, columns), reconstruction.pitch)
    truth = np.asarray(sample(target.plane, grid), dtype=float)
    image, truth = (as_picture(i) for i in (image, truth))
    metrics: dict[str, Any] = {
        "psnr_db": rounded(psnr(image, truth), 4),
        "ssim": round(ssim(image, truth), 5),
        "object_pixel_mm": round(float(grid.pitch), 6),
        "resolved": None,
    }
    contrast = None
    if target.kind == "usaf1951":
        metrics["resolved"], contrast = _resolution(method, target, image, float(grid.pitch))
    return Evaluation(align(image, truth)[0], truth, metrics, contrast)


def rounded(score: float, digits: int = 3) -> float | None:
    """A PSNR, dB, for metrics; None where nothing differs, which JSON has no number for."""
    return round(score, digits) if math.isfinite(score) else None


@eqx.filter_jit
def sample(plane: ImagePlane, grid: Grid) -> Array:
    """The scene averaged over the pixels of an upright reconstruction."""
    return plane.sample(grid, magnification=1.0)


def as_picture(image: np.ndarray) -> np.ndarray:
    """From (channel, y, x) to (y, x) or (y, x, channel)."""
    picture = np.moveaxis(image, 0, -1)
    return picture[..., 0] if picture.shape[-1] == 1 else picture


def _resolution(method: Method, target: Target, image: np.ndarray, pitch: float):
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
    resolved = {
        "group": element.group,
        "element": element.element,
        "object_mm": round(period, 4),
        "sensor_cycles_per_mm": round(magnification / period, 3),
    }
    return resolved, contrast
