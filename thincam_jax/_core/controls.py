"""Numbers that are turned by hand, on a page or in a widget."""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np

from thincam_jax._core import checks


@dataclass(frozen=True)
class Control:
    """A number that is turned.

    - `name`: name of the number; `label`, `unit`: words that are shown.
    - `low`, `high`, `value`: in the shown unit. `scale`: units of the package of one shown unit.
    """

    name: str
    label: str
    unit: str
    low: float
    high: float
    value: float
    scale: float = 1.0


@dataclass(frozen=True, eq=False)
class View:
    """Pictures and numbers of a setting.

    - `pictures`: files of "psf", and at rest of "capture" and "image": JPEG, at rest PNG.
    - `step`: cycles/mm from one entry of `transfer`, |H| along u at v = 0 over its value at low
      frequencies, to the next; without zero frequency, which is the background's. In place of it a
      rig has the histogram of a frame.
    - `cut_off`: cycles/mm, where it ends. `zero`: at rest, the first that a zone aperture's fringe
      scanning cannot carry; None where there is none.
    - `values`: values of the controls. `lines`: sentences about the setting, at rest.
    """

    values: dict[str, float]
    pictures: dict[str, bytes]
    step: float
    transfer: np.ndarray
    cut_off: float = 0.0
    zero: float | None = None
    lines: tuple[str, ...] = ()

    def message(self) -> tuple[str, list[bytes]]:
        """A header as JSON, and the pictures in the order of its `names`."""
        header = {
            "names": [*self.pictures],
            "step": self.step,
            "transfer": [round(float(value), 4) for value in self.transfer],
            "zero": self.zero,
            "cut_off": self.cut_off,
            "lines": self.lines,
            "values": self.values,
        }
        return json.dumps(header), [*self.pictures.values()]


@runtime_checkable
class Controlled(Protocol):
    """Controls and pictures of a page.

    - `captions`: captions of its pictures, by name, "transfer" that of a curve; None for those of a
      camera.
    - `live`: whether it changes by itself, so that the page goes on asking.
    """

    controls: tuple[Control, ...]
    captions: Mapping[str, str] | None
    live: bool

    def turn(self, values: dict[str, float]) -> None:
        """Set controls; ValueError where one does not exist, or is out of its range."""

    def view(self, *, rest: bool = True) -> View:
        """The pictures of the setting; at rest, or to keep a live one, all of them."""
        ...


def turned(controls: tuple[Control, ...], values: Mapping[str, float]) -> dict[str, float]:
    """Values checked, each within its control's range; ValueError names one that does not exist."""
    known, found = {control.name: control for control in controls}, {}
    for name, value in values.items():
        checks.choice("control", name, known)
        one = known[name]
        found[name] = float(checks.between(name, value, one.unit, one.low, one.high))
    return found
