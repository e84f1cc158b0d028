"""The pictures of a training."""

from typing import TYPE_CHECKING

import numpy as np
from matplotlib.figure import Figure

from thincam_jax.learn.refocusing.learned import SURE
from thincam_jax.plot.frame import drawing, grey_levels, white_level

if TYPE_CHECKING:
    from thincam_jax.learn.refocusing.learned import Reading
    from thincam_jax.learn.refocusing.network import RefocusNetwork
    from thincam_jax.learn.refocusing.scenes import Batch
    from thincam_jax.learn.training import TrainingState

_SMOOTHED = 25  # steps
_SHOWN = 3  # scenes


def draw_losses(state: "TrainingState", check_every: int) -> Figure:
    """The loss of every step and of every check."""
    figure, ax = drawing((7, 3.6))
    losses = state.losses[: state.step]
    steps = np.arange(1, len(losses) + 1)
    ax.plot(steps, losses, color="0.8", linewidth=0.8, label="loss of a step")
    if len(losses) > _SMOOTHED:
        mean = np.convolve(np.nan_to_num(losses), np.full(_SMOOTHED, 1 / _SMOOTHED), "valid")
        ax.plot(steps[_SMOOTHED - 1 :], mean, color="C0", label=f"mean of {_SMOOTHED} steps")
    checked = np.minimum(np.arange(1, len(state.scores) + 1) * check_every, len(state.losses))
    ax.plot(checked, state.scores, "o-", color="C1", markersize=3, label="scenes of the checks")
    ax.set(xlabel="step", ylabel="loss (0.115 less is 1 dB)")
    ax.legend(frameon=False)
    return figure


def draw_scenes(network: "RefocusNetwork", batch: "Batch", reading: "Reading") -> Figure:
    """Scenes: capture, what a lens would see and what the network makes of it; distances."""
    rows = min(_SHOWN, len(batch.capture))
    figure, axes = drawing((2.1 * 7, 2.35 * rows), rows, 7, squeeze=False)
    near, far = float(network.camera.near), float(network.camera.far)
    for number, row in enumerate(axes):
        place = f"focused on {float(batch.commanded[number]):.0f} mm"
        images = {
            "capture": (batch.capture, batch.capture),
            f"lens, {place}": (batch.image, batch.image),
            f"network, {place}": (reading.images[:, 0], batch.image),
            "pinhole": (batch.all_in_focus, batch.all_in_focus),
            "network, all in focus": (reading.all_in_focus, batch.all_in_focus),
        }
        for ax in row:
            ax.set(xticks=[], yticks=[])
        for ax, (name, (image, like)) in zip(row, images.items(), strict=False):
            ax.set_title(name.replace(", focused ", ",\nfocused\n"), fontsize=9)
            levels = grey_levels(np.asarray(image[number]), white_level(np.asarray(like[number])))
            ax.imshow(levels[::-1, ::-1], cmap="gray", vmin=0, vmax=1)
        row[5].set_title("distance", fontsize=9)
        row[6].set_title("network, distance", fontsize=9)
        unsure = np.asarray(reading.confidence[number])[::-1, ::-1] < SURE
        for ax, distance in zip(row[5:], (batch.distance, reading.distance), strict=True):
            inverse = 1 / np.asarray(distance[number])[::-1, ::-1]
            ax.imshow(inverse, cmap="viridis", vmin=1 / far, vmax=1 / near)
        row[6].contourf(unsure, levels=[0.5, 1.5], colors="none", hatches=["////"])
        row[6].set_xlabel("hatched: unsure", fontsize=8)
    bar = figure.colorbar(axes[0, 5].images[0], ax=axes, shrink=0.8)
    places = np.linspace(1 / far, 1 / near, 5)
    bar.set_ticks(places.tolist(), labels=[f"{1 / p:.0f}" for p in places])
    bar.set_label("distance (mm)")
    return figure


def draw_unsure(image: np.ndarray, unsure: np.ndarray) -> Figure:
    """An image (channel, y, x), its colours averaged; pixels that are unsure in any are red."""
    image, unsure = np.mean(image, axis=0), np.any(unsure, axis=0)
    figure, ax = drawing((5, 5 * image.shape[0] / image.shape[1] + 0.4))
    ax.set(xticks=[], yticks=[])
    ax.imshow(grey_levels(image, white_level(image)) ** (1 / 2.2), cmap="gray", vmin=0, vmax=1)
    shade = np.zeros((*unsure.shape, 4))
    shade[unsure] = (0.84, 0.15, 0.16, 0.45)
    ax.imshow(shade)
    ax.set_xlabel("red: the network is not sure of the distance")
    return figure
