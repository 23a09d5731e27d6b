"""I2C buses: the one seam between converter drivers and the kernel (a device node, a remote bus, or memory).

A transaction is a list of messages joined by repeated starts, as ``ioctl(I2C_RDWR)`` takes it. Failures are
``OSError`` with the errno the kernel's adapter drivers use, so that a fake and a real bus fail alike.

Drivers hold an :class:`AsyncBus`, which they get from a :class:`BusOpener`. There are two kinds of it:
:mod:`hal.bus.i2c_thread` gives a blocking :class:`Bus` (:mod:`hal.bus.i2c_linux`, :mod:`hal.bus.i2c_remote`) a thread
of its own, :mod:`hal.bus.i2c_memory` runs a bus that is nothing but memory inside the event loop, in virtual or real
time.
"""

from __future__ import annotations

import errno
from collections.abc import Callable, Generator
from dataclasses import dataclass
from typing import Final, Protocol

MAX_MESSAGES: Final = 42
"""Messages of one transaction (I2C_RDWR_IOCTL_MAX_MSGS)."""
MAX_LENGTH: Final = 8192
"""Bytes of one message, as i2c-dev has it."""
NACKS: Final = frozenset({errno.ENXIO, errno.EREMOTEIO})
"""What a missing acknowledgement is called; which one depends on the adapter's driver."""


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
    whoever called delivers the result when that time has come (:mod:`hal.bus.i2c_memory` does).
    """

    @property
    def name(self) -> str:
        """The bus as the user named it (``/dev/i2c-1``, ``unix:/run/x``, ``tcp://host:port``)."""
        ...

    @property
    def about(self) -> str:
        """What the adapter calls itself (``bcm2835 (i2c@7e804000)``); empty where it does not."""
        ...

    def transfer(self, messages: tuple[Message, ...]) -> Transferred:
        """Carry out one transaction.

        Raises:
            OSError: with the kernel's errno (ENXIO, EREMOTEIO, ETIMEDOUT, EIO, EAGAIN, ENODEV, EOPNOTSUPP ...).
        """
        ...

    def repeat(self, messages: tuple[Message, ...]) -> Generator[Transferred]:
        """The same transaction again and again, with as little pause between as this bus can do; raises `OSError`."""
        ...

    def release(self) -> None:
        """Give up what of the bus is this program's alone; from another thread, while a transaction hangs."""
        ...

    def close(self) -> None:
        """Close; idempotent."""
        ...


OnRead = Callable[[Transferred, int], None]
"""Called in the loop thread with a transaction, and how many before it nobody had time for (counted from the start)."""


class AsyncBus(Protocol):
    """An open bus as a driver in the event loop uses it; transactions are carried out one after the other."""

    @property
    def name(self) -> str:
        """See :attr:`Bus.name`."""
        ...

    @property
    def about(self) -> str:
        """See :attr:`Bus.about`."""
        ...

    async def transfer(self, messages: tuple[Message, ...]) -> Transferred:
        """Carry out one transaction; while a stream runs, between two of its transactions. Raises `OSError`."""
        ...

    async def stream(self, messages: tuple[Message, ...], on_read: OnRead) -> None:
        """Repeat one transaction until cancelled; it never returns.

        What the loop has no time to take is dropped: the latest wins.

        Raises:
            OSError: what a transaction failed with; none follows it.
        """
        ...

    async def close(self) -> None:
        """Close; idempotent. A transaction that hangs in the kernel is left to itself."""
        ...


class BusOpener(Protocol):
    """Opens a bus by its name. Drivers get this injected, so that a test can hand out memory buses."""

    async def __call__(self, name: str) -> AsyncBus:
        """Open ``name``.

        Raises:
            DeviceMissing: nothing there. DeviceRefused: permission, busy, not an I2C bus.
        """
        ...


def read(address: int, length: int) -> Message:
    """A message that reads ``length`` bytes."""
    return Message(address, length=length)


def write(address: int, data: bytes) -> Message:
    """A message that writes ``data``."""
    return Message(address, data)


def check(messages: tuple[Message, ...]) -> None:
    """Refuse what i2c-dev refuses, and the lengths that smbus2 would silently cut to 16 bits.

    Raises:
        OSError: EINVAL, with what is wrong in words.
    """
    if not 1 <= len(messages) <= MAX_MESSAGES:
        raise OSError(errno.EINVAL, f"{len(messages)} messages: one transaction has 1 to {MAX_MESSAGES}")
    for message in messages:
        length = len(message.data) or message.length
        if not 0 <= message.address <= 0x7F:
            raise OSError(errno.EINVAL, f"address {message.address:#x}: 7 bits at most")
        if message.data and message.length:
            raise OSError(errno.EINVAL, "a message either writes or reads")
        if not 1 <= length <= MAX_LENGTH:
            raise OSError(errno.EINVAL, f"{length} bytes: one message has 1 to {MAX_LENGTH}")
