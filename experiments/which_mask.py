# %% [markdown]
# # Which mask for which scene?
#
# One sensor, one photograph, equal light, and a mask of each sort: a pinhole, nine lenslets,
# Voronoi-Fresnel lenses, a diffuser, a MURA and a zone plate. What does the transfer function of
# each promise, and is it kept? `thincam run configs/masks.yaml` asks the same of more masks,
# scenes, colours and distances; here is how such a comparison is made. Lengths are in mm.

# %%
import os
from pathlib import Path

import jax
import matplotlib.pyplot as plt
import numpy as np

import thincam_jax as tc
from thincam_jax.imaging.metrics import psnr
from thincam_jax.imaging.targets import resize, sample_image
from thincam_jax.units import nm, um

SIZE = os.environ.get("THINCAM_SIZE", "full")  # "small": large pixels, in seconds
FIGURES = Path(os.environ.get("THINCAM_FIGURES", "runs/experiments")) / "which_mask"
FIGURES.mkdir(parents=True, exist_ok=True)

# %% [markdown]
# ## Six masks
#
# All are 0.744 mm wide (the pinhole lets through what one opening of 48 µm does) and stand 2 mm
# before the sensor, which holds their whole shadow from every direction of the scene.

# %%
pixels, pitch, iterations = {"full": (256, 6 * um, 60), "small": (64, 24 * um, 30)}[SIZE]
width, distance, away, green = 0.744, 2.0, 300.0, 550 * nm
blank = tc.MaskBlank((186, 186), 4 * um, 1.52)
keys = jax.random.split(jax.random.key(0), 3)
masks = {
    "pinhole": tc.Pinhole(48 * um),
    "9 lenslets": tc.LensletArray(2.0, width / 3, (3, 3)),
    "Voronoi-Fresnel": tc.voronoi_fresnel(
        keys[0], blank, sites=20, focal_length=2.0, wavelength=green
    ),
    "diffuser": tc.diffuser(keys[1], blank, correlation_length=40 * um, rms_slope=0.016),
    "MURA": tc.ModifiedUniformlyRedundantArray(31, 24 * um),
    "zone plate": tc.FresnelZoneAperture(100.0, width=width),
}


def camera_of(mask, electrons=None):
    return tc.LenslessCamera(
        mask, tc.Sensor((pixels, pixels), pitch, electrons=electrons), distance
    )


def model_of(mask):
    """Phase masks are sampled; all others have an exact PSF."""
    return "angular_spectrum" if mask.pure_phase and hasattr(mask, "height") else "separable"


# %% [markdown]
# ## What the transfer function promises
#
# An image rises from noise by |H|. Shot noise grows as the root of the light H(0), so that in much
# light |H|/√H(0) counts; read noise stays, so that in little light it is |H| itself.

# %%
psfs, responses, promise = {}, {}, {}
frequency = np.hypot(*np.meshgrid(*(np.fft.fftfreq(pixels, pitch),) * 2))
band = (frequency > 1 / (pixels * pitch / 2)) & (
    frequency < 0.25 / 6e-3 / (4 if SIZE == "small" else 1)
)
for name, mask in masks.items():
    given = {"wavelength": green, "object_distance": away, "pixel_integration": True}
    psfs[name] = np.asarray(tc.psf(camera_of(mask), model=model_of(mask), **given))
    responses[name] = np.abs(np.fft.fft2(psfs[name])) * pitch**2 / width**2
    light = responses[name][0, 0]
    size = np.sqrt(np.mean(responses[name][band] ** 2))
    promise[name] = {"light": light, "shot": size / np.sqrt(light), "read": size}
    print(
        f"{name}: light {light:.3f}, in shot noise {size / np.sqrt(light):.3f}, in read {size:.4f}"
    )

# %%
figure, axes = plt.subplots(2, 3, figsize=(11, 7), layout="constrained")
half = pixels * pitch / 2
for ax, (name, h) in zip(axes.ravel(), psfs.items(), strict=True):
    ax.imshow(h, cmap="gray", vmax=np.quantile(h, 0.998), extent=(-half, half, half, -half))
    ax.set(title=f"{name}: {100 * promise[name]['light']:.1f} % of the light", xlabel="x (mm)")
axes[0, 0].set(ylabel="y (mm)")
axes[1, 0].set(ylabel="y (mm)")
figure.savefig(FIGURES / "psfs.png", dpi=100)

# %% [markdown]
# ## What is kept
#
# Light is counted as electrons of a pixel of the bare sensor before a white scene, so that every
# mask gets the same exposure and pays for what it blocks. Read noise is 3 electrons. Total
# variation has the same τ for all here; the command finds it for each on another scene.

# %%
across = pixels // 2  # pixels of the scene on the sensor
picture = resize(sample_image("camera"), (across, across))
plane = tc.ImagePlane(picture, distance=away, width=across * pitch * away / distance)
scene, truth = tc.Scene(plane, green), picture
lights = (1e3, 1e4, 1e5)
images, scores = {}, {name: [] for name in masks}
for name, mask in masks.items():
    for electrons in lights:
        camera = camera_of(mask, electrons / (across * pitch) ** 2)
        strong = tc.Sensor(
            camera.sensor.shape, pitch, electrons=camera.sensor.electrons, full_well=1e8
        )
        camera = tc.LenslessCamera(mask, strong, distance)
        noise = tc.PoissonGaussianNoise(3.0)
        capture = tc.capture(camera, scene, noise=noise, key=keys[2], model=model_of(mask))
        imaging_model = tc.Cameras(
            [camera],
            wavelength=green,
            object_distance=away,
            field_shape=(across, across),
            model=model_of(mask),
        )
        variance = noise.variance(capture, strong.electrons.reshape(1, 1))
        recording = tc.Recording(capture[None], imaging_model, noise_variance=variance)
        result = tc.reconstruct(recording, tc.AdmmTV(tau=1.0, iterations=iterations))
        images[name, electrons] = np.asarray(result.image)
        scores[name].append(psnr(images[name, electrons], truth))
    print(name, [f"{score:.1f} dB" for score in scores[name]])

# %%
figure, axes = plt.subplots(2, 3, figsize=(11, 7.6), layout="constrained")
side = float(plane.width) / 2
for ax, (name, values) in zip(axes.ravel(), scores.items(), strict=True):
    ax.imshow(
        images[name, lights[-1]], cmap="gray", vmin=0, vmax=1, extent=(-side, side, side, -side)
    )
    ax.set(title=f"{name}: {values[-1]:.1f} dB", xlabel="x on the object (mm)")
figure.savefig(FIGURES / "images.png", dpi=100)

figure, axes = plt.subplots(1, 2, figsize=(10, 4), layout="constrained")
styles = ("k:o", "k-s", "k-D", "k--^", "k:v", "k-.*")
for (name, values), style in zip(scores.items(), styles, strict=True):
    axes[0].semilogx(lights, values, style, label=name)
    axes[1].semilogx(promise[name]["shot"], values[-1], style[0] + style[-1], label=name)
axes[0].set(xlabel="electrons a pixel of the bare sensor", ylabel="PSNR (dB)")
axes[1].set(xlabel="|H|/√H(0), relative to the open width", ylabel="PSNR in much light (dB)")
axes[1].set_xticks([0.03, 0.1, 0.3], ["0.03", "0.1", "0.3"], minor=False)
axes[1].minorticks_off()
for ax in axes:
    ax.grid(alpha=0.3)
axes[0].legend()
figure.savefig(FIGURES / "light.png", dpi=100)

# %% [markdown]
# - Few lenses put a third of their light into detail, where a code of 31 × 31 cells puts a
#   thirtieth: the transfer function says who wins before a capture is made.
# - The pinhole rises higher from shot noise than the amplitude codes, which pay with the noise of
#   all the light of a dense scene. In little light its few electrons drown in read noise, where the
#   codes have a hundred times as many.

# %%
best = {n: max(scores, key=lambda name, n=n: scores[name][n]) for n in (0, 2)}
assert best[2] in ("9 lenslets", "Voronoi-Fresnel") and best[0] in ("9 lenslets", "Voronoi-Fresnel")
assert promise["pinhole"]["shot"] > promise["MURA"]["shot"]
assert promise["pinhole"]["read"] < promise["MURA"]["read"]
assert scores["pinhole"][2] - scores["MURA"][2] > scores["pinhole"][0] - scores["MURA"][0]
