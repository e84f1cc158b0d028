"""Tables of results: numbers and texts, as Markdown, in a terminal and on a page."""

from collections.abc import Sequence
from dataclasses import dataclass

Cell = str | float | int | None


def number(value: float | None, digits: int) -> str:
    """Text of a value with so many decimals; a dash for none."""
    return "–" if value is None else f"{value:.{digits}f}"


@dataclass(frozen=True)
class Table:
    """Rows of cells under headings; as text it is Markdown, which notebooks show as a table.

    - `headings`: one a column; a line break stays one on a page and in a terminal.
    - `rows`: texts and numbers, None where there is no number; the first cell names its row.
    - `digits`: decimals of the columns after the first; integers and texts need none.
    - `title`: stands above the table.
    - `published`: columns of others' figures, grey on a page.
    - `words`: columns of words, to the left on a page.
    """

    headings: Sequence[str]
    rows: Sequence[Sequence[Cell]]
    digits: Sequence[int] = ()
    title: str = ""
    published: Sequence[int] = ()
    words: Sequence[int] = ()

    def __post_init__(self):
        for row in self.rows:
            if len(row) != len(self.headings):
                raise ValueError(f"{len(row)} cells under {len(self.headings)} headings: {row}")

    def texts(self) -> list[list[str]]:
        """The rows as they are shown."""
        return [[self._text(*cell) for cell in enumerate(row)] for row in self.rows]

    def _text(self, column: int, cell: Cell) -> str:
        if cell is None or isinstance(cell, str | int):
            return "–" if cell is None else str(cell)
        if not 0 < column <= len(self.digits):
            raise ValueError(f"{cell} in column {column}: give `digits` for its decimals")
        return number(cell, self.digits[column - 1])

    def __str__(self) -> str:
        every = (self.headings, *self.texts())
        rows = [[cell.replace("\n", " ") for cell in row] for row in every]
        widths = [max(3, *map(len, column)) for column in zip(*rows, strict=True)]
        ruled = ["-" * widths[0], *("-" * (width - 1) + ":" for width in widths[1:])]
        lines = [_line(row, widths) for row in (rows[0], ruled, *rows[1:])]
        return "\n".join([self.title, "", *lines] if self.title else lines)

    def _repr_markdown_(self) -> str:
        return str(self)


def _line(row: Sequence[str], widths: Sequence[int]) -> str:
    first, *others = zip(row, widths, strict=True)
    cells = [first[0].ljust(first[1]), *(cell.rjust(width) for cell, width in others)]
    return f"| {' | '.join(cells)} |"
