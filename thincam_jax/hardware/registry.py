"""Drivers by name: those of this package, and those that other packages register.

A driver is a `Device` class with a frozen dataclass `Options`, the options in a config file, and a
class method `open(options)`. Another package registers one by an entry point in its pyproject.toml:

    [project.entry-points."thincam_jax.cameras"]
    my_camera = "my_package:MyCamera"
"""

from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from importlib import import_module
from importlib.metadata import entry_points
from typing import Any

from thincam_jax._core.arguments import checked
from thincam_jax.hardware.base import Device
from thincam_jax.hardware.errors import NotFound

_BUILT_IN = {
    "cameras": {
        "usb3_vision": "thincam_jax.hardware.cameras.usb3_vision.camera:Usb3VisionCamera",
        "pylon": "thincam_jax.hardware.cameras.pylon:PylonCamera",
        "aravis": "thincam_jax.hardware.cameras.aravis:AravisCamera",
        "pylablib": "thincam_jax.hardware.cameras.pylablib:PylablibCamera",
    },
    "stages": {
        "zaber": "thincam_jax.hardware.stages.zaber:ZaberStage",
        "grbl": "thincam_jax.hardware.stages.grbl:GrblStage",
    },
    "displays": {
        "sdl": "thincam_jax.hardware.displays.sdl:SdlDisplay",
        "tkinter": "thincam_jax.hardware.displays.tkinter:TkinterDisplay",
        "shutter": "thincam_jax.hardware.displays.shutter:Shutter",
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
    getattr(found, "require_libraries", lambda: None)()  # those that pip does not install
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
    """Open a device; `options` are fields of the driver's `Options`."""
    chosen, given = driver(kind, name), dict(options or {})
    allowed = [field.name for field in fields(chosen.Options)]
    if unknown := set(given) - set(allowed):
        raise ValueError(
            f"{name} has no option {', '.join(sorted(unknown))}; allowed: {', '.join(allowed)}"
        )
    return chosen.open(chosen.Options(**given))
