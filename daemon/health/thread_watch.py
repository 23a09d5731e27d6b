"""Hang detection: each worker thread reports the start time of its current job.

If a restart helps (a computation that hangs), the watchdog is not triggered any more and the service restarts.
Otherwise the hang is only reported. A thread that hangs in the kernel, at a disk or a bus, would hang in the next
process too. The restart would end the present localisation for nothing.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

from daemon.snapshot import Thread

log = logging.getLogger(__name__)

COMPUTING_S: Final = 120.0
"""Time limit of a computing job, s: the longest jobs take a few seconds, on a slow computer somewhat more."""
DISK_S: Final = 30.0
"""Time limit of disk access, s: a working disk responds sooner, whatever its load."""
CURED: Final = frozenset([Thread.SOLVER, Thread.SEARCH])
"""Threads for which a restart ends a hang."""

Since = Callable[[], float | None]
"""Start time of a thread's current job (`time.monotonic`, s); None while it waits for a job."""


@dataclass(frozen=True, slots=True)
class _Watched:
    thread: Thread
    since: Since
    limit_s: float


class ThreadWatch:
    """Hang detection of threads; call :meth:`look` once per heartbeat.

    Attributes:
        hanging: threads whose current job exceeds its time limit.
    """

    def __init__(self, now: Callable[[], float] = time.monotonic) -> None:
        self.hanging: frozenset[Thread] = frozenset()
        self._now = now
        self._watched: list[_Watched] = []

    def watch(self, thread: Thread, since: Since, limit_s: float) -> None:
        """Add a thread with its time limit in s."""
        self._watched.append(_Watched(thread, since, limit_s))

    def look(self) -> frozenset[Thread]:
        """Threads that hang at present; the start and the end of each hang are logged once."""
        now, before = self._now(), self.hanging
        self.hanging = frozenset(one.thread for one in self._watched if _busy(one, now) > one.limit_s)
        for one in self._watched:
            if one.thread in self.hanging - before:
                end = "; the watchdog ends the daemon soon" if one.thread in CURED else ""
                log.error("thread %s has not responded for %.0f s%s", one.thread.name, one.limit_s, end)
        for thread in before - self.hanging:
            log.info("thread %s responds again", thread.name)
        return self.hanging

    @property
    def alive(self) -> bool:
        """Whether the watchdog may be triggered: no thread hangs that a restart would cure."""
        return not self.hanging & CURED


def _busy(one: _Watched, now: float) -> float:
    since = one.since()
    return 0.0 if since is None else now - since
