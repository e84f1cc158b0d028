"""Entry point of the command `thincam`: Ctrl-C ends it in one line from the first moment.

Imported before anything else, hence it imports next to nothing itself.
"""

import os
import sys

from thincam_jax.commands.interrupt import INTERRUPTED, end_on_interrupt


def main() -> None:
    """Run the command `thincam`."""
    end_on_interrupt()
    os.environ["MPLBACKEND"] = "agg"  # figures are files
    from thincam_jax.commands.cli import app

    try:
        app(prog_name="thincam")
    except SystemExit as end:
        if end.code == INTERRUPTED:
            # Not by way of the interpreter's end: threads that still compile may crash there.
            sys.stdout.flush()
            sys.stderr.flush()
            os._exit(INTERRUPTED)
        raise


if __name__ == "__main__":
    main()
