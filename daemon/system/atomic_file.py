"""Atomic file writing: a file appears whole or not at all, and survives a power cut once written."""

from __future__ import annotations

import contextlib
import os
from pathlib import Path


def write_whole(path: Path, content: bytes) -> None:
    """Write a file atomically: temporary file, sync, rename. On `OSError` the previous content stays."""
    beside = path.with_name(f".{path.name}.part")
    try:
        with beside.open("wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        beside.replace(path)
        sync_folder(path.parent)
    except OSError:
        with contextlib.suppress(OSError):
            beside.unlink(missing_ok=True)
        raise


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
