r"""Solving :math:`(\sum_k A_k^T w_k A_k + \mu)\, z = b` by the structure of the operators.

Dense: the Gram matrix once, a Cholesky factorisation for each μ. One separable term with one
weight: its modes, once, or those that it has kept; a `ReducedMatrix` brings its own. All else:
conjugate gradients (`lineax.CG`), preconditioned for convolutions and for separable cameras of
several terms or weights.
"""

import functools
import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax
import numpy as np
import optimistix
from jax.scipy.sparse.linalg import cg
from jaxtyping import Array, Bool, Complex, Float

from thincam_jax._core.checks import Number
from thincam_jax._core.grids import fast_shape
from thincam_jax._core.precision import as_complex
from thincam_jax.imaging.operators import CropConvolution, Matrix, ReducedMatrix, Separable
from thincam_jax.imaging.operators.crop_convolution import cut, place
from thincam_jax.imaging.operators.separable import SeparableModes
from thincam_jax.reconstruction.backgrounds import with_other_background
from thincam_jax.reconstruction.closed_normal import (
    AbstractNormal,
    DenseNormal,
    LevelledNormal,
    ReducedNormal,
    SeparableNormal,
    by_modes,
    gain_of,
    gram_matrix,
    inner,
    with_weights,
    without_gain,
)
from thincam_jax.reconstruction.problem import (
    InverseProblem,
    back_projected,
    convolutions,
    detector_shape,
    forward,
    or_one,
    without_background,
)

# Of conjugate gradients within an iteration, relative to the right-hand side.
INNER_TOLERANCE = {"float32": 1e-5, "float64": 1e-10}
INNER_STEPS = 500
# Steps between estimates of the error, at least; pixels of convolutions that are solved sooner
# without a filter.
_SPAN, _FEW = 8, 1024
# In units of the machine's, of the eigenvalues of convolutions, relative to the largest.
_ROUNDING = 10
# Steps that find what a background takes: fewer leave the image twice as many, more gain none.
_BEGINNING = 6


def normal_equations(problem: InverseProblem, shift: Float[Array, ""]) -> AbstractNormal:
    """The solver that suits the operators and weights of a problem."""
    fixed = jax.lax.stop_gradient(problem)
    pairs = with_weights(fixed)
    same = [math.prod(w.shape[: -len(detector_shape(o))]) == 1 for o, w in pairs]
    bare = [without_gain(o) for o in fixed.operators]
    if all(same) and all(isinstance(o, Matrix) for o in bare):
        return DenseNormal(problem, shift, gram_matrix(fixed))
    if len(bare) == 1 and isinstance(bare[0], ReducedMatrix) and fixed.weights[0].size == 1:
        return ReducedNormal(problem, shift)
    if len(bare) == 1 and isinstance(bare[0], Separable):
        modes = bare[0].modes or _with_modes(bare[0]).modes
        assert modes is not None
        values = jnp.abs(gain_of(fixed.operators[0])) * modes.values
        weighted = replace(modes, values=jnp.sqrt(jnp.mean(fixed.weights[0])) * values)
        if bare[0].terms == 1 and fixed.weights[0].size == 1:
            known = SeparableNormal(with_other_background(problem, "known"), shift, weighted)
            return LevelledNormal(problem, known) if problem.has_background else known
        return IterativeNormal(problem, shift, weighted)
    convolved = convolutions(fixed)
    if convolved is None:
        return IterativeNormal(problem, shift)
    powers, uniform = _nearest(fixed, jax.lax.stop_gradient(shift), convolved)
    return IterativeNormal(problem, shift, powers=powers, uniform=uniform)


def levelled_equations(problem: InverseProblem, shift: Float[Array, ""]) -> AbstractNormal:
    """Normal equations whose backgrounds may be kept from being negative."""
    if problem.has_background and len(problem.operators) == 1:
        return LevelledNormal(
            problem, normal_equations(with_other_background(problem, "known"), shift)
        )
    normal = normal_equations(problem, shift)
    is_iterative = problem.background != "nonnegative" or isinstance(normal, IterativeNormal)
    return normal if is_iterative else IterativeNormal(problem, shift)


class IterativeNormal(AbstractNormal):
    """Solutions by conjugate gradients to `INNER_TOLERANCE`.

    Convolutions are preconditioned by their `mean_powers`, separable cameras by the `modes` given.
    Captures that are not `lit` have no background.

    - `uniform`: with backgrounds to find, the `UniformLight` of one plane.
    """

    modes: SeparableModes | None = None
    powers: Complex[Array, "channel p q v u"] | None = None
    uniform: "UniformLight | None" = None
    lit: tuple[Bool[Array, "..."], ...] | None = None

    def applied(self, image: Float[Array, "..."]):
        seen = tuple(forward(operator, image) for operator in self.problem.operators)
        return back_projected(self.problem, seen, self.lit) + self.shift * image

    def solve(self, right: Float[Array, "..."]):
        return self(right, jnp.zeros_like(right))

    def __call__(self, right: Float[Array, "..."], guess: Float[Array, "..."]):
        limit = INNER_TOLERANCE[str(right.dtype)]
        solution = self.solution(right, guess, limit, INNER_STEPS)
        return solution.value

    def solution(
        self, right: Float[Array, "..."], guess: Float[Array, "..."], tolerance: Number, steps: int
    ) -> lineax.Solution:
        """Status by lineax; `tolerance` is relative to the right-hand side, root mean square."""
        structure = jax.ShapeDtypeStruct(right.shape, right.dtype)
        tags = lineax.positive_semidefinite_tag
        # lineax takes a curvature pᵀAp/‖r‖² below 100·eps·(number of unknowns) for a breakdown: in
        # float32 that is 3 for 512² pixels, more than any A of norm 1 has. A is therefore scaled to
        # allow eigenvalues down to 1e-6.
        eps = float(jnp.finfo(right.dtype).eps)
        factor = max(1.0, 1e8 * eps * right.size)
        operator = lineax.FunctionLinearOperator(
            lambda image: factor * self.applied(image), structure, tags
        )
        # They decide how the solution is found: it has its slopes by the equation alone.
        fixed, guess, size = jax.lax.stop_gradient((self, guess, jnp.sqrt(jnp.mean(right**2))))
        options: dict[str, Any] = {"y0": guess / factor}
        if (filtered := fixed._filter()) is not None:
            options["preconditioner"] = lineax.FunctionLinearOperator(filtered, structure, tags)
        limits: dict[str, Any] = {"rtol": tolerance, "atol": tolerance * size}
        solver = lineax.CG(**limits, norm=optimistix.rms_norm, max_steps=steps)
        solution = lineax.linear_solve(operator, right, solver, options=options, throw=False)
        return eqx.tree_at(lambda s: s.value, solution, factor * solution.value)

    def _filter(self):
        if self.powers is not None:
            nearest = functools.partial(_filtered, self.inverse_filter())
            if self.uniform is None:
                return nearest
            beside = self.uniform.solver(self.shift)
            return lambda image: nearest(image) + beside(image)
        return self.modes and functools.partial(by_modes, self.modes, self.shift)

    def least_squares(
        self, captures: tuple[Float[Array, "..."], ...], tolerance: Number, steps: int
    ) -> tuple[Float[Array, "..."], Float[Array, ""], Float[Array, ""], Array]:
        r"""z of b = Σ Aᵀwg, ⟨b, z⟩, the error relative to z that is left, and the steps taken.

        Conjugate gradients from 0 that keep the residuals d = g − A z, which round less (Björck,
        Elfving and Strakoš, SIAM J. Matrix Anal. Appl. 19, 720, 1998). The error is δ q/(1 − q) of
        the change δ over the last fifth of the steps, with q the slower of the last two ratios of
        δ, and :math:`\epsilon\|\sqrt{w} d\|/4\mu` for rounding.
        """
        problem, shift = self.problem, self.shift
        captures = without_background(problem, captures)
        slope = back_projected(problem, captures)
        few = self.modes is None and math.prod(slope.shape[-3:]) <= _FEW
        ahead = (not few and self._filter()) or (lambda image: image)

        def squares(seen):
            return sum(jnp.sum(w * d**2) for w, d in zip(problem.weights, seen, strict=True))

        def advance(state):
            (z, left, slope, along, power), memory, step = state
            seen = [forward(operator, along) for operator in problem.operators]
            seen = without_background(problem, seen)
            length = jnp.sum(slope * along) / or_one(squares(seen) + shift * jnp.sum(along**2))
            z = z + length * along
            left = tuple(d - length * a for d, a in zip(left, seen, strict=True))
            slope = back_projected(problem, left) - shift * z
            before, power = power, jnp.sum(slope * (downhill := ahead(slope)))
            along, step = downhill + power / or_one(before) * along, step + 1

            def look(memory):
                change = jnp.linalg.norm(z - memory[0])
                ratio = change / or_one(memory[1])
                slower = jnp.maximum(ratio, memory[2])
                to_come = jnp.where(slower < 0.95, change * slower / (1 - slower), jnp.inf)
                error = to_come + jnp.finfo(z.dtype).eps / 4 * jnp.sqrt(squares(left)) / shift
                due = step + jnp.maximum(_SPAN, step // 4)
                return z, change, ratio, due, error / or_one(jnp.linalg.norm(z))

            memory = jax.lax.cond(step == memory[3], look, lambda memory: memory, memory)
            return (z, left, slope, along, power), memory, step

        zero, never = jnp.zeros_like(slope), jnp.asarray(jnp.inf, slope.dtype)
        start = (zero, captures, slope, first := ahead(slope), jnp.sum(slope * first))
        memory = (zero, never, never, jnp.asarray(_SPAN), never)
        going = lambda state: (state[1][4] > tolerance) & (state[2] < steps)  # noqa: E731
        (z, *_), memory, step = jax.lax.while_loop(going, advance, (start, memory, jnp.asarray(0)))
        return z, jnp.sum(slope * z), memory[4], step

    def inverse_filter(self) -> Complex[Array, "channel p q v u"]:
        """(AᵀwA + μ)⁻¹ of the planes p, q at each frequency of a convolution's field."""
        assert self.powers is not None
        count, shift = self.powers.shape[1], self.shift.astype(self.powers.dtype)
        if count == 1:
            return 1 / (self.powers + shift)
        matrix = jnp.moveaxis(self.powers, (1, 2), (-2, -1))
        inverse = jnp.linalg.inv(matrix + shift * jnp.eye(count, dtype=matrix.dtype))
        return jnp.moveaxis(inverse, (-2, -1), (1, 2))


class UniformLight(eqx.Module):
    r"""The image d whose light on the sensor is nearest to uniform, which a background takes.

    Without the background d has one of the largest eigenvalues, with it one of the smallest: the
    step :math:`d\,d^T / d^T(A^TwA + \mu)d` is added to the preconditioner.

    - `image`: d. `power`: ‖√w A d‖² of it without its background.
    """

    image: Float[Array, "*batch channel 1 y x"]
    power: Float[Array, "*batch channel 1 1 1"]

    def solver(self, shift: Float[Array, ""]):
        """The function of b that gives d dᵀb / dᵀ(AᵀwA + μ)d."""
        size = or_one(self.power + shift * inner(self.image, self.image))
        return lambda right: self.image * (inner(self.image, right) / size)


@jax.jit
def _nearest(
    problem: InverseProblem, shift: Float[Array, ""], operators: tuple[CropConvolution, ...]
) -> tuple[Complex[Array, "channel p q v u"], UniformLight | None]:
    """The preconditioner of convolutions: eigenvalues, and what a background takes.

    d = (AᵀwA + μ)⁻¹ Aᵀw1 without backgrounds takes few steps, since its light is strong.
    """
    powers = mean_powers(operators, problem.weights)
    if powers.shape[1] > 1 or not problem.has_background:
        return powers, None
    dark = tuple(jnp.zeros((), bool) for _ in operators)
    known = IterativeNormal(problem, shift, powers=powers, lit=dark)
    ones = [jnp.ones(operator.out_shape, shift.dtype) for operator in operators]
    right = back_projected(problem, ones, dark)
    image, _ = cg(known.applied, right, M=known._filter(), tol=0.0, maxiter=_BEGINNING)
    seen = [forward(operator, image) for operator in problem.operators]
    seen = without_background(problem, seen)
    pairs = zip(problem.weights, seen, strict=True)
    squares = [jnp.sum(w * d**2, axis=(-2, -1))[..., None, None, None] for w, d in pairs]
    return powers, UniformLight(image, sum(squares[1:], start=squares[0]))


def _filtered(inverse: Complex[Array, "channel p q v u"], image: Float[Array, "..."]):
    """An image on the window of the filter, filtered, and cut: positive definite."""
    rows, columns = image.shape[-2:]
    window = padded_field((rows, columns))
    field = jnp.fft.rfft2(place(image, (0, 0), window))
    field = jnp.fft.irfft2(jnp.sum(inverse * field[..., None, :, :, :], axis=-3), s=window)
    return cut(field, (0, 0), (rows, columns))


def padded_field(shape: tuple[int, int]) -> tuple[int, int]:
    """The window of a field's filters."""
    return fast_shape(shape, real=True)


@jax.jit
def mean_powers(
    operators: Sequence[CropConvolution], weights: Sequence[Float[Array, "..."]]
) -> Complex[Array, "channel p q v u"]:
    r"""Eigenvalues of the circulant matrix nearest to Σ AᵀwA, at the frequencies of the field.

    AᵀA of a pixel and another at a lag l, averaged over the field, is the correlation of the PSFs,
    each point weighted by the part of the field from which it falls on the sensor, times the part
    of the field that has both pixels (T. Chan, SIAM J. Sci. Stat. Comput. 9, 766, 1988). All are
    positive, since so are the spectra that are multiplied and averaged.
    """
    window, field = operators[0].window, operators[0].field_shape
    parts = []
    for o, w in zip(operators, weights, strict=True):
        sides = zip(o.sensor_shape, field, window, o.sensor_corner, o.field_corner, strict=True)
        rows, columns = (np.sqrt(_seen(*side)).astype(w.dtype) for side in sides)
        kernel = jnp.fft.irfft2(o.spectrum, s=window) * rows[:, None] * columns
        spectrum = jnp.fft.rfft2(kernel)
        both = spectrum[:, :, None].conj() * spectrum[:, None]
        parts.append(as_complex(jnp.mean(w)) * both)
    folded = jnp.fft.irfft2(sum(parts[1:], start=parts[0]), s=window)
    for axis, side, period in zip((-2, -1), field, padded_field(field), strict=True):
        folded = _folded(jnp.moveaxis(folded, axis, -1), side, period)
        folded = jnp.moveaxis(folded, -1, axis)
    powers = jnp.fft.rfft2(folded)
    # Rounding must not make one negative.
    least = _ROUNDING * jnp.finfo(folded.dtype).eps * jnp.max(jnp.abs(powers))
    unit = jnp.eye(powers.shape[1], dtype=folded.dtype)[..., None, None]
    return powers + as_complex(least * unit)


def _folded(lags: Float[Array, "*planes n"], side: int, period: int) -> Float[Array, "*planes m"]:
    """Lags of a line of pixels on a circle, each times the part of the line that has both."""
    shared = ((side - np.arange(side)) / side).astype(lags.dtype)
    circle = jnp.zeros((*lags.shape[:-1], period), lags.dtype)
    circle = circle.at[..., :side].add(shared * lags[..., :side])
    return circle.at[..., period - side + 1 :].add(shared[:0:-1] * lags[..., 1 - side :])


def _seen(sensor: int, field: int, window: int, start: int, begin: int) -> np.ndarray:
    """Part of a field's samples that send light to the sensor, for each sample of a PSF."""
    least = 1 - field - (window - (sensor + field - 1)) // 2
    lag = (np.arange(window) - (start - begin) - least) % window + least
    both = np.minimum(min(sensor, field), np.minimum(lag + field, sensor - lag))
    return np.clip(both, 0, None) / field


@jax.jit
def _with_modes(operator: Separable) -> Separable:
    return operator.with_modes()
