"""The picture of a design's Pareto fronts, drawn from what design.json says of them."""

from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, NullLocator

_FACE = {True: "white", False: "black"}  # of points that are dominated, and of the front's
_MARKER = {"markersize": 8, "markeredgewidth": 1.3, "linestyle": "none", "zorder": 4}
_LABELS = {
    "thickness": ("thickness: longest distance allowed (mm)", "thickness_mm"),
    "captures": ("captures", "captures"),
    "light": ("light: electrons from each mm² of open aperture", "electrons_per_mm2"),
}


def draw_fronts(fronts: dict[str, Any], reference: str, object_distance: float) -> Figure:
    """A panel for each front; `fronts` as in design.json, `object_distance` in mm."""
    asked = [name for name in _LABELS if name in fronts]
    figure = Figure(figsize=(4.2 * len(asked) + 0.6, 4.9), layout="constrained")
    engine = figure.get_layout_engine()
    assert engine is not None  # for the type checker
    engine.set(wspace=0.06)  # pyright: ignore[reportCallIssue]
    for ax, name in zip(figure.subplots(1, len(asked), squeeze=False)[0], asked, strict=True):
        label, cost = _LABELS[name]
        ax.set_xlabel(label)
        ax.grid(alpha=0.3)
        if name == "captures":
            _draw_captures(ax, fronts[name], reference)
        else:
            _draw_resolution(ax, fronts[name], cost, reference)
            _object_scale(ax, object_distance)
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
        chosen = [
            p
            for p in points
            if p["dominated"] == beaten and (p["resolution_ends"] is not None) == ended
        ]
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


def _object_scale(ax, distance: float) -> None:
    along = (lambda nu: np.asarray(nu) / distance, lambda u: np.asarray(u) * distance)
    ax.secondary_yaxis("right", functions=along).set_ylabel("on the object (line pairs/mm)")
