"""Byte ports: the one seam between drivers and the operating system (a tty, a TCP socket, or memory).

A port delivers bytes with their arrival time by callback from the loop thread; there is no reader thread. The same
driver code runs over all three kinds, which is what lets virtual-time tests carry the very bytes a tty carries.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from typing import Protocol

from hal.clock import Clock
from hal.errors import DeviceMissing, HalError

OnData = Callable[[bytes, float], None]
"""Called with bytes and the ``t_mono`` taken before anything else was done with them."""

OnLost = Callable[[HalError], None]
"""Called once when the port is gone; no data follow."""


class Port(Protocol):
    """An open byte stream to a device."""

    @property
    def name(self) -> str:
        """The port as the user named it."""
        ...

    def start(self, on_data: OnData, on_lost: OnLost) -> None:
        """Begin delivering. Bytes that arrived before are delivered first."""
        ...

    def write(self, data: bytes) -> None:
        """Send a short command at once; raises `DeviceMissing` if the port is gone."""
        ...

    def set_baud(self, baud: int) -> None:
        """Change the line rate where there is one; nothing on TCP and memory ports."""
        ...

    def close(self) -> None:
        """Close; idempotent; `on_lost` is not called for a close of our own."""
        ...


class PortOpener(Protocol):
    """Opens a port by its name. Drivers get this injected, so that a test can hand out memory ports."""

    async def __call__(self, device: str, baud: int) -> Port:
        """Open ``device`` (path, ``tcp://host:port``, or whatever the opener knows).

        Raises:
            DeviceMissing: nothing there. DeviceRefused: permission, busy, not a tty.
        """
        ...


class MemoryPort:
    """One end of a pair that carries bytes inside one event loop, in virtual or real time.

    Every write arrives at the other end as one piece, from the loop, never inside the writer's call. There is no
    latency, no line rate and no limit to what is in flight: a fake device that wants those makes its own delays and
    pieces. :attr:`peer_baud` lets it notice that the driver listens at another rate.
    """

    def __init__(self, name: str, clock: Clock) -> None:
        self._name = name
        self._clock = clock
        self._peer: MemoryPort | None = None
        self._inbox: list[bytes] = []
        self._on_data: OnData | None = None
        self._on_lost: OnLost | None = None
        self._closed = False
        self._lost: HalError | None = None
        self.baud = 0

    @property
    def name(self) -> str:
        """The name given to :func:`memory_pair`."""
        return self._name

    @property
    def closed(self) -> bool:
        """True once this end was closed or the other end went away and that was told."""
        return self._closed

    @property
    def peer_baud(self) -> int:
        """Line rate the other end was last set to, 0 if never."""
        return self._peer.baud if self._peer else 0

    def start(self, on_data: OnData, on_lost: OnLost) -> None:
        """Begin delivering; what the other end wrote before comes first."""
        self._on_data, self._on_lost = on_data, on_lost
        self._wake()

    def write(self, data: bytes) -> None:
        """Hand ``data`` to the other end; raises `DeviceMissing` after either end was closed."""
        if self._closed or self._lost or self._peer is None:
            raise DeviceMissing(self._name, "the port is closed")
        self._peer._inbox.append(bytes(data))
        self._peer._wake()

    def set_baud(self, baud: int) -> None:
        """Remember the rate for the other end to look at."""
        self.baud = baud

    def close(self) -> None:
        """Close; the other end is told, after the bytes already written to it (an unplug, or a daemon that left)."""
        if self._closed:
            return
        self._closed = True
        self._inbox.clear()
        if self._peer is not None and not self._peer._closed:
            self._peer._lost = DeviceMissing(self._name, "the other end was closed")
            self._peer._wake()

    def _wake(self) -> None:
        if self._on_data is not None:
            asyncio.get_running_loop().call_soon(self._deliver)

    def _deliver(self) -> None:
        while self._inbox and self._on_data is not None and not self._closed:
            self._on_data(self._inbox.pop(0), self._clock.now())
        if self._lost is not None and self._on_lost is not None and not self._closed:
            self._closed = True
            self._on_lost(self._lost)


def memory_pair(clock: Clock, name: str = "memory") -> tuple[MemoryPort, MemoryPort]:
    """Two ends of a byte channel in memory, for fakes and replay; which end is whose does not matter.

    Args:
        clock: gives the arrival times, a :class:`hal.clock.LoopClock` under virtual time.
        name: what both ends are called in errors.
    """
    ends = MemoryPort(name, clock), MemoryPort(name, clock)
    ends[0]._peer, ends[1]._peer = ends[1], ends[0]
    return ends
