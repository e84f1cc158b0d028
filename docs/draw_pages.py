"""Draws pictures of docs pages that no experiment draws: `python docs/draw_pages.py [NAME ...]`.

Names are those of the functions below; without one all are drawn, in some minutes.
"""

import os
import re
import runpy
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from matplotlib import colormaps
from matplotlib.colors import BoundaryNorm
from matplotlib.figure import Figure

import thincam_jax as tc
from thincam_jax import design, measured
from thincam_jax.design.landscape import evaluate_grid
from thincam_jax.design.match import ResponseModel, match_response, ring_levels
from thincam_jax.design.objectives import bayes_error, channels
from thincam_jax.design.setup import Polar
from thincam_jax.lensless.masks import (
    UniformlyRedundantArray,
    maximum_length_sequence,
    random_cells,
)
from thincam_jax.reconstruction import phase_pairs
from thincam_jax.studies.prepared import pixel_noise, reconstruct_prepared
from thincam_jax.units import nm, um

ROOT = Path(__file__).resolve().parents[1]
IMAGES = ROOT / "docs/images"
MASK = tc.FresnelZoneAperture(25.0, width=5.632)


def models():
    """Along a line, near the axis and at the shadow's edge."""
    camera = tc.LenslessCamera(MASK, tc.Sensor((1, 8000), 6.2 / 8000), distance=6.5)
    light = {"wavelength": 500 * nm, "object_distance": 250.0}
    styles = {
        "separable": ("k", "-"),
        "closed_form": ("0.35", "--"),
        "paraxial": ("0.55", "-."),
        "geometric": ("0.6", ":"),
    }
    figure = Figure(figsize=(10, 3.4), layout="constrained")
    panels = figure.subplots(1, 3, sharey=True)
    titles = ("near the axis", "half way to the edge", "at the mask's edge")
    for ax, low, title in zip(panels, (0.0, 1.4, 2.76), titles, strict=True):
        for model, (grey, dashes) in styles.items():
            line = tc.psf(camera, model=model, **light, pixel_integration=False)[0]
            ax.plot(camera.sensor.grid.x, line, color=grey, linestyle=dashes, label=model, lw=1.2)
        ax.set(xlim=(low, low + 0.18), ylim=(0, 1.35), title=title, xlabel="x on the sensor (mm)")
    panels[0].set_ylabel("irradiance (open aperture = 1)")
    handles = panels[0].get_legend_handles_labels()
    figure.legend(*handles, loc="outside upper center", ncols=4, frameon=False)
    return figure


def calibration():
    """A noisy PSF, what is fitted to it, and what is left."""
    return _by_script("calibrate_psf", "fit.png", "full")


def _two_pitches():
    """The thesis' camera with two pitches, and the data of their objective, as in design_python."""
    setup = design.Setup(
        pitch=5.5 * um,
        sensor_width=5.632,
        object_distance=250.0,
        object_width=180.0,
        noise=design.SignalNoise(30.0),
        prior=design.PowerLaw(2.8),
    )
    pair = jnp.array([25.0, 21.0])
    base = design.shots(pair, 6.5, (0.0, 1.5 * jnp.pi), wavelength=500 * nm, width=5.632)
    free = [design.Variable("beta", 8.0, 36.0, which) for which in ((0, 1), (2, 3))]
    space = design.DesignSpace(base, tuple(free))
    return space, setup, jnp.asarray(phase_pairs(2))


def _expected_error(chosen, data):
    return bayes_error(channels(chosen, *data))


def _decibels(error):
    return 10 * np.log10(np.asarray(error))


def design_landscape():
    """The expected error over two pitches of the thesis' camera, as docs/guide/design.md."""
    space, *data = _two_pitches()
    count, (low, high) = 57, (8.0, 36.0)
    data = (*data, Polar(290.0, 128, 2))
    _, error = evaluate_grid(_expected_error, space, data, count)
    level = _decibels(error / jnp.nanmin(error)).reshape(count, count)
    figure = Figure(figsize=(6.4, 4.2), layout="constrained")
    ax = figure.subplots()
    axis = np.linspace(low, high, count)
    steps = [0, 0.1, 0.2, 0.4, 0.8, 1.6, 3.2]
    shades = {"cmap": "cividis", "norm": BoundaryNorm(steps, 256, extend="max")}
    shown = ax.contourf(axis, axis, level.T, steps, extend="max", **shades)
    figure.colorbar(shown, ax=ax, label="expected error (dB above the best)")
    ax.plot(25, 21, "X", color="k", mec="w", ms=11, label="the thesis' pair")
    ax.plot(20.18, 16.51, "o", color="w", mec="k", ms=9, label="found")
    ax.set(xlabel="β of the first mask (rad/mm²)", ylabel="β of the second mask (rad/mm²)")
    ax.set(xlim=(low, high), ylim=(low, high), aspect="equal")
    ax.legend()
    return figure


def design_front():
    """The expected error against the camera's thickness: pitches of the thesis, and the best."""
    space, *data = _two_pitches()
    data = (*data, Polar(290.0, 128, 2))
    distances = np.linspace(3.0, 6.5, 8)
    lines = {"β 25 and 21 rad/mm²": ("0.6", "s"), "the best β of each thickness": ("k", "o")}
    levels = []
    for distance in distances:
        thesis = eqx.tree_at(lambda d: d.distance, space.base, jnp.full(4, distance))
        moved = design.DesignSpace(thesis, space.variables)
        _, found = evaluate_grid(_expected_error, moved, data, 29)
        levels.append([_decibels(_expected_error(thesis, data)), _decibels(np.nanmin(found))])
    figure = Figure(figsize=(6.4, 3.2), layout="constrained")
    ax = figure.subplots()
    for (name, (grey, marker)), line in zip(lines.items(), np.transpose(levels), strict=True):
        ax.plot(distances, line, color=grey, marker=marker, label=name)
    ax.set(xlabel="mask to sensor (mm)", ylabel="expected error (dB)")
    ax.legend()
    return figure


def suggest():
    """A wanted response, which is that of a hidden design, and what the search finds for it."""
    space, *data = _two_pitches()
    rings = Polar(96.0, 128, 2)
    hidden = design.shots(
        jnp.array([17.0, 12.5]), 6.5, (0.0, 1.5 * jnp.pi), wavelength=500 * nm, width=5.632
    )
    wanted = ring_levels(channels(hidden, *data, rings), rings, 32)
    best = match_response(ResponseModel(space, *data, rings), wanted, key=jax.random.key(1))
    thesis = channels(space.base, *data, rings)
    figure = Figure(figsize=(6.4, 3.4), layout="constrained")
    ax = figure.subplots()
    cycles = (np.arange(32) + 0.5) * 96.0 / 32
    ax.plot(cycles, wanted, "k--", label="wanted (of β 17 and 12.5 rad/mm²)", lw=3)
    found = best.found[0].design
    first, second = (float(found.beta[n]) for n in (0, 2))
    found = channels(found, *data, rings)
    name = f"found: β {first:.1f} and {second:.1f} rad/mm²"
    ax.plot(cycles, ring_levels(found, rings, 32), "k-", label=name, lw=1)
    levels = ring_levels(thesis, rings, 32)
    ax.plot(cycles, levels, color="0.6", label="the thesis' pair, 25 and 21 rad/mm²")
    ax.set(xlabel="frequency (cycles/rad)", ylabel="level (dB)", ylim=(0, None))
    ax.legend()
    return figure


def depth():
    """What `thincam run configs/fza_refocus.yaml` draws."""
    return _by_command("figures/depth.png", "run", "configs/fza_refocus.yaml")


def sweep():
    """The summary of the example of docs/files/index.md."""
    axes = ("methods.3.shots.1.beta=17:23:4 rad/mm^2", "noise.snr_db=30,36")
    grids = [word for axis in axes for word in ("--grid", axis)]
    return _by_command("summary.png", "sweep", "configs/quick.yaml", *grids)


def which_mask():
    """From the experiment at its full size, in some six minutes."""
    return _by_script("compare_masks", "error.png", "full")


def screen_design():
    """What each number of two plates does, from the small size of its experiment."""
    return _by_script("sts_design", "slices.png")


def _by_script(name: str, picture: str, size: str = "small") -> Path:
    out = Path(tempfile.mkdtemp())
    os.environ |= {"THINCAM_SIZE": size, "THINCAM_FIGURES": str(out)}
    sys.path.append(str(ROOT / "experiments"))  # of its tools
    runpy.run_path(str(ROOT / "experiments" / f"{name}.py"))
    return out / name / picture


def _by_command(picture: str, command: str, config: str, *options: str) -> Path:
    out = Path(tempfile.mkdtemp()) / "out"
    program = [sys.executable, "-m", "thincam_jax.commands.start"]
    subprocess.run([*program, command, str(ROOT / config), *options, "--out", str(out)], check=True)
    return out / picture


def masks():
    """A contact sheet: masks 1.5 mm wide, and the PSF of each 2 mm behind it."""
    code = maximum_length_sequence(31)
    rings = np.random.default_rng(4).integers(0, 2, 24)
    sheet = {
        "Fresnel zone aperture": tc.FresnelZoneAperture(80.0, width=1.5),
        "MURA, 29": tc.ModifiedUniformlyRedundantArray(29, 1.5 / 29),
        "URA, 31 × 29": UniformlyRedundantArray((31, 29), 1.5 / 31),
        "code of 31, xor": tc.SeparableMask(code, code, 1.5 / 31, combine="xor"),
        "random cells": random_cells(jax.random.key(0), 1.5, 0.05),
        "pinhole": tc.Pinhole(50 * um),
        "lenslets, f = 2 mm": tc.LensletArray(2.0, 1.5 / 8, (8, 8)),
        "rings": tc.RadialMask(rings, 0.75 / 24),
    }
    sensor = tc.Sensor((360, 360), 5 * um)
    figure = Figure(figsize=(13, 3.9), layout="constrained")
    panels = figure.subplots(2, len(sheet))
    end = 360 * 5 * um / 2
    for column, (name, mask) in zip(panels.T, sheet.items(), strict=True):
        model = "angular_spectrum" if isinstance(mask, tc.RadialMask) else "separable"
        camera = tc.LenslessCamera(mask, sensor, 2.0)
        h = tc.psf(camera, wavelength=550 * nm, model=model, pixel_integration=True)
        t = mask.sample(sensor.grid, 550 * nm)
        shown = np.angle(t) if mask.pure_phase else np.abs(t)
        limit = float(np.quantile(h, 0.995))
        for ax, image, most in zip(column, (shown, h), (None, limit), strict=True):
            ax.imshow(image, cmap="gray", vmax=most, extent=(-end, end, end, -end))
            ax.set(xticks=(-0.75, 0.75), yticks=())
            ax.tick_params(labelsize=8)
        column[0].set_title(name, fontsize=10)
        column[1].set_xlabel("x (mm)", fontsize=9)
    panels[0, 0].set_ylabel("mask")
    panels[1, 0].set_ylabel("PSF")
    return figure


def bench():
    """The bench of configs/rig_manual.yaml from the side, whole and near the sensor, to scale."""
    figure = Figure(figsize=(10, 3.6), layout="constrained")
    whole, near = figure.subplots(1, 2, width_ratios=(1.5, 1))
    mask, sensor, object_, polarisers = 3.168 / 2, 224 * 0.0165 / 2, 40.0, (-4.0, 2.0)
    for ax in (whole, near):
        ax.plot([-250, -250], [-object_, object_], color="k", lw=4)
        for z in polarisers:
            ax.plot([z, z], [-4, 4], color="0.55", lw=3, ls=(0, (1, 1)))
        ax.plot([0, 0], [-mask, mask], color="k", lw=3, ls=(0, (2, 1)))
        ax.plot([6.5, 6.5], [-sensor, sensor], color="k", lw=5)
        ax.axhline(0, color="0.7", lw=0.8, ls="-.")
        for edge in (-1, 1):
            ax.plot([-250, 6.5], [0, edge * mask * 256.5 / 250], color="0.75", lw=0.8)
        ax.set(xlabel="z (mm), along the light", ylabel="x (mm)")
    whole.set(xlim=(-262, 30), ylim=(-62, 62), aspect="equal", title="the whole bench")
    whole.text(-243, 30, "object, 80 mm wide", va="center")
    whole.annotate(
        "modulator, polarisers, sensor", (0, 5), (-120, 46), arrowprops={"arrowstyle": "-"}
    )
    near.set(xlim=(-8, 14), ylim=(-7.5, 7.5), aspect="equal", title="mask and sensor")
    for z, x, text in (
        (polarisers[0], 4.6, "polariser"),
        (0.0, -2.6, "mask"),
        (polarisers[1], 4.6, "polariser"),
        (6.5, 2.6, "sensor"),
    ):
        near.text(z, x, text, ha="center", va="center", fontsize=9)
    near.annotate("", (6.5, -5.6), (0, -5.6), arrowprops={"arrowstyle": "<->"})
    near.text(3.25, -6.5, "d = 6.5 mm", ha="center", va="center", fontsize=9)
    near.annotate("", (11.5, -2.6), (6.7, -2.6), arrowprops={"arrowstyle": "->"})
    near.text(9.3, -3.6, "stage", ha="center", va="center", fontsize=9)
    return figure


def photon_transfer():
    """A frame of an evenly lit sensor, corrected, and the line: the example of its page."""
    page = (ROOT / "docs/measured/photon_transfer.md").read_text("utf-8")
    names: dict = {}
    os.chdir(tempfile.mkdtemp())
    for block in re.findall(r"```python\n(.*?)```", page, re.DOTALL):
        exec(block, names)  # the project's own page
    sensor, raw, part = names["sensor"], names["raw"], np.s_[100:164, 100:180]
    light, _ = sensor.at(0.1).correct(raw)
    frame = raw.pixels - sensor.dark_level.mean()
    light = np.where(sensor.defective, np.nan, light)
    figure = Figure(figsize=(11, 3.1), layout="constrained")
    panels = figure.subplots(1, 3, width_ratios=(1, 1, 1.1))
    mean = float(np.nanmean(light))
    grey = colormaps["gray"].with_extremes(bad="k")
    titles = "frame minus mean dark level", "corrected; defective pixels black"
    for ax, image, title in zip(panels, (frame, light), titles, strict=False):
        shown = ax.imshow(image[part] / mean, cmap=grey, vmin=0.9, vmax=1.1)
        ax.set(title=title, xlabel="x (pixels)", ylabel="y (pixels)")
    figure.colorbar(shown, ax=panels[:2], label="light (mean = 1)", shrink=0.8)
    means, variances, errors = sensor.photon_transfer.T
    line = np.array([0.0, 1.05 * means[-1]])
    slope = f"slope {sensor.conversion_gain:.4f} ± {sensor.conversion_gain_error:.4f}"
    panels[2].plot(
        line, sensor.conversion_gain * line, color="0.6", label=f"{slope} counts/electron"
    )
    panels[2].errorbar(means, variances, errors, fmt="ko", ms=4, label="eight exposures")
    panels[2].set(xlabel="mean light (counts)", ylabel="variance of light (counts²)")
    panels[2].set(xlim=(0, None), ylim=(0, 1.3 * variances[-1]), title="photon transfer")
    panels[2].legend(loc="upper left", fontsize=8, frameon=False)
    return figure


def hand():
    """PSF, capture and image of DiffuserCam's tutorial, whose files `THINCAM_HAND` has."""
    folder = Path(os.environ.get("THINCAM_HAND", ROOT / "../shared/data/diffusercam-hand"))
    psf, capture = (
        measured.read_image(folder / f"{name}_sample.tif") for name in ("psf", "rawdata_hand")
    )
    ready = measured.prepare(psf, capture, options=measured.Preparation(downsample=4))
    found = reconstruct_prepared(ready, tc.AdmmTV(), pixel_noise(ready)).image()[0]
    light = np.clip(found / np.percentile(found, 99.8), 0, 1) ** (1 / 2.2)
    figure = Figure(figsize=(9, 2.55), layout="constrained")
    parts = {"PSF": ready.psf, "capture": ready.capture, "image": light}
    for ax, (title, part) in zip(figure.subplots(1, 3), parts.items(), strict=True):
        shown = part if title == "image" else measured.to_display(part)
        ax.imshow(shown, cmap="gray", vmin=0)
        ax.set(title=title, xticks=[], yticks=[])
    return figure


_DESIGNS = (design_landscape, design_front, suggest, screen_design)
_DRAWN = (
    models,
    calibration,
    *_DESIGNS,
    depth,
    sweep,
    masks,
    which_mask,
    bench,
    photon_transfer,
    hand,
)
PAGES = {f.__name__: f for f in _DRAWN}

for name in sys.argv[1:] or PAGES:
    picture, place = PAGES[name](), IMAGES / f"{name.replace('_', '-')}.png"
    if isinstance(picture, Figure):
        picture.savefig(place, dpi=100)
    else:
        shutil.copy(picture, place)
