"""Exclusive use of a folder by one process: a lock on the folder itself, not on a file in it.

Whoever deletes all files of the folder leaves the lock. A folder that has been deleted and created again is another
one, and its lock has to be taken anew.
"""

from __future__ import annotations

import errno
import fcntl
import os
from pathlib import Path
from typing import Final

NOT_ON_FOLDERS: Final = (errno.EBADF, errno.EINVAL, errno.EOPNOTSUPP)
"""Errors of flock(2) on file systems that lock only files opened for writing, as NFS does."""
FILE: Final = "lock"
"""Name of the file that is locked there instead."""


class FolderLock:
    """Lock of one folder; not held before :meth:`take`."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._handles: list[int] = []

    @property
    def held(self) -> bool:
        """Whether a folder is locked, be it a deleted one."""
        return bool(self._handles)

    def take(self) -> bool:
        """Lock the folder that is there now; return whether it was not locked before.

        A lock on a deleted folder is released only after the new one is held.

        Raises:
            BlockingIOError: another process holds it. OSError: the folder cannot be opened.
        """
        if self._handles and self._is_current():
            return False
        handles = locked(self._folder, fcntl.LOCK_EX)
        self.close()
        self._handles = handles
        return True

    def _is_current(self) -> bool:
        return os.path.samestat(os.fstat(self._handles[0]), self._folder.stat())

    def close(self) -> None:
        """Release the lock; idempotent."""
        handles, self._handles = self._handles, []
        for handle in handles:
            os.close(handle)


def locked(folder: Path, kind: int) -> list[int]:
    """File descriptors that hold a lock of a folder: the folder, and where it cannot be locked, the file in it.

    Raises:
        BlockingIOError: another process holds it. OSError: the folder cannot be opened.
    """
    handles = [os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)]
    try:
        try:
            fcntl.flock(handles[0], kind | fcntl.LOCK_NB)
        except OSError as error:
            if error.errno not in NOT_ON_FOLDERS:
                raise
            flags = os.O_RDWR | os.O_CREAT if kind == fcntl.LOCK_EX else os.O_RDONLY
            handles.append(os.open(folder / FILE, flags | os.O_NONBLOCK | os.O_CLOEXEC, 0o644))
            fcntl.flock(handles[1], kind | fcntl.LOCK_NB)
    except OSError:
        for handle in handles:
            os.close(handle)
        raise
    return handles
