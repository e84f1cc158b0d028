r"""Phases of a phase-only light modulator (LCoS) by its levels, and the levels of a phase mask."""

import json
from dataclasses import asdict, dataclass
from os import PathLike
from typing import Annotated

import numpy as np
from scipy.spatial import KDTree

from thincam_jax._core import checks
from thincam_jax._core.files import read_json, write_whole
from thincam_jax._core.grids import Grid
from thincam_jax._core.quantity import FieldError, check_fields, quantity
from thincam_jax.hardware.displays.grey_levels import LEVELS
from thincam_jax.lensless.masks.base import AbstractMask
from thincam_jax.lensless.masks.sampled import SampledMask


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
    from thincam_jax.hardware.displays.phase_levels import PhaseLevels
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
