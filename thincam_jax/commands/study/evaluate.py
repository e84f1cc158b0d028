"""How good a reconstruction is: agreement with the scene, and what it resolves."""

import math
from typing import Any, NamedTuple

import equinox as eqx
import numpy as np

from thincam_jax._core.grids import Grid
from thincam_jax.commands.study.build import reference_distance
from thincam_jax.commands.study.config import MethodConfig, StudyConfig, TargetConfig
from thincam_jax.imaging.metrics import align, psnr, resolved_element, ssim, usaf_contrast
from thincam_jax.imaging.scene import ImagePlane
from thincam_jax.imaging.targets import line_pair, usaf1951_elements
from thincam_jax.reconstruction import Reconstruction


class Evaluation(NamedTuple):
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


def evaluate(
    config: StudyConfig,
    method: MethodConfig,
    target: TargetConfig,
    plane: ImagePlane,
    reconstruction: Reconstruction,
) -> Evaluation:
    """PSNR and SSIM after alignment, over the target's area; the resolved element of a chart."""
    image = np.asarray(reconstruction.image, dtype=float)
    rows, columns = image.shape[-2:]
    grid = Grid((rows, columns), _known_pitch(reconstruction))
    truth = np.asarray(_sample(plane, grid), dtype=float)
    image, truth = (_as_picture(i) for i in (image, truth))
    metrics: dict[str, Any] = {
        "psnr_db": _finite(round(psnr(image, truth), 4)),
        "ssim": round(ssim(image, truth), 5),
        "object_pixel_mm": round(float(grid.pitch), 6),
        "resolved": None,
    }
    contrast = None
    if target.kind == "usaf1951":
        metrics["resolved"], contrast = _resolution(config, method, image, float(grid.pitch))
    return Evaluation(align(image, truth)[0], truth, metrics, contrast)


def _known_pitch(reconstruction: Reconstruction):
    if reconstruction.pitch is None:
        raise ValueError("a reconstruction from PSFs alone has no pitch on the object")
    return reconstruction.pitch


def _finite(value: float) -> float | None:
    """JSON has no infinity: an exact reconstruction has no PSNR."""
    return value if math.isfinite(value) else None


@eqx.filter_jit
def _sample(plane: ImagePlane, grid: Grid):
    return plane.sample(grid, magnification=1.0)


def _as_picture(image: np.ndarray) -> np.ndarray:
    picture = np.moveaxis(image, 0, -1)
    return picture[..., 0] if picture.shape[-1] == 1 else picture


def _resolution(config: StudyConfig, method: MethodConfig, image: np.ndarray, pitch: float):
    """The finest element resolved in both directions, and the contrast of all."""
    records = usaf_contrast(image, usaf1951_elements(), config.object.width / pitch)
    contrast = [
        (line_pair(r.element, config.object.width), r.element.orientation, float(r.contrast))
        for r in records
    ]
    element = resolved_element(records)
    if element is None:
        return None, contrast
    period = line_pair(element, config.object.width)
    magnification = config.object.distance / reference_distance(method)
    resolved = {
        "group": element.group,
        "element": element.element,
        "object_mm": round(period, 4),
        "sensor_cycles_per_mm": round(magnification / period, 3),
    }
    return resolved, contrast
