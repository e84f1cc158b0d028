r"""Plug and play: any denoiser in the place of a proximal map.

A proximal map takes noise out of an image; so does any denoiser D, be it a filter or a network.
Put in its place (Venkatakrishnan, Bouman, Wohlberg, IEEE GlobalSIP 2013) it stands for an image
prior that need not have a formula. The iteration, that of FISTA, ends where

.. math:: f = D\big(f - \tfrac1L \nabla E_{\mathrm{misfit}}(f)\big).

With D = prox(τR/L) that is a minimiser of misfit + τR. With others it is a point of balance, no
minimum, and surely exists only if D − 1 is a contraction (Ryu et al., ICML 2019). The stronger D,
the smoother the image.
"""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from thincam_jax._core import checks
from thincam_jax._core.checks import Number
from thincam_jax.reconstruction.drive import Callback, Outcome, drive
from thincam_jax.reconstruction.fista import (
    AbstractProximalMap,
    AbstractScaledMethod,
    AcceleratedProximalGradient,
)
from thincam_jax.reconstruction.problem import InverseProblem, gradient, start_image
from thincam_jax.reconstruction.regularisers import AbstractRegulariser, Image, Parts, denoise
from thincam_jax.reconstruction.scaled import ScaledProblem

Denoiser = Callable[[Array], Array]


class RegulariserDenoiser(eqx.Module):
    """Denoising of the strength that makes plug and play minimise a problem's own objective."""

    strength: Float[Array, ""]
    regulariser: AbstractRegulariser
    nonnegative: bool = eqx.field(static=True)
    iterations: int = eqx.field(static=True)

    def __init__(self, problem: InverseProblem, iterations: int = 100):
        self.strength = problem.absolute_tau / ScaledProblem(problem).curvature
        self.regulariser, self.nonnegative = problem.regulariser, problem.nonnegative
        self.iterations = iterations

    def __call__(self, image: Image):
        return denoise(
            image,
            self.strength,
            self.regulariser,
            nonnegative=self.nonnegative,
            iterations=self.iterations,
        )


class DenoiserMap(AbstractProximalMap):
    """A denoiser as the map that follows each gradient step.

    - `unit`: what an image is multiplied by before the denoiser sees it.
    """

    denoiser: Denoiser
    unit: Float[Array, ""]
    nonnegative: bool = eqx.field(static=True)

    def start(self, image: Image):
        return ()

    def __call__(self, image: Image, kept: Parts):
        image = self.denoiser(image * self.unit) / self.unit
        return (jnp.maximum(image, 0) if self.nonnegative else image), kept


class PlugAndPlay(AbstractScaledMethod):
    """The iteration of a denoiser plugged into a problem.

    There is no objective: what is to be small is how far an image is from a fixed point,
    ‖f − D(f − ∇E/L)‖, of each batch element.
    """

    scaled: ScaledProblem
    solver: Any

    def __init__(self, scaled: ScaledProblem, solver: AcceleratedProximalGradient):
        self.scaled, self.solver = scaled, solver

    def objective(self, image: Image):
        return _distance(self, image)


def solve_plug_and_play(
    problem: InverseProblem,
    denoiser: Denoiser,
    *,
    image: Float[Array, "..."] | None = None,
    brightness: Number = 1.0,
    iterations: int = 200,
    callback: Callback | None = None,
) -> Outcome:
    """The image on which the captures and a denoiser agree; the problem's τ and R are not used.

    **Arguments**

    - `denoiser`: takes and returns images (*batch, channel, plane, y, x); pure JAX, an
      `equinox.Module` if it holds arrays (what is not JAX goes through `jax.pure_callback`).
      `RegulariserDenoiser(problem)` gives the problem's own minimiser.
    - `image`: to start from; default the uniform image that explains the captures best.
    - `brightness`: what the denoiser takes for 1, in the image's unit: a network for images from 0
      to 1 wants the brightness of white.
    - `iterations`: at most; it ends where a step is shorter than 1e-5 of the image.

    The history's objective is the distance from a fixed point, which also picks the image that
    is returned.
    """
    start = start_image(problem, image)
    scaled = ScaledProblem(problem)
    brightness = checks.positive("brightness", brightness, "the image's unit").astype(start.dtype)
    proximal = DenoiserMap(denoiser, scaled.image_unit / brightness, problem.nonnegative)
    method = PlugAndPlay(scaled, AcceleratedProximalGradient(proximal, _TOLERANCE))
    return drive(method, start, iterations=iterations, tolerance=_TOLERANCE, callback=callback)


_TOLERANCE = 1e-5


@eqx.filter_jit
def _distance(method: PlugAndPlay, image):
    scaled = method.scaled
    scaled_image = image / scaled.image_unit
    step = scaled_image - gradient(scaled.problem, scaled_image)
    difference = scaled_image - method.solver.proximal(step, ())[0]
    return jnp.sqrt(jnp.sum(difference**2, axis=(-4, -3, -2, -1))) * scaled.image_unit
