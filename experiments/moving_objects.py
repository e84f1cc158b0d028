"""Objects that move
=================

More captures carry more of the scene (thesis, section 3.5), if it stays where it is. How far may
it move until fewer captures are better? All methods take the same time and the same light: one
capture blurs along the whole way; of several each blurs less, but they disagree on the place.
"""

import os
from dataclasses import replace
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

import thincam_jax as tc
from thincam_jax.studies import Method, Study, Target, evaluate_target
from thincam_jax.units import nm, um

SIZE = os.environ.get("THINCAM_SIZE", "full")  # "small": a narrower camera, in seconds
FIGURES = Path(os.environ.get("THINCAM_FIGURES", "runs/experiments")) / "moving_objects"
FIGURES.mkdir(parents=True, exist_ok=True)

# %%
# A capture of what moves
# -----------------------
#
# `moves` are the places of the image's middle when an exposure begins and when it ends. What is
# captured is the mean on the way, exact: the weights of the image's pixels in a sensor's pixel are
# integrated along it. Here a bar goes 2 mm, beside the sum over 200 places on the way.

bar = np.zeros((24, 40))
bar[6:18, 18:22] = 1.0
mask = tc.FresnelZoneAperture(100.0, width=1.2)
camera = tc.LenslessCamera(mask, tc.Sensor((96, 120), 11 * um), distance=6.5)


def seen(moves):
    plane = tc.ImagePlane(bar, distance=250.0, width=30.0, moves=moves)
    return np.asarray(plane.sample(camera.sensor.grid, magnification=-6.5 / 250.0))


way = np.linspace(0.0, 2.0, 401)[1::2]
apart = np.abs(seen((0.0, 2.0)) - np.mean([seen((x, x)) for x in way], axis=0)).max()
print(f"from the sum: {apart:.1e}")
moving = tc.ImagePlane(bar, distance=250.0, width=30.0, moves=(0.0, 2.0))
capture = np.asarray(tc.capture(camera, tc.Scene(moving, 500 * nm)))
figure, axes = plt.subplots(1, 3, figsize=(11, 3.2), layout="constrained")
half = [5.5 * um * n for n in camera.sensor.shape]
extent = (-half[1], half[1], half[0], -half[0])
panels = {"at rest": seen(None), "moves 2 mm on the object": seen((0.0, 2.0)), "capture": capture}
for ax, (name, image) in zip(axes, panels.items(), strict=True):
    ax.imshow(image, cmap="gray", extent=extent)
    ax.set(title=name, xlabel="x on the sensor (mm)")
axes[0].set_ylabel("y on the sensor (mm)")
figure.savefig(FIGURES / "bar.png", dpi=110)

# %%
# Speeds
# ------
#
# The cameras and methods of `configs/moving.yaml`; sensor, mask and scene are a quarter as wide,
# and the zones as fine. All but the short capture take the light of eight exposures. The scene's
# way in the whole sequence is given in pixels of the sensor.

count, ways = {"full": (128, (0, 1, 2, 4, 8, 16)), "small": (96, (0, 6))}[SIZE]
part = 512 / count
exposures, pitch, magnification = 8, 5.5 * um, 6.5 / 250.0
sensor = tc.Sensor((count, count), pitch, electrons=16000 * part**2, full_well=500_000 * part**2)
zones = tc.FresnelZoneAperture(50.0 * part, width=2.816 / part)
place = 250.0, 90 / part
charts = [
    Target.usaf1951(*place),
    *(Target.photograph(name, *place) for name in ("camera", "coins")),
]
variation, wiener = tc.AdmmTV(0.3, iterations=60), tc.Wiener()


def shot(relative_time, beta=50.0, distance=6.5):
    """A setting of the camera, or several."""
    betas = np.multiply(beta, part)
    light = {"wavelength": 500 * nm, "width": 2.816 / part}
    return tc.Exposures(betas, distance, relative_time=relative_time, **light)


both = shot(1, distance=[5.0, 6.5]).fringe_scanned()
methods = [
    Method("1 capture, TV", shot(8), variation),
    Method("1 short capture, TV", shot(1), variation),
    Method("4 captures, TV", shot(2).fringe_scanned(), variation, "fringe_scanning"),
    Method("1 capture", shot(8), wiener),
    Method("2 captures, a pair", shot(4).phase_pairs(), wiener, "phase_pairs"),
    Method("4 captures, scanned", shot(2).fringe_scanned(), wiener, "fringe_scanning"),
    Method("4 captures, method B", shot(2, [50.0, 42.0]).phase_pairs(), wiener, "phase_pairs"),
    Method("8 captures, method A", both, wiener, "fringe_scanning"),
]


def studied(pixels):
    """Every method on every target, when the scene moves so far in the sequence."""
    speed = pixels * pitch / magnification / exposures
    moving = [replace(m, exposures=m.exposures.of_moving(speed)) if speed else m for m in methods]
    noise = tc.PoissonGaussianNoise(2.0)
    study = Study(zones, sensor, tuple(moving), tuple(charts), object_distance=250.0, noise=noise)
    found = {target.name: evaluate_target(study, target) for target in study.targets}
    print(f"{pixels} pixels: done", flush=True)
    return found


by_way = {pixels: studied(pixels) for pixels in ways}
names = [method.name for method in methods]
targets = [target.name for target in charts]


def decibels(name, *on):
    """Mean PSNR of targets along the ways."""
    return [np.mean([by_way[p][t][name].scores.psnr_db for t in on]) for p in ways]


for target in targets:
    for name in names:
        print(target, name, [f"{value:.1f}" for value in decibels(name, target)])

# %%
scenes = {"the chart": targets[:1], "the photographs": targets[1:]}
figure, axes = plt.subplots(1, 2, figsize=(11.5, 4.6), layout="constrained")
shades = {"1 c": "0.0", "1 s": "0.0", "2": "C0", "4": "C1", "8": "C2"}
for ax, (title, on) in zip(axes, scenes.items(), strict=True):
    for name in names:
        color = next(shade for start, shade in shades.items() if name.startswith(start))
        style = "-" if "TV" in name else "--"
        style = ":" if "short" in name or "method B" in name else style
        ax.plot(ways, decibels(name, *on), style, color=color, marker="o", label=name)
    ax.set_xscale("symlog", base=2, linthresh=1)
    ax.set_xticks(ways, [str(pixels) for pixels in ways])
    ax.set(title=title, xlabel="pixels moved in the whole sequence")
    ax.grid(alpha=0.3)
axes[0].set_ylabel("PSNR (dB)")
axes[1].legend(loc="center left", bbox_to_anchor=(1.0, 0.5))
figure.savefig(FIGURES / "errors.png", dpi=110)

# %%
shown = [ways[0], ways[len(ways) // 2], ways[-1]] if len(ways) > 2 else ways
columns = ["1 capture, TV", "1 short capture, TV", "4 captures, TV", "8 captures, method A"]
figure, axes = plt.subplots(
    len(shown), len(columns), figsize=(2.6 * len(columns), 2.75 * len(shown)), layout="constrained"
)
for row, pixels in zip(axes, shown, strict=True):
    for ax, name in zip(row, columns, strict=True):
        found = by_way[pixels][targets[1]][name]
        rows, across = found.image.shape
        middle = found.image[rows // 4 : -(rows // 4), across // 4 : -(across // 4)]
        ax.imshow(middle, cmap="gray", vmin=0, vmax=1)
        ax.set(xticks=[], yticks=[], xlabel=f"{found.scores.psnr_db:.1f} dB")
        if pixels == shown[0]:
            ax.set_title(name)
    row[0].set_ylabel(f"{pixels} pixels")
figure.savefig(FIGURES / "images.png", dpi=110)

# %%
# What the text says:

lost = {name: decibels(name, *targets)[0] - decibels(name, *targets)[-1] for name in names}
print({name: f"loses {value:.1f} dB" for name, value in lost.items()})
assert apart < 1e-3
# A short capture is hurt least; a pair most of those that are subtracted.
assert lost["1 short capture, TV"] == min(lost[name] for name in names if "TV" in name)
assert lost["4 captures, scanned"] > lost["8 captures, method A"]
