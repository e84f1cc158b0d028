"""Refractive indices of glasses and films as functions of the wavelength."""

import abc

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from thincam_jax._core import checks
from thincam_jax._core.checks import Number, Numbers
from thincam_jax._core.module import Module


class AbstractIndex(Module):
    """A refractive index n(λ), λ in mm (of vacuum).

    - `band`: the wavelengths for which it holds, mm.
    """

    band: eqx.AbstractVar[tuple[float, float]]

    @abc.abstractmethod
    def __call__(self, wavelength: Numbers) -> Float[Array, "..."]:
        """n at wavelengths in mm."""


class ConstantIndex(AbstractIndex):
    """Refractive index without dispersion."""

    value: Float[Array, ""]
    band: tuple[float, float] = eqx.field(static=True, default=(0.0, float("inf")))

    def __init__(self, value: Number):
        self.value = checks.positive("index", value, "(no unit)")
        self.band = (0.0, float("inf"))

    def __call__(self, wavelength: Numbers):
        return jnp.broadcast_to(self.value, jnp.shape(wavelength))


class CauchyIndex(AbstractIndex):
    """n = A + B/λ², the usual description of photopolymers in the visible.

    - `offset`: A. `dispersion`: B, mm² (1 µm² is 1e-6 mm²).
    """

    offset: Float[Array, ""]
    dispersion: Float[Array, ""]
    band: tuple[float, float] = eqx.field(static=True)

    def __init__(
        self, offset: Number, dispersion: Number, band: tuple[float, float] = (350e-6, 1000e-6)
    ):
        self.offset = checks.positive("offset", offset, "(no unit)")
        self.dispersion = checks.non_negative("dispersion", dispersion, "mm²")
        self.band = band

    def __call__(self, wavelength: Numbers):
        return self.offset + self.dispersion / wavelength**2


class SellmeierIndex(AbstractIndex):
    """n² = 1 + Σ Bᵢλ²/(λ² − Cᵢ), three terms; the catalogues of glass makers give Bᵢ and Cᵢ.

    - `strengths`: Bᵢ. `resonances`: Cᵢ, mm² (1 µm² is 1e-6 mm²).
    """

    strengths: Float[Array, "3"]
    resonances: Float[Array, "3"]
    band: tuple[float, float] = eqx.field(static=True)

    def __init__(self, strengths: Numbers, resonances: Numbers, band: tuple[float, float]):
        self.strengths = checks.finite("strengths", strengths, "(no unit)", shape=(3,))
        self.resonances = checks.finite("resonances", resonances, "mm²", shape=(3,))
        self.band = band

    def __call__(self, wavelength: Numbers):
        squared = jnp.asarray(wavelength)[..., None] ** 2
        terms = self.strengths * squared / (squared - self.resonances)
        return jnp.sqrt(1 + jnp.sum(terms, axis=-1))


def bk7() -> SellmeierIndex:
    """Schott N-BK7 (Schott, Optical glass data sheets): 1.5168 at 587.6 nm."""
    return SellmeierIndex(
        jnp.array([1.03961212, 0.231792344, 1.01046945]),
        jnp.array([0.00600069867, 0.0200179144, 103.560653]) * 1e-6,
        (310e-6, 2325e-6),
    )


def as_index(name: str, value: AbstractIndex | Number) -> AbstractIndex:
    """An index as given, or a constant one of a plain number."""
    if isinstance(value, AbstractIndex):
        return value
    number = checks.real(name, value, "(no unit)")
    if not checks.is_traced(number) and not float(number) >= 1:
        raise ValueError(f"{name} = {float(number):g} is below that of vacuum; give at least 1")
    if not checks.is_traced(number) and not float(number) <= 5:
        raise ValueError(f"{name} = {float(number):g} is above that of any film; give at most 5")
    return ConstantIndex(number)


class ChangedIndex(AbstractIndex):
    """An index that development has changed by the same amount at every wavelength."""

    before: AbstractIndex
    change: Float[Array, ""]
    band: tuple[float, float] = eqx.field(static=True)

    def __call__(self, wavelength: Numbers):
        return self.before(wavelength) + self.change


def changed(index: AbstractIndex, change: Float[Array, ""]) -> AbstractIndex:
    """The index with `change` added; a constant one stays constant."""
    if isinstance(index, ConstantIndex):
        return ConstantIndex(index.value + change)
    return ChangedIndex(before=index, change=change, band=index.band)
