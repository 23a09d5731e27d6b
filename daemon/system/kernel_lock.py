"""File lock for the cache of compiled kernels: a compiling process holds it; a process that only loads needs none.

Each cache file is written under a temporary name and renamed. A reader therefore finds a complete file or none,
and compiles a kernel that is missing. A process that finds all kernels never waits.
Two processes that compile at once would do the same work twice, which is the lesser evil where no lock can be taken.
"""

from __future__ import annotations

import contextlib
import fcntl
import logging
import os
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Final, Self

log = logging.getLogger(__name__)

MOST_S: Final = 600.0
"""Longest wait in s for another process, which may be stopped or stand at a disk."""
LOOK_S: Final = 0.2
"""Interval in s between two attempts to take the lock."""

waits: Final = threading.Event()
"""Set while this process waits for another one that compiles."""


class KernelLock:
    """Exclusive lock that :meth:`acquire` takes on demand and the end of the ``with`` block releases.

    Args:
        folder: of compiled kernels.
    """

    def __init__(self, folder: Path) -> None:
        self._path = folder / "lock"
        self._file = -1
        self._tried = False

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._tried = False
        if self._file >= 0:
            os.close(self._file)
            self._file = -1

    def acquire(self) -> None:
        """Take the lock; if another process holds it, log that and wait. Without a lock file, log the reason."""
        if self._tried:
            return
        self._tried = True
        try:
            self._file = os.open(self._path, os.O_RDWR | os.O_CREAT | os.O_NONBLOCK | os.O_CLOEXEC, 0o644)
            self._wait()
        except OSError as error:
            log.warning("%s: %s; kernels are compiled without this lock", self._path, error.strerror)

    def _wait(self) -> None:
        try:
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            log.info("waiting for another process that compiles kernels (it holds %s)", self._path)
            waits.set()
            try:
                self._take_later()
            finally:
                waits.clear()

    def _take_later(self) -> None:
        end = time.monotonic() + MOST_S
        while time.monotonic() < end:
            time.sleep(LOOK_S)
            with contextlib.suppress(BlockingIOError):
                fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                return
        log.warning("%s is still held after %.0f s; kernels are compiled without it", self._path, MOST_S)


@contextlib.contextmanager
def before_compiling(call: Callable[[], None]) -> Iterator[None]:
    """Context in which ``call`` runs before each compilation, in the compiling thread."""
    from numba.core import event

    class Before(event.Listener):
        def on_start(self, _: object) -> None:
            call()

        def on_end(self, _: object) -> None:
            pass

    with event.install_listener("numba:compile", Before()):
        yield
