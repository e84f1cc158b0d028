"""Which mask for which scene?
===========================

Masks of every family, all of one width, before one sensor, in equal light: which gives the best
image of a photograph, of text and of points, in much and in little light, and can one know
before? At full size some six minutes of one core. Lengths are in mm.
"""

import os
from pathlib import Path

import jax
import matplotlib.pyplot as plt
import numpy as np
from tools.mask_captures import ComparedMask, Setting
from tools.mask_comparison import ComparedScene, MaskComparison, Tuning, draw_error, draw_images

import thincam_jax as tc
from thincam_jax.design.phase_mask import mask_of_phase, one_turn
from thincam_jax.design.phase_retrieval import contour_target, retrieve_phase
from thincam_jax.imaging.targets import middle_square, sample_image
from thincam_jax.imaging.targets.patterns import point_grid
from thincam_jax.lensless import LightPath
from thincam_jax.lensless.masks import MaskBlank, maximum_length_sequence, random_cells
from thincam_jax.lensless.masks.phase import diffuser, voronoi_fresnel
from thincam_jax.units import nm, um

SIZE = os.environ.get("THINCAM_SIZE", "full")  # "small": large pixels, in seconds
FIGURES = Path(os.environ.get("THINCAM_FIGURES", "runs/experiments")) / "compare_masks"
FIGURES.mkdir(parents=True, exist_ok=True)

# %%
# One sensor
# ----------
#
# It holds the whole shadow of a mask, 0.744 mm wide, from every direction of the scene, 21.7
# degrees across.

pixels, pitch = {"full": (256, 6 * um), "small": (64, 24 * um)}[SIZE]
width, distance, green = 0.744, 2.0, 550 * nm
field = (pixels // 2, pixels // 2)  # pixels of a scene on the sensor
setting = Setting(tc.Sensor((pixels, pixels), pitch), distance, field, width)

# %%
# Masks
# -----
#
# Cells of 24 µm: the square of it over the wavelength is half of the distance. Contours are
# retrieved for an object far away. Zone plates with four phases take four captures, which share
# the photons of one.

key, cells = jax.random.key(0), 24 * um
fine, coarse = MaskBlank((372, 372), 2 * um, 1.52), MaskBlank((186, 186), 4 * um, 1.52)
code = maximum_length_sequence(31)


def contours():
    lines = contour_target(key, coarse.grid, feature=200 * um, line_width=12 * um)
    path = LightPath(*(np.asarray(n, lines.dtype) for n in (green, distance, np.inf)))
    found = retrieve_phase(lines, coarse.grid, path, shape=coarse.shape, key=key)
    return mask_of_phase(found.phase, coarse, green, one_turn(coarse, green))


def zone_plate(phase=0.0, profile="cosine"):
    return tc.FresnelZoneAperture(100.0, phase, width=width, profile=profile)


lenses = {
    "9 lenslets": tc.LensletArray(2.0, 248 * um, (3, 3)),
    "Voronoi-Fresnel": voronoi_fresnel(key, fine, sites=9, focal_length=2.0, wavelength=green),
}
reliefs = {
    "contours": contours(),
    "diffuser": diffuser(key, fine, correlation_length=40 * um, rms_slope=0.016),
}
openings = {
    "MURA": tc.ModifiedUniformlyRedundantArray(31, cells),
    "FlatCam product": tc.SeparableMask(code, code, cells, combine="product"),
    "FlatCam xor": tc.SeparableMask(code, code, cells, combine="xor"),
    "random cells": random_cells(key, width, cells),
}
zones = {"zone plate": zone_plate(), "binary zone plate": zone_plate(profile="binary")}
masks = {}
sorts = {"lenses": lenses, "reliefs": reliefs, "cells": openings, "zones": zones}
for sort, of_sort in sorts.items():
    masks |= {name: ComparedMask((mask,), sort) for name, mask in of_sort.items()}
phases = tuple(zone_plate(phase) for phase in np.arange(4) * np.pi / 2)
masks["zone plate, 4 phases"] = ComparedMask(phases, "zones", "fringe_scanning")
masks["pinhole"] = ComparedMask((tc.Pinhole(48 * um),), "pinhole")

# %%
# Scenes and light
# ----------------
#
# Light is counted as electrons of a pixel of the *bare* sensor before a white scene, so that a
# mask pays for what it blocks; read noise is 3 electrons. The τ of total variation is, for each
# mask and light, the best of five on another scene.

page = sample_image("page", linear=True)
page = middle_square(page, round(0.7 * min(page.shape)))
scenes = {
    "photograph": ComparedScene.of_picture(sample_image("camera", linear=True), field),
    "text": ComparedScene.of_picture(page, field),
    "points": ComparedScene.of_picture(point_grid(field, (9, 9)), field, "flat"),
}
astronaut = ComparedScene.of_picture(sample_image("astronaut", linear=True), field)
tuning = Tuning(astronaut, *{"full": ((0.25, 0.5, 1, 2, 4), 60), "small": ((1,), 30)}[SIZE])
comparison = MaskComparison(
    setting,
    masks,
    scenes,
    tuning,
    wavelength=green,
    band=tuple(n * nm for n in {"full": (450, 500, 550, 600, 650), "small": (500, 600)}[SIZE]),
    light=(1e3, 1e4, 1e5),
    object_distances=(300.0, 20.0),
)
result = comparison.run(lambda step, total: print(step))

# %%
# What comes out
# --------------

print(result.table())
print(result.table("linear"))
draw_error(result).savefig(FIGURES / "error.png", dpi=110)
draw_images(result).savefig(FIGURES / "images.png", dpi=110)

# %%
# What the transfer function says before
# --------------------------------------
#
# An image rises from noise by the detail of :math:`|H|`. Shot noise grows as the root of the light,
# read noise stays: in much light the detail times the root of the light counts, in little times
# the light.

print(result.strength_table())
single = [name for name, mask in masks.items() if len(mask.masks) == 1]
promised = [result.strengths[name].in_shot_noise for name in single]
kept = [result.mean(name) for name in single]
order = np.corrcoef(*(np.argsort(np.argsort(values)) for values in (promised, kept)))[0, 1]
print(f"rank correlation with the images in the strongest light: {order:.2f}")
figure, ax = plt.subplots(figsize=(6, 4), layout="constrained")
ax.semilogx(promised, kept, "ko")
for name, x, y in zip(single, promised, kept, strict=True):
    ax.annotate(name, (x, y), fontsize=8)
ax.set(xlabel="detail × √light, of the open width", ylabel="mean PSNR in much light (dB)")
figure.savefig(FIGURES / "promise.png", dpi=100)

# %%
# Colours and distance
# --------------------
#
# To focus after the capture a mask wants a low cost of the known PSF (it is sharp at both
# distances) and a high one of the wrong PSF (distances can be told apart).

print(result.cost_table())

# %%
# - Few lenses put a third of their light into detail, where a code of 31 × 31 cells puts a
#   thirtieth: the transfer function says who wins before a capture is made.
# - The pinhole rises higher from shot noise than the amplitude codes, which pay with the noise of
#   all the light of a dense scene. In little light its few electrons drown in read noise, where the
#   codes have a hundred times as many.


def psnr_of(name, light):
    return result.scores[result.case(name, "photograph", light)][0]


weak, _, strong = comparison.light
for light in (weak, strong):
    assert max(masks, key=lambda name, at=light: psnr_of(name, at)) in lenses
pinhole, mura = result.strengths["pinhole"], result.strengths["MURA"]
assert pinhole.in_shot_noise > mura.in_shot_noise and pinhole.in_read_noise < mura.in_read_noise
gaps = [psnr_of("pinhole", light) - psnr_of("MURA", light) for light in (weak, strong)]
assert gaps[1] > gaps[0]
assert order > 0.5
