"""Atomic file writing: a file appears whole or not at all, and survives a power cut once written."""

from __future__ import annotations

import contextlib
import os
from pathlib import Path
from typing import Final

_NEW: Final = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC
"""Flags of a file that must not exist yet, as a link neither."""


def write_whole(path: Path, content: bytes) -> None:
    """Write a file atomically: temporary file, sync, rename. On `OSError` the previous content stays.

    Root may write into a folder of another user, such as the service's. The file then belongs to that user, and a link
    in the place of the temporary file is not followed.
    """
    beside = path.with_name(f".{path.name}.part")
    try:
        with os.fdopen(_new_file(beside), "wb") as file:
            _give_to_owner(file.fileno(), path.parent)
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        beside.replace(path)
        sync_folder(path.parent)
    except OSError:
        with contextlib.suppress(OSError):
            beside.unlink(missing_ok=True)
        raise


def _new_file(path: Path) -> int:
    """Make a file, in place of what a killed process has left there; return its descriptor."""
    try:
        return os.open(path, _NEW, 0o666)
    except FileExistsError:
        path.unlink(missing_ok=True)
        return os.open(path, _NEW, 0o666)


def _give_to_owner(handle: int, folder: Path) -> None:
    """Give a file that root has made to the owner of its folder, who could not read it with a strict umask."""
    about = folder.stat()
    if os.geteuid() == 0 and about.st_uid:
        with contextlib.suppress(OSError):  # a file system without owners, or root without that right
            os.fchown(handle, about.st_uid, about.st_gid)


def reason_of(error: Exception) -> str:
    """Readable reason why something could not be written: the system's message where there is one."""
    return (error.strerror if isinstance(error, OSError) else None) or repr(error)


def defect_in(error: Exception) -> Exception | None:
    """The exception for a traceback in the log; None for an `OSError`, whose message suffices."""
    return None if isinstance(error, OSError) else error


def sync_folder(folder: Path) -> None:
    """Sync a folder, so that a new file name in it survives a power cut."""
    handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
