"""PSFs of points off the axis against the direct sum, and their limits, slopes and precision."""

import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import thincam_jax as tc
from helpers import count_traces, point_psf
from thincam_jax._core.grids import SparseGrid
from thincam_jax._core.precision import cast
from thincam_jax.lensless.masks import random_cells
from thincam_jax.lensless.method import AccuracyWarning
from thincam_jax.lensless.propagation.angular_spectrum import lit_mask
from thincam_jax.lensless.propagation.rayleigh_sommerfeld import rayleigh_sommerfeld_field
from thincam_jax.lensless.psf import psf_about_ray
from thincam_jax.units import deg, nm, um

SENSOR = tc.Sensor((9, 12), 150 * um)
DISTANCE, INF = 5.0, float("inf")


def plate(centre=(0.0, 0.0), **m):
    return tc.FresnelZoneAperture(60.0, 0.4, width=1.2, height=1.0, centre=centre, **m)


def mura(centre=(0.0, 0.0)):
    return tc.ModifiedUniformlyRedundantArray(11, cell=0.1, centre=centre)


def relief(centre=(0.0, 0.0)):
    height = np.random.default_rng(0).uniform(0, 1.0, (14, 17)) * um
    return tc.PhaseMask(height, 70 * um, 1.5, centre=centre, interpolation="bilinear")


def tangents(angle, azimuth):
    """(y, x) of a direction; exactly 0 where it lies along an axis."""
    along = np.array([np.sin(azimuth * deg), np.cos(azimuth * deg)])
    return np.where(np.abs(along) < 1e-12, 0.0, np.tan(angle * deg) * along)


def relative(found, expected):
    return np.linalg.norm(found - expected) / np.linalg.norm(expected)


def seen(mask, angle, azimuth, distance, **how):
    """The PSF of a point under an angle, on a sensor under the middle of its shadow."""
    tangent = tangents(angle, azimuth)
    camera = tc.LenslessCamera(mask(tuple(DISTANCE * tangent)), SENSOR, DISTANCE)
    at = tangent if distance == INF else (distance + DISTANCE) * tangent
    h = tc.psf(
        camera,
        wavelength=500 * nm,
        object_distance=distance,
        at=at,
        **{"pixel_integration": False, **how},
    )
    return np.asarray(h, float)


def direct(mask, angle, azimuth, distance, every=1):
    """The same by the sum over the mask, which lies on the axis, and where the ray meets.

    At every so-manieth pixel of each axis.
    """
    tangent = tangents(angle, azimuth)
    at = tangent if distance == INF else distance * tangent
    own = mask()
    path = tc.LenslessCamera(own, SENSOR, DISTANCE).path(500 * nm, distance, at)
    moved = DISTANCE * tangent / np.asarray(SENSOR.pitch)
    rows, columns = (
        np.arange(0, n, every) - (n - 1) / 2 - m for n, m in zip(SENSOR.shape, moved, strict=True)
    )
    points = SparseGrid(rows, columns, SENSOR.pitch)
    return np.abs(_field(own, path, points)) ** 2 * (1 + DISTANCE / distance) ** 2


@jax.jit
def _field(mask, path, points):
    plane = tc.Grid((900, 900), jnp.maximum(*mask.extent) / 900)
    ray = path.chief_ray(mask.centre)
    return rayleigh_sommerfeld_field(lit_mask(mask, plane, path), plane, points, path, ray)


# --- against the Rayleigh-Sommerfeld integral -----------------------------------------------------


@pytest.mark.parametrize(
    ("angle", "azimuth", "distance", "every"),
    [
        (20, 0, INF, 3),
        pytest.param(20, 45, INF, 1, marks=pytest.mark.thorough),
        pytest.param(30, 45, 60.0, 1, marks=pytest.mark.thorough),
    ],
)
def test_closed_form_against_the_direct_sum(angle, azimuth, distance, every):
    """2 to 5 %, as on the axis; the axis' PSF is 11 to 16 % off."""
    exact = direct(plate, angle, azimuth, distance, every)
    points = ((angle, azimuth), (0, 0))
    own, axis = (seen(plate, *point, distance)[::every, ::every] for point in points)
    error = relative(own, exact)
    assert error < 0.06
    assert error < relative(axis, exact) / 2


def about_ray(camera, angle, azimuth, model, samples=None, averaged=False, **method):
    at = tuple(tangents(angle, azimuth))
    own = tc.PsfMethod(model, None, averaged, oversampling=samples, **method)
    return np.asarray(psf_about_ray(camera, 500 * nm, INF, at, own), float)


@pytest.mark.full_size
@pytest.mark.parametrize(("angle", "most"), [(20, 0.01), (30, 0.02)])
def test_averages_of_the_full_size(angle, most):
    """5.632 mm, pixels of 11 µm; more samples change the angular spectrum by 0.15 %."""
    mask = tc.FresnelZoneAperture(25.0, 0.3, width=5.632)
    camera = cast(tc.LenslessCamera(mask, tc.Sensor((576, 576), 11 * um), 6.5), "float32")
    with jax.numpy_dtype_promotion("standard"):
        found = about_ray(camera, angle, 45, "separable", averaged=True)
        exact = about_ray(camera, angle, 45, "angular_spectrum", 5, averaged=True)
        axis = about_ray(camera, 0, 0, "separable", averaged=True)
    assert relative(found, exact) < most
    assert relative(axis, exact) > 20 * most


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("angle", "most", "axis"), [(20, 0.006, 1), (-20, 0.006, 0), (30, 0.008, 0)]
)
def test_cells_are_within_a_percent_along_an_axis(angle, most, axis):
    """With the waves of third order, which are 2 %, as near as on the axis: 0.4 % of samples."""
    tangent = tuple(np.tan(angle * deg) * np.eye(2)[axis])
    sensor, light = tc.Sensor((32, 48), 22 * um), {"wavelength": 500 * nm, "at": tangent}

    def camera(cast_to="float64"):
        centre = tuple(6.5 * t for t in tangent)
        mask = tc.ModifiedUniformlyRedundantArray(23, cell=62 * um, centre=centre)
        return cast(tc.LenslessCamera(mask, sensor, 6.5), cast_to)

    sampled = tc.PsfMethod("angular_spectrum", oversampling=17)
    exact = tc.psf(camera(), model=sampled, pixel_integration=True, **light)
    found = tc.psf(camera(), pixel_integration=True, **light)
    assert relative(found, exact) < most
    with jax.numpy_dtype_promotion("standard"):
        single = tc.psf(camera("float32"), pixel_integration=True, **light)
    assert single.dtype == jnp.float32 and relative(np.asarray(single, float), found) < 1e-4


@pytest.mark.parametrize(
    ("mask", "most"),
    [
        (tc.ModifiedUniformlyRedundantArray(11, cell=62 * um), 17),
        pytest.param(tc.RadialMask([1, 0, 1], 0.11), 17, marks=pytest.mark.thorough),
        # Of more terms than are squared one by one; no warning of the closed form's average.
        pytest.param(random_cells(0, 0.65, 5 * um), 35, marks=pytest.mark.thorough),
    ],
)
def test_edges_without_a_closed_form_are_sampled(mask, most):
    """Within about a percent of more samples; the axis' PSF is over 10 % off."""
    camera = tc.LenslessCamera(mask, tc.Sensor((12, 16), 22 * um), 6.5)

    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = about_ray(camera, 20, 30, "separable", averaged=True)
    exact = about_ray(camera, 20, 30, "angular_spectrum", most, averaged=True)
    assert relative(found, exact) < 0.012
    on_axis = tc.PsfMethod("angular_spectrum", pixel_integration=True, oversampling=7)
    assert relative(tc.psf(camera, wavelength=500 * nm, model=on_axis), exact) > 0.1


def test_the_detour_turns_waves_as_the_distance_does():
    """To third order, and what is left as on the axis; its slope against a difference."""
    mask = mura()
    path = tc.LenslessCamera(mask, SENSOR, DISTANCE).path(500 * nm, INF, (0.0, np.tan(20 * deg)))
    _, across = path.along_axes(mask.centre)
    u = jnp.linspace(-2.0, 2.0, 9)
    length, sine = DISTANCE / np.cos(20 * deg), -np.sin(20 * deg)
    wave = 2 * np.pi / (500 * nm)
    exact = wave * (np.sqrt(length**2 + 2 * length * sine * u + u**2) - length - sine * u)
    on_axis = wave * (np.hypot(length, u) - length) / (wave * u**2 / (2 * length) + 1e-300)
    found = across.fresnel_curvature * across.detour(u) ** 2
    np.testing.assert_allclose(found * jnp.where(u == 0, 1, on_axis), exact, rtol=1e-9, atol=1e-6)
    np.testing.assert_allclose(
        jax.vmap(jax.grad(across.detour))(u),
        (across.detour(u + 1e-5) - across.detour(u - 1e-5)) / 2e-5,
        rtol=1e-8,
    )
    assert path.detour(u) is u


@pytest.mark.thorough
@pytest.mark.parametrize("mask", [plate, mura, relief])
def test_angular_spectrum_along_the_ray(mask):
    """Samples of the hard edges differ; at most half as far again off the axis as on it."""
    errors = [
        relative(
            seen(mask, angle, 45, INF, model=tc.PsfMethod("angular_spectrum", oversampling=31)),
            direct(mask, angle, 45, INF),
        )
        for angle in (0, 25)
    ]
    assert errors[1] < 1.5 * errors[0]
    assert errors[0] < 0.08


# --- averages over pixels off both axes -----------------------------------------------------------


@pytest.mark.parametrize(
    ("pitch", "most"),
    [
        (11 * um, 1e-4),
        # Of up to 29 and 72 fringes a pixel.
        pytest.param(60 * um, 5e-3, marks=pytest.mark.thorough),
        pytest.param(150 * um, 1.5e-2, marks=pytest.mark.thorough),
    ],
)
def test_averages_are_means_over_points_of_a_pixel(pitch, most):
    """Of 80 × 80 in each."""
    tangent = tangents(30, 40)
    mask = plate(tuple(DISTANCE * tangent))
    sensor = tc.Sensor((3, 4), pitch)
    light = {"wavelength": 500 * nm, "at": tangent}
    found = tc.psf(tc.LenslessCamera(mask, sensor, DISTANCE), pixel_integration=True, **light)
    fine = tc.LenslessCamera(mask, tc.Sensor((240, 320), pitch / 80), DISTANCE)
    exact = np.asarray(point_psf(fine, **light)).reshape(3, 80, 4, 80).mean((1, 3))
    assert relative(np.asarray(found), exact) < most


# --- limits, slopes, precision --------------------------------------------------------------------


def camera_of(beta=25.0, distance=6.5, width=2.0, pitch=200 * um):
    """Of the shapes above, so that one program serves both."""
    mask = tc.FresnelZoneAperture(beta, 0.3, width=width, height=0.9 * width)
    return tc.LenslessCamera(mask, tc.Sensor(SENSOR.shape, pitch), distance)


def psf(at, beta=25.0, distance=6.5, wavelength=500 * nm, object_distance=100.0):
    camera = camera_of(beta, distance)
    return point_psf(camera, wavelength=wavelength, object_distance=object_distance, at=at)


anywhere = jax.jit(lambda at, distance: psf(at, object_distance=distance))


@pytest.mark.thorough
@pytest.mark.parametrize("distance", [INF, 100.0])
def test_on_the_axis_it_is_the_psf_of_the_axis(distance):
    expected = point_psf(camera_of(), wavelength=500 * nm, object_distance=distance)
    for at in ((0.0, 0.0), (0.0, 1e-9), (1e-9, 1e-9)):
        assert relative(anywhere(jnp.asarray(at), distance), expected) < 1e-6
    assert relative(psf((0.0, 0.0), object_distance=distance), expected) < 1e-12


@pytest.mark.thorough
def test_cells_are_continuous_at_the_axis_and_have_slopes():
    """Against a difference, of a point along the axis that is traced."""
    camera = tc.LenslessCamera(mura(), SENSOR, DISTANCE)
    weights = np.random.default_rng(0).normal(size=SENSOR.shape)

    @jax.jit
    def value(x):
        return jnp.sum(weights * point_psf(camera, wavelength=500 * nm, at=(0.0, x)))

    on_axis = float(jnp.sum(weights * point_psf(camera, wavelength=500 * nm)))
    assert float(value(1e-9)) == pytest.approx(on_axis, rel=1e-6)
    difference = (value(0.2 + 1e-6) - value(0.2 - 1e-6)) / 2e-6
    assert float(jax.grad(value)(0.2)) == pytest.approx(float(difference), rel=1e-5)


@pytest.mark.thorough
def test_along_an_axis_both_forms_agree():
    """That of products, and that of a point which may be anywhere."""
    for at in ((0.0, 20.0), (-30.0, 0.0)):
        assert relative(anywhere(jnp.asarray(at), 100.0), psf(at)) < 1e-12


def test_the_shadow_moves_against_the_point():
    """By −d/t of it: the middle of the light of a wide pinhole."""
    camera = tc.LenslessCamera(tc.Pinhole(0.5), tc.Sensor((60, 80), 40 * um), 6.5)
    at = np.array([10.0, -14.0])
    h = np.asarray(
        point_psf(camera, wavelength=500 * nm, object_distance=100.0, at=at, model="geometric")
    )
    y, x = np.asarray(camera.sensor.grid.y), np.asarray(camera.sensor.grid.x)
    middle = np.array([h.sum(1) @ y, h.sum(0) @ x]) / h.sum()
    np.testing.assert_allclose(middle, -6.5 / 100.0 * at, atol=0.02)


@pytest.mark.thorough
def test_slopes():
    """On the axis, too."""
    weights = np.random.default_rng(0).normal(size=SENSOR.shape)

    @jax.jit
    def value(numbers):
        at, rest = numbers[:2], numbers[2:]
        return jnp.sum(weights * psf(at, *rest))

    slope = jax.jit(jax.grad(value))
    for place in ((0.0, 0.0), (12.0, 21.0)):
        numbers = jnp.asarray([*place, 25.0, 6.5, 500 * nm, 100.0])
        for k, step in enumerate((1e-5, 1e-5, 1e-5, 1e-6, 1e-10, 1e-4)):
            moved = jnp.zeros(6).at[k].set(step)
            difference = (value(numbers + moved) - value(numbers - moved)) / (2 * step)
            np.testing.assert_allclose(slope(numbers)[k], difference, rtol=2e-4, atol=2e-6)


@pytest.mark.thorough
def test_batches_and_new_values_are_one_program():
    points = jnp.asarray([[12.0, 21.0], [0.0, -5.0], [3.0, 0.0]])
    counted = count_traces(psf)
    batch = jax.jit(jax.vmap(counted))
    found = batch(points)
    batch(points + 1.0)
    assert counted.traces == 1
    for h, at in zip(found, points, strict=True):
        np.testing.assert_allclose(h, psf(np.asarray(at)), atol=1e-10)


@pytest.mark.parametrize(
    "at", [pytest.param((0.0, 36.0), marks=pytest.mark.thorough), (25.0, 25.0)]
)
def test_single_precision(at):
    camera = camera_of(width=5.632, pitch=400 * um)
    exact, single = (
        point_psf(
            camera,
            wavelength=500 * nm,
            object_distance=100.0,
            at=at,
            model=tc.PsfMethod("separable", precision),
        )
        for precision in ("float64", "float32")
    )
    assert relative(np.asarray(single, float), exact) < 1e-4


# --- what is refused ------------------------------------------------------------------------------


@pytest.mark.parametrize("model", ["closed_form", "paraxial"])
def test_models_of_the_axis_say_so(model):
    with pytest.raises(
        ValueError, match=f"{model!r} is for points on the axis: leave `at` out, or"
    ):
        point_psf(camera_of(), wavelength=500 * nm, at=(0.0, 0.1), model=model)


def test_lenses_off_both_axes_name_the_sampled_model():
    camera = tc.LenslessCamera(tc.LensletArray(5.0, 0.4, (2, 3)), SENSOR, DISTANCE)
    with pytest.raises(TypeError, match=r"on one of its axes only; give at = \(y, 0\) or \(0, x\)"):
        point_psf(camera, wavelength=500 * nm, at=(0.1, 0.1))
    h = point_psf(camera, wavelength=500 * nm, at=(0.1, 0.1), model="angular_spectrum")
    assert np.all(np.isfinite(h))


def test_steep_light_is_warned_of():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        point_psf(camera_of(width=5.632), wavelength=500 * nm, at=(0.0, np.tan(30 * deg)))
    with pytest.warns(AccuracyWarning, match="at 60° waves of third order"):
        point_psf(camera_of(width=5.632), wavelength=500 * nm, at=(0.0, np.tan(60 * deg)))


def test_zones_that_focus_off_both_axes_are_sampled():
    """Order −1 of β = 62.83 rad/mm² focuses on a sensor at 100 mm; inside jit it is refused."""
    at, given = (0.02, 0.02), {"beta": 62.83, "distance": 100.0, "object_distance": INF}
    sampled = tc.PsfMethod("angular_spectrum", oversampling=61)
    exact = point_psf(camera_of(62.83, 100.0), wavelength=500 * nm, at=at, model=sampled)
    assert relative(psf(at, **given), exact) < 0.01
    with pytest.raises(Exception, match="an order focuses nearly on the sensor; use 'angular"):
        jax.jit(lambda y: psf((y, 0.02), **given))(0.02)
