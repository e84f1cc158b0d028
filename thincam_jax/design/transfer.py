r"""Modulation transfer of a design: of its sums of captures, and with the reconstruction.

A scene 1 + m cos(2πν·θ) gives the sum of captures c a fringe of the amplitude m |Σ_k W_ck H_k(ν)|,
while the captures that it is made of hold the light Σ_k |W_ck| H_k(0). Their ratio is the contrast
with which the sum shows that of the scene,

.. math:: \mathrm{MTF}_c(\nu) = \frac{|\sum_k W_{ck} \bar H_k(\nu)|}{\sum_k |W_{ck}| H_k(0)}

At most 1; a single capture has 1 at zero frequency, and a difference of captures 0. A zone aperture
spreads each point over its whole shadow, so that some per mille are all there is.

The best linear reconstruction returns of each frequency the part

.. math:: \mathrm{MTF}(\nu) = \frac{S(\nu)}{1 + S(\nu)},\qquad S = \eta_f J

of what the scene holds (`thincam_jax.design.objectives`): the contrast of the whole chain. It holds
for the noise and the prior of the setup, on average over the object's points.
"""

from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from thincam_jax._core.arguments import checked
from thincam_jax.design.design import Design
from thincam_jax.design.frequencies import Quadrant
from thincam_jax.design.objectives import ObjectiveData, channels, over_rings

RINGS = 64


@dataclass(frozen=True, eq=False)
class ModulationTransfer:
    """Contrast transfer against frequency, over rings of equal width up to the highest frequency.

    - `channels`: root mean square of MTF_c over each ring, for each sum of captures.
    - `chain`: mean of S/(1 + S) over each ring.
    - `sums`: captures that each sum adds and those that it subtracts, numbered from 1.
    """

    channels: np.ndarray
    chain: np.ndarray
    sums: tuple[tuple[tuple[int, ...], tuple[int, ...]], ...]


@checked
def modulation_transfer(design: Design, data: ObjectiveData) -> ModulationTransfer:
    """The contrast transfer of a design, by the exact response of the square aperture.

    `data`: with frequencies on a `Quadrant`. Channels are (channel, ring), the chain (ring,), both
    without unit. Valid as are the responses: Fresnel diffraction, centred masks.

    **Errors**: TypeError for frequencies on `Polar`, where the uniform background is left out.
    """
    if not isinstance(data.frequencies, Quadrant):
        raise TypeError("contrast is measured against the light at zero frequency; give a Quadrant")
    each, chain = _means(design, data)
    rows = np.asarray(data.synthesis)
    sums = tuple(
        (_numbers(row > 0), _numbers(row < 0)) if np.any(row > 0) else (_numbers(row < 0), ())
        for row in rows
    )
    return ModulationTransfer(np.asarray(each), np.asarray(chain), sums)


def _numbers(used: np.ndarray) -> tuple[int, ...]:
    return tuple(int(n) + 1 for n in np.flatnonzero(used))


@eqx.filter_jit
def _means(
    design: Design, data: ObjectiveData
) -> tuple[Float[Array, "channel ring"], Float[Array, " ring"]]:
    known = data.channels(design)
    # Each capture by itself, at zero frequency: all that its mask lets through.
    alone = jnp.eye(design.captures, dtype=data.synthesis.dtype)
    origin = Quadrant(data.frequencies.highest, 2)
    light = channels(design, data.setup, alone, origin).response[:, 0, 0]
    held = jnp.sum(jnp.abs(data.synthesis) * light, axis=1)
    contrast = known.response / held[:, None, None]
    ratio = known.signal_to_noise
    squared = jax.vmap(lambda c: over_rings(c**2, data.frequencies, RINGS))(contrast)
    return jnp.sqrt(squared), over_rings(ratio / (1 + ratio), data.frequencies, RINGS)
