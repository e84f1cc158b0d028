"""The PSF over the field of view
==============================

Lensless cameras are reconstructed as if the PSF were that of the axis everywhere. But light under
an angle θ goes a longer way, and what diffracts it is foreshortened: in the plane of incidence it
acts like light over d/cos³θ in place of d. This script asks what that does to the thesis' camera,
whose object reaches 20°: to its PSF, to the three methods of section 3.5, and to total variation,
which can be given the PSF of every point.

Lengths are in mm, β in rad/mm².
"""

import math
import os
from pathlib import Path

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import thincam_jax as tc
from thincam_jax.imaging.metrics import align
from thincam_jax.imaging.metrics.usaf import resolved_element, usaf_contrast
from thincam_jax.imaging.targets import resize, sample_image, usaf1951
from thincam_jax.imaging.targets.usaf import line_pair, usaf1951_elements
from thincam_jax.reconstruction import fringe_scanning, phase_pairs
from thincam_jax.units import nm

SIZE = os.environ.get("THINCAM_SIZE", "full")  # "small": a smaller camera, in seconds
FIGURES = Path(os.environ.get("THINCAM_FIGURES", "runs/experiments")) / "field_of_view"
FIGURES.mkdir(parents=True, exist_ok=True)

# %%
# The camera
# ----------
#
# That of section 3.5.1 with pixels of 11 µm: 5.63 mm wide, an object of 178 mm at t = 250 mm, 500
# nm. The small size has half the width and twice the β, so that the finest zones, which decide what
# happens over the field, are the same.

count, part, iterations = {"full": (512, 1, 200), "small": (128, 2, 40)}[SIZE]
width, object_distance = 5.632 / part, 250.0
near, far = 5.0, 6.5  # mm, mask to sensor
sensor = tc.Sensor((count, count), width / count)
field = 420 // part  # pixels of the object on the sensor at 6.5 mm
object_width = field * width / count * object_distance / far  # mm
light = {"wavelength": 500 * nm, "object_distance": object_distance}
beta_1, beta_2 = 25.0 * part, 21.0 * part


def camera(beta, turns, distance):
    """A camera whose mask has the phase φ = 2π·turns."""
    mask = tc.FresnelZoneAperture(beta, 2 * math.pi * turns, width=width)
    return tc.LenslessCamera(mask, sensor, distance)


# %%
# The PSF at 5 × 5 points
# -----------------------
#
# `at` is the point of the object. What is drawn is how strongly the PSF differs from that of the
# axis, moved to the same place, as the root mean square over a few pixels: nothing in the middle,
# and more and more outwards, in the finest zones and in the direction of the point first.

wider = tc.Sensor((round(1.1 * count),) * 2, sensor.pitch)
places = np.linspace(-1, 1, 5) * object_width / 2


def seen_from(y, x):
    """The PSF of a point, on a sensor that is moved to where its shadow falls."""
    shadow = far / object_distance * np.array([y, x])
    mask = tc.FresnelZoneAperture(beta_1, width=width, centre=tuple(shadow))
    moved = tc.LenslessCamera(mask, wider, far)
    at = (1 + far / object_distance) * np.array([y, x])
    return np.asarray(tc.psf(moved, at=at, pixel_integration=True, **light))


def strength(difference, block=8 // part):
    """Root mean square over blocks of pixels."""
    kept = len(difference) // block * block
    blocks = difference[:kept, :kept].reshape(kept // block, block, kept // block, block)
    return np.sqrt(np.mean(blocks**2, axis=(1, 3)))


axis = seen_from(0.0, 0.0)
over_field = np.array([[seen_from(y, x) for x in places] for y in places])
change = np.linalg.norm(over_field - axis, axis=(2, 3)) / np.linalg.norm(axis)
print("change of the PSF, %:\n", (100 * change).round(1))

# %%
figure, axes = plt.subplots(5, 5, figsize=(8.6, 8), layout="constrained", sharex=True, sharey=True)
half = 0.55 * width
for ax, (i, j) in zip(axes.flat, np.ndindex(5, 5), strict=True):
    h, share = over_field[i, j], change[i, j]
    drawn = ax.imshow(
        strength(h - axis), cmap="gray", vmin=0, vmax=0.4, extent=(-half, half, half, -half)
    )
    ax.set_title(f"{places[i]:.0f}, {places[j]:.0f} mm: {100 * share:.0f} %", fontsize=9)
figure.supxlabel("x on the sensor, from the middle of the shadow (mm)")
figure.supylabel("y (mm)")
figure.colorbar(drawn, ax=axes, label="difference from the axis (open aperture = 1)", shrink=0.6)
figure.savefig(FIGURES / "psf.png", dpi=110)

# %%
# Captures of the true field
# --------------------------
#
# `tc.field_operator` gives every point of the object its own PSF, and its light, which falls as
# cos⁴θ: a sum of a few convolutions of weighted scenes. The scene is a USAF-1951 chart in each of 5
# × 5 tiles, and a photograph. For comparison, the same captures with the PSF of the axis.

chart = np.tile(usaf1951((field // 5 * 3,) * 2), (5, 5))
photograph = sample_image("chelsea", linear=True).mean(axis=-1)[:, 75:375]
pictures = np.stack([chart, resize(photograph, chart.shape)])
plane = tc.ImagePlane(pictures, distance=object_distance, width=object_width)
scene = tc.Scene(plane, 500 * nm)

quarters = (0.0, 0.25, 0.5, 0.75)
scan_near = [(beta_1, turns, near) for turns in quarters]
scan_far = [(beta_1, turns, far) for turns in quarters]
pairs = [(beta, turns, far) for beta in (beta_1, beta_2) for turns in (0.0, 0.75)]
shots = sorted({*scan_near, *scan_far, *pairs})


def on_sensor(distance, shape):
    """The object as a pinhole casts it."""
    grid = tc.Grid(shape, sensor.pitch)
    return plane.sample(grid, magnification=-distance / object_distance)


def with_true_field(shot):
    shape = (2 * math.ceil(field * shot[2] / far / 2),) * 2
    fit = tc.field_operator(
        camera(*shot), 500 * nm, object_distance=object_distance, field_shape=shape, tolerance=3e-3
    )
    return fit.operator(on_sensor(shot[2], shape))


clean = {
    "axis everywhere": {shot: tc.capture(camera(*shot), scene) for shot in shots},
    "true field": {shot: with_true_field(shot) for shot in shots},
}
keys = dict(zip(shots, jax.random.split(jax.random.key(0), len(shots)), strict=True))
noise = tc.GaussianNoise(30.0, signal_power="without_mean")

# %%
# Reconstructions with the PSF of the axis
# ----------------------------------------
#
# As in `superresolution.py`; the images are divided by cos⁴θ where the light fell.

methods = {
    "conventional, 6.5 mm": (tc.FringeScanning(), scan_far),
    "method A": (tc.Wiener(synthesis=fringe_scanning(2)), scan_near + scan_far),
    "method B": (tc.Wiener(synthesis=phase_pairs(2)), pairs),
}
across = np.linspace(-0.5, 0.5, field) * object_width / object_distance
fall = (1 + across[:, None] ** 2 + across**2) ** -2


def record(kind, shots, imaging_model):
    captures = [noise.add(keys[shot], clean[kind][shot], None) for shot in shots]
    variances = jnp.stack([noise.variance(clean[kind][shot]) for shot in shots])
    return tc.Recording(jnp.stack(captures), imaging_model, noise_variance=variances)


def reconstructed(kind, name):
    solver, shots = methods[name]
    cameras = tc.Cameras([camera(*s) for s in shots], field_shape=(field, field), **light)
    image = np.asarray(tc.reconstruct(record(kind, shots, cameras), solver).image)
    return image / (fall if kind == "true field" else 1.0)


images = {(kind, name): reconstructed(kind, name) for kind in clean for name in methods}

# %%
# Total variation with the PSF of every point
# -------------------------------------------
#
# Of one capture: with the axis' convolution, and with the operator over the field, by the same
# solver. Both are told that there is no background. The operator takes as long as five
# convolutions.

shot = scan_far[0]
shape = (field, field)
fit = tc.field_operator(camera(*shot), 500 * nm, object_distance=object_distance, field_shape=shape)
print(f"{fit.operator.weights.shape[0]} convolutions, error {fit.truncation_error:.1e}")
alone = tc.Cameras([camera(*shot)], field_shape=shape, **light)
for name, model in (("TV, axis PSF", alone), ("TV, field operator", [fit.operator])):
    recording = record("true field", [shot], model).with_background(0.0)
    image = np.asarray(tc.reconstruct(recording, tc.Fista(0.5, iterations=iterations)).image)
    upright = image if model is alone else image[:, ::-1, ::-1]  # an operator's image lies turned
    images["true field", name] = upright / (fall if model is alone else 1.0)

# %%
# Quality against the place in the field
# --------------------------------------
#
# PSNR of the photograph and the finest line pair of the chart, in rings of tiles: the middle one,
# the eight about it, and the sixteen at the edge of the field. Infinite: not even the chart's
# coarsest, 2.2 mm.

truth = np.asarray(on_sensor(far, shape))[:, ::-1, ::-1]
ring = np.maximum(*np.abs(np.indices((5, 5)) - 2))
cells = np.arange(field).reshape(5, -1)


def quality_of(image):
    """PSNR (dB) and finest line pair (mm), the median of the tiles, for each ring."""
    photo = align(image[1], truth[1])
    errors, finest = np.zeros((5, 5)), np.zeros((5, 5))
    for i, j in np.ndindex(5, 5):
        place = np.ix_(cells[i], cells[j])
        errors[i, j] = np.mean((photo[place] - truth[1][place]) ** 2)
        contrasts = usaf_contrast(image[0][place], usaf1951_elements(), len(cells[i]))
        element = resolved_element(contrasts)
        finest[i, j] = line_pair(element, object_width / 5) if element else math.inf
    return [
        (-10 * math.log10(errors[ring == r].mean()), float(np.median(finest[ring == r])))
        for r in range(3)
    ]


quality = {key: quality_of(image) for key, image in images.items()}
for (kind, name), values in quality.items():
    shown = ", ".join(f"{psnr:.1f} dB {pair:.2f} mm" for psnr, pair in values)
    print(f"{name}, {kind}: {shown}")

# %%
figure, ax = plt.subplots(figsize=(9, 4), layout="constrained")
styles = dict(zip([*methods, "TV, axis PSF", "TV, field operator"], "so^xD", strict=True))
for (kind, name), values in quality.items():
    dashes, color = ("-", "k") if kind == "true field" else (":", "0.5")
    levels = [level for level, _ in values]
    ax.plot(levels, dashes + styles[name], color=color, label=f"{name}, {kind}", markersize=5)
ax.set_xticks(range(3), ["middle", "half", "edge"])
ax.set(xlabel="ring of the field", ylabel="PSNR of the photograph (dB)")
ax.legend(fontsize=8, loc="center left", bbox_to_anchor=(1.0, 0.5))
figure.savefig(FIGURES / "rings.png", dpi=110)

# %%
panels = [
    ("scene", truth[1]),
    *((f"{name}\n{kind}", images[kind, name][1]) for kind, name in images if kind == "true field"),
]
figure, axes = plt.subplots(1, len(panels), figsize=(15, 3.5), sharey=True, layout="constrained")
half = object_width / 2
for ax, (title, image) in zip(axes, panels, strict=True):
    shown = align(image, truth[1])
    ax.imshow(shown, cmap="gray", vmin=0, vmax=1, extent=(-half, half, half, -half))
    ax.set_title(title, fontsize=9)
    ax.set(xlabel="x on the object (mm)")
axes[0].set(ylabel="y on the object (mm)")
figure.savefig(FIGURES / "images.png", dpi=110)

# %%
# What came out
# -------------
#
# - The finest zones see the field first: 20° off the axis the PSF is 26 % off that of the axis, in
#   the corners, at 27°, 47 %.
# - Methods A and B hold over the thesis' field all the same. At its edge they lose 0.2 dB and a
#   step of the chart, 12 %: the light at the end of the band is turned by 1.2 rad there, so that
#   cos 1.2 = 0.4 of it is left. Noise of 30 dB weighs more.
# - One capture with total variation gains 0.8 dB in the middle from the operator over the field,
#   where the light of all points falls, and nothing at the edge. With a background to find, 200
#   iterations come farther with the axis' PSF, 22.8 dB, and as far with the operator, 21.9 dB.

rings = {name: values for (kind, name), values in quality.items() if kind == "true field"}
quoted = {
    "full": {
        "conventional, 6.5 mm": [20.9, 21.1, 21.2],
        "method A": [29.1, 28.1, 28.3],
        "method B": [25.7, 25.0, 25.4],
        "TV, axis PSF": [20.9, 21.1, 22.3],
        "TV, field operator": [21.7, 21.4, 22.2],
    },
    "small": {
        "conventional, 6.5 mm": [16.1, 17.6, 19.0],
        "method A": [28.7, 27.1, 20.9],
        "method B": [24.7, 23.6, 20.2],
        "TV, axis PSF": [17.4, 18.5, 20.6],
        "TV, field operator": [18.3, 18.5, 20.0],
    },
}[SIZE]
for name, levels in quoted.items():
    np.testing.assert_allclose([level for level, _ in rings[name]], levels, atol=0.15)
if SIZE == "full":
    finest = {
        name: [round(pair, 2) for _, pair in rings[name]] for name in ("method A", "method B")
    }
    assert finest == {"method A": [1.98, 1.98, 2.22], "method B": [1.98, 2.22, 2.22]}
assert change[2, 2] == 0 and change[2, 4] > 0.15 and change[0, 0] > change[2, 4]
