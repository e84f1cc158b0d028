"""Compiled programs are kept from one process to the next, in the user's cache folder.

JAX keeps them. It learns so from the environment, before it is imported: by a command, or by the
first name of `thincam_jax` that a script takes. `thincam --help` need not wait for JAX, and worker
processes keep their programs in the same folder.
"""

import os
import sys
import warnings
from pathlib import Path

_PATIENCE = 3.0  # s that another process may hold the cache; it takes it for milliseconds
LARGEST = 2**30  # bytes; beyond, JAX drops what was not used for longest

_SETTINGS = {
    "JAX_COMPILATION_CACHE_MAX_SIZE": str(LARGEST),
    # There are many small programs, of which most take longer to compile than to read.
    "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
    # XLA takes the processor for another one and says so in 4 kB for each program that it reads
    # (https://github.com/jax-ml/jax/issues/38445). What fails is an exception anyway.
    "TF_CPP_MIN_LOG_LEVEL": "3",
}


def cache_folder() -> Path:
    """Folder of the programs, below the platform's cache folder."""
    if sys.platform == "win32":
        base = os.environ.get("LOCALAPPDATA") or Path.home() / "AppData/Local"
    elif sys.platform == "darwin":
        base = Path.home() / "Library/Caches"
    else:
        base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(base) / "thincam_jax" / "programs"


def keep_programs() -> None:
    """Have JAX keep what it compiles, unless the user has said where, or THINCAM_CACHE=off.

    Where the folder cannot be written, nothing is kept and nothing is said; where another process
    holds it, a line says so.
    """
    is_off = os.environ.get("THINCAM_CACHE", "").lower() in ("0", "off", "no", "false", "n", "f")
    if is_off or "JAX_COMPILATION_CACHE_DIR" in os.environ:
        return
    from filelock import FileLock, Timeout

    folder = cache_folder()
    try:
        folder.mkdir(parents=True, exist_ok=True)
        _drop_unfinished(folder)
        with FileLock(folder / ".lockfile", timeout=_PATIENCE):  # JAX would wait for each program
            pass
    except Timeout:
        held = "the cache of programs is held by another process: nothing is kept"
        sys.stderr.write(f"thincam: warning: {held}\n")
        return
    except OSError:
        return
    if os.access(folder, os.W_OK | os.X_OK):
        os.environ["JAX_COMPILATION_CACHE_DIR"] = str(folder)
        for name, value in _SETTINGS.items():
            os.environ.setdefault(name, value)
        # Compiled anew, as if it were not there.
        warnings.filterwarnings("ignore", "Error .* persistent compilation cache entry")


def _drop_unfinished(folder: Path) -> None:
    """JAX writes a program and then when it was used; it stumbles over one without the other."""
    for program in folder.glob("*-cache"):
        if not program.with_name(program.name.removesuffix("cache") + "atime").exists():
            program.unlink(missing_ok=True)


def cache_state() -> str:
    """The folder and its size, or that it is not in use."""
    if not (chosen := os.environ.get("JAX_COMPILATION_CACHE_DIR")):
        return f"{cache_folder()}, not in use"
    folder = Path(chosen)
    size = sum(file.stat().st_size for file in folder.rglob("*") if file.is_file())
    most = f" of at most {LARGEST / 2**20:.0f}" if folder == cache_folder() else ""
    return f"{folder}, {size / 2**20:.1f} MiB{most}"
