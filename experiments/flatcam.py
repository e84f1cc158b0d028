"""FlatCam: how many products is a camera?
=======================================

A FlatCam has a mask that is the product of two codes, so that rows and columns of the image are
coded independently: Y = P X Qᵀ. Two small decompositions then give its image, its best ridge and
the error bar of each pixel in closed form. How far does that carry when light is diffracted and
has all colours? Two masks of one maximum length sequence answer: "product" (open where both
codes are) and "xor" (open where one is, twice the light, the usual choice).
"""

import os
from pathlib import Path

import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import thincam_jax as tc
from thincam_jax.imaging.metrics import psnr
from thincam_jax.imaging.operators.separable import centred
from thincam_jax.imaging.targets import resize, sample_image
from thincam_jax.lensless.masks import maximum_length_sequence
from thincam_jax.units import nm, um

SIZE = os.environ.get("THINCAM_SIZE", "full")  # "small": a smaller camera, in seconds
FIGURES = Path(os.environ.get("THINCAM_FIGURES", "runs/experiments")) / "flatcam"
FIGURES.mkdir(parents=True, exist_ok=True)

# %%
# The camera
# ----------
#
# Cells of 30 µm, light of 400–700 nm. Mask, scene and sensor are
# such that the shadow overfills the sensor for every point of the scene.

full = SIZE == "full"
length, pixels, pitch = (255, (500, 620), 8 * um) if full else (63, (84, 100), 12 * um)
scene_shape, scene_pitch = ((96, 128), 20 * um) if full else ((18, 24), 24 * um)  # as projected
colours = tc.Spectrum(np.linspace(400, 700, 7 if full else 2) * nm)
object_distance = 250.0
code = maximum_length_sequence(length)


def camera(combine, distance):
    mask = tc.SeparableMask(code, code, cell=30 * um, combine=combine)
    return tc.LenslessCamera(mask, tc.Sensor(pixels, pitch), distance)


def scene(image, distance, light=colours):
    """An image that a pinhole at that distance would cast with pixels of `scene_pitch`."""
    width = scene_shape[1] * scene_pitch * object_distance / distance
    return tc.Scene(tc.ImagePlane(image, distance=object_distance, width=width), light)


photograph = resize(sample_image("camera", linear=True)[40:328, 130:514], scene_shape)

# %%
# Terms
# -----
#
# The operator is a sum of products; `separable_operator` finds the fewest that hold a tolerance.
# Row and column means are taken off first, as is usual: that removes the uniform half of the "xor"
# mask. What n terms miss of captures of white scenes, against n:

distances = (0.5, 1.0, 2.0) if full else (0.5, 2.0)
found = {
    (combine, distance): tc.separable_operator(
        camera(combine, distance),
        scene(photograph, distance),
        tolerance=1e-4,
        pixel_integration=full,  # a small script compiles less without
    )
    for combine in ("product", "xor")
    for distance in distances
}
figure, panels = plt.subplots(1, 2, figsize=(9, 3.4), sharey=True, layout="constrained")
for panel, combine in zip(panels, ("product", "xor"), strict=True):
    for distance in distances:
        errors = found[combine, distance].operator.centred().truncated().errors
        shown = np.maximum(np.asarray(errors), 1e-4)[:8]
        panel.semilogy(1 + np.arange(len(shown)), 100 * shown, "o-", label=f"{distance:g} mm")
        first, third = (100 * float(errors[min(n, len(errors) - 1)]) for n in (0, 2))
        print(f"{combine:8s} {distance:g} mm: one term misses {first:.1f} %, three {third:.2f} %")
    panel.set(title=f"Mask “{combine}”", xlabel="terms", xticks=range(1, 9))
    panel.legend(title="mask to sensor")
panels[0].set_ylabel("missed, % of the centred camera")
figure.savefig(FIGURES / "terms.png", dpi=130)

# %%
# Images
# ------
#
# One capture with each mask, 2 mm before the sensor, with the same noise: 1 % of the contrast
# behind "product". One term has everything in closed form: `Ridge("sure")` finds the ridge and how
# far pixels resemble their neighbours. What the term misses counts as noise. With all its terms,
# the "xor" camera takes preconditioned conjugate gradients. They need the centring: the uniform
# light is one mode a thousand times the others, below which float32 finds nothing.

lengths = (1.0, 2.0, 4.0, 8.0) if full else (2.0,)
image = jnp.asarray(photograph, found["product", distances[-1]].operator.left.dtype)
noise = 0.01 * float(found["product", distances[-1]].operator(image).std())
images, sigma, coverage = {}, None, None
for combine in ("product", "xor"):
    whole = found[combine, distances[-1]].operator
    clean = whole(image)
    capture = clean + noise * np.random.default_rng(3).normal(size=clean.shape).astype(np.float32)
    flat = centred(capture)
    one = whole.centred().truncated(terms=1)
    missed = float(one.error * flat.std())
    recording = tc.Recording(flat, one.operator, noise_variance=noise**2 + missed**2)
    solver = tc.Ridge("sure", correlation=lengths)
    images[f"{combine}, one term"] = tc.reconstruct(recording, solver).image
    if combine == "product":
        sigma, shown_capture = solver.deviation(recording), capture
        gap = np.abs(images["product, one term"] - photograph)
        coverage = float(np.mean(gap < 1.96 * sigma))
recording = tc.Recording(flat, whole.centred().with_modes(), noise_variance=noise**2)
solver = tc.Ridge(10.0, correlation=8.0 if full else 2.0)
result = tc.reconstruct(recording, solver)
images["xor, all terms"] = result.image

quality = {name: psnr(np.asarray(image), photograph) for name, image in images.items()}
for name, value in quality.items():
    print(f"{name}: {value:.1f} dB")
print(f"95 % intervals hold {100 * coverage:.1f} % of the pixels (product, one term)")
assert result.status == "converged" and quality["xor, all terms"] > quality["xor, one term"]
assert 0.85 < coverage < 1.0

# %%
figure, panels = plt.subplots(2, 3, figsize=(10, 5.4), layout="constrained")
shown = {
    "Scene": photograph,
    "Capture (product)": shown_capture,
    "Product, one term": images["product, one term"],
    "Error bars, 1.96 σ": 1.96 * sigma,
    "Xor, one term": images["xor, one term"],
    "Xor, all terms": images["xor, all terms"],
}
for panel, (title, image) in zip(panels.flat, shown.items(), strict=True):
    value = quality.get(title.lower())
    is_scene = title not in ("Capture (product)", "Error bars, 1.96 σ")
    limits = {"vmin": 0, "vmax": 1} if is_scene else {}
    colours_of = "viridis" if "bars" in title else "gray"
    drawn = panel.imshow(image, cmap=colours_of, **limits)
    panel.set_title(title if value is None else f"{title}: {value:.1f} dB")
    panel.set_xticks([]), panel.set_yticks([])
    if "bars" in title:
        figure.colorbar(drawn, ax=panel, label="parts of white")
        panel.set_xlabel(f"95 % intervals hold {100 * coverage:.0f} % of the pixels")
panels[0, 1].set_xlabel(f"{pixels[0]}×{pixels[1]} pixels")
figure.savefig(FIGURES / "images.png", dpi=130)
