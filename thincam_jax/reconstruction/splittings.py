r"""Splittings of ADMM by the structure of the operators: Fourier for convolutions, else direct.

Convolutions on one window: the image, on a window that holds field and sensor, is split three ways,

.. math:: v_k = H_k f \;(\text{data, on the sensor}),\quad u = \Psi f \;(TV),\quad
    w = f \;(f \ge 0,\ 0 \text{ outside of the field})

and the equation that joins them is diagonal in the Fourier domain. The crop of the sensor is part
of the data's proximal map. This is the splitting of Almeida and Figueiredo (IEEE Trans. Image
Process. 22, 3074, 2013) as used for DiffuserCam (Antipa et al., Optica 5, 1, 2018).

All other operators (dense, separable, sparse, stacked):

.. math:: z = f \;(\text{data}),\quad u = \Psi f \;(TV),\quad w = f \;(f \ge 0)

The differences stop at the border of the field, so that cosine transforms diagonalise the joint
equation, (μ₁ + μ₂ΨᵀΨ + μ₃)⁻¹. The proximal map of the data is the solution of

.. math:: \Big(\sum_k A_k^T w_k A_k + \mu_1\Big) z = \sum_k A_k^T w_k g_k + \mu_1 q,

which `normal_equations` finds by the structure of the operators.
"""

import math
from dataclasses import replace
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.scipy.fft
import numpy as np
from jax.typing import DTypeLike
from jaxtyping import Array, Complex, Float

from thincam_jax._core.checks import Number
from thincam_jax._core.precision import as_complex, scaled, squared_modulus
from thincam_jax._core.quick_programs import quickly_compiled
from thincam_jax.imaging.operators import CropConvolution
from thincam_jax.imaging.operators.crop_convolution import cut, place
from thincam_jax.reconstruction.admm import (
    RELAXATION,
    AbstractSplitting,
    AdmmMethod,
    Penalties,
    State,
)
from thincam_jax.reconstruction.backgrounds import darkest
from thincam_jax.reconstruction.closed_normal import AbstractNormal, LevelledNormal
from thincam_jax.reconstruction.normal_equations import levelled_equations
from thincam_jax.reconstruction.problem import (
    Background,
    InverseProblem,
    back_projected,
    convolutions,
    lit,
    or_one,
    with_background,
)
from thincam_jax.reconstruction.regularisers import Image
from thincam_jax.reconstruction.scaled_problem import ScaledProblem
from thincam_jax.reconstruction.total_variation import (
    TotalVariation,
    differences,
    differences_adjoint,
    field_masks,
    within_field,
)

# Penalties from an image near the one sought: step of a difference over the image's standard
# deviation, μ₃/√μ₂, and the least μ₂ over that of a far image.
_STEP, _FRAME, _LEAST = 0.6, 0.85, 1e-4
_SETS = 10  # of backgrounds that are positive, at most


def admm_method(
    problem: InverseProblem,
    near: Image | None = None,
    *,
    relaxation: Number = RELAXATION,
    rough: bool = False,
) -> AdmmMethod:
    """ADMM for a problem, with the splitting that suits its operators; see `splitting_of`.

    From a `near` image penalties stay, and steps are not judged.
    """
    splitting = splitting_of(problem, near, rough=rough)
    return AdmmMethod(problem, splitting, relaxation, judged=near is None)


def splitting_of(
    problem: InverseProblem, near: Image | None = None, *, rough: bool = False
) -> AbstractSplitting:
    """The splitting that suits the operators of a problem.

    - `near`: a start image with the right low frequencies, to which penalties are suited.
    - `rough`: whether the image is only a start; see `FourierSplitting`.
    """
    variation = problem.regulariser
    if not isinstance(variation, TotalVariation):
        raise ValueError(
            f"ADMM is for total variation; the regulariser is a {type(variation).__name__}: use "
            "Fista"
        )
    operators = convolutions(problem)
    if operators is None:
        return DirectSplitting(problem, variation)
    return FourierSplitting(problem, operators, variation, near, rough=rough)


class FourierSplitting(AbstractSplitting):
    """The splitting of a problem whose operators are convolutions on one window.

    The largest weight of a capture is part of its operator, as `gains`; `weights` are relative.

    Light only adds to a background, which is not above the darkest part of its capture. A `rough`
    image for a start keeps to that, and does not first take all light for background. The final
    one need not: a measured PSF may be negative by errors of its own.
    """

    operators: tuple[CropConvolution, ...]
    gains: tuple[Float[Array, ""], ...]
    captures: tuple[Float[Array, "*batch channel y x"], ...]
    weights: tuple[Float[Array, "..."], ...]
    normal: "NormalInverse"
    highest: tuple[Float[Array, "..."], ...] | None
    background: Background = eqx.field(static=True)

    def __init__(
        self,
        problem: InverseProblem,
        operators: tuple[CropConvolution, ...],
        variation: TotalVariation,
        near: Image | None = None,
        *,
        rough: bool = False,
    ):
        units = _units(problem, operators, variation)
        # The operators themselves: a compiled function would return copies.
        self.operators = operators
        self.gains, self.captures, self.weights, self.tau, self.normal, self.image_unit = units
        self.variation, self.nonnegative = variation, problem.nonnegative
        self.background = problem.background
        is_limited = rough and self.background != "known"
        self.highest = darkest(self.captures, self.weights) if is_limited else None
        self.penalties = _default_penalties(self.operators, self.gains)
        if near is not None:
            unit = self.image_unit
            self.penalties = _near_penalties(self.penalties, near, unit, self.tau)

    def with_captures(self, captures: tuple[Float[Array, "..."], ...]):
        scaled = tuple(g / self.image_unit * c for g, c in zip(self.gains, captures, strict=True))
        highest = self.highest and darkest(scaled, self.weights)
        where, none = lambda s: (s.captures, s.highest), {"is_leaf": lambda part: part is None}
        return eqx.tree_at(where, self, (scaled, highest), **none)

    def start(self, image: Image):
        operator = self.operators[0]
        field = place(image / self.image_unit, operator.field_corner, operator.window)
        return self._images(jnp.fft.rfft2(field))

    def image(self, state: State):
        operator = self.operators[0]
        field = cut(state.image, operator.field_corner, operator.field_shape)
        image = jnp.maximum(field, 0) if self.nonnegative else field
        return image * self.image_unit

    def reflected(self, state: State):
        operator, window = self.operators[0], self.operators[0].window
        masks = field_masks(operator.field_shape, window, operator.field_corner)
        data = [q + 2 * self._data_pull(k, q) for k, q in enumerate(state.data)]
        framed = within_field(state.slopes, masks)
        shrunk = self.variation.shrink(framed, self.tau / self.penalties.variation)
        slopes = [q + 2 * (z - f) for q, z, f in zip(state.slopes, shrunk, framed, strict=True)]
        y, x = masks[-1]
        allowed = jnp.abs(state.image) if self.nonnegative else state.image
        return State(tuple(data), tuple(slopes), jnp.where(y & x, allowed, -state.image))

    def nearest(self, target: State):
        penalties = self.penalties
        image = penalties.image * target.image + penalties.variation * differences_adjoint(
            target.slopes, self.variation.depth_weight
        )
        total = jnp.fft.rfft2(image)
        for operator, gain, data in zip(self.operators, self.gains, target.data, strict=True):
            factor = (penalties.data * gain).astype(total.dtype)
            total = total + factor * operator.spread(jnp.fft.rfft2(data))
        return self._images(self.normal(total, penalties))

    def _data_pull(self, index: int, q):
        """z − q of a capture: zero outside of the sensor; z is best with its background.

        The minimum over z has the weights of `share` for the background.
        """
        operator, weight = self.operators[index], self.weights[index]
        difference = cut(q, operator.sensor_corner, operator.sensor_shape) - self.captures[index]
        share = weight / (weight + self.penalties.data)
        highest = math.inf if self.highest is None else self.highest[index]
        excess = with_background(self.background, share, difference, 2, highest)
        return place(-share * excess, operator.sensor_corner, operator.window)

    def _images(self, spectrum) -> State:
        """K f of an image's spectrum."""
        window = self.operators[0].window
        image = jnp.fft.irfft2(spectrum, s=window)
        data = tuple(
            jnp.fft.irfft2(operator.combine(spectrum) * gain.astype(spectrum.dtype), s=window)
            for operator, gain in zip(self.operators, self.gains, strict=True)
        )
        return State(data, differences(image, self.variation.depth_weight), image)


@quickly_compiled
def _units(problem: InverseProblem, operators, variation: TotalVariation):
    """The fields of a splitting, without its operators."""
    stop = jax.lax.stop_gradient
    largest = [or_one(stop(jnp.max(w))) for w in problem.weights]
    roots = [jnp.sqrt(w) for w in largest]
    operator_unit = stop(_operator_unit(operators, largest))
    sizes = [jnp.mean(w * c**2) for w, c in zip(problem.weights, problem.captures, strict=True)]
    capture_unit = stop(or_one(jnp.sqrt(sum(sizes) / len(sizes))))
    gains = tuple(r / operator_unit for r in roots)
    captures = tuple(c * (r / capture_unit) for r, c in zip(roots, problem.captures, strict=True))
    weights = tuple(w / m for w, m in zip(problem.weights, largest, strict=True))
    tau = problem.absolute_tau / (operator_unit * capture_unit)
    normal = NormalInverse(operators, gains, variation.depth_weight)
    return gains, captures, weights, tau, normal, capture_unit / operator_unit


@quickly_compiled
def _default_penalties(operators, gains) -> Penalties:
    r"""Penalties that suit the operators' spectrum, by rules of thumb.

    If one low frequency is far stronger than the others, as with a bright background, the splits
    of variation and image weigh more by the ratio r = max|H|/rms|H|, μ₂ = μ₃ = r. μ₁ = 1 weighs the
    split data like the data. Residual balancing corrects them. Several planes are separated by
    frequencies in which their PSFs differ, a tenth as strong or less: μ₁ = 0.1, μ₂ = μ₃ = r/100.
    """
    power = sum(
        g**2 * jnp.sum(squared_modulus(o.spectrum), axis=-3)
        for o, g in zip(operators, gains, strict=True)
    )
    strongest = jax.lax.stop_gradient(or_one(jnp.sqrt(jnp.max(power))))
    if operators[0].spectrum.shape[-3] > 1:
        return Penalties(jnp.full_like(strongest, 0.1), strongest / 100, strongest / 100)
    return Penalties(jnp.ones_like(strongest), strongest, strongest)


def _near_penalties(far: Penalties, image: Image, unit, tau) -> Penalties:
    r"""Penalties from an image with the right low frequencies: those of Fourier's splitting.

    A step shortens differences by τ/μ₂. It is set to 0.6 standard deviations of the image, which
    neither removes what the image has nor leaves its noise, and μ₃ = 0.85 √μ₂
    (docs/decisions/penalties_of_levels.md).
    """
    most, spread = float(far.variation), float(np.std(np.asarray(image))) / float(unit)
    wanted = float(tau) / (_STEP * spread) if spread > 0 else most
    variation = min(max(wanted, _LEAST * most), most)
    pair = (jnp.asarray(p, tau.dtype) for p in (variation, _FRAME * math.sqrt(variation)))
    return Penalties(far.data, *pair)


def _operator_unit(operators, weights) -> Float[Array, ""]:
    """Root mean square of the operators' weighted spectra, over the whole plane."""
    total = jnp.zeros((), weights[0].dtype)
    for operator, weight in zip(operators, weights, strict=True):
        planes = operator.spectrum.shape[-3]
        total = total + weight * planes * operator.mean_power()
    return jnp.sqrt(or_one(total))


class NormalInverse(eqx.Module):
    r"""The inverse of :math:`\mu_1 \sum_k H_k^* H_k^T + \mu_2 (\Lambda + \delta^2 D^T D) + \mu_3`.

    At each frequency the unknowns are the planes of the image. H_k is the vector of their transfer
    functions to the capture k, Λ the symbol of the differences along y and x, and D takes
    differences between planes. One plane: a division. Several: the cosine transform over the planes
    makes DᵀD diagonal, and each capture adds a term of rank one, which the formula of Sherman and
    Morrison inverts one after the other, without arrays of the size planes².

    - `power`: Σ_k |H_k|², of one plane; None with several.
    - `depth_weight`: δ.
    """

    spectra: tuple[Complex[Array, "channel plane v u"], ...]
    power: Float[Array, "channel 1 v u"] | None
    depth_weight: Float[Array, ""]
    window: tuple[int, int] = eqx.field(static=True)

    def __init__(
        self,
        operators: tuple[CropConvolution, ...],
        gains: tuple[Float[Array, ""], ...],
        depth_weight: Float[Array, ""],
    ):
        self.window = operators[0].window
        self.depth_weight = depth_weight
        if operators[0].spectrum.shape[-3] == 1:
            self.spectra = ()
            pairs = zip(operators, gains, strict=True)
            self.power = _total([g**2 * squared_modulus(o.spectrum) for o, g in pairs])
        else:
            self.spectra = tuple(
                _to_modes(o.spectrum * g.astype(o.spectrum.dtype))
                for o, g in zip(operators, gains, strict=True)
            )
            self.power = None

    def __call__(
        self, spectrum: Complex[Array, "*batch channel plane v u"], penalties: Penalties
    ) -> Complex[Array, "*batch channel plane v u"]:
        smooth = penalties.variation * difference_symbol(self.window, spectrum.real.dtype)
        if self.power is not None:
            # By real factors, so that a gradient keeps no complex copy.
            return scaled(spectrum, 1 / (penalties.data * self.power + smooth + penalties.image))
        planes = spectrum.shape[-3]
        depth = penalties.variation * self._depth_symbol(planes, smooth.dtype)
        inverse = 1 / (smooth + depth[:, None, None] + penalties.image)
        inverse = as_complex(inverse)
        return _from_modes(self._rank_ones(_to_modes(spectrum), inverse, penalties.data))

    def _depth_symbol(self, planes: int, dtype):
        """Eigenvalues of δ²DᵀD, whose eigenvectors are the cosines."""
        angles = np.pi * np.arange(planes) / planes
        return self.depth_weight.astype(dtype) ** 2 * jnp.asarray(2 - 2 * np.cos(angles), dtype)

    def _rank_ones(self, spectrum, inverse, mu):
        """(A + μ Σ_k h_k h_kᴴ)⁻¹ applied, A⁻¹ = `inverse` diagonal in the modes."""
        columns = []  # A_{k-1}⁻¹ h_k, and 1/μ + h_kᴴ A_{k-1}⁻¹ h_k

        def apply(vector, used):
            result = vector * inverse
            for h, column, size in used:
                result = result - column * (_inner(h, result) / size)
            return result

        for spectra in self.spectra:
            h = spectra.conj()
            column = apply(h, columns)
            size = (1 / mu).astype(h.dtype) + _inner(h, column)
            columns.append((h, column, size))
        return apply(spectrum, columns)


def _total(parts: list[Array]) -> Array:
    return sum(parts[1:], start=parts[0])


def difference_symbol(window: tuple[int, int], dtype: DTypeLike) -> Float[Array, "v u"]:
    """4 sin²(πv) + 4 sin²(πu) on the half plane of a real transform: that of ΨᵀΨ."""
    v, u = np.fft.fftfreq(window[0]), np.fft.rfftfreq(window[1])
    down, right = (jnp.asarray(4 * np.sin(np.pi * f) ** 2, dtype) for f in (v, u))
    return down[:, None] + right


def _inner(a, b):
    return jnp.sum(a.conj() * b, axis=-3, keepdims=True)


def _cosines(planes: int) -> np.ndarray:
    """The orthonormal DCT-II: (mode, plane)."""
    mode, plane = np.ogrid[:planes, :planes]
    matrix = np.cos(np.pi * mode * (plane + 0.5) / planes) * np.sqrt(2 / planes)
    matrix[0] /= np.sqrt(2)
    return matrix


def _to_modes(spectrum):
    matrix = jnp.asarray(_cosines(spectrum.shape[-3]), spectrum.dtype)
    return jnp.einsum("mp,...pvu->...mvu", matrix, spectrum, precision="highest")


def _from_modes(spectrum):
    matrix = jnp.asarray(_cosines(spectrum.shape[-3]), spectrum.dtype)
    return jnp.einsum("mp,...mvu->...pvu", matrix, spectrum, precision="highest")


class DirectSplitting(AbstractSplitting):
    """The splitting of a problem with any operators.

    - `normal`: solves the normal equations with the penalty of the data.
    - `pulled`: Σ Aᵀwg.

    Penalties start at the mean eigenvalue of AᵀwA and seldom need to adapt: only while a residual
    is above `settling`, as with captures of hardly any noise. Balancing them further makes dense
    and separable operators up to a hundred times slower.
    """

    settling: ClassVar[float] = 0.6
    problem: InverseProblem
    normal: AbstractNormal
    pulled: Image
    capture_unit: Float[Array, ""]

    def __init__(self, problem: InverseProblem, variation: TotalVariation):
        scaled = ScaledProblem(problem)
        self.problem, self.image_unit = scaled.problem, scaled.image_unit
        self.capture_unit = scaled.capture_unit
        self.pulled = back_projected(self.problem, self.problem.captures)
        self.tau = self.problem.absolute_tau
        self.variation, self.nonnegative = variation, problem.nonnegative
        # The mean eigenvalue of AᵀwA, whose largest is about 1. A matrix with a strong uniform
        # background has one large eigenvalue and thousands of small ones, and a penalty near the
        # large one would slow the image down for hundreds of iterations.
        power = (problem.tau_unit**2 / scaled.curvature).astype(self.tau.dtype)
        mean = jax.lax.stop_gradient(or_one(power))
        self.penalties = Penalties(mean, mean, mean)
        self.normal = levelled_equations(self.problem, self.penalties.data)

    def with_captures(self, captures: tuple[Float[Array, "..."], ...]):
        captures = tuple(c / self.capture_unit for c in captures)
        pulled = back_projected(self.problem, captures)
        return eqx.tree_at(lambda s: (s.pulled, s.problem.captures), self, (pulled, captures))

    def with_penalties(self, penalties: Penalties):
        normal = self.normal.shifted(penalties.data)
        return eqx.tree_at(lambda s: (s.penalties, s.normal), self, (penalties, normal))

    def settled(self):
        return eqx.tree_at(lambda s: s.normal, self, self.normal.settled())

    def start(self, image: Image):
        return self._images(image / self.image_unit)

    def image(self, state: State):
        image = jnp.maximum(state.image, 0) if self.nonnegative else state.image
        return image * self.image_unit

    def reflected(self, state: State):
        (q,) = state.data
        shrunk = self.variation.shrink(state.slopes, self.tau / self.penalties.variation)
        slopes = tuple(2 * z - s for z, s in zip(shrunk, state.slopes, strict=True))
        allowed = jnp.abs(state.image) if self.nonnegative else state.image
        return State((2 * self._data(q) - q,), slopes, allowed)

    def _data(self, q: Image) -> Image:
        """z of the data; with backgrounds ≥ 0, solved with just those that are positive for z.

        That of one capture has a closed form. The sets of several are found by Newton's method, the
        gradient is that of the last solution.
        """
        problem = self.problem
        if problem.background != "nonnegative":
            return self.normal(self.pulled + self.penalties.data * q, q)
        if isinstance(self.normal, LevelledNormal):
            found = self.normal.known(self.pulled + self.penalties.data * q, q)
            return self.normal.levelled(found, -self.normal.mean_of(problem.captures[0]))

        def solved(splitting, q, found, guess):
            problem, normal = splitting.problem, replace(splitting.normal, lit=found)
            pulled = back_projected(problem, problem.captures, found)
            return normal(pulled + splitting.penalties.data * q, guess)

        fixed, known = jax.lax.stop_gradient((self, q))

        def step(state):
            found, _, z, count = state
            z = solved(fixed, known, found, z)
            return lit(fixed.problem, z), found, z, count + 1

        def going(state):
            differ = [jnp.any(new != old) for new, old in zip(*state[:2], strict=True)]
            return jnp.any(jnp.stack(differ)) & (state[3] < _SETS)

        first = lit(fixed.problem, known)
        start = (first, tuple(~one for one in first), known, jnp.asarray(0))
        found, _, z, _ = jax.lax.while_loop(going, step, start)
        return solved(self, q, found, z)

    def nearest(self, target: State):
        (data,) = target.data
        penalties = self.penalties
        total = penalties.data * data + penalties.image * target.image
        total = total + penalties.variation * self.variation.synthesise(target.slopes)
        symbol = _difference_symbol(total.shape[-3:], self.variation.depth_weight, total.dtype)
        smooth = penalties.variation * symbol
        shift = penalties.data + penalties.image
        axes = (-3, -2, -1)
        modes = jax.scipy.fft.dctn(total, axes=axes, norm="ortho") / (smooth + shift)
        return self._images(jax.scipy.fft.idctn(modes, axes=axes, norm="ortho"))

    def _images(self, image) -> State:
        return State((image,), self.variation.analyse(image), image)


def _difference_symbol(shape: tuple[int, ...], depth_weight, dtype) -> Float[Array, "plane y x"]:
    """ΨᵀΨ in the cosine transform: 4 sin²(πk/2n) along each axis, δ² times that between planes."""
    planes, rows, columns = (
        jnp.asarray(4 * np.sin(np.pi * np.arange(n) / (2 * n)) ** 2, dtype) for n in shape
    )
    depth = depth_weight.astype(dtype) ** 2 * planes
    return depth[:, None, None] + rows[:, None] + columns
