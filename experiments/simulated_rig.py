# %% [markdown]
# # A rig from its first pattern to its image
#
# A light modulator shows zone apertures, a camera behind it takes a frame of each, and an image is
# made of the frames (method B of the thesis, section 3.4). One line of the file below says whether
# the devices are there: `rig: virtual` becomes `rig: real`, and the rest of this script stays.
# The virtual devices speak the real protocols: the camera USB3 Vision, the stage Zaber's ASCII.

# %%
import os
import tempfile
from pathlib import Path

import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import thincam_jax as tc
from thincam_jax.commands.capture.command import build_plan, opened
from thincam_jax.commands.capture.config import CaptureConfig
from thincam_jax.commands.checked_config import load_as
from thincam_jax.hardware.acquisition.acquire import Procedure, acquire
from thincam_jax.hardware.acquisition.read import read_acquisition
from thincam_jax.hardware.virtual.rig import Electronics
from thincam_jax.imaging.metrics import psnr
from thincam_jax.imaging.targets import sample_image
from thincam_jax.reconstruction import phase_pairs
from thincam_jax.reconstruction.noise import estimate_noise

SIZE = os.environ.get("THINCAM_SIZE", "full")  # "small": a smaller sensor, in seconds
FIGURES = Path(os.environ.get("THINCAM_FIGURES", "runs/experiments")) / "simulated_rig"
FIGURES.mkdir(parents=True, exist_ok=True)
rows, columns, pitch, side, electrons = {
    "full": (512, 512, 11, 156, 260_000),
    "small": (112, 144, 33, 80, 400_000),
}[SIZE]

# %% [markdown]
# ## The rig
#
# What is fixed, in the words of an experiment file; `thincam capture` takes the same.

# %%
FILE = f"""
name: simulated-rig
kind: capture
rig: {os.environ.get("THINCAM_RIG", "virtual")}  # or real
camera: {{driver: usb3_vision, exposure: 20 ms, pitch: {pitch} um}}
display: {{driver: sdl, pitch: 36 um, settle: 5 ms}}
stage: {{driver: zaber, options: {{port: /dev/ttyUSB0}}}}
plan:
  kind: method_b
  betas: [25 rad/mm^2, 21 rad/mm^2]
  width: {side * 0.036:g} mm
  dark_frames: 1
optics:
  wavelength: 532 nm
  distance: 6.5 mm
  object: {{distance: 250 mm, width: 130 mm}}
virtual:
  sensor: [{rows}, {columns}]
  display: [192, 256]
  electrons: {electrons}
  response: 2 ms
targets:
  - {{name: astronaut, kind: photograph, image: astronaut}}
"""
path = FIGURES / "rig.yaml"
path.write_text(FILE, encoding="utf-8")
config = load_as(CaptureConfig, path)

# %% [markdown]
# ## The capture
#
# For each step of the plan: move, show, settle, flush, trigger, check, keep. The virtual rig
# computes what its camera will see while the pattern is shown.

# %%
plan = build_plan(config)
with tempfile.TemporaryDirectory() as folder, opened(config) as rig:
    shown = [rig.render(plan.pattern(step)) for step in plan.steps]
    procedure = Procedure(settle=config.display.settle, timeout=2.0, saturated=0.01)
    outcome = acquire(plan, rig, Path(folder) / "frames.zarr", procedure=procedure)
    taken = read_acquisition(outcome.path)
    frames = jnp.asarray(taken.captures())  # without the dark frame, counts
print(f"{outcome.total} frames by {taken.provenance['devices']['camera']['model']}")
for step, seconds in outcome.seconds.items():
    print(f"  {step}: {1000 * seconds / outcome.total:.1f} ms a frame")

# %% [markdown]
# ## The image
#
# From the patterns that were shown, as from any others.

# %%
sensor = tc.Sensor(frames.shape[1:], pitch * 1e-3)
cameras = [
    tc.LenslessCamera(
        tc.FresnelZoneAperture(
            pattern.numbers["beta"],
            pattern.numbers["phase"],
            width=pattern.numbers["width"],
            pixel_pitch=config.display.pitch,
        ),
        sensor,
        config.optics.distance,
    )
    for pattern in taken.patterns
]
field = round(130 * 6.5 / 250 / float(sensor.pitch))
imaging_model = tc.Cameras(
    cameras, wavelength=config.optics.wavelength, object_distance=250.0, field_shape=(field, field)
)
recording = tc.Recording(frames, imaging_model, noise_variance=estimate_noise(frames) ** 2)
result = tc.reconstruct(recording, tc.Wiener(synthesis=phase_pairs(2)))
image = np.squeeze(np.asarray(result.image))

# %%
figure, axes = plt.subplots(1, 3, figsize=(12, 4.2), layout="constrained")
lit = taken.lit[0]
panels = [
    (shown[lit], 0.036, "pattern shown", "display"),
    (np.asarray(frames[0]), pitch * 1e-3, "frame taken", "sensor"),
    (image, float(result.pitch), "image reconstructed", "object"),
]
for ax, (picture, size, title, place) in zip(axes, panels, strict=True):
    height, width = (n * size / 2 for n in picture.shape)
    low, high = np.quantile(picture, (0.001, 0.999))
    ax.imshow(picture, cmap="gray", vmin=low, vmax=high, extent=(-width, width, height, -height))
    ax.set(title=title, xlabel=f"x on the {place} (mm)", ylabel=f"y on the {place} (mm)")
figure.savefig(FIGURES / "images.png", dpi=110)

# %%
figure, ax = plt.subplots(figsize=(7, 3), layout="constrained")
times = {name: 1000 * seconds / outcome.total for name, seconds in outcome.seconds.items()}
bars = ax.barh(list(times), list(times.values()), color="0.45")
ax.bar_label(bars, [f"{time:.1f} ms" for time in times.values()], padding=3)
ax.set(xscale="log", xlabel="mean time of a frame (ms)", ylabel="step")
ax.margins(x=0.2)
ax.invert_yaxis()
figure.savefig(FIGURES / "timing.png", dpi=110)

# %% [markdown]
# ## What this says
#
# The virtual rig computes what its camera sees from the pixels shown. By another model, the exact
# one of a zone aperture, the same frames are predicted to within the noise of the camera. A real
# rig has no scene to compare with; its frames and its image are in the figures above.

# %%
assert outcome.complete
if config.rig == "virtual":
    picture = sample_image("astronaut").mean(axis=-1)
    plane = tc.ImagePlane(picture, distance=250.0, width=130.0)
    virtual = config.virtual
    electron, _ = Electronics().scale(taken.settings[0])
    counts = electron * virtual.electrons * taken.settings[0].exposure
    scene = tc.Scene(plane, config.optics.wavelength)
    for frame, camera in zip(frames, cameras, strict=True):
        clean = counts * np.asarray(tc.capture(camera, scene))
        read = 2 * (electron * virtual.read_noise) ** 2 + 1 / 6  # of the dark frame, too
        residual = (np.asarray(frame) - clean) / np.sqrt(electron * clean + read)
        print(f"a frame's residual over its noise: {residual.std():.3f}")
        assert abs(residual.std() - 1) < 0.03
        assert abs(residual.mean()) < 0.1
    truth = np.asarray(plane.sample(tc.Grid(image.shape, result.pitch), magnification=1.0))
    score = psnr(image, truth)
    print(f"image: {score:.1f} dB")
    assert score > {"full": 19, "small": 15}[SIZE]
