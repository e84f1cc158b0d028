"""Moving objects behind a screen
==============================

The see-through-screen camera has to undo its ghosts for every image. Can it follow an object
that moves (an open problem of the thesis)? A measured matrix H of 440² pixels and 64² cells has
3.2 GB, all of which Hᵀg reads. It is compressed here in several ways: what does each cost in dB,
and how many images a second does it allow?
"""

import os
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import scipy.sparse

import thincam_jax as tc
from thincam_jax import waveguide as wg
from thincam_jax.imaging.metrics import psnr
from thincam_jax.imaging.operators import Matrix, ReducedMatrix, Sparse
from thincam_jax.imaging.targets import resize, sample_image
from thincam_jax.measured.calibration import fit_screen
from thincam_jax.units import deg, nm, um
from thincam_jax.waveguide.measured.screen_fit import GhostPositions

SIZE = os.environ.get("THINCAM_SIZE", "full")  # "small": fewer pixels and cells, in seconds
FIGURES = Path(os.environ.get("THINCAM_FIGURES", "runs/experiments")) / "sts_realtime"
FIGURES.mkdir(parents=True, exist_ok=True)

# %%
# A measured matrix, and a moving scene
# -------------------------------------
#
# The matrix is that of the ray model with the noise of its calibration, 0.1 % of its largest
# entry. A window moves over a photograph by a cell an image; captures have 30 dB.

pixels, cells, count = {"full": (440, 64, 30), "small": (88, 16, 5)}[SIZE]
hologram = wg.VolumeHologram.record(
    532 * nm, 0.0, 61.2 * deg, index=1.5, thickness=16 * um, index_modulation=0.02
)
sensor = tc.Sensor((pixels, pixels), 440 * 4.8 * um / pixels)
places = wg.Rectangle((0.0, 0.0), (20.0, 50.0)), wg.Rectangle((25.0, 0.0), (50.0, 50.0))
camera = wg.SeeThroughCamera(wg.Screen(hologram, 5.0, 1.5, *places), sensor, 6.0, 10.0)
plane = wg.ObjectPlane((cells, cells), 550.0, 150.0, (27.0, 0.0))
rays = wg.system_operator(camera, plane)
where = (np.asarray(rays.rows), np.asarray(rays.columns))
model = scipy.sparse.csr_array(
    (np.asarray(rays.values), where), shape=(pixels**2, cells**2), dtype=np.float32
)
rng = np.random.default_rng(0)
noise = np.float32(1e-3 * model.max())
measured = noise * rng.standard_normal(model.shape, dtype=np.float32)
np.add.at(measured, where, np.asarray(rays.values))

photograph = resize(sample_image("camera", linear=True), (cells + count, cells + count))
scenes = [jnp.asarray(photograph[k : k + cells, k : k + cells], jnp.float32) for k in range(count)]
clean = [rays(scene) for scene in scenes]
deviation = float(jnp.sqrt(jnp.mean(clean[0] ** 2))) * 10 ** (-30 / 20)
keys = jax.random.split(jax.random.key(0), count)
captures = [c + deviation * jax.random.normal(k, c.shape) for c, k in zip(clean, keys, strict=True)]

# %%
# Matrices that are read faster
# -----------------------------
#
# - the ray model, without noise: a plate taken for 5.1 mm thick is fitted to 36 ghosts, each known
#   to 0.3 mm;
# - entries above 5 times the noise of the calibration alone;
# - half precision;
# - pixels averaged 2 × 2, which loses what tells them apart.

shapes = (cells, cells), (pixels, pixels)
spots = rng.uniform(-1, 1, (12, 2))[:, ::-1]  # (y, x), mm on the sensor
points = np.asarray(wg.trace(camera, spots, object_distance=plane.distance, orders=3).points)[
    ..., 1::-1
]
points = points - np.asarray(plane.centre) + 0.3 * rng.standard_normal(points.shape)[..., ::-1]
ghosts = GhostPositions(
    np.tile(spots, (3, 1)), points.reshape(-1, 2), np.repeat(np.arange(3), 12), 0.3
)
start = wg.SeeThroughCamera(wg.Screen(hologram, 5.1, 1.5, *places), sensor, 6.0, 10.0)
free = ("glass_thickness", "slant", "tilt", "object_x", "object_y")
fit = fit_screen(ghosts, start, plane, parameters=free, samples=None)
glass, error = fit.values["glass_thickness"], fit.standard_errors["glass_thickness"]
print(f"fitted glass {glass:.3f} ± {error:.3f} mm, {fit.status}")


def summed(array):
    """Blocks of 2 × 2 pixels of captures, or of the matrix's columns, averaged."""
    blocks = array.reshape(*array.shape[:-2], pixels // 2, 2, pixels // 2, 2)
    return blocks.mean(axis=(-3, -1))


binned = summed(measured.T.reshape(-1, pixels, pixels)).reshape(cells**2, -1).T
strong = scipy.sparse.csr_array(np.where(measured > 5 * noise, measured, 0))
half = measured.astype(np.float16)
matrices = {
    "dense": Matrix(measured, *shapes),
    "half precision": Matrix(half, *shapes),
    "2 × 2 pixels": Matrix(binned, shapes[0], (pixels // 2,) * 2),
    "threshold": Sparse(strong, *shapes),
    "ray model": fit.system(fit.plane),
}

# %%
# The stream
# ----------
#
# Each matrix is reduced once. Then an image is one Hᵀg and four iterations of ADMM from the image
# and the forces before it. What is timed is all of it, from the capture to the image; the first
# two captures, which are reconstructed in full and compiled for, do not count.

speed, accuracy, images = {}, {}, {}
for name, matrix in matrices.items():
    rounded = Matrix(half.astype(np.float32), *shapes) if name == "half precision" else matrix
    reduced = ReducedMatrix.of(rounded)
    seen = [summed(c) for c in captures] if name.startswith("2") else captures
    variance = deviation**2 / (4 if name.startswith("2") else 1)
    first = tc.Recording(reduced.project(matrix, seen[0]), reduced, noise_variance=variance)
    stream = tc.Stream(first, tc.AdmmTV(0.5, iterations=50), steps=4)
    seconds, accuracy[name] = [], []
    for capture, scene in zip(seen[1:], scenes[1:], strict=True):
        began = time.perf_counter()
        stream, image = stream.next(reduced.project(matrix, capture))
        image.block_until_ready()
        seconds.append(time.perf_counter() - began)
        accuracy[name].append(float(psnr(image, scene)))
    images[name], speed[name] = np.asarray(image), 1 / np.median(seconds[1:])
    loss = np.mean(accuracy["dense"]) - np.mean(accuracy[name])
    print(f"{name}: {speed[name]:.1f} images/s, {loss:.2f} dB below the dense matrix")

# %%
figure, (left, right) = plt.subplots(1, 2, figsize=(10, 3.8), layout="constrained")
for marker, (name, values) in zip("os^Dv", accuracy.items(), strict=True):
    left.plot(speed[name], np.mean(values), marker, color="0.2", label=name)
    right.plot(range(1, count), values, marker + "-", color="0.4", markersize=4, label=name)
left.axvline(15, color="0.6", linestyle="--", label="15 images/s")
left.set(xscale="log", xlabel="images per second", ylabel="mean PSNR (dB)")
right.set(xlabel="image of the sequence", ylabel="PSNR (dB)")
left.xaxis.set_minor_formatter("")
left.legend(fontsize="small")
right.legend(fontsize="small")
figure.savefig(FIGURES / "speed.png", dpi=110)

# %%
figure, axes = plt.subplots(1, 5, figsize=(13, 3), layout="constrained")
turned = np.asarray(captures[-1])[::-1, ::-1]
shown = [("scene", scenes[-1]), ("capture", turned)]
shown += [(name, images[name]) for name in ("dense", "threshold", "ray model")]
for ax, (title, picture) in zip(axes, shown, strict=True):
    width = 440 * 4.8e-3 if title == "capture" else 150.0
    ax.imshow(picture, cmap="gray", extent=(-width / 2, width / 2, width / 2, -width / 2))
    ax.set(title=title, xlabel="mm on the sensor" if title == "capture" else "mm on the object")
figure.savefig(FIGURES / "images.png", dpi=110)

# %%
# What this says
# --------------
#
# Few rays meet a pixel, so nearly all of a measured matrix is noise. What is above the noise, or
# the model that was fitted to it, is read far faster (above) and reconstructs as well.

for name in ("half precision", "threshold", "ray model"):
    assert np.mean(accuracy["dense"]) - np.mean(accuracy[name]) < 0.5, name
