"""A dense matrix between images."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
from imaging.operators.dense import IN, OUT, numbers

from thincam_jax.imaging.operators import Matrix


def test_sums():
    """Pixels are read row by row."""
    batch = (2, 3)
    H, f, g = numbers((10, 12)), numbers((*batch, *IN), 1), numbers((*batch, *OUT), 2)
    tensor = H.reshape(*OUT, *IN)
    operator = Matrix(H, IN, OUT)
    forward = np.einsum("yxmn,...mn->...yx", tensor, f)
    back = np.einsum("yxmn,...yx->...mn", tensor, g)
    np.testing.assert_allclose(operator(jnp.asarray(f)), forward, atol=1e-13)
    np.testing.assert_allclose(operator.adjoint(jnp.asarray(g)), back, atol=1e-13)


def test_a_hadamard_matrix_of_whole_numbers():
    """All its singular values are √n, and its transpose is its inverse times n."""
    operator = Matrix(scipy.linalg.hadamard(8), (2, 4), (4, 2))
    assert operator.matrix.dtype == jnp.float64
    np.testing.assert_allclose(operator.norm(), np.sqrt(8), rtol=1e-14)
    f = jnp.asarray(numbers((2, 4)))
    np.testing.assert_allclose(operator.adjoint(operator(f)), 8 * f, atol=1e-13)


def test_the_matrix_is_never_transposed():
    """On a CPU that would cost twenty times the product, in the gradients too."""
    operator = Matrix(numbers((10, 12)).astype(np.float32), IN, OUT)
    f, g = jnp.ones((4, *IN), jnp.float32), jnp.ones((4, *OUT), jnp.float32)

    def both(f, g):
        forward, forward_slope = jax.vjp(operator, f)
        back, back_slope = jax.vjp(operator.adjoint, g)
        return forward, back, forward_slope(g), back_slope(f)

    equations = jax.make_jaxpr(both)(f, g).eqns
    transposed = [e for e in equations if e.primitive.name == "transpose"]
    assert all(e.invars[0].aval.shape not in ((10, 12), (12, 10)) for e in transposed)
    products = [e for e in equations if e.primitive.name == "dot_general"]
    assert len(products) == 4
    assert all(set(e.params["precision"]) == {jax.lax.Precision.HIGHEST} for e in products)


def test_bad_input():
    H = numbers((10, 12))
    with pytest.raises(ValueError, match=r"matrix has shape \(10,\); give rows"):
        Matrix(H[:, 0], IN, OUT)
    with pytest.raises(ValueError, match="matrix holds 2 numbers that are not finite"):
        Matrix(np.where(H == H.max(), np.inf, np.where(H == H.min(), np.nan, H)), IN, OUT)
    with pytest.raises(TypeError, match="matrix holds bool; give real"):
        Matrix(H > 0, IN, OUT)
    for wrong in ((3, 5), (-3, -4), (2.4, 5), 13, ("3", "4x"), ()):
        with pytest.raises(ValueError, match=r"in_shape = .* 12 columns; .* product is 12"):
            Matrix(H, wrong, OUT)
        with pytest.raises(ValueError, match=r"out_shape = .* 10 rows; .* product is 10"):
            Matrix(H, IN, wrong)
