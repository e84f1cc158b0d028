"""Figures of numbers: a solver's history, objectives, fronts of designs and their tolerances."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from thincam_jax._core.arguments import checked
from thincam_jax._core.checks import numbers
from thincam_jax.plot.frame import Figure, new_figure
from thincam_jax.reconstruction.result import Reconstruction

# The figures of reconstructions wait for no design.
if TYPE_CHECKING:
    from thincam_jax.design.fronts import FrontPoint
    from thincam_jax.design.sensitivity import Sensitivity


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
