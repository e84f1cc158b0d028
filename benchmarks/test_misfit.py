"""Eight cameras whose model is wrong: quality against iterations, and smooth misfit counted less.

One photograph, 30 dB of noise. Captures are those of a PSF that is blurred, or has a random profile
beside the model's (1, 3, 10 % of its detail), or they are shaded by as much. PSNR after the best
gain and offset, after 50, 100, 300 and 600 iterations of the default AdmmTV at most; then of 600
iterations whose smooth light counts in full.
"""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from test_background import score
from test_prior import PHOTOGRAPHS

import thincam_jax as tc
from thincam_jax.learn.sources import photographs
from thincam_jax.reconstruction import smooth_misfit
from thincam_jax.reconstruction.problem import forward

SIDE = 96
ITERATIONS = (50, 100, 300, 600)
CASES = [("none", 0.0)]
CASES += [(kind, part) for kind in ("blur", "profile", "shading") for part in (0.01, 0.03, 0.1)]


def zone(pixels, pitch, field, beta, width):
    mask = tc.FresnelZoneAperture(beta, width=width)
    camera = tc.LenslessCamera(mask, tc.Sensor((pixels, pixels), pitch), 7.5)
    optics = tc.Cameras(
        [camera], wavelength=5e-4, object_distance=100.0, field_shape=(field, field)
    )
    return optics, pixels


def pairs(betas, phases):
    masks = [tc.FresnelZoneAperture(b, p, width=5.6) for b in betas for p in phases]
    cameras = [tc.LenslessCamera(m, tc.Sensor((192, 192), 0.029), 6.5) for m in masks]
    optics = tc.Cameras(cameras, wavelength=5e-4, object_distance=250.0, field_shape=(SIDE, SIDE))
    return optics, 192


def mura(order, cell):
    mask = tc.ModifiedUniformlyRedundantArray(order, cell)
    camera = tc.LenslessCamera(mask, tc.Sensor((192, 192), 0.03), 3.0)
    optics = tc.Cameras([camera], wavelength=5e-4, object_distance=100.0, field_shape=(SIDE, SIDE))
    return optics, 192


def measured(kind):
    rng = np.random.default_rng(0)
    if kind == "random code":
        psf = np.kron(rng.random((24, 24)) < 0.3, np.ones((4, 4))).astype(float)
    else:
        v = np.fft.fftfreq(SIDE)
        smooth = np.exp(-400 * (v[:, None] ** 2 + v**2))
        relief = np.fft.ifft2(np.fft.fft2(rng.standard_normal((SIDE, SIDE))) * smooth).real
        slopes = np.gradient(relief / relief.std())
        places = [np.indices((SIDE, SIDE))[k] + 40 * slopes[k] for k in (0, 1)]
        edges = [np.arange(SIDE + 1) - 0.5] * 2
        psf = np.histogram2d(places[0].ravel(), places[1].ravel(), edges)[0]
    return tc.Psfs((psf / psf.sum())[None], field_shape=(191, 191)), SIDE


CAMERAS = {
    "zone aperture": lambda: zone(192, 0.044, SIDE, 13.0, 4.2),
    "zone aperture, field of the sensor": lambda: zone(112, 0.06, 112, 17.0, 6.0),
    "four phases": lambda: pairs((25.0,), (0.0, np.pi / 2, np.pi, 3 * np.pi / 2)),
    "method B": lambda: pairs((25.0, 21.0), (0.0, 3 * np.pi / 2)),
    "MURA-31": lambda: mura(31, 0.18),
    "MURA-101": lambda: mura(101, 0.055),
    "diffuser": lambda: measured("diffuser"),
    "random code": lambda: measured("random code"),
}


def true_operator(operator, kind, part, rng):
    """The camera of which the model is `operator`: a part of its detail is another."""
    modelled, window = np.asarray(operator.spectrum), operator.window
    v, u = np.fft.fftfreq(window[0])[:, None], np.fft.rfftfreq(window[1])
    detail = v**2 + u**2

    def changed(other):
        power = [np.sum(np.abs(s) ** 2 * (detail > 0)) for s in (other - modelled, modelled)]
        return np.sqrt(power[0] / power[1])

    other = modelled
    if kind == "blur":
        low, high = 0.0, 20.0
        for _ in range(40):
            sigma = (low + high) / 2
            other = modelled * np.exp(-2 * np.pi**2 * sigma**2 * detail)
            low, high = (sigma, high) if changed(other) < part else (low, sigma)
    if kind == "profile":
        kernel = np.fft.irfft2(modelled, s=window)
        error = np.fft.rfft2(rng.standard_normal(kernel.shape) * np.abs(kernel))
        other = modelled + part * error / changed(modelled + error)
    return eqx.tree_at(lambda o: o.spectrum, operator, jnp.asarray(other))


def recorded(optics, pixels, picture, kind, part):
    rng = np.random.default_rng(0)
    blank = np.zeros((optics.count, pixels, pixels))
    operators = tc.Recording(blank, optics, noise_variance=1.0).problem().operators
    shape = operators[0].field_shape
    if isinstance(optics, tc.Psfs):
        inner = picture[16:80, 16:80]
        truth = np.pad(inner, [((n - 64) // 2, n - 64 - (n - 64) // 2) for n in shape])
    else:
        truth = picture
    # Cameras turn the scene by 180°.
    seen = truth if isinstance(optics, tc.Psfs) else truth[::-1, ::-1]
    y, x = np.meshgrid(*[np.linspace(-1, 1, pixels)] * 2, indexing="ij")
    shade = part * (np.sin(1.7 * y + 0.3) + 0.7 * np.cos(2.9 * x - 1)) * (kind == "shading")
    captures = []
    for operator in operators:
        other = true_operator(operator, kind, part, rng)
        light = np.asarray(forward(other, jnp.asarray(seen.copy())[None, None])).reshape(y.shape)
        noise = light.std() * 10**-1.5 * rng.standard_normal(y.shape)
        captures.append(light * (1 + shade) + noise)
    return tc.Recording(captures, optics), truth


@pytest.mark.parametrize("name", CAMERAS)
def test_more_iterations_make_nothing_worse(name, capsys, monkeypatch):
    if not PHOTOGRAPHS.exists():
        pytest.skip(f"needs photographs in {PHOTOGRAPHS}")
    optics, pixels = CAMERAS[name]()
    side = 112 if "field" in name else SIDE
    picture = photographs(PHOTOGRAPHS / "cc-by-sa/validation", side)[3]
    for kind, part in CASES:
        recording, truth = recorded(optics, pixels, picture, kind, part)
        found = [tc.reconstruct(recording, tc.AdmmTV(iterations=n)) for n in ITERATIONS]
        scores = [score(result.image, truth) for result in found]
        with monkeypatch.context() as patch:
            patch.setattr(smooth_misfit, "_MISFIT", np.inf)
            plain = score(tc.reconstruct(recording, tc.AdmmTV(iterations=600)).image, truth)
        said = "smooth" if "smooth" in found[-1].reason else found[-1].reason[:20]
        cells = "/".join(f"{value:.2f}" for value in scores)
        with capsys.disabled():
            print(
                f"\n| {name} | {kind} {100 * part:g} % | {cells} | {plain:.2f} | {said} |", end=""
            )
        assert min(b - a for a, b in zip(scores[1:], scores[2:], strict=False)) > -0.2
        assert scores[-1] > plain - 0.1
