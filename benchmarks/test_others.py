"""thincam_jax beside LenslessPiCam, scico, chromatix and dLux: PSNR, accuracy and CPU seconds.

Every part is skipped where its package is missing. One environment for all, whose declared bounds
on jax, numpy and opencv contradict one another, so that two packages come without them:

    pip install . pytest dLux==0.15.1 opencv-python-headless flax PyAbel einops
    pip install --no-deps lensless==1.0.8 scico==0.0.7
    git clone https://github.com/chromatix-team/chromatix   # its src/ into PYTHONPATH
    python -m pytest benchmarks/test_others.py -s

Rivals are tuned against the truth, each picture and PSF for itself; thincam_jax runs by its default
calls, and once tuned alike. Photographs are those that no denoiser here was trained on. Captures
are linear convolutions of a scene in front of the sensor, cropped to it, with 30 dB of noise;
models are right, or 2 % off in norm, blurred or shaded. PSNR is after the best gain and offset.
"""

import importlib.util
import os
import resource
import subprocess
import sys
import time
from pathlib import Path

import jax
import numpy as np
import pytest
import scipy.signal
from scipy.ndimage import gaussian_filter

sys.path.insert(0, str(Path(__file__).parent))
import others
from test_background import score

import thincam_jax as tc
from thincam_jax.learn.sources import photographs
from thincam_jax.units import nm

PHOTOGRAPHS = Path(os.environ.get("THINCAM_PHOTOGRAPHS", "../shared/data/photographs"))
UNSEEN = PHOTOGRAPHS / "cc-by-sa/validation"
PICTURES = 3, 10
SENSOR = 96, 120
START = 1e-4, 1e2, 1.0  # weight, and factors of LenslessPiCam's penalties
TAUS = 0.25, 0.35, 0.5, 0.7, 1.0, 1.4, 2.0
RIGHT = "right"


def diffuser():
    """Caustics of a smooth random relief."""
    rng, (rows, columns) = np.random.default_rng(0), SENSOR
    v, u = np.fft.fftfreq(rows)[:, None], np.fft.rfftfreq(columns)
    smooth = np.exp(-400 * (v**2 + u**2))
    relief = np.fft.irfft2(np.fft.rfft2(rng.standard_normal(SENSOR)) * smooth, s=SENSOR)
    places = [
        n / 2 + 0.6 * (place - n / 2) + 30 * slope
        for n, place, slope in zip(
            SENSOR, np.indices(SENSOR), np.gradient(relief / relief.std()), strict=True
        )
    ]
    edges = [np.arange(n + 1) - 0.5 for n in SENSOR]
    psf = np.histogram2d(*(place.ravel() for place in places), edges)[0]
    return psf / psf.sum()


def zone_aperture():
    mask = tc.FresnelZoneAperture(17.0, width=3.0)
    camera = tc.LenslessCamera(mask, tc.Sensor(SENSOR, 0.044), 7.5)
    light = {"wavelength": 500 * nm, "object_distance": 100.0, "pixel_integration": False}
    psf = np.asarray(tc.psf(camera, **light), float)
    return psf / psf.sum()


CAMERAS = {"diffuser": diffuser, "zone aperture": zone_aperture}


def wrong(psf, kind, part=0.02):
    """A PSF that differs from another by a part of its norm."""
    if kind == RIGHT:
        return psf
    if kind == "shaded":
        y, x = np.meshgrid(*(np.linspace(-1, 1, n) for n in psf.shape), indexing="ij")
        change = psf * (np.sin(1.7 * y + 0.3) + 0.7 * np.cos(2.9 * x - 1))
        return psf + part * np.linalg.norm(psf) / np.linalg.norm(change) * change
    low, high = 0.0, 5.0
    for _ in range(30):
        sigma = (low + high) / 2
        model = gaussian_filter(psf, sigma, mode="constant")
        small = np.linalg.norm(model - psf) < part * np.linalg.norm(psf)
        low, high = (sigma, high) if small else (low, sigma)
    return model


def exposures(psf):
    """(scene, capture) of every picture."""
    if not UNSEEN.is_dir():
        pytest.skip(f"needs photographs in {UNSEEN}")
    images = photographs(UNSEEN, 80)
    for seed, index in enumerate(PICTURES):
        scene = np.zeros(SENSOR)
        scene[16:80, 20:100] = images[index][8:72]
        light = scipy.signal.fftconvolve(scene, psf)
        light = light[tuple(slice(n // 2, n // 2 + n) for n in SENSOR)]
        noise = np.random.default_rng(seed).standard_normal(SENSOR)
        yield scene, light + light.std() * 10**-1.5 * noise


def climb(quality, start, steps):
    """(best quality, settings) by factors of one setting at a time, from coarse to fine."""
    seen = {}

    def value(settings):
        key = tuple(np.round(np.log10(settings), 6))
        if key not in seen:
            seen[key] = quality(settings)
        return seen[key]

    best = tuple(start)
    for step in steps:
        while True:
            near = [
                tuple(s * step**power if k == axis else s for k, s in enumerate(best))
                for axis in range(len(best))
                for power in (-1, 1)
            ]
            found = max(near, key=value)
            if value(found) <= value(best):
                break
            best = found
    return value(best), best


STEPS = 10**0.5, 10**0.25


def best_of(method, scene, capture, psf, start=START, iterations=(100, 300), steps=STEPS):
    """Tuned PSNR for each number of iterations, later ones coarsely, and the last settings."""
    scores = []
    for count in iterations:

        def quality(settings, count=count):
            with np.errstate(all="ignore"):
                image = method(capture, psf, settings, count)
            return score(image, scene) if np.isfinite(image).all() else -np.inf

        found, start = climb(quality, start, steps if count == iterations[0] else steps[:1])
        scores.append(found)
    return scores, start


def say(capsys, *cells):
    with capsys.disabled():
        print("\n| " + " | ".join(str(cell) for cell in cells) + " |", end="", flush=True)


@pytest.mark.filterwarnings("ignore::UserWarning")  # of scico and lensless at import
@pytest.mark.filterwarnings("ignore::DeprecationWarning")
@pytest.mark.parametrize("kind", [RIGHT, "blurred", "shaded"])
@pytest.mark.parametrize("camera", CAMERAS)
def test_reconstruction(camera, kind, capsys):
    if not (there("lensless.recon") or there("scico")):
        pytest.skip("needs lensless or scico")
    truth = CAMERAS[camera]()
    model, rows, settings = wrong(truth, kind), {}, {}
    for scene, capture in exposures(truth):
        own = {"AdmmTV()": others.thincam("AdmmTV"), "PlugAndPlay()": others.thincam("PlugAndPlay")}
        for rule in ("sure", "discrepancy"):
            own[f"AdmmTV, τ {rule}"] = others.thincam("AdmmTV", tau=rule)
        found = {name: [score(method(capture, model), scene)] for name, method in own.items()}
        tuned = [others.thincam("AdmmTV", tau=tau)(capture, model) for tau in TAUS]
        values = [score(image, scene) for image in tuned]
        found["AdmmTV, τ tuned"] = [max(values)]
        settings["AdmmTV, τ tuned"] = TAUS[int(np.argmax(values))]
        found["NumPy ADMM"], best = best_of(others.numpy_admm, scene, capture, model)
        settings["NumPy ADMM"] = best
        if there("lensless.recon"):
            name = "LenslessPiCam ADMM"
            found[name], settings[name] = best_of(others.lensless_picam, scene, capture, model)
        if there("scico") and kind == RIGHT:
            dncnn = settings.get("scico DnCNN")
            for name, (scores, last) in scicos(scene, capture, model, best, dncnn):
                found[name], settings[name] = scores, last
        for name, scores in found.items():
            cell = " / ".join(f"{value:.2f}" for value in scores)
            rows.setdefault(name, []).append(cell)
    for name, scores in rows.items():
        last = " ".join(f"{value:.2g}" for value in np.atleast_1d(settings.get(name, ())))
        say(capsys, camera, kind, name, *scores, last or "default")


def scicos(scene, capture, psf, best, dncnn):
    """ADMM with NumPy's settings, as its iteration is the same; DnCNN tuned, or as for a picture.

    An iteration takes too long for a search of all settings for every picture.
    """
    with jax.enable_x64(False):
        images = [others.scico(capture, psf, best, count) for count in (100, 300)]
        yield "scico ADMM", ([score(image, scene) for image in images], best)
        found = [score(others.scico_dncnn(capture, psf, dncnn, 30), scene)] if dncnn else None
        if not found:
            options = {"iterations": (30,), "steps": (10**0.5,)}
            found, dncnn = best_of(others.scico_dncnn, scene, capture, psf, (0.1, 3e-3), **options)
        yield "scico DnCNN", (found, dncnn)


def there(package):
    """Whether a module is installed; its absence leaves out its rows only.

    Ask for lensless.recon: a folder of the tests is called lensless, too.
    """
    try:
        return importlib.util.find_spec(package) is not None
    except ModuleNotFoundError:
        return False


METHODS = {
    "AdmmTV()": ("thincam_jax", "others.thincam('AdmmTV')(c, p)"),
    "PlugAndPlay()": ("thincam_jax", "others.thincam('PlugAndPlay')(c, p)"),
    "NumPy ADMM, 100": ("numpy", "others.numpy_admm(c, p, (1e-4, 1e2, 1.0), 100)"),
    "LenslessPiCam ADMM, 100": (
        "lensless.recon.admm",
        "others.lensless_picam(c, p, (1e-4, 1e2, 1.0), 100)",
    ),
    "scico ADMM, 100": ("scico", "others.scico(c, p, (1e-4, 1e2, 1.0), 100)"),
    "scico DnCNN, 30": ("scico", "others.scico_dncnn(c, p, (0.1, 1e-3), 30)"),
}


@pytest.mark.filterwarnings("ignore::UserWarning")
@pytest.mark.filterwarnings("ignore::DeprecationWarning")
@pytest.mark.parametrize("name", METHODS)
def test_reconstruction_time(name, capsys, tmp_path):
    """CPU and wall seconds: a new process to its first image, then warm, least to most of five."""
    package, call = METHODS[name]
    pytest.importorskip(package)
    psf = diffuser()
    capture = next(exposures(psf))[1]
    np.savez(tmp_path / "case.npz", c=capture, p=psf)
    code = f"import numpy as np, others; f = np.load({str(tmp_path / 'case.npz')!r}); "
    code += f"c, p = f['c'], f['p']; {call}"
    before, start = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    path = os.pathsep.join([str(Path(__file__).parent), os.environ.get("PYTHONPATH", "")])
    subprocess.run(
        [sys.executable, "-c", code], check=True, env=os.environ | {"PYTHONPATH": path}, timeout=300
    )
    wall, after = time.perf_counter() - start, resource.getrusage(resource.RUSAGE_CHILDREN)
    cold = sum(getattr(after, k) - getattr(before, k) for k in ("ru_utime", "ru_stime"))
    with jax.enable_x64(False):
        run = eval(f"lambda c, p: {call}", {"others": others})
        times = repeated(lambda: run(capture, psf))
    say(capsys, name, f"{cold:.1f} ({wall:.1f})", *(f"{seconds:.3g}" for seconds in times))


def repeated(function, rounds=5):
    """Least, median and most CPU seconds after a warm-up, and the median of the wall's."""
    function()
    cpu, wall = [], []
    for _ in range(rounds):
        starts = time.process_time(), time.perf_counter()
        function()
        cpu.append(time.process_time() - starts[0])
        wall.append(time.perf_counter() - starts[1])
    return min(cpu), float(np.median(cpu)), max(cpu), float(np.median(wall))


# The PSF of a zone aperture: 512² pixels of 5.5 µm, whose shadow fits on the sensor.
PIXELS, PITCH, DISTANCE, FAR, WAVELENGTH = 512, 5.5e-3, 6.5, 250.0, 5e-4
BETA, WIDTH = 25.0, 2.2


def reference(x):
    """Fresnel's integral by 8192 Gauss–Legendre nodes along each axis, at coordinates x along both.

    The field behind ½ + ½ cos βr² lit from a point on the axis is ½ g₀(x)g₀(y) + ¼ Σ± g±(x)g±(y),
    g_s(x) = ∫ exp(j[(sβ + k/2t + k/2d)ξ² − kxξ/d]) dξ over the aperture.
    """
    k = 2 * np.pi / WAVELENGTH
    nodes, weights = np.polynomial.legendre.leggauss(64)
    panels = np.linspace(-WIDTH / 2, WIDTH / 2, 129)
    half = np.diff(panels)[:, None] / 2
    xi = (panels[:-1, None] + half + half * nodes).ravel()
    weights = (half * weights).ravel()
    spread = np.exp(-1j * k / DISTANCE * np.outer(x, xi))
    field = 0
    for sign, amplitude in ((0, 0.5), (1, 0.25), (-1, 0.25)):
        chirp = (sign * BETA + k / 2 / FAR + k / 2 / DISTANCE) * xi**2
        g = spread @ (weights * np.exp(1j * chirp))
        field = field + amplitude * np.outer(g, g)
    return np.abs(field) ** 2


def field_behind(x):
    """The mask's field on samples; one at its edge counts by the part of it that is open."""
    step = x[1] - x[0]
    opened = np.clip((WIDTH / 2 - np.abs(x)) / step + 0.5, 0, 1)
    squared = x[:, None] ** 2 + x**2
    lit = np.exp(1j * np.pi / WAVELENGTH / FAR * squared)
    return (0.5 + 0.5 * np.cos(BETA * squared)) * lit * np.outer(opened, opened)


def errors(found, exact):
    """Relative RMS and greatest error, of its maximum, after the best gain."""
    found = np.asarray(found, float)
    gap = found * np.vdot(found, exact) / np.vdot(found, found) - exact
    return np.linalg.norm(gap) / np.linalg.norm(exact), np.abs(gap).max() / exact.max()


def psf_row(capsys, name, call, part, exact, **cells):
    worst = [f"{value:.1e}" for value in errors(np.asarray(call())[part], exact)]
    least, median, most, wall = repeated(call)
    say(
        capsys,
        name,
        *cells.values(),
        *worst,
        f"{median:.3g} ({least:.3g}–{most:.3g})",
        f"{wall:.3g}",
    )


@pytest.mark.parametrize("digits", [32, 64])
def test_psf_of_thincam(digits, capsys):
    x = (np.arange(PIXELS) - (PIXELS - 1) / 2) * PITCH
    with jax.enable_x64(digits == 64):
        mask = tc.FresnelZoneAperture(BETA, width=WIDTH)
        camera = tc.LenslessCamera(mask, tc.Sensor((PIXELS, PIXELS), PITCH), DISTANCE)

        def call():
            found = tc.psf(
                camera, wavelength=WAVELENGTH, object_distance=FAR, pixel_integration=False
            )
            return jax.block_until_ready(found)

        cells = {"samples": PIXELS, "float": digits}
        psf_row(capsys, "tc.psf", call, np.s_[:], reference(x), **cells)


@pytest.mark.parametrize("digits", [32, 64])
@pytest.mark.parametrize("times", [1, 2, 4])
@pytest.mark.parametrize(
    ("package", "model", "centre"),
    [
        ("chromatix.functional", "chromatix_fresnel", 0.0),
        ("chromatix.functional", "chromatix_angular_spectrum", 0.0),
        ("dLux", "dlux_angular_spectrum", 0.5),
    ],
)
def test_psf_of_others(package, model, centre, times, digits, capsys):
    """At the pixels' pitch over `times`; every such sample is compared, where it lies."""
    pytest.importorskip(package)
    pitch, count = PITCH / times, PIXELS * times
    x = (np.arange(count) - count / 2 + centre) * pitch
    with jax.enable_x64(digits == 64):
        field = field_behind(x).astype(f"complex{2 * digits}")
        call = getattr(others, model)(field, pitch, DISTANCE, WAVELENGTH)
        cells = {"samples": 2 * count, "float": digits}
        part = np.s_[::times, ::times]
        psf_row(capsys, model.replace("_", " "), call, part, reference(x[::times]), **cells)
