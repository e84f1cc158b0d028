"""Search problem of a design: an objective, the numbers that are free, and the setup."""

import dataclasses
import math
from collections.abc import Callable
from typing import Annotated, Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from thincam_jax._core.arguments import checked
from thincam_jax._core.quantity import whole
from thincam_jax.design.design import Design
from thincam_jax.design.objectives import ObjectiveData
from thincam_jax.design.setup import PhotonNoise, Polar, Quadrant, Setup
from thincam_jax.design.space import DesignSpace

# (design, data) → cost to minimise, at module level or a frozen object: it is compiled once.
Objective = Callable[[Design, Any], Float[Array, ""]]

_MARGIN, _FEWEST = 1.1, 128  # of the samples that fringes need; at least
# Along an axis, of even samples; where more are needed, so many that are close at zero only.
_MOST_EVEN, _GRADED = 1280, 384


@checked
class DesignProblem(eqx.Module):
    """Problem of a search: minimise `objective` over the designs of `space`.

    - `objective`: (design, data) → cost; an `AbstractObjective`, or a function at module level.
    - `data`: for the many evaluations of a search.
    - `exact`: for the designs found; None where `data` is exact itself.
    """

    objective: Objective
    space: DesignSpace
    data: Any
    exact: Any = None

    @property
    def best_data(self) -> Any:
        """Data that designs are ranked with: `exact`, or `data` where there is none."""
        return self.data if self.exact is None else self.exact

    @property
    def searched(self) -> "DesignProblem":
        """The problem without its exact data."""
        return dataclasses.replace(self, exact=None)

    def with_thickness(self, thickness: float) -> "DesignProblem":
        """The problem with no distance above a thickness, mm."""
        is_distance = jnp.asarray([v.name == "distance" for v in self.space.variables])
        upper = self.space.upper
        thin = jnp.where(is_distance, jnp.minimum(upper, thickness), upper)
        return dataclasses.replace(self, space=eqx.tree_at(lambda s: s.upper, self.space, thin))

    def with_electrons(self, electrons: float) -> "DesignProblem":
        """The problem at another light, electrons of a pixel from each mm² of open aperture.

        **Errors**: TypeError for noise that counts no electrons.
        """
        noise = self.data.setup.noise
        if not isinstance(noise, PhotonNoise):
            raise TypeError("noise at an SNR is the same at any light; give the setup PhotonNoise")
        number = jnp.asarray(electrons, noise.electrons.dtype)
        return self._map_data(
            lambda data: eqx.tree_at(lambda d: d.setup.noise.electrons, data, number)
        )

    def with_captures(
        self,
        space: DesignSpace,
        synthesis: Float[Array, "channel capture"] | Float[np.ndarray, "channel capture"],
    ) -> "DesignProblem":
        """The problem for designs of other captures, on the same frequencies.

        With noise that counts electrons they divide the exposure of this problem's captures evenly.
        """
        if isinstance(self.data.setup.noise, PhotonNoise):
            captures = space.base.captures
            share = jnp.full(captures, self.space.base.captures / captures, space.lower.dtype)
            space = eqx.tree_at(lambda s: s.base.exposure, space, share)
        changed, matrix = dataclasses.replace(self, space=space), jnp.asarray(synthesis, float)
        return changed._map_data(lambda data: dataclasses.replace(data, synthesis=matrix))

    def _map_data(self, change: Callable[[Any], Any]) -> "DesignProblem":
        exact = None if self.exact is None else change(self.exact)
        return dataclasses.replace(self, data=change(self.data), exact=exact)


@checked
@dataclasses.dataclass(frozen=True)
class FrequencyCounts:
    """Sampling of responses: radii and directions in a search, the square of `exact`.

    - `exact`: along each axis, close at zero only where they are fewer than the fringes of the
      responses need; None: as many as these need, or 384 where those would be too many.
    """

    radii: Annotated[int, whole(64, 8192)] = 1024
    directions: Annotated[int, whole(1, 16)] = 3
    exact: Annotated[int | None, whole(64, 4096, optional=True)] = None


@checked
def design_problem(
    objective: Objective,
    space: DesignSpace,
    setup: Setup,
    synthesis: Float[Array, "channel capture"] | Float[np.ndarray, "channel capture"],
    counts: FrequencyCounts | None = None,
) -> DesignProblem:
    r"""A search problem on frequencies that all designs of its space can be compared up to.

    They reach up to :math:`d_{max}/(4p)` cycles/rad: at the largest field of view half of the
    Nyquist frequency 1/(2p) of pixels p wide. The search evaluates rings by stationary phase, and
    its designs are improved on the exact response.

    **Precision.** The fringes of an objective are finer than single precision holds: enable JAX's
    double precision for figures of three digits and more.
    """
    counts = counts or FrequencyCounts()
    highest = jnp.asarray(space.reach("distance")[1] / (4 * float(setup.pitch)))
    needed = _exact_count(space, setup, float(highest))
    exact = counts.exact or (needed if needed <= _MOST_EVEN else _GRADED)
    matrix = jnp.asarray(synthesis, float)
    return DesignProblem(
        objective,
        space,
        ObjectiveData(setup, matrix, Polar(highest, counts.radii, counts.directions)),
        ObjectiveData(setup, matrix, Quadrant(highest, exact, needed)),
    )


def _exact_count(space: DesignSpace, setup: Setup, highest: float) -> int:
    """Samples along an axis that resolve the fringes of |H|².

    As an angle, a PSF is as wide as the mask's shadow over its distance; |H|² holds differences of
    its points, up to that width to either side.
    """
    nearest, widest = space.reach("distance")[0], space.reach("width")[1]
    shadow = widest * (1 + nearest / float(setup.object_distance)) / nearest
    return max(_FEWEST, math.ceil(_MARGIN * 2 * shadow * highest) + 1)
