"""The loop's thread before all other programs, and its memory never paged out, where the service's unit allows it.

The right is the switch: a unit with ``LimitRTPRIO=`` and ``LimitMEMLOCK=infinity`` says that this computer is there for
the robot. A person who tries the program in a terminal, even as root, gets neither.

The other threads come right behind the loop, ahead of ordinary programs. They must: while one of them holds the
interpreter and another program has its processor, the loop waits for that program, whatever its own priority is. With
both cores busy cycles began up to 130 ms late for this; they are at work for a few hundredths of the time only.
"""

from __future__ import annotations

import ctypes
import os
import resource
import threading
from pathlib import Path
from typing import Final

PRIORITY: Final = 40
"""Of SCHED_FIFO: above ordinary threaded interrupts' users, below the interrupts themselves (50)."""
BEHIND: Final = 1
"""Of SCHED_RR: that of the other threads, the lowest there is above all ordinary programs."""
MCL_CURRENT, MCL_FUTURE, MCL_ONFAULT = 1, 2, 4
"""Flags of mlockall(2). On fault: only what is touched is kept; stacks and arenas are mostly never."""


M_TRIM_THRESHOLD, M_MMAP_THRESHOLD, M_ARENA_MAX = -1, -3, -8
"""Parameters of mallopt(3)."""

LARGE, SLACK = 1 << 20, 1 << 20
"""Blocks of so many bytes are mapped each by itself; so much may be free at the end of the heap."""
RESERVE, OBJECTS = 16 << 20, 3 << 20
"""Bytes of the heap, and of the interpreter's own, that are there before the first cycle: what a map fills up."""
ARENA, SMALL = 1 << 20, 400
"""The interpreter takes and gives back its memory by so many bytes; an object that lies in it."""
_stakes: list[bytes] = []
"""An object in each part of the interpreter's reserve: what is empty is given back."""


def give_back() -> None:
    """Have memory that a job has needed returned to the system when it is freed, where the C library is glibc.

    By itself, glibc takes the first large block that is freed for a sign that more of that size will come, and carves
    those out of the heap from then on, where one small block behind them keeps them: a robot that was lost for a second
    kept 30 MB for good. And it gives each thread a heap of its own, so that what one of them frees, others cannot use:
    what loading the kernels leaves free would hold a map for hours.
    """
    libc = ctypes.CDLL(None)
    if hasattr(libc, "mallopt"):
        libc.mallopt(M_ARENA_MAX, 1)
        libc.mallopt(M_MMAP_THRESHOLD, LARGE)
        libc.mallopt(M_TRIM_THRESHOLD, SLACK)


def reserve() -> None:
    """Have the next memory that is needed at hand, where the C library is glibc: a map that grows meets no page fault.

    It is taken, written to and freed again: objects of the interpreter's, and blocks smaller than those that are mapped
    each by itself. Both heaps keep it from then on.
    """
    objects = [bytes(SMALL) for _ in range(OBJECTS // SMALL)]
    _stakes.extend(objects[:: ARENA // SMALL // 2])
    libc = ctypes.CDLL(None)
    if not hasattr(libc, "mallopt"):
        return
    libc.mallopt(M_TRIM_THRESHOLD, RESERVE + SLACK)
    libc.malloc.restype, libc.malloc.argtypes = ctypes.c_void_p, [ctypes.c_size_t]
    libc.free.argtypes = [ctypes.c_void_p]
    piece = LARGE // 2
    for block in [libc.malloc(piece) for _ in range(RESERVE // piece)]:
        if block:  # none: there is no memory left, and nothing to be had at hand
            ctypes.memset(block, 0, piece)
            libc.free(block)


def claim() -> tuple[str, ...]:
    """Take what the limits allow, for the calling thread and its process; what was taken, or why not, a phrase each.

    Threads made later do not inherit it (SCHED_RESET_ON_FORK): only the loop is in a hurry. They get their place from
    :func:`line_up`. The memory of :func:`reserve` is taken whatever the limits say.
    """
    if not _stakes:
        reserve()
    said = _schedule(resource.getrlimit(resource.RLIMIT_RTPRIO)[0])
    line_up()
    return said, _lock(resource.getrlimit(resource.RLIMIT_MEMLOCK)[0])


def line_up() -> int:
    """Put threads made since the last call behind the calling one, where that is ahead of other programs; how many.

    Call it now and then: it costs a few microseconds a thread.
    """
    if os.sched_getscheduler(0) & ~os.SCHED_RESET_ON_FORK != os.SCHED_FIFO:
        return 0
    moved, ours = 0, threading.get_native_id()
    try:
        tasks = [int(path.name) for path in Path("/proc/self/task").iterdir()]
    except OSError:
        return 0  # no file descriptor is left: the next call will do
    for task in tasks:
        try:
            if task != ours and os.sched_getscheduler(task) & ~os.SCHED_RESET_ON_FORK == os.SCHED_OTHER:
                os.sched_setscheduler(task, os.SCHED_RR | os.SCHED_RESET_ON_FORK, os.sched_param(BEHIND))
                moved += 1
        except OSError:
            continue  # it has ended, or the limit allows no more
    return moved


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
