"""Designs: the captures of a lensless camera with Fresnel zone apertures."""

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import get_args

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from thincam_jax._core import checks
from thincam_jax._core.checks import Number, Numbers
from thincam_jax._core.module import Module
from thincam_jax._core.quantity import unchecked
from thincam_jax.imaging.sensor import Sensor
from thincam_jax.lensless.camera import LenslessCamera
from thincam_jax.lensless.masks.fza import FresnelZoneAperture, Profile

MOST_CAPTURES = 8


@dataclass(frozen=True, order=True)
class Shot:
    """Captures of a design that differ in phase only.

    - `beta`: rad/mm²; `distance`, `wavelength`, `width` of the mask: mm.
    - `exposure`: of each capture, relative to the others.
    """

    beta: float
    distance: float
    wavelength: float
    width: float
    exposure: float = 1.0


class Design(Module):
    """Captures with Fresnel zone apertures; every number may be searched for.

    - `beta`: β of each capture's mask, rad/mm².
    - `phase`: its initial phase, rad.
    - `distance`: mask to sensor, mm.
    - `wavelength`: mm.
    - `exposure`: its share of the exposure time, relative to the others.
    - `width`: of all masks, mm.
    """

    beta: Float[Array, " capture"] = eqx.field(converter=unchecked("rad/mm^2"))
    phase: Float[Array, " capture"] = eqx.field(converter=unchecked("rad"))
    distance: Float[Array, " capture"] = eqx.field(converter=unchecked("mm"))
    wavelength: Float[Array, " capture"] = eqx.field(converter=unchecked("mm"))
    exposure: Float[Array, " capture"] = eqx.field(converter=unchecked("shares"))
    width: Float[Array, ""] = eqx.field(converter=unchecked("mm"))
    profile: Profile = eqx.field(static=True)

    def __init__(
        self,
        beta: Numbers,
        phase: Numbers,
        distance: Numbers,
        *,
        wavelength: Numbers,
        width: Number,
        exposure: Numbers = 1.0,
        profile: Profile = "cosine",
    ):
        """Numbers, or one for each capture: they are broadcast against each other.

        **Errors**: ValueError for no capture, more than eight, or a number out of range.
        """
        phase = jnp.asarray(phase, float)
        given = (
            checks.positive_all("beta", jnp.asarray(beta, float), "rad/mm^2"),
            checks.finite("phase", phase, "rad", shape=phase.shape),
            checks.positive_all("distance", jnp.asarray(distance, float), "mm"),
            checks.positive_all("wavelength", jnp.asarray(wavelength, float), "mm"),
            checks.positive_all("exposure", jnp.asarray(exposure, float), "shares"),
        )
        shape = jnp.broadcast_shapes((1,), *(g.shape for g in given))
        if len(shape) != 1 or not 1 <= shape[0] <= MOST_CAPTURES:
            raise ValueError(
                f"a design of {shape} captures; give 1 to {MOST_CAPTURES}, each number one for "
                "all or one for each"
            )
        numbers = [jnp.broadcast_to(g, shape) for g in given]
        self.beta, self.phase, self.distance, self.wavelength, self.exposure = numbers
        self.width = checks.positive("width", width, "mm")
        self.profile = checks.choice("profile", profile, get_args(Profile))  # pyright: ignore

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
    settings = jnp.broadcast_arrays(jnp.atleast_1d(jnp.asarray(beta, float)), jnp.asarray(distance))
    repeated = [jnp.repeat(s, len(phases)) for s in settings]
    every = jnp.tile(jnp.asarray(phases, float), settings[0].shape[0])
    return Design(
        repeated[0], every, repeated[1], wavelength=wavelength, width=width, profile=profile
    )
