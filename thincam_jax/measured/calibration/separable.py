r"""The matrices of a FlatCam from captures of stripes, or of a few known images.

With row i of the image, and then column j, shown as a stripe, the captures are

.. math:: G_i = P e_i\,(Q 1)^T, \qquad G'_j = P 1\,(Q e_j)^T

of rank one (Asif et al., IEEE Trans. Comput. Imaging 3, 384, 2017, section V). Their columns are
those of P, their rows those of Q. All stripes of one direction share a factor, Q1 or P1, which one
joint decomposition finds even where single stripes are lost in noise.
"""

import math
from dataclasses import dataclass
from typing import Literal, get_args

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Num

from thincam_jax._core import checks
from thincam_jax._core.arguments import checked
from thincam_jax._core.module import Module
from thincam_jax._core.precision import allow, cast, precision_of
from thincam_jax._core.progress import watched
from thincam_jax.imaging.operators import Separable
from thincam_jax.measured.calibration.hadamard import natural_rows, walsh_hadamard

Shown = Literal["stripes", "hadamard"]
# A second singular value is reported above this multiple of its noise, and of the first one.
_SIGNIFICANT, _RELEVANT = 1.5, 0.02
# Weights of the start, relative to the Gram matrix: from a stiff fit to a nearly free one.
_WEIGHTS = 10.0 ** -np.arange(11)
_HELD_OUT = 4  # one capture in so many, at least one
_STEPS = 60  # of conjugate gradients, for the images held out


class SeparableFit(Module):
    """A measured separable camera.

    - `operator`: for images that are 1 where the monitor is white.
    - `residual`: relative L2 residual of the captures, noise included; of those held out by
      `fit_separable`.
    - `status`: "ok", "converged", or "iterations_exhausted".
    - `reason`: warning about captures that one term does not explain; else empty.
    """

    operator: Separable
    residual: float
    status: str
    reason: str


@checked
@watched("calibrating the camera")
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

    ```python
    import numpy as np
    import thincam_jax as tc

    P, Q = np.random.default_rng(0).normal(size=(2, 6, 4))
    rows = np.stack([np.outer(p, Q.sum(axis=1)) for p in P.T])  # captures of lit rows
    columns = np.stack([np.outer(P.sum(axis=1), q) for q in Q.T])
    fit = tc.measured.calibration.calibrate_separable(rows, columns)
    ```

    **See also**: `fit_separable`, `separable_operator`.
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


@checked
@watched("fitting the camera")
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

    for all P_k and for all Q_k in turn, each a linear problem (alternating least squares), held
    near the start. There are far more numbers than captures determine, so every fourth capture is
    held out, the last one first, and the weight of the start falls by tens. Of the matrices that
    explain the captures held out better than the start *and* reconstruct their images better, those
    with the least product of both errors are returned, else the start. (Captures alone would judge
    wrongly: glare, which no P and Q make, lets their residual fall while images get worse.) In
    double precision, whatever that of the captures.

    Correlation of another scene (22×27 pixels, 8 images, 40 dB), with the start, the fit, and a fit
    without hold:

    | images | start | start | fit | free fit |
    |---|---|---|---|---|
    | random | scale 1 % off, no shading | 0.769 | 0.977 | 0.989 |
    | smooth | the same | 0.769 | 0.992 | 0.003 |
    | random, 20 % glare | nearly right | 0.895 | 0.913 | 0.611 |
    | smooth, 20 % glare | nearly right | 0.895 | 0.916 | 0.000 |

    Random images are best; photographs hold hardly any fine detail, and matrices fitted to them are
    right for photographs only.

    **Arguments**

    - `images`, `captures`: at least four, minus the dark level. Two or fewer, beside those held
      out, do not distinguish P X Qᵀ from P G X H Qᵀ.
    - `start`: from stripes or from the design of the camera (`separable_operator`), with the
      number of terms to fit.
    - `iterations`: at most, with each weight. `tolerance`: change of the residual, relative to the
      captures, at which they end.

    **Errors**: ValueError for numbers and sizes that do not fit.

    ```python
    import jax.numpy as jnp
    import numpy as np
    import thincam_jax as tc
    from thincam_jax.imaging.operators import Separable

    rng = np.random.default_rng(0)
    truth = Separable(rng.normal(size=(6, 3)), rng.normal(size=(5, 4)))
    images = jnp.asarray(rng.random((8, 3, 4)))
    start = Separable(1.1 * truth.left, truth.right)
    fit = tc.measured.calibration.fit_separable(images, truth(images), start)
    ```

    **See also**: `measured.calibration.calibrate_separable`.
    """
    images, captures = jnp.asarray(images), jnp.asarray(captures)
    expected = (len(images), *start.in_shape), (len(images), *start.out_shape)
    if (images.shape, captures.shape) != expected:
        raise ValueError(
            f"images have shape {images.shape} and captures {captures.shape}; the camera takes "
            f"(j, {start.in_shape[0]}, {start.in_shape[1]}) and (j, {start.out_shape[0]}, "
            f"{start.out_shape[1]})"
        )
    if len(images) < 4:
        raise ValueError(f"{len(images)} images do not tell one camera from others; give 4 or more")
    if iterations < 1:
        raise ValueError(f"iterations = {iterations}; give a whole number of at least 1")
    if not bool(jnp.isfinite(images).all() & jnp.isfinite(captures).all()):
        raise ValueError("images or captures hold NaN or infinity; leave such frames out")
    precision, held = precision_of(captures), np.arange(len(images))[::-1] % _HELD_OUT == 0
    with allow("float64", captures):
        images, captures, start = cast((images, captures, start), "float64")
        shown, held_out = ((images[k], captures[k]) for k in (~held, held))
        first = best = pair = start.left, start.right
        before = _held_out_errors(*held_out, best)
        least, status = before, "converged"
        for weight in _WEIGHTS:
            pair, ended = _alternate(shown, first, pair, weight, tolerance, iterations)
            errors = _held_out_errors(*held_out, pair)
            if np.all(errors < before) and np.prod(errors) < np.prod(least):
                best, least = pair, errors
                status = "converged" if bool(ended) else "iterations_exhausted"
        operator = Separable(best[0], best[1])
    reason = "" if least is not before else "the start explains the images held out best"
    return SeparableFit(cast(operator, precision), float(least[1]), status, reason)


def _held_out_errors(images, captures, pair) -> np.ndarray:
    """Relative errors of the images held out and of their captures."""
    of_each = _image_error(images, captures, pair), _residual(images, captures, pair)
    return np.array([float(error) for error in of_each])


@jax.jit
def _residual(images, captures, pair):
    """Relative residual of captures."""
    seen = jnp.einsum("kym,jmn,kxn->jyx", pair[0], images, pair[1], precision="highest")
    size = jnp.sqrt(jnp.sum(captures**2))
    return jnp.sqrt(jnp.sum((seen - captures) ** 2)) / jnp.where(size > 0, size, 1)


@jax.jit
def _image_error(images, captures, pair):
    """1 − correlation of images with their linear estimates, by the best of some ridges."""
    left, right = pair
    grams = (jnp.einsum("kym,lym->kl", part, part, precision="highest") for part in pair)
    mean = jnp.sum(math.prod(grams)) / math.prod(images.shape[1:])
    back = jnp.einsum("kym,jyx,kxn->jmn", left, captures, right, precision="highest")

    def error(ridge):
        def normal(image):
            seen = jnp.einsum("kym,jmn,kxn->jyx", left, image, right, precision="highest")
            return (
                jnp.einsum("kym,jyx,kxn->jmn", left, seen, right, precision="highest")
                + ridge * mean * image
            )

        found, _ = jax.scipy.sparse.linalg.cg(normal, back, maxiter=_STEPS)
        off, true = (a - a.mean(axis=(1, 2), keepdims=True) for a in (found, images))
        sizes = [jnp.sum(a**2, axis=(1, 2)) for a in (off, true)]
        scale = jnp.sqrt(jnp.maximum(math.prod(sizes), jnp.finfo(off.dtype).tiny))
        return 1 - jnp.mean(jnp.sum(off * true, axis=(1, 2)) / scale)

    return jnp.min(jax.lax.map(error, jnp.logspace(0, -5, 6, dtype=back.dtype)))


@jax.jit(static_argnames="iterations")
def _alternate(shown, first, pair, weight, tolerance, iterations: int):
    """P and Q held near the first ones, and whether the residual has become constant."""
    images, captures = shown
    turned = jnp.swapaxes(images, 1, 2), jnp.swapaxes(captures, 1, 2)

    def step(carry):
        (left, right), before, _, count = carry
        left = _solved(images, captures, right, first[0], weight)
        right = _solved(*turned, left, first[1], weight)
        missed = _residual(images, captures, (left, right))
        return (left, right), missed, jnp.abs(before - missed), count + 1

    def unfinished(carry):
        *_, change, count = carry
        return (change > tolerance) & (count < iterations)

    infinite = jnp.full((), jnp.inf, captures.dtype)
    pair, _, change, _ = jax.lax.while_loop(unfinished, step, (pair, infinite, infinite, 0))
    return pair, change <= tolerance


def _solved(images, captures, other, start, weight):
    """All P_k that fit the captures best for given Q_k, held near those of the start."""
    terms, rows, m = start.shape
    seen = jnp.einsum("jmn,kxn->jkmx", images, other, precision="highest")
    seen = seen.reshape(len(images), terms * m, -1)
    gram = jnp.einsum("jax,jbx->ab", seen, seen, precision="highest")
    hold = weight * jnp.trace(gram) / len(gram) + jnp.finfo(start.dtype).tiny
    flat = jnp.swapaxes(start, 0, 1).reshape(rows, -1)
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
