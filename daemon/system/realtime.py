"""Real-time scheduling of the event loop's thread and memory locking, where the service unit permits both.

The resource limits are the switch. A unit with ``LimitRTPRIO=`` and ``LimitMEMLOCK=infinity`` dedicates the computer to
the robot. A run in a terminal, even as root, gets neither.

The other threads run just below the loop's priority and above ordinary programs. This is necessary: one of them may
hold the interpreter lock while another program has its processor. The loop then waits for that program, at any priority
of its own. With both cores busy, cycles started up to 130 ms late because of this. These threads compute for a few
hundredths of the time only.
"""

from __future__ import annotations

import ctypes
import os
import resource
import threading
from pathlib import Path
from typing import Final

PRIORITY: Final = 40
"""Priority in SCHED_FIFO: above ordinary users of threaded interrupts, below the interrupts themselves (50)."""
BEHIND: Final = 1
"""Priority in SCHED_RR of the other threads: the lowest real-time priority, above all ordinary programs."""
MCL_CURRENT, MCL_FUTURE, MCL_ONFAULT = 1, 2, 4
"""Flags of mlockall(2). ONFAULT locks only pages that are touched; most of the stacks and arenas never are."""


M_TRIM_THRESHOLD, M_MMAP_THRESHOLD, M_ARENA_MAX = -1, -3, -8
"""Parameters of mallopt(3)."""

LARGE, SLACK = 1 << 20, 1 << 20
"""Size in bytes above which each block gets a mapping of its own; bytes that may stay free at the end of the heap."""
RESERVE, OBJECTS = 16 << 20, 3 << 20
"""Bytes of the C heap and of the interpreter's heap that are reserved before the first cycle; the map fills them."""
ARENA, SMALL = 1 << 20, 400
"""Bytes of one allocation unit of the interpreter; size in bytes of an object inside it."""
_stakes: list[bytes] = []
"""One object in each allocation unit of the interpreter's reserve: an empty unit would be returned."""


def give_back() -> None:
    """Return freed memory of jobs to the system, where the C library is glibc.

    By default, when the first large block is freed, glibc expects more of that size and takes them from the heap from
    then on. One small block behind them then keeps them allocated: one second of relocalisation kept 30 MB for good.
    glibc also gives each thread a heap of its own, so that memory freed by one thread is not available to others.
    Memory left free by loading the kernels could then hold a map for hours.
    """
    libc = ctypes.CDLL(None)
    if hasattr(libc, "mallopt"):
        libc.mallopt(M_ARENA_MAX, 1)
        libc.mallopt(M_MMAP_THRESHOLD, LARGE)
        libc.mallopt(M_TRIM_THRESHOLD, SLACK)


def reserve() -> None:
    """Reserve memory in advance, where the C library is glibc, so that a growing map causes no page fault.

    The memory is allocated, written to and freed again: interpreter objects, and blocks below the mapping threshold.
    Both heaps keep it from then on.
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
        if block:  # null: no memory is left to reserve
            ctypes.memset(block, 0, piece)
            libc.free(block)


def claim() -> tuple[str, ...]:
    """Apply real-time scheduling and memory locking as far as the limits permit; return one phrase on each.

    It applies to the calling thread and its process. Later threads do not inherit it (SCHED_RESET_ON_FORK), because
    only the loop is urgent; :func:`line_up` sets their priority. :func:`reserve` runs whatever the limits are.
    """
    if not _stakes:
        reserve()
    said = _schedule(resource.getrlimit(resource.RLIMIT_RTPRIO)[0])
    line_up()
    return said, _lock(resource.getrlimit(resource.RLIMIT_MEMLOCK)[0])


def line_up() -> int:
    """Set the priority of new threads below the calling thread's, if that one is real-time; return how many changed.

    Call it periodically: it costs a few microseconds a thread.
    """
    if os.sched_getscheduler(0) & ~os.SCHED_RESET_ON_FORK != os.SCHED_FIFO:
        return 0
    moved, ours = 0, threading.get_native_id()
    try:
        tasks = [int(path.name) for path in Path("/proc/self/task").iterdir()]
    except OSError:
        return 0  # no file descriptor is left: the next call will succeed
    for task in tasks:
        try:
            if task != ours and os.sched_getscheduler(task) & ~os.SCHED_RESET_ON_FORK == os.SCHED_OTHER:
                os.sched_setscheduler(task, os.SCHED_RR | os.SCHED_RESET_ON_FORK, os.sched_param(BEHIND))
                moved += 1
        except OSError:
            continue  # the thread has ended, or the limit permits no more
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
        return (
            "memory not locked (the unit sets no LimitMEMLOCK=infinity)"  # under a finite limit later calls would fail
        )
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.mlockall(MCL_CURRENT | MCL_FUTURE | MCL_ONFAULT):
        return f"memory not locked ({os.strerror(ctypes.get_errno())})"
    return "memory locked"
