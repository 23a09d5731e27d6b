"""Taps on ports: pass every byte on to the recording and to the clients of raw bytes."""

from __future__ import annotations

from collections.abc import Callable

from hal.clock import Clock
from hal.errors import HalError
from hal.port.port import OnData, OnLost, Port, PortOpener
from hal.replay.recording import Kind

Passed = Callable[[Kind, float, bytes], None]
"""Takes what has passed: what it was (RX, TX, OPEN, LOST, BAUD), when, and the bytes. It must return at once."""


def tapped(opener: PortOpener, passed: Passed, clock: Clock) -> PortOpener:
    """A port opener of whose ports ``passed`` is told everything that passes through them."""

    async def open_tapped(device: str, baud: int) -> Port:
        port = await opener(device, baud)
        passed(Kind.OPEN, clock.now(), f"{port.name} {baud}".encode())
        return _TappedPort(port, passed, clock)

    return open_tapped


class _TappedPort:
    """A port that tells everything that passes through it (`hal.port.port.Port`)."""

    def __init__(self, port: Port, passed: Passed, clock: Clock) -> None:
        self._port = port
        self._passed = passed
        self._clock = clock

    @property
    def name(self) -> str:
        """The port as the user named it."""
        return self._port.name

    def start(self, on_data: OnData, on_lost: OnLost) -> None:
        """Begin delivering; bytes are told before anybody else sees them."""
        passed = self._passed

        def keep(data: bytes, t_rx: float) -> None:
            passed(Kind.RX, t_rx, data)
            on_data(data, t_rx)

        def lose(error: HalError) -> None:
            passed(Kind.LOST, self._clock.now(), str(error).encode())
            on_lost(error)

        self._port.start(keep, lose)

    def write(self, data: bytes) -> None:
        """Send a short command; it is told once the port has taken it."""
        self._port.write(data)
        self._passed(Kind.TX, self._clock.now(), data)

    def set_baud(self, baud: int) -> None:
        """Change the line rate."""
        self._port.set_baud(baud)
        self._passed(Kind.BAUD, self._clock.now(), str(baud).encode())

    def close(self) -> None:
        """Close the port."""
        self._port.close()
        self._passed(Kind.LOST, self._clock.now(), b"closed")
