r"""Light that no image casts through a separable camera: noise, and hot or dead pixels.

With projections P and Q onto the columns of its matrices, of all terms, captures are
:math:`G = P G Q` but for their noise. The rest, :math:`G - P G Q`, shows the noise whatever the
image is, where a code as fine as a pixel hides it from a look at the finest detail.
"""

import math
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from thincam_jax._core.precision import product
from thincam_jax.imaging.operators import AbstractOperator, Separable
from thincam_jax.reconstruction.problem import or_one

_LEAST = 64  # dimensions that no image reaches, from which a variance is known
_FILLINGS, _STILL = 30, 0.01  # of pixels that are not valid, at most, and the last change
# Of a lone pixel: standard deviations and part of the range that it exceeds, the part of a pixel
# that images leave, and rounds in which the largest are found.
_CERTAIN, _RANGE, _LEFT, _ROUNDS = 10.0, 0.02, 0.1, 12
_CLASSES = 32  # of brightness, each with its own noise
_FEW = 20  # pixels, or a hundredth


def unseen_variance(
    operators: Sequence[AbstractOperator],
    captures: Sequence[Float[Array, "*batch y x"]],
    valid: Sequence[Bool[Array, "*batch y x"] | None],
    found: Float[Array, " capture"],
) -> Float[Array, " capture"]:
    """The lower of a variance `found` and that of what no image casts through a separable camera.

    Both are too high at worst: that of the finest detail where the code is as fine as a pixel, that
    of the rest by light that the model lacks.
    """
    least = list(found)
    for n, operator in enumerate(operators):
        if isinstance(operator, Separable):
            known = jnp.ones((), bool) if valid[n] is None else valid[n]
            unseen = _variance(operator.left, operator.right, captures[n], known)
            least[n] = jnp.where(unseen > 0, jnp.minimum(found[n], unseen), found[n])
    return jnp.stack(least)


@jax.jit
def _variance(left: Float[Array, "k y m"], right: Float[Array, "k x n"], capture, valid):
    """Variance of a capture outside of the columns of two matrices; 0 where too little is.

    Pixels that are not valid are filled. A uniform background is left out.
    """
    valid = jnp.broadcast_to(valid, capture.shape)
    both = jnp.stack([capture, jnp.ones_like(capture)])
    _, (lost, even), used = _filled(left, right, both, valid)
    size = jnp.sum(even**2, axis=(-2, -1), keepdims=True)
    level = jnp.sum(lost * even, axis=(-2, -1), keepdims=True) / or_one(size)
    unseen = jnp.where(valid, lost - level * even, 0)
    freedom = jnp.sum(valid.astype(capture.dtype), axis=(-2, -1)) - used
    total = jnp.sum(unseen**2) / or_one(jnp.sum(freedom))
    return jnp.where(jnp.min(freedom) >= _LEAST, total, 0)


@jax.jit
def filled_by_images(
    operator: Separable, capture: Float[Array, "*batch y x"], valid: Bool[Array, "..."]
) -> Float[Array, "*batch y x"]:
    """A capture whose pixels that are not valid are what an image casts there."""
    valid = jnp.broadcast_to(valid, capture.shape)
    return _filled(operator.left, operator.right, capture, valid)[0]


def _filled(left, right, captures, valid):
    """Captures, filled where they are not valid, their rest, and the dimensions of images."""
    bases = [jnp.linalg.qr(jnp.concatenate(list(one), axis=1))[0] for one in (left, right)]
    rows, columns = (product(basis, basis.T) for basis in bases)
    count = jnp.sum(valid.astype(captures.dtype), axis=(-2, -1), keepdims=True)
    middle = jnp.sum(jnp.where(valid, captures, 0), axis=(-2, -1), keepdims=True) / or_one(count)

    def beyond(captures):
        return captures - product(product(rows, captures), columns)

    def squares(lost):
        return jnp.sum(jnp.where(valid, lost, 0) ** 2)

    def fill(state):
        captures, lost, _, step = state
        captures = jnp.where(valid, captures, captures - lost)
        rest = beyond(captures)
        return captures, rest, squares(rest - lost) / or_one(squares(rest)), step + 1

    captures = jnp.where(valid, captures, middle)
    change = jnp.where(jnp.all(valid), 0.0, jnp.inf).astype(captures.dtype)
    start = (captures, beyond(captures), change, jnp.asarray(0))
    going = lambda state: (state[2] > _STILL**2) & (state[3] < _FILLINGS)  # noqa: E731
    captures, lost, *_ = jax.lax.while_loop(going, fill, start)
    return captures, lost, math.prod(basis.shape[1] for basis in bases)


def unseen_defects(operator: Separable, plane: Float[np.ndarray, "y x"]) -> Bool[np.ndarray, "y x"]:
    """Map of single pixels of a capture that no image explains, and that noise does not."""
    bases = [
        np.linalg.qr(np.concatenate(list(np.asarray(one)), axis=1))[0]
        for one in (operator.left, operator.right)
    ]
    rows, columns = (basis @ basis.T for basis in bases)
    left = 1 - np.outer(np.diag(rows), np.diag(columns))
    found = np.zeros(plane.shape, bool)
    if left.sum() < _LEAST:
        return found

    def unseen(image):
        return image - rows @ image @ columns

    even, image = unseen(np.ones_like(plane)), plane
    middle, top = np.percentile(plane, [50, 99.5])
    floor = _RANGE * (top - middle)
    for _ in range(_ROUNDS):
        lost = unseen(image)
        lost = lost - np.sum(lost * even) / max(float(np.sum(even**2)), 1e-12) * even
        size = np.abs(lost) / np.sqrt(np.maximum(left, _LEFT))
        noise = _by_brightness(size, image - lost, ~found)
        odd = ~found & (left > _LEFT) & (size > _CERTAIN * noise)
        odd &= size > max(floor, size[~found].max() / 2)
        if not odd.any():
            break
        found |= odd
        y, x = np.nonzero(found)
        if y.size > max(_FEW, plane.size // 100):
            return np.zeros_like(found)
        # Their light, with the image eliminated.
        matrix = np.eye(y.size) - rows[np.ix_(y, y)] * columns[np.ix_(x, x)]
        image = plane.copy()
        image[y, x] -= np.linalg.lstsq(matrix, unseen(plane)[y, x], rcond=1e-6)[0]
    return found


def _by_brightness(size: np.ndarray, light: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Standard deviation by median of pixels as bright as each, the larger one of two classes."""
    ranked = np.flatnonzero(known)[np.argsort(light[known])]
    parts = np.array_split(ranked, _CLASSES)
    each = np.pad([np.median(size.flat[part]) / 0.6745 for part in parts], 1, mode="edge")
    noise = np.zeros(size.shape)
    for number, part in enumerate(parts):
        noise.flat[part] = each[number : number + 3].max()
    return noise
