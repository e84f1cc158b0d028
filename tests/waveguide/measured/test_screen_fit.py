"""Screens found from a matrix or from ghosts: the errors claimed, other distances, what is open."""

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import thincam_jax as tc
from thincam_jax import waveguide as wg
from thincam_jax.imaging.operators import Matrix
from thincam_jax.measured.calibration import fit_screen
from thincam_jax.units import deg, nm, um
from thincam_jax.waveguide.measured.screen_fit import GhostPositions
from thincam_jax.waveguide.smear import trace_band

CELLS = (8, 16)


def camera(reference=61.2, glass=5.0, lens=10.0, tilt=0.0, pixels=(22, 30), pitch=70.4 * um):
    film = wg.VolumeHologram.record(
        532 * nm, 0.0, reference * deg, index=1.5, thickness=16 * um, index_modulation=0.02
    )
    _, y, z = film.grating
    grating = jnp.stack([-jnp.sin(tilt) * y, jnp.cos(tilt) * y, z])
    film = wg.VolumeHologram(grating, 1.5, film.thickness, film.index_modulation)
    return wg.SeeThroughCamera(wg.Screen(film, glass, 1.5), tc.Sensor(pixels, pitch), 6.0, lens)


def plane(distance=550.0, centre=(27.0, 0.0), shape=CELLS):
    return wg.ObjectPlane(shape, distance, 150.0, centre)


TRUE = {"reference": 61.7, "glass": 5.1, "lens": 10.6, "tilt": 0.01}
CENTRE = (27.9, 0.8)
VALUES = {
    "glass_thickness": 5.1,
    "lens_distance": 10.6,
    "slant": 61.7 * deg / 2,
    "tilt": 0.01,
    "object_x": 0.8,
    "object_y": 27.9,
}


def ghosts(deviation, true=TRUE, orders=3, leaning=(0.0, 0.0)):
    """A dot for every order of twelve pixels, the middle of its band, with an error."""
    random = np.random.default_rng(0)
    pixels = random.uniform(-1, 1, (12, 2))[:, ::-1]
    sts = eqx.tree_at(lambda c: c.tilt, camera(**true), jnp.asarray(leaning))
    seen = trace_band(sts, jnp.asarray(pixels), 550.0, orders, 1).points[:, :, 0]
    points = (np.asarray(seen) - CENTRE).reshape(-1, 2)
    noisy = points + deviation * random.normal(size=points.shape)[:, ::-1]
    return GhostPositions(
        np.tile(pixels, (orders, 1)), noisy, np.repeat(np.arange(orders), 12), deviation
    )


def matrix(system, noise=0.0):
    size = np.prod(system.in_shape)
    columns = jax.vmap(system)(jnp.eye(size).reshape(size, *system.in_shape)).reshape(size, -1)
    error = np.random.default_rng(1).normal(size=columns.shape[::-1])
    return Matrix(np.asarray(columns).T + noise * error, system.in_shape, system.out_shape)


def deviations(fit, truth):
    return np.array([float((fit.values[n] - truth[n]) / fit.standard_errors[n]) for n in truth])


@pytest.mark.thorough
def test_a_screen_from_a_few_ghosts():
    """Within the errors that it claims; without noise, up to what the nodes of the band resolve."""
    fit = fit_screen(ghosts(0.05), camera(), plane())
    assert np.abs(deviations(fit, VALUES)).max() < 4
    assert fit.standard_errors["glass_thickness"] < 0.1
    exact = fit_screen(ghosts(1e-7), camera(), plane())
    for name, value in VALUES.items():
        assert float(exact.values[name]) == pytest.approx(value, abs=5e-4)


@pytest.mark.thorough
def test_the_smear_is_in_the_model():
    """Without it the glass is off by many standard errors, and χ² says so."""
    measured, names = ghosts(0.01), ("glass_thickness", "object_y")
    start = camera(**TRUE | {"glass": 5.0}), plane(centre=CENTRE)
    fit, without = (fit_screen(measured, *start, parameters=names, samples=s) for s in (4, None))
    truth = {name: VALUES[name] for name in names}
    assert fit.status == "ok" and np.abs(deviations(fit, truth)).max() < 4
    assert without.status == "poor_fit" and np.abs(deviations(without, truth)).max() > 10
    assert "does not explain the positions: χ² is" in without.reasons[0]


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("names", "reason"),
    [
        (("lens_distance", "object_distance"), "lens_distance and object_distance cannot"),
        (("slant", "shrinkage"), "slant and shrinkage cannot be told apart"),
        (("tilt", "film_thickness"), "do not see film_thickness at all"),
    ],
)
def test_undetermined_parameters_are_named(names, reason):
    fit = fit_screen(ghosts(0.05), camera(), plane(), parameters=names, samples=None)
    assert any(reason in line for line in fit.reasons)


@pytest.mark.thorough
def test_a_plate_that_leans():
    """Found from ghosts within the errors that are claimed; held upright it explains them badly."""
    measured, start = ghosts(0.05, leaning=(0.02, -0.01)), (camera(**TRUE), plane(centre=CENTRE))
    fit = fit_screen(measured, *start, parameters=("plate_x", "plate_y"))
    assert fit.status == "ok"
    assert np.abs(deviations(fit, {"plate_x": 0.02, "plate_y": -0.01})).max() < 4
    assert fit_screen(measured, *start, parameters=("object_x", "object_y")).status == "poor_fit"


@pytest.mark.thorough
def test_a_screen_from_its_matrix(optimised):
    """In any unit; noise of 0.001 of the largest entries, and the colours' smear."""
    few = {"pixels": (11, 15), "pitch": 140.8 * um}
    true = wg.system_operator(camera(**TRUE, **few), plane(centre=CENTRE), samples=8)
    measured = matrix(true, noise=0.001)
    scaled = Matrix(40 * measured.matrix, measured.in_shape, measured.out_shape)
    fit = fit_screen(scaled, camera(**few), plane())
    assert np.abs(deviations(fit, VALUES | {"gain": 40.0})).max() < 4
    found = matrix(fit.system(fit.plane)).matrix
    error = jnp.linalg.norm(found / 40 - matrix(true).matrix)
    assert error < 0.2 * jnp.linalg.norm(matrix(true).matrix)


@pytest.mark.thorough
def test_edges_of_holograms_that_cut_bands():
    """Weights of cut bands are in the model; without, values are 50 standard errors off."""
    bottom = wg.Rectangle((22.5, 0.0), (45.0, 50.0))  # the second ghost's light ends about it

    def cut(glass):
        given = camera(pixels=(7, 9), pitch=200.0 * um, glass=glass)
        return replace(given, screen=replace(given.screen, bottom=bottom))

    measured = matrix(wg.system_operator(cut(5.0), plane(), samples=4), noise=2e-4)
    names = ("glass_thickness", "object_y")
    fit = fit_screen(measured, cut(5.05), plane(), parameters=names, samples=4)
    assert np.abs(deviations(fit, {"glass_thickness": 5.0, "object_y": 27.0})).max() < 4


def reconstructed(operator, capture, deviation):
    recording = tc.Recording(capture[None, None], [operator], noise_variance=deviation**2)
    return np.squeeze(tc.reconstruct(recording, tc.AdmmTV(0.5, iterations=40)).image)


def test_what_cannot_be_fitted_is_refused():
    measured = Matrix(np.ones((660, 128)), CELLS, (22, 30))
    with pytest.raises(ValueError, match="the plane has 16 × 8, but the matrix was measured for 8"):
        fit_screen(measured, camera(), plane(shape=(16, 8)))
    with pytest.raises(ValueError, match="the sensor has 30 × 22, but the matrix was measured for"):
        fit_screen(measured, camera(pixels=(30, 22)), plane())

    few = GhostPositions(np.zeros((1, 2)), np.zeros((1, 2)), np.zeros(1, int), 0.1)
    with pytest.raises(ValueError, match="2 measured numbers for 6 unknowns: give more ghosts"):
        fit_screen(few, camera(), plane())
    late = GhostPositions(np.zeros((1, 2)), np.zeros((1, 2)), np.array([4]), 0.1)
    with pytest.raises(ValueError, match="a ghost of order 4, but orders = 4"):
        fit_screen(late, camera(), plane(), parameters=("slant",))
