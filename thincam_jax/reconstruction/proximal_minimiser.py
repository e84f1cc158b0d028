"""The accelerated proximal gradient step as a minimiser of optimistix."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import optimistix
from jaxtyping import Array, Bool, Float, PyTree

from thincam_jax.reconstruction.fista import Course, ProximalStep
from thincam_jax.reconstruction.problem import Deconvolution, misfit


class _State(eqx.Module):
    course: Course
    done: Bool[Array, ""]


class AcceleratedProximal(optimistix.AbstractMinimiser):
    r"""FISTA with restart for `optimistix.minimise`: f smooth, plus τR of its own.

    The function given to `minimise` is the smooth part alone; its gradient must be Lipschitz
    with 1/`step.length`. R, τ and f ≥ 0 are in `step`. It ends when
    neither the step ‖x⁺ − y‖ nor the move ‖x⁺ − x‖ is longer than atol + rtol·‖x⁺‖.

    To differentiate the solution pass `adjoint=optimistix.RecursiveCheckpointAdjoint()`. The
    default `ImplicitAdjoint` takes the gradient of the smooth part to be zero, which it is not: its
    derivatives would be wrong. For implicit differentiation see `_jaxopt.implicit_minimiser`.
    """

    step_map: ProximalStep
    # Arrays, so that another tolerance is not compiled anew.
    rtol: Any
    atol: Any
    norm: Callable[[PyTree], Float[Array, ""]] = eqx.field(static=True)

    def __init__(self, step: ProximalStep, *, rtol, atol, norm=optimistix.two_norm):
        self.step_map, self.norm = step, norm
        self.rtol, self.atol = jnp.asarray(rtol), jnp.asarray(atol)

    def init(self, fn, y, args, options, f_struct, aux_struct, tags) -> _State:
        return _State(self.step_map.start(y), jnp.zeros((), bool))

    def step(self, fn, y, args, options, state, tags) -> tuple[Array, _State, Any]:
        (_, aux), gradient = eqx.filter_value_and_grad(fn, has_aux=True)(state.course.lead, args)
        course = self.step_map(state.course, gradient)
        size = self.norm(course.image)
        stepped = self.norm(course.image - state.course.lead)
        moved = self.norm(course.image - state.course.image)
        limit = self.atol.astype(size.dtype) + self.rtol.astype(size.dtype) * size
        return course.image, _State(course, jnp.maximum(stepped, moved) <= limit), aux

    def terminate(self, fn, y, args, options, state, tags):
        return state.done, optimistix.RESULTS.successful

    def postprocess(self, fn, y, aux, args, options, state, tags, result):
        return y, aux, {}


def total_misfit(
    image: Float[Array, "*batch channel plane y x"], problem: Deconvolution
) -> Float[Array, ""]:
    """½ Σ w (H f − g)² over the whole batch, as solvers call it: image first, data second."""
    return jnp.sum(misfit(problem, image))
