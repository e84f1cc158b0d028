"""The pictures of a design: the objective's landscape, responses, contrast transfer and fronts."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.ticker import FixedLocator, NullLocator

from thincam_jax._core.grids import Grid
from thincam_jax.commands.design.problem import DesignObjective, Shot, phases_of
from thincam_jax.commands.design.ranking import Candidate, FoundDesigns
from thincam_jax.commands.design.record import COSTS
from thincam_jax.commands.design.surroundings import Landscape
from thincam_jax.commands.design.train import TrainingObjective
from thincam_jax.commands.design.transfer import Transfer
from thincam_jax.commands.design.words import QUANTITIES, first, free_number
from thincam_jax.commands.study.build import FileStudy
from thincam_jax.commands.study.figures import as_png as as_png
from thincam_jax.commands.study.figures import drawing, line_style

_ROOM = 0.06  # around points, as a part of an axis
_SHADED = 85  # per cent of the landscape that the shades tell apart; the worst is one shade
_LEAST_CONTRAST = 1e-5
_FLOOR_DB = -30.0  # what is further below the noise is not drawn
_FACE = {True: "white", False: "black"}  # of points that are dominated, and of the front's
_MARKER = {"markersize": 8, "markeredgewidth": 1.3, "linestyle": "none", "zorder": 4}
_LABELS = {
    "thickness": "thickness: longest distance allowed (mm)",
    "captures": "captures",
    "light": "light: electrons from each mm² of open aperture",
}


@dataclass(frozen=True, eq=False)
class _DrawnLandscape:
    """A landscape, what it is of, and which value of a design is drawn and which is told."""

    around: Landscape
    objective: DesignObjective | TrainingObjective
    drawn: str
    told: str

    def name(self, one: Candidate) -> str:
        value = getattr(one, self.told)
        if value is None:
            return one.name
        return f"{one.name} ({float(self.objective.told(value)):.2f} {self.objective.unit})"


_MASK_SAMPLES = 600  # along a side of a drawn mask


def draw_masks(study: FileStudy, best: str) -> Figure:
    """The first mask of each shot and its PSF, of the reference and of the best design, in rows."""
    methods = [study.methods[0], next(m for m in study.methods if m.name == best)]
    shots = max(len(method.shots) for method in methods)
    figure, rows = drawing((5.2 * shots, 6.2), 2, 2 * shots, squeeze=False)
    for axes, method in zip(rows, methods, strict=True):
        for ax in axes:
            ax.set_axis_off()
        for ax, beside, shot in zip(axes[::2], axes[1::2], method.shots, strict=False):
            camera, half = study.camera(shot), shot.width / 2
            grid = Grid((_MASK_SAMPLES,) * 2, shot.width / _MASK_SAMPLES)
            mask = np.abs(np.asarray(camera.mask.sample(grid)))
            ax.imshow(mask, cmap="gray", vmin=0, vmax=1, extent=(-half, half, half, -half))
            h = np.asarray(study.psf(shot))
            y, x = (n * study.pitch / 2 for n in h.shape)
            beside.imshow(h, cmap="gray", extent=(-x, x, y, -y))
            for drawn, what in ((ax, "mask"), (beside, "its PSF")):
                drawn.set_axis_on()
                drawn.set_xlabel("x (mm)")
                drawn.set_title(f"{method.name}, {what}", fontsize=9)
            ax.set_ylabel(f"β {shot.beta:.4g} rad/mm² at {shot.distance:.3g} mm\ny (mm)")
    return figure


def draw_landscape(result: FoundDesigns, count: int) -> Figure | None:
    """The objective over the free numbers, with the reference and the first `count` found.

    None where the search's bounds leave no room to draw.
    """
    if result.landscape is None:
        return None
    view = _DrawnLandscape(result.landscape, result.objective, "searched", "exact")
    return _draw(view, result, count)


def draw_training(result: FoundDesigns, count: int) -> Figure | None:
    """The same of the training error; None without training."""
    if result.training is None or result.training.landscape is None:
        return None
    given = result.training.landscape, result.training.objective
    return _draw(_DrawnLandscape(*given, "trained", "trained"), result, count)


def _draw(view: _DrawnLandscape, result: FoundDesigns, count: int) -> Figure:
    points = (result.reference, *result.found[:count])
    figure, ax = drawing((7.6, 6.0))
    if len(view.around.axes) == 1:
        _draw_line(ax, view, points)
    else:
        _draw_map(figure, ax, view, points)
    ax.legend(fontsize=9, loc="upper center", bbox_to_anchor=(0.5, -0.1), ncols=2, frameon=False)
    return figure


def _place(landscape: Landscape, one: Candidate) -> list[float]:
    """Where a design lies on the landscape's axes, as drawn."""
    return [
        getattr(one.shots[first(shots)], name) * QUANTITIES[name].scale
        for name, shots in landscape.variables
    ]


def _axes(landscape: Landscape) -> list[np.ndarray]:
    """As drawn."""
    named = zip(landscape.variables, landscape.axes, strict=True)
    return [axis * QUANTITIES[name].scale for (name, _), axis in named]


def _marker(number: int) -> dict:
    """Of the reference, number 0, and of what was found: told apart by shape."""
    face, edge, size = ("white", "black", 10) if number else ("black", "white", 12)
    style = {"marker": "Xo^Ds"[number % 5], "markersize": size, "linestyle": "none"}
    return style | {"color": face, "markeredgecolor": edge, "markeredgewidth": 1.3}


def _draw_map(figure: Figure, ax, view: _DrawnLandscape, points: tuple[Candidate, ...]) -> None:
    around, objective = view.around, view.objective
    x, y = _axes(around)
    told = objective.told(around.values).T
    worst = np.nanpercentile(told, 100 - _SHADED if objective.wants_more else _SHADED)
    steps = {"vmin" if objective.wants_more else "vmax": worst}
    extend = "min" if objective.wants_more else "max"
    shown = ax.pcolormesh(x, y, told, cmap="cividis", shading="nearest", rasterized=True, **steps)
    figure.colorbar(shown, ax=ax, label=objective.label, extend=extend)
    # Grounds beside the map are not allowed, or not looked at.
    ax.set_facecolor("#e8e8e8")
    places = np.array([_place(around, p) for p in points])
    for set_limits, axis, own in ((ax.set_xlim, x, places[:, 0]), (ax.set_ylim, y, places[:, 1])):
        set_limits(*_reach(axis, own))
    for number, (one, place) in enumerate(zip(points, places, strict=True)):
        ax.plot(*place, label=view.name(one), clip_on=False, zorder=5, **_marker(number))
    names = [free_number(*variable) for variable in around.variables]
    ax.set(xlabel=names[0], ylabel=names[1])


def _reach(axis: np.ndarray, own: np.ndarray) -> tuple[float, float]:
    """The axis, and room for points that lie beyond it."""
    half = (axis[1] - axis[0]) / 2
    low, high = axis[0] - half, axis[-1] + half
    room = _ROOM * (high - low)
    low = min(low, own.min() - room) if own.min() < low else low
    high = max(high, own.max() + room) if own.max() > high else high
    return float(low), float(high)


def _draw_line(ax, view: _DrawnLandscape, points: tuple[Candidate, ...]) -> None:
    around, objective = view.around, view.objective
    ax.plot(_axes(around)[0], objective.told(around.values), color="black", linewidth=1)
    for number, one in enumerate(points):
        point = *_place(around, one), float(objective.told(getattr(one, view.drawn)))
        ax.plot(*point, label=view.name(one), zorder=5, **_marker(number))
    ax.set(xlabel=free_number(*around.variables[0]), ylabel=objective.label)
    ax.grid(alpha=0.3)


def draw_responses(result: FoundDesigns, count: int, pitch: float) -> Figure:
    """Ring means of the signal-to-noise ratio of the reference and the first `count` found."""
    figure = Figure(figsize=(8.5, 6.2), layout="constrained")
    ax, over = figure.subplots(2, 1, sharex=True, height_ratios=(1.5, 1))
    rings = len(result.reference.level)
    frequency = (np.arange(rings) + 0.5) / rings * result.edge
    reference = _decibel(result.reference.level)
    for number, one in enumerate((result.reference, *result.found[:count])):
        level = _decibel(one.level)
        style = line_style(number) | {"markersize": 4, "markevery": (number, 5), "linewidth": 1.2}
        ax.plot(frequency, level, label=one.name, **style)
        if number:
            over.plot(frequency, level - reference, **style)
    for axes in (ax, over):
        axes.axhline(0, color="black", linewidth=0.8)
        axes.grid(alpha=0.3)
    ax.set(xlim=(0, result.edge), ylabel="signal-to-noise ratio,\nmean over a ring (dB)")
    ax.set_ylim(bottom=_FLOOR_DB)
    ax.legend(fontsize=9)
    over.set_ylabel(f"over {result.reference.name}\n(dB)")
    over.set_xlabel("angular frequency of the object (cycles/rad)")
    distance = max(shot.distance for shot in result.reference.shots)
    ax.secondary_xaxis("top", functions=_at(distance)).set_xlabel(
        f"on the sensor at the reference's {distance:g} mm (cycles/mm); "
        f"its pixels' Nyquist frequency is {1 / (2 * pitch):.4g}"
    )
    return figure


def draw_mtf(result: FoundDesigns, object_distance: float) -> Figure | None:
    """Contrast transfer of the reference and of the best design side by side, on common axes.

    `object_distance` in mm. None for a result without transfers.
    """
    if result.transfers is None:
        return None
    figure, panels = drawing((11.0, 5.6), 1, 2, sharex=True, sharey=True)
    shown = (result.reference, result.found[0])
    for ax, one, transfer in zip(panels, shown, result.transfers, strict=True):
        _draw_transfer(ax, one, transfer, result.edge)
        top = ax.secondary_xaxis("top", functions=_at(object_distance))
        top.set_xlabel("on the object (cycles/mm)")
        ax.set_xlabel("angular frequency (cycles/rad)")
    panels[0].set_ylabel("contrast transfer, over rings")
    return figure


def _draw_transfer(ax, one: Candidate, transfer: Transfer, edge: float) -> None:
    frequency = (np.arange(len(transfer.chain)) + 0.5) / len(transfer.chain) * edge
    chain = {"color": "black", "linewidth": 2.2, "label": "camera and reconstruction"}
    ax.plot(frequency, transfer.chain, **chain)
    phases = phases_of(one.design)
    for number, (level, sums) in enumerate(zip(transfer.channels, transfer.sums, strict=True)):
        style = line_style(number) | {"markersize": 4, "markevery": (2 * number, 8)}
        shot = one.shots[(sums[0][0] - 1) // phases]
        ax.plot(frequency, level, linewidth=1.2, label=_sum_label(shot, sums), **style)
    ax.set(yscale="log", xlim=(0, edge), ylim=(_LEAST_CONTRAST, 1.5))
    ax.grid(alpha=0.3)
    ax.set_title(one.name, fontsize=11)
    ax.legend(fontsize=9, loc="upper center", bbox_to_anchor=(0.5, -0.13), frameon=False)


def _sum_label(shot: Shot, sums: tuple[tuple[int, ...], tuple[int, ...]]) -> str:
    """Of a sum of captures: "captures 1 − 2: β 25 rad/mm² at 6.5 mm"."""
    added, taken = (" + ".join(str(n) for n in part) for part in sums)
    formula = f"{added} − {taken.replace('+', '−')}" if taken else added
    return f"captures {formula}: β {shot.beta:.4g} rad/mm² at {shot.distance:.3g} mm"


def _at(distance: float) -> tuple[Callable, Callable]:
    """From angular frequencies to those on a plane at a distance, and back."""
    return lambda nu: np.asarray(nu) / distance, lambda u: np.asarray(u) * distance


def _decibel(level: np.ndarray) -> np.ndarray:
    """NaN, which is not drawn, below the floor."""
    return 10 * np.log10(np.where(level > 10 ** (_FLOOR_DB / 10), level, np.nan))


def draw_fronts(fronts: dict[str, Any], reference: str, object_distance: float) -> Figure:
    """A panel for each front; `fronts` as in design.json, `object_distance` in mm."""
    asked = [name for name in _LABELS if name in fronts]
    layout = ConstrainedLayoutEngine(wspace=0.06)
    figure = Figure(figsize=(4.2 * len(asked) + 0.6, 4.9), layout=layout)
    for ax, name in zip(figure.subplots(1, len(asked), squeeze=False)[0], asked, strict=True):
        ax.set_xlabel(_LABELS[name])
        ax.grid(alpha=0.3)
        if name == "captures":
            _draw_captures(ax, fronts[name], reference)
        else:
            _draw_resolution(ax, fronts[name], COSTS[name][1], reference)
            right = ax.secondary_yaxis("right", functions=_at(object_distance))
            right.set_ylabel("on the object (line pairs/mm)")
        if name == "light":
            ax.set_xscale("log")
        ax.margins(0.08, 0.1)
        ax.legend(fontsize=9, loc="upper center", bbox_to_anchor=(0.5, -0.14), frameon=False)
    return figure


def _draw_resolution(ax, front: dict[str, Any], cost: str, reference: str) -> None:
    value = "resolution_cycles_per_rad"
    points = front["points"]
    _steps(ax, points, cost, value, "dominated", "-")
    groups = [
        (False, False, "on the front"),
        (True, False, "dominated by one of lower cost"),
        (False, True, "on the front; at least, where frequencies end"),
        (True, True, "dominated; at least, where frequencies end"),
    ]
    for beaten, ended, label in groups:
        kind = (beaten, ended)
        chosen = [p for p in points if (p["dominated"], bool(p["resolution_ends"])) == kind]
        if chosen:
            shape = "^" if ended else "o"
            _marks(ax, chosen, cost, value, label, marker=shape, markerfacecolor=_FACE[beaten])
    _mark_reference(ax, front["reference"], cost, value, reference)
    ax.set_ylabel("limit of resolution (cycles/rad)")


def _draw_captures(ax, front: dict[str, Any], reference: str) -> None:
    points = front["points"]
    known = [p for p in points if p["simulated_mean_db"] is not None]
    lines = [
        (points, "predicted_psnr_db", "dominated", "predicted", "-", "o", "black"),
        (known, "simulated_mean_db", "simulated_dominated", "simulated", "--", "s", "#8a8a8a"),
    ]
    for chosen, value, flag, label, dash, shape, colour in lines:
        _steps(ax, chosen, "captures", value, flag, dash)
        for beaten, told in ((False, label), (True, f"{label}; dominated")):
            group = [p for p in chosen if p[flag] == beaten]
            if group:
                face = "white" if beaten else colour
                _marks(ax, group, "captures", value, told, marker=shape, markerfacecolor=face)
    _mark_reference(
        ax, front["reference"], "captures", "predicted_psnr_db", f"{reference}, predicted"
    )
    ax.xaxis.set_major_locator(FixedLocator(sorted({p["captures"] for p in points})))
    ax.xaxis.set_minor_locator(NullLocator())
    ax.set_ylabel("PSNR, mean over the pictures (dB)")


def _marks(ax, points: list[dict[str, Any]], cost: str, value: str, label: str, **style) -> None:
    places = ([p[cost] for p in points], [p[value] for p in points])
    ax.plot(*places, label=label, markeredgecolor="black", **(_MARKER | style))


def _mark_reference(ax, point: dict[str, Any], cost: str, value: str, name: str) -> None:
    style = _MARKER | {"marker": "X", "markersize": 11, "zorder": 5}
    ax.plot(
        point[cost], point[value], label=name, color="#606060", markeredgecolor="white", **style
    )


def _steps(ax, points: list[dict[str, Any]], cost: str, value: str, flag: str, dash: str) -> None:
    """What is reached at each cost: the best of the points up to there."""
    front = sorted((p[cost], p[value]) for p in points if not p[flag])
    if not front:
        return
    # On to the last of all points, which may be dominated.
    front.append((max(p[cost] for p in points), front[-1][1]))
    ax.step(*np.transpose(front), where="post", color="black", linewidth=1.1, linestyle=dash)
