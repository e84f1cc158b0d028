"""From a refocus experiment's file to what is captured; distances found, and figures of merit."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from thincam_jax._core.grids import Grid
from thincam_jax.commands.config_file import ConfigError
from thincam_jax.commands.refocus.config import PlacedConfig, RefocusConfig
from thincam_jax.commands.study import build
from thincam_jax.commands.study.build import FileStudy
from thincam_jax.imaging.metrics import psnr
from thincam_jax.imaging.metrics.image import SSIM_WINDOW
from thincam_jax.imaging.scene import ImagePlane
from thincam_jax.imaging.targets import middle_square, resize
from thincam_jax.lensless.exposures import Exposure
from thincam_jax.reconstruction import Reconstruction
from thincam_jax.reconstruction.depth import find as finding
from thincam_jax.reconstruction.depth.refocus import (
    RefocusSweep,
    axial_resolution,
    refocus_distances,
)
from thincam_jax.studies import simulate
from thincam_jax.studies.evaluate import reconstructor, rounded, sample
from thincam_jax.studies.simulate import Capture
from thincam_jax.studies.study import Method, Study, Target

_MARGIN = 1.15  # the field over what the objects cover


@dataclass(frozen=True)
class PlacedTarget(Target):
    """An object whose middle is at (x, y), mm, on a dark plane of its own centred on the axis."""

    x: float
    y: float

    @property
    def height(self) -> float:
        """Of the object itself, mm: the plane reaches as far to the other side of the axis."""
        return float(self.plane.height) - 2 * abs(self.y)


def build_refocus(config: RefocusConfig) -> FileStudy:
    """Cameras and methods, and the objects as targets at their distances.

    **Errors**: ConfigError, one line for each fault, beginning with the field.
    """
    study, faults, objects = build.assemble(config, ()), [], []
    try:
        for exposure in study.exposures:
            study.camera(exposure)
    except (ValueError, TypeError) as error:
        faults.append(f"mask, sensor or model: {error}")
    for number, placed in enumerate(config.objects):
        try:
            objects.append(_place(study, number, placed))
        except (ValueError, FileNotFoundError) as error:
            faults.append(f"objects[{number}]: {error}")
            continue
        seen = min(round(placed.width * _pixels_per_mm(study, m, placed)) for m in study.methods)
        if seen < 2 * SSIM_WINDOW:
            faults.append(
                f"objects[{number}]: covers {seen} pixels of a reconstruction; give it a larger "
                f"width or the sensor a smaller pitch, for at least {2 * SSIM_WINDOW}"
            )
    if faults:
        raise ConfigError("\n".join(faults))
    return replace(study, targets=tuple(objects))


def _place(study: Study, number: int, placed: PlacedConfig) -> PlacedTarget:
    picture = np.atleast_3d(build.read_picture(placed)).astype(np.float32)
    picture = picture.astype(np.float64).mean(axis=-1)
    if placed.crop < 1:
        picture = middle_square(picture, round(placed.crop * min(picture.shape)))
    # Two pixels of the picture to one of the reconstruction.
    finest = max(_pixels_per_mm(study, method, placed) for method in study.methods)
    columns = max(8, round(2 * placed.width * finest))
    rows = max(8, round(columns * picture.shape[0] / picture.shape[1]))
    pitch = placed.width / columns
    picture = resize(picture, (rows, columns))
    right, down = round(placed.x / pitch), round(placed.y / pitch)
    canvas = np.zeros((rows + 2 * abs(down), columns + 2 * abs(right)), np.float32)
    top, left = down + abs(down), right + abs(right)
    canvas[top : top + rows, left : left + columns] = picture
    plane = ImagePlane(canvas, placed.distance, canvas.shape[1] * pitch)
    numbers = (placed.distance, placed.width, plane, placed.x, placed.y)
    return PlacedTarget(number, placed.name, placed.kind, *numbers)


def _pixels_per_mm(study: Study, method: Method, placed: PlacedConfig | Target) -> float:
    """Of a reconstruction, on an object."""
    return method.distance / placed.distance / study.pitch


def sweep_method(study: FileStudy) -> Method:
    """The method that the sweep reconstructs with."""
    return next(m for m in study.methods if m.name == study.config.sweep.method)


def sweep_distances(study: FileStudy) -> list[float]:
    """The distances of the sweep, mm, evenly spaced in 1/t."""
    sweep = study.config.sweep
    return np.asarray(refocus_distances(sweep.nearest, sweep.farthest, sweep.count)).tolist()


def take_scene(study: Study, exposure: Exposure) -> Capture:
    """One capture of all objects together, (y, x)."""
    planes = [target.plane for target in study.targets]
    return simulate.expose(study, exposure, simulate.noise_free(study, exposure, planes), 0)


def field_shape(study: Study, method: Method) -> tuple[int, int]:
    """Pixels of a reconstruction: the directions of all objects, about the axis, and a margin."""
    scale = _MARGIN * method.distance / study.pitch
    planes = [t.plane for t in study.targets]
    extents = [(float(p.height), float(p.width)) for p in planes]
    angles = np.asarray(extents) / np.asarray([[float(p.distance)] for p in planes])
    rows, columns = (math.ceil(scale * angle) for angle in angles.max(axis=0))
    # The same parity for all: rows are then rows of one grid of directions.
    return rows + rows % 2, columns + columns % 2


def focus_on(
    study: Study,
    method: Method,
    captures: Mapping[Exposure, Capture],
    distance: float,
) -> Reconstruction:
    """A method's reconstruction (y, x) focused on one distance."""
    images, variances = simulate.stacked([captures[exposure] for exposure in method.exposures])
    focused = reconstructor(study, method, field_shape(study, method), distance)
    result = focused(images[:, None], variances[:, None])
    return jax.tree.map(lambda leaf: leaf[0] if leaf.ndim == 3 else leaf, result)


def join_sweep(
    study: FileStudy, distances: list[float], focused: list[Reconstruction]
) -> RefocusSweep:
    """Reconstructions that are focused on each of the distances, as one sweep."""
    images = jnp.stack([result.image for result in focused])
    # p·t/d of any image over its t.
    slope = jnp.reshape(jnp.asarray(focused[-1].pitch, images.dtype), ()) / distances[-1]
    method = sweep_method(study).solver.name
    return RefocusSweep(images, jnp.asarray(distances, images.dtype), slope, method)


@dataclass(frozen=True, eq=False)
class FoundObjects:
    """Regions of a sweep, their focus curves, and which region each object is (None: none)."""

    regions: np.ndarray
    curves: finding.FocusCurves | None
    region_of: dict[str, int | None]

    def peak(self, name: str) -> finding.FocusPeak | None:
        """The focus of an object."""
        region = self.region_of[name]
        return None if region is None or self.curves is None else self.curves.distance_of(region)


def find_objects(study: FileStudy, sweep: RefocusSweep) -> FoundObjects:
    """Regions of the picture and their distances; objects are named by where they were placed."""
    regions, asked = finding.object_regions(sweep), study.config.sweep
    boxes = {t.name: object_box(study, sweep_method(study), t) for t in study.targets}
    if not regions.any():
        return FoundObjects(regions, None, dict.fromkeys(boxes))
    curves = finding.find_distances(
        sweep, measure=asked.measure, smoothing=asked.smoothing, regions=regions
    )
    return FoundObjects(
        regions, curves, {name: _covering(regions[box]) for name, box in boxes.items()}
    )


def _covering(part: np.ndarray) -> int | None:
    """The region that covers most of an object's box, if it covers a quarter of it."""
    counts = np.bincount(part.ravel())
    counts[0] = 0  # the ground
    most = int(np.argmax(counts))
    return most if counts[most] >= part.size / 4 else None


def object_box(study: Study, method: Method, placed: Target) -> tuple[slice, slice]:
    """Rows and columns of an object in a method's reconstructions, whatever their focus."""
    assert isinstance(placed, PlacedTarget)  # for the type checker
    shape, scale = field_shape(study, method), _pixels_per_mm(study, method, placed)
    places, sizes = (placed.y, placed.x), (placed.height, placed.width)
    sides = []
    for place, size, count in zip(places, sizes, shape, strict=True):
        centre = (count - 1) / 2 + place * scale
        first = max(0, round(centre - size * scale / 2 + 0.5))
        sides.append(slice(first, min(count, round(centre + size * scale / 2 + 0.5))))
    return sides[0], sides[1]


def psnr_of_objects(
    study: Study, method: Method, reconstruction: Reconstruction
) -> dict[str, float | None]:
    """PSNR of every object within its box, dB, after a gain and an offset of its own."""
    image = np.asarray(reconstruction.image, dtype=float)
    scores = {}
    for placed in study.targets:
        box = object_box(study, method, placed)
        grid = Grid(image.shape, 1 / _pixels_per_mm(study, method, placed))
        score = psnr(image[box], np.asarray(sample(placed.plane, grid), dtype=float)[box])
        scores[placed.name] = rounded(score)
    return scores


def object_metrics(study: FileStudy, found: FoundObjects) -> dict[str, Any]:
    """Distance of each object as placed and as found."""
    metrics: dict[str, Any] = {}
    cameras = [study.camera(exposure) for exposure in sweep_method(study).exposures]
    for placed in study.targets:
        peak = found.peak(placed.name)
        at = None if peak is None or peak.at_end else peak.distance
        finest = min(float(axial_resolution(c, placed.distance)) for c in cameras)
        metrics[placed.name] = {
            "distance_mm": round(placed.distance, 4),
            "found_mm": None if at is None else round(at, 2),
            "error_percent": None if at is None else round(100 * (at / placed.distance - 1), 2),
            "focus_contrast": round(peak.contrast, 4) if peak is not None else None,
            "axial_resolution_mm": round(finest, 2),
        }
    return metrics
