"""The user guide is short, in short sentences; what was measured and decided stands beside it."""

import re

import pytest

from helpers import ROOT


def read(*places: str) -> dict[str, str]:
    """Pages by their path below docs/."""
    paths = [path for place in places for path in (ROOT / "docs").glob(place)]
    return {path.relative_to(ROOT / "docs").as_posix(): path.read_text("utf-8") for path in paths}


GUIDE = read("start.md", "guide/*.md")


def sentences(text: str) -> list[list[str]]:
    """Words of each sentence of a page's prose: outside of code, tables, pictures and headings."""
    text = re.sub(r"^(```|\$\$).*?\1$", "", text, flags=re.MULTILINE | re.DOTALL)
    text = re.sub(r"^\s*(#|\||!\[|<| {4}\S).*$", "", text, flags=re.MULTILINE)
    text = re.sub(r"^\s*([-*]|\d+\.) ", "\n\n", text, flags=re.MULTILINE)
    text = re.sub(r"(`|\$)[^`$]*\1", "code", text)
    text = re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", text)
    parts = re.split(r"\n\s*\n|(?<=[.!?])[)*\"']*\s+|(?<=[.!?][)*\"'])\s+", text)
    return [[word for word in part.split() if re.search(r"\w", word)] for part in parts]


def test_sentences_are_counted():
    text = (
        "# Four words in it\n\nOne `two words` [three four](page.md) five. *Six\nseven!* Eight:\n"
    )
    text += "- nine ten;\n- eleven.\n\n| a | b |\n\n```py\nmany words of code\n```\n\n$$x + y$$\n"
    counts = [len(words) for words in sentences(text) if words]
    assert counts == [5, 2, 1, 2, 1]


@pytest.mark.parametrize("page", list(GUIDE))
def test_pages_of_the_guide_are_short(page):
    """900 words (`wc -w`), and no sentence of more than 30."""
    text = GUIDE[page]
    long = [" ".join(part) for part in sentences(text) if len(part) > 30]
    assert len(text.split()) <= 900
    assert not long, "\n".join(long)


def test_the_guide_is_short():
    assert sum(len(text.split()) for text in GUIDE.values()) <= 20_000


@pytest.mark.parametrize("place", ["measured", "decisions"])
def test_notes_are_listed(place):
    every = {page.split("/")[1][:-3]: text for page, text in read(f"{place}/*.md").items()}
    listed = re.findall(r"```{toctree}\n(?::[^\n]*\n)*\n(.*?)```", every.pop("index"), re.DOTALL)
    assert sorted(" ".join(listed).split()) == sorted(every)
    parts = [f"**{part}" for part in ("Context", "Choice", "Evidence", "Date")]
    assert place == "measured" or all(part in text for text in every.values() for part in parts)
