"""A display behind the plate: its colours through the holograms, its light in the camera."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from waveguide.setting import camera, hologram
from waveguide.studies import tiny_screen

import thincam_jax as tc
from thincam_jax import waveguide as wg
from thincam_jax.imaging.encoding import cie_1931
from thincam_jax.imaging.targets import resize, sample_image
from thincam_jax.units import nm
from thincam_jax.waveguide import display
from thincam_jax.waveguide.display import DisplayLight, display_alone, tint
from thincam_jax.waveguide.studies.screen import ScreenModel

AXIS = jnp.zeros(2)
transmission = eqx.filter_jit(display.transmission)
LCD = [
    wg.ColourBand(centre * nm, width * nm) for centre, width in ((450, 20), (530, 35), (625, 20))
]
LEAK = [(400 * nm, 2e-3), (700 * nm, 2e-3)]


def test_what_is_not_diffracted_goes_through():
    """Kogelnik's peak on the axis: 1 − tanh²ν, with ν smaller by |s·s′| for TM."""
    film = hologram()
    guided = np.asarray(film.diffracted(jnp.array([0.0, 0.0, 1.0])))
    strength = np.pi * 0.02 * 16e-3 / (532 * nm * np.sqrt(-guided[2]))
    expected = np.mean([1 / np.cosh(strength * p) ** 2 for p in (1.0, guided[2])])
    seen = np.asarray(transmission(film, AXIS, jnp.array([480.0, 532.0, 600.0]) * nm))
    np.testing.assert_allclose(seen[1], expected, rtol=1e-4)
    assert seen[0] > 0.99 and seen[2] > 0.99
    both = transmission([film, hologram()], AXIS, jnp.array([532 * nm]))
    assert both[0] < seen[1]


def test_light_from_behind_sees_the_fringes_of_the_opposite_direction():
    """What the hologram takes from the display is guided down, from the scene up."""
    film = hologram()
    sums = np.array([0.0, 0.1, np.sqrt(1 - 0.01)])
    scene, display = (np.asarray(film.diffracted(jnp.asarray(sign * sums))) for sign in (1, -1))
    np.testing.assert_allclose(display, -scene)


def test_a_narrow_primary_is_lost_and_a_broad_one_tinted():
    film = hologram()
    lamp, laser = tint(film, AXIS, LCD), tint(film, AXIS, [wg.ColourBand(532 * nm, 1 * nm)])
    loss = 1 - np.asarray(transmission(film, AXIS, jnp.linspace(500, 560, 601) * nm))
    light = np.linspace(500, 560, 601) * nm
    eye = cie_1931(light)[:, 1] * np.asarray(LCD[1](jnp.asarray(light)))
    rest = (
        sum(np.asarray(one(jnp.asarray(light))) for one in (LCD[0], LCD[2])) * cie_1931(light)[:, 1]
    )
    whole = np.linspace(380, 780, 4001) * nm
    white = cie_1931(whole)[:, 1] @ sum(np.asarray(one(jnp.asarray(whole))) for one in LCD)
    expected = 1 - (loss @ (eye + rest)) * 0.1 / (white * 0.1)
    assert lamp.luminance == pytest.approx(expected, abs=2e-3)
    assert laser.luminance < 0.2 < 0.8 < lamp.luminance
    assert lamp.shift[0] > 0.01 > -0.01 > lamp.shift[1]  # less green
    aside = tint(film, jnp.array([0.0, np.sin(np.radians(10.0))]), LCD)
    assert aside.luminance > 0.99


def test_its_irradiance_is_the_integral_over_leak_and_spectrum():
    """Of a band far narrower than the table, its width times the fraction there, over W."""
    narrow = [wg.ColourBand(550 * nm, 2 * nm)]
    width = 2 * nm * np.sqrt(np.pi / np.log(2)) / 2
    light = DisplayLight([(500 * nm, 0.0), (600 * nm, 0.02)], narrow, radiance=3.0)
    found = light.irradiance((2, 3), 6 * nm)
    np.testing.assert_allclose(found, np.full((2, 3), 3 * 0.01 * width / (6 * nm)), rtol=1e-4)
    halved = light.irradiance((2, 3), 6 * nm, wg.ColourBand(450 * nm, 200 * nm))
    np.testing.assert_allclose(halved, found / 2, rtol=1e-3)
    pattern = np.array([[0.0, 1.0, 2.0], [3.0, 4.0, 2.0]])
    uneven = light.replace(pattern=pattern).irradiance((2, 3), 6 * nm)
    np.testing.assert_allclose(uneven, found * pattern / 2, rtol=1e-6)
    with pytest.raises(ValueError, match=r"has \(2, 3\) pixels; give \(3, 2\)"):
        light.replace(pattern=pattern).irradiance((3, 2), 6 * nm)


@pytest.mark.parametrize(
    ("given", "line"),
    [
        ({"leak": [(500 * nm, 0.1)]}, r"give rows of \(wavelength in mm, fraction\)"),
        ({"leak": [(600 * nm, 0.1), (500 * nm, 0.1)]}, "rows that do not rise"),
        ({"leak": [(500 * nm, 0.1), (600 * nm, 1.1)]}, "fractions outside of 0 to 1"),
        ({"pattern": [[0.0, 0.0]]}, r"give a picture \(y, x\) with light"),
        ({"primaries": []}, "give a list of waveguide.ColourBand"),
    ],
)
def test_faults_are_told(given, line):
    with pytest.raises((ValueError, TypeError), match=line):
        DisplayLight(**({"leak": LEAK, "primaries": LCD} | given))


def test_exposures_of_the_display_have_its_shot_noise():
    light, noise = jnp.full((64, 64), 0.5), tc.PoissonGaussianNoise(3.0)
    sensor = tc.Sensor((64, 64), 5e-3, full_well=1e6, exposure=0.9)
    electrons = jnp.array([200.0, 800.0])[:, None, None]
    mean, variance = display_alone(light, electrons, (sensor, noise, jax.random.key(0)), 4)
    expected = (np.array([100.0, 400.0]) + 9) / np.array([200.0, 800.0]) ** 2 / 4
    np.testing.assert_allclose(variance, expected, rtol=1e-5)
    np.testing.assert_allclose(np.var(mean, axis=(1, 2)), expected, rtol=0.1)
    np.testing.assert_allclose(np.mean(mean, axis=(1, 2)), 0.5, rtol=5e-3)


def test_a_plan_leaves_it_out_below_the_tolerance():
    """And says how much it is of the image otherwise; the level is that of the image."""
    plane = wg.ObjectPlane((24, 28), 550.0, 150.0, (27.0, 0.0))
    scene = wg.LitPlane(plane, resize(sample_image("camera"), (24, 28)))
    sts = dataclasses.replace(camera(), sensor=tc.Sensor((6, 5), 280e-3))
    bare = wg.plan_screen(sts, scene, tolerance=0.03)
    bright, faint = (
        wg.plan_screen(sts, scene, tolerance=0.03, display=DisplayLight(leak, LCD))
        for leak in (LEAK, [(400 * nm, 2e-5), (700 * nm, 2e-5)])
    )
    assert bare.background is None and "display" not in str(bare)
    capture = np.asarray(bare.system()(jnp.asarray(scene.image, bare.precision)))
    relative = np.sqrt(np.mean(bright.background**2) / np.mean(capture**2))
    assert bright.shares["display"] == pytest.approx(relative, rel=0.1) and relative > 0.03
    assert "subtract it" in str(bright) and bright.predicted_error == bare.predicted_error
    assert faint.background is None and "left out" in str(faint) and faint.meets_tolerance
    assert faint.shares["display"] == pytest.approx(bright.shares["display"] / 100)
    assert faint.shares["display"] < faint.predicted_error <= 0.03


def test_two_exposures_subtract_it_and_cost_noise():
    """Without them the image is useless; with them it has the noise that variances add up to."""
    sensor = tc.Sensor((22, 30), 70.4e-3, full_well=2e4, exposure=0.7)
    seen = dataclasses.replace(tiny_screen.camera(), sensor=sensor)
    changed = {
        "noise": tc.PoissonGaussianNoise(2.0),
        "models": (ScreenModel("right"),),
        "solvers": {"CGM": tc.Ridge(1.0)},
        "band_samples": 1,
    }
    light = DisplayLight([(400 * nm, 0.1), (700 * nm, 0.1)], LCD)
    scores, captures = [], []
    for given in ({}, {"display_light": light}, {"display_light": light, "display_frames": 0}):
        study = tiny_screen.study(seen, **changed, **given)
        scores.append(study.run().models["right"].methods["CGM"].scores.mean_psnr_db)
        captures.append(study.captures)
    assert study.background.mean() > 1
    dark, on, left = scores
    assert dark > on + 0.5 and on > left + 5
    clean = study.systems[0](
        jnp.asarray(np.stack(list(study.targets.values())), study.systems[0].values.dtype)
    )
    residual = np.asarray(captures[1].images - clean)
    np.testing.assert_allclose(np.var(residual, axis=(1, 2)), captures[1].variance, rtol=0.2)
    with pytest.raises(ValueError, match="has shot noise; give read_noise"):
        tiny_screen.study(display_light=light)
    with pytest.raises(ValueError, match="takes a lens and one colour"):
        tiny_screen.study(*[tiny_screen.camera()] * 3, display_light=light)
