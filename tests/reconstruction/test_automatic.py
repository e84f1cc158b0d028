"""Which method is picked, and the reason that is given."""

import jax.numpy as jnp
import numpy as np
import pytest
from reconstruction import rig

from thincam_jax.reconstruction.automatic import are_cameras, choose_method

RNG = np.random.default_rng(1)
PAIR = np.array([[1.0, -1.0]])


def captures(noise):
    """A bright ground of 10, a pattern of ±1 of opposite sign in the two captures, white noise."""
    pattern = np.sign(np.sin(np.arange(96)[:, None] / 5) * np.sin(np.arange(85) / 7 + 0.1))
    clean = 10 + np.stack([pattern, -pattern])
    return jnp.asarray(clean + noise * RNG.normal(size=clean.shape))


def test_measured_psfs_need_the_crop():
    method, reason = choose_method(captures(0.1), jnp.ones((2, 5, 6)), None, None)
    assert method == "admm_tv" and "PSFs were measured" in reason


@pytest.mark.parametrize(
    ("synthesis", "count"), [(None, "2 of 2"), (np.array([[1.0, 1.0], [1.0, -1.0]]), "1 of 2")]
)
def test_a_background_that_is_kept_needs_the_crop(synthesis, count):
    method, reason = choose_method(captures(0.001), rig.pair(), synthesis, None)
    assert method == "admm_tv" and reason.startswith(f"{count} channels keep the bright background")


def test_backgrounds_of_unlike_apertures_do_not_cancel():
    cameras = [rig.camera(0.0), rig.camera(0.0, width=1.4)]
    method, reason = choose_method(captures(0.001), cameras, PAIR, None)
    assert method == "admm_tv" and reason.startswith("1 of 1 channels keep the bright background")


@pytest.mark.parametrize(
    ("synthesis", "variance", "message"),
    [
        (np.ones((1, 3)), None, r"synthesis has shape \(1, 3\); give \(channels, 2\)"),
        (PAIR, jnp.ones(3), r"noise_variance has shape \(3,\); give one number or one for each"),
    ],
)
def test_what_does_not_fit_is_told_before_the_choice(synthesis, variance, message):
    with pytest.raises(ValueError, match=message):
        choose_method(captures(0.001), rig.pair(), synthesis, variance)


@pytest.mark.parametrize("known", [True, False])
def test_contrast_over_noise_decides_else(known):
    """The difference has a contrast of 2 over a noise of √2 σ: √2/σ, whether σ is told or not."""
    for noise, expected in ((0.2, "admm_tv"), (0.056, "admm_tv"), (0.039, "wiener")):
        variance = noise**2 if known else None
        method, reason = choose_method(captures(noise), rig.pair(), PAIR, variance)
        assert method == expected
        told = float(reason.split("contrast is ")[1].split()[0])
        assert told == pytest.approx(2**0.5 / noise, rel=0.06)
    each = choose_method(captures(0.1), rig.pair(), PAIR, jnp.asarray([0.01, 0.03]))
    told = float(each[1].split("contrast is ")[1].split()[0])
    assert told == pytest.approx(2 / 0.04**0.5, rel=0.05)


def test_colours_and_darkness():
    """A batch is judged as one; nothing at all is no reason for a filter."""
    colour = jnp.stack([captures(0.02)] * 3, axis=1)
    assert choose_method(colour, rig.pair(), PAIR, None)[0] == "wiener"
    assert choose_method(0 * colour, rig.pair(), PAIR, None)[0] == "admm_tv"
    # clean captures, of which most of the pixels are dark
    clean = jnp.zeros((2, 96, 85)).at[0, 30:40, 20:30].set(1.0)
    assert choose_method(clean, rig.pair(), PAIR, None)[0] == "wiener"


def test_are_cameras():
    assert are_cameras(rig.pair()) and are_cameras(tuple(rig.pair()))
    assert not are_cameras(jnp.ones((2, 3, 4))) and not are_cameras([np.ones((3, 4))])
