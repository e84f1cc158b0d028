"""One capture, any distance: learned refocusing
=============================================

A zone-aperture camera takes one capture of a scene with depth. A network that knows the camera's
optics explains it by a stack of planes, and focuses on any distance. Thesis chapter 4 has a
network with a control code for two distances; here the distance is in the optics.

The network of this script is trained for minutes only: what it shows is how it is used and how
far it may be trusted. `thincam train configs/learned_refocus.yaml` trains the full one.

Lengths are in mm, β in rad/mm².
"""

import os
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import PIL.Image

import thincam_jax as tc
from thincam_jax import learn
from thincam_jax.imaging.metrics import psnr
from thincam_jax.learn.refocusing.cameras import RefocusCamera
from thincam_jax.learn.refocusing.learned import read
from thincam_jax.learn.refocusing.network import NetworkOptions, RefocusNetwork
from thincam_jax.learn.refocusing.scenes import SceneOptions, draw_batch
from thincam_jax.learn.refocusing.sources import drawn
from thincam_jax.learn.refocusing.train import Lessons, train
from thincam_jax.learn.training import TrainingOptions
from thincam_jax.reconstruction.depth import refocus_distances
from thincam_jax.units import nm, um

SIZE = os.environ.get("THINCAM_SIZE", "full")  # "small": a smaller camera, in seconds
FIGURES = Path(os.environ.get("THINCAM_FIGURES", "runs/experiments")) / "learned_refocus"
FIGURES.mkdir(parents=True, exist_ok=True)
# A trained network of this camera, if there is one; else a short training is done here.
NETWORK = Path(os.environ.get("THINCAM_NETWORK", FIGURES / "network.thincam"))

# %%
# Camera and network
# ------------------
#
# The depth of focus of the finest detail, π t (t + d)/(β d R²), is 17 mm at 60 mm, 63 mm at 120
# mm.

pixels, width, steps = {"full": (128, 5.6, 400), "small": (16, 0.7, 4)}[SIZE]
planes, widths = {"full": (5, (16, 24, 32)), "small": (2, (4, 4))}[SIZE]
aperture = tc.FresnelZoneAperture(beta=13.0, width=width)
thin = tc.LenslessCamera(aperture, tc.Sensor((pixels, pixels), 44 * um), distance=7.5)
shape = (pixels // 2, pixels // 2)
camera = RefocusCamera(thin, 500 * nm, field_shape=shape, near=50.0, far=200.0, planes=planes)
options = NetworkOptions(steps=2 if SIZE == "full" else 1, widths=widths)
untrained = RefocusNetwork.create(camera, options, key=jax.random.key(0))

# %%
# Training
# --------
#
# Scenes are drawn: leaves of all sizes that hide each other, in layers at random distances, with
# noise of 20 to 45 dB. A step that gives NaN is skipped; the folder holds all that a training
# which was killed goes on from.

source, unseen = drawn(0, 64 if SIZE == "full" else 4, 2 * pixels), drawn(1, 8, 2 * pixels)
two = SceneOptions(layers=(0.0, 1.0, 0.0), dark=0.0, relief=0.0, snr_db=(30.0, 30.0), poisson=0.0)
kinds = SceneOptions() if SIZE == "full" else two
pool = 100 if SIZE == "full" else 2  # pairs of scenes
lessons = Lessons(source, kinds, batch=2, pool=pool, judged=1, held_out=unseen)
training = TrainingOptions(steps=steps, rate=1e-3, check_every=max(2, steps // 10))
if NETWORK.exists():
    network, state = learn.RefocusNetwork.load(NETWORK, camera), None
else:
    trained = train(untrained, lessons, training, folder=FIGURES)
    network, state = trained.model, trained.state

# %%
if state is not None:
    figure, ax = plt.subplots(figsize=(6, 3.2), layout="constrained")
    ax.plot(1 + np.arange(len(state.losses)), state.losses, color="0.75", label="steps")
    checked = np.arange(1, len(state.scores) + 1) * training.check_every
    ax.plot(checked, state.scores, "ko-", label="unseen scenes")
    ax.set(xlabel="step", ylabel="loss (0.115 less is 1 dB)", title="training")
    ax.legend(frameon=False)
    figure.savefig(FIGURES / "training.png", dpi=110)

# %%
# A sweep of the focus
# --------------------
#
# One capture of two layers, at 30 dB, focused on distances even in 1/t: all are read from one
# explanation of the capture.

scenes = draw_batch(jax.random.key(5), jnp.asarray(unseen.images), camera, two, 2)
distances = np.asarray(refocus_distances(50.0, 200.0, 15))
reading = read(network, scenes.capture, distances, scenes.deviation)
images = np.asarray(reading.images)[..., ::-1, ::-1]  # upright
focused = eqx.filter_jit(scenes.target)
truths = np.stack([focused(camera, t) for t in distances], axis=1)[..., ::-1, ::-1]
white = np.percentile(truths[0], 99.8)

figure, axes = plt.subplots(3, 5, figsize=(11, 7), layout="constrained")
for ax, image, t in zip(axes.ravel(), images[0], distances, strict=True):
    ax.imshow(image, cmap="gray", vmin=0, vmax=white)
    ax.set_title(f"{t:.0f} mm", fontsize=10)
    ax.set_axis_off()
figure.savefig(FIGURES / "sweep.png", dpi=110)

# %%
levels = np.clip(images[0] / white, 0, 1) ** (1 / 2.2)
frames = [PIL.Image.fromarray(np.uint8(255 * frame)).resize((256, 256)) for frame in levels]
frames += frames[-2:0:-1]
frames[0].save(FIGURES / "sweep.gif", save_all=True, append_images=frames[1:], duration=140, loop=0)

# %%
# A map of distances
# ------------------
#
# Each pixel may have a focus of its own: left near and right far, and the other way round. The
# control code of thesis Fig 4.8 had such halves and was obeyed by neither.

near, far = distances[3], distances[-4]
left = np.arange(shape[1]) < shape[1] // 2  # of the upright image
figure, axes = plt.subplots(1, 4, figsize=(11, 3.2), layout="constrained")
for pair, first, second in ((axes[:2], near, far), (axes[2:], far, near)):
    wanted = np.where(left, first, second) * np.ones(shape)
    found = network.focus(scenes.capture[0], wanted[:, ::-1], scenes.deviation[0])[::-1, ::-1]
    lens = np.where(left, *(truths[0][list(distances).index(t)] for t in (first, second)))
    for ax, image, name in zip(pair, (lens, found), ("lenses", "network"), strict=True):
        ax.imshow(image, cmap="gray", vmin=0, vmax=white)
        ax.set_title(f"{name}: {first:.0f} | {second:.0f} mm", fontsize=10)
        ax.set_axis_off()
figure.savefig(FIGURES / "map.png", dpi=110)

# %%
# Trained distances are not special: PSNR against a lens of the mask's width, focused there, varies
# without jumps. The untrained network is the linear start alone.

linear = np.asarray(read(untrained, scenes.capture, distances, scenes.deviation).images)
linear = linear[..., ::-1, ::-1]
figure, ax = plt.subplots(figsize=(6, 3.4), layout="constrained")
for name, found, style in (("network", images, "ko-"), ("linear start", linear, "s--")):
    quality = np.mean(
        [
            [psnr(i, t) for i, t in zip(*pair, strict=True)]
            for pair in zip(found, truths, strict=True)
        ],
        axis=0,
    )
    ax.plot(distances, quality, style, markersize=4, label=name)
ax.set(xlabel="focused on (mm)", ylabel="PSNR (dB)", xscale="log", title="two layers, 30 dB")
ax.legend(frameon=False)
figure.savefig(FIGURES / "psnr.png", dpi=110)

# %%
# What to trust
# -------------
#
# `consistency` is the residual of the explained capture over the noise: about 1 where the stack
# explains what was seen. With a mask whose β is off by some per cent it is not explained any more,
# however good the image looks. And the network says of each pixel how sure it is of its distance.

errors = np.asarray([-0.04, -0.02, 0.0, 0.02, 0.04])
found = []
for error in errors:
    other = tc.LenslessCamera(
        tc.FresnelZoneAperture(beta=13.0 * (1 + error), width=width), thin.sensor, 7.5
    )
    seen = RefocusCamera(other, 500 * nm, field_shape=shape, near=50.0, far=200.0, planes=planes)
    # The same scene and the same noise through another mask.
    taken = draw_batch(jax.random.key(5), jnp.asarray(unseen.images), seen, two, 2)
    one = read(network, taken.capture, distances, taken.deviation)
    found.append(float(one.consistency.mean()))

wrong = np.abs(1 / reading.distance - scenes.inverse) > float(camera.step) / 2
confidence = np.asarray(reading.confidence).ravel()
order = np.argsort(confidence)
groups = np.array_split(order, 6)

figure, axes = plt.subplots(1, 2, figsize=(10, 3.4), layout="constrained")
axes[0].plot(100 * errors, found, "ko-")
axes[0].set(xlabel="error of β (%)", ylabel="residual (noise = 1)", title="another camera")
axes[0].set_ylim(bottom=0)
axes[1].plot(
    [confidence[g].mean() for g in groups], [1 - wrong.ravel()[g].mean() for g in groups], "ko-"
)
axes[1].plot([0, 1], [0, 1], color="0.7")
axes[1].set(xlabel="confidence told", ylabel="share within half a plane", title="distances")
figure.savefig(FIGURES / "trust.png", dpi=110)

# %%
# As a solver
# -----------
#
# The same network in place of any other solver; another camera, or a distance that it was not
# trained for, is refused in one line.

cameras = tc.Cameras([thin], wavelength=500 * nm, object_distance=distances)
variance = float(scenes.deviation[0] ** 2)
recording = tc.Recording([scenes.capture], cameras, noise_variance=variance)
result = tc.reconstruct(recording, tc.Learned(network))  # (capture, distance, y, x)
print(result.status, "residual over noise:", result.consistency, result.reason)
# The depths of focus above, mm, of the full mask.
assert [round(np.pi * t * (t + 7.5) / (13.0 * 7.5 * 2.8**2)) for t in (60, 120)] == [17, 63]
assert np.allclose(result.image[0], images[0], rtol=1e-3, atol=1e-3 * white)
try:
    tc.reconstruct(recording.focused(30.0), tc.Learned(network))
except ValueError as error:
    print(error)
else:
    raise AssertionError("30 mm were taken")
