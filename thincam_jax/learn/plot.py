"""The pictures of a training."""

from typing import TYPE_CHECKING

import numpy as np
from matplotlib.figure import Figure

from thincam_jax.plot.frame import drawing

if TYPE_CHECKING:
    from thincam_jax.learn.training import TrainingState

_SMOOTHED = 25  # steps


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
