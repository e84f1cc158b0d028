r"""How much a design loses when it is not built, or not known, exactly."""

from dataclasses import dataclass
from typing import Literal

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from thincam_jax._core import checks
from thincam_jax.design.design import Design
from thincam_jax.design.frequencies import Frequencies
from thincam_jax.design.objectives import bayes_error, channels, mismatch_error
from thincam_jax.design.setup import Setup


@dataclass(frozen=True)
class Tolerances:
    """Standard deviations of what the reconstruction takes for known; 0 is exact.

    - `beta`: relative, of each capture's mask on its own.
    - `distance`: mm, of each capture on its own; `wavelength`: mm, `object_distance`: mm, of all.
    - `tilt`: of the mask against the sensor, rad. Over a mask of width w it makes the distance
      vary evenly with a standard deviation of tilt·w/√12, and is counted as an error of that size.
    """

    beta: float = 0.0
    distance: float = 0.0
    wavelength: float = 0.0
    object_distance: float = 0.0
    tilt: float = 0.0


def robust_error(
    design: Design,
    setup: Setup,
    synthesis: Float[Array, "channel capture"],
    frequencies: Frequencies,
    tolerances: Tolerances,
    *,
    how: Literal["mean", "worst"] = "mean",
) -> Float[Array, ""]:
    r"""`mismatch_error` over the tolerances, of a reconstruction made for the exact design.

    "mean": its expectation for independent errors, to second order,
    :math:`E_0 + \sum_i [\tfrac12(E_{+i} + E_{-i}) - E_0]` with each number moved by its standard
    deviation. "worst": the largest of all E±i, as a soft maximum. The scale of the image on the
    sensor is taken to be registered.
    """
    checks.choice("how", how, ("mean", "worst"))
    known = channels(design, setup, synthesis, frequencies)
    exact = bayes_error(known)
    moved = list(_moved(design, setup, tolerances))
    if not moved:
        return exact

    def error(one: tuple[Design, Setup]):
        actual = channels(one[0], one[1], synthesis, frequencies)
        return mismatch_error(known, actual)

    # Stacked, they are one program in place of one for each.
    every = jax.vmap(error)(jax.tree.map(lambda *leaves: jnp.stack(leaves), *moved))
    if how == "mean":
        return exact + jnp.sum(every - exact) / 2
    # Soft to a hundredth of the error: smooth where two tolerances cost the same.
    scale = 100 / exact
    return jax.nn.logsumexp(scale * jnp.append(every, exact)) / scale


def _moved(design: Design, setup: Setup, tolerances: Tolerances):
    """The design and the setup with one number moved, either way."""
    captures = range(design.captures)
    for sign in (-1.0, 1.0):
        for k in captures:
            if tolerances.beta:
                beta = design.beta.at[k].multiply(1 + sign * tolerances.beta)
                yield eqx.tree_at(lambda d: d.beta, design, beta), setup
            if tolerances.distance:
                yield _farther(design, design.distance.at[k].add(sign * tolerances.distance)), setup
        if tolerances.tilt:
            depth = (
                sign * tolerances.tilt * design.width / jnp.sqrt(12.0).astype(design.width.dtype)
            )
            yield _farther(design, design.distance + depth), setup
        if tolerances.wavelength:
            wavelength = design.wavelength + sign * tolerances.wavelength
            yield eqx.tree_at(lambda d: d.wavelength, design, wavelength), setup
        if tolerances.object_distance:
            there = setup.object_distance + sign * tolerances.object_distance
            yield design, eqx.tree_at(lambda s: s.object_distance, setup, there)


def _farther(design: Design, distance: Float[Array, " capture"]) -> Design:
    return eqx.tree_at(lambda d: d.distance, design, distance)
