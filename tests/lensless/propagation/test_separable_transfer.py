"""The transfer function in closed form, against integrals that share nothing with it."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate

import thincam_jax as tc
from helpers import count_traces, finite_difference, quick, relative_l2, value_and_slope
from thincam_jax.lensless import LightPath
from thincam_jax.lensless.propagation.separable_transfer import overlaps, transfer_factors

INF = float("inf")
BETA, WIDTH, DISTANCE, WAVELENGTH = 90.0, 0.5, 20.0, 500e-6
CUT_OFF = WIDTH / (WAVELENGTH * DISTANCE)
V = np.array([0.0, 3.3, -17.0])
U = np.array([0.0, 0.01, -2.5, 11.0, 0.999 * CUT_OFF])


def mask_of(phase=0.7, beta=BETA, width=WIDTH, **kind):
    return tc.FresnelZoneAperture(beta, phase, width=width, **kind)


@jax.jit
def compiled_response(mask, path, v, u, pixel_pitch):
    return transfer_factors(mask, path, v, u, pixel_pitch=pixel_pitch).response()


def response(mask, path, v=V, u=U, pixel_pitch=None):
    return compiled_response(mask, path, jnp.asarray(v), jnp.asarray(u), pixel_pitch)


def direct(mask, path, v, u):
    """The double sum over orders, each overlap by adaptive quadrature: no pairs, no symmetry."""
    zones = mask.zone_orders()
    magnification = float(path.magnification)

    def overlap(k, m, f):
        s = WAVELENGTH * DISTANCE * f
        end = (WIDTH - abs(s)) / 2
        if end <= 0:
            return 0.0

        def phase(z):
            chirps = k * BETA * (z - s / 2) ** 2 - m * BETA * (z + s / 2) ** 2
            return chirps - 2 * np.pi * magnification * f * z

        parts = [
            scipy.integrate.quad(
                lambda z, part=part: part(phase(z)), -end, end, epsabs=1e-13, limit=400
            )
            for part in (np.cos, np.sin)
        ]
        return magnification * (parts[0][0] + 1j * parts[1][0])

    total = np.zeros((len(v), len(u)), complex)
    for k, c in zip(zones.orders, np.asarray(zones.coefficients), strict=True):
        for m, d in zip(zones.orders, np.asarray(zones.coefficients), strict=True):
            rows, columns = ([overlap(k, m, f) for f in axis] for axis in (v, u))
            total += c * np.conj(d) * np.outer(rows, columns)
    return total


@pytest.mark.parametrize("object_distance", [60.0, INF])
@pytest.mark.parametrize("kind", quick([{}, {"profile": "binary", "harmonics": 3}], 1))
def test_against_quadrature(object_distance, kind):
    """To 1e-11 of the light at zero frequency; the imaginary parts of the sum cancel."""
    mask, path = mask_of(**kind), LightPath(WAVELENGTH, DISTANCE, object_distance)
    expected = direct(mask, path, V, U)
    np.testing.assert_allclose(expected.imag, 0.0, atol=1e-12)
    value = response(mask, path)
    assert value.shape == (3, 5)
    np.testing.assert_allclose(value, expected.real, rtol=0, atol=1e-11 * expected.real.max())
    # What passes the mask arrives, magnified.
    x = (np.arange(2000) + 0.5) / 2000 * WIDTH - WIDTH / 2
    zones = mask.zone_orders()
    rows = np.exp(1j * np.outer(np.asarray(zones.orders) * BETA, x**2))
    field = (np.asarray(zones.coefficients)[:, None] * rows).T @ rows
    light = np.mean(np.abs(field) ** 2) * WIDTH**2 * float(path.magnification) ** 2
    np.testing.assert_allclose(value[0, 0], light, rtol=1e-5)


def test_single_precision():
    """Relative L2 at the thesis' size, up to 45 cycles/mm; measured 4e-6."""
    u = np.linspace(0, 45, 60)
    mask, path = mask_of(0.0, 25.0, 5.632), LightPath(500e-6, 6.5, 250.0)
    exact = response(mask, path, u, u[:50])
    single = jax.tree.map(lambda leaf: leaf.astype(jnp.float32), (mask, path))
    value = response(*single, u.astype(np.float32), u[:50].astype(np.float32))
    assert value.dtype == jnp.float32
    assert relative_l2(np.asarray(value, float), exact) < 2e-5


WEIGHTS = np.random.default_rng(2).normal(size=(3, 5))


def weighted(numbers):
    mask = mask_of(numbers["phase"], numbers["beta"], numbers["width"])
    path = LightPath(numbers["wavelength"], numbers["distance"], numbers["object_distance"])
    frequencies = numbers["scale"] * jnp.asarray([0.3, 4.0, -11.0, 17.0, 31.0])
    factors = transfer_factors(mask, path, frequencies[:3], frequencies, pixel_pitch=0.01)
    return jnp.sum(WEIGHTS * factors.response())


NUMBERS = {
    "beta": 90.0,
    "phase": 0.7,
    "width": 0.5,
    "wavelength": 500e-6,
    "distance": 20.0,
    "object_distance": 60.0,
    "scale": 1.0,
}


@pytest.fixture(scope="module")
def compiled():
    counted = count_traces(weighted)
    return counted, *value_and_slope(counted)


@pytest.mark.parametrize("name", NUMBERS)
def test_gradient(compiled, name):
    numbers = {k: jnp.asarray(v) for k, v in NUMBERS.items()}
    direction = {k: jnp.asarray(v if k == name else 0.0) for k, v in NUMBERS.items()}
    expected = finite_difference(compiled[1], numbers, direction, 1e-4)
    slope = compiled[2](numbers)[name] * NUMBERS[name]
    np.testing.assert_allclose(slope, expected, rtol=1e-7)


def test_compiled_once_and_mapped(compiled):
    counted, value, _ = compiled
    numbers = {k: jnp.asarray(v) for k, v in NUMBERS.items()}
    value(numbers)
    before = counted.traces
    several = [numbers | {"beta": jnp.asarray(b)} for b in (70.0, 90.0, 120.0)]
    one_by_one = [float(value(n)) for n in several]
    assert counted.traces == before
    stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *several)
    np.testing.assert_allclose(jax.jit(jax.vmap(weighted))(stacked), one_by_one, rtol=1e-12)


@pytest.mark.thorough
def test_second_derivative():
    """The slope of the chirp is written by hand; differentiated again it stays right."""
    numbers = {k: jnp.asarray(v) for k, v in NUMBERS.items()}

    def slope(beta):
        return jax.grad(lambda b: weighted(numbers | {"beta": b}))(beta)

    expected = finite_difference(jax.jit(slope), jnp.asarray(90.0), jnp.asarray(90.0), 1e-4)
    curvature = jax.jit(jax.grad(slope))(jnp.asarray(90.0))
    np.testing.assert_allclose(curvature * 90.0, expected, rtol=1e-6)


def test_one_order_is_the_aperture():
    """Pairs of an order with itself: the triangle of the open aperture's autocorrelation."""
    zones, path = mask_of().zone_orders(), LightPath(WAVELENGTH, DISTANCE)
    value = jax.jit(lambda u: overlaps(zones, path, u))(jnp.asarray([0.0]))
    np.testing.assert_allclose(value[0, 0], WIDTH, rtol=1e-14)
