"""Rows and columns through matrices of their own."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from imaging.operators.dense import dense, numbers

from helpers import finite_difference, quick, relative_l2
from thincam_jax.imaging.operators import Separable
from thincam_jax.imaging.operators.separable import centred

# sizes of capture and image for which the one and the other product comes first
SIZES = [((6, 2), (3, 4)), ((2, 6), (4, 3)), ((1, 5), (7, 2)), ((9, 8), (1, 1))]


@pytest.mark.parametrize(("out", "image"), quick(SIZES, 0, 1))
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


def terms(count=3, out=(9, 5), image=(4, 6), seed=1):
    return Separable(
        numbers((count, out[0], image[0]), seed), numbers((count, out[1], image[1]), seed + 1)
    )


def test_several_terms_are_summed():
    operator = terms()
    image, capture = numbers((2, 4, 6), 3), numbers((2, 9, 5), 4)
    forward = np.einsum("kym,bmn,kxn->byx", operator.left, image, operator.right)
    back = np.einsum("kym,byx,kxn->bmn", operator.left, capture, operator.right)
    np.testing.assert_allclose(operator(jnp.asarray(image)), forward, atol=1e-13)
    np.testing.assert_allclose(operator.adjoint(jnp.asarray(capture)), back, atol=1e-13)
    matrix = dense(operator)
    np.testing.assert_allclose(operator.mean_power(), (matrix**2).sum() / 24, rtol=1e-12)
    np.testing.assert_allclose(operator.norm(iterations=200), np.linalg.norm(matrix, 2), rtol=1e-6)


@pytest.mark.parametrize(("out", "image"), [((9, 5), (4, 6)), ((3, 7), (5, 7))])
def test_modes_of_one_term_are_those_of_the_whole(out, image):
    """Of more rows than the image and of fewer, where the image has modes that are not seen."""
    operator = terms(1, out, image).with_modes()
    modes = operator.modes
    np.testing.assert_allclose(
        np.sort(modes.values.ravel()), np.sort(_singular_values(operator)), atol=1e-12
    )
    for i, j in ((0, 1), (image[0] - 1, 2)):
        seen = operator(jnp.outer(modes.rows[:, i], modes.columns[:, j]))
        expected = jnp.outer(modes.seen_rows[:, i], modes.seen_columns[:, j]) * modes.values[i, j]
        np.testing.assert_allclose(seen, expected, atol=1e-12)


def _singular_values(operator):
    """As many as pixels of the image."""
    values = np.linalg.svd(dense(operator), compute_uv=False)
    return np.append(values, np.zeros(np.prod(operator.in_shape) - len(values)))


def test_modes_of_several_terms_hold_the_diagonal():
    operator = terms().with_modes()
    modes = operator.modes
    basis = np.kron(modes.rows, modes.columns)
    normal = basis.T @ dense(operator).T @ dense(operator) @ basis
    np.testing.assert_allclose(modes.values.ravel() ** 2, np.diag(normal), rtol=1e-10)


def test_centred_captures_are_those_of_the_centred_camera():
    operator, image = terms(), jnp.asarray(numbers((2, 4, 6), 3))
    np.testing.assert_allclose(operator.centred()(image), centred(operator(image)), atol=1e-13)


def test_centring_leaves_one_term_only_where_the_shadow_overfills_the_sensor():
    """A mask (1 + c cᵀ)/2: its uniform half vanishes, unless it ends on the sensor."""
    code = np.sign(numbers(40, 5))
    inside = np.abs(np.arange(40) - 19.5) < 12  # what is open of a small mask
    for window, count in ((np.ones(40), 1), (inside, 2)):
        pairs = [
            [_shadow(line * window, size, scene) for line in (np.ones(40), code)]
            for size, scene in ((30, 8), (26, 7))
        ]
        left, right = (np.stack(pair) for pair in pairs)
        found = Separable(left, right).centred().truncated(1e-6)
        assert found.operator.terms == count
        assert (float(found.errors[0]) > 0.1) == (count == 2)


def _shadow(line, size, scene):
    """(sensor, scene) of a line that moves over the sensor with the point of the scene."""
    middle = (len(line) - size - scene) // 2
    return np.stack([np.roll(line, m)[middle + scene :][:size] for m in range(scene)], axis=1)


def test_truncated_to_the_nearest_of_few_terms():
    """Its error is that of the matrices, and no other sum of as many terms is nearer."""
    operator = terms(4)
    scaled = Separable(
        operator.left * np.array([1, 0.3, 0.03, 3e-3])[:, None, None], operator.right
    )
    whole = dense(scaled)
    for count in (1, 2, 3, 4):
        found = scaled.truncated(terms=count)
        error = relative_l2(dense(found.operator), whole)
        assert error == pytest.approx(float(found.error), abs=1e-12)
        assert found.operator.terms == count and float(found.errors[count - 1]) == found.error
    rearranged = np.einsum("kym,kxn->ymxn", scaled.left, scaled.right).reshape(36, 30)
    values = np.linalg.svd(rearranged, compute_uv=False)
    best = np.sqrt(np.cumsum(values[::-1] ** 2)[::-1][1:5]) / np.linalg.norm(values)
    np.testing.assert_allclose(scaled.truncated().errors, best, atol=1e-12)
    loose = scaled.truncated(float(best[1]) * 1.01)
    assert loose.operator.terms == 2


def test_it_is_traced_and_differentiated():
    """Modes and truncations by a number of terms; derivatives through singular values."""
    operator = terms()

    def length(scale):
        changed = Separable(operator.left * scale[:, None, None], operator.right)
        return jnp.sum(changed.truncated(terms=2).operator(jnp.ones((4, 6))) ** 2)

    at, direction = jnp.array([1.0, 0.6, 0.3]), jnp.array([0.2, -0.5, 1.0])
    slope = jnp.vdot(jax.jit(jax.grad(length))(at), direction)
    change = finite_difference(length, at, direction, 1e-5)
    assert float(slope) == pytest.approx(float(change), rel=1e-6)
    many = jax.vmap(length)(jnp.stack([at, 2 * at]))
    np.testing.assert_allclose(many, [length(at), length(2 * at)], rtol=1e-10)
    single = jax.tree.map(lambda x: x.astype(jnp.float32), operator)
    kept = jax.jit(Separable.with_modes)(single)
    assert kept.modes.values.dtype == jnp.float32
    np.testing.assert_allclose(kept.modes.values, operator.with_modes().modes.values, rtol=1e-4)
