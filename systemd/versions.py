"""Versions of an installation beside each other, one of which is in use; a single rename puts another in its place.

PREFIX is a symbolic link into PREFIX-versions, where each environment has a folder of its own. The link is replaced
after everything in that folder has reached the disk. Needs the standard library alone.
"""

from __future__ import annotations

import ctypes
import fcntl
import os
import shutil
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Final

MARK: Final = ".lumiloop"
"""File in each folder of an installation; in an environment it lists the distributions that came with it."""
FULL_BYTES: Final = 32 << 20
"""Free bytes below which a disk is named as the cause of a failure."""
EXCHANGE: Final = 2
"""Flag of renameat2(2)."""
AT_CWD: Final = -100


class CannotInstall(Exception):
    """The environment cannot be made; the text gives the cause."""


@dataclass(frozen=True)
class Place:
    """Where an installation lies; ``prefix`` as its programs see it, ``root`` the same below DESTDIR."""

    prefix: Path
    root: Path

    @property
    def versions(self) -> Path:
        """Folder of all environments."""
        return self.root.with_name(f"{self.root.name}-versions")

    @property
    def current(self) -> Path | None:
        """The environment in use; None: there is none."""
        return self.root.resolve() if (self.root / "pyvenv.cfg").exists() else None

    def seen(self, environment: Path) -> Path:
        """Path of an environment as its programs see it."""
        return self.prefix.with_name(f"{self.prefix.name}-versions") / environment.name

    def check(self) -> None:
        """Raise `CannotInstall` where one of the paths holds anything else than an installation."""
        linked = self.root.is_symlink() and self.root.readlink().parts[:1] == (self.versions.name,)
        for path in (self.root, self.versions):
            other = path.is_symlink() or path.exists()
            if other and not (path == self.root and linked) and not (path / MARK).exists() and not is_empty(path):
                raise CannotInstall(
                    f"{path} is not an installation of lumiloop; PREFIX must name a directory of its own, "
                    "as /opt/lumiloop"
                )


def place() -> Place:
    """The place that the variables name."""
    prefix = Path(os.environ.get("PREFIX") or "/opt/lumiloop")
    return Place(prefix, Path(os.environ.get("DESTDIR", "") + str(prefix)))


def is_empty(path: Path) -> bool:
    """Whether it is a folder without entries."""
    return path.is_dir() and not path.is_symlink() and not any(path.iterdir())


@contextmanager
def locked(where: Place) -> Iterator[None]:
    """Context in which no other installation changes this place."""
    where.check()
    where.versions.mkdir(parents=True, exist_ok=True)
    (where.versions / MARK).touch()
    with (where.versions / ".lock").open("w") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise CannotInstall(f"another installation into {where.root} is running") from None
        yield


def replace(where: Place, make: Callable[[Path, Path | None], None], version: str) -> None:
    """Make a new environment by ``make(new, old)`` and put it in the place of the old one."""
    with locked(where):
        prune(where)
        old = where.current
        begun = f"{version}-{time.strftime('%Y%m%dT%H%M%S')}"
        new = next(path for n in range(100) if not (path := where.versions / (begun + f"-{n}" * (n > 0))).exists())
        try:
            new.mkdir()
            make(new, old)
            sync(new)
        except BaseException as error:
            full = [path for path in (where.versions, tempfile.gettempdir()) if is_full(path)]
            shutil.rmtree(new, ignore_errors=True)
            if full and isinstance(error, CannotInstall | OSError):
                raise CannotInstall(f"{error}; the disk of {full[0]} is full") from error
            raise
        swap(where, new)
        prune(where)


def is_full(folder: Path | str) -> bool:
    """Whether the disk of a folder has no room."""
    return shutil.disk_usage(folder).free < FULL_BYTES


def sync(folder: Path) -> None:
    """Write everything on the file system of a folder to the disk (syncfs(2))."""
    handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        library = ctypes.CDLL(None, use_errno=True)
        if library.syncfs(handle):
            raise OSError(ctypes.get_errno(), os.strerror(ctypes.get_errno()), str(folder))
    finally:
        os.close(handle)


def swap(where: Place, new: Path) -> None:
    """Let PREFIX lead to ``new``, which is on the disk, by one rename."""
    link = where.root.with_name(f"{where.root.name}.next")
    with suppress(FileNotFoundError):
        link.unlink()
    link.symlink_to(Path(where.versions.name, new.name))
    if where.root.is_dir() and not where.root.is_symlink():  # an environment in PREFIX itself, or an empty folder
        exchange(link, where.root)
        link.rename(where.versions / f"before-{new.name}")
    else:
        link.replace(where.root)
    sync(where.root.parent)


def exchange(first: Path, second: Path) -> None:
    """Exchange two names in one step (renameat2(2))."""
    library = ctypes.CDLL(None, use_errno=True)
    if library.renameat2(AT_CWD, os.fsencode(first), AT_CWD, os.fsencode(second), EXCHANGE):
        raise OSError(ctypes.get_errno(), os.strerror(ctypes.get_errno()), str(second))


def prune(where: Place) -> None:
    """Remove environments that are neither current nor used by a running program, and what a killed one has left."""
    others = {path.resolve() for path in where.versions.iterdir() if path.is_dir() and path.name[0] != "."}
    others -= {where.current} if where.current else set()
    for path in others - used(others):
        shutil.rmtree(path, ignore_errors=True)


def used(environments: set[Path]) -> set[Path]:
    """Environments from which a running program has loaded libraries."""
    found = set[Path]()
    for maps in Path("/proc").glob("[0-9]*/maps") if environments else ():
        with suppress(OSError):  # it has ended, or is another user's
            text = maps.read_bytes()
            found |= {path for path in environments if os.fsencode(path) + b"/" in text}
    return found


def lay(stage: Path, onto: Path) -> None:
    """Give files their places; an interruption leaves each as it was or as it is now."""
    files = [path for path in stage.rglob("*") if path.is_symlink() or path.is_file()]
    places = [onto / path.relative_to(stage) for path in files]
    beside = [path.with_name(f"{path.name}.lumiloop-new") for path in places]
    for file, new in zip(files, beside, strict=True):
        new.parent.mkdir(parents=True, exist_ok=True)
        new.unlink(missing_ok=True)
        shutil.copy2(file, new, follow_symlinks=False)
    disks = {path.stat().st_dev: path for path in {path.parent for path in places}}.values()
    for folder in disks:
        sync(folder)
    for new, path in zip(beside, places, strict=True):
        new.replace(path)
    for folder in disks:
        sync(folder)


def remove(where: Place) -> None:
    """Remove all environments, and the link to them."""
    where.check()
    if where.root.is_symlink():
        where.root.unlink()
    for path in (where.root, where.versions):
        shutil.rmtree(path, ignore_errors=False) if path.exists() else None
    where.root.with_name(f"{where.root.name}.next").unlink(missing_ok=True)
