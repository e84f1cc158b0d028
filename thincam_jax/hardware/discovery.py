"""Devices that are connected, and the lines of a file that use them.

Looking moves and changes nothing: cameras are read by their descriptors, monitors by the system's
list, and serial ports stay closed. What is behind a serial port tells only an answer: `ask_port`
asks one port for it, by questions that a Zaber or a GRBL only reads.
"""

import time
from contextlib import closing

from thincam_jax.hardware.base import Connected
from thincam_jax.hardware.errors import HardwareError, NotFound
from thincam_jax.hardware.registry import KINDS, driver, drivers

_PATIENCE = 0.5  # s for an answer
_STARTING = 2.5  # s; opening the port restarts many boards of GRBL


def report(asked: str | None = None) -> list[str]:
    """A line for each device and serial port that is there, and for what answers at one port.

    **Errors**: as of `ask_port`.
    """
    answers = [] if asked is None else list(map(str, ask_port(asked)))
    if asked is not None and not answers:
        answers = [f"{asked}: no Zaber and no GRBL answers"]
    return [*map(str, (*connected_devices(), *serial_ports())), *answers]


def connected_devices() -> list[Connected]:
    """Cameras, stages and displays that their drivers find, of other packages' drivers, too.

    A driver whose library is missing finds none, see `registry.driver_report`.
    """
    found = []
    for kind in KINDS:
        for name in drivers(kind):
            try:
                found += driver(kind, name).connected()
            except NotFound:
                continue
            except HardwareError as error:
                found.append(Connected(kind[:-1], name, {}, f"cannot be asked: {error}"))
    return found


def serial_ports() -> list[Connected]:
    """Serial ports, unopened, with what their adapters are called."""
    try:
        from serial.tools import list_ports
    except ImportError:
        return []
    return [
        Connected("serial port", "", {"port": port.device}, port.description)
        for port in sorted(list_ports.comports())
    ]


def ask_port(port: str, baud_rate: int = 115200) -> list[Connected]:
    """The stages that answer at a serial port: Zaber's, or a GRBL machine.

    Sends "?", to which GRBL reports its state, and "/get system.serial", to which each Zaber device
    answers. Opening the port restarts many boards of GRBL, which then have to be homed; nothing is
    moved, and no setting is changed.

    **Errors**: HardwareError where the port cannot be opened: held by another program, not
    permitted, not there.
    """
    from thincam_jax.hardware.stages import grbl, zaber
    from thincam_jax.hardware.stages.serial_link import SerialLink

    def lines(link: SerialLink, question: bytes, patience: float):
        end = time.monotonic() + patience
        link.write(question, end)
        while True:
            try:
                yield link.read_line(end)
            except HardwareError:  # none in time, or none at this baud rate
                return

    with closing(SerialLink("serial port", port, baud_rate)) as link:
        for patience in (_PATIENCE, _STARTING):
            for line in lines(link, grbl.ASK, patience):
                try:
                    message = grbl.parse_line(line)
                except HardwareError:
                    continue
                if message.kind in ("status", "banner"):
                    about = message.text and f"Grbl {message.text}" or f"state {message.state}"
                    return [Connected("stage", "grbl", {"port": port}, about)]
            found = []
            for line in lines(link, b"\n/get system.serial\n", _PATIENCE):
                try:
                    reply = zaber.parse_message(line)
                except HardwareError:
                    continue
                if reply.kind == "@" and reply.accepted:
                    options = {"port": port, "device": reply.device}
                    found.append(Connected("stage", "zaber", options, f"serial {reply.data}"))
            if found:
                return found
    return []
