"""What is predicted of a sampled PSF is at least what it is, and not far above."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import thincam_jax as tc
from helpers import relative_l2
from thincam_jax.lensless.masks.phase import MaskBlank, diffuser, voronoi_fresnel
from thincam_jax.units import nm, um

WAVELENGTH = 532 * nm
KEY = jax.random.key(11)
BLANK = MaskBlank((40, 48), 5 * um, 1.5)


def camera(name):
    if name == "diffuser":
        mask = diffuser(KEY, BLANK, correlation_length=20 * um, rms_slope=0.02)
    elif name == "lenses":
        mask = voronoi_fresnel(KEY, BLANK, sites=3, focal_length=4.0, wavelength=WAVELENGTH)
    else:
        mask = BLANK.mask(np.random.default_rng(0).uniform(0, 1e-3, (40, 48)))
    return tc.LenslessCamera(mask, tc.Sensor((36, 40), 5 * um), 4.0)


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("name", "average"),
    [("diffuser", False), ("lenses", True), ("cells", False), ("lenses", False), ("cells", True)],
)
def test_predicted_errors_are_at_least_the_true_ones(name, average):
    """Against 11 samples a pixel and a window of three times the width."""
    here = camera(name)
    light = {"wavelength": WAVELENGTH, "pixel_integration": average}
    choice = tc.choose_model(here, tolerance=0.05 if name == "cells" else 0.02, **light)
    assert choice.method.model == "angular_spectrum" and choice.meets_tolerance
    finest = tc.PsfMethod("angular_spectrum", oversampling=11, mask_shape=(120, 128))
    best = tc.psf(here, model=finest, **light)
    for tried in choice.considered:
        found = tc.psf(here, model=tried.method, **light)
        true = relative_l2(found, best)
        assert true < tried.predicted_error < 12 * true + 1e-6, (tried, true)
    assert "has no exact PSF" in choice.reasons[0]


@pytest.mark.thorough
def test_a_choice_beyond_reach_says_so_and_traced_numbers_are_refused():
    choice = tc.choose_model(
        camera("diffuser"), wavelength=WAVELENGTH, tolerance=1e-9, pixel_integration=False
    )
    assert not choice.meets_tolerance
    assert [p.method.oversampling for p in choice.considered] == [1, 3, 5, 7]
    assert choice.predicted_error == choice.considered[-1].predicted_error
    lenses = camera("lenses")
    with pytest.raises(TypeError, match="the choice of a model needs known numbers"):
        jax.jit(
            lambda w: (
                tc.choose_model(
                    lenses, wavelength=w, tolerance=0.1, pixel_integration=False
                ).cost.flops
            )
        )(jnp.asarray(WAVELENGTH))
