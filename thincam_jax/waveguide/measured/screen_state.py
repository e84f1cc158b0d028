"""A see-through camera before a plane as numbers that can be fitted, each of them movable."""

import operator
from collections.abc import Iterable

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from thincam_jax._core.precision import allow, cast
from thincam_jax._core.quantity import quantities, unchecked
from thincam_jax.imaging.refractive_index import changed
from thincam_jax.waveguide import ObjectPlane, Screen, SeeThroughCamera, VolumeHologram

# Parameters that can be fitted, with a step of small effect on an image.
PARAMETERS = {
    "glass_thickness": 0.01,
    "lens_distance": 0.1,
    "focal_distance": 0.001,
    "index": 1e-3,
    "slant": 1e-3,
    "tilt": 1e-3,
    "plate_x": 1e-3,
    "plate_y": 1e-3,
    "shrinkage": 1e-3,
    "film_thickness": 1e-4,
    "index_modulation": 1e-4,
    "object_distance": 1.0,
    "object_x": 0.1,
    "object_y": 0.1,
}
# Place in a state of the value to which a step is added, and its entry in a vector.
_PLACES = {
    "glass_thickness": ("camera.screen.glass_thickness", ...),
    "lens_distance": ("camera.lens_distance", ...),
    "focal_distance": ("camera.focal_distance", ...),
    "plate_x": ("camera.tilt", 0),
    "plate_y": ("camera.tilt", 1),
    "film_thickness": ("camera.screen.hologram.thickness", ...),
    "index_modulation": ("camera.screen.hologram.index_modulation", ...),
    "object_distance": ("plane.distance", ...),
    "object_x": ("plane.centre", 1),
    "object_y": ("plane.centre", 0),
    "gain": ("gain", ...),
}
_FIELDS = quantities(VolumeHologram, Screen, SeeThroughCamera, ObjectPlane)
_FIELD_OF = {"slant": "tilt"} | {n: path.rpartition(".")[2] for n, (path, _) in _PLACES.items()}
# Quantity of the attribute that each parameter is; ratios have no unit.
QUANTITIES = {name: _FIELDS.get(_FIELD_OF.get(name, name), unchecked()) for name in PARAMETERS}
DEFAULT = ("glass_thickness", "lens_distance", "slant", "tilt", "object_x", "object_y")


class ScreenState(eqx.Module):
    """The camera and the plane of a step of the fit.

    `gain`: ratio of the matrix to the model's. `shrinkage`: the film's, beyond the given.
    """

    camera: SeeThroughCamera
    plane: ObjectPlane
    gain: Array
    shrinkage: Array

    def moved(self, names: tuple[str, ...], steps: Iterable[Array]) -> "ScreenState":
        """After a step of each named parameter, one after another."""
        state = self
        for name, step in zip(names, steps, strict=True):
            state = state._stepped(name, step)
        return state

    def _stepped(self, name: str, step) -> "ScreenState":
        screen, hologram = self.camera.screen, self.camera.screen.hologram
        if name in _PLACES:
            path, entry = _PLACES[name]
            where = operator.attrgetter(path)
            old = where(self)
            new = old + step if entry is ... else old.at[entry].add(step)
            return eqx.tree_at(where, self, new)
        if name == "index":
            indices = changed(hologram.index, step), changed(screen.glass_index, step)
            paths = "camera.screen.hologram.index", "camera.screen.glass_index"
            return eqx.tree_at(operator.attrgetter(*paths), self, indices)
        if name == "shrinkage":
            processed = hologram.processed(step), self.shrinkage + (1 - self.shrinkage) * step
            return eqx.tree_at(lambda s: (s.camera.screen.hologram, s.shrinkage), self, processed)
        turned = _turned(hologram.grating, name, step)
        return eqx.tree_at(lambda s: s.camera.screen.hologram.grating, self, turned)

    def value(self, name: str) -> Array:
        """Value of a parameter; the index is the glass's at 532 nm."""
        screen, grating = self.camera.screen, self.camera.screen.hologram.grating
        if name in _PLACES:
            path, entry = _PLACES[name]
            return operator.attrgetter(path)(self)[entry]
        return {
            "index": screen.glass_index(jnp.asarray(532e-6, grating.dtype)),
            "slant": jnp.arctan2(jnp.hypot(grating[0], grating[1]), grating[2]),
            "tilt": jnp.arctan2(grating[0], -grating[1]),
            "shrinkage": self.shrinkage,
        }[name]


def _turned(grating: Float[Array, "3"], name: str, angle) -> Float[Array, "3"]:
    """K with its slant from the film's normal changed, or turned about that normal."""
    x, y, z = grating
    cos, sin = jnp.cos(angle), jnp.sin(angle)
    if name == "tilt":
        return jnp.stack([cos * x - sin * y, sin * x + cos * y, z])
    across = jnp.sqrt(x**2 + y**2)
    slanted = cos + sin * z / across
    return jnp.stack([x * slanted, y * slanted, cos * z - sin * across])


def screen_values(camera: SeeThroughCamera, plane: ObjectPlane) -> dict[str, float]:
    """`PARAMETERS` of a camera before a plane, but those that are changes of an index or a film."""
    with allow("float64", camera):
        state = cast(ScreenState(camera, plane, jnp.ones(()), jnp.zeros(())), "float64")
        names = (name for name in PARAMETERS if name not in ("index", "shrinkage"))
        return {name: float(state.value(name)) for name in names}
