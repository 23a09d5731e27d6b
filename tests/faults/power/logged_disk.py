"""``python -m tests.faults.power.logged_disk FOLDER IMAGE LOG``: an image as FOLDER/disk, with a log of its writes.

A loop device on that file is a disk whose every write and flush is known, in order. The kernel's own dm-log-writes does
the same, where there is one. Speaks the protocol of fuse(4) itself: root is needed, and no library.
"""

from __future__ import annotations

import ctypes
import errno
import os
import stat
import struct
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO, Final

MOST: Final = 1 << 20
"""Bytes of the largest write."""
ROOT, DISK = 1, 2
"""Node numbers of the folder and of the file."""
LOOKUP, FORGET, GETATTR, SETATTR, OPEN, READ, WRITE, STATFS, RELEASE = 1, 2, 3, 4, 14, 15, 16, 17, 18
FSYNC, FLUSH, INIT, OPENDIR, RELEASEDIR, INTERRUPT, DESTROY, MANY_FORGET = 20, 25, 26, 27, 29, 36, 38, 42
SILENT: Final = (FORGET, MANY_FORGET, INTERRUPT)
"""Requests without an answer."""
BIG_WRITES: Final = 1 << 5
HEADER: Final = struct.Struct("<cQQ")
"""Of an entry in the log: kind, offset, number of bytes that follow."""


@dataclass(frozen=True)
class Entry:
    """One write in the log (``data`` at ``offset``), or a flush (None): all before it are on the disk."""

    offset: int
    data: bytes | None


def entries(log: bytes) -> Iterator[tuple[int, Entry]]:
    """Entries of a log, each with the number of bytes of the log up to its end."""
    at = 0
    while at < len(log):
        kind, offset, size = HEADER.unpack_from(log, at)
        at += HEADER.size + size
        yield at, Entry(offset, log[at - size : at] if kind == b"W" else None)


class Server:
    """Answers the kernel's requests about one folder with one file."""

    def __init__(self, image: BinaryIO, log: BinaryIO) -> None:
        self._image, self._log = image, log
        self._size = image.seek(0, os.SEEK_END)
        self._answers: dict[int, Callable[[int, bytes], bytes]] = {
            INIT: self._init, LOOKUP: self._lookup, GETATTR: self._attributes, SETATTR: self._attributes,
            OPEN: self._open, OPENDIR: self._open, READ: self._read, WRITE: self._write, FSYNC: self._fsync,
            **dict.fromkeys((FLUSH, RELEASE, RELEASEDIR, DESTROY), lambda node, body: b""),
            STATFS: lambda node, body: bytes(80),
        }  # fmt: skip

    def answer(self, request: bytes) -> bytes | None:
        """The answer to a request; None: it has none."""
        _, code, unique, node = struct.unpack_from("<IIQQ", request)
        if code in SILENT:
            return None
        number, body = 0, b""
        try:
            body = self._answers[code](node, request[40:])
        except KeyError:
            number = -errno.ENOSYS
        except OSError as error:
            number = -(error.errno or errno.EIO)
        return struct.pack("<IiQ", 16 + len(body), number, unique) + body

    def _note(self, kind: bytes, offset: int = 0, data: bytes = b"") -> None:
        self._log.write(HEADER.pack(kind, offset, len(data)) + data)

    def _init(self, _: int, body: bytes) -> bytes:
        ahead = struct.unpack_from("<III", body)[2]
        return struct.pack("<IIIIHHIIHHI28x", 7, 31, ahead, BIG_WRITES, 0, 0, MOST, 1, 0, 0, 0)

    def _attr(self, node: int) -> bytes:
        mode, size = (stat.S_IFDIR | 0o700, 0) if node == ROOT else (stat.S_IFREG | 0o600, self._size)
        return struct.pack("<6Q10I", node, size, size // 512, 0, 0, 0, 0, 0, 0, mode, 1, 0, 0, 0, 4096, 0)

    def _lookup(self, _: int, body: bytes) -> bytes:
        if body.rstrip(b"\0") != b"disk":
            raise FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT))
        return struct.pack("<QQQQII", DISK, 0, 3600, 3600, 0, 0) + self._attr(DISK)

    def _attributes(self, node: int, _: bytes) -> bytes:
        return struct.pack("<QII", 3600, 0, 0) + self._attr(node)

    def _open(self, _: int, __: bytes) -> bytes:
        return struct.pack("<QII", 0, 0, 0)

    def _read(self, _: int, body: bytes) -> bytes:
        _, offset, size = struct.unpack_from("<QQI", body)
        return os.pread(self._image.fileno(), size, offset)

    def _write(self, _: int, body: bytes) -> bytes:
        _, offset, size = struct.unpack_from("<QQI", body)
        data = body[40 : 40 + size]
        os.pwrite(self._image.fileno(), data, offset)
        self._note(b"W", offset, data)
        return struct.pack("<II", size, 0)

    def _fsync(self, _: int, __: bytes) -> bytes:
        self._note(b"F")
        return b""


def main(folder: str, image: str, log: str) -> None:
    """Mount and serve until the folder is unmounted."""
    device = os.open("/dev/fuse", os.O_RDWR)
    words = f"fd={device},rootmode=40000,user_id=0,group_id=0,max_read={MOST}".encode()
    library = ctypes.CDLL(None, use_errno=True)
    if library.mount(b"lumiloop", folder.encode(), b"fuse", 0, words):
        raise OSError(ctypes.get_errno(), os.strerror(ctypes.get_errno()), folder)
    with Path(image).open("r+b") as image_file, Path(log).open("wb", buffering=0) as log_file:
        server = Server(image_file, log_file)
        while True:
            try:
                request = os.read(device, MOST + 4096)
            except OSError as error:
                if error.errno == errno.ENODEV:  # it is unmounted
                    return
                raise
            if (answer := server.answer(request)) is not None:
                os.write(device, answer)


if __name__ == "__main__":
    main(*sys.argv[1:])
