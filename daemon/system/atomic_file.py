"""Files that appear whole or not at all, and survive a power cut once they are there."""

from __future__ import annotations

import contextlib
import os
from pathlib import Path


def write_whole(path: Path, content: bytes) -> None:
    """Write beside the place, sync, move there; raises `OSError`, and then what was there before stays."""
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
    """Why something could not be written, for people: the system's words where it has some."""
    return (error.strerror if isinstance(error, OSError) else None) or repr(error)


def defect_in(error: Exception) -> Exception | None:
    """What a log tells in full: whatever is more than the system's refusal."""
    return None if isinstance(error, OSError) else error


def sync_folder(folder: Path) -> None:
    """Make a new file's name survive a power cut, too."""
    handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
