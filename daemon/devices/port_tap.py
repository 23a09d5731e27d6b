"""Port taps: copy every byte of a device port to the recording and to the stream's clients of raw bytes."""

from __future__ import annotations

from collections.abc import Callable

from hal.clock import Clock
from hal.errors import HalError
from hal.port.port import OnData, OnLost, Port, PortOpener
from hal.replay.recording import Kind

Passed = Callable[[Kind, float, bytes], None]
"""Observer of port traffic: kind (RX, TX, OPEN, LOST, BAUD), time, and the bytes. It must return at once."""


def tapped(opener: PortOpener, passed: Passed, clock: Clock) -> PortOpener:
    """Wrap a port opener so that ``passed`` receives all traffic of the ports it opens."""

    async def open_tapped(device: str, baud: int) -> Port:
        port = await opener(device, baud)
        passed(Kind.OPEN, clock.now(), f"{port.name} {baud}".encode())
        return _TappedPort(port, passed, clock)

    return open_tapped


class _TappedPort:
    """Port that copies all its traffic to an observer (`hal.port.port.Port`)."""

    def __init__(self, port: Port, passed: Passed, clock: Clock) -> None:
        self._port = port
        self._passed = passed
        self._clock = clock

    @property
    def name(self) -> str:
        """Port name as configured."""
        return self._port.name

    def start(self, on_data: OnData, on_lost: OnLost) -> None:
        """Begin delivery; the observer receives bytes before the driver."""
        passed = self._passed

        def keep(data: bytes, t_rx: float) -> None:
            passed(Kind.RX, t_rx, data)
            on_data(data, t_rx)

        def lose(error: HalError) -> None:
            passed(Kind.LOST, self._clock.now(), str(error).encode())
            on_lost(error)

        self._port.start(keep, lose)

    def write(self, data: bytes) -> None:
        """Send a short command; the observer receives it once the port has accepted it."""
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
