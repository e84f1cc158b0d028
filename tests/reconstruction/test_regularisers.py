"""Proximal maps: against closed forms and against conditions of optimality."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from helpers import count_traces, quick
from thincam_jax.reconstruction.regularisers import Cosines, Sparsity, denoise, no_dual, prox
from thincam_jax.reconstruction.total_variation import TotalVariation
from thincam_jax.reconstruction.wavelet import Wavelet

RNG = np.random.default_rng(4)
REGULARISERS = [
    TotalVariation(),
    TotalVariation("anisotropic", depth_weight=0.7),
    TotalVariation(coupling="opponent", depth_weight=0.3),
    Sparsity(Wavelet("daubechies4", 2)),
    Sparsity(Cosines()),
]


@functools.partial(jax.jit, static_argnames="nonnegative")
def mapped(regulariser, v, step, nonnegative):
    dual = no_dual(regulariser, v)
    return prox(regulariser, v, step, dual, nonnegative=nonnegative, iterations=3000)[0]


value = jax.jit(lambda regulariser, f: regulariser(f))


def image(shape=(3, 2, 7, 10)):
    return jnp.asarray(RNG.normal(0.2, 1.0, shape))


@pytest.mark.parametrize("regulariser", quick(REGULARISERS, 2, 3), ids=lambda r: type(r).__name__)
def test_synthesis_is_the_transpose_and_the_norm_is_bounded(regulariser):
    f = image()
    parts = regulariser.analyse(f)
    other = tuple(jnp.asarray(RNG.normal(size=p.shape)) for p in parts)
    forward = sum(jnp.vdot(a, b) for a, b in zip(parts, other, strict=True))
    np.testing.assert_allclose(forward, jnp.vdot(f, regulariser.synthesise(other)), rtol=1e-12)
    again = jax.jit(lambda f: regulariser.synthesise(regulariser.analyse(f)))
    for _ in range(60):
        f = again(f)
        f = f / jnp.sqrt(jnp.sum(f**2))
    largest = sum(jnp.sum(p**2) for p in regulariser.analyse(f))
    assert 0.8 * regulariser.squared_norm(f.dtype) < largest
    assert largest <= regulariser.squared_norm(f.dtype) * (1 + 1e-12)


@pytest.mark.parametrize("nonnegative", [False, True])
@pytest.mark.parametrize("regulariser", quick(REGULARISERS, 2, 3), ids=lambda r: type(r).__name__)
def test_the_proximal_map_is_the_minimiser(regulariser, nonnegative):
    """x = prox(v) exactly if (v − x)/step is a subgradient of R + the sign: for every allowed z,

    step·R(z) ≥ step·R(x) + ⟨v − x, z − x⟩. Tried on z near x and far from it.
    """
    v, step = image(), 0.3
    x = mapped(regulariser, v, step, nonnegative)
    assert not nonnegative or float(x.min()) >= 0
    assert float(jnp.abs(x - v).max()) > 0.1
    worst = np.inf
    for size in (1e-3, 1e-2, 0.1, 1.0):
        for _ in range(10):
            z = x + size * jnp.asarray(RNG.normal(size=v.shape))
            z = jnp.maximum(z, 0) if nonnegative else z
            rise = step * (value(regulariser, z) - value(regulariser, x)) - jnp.vdot(v - x, z - x)
            worst = min(worst, float(rise) / float(np.linalg.norm(z - x)))
    assert worst > -1e-5
    # The condition is not empty: a point beside x breaks it, with z = x.
    beside = jnp.maximum(x + 0.05 * jnp.asarray(RNG.normal(size=v.shape)), 0)
    rise = step * (value(regulariser, x) - value(regulariser, beside)) - jnp.vdot(
        v - beside, x - beside
    )
    assert float(rise) < -1e-3 or not nonnegative


def test_cutting_off_the_negative_part_afterwards_is_no_proximal_map():
    """The two do not commute: the composition has a higher objective than the map of both."""
    regulariser, v, step = Sparsity(Wavelet("haar", 2)), image(), 0.5
    both = mapped(regulariser, v, step, True)
    cut = jnp.maximum(mapped(regulariser, v, step, False), 0)

    def energy(x):
        return float(step * regulariser(x) + jnp.sum((x - v) ** 2) / 2)

    assert energy(both) < energy(cut) - 0.1


def test_tv_of_a_line_of_two_pixels_in_closed_form():
    """½|x − v|² + s|x₁ − x₀|: both move by s towards their mean, which they do not cross."""
    v = jnp.array([1.0, 4.0]).reshape(1, 1, 1, 2)
    found = [denoise(v, s, TotalVariation(), iterations=300).ravel() for s in (0.5, 5.0)]
    np.testing.assert_allclose(found, [[1.5, 3.5], [2.5, 2.5]], atol=1e-9)
    signed = denoise(v - 3, 0.5, TotalVariation(), nonnegative=True, iterations=300).ravel()
    np.testing.assert_allclose(signed, [0.0, 0.5], atol=1e-9)


def test_tv_keeps_the_mean_of_every_channel_and_a_single_pixel():
    v = image((2, 3, 1, 7, 11))
    x = denoise(v, 0.4, TotalVariation())
    np.testing.assert_allclose(x.mean((-2, -1)), v.mean((-2, -1)), atol=1e-12)
    pixel = jnp.array([[[[-2.0]]]])
    np.testing.assert_allclose(denoise(pixel, 0.4, TotalVariation()), pixel)
    np.testing.assert_allclose(denoise(pixel, 0.4, TotalVariation(), nonnegative=True), 0)


def test_it_scales_with_the_image_in_float32_and_is_compiled_once():
    v = image().astype(jnp.float32)
    plain = denoise(v, 0.3, TotalVariation())
    for factor in (1e-8, 1e8):
        scaled = denoise(v * jnp.float32(factor), 0.3 * factor, TotalVariation())
        np.testing.assert_allclose(scaled / jnp.float32(factor), plain, atol=2e-5)

    counted = count_traces(lambda image, step: denoise(image, step, TotalVariation()))
    compiled = jax.jit(counted)
    compiled(v, jnp.float32(0.1)), compiled(v, jnp.float32(0.2))
    assert counted.traces == 1
