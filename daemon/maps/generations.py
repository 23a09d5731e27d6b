"""Files of a folder of maps: generations by name, and whether what was written can be read back."""

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
    """One file.

    Attributes:
        number: counts all saves in the folder; 0: somebody has put it there. map_id: by its name; negative: not told.
    """

    number: int
    map_id: int
    path: Path


def verify(path: Path, content: bytes) -> None:
    """Whether a file on the disk is what was written, and loads.

    Raises:
        Damaged: it is not. OSError: it cannot be read.
    """
    with path.open("rb") as file:
        os.posix_fadvise(file.fileno(), 0, 0, os.POSIX_FADV_DONTNEED)  # from the disk, not from what we just gave it
        found = file.read()
    if found != content:
        raise Damaged("what was read back is not what was written: the disk is failing")
    read(found)


def said(error: OSError) -> str:
    """What is wrong, for people."""
    if isinstance(error, BlockingIOError):
        return "another process keeps its maps there"
    return error.strerror or str(error)


def newest_number(generations: list[Generation], map_id: int) -> int:
    """Number of the newest generation of a map."""
    return max(one.number for one in generations if one.map_id == map_id)
