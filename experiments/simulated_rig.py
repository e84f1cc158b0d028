"""A rig from its first pattern to its image
=========================================

A light modulator shows zone apertures, a camera behind it takes a frame of each, and an image is
made of the frames (method B of the thesis, section 3.4). Without a `virtual` rig below, the same
drivers open real devices, and the rest of this script stays. The virtual stage speaks Zaber's real
protocol, the camera is a function. `thincam capture` does the same with an experiment file.
"""

import os
import tempfile
from pathlib import Path

import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import thincam_jax as tc
from thincam_jax.hardware import Acquisition, CameraSettings, acquire, plans
from thincam_jax.hardware.acquisition.taker import Procedure
from thincam_jax.hardware.virtual import VirtualRig
from thincam_jax.hardware.virtual.optics import ModulatorOptics
from thincam_jax.hardware.virtual.rig import Electronics
from thincam_jax.imaging.metrics import psnr
from thincam_jax.imaging.targets import sample_image
from thincam_jax.reconstruction import phase_pairs
from thincam_jax.reconstruction.noise import estimate_noise
from thincam_jax.units import nm, um

SIZE = os.environ.get("THINCAM_SIZE", "full")  # "small": a smaller sensor, in seconds
FIGURES = Path(os.environ.get("THINCAM_FIGURES", "runs/experiments")) / "simulated_rig"
FIGURES.mkdir(parents=True, exist_ok=True)
shape, pitch, side, electrons = {
    "full": ((512, 512), 11 * um, 156, 2.6e5),
    "small": ((112, 144), 33 * um, 80, 4e5),
}[SIZE]

# %%
# The rig
# -------
#
# A modulator of 36 µm pixels at 6.5 mm from the sensor, a photograph at 250 mm, and the drivers of
# the devices.

display_pitch, distance, wavelength = 36 * um, 6.5, 532 * nm
picture = sample_image("astronaut", linear=True).mean(axis=-1)
scene = tc.Scene(tc.ImagePlane(picture, distance=250.0, width=130.0), wavelength)
electronics = Electronics()
virtual = None
if os.environ.get("THINCAM_RIG", "virtual") == "virtual":
    sensor = tc.Sensor(shape, pitch)
    optics = ModulatorOptics(scene, sensor, display_pitch, distance, electrons)
    virtual = VirtualRig(optics, electronics, display_shape=(192, 256), response=2e-3)
drivers = {
    "camera": ("aravis", {}),
    "display": ("sdl", {}),
    "stage": ("zaber", {"port": "/dev/ttyUSB0"}),
}

# %%
# The capture
# -----------
#
# For each step of the plan: move, show, settle, flush, trigger, check, keep. The virtual rig
# computes what its camera will see while the pattern is shown.

mask = plans.zone_plate(25.0, side * display_pitch)
settings = CameraSettings(exposure=20e-3, pixel_format="Mono12")
plan = plans.method_b(mask, (25.0, 21.0), settings, dark_frames=1).at_position(0.0)
with (
    tempfile.TemporaryDirectory() as folder,
    tc.hardware.open_rig(drivers, display_pitch, virtual=virtual) as rig,
):
    shown = [rig.render(plan.pattern(step)) for step in plan.steps]
    procedure = Procedure(settle=5e-3, timeout=2.0, saturated=0.01)
    outcome = acquire(plan, rig, Path(folder) / "frames.zarr", procedure=procedure)
    taken = Acquisition.load(outcome.path)
    frames = jnp.asarray(taken.captures())  # without the dark frame, counts
print(f"{outcome.total} frames by {taken.provenance['devices']['camera']['model']}")
for step, seconds in outcome.seconds.items():
    print(f"  {step}: {1000 * seconds / outcome.total:.1f} ms a frame")

# %%
# The image
# ---------
#
# From the patterns that were shown, as from any others.

sensor = tc.Sensor(frames.shape[1:], pitch)
cameras = [
    tc.LenslessCamera(
        tc.FresnelZoneAperture(
            pattern.numbers["beta"],
            pattern.numbers["phase"],
            width=pattern.numbers["width"],
            pixel_pitch=display_pitch,
        ),
        sensor,
        distance,
    )
    for pattern in taken.patterns
]
field = round(130 * distance / 250 / pitch)
imaging_model = tc.Cameras(
    cameras, wavelength=wavelength, object_distance=250.0, field_shape=(field, field)
)
recording = tc.Recording(frames, imaging_model, noise_variance=estimate_noise(frames) ** 2)
result = tc.reconstruct(recording, tc.Wiener(synthesis=phase_pairs(2)))
image = np.squeeze(np.asarray(result.image))

# %%
figure, axes = plt.subplots(1, 3, figsize=(12, 4.2), layout="constrained")
lit = taken.lit[0]
panels = [
    (shown[lit], display_pitch, "pattern shown", "display"),
    (np.asarray(frames[0]), pitch, "frame taken", "sensor"),
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

# %%
# What this says
# --------------
#
# The virtual rig computes what its camera sees from the pixels shown. By another model, the exact
# one of a zone aperture, the same frames are predicted to within the noise of the camera. A real
# rig has no scene to compare with; its frames and its image are in the figures above.

assert outcome.complete
if virtual is not None:
    electron, _ = electronics.scale(taken.settings[0])
    counts = electron * electrons * taken.settings[0].exposure
    for frame, camera in zip(frames, cameras, strict=True):
        clean = counts * np.asarray(tc.capture(camera, scene))
        read = 2 * (electron * electronics.read_noise) ** 2 + 1 / 6  # of the dark frame, too
        residual = (np.asarray(frame) - clean) / np.sqrt(electron * clean + read)
        print(f"a frame's residual over its noise: {residual.std():.3f}")
        assert abs(residual.std() - 1) < 0.03
        assert abs(residual.mean()) < 0.1
    truth = np.asarray(
        scene.planes[0].sample(tc.Grid(image.shape, result.pitch), magnification=1.0)
    )
    score = psnr(image, truth)
    print(f"image: {score:.1f} dB")
    assert score > {"full": 19, "small": 15}[SIZE]
