"""A trained reconstruction beside total variation, plug and play and ridge regression.

`python benchmarks/trained.py NETWORK PSF PHOTOGRAPHS [--capture RAW] [--downsample 8] [--out DIR]`:
captures of the photographs behind the camera of a PSF, each with its own faults, which no method
knows; gain and offset of every image are fitted. NETWORK is a file, or "diffusercam". Prints a
table, and draws worst, median and best image by the gain of the network, and a real capture, into
DIR.

`python benchmarks/trained.py FOLDER PSF PHOTOGRAPHS --without-each --downsample 24 --count 60`:
small networks learn from the photographs of FOLDER, with all faults and without each in turn.

`python benchmarks/trained.py NETWORK PSF PHOTOGRAPHS --bounds`: what a network could gain from
these images at most: by the best filter for each capture, or by the true PSF.

`python benchmarks/trained.py --scores DIR`: the worst, median and best image of `thincam evaluate`.
"""

import argparse
import json
import logging
import time
from dataclasses import replace
from pathlib import Path
from typing import ClassVar

import matplotlib.pyplot as plt
import numpy as np
from scipy import stats

import thincam_jax as tc
from thincam_jax import measured
from thincam_jax.imaging.operators.crop_convolution import centred_crop
from thincam_jax.learn.denoiser.pictures import united
from thincam_jax.learn.imperfections import Imperfections
from thincam_jax.learn.trained import PhysicsStep, TrainedOptions, TrainedReconstruction, cleaned
from thincam_jax.learn.trained_lessons import CameraLessons, drawn, photographs
from thincam_jax.learn.trained_training import ReconstructionLessons, train_reconstruction
from thincam_jax.learn.training import TrainingOptions
from thincam_jax.studies.agreement import agreement
from thincam_jax.studies.prepared import pixel_noise, prepared_recording

SEED, WARM = 4242, 100
LESS = "AdmmTV(tau=0.5)"
REFINED = {f"{name}, refined": name for name in ("AdmmTV", "pnp", "trained")}
HIDDEN = (LESS, *REFINED)  # in the pictures


def draw(rows, path):
    """Images of rows of {title: image}, all of a row in the grey scale of its first."""
    size = 2.6 * len(rows[0]), 2.1 * len(rows)
    figure, axes = plt.subplots(len(rows), len(rows[0]), figsize=size, squeeze=False)
    for row, images in zip(axes, rows, strict=True):
        first = next(iter(images.values()))
        for ax, (title, image) in zip(row, images.items(), strict=True):
            white = np.percentile(image if title == "capture" else first, 99.8)
            ax.imshow(np.clip(image / white, 0, 1) ** (1 / 2.2), cmap="gray", vmin=0, vmax=1)
            ax.set_title(title, fontsize=8)
            ax.set(xticks=[], yticks=[])
    figure.tight_layout()
    figure.savefig(path, dpi=110)


def draw_scores(folder, path):
    """Capture, truth and images of the worst, median and best pair of an evaluation."""
    methods = [one["method"] for one in json.loads((folder / "metrics.json").read_text())["scores"]]
    columns = ["truth", "capture", *(one.replace("_", "-") for one in methods)]
    figure, axes = plt.subplots(3, len(columns), figsize=(2.1 * len(columns), 6.4))
    for row, word in zip(axes, ("worst", "median", "best"), strict=True):
        for ax, column in zip(row, columns, strict=True):
            ax.imshow(plt.imread(folder / "images" / f"{word}-{column}.png"), cmap="gray")
            ax.set(xticks=[], yticks=[])
            ax.set_title(column if word == "worst" else "", fontsize=9)
        row[0].set_ylabel(word)
    figure.tight_layout()
    figure.savefig(path, dpi=75)


def image_of(recording, name, method, sensor):
    """The image in front of the sensor; of all that sends light to it where the name says so."""
    return np.asarray(centred_crop(tc.reconstruct(recording, method).image, sensor), np.float32)


def compare(camera, methods, count, seed):
    """Rows of scores by method, (PSNR, SSIM, CPU seconds), and the images."""
    scores, shown = {name: [] for name in methods}, []
    rows, columns = camera.sensor
    for name, method in methods.items():
        image_of(camera.drawn(seed, WARM)[0], name, method, camera.sensor)
    for number in range(count):
        recording, scene = camera.drawn(seed, number)
        top, left = ((n - m) // 2 for n, m in zip(scene.shape[1:], camera.sensor, strict=True))
        truth = scene[:, top : top + rows, left : left + columns]
        images = {"truth": truth[0], "capture": np.asarray(recording.captures[0])[0]}
        began = time.process_time()
        mended = tc.refine(recording, parameters=("scale", "turn")).recording
        refining = time.process_time() - began
        for name, method in methods.items():
            began = time.process_time() - refining * (name in REFINED)
            image = image_of(mended if name in REFINED else recording, name, method, camera.sensor)
            seconds = time.process_time() - began
            found = agreement(image, truth)
            scores[name].append((found.psnr_db, found.ssim, seconds))
            if name not in HIDDEN:
                images[f"{name}\n{found.psnr_db:.1f} dB"] = found.image[0]
        shown.append(images)
    return scores, shown


class Remembered(Imperfections):
    """Faults whose last PSF is kept in `true`."""

    true: ClassVar[list] = []

    def psf(self, psf, rng):
        self.true[:] = [super().psf(psf, rng)]
        return self.true[0]


def best_filter(images, truth, reach):
    """The truth's best linear estimate by pixels of the images nearby: fitted to this truth."""
    size, (rows, columns) = 2 * reach + 1, truth.shape
    padded = [np.pad(one, reach, mode="edge").astype(float) for one in images]
    near = [
        one[y : y + rows, x : x + columns].ravel()
        for one in padded
        for y in range(size)
        for x in range(size)
    ]
    known = np.stack([*near, np.ones(truth.size)], axis=1)
    weights = np.linalg.lstsq(known, truth.ravel().astype(float), rcond=None)[0]
    return (known @ weights).reshape(truth.shape)


def bounds(camera, count):
    """Gains over the image of plug and play, dB, by what no method knows."""
    physics = PhysicsStep(np.zeros(len(camera.psf), np.float32), 100, "both")
    gains = {}
    for number in range(count):
        recording, scene = camera.drawn(SEED, number)
        truth = np.asarray(centred_crop(scene, camera.sensor))[0]
        true = tc.Recording(recording.captures[0][None], tc.Psfs(Remembered.true[0][None]))
        (variation, plug), (mended, known) = (
            [np.asarray(centred_crop(one[0, 0], camera.sensor)) for one in physics(given)[1]]
            for given in (recording, true)
        )
        tried = {
            "plug and play": plug,
            "total variation": variation,
            "mean of both": (plug + variation) / 2,
            "best filter of 7×7 pixels": best_filter([plug], truth, 3),
            "best filter of 7×7 pixels of both": best_filter([plug, variation], truth, 3),
            "plug and play, true PSF": known,
            "total variation, true PSF": mended,
        }
        for name, image in tried.items():
            score = agreement(np.asarray(image, np.float32)[None], truth[None]).psnr_db
            gains.setdefault(name, []).append(score)
    for name, values in gains.items():
        gain = np.subtract(values, gains["plug and play"])
        half = stats.t.ppf(0.975, count - 1) * stats.sem(gain)
        print(f"| {name} | {np.mean(values):.2f} | {gain.mean():+.2f} ± {half:.2f} |")


FAULTS = ("scale", "turn", "blur", "background", "ambient", "saturated", "hot", "bits")


def without_each(judge, learned, count):
    """Gains over its physics step of a network that has seen all faults but one."""
    sizes = TrainedOptions(40, (16, 24, 32))
    options = TrainingOptions(400, 1e-3, check_every=50, averaging=0.98)
    faults = {"": learned.faults, **{one: learned.faults.without(one) for one in FAULTS}}
    faults["PSF's"] = replace(learned.faults, scale=0.0, turn=0.0, blur=0.0)
    gains = {}
    for name, some in faults.items():
        camera = replace(learned, faults=some)
        lessons = ReconstructionLessons(camera, pool=120, judged=8, batch=8, crop=32)
        untrained = TrainedReconstruction.create(sizes, camera.psf, key=0)
        model = train_reconstruction(untrained, lessons, options).model
        drawn_ = judge.examples(model.physics, SEED, count)
        pairs = zip(drawn_.images, np.asarray(drawn_.truth, np.float32), strict=True)
        values = []
        for images, truth in pairs:
            images = images.astype(np.float32)
            found = np.maximum(cleaned(model.network, 1, images), 0)
            ends = (agreement(np.asarray(one), truth).psnr_db for one in (images[-1], found))
            before, after = ends
            values.append(after - before)
        gains[name] = np.asarray(values)
        lost = gains[name] - gains[""]
        half = 2.0 * lost.std(ddof=1) / count**0.5
        print(f"| {name or 'none'} | {gains[name].mean():+.2f} | {lost.mean():+.3f} ± {half:.3f} |")


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    for name in ("network", "psf", "photographs"):
        parser.add_argument(name, type=Path, nargs="?")
    parser.add_argument("--scores", type=Path)
    parser.add_argument("--capture", type=Path)
    parser.add_argument("--downsample", type=int, default=8)
    parser.add_argument("--count", type=int, default=12)
    parser.add_argument("--seed", type=int, default=SEED)
    parser.add_argument("--out", type=Path, default=Path("runs/trained"))
    parser.add_argument("--without-each", action="store_true")
    parser.add_argument("--bounds", action="store_true")
    given = parser.parse_args()
    given.out.mkdir(parents=True, exist_ok=True)
    if given.scores:
        draw_scores(given.scores, given.out / "trained-rig.png")
        return
    logging.getLogger("thincam_jax").setLevel(logging.ERROR)
    raw, capture = measured.read_image(given.psf), given.capture or given.psf
    options = measured.Preparation(downsample=given.downsample)
    ready = measured.prepare(
        raw, measured.read_image(capture), background="corner", options=options
    )
    rows, columns = ready.capture.shape[-2:]
    pictures = united(list(photographs(given.photographs).values()))
    camera = CameraLessons(ready.psf, (rows, columns), pictures)
    if given.without_each:
        learned = united([*photographs(given.network).values(), drawn(0, 20)])
        without_each(camera, replace(camera, pictures=learned), given.count)
        return
    if given.bounds:
        bounds(replace(camera, faults=Remembered()), given.count)
        return
    trained = TrainedReconstruction.load(given.network)
    methods = {
        "ridge": tc.Ridge(),
        "AdmmTV": tc.AdmmTV(),
        LESS: tc.AdmmTV(0.5),
        "pnp": tc.PlugAndPlay(),
        "trained": trained,
    }
    methods |= {name: methods[plain] for name, plain in REFINED.items()}
    scores, shown = compare(camera, methods, given.count, given.seed)
    reference = np.asarray([one[0] for one in scores["AdmmTV"]])
    print("| method | PSNR, dB | gain over AdmmTV, dB | least gain | SSIM | CPU s |")
    print("|---|---|---|---|---|---|")
    for name, values in scores.items():
        decibels, similar, seconds = np.asarray(values, float).T
        gain = decibels - reference
        half = stats.t.ppf(0.975, len(gain) - 1) * stats.sem(gain)
        print(
            f"| {name} | {decibels.mean():.2f} | {gain.mean():+.2f} ± {half:.2f} | "
            f"{gain.min():+.2f} | {similar.mean():.3f} | {np.median(seconds):.1f} |"
        )
    for name, other in {"trained": "pnp", **REFINED}.items():
        beside = np.asarray(
            [one[0] - two[0] for one, two in zip(scores[name], scores[other], strict=True)]
        )
        half = stats.t.ppf(0.975, len(beside) - 1) * stats.sem(beside)
        print(f"{name} less {other}: {beside.mean():+.2f} ± {half:.2f}, least {beside.min():+.2f}")
    order = np.argsort(np.asarray([one[0] for one in scores["trained"]]) - reference)
    chosen = [shown[order[place]] for place in (0, len(order) // 2, -1)]
    draw(chosen, given.out / "trained-simulated.png")
    if given.capture is not None:
        recording = prepared_recording(ready, pixel_noise(ready))
        images = {"capture": ready.capture[0]}
        for name, method in methods.items():
            if name not in HIDDEN:  # all have the whole field
                image = image_of(recording, name, method, camera.sensor)[0]
                images[name] = np.maximum(image, 0)
        first = {"AdmmTV": images.pop("AdmmTV")}
        draw([first | images], given.out / "trained-hand.png")


if __name__ == "__main__":
    main()
