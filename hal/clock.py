"""The injected clock, real or virtual, and the event loop that runs in virtual time.

``t_mono`` everywhere in the project means seconds of CLOCK_MONOTONIC (or of the virtual clock); UTC exists only at the
edge. Virtual time is a property of the event loop: under :class:`VirtualLoop`, ``asyncio.sleep``, ``call_at`` and
``wait_for`` all run in virtual seconds, and the clock jumps to the next timer as soon as nothing is ready to run. Code
that uses the loop's own timers therefore needs no second version for tests and replay.
"""

from __future__ import annotations

import asyncio
import selectors
import time
from collections.abc import Coroutine
from typing import Any, Protocol, TypeVar

T = TypeVar("T")


class Clock(Protocol):
    """The only source of time for the daemon and the drivers."""

    def now(self) -> float:
        """Seconds of the monotonic clock (``t_mono``)."""
        ...

    def utc(self) -> float:
        """Seconds since the Unix epoch; may step; never used in arithmetic with ``now()``."""
        ...


class SystemClock:
    """CLOCK_MONOTONIC, which is also what asyncio's loops use for ``loop.time()`` on Linux."""

    def now(self) -> float:
        """Seconds of CLOCK_MONOTONIC."""
        return time.monotonic()

    def utc(self) -> float:
        """Seconds since the Unix epoch."""
        return time.time()


class LoopClock:
    """The time of a :class:`VirtualLoop`; ``utc`` starts at a settable epoch so that runs are repeatable."""

    def __init__(self, loop: asyncio.AbstractEventLoop, utc_at_zero: float = 0.0) -> None:
        self._loop = loop
        self._utc_at_zero = utc_at_zero

    def now(self) -> float:
        """Seconds of the loop's virtual time."""
        return self._loop.time()

    def utc(self) -> float:
        """The epoch chosen at construction plus virtual time."""
        return self._utc_at_zero + self._loop.time()


class _JumpingSelector(selectors.DefaultSelector):
    """A selector that never sleeps: it reports what is ready and otherwise moves virtual time by the timeout."""

    def __init__(self) -> None:
        super().__init__()
        self.virtual_now = 0.0

    def select(self, timeout: float | None = None) -> list[tuple[selectors.SelectorKey, int]]:
        ready = super().select(0)
        if not ready:
            if timeout is None:
                raise RuntimeError("virtual time cannot advance: no timer is pending and no task is ready to run")
            if timeout > 0:
                self.virtual_now += timeout
        return ready


class VirtualLoop(asyncio.SelectorEventLoop):
    """An event loop whose time is virtual and jumps from timer to timer.

    Real file descriptors must not be waited for under this loop: memory ports carry the same bytes.
    """

    def __init__(self, start: float = 0.0) -> None:
        self._jumping = _JumpingSelector()
        self._jumping.virtual_now = start
        super().__init__(self._jumping)
        self._clock_resolution = 1e-9

    def time(self) -> float:
        """Virtual seconds, as timers see them."""
        return self._jumping.virtual_now


def run_virtual(main: Coroutine[Any, Any, T], start: float = 0.0) -> T:
    """Run a coroutine to its end in virtual time (the counterpart of ``asyncio.run``)."""
    with asyncio.Runner(loop_factory=lambda: VirtualLoop(start)) as runner:
        return runner.run(main)
