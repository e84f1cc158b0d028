"""Draws which room of the package imports which, with their sizes: `python docs/draw_rooms.py`.

Rooms and floors are those of tests/test_architecture.py. The rooms are the steps of a staircase.
From each a line leads to the left, across the columns of the rooms below: a dot marks an import.
"""

import json
import sys
from pathlib import Path

from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from PIL import Image

ROOT = Path(__file__).resolve().parents[1]
sys.path.append(str(ROOT / "tests"))
from source_tree import PACKAGE, read_package  # noqa: E402
from test_architecture import CLOSED, FLOORS, OUTSIDE, OUTSIDE_USES, PLOT, room, room_of  # noqa: E402

PICTURE = ROOT / "docs/images/rooms.png"
WIDTH, HEIGHT = 0.96, 0.64  # of a box, in steps
LINE = {"color": "0.45", "lw": 1.4}


def rooms_and_imports() -> dict[str, tuple[int, list[str]]]:
    """The lines of each room and the rooms that it imports, lowest floor first.

    But `plot` below it: only methods `plot` of results import it, when they are called. What a
    closed room has on higher floors counts to its lines, and imports for the room of that floor.
    """
    names = []
    for floor in FLOORS:
        names += [*floor, OUTSIDE] if OUTSIDE_USES in floor else floor
    rooms, package = {}, read_package(ROOT / PACKAGE)
    for name in names:
        modules = [module for module in package if module.top == name]
        here = [module for module in package if room(module) == name]
        names_in = [to.split(".") for module in here for _, to in module.imports]
        imported = {(to[0], room_of(to[1:])) for to in names_in if to[1:]}
        used = [
            other
            for place, other in enumerate(names)
            if other != name
            and (PACKAGE, other) in imported
            and not (other == PLOT and place > names.index(name))
        ]
        if modules:
            rooms[name] = (sum(len(module.text.splitlines()) for module in modules), used)
    return rooms


def imports_drawn(picture: Path = PICTURE) -> dict[str, list[str]]:
    """The imports that a picture shows: they are kept in the file, beside its pixels."""
    with Image.open(picture) as image:
        return json.loads(image.text["Description"])


def draw(picture: Path = PICTURE) -> None:
    rooms = rooms_and_imports()
    step = {name: float(number) for number, name in enumerate(rooms)}
    count = len(rooms)
    figure = Figure(figsize=(1.15 * count, 0.68 * count), layout="constrained")
    axes = figure.add_subplot()
    for floor in FLOORS:  # a band; what stands outside has none
        steps = [step[name] for name in floor if name in step]
        low, high = min(steps, default=0) - 0.42, max(steps, default=0) + 0.42
        axes.add_patch(Rectangle((-0.6, low), count + 0.2, high - low, fc="0.93"))
    for name, (lines, used) in rooms.items():
        at = step[name]
        importers = [step[other] for other, (_, uses) in rooms.items() if name in uses]
        if importers:
            arrow = {"arrowstyle": "-|>", "shrinkA": 0, "shrinkB": 0, **LINE}
            axes.annotate("", (at, at + HEIGHT / 2), (at, max(importers)), arrowprops=arrow)
        if used:
            axes.plot([min(step[other] for other in used), at], [at, at], zorder=1, **LINE)
        axes.plot([step[other] for other in used], [at] * len(used), "ko", ms=7, zorder=4)
        corner = (at - WIDTH / 2, at - HEIGHT / 2)
        axes.add_patch(Rectangle(corner, WIDTH, HEIGHT, fc="white", ec="black", lw=1.4, zorder=2))
        centred = {"ha": "center", "va": "center"}
        axes.text(at, at + 0.12, name, fontsize=8.5, weight="bold", **centred)
        axes.text(at, at - 0.15, f"{lines:,} lines", fontsize=9, **centred)
    words = (
        "A box is a room, a grey band a floor: imports go to lower floors only.\n"
        "A dot says that the room at the right end of its line\n"
        "imports the room at the foot of its column."
    )
    if OUTSIDE in rooms:
        words += f"\n{OUTSIDE} stands on no floor: only its command imports it."
    if closed := [name for name in CLOSED if name in rooms]:
        words += f"\n{', '.join(closed)} may be left out with all that is theirs."
    axes.text(count - 0.55, 0.0, words, ha="right", va="center", fontsize=9)
    axes.set(xlim=(-0.65, count - 0.35), ylim=(-0.5, count - 0.5))
    axes.axis("off")
    shown = json.dumps({name: used for name, (_, used) in rooms.items()})
    figure.savefig(picture, dpi=110, metadata={"Description": shown})


if __name__ == "__main__":
    draw()
