"""Tables of results: numbers as they are, and as plain text."""

from collections.abc import Sequence
from dataclasses import dataclass


def number(value: float | None, digits: int) -> str:
    """With so many decimals; a dash for none."""
    return "–" if value is None else f"{value:.{digits}f}"


@dataclass(frozen=True)
class Table:
    """Rows of a name and numbers; as text it is Markdown, which notebooks show as a table.

    - `headings`: of the columns. `digits`: decimals of each column but the first.
    - `rows`: None where there is no number.
    """

    headings: tuple[str, ...]
    digits: tuple[int, ...]
    rows: tuple[tuple[str | float | None, ...], ...]

    def text(self) -> list[list[str]]:
        """Headings and rows as they are shown."""
        found = [list(self.headings)]
        for name, *numbers in self.rows:
            cells = zip(numbers, self.digits, strict=True)
            found.append([str(name), *(number(value, digits) for value, digits in cells)])  # pyright: ignore[reportArgumentType]
        return found

    def __str__(self) -> str:
        rows = self.text()
        widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
        ruled = ["-" * widths[0], *("-" * (width - 1) + ":" for width in widths[1:])]
        return "\n".join(_line(row, widths) for row in (rows[0], ruled, *rows[1:]))

    def _repr_markdown_(self) -> str:
        return str(self)


def _line(row: Sequence[str], widths: Sequence[int]) -> str:
    first, *others = zip(row, widths, strict=True)
    cells = [first[0].ljust(first[1]), *(cell.rjust(width) for cell, width in others)]
    return f"| {' | '.join(cells)} |"
