r"""The matrices of a FlatCam from captures of stripes, or of a few known images.

With row i of the image, and then column j, shown as a stripe, the captures are

.. math:: G_i = P e_i\,(Q 1)^T, \qquad G'_j = P 1\,(Q e_j)^T

of rank one (Asif et al., IEEE Trans. Comput. Imaging 3, 384, 2017, section V). Their columns are
those of P, their rows those of Q. All stripes of one direction share a factor, Q1 or P1, which one
joint decomposition finds even where single stripes are lost in noise.
"""

from dataclasses import dataclass
from typing import Literal, get_args

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Num

from thincam_jax._core import checks
from thincam_jax._core.module import Module
from thincam_jax.imaging.operators import Separable
from thincam_jax.measured.calibration.hadamard import natural_rows, walsh_hadamard

Shown = Literal["stripes", "hadamard"]
# A second singular value is reported above this multiple of its noise, and of the first one.
_SIGNIFICANT, _RELEVANT = 1.5, 0.02
# Proximal weight of the previous estimate, relative to the Gram matrix.
_PROXIMAL = {"float32": 1e-5, "float64": 1e-9}


class SeparableFit(Module):
    """A measured separable camera.

    - `operator`: for images that are 1 where the monitor is white.
    - `residual`: relative L2 residual of the captures, noise included.
    - `status`: "ok", "converged", or "iterations_exhausted".
    - `reason`: warning about captures that one term does not explain; else empty.
    """

    operator: Separable
    residual: float
    status: str
    reason: str


def calibrate_separable(
    rows: Num[np.ndarray, "m y x"], columns: Num[np.ndarray, "n y x"], *, shown: Shown = "stripes"
) -> SeparableFit:
    """P and Q of one term from captures of stripes, minus their dark level.

    **Arguments**

    - `rows`, `columns`: captures of each row of the image fully lit, and of each column.
    - `shown`: "hadamard" if the stripes showed the rows of a Hadamard matrix of ±1 in sequency
      order (`HadamardSeries`): captures are then differences of complementary frames, and their
      number a power of two. Each stripe is measured in all of them, with 2/√n of the noise.

    The uniform part of a mask (1 + c dᵀ)/2 of codes ±1 makes a second term. `centred` captures are
    free of it if the shadow overfills the sensor; else `reason` warns, and `fit_separable` takes
    two terms.

    **Errors**: ValueError for captures that are no stacks of one size, or are dark.
    """
    checks.choice("shown", shown, get_args(Shown))
    stacks = [np.asarray(stack) for stack in (rows, columns)]
    if any(s.ndim != 3 or 0 in s.shape for s in stacks) or len({s.shape[1:] for s in stacks}) > 1:
        shapes = " and ".join(str(s.shape) for s in stacks)
        raise ValueError(
            f"rows and columns have shapes {shapes}; give (stripe, y, x), both of one sensor"
        )
    dtype = np.result_type(*stacks, np.float32)
    down, across = (_decoded(s.astype(dtype), shown) for s in stacks)
    left = _one_factor(down, "rows")
    right = _one_factor(np.swapaxes(across, 1, 2), "columns")
    # Both are |P1||Q1|, with the sign that the two factors' signs leave.
    scale = (left.shared @ right.own.sum(axis=1) + right.shared @ left.own.sum(axis=1)) / 2
    if scale == 0:
        raise ValueError("the captures are dark; light the stripes, or expose for longer")
    operator = Separable(left.own, right.own / scale)
    missed = np.hypot(left.rest, right.rest) / np.hypot(left.whole, right.whole)
    reason = "; ".join(filter(None, (left.reason, right.reason)))
    return SeparableFit(operator, float(missed), "ok", reason)


def fit_separable(
    images: Float[Array, "j m n"],
    captures: Float[Array, "j y x"],
    start: Separable,
    *,
    iterations: int = 200,
    tolerance: float = 1e-6,
) -> SeparableFit:
    r"""Matrices of one or several terms from captures of known images, by least squares.

    .. math:: \min \sum_j \Big\|\sum_k P_k X_j Q_k^T - G_j\Big\|^2

    for all P_k and for all Q_k in turn, each a linear problem (proximal alternating least squares).
    Random images are best.

    **Arguments**

    - `images`, `captures`: at least three, minus the dark level. Two or fewer do not distinguish
      P X Qᵀ from P G X H Qᵀ.
    - `start`: from stripes or from the design of the camera (`separable_operator`), with the
      number of terms to fit.
    - `iterations`: at most. `tolerance`: of the change of the residual, relative to the captures.

    **Errors**: ValueError for numbers and sizes that do not fit.
    """
    images, captures = jnp.asarray(images), jnp.asarray(captures)
    expected = (len(images), *start.in_shape), (len(images), *start.out_shape)
    if (images.shape, captures.shape) != expected:
        raise ValueError(
            f"images have shape {images.shape} and captures {captures.shape}; the camera takes "
            f"(j, {start.in_shape[0]}, {start.in_shape[1]}) and (j, {start.out_shape[0]}, "
            f"{start.out_shape[1]})"
        )
    if len(images) < 3:
        raise ValueError(f"{len(images)} images do not tell one camera from others; give 3 or more")
    if iterations < 1:
        raise ValueError(f"iterations = {iterations}; give a whole number of at least 1")
    dtype = captures.dtype
    size = jnp.sqrt(jnp.sum(captures**2))
    pair = start.left.astype(dtype), start.right.astype(dtype)
    limit = jnp.asarray(tolerance, dtype)
    left, right, missed, change = _alternate(
        images.astype(dtype), captures / jnp.where(size > 0, size, 1), pair, limit, iterations
    )
    status = "converged" if float(change) <= tolerance else "iterations_exhausted"
    if not bool(jnp.isfinite(missed)):
        raise ValueError("images or captures hold NaN or infinity; leave such frames out")
    return SeparableFit(Separable(left, right * size), float(missed), status, "")


@jax.jit(static_argnames="iterations")
def _alternate(images, captures, pair, tolerance, iterations: int):
    """P, Q, the residual and its last change, for captures of unit norm."""
    turned = jnp.swapaxes(images, 1, 2), jnp.swapaxes(captures, 1, 2)

    def step(carry):
        left, right, before, _, count = carry
        left = _solved(images, captures, right, left)
        right = _solved(*turned, left, right)
        seen = jnp.einsum("kym,jmn,kxn->jyx", left, images, right, precision="highest")
        missed = jnp.sqrt(jnp.sum((seen - captures) ** 2))
        return left, right, missed, jnp.abs(before - missed), count + 1

    def unfinished(carry):
        *_, change, count = carry
        return (change > tolerance) & (count < iterations)

    infinite = jnp.asarray(jnp.inf, captures.dtype)
    left, right, missed, change, _ = jax.lax.while_loop(
        unfinished, step, (*pair, infinite, infinite, 0)
    )
    return left, right, missed, change


def _solved(images, captures, other, last):
    """All P_k that fit the captures best for given Q_k, regularised towards the previous ones."""
    terms, rows, m = last.shape
    seen = jnp.einsum("jmn,kxn->jkmx", images, other, precision="highest")
    seen = seen.reshape(len(images), terms * m, -1)
    gram = jnp.einsum("jax,jbx->ab", seen, seen, precision="highest")
    hold = _PROXIMAL[str(last.dtype)] * jnp.trace(gram) / len(gram) + jnp.finfo(last.dtype).tiny
    flat = jnp.swapaxes(last, 0, 1).reshape(rows, -1)
    right = jnp.einsum("jax,jyx->ay", seen, captures, precision="highest") + hold * flat.T
    held = gram + hold * jnp.eye(len(gram), dtype=gram.dtype)
    found = jax.scipy.linalg.solve(held, right, assume_a="pos")
    return found.reshape(terms, m, rows).swapaxes(1, 2)


@dataclass(frozen=True, eq=False)
class _Factor:
    """Stripes as products with one shared vector.

    - `own`: (y, stripe). `shared`: (x), of unit norm. `whole`, `rest`: norms of the captures and of
      their residual. `reason`: warning about a second term.
    """

    own: np.ndarray
    shared: np.ndarray
    whole: float
    rest: float
    reason: str


def _one_factor(captures: Float[np.ndarray, "n y x"], what: str) -> _Factor:
    """Best approximation of the captures by p_i vᵀ, for stripes along `what`."""
    flat = captures.reshape(-1, captures.shape[2])
    squares, vectors = np.linalg.eigh(flat.T @ flat)
    shared = vectors[:, -1]
    squares = np.maximum(squares, 0)
    # The largest singular value of white noise is σ(√rows + √columns); σ follows from the median,
    # on which a few terms have no influence.
    rows, columns = flat.shape
    noise = np.sqrt(np.median(squares) / rows) * (np.sqrt(rows) + np.sqrt(columns))
    *_, second, first = np.sqrt([0.0, *squares])
    first, reason = max(first, 1e-150), ""
    if second >= max(_SIGNIFICANT * noise, _RELEVANT * first):
        reason = (
            f"stripes along {what} are no products of two vectors: a second one has "
            f"{100 * second / first:.0f} % of the first; centre the captures if the shadow "
            "overfills the sensor, else fit_separable with two terms"
        )
    whole, rest = (float(np.sqrt(part.sum())) for part in (squares, squares[:-1]))
    return _Factor((captures @ shared).T, shared, whole, rest, reason)


def _decoded(captures: Float[np.ndarray, "n y x"], shown: Shown) -> Float[np.ndarray, "n y x"]:
    """Captures of single stripes, by the inverse transform of Hadamard ones."""
    if shown == "stripes":
        return captures
    shown_at = np.argsort(natural_rows(len(captures), "sequency"))
    flat = captures.reshape(len(captures), -1)[shown_at]
    return (walsh_hadamard(flat) / len(captures)).T.reshape(captures.shape)
