"""Compiled programs of commands: where they are, that they are read, and no error where not."""

import fcntl
import os
import subprocess
import sys
from pathlib import Path

import pytest

import thincam_jax as tc
from helpers import ROOT
from thincam_jax._core import program_cache as cache


@pytest.fixture
def environment(monkeypatch, tmp_path):
    """Without settings of JAX's cache, and put back afterwards."""
    names = [name for name in os.environ if name.startswith(("JAX_COMPILATION", "JAX_PERSISTENT"))]
    names.append("THINCAM_CACHE")
    for name in (*names, *cache._SETTINGS, "JAX_COMPILATION_CACHE_DIR"):
        monkeypatch.setenv(name, "")
        monkeypatch.delenv(name)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(cache.warnings, "filterwarnings", lambda *_: None)
    monkeypatch.setattr(sys, "platform", "linux")
    return tmp_path / "thincam_jax" / "programs"


@pytest.mark.parametrize(
    ("platform", "variable", "folder"),
    [
        ("linux", "XDG_CACHE_HOME", "thincam_jax/programs"),
        ("win32", "LOCALAPPDATA", "thincam_jax/programs"),
        ("linux", None, "home/.cache/thincam_jax/programs"),
        ("darwin", None, "home/Library/Caches/thincam_jax/programs"),
        ("win32", None, "home/AppData/Local/thincam_jax/programs"),
    ],
)
def test_folder_of_the_platform(monkeypatch, tmp_path, platform, variable, folder):
    monkeypatch.setattr(sys, "platform", platform)
    monkeypatch.setattr(Path, "home", lambda: tmp_path / "home")
    for name in ("XDG_CACHE_HOME", "LOCALAPPDATA"):
        monkeypatch.delenv(name, raising=False)
    if variable:
        monkeypatch.setenv(variable, str(tmp_path))
    assert cache.cache_folder() == tmp_path / folder


def test_jax_is_told_where_and_how_much(environment):
    cache.keep_programs()
    assert os.environ["JAX_COMPILATION_CACHE_DIR"] == str(environment)
    assert int(os.environ["JAX_COMPILATION_CACHE_MAX_SIZE"]) == 2**30
    (environment / "jit_f-cache").write_bytes(bytes(2**20))
    assert cache.cache_state() == f"{environment}, 1.0 MiB of at most 1024"


@pytest.mark.parametrize("switch", ["on", "off"])
def test_the_first_name_that_a_script_takes_has_jax_keep_programs(environment, monkeypatch, switch):
    monkeypatch.setenv("THINCAM_CACHE", switch)
    tc.units  # noqa: B018 (JAX is imported, and has begun with its own settings)
    assert "JAX_COMPILATION_CACHE_DIR" not in os.environ
    monkeypatch.delitem(sys.modules, "jax")
    tc.__getattr__("units")
    assert ("JAX_COMPILATION_CACHE_DIR" in os.environ) == (switch == "on")


def test_a_cache_that_another_process_holds_is_not_waited_for(environment, monkeypatch, capsys):
    monkeypatch.setattr(cache, "_PATIENCE", 0.0)
    environment.mkdir(parents=True)
    with (environment / ".lockfile").open("w") as other:
        fcntl.flock(other, fcntl.LOCK_EX)
        cache.keep_programs()
    assert "JAX_COMPILATION_CACHE_DIR" not in os.environ
    assert capsys.readouterr().err == (
        "thincam: warning: the cache of programs is held by another process: nothing is kept\n"
    )


def test_folder_that_cannot_be_written(environment, monkeypatch):
    monkeypatch.setattr(os, "access", lambda *_: False)
    cache.keep_programs()
    assert "JAX_COMPILATION_CACHE_DIR" not in os.environ


@pytest.mark.thorough
def test_second_run_reads_what_the_first_has_compiled(tmp_path):
    """Also where a program is damaged, and where another was not written to its end."""
    told = ("JAX_COMPILATION", "JAX_PERSISTENT", "TF_CPP")  # by these tests' own process
    kept = {k: v for k, v in os.environ.items() if not k.startswith(told)}
    path = os.pathsep.join(filter(None, [str(ROOT), kept.get("PYTHONPATH")]))
    place = {"XDG_CACHE_HOME": tmp_path, "HOME": tmp_path, "LOCALAPPDATA": tmp_path}
    variables = {**kept, "PYTHONPATH": path, "THINCAM_CACHE": "on", **place}

    def run():
        command = [sys.executable, "-m", "thincam_jax.commands.start", "doctor", "--all"]
        done = subprocess.run(command, capture_output=True, text=True, env=variables, timeout=120)
        assert (done.returncode, done.stderr) == (0, "")
        assert "compiled sums: right" in done.stdout
        return {path: path.read_bytes() for path in tmp_path.rglob("*-atime")}

    first = run()
    assert len(first) > 3
    damaged, unfinished, *_ = first
    damaged.with_name(damaged.name.replace("-atime", "-cache")).write_bytes(b"damaged")
    unfinished.unlink()
    second = run()
    assert second.keys() == first.keys()
    assert all(second[path] != first[path] for path in first if path != damaged)  # when read


def test_folder_that_cannot_be_made(environment, monkeypatch, tmp_path):
    (tmp_path / "thincam_jax").write_text("mine", "utf-8")
    cache.keep_programs()
    assert "JAX_COMPILATION_CACHE_DIR" not in os.environ
    assert cache.cache_state() == f"{environment}, not in use"
