r"""Ridge regression in the modes of a separable camera (FlatCam), in closed form.

With the singular value decompositions :math:`P = U_P S V^T, Q = U_Q T W^T` of its one term, a
white prior of variance 1/ρ and noise of variance 1, every mode stands alone:

.. math:: \hat g = U_P^T (g - A\bar f)\, U_Q,\qquad
    f = \bar f + V \Big[\frac{s_i t_j}{s_i^2 t_j^2 + \rho}\,\hat g_{ij}\Big] W^T

(Asif et al., IEEE Trans. Comput. Imaging 3, 384, 2017). So do what the data say of ρ: generalised
cross-validation (Golub, Heath and Wahba, Technometrics 21, 215, 1979), which needs no variance of
the noise, and Stein's unbiased estimate of the risk (Ann. Stat. 9, 1135, 1981), which does:

.. math:: \mathrm{GCV} = \frac{N\,r(\rho)}{(N - n(\rho))^2},\qquad
    \mathrm{SURE} = r(\rho) - N + 2\,n(\rho)

with the squared residual r, N pixels of the captures and
:math:`n = \sum s^2t^2/(s^2t^2 + \rho)` degrees of freedom.
"""

import math
from dataclasses import replace
from typing import Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, DTypeLike, Float

from thincam_jax._core import checks
from thincam_jax._core.precision import product
from thincam_jax.imaging.operators import Separable
from thincam_jax.imaging.operators.separable import SeparableModes
from thincam_jax.reconstruction.normal_equations import SeparableNormal, normal_equations
from thincam_jax.reconstruction.problem import InverseProblem, residuals
from thincam_jax.reconstruction.regularisers import Image

Rule = Literal["gcv", "sure"]
RULES: tuple[Rule, ...] = ("gcv", "sure")
# ρ is sought among so many, from 1e-12 to 1e4 of the largest eigenvalue of AᵀA, then between the
# neighbours of the best, twice: 0.2 % in the end.
_STEPS, _ZOOMS, _DECADES = 33, 3, (-12.0, 4.0)


@jax.jit
def ridge_by_modes(
    modes: SeparableModes, captures: Float[Array, "*batch y x"], precision: Float[Array, ""]
) -> Float[Array, "*batch m n"]:
    """The ridge reconstruction drawn to 0, for captures whose noise has variance 1.

    Four products a capture and nothing else: for videos and channels of one camera, whose modes
    `Separable.with_modes` keeps. `Ridge` finds the same for a recording, and knows what to draw to.

    - `precision`: ρ > 0, 1/variance of the image where noise has variance 1.
    """
    seen = _seen(modes, captures)
    inside = seen * modes.values / (modes.values**2 + precision)
    return product(product(modes.rows, inside), modes.columns.T)


class Prior(eqx.Module):
    r"""Pixels that resemble their neighbours: covariance e^{−|y−y'|/ℓ − |x−x'|/ℓ} over ρ.

    The product of two Markov chains, the usual model of photographs (Jain, Proc. IEEE 69, 349,
    1981). It is L Lᵀ with the lower triangular L = `rows` ⊗ `columns`, so that z = L⁻¹(f − f̄) is
    white and a separable camera of f is one of z.
    """

    rows: Float[Array, "m m"]
    columns: Float[Array, "n n"]

    @classmethod
    def of(cls, shape: tuple[int, int], correlation: float, dtype: DTypeLike) -> "Prior":
        """- `correlation`: ℓ ≥ 0, pixels; 0 is white."""
        near = math.exp(-1 / correlation) if correlation > 0 else 0.0

        def root(count):
            steps = np.subtract.outer(np.arange(count), np.arange(count))
            chain = np.where(steps >= 0, near ** np.abs(steps), 0)
            chain[:, 1:] *= math.sqrt(1 - near**2)
            return jnp.asarray(chain, dtype)

        return cls(root(shape[0]), root(shape[1]))

    def seen_by(self, operator: Separable) -> Separable:
        """The camera of z."""
        return Separable(
            product(operator.left, self.rows), product(operator.right, self.columns)
        ).with_modes()

    def image(self, white: Float[Array, "*batch m n"]) -> Float[Array, "*batch m n"]:
        """L z."""
        return product(product(self.rows, white), self.columns.T)

    def modes(self, modes: SeparableModes) -> SeparableModes:
        """Modes of z as images: those of `ridge_by_modes` under this prior, and no longer white."""
        return replace(
            modes, rows=product(self.rows, modes.rows), columns=product(self.columns, modes.columns)
        )


def choose_precision(
    problem: InverseProblem, mean: Image, rule: Rule
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """ρ of least GCV or SURE, one for all batch elements and channels, and that least value.

    - `mean`: f̄, what the image is drawn to.

    **Errors**: ValueError where the problem is not that of one separable term with one weight.
    """
    checks.choice("rule", rule, RULES)
    unit = jnp.ones((), problem.captures[0].dtype)
    normal = normal_equations(problem, unit)
    if not isinstance(normal, SeparableNormal):
        raise ValueError(
            f"ridge = {rule!r} needs the modes of one separable term with one weight; give a "
            "number, or a Separable of one term (truncated(terms=1)) and no dead pixels"
        )
    (difference,) = residuals(problem, mean)
    weighted = -jnp.sqrt(problem.weights[0]) * difference
    return _least(normal.modes, weighted, rule)


@jax.jit(static_argnames="rule")
def _least(modes: SeparableModes, captures, rule: Rule):
    """The minimum over log ρ by grids that zoom in."""
    seen = _seen(modes, captures)
    power = (modes.values / jnp.max(modes.values)) ** 2
    assert modes.seen_rows is not None and modes.seen_columns is not None
    beside = captures - product(product(modes.seen_rows, seen), modes.seen_columns.T)
    beside, squares = jnp.sum(beside**2), jnp.sum(seen**2, axis=tuple(range(seen.ndim - 2)))
    images = captures.size // (captures.shape[-2] * captures.shape[-1])
    count = captures.size

    def criterion(exponent):
        kept = power / (power + 10.0**exponent)
        residual = jnp.sum(squares * (1 - kept) ** 2) + beside
        freedom = images * jnp.sum(kept)
        if rule == "gcv":
            # Where all is kept, 0/0; the scale is that of the captures.
            return count * residual / jnp.maximum(count - freedom, 0.5) ** 2
        return residual - count + 2 * freedom

    lower, upper = _DECADES
    lower, upper = (jnp.asarray(e, captures.dtype) for e in (lower, upper))
    for _ in range(_ZOOMS):
        tried = jnp.linspace(lower, upper, _STEPS, dtype=captures.dtype)
        best = jnp.argmin(jax.lax.map(criterion, tried)).astype(jnp.int32)
        lower, upper = tried[jnp.maximum(best - 1, 0)], tried[jnp.minimum(best + 1, _STEPS - 1)]
    middle = (lower + upper) / 2
    return jnp.max(modes.values) ** 2 * 10.0**middle, criterion(middle)


def _seen(modes: SeparableModes, captures):
    """ĝ, what is seen of each mode."""
    if modes.seen_rows is None or modes.seen_columns is None:
        raise ValueError("these are modes of several terms; give those of one, truncated(terms=1)")
    return product(product(modes.seen_rows.T, captures), modes.seen_columns)
