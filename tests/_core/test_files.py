import os

import pytest

from helpers import full_disk
from thincam_jax._core import files


@pytest.mark.parametrize("crash", [KeyboardInterrupt, OSError])
def test_crash_before_the_rename_leaves_the_old_file_alone(tmp_path, monkeypatch, crash):
    path = tmp_path / "a.txt"
    path.write_text("old", encoding="utf-8")
    seen = []

    def stop(source, target):
        seen.append(source.read_text(encoding="utf-8"))
        raise crash

    monkeypatch.setattr(os, "replace", stop)
    with pytest.raises(crash):
        files.write_whole(path, "new")
    assert seen == ["new"]  # the crash came after all was written
    assert path.read_text(encoding="utf-8") == "old"
    assert [p.name for p in tmp_path.iterdir()] == ["a.txt"]


def test_crash_while_writing_leaves_nothing_half(tmp_path):
    path = tmp_path / "a.txt"
    with full_disk(4), pytest.raises(files.WriteError, match="too large"):
        files.write_whole(path, "new text")
    assert list(tmp_path.iterdir()) == []


def test_no_link_is_followed_and_no_neighbour_is_overwritten(tmp_path):
    """Whatever another user has put beside it in a folder that both can write to."""
    path, victim = tmp_path / "a.txt", tmp_path / "victim"
    for place in (path, tmp_path / "a.txt.partial"):
        victim.write_text("mine", encoding="utf-8")
        place.symlink_to(victim)
        files.write_whole(path, "x")
        assert victim.read_text(encoding="utf-8") == "mine"
        assert not path.is_symlink() and path.read_text(encoding="utf-8") == "x"


def test_of_two_writers_of_a_file_one_wins(tmp_path, monkeypatch):
    path, replace = tmp_path / "a.txt", os.replace

    def other_first(source, target):
        monkeypatch.setattr(os, "replace", replace)
        files.write_whole(path, "second")
        replace(source, target)

    monkeypatch.setattr(os, "replace", other_first)
    files.write_whole(path, "first")
    assert path.read_text(encoding="utf-8") == "first"
    assert [p.name for p in tmp_path.iterdir()] == ["a.txt"]


def test_only_regular_files_are_read(tmp_path):
    (tmp_path / "file").write_bytes(b"abc")
    assert files.read_regular(tmp_path / "file") == b"abc"
    (tmp_path / "zero").symlink_to("/dev/zero")
    os.mkfifo(tmp_path / "pipe")
    for name in ("zero", "pipe"):
        with pytest.raises(OSError, match="a device or a pipe"):
            files.read_regular(tmp_path / name)
    with (tmp_path / "large").open("wb") as large:
        large.truncate(2**42)  # takes no room
    with pytest.raises(MemoryError, match=r"large needs about 4\.0 TiB"):
        files.read_regular(tmp_path / "large")
    (tmp_path / "loop").symlink_to(tmp_path / "loop")
    with pytest.raises(OSError, match="symbolic links"):
        files.read_regular(tmp_path / "loop")
