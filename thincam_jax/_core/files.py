"""Files that are written whole or not at all."""

import os
from pathlib import Path


def write_whole(path: str | os.PathLike[str], content: bytes | str) -> Path:
    """Write `NAME.partial` beside the file and rename it; text as UTF-8.

    After an error or Ctrl-C the old file is untouched and no partial one is left.
    """
    path = Path(path)
    partial = path.with_name(path.name + ".partial")
    data = content.encode("utf-8") if isinstance(content, str) else content
    try:
        partial.write_bytes(data)
        os.replace(partial, path)
    except BaseException:
        if not partial.is_dir():
            partial.unlink(missing_ok=True)
        raise
    return path
