"""Plans: the steps of an acquisition as data that is hashed, stored and compared.

A plan holds a table of patterns, one of camera settings, and the steps, which point into both. Its
SHA-256 is over canonical JSON, so that an acquisition is only ever resumed with its own plan. The
ready-made plans are those of the thesis: fringe scanning, method A (several mask-sensor distances),
method B (pairs of phases of several β), a stack of PSFs by depth, Hadamard calibration, and
pictures on the calibrated cells; and scenes, at one exposure or more, levels of a display, and
marks that tell where it is.
"""

import dataclasses
import hashlib
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from thincam_jax._core.arguments import checked
from thincam_jax._core.quantity import check_fields
from thincam_jax.hardware.base import SOFTWARE, CameraSettings, Region

if TYPE_CHECKING:  # it brings JAX
    from thincam_jax.measured.calibration.hadamard import HadamardSeries

FRINGE_SCAN = (0.0, 0.5 * math.pi, math.pi, 1.5 * math.pi)  # phases, rad
# Settings that older plans do not have.
_LEFT_OUT = ("black_level", None), ("binning", 1), ("trigger", SOFTWARE)
PHASE_PAIR = (0.0, 1.5 * math.pi)


@checked
@dataclass(frozen=True)
class Pattern:
    """Pattern on a display: a kind and the numbers that define it.

    - "fza": `beta` rad/mm², `phase` rad, `width` mm, `profile` ("cosine", "intensity", "binary").
    - "hadamard": `frame` of a `HadamardSeries` of `rows`, `columns`, `order`, `display`.
    - "picture": `name` and SHA-256 `digest` of its levels on `rows` × `columns` cells.
    - "pixels": the same of levels of so many pixels, such as a phase mask's.
    - "mark": a white disc of the diameter `size` at `x`, `y` from the display's middle, mm.
    - "uniform": `level` of all pixels. "black": no numbers. Other kinds are the renderer's own.
    """

    kind: str
    numbers: Mapping[str, float | int | str] = field(default_factory=dict)

    @property
    def label(self) -> str:
        """Label in a figure's title: β and φ of a mask, the number of a Hadamard frame."""
        if self.kind == "fza":
            return f"β {self.numbers['beta']:.3g} rad/mm², φ {self.numbers['phase']:.2f} rad"
        if self.kind in ("picture", "pixels"):
            return str(self.numbers["name"])
        if self.kind == "uniform":
            return f"level {self.numbers['level']}"
        return f"pattern {self.numbers['frame']}" if self.kind == "hadamard" else self.kind


BLACK, WHITE = Pattern("black"), Pattern("uniform", {"level": 255})


@checked
@dataclass(frozen=True)
class Step:
    """One frame: its pattern and settings by their number in the plan, and the stage position.

    - `position`: mm; None: the stage stays where the steps before left it.
    - `dark`: a dark frame, subtracted from the others.
    """

    pattern: int
    position: float | None = None
    settings: int = 0
    dark: bool = False


@checked
@dataclass(frozen=True)
class Plan:
    """An ordered list of steps.

    - `name`: its purpose, such as "method_b".
    - `facts`: numbers and texts stored with the captures. `stage_zero` is the distance, mm, at the
      stage's position 0. With `series`, as in `hadamard`, `open_captures` reads the store. With
      `bracket`, frames of all but the shortest exposure may be saturated.

    **Errors**: ValueError for no steps, numbers that point outside of the tables, and what JSON
    cannot hold.
    """

    name: str
    patterns: tuple[Pattern, ...]
    settings: tuple[CameraSettings, ...]
    steps: tuple[Step, ...]
    facts: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self):
        if not self.steps:
            raise ValueError(f"the plan {self.name!r} has no steps; give at least one")
        for number, step in enumerate(self.steps):
            for what, index in (("patterns", step.pattern), ("settings", step.settings)):
                count = len(getattr(self, what))
                if not 0 <= index < count:
                    raise ValueError(
                        f"step {number} of the plan {self.name!r} points to number {index} of its "
                        f"{count} {what}; give 0 … {count - 1}"
                    )
        _ = self.hash  # refuses NaN and objects now, not after the first frame

    def pattern(self, step: Step) -> Pattern:
        """Pattern shown in a step of this plan."""
        return self.patterns[step.pattern]

    def at_position(self, position: float) -> "Plan":
        """The plan with the stage at a position, mm, until a step moves it."""
        return dataclasses.replace(self, steps=self.placed(position))

    def placed(self, start: float | None = None) -> tuple[Step, ...]:
        """The steps, each with the stage's position, mm: the last given one, `start` before any."""
        steps = []
        for step in self.steps:
            start = start if step.position is None else step.position
            steps.append(dataclasses.replace(step, position=start))
        return tuple(steps)

    @cached_property
    def hash(self) -> str:
        """SHA-256 over the plan's canonical JSON, in hexadecimal."""
        return hashlib.sha256(self.as_json().encode()).hexdigest()

    def as_json(self) -> str:
        """Canonical JSON of the plan: equal plans give equal texts."""
        plan = {
            "name": self.name,
            "patterns": [[p.kind, dict(p.numbers)] for p in self.patterns],
            "settings": [
                dict(one for one in dataclasses.asdict(s).items() if one not in _LEFT_OUT)
                for s in self.settings
            ],
            "steps": [[s.pattern, s.position, s.settings, s.dark] for s in self.steps],
            "facts": dict(self.facts),
        }
        try:
            return canonical_json(plan)
        except (TypeError, ValueError) as error:
            raise ValueError(
                f"the plan {self.name!r} cannot be kept: {error}; give finite numbers and texts"
            ) from error

    @classmethod
    def from_json(cls, text: str) -> "Plan":
        """Inverse of `as_json`; errors of many kinds for anything else."""
        plan = json.loads(text)
        return cls(
            name=plan["name"],
            patterns=tuple(Pattern(kind, numbers) for kind, numbers in plan["patterns"]),
            settings=tuple(settings_from(record) for record in plan["settings"]),
            steps=tuple(Step(*step) for step in plan["steps"]),
            facts=plan["facts"],
        )


def canonical_json(value: Any) -> str:
    """JSON with sorted keys, no spaces and no NaN: equal values give equal texts."""
    return json.dumps(value, sort_keys=True, separators=(",", ":"), allow_nan=False)


def settings_from(record: Mapping[str, Any]) -> CameraSettings:
    """Inverse of `dataclasses.asdict` for camera settings."""
    region = record["region"]
    found = CameraSettings(**{**record, "region": None if region is None else Region(**region)})
    check_fields(found)
    return found


@checked
def zone_plate(
    beta: float, width: float, *, phase: float = 0.0, profile: str = "cosine"
) -> Pattern:
    """Fresnel zone aperture for a light modulator; arguments as of `FresnelZoneAperture`."""
    numbers = {"beta": float(beta), "phase": float(phase), "width": float(width)}
    return Pattern("fza", {**numbers, "profile": profile})


@checked
def fringe_scan(mask: Pattern, settings: CameraSettings, *, dark_frames: int = 0) -> Plan:
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
) -> Plan:
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
) -> Plan:
    """Captures with the phases 0 and 3π/2 for each of several β, rad/mm²."""
    shots = [
        (_changed(mask, beta=beta, phase=phase), None) for beta in betas for phase in PHASE_PAIR
    ]
    return _plan("method_b", shots, settings, dark_frames)


@checked
def psf_stack(
    mask: Pattern,
    depths: Sequence[float],
    settings: CameraSettings,
    *,
    stage_zero: float = 0.0,
    dark_frames: int = 0,
) -> Plan:
    """PSFs of one pattern for a point source on the stage, at several depths, mm.

    The stage moves to depth − `stage_zero`, the depth at its position 0.
    """
    shots = [(mask, depth - stage_zero) for depth in depths]
    return _plan("psf_stack", shots, settings, dark_frames, {"stage_zero": float(stage_zero)})


@checked
def hadamard(series: "HadamardSeries", settings: CameraSettings) -> Plan:
    """The frames of a calibration by Hadamard patterns, which `open_captures` reads.

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
    black = Step(len(plan.patterns) - 1, dark=True)
    facts = {"series": {**described, "object_shape": [rows, columns]}}
    return dataclasses.replace(plan, steps=plan.steps + (black,) * lacking, facts=facts)


def pictures(
    shown: Mapping[str, np.ndarray],
    settings: CameraSettings,
    *,
    frames: int = 1,
    dark_frames: int = 0,
) -> Plan:
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


def grey_levels(settings: CameraSettings, *, frames: int = 1) -> Plan:
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
) -> Plan:
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
) -> Plan:
    """Frames of what stands before the camera, which `Acquisition.merged` makes one image of.

    - `mask`: shown meanwhile, such as a `zone_plate`.
    - `exposures`: s, in place of the settings' one.
    - `frames`, `dark_frames`: numbers of frames of each exposure; all dark ones come last.
    """
    every = tuple(dataclasses.replace(settings, exposure=float(one)) for one in exposures)
    every = every or (settings,)
    steps = [
        Step(int(dark), None, number, dark)
        for dark, count in ((False, frames), (True, dark_frames))
        for number in range(len(every))
        for _ in range(count)
    ]
    facts = {"bracket": len(every) > 1}
    return Plan("scene", (mask, BLACK), every, tuple(steps), facts)


def picture_digest(levels: np.ndarray) -> str:
    """SHA-256 of levels (row, column), uint8, and of their shape."""
    return hashlib.sha256(repr(levels.shape).encode() + levels.tobytes()).hexdigest()


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
) -> Plan:
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
            steps.append(Step(len(patterns), position, dark=True))
        steps.append(Step(index[_key(pattern)], position))
    black = (BLACK,) if every else ()
    return Plan(name, (*patterns.values(), *black), (settings,), tuple(steps), facts or {})


def _key(pattern: Pattern) -> tuple[object, ...]:
    return (pattern.kind, *sorted(pattern.numbers.items()))
