"""Texts of files and users in messages: escaped, and cut to a length."""


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
