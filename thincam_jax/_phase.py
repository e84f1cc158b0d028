"""Complex phasors from real phases, in the precision of the phase."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Complex, Float


def phasor(phase: Float[Array, "..."]) -> Complex[Array, "..."]:
    """e^{jφ} for φ in rad."""
    return jax.lax.complex(jnp.cos(phase), jnp.sin(phase))


def turn_phasor(turns: Float[Array, "..."]) -> Complex[Array, "..."]:
    """e^{2πjτ} for τ in turns, reduced to ±½ before it is multiplied by 2π."""
    return phasor(2 * jnp.pi * (turns - jnp.round(turns)))


def as_complex(value: Float[Array, "..."]) -> Complex[Array, "..."]:
    """A real array as a complex one of the same precision (strict promotion forbids it unsaid)."""
    return jax.lax.complex(value, jnp.zeros_like(value))
