"""Hang detection: each worker thread reports the start time of its current job.

What a restart cures (a computation that hangs) keeps the watchdog from being fed, what it does not cure is only said:
a thread that hangs in the kernel, at a disk or a bus, hangs in the next process too, and ends this one's localisation.
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
"""No job takes that long: the longest are a few seconds, on a slow computer some more."""
DISK_S: Final = 30.0
"""Nor does a disk that works, however many are at it."""
CURED: Final = frozenset([Thread.SOLVER, Thread.SEARCH])
"""Threads whose hanging a restart cures."""

Since = Callable[[], float | None]
"""Since when a thread has been busy with one thing (`time.monotonic`), None while it waits for something to do."""


@dataclass(frozen=True, slots=True)
class _Watched:
    thread: Thread
    since: Since
    limit_s: float


class ThreadWatch:
    """Watches threads; :meth:`look` once per heartbeat.

    Attributes:
        hanging: those that have not come back for longer than they may take.
    """

    def __init__(self, now: Callable[[], float] = time.monotonic) -> None:
        self.hanging: frozenset[Thread] = frozenset()
        self._now = now
        self._watched: list[_Watched] = []

    def watch(self, thread: Thread, since: Since, limit_s: float) -> None:
        """Watch one more."""
        self._watched.append(_Watched(thread, since, limit_s))

    def look(self) -> frozenset[Thread]:
        """Which hang now; each is said once when it does and once when it has come back."""
        now, before = self._now(), self.hanging
        self.hanging = frozenset(one.thread for one in self._watched if _busy(one, now) > one.limit_s)
        for one in self._watched:
            if one.thread in self.hanging - before:
                end = "; the watchdog will end the daemon" if one.thread in CURED else ""
                log.error("thread %s has not come back for %.0f s%s", one.thread.name, one.limit_s, end)
        for thread in before - self.hanging:
            log.info("thread %s has come back", thread.name)
        return self.hanging

    @property
    def alive(self) -> bool:
        """Whether the watchdog may be fed."""
        return not self.hanging & CURED


def _busy(one: _Watched, now: float) -> float:
    since = one.since()
    return 0.0 if since is None else now - since
