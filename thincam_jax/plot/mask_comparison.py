"""The figures of a comparison of masks: errors against light, and a contact sheet."""

import numpy as np
from matplotlib.figure import Figure

from thincam_jax.imaging.metrics.image import align
from thincam_jax.plot.frame import drawing
from thincam_jax.studies.mask_comparison import MaskComparisonResult

# Dash and grey tell the sort of a mask, and the marker which it is: read without colours.
_SORTS = (
    ("-", "#000000"),
    ("--", "#404040"),
    (":", "#606060"),
    ("-.", "#808080"),
    ("-", "#b0b0b0"),
)
_MARKERS = "osD^v<>*XPphd"


def draw_error(result: MaskComparisonResult, figure: Figure) -> Figure:
    """Root mean square error against light, a line for each mask and a panel for each scene."""
    comparison = result.comparison
    panels = figure.subplots(1, len(comparison.scenes), squeeze=False)[0]
    light = comparison.light
    sorts = list(dict.fromkeys(one.sort for one in comparison.masks.values()))
    for ax, scene in zip(panels, comparison.scenes, strict=True):
        for number, (name, mask) in enumerate(comparison.masks.items()):
            dash, grey = _SORTS[sorts.index(mask.sort) % len(_SORTS)]
            scores = (result.scores[result.case(name, scene, at)][0] for at in light)
            ax.loglog(
                light,
                [10 ** (-score / 20) for score in scores],
                label=name,
                color=grey,
                linestyle=dash,
                marker=_MARKERS[number % len(_MARKERS)],
                markersize=5,
                linewidth=1.2,
                markerfacecolor="white" if len(mask.masks) > 1 else grey,
            )
        ax.set_title(scene, fontsize=10)
        ax.set_xlabel("electrons a pixel of the bare sensor")
        ax.grid(alpha=0.3, which="both")
    panels[0].set_ylabel("root mean square error (white = 1)")
    handles, labels = panels[0].get_legend_handles_labels()
    # The worst first, as the lines are at the left.
    order = np.argsort([result.mean(name) for name in labels])
    figure.legend(
        [handles[n] for n in order],
        [labels[n] for n in order],
        loc="outside right upper",
        fontsize=8,
    )
    return figure


def draw_images(result: MaskComparisonResult, figure: Figure) -> Figure:
    """A row for each mask: the mask, its PSF, and scenes at several lights, colours, distances."""
    comparison, setting = result.comparison, result.comparison.setting
    first, *_ = comparison.scenes
    *weaker, strong = comparison.light
    asked = {f"{first}\n{at:,.0f}": (first, at, {}) for at in weaker}
    asked |= {f"{scene}\n{strong:,.0f}": (scene, strong, {}) for scene in comparison.scenes}
    near = f"at {comparison.object_distances[1]:g} mm"
    asked[f"{first}\n{strong:,.0f}, broadband"] = first, strong, {"colours": "broadband"}
    asked[f"{first}\n{strong:,.0f}, {near}"] = first, strong, {"near": True}
    columns, rows = 2 + len(asked), len(comparison.masks)
    size = 1.5 * columns, 1.62 * rows + 0.5
    _, axes = drawing(size, rows, columns, figure=figure, squeeze=False)
    grid = setting.sensor.grid
    for row, (name, compared) in zip(axes, comparison.masks.items(), strict=True):
        mask, h = compared.masks[0], np.asarray(result.psfs[name][0])
        t = np.asarray(mask.sample(grid, comparison.wavelength))
        shown = np.where(np.abs(t) > 0.5, np.angle(t), -np.pi) if mask.pure_phase else np.abs(t)
        row[0].imshow(shown, cmap="gray")
        down, right = ((a - b) // 2 for a, b in zip(h.shape, grid.shape, strict=True))
        seen = h[down : down + grid.shape[0], right : right + grid.shape[1]]
        row[1].imshow(seen, cmap="gray", vmin=0, vmax=np.quantile(seen, 0.998))
        row[0].set_ylabel(name, fontsize=8)
        for ax, (scene, electrons, other) in zip(row[2:], asked.values(), strict=True):
            case, truth = (
                result.case(name, scene, electrons, **other),
                comparison.scenes[scene].image,
            )
            ax.imshow(align(result.images[case], truth)[0], cmap="gray", vmin=0, vmax=truth.max())
            ax.set_xlabel(f"{result.scores[case][0]:.1f} dB", fontsize=8, labelpad=1)
    for ax, title in zip(axes[0], ("mask", "PSF", *asked), strict=True):
        ax.set_title(title, fontsize=8)
    for ax in axes.ravel():
        ax.set(xticks=[], yticks=[])
    return figure
