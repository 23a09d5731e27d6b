"""Reading of files that may be anything: bounded in size, tried again after a failure, and without waiting for a FIFO.

A start reads its files with this, and an import those of others. A read that fails once, as on a worn memory card,
does not end it.
"""

from __future__ import annotations

import errno
import os
import stat
import time
from pathlib import Path
from typing import BinaryIO, Final

TRIES: Final = 3
PAUSE_S: Final = 0.05
"""Pause in s before another try."""
LASTING: Final = frozenset(
    (
        *(errno.ENOENT, errno.ENOTDIR, errno.ELOOP, errno.ENAMETOOLONG, errno.ENXIO, errno.ENODEV),
        *(errno.EINVAL, errno.EFBIG, errno.EISDIR),
    )
)
"""Errors that another try does not change."""
OPEN_ALREADY: Final = ("/dev/stdin", "/dev/fd/", "/proc/self/fd/")
"""Paths of what the caller has opened, as a shell does for ``<(command)``: a pipe is welcome there."""
_PIECE: Final = 1 << 20
_KINDS: Final = {stat.S_IFIFO: "a FIFO", stat.S_IFSOCK: "a socket"}


def read_regular(path: Path, most_bytes: int) -> bytes:
    """Content of a regular file of at most ``most_bytes``.

    Raises:
        OSError: it cannot be read, is not a regular file, or is larger.
    """
    for _ in range(TRIES - 1):
        try:
            return _read(path, most_bytes)
        except OSError as error:
            if error.errno in LASTING:
                raise
        time.sleep(PAUSE_S)
    return _read(path, most_bytes)


def read_start(path: Path, most_bytes: int) -> bytes:
    """First ``most_bytes`` of a regular file; raises `OSError` where it is not one, or cannot be read."""
    _must_be_regular(path, path.stat().st_mode)
    with open(path, "rb", opener=_without_waiting) as file:
        _must_be_regular(path, os.fstat(file.fileno()).st_mode)
        return file.read(most_bytes)


def read_named(path: Path, most_bytes: int) -> bytes:
    """As :func:`read_regular`, for a file that an operator names: it may also be a pipe that is open already."""
    if not str(path).startswith(OPEN_ALREADY):
        return read_regular(path, most_bytes)
    with path.open("rb") as file:
        content = _read_up_to(most_bytes + 1, file, 0)
    return _bounded(path, content, len(content), most_bytes)


def _read(path: Path, most_bytes: int) -> bytes:
    _must_be_regular(path, path.stat().st_mode)  # before it is opened, which may start a device
    handle = _without_waiting(path)
    try:
        about = os.fstat(handle)
        _must_be_regular(path, about.st_mode)
        with os.fdopen(handle, "rb", closefd=False) as file:
            content = b"" if about.st_size > most_bytes else _read_up_to(most_bytes + 1, file, about.st_size)
    finally:
        os.close(handle)
    return _bounded(path, content, max(about.st_size, len(content)), most_bytes)


def _without_waiting(path: str | Path, flags: int = os.O_RDONLY) -> int:
    return os.open(path, flags | os.O_NONBLOCK | os.O_NOCTTY | os.O_CLOEXEC)


def _read_up_to(most: int, file: BinaryIO, size: int) -> bytes:
    """Read to the end, but no more than ``most`` bytes; ``size``: as stated, which a file of /proc or a pipe does not.

    The buffer has the size of the file: one of ``most`` bytes could exceed a memory limit.
    """
    parts, piece = [], size + 1
    while most > 0 and (part := file.read(min(most, piece))):
        parts.append(part)
        most, piece = most - len(part), _PIECE
    return b"".join(parts)


def _must_be_regular(path: Path, mode: int) -> None:
    if stat.S_ISDIR(mode):
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
    if not stat.S_ISREG(mode):
        raise OSError(errno.EINVAL, f"it is {_KINDS.get(stat.S_IFMT(mode), 'a device')}, not a regular file", str(path))


def _bounded(path: Path, content: bytes, size: int, most_bytes: int) -> bytes:
    if size > most_bytes:
        raise OSError(errno.EFBIG, f"it is larger than {most_bytes} bytes", str(path))
    return content
