r"""Volume holograms: how they are recorded, and the light that they diffract.

Two plane waves of a laser record planes of refractive index with the grating vector

.. math:: \mathbf K = \frac{2\pi n}{\lambda}(\hat{\mathbf o} - \hat{\mathbf r})

of the directions of the object and the reference wave in the film (thesis Eq 5.4; for the
reflection hologram the reference comes from the other side, which the thesis misses: its Θ_R is the
acute angle, so that K_z has a plus). Light of direction s in the film is diffracted where it meets
the Bragg condition (Eq 5.5); with k = 2πn/λ this is a mirror reflection at the planes,

.. math:: \lambda_B = 4\pi n\,\mathbf s\cdot\mathbf K/|\mathbf K|^2, \qquad
    \mathbf s' = \mathbf s - 2(\mathbf s\cdot\hat{\mathbf K})\hat{\mathbf K}

Directions are unit vectors (x, y, z) in the film; z is its normal.
"""

import functools
from typing import Annotated

import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix
from jaxtyping import Array, Bool, Float

from thincam_jax._core import checks
from thincam_jax._core.checks import Number
from thincam_jax._core.module import Module
from thincam_jax._core.quantity import quantity
from thincam_jax.imaging.refractive_index import AbstractIndex, ConstantIndex, as_index, changed


def _acute(name: str, angle: Number) -> Float[Array, ""]:
    value = checks.real(name, angle, "rad")
    if not checks.is_traced(value) and not abs(float(value)) < jnp.pi / 2:
        raise ValueError(
            f"{name} = {float(value):g} rad is not acute; give the angle from the film's normal, "
            "between −π/2 and π/2, such as 61.2 * deg"
        )
    return value


_ACUTE = quantity("rad", check=_acute)
_FILM = quantity("mm", least=1e-4, most=10.0)  # what must be µm or m is refused
_MODULATION = quantity(check=functools.partial(checks.between, unit="a ratio", least=0.0, most=0.5))


class VolumeHologram(Module):
    """A reflection hologram of plane, equidistant fringes in a film.

    - `grating`: K, rad/mm, (x, y, z).
    - `index`: index of the film after processing, also that of the glass that it is on (no
      refraction between the two).
    - `thickness`: thickness of the film after processing, mm.
    - `index_modulation`: Δn, the amplitude of n + Δn·cos(K·r). Above 0.012 efficiencies of single
      rays are more than 0.03 off by Kogelnik's equations; see `diffraction_efficiency`.
    """

    grating: Float[Array, "3"] = eqx.field(converter=quantity("rad/mm", shape=(3,)))
    index: AbstractIndex = eqx.field(converter=quantity(check=as_index))
    thickness: Float[Array, ""] = eqx.field(converter=_FILM)
    index_modulation: Float[Array, ""] = eqx.field(converter=_MODULATION)

    @staticmethod
    def record(
        wavelength: Annotated[Number, quantity("mm", check=checks.wavelength)],
        object_angle: Annotated[Number, _ACUTE],
        reference_angle: Annotated[Number, _ACUTE],
        *,
        index: Annotated[AbstractIndex | Number, quantity(check=as_index)],
        thickness: Annotated[Number, _FILM],
        index_modulation: Annotated[Number, _MODULATION],
    ) -> "VolumeHologram":
        """The reflection hologram that two plane waves in the plane x = 0 record.

        - `wavelength`: wavelength of the laser, mm.
        - `object_angle`, `reference_angle`: from the normal in the film, rad, both acute: the
          object wave runs along +z, the reference wave along −z. `refracted` makes them of angles
          in glass or air.
        - `index`, `thickness`: index and thickness (mm) of the film during recording. See
          `processed` for the changes by development.
        - `index_modulation`: Δn.
        """
        laser = checks.wavelength("wavelength", wavelength)
        film = as_index("index", index)
        toward = _acute("object_angle", object_angle)
        reference = _acute("reference_angle", reference_angle)
        across = jnp.sin(toward) - jnp.sin(reference)
        along = jnp.cos(toward) + jnp.cos(reference)
        wavenumber = 2 * jnp.pi * film(laser) / laser
        grating = wavenumber * jnp.stack([jnp.zeros_like(across), across, along])
        return VolumeHologram(grating, film, thickness, index_modulation)

    def processed(
        self, shrinkage: Number = 0.0, index_change: Number | None = None
    ) -> "VolumeHologram":
        """The hologram after development.

        - `shrinkage`: part of the thickness that is lost; the fringes come nearer along the normal.
        - `index_change`: change of the average index; None for none.
        """
        shrinkage = checks.real("shrinkage", shrinkage, "parts of the thickness")
        if not checks.is_traced(shrinkage) and not -1 < float(shrinkage) < 1:
            raise ValueError(f"shrinkage = {float(shrinkage):g}; give a part between −1 and 1")
        index = self.index
        if index_change is not None:
            index = changed(index, checks.finite("index_change", index_change, "n"))
        grating = self.grating / jnp.ones(3).at[2].set(1 - shrinkage).astype(self.grating.dtype)
        thickness = self.thickness * (1 - shrinkage)
        return VolumeHologram(grating, index, thickness, self.index_modulation)

    def diffracted(self, direction: Float[Array, "*ray 3"]) -> Float[Array, "*ray 3"]:
        r"""s′ of Bragg-matched light of direction s: the reflection at the fringes.

        Near grazing most digits of s − 2(s·K̂)K̂ cancel in z. There it is computed as

        .. math:: s'_z = \frac{s_z(K_x^2 + K_y^2 - K_z^2) - 2K_z(s_xK_x + s_yK_y)}{|\mathbf K|^2}

        with the difference of squares as a product: of light along the normal and fringes tilted
        about x or y no digit is lost, of other light the rounding of s and K divided by s′_z.
        """
        tangential, normal = self.grating[:2], self.grating[2]
        projected = jnp.sum(direction[..., :2] * tangential, axis=-1, keepdims=True)
        swapped = jnp.abs(tangential[0]) > jnp.abs(tangential[1])
        less, more = jnp.where(swapped, tangential[::-1], tangential)
        difference = less**2 + (more - normal) * (more + normal)
        power = jnp.sum(self.grating**2)
        fringes = power > 0  # without any, s′ is s
        difference, power = jnp.where(fringes, difference, 1), jnp.where(fringes, power, 1)
        along = projected + direction[..., 2:] * normal
        across = direction[..., :2] - 2 * along / power * tangential
        depth = (direction[..., 2:] * difference - 2 * normal * projected) / power
        return jnp.concatenate([across, depth], axis=-1)

    def bragg_wavelength(
        self, tangential: Float[Array, "*ray 2"]
    ) -> tuple[Float[Array, "*ray"], Bool[Array, "*ray"]]:
        r"""λ in vacuum, mm, that Bragg-matches light from air, and whether there is one.

        `tangential` are the direction cosines (x, y) in air, which refraction keeps. With s = t/n,

        .. math:: \lambda\,|\mathbf K|^2/4\pi = \mathbf t\cdot\mathbf K_{xy} + \sqrt{n^2-t^2}\,K_z

        In closed form for a constant index. With dispersion the difference of both sides grows with
        λ wherever n falls with it, so that it has one root at most: by bisection within the band of
        the index, implicitly differentiable (`optimistix`). Where there is none the recorded
        colour's value of the right-hand side stands in, finite, with False.
        """
        squared = jnp.sum(tangential**2, axis=-1)
        across = jnp.sum(tangential * self.grating[:2], axis=-1)
        power = jnp.sum(self.grating**2)
        if isinstance(self.index, ConstantIndex):
            inside = jnp.sqrt(self.index.value**2 - squared)
            found = 4 * jnp.pi * (across + inside * self.grating[2])
            found = found / jnp.where(power > 0, power, 1)  # no fringes match nothing
            return jnp.where(found > 0, found, 1.0), found > 0
        low, high = self.index.band

        def one(across, squared):
            data = (self.index, across, squared, self.grating[2], power)
            ends = [_mismatch(jnp.asarray(end, across.dtype), data) for end in (low, high)]
            found = (ends[0] < 0) & (ends[1] > 0)
            middle = jnp.asarray((low * high) ** 0.5, across.dtype)
            # Without a root the search is for that of a line instead, which has one.
            safe = (*data, found, middle)
            eps = float(jnp.finfo(across.dtype).eps)
            solver = optimistix.Bisection(rtol=eps, atol=eps * low, flip=False)
            solution = optimistix.root_find(
                _bracketed,
                solver,
                middle,
                args=safe,
                options={"lower": low, "upper": high},
                max_steps=64,
                throw=False,
            )
            return solution.value, found

        flat = (across.reshape(-1), squared.reshape(-1))
        values, found = jax.vmap(one)(*flat)
        return values.reshape(across.shape), found.reshape(across.shape)


def refracted(angle: Number, before: Number, after: Number) -> Float[Array, ""]:
    """The angle from the normal, rad, in an index `after`, of light from an index `before`."""
    sine = jnp.sin(checks.finite("angle", angle, "rad"))
    sine = sine * checks.positive("before", before, "n") / checks.positive("after", after, "n")
    if not checks.is_traced(sine) and abs(float(sine)) > 1:
        raise ValueError(
            f"angle = {angle:g} rad is totally reflected: its sine in the second medium would be "
            f"{float(sine):g}; give a smaller angle"
        )
    return jnp.arcsin(sine)


def directions(
    tangential: Float[Array, "*ray 2"], index: Float[Array, "*wave"]
) -> Float[Array, "*wave 3"]:
    """Unit vectors in a medium, +z, of light whose direction cosines in air are (x, y)."""
    across = tangential / index[..., None]
    along = jnp.sqrt(1 - jnp.sum(across**2, axis=-1, keepdims=True))
    return jnp.concatenate([across, along], axis=-1)


def _mismatch(wavelength, data):
    """Excess of a wavelength over the one that the fringes match at it, times |K|²/4π."""
    index, across, squared, along, power = data
    inside = jnp.sqrt(index(wavelength) ** 2 - squared)
    return wavelength * power / (4 * jnp.pi) - across - inside * along


def _bracketed(wavelength, data):
    """`_mismatch`, or a line through the middle of the band where it has no root."""
    *given, found, middle = data
    return jnp.where(found, _mismatch(wavelength, given), wavelength - middle)
