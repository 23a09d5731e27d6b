"""I2C buses: the one seam between converter drivers and the kernel (a device node, a remote bus, or memory).

A transaction is a list of messages joined by repeated starts, as ``ioctl(I2C_RDWR)`` takes it. Failures are
``OSError`` with the errno the kernel's adapter drivers use, so that a fake and a real bus fail alike.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol


@dataclass(frozen=True, slots=True)
class Message:
    """One I2C message: a write of ``data``, or a read of ``length`` bytes (then ``data`` is empty)."""

    address: int
    data: bytes = b""
    length: int = 0


@dataclass(frozen=True, slots=True)
class Transferred:
    """A completed transaction: bytes of each read message in order, and ``t_mono`` immediately around it."""

    t0: float
    t1: float
    reads: tuple[bytes, ...]


class Bus(Protocol):
    """An open bus. ``transfer`` blocks, so a real bus belongs to a thread of its own.

    A memory bus under virtual time cannot block: it answers at once with ``t1`` in the future of the virtual clock, and
    whoever called delivers the result when that time has come.
    """

    @property
    def name(self) -> str:
        """The bus as the user named it (``/dev/i2c-1``, ``unix:/run/x``, ``tcp://host:port``)."""
        ...

    def transfer(self, messages: tuple[Message, ...]) -> Transferred:
        """Carry out one transaction.

        Raises:
            OSError: with the kernel's errno (ENXIO, EREMOTEIO, ETIMEDOUT, EIO, EAGAIN, ENODEV, EOPNOTSUPP ...).
        """
        ...

    def close(self) -> None:
        """Close; idempotent."""
        ...
