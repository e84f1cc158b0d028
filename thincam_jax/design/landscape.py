"""Landscape of an objective over one or two free numbers of a design, the others held."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from thincam_jax.design.design import Design
from thincam_jax.design.objectives import AbstractObjective
from thincam_jax.design.problem import DesignProblem, Objective
from thincam_jax.design.search import AT_A_TIME, evaluate
from thincam_jax.design.space import REPORTED, DesignSpace, Variable

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_ROOM = 0.06  # around points, as a part of an axis
_SHADED = 85  # per cent of the landscape that the shades tell apart; the worst is one shade


@dataclass(frozen=True, eq=False)
class Landscape:
    """An objective over one or two free numbers, the others as in one design.

    - `variables`: their names and shots (none for the width); `axes`: their values, in the
      package's units.
    - `costs`: (n,) or (n, n), the first variable along the first axis; NaN where there is none.
    - `objective`: that they are costs of.
    """

    variables: tuple[tuple[str, tuple[int, ...]], ...]
    axes: tuple[np.ndarray, ...]
    costs: np.ndarray
    objective: Objective

    @property
    def values(self) -> np.ndarray:
        """The costs as the objective reports them."""
        return self.reported(self.costs)

    @property
    def label(self) -> str:
        """Label of the values, with their unit."""
        if isinstance(self.objective, AbstractObjective):
            return self.objective.label
        return "objective to minimise"

    def reported(self, costs: Any) -> Any:
        """Values that are reported for costs."""
        if isinstance(self.objective, AbstractObjective):
            return self.objective.reported(costs)
        return np.asarray(costs, dtype=float)

    def place(self, design: Design) -> tuple[float, ...]:
        """Where a design lies on the axes, in the units of the plot."""
        firsts = [(own[0] - 1) * design.phases if own else 0 for _, own in self.variables]
        return tuple(
            float(np.asarray(getattr(design, name), dtype=float).ravel()[first])
            * REPORTED[name].scale
            for (name, _), first in zip(self.variables, firsts, strict=True)
        )

    def plot(
        self,
        designs: Mapping[str, Design] | None = None,
        costs: Mapping[str, float] | None = None,
        *,
        ax: "Axes | None" = None,
    ) -> "Figure":
        """A map of two numbers, or a line over one, with labelled axes.

        - `designs`: marked in it, by their names in the legend; the first is the reference.
        - `costs`: where they are drawn over a single number; by default on the line.
        - `ax`: to draw in; by default of a new figure of pyplot, which a notebook shows.
        """
        if ax is None:
            from thincam_jax.plot.frame import new_figure

            ax = new_figure(7.6, 6.0).subplots()
        scaled = zip(self.variables, self.axes, strict=True)
        axes = [axis * REPORTED[name].scale for (name, _), axis in scaled]
        labels = [REPORTED[name].of_shots(shots) for name, shots in self.variables]
        places = {name: self.place(design) for name, design in (designs or {}).items()}
        if len(axes) == 1:
            self._draw_line(ax, axes[0], places, costs or {})
            ax.set(xlabel=labels[0], ylabel=self.label)
        else:
            self._draw_map(ax, axes, places)
            ax.set(xlabel=labels[0], ylabel=labels[1])
        if places:
            below = {"loc": "upper center", "bbox_to_anchor": (0.5, -0.1)}
            ax.legend(fontsize=9, ncols=2, frameon=False, **below)
        figure: Any = ax.figure
        return figure

    def _draw_line(
        self, ax: "Axes", axis: np.ndarray, places: Mapping[str, Any], costs: Mapping[str, float]
    ) -> None:
        ax.plot(axis, self.values, color="black", linewidth=1)
        for number, (name, (place,)) in enumerate(places.items()):
            on_line = np.interp(place, axis, self.values)
            height = self.reported(costs[name]) if name in costs else on_line
            ax.plot(place, float(height), label=name, zorder=5, **_marker(number))
        ax.grid(alpha=0.3)

    def _draw_map(self, ax: "Axes", axes: list[np.ndarray], places: Mapping[str, Any]) -> None:
        values = self.values.T
        more = getattr(self.objective, "maximised", False)
        worst = np.nanpercentile(values, 100 - _SHADED if more else _SHADED)
        shades: dict[str, Any] = {"vmin" if more else "vmax": worst, "cmap": "cividis"}
        x, y = axes
        shown = ax.pcolormesh(x, y, values, shading="nearest", rasterized=True, **shades)
        figure: Any = ax.figure
        figure.colorbar(shown, ax=ax, label=self.label, extend="min" if more else "max")
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


def landscape_around(
    problem: DesignProblem, design: Design, count: int = 61, *, at_a_time: int = AT_A_TIME
) -> Landscape:
    """Landscape over the first two free numbers, or the only one, the others as in a design.

    Those of `drawn_variables`, by `problem.data`. `count`: points along each axis; `at_a_time`:
    points evaluated at a time.

    **Errors**: ValueError where no free number can be drawn, or its bounds leave no room.
    """
    found = landscape_if_any(problem, design, count, at_a_time=at_a_time)
    if found is None:
        raise ValueError(
            "the free numbers have no landscape: their bounds leave no room, or several exposures "
            "share the rest; free others, or widen their bounds"
        )
    return found


def landscape_if_any(
    problem: DesignProblem, design: Design, count: int, *, at_a_time: int = AT_A_TIME
) -> Landscape | None:
    """As `landscape_around`; None where there is no number to draw, or no room."""
    drawn = drawn_variables(problem.space)
    if not drawn:
        return None
    plane = DesignSpace(design, drawn, problem.space.limits)
    variables = plane.variables
    ends = (plane.lower, plane.highest(design.width))
    lower, upper = (np.asarray(end, dtype=float) for end in ends)
    spans = upper - lower
    if not np.all(spans > 0):
        return None
    given = problem.objective, plane, problem.data
    _, found = evaluate_grid(*given, count, at_a_time=at_a_time)
    place = np.linspace(0.0, 1.0, count)
    axes = tuple(low + place * span for low, span in zip(lower, spans, strict=True))
    shape = (count,) * len(variables)
    named = tuple((v.name, v.shots(design)) for v in variables)
    costs = np.asarray(found, dtype=float).reshape(shape)
    return Landscape(named, axes, costs, problem.objective)


def drawn_variables(space: DesignSpace) -> tuple[Variable, ...]:
    """The first two variables whose change leaves the others as they are.

    Not the width beside a β that a mask's pixels tie to it, and none of several exposures that
    share one with a third.
    """
    last = sorted(space.variables, key=lambda v: v.name == "width")
    exposures = sum(v.name == "exposure" for v in last)
    if exposures > 2 or exposures == 2 and len(last) > 2:
        last = [v for v in last if v.name != "exposure"]
    if space.limits.mask_pixel is not None and [v.name for v in last[:2]] == ["beta", "width"]:
        last = last[:1]
    return tuple(last[:2])


def evaluate_grid(
    objective: Objective, space: DesignSpace, data: Any, count: int, *, at_a_time: int = AT_A_TIME
) -> tuple[Float[Array, "point variable"], Float[Array, " point"]]:
    """The objective on an even grid over the cube, `count` points along each variable.

    Feasible for two or three variables; the grid's best is what a search can be checked against.

    **Errors**: ValueError for fewer than two points a side, and for more than 10 million.
    """
    if count < 2 or count**space.size > 10_000_000:
        raise ValueError(
            f"a grid of {count}^{space.size} points; give 2 or more a side and at most 10 million"
        )
    axis = jnp.linspace(0.0, 1.0, count, dtype=space.lower.dtype)
    mesh = jnp.meshgrid(*[axis] * space.size, indexing="ij")
    points = jnp.stack([m.ravel() for m in mesh], axis=-1)
    return points, evaluate(objective, space, data, points, at_a_time=at_a_time)
