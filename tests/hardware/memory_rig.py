"""A rig in memory: devices that do what the interfaces say, and with `Faults` what they must not.

Each pattern carries a fiducial, its number in base 256 in the first pixels; the camera sees what is
shown with a texture of its own, so that a frame tells of which pattern it is, whole. It imports no
JAX: `python memory_rig.py STORE FRAMES [rows|stays|pictures|scene|manual]` is what tests kill.
"""

import itertools
import sys
import time
from dataclasses import replace

import numpy as np

from thincam_jax.hardware import Camera, CameraSettings, Display, Stage
from thincam_jax.hardware.acquisition.plan import BLACK, AcquisitionPlan, AcquisitionStep, Pattern
from thincam_jax.hardware.acquisition.rig import Rig
from thincam_jax.hardware.base import (
    Busy,
    Disconnected,
    Frame,
    Identity,
    IncompleteFrame,
    NotFound,
    OutOfRange,
    ProtocolError,
    Region,
    Timeout,
)
from thincam_jax.hardware.plans import pictures, scene
from thincam_jax.hardware.stages.manual import ManualStage
from thincam_jax.hardware.virtual.devices import Faults

SHAPE = (6, 9)  # of sensor and display
BITS = 12
SETTINGS = CameraSettings(exposure=0.01)
TEXTURE = np.random.default_rng(3).integers(100, 2000, SHAPE).astype(np.uint16)


class World:
    """What the devices share: the pattern shown, where the stage is, and the faults to come."""

    def __init__(self, shape=SHAPE, texture=TEXTURE, pause=0.0):
        self.shape, self.texture, self.pause = shape, texture, pause
        self.faults = Faults()
        self.shown = np.zeros(shape, np.uint8)
        self.position, self.homed = 0.0, True
        self.opened = {"camera": 0, "display": 0, "stage": 0}
        self.absent = 0  # how often a device that is opened again is not there yet
        self.unplugs: str | None = None  # the device that "unplug" is for; None: any
        self.light = 1.0
        self.serial, self.limits = "1", (0.0, 50.0)
        self.exposed: list[tuple[int, float]] | None = None  # fiducial and exposure of each frame

    def open(self, kind):
        role = kind.__name__.removeprefix("Memory").lower()
        if self.opened[role] and self.absent:
            self.absent -= 1
            raise NotFound(role, "open", "no such device", "plug it in")
        self.opened[role] += 1
        return kind(self)

    def rig(self, stage=True, manual=False):
        by_hand = lambda: ManualStage(ManualStage.Options(highest=50.0), self.move)  # noqa: E731
        return Rig(
            lambda: self.open(MemoryCamera),
            lambda: self.open(MemoryDisplay),
            self.render,
            by_hand if manual else (lambda: self.open(MemoryStage)) if stage else None,
        )

    def move(self, position):
        self.position = position

    def render(self, pattern: Pattern) -> np.ndarray:
        levels = np.zeros(self.shape, np.uint8)
        if pattern != BLACK:
            levels[0, :4] = digits(number_of(pattern) + 1)
        return levels

    def see(self, exposure: float) -> np.ndarray:
        """Counts of what is shown: the number in the first four pixels, a texture in the others."""
        number = fiducial(self.shown)
        if number < 0:
            return np.zeros(self.shape, np.uint16)
        lit = np.roll(self.texture, 7 * number).reshape(self.shape)
        if self.light != 1.0 or exposure != SETTINGS.exposure:
            lit = np.minimum(lit * (self.light * exposure / SETTINGS.exposure), 2**BITS - 1)
        lit = lit.astype(np.uint16)
        lit[0, :4] = self.shown[0, :4]
        return lit

    def unplugged(self, role: str) -> Disconnected:
        return Disconnected(role, "use", "it is not there any more", "plug it in")


def digits(number: int) -> list[int]:
    """A number in base 256, the lowest digit first."""
    return [number // 256**place % 256 for place in range(4)]


def number_of(pattern: Pattern) -> int:
    """The number of a pattern that is not black; pictures are named by it."""
    return int(pattern.numbers.get("number", pattern.numbers.get("name", 0)))


def fiducial(pixels: np.ndarray) -> int:
    """The number of the pattern that a frame shows, −1 for black."""
    return sum(int(digit) * 256**place for place, digit in enumerate(pixels[0, :4])) - 1


class MemoryDevice:
    def __init__(self, world: World):
        self.world, self.here = world, True
        self.role = type(self).__name__.removeprefix("Memory").lower()

    @property
    def identity(self) -> Identity:
        return Identity("thincam_jax", f"memory {self.role}", self.world.serial)

    def close(self) -> None:
        self.here = False

    def play(self, *faults: str) -> None:
        """What goes wrong with a command, of the faults that this device is asked for."""
        if not self.here:
            raise self.world.unplugged(self.role)
        for fault in faults:
            elsewhere = fault == "unplug" and self.world.unplugs not in (None, self.role)
            if elsewhere or not self.world.faults.due(fault):
                continue
            if fault == "latency":
                time.sleep(0.002)
            elif fault == "unplug":
                self.here = False
                raise self.world.unplugged(self.role)
            elif fault == "busy":
                raise Busy(self.role, "use", "it is not ready", "wait for it")
            else:
                raise ProtocolError(self.role, "use", f"it answered with a {fault}", "run again")


class MemoryCamera(MemoryDevice, Camera):
    def __init__(self, world):
        super().__init__(world)
        self.count, self.settings, self.last = 0, None, None

    @property
    def sensor_shape(self):
        return self.world.shape

    def configure(self, settings):
        self.play("nak", "wrong_checksum")
        if not 1e-5 <= settings.exposure <= 1:
            raise OutOfRange("camera", "configure", f"{settings.exposure} s", "give 1e-5 … 1 s")
        region = settings.region or Region(0, 0, *self.world.shape)
        exposure = round(settings.exposure * 1e6) / 1e6
        self.settings = replace(settings, exposure=exposure, region=region)
        return self.settings

    def flush(self):
        self.play("unplug")

    def trigger_and_grab(self, timeout):
        self.play("latency", "busy", "unplug")
        if self.settings is None:
            raise ProtocolError("camera", "trigger", "it has not been set", "configure it")
        if self.last is not None and self.world.faults.due("stale_frame"):
            return self.last
        if self.world.pause:
            time.sleep(self.world.pause)
        self.count += 1
        if self.world.faults.due("dropped_frame"):
            raise Timeout("camera", "trigger", f"no frame within {timeout} s", "wait longer")
        pixels = self.world.see(self.settings.exposure)
        if self.world.exposed is not None:
            pixels[1, :4] = digits(len(self.world.exposed))
            self.world.exposed.append((fiducial(self.world.shown), self.settings.exposure))
        region = self.settings.region
        rows = slice(region.top, region.top + region.height)
        pixels = pixels[rows, region.left : region.left + region.width]
        if self.world.faults.due("short_frame"):
            if self.count % 2:
                raise IncompleteFrame("camera", "grab", "half of it is missing", "check the cable")
            pixels = pixels[: len(pixels) // 2]
        self.last = Frame(pixels, self.count, 0.01 * self.count, self.settings.exposure, BITS)
        return self.last


class MemoryDisplay(MemoryDevice, Display):
    @property
    def shape(self):
        return self.world.shape

    def show(self, pattern):
        self.play("unplug")
        self.world.shown = pattern


class MemoryStage(MemoryDevice, Stage):
    @property
    def limits(self):
        return self.world.limits

    @property
    def homed(self):
        return self.world.homed

    def home(self, timeout=60.0):
        self.world.position, self.world.homed = 0.0, True

    def move_to(self, position, timeout=60.0):
        self.play("latency", "nak", "busy", "wrong_checksum", "unplug")
        if not self.limits[0] <= position <= self.limits[1]:
            raise OutOfRange("stage", "move", f"{position} mm", "stay within 0 … 50 mm")
        self.world.position = position
        if self.world.faults.due("lost_steps"):
            self.world.position += 1.5
            self.world.homed = False
        return position

    def position(self):
        self.play()
        return self.world.position

    def stop(self):
        self.play()


def fiducial_plan(
    count: int, *, every: int = 5, dark_every: int = 0, stage: bool = True
) -> AcquisitionPlan:
    """Steps that show each its own number; the stage moves on after `every` of them."""
    patterns = (*(Pattern("fiducial", {"number": number}) for number in range(count)), BLACK)
    steps = []
    for number in range(count):
        place = float(number // every % 40) if stage else None
        if dark_every and number % dark_every == 0:
            steps.append(AcquisitionStep(count, place, dark=True))
        steps.append(AcquisitionStep(number, place))
    return AcquisitionPlan("fiducials", patterns, (SETTINGS,), tuple(steps))


def staying(plan: AcquisitionPlan) -> AcquisitionPlan:
    """The plan with a position only where the stage moves, and none for the first steps."""
    places = [step.position for step in plan.steps]
    moves = [None, *(b if a != b else None for a, b in itertools.pairwise(places))]
    steps = [replace(s, position=p) for s, p in zip(plan.steps, moves, strict=True)]
    return replace(plan, steps=tuple(steps))


def by_rows(plan: AcquisitionPlan) -> AcquisitionPlan:
    """The plan, 2^n patterns of it, as one of Hadamard patterns: 16 frames share a chunk."""
    dark = sum(step.dark for step in plan.steps)
    cells = {"object_shape": [len(plan.steps) - dark, 1], "order": "natural"}
    series = {**cells, "display": "binary", "dark_frames": dark}
    return replace(plan, facts={"series": series})


def picture_plan(count: int, frames: int = 4) -> AcquisitionPlan:
    """Pictures on the cells, several frames of each, and dark frames among them."""
    shown = {str(number): np.full((2, 3), number, np.int32) for number in range(count // frames)}
    return pictures(shown, SETTINGS, frames=frames, dark_frames=count // 8)


def scene_plan(count: int) -> AcquisitionPlan:
    """Three exposures of one pattern, the longer ones saturated in part, and their dark frames."""
    exposures, mask = (0.01, 0.03, 0.1), Pattern("fiducial", {"number": 0})
    numbers = {"frames": count // 3, "dark_frames": count // 6}
    return scene(mask, SETTINGS, exposures=exposures, **numbers)


if __name__ == "__main__":
    from jax._src import xla_bridge

    from thincam_jax.hardware.acquisition.acquire import acquire

    count = int(sys.argv[2])
    plan = fiducial_plan(count, dark_every=16)
    kinds = {
        "rows": lambda: by_rows(plan), "stays": lambda: staying(plan),
        "pictures": lambda: picture_plan(count), "scene": lambda: scene_plan(count)
    }  # fmt: skip
    for kind in kinds.keys() & set(sys.argv):
        plan = kinds[kind]()
    with World(pause=0.004).rig(manual="manual" in sys.argv) as rig:
        done = acquire(plan, rig, sys.argv[1])
    assert not xla_bridge.backends_are_initialized()  # the rig leaves the GPU to others
    print("complete" if done.complete else "stopped")
