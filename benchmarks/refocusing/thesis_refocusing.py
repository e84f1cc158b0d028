"""The thesis' test of refocusing (section 4.2), by its camera and by the one of the network here.

`python thesis_refocusing.py IMAGES TUNING [COUNT]`, as score_refocusing.py. Two
planes, the near one left and the far one right, focused on one and on the other: PSNR of the whole
frame (table 4.2), and of the half in focus, told its distance and told the other's. If that loses
nothing, the planes are not told apart. Draws docs/images/learned_thesis.png.
"""

import sys
from collections.abc import Callable
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure
from score_refocusing import (
    FAR,
    NEAR,
    SNR,
    Methods,
    halves,
    head,
    interval,
    refocus_camera,
    row,
    squares,
    tune,
)

import thincam_jax as tc
from thincam_jax import learn
from thincam_jax.imaging.targets import siemens_star
from thincam_jax.learn.refocusing.cameras import RefocusCamera
from thincam_jax.learn.refocusing.network import NetworkOptions, RefocusNetwork
from thincam_jax.learn.refocusing.sources import dead_leaves
from thincam_jax.reconstruction.depth.refocus import axial_resolution
from thincam_jax.units import nm, um

THESIS = (160.0, 200.0)  # mm


def thesis_camera(pixels: int) -> RefocusCamera:
    """A mask of 2.15 mm before a sensor of 2048 × 2.4 µm, in so many pixels.

    The mask is not an aperture of zones; here it is one, as fine as the pixels carry.
    """
    pitch = 2048 * 2.4 * um / pixels
    mask = tc.FresnelZoneAperture(beta=np.pi / (2.15 * pitch), width=2.15)
    thin = tc.LenslessCamera(mask, tc.Sensor((pixels, pixels), pitch), distance=2.5)
    shape = (pixels // 2, pixels // 2)
    return RefocusCamera(thin, 500 * nm, field_shape=shape, near=150.0, far=210.0, planes=2)


def optics(camera: RefocusCamera, distances) -> dict[str, float]:
    """How much two distances differ to a camera.

    The depth of focus at the nearer one, mm; by how many pixels the mask's shadow is wider; and
    the norm of the difference of both PSFs without their means, of the one's norm. √2: they have
    nothing in common.
    """
    thin, (near, far) = camera.camera, distances
    wider = thin.mask.extent[1] * thin.distance * (1 / near - 1 / far) / thin.sensor.pitch
    kernels = np.asarray(camera.kernels(jnp.asarray(distances, camera.near.dtype)), float)
    one, other = kernels - kernels.mean(axis=(1, 2), keepdims=True)
    return {
        "depth of focus": float(axial_resolution(thin, object_distance=near)),
        "wider": float(wider),
        "difference": float(np.linalg.norm(one - other) / np.linalg.norm(one)),
    }


def table(camera, runs: dict[str, Callable], pictures, count: int, distances, snr=SNR) -> list:
    """The whole frame; then each plane's half, and what it loses when the other's is told.

    Returns that, dB, for both planes, (method, shot).
    """
    pairs = [(pictures[n], pictures[-1 - n]) for n in range(count)]
    shots = halves(camera, pairs, True, distances=distances, snr=snr)
    whole = [shot._replace(distances=()) for shot in shots]
    print(f"\n{camera.field_shape} at {snr:g} dB:")
    print(", ".join(f"{k} {v:.3g}" for k, v in optics(camera, distances).items()))
    head(runs)
    found = []
    for t, other in (distances, distances[::-1]):
        wrong = {k: (lambda s, t, run=run, told=other: run(s, told)) for k, run in runs.items()}
        row(f"{t:g} mm, whole frame", camera, runs, whole, t)
        right = row(f"{t:g} mm, its half", camera, runs, shots, t)
        lost = right - row(f"its half, told {other:g} mm", camera, wrong, shots, t)
        print(f"| lost | {' | '.join(map(interval, lost))} |", flush=True)
        found.append(lost)
    return found


def baselines(camera) -> Methods:
    options = NetworkOptions(steps=1, widths=(4,))
    return Methods(RefocusNetwork.create(camera, options, key=jax.random.key(0)))


def main(images: str, tuned: str, count: int) -> None:
    here = refocus_camera()
    cameras = {
        "the thesis' camera": (thesis_camera(256), THESIS),
        "the camera here": (here, (NEAR, FAR)),
    }
    shown = {}
    for name, (camera, distances) in cameras.items():
        side = 5 * max(camera.field_shape) // 4
        pictures, known = (squares(folder, camera, side) for folder in (images, tuned))
        methods = baselines(camera)
        tune(methods, known, min(count, 6), distances)
        runs = {"Wiener": methods.wiener, "ADMM-TV": methods.admm}
        if camera is here:
            runs["network"] = Methods(learn.RefocusNetwork.load("shipped", camera)).learned
        # The thesis' captures have no noise; the network is trained for 45 dB at most.
        for snr in (SNR, 45.0 if camera is here else 60.0):
            table(camera, runs, pictures, count, distances, snr)
        method = list(runs)[-1]
        shown[name] = (camera, method, runs[method], distances)
    picture(shown)
    fine = thesis_camera(2048)
    leaves = [np.asarray(one, float) for one in dead_leaves(7, 4, fine.field_shape[0])]
    table(fine, {"Wiener": baselines(fine).wiener}, leaves, 2, THESIS)


def picture(shown: dict[str, tuple]) -> None:
    """What a lens sees, and what a method makes of the capture, told both distances."""
    figure = Figure(figsize=(10, 5.6), layout="constrained")
    axes = figure.subplots(2, 4)
    for line, (name, (camera, method, run, distances)) in zip(axes, shown.items(), strict=True):
        star = np.asarray(siemens_star(camera.field_shape, spokes=12), float)
        (shot,) = halves(camera, [(star, star)], True, distances=distances, snr=45.0)
        images = {f"a lens on {t:g} mm": shot.target(camera, t) for t in distances}
        white = np.quantile(images[f"a lens on {distances[0]:g} mm"], 0.998)
        images |= {f"{method}, told {t:g} mm": run(shot, t) for t in distances}
        for ax, (title, image) in zip(line, images.items(), strict=True):
            level = np.clip(image / white, 0, 1)
            ax.imshow(level ** (1 / 2.2), cmap="gray", vmin=0, vmax=1)
            ax.set(xticks=[], yticks=[])
            ax.set_title(title, fontsize=10)
        line[0].set_ylabel(name)
    figure.savefig(Path(__file__).parents[2] / "docs/images/learned_thesis.png", dpi=80)


if __name__ == "__main__":
    images, tuned, *more = sys.argv[1:]
    main(images, tuned, int(more[0]) if more else 8)
