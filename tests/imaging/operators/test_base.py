"""What holds for every operator: its transpose, its norm, batches, derivatives, compilation."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from imaging.operators.dense import IN, NAMES, OUT, dense, dense_of, flat, numbers, operators, white

from helpers import count_traces, finite_difference, quick
from thincam_jax.imaging.operators import AbstractOperator, Matrix, Stacked
from thincam_jax.imaging.operators.base import adjoint_error, is_shape

KINDS = pytest.mark.parametrize("name", NAMES)
# A convolution, several terms, a sparse matrix, and operators within operators.
FEW = pytest.mark.parametrize("name", quick(NAMES, 0, 3, 4, 10))
# One program for an operator, not one for each step.
error_of_adjoint = eqx.filter_jit(adjoint_error)


MISTAKES = ("sign", "factor", "shifted", "turned", "zero", "nan")


class Wrong(AbstractOperator):
    """A matrix with one of `MISTAKES` in its adjoint; a transposed one by default."""

    matrix: Matrix
    mistake: int | jax.Array | None = None  # no static field, which would be compiled for

    @property
    def in_shape(self):
        return self.matrix.in_shape

    @property
    def out_shape(self):
        return self.matrix.out_shape

    def __call__(self, image):
        return self.matrix(image)

    def adjoint(self, capture):
        right = self.matrix.adjoint(capture)
        if self.mistake is None:
            return right.swapaxes(-1, -2)
        shifted, turned = jnp.roll(right, 1, axis=-1), right[..., ::-1, ::-1]
        wrong = (-right, 1.1 * right, shifted, turned, 0 * right, jnp.nan * right)
        return jnp.stack(wrong)[self.mistake]


class Mislabelled(Wrong):
    """One whose captures have another shape than it says."""

    @property
    def out_shape(self):
        return self.matrix.out_shape[::-1]


def a_matrix(seed=0, rows=10):
    return Matrix(numbers((rows, 12), seed), IN, (rows // 2, 2))


@eqx.filter_jit
def all_ways(operator, images, captures):
    """Both maps of a batch, and both mapped over it."""
    seen, back = operator(images), operator.adjoint(captures)
    each = jax.vmap(operator)(images), jax.vmap(operator.adjoint)(captures)
    return seen, back, each


@KINDS
def test_shapes_batches_and_vmap(name):
    """A batch is what its elements are one by one, and what the matrix makes of them."""
    operator, matrix = operators()[name], dense_of(name)
    image, capture = white(operator, (2, 3))
    seen, back, each = all_ways(operator, image, capture)
    shapes = jax.tree.leaves(operator.out_shape, is_leaf=is_shape)
    assert [leaf.shape[2:] for leaf in jax.tree.leaves(seen)] == shapes
    assert back.shape == (2, 3, *operator.in_shape)
    expected = flat(image, 2) @ matrix.T, flat(capture, 2) @ matrix
    for forward, backward in ((seen, back), each):
        np.testing.assert_allclose(flat(forward, 2), expected[0], atol=1e-13)
        np.testing.assert_allclose(flat(backward, 2), expected[1], atol=1e-13)


@pytest.mark.parametrize(
    ("name", "dtype", "limit"),
    [
        *quick([(name, jnp.float64, 1e-14) for name in NAMES], 0, 10),
        *quick([(name, jnp.float32, 3e-6) for name in NAMES], 0),
    ],
)
def test_adjoint_error_is_rounding(name, dtype, limit, key):
    operator = operators(dtype)[name]
    error = error_of_adjoint(operator, key)
    assert error.dtype == dtype
    assert error < limit


@pytest.mark.parametrize("mistake", MISTAKES)
def test_adjoint_error_shows_a_mistake(mistake, key):
    operator = Wrong(a_matrix(), jax.device_put(MISTAKES.index(mistake)))
    assert not error_of_adjoint(operator, key) < 0.01


def test_adjoint_error_shows_a_transposed_adjoint(key):
    with pytest.raises(ValueError, match=r"adjoint returns shapes \[\(4, 3\)\].*\(3, 4\)"):
        adjoint_error(Wrong(a_matrix()), key)


def test_adjoint_error_compares_the_shapes_with_those_announced(key):
    with pytest.raises(ValueError, match=r"operator returns shapes \[\(5, 2\)\].*\[\(2, 5\)\]"):
        adjoint_error(Mislabelled(a_matrix(), 1), key)


@FEW
def test_norm_is_the_largest_singular_value(name):
    """The power iteration comes from below."""
    operator = operators()[name]
    largest = np.linalg.svd(dense_of(name), compute_uv=False)[0]
    value = operator.norm()
    assert 0.95 * largest < value < largest * (1 + 1e-12)


def test_norm_to_all_digits_where_one_value_stands_alone():
    """As a camera's does: light is positive."""
    matrix = np.abs(numbers((10, 12)))
    largest = np.linalg.svd(matrix, compute_uv=False)[0]
    np.testing.assert_allclose(Matrix(matrix, IN, OUT).norm(), largest, rtol=1e-13)


@pytest.mark.parametrize("name", quick(["planes", "stacked", "sparse", "separable"], 2))
def test_norm_in_single_precision(name):
    """Also where float64 is the default: the operator's own precision counts."""
    value = operators(jnp.float32)[name].norm(iterations=300)
    assert value.dtype == jnp.float32
    largest = np.linalg.svd(dense_of(name), compute_uv=False)[0]
    np.testing.assert_allclose(value, largest, rtol=3e-5)


def test_slope_of_the_norm():
    """d‖A‖ = uᵀ dA v."""
    matrix = np.abs(numbers((10, 12)))
    slope = jax.grad(lambda m: Matrix(m, IN, OUT).norm(iterations=100))(jnp.asarray(matrix))
    u, _, v = np.linalg.svd(matrix)
    np.testing.assert_allclose(slope, np.outer(u[:, 0], v[0]), atol=1e-10)


def test_norm_passes_nan_on():
    matrix = Matrix(np.ones((10, 12)), IN, OUT)
    assert jnp.isnan(Matrix.norm(eqx.tree_at(lambda m: m.matrix, matrix, matrix.matrix * np.nan)))


class Counting(AbstractOperator):
    """A matrix that counts how often its map is traced."""

    matrix: Matrix
    traces = 0

    @property
    def in_shape(self):
        return self.matrix.in_shape

    @property
    def out_shape(self):
        return self.matrix.out_shape

    def __call__(self, image):
        Counting.traces += 1
        return self.matrix(image)

    def adjoint(self, capture):
        return self.matrix.adjoint(capture)


def test_norm_is_compiled_once():
    """Called from outside of jit, for operators of other numbers too."""
    values = [Counting(a_matrix(0)).norm()]
    traces = Counting.traces
    values.append(Counting(a_matrix(1)).norm())
    assert Counting.traces == traces
    assert abs(values[0] - values[1]) > 1e-3


@pytest.mark.parametrize("name", quick(["planes", "sparse", "masked stacked", "scaled"], 2))
def test_compiled_once(name):
    """For other numbers in the operator, and other images."""
    counted = count_traces(lambda o, image: o.adjoint(o(image)))
    compiled = eqx.filter_jit(counted)
    for factor in (1.0, 3.0):
        operator = jax.tree.map(
            lambda a, f=factor: a * f if eqx.is_inexact_array(a) else a, operators()[name]
        )
        image, _ = white(operator, seed=int(factor))
        matrix = dense(operator)
        expected = matrix.T @ (matrix @ flat(image))
        np.testing.assert_allclose(flat(compiled(operator, image)), expected, rtol=1e-9)
    assert counted.traces == 1


@FEW
def test_gradient_in_the_numbers_of_the_operator(name):
    """Both maps take the same numbers: ⟨A f, g⟩ and ⟨f, Aᵀ g⟩ have one gradient."""
    operator = operators()[name]
    image, capture = white(operator)
    free, rest = eqx.partition(operator, eqx.is_inexact_array)
    direction = jax.tree.map(lambda a: numbers(a.shape, 11).astype(a.dtype), free)

    def forward(free):
        seen = eqx.combine(free, rest)(image)
        return sum(jax.tree.leaves(jax.tree.map(jnp.vdot, seen, capture)))

    def backward(free):
        return jnp.vdot(image, eqx.combine(free, rest).adjoint(capture))

    slopes = jax.jit(jax.grad(forward))(free), jax.jit(jax.grad(backward))(free)
    for a, b in zip(*map(jax.tree.leaves, slopes), strict=True):
        np.testing.assert_allclose(a, b, atol=1e-12)
    expected = finite_difference(jax.jit(forward), free, direction, 1e-2)
    terms = jax.tree.map(lambda s, d: np.sum(np.asarray(s) * d).real, slopes[0], direction)
    value = sum(jax.tree.leaves(terms))
    np.testing.assert_allclose(value, expected, rtol=1e-8, atol=1e-9)


@KINDS
def test_an_image_or_capture_of_another_shape(name):
    operator = operators()[name]
    image, capture = white(operator)
    for wrong in (image[..., :-1], image[..., :1], jnp.swapaxes(image, -1, -2)):
        with pytest.raises(ValueError, match=r"has shape .*the operator takes"):
            operator(wrong)
    for wrong in (
        jax.tree.map(lambda c: c[..., :1], capture),
        jax.tree.map(lambda c: jnp.swapaxes(c, -1, -2), capture),
    ):
        with pytest.raises(ValueError, match=r"has shape .*the operator takes") as caught:
            operator.adjoint(wrong)
        assert "\n" not in str(caught.value)


def test_a_stack_of_one_has_the_norm_of_that_one():
    separable = operators()["separable"]
    assert Stacked([separable]).norm() == separable.norm()
    with pytest.raises(ValueError, match="at least 1"):
        Stacked([a_matrix()]).norm(iterations=0)
