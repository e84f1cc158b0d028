r"""Levels of a display: measured and linearised for grey patterns, and for a mask's phases.

With the transmission T(level) measured by a camera, the pattern value v is shown as the level where

.. math:: T(\mathrm{level}) = T_{min} + (T_{max} - T_{min})\, v / 255
"""

import json
from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from os import PathLike
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
from scipy.interpolate import PchipInterpolator
from scipy.optimize import isotonic_regression
from scipy.spatial import KDTree

from thincam_jax._core import checks
from thincam_jax._core.files import read_json, write_whole
from thincam_jax._core.grids import Grid
from thincam_jax._core.quantity import FieldError, check_fields, quantity
from thincam_jax.hardware.base import Display, OutOfRange
from thincam_jax.lensless.masks.base import AbstractMask
from thincam_jax.lensless.masks.sampled import SampledMask

if TYPE_CHECKING:
    from thincam_jax.hardware.acquisition.read import Acquisition


LEVELS = 256


@dataclass(frozen=True)
class GreyLevels:
    """`table`: level to show for each of the 256 pattern values; `provenance`: its origin."""

    table: np.ndarray  # (256,) uint8
    provenance: Mapping[str, Any]

    def __post_init__(self):
        if self.table.shape != (LEVELS,) or self.table.dtype != np.uint8:
            raise ValueError(
                f"a table of {self.table.dtype} {self.table.shape}; give 256 levels of uint8"
            )
        steps = np.diff(self.table.astype(int))
        if np.any(steps > 0) and np.any(steps < 0):
            raise ValueError("the table rises and falls; give one that does either")

    def __call__(self, pattern: np.ndarray) -> np.ndarray:
        """Levels to show for a pattern of uint8."""
        return self.table[pattern]

    def save(self, path: str | PathLike[str]) -> None:
        """Write the table with its provenance as a JSON file."""
        content = {"table": self.table.tolist(), "provenance": dict(self.provenance)}
        write_whole(path, json.dumps(content, indent=1) + "\n")

    @classmethod
    def load(cls, path: str | PathLike[str]) -> "GreyLevels":
        """Read the table of a file; ValueError, one line, for an invalid one."""
        try:
            content = read_json(path)
            table = np.asarray(content["table"])
            if table.dtype.kind != "i" or np.any((table < 0) | (table >= LEVELS)):
                raise ValueError("its levels are no whole numbers from 0 to 255")
            return cls(table.astype(np.uint8), content["provenance"])
        except (ValueError, KeyError, TypeError) as error:
            raise ValueError(f"{path} holds no table of grey levels: {error}") from error


class GreyLevelDisplay(Display):
    """A display of 256 levels, with `grey_levels` in equal steps of the irradiance."""

    def __init__(self, grey_levels: GreyLevels | None = None):
        self.grey_levels = grey_levels

    def show(self, pattern: np.ndarray) -> None:
        if pattern.shape != self.shape or pattern.dtype != np.uint8:
            cause = f"a pattern {pattern.shape} of {pattern.dtype}"
            remedy = f"give uint8 levels of shape {self.shape}"
            raise OutOfRange(str(self.identity), "show", cause, remedy)
        self._present(pattern if self.grey_levels is None else self.grey_levels(pattern))

    @abstractmethod
    def _present(self, levels: np.ndarray) -> None:
        """Present levels unchanged; returns once they are visible."""


def linear_levels(
    levels: np.ndarray, transmission: np.ndarray, provenance: Mapping[str, Any] | None = None
) -> GreyLevels:
    """Table from transmissions (n,) measured at n ascending levels from 0 to 255.

    Isotonic regression removes noise, monotone cubic interpolation fills in between the levels. A
    display whose transmission falls has a falling table. The data, the contrast T_max/T_min, the
    `departure` of the data from a monotone curve and the remaining `nonlinearity`, both relative to
    T_max − T_min, are added to the provenance.

    **Errors**: ValueError for levels that do not cover the display, and a constant transmission.
    """
    levels, transmission = np.asarray(levels), np.asarray(transmission, float)
    ascending = levels.ndim == 1 and levels.size > 1 and bool(np.all(np.diff(levels) > 0))
    if not ascending or (levels[0], levels[-1]) != (0, LEVELS - 1):
        raise ValueError(f"levels {levels}: give ascending ones from 0 to {LEVELS - 1}")
    if transmission.shape != levels.shape or not np.all(np.isfinite(transmission)):
        raise ValueError(f"{levels.size} levels: give as many finite transmissions")
    rising = bool(np.polyfit(levels, transmission, 1)[0] > 0)
    monotone = isotonic_regression(transmission, increasing=rising).x
    curve = PchipInterpolator(levels, monotone)(np.arange(LEVELS))
    low, high = curve.min(), curve.max()
    if not high > low:
        raise ValueError("the transmission is the same at every level: the display does nothing")
    wanted = low + (high - low) * np.arange(LEVELS) / (LEVELS - 1)
    table = np.abs(curve[None, :] - wanted[:, None]).argmin(axis=1)
    measured = {
        "levels": levels.tolist(),
        "transmission": transmission.tolist(),
        "contrast": float(high / low) if low > 0 else None,
        "departure": float(np.abs(monotone - transmission).max() / (high - low)),
        "nonlinearity": float(np.abs(curve[table] - wanted).max() / (high - low)),
    }
    return GreyLevels(table.astype(np.uint8), {**(provenance or {}), **measured})


def measured_levels(taken: "Acquisition") -> GreyLevels:
    """Table from an acquisition of a plan of `grey_levels`, by a display without a table.

    The camera sees any part of the display; the mean of each frame counts.
    """
    means: dict[int, list[float]] = {}
    for number in taken.lit:
        level = int(taken.plan.pattern(taken.plan.steps[number]).numbers["level"])
        means.setdefault(level, []).append(float(taken.frame(number).mean(dtype=float)))
    known, levels = taken.provenance, sorted(means)
    provenance = {
        **{role: known["devices"][role] for role in ("display", "camera")},
        "exposure": taken.settings[0].exposure,
        "settle": known["procedure"]["settle"],
        "frames": len(means[levels[0]]),
        "time": known["begun"],
        "thincam_jax": known["versions"]["thincam_jax"],
    }
    transmission = np.array([np.mean(means[level]) for level in levels])
    return linear_levels(np.array(levels), transmission, provenance)


@dataclass(frozen=True)
class PhaseLevels:
    """Measured phases of a modulator's levels, at a wavelength.

    - `phases`: phases, rad, of levels in equal steps from 0 to 255: of all 256, or of fewer,
      between which they are interpolated linearly.
    - `wavelength`: at which they were measured, mm.
    - `tolerance`: width of the interval about a phase in which a level has to lie, rad.
    - `gap`: amplitude of the dead space between pixels over theirs, of phase 0: zero order.

    **Errors**: ValueError for one phase, or more than there are levels.

    ```python
    import numpy as np
    from thincam_jax.hardware.displays.levels import PhaseLevels
    from thincam_jax.units import nm

    table = PhaseLevels(tuple(np.linspace(0, 6.2, 17)), 532 * nm)
    print(table.levels(np.array([[0.0, 3.1]]), 532 * nm))  # [[  0 128]]
    ```

    **See also**: `open_rig`.
    """

    phases: Annotated[tuple[float, ...], quantity("rad", many=True)]
    wavelength: Annotated[float, quantity("mm", check=checks.wavelength)]
    tolerance: Annotated[float, quantity("rad", positive=True)] = np.pi / 4
    gap: Annotated[float, quantity(least=0.0, most=1.0)] = 0.0

    def __post_init__(self):
        check_fields(self)
        if not 2 <= len(self.phases) <= LEVELS:
            given = f"{len(self.phases)} phases; give 2 to {LEVELS}, from level 0 to 255"
            raise FieldError(given, "phases")

    def save(self, path: str | PathLike[str]) -> None:
        """Write the table as a JSON file."""
        write_whole(path, json.dumps(asdict(self), indent=1) + "\n")

    @classmethod
    def load(cls, path: str | PathLike[str]) -> "PhaseLevels":
        """Read the table of a file; ValueError, one line, for an invalid one."""
        try:
            content = read_json(path)
            return cls(**{**content, "phases": tuple(content["phases"])})
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise ValueError(f"{path} holds no table of phases: {error}") from error

    def at(self, wavelength: float) -> np.ndarray:
        """Phase of each of the 256 levels at a wavelength, mm, by λ₀/λ: without dispersion."""
        steps = np.linspace(0, LEVELS - 1, len(self.phases))
        table = np.interp(np.arange(LEVELS), steps, self.phases)
        return table * (self.wavelength / wavelength)

    def field(self, levels: np.ndarray, wavelength: float) -> np.ndarray:
        """Complex amplitude of each pixel's open part."""
        return np.exp(1j * self.at(wavelength))[levels]

    def levels(self, phase: np.ndarray, wavelength: float) -> np.ndarray:
        """Levels (y, x), uint8, of the phases at a wavelength, mm, nearest on the circle to others.

        **Errors**: ValueError where no level is within half the tolerance of a phase.
        """
        table = self.at(wavelength)
        known, asked = (np.dstack([np.cos(one), np.sin(one)]) for one in (table, phase))
        apart, levels = KDTree(known[0]).query(asked)
        error, allowed = 2 * np.arcsin(np.minimum(apart.max() / 2, 1)), self.tolerance / 2
        if error > allowed:
            worst = phase.ravel()[np.argmax(apart)] % (2 * np.pi)
            raise ValueError(
                f"the phase {worst:.3g} rad is {error:.2g} rad from the nearest level, of which "
                f"the modulator has {table.min():.3g} to {table.max():.3g} rad, and {allowed:.2g} "
                f"are allowed; give a tolerance of {2 * error + 5e-3:.2f} rad, or a mask of less"
            )
        return np.asarray(levels, np.uint8)

    def levels_of(self, mask: AbstractMask, pitch: float, wavelength: float) -> np.ndarray:
        """Levels of a mask that turns the phase, on pixels of a pitch, mm.

        **Errors**: as of `levels`; ValueError for sides that are no whole number of pixels.
        """
        sides = zip(("height", "width"), mask.extent, strict=True)
        rows, columns = (checks.whole_cells(name, side, "pitch", pitch) for name, side in sides)
        sampled = np.asarray(mask.sample(Grid((rows, columns), pitch), wavelength))
        phase = np.angle(sampled)
        if not np.iscomplexobj(sampled) or not phase.any():
            raise ValueError("it turns no phase; give lenslets, a relief or a phase of a file")
        return self.levels(phase, wavelength)

    def mask(
        self, levels: np.ndarray, pitch: float, wavelength: float, fill_factor: float = 1.0
    ) -> SampledMask:
        """Mask that levels (y, x) make at a wavelength, for a camera's model.

        - `pitch`: pitch of the pixels, mm. `fill_factor`: part of a pixel's area that turns the
          phase.
        """
        given = {"fill_factor": fill_factor, "gap": self.gap or None}
        return SampledMask(self.field(levels, wavelength), pitch, **given)
