"""Sweeps without optics: two textured halves, each blurred by how far the focus is from it."""

import jax.numpy as jnp
import numpy as np
import scipy.ndimage as ndimage

from thincam_jax.reconstruction.depth.refocus import RefocusSweep, refocus_distances

DISTANCES = np.asarray(refocus_distances(100.0, 220.0, 15))
LEFT, RIGHT = 127.0, 178.0  # between the steps
SHAPE = (48, 90)
SPLIT = 45


def texture(seed=2):
    rng = np.random.default_rng(seed)
    # Patches with edges: noise stays noise when it is blurred, and its gradients as sparse.
    return 1.0 + (ndimage.gaussian_filter(rng.normal(size=SHAPE), 2.5) > 0.05)


def sweep(left=LEFT, right=RIGHT, noise=0.0, batch=(), blur=1200.0):
    """The blur's width is linear in 1/t and 0.8 pixels at its least."""
    base, images = texture(), []
    rng = np.random.default_rng(7)
    for t in DISTANCES:
        sides = [
            ndimage.gaussian_filter(base, np.hypot(0.8, blur * (1 / t - 1 / place)))
            for place in (left, right)
        ]
        image = np.where(np.arange(SHAPE[1]) < SPLIT, *sides)
        images.append(image + noise * rng.normal(size=SHAPE))
    stack = np.stack(images)
    for size in batch:
        stack = np.repeat(stack[:, None], size, axis=1)
    return RefocusSweep(jnp.asarray(stack), jnp.asarray(DISTANCES), jnp.asarray(0.003), "wiener")


def halves():
    """Labels of the two halves, away from the seam and the border."""
    labels = np.zeros(SHAPE, int)
    labels[4:-4, 4 : SPLIT - 6] = 1
    labels[4:-4, SPLIT + 6 : -4] = 2
    return labels
