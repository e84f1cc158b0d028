"""Landscape of an objective over one or two free numbers of a design, the others held."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from thincam_jax._core.arguments import checked
from thincam_jax._core.progress import watched
from thincam_jax.design.design import Design
from thincam_jax.design.objectives import AbstractObjective
from thincam_jax.design.problem import DesignProblem, Objective
from thincam_jax.design.search import AT_A_TIME, evaluate
from thincam_jax.design.space import REPORTED, DesignSpace, Variable

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


@dataclass(frozen=True, eq=False)
class Landscape:
    """An objective over one or two free numbers, the others as in one design.

    - `variables`: their names and shots (none for the width); `axes`: their values, in the
      package's units.
    - `costs`: (n,) or (n, n), the first variable along the first axis; NaN where there is none.
    - `objective`: objective of the costs.
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
        """Place of a design on the axes, in the units of the plot."""
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
        - `costs`: heights at which designs are drawn over a single number; by default on the line.
        - `ax`: to draw in; by default of a new figure of pyplot, which a notebook shows.
        """
        from thincam_jax.plot.frame import new_figure
        from thincam_jax.plot.objectives import draw_landscape

        ax = new_figure(7.6, 6.0).subplots() if ax is None else ax
        draw_landscape(self, ax, designs or {}, costs or {})
        figure: Any = ax.figure
        return figure


@checked
@watched("computing the landscape")
def landscape_around(
    problem: DesignProblem, design: Design, *, count: int = 61, at_a_time: int = AT_A_TIME
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
    """Landscape by `landscape_around`; None where there is no number to draw, or no room."""
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


@checked
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
