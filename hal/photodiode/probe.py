"""Identifies the converters on this computer's I2C buses without changing any register (``lumiloop probe``).

At each address two bytes are read. If a chip acknowledges, some of its registers are read, for which a pointer is
written; no register is. Only the possible addresses of the supported converters are used.
"""

from __future__ import annotations

import errno
import os
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

from hal.bus.i2c import NACKS, AsyncBus, BusOpener, read
from hal.errors import HalError
from hal.photodiode import adc121c021, ads1x15, mcp3221
from hal.photodiode.chips import Query
from hal.photodiode.dc_channel import read_register
from hal.photodiode.io_errors import explain

ADDRESSES: Final = tuple(sorted(mcp3221.ADDRESSES | ads1x15.ADDRESSES | adc121c021.ADC121C021.addresses))
_ELSE: Final = "an unsupported device"
_FATAL: Final = frozenset({errno.ETIMEDOUT, errno.ENODEV, errno.ESHUTDOWN, errno.EACCES, errno.EPERM})
"""Errnos after which the other addresses of the bus are not tried."""


@dataclass(frozen=True, slots=True)
class Chip:
    """A chip that answers.

    Attributes:
        address: 7 bits. name: MCP3221, ADC121C021, ``ADS1015 or ADS1115``; empty for anything else.
        usable: lights can be decoded with it (else it gives levels, or nothing). problem: why it is not identified.
    """

    address: int
    name: str = ""
    usable: bool = False
    problem: str = ""

    def __str__(self) -> str:
        level = "" if self.usable or not self.name else " (levels only: the DC channel)"
        return f"{self.address:#04x}: {self.name or self.problem or _ELSE}{level}"


@dataclass(frozen=True, slots=True)
class BusFinding:
    """The result of one bus.

    Attributes:
        bus: its name for a driver. adapter: its own name. chips: in order of their addresses.
        error: why the bus, or the rest of it, could not be probed; with a remedy.
    """

    bus: str
    adapter: str = ""
    chips: tuple[Chip, ...] = ()
    error: HalError | None = None

    def __str__(self) -> str:
        title = f"{self.bus}: {self.adapter}" if self.adapter else self.bus
        lines = [title, *(f"  {chip}" for chip in self.chips)]
        if self.error is not None:
            lines.append(f"  {self.error}")
        elif not self.chips:
            lines.append("  no converter answers; check its power, SDA and SCL")
        return "\n".join(lines)


async def probe_buses(opener: BusOpener, buses: Sequence[str]) -> list[BusFinding]:
    """Probe each bus; errors of a bus are returned, not raised.

    Args:
        opener: opens buses (:func:`hal.bus.opening.open_bus`).
        buses: their names; those of this computer are :func:`hal.bus.i2c_linux.buses`.
    """
    return [await probe_bus(opener, bus) for bus in buses]


async def probe_bus(opener: BusOpener, name: str) -> BusFinding:
    """Probe one bus."""
    try:
        bus = await opener(name)
    except HalError as error:
        return BusFinding(name, error=error)
    chips: list[Chip] = []
    try:
        for address in ADDRESSES:
            chip = await _probe_address(bus, address)
            if chip is not None:
                chips.append(chip)
    except OSError as error:
        return BusFinding(name, bus.about, tuple(chips), explain(error, name, "converter", address))
    finally:
        await bus.close()
    return BusFinding(name, bus.about, tuple(chips))


async def _probe_address(bus: AsyncBus, address: int) -> Chip | None:
    """The chip at an address; None: none. Raises `OSError` where the bus itself is at fault."""
    try:
        await bus.transfer((read(address, 2),))
        return await _identify(bus, address)
    except OSError as error:
        if error.errno in _FATAL:
            raise
        if error.errno in NACKS or error.errno == errno.EIO:
            return None
        busy = "in use by another program or a kernel driver; end or unbind it first"
        return Chip(address, problem=busy if error.errno == errno.EBUSY else os.strerror(error.errno or 0))


async def _identify(bus: AsyncBus, address: int) -> Chip:
    async def answers(queries: Sequence[Query]) -> tuple[bytes | None, ...]:
        return tuple([await read_register(bus, address, query) for query in queries])

    if address in ads1x15.ADDRESSES and not ads1x15.mismatch(await answers(ads1x15.QUERIES)):
        return Chip(address, "ADS1015 or ADS1115")
    chip = mcp3221.CHIP if address in mcp3221.ADDRESSES else adc121c021.ADC121C021
    replies = await answers(chip.queries)
    if chip is mcp3221.CHIP and replies != (None,):  # others may have zeros there, too; an MCP3221 accepts no data
        return Chip(address)
    return Chip(address) if chip.mismatch(replies) else Chip(address, chip.name, usable=True)
