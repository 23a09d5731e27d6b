"""Files that are no regular files, where a regular one is expected."""

import os
import socket
from pathlib import Path
from typing import Final

KINDS: Final = ("fifo", "folder", "device", "loop", "socket")


def planted(path: Path, kind: str) -> None:
    """Put a FIFO, a folder, a link to an endless device or to itself, or a socket in a file's place."""
    path.unlink(missing_ok=True)
    if kind == "fifo":
        os.mkfifo(path)
    elif kind == "folder":
        path.mkdir()
    elif kind == "device":
        path.symlink_to("/dev/zero")
    elif kind == "loop":
        path.symlink_to(path.name)
    else:
        folder = os.open(path.parent, os.O_RDONLY)  # the name of a socket has few characters
        with socket.socket(socket.AF_UNIX) as made:
            made.bind(f"/proc/self/fd/{folder}/{path.name}")
        os.close(folder)
