"""Figures of a refocusing study: the sweep, focus curves, depth map, and all methods."""

import io
from collections.abc import Mapping
from types import MappingProxyType
from typing import TYPE_CHECKING

import numpy as np
import PIL.Image
import PIL.ImageDraw
import PIL.ImageFont
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from thincam_jax.imaging.targets import middle_square
from thincam_jax.plot.frame import drawing, grey_levels, line_style, sheet, white_level

if TYPE_CHECKING:
    from thincam_jax.reconstruction.depth.find import DepthMap
    from thincam_jax.reconstruction.depth.refocus import RefocusSweep
    from thincam_jax.studies.refocus import PlacedTarget, RefocusResult
    from thincam_jax.studies.study import Method

_SHOWN = 15  # images on the contact sheet, in rows of five
_HELD = 160  # ms of an image of the animation
_SURE = 0.25  # confidence from which the depth map shows a distance
_MEASURED = {
    "laplacian_variance": "variance of the Laplacian",
    "gradient_energy": "energy of the gradient",
    "gradient_sparsity": "sparsity of the gradient",
}


def draw_sweep(sweep: "RefocusSweep", places: Mapping[str, float] = MappingProxyType({})) -> Figure:
    """Contact sheet of the sweep, each image with the distance it is focused on.

    `places`: distances of objects, mm, whose nearest images are titled in bold.
    """
    images, distances = np.asarray(sweep.images), np.asarray(sweep.distances)
    white = white_level(images)
    nearest = {int(np.argmin(np.abs(distances - t))): name for name, t in places.items()}
    picked = _spread(len(distances), _SHOWN, list(nearest))
    figure, axes = sheet(len(picked), 5, 2.2, images.shape[-2] / images.shape[-1], 0.35)
    for ax, index in zip(axes, picked, strict=True):
        ax.imshow(grey_levels(images[index], white), cmap="gray", vmin=0, vmax=1)
        name = nearest.get(index)
        text = f"{distances[index]:.4g} mm" + (f" – {name}" if name else "")
        ax.set_title(text, fontsize=10, fontweight="bold" if name else "normal")
    return figure


def _spread(count: int, most: int, wanted: list[int]) -> list[int]:
    """At most `most` of `count` places, evenly spread but with those wanted among them."""
    picked = {int(p) for p in np.linspace(0, count - 1, min(most, count)).round()}
    for place in wanted:
        free = picked - set(wanted)
        if place not in picked and free:
            picked.remove(min(free, key=lambda p: (abs(p - place), p)))
            picked.add(place)
    return sorted(picked)


def animate_sweep(sweep: "RefocusSweep") -> bytes:
    """The sweep there and back as an animated WebP, the distance written below."""
    images, distances = np.asarray(sweep.images), np.asarray(sweep.distances)
    white = white_level(images)
    frames = [_frame(grey_levels(i, white), t) for i, t in zip(images, distances, strict=True)]
    frames += frames[-2:0:-1]
    buffer = io.BytesIO()
    frames[0].save(
        buffer,
        format="WEBP",
        save_all=True,
        append_images=frames[1:],
        duration=_HELD,
        loop=0,
        quality=70,
    )
    return buffer.getvalue()


def _frame(image: np.ndarray, distance: float) -> PIL.Image.Image:
    rows, columns = image.shape
    frame = PIL.Image.new("L", (columns, rows + 24), 255)
    frame.paste(PIL.Image.fromarray((image * 255).round().astype(np.uint8)), (0, 0))
    font = PIL.ImageFont.load_default(15)
    PIL.ImageDraw.Draw(frame).text(
        (columns / 2, rows + 12), f"focus at {distance:.0f} mm", fill=0, font=font, anchor="mm"
    )
    return frame


def draw_curves(result: "RefocusResult") -> Figure:
    """Focus measure of each object over the sweep, with where it stands and where it was found."""
    figure, ax = drawing((8.5, 4.0))
    distances = np.asarray(result.sweep.distances)
    for index, (name, scores) in enumerate(result.objects.items()):
        curve, style = result.found.curve(name), line_style(index + 2)
        if curve is not None:
            label = name
            if scores.found_mm is not None:
                label += f": found at {scores.found_mm:.1f} mm ({scores.error_percent:+.1f} %)"
            ax.plot(distances, curve / curve.max(), label=label, markersize=4, **style)
        ax.axvline(scores.distance_mm, color=style["color"], linestyle=style["linestyle"])
        ax.text(scores.distance_mm, 1.1, f" placed at {scores.distance_mm:g} mm", fontsize=9)
    measured = f"{_MEASURED[result.refocusing.sweep.measure]},\nrelative to its largest"
    ax.set(ylim=(0, 1.18), xlabel="focused on the distance t (mm)", ylabel=measured)
    ax.grid(alpha=0.3)
    figure.legend(fontsize=9, loc="outside upper center", ncols=2)
    return figure


def draw_depth(sweep: "RefocusSweep", depth: "DepthMap", sharp: np.ndarray) -> Figure:
    """Depth map, its confidence, and the picture that is sharp everywhere.

    Over directions; over pixels where measured PSFs do not tell these.
    """
    confidence, distance = np.asarray(depth.confidence), np.asarray(depth.distance)
    white = white_level(np.asarray(sweep.images))
    rows, columns = sharp.shape
    slope, names = 1.0, ("x (pixels)", "y (pixels)")
    if sweep.slope is not None:
        slope, names = float(sweep.slope), ("direction x/t", "direction y/t")
    extent = (-columns / 2 * slope, columns / 2 * slope, rows / 2 * slope, -rows / 2 * slope)
    figure, axes = drawing((12, 3.4 * rows / columns * 1.15 + 1.5), 1, 3, sharey=True)
    shown = np.ma.masked_where(confidence < _SURE, distance)
    span = (float(sweep.distances[0]), float(sweep.distances[-1]))
    panels = [
        (shown, "viridis", span, "t (mm)", f"depth map (grey: confidence below {_SURE})"),
        (confidence, "gray", (0, 1), "confidence", "confidence"),
        (sharp, "gray", (0, white), "radiance", "all in focus"),
    ]
    for ax, (image, cmap, (low, high), label, title) in zip(axes, panels, strict=True):
        drawn = ax.imshow(image, cmap=cmap, vmin=low, vmax=high, extent=extent)
        figure.colorbar(drawn, ax=ax, label=label, location="bottom", aspect=30)
        ax.set_title(title, fontsize=10)
        ax.set_xlabel(names[0])
    axes[0].set(facecolor="0.85", ylabel=names[1])
    return figure


def draw_methods(result: "RefocusResult", figure: Figure | None = None) -> Figure:
    """Every method focused on every object; below each, the objects enlarged."""
    methods, objects = result.refocusing.study.methods, result.refocusing.objects
    aspect = max(p.shape[0] / p.shape[1] for p in result.images.values())
    width = 3.1
    # A row of whole pictures and one of details for each focus.
    heights = [width * aspect, width / len(objects)] * len(objects)
    size = (width * len(methods), sum(heights) + 0.42 * len(objects))
    how = {"squeeze": False, "gridspec_kw": {"height_ratios": heights}}
    figure, axes = drawing(size, 2 * len(objects), len(methods), figure=figure, **how)
    for column, method in enumerate(methods):
        for row, focused in enumerate(objects):
            image = result.images[method.name, focused.distance]
            distance = f"{focused.distance:g}"
            whole, detail = axes[2 * row, column], axes[2 * row + 1, column]
            whole.imshow(grey_levels(image, white_level(image)), cmap="gray", vmin=0, vmax=1)
            _frame_objects(whole, result, method, focused)
            title = f"focused on {distance} mm"
            whole.set_title(f"{method.name}\n{title}" if row == 0 else title, fontsize=10)
            _show_details(detail, result, method, focused)
            score = result.methods[method.name].focused_on_mm[distance].psnr_db[focused.name]
            sharp = "exact" if score is None else f"{score:.1f} dB"
            detail.set_xlabel(f"in focus: {focused.name}, {sharp}", fontsize=9)
    assert figure is not None
    return figure


def _frame_objects(ax, result: "RefocusResult", method: "Method", focused: "PlacedTarget") -> None:
    """The object in focus in a solid box, the others in dashed ones."""
    ax.set(xticks=[], yticks=[])
    for placed in result.refocusing.objects:
        rows, columns = result.refocusing.object_box(method, placed)
        corner = (columns.start - 4, rows.start - 4)
        sides = (columns.stop - columns.start + 7, rows.stop - rows.start + 7)
        dash = "-" if placed is focused else (0, (2, 3))
        frame = Rectangle(corner, *sides, fill=False, edgecolor="white", linewidth=1.2)
        frame.set_linestyle(dash)
        ax.add_patch(frame)


def _show_details(ax, result: "RefocusResult", method: "Method", focused: "PlacedTarget") -> None:
    """The middle of each object, enlarged, side by side; a frame round that in focus."""
    image, objects = result.images[method.name, focused.distance], result.refocusing.objects
    white = white_level(image)
    for index, placed in enumerate(objects):
        rows, columns = result.refocusing.object_box(method, placed)
        part = image[rows, columns]
        part = grey_levels(middle_square(part, round(0.6 * min(part.shape))), white)
        left = index + 0.02
        ax.imshow(part, cmap="gray", vmin=0, vmax=1, extent=(left, left + 0.96, 0.98, 0.02))
        if placed is focused:
            frame = Rectangle((left, 0.02), 0.96, 0.96, fill=False, color="black", linewidth=2)
            ax.add_patch(frame)
    ax.set(xlim=(0, len(objects)), ylim=(1, 0), aspect="equal", xticks=[], yticks=[])
    ax.spines[:].set_visible(False)
