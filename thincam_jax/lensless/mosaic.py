"""Several masks side by side before one sensor: as many captures in one exposure."""

import dataclasses
from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from thincam_jax._core import checks
from thincam_jax._core.module import Module
from thincam_jax._core.quantity import quantity
from thincam_jax.imaging.sensor import Sensor, as_sensor
from thincam_jax.lensless.camera import LenslessCamera
from thincam_jax.lensless.masks.base import AbstractMask
from thincam_jax.lensless.masks.side_by_side import SideBySide

_FITS = 1e-6  # pixels, for rounding


def _rows(given: Any) -> tuple[tuple[AbstractMask, ...], ...]:
    try:
        rows = tuple(tuple(row) for row in given)
    except TypeError:
        rows = ()
    if not rows or not rows[0] or len({len(row) for row in rows}) > 1:
        raise ValueError(f"masks is {checks.shown(given)}; give rows of masks, such as [[a, b]]")
    for mask in (mask for row in rows for mask in row):
        if not isinstance(mask, AbstractMask):
            raise TypeError(f"masks holds a {type(mask).__name__}; give rows of masks")
    return rows


def _pitches(name: str, given: Any) -> Float[Array, "2"]:
    array = checks.array(name, given)
    both = jnp.broadcast_to(array, (2,)) if array.ndim == 0 else array
    return checks.positive_all(name, checks.finite(name, both, "mm", shape=(2,)), "mm")


class Mosaic(Module):
    r"""Masks side by side before one sensor, each with its own part of it (thesis Fig 3.3).

    One exposure holds as many captures as there are masks: the four phases of fringe scanning, two
    pairs of method B. `split` cuts them out of a frame. `cameras` are the parts as cameras of one
    scene, for `Cameras`: each sees the scene from its own `place` c, so that a point at t lies
    :math:`(d/t)\,\mathbf c` further from the middle of its part. Their PSFs hold this parallax, to
    parts of a pixel, whatever the distance: images of all parts come out registered.

    With walls a part has the light of its own mask alone, cut off at the wall. Without, the light
    of all masks falls on all parts: PSFs are those of all masks together (`SideBySide`). A part of
    N has about 1/N of the sensor's pixels, and its mask as much less light.

    **Arguments**

    - `masks`: rows of masks, [[a, b], [c, d]]; the `centre` of each is from the middle of its cell.
    - `sensor`: the whole sensor.
    - `distance`: mask-sensor distance d, mm, > 0.
    - `pitch`: distance of the cells' middles, mm, one number or (y, x); default: the sensor's sides
      over the number of cells.
    - `wall`: thickness of black walls between the cells, from the mask to the sensor, mm; 0 for
      thin ones, None for none.
    - `spacers`: height by which each mask lies farther from the sensor, mm, in rows like `masks`:
      steps etched into the substrate. They need walls.

    **Errors**: ValueError for cells that do not fit the sensor, for masks that do not fit their
    cells, and for spacers without walls; TypeError for masks without separable terms if there are
    no walls.

    ```python
    import thincam_jax as tc
    from thincam_jax.units import nm, um

    phases = [[0.0, 1.571], [3.142, 4.712]]
    masks = [[tc.FresnelZoneAperture(50.0, p, width=0.8) for p in row] for row in phases]
    mosaic = tc.Mosaic(masks, tc.Sensor((40, 48), 50 * um), distance=5.0, wall=0.1)
    scene = tc.Scene(tc.ImagePlane([[0.0, 1.0]], distance=250.0, width=40.0), 500 * nm)
    frame = tc.capture(mosaic, scene)
    print(frame.shape, mosaic.split(frame)[0].shape)  # (40, 48) (18, 22)
    ```

    **See also**: `record`, `LenslessCamera`, `Cameras`, `FringeScanning`.
    """

    masks: tuple[tuple[AbstractMask, ...], ...] = eqx.field(converter=_rows)
    sensor: Sensor = eqx.field(converter=as_sensor)
    distance: Float[Array, ""] = eqx.field(converter=quantity("mm", positive=True))
    pitch: Float[Array, "2"] | None = eqx.field(
        default=None, converter=quantity("mm", optional=True, check=_pitches), kw_only=True
    )
    wall: Float[Array, ""] | None = eqx.field(
        default=None, converter=quantity("mm", non_negative=True, optional=True), kw_only=True
    )
    spacers: Float[Array, "row column"] | None = eqx.field(default=None, kw_only=True)

    def __init__(
        self,
        masks: Sequence[Sequence[AbstractMask]],
        sensor: Sensor,
        distance: Any,
        *,
        pitch: Any = None,
        wall: Any = None,
        spacers: Any = None,
    ):
        given: Any = masks, sensor, distance, pitch, wall  # converted afterwards
        self.masks, self.sensor, self.distance, self.pitch, self.wall = given
        self.spacers = None if spacers is None else checks.array("spacers", spacers)

    def __check_init__(self):
        """Refuse what does not fit."""
        shape = self.shape
        if self.spacers is not None:
            if self.wall is None:
                raise ValueError(
                    "masks at several distances share no plane: give a wall between them, or leave "
                    "spacers out"
                )
            heights = checks.finite("spacers", self.spacers, "mm", shape=shape)
            if not checks.is_traced(heights) and np.asarray(heights).min() < 0:
                raise ValueError(
                    "spacers has a negative height; give the smallest distance and >= 0"
                )
        self.part_shape  # noqa: B018 it refuses cells that do not fit
        cell, wall = self._cell, 0.0 if self.wall is None else self.wall
        for number, mask in enumerate(self._flat):
            if checks.holds_traced(mask.extent, mask.centre, wall):
                continue
            reach = np.asarray([float(n) for n in mask.extent]) / 2 + abs(np.asarray(mask.centre))
            room = cell - float(np.asarray(wall))
            if (2 * reach > room * (1 + 1e-5)).any():
                height, width = 2 * reach
                raise ValueError(
                    f"mask {number} needs a cell of {height:.4g}×{width:.4g} mm (y, x), and has "
                    f"{room[0]:.4g}×{room[1]:.4g}; give smaller masks, a larger pitch or a "
                    "thinner wall"
                )
        if self.wall is None:
            self._in_a_plane((0.0, 0.0))  # refuses masks of other kinds

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of masks."""
        return len(self.masks), len(self.masks[0])

    @property
    def part_shape(self) -> tuple[int, int]:
        """Pixels (rows, columns) of each part."""
        pixel, wall = self._pixel, 0.0 if self.wall is None else float(np.asarray(self.wall))
        sizes = []
        for side, pitch, count in zip(self.sensor.shape, self._cell, self.shape, strict=True):
            most = (side * pixel - (count - 1) * pitch) / pixel
            pixels = int(min(most, (pitch - wall) / pixel) + _FITS)
            if pixels < 1:
                raise ValueError(
                    f"{count} cells of {pitch:.4g} mm with walls of {wall:.4g} mm do not fit "
                    f"{side} pixels of {pixel * 1e3:.4g} um; give a smaller pitch, thinner walls, "
                    "or a larger sensor"
                )
            sizes.append(pixels)
        return sizes[0], sizes[1]

    @property
    def placed(self) -> tuple[AbstractMask, ...]:
        """The masks at their places in the plane, row by row."""
        return tuple(_moved(m, c) for m, c in zip(self._flat, self._centres, strict=True))

    @property
    def cameras(self) -> tuple[LenslessCamera, ...]:
        """The parts, row by row, as cameras that look at one scene from their places.

        A part is whole pixels; its mask is off its middle by what is left.
        """
        sensor = dataclasses.replace(self.sensor, shape=self.part_shape)
        middles = [self._middle(corner) for corner in self._corners]
        parts = []
        for number, (middle, centre) in enumerate(zip(middles, self._centres, strict=True)):
            mask, distance = self._flat[number], self.distance
            if self.wall is None:
                mask = self._in_a_plane(-middle)
            else:
                mask = _moved(mask, centre - middle)
            if self.spacers is not None:
                distance = distance + self.spacers.ravel()[number].astype(distance.dtype)
            parts.append(LenslessCamera(mask, sensor, distance, place=middle))
        return tuple(parts)

    @property
    def whole(self) -> LenslessCamera:
        """The camera without walls: all masks as one, before the whole sensor.

        **Errors**: ValueError with walls, which no mask has.
        """
        if self.wall is not None:
            raise ValueError(
                "a point's light is cut off at the walls, which is no PSF of the whole sensor; use "
                "the parts, mosaic.cameras"
            )
        return LenslessCamera(self._in_a_plane((0.0, 0.0)), self.sensor, self.distance)

    def split(self, frame: Float[Any, "*batch y x"]) -> tuple[Any, ...]:
        """The captures of the parts, cut out of a frame of the sensor, row by row."""
        if frame.shape[-2:] != self.sensor.shape:
            raise ValueError(
                f"the frame has {frame.shape[-2:]} pixels, the mosaic's sensor {self.sensor.shape}"
            )
        rows, columns = self.part_shape
        return tuple(frame[..., y : y + rows, x : x + columns] for y, x in self._corners)

    def join(self, parts: Sequence[Float[Any, "*batch v u"]]) -> Float[Array, "*batch y x"]:
        """A frame of the sensor from images of the parts; black between them."""
        first, (rows, columns) = jnp.asarray(parts[0]), self.part_shape
        frame = jnp.zeros((*first.shape[:-2], *self.sensor.shape), first.dtype)
        for part, (y, x) in zip(parts, self._corners, strict=True):
            frame = frame.at[..., y : y + rows, x : x + columns].set(part)
        return frame

    @property
    def _flat(self) -> tuple[AbstractMask, ...]:
        return tuple(mask for row in self.masks for mask in row)

    @property
    def _pixel(self) -> float:
        numbers = self.sensor.pitch, self.pitch, self.wall
        if checks.holds_traced(*numbers):
            raise TypeError(
                "the pitches and the wall of a Mosaic set array sizes: give them as known numbers"
            )
        return float(np.asarray(self.sensor.pitch, float))

    @property
    def _cell(self) -> np.ndarray:
        """Distance (y, x) of the cells' middles, mm."""
        if self.pitch is not None:
            return np.asarray(self.pitch, float)
        return np.asarray(self.sensor.shape) * self._pixel / np.asarray(self.shape)

    @property
    def _centres(self) -> np.ndarray:
        """Middles (part, 2) of the cells, mm."""
        places = [
            (np.arange(count) - (count - 1) / 2) * pitch
            for count, pitch in zip(self.shape, self._cell, strict=True)
        ]
        return np.stack(np.meshgrid(*places, indexing="ij"), axis=-1).reshape(-1, 2)

    @property
    def _corners(self) -> list[tuple[int, int]]:
        """First row and column of each part."""
        free = np.asarray(self.sensor.shape) - self.part_shape
        corners = np.clip(np.round(free / 2 + self._centres / self._pixel - _FITS), 0, free)
        return [(int(y), int(x)) for y, x in corners]

    def _middle(self, corner: tuple[int, int]) -> np.ndarray:
        """Middle (y, x) of the part that begins at a pixel, mm."""
        free = np.asarray(self.sensor.shape) - self.part_shape
        return (np.asarray(corner) - free / 2) * self._pixel

    def _in_a_plane(self, moved: Any) -> SideBySide:
        return SideBySide(self.placed, centre=moved)  # pyright: ignore[reportArgumentType]


def _moved(mask: AbstractMask, by: np.ndarray) -> AbstractMask:
    dtype = mask.centre.dtype
    return eqx.tree_at(lambda m: m.centre, mask, mask.centre + jnp.asarray(by, dtype))
