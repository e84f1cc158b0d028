"""Whether cells that suit total variation beat linear ones: `python benchmarks/refined_cells.py`.

`find_cells` searches for the least error of a linear image. Here its cells go on by the slope of
another error, that of photographs as ADMM with total variation leaves them: through the captures,
their noise and ten iterations from a settled state. Cells that promise most are flipped together,
and stay flipped where the error falls. What comes out is judged on other photographs by what users
run. A quarter of the thesis' sensor, in little light and in plenty. Lengths are in mm.
"""

import json
import os
import sys
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import scipy.stats
from PIL import Image

import thincam_jax as tc
from thincam_jax.design import CellMasks, find_cells
from thincam_jax.design.cell_masks import CellOptics
from thincam_jax.design.cell_search import CellSettings
from thincam_jax.imaging.operators import CropConvolution
from thincam_jax.imaging.targets.images import load_image
from thincam_jax.reconstruction.admm import RELAXATION, Penalties, admm_map
from thincam_jax.reconstruction.problem import InverseProblem, uniform_image
from thincam_jax.reconstruction.splittings import splitting_of
from thincam_jax.units import nm, um

sys.path.insert(0, str(Path(__file__).parents[1] / "experiments"))
from tools.photographs import fitted, halved, photographs

SIZE = os.environ.get("THINCAM_SIZE", "full")  # "small": a smaller camera, in seconds
FIGURES = Path(os.environ.get("THINCAM_FIGURES", "runs/experiments")) / "refined_cells"
FIGURES.mkdir(parents=True, exist_ok=True)
PHOTOGRAPHS = Path(os.environ.get("THINCAM_PHOTOGRAPHS", "../shared/data/photographs"))

# %%
# Camera and photographs
# ----------------------
#
# The image has pixels of 2 × 2 of the sensor's. Training has photographs of one folder, judging
# those of the atlas and twenty more of another; without the folders only those of the atlas.

full = SIZE == "full"
count, pitch, cells, cell = (256, 5.5 * um, 128, 11 * um) if full else (32, 22 * um, 16, 44 * um)
lights = {"little light": 2e3, "plenty of light": 2e5} if full else {"little light": 2e5}
settings = CellSettings() if full else CellSettings(4, 1, 2, flips=4)
attempts, settling, unrolled, read = (40, 30, 10, 8.0) if full else (3, 10, 5, 8.0)
distance, far, light = 6.5, 250.0, 500 * nm
width, across = count * pitch, 179 * count * pitch / 5.632
space = CellMasks(cell, cells, distance=distance, wavelength=light)
field = 2 * round(across / far * distance / float(pitch) / 4)


def of_folder(name, most):
    """Photographs of a folder, in twice the field's pixels."""
    files = sorted((PHOTOGRAPHS / name).glob("*.png"))
    chosen = np.random.default_rng(0).permutation(len(files))[:most] if full else []
    images = [fitted(load_image(files[n]), (field, field)) for n in chosen]
    return np.stack(images).astype(np.float32) if images else photographs(2, (field, field))


trained = jnp.asarray(halved(of_folder("cc0", 25)))
judging = np.concatenate(
    [photographs(8 if full else 2, (field, field)), of_folder("cc-by-sa/validation", 20)]
)

# %%
# The error of an image, and its slope
# ------------------------------------
#
# PSFs are interpolated on the sensor's pixels. A state that is nearly settled is taken as it is:
# ten iterations from there have the slope of eighty, to a part in a thousand.

optics = CellOptics(space, far, float(pitch), focus=1e9)


def problem_of(amplitude, image, normal, electrons):
    psf = optics(amplitude)
    middle = len(psf) // 2
    half = (middle - 1) // 2 * 2 + 1  # an odd number of pairs, the middle one on the axis
    psf = halved(psf[middle - half : middle + half, middle - half : middle + half])
    operator = CropConvolution(psf, 2 * pitch, (cells, cells), (field, field))
    operator = operator.with_channels_and_planes()
    clean = operator(image[None, None])
    variance = jnp.maximum((clean * electrons + read**2) / electrons**2 / 4, 1e-20)
    weight = jax.lax.stop_gradient(1 / jnp.mean(variance))
    capture = clean + jnp.sqrt(variance) * normal
    return InverseProblem([operator], [capture], weights=[weight], background="nonnegative")


def splitting(amplitude, image, normal, electrons):
    """ADMM's, with penalties that suit the image, as from larger pixels."""
    problem = problem_of(amplitude, image, normal, electrons)
    one = splitting_of(problem)
    step, most = 0.6 * jnp.std(image) / one.image_unit, one.penalties.variation
    variation = jax.lax.stop_gradient(jnp.clip(one.tau / step, 1e-4 * most, most))
    one = one.with_penalties(Penalties(one.penalties.data, variation, 0.85 * variation**0.5))
    return one, uniform_image(problem)


def advanced(one, state, steps):
    @jax.checkpoint
    def step(state, _):
        moved = admm_map(state, one)
        return jax.tree.map(lambda q, t: q + RELAXATION * (t - q), state, moved), None

    return jax.lax.scan(step, state, None, steps)[0]


@jax.jit
def begun(*capture):
    one, image = splitting(*capture)
    return one.start(image)


def error_of(steps, amplitude, state, *capture):
    """Logarithm of the squared error after some iterations, and the state."""
    one, _ = splitting(amplitude, *capture)
    after = advanced(one, state, steps)
    error = jnp.mean((one.image(after)[0, 0] - capture[0]) ** 2)
    return 10 * jnp.log10(error), jax.lax.stop_gradient(after)


value = jax.jit(partial(error_of, settling))
slope = jax.jit(jax.grad(partial(error_of, unrolled), has_aux=True))

# %%
# Flips
# -----
#
# All photographs count alike. After every four steps they are turned, and their noise is drawn
# anew, so that cells do not suit a noise.


def refined(amplitude, electrons):
    rng = np.random.default_rng(0)

    def drawn():
        turned = [
            jnp.rot90(one, int(rng.integers(4)))[:, :: int(rng.choice((-1, 1)))] for one in trained
        ]
        shape = 1, cells, cells
        return [(one, jnp.asarray(rng.normal(size=shape), float), electrons) for one in turned]

    def settled(amplitude, states):
        pairs = [value(amplitude, s, *c) for s, c in zip(states, captures, strict=True)]
        return np.mean([float(error) for error, _ in pairs]), [state for _, state in pairs]

    several, kept = max(1, int(jnp.sum(amplitude)) // 10), 0
    for attempt in range(attempts):
        if attempt == 0 or (is_better and kept % 4 == 0):
            captures = drawn()
            states = [begun(amplitude, *capture) for capture in captures]
            for _ in range(3):
                error, states = settled(amplitude, states)
        if attempt == 0 or is_better:
            slopes = [slope(amplitude, s, *c)[0] for s, c in zip(states, captures, strict=True)]
            promise = np.ravel(sum(slopes) * (1 - 2 * amplitude))
            order = np.argsort(promise)
        chosen = order[: min(several, np.sum(promise < 0))]
        other = np.array(amplitude).ravel()
        other[chosen] = 1 - other[chosen]
        other = jnp.asarray(other.reshape(cells, cells))
        new, others = settled(other, states)
        is_better = new < error
        print(f"{attempt}: {error:.3f} dB, {len(chosen)} flipped {new - error:+.3f} dB", flush=True)
        if is_better:
            amplitude, error, states, kept = other, new, others, kept + 1
            several = max(several + 1, several * 6 // 5)
        elif several == 1:
            break
        else:
            several //= 2
    return amplitude


designs = {}
for name, electrons in lights.items():
    noise, prior = tc.design.PhotonNoise(electrons, read), tc.design.PowerLaw(2.8)
    setup = tc.design.Setup(pitch, width, far, across, noise=noise, prior=prior)
    found = find_cells(setup, space, settings, folder=FIGURES / name.replace(" ", "_"))
    before, file = jnp.asarray(found.masks[0].amplitude, float), FIGURES / f"{name}, refined.png"
    if file.exists():
        after = jnp.asarray(tc.read_mask(file, cell).amplitude, float)
    else:
        after = refined(before, electrons)
        Image.fromarray(np.uint8(255 * np.asarray(after))).save(file)
    designs[name] = before, after
    print(f"{name}: {int(jnp.sum(abs(after - before)))} of {int(jnp.sum(before))} cells flipped")

# %%
# Judged by what users run
# ------------------------
#
# Captures on all pixels by exact PSFs, each photograph by itself.

sensor, coarse = tc.Sensor((count, count), pitch), tc.Sensor((cells, cells), 2 * pitch)
plane = tc.ImagePlane(judging, far, 2 * field * float(pitch) * far / distance)
truth = halved(judging)[..., ::-1, ::-1]


def judged(amplitude, electrons, solver):
    """PSNR of each photograph, dB."""
    mask, noise = tc.SampledMask(amplitude, cell), tc.PoissonGaussianNoise(read)
    clean = tc.capture(tc.LenslessCamera(mask, sensor, distance), tc.Scene(plane, light))
    exposure = jnp.full((len(judging), 1, 1), electrons)
    optics = tc.Cameras(
        [tc.LenslessCamera(mask, coarse, distance)],
        wavelength=light,
        object_distance=far,
        field_shape=(field, field),
    )
    levels = []
    for capture, image in zip(
        halved(noise.add(jax.random.key(0), clean, exposure)), truth, strict=True
    ):
        recording = tc.Recording([capture], optics)
        found = np.asarray(recording.oriented(tc.reconstruct(recording, solver).image), float)
        levels.append(-10 * np.log10(np.mean((found - image) ** 2)))
    return np.array(levels)


gains = {}
for name, electrons in lights.items():
    for solver in ("admm_tv", "pnp"):
        before, after = (judged(one, electrons, solver) for one in designs[name])
        gains[name, solver] = each = after - before
        half = scipy.stats.t.ppf(0.975, len(each) - 1) * each.std(ddof=1) / len(each) ** 0.5
        print(f"{name}, {solver}: {before.mean():.2f} dB, refined {each.mean():+.2f} ± {half:.2f}")
record = {", ".join(key): list(each) for key, each in gains.items()}
(FIGURES / "gains.json").write_text(json.dumps(record, indent=1))

# %%
figure, panels = plt.subplots(1, 2, figsize=(7, 3.4), sharey=True, layout="constrained")
extent = (-width / 2, width / 2, width / 2, -width / 2)
for ax, one, title in zip(panels, designs["little light"], ("found", "refined"), strict=True):
    ax.imshow(one, cmap="gray", extent=extent, interpolation="nearest")
    ax.set(xlabel="x (mm)", title=title)
panels[0].set(ylabel="y (mm)")
figure.savefig(FIGURES / "refined-cells.png", dpi=100)

# %%
figure, panels = plt.subplots(1, 2, figsize=(7, 3), sharey=True, layout="constrained")
for ax, solver in zip(panels, ("admm_tv", "pnp"), strict=True):
    for name, mark in zip(lights, ("ko", "wo"), strict=False):
        ax.plot(np.sort(gains[name, solver]), mark, mec="k", ms=4, label=name)
    ax.axhline(0, color="k", lw=0.6)
    ax.set(xlabel="photographs, sorted", title=solver)
panels[0].set(ylabel="gain by refinement (dB)")
panels[0].legend()
figure.savefig(FIGURES / "gains.png", dpi=100)
