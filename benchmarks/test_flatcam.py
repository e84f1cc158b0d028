"""FlatCam of published size: ridge regression of four channels, against the same in NumPy.

A scene of 256² on a sensor of 500×620 pixels. One NumPy version keeps its decompositions, another
repeats them at each call, as published code does. All run in turn, so that the machine's load is
the same for each; the least of their times counts.
"""

import time

import jax
import jax.numpy as jnp
import numpy as np

import thincam_jax as tc
from thincam_jax.imaging.operators import Separable
from thincam_jax.lensless.masks.cells import maximum_length_sequence
from thincam_jax.reconstruction.ridge import ridge_by_modes

SENSOR, FIELD, CHANNELS, RHO = (500, 620), (256, 256), 4, 1e-3


def codes():
    """Shadows of a maximum length sequence, blurred as by diffraction: one for each axis."""
    code = np.repeat(np.tile(2.0 * maximum_length_sequence(255) - 1, 2), 2)
    code = np.convolve(code, [0.25, 0.5, 0.25], "same")
    pixels = [np.arange(n)[:, None] - np.arange(m) + m for n, m in zip(SENSOR, FIELD, strict=True)]
    return [code[p] / len(p) ** 0.5 for p in pixels]


def kept_in_numpy(captures, left, right, rows, columns):
    """X = V [(V Pᵀ Y Q Wᵀ) / (s² t² + ρ)] W, channel by channel."""
    images = np.empty((len(captures), *FIELD))
    for image, capture in zip(images, captures, strict=True):
        inside = rows.V @ left.T @ capture @ right @ columns.V.T
        image[:] = rows.V.T @ (inside / (rows.s[:, None] ** 2 * columns.s**2 + RHO)) @ columns.V
    return images


def repeated_in_numpy(captures, left, right):
    images = np.empty((len(captures), *FIELD))
    for k in range(len(captures)):
        both = Decomposition(left), Decomposition(right)
        images[k] = kept_in_numpy(captures[k : k + 1], left, right, *both)[0]
    return images


class Decomposition:
    def __init__(self, matrix):
        self.U, self.s, self.V = np.linalg.svd(matrix, full_matrices=True)


def test_four_channels(capsys):
    left, right = codes()
    rng = np.random.default_rng(0)
    scene = rng.uniform(size=(CHANNELS, *FIELD))
    captures = left @ scene @ right.T
    captures += 0.01 * captures.std() * rng.normal(size=captures.shape)

    single = [np.asarray(a, np.float32) for a in (left, right, captures)]
    began = time.perf_counter()
    operator = Separable(single[0], single[1]).with_modes()
    jax.block_until_ready(operator)
    once = time.perf_counter() - began
    seen, rho = jnp.asarray(single[2]), jnp.float32(RHO)
    kept = Decomposition(left), Decomposition(right)
    recording = tc.Recording(seen, operator, noise_variance=1.0)
    sides = {
        "ours": lambda: ridge_by_modes(operator.modes, seen, rho).block_until_ready(),
        "reconstruct": lambda: tc.reconstruct(recording, tc.Ridge(RHO)).image.block_until_ready(),
        "kept": lambda: kept_in_numpy(captures, left, right, *kept),
        "repeated": lambda: repeated_in_numpy(captures, left, right),
    }
    images, times = {}, {name: [] for name in sides}
    for repeat in range(6):
        for name, side in sides.items():
            if name != "repeated" or repeat < 3:
                began = time.perf_counter()
                images[name] = side()
                times[name].append(time.perf_counter() - began)
    least = {name: min(taken[1:]) for name, taken in times.items()}  # the first compiles
    error = np.linalg.norm(images["ours"] - images["kept"]) / np.linalg.norm(images["kept"])
    with capsys.disabled():
        print(f"\n{FIELD} on {SENSOR}, {CHANNELS} channels; modes once in {once:.2f} s")
        for name, seconds in least.items():
            ratio = seconds / least["ours"]
            print(f"  {name:12s} {1e3 * seconds:8.1f} ms, {ratio:6.1f} times ours")
        print(f"  float32 against NumPy's float64: {error:.1e}")
    assert error < 1e-3
    assert least["repeated"] > 15 * least["ours"] and least["kept"] > 1.3 * least["ours"]
