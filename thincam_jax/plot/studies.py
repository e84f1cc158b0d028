"""The figures of a study: reconstructions, captures, transfer functions and contrast."""

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.figure import Figure

from thincam_jax.imaging.encoding import as_picture
from thincam_jax.imaging.metrics.mtf import low_frequency_value
from thincam_jax.imaging.targets import middle_square
from thincam_jax.plot.cameras import draw_psf as draw_camera_psf
from thincam_jax.plot.frame import drawing, line_style, sheet

if TYPE_CHECKING:
    from thincam_jax.lensless.exposures import Exposure
    from thincam_jax.studies.evaluate import Capture, Contrasts, Evaluation
    from thincam_jax.studies.result import Response
    from thincam_jax.studies.study import Study, Target


def truth_of(evaluations: "Mapping[str, Evaluation]") -> np.ndarray:
    """The scene on the pixels of the last method."""
    return list(evaluations.values())[-1].truth


def draw_found(
    target: "Target", evaluations: "Mapping[str, Evaluation]", *, figure: Figure | None = None
) -> Figure:
    """A target's scene and its reconstructions, whole and enlarged."""
    truth = truth_of(evaluations)
    panels = [("scene", truth, "")]
    panels += [
        (name, one.image, one.scores.words.replace("; ", "\n")) for name, one in evaluations.items()
    ]
    aspect = truth.shape[0] / truth.shape[1]
    drawn, wholes, details = _pairs_of_axes(len(panels), aspect, figure)
    axes = zip(wholes, details, panels, strict=True)
    for ax, detail, (name, light, caption) in axes:
        image = target.shown(light)
        _show(ax, image, f"{name}\n{caption}" if caption else name)
        part, label = enlarged_part(image, target)
        _show(detail, part, "")
        detail.set_xlabel(label, fontsize=9)
    return drawn


def draw_captures(study: "Study", captures: "Mapping[Exposure, Capture]") -> Figure:
    """All captures of a target, each from black to its own maximum."""
    aspect = study.sensor.shape[0] / study.sensor.shape[1]
    figure, axes = sheet(len(captures), _BESIDE, 2.2, aspect, 0.9)
    for number, (ax, exposure) in enumerate(zip(axes, study.exposures, strict=True), 1):
        image = captures[exposure].image
        image = image[(..., *[slice(None, None, 1 + n // 512) for n in image.shape[-2:]])]
        title = f"{number}: {study.mask_of(exposure)},\n"
        _show(ax, as_picture(image / image.max()), f"{title}d {exposure.distance:.3g} mm")
    return figure


# More beside each other are too small to be read on a page.
_BESIDE = 6


def _pairs_of_axes(count: int, aspect: float, figure: Figure | None = None) -> Any:
    """A figure with `count` places for a picture and, below each, its detail."""
    bands = math.ceil(count / _BESIDE)
    columns = math.ceil(count / bands)
    size = (2.75 * columns, bands * (2.75 * (aspect + 1) + 1.25))
    ratios = {"height_ratios": (aspect, 1) * bands}
    figure, axes = drawing(size, 2 * bands, columns, figure=figure, gridspec_kw=ratios)
    wholes, details = axes[::2].ravel(), axes[1::2].ravel()
    for ax in axes.ravel():
        ax.set(xticks=[], yticks=[])
    for ax in (*wholes[count:], *details[count:]):
        ax.set_axis_off()
    return figure, wholes[:count], details[:count]


def _show(ax, image: np.ndarray, title: str) -> None:
    ax.imshow(np.clip(image, 0, 1), cmap="gray", vmin=0, vmax=1, interpolation="nearest")
    if title:
        ax.set_title(title, fontsize=9)


# The second layer of the USAF chart, with the finer ones inside: place of its centre down and right
# of the chart's, and its side, as parts of the chart (see `thincam_jax.imaging.targets.usaf`).
_FINE = (-2.5 / 32, 2.25 / 32, 8 / 32)


def enlarged_part(image: np.ndarray, target: "Target") -> tuple[np.ndarray, str]:
    """The part of a picture that is enlarged, and what it is."""
    if target.kind != "usaf1951":
        return _middle(image), f"middle {target.width / 3:.0f} mm"
    down, right, part = _FINE
    side = min(image.shape[:2])
    half = max(1, round(side * part / 2))
    row, column = (
        round(n / 2 + side * s) for n, s in zip(image.shape, (down, right), strict=False)
    )
    fine = image[row - half : row + half, column - half : column + half]
    return fine, f"fine groups, {target.width * part:.0f} mm"


def _middle(image: np.ndarray) -> np.ndarray:
    """The central square whose side is a third of the width."""
    rows, columns = image.shape[:2]
    return middle_square(image, 2 * min(columns // 6, rows // 2))


def draw_responses(
    study: "Study", responses: "Mapping[str, Response]", figure: Figure | None = None
) -> Figure:
    """Transfer functions of all methods, from 0 to 1; methods of one synthesis share a panel.

    With their limits and those that are published, to a seventh beyond the highest of the panel,
    whose title says how far a curve goes above 1, and where.
    """
    published = {m.name: m.published.limit_cycles_per_mm for m in study.methods}
    nyquist = 0.5 / study.pitch
    panels = _by_synthesis(study, responses)
    size = (8.5, 2.3 * len(panels) + 0.8)
    drawn, axes = drawing(size, len(panels), 1, figure=figure)
    axes = np.atleast_1d(axes)
    for index, (ax, (name, response)) in enumerate(zip(axes, panels, strict=True)):
        limits = response.limits
        zero, cut = limits.first_zero_cycles_per_mm, limits.cut_off_cycles_per_mm
        stated = {limit for own in name.split("; ") if (limit := published.get(own))}
        end = 1.15 * max(cut, 0, *stated) or 1.08 * nyquist
        u, levels = response.frequency[1:], response.magnitude[1:]
        levels = levels / low_frequency_value(response.frequency, response.magnitude)
        ax.plot(u, levels, linewidth=1.1, **line_style(index) | {"marker": "", "linestyle": "-"})
        ax.axvspan(min(nyquist, end), end, color="#d8d8d8", linewidth=0)
        marks = [("first zero", zero, ":"), ("cut-off", cut, "--")]
        marks += [("Nyquist", nyquist, "-")] if nyquist < end else []
        marks += [("published limit", limit, "-.") for limit in sorted(stated)]
        for what, at, dash in marks:
            if at is not None:
                label = f"{what} {at:.1f}"
                ax.axvline(at, color="black", linestyle=dash, linewidth=1, label=label)
        ax.legend(fontsize=8, loc="upper left", bbox_to_anchor=(1, 1), frameon=False)
        ax.set(xlim=(0, end), ylim=(0, 1.05), ylabel="relative MTF")
        top = np.argmax(np.where(u < end, levels, 0))
        above = f", up to {levels[top]:.2f} at {u[top]:.1f}" if levels[top] > 1.05 else ""
        ax.set_title(f"{name}{above}", fontsize=10, loc="left")
    axes[-1].set_xlabel("spatial frequency u on the reference sensor plane (cycles/mm), v = 0")
    return drawn


def _by_synthesis(
    study: "Study", responses: "Mapping[str, Response]"
) -> "list[tuple[str, Response]]":
    """Titles and responses: the methods that take the same captures and sums of them as one."""
    names: dict[tuple, list[str]] = {}
    for method in study.methods:
        sums = tuple(method.exposures), method.synthesis, method.harmonics
        names.setdefault(sums, []).append(method.name)
    return [("; ".join(group), responses[group[0]]) for group in names.values()]


def draw_contrasts(contrasts: "Mapping[str, Contrasts]") -> Figure:
    """Contrast of every chart element against its period, for each method."""
    figure, ax = drawing((8.5, 4.2))
    for index, (name, records) in enumerate(contrasts.items()):
        periods = sorted({period for period, _, _ in records}, reverse=True)
        worst = [min(c for p, _, c in records if p == period) for period in periods]
        ax.plot(periods, worst, label=name, markersize=4, linewidth=1.2, **line_style(index))
    ax.axhline(0, color="black", linewidth=0.8)
    ax.set_xscale("log")
    ax.invert_xaxis()
    ticks = [10, 5, 2, 1, 0.5, 0.2]
    ax.set_xticks(ticks, [f"{t:g}" for t in ticks])
    ax.minorticks_off()
    contrast = "contrast of the three bars,\nworse direction"
    ax.set(ylim=(-1.05, 1.1), xlabel="line pair on the object (mm)", ylabel=contrast)
    ax.legend(fontsize=9, loc="lower left")
    ax.grid(alpha=0.3)
    return figure


def draw_psf(study: "Study") -> Figure:
    """PSF of the first exposure: the image, and a line through its middle."""
    exposure = study.exposures[0]
    figure, title = Figure(figsize=(8.5, 3.4), layout="constrained"), study.mask_of(exposure)
    grid, h = study.camera(exposure).sensor.grid, np.asarray(study.psf(exposure))
    draw_camera_psf(figure, h, grid, f"{title}, d = {exposure.distance:g} mm")
    return figure
