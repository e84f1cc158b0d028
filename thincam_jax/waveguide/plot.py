"""Figures of a see-through screen: its rays, and what its models reconstruct."""

from typing import TYPE_CHECKING

import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure

from thincam_jax.imaging.encoding import cie_1931, encode_srgb
from thincam_jax.plot.frame import drawing, line_style
from thincam_jax.plot.pictures import decibels, draw_beside, draw_columns, labels, show_panel
from thincam_jax.studies.pictures import diagonal_cells
from thincam_jax.units import nm
from thincam_jax.waveguide.studies.mask import MaskSystem

if TYPE_CHECKING:
    from thincam_jax.waveguide.rays import Rays
    from thincam_jax.waveguide.studies.calibration import CalibrationResult
    from thincam_jax.waveguide.studies.screen import ScreenResult, ScreenStudy

_RAYS = (
    "Side view: rays of three pixels through {}, plate (grey) and out to the object; thin lines "
    "go on to the object points of the image and its ghosts, further down with each bounce."
)
_FIELD = (
    "Each pixel is reached by one colour, and its ghosts have a shift of their own: no convolution "
    "describes this camera."
)
_SHADOWS = (
    "What the sensor sees of single cells (row, column): the mask's shadow, once for each order of "
    "the screen, at its own place."
)
COLUMNS_CAPTION = (
    "What the sensor sees of single cells (row, column): columns of the measured matrix, and of "
    "the exact one."
)

_TO_SRGB = ((3.2406, -1.5372, -0.4986), (-0.9689, 1.8758, 0.0415), (0.0557, -0.2040, 1.0570))


def srgb(wavelength: np.ndarray) -> np.ndarray:
    """Linear sRGB (…, 3) of spectral light, mm, within the gamut, its brightest part 1."""
    linear = np.clip(cie_1931(np.asarray(wavelength)) @ np.array(_TO_SRGB).T, 0, None)
    return linear / np.maximum(linear.max(axis=-1, keepdims=True), 1e-9)


def in_colour(capture: np.ndarray, wavelength: np.ndarray) -> np.ndarray:
    """A capture as an eye would see it on the sensor, turned upright: sRGB with its gamma.

    Of channels (channel, y, x), each in its own light, the sum.
    """
    level = np.clip(capture / np.percentile(capture, 99.8), 0, 1)[..., None]
    linear = level * srgb(wavelength)
    linear = np.clip(linear.sum(axis=0), 0, 1) if linear.ndim == 4 else linear
    return encode_srgb(linear)[::-1, ::-1]


def draw_result(result: "ScreenResult", rays: "Rays") -> dict[str, Figure]:
    """All figures of a study, by the name of their file."""
    study, system = result.study, result.study.systems[0]
    if isinstance(system, MaskSystem):
        cells, sensor = diagonal_cells(study.plane.shape), study.camera.sensor
        numbers = np.ravel_multi_index(tuple(np.transpose(cells)), study.plane.shape)
        shadows = np.asarray(system.matrix)[:, numbers].T.reshape(-1, *sensor.shape)
        field = draw_columns(float(sensor.pitch), cells, {"shadows": shadows}, "mm² of aperture")
    else:
        field = draw_field(study, rays)
    return {
        "rays": draw_rays(study),
        "field": field,
        "images": draw_images(result),
        "models": draw_models(result),
        "errors": draw_errors(result),
    }


def captions(study: "ScreenStudy") -> dict[str, str]:
    """Captions of the figures of a study, by their names."""
    lens = study.mask is None
    turned = "in the colours of its pixels, turned upright" if lens else "turned upright"
    return {
        "rays": _RAYS.format("lens" if lens else "the middle of the mask"),
        "field": _FIELD if lens else f"{_SHADOWS} {study.systems[0]}",
        "images": f"Targets, what the sensor captures ({turned}), and reconstructions with the "
        f"model “{study.models[0].name}”.",
    }


def draw_rays(study: "ScreenStudy") -> Figure:
    """Side view: rays of three pixels from the sensor through the plate to its front."""
    camera, screen = study.camera, study.camera.screen
    half = 0.43 * camera.sensor.shape[0] * float(camera.sensor.pitch)
    pixels = np.array([[-half, 0.0], [0.0, 0.0], [half, 0.0]])
    rays = study.rays(camera, jnp.asarray(pixels))
    d0, d1 = float(camera.focal_distance), float(camera.lens_distance)
    width, start = float(screen.glass_thickness), d0 + d1
    slopes = -pixels[:, 0] / d0
    sines = slopes / np.hypot(1, slopes)
    index = np.asarray(screen.glass_index(rays.wavelength))
    crossing = width * sines / np.sqrt(index**2 - sines**2)
    along = np.asarray(rays.guided)
    bounce = width * along[:, 1] / np.sqrt(index**2 - np.sum(along**2, axis=-1))
    figure, ax = drawing((9.5, 4.6))
    ahead = 5 * width
    for n, (pixel, light) in enumerate(zip(pixels[:, 0], rays.wavelength, strict=True)):
        style = line_style(n + 1)
        del style["marker"]
        top = d1 * slopes[n] + crossing[n]
        path = [(0, pixel), (d0, 0), (start, d1 * slopes[n]), (start + width, top)]
        count = 2 * study.orders - 1
        path += [(start + width * (m % 2), top + (m + 1) * bounce[n]) for m in range(count)]
        name = f"pixel at y = {pixel:.2g} mm: {float(light) / nm:.0f} nm"
        ax.plot(*zip(*path, strict=True), label=name, **style)
        for order in range(study.orders):
            bottom = top + (2 * order + 1) * bounce[n]
            out = bottom + crossing[n]
            line = [(start, bottom), (start + width, out)]
            line.append((start + width + ahead, out + ahead * slopes[n]))
            ax.plot(*zip(*line, strict=True), linewidth=0.8, **style)
    ax.axvspan(start, start + width, color="0.9")
    kind = "lens" if study.mask is None else "middle of the mask"
    ax.axvline(d0, color="0.6", linewidth=4, label=kind)
    ax.set(xlabel="z from the sensor (mm)", ylabel="y, down the screen (mm)")
    ax.set_xlim(0, start + width + ahead)
    ax.invert_yaxis()
    ax.legend(loc="lower left", fontsize=9)
    return figure


def draw_field(study: "ScreenStudy", rays: "Rays") -> Figure:
    """Colour and ghost shift of every pixel, in grey with contours, and the colours as seen."""
    rows, columns = study.camera.sensor.shape
    pitch = float(study.camera.sensor.pitch)
    x, y = columns * pitch / 2, rows * pitch / 2
    light = np.asarray(rays.wavelength)
    maps = [(light / nm, "Bragg wavelength (nm)")]
    if study.orders > 1:
        shift = np.asarray(rays.points[1] - rays.points[0])
        maps.append((shift[..., 1], "first ghost: seen further down (mm)"))
        maps.append((shift[..., 0], "first ghost: seen further right (mm)"))
    figure, axes = drawing((3.1 * (len(maps) + 1), 3.9), 1, len(maps) + 1)
    for ax, (values, label) in zip(axes, maps, strict=False):
        drawn = ax.imshow(values, cmap="gray", extent=(-x, x, y, -y))
        lines = ax.contour(values, levels=6, colors="#d08020", extent=(-x, x, -y, y))
        ax.clabel(lines, fontsize=8)
        figure.colorbar(drawn, ax=ax, label=label, location="bottom")
    encoded = in_colour(np.ones_like(light), light)[::-1, ::-1]
    axes[-1].imshow(encoded, extent=(-x, x, y, -y))
    axes[-1].set_title("a white object's colours", fontsize=10)
    for ax in axes:
        ax.set_xlabel("x on the sensor (mm)", fontsize=9)
    axes[0].set_ylabel("y on the sensor (mm)", fontsize=9)
    return figure


def draw_images(result: "ScreenResult", figure: Figure | None = None) -> Figure:
    """Targets, captures, and what the first model reconstructs by every solver."""
    study, (first, *_) = result.study, result.models.items()
    captures = np.asarray(study.captures.images)
    if study.mask is None:
        seen = [in_colour(capture, study.wavelengths) for capture in captures]
    else:  # light of all colours in every pixel
        seen = [one[::-1, ::-1] / np.percentile(one, 99.8) for one in captures]
    columns = [("capture, turned", seen, [""] * len(seen))]
    columns += [(name, list(one.images), labels(one)) for name, one in first[1].methods.items()]
    return draw_beside(study.targets, columns, figure)


def draw_models(result: "ScreenResult") -> Figure:
    """Targets, and what every model reconstructs by the last solver."""
    last = list(result.study.solvers)[-1]
    found = {name: model.methods[last] for name, model in result.models.items()}
    columns = [(name, list(one.images), labels(one)) for name, one in found.items()]
    return draw_beside(result.study.targets, columns)


def draw_errors(result: "ScreenResult") -> Figure:
    """PSNR of every target by the last solver with each model."""
    figure, ax = drawing((9, 3.8))
    last = list(result.study.solvers)[-1]
    for index, (name, model) in enumerate(result.models.items()):
        scores = model.methods[last].scores.targets
        levels = [score.psnr_db for score in scores.values()]
        ax.plot(list(scores), levels, label=name, **line_style(index))
    ax.set(ylabel="PSNR (dB)", xlabel="target")
    ax.grid(alpha=0.3)
    figure.legend(loc="outside right center", fontsize=9)
    return figure


def draw_calibration(result: "CalibrationResult") -> dict[str, Figure]:
    """Figures of a calibration, by the name of their file."""
    pitch = float(result.study.camera.sensor.pitch)
    figures = {"columns": draw_columns(pitch, result.cells, result.columns)}
    return figures | ({"distances": draw_distances(result)} if result.images else {})


def draw_distances(result: "CalibrationResult") -> Figure:
    """The first target in halftones at other distances, by each matrix, in grey with its PSNR."""
    targets, images = result.study.targets, result.images
    halftones = (n for n, truth in enumerate(targets.values()) if len(np.unique(truth)) > 2)
    number = next(halftones, 0)
    target = list(targets)[number]
    ways = list(next(iter(images.values())))
    rows, columns = len(images), len(ways) + 1
    figure, grid = drawing((2.1 * columns, 2.4 * rows), rows, columns, squeeze=False)
    for row, ((distance, found), line) in enumerate(zip(images.items(), grid, strict=True)):
        show_panel(line[0], targets[target], target, "" if row else "target")
        line[0].set_ylabel(f"object at {distance}")
        for name, ax in zip(ways, line[1:], strict=True):
            score = result.scores.distances[distance][name].targets[target]
            show_panel(ax, found[name][number], decibels(score), "" if row else name)
    return figure
