"""Priors of other packages on a recording
=======================================

A recording is a linear problem, and SciPy, PyLops, scico and deepinv solve linear problems: with
priors, optimisers and networks that are theirs. This script hands the same capture of a zone
aperture to each that is installed. deepinv wants `pip install deepinv`; scico caps the release of
JAX, so that it is installed with `pip install --no-deps scico flax pyabel`.
"""

import os
from importlib.util import find_spec
from pathlib import Path

import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
from scipy.sparse.linalg import lsqr

import thincam_jax as tc
from thincam_jax.imaging.metrics import align, psnr
from thincam_jax.imaging.targets import resize, sample_image
from thincam_jax.reconstruction.exchange import deepinv_physics, scico_operator, scipy_operator
from thincam_jax.units import nm, um

SIZE = os.environ.get("THINCAM_SIZE", "full")  # "small": fewer pixels and iterations
FIGURES = Path(os.environ.get("THINCAM_FIGURES", "runs/experiments")) / "other_packages"
FIGURES.mkdir(parents=True, exist_ok=True)
count, iterations = {"full": (160, 100), "small": (48, 5)}[SIZE]

# %%
# A recording
# -----------

mask = tc.FresnelZoneAperture(beta=20.0, width=4.4 * count / 160)
camera = tc.LenslessCamera(mask, tc.Sensor((count, count), 30 * um), distance=5.0)
picture = resize(sample_image("camera", linear=True), (count // 2, count // 2))
scene = tc.Scene(tc.ImagePlane(picture, distance=250.0, width=0.75 * count), 540 * nm)
recording = tc.record(camera, scene, noise=30.0, key=0)
images = {"AdmmTV()": np.squeeze(tc.reconstruct(recording, "admm_tv").image)}

# %%
# SciPy, and PyLops alike: least squares with a ridge
# ---------------------------------------------------

operator, measured, noise_std = scipy_operator(recording)
shape = images["AdmmTV()"].shape
strength = float(recording.problem(tau=2.0).absolute_tau) * noise_std**2  # as of AdmmTV()
damp = (5 * strength) ** 0.5
images["SciPy: LSQR"] = lsqr(operator, measured, damp=damp, iter_lim=iterations)[0].reshape(shape)

# %%
# scico: total variation by its ADMM
# ----------------------------------

if find_spec("scico"):
    from scico import functional, linop, loss, optimize

    operator, measured, noise_std = scico_operator(recording)
    step = linop.FiniteDifference(operator.input_shape, measured.dtype, axes=(-2, -1), append=0)
    solver = optimize.ADMM(
        f=loss.SquaredL2Loss(y=measured, A=operator),
        g_list=[strength * functional.L21Norm()],
        C_list=[step],
        rho_list=[30 * strength],
        x0=jnp.zeros(operator.input_shape, measured.dtype),
        maxiter=iterations,
    )
    images["scico: TV"] = np.squeeze(solver.solve())

# %%
# deepinv: total variation by FISTA
# ---------------------------------
#
# Any of its denoisers, data terms and unrolled networks takes the same physics.

if find_spec("deepinv"):
    import deepinv

    physics, tensor = deepinv_physics(recording)
    largest = float(physics.compute_sqnorm(0 * physics.A_adjoint(tensor) + 1.0))
    solver = deepinv.optim.FISTA(
        prior=deepinv.optim.prior.TVPrior(n_it_max=30),
        data_fidelity=deepinv.optim.data_fidelity.L2(),
        stepsize=1 / largest,
        lambda_reg=strength,
        max_iter=4 * iterations,
    )
    images["deepinv: TV"] = np.squeeze(solver(tensor, physics).numpy())

# %%

truth = resize(np.asarray(picture), shape)
figure, axes = plt.subplots(
    1, len(images) + 1, figsize=(2.2 * len(images) + 2.2, 2.6), layout="constrained"
)
axes[0].imshow(np.squeeze(recording.captures[0]), cmap="gray")
axes[0].set_title("capture")
for ax, (name, image) in zip(axes[1:], images.items(), strict=True):
    seen = np.asarray(align(jnp.asarray(image, jnp.float32), jnp.asarray(truth, jnp.float32)))
    decibels = float(psnr(jnp.asarray(seen), jnp.asarray(truth, jnp.float32)))
    print(f"{name:12} {decibels:5.1f} dB after gain and offset")
    images[name] = seen
    ax.imshow(seen, cmap="gray", vmin=0, vmax=1)
    ax.set_title(f"{name}\n{decibels:.1f} dB", fontsize=9)
for ax in axes:
    ax.set(xticks=[], yticks=[])
figure.savefig(FIGURES / "other-packages.png", dpi=120)

# %%
# Four rows of the images:

figure, axes = plt.subplots(2, 2, figsize=(10, 5), sharey=True, layout="constrained")
for ax, place in zip(axes.flat, (0.2, 0.4, 0.6, 0.8), strict=True):
    row = int(place * len(truth))
    for name, image in {"photograph": truth, **images}.items():
        ax.plot(image[row], "k:" if image is truth else "-", label=name)
    ax.set(title=f"row {row}", xlabel="x (pixels)", ylabel="brightness (white = 1)")
axes[0, 0].legend(fontsize=8)
figure.savefig(FIGURES / "rows.png", dpi=100)
