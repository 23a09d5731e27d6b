"""File descriptors of this process: whether there are any left."""

from __future__ import annotations

import errno
import os
import resource
from typing import Final

RESERVE: Final = 8
"""Number of free descriptors from which on they count as used up: a map, a recording and a client need one each."""


def used_up() -> bool:
    """Return True if fewer than :data:`RESERVE` descriptors are left to the process, or none to the computer."""
    try:
        lowest = os.open("/dev/null", os.O_RDONLY | os.O_CLOEXEC)  # the kernel gives the lowest free number
    except OSError as error:
        return error.errno in (errno.EMFILE, errno.ENFILE)
    os.close(lowest)
    limit = resource.getrlimit(resource.RLIMIT_NOFILE)[0]
    return limit != resource.RLIM_INFINITY and lowest > limit - RESERVE
