r"""What is asked of an image besides its captures: R(f) = φ(Kf), and its proximal map."""

import abc
import functools
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.scipy.fft
import numpy as np
from jax.typing import DTypeLike
from jaxtyping import Array, Bool, Float

from thincam_jax._core.checks import Number
from thincam_jax._core.module import Module
from thincam_jax.reconstruction.wavelet import Wavelet

# What an image is to every solver.
Image = Float[Array, "*batch channel plane y x"]
Parts = tuple[Float[Array, "..."], ...]


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


def no_dual(regulariser: AbstractRegulariser, image: Image) -> Parts:
    """The dual of an image that is left as it is, to start `prox` with."""
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
    r"""The x that minimises step·R(x) + ½‖x − image‖², with x ≥ 0 where asked, and its dual.

    In closed form, x = Kᵀ shrink(K image), if K is orthonormal and no sign is asked. Shrinking and
    cutting off what is negative do not commute, so that together there is no closed form. As for
    total variation, the dual problem then is solved, whose solution gives that of both at once,

    .. math:: x = P(v - K^T p),\qquad
        p = \arg\min_{\varphi^*(p / step) \le 1} \tfrac12\|P(v - K^T p)\|^2 + \dots

    by accelerated projected gradients, with P the projection on what is allowed (Beck and Teboulle,
    IEEE Trans. Image Process. 18, 2419, 2009, algorithm FGP). The projection of p is what
    `shrink` takes away (Moreau).

    After a fixed number of `iterations` x is inexact. Within an outer iteration hand the `dual`
    of the last call back in: the inner problems change little, and the error goes to zero.
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
        # Without restart: a map cut short stays continuous, which outer iterations ask for.
        return after, *run_on(before, lead, after, t, restart=False)

    start = (dual, dual, first_t(image))
    dual, _, _ = jax.lax.fori_loop(0, iterations, body, start)
    return allowed(dual), dual


def run_on(
    before: Parts, lead: Parts, after: Parts, t: Float[Array, "..."], *, restart: bool = True
) -> tuple[Parts, Float[Array, "..."]]:
    r"""Where the next gradient is taken, beyond a step from `lead` to `after`, and the next t.

    Nesterov's momentum in the sequence of Beck and Teboulle (SIAM J. Imaging Sci. 2, 183, 2009). It
    starts anew where it points uphill, ⟨lead − after, after − before⟩ > 0: the gradient scheme of
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


def first_t(image: Image) -> Float[Array, "*batch 1 1 1 1"]:
    """The t to start `run_on` with."""
    return jnp.ones((*image.shape[:-4], 1, 1, 1, 1), image.dtype)


def denoise(
    image: Image,
    step: Number,
    regulariser: AbstractRegulariser,
    *,
    nonnegative: bool = False,
    iterations: int = 100,
) -> Image:
    r"""The image x that minimises ½‖x − image‖² + step·R(x), with x ≥ 0 where asked.

    With R = TV it is denoising by Rudin, Osher and Fatemi. The larger `step` is against the
    differences in the image, the more of them it takes; `step` has the unit of the image.
    """
    step = jnp.asarray(step, image.dtype)
    return _denoise(image, step, regulariser, nonnegative, iterations)


@functools.partial(jax.jit, static_argnames=("nonnegative", "iterations"))
def _denoise(image, step, regulariser, nonnegative: bool, iterations: int):
    dual = no_dual(regulariser, image)
    return prox(regulariser, image, step, dual, nonnegative=nonnegative, iterations=iterations)[0]


class Cosines(eqx.Module):
    """The orthonormal discrete cosine transform (DCT-II) over the last two axes."""

    def analyse(self, image: Float[Array, "*batch y x"]) -> Float[Array, "*batch y x"]:
        """The coefficients of an image, zero frequency first."""
        return jax.scipy.fft.dctn(image, axes=(-2, -1), norm="ortho")

    def synthesise(self, coefficients: Float[Array, "*batch y x"]) -> Float[Array, "*batch y x"]:
        """The image of coefficients: the transpose and inverse of `analyse`."""
        return jax.scipy.fft.idctn(coefficients, axes=(-2, -1), norm="ortho")

    def coarse_shape(self, shape: tuple[int, int]) -> tuple[int, int]:
        """The mean is one coefficient."""
        return 1, 1


class Sparsity(AbstractRegulariser):
    r"""R(f) = Σ |details of f| in an orthonormal basis, each plane and channel by itself.

    The coarse coefficients (of cosines: the mean) are free, so that an even image costs nothing and
    its brightness is not drawn to zero. R is a seminorm.

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
        """Where the coarse coefficients stand."""
        sizes = zip(shape[-2:], self.basis.coarse_shape(shape[-2:]), strict=True)
        y, x = (jnp.asarray(np.arange(n) < coarse) for n, coarse in sizes)
        return y[:, None] & x
