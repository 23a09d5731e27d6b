"""The loop's thread before all other programs, and its memory never paged out, where the service's unit allows it.

The right is the switch: a unit with ``LimitRTPRIO=`` and ``LimitMEMLOCK=infinity`` says that this computer is there for
the robot. A person who tries the program in a terminal, even as root, gets neither.
"""

from __future__ import annotations

import ctypes
import os
import resource
from typing import Final

PRIORITY: Final = 40
"""Of SCHED_FIFO: above ordinary threaded interrupts' users, below the interrupts themselves (50)."""
MCL_CURRENT, MCL_FUTURE, MCL_ONFAULT = 1, 2, 4
"""Flags of mlockall(2). On fault: only what is touched is kept; stacks and arenas are mostly never."""


def claim() -> tuple[str, ...]:
    """Take what the limits allow, for the calling thread and its process; what was taken, or why not, a phrase each.

    Threads made later do not inherit it (SCHED_RESET_ON_FORK): only the loop is in a hurry.
    """
    return _schedule(resource.getrlimit(resource.RLIMIT_RTPRIO)[0]), _lock(
        resource.getrlimit(resource.RLIMIT_MEMLOCK)[0]
    )


def _schedule(most: int) -> str:
    if most == 0:
        return "ordinary scheduling (the unit sets no LimitRTPRIO=)"
    priority = PRIORITY if most == resource.RLIM_INFINITY else min(PRIORITY, most)
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, os.sched_param(priority))
    except OSError as error:
        return f"ordinary scheduling ({error.strerror})"
    return f"SCHED_FIFO {priority}"


def _lock(most: int) -> str:
    if most != resource.RLIM_INFINITY:
        return "memory not locked (the unit sets no LimitMEMLOCK=infinity)"  # a bound would make later calls fail
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.mlockall(MCL_CURRENT | MCL_FUTURE | MCL_ONFAULT):
        return f"memory not locked ({os.strerror(ctypes.get_errno())})"
    return "memory locked"
