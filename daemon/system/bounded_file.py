"""Bounded reading of files that others have made: regular files only, and no more than a stated size."""

from __future__ import annotations

import os
import stat
from pathlib import Path
from typing import Final

_KINDS: Final = {
    stat.S_IFDIR: "a folder",
    stat.S_IFCHR: "a device",
    stat.S_IFBLK: "a device",
    stat.S_IFIFO: "a pipe",
    stat.S_IFSOCK: "a socket",
}
_PIECE: Final = 1 << 20


class FileRefused(Exception):
    """A path that is not a regular file of acceptable size; the text states what it is, to follow its name."""


def read_regular(path: Path, most: int) -> bytes:
    """Read a regular file of at most ``most`` bytes; it never waits for a device, a pipe or a socket.

    Raises:
        FileRefused: another kind of file, or a larger one.
        OSError: it cannot be opened or read.
    """
    _check(path.stat(), most)  # before the opening, which may start a device
    descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_NOCTTY | os.O_CLOEXEC)
    with os.fdopen(descriptor, "rb") as file:
        _check(os.fstat(descriptor), most)
        content = bytearray()
        while piece := file.read(min(_PIECE, most + 1 - len(content))):  # files of /proc state no size
            content += piece
    if len(content) > most:
        raise FileRefused(f"has more than {most} bytes")
    return bytes(content)


def _check(found: os.stat_result, most: int) -> None:
    kind = stat.S_IFMT(found.st_mode)
    if kind != stat.S_IFREG:
        raise FileRefused(f"is {_KINDS.get(kind, 'something else')}, not a file")
    if found.st_size > most:
        raise FileRefused(f"has {found.st_size} bytes; the limit is {most}")
