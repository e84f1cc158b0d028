"""A hand before the screen
========================

A see-through screen is a camera for gestures and touch, where hands come as near as 20 mm (thesis
chapter 5). A lens gathers light by its aperture, and blurs what it is not focused on. What focus
and aperture do hands at 20 to 100 mm need, and what does a camera see that looks users in the eye?

Lengths are in mm.
"""

import dataclasses
import os
from pathlib import Path

import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import thincam_jax as tc
from thincam_jax import waveguide as wg
from thincam_jax.imaging.targets import middle_square, resize, sample_image
from thincam_jax.units import deg, nm, um
from thincam_jax.waveguide.display import tint
from thincam_jax.waveguide.field_of_view import field_of_view
from thincam_jax.waveguide.lens import blur_radius
from thincam_jax.waveguide.studies.screen import ScreenModel, ScreenStudy

SIZE = os.environ.get("THINCAM_SIZE", "full")  # "small": fewer pixels and cases, in seconds
FIGURES = Path(os.environ.get("THINCAM_FIGURES", "runs/experiments")) / "near_screen"
FIGURES.mkdir(parents=True, exist_ok=True)
shape, cells, seeds = {"full": ((72, 90), 40, 3), "small": ((32, 40), 16, 1)}[SIZE]
distances = {"full": (20.0, 50.0, 100.0), "small": (20.0,)}[SIZE]
apertures = {"full": (0.12, 0.3, 0.7, 1.5, 3.0), "small": (0.25, 1.0)}[SIZE]

# %%
# The camera
# ----------
#
# The thesis' plate, lens and whole sensor, whose pixels are binned to 68 µm. The brightest pixel
# gets a number of electrons that grows with the aperture's area: of an object of 40 cd/m² (a hand
# under 300 lux) in white light, 33 ms, a quantum efficiency of 0.6, and the 6 nm that both
# holograms pass to a pixel.

film = wg.VolumeHologram.record(
    532 * nm, 0.0, 61.2 * deg, index=1.5, thickness=16 * um, index_modulation=0.02
)
pitch = 4.9 / shape[0]


def camera(middle=25.0, height=50.0, full_well=1e4, **lens):
    """The plate with a bottom hologram of that height about its middle, mm down from the axis."""
    bottom = wg.Rectangle((middle, 0.0), (height, 50.0))
    screen = wg.Screen(film, 5.0, 1.5, wg.Rectangle((0.0, 0.0), (20.0, 50.0)), bottom)
    sensor = tc.Sensor(shape, pitch, full_well=full_well / 0.7, exposure=0.7)
    return wg.SeeThroughCamera(screen, sensor, 6.0, 10.0, **lens)


def electrons(aperture):
    """Of the brightest pixel in 33 ms."""
    radiance = 40 / 683 / 107  # W/m²/sr/nm of a flat spectrum: 107 nm is the eye's width
    power = radiance * 6 * np.pi / 4 * (aperture / 6) ** 2 * (pitch * 1e-3) ** 2
    return 0.6 * 0.033 * power / 3.73e-19  # photons of 532 nm


def hand(distance):
    """A picture that fills some two thirds of what the camera sees there."""
    return wg.ObjectPlane((cells, cells), distance, 0.6 * (10 + distance), (18.0, 0.0))


# %%
# Focus
# -----
#
# Light of the image has gone through the glass obliquely, so that it has no single focus: the way
# changes with the direction, along the screen otherwise than across. The radius of the blur, in
# pixels, of an aperture of 1 mm:

focuses = np.geomspace(20.0, 2000.0, 25)
blurs = {
    distance: [
        blur_radius(camera(aperture=1.0, focus_distance=focus), hand(distance), 1)
        for focus in focuses
    ]
    for distance in distances
}
best = {distance: float(focuses[np.argmin(blurs[distance])]) for distance in distances}
for distance in distances:
    straight = distance + 10 + 2 * 5 / 1.5
    print(
        f"{distance:4.0f} mm: least blur {min(blurs[distance]):.2f} pixels, in focus at "
        f"{best[distance]:.0f} mm (straight way {straight:.0f} mm); in focus at 2 m "
        f"{blurs[distance][-1]:.2f}; electrons of 1 mm {electrons(1.0):.0f}"
    )

# %%
# Aperture
# --------
#
# PSNR of total variation over seeds of the noise, with the model that has the lens, and with one of
# a pinhole.

picture = resize(middle_square(sample_image("camera", linear=True), 400), (cells, cells))
models = ScreenModel("lens"), ScreenModel("pinhole", "no_defocus")


def scores(distance, aperture, focus):
    """Mean and spread of the PSNR by each model, and an image by the first."""
    seen = camera(aperture=aperture, focus_distance=focus, full_well=electrons(aperture))
    study = ScreenStudy(
        cameras=(seen,),
        plane=hand(distance),
        targets={"picture": picture},
        noise=tc.PoissonGaussianNoise(2.0),
        solvers={"TV": tc.AdmmTV(0.5, iterations=60)},
        models=models,
    )
    systems, found = study.systems, []
    for seed in range(seeds):
        again = dataclasses.replace(study, seed=seed)
        again.__dict__["systems"] = systems  # the same for all seeds
        result = again.run()
        found.append([result.models[one.name].methods["TV"].scores.mean_psnr_db for one in models])
    return (
        np.mean(found, axis=0),
        np.ptp(found, axis=0),
        result.models["lens"].methods["TV"].images[0],
    )


table, images = {}, {}
for distance in distances:
    for name, focus in (("best", best[distance]), ("2 m", 2000.0)):
        for aperture in apertures:
            mean, spread, image = scores(distance, aperture, focus)
            table[distance, name, aperture], images[distance, name, aperture] = mean, image
            print(
                f"{distance:4.0f} mm, focus {name:4}, aperture {aperture:4.2f}: "
                f"{mean[0]:5.1f} dB ± {spread[0] / 2:.1f}, as a pinhole {mean[1]:5.1f}"
            )

# %%
# In the eye
# ----------
#
# The image enters 9 mm below the camera, at the first contact with the bottom hologram. A hologram
# further down gives a view from there, by light that was reflected more often on its way. A user at
# 500 mm looks at the middle of a screen 150 mm below the camera.

for middle in (25.0, 75.0, 125.0, 175.0):
    enters = camera(middle)
    rays = wg.trace(enters, np.zeros((1, 2)), object_distance=500.0, orders=16)
    lit = np.asarray(rays.weight[:, 0])
    first = float(rays.points[np.argmax(lit > 0), 0, 1])
    off = np.degrees(np.arctan((150 - first) / 500))
    print(
        f"hologram {middle:3.0f} mm down: view from {first:3.0f} mm, {off:2.0f}° beside the gaze, "
        f"field {field_of_view(enters, orders=16)}, of the first image alone "
        f"{field_of_view(enters, orders=int(np.argmax(lit > 0)) + 1)}"
    )

# %%
# A display behind the plate
# --------------------------
#
# The bottom hologram takes light of the display, too, on its way to the user: of white light of an
# LCD, of a laser's white, and of its green alone, by the angle under which the user looks, down.

lamps = {
    "LCD": [wg.ColourBand(c * nm, w * nm) for c, w in ((450, 20), (530, 35), (625, 20))],
    "lasers": [wg.ColourBand(c * nm, 1 * nm) for c in (450, 532, 638)],
    "532 nm": [wg.ColourBand(532 * nm, 1 * nm)],
}
angles, tints = (-10.0, -3.0, 0.0, 3.0, 10.0), {name: [] for name in lamps}
for degrees in angles:
    along = jnp.array([0.0, np.sin(np.radians(degrees))])
    words = []
    for name, primaries in lamps.items():
        through = tint(film, along, primaries)
        moved = np.hypot(*through.shift)
        tints[name].append((100 * through.luminance, moved))
        words.append(f"{name} {100 * through.luminance:.0f} %, Δu′v′ {moved:.3f}")
    print(f"{degrees:3.0f}°: " + "; ".join(words))

# %%

figure, axes = plt.subplots(1, 3, figsize=(10, 3.2), layout="constrained")
for (distance, blur), style in zip(blurs.items(), ("-", "--", ":"), strict=False):
    axes[0].loglog(focuses, blur, style, color="black", label=f"{distance:.0f} mm")
axes[0].set(xlabel="focus, mm from the lens", ylabel="blur of 1 mm, pixels", title="Focus")
axes[0].set_xticks([20, 50, 100, 200, 500, 1000], ["20", "50", "100", "200", "500", "1000"])
axes[0].legend(title="hand at", frameon=False)
for distance, style in zip(distances, ("-", "--", ":"), strict=False):
    for name, colour in (("best", "black"), ("2 m", "tab:orange")):
        decibels = [table[distance, name, aperture][0] for aperture in apertures]
        label = f"{distance:.0f} mm, focus {name}"
        axes[1].semilogx(apertures, decibels, style, color=colour, label=label)
axes[1].set(xlabel="aperture, mm", ylabel="PSNR, dB", title="Image, 33 ms")
axes[1].set_xticks(apertures, [f"{one:g}" for one in apertures])
for ax in axes[:2]:
    ax.minorticks_off()
axes[1].legend(frameon=False, fontsize=7)
near, wide = distances[0], apertures[-1]
pair = [images[near, "best", one] for one in (apertures[0], wide)]
axes[2].imshow(np.hstack([np.asarray(one) for one in pair]), cmap="gray", vmin=0, vmax=1)
axes[2].set(title=f"{near:.0f} mm, aperture {apertures[0]} | {wide} mm", xticks=[], yticks=[])
figure.savefig(FIGURES / "near-screen.png", dpi=120)

# %%

figure, axes = plt.subplots(1, 2, figsize=(8, 3), layout="constrained")
for (name, found), style in zip(tints.items(), ("o-", "s--", "^:"), strict=True):
    for ax, values in zip(axes, zip(*found, strict=True), strict=True):
        ax.plot(angles, values, style, color="black", label=name)
axes[0].set(xlabel="angle, degrees", ylabel="light that goes through, %", ylim=(0, None))
axes[1].set(xlabel="angle, degrees", ylabel="shift of white, Δu′v′")
axes[0].legend(frameon=False)
figure.savefig(FIGURES / "tint.png", dpi=120)
