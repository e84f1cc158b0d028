"""Faults of simulated captures: each changes what it says, by as much as it says."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

from thincam_jax.imaging.operators import CropConvolution
from thincam_jax.learn.imperfections import Imperfections

NONE = Imperfections(
    scale=0.0,
    turn=0.0,
    blur=0.0,
    background=0.0,
    ambient=0.0,
    saturated=0.0,
    hot=0.0,
    electrons=(1e9, 1e9),
    read=0.0,
    bits=12,
)
Y, X = np.mgrid[:41, :61] - np.array([20, 30])[:, None, None]


def spots():
    """A PSF of two spots at a distance on an inclined line, in float32."""
    spot = [np.exp(-((Y - s * 8) ** 2 + (X - s * 18) ** 2) / 8) for s in (-1, 1)]
    return (spot[0] + 0.5 * spot[1])[None].astype(np.float32)


def moments(psf):
    """Angle and length of the main axis of a PSF."""
    weight = psf[0] / psf.sum()
    y, x = (np.sum(weight * c) for c in (Y, X))
    parts = [[np.sum(weight * (a - m) * (b - n)) for b, n in ((Y, y), (X, x))]
             for a, m in ((Y, y), (X, x))]  # fmt: skip
    values, vectors = np.linalg.eigh(np.asarray(parts))
    return np.arctan2(*vectors[:, 1]) % np.pi, np.sqrt(values)


def drawn(count=40, **changes):
    faults = dataclasses.replace(NONE, **changes)
    return [faults.psf(spots(), np.random.default_rng(n)) for n in range(count)]


def test_a_psf_keeps_its_sum_and_without_faults_all():
    (same,) = drawn(1)
    np.testing.assert_allclose(same, spots(), atol=1e-6)
    found = np.asarray([one.sum() for one in drawn(5, scale=0.1, turn=3.0, blur=2.0)])
    np.testing.assert_allclose(found, spots().sum(), rtol=1e-5)


def test_scale_turn_and_blur_are_as_large_as_they_say():
    angle, (narrow, long) = moments(spots())
    sizes = np.asarray([moments(one)[1][1] for one in drawn(scale=0.05)]) / long - 1
    assert 0.04 < sizes.max() < 0.051 and -0.051 < sizes.min() < -0.04
    turns = np.degrees([moments(one)[0] - angle for one in drawn(turn=4.0)])
    assert 3 < turns.max() < 4.01 and -4.01 < turns.min() < -3
    widths = np.asarray([moments(one)[1][0] for one in drawn(blur=2.0)])
    blurs = np.sqrt(np.maximum(widths**2 - narrow**2, 0))
    assert blurs.min() < 0.2 and 1.7 < blurs.max() < 2.05


def test_light_without_faults_is_what_the_sensor_counts():
    light = np.random.default_rng(0).uniform(0, 3, (2, 24, 36)).astype(np.float32)
    seen = NONE.exposed(light, np.random.default_rng(1))
    assert seen.shape == light.shape
    # 12 bits of a range of at most twice the largest, and shot noise of a billion electrons.
    np.testing.assert_allclose(seen, light, atol=3 / 0.5 / 4095)


@pytest.mark.parametrize("name", ["background", "ambient"])
def test_added_light_is_at_most_as_much_as_it_says(name):
    light = np.zeros((1, 24, 36), np.float32)
    light[0, 12, 18] = 2.0
    faults = dataclasses.replace(NONE, **{name: 0.2})
    added = [faults.exposed(light, np.random.default_rng(n))[0, :10] for n in range(30)]
    highest = np.asarray([one.max() for one in added])
    assert 0.2 < highest.max() < 0.41 and highest.min() < 0.1
    spread = np.asarray([np.ptp(one) for one in added]).max()
    assert spread < 0.005 if name == "background" else spread > 0.05


def test_noise_hot_and_saturated_pixels():
    flat = np.full((1, 60, 80), 1.0, np.float32)
    noisy = dataclasses.replace(NONE, electrons=(400.0, 400.0), read=3.0)
    seen = [noisy.exposed(flat, np.random.default_rng(n)) for n in range(6)]
    # A full pixel has 400 electrons, these 0.5 to 0.98 of it: where more come, they are cut off.
    variance = np.asarray([one.var() for one in seen])
    assert (0.9 / 400 < variance).all() and (variance < (2.0 / 400 + 36 / 400**2) * 1.1).all()
    hot = dataclasses.replace(NONE, hot=0.01).exposed(0.1 * flat, np.random.default_rng(0))
    share = np.mean(np.abs(hot - 0.1) > 0.01)
    assert 0.002 < share < 0.02
    ramp = np.linspace(0, 1, 4800, dtype=np.float32).reshape(1, 60, 80)
    cut = dataclasses.replace(NONE, saturated=0.1)
    shares = [np.mean(one == one.max()) for one in
              (cut.exposed(ramp, np.random.default_rng(n)) for n in range(20))]  # fmt: skip
    assert 0.05 < max(shares) < 0.11 and min(shares) < 0.01


def test_a_capture_is_that_of_the_true_psf():
    operator = CropConvolution(jnp.asarray(spots()[:, None], jnp.float32), 1.0, (20, 30), (26, 36),
                               summed=1)  # fmt: skip
    scene = np.random.default_rng(0).uniform(size=(1, 26, 36)).astype(np.float32)
    seen = NONE.capture(operator, spots(), scene, np.random.default_rng(0))
    exact = np.asarray(operator(jnp.asarray(scene)[:, None]))
    np.testing.assert_allclose(seen, exact, atol=2e-3 * exact.max())
    faults = dataclasses.replace(NONE, turn=5.0)
    assert (
        np.abs(faults.capture(operator, spots(), scene, np.random.default_rng(0)) - exact).max()
        > 0.05
    )


def test_what_is_left_out_and_what_is_refused():
    assert (
        Imperfections().without("scale").scale == 0 and Imperfections().without("bits").bits == 12
    )
    with pytest.raises(ValueError, match=r"electrons = \(9.0, 3.0\): give the fewest first"):
        Imperfections(electrons=(9.0, 3.0))
    with pytest.raises(ValueError, match="scale"):
        Imperfections(scale=0.5)
