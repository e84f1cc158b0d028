"""A photograph, its capture and its image
=======================================

Three lines: a camera, what it records of a photograph on a screen, and the image. The camera is a
Fresnel zone aperture before a bare sensor, lengths are in mm. The capture looks like fog: every
point of the scene casts the whole aperture's shadow. The prior of the image is the network that
the package brings.
"""

import os
from pathlib import Path

import numpy as np
from PIL import Image

import thincam_jax as tc
from thincam_jax.imaging.targets import sample_image

SIZE = os.environ.get("THINCAM_SIZE", "full")  # "small": a smaller camera, in seconds
FIGURES = Path(os.environ.get("THINCAM_FIGURES", "runs/experiments")) / "three_lines"
FIGURES.mkdir(parents=True, exist_ok=True)
pixels, beta = {"full": (512, 25.0), "small": (96, 4.0)}[SIZE]

# %%
# Any file of a photograph; here a cat of scikit-image's.

path = FIGURES / "photo.png"
codes = sample_image("chelsea", linear=True)
Image.fromarray(np.uint8(255 * codes + 0.5)).save(path)

# %%
# The signal is 50 dB above the noise. That is of all light: most of it is a bright background that
# says nothing of the scene, so that the fog of its contrast has some 36 dB.

mask = tc.FresnelZoneAperture(beta=beta, width=5.6)
sensor = tc.Sensor((pixels, pixels), 5.632 / pixels)
camera = tc.LenslessCamera(mask, sensor, distance=6.5)
scene = tc.Scene.photograph(path, distance=250.0, width=180.0)
recording = tc.record(camera, scene, noise=50.0)
result = tc.reconstruct(recording, "pnp")
# %%
# In a notebook `result` shows itself. Beside photograph and capture:

photograph, capture = scene.planes[0].image, recording.captures[0]
figure = tc.plot.compare({"photograph": photograph, "capture": capture, "image": result})
figure.savefig(FIGURES / "images.png", dpi=110)

# %%
# The shadow that a green point casts through the mask, the PSF, in mm:

psf = tc.plot.psf(camera, wavelength=532e-6, object_distance=250.0)
psf.savefig(FIGURES / "psf.png", dpi=110)
