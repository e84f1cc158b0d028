"""A reconstruction trained for your camera
========================================

A lensless camera is known by its PSF. Photographs behind the exact model, with the faults that real
captures have, teach a small network what total variation leaves: no real capture is needed. Here
this is done for a mask of random cells, and judged on captures whose faults nobody tells.
"""

import logging
import os
from dataclasses import replace
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np

import thincam_jax as tc
from thincam_jax.imaging.metrics import align, psnr
from thincam_jax.learn.denoiser.pictures import united
from thincam_jax.learn.imperfections import Imperfections
from thincam_jax.learn.trained import TrainedOptions, TrainedReconstruction
from thincam_jax.learn.trained_lessons import CameraLessons, drawn, photographs
from thincam_jax.learn.trained_training import ReconstructionLessons, train_reconstruction
from thincam_jax.learn.training import TrainingOptions
from thincam_jax.lensless.masks import random_cells
from thincam_jax.studies.intervals import Intervals, PixelSample
from thincam_jax.units import nm, um

SMALL = os.environ.get("THINCAM_SIZE") == "small"
FIGURES = Path(os.environ.get("THINCAM_FIGURES", "runs/experiments")) / "trained_reconstruction"
FIGURES.mkdir(parents=True, exist_ok=True)
PHOTOGRAPHS = Path(os.environ.get("THINCAM_PHOTOGRAPHS", "../shared/data/photographs"))
logging.getLogger("thincam_jax").setLevel(logging.ERROR)  # hot pixels of every drawn capture

# %%
# Camera and pictures
# -------------------
#
# All that is known of the camera is its PSF: with yours, `measured.prepare` and
# `experiments/real_capture.py` read the file. A few photographs are held out.

SENSOR = (36, 44) if SMALL else (96, 128)
if SMALL or not PHOTOGRAPHS.is_dir():
    train, unseen = drawn(0, 4), drawn(1, 2)
else:
    named = photographs(PHOTOGRAPHS / "cc0")
    names = sorted(named)
    train = united([*(named[n] for n in names[5:]), drawn(0, 20)])
    unseen = united([named[n] for n in names[:5]])
pitch = (60 if SMALL else 20) * um


def psf_of(scale):
    """PSF of the mask, or of one that is larger, (1, y, x), of unit sum."""
    mask = random_cells(0, 1.2 * scale, 40 * um * scale, open_fraction=0.1)
    thin = tc.LenslessCamera(mask, tc.Sensor(SENSOR, pitch), 2.0)
    light = np.asarray(tc.psf(thin, wavelength=540 * nm, pixel_integration=True), np.float32)
    return (light / light.sum())[None]


psf = psf_of(1.0)

# %%
# Training
# --------
#
# Each capture has a PSF of its own, up to 2 % larger or smaller than the one we know, turned and
# blurred, light that is not the scene's, saturated and hot pixels, and noise.

faults = Imperfections()
camera = CameraLessons(psf, SENSOR, train, faults)
held_out = replace(camera, pictures=unseen)
amount: dict[str, Any] = {"pool": 80}
if SMALL:
    amount = {"fitted": 1, "pool": 3, "judged": 1, "batch": 2, "crop": 24}
lessons = ReconstructionLessons(camera, judge=held_out, **amount)
options = TrainingOptions(4 if SMALL else 800, 4e-4, check_every=2 if SMALL else 100)
sizes = TrainedOptions(5, (4, 4)) if SMALL else TrainedOptions(widths=(24, 32, 48))
untrained = TrainedReconstruction.create(sizes, psf, key=0)
trained = train_reconstruction(untrained, lessons, options).model
trained.save(FIGURES / "network.thincam")

# %%
# Captures that it has not seen
# -----------------------------
#
# Gain and offset of each image are fitted, as `thincam evaluate` does.

methods = {"AdmmTV": tc.AdmmTV(), "PlugAndPlay": tc.PlugAndPlay(), "trained": trained}
if SMALL:
    del methods["PlugAndPlay"]
scores = {name: [] for name in methods}
shown = []
for number in range(1 if SMALL else 6):
    recording, scene = held_out.drawn(99, number)
    top, left = ((n - m) // 2 for n, m in zip(scene.shape[1:], SENSOR, strict=True))
    truth = scene[:, top : top + SENSOR[0], left : left + SENSOR[1]]
    images = {"truth": truth, "capture": np.asarray(recording.captures[0])}
    for name, method in methods.items():
        image = np.asarray(tc.reconstruct(recording, method).image, np.float32)
        scores[name].append(psnr(image[0], truth[0]))
        images[name] = align(image[0], truth[0])[None]
    shown.append(images)
for name, values in scores.items():
    print(f"{name:12s} {np.mean(values):.2f} dB")
assert all(np.isfinite(values).all() for values in scores.values())

rows = min(3, len(shown))
figure, axes = plt.subplots(
    rows, len(shown[0]), figsize=(2.4 * len(shown[0]), 2 * rows), squeeze=False
)
for row, (images, number) in enumerate(zip(shown, range(rows), strict=False)):
    white = images["truth"].max()
    for ax, (name, image) in zip(axes[row], images.items(), strict=True):
        top_level = image.max() if name == "capture" else white
        ax.imshow(np.clip(image[0] / top_level, 0, 1) ** (1 / 2.2), cmap="gray", vmin=0, vmax=1)
        score = f", {scores[name][number]:.1f} dB" if name in scores else ""
        ax.set_title(f"{name}{score}", fontsize=9)
        ax.set(xlabel="x, pixels")
    axes[rows - 1][0].set(ylabel="y, pixels")
figure.tight_layout()
figure.savefig(FIGURES / "images.png", dpi=110)

figure, ax = plt.subplots(figsize=(5, 3))
for name, values in scores.items():
    ax.plot(range(1, len(values) + 1), values, "o-", label=name)
ax.set(xlabel="capture", ylabel="PSNR, dB")
ax.legend(frameon=False)
figure.tight_layout()
figure.savefig(FIGURES / "scores.png", dpi=110)

# %%
# What it makes up, and how far to trust it
# -----------------------------------------
#
# The network has seen photographs: where a capture tells nothing it draws what photographs have
# there. Captures with truths tell how wrong images are: intervals about their pixels, calibrated on
# some, hold for others, of each method. Here 90 % of the pixels are to be inside, of captures of
# other photographs, at first with the true PSF, then with one that is wrong by 1 to 6 %, which
# nobody told the calibration.

halves = [unseen, unseen]
if (PHOTOGRAPHS / "cc-by-sa").is_dir() and not SMALL:
    named = photographs(PHOTOGRAPHS / "cc-by-sa" / "validation")
    halves = [united([named[n] for n in sorted(named)[part::2]]) for part in range(2)]
right = replace(held_out, faults=replace(faults, scale=0.0, turn=0.0, blur=0.0))
count, judged = (9, 1) if SMALL else (40, 20)


def captured(half, number, misfit=0.0):
    """A recording by a PSF that is larger than the known one by a part, and its truth."""
    true = replace(right, psf=psf_of(1 + misfit), pictures=halves[half])
    recording, scene = true.drawn(half, number)
    top, left = ((n - m) // 2 for n, m in zip(scene.shape[1:], SENSOR, strict=True))
    truth = scene[:, top : top + SENSOR[0], left : left + SENSOR[1]]
    return right.recorded(np.asarray(recording.captures[0])[None]), truth


def image_of(method, recording):
    return np.asarray(tc.reconstruct(recording, method).image, np.float32)


known = [captured(0, number) for number in range(count)]
misfits = (0.0, 0.03) if SMALL else (0.0, 0.01, 0.02, 0.03, 0.06)
others = {misfit: [captured(1, n, misfit) for n in range(judged)] for misfit in misfits}
intervals, inside = {}, {}
print("share of pixels inside, with a PSF right and too small by " + f"{misfits[1:]}; mean width")
for name, method in methods.items():
    pairs = [PixelSample.of(image_of(method, one), truth) for one, truth in known]
    made = intervals[name] = Intervals.calibrated(pairs)
    found = {
        misfit: [PixelSample.of(image_of(method, one), truth) for one, truth in drawn_]
        for misfit, drawn_ in others.items()
    }
    shares = [np.mean([made.coverage(one) for one in some]) for some in found.values()]
    width = np.mean([made.width(one) for one in found[0.0]])
    inside[name] = [made.coverage(one) for one in found[0.0]]
    print(
        f"{name:12s}",
        *(f"{share:.3f}" for share in shares),
        f"{width:.3f}, least {min(inside[name]):.2f}",
    )

# The capture of which half of the others have more pixels inside.
recording, truth = others[0.0][np.argsort(inside["trained"])[judged // 2]]
figure, axes = plt.subplots(len(methods), 4, figsize=(9.6, 2.1 * len(methods)), squeeze=False)
for row, (name, method) in zip(axes, methods.items(), strict=True):
    image = image_of(method, recording)
    lower, upper = intervals[name].of(image)
    line = np.polyfit(truth.ravel(), image.ravel(), 1)
    level = np.polyval(line, truth)
    black, white = np.percentile(image, (1, 99))
    outside = (level < lower) | (level > upper)
    shown = {"truth": level, name: image, "width": upper - lower, "outside": outside}
    for ax, (title, part) in zip(row, shown.items(), strict=True):
        if title in ("width", "outside"):
            shade = part[0] / (white - black) if title == "width" else part[0]
            seen = ax.imshow(shade, cmap="magma" if title == "width" else "gray_r", vmin=0)
            if title == "width":
                figure.colorbar(seen, ax=ax, label="of the range", fraction=0.035)
        else:
            light = np.clip((part[0] - black) / (white - black), 0, 1)
            ax.imshow(light ** (1 / 2.2), cmap="gray", vmin=0, vmax=1)
        ax.set_title(f"{title}: {100 * part.mean():.0f} %" if title == "outside" else title)
        ax.set(xlabel="x, pixels")
    row[0].set(ylabel="y, pixels")
figure.tight_layout()
figure.savefig(FIGURES / "intervals.png", dpi=110)
