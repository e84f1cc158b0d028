"""The operator of products of rows and columns: against `capture`, its terms, its gradient."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import thincam_jax as tc
from helpers import finite_difference, relative_l2
from thincam_jax.lensless.masks import maximum_length_sequence
from thincam_jax.units import nm, um

IMAGE = np.random.default_rng(0).uniform(size=(11, 14))
LIGHT = tc.Spectrum(np.array([450.0, 620.0]) * nm, np.array([0.3, 0.7]))


def camera(beta=40.0, dtype=float):
    number = lambda x: np.asarray(x, dtype)  # noqa: E731
    mask = tc.FresnelZoneAperture(
        beta=jnp.asarray(beta, dtype), width=number(0.8), phase=number(0.4)
    )
    sensor = tc.Sensor(shape=(20, 26), pitch=number(40 * um))
    return tc.LenslessCamera(mask=mask, sensor=sensor, distance=number(3.0))


def scene(light=LIGHT):
    """Of pixels that are no whole number of the sensor's."""
    return tc.Scene(tc.ImagePlane(IMAGE, distance=200.0, width=49.3), light)


def test_it_is_what_the_camera_captures():
    """In two colours; with few terms it is off by what it says, for white scenes."""
    found = tc.separable_operator(camera(), scene(), tolerance=1e-9)
    expected = tc.capture(camera(), scene())
    assert relative_l2(found.operator(jnp.asarray(IMAGE)), expected) < 1e-8
    loose = tc.separable_operator(camera(), scene(), tolerance=0.2)
    assert 1 <= loose.operator.terms < found.operator.terms
    assert float(loose.error) <= 0.2 < float(loose.errors[loose.operator.terms - 2])
    white = jnp.asarray(np.random.default_rng(1).normal(size=(300, *IMAGE.shape)))
    seen = relative_l2(loose.operator(white), found.operator(white))
    assert seen == pytest.approx(float(loose.error), rel=0.05)


@pytest.mark.thorough
@pytest.mark.filterwarnings("ignore::thincam_jax.lensless.resolve.SamplingWarning")
def test_a_mask_of_many_terms_has_an_operator():
    """Cells at random: 150 terms, 22,500 products, of which the 11 rows of the kernel leave 11."""
    open_cells = np.random.default_rng(2).integers(0, 2, (200, 150)).astype(float)
    many = tc.LenslessCamera(tc.SampledMask(open_cells, 5 * um), tc.Sensor((6, 9), 40 * um), 3.0)
    plane = tc.Scene(tc.ImagePlane(IMAGE[:5, :7], distance=200.0, width=20.0), 550 * nm)
    found = tc.separable_operator(many, plane, tolerance=1e-9, pixel_integration=False)
    expected = tc.capture(many, plane, pixel_integration=False)
    assert found.operator.terms == 11
    assert relative_l2(found.operator(jnp.asarray(IMAGE[:5, :7])), expected) < 1e-12


@pytest.mark.thorough
def test_the_gradient_goes_through():
    """With all terms: their number cannot follow from traced numbers."""

    def light(beta):
        found = tc.separable_operator(camera(beta), scene(550 * nm), pixel_integration=False)
        return jnp.sum(found.operator(jnp.asarray(IMAGE)) ** 2)

    slope = jax.jit(jax.grad(light))(jnp.asarray(40.0))
    change = finite_difference(light, jnp.asarray(40.0), jnp.asarray(1.0), 1e-2)
    assert float(slope) == pytest.approx(float(change), rel=2e-3)


def test_what_has_no_terms_is_refused():
    relief = tc.PhaseMask(1e-3 * np.eye(4), 0.1, 1.5)
    other = tc.LenslessCamera(relief, camera().sensor, 3.0)
    with pytest.raises(TypeError, match="few separable terms.*for a PhaseMask use"):
        tc.separable_operator(other, scene())
    two = tc.Scene(scene().planes * 2, 550 * nm)
    with pytest.raises(ValueError, match="the scene has 2 planes; give one"):
        tc.separable_operator(camera(), two)
    with pytest.raises(TypeError, match="scene is an array .*; give Scene"):
        tc.separable_operator(camera(), IMAGE)


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("distance", "missed"), [(0.5, (11.5, 3.9, 0.5)), (2.0, (28.5, 19.8, 2.4))]
)
def test_how_many_products_a_coded_mask_needs(distance, missed):
    """The table of docs/measured/flatcam.md, per cent, by singular values of the centred PSF."""
    code = maximum_length_sequence(255)
    mask = tc.SeparableMask(code, code, cell=30 * um, combine="xor")
    flat = tc.LenslessCamera(mask, tc.Sensor((1020, 1020), 7.5 * um), distance)
    seen = sum(
        np.asarray(tc.psf(flat, wavelength=float(w), pixel_integration=True))
        for w in np.linspace(400, 700, 7) * nm
    )
    centred = seen - seen.mean(axis=0)
    centred = centred - centred.mean(axis=1, keepdims=True)
    squares = np.linalg.svd(centred, compute_uv=False) ** 2
    found = [100 * (squares[n:].sum() / squares.sum()) ** 0.5 for n in (1, 2, 3)]
    np.testing.assert_allclose(found, missed, rtol=0.03, atol=0.06)
