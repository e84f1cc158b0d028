"""Plans: the steps of an acquisition as data that is hashed, stored and compared.

A plan holds a table of patterns, one of camera settings, and the steps, which point into both. Its
SHA-256 is over canonical JSON, so that an acquisition is only ever resumed with its own plan.
`thincam_jax.hardware.plans` makes them.
"""

import dataclasses
import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np

from thincam_jax._core.arguments import checked
from thincam_jax._core.quantity import check_fields
from thincam_jax.hardware.base import SOFTWARE, CameraSettings, Region

# Settings that older plans do not have.
_LEFT_OUT = ("black_level", None), ("binning", 1), ("trigger", SOFTWARE)


@checked
@dataclass(frozen=True)
class Pattern:
    """Pattern on a display: a kind and the numbers that define it.

    - "fza": `beta` rad/mm², `phase` rad, `width` mm, `profile` ("cosine", "intensity", "binary").
    - "mosaic": `rows` × `columns` of these, `pitch` mm apart, each with its "beta N", "phase N".
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
class AcquisitionStep:
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
class AcquisitionPlan:
    """An ordered list of steps.

    - `name`: its purpose, such as "method_b".
    - `facts`: numbers and texts stored with the captures. `stage_zero` is the distance, mm, at the
      stage's position 0. With `series`, as in `hadamard`, it makes `HadamardCaptures`. With
      `bracket`, frames of all but the shortest exposure may be saturated.

    **Errors**: ValueError for no steps, numbers that point outside of the tables, and what JSON
    cannot hold.
    """

    name: str
    patterns: tuple[Pattern, ...]
    settings: tuple[CameraSettings, ...]
    steps: tuple[AcquisitionStep, ...]
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

    def pattern(self, step: AcquisitionStep) -> Pattern:
        """Pattern shown in a step of this plan."""
        return self.patterns[step.pattern]

    def at_position(self, position: float) -> "AcquisitionPlan":
        """The plan with the stage at a position, mm, until a step moves it."""
        return dataclasses.replace(self, steps=self.placed(position))

    def placed(self, start: float | None = None) -> tuple[AcquisitionStep, ...]:
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
    def from_json(cls, text: str) -> "AcquisitionPlan":
        """Inverse of `as_json`; errors of many kinds for anything else."""
        plan = json.loads(text)
        return cls(
            name=plan["name"],
            patterns=tuple(Pattern(kind, numbers) for kind, numbers in plan["patterns"]),
            settings=tuple(settings_from(record) for record in plan["settings"]),
            steps=tuple(AcquisitionStep(*step) for step in plan["steps"]),
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


def picture_digest(levels: np.ndarray) -> str:
    """SHA-256 of levels (row, column), uint8, and of their shape."""
    return hashlib.sha256(repr(levels.shape).encode() + levels.tobytes()).hexdigest()
