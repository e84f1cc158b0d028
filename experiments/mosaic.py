"""Four captures in one exposure
=============================

Fringe scanning takes four captures, at four phases of the mask. The thesis (Fig 3.3) also has them
side by side: four masks on one sensor, one exposure. Each has a quarter of the pixels, sees the
scene from its own place, and, without walls, lights its neighbours. When is that better than four
captures, one after another, on the whole sensor?
"""

import math
import os
from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import scipy.optimize

import thincam_jax as tc
from thincam_jax.lensless.exposures import Layout
from thincam_jax.lensless.forward import imaging_operator, in_steps, project, projected_shape
from thincam_jax.studies import Method, Study, Target
from thincam_jax.studies.evaluate import evaluate, expose, field_shape, reconstructor, stacked
from thincam_jax.units import nm, um

# "whole": all of the thesis' pixels, one noise; "half": half the sensor, with total variation;
# "small": a quarter of it, in a minute.
SIZE = os.environ.get("THINCAM_SIZE", "full")
FIGURES = Path(os.environ.get("THINCAM_FIGURES", "runs/experiments")) / "mosaic"
FIGURES.mkdir(parents=True, exist_ok=True)

# The sensor of the thesis, 5.632 mm, with pixels of twice its pitch; "small" is a quarter as wide,
# with zones as fine. Masks of half the width and twice the β have the same band.
count, pitch, seeds, noises = {
    "whole": (1024, 5.5 * um, 1, (40,)),
    "full": (512, 11 * um, 3, (30, 40)),
    "half": (256, 11 * um, 1, (40,)),
    "small": (128, 11 * um, 1, (40,)),
}[SIZE]
part = round(5.632 / (count * pitch))
light, distance, place = 500 * nm, 6.5, (250.0, 90.0 / part)
sensor = tc.Sensor((count, count), pitch)
beta, small, wall = 50.0 * part, 2.7 / part, 0.1 / part
phases = [[0.0, math.pi / 2], [math.pi, 3 * math.pi / 2]]


def mosaic(wall, beta=beta, spacers=None):
    masks = [[tc.FresnelZoneAperture(beta, phase, width=small) for phase in row] for row in phases]
    return tc.Mosaic(masks, sensor, distance, wall=wall, spacers=spacers)


# %%
# Its light on the sensor
# -----------------------
#
# With walls each part has the shadow of its own mask. Without, the fields of all masks add up: each
# shadow has its place, and at their borders the waves of their edges interfere. Below, one line
# beside a sum of the Fresnel integral over 40,000 points of each mask.

walled, free = mosaic(wall), mosaic(None)
near = {"wavelength": light, "object_distance": 60.0}
frames = {
    "walls": walled.join([tc.psf(camera, **near) for camera in walled.cameras]),
    "no walls": tc.psf(free.whole, **near),
}


def direct(row):
    """Irradiance along a row of pixels' centres, by summing up the Fresnel integral."""
    scale = 1 + distance / near["object_distance"]
    b, x = math.pi * scale / (light * distance), np.asarray(sensor.grid.x, float) / scale
    y = float(sensor.grid.y[row]) / scale
    nodes = small * ((np.arange(40_000) + 0.5) / 40_000 - 0.5)
    field, cell = 0.0, count * pitch / 2
    for (down, across), phase in zip(
        [(v, u) for v in (-0.5, 0.5) for u in (-0.5, 0.5)], np.ravel(phases), strict=True
    ):
        for order, weight in ((0, 0.5), (1, 0.25), (-1, 0.25)):  # ½(1 + cos(βr² + φ))
            zones = np.exp(1j * order * beta * nodes**2) * small / len(nodes)
            along = [
                np.array([np.exp(1j * b * (at - middle * cell - nodes) ** 2) @ zones for at in ats])
                for ats, middle in (([y], down), (x, across))
            ]
            field = field + weight * np.exp(1j * order * phase) * along[0] * along[1]
    return np.abs(b / math.pi * field) ** 2


row = count // 2 - 3
points = {"wavelength": light, "object_distance": 60.0, "pixel_integration": False}
line, summed = np.asarray(tc.psf(free.whole, **points))[row], direct(row)
from_sum = np.linalg.norm(line - summed) / np.linalg.norm(summed)
print(f"PSF without walls, from the direct sum: {from_sum:.1e}")

figure, axes = plt.subplots(1, 3, figsize=(12.5, 4.0), layout="constrained")
half = count * pitch / 2
for ax, (name, frame) in zip(axes, frames.items(), strict=False):
    picture = ax.imshow(frame, cmap="gray", extent=(-half, half, half, -half))
    ax.set(title=f"PSF, {name}", xlabel="x on the sensor (mm)", ylabel="y on the sensor (mm)")
figure.colorbar(picture, ax=axes[:2], label="irradiance, relative to no mask", shrink=0.85)
middle = slice(count // 2 - 24, count // 2 + 24)
axes[2].plot(sensor.grid.x[middle], line[middle], color="0.0", label="closed form")
axes[2].plot(sensor.grid.x[middle], summed[middle], "o", ms=4, mfc="none", color="C1", label="sum")
axes[2].set(title="between two masks, no walls", xlabel="x on the sensor (mm)")
axes[2].set_ylabel("irradiance, relative to no mask")
axes[2].legend()
figure.savefig(FIGURES / "psf.png", dpi=110)

# %%
# Near objects
# ------------
#
# A part at c sees a point at t displaced by (d/t)·c. Its PSF holds this, so that reconstructions of
# all parts agree. The same captures, as if all parts stood in one place:

steps = (40.0, 80.0, 160.0, 320.0) if part == 1 else (20.0, 80.0)
photographs = ("camera", "coins", "rocket")[: {1: 3, 2: 2}.get(part, 1)]


def decibels(recording, scene):
    """PSNR of the Wiener filter's image after the best gain and offset."""
    found = tc.reconstruct(recording, tc.Wiener())
    grid = tc.Grid(found.image.shape, found.pitch)
    truth = scene.planes[0].sample(grid, magnification=1.0)
    aligned = tc.imaging.metrics.align(np.asarray(found.image), np.asarray(truth))
    return float(tc.imaging.metrics.psnr(aligned, np.asarray(truth)))


parallax = {}
for step in steps:
    rows = []
    for name in photographs:
        picture = tc.imaging.targets.sample_image(name)
        grey = picture if picture.ndim == 2 else picture.mean(axis=-1)
        plane = tc.ImagePlane(grey[:400, :400], step, 0.3 * step / part)
        scene = tc.Scene(plane, light)
        recording = tc.record(walled, scene, noise=40.0)
        optics = recording.imaging_model
        alone = optics.replace(cameras=[one.replace(place=None) for one in optics.cameras])
        rows.append(
            [decibels(r, scene) for r in (recording, recording.replace(imaging_model=alone))]
        )
    parallax[step] = np.array(rows)
    moved = 2 * distance / step * float(abs(walled.cameras[0].place[0]))
    print(
        f"t = {step:g} mm: parts differ by {moved / pitch:.1f} pixels; "
        f"{parallax[step].mean(axis=0).round(1)} dB registered and not, "
        f"spread {parallax[step].std(axis=0).round(1)}"
    )

# %%
# One exposure, or four one after another
# ---------------------------------------
#
# All have the same total time: an exposure of 4, or four of 1. The electrons are those at which one
# capture by a mask of the sensor's width has the SNR given, in the whole time. The scene moves by
# so many pixels of 11 µm in it. Method A′ is two β at four phases: eight captures of a half,
# or eight masks. Halves of the width cost half of the resolution, or take twice the β.

ways = {1: (0, 4, 8, 16), 2: (0, 4, 8, 16, 32), 4: (0, 8)}[part]
shape = {"wavelength": light, "width": 5.632 / part}
parts_of = {"wavelength": light, "width": small, "relative_time": 4}
four, eight = Layout(2, 2, wall), Layout(2, 4, wall)
scanned = tc.Exposures(beta / 2, distance, **shape).fringe_scanned()
pairs = tc.Exposures([beta / 2, beta * 0.42], distance, **shape).phase_pairs()
prime = tc.Exposures([beta / 2, beta * 0.42], distance, relative_time=0.5, **shape)
own = tc.Exposures(beta, distance, **parts_of).fringe_scanned().at_once(four)
own_pairs = tc.Exposures([beta, 0.84 * beta], distance, **parts_of).phase_pairs().at_once(four)
narrow = parts_of | {"width": 1.3 / part}
own_prime = tc.Exposures([2 * beta, 1.68 * beta], distance, **narrow).fringe_scanned()
wiener = tc.Wiener()
methods = (
    Method("4 captures", scanned, wiener, "fringe_scanning"),
    Method("mosaic of 4", own, wiener, "fringe_scanning"),
    Method("method B", pairs, wiener, "phase_pairs"),
    Method("method B, mosaic", own_pairs, wiener, "phase_pairs"),
    Method("method A′", prime.fringe_scanned(), wiener, "fringe_scanning"),
    Method("method A′, mosaic", own_prime.at_once(eight), wiener, "fringe_scanning"),
)
targets = [
    replace(Target.usaf1951(*place), number=0),
    *(replace(Target.photograph(n, *place), number=i) for i, n in enumerate(photographs, 1)),
]
print("captures:", {method.name: len(method.exposures) for method in methods})
tv = tc.AdmmTV(0.3, iterations=60)
if part > 1:
    methods = methods[:2]
if SIZE == "half":
    short = tc.Exposures(beta, distance, **parts_of | {"relative_time": 1}).fringe_scanned()
    methods += (
        Method("4 captures, TV", scanned, tv, "fringe_scanning"),
        Method("mosaic of 4, TV", own, tv, "fringe_scanning"),
        Method("short mosaic, TV", short.at_once(four), tv, "fringe_scanning"),
    )
still = [method for method in methods if "A′" in method.name]


def electrons(snr_db):
    """Electrons of an exposure of 1 at which one of 4 on the whole sensor has an SNR."""
    camera = tc.LenslessCamera(tc.FresnelZoneAperture(beta / 2, width=shape["width"]), sensor, 6.5)
    plane = tc.ImagePlane(targets[1].plane.image[0], *place)
    image = np.asarray(tc.capture(camera, tc.Scene(plane, light)), float)
    return 10 ** (snr_db / 10) * image.mean() / image.var() / 4


studies = {
    snr: Study(
        tc.FresnelZoneAperture(beta, width=small),
        sensor.replace(electrons=electrons(snr), full_well=1e9),
        methods,
        tuple(targets),
        250.0,
        noise=tc.PoissonGaussianNoise(2.0),
    )
    for snr in noises
}


def moving(method, pixels):
    """The exposures of a scene that goes so many pixels of 11 µm in all."""
    speed = pixels * 11 * um * 250 / distance / 4
    return method.exposures.of_moving(speed) if speed else method.exposures


# The PSF of each exposure, and the filter of each method, are computed once.
study, found = studies[noises[0]], {}
for method in methods:
    shape = field_shape(study, method, targets[0])
    solve = reconstructor(study, method, shape, 250.0)
    cameras = [study.camera(exposure) for exposure in method.exposures]
    field = in_steps(projected_shape(cameras[0], targets[0].plane))
    optics = [imaging_operator(one, light, 250.0, field_shape=field) for one in cameras]
    for pixels in ways[:1] if method in still else ways:
        ends = [exposure.moves for exposure in moving(method, pixels)]
        for target in targets:
            planes = [replace(target.plane, moves=one) for one in ends]
            clean = [
                seen(project(camera, plane, field))
                for seen, camera, plane in zip(optics, cameras, planes, strict=True)
            ]
            for snr, noisy in studies.items():
                scores = found.setdefault((snr, pixels), {}).setdefault(target.name, {})
                scores[method.name] = [
                    evaluate(method, target, solve(*stacked(taken))).scores
                    for trial in range(seeds)
                    for taken in [
                        [
                            expose(noisy, exposure, image, target.number, trial)
                            for exposure, image in zip(method.exposures, clean, strict=True)
                        ]
                    ]
                ]
    print(f"{method.name}: done", flush=True)


def psnrs(snr, pixels, name):
    """PSNR (photograph, seed)."""
    scores = [found[snr, pixels][photograph][name] for photograph in photographs]
    return np.array([[one.psnr_db for one in seeds] for seeds in scores])


def lines(snr, pixels, name):
    """Line pairs resolved of the chart, mm, by seed."""
    scores = found[snr, pixels]["USAF-1951"][name]
    return [None if one.resolved is None else one.resolved.object_mm for one in scores]


for snr in noises:
    for method in methods:
        gone = ways[:1] if method in still else ways
        means = [psnrs(snr, pixels, method.name).mean() for pixels in gone]
        spread = psnrs(snr, 0, method.name)
        print(
            f"{snr} dB, {method.name}: {np.round(means, 1)} dB; over images "
            f"{spread.mean(axis=1).std():.1f}, over seeds {spread.std(axis=1).max():.2f}; "
            f"line pairs {lines(snr, 0, method.name)} mm, in motion "
            f"{lines(snr, gone[-1], method.name)}"
        )

# %%
figure, axes = plt.subplots(1, len(noises), figsize=(4 + 4 * len(noises), 4.2), sharey=True)
for ax, snr in zip(np.atleast_1d(axes), noises, strict=True):
    for method in methods:
        if method in still:
            continue
        color = "C0" if "TV" in method.name else "C1" if "B" in method.name else "0.0"
        style = ":" if "short" in method.name else "-" if "mosaic" in method.name else "--"
        marker = {":": "^", "-": "o", "--": "s"}[style]
        means = [psnrs(snr, pixels, method.name).mean() for pixels in ways]
        ax.plot(ways, means, style, color=color, marker=marker, label=method.name)
    ax.set_xscale("symlog", base=2, linthresh=1)
    ax.set_xticks(ways, [str(pixels) for pixels in ways])
    ax.set(title=f"{snr} dB on the whole sensor", xlabel="pixels moved in the whole time")
    ax.grid(alpha=0.3)
np.atleast_1d(axes)[0].set_ylabel(f"PSNR (dB), mean of {len(photographs)} photographs")
np.atleast_1d(axes)[-1].legend(loc="center left", bbox_to_anchor=(1.0, 0.5))
figure.tight_layout()
figure.savefig(FIGURES / "speeds.png", dpi=110)

# %%
# Without walls
# -------------
#
# Every part has light of its neighbours. Three ways to take it: all masks as one PSF of the whole
# sensor; the parts, whose PSFs hold their neighbours' light; and the parts as if there were walls.

tv = tc.AdmmTV(iterations=60)
plane = tc.ImagePlane(targets[1].plane.image[0], *place)
scene = tc.Scene(plane, light)
split = tc.record(free, scene, noise=40.0)
alone = split.imaging_model.replace(cameras=mosaic(0.0).cameras)
ways_out = {
    "walls": tc.record(walled, scene, noise=40.0),
    "no walls, one PSF": tc.record(free.whole, scene, noise=40.0),
    "no walls, parts": split,
    "no walls, neighbours ignored": split.replace(imaging_model=alone),
}
images = {name: tc.reconstruct(recording, tv) for name, recording in ways_out.items()}
scored = {}
for name, result in images.items():
    truth = np.asarray(plane.sample(tc.Grid(result.image.shape, result.pitch), magnification=1.0))
    scored[name] = tc.imaging.metrics.psnr(np.asarray(result.image), truth)
    print(f"TV, {name}: {scored[name]:.1f} dB")
sums = {
    name: float(jnp.sum(tc.capture(one, scene))) for name, one in (("walls", walled), ("no", free))
}
print(f"light that walls take: {1 - sums['walls'] / sums['no']:.0%}")
figure, axes = plt.subplots(1, len(images), figsize=(3.1 * len(images), 3.5), layout="constrained")
for ax, (name, result) in zip(axes, images.items(), strict=True):
    image = np.asarray(result.image)
    ax.imshow(np.clip(image, 0, 1), cmap="gray", vmin=0, vmax=1)
    ax.set(xticks=[], yticks=[], title=name, xlabel=f"{scored[name]:.1f} dB")
figure.savefig(FIGURES / "walls.png", dpi=110)

# %%
# A mosaic designed by gradient
# -----------------------------
#
# Two β and two heights of spacers, for pairs of phases (method B): the expected error of the Wiener
# filter, 1/(1/η_f + Σ|H|²/η) averaged over frequencies, for a scene of spectrum η_f ∝ 1/f².

fine = 64 if SIZE == "small" else 256
alone = tc.Sensor((fine, fine), 11 * um)
rho2 = np.asarray(alone.grid.v)[:, None] ** 2 + np.asarray(alone.grid.u) ** 2
scene_power = 3e3 / (rho2 + (2 / (fine * 11 * um)) ** 2)


def cost(numbers):
    """Expected error over that without captures; β over 50 or its like, heights in mm."""
    betas, heights = beta * numbers[:2], numbers[2:]
    error = 1 / scene_power
    for one, height in zip(betas, heights, strict=True):
        pair = [
            tc.otf(
                tc.LenslessCamera(
                    tc.FresnelZoneAperture(one, phase, width=small), alone, distance + height
                ),
                wavelength=light,
                object_distance=250.0,
            )
            for phase in (0.0, 3 * math.pi / 2)
        ]
        error = error + jnp.abs(pair[0] - pair[1]) ** 2 / small**4 * 1e4
    return jnp.mean(1 / error) / np.mean(scene_power)


slopes = jax.jit(jax.value_and_grad(cost))
begin = np.array([1.0, 0.84, 0.0, 0.0])
moves = 1e-3 * np.eye(4)[2]
slope = float(slopes(jnp.asarray(begin))[1] @ moves) / 1e-3
differences = float(cost(jnp.asarray(begin + moves)) - cost(jnp.asarray(begin - moves))) / 2e-3
print(f"slope in a spacer's height: {slope:.4g}, by differences {differences:.4g}")


def by_scipy(numbers):
    value, gradient = slopes(jnp.asarray(numbers))
    return float(value), np.asarray(gradient, float)


bounds = [(0.6, 1.1), (0.6, 1.1), (0.0, 2.0), (0.0, 2.0)]
best = scipy.optimize.minimize(
    by_scipy, begin, jac=True, bounds=bounds, options={"maxiter": 25 if part == 1 else 3}
)
print(
    f"error {cost(begin):.4f} -> {best.fun:.4f}: β {beta * best.x[:2].round(3)}, "
    f"spacers {best.x[2:].round(3)} mm"
)

# %%
# What the text says:

assert from_sum < 2e-3
assert parallax[steps[0]][:, 0].mean() > parallax[steps[0]][:, 1].mean() + 1
assert abs(slope - differences) < 0.02 * abs(differences) + 1e-6
assert best.fun < cost(begin)
assert scored["no walls, parts"] > scored["no walls, neighbours ignored"]
