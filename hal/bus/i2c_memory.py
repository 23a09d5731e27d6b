"""A bus that is nothing but memory, inside the event loop: in virtual time, or in real time behind a server.

Such a bus does not block. It is told to begin a transaction, says at once when that will be over, and is asked for the
result when the time has come: what it measures then lies in the past, also for whoever simulates the light.
"""

from __future__ import annotations

import asyncio
from typing import Protocol

from hal.bus.i2c import Message, OnRead, Transferred
from hal.clock import Clock


class Pending(Protocol):
    """A transaction that has begun."""

    @property
    def t_end(self) -> float:
        """``t_mono`` at which its caller gets the result."""
        ...

    def finish(self) -> Transferred:
        """The result; raises `OSError` if it failed."""
        ...


class MemoryBus(Protocol):
    """A simulated bus."""

    @property
    def about(self) -> str:
        """See :attr:`hal.bus.i2c.Bus.about`."""
        ...

    def begin(self, messages: tuple[Message, ...]) -> Pending:
        """Begin one transaction now."""
        ...


class LoopBus:
    """A :class:`hal.bus.i2c.AsyncBus` over a memory bus.

    Args:
        name: what errors call it. bus: the simulation. clock: the loop's, real or virtual.
    """

    def __init__(self, name: str, bus: MemoryBus, clock: Clock) -> None:
        self._name, self._bus, self._clock = name, bus, clock
        self._turn = asyncio.Lock()

    @property
    def name(self) -> str:
        """See :attr:`hal.bus.i2c.Bus.name`."""
        return self._name

    @property
    def about(self) -> str:
        """See :attr:`hal.bus.i2c.Bus.about`."""
        return self._bus.about

    async def transfer(self, messages: tuple[Message, ...]) -> Transferred:
        """Carry out one transaction; raises `OSError` when its time is over."""
        async with self._turn:
            pending = self._bus.begin(messages)
            await asyncio.sleep(pending.t_end - self._clock.now())
            return pending.finish()

    async def stream(self, messages: tuple[Message, ...], on_read: OnRead) -> None:
        """Repeat one transaction until cancelled; nothing is ever dropped, the bus waits for the loop."""
        while True:
            on_read(await self.transfer(messages), 0)

    async def close(self) -> None:
        """Nothing is held open."""
