"""An image from a camera's raw files
==================================

A lensless camera sees a distant point of light as its PSF. With a picture of that and a raw
capture, the image follows; and the capture itself says whether the PSF is the right one.
"""

import os
from dataclasses import replace
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import PIL.Image

import thincam_jax as tc
from thincam_jax import measured
from thincam_jax.imaging.targets import sample_image
from thincam_jax.lensless.masks import random_cells
from thincam_jax.studies.prepared import pixel_noise, reconstruct_prepared
from thincam_jax.units import nm, um

SMALL = os.environ.get("THINCAM_SIZE") == "small"
FIGURES = Path(os.environ.get("THINCAM_FIGURES", "runs/experiments")) / "real_capture"
FIGURES.mkdir(parents=True, exist_ok=True)

# %%
# The files
# ---------
#
# `THINCAM_HAND` may name the folder `tutorial` of https://github.com/Waller-Lab/DiffuserCam-Tutorial
# (BSD-3-Clause): a hand before a diffuser. Without it we write what a camera with a Bayer mosaic
# (RGGB, 12 bit) would: a PSF, a capture and a dark frame.


def write_raw(path, colours, peak):
    """The mosaic of (3, y, x): dark level 40, `peak` counts above it, 4 counts of noise."""
    counts = 40 + peak * np.asarray(colours) / (np.max(colours) or 1)
    raw = np.array(counts[1])
    raw[::2, ::2], raw[1::2, 1::2] = counts[0, ::2, ::2], counts[2, 1::2, 1::2]
    raw += np.random.default_rng(len(path.name)).normal(0, 4, raw.shape)
    PIL.Image.fromarray(raw.round().clip(0, 4095).astype(np.uint16)).save(path)


if hand := os.environ.get("THINCAM_HAND"):
    files = {"psf": "psf_sample.tif", "capture": "rawdata_hand_sample.tif"}
    paths = {name: Path(hand) / file for name, file in files.items()}
    bits, options, upright = None, measured.Preparation(downsample=8 if SMALL else 4), 1
    shadow = 1.0
else:
    shape, pitch = ((160, 200), 12 * um) if SMALL else ((480, 600), 4 * um)
    camera = tc.LenslessCamera(random_cells(0, 1.2, 60 * um), tc.Sensor(shape, pitch), 2.0)
    picture = np.moveaxis(sample_image("chelsea", linear=True), -1, 0)
    planes = [tc.ImagePlane(colour, distance=250.0, width=240.0) for colour in picture]
    light = [610 * nm, 540 * nm, 460 * nm]
    views = [tc.capture(camera, tc.Scene(p, w)) for p, w in zip(planes, light, strict=True)]
    psfs = [tc.psf(camera, wavelength=w, pixel_integration=True) for w in light]
    paths = {name: FIGURES / f"{name}.tif" for name in ("psf", "capture", "dark")}
    write_raw(paths["psf"], np.stack(psfs), 3600)
    write_raw(paths["capture"], np.stack(views), 3600)
    write_raw(paths["dark"], np.zeros((3, *shape)), 0)
    bits, options = 12, measured.Preparation(bayer="RGGB", demosaicing="superpixel")
    upright = -1  # behind a mask a scene is upside down
    shadow = 1 + camera.distance / 250.0  # the PSF's lamp was far away, the scene is near

# %%
# From files to an image
# ----------------------
#
# `prepare` takes off the dark level, makes colours of the mosaic, marks saturated pixels and writes
# a log of it. The noise is estimated from the capture.

raws = {name: measured.read_image(path, bits=bits) for name, path in paths.items()}
ready = measured.prepare(raws["psf"], raws["capture"], background=raws.get("dark"), options=options)
noise = pixel_noise(ready)
solver = tc.AdmmTV(tau=2.0, iterations=100)
found = reconstruct_prepared(ready, solver, noise)
image = found.image()[:, ::upright, ::upright]  # (channel, y, x), linear
measured.write_image(FIGURES / "image.png", image, ready.log)  # and image.json
print(f"noise {noise.counts:.1f} counts, relative residual {found.relative_residual:.3f}")

figure, panels = plt.subplots(1, 3, figsize=(11, 3.2), layout="constrained")
pictures = {"PSF": ready.psf, "capture": ready.capture, "image": image}
for ax, (name, picture) in zip(panels, pictures.items(), strict=True):
    ax.imshow(measured.to_display(picture), cmap="gray")
    ax.set(title=name, xlabel="x (pixels)", ylabel="y (pixels)")
figure.savefig(FIGURES / "reconstruction.png", dpi=110)

# %%
# Is it the right PSF?
# --------------------
#
# A wrong PSF explains a capture nearly as well, by an image full of artefacts. `check_psf` weighs
# both: it tries turns, mirror images and scales. Here the PSF is made 3 % too small first. The
# check finds that, and 0.8 % more: the mask's shadow is 1 + d/t times as large for a scene at
# t = 250 mm as for the lamp far away that the PSF was taken of.

blocks = max(1, ready.capture.shape[-1] // 100) * options.downsample  # some 100 pixels are enough
coarse = replace(options, downsample=blocks, psf_scale=0.97)
wrong = measured.prepare(raws["psf"], raws["capture"], background=raws.get("dark"), options=coarse)
check = tc.check_psf(tc.Recording([wrong.capture], tc.Psfs(wrong.psf[None])))
print(check)
print(f"of the scene's size {0.97 * check.scale / shadow:.4f} ± {0.97 * check.scale_error:.4f}")

figure, ax = plt.subplots(figsize=(6, 3.2), layout="constrained")
ax.plot(check.scales, check.objectives, "ko-")
ax.axvline(shadow / 0.97, color="0.5", linestyle="--", label="the true scale")
ax.set(xlabel="scale of the PSF", ylabel="lowest objective (best = 1)")
ax.legend()
figure.savefig(FIGURES / "check.png", dpi=110)
assert found.relative_residual < 0.05
assert abs(0.97 * check.scale / shadow - 1) < (0.01 if hand else 4 * check.scale_error)
assert not check.fits
