"""Which mask for which light?
===========================

Ten kinds of mask before the thesis' sensor of 1024² pixels of 5.5 µm, each by its best member of
11 µm cells, in four lights for a flat scene, in two for depths of 150 mm to 1 m that are not
refocused and for a narrow field: `recommend` judges each by exact diffraction. Photographs, by
total variation as it comes, say whether the order holds. Lengths are in mm.
"""

import json
import os
from pathlib import Path

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import scipy.stats
from tools.photographs import halved, photographs

import thincam_jax as tc
from thincam_jax.design import CellMasks, limit, recommend
from thincam_jax.design.recommendation import KINDS, MaskJudge, zone_plates
from thincam_jax.units import nm, um

SIZE = os.environ.get("THINCAM_SIZE", "full")  # "small": a smaller camera, in seconds
FIGURES = Path(os.environ.get("THINCAM_FIGURES", "runs/experiments")) / "atlas_of_masks"
FIGURES.mkdir(parents=True, exist_ok=True)

# %%
# Lights, depths and fields
# -------------------------
#
# All captures of a kind share one exposure: so many electrons of a pixel from each mm² of open
# aperture before a white scene, and 8 electrons of read noise in each. An object 179 mm wide at
# 250 mm is 40° of field.

full = SIZE == "full"
count, pitch, cells, cell = (1024, 5.5 * um, 512, 11 * um) if full else (64, 22 * um, 32, 44 * um)
lights = (2e2, 2e3, 2e4, 2e5) if full else (2e6,)
distance, far, wave, width = 6.5, 250.0, 500 * nm, count * pitch
space = CellMasks(cell, cells, distance=distance, wavelength=wave)
flat, deep, whole = (far,), (150.0, far, 1000.0), 179 * count * pitch / 5.632
views = {"flat": (flat, whole, lights), "150 mm to 1 m": (deep, whole, lights[1::2])}
views["flat, a third of the field"] = flat, whole / 3, lights[1::2]
if not full:
    views = {"flat": (flat, whole, lights), "150 mm to 1 m": (deep, whole, lights)}


def setup_of(electrons, across=whole):
    noise, prior = tc.design.PhotonNoise(electrons, 8.0), tc.design.PowerLaw(2.8)
    return tc.design.Setup(pitch, width, far, across, noise=noise, prior=prior)


found, limits = {}, {}
for view, (depths, across, several) in views.items():
    for electrons in several:
        setup = setup_of(electrons, across)
        every = recommend(setup, space, depths=depths)
        found[view, electrons] = {one.kind: one for one in every}
        plate = tc.design.shots([25.0], distance, [0.0], wavelength=wave, width=width)
        free = tc.design.DesignSpace(plate, (tc.design.Variable("beta", 5.0, 30.0, (0,)),))
        problem = tc.design.design_problem(tc.design.BayesError(), free, setup, np.eye(1))
        limits[view, electrons] = limit(problem).decibels
        print(f"\n{view}, {electrons:g} electrons: limit {limits[view, electrons]:.2f} dB\n{every}")

record = {
    f"{view}, {electrons:g}": {kind: [one.member, one.decibels] for kind, one in kinds.items()}
    for (view, electrons), kinds in found.items()
}
(FIGURES / "atlas.json").write_text(json.dumps(record, indent=1, ensure_ascii=False))

# %%
# The atlas
# ---------
#
# Dark is good. The numbers are expected errors in dB; the first row is the least of any shadow,
# which masks that focus can pass.

order = [kind for kind in KINDS if all(kind in kinds for kinds in found.values())]
rows = ["limit of shadows", *order]
sizes = [len(several) for *_, several in views.values()]
figure, panels = plt.subplots(
    1, len(views), figsize=(10, 4.4), sharey=True, layout="constrained", width_ratios=sizes
)
for ax, view in zip(panels, views, strict=True):
    several = views[view][-1]
    values = np.array(
        [
            [limits[view, e] for e in several],
            *([found[view, e][kind].decibels for e in several] for kind in order),
        ]
    )
    ax.imshow(values, cmap="gray", aspect="auto", vmin=-36, vmax=-2)
    for (row, column), value in np.ndenumerate(values):
        best = row and value == values[1:, column].min()
        ax.text(
            column,
            row,
            f"{value:.1f}",
            ha="center",
            va="center",
            color="w" if value < -19 else "k",
            weight="bold" if best else "normal",
        )
    ax.set_xticks(range(len(several)), [f"{e:,.0f}" for e in several])
    ax.set_title(view, fontsize=10)
    ax.set(xlabel="electrons/mm²")
panels[0].set_yticks(range(len(rows)), rows)
figure.savefig(FIGURES / "atlas.png", dpi=100)

# %%
# The masks
# ---------

bright, dim = ("flat", lights[-1]), ("flat", lights[(len(lights) - 1) // 2])
size = float(width) / 2
figure, panels = plt.subplots(
    2, 5, figsize=(10, 4.8), sharex=True, sharey=True, layout="constrained"
)
for ax, kind in zip(panels.ravel(), order, strict=False):
    amplitude = found[dim][kind].amplitudes[0]
    shown = np.angle(amplitude) * (abs(amplitude) > 0) if np.iscomplexobj(amplitude) else amplitude
    ax.imshow(shown, cmap="gray", extent=(-size, size, size, -size))
    ax.set_title(kind, fontsize=10)
for ax in panels[1]:
    ax.set(xlabel="x (mm)")
for ax in panels[:, 0]:
    ax.set(ylabel="y (mm)")
figure.savefig(FIGURES / "masks.png", dpi=100)

# %%
# Two pitches once more
# ---------------------
#
# Zone plates in the four captures of method B, by β and distance: how much better is the best pair
# than the thesis' 25 and 21 rad/mm² at 6.5 mm, and how much worse the worst?


def pair(judge, moved, one, other):
    """Expected error of two pitches, dB."""
    plates = zone_plates((one, one, other, other), (0.0, 1.5 * np.pi) * 2, moved)
    return 10 * np.log10(judge(plates))


pitches, distances = ((8.0, 15.0, 25.0, 40.0), (3.25, 6.5)) if full else ((25.0,), (6.5,))
for view in [*views][:2]:
    for electrons in views[view][-1][-2:]:
        depths, across, _ = views[view]
        setup, every = setup_of(electrons, across), {}
        thesis = pair(MaskJudge(setup, space, depths), space, 25.0, 21.0)
        for away in distances:
            moved = space.replace(distance=away)
            judge = MaskJudge(setup, moved, depths)
            for one in pitches:
                for part in (0.6, 0.84, 1.0):
                    every[one, part * one, away] = pair(judge, moved, one, part * one) - thesis
        least, most = min(every, key=every.get), max(every, key=every.get)
        for name, (one, other, away) in (("best", least), ("worst", most)):
            print(
                f"{view}, {electrons:g} electrons: {name} {one:g} and {other:g} rad/mm² at {away:g}"
                f" mm, {every[one, other, away]:+.2f} dB beside the thesis' pair ({thesis:.2f} dB)"
            )

# %%
# Photographs
# -----------
#
# Captures on all pixels, each photograph reconstructed by itself from sums of 2 × 2 of them. The
# cells found by full_size_design.py for little light and for plenty stand beside the kinds, in all
# lights. Levels are kept in a file, by mask, light, photograph and seed of the noise.

sensor, coarse = tc.Sensor((count, count), pitch), tc.Sensor((count // 2,) * 2, 2 * pitch)
field = 2 * round(whole / far * distance / float(pitch) / 4)

scenes = photographs(24 if full else 2, (field, field))
plane = tc.ImagePlane(scenes, far, 2 * field * float(pitch) * far / distance)
truth = halved(scenes)[..., ::-1, ::-1]

kept, seeds = FIGURES / "levels.json", range(3 if full else 2)
levels = json.loads(kept.read_text()) if kept.exists() else {}
chosen = "random cells", "lenses of zones", "method B", "phase lenses", "MURA", "one opening"
judged_in, designs = (lights[1], lights[3], lights[2]) if full else lights, {}
for electrons in judged_in:
    designs |= {(kind, electrons): found["flat", electrons][kind].masks for kind in chosen}
if full:
    folder = Path(__file__).resolve().parents[1] / "docs/images"
    for word, name in (("2,000", "-little"), ("200,000", "")):
        mask = tc.read_mask(folder / f"full-size-cells{name}.png", cell)
        chosen = f"cells found for {word}", *chosen
        designs |= {(chosen[0], electrons): [mask] for electrons in judged_in}


def key_of(kind, electrons, number, seed):
    return f"{kind}, {electrons:g}, {number}, {seed}"


psfs = {}


class Kept(tc.Cameras):
    """Cameras that compute their PSFs once, which takes longer than an image."""

    def own_psf(self, number, field, distance):
        camera = self.cameras[number]
        key = id(camera), field
        if key not in psfs:
            psfs[key] = camera, super().own_psf(number, field, distance)
        return psfs[key][1]


def judge_all(kind, electrons):
    """PSNR of each photograph and seed, dB, that is not known yet."""
    pairs = [(seed, n) for seed in seeds for n in range(len(scenes))]
    pairs = [(s, n) for s, n in pairs if key_of(kind, electrons, n, s) not in levels]
    if not pairs:
        return
    masks, noise, captures = designs[kind, electrons], tc.PoissonGaussianNoise(8.0), {}
    optics = Kept(
        [tc.LenslessCamera(mask, coarse, distance) for mask in masks],
        wavelength=wave,
        object_distance=far,
        field_shape=(field, field),
    )
    clean = [
        tc.capture(tc.LenslessCamera(mask, sensor, distance), tc.Scene(plane, wave))
        for mask in masks
    ]
    exposure = jnp.full((len(scenes), 1, 1), electrons / len(masks))
    for seed in {seed for seed, _ in pairs}:
        keys = jax.random.split(jax.random.key(seed), len(masks))
        captures[seed] = [
            halved(noise.add(key, one, exposure)) for key, one in zip(keys, clean, strict=True)
        ]
    for seed, n in pairs:
        recording = tc.Recording([capture[n] for capture in captures[seed]], optics)
        image = np.asarray(recording.oriented(tc.reconstruct(recording, tc.AdmmTV()).image), float)
        level = -10 * np.log10(np.mean((image - truth[n]) ** 2))
        levels[key_of(kind, electrons, n, seed)] = float(level)
        kept.write_text(json.dumps(levels, indent=1))


for electrons in judged_in:
    for kind in chosen:
        judge_all(kind, electrons)


def each(kind, electrons):
    """Levels by seed and photograph, dB."""
    numbers = range(len(scenes))
    return np.array([[levels[key_of(kind, electrons, n, s)] for n in numbers] for s in seeds])


def gain(kind, electrons, over):
    """Mean, half of the 95 % interval over photographs (Student's t), and spread over seeds, dB."""
    gains = each(kind, electrons) - each(over, electrons)
    means = gains.mean(0)
    half = scipy.stats.t.ppf(0.975, len(means) - 1) * means.std(ddof=1) / len(means) ** 0.5
    return means.mean(), half, gains.mean(1).std(ddof=1)


print(f"{len(scenes)} photographs, {len(seeds)} seeds of the noise")
for electrons in sorted(judged_in):
    for kind in chosen:
        line = f"{electrons:g} electrons: {kind} {each(kind, electrons).mean():.2f} dB"
        for over in ("random cells", "method B"):
            mean, half, spread = gain(kind, electrons, over)
            line += f"; over {over} {mean:+.2f} ± {half:.2f}, seeds {spread:.2f}"
        print(line)

# %%
# What came out
# -------------
#
# - A lens of phases is best in every light, 0.8 to 14 dB below the limit of shadows.
# - Of masks that are open and closed a lens of zones leads in plenty of light, random cells lead
#   in little; method B is nowhere the best.
# - The thesis' pair of pitches is within 0.4 dB of the best.
# - On photographs cells that are searched lead all that are open and closed, by 0.3 dB over random
#   cells in little light and 1.3 dB over a lens of zones in plenty.

quoted = {  # dB
    ("flat", 2e3): {"phase lenses": -19.4, "random cells": -13.3, "method B": -13.0},
    ("flat", 2e5): {"phase lenses": -35.0, "lenses of zones": -21.1, "method B": -16.7},
    ("150 mm to 1 m", 2e5): {"phase lenses": -29.2, "method B": -12.3},
}
for key, values in quoted.items() if full else ():
    for kind, value in values.items():
        assert abs(found[key][kind].decibels - value) < 0.2
leads = {("2,000", 2e3): "random cells", ("200,000", 2e5): "lenses of zones"}
for (word, electrons), over in leads.items() if full else ():
    mean, half, _ = gain(f"cells found for {word}", electrons, over)
    assert mean > half
