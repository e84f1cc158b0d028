"""Drivers by name: those of this package, and those that other packages register.

A driver is a `Device` class with a frozen dataclass `Options`, the options in a config file, and a
class method `open(options)`. Another package registers one by an entry point in its pyproject.toml:

    [project.entry-points."thincam_jax.cameras"]
    my_camera = "my_package:MyCamera"

Looking moves and changes nothing: cameras are read by their descriptors, monitors by the system's
list, and serial ports stay closed. What is behind a serial port tells only an answer: `ask_port`
asks one port for it, by questions that a Zaber or a GRBL only reads.
"""

import time
from collections.abc import Mapping
from contextlib import closing
from dataclasses import fields, is_dataclass
from importlib import import_module
from importlib.metadata import entry_points
from typing import Any

from thincam_jax._core.arguments import checked
from thincam_jax.hardware.base import Connected, Device, HardwareError, NotFound

_BUILT_IN = {
    "cameras": {
        "pylon": "thincam_jax.hardware.cameras.pylon:PylonCamera",
        "aravis": "thincam_jax.hardware.cameras.aravis:AravisCamera",
        "pylablib": "thincam_jax.hardware.cameras.pylablib:PylablibCamera",
        "picamera2": "thincam_jax.hardware.cameras.picamera2:RaspberryPiCamera",
    },
    "stages": {
        "zaber": "thincam_jax.hardware.stages.zaber:ZaberStage",
        "grbl": "thincam_jax.hardware.stages.grbl:GrblStage",
        "manual": "thincam_jax.hardware.stages.manual:ManualStage",
    },
    "displays": {
        "sdl": "thincam_jax.hardware.displays.sdl:SdlDisplay",
        "tkinter": "thincam_jax.hardware.displays.tkinter:TkinterDisplay",
        "shutter": "thincam_jax.hardware.displays.settle:Shutter",
    },
}
KINDS = tuple(_BUILT_IN)


@checked
def drivers(kind: str) -> dict[str, str]:
    """Names of the drivers of "cameras", "stages" or "displays", and the place of each."""
    if kind not in _BUILT_IN:
        raise ValueError(f"{kind!r} is no kind of device; give one of {', '.join(KINDS)}")
    outside = {point.name: point.value for point in entry_points(group=f"thincam_jax.{kind}")}
    return {**outside, **_BUILT_IN[kind]}


@checked
def driver(kind: str, name: str) -> type[Device]:
    """Class of a driver; `NotFound` where it is unknown, broken or its library is missing."""
    found = _class(kind, name)
    getattr(found, "require_libraries", lambda: None)()  # those that pip does not install
    return found


def _class(kind: str, name: str) -> type[Device]:
    known = drivers(kind)
    if name not in known:
        raise NotFound(name, "open", f"no driver of that name among the {kind}",
                       f"use one of {', '.join(known)}")  # fmt: skip
    module, _, attribute = known[name].partition(":")
    try:
        found = getattr(import_module(module), attribute)
        if not (issubclass(found, Device) and is_dataclass(found.Options)):
            raise TypeError(f"{attribute} is no device with Options of a dataclass")
    except ImportError as error:
        remedy = "pip install 'thincam-jax[hardware]'"
        raise NotFound(name, "open", f"its library is missing ({error})", remedy) from error
    except (Exception, SystemExit) as error:  # whatever code of another package may raise
        cause, remedy = f"broken ({type(error).__name__}: {error})", f"mend or remove {module}"
        raise NotFound(name, "open", cause, remedy) from error
    return found


def driver_report() -> list[str]:
    """A line for each driver: its kind, name and package, and why it cannot be used."""
    lines = []
    for kind in KINDS:
        for name, place in drivers(kind).items():
            package = place.partition(".")[0].partition(":")[0]
            outside = "" if package == "thincam_jax" else f", from {package}"
            try:
                driver(kind, name)
                fault = ""
            except NotFound as error:
                fault = f": {error.cause}; {error.remedy}"
            lines.append(f"driver of {kind} {name}{outside}{fault}")
    return lines


@checked
def open_device(kind: str, name: str, options: Mapping[str, Any] | None = None) -> Any:
    """Open a device; `options` are attributes of the driver's `Options`."""
    return driver(kind, name).open(read_options(kind, name, options))


def read_options(kind: str, name: str, options: Mapping[str, Any] | None = None) -> Any:
    """`Options` of a driver; ValueError for those that it has not."""
    made, given = _class(kind, name).Options, dict(options or {})
    allowed = [field.name for field in fields(made)]
    if unknown := set(given) - set(allowed):
        raise ValueError(
            f"{name} has no option {', '.join(sorted(unknown))}; allowed: {', '.join(allowed)}"
        )
    return made(**given)


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


def ask_port(port: str) -> list[Connected]:
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

    with closing(SerialLink("serial port", port, 115200)) as link:
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
