"""Fringe scanning: orientation, scale, gain, and the frequencies that diffraction takes away."""

import itertools
import math

import jax.numpy as jnp
import numpy as np
import pytest
from reconstruction import rig

import thincam_jax as tc
from helpers import quick, relative_l2
from thincam_jax.units import nm, um


def scanning(cameras, **settings):
    """The filter; neither light nor model of the cameras matters to it."""
    where = {"object_distance": rig.OBJECT_DISTANCE, "field_shape": rig.FIELD} | settings
    return tc.FringeScanning().prepare(tc.Cameras(cameras, **where))


def test_the_scene_comes_back_upright_with_its_radiance():
    """The shadow of a zone plate of 50 rad, noise-free: the rest are the ripples of its edge."""
    cameras = rig.phases(beta=50.0)
    image = rig.picture()
    value = scanning(cameras)(rig.captures(cameras, image))
    assert rig.correlation(value.image, image) > 0.98
    for flipped in (image[::-1], image[:, ::-1], image[::-1, ::-1]):
        assert rig.correlation(value.image, flipped) < 0.5
    inside = np.s_[3:-3, 3:-3]  # of the scene's sharp border
    gain, offset = np.polyfit(image[inside].ravel(), np.asarray(value.image)[inside].ravel(), 1)
    assert abs(gain - 1) < 0.05 and abs(offset) < 0.05
    assert float(value.pitch) == pytest.approx(rig.OBJECT_PITCH)


@pytest.mark.parametrize("distance", quick([rig.DISTANCE, 1.3 * rig.DISTANCE], 1))
def test_a_point_is_found_where_it_is(distance):
    """Off the axis; at the larger distance the pixels are finer on the object."""
    image = np.zeros(rig.FIELD)
    image[9, 30] = 1.0
    cameras = rig.phases(beta=50.0, distance=distance)
    value = scanning(cameras)(rig.captures(cameras, image))
    assert float(value.pitch) == pytest.approx(25 * um * rig.OBJECT_DISTANCE / distance)
    expected = np.array([9 - 19.5, 30 - 23.0]) * rig.OBJECT_PITCH
    np.testing.assert_allclose(rig.centroid(value), expected, atol=0.15 * rig.OBJECT_PITCH)


def test_a_moved_mask_moves_nothing():
    """The mask's centre is part of the camera: the image stays in its place."""
    image = rig.picture()
    cameras = rig.phases(beta=50.0, centre=(0.11, -0.07), width=1.9)
    value = scanning(cameras)(rig.captures(cameras, image))
    plain = rig.phases(beta=50.0, width=1.9)
    expected = scanning(plain)(rig.captures(plain, image))
    assert relative_l2(value.image, expected.image) < 0.05


@pytest.mark.parametrize(("distance", "wavelength"), quick([(3.0, 2000 * nm), (2.0, 5000 * nm)], 1))
def test_diffraction_takes_the_zero_of_the_cosine_away(distance, wavelength):
    """Of a point, the spectrum has the sign of cos(πλdMρ²): its zero is at ρ = 1/√(2λdM).

    λ is long, so that the zero lies well inside the aperture's cut-off βR/π = 15.9 cycles/mm, and
    the mean over rings smooths the ripples of the aperture's edge.
    """
    pitch = 25 * um
    image = np.zeros((96, 85))
    image[47:49, 42] = 0.5
    cameras = rig.phases(beta=50.0, distance=distance)
    where = {"pitch": pitch * rig.OBJECT_DISTANCE / distance, "wavelength": wavelength}
    taken = rig.captures(cameras, image, model="separable", **where)
    value = np.asarray(scanning(cameras, field_shape=None)(taken).image)
    spectrum = np.fft.fft2(value)
    v, u = np.fft.fftfreq(96, pitch)[:, None], np.fft.fftfreq(85, pitch)[None, :]
    centre = np.exp(2j * np.pi * pitch * (v * 47.5 + u * 42.0))
    response = np.real(spectrum * centre) / np.cos(np.pi * v * pitch)  # of a source 2 pixels high
    rho = np.sqrt(v**2 + u**2)
    rings = np.arange(2.0, 14.0, 0.5)
    mean = np.array([response[(rho > r - 0.5) & (rho < r + 0.5)].mean() for r in rings])
    zero = 1 / math.sqrt(2 * wavelength * distance * (1 + distance / rig.OBJECT_DISTANCE))
    after = np.argmax(mean < 0)
    crossing = np.interp(0.0, -mean[after - 1 : after + 1], rings[after - 1 : after + 1])
    assert abs(crossing / zero - 1) < 0.06
    assert (mean[rings < zero - 1.0] > 0.15).all()
    assert (mean[(rings > zero + 1.0) & (rings < 1.5 * zero)] < -0.15).all()


def test_batches_equal_one_by_one_and_intensities_scale():
    cameras = rig.phases(beta=50.0)
    method = scanning(cameras)
    images = np.stack([rig.picture(), rig.picture()[::-1], rig.picture()[:, ::-1]])
    taken = rig.captures(cameras, images)
    whole = method(taken)
    assert whole.image.shape == (3, *rig.FIELD)
    assert relative_l2(whole.image[1], method(taken[:, 1]).image) < 1e-12
    assert relative_l2(method(1e-6 * taken[:, 2]).image, 1e-6 * whole.image[2]) < 1e-12


@pytest.mark.parametrize(
    ("second", "profile"), quick(itertools.product([1, 3], ["cosine", "intensity"]), 2)
)
def test_two_phases_in_quadrature(second, profile):
    """As good as four on a few bright things; not on a bright field, whose background is left."""
    cameras = rig.phases(beta=50.0, profile=profile)
    sparse = np.zeros(rig.FIELD)
    sparse[9:12, 30:33], sparse[20:28, 10], sparse[30, 20:26] = 1.0, 0.7, 0.8
    pair = [cameras[0], cameras[second]]

    def likeness(used, image):
        return rig.correlation(scanning(used)(rig.captures(used, image)).image, image)

    assert likeness(pair, sparse) > likeness(cameras, sparse) - 0.02 > 0.85
    assert likeness(pair, rig.picture()) < 0.7


def test_what_is_refused():
    cameras = rig.phases()
    with pytest.raises(ValueError, match=r"phases are .* give 0, π/2, π, 3π/2, or 0 and one of"):
        scanning([cameras[0], cameras[2]])
    with pytest.raises(ValueError, match=r"takes four cameras .* got 3"):
        scanning(cameras[:3])
    other = tc.Sensor(rig.SENSOR.shape, 24 * um)
    changes = ({"distance": 3.1}, {"beta": 31.0}, {"sensor": other}, {"width": 1.9})
    for change in changes:
        with pytest.raises(ValueError, match="differ in"):
            scanning([*cameras[:3], rig.camera(1.5 * math.pi, **change)])
    method = scanning(cameras)
    for shape in ((4, 85, 96), (3, 96, 85)):
        with pytest.raises(ValueError, match=r"captures have shape .*\(4, …, 96, 85\)"):
            method(jnp.ones(shape))
