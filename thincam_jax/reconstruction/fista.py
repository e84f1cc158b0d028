r"""One accelerated proximal-gradient step, with restart: shared by all that iterate it."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from thincam_jax.reconstruction.regulariser import (
    AbstractRegulariser,
    Parts,
    first_t,
    no_dual,
    prox,
    run_on,
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
    - `accelerate`: Nesterov's momentum (FISTA).
    - `restart`: start the momentum anew where it points uphill, see `regulariser.run_on`.
    """

    regulariser: AbstractRegulariser
    tau: Float[Array, ""]
    length: Float[Array, ""]
    nonnegative: bool = eqx.field(static=True)
    inner: int = eqx.field(static=True)
    accelerate: bool = eqx.field(static=True)
    restart: bool = eqx.field(static=True)

    def start(self, image: Float[Array, "*batch channel plane y x"]) -> Course:
        return Course(image, image, first_t(image), no_dual(self.regulariser, image))

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
        (lead,), t = run_on(
            (course.image,), (course.lead,), (image,), course.t, restart=self.restart
        )
        return Course(image, lead, t, dual)


def relative_length(difference, reference) -> Float[Array, ""]:
    """‖difference‖/‖reference‖; zero if both are, infinite if only the reference is."""
    above, below = (jnp.sqrt(jnp.sum(x**2)) for x in (difference, reference))
    ratio = above / jnp.where(below > 0, below, 1)
    return jnp.where(below > 0, ratio, jnp.where(above > 0, jnp.inf, 0))
