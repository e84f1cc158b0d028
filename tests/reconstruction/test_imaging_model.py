"""Captures on one scale (enlargement about the centre, sizes, parities); cameras over the field."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.signal

import thincam_jax as tc
from helpers import relative_l2
from thincam_jax.imaging.operators import Stacked
from thincam_jax.imaging.operators.base import adjoint_error
from thincam_jax.reconstruction.imaging_model import pedestal_of, register, registered_shape
from thincam_jax.units import nm, um


def blob(y, x):
    return np.exp(-((y - 4.2) ** 2) / 30 - (x + 6.1) ** 2 / 20) + 0.5 * np.exp(
        -((y + 7.3) ** 2) / 18 - (x - 3.4) ** 2 / 50
    )


def pixels(shape):
    y, x = (np.arange(n) - (n - 1) / 2 for n in shape)
    return y[:, None], x[None, :]


@pytest.mark.parametrize(
    ("shape", "ratio"), [((38, 47), 1.3), pytest.param((41, 36), 1.031, marks=pytest.mark.thorough)]
)
def test_the_picture_is_enlarged_about_its_centre(shape, ratio):
    """A smooth function of (y, x) becomes that of (y, x)/ratio; off the sensor's rim."""
    value = jax.jit(lambda picture: register(picture, ratio))(blob(*pixels(shape)))
    assert value.shape == registered_shape(shape, ratio)
    y, x = pixels(value.shape)
    expected = blob(y / ratio, x / ratio)
    inside = (abs(y) < ratio * (shape[0] / 2 - 4)) & (abs(x) < ratio * (shape[1] / 2 - 4))
    np.testing.assert_allclose(np.asarray(value)[inside], expected[inside], atol=2e-3)
    # the light grows with the area
    total = blob(*pixels(shape)).sum()
    np.testing.assert_allclose(value.sum(), ratio**2 * total, rtol=2e-3)
    # a flip or a shift by half a pixel would show
    assert np.abs(blob(y / ratio + 0.5, x / ratio)[inside] - expected[inside]).max() > 0.05


@pytest.mark.parametrize("ratio", [1.0, 1.001, 1.3, 2.0])
@pytest.mark.parametrize("shape", [(8, 11), (1, 96)])
def test_registered_shape_holds_the_enlarged_picture_and_its_parity(shape, ratio):
    for new, old in zip(registered_shape(shape, ratio), shape, strict=True):
        assert ratio * old - 1e-5 <= new < ratio * old + 2 and (new - old) % 2 == 0


def wide_recording(model, **changes):
    """A capture of ±16° in which every point has its own PSF and light, for some cameras."""
    mask = tc.FresnelZoneAperture(25.0, 0.3, width=1.4)
    camera = tc.LenslessCamera(mask, tc.Sensor((20, 26), 90 * um), 3.0)
    scene = np.zeros((18, 20))
    scene[3:7, 2:9], scene[11:13, 12:18] = 1.0, 0.5
    plane = tc.ImagePlane(scene, distance=250.0, width=20 * 90 * um / 3.0 * 250.0)
    exact = tc.PsfMethod("separable", field_tolerance=1e-2)
    capture = tc.capture(camera, tc.Scene(plane, 500 * nm), model=exact)
    light = {"wavelength": 500 * nm, "object_distance": 250.0, "field_shape": scene.shape}
    cameras = tc.Cameras([camera], model=model, **(light | changes))
    return tc.Recording([capture], cameras, noise_variance=1e-8), scene


@pytest.mark.thorough
def test_cameras_over_the_field_explain_their_capture():
    """Upright, with the object's pixels; the PSF and the light of the axis leave some percent."""
    unexplained = {}
    for name, tolerance in (("axis", None), ("light", 1.0), ("own", 1e-2)):
        model = tc.PsfMethod("separable", field_tolerance=tolerance)
        recording, scene = wide_recording(model)
        problem = recording.problem()
        (operator,), (capture,) = problem.operators, recording.captures
        turned = jnp.asarray(scene[::-1, ::-1]).reshape(operator.in_shape)
        unexplained[name] = relative_l2(np.ravel(operator(turned)), np.ravel(capture))
    assert unexplained["axis"] > 0.03 > 3e-3 > unexplained["light"] > unexplained["own"]
    assert unexplained["own"] < 1e-12
    found = tc.reconstruct(recording, tc.Fista(0.1, iterations=60))
    assert found.pitch == pytest.approx(90 * um / 3.0 * 250.0)
    assert np.corrcoef(np.ravel(found.image), np.ravel(scene))[0, 1] > 0.9  # not turned
    assert tc.choose_solver(recording)[0].name == "fista"


@pytest.mark.thorough
@pytest.mark.parametrize("solver", [tc.Wiener(), tc.FringeScanning()])
def test_filters_over_the_field_divide_by_the_light(solver):
    """A bright field of ±20° is even again; before, its corners fell to cos⁴θ."""
    masks = [tc.FresnelZoneAperture(60.0, n * np.pi / 2, width=1.2) for n in range(4)]
    cameras = [tc.LenslessCamera(mask, tc.Sensor((40, 48), 30 * um), 1.0) for mask in masks]
    shape = (20, 24)
    plane = tc.ImagePlane(np.ones(shape), distance=250.0, width=24 * 30 * um * 250.0)
    axis, captured = tc.PsfMethod(), tc.PsfMethod(field_tolerance=1.0)
    captures = [tc.capture(one, tc.Scene(plane, 500 * nm), model=captured) for one in cameras]
    light = {"wavelength": 500 * nm, "object_distance": 250.0, "field_shape": shape}
    dark, even = (
        tc.reconstruct(tc.Recording(captures, tc.Cameras(cameras, **light, model=m)), solver).image
        for m in (axis, captured)
    )
    down, across = ((np.arange(n) - (n - 1) / 2) * 30 * um for n in shape)
    fall = np.cos(np.arctan(np.hypot(down[:, None], across))) ** 4
    np.testing.assert_allclose(even * fall, dark, rtol=1e-6)
    slope, _ = np.polyfit(np.ravel(fall), np.ravel(even / np.mean(even)), 1)
    before, _ = np.polyfit(np.ravel(fall), np.ravel(dark / np.mean(dark)), 1)
    assert abs(slope) < 0.4 < before


@pytest.mark.parametrize("tolerance", [1.0, pytest.param(0.02, marks=pytest.mark.thorough)])
def test_over_the_field_at_several_distances(tolerance):
    """Each camera as alone, of a smooth scene on its own samples; the adjoint is the transpose."""
    mask, shape = tc.FresnelZoneAperture(25.0, width=1.0), (40, 48)
    cameras = [tc.LenslessCamera(mask, tc.Sensor(shape, 30 * um), d) for d in (6.5, 5.2)]
    model = tc.PsfMethod("separable", field_tolerance=tolerance)
    light = {"wavelength": 500 * nm, "object_distance": 250.0, "model": model}
    far, near = tc.Cameras(cameras, **light).field_operators(shape)
    own = tuple(near.operator.in_shape)
    assert own == (32, 40)
    (alone,) = tc.Cameras(cameras[1:], **light).field_operators(own)
    (farther,) = tc.Cameras(cameras[:1], **light).field_operators(shape)
    (y, x), (v, u) = pixels(shape), pixels(own)
    scene, expected = jnp.asarray(blob(y, x)), alone(jnp.asarray(blob(1.25 * v, 1.25 * u)))
    np.testing.assert_allclose(far(scene), farther(scene), rtol=1e-12)
    assert relative_l2(np.asarray(near(scene)), np.asarray(expected)) < 0.01
    assert adjoint_error(Stacked([far, near]), jax.random.key(0)) < 1e-12


CAMERA = tc.LenslessCamera(tc.FresnelZoneAperture(25.0, width=1.2), tc.Sensor((24, 33), 0.05), 5.0)
LIGHT = {"wavelength": 500 * nm, "object_distance": 250.0}


def test_the_field_in_mm():
    """Pixels are 2.5 mm apart on the object; a side alone leaves the sensor's for the other."""
    both = tc.Cameras([CAMERA], field_height=50.0, field_width=101.0, **LIGHT)
    assert both.pixels == (20, 41)
    assert tc.Recording([np.ones((24, 33))], both).problem().field_shape == (20, 41)
    assert tc.Cameras([CAMERA], field_width=50.0, **LIGHT).pixels == (24, 20)
    planes = tc.Cameras(
        [CAMERA], field_height=50.0, **(LIGHT | {"object_distance": [125.0, 250.0]})
    )
    assert planes.pixels == (40, 33)
    assert tc.Cameras([CAMERA], **LIGHT).pixels is None
    focused = tc.Recording([np.ones((24, 33))], both).focused(125.0)
    assert focused.imaging_model.pixels == (40, 81)


def test_the_field_that_the_sensor_sees():
    """A shadow of 1.2 (1 + 5/250) mm is 24.5 pixels wide; nearer cameras are enlarged."""
    assert tc.Cameras([CAMERA], **LIGHT).seen_field == (49, 58)
    near = tc.LenslessCamera(CAMERA.mask, CAMERA.sensor, 2.5)
    assert tc.Cameras([CAMERA, near], **LIGHT).seen_field == (97, 115)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"field_shape": (3, 4), "field_width": 9.0}, "are given; give pixels or mm"),
        ({"field_width": -1.0}, "field_width = -1.0 mm is not positive"),
    ],
)
def test_fields_that_are_refused(given, message):
    with pytest.raises(ValueError, match=message) as error:
        tc.Cameras([CAMERA], **given, **LIGHT)
    assert "\n" not in str(error.value)
    with pytest.raises(ValueError, match="no object_distance; give it in mm"):
        _ = tc.Cameras([CAMERA], field_width=9.0).pixels


def test_captures_are_never_made_smaller():
    with pytest.raises(ValueError, match=r"ratio = 0.8: captures are only enlarged"):
        register(jnp.ones((4, 5)), 0.8)


def test_a_field_in_mm_needs_known_numbers():
    def pixels_at(distance):
        return tc.Cameras(
            [CAMERA], wavelength=5e-4, object_distance=distance, field_width=9.0
        ).pixels

    with pytest.raises(TypeError, match="give field_shape, or known numbers"):
        jax.jit(pixels_at)(250.0)


def test_another_geometry_may_not_hold_the_whole_scene():
    """What `record` knows of its own field does not hold for one that a user gives."""
    mask = tc.FresnelZoneAperture(25.0, width=1.0)
    camera = tc.LenslessCamera(mask, tc.Sensor((24, 32), 50 * um), distance=5.0)
    plane = tc.ImagePlane(np.eye(2), distance=250.0, width=80.0)
    model = tc.record(camera, tc.Scene(plane, 500 * nm)).imaging_model
    assert model.whole_scene and model.replace(wavelength=600 * nm).whole_scene
    assert not model.replace(field_shape=(12, 16)).whole_scene
    assert not model.replace(object_distance=125.0).whole_scene
    assert model.replace(field_shape=(48, 64), whole_scene=True).whole_scene


def test_a_pedestal_of_a_psf_is_said():
    """Of 6 % of its mean light, with noise; what is advised is silent, and so is a PSF of light."""
    chance = np.random.default_rng(0)
    spots = np.zeros((40, 56))
    spots[8:30, 12:44] = chance.random((22, 32)) ** 4
    spots += 1e-4 * chance.standard_normal(spots.shape)
    y, x = pixels(spots.shape)
    wide = np.exp(-(y**2 + x**2) / 300)  # darkest in its corners, where it is not uniform
    for clean in (spots, chance.random(spots.shape), wide, spots[:30, :30]):
        assert not pedestal_of(tc.Psfs(clean[None]))
    level = 0.06 * spots.mean()
    capture = scipy.signal.fftconvolve(chance.random(spots.shape), spots, mode="same")
    model = tc.Psfs((spots + level)[None])
    result = tc.reconstruct(tc.Recording(capture[None], model), tc.Ridge(0.1))
    told = float(result.reason.partition("psfs - ")[2].partition(")")[0])
    assert told == pytest.approx(level, rel=0.05) and "6 % of its mean" in result.reason
    assert pedestal_of(tc.Psfs(np.stack([spots, spots + level]))) == pedestal_of(model)
    assert not pedestal_of(tc.Psfs((spots + level - told)[None]))
