"""Which plate makes the best see-through camera?
==============================================

The thesis gives neither the glass of its screen, nor its distance from the lens, nor the film of
its holograms; the defaults of this project are assumptions (5 mm, 10 mm, 16 µm, Δn = 0.02). Here
they are chosen: by gradient, for the least expected error of the reconstruction, within what can
be made, and then simulated in full beside the defaults.
"""

import os
from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import thincam_jax as tc
from thincam_jax import waveguide as wg
from thincam_jax.imaging.metrics import psnr, ssim
from thincam_jax.imaging.targets import middle_square, resize, sample_image
from thincam_jax.units import deg, um
from thincam_jax.waveguide.design.plate import (
    Plate,
    PlateLimits,
    Viewing,
    find_plate,
    judge_plate,
    noise_variance,
)

SIZE = os.environ.get("THINCAM_SIZE", "full")  # "small": fewer pixels, cells and steps
FIGURES = Path(os.environ.get("THINCAM_FIGURES", "runs/experiments")) / "sts_design"
FIGURES.mkdir(parents=True, exist_ok=True)

# %%
# What is asked, and what can be made
# -----------------------------------
#
# Captures of the default plate have 30 dB, and a plate that takes in more light has less shot
# noise beside its signal. The film is a photopolymer: Δn up to 0.03 and 25 µm. Equal limits fix a
# number.

full = SIZE == "full"
sensor = tc.Sensor((440, 440), 4.8 * um) if full else tc.Sensor((44, 44), 48 * um)
cells = (64, 64) if full else (16, 16)
viewing = Viewing(sensor, 550.0, 150.0, cell=150.0 / cells[1], snr_db=30.0)
limits = PlateLimits(
    Plate(5.0, 45 * deg, 8 * um, 0.005, 8.0, 6.0), Plate(5.0, 70 * deg, 25 * um, 0.03, 20.0, 6.0)
)
counts = {"starts": 3, "samples": 64, "steps": 40} if full else {"samples": 16, "steps": 8}
counts = counts if full else counts | {"starts": 1}
numbers = {  # unit and label of each
    "glass_thickness": (1.0, "glass (mm)"),
    "reference_angle": (deg, "recording angle (degrees)"),
    "film_thickness": (um, "film (µm)"),
    "index_modulation": (1.0, "index modulation"),
    "lens_distance": (1.0, "lens to plate (mm)"),
    "focal_distance": (1.0, "sensor to lens (mm)"),
}


def find(limits):
    return find_plate(viewing, limits, key=jax.random.key(0), **counts)


plates = {"default": Plate(), "found": find(limits).plate}
worth = {name: judge_plate(plate, viewing) for name, plate in plates.items()}
for name, plate in plates.items():
    values = (f"{text} {getattr(plate, n) / unit:.4g}" for n, (unit, text) in numbers.items())
    print(f"{name}: error {worth[name].error:.2e}; {'; '.join(values)}")

# %%
# The same as sections of an experiment file of `kind: screen`, for `thincam run`:

best = plates["found"]
sections = f"""\
hologram:
  wavelength: 532 nm
  reference_angle: {float(best.reference_angle) / deg} deg
  thickness: {float(best.film_thickness) / um} um
  index_modulation: {float(best.index_modulation)}
screen:
  glass_thickness: {float(best.glass_thickness)} mm
lens:
  focal_distance: {float(best.focal_distance)} mm
  lens_distance: {float(best.lens_distance)} mm
"""
(FIGURES / "found.yaml").write_text(sections, "utf-8")
print(sections)

# %%
# What each number does
# ---------------------
#
# Each number alone, the others held. Below some 48° light is no longer guided.


def error(plate, number, value):
    return float(judge_plate(replace(plate, **{number: value}), viewing).error)


free = [n for n in numbers if getattr(limits.lower, n) < getattr(limits.upper, n)]
styles = {"default": ("0.6", "-"), "found": ("k", "--")}
figure, axes = plt.subplots(1, len(free), figsize=(3.2 * len(free), 3.4), sharey=True)
for ax, number in zip(axes, free, strict=True):
    unit, label = numbers[number]
    low, high = (float(getattr(end, number)) for end in (limits.lower, limits.upper))
    values = np.linspace(low, high, 21)
    for name, plate in plates.items():
        grey, dashes = styles[name]
        levels = [error(plate, number, value) for value in values]
        ax.semilogy(values / unit, levels, color=grey, linestyle=dashes, label=name)
        own = float(getattr(plate, number))
        ax.semilogy(own / unit, error(plate, number, own), "ko", fillstyle="none")
    ax.set_xlabel(label)
axes[0].set_ylabel("expected error (of the variance)")
axes[0].legend()
figure.tight_layout()
figure.savefig(FIGURES / "slices.png", dpi=110)

# %%
# Simulated in full
# -----------------
#
# Captures with four ghosts and their smear, read with the shot noise of the plate's own light, and
# reconstructed by ADMM with total variation.

page = sample_image("page", linear=True)
pictures = {"camera": sample_image("camera", linear=True)}
pictures["text"] = middle_square(page, round(0.94 * min(page.shape)))
scenes = {name: resize(picture, cells) for name, picture in pictures.items()}
solver = tc.AdmmTV(0.5, iterations=50) if full else tc.Ridge(1.0)
images = {"scene": np.stack(list(scenes.values()))}
reached = {}
for name, plate in plates.items():
    camera = plate.camera(sensor)
    rays = wg.trace(camera, jnp.zeros((1, 2)), object_distance=viewing.object_distance, orders=4)
    centre = jnp.sum(rays.points[:, 0, 1] * rays.weight[:, 0]) / jnp.sum(rays.weight)
    middle = jnp.stack([centre, jnp.zeros_like(centre)])
    plane = wg.ObjectPlane(cells, viewing.object_distance, viewing.object_width, middle)
    system = wg.system_operator(camera, plane, orders=4, samples=6)
    light = worth[name].light
    variance = noise_variance(viewing, light) / light**2
    clean = system(jnp.asarray(images["scene"], light.dtype))
    drawn = jax.random.normal(jax.random.key(0), clean.shape, clean.dtype)
    captures = clean + jnp.sqrt(variance) * drawn
    recording = tc.Recording(captures[None], [system], noise_variance=variance[None])
    images[name] = np.asarray(tc.reconstruct(recording, solver).image, float)
    reached[name] = [psnr(i, s) for i, s in zip(images[name], images["scene"], strict=True)]
    likeness = [ssim(i, s) for i, s in zip(images[name], images["scene"], strict=True)]
    print(f"{name}: PSNR", np.round(reached[name], 2), "dB; SSIM", np.round(likeness, 4))

half = viewing.object_width / 2
figure, rows = plt.subplots(2, 3, figsize=(8.4, 5.8), layout="constrained")
for number, (row, target) in enumerate(zip(rows, scenes, strict=True)):
    for ax, (name, shown) in zip(row, images.items(), strict=True):
        ax.imshow(shown[number], cmap="gray", vmin=0, vmax=1, extent=(-half, half, half, -half))
        level = f", {reached[name][number]:.1f} dB" if name in reached else ""
        ax.set_title(f"{target}, {name}{level}", fontsize="medium")
        ax.set_xlabel("x on the object (mm)", fontsize="small")
figure.savefig(FIGURES / "images.png", dpi=110)

# %%
# What it is worth
# ----------------
#
# More index modulation and a thicker film take in more light and leave less of it to ghosts.

figure, axes = plt.subplots(1, 3, figsize=(10, 3.2), layout="constrained")
light = [float(one.light) * 1e6 for one in worth.values()]
ghosts = [float(one.ghost_light) for one in worth.values()]
labelled = ((light, "light (nm of the spectrum)"), (ghosts, "part of the light in ghosts"))
for ax, (heights, label) in zip(axes, labelled, strict=False):
    ax.bar(list(plates), heights, color=("0.7", "0.2"))
    ax.set_ylabel(label)
places = np.arange(len(scenes))
for offset, grey, (name, levels) in zip((-0.2, 0.2), ("0.7", "0.2"), reached.items(), strict=True):
    axes[2].bar(places + offset, levels, 0.4, color=grey, label=name)
axes[2].set(xticks=places, ylabel="PSNR (dB)")
axes[2].set_xticklabels(list(scenes))
axes[2].legend(loc="lower right")
figure.savefig(FIGURES / "plates.png", dpi=110)

# %%
# Field of view against error
# ---------------------------
#
# A shorter focal length shows more of the room, with fewer pixels for each part of it; at each the
# other numbers are searched for anew.

front = []
for focal in (10.0, 8.0, 6.0, 5.0, 4.0, 3.0) if full else (8.0, 4.0):
    ends = [replace(end, focal_distance=focal) for end in (limits.lower, limits.upper)]
    default = judge_plate(Plate(focal_distance=focal), viewing)
    found = find(PlateLimits(*ends)).error
    front.append((float(default.field_of_view) / deg, float(default.error), found))
fields, default_errors, found_errors = zip(*front, strict=True)
figure, ax = plt.subplots(figsize=(6, 4), layout="constrained")
ax.semilogy(fields, default_errors, "k--s", label="default but for the lens")
ax.semilogy(fields, found_errors, "k-o", label="found at that field of view")
ax.set(xlabel="field of view along y (degrees)", ylabel="expected error (parts of the variance)")
ax.legend()
ax.grid(alpha=0.3)
figure.savefig(FIGURES / "front.png", dpi=110)

# %%
# What this says
# --------------
#
# At the same field of view and the same glass the plate that was found has less error, in the
# expectation and in the simulation. What is modelled is the light, its ghosts and their smear; a
# film that is harder to make, scatters more or shrinks more is not.

assert worth["found"].error < worth["default"].error
assert all(found > default for default, found in zip(*reached.values(), strict=True))
assert all(found < default for _, default, found in front)
