"""Precision: evaluating in another one, and complex phasors in that of their phase."""

import contextlib
import math
from collections.abc import Iterator
from typing import Any, Literal, get_args

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float

from thincam_jax._core import checks

Precision = Literal["float32", "float64"]
# Relative L2 error of an image that is rounded to a precision.
RESULT_ROUNDING: dict[Precision, float] = {"float32": 3e-8, "float64": 1e-16}
PRECISIONS: tuple[Precision, ...] = get_args(Precision)


class AccuracyWarning(UserWarning):
    """A default trades accuracy for time, or is used where it is some per cent off.

    ```python
    import warnings

    import thincam_jax as tc

    warnings.simplefilter("ignore", tc.lensless.AccuracyWarning)
    ```

    **See also**: `PsfMethod`, `lensless.sampling.SamplingWarning`.
    """


def precision_of(array: Any) -> Precision:
    """The precision of a floating array."""
    return "float64" if array.dtype == jnp.float64 else "float32"


def itemsize_of(precision: Precision) -> int:
    """Bytes of a real number."""
    return jnp.dtype(precision).itemsize


def is_double() -> bool:
    """Whether JAX computes in double precision by default."""
    return bool(jax.config.read("jax_enable_x64"))


def double_precision(on: bool) -> contextlib.AbstractContextManager[None]:
    """Computing in double precision by default, or not, while the context lasts."""
    return jax.enable_x64(on)


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


def decimal_value(value: Any) -> Any:
    """The decimal number behind a stored one: 0.0055 for the float32 0.005499999970197678.

    Sizes that are counted from plain numbers come out the same whatever the precision in between.
    A traced value is returned as it is.
    """
    return value if checks.is_traced(value) else float(str(np.asarray(value)[()]))


def product(first: Any, second: Any) -> Any:
    """Matrix product with all the digits of its precision.

    An accelerator's default multiplies float32 with fewer.
    """
    return jnp.matmul(first, second, precision="highest")


@jax.jit
def flat_root(value: Any) -> Any:
    """√ with a slope of 0, not of infinity, at 0."""
    zero = value == 0
    return jnp.where(zero, 0, jnp.sqrt(jnp.where(zero, 1, value)))


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


# π/2 as a sum whose first part has few digits: its multiples up to 1e5 rad, or 1e6 in double
# precision, are exact (Cody and Waite 1980).
_QUARTER: dict[Precision, tuple[float, ...]] = {
    "float32": (1.5703125, 4.837512969970703125e-4, 7.54978995489188216e-8),
    "float64": (1.57079632673412561417, 6.07710050650619224932e-11),
}
# Terms of the Taylor series of sin and cos that are enough within ±π/4.
_TERMS: dict[Precision, int] = {"float32": 5, "float64": 9}


@jax.custom_jvp
@jax.jit
def phasor(phase: Float[Array, "..."]) -> Complex[Array, "..."]:
    """e^{jφ} for φ in rad, to the last digit of φ.

    In the time of a few products: `jnp.cos` and `sin` take most of that of a PSF.
    """
    quarters = jnp.round(phase * (2 / math.pi))
    precision = precision_of(phase)
    for part in _QUARTER[precision]:
        phase = phase - quarters * part
    phase = jnp.clip(phase, -0.8, 0.8)  # where φ has no digits left, at least a modulus of one
    sine, cosine = jnp.zeros_like(phase), jnp.zeros_like(phase)
    for m in reversed(range(_TERMS[precision])):
        sign = (-1.0) ** m
        sine = sine * phase**2 + sign / math.factorial(2 * m + 1)
        cosine = cosine * phase**2 + sign / math.factorial(2 * m)
    sine = sine * phase
    turned = quarters - 4 * jnp.floor(quarters / 4)
    odd = (turned == 1) | (turned == 3)
    real, imaginary = jnp.where(odd, sine, cosine), jnp.where(odd, cosine, sine)
    real = jnp.where((turned == 1) | (turned == 2), -real, real)
    return jax.lax.complex(real, jnp.where(turned >= 2, -imaginary, imaginary))


@phasor.defjvp
def _phasor_slope(primals, tangents):
    """j e^{jφ}."""
    (phase,), (phase_dot,) = primals, tangents
    value = phasor(phase)
    return value, value * jax.lax.complex(jnp.zeros_like(phase_dot), phase_dot)


def turn_phasor(turns: Float[Array, "..."]) -> Complex[Array, "..."]:
    """e^{2πjτ} for τ in turns, reduced to ±½ before it is multiplied by 2π."""
    return phasor(2 * jnp.pi * (turns - jnp.round(turns)))


def as_complex(value: Float[Array, "..."]) -> Complex[Array, "..."]:
    """A real array as a complex one of the same precision (strict promotion forbids it unsaid)."""
    return jax.lax.complex(value, jnp.zeros_like(value))


def squared_modulus(value: Complex[Array, "..."]) -> Float[Array, "..."]:
    """|z|², without the root that `abs` takes."""
    return value.real**2 + value.imag**2


def scaled(spectrum: Complex[Array, "..."], factor: Float[Array, "..."]) -> Complex[Array, "..."]:
    """A complex array times a real one; a complex division takes several times as long."""
    return jax.lax.complex(spectrum.real * factor, spectrum.imag * factor)
