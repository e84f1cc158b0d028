"""Products of zone orders: which chirps an irradiance is made of."""

import numpy as np
from jaxtyping import Array, Complex

from thincam_jax.lensless.masks.base import AbstractMask, ZoneOrders


def require_zone_orders(mask: AbstractMask, model: str) -> ZoneOrders:
    """The mask's zone orders, or one line that says which models can be used without."""
    zone_orders = getattr(mask, "zone_orders", None)
    if zone_orders is None:
        raise TypeError(
            f"model {model!r} needs a mask made of zone orders, such as FresnelZoneAperture; for a "
            f"{type(mask).__name__} use 'angular_spectrum' or 'rayleigh_sommerfeld'"
        )
    return zone_orders()


def pairs(zones: ZoneOrders) -> tuple[np.ndarray, np.ndarray, Complex[Array, " pair"]]:
    """All pairs k ≤ l of orders and their weights, so that |Σ c_k A_k|² = Re Σ w_kl A_k A_l*."""
    first, second = np.triu_indices(len(zones.orders))
    c = zones.coefficients
    double = np.where(first == second, 1.0, 2.0).astype(c.dtype)
    return first, second, c[first] * c[second].conj() * double
