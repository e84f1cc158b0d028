"""Planes reconstructed together through PSFs that are wrong: where a near object's light goes.

A near and a far object beside each other on black, seen through PSFs at two or five distances and
reconstructed by `AdmmTV()` with other PSFs than saw them: another exposure for each plane, shading,
a pedestal, noise, blur, or another size. PSFs are the measured one of a diffuser (BSD-3, of
Waller-Lab/DiffuserCam-Tutorial, `THINCAM_HAND`) with photographs (CC0, `THINCAM_PHOTOGRAPHS`), and
drawn caustics with drawn objects; at other distances t they are scaled by 1 + d/t. The size of an
error is its norm over that of the PSF. Noise is 0.5 % of the brightest pixel where nothing else is
said.

Light counts within 3 pixels of an object's outline; PSNR is of the whole plane.
"""

import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import scipy.ndimage as ndimage
import scipy.signal as signal
import tifffile

import thincam_jax as tc
from thincam_jax._core.grids import block_sum
from thincam_jax.learn.sources import photographs

HAND = Path(os.environ.get("THINCAM_HAND", "../shared/data/diffusercam-hand"))
PHOTOGRAPHS = Path(os.environ.get("THINCAM_PHOTOGRAPHS", "../shared/data/photographs"))
BIN, SIDE = 10, 40
TWO, FIVE = (120.0, 320.0), (120.0, 150.0, 200.0, 320.0, 1000.0)
# Planes and the distance of mask and sensor: PSFs 1.1, 2.4 and some 0.9 pixels apart at their edge.
STACKS = {"two, near": (TWO, 4.0), "two": (TWO, 9.0), "five": (FIVE, 9.0)}
SIZES = (0.01, 0.03, 0.05)
# Least share of the near object's light in its plane and the next one, and most in the farthest.
LEAST, MOST = 0.85, 0.05


@dataclass(frozen=True)
class Stack:
    """PSFs of the planes, and what is in the nearest one and in the one at 320 mm."""

    psfs: np.ndarray
    scene: np.ndarray
    far: int

    def seen(self, noise, rng):
        planes = zip(self.scene, self.psfs, strict=True)
        capture = sum(signal.fftconvolve(image, psf, mode="same") for image, psf in planes)
        return capture + noise * capture.max() * rng.normal(size=capture.shape)

    def figures(self, image):
        """Shares of the near object's light (own plane, with the next, farthest); two PSNRs."""
        around = ndimage.binary_dilation(self.scene[0] > 0, iterations=3)
        light = np.maximum(image, 0)[:, around].sum(axis=1)
        light /= light.sum()
        errors = ((image - self.scene) ** 2).mean(axis=(1, 2))
        quality = [10 * np.log10(self.scene[p].max() ** 2 / errors[p]) for p in (0, self.far)]
        own = light[0] + (light[1] if len(light) > 2 else 0)
        return light[0], own, light[-1], *quality


def measured_psf():
    raw = tifffile.imread(HAND / "psf_sample.tif").astype(float)
    return np.maximum(raw - raw[5:15, 5:15].mean(), 0)


def drawn_psf(shape=(1200, 1600)):
    """Caustics: rays through a smooth random surface."""
    rng = np.random.default_rng(5)
    surface = ndimage.gaussian_filter(rng.normal(size=shape), 45)
    slopes = np.gradient(surface / surface.std())
    y, x = (np.arange(n) - (n - 1) / 2 for n in shape)
    inside = (np.abs(y) < 470)[:, None] & (np.abs(x) < 540)
    places = [(axis + 1000 * s)[inside] for axis, s in zip((y[:, None], x), slopes, strict=True)]
    edges = [np.arange(n + 1) - n / 2 for n in shape]
    return ndimage.gaussian_filter(np.histogram2d(*places, bins=edges)[0], 3)


def scaled(psf, size, bins=BIN):
    """A PSF `size` times as large about its centre, binned."""
    middle = (np.array(psf.shape) - 1) / 2
    larger = ndimage.affine_transform(psf, np.eye(2) / size, middle * (1 - 1 / size), order=1)
    return block_sum(larger, bins) / size**2


def card():
    image = np.full((SIDE, SIDE), 0.15)
    image[5:20, 5:13] = 1.0
    image[10:13, 20:37] = 0.9
    image[-6:-3, 3:20] = 0.8
    y, x = np.mgrid[:SIDE, :SIDE]
    image[(y - 28) ** 2 + (x - 26) ** 2 < 64] = 0.7
    return image


def waves():
    y, x = np.mgrid[:SIDE, :SIDE]
    return 0.5 + 0.25 * np.sin(y / 3) + 0.25 * np.sin(x / 5 + y / 9)


def stack(name, real):
    distances, d = STACKS[name]
    psf = measured_psf() if real else drawn_psf()
    psfs = np.stack([scaled(psf, (1 + d / t) / (1 + d / distances[0])) for t in distances])
    if real:
        near, far = photographs(PHOTOGRAPHS / "cc0", SIDE)[[4, 9]]
    else:
        near, far = card(), waves()
    scene, place = np.zeros(psfs.shape), distances.index(320.0)
    rows = (scene.shape[1] - SIDE) // 2
    scene[0, rows - 6 : rows - 6 + SIDE, 25 : 25 + SIDE] = near / near.max()
    scene[place, rows + 8 : rows + 8 + SIDE, 90 : 90 + SIDE] = far / far.max()
    return Stack(psfs / psfs[0].sum(), scene, place)


def spoilt(psf, kind, size, rng):
    """A PSF that is wrong by `size` times its norm, or larger by so much."""
    if kind == "larger":
        return scaled(psf, 1 + size, 1)
    y, x = (np.linspace(-1, 1, n) for n in psf.shape)
    error = {
        "shading": lambda: psf * (x + y[:, None] ** 2),
        "pedestal": lambda: np.ones_like(psf),
        "noise": lambda: ndimage.gaussian_filter(rng.normal(size=psf.shape), 0.7),
        "blur": lambda: ndimage.gaussian_filter(psf, 1.0) - psf,
    }[kind]()
    return psf + size * np.linalg.norm(psf) / np.linalg.norm(error) * error


KINDS = ("shading", "pedestal", "noise", "blur")
CASES = [("none", 0.0), ("exposure", 0.0), *((kind, size) for kind in KINDS for size in SIZES)]


def measured(seen: Stack, kind, size, noise=0.005):
    rng = np.random.default_rng(1)
    capture, psfs = seen.seen(noise, rng), seen.psfs
    if size:
        psfs = np.stack([spoilt(psf, kind, size, rng) for psf in psfs])
    exposures = np.ones(len(psfs))
    if kind == "exposure":
        exposures = np.resize((0.5, 2.0, 1.0), len(psfs))
    psfs = psfs * exposures[:, None, None]
    recording = tc.Recording(capture[None], tc.Psfs(psfs[None, None]))
    image = np.asarray(tc.reconstruct(recording, tc.AdmmTV()).image)
    return seen.figures(image * exposures[:, None, None])


@pytest.mark.filterwarnings("ignore:planes")
@pytest.mark.parametrize("real", [False, True], ids=["drawn", "measured"])
@pytest.mark.parametrize("name", STACKS)
def test_a_near_object_stays_near(name, real, capsys):
    if real and not (HAND.exists() and PHOTOGRAPHS.exists()):
        pytest.skip(f"needs {HAND} and {PHOTOGRAPHS}: set THINCAM_HAND and THINCAM_PHOTOGRAPHS")
    seen, figures = stack(name, real), {}
    for case in CASES:
        figures[case] = measured(seen, *case)
    figures["larger", 0.01] = measured(seen, "larger", 0.01)
    figures["captures of 2 % noise", 0.0] = measured(seen, "none", 0.0, noise=0.02)
    with capsys.disabled():
        print(f"\n{name}, {'measured' if real else 'drawn'} PSFs")
        print("| wrong by | in its plane | and the next | in the farthest | PSNR near, far |")
        print("|---|---|---|---|---|")
        for (kind, size), (first, own, last, near, far) in figures.items():
            label = f"{kind} {100 * size:.0f} %" if size else kind
            print(
                f"| {label} | {100 * first:.0f} % | {100 * own:.0f} % | {100 * last:.0f} % "
                f"| {near:.1f}, {far:.1f} dB |"
            )
    for case in CASES:
        _, own, last, _, _ = figures[case]
        assert own > LEAST, case
        assert last < (1 - LEAST if len(seen.psfs) == 2 else MOST), case
