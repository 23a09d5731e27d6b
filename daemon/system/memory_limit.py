"""Errors that a lack of memory causes: under a limit a library "cannot be found" that is there, and maps not enough."""

from __future__ import annotations

import errno
import mmap
import os
from typing import Final

NEEDED: Final = 256 << 20
"""Address space in bytes that the largest library and what it allocates at once take."""
SIGNS: Final = (os.strerror(errno.ENOMEM), "failed to map segment", "Memory allocation")
"""Parts of messages of the dynamic linker and of libraries."""
REMEDY: Final = "raise `MemoryMax=` of the service, or the limit of `ulimit -v`"


def lacks_memory(error: BaseException) -> bool:
    """True if an error, or one of those that led to it, comes from too little memory.

    A library that cannot be loaded counts as such where no more of its size could be mapped.
    """
    cause: BaseException | None = error
    while cause is not None:
        if isinstance(cause, MemoryError) or any(sign in str(cause) for sign in SIGNS):
            return True
        if isinstance(cause, OSError | ImportError) and "shared object" in str(cause) and not _can_map():
            return True
        cause = cause.__cause__ or cause.__context__
    return False


def _can_map() -> bool:
    try:
        mmap.mmap(-1, NEEDED, flags=mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS).close()
    except (OSError, MemoryError):
        return False
    return True
