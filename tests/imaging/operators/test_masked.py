"""Pixels that do not count, and gains."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from imaging.operators.dense import IN, OUT, dense, numbers

from thincam_jax.imaging.operators import Masked, Matrix, Separable, Stacked
from thincam_jax.imaging.operators.masked import Scaled

H = numbers((10, 12))
VALID = np.arange(10).reshape(OUT) % 3 > 0


def matrix():
    return Matrix(H, IN, OUT)


def stack():
    return Stacked((matrix(), Separable(numbers((6, 3), 1), numbers((2, 4), 2))))


@pytest.mark.parametrize("valid", [VALID, VALID[:, :1], VALID[0], True, np.zeros(OUT, bool)])
def test_masked_pixels_read_zero(valid):
    operator = Masked(matrix(), valid)
    rows = np.broadcast_to(valid, OUT).ravel()
    np.testing.assert_allclose(dense(operator), H * rows[:, None], atol=1e-15)
    g = numbers((4, *OUT), 1)
    expected = (g.reshape(4, 10) * rows) @ H
    np.testing.assert_allclose(
        operator.adjoint(jnp.asarray(g)).reshape(4, 12), expected, atol=1e-13
    )


def test_what_a_masked_pixel_holds_is_not_looked_at():
    """NaN times zero would be NaN, in the slopes too."""
    operator = Masked(matrix(), VALID)
    g = numbers(OUT, 1)
    broken = jnp.asarray(np.where(VALID, g, np.nan))
    clean = jnp.asarray(np.where(VALID, g, 0))
    np.testing.assert_array_equal(operator.adjoint(broken), operator.adjoint(clean))
    slope = jax.grad(lambda c: jnp.sum(operator.adjoint(c) ** 2))(broken)
    assert (slope[~VALID] == 0).all()
    assert jnp.isfinite(slope).all()


def test_everything_masked_has_norm_zero():
    assert Masked(matrix(), False).norm() == 0


@pytest.mark.parametrize(
    "gain", [3, -0.5, numbers(OUT, 1), numbers((5, 1), 1), numbers(2, 1), [2, 3]]
)
def test_gain(gain):
    operator = Scaled(matrix(), gain)
    rows = np.broadcast_to(gain, OUT).ravel()
    np.testing.assert_allclose(dense(operator), H * rows[:, None], atol=1e-15)
    g = numbers((4, *OUT), 1)
    expected = (g.reshape(4, 10) * rows) @ H
    np.testing.assert_allclose(
        operator.adjoint(jnp.asarray(g)).reshape(4, 12), expected, atol=1e-13
    )


def test_gains_of_several_captures():
    image = jnp.asarray(numbers(IN, 3))
    captures = stack()(image)
    pixels = numbers((6, 2), 4)
    for given, gains in (((2, pixels), (2, pixels)), (-3, (-3, -3)), ([1, 0.5], (1, 0.5))):
        for seen, capture, gain in zip(Scaled(stack(), given)(image), captures, gains, strict=True):
            np.testing.assert_allclose(seen, gain * np.asarray(capture), atol=1e-14)


def test_slope_in_the_gain():
    """∂ ½‖c·Bf‖² = c·(Bf)²."""
    f, gain = jnp.asarray(numbers(IN, 1)), jnp.asarray(numbers((5, 1), 2))
    slope = eqx.filter_grad(lambda o: jnp.sum(o(f) ** 2) / 2)(Scaled(matrix(), gain))
    seen = np.asarray(matrix()(f))
    np.testing.assert_allclose(
        slope.gain, gain * np.sum(seen**2, axis=1, keepdims=True), rtol=1e-12
    )


def test_bad_masks():
    with pytest.raises(TypeError, match="valid has dtype float64; give booleans.*Scaled"):
        Masked(matrix(), np.ones(OUT))
    for wrong in (VALID.T, VALID[None], VALID[:3]):
        with pytest.raises(ValueError, match=r"valid has shape .* broadcasts .* \(5, 2\)"):
            Masked(matrix(), wrong)
    with pytest.raises(ValueError, match="valid has 1 parts; give 2, one for each capture"):
        Masked(stack(), (VALID,))


@pytest.mark.parametrize("kind", [lambda o: Masked(o, True), lambda o: Scaled(o, 2.0)])
def test_captures_of_another_structure(kind):
    one, two = jnp.ones(OUT), (jnp.ones(OUT), jnp.ones((6, 2)))
    with pytest.raises(ValueError, match="capture is a tuple of 2; give one array"):
        kind(matrix()).adjoint(two)
    for wrong in (one, two[:1]):
        with pytest.raises(ValueError, match="has 2 captures; give a tuple of 2"):
            kind(stack()).adjoint(wrong)
