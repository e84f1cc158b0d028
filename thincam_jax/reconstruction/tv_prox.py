"""Total variation as a regulariser of gradient methods: its proximal map, by the dual."""

import functools

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from thincam_jax.reconstruction.regulariser import AbstractRegulariser, no_dual, prox
from thincam_jax.reconstruction.total_variation import (
    TotalVariation,
    differences,
    differences_adjoint,
    field_masks,
    within_field,
)


class VariationRegulariser(AbstractRegulariser):
    """R = TV: K takes the differences inside of the image, φ sums the lengths of their vectors."""

    variation: TotalVariation

    @property
    def orthonormal(self):
        return False

    def __call__(self, image):
        return self.variation(image)

    def analyse(self, image):
        return _inside(differences(image, self.variation.depth_weight))

    def synthesise(self, parts):
        return differences_adjoint(_inside(parts), self.variation.depth_weight)

    def shrink(self, parts, step):
        return self.variation.prox(parts, step)

    def squared_norm(self, dtype):
        # Each of the three directions takes differences of two samples: at most 2² = 4.
        return 8 + 4 * self.variation.depth_weight.astype(dtype) ** 2


def tv_prox(
    image: Float[Array, "*batch channel plane y x"],
    step,
    variation: TotalVariation,
    *,
    nonnegative: bool = False,
    iterations: int = 100,
) -> Float[Array, "*batch channel plane y x"]:
    r"""The image x that minimises ½‖x − image‖² + step·TV(x), with x ≥ 0 where asked.

    TV denoising (Rudin, Osher, Fatemi), by `iterations` of Beck and Teboulle's FGP on the
    dual (see `regulariser.prox`). The larger `step` is against the differences in the image, the
    more of them it takes; `step` has the unit of the image.
    """
    return _tv_prox(image, jnp.asarray(step, image.dtype), variation, nonnegative, iterations)


@functools.partial(jax.jit, static_argnames=("nonnegative", "iterations"))
def _tv_prox(image, step, variation, nonnegative: bool, iterations: int):
    regulariser = VariationRegulariser(variation)
    dual = no_dual(regulariser, image)
    return prox(regulariser, image, step, dual, nonnegative=nonnegative, iterations=iterations)[0]


def _inside(slopes):
    shape = slopes[0].shape[-2:]
    return within_field(slopes, field_masks(shape, shape))
