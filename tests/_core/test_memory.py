"""Sizes that do not fit are refused before the work, with the estimate."""

import pytest

from thincam_jax._core import memory


def test_refuses_with_both_numbers(monkeypatch):
    monkeypatch.setattr(memory, "available_bytes", lambda: 3 * 2**30)
    with pytest.raises(
        MemoryError, match=r"^a cube needs about 4.5 GiB, 3.0 GiB are free; halve it$"
    ):
        memory.refuse_if_too_large("a cube", int(4.5 * 2**30), "halve it")
    memory.refuse_if_too_large("a cube", 3 * 2**30, "halve it")


def test_free_memory_that_cannot_be_told_refuses_nothing(monkeypatch):
    monkeypatch.setattr(memory, "available_bytes", lambda: None)
    memory.refuse_if_too_large("a cube", 10**30, "halve it")


def test_free_memory_of_this_machine():
    """Between 10 MiB and 100 TiB, if it can be told at all: bytes, not pages or kilobytes."""
    free = memory.available_bytes()
    assert free is None or 10 * 2**20 < free < 100 * 2**40


def test_the_cache_of_files_is_free_memory(monkeypatch):
    """A file of gigabytes that was just written would leave none: pages that hold it are not."""
    lines = "MemTotal: 9 kB\nMemFree: 10 kB\nMemAvailable: 3000 kB\n"
    monkeypatch.setattr(memory.Path, "read_text", lambda path, encoding: lines)
    assert memory.available_bytes() == 3000 * 1024


@pytest.mark.parametrize(
    ("count", "text"),
    [
        (0, "0 bytes"),
        (1023, "1023 bytes"),
        (1024, "1.0 KiB"),
        (3 * 2**39, "1.5 TiB"),
        (2**70, "1048576.0 PiB"),
    ],
)
def testreadable(count, text):
    assert memory.readable(count) == text
