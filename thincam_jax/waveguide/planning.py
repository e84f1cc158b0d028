"""Plans: the cheapest model of a see-through camera's capture within a tolerance."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from thincam_jax._core import checks
from thincam_jax._core.precision import Precision, allow, cast
from thincam_jax.imaging.operators import Separable, Sparse
from thincam_jax.imaging.refractive_index import ConstantIndex
from thincam_jax.waveguide.camera import SeeThroughCamera, without_dispersion
from thincam_jax.waveguide.colours import ColourCamera, Crosstalk, colour_system, modelled
from thincam_jax.waveguide.rays import RayStatus, pixel_centres, trace
from thincam_jax.waveguide.smear import SmearedRays
from thincam_jax.waveguide.system import (
    LitPlane,
    ObjectPlane,
    footprints,
    in_cells,
    planes_operator,
    require_same,
    seen_size,
    smeared_rays,
)

# Numbers of ghosts and of parts of the band that are tried; the last is the reference.
_ORDERS = (1, 2, 3, 4, 6, 8, 12, 16, 24, 32)
_SAMPLES = (None, 1, 2, 4, 8, 16, 32, 64)
# Pixels at which the models are compared, drawn from those of so many rows and columns.
_PIXELS, _POOL = 192, (96, 32)
# Factors that keep the predicted error above the true one over random cameras: of the root mean
# square, of the largest error, where few pixels hold it, and of both where rows and columns are
# separated, whose error is largest at the ends of few columns.
_MARGIN, _LARGEST, _APART = 1.2, 2.5, 1.6
# Parts of the tolerance that the decisions may use, in the order in which they are taken.
_SHARES = {"orders": 0.4, "crosstalk": 0.6, "smear": 0.6, "dispersion": 0.4, "precision": 0.4}


@dataclass(frozen=True, eq=False)
class ScreenPlan:
    """Model of a screen's capture within a tolerance; by `plan_screen`.

    Print it for a table. It holds for images like the one that it was made for.

    - `camera`, `plane` (or a tuple of planes): subjects of the plan.
    - `tolerance`, `predicted_error`: relative L2 of the noise-free capture.
    - `orders`: ghosts that are modelled, of `all_orders` that can meet the object.
    - `samples`: parts of the band of each pixel and order; None: the Bragg wavelength alone.
    - `dispersion`: whether the indices change with the wavelength.
    - `field_dependent`: False where rows and columns are separated: every column has the ghosts of
      one column, every row those of one row, and the system is `Separable`.
    - `precision`: precision of the rays and of the system's numbers.
    - `level`: weight, mm, that counts as 1: the mean over pixels of the sum over all orders.
    - `shares`: errors of the single decisions. `simpler`: predicted ones of `separable`, and of
      `shift-invariant`: a convolution, with the ghosts of the sensor's middle everywhere.
    - `crosstalk`: argument of `colour_system`, for a `ColourCamera`; `level` then has several.
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
        return "\n".join(f"{name:<10}  {text}" for name, text in lines)

    def system(self) -> Sparse | Separable:
        """The planned operator, from the cells of the plane or planes to the sensor."""
        decided: Any = self.camera, self.level, (self.orders, self.samples)
        camera, level, counts = decided
        camera = camera if self.dispersion else without_dispersion(camera)
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
) -> ScreenPlan:
    r"""Choose the cheapest model of the capture of a scene to a relative error.

    The error is ‖g − g₀‖₂/‖g₀‖₂ of the noise-free capture. g₀ has every order that can meet the
    object, 64 parts of each band, dispersion, and double precision. What is decided: how many
    orders; whether the band's smear and dispersion are modelled, and with how many parts; whether
    rows and columns can be separated; the precision. All are compared with g₀ at 192 pixels,
    half of them where the object's light arrives; no whole capture is computed. Of a scene of
    several planes, each of as many cells, the light adds up, and rows and columns stay together.

    Of a `ColourCamera`, before one plane, the cross-talk is decided in place of dispersion and of
    rows and columns, and g₀ has the light of all ways through the gratings and 32 parts of each.

    A plane wave per pixel, thin holograms and Kogelnik's efficiency are common to all models, as is
    the end of each band at |ξ| = 10π, beyond which lie some 1e-3 of the light.

    **Errors**: ValueError for a tolerance that is not between 0 and 1 and where no light arrives;
    TypeError for traced numbers and for a scene that is no `LitPlane` and holds others.
    """
    tolerance = float(checks.positive("tolerance", tolerance, "parts of one"))
    if tolerance > 1:
        raise ValueError(f"tolerance = {tolerance:g} is relative: give at most 1 (0.01 is 1 %)")
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
        probe = (_ColourProbe if channels else _Probe)(*cast((camera, lit), "float64"))
        share = 1.0
        while True:
            made = probe.plan(camera, plane, tolerance, share)
            if made.meets_tolerance or share < 0.05:
                return made
            share /= 2


@dataclass(frozen=True, eq=False)
class _Rays:
    """`SmearedRays` as NumPy arrays in double precision."""

    points: Float[np.ndarray, "order pixel sample 2"]
    weight: Float[np.ndarray, "order pixel"]


class _Probe:
    """A scene at some pixels: the reference capture, and the errors of other models."""

    rounding: dict[Any, float] = {"float32": 3e-7, "float64": 1e-14}  # of the sums of a capture
    level: Any

    def __init__(self, camera: SeeThroughCamera, scene: tuple[LitPlane, ...]):
        seen = self._draw(camera, [one.plane for one in scene], [one.image for one in scene])
        indices = camera.screen.hologram.index, camera.screen.glass_index
        self.dispersive = not all(isinstance(index, ConstantIndex) for index in indices)
        rays = self.rays(True, "float64")
        self.level = float(np.average(np.sum(rays.weight, axis=0)[1:], weights=self.counts))
        if self.level == 0:
            raise ValueError("no light reaches the sensor by this screen: see check_screen")
        self._refer(self.seen(rays), rays.weight[-1, 1:] / self.level, seen)

    def _draw(self, camera: SeeThroughCamera, planes: list, images: Any) -> np.ndarray:
        """Choose pixels by the light of planes; how many orders can meet them at each pixel."""
        self.options: dict[str, tuple] = {
            "orders": _ORDERS,
            "smear": _SAMPLES,
            "dispersion": (False, True),
            "precision": ("float32", "float64"),
        }
        self.camera, self.planes, self._traced = camera, planes, {}
        self.sizes = [float(seen_size(camera, plane)) for plane in self.planes]
        for plane, size in zip(self.planes, self.sizes, strict=True):
            footprints(np.zeros((1, 2)), plane, size)  # refuses cells that are too small
        self.images = [np.asarray(image) for image in images]
        self.sums = [np.pad(i.cumsum(axis=0).cumsum(axis=1), ((1, 0),) * 2) for i in self.images]
        pool = _spread(camera)
        light = [self._lit(pool, number) for number in range(len(planes))]
        chosen, self.counts = _drawn(np.sum(light, axis=0))
        # The middle first, for the shift-invariant model.
        self.pixels = np.concatenate([np.zeros((1, 2)), pool[chosen]])
        seen = np.max([_orders_seen(camera, plane, self.pixels) for plane in self.planes], axis=0)
        self.all_orders = int(seen.max())
        return seen[1:]

    def _refer(self, reference: np.ndarray, last: np.ndarray, seen: np.ndarray) -> None:
        """Keep the reference (order, …, pixel); `last`: weights of the last order, relative."""
        self.reference, self.norm = reference, 1.0
        self.norm = self._length(self.reference.sum(axis=0))
        if self.norm == 0:
            raise ValueError("no pixel sees the object's light; give it another place")
        # Orders beyond the last that is computed.
        # Weights fall as i^(−3/2), so that all that follow are at most twice I times the last.
        beyond = np.clip(seen - _ORDERS[-1], 0, 2 * _ORDERS[-1])
        brightness = sum(float(np.sqrt(np.mean(image**2))) for image in self.images)
        self.tail = self._length(last * beyond) * brightness

    def rays(
        self,
        dispersion: bool,
        precision: Precision,
        samples: int | None = _SAMPLES[-1],
        pixels: np.ndarray | None = None,
    ) -> _Rays:
        """All orders to the first plane, at the probe's pixels or as many others.

        Traced once for all samples.
        """
        key = dispersion, precision, samples is None, None if pixels is None else pixels.tobytes()
        if key not in self._traced:
            camera = self.camera if dispersion else without_dispersion(self.camera)
            places = jnp.asarray(self.pixels if pixels is None else pixels)
            most = None if samples is None else _SAMPLES[-1]
            camera, places, plane = cast((camera, places, self.planes[0]), precision)
            found = smeared_rays(camera, places, plane, _ORDERS[-1], most)
            self._traced[key] = _as_numpy(found)
        points, weight = self._traced[key].points, self._traced[key].weight
        # Fewer parts of the band, each the mean of as many neighbours.
        groups = points.reshape(*points.shape[:2], samples or 1, -1, 2)
        return _Rays(groups.mean(axis=-2), weight)

    def seen(self, rays: _Rays, orders: int | None = None) -> np.ndarray:
        """Light of the image at the pixels without the middle one, (order, pixel)."""
        points, weight = rays.points[:orders, 1:], rays.weight[:orders, 1:]
        slope = -self.pixels[1:] / float(self.camera.focal_distance)  # in air, whatever the order
        seen = 0.0
        for number, plane in enumerate(self.planes):
            further = float(plane.distance - self.planes[0].distance)
            seen = seen + np.mean(self._radiance(points + further * slope[:, None], number), -1)
        return seen * weight / self.level

    def _radiance(self, points: np.ndarray, number: int) -> np.ndarray:
        """Mean radiance of a plane over a pixel's field about each point (…, 2)."""
        plane, sums = self.planes[number], self.sums[number]
        ratio, found = self.sizes[number] / float(plane.pitch), 0.0
        rows, columns = in_cells(points, plane)
        for down, across in ((1, 1), (1, -1), (-1, 1), (-1, -1)):
            corner = _bilinear(sums, rows + down * ratio / 2, columns + across * ratio / 2)
            found = found + down * across * corner / ratio**2
        return np.asarray(found)

    def _lit(self, pixels: np.ndarray, number: int) -> np.ndarray:
        """About how much light of a plane each pixel gets in all orders together, relative."""
        plane = self.planes[number]
        rays = trace(self.camera, jnp.asarray(pixels), object_distance=plane.distance, orders=2)
        first, second = np.asarray(rays.points[..., 1::-1], float)
        order = np.arange(_ORDERS[-1])[:, None]
        points = first + order[..., None] * (second - first)
        light = np.sum(np.abs(self._radiance(points, number)) / (1 + order) ** 1.5, axis=0)
        return np.where(rays.status[0] == RayStatus.OK, light, 0)

    def plan(self, camera, plane, tolerance: float, share: float) -> ScreenPlan:
        """The cheapest decisions, each within its part of the remaining tolerance."""
        left, shares, found = tolerance * share / _MARGIN, {}, self.reference.sum(axis=0)
        way: dict[str, Any] = {name: values[-1] for name, values in self.options.items()}
        for name, values in self.options.items():
            value, size, there = values[-1], math.inf, found
            for value in values:
                there = self.capture(**(way | {name: value}))
                size = self._length(there - found) + self.rounding.get(value, 0.0)
                if size <= left * _SHARES[name] or value == values[-1]:
                    break
            way[name], shares[name], found = value, size, there
            left = max(left - size, 0.0)
        simpler = self.simpler(way, shares["precision"])
        apart = simpler.get("separable", math.inf)
        apart_serves = len(self.planes) == 1 and apart <= tolerance
        return ScreenPlan(
            camera=camera,
            plane=plane,
            tolerance=tolerance,
            predicted_error=apart if apart_serves else self._predicted(found, shares["precision"]),
            orders=way["orders"],
            all_orders=self.all_orders,
            samples=way["smear"],
            dispersion=way["dispersion"],
            field_dependent=not apart_serves,
            precision=way["precision"],
            level=self.level,
            shares=shares,
            simpler=simpler,
            crosstalk=way.get("crosstalk"),
        )

    def capture(self, **way: Any) -> np.ndarray:
        """Capture at the pixels, by one way of the `options`."""
        rays = self.rays(way["dispersion"] or not self.dispersive, way["precision"], way["smear"])
        return self.seen(rays, way["orders"]).sum(axis=0)

    def simpler(self, way: dict[str, Any], rounded: float) -> dict[str, float]:
        """Predicted errors of models that are not among the options."""
        models = {"separable": self._separable, "shift-invariant": self._shift_invariant}
        counts = way["dispersion"], way["smear"], way["orders"]
        found = {name: model(*counts) for name, model in models.items()}
        return {name: _APART * self._predicted(one, rounded) for name, one in found.items()}

    def _predicted(self, capture: np.ndarray, rounded: float) -> float:
        """`rounded`: error by the precision, twice: the operator does not round as the probe."""
        away = capture - self.reference.sum(axis=0)
        largest = float((np.sqrt(self.counts) * np.abs(away)).max()) / self.norm
        return _MARGIN * self._length(away) + _LARGEST * largest + self.tail + 2 * rounded

    def _length(self, difference: np.ndarray) -> float:
        """Relative to the reference's, over all pixels that those of the probe stand for."""
        return float(np.linalg.norm(np.sqrt(self.counts) * difference)) / self.norm

    def _separable(self, dispersion: bool, samples: int | None, orders: int):
        """The capture with rows and columns separated."""
        column, row = _cross(self.camera)
        down, across = self.pixels.copy(), self.pixels.copy()
        down[:, 1], across[:, 0] = column, row
        vertical, horizontal = (
            self.rays(dispersion, "float64", samples, places) for places in (down, across)
        )
        points = vertical.points.copy()
        points[..., 1] = _mean_x(horizontal, orders)[None, :, None]
        return self.seen(_Rays(points, vertical.weight), orders).sum(axis=0)

    def _shift_invariant(self, dispersion: bool, samples: int | None, orders: int):
        """The capture with the ghosts of the sensor's middle for all pixels."""
        rays = self.rays(dispersion, "float64", samples)
        scale = -float(self.camera.lens_distance + self.planes[0].distance)
        linear = scale / float(self.camera.focal_distance) * self.pixels
        points = rays.points[:, :1] + linear[None, :, None, :]
        weight = np.broadcast_to(rays.weight[:, :1], rays.weight.shape)
        return self.seen(_Rays(points, weight), orders).sum(axis=0)


class _ColourProbe(_Probe):
    """A scene in its colours: captures are (channel, pixel)."""

    rounding = {"float32": 2e-5, "float64": 1e-14}  # with that of rays

    def __init__(self, camera: ColourCamera, scene: tuple[LitPlane, ...]):
        (lit,), self.colours = scene, camera
        middle = camera.cameras[len(camera.cameras) // 2]
        seen = self._draw(middle, [lit.plane] * len(lit.image), lit.image)
        self.options = {"crosstalk": camera.crosstalk} | self.options
        self.options |= {"smear": _SAMPLES[1:-1], "dispersion": (True,)}
        counts = min(self.all_orders, _ORDERS[-1]), _SAMPLES[-2]
        seen_from = jnp.asarray(self.pixels[1:]), lit.plane.distance
        found = [camera.trace(*seen_from, out, counts) for out in jnp.arange(len(camera.cameras))]
        self.ways = [[np.asarray(part) for part in each] for each in found]
        weight = np.sum([each.mean(axis=-1).sum(axis=(0, 2)) for _, each in self.ways], axis=0)
        level = np.average(weight.sum(axis=1), weights=self.counts, axis=-1)
        self.level, last = tuple(level.tolist()), weight[:, -1] / level[:, None]
        best = {name: values[-1] for name, values in self.options.items()}
        self._refer(self.capture(**best, apart=True), last, seen)

    def capture(self, *, apart: bool = False, **way: Any) -> np.ndarray:
        """Capture at the pixels, (channel, pixel), or (order, channel, pixel) with `apart`."""
        total, (channels, primaries), smear = 0.0, self.colours.channels, way["smear"]
        for out, (points, weight) in enumerate(self.ways):
            points, weight = points[:, : way["orders"]], weight[:, :, :, : way["orders"]]
            points = points.reshape(*points.shape[:3], smear, -1, 2).mean(axis=-2)
            weight = weight.reshape(*weight.shape[:-1], smear, -1).mean(axis=-1) / smear
            ways, channel = np.ogrid[: len(points), :channels]
            for primary in range(primaries):
                kept = modelled(way["crosstalk"], ways, channel, primary, out)
                light = weight[:, :, primary] * kept[..., None, None, None]
                total += np.einsum("wops,wcops->ocp", self._radiance(points, primary), light)
        found = np.asarray(total) / np.asarray(self.level)[:, None]
        return found if apart else found.sum(axis=0)

    def simpler(self, way: dict[str, Any], rounded: float) -> dict[str, float]:
        """None: all models are among the options."""
        return {}


def _separable(camera, plane, size, counts, level) -> Separable:
    """Rows with the ghosts of one column of pixels, columns with the mean shift of one row."""
    grid, (column, row) = camera.sensor.grid, _cross(camera)
    vertical = smeared_rays(
        camera, jnp.stack([grid.y, jnp.full_like(grid.y, column)], -1), plane, *counts
    )
    horizontal = smeared_rays(
        camera, jnp.stack([jnp.full_like(grid.x, row), grid.x], -1), plane, *counts
    )
    x = _mean_x(_as_numpy(horizontal), counts[0])
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


def _cross(camera) -> tuple[float, float]:
    """The column, off the middle by the root mean square of x, and the row that stand for all."""
    pitch, columns = float(camera.sensor.pitch), camera.sensor.shape[1]
    return pitch * columns / math.sqrt(12), 0.0


def _mean_x(rays: _Rays, orders: int):
    """Origin of a pixel's light along x, the mean over orders and colours."""
    weight, x = rays.weight[:orders], rays.points[:orders, ..., 1].mean(axis=-1)
    total = weight.sum(axis=0)
    return (weight * x).sum(axis=0) / np.where(total > 0, total, 1)


def _as_numpy(rays: SmearedRays) -> _Rays:
    return _Rays(np.asarray(rays.points, float), np.asarray(rays.weight, float))


def _spread(camera) -> np.ndarray:
    """Pixels (y, x), mm, each at random in its own part of the sensor."""
    pixels = np.asarray(pixel_centres(camera), float)
    counts = [min(n, most) for n, most in zip(camera.sensor.shape, _POOL, strict=True)]
    random = np.random.default_rng(0)
    y, x = (
        ((np.indices(counts)[axis] + random.uniform(size=counts)) * size / counts[axis]).astype(int)
        for axis, size in enumerate(camera.sensor.shape)
    )
    return pixels[y, x].reshape(-1, 2)


def _drawn(light: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Indices of `_PIXELS` pixels, and how many each stands for.

    Drawn at equal steps of a sum of probabilities, half of it uniform and half by their light.
    """
    wanted = np.full(light.size, 0.5 / light.size)
    wanted += 0.5 * light / light.sum() if light.any() else wanted
    chance = np.minimum(1.0, _PIXELS * wanted)
    for _ in range(20):  # certain pixels leave more to the others
        free = chance < 1
        if not free.any():
            break
        left = _PIXELS - np.count_nonzero(~free)
        chance[free] = np.minimum(1.0, left * wanted[free] / wanted[free].sum())
    steps = np.arange(round(chance.sum())) + np.random.default_rng(0).uniform()
    chosen = np.minimum(np.searchsorted(np.cumsum(chance), steps), light.size - 1)
    return chosen, 1 / chance[chosen]


def _orders_seen(camera, plane, pixels) -> np.ndarray:
    """Number of orders, for each pixel, beyond which every ghost has left the object."""
    rays = trace(camera, jnp.asarray(pixels), object_distance=plane.distance, orders=2)
    first, second = np.asarray(rays.points[..., 1::-1], float)
    half = float(plane.pitch) * np.asarray(plane.shape) / 2 + float(seen_size(camera, plane))
    steps = second - first
    # Of the band, light near the critical angle goes three quarters of the way and less.
    ahead = np.asarray(plane.centre) + np.sign(steps) * half - first
    lasts = np.where(np.abs(steps) > 1e-9, ahead / np.where(steps == 0, 1, 0.75 * steps), np.inf)
    count = lasts.min(axis=-1)
    return np.ceil(np.where(rays.status[0] == RayStatus.OK, np.maximum(count, 0), 0)) + 1


def _bilinear(sums, rows, columns):
    """Sums over cells up to places between their edges; beyond the edges nothing is added."""
    limits = sums.shape[0] - 1, sums.shape[1] - 1
    rows, columns = (np.clip(p, 0, n) for p, n in zip((rows, columns), limits, strict=True))
    i, j = (np.minimum(p.astype(int), n - 1) for p, n in zip((rows, columns), limits, strict=True))
    y, x = rows - i, columns - j
    upper = sums[i, j] * (1 - x) + sums[i, j + 1] * x
    lower = sums[i + 1, j] * (1 - x) + sums[i + 1, j + 1] * x
    return upper * (1 - y) + lower * y
