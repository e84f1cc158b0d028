"""Designs: the captures of a lensless camera with Fresnel zone apertures."""

from collections.abc import Sequence
from dataclasses import dataclass, fields

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from thincam_jax._core import checks
from thincam_jax._core.arguments import checked
from thincam_jax._core.checks import Number, Numbers
from thincam_jax._core.module import Module
from thincam_jax._core.quantity import FieldError, quantity, unchecked
from thincam_jax.imaging.sensor import Sensor
from thincam_jax.lensless.camera import LenslessCamera
from thincam_jax.lensless.exposures import Exposures
from thincam_jax.lensless.masks.fza import FresnelZoneAperture, Profile

MOST_CAPTURES = 8


@dataclass(frozen=True, order=True)
class Shot:
    """Captures of a design that differ in phase only.

    - `beta`: rad/mm²; `distance`, `wavelength`, `width` of the mask: mm.
    - `exposure`: exposure of each capture, relative to the others.
    """

    beta: float
    distance: float
    wavelength: float
    width: float
    exposure: float = 1.0


@checked
class Design(Module):
    """Captures with Fresnel zone apertures; every number may be searched for.

    - `beta`: β of each capture's mask, rad/mm².
    - `phase`: its initial phase, rad.
    - `distance`: mask to sensor, mm.
    - `wavelength`: mm.
    - `exposure`: its share of the exposure time, relative to the others.
    - `width`: width of every mask, mm.
    """

    beta: Float[Array, " capture"] = eqx.field(converter=unchecked("rad/mm^2"))
    phase: Float[Array, " capture"] = eqx.field(converter=unchecked("rad"))
    distance: Float[Array, " capture"] = eqx.field(converter=unchecked("mm"))
    wavelength: Float[Array, " capture"] = eqx.field(
        converter=quantity("mm", check=checks.wavelengths)
    )
    exposure: Float[Array, " capture"] = eqx.field(converter=unchecked("shares"))
    width: Float[Array, ""] = eqx.field(converter=unchecked("mm"))
    profile: Profile = eqx.field(static=True)

    def __init__(self, exposures: Exposures):
        """The captures of these exposures; masks without a profile have the cosine one.

        **Errors**: ValueError for more than eight captures, a β of 0, and masks that differ in
        their width or profile.
        """
        if len(exposures) > MOST_CAPTURES:
            message = f"a design of {len(exposures)} captures; give 1 to {MOST_CAPTURES}"
            raise FieldError(message, "exposures")
        beta = jnp.asarray(exposures.beta, float)
        self.beta = checks.positive_all("beta", beta, "rad/mm^2")
        self.phase = jnp.asarray(exposures.phase, float)
        self.distance = jnp.asarray(exposures.distance, float)
        self.wavelength = jnp.asarray(exposures.wavelength, float)
        self.exposure = jnp.asarray(exposures.relative_time, float)
        self.width = jnp.asarray(exposures.width[0], float)
        profiles = set(exposures.profile)
        known = not checks.is_traced(exposures.width)
        if len(profiles) > 1 or (known and np.ptp(np.asarray(exposures.width)) > 0):
            raise ValueError("masks of a design differ in width or profile; give one for all")
        self.profile = profiles.pop() or "cosine"

    @property
    def exposures(self) -> Exposures:
        """The captures, in plain numbers where they are known."""

        def plain(number):
            return number if checks.is_traced(number) else np.asarray(number)

        return Exposures(
            plain(self.beta),
            plain(self.distance),
            phase=plain(self.phase),
            wavelength=plain(self.wavelength),
            width=plain(self.width),
            relative_time=plain(self.exposure),
            profile=self.profile,
        )

    @property
    def captures(self) -> int:
        return self.beta.shape[0]

    @property
    def phases(self) -> int:
        """Captures of each shot: every shot has the same, different phases."""
        return len(np.unique(np.asarray(self.phase)))

    @property
    def shots(self) -> tuple[Shot, ...]:
        """The numbers of each shot, in the order of the captures."""
        numbers = (getattr(self, field.name) for field in fields(Shot))
        each = np.broadcast_arrays(*(np.asarray(n, dtype=float) for n in numbers))
        rows = zip(*(n[:: self.phases].tolist() for n in each), strict=True)
        return tuple(Shot(*row) for row in rows)

    def mask(self, beta: Number, phase: Number) -> FresnelZoneAperture:
        """The mask of a capture, of the width and the profile that all share."""
        return FresnelZoneAperture(beta, phase, width=self.width, profile=self.profile)

    def cameras(self, sensor: Sensor) -> list[LenslessCamera]:
        """The camera of each capture."""
        return [
            LenslessCamera(self.mask(b, p), sensor, d)
            for b, p, d in zip(self.beta, self.phase, self.distance, strict=True)
        ]


@checked
def shots(
    beta: Numbers | Sequence[float | int],
    distance: Numbers | Sequence[float | int],
    phases: Sequence[float | int] | Float[Array, " phase"] | Float[np.ndarray, " phase"],
    *,
    wavelength: Numbers,
    width: Number,
    profile: Profile = "cosine",
) -> Design:
    """Each setting (β, d) with each of the phases, in the order of a study's captures."""
    settings = Exposures(beta, distance, wavelength=wavelength, width=width, profile=profile)
    return Design(settings.at_phases(np.asarray(phases).tolist()))
