"""The pictures of captures, as PNG files in the folder of a run."""

import math
from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.figure import Figure

from thincam_jax.commands.capture.config import CaptureConfig
from thincam_jax.commands.run_folder import RunFolder
from thincam_jax.commands.study.figures import drawing, save_figure, save_image
from thincam_jax.reconstruction import Reconstruction

_CORNER = (12, 8)  # pixels of a fiducial, which see no light
_BESIDE = 4


def without_fiducial(config: CaptureConfig, shape: tuple[int, ...]) -> np.ndarray:
    """Where frames show light."""
    inside = np.ones(shape, bool)
    if config.rig == "virtual" and config.virtual is not None and config.virtual.fiducial:
        inside[: _CORNER[0], : _CORNER[1]] = False
    return inside


def save_frames(
    folder: RunFolder, config: CaptureConfig, frames: np.ndarray, labels: Sequence[str]
) -> None:
    """Frames in counts, as they were taken, in the order of the plan."""
    seen = frames[:, without_fiducial(config, frames.shape[1:])]
    norm = {"vmin": float(seen.min()), "vmax": float(np.quantile(seen, 0.9999))}
    height, width = (n * config.camera.pitch / 2 for n in frames.shape[1:])
    place = {"extent": (-width, width, height, -height), **norm}
    _save_stack(folder, "frames", frames, labels, place, ("on the sensor", "counts"))


def save_shown(
    folder: RunFolder, config: CaptureConfig, shown: Sequence[np.ndarray], labels: Sequence[str]
) -> None:
    """What the display showed for them, levels of 0 to 255, where any of them is lit."""
    lit = np.argwhere(np.max(shown, axis=0))
    middle = np.array(shown[0].shape) / 2
    half = np.ceil(1.1 * np.abs(lit + 0.5 - middle).max(axis=0)) if len(lit) else middle
    low, high = np.maximum(middle - half, 0).astype(int), (middle + half).astype(int)
    shown = [pattern[low[0] : high[0], low[1] : high[1]] for pattern in shown]
    height, width = (n * config.display.pitch / 2 for n in shown[0].shape)
    place = {"extent": (-width, width, height, -height), "vmin": 0, "vmax": 255}
    _save_stack(folder, "shown", np.stack(shown), labels, place, ("on the display", "level"))


def _save_stack(folder, name, images, labels, place, words) -> None:
    columns = min(_BESIDE, len(images))
    rows = math.ceil(len(images) / columns)
    aspect = images.shape[1] / images.shape[2]
    size = (2.6 * columns + 1.0, rows * (2.3 * aspect + 0.7))
    figure, axes = drawing(size, rows, columns, squeeze=False)
    for ax, image, label in zip(axes.ravel(), images, labels, strict=False):
        ax.imshow(image, cmap="gray", **place)
        ax.set_title(label, fontsize=9)
    for ax in axes.ravel()[len(images) :]:
        ax.set_axis_off()
    for ax in axes[-1]:
        ax.set_xlabel(f"x {words[0]} (mm)", fontsize=9)
    for ax in axes[:, 0]:
        ax.set_ylabel(f"y {words[0]} (mm)", fontsize=9)
    figure.colorbar(axes[0, 0].images[0], ax=axes, label=words[1])
    save_figure(folder, name, figure)


def save_images(
    folder: RunFolder, images: Mapping[str, Reconstruction], scores: Mapping[str, float | None]
) -> None:
    """Reconstructions on the object, each from its own black to its own white."""
    figure = Figure(figsize=(4.2 * len(images), 4.7), layout="constrained")
    axes = figure.subplots(1, len(images), squeeze=False)[0]
    for ax, (name, one) in zip(axes, images.items(), strict=True):
        image = np.squeeze(np.asarray(one.image, float))
        low, high = np.quantile(image, (0.002, 0.998))
        half = [n * float(np.asarray(one.pitch)) / 2 for n in image.shape]
        extent = (-half[1], half[1], half[0], -half[0])
        ax.imshow(image, cmap="gray", vmin=low, vmax=high, extent=extent)
        score = scores.get(name)
        ax.set_title(name if score is None else f"{name}, {score:.1f} dB", fontsize=10)
        ax.set_xlabel("x on the object (mm)")
        save_image(folder, name.replace(" ", "-"), (image - low) / (high - low))
    axes[0].set_ylabel("y on the object (mm)")
    save_figure(folder, "images", figure)


def save_seconds(folder: RunFolder, seconds: Mapping[str, float]) -> None:
    """Time that the steps of the acquisition took in all."""
    figure, ax = drawing((6.5, 2.6))
    bars = ax.barh(list(seconds), list(seconds.values()), color="0.45")
    ax.bar_label(bars, fmt="%.3g s", padding=3, fontsize=9)
    ax.set_xlabel("time of all frames (s)")
    ax.margins(x=0.15)
    ax.invert_yaxis()
    save_figure(folder, "seconds", figure)
