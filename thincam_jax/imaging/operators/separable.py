"""A camera whose rows and columns are coded independently, or that is a sum of few such cameras."""

import functools
import math

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, DTypeLike, Float, PRNGKeyArray

from thincam_jax._core import checks
from thincam_jax._core.checks import Number, Numbers
from thincam_jax._core.precision import product
from thincam_jax.imaging.operators.base import AbstractOperator, real_numbers, require_shape


class SeparableModes(eqx.Module):
    r"""The images that a separable camera captures independently: F = v_i w_jᵀ.

    - `rows`: V, (m, m), and `columns`: W, (n, n), an orthonormal vector a column.
    - `values`: (m, n), the singular values of A, exactly for one term. For several, the roots of
      the diagonal of AᵀA in modes that suit the mean of the terms.
    - `seen_rows`, `seen_columns`: V and W of one term as captured by the sensor, the left singular
      vectors (y, m) and (x, n); zero where no light arrives.
    """

    rows: Float[Array, "m m"]
    columns: Float[Array, "n n"]
    values: Float[Array, "m n"]
    seen_rows: Float[Array, "y m"] | None
    seen_columns: Float[Array, "x n"] | None

    def seen(self, captures: Float[Array, "*batch y x"]) -> Float[Array, "*batch m n"]:
        """Coefficient of each mode of one term in captures, ĝ."""
        if self.seen_rows is None or self.seen_columns is None:
            raise ValueError(
                "these are modes of several terms; give those of one, truncated(terms=1).operator"
            )
        return product(product(self.seen_rows.T, captures), self.seen_columns)

    def uniform(self) -> Float[Array, "m n"]:
        """Coefficient of each mode of one term in a capture of 1."""
        assert self.seen_rows is not None and self.seen_columns is not None
        return jnp.outer(self.seen_rows.sum(axis=0), self.seen_columns.sum(axis=0))

    def image(self, coefficients: Float[Array, "*batch m n"]) -> Float[Array, "*batch m n"]:
        """Image of a coefficient of each mode."""
        return product(product(self.rows, coefficients), self.columns.T)


class Truncated(eqx.Module):
    """A sum of fewer terms, and its error on captures of white scenes, ‖difference‖_F/‖A‖_F.

    `errors`: errors with 1, 2, … terms.
    """

    operator: "Separable"
    error: Float[Array, ""]
    errors: Float[Array, " term"]


class Separable(AbstractOperator):
    r"""An image between two matrices, one for its rows and one for its columns, or a sum of those.

    .. math:: G = \sum_k P_k F Q_k^T, \qquad A^T G = \sum_k P_k^T G Q_k

    (FlatCam: Asif et al., IEEE Trans. Comput. Imaging 3, 384, 2017, Eq 3). One term is the shadow
    of a mask that is an outer product of two sequences. Masks of more products, diffraction and
    broadband light make it a few. For n×n images and captures, two matrices of n² numbers a term
    stand for one of n⁴, and a map costs 2n³ products a term.

    **Arguments**

    - `left`: P, (rows of the capture, rows of the image), or (k, …) of several terms.
    - `right`: Q, (columns of the capture, columns of the image), or (k, …).
    - `modes`: from `with_modes`, which see.
    """

    left: Float[Array, "k y m"]
    right: Float[Array, "k x n"]
    modes: SeparableModes | None

    def __init__(self, left: Numbers, right: Numbers, modes: SeparableModes | None = None):
        self.left, self.right = _matrices("left", left), _matrices("right", right)
        self.modes = modes
        if self.left.dtype != self.right.dtype:
            raise TypeError(
                f"left is {self.left.dtype} and right is {self.right.dtype}; give both in one "
                "precision"
            )
        if len(self.left) != len(self.right):
            raise ValueError(
                f"left has {len(self.left)} terms and right {len(self.right)}; give as many of each"
            )

    @property
    def in_shape(self) -> tuple[int, int]:
        return self.left.shape[2], self.right.shape[2]

    @property
    def out_shape(self) -> tuple[int, int]:
        return self.left.shape[1], self.right.shape[1]

    @property
    def terms(self) -> int:
        """Number of products in the sum."""
        return len(self.left)

    def __call__(self, image: Float[Array, "..."]) -> Float[Array, "..."]:
        require_shape("image", image, self.in_shape)
        return _between(self.left, image, self.right)

    def adjoint(self, capture: Float[Array, "..."]) -> Float[Array, "..."]:
        require_shape("capture", capture, self.out_shape)
        return _between(self.left, capture, self.right, adjoint=True)

    def _norm(self, iterations: int, key: PRNGKeyArray | None, dtype: DTypeLike | None):
        """The largest singular value: of one term exactly, without an iteration."""
        if self.terms > 1:
            return super()._norm(iterations, key, dtype)
        if self.modes is not None:
            return jnp.max(self.modes.values).astype(dtype or self.left.dtype)
        return jnp.linalg.norm(self.left[0], 2) * jnp.linalg.norm(self.right[0], 2)

    def mean_power(self) -> Float[Array, ""]:
        """Mean squared length of a column, exactly: Σ_kl of the terms' inner products."""
        return jnp.sum(_inner(self.left) * _inner(self.right)) / math.prod(self.in_shape)

    def with_modes(self) -> "Separable":
        """This operator with its modes, for reuse in all captures and channels.

        Two singular value decompositions for one term, two of Σ P_kᵀP_k and Σ Q_kᵀQ_k for
        several, once: some 0.2 s for 500×620 pixels and 256² of the image. Every solver uses them.
        They speed solutions up and carry no derivative; those of the camera are right all the same.
        """
        left, right = jax.lax.stop_gradient(self._pair)
        if self.terms == 1:
            (seen_rows, rows, s), (seen_columns, columns, t) = map(_singular, (left[0], right[0]))
            values = jnp.outer(s, t)
            modes = SeparableModes(rows, columns, values, seen_rows, seen_columns)
        else:
            # In units in which squares keep within the range of the precision.
            units = [jnp.max(jnp.abs(part)) for part in (left, right)]
            rows, columns = (
                jnp.linalg.eigh(_gram(part / jnp.where(unit > 0, unit, 1)))[1]
                for part, unit in zip((left, right), units, strict=True)
            )
            down, across = (
                jnp.einsum("kym,lym->klm", part, part, precision="highest")
                for part in (product(left, rows), product(right, columns))
            )
            power = jnp.einsum("klm,kln->mn", down, across, precision="highest")
            modes = SeparableModes(rows, columns, jnp.sqrt(jnp.maximum(power, 0)), None, None)
        return Separable(self.left, self.right, modes)

    def centred(self) -> "Separable":
        r"""The camera whose captures have their row and column means taken off.

        .. math:: (1 - J_y)\, G\, (1 - J_x) = \sum_k (P_k - \bar P_k) F (Q_k - \bar Q_k)^T

        with the means over the sensor. It is exact for any camera. A term that is uniform light
        on the sensor for every scene vanishes: the opaque half of a mask of ±1, if its shadow
        overfills the sensor for every point of the scene. Where a border of the shadow lies on
        the sensor the term stays, and `truncated` gives the error of one term.
        """
        left, right = (part - part.mean(axis=1, keepdims=True) for part in self._pair)
        return Separable(left, right)

    def truncated(self, tolerance: Number = 0.0, *, terms: int | None = None) -> Truncated:
        """The nearest sum of fewest terms (Van Loan and Pitsianis 1993), and its error.

        - `tolerance`: error that is allowed, relative Frobenius norm; it makes the number of terms
          known only outside of jit.
        - `terms`: their number in place of a tolerance.

        **Errors**: ValueError for a tolerance that is not 0 ≤ … < 1, and for less than one term.
        """
        if terms is not None and not 1 <= terms == int(terms):
            raise ValueError(f"terms = {terms}; give a whole number of at least 1")
        tolerance = checks.non_negative("tolerance", tolerance, "parts of one")
        if not checks.is_traced(tolerance) and float(tolerance) >= 1:
            raise ValueError(f"tolerance = {float(tolerance):g}; give less than 1 (0.01 is 1 %)")
        rows, columns, errors = orthogonal_terms(
            *(part.reshape(self.terms, -1) for part in self._pair)
        )
        if terms is None:
            known = [float(error) > float(tolerance) for error in errors[:-1]]
            terms = 1 + sum(known)
        terms = min(terms, len(errors))
        left = rows[:terms].reshape(terms, *self.left.shape[1:])
        right = columns[:terms].reshape(terms, *self.right.shape[1:])
        return Truncated(Separable(left, right), errors[terms - 1], errors)

    @property
    def _pair(self):
        return self.left, self.right


def centred(capture: Float[Array, "*batch y x"]) -> Float[Array, "*batch y x"]:
    """A capture with its row and column means taken off, as `Separable.centred` takes captures.

    White noise on it is no longer quite white: one mode in y and one in x are gone.
    """
    capture = capture - capture.mean(axis=-1, keepdims=True)
    return capture - capture.mean(axis=-2, keepdims=True)


@jax.jit
def orthogonal_terms(left: Float[Array, "k i"], right: Float[Array, "k j"]):
    """Σ_k left_k ⊗ right_k as a sum of orthogonal terms of falling size, and their errors.

    By the small matrix between orthonormal bases of both. The error of n terms is what the rest
    would add, relative to the root of the sum of all squares.
    """
    (down, a), (across, b) = (jnp.linalg.qr(part.T) for part in (left, right))
    u, values, v = jnp.linalg.svd(product(a, b.T))
    total = jnp.sum(values**2)
    rest = jnp.append(jnp.cumsum((values**2)[::-1])[::-1][1:], 0.0)
    errors = jnp.sqrt(rest / jnp.where(total > 0, total, 1))
    count = len(values)
    # The root on either side, so that both keep within the range of the precision.
    root = jnp.sqrt(values)[:, None]
    rows, columns = product(down, u[:, :count]).T, product(across, v[:count].T).T
    return root * rows, root * columns, errors


def _matrices(name: str, value) -> Float[Array, "k i j"]:
    """One or several matrices, with an axis for the terms."""
    array = real_numbers(name, value)
    if array.ndim not in (2, 3) or array.size == 0:
        raise ValueError(
            f"{name} has shape {array.shape}; give rows (capture) and columns (image), after the "
            "terms if there are several"
        )
    return array[None] if array.ndim == 2 else array


@jax.jit
def _singular(matrix: Float[Array, "y m"]):
    """U (y, m), V (m, m) and s (m): zero beyond min(y, m), where V spans the null space."""
    y, m = matrix.shape
    u, s, v = jnp.linalg.svd(matrix, full_matrices=m > y)
    more = m - len(s)
    u, s = jnp.pad(u, ((0, 0), (0, more))), jnp.pad(s, (0, more))
    return jnp.where(s > 0, u, 0), v.T, s


def _gram(parts: Float[Array, "k y m"]) -> Float[Array, "m m"]:
    return jnp.einsum("kym,kyl->ml", parts, parts, precision="highest")


def _inner(parts: Float[Array, "k i j"]) -> Float[Array, "k k"]:
    flat = parts.reshape(len(parts), -1)
    return product(flat, flat.T)


@functools.partial(jax.jit, static_argnames="adjoint")
def _between(left, image, right, adjoint=False):
    """Σ_k left_k · image · right_kᵀ or its adjoint, in the order of fewer products."""
    if adjoint:
        left = jnp.swapaxes(left, 1, 2)
    else:
        right = jnp.swapaxes(right, 1, 2)
    (_, rows, m), (_, n, columns) = left.shape, right.shape
    if rows * n * (m + columns) <= m * columns * (n + rows):
        middle = jnp.einsum("krm,...mn->...krn", left, image, precision="highest")
        return jnp.einsum("...krn,knc->...rc", middle, right, precision="highest")
    middle = jnp.einsum("...mn,knc->...kmc", image, right, precision="highest")
    return jnp.einsum("krm,...kmc->...rc", left, middle, precision="highest")
