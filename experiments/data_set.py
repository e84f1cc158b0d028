"""Solvers over a data set
=======================

One picture says little of a solver: between two pictures the PSNR differs by more than between two
solvers. Data sets hold many captures, each with its truth. We write 500 pairs as DiffuserCam's data
set has them, and score two solvers over them by `thincam evaluate`.
"""

import csv
import os
import subprocess
import sys
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import PIL.Image
from scipy.signal import fftconvolve

import thincam_jax as tc
from thincam_jax.imaging.targets import resize, sample_image
from thincam_jax.lensless.masks import random_cells
from thincam_jax.units import nm, um

SMALL = os.environ.get("THINCAM_SIZE") == "small"
FIGURES = Path(os.environ.get("THINCAM_FIGURES", "runs/experiments")) / "data_set"
FIGURES.mkdir(parents=True, exist_ok=True)
COUNT = 6 if SMALL else 500

# %%
# The files
# ---------
#
# Floats in NPY, blue, green, red, upside down; a PSF of 8 bit with four times the pixels; a list of
# the split. Each truth is a part of a photograph, on black. A capture has 40 dB of noise.

rows, columns = shape = (54, 72)
sensor = tc.Sensor((4 * rows, 4 * columns), 12 * um)
camera = tc.LenslessCamera(random_cells(0, 1.62, 60 * um), sensor, 2.0)
fine = np.asarray(tc.psf(camera, wavelength=540 * nm, pixel_integration=True))
light = fine.reshape(rows, 4, columns, 4).sum(axis=(1, 3))
light /= light.sum()
random = np.random.default_rng(0)
names = ("astronaut", "cat", "coffee", "rocket", "retina", "colorwheel", "hubble_deep_field")
photographs = [sample_image(name)[..., :3] for name in names]


def truth_of(number):
    """A square part of a photograph in the middle of the field, (y, x, 3)."""
    photograph = photographs[number % len(photographs)]
    side = random.integers(min(photograph.shape[:2]) // 3, min(photograph.shape[:2]))
    top, left = (random.integers(0, n - side + 1) for n in photograph.shape[:2])
    part = photograph[top : top + side, left : left + side]
    small = [resize(part[..., c], (36, 36)) for c in range(3)]
    truth = np.zeros((*shape, 3))
    truth[9:45, 18:54] = np.clip(np.stack(small, -1), 0, 1)
    return truth


data = FIGURES / "pairs"
for folder in ("diffuser_images", "ground_truth_lensed"):
    (data / folder).mkdir(parents=True, exist_ok=True)
for number in range(1, COUNT + 1):
    truth = truth_of(number)
    whole = np.stack([fftconvolve(truth[..., c], light) for c in range(3)], -1)
    capture = whole[rows // 2 : rows // 2 + rows, columns // 2 : columns // 2 + columns]
    capture += 0.01 * np.sqrt(np.mean(capture**2)) * random.normal(size=capture.shape)
    for folder, image in (("diffuser_images", capture), ("ground_truth_lensed", truth)):
        np.save(data / folder / f"im{number}.npy", image[::-1, :, ::-1].astype(np.float32))
psf = np.repeat((255 * fine / fine.max())[::-1, :, None], 3, axis=2)
PIL.Image.fromarray(psf.round().astype(np.uint8)).save(data / "psf.tiff")
listed = ["name", *(f"im{n}.jpg.tiff" for n in range(1, COUNT + 1))]
(data / "dataset_test.csv").write_text("\n".join(listed))

# %%
# The evaluation
# --------------
#
# In a shell: `thincam evaluate pairs --method admm-tv --method ridge --background 0`. Interrupted,
# the same command goes on.

out = FIGURES / "evaluation"
thincam = (sys.executable, "-m", "thincam_jax.commands.start")
levels = ("--background", "0", "--psf-background", "0")
methods = ("--method", "admm-tv", "--method", "ridge")
subprocess.run([*thincam, "dataset", "info", data], check=True)
subprocess.run([*thincam, "evaluate", data, *methods, *levels, "--out", out, "--quiet"], check=True)

# %%
# What it shows
# -------------
#
# Its page, `report.html`, holds these images and the table. The curves are of all images, each in
# the order of its own PSNR.

with open(out / "table.csv", encoding="utf-8") as file:
    table = list(csv.DictReader(file))
scores = {
    m: np.array([float(r["psnr_db"]) for r in table if r["method"] == m])
    for m in ("admm_tv", "ridge")
}
words, kinds = ("worst", "median", "best"), ("capture", "truth", "admm-tv", "ridge")
figure = plt.figure(figsize=(10.5, 4.6), layout="constrained")
pictures, curves = figure.subfigures(1, 2, width_ratios=(1.9, 1))
for ax, (word, kind) in zip(
    pictures.subplots(3, 4).flat, [(w, k) for w in words for k in kinds], strict=True
):
    ax.imshow(plt.imread(out / "images" / f"{word}-{kind}.png"), cmap="gray")
    ax.set(xticks=[], yticks=[])
    if word == "worst":
        ax.set_title(kind, fontsize=10)
    if kind == "capture":
        ax.set_ylabel(word)
ax = curves.subplots()
for style, (method, values) in zip(("k-", "k--"), scores.items(), strict=True):
    ax.plot(
        np.linspace(0, 100, len(values)), np.sort(values), style, label=method.replace("_", "-")
    )
ax.set(xlabel="images below (%)", ylabel="PSNR (dB)", title=f"{COUNT} pairs")
ax.legend()
figure.savefig(FIGURES / "data_set.png", dpi=110)

# %%
# Image by image
# --------------
#
# What makes an image hard is hard for both. Their difference varies less than their PSNR, and its
# mean is known with a smaller error.

figure, ax = plt.subplots(figsize=(4.2, 4), layout="constrained")
ax.plot(scores["ridge"], scores["admm_tv"], "k.", markersize=3)
ends = [min(map(np.min, scores.values())), max(map(np.max, scores.values()))]
ax.plot(ends, ends, color="0.5", linewidth=1, label="equal")
ax.set(xlabel="PSNR of ridge (dB)", ylabel="PSNR of admm-tv (dB)", aspect="equal")
ax.legend()
figure.savefig(FIGURES / "image_by_image.png", dpi=110)
gains = scores["admm_tv"] - scores["ridge"]
for method, values in scores.items():
    print(f"{method}: mean {values.mean():.2f} dB, from image to image {values.std():.2f} dB")
print(f"admm-tv beside ridge: {gains.mean():.2f} dB, above it in {100 * np.mean(gains > 0):.0f} %")
assert len(gains) == COUNT and gains.mean() > 0
