"""A depth map, and one image that is sharp everywhere, of images focused on several distances."""

from pathlib import Path

import jax.numpy as jnp
import numpy as np

from thincam_jax.commands.photo.jobs import Job
from thincam_jax.commands.refocus import figures
from thincam_jax.commands.study.figures import as_png
from thincam_jax.measured.write import linear_bytes
from thincam_jax.reconstruction.depth import DepthMap, RefocusSweep, all_in_focus, depth_map


def find_depth(
    images: list[np.ndarray], distances: tuple[float, ...]
) -> tuple[RefocusSweep, DepthMap, np.ndarray]:
    """The mean of the colours over the distances, its depth map, and the sharp image (channel, y,
    x): one distance a pixel for all colours."""
    stack, focus = jnp.stack(images), jnp.asarray(distances, jnp.float32)
    sweep = RefocusSweep(jnp.mean(stack, axis=1), focus, None)
    depth = depth_map(sweep)
    colours = [RefocusSweep(stack[:, n], focus, None) for n in range(stack.shape[1])]
    return sweep, depth, np.stack([all_in_focus(colour, depth) for colour in colours])


def draw_depth(
    job: Job, sweep: RefocusSweep, depth: DepthMap, sharp: np.ndarray
) -> dict[Path, bytes]:
    """The contents of the files beside the image: contact sheet, depth map, its distances."""
    sheet, map_, *linear = job.beside
    contents = {
        sheet: as_png(figures.draw_sweep(sweep, {})),
        map_: as_png(figures.draw_depth(sweep, depth, sharp.mean(axis=0))),
    }
    distance = np.asarray(depth.distance, np.float32)[None]
    return contents | {path: linear_bytes(distance, path.suffix.lower()) for path in linear}
