"""How far is the person before the screen?
========================================

The screen's light guide shows an object several times, and the nearer it is, the further its
ghosts are displaced. One capture then tells the distance of a flat object, with an error and a
status. When does it, and when not?
"""

import os
from pathlib import Path

import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import thincam_jax as tc
from thincam_jax import waveguide as wg
from thincam_jax.imaging.targets import resize, sample_image
from thincam_jax.units import deg, nm, um

SIZE = os.environ.get("THINCAM_SIZE", "full")  # "small": fewer pixels, in seconds
FIGURES = Path(os.environ.get("THINCAM_FIGURES", "runs/experiments")) / "screen_distance"
FIGURES.mkdir(parents=True, exist_ok=True)

# %%
# The camera
# ----------
#
# The default plate, and the sensor's 2.1 mm in pixels of 24 µm. At 300 mm the first ghost is about
# 15 of them from the image, at 900 mm 5.

pixels, cells, samples = {"full": (88, 200, 8), "small": (44, 100, None)}[SIZE]
hologram = wg.VolumeHologram.record(
    532 * nm, 0.0, 61.2 * deg, index=1.5, thickness=16 * um, index_modulation=0.02
)
places = wg.Rectangle((0.0, 0.0), (20.0, 50.0)), wg.Rectangle((25.0, 0.0), (50.0, 50.0))
sensor = tc.Sensor((pixels, pixels), 2112 * um / pixels)
camera = wg.SeeThroughCamera(wg.Screen(hologram, 5.0, 1.5, *places), sensor, 6.0, 10.0)


def capture(picture, distance, seed):
    """At 40 dB; the picture has the same angular size at all distances and fills the field."""
    field = 0.352 * (10.0 + distance)
    plane = wg.ObjectPlane(picture.shape, distance, 1.5 * field, (9.1 + 0.22 * field, 0.0))
    clean = np.asarray(wg.system_operator(camera, plane, samples=samples)(jnp.asarray(picture)))
    deviation = np.sqrt(np.mean(clean**2)) * 10 ** (-40 / 20)
    return clean + deviation * np.random.default_rng(seed).standard_normal(clean.shape)


# %%
# Three distances, and an object that has none
# --------------------------------------------
#
# For each distance of the search the ghosts are removed from the capture. The right one leaves the
# picture that is predicted best from its own pixels, as in lossless compression. A blank wall has
# no ghosts to tell: its status says so, and the distances that it does not exclude are all.

person = resize(sample_image("camera", linear=True), (cells, cells))
scenes = {f"{distance:g} mm": (person, distance) for distance in (300.0, 550.0, 900.0)}
scenes["blank wall"] = (np.ones((cells, cells)), 550.0)
captures, found = {}, {}
for number, (name, (picture, distance)) in enumerate(scenes.items()):
    captures[name] = capture(picture, distance, number)
    one = found[name] = wg.distance_from_ghosts(camera, captures[name])
    print(f"{name}: {one.status}, {one.distance:.0f} ± {one.standard_error:.0f} mm", end="; ")
    print(f"{one.plausible.size} of {one.distances.size} distances are not excluded")

# %%
figure, axes = plt.subplot_mosaic(
    "01p;23p", width_ratios=[1, 1, 2.6], figsize=(11, 4.2), layout="constrained"
)
half = 1.056
for number, (name, image) in enumerate(captures.items()):
    ax = axes[str(number)]
    ax.imshow(image[::-1, ::-1], cmap="gray", extent=(-half, half, half, -half), vmin=0, vmax=1.2)
    ax.set_title(name, fontsize="medium")
    ax.set_xlabel("mm on the sensor, turned", fontsize="small")
ax = axes["p"]
styles = [("0.0", "-"), ("0.0", "--"), ("0.0", ":"), ("0.6", "-")]
for (grey, dashes), (name, one) in zip(styles, found.items(), strict=True):
    label = f"{name}: {one.distance:.0f} ± {one.standard_error:.0f} mm"
    if one.status != "determined":
        label = f"{name}: not determined"
    ax.plot(one.distances, one.log_likelihood, color=grey, linestyle=dashes, label=label)
ax.set(xscale="log", xlabel="distance d2 (mm)", ylabel="log-likelihood, relative to the highest")
ticks = [200, 300, 550, 900, 2000]
ax.set_xticks(ticks, [str(tick) for tick in ticks])
ax.set_xticks([], minor=True)
ax.legend(loc="lower right", fontsize="small")
figure.savefig(FIGURES / "distance.png", dpi=110)

# %%
# A picture that repeats itself
# -----------------------------
#
# Blinds whose period is a ghost's displacement look like ghosts. The evidence is compared over 30
# tiles of the capture: the likeliest distance has to lead every other, by Student's t of their
# differences, and ghosts on the opposite side, where no distance puts them. Here it does not.

rows = np.arange(cells)[:, None] * np.ones(cells)
period = 0.195 / (2.112 * 1.5) * cells  # cells: the first ghost's displacement at 550 mm
blinds = 0.5 + 0.3 * np.sign(np.sin(2 * np.pi * rows / period))
captures["blinds"] = capture(blinds, 750.0, 9)
repeated = wg.distance_from_ghosts(camera, captures["blinds"])
print(f"blinds: {repeated.status}, {repeated.plausible.size} distances are not excluded")

figure, (ax, curve) = plt.subplots(1, 2, figsize=(9, 3.4), layout="constrained")
ax.imshow(captures["blinds"][::-1, ::-1], cmap="gray", extent=(-half, half, half, -half))
ax.set(title="blinds at 750 mm", xlabel="mm on the sensor, turned")
for one, (grey, dashes), label in zip(
    (found["550 mm"], repeated), styles, ("person at 550 mm", "blinds at 750 mm"), strict=False
):
    curve.plot(one.distances, one.lead, color=grey, linestyle=dashes, label=label)
curve.axhline(2.05, color="0.6", linestyle=":", label="level of 2.5 %")
curve.set(xscale="log", xlabel="distance d2 (mm)", ylabel="lead of the likeliest, Student's t")
curve.set_xticks(ticks, [str(tick) for tick in ticks])
curve.set_xticks([], minor=True)
curve.legend(fontsize="small")
figure.savefig(FIGURES / "blinds.png", dpi=110)

# %%
# What this says
# --------------
#
# The error grows with the square of the distance, from 1 mm at 300 mm to about 12 mm at 900 mm.

determined = [n for n, one in found.items() if one.status == "determined"]
assert len(determined) >= {"full": 3, "small": 2}[SIZE]
for name in determined:
    one = found[name]
    assert abs(one.distance - scenes[name][1]) < 4 * one.standard_error
assert "blank wall" not in determined
assert repeated.status != "determined"
