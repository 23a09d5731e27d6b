"""The calling thread before all other programs, as the daemon's loop is where a unit allows it."""

import ctypes
import os
from collections.abc import Iterator
from contextlib import contextmanager

from daemon.system.realtime import MCL_CURRENT, MCL_FUTURE, MCL_ONFAULT, PRIORITY, line_up


def first_in_line() -> None:
    """As `daemon.system.realtime.claim` does, but without asking for the unit's limits: a benchmark has no unit."""
    os.sched_setscheduler(0, os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, os.sched_param(PRIORITY))
    ctypes.CDLL(None).mlockall(MCL_CURRENT | MCL_FUTURE | MCL_ONFAULT)
    line_up()


@contextmanager
def before_others(wanted: bool) -> Iterator[None]:
    """The same for a while; this process's other threads stay where they are put."""
    if not wanted:
        yield
        return
    first_in_line()
    try:
        yield
    finally:
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
        ctypes.CDLL(None).munlockall()
