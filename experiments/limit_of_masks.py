"""How far from the limit are masks?
=================================

However a mask is cut, its shadow is nowhere negative, nowhere brighter than the open mask's and
holds the light that it lets through. This bounds what its captures tell of all frequencies
together, and so the expected error of the best linear image: `tc.design.limit` gives the least
error that any shadow can have. How far above it are the thesis' zone plates, a MURA, random cells,
one opening, and cells found by gradient? Lengths are in mm.
"""

import os
from pathlib import Path

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import optax

import thincam_jax as tc
from thincam_jax.design import limit
from thincam_jax.design.objectives import bayes_error, channels, over_rings
from thincam_jax.reconstruction import phase_pairs
from thincam_jax.units import nm

jax.config.update("jax_enable_x64", True)
SIZE = os.environ.get("THINCAM_SIZE", "full")  # "small": few cells, in seconds
FIGURES = Path(os.environ.get("THINCAM_FIGURES", "runs/experiments")) / "limit_of_masks"
FIGURES.mkdir(parents=True, exist_ok=True)

# %%
# Two cameras, little and plenty of light
# ---------------------------------------
#
# The thesis' sensor and the same with pixels of 44 µm, 6.5 mm behind masks 5.63 mm wide. All
# captures of a design share the exposure: so many electrons of a pixel from each mm² of open
# aperture. Scenes have the spectrum of photographs. What the sensor cuts off is left out.

full = SIZE == "full"
width, distance, wave = 5.632, 6.5, 500 * nm
cameras = {  # pitch, read noise in electrons, cells, steps and masks of a descent, lights
    "pixels of 44 µm": (0.044, 64.0, 128, (400, 1, 2), {"little": 4e3, "plenty": 2.048e5}),
    "pixels of 5.5 µm": (0.0055, 8.0, 512, (40, 1), {"little": 2e3, "plenty": 2e5}),
}
if not full:
    lights = {"plenty": 2.048e5}
    cameras = {
        f"pixels of {pitch:.0f} µm": (pitch / 1000, 64.0, 32, (5, 1), lights)
        for pitch in (176.0, 352.0)
    }
phases = (0.0, 1.5 * np.pi)


def problem_of(pitch, electrons, read):
    """Of one capture with all of the light."""
    noise = tc.design.PhotonNoise(electrons, read)
    prior = tc.design.PowerLaw(2.8)
    setup = tc.design.Setup(pitch, width, 250.0, 179.0, noise=noise, prior=prior, crop=False)
    plate = tc.design.shots([25.0], distance, [0.0], wavelength=wave, width=width)
    space = tc.design.DesignSpace(plate, (tc.design.Variable("beta", 5.0, 30.0, (0,)),))
    return tc.design.design_problem(tc.design.BayesError(), space, setup, np.eye(1))


# %%
# Masks of cells
# --------------
#
# The response of a shadow of square cells is a Fourier sum, the same above and below the axis but
# for the sign: two quadrants of frequencies.


class Cells:
    """Expected errors of masks (capture, y, x) of transmittances 0 to 1, which share the light."""

    def __init__(self, problem, count):
        data = problem.best_data
        self.setup, self.frequencies = data.setup, data.frequencies
        side, self.shape = width * (1 + distance / 250.0), (count, count)
        self.cell, u = side / count, np.asarray(self.frequencies.axis) / distance
        turned = np.outer(u, (np.arange(count) - (count - 1) / 2) * self.cell) * 2 * np.pi
        size = self.cell * np.sinc(self.cell * u) * np.sinc(float(self.setup.pitch) * u)
        waves = np.stack([np.cos(turned), np.sin(turned)]) * size[:, None]
        self.waves = jnp.asarray(waves, jnp.float32)
        self.seen = min(1.0, float(self.setup.field) * distance / side) ** 2
        prior = self.setup.prior(self.frequencies.squared, self.setup.field)
        weight = self.frequencies.weight * prior
        density = self.setup.contrast**2 * prior / jnp.sum(weight)
        self.density = jnp.asarray(density, jnp.float32)
        self.weight = jnp.asarray(weight / jnp.sum(weight), jnp.float32)

    def ratio(self, masks):
        """Signal-to-noise ratios η_f J of both quadrants."""
        w = self.waves
        (rr, ri), (ir, ii) = jnp.einsum("avy,kyx,bux->abkvu", w, masks, w, optimize=True)
        power = jnp.stack([(rr - ii) ** 2 + (ri + ir) ** 2, (rr + ii) ** 2 + (ri - ir) ** 2])
        light = self.seen * self.cell**2 * jnp.sum(masks, (1, 2))
        noise = self.setup.noise.variance(light, 0.0, 1 / len(masks)) * self.setup.pitch**2
        known = jnp.asarray(distance**2 / noise, jnp.float32)
        return self.density * jnp.einsum("qkvu,k->qvu", power, known)

    def error(self, masks):
        return jnp.sum(self.weight / (1 + self.ratio(masks))) / 2


def squares(pattern, side, count):
    """Squares of cells, in the middle of a mask."""
    mask = np.kron(pattern, np.ones((side, side)))
    before = (count - len(mask)) // 2
    return np.pad(mask, (before, count - len(mask) - before))[None]


def drawn(rng, count):
    side = int(rng.integers(1, 7))
    across = int(rng.integers(count // side // 4, count // side + 1))
    return squares(rng.random((across, across)) < np.exp(rng.uniform(-4, 0)), side, count)


def descent(error, start, steps):
    """Grey cells by a sigmoid that becomes steeper, rounded at the end."""
    method = optax.adam(optax.cosine_decay_schedule(0.1, steps))

    def cost(x, steepness):
        return jnp.log(error(jax.nn.sigmoid(steepness * x)))

    @jax.jit
    def step(x, state, steepness):
        change, state = method.update(jax.grad(cost)(x, steepness), state)
        return x + change, state

    x = jnp.asarray(start, jnp.float32)
    for steepness in (1.0, 3.0, 10.0):
        state = method.init(x)
        for _ in range(steps):
            x, state = step(x, state, steepness)
    return jnp.asarray(x > 0, jnp.float32)


# %%
# Above the limit
# ---------------
#
# Methods A and B have four captures, and their exact responses, diffraction included.

primes = (11, 13, 17, 23, 31, 43, 61, 101, 127, 251, 509)


def zone_plates(problem, beta, distances):
    design = tc.design.shots(beta, distances, phases, wavelength=wave, width=width)
    data = problem.best_data
    setup = problem.with_electrons(float(data.setup.noise.electrons) / 4).best_data.setup
    known = channels(design, setup, jnp.asarray(phase_pairs(2)), data.frequencies)
    return float(bayes_error(known)), known.signal_to_noise


above, ratios, least = {}, {}, {}
for camera, (pitch, read, count, (steps, *numbers), lights) in cameras.items():
    for light, electrons in lights.items():
        problem, rng = problem_of(pitch, electrons, read), np.random.default_rng(0)
        bound, cells = limit(problem), Cells(problem, count)
        error, key = jax.jit(cells.error), (camera, light)
        openings = [squares(np.ones((n, n)), 1, count) for n in (1, 2, 3, 4, 5, 6, 8, 12, 16)]
        muras = [
            squares(np.asarray(tc.ModifiedUniformlyRedundantArray(p, 1.0).cells), side, count)
            for p in primes
            for side in (1, 2, 4)
            if p * side <= count
        ]
        kinds = {"one opening": openings, "MURA": muras}
        kinds["random cells"] = [drawn(rng, count) for _ in range(40)]
        best = {name: min(masks, key=error) for name, masks in kinds.items()}
        coarse = Cells(problem, min(count, 256))  # a descent over finer cells takes long
        for captures in numbers:
            noise = rng.normal(size=(captures, *coarse.shape))
            mask = descent(coarse.error, 0.3 * noise - 1.0, steps)
            name = "cells by gradient" if captures == 1 else "two masks by gradient"
            best[name] = np.kron(mask, np.ones((1, count // len(mask[0]), count // len(mask[0]))))
        found = {
            "method A": zone_plates(problem, [25.0, 25.0], [5.0, 6.5]),
            "method B": zone_plates(problem, [25.0, 21.0], [6.5, 6.5]),
        }
        found |= {n: (float(error(m)), jnp.mean(cells.ratio(m), 0)) for n, m in best.items()}
        above[key] = {name: bound.above(value) for name, (value, _) in found.items()}
        rings = {name: over_rings(r, cells.frequencies, 40) for name, (_, r) in found.items()}
        rings["limit"] = over_rings(jnp.asarray(bound.ratio), cells.frequencies, 40)
        ratios[key], least[key] = rings, bound
        lens = limit(problem, masks="amplitude").decibels
        print(
            f"{camera}, {light}: limit {bound.decibels:.2f} dB (gap {bound.gap:.0e}), of", end=" "
        )
        print(f"which {bound.transmission:.3f} of the light; with diffraction {lens:.1f} dB")
        for name, value in above[key].items():
            part = f", open {float(np.mean(best[name])):.3f}" if name in best else ""
            print(f"  {name}: {value:.2f} dB above{part}")

# %%
marks = {"little": "ko", "plenty": "ws"}
lights_named = {"little": "little light", "plenty": "plenty of light"}
size = {"figsize": (9, 3.4), "layout": "constrained", "squeeze": False}
figure, panels = plt.subplots(1, len(cameras), sharey=True, **size)
rows = [*above[next(iter(above))]]  # the first camera's, which has all
for ax, camera in zip(panels[0], cameras, strict=True):
    for light in cameras[camera][-1]:
        values = above[camera, light]
        places = [rows.index(name) for name in values]
        ax.plot([*values.values()], places, marks[light], mec="k", label=lights_named[light])
    ax.axvline(0, color="k", lw=0.8)
    ax.set(title=camera, xlabel="expected error above the limit (dB)", xlim=(-0.5, None))
    ax.grid(axis="y", color="0.9")
panels[0, 0].set_yticks(range(len(rows)), rows)
panels[0, 0].invert_yaxis()
panels[0, 0].legend()
figure.savefig(FIGURES / "above.png", dpi=100)

# %%
# Spectra beside it
# -----------------
#
# The limit spends the energy of the shadow where it lowers the error most: more on high
# frequencies, of which the scene has less, up to where they are not worth it.

styles = {"limit": "k-", "method B": "k:", "MURA": "k-.", "random cells": "k--"}
styles["cells by gradient"] = "0.6"
figure, panels = plt.subplots(1, len(cameras), **size)
for ax, (camera, (pitch, *_, lights)) in zip(panels[0], cameras.items(), strict=True):
    middles = (np.arange(40) + 0.5) / 40 / (4 * pitch)
    for name, style in styles.items():
        ax.plot(middles, ratios[camera, [*lights][-1]][name], style, lw=2, label=name)
    ax.set(title=camera, xlabel="frequency on the sensor (cycles/mm)", yscale="log")
panels[0, 0].set(ylabel="signal-to-noise ratio, mean over rings")
panels[0, -1].legend()
figure.savefig(FIGURES / "spectra.png", dpi=100)

# %%
# What came out
# -------------
#
# - No mask passes the limit.
# - On the thesis' pixels of 5.5 µm the limit is nearly reached: cells by gradient are 1.0 dB above
#   it in little light and one opening 1.5 dB in plenty, methods A and B some 5 dB.
# - On pixels of 44 µm methods A and B waste the band on fringes that these pixels do not resolve.
#   Two masks by gradient stay 1.7 and 3.5 dB above the limit, one mask 2.0 and 5.4 dB.

for key, values in above.items():
    assert min(values.values()) > 0
    assert 0 <= least[key].gap < 0.05

quoted = {  # dB
    ("pixels of 44 µm", "little"): {"cells by gradient": 2.0, "two masks by gradient": 1.7},
    ("pixels of 44 µm", "plenty"): {"cells by gradient": 5.4, "two masks by gradient": 3.5},
    ("pixels of 5.5 µm", "little"): {"cells by gradient": 1.0, "method B": 5.1},
    ("pixels of 5.5 µm", "plenty"): {"one opening": 1.5, "method A": 4.9},
}
for key, values in quoted.items() if full else ():
    for name, value in values.items():
        assert abs(above[key][name] - value) < 0.15
