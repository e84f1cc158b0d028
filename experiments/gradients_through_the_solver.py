"""Gradients through a reconstruction
==================================

Total variation has no closed form, and yet its image has an exact slope in everything it depends
on: the weight τ, the captures, the PSF and so the camera's own numbers. Here a photograph of a
known chart corrects the β that the mask was printed with, and finds the best τ on the way.
"""

import math
import os
from pathlib import Path

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import scipy.optimize

import thincam_jax as tc
from thincam_jax.imaging.targets import siemens_star
from thincam_jax.reconstruction import solve_fixed_point
from thincam_jax.units import nm, um

SMALL = os.environ.get("THINCAM_SIZE") == "small"
FIGURES = Path(os.environ.get("THINCAM_FIGURES", "runs/experiments"))
FIGURES /= "gradients_through_the_solver"
FIGURES.mkdir(parents=True, exist_ok=True)

# %%
# Two captures of a chart
# -----------------------
#
# With the phases 0 and π. The mask was ordered with β = 46 rad/mm² and has 50.

shape, pitch, width = ((24, 32), 50 * um, 0.84) if SMALL else ((48, 64), 50 * um, 1.2)
sensor, field = tc.Sensor(shape, pitch), (shape[0] // 2, shape[1] // 2)
wide = tc.Grid((shape[0] + field[0] - 1, shape[1] + field[1] - 1), pitch)
chart = jnp.asarray(siemens_star(field, spokes=6 if SMALL else 12), jnp.float32)[
    None, None
]  # (channel, plane, y, x)
ORDERED, TRUE = 46.0, 50.0


def problem_of(beta, tau, difference):
    """The difference of both captures, in which the bright background cancels, explained by β."""
    masks = [tc.FresnelZoneAperture(beta, phase, width=width) for phase in (0.0, math.pi)]
    cameras = [tc.LenslessCamera(mask, sensor, 4.0).on_grid(wide) for mask in masks]
    psfs = [
        tc.psf(camera, wavelength=500 * nm, object_distance=200.0, pixel_integration=False)
        for camera in cameras
    ]
    model = tc.Psfs((psfs[0] - psfs[1])[None], field_shape=field)
    return tc.Recording(difference[None], model, noise_variance=NOISE**2).problem(tau=tau)


NOISE = 0.2  # standard deviation, of the difference
clean = problem_of(TRUE, 1.0, jnp.zeros(shape)).operators[0](chart)[0]
noise = np.random.default_rng(0).normal(0, NOISE, shape).astype(np.float32)
seen = clean + noise
print(f"signal to noise {20 * math.log10(float(jnp.std(clean)) / NOISE):.1f} dB")

# %%
# The slope of the image's error
# ------------------------------
#
# `solve_fixed_point` is the iteration of `AdmmTV` under `jit` and `grad`. Its gradient is that of
# the minimiser, by the implicit function theorem: no iteration is stored.


def image_of(numbers):
    problem = problem_of(numbers[0], jnp.exp(numbers[1]), seen)
    return solve_fixed_point(problem, 0 * chart, iterations=100, tolerance=1e-6).image


@jax.jit
def error(numbers):
    """Mean squared difference of the image from the chart, dB, by β (rad/mm²) and log τ."""
    return 10 * jnp.log10(jnp.mean((image_of(numbers) - chart) ** 2))


slope = jax.jit(jax.grad(error))
start = np.array([ORDERED, math.log(0.05)], np.float32)
path = [start]
found = scipy.optimize.minimize(
    lambda x: float(error(np.float32(x))),
    start,
    jac=lambda x: np.asarray(slope(np.float32(x)), float),
    method="L-BFGS-B",
    bounds=[(40.0, 56.0), (math.log(0.01), math.log(20.0))],
    callback=lambda x: path.append(x),
    options={"maxiter": 6 if SMALL else 30},
)
print(f"β {found.x[0]:.2f} rad/mm², τ {math.exp(found.x[1]):.2f}, {found.nfev} gradients")

# %%
# The error over both, and the way down
# -------------------------------------

betas = np.linspace(44, 54, 4 if SMALL else 11)
log_taus = np.linspace(math.log(0.02), math.log(10), 3 if SMALL else 9)
grid = [[float(error(np.float32([b, t]))) for b in betas] for t in log_taus]
figure, ax = plt.subplots(figsize=(6.4, 4.2), layout="constrained")
shown = ax.contourf(betas, np.exp(log_taus), grid, 16, cmap="gray")
figure.colorbar(shown, ax=ax, label="error of the image (dB)")
way = np.array(path)
ax.plot(way[:, 0], np.exp(way[:, 1]), "o-", color="w", mec="k", label="the way by gradients")
ax.axvline(TRUE, color="w", linestyle=":")
ax.set(xlabel="β of the PSF (rad/mm²)", ylabel="τ", yscale="log")
ax.legend()
figure.savefig(FIGURES / "landscape.png", dpi=110)

figure, panels = plt.subplots(1, 3, figsize=(11, 3), layout="constrained")
ends = {"chart": chart, "β as ordered": image_of(start), "β and τ found": image_of(found.x)}
for ax, (name, image) in zip(panels, ends.items(), strict=True):
    ax.imshow(image[0, 0], cmap="gray", vmin=0, vmax=1)
    ax.set(title=name, xlabel="x (pixels)", ylabel="y (pixels)")
figure.savefig(FIGURES / "images.png", dpi=110)

step = np.float32([0.2, 0])
by_differences = float(error(start + step) - error(start - step)) / 0.4
np.testing.assert_allclose(slope(start)[0], by_differences, rtol=0.05)
assert abs(found.x[0] / TRUE - 1) < 0.01 and found.fun < float(error(start)) - 6
