"""The smear of a pixel's colours, against each wavelength traced surface by surface."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from waveguide.setting import camera, hologram
from waveguide.test_rays import snell, to_plane, turned

import thincam_jax as tc
from helpers import quick, relative_l2
from thincam_jax import waveguide as wg
from thincam_jax.imaging.operators.base import adjoint_error
from thincam_jax.units import nm, um
from thincam_jax.waveguide.camera import seen_size
from thincam_jax.waveguide.efficiency import diffraction_efficiency
from thincam_jax.waveguide.rays import pixel_centres
from thincam_jax.waveguide.smear import direct_rays, trace_band
from thincam_jax.waveguide.system import LitPlane, planes_operator, system_matrix

PIXELS = [(0.0, 0.0), (1.0536, 0.0), (-1.0536, -1.0536)]


def one_wavelength(pixel, order, wavelength, index, distance=550.0, width=5.0):
    """(y, x) on the object by wave vectors: the tangential one is kept, the medium sets its length.

    At each hologram K is taken from the wave vector and z follows from the wavenumber, for every
    wavelength, so that nothing is known of the Bragg condition.
    """
    fringes = 2 * np.pi * 1.5 / 532e-6 * np.array([-np.sin(np.radians(61.2))])
    wavenumber = 2 * np.pi / wavelength
    ray = -np.array([*pixel])[::-1] / np.hypot(np.hypot(*pixel), 6.0)

    def gone(tangential, medium, depth):
        length = medium * wavenumber
        return depth * tangential / np.sqrt(length**2 - tangential @ tangential)

    outside = ray * wavenumber
    guided = outside - np.array([0.0, *fringes])
    if not wavenumber < np.linalg.norm(guided) < index * wavenumber:
        return None
    place = gone(outside, 1.0, 10.0) + gone(outside, index, width)
    place = place + (2 * order + 1) * gone(guided, index, width)
    place = place + gone(outside, index, width) + gone(outside, 1.0, distance)
    return place[::-1]


efficiency = eqx.filter_jit(diffraction_efficiency)


def lights(across, wavelengths, orders):
    """η²(1−η)^i, unpolarised, (order, wavelength)."""
    directions = jnp.asarray(np.broadcast_to(across, (len(wavelengths), 2)))
    eta = [
        np.asarray(efficiency(hologram(), directions, jnp.asarray(wavelengths), kind))
        for kind in ("TE", "TM")
    ]
    powers = np.arange(orders)[:, None]
    return np.mean([e**2 * (1 - e) ** powers for e in eta], axis=0)


@pytest.mark.thorough
@pytest.mark.parametrize("number", range(3))
def test_parts_of_the_band(number):
    """Sums, means and deciles of 4001 wavelengths weighted by η²(1−η)^i."""
    sts, film, pixel = camera(), hologram(), PIXELS[number]
    samples = 10
    rays = trace_band(sts, jnp.asarray(pixel), 550.0, 3, samples)
    across = -np.array(pixel)[::-1] / np.hypot(np.hypot(*pixel), 6.0)
    centre = float(film.bragg_wavelength(jnp.asarray(across))[0])
    wavelengths = centre + np.linspace(-80, 80, 4001) * nm
    lights_there = lights(across, wavelengths, 3)
    for order in range(3):
        places = [one_wavelength(pixel, order, w, 1.5) for w in wavelengths]
        guided = np.array([f is not None for f in places])
        light = lights_there[order][guided]
        places = np.array([f for f in places if f is not None])
        np.testing.assert_allclose(rays.weight[order], light.sum() * 0.04 * nm, rtol=5e-3)
        mean = light @ places / light.sum()
        np.testing.assert_allclose(
            rays.points[order].mean(axis=0), mean, atol=0.03 * (2 * order + 1)
        )
        # Parts of equal light; the outermost two show where the band is cut, |ξ| = 10π.
        part = np.minimum(np.cumsum(light) / light.sum() * samples, samples - 1e-9).astype(int)
        means = np.stack([np.average(places[part == k], 0, light[part == k]) for k in range(10)])
        ours = np.asarray(rays.points[order])
        ours = ours[np.argsort(ours[:, 0])]
        np.testing.assert_allclose(ours[1:-1], means[1:-1], atol=0.03 * (2 * order + 1))


@pytest.mark.thorough
def test_holograms_and_critical_angle_cut_the_band():
    """At its edge a hologram keeps a part of a contact's band, and the later contacts their own."""
    pixel = jnp.zeros((1, 2))
    whole = trace_band(camera(), pixel, 550.0, 3, 4)
    edge = float(wg.trace(camera(), pixel, object_distance=550.0, orders=3).points[1, 0, 1])
    half = wg.Rectangle((edge / 2, 0.0), (edge, 10.0))
    cut = trace_band(camera(bottom=half), pixel, 550.0, 3, 4)
    np.testing.assert_allclose(cut.weight[0], whole.weight[0], rtol=1e-12)
    assert 0.3 < float(cut.weight[1, 0] / whole.weight[1, 0]) < 0.7
    assert float(cut.points[1, ..., 0].max()) < edge + 0.01
    assert not cut.weight[2].any()
    # −29.87° is the critical angle of the Bragg wavelength: half of the band is still guided there.
    steep = jnp.array([[6.0 * np.tan(np.radians(29.87)), 0.0]])
    part = trace_band(camera(), steep, 550.0, 3, 4)
    assert 0.3 < float(part.weight[0, 0]) / 4.9e-6 < 0.8


@pytest.mark.thorough
def test_a_capture_is_the_sum_over_the_band():
    """Against 101 wavelengths of a coarse sensor, cells averaged by many points."""
    sensor = tc.Sensor((5, 6), 360 * um)
    sts = wg.SeeThroughCamera(wg.Screen(hologram(), 5.0, 1.5), sensor, 6.0, 10.0)
    plane = wg.ObjectPlane((20, 16), 550.0, 160.0, (27.0, 0.0))
    image = np.random.default_rng(4).uniform(size=plane.shape)
    operator = wg.system_operator(sts, plane, orders=2, samples=20)
    assert adjoint_error(operator, jax.random.key(1)) < 1e-14
    film, expected, level = hologram(), np.zeros(sensor.shape), 0.0
    pixels = np.asarray(pixel_centres(sts))
    size = 0.36 * 560 / 6
    offsets = (np.arange(60) + 0.5) / 60 * size - size / 2
    for row, column in np.ndindex(*sensor.shape):
        pixel = pixels[row, column]
        across = jnp.asarray(-pixel[::-1] / np.hypot(np.hypot(*pixel), 6.0))
        centre = float(film.bragg_wavelength(across)[0])
        wavelengths = centre + np.linspace(-25, 25, 101) * nm
        eta = lights(across, wavelengths, 2)
        level += eta.sum()
        for order in range(2):
            for wavelength, light in zip(wavelengths, eta[order], strict=True):
                place = one_wavelength(pixel, order, wavelength, 1.5)
                if place is None or light < 1e-4:
                    continue
                columns = np.floor((place[1] + offsets) / 10 + 8).astype(int)
                rows = np.floor((place[0] - 27 + offsets) / 10 + 10).astype(int)
                columns = columns[(columns >= 0) & (columns < 16)]
                rows = rows[(rows >= 0) & (rows < 20)]
                expected[row, column] += light * image[np.ix_(rows, columns)].sum() / 3600
    expected /= level / 30
    np.testing.assert_allclose(operator(jnp.asarray(image)), expected, atol=6e-3)


@pytest.mark.parametrize("tilt", [(0.0, 0.0), (0.03, -0.05)])
def test_direct_light_is_refracted_at_two_planes(tilt):
    """Followed surface by surface; a cover stops what meets it on the front surface."""
    axes, pixel = turned(tilt), np.array([0.6, -0.9])
    corner, start = np.array([0.0, 0.0, 10.0]), np.zeros(3)
    ray = axes.T @ np.array([*-pixel[::-1], 6.0])
    place = to_plane(axes.T @ (start - corner), ray, 0.0)
    front = to_plane(place, snell(ray / np.linalg.norm(ray), 1.0, 1.5), 5.0)
    ended = to_plane(corner + axes @ front, axes @ ray, 10.0 + 5.0 + 550.0)
    made = dataclasses.replace(camera(), tilt=np.array(tilt), direct_band=200 * nm)
    rays = direct_rays(made, jnp.asarray(pixel[None]), 550.0)
    np.testing.assert_allclose(rays.points[0, 0, 0], ended[1::-1], atol=1e-10)
    assert rays.weight.tolist() == [[pytest.approx(200e-6)]]
    for height, left in ((abs(front[1]) * 2 + 0.01, 0.0), (abs(front[1]) * 2 - 0.01, 200e-6)):
        tape = wg.Rectangle((0.0, 0.0), (height, 20.0))
        covered = eqx.tree_at(lambda c: c.screen.cover, made, tape, is_leaf=lambda n: n is None)
        found = direct_rays(covered, jnp.asarray(pixel[None]), 550.0).weight
        assert found[0, 0] == pytest.approx(left)


@pytest.mark.parametrize("planned", quick([False, True], 0))
def test_direct_light_is_added_to_the_capture(planned):
    plane = wg.ObjectPlane((24, 28), distance=550.0, width=150.0, centre=(0.0, 0.0))
    sensor = tc.Sensor((20, 14), 120 * um)
    dark = dataclasses.replace(camera(), sensor=sensor)
    lit = dataclasses.replace(dark, direct_band=200 * nm)
    image = jnp.asarray(np.random.default_rng(3).uniform(size=plane.shape))
    with_light, without = (wg.system_operator(c, plane) for c in (lit, dark))
    level = np.mean(wg.trace(dark, pixel_centres(dark), object_distance=550.0).weight.sum(axis=0))
    rays = direct_rays(lit, pixel_centres(lit), 550.0)
    alone = system_matrix(rays, plane, float(seen_size(dark, plane)), float(level)) @ image.ravel()
    added = np.asarray(with_light(image) - without(image)).ravel()
    np.testing.assert_allclose(added, alone, rtol=1e-9)
    assert alone.max() > 10  # some 200 nm for some 5
    if planned:
        plan = wg.plan_screen(lit, LitPlane(plane, image), tolerance=0.02)
        found = plan.system()(image.astype(jnp.dtype(plan.precision)))
        every = planes_operator(lit, plane, (12, 8), plan.level)(image)
        assert relative_l2(np.asarray(found, float), np.asarray(every)) <= plan.predicted_error
