"""What is left of a design once it is made?
=========================================

The masks of 512² cells of 11 µm found for the thesis' sensor, as they are made and mounted: cells
with round corners, cells of a display that leak, reliefs of a few levels, a mask that is tilted,
turned or a little too far away; and the files for them, read back. Each loss is given twice: for an
image made with the PSF as it is (calibrated), and with that of the design. Lengths are in mm.
"""

import os
from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
from tools.photographs import halved, photographs

import thincam_jax as tc
from thincam_jax.design import CellMasks, find_cells
from thincam_jax.design.cell_masks import CellOptics, without_lone_cells
from thincam_jax.design.cell_search import CellSettings
from thincam_jax.design.expected_error import ExpectedError
from thincam_jax.design.objectives import Tolerances
from thincam_jax.design.phase_mask import mask_of_phase, one_turn
from thincam_jax.design.relief_files import read_height_map, write_height_map
from thincam_jax.lensless.masks import MaskBlank
from thincam_jax.lensless.masks.halftone import halftone
from thincam_jax.lensless.masks.written import as_written
from thincam_jax.units import deg, nm, um

SIZE = os.environ.get("THINCAM_SIZE", "full")  # "small": a smaller camera, in seconds
FIGURES = Path(os.environ.get("THINCAM_FIGURES", "runs/experiments")) / "designs_as_made"
FIGURES.mkdir(parents=True, exist_ok=True)
SHIPPED = Path(__file__).resolve().parents[1] / "docs/images"

# %%
# Designs
# -------
#
# Camera, scene and light are those of full_size_design.py, which has found the cells.

full = SIZE == "full"
count, pitch, panel, cell = (1024, 5.5 * um, 512, 11 * um) if full else (64, 22 * um, 32, 44 * um)
lights = {"plenty of light": 2e5, "little light": 2e3} if full else {"plenty of light": 2e6}
settings = CellSettings() if full else CellSettings(8, 1, 2, flips=8)
distance, far, light, width = 6.5, 250.0, 500 * nm, count * pitch
across, middle = 179 * width / 5.632, 64 if full else 16  # cells of the searches below


def setup_of(electrons):
    noise, prior = tc.design.PhotonNoise(electrons, 8.0), tc.design.PowerLaw(2.8)
    return tc.design.Setup(pitch, width, far, across, noise=noise, prior=prior)


def space_of(cells, side=cell, **changed):
    return CellMasks(side, cells, **({"distance": distance, "wavelength": light} | changed))


def shipped(name, electrons):
    if full:
        kind = "" if name == "plenty of light" else "-little"
        return np.asarray(tc.read_mask(SHIPPED / f"full-size-cells{kind}.png", cell).amplitude)
    return np.asarray(find_cells(setup_of(electrons), space_of(panel), settings).masks[0].amplitude)


designs = {name: shipped(name, electrons) for name, electrons in lights.items()}


def used(cells, margin=2):
    """The square of cells about the middle that are not all closed, and a rim."""
    places = np.argwhere(cells)
    half = int(max(abs(2 * places - len(cells) + 1).max() + 1, 2)) // 2 + margin
    half = min(half, len(cells) // 2)
    return cells[len(cells) // 2 - half :, len(cells) // 2 - half :][: 2 * half, : 2 * half]


# %%
# A bench
# -------
#
# Cells in fine parts, their PSFs by exact diffraction, and the expected error over the field. An
# image made with another PSF than its own counts as registered: its brightness, scale and place are
# not held against it.


@jax.jit
def cast(optics, amplitude):
    return optics(amplitude)


@jax.jit
def errors(error, psf, assumed):
    axis = psf if psf.ndim == 2 else psf[1, 1]
    assumed = assumed * (jnp.sum(axis) / jnp.sum(assumed))
    found = error([psf]), error([psf], assumed=[assumed])
    return 10 * jnp.log10(jnp.stack(found))


class Bench:
    def __init__(self, cells, electrons):
        self.cells = used(cells)
        self.split = 24 if len(self.cells) < 128 else 12  # as many as edges need
        self.space = space_of(len(self.cells))
        self.optics = CellOptics(self.space, far, float(pitch))
        grids = [self.optics.grid]
        self.error = ExpectedError(setup_of(electrons), grids, [distance], padding=1.5)
        self.nominal = self.psf(self.cells)
        self.least = float(errors(self.error, self.nominal, self.nominal)[0])

    def moved(self, split=1, **changed):
        space, cells = self.space.replace(**changed), self.optics.cells
        return CellOptics(space, far, float(pitch), cells=cells, split=split)

    def psf(self, parts, **changed):
        """Of cells, or of as many parts of each as are given."""
        return cast(self.moved(len(parts) // len(self.cells), **changed), jnp.asarray(parts, float))

    def losses(self, psf):
        """Of an image made with this PSF, and with that of the design, dB."""
        return np.asarray(errors(self.error, psf, self.nominal)) - self.least

    def written(self, radius, bias):
        """As a writer makes it; lengths in µm, of cells of 11 µm."""
        unit = float(cell) / 11
        mask = tc.SampledMask(self.cells, cell)
        made = as_written(mask, radius=radius * unit, bias=bias * unit, samples=self.split)
        return self.psf(made.amplitude)

    def turned(self, angle, split, points=2):
        """Parts of the mask turned about the axis, by so many points along each side of a part."""
        n, size = len(self.cells), len(self.cells) * split
        at = (np.arange(points * size) + 0.5) / (points * split) - n / 2
        rows = []
        for y in at.reshape(size, points, 1):
            place = np.cos(angle) * y + np.sin(angle) * at, np.cos(angle) * at - np.sin(angle) * y
            index = [np.floor(p + n / 2).astype(int) for p in place]
            inside = np.all([(i >= 0) & (i < n) for i in index], axis=0)
            seen = self.cells[tuple(np.clip(i, 0, n - 1) for i in index)] * inside
            rows.append(seen.reshape(points, size, points).mean((0, 2)))
        return np.stack(rows)

    def tilted(self, angle, strips=16):
        """PSFs at the nodes of the field, of columns of cells each at its own distance.

        From a direction θ the shadow of a column at the height z moves by −zθ.
        """
        x = (np.arange(len(self.cells)) - (len(self.cells) - 1) / 2) * float(cell)
        places = np.polynomial.legendre.leggauss(3)[0] * across / far / 2
        samples = self.optics.samples
        frequency = np.fft.fftfreq(self.optics.cells * samples, float(cell) / samples)
        spectra = [0.0] * 3
        for columns in np.array_split(np.arange(len(x)), min(strips, len(x))):
            height = x[columns].mean() * np.sin(angle)
            optics = self.moved(distance=distance - height)
            spectrum = optics.spectrum(
                jnp.asarray(self.cells * np.isin(np.arange(len(x)), columns))
            )
            for node, place in enumerate(places):
                shift = np.exp(2j * np.pi * frequency * height * place).astype(spectrum.dtype)
                spectra[node] += spectrum * shift
        psfs = jnp.stack([self.optics.power(one) for one in spectra])
        return jnp.broadcast_to(psfs, (3, *psfs.shape))


# %%
# How exactly must it be made and mounted?
# ----------------------------------------

benches = {name: Bench(designs[name], electrons) for name, electrons in lights.items()}
table = {name: {} for name in lights}
for name, bench in benches.items():
    rows, cells = table[name], bench.cells
    for step in (0.05, 0.1, 0.3):
        ends = [bench.losses(bench.psf(cells, distance=distance + s * step)) for s in (-1, 1)]
        rows[f"distance ± {step} mm"] = np.max(ends, axis=0)
    for step in (10, 30):
        moved = bench.psf(cells, wavelength=light + step * nm)
        rows[f"wavelength + {step} nm"] = bench.losses(moved)
    for angle in (0.3, 1, 3):
        rows[f"tilt {angle}°"] = bench.losses(bench.tilted(angle * deg))
    for angle in (0.2, 1, 5):
        rows[f"turned {angle}°"] = bench.losses(bench.psf(bench.turned(angle * deg, bench.split)))
    rows["turned 90°"] = bench.losses(bench.psf(np.rot90(cells)))
    rows["face down"] = bench.losses(bench.psf(cells[:, ::-1]))
    # The image moves along; what it loses is what the sensor cuts off.
    for step in (0.1, 1.0):
        off = jnp.roll(bench.nominal, round(step / float(bench.optics.grid.pitch)), 1)
        rows[f"{step} mm off the centre"] = np.repeat(bench.losses(off)[0], 2)
    for radius in (1, 2, 4):
        rows[f"corners {radius} µm"] = bench.losses(bench.written(radius, 0.0))
    for bias in (-1, -0.5, -0.2, 0.2, 0.5, 1):
        rows[f"edges {bias:+} µm"] = bench.losses(bench.written(1, bias))
    cleared = without_lone_cells(jnp.asarray(cells))
    rows["lone cells lost"] = bench.losses(bench.psf(cleared))
    print(f"{name}: {bench.least:.2f} dB; lost with its own PSF, and with the design's, dB")
    for what, (own, other) in rows.items():
        print(f"  {what}: {own:.2f}, {other:.2f}")

# %%
# Displays
# --------
#
# A display's pixels have gaps, and its closed ones leak. Of 512² pixels few are open, and what
# leaks through all others is more than these pass, unless a stop covers them.

for name, electrons in lights.items():
    setup = setup_of(electrons)
    for stop in (False, True):
        cells = used(designs[name]) if stop else designs[name]
        numbers, least = jnp.asarray(cells.reshape(1, -1) - 0.5), None
        pixels = (None, None), (0.95, None), (0.9, None), (0.87, None), (0.9, 1000), (0.9, 100)
        for fill, contrast in pixels:
            space = space_of(len(cells), fill_factor=fill, contrast=contrast)
            optics = CellOptics(space, far, float(pitch))
            error = ExpectedError(setup, [optics.grid], [distance], padding=1.5)
            psf = cast(optics, space.amplitudes(space.parts(numbers))[0])
            if least is None:
                nominal, least = psf, errors(error, psf, psf)[0]
            own, other = errors(error, psf, nominal) - least
            about = f"fill {fill or 1}" + (f", {contrast}:1" if contrast else "")
            about += ", stop" if stop else ""
            table[name][about] = own, other
            print(f"{name}, display, {about}: {own:.2f}, {other:.2f} dB")

# %%
# Masks found for what can be made
# --------------------------------
#
# Among the middle cells, for plenty of light: a tolerance of the distance, no lone cells, a
# display of low contrast, and reliefs. What each costs where all is exact is its price.

bright = lights["plenty of light"]
setup = setup_of(bright)
kinds = {
    "binary": ({}, {}, None),
    "no lone cells": ({}, {"lone_cells": False}, None),
    "distance ± 0.1 mm": ({}, {}, Tolerances(distance=0.1)),
    "distance ± 0.3 mm": ({}, {}, Tolerances(distance=0.3)),
    "display 100:1": ({"contrast": 100.0, "fill_factor": 0.9}, {}, None),
    "grey": ({"levels": "grey"}, {}, None),
    "0 and π": ({"levels": "binary_phase"}, {}, None),
    "phase": ({"levels": "phase"}, {}, None),
}
found = {}
for kind, (changed, options, tolerances) in kinds.items():
    space = space_of(middle, **changed)
    folder = FIGURES / kind.replace(" ", "_").replace(":", "")
    found[kind] = find_cells(
        setup, space, replace(settings, **options), folder=folder, tolerances=tolerances
    )
    print(f"{kind}: {10 * np.log10(found[kind].error):.2f} dB over its tolerances")
    if changed.get("levels", "binary") == "binary" and "contrast" not in changed:
        bench = Bench(np.asarray(found[kind].masks[0].amplitude), bright)
        cells = bench.cells
        for what, psf in {
            "exact": bench.nominal,
            "0.1 mm nearer": bench.psf(cells, distance=distance - 0.1),
            "0.1 mm farther": bench.psf(cells, distance=distance + 0.1),
            "0.3 mm nearer": bench.psf(cells, distance=distance - 0.3),
            "0.3 mm farther": bench.psf(cells, distance=distance + 0.3),
            "edges +0.5 µm": bench.written(1, 0.5),
        }.items():
            own, other = bench.losses(psf) + bench.least
            print(f"  {what}: {own:.2f}, {other:.2f} dB")

# %%
# Reliefs of 2, 4 and 8 levels, their depth off by some percent, and light of a band: the PSFs of
# 11 wavelengths, their mean.

(relief,) = found["phase"].masks
blank = MaskBlank((middle, middle), cell, 1.52)
optics = CellOptics(space_of(middle), far, float(pitch))
error = ExpectedError(setup, [optics.grid], [distance], padding=1.5)


def etched(levels, depth=1.0, band=0.0):
    """PSF of the relief of so many levels; heights times `depth`, in light of ± `band`."""
    limits = one_turn(blank, light, levels)
    made = mask_of_phase(jnp.angle(relief.amplitude), blank, light, limits)
    made, psfs = made.replace(height=made.height * depth), []
    for shift in np.linspace(-band, band, 11 if band else 1):
        space = space_of(middle, wavelength=light + shift)
        wave = jnp.exp(2j * jnp.pi * made.turns(light + shift))
        psfs.append(cast(CellOptics(space, far, float(pitch), cells=optics.cells), wave))
    return sum(psfs) / len(psfs)


free = cast(optics, relief.amplitude)
best = float(errors(error, free, free)[0])
print(f"any phase: {best:.2f} dB")
for levels in (None, 8, 4, 2):
    exact = etched(levels)
    changes = {"levels": exact}
    changes |= {f"depth {100 * e:+.0f} %": etched(levels, 1 + e) for e in (0.01, 0.03, 0.05)}
    changes |= {f"light of ± {b} nm": etched(levels, band=b * nm) for b in (5, 20)}
    for what, psf in changes.items():
        own, other = errors(error, psf, exact) - best
        table["plenty of light"][f"{levels} levels, {what}"] = own, other
        print(f"{levels or 'all'} levels, {what}: {own:.2f}, {other:.2f} dB")

# %%
# Files
# -----
#
# A layout for lithography, a picture for a display, a grey mask as half-tone cells, and a relief's
# height map: written, read back, and judged again.


def read_layout(path, cells, side=cell):
    """Cells whose middle lies in a rectangle of the layout; y is upwards there."""
    import gdstk

    opened = np.zeros((cells, cells))
    for polygon in gdstk.read_gds(path).top_level()[0].polygons:
        (left, low), (right, high) = np.asarray(polygon.bounding_box()) / 1e3  # mm
        first, last = (round(x / float(side) + cells / 2) for x in (left, right))
        top, bottom = (round(cells / 2 - y / float(side)) for y in (high, low))
        opened[top:bottom, first:last] = 1
    return opened


def decibels(mask, electrons, split=1, fill_factor=None):
    """Error of a mask, in cells that are `split` parts of a cell, or in samples of its PSF."""
    cells = np.asarray(mask.amplitude)
    space = space_of(len(cells) // split, fill_factor=fill_factor)
    optics = CellOptics(space, far, float(pitch), split=split)
    error = ExpectedError(setup_of(electrons), [optics.grid], [distance], padding=1.5)
    psf = cast(optics, jnp.asarray(cells))
    return float(errors(error, psf, psf)[0])


for name, electrons in lights.items():
    mask = tc.SampledMask(designs[name], cell)
    tc.design.write_gds(FIGURES / "cells.gds", mask, smallest_feature=cell)
    tc.measured.write_image(FIGURES / "cells.png", mask.amplitude[None], percentile=100)
    drawn = decibels(mask, electrons)
    layout = tc.SampledMask(read_layout(FIGURES / "cells.gds", panel), cell)
    picture = tc.read_mask(FIGURES / "cells.png", cell)
    for what, read in {"layout": layout, "picture": picture}.items():
        table[name][what] = np.repeat(decibels(read, electrons) - drawn, 2)
        print(f"{name}: {what} read back {table[name][what][0]:+.3f} dB")
(grey,) = found["grey"].masks
for split in (3, 6):
    plate = halftone(grey, cell / split)
    tc.design.write_gds(FIGURES / "grey.gds", plate, smallest_feature=cell / split)
    read = tc.SampledMask(read_layout(FIGURES / "grey.gds", split * middle, cell / split), cell)
    lost = decibels(read, bright, split) - decibels(grey, bright)
    print(f"grey cells as half-tone cells of 1/{split}, layout read back: {lost:+.2f} dB")
made = mask_of_phase(jnp.angle(relief.amplitude), blank, light, one_turn(blank, light, 8))
write_height_map(FIGURES / "relief.png", made, wavelength=light)
read = read_height_map(FIGURES / "relief.png")
waves = [tc.SampledMask(jnp.exp(2j * jnp.pi * m.turns(light)), cell) for m in (made, read)]
print(f"relief read back: {decibels(waves[1], bright) - decibels(waves[0], bright):+.3f} dB")

# %%
# Photographs
# -----------
#
# As in full_size_design.py: captures on all pixels by exact PSFs, images by total variation from
# sums of 2 × 2 pixels. The object is as large on the sensor as at the design's distance.

seen = 8 if full else 2
sensor, coarse = tc.Sensor((count, count), pitch), tc.Sensor((count // 2,) * 2, 2 * pitch)
field = 2 * round(across / far * distance / float(pitch) / 4)

scenes = photographs(seen, (field, field))
truth = halved(scenes)[..., ::-1, ::-1]


def judged(mask, electrons, assumed=None, d=distance):
    """Mean PSNR, dB, of images made with the PSF of the `assumed` mask at the design's distance."""
    plane = tc.ImagePlane(scenes, far, 2 * field * float(pitch) * far / d)
    clean = tc.capture(tc.LenslessCamera(mask, sensor, d), tc.Scene(plane, light))
    noise, counted = tc.PoissonGaussianNoise(8.0), jnp.full((len(scenes), 1, 1), electrons)
    captures = [halved(noise.add(jax.random.key(0), clean, counted))]
    thought = mask if assumed is None else assumed
    camera = tc.LenslessCamera(thought, coarse, d if assumed is None else distance)
    known = {"wavelength": light, "object_distance": far, "field_shape": (field, field)}
    recording = tc.Recording(captures, tc.Cameras([camera], **known))
    image = recording.oriented(tc.reconstruct(recording, tc.AdmmTV()).image)
    image = np.asarray(image, float)  # its brightness is registered, as above
    gain = np.sum(image * truth, axis=(-2, -1)) / np.sum(image**2, axis=(-2, -1))
    error = np.mean((image * gain[:, None, None] - truth) ** 2, axis=(-2, -1))
    return float(np.mean(-10 * np.log10(error)))


name, bench = "plenty of light", benches["plenty of light"]
drawn = tc.SampledMask(bench.cells, cell)
unit = float(cell) / 11
wide = as_written(drawn, radius=unit, bias=0.5 * unit, samples=6)
shown = space_of(len(bench.cells), fill_factor=0.9, contrast=1000)
(shown,) = shown.masks(jnp.asarray(bench.cells.reshape(1, -1) - 0.5))
best = judged(drawn, lights[name])
print(f"photographs, {name}: {best:.2f} dB")
for what, (mask, d) in {
    "distance ± 0.3 mm": (drawn, distance + 0.3),
    "edges +0.5 µm": (wide, distance),
    "fill 0.9, 1000:1, stop": (shown, distance),
}.items():
    own, other = (judged(mask, lights[name], one, d) - best for one in (None, drawn))
    expected = table[name][what]
    print(
        f"  {what}: {own:+.2f}, {other:+.2f} dB; expected {-expected[0]:+.2f}, {-expected[1]:+.2f}"
    )

print(f"  relief of 8 levels: {judged(waves[0], lights[name]) - best:+.2f} dB")

name, bench = list(benches.items())[-1]
drawn, turned = tc.SampledMask(bench.cells, cell), bench.turned(1 * deg, 2, 6)
best, mask = judged(drawn, lights[name]), tc.SampledMask(turned, cell / 2)
own, other = (judged(mask, lights[name], one) - best for one in (None, drawn))
print(f"photographs, {name}: {best:.2f} dB; turned 1° {own:+.2f}, {other:+.2f} dB")

# %%
chosen = [
    "distance ± 0.1 mm",
    "distance ± 0.3 mm",
    "wavelength + 10 nm",
    "tilt 1°",
    "turned 1°",
    "1.0 mm off the centre",
    "corners 2 µm",
    "edges -0.2 µm",
    "edges +0.2 µm",
    "edges +1 µm",
    "lone cells lost",
    "fill 0.9",
    "fill 0.9, 1000:1, stop",
    "fill 0.9, 1000:1",
]
figure, panels = plt.subplots(1, len(lights), figsize=(9, 4.6), sharey=True, layout="constrained")
for ax, name in zip(np.atleast_1d(panels), lights, strict=True):
    for mark, column, label in (("o", 0, "image by its own PSF"), ("x", 1, "by the design's")):
        lost = [max(table[name][what][column], 0.01) for what in chosen]
        ax.plot(lost, range(len(chosen)), mark, color="k", mfc="w", label=label)
    ax.set(xscale="log", xlabel="lost, expected error (dB)", title=name)
    ax.grid(color="0.9")
    ax.axvline(1, color="0.6", lw=0.8)
ax = np.atleast_1d(panels)[0]
ax.set_yticks(range(len(chosen)), chosen)
ax.invert_yaxis()
figure.legend(*ax.get_legend_handles_labels(), loc="outside upper right", ncols=2)
figure.savefig(FIGURES / "as-made.png", dpi=100)

# %%
# The cells for plenty of light, as a writer makes them.

bench = benches["plenty of light"]
drawn = tc.SampledMask(bench.cells, cell)
rows = min(len(bench.cells), 38)
half = rows * float(cell) / 2
extent = (-half, half, half, -half)
parts = {
    "as designed": np.kron(bench.cells, np.ones((12, 12))),
    "corners of 4 µm": as_written(drawn, radius=4 * unit, samples=12).amplitude,
    "edges 1 µm wider": as_written(drawn, radius=unit, bias=unit, samples=12).amplitude,
}
figure, panels = plt.subplots(1, 3, figsize=(9, 3.2), layout="constrained")
for ax, (title, image) in zip(panels, parts.items(), strict=True):
    ax.imshow(image, cmap="gray", extent=extent, interpolation="nearest")
    ax.set(xlabel="x (mm)")
    ax.set_title(title, fontsize=10)
panels[0].set(ylabel="y (mm)")
figure.savefig(FIGURES / "as-made-cells.png", dpi=100)

# %%
# What came out
# -------------
#
# - Measure the PSF of what was made: then edges of ±0.5 µm, a tilt of 3° and a turn cost less than
#   0.15 dB in plenty of light, and next to nothing in little. By the design's PSF the same edges
#   cost 1.4 to 1.5 dB in plenty of light, and a turn of 1° costs 6 dB in little,
#   4.4 dB of photographs.
# - The lens for plenty of light needs its distance: 0.1 dB at ±0.1 mm, 0.8 dB at ±0.3 mm. A search
#   over ±0.3 mm costs 0.3 dB where the distance is right and saves as much at one end: no default.
# - A display's closed cells leak more than its few open ones pass: cover them with a stop.
# - Reliefs of 8 levels are 7 dB better than open and closed cells by expected error; photographs by
#   total variation gain 0.9 dB.
# - Without lone cells, which writers lose first, a mask is 0.8 dB worse.

quoted = {
    ("plenty of light", "distance ± 0.1 mm"): (0.10, 0.17),
    ("plenty of light", "edges +0.5 µm"): (0.13, 1.50),
    ("plenty of light", "fill 0.9, 1000:1, stop"): (0.81, 1.62),
    ("little light", "turned 1°"): (0.01, 6.03),
    ("little light", "edges +1 µm"): (0.00, 0.07),
}
for (name, what), wanted in quoted.items() if full else ():
    assert np.abs(table[name][what] - np.array(wanted)).max() < 0.1, what
