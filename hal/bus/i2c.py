"""The I2C bus interface between converter drivers and the kernel, a remote bus, or a simulated bus.

A transaction is a list of messages joined by repeated starts, as ``ioctl(I2C_RDWR)`` takes it. Failures are
``OSError`` with the errno the kernel's adapter drivers use, so that a fake and a real bus fail alike.

A driver obtains an :class:`AsyncBus` from a :class:`BusOpener`. It has two implementations:
:mod:`hal.bus.i2c_thread` runs a blocking :class:`Bus` (:mod:`hal.bus.i2c_linux`, :mod:`hal.bus.i2c_remote`) in a thread
of its own; :mod:`hal.bus.i2c_memory` runs a simulated bus inside the event loop, in virtual or real time.
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
"""Errnos of a missing acknowledgement; which one depends on the adapter's driver."""


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

    A memory bus under virtual time cannot block: it returns at once with ``t1`` in the future of the virtual clock, and
    the caller delivers the result at that time (as :mod:`hal.bus.i2c_memory` does).
    """

    @property
    def name(self) -> str:
        """The bus as the user named it (``/dev/i2c-1``, ``unix:/run/x``, ``tcp://host:port``)."""
        ...

    @property
    def about(self) -> str:
        """The adapter's own name (``bcm2835 (i2c@7e804000)``); empty where it has none."""
        ...

    def transfer(self, messages: tuple[Message, ...]) -> Transferred:
        """Carry out one transaction.

        Raises:
            OSError: with the kernel's errno (ENXIO, EREMOTEIO, ETIMEDOUT, EIO, EAGAIN, ENODEV, EOPNOTSUPP ...).
        """
        ...

    def repeat(self, messages: tuple[Message, ...]) -> Generator[Transferred]:
        """Repeat the transaction with the shortest pause that this bus can do; raises `OSError`."""
        ...

    def release(self) -> None:
        """Release exclusive claims on the bus; called from another thread while a transaction hangs."""
        ...

    def close(self) -> None:
        """Close; idempotent."""
        ...


OnRead = Callable[[Transferred, int], None]
"""Called in the loop thread with a transaction and the number dropped before it, counted from the start."""


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

        A transaction that the loop has no time to receive is dropped: the latest wins.

        Raises:
            OSError: a transaction failed; no further one follows.
        """
        ...

    async def close(self) -> None:
        """Close; idempotent. A transaction that hangs in the kernel is abandoned."""
        ...


class BusOpener(Protocol):
    """Opens a bus by its name. It is injected into drivers, so that a test can supply memory buses."""

    async def __call__(self, name: str) -> AsyncBus:
        """Open ``name``.

        Raises:
            DeviceMissing: no such bus. DeviceRefused: permission, busy, not an I2C bus.
        """
        ...


def read(address: int, length: int) -> Message:
    """A message that reads ``length`` bytes."""
    return Message(address, length=length)


def write(address: int, data: bytes) -> Message:
    """A message that writes ``data``."""
    return Message(address, data)


def check(messages: tuple[Message, ...]) -> None:
    """Check the limits of i2c-dev, and the lengths that smbus2 would silently cut to 16 bits.

    Raises:
        OSError: EINVAL, with the violated limit as text.
    """
    if not 1 <= len(messages) <= MAX_MESSAGES:
        raise OSError(errno.EINVAL, f"{len(messages)} messages; a transaction must have 1 to {MAX_MESSAGES}")
    for message in messages:
        length = len(message.data) or message.length
        if not 0 <= message.address <= 0x7F:
            raise OSError(errno.EINVAL, f"address {message.address:#x}: 7 bits at most")
        if message.data and message.length:
            raise OSError(errno.EINVAL, "a message must either write or read")
        if not 1 <= length <= MAX_LENGTH:
            raise OSError(errno.EINVAL, f"{length} bytes; a message must have 1 to {MAX_LENGTH}")
