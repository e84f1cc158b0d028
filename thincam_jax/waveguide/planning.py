"""Plans: the cheapest model of a see-through camera's capture within a tolerance."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from thincam_jax._core import checks
from thincam_jax._core.precision import Precision, allow, cast
from thincam_jax.imaging.operators import Separable, Sparse
from thincam_jax.waveguide.camera import (
    ObjectPlane,
    SeeThroughCamera,
    seen_size,
    without_dispersion,
)
from thincam_jax.waveguide.colours import ColourCamera, Crosstalk, colour_system
from thincam_jax.waveguide.display import DisplayLight
from thincam_jax.waveguide.probe import MARGIN, ColourProbe, ScreenProbe, as_numpy, cross, mean_x
from thincam_jax.waveguide.system import (
    LitPlane,
    footprints,
    planes_operator,
    require_same,
    smeared_rays,
)

# Parts of the tolerance that the decisions may use, in the order in which they are taken.
_SHARES = {"display": 0.4, "lens": 0.4, "orders": 0.4, "crosstalk": 0.6, "smear": 0.6}
_SHARES |= {"dispersion": 0.4, "precision": 0.4}


@dataclass(frozen=True, eq=False)
class ScreenPlan:
    """Model of a screen's capture within a tolerance; by `plan_screen`.

    Print it for a table. It holds for images like the one that it was made for.

    - `camera`, `plane` (or a tuple of planes): subjects of the plan.
    - `tolerance`, `predicted_error`: relative L2 of the noise-free capture.
    - `orders`: ghosts that are modelled, of `all_orders` that can meet the object.
    - `samples`: parts of the band of each pixel and order; None: the Bragg wavelength alone.
    - `dispersion`: whether the indices change with the wavelength.
    - `defocus`: whether the lens is more than a pinhole.
    - `field_dependent`: False where rows and columns are separated: every column has the ghosts of
      one column, every row those of one row, and the system is `Separable`.
    - `precision`: precision of the rays and of the system's numbers.
    - `level`: weight, mm, that counts as 1: the mean over pixels of the sum over all orders.
    - `shares`: errors of the single decisions. `simpler`: predicted ones of `separable`, and of
      `shift-invariant`: a convolution, with the ghosts of the sensor's middle everywhere.
    - `crosstalk`: argument of `colour_system`, for a `ColourCamera`; `level` then has several.
    - `background`: the display's light on the sensor, ([channel,] y, x), to add or to subtract;
      None where there is none, or where it is left out.
    """

    camera: SeeThroughCamera | ColourCamera
    plane: ObjectPlane | tuple[ObjectPlane, ...]
    tolerance: float
    predicted_error: float
    orders: int
    all_orders: int
    samples: int | None
    dispersion: bool
    field_dependent: bool
    precision: Precision
    level: float | tuple[float, ...]
    shares: dict[str, float]
    simpler: dict[str, float]
    crosstalk: Crosstalk | None = None
    defocus: bool = False
    background: Float[np.ndarray, "*channel y x"] | None = None

    @property
    def meets_tolerance(self) -> bool:
        """False where no model meets the tolerance; the plan is then the best one."""
        return self.predicted_error <= self.tolerance

    def __str__(self) -> str:
        met = "" if self.meets_tolerance else "  NOT MET"
        band = "Bragg wavelength alone" if self.samples is None else f"{self.samples} parts"
        share = {name: f": {size:.1e}" for name, size in self.shares.items()}
        field = "every pixel its own ghosts" if self.field_dependent else "rows and columns apart"
        simpler = ", ".join(f"{name} {size:.1e}" for name, size in self.simpler.items())
        lines = [
            ("tolerance", f"{self.tolerance:.1e}, predicted {self.predicted_error:.1e}{met}"),
            ("ghosts", f"{self.orders} of {self.all_orders}{share['orders']}"),
            ("smear", f"{band}{share['smear']}"),
            ("dispersion", f"{'on' if self.dispersion else 'off'}{share['dispersion']}"),
            ("precision", f"{self.precision}{share['precision']}"),
            ("field", f"{field} (predicted with {simpler})"),
        ]
        if self.crosstalk is not None:
            lines[-1] = "cross-talk", f"{self.crosstalk}{share['crosstalk']}"
        if "lens" in share:
            lines.append(("lens", f"{'defocus' if self.defocus else 'a pinhole'}{share['lens']}"))
        if "display" in share:
            lit = "left out" if self.background is None else "subtract it"
            lines.append(("display", f"{lit}{share['display']} of the image"))
        return "\n".join(f"{name:<10}  {text}" for name, text in lines)

    def system(self) -> Sparse | Separable:
        """The planned operator, from the cells of the plane or planes to the sensor."""
        decided: Any = self.camera, self.level, (self.orders, self.samples)
        camera, level, counts = decided
        camera = camera if self.dispersion else without_dispersion(camera)
        camera = camera if self.defocus else _as_pinhole(camera)
        with allow(self.precision, camera):
            camera, plane = cast((camera, self.plane), self.precision)
            if self.crosstalk is not None:
                return colour_system(camera, plane, counts[0], counts[1], self.crosstalk, level)
            if self.field_dependent:
                return planes_operator(camera, plane, counts, level)
            assert isinstance(plane, ObjectPlane)  # several planes are never separated
            return _separable(camera, plane, float(seen_size(camera, plane)), counts, level)


def plan_screen(
    camera: SeeThroughCamera | ColourCamera,
    scene: LitPlane | Sequence[LitPlane],
    *,
    tolerance: float,
    display: DisplayLight | None = None,
) -> ScreenPlan:
    r"""Choose the cheapest model of the capture of a scene to a relative error.

    The error is ‖g − g₀‖₂/‖g₀‖₂ of the noise-free capture. g₀ has every order that can meet the
    object, 64 parts of each band, dispersion, and double precision. What is decided: how many
    orders; whether the band's smear and dispersion are modelled, and with how many parts; whether
    rows and columns can be separated; the precision. All are compared with g₀ at 192 pixels,
    half of them where the object's light arrives; no whole capture is computed. Of a scene of
    several planes, each of as many cells, the light adds up, and rows and columns stay together.
    Of a lens with an aperture it is decided whether its defocus matters; of the light of a
    `display` behind the plate, whether it has to be subtracted.

    Of a `ColourCamera`, before one plane, the cross-talk is decided in place of dispersion and of
    rows and columns, and g₀ has the light of all ways through the gratings and 32 parts of each.

    A plane wave per pixel, thin holograms and Kogelnik's efficiency are common to all models, as is
    the end of each band at |ξ| = 10π, beyond which lie some 1e-3 of the light.

    **Errors**: ValueError for a tolerance that is not between 0 and 1 and where no light arrives;
    TypeError for traced numbers and for a scene that is no `LitPlane` and holds others.
    """
    tolerance = checks.relative_tolerance(tolerance)
    lit = (scene,) if isinstance(scene, LitPlane) else tuple(scene)
    for one in lit:
        if not isinstance(one, LitPlane):
            raise TypeError(f"scene holds {type(one).__name__}; give waveguide.LitPlane")
    require_same("planes", "cells", [one.plane.shape for one in lit])
    plane = scene.plane if isinstance(scene, LitPlane) else tuple(one.plane for one in lit)
    if any(checks.is_traced(leaf) for leaf in jax.tree.leaves((camera, scene))):
        raise TypeError("plan_screen needs known numbers: call it outside of jit and grad")
    channels = (camera.channels[1],) if isinstance(camera, ColourCamera) else ()
    if any(one.image.shape[:-2] != channels for one in lit) or len(lit) > 1 and channels:
        shapes = [one.image.shape for one in lit]
        raise ValueError(
            f"images are {shapes}; give {(*channels, 'y', 'x')}, of one plane in colours"
        )
    with allow("float64", camera, lit):
        probe = (ColourProbe if channels else ScreenProbe)(*cast((camera, lit), "float64"))
        share = 1.0
        while True:
            made = _decided(probe, (camera, plane), tolerance, share, display)
            if made.meets_tolerance or share < 0.05:
                return made
            share /= 2


def _decided(
    probe: ScreenProbe, subjects, tolerance: float, share: float, display: DisplayLight | None
) -> ScreenPlan:
    """The cheapest decisions, each within its part of the remaining tolerance."""
    left, shares, found = tolerance * share / MARGIN, {}, probe.reference.sum(axis=0)
    background, neglected = None, 0.0
    if display is not None:
        background = _background(display, subjects[0], probe.level)
        shares["display"] = probe.length(background[..., *probe.places])
        if shares["display"] <= left * _SHARES["display"]:
            background, neglected = None, shares["display"]
            left -= neglected
    way: dict[str, Any] = {name: values[-1] for name, values in probe.options.items()}
    for name, values in probe.options.items():
        value, size, there = values[-1], math.inf, found
        for value in values:
            there = probe.capture(**(way | {name: value}))
            size = probe.length(there - found) + probe.rounding.get(value, 0.0)
            if size <= left * _SHARES[name] or value == values[-1]:
                break
        way[name], shares[name], found = value, size, there
        left = max(left - size, 0.0)
    simpler = probe.simpler(way, shares["precision"])
    apart = simpler.get("separable", math.inf) + neglected
    predicted = probe.predicted(found, shares["precision"]) + neglected
    apart_serves = len(probe.planes) == 1 and apart <= tolerance
    return ScreenPlan(
        camera=subjects[0],
        plane=subjects[1],
        tolerance=tolerance,
        predicted_error=apart if apart_serves else predicted,
        orders=way["orders"],
        all_orders=probe.all_orders,
        samples=way["smear"],
        dispersion=way["dispersion"],
        field_dependent=not apart_serves,
        precision=way["precision"],
        level=probe.level,
        shares=shares,
        simpler=simpler,
        crosstalk=way.get("crosstalk"),
        defocus=way.get("lens", False),
        background=background,
    )


def _background(display: DisplayLight, camera, level) -> Float[np.ndarray, "*channel y x"]:
    if not isinstance(camera, ColourCamera):
        return display.irradiance(camera.sensor.shape, level)
    shape, channels = camera.cameras[0].sensor.shape, zip(level, camera.responses, strict=True)
    return np.stack([display.irradiance(shape, *one) for one in channels])


def _separable(camera, plane, size, counts, level) -> Separable:
    """Rows with the ghosts of one column of pixels, columns with the mean shift of one row."""
    grid, (column, row) = camera.sensor.grid, cross(camera)
    vertical = smeared_rays(
        camera, jnp.stack([grid.y, jnp.full_like(grid.y, column)], -1), plane, *counts
    )
    horizontal = smeared_rays(
        camera, jnp.stack([jnp.full_like(grid.x, row), grid.x], -1), plane, *counts
    )
    x = mean_x(as_numpy(horizontal), counts[0])
    places = np.stack([np.full_like(x, float(plane.centre[0])), x], axis=-1)
    right = _overlaps(places[None, :, None], plane, size, 1)[0, :, 0]
    left = _overlaps(np.asarray(vertical.points), plane, size, 0)
    weight = np.asarray(vertical.weight, float)[..., None] / level
    left = np.mean(left, axis=2) * weight
    dtype = grid.y.dtype
    return Separable(jnp.asarray(left.sum(axis=0), dtype), jnp.asarray(right, dtype))


def _overlaps(points, plane, size, axis):
    """Parts of the light of each point from every row (axis 0) or column of cells."""
    seen = footprints(points, plane, size)
    first, parts = seen.first[axis], seen.parts[axis]
    dense = np.zeros((*first.shape, plane.shape[axis]))
    for offset in range(parts.shape[-1]):
        cell = first + offset
        places = np.nonzero((cell >= 0) & (cell < plane.shape[axis]))
        dense[(*places, cell[places])] += parts[..., offset][places]
    return dense


def _as_pinhole(camera):
    """The camera, or that of several colours, with no defocus."""

    def apertures(c):
        return [one.aperture for one in (c.cameras if isinstance(c, ColourCamera) else (c,))]

    return eqx.tree_at(apertures, camera, [jnp.zeros_like(one) for one in apertures(camera)])
