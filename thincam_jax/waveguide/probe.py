"""A scene at some pixels: its capture by one model of a screen, and how far another is off."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from thincam_jax._core.precision import Precision, cast
from thincam_jax.imaging.refractive_index import ConstantIndex
from thincam_jax.waveguide.camera import SeeThroughCamera, seen_size, without_dispersion
from thincam_jax.waveguide.colours import ColourCamera, modelled
from thincam_jax.waveguide.lens import LensView, lens_views
from thincam_jax.waveguide.rays import RayStatus, pixel_centres, slopes, trace
from thincam_jax.waveguide.smear import SmearedRays, direct_rays
from thincam_jax.waveguide.system import LitPlane, footprints, in_cells, smeared_rays

# Numbers of ghosts and of parts of the band that are tried; the last is the reference.
_ORDERS = (1, 2, 3, 4, 6, 8, 12, 16, 24, 32)
_SAMPLES = (None, 1, 2, 4, 8, 16, 32, 64)
# Pixels at which the models are compared, drawn from those of so many rows and columns.
_PIXELS, _POOL = 192, (96, 32)
# Factors that keep the predicted error above the true one over random cameras: of the root mean
# square, of the largest error, where few pixels hold it, and of both where rows and columns are
# separated, whose error is largest at the ends of few columns.
MARGIN, _LARGEST, _APART = 1.2, 2.5, 1.6


@dataclass(frozen=True, eq=False)
class ProbeRays:
    """`SmearedRays` as NumPy arrays in double precision."""

    points: Float[np.ndarray, "order pixel sample 2"]
    weight: Float[np.ndarray, "order pixel"]


class ScreenProbe:
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
        reference = sum(
            view.share * self.seen(self.rays(True, "float64", view=view), view=view)
            for view in self.views
        )
        self.straight = {False: self.direct((self.middle,)), True: self.direct(self.views)}
        reference = np.concatenate([reference, [self.straight[True]]])
        self._refer(reference, rays.weight[-1, 1:] / self.level, seen)

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
        self.middle = LensView(1.0, camera)
        self.views = lens_views(camera, planes, min(self.all_orders, _ORDERS[-1]))
        if len(self.views) > 1:
            self.options = {"lens": (False, True)} | self.options
        return seen[1:]

    def _refer(self, reference: np.ndarray, last: np.ndarray, seen: np.ndarray) -> None:
        """Keep the reference (order, …, pixel); `last`: weights of the last order, relative."""
        self.reference, self.norm = reference, 1.0
        self.norm = self.length(self.reference.sum(axis=0))
        if self.norm == 0:
            raise ValueError("no pixel sees the object's light; give it another place")
        # Orders beyond the last that is computed.
        # Weights fall as i^(−3/2), so that all that follow are at most twice I times the last.
        beyond = np.clip(seen - _ORDERS[-1], 0, 2 * _ORDERS[-1])
        brightness = sum(float(np.sqrt(np.mean(image**2))) for image in self.images)
        self.tail = self.length(last * beyond) * brightness

    def rays(
        self,
        dispersion: bool,
        precision: Precision,
        samples: int | None = _SAMPLES[-1],
        pixels: np.ndarray | None = None,
        view: LensView | None = None,
    ) -> ProbeRays:
        """All orders to the first plane, at the probe's pixels or as many others.

        Traced once for all samples.
        """
        camera = (view or self.middle).camera
        key = dispersion, precision, samples is None, None if pixels is None else pixels.tobytes()
        key = *key, np.asarray(camera.lens_point).tobytes()
        if key not in self._traced:
            camera = camera if dispersion else without_dispersion(camera)
            places = jnp.asarray(self.pixels if pixels is None else pixels)
            most = None if samples is None else _SAMPLES[-1]
            camera, places, plane = cast((camera, places, self.planes[0]), precision)
            found = smeared_rays(camera, places, plane, _ORDERS[-1], most)
            self._traced[key] = as_numpy(found)
        points, weight = self._traced[key].points, self._traced[key].weight
        # Fewer parts of the band, each the mean of as many neighbours.
        groups = points.reshape(*points.shape[:2], samples or 1, -1, 2)
        return ProbeRays(groups.mean(axis=-2), weight)

    def seen(
        self, rays: ProbeRays, orders: int | None = None, view: LensView | None = None
    ) -> np.ndarray:
        """Light of the image at the pixels without the middle one, (order, pixel)."""
        points, weight = rays.points[:orders, 1:], rays.weight[:orders, 1:]
        # In air, whatever the order.
        camera, pixels = (view or self.middle).camera, jnp.asarray(self.pixels[1:])
        slope = np.asarray(slopes(camera, pixels))[:, ::-1]
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

    def capture(self, **way: Any) -> np.ndarray:
        """Capture at the pixels, by one way of the `options`."""
        how = way["dispersion"] or not self.dispersive, way["precision"], way["smear"]
        lens = way.get("lens", False)
        found = self.straight[lens]
        for view in self.views if lens else (self.middle,):
            rays = self.rays(*how, view=view)
            found = found + view.share * self.seen(rays, way["orders"], view).sum(axis=0)
        return found

    @property
    def places(self) -> tuple[np.ndarray, np.ndarray]:
        """Rows and columns of the pixels without the middle one."""
        sensor = self.camera.sensor
        middle = (np.array(sensor.shape) - 1) / 2
        rows, columns = np.rint(self.pixels[1:] / float(sensor.pitch) + middle).astype(int).T
        return rows, columns

    def direct(self, views: Sequence[LensView]) -> np.ndarray:
        """Light straight through the plate, (pixel)."""
        found = np.zeros(len(self.pixels) - 1)
        for view in views if float(self.camera.direct_band) > 0 else ():
            rays = direct_rays(view.camera, jnp.asarray(self.pixels), self.planes[0].distance)
            found += view.share * self.seen(as_numpy(rays), view=view)[0]
        return found

    def simpler(self, way: dict[str, Any], rounded: float) -> dict[str, float]:
        """Predicted errors of models that are not among the options."""
        models = {"separable": self._separable, "shift-invariant": self._shift_invariant}
        counts = way["dispersion"], way["smear"], way["orders"]
        found = {name: model(*counts) for name, model in models.items()}
        return {name: _APART * self.predicted(one, rounded) for name, one in found.items()}

    def predicted(self, capture: np.ndarray, rounded: float) -> float:
        """`rounded`: error by the precision, twice: the operator does not round as the probe."""
        away = capture - self.reference.sum(axis=0)
        largest = float((np.sqrt(self.counts) * np.abs(away)).max()) / self.norm
        return MARGIN * self.length(away) + _LARGEST * largest + self.tail + 2 * rounded

    def length(self, difference: np.ndarray) -> float:
        """Relative to the reference's, over all pixels that those of the probe stand for."""
        return float(np.linalg.norm(np.sqrt(self.counts) * difference)) / self.norm

    def _separable(self, dispersion: bool, samples: int | None, orders: int):
        """The capture with rows and columns separated."""
        column, row = cross(self.camera)
        down, across = self.pixels.copy(), self.pixels.copy()
        down[:, 1], across[:, 0] = column, row
        vertical, horizontal = (
            self.rays(dispersion, "float64", samples, places) for places in (down, across)
        )
        points = vertical.points.copy()
        points[..., 1] = mean_x(horizontal, orders)[None, :, None]
        return self.seen(ProbeRays(points, vertical.weight), orders).sum(axis=0)

    def _shift_invariant(self, dispersion: bool, samples: int | None, orders: int):
        """The capture with the ghosts of the sensor's middle for all pixels."""
        rays = self.rays(dispersion, "float64", samples)
        scale = -float(self.camera.lens_distance + self.planes[0].distance)
        linear = scale / float(self.camera.focal_distance) * self.pixels
        points = rays.points[:, :1] + linear[None, :, None, :]
        weight = np.broadcast_to(rays.weight[:, :1], rays.weight.shape)
        return self.seen(ProbeRays(points, weight), orders).sum(axis=0)


class ColourProbe(ScreenProbe):
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

        def ways(view: LensView) -> list[tuple[int, np.ndarray, np.ndarray]]:
            at, found = camera.at(view.camera.lens_point), []
            for out in range(len(camera.cameras)):
                points, weight = at.trace(*seen_from, jnp.asarray(out), counts)
                found.append((out, np.asarray(points), view.share * np.asarray(weight)))
            return found

        self.ways = {False: ways(self.middle)}
        if len(self.views) > 1:
            self.ways[True] = [way for view in self.views for way in ways(view)]
        sums = [each.mean(axis=-1).sum(axis=(0, 2)) for _, _, each in self.ways[False]]
        weight = np.sum(sums, axis=0)
        level = np.average(weight.sum(axis=1), weights=self.counts, axis=-1)
        self.level, last = tuple(level.tolist()), weight[:, -1] / level[:, None]
        best = {name: values[-1] for name, values in self.options.items()}
        self._refer(self.capture(**best, apart=True), last, seen)

    def capture(self, *, apart: bool = False, **way: Any) -> np.ndarray:
        """Capture at the pixels, (channel, pixel), or (order, channel, pixel) with `apart`."""
        total, (channels, primaries), smear = 0.0, self.colours.channels, way["smear"]
        for out, points, weight in self.ways[way.get("lens", False)]:
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


def cross(camera: SeeThroughCamera) -> tuple[float, float]:
    """The column, off the middle by the root mean square of x, and the row that stand for all."""
    pitch, columns = float(camera.sensor.pitch), camera.sensor.shape[1]
    return pitch * columns / math.sqrt(12), 0.0


def mean_x(rays: ProbeRays, orders: int):
    """Origin of a pixel's light along x, the mean over orders and colours."""
    weight, x = rays.weight[:orders], rays.points[:orders, ..., 1].mean(axis=-1)
    total = weight.sum(axis=0)
    return (weight * x).sum(axis=0) / np.where(total > 0, total, 1)


def as_numpy(rays: SmearedRays) -> ProbeRays:
    return ProbeRays(np.asarray(rays.points, float), np.asarray(rays.weight, float))


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
