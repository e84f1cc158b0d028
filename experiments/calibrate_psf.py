"""A camera's numbers from a picture of its PSF
============================================

How far is the mask from the sensor, and where is its middle? A drawing says so within a few per
cent, which is far too coarse to reconstruct with. One noisy picture of a distant point says it.
"""

import os
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

import thincam_jax as tc
from thincam_jax.imaging.metrics import psnr
from thincam_jax.imaging.targets import sample_image
from thincam_jax.units import nm, um

SMALL = os.environ.get("THINCAM_SIZE") == "small"
FIGURES = Path(os.environ.get("THINCAM_FIGURES", "runs/experiments")) / "calibrate_psf"
FIGURES.mkdir(parents=True, exist_ok=True)

# %%
# The picture, and the fit
# ------------------------
#
# The true camera has β 2.5 % and d 2 % off the drawing's, and its mask is 0.1 and 0.2 mm off the
# middle. `fit_psf` finds the fringes by a matched filter, then fits the exact PSF by least squares.

shape, pitch = ((96, 128), 44 * um) if SMALL else ((192, 256), 22 * um)
sensor = tc.Sensor(shape, pitch)
beta, fitted = (6.0, 6.15) if SMALL else (12.0, 12.3)
true = tc.LenslessCamera(
    tc.FresnelZoneAperture(fitted, 0.4, width=4.0, centre=(0.12, -0.2)), sensor, distance=6.62
)
drawing = tc.LenslessCamera(tc.FresnelZoneAperture(beta, width=4.0), sensor, distance=6.5)
light = {"wavelength": 500 * nm, "object_distance": 250.0}
exact = np.asarray(tc.psf(true, pixel_integration=True, **light))
picture = exact + 0.05 * np.random.default_rng(0).normal(size=exact.shape)
fit = tc.fit_psf(picture, drawing, **light)
print(fit.status, *fit.reasons)
for name, value in fit.values.items():
    print(f"{name:10} {float(value):8.4f} ± {float(fit.standard_errors[name]):.4f}")

figure, panels = plt.subplots(1, 3, figsize=(11, 3.2), sharey=True, layout="constrained")
residual = np.asarray(fit.residual)
images = {"measured": picture, "fitted": picture - residual, "measured − fitted": residual}
down, right = (n * pitch / 2 for n in shape)
for ax, (title, image) in zip(panels, images.items(), strict=True):
    low, high = (-0.5, 0.5) if image is residual else (0, 1.2)
    extent = (-right, right, down, -down)
    shown = ax.imshow(image, cmap="gray", vmin=low, vmax=high, extent=extent)
    ax.set(title=title, xlabel="x on the sensor (mm)")
    figure.colorbar(shown, ax=ax, label="irradiance (open aperture = 1)", shrink=0.75)
panels[0].set_ylabel("y on the sensor (mm)")
figure.savefig(FIGURES / "fit.png", dpi=100)

# %%
# What it is worth
# ----------------
#
# A capture of the true camera, reconstructed as if it were the drawing's, and with the fitted one.

plane = tc.ImagePlane(
    sample_image("chelsea", linear=True).mean(axis=-1), distance=250.0, width=120.0
)
capture = tc.capture(true, tc.Scene(plane, 500 * nm), key=0, noise=tc.GaussianNoise(snr_db=40.0))
field_shape = tuple(round(float(side) * 6.62 / 250 / pitch) for side in (plane.height, plane.width))
solver, found = tc.AdmmTV(tau=1.0, iterations=50 if SMALL else 300), {}
for name, camera in {"as drawn": drawing, "as fitted": fit.camera, "true": true}.items():
    optics = tc.Cameras([camera], field_shape=field_shape, **light)
    found[name] = tc.reconstruct(tc.Recording([capture], optics), solver)
grid = tc.Grid(field_shape, found["true"].pitch)
truth = np.asarray(plane.sample(grid, magnification=1.0))
quality = {name: psnr(result.image, truth) for name, result in found.items()}
print({name: round(value, 1) for name, value in quality.items()})
figure = tc.plot.compare({"scene": truth} | found, truth="scene")
figure.savefig(FIGURES / "images.png", dpi=110)

deviations = [
    abs(float(fit.values[name]) - value) / float(fit.standard_errors[name])
    for name, value in {"beta": fitted, "distance": 6.62, "centre_x": -0.2}.items()
]
assert fit.status == "ok" and max(deviations) < 3
assert abs(quality["as fitted"] - quality["true"]) < 0.3 < quality["true"] - quality["as drawn"]
