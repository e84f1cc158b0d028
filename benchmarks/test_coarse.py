"""A colour capture of 512²: the default, with coarse pixels first, beside all on the finest."""

import time

import jax.numpy as jnp
import numpy as np
import pytest
from test_prior import PHOTOGRAPHS

import thincam_jax as tc
from thincam_jax.imaging.metrics import align, psnr
from thincam_jax.learn.sources import photographs
from thincam_jax.reconstruction.problem import forward

SIDE = 512


def timed(recording, solver, **more):
    """Result and CPU seconds of the second call."""
    tc.reconstruct(recording, solver, **more)
    began = time.process_time()
    result = tc.reconstruct(recording, solver, **more)
    return result, time.process_time() - began


def test_a_colour_capture(capsys):
    if not PHOTOGRAPHS.exists():
        pytest.skip(f"needs photographs in {PHOTOGRAPHS}")
    mask, sensor = tc.FresnelZoneAperture(25.0, width=5.6), tc.Sensor((SIDE, SIDE), 0.011)
    camera = tc.LenslessCamera(mask, sensor, 6.5)
    optics = tc.Cameras([camera], wavelength=5e-4, object_distance=250.0)
    truth = np.stack(photographs(PHOTOGRAPHS / "cc-by-sa/validation", SIDE)[:3])
    blank = tc.Recording(np.zeros((1, SIDE, SIDE)), optics, noise_variance=1.0).problem()
    seen = jnp.asarray(truth[:, ::-1, ::-1].astype(np.float32))[:, None]
    light = np.stack([np.asarray(forward(blank.operators[0], one[None])) for one in seen])
    light = light.reshape(3, SIDE, SIDE)
    rng = np.random.default_rng(0)
    noise = light.std((1, 2), keepdims=True) * 10**-1.5 * rng.standard_normal(light.shape)
    recording = tc.Recording((light + noise)[None].astype(np.float32), optics)
    uniform = jnp.full((3, SIDE, SIDE), 0.4)
    rows = {
        "default": timed(recording, tc.AdmmTV()),
        "100 iterations from a uniform start": timed(
            recording, tc.AdmmTV(iterations=100), start=uniform
        ),
        "plug and play": timed(recording, tc.PlugAndPlay()),
    }
    found = {}
    for name, (result, seconds) in rows.items():
        scores = [
            float(psnr(align(np.asarray(i), t), t))
            for i, t in zip(result.image, truth, strict=True)
        ]
        found[name] = (seconds, min(p.objective for p in result.history), np.mean(scores))
        with capsys.disabled():
            cells = "{:.1f} | {:.0f} | {:.2f}".format(*found[name])
            print(f"\n| {name} | {cells} | {result.iterations} | {result.status} |", end="")
    default, uniform = found["default"], found["100 iterations from a uniform start"]
    assert default[0] < 0.8 * uniform[0] and default[1] < uniform[1] and default[2] > uniform[2]
