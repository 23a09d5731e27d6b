"""The byte port interface between drivers and the operating system (a tty, a TCP socket, or memory).

A port delivers bytes with their arrival time by callback from the loop thread; there is no reader thread. The same
driver code runs over all three kinds, so that tests in virtual time carry the same bytes as a tty.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from typing import Protocol

from hal.clock import Clock
from hal.errors import DeviceMissing, HalError

OnData = Callable[[bytes, float], None]
"""Called with bytes and their arrival time ``t_mono``, read before any processing."""

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
        """Close; idempotent; does not call `on_lost`."""
        ...


class PortOpener(Protocol):
    """Opens a port by its name. It is injected into drivers, so that a test can supply memory ports."""

    async def __call__(self, device: str, baud: int) -> Port:
        """Open ``device`` (path, ``tcp://host:port``, or another name that the opener supports).

        Raises:
            DeviceMissing: no such device. DeviceRefused: permission, busy, not a tty.
        """
        ...


class MemoryPort:
    """One end of a pair that carries bytes inside one event loop, in virtual or real time.

    Every write arrives at the other end as one piece, from the loop, never inside the writer's call. There is no
    latency, line rate or limit of bytes in flight: a fake device simulates its own delays and pieces.
    :attr:`peer_baud` shows it the rate at which the driver reads.
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
        """True once this end was closed, or the loss of the other end was delivered."""
        return self._closed

    @property
    def peer_baud(self) -> int:
        """Line rate set at the other end, 0 if none was."""
        return self._peer.baud if self._peer else 0

    def start(self, on_data: OnData, on_lost: OnLost) -> None:
        """Begin delivering; what the other end wrote before comes first."""
        self._on_data, self._on_lost = on_data, on_lost
        self._wake()

    def write(self, data: bytes) -> None:
        """Send ``data`` to the other end; raises `DeviceMissing` after either end was closed."""
        if self._closed or self._lost or self._peer is None:
            raise DeviceMissing(self._name, "the port is closed")
        self._peer._inbox.append(bytes(data))
        self._peer._wake()

    def set_baud(self, baud: int) -> None:
        """Store the rate; the other end reads it as :attr:`peer_baud`."""
        self.baud = baud

    def close(self) -> None:
        """Close; the other end is lost after the bytes already written to it (as by an unplug)."""
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
    """Two ends of a byte channel in memory, for fakes and replay; both ends are alike.

    Args:
        clock: gives the arrival times, a :class:`hal.clock.LoopClock` under virtual time.
        name: of both ends in errors.
    """
    ends = MemoryPort(name, clock), MemoryPort(name, clock)
    ends[0]._peer, ends[1]._peer = ends[1], ends[0]
    return ends
