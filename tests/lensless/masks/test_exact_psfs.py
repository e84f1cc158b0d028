"""The PSFs of all masks of few terms: exact, differentiable, and right at the extremes."""

import functools
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from lensless.masks import families
from lensless.masks.families import DISTANCE, PITCH, SHAPE, WAVELENGTH

import thincam_jax as tc
from helpers import finite_difference, quick, relative_l2, value_and_slope

INF = math.inf
NAMES = tuple(families.masks())
SENSOR = tc.Sensor(SHAPE, PITCH)
SHADOWED = [name for name in NAMES if name != "lenslets"]


def every_family(first):
    """One of them always, the others thoroughly."""
    rest = (pytest.param(n, marks=pytest.mark.thorough) for n in NAMES if n != first)
    return pytest.mark.parametrize("name", [first, *rest])


@functools.partial(jax.jit, static_argnames=("model", "average"))
def evaluate(mask, sensor, distance, wavelength, t, model="separable", average=False):
    camera = tc.LenslessCamera(mask, sensor, distance)
    return tc.psf(
        camera, wavelength=wavelength, object_distance=t, model=model, pixel_integration=average
    )


def psf_of(mask, t=INF, **options):
    numbers = options.pop("distance", DISTANCE), options.pop("wavelength", WAVELENGTH), t
    sensor = options.pop("sensor", SENSOR)
    return np.asarray(evaluate(mask, sensor, *(jnp.asarray(n) for n in numbers), **options))


@pytest.mark.parametrize("name", quick(NAMES, 3))
def test_against_quadrature(name):
    """Within 1e-9 in double precision (measured 4e-14), 3e-5 in single (1e-6)."""
    mask = families.masks()[name]
    for t in (INF, 40.0):
        expected = families.psf(name, mask, t)
        assert relative_l2(psf_of(mask, t), expected) < 1e-9
    single = jax.tree.map(
        lambda leaf: leaf.astype(jnp.complex64 if jnp.iscomplexobj(leaf) else jnp.float32),
        (mask, SENSOR, *(jnp.asarray(n) for n in (DISTANCE, WAVELENGTH, 40.0))),
    )
    found = evaluate(*single)
    assert found.dtype == jnp.float32
    assert relative_l2(np.asarray(found, float), expected) < 3e-5


@every_family("xor")
def test_gradients(name):
    """In cell (or width), distance, wavelength and position: 1e-6 of finite differences."""
    weights = jnp.asarray(np.random.default_rng(2).uniform(size=SHAPE))

    def weighted(numbers):
        cell, distance, wavelength, *centre = numbers
        mask = families.masks()[name]
        size = next(size for size in ("cell", "pitch", "width") if hasattr(mask, size))
        scaled = getattr(mask, size) * cell
        mask = eqx_set(mask, **{size: scaled, "centre": jnp.stack(centre)})
        h = evaluate(mask, SENSOR, distance * DISTANCE, wavelength * WAVELENGTH, jnp.asarray(40.0))
        return jnp.sum(weights * h)

    start = jnp.asarray([1.0, 1.0, 1.0, *families.CENTRE])
    value, slope = value_and_slope(weighted)
    found = slope(start)
    for i in range(5):
        direction = jnp.zeros(5).at[i].set(1.0)
        expected = finite_difference(value, start, direction, 4e-5)
        np.testing.assert_allclose(found[i], expected, rtol=1e-6, atol=1e-7)


def eqx_set(mask, **numbers):
    """The mask with other numbers."""
    copy = object.__new__(type(mask))
    for field in mask.__dataclass_fields__:
        object.__setattr__(copy, field, numbers.get(field, getattr(mask, field)))
    return copy


@pytest.mark.parametrize("name", quick(SHADOWED, 0, 3))
def test_shadow(name):
    """`geometric` is |t|² of the cell, its pixel averages are exact, and it is the limit λ → 0."""
    mask = families.masks()[name]
    values = np.abs(families.cells(name, mask)) ** 2
    own = tc.Sensor(tuple(n + 2 for n in values.shape), families.CELL)
    still = families.masks(centre=(0.0, 0.0))[name]
    np.testing.assert_allclose(
        psf_of(still, sensor=own, model="geometric"), np.pad(values, 1), atol=1e-12
    )
    # A pixel that is no whole number of cells: against the points in it.
    fine = 25
    points = tc.Sensor((SHAPE[0] * fine, SHAPE[1] * fine), PITCH / fine)
    shadow = psf_of(mask, 40.0, model="geometric", sensor=points)
    average = shadow.reshape(SHAPE[0], fine, SHAPE[1], fine).mean(axis=(1, 3))
    found = psf_of(mask, 40.0, model="geometric", average=True)
    assert np.abs(found - average).max() < 0.09
    # Short waves: within the waves of the nearest edges.
    waves = psf_of(mask, 40.0, wavelength=1e-12)
    assert relative_l2(waves, psf_of(mask, 40.0, model="geometric")) < 5e-3


@every_family("xor")
def test_cells_smaller_than_a_pixel(name):
    """Pixel averages: against 33 × 33 points in each of the sensor's pixels, two cells wide."""
    mask, fine, pitch = families.masks()[name], 33, 2.1 * families.CELL
    inside = (np.arange(fine) - fine // 2) * pitch / fine
    points = [((np.arange(n) - (n - 1) / 2)[:, None] * pitch + inside).ravel() for n in (4, 5)]
    h = families.psf(name, mask, 40.0, points=points)
    average = h.reshape(4, fine, 5, fine).mean(axis=(1, 3))
    found = psf_of(mask, 40.0, sensor=tc.Sensor((4, 5), pitch), average=True)
    assert relative_l2(found, average) < 0.01
