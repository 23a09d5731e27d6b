"""The optional DC channel: the mean light at the amplifier, which distinguishes darkness from saturation.

The photodiode's signal path is AC-coupled, so that both look alike there. An ADS1015 or ADS1115 on the same bus
measures the amplifier's output before the coupling capacitor, twice a second, between two blocks. Its failures do not
affect the sampling.
"""

from __future__ import annotations

import asyncio
import errno
import logging
from dataclasses import dataclass
from typing import Final

from hal.bus.i2c import NACKS, AsyncBus, read, write
from hal.clock import Clock
from hal.photodiode import ads1x15
from hal.photodiode.chips import Query

log = logging.getLogger(__name__)

_NOT_ACKNOWLEDGED: Final = NACKS | {errno.EIO}
_ATTEMPTS: Final = 3
PERIOD_S: Final = 0.5
"""Shorter than the time for which a light condition must last: a reported condition rests on a recent level."""
STALE_S: Final = 3.0
SETTLE_S: Final = 0.02
"""From a new configuration to its first result: two conversions at 128 samples/s with a clock 10 % slow."""


@dataclass(frozen=True, slots=True)
class LevelInput:
    """Configuration of the DC channel.

    Attributes:
        chip: ADS1015 or ADS1115. address: 0x48 to 0x4B. channel: 0 to 3.
        full_scale_v: output of the saturated amplifier, V: level 1.
        rest_v: its output without light, V: level 0 (docs/receiver.md biases it to 0.1 V).

    Raises:
        ValueError: a field out of range.
    """

    chip: str = "ADS1115"
    address: int = 0x48
    channel: int = 0
    full_scale_v: float = 3.3
    rest_v: float = 0.1

    def __post_init__(self) -> None:
        if self.chip.upper() not in ads1x15.RATES:
            raise ValueError(f"DC channel {self.chip}: expected ADS1015 or ADS1115")
        if self.address not in ads1x15.ADDRESSES:
            raise ValueError(f"DC channel at {self.address:#04x}: an {self.chip} answers at 0x48 to 0x4b")
        if not 0 <= self.channel <= 3:
            raise ValueError(f"DC channel {self.channel}: expected 0 to 3")
        if not 0.0 < self.full_scale_v <= ads1x15.RANGES_V[0]:
            raise ValueError(f"DC channel of {self.full_scale_v:g} V: expected up to {ads1x15.RANGES_V[0]:g} V")
        if not 0.0 <= self.rest_v < self.full_scale_v:
            raise ValueError(f"DC channel at rest at {self.rest_v:g} V: expected 0 to {self.full_scale_v:g} V")


async def read_register(bus: AsyncBus, address: int, query: Query) -> bytes | None:
    """Read a register; None where the chip never acknowledges, or never returns all bytes, in three attempts.

    Raises:
        OSError: any other error; EIO counts as a missing acknowledgement, the only error of some adapters.
    """
    for _ in range(_ATTEMPTS):
        try:
            done = await bus.transfer((write(address, query.select), read(address, query.length)))
        except OSError as error:
            if error.errno not in _NOT_ACKNOWLEDGED:
                raise
        else:
            if len(done.reads[0]) == query.length:
                return done.reads[0]
    return None


class LevelMeter:
    """Reads the DC channel; failures of the chip are stored, not raised.

    Args:
        where: the chip and its input. clock: the loop's.

    Attributes:
        problem: why the level is missing; empty where it is known.
    """

    def __init__(self, where: LevelInput, clock: Clock) -> None:
        self._where, self._clock = where, clock
        pga = max(code for code, volts in enumerate(ads1x15.RANGES_V) if volts >= where.full_scale_v)
        self._wanted = ads1x15.Configuration(channel=where.channel, pga=pga)
        self._level, self._t_read = 0.0, float("-inf")
        self.problem = "not read yet"

    def level(self) -> float | None:
        """Mean light as a fraction of the amplifier's full scale; None where unknown."""
        return self._level if self._clock.now() - self._t_read <= STALE_S else None

    async def update(self, bus: AsyncBus) -> None:
        """Check the chip's configuration and read the level once."""
        try:
            problem = await self._read(bus) if await self._configured(bus) else await self._set_up(bus)
        except OSError as error:
            problem = f"{error.strerror or error}"
        if problem and problem != self.problem:
            log.warning("%s: DC channel %s at %#04x: %s", bus.name, self._where.chip, self._where.address, problem)
        self.problem = problem

    async def _configured(self, bus: AsyncBus) -> bool:
        answer = await read_register(bus, self._where.address, ads1x15.READ_BACK)
        return answer is not None and ads1x15.same_configuration(answer, self._wanted)

    async def _set_up(self, bus: AsyncBus) -> str:
        address = self._where.address
        problem = ads1x15.mismatch(tuple([await read_register(bus, address, query) for query in ads1x15.QUERIES]))
        if problem:
            return problem
        await bus.transfer((write(address, self._wanted.message()),))
        if not await self._configured(bus):
            return "does not keep its configuration: another kind of chip"
        await asyncio.sleep(SETTLE_S)
        return await self._read(bus)

    async def _read(self, bus: AsyncBus) -> str:
        answer = await read_register(bus, self._where.address, ads1x15.RESULT)
        if answer is None:
            return "does not answer"
        volts = ads1x15.fraction(answer) * self._wanted.full_scale_v
        where = self._where
        self._level, self._t_read = (volts - where.rest_v) / (where.full_scale_v - where.rest_v), self._clock.now()
        return ""
