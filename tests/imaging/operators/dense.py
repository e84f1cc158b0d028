"""An operator as a matrix, column by column, and operators of every kind for tests."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.sparse

from thincam_jax.imaging.operators import (
    AbstractOperator,
    CropConvolution,
    Masked,
    Matrix,
    Separable,
    Sparse,
    Stacked,
)
from thincam_jax.imaging.operators.masked import Scaled

IN, OUT = (3, 4), (5, 2)


def numbers(shape, seed=0):
    return np.random.default_rng(seed).normal(size=shape)


def flat(capture, batch: int = 0) -> np.ndarray:
    """All arrays of a capture in one axis, after the batch axes."""
    leaves = [np.asarray(leaf) for leaf in jax.tree.leaves(capture)]
    return np.concatenate([leaf.reshape(*leaf.shape[:batch], -1) for leaf in leaves], axis=-1)


@functools.cache
def dense_of(name: str) -> np.ndarray:
    return dense(operators()[name])


def dense(operator: AbstractOperator) -> np.ndarray:
    """(capture, image): each column the capture of one pixel."""
    size = int(np.prod(operator.in_shape))
    # In the precision of the operator's numbers.
    first = next(a for a in jax.tree.leaves(operator) if a.dtype.kind in "fc")
    unit = jnp.eye(size, dtype=jnp.finfo(first.dtype).dtype)
    return flat(_one_by_one(operator, unit.reshape(size, *operator.in_shape)), 1).T


@eqx.filter_jit
def _one_by_one(operator, images):
    return jax.lax.map(operator, images)


def white(operator: AbstractOperator, batch=(), seed=1, dtype=jnp.float64):
    """A random image and a random capture."""
    image = jnp.asarray(numbers((*batch, *operator.in_shape), seed), dtype)
    like = jax.eval_shape(operator, image)
    leaves, structure = jax.tree.flatten(like)
    captures = [
        jnp.asarray(numbers(leaf.shape, seed + 1 + i), dtype) for i, leaf in enumerate(leaves)
    ]
    return image, jax.tree.unflatten(structure, captures)


def sparse_matrix(shape=(10, 12), seed=5):
    generator = np.random.default_rng(seed)
    return scipy.sparse.random_array(
        shape, density=0.3, rng=generator, data_sampler=generator.standard_normal
    )


@functools.cache
def operators(dtype=jnp.float64) -> dict[str, AbstractOperator]:
    """One of each kind, and some of operators in operators; nothing square."""

    def real(shape, seed):
        return jnp.asarray(numbers(shape, seed), dtype)

    matrix = Matrix(real((10, 12), 2), IN, OUT)
    separable = Separable(real((6, 3), 3), real((2, 4), 4))
    stacked = Stacked((separable, matrix))
    valid = np.arange(10).reshape(OUT) % 3 > 0
    kernel, pitch = real((2, 3, 3, 5), 6), jnp.asarray(0.5, dtype)
    return {
        "planes": CropConvolution(kernel, pitch, OUT, IN, summed=1, window=(11, 9)),
        "matrix": matrix,
        "separable": separable,
        "terms": Separable(real((3, 6, 3), 10), real((3, 2, 4), 11)),
        "sparse": Sparse(sparse_matrix().astype(dtype), IN, OUT),
        "stacked": stacked,
        "masked": Masked(matrix, valid),
        "masked stacked": Masked(stacked, (numbers((6, 2), 8) > 0, ~valid)),
        "scaled": Scaled(matrix, real((5, 1), 7)),
        "scaled stacked": Scaled(stacked, -2),
        "stacked twice": Stacked((Scaled(stacked, (1, real((2,), 9))), Masked(matrix, valid))),
    }


NAMES = tuple(operators())
