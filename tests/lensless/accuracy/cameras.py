"""Random cameras, and their PSFs worked out without the package.

All numbers are drawn log-uniformly from wide ranges, so that every regime comes up: shadows that
are sharp or all fringes, sensors in the middle of the shadow or far beyond it, orders near focus.
"""

import math
from typing import NamedTuple

import numpy as np
import scipy.integrate
from lensless.propagation import reference

import thincam_jax as tc

# What decides about compilation comes in few combinations, with their shares: shape of the sensor,
# profile, pixel average. Rows and columns up to 256 are all looked at by the selector, beyond that
# it draws some of them. On the smallest sensor the direct sum can be tried.
KINDS = (
    ((48, 80), "cosine", False, 0.24),
    ((25, 36), "cosine", False, 0.13),
    ((320, 384), "cosine", False, 0.19),
    ((900, 600), "cosine", False, 0.17),
    ((48, 80), "binary", False, 0.07),
    ((320, 384), "binary", False, 0.05),
    ((48, 80), "cosine", True, 0.06),
    ((320, 384), "cosine", True, 0.06),
    ((48, 80), "binary", True, 0.03),
)
# Widths of up to this many pixels are rounded up to the next of them, less a random part of a
# pixel: the models that sample the mask then come in few sizes, each compiled once.
SIZES = (30, 60, 110, 180, 260)
_FAR = 1e5


class Case(NamedTuple):
    """A camera and the numbers it was made of.

    - `geometry`: beta, width, distance, wavelength and object_distance, as `reference` takes them.
    - `conditions`: keywords of `psf` and of the selection.
    """

    camera: tc.LenslessCamera
    shape: tuple[int, int]
    pitch: float
    profile: str
    phase: float
    centre: tuple[float, float]
    geometry: dict
    conditions: dict

    @property
    def pixels(self) -> float:
        """Pixels across the mask, its offset included."""
        reach = self.geometry["width"] + 2 * max(abs(c) for c in self.centre)
        return reach / self.pitch


def random_cases(count: int, seed: int, kinds=KINDS) -> list[Case]:
    """`count` random cameras; a longer list begins like a shorter one."""
    rng = np.random.default_rng(seed)
    return [_random_case(rng, kinds) for _ in range(count)]


def _random_case(rng, kinds) -> Case:
    def log_uniform(low, high):
        return float(np.exp(rng.uniform(np.log(low), np.log(high))))

    shares = np.array([kind[3] for kind in kinds])
    shape, profile, average, _ = kinds[rng.choice(len(kinds), p=shares / shares.sum())]
    geometry = {
        "beta": log_uniform(1, 200),
        "width": log_uniform(0.5, 20),
        "distance": log_uniform(0.2, 50),
        "wavelength": log_uniform(400e-6, 1000e-6),
        "object_distance": math.inf if rng.uniform() < 0.2 else log_uniform(5, _FAR),
    }
    pitch, phase = log_uniform(1e-3, 20e-3), float(rng.uniform(0, 2 * np.pi))
    offset = rng.uniform(-0.2, 0.2, 2) * geometry["width"] * (rng.uniform() < 0.25)
    # Width and offset share one scale, so that the plane that holds both has the size wanted.
    reach = geometry["width"] + 2 * np.max(np.abs(offset))
    sizes = [n for n in SIZES if n * pitch >= reach]
    scale = (sizes[0] - rng.uniform()) * pitch / reach if sizes else 1.0
    geometry["width"] *= scale
    return make_case(shape, pitch, profile, phase, tuple(offset * scale), geometry, average)


def make_case(shape, pitch, profile, phase, centre, geometry, average) -> Case:
    sides = {side: geometry.get(side) for side in ("width", "height")}
    mask = tc.FresnelZoneAperture(geometry["beta"], phase, **sides, profile=profile, centre=centre)
    camera = tc.LenslessCamera(mask, tc.Sensor(shape, pitch), geometry["distance"])
    conditions = {k: geometry[k] for k in ("wavelength", "object_distance")}
    conditions["pixel_integration"] = average
    return Case(camera, shape, pitch, profile, phase, centre, geometry, conditions)


def orders_of(profile: str) -> dict[int, float]:
    """Orders and weights of the profile; those of the binary one from quadrature."""
    if profile == "cosine":
        return reference.COSINE
    return {
        k: scipy.integrate.quad(lambda a, k=k: np.cos(k * a), -np.pi / 2, np.pi / 2)[0] / 2 / np.pi
        for k in (0, *(sign * n for n in (1, 3, 5, 7, 9) for sign in (1, -1)))
    }


def expected(case: Case) -> np.ndarray:
    """The exact Fresnel PSF."""
    orders = orders_of(case.profile)
    given = {"phase": case.phase, "centre": case.centre, "orders": orders, **case.geometry}
    if case.conditions["pixel_integration"]:
        return pixel_average(case.shape, case.pitch, **given)
    return reference.psf(*(reference.centred(n, case.pitch) for n in case.shape), **given)


# Pieces of a pixel hold at most so many fringes, which so many nodes integrate to rounding.
_FRINGES, _NODES = 3, 20
_AT_ONCE = 2**19


def pixel_average(shape, pitch, *, orders, phase, centre, height=None, **geometry) -> np.ndarray:
    r"""Σ_kl c_k c_l* ⟨A_k A_l*⟩(y) ⟨A_k A_l*⟩(x), each average by quadrature over the pixel.

    The irradiance's band ends at width/(λd), which says how finely a pixel is divided.
    """
    largest = max(geometry["width"], height or 0.0)
    fringes = pitch * largest / (geometry["wavelength"] * geometry["distance"])
    pieces = math.ceil(fringes / _FRINGES)
    nodes, weights = np.polynomial.legendre.leggauss(_NODES)
    inside = (reference.centred(pieces, 2 / pieces)[:, None] + nodes / pieces).ravel()
    weights = np.tile(weights / 2 / pieces, pieces)
    c = np.array([w * np.exp(1j * k * phase) for k, w in orders.items()])

    def axis(count, offset, side):
        aperture = {**geometry, "width": side}
        together = max(1, _AT_ONCE // len(inside))
        x = reference.centred(count, pitch)
        found = []
        for part in np.array_split(x, math.ceil(count / together)):
            fine = (part[:, None] + inside * pitch / 2).ravel()
            fields = [reference.axis_field(k, fine, centre=offset, **aperture) for k in orders]
            fields = np.stack(fields).reshape(len(orders), len(part), -1)
            found.append(np.einsum("kpn,lpn,n->klp", fields, fields.conj(), weights, optimize=True))
        return np.concatenate(found, axis=-1).reshape(len(orders) ** 2, count)

    sides = geometry["width"] if height is None else height, geometry["width"]
    rows, columns = (axis(*given) for given in zip(shape, centre, sides, strict=True))
    return ((np.outer(c, c.conj()).ravel()[:, None] * rows).T @ columns).real
