"""The network that was trained for a camera, in place of a solver."""

import time
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from thincam_jax.commands.config_file import ConfigError
from thincam_jax.commands.reconstruct.options import Focusing
from thincam_jax.commands.refocus.figures import grey_levels, white_level
from thincam_jax.commands.study.figures import as_png, drawing
from thincam_jax.learn.refocusing.store import load
from thincam_jax.learn.refocusing.use import SURE, doubt, read
from thincam_jax.measured import MeasurementError, Prepared
from thincam_jax.reconstruction import Cameras


def read_network(path: Path, cameras: Cameras) -> Focusing:
    """A network and the distance that it is to be focused on, checked before any work.

    **Errors**: ConfigError for a damaged file, another camera, and a distance outside of the range.
    """
    try:
        network = load(path, cameras)
        network.camera.within(cameras.object_distance)
    except ValueError as error:
        raise ConfigError(str(error)) from None
    return Focusing(path, network, float(cameras.object_distance))


def focus(
    ready: Prepared, focusing: Focusing, noise: float
) -> tuple[Float[np.ndarray, "channel y x"], dict[str, Any], bytes]:
    """The image of a network, the facts of it, and a picture that marks uncertain pixels."""
    began = time.perf_counter()
    if not ready.valid.all():
        raise MeasurementError(
            f"{int((~ready.valid).sum())} pixels of the capture are dead or saturated, and a "
            "network needs every pixel; repair them, or use another method"
        )
    try:
        found = read(focusing.network, ready.capture, [focusing.distance], noise)
    except ValueError as error:
        raise MeasurementError(f"{focusing.path}: {error}") from None
    image = np.asarray(found.images[:, 0], np.float32)
    unsure = np.asarray(found.confidence) < SURE
    consistency = float(found.consistency.max())
    facts = {
        "method": "learned",
        "network": focusing.path,
        "focused_on_mm": focusing.distance,
        "status": "ok" if np.isfinite(image).all() else "non_finite",
        "consistency": consistency,
        "doubt": doubt(consistency),
        "unsure": float(unsure.mean()),
        "iterations": 0,
        "seconds": round(time.perf_counter() - began, 3),
    }
    return image, facts, _marked(image, unsure)


def _marked(image: np.ndarray, unsure: np.ndarray) -> bytes:
    """The mean of an image's colours, with pixels that are uncertain in any in red."""
    image, unsure = np.mean(image, axis=0), np.any(unsure, axis=0)
    figure, ax = drawing((5, 5 * image.shape[0] / image.shape[1] + 0.4))
    ax.set(xticks=[], yticks=[])
    ax.imshow(grey_levels(image, white_level(image)) ** (1 / 2.2), cmap="gray", vmin=0, vmax=1)
    shade = np.zeros((*unsure.shape, 4))
    shade[unsure] = (0.84, 0.15, 0.16, 0.45)
    ax.imshow(shade)
    ax.set_xlabel("red: the network is not sure of the distance")
    return as_png(figure)
