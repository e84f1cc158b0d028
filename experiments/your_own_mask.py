"""A mask of your own
==================

A mask is a sum of products of one factor down and one across. Write these factors, and the
package does the rest: the exact PSF with diffraction, the shadow, the choice of a model,
gradients. Here the mask is a comb of slits at the marks of a Golomb ruler, crossed with itself:
no two pairs of marks are the same distance apart, so that its autocorrelation has no strong
sidelobe. How wide are its slits to be?
"""

import os
from pathlib import Path

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import thincam_jax as tc
from thincam_jax.imaging.metrics import psnr
from thincam_jax.imaging.targets import sample_image
from thincam_jax.lensless.masks import AxisFactors, MaskTerms
from thincam_jax.lensless.masks.halftone import DENSITIES, halftone
from thincam_jax.units import nm, um

SIZE = os.environ.get("THINCAM_SIZE", "full")  # "small": a smaller sensor, in seconds
FIGURES = Path(os.environ.get("THINCAM_FIGURES", "runs/experiments")) / "your_own_mask"
FIGURES.mkdir(parents=True, exist_ok=True)
SHAPE, PITCH = ((600, 720), 3 * um) if SIZE == "full" else ((112, 128), 6 * um)
WAVELENGTH, DISTANCE = 550 * nm, 1.0

# %%
# The class
# ---------
#
# `edges` are the borders of cells along an axis, in ascending order: dark before the first and
# behind the last. `values` holds the transmittance of each cell for each term; a gap is a cell of
# zeros. Anything that is to be differentiated is an array: here the width of the slits.

# Golomb rulers: all differences of two marks are different.
MARKS = (0, 1, 4, 9, 15, 22, 32, 34) if SIZE == "full" else (0, 1, 4, 9, 11)


class GolombSlits(tc.lensless.masks.AbstractFactoredMask):
    """Slits at the marks of a Golomb ruler, crossed with the same slits."""

    slit: jax.Array  # width of a slit, mm
    unit: jax.Array  # distance of the ruler's marks, mm
    centre: jax.Array

    def __init__(self, slit, unit, centre=(0.0, 0.0)):
        self.slit, self.unit = jnp.asarray(slit, float), jnp.asarray(unit, float)
        self.centre = jnp.asarray(centre, float)

    @property
    def extent(self):
        side = MARKS[-1] * self.unit + self.slit
        return side, side

    def terms(self, wavelength=None):
        middles = (jnp.asarray(MARKS) - MARKS[-1] / 2) * self.unit
        edges = jnp.stack([middles - self.slit / 2, middles + self.slit / 2], axis=-1).ravel()
        open_or_dark = jnp.asarray(np.arange(edges.size - 1) % 2 == 0, edges.dtype)
        factors = AxisFactors(edges, jax.lax.complex(open_or_dark, 0 * open_or_dark)[None])
        one = factors.values[0, :1]
        return MaskTerms(one, factors, factors)  # one product, the same on both axes


# %%
# Its PSF
# -------
#
# `separable` is exact. The sampled model is right only as far as samples hold the slits.

mask = GolombSlits(slit=24 * um, unit=48 * um)
camera = tc.LenslessCamera(mask, tc.Sensor(SHAPE, PITCH), DISTANCE)
light = {"wavelength": WAVELENGTH, "pixel_integration": True}
exact = np.asarray(tc.psf(camera, **light))
shadow = np.asarray(tc.psf(camera, model="geometric", **light))
choice = tc.choose_model(camera, wavelength=WAVELENGTH, tolerance=1e-3, pixel_integration=True)
print(f"{choice.method.model} in {choice.method.precision}: {choice.predicted_error:.1e}")
print(f"without diffraction: {np.linalg.norm(shadow - exact) / np.linalg.norm(exact):.0%} off")

figure, panels = plt.subplots(1, 3, figsize=(12, 3.6), layout="constrained")
down, right = (pitch * PITCH / 2 for pitch in SHAPE)
pictures = {"mask": mask.sample(camera.sensor.grid).real, "shadow": shadow, "PSF": exact}
for ax, (name, image) in zip(panels, pictures.items(), strict=True):
    ax.imshow(image, cmap="gray", extent=(-right, right, down, -down))
    ax.set(title=name, xlabel="x (mm)", ylabel="y (mm)")
figure.savefig(FIGURES / "mask_and_psf.png")
assert choice.method.model == "separable"

# %%
# How wide a slit?
# ----------------
#
# Wide slits pass more light, narrow ones finer detail. What counts beside shot noise is
# :math:`|H|` over the root of the light: we take its mean over a band of frequencies. Its slope
# with the slit's width is exact; where it is zero lies the best width.

BAND = (10.0, 35.0)  # cycles/mm


@jax.jit
def signal(slit):
    """Mean of |H|/√H(0) along the axis u over the band, mm."""
    own = tc.LenslessCamera(GolombSlits(slit, 48 * um), camera.sensor, DISTANCE)
    response = jnp.abs(tc.otf(own, **light)[SHAPE[0] // 2])
    u = camera.sensor.grid.u
    inside = (u >= BAND[0]) & (u <= BAND[1])
    return jnp.mean(response, where=inside) / jnp.sqrt(jnp.max(response))


slope = jax.jit(jax.grad(signal))
widths = np.linspace(6 * um, 44 * um, 14)
signals = np.array([signal(w) for w in widths])
slopes = np.array([slope(w) for w in widths])

top = int(np.clip(signals.argmax(), 1, len(widths) - 2))
low, high = widths[top - 1], widths[top + 1]
for _ in range(12):
    middle = (low + high) / 2
    low, high = (middle, high) if slope(middle) > 0 else (low, middle)
best = (low + high) / 2
print(f"best slit: {best / um:.1f} µm of 48 µm")

figure, (first, second) = plt.subplots(1, 2, figsize=(9, 3.4), layout="constrained")
first.plot(widths / um, signals)
second.plot(widths / um, slopes)
for ax, name in ((first, "mean |H|/√H(0) (mm)"), (second, "its slope")):
    ax.axvline(best / um, color="0.6", linestyle=":")
    ax.set(xlabel="width of a slit (µm)", ylabel=name)
figure.savefig(FIGURES / "best_slit.png")
assert signal(best) >= 0.999 * signals.max()

# %%
# Have it made
# ------------
#
# A layout in GDSII is what a mask shop takes (`pip install 'thincam_jax[layout]'`). Parts finer
# than its lithography writes are refused.

drawn = GolombSlits(best, 48 * um)
layout = tc.design.write_gds(FIGURES / "golomb.gds", drawn, smallest_feature=2 * um)
assert layout.stat().st_size > 0

# %%
# A grey plate
# ------------
#
# Lithography opens a cell or leaves it closed. `halftone` spreads the grey of a cosine zone plate
# over such cells, and the exact PSF of these says what that costs. The open fraction is the grey
# plate's amplitude transmittance or its irradiance; PSFs are compared over all pixels, images with
# the photograph after a gain and an offset. The τ is the better of two for each plate.

side, cells, distances = (1.6, (8, 4, 2), (2.0, 6.5)) if SIZE == "full" else (0.64, (16, 8), (6.5,))
sensor = tc.Sensor((128, 144) if SIZE == "full" else (48, 56), 20 * um)
grey = tc.FresnelZoneAperture(160.0 / side, width=side)
plates = {"grey": grey, "binary": tc.FresnelZoneAperture(grey.beta, width=side, profile="binary")}
plates |= {(cell, kind): halftone(grey, cell * um, kind) for kind in DENSITIES for cell in cells}
photograph = sample_image("camera", linear=True)


def psf_and_psnr(plate, distance, reconstructed):
    """The plate's PSF, and the PSNR of the photograph behind it, dB, where it is asked for."""
    own = tc.LenslessCamera(plate, sensor, distance)
    many = isinstance(plate, tc.SampledMask)  # fine cells scatter: many samples of a pixel
    model = tc.PsfMethod("separable", nodes=144) if many else "separable"
    kernel = np.asarray(tc.psf(own, wavelength=WAVELENGTH, object_distance=300.0, model=model))
    if not reconstructed:
        return kernel, np.nan
    plane = tc.ImagePlane(photograph, 300.0, 0.75 * side * 300.0 / distance)
    recording = tc.record(own, tc.Scene(plane, WAVELENGTH), noise=40.0, model=model)
    found = [tc.reconstruct(recording, tc.AdmmTV(tau)) for tau in (0.3, 1.0)]
    grid = tc.Grid(found[0].image.shape[-2:], found[0].pitch)
    truth = np.asarray(plane.sample(grid, magnification=1.0))
    return kernel, max(psnr(np.squeeze(one.image), truth) for one in found)


kernels, errors = {}, {}
for distance in distances:
    for name, plate in plates.items():
        imaged = SIZE == "full" and (name in ("grey", "binary") or name[0] == cells[1])
        kernel, quality = psf_and_psnr(plate, distance, imaged)
        kernels[distance, name] = kernel
        wanted = kernels[distance, "grey"]
        error = np.linalg.norm(kernel - wanted) / np.linalg.norm(wanted)
        errors[distance, name] = error
        image = f", photograph {quality:.1f} dB" if imaged else ""
        print(f"d = {distance} mm, {name}: PSF {error:.0%} off{image}")

for distance in distances:
    coarse, fine = (errors[distance, (cell, "amplitude")] for cell in (cells[0], cells[-1]))
    assert fine < coarse

# %%
# The plate goes to the shop as GDS and, for a look, as PNG, a pixel a cell.

chosen = plates[cells[1], "amplitude"]
tc.design.write_gds(FIGURES / "plate.gds", chosen, smallest_feature=cells[1] * um)
tc.measured.write_image(FIGURES / "plate_cells.png", np.asarray(chosen.amplitude)[None])

figure, panels = plt.subplots(1, 4, figsize=(12, 3.3), layout="constrained")
near = tc.Grid((300, 300), side / 600)  # the middle of the plate, half as wide
parts = {"grey plate": grey.sample(near), f"cells of {cells[1]} µm": chosen.sample(near)}
for ax, (name, image) in zip(panels, parts.items(), strict=False):
    ax.imshow(image, cmap="gray", extent=(-side / 4, side / 4, side / 4, -side / 4), vmin=0, vmax=1)
    ax.set(title=name, xlabel="x (mm)", ylabel="y (mm)")
x, row = np.asarray(sensor.grid.x), sensor.shape[0] // 2
for ax, distance in zip(panels[2:], (distances[0], distances[-1]), strict=True):
    lines = {"grey": ("k", "-"), (cells[1], "amplitude"): ("0.4", "--")}
    lines |= {(cells[1], "irradiance"): ("0.6", "-.")}
    for name, (level, dashes) in lines.items():
        label = name if name == "grey" else f"{name[0]} µm, {name[1]}"
        ax.plot(x, kernels[distance, name][row], color=level, linestyle=dashes, label=label)
    ax.set(xlim=(0, side / 2), xlabel="x on the sensor (mm)", ylabel="PSF (open aperture = 1)")
    ax.set(title=f"d = {distance} mm", ylim=(0, None))
panels[3].legend(fontsize=8)
figure.savefig(FIGURES / "halftone.png", dpi=100)
