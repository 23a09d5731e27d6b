"""Reads the lines of a text log, gzipped or not; a truncated file yields its readable lines and the reason."""

from __future__ import annotations

import errno
import gzip
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from hal.errors import DataInvalid, DeviceMissing, DeviceRefused, HalError

GZIP_MAGIC: Final = b"\x1f\x8b"
_CHUNK: Final = 1 << 20
_LONGEST_LINE: Final = 1 << 22


@dataclass(slots=True)
class Torn:
    """Truncation of a compressed file: ``reason``; empty where the file is complete."""

    reason: str = ""


def unreadable(path: Path, error: OSError) -> HalError:
    """The device error for an unreadable file, with a remedy."""
    if error.errno == errno.ENOENT:
        return DeviceMissing(str(path), "no such file", "check the path")
    if error.errno == errno.EISDIR:
        return DeviceRefused(str(path), "is a folder", "name the log file inside it")
    if error.errno in (errno.EACCES, errno.EPERM):
        return DeviceRefused(str(path), "cannot be read by this user", f"run this with sudo, or run: chmod a+rX {path}")
    return DeviceRefused(str(path), f"cannot be read: {error.strerror or error}", "check the disk and the path")


def head(path: Path, size: int = 4096) -> bytes:
    """The first bytes of a file's content (inflated where it is gzip), to distinguish kinds of logs.

    Raises:
        DeviceMissing, DeviceRefused: see `unreadable`.
    """
    data = b""
    for chunk in _chunks(path, Torn(), min(size, _CHUNK)):
        data += chunk
        if len(data) >= size:
            break
    return data[:size]


def lines(path: Path, torn: Torn) -> Iterator[tuple[int, bytes]]:
    """Yield ``(line number from 1, line without its end)``; a last line without its end is yielded like any other.

    Args:
        path: the log.
        torn: its ``reason`` is set when the compressed stream breaks off.

    Raises:
        DeviceMissing, DeviceRefused: see `unreadable`.
        DataInvalid: a line longer than 4 MB: not a text log.
    """
    number = 0
    rest = b""
    for chunk in _chunks(path, torn, _CHUNK):
        parts = (rest + chunk).split(b"\n")
        rest = parts.pop()
        for part in parts:
            number += 1
            yield number, part
        if len(rest) > _LONGEST_LINE:
            raise DataInvalid(f"{path}:{number + 1}", "line of more than 4 MB", "this is not a text log")
    if rest:
        yield number + 1, rest


def _chunks(path: Path, torn: Torn, size: int) -> Iterator[bytes]:
    try:
        with path.open("rb") as raw:
            magic = raw.read(2)
            raw.seek(0)
            with gzip.GzipFile(fileobj=raw) as inflated:
                read = (
                    inflated.read1 if magic == GZIP_MAGIC else raw.read
                )  # read1: returns all data before the truncation
                while chunk := read(size):
                    yield chunk
    except (EOFError, zlib.error, gzip.BadGzipFile) as error:
        torn.reason = f"the compressed file is incomplete ({error})"
    except OSError as error:
        raise unreadable(path, error) from error
