"""Several captures of one image."""

import jax.numpy as jnp
import numpy as np
import pytest
from imaging.operators.dense import IN, dense, numbers

from thincam_jax.imaging.operators import Matrix, Separable, Stacked
from thincam_jax.imaging.operators.base import adjoint_error

LEFT, RIGHT, H = numbers((6, 3), 1), numbers((2, 4), 2), numbers((5, 12), 3)


def stack():
    return Stacked([Separable(LEFT, RIGHT), Matrix(H, IN, (5,))])


def test_captures_one_after_the_other():
    f = numbers(IN)
    first, second = stack()(jnp.asarray(f))
    np.testing.assert_allclose(first, np.einsum("ym,xn,mn->yx", LEFT, RIGHT, f), atol=1e-14)
    np.testing.assert_allclose(second, np.einsum("ij,j->i", H, f.ravel()), atol=1e-14)


def test_adjoints_add_up():
    a, b = numbers((6, 2), 4), numbers(5, 5)
    expected = np.einsum("ym,xn,yx->mn", LEFT, RIGHT, a) + np.einsum("ij,i->j", H, b).reshape(IN)
    for captures in ((a, b), [a, b]):
        value = stack().adjoint(type(captures)(map(jnp.asarray, captures)))
        np.testing.assert_allclose(value, expected, atol=1e-13)


def test_shapes():
    assert stack().in_shape == IN
    assert stack().out_shape == ((6, 2), (5,))


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


def test_bad_input():
    with pytest.raises(ValueError, match="operators is empty; give at least one"):
        Stacked([])
    with pytest.raises(ValueError, match=r"\[\(3, 4\), \(4, 3\)\]; give operators of one in_shape"):
        Stacked([Matrix(H, IN, (5,)), Matrix(H, (4, 3), (5,))])
    for captures, given in (((jnp.ones((6, 2)),), "1"), (jnp.ones((2, 5)), "one array")):
        with pytest.raises(ValueError, match=f"captures are {given}; give a tuple of 2"):
            stack().adjoint(captures)
