"""State of the virtual rig (pattern, stage position, exposure) and the resulting frame.

The optics take the pixels shown, not the plan: a wrong pattern gives a wrong capture.
"""

import threading
import time
import zlib
from collections import Counter, OrderedDict
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from jaxtyping import Float, UInt8, UInt16

from thincam_jax._core.grids import block_sum, central_blocks
from thincam_jax._core.quantity import check_fields, quantity
from thincam_jax.hardware.base import CameraSettings
from thincam_jax.hardware.virtual.optics import Optics

_KEPT = 8  # cached images


@dataclass(frozen=True)
class Electronics:
    """Conversion of electrons to counts: shot and read noise, offset, saturation at the full well.

    - `full_well`: electrons of the largest count without gain; `read_noise`: in electrons.
    - `offset`: counts of a dark frame at 12 bits.
    """

    full_well: Annotated[float, quantity("electrons", positive=True)] = 13_500.0
    read_noise: Annotated[float, quantity("electrons", non_negative=True)] = 8.0
    offset: Annotated[float, quantity("counts", least=0.0, most=2047.0)] = 60.0

    def __post_init__(self):
        check_fields(self)

    def counts(
        self, electrons: Float[np.ndarray, "y x"], settings: CameraSettings, seed: list[int]
    ) -> UInt16[np.ndarray, "y x"]:
        """Counts in the pixel format's bits; the shot noise is Gaussian, of Poisson variance."""
        scale, offset = self.scale(settings)
        random = np.random.default_rng(seed)
        noise = random.standard_normal(electrons.shape, dtype=np.float32)
        noise *= np.sqrt(electrons + np.float32(self.read_noise**2))
        values = (electrons + noise) * np.float32(scale) + np.float32(offset)
        return np.clip(np.rint(values), 0, 2 ** bits_of(settings) - 1).astype(np.uint16)

    def scale(self, settings: CameraSettings) -> tuple[float, float]:
        """Counts per electron, and the offset in counts."""
        offset = self.offset * 2.0 ** (bits_of(settings) - 12)
        room = 2 ** bits_of(settings) - 1 - offset
        return 10 ** (settings.gain / 20) * room / self.full_well, offset


def bits_of(settings: CameraSettings) -> int:
    """Bits of a pixel format such as Mono12."""
    return int("".join(c for c in settings.pixel_format if c.isdigit()))


@dataclass(frozen=True)
class Fiducial:
    """Conditions of a frame's exposure, written into its corner for tests.

    - `pattern`: checksum of the pixels shown (`pattern_number`). `position`: the stage's, µm.
    - `exposure`: number of the exposure of that pattern at that position, from 0.
    """

    pattern: int
    position: int
    exposure: int


FIDUCIAL_SHAPE = (12, 8)  # a bit a pixel


def pattern_number(shown: UInt8[np.ndarray, "v u"]) -> int:
    """32-bit checksum of the pixels shown."""
    return zlib.crc32(np.ascontiguousarray(shown).data)


def _write_fiducial(pixels: UInt16[np.ndarray, "y x"], fiducial: Fiducial, bit_depth: int) -> None:
    words = np.array([fiducial.pattern, fiducial.position + 2**31, fiducial.exposure], ">u4")
    bits = np.unpackbits(words.view(np.uint8)).reshape(FIDUCIAL_SHAPE)
    pixels[: FIDUCIAL_SHAPE[0], : FIDUCIAL_SHAPE[1]] = bits.astype(np.uint16) * 2 ** (bit_depth - 1)


class VirtualRig:
    """The state shared by virtual devices; thread-safe.

    `on_show` is for a display, `on_move` for a stage, `expose` for a camera. The noise of an
    exposure depends on the pattern, the position and the step of the plan (`on_step`), so that a
    resumed run gives the same frames as an uninterrupted one; before the first step on the number
    of earlier exposures of both.

    - `response`: s until the display changes to a new pattern.
    - `fiducial`: write a `Fiducial` in place of the image in each frame's corner.
    """

    def __init__(
        self,
        optics: Optics,
        electronics: Electronics | None = None,
        *,
        display_shape: tuple[int, int],
        response: Annotated[float, quantity("s", non_negative=True)] = 0.0,
        fiducial: bool = False,
        seed: int = 0,
    ):
        self.optics, self.electronics = optics, electronics or Electronics()
        self.display_shape, self.response = display_shape, response
        self.fiducial, self.seed = fiducial, seed
        black = np.zeros(display_shape, np.uint8)
        self._shown = self._before = pattern_number(black), black
        self._shown_at, self._position = -np.inf, 0.0
        self._lock = threading.RLock()
        self._known: OrderedDict[tuple[int, int], np.ndarray] = OrderedDict()
        self._exposures: Counter[tuple[int, int]] = Counter()
        self._step: int | None = None

    def on_show(self, pattern: UInt8[np.ndarray, "v u"]) -> None:
        """Present a pattern; computes its image in advance."""
        if pattern.shape != self.display_shape:
            raise ValueError(f"a pattern of {pattern.shape} pixels; give {self.display_shape}")
        shown = np.array(pattern, np.uint8)
        with self._lock:
            number = pattern_number(shown)
            self._before, self._shown = self._shown, (number, shown)
            self._image(number, shown)
            self._shown_at = time.monotonic()

    def on_move(self, position: float) -> None:
        """Set the stage's position, mm, moving or not."""
        with self._lock:
            self._position = position

    def on_step(self, number: int) -> None:
        """Begin a step of a plan, by its number."""
        self._step = number

    @property
    def position(self) -> float:
        """Position of the stage, mm."""
        return self._position

    def expose(self, settings: CameraSettings) -> UInt16[np.ndarray, "y x"]:
        """Counts of a frame exposed now, within the settings' region."""
        with self._lock:
            settled = time.monotonic() - self._shown_at >= self.response
            number, shown = self._shown if settled else self._before
            state = number, round(1000 * self._position)
            electrons = settings.exposure * self._image(number, shown)
            kept = central_blocks(electrons.shape, settings.binning)
            electrons = block_sum(electrons[kept], settings.binning)
            exposure = self._exposures[state]
            self._exposures[state] += 1
        region = settings.region
        if region is not None:
            down = slice(region.top, region.top + region.height)
            electrons = electrons[down, region.left : region.left + region.width]
        drawn = [exposure] if self._step is None else [self._step, 1]  # of another length
        seed = [self.seed, number, state[1] + 2**31, *drawn]
        pixels = self.electronics.counts(electrons, settings, seed)
        if self.fiducial:
            _write_fiducial(pixels, Fiducial(*state, exposure), bits_of(settings))
        return pixels

    def _image(self, number: int, shown: np.ndarray) -> np.ndarray:
        key = number, round(1000 * self._position)
        if key not in self._known:
            self._known[key] = self.optics(shown, self._position)
        self._known.move_to_end(key)
        while len(self._known) > _KEPT:
            self._known.popitem(last=False)
        return self._known[key]
