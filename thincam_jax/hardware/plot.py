"""Figures of a rig's captures: patterns and frames, images made of them, time of the steps."""

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Bool, Float
from matplotlib.figure import Figure

from thincam_jax.plot.frame import drawing, show_image
from thincam_jax.plot.pictures import draw_beside, labels

if TYPE_CHECKING:
    from thincam_jax.hardware.studies.rig import ShownPictures

_BESIDE = 4


def draw_frames(
    frames: Float[np.ndarray, "frame y x"],
    labels: Sequence[str],
    pitch: float,
    lit: Bool[np.ndarray, "y x"] | None = None,
) -> Figure:
    """Frames in counts on the sensor, all on one grey scale.

    - `pitch`: pitch of the sensor's pixels, mm.
    - `lit`: pixels that see light, which set the scale; default all.
    """
    seen = frames if lit is None else frames[:, lit]
    levels = {"vmin": float(seen.min()), "vmax": float(np.quantile(seen, 0.9999))}
    return _stack(frames, labels, pitch, levels, ("on the sensor", "counts"))


def draw_patterns(shown: Sequence[np.ndarray], labels: Sequence[str], pitch: float) -> Figure:
    """Patterns (y, x) that a display showed, levels 0 to 255, where any of them is lit.

    - `pitch`: pitch of the display's pixels, mm.
    """
    lit = np.argwhere(np.max(shown, axis=0))
    middle = np.array(shown[0].shape) / 2
    half = np.ceil(1.1 * np.abs(lit + 0.5 - middle).max(axis=0)) if len(lit) else middle
    low, high = np.maximum(middle - half, 0).astype(int), (middle + half).astype(int)
    parts = np.stack([pattern[low[0] : high[0], low[1] : high[1]] for pattern in shown])
    return _stack(parts, labels, pitch, {"vmin": 0, "vmax": 255}, ("on the display", "level"))


def _stack(images, labels, pitch, levels, words) -> Figure:
    """Images about their common middle; `words`: where x and y are, and what the levels are."""
    height, width = (n * pitch / 2 for n in images.shape[1:])
    columns = min(_BESIDE, len(images))
    rows = math.ceil(len(images) / columns)
    aspect = images.shape[1] / images.shape[2]
    size = (2.6 * columns + 1.0, rows * (2.3 * aspect + 0.7))
    figure, axes = drawing(size, rows, columns, squeeze=False)
    for ax, image, label in zip(axes.ravel(), images, labels, strict=False):
        ax.imshow(image, cmap="gray", extent=(-width, width, height, -height), **levels)
        ax.set_title(label, fontsize=9)
    for ax in axes.ravel()[len(images) :]:
        ax.set_axis_off()
    for ax in axes[-1]:
        ax.set_xlabel(f"x {words[0]} (mm)", fontsize=9)
    for ax in axes[:, 0]:
        ax.set_ylabel(f"y {words[0]} (mm)", fontsize=9)
    figure.colorbar(axes[0, 0].images[0], ax=axes, label=words[1])
    return figure


def draw_images(
    images: Mapping[str, Float[np.ndarray, "y x *colour"]],
    pitch: float,
    scores: Mapping[str, float | None],
) -> Figure:
    """Images on the object, each from its own black to its own white.

    - `pitch`: pitch of their pixels, mm. `scores`: PSNR, dB, by their names, of those that have
      one.
    """
    figure, axes = drawing((4.2 * len(images), 4.7), 1, len(images), squeeze=False)
    for ax, (name, image) in zip(axes[0], images.items(), strict=True):
        show_image(ax, stretched(image), pitch, vmin=0, vmax=1)
        score = scores.get(name)
        ax.set_title(name if score is None else f"{name}, {score:.1f} dB", fontsize=10)
        ax.set(xlabel="x on the object (mm)", ylabel="")
    axes[0, 0].set_ylabel("y on the object (mm)")
    return figure


def stretched(image: np.ndarray) -> np.ndarray:
    """The image from its own black, 0, to its own white, 1; of two in a thousand pixels."""
    low, high = np.quantile(image, (0.002, 0.998))
    return np.clip((image - low) / (high - low), 0, 1)


def draw_seconds(seconds: Mapping[str, float]) -> Figure:
    """Time that the steps of an acquisition took in all, by their names."""
    figure, ax = drawing((6.5, 2.6))
    bars = ax.barh(list(seconds), list(seconds.values()), color="0.45")
    ax.bar_label(bars, fmt="%.3g s", padding=3, fontsize=9)
    ax.set_xlabel("time of all frames (s)")
    ax.margins(x=0.15)
    ax.invert_yaxis()
    return figure


def draw_pictures(found: "ShownPictures") -> Figure:
    """Pictures shown, their captures in grey, turned upright, and reconstructions by solver.

    What is not known stays white.
    """
    captures, bright = found.captures, np.quantile(found.captures, 0.999)
    columns = [("capture, turned", list(captures[:, ::-1, ::-1] / bright), [""] * len(captures))]
    columns += [(name, list(one.images), labels(one)) for name, one in found.methods.items()]
    shown = {n: np.ones((1, 1)) if one is None else one for n, one in found.targets.items()}
    return draw_beside(shown, columns)
