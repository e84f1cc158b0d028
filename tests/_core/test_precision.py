"""Computing in another precision than the camera's own, whatever JAX is set to."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import thincam_jax as tc
from helpers import point_psf, quick, relative_l2
from thincam_jax._core.precision import allow, cast, phasor

SHAPE = (48, 80)
CONDITIONS = {"wavelength": 500e-6, "object_distance": 250.0}
MODELS = ("geometric", "paraxial", "closed_form", "separable", "angular_spectrum")


def camera_of(width=5.632, pitch=5.5e-3):
    mask = tc.FresnelZoneAperture(25.0, 0.3, width=width)
    return tc.LenslessCamera(mask, tc.Sensor(SHAPE, pitch), 6.5)


def single_camera(**arguments):
    """A camera whose numbers are float32, and the same numbers in float64."""
    single = cast(camera_of(**arguments), "float32")
    return single, cast(single, "float64")


def conditions(precision):
    """The wavelength and distance that float32 knows, in that precision."""
    return {k: jnp.asarray(np.float32(v), precision) for k, v in CONDITIONS.items()}


@pytest.mark.parametrize("average", [False, pytest.param(True, marks=pytest.mark.thorough)])
@pytest.mark.parametrize("model", quick(MODELS, 3))
def test_double_precision_without_the_switch(model, average):
    """The float64 result, rounded once: bit by bit, while JAX knows float32 only."""
    small = {"width": 0.5, "pitch": 0.01} if model == "angular_spectrum" else {}
    single, double = single_camera(**small)
    method = tc.PsfMethod(model, pixel_integration=average)
    expected = np.asarray(tc.psf(double, **conditions("float64"), model=method))
    with jax.enable_x64(False):
        given = conditions("float32")
        value = tc.psf(single, model=replace(method, precision="float64"), **given)
        own = tc.psf(single, model=method, **given)
        assert not jax.config.read("jax_enable_x64")
        assert jnp.ones(1).dtype == jnp.float32
    assert expected.dtype == np.float64
    assert value.dtype == own.dtype == jnp.float32
    np.testing.assert_array_max_ulp(np.asarray(value), expected.astype(np.float32), maxulp=1)
    assert relative_l2(np.asarray(own, float), expected) > 3 * relative_l2(
        np.asarray(value, float), expected
    )


@pytest.mark.parametrize("model", quick(MODELS[:-1], 0, 3))
def test_single_precision_of_a_double_camera(model):
    """Comes back in float64, with the error of float32: neither none, nor more than a few 1e-5."""
    expected = point_psf(camera_of(), model=model, **CONDITIONS)
    value = point_psf(camera_of(), model=tc.PsfMethod(model, "float32"), **CONDITIONS)
    assert value.dtype == expected.dtype == jnp.float64
    assert 1e-8 < relative_l2(value, expected) < 3e-5
    same = point_psf(camera_of(), model=tc.PsfMethod(model, "float64"), **CONDITIONS)
    np.testing.assert_array_equal(same, expected)


def total(single, precision):
    """The PSF's sum as a function of the camera's distance."""

    def of(distance):
        camera = tc.LenslessCamera(single.mask, single.sensor, distance)
        method = tc.PsfMethod(precision=precision)
        return jnp.sum(point_psf(camera, model=method, **conditions("float32")) ** 2)

    return of


@pytest.mark.parametrize("transform", [jax.jit, jax.grad])
def test_traced_numbers_need_the_switch(transform):
    """JAX cannot be switched over in the middle of a trace: one line that says what to do."""
    single, _ = single_camera()
    with jax.enable_x64(False), pytest.raises(ValueError, match="jax_enable_x64") as error:
        transform(total(single, "float64"))(jnp.float32(6.5))
    assert "\n" not in str(error.value)


@pytest.mark.thorough
@pytest.mark.parametrize("transform", [jax.jit, jax.grad])
def test_traced_numbers_with_the_switch(transform):
    """In float64 inside, in float32 outside; closer to the float64 result than float32 is."""
    single, double = single_camera()
    given = conditions("float64")

    def exact(distance):
        camera = tc.LenslessCamera(double.mask, double.sensor, distance)
        return jnp.sum(point_psf(camera, **given) ** 2)

    expected = float(transform(exact)(jnp.asarray(6.5)))
    value = transform(total(single, "float64"))(jnp.float32(6.5))
    own = transform(total(single, "float32"))(jnp.float32(6.5))
    assert value.dtype == own.dtype == jnp.float32
    errors = [abs(float(v) / expected - 1) for v in (value, own)]
    assert errors[0] < 1e-6
    assert errors[0] <= errors[1]


def test_the_switch_is_put_back_after_an_error():
    with jax.enable_x64(False):
        with pytest.raises(RuntimeError), allow("float64"):
            assert jnp.ones(1).dtype == jnp.float64
            raise RuntimeError
        assert jnp.ones(1).dtype == jnp.float32


@pytest.mark.parametrize(("dtype", "largest"), [("float32", 1e5), ("float64", 1e6)])
def test_phasor_has_all_digits_of_its_phase(dtype, largest):
    """Against NumPy, with multiples of π/4 among the phases; and its slope j e^{jφ}."""
    spread = np.random.default_rng(0).uniform(-1, 1, 20_000)
    phases = np.concatenate([spread, 10 * spread, largest * spread, np.pi / 4 * np.arange(-40, 41)])
    phases = phases.astype(dtype)
    expected = np.exp(1j * phases.astype("float64"))
    ones = jnp.ones(phases.shape, dtype)
    value, slope = map(np.asarray, jax.jvp(phasor, (jnp.asarray(phases),), (ones,)))
    # A thousandth of what the last digit of the phase itself stands for.
    allowed = np.finfo(dtype).eps * (2 + 1e-3 * np.abs(phases))
    assert np.all(np.abs(value - expected) < allowed)
    assert np.all(np.abs(slope - 1j * expected) < allowed)
    # A phase without digits has a modulus of one still; none has none.
    lost = np.abs(phasor(jnp.asarray([1e30, -3e37, np.inf, np.nan], dtype)))
    assert np.all(np.abs(lost[:2] - 1) < 0.01) and np.all(np.isnan(lost[2:]))


def test_cast_changes_floating_numbers_only():
    tree = {"a": np.ones(2), "b": jnp.ones(2, complex), "n": np.arange(3), "f": 0.1, "s": "x"}
    found = cast(tree, "float32")
    assert found["a"].dtype == found["f"].dtype == np.float32
    assert found["b"].dtype == np.complex64
    assert found["n"].dtype == np.arange(3).dtype and found["s"] == "x"
    assert cast({"t": True, "n": 3, "none": None}, "float32") == {"t": True, "n": 3, "none": None}
