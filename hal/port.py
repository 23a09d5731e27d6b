"""Byte ports: the one seam between drivers and the operating system (a tty, a TCP socket, or memory).

A port delivers bytes with their arrival time by callback from the loop thread; there is no reader thread. The same
driver code runs over all three kinds, which is what lets virtual-time tests carry the very bytes a tty carries.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

from hal.errors import HalError

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
