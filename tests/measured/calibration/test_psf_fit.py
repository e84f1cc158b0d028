"""PSF fits: recovery from noisy pictures, the errors claimed, what cannot be told apart."""

import math

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.ndimage

import thincam_jax as tc
from helpers import relative_l2
from thincam_jax import fit_psf
from thincam_jax.measured.calibration import problem
from thincam_jax.measured.calibration.psf_fit import FRINGE_SCANNED
from thincam_jax.measured.calibration.start import PsfSearch, _one_picture, given
from thincam_jax.units import nm, um

LIGHT = {"object_distance": 100.0, "wavelength": 500 * nm}


SENSOR = tc.Sensor((112, 133), 20 * um)


def camera(beta=30.0, distance=3.0, phase=0.0, centre=(0.0, 0.0), *, sensor=SENSOR, height=None):
    mask = tc.FresnelZoneAperture(beta, phase, width=2.0, height=height, centre=centre)
    return tc.LenslessCamera(mask, sensor, distance)


TRUE = camera(phase=1.0, centre=(0.05, -0.03))
START = camera(27.0, 3.3)


def picture(rig, seed=0, snr_db=30.0, **light):
    h = tc.psf(rig, pixel_integration=True, **(LIGHT | light))
    return tc.GaussianNoise(snr_db).add(jax.random.key(seed), h, None)


def deviations(fit, rig):
    """Of each value from the truth, in standard errors."""
    truth = {
        "beta": rig.mask.beta,
        "phase": rig.mask.phase,
        "centre_y": rig.mask.centre[0],
        "centre_x": rig.mask.centre[1],
        "distance": rig.distance,
        "background": 0.0,
        "gain": 1.0,
    }
    return np.array([float((fit.values[n] - truth[n]) / fit.standard_errors[n]) for n in fit.names])


@pytest.mark.thorough
@pytest.mark.parametrize("seed", range(3))
def test_values_are_right_within_their_errors(seed):
    """From a start ten per cent off in β and d, as above on a camera a tenth the size."""
    coarse = tc.Sensor((80, 95), 28 * um)
    true = camera(phase=1.0, centre=(0.05, -0.03), sensor=coarse)
    fit = fit_psf(picture(true, seed), camera(27.0, 3.3, sensor=coarse), **LIGHT)
    assert (fit.status, fit.reasons) == ("ok", ())
    assert np.all(np.abs(deviations(fit, true)) < 4.5)
    assert float(fit.standard_errors["distance"]) < 0.01
    noise = 10 ** (-30 / 20) * math.sqrt(np.mean(np.square(picture(true, snr_db=200.0))))
    np.testing.assert_allclose(np.std(fit.residual), noise, rtol=0.03)


def test_the_model_follows_the_fringes_of_a_pixel():
    """27 a pixel, of the far rim's waves: 24 nodes moved d by 30 standard errors at 40 dB."""
    true = camera(phase=1.0, centre=(0.05, -0.03), sensor=tc.Sensor((12, 15), 20 * um))
    state = given(true, *LIGHT.values(), PsfSearch())
    model = eqx.filter_jit(lambda state: state.image(pixel_integration=True))(state)
    assert relative_l2(model, tc.psf(true, **LIGHT)) < 1e-8


@pytest.mark.thorough
@pytest.mark.parametrize("snr_db", [30.0, *(db for db in (40.0, 10.0))])
def test_ripples_of_the_rims_hold_no_fit(snr_db):
    """The waves of the rims make some hundred minima, each a few standard errors from the next.

    At 10 dB least squares took 38 steps through them.
    """
    h = tc.psf(TRUE, pixel_integration=True, **LIGHT)
    noise = np.random.default_rng(0).normal(size=h.shape)
    image = h + 10 ** (-snr_db / 20) * np.sqrt(np.mean(h**2)) * noise
    fit = fit_psf(image, START, search=PsfSearch(max_steps=20), **LIGHT)
    assert (fit.status, fit.reasons) == ("ok", ())
    assert np.all(np.abs(deviations(fit, TRUE)) < 4.5)


@pytest.mark.thorough
@pytest.mark.parametrize("left_out", ["blur", "shade"])
def test_what_a_wrong_model_leaves_of_a_number_is_told(left_out):
    """A blur of half a pixel moves d by 5 %, 20 times what noise explains; β is right to 0.3 %."""
    image = np.asarray(picture(TRUE))
    if left_out == "blur":
        image = scipy.ndimage.gaussian_filter(image, 0.5)
    else:
        image = image * (1 + 0.2 * np.linspace(-1, 1, image.shape[1]))
    fit = fit_psf(image, START, **LIGHT)
    assert fit.status == "ambiguous"
    (reason,) = fit.reasons
    assert reason.startswith("distance is uncertain by more than") and "blur" in reason
    assert 0.005 < fit.standard_errors["distance"] / fit.values["distance"] < 0.02
    np.testing.assert_allclose(fit.camera.mask.beta, 30.0, rtol=3e-3)


@pytest.mark.thorough
def test_a_number_that_leaves_its_search_is_told():
    """A blur of a pixel is fitted best by a longer d: 4.0 in place of 3.0."""
    image = scipy.ndimage.gaussian_filter(np.asarray(picture(TRUE)), 1.0)
    fit = fit_psf(image, START, **LIGHT)
    assert fit.status == "ambiguous"
    assert any("distance" in line and "left the search of 12%" in line for line in fit.reasons)


@pytest.mark.thorough
def test_wavelength_and_distance_of_a_plane_wave_are_one():
    light = {"object_distance": math.inf, "wavelength": 500 * nm}
    fit = fit_psf(
        picture(TRUE, **light),
        TRUE,
        search=PsfSearch(("distance", "wavelength", "background", "gain"), relative=0.02),
        **light,
    )
    assert fit.status == "ambiguous"
    assert "distance and wavelength cannot be told apart" in fit.reasons[0]
    d, w = (fit.names.index(n) for n in ("distance", "wavelength"))
    np.testing.assert_allclose(fit.correlation[d, w], -1.0, atol=1e-6)
    np.testing.assert_allclose(fit.wavelength * fit.camera.distance, 3.0 * 500 * nm, rtol=1e-3)


def synthesised(weights, seed=6):
    """Of captures that have noise of their own and a background that the synthesis may cancel."""
    shots = [
        0.3 + np.asarray(picture(camera(phase=1.0 + phase, centre=(0.05, -0.03)), seed + k))
        for k, phase in enumerate(weights)
    ]
    return sum(w * shot for w, shot in zip(weights.values(), shots, strict=True))


@pytest.mark.thorough
def test_model_of_a_synthesis_is_the_sum_of_pictures():
    """Here of two in quadrature, which keep a background; and its fringes as one picture."""
    weights = {0.0: 1.0, math.pi / 2: -1j}
    synthesis = problem.Synthesis(
        jnp.asarray(list(weights)), jnp.asarray([[1.0, 0.0], [0.0, -1.0]])
    )
    rigs = [camera(phase=1.0 + phase) for phase in weights]
    h = [
        np.asarray(tc.psf(rig, wavelength=500 * nm, object_distance=100.0, pixel_integration=False))
        for rig in rigs
    ]
    state = problem.FitState(rigs[0], *map(jnp.asarray, (500 * nm, 0.01, 0.2, 3.0)), synthesis)
    image = np.asarray(state.image(False))
    expected = [0.2 + 3 * h[0], -0.2 - 3 * h[1]]
    np.testing.assert_allclose(image, expected, rtol=1e-9, atol=1e-9)
    fringes = _one_picture(image, state)
    assert np.corrcoef(fringes.ravel(), h[0].ravel())[0, 1] > 0.9


@pytest.mark.thorough
def test_phases_in_reverse_order_are_named_and_fitted():
    image = synthesised({-phase: weight for phase, weight in FRINGE_SCANNED.items()})
    fit = fit_psf(image, START, **LIGHT)
    assert fit.status == "ok"
    (reason,) = fit.reasons
    assert "the phases run backwards" in reason
    np.testing.assert_allclose(fit.camera.mask.beta, 30.0, rtol=1e-4)
    assert np.all(np.abs(deviations(fit, TRUE)) < 4.5)


def test_residuals_follow_a_direct_sum():
    """The residual against background + gain·h of the camera that the steps describe."""
    names = problem.unknown_names(("beta", "centre", "distance", "object_distance", "gain"))
    start = problem.FitState(TRUE, *map(jnp.asarray, (500 * nm, 0.01, 0.2, 3.0)))
    steps = jnp.asarray([0.01, 0.5, -1.0, 0.02, 0.001, 0.1])
    there = start.moved(names, steps)
    d = 3.0 * math.exp(0.02)
    nearness = 0.01 + 0.001 / 3.0
    beta = 30.0 * math.exp(0.01) * ((1 + d * nearness) / 1.03) ** 2
    rig = camera(beta, d, 1.0, (0.05 + 0.5 * 0.02, -0.03 - 0.02))
    h = tc.psf(rig, wavelength=500 * nm, object_distance=1 / nearness, pixel_integration=False)
    np.testing.assert_allclose(there.image(False), 0.2 + 3.1 * h, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"camera": camera(0.5)}, "fringes"),
        ({"weights": {0.0: 1.0, 1.5: 1j}}, "give the complex picture"),
        ({"weights": {0.0: 1.0, 2 * math.pi: -1.0}}, "leave no fringes"),
        ({"camera": camera(height=1.0)}, "fits square masks"),
    ],
)
def test_refusals_take_one_line(change, message):
    image = np.random.default_rng(0).uniform(size=(112, 133))
    given = {"psf_image": image, "camera": START} | LIGHT | change
    with pytest.raises(ValueError, match=message) as caught:
        fit_psf(**given)
    assert "\n" not in str(caught.value)
