"""Map file generations of a folder: names and numbers, and verification of a written file."""

from __future__ import annotations

import os
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from daemon.maps.container import Damaged
from daemon.maps.schema import read

NAME: Final = re.compile(r"map-([0-9a-f]{8})-([0-9]{8})\.lumimap")
BROKEN: Final = ".broken"
BROKEN_NAME: Final = re.compile(r"map-([0-9a-f]{8})-([0-9]{8})\.lumimap\.broken")


@dataclass(frozen=True, slots=True)
class Generation:
    """One map file of a folder.

    Attributes:
        number: counts all saves in the folder; 0: an operator placed the file there. map_id: from its name; negative:
            not contained in it.
    """

    number: int
    map_id: int
    path: Path


def verify(path: Path, content: bytes) -> None:
    """Check that a file on the disk equals what was written, and loads.

    Raises:
        Damaged: it does not. OSError: it cannot be read.
    """
    with path.open("rb") as file:
        os.posix_fadvise(
            file.fileno(), 0, 0, os.POSIX_FADV_DONTNEED
        )  # read from the disk, not from the cache of what was just written
        found = file.read()
    if found != content:
        raise Damaged("what was read back is not what was written: the disk is failing")
    read(found)


def said(error: OSError) -> str:
    """Readable reason of an `OSError`."""
    if isinstance(error, BlockingIOError):
        return "another process keeps its maps there"
    return error.strerror or str(error)


def newest_number(generations: list[Generation], map_id: int) -> int:
    """Number of the newest generation of a map."""
    return max(one.number for one in generations if one.map_id == map_id)
