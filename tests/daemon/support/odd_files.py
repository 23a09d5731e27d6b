"""Files that are no regular files, where a regular one is expected."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Final

KINDS: Final = ("fifo", "folder", "device", "loop")


def planted(path: Path, kind: str) -> None:
    """Put a FIFO that nobody writes, a folder, a link to an endless device, or a link to itself in a file's place."""
    path.unlink(missing_ok=True)
    if kind == "fifo":
        os.mkfifo(path)
    elif kind == "folder":
        path.mkdir()
    elif kind == "device":
        path.symlink_to("/dev/zero")
    else:
        path.symlink_to(path.name)
