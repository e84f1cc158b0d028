"""What the stages make of faults at random moments, as counts; printed as a table for the docs.

`python tests/stage_faults.py 100` prints what the documentation of the rig shows.
"""

import random
import sys
import threading
from collections import Counter
from contextlib import suppress
from dataclasses import dataclass, field

from thincam_jax.hardware.base import Disconnected, HardwareError, NotHomed, ProtocolError, Stage
from thincam_jax.hardware.stages.grbl import GrblStage
from thincam_jax.hardware.stages.zaber import ZaberStage
from thincam_jax.hardware.virtual.devices import Fault
from thincam_jax.hardware.virtual.grbl import VirtualGrbl
from thincam_jax.hardware.virtual.serial_device import Motion, VirtualSerialDevice
from thincam_jax.hardware.virtual.zaber import VirtualZaber

STAGES = {"zaber": (ZaberStage, VirtualZaber), "grbl": (GrblStage, VirtualGrbl)}
# The errors that are right for a fault; a fault without any has to be recovered.
RIGHT: dict[Fault, tuple[type[HardwareError], ...]] = {
    "latency": (),
    "busy": (),
    "wrong_checksum": (),
    "nak": (ProtocolError,),
    "unplug": (Disconnected,),
    "lost_steps": (NotHomed,),
}
MOTION = Motion(travel=10.0, speed=1000.0, latency=0.02)
TOLERANCE = 0.004  # mm: a step, and the digits of a position


@dataclass
class Counts:
    """What became of one fault, injected so often."""

    injected: int = 0
    recovered: int = 0
    stopped: Counter[str] = field(default_factory=Counter)  # by the name of the error
    wrong_errors: list[str] = field(default_factory=list)
    wrong_positions: int = 0  # the stage said that it is where it is not


def campaign(stage: str, fault: Fault, times: int, seed: int = 0) -> Counts:
    """Injects a fault at random moments while a stage homes, moves and is asked where it is."""
    driver, virtual = STAGES[stage]
    random_ = random.Random(f"{stage} {fault} {seed}")
    counts = Counts()
    with virtual(MOTION, seed=seed) as device:
        options = driver.Options(port=str(device.port))
        opened: Stage = driver.open(options)
        opened.home()
        try:
            for _ in range(times):
                error = _one(opened, device, fault, random_, counts)
                if isinstance(error, Disconnected):
                    opened.close()
                    opened = _open_again(driver, options)
                if error is not None:
                    opened.home()
                    _check(opened.position(), device, counts)
        finally:
            opened.close()
    return counts


def _open_again(driver, options) -> Stage:
    """As a user does whose plug is not quite in yet."""
    for _ in range(4):
        with suppress(Disconnected):
            return driver.open(options)
    return driver.open(options)


def _one(
    stage: Stage, device: VirtualSerialDevice, fault: Fault, random_: random.Random, counts: Counts
) -> HardwareError | None:
    """One fault; returns the error that it ended in."""
    played = device.faults.happened[fault]
    injector = threading.Timer(random_.uniform(0.0, 0.02), device.faults.inject, [fault])
    injector.start()
    counts.injected += 1
    error = None
    while error is None and device.faults.happened[fault] == played:
        try:
            if random_.random() < 0.2:
                stage.home()
            else:
                target = random_.uniform(0.0, 10.0)
                reached = stage.move_to(target)
                _check(reached, device, counts)
                counts.wrong_positions += abs(reached - target) > TOLERANCE
            for _ in range(random_.randrange(1, 20)):  # as long as it moved, so faults hit both
                _check(stage.position(), device, counts)
        except HardwareError as raised:
            error = raised
    injector.join()
    if error is None:
        counts.recovered += 1
        return None
    if isinstance(error, NotHomed):  # and it says so until it is homed
        with suppress(NotHomed):
            _check(stage.position(), device, counts)
    counts.stopped[type(error).__name__] += 1
    if not isinstance(error, RIGHT[fault]):
        counts.wrong_errors.append(str(error))
    return error


def _check(said: float, device: VirtualSerialDevice, counts: Counts) -> None:
    counts.wrong_positions += abs(said - device.true_position) > TOLERANCE


def table(times: int) -> str:
    """Markdown: for each stage and fault, how often it was injected, recovered and stopped."""
    lines = ["| stage | fault | injected | recovered | stopped with | wrong positions |",
             "|---|---|--:|--:|---|--:|"]  # fmt: skip
    for stage in STAGES:
        for fault in RIGHT:
            counts = campaign(stage, fault, times)
            stopped = ", ".join(f"{name} {n}" for name, n in counts.stopped.items()) or "—"
            lines.append(
                f"| {stage} | {fault.replace('_', ' ')} | {counts.injected} | {counts.recovered} "
                f"| {stopped} | {counts.wrong_positions} |"
            )
    return "\n".join(lines)


if __name__ == "__main__":
    print(table(int(sys.argv[1])))
