"""Precision: evaluating in another one, and complex phasors in that of their phase."""

import contextlib
from collections.abc import Iterator
from typing import Any, Literal, get_args

import jax
import jax.numpy as jnp
from jaxtyping import Array, Complex, Float

from thincam_jax._core import checks

Precision = Literal["float32", "float64"]
# Relative L2 error of an image that is rounded to a precision.
RESULT_ROUNDING: dict[Precision, float] = {"float32": 3e-8, "float64": 1e-16}
PRECISIONS: tuple[Precision, ...] = get_args(Precision)


def precision_of(array: Any) -> Precision:
    """The precision of a floating array."""
    return "float64" if array.dtype == jnp.float64 else "float32"


def itemsize_of(precision: Precision) -> int:
    """Bytes of a real number."""
    return jnp.dtype(precision).itemsize


@contextlib.contextmanager
def allow(precision: Precision, *numbers: Any) -> Iterator[None]:
    """Makes float64 available inside, also where JAX is set to float32 only.

    JAX cannot change that setting while it traces `numbers`: ValueError.
    """
    if precision == "float32" or jax.config.read("jax_enable_x64"):
        yield
        return
    if any(checks.is_traced(leaf) for leaf in jax.tree.leaves(numbers)):
        raise ValueError(
            "precision 'float64' inside jit or grad needs double precision switched on: call "
            "jax.config.update('jax_enable_x64', True) at the start of the program"
        )
    with jax.enable_x64(True):
        yield


def product(first: Any, second: Any) -> Any:
    """Matrix product with all the digits of its precision.

    An accelerator's default multiplies float32 with fewer.
    """
    return jnp.matmul(first, second, precision="highest")


def cast(tree: Any, precision: Precision) -> Any:
    """The pytree with all its floating arrays, and plain floats, in one precision."""
    target = jnp.dtype(precision)

    def convert(leaf):
        if isinstance(leaf, bool | int | str) or leaf is None:
            return leaf
        if isinstance(leaf, float):
            return jnp.asarray(leaf, target)
        if jnp.issubdtype(leaf.dtype, jnp.complexfloating):
            return leaf.astype(jnp.complex128 if precision == "float64" else jnp.complex64)
        return leaf.astype(target) if jnp.issubdtype(leaf.dtype, jnp.floating) else leaf

    return jax.tree.map(convert, tree)


def phasor(phase: Float[Array, "..."]) -> Complex[Array, "..."]:
    """e^{jφ} for φ in rad."""
    return jax.lax.complex(jnp.cos(phase), jnp.sin(phase))


def turn_phasor(turns: Float[Array, "..."]) -> Complex[Array, "..."]:
    """e^{2πjτ} for τ in turns, reduced to ±½ before it is multiplied by 2π."""
    return phasor(2 * jnp.pi * (turns - jnp.round(turns)))


def as_complex(value: Float[Array, "..."]) -> Complex[Array, "..."]:
    """A real array as a complex one of the same precision (strict promotion forbids it unsaid)."""
    return jax.lax.complex(value, jnp.zeros_like(value))
