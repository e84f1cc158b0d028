"""Proximal maps of regularisers, and orthonormal wavelets."""

import functools
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from helpers import quick
from thincam_jax.reconstruction.regularisers import (
    FILTERS,
    Cosines,
    Sparsity,
    Wavelet,
    prox,
    zero_dual,
)
from thincam_jax.reconstruction.total_variation import TotalVariation

RNG = np.random.default_rng(4)
REGULARISERS = [
    TotalVariation(),
    TotalVariation("anisotropic", depth_weight=0.7),
    TotalVariation(coupling="opponent", depth_weight=0.3),
    Sparsity(Wavelet("daubechies4", 2)),
    Sparsity(Cosines()),
]


@functools.partial(jax.jit, static_argnames=("nonnegative", "iterations"))
def denoise(image, step, regulariser, *, nonnegative=False, iterations=100):
    """The x that minimises ½‖x − image‖² + step·R(x), from a dual of zero."""
    dual, step = zero_dual(regulariser, image), jnp.asarray(step, image.dtype)
    options = {"nonnegative": nonnegative, "iterations": iterations}
    return prox(regulariser, image, step, dual, **options)[0]


@functools.partial(jax.jit, static_argnames="nonnegative")
def mapped(regulariser, v, step, nonnegative):
    dual = zero_dual(regulariser, v)
    return prox(regulariser, v, step, dual, nonnegative=nonnegative, iterations=3000)[0]


value = jax.jit(lambda regulariser, f: regulariser(f))


def image(shape=(3, 2, 7, 10)):
    return jnp.asarray(RNG.normal(0.2, 1.0, shape))


@pytest.mark.parametrize("regulariser", quick(REGULARISERS, 2), ids=lambda r: type(r).__name__)
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


@pytest.mark.parametrize(
    ("regulariser", "nonnegative"), quick(itertools.product(REGULARISERS, [False, True]), 4, 7)
)
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


def test_tv_of_a_line_of_two_pixels_in_closed_form():
    """½|x − v|² + s|x₁ − x₀|: both move by s towards their mean, which they do not cross."""
    v = jnp.array([1.0, 4.0]).reshape(1, 1, 1, 2)
    found = [denoise(v, s, TotalVariation(), iterations=300).ravel() for s in (0.5, 5.0)]
    np.testing.assert_allclose(found, [[1.5, 3.5], [2.5, 2.5]], atol=1e-9)
    signed = denoise(v - 3, 0.5, TotalVariation(), nonnegative=True, iterations=300).ravel()
    np.testing.assert_allclose(signed, [0.0, 0.5], atol=1e-9)


SIZES = [(1, 1), (2, 7), (13, 16)]


def matrix(basis, shape):
    """The transform, dense: (coefficient, pixel)."""
    pixels = jnp.eye(shape[0] * shape[1]).reshape(-1, *shape)
    return np.asarray(jax.jit(type(basis).analyse)(basis, pixels)).reshape(len(pixels), -1).T


BASES = [Wavelet("haar", 2), Wavelet("daubechies4", 3), Wavelet("daubechies8", 2), Cosines()]


@pytest.mark.parametrize(("shape", "basis"), quick(itertools.product(SIZES, BASES), 7, 9))
def test_it_is_orthonormal_and_synthesis_undoes_it(basis, shape):
    dense = matrix(basis, shape)
    np.testing.assert_allclose(dense @ dense.T, np.eye(len(dense)), atol=1e-12)
    image = jnp.asarray(np.random.default_rng(1).normal(size=(2, *shape)))
    there = jax.jit(type(basis).analyse)(basis, image)
    back = jax.jit(type(basis).synthesise)(basis, there)
    np.testing.assert_allclose(back, image, atol=1e-12)


@pytest.mark.parametrize("family", FILTERS)
def test_details_of_a_polynomial_vanish_away_from_the_border(family):
    """A filter of 2m numbers has m vanishing moments: it sees no polynomial below degree m."""
    taps = len(FILTERS[family])
    x = np.arange(64.0)
    line = jnp.asarray((x / 64) ** (taps // 2 - 1))[None]
    details = Wavelet(family, 1).analyse(line)[0, 32:]
    np.testing.assert_allclose(details[: 32 - taps], 0, atol=1e-12)
    steeper = jnp.asarray((x / 64) ** (taps // 2))[None]
    assert float(jnp.abs(Wavelet(family, 1).analyse(steeper)[0, 32 : 64 - taps]).max()) > 1e-9


@pytest.mark.thorough
def test_the_sparsity_of_an_even_image_is_nothing_and_of_a_pixel_is_known():
    even = jnp.full((1, 1, 8, 16), 3.0)
    pixel = jnp.zeros((1, 1, 4, 4)).at[0, 0, 1, 2].set(1.0)
    for basis in (Wavelet("haar", 2), Cosines()):
        assert float(Sparsity(basis)(even)) < 1e-12
    # Haar, two levels: 3 details of 1/2, 3 of 1/4.
    np.testing.assert_allclose(Sparsity(Wavelet("haar", 2))(pixel), 2.25, atol=1e-12)


def test_float32_stays_float32_and_gradients_are_the_transpose():
    wavelet = Wavelet(levels=2)
    image = jnp.asarray(np.random.default_rng(2).normal(size=(11, 14)), jnp.float32)
    analyse, synthesise = jax.jit(wavelet.analyse), jax.jit(wavelet.synthesise)
    assert analyse(image).dtype == jnp.float32
    assert jax.jit(Cosines().analyse)(image).dtype == jnp.float32
    _, pull = jax.vjp(analyse, image)
    np.testing.assert_allclose(pull(image)[0], synthesise(image), atol=1e-5)
