"""Figure of a sweep: how the methods' PSNR goes along each axis of its grid."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from thincam_jax._core.quantity import quantities
from thincam_jax.imaging.scene import ImagePlane
from thincam_jax.imaging.sensor import GaussianNoise, PoissonGaussianNoise, Sensor
from thincam_jax.lensless.camera import LightPath
from thincam_jax.lensless.masks.fza import FresnelZoneAperture
from thincam_jax.plot.frame import drawing, line_style

_MAPS = 4  # of methods, at most
# Of the swept values that are numbers, by the last key of their path.
_QUANTITIES = quantities(
    *(FresnelZoneAperture, LightPath, Sensor, GaussianNoise, PoissonGaussianNoise, ImagePlane)
)
_QUANTITIES["phases"] = _QUANTITIES["phase"]


def draw_sweep(rows: list[dict], axes: Sequence[str], methods: dict[str, str]) -> Figure:
    """A panel of lines for each axis; of two axes also maps of methods that change along both.

    - `rows`: results of the points, by column. `axes`: the columns of swept values, whose last word
      says their quantity, as `methods.0.shots.0.beta` in rad/mm².
    - `methods`: the column of each method's mean PSNR, dB.
    """
    changing = [m for m in methods.items() if all(_changes(rows, p, axes, m[1]) for p in axes)]
    maps = changing[:_MAPS] if len(axes) == 2 else []
    count = len(axes) + len(maps)
    columns = min(2, count)
    lines = -(-count // columns)
    figure, panels = drawing((5.6 * columns, 3.9 * lines), lines, columns, squeeze=False)
    panels = list(panels.ravel())
    for ax in panels[count:]:
        ax.set_axis_off()
    for ax, path in zip(panels, axes, strict=False):
        _draw_lines(ax, rows, path, methods, alone=len(axes) == 1)
    for ax, (method, column) in zip(panels[len(axes) :], maps, strict=False):
        shown = _draw_map(ax, rows, axes[0], axes[1], column)
        ax.set_title(method, fontsize=10, loc="left")
        figure.colorbar(shown, ax=ax, label="mean PSNR (dB)")
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside upper center", ncols=2)
    return figure


def _changes(rows: list[dict], path: str, axes: Sequence[str], column: str) -> bool:
    """Whether a method's PSNR depends on an axis, at any values of the others."""
    seen: dict[tuple, set] = {}
    for row in rows:
        seen.setdefault(tuple(row[other] for other in axes if other != path), set()).add(
            row[column]
        )
    return any(len(values) > 1 for values in seen.values())


def _draw_lines(
    ax: Axes, rows: list[dict], path: str, methods: dict[str, str], alone: bool
) -> None:
    """The mean over the other axes, and their range as bars."""
    values, place = _values(rows, path)
    for number, (method, column) in enumerate(methods.items()):
        run = [row for row in rows if row[column] is not None]
        groups = [[row[column] for row in run if row[path] == value] for value in values]
        known = [n for n, group in enumerate(groups) if group]
        means = np.array([np.mean(groups[n]) for n in known])
        spread = [means - [min(groups[n]) for n in known], [max(groups[n]) for n in known] - means]
        style = line_style(number) | {"markersize": 5, "linewidth": 1.2, "capsize": 3}
        ax.errorbar(place[known], means, None if alone else spread, label=method, **style)
    ax.set(xlabel=_label(path), ylabel="mean PSNR of all targets (dB)")
    if not alone:
        ax.set_title("mean over the other axes; bars: their range", fontsize=9, loc="left")
    if any(isinstance(value, str) for value in values):
        ax.set_xticks(place, [_short(value) for value in values])
    ax.grid(alpha=0.3)


def _draw_map(ax: Axes, rows: list[dict], across: str, up: str, column: str) -> Any:
    xs, ys = (_values(rows, path)[0] for path in (across, up))
    level = np.full((len(ys), len(xs)), np.nan)
    for row in rows:
        if row[column] is not None:
            level[ys.index(row[up]), xs.index(row[across])] = row[column]
    shown = ax.pcolormesh(np.arange(len(xs)), np.arange(len(ys)), level, cmap="cividis")
    ax.set(xlabel=_label(across), ylabel=_label(up))
    for axis, values in ((ax.xaxis, xs), (ax.yaxis, ys)):
        axis.set_ticks(range(len(values)), [_short(value) for value in values])
    return shown


def _values(rows: list[dict], path: str) -> tuple[list[Any], np.ndarray]:
    """The values of an axis in the grid's order, and where they are drawn."""
    values = list(dict.fromkeys(row[path] for row in rows))
    numbers = all(isinstance(v, int | float) and not isinstance(v, bool) for v in values)
    return values, np.asarray(values if numbers else range(len(values)), float)


def _short(value: Any) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)[:16]


def _label(path: str) -> str:
    quantity = _QUANTITIES.get(path.rpartition(".")[2])
    return f"{path} ({quantity.symbol})" if quantity and quantity.symbol else path
