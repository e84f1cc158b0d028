"""Slightly wrong PSFs and cameras, refined by `tc.refine` from one capture of a photograph.

Error left, coverage of the stated errors, and PSNR of another photograph that was held out, with
the PSF as given, refined and right. scikit-image's photographs fill what lies before a sensor of
96×128 pixels, the noise is 30 to 40 dB below the capture, and a background of a tenth of the
maximum is unknown. PSFs are measured: 12 bit, shot noise. `THINCAM_COUNT` (4) photographs, at most
6: some 7 minutes on two cores.
"""

import os

import jax.numpy as jnp
import numpy as np
import pytest
import scipy
import skimage

import thincam_jax as tc
from thincam_jax.imaging.metrics import align, psnr
from thincam_jax.units import nm, um

SHAPE = (96, 128)
PHOTOGRAPHS = ("camera", "coins", "astronaut", "coffee", "chelsea", "rocket")
COUNT = int(os.environ.get("THINCAM_COUNT", "4"))
TURN = np.deg2rad(0.5)
FINE = 4  # samples a pixel


def photograph(number):
    image = getattr(skimage.data, PHOTOGRAPHS[number % len(PHOTOGRAPHS)])()
    image = skimage.color.rgb2gray(image) if image.ndim == 3 else image
    image = skimage.util.img_as_float(image) ** 2.2
    factor = min(n / s for n, s in zip(image.shape, SHAPE, strict=True))
    rows, columns = (int(factor * s) for s in SHAPE)
    top, left = (image.shape[0] - rows) // 2, (image.shape[1] - columns) // 2
    part = image[top : top + rows, left : left + columns]
    return skimage.transform.resize(part, SHAPE, anti_aliasing=True)


def diffuser(generator, size):
    """Caustics: bright lines where a random surface is level."""
    surface = scipy.ndimage.gaussian_filter(generator.normal(size=size), 2.2 * FINE)
    lines = np.exp(-3 * np.abs(surface) / surface.std())
    return scipy.ndimage.gaussian_filter(lines, 0.7 * FINE)


def random_mask(generator, size):
    """Square cells of 2.5 pixels, every other one open."""
    side = round(2.5 * FINE)
    cells = generator.random([n // side + 1 for n in size]) < 0.5
    cells = np.kron(cells, np.ones((side, side)))[: size[0], : size[1]]
    return scipy.ndimage.gaussian_filter(cells, 0.6 * FINE)


def sampled(kind, seed, *, scale=1.0, turn=0.0, blur=0.0):
    """A PSF that ends on the sensor, of unit sum; turned anticlockwise."""
    pattern = kind(np.random.default_rng(seed), [int(1.3 * n * FINE) for n in SHAPE])
    y, x = np.meshgrid(*(np.arange(n) - (n - 1) / 2 for n in SHAPE), indexing="ij")
    cos, sin = np.cos(turn), np.sin(turn)
    v, u = (cos * y + sin * x) / scale, (cos * x - sin * y) / scale
    place = [FINE * a + (n - 1) / 2 for a, n in zip((v, u), pattern.shape, strict=True)]
    psf = np.maximum(scipy.ndimage.map_coordinates(pattern, place, mode="nearest"), 0)
    psf *= np.exp(-((np.hypot(v / SHAPE[0], u / SHAPE[1]) / 0.4) ** 8))
    psf = scipy.ndimage.gaussian_filter(psf, np.sqrt(blur)) if blur else psf
    return psf / psf.sum()


def measured(psf, seed):
    light, generator = 4e4, np.random.default_rng(seed)
    counts = np.round(4095 * 0.9 * generator.poisson(light * psf / psf.max()) / light)
    return tc.Psfs(counts[None] / counts.sum())


def camera(distance=4.0, object_distance=25.0):
    """A zone aperture close to its object: the shadow is 16 % larger than the mask."""
    mask = tc.FresnelZoneAperture(60.0, width=1.5)
    one = tc.LenslessCamera(mask, tc.Sensor(SHAPE, 20 * um), distance)
    return tc.Cameras([one], wavelength=532 * nm, object_distance=object_distance)


def exposed(model, image, seed):
    """A capture through a PSF, with noise and an unknown background."""
    operator = tc.Recording(np.ones((1, *SHAPE)), model).problem().operators[0]
    sizes = zip(operator.in_shape[-2:], SHAPE, strict=True)
    field = np.pad(image, [((n - s) // 2, n - s - (n - s) // 2) for n, s in sizes])
    clean = np.asarray(operator(jnp.asarray(field[None, None])))
    generator, snr = np.random.default_rng(seed), (30, 35, 40)[seed % 3]
    noise = clean.std() * 10 ** (-snr / 20) * generator.normal(size=clean.shape)
    return clean + 0.1 * clean.max() + noise


def score(model, capture, image, *, turned):
    """PSNR of a reconstruction by the default after the best gain and offset."""
    found = np.asarray(tc.reconstruct(tc.Recording(capture, model), tc.AdmmTV()).image)
    found = found.reshape(image.shape)
    truth = image[::-1, ::-1] if turned else image
    return float(psnr(align(found, truth), truth))


def run(right, given, number, wanted, *, parameters=None):
    """Errors left over stated ones, and the PSNRs of a photograph held out."""
    capture = exposed(right, photograph(number), number)
    found = tc.refine(tc.Recording(capture, given), parameters=parameters)
    held_out = photograph(number + 1)
    other = exposed(right, held_out, number + 100)
    turned = isinstance(right, tc.Cameras)
    models = given, found.recording.imaging_model, right
    scores = [score(model, other, held_out, turned=turned) for model in models]
    errors = {
        name: (found.values[name] - value, found.errors[name])
        for name, value in wanted.items()
        if name in found.values
    }
    return found, errors, scores


def report(name, runs, start, unit=1.0):
    """A line of the table for one number."""
    left = np.array([e[name] for _, e, _ in runs if name in e])
    scores = np.array([s for _, _, s in runs])
    if not left.size:
        return f"{name} not determined in {len(runs)} | | | "
    inside = int(np.sum(np.abs(left[:, 0]) < 2 * left[:, 1]))
    return (
        f"{start} | {name} | {np.median(np.abs(left[:, 0])) / unit:.3f} | "
        f"{np.max(np.abs(left[:, 0])) / unit:.3f} | {np.median(left[:, 1]) / unit:.3f} | "
        f"{inside} of {len(left)} (determined in {len(left)} of {len(runs)}) | "
        + " / ".join(f"{s:.2f}" for s in scores.mean(axis=0))
    )


@pytest.mark.parametrize("kind", [diffuser, random_mask])
@pytest.mark.parametrize("wrong", [0.0, 0.01, -0.02, 0.04])
def test_measured(kind, wrong, capsys):
    turn = TURN if wrong else 0.0
    runs = []
    for number in range(COUNT):
        right = tc.Psfs(sampled(kind, number)[None])
        given = measured(sampled(kind, number, scale=1 / (1 + wrong), turn=-turn), number)
        runs.append(run(right, given, number, {"scale": 1 + wrong, "turn": turn}))
    with capsys.disabled():
        for name, start, unit in (
            ("scale", f"{100 * wrong:g} %", 0.01),
            ("turn", f"{np.rad2deg(turn):g}°", np.deg2rad(1)),
        ):
            print(f"\n| {kind.__name__} | {report(name, runs, start, unit)} |", end="")
    check(runs, is_wrong=bool(wrong))


def check(runs, *, is_wrong):
    """As good as with the right PSF, and on average better than with a wrong one."""
    gains = [after - before for _, _, (before, after, _) in runs]
    assert all(after > min(before, right) - 0.1 for _, _, (before, after, right) in runs)
    assert not is_wrong or np.mean(gains) > 0


@pytest.mark.parametrize("name", ["object_distance", "distance", "both"])
def test_computed(name, capsys):
    runs = []
    wanted = {"distance": 4.0, "object_distance": 25.0}
    for number in range(COUNT):
        given = {n: v * 1.02 if name in (n, "both") else v for n, v in wanted.items()}
        asked = None if name == "both" else [name]
        runs.append(run(camera(), camera(**given), number, wanted, parameters=asked))
    with capsys.disabled():
        for one, value in wanted.items():
            if name in (one, "both"):
                print(f"\n| zone aperture | {report(one, runs, '2 %', value / 100)} |", end="")
