"""The pictures of a design: the objective's landscape, the responses, and contrast transfer."""

import io
import operator
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from matplotlib.figure import Figure

from thincam_jax.commands.design.landscape import Landscape
from thincam_jax.commands.design.problem import Goal
from thincam_jax.commands.design.ranking import Candidate, Result, Shot
from thincam_jax.commands.design.train import TrainingGoal
from thincam_jax.commands.design.transfer import Transfer
from thincam_jax.commands.design.words import QUANTITIES, first, free_number
from thincam_jax.commands.study.figures import line_style

_ROOM = 0.06  # around points, as a part of an axis
_SHADED = 85  # per cent of the landscape that the shades tell apart; the worst is one shade
_LEAST_CONTRAST = 1e-5
_FLOOR_DB = -30.0  # what is further below the noise is not drawn


def as_png(figure: Figure) -> bytes:
    """The file's content."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=110)
    return buffer.getvalue()


class _View(NamedTuple):
    """A landscape, what it is of, and the value of a design as drawn and as told."""

    around: Landscape
    goal: Goal | TrainingGoal
    drawn: Callable[[Candidate], float | None]
    told: Callable[[Candidate], float | None]

    def name(self, one: Candidate) -> str:
        value = self.told(one)
        if value is None:
            return one.name
        return f"{one.name} ({float(self.goal.told(value)):.2f} {self.goal.unit})"


def draw_landscape(result: Result, count: int) -> Figure | None:
    """The objective over the free numbers, with the reference and the first `count` found.

    None where the search's bounds leave no room to draw.
    """
    if result.landscape is None:
        return None
    searched, exact = operator.attrgetter("searched"), operator.attrgetter("exact")
    return _draw(_View(result.landscape, result.goal, searched, exact), result, count)


def draw_training(result: Result, count: int) -> Figure | None:
    """The same of the training error; None without training."""
    if result.training is None or result.training.landscape is None:
        return None
    trained = operator.attrgetter("trained")
    view = _View(result.training.landscape, result.training.goal, trained, trained)
    return _draw(view, result, count)


def _draw(view: _View, result: Result, count: int) -> Figure:
    points = (result.reference, *result.found[:count])
    figure = Figure(figsize=(7.6, 6.0), layout="constrained")
    ax = figure.subplots()
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
    face = "black" if number == 0 else "white"
    edge = "white" if number == 0 else "black"
    shape = "Xo^Ds"[number % 5]
    size = 12 if number == 0 else 10
    return {
        "marker": shape,
        "markersize": size,
        "color": face,
        "markeredgecolor": edge,
        "markeredgewidth": 1.3,
        "linestyle": "none",
    }


def _draw_map(figure: Figure, ax, view: _View, points: tuple[Candidate, ...]) -> None:
    around, goal = view.around, view.goal
    x, y = _axes(around)
    told = goal.told(around.goal).T
    worst = np.nanpercentile(told, 100 - _SHADED if goal.wants_more else _SHADED)
    steps = {"vmin" if goal.wants_more else "vmax": worst}
    extend = "min" if goal.wants_more else "max"
    shown = ax.pcolormesh(x, y, told, cmap="cividis", shading="nearest", rasterized=True, **steps)
    figure.colorbar(shown, ax=ax, label=goal.label, extend=extend)
    # Grounds beside the map are not allowed, or not looked at.
    ax.set_facecolor("#e8e8e8")
    places = np.array([_place(around, p) for p in points])
    for set_limits, axis, own in ((ax.set_xlim, x, places[:, 0]), (ax.set_ylim, y, places[:, 1])):
        set_limits(*_reach(axis, own))
    for number, (one, place) in enumerate(zip(points, places, strict=True)):
        ax.plot(*place, label=view.name(one), clip_on=False, zorder=5, **_marker(number))
    ax.set_xlabel(free_number(*around.variables[0]))
    ax.set_ylabel(free_number(*around.variables[1]))


def _reach(axis: np.ndarray, own: np.ndarray) -> tuple[float, float]:
    """The axis, and room for points that lie beyond it."""
    half = (axis[1] - axis[0]) / 2
    low, high = axis[0] - half, axis[-1] + half
    room = _ROOM * (high - low)
    low = min(low, own.min() - room) if own.min() < low else low
    high = max(high, own.max() + room) if own.max() > high else high
    return float(low), float(high)


def _draw_line(ax, view: _View, points: tuple[Candidate, ...]) -> None:
    around, goal = view.around, view.goal
    ax.plot(_axes(around)[0], goal.told(around.goal), color="black", linewidth=1)
    for number, one in enumerate(points):
        level = view.drawn(one)
        assert level is not None  # for the type checker; what is drawn was scored
        place = _place(around, one)
        ax.plot(*place, float(goal.told(level)), label=view.name(one), zorder=5, **_marker(number))
    ax.set_xlabel(free_number(*around.variables[0]))
    ax.set_ylabel(goal.label)
    ax.grid(alpha=0.3)


def draw_responses(result: Result, count: int, pitch: float) -> Figure:
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
    ax.set_xlim(0, result.edge)
    ax.set_ylim(bottom=_FLOOR_DB)
    ax.set_ylabel("signal-to-noise ratio,\nmean over a ring (dB)")
    ax.legend(fontsize=9)
    over.set_ylabel(f"over {result.reference.name}\n(dB)")
    over.set_xlabel("angular frequency of the object (cycles/rad)")
    distance = max(shot.distance for shot in result.reference.shots)
    along = (lambda nu: np.asarray(nu) / distance, lambda u: np.asarray(u) * distance)
    ax.secondary_xaxis("top", functions=along).set_xlabel(
        f"on the sensor at the reference's {distance:g} mm (cycles/mm); "
        f"its pixels' Nyquist frequency is {1 / (2 * pitch):.4g}"
    )
    return figure


def draw_mtf(result: Result, object_distance: float) -> Figure | None:
    """Contrast transfer of the reference and of the best design side by side, on common axes.

    `object_distance` in mm. None for a result without transfers.
    """
    if result.transfers is None:
        return None
    figure = Figure(figsize=(11.0, 5.6), layout="constrained")
    panels = figure.subplots(1, 2, sharex=True, sharey=True)
    for ax, one, transfer in zip(
        panels, (result.reference, result.found[0]), result.transfers, strict=True
    ):
        _draw_transfer(ax, one, transfer, result.edge)
        along = (
            lambda nu: np.asarray(nu) / object_distance,
            lambda u: np.asarray(u) * object_distance,
        )
        ax.secondary_xaxis("top", functions=along).set_xlabel("on the object (cycles/mm)")
        ax.set_xlabel("angular frequency (cycles/rad)")
    panels[0].set_ylabel("contrast transfer, over rings")
    return figure


def _draw_transfer(ax, one: Candidate, transfer: Transfer, edge: float) -> None:
    frequency = (np.arange(len(transfer.chain)) + 0.5) / len(transfer.chain) * edge
    chain = {"color": "black", "linewidth": 2.2, "label": "camera and reconstruction"}
    ax.plot(frequency, transfer.chain, **chain)
    phases = max(n for sums in transfer.sums for part in sums for n in part) // len(one.shots)
    for number, (level, sums) in enumerate(zip(transfer.channels, transfer.sums, strict=True)):
        style = line_style(number) | {"markersize": 4, "markevery": (2 * number, 8)}
        shot = one.shots[(sums[0][0] - 1) // phases]
        ax.plot(frequency, level, linewidth=1.2, label=_sum_label(shot, sums), **style)
    ax.set_yscale("log")
    ax.set_xlim(0, edge)
    ax.set_ylim(_LEAST_CONTRAST, 1.5)
    ax.grid(alpha=0.3)
    ax.set_title(one.name, fontsize=11)
    ax.legend(fontsize=9, loc="upper center", bbox_to_anchor=(0.5, -0.13), frameon=False)


def _sum_label(shot: Shot, sums: tuple[tuple[int, ...], tuple[int, ...]]) -> str:
    """Of a sum of captures: "captures 1 − 2: β 25 rad/mm² at 6.5 mm"."""
    added, taken = (" + ".join(str(n) for n in part) for part in sums)
    formula = f"{added} − {taken.replace('+', '−')}" if taken else added
    return f"captures {formula}: β {shot.beta:.4g} rad/mm² at {shot.distance:.3g} mm"


def _decibel(level: np.ndarray) -> np.ndarray:
    """NaN, which is not drawn, below the floor."""
    return 10 * np.log10(np.where(level > 10 ** (_FLOOR_DB / 10), level, np.nan))
