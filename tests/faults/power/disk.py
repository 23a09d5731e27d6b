"""A disk whose writes are recorded, and what a power cut at any of them leaves."""

from __future__ import annotations

import random
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

from tests.faults.power.logged_disk import Entry, entries

SECTOR: Final = 512
OPTIONS: Final = "commit=1"
"""Of the mount while it is recorded: the journal is written once a second, so that short work has many states."""


@dataclass(frozen=True)
class Moment:
    """What holds from a place in the log on: phase, number of the latest map that was saved."""

    at: int
    phase: str
    saved: int


@dataclass
class Recording:
    """Writes by their place in the log, the moments, and the file listings of the versions that were in use."""

    log: list[tuple[int, Entry]] = field(default_factory=list)
    moments: list[Moment] = field(default_factory=list)
    versions: list[dict[str, bytes]] = field(default_factory=list)


def tool(*words: object) -> str:
    """Run a program of the system."""
    return subprocess.run([str(word) for word in words], check=True, capture_output=True, text=True).stdout.strip()


@contextmanager
def mounted(disk: Path, folder: Path, options: str) -> Iterator[Path]:
    """An image as a file system, by a loop device."""
    device = tool("losetup", "--find", "--show", disk)
    try:
        folder.mkdir(exist_ok=True)
        tool("mount", "-t", "ext4", "-o", options, device, folder)
        try:
            yield folder
        finally:
            tool("umount", folder)
    finally:
        tool("losetup", "--detach", device)


@contextmanager
def logged(image: Path, folder: Path, log: Path) -> Iterator[Path]:
    """An image as a file whose writes are logged."""
    folder.mkdir()
    words = [sys.executable, "-m", "tests.faults.power.logged_disk", str(folder), str(image), str(log)]
    with subprocess.Popen(words) as server:
        try:
            end = time.monotonic() + 20.0
            while not (folder / "disk").exists():
                assert server.poll() is None
                assert time.monotonic() < end
                time.sleep(0.05)
            yield folder / "disk"
        finally:
            tool("umount", folder)
            server.wait(20.0)


@contextmanager
def recorded(
    work: Path, size: int, furnish: Callable[[Path], None], made: Recording
) -> Iterator[tuple[Path, Callable[[], int]]]:
    """A file system of so many bytes whose writes are recorded after it was furnished.

    Yields its folder, and a function for the place in the log up to now. ``work``/base is the image before the writes.
    """
    image, log = work / "image", work / "log"
    with image.open("wb") as file:
        file.truncate(size)
    tool("mkfs.ext4", "-q", "-F", image)
    with mounted(image, work / "mount", "defaults") as folder:
        furnish(folder)
    shutil.copy(image, work / "base")
    with logged(image, work / "fuse", log) as disk, mounted(disk, work / "mount", OPTIONS) as folder:
        yield folder, lambda: log.stat().st_size
    made.log = list(entries(log.read_bytes()))


def place(made: Recording, begin: Moment, end: Moment, draw: random.Random) -> int:
    """Number of entries up to a cut between two moments."""
    return draw.choice([at for at, (size, _) in enumerate(made.log, 1) if begin.at < size <= end.at])


def cut(made: Recording, base: Path, image: Path, last: int, draw: random.Random, way: int) -> None:
    """Make the image that a power cut after ``last`` entries leaves; ``way`` 0: all of them, 1: some, 2: torn."""
    shutil.copy(base, image)
    done = [entry for _, entry in made.log[:last]]
    flushed = max((number for number, entry in enumerate(done) if entry.data is None), default=0)
    kept = [one for number, one in enumerate(done) if number < flushed or way == 0 or draw.random() < 0.5]
    with image.open("r+b") as file:
        for number, one in enumerate(kept):
            data = one.data or b""
            if way == 2 and number == len(kept) - 1 and number >= flushed:
                data = data[: SECTOR * draw.randint(0, len(data) // SECTOR)]
            file.seek(one.offset)
            file.write(data)
