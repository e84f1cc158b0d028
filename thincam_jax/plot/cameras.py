"""Figures of a camera, of a solver's history, and of designs: objectives, fronts, tolerances."""

import math
import textwrap
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import matplotlib.figure
import numpy as np
import wadler_lindig as wl

from thincam_jax._core.arguments import checked
from thincam_jax._core.checks import Number, numbers, whole
from thincam_jax._core.grids import Grid
from thincam_jax.lensless import psf as psfs
from thincam_jax.lensless.camera import LenslessCamera
from thincam_jax.lensless.masks.base import AbstractMask
from thincam_jax.lensless.method import Model, PsfMethod
from thincam_jax.plot.frame import Figure, new_figure, show_image
from thincam_jax.reconstruction.result import Reconstruction

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from thincam_jax.design.design import Design
    from thincam_jax.design.fronts import FrontPoint
    from thincam_jax.design.landscape import Landscape
    from thincam_jax.design.sensitivity import Sensitivity


def psf(
    camera: LenslessCamera,
    *,
    wavelength: Number,
    object_distance: Number = math.inf,
    model: Model | PsfMethod = "separable",
    pixel_integration: bool = True,
) -> Figure:
    """A camera's PSF, as an image and along a line through its middle; arguments as of `tc.psf`.

    ```python
    import thincam_jax as tc
    from thincam_jax.units import nm, um

    mask = tc.FresnelZoneAperture(beta=25.0, width=1.6)
    camera = tc.LenslessCamera(mask, tc.Sensor((96, 128), 15 * um), distance=3.0)
    figure = tc.plot.psf(camera, wavelength=500 * nm)
    ```
    """
    light = {"wavelength": wavelength, "object_distance": object_distance, "model": model}
    image = psfs.psf(camera, **light, pixel_integration=pixel_integration)
    figure = new_figure(8.5, 3.4)
    draw_psf(figure, np.asarray(image), camera.sensor.grid, _title(camera.mask))
    return figure


def draw_psf(figure: matplotlib.figure.Figure, image: np.ndarray, grid: Grid, title: str) -> None:
    """Draw a PSF (y, x) on a grid, and its values along a line through its middle."""
    whole, line = figure.subplots(1, 2, gridspec_kw={"width_ratios": (1, 1.6)})
    shown = show_image(whole, image, float(grid.pitch))
    figure.colorbar(shown, ax=whole, label="irradiance / open aperture")
    rows, columns = image.shape
    x = float(grid.pitch) * (np.arange(columns) - (columns - 1) / 2)
    line.plot(x, image[rows // 2], color="black", linewidth=0.7)
    line.set(xlabel="x (mm), through the middle", ylabel="irradiance / open aperture")
    line.yaxis.set(label_position="right", ticks_position="right")  # away from the other scale
    line.set_title(title, fontsize=9)


def otf(
    camera: LenslessCamera,
    *,
    wavelength: Number,
    object_distance: Number = math.inf,
    model: Model | PsfMethod = "separable",
    pixel_integration: bool = True,
) -> Figure:
    """Magnitude of a camera's OTF, relative to zero frequency, and the same along v = 0.

    Arguments as of `tc.otf`.
    """
    light = {"wavelength": wavelength, "object_distance": object_distance, "model": model}
    response = np.asarray(psfs.otf(camera, **light, pixel_integration=pixel_integration))
    grid = camera.sensor.grid
    u, v = np.asarray(grid.u), np.asarray(grid.v)
    rows, columns = response.shape
    relative = response / np.abs(response[rows // 2, columns // 2])
    figure = new_figure(8.5, 3.4)
    whole, line = figure.subplots(1, 2, gridspec_kw={"width_ratios": (1, 1.6)})
    decibels = 20 * np.log10(np.maximum(np.abs(relative), 1e-6))
    du, dv = (u[1] - u[0]) / 2, (v[1] - v[0]) / 2
    extent = (u[0] - du, u[-1] + du, v[-1] + dv, v[0] - dv)
    shown = whole.imshow(decibels, cmap="gray", vmin=-60, vmax=0, extent=extent, aspect="auto")
    figure.colorbar(shown, ax=whole, label="|H| / |H(0)| (dB)")
    whole.set(xlabel="u (cycles/mm)", ylabel="v (cycles/mm)")
    positive = slice(columns // 2, None)
    line.plot(u[positive], decibels[rows // 2, positive], color="black", linewidth=0.8)
    line.set(xlabel="u (cycles/mm), v = 0", ylabel="|H| / |H(0)| (dB)", ylim=(-60, 3))
    line.set_title(_title(camera.mask), fontsize=9)
    return figure


@checked
def mask(mask: AbstractMask, *, wavelength: Number | None = None, samples: int = 512) -> Figure:
    """A mask's amplitude transmittance, and its phase where it delays the light.

    - `wavelength`: mm, of the light; a phase mask needs it.
    - `samples`: along the longer side of the mask.
    """
    height, width = (float(side) for side in mask.extent)
    pitch = max(height, width) / whole("samples", samples, 1)
    grid = Grid((max(1, round(height / pitch)), max(1, round(width / pitch))), pitch)
    field = np.asarray(mask.sample(grid, wavelength))
    phase = np.angle(field) if np.iscomplexobj(field) else np.zeros(field.shape)
    delays = bool(np.any((np.abs(field) > 1e-3) & (np.abs(phase) > 1e-6)))
    amplitude = "amplitude transmittance", np.abs(field), {"vmin": 0, "vmax": 1}
    delay = "phase (rad)", phase, {"vmin": -np.pi, "vmax": np.pi}
    drawn = [amplitude, delay] if delays else [amplitude]
    figure = new_figure(4.3 * len(drawn), 3.6)
    panels = figure.subplots(1, len(drawn), squeeze=False)[0]
    for axes, (label, values, limits) in zip(panels, drawn, strict=True):
        figure.colorbar(show_image(axes, values, pitch, **limits), ax=axes, label=label)
    figure.suptitle(_title(mask), fontsize=9)
    return figure


def _title(mask: AbstractMask) -> str:
    """The mask's numbers in at most three lines."""
    return textwrap.fill(wl.pformat(mask, width=10_000), 56, max_lines=3)


# The figures of reconstructions wait for no design.

_ROOM = 0.06  # around points, as a part of an axis
_SHADED = 85  # per cent of the landscape that the shades tell apart; the worst is one shade


@checked
def history(result: Reconstruction) -> Figure:
    """Objective and residuals of an iterative reconstruction over its iterations.

    **Errors**: ValueError where the method is a closed form and has no iterations.
    """
    if not result.history:
        raise ValueError(
            f"the reconstruction by {result.method or 'this method'} has no iterations; give the "
            "result of an iterative solver, such as tc.AdmmTV()"
        )
    iterations = [entry.iteration for entry in result.history]
    figure = new_figure(8.5, 3.2)
    objective, residuals = figure.subplots(1, 2)
    values = [entry.objective for entry in result.history]
    objective.plot(iterations, values, color="black", marker=".")
    objective.set(xlabel="iteration", ylabel="objective")
    for name, style in (("primal", "-"), ("dual", "--")):
        values = np.array([getattr(entry, name) for entry in result.history], dtype=float)
        if np.isfinite(values).any():
            residuals.semilogy(iterations, values, style, color="black", marker=".", label=name)
    residuals.set(xlabel="iteration", ylabel="relative residual")
    if residuals.lines:
        residuals.legend(frameon=False)
    objective.set_title(f"{result.method}, {result.ending.partition(';')[0]}", fontsize=9)
    return figure


@checked
def landscape(
    values: Any, across: Any, down: Any, *, labels: tuple[str, str, str] = ("", "", "")
) -> Figure:
    """An objective over two parameters, as grey levels with contours; a cross marks its minimum.

    - `values`: (down, across); values that are not finite stay white.
    - `across`, `down`: the parameters' values, ascending.
    - `labels`: labels of both axes and of the values, with units: ("β₁ (rad/mm²)", "β₂ (rad/mm²)",
      "error (dB)").

    **Errors**: ValueError where the shapes do not fit, or no value is finite.
    """
    values, across, down = (numbers("an argument", v).astype(float) for v in (values, across, down))
    if values.shape != (*down.shape, *across.shape) or not np.isfinite(values).any():
        raise ValueError(
            f"values of shape {values.shape} over {across.size} values across and {down.size} "
            f"down; give finite values of shape ({down.size}, {across.size})"
        )
    figure = new_figure(5.2, 4.0)
    axes = figure.subplots()
    shown = axes.pcolormesh(across, down, values, cmap="gray", shading="nearest")
    figure.colorbar(shown, ax=axes, label=labels[2])
    if min(values.shape) > 1 and np.nanmin(values) < np.nanmax(values):
        lines = axes.contour(across, down, values, levels=6, colors="tab:blue", linewidths=0.7)
        axes.clabel(lines, fontsize=7)
    row, column = np.unravel_index(np.nanargmin(values), values.shape)
    axes.plot(across[column], down[row], "x", color="tab:red", markersize=9)
    axes.set(xlabel=labels[0], ylabel=labels[1])
    return figure


def draw_landscape(
    landscape: "Landscape", ax: "Axes", designs: "Mapping[str, Design]", costs: Mapping[str, float]
) -> None:
    """A map of two numbers, or a line over one; arguments as of `Landscape.plot`."""
    from thincam_jax.design.space import REPORTED

    scaled = zip(landscape.variables, landscape.axes, strict=True)
    axes = [axis * REPORTED[name].scale for (name, _), axis in scaled]
    labels = [REPORTED[name].of_shots(shots) for name, shots in landscape.variables]
    places = {name: landscape.place(design) for name, design in designs.items()}
    if len(axes) == 1:
        _draw_line(ax, landscape, axes[0], places, costs)
        ax.set(xlabel=labels[0], ylabel=landscape.label)
    else:
        _draw_map(ax, landscape, axes, places)
        ax.set(xlabel=labels[0], ylabel=labels[1])
    if places:
        below = {"loc": "upper center", "bbox_to_anchor": (0.5, -0.1)}
        ax.legend(fontsize=9, ncols=2, frameon=False, **below)


def _draw_line(
    ax: "Axes",
    landscape: "Landscape",
    axis: np.ndarray,
    places: Mapping[str, Any],
    costs: Mapping[str, float],
) -> None:
    ax.plot(axis, landscape.values, color="black", linewidth=1)
    for number, (name, (place,)) in enumerate(places.items()):
        on_line = np.interp(place, axis, landscape.values)
        height = landscape.reported(costs[name]) if name in costs else on_line
        ax.plot(place, float(height), label=name, zorder=5, **_marker(number))
    ax.grid(alpha=0.3)


def _draw_map(
    ax: "Axes", landscape: "Landscape", axes: list[np.ndarray], places: Mapping[str, Any]
) -> None:
    values = landscape.values.T
    more = getattr(landscape.objective, "maximised", False)
    worst = np.nanpercentile(values, 100 - _SHADED if more else _SHADED)
    shades: dict[str, Any] = {"vmin" if more else "vmax": worst, "cmap": "cividis"}
    x, y = axes
    shown = ax.pcolormesh(x, y, values, shading="nearest", rasterized=True, **shades)
    figure: Any = ax.figure
    figure.colorbar(shown, ax=ax, label=landscape.label, extend="min" if more else "max")
    # Grounds beside the map are not allowed, or not looked at.
    ax.set_facecolor("#e8e8e8")
    own = np.array([*places.values()]).reshape(-1, 2)
    ax.set_xlim(*_reach(x, own[:, 0]))
    ax.set_ylim(*_reach(y, own[:, 1]))
    for number, (name, place) in enumerate(places.items()):
        ax.plot(*place, label=name, clip_on=False, zorder=5, **_marker(number))


def _marker(number: int) -> dict[str, Any]:
    """Marker of the reference, number 0, and of designs found: told apart by shape."""
    face, edge, size = ("white", "black", 10) if number else ("black", "white", 12)
    style = {"marker": "Xo^Ds"[number % 5], "markersize": size, "linestyle": "none"}
    return style | {"color": face, "markeredgecolor": edge, "markeredgewidth": 1.3}


def _reach(axis: np.ndarray, own: np.ndarray) -> tuple[float, float]:
    """The axis, and room for points that lie beyond it."""
    half = (axis[1] - axis[0]) / 2
    low, high = axis[0] - half, axis[-1] + half
    room = _ROOM * (high - low)
    low = min([low, *(own - room)[own < low]])
    high = max([high, *(own + room)[own > high]])
    return float(low), float(high)


def front(points: "Sequence[FrontPoint]", cost: str) -> Figure:
    """Resolution and error of the points of a front over their cost; hollow ones are dominated.

    - `points`: result of `tc.design.find_front`. `cost`: label of the cost, "thickness (mm)".
    """
    from thincam_jax.design.fronts import non_dominated

    figure = new_figure(8.5, 3.4)
    worths = (
        ("resolution", "limit of resolution (cycles/rad)", True),
        ("error", "expected error over the scene's variance", False),
    )
    for ax, (name, label, larger) in zip(figure.subplots(1, 2), worths, strict=True):
        places = np.array([(point.cost, getattr(point, name)) for point in points], dtype=float)
        best = non_dominated(places, larger=(False, larger))
        ax.plot(*places.T, color="black", linewidth=0.7)
        for chosen, face in ((best, "black"), (~best, "white")):
            marks = {"linestyle": "none", "markerfacecolor": face, "markeredgecolor": "black"}
            ax.plot(*places[chosen].T, marker="o", **marks)
        ax.set(xlabel=cost, ylabel=label)
    return figure


def sensitivity(around: "Sensitivity") -> Figure:
    """Tolerance of each free number of a design, in per cent of the number, as bars."""
    from thincam_jax.design.space import REPORTED

    values = around.values
    names = [f"{REPORTED[v.variable].of_shots(v.shots)}\n{v}" for v in values]
    parts = [np.nan if v.tolerance is None else 100 * v.tolerance / abs(v.value) for v in values]
    figure = new_figure(6.0, 0.6 * len(values) + 1.0)
    axes = figure.subplots()
    axes.barh(names, parts, color="#606060")
    axes.invert_yaxis()
    axes.set(xlabel="tolerance (per cent of the number)")
    return figure
