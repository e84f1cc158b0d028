"""Rows and columns through matrices of their own."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from imaging.operators.dense import numbers

from thincam_jax.imaging.operators import Separable

# sizes of capture and image for which the one and the other product comes first
SIZES = [((6, 2), (3, 4)), ((2, 6), (4, 3)), ((1, 5), (7, 2)), ((9, 8), (1, 1))]


@pytest.mark.parametrize(("out", "image"), SIZES)
def test_sums(out, image):
    """G_yx = Σ L_ym F_mn R_xn, and the transposed."""
    left, right = numbers((out[0], image[0]), 1), numbers((out[1], image[1]), 2)
    operator = Separable(left, right)
    assert operator.in_shape == image
    assert operator.out_shape == out
    f, g = numbers((2, *image), 3), numbers((2, *out), 4)
    forward = np.einsum("ym,bmn,xn->byx", left, f, right)
    back = np.einsum("ym,byx,xn->bmn", left, g, right)
    np.testing.assert_allclose(operator(jnp.asarray(f)), forward, atol=1e-13)
    np.testing.assert_allclose(operator.adjoint(jnp.asarray(g)), back, atol=1e-13)


@pytest.mark.parametrize(("out", "image"), SIZES)
def test_norm_is_exact(out, image):
    left, right = numbers((out[0], image[0]), 1), numbers((out[1], image[1]), 2)
    singular = np.linalg.svd(np.kron(left, right), compute_uv=False)
    np.testing.assert_allclose(Separable(left, right).norm(), singular[0], rtol=1e-12)


def test_norm_zero():
    assert Separable(np.zeros((6, 3)), numbers((2, 4))).norm() == 0


@pytest.mark.parametrize("image", [(3, 40), (40, 3)])
def test_products_in_the_cheaper_order(image):
    """The few rows or columns of the image grow to the many of the capture last."""
    operator = Separable(numbers((50, image[0])), numbers((60, image[1])))
    compiled = jax.jit(operator.__call__).lower(jnp.ones(image)).compile()
    m, n = image
    orders = 50 * m * n + 50 * n * 60, m * n * 60 + 50 * m * 60
    assert compiled.cost_analysis()["flops"] < 2.1 * min(orders)


def test_products_keep_the_digits():
    """An accelerator would multiply float32 with fewer, if not told."""
    operator = Separable(numbers((6, 3)).astype(np.float32), numbers((2, 4)).astype(np.float32))
    for function, shape in ((operator, (3, 4)), (operator.adjoint, (6, 2))):
        text = str(jax.make_jaxpr(function)(jnp.ones(shape, jnp.float32)))
        assert text.count("dot_general") == text.count("Precision.HIGHEST") // 2 == 2


def test_bad_input():
    with pytest.raises(ValueError, match=r"left has shape \(3,\); give rows"):
        Separable(np.ones(3), np.ones((2, 4)))
    with pytest.raises(ValueError, match=r"right has shape \(0, 4\); give rows"):
        Separable(np.ones((6, 3)), np.ones((0, 4)))
    with pytest.raises(ValueError, match="right holds 1 numbers that are not finite"):
        Separable(np.ones((6, 3)), np.array([[1, np.nan]]))
    with pytest.raises(TypeError, match="left holds complex128; give real"):
        Separable(1j * np.ones((6, 3)), np.ones((2, 4)))
    with pytest.raises(TypeError, match="left is float32 and right is float64; give both in one"):
        Separable(np.ones((6, 3), np.float32), np.ones((2, 4)))
