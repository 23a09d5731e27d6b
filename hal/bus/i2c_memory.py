"""The interface of a simulated I2C bus, and its adapter to the event loop (virtual time, or real time behind a server).

A simulated bus does not block. ``begin`` starts a transaction and returns its end time at once; ``finish`` returns the
result at that time. The sampled interval then lies in the past, for the light simulation too.
"""

from __future__ import annotations

import asyncio
from typing import Protocol

from hal.bus.i2c import Message, OnRead, Transferred
from hal.clock import Clock


class Pending(Protocol):
    """A transaction in progress."""

    @property
    def t_end(self) -> float:
        """``t_mono`` at which the result is available."""
        ...

    def finish(self) -> Transferred:
        """Return the result; raises `OSError` if the transaction failed."""
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
        name: for errors. bus: the simulation. clock: the loop's, real or virtual.
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
        """Carry out one transaction; raises `OSError` at its end if it failed."""
        async with self._turn:
            pending = self._bus.begin(messages)
            await asyncio.sleep(pending.t_end - self._clock.now())
            return pending.finish()

    async def stream(self, messages: tuple[Message, ...], on_read: OnRead) -> None:
        """Repeat one transaction until cancelled; nothing is dropped: the bus waits for the loop."""
        while True:
            on_read(await self.transfer(messages), 0)

    async def close(self) -> None:
        """Nothing is held open."""
