"""A phase mask from noise to a file that can be made
==================================================

A phase mask passes all the light and bends it: its PSF can be sharp lines in place of a shadow.
This script draws a target of contours (PhlatCam: Boominathan et al., IEEE PAMI 42, 1618 (2020)),
finds a relief whose PSF it is by the algorithm of Gerchberg and Saxton, and improves the relief
by gradient with the levels that can be made. It sets both beside a diffuser and Voronoi-Fresnel
lenses, and asks what few levels, broad light and dispersion cost. Lengths are in mm.
"""

import os
from pathlib import Path

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import thincam_jax as tc
from thincam_jax.design import PhotonNoise, PowerLaw, Setup
from thincam_jax.design.phase_mask import (
    MaskSetting,
    cropped_error,
    linear_objective,
    mask_of_phase,
    one_turn,
    refine_mask,
)
from thincam_jax.design.phase_retrieval import contour_target, retrieve_phase
from thincam_jax.design.relief_files import write_height_map, write_stl
from thincam_jax.imaging.metrics import psnr
from thincam_jax.imaging.refractive_index import CauchyIndex, ConstantIndex
from thincam_jax.imaging.targets import resize, sample_image
from thincam_jax.lensless import LightPath
from thincam_jax.lensless.masks import MaskBlank
from thincam_jax.lensless.masks.phase import diffuser, voronoi_fresnel
from thincam_jax.units import nm, um

SIZE = os.environ.get("THINCAM_SIZE", "full")  # "small": a smaller camera, in seconds
FIGURES = Path(os.environ.get("THINCAM_FIGURES", "runs/experiments")) / "phase_mask"
FIGURES.mkdir(parents=True, exist_ok=True)

# %%
# The camera
# ----------
#
# A sensor of 32 × 40 pixels of 6 µm, a mask as large with cells of 2 µm, 2 mm before it. The
# material is a photopolymer, n = 1.504 + 0.0042 µm²/λ² (1.519 at 532 nm). Cells of 2 µm bend green
# light by up to λ/(2 · 2 µm) = 7.6°, 0.27 mm on the sensor.
#
# The error is that of the best linear image, as a part of the scene's variance, for photographs'
# spectrum (f^-2.5), 10,000 electrons a pixel before a white scene and 8 electrons of read noise.
# It counts the sensor's crop: of a scene that covers 26 × 26 pixels, what falls beside it is lost.

pixels, across, steps, rounds = {"full": ((32, 40), 26, 60, 60), "small": ((16, 20), 12, 20, 8)}[
    SIZE
]
pitch, cell, distance, green = 6 * um, 2 * um, 2.0, 532 * nm
polymer = CauchyIndex(1.504, 0.0042e-6)
cells = (3 * pixels[0], 3 * pixels[1])
blank = MaskBlank(cells, cell, polymer)
sensor = tc.Sensor(pixels, pitch)
height, width = cells[0] * cell, cells[1] * cell
object_distance = 300.0
setup = Setup(
    pitch=pitch,
    sensor_width=width,
    object_distance=object_distance,
    object_width=across * pitch * object_distance / distance,
    noise=PhotonNoise(1e4 / (height * width), 8.0),
    prior=PowerLaw(2.5),
)
keys = jax.random.split(jax.random.key(7), 4)


def setting(wavelengths, **given):
    return MaskSetting(
        tc.LenslessCamera(blank.mask(np.zeros(cells)), sensor, distance),
        wavelengths=wavelengths,
        object_distances=[object_distance],
        **{"field_shape": (across, across), **given},
    )


at_green = setting([green])
evaluate = jax.jit(linear_objective)


def error_of(mask, where=at_green):
    """Expected error of the best linear image."""
    return float(evaluate(mask, (where, setup), keys[0]))


# %%
# Four families
# -------------
#
# The target's lines are 9 µm wide. Gerchberg and Saxton's algorithm begins with random phases. The
# refined relief starts from what it found and lowers the expected error itself, whatever PSF that
# makes. Both have eight levels, 1/8 turn of green light apart. A third is refined for a sensor
# whose rims meet: it may put its light at the rim, where a real sensor ends.

fine = blank.grid
target = contour_target(keys[0], fine, feature=60 * um, line_width=1.5 * pitch)
path = LightPath(green, distance, object_distance)
retrieved = retrieve_phase(target, fine, path, shape=cells, key=keys[1], steps=rounds)
eight = one_turn(blank, green, 8)
by_retrieval = mask_of_phase(retrieved.phase, blank, green, eight)
refined = refine_mask(
    linear_objective, by_retrieval, eight, (at_green, setup), key=keys[2], steps=steps
)
rimless = setting([green], field_shape=None)
without_crop = refine_mask(
    linear_objective, by_retrieval, eight, (rimless, setup), key=keys[2], steps=steps
)
lenses = max(3, round(height * width / 0.15**2))
focal_length = 1 / (1 / distance + 1 / object_distance)
masks = {
    "diffuser": diffuser(keys[3], blank, correlation_length=40 * um, rms_slope=0.024),
    "Voronoi-Fresnel": voronoi_fresnel(
        keys[3], blank, sites=lenses, focal_length=focal_length, wavelength=green
    ),
    "contours": by_retrieval,
    "refined": refined.mask,
    "refined without crop": without_crop.mask,
}
errors = {name: error_of(mask) for name, mask in masks.items()}
for name, error in errors.items():
    print(f"{name}: expected error {error:.4f}")

# %%
figure, axes = plt.subplots(2, 5, figsize=(16, 5.4), layout="constrained")
extent = (-width / 2, width / 2, height / 2, -height / 2)
for (above, below), (name, mask) in zip(axes.T, masks.items(), strict=True):
    relief = np.asarray(mask.height) / um
    drawn = above.imshow(relief, cmap="gray", extent=extent)
    figure.colorbar(drawn, ax=above, label="height (µm)", shrink=0.8)
    h = np.asarray(rimless.psfs(mask)[0, 0])
    drawn = below.imshow(h, cmap="gray", extent=extent, vmin=0, vmax=np.quantile(h, 0.995))
    figure.colorbar(drawn, ax=below, label="irradiance (open = 1)", shrink=0.8)
    above.set(title=name)
    below.set(title=f"its PSF: error {errors[name]:.3f}", xlabel="x (mm)")
for ax in axes[:, 0]:
    ax.set(ylabel="y (mm)")
figure.savefig(FIGURES / "families.png", dpi=110)

# %%
# What levels cost
# ----------------
#
# Fewer levels, cheaper masks. The retrieved phase is rounded to them; the refinement knows of them
# throughout.

counts = {"full": (2, 4, 16), "small": ()}[SIZE]
by_levels = {8: (errors["contours"], errors["refined"])}
for count in counts:
    limits = one_turn(blank, green, count)
    rounded = mask_of_phase(retrieved.phase, blank, green, limits)
    better = refine_mask(
        linear_objective, rounded, limits, (at_green, setup), key=keys[2], steps=steps
    )
    by_levels[count] = error_of(rounded), error_of(better.mask)
for count, (before, after) in sorted(by_levels.items()):
    print(f"{count} levels: retrieved {before:.4f}, refined {after:.4f}")
    assert after < before  # at equal levels

# %%
# What broad light and dispersion cost
# ------------------------------------
#
# The phase (n − 1)h/λ falls with the wavelength twice: by 1/λ, and by n. Away from green the PSF
# blurs and gets a bright spot of light that is not bent. That costs also where the PSF of each
# wavelength is known, and more on a grey sensor, which sees their sum. A relief refined for the
# sum gives that back.
#
# Dispersion is judged by the same relief in a material whose index is that of green everywhere.

band = np.linspace(450, 650, {"full": 5, "small": 2}[SIZE]) * nm
white = setting(band, together=True)
for_white = refine_mask(
    linear_objective,
    refined.mask,
    eight,
    (setting(band[::2], together=True), setup),
    key=keys[2],
    steps=steps,
)
constant = ConstantIndex(float(polymer(jnp.asarray(green))))


def without_dispersion(mask):
    return tc.PhaseMask(mask.height, mask.pitch, constant)


each = setting(band)
reliefs = {
    "retrieved": by_retrieval,
    "refined for green": refined.mask,
    "refined for white": for_white.mask,
    "refined for green, no dispersion": without_dispersion(refined.mask),
}
spectra, grey = {}, {}
per_wavelength = jax.jit(
    lambda m: cropped_error(each.psfs(m), setup, each.distance, (across, across))[0]
)
for name, mask in reliefs.items():
    spectra[name] = np.asarray(per_wavelength(mask))
    grey[name] = error_of(mask, white)
    print(
        f"{name}: green {error_of(mask):.4f}, mean over the band {spectra[name].mean():.4f}, "
        f"all at once {grey[name]:.4f}"
    )

# %%
figure, axes = plt.subplots(1, 2, figsize=(12, 3.8), layout="constrained")
order = sorted(by_levels)
for index, (name, style) in enumerate([("retrieved", "k--"), ("refined", "k-")]):
    axes[0].plot(order, [by_levels[n][index] for n in order], style, marker="o", label=name)
axes[0].set(xlabel="levels of height", ylabel="expected error (of the scene's variance)")
axes[0].set_xscale("log", base=2)
axes[0].set_xticks(order, [str(n) for n in order])
styles = dict(zip(reliefs, ("k--", "k-", "C0-", "k:"), strict=True))
for name, values in spectra.items():
    axes[1].plot(band / nm, values, styles[name], label=f"{name}; all at once {grey[name]:.3f}")
axes[1].set(xlabel="wavelength (nm)", ylabel="expected error (of the scene's variance)")
axes[1].set_ylim(top=1.5 * max(map(np.max, spectra.values())))  # above it, the legend
for ax in axes:
    ax.set_ylim(bottom=0)
    ax.grid(alpha=0.3)
    ax.legend()
figure.savefig(FIGURES / "light.png", dpi=110)

# %%
# Images
# ------
#
# The expected error is of scenes of a spectrum. Photographs through the masks, with the same light
# and noise, restored by the same linear method with the best of a few τ for each; and other
# contours and other first phases of Gerchberg and Saxton's algorithm: three seeds.


def photograph(name):
    whole = sample_image(name, linear=True).astype(float)
    whole = whole if whole.ndim == 2 else whole.mean(axis=-1)
    side = min(whole.shape)
    return resize(whole[:side, :side], (120, 120))


names = "chelsea", "camera", "rocket"
plane = tc.ImagePlane(
    np.stack([photograph(name) for name in names]), object_distance, setup.object_width
)
scene = tc.Scene(plane, green)
truths = np.asarray(
    plane.sample(tc.Grid((across, across), plane.width / across), magnification=1.0)
)
lit = tc.Sensor(pixels, pitch, electrons=1e4 / (height * width), full_well=1e8)
noise = tc.PoissonGaussianNoise(8.0)


def restored(mask):
    """Photographs through a mask, and their PSNR, dB."""
    camera = tc.LenslessCamera(mask, lit, distance)
    captures = tc.capture(camera, scene, noise=noise, key=keys[3], model="angular_spectrum")
    cameras = tc.Cameras(
        [camera],
        wavelength=green,
        object_distance=object_distance,
        field_shape=(across, across),
        model="angular_spectrum",
    )
    recording = tc.Recording(captures[None], cameras)
    tried = [np.asarray(tc.reconstruct(recording, tc.Ridge(tau)).image) for tau in TAUS]
    quality = [[psnr(i, t) for i, t in zip(image, truths, strict=True)] for image in tried]
    best = int(np.argmax(np.mean(quality, axis=1)))
    return tried[best], quality[best]


TAUS = {"full": (1.0, 10.0, 100.0, 1000.0), "small": (10.0, 100.0)}[SIZE]
shown = {name: restored(masks[name]) for name in ("contours", "refined", "refined without crop")}
by_seed = [(errors["contours"], errors["refined"], shown["contours"][1], shown["refined"][1])]
for seed in (8, 9):
    first, second, third = jax.random.split(jax.random.key(seed), 3)
    lines = contour_target(first, fine, feature=60 * um, line_width=1.5 * pitch)
    found = retrieve_phase(lines, fine, path, shape=cells, key=second, steps=rounds)
    before = mask_of_phase(found.phase, blank, green, eight)
    after = refine_mask(
        linear_objective, before, eight, (at_green, setup), key=third, steps=steps
    ).mask
    by_seed.append((error_of(before), error_of(after), restored(before)[1], restored(after)[1]))
for before, after, *qualities in by_seed:
    told = [", ".join(f"{value:.1f}" for value in values) for values in qualities]
    print(f"retrieved {before:.4f}: {told[0]} dB; refined {after:.4f}: {told[1]} dB")
print(f"refined without crop: {np.round(shown['refined without crop'][1], 1)} dB")

# %%
columns = {"scene": (truths, None), **shown}
figure, axes = plt.subplots(
    len(names), len(columns), figsize=(11, 2.9 * len(names)), layout="constrained"
)
half = float(plane.width) / 2
for column, (name, (images, quality)) in zip(axes.T, columns.items(), strict=True):
    for number, (ax, image) in enumerate(zip(column, images, strict=True)):
        ax.imshow(image, cmap="gray", vmin=0, vmax=1, extent=(-half, half, half, -half))
        ax.set(title=f"{name}\n{quality[number]:.1f} dB" if quality else name)
for ax in axes[-1]:
    ax.set(xlabel="x on the object (mm)")
for ax in axes[:, 0]:
    ax.set(ylabel="y on the object (mm)")
figure.savefig(FIGURES / "image.png", dpi=110)

# %%
# Files to make it from
# ---------------------
#
# An 8-bit height map with its scale in a JSON file beside it, for grey-scale lithography, and a
# closed solid for two-photon printing.

write_height_map(FIGURES / "height_map.png", refined.mask, wavelength=green)
corner = tc.PhaseMask(refined.mask.height[:24, :24], cell, polymer)
write_stl(FIGURES / "corner.stl", corner)

# %%
# What the text says:

for before, after, *qualities in by_seed:
    assert after < before  # in expected error, and in images
    assert np.mean(qualities[1]) > np.mean(qualities[0])
assert spectra["refined for green"].mean() > errors["refined"]
assert grey["refined for white"] < grey["refined for green"]
