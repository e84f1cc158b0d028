"""Reading a complete acquisition: its frames and their records."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NotRequired, TypedDict

import numpy as np

from thincam_jax._core.capture_store import CaptureStore, CaptureStoreError, frame_digest, listed
from thincam_jax._core.files import read_regular
from thincam_jax._core.text import of_error
from thincam_jax.hardware.acquisition.plan import AcquisitionPlan, Pattern, settings_from
from thincam_jax.hardware.acquisition.recorder import JOURNAL, PLAN, frame_records, read_journal
from thincam_jax.hardware.base import CameraSettings
from thincam_jax.measured.exposures import ExposedFrames, MergedExposures, merge_exposures
from thincam_jax.measured.raw import Raw


class FrameRecord(TypedDict):
    """Record of a frame: when it was `taken` (UTC), the camera's `number` and `time` (s), the
    `exposure` (s), the stage's `position` (mm or None), the `saturated` pixels."""

    digest: str
    taken: str
    number: int
    time: float
    exposure: float
    position: float | None
    saturated: int
    retries: int


class Provenance(TypedDict):
    """Record of a run: its devices, and the settings `asked` for; `plan`: hash of the plan."""

    plan: str
    devices: dict[str, dict[str, str]]
    versions: dict[str, str]
    procedure: dict[str, float | int | None]
    asked: list[dict[str, object]]
    display_shape: NotRequired[tuple[int, int]]
    begun: str


@dataclass(frozen=True)
class Acquisition:
    """A complete acquisition.

    - `settings`: actual camera settings, one for each of `plan.settings`; `shots`: one a step.
    """

    path: Path
    plan: AcquisitionPlan
    settings: tuple[CameraSettings, ...]
    bits: int
    sensor_shape: tuple[int, int]
    shots: tuple[FrameRecord, ...]
    provenance: Provenance

    @classmethod
    def load(cls, path: str | Path) -> "Acquisition":
        """Read a complete acquisition; `HadamardCaptures.load` reads one of a Hadamard plan, too.

        **Errors**: CaptureStoreError, one line, for another store, and for one that lacks frames.
        """
        path = Path(path)
        store = CaptureStore(path)
        attributes = store.attributes
        try:
            begun: Any = dict(attributes["acquisition"])
            plan = AcquisitionPlan.from_json(read_regular(path / PLAN).decode("utf-8"))
            settings = tuple(settings_from(record) for record in begun.pop("settings"))
            if begun["plan"] != plan.hash or len(store.digests) != len(plan.steps):
                raise ValueError("its plan is another one")
        except Exception as error:  # whatever another's plan or attributes bring about
            raise CaptureStoreError(
                f"{path} is not what an acquisition made ({of_error(error)}); give a store of "
                "acquire()"
            ) from error
        shots = frame_records(path / JOURNAL, read_journal(path / JOURNAL), len(plan.steps))
        missing = sorted({n for n in range(len(plan.steps)) if n not in shots} | store.lost())
        if missing:
            raise CaptureStoreError(
                f"{path}: {len(missing)} of {len(plan.steps)} frames are missing: {listed(missing)}"
                "; run the same acquisition again to take them"
            )
        rows, columns = attributes["sensor_shape"]
        return cls(
            path,
            plan,
            settings,
            attributes["bits"],
            (rows, columns),
            tuple(shots[number] for number in range(len(plan.steps))),
            begun,
        )

    @property
    def lit(self) -> list[int]:
        """Numbers of the steps of `captures`, `patterns` and `distances`: all but dark frames."""
        return [number for number, step in enumerate(self.plan.steps) if not step.dark]

    @property
    def patterns(self) -> list[Pattern]:
        """Pattern shown for each capture."""
        return [self.plan.pattern(self.plan.steps[number]) for number in self.lit]

    @property
    def pixels(self) -> tuple[slice, slice]:
        """Rows and columns of the sensor that were read."""
        (rows, columns), region = self.sensor_shape, self.settings[0].region
        top, left = (0, 0) if region is None else (region.top, region.left)
        return slice(top, top + rows), slice(left, left + columns)

    def raw(self, step: int) -> Raw:
        """Frame of a step as `prepare` takes it."""
        return Raw(self.frame(step), self.bits, name=f"frame {step} of {self.path}")

    @property
    def distances(self) -> list[float | None]:
        """Stage position plus the plan's `stage_zero`, mm, for each capture."""
        zero = self.plan.facts.get("stage_zero", 0.0)
        places = [self.shots[number]["position"] for number in self.lit]
        return [None if place is None else place + zero for place in places]

    def frame(self, step: int) -> np.ndarray:
        """Counts (y, x) of a step; CaptureStoreError where they have changed since."""
        pixels = CaptureStore(self.path).read(step)
        if f"{frame_digest(pixels):016x}" != self.shots[step]["digest"]:
            raise CaptureStoreError(
                f"{self.path}: frame {step} is not the one that was taken; capture again"
            )
        return pixels

    def dark(self, settings: int = 0) -> np.ndarray | None:
        """Mean of the dark frames with the settings of that number, (y, x) counts."""
        if not (numbers := self._steps(settings, True)):
            return None
        total = np.zeros(self.sensor_shape)
        for number in numbers:
            total += self.frame(number)
        return (total / len(numbers)).astype(np.float32)

    def _steps(self, settings: int, dark: bool) -> list[int]:
        steps = enumerate(self.plan.steps)
        return [n for n, step in steps if (step.settings, step.dark) == (settings, dark)]

    def captures(self) -> np.ndarray:
        """All captures (capture, y, x) in counts, float32, minus the mean dark frame."""
        dark = {n: self.dark(n) for n in range(len(self.settings))}
        found = np.empty((len(self.lit), *self.sensor_shape), np.float32)
        for place, number in enumerate(self.lit):
            found[place] = self.frame(number)
            offset = dark[self.plan.steps[number].settings]
            if offset is not None:
                found[place] -= offset
        return found

    def means(self) -> Iterator[tuple[Pattern, np.ndarray]]:
        """Each pattern and the mean of its frames, (y, x) counts minus the mean dark frame."""
        of_pattern: dict[int, list[int]] = {}
        for number in self.lit:
            of_pattern.setdefault(self.plan.steps[number].pattern, []).append(number)
        dark = self.dark()
        for pattern, numbers in of_pattern.items():
            total = sum(self.frame(number).astype(np.float32) for number in numbers)
            mean = np.asarray(total) / len(numbers)
            yield self.plan.patterns[pattern], mean if dark is None else mean - dark

    def exposed(self) -> list[ExposedFrames]:
        """Frames and dark frames of each exposure; ValueError for fewer than two of either."""

        def frames(number: int, dark: bool) -> np.ndarray:
            found = [self.frame(step) for step in self._steps(number, dark)]
            return np.reshape(found, (-1, *self.sensor_shape))

        return [
            ExposedFrames(one.exposure, frames(number, False), frames(number, True))
            for number, one in enumerate(self.settings)
        ]

    def merged(self) -> MergedExposures:
        """One linear image, counts per second, of a scene's frames; see `merge_exposures`."""
        return merge_exposures(self.exposed(), 2**self.bits - 1)

    def scene(self) -> tuple[np.ndarray, np.ndarray | None]:
        """One frame (1, y, x) of a scene, and its variance (y, x), in counts of the first exposure.

        None for the variance, and the mean of the frames, where one exposure has no two frames and
        two dark ones to tell it by.
        """
        darks = len(self.plan.steps) - len(self.lit)
        if min(len(self.lit), darks) < 2 * len(self.settings):
            return self.captures().mean(axis=0, keepdims=True), None
        exposure, found = self.settings[0].exposure, self.merged()
        frame = (exposure * found.rate)[None].astype(np.float32)
        return frame, exposure**2 * found.noise_variance
