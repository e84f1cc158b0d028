"""A dense matrix between images, and stacks of operators."""

import jax
import jax.numpy as jnp
import numpy as np
import scipy.linalg
from imaging.operators.dense import IN, OUT, dense, numbers

from thincam_jax.imaging.operators import Matrix, Separable, Stacked
from thincam_jax.imaging.operators.base import adjoint_error


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


LEFT, RIGHT, H = numbers((6, 3), 1), numbers((2, 4), 2), numbers((5, 12), 3)


def stack():
    return Stacked([Separable(LEFT, RIGHT), Matrix(H, IN, (5,))])


def test_captures_one_after_the_other():
    f = numbers(IN)
    first, second = stack()(jnp.asarray(f))
    np.testing.assert_allclose(first, np.einsum("ym,xn,mn->yx", LEFT, RIGHT, f), atol=1e-14)
    np.testing.assert_allclose(second, np.einsum("ij,j->i", H, f.ravel()), atol=1e-14)


def test_norm_lies_between_the_largest_and_the_root_of_squares():
    """And is that of the matrices on top of each other."""
    parts = [np.linalg.norm(dense(operator), 2) for operator in stack().operators]
    value = stack().norm(iterations=300)
    assert max(parts) < value < np.hypot(*parts)
    whole = np.vstack([np.kron(LEFT, RIGHT), H])
    np.testing.assert_allclose(value, np.linalg.svd(whole, compute_uv=False)[0], rtol=1e-9)


def test_captures_in_the_wrong_order_do_not_pass(key):
    """Two of one shape: only the adjoint's order can tell."""

    class Swapped(Stacked):
        def adjoint(self, capture):
            return super().adjoint(capture[::-1])

    pair = Matrix(H, IN, (5,)), Matrix(numbers((5, 12), 6), IN, (5,))
    assert adjoint_error(Stacked(pair), key) < 1e-14
    assert adjoint_error(Swapped(pair), key) > 0.01
