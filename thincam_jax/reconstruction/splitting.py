r"""ADMM for total variation: what it iterates, whatever the structure of the operators.

The image f is split so that each part of the objective has a proximal map in closed form. With
K f the parts, penalties μ (diagonal M) and the scaled duals λ, only q = Kf + λ is carried along, in
the Douglas–Rachford form of ADMM (Eckstein and Bertsekas, Math. Program. 55, 293, 1992),

.. math:: z = \mathrm{prox}(q),\quad f = (K^T M K)^{-1} K^T M (2z - q),\quad
    T(q) = q + K f - z .

The minimiser is a fixed point of T, which is averaged: q ← q + α (T(q) − q) converges for
0 < α < 2. α = 1 is plain ADMM, 1 < α < 2 over-relaxes. This needs half of the usual arrays, and
implicit differentiation asks for such a map.

How f is split follows from the operators: `fourier_splitting` for convolutions on one window,
`direct_splitting` for all others.
"""

import abc
from typing import ClassVar, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from thincam_jax.reconstruction.regularisers import Image
from thincam_jax.reconstruction.total_variation import TotalVariation


class Penalties(eqx.Module):
    """μ of the three splits, in the units of the splitting."""

    data: Float[Array, ""]
    variation: Float[Array, ""]
    image: Float[Array, ""]


class State(eqx.Module):
    """q of the three splits: data, differences and image."""

    data: tuple[Float[Array, "..."], ...]
    slopes: tuple[Float[Array, "..."], ...]
    image: Float[Array, "..."]


Some = TypeVar("Some", bound="AbstractSplitting")


class AbstractSplitting(eqx.Module):
    """A problem split for ADMM, in units in which captures, operators and weights are about 1.

    Whatever the units of the captures, iterations see the same numbers, and the image scales with
    the captures.

    - `tau`: weight of the variation in these units.
    - `image_unit`: the image is that of `State`, times this.
    - `settling`: penalties follow the residuals only while one is above this overall.
    """

    settling: ClassVar[float] = 0.0
    penalties: Penalties
    tau: Float[Array, ""]
    variation: TotalVariation
    image_unit: Float[Array, ""]
    nonnegative: bool = eqx.field(static=True)

    @abc.abstractmethod
    def start(self, image: Image) -> State:
        """The state of an image, with no forces yet."""

    @abc.abstractmethod
    def image(self, state: State) -> Image:
        """The image that a state stands for: non-negative if that is asked."""

    @abc.abstractmethod
    def reflected(self, state: State) -> State:
        """2z − q, where z minimises each part of the objective plus μ/2 ‖z − q‖²."""

    @abc.abstractmethod
    def nearest(self, target: State) -> State:
        """K f of the f whose K f is nearest to the target in the norm of the penalties."""

    @abc.abstractmethod
    def with_captures(self: Some, captures: tuple[Float[Array, "..."], ...]) -> Some:
        """The same splitting, units included, of other captures g."""

    def with_penalties(self: Some, penalties: Penalties) -> Some:
        """The same splitting with other penalties."""
        return eqx.tree_at(lambda s: s.penalties, self, penalties)

    def settled(self: Some) -> Some:
        """The same where penalties stay for hundreds of iterations."""
        return self


def admm_map(state: State, splitting: AbstractSplitting) -> State:
    """T(q), for `optimistix.fixed_point(admm_map, …, args=splitting)`."""
    # The barrier has it computed once: it enters the sum of differences and the update below.
    mirrored = jax.lax.optimization_barrier(splitting.reflected(state))
    images = splitting.nearest(mirrored)
    return jax.tree.map(lambda q, m, k: q + (k - 0.5 * (q + m)), state, mirrored, images)


def consensus(splitting: AbstractSplitting, state: State) -> State:
    """z of a state."""
    return jax.tree.map(lambda q, r: 0.5 * (q + r), state, splitting.reflected(state))


def rescaled(splitting: AbstractSplitting, state: State, factors: Penalties) -> State:
    """The state that keeps image and forces when penalties are multiplied: q = z + λ, λ ∝ 1/μ."""
    settled = consensus(splitting, state)

    def scaled(part, factor):
        return jax.tree.map(lambda q, z: z + (q - z) / factor, *part)

    return State(
        scaled((state.data, settled.data), factors.data),
        scaled((state.slopes, settled.slopes), factors.variation),
        scaled((state.image, settled.image), factors.image),
    )


def squared_sizes(state: State) -> Float[Array, "3"]:
    """Squared norms of the three splits."""
    parts = (state.data, state.slopes, state.image)
    return jnp.stack([sum(jnp.sum(x**2) for x in jax.tree.leaves(part)) for part in parts])
