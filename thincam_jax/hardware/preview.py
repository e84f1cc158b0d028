"""A rig at work, to align, focus and expose by: each newest frame, and settings that are turned."""

import dataclasses
import io
import json
import math
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import tifffile

from thincam_jax._core.controls import Control, View, turned
from thincam_jax._core.files import write_whole
from thincam_jax.hardware.acquisition.plan import AcquisitionPlan, AcquisitionStep
from thincam_jax.hardware.acquisition.rig import Rig
from thincam_jax.hardware.acquisition.taker import Procedure, Taker, full_scale
from thincam_jax.hardware.base import CameraSettings, Frame, HardwareError
from thincam_jax.imaging.encoding import jpeg_bytes
from thincam_jax.measured.examination import examine
from thincam_jax.measured.options import Preparation
from thincam_jax.measured.raw import Raw

_LONGEST = 900  # pixels of the longer side of a shown frame
_BINS = 64  # of the histogram
_SPREAD, _GAIN = 10.0, 24.0  # how far the exposure is turned, and the gain, dB
_SATURATED = (255, 40, 40)  # the colour of full pixels
_EXAMINED = 3.0  # seconds after which a frame is examined again


@dataclass(frozen=True)
class FrameNumbers:
    """Exposure and focus of a frame.

    - `brightest`: count that a thousandth of the pixels exceeds, over the largest that there is.
    - `saturated`: share of full pixels. `focus`: mean squared Laplacian over the mean squared: it
      is largest where detail is sharpest.
    - `histogram`: pixels by count from 0 to full scale, over the most frequent.
    """

    brightest: float
    saturated: float
    focus: float
    histogram: np.ndarray

    @classmethod
    def of(cls, frame: Frame) -> "FrameNumbers":
        full, pixels = full_scale(frame), frame.pixels.astype(np.float32)
        inner = pixels[1:-1, 1:-1]
        around = pixels[:-2, 1:-1] + pixels[2:, 1:-1] + pixels[1:-1, :-2] + pixels[1:-1, 2:]
        level = float(np.mean(pixels) ** 2) or 1.0
        counts, _ = np.histogram(pixels, _BINS, (0, full + 1))
        return cls(
            float(np.quantile(pixels, 0.999)) / full,
            float(np.mean(frame.pixels >= full)),
            float(np.mean((around - 4 * inner) ** 2)) / level,
            counts / counts.max(),
        )


class Preview:
    """The newest frame of a rig, whose settings are turned; see `Controlled`.

    - `rig`: its devices, open. `plan`: whose patterns are shown, and whose first settings it begins
      with.
    - `procedure`: settle time and timeout, as of an acquisition; nothing is tried again.
    - `image`: reconstruction of a frame (y, x) of the first pattern, as levels 0 to 1.
    - `folder`: folder of the frames that are kept.

    The error of a device is shown as a line; an unplugged one is opened again. So is what `examine`
    finds in a frame: in the first of new settings, and every 3 s.
    """

    captions = {
        "frame": "frame, black to full scale; full pixels are red, the cross is the middle",
        "transfer": "pixels by count, from 0 to full scale, over the most frequent",
        "image": "reconstruction of the first pattern's frame",
    }
    live = True

    def __init__(
        self,
        rig: Rig,
        plan: AcquisitionPlan,
        procedure: Procedure | None = None,
        *,
        image: Callable[[np.ndarray], np.ndarray] | None = None,
        folder: Path | None = None,
    ):
        self.rig, self.plan = rig, plan
        self.taker = Taker(plan, rig, dataclasses.replace(procedure or Procedure(), retries=0))
        self.image, self.folder = image, folder or Path("frames")
        self.settings = plan.settings[0]
        self._asked: CameraSettings | None = None
        if image is None:
            self.captions = {k: v for k, v in self.captions.items() if k != "image"}
        exposure = 1000 * self.settings.exposure
        controls = [
            Control("exposure", "exposure", "ms", exposure / _SPREAD, _SPREAD * exposure, exposure),
            Control("gain", "gain", "dB", 0.0, _GAIN, min(max(self.settings.gain, 0.0), _GAIN)),
        ]
        if len(plan.patterns) > 1:
            most = float(len(plan.patterns) - 1)
            controls.append(Control("pattern", "pattern", "", 0.0, most, 0.0))
        if rig.stage is not None and rig.stage.by_hand:
            rig.stage = None  # its person moves it unasked
        if rig.stage is not None:
            low, high = rig.stage.limits
            place = min(max(rig.stage.position(), low), high)
            controls.append(Control("position", "stage", "mm", low, high, place))
        self.controls = tuple(controls)
        self.values = {one.name: one.value for one in controls}
        self._position: float | None = None  # the stage stays where it is until it is turned
        self._best, self._seen = 0.0, time.monotonic()
        self._rate = 0.0
        self._findings: tuple[str, ...] = ()
        self._examined: tuple[float, dict[str, float]] = (-math.inf, {})

    def turn(self, values: dict[str, float]) -> None:
        """Set controls, each within its range; ValueError names one that does not exist."""
        before = self.values.get("position")
        self.values |= turned(self.controls, values)
        if self.values.get("position") != before:
            self._position = self.values["position"]

    def view(self, *, rest: bool = False) -> View:
        """The next frame; `rest` keeps it in the folder."""
        try:
            frame = self._frame()
        except HardwareError as error:
            with suppress(HardwareError):
                self.taker.recover(error)
            return View(dict(self.values), {}, 1 / _BINS, np.zeros(0), lines=(str(error),))
        numbers = FrameNumbers.of(frame)
        now = time.monotonic()
        rate = 1 / max(now - self._seen, 1e-6)
        self._seen, self._rate = now, rate if not self._rate else 0.8 * self._rate + 0.2 * rate
        self._best = max(self._best, numbers.focus)
        lines = [
            f"{numbers.brightest:.0%} of full scale, {numbers.saturated:.2%} of the pixels full.",
            f"Focus {numbers.focus:.3g}, best {self._best:.3g}.",
            f"Exposure {1000 * frame.exposure:.3g} ms, {self._rate:.1f} frames a second.",
        ]
        lines += self._found(frame, now)
        if rest:
            lines.append(f"Kept as {self._keep(frame)}.")
        pictures = {"frame": jpeg_bytes(_shown(frame))}
        if self.image is not None and self._pattern == 0:
            image = np.clip(self.image(frame.pixels.astype(np.float32)), 0, 1)
            pictures["image"] = jpeg_bytes(np.round(255 * image).astype(np.uint8))
        histogram = 1 / _BINS, numbers.histogram
        return View(dict(self.values), pictures, *histogram, lines=tuple(lines))

    def _found(self, frame: Frame, now: float) -> tuple[str, ...]:
        """Findings in a frame, or in one of these settings that is not long ago."""
        since, values = self._examined
        if now - since > _EXAMINED or values != self.values:
            raw = Raw(frame.pixels, frame.bit_depth, name="frame")
            options = Preparation(bayer=self.settings.bayer)
            self._findings = tuple(str(one) for one in examine([raw], options=options).findings)
            self._examined = now, dict(self.values)
        return self._findings

    @property
    def _pattern(self) -> int:
        return round(self.values.get("pattern", 0.0))

    def _frame(self) -> Frame:
        """Frame taken with the devices set to the controls; only what has changed is set."""
        turned_to = {"exposure": self.values["exposure"] / 1000, "gain": self.values["gain"]}
        asked = dataclasses.replace(self.plan.settings[0], **turned_to)
        if asked != self._asked:
            self.settings, self._asked = self.taker.set_near(asked), asked
        step = AcquisitionStep(self._pattern, self._position)
        return self.taker.take(step, self.settings, probe=True)[0]

    def _keep(self, frame: Frame) -> Path:
        """A TIFF of the counts, with where they come from as its description."""
        when = datetime.now(UTC)
        known = {
            "time": when.isoformat(),
            "devices": {role: str(one) for role, one in self.rig.identities().items()},
            "settings": dataclasses.asdict(self.settings),
            "pattern": self.plan.patterns[self._pattern].label,
            "position_mm": self.values.get("position"),
            "number": int(frame.number),
            "bits": frame.bit_depth,
        }
        content = io.BytesIO()
        tifffile.imwrite(content, frame.pixels, description=json.dumps(known))
        self.folder.mkdir(parents=True, exist_ok=True)
        path = self.folder / f"{when:%Y%m%d-%H%M%S}-{frame.number}.tif"
        write_whole(path, content.getvalue())
        return path


def _shown(frame: Frame) -> np.ndarray:
    """8 bits, RGB, at most some 900 pixels a side, with full pixels in red and a cross."""
    full = full_scale(frame)
    step = max(1, math.ceil(max(frame.pixels.shape) / _LONGEST))
    pixels = frame.pixels[::step, ::step]
    # Where any of a block is full, it is shown.
    blocks = np.maximum.reduceat(
        np.maximum.reduceat(frame.pixels, np.arange(0, frame.pixels.shape[0], step), axis=0),
        np.arange(0, frame.pixels.shape[1], step),
        axis=1,
    )
    grey = (pixels.astype(np.float32) * (255 / full)).astype(np.uint8)
    picture = np.repeat(grey[..., None], 3, axis=-1)
    rows, columns = grey.shape
    for line in (picture[rows // 2], picture[:, columns // 2]):
        line[:] = np.where(line < 128, 255, 0)
    picture[blocks >= full] = _SATURATED
    return picture
