"""Reading of files that may be anything: bounded in size, and a FIFO or a device is refused instead of awaited."""

from __future__ import annotations

import errno
import os
import stat
from pathlib import Path


def read_regular(path: Path, most_bytes: int) -> bytes:
    """Content of a regular file of at most ``most_bytes``.

    Raises:
        OSError: it cannot be read, is no regular file, or is larger.
    """
    with os.fdopen(os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_NOCTTY | os.O_CLOEXEC), "rb") as file:
        about = os.fstat(file.fileno())
        if not stat.S_ISREG(about.st_mode):
            raise OSError(errno.EINVAL, f"it is {kind_of(about.st_mode)}, and no regular file", str(path))
        content = b"" if about.st_size > most_bytes else file.read(most_bytes + 1)
        if max(about.st_size, len(content)) > most_bytes:
            raise OSError(errno.EFBIG, f"it is larger than {most_bytes} bytes", str(path))
    return content


def kind_of(mode: int) -> str:
    """Readable kind of a file, by its mode."""
    kinds = {stat.S_IFDIR: "a folder", stat.S_IFIFO: "a FIFO", stat.S_IFSOCK: "a socket"}
    return kinds.get(stat.S_IFMT(mode), "a device")
