"""A hand, by a network that was trained without any capture
=========================================================

A network for the camera of DiffuserCam's tutorial comes with the package. It has seen that camera's
PSF and photographs behind its model, never one of its captures. What does it see of a hand, what
does it make up, and what does it say to other cameras?
"""

import logging
import os
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

import thincam_jax as tc
from thincam_jax import measured
from thincam_jax.imaging.targets import sample_image
from thincam_jax.learn.trained import TrainedReconstruction, training_record
from thincam_jax.lensless.masks import random_cells
from thincam_jax.studies.prepared import pixel_noise, reconstruct_prepared
from thincam_jax.units import nm, um

SMALL = os.environ.get("THINCAM_SIZE") == "small"
FIGURES = Path(os.environ.get("THINCAM_FIGURES", "runs/experiments")) / "trained_diffusercam"
FIGURES.mkdir(parents=True, exist_ok=True)
logging.getLogger("thincam_jax").setLevel(logging.ERROR)

# %%
# The files
# ---------
#
# `THINCAM_HAND` names the folder `tutorial` of https://github.com/Waller-Lab/DiffuserCam-Tutorial
# (BSD-3-Clause). Neither the PSF nor the capture comes with the package. Without them we take a
# mask of random cells, of which the network knows nothing.

if hand := os.environ.get("THINCAM_HAND"):
    psf = measured.read_image(Path(hand) / "psf_sample.tif")
    capture = measured.read_image(Path(hand) / "rawdata_hand_sample.tif")
    options, upright = measured.Preparation(downsample=8), 1  # the pixels of the training
    near = slice(25, 120), slice(70, 190)  # the hand
else:
    shape, pitch = ((48, 64), 40 * um) if SMALL else ((150, 200), 12 * um)
    camera = tc.LenslessCamera(random_cells(0, 1.2, 60 * um), tc.Sensor(shape, pitch), 2.0)
    scene = tc.ImagePlane(
        sample_image("chelsea", linear=True).mean(-1), distance=250.0, width=240.0
    )
    seen = tc.capture(camera, tc.Scene(scene, 540 * nm)), tc.psf(camera, wavelength=540 * nm)
    noisy = [np.asarray(one) / np.max(one) * 3000 + 40 for one in seen]
    noisy[0] += np.random.default_rng(0).normal(0, 4, shape)
    paths = [FIGURES / f"{name}.npy" for name in ("capture", "psf")]
    for path, counts in zip(paths, noisy, strict=True):
        np.save(path, np.round(counts).astype(np.uint16))
    capture, psf = (measured.read_image(path, bits=12) for path in paths)
    options, upright = measured.Preparation(), -1  # behind a mask a scene is upside down
    near = slice(shape[0] // 4, -shape[0] // 4), slice(shape[1] // 4, -shape[1] // 4)
ready = measured.prepare(psf, capture, background="corner", options=options)

# %%
# Three images
# ------------
#
# The network cleans what `AdmmTV` and `PlugAndPlay` have made. It refuses another camera's PSF.

trained = TrainedReconstruction.load("diffusercam")
methods = {"AdmmTV": tc.AdmmTV(), "PlugAndPlay": tc.PlugAndPlay(), "trained": trained}
images, refused = {}, ""
for name, method in methods.items():
    try:
        found = reconstruct_prepared(ready, method, pixel_noise(ready))
    except ValueError as error:
        refused = str(error)
        print(f"{name}: {refused}")
        continue
    images[name] = found.image()[0, ::upright, ::upright]
    print(f"{name:12s} relative residual {found.relative_residual:.3f}")
assert bool(refused) != bool(hand)

figure, panels = plt.subplots(2, 4, figsize=(12, 4.8), layout="constrained")
white = np.percentile(images["AdmmTV"], 99.8)
for name, (above, below) in zip(("capture", *methods), panels.T, strict=True):
    above.set(title=name, xlabel="x (pixels)", ylabel="y (pixels)")
    if name in images:
        light = np.clip(images[name] / white, 0, 1) ** (1 / 2.2)
        above.imshow(light, cmap="gray", vmin=0, vmax=1)
        below.imshow(light[near], cmap="gray", vmin=0, vmax=1)
    elif name == "capture":
        above.imshow(measured.to_display(ready.capture), cmap="gray")
    else:
        words = refused.split()
        lines = [" ".join(words[n : n + 5]) for n in range(0, len(words), 5)]
        below.text(0.5, 0.5, "\n".join(lines), ha="center", va="center", fontsize=8)
    if name not in images:
        for ax in (above, below) if name in methods else (below,):
            ax.axis("off")
    else:
        below.set(xlabel="the middle, enlarged", xticks=[], yticks=[])
figure.savefig(FIGURES / "images.png", dpi=110)

# %%
# What it makes up
# ----------------
#
# Nobody knows the truth of this capture. Where two images differ, at least one of them is wrong:
# look there before you believe a detail.

last = list(images)[-1]
names = [name for name in images if name != last]
figure, panels = plt.subplots(
    1, len(names), figsize=(4.4 * len(names), 3.2), layout="constrained", squeeze=False
)
for ax, name in zip(panels[0], names, strict=True):
    shown = ax.imshow((images[last] - images[name]) / white, cmap="RdBu", vmin=-0.15, vmax=0.15)
    ax.set(title=f"{last} less {name}", xlabel="x (pixels)", ylabel="y (pixels)")
figure.colorbar(shown, ax=panels, label="parts of white")
figure.savefig(FIGURES / "differences.png", dpi=110)

# %%
# Its card
# --------
#
# The file says what it was trained on, by whose licences.

record = training_record("diffusercam")
print(record["psf"]["source"], record["psf"]["licence"], sep="\n")
for use, pictures in record["images"].items():
    print(f"{use}: {len(pictures)}, {', '.join(sorted({one['licence'] for one in pictures}))}")
