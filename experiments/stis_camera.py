"""A screen that is a lensless camera
==================================

The thesis proposes (section 5.4) to take the lens out of the see-through screen: a mask and a
bare sensor behind the top hologram make it thinner. It gives no equations. What does such a
camera see, what do the screen's ghosts do to it, and how well does an image come back?
"""

import os
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import thincam_jax as tc
from thincam_jax import waveguide as wg
from thincam_jax.imaging.metrics import psnr
from thincam_jax.imaging.operators import CropConvolution
from thincam_jax.imaging.operators.crop_convolution import kernel_grid
from thincam_jax.imaging.operators.low_rank import low_rank_psf
from thincam_jax.imaging.targets import resize, sample_image
from thincam_jax.units import deg, nm, um
from thincam_jax.waveguide.screen_to_sensor import ghost_images, ghost_psfs

SIZE = os.environ.get("THINCAM_SIZE", "full")  # "small": fewer and larger pixels
FIGURES = Path(os.environ.get("THINCAM_FIGURES", "runs/experiments")) / "stis_camera"
FIGURES.mkdir(parents=True, exist_ok=True)

# %%
# The camera
# ----------
#
# The plate and its holograms are those of the camera with a lens (5 mm of n = 1.5, a film of 16 µm
# with Δn = 0.02, 532 nm at 61.2°; assumed but for the last two). The mask stands half a millimetre
# behind the plate, the sensor d = 6.5 mm behind the mask. `SeeThroughCamera` describes both
# cameras: here its pinhole is the middle of the mask.

count, field_count, points, pitch, width, beta = {
    "full": (96, 48, 7, 44 * um, 3.2, 20.0),
    "small": (48, 24, 5, 86 * um, 2.6, 13.0),
}[SIZE]
distance, gap, orders = 6.5, 0.5, 4  # mm, mm, ghosts
iterations = {"full": 200, "small": 40}[SIZE]
SNR = 40  # of the captures' contrast, dB
far, near = 550.0, 250.0  # objects before the plate, mm
hologram = wg.VolumeHologram.record(
    532 * nm, 0.0, 61.2 * deg, index=1.5, thickness=16 * um, index_modulation=0.02
)
screen = wg.Screen(hologram, 5.0, 1.5)
sensor = tc.Sensor((count, count), pitch)
field = (field_count, field_count)  # samples of the object's first image
camera = wg.SeeThroughCamera(screen, sensor, distance, gap)

# %%
# Rays
# ----
#
# A point of the object (right) sends light to the whole mask. Two rays of each order are drawn, to
# the edges of the mask, as if from a ghost behind the object. On the axis the first ghost is 30.4
# mrad from the image, 36 pixels of 5.5 µm. (A pixel sees points 18.2 mm apart, 32 mrad at the
# image's distance; but the ghost's is 600 mm, not 567.)

axis = ghost_images(camera, jnp.zeros((1, 2)), far, orders)
places, sources = np.asarray(axis.places)[:, 0, 0], np.asarray(axis.distance)[:, 0]
apart = 1e3 * (places[1] - places[0]) / distance
print(f"first ghost {apart:.1f} mrad away, sources at {np.round(sources)} mm")
front = distance + gap + 5.0  # z of the plate's front surface
figure, ax = plt.subplots(figsize=(10, 4), layout="constrained")
for order, grey in enumerate(("0.0", "0.4", "0.65")):
    for m in (-width / 2, width / 2):
        # The ray's direction is that to the order's virtual source.
        slope = -places[order] / distance - m / sources[order]
        pixel = jnp.asarray([[-distance * slope, 0.0]])
        ray = wg.trace(camera, pixel, object_distance=far, orders=orders)
        bounce = 5.0 * float(ray.guided[0, 1]) / np.sqrt(1.5**2 - float(ray.guided[0, 1]) ** 2)
        inside = slope / np.sqrt(1 + slope**2) / 1.5
        crossing = 5.0 * inside / np.sqrt(1 - inside**2)
        top = m + gap * slope + crossing
        zig = [
            (distance + gap + (0 if n % 2 == 0 else 5), top + (n + 1) * bounce) for n in range(9)
        ]
        line = [(0, m - distance * slope), (distance, m), (distance + gap, m + gap * slope)]
        line += [(front, top), *zig[: 2 * order + 1]]
        end = line[-1][1]
        line += [(front, end + crossing), (front + 14, end + crossing + 14 * slope)]
        label = f"order {order}" if m < 0 else None
        ax.plot(*zip(*line, strict=True), color=grey, linewidth=0.9, label=label)
ax.axvspan(distance + gap, front, color="0.92")
ax.plot([distance] * 2, [-width / 2, width / 2], color="k", linewidth=4, label="mask")
ax.plot([0, 0], [-count * pitch / 2, count * pitch / 2], color="0.5", linewidth=4, label="sensor")
ax.set(xlabel="z from the sensor (mm)", ylabel="y (mm), down the screen", xlim=(-0.5, front + 14))
ax.invert_yaxis()
ax.legend(loc="lower left", fontsize="small")
figure.savefig(FIGURES / "rays.png", dpi=110)

# %%
# The PSF, order by order
# -----------------------
#
# Each order casts the mask's shadow, with its diffraction, at its own place, in its own colour and
# from its own distance: `ghost_images` finds these, `ghost_psfs` adds the shadows up. The mask's
# PSF is a function of wavelength, distance and place; any mask will do.


def plate(centre):
    return tc.FresnelZoneAperture(beta, width=width, centre=centre)


def shadow(mask_at, sensor, grid, wavelength, source, place):
    """What a mask casts, with its middle imaged at a place of the sensor."""
    lensless = tc.LenslessCamera(mask_at(place / (1 + distance / source)), sensor, distance)
    return tc.psf(
        lensless.on_grid(grid),
        wavelength=wavelength,
        object_distance=source,
        pixel_integration=False,
    )


grid = kernel_grid(sensor.grid, field)
zone_plate = partial(shadow, plate, sensor, grid)
own = ghost_psfs(jax.tree.map(lambda part: part[:, None], axis), zone_plate)  # all orders
figure, axes = plt.subplots(1, orders, figsize=(13, 3.4), layout="constrained")
half = grid.shape[0] / 2 * float(pitch)
weights = np.asarray(axis.weight)[:, 0]
for order, ax in enumerate(axes):
    parts = (axis.wavelength, axis.distance, axis.places)
    image = zone_plate(*(part[order, 0] for part in parts))
    drawn = ax.imshow(np.asarray(image), cmap="gray", extent=(-half, half, half, -half))
    part = weights[order] / weights.sum()
    nanometres = float(axis.wavelength[order, 0]) / nm
    ax.set(xlabel="x (mm)", title=f"order {order}: {part:.0%} of the light\nat {nanometres:.0f} nm")
axes[0].set_ylabel("y on the sensor (mm)")
figure.colorbar(drawn, ax=axes, label="irradiance / open aperture")
figure.savefig(FIGURES / "orders.png", dpi=110)

# %%
# Ghosts alone never take a frequency away: the weights ∫η²(1−η)ⁱ dλ fall with i, and then
# the modulus of Σ Wᵢ e^{ijφ} has no zero (Eneström and Kakeya). For this film it never falls below
# 0.70 of its value at φ = 0.

phase = np.linspace(0, 2 * np.pi, 361)
step = np.abs(np.exp(1j * np.outer(phase, np.arange(orders))) @ weights) / weights.sum()
figure, ax = plt.subplots(figsize=(5, 2.6), layout="constrained")
ax.plot(phase / (2 * np.pi), step, "k")
ax.set(xlabel="spatial frequency × the ghosts' step", ylabel="ghosts' transfer", ylim=(0, 1.05))
figure.savefig(FIGURES / "transfer.png", dpi=110)

# %%
# Captures and three models
# -------------------------
#
# Captures are simulated without any shortcut: every point of the field with the PSF of its own
# ghosts. They are undone with the ghosts ignored, with the PSF of the axis everywhere, and with
# the low-rank sum of `low_rank_psf` from a few points of the field. One noise for all.


def field_points(shape, count):
    """First images, (y, x) mm, of `count`² points of a field from its first to its last sample."""
    ends = [(n - 1) / 2 * float(pitch) for n in shape]
    y, x = (np.linspace(-end, end, count) for end in ends)
    return jnp.asarray(np.stack(np.meshgrid(y, x, indexing="ij"), axis=-1), jnp.float32)


@partial(jax.jit, static_argnames="mask_psf")
def superposed(images, values, mask_psf):
    """Σ over the field's points of their PSFs: (scene, y, x) from values (scene, point)."""
    rows, columns = (jnp.arange(n) for n in field)
    # The kernel holds every difference of pixel and sample: a sample sees a part of it.
    corners = jnp.meshgrid(field[0] - 1 - rows, field[1] - 1 - columns, indexing="ij")
    corners = jnp.stack(corners, axis=-1).reshape(-1, 2)

    def add(total, point):
        image, value, corner = point
        one = jax.tree.map(lambda part: part[:, None], image)
        psf = ghost_psfs(one, mask_psf)[0]
        seen = jax.lax.dynamic_slice(psf, tuple(corner), (count, count))
        return total + value[:, None, None] * seen, None

    flat = jax.tree.map(lambda part: part.reshape(orders, -1, *part.shape[3:]), images)
    moved = jax.tree.map(lambda part: jnp.moveaxis(part, 1, 0), flat)
    start = jnp.zeros((values.shape[0], count, count))
    return jax.lax.scan(add, start, (moved, values.T, corners))[0] * pitch**2


def models(mask_psf, object_distance):
    """What the camera is taken for, and the level of its PSFs."""
    few = ghost_images(camera, field_points(field, points), object_distance, orders)
    middle = points // 2
    level = few.weight[:, middle, middle].sum()
    psfs = ghost_psfs(few, mask_psf) / level
    first = jax.tree.map(lambda part: part[:1, middle, middle], few)
    alone = ghost_psfs(first, mask_psf) / level
    fit = low_rank_psf(psfs, pitch, sensor.shape, field, tolerance=1e-2)
    errors = f"{fit.truncation_error:.1e} and {fit.interpolation_error:.1e}"
    print(f"{fit.operator.weights.shape[0]} convolutions, errors {errors}")
    found = {
        "ghosts ignored": CropConvolution(alone, pitch, sensor.shape, field),
        "shift-invariant": CropConvolution(psfs[middle, middle], pitch, sensor.shape, field),
        "in full": fit.operator,
    }
    return found, level


pictures = [sample_image("camera", linear=True), sample_image("page", linear=True)[:180, :180]]
# The first image is upside down, as behind every mask.
scenes = jnp.asarray(np.stack([resize(p, field) for p in pictures])[:, ::-1, ::-1], jnp.float32)


def captured(mask_psf, object_distance, level):
    """Without noise, from every point of the field."""
    every = ghost_images(camera, field_points(field, field[0]), object_distance, orders)
    return superposed(every, scenes.reshape(len(scenes), -1), mask_psf) / level


def noisy(clean, deviation=None):
    """With noise of a standard deviation, or `SNR` below the contrast; and its variance."""
    if deviation is None:
        deviation = jnp.std(clean) * 10 ** (-SNR / 20)
    return clean + deviation * jax.random.normal(jax.random.key(0), clean.shape), deviation**2


def undone(operator, capture, variance):
    recording = tc.Recording(capture[None], [operator], noise_variance=variance)
    return np.asarray(tc.reconstruct(recording, tc.AdmmTV(0.1, iterations=iterations)).image)


compared, level = models(zone_plate, far)
clean = captured(zone_plate, far, level)
explained = jnp.stack([compared["in full"](scene) for scene in scenes])
left_out = float(jnp.linalg.norm(explained - clean) / jnp.linalg.norm(clean))
print(f"in full, without noise: {left_out:.1e} of the capture from every point is left out")
captures, variance = noisy(clean)
images = {name: undone(operator, captures, variance) for name, operator in compared.items()}


def scores(found):
    """PSNR of each scene, dB."""
    return [psnr(image, scene) for image, scene in zip(found, np.asarray(scenes), strict=True)]


quality = {name: scores(found) for name, found in images.items()}
for name, values in quality.items():
    print(f"{name}: " + ", ".join(f"{value:.1f} dB" for value in values))

# %%
columns = {"object": np.asarray(scenes), "capture": np.asarray(captures), **images}
figure, axes = plt.subplots(2, len(columns), figsize=(13, 5.6), layout="constrained")
for column, (name, found) in zip(axes.T, columns.items(), strict=True):
    for number, (ax, image) in enumerate(zip(column, found, strict=True)):
        half = image.shape[0] / 2 * float(pitch)
        limits = (0, 1) if name in ("object", *images) else (None, None)
        ax.imshow(
            image[::-1, ::-1],
            cmap="gray",
            vmin=limits[0],
            vmax=limits[1],
            extent=(-half, half, half, -half),
        )
        text = f"{name}: {quality[name][number]:.1f} dB" if name in quality else name
        ax.set(title=text, xlabel="x on the sensor, turned (mm)")
for ax in axes[:, 0]:
    ax.set_ylabel("y on the sensor, turned (mm)")
figure.savefig(FIGURES / "models.png", dpi=110)

# %%
# Refocus
# -------
#
# The mask's shadow grows with 1 + d/T, and the ghosts' places change with the distance too. A
# capture of objects at 250 mm, undone for 550 mm and for 250 mm:

close, near_level = models(zone_plate, near)
near_captures, near_variance = noisy(captured(zone_plate, near, near_level))
refocused = {
    f"undone for {at:.0f} mm": undone(operator, near_captures, near_variance)
    for at, operator in ((far, compared["in full"]), (near, close["in full"]))
}
focus = {name: scores(found) for name, found in refocused.items()}
print(focus)
figure, axes = plt.subplots(1, 2, figsize=(7, 3.8), layout="constrained")
half = field[0] / 2 * float(pitch)
for ax, (name, found) in zip(axes, refocused.items(), strict=True):
    extent = (-half, half, half, -half)
    ax.imshow(found[0][::-1, ::-1], cmap="gray", vmin=0, vmax=1, extent=extent)
    ax.set(title=f"{name}: {focus[name][0]:.1f} dB", xlabel="x on the sensor, turned (mm)")
axes[0].set_ylabel("y on the sensor, turned (mm)")
figure.savefig(FIGURES / "refocus.png", dpi=110)

# %%
# Three masks
# -----------
#
# Any mask with a PSF will do. With the same exposure and the same noise, on the same sensor: the
# zone plate, a MURA of 31 × 31 cells of 0.1 mm, and a pinhole of 0.1 mm, each undone in full. (The
# small size leaves the last two out.)


def mura(centre):
    return tc.ModifiedUniformlyRedundantArray(order=31, cell=0.1, centre=centre)


def pinhole(centre):
    return tc.Pinhole(0.1, centre=centre)


masks = {"zone plate": plate, "MURA": mura, "pinhole": pinhole}
opened = {"zone plate": 3 / 8 * width**2, "MURA": 0.5 * 3.1**2, "pinhole": 0.1**2}  # mm²
by_mask = {"zone plate": images["in full"]}
for name in list(masks)[1:] if SIZE == "full" else ():
    of_mask = partial(shadow, masks[name], sensor, grid)
    whole, own_level = models(of_mask, far)
    taken, noise = noisy(captured(of_mask, far, own_level), variance**0.5)
    by_mask[name] = undone(whole["in full"], taken, noise)
of_masks = {name: scores(found) for name, found in by_mask.items()}
for name, values in of_masks.items():
    print(f"{name}, {opened[name]:.2f} mm² open: {values[0]:.1f} and {values[1]:.1f} dB")
figure, axes = plt.subplots(
    2, len(by_mask), figsize=(3.2 * len(by_mask) + 0.5, 6), layout="constrained", squeeze=False
)
for column, (name, found) in zip(axes.T, by_mask.items(), strict=True):
    for number, (ax, image) in enumerate(zip(column, found, strict=True)):
        extent = (-half, half, half, -half)
        ax.imshow(image[::-1, ::-1], cmap="gray", vmin=0, vmax=1, extent=extent)
        ax.set(
            title=f"{name}: {of_masks[name][number]:.1f} dB", xlabel="x on the sensor, turned (mm)"
        )
for ax in axes[:, 0]:
    ax.set_ylabel("y on the sensor, turned (mm)")
figure.savefig(FIGURES / "masks.png", dpi=110)

# %%
# Beside the camera with a lens
# -----------------------------
#
# From the sensor to the screen's front: with a lens d0 + d1 + w, without d + gap + w. The light is
# what a lens or the mask's openings let through, whatever it is then spread over.

depth_with_lens = 6.0 + 10.0 + 5.0
depth = distance + gap + 5.0
aperture = np.pi * (6.0 / 2 / 2) ** 2  # of a lens at f/2
print(f"depth {depth:g} mm, with a lens {depth_with_lens:g} mm")
print(f"open area {opened['zone plate']:.1f} mm², of a lens at f/2 {aperture:.1f} mm²")

# %%
# The numbers above hold.

mean = {name: np.mean(values) for name, values in quality.items()}
np.testing.assert_allclose(apart, 30.4, atol=0.1)
np.testing.assert_allclose(step.min(), 0.70, atol=0.01)
assert left_out < {"full": 2e-3, "small": 1e-2}[SIZE]
assert mean["in full"] > mean["shift-invariant"] > mean["ghosts ignored"]
np.testing.assert_allclose([depth, depth_with_lens], [12.0, 21.0])
