"""Focus after the event
=====================

A mask's shadow grows with 1 + d/t, so that four captures hold the distance t of everything they
show. Half of a picture stands at 80 mm and half at 140 mm: how far away is each, and what does a
picture that is sharp everywhere look like?
"""

import math
import os
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

import thincam_jax as tc
from thincam_jax.imaging.targets import sample_image
from thincam_jax.reconstruction import depth, fringe_scanning
from thincam_jax.units import nm, um

PART = 2 if os.environ.get("THINCAM_SIZE") == "small" else 1  # small: half as wide, half as far
FIGURES = Path(os.environ.get("THINCAM_FIGURES", "runs/experiments")) / "refocus"
FIGURES.mkdir(parents=True, exist_ok=True)

# %%
# Four captures of two planes
# ---------------------------

sensor = tc.Sensor((400 // PART, 480 // PART), 12 * um)
phases = [n * math.pi / 2 for n in range(4)]
masks = [tc.FresnelZoneAperture(40.0 * PART, phase, width=5.6 / PART) for phase in phases]
cameras = [tc.LenslessCamera(mask, sensor, distance=6.5) for mask in masks]
near, far = 80.0 / PART, 140.0 / PART
picture = sample_image("astronaut", linear=True).mean(axis=-1)
left = np.arange(picture.shape[1]) < picture.shape[1] // 2
scene = tc.Scene(
    [
        tc.ImagePlane(np.where(left, picture, 0), near, width=0.6 * near / PART),
        tc.ImagePlane(np.where(left, 0, picture), far, width=0.6 * far / PART),
    ],
    500 * nm,
)
noise = tc.GaussianNoise(snr_db=40.0, signal_power="without_mean")
captures = [tc.capture(camera, scene, key=n, noise=noise) for n, camera in enumerate(cameras)]
resolved = [float(depth.axial_resolution(cameras[0], object_distance=t)) for t in (near, far)]
print("depth of focus, mm:", *(f"{t:.1f}" for t in resolved))

# %%
# A sweep, and what is sharp in it
# --------------------------------
#
# The distance is an argument of the compiled program: only the first image waits for it.

recording = tc.Recording(captures, tc.Cameras(cameras, wavelength=500 * nm))
distances = depth.refocus_distances(0.8 * near, 1.3 * far, 25)  # even steps of 1/t
sweep = depth.refocus_sweep(recording, distances, tc.Wiener(synthesis=fringe_scanning(1)))
rows, columns = sweep.images.shape[-2:]
regions = np.zeros((rows, columns), int)
inside = round(0.25 * 6.5 * 0.6 / PART / (12 * um))  # pixels of the sensor, half of a half
middle, across = slice(rows // 2 - inside, rows // 2 + inside), columns // 2
regions[middle, across - 2 * inside : across - 8] = 1
regions[middle, across + 8 : across + 2 * inside] = 2
curves = depth.find_distances(sweep, regions=regions)
found = [curves.distance_of(region).distance for region in (1, 2)]
print("found, mm:", *(f"{t:.1f}" for t in found))

figure, ax = plt.subplots(figsize=(7, 3.4), layout="constrained")
styles = (("k-", near, "left half"), ("k--", far, "right half"))
for curve, (style, placed, name) in zip(curves.curves, styles, strict=True):
    ax.plot(distances, curve / curve.max(), style, label=name)
    ax.axvline(placed, color="0.6", linestyle=style[1:])
ax.set(xlabel="focused on the distance t (mm)", ylabel="sharpness (largest = 1)")
ax.legend()
figure.savefig(FIGURES / "curves.png", dpi=110)

# %%
# Depth map, and all in focus
# ---------------------------

map_ = depth.depth_map(sweep)
sharp = depth.all_in_focus(sweep, map_)
nearest = [int(np.argmin(np.abs(np.asarray(distances) - t))) for t in (near, far)]
images = {f"focused on {distances[n]:.0f} mm": sweep.images[n] for n in nearest}
images |= {"sharp everywhere": sharp}
figure, panels = plt.subplots(1, 4, figsize=(14, 3.2), layout="constrained")
slope = float(sweep.slope)  # of the angle between neighbouring pixels
extent = slope * np.array([-columns, columns, rows, -rows]) / 2
for ax, (title, image) in zip(panels, images.items(), strict=False):
    ax.imshow(image, cmap="gray", vmin=0, vmax=np.percentile(sharp, 99.8), extent=extent)
    ax.set(title=title, xlabel="direction x/t")
sure = np.ma.masked_where(np.asarray(map_.confidence) < 0.25, map_.distance)
shown = panels[3].imshow(sure, cmap="gray", extent=extent)
panels[3].set(title="distance, where it is sure", xlabel="direction x/t", facecolor="#4060a0")
figure.colorbar(shown, ax=panels[3], label="t (mm)")
panels[0].set_ylabel("direction y/t")
figure.savefig(FIGURES / "depth.png", dpi=110)
assert abs(found[0] / near - 1) < 0.05 and abs(found[1] / far - 1) < 0.1
