"""The figures of a design: the objective's landscape, responses, contrast transfer and fronts."""

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.ticker import FixedLocator, NullLocator

from thincam_jax._core.grids import Grid
from thincam_jax.design.training_search import TrainingError
from thincam_jax.plot.frame import drawing, line_style, show_image
from thincam_jax.plot.objectives import draw_landscape

if TYPE_CHECKING:
    from thincam_jax.design.cell_search import CellDesign
    from thincam_jax.design.design import Shot
    from thincam_jax.design.landscape import Landscape
    from thincam_jax.design.ranking import ModulationTransfer, RankedDesign
    from thincam_jax.studies.design import FoundDesigns
    from thincam_jax.studies.design_scores import FrontScores, FrontsScores, PointScores
    from thincam_jax.studies.study import Study

_LEAST_CONTRAST = 1e-5
_FLOOR_DB = -30.0  # what is further below the noise is not drawn
_FAINTEST_DB = -50.0  # of a PSF
_FACE = {True: "white", False: "black"}  # of points that are dominated, and of the front's
_MARKER: dict[str, Any] = {
    "markersize": 8,
    "markeredgewidth": 1.3,
    "linestyle": "none",
    "zorder": 4,
}
_LABELS = {
    "thickness": "thickness: longest distance allowed (mm)",
    "captures": "captures",
    "light": "light: electrons from each mm² of open aperture",
}
_MASK_SAMPLES = 600  # along a side of a drawn mask


def draw_masks(study: "Study", best: str) -> Figure:
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


def draw_cells(found: "CellDesign", psfs: np.ndarray, pitch: float) -> Figure:
    """Masks of cells, the middle of those that are dark around it, and PSFs, a row a capture.

    - `psfs`: (capture, y, x), of samples of a `pitch`, mm.
    """
    cell, phases = float(found.space.cell), "phase" in found.space.levels
    masks = [np.asarray(mask.amplitude) for mask in found.masks]
    half = max(_reach(np.abs(mask) ** 2, cell) for mask in masks)
    middle = half < 0.35 * found.space.count * cell
    columns = 3 if middle else 2
    figure, rows = drawing((3.8 * columns, 3.2 * len(masks)), len(masks), columns, squeeze=False)
    for number, (axes, mask, psf) in enumerate(zip(rows, masks, psfs, strict=True), 1):
        name = f" {number}" if len(masks) > 1 else ""
        shown = np.angle(mask) % (2 * np.pi) if phases else np.abs(mask)
        most, label = (2 * np.pi, "phase (rad)") if phases else (1.0, "amplitude transmittance")
        style: dict[str, Any] = {"vmin": 0, "vmax": most, "interpolation": "nearest"}
        drawn = [show_image(ax, shown, cell, **style) for ax in axes[:-1]]
        axes[0].set_title(f"mask{name}", fontsize=10)
        if middle:
            axes[1].set(xlim=(-half, half), ylim=(half, -half))
            axes[1].set_title("its middle", fontsize=10)
        elif found.space.levels != "binary":
            figure.colorbar(drawn[0], ax=axes[0], label=label)
        near = _reach(psf, pitch)
        level = 10 * np.log10(np.maximum(psf / psf.max(), 1e-9))
        light = show_image(axes[-1], level, pitch, vmin=_FAINTEST_DB, vmax=0)
        axes[-1].set(xlim=(-near, near), ylim=(near, -near))
        axes[-1].set_title(f"PSF{name}", fontsize=10)
        figure.colorbar(light, ax=axes[-1], label="irradiance (dB of its maximum)")
    return figure


def _reach(light: np.ndarray, pitch: float) -> float:
    """Half a side, mm, of a centred square that holds 95 % of the light, with a margin."""
    places = np.abs(np.arange(len(light)) - (len(light) - 1) / 2)
    ring = np.maximum(places[:, None], places).astype(int)
    within = np.cumsum(np.bincount(ring.ravel(), np.ravel(light)))
    number = int(np.searchsorted(within, 0.95 * within[-1]))
    return min(2.0 * (number + 1), len(light) / 2) * pitch


def draw_objective(
    result: "FoundDesigns", count: int, figure: Figure | None = None
) -> Figure | None:
    """The objective over the free numbers, with the reference and the first `count` found.

    None where the search's bounds leave no room to draw.
    """
    designs = (result.reference, *result.found[:count])
    costs = [(one, one.searched, one.exact) for one in designs]
    return _marked(result.landscape, result.objective.unit, costs, figure)


def draw_training(result: "FoundDesigns", count: int) -> Figure | None:
    """The training error over the free numbers, with designs; None without training."""
    if result.training is None:
        return None
    designs = (result.reference, *result.found[:count])
    costs = [(one, one.trained or 0.0, one.trained or 0.0) for one in designs]
    return _marked(result.training.landscape, TrainingError.unit, costs)


def _marked(
    landscape: "Landscape | None",
    unit: str,
    costs: "list[tuple[RankedDesign, float, float]]",
    figure: Figure | None = None,
) -> Figure | None:
    """Figure with designs, each with the cost where it is drawn, and that of the legend."""
    if landscape is None:
        return None
    names = [f"{one.name} ({float(landscape.reported(c)):.2f} {unit})" for one, _, c in costs]
    designs = {name: one.design for name, (one, _, _) in zip(names, costs, strict=True)}
    drawn = {name: cost for name, (_, cost, _) in zip(names, costs, strict=True)}
    drawn_on, ax = drawing((7.6, 6.0), figure=figure)
    draw_landscape(landscape, ax, designs, drawn)
    return drawn_on


def draw_responses(result: "FoundDesigns", count: int, pitch: float) -> Figure:
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


def draw_mtf(result: "FoundDesigns", object_distance: float) -> Figure | None:
    """Contrast transfer of the reference and of the best design side by side, on common axes.

    `object_distance` in mm. None for a result without transfers.
    """
    if not result.transfers:
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


def _draw_transfer(
    ax: Axes, one: "RankedDesign", transfer: "ModulationTransfer", edge: float
) -> None:
    frequency = (np.arange(len(transfer.chain)) + 0.5) / len(transfer.chain) * edge
    chain = {"color": "black", "linewidth": 2.2, "label": "camera and reconstruction"}
    ax.plot(frequency, transfer.chain, **chain)
    phases = one.design.phases
    for number, (level, sums) in enumerate(zip(transfer.channels, transfer.sums, strict=True)):
        style = line_style(number) | {"markersize": 4, "markevery": (2 * number, 8)}
        shot = one.shots[(sums[0][0] - 1) // phases]
        ax.plot(frequency, level, linewidth=1.2, label=_sum_label(shot, sums), **style)
    ax.set(yscale="log", xlim=(0, edge), ylim=(_LEAST_CONTRAST, 1.5))
    ax.grid(alpha=0.3)
    ax.set_title(one.name, fontsize=11)
    ax.legend(fontsize=9, loc="upper center", bbox_to_anchor=(0.5, -0.13), frameon=False)


def _sum_label(shot: "Shot", sums: tuple[tuple[int, ...], tuple[int, ...]]) -> str:
    """Label of a sum of captures: "captures 1 − 2: β 25 rad/mm² at 6.5 mm"."""
    added, taken = (" + ".join(str(n) for n in part) for part in sums)
    formula = f"{added} − {taken.replace('+', '−')}" if taken else added
    return f"captures {formula}: β {shot.beta:.4g} rad/mm² at {shot.distance:.3g} mm"


def _at(distance: float) -> tuple[Callable, Callable]:
    """Conversions of angular frequencies to those on a plane at a distance, and back."""
    return lambda nu: np.asarray(nu) / distance, lambda u: np.asarray(u) * distance


def _decibel(level: np.ndarray) -> np.ndarray:
    """NaN, which is not drawn, below the floor."""
    return 10 * np.log10(np.where(level > 10 ** (_FLOOR_DB / 10), level, np.nan))


def draw_fronts(scores: "FrontsScores", reference: str, object_distance: float) -> Figure:
    """A panel for each front; `object_distance` in mm, `reference`: name of the design to beat."""
    count = len(scores.fronts)
    drawn, panels = drawing((4.2 * count + 0.6, 4.9), 1, count, squeeze=False)
    drawn.set_layout_engine(ConstrainedLayoutEngine(wspace=0.06))
    for ax, (name, front) in zip(panels[0], scores.fronts.items(), strict=True):
        ax.set_xlabel(_LABELS[name])
        ax.grid(alpha=0.3)
        if name == "captures":
            _draw_captures(ax, front, reference)
        else:
            _draw_resolution(ax, front, reference)
            right = ax.secondary_yaxis("right", functions=_at(object_distance))
            right.set_ylabel("on the object (line pairs/mm)")
        if name == "light":
            ax.set_xscale("log")
        ax.margins(0.08, 0.1)
        ax.legend(fontsize=9, loc="upper center", bbox_to_anchor=(0.5, -0.14), frameon=False)
    return drawn


def _draw_resolution(ax: Axes, front: "FrontScores", reference: str) -> None:
    value, points = "resolution_cycles_per_rad", front.points
    _steps(ax, points, value, "dominated", "-")
    groups = [
        (False, False, "on the front"),
        (True, False, "dominated by one of lower cost"),
        (False, True, "on the front; at least, where frequencies end"),
        (True, True, "dominated; at least, where frequencies end"),
    ]
    for beaten, ended, label in groups:
        chosen = [p for p in points if (p.dominated, bool(p.resolution_ends)) == (beaten, ended)]
        shape = "^" if ended else "o"
        _marks(ax, chosen, value, label, marker=shape, markerfacecolor=_FACE[beaten])
    _mark_reference(ax, front.reference, value, reference)
    ax.set_ylabel("limit of resolution (cycles/rad)")


def _draw_captures(ax: Axes, front: "FrontScores", reference: str) -> None:
    points = front.points
    known = [p for p in points if p.simulated_mean_db is not None]
    lines = [
        (points, "predicted_psnr_db", "dominated", "predicted", "-", "o", "black"),
        (known, "simulated_mean_db", "simulated_dominated", "simulated", "--", "s", "#8a8a8a"),
    ]
    for chosen, value, flag, label, dash, shape, colour in lines:
        _steps(ax, chosen, value, flag, dash)
        for beaten, name in ((False, label), (True, f"{label}; dominated")):
            group = [p for p in chosen if getattr(p, flag) == beaten]
            face = "white" if beaten else colour
            _marks(ax, group, value, name, marker=shape, markerfacecolor=face)
    _mark_reference(ax, front.reference, "predicted_psnr_db", f"{reference}, predicted")
    ax.xaxis.set_major_locator(FixedLocator(sorted({p.cost for p in points})))
    ax.xaxis.set_minor_locator(NullLocator())
    ax.set_ylabel("PSNR, mean over the pictures (dB)")


def _marks(ax: Axes, points: "Sequence[PointScores]", value: str, label: str, **style: Any) -> None:
    if points:
        places = ([p.cost for p in points], [getattr(p, value) for p in points])
        ax.plot(*places, label=label, markeredgecolor="black", **(_MARKER | style))


def _mark_reference(ax: Axes, point: "PointScores", value: str, name: str) -> None:
    style = _MARKER | {"marker": "X", "markersize": 11, "zorder": 5}
    style |= {"color": "#606060", "markeredgecolor": "white"}
    ax.plot(point.cost, getattr(point, value), label=name, **style)


def _steps(ax: Axes, points: "Sequence[PointScores]", value: str, flag: str, dash: str) -> None:
    """Draw the best value reached up to each cost."""
    front = sorted((p.cost, getattr(p, value)) for p in points if not getattr(p, flag))
    if not front:
        return
    # On to the last of all points, which may be dominated.
    front.append((max(p.cost for p in points), front[-1][1]))
    ax.step(*np.transpose(front), where="post", color="black", linewidth=1.1, linestyle=dash)
