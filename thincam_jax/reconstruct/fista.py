r"""One accelerated proximal-gradient step, with restart: shared by all that iterate it."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from thincam_jax.reconstruct.regulariser import (
    AbstractRegulariser,
    Parts,
    momentum,
    no_dual,
    prox,
)


class Course(eqx.Module):
    """Where an accelerated iteration stands.

    - `image`: x.
    - `lead`: y, where the next gradient is taken.
    - `t`: the length of the run-up since the start or the last restart, one of each batch member.
    - `dual`: of the proximal map, kept from step to step.
    """

    image: Float[Array, "*batch channel plane y x"]
    lead: Float[Array, "*batch channel plane y x"]
    t: Float[Array, "*batch 1 1 1 1"]
    dual: Parts


class ProximalStep(eqx.Module):
    r"""The proximal gradient step, :math:`x = \mathrm{prox}_{sR\tau}(y - s\,\nabla)`.

    - `length`: s, at most 1/L; with momentum nothing longer converges.
    - `tau`: weight of the regulariser.
    - `inner`: iterations of a proximal map without closed form.
    - `accelerate`: Nesterov's momentum (FISTA: Beck and Teboulle, SIAM J. Imaging Sci. 2, 183, 2009).
    - `restart`: start the momentum anew where it points uphill, ⟨y − x⁺, x⁺ − x⟩ > 0, the gradient
      scheme of O'Donoghue and Candès (Found. Comput. Math. 15, 715, 2015). Near the minimum, where
      the objective is about quadratic, this makes convergence linear at the best rate.
    """

    regulariser: AbstractRegulariser
    tau: Float[Array, ""]
    length: Float[Array, ""]
    nonnegative: bool = eqx.field(static=True)
    inner: int = eqx.field(static=True)
    accelerate: bool = eqx.field(static=True)
    restart: bool = eqx.field(static=True)

    def start(self, image: Float[Array, "*batch channel plane y x"]) -> Course:
        t = jnp.ones((*image.shape[:-4], 1, 1, 1, 1), image.dtype)
        return Course(image, image, t, no_dual(self.regulariser, image))

    def __call__(
        self, course: Course, gradient: Float[Array, "*batch channel plane y x"]
    ) -> Course:
        """The next state, from the gradient at `course.lead`."""
        image, dual = prox(
            self.regulariser,
            course.lead - self.length * gradient,
            self.length * self.tau,
            course.dual,
            nonnegative=self.nonnegative,
            iterations=self.inner,
        )
        if not self.accelerate:
            return Course(image, image, course.t, dual)
        moved = image - course.image
        t = course.t
        speed = (t - 1) / momentum(t)
        t = momentum(t)
        if self.restart:
            product = (course.lead - image) * moved
            uphill = jnp.sum(product, axis=(-4, -3, -2, -1), keepdims=True) > 0
            speed, t = jnp.where(uphill, 0, speed), jnp.where(uphill, 1, t)
        return Course(image, image + speed * moved, t, dual)


def relative_length(difference, reference) -> Float[Array, ""]:
    """‖difference‖/‖reference‖; zero if both are, infinite if only the reference is."""
    above, below = (jnp.sqrt(jnp.sum(x**2)) for x in (difference, reference))
    ratio = above / jnp.where(below > 0, below, 1)
    return jnp.where(below > 0, ratio, jnp.where(above > 0, jnp.inf, 0))
