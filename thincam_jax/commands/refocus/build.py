"""From a refocus experiment's configuration to scene, captures, sweep and figures of merit."""

import functools
import math
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from thincam_jax._core.grids import Grid
from thincam_jax.commands.refocus.config import PlacedConfig, RefocusConfig
from thincam_jax.commands.study import build
from thincam_jax.commands.study.config import ConfigError, MethodConfig, VariationConfig
from thincam_jax.imaging.metrics import psnr
from thincam_jax.imaging.metrics.image import SSIM_WINDOW
from thincam_jax.imaging.scene import ImagePlane, Scene
from thincam_jax.imaging.sensor import Sensor, electrons_per_unit, read_out
from thincam_jax.imaging.targets import resize
from thincam_jax.lensless.camera import LenslessCamera
from thincam_jax.lensless.capture import capture
from thincam_jax.reconstruction import (
    AbstractSolver,
    AdmmTV,
    Cameras,
    FringeScanning,
    Reconstruction,
    Recording,
    TotalVariation,
    Wiener,
)
from thincam_jax.reconstruction.depth import (
    RefocusSweep,
    axial_resolution,
    refocus_distances,
    refocus_sweep,
)
from thincam_jax.reconstruction.depth.find import (
    FocusCurves,
    FocusPeak,
    find_distances,
    object_regions,
)

_MARGIN = 1.15  # the field over what the objects cover


class Captures(NamedTuple):
    """Images (exposure, y, x) and noise variances (exposure,) by setting."""

    images: dict[build.Setting, np.ndarray]
    variances: dict[build.Setting, float]

    def of(self, config: RefocusConfig, method: MethodConfig) -> tuple[Array, Array]:
        """Captures (capture, y, x) and variances (capture,) of a method."""
        used = method_settings(config, method)
        images = np.stack([self.images[s] for s in used])
        return jnp.asarray(images), jnp.asarray([self.variances[s] for s in used], images.dtype)


def method_settings(config: RefocusConfig, method: MethodConfig) -> list[build.Setting]:
    """The exposures of a method."""
    return build.settings(config.focused(config.objects[0].distance), method)


def all_settings(config: RefocusConfig) -> list[build.Setting]:
    """Every exposure once, in order of first use."""
    return list(dict.fromkeys(s for m in config.methods for s in method_settings(config, m)))


def build_planes(config: RefocusConfig) -> list[ImagePlane]:
    """Each object on a dark plane of its own that is centred on the axis."""
    return [_plane(config, placed) for placed in config.objects]


def _plane(config: RefocusConfig, placed: PlacedConfig) -> ImagePlane:
    picture = build.build_plane(config.focused(placed.distance), placed).image
    picture = _cropped(np.asarray(picture, dtype=np.float64).mean(axis=0), placed.crop)
    furthest = max(build.reference_distance(m) for m in config.methods)
    # Two pixels of the picture to one of the reconstruction.
    columns = max(8, round(2 * placed.width * furthest / placed.distance / config.sensor.pitch))
    rows = max(8, round(columns * picture.shape[0] / picture.shape[1]))
    pitch = placed.width / columns
    picture = resize(picture, (rows, columns))
    right, down = round(placed.x / pitch), round(placed.y / pitch)
    canvas = np.zeros((rows + 2 * abs(down), columns + 2 * abs(right)), np.float32)
    top, left = down + abs(down), right + abs(right)
    canvas[top : top + rows, left : left + columns] = picture
    return ImagePlane(canvas, placed.distance, canvas.shape[1] * pitch)


def _cropped(picture: np.ndarray, part: float) -> np.ndarray:
    """The middle square of a picture, `part` of its shorter side; the whole for 1."""
    if part == 1:
        return picture
    side = max(1, round(part * min(picture.shape)))
    top, left = ((n - side) // 2 for n in picture.shape)
    return picture[top : top + side, left : left + side]


def check_refocus(config: RefocusConfig) -> None:
    """Refuse cameras that cannot be built and images that cannot be read, before the first capture.

    **Errors**: ConfigError, one line for each fault, beginning with the field.
    """
    faults = []
    try:
        for setting in all_settings(config):
            build.build_camera(config.focused(config.objects[0].distance), setting)
    except (ValueError, TypeError) as error:
        faults.append(f"mask or sensor: {error}")
    for index, placed in enumerate(config.objects):
        try:
            _plane(config, placed)
        except (ValueError, FileNotFoundError) as error:
            faults.append(f"objects[{index}]: {error}")
            continue
        seen = min(_box_size(config, m, placed) for m in config.methods)
        if seen < 2 * SSIM_WINDOW:
            faults.append(
                f"objects[{index}]: covers {seen} pixels of a reconstruction; give it a larger "
                f"width or the sensor a smaller pitch, for at least {2 * SSIM_WINDOW}"
            )
    if faults:
        raise ConfigError("\n".join(faults))


def _box_size(config: RefocusConfig, method: MethodConfig, placed: PlacedConfig) -> int:
    scale = build.reference_distance(method) / placed.distance / config.sensor.pitch
    return round(placed.width * scale)


def take(config: RefocusConfig, planes: list[ImagePlane], number: int, setting: build.Setting):
    """One capture of the whole scene, and the variance of its noise."""
    study = config.focused(config.objects[0].distance)
    camera, noise = build.build_camera(study, setting), build.build_noise(study)
    ideal = LenslessCamera(
        camera.mask, Sensor(config.sensor.shape, config.sensor.pitch), camera.distance
    )
    clean = capture(
        ideal,
        Scene(planes, setting.wavelength),
        model=config.model,
        pixel_integration=config.pixel_integration,
    )
    variance = 0.0
    if noise is not None:
        variance = float(noise.variance(clean, electrons_per_unit(camera.sensor, clean)))
    key = build.capture_key(study, 0, number)
    return np.asarray(read_out(camera.sensor, clean, noise=noise, key=key)), variance


def field_shape(config: RefocusConfig, method: MethodConfig) -> tuple[int, int]:
    """Pixels of a reconstruction: the directions of all objects, about the axis, and a margin."""
    scale = _MARGIN * build.reference_distance(method) / config.sensor.pitch
    planes = [_extent(plane) for plane in build_planes(config)]
    rows, columns = (math.ceil(scale * max(extent)) for extent in zip(*planes, strict=True))
    # The same parity for all: rows are then rows of one grid of directions.
    return rows + rows % 2, columns + columns % 2


def _extent(plane: ImagePlane) -> tuple[float, float]:
    """Height and width over distance."""
    distance = float(plane.distance)
    return float(plane.height) / distance, float(plane.width) / distance


def sweep_distances(config: RefocusConfig) -> np.ndarray:
    """The distances of the sweep, mm, evenly spaced in 1/t."""
    sweep = config.sweep
    return np.asarray(refocus_distances(sweep.nearest, sweep.farthest, sweep.count))


def run_sweep(
    config: RefocusConfig, captures: Captures, progress: Callable[[int], object] | None = None
) -> RefocusSweep:
    """The sweep of the configured method."""
    method = config.sweep_method()
    study = config.focused(config.objects[0].distance)
    used = method_settings(config, method)
    images, variances = captures.of(config, method)
    cameras = Cameras(
        [build.build_camera(study, s) for s in used],
        wavelength=[s.wavelength for s in used],
        field_shape=field_shape(config, method),
        model=config.model,
        pixel_integration=config.pixel_integration,
    )
    recording = Recording(images, cameras, noise_variance=variances if config.noise else None)
    return refocus_sweep(
        recording, sweep_distances(config), _solver(config, method), callback=progress
    )


def _solver(config: RefocusConfig, method: MethodConfig) -> AbstractSolver:
    """What the sweep reconstructs by."""
    if method.kind == "fringe_scanning":
        return FringeScanning()
    synthesis = build.synthesis_matrix(method)
    if method.kind == "wiener":
        return Wiener(synthesis=synthesis, prior=config.prior)
    options = method.variation or VariationConfig()
    return AdmmTV(
        options.tau,
        variation=TotalVariation(options.kind),
        synthesis=synthesis,
        iterations=options.iterations,
    )


class Found(NamedTuple):
    """Regions of a sweep, their focus curves, and which region each object is (None: none)."""

    regions: np.ndarray
    curves: FocusCurves | None
    region_of: dict[str, int | None]

    def peak(self, name: str) -> FocusPeak | None:
        """The focus of an object."""
        region = self.region_of[name]
        return None if region is None or self.curves is None else self.curves.distance_of(region)


def find_objects(config: RefocusConfig, sweep: RefocusSweep) -> Found:
    """Regions of the picture and their distances; objects are named by where they were placed."""
    regions = object_regions(sweep)
    boxes = {
        placed.name: object_box(config, config.sweep_method(), placed) for placed in config.objects
    }
    if not regions.any():
        return Found(regions, None, dict.fromkeys(boxes))
    curves = find_distances(
        sweep, measure=config.sweep.measure, smoothing=config.sweep.smoothing, regions=regions
    )
    return Found(regions, curves, {name: _covering(regions[box]) for name, box in boxes.items()})


def _covering(part: np.ndarray) -> int | None:
    """The region that covers most of an object's box, if it covers a quarter of it."""
    counts = np.bincount(part.ravel())
    counts[0] = 0  # the ground
    most = int(np.argmax(counts))
    return most if counts[most] >= part.size / 4 else None


def object_box(
    config: RefocusConfig, method: MethodConfig, placed: PlacedConfig
) -> tuple[slice, slice]:
    """Rows and columns of an object in a method's reconstructions, whatever their focus."""
    rows, columns = field_shape(config, method)
    scale = build.reference_distance(method) / placed.distance / config.sensor.pitch
    plane = _plane(config, placed)
    # The canvas of an object beside the axis reaches as far to the other side.
    height = float(plane.height) - 2 * abs(placed.y)
    middle = (rows - 1) / 2 + placed.y * scale, (columns - 1) / 2 + placed.x * scale
    sides = []
    for centre, size, count in zip(middle, (height, placed.width), (rows, columns), strict=True):
        first = max(0, round(centre - size * scale / 2 + 0.5))
        sides.append(slice(first, min(count, round(centre + size * scale / 2 + 0.5))))
    return sides[0], sides[1]


def reconstruct_at(
    config: RefocusConfig, method: MethodConfig, captures: Captures, distance: float
) -> Reconstruction:
    """A method's reconstruction (y, x) focused on one distance."""
    images, variances = captures.of(config, method)
    reconstructor = build.build_reconstructor(
        config.focused(distance), method, field_shape(config, method)
    )
    result = reconstructor(images[:, None], variances[:, None])
    return jax.tree.map(lambda leaf: leaf[0] if leaf.ndim == 3 else leaf, result)


def evaluate(
    config: RefocusConfig,
    method: MethodConfig,
    planes: list[ImagePlane],
    reconstruction: Reconstruction,
) -> dict[str, float | None]:
    """PSNR of every object within its box, dB, after a gain and an offset of its own."""
    image = np.asarray(reconstruction.image, dtype=float)
    slope = config.sensor.pitch / build.reference_distance(method)
    scores = {}
    for placed, plane in zip(config.objects, planes, strict=True):
        box = object_box(config, method, placed)
        truth = _sampled(plane, Grid(image.shape, slope * placed.distance))
        score = psnr(image[box], np.asarray(truth, dtype=float)[box])
        scores[placed.name] = round(score, 3) if math.isfinite(score) else None
    return scores


@functools.partial(jax.jit)
def _sampled(plane: ImagePlane, grid: Grid) -> Array:
    return plane.sample(grid, magnification=1.0)


def object_metrics(config: RefocusConfig, found: Found) -> dict[str, Any]:
    """Distance of each object as placed and as found."""
    metrics: dict[str, Any] = {}
    study = config.focused(config.objects[0].distance)
    cameras = [build.build_camera(study, s) for s in method_settings(config, config.sweep_method())]
    for placed in config.objects:
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
