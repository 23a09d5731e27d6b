"""A kernel timer as a file descriptor (timerfd_create(2)): asyncio's own timers fire up to a millisecond late.

epoll_wait(2) takes whole milliseconds, and asyncio rounds its timeouts up. A timerfd becomes readable when it is due.
"""

from __future__ import annotations

import asyncio
import ctypes
import os
import time
from collections.abc import Callable
from typing import Final, Protocol

from hal.clock import VirtualLoop

_NONBLOCK: Final = os.O_NONBLOCK
_CLOEXEC: Final = os.O_CLOEXEC


class _Times(ctypes.Structure):
    """struct itimerspec: interval, then first expiration, each seconds and nanoseconds."""

    _fields_ = (
        ("every_s", ctypes.c_long),
        ("every_ns", ctypes.c_long),
        ("first_s", ctypes.c_long),
        ("first_ns", ctypes.c_long),
    )


class Timer(Protocol):
    """Calls back once at an instant of the loop's time; a new instant replaces the one before."""

    def at(self, when: float) -> None:
        """Call back then; at once where that is past."""
        ...

    def close(self) -> None:
        """Call back no more; idempotent."""
        ...


class KernelTimer:
    """A :class:`Timer` on a timerfd. Raises `OSError` where the system has none."""

    def __init__(self, loop: asyncio.AbstractEventLoop, callback: Callable[[], object]) -> None:
        self._libc = ctypes.CDLL(None, use_errno=True)
        self._fd: int = self._libc.timerfd_create(time.CLOCK_MONOTONIC, _NONBLOCK | _CLOEXEC)
        if self._fd < 0:
            raise OSError(ctypes.get_errno(), "timerfd_create")
        self._loop = loop
        self._callback = callback
        self._times = _Times()
        self._set = self._libc.timerfd_settime
        self._at = ctypes.byref(self._times)
        loop.add_reader(self._fd, self._expired)

    def at(self, when: float) -> None:
        """Call back then; at once where that is past."""
        nanoseconds = max(1, round((when - self._loop.time()) * 1e9))
        self._times.first_s, self._times.first_ns = divmod(nanoseconds, 1_000_000_000)
        self._set(self._fd, 0, self._at, None)

    def close(self) -> None:
        """Call back no more; idempotent."""
        if self._fd >= 0:
            self._loop.remove_reader(self._fd)
            os.close(self._fd)
            self._fd = -1

    def _expired(self) -> None:
        try:
            os.read(self._fd, 8)
        except BlockingIOError:
            return  # set again after it had become ready
        self._callback()


class LoopTimer:
    """A :class:`Timer` of the loop itself: under virtual time, and where there is no timerfd."""

    def __init__(self, loop: asyncio.AbstractEventLoop, callback: Callable[[], object]) -> None:
        self._loop = loop
        self._callback = callback
        self._handle: asyncio.TimerHandle | None = None

    def at(self, when: float) -> None:
        """Call back then; at once where that is past."""
        self.close()
        self._handle = self._loop.call_at(when, self._callback)

    def close(self) -> None:
        """Call back no more; idempotent."""
        if self._handle is not None:
            self._handle.cancel()
            self._handle = None


def timer(loop: asyncio.AbstractEventLoop, callback: Callable[[], object]) -> Timer:
    """Return a kernel timer where the loop runs in real time and the system has one, else a timer of the loop."""
    if isinstance(loop, VirtualLoop):
        return LoopTimer(loop, callback)
    try:
        return KernelTimer(loop, callback)
    except (OSError, AttributeError):
        return LoopTimer(loop, callback)
