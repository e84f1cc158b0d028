"""A measured matrix reduced to as many rows as it has columns."""

import math
import zipfile

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.sparse
from imaging.operators.dense import numbers

import thincam_jax as tc
from helpers import relative_l2
from thincam_jax.imaging.operators import Matrix, ReducedMatrix, Sparse, reduced
from thincam_jax.imaging.operators.base import adjoint_error
from thincam_jax.imaging.operators.masked import Scaled

IN, OUT = (4, 5), (9, 11)
H = numbers((99, 20))


@pytest.fixture(autouse=True)
def several_blocks(monkeypatch):
    monkeypatch.setattr(reduced, "_BLOCK", 33 * 20)


def test_it_is_the_singular_value_decomposition():
    """SVᵀ and Uᵀg up to signs, and the same slope of the misfit for any image."""
    g, f = numbers((2, 3, *OUT), 1), jnp.asarray(numbers((2, 3, *IN), 2))
    system, whole = ReducedMatrix.of(H, IN), Matrix(H, IN, OUT)
    left, values, _ = np.linalg.svd(H, full_matrices=False)
    np.testing.assert_allclose(system.values[::-1], values, rtol=1e-12)
    assert float(system.norm()) == pytest.approx(values[0], rel=1e-13)
    assert float(system.mean_power()) == pytest.approx(float(whole.mean_power()))
    seen = system.project(H, g)
    expected = np.linalg.norm(g.reshape(2, 3, 99) @ left, axis=-1)
    np.testing.assert_allclose(np.linalg.norm(seen, axis=-1), expected, rtol=1e-10)
    slope = whole.adjoint(whole(f) - g)
    np.testing.assert_allclose(system.adjoint(system(f) - seen), slope, atol=1e-10)
    assert float(adjoint_error(system, jax.random.key(0))) < 1e-13


def test_what_no_capture_shows_counts_as_unseen():
    """A column that is zero in single precision: its eigenvalue is rounding."""
    blind = H.astype(np.float32)
    blind[:, 7] = 0
    system = ReducedMatrix.of(blind, IN)
    assert int((system.values == 0).sum()) == 1
    seen = system.project(blind, numbers(OUT, 1).astype(np.float32))
    assert float(jnp.abs(system.adjoint(seen)).ravel()[7]) < 1e-5
    assert bool(jnp.isfinite(seen).all())


def test_rows_may_come_from_anywhere():
    """Single numbers of the mean capture: from arrays, operators and a store read in chunks."""
    few = scipy.sparse.random_array((99, 20), density=0.2, rng=3)
    dense, g = few.toarray(), numbers(OUT, 1)
    expected = ReducedMatrix.of(dense, IN)
    gain = 1 + numbers(OUT, 3) ** 2
    brighter = few / gain.reshape(-1, 1)
    scaled = [Scaled(Sparse(scipy.sparse.coo_array(brighter), IN, OUT), gain)]
    scaled += [Scaled(Matrix(dense / 3, IN, OUT), 3.0)]
    arrays = [few.tocsr(), Chunked(dense)]
    for given in (*arrays, Sparse(few, IN, OUT), Matrix(dense, IN, OUT), *scaled):
        shape = None if hasattr(given, "in_shape") else IN
        found = ReducedMatrix.of(given, shape)
        np.testing.assert_allclose(found.values, expected.values, atol=1e-12)
        pulled = found.adjoint(found.project(given, g))
        np.testing.assert_allclose(pulled, (dense.T @ g.ravel()).reshape(IN), atol=1e-12)


class Chunked:
    """As a Zarr array: a shape, chunks, and rows to be sliced by whole chunks."""

    def __init__(self, numbers):
        self.numbers, self.shape, self.dtype = numbers, numbers.shape, numbers.dtype
        self.chunks = (10, 20)

    def __getitem__(self, rows):
        assert rows.start % 10 == 0 or rows.stop == rows.start + 1  # a block, or a row
        return self.numbers[rows]


@pytest.mark.parametrize(
    "solver", [pytest.param(tc.AdmmTV(1.0, iterations=30), marks=pytest.mark.thorough), tc.Ridge()]
)
def test_reconstructions_are_those_of_the_whole_matrix(solver):
    """Of a batch, before convergence; the whole matrix's norm is approached from below."""
    scene = np.abs(numbers((3, *IN), 4))
    captures = Matrix(H, IN, OUT)(jnp.asarray(scene)) + 0.01 * numbers((3, *OUT), 5)
    system = ReducedMatrix.of(H, IN)
    projected = system.project(H, captures)
    found = tc.reconstruct(tc.Recording(projected, system, noise_variance=1e-4), solver)
    whole = tc.Recording(captures, Matrix(H, IN, OUT), noise_variance=1e-4)
    expected = tc.reconstruct(whole, solver)
    assert found.image.shape == (3, *IN)
    assert relative_l2(found.image, expected.image) < 5e-4
    with pytest.raises(ValueError, match="give noise_variance: it is estimated from captures"):
        tc.reconstruct(tc.Recording(projected, system), solver)


def test_a_file_is_read_for_its_own_matrix_only(tmp_path):
    system = ReducedMatrix.of(H, IN)
    path = system.save(tmp_path / "reduced.npz", H)
    again = ReducedMatrix.load(path, Matrix(H, IN, OUT))
    np.testing.assert_array_equal(again.vectors, system.vectors)
    np.testing.assert_array_equal(again.transposed, system.transposed)
    assert again.in_shape == IN
    for other in (H + 1e-9, H[:-1], H.astype(np.float32)):
        with pytest.raises(ValueError, match=r"reduced.npz belongs to another matrix .* make it"):
            ReducedMatrix.load(path, other)
    path.write_bytes(path.read_bytes()[:-400])
    with pytest.raises(ValueError, match=r"reduced.npz is no reduced matrix .* make it anew"):
        ReducedMatrix.load(path, H)


@pytest.mark.parametrize(
    ("changed", "told"),
    [
        ({"values": np.nan}, "or wrong numbers"),
        ({"values": np.ones(3)}, "other shapes"),
        ({"vectors": np.eye(math.prod(IN), dtype=complex)}, "other shapes"),
        ({"in_shape": [2, 2]}, "other shapes"),
        ({"packed": True}, "its arrays are packed"),
        ({"header": b"(" * 99}, "is no reduced matrix"),
    ],
)
def test_a_file_that_is_not_to_be_trusted(changed, told, tmp_path):
    path = ReducedMatrix.of(H, IN).save(tmp_path / "reduced.npz", H)
    with np.load(path) as file:
        arrays = {name: file[name] for name in file}
    ((name, value),) = changed.items()
    if name in arrays:
        alike = isinstance(value, float)
        arrays[name] = np.full_like(arrays[name], value) if alike else np.asarray(value)
    (np.savez_compressed if name == "packed" else np.savez)(
        path, **{key: array for key, array in arrays.items() if (key, name) != ("mark", "header")}
    )
    if name == "header":
        text = b"{'descr': '<f8', 'shape': " + value + b"\n"
        with zipfile.ZipFile(path, "a") as archive:
            head = b"\x93NUMPY\x01\x00" + len(text).to_bytes(2, "little")
            archive.writestr("mark.npy", head + text)
    with pytest.raises(ValueError, match=f"{told}.*make it anew") as raised:
        ReducedMatrix.load(path, H)
    assert len(str(raised.value)) < 600


def test_sizes_that_differ():
    system = ReducedMatrix.of(H, IN)
    with pytest.raises(ValueError, match=r"captures have shape \(9, 10\) and the matrix 99 rows"):
        system.project(H, np.ones((9, 10)))
    with pytest.raises(ValueError, match="the matrix has 19 columns and was reduced from 20"):
        system.project(H[:, 1:], np.ones(OUT))
    with pytest.raises(ValueError, match=r"in_shape = \(4, 4\), but the matrix has 20 columns"):
        ReducedMatrix.of(H, (4, 4))
    with pytest.raises(ValueError, match=r"ndarray of shape \(99,\); give rows"):
        ReducedMatrix.of(H[:, 0], IN)
    with pytest.raises(ValueError, match=r"HᵀH holds \d+ numbers that are not finite"):
        ReducedMatrix.of(np.where(H == H.max(), np.nan, H), IN)
    with pytest.raises(ValueError, match=r"capture has shape \(9, 11\); its operator takes"):
        tc.Recording(np.ones(OUT), system, noise_variance=1.0).problem()
