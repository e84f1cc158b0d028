"""If the image looks like this
============================

What mistakes in the input look like, and what the program says of them. One photograph behind one
random mask, a colour sensor of 12 bit; everything else is the default.
"""

import os
import textwrap
import warnings
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import scipy.ndimage
import scipy.signal

import thincam_jax as tc
from thincam_jax import measured
from thincam_jax.imaging.targets import resize, sample_image
from thincam_jax.measured import Preparation, Raw
from thincam_jax.measured.examination import examine
from thincam_jax.studies.prepared import pixel_noise, reconstruct_prepared

SMALL = os.environ.get("THINCAM_SIZE") == "small"
FIGURES = Path(os.environ.get("THINCAM_FIGURES", "runs/experiments"))
FIGURES.mkdir(parents=True, exist_ok=True)
SHAPE = (64, 96) if SMALL else (192, 256)
SOLVER = tc.AdmmTV(iterations=20 if SMALL else 300)
DARK, FULL = 64, 4095

# %%
# The camera, its PSF and its captures
# ------------------------------------
#
# The PSF fills the middle of the sensor, a scene of half the sensor's size lies in front of it.

random = np.random.default_rng(0)
cells = np.kron(random.random([n // 6 for n in SHAPE]) < 0.3, np.ones((3, 3)))
PSF = scipy.ndimage.gaussian_filter(cells, 0.8)
SCENE = np.moveaxis(
    resize(sample_image("astronaut", linear=True), (SHAPE[0] // 2, SHAPE[1] // 2)), -1, 0
)


def seen(scene, psf=PSF):
    """Linear convolution (3, y, x) on the sensor."""
    room = [(n + k - 1 - m) for n, k, m in zip(SHAPE, psf.shape, scene.shape[1:], strict=True)]
    padded = np.pad(scene, [(0, 0), *((r // 2, r - r // 2) for r in room)])
    return np.stack([scipy.signal.fftconvolve(one, psf, "valid") for one in padded])


def counts(light, exposure=0.9):
    """Counts (y, x) or (y, x, 3) with photon and read noise; the brightest at `exposure`."""
    light = np.moveaxis(light, 0, -1) if light.ndim == 3 else light
    light = random.poisson(np.maximum(light / light.max(), 0) * exposure * (FULL - DARK))
    noisy = light + DARK + random.normal(0, 3, light.shape)
    return np.clip(noisy.round(), 0, FULL).astype(np.uint16)


def mosaic(image):
    """RGGB of (3, y, x)."""
    raw = np.array(image[1])
    raw[::2, ::2], raw[1::2, 1::2] = image[0, ::2, ::2], image[2, 1::2, 1::2]
    return raw


def on_sensor(psf):
    room = [n - k for n, k in zip(SHAPE, psf.shape, strict=True)]
    return np.pad(psf, [(r // 2, r - r // 2) for r in room])


white = np.ones((3, 1, 1))
capture, psf = counts(seen(SCENE)), counts(white * on_sensor(PSF))
colours = np.array([0.6, 1.0, 0.7])[:, None, None]
raw_capture = counts(mosaic(colours * seen(SCENE)))
raw_psf = counts(mosaic(colours * on_sensor(PSF)))
larger = scipy.ndimage.zoom(PSF, 1.06, order=1)

figure, axes = plt.subplots(1, 2, figsize=(9, 3.6), layout="constrained")
for ax, (name, raw) in zip(axes, {"PSF": psf, "capture": capture}.items(), strict=True):
    drawn = ax.imshow(raw[..., 1], cmap="gray")
    ax.set(title=f"{name}, green", xlabel="x (pixels)", ylabel="y (pixels)")
    figure.colorbar(drawn, ax=ax, label="counts")
figure.savefig(FIGURES / "handed-in.png", dpi=110)

# %%
# Nine ways to hand them in
# -------------------------
#
# `thincam reconstruct` does the same with files; its words for each stand below the image.


def made(psf, capture, background=DARK, bayer=None):
    """The image (3, y, x), and what was said."""
    capture, psf = Raw(capture, 12, name="capture"), Raw(psf, 12, name="PSF")
    options = Preparation(bayer=bayer)
    examined = examine([capture], psf, options)
    assert examined.psf is not None
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        ready = measured.prepare(
            examined.psf, examined.captures[0], background=background, options=options
        )
    done = reconstruct_prepared(ready, SOLVER, pixel_noise(ready))
    said = [str(one).partition(": ")[2] for one in examined.findings] + [done.found.reason]
    return done.image(), "; ".join(filter(None, said))


beyond = np.pad(SCENE, [(0, 0), (0, SHAPE[0] // 2), (0, SHAPE[1] // 2)], mode="symmetric")
light = np.moveaxis(counts(seen(beyond)) - DARK, -1, 0) / FULL
narrow = tc.Recording([light], tc.Psfs(PSF[None], field_shape=[n // 2 for n in SHAPE]))
narrow = tc.reconstruct(narrow, SOLVER)

shown = {
    "as it should be": made(psf, capture),
    "PSF and capture exchanged": made(capture, psf),
    "a PSF upside down": made(psf[::-1], capture),
    "a PSF 6 % too large": made(counts(white * on_sensor(larger)), capture),
    "exposed 4 times too long": made(psf, counts(seen(SCENE), 3.6)),
    "a background 8 times too high": made(psf, capture, 8 * DARK),
    "the Bayer pattern BGGR for RGGB": made(raw_psf, raw_capture, bayer="BGGR"),
    "a mosaic taken for grey": made(raw_psf, raw_capture),
    "a scene beyond the field": (np.asarray(narrow.image), narrow.reason),
}

# %%
# What they look like
# -------------------

figure, axes = plt.subplots(3, 3, figsize=(9.6, 10.4), layout="constrained")
for ax, (name, (image, said)) in zip(axes.flat, shown.items(), strict=True):
    image = np.asarray(image) if len(image) == 3 else np.repeat(image, 3, axis=0)
    first = [max((n - m // 2) // 2, 0) for n, m in zip(image.shape[1:], SHAPE, strict=True)]
    image = image[:, first[0] : first[0] + SHAPE[0] // 2, first[1] : first[1] + SHAPE[1] // 2]
    image = np.moveaxis(image, 0, -1)
    ax.imshow(np.clip(image / np.percentile(image, 99.5), 0, 1) ** (1 / 2.2))
    ax.set_title(name, fontsize=11)
    words = textwrap.shorten(said or "nothing is said", 150, placeholder=" …")
    ax.set_xlabel("\n".join(textwrap.wrap(words, 48)), fontsize=8)
    ax.set(xticks=[], yticks=[])
figure.savefig(FIGURES / "when-it-looks-wrong.png", dpi=110)
for name, (_, said) in shown.items():
    print(f"{name}: {said or 'nothing'}")

# %%
# Asserted: the right input raises no word, and six of the mistakes are named.

assert not shown["as it should be"][1]
if not SMALL:
    assert "exchange --psf and --capture" in shown["PSF and capture exchanged"][1]
    assert "turn the PSF" in shown["a PSF upside down"][1]
    assert "0.94 times the size" in shown["a PSF 6 % too large"][1]
    assert "saturated" in shown["exposed 4 times too long"][1]
    assert "give --bayer RGGB" in shown["a mosaic taken for grey"][1]
