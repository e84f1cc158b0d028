"""Errors from one-dimensional fields, against the images that they stand for."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate
import scipy.special
from lensless.accuracy import cameras

import thincam_jax as tc
from helpers import relative_l2
from thincam_jax.lensless import LightPath
from thincam_jax.lensless.accuracy import probe as probe_module
from thincam_jax.lensless.accuracy.probe import MaskProbe, fine_fields
from thincam_jax.lensless.method import PsfMethod
from thincam_jax.lensless.propagation.angular_spectrum import angular_spectrum
from thincam_jax.lensless.propagation.separable import separable

THESIS = {"beta": 25.0, "width": 5.632, "distance": 6.5, "wavelength": 500e-6}
CLOSED = ("geometric", "paraxial", "closed_form", "separable")


def case_of(shape, pitch, *, profile="cosine", average=False, centre=(0.0, 0.0), **changes):
    geometry = {**THESIS, "object_distance": 250.0, **changes}
    return cameras.make_case(shape, pitch, profile, 0.7, centre, geometry, average)


def probe_of(case):
    conditions = dict(case.conditions)
    average = conditions.pop("pixel_integration")
    camera = case.camera
    return MaskProbe(
        camera.mask, camera.sensor.grid, camera.path(**conditions), pixel_integration=average
    )


def value(case, model, **arguments):
    return np.asarray(tc.psf(case.camera, model=model, **case.conditions, **arguments), float)


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("pitch", "distance", "average"),
    [(0.02, 6.5, False), (0.005, 1.0, False), (0.009, 30.0, False), (0.005, 6.5, True)],
)
def test_large_images_are_estimated(pitch, distance, average):
    """600×300 pixels from 256 rows and columns: within 15 %."""
    case = case_of((600, 300), pitch, distance=distance, average=average)
    probe = probe_of(case)
    reference = value(case, "separable")
    for model in CLOSED[:-1]:
        true = relative_l2(value(case, model), reference)
        assert probe.difference(model, "separable") == pytest.approx(true, rel=0.15)


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("precision", "average", "oversampling", "height"),
    [("float32", False, 1, None), ("float64", False, 3, 0.4), ("float32", True, 3, None)],
)
def test_sampled_models(optimised, precision, average, oversampling, height):
    """The angular spectrum's error within 5 % from one-dimensional transforms; the direct sum's
    within 30 % from 14×14 of 48×80 pixels."""
    sides = {"width": 0.6, "height": height}
    case = case_of(
        (48, 80), 0.01, **sides, distance=20.0, beta=150.0, centre=(0.03, -0.02), average=average
    )
    probe = probe_of(case)
    exact = cameras.expected(case)
    for model, within in (("angular_spectrum", 0.05), ("rayleigh_sommerfeld", 0.3)):
        image = value(case, PsfMethod(model, precision, oversampling=oversampling))
        method = PsfMethod(
            model, precision, average, oversampling, (66 if height is None else 46, 64)
        )
        predicted = getattr(probe, model)(method)
        assert predicted == pytest.approx(relative_l2(image, exact), rel=within)


@pytest.mark.thorough
@pytest.mark.parametrize(("distance", "known"), [(2.0, 0.03), (1.0, 0.06)])
def test_paraxial_error_of_a_small_aperture(distance, known):
    """How far Fresnel is from exact diffraction where that can be sampled finely in two dimensions.

    Samples of 1 µm, so that the error of the sampling itself is a tenth of what is looked for. The
    estimate, from a line, is within a factor of two.
    """
    case = case_of((12, 15), 0.03, width=0.3, beta=200.0, distance=distance, object_distance=np.inf)
    path = LightPath(THESIS["wavelength"], distance)
    mask, grid = case.camera.mask, case.camera.sensor.grid
    method = PsfMethod("angular_spectrum", None, False, 31, (10, 11))
    exact = jax.jit(lambda: angular_spectrum(mask, grid, path, method))
    fresnel = np.asarray(
        jax.jit(lambda: separable(mask, grid, path, pixel_integration=False).image())()
    )
    true = relative_l2(np.asarray(exact()), fresnel)
    assert true == pytest.approx(known, rel=0.3)
    assert true / 2 < probe_of(case).paraxial_error() < 2 * true


def test_paraxial_error_averages_out_over_pixels():
    """It sits in the edges' fringes, of some micrometres."""
    points, average = (case_of((300, 200), 0.02, average=a) for a in (False, True))
    error = probe_of(points).paraxial_error()
    assert 1e-3 < error
    assert probe_of(average).paraxial_error() < error / 10


def slit_field(x, width, distance, wavelength, exact, samples=20001):
    """The field behind a slit lit by a plane wave by Simpson's rule, its piston dropped.

    Exact: the first Rayleigh-Sommerfeld integral in two dimensions, (jkd/2R)·H₁⁽¹⁾(kR).
    """
    wavenumber = 2 * np.pi / wavelength
    places = np.linspace(-width / 2, width / 2, samples)
    across = x[:, None] - places
    if exact:
        distances = np.sqrt(distance**2 + across**2)
        kernel = 1j * wavenumber * distance / (2 * distances)
        detour = across**2 / (distances + distance)
        kernel = kernel * scipy.special.hankel1e(1, wavenumber * distances)
        kernel = kernel * np.exp(1j * wavenumber * detour)
    else:
        kernel = np.exp(1j * wavenumber * across**2 / (2 * distance))
        kernel = kernel / np.sqrt(1j * wavelength * distance)
    return scipy.integrate.simpson(kernel, x=places, axis=-1)


@pytest.mark.parametrize("exact", [True, False])
def test_line_fields_of_a_slit(exact):
    """Order 0 is a bare slit: its exact field and Fresnel's, each to 5e-3 by independent sums.

    What is left are the edges' steepest waves, that come round from the window's other side. The
    two fields differ by more than four times that.
    """
    width, distance, wavelength, reach, count = 0.5, 0.5, 500e-6, 0.4, 2**16
    mask = tc.FresnelZoneAperture(25.0, width=width)
    given = (mask, LightPath(wavelength, distance), jnp.asarray(reach), jnp.asarray(exact))
    fields = fine_fields(*given, samples=count)
    orders = mask.zone_orders().orders
    place = np.arange(100, count // 2, 400)
    x = (place - (count / 2 - 1) / 2) * 4 * reach / count
    found = np.asarray(fields)[orders.index(0)][place]
    fine = slit_field(x, width, distance, wavelength, exact)
    other = slit_field(x, width, distance, wavelength, not exact)
    assert relative_l2(np.abs(found) ** 2, np.abs(fine) ** 2) < 5e-3
    assert relative_l2(np.abs(other) ** 2, np.abs(fine) ** 2) > 2e-2


def test_models_without_nodes_are_compiled_once(monkeypatch):
    """Whatever the fringes of a pixel: in `explore` each number of nodes made a program of each."""
    given = set()

    class Asked(Exception):
        pass

    def asked(mask, points, path, method):
        given.add((method.model, method.nodes))
        raise Asked

    monkeypatch.setattr(probe_module, "closed_terms", asked)
    for pitch in (0.02, 0.2):
        probe = probe_of(case_of((12, 15), pitch, average=True))
        for model in CLOSED:
            with pytest.raises(Asked):
                probe.closed(model, "float64")
    assert len(given) == 5  # "separable" by its numbers
    assert {nodes for model, nodes in given if model != "separable"} == {None}
