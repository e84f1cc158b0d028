"""What the numbers of designs are called, and how they are written, in tables and pictures."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from thincam_jax.design.space import QUANTITIES as FREE
from thincam_jax.units import nm


@dataclass(frozen=True)
class Quantity:
    """A number of a shot.

    - `what`: its name; `unit`: in which it is written, as `scale`, from the package's; `form`: how.
    """

    name: str
    what: str
    unit: str
    scale: float = 1.0
    form: str = ".2f"

    @property
    def label(self) -> str:
        """With its unit."""
        return f"{self.what}, {self.unit}" if self.unit else self.what

    @property
    def key(self) -> str:
        """In design.json's shots."""
        unit = self.unit.replace("/", "_per_").replace("²", "2")
        return f"{self.name}_{unit}" if unit else self.name


QUANTITIES = {
    "beta": Quantity("beta", "β", FREE["beta"].symbol),
    "distance": Quantity("distance", "distance", FREE["distance"].symbol),
    "wavelength": Quantity("wavelength", "wavelength", "nm", 1 / nm, ".0f"),
    "width": Quantity("width", "mask width", FREE["width"].symbol),
    "exposure": Quantity("exposure", "exposure", FREE["exposure"].symbol),
}
_ALWAYS = ("beta", "distance")


def free_number(name: str, shots: Sequence[int]) -> str:
    """Of a free number: "β of shot 1, rad/mm²"."""
    what, comma, unit = QUANTITIES[name].label.partition(",")
    if not shots:  # all masks share it
        return f"{what}{comma}{unit}"
    word = "shot" if len(shots) == 1 else "shots"
    return f"{what} of {word} {', '.join(str(s) for s in shots)}{comma}{unit}"


def first(shots: Sequence[int]) -> int:
    """Where the first of these shots stands; of none, which is all, the first of all."""
    return shots[0] - 1 if shots else 0


def of_shots(one: dict[str, Any], name: str, shots: Sequence[int]) -> str:
    """A number of a design of design.json, as the first of its shots has it."""
    quantity = QUANTITIES[name]
    return f"{one['shots'][first(shots)][quantity.key]:{quantity.form}}"


def found_number(value: dict[str, Any]) -> str:
    """A free number of design.json, with its tolerance."""
    quantity = QUANTITIES[value["variable"]]
    text = f"{value['value'] * quantity.scale:{quantity.form}}"
    if value["tolerance"] is None:
        return text
    return f"{text} (±{value['tolerance'] * quantity.scale:.2g})"


def told_of(designs: Sequence[dict[str, Any]]) -> tuple[str, ...]:
    """β and distance, and what else is not the same in all shots of all designs."""
    every = [shot for one in designs for shot in one["shots"]]
    return tuple(
        name
        for name, quantity in QUANTITIES.items()
        if name in _ALWAYS or len({shot.get(quantity.key) for shot in every}) > 1
    )


def cells(one: dict[str, Any], names: Sequence[str]) -> list[str]:
    """Each number of all shots; one that all share stands once, but for β."""
    told = []
    for name in names:
        texts = [of_shots(one, name, [shot]) for shot in range(1, len(one["shots"]) + 1)]
        told.append(", ".join(texts if len(set(texts)) > 1 or name == "beta" else texts[:1]))
    return told


def in_words(one: dict[str, Any], names: Sequence[str]) -> list[str]:
    """Each shot of a design: "β 25.00 at 5.00 mm", "β 21.00 at 6.50 mm"."""
    told = []
    for shot in range(1, len(one["shots"]) + 1):
        words = f"β {of_shots(one, 'beta', [shot])} at {of_shots(one, 'distance', [shot])} mm"
        for name in names:
            if name not in _ALWAYS:
                what, _, unit = QUANTITIES[name].label.partition(",")
                words += f", {what} {of_shots(one, name, [shot])}{unit}"
        told.append(words)
    return told
