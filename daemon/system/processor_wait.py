"""Time for which a thread was ready to run while other threads had the processor, from the kernel's scheduler."""

from __future__ import annotations

import os
import threading


class ProcessorWait:
    """Reads the wait of the thread that makes it. The file is opened at the first reading and stays open."""

    def __init__(self) -> None:
        self._path = f"/proc/self/task/{threading.get_native_id()}/schedstat"
        self._file = -1

    def seconds(self) -> float | None:
        """Wait since the start of the thread, s; None where the kernel does not report it."""
        try:
            if self._file < 0:
                self._file = os.open(self._path, os.O_RDONLY | os.O_CLOEXEC)
            return int(os.pread(self._file, 100, 0).split()[1]) * 1e-9
        except (OSError, IndexError, ValueError):
            return None

    def close(self) -> None:
        """Close the file; idempotent."""
        if self._file >= 0:
            os.close(self._file)
        self._file = -1
