"""How much of the loop's time those outside may take: a flood on a port must not keep the loop busy without a pause.

A loop that is never idle is late for its cycle, and under SCHED_FIFO the kernel takes the processor away from it for
50 ms of every second that it would otherwise use whole (sched(7), sched_rt_runtime_us). So what serves a socket does so
for half of each slice of 10 ms at most; the rest of what came waits in the kernel, or is dropped there.
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable
from typing import Final

SLICE_S: Final = 0.01
PART: Final = 0.5


class Share:
    """The time that some callbacks have in common. Call :meth:`begin` and :meth:`end` around each.

    Attributes:
        held: how often somebody had to wait for the next slice.
    """

    def __init__(self, stopwatch: Callable[[], float] = time.perf_counter) -> None:
        self.held = 0
        self._stopwatch = stopwatch
        self._begun = 0.0
        self._slice = -1.0
        self._spent = 0.0

    def begin(self) -> bool:
        """Whether there is time left; the time of what is done now is taken from it."""
        self._begun = now = self._stopwatch()
        if not 0.0 <= now - self._slice < SLICE_S:
            self._slice, self._spent = now, 0.0
        if self._spent < PART * SLICE_S:
            return True
        self.held += 1
        return False

    def end(self) -> None:
        """It is done."""
        self._spent += self._stopwatch() - self._begun

    def left_s(self) -> float:
        """Seconds until the next slice."""
        return max(0.0, self._slice + SLICE_S - self._stopwatch())

    def later(self, callback: Callable[[], object]) -> asyncio.TimerHandle:
        """Call back in the next slice."""
        return asyncio.get_running_loop().call_later(self.left_s(), callback)


class Reader:
    """Calls back when a socket can be read, as long as the share lasts.

    Args:
        fd: of the socket. serve: reads what is there, some of it.
    """

    def __init__(self, fd: int, serve: Callable[[], None], share: Share) -> None:
        self._fd, self._serve, self._share = fd, serve, share
        self._waiting: asyncio.TimerHandle | None = None
        self._loop = asyncio.get_running_loop()
        self._loop.add_reader(fd, self._read)

    def close(self) -> None:
        """Call back no more; idempotent: the number of a closed socket may be another one's by then."""
        if self._fd < 0:
            return
        self._loop.remove_reader(self._fd)
        self._fd = -1
        if self._waiting is not None:
            self._waiting.cancel()

    def _read(self) -> None:
        if self._share.begin():
            try:
                self._serve()
            finally:
                self._share.end()
        else:
            self._loop.remove_reader(self._fd)
            self._waiting = self._share.later(self._again)

    def _again(self) -> None:
        self._waiting = None
        self._loop.add_reader(self._fd, self._read)
