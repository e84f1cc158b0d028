"""A sparse matrix between images."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.sparse
from imaging.operators.dense import IN, OUT, dense, numbers, sparse_matrix
from jax.experimental import sparse

from thincam_jax.imaging.operators import Sparse

FORMATS = ["coo", "csr", "csc", "lil", "dia", "bsr"]


@pytest.mark.parametrize(
    ("kind", "batch"),
    [("coo", ()), ("coo", (1,)), *((kind, (2, 3)) for kind in [*FORMATS, "matrix", "bcoo"])],
)
def test_sums(kind, batch):
    """Every format is the same matrix; a batch is read one by one."""
    H = sparse_matrix()
    tensor = H.toarray().reshape(*OUT, *IN)
    given = {
        "matrix": lambda: scipy.sparse.csr_matrix(H),
        "bcoo": lambda: sparse.BCOO.from_scipy_sparse(scipy.sparse.coo_matrix(H)),
    }.get(kind, lambda: H.asformat(kind))()
    operator = Sparse(given, IN, OUT)
    f, g = numbers((*batch, *IN), 1), numbers((*batch, *OUT), 2)
    forward = np.einsum("yxmn,...mn->...yx", tensor, f)
    back = np.einsum("yxmn,...yx->...mn", tensor, g)
    np.testing.assert_allclose(operator(jnp.asarray(f)), forward, atol=1e-13)
    np.testing.assert_allclose(operator.adjoint(jnp.asarray(g)), back, atol=1e-13)


def test_entries_at_one_place_add_up():
    H = scipy.sparse.coo_array(([1.0, 2.0, 4.0], ([0, 0, 2], [1, 1, 0])), shape=(3, 2))
    np.testing.assert_array_equal(dense(Sparse(H, (2,), (3,))), [[0, 3], [0, 0], [4, 0]])


@pytest.mark.thorough
def test_padding_of_a_bcoo_is_left_out():
    """Its indices lie one beyond the matrix; neither values nor slopes come from there."""
    H = sparse_matrix().toarray()
    padded = sparse.BCOO.fromdense(jnp.asarray(H), nse=60)
    assert padded.nse > np.count_nonzero(H)
    assert (np.asarray(padded.indices) >= H.shape).all(axis=1).any()
    broken = sparse.BCOO(
        (jnp.where(padded.data == 0, 7, padded.data), padded.indices), shape=H.shape
    )
    operator = Sparse(broken, IN, OUT)
    np.testing.assert_allclose(dense(operator), H, atol=1e-14)
    np.testing.assert_allclose(operator.by_rows().toarray(), H, atol=1e-14)
    g = jnp.asarray(numbers(OUT))
    np.testing.assert_allclose(operator.adjoint(g).ravel(), np.ravel(g) @ H, atol=1e-13)
    slope = eqx.filter_grad(lambda o: jnp.sum(o(jnp.ones(IN)) ** 2))(operator)
    assert jnp.isfinite(slope.values).all()
    assert (slope.values[padded.data == 0] == 0).all()


def test_slope_in_the_values():
    """∂⟨g, H f⟩/∂H_ij = g_i f_j, at the entries."""
    H = sparse_matrix().tocoo()
    f, g = numbers(IN, 1), numbers(OUT, 2)
    operator = Sparse(H, IN, OUT)
    for loss in (
        lambda o: jnp.vdot(g, o(jnp.asarray(f))),
        lambda o: jnp.vdot(f, o.adjoint(jnp.asarray(g))),
    ):
        slope = eqx.filter_grad(loss)(operator)
        expected = g.ravel()[operator.rows] * f.ravel()[operator.columns]
        np.testing.assert_allclose(slope.values, expected, atol=1e-14)


def test_a_batch_does_not_hold_all_products():
    """The largest array of a batch of 64 is the batch, not 64 times the entries."""
    H = scipy.sparse.coo_array(np.ones((10, 12)))
    text = str(jax.make_jaxpr(Sparse(H, IN, OUT))(jnp.ones((64, *IN))))
    assert "f64[120]" in text
    assert "64,120" not in text


def test_bad_input():
    H = sparse_matrix()
    with pytest.raises(TypeError, match="matrix is a ndarray; give a scipy.sparse .* Matrix"):
        Sparse(H.toarray(), IN, OUT)
    with pytest.raises(TypeError, match="matrix holds complex128; give real"):
        Sparse(H * 1j, IN, OUT)
    with pytest.raises(ValueError, match="matrix holds 1 numbers that are not finite"):
        Sparse(scipy.sparse.coo_array(([np.nan], ([0], [0])), shape=(10, 12)), IN, OUT)
    with pytest.raises(ValueError, match=r"matrix has shape \(12,\); give rows and columns"):
        Sparse(scipy.sparse.coo_array(np.ones(12)), IN, OUT)
    with pytest.raises(ValueError, match="1 batch and 0 dense axes; give two axes, both sparse"):
        rows = np.ones((10, 12)), np.broadcast_to(np.arange(12)[:, None], (10, 12, 1))
        Sparse(sparse.BCOO(tuple(map(jnp.asarray, rows)), shape=(10, 12)), IN, OUT)
    with pytest.raises(ValueError, match=r"in_shape = \(3, 5\), but the matrix has 12 columns"):
        Sparse(H, (3, 5), OUT)
    with pytest.raises(ValueError, match=r"out_shape = \(5, 3\), but the matrix has 10 rows"):
        Sparse(H, IN, (5, 3))
