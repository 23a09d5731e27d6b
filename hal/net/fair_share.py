"""Limits the share of the loop's time that network clients may use, so that a flood on a port cannot delay the cycle.

A loop that is never idle is late for its cycle. Under SCHED_FIFO the kernel also stops a loop that uses a whole second
of processor time, for 50 ms (sched(7), sched_rt_runtime_us). Socket callbacks therefore run for at most half of each
slice of 10 ms. Data beyond that wait in the kernel, or are dropped there.
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable
from typing import Final

SLICE_S: Final = 0.01
PART: Final = 0.5


class Share:
    """A time budget that several callbacks share. Call :meth:`begin` and :meth:`end` around each.

    Attributes:
        held: number of callbacks put off to the next slice.
    """

    def __init__(self, stopwatch: Callable[[], float] = time.perf_counter) -> None:
        self.held = 0
        self._stopwatch = stopwatch
        self._begun = 0.0
        self._slice = -1.0
        self._spent = 0.0

    def begin(self) -> bool:
        """Start a callback: True where the slice has time left, which the callback then uses up."""
        self._begun = now = self._stopwatch()
        if not 0.0 <= now - self._slice < SLICE_S:
            self._slice, self._spent = now, 0.0
        if self._spent < PART * SLICE_S:
            return True
        self.held += 1
        return False

    def end(self) -> None:
        """End the callback: charge its duration to the slice."""
        self._spent += self._stopwatch() - self._begun

    def left_s(self) -> float:
        """Seconds until the next slice."""
        return max(0.0, self._slice + SLICE_S - self._stopwatch())

    def later(self, callback: Callable[[], object]) -> asyncio.TimerHandle:
        """Call back in the next slice."""
        return asyncio.get_running_loop().call_later(self.left_s(), callback)


class Reader:
    """Calls back when a socket can be read, as long as its share of the slice lasts.

    Args:
        fd: of the socket. serve: reads some of the waiting data.
    """

    def __init__(self, fd: int, serve: Callable[[], None], share: Share) -> None:
        self._fd, self._serve, self._share = fd, serve, share
        self._waiting: asyncio.TimerHandle | None = None
        self._loop = asyncio.get_running_loop()
        self._loop.add_reader(fd, self._read)

    def close(self) -> None:
        """Stop calling back; idempotent, since the descriptor of a closed socket may already belong to another one."""
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
