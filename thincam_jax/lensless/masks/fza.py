r"""The Fresnel zone aperture (FZA), thesis Eq 3.1."""

from typing import Annotated, Any, Literal, get_args

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float

from thincam_jax._core import checks
from thincam_jax._core.checks import Number, Numbers
from thincam_jax._core.grids import Grid, centred_indices
from thincam_jax._core.precision import as_complex, decimal_value, phasor
from thincam_jax._core.quantity import choice, quantity
from thincam_jax.lensless.masks.base import (
    AbstractFactoredMask,
    AxisFactors,
    MaskTerms,
    ZoneOrders,
    open_parts,
    pairs,
)

_HIGHEST_HARMONIC = 99
Profile = Literal["cosine", "intensity", "binary"]
PROFILES: tuple[Profile, ...] = get_args(Profile)


PIXEL_PITCH = quantity("mm", positive=True, optional=True)


def _odd(name: str, value: int) -> int:
    if value % 2 == 0 or not 1 <= value <= _HIGHEST_HARMONIC:
        raise ValueError(f"{name} = {value}: give an odd number from 1 to {_HIGHEST_HARMONIC}")
    return value


class FresnelZoneAperture(AbstractFactoredMask):
    r"""A square or rectangular Fresnel zone aperture.

    Amplitude transmittance of the cosine profile, :math:`r` from the mask's centre (thesis Eq 3.1,
    which Eq 3.18 propagates as a field):

    .. math:: t(r) = \tfrac12 [1 + \cos(\beta r^2 + \varphi)]

    Behind it the geometric shadow is t². Much of the literature has the cosine in the irradiance,
    :math:`I = \tfrac12 [1 + \cos(\beta r^2 + \varphi)]`. That is the profile "intensity": its
    amplitude is :math:`\sqrt I = |\cos((\beta r^2 + \varphi)/2)|`, that of a grey film without
    phase, represented by its Fourier series
    :math:`\tfrac2\pi \sum_k (-1)^{k+1}/(4k^2-1)\, e^{jk(\beta r^2+\varphi)}` up to ``harmonics``;
    what is left out is at most 2/π/(2·harmonics + 1) of the amplitude, where it is dark.

    The binary profile opens where that cosine is positive. It is represented by its Fourier series
    in the phase, :math:`\tfrac12 + \sum_{k\ odd} \sin(k\pi/2)/(k\pi)\, e^{jk(\beta r^2+\varphi)}`,
    up to ``harmonics``: the best approximation with that many orders, with the overshoot of a
    truncated series at the zone edges. Every harmonic k acts like a cosine mask of :math:`k\beta`.

    **Arguments**

    - `beta`: β, rad/mm², > 0. The zones at the edge have the local frequency β·width/(2π).
    - `phase`: initial phase φ, rad.
    - `width`: side of the square aperture, mm; of a rectangle that along x.
    - `height`: side of a rectangle along y, mm; None for a square.
    - `profile`: "cosine", "intensity" or "binary".
    - `centre`: (y, x) of the mask's centre, mm.
    - `pixel_pitch`: pitch in mm of the display that shows the mask (a spatial light modulator);
      None for a printed mask. Each pixel shows the pattern's value at its centre; the sides must
      be whole numbers of pixels.
    - `fill_factor`: open fraction of a display pixel's area, 0 < fill_factor ≤ 1.
    - `harmonics`: highest harmonic of the intensity and binary profiles, odd.

    **Errors**: ValueError or TypeError, one line, for what is out of range.

    ```python
    import thincam_jax as tc
    from thincam_jax.units import nm, um

    mask = tc.FresnelZoneAperture(25.0, width=1.6)
    camera = tc.LenslessCamera(mask, tc.Sensor((24, 32), 50 * um), distance=5.0)
    h = tc.psf(camera, wavelength=500 * nm, object_distance=250.0)
    ```

    **See also**: `LenslessCamera`, `psf`, `lensless.masks.display.on_display`.
    """

    beta: Float[Array, ""] = eqx.field(converter=quantity("rad/mm^2", positive=True))
    phase: Float[Array, ""] = eqx.field(converter=quantity("rad"))
    width: Float[Array, ""] = eqx.field(converter=quantity("mm", positive=True))
    height: Float[Array, ""] | None = eqx.field(
        converter=quantity("mm", positive=True, optional=True)
    )
    centre: Float[Array, "2"] = eqx.field(converter=quantity("mm", shape=(2,)))
    fill_factor: Float[Array, ""] = eqx.field(converter=quantity(check=checks.fraction))
    profile: Profile = eqx.field(converter=choice(PROFILES), static=True)
    pixels: tuple[int, int] | None = eqx.field(static=True)
    harmonics: int = eqx.field(converter=quantity(check=_odd), static=True)

    def __init__(
        self,
        beta: Number,
        phase: Number = 0.0,
        *,
        width: Number,
        height: Number | None = None,
        profile: Profile = "cosine",
        centre: Numbers | tuple[Number, Number] = (0.0, 0.0),
        pixel_pitch: Annotated[Number | None, PIXEL_PITCH] = None,
        fill_factor: Number = 1.0,
        harmonics: int = 9,
    ):
        given: Any = beta, phase, width, height, centre, fill_factor  # converted afterwards
        self.beta, self.phase, self.width, self.height, self.centre, self.fill_factor = given
        self.profile, self.harmonics = profile, harmonics
        self.pixels = None
        if pixel_pitch is not None:
            columns = checks.whole_cells("width", width, "pixel_pitch", pixel_pitch)
            rows = (
                columns
                if height is None
                else checks.whole_cells("height", height, "pixel_pitch", pixel_pitch)
            )
            self.pixels = rows, columns

    @property
    def pixel_pitch(self) -> Any:
        """Pitch of the display that shows the mask, mm; None for a printed one."""
        return None if self.pixels is None else decimal_value(self.width) / self.pixels[1]

    @property
    def extent(self) -> tuple[Float[Array, ""], Float[Array, ""]]:
        return self.width if self.height is None else self.height, self.width

    @property
    def finest_frequency(self) -> Float[Array, ""]:
        """Local zone frequency at the middle of the farther edges, cycles/mm."""
        return _finest_frequency(self.beta, *self.extent)

    @property
    def orders(self) -> tuple[int, ...]:
        """The diffraction orders k of the profile, without their weights."""
        return _series(self.profile, self.harmonics)[0]

    def zone_orders(self) -> ZoneOrders:
        """The unbounded zone plate: what `paraxial`, `closed_form` and its response are made of."""
        orders, coefficients = self._orders()
        return ZoneOrders(orders, coefficients, self.beta, self.width)

    def terms(self, wavelength: Number | None = None) -> MaskTerms:
        orders, coefficients = self._orders()
        return self._terms(np.asarray(orders), coefficients)

    def irradiance(self, wavelength: Number | None = None) -> MaskTerms:
        """|t|² = Re Σ_m w_m e^{jmβr²} over the different m ≥ 0 only."""
        orders, coefficients = self._orders()
        first, second, weights = pairs(coefficients)
        difference = np.asarray(orders)[first] - np.asarray(orders)[second]
        # A pair and its conjugate carry the same real part: fold the negative orders.
        folded = jnp.where(difference < 0, weights.conj(), weights)
        different, position = np.unique(np.abs(difference), return_inverse=True)
        total = jnp.zeros(len(different), weights.dtype).at[position].add(folded)
        return self._terms(different, total)

    def sample(self, grid: Grid, wavelength: Number | None = None) -> Float[Array, "y x"]:
        return jnp.real(super().sample(grid, wavelength))

    def _orders(self) -> tuple[tuple[int, ...], Complex[Array, " order"]]:
        orders, weights = _series(self.profile, self.harmonics)
        k = jnp.asarray(orders, dtype=self.beta.dtype)
        weights = jnp.asarray(weights, dtype=self.beta.dtype)
        # Not `phasor`, whose multiples of π/2 are exact up to 1e5 rad only.
        phase = k * self.phase
        return orders, as_complex(weights) * jax.lax.complex(jnp.cos(phase), jnp.sin(phase))

    def _terms(self, orders: np.ndarray, coefficients: Complex[Array, " order"]) -> MaskTerms:
        columns = self._factors(orders, 1)
        return MaskTerms(
            coefficients, columns if self.height is None else self._factors(orders, 0), columns
        )

    def _factors(self, orders: np.ndarray, axis: int) -> AxisFactors:
        curvatures = jnp.asarray(orders, dtype=self.beta.dtype) * self.beta
        side = self.extent[axis]
        if self.pixels is None:
            whole = as_complex(jnp.ones_like(curvatures)[:, None])
            return AxisFactors(jnp.stack([-side / 2, side / 2]), whole, curvatures)
        pitch = side / self.pixels[axis]
        sites = centred_indices(self.pixels[axis], self.beta.dtype) * pitch
        shown = phasor(curvatures[:, None] * sites**2)
        return open_parts(shown, pitch, self.fill_factor)


def edge_frequency(beta: Any, width: Any) -> Any:
    """Zone frequency β·width/(2π) at an aperture's edge, cycles/mm: d(βr²)/dr = 2πf there."""
    return beta * width / (2 * np.pi)


@jax.jit
def _finest_frequency(beta, height, width) -> Float[Array, ""]:
    return edge_frequency(beta, jnp.maximum(height, width))


def _series(profile: str, harmonics: int) -> tuple[tuple[int, ...], tuple[float, ...]]:
    """Orders k and weights of the profile's Fourier series in the phase βr² + φ."""
    if profile == "cosine":
        return (0, 1, -1), (0.5, 0.25, 0.25)
    if profile == "intensity":
        every = [0, *(k for n in range(1, harmonics + 1) for k in (n, -n))]
        return tuple(every), tuple(2 / np.pi * (-1.0) ** (k + 1) / (4 * k * k - 1) for k in every)
    odd = [k for n in range(1, harmonics + 1, 2) for k in (n, -n)]
    return (0, *odd), (0.5, *(float(np.sin(k * np.pi / 2) / (k * np.pi)) for k in odd))
