"""Which mask, if every cell of 11 µm is free?
===========================================

The thesis' sensor has 1024² pixels of 5.5 µm. Here all 262,144 cells of a binary mask are free:
exact diffraction of all of them, the error of the best linear image over the field, and its slope
take 0.6 seconds. What is found stands beside the thesis' methods A and B, the best opening,
MURA, random cells and lens of such cells, at equal light and time, and is judged on photographs
by two reconstructions. Cells found and levels are kept in a folder, so that it can be ended at any
time and goes on from there. Lengths are in mm.
"""

import json
import os
from pathlib import Path

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import scipy.stats
from PIL import Image
from tools.photographs import halved, photographs

import thincam_jax as tc
from thincam_jax.design import CellMasks, find_cells, limit
from thincam_jax.design.cell_masks import CellOptics, drawn_cells
from thincam_jax.design.cell_search import CellSettings
from thincam_jax.design.expected_error import ExpectedError
from thincam_jax.units import nm, um

SIZE = os.environ.get("THINCAM_SIZE", "full")  # "small": a smaller camera, in seconds
FIGURES = Path(os.environ.get("THINCAM_FIGURES", "runs/experiments")) / "full_size_design"
FIGURES.mkdir(parents=True, exist_ok=True)

# %%
# Camera, scene and light
# -----------------------
#
# A sensor 5.63 mm wide, 6.5 mm behind masks as wide; an object 179 mm wide at 250 mm. All captures
# of a design share one exposure: so many electrons of a pixel from each mm² of open aperture before
# a white scene, and 8 electrons of read noise in each.

full = SIZE == "full"
count, pitch, cells, cell = (1024, 5.5 * um, 512, 11 * um) if full else (64, 22 * um, 32, 44 * um)
settings = CellSettings() if full else CellSettings(8, 2, 4, flips=8)
lights = {"plenty of light": 2e5, "some light": 2e4, "little light": 2e3}
lights = lights if full else {"plenty of light": 2e6}
distance, far, light = 6.5, 250.0, 500 * nm
width, across, seen = count * pitch, 179 * count * pitch / 5.632, 8 if full else 2
space = CellMasks(cell, cells, distance=distance, wavelength=light)


def setup_of(electrons):
    noise, prior = tc.design.PhotonNoise(electrons, 8.0), tc.design.PowerLaw(2.8)
    return tc.design.Setup(pitch, width, far, across, noise=noise, prior=prior)


# %%
# Rivals
# ------
#
# One number of each is tuned by the same expected error. Cells of a lens are open where the wave of
# a point would arrive in phase: rings of half a wave, no finer than a cell.

place = (np.arange(cells) - (cells - 1) / 2) * float(cell)
squared = place[:, None] ** 2 + place**2
zones = np.cos(np.pi / (float(light) * distance) * (1 + distance / far) * squared) > 0


def squares(pattern, side):
    """Squares of cells in the middle of a mask."""
    mask = np.kron(pattern, np.ones((side, side)))
    before = (cells - len(mask)) // 2
    return np.pad(mask, (before, cells - len(mask) - before)) > 0


def mura(prime, side):
    return squares(np.asarray(tc.ModifiedUniformlyRedundantArray(prime, 1.0).cells), side)


primes = [p for p in (5, 7, 11, 13, 17, 23, 31, 43, 61, 101, 127, 251, 509) if p <= cells]
rng = np.random.default_rng(1)
rivals = {
    "lens of zones": [zones & (squared < r**2) for r in (0.06, 0.08, 0.1, 0.12, 0.15, 0.18, 0.25)],
    "random cells": [
        drawn_cells(space, rng).reshape(cells, cells) for _ in range(240 if full else 8)
    ],
    "one opening": [squares(np.ones((n, n)), 1) for n in (2, 4, 5, 6, 7, 8, 9, 10, 12, 14, 20, 30)],
    "MURA": [mura(p, n) for p in primes for n in (1, 2, 4, 8, 16) if p * n <= cells],
}


@jax.jit
def quick(mask, optics, error):
    return error([optics(mask)])


def best(masks, optics, error):
    return min((jnp.asarray(m, float) for m in masks), key=lambda m: quick(m, optics, error))


# %%
# The search
# ----------
#
# It begins at random cells, and keeps its state in a folder. Cells that are there as an image are
# taken, not searched; docs/images holds those of docs/measured/full_size.md.


def cells_of(name, electrons):
    file = FIGURES / f"{name}.png"
    if not file.exists():
        folder = FIGURES / name.replace(" ", "_")
        found = find_cells(setup_of(electrons), space, settings, folder=folder)
        print(f"{name}: {found.evaluations} evaluations")
        Image.fromarray(np.uint8(255 * np.asarray(found.masks[0].amplitude))).save(file)
    return jnp.asarray(tc.read_mask(file, cell).amplitude)


designs, phases = {}, (0.0, 1.5 * np.pi) * 2
for name, electrons in lights.items():
    setup, optics = setup_of(electrons), CellOptics(space, far, float(pitch))
    error = ExpectedError(setup, [optics.grid], [distance])
    kinds = {"cells found": cells_of(name, electrons)}
    kinds |= {kind: best(masks, optics, error) for kind, masks in rivals.items()}
    designs[name] = {kind: ([tc.SampledMask(m, cell)], [distance]) for kind, m in kinds.items()}
    plates = (
        ("method B", [25.0, 25.0, 21.0, 21.0], [6.5] * 4),
        ("method A", [25.0] * 4, [5.0, 5.0, 6.5, 6.5]),
    )
    for kind, beta, distances in plates:
        masks = [
            tc.FresnelZoneAperture(b, p, width=width) for b, p in zip(beta, phases, strict=True)
        ]
        designs[name][kind] = masks, distances

# %%
# Expected errors, by exact PSFs
# ------------------------------
#
# On a grid wider than the sensor, which sees of each point of the object another part of the PSF.

sensor, errors = tc.Sensor((count, count), pitch), {}
wide = tc.Sensor((count + count // 6 * 2,) * 2, pitch)
for name, electrons in lights.items():
    for kind, (masks, distances) in designs[name].items():
        cameras = [tc.LenslessCamera(m, wide, d) for m, d in zip(masks, distances, strict=True)]
        psfs = [tc.psf(camera, wavelength=light, object_distance=far) for camera in cameras]
        grids = [wide.grid] * len(psfs)
        error = ExpectedError(setup_of(electrons), grids, distances, padding=1.5)
        errors[name, kind] = 10 * np.log10(float(jax.jit(lambda h, e: e(h))(psfs, error)))
        opened = f", open {float(jnp.mean(masks[0].amplitude)):.4f}" if len(masks) == 1 else ""
        print(f"{name}, {kind}: {errors[name, kind]:.2f} dB{opened}")

# %%
# No shadow has less than the limit; a mask that focuses can have.

plate = tc.design.shots([25.0], distance, [0.0], wavelength=light, width=width)
free = tc.design.DesignSpace(plate, (tc.design.Variable("beta", 5.0, 30.0, (0,)),))
limits = {}
for name, electrons in lights.items():
    setup = setup_of(electrons)
    limits[name] = limit(tc.design.design_problem(tc.design.BayesError(), free, setup, np.eye(1)))
    print(f"{name}: limit of shadows {limits[name].decibels:.2f} dB")

# %%
# Photographs
# -----------
#
# Captures on all pixels, by exact PSFs; reconstructed, by total variation and by plug and play as
# they come, from sums of 2 × 2 pixels, which hold half of the Nyquist band.

solvers = "admm_tv", "pnp"

coarse = tc.Sensor((count // 2,) * 2, 2 * pitch)
field = 2 * round(across / far * distance / float(pitch) / 4)  # of those, centred as they are

scenes = photographs(seen, (field, field))
plane = tc.ImagePlane(scenes, far, 2 * field * float(pitch) * far / distance)
truth = halved(scenes)[..., ::-1, ::-1]


kept = FIGURES / "levels.json"
levels = json.loads(kept.read_text()) if kept.exists() else {}


def judge(solver, name, kind):
    """PSNR of each photograph, dB, that is not known yet."""
    unknown = [n for n in range(len(scenes)) if f"{solver}, {name}, {kind}, {n}" not in levels]
    if not unknown:
        return
    pairs = [*zip(*designs[name][kind], strict=True)]
    counted, noise = lights[name] / len(pairs), tc.PoissonGaussianNoise(8.0)
    keys, captures = jax.random.split(jax.random.key(0), len(pairs)), []
    for key, (mask, d) in zip(keys, pairs, strict=True):
        clean = tc.capture(tc.LenslessCamera(mask, sensor, d), tc.Scene(plane, light))
        captures.append(halved(noise.add(key, clean, jnp.full((len(scenes), 1, 1), counted))))
    optics = tc.Cameras(
        [tc.LenslessCamera(mask, coarse, d) for mask, d in pairs],
        wavelength=light,
        object_distance=far,
        field_shape=(field, field),
    )
    for n in unknown:
        recording = tc.Recording([capture[n] for capture in captures], optics)
        image = np.asarray(recording.oriented(tc.reconstruct(recording, solver).image), float)
        level = -10 * np.log10(np.mean((image - truth[n]) ** 2))
        levels[f"{solver}, {name}, {kind}, {n}"] = float(level)
        kept.write_text(json.dumps(levels, indent=1))


for solver in solvers:
    for kind in designs[[*lights][0]]:
        for name in lights:
            judge(solver, name, kind)


def each(solver, name, kind):
    return np.array([levels[f"{solver}, {name}, {kind}, {n}"] for n in range(len(scenes))])


def gain(solver, name, kind, over):
    """Low end of the 95 % interval over the photographs, mean, and high end, dB (Student's t)."""
    gains = each(solver, name, kind) - each(solver, name, over)
    half = scipy.stats.t.ppf(0.975, len(gains) - 1) * gains.std(ddof=1) / len(gains) ** 0.5
    return gains.mean() + half * np.array([-1, 0, 1])


for solver in solvers:
    for name in lights:
        for kind in designs[name]:
            low, middle, high = gain(solver, name, "cells found", kind)
            print(
                f"{solver}, {name}: PSNR by {kind} {each(solver, name, kind).mean():.2f} dB; "
                f"cells found {middle:+.2f} dB ({low:+.2f} to {high:+.2f})"
            )

# %%
marks, order = dict(zip(lights, ("ws", "^", "ko"), strict=False)), [*designs[[*lights][0]]]
figure, panels = plt.subplots(1, 3, figsize=(10, 3.6), sharey=True, layout="constrained")
for name, mark in marks.items():
    rows = np.arange(len(order))
    style = {"color": "0.6", "mec": "k"} if mark == "^" else {"mec": "k"}
    panels[0].axvline(limits[name].decibels, color="k" if mark == "ko" else "0.6", lw=0.8)
    panels[0].plot([errors[name, kind] for kind in order], rows, mark, label=name, **style)
    for ax, solver in zip(panels[1:], solvers, strict=True):
        means = [each(solver, name, kind).mean() for kind in order]
        ax.plot(means, rows, mark, label=name, **style)
panels[0].set_yticks(range(len(order)), order)
panels[0].invert_yaxis()
panels[0].set(xlabel="expected error (dB); lines: limit of shadows")
panels[1].set(xlabel="PSNR by total variation (dB)")
panels[2].set(xlabel="PSNR by plug and play (dB)")
for ax in panels:
    ax.grid(axis="y", color="0.9")
figure.legend(*panels[1].get_legend_handles_labels(), loc="outside lower center", ncols=3)
figure.savefig(FIGURES / "full-size.png", dpi=100)

# %%
# A mask and its PSF
# ------------------
#
# What is found, for the most light: rings about centres, each of them a lens that casts a point.

bright = [*lights][0]
(mask,), _ = designs[bright]["cells found"]
camera, half = tc.LenslessCamera(mask, sensor, distance), min(0.6, width / 2)
psf = tc.psf(camera, wavelength=light, object_distance=far)
extent = (-width / 2, width / 2, width / 2, -width / 2)
figure, panels = plt.subplots(1, 3, figsize=(9, 3.3), layout="constrained")
for ax in panels[:2]:
    ax.imshow(np.asarray(mask.amplitude), cmap="gray", extent=extent, interpolation="nearest")
panels[1].set(xlim=(-half, half), ylim=(half, -half))
middle = panels[2].imshow(np.sqrt(psf), cmap="gray", extent=extent)
panels[2].set(xlim=(-half, half), ylim=(half, -half))
titles = "cells, open ones white", "their middle", "PSF there"
for ax, title in zip(panels, titles, strict=True):
    ax.set(xlabel="x (mm)")
    ax.set_title(title, fontsize=10)
panels[0].set(ylabel="y (mm)")
figure.colorbar(middle, ax=panels[2], label="√ of irradiance, open mask 1")
figure.savefig(FIGURES / "full-size-mask.png", dpi=100)

# %%
# How well must it be made?
# -------------------------
#
# The same cells at another distance and in another light, each reconstructed by its own PSF.

changes = {"distance": (0.1, 0.3, 1.0), "wavelength": (10 * nm, 30 * nm)}
for name, steps in changes.items():
    for step in steps:
        moved = [space.replace(**{name: getattr(space, name) + s * step}) for s in (-1, 1)]
        losses = []
        for one in moved:
            optics, d = CellOptics(one, far, float(pitch)), float(one.distance)
            error = ExpectedError(setup_of(lights[bright]), [optics.grid], [d])
            value = 10 * np.log10(float(quick(mask.amplitude, optics, error)))
            losses.append(value - errors[bright, "cells found"])
        print(f"{name} ± {float(step):g} mm: {losses[0]:+.2f} and {losses[1]:+.2f} dB")

# %%
# What came out
# -------------
#
# - In plenty of light the cells found are 6.3 dB below methods A and B in expected error and 4.9 dB
#   below the best opening; photographs gain 6.2 and 4.6 dB by plug and play.
# - One small lens of rings does it: it is 2.1 dB better than a Fresnel lens of such cells.
# - In little light random cells are within 0.3 dB: the limit leaves no room.

quoted = {
    ("plenty of light", "cells found"): -23.2,
    ("some light", "cells found"): -17.9,
    ("little light", "cells found"): -13.7,
}
for key, value in quoted.items() if full else ():
    assert abs(errors[key] - value) < 0.2
for other, least in {"method B": 1.5, "random cells": 0.5}.items() if full else ():
    assert gain("admm_tv", bright, "cells found", other)[0] > least
for name in lights if full else ():
    assert min(gain("pnp", name, "cells found", kind)[0] for kind in order[1:]) > 0.4
