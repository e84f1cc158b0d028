"""Ready-made plans of an acquisition.

Those of the thesis: fringe scanning, method A (several mask-sensor distances), method B (pairs of
phases of several β), a stack of PSFs by depth, Hadamard calibration, and pictures on the calibrated
cells; and scenes, at one exposure or more, levels of a display, and marks that tell where it is.
"""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from thincam_jax._core.arguments import checked
from thincam_jax.hardware.acquisition.plan import (
    BLACK,
    AcquisitionPlan,
    AcquisitionStep,
    Pattern,
    picture_digest,
)
from thincam_jax.hardware.base import CameraSettings

if TYPE_CHECKING:  # it brings JAX
    from thincam_jax.measured.calibration.hadamard import HadamardSeries

FRINGE_SCAN = (0.0, 0.5 * math.pi, math.pi, 1.5 * math.pi)  # phases, rad
PHASE_PAIR = (0.0, 1.5 * math.pi)


@checked
def zone_plate(
    beta: float, width: float, *, phase: float = 0.0, profile: str = "cosine"
) -> Pattern:
    """Fresnel zone aperture for a light modulator; arguments as of `FresnelZoneAperture`."""
    numbers = {"beta": float(beta), "phase": float(phase), "width": float(width)}
    return Pattern("fza", {**numbers, "profile": profile})


@checked
def fringe_scan(
    mask: Pattern, settings: CameraSettings, *, dark_frames: int = 0
) -> AcquisitionPlan:
    """Four captures of one zone plate with the phases 0, π/2, π and 3π/2.

    - `mask`: a `zone_plate`; its phase is replaced.
    - `dark_frames`: at most so many, one first and the others evenly among the captures.
    """
    shots = [(_changed(mask, phase=phase), None) for phase in FRINGE_SCAN]
    return _plan("fringe_scan", shots, settings, dark_frames)


@checked
def method_a(
    mask: Pattern,
    distances: Sequence[float],
    settings: CameraSettings,
    *,
    stage_zero: float = 0.0,
    dark_frames: int = 0,
) -> AcquisitionPlan:
    """A fringe scan at each of several mask-sensor distances.

    - `distances`: mm; the stage moves to distance − `stage_zero`, the distance at its position 0.
    """
    shots = [
        (_changed(mask, phase=phase), distance - stage_zero)
        for distance in distances
        for phase in FRINGE_SCAN
    ]
    return _plan("method_a", shots, settings, dark_frames, {"stage_zero": float(stage_zero)})


@checked
def method_b(
    mask: Pattern, betas: Sequence[float], settings: CameraSettings, *, dark_frames: int = 0
) -> AcquisitionPlan:
    """Captures with the phases 0 and 3π/2 for each of several β, rad/mm²."""
    shots = [
        (_changed(mask, beta=beta, phase=phase), None) for beta in betas for phase in PHASE_PAIR
    ]
    return _plan("method_b", shots, settings, dark_frames)


@checked
def mosaic(
    masks: Sequence[Pattern],
    rows: int,
    columns: int,
    pitch: float,
    settings: CameraSettings,
    *,
    dark_frames: int = 0,
) -> AcquisitionPlan:
    """One capture of several zone plates side by side, see `Mosaic`.

    - `masks`: `zone_plate`s of one width and profile, row by row.
    - `pitch`: distance of their middles, mm.
    """
    numbers: dict[str, float | int | str] = {"rows": rows, "columns": columns, "pitch": pitch}
    for number, mask in enumerate(masks):
        numbers |= {
            f"beta {number}": mask.numbers["beta"],
            f"phase {number}": mask.numbers["phase"],
        }
    numbers |= {name: masks[0].numbers[name] for name in ("width", "profile")}
    return _plan("mosaic", [(Pattern("mosaic", numbers), None)], settings, dark_frames)


@checked
def psf_stack(
    mask: Pattern,
    depths: Sequence[float],
    settings: CameraSettings,
    *,
    stage_zero: float = 0.0,
    dark_frames: int = 0,
) -> AcquisitionPlan:
    """PSFs of one pattern for a point source on the stage, at several depths, mm.

    The stage moves to depth − `stage_zero`, the depth at its position 0.
    """
    shots = [(mask, depth - stage_zero) for depth in depths]
    return _plan("psf_stack", shots, settings, dark_frames, {"stage_zero": float(stage_zero)})


@checked
def hadamard(series: "HadamardSeries", settings: CameraSettings) -> AcquisitionPlan:
    """The frames of a calibration by Hadamard patterns, which `HadamardCaptures.load` reads.

    The dark frames of the series are spread evenly among the patterns, the first one first.
    """
    if not dataclasses.is_dataclass(series):
        raise TypeError(f"series is {series!r:.60}; give HadamardSeries(object_shape, …)")
    described = dataclasses.asdict(series)
    rows, columns = series.object_shape
    numbers = {"rows": rows, "columns": columns, "order": series.order, "display": series.display}
    shots = [
        (Pattern("hadamard", {**numbers, "frame": frame}), None)
        for frame in range(series.pattern_frames)
    ]
    plan = _plan("hadamard", shots, settings, series.dark_frames)
    # With few patterns and many dark frames the last ones come together.
    lacking = series.dark_frames - sum(step.dark for step in plan.steps)
    black = AcquisitionStep(len(plan.patterns) - 1, dark=True)
    facts = {"series": {**described, "object_shape": [rows, columns]}}
    return dataclasses.replace(plan, steps=plan.steps + (black,) * lacking, facts=facts)


def pictures(
    shown: Mapping[str, np.ndarray],
    settings: CameraSettings,
    *,
    frames: int = 1,
    dark_frames: int = 0,
) -> AcquisitionPlan:
    """Pictures on the cells of a monitor, `frames` captures of each.

    - `shown`: levels of the cells (row, column), uint8, by name. The plan has a digest of each: a
      changed picture makes another plan.
    """
    shots = []
    for name, levels in shown.items():
        shots += [(levels_pattern(name, levels, "picture"), None)] * frames
    return _plan("pictures", shots, settings, dark_frames)


def levels_pattern(name: str, levels: np.ndarray, kind: str = "pixels") -> Pattern:
    """Levels (row, column), uint8, of the pixels in the middle of a display, or of cells."""
    numbers = {"rows": levels.shape[0], "columns": levels.shape[1]}
    return Pattern(kind, {"name": name, "digest": picture_digest(levels), **numbers})


def grey_levels(settings: CameraSettings, *, frames: int = 1) -> AcquisitionPlan:
    """Every fifteenth level of a display, the brightest first; `measured_levels` takes them."""
    levels = [Pattern("uniform", {"level": level}) for level in range(255, -1, -15)]
    return _plan("grey_levels", [(one, None) for one in levels for _ in range(frames)], settings, 0)


def alignment(
    marks: tuple[int, int],
    spread: float,
    size: float,
    settings: CameraSettings,
    *,
    frames: int = 1,
    dark_frames: int = 0,
) -> AcquisitionPlan:
    """Marks, one at a time, in rows and columns on a square of the side `spread`, mm.

    - `size`: diameter of a mark, mm. `frames`: number of frames of each.
    """
    rows, columns = (np.linspace(-spread / 2, spread / 2, count).tolist() for count in marks)
    every = [Pattern("mark", {"x": x, "y": y, "size": size}) for y in rows for x in columns]
    shots = [(one, None) for one in every for _ in range(frames)]
    return _plan("alignment", shots, settings, dark_frames)


def scene(
    mask: Pattern,
    settings: CameraSettings,
    *,
    exposures: Sequence[float] = (),
    frames: int = 1,
    dark_frames: int = 0,
) -> AcquisitionPlan:
    """Frames of what stands before the camera, which `Acquisition.merged` makes one image of.

    - `mask`: shown meanwhile, such as a `zone_plate`.
    - `exposures`: s, in place of the settings' one.
    - `frames`, `dark_frames`: numbers of frames of each exposure; all dark ones come last.
    """
    every = tuple(dataclasses.replace(settings, exposure=float(one)) for one in exposures)
    every = every or (settings,)
    steps = [
        AcquisitionStep(int(dark), None, number, dark)
        for dark, count in ((False, frames), (True, dark_frames))
        for number in range(len(every))
        for _ in range(count)
    ]
    facts = {"bracket": len(every) > 1}
    return AcquisitionPlan("scene", (mask, BLACK), every, tuple(steps), facts)


def _changed(mask: Pattern, **numbers: float) -> Pattern:
    if mask.kind != "fza":
        raise ValueError(f"a pattern of kind {mask.kind!r} has no phase; give a zone_plate")
    changed = {name: float(number) for name, number in numbers.items()}
    return Pattern(mask.kind, {**mask.numbers, **changed})


def _plan(
    name: str,
    shots: Sequence[tuple[Pattern, float | None]],
    settings: CameraSettings,
    dark_frames: int,
    facts: Mapping[str, Any] | None = None,
) -> AcquisitionPlan:
    """Plan of (pattern, position) shots, with dark frames among them."""
    if dark_frames < 0:
        raise ValueError(f"dark_frames = {dark_frames}; give a whole number, 0 for no dark frames")
    every = -(-len(shots) // dark_frames) if dark_frames else 0
    patterns = {_key(pattern): pattern for pattern, _ in shots}
    index = {key: number for number, key in enumerate(patterns)}
    steps = []
    for number, (pattern, position) in enumerate(shots):
        position = None if position is None else float(position)
        if every and number % every == 0:
            steps.append(AcquisitionStep(len(patterns), position, dark=True))
        steps.append(AcquisitionStep(index[_key(pattern)], position))
    black = (BLACK,) if every else ()
    return AcquisitionPlan(
        name, (*patterns.values(), *black), (settings,), tuple(steps), facts or {}
    )


def _key(pattern: Pattern) -> tuple[object, ...]:
    return (pattern.kind, *sorted(pattern.numbers.items()))
