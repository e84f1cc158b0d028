"""Phase masks: against closed forms of prisms, gratings, lenses and steps, and their refusals."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from lensless.propagation import reference
from scipy.special import j1

import thincam_jax as tc
from helpers import finite_difference, point_psf, relative_l2, value_and_slope
from thincam_jax.imaging.refractive_index import CauchyIndex, bk7
from thincam_jax.units import nm, um

WAVELENGTH = 500 * nm
INDEX = 1.5
TURN = WAVELENGTH / (INDEX - 1)  # mm of height
AS = "angular_spectrum"

sample = jax.jit(lambda mask, grid, wavelength=WAVELENGTH: mask.sample(grid, wavelength))


def centred(count, pitch):
    return reference.centred(count, pitch)


def camera(mask, shape=(48, 64), pitch=5 * um, distance=10.0):
    return tc.LenslessCamera(mask, tc.Sensor(shape, pitch), distance)


def psf(camera, model=AS, *, pixel_integration=False, object_distance=np.inf, **settings):
    return np.asarray(
        point_psf(
            camera,
            wavelength=settings.pop("wavelength", WAVELENGTH),
            object_distance=object_distance,
            model=tc.PsfMethod(model, pixel_integration=pixel_integration, **settings),
        )
    )


def test_transmittance_of_cells_and_between_them():
    """On its own grid both are A e^{jφ} at the centres; midway, cells average, heights are mean."""
    height = np.array([[0.0, 0.1, 0.3], [0.2, 0.45, 0.05]]) * TURN
    passed = np.array([[1.0, 0.2, 0.5], [0.0, 0.7, 1.0]])
    expected = passed * np.exp(2j * np.pi * height / TURN)
    for interpolation in ("cells", "bilinear"):
        mask = tc.PhaseMask(height, 0.1, INDEX, amplitude=passed, interpolation=interpolation)
        own = sample(mask, tc.Grid((2, 3), 0.1))
        np.testing.assert_allclose(own, expected, rtol=0, atol=1e-9)
        outside = np.asarray(sample(mask, tc.Grid((4, 5), 0.1)))
        np.testing.assert_allclose(outside, np.pad(expected, 1), rtol=0, atol=1e-9)
    grid = tc.Grid((2, 2), 0.1)  # half a cell to the side
    cells = sample(tc.PhaseMask(height, 0.1, INDEX), grid)
    whole = np.exp(2j * np.pi * height / TURN)
    np.testing.assert_allclose(cells, (whole[:, 1:] + whole[:, :-1]) / 2, rtol=0, atol=1e-9)
    smooth = sample(tc.PhaseMask(height, 0.1, INDEX, interpolation="bilinear"), grid)
    middle = np.exp(1j * np.pi * (height[:, 1:] + height[:, :-1]) / TURN)
    np.testing.assert_allclose(smooth, middle, rtol=0, atol=1e-9)


def test_the_rim_is_cut_by_area_and_the_centre_moves():
    mask = tc.PhaseMask(np.zeros((2, 3)), 0.1, INDEX, centre=(0.02, -0.05))
    smooth = tc.PhaseMask(
        np.zeros((2, 3)), 0.1, INDEX, centre=(0.02, -0.05), interpolation="bilinear"
    )
    grid = tc.Grid((9, 11), 0.04)
    light = np.asarray(sample(smooth, grid))
    np.testing.assert_allclose(light, sample(mask, grid), rtol=0, atol=1e-12)
    np.testing.assert_allclose(light.real.sum() * 0.04**2, 0.06, rtol=1e-12)
    np.testing.assert_allclose(
        [np.sum(light.real * grid.y[:, None]), np.sum(light.real * grid.x)],
        np.array([0.02, -0.05]) * light.real.sum(),
        rtol=0.02,  # of a sum over samples
    )


def lens(count, pitch, focal_length):
    y = centred(count[0], pitch)[:, None] ** 2 + centred(count[1], pitch) ** 2
    bulge = (np.sqrt(focal_length**2 + y) - focal_length) / (INDEX - 1)
    return bulge.max() - bulge


def test_a_lens_focuses_to_sinc_and_to_airy():
    """At its focus (ab/λf)² sinc²(bx/λf) sinc²(ay/λf), and the Airy pattern of a disc."""
    f, pitch = 10.0, 5 * um
    relief = lens((80, 120), pitch, f)
    y, x = centred(48, 3 * um)[:, None], centred(64, 3 * um)
    a, b = 80 * pitch, 120 * pitch
    square = tc.PhaseMask(relief, pitch, INDEX, interpolation="bilinear")
    h = psf(camera(square, pitch=3 * um, distance=f), oversampling=1)
    sinc = np.sinc(a * y / (WAVELENGTH * f)) * np.sinc(b * x / (WAVELENGTH * f))
    assert relative_l2(h, (a * b / (WAVELENGTH * f) * sinc) ** 2) < 5e-3
    radius = 0.19
    place = np.hypot(centred(80, pitch)[:, None], centred(120, pitch))
    disc = np.clip((radius - place) / pitch + 0.5, 0, 1)
    round_one = tc.PhaseMask(relief, pitch, INDEX, amplitude=disc, interpolation="bilinear")
    h = psf(camera(round_one, pitch=3 * um, distance=f), oversampling=1)
    v = 2 * np.pi * radius * np.hypot(y, x) / (WAVELENGTH * f)
    airy = np.pi * radius**2 / (WAVELENGTH * f) * 2 * j1(v) / v
    assert relative_l2(h, airy**2) < 2e-2


def test_a_phase_step_against_fresnel_integrals():
    """Half of the mask half a turn higher: two apertures by scipy, one with its sign turned."""
    height = np.zeros((60, 80))
    height[:, 40:] = TURN / 2
    mask = tc.PhaseMask(height, 5 * um, INDEX)
    h = psf(camera(mask, pitch=5 * um), oversampling=5)
    b = np.pi / (WAVELENGTH * 10.0)
    y, x = centred(48, 5 * um), centred(64, 5 * um)
    down = reference.chirp(0.0, b, y, -0.15, 0.15)
    across = reference.chirp(0.0, b, x, -0.2, 0.0) - reference.chirp(0.0, b, x, 0.0, 0.2)
    assert relative_l2(h, np.abs(np.outer(down, across) * b / np.pi) ** 2) < 3e-3


def test_both_sampled_models_agree_and_dispersion_is_the_materials():
    """n(λ)−1 over λ is all that the wavelength changes; the direct sum is the same field."""
    height = np.random.default_rng(3).uniform(0, 1e-3, (20, 24))
    mask = tc.PhaseMask(height, 4 * um, bk7())
    here = camera(mask, (16, 18), 4 * um, 1.0)
    fourier = psf(here, oversampling=3)
    assert relative_l2(fourier, psf(here, model="rayleigh_sommerfeld", oversampling=3)) < 0.02
    grid = tc.Grid((20, 24), 4 * um)
    n = 1.51509  # of N-BK7 at 632.8 nm
    red = sample(mask, grid, 632.8 * nm)
    np.testing.assert_allclose(red, np.exp(2j * np.pi * (n - 1) * height / 632.8e-6), atol=2e-4)


@pytest.mark.parametrize(
    ("distance", "pitch", "model", "oversampling"),
    [
        (0.2, 5 * um, AS, 5),
        pytest.param(10.0, 5 * um, AS, 1, marks=pytest.mark.thorough),
        (1e3, 5 * um, "rayleigh_sommerfeld", 1),
    ],
)
def test_one_cell_is_a_pinhole(distance, pitch, model, oversampling):
    """Of any height, from near, where it casts its shadow, up to a metre away."""
    mask = tc.PhaseMask([[0.3 * TURN]], 40 * um, INDEX)
    here = camera(mask, (12, 14), pitch, distance)
    exact = tc.LenslessCamera(tc.Pinhole(40 * um), here.sensor, distance)
    found = psf(here, model=model, oversampling=oversampling, mask_shape=(64, 64))
    assert relative_l2(found, np.asarray(point_psf(exact, wavelength=WAVELENGTH))) < 0.03


@pytest.mark.parametrize(
    "interpolation", ["bilinear", pytest.param("cells", marks=pytest.mark.thorough)]
)
def test_gradients(interpolation):
    """With respect to every height, the index, the pitch, the centre, λ, d and t."""
    height = jnp.asarray(np.random.default_rng(7).uniform(0, TURN / 4, (6, 8)))
    weights = jnp.asarray(np.random.default_rng(8).normal(size=(10, 12)))

    def weighted(numbers):
        height, index, pitch, y, x, wavelength, distance, away = numbers
        material = CauchyIndex(index, 3e-9)
        centre = jnp.stack([y, x])
        mask = tc.PhaseMask(height, pitch, material, centre=centre, interpolation=interpolation)
        where = tc.LenslessCamera(mask, tc.Sensor((10, 12), 5 * um), distance)
        light = {"wavelength": wavelength, "object_distance": away}
        method = tc.PsfMethod(AS, oversampling=3, mask_shape=(20, 22))
        return jnp.sum(weights * point_psf(where, model=method, **light))

    given = (1.49, 10.1 * um, 1.3 * um, 0.7 * um, WAVELENGTH, 1.5, 40.0)
    numbers = (height, *(jnp.asarray(n) for n in given))
    loss, slope_of = value_and_slope(weighted)
    slope = slope_of(numbers)
    for index, (number, found) in enumerate(zip(numbers, slope, strict=True)):
        along = jnp.ones_like(number) * (WAVELENGTH if index == 0 else number)
        along = along * weights[:6, :8] if index == 0 else along
        zero = tuple(jnp.zeros_like(n) for n in numbers)
        direction = (*zero[:index], along, *zero[index + 1 :])
        expected = finite_difference(loss, numbers, direction, 2e-4 if index in (0, 1) else 1e-5)
        np.testing.assert_allclose(jnp.sum(found * along), expected, rtol=1e-5, atol=1e-8)


MAP = np.zeros((4, 6))


@pytest.mark.parametrize("model", ["geometric", "paraxial", "closed_form", "separable"])
def test_models_without_phases_are_refused_in_one_line(model):
    here = camera(tc.PhaseMask(MAP, 2 * um, INDEX))
    with pytest.raises(TypeError, match="PhaseMask") as told:
        psf(here, model=model)
    assert "'angular_spectrum'" in str(told.value)
    assert "\n" not in str(told.value)


@pytest.mark.parametrize(("model", "enough"), [(AS, 3), ("rayleigh_sommerfeld", 7)])
def test_steep_slopes_are_refused_with_the_oversampling_that_holds_them(model, enough):
    """0.7 turns a cell of 5 µm: 140 cycles/mm, 1.4 π a sample; the sum's waves add to it."""
    ramp = np.tile(np.arange(6) * 0.7 * TURN, (4, 1))
    mask = tc.PhaseMask(ramp, 5 * um, INDEX, interpolation="bilinear")
    here = camera(mask, (40, 80), 5 * um, 1.0)
    told = rf"turns by up to .* π between samples 5 um apart .*: give oversampling = {enough} or"
    with pytest.raises(ValueError, match=told):
        psf(here, model=model, oversampling=1)
    if model == AS:
        with pytest.raises(ValueError, match=r"1.4 π between samples 5 um apart \(140 cycles/mm\)"):
            psf(here)
        held, finer = psf(here, oversampling=3), psf(here, oversampling=9)
        assert abs(np.argmax(held.sum(axis=0)) - np.argmax(finer.sum(axis=0))) <= 1


def test_light_outside_of_the_materials_band_is_refused():
    here = camera(tc.PhaseMask(MAP, 5 * um, bk7()))
    with pytest.raises(ValueError, match=r"wavelength = 0.00025 mm is outside of the material's"):
        psf(here, wavelength=250 * nm)
