r"""A display behind a see-through screen: its colours through the plate, its light in the camera.

The bottom hologram takes light from the display on its way to the user as it takes light from the
scene: cos(**K**·**r**) is unchanged by **r** → −**r**, so that light from behind has the efficiency
of the opposite direction. What is not diffracted goes through,

.. math:: T(\mathbf t, \lambda) = \tfrac12 \sum_{p = \mathrm{TE}, \mathrm{TM}} \prod_k
    \big(1 - \eta_{k,p}(\mathbf t, \lambda)\big)

What is diffracted is guided down, away from the camera. The camera gets what is scattered, or
reflected by surfaces. This is not computed: it depends on dust, haze and edges, and is measured as
the fraction l(λ) of the irradiance that the display would give if the lens looked straight at it.
Beside an image of weight W, mm, with the display's spectrum s and the sensor's response r,

.. math:: L = \frac{R}{W} \int l(\lambda)\,s(\lambda)\,r(\lambda)\,d\lambda

is its irradiance in units of a white object that fills the field, R times as bright per nm.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from thincam_jax._core import checks
from thincam_jax._core.arguments import checked
from thincam_jax._core.module import Module
from thincam_jax._core.quantity import FieldError, quantity
from thincam_jax.imaging.encoding import cie_1931
from thincam_jax.imaging.sensor import AbstractNoise, PoissonGaussianNoise, Sensor, read_out
from thincam_jax.units import nm
from thincam_jax.waveguide.colours import ColourBand, several
from thincam_jax.waveguide.efficiency import diffraction_efficiency
from thincam_jax.waveguide.hologram import VolumeHologram

_NODES = 4001  # of wavelengths


@checked
def transmission(
    holograms: VolumeHologram | Sequence[VolumeHologram],
    tangential: Float[Array, "2"],
    wavelength: Float[Array, "*wave"],
) -> Float[Array, "*wave"]:
    """T of unpolarised light that crosses holograms in one film, or in films one on the other.

    Reflection at the glass, 8 % of both surfaces together, is left out.

    - `tangential`: direction cosines (x, y) in air, against the plate. `wavelength`: mm.
    """
    films = [holograms] if isinstance(holograms, VolumeHologram) else holograms
    ways = jnp.broadcast_to(tangential, (*wavelength.shape, 2))
    passed = [
        math.prod(1 - diffraction_efficiency(one, ways, wavelength, p, "exact") for one in films)
        for p in ("TE", "TM")
    ]
    return jnp.asarray(sum(passed)) / 2


@dataclass(frozen=True)
class Tint:
    """A white display through a plate.

    - `luminance`: the part that goes through. `shift`: change of its colour in CIE 1976 u′, v′;
      eyes see about 0.004 side by side.
    """

    luminance: float
    shift: tuple[float, float]


@checked
def tint(
    holograms: VolumeHologram | Sequence[VolumeHologram],
    direction: Float[Array, "2"],
    primaries: Sequence[ColourBand],
) -> Tint:
    """The white of a display, the sum of its primaries, as seen through holograms.

    - `direction`: direction cosines (x, y) in air.

    ```python
    import jax.numpy as jnp

    from thincam_jax import waveguide as wg
    from thincam_jax.units import deg, nm, um
    from thincam_jax.waveguide.display import tint

    film = wg.VolumeHologram.record(
        532 * nm, 0.0, 61.2 * deg, index=1.5, thickness=16 * um, index_modulation=0.02
    )
    bands = ((450 * nm, 20 * nm), (530 * nm, 35 * nm), (625 * nm, 20 * nm))
    seen = tint(film, jnp.zeros(2), [wg.ColourBand(*band) for band in bands])
    print(round(seen.luminance, 2))  # 0.84
    ```
    """
    light = np.linspace(380 * nm, 780 * nm, _NODES)
    seen = np.asarray(transmission(holograms, direction, jnp.asarray(light)), float)
    white = _sum(primaries, light)
    both = np.stack([white, white * seen]) @ cie_1931(light)
    scale = both @ np.array([1, 15, 3])
    places = both[:, :2] * np.array([4, 9]) / scale[:, None]
    u, v = (places[1] - places[0]).tolist()
    return Tint(float(both[1, 1] / both[0, 1]), (u, v))


def _sum(bands: Sequence[ColourBand], light: np.ndarray) -> np.ndarray:
    """Sum of bands at wavelengths."""
    return np.sum([np.asarray(one(jnp.asarray(light)), float) for one in bands], axis=0)


def _leak(name: str, given: Any) -> Float[Array, "row 2"]:
    table = checks.array(name, given)
    if table.ndim != 2 or table.shape[1] != 2 or len(table) < 2:
        raise ValueError(
            f"{name} has shape {table.shape}; give rows of (wavelength in mm, fraction), two or "
            "more"
        )
    light, fraction = np.asarray(table, float).T
    checks.wavelengths(name, light)
    if (np.diff(light) <= 0).any() or not (0 <= fraction).all() or not (fraction <= 1).all():
        raise ValueError(f"{name} has rows that do not rise, or fractions outside of 0 to 1")
    return table


def _pattern(name: str, given: Any) -> Float[Array, "y x"]:
    light = checks.finite(name, given, "light", shape=np.shape(given))
    if np.ndim(light) != 2 or not np.mean(light) > 0:
        raise ValueError(f"{name} has shape {np.shape(light)}; give a picture (y, x) with light")
    return light


class DisplayLight(Module):
    """Light of a white display behind the plate that reaches the camera beside the image.

    - `leak`: rows of (wavelength, fraction), measured: the sensor's irradiance over that of the
      same lens before the display itself, in light of that colour, the scene dark. Linear between
      the rows, 0 beyond.
    - `primaries`: spectra of the display's colours, which add up.
    - `radiance`: that of the display at a primary's maximum over that of a white object, per nm.
    - `pattern`: a measured picture of it on the sensor, (y, x), of any scale; None: uniform.

    ```python
    from thincam_jax import waveguide as wg
    from thincam_jax.units import nm
    from thincam_jax.waveguide.display import DisplayLight

    leak = [(400 * nm, 1e-3), (700 * nm, 1e-3)]  # measured
    light = DisplayLight(leak, [wg.ColourBand(530 * nm, 60 * nm)])
    print(light.irradiance((2, 3), level=6 * nm).mean().round(4))  # 0.0106
    ```

    **See also**: `plan_screen`.
    """

    leak: Float[Array, "row 2"] = eqx.field(converter=quantity(check=_leak))
    primaries: tuple[ColourBand, ...] = eqx.field(converter=quantity(check=several(ColourBand)))
    radiance: Float[Array, ""] = eqx.field(default=1.0, converter=quantity(positive=True))
    pattern: Float[Array, "y x"] | None = eqx.field(
        default=None, converter=quantity(check=_pattern, optional=True)
    )

    def irradiance(
        self, shape: tuple[int, int], level: float, response: ColourBand | None = None
    ) -> Float[np.ndarray, "y x"]:
        """L on a sensor of (rows, columns), the mean of a pattern.

        - `level`: W of the image, mm, such as `ScreenPlan.level`. `response`: that of a channel;
          None for 1 at all wavelengths, as a `direct_band` has it.

        **Errors**: ValueError for a pattern of other pixels.
        """
        table = np.asarray(self.leak, float)
        light = np.linspace(table[0, 0], table[-1, 0], _NODES)
        spectrum = _sum(self.primaries, light)
        if response is not None:
            spectrum = spectrum * _sum([response], light)
        total = np.trapezoid(np.interp(light, *table.T) * spectrum, light)
        mean = float(self.radiance) * float(total) / level
        if self.pattern is None:
            return np.full(shape, mean)
        if self.pattern.shape != shape:
            raise ValueError(
                f"the pattern of the display's light has {self.pattern.shape} pixels; give {shape}"
            )
        picture = np.asarray(self.pattern, float)
        return mean * picture / picture.mean()


def require_display_fits(noise: AbstractNoise, colours: int, mask: bool) -> None:
    """Refuse what a study with the light of a display has not.

    **Errors**: FieldError, with the keys of a file.
    """
    if colours > 1 or mask:
        message = "takes a lens and one colour; drop it (plan_screen takes colours)"
        raise FieldError(message, "display_light")
    if not isinstance(noise, PoissonGaussianNoise):
        fault = "light of a display has shot noise; give read_noise"
        raise FieldError(fault, "noise", "read_noise")


def display_alone(
    light: Float[Array, "y x"],
    electrons: Float[Array, "capture 1 1"],
    read: tuple[Sensor, AbstractNoise, Array],
    frames: int,
) -> tuple[Float[Array, "capture y x"], Float[Array, " capture"]]:
    """Mean exposure of the display before a dark scene, and its variance, to subtract.

    - `electrons`: per unit of each capture, and of the exposures to subtract from it.
    - `read`: sensor, noise and a key. `frames`: number of exposures for each capture.
    """
    sensor, noise, key = read
    means = []
    for number, counted in enumerate(np.ravel(electrons).tolist()):
        held = sensor.replace(exposure=None, electrons=counted)
        keys = jax.random.split(jax.random.fold_in(key, number), frames)
        taken = [read_out(held, light, noise=noise, key=one) for one in keys]
        means.append(jnp.mean(jnp.stack(taken), axis=0))
    alone = jnp.broadcast_to(light, (len(means), *light.shape))
    return jnp.stack(means), noise.variance(alone, electrons) / frames
