"""Entry point of the command `thincam`: Ctrl-C ends it in one line from the first moment.

Imported before anything else, hence it imports next to nothing itself.
"""

import gc
import io
import os
import sys

from thincam_jax.commands.terminal import end_on_interrupt


def main() -> None:
    """Run the command `thincam`."""
    # Imports and tracing make many objects and little garbage: looking for it took a tenth.
    gc.set_threshold(50_000, 20, 100)
    end_on_interrupt()
    while (unused := os.open(os.devnull, os.O_RDWR)) <= 2:
        pass  # a stream that was closed at the start: its number is no file's to come
    os.close(unused)
    os.environ["MPLBACKEND"] = "agg"  # figures are files
    os.environ.pop("JAX_NUMPY_RANK_PROMOTION", None)  # is for scripts; no array here is theirs
    if isinstance(sys.stdout, io.TextIOWrapper):
        # Each line at once, so that a full disk is reported; escaped what the encoding lacks.
        sys.stdout.reconfigure(errors="backslashreplace", line_buffering=True)
    from thincam_jax.commands.cli import app

    try:
        app(prog_name="thincam")
    except (OSError, SystemExit) as end:
        if isinstance(end, OSError):  # of standard output; commands tell all others
            os.write(2, f"thincam: {end}\n".encode())
        if code := getattr(end, "code", 2):
            # Not by way of the interpreter's end: threads that still compile may crash there, and
            # what could not be printed would be reported again.
            os._exit(code)
        raise


if __name__ == "__main__":
    main()
