"""Modules that print the values of their numbers, with units."""

import dataclasses
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import wadler_lindig as wl

from thincam_jax._core import checks

_MM = (
    *("cell", "centre", "centre_x", "centre_y", "distance", "focal_distance", "focal_length"),
    *("glass_thickness", "height", "lens_distance", "object_distance", "object_width", "pitch"),
    *("ring", "sensor_width", "size", "thickness", "wavelength", "wavelengths", "width"),
)
_UNITS = dict.fromkeys(_MM, "mm") | {
    "beta": "rad/mm²",
    "electrons": "electrons/mm²",
    "full_well": "electrons",
    "grating": "rad/mm",
    "phase": "rad",
    "read_noise": "electrons",
    "snr_db": "dB",
    "tilt": "rad",
}
_LENGTHS = ((1.0, "mm", 0.1), (1e-3, "µm", 1e-3), (1e-6, "nm", 0.0))  # unit, name, from here on
_MOST = 4  # numbers of an array that are shown, not counted


class Module(eqx.Module):
    """An `equinox.Module` whose repr shows scalars by value and unit; "?" while they are traced.

    Larger arrays are shown by type and shape. None is left out, and so is what is as by default,
    unless a converter says that it was to be chosen.
    """

    def __pdoc__(self, **kwargs: Any) -> wl.AbstractDoc:
        """What equinox's printer asks for, of this object or of one inside another."""
        named = [(f, getattr(self, f.name, None)) for f in dataclasses.fields(self) if f.repr]
        parts = [
            wl.TextDoc(f"{f.name}=") + wl.pdoc(_shown(f.name, value), **kwargs)
            for f, value in named
            if value is not None and ("converter" in f.metadata or value is not f.default)
        ]
        name = wl.TextDoc(f"{type(self).__name__}(")
        return wl.bracketed(name, parts, wl.comma, wl.TextDoc(")"), kwargs["indent"])


def _shown(name: str, value: Any) -> Any:
    """A few numbers with the unit of the field, or of their keys; anything else as it is."""
    if isinstance(value, dict):
        return {key: _shown(str(key), one) for key, one in value.items()}
    if not isinstance(value, float | np.ndarray | jax.Array):
        return value
    is_number = jnp.issubdtype(jnp.result_type(value), jnp.number)
    if np.ndim(value) > 1 or np.size(value) > _MOST or not is_number:
        return value
    unit, numbers = _UNITS.get(name, ""), ["?"] * np.size(value)
    if not checks.is_traced(value):
        known = np.atleast_1d(np.asarray(value))
        largest = np.abs(known).max(initial=0.0)
        if unit == "mm" and largest > 0:
            scale, unit = next((s, u) for s, u, least in _LENGTHS if largest >= least)
            known = known / scale
        numbers = [f"{number:.5g}" for number in known]
    text = numbers[0] if np.ndim(value) == 0 else f"({', '.join(numbers)})"
    return wl.TextDoc(f"{text} {unit}".rstrip())
