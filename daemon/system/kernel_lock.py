"""File lock for the cache of compiled kernels: a compiling process holds it; a process that only loads needs none.

numba writes each cache file under a temporary name and renames it. A reader therefore finds a complete file or none,
and compiles a kernel that is missing. A process that finds all kernels never waits.
Two processes that compile at once would do the same work twice and could damage the cache's index.
"""

from __future__ import annotations

import contextlib
import fcntl
import logging
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import IO, Final, Self

log = logging.getLogger(__name__)

waits: Final = threading.Event()
"""Set while this process waits for another one that compiles."""


class KernelLock:
    """Exclusive lock that :meth:`acquire` takes on demand and the end of the ``with`` block releases.

    Args:
        folder: of compiled kernels.
    """

    def __init__(self, folder: Path) -> None:
        self._path = folder / "lock"
        self._file: IO[str] | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        if self._file is not None:
            self._file.close()
            self._file = None

    def acquire(self) -> None:
        """Take the lock; if another process holds it, log that and wait.

        Raises:
            OSError: the folder cannot be written to.
        """
        if self._file is not None:
            return
        self._file = self._path.open("w")
        try:
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            log.info("waiting for another process, which compiles kernels (it holds %s)", self._path)
            waits.set()
            try:
                fcntl.flock(self._file, fcntl.LOCK_EX)
            finally:
                waits.clear()


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
