"""Figures of objectives: over iterations, over a design's numbers, on fronts; tolerances."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from thincam_jax._core.arguments import checked
from thincam_jax._core.checks import numbers
from thincam_jax.plot.frame import Figure, new_figure
from thincam_jax.reconstruction.result import Reconstruction

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from thincam_jax.design.design import Design
    from thincam_jax.design.fronts import FrontPoint
    from thincam_jax.design.landscape import Landscape
    from thincam_jax.design.sensitivity import Sensitivity

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
