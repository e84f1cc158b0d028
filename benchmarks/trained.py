"""A trained reconstruction beside total variation, plug and play and ridge regression.

`python benchmarks/trained.py NETWORK PSF PHOTOGRAPHS [--capture RAW] [--downsample 8] [--out DIR]`:
captures of the photographs behind the camera of a PSF, each with its own faults, which no method
knows; gain and offset of every image are fitted. Prints a table, and draws worst, median and best
image by the gain of the network, and a real capture, into DIR.
"""

import argparse
import logging
import time
from dataclasses import replace
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

import thincam_jax as tc
from thincam_jax import measured
from thincam_jax.learn.denoiser.pictures import united
from thincam_jax.learn.trained import TrainedReconstruction
from thincam_jax.learn.trained_lessons import CameraLessons, photographs
from thincam_jax.studies.agreement import agreement
from thincam_jax.studies.prepared import pixel_noise, prepared_recording

SEED, WARM = 4242, 100


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


def compare(camera, methods, count):
    """Rows of scores by method, (PSNR, SSIM, CPU seconds), and the images."""
    scores, shown = {name: [] for name in methods}, []
    rows, columns = camera.sensor
    for method in methods.values():
        tc.reconstruct(camera.drawn(SEED, WARM)[0], method)
    for number in range(count):
        recording, scene = camera.drawn(SEED, number)
        top, left = ((n - m) // 2 for n, m in zip(scene.shape[1:], camera.sensor, strict=True))
        truth = scene[:, top : top + rows, left : left + columns]
        images = {"truth": truth[0], "capture": np.asarray(recording.captures[0])[0]}
        for name, method in methods.items():
            began = time.process_time()
            image = np.asarray(tc.reconstruct(recording, method).image, np.float32)
            seconds = time.process_time() - began
            found = agreement(image, truth)
            scores[name].append((found.psnr_db, found.ssim, seconds))
            images[f"{name}\n{found.psnr_db:.1f} dB"] = found.image[0]
        shown.append(images)
    return scores, shown


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    for name in ("network", "psf", "photographs"):
        parser.add_argument(name, type=Path)
    parser.add_argument("--capture", type=Path)
    parser.add_argument("--downsample", type=int, default=8)
    parser.add_argument("--count", type=int, default=12)
    parser.add_argument("--out", type=Path, default=Path("runs/trained"))
    given = parser.parse_args()
    given.out.mkdir(parents=True, exist_ok=True)
    logging.getLogger("thincam_jax").setLevel(logging.ERROR)
    trained = TrainedReconstruction.load(given.network)
    methods = {
        "ridge": tc.Ridge(),
        "AdmmTV": tc.AdmmTV(),
        "AdmmTV(iterations=40)": tc.AdmmTV(iterations=40),
        "pnp": tc.PlugAndPlay(),
        "trained": trained,
        "trained, after all iterations": replace(
            trained, physics=replace(trained.physics, iterations=300)
        ),
    }
    raw, capture = measured.read_image(given.psf), given.capture or given.psf
    options = measured.Preparation(downsample=given.downsample)
    ready = measured.prepare(
        raw, measured.read_image(capture), background="corner", options=options
    )
    rows, columns = ready.capture.shape[-2:]
    pictures = united(list(photographs(given.photographs).values()))
    camera = CameraLessons(ready.psf, (rows, columns), pictures)
    scores, shown = compare(camera, methods, given.count)
    reference = np.asarray([one[0] for one in scores["AdmmTV"]])
    print("| method | PSNR, dB | gain over AdmmTV, dB | SSIM | CPU s |\n|---|---|---|---|---|")
    for name, values in scores.items():
        decibels, similar, seconds = np.asarray(values, float).T
        gain = decibels - reference
        half = 2.2 * gain.std(ddof=1) / len(gain) ** 0.5
        print(
            f"| {name} | {decibels.mean():.2f} | {gain.mean():+.2f} ± {half:.2f} | "
            f"{similar.mean():.3f} | {np.median(seconds):.1f} |"
        )
    order = np.argsort(np.asarray([one[0] for one in scores["trained"]]) - reference)
    chosen = [shown[order[place]] for place in (0, len(order) // 2, -1)]
    draw(chosen, given.out / "trained-simulated.png")
    if given.capture is not None:
        recording = prepared_recording(ready, pixel_noise(ready))
        del methods["AdmmTV(iterations=40)"]
        images = {"capture": ready.capture[0]}
        for name, method in methods.items():
            image = np.asarray(tc.reconstruct(recording, method).image, np.float32)[0]
            top, left = ((n - m) // 2 for n, m in zip(image.shape, (rows, columns), strict=True))
            images[name] = np.maximum(image[top : top + rows, left : left + columns], 0)
        first = {"AdmmTV": images.pop("AdmmTV")}
        draw([first | images], given.out / "trained-hand.png")


if __name__ == "__main__":
    main()
