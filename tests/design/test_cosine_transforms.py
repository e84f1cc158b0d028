"""Transforms by parity against the sums that they stand for."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from thincam_jax.design import wiener
from thincam_jax.design.wiener import both_signs, half_places

COMPILED = ("fold", "transform", "waves", "series")
fold, transform, waves, series = (jax.jit(getattr(wiener, n)) for n in COMPILED)
unfold = jax.jit(wiener.unfold, static_argnums=1)
SHAPES = [(6, 9), (7, 4), (1, 5)]


def image(shape):
    return jnp.asarray(np.random.default_rng(3).normal(size=shape))


def centred(count, pitch):
    return (np.arange(count) - (count - 1) / 2) * pitch


@pytest.mark.parametrize("shape", SHAPES)
def test_unfolding_the_mean_of_the_signs_gives_the_image(shape):
    given = image(shape)
    parts = np.array(fold(given)) / 4
    for axis, count in ((2, shape[0]), (3, shape[1])):
        if count % 2:  # the middle line counted once
            np.moveaxis(parts, axis, 0)[0] *= 2
    assert np.allclose(unfold(jnp.asarray(parts), shape), given, atol=1e-15)


@pytest.mark.parametrize("shape", SHAPES)
def test_transform_is_the_sum_with_complex_waves(shape):
    given, v, u = image(shape), np.array([0.0, 0.3, 1.7]), np.array([0.0, 0.21, 0.5, 0.77])
    y, x = (centred(count, 0.4) for count in shape)
    sides = [waves(half_places(n, 0.4), jnp.asarray(f)) for n, f in zip(shape, (v, u), strict=True)]
    parts = np.asarray(transform(fold(given), *sides))
    for sign in (1, -1):
        direct = np.exp(-2j * np.pi * sign * np.outer(v, y)) @ np.asarray(given)
        direct = direct @ np.exp(-2j * np.pi * np.outer(x, u))
        even, odd = parts[0], -1j * sign * parts[1]
        assert np.allclose(even[0] + odd[0] - 1j * (even[1] + odd[1]), direct, atol=1e-13)


@pytest.mark.parametrize("shape", SHAPES)
def test_series_over_the_frequencies_of_either_sign_inverts_the_transform(shape):
    """On a window as wide as the samples that the image has, it is the inverse DFT."""
    given, count, pitch = image(shape), 12, 0.4
    frequencies = jnp.asarray(np.fft.rfftfreq(count, pitch))
    sides = [waves(half_places(n, pitch), frequencies) for n in shape]
    weights = jnp.asarray(both_signs(count))
    spectrum = transform(fold(given), *sides) * weights[:, None] * weights
    back = unfold(series(spectrum, *sides), shape) / count**2
    assert np.allclose(back, given, atol=1e-14)
