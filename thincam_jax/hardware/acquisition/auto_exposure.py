"""Search of the exposure at which the brightest pixels have a given level."""

from collections.abc import Callable
from dataclasses import dataclass

from thincam_jax._core.arguments import checked
from thincam_jax.hardware.errors import OutOfRange, Saturated

_MOST = 8.0  # largest factor from one exposure to the next
_REMEDY = "change the light or the limits of the auto-exposure"


@checked
@dataclass(frozen=True)
class AutoExposure:
    """Target of the search: `quantile` of the pixels at `target` of full scale, within `tolerance`.

    - `shortest`, `longest`: limits of the exposure, s. `attempts`: frames at most.
    """

    target: float = 0.7
    quantile: float = 0.999
    tolerance: float = 0.1
    shortest: float = 1e-5
    longest: float = 1.0
    attempts: int = 12

    def __post_init__(self):
        if not 0 < self.target < 1 or not 0 < self.quantile <= 1 or self.tolerance <= 0:
            raise ValueError(
                f"target = {self.target}, quantile = {self.quantile}, tolerance = {self.tolerance}"
                "; give 0 < target < 1, 0 < quantile <= 1 and tolerance > 0"
            )
        if not 0 < self.shortest <= self.longest or self.attempts < 1:
            raise ValueError(
                f"shortest = {self.shortest} s, longest = {self.longest} s, attempts = "
                f"{self.attempts}; give 0 < shortest <= longest and at least 1 attempt"
            )


@checked
def find_exposure(
    level_at: Callable[[float], float], start: float, wanted: AutoExposure, camera: str
) -> float:
    """Exposure, s, at which `level_at` reaches the target.

    - `level_at`: takes a frame with an exposure and returns its level as a fraction of full scale.

    The level grows linearly with the exposure, apart from an offset, up to saturation.

    **Errors**: Saturated where the shortest exposure is too bright; OutOfRange where the longest is
    too dark, or the search does not end.
    """

    def within(exposure: float) -> float:
        return min(max(exposure, wanted.shortest), wanted.longest)

    exposure, level = within(start), 0.0
    for _ in range(wanted.attempts):
        level = level_at(exposure)
        if abs(level - wanted.target) <= wanted.tolerance * wanted.target:
            return exposure
        factor = 1 / _MOST if level >= 1 else wanted.target / max(level, wanted.target / _MOST)
        following = within(exposure * factor)
        if following == exposure:
            cause = f"level {level:.3g} at {exposure:g} s, {wanted.target:g} wanted"
            kind = Saturated if level > wanted.target else OutOfRange
            raise kind(camera, "find the exposure", cause, _REMEDY)
        exposure = following
    cause = f"level {level:.3g} after {wanted.attempts} frames, {wanted.target:g} wanted"
    raise OutOfRange(camera, "find the exposure", cause, _REMEDY)
