"""The figure and the table of costs of `benchmarks/accuracy.py`, from its accuracy.json.

    python benchmarks/draw_accuracy.py runs/NAME-accuracy/accuracy.json

prints what errors do to captures and reconstructions, and draws accuracy.png beside the file:
errors against times, and what an error costs.
"""

import json
import sys
from pathlib import Path
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

# Models are told apart by marker, precisions by filling, sizes by grey.
_MARKERS = {
    ("geometric", None): "v",
    ("paraxial", None): "s",
    ("closed_form", None): "D",
    ("separable", None): "o",
    ("angular_spectrum", 1): "<",
    ("angular_spectrum", 3): "^",
    ("rayleigh_sommerfeld", 1): "P",
    ("rayleigh_sommerfeld", 3): "X",
}
_GREYS = ("#000000", "#8a8a8a", "#c4c4c4")
_WRONG: dict[str, dict[str, Any]] = {
    "beta": {"linestyle": "-", "marker": "x", "label": "wrong β"},
    "distance": {"linestyle": "--", "marker": "+", "label": "wrong d"},
}
_WORST = 3.0  # relative errors above this are written, not drawn
_LINEAR_DB = 0.01  # losses below this are drawn to a linear scale

Point = tuple[float, float]


def words(model: str) -> str:
    """A model's name as it is read."""
    return model.replace("rayleigh_s", "Rayleigh-S").replace("_", " ")


def label(model: str, precision: str, oversampling: int | None) -> str:
    """A candidate in words, such as "angular spectrum ×3, float32"."""
    samples = f" ×{oversampling}" if oversampling else ""
    return f"{words(model)}{samples}, {precision}"


def draw(results: dict[str, Any]) -> Figure:
    """Errors against times, and errors of captures and PSNR lost against the PSF's error."""
    figure = Figure(figsize=(13.5, 7.6), layout="constrained")
    panels = figure.subplot_mosaic(
        [["times", "captures"], ["times", "losses"]], width_ratios=(1.45, 1)
    )
    panels["losses"].sharex(panels["captures"])
    _draw_times(panels["times"], results)
    _draw_captures(panels["captures"], results)
    _draw_losses(panels["losses"], results)
    figure.legend(handles=_legend(results), loc="outside lower center", ncols=5, fontsize=9)
    return figure


def _draw_times(ax: Axes, results: dict[str, Any]) -> None:
    """Error against time; the candidates of each size that are worth choosing are joined."""
    run = [row for row in results["psfs"] if row["status"] == "run"]
    shown = [row for row in run if 0 < row["true_error"] <= _WORST]
    for rank, shape in enumerate(_shapes(results)):
        rows = [row for row in shown if tuple(row["shape"]) == shape]
        for row in rows:
            point = (row["seconds"], row["true_error"])
            ax.plot(*point, **_mark(row, _grey(rank)), zorder=5 - rank)
        front = sorted((r["seconds"], r["true_error"]) for r in rows if r["worth_choosing"])
        width = 1.6 if rank == 0 else 1.0
        ax.plot(*zip(*front, strict=True), "-", linewidth=width, color=_grey(rank), zorder=1)
    ax.set_xscale("log")
    ax.set_yscale("log")
    ax.margins(x=0.1, y=0.08)
    ax.set_xlabel("time of one PSF, compiled (s)")
    ax.set_ylabel("relative L2 error of the PSF over the sensor")
    ax.grid(alpha=0.25)
    for row in (row for row in run if row["true_error"] == 0):
        # Its time alone, on the frame: an error of its own is not measured.
        style = _mark(row, _grey(_shapes(results).index(tuple(row["shape"]))))
        across = ax.get_xaxis_transform()
        ax.plot(row["seconds"], 0, transform=across, clip_on=False, **style, zorder=6)
    _titles(ax, results)
    _tell_the_worst(ax, [row for row in run if row["true_error"] > _WORST])


def _shapes(results: dict[str, Any]) -> list[tuple[int, ...]]:
    """The sizes of the sensor, the largest first."""
    return sorted({tuple(row["shape"]) for row in results["psfs"]}, reverse=True)


def _tell_the_worst(ax: Axes, rows: list[dict[str, Any]]) -> None:
    lines = [
        f"{label(r['model'], r['precision'], r['oversampling'])}, {max(r['shape'])} pixels: "
        f"{r['true_error']:.1g} in {r['seconds']:.2g} s"
        for r in rows
    ]
    if lines:
        text = f"errors above {_WORST:g}, not drawn:\n" + "\n".join(lines)
        ax.text(0.985, 0.985, text, transform=ax.transAxes, ha="right", va="top", fontsize=8)
        bottom, top = ax.get_ylim()
        ax.set_ylim(bottom, top * (top / bottom) ** (0.04 * (1 + len(lines))))


def _titles(ax: Axes, results: dict[str, Any]) -> None:
    camera, device = results["settings"]["camera"], results["machine"]
    ax.set_title(
        f"{results['settings']['study']}: β = {camera['beta_rad_per_mm2']:g} rad/mm², "
        f"d = {camera['distance_mm']:g} mm, on {device['device_kind']} ({device['cores']} cores)\n"
        "joined: worth choosing, nothing measured is both faster and more accurate\n"
        "on the lower frame: the reference, separable in float64, by its time alone",
        fontsize=10,
        loc="left",
    )


def _mark(row: dict[str, Any], colour: str) -> dict[str, Any]:
    return {
        "marker": _MARKERS[row["model"], row["oversampling"]],
        "color": colour,
        "markerfacecolor": colour if row["precision"] == "float32" else "white",
        "markersize": 7,
        "linestyle": "none",
    }


def _grey(rank: int) -> str:
    return _GREYS[min(rank, len(_GREYS) - 1)]


def _legend(results: dict[str, Any]) -> list[Line2D]:
    """Of all panels."""

    def mark(text: str, **style) -> Line2D:
        return Line2D([], [], linestyle="none", markersize=7, label=text, **style)

    run = [row for row in results["psfs"] if row["status"] == "run"]
    used = {(row["model"], row["oversampling"]) for row in run}
    handles = [
        mark(words(model) + (f" ×{samples}" if samples else ""), marker=marker, color="black")
        for (model, samples), marker in _MARKERS.items()
        if (model, samples) in used
    ]
    handles.append(mark("filled: float32", marker="o", color="black"))
    handles.append(mark("open: float64", marker="o", color="black", markerfacecolor="white"))
    for rank, (rows, columns) in enumerate(_shapes(results)):
        handles.append(Line2D([], [], color=_grey(rank), label=f"{rows}×{columns} pixels"))
    return handles


def _draw_captures(ax: Axes, results: dict[str, Any]) -> None:
    """Error of a capture without its mean against that of the PSF."""
    run = [row for row in results["captures"] if row["status"] == "run"]
    points = [(row["psf_error"], row["contrast_error"]) for row in run]
    _draw_wrong(ax, results, "capture_contrast_error")
    _draw_models(ax, run, points)
    ax.set_yscale("log")
    ax.set_ylabel("relative error of the capture\nwithout its mean")
    rows, columns = results["settings"]["capture_shape"]
    title = f"{results['settings']['target']}, {rows}×{columns} pixels, captured"
    ax.set_title(title, fontsize=10, loc="left")
    _finish_cost(ax)


def _draw_losses(ax: Axes, results: dict[str, Any]) -> None:
    """PSNR lost against the error of the assumed PSF."""
    found = results["reconstructions"]
    if found["skipped"]:
        ax.set_axis_off()
        ax.text(0.5, 0.5, f"no reconstruction:\n{found['skipped']}", ha="center", fontsize=10)
        return
    run = [row for row in found["models"] if row["status"] == "run"]
    points = [(row["psf_error"], row["psnr_lost_db"]) for row in run]
    lines = _draw_wrong(ax, results, "psnr_lost_db")
    _draw_models(ax, run, points)
    ax.set_yscale("symlog", linthresh=_LINEAR_DB, linscale=0.5)
    low = min(0.0, *(y for _, y in points))
    high = max(0.1, *(y for _, y in points), *(y for line in lines for _, y in line))
    ax.set_ylim(3 * low - 2 * _LINEAR_DB, 3 * high)
    ticks = [t for t in (-10, -1, -0.1, -0.01, 0, 0.01, 0.1, 1, 10) if 3 * low <= t <= 3 * high]
    ax.set_yticks(ticks, [f"{t:g}".replace("-", "−") for t in ticks])
    ax.axhline(0, color="black", linewidth=0.7)
    ax.set_ylabel("PSNR lost (dB)")
    ax.set_title(
        f"{found['method']}, this PSF assumed; with the exact one {found['exact_psnr_db']:.1f} dB",
        fontsize=10,
        loc="left",
    )
    _finish_cost(ax)


def _draw_wrong(ax: Axes, results: dict[str, Any], quantity: str) -> list[list[Point]]:
    """A line for each kind of wrong camera."""
    lines = []
    for wrong, style in _WRONG.items():
        rows = [r for r in results["reconstructions"]["controlled"] if r["wrong"] == wrong]
        line = [(r["psf_error"], r[quantity]) for r in rows if r["status"] == "run"]
        if line:
            ax.plot(*zip(*line, strict=True), color="black", linewidth=1, markersize=6, **style)
            lines.append(line)
    return lines


def _draw_models(ax: Axes, run: list[dict[str, Any]], points: list[Point]) -> None:
    for row, point in zip(run, points, strict=True):
        marker = _MARKERS.get((row["model"], None)) or _MARKERS[row["model"], 3]
        ax.plot(*point, marker=marker, color="black", markersize=7)


def _finish_cost(ax: Axes) -> None:
    ax.set_xscale("log")
    ax.margins(x=0.12, y=0.15)
    ax.set_xlabel("relative L2 error of the PSF over the sensor")
    ax.grid(alpha=0.25)
    if ax.get_legend_handles_labels()[0]:
        ax.legend(fontsize=8.5, loc="upper left", framealpha=1)


def costs(results: dict[str, Any]) -> list[str]:
    """A line for each PSF that was assumed: errors of the PSF and the capture, and PSNR lost."""
    found = results["reconstructions"]
    lost = {row["model"]: row.get("psnr_lost_db") for row in found["models"]}
    lines = [
        "| assumed | PSF error | capture error | without mean | PSNR lost dB |",
        "|---|---|---|---|---|",
    ]
    for row in results["captures"]:
        if row["status"] == "run":
            errors = (row["psf_error"], row["error"], row["contrast_error"])
            lines.append(_line(words(row["model"]), errors, lost.get(row["model"])))
    for row in found["controlled"]:
        if row["status"] == "run":
            wrong = _WRONG[row["wrong"]]["label"]
            errors = (row["psf_error"], row["capture_error"], row["capture_contrast_error"])
            name = f"exact, {wrong} by {row['change']:.1e}"
            lines.append(_line(name, errors, row["psnr_lost_db"]))
    return lines


def _line(name: str, errors: tuple[float, ...], lost: float | None) -> str:
    loss = "–" if lost is None else f"{lost:.4f}".replace("-", "−")
    return f"| {' | '.join([name, *(f'{error:.1e}' for error in errors), loss])} |"


if __name__ == "__main__":
    path = Path(sys.argv[1])
    recorded = json.loads(path.read_text("utf-8"))
    print(*costs(recorded), sep="\n")
    draw(recorded).savefig(path.with_name("accuracy.png"), dpi=110)
