"""The pictures of a comparison of masks, as PNG files in its folder."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from thincam_jax.commands.masks.build import Setup
from thincam_jax.commands.masks.words import Case, Results
from thincam_jax.commands.run_folder import RunFolder
from thincam_jax.commands.study.figures import drawing, save_figure
from thincam_jax.imaging.metrics.image import align

# Dash and grey tell the sort of a mask, and the marker which it is: read without colours.
_SORTS = {
    **dict.fromkeys(("lenslets", "voronoi_fresnel"), ("-", "#000000")),
    **dict.fromkeys(("contours", "diffuser"), ("--", "#404040")),
    **dict.fromkeys(("mura", "ura", "mls", "random", "file"), (":", "#606060")),
    "fza": ("-.", "#808080"),
    "pinhole": ("-", "#b0b0b0"),
}
_MARKERS = "osD^v<>*XPphd"


def save_error(folder: RunFolder, results: Results) -> None:
    """Root mean square error against light, a line for each mask and a panel for each scene."""
    figure = Figure(figsize=(11, 4.4), layout="constrained")
    panels = figure.subplots(1, len(results.scenes), squeeze=False)[0]
    light = results.config.light
    for ax, scene in zip(panels, results.scenes, strict=True):
        for number, (name, mask) in enumerate(results.masks.items()):
            dash, grey = _SORTS[mask["family"]]
            errors = [10 ** (-results.score(name, scene, at) / 20) for at in light]
            ax.loglog(
                light,
                errors,
                label=name,
                color=grey,
                linestyle=dash,
                marker=_MARKERS[number % len(_MARKERS)],
                markersize=5,
                linewidth=1.2,
                markerfacecolor="white" if mask["captures"] > 1 else grey,
            )
        ax.set_title(scene, fontsize=10)
        ax.set_xlabel("electrons a pixel of the bare sensor")
        ax.grid(alpha=0.3, which="both")
    panels[0].set_ylabel("root mean square error (white = 1)")
    handles, labels = panels[0].get_legend_handles_labels()
    # The worst first, as the lines are at the left.
    order = np.argsort([-results.mean(name, light[-1]) for name in labels])[::-1]
    figure.legend(
        [handles[n] for n in order],
        [labels[n] for n in order],
        loc="outside right upper",
        fontsize=8,
    )
    save_figure(folder, "error", figure)


def save_sheet(
    folder: RunFolder,
    setup: Setup,
    psfs: Mapping[str, Any],
    images: dict[Case, np.ndarray],
    results: Results,
) -> None:
    """A row for each mask: the mask, its PSF, and scenes at several lights, colours, distances."""
    config, first = setup.config, results.scenes[0]
    *weaker, strong = config.light
    asked = [(first, at, {}) for at in weaker] + [(scene, strong, {}) for scene in results.scenes]
    asked.append((first, strong, {"colours": "broadband"}))
    asked.append((first, strong, {"distance": config.object_distances[1]}))
    columns, rows = 2 + len(asked), len(config.masks)
    figure, axes = drawing((1.5 * columns, 1.62 * rows + 0.5), rows, columns, squeeze=False)
    for row, entry in zip(axes, config.masks, strict=True):
        camera = setup.cameras[entry.name][0]
        grid = camera.sensor.grid
        mask, h = camera.mask, np.asarray(psfs[entry.name][0])
        t = np.asarray(mask.sample(grid, config.wavelength))
        shown = np.where(np.abs(t) > 0.5, np.angle(t), -np.pi) if mask.pure_phase else np.abs(t)
        row[0].imshow(shown, cmap="gray")
        down, right = ((a - b) // 2 for a, b in zip(h.shape, grid.shape, strict=True))
        seen = h[down : down + grid.shape[0], right : right + grid.shape[1]]
        row[1].imshow(seen, cmap="gray", vmin=0, vmax=np.quantile(seen, 0.998))
        row[0].set_ylabel(entry.name, fontsize=8)
        for ax, (scene, electrons, other) in zip(row[2:], asked, strict=True):
            case = results.case(entry.name, scene, electrons, **other)
            truth = setup.scenes[scene].image
            ax.imshow(align(images[case], truth)[0], cmap="gray", vmin=0, vmax=truth.max())
            ax.set_xlabel(f"{results.cases[case][0]:.1f} dB", fontsize=8, labelpad=1)
    titles = ["mask", "PSF", *(_title(results, *one) for one in asked)]
    for ax, title in zip(axes[0], titles, strict=True):
        ax.set_title(title, fontsize=8)
    for ax in axes.ravel():
        ax.set(xticks=[], yticks=[])
    save_figure(folder, "sheet", figure)


def _title(results: Results, scene: str, electrons: float, other: dict) -> str:
    more = {"colours": lambda _: "broadband", "distance": lambda t: f"at {t:g} mm"}
    told = [more[key](value) for key, value in other.items()]
    return f"{scene}\n{', '.join([f'{electrons:,.0f}', *told])}"
