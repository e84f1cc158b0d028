r"""Regularisers R(f) = φ(Kf), their proximal maps, and orthonormal bases for sparsity."""

import abc
import functools
import math
from typing import ClassVar, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.scipy.fft
import numpy as np
from jax.typing import DTypeLike
from jaxtyping import Array, Bool, Float

from thincam_jax._core import checks
from thincam_jax._core.checks import Number
from thincam_jax._core.module import Module

# Images in all solvers.
Image = Float[Array, "*batch channel plane y x"]

Parts = tuple[Float[Array, "..."], ...]

Family = Literal["haar", "daubechies4", "daubechies8"]

_ROOT3 = math.sqrt(3.0)

# Scaling filters: the number is their length; vanishing moments are half as many.
FILTERS: dict[str, tuple[float, ...]] = {
    "haar": (math.sqrt(0.5), math.sqrt(0.5)),
    "daubechies4": tuple(
        c / (4 * math.sqrt(2.0)) for c in (1 + _ROOT3, 3 + _ROOT3, 3 - _ROOT3, 1 - _ROOT3)
    ),
    "daubechies8": (
        0.23037781330885523,
        0.7148465705525415,
        0.6308807679295904,
        -0.02798376941698385,
        -0.18703481171888114,
        0.030841381835986965,
        0.032883011666982945,
        -0.010597401784997278,
    ),
}


class AbstractRegulariser(Module):
    r"""R(f) = φ(K f) of images (*batch, channel, plane, y, x), K linear, φ a norm or a seminorm."""

    # Whether KᵀK = KKᵀ = 1, which gives a proximal map in closed form.
    orthonormal: ClassVar[bool]

    @abc.abstractmethod
    def __call__(self, image: Image) -> Float[Array, "*batch"]:
        """R of each batch element."""

    @abc.abstractmethod
    def analyse(self, image: Image) -> Parts:
        """K f."""

    @abc.abstractmethod
    def synthesise(self, parts: Parts) -> Image:
        """Kᵀ of parts."""

    @abc.abstractmethod
    def shrink(self, parts: Parts, step: Number) -> Parts:
        """The parts u that minimise step·φ(u) + ½‖u − parts‖²."""

    @abc.abstractmethod
    def squared_norm(self, dtype: DTypeLike) -> Float[Array, ""]:
        """A bound of ‖K‖²."""


def zero_dual(regulariser: AbstractRegulariser, image: Image) -> Parts:
    """The zero dual, to start `prox` with."""
    shapes = jax.eval_shape(regulariser.analyse, image)
    return tuple(jnp.zeros(s.shape, s.dtype) for s in shapes)


def prox(
    regulariser: AbstractRegulariser,
    image: Image,
    step: Number,
    dual: Parts,
    *,
    nonnegative: bool,
    iterations: int,
) -> tuple[Image, Parts]:
    r"""The x that minimises step·R(x) + ½‖x − image‖², with x ≥ 0 if constrained, and its dual.

    In closed form, x = Kᵀ shrink(K image), if K is orthonormal and the sign is free. Shrinking and
    clipping do not commute, so with x ≥ 0 there is no closed form. Then, as for total variation,
    the dual problem is solved,

    .. math:: x = P(v - K^T p),\qquad
        p = \arg\min_{\varphi^*(p / step) \le 1} \tfrac12\|P(v - K^T p)\|^2 + \dots

    by accelerated projected gradients, with P the projection on the constraint (Beck and Teboulle,
    IEEE Trans. Image Process. 18, 2419, 2009, algorithm FGP). The projection of p is the part that
    `shrink` removes (Moreau).

    After a fixed number of `iterations` x is inexact. In an outer iteration pass the `dual` of the
    last call: the inner problems change little, and the error goes to zero.
    """
    if regulariser.orthonormal and not nonnegative:
        return regulariser.synthesise(regulariser.shrink(regulariser.analyse(image), step)), dual
    rate = 1 / regulariser.squared_norm(image.dtype)

    def allowed(parts):
        rest = image - regulariser.synthesise(parts)
        return jnp.maximum(rest, 0) if nonnegative else rest

    def body(_, carry):
        before, lead, t = carry
        slopes = regulariser.analyse(allowed(lead))
        moved = tuple(p + rate * s for p, s in zip(lead, slopes, strict=True))
        shrunk = regulariser.shrink(moved, step)
        after = tuple(m - s for m, s in zip(moved, shrunk, strict=True))
        # Without restart: a truncated map stays continuous, which outer iterations need.
        return after, *extrapolated(before, lead, after, t, restart=False)

    start = (dual, dual, first_momentum(image))
    dual, _, _ = jax.lax.fori_loop(0, iterations, body, start)
    return allowed(dual), dual


def extrapolated(
    before: Parts, lead: Parts, after: Parts, t: Float[Array, "..."], *, restart: bool = True
) -> tuple[Parts, Float[Array, "..."]]:
    r"""The point of the next gradient after a step from `lead` to `after`, and the next t.

    Nesterov's momentum with the t of Beck and Teboulle (SIAM J. Imaging Sci. 2, 183, 2009). It
    restarts where it points uphill, ⟨lead − after, after − before⟩ > 0: the gradient scheme of
    O'Donoghue and Candès (Found. Comput. Math. 15, 715, 2015). Near the minimum, where an
    objective is about quadratic, convergence is then linear at the best rate. Each batch
    element has its own t, (*batch, 1, 1, 1, 1).
    """
    later = (1 + jnp.sqrt(1 + 4 * t**2)) / 2
    speed = (t - 1) / later
    if restart:
        products = ((y - x) * (x - b) for b, y, x in zip(before, lead, after, strict=True))
        uphill = sum(jnp.sum(p, axis=(-4, -3, -2, -1), keepdims=True) for p in products) > 0
        speed, later = jnp.where(uphill, 0, speed), jnp.where(uphill, 1, later)
    ahead = tuple(x + speed * (x - b) for b, x in zip(before, after, strict=True))
    return ahead, later


def first_momentum(image: Image) -> Float[Array, "*batch 1 1 1 1"]:
    """The initial t of `extrapolated`."""
    return jnp.ones((*image.shape[:-4], 1, 1, 1, 1), image.dtype)


class Wavelet(eqx.Module):
    r"""An orthonormal wavelet transform over the last two axes, for images of any size.

    A line x of even length n is split in two halves by a filter h and its mirror,

    .. math:: a_k = \sum_m h_m x_{(2k + m) \bmod n},\qquad
        d_k = \sum_m (-1)^m h_{M-1-m} x_{(2k + m) \bmod n},

    an orthonormal map, periodic at the border (Daubechies, Commun. Pure Appl. Math. 41, 909, 1988).
    The last sample of a line of odd length joins the coarse half unchanged, so that the map is
    orthonormal for every length. Lines and columns are split in turn; then the coarse quarter
    again. The coefficients have the shape of the image, with the coarse ones of `coarse_shape` in
    the upper left corner.

    - `family`: "haar", for edges along the axes; "daubechies4" and "daubechies8", for smoother
      images.
    - `levels`: how often the coarse part is split, at most until one sample is left.
    """

    family: Family = eqx.field(static=True)
    levels: int = eqx.field(static=True)

    def __init__(self, family: Family = "daubechies4", levels: int = 4):
        self.family = checks.choice("family", family, tuple(FILTERS))  # type: ignore[assignment]
        if levels < 1:
            raise ValueError(f"levels = {levels}: give at least 1")
        self.levels = levels

    def analyse(self, image: Float[Array, "*batch y x"]) -> Float[Array, "*batch y x"]:
        """The coefficients of an image."""
        return _analyse(image, self.family, self._shapes(_size(image)))

    def synthesise(self, coefficients: Float[Array, "*batch y x"]) -> Float[Array, "*batch y x"]:
        """The image of coefficients: the transpose and inverse of `analyse`."""
        return _synthesise(coefficients, self.family, self._shapes(_size(coefficients)))

    def coarse_shape(self, shape: tuple[int, int]) -> tuple[int, int]:
        """Size of the coarse part after all splits."""
        return _half(self._shapes(shape)[-1])

    def _shapes(self, shape: tuple[int, int]) -> tuple[tuple[int, int], ...]:
        """Sizes of the coarse part before each split."""
        shapes = [shape]
        for _ in range(self.levels - 1):
            shapes.append(_half(shapes[-1]))
        return tuple(shapes)


class Cosines(eqx.Module):
    """The orthonormal discrete cosine transform (DCT-II) over the last two axes."""

    def analyse(self, image: Float[Array, "*batch y x"]) -> Float[Array, "*batch y x"]:
        """The coefficients of an image, zero frequency first."""
        return jax.scipy.fft.dctn(image, axes=(-2, -1), norm="ortho")

    def synthesise(self, coefficients: Float[Array, "*batch y x"]) -> Float[Array, "*batch y x"]:
        """The image of coefficients: the transpose and inverse of `analyse`."""
        return jax.scipy.fft.idctn(coefficients, axes=(-2, -1), norm="ortho")

    def coarse_shape(self, shape: tuple[int, int]) -> tuple[int, int]:
        """Size of the coarse part: the mean is one coefficient."""
        return 1, 1


class Sparsity(AbstractRegulariser):
    r"""R(f) = Σ |details of f| in an orthonormal basis, of each plane and channel.

    The coarse coefficients (of cosines: the mean) are not penalised, so that R of a uniform image
    is 0 and its brightness is not drawn to zero. R is a seminorm.

    - `basis`: `Wavelet` or `Cosines`.
    """

    orthonormal: ClassVar[bool] = True
    basis: Wavelet | Cosines

    def __init__(self, basis: Wavelet | Cosines | None = None):
        self.basis = Wavelet() if basis is None else basis

    def __call__(self, image: Image):
        (details,) = self.analyse(image)
        counted = jnp.where(self._free(details.shape), 0, jnp.abs(details))
        return jnp.sum(counted, axis=(-4, -3, -2, -1))

    def analyse(self, image: Image):
        return (self.basis.analyse(image),)

    def synthesise(self, parts: Parts):
        return self.basis.synthesise(parts[0])

    def shrink(self, parts: Parts, step: Number):
        (details,) = parts
        shrunk = jnp.sign(details) * jnp.maximum(jnp.abs(details) - step, 0)
        return (jnp.where(self._free(details.shape), details, shrunk),)

    def squared_norm(self, dtype: DTypeLike):
        return jnp.ones((), dtype)

    def _free(self, shape) -> Bool[Array, "y x"]:
        """Mask of the coarse coefficients."""
        sizes = zip(shape[-2:], self.basis.coarse_shape(shape[-2:]), strict=True)
        y, x = (jnp.asarray(np.arange(n) < coarse) for n, coarse in sizes)
        return y[:, None] & x


@functools.partial(jax.jit, static_argnames=("family", "shapes"))
def _analyse(image, family: str, shapes):
    result = image
    for rows, columns in shapes:
        coarse = _split(_split(result[..., :rows, :columns], family, -2), family, -1)
        result = result.at[..., :rows, :columns].set(coarse)
    return result


@functools.partial(jax.jit, static_argnames=("family", "shapes"))
def _synthesise(coefficients, family: str, shapes):
    result = coefficients
    for rows, columns in reversed(shapes):
        fine = _join(_join(result[..., :rows, :columns], family, -1), family, -2)
        result = result.at[..., :rows, :columns].set(fine)
    return result


def _size(image: Array) -> tuple[int, int]:
    rows, columns = image.shape[-2:]
    return rows, columns


def _half(shape: tuple[int, int]) -> tuple[int, int]:
    rows, columns = shape
    return (rows + 1) // 2, (columns + 1) // 2


def _split(line: Float[Array, "..."], family: str, axis: int) -> Float[Array, "..."]:
    """Coarse and detail halves of the lines along an axis, concatenated."""
    line = jnp.moveaxis(line, axis, -1)
    even = line.shape[-1] // 2 * 2
    body, rest = line[..., :even], line[..., even:]
    coarse = detail = jnp.zeros_like(body[..., ::2])
    for m, (low, high) in enumerate(_filters(family)):
        taken = jnp.roll(body, -m, axis=-1)[..., ::2]
        coarse, detail = coarse + low * taken, detail + high * taken
    return jnp.moveaxis(jnp.concatenate([coarse, rest, detail], axis=-1), -1, axis)


def _join(line: Float[Array, "..."], family: str, axis: int) -> Float[Array, "..."]:
    """The transpose of `_split`."""
    line = jnp.moveaxis(line, axis, -1)
    half = line.shape[-1] // 2
    coarse, rest, detail = jnp.split(line, [half, line.shape[-1] - half], axis=-1)
    body = jnp.zeros((*line.shape[:-1], 2 * half), line.dtype)
    for m, (low, high) in enumerate(_filters(family)):
        spread = jnp.zeros_like(body).at[..., ::2].set(low * coarse + high * detail)
        body = body + jnp.roll(spread, m, axis=-1)
    return jnp.moveaxis(jnp.concatenate([body, rest], axis=-1), -1, axis)


def _filters(family: str) -> list[tuple[float, float]]:
    low = np.array(FILTERS[family])
    high = low[::-1] * (-1.0) ** np.arange(len(low))
    return list(zip(low.tolist(), high.tolist(), strict=True))
