"""Exposures: the settings with which a lensless camera takes its captures."""

import dataclasses
import itertools
import math
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from thincam_jax._core import checks
from thincam_jax._core.checks import Numbers
from thincam_jax._core.module import Module
from thincam_jax._core.precision import decimal_value
from thincam_jax._core.quantity import check_fields, quantities, quantity, unchecked, whole
from thincam_jax.imaging.sensor import Sensor
from thincam_jax.lensless.camera import LenslessCamera
from thincam_jax.lensless.masks.base import AbstractMask
from thincam_jax.lensless.masks.fza import PROFILES, FresnelZoneAperture, Profile
from thincam_jax.lensless.mosaic import Mosaic

# Mask phases of a turn, rad: all four cancel the background (thesis Eq 3.14), and the pair of
# method B (Eq 3.49).
QUARTERS = (0.0, math.pi / 2, math.pi, 3 * math.pi / 2)
PAIR = (0.0, 3 * math.pi / 2)

# Numbers and profiles of each exposure.
_SETTINGS = ("beta", "distance", "phase", "wavelength", "width", "relative_time", "profile")

# What a row holds: plain numbers, or elements of the arrays while gradients pass.
if TYPE_CHECKING:
    Plain = float
else:
    Plain = Any

Each = Float[Array, " exposure"] | Float[np.ndarray, " exposure"]
Given = Numbers | Sequence[float | int]


@dataclass(frozen=True)
class Layout:
    """How the masks of exposures that are taken at once lie side by side: a `Mosaic`.

    - `rows`, `columns`: numbers of masks, which follow each other row by row.
    - `wall`: thickness of walls between them, mm; None for none. `pitch`: distance of their
      middles, mm; None for the sensor's sides over their number.
    """

    rows: Annotated[int, whole(1, 16)]
    columns: Annotated[int, whole(1, 16)]
    wall: Annotated[float | None, quantity("mm", non_negative=True, optional=True)] = None
    pitch: Annotated[float | None, quantity("mm", positive=True, optional=True)] = None

    def __post_init__(self):
        check_fields(self)


@dataclass(frozen=True)
class MosaicPart:
    """One of several exposures that are taken at once; `exposures` are all of them."""

    number: int
    exposures: "tuple[Exposure, ...]"
    layout: Layout

    def camera(self, sensor: Sensor, mask: AbstractMask | None) -> LenslessCamera:
        """The part as a camera; arguments as of `Exposures.cameras`."""
        return self.mosaic(sensor, mask).cameras[self.number]

    def mosaic(self, sensor: Sensor, mask: AbstractMask | None) -> Mosaic:
        """All parts; arguments as of `Exposures.cameras`."""
        layout, all_ = self.layout, self.exposures
        masks = [one.mask(mask) for one in all_]
        nearest = min(one.distance for one in all_)
        heights = np.reshape([one.distance - nearest for one in all_], (-1, layout.columns))
        return Mosaic(
            [masks[n : n + layout.columns] for n in range(0, len(masks), layout.columns)],
            all_[0].sensor(sensor),
            nearest,
            pitch=layout.pitch,
            wall=layout.wall,
            spacers=heights if heights.any() else None,
        )


@dataclass(frozen=True)
class Exposure:
    """One exposure, in plain numbers: equal ones are taken once for all methods.

    The attributes are those of `Exposures`.
    """

    beta: Plain
    phase: Plain
    distance: Plain
    wavelength: Plain
    width: Plain
    relative_time: Plain = 1.0
    take: int = 1
    profile: Profile | None = None
    moves: tuple[Plain, Plain] | None = None
    part: MosaicPart | None = None
    centre: tuple[Plain, Plain] | None = None

    def mask(self, mask: AbstractMask | None = None) -> AbstractMask:
        """A zone plate with the numbers of this exposure and all others as of `mask`, whose own
        profile holds where the exposure has none. A mask of another family keeps its own, but for
        the centre."""
        if mask is not None and not isinstance(mask, FresnelZoneAperture):
            return mask if self.centre is None else mask.replace(centre=self.centre)
        numbers: dict[str, Any] = {"beta": self.beta, "phase": self.phase, "width": self.width}
        if self.centre is not None:
            numbers["centre"] = self.centre
        if self.profile is not None:
            numbers["profile"] = self.profile
        return FresnelZoneAperture(**numbers) if mask is None else mask.replace(**numbers)

    def sensor(self, sensor: Sensor) -> Sensor:
        """The sensor exposed `relative_time` times as long."""
        if not isinstance(self.relative_time, Array) and self.relative_time == 1:
            return sensor
        levels = {"exposure": sensor.exposure, "electrons": sensor.electrons}
        longer = {
            name: decimal_value(level) * self.relative_time
            for name, level in levels.items()
            if level is not None
        }
        return dataclasses.replace(sensor, **longer)

    def camera(self, sensor: Sensor, mask: AbstractMask | None = None) -> LenslessCamera:
        """The camera that takes it; arguments as of `Exposures.cameras`."""
        if self.part is not None:
            return self.part.camera(sensor, mask)
        return LenslessCamera(self.mask(mask), self.sensor(sensor), self.distance)


class Exposures(Module):
    r"""Exposures of a lensless camera: one number of each, or one for each exposure.

    - `beta`: β of the mask, rad/mm²; 0 for a mask without zones.
    - `distance`: mask to sensor, mm.
    - `phase`: initial phase φ of the mask, rad.
    - `wavelength`: mm. `width`: width of the mask along x, mm.
    - `relative_time`: exposure time over the sensor's own.
    - `profile`: profile of a zone plate, see `FresnelZoneAperture`; None is that of the mask given
      to `cameras`.
    - `take`: number of the exposure among those with the same settings, each with noise of its own;
      by default they are counted.
    - `moves`: x of the object's middle at the beginning and the end of each, mm; see `ImagePlane`.
    - `centre`: (y, x) of the mask's middle of each, mm, where it is not that of the mask given.
    - `layout`: masks side by side, which take all at once; None for one after another.

    Plain numbers are kept with all their digits, arrays of JAX as they are: gradients pass through
    them to the cameras.

    **Errors**: ValueError or TypeError for a number out of range, or numbers of unequal count.

    ```python
    import thincam_jax as tc
    from thincam_jax.units import nm

    settings = tc.Exposures(25.0, [5.0, 6.5], wavelength=500 * nm, width=5.632)
    method_a = settings.fringe_scanned()
    print(len(method_a), method_a[4].distance)  # 8 6.5
    ```

    **See also**: `FresnelZoneAperture`, `Cameras`, `capture`.
    """

    beta: Each = eqx.field(converter=unchecked("rad/mm^2"))
    phase: Each = eqx.field(converter=unchecked("rad"))
    distance: Each = eqx.field(converter=unchecked("mm"))
    wavelength: Each = eqx.field(converter=unchecked("mm"))
    width: Each = eqx.field(converter=unchecked("mm"))
    relative_time: Each = eqx.field(converter=unchecked("a ratio"))
    moves: Float[Array, "exposure 2"] | Float[np.ndarray, "exposure 2"] | None
    centre: Float[Array, "exposure 2"] | Float[np.ndarray, "exposure 2"] | None
    take: tuple[int, ...] = eqx.field(static=True)
    profile: tuple[Profile | None, ...] = eqx.field(static=True)
    layout: Layout | None = eqx.field(static=True)

    def __init__(
        self,
        beta: Given,
        distance: Given,
        *,
        phase: Given = 0.0,
        wavelength: Given,
        width: Given,
        relative_time: Given = 1.0,
        profile: Profile | None | Sequence[Profile | None] = None,
        take: Sequence[int] | None = None,
        moves: Numbers | Sequence[Sequence[float]] | None = None,
        centre: Numbers | Sequence[Sequence[float]] | None = None,
        layout: Layout | None = None,
    ):
        given = {"beta": beta, "phase": phase, "distance": distance, "wavelength": wavelength}
        given |= {"width": width, "relative_time": relative_time}
        numbers = {name: _numbers(name, value) for name, value in given.items()}
        counts = {name: value.size for name, value in numbers.items() if value.ndim}
        profiles = [profile] if profile is None or isinstance(profile, str) else list(profile)
        counts |= {"profile": len(profiles)} if len(profiles) != 1 else {}
        counts |= {"take": len(take)} if take is not None else {}
        count = max(counts.values(), default=1)
        if not count or any(n not in (1, count) for n in counts.values()):
            listed = ", ".join(f"{n} of {name}" for name, n in counts.items())
            raise ValueError(f"exposures have {listed}; give each one number, or one for each")
        for one in profiles:
            if one is not None:
                checks.choice("profile", one, PROFILES)
        for name, value in numbers.items():
            spread = jnp if isinstance(value, Array) else np
            setattr(self, name, spread.broadcast_to(value, (count,)))
        self.profile = tuple(profiles * count if len(profiles) == 1 else profiles)  # pyright: ignore
        self.moves = None if moves is None else _pairs("moves", moves, count)
        self.centre = None if centre is None else _pairs("centre", centre, count)
        self.layout = layout
        if layout is not None:
            _check_layout(layout, count, numbers["relative_time"])
        self.take = (1,) * count
        self.take = _counted(self) if take is None else tuple(take)

    def __len__(self) -> int:
        return self.beta.shape[0]

    def __iter__(self) -> Iterator[Exposure]:
        return (self[number] for number in range(len(self)))

    def __getitem__(self, number: int) -> Exposure:
        """One exposure, in plain numbers."""
        return self._row(number, lambda one: decimal_value(one))

    def _row(self, number: int, read: Any) -> Exposure:
        one = self._alone(number, read)
        if self.layout is None:
            return one
        every = tuple(self._alone(n, read) for n in range(len(self)))
        return dataclasses.replace(one, part=MosaicPart(number, every, self.layout))

    def _alone(self, number: int, read: Any) -> Exposure:
        ends, centre = (
            None if pairs is None else (read(pairs[number][0]), read(pairs[number][1]))
            for pairs in (self.moves, self.centre)
        )
        return Exposure(
            read(self.beta[number]),
            read(self.phase[number]),
            read(self.distance[number]),
            read(self.wavelength[number]),
            read(self.width[number]),
            read(self.relative_time[number]),
            self.take[number],
            self.profile[number],
            ends,
            centre=centre,
        )

    @classmethod
    def of(cls, rows: Iterable[Exposure]) -> "Exposures":
        """Exposures one after another, with the settings of single ones; takes are counted anew."""
        rows = tuple(rows)
        given: dict[str, Any] = {n: [getattr(one, n) for one in rows] for n in _SETTINGS}
        for name in ("moves", "centre"):
            pairs = [getattr(one, name) for one in rows]
            given[name] = pairs if any(pairs) else None
        return cls(**given)

    def cameras(self, sensor: Sensor, mask: AbstractMask | None = None) -> list[LenslessCamera]:
        """The camera of each exposure; equal in all but what the exposures differ in.

        - `sensor`: exposed `relative_time` times as long.
        - `mask`: a zone plate whose display, height and harmonics hold for all, by default a
          printed square; or the mask of another family that all share.
        """
        rows = (self._row(number, _as_stored) for number in range(len(self)))
        return [row.camera(sensor, mask) for row in rows]

    def at_phases(self, phases: Sequence[float]) -> "Exposures":
        """Each exposure at each mask phase, rad, one after another."""
        count = len(phases)

        def repeated(each):
            return (jnp if isinstance(each, Array) else np).repeat(each, count, axis=0)

        return Exposures(
            repeated(self.beta),
            repeated(self.distance),
            phase=np.tile(np.asarray(phases, float), len(self)),
            wavelength=repeated(self.wavelength),
            width=repeated(self.width),
            relative_time=repeated(self.relative_time),
            profile=[one for one in self.profile for _ in phases],
            take=[one for one in self.take for _ in phases],
            moves=None if self.moves is None else repeated(self.moves),
            centre=None if self.centre is None else repeated(self.centre),
        )

    def fringe_scanned(self) -> "Exposures":
        """Each exposure at the phases 0, π/2, π and 3π/2 (thesis Eq 3.14)."""
        return self.at_phases(QUARTERS)

    def phase_pairs(self) -> "Exposures":
        """Each exposure at the phases 0 and 3π/2 (thesis Eq 3.49)."""
        return self.at_phases(PAIR)

    def at_once(self, layout: Layout) -> "Exposures":
        """These exposures in one, by masks side by side."""
        return dataclasses.replace(self, layout=layout)

    def of_moving(self, speed: float) -> "Exposures":
        """These exposures of an object that moves, one after another without a pause.

        Those with a layout are taken at once.

        `speed`: mm to +x during an exposure of the sensor's own time. Half way through all
        exposures the object is on the axis.
        """
        ends = np.cumsum([0.0, *(one.relative_time for one in self)])
        if self.layout is not None:
            half = speed * self[0].relative_time / 2
            return dataclasses.replace(self, moves=[[-half, half]] * len(self))
        ends = speed * (ends - ends[-1] / 2)
        moves = np.asarray(list(itertools.pairwise(ends.tolist())))
        return dataclasses.replace(self, moves=moves)


def _check_layout(layout: Layout, count: int, times: Any) -> None:
    """Refuse exposures that are no mosaic."""
    if count != layout.rows * layout.columns:
        raise ValueError(
            f"{count} exposures do not fill {layout.rows}×{layout.columns} masks; give as many"
        )
    if np.ptp(np.asarray(times)) > 0:
        raise ValueError("masks side by side are exposed together: give one relative_time")


def _as_stored(one: Any) -> Any:
    return one if isinstance(one, Array) else float(one)


def _numbers(name: str, given: Any) -> Array | np.ndarray:
    """One number or several, checked: plain ones in NumPy's float64, those of JAX as they are."""
    of_jax = any(isinstance(leaf, Array) for leaf in jax.tree.leaves(given))
    array = checks.array(name, given) if of_jax else checks.numbers(name, given)
    if array.ndim > 1:
        raise ValueError(f"{name} has shape {array.shape}; give one number, or one for each")
    unit = quantities(Exposures)[name].unit
    checked = checks.finite(name, array, unit, shape=array.shape)
    if name == "beta":
        if not checks.is_traced(checked) and (np.asarray(checked) < 0).any():
            raise ValueError(f"beta = {given} is negative; give beta >= 0 in rad/mm^2")
    elif name == "wavelength":
        checks.wavelengths(name, checked)
    elif name != "phase":
        checks.positive_all(name, checked, unit)
    return checked if of_jax else array.astype(float)


def _pairs(name: str, given: Any, count: int) -> Array | np.ndarray:
    array = given if isinstance(given, Array) else np.asarray(given, float)
    checks.finite(name, array, "mm", shape=(count, 2))
    return array


def _counted(exposures: Exposures) -> tuple[int, ...]:
    """The take of each: exposures that are equal follow each other."""
    arrays = jax.tree.leaves(exposures)
    if any(checks.is_traced(array) for array in arrays):
        return (1,) * len(exposures)
    taken: Counter[Exposure] = Counter()
    found = []
    for one in exposures:
        taken[one] += 1
        found.append(taken[one])
    return tuple(found)
