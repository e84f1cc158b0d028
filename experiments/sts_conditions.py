"""Why a real screen camera reaches 10 to 19 dB
============================================

The thesis' calibrated screen reconstructs six pictures on a monitor at 9.6 to 18.7 dB (Table 5.1).
The same steps on a virtual rig give 41 dB. Which conditions of a real set-up explain that?
"""

import functools
import os
from pathlib import Path
from types import SimpleNamespace

import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import scipy

import thincam_jax as tc
from thincam_jax import waveguide as wg
from thincam_jax.imaging.metrics import psnr
from thincam_jax.imaging.operators import Matrix
from thincam_jax.imaging.targets import middle_square, resize, sample_image, siemens_star
from thincam_jax.measured.calibration.hadamard import hadamard_pattern, walsh_hadamard
from thincam_jax.units import deg, nm, um

SIZE = os.environ.get("THINCAM_SIZE", "full")  # "small": fewer cells and pixels, in seconds
FIGURES = Path(os.environ.get("THINCAM_FIGURES", "runs/experiments")) / "sts_conditions"
FIGURES.mkdir(parents=True, exist_ok=True)
cells, pixels = {"full": (32, 112), "small": (8, 28)}[SIZE]

# %%
# What gamma alone costs
# ----------------------
#
# Patterns are black and white, right for any gamma. A picture f is shown as the light f^2.2, and so
# reconstructed at best. Binary pictures that are cut before they are resized have grey edges.

NAMES = ["star", "coins", "face", "camera", "clock", "text"]  # for apple, bee, face, cameraman …
PUBLISHED = np.array([[16.8, 15.2, 18.7, 12.0, 9.6, 13.2], [17.1, 15.3, 18.7, 15.1, 11.9, 14.2]])
CROPS = {"coins": 0.7, "astronaut": 1.0, "camera": 1.0, "clock": 0.9, "page": 0.94}


def pictures(count, grey_edges=False):
    drawn = [siemens_star((256, 256))]
    for name, crop in CROPS.items():
        photograph = np.atleast_3d(sample_image(name, linear=True)).mean(axis=-1)
        drawn.append(middle_square(photograph, round(crop * min(photograph.shape))))
    small = np.stack([resize(one, (count, count)) for one in drawn])
    for number, fine in enumerate(drawn[:3]):
        cut = fine if grey_edges else small[number]
        small[number] = resize((cut > cut.mean()).astype(float), (count, count))
    return small


def decibels(images, truth):
    return -10 * np.log10(np.mean((images - truth) ** 2, axis=(-2, -1)) + 1e-12)


def show(label, values):
    print(f"{label:44}", " ".join(f"{value:5.1f}" for value in np.ravel(values)))


for count, edges in ((cells, False), (cells, True), (64, False), (64, True)):
    light = (truth := pictures(count, edges)) ** 2.2
    best = (light * truth).sum((1, 2)) / (light**2).sum((1, 2))  # the scale nearest to f
    show(f"gamma, {count} cells, grey edges: {edges}", decibels(light, truth))
    show("the same, scaled best", decibels(best[:, None, None] * light, truth))
truth = pictures(cells)

# %%
# A set-up, and its conditions
# ----------------------------
#
# Of the monitor: gamma, light of a black cell, flicker, part of the pattern before that is left;
# after the calibration its light and place (mm along x and y, and nearer). Of the camera: blur in
# pixels, darkness of corners, electrons of the largest count, part of the range that white fills.

RIG = {"gamma": 1, "grey_edges": False, "black": 0, "flicker": 0, "left": 0, "light": 1, "shift": 0}
RIG |= {"nearer": 0, "blur": 0, "corners": 0, "well": 13500, "bits": 12, "exposure": 0.9, "room": 0}

recorded = {"index": 1.5, "thickness": 16 * um, "index_modulation": 0.02}
film = wg.VolumeHologram.record(532 * nm, 0.0, 61.2 * deg, **recorded)
outlines = wg.Rectangle((0.0, 0.0), (20.0, 50.0)), wg.Rectangle((25.0, 0.0), (50.0, 50.0))
sensor = tc.Sensor((pixels, pixels), 19.2 * um * 112 / pixels)
camera = wg.SeeThroughCamera(wg.Screen(film, 5.0, 1.5, *outlines), sensor, 6.0, 10.0)
radius = np.hypot(*np.meshgrid(*[np.linspace(-1, 1, pixels, dtype=np.float32)] * 2)) / 1.4142
numbers, shape = range(cells**2), (cells, cells)
patterns = np.stack([hadamard_pattern(n, shape, "natural") > 0 for n in numbers])


@functools.cache
def rays(shift=0.0, nearer=0.0):
    plane = wg.ObjectPlane(shape, 550.0 - nearer, 110.0, (20.0 + shift, shift))
    return wg.system_operator(camera, plane, orders=4, samples=8)


def frames(setup, system, shown, random):
    """What the camera makes of pictures, (picture, pixel), in parts of a white monitor's light."""
    seen = setup.black + (1 - setup.black) * jnp.asarray(shown, jnp.float32)
    seen = np.asarray(system(seen) / rays()(jnp.ones(shape)).max())
    seen = scipy.ndimage.gaussian_filter(seen, (0, setup.blur, setup.blur))
    change = random.standard_normal((2, len(seen), 1, 1), dtype=np.float32)
    seen = seen * (1 - setup.corners * radius**2) * (1 + setup.flicker * change[0])
    seen = seen + setup.room * (1 + 0.1 * change[1])  # light of the room varies by a tenth
    electrons = setup.exposure * setup.well * seen
    electrons += np.sqrt(electrons + 8**2) * random.standard_normal(seen.shape, dtype=np.float32)
    levels = 2**setup.bits - 1
    counts = np.rint(levels * np.clip(electrons / setup.well, 0, 1)).reshape(len(seen), -1)
    return counts / (levels * setup.exposure)


def reconstructed(setup):
    """By conjugate gradients and ADMM-TV; H = V'U'ᵀ/N with v' = 2v − v₀, thesis Eq 5.13–5.17."""
    mixed = (1 - setup.left) * patterns + setup.left * np.roll(patterns, 1, axis=0)
    taken = frames(setup, rays(), mixed, np.random.default_rng(0))
    matrix = walsh_hadamard(2 * taken - taken[0]) / cells**2
    shown = setup.light * pictures(cells, setup.grey_edges) ** setup.gamma
    taken = frames(setup, rays(setup.shift, setup.nearer), shown, np.random.default_rng(1))
    gram, pulled = (matrix.T @ matrix).astype(float), (taken @ matrix).astype(float)
    images = np.stack([scipy.sparse.linalg.cg(gram, one, maxiter=50)[0] for one in pulled])
    variance = np.mean((images @ matrix.T - taken) ** 2)
    upper = scipy.linalg.cholesky(gram)  # R of H = QR: Rf = Qᵀg is as many equations as cells
    seen = scipy.linalg.solve_triangular(upper, pulled.T, trans="T").T.reshape(1, *shown.shape)
    square = Matrix(jnp.asarray(upper, jnp.float32), shape, shape)
    recording = tc.Recording(seen.astype(np.float32), [square], noise_variance=float(variance))
    varied = tc.reconstruct(recording, tc.AdmmTV(2.0, iterations=50)).image
    return np.stack([images.reshape(shown.shape), np.asarray(varied).reshape(shown.shape)])


# %%
# One condition at a time, and together
# -------------------------------------
#
# Sizes: gamma of sRGB; contrast 800:1, as measured of an HP LP2475w; 1 mm on the monitor is 0.1° of
# the camera; backlights warm up, and their dimming beats with exposures; crystals take a frame to
# switch; a lens at infinity and f/2 blurs by half a pixel; "half white" fills 0.9 of the range.

usual = {"black": 1 / 800, "flicker": 0.005, "left": 0.02, "room": 0.02}
usual |= {"blur": 0.5, "corners": 0.3, "bits": 8, "nearer": 1.0, "light": 1.02}
ALL = "usual, gamma, moved by 1 mm"
CONDITIONS = {
    "no condition": {},
    "gamma 2.2": {"gamma": 2.2},
    "gamma 2.2, grey edges": {"gamma": 2.2, "grey_edges": True},
    "exposed for half white": {"exposure": 1.8},
    "moved by 1 mm": {"shift": 0.7},
    "5 mm nearer": {"nearer": 5.0},
    "5 % more light": {"light": 1.05},
    "5 % of the pattern before": {"left": 0.05},
    "room light 5 ± 0.5 %": {"room": 0.05},
    "flicker of 1 %": {"flicker": 0.01},
    "a tenth of the light": {"well": 1350.0},
    "blur of 1 pixel": {"blur": 1.0},
    "corners −30 %, black 1/800, 8 bits": {"corners": 0.3, "black": 1 / 800, "bits": 8},
    "usual faults": usual,
    "usual, moved by 1 mm": usual | {"shift": 0.7},
    "usual, gamma": usual | {"gamma": 2.2},
    ALL: usual | {"gamma": 2.2, "shift": 0.7},
    "usual, gamma, grey edges": usual | {"gamma": 2.2, "grey_edges": True},
    "usual, exposed for half white": usual | {"exposure": 1.8},
}
found, scores, misfit = {}, {}, {}
for label, conditions in CONDITIONS.items():
    setup = SimpleNamespace(**(RIG | conditions))
    found[label] = reconstructed(setup)
    scores[label] = decibels(found[label], pictures(cells, setup.grey_edges))
    misfit[label] = np.sqrt(np.mean((scores[label] - PUBLISHED) ** 2))
    show(f"{label} [{misfit[label]:.1f} dB off]", scores[label])
show("published", PUBLISHED)
means = {label: one.reshape(2, 2, 3).mean(axis=2) for label, one in scores.items()}
images = found[ALL]  # its PSNR in other ways
show("scaled to its peak", decibels(images.clip(0) / images.max((2, 3), keepdims=True), truth))
show("against the light shown", decibels(images, truth**2.2))
show("gain and offset fitted", [list(map(psnr, one, truth)) for one in images])

figure = plt.figure(figsize=(10.5, 8.4), layout="constrained")
(above,), (below,) = figure.subfigures(2, 1, squeeze=False, height_ratios=(1.1, 1))
rows = {"shown": truth, "conjugate\ngradients": found[ALL][0], "ADMM-TV": found[ALL][1]}
for number, (line, label) in enumerate(zip(above.subplots(3, 6), rows, strict=True)):
    for column, ax in enumerate(line):
        ax.imshow(rows[label][column], cmap="gray", vmin=0, vmax=1)
        ours, theirs = scores[ALL][number - 1, column], PUBLISHED[number - 1, column]
        title = f"{ours:.1f} dB ({theirs})" if number else NAMES[column]
        ax.set(xticks=[], yticks=[], title=title, ylabel="" if column else label)
ax = below.subplots()
shown = [label for label in CONDITIONS if not label.startswith("usual")] + [ALL]
for part, kind, colour, line in ((0, "binary", "0.25", "--"), (1, "grey", "0.7", ":")):
    places, heights = np.arange(len(shown)) + 0.4 * part, [means[label][1, part] for label in shown]
    ax.barh(places - 0.2, heights, 0.4, color=colour, label=f"{kind} pictures")
    mean = PUBLISHED[1, 3 * part :][:3].mean()
    ax.axvline(mean, color="k", linestyle=line, label=f"published, {kind}: {mean:.1f} dB")
ax.set(yticks=range(len(shown)), yticklabels=shown, xlabel="mean PSNR by ADMM-TV (dB)")
ax.invert_yaxis()
ax.legend(loc="lower center", bbox_to_anchor=(0.4, 1.0), ncols=4, frameon=False)
figure.savefig(FIGURES / "conditions.png", dpi=90)

figure, ax = plt.subplots(figsize=(6, 3.6), layout="constrained")
gammas = np.linspace(1.2, 2.6, 8)
for picture, name, mark in zip(truth[3:], NAMES[3:], "osd", strict=True):
    ax.plot(gammas, [decibels(picture**g, picture) for g in gammas], f"k{mark}-", label=name)
ax.set(xlabel="gamma of the monitor", ylabel="PSNR of a perfect reconstruction (dB)")
ax.legend()
figure.savefig(FIGURES / "gamma.png", dpi=110)

# %%
# What this says
# --------------
#
# Faults that are linear in the light leave greys better than black and white; published greys are
# 3 to 5 dB worse. A gamma does that, or an exposure that clips white. Both come within 2 to 3 dB of
# the published figures, with other faults: the table does not tell which.

bound = decibels(truth[3:] ** 2.2, truth[3:])
assert np.abs(scores["gamma 2.2"][0, 3:] - bound).max() < {"full": 0.1, "small": 0.6}[SIZE]
if SIZE == "full":
    linear = ("moved by 1 mm", "5 mm nearer", "5 % of the pattern before", "usual faults")
    assert all((means[label][:, 0] < means[label][:, 1]).all() for label in linear)
    assert (means[ALL][:, 0] > means[ALL][:, 1]).all() and misfit[ALL] < 2.2
