"""Video without a lens
====================

A camera gives thirty frames a second and more, the reconstruction by total variation takes
seconds. A stream goes on from the image before, four iterations a frame; a Wiener filter begins
anew. How many images a second does each give, and what do they lose where the scene moves?
"""

import os
import time
from pathlib import Path

import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import thincam_jax as tc
from thincam_jax.imaging.metrics import psnr
from thincam_jax.imaging.targets import resize, sample_image
from thincam_jax.units import nm, um

SIZE = os.environ.get("THINCAM_SIZE", "full")  # "small": a smaller camera, in seconds
FIGURES = Path(os.environ.get("THINCAM_FIGURES", "runs/experiments")) / "video"
FIGURES.mkdir(parents=True, exist_ok=True)

# %%
# Frames of a moving scene
# ------------------------
#
# A window moves over a photograph by a whole number of pixels a frame; within an exposure it
# stands. One zone aperture takes all frames with a noise of 30 dB; or its phase goes on by π/2
# with every frame, and the last four are combined.

count, length, iterations = {"full": (256, 13, 200), "small": (64, 6, 40)}[SIZE]
speeds, names = (0, 1, 2, 4), {"full": ("camera", "coins"), "small": ("camera",)}[SIZE]
pitch, distance, far, rng = 5.5 * um, 6.5, 250.0, np.random.default_rng(0)
sensor, width = tc.Sensor((count, count), pitch), count * pitch
beta = 100.0 * 256 / count  # the zones at the edge stay as fine
masks = [tc.FresnelZoneAperture(beta, k * np.pi / 2, width=width) for k in range(4)]
cameras = [tc.LenslessCamera(mask, sensor, distance) for mask in masks]
light = {"wavelength": 500 * nm, "object_distance": far, "field_shape": (count, count)}


def seen(camera, scenes):
    plane = tc.ImagePlane(scenes, far, width * far / distance)
    return np.asarray(tc.capture(camera, tc.Scene(plane, 500 * nm)), np.float32)


def windows(name, speed):
    """The last one is the same at every speed."""
    size = count, count + speeds[-1] * length
    photograph = np.asarray(resize(sample_image(name, linear=True), size), np.float32)
    return np.stack([photograph[:, speed * k :][:, :count] for k in range(length)][::-1])


scenes = {(name, speed): windows(name, speed) for name in names for speed in speeds}
clean = {key: seen(cameras[0], moved) for key, moved in scenes.items()}
deviation = float(np.sqrt(np.mean(clean[names[0], 0] ** 2))) * 10 ** (-30 / 20)


def noisy(frames):
    return jnp.asarray(frames + deviation * rng.standard_normal(frames.shape, dtype=np.float32))


frames = {key: noisy(one) for key, one in clean.items()}
last = {k: [seen(c, s[j - 4]) for j, c in enumerate(cameras)] for k, s in scenes.items()}
scanned = {key: noisy(np.stack(four)) for key, four in last.items()}

# %%
# Images
# ------
#
# What is timed is all of it, from a frame in memory to an image of 8 bits; the first image, which
# is compiled for, does not count. "TV, converged" is total variation of the last frame alone, by
# 200 iterations. τ = 2 is its best of 0.5, 1, 2 and 4.

STREAM, ONE, FOUR, WHOLE = "TV stream, 4 steps", "Wiener", "Wiener, 4 phases", "TV, converged"
seconds = {name: [] for name in (STREAM, ONE, FOUR, WHOLE)}
images, along = {}, {}
optics, scan = tc.Cameras(cameras[:1], **light), tc.Cameras(cameras, **light)
one = tc.Wiener().prepare(optics)
four = tc.Wiener(synthesis=[[1, 0, -1, 0], [0, 1, 0, -1]]).prepare(scan)
variance, whole = deviation**2, tc.AdmmTV(2.0, iterations=iterations)


def timed(name, solve):
    began = time.perf_counter()
    found = solve()
    stream, image = found if name == STREAM else (None, found.image)
    np.clip(255 * np.asarray(image), 0, 255).astype(np.uint8)
    seconds[name].append(time.perf_counter() - began)
    return stream, np.asarray(image)


for (name, speed), moved in scenes.items():
    key, solver, along[name, speed] = (name, speed), tc.AdmmTV(2.0, iterations=60), []
    stream = tc.Stream(tc.Recording(frames[key][:1], optics, noise_variance=variance), solver)
    for frame, scene in zip(frames[key][1:], moved[1:], strict=True):
        stream, image = timed(STREAM, lambda f=frame, s=stream: s.next([f]))
        along[key].append(float(psnr(image, scene)))
        images[key, ONE] = timed(ONE, lambda f=frame: one(f[None], variance))[1]
        images[key, FOUR] = timed(FOUR, lambda k=key: four(scanned[k], variance))[1]
    images[key, STREAM] = image
    newest = tc.Recording(frames[key][-1:], optics, noise_variance=variance)
    images[key, WHOLE] = timed(WHOLE, lambda n=newest: tc.reconstruct(n, whole))[1]

rates = {name: 1 / np.median(times[1:]) for name, times in seconds.items()}
errors = {}
for name in seconds:
    of = [[psnr(images[(on, v), name], scenes[on, v][-1]) for on in names] for v in speeds]
    errors[name] = np.mean(of, axis=1)
    print(f"{name}: {rates[name]:.2g} images/s; {np.round(errors[name], 1)} dB at {speeds} pixels")

# %%
styles = {STREAM: "ko-", ONE: "k^:", FOUR: "ks--", WHOLE: "kD-."}
figure = plt.figure(figsize=(12, 6.4), layout="constrained")
top, bottom = figure.subfigures(2, 1)
axes, (left, right) = top.subplots(1, 4), bottom.subplots(1, 2)
half, shown = width * far / distance / 2, scenes[names[0], 2][-1]
panels = {"scene": shown} | {n: images[(names[0], 2), n] for n in (ONE, FOUR, STREAM)}
for ax, (title, picture) in zip(axes, panels.items(), strict=True):
    ax.imshow(picture, cmap="gray", vmin=0, vmax=1, extent=(-half, half, half, -half))
    value = "" if title == "scene" else f": {psnr(picture, shown):.1f} dB"
    ax.set(title=title + value, xlabel="x on the object (mm)")
axes[0].set_ylabel("y on the object (mm)")
for name, style in styles.items():
    left.plot(speeds, errors[name], style, label=name, markerfacecolor="0.7")
    right.plot([rates[name]] * len(speeds), errors[name], style, markerfacecolor="0.7")
left.set(xlabel="motion (pixels a frame)", ylabel="PSNR (dB)", xticks=speeds)
right.set(xlabel="images per second", ylabel="PSNR (dB), every speed", xscale="log")
left.legend(fontsize="small")
figure.savefig(FIGURES / "video.png", dpi=90)

# %%
figure, panels = plt.subplots(1, len(names), figsize=(10, 3.6), layout="constrained", squeeze=False)
for ax, name in zip(panels[0], names, strict=True):
    for style, speed in zip(("o-", "s--", "^-.", "D:"), speeds, strict=True):
        ax.plot(along[name, speed], "k" + style, markersize=4, label=f"{speed} pixels a frame")
    ax.set(xlabel="image of the stream", ylabel="PSNR (dB)", title=name)
figure.legend(*ax.get_legend_handles_labels(), loc="outside right upper", fontsize="small")
figure.savefig(FIGURES / "frames.png", dpi=90)

# %%
# Of a scene that stands, a stream averages the noise of its frames as well. The more a scene
# moves from frame to frame, the more a stream and four phases lose; one frame loses nothing.

lost = {name: values[0] - values[-1] for name, values in errors.items()}
assert abs(lost[ONE]) < 1 < min(lost[STREAM], lost[FOUR]) and errors[STREAM][0] > errors[ONE][0]
