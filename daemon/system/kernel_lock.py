"""The lock of the folder of compiled kernels: a process that compiles holds it; one that only loads needs none.

numba writes each file of its cache beside and renames it: who reads meets a whole one or none, and compiles the kernel
of which there is none. So nothing has to be waited for where all are there, whatever others do. Two who compile at once
would do the same work twice, and could spoil the cache's index.
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
"""Whether this process waits for one that compiles."""


class KernelLock:
    """Taken when it is needed, held until the block ends.

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
        """Have it from now on; says so where another process has it, and waits.

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
    """``call`` before anything is compiled meanwhile, in the thread that compiles."""
    from numba.core import event

    class Before(event.Listener):
        def on_start(self, _: object) -> None:
            call()

        def on_end(self, _: object) -> None:
            pass

    with event.install_listener("numba:compile", Before()):
        yield
