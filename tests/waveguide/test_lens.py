"""A lens of finite aperture: its blur against discs of geometry, and against denser points."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
from waveguide.setting import camera, hologram

import thincam_jax as tc
from helpers import quick, relative_l2
from thincam_jax import waveguide as wg
from thincam_jax.units import um
from thincam_jax.waveguide import lens
from thincam_jax.waveguide.colours import colour_system
from thincam_jax.waveguide.lens import aperture_points, blur_radius, lens_views
from thincam_jax.waveguide.system import LitPlane, planes_operator, system_operator

PLANE = wg.ObjectPlane((24, 28), distance=550.0, width=60.0, centre=(25.0, 0.0))


def behind_a_lens(aperture, focus_distance, shape=(20, 14)):
    """ERRATA's plate before large pixels."""
    sensor = tc.Sensor(shape, 70.4 * um)
    return dataclasses.replace(
        camera(), sensor=sensor, aperture=aperture, focus_distance=focus_distance
    )


@pytest.mark.parametrize("rings", [0, 1, 4])
def test_points_of_the_aperture_have_the_moments_of_a_disc(rings):
    points, shares = aperture_points(rings)
    assert shares.sum() == pytest.approx(1)
    np.testing.assert_allclose(shares @ points, 0, atol=1e-15)
    moments = np.einsum("p,pi,pj->ij", shares, points, points)
    np.testing.assert_allclose(moments, np.eye(2) / 4 * (rings > 0), atol=0.005)
    assert (np.hypot(*points.T) < 1).all()


@pytest.mark.parametrize(
    ("times", "error"), [(1, 0.03), pytest.param(3, 0.01, marks=pytest.mark.thorough)]
)
def test_a_point_is_blurred_to_the_disc_of_geometry(monkeypatch, times, error):
    """Through a plate so thin that nothing is displaced: of A|1 − s′/s| on the object's plane."""
    aperture, focus, along = 2.0, 130.0, 310.0 / 6.0
    shape, pixel, cell = (14, 18), 0.01 * along, 1.5
    made = wg.SeeThroughCamera(
        wg.Screen(hologram(), 1e-3, 1.5), tc.Sensor(shape, 10 * um), 6.0, 10.0,
        aperture=aperture, focus_distance=focus
    )  # fmt: skip
    cells = wg.ObjectPlane((9, 11), 300.0, 11 * cell, (0.0, 0.0))
    blur = blur_radius(made, cells, 1)
    radius = aperture / 2 * abs(1 - 310.0 / focus)
    assert blur == pytest.approx(radius / pixel, rel=2e-3)
    monkeypatch.setattr(lens, "blur_radius", lambda *_: times * blur)
    image = np.zeros(cells.shape)
    image[4, 5] = 1.0
    found = np.asarray(system_operator(made, cells, orders=1)(jnp.asarray(image)))
    # The same on the object's plane, by a fine grid over the disc, and overlaps in closed form.
    disc = np.stack(np.meshgrid(*2 * [np.linspace(-radius, radius, 401)]), axis=-1)
    disc = disc[np.hypot(disc[..., 0], disc[..., 1]) <= radius]
    shared = []
    for axis, n in enumerate(shape):
        low = ((n - 1) / 2 - np.arange(n)[:, None] - 0.5) * pixel
        ends = disc[:, axis] + cell / 2, low + pixel, disc[:, axis] - cell / 2, low
        shared.append(np.maximum(np.minimum(*ends[:2]) - np.maximum(*ends[2:]), 0) / pixel)
    expected = shared[0] @ shared[1].T / len(disc)
    scale = float(np.sum(found * expected) / np.sum(expected**2))
    assert scale == pytest.approx(1, abs=0.01)  # weights change a little over the field
    assert relative_l2(found, scale * expected) < error
    assert np.count_nonzero(expected > 0.1 * expected.max()) > 30  # a disc, not a point


@pytest.mark.parametrize(("aperture", "focus"), quick([(2.0, 150.0), (4.0, 200.0)], 1))
def test_rings_that_are_taken_do_for_random_light(monkeypatch, aperture, focus):
    light = jnp.asarray(np.random.default_rng(0).uniform(size=PLANE.shape))
    made = behind_a_lens(aperture, focus)
    found = np.asarray(system_operator(made, PLANE, orders=3)(light))
    blur = blur_radius(made, PLANE, 3)
    monkeypatch.setattr(lens, "blur_radius", lambda *_: 4 * blur)
    dense = np.asarray(system_operator(made, PLANE, orders=3)(light))
    assert relative_l2(found, dense) < 0.01
    sharp = np.asarray(system_operator(behind_a_lens(0.0, focus), PLANE, orders=3)(light))
    assert relative_l2(sharp, dense) > 0.05


def test_a_lens_in_focus_blurs_ghosts_alone():
    """The way of a ghost through the glass changes with the direction."""
    air = 10.0 + 550.0 + 2 * 5.0 / 1.5
    made = behind_a_lens(4.0, air)
    first, third = (blur_radius(made, PLANE, orders) for orders in (1, 3))
    assert third > 2 * first
    assert len(lens_views(behind_a_lens(0.01, air), [PLANE], 3)) == 1


def test_a_blur_of_more_than_a_sensor_resolves_is_refused():
    with pytest.raises(ValueError, match="give the lens a smaller aperture than 60 mm, or a focus"):
        lens_views(behind_a_lens(60.0, 30.0), [PLANE], 3)


@pytest.mark.parametrize(
    ("aperture", "defocus"), [(0.5, False), pytest.param(4.0, True, marks=pytest.mark.thorough)]
)
def test_a_plan_has_the_defocus_where_it_matters(aperture, defocus):
    light = LitPlane(PLANE, np.random.default_rng(1).uniform(size=PLANE.shape))
    made = behind_a_lens(aperture, 200.0, (6, 5))
    plan = wg.plan_screen(made, light, tolerance=0.03)
    assert plan.defocus is defocus
    assert f"lens        {'defocus' if defocus else 'a pinhole'}: " in str(plan)
    every = planes_operator(made, PLANE, (plan.all_orders, 16), plan.level)
    expected = every(jnp.asarray(light.image))
    found = plan.system()(jnp.asarray(light.image, jnp.dtype(plan.precision)))
    assert relative_l2(np.asarray(found, float), np.asarray(expected)) <= plan.predicted_error
    assert plan.predicted_error <= 0.03


def test_colours_are_blurred_alike():
    """A film that is one of three is blurred as the camera of its own colour."""
    made = behind_a_lens(4.0, 200.0, (6, 8))
    bands = [wg.ColourBand(532e-6, 1.0)]
    found = colour_system(wg.ColourCamera([made], bands), PLANE, orders=2, samples=8)
    expected = system_operator(made, PLANE, orders=2, samples=8)
    light = jnp.asarray(np.random.default_rng(2).uniform(size=PLANE.shape))
    assert relative_l2(np.asarray(found(light[None, None]))[0], np.asarray(expected(light))) < 0.01
