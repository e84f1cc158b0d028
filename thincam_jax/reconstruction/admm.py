r"""ADMM for total variation that models the crop of the sensor: one iteration, as a map.

The image f, on a window that holds field and sensor, is split three ways, so that each part of the
objective has a proximal map in closed form and what ties them together is diagonal in the
Fourier domain:

.. math:: v_k = H_k f \;(\text{data, on the sensor}),\quad u = \Psi f \;(TV),\quad
    w = f \;(f \ge 0,\ 0 \text{ outside of the field})

This is the splitting of Almeida and Figueiredo (IEEE Trans. Image Process. 22, 3074, 2013) as used
for DiffuserCam (Antipa et al., Optica 5, 1, 2018). It is written here in the Douglas–Rachford form
(Eckstein and Bertsekas, Math. Program. 55, 293, 1992): with Kf = (Hf, Ψf, f), penalties μ and the
scaled duals λ, only q = Kf + λ is carried along,

.. math:: z = \mathrm{prox}(q),\quad f = (K^T M K)^{-1} K^T M (2z - q),\quad
    q \leftarrow q + \alpha\,(K f - z).

α = 1 is plain ADMM, 1 < α < 2 over-relaxes, α < 1 under-relaxes. This needs half of the usual
arrays, and q is the fixed point of one averaged map, which acceleration and implicit
differentiation ask for.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from thincam_jax.imaging.operators import CropConvolution
from thincam_jax.imaging.operators.crop_convolution import cut, place
from thincam_jax.reconstruction.normal import NormalInverse, mean_power, or_one, squared_modulus
from thincam_jax.reconstruction.problem import Deconvolution
from thincam_jax.reconstruction.total_variation import (
    TotalVariation,
    differences,
    differences_adjoint,
    field_masks,
    within_field,
)


class Penalties(eqx.Module):
    """μ of the three splits, in the units of `Splitting`."""

    data: Float[Array, ""]
    variation: Float[Array, ""]
    image: Float[Array, ""]


class State(eqx.Module):
    """q of the three splits, on the window."""

    data: tuple[Float[Array, "*batch channel v u"], ...]
    slopes: tuple[Float[Array, "*batch channel plane v u"], ...]
    image: Float[Array, "*batch channel plane v u"]


class Splitting(eqx.Module):
    r"""A problem in units in which captures, operators and weights are about 1.

    Whatever the units of the captures, iterations see the same numbers, and the image scales with
    the captures. The weight of a whole capture goes into its operator, as `gains`; `weights` then
    only tell its pixels apart.

    - `image_unit`: the image is that of `State`, times this.
    """

    operators: tuple[CropConvolution, ...]
    gains: tuple[Float[Array, ""], ...]
    captures: tuple[Float[Array, "*batch channel y x"], ...]
    weights: tuple[Float[Array, "..."], ...]
    tau: Float[Array, ""]
    variation: TotalVariation
    normal: NormalInverse
    image_unit: Float[Array, ""]
    nonnegative: bool = eqx.field(static=True)

    def __init__(self, problem: Deconvolution):
        stop = jax.lax.stop_gradient
        largest = [or_one(stop(jnp.max(w))) for w in problem.weights]
        roots = [jnp.sqrt(w) for w in largest]
        operator_unit = stop(_operator_unit(problem.operators, largest))
        sizes = [jnp.mean(w * c**2) for w, c in zip(problem.weights, problem.captures, strict=True)]
        capture_unit = stop(or_one(jnp.sqrt(sum(sizes) / len(sizes))))
        self.operators = problem.operators
        self.gains = tuple(r / operator_unit for r in roots)
        self.captures = tuple(
            c * (r / capture_unit) for r, c in zip(roots, problem.captures, strict=True)
        )
        self.weights = tuple(w / m for w, m in zip(problem.weights, largest, strict=True))
        self.tau = problem.tau / (operator_unit * capture_unit)
        self.variation = problem.variation
        self.normal = NormalInverse(problem.operators, self.gains, problem.variation.depth_weight)
        self.image_unit = capture_unit / operator_unit
        self.nonnegative = problem.nonnegative

    @property
    def depth_weight(self) -> Float[Array, ""]:
        return self.variation.depth_weight


def start(splitting: Splitting, image: Float[Array, "*batch channel plane y x"]) -> State:
    """The state of an image, with no forces yet."""
    operator = splitting.operators[0]
    field = place(image / splitting.image_unit, operator.field_corner, operator.window)
    return _images(splitting, jnp.fft.rfft2(field))


def image_of(splitting: Splitting, state: State) -> Float[Array, "*batch channel plane y x"]:
    """The image that a state stands for: non-negative if that is asked."""
    operator = splitting.operators[0]
    field = cut(state.image, operator.field_corner, operator.field_shape)
    image = jnp.maximum(field, 0) if splitting.nonnegative else field
    return image * splitting.image_unit


def step(splitting: Splitting, penalties: Penalties, relaxation, state: State) -> State:
    """One iteration: q + α (K f − z)."""
    # The barrier has it computed once: it enters the sum of differences and the update below.
    mirrored = jax.lax.optimization_barrier(reflected(splitting, penalties, state))
    images = _images(splitting, _solve(splitting, penalties, mirrored))
    return jax.tree.map(
        lambda q, m, k: q + relaxation * (k - 0.5 * (q + m)), state, mirrored, images
    )


def reflected(splitting: Splitting, penalties: Penalties, state: State) -> State:
    """2z − q, where z minimises each part of the objective plus μ/2 ‖z − q‖²."""
    operator, window = splitting.operators[0], splitting.operators[0].window
    masks = field_masks(operator.field_shape, window, operator.field_corner)
    data = [
        q + 2 * _data_pull(o, capture, weight, penalties.data, q)
        for q, o, capture, weight in zip(
            state.data, splitting.operators, splitting.captures, splitting.weights, strict=True
        )
    ]
    framed = within_field(state.slopes, masks)
    shrunk = splitting.variation.prox(framed, splitting.tau / penalties.variation)
    slopes = [q + 2 * (z - f) for q, z, f in zip(state.slopes, shrunk, framed, strict=True)]
    y, x = masks[-1]
    allowed = jnp.abs(state.image) if splitting.nonnegative else state.image
    return State(tuple(data), tuple(slopes), jnp.where(y & x, allowed, -state.image))


def _data_pull(operator: CropConvolution, capture, weight, penalty, q):
    """z − q of a capture: zero beside the sensor, where nothing is known."""
    seen = cut(q, operator.sensor_corner, operator.sensor_shape)
    pull = weight / (weight + penalty) * (capture - seen)
    return place(pull, operator.sensor_corner, operator.window)


def _solve(splitting: Splitting, penalties: Penalties, target: State):
    """The spectrum of the f whose K f is nearest to the target."""
    image = penalties.image * target.image + penalties.variation * differences_adjoint(
        target.slopes, splitting.depth_weight
    )
    total = jnp.fft.rfft2(image)
    for operator, gain, data in zip(splitting.operators, splitting.gains, target.data, strict=True):
        factor = (penalties.data * gain).astype(total.dtype)
        total = total + factor * operator.spread(jnp.fft.rfft2(data))
    return splitting.normal(total, penalties)


def _images(splitting: Splitting, spectrum) -> State:
    """K f: what an image looks like to each part of the objective."""
    window = splitting.operators[0].window
    image = jnp.fft.irfft2(spectrum, s=window)
    data = tuple(
        jnp.fft.irfft2(operator.combine(spectrum) * gain.astype(spectrum.dtype), s=window)
        for operator, gain in zip(splitting.operators, splitting.gains, strict=True)
    )
    return State(data, differences(image, splitting.depth_weight), image)


def rescale(
    splitting: Splitting, state: State, penalties: Penalties, factors: Penalties
) -> tuple[Penalties, State]:
    """Other penalties, with the state that keeps image and forces: q = z + λ, λ ∝ 1/μ."""
    back = reflected(splitting, penalties, state)

    def scaled(q, r, factor):
        z = 0.5 * (q + r)
        return z + (q - z) / factor

    data = tuple(scaled(q, r, factors.data) for q, r in zip(state.data, back.data, strict=True))
    slopes = tuple(
        scaled(q, r, factors.variation) for q, r in zip(state.slopes, back.slopes, strict=True)
    )
    image = scaled(state.image, back.image, factors.image)
    return jax.tree.map(jnp.multiply, penalties, factors), State(data, slopes, image)


def default_penalties(splitting: Splitting) -> Penalties:
    r"""Penalties that suit the operators' spectrum.

    Where one low frequency is far stronger than the rest, as the light of a bright background is,
    the splits that it does not concern must weigh more: by the ratio of the largest to the root
    mean square, μ₂ = μ₃ = max|H|/rms|H|. μ₁ = 1 puts the split data on a par with the data. A rule
    of thumb, which `AdmmTotalVariation.adapt` corrects.
    """
    strongest = jnp.sqrt(
        jnp.max(
            sum(
                g**2 * jnp.sum(squared_modulus(o.spectrum), axis=-3)
                for o, g in zip(splitting.operators, splitting.gains, strict=True)
            )
        )
    )
    strongest = jax.lax.stop_gradient(or_one(strongest))
    return Penalties(jnp.ones_like(strongest), strongest, strongest)


def _operator_unit(operators, weights) -> Float[Array, ""]:
    """Root mean square of the operators' weighted spectra, over the whole plane."""
    total = jnp.zeros((), weights[0].dtype)
    for operator, weight in zip(operators, weights, strict=True):
        planes = operator.spectrum.shape[-3]
        total = total + weight * planes * mean_power(operator)
    return jnp.sqrt(or_one(total))
