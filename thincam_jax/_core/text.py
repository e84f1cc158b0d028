"""Texts of files and users in messages: escaped, cut to a length, and names near what was meant."""

import re
from collections.abc import Iterable


def escaped(text: str) -> str:
    """Text whose control characters and marks of writing direction are written out."""
    return "".join(c if c.isprintable() or c in "\n\xa0\u202f" else ascii(c)[1:-1] for c in text)


def shortened(text: str, longest: int = 60) -> str:
    """The begin of a text, with its number of characters where it is longer."""
    return text if len(text) <= longest else f"{text[:longest]}… ({len(text)} characters)"


def of_error(error: BaseException) -> str:
    """Kind and text of an error of another library, in a line."""
    return shortened(f"{type(error).__name__}: {' '.join(str(error).split())}", 200)


def spelled(value: object) -> str:
    """A value as YAML has it."""
    return {"None": "null", "True": "true", "False": "false"}.get(repr(value), str(value))


def nearest(name: str, known: Iterable[str]) -> list[str]:
    """At most three of the known names that are spelled nearly so, nearest first.

    Capitals, underscores and hyphens do not count: "AdmmTV" is "admm_tv".
    """
    import difflib  # here, since only messages need it

    plain = {re.sub(r"[\W_]", "", one).casefold(): one for one in known}
    given = re.sub(r"[\W_]", "", name).casefold()
    return [plain[one] for one in difflib.get_close_matches(given, plain)]


def meant(given: object, known: Iterable[str]) -> str:
    """The end of a message: what a text that is not known may have been meant for."""
    near = nearest(given, known) if isinstance(given, str) else []
    return f"; did you mean {near[0]!r}?" if near else ""


def one_of(given: object, known: Iterable[str]) -> str:
    """Advice to choose one of the texts that are known, and which may have been meant."""
    known = tuple(known)
    return f"choose one of {', '.join(known)}{meant(given, known)}"


def slug(name: str) -> str:
    """A name as a file name."""
    return re.sub(r"[^a-z0-9._]+", "-", name.lower()).strip("-._") or "unnamed"
