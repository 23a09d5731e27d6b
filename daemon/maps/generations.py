"""Map file generations of a folder: names and numbers, verification of a written file, and which ones are superfluous.

Only a file that has been read and found good counts as a generation, and only such a file is ever superfluous. A file
that cannot be read (I/O error, permissions, a newer version's format) may be the best map there is.
"""

from __future__ import annotations

import contextlib
import logging
import os
import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from daemon.maps.container import MOST_BYTES, BadMap, Damaged, Newer
from daemon.maps.schema import OtherBuilding, read
from daemon.system.regular_file import read_regular

log = logging.getLogger(__name__)

NAME: Final = re.compile(r"map-([0-9a-f]{8})-([0-9]{8,18})\.lumimap")
BROKEN: Final = ".broken"
BROKEN_NAME: Final = re.compile(NAME.pattern + re.escape(BROKEN))
NEWEST: Final = 2
"""Number of good generations of the map in use that are kept."""
OTHERS: Final = 7
"""Number of other maps of which the newest good generation is kept."""
Problem = BadMap | OSError | MemoryError
"""Reason why a map file cannot be used."""
OLDER: Final = "newer files of this map are kept"
CROWDED: Final = f"{OTHERS} maps of other areas are newer"


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


class Examination:
    """Which map files are good, each read once: maps are large; a file that has changed is read again.

    A file that could not be read once counts as unreadable for the whole run, which goes on from an older one.
    """

    def __init__(self) -> None:
        self._good: dict[Path, tuple[tuple[int, int, int], bool]] = {}
        self._unread: set[Path] = set()

    def found(self, path: Path, problem: Problem | None) -> None:
        """Note the result of reading a file; None: it is good."""
        if isinstance(problem, OtherBuilding):  # good, for another survey
            problem = None
        if problem is not None and is_unread(problem):
            self._unread.add(path)
            return
        with contextlib.suppress(OSError):
            self._good[path] = _stamp(path), problem is None

    def is_good(self, path: Path) -> bool:
        """Whether a file is good; the first failure is logged."""
        if path in self._unread:
            return False
        with contextlib.suppress(OSError):
            stamp, good = self._good.get(path, ((), False))
            if stamp == _stamp(path):
                return good
        problem = problem_of(path)
        self.found(path, problem)
        if problem is not None:
            log.warning(
                "%s cannot be used: %s; the daemon keeps it and the previous generation", path, words_of(problem)
            )
        return problem is None


def _stamp(path: Path) -> tuple[int, int, int]:
    about = path.stat()
    return about.st_ino, about.st_size, about.st_mtime_ns


def problem_of(path: Path) -> Problem | None:
    """Reason why a map file cannot be used; None for a good one."""
    try:
        read(read_regular(path, MOST_BYTES))
    except (BadMap, OSError, MemoryError) as error:
        return error
    return None


def superfluous(
    generations: Iterable[Generation], map_id: int, origin: Path | None, examined: Examination
) -> Iterator[tuple[Generation, str]]:
    """Good generations that newer good ones replace, each with the reason.

    Args:
        generations: of the folder, newest first.
        map_id: of the map in use.
        origin: file with which this run started.
        examined: of the files.
    """
    files: dict[int, list[Generation]] = {map_id: []}
    for generation in generations:
        if generation.number > 0:
            files.setdefault(generation.map_id, []).append(generation)

    def good(of_map: list[Generation]) -> list[Generation]:
        return [one for one in of_map if examined.is_good(one.path)]

    mine = files.pop(map_id)
    if len(mine) > NEWEST:
        yield from ((one, OLDER) for one in good(mine)[NEWEST:] if one.path != origin)
    for of_map in files.values():
        if len(of_map) > 1:
            yield from ((one, OLDER) for one in good(of_map)[1:])
    if len(files) > OTHERS:
        newest = [found[0] for of_map in files.values() if (found := good(of_map))]
        yield from ((one, CROWDED) for one in newest[OTHERS:])


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
        raise Damaged("the content read back differs from the content written; check the disk")
    read(found)


def words_of(error: Problem) -> str:
    """Readable reason why a file cannot be used."""
    if isinstance(error, MemoryError):
        return "not enough memory"
    return said(error) if isinstance(error, OSError) else str(error)


def is_unread(error: Problem) -> bool:
    """Whether a file's content is unknown: it may be good, for another version or at another time."""
    return not isinstance(error, BadMap) or isinstance(error, Newer)


def said(error: OSError) -> str:
    """Readable reason of an `OSError`."""
    if isinstance(error, BlockingIOError):
        return "another process stores its maps there"
    return error.strerror or str(error)


def newest_number(generations: list[Generation], map_id: int) -> int:
    """Number of the newest generation of a map."""
    return max(one.number for one in generations if one.map_id == map_id)
