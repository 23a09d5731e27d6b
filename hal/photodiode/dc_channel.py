"""The optional DC channel: the mean light at the amplifier, which distinguishes darkness from saturation.

The photodiode's signal path is AC-coupled, so that both look alike there. An ADS1015 or ADS1115 on the same bus
measures the amplifier's output before the coupling capacitor, twice a second, between two blocks. Its failures do not
affect the sampling.
"""

from __future__ import annotations

import asyncio
import errno
import logging
import math
from dataclasses import dataclass
from typing import Final

from hal.bus.i2c import NACKS, AsyncBus, read, write
from hal.clock import Clock
from hal.photodiode import ads1x15
from hal.photodiode.chips import Query

log = logging.getLogger(__name__)

_NOT_ACKNOWLEDGED: Final = NACKS | {errno.EIO}
_LAYOUT: Final = frozenset({errno.EOPNOTSUPP, errno.EINVAL})
"""Errnos of an adapter that joins a read to short writes only (FT260: two bytes)."""
_ATTEMPTS: Final = 3
PERIOD_S: Final = 0.5
"""Shorter than the time for which a light condition must last: a reported condition rests on a recent level."""
STALE_S: Final = 3.0
SETTLE_S: Final = 0.02
"""From a new configuration to its first result: two conversions at 128 samples/s with a clock 10 % slow."""
_SLOW: Final = 1.12
"""Longest conversion over its nominal duration: a running one of another program's is completed first."""
CALM_S: Final = 60.0
"""A problem is over, and is logged anew, after it has been absent for this long (s)."""
FOREIGN: Final = (
    "another program changes the configuration of the converter; end that program, or use separate converters"
)


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
        self._level, self._t_read = 0.0, -math.inf
        self._t_foreign = -math.inf
        self._set = False
        rates = ads1x15.RATES[where.chip.upper()]
        self._settle_s = SETTLE_S + _SLOW / min(rates)
        self._logged: dict[str, float] = {}
        self.problem = "not read yet"

    def level(self) -> float | None:
        """Mean light as a fraction of the amplifier's full scale; None where unknown."""
        return self._level if self._clock.now() - self._t_read <= STALE_S else None

    @property
    def shared(self) -> bool:
        """Whether another program has changed the chip's configuration lately."""
        return self._clock.now() - self._t_foreign < CALM_S

    async def update(self, bus: AsyncBus) -> None:
        """Check the chip's configuration, read the level once, and check the configuration again."""
        try:
            problem = await self._measure(bus)
        except OSError as error:
            problem = f"{error.strerror or error}"
        for text in {problem, FOREIGN if self.shared else ""} - {""}:
            self._log(bus, text)
        self.problem = problem

    def _log(self, bus: AsyncBus, text: str) -> None:
        """Log a problem once, until it has been absent for :data:`CALM_S`."""
        now = self._clock.now()
        if now - self._logged.get(text, -math.inf) > CALM_S:
            where = self._where
            log.warning("%s: DC channel %s at %#04x: %s", bus.name, where.chip, where.address, text)
        self._logged[text] = now

    async def _measure(self, bus: AsyncBus) -> str:
        """Read the level; returns the problem where it is not trustworthy."""
        if not await self._is_ours(bus):
            problem = await self._set_up(bus)
            if problem:
                return problem
        answer = await read_register(bus, self._where.address, ads1x15.RESULT)
        if answer is None:
            return "does not answer"
        if not await self._is_ours(bus):  # the result may be that of another input
            return FOREIGN if self.shared else "has lost its configuration"
        volts = ads1x15.fraction(answer) * self._wanted.full_scale_v
        where = self._where
        self._level, self._t_read = (volts - where.rest_v) / (where.full_scale_v - where.rest_v), self._clock.now()
        return ""

    async def _is_ours(self, bus: AsyncBus) -> bool:
        """Read the configuration back; one that is neither ours nor that after a reset is another program's."""
        answer = await read_register(bus, self._where.address, ads1x15.READ_BACK)
        if answer is None or ads1x15.same_configuration(answer, self._wanted):
            return answer is not None
        if self._set and not ads1x15.after_reset(answer):
            self._t_foreign = self._clock.now()
        return False

    async def _set_up(self, bus: AsyncBus) -> str:
        address = self._where.address
        problem = ads1x15.mismatch(tuple([await read_register(bus, address, query) for query in ads1x15.QUERIES]))
        if problem:
            return problem
        if not ads1x15.same_configuration(await self._write(bus), self._wanted):
            return "does not keep its configuration, so it is another kind of converter"
        settled_s = SETTLE_S if self._set and not self.shared else self._settle_s
        self._set = True
        await asyncio.sleep(settled_s)
        return ""

    async def _write(self, bus: AsyncBus) -> bytes:
        """Write the configuration and read it back; no other program comes between where the adapter can join both."""
        address, message = self._where.address, self._wanted.message()
        try:
            return (await bus.transfer((write(address, message), read(address, 2)))).reads[0]
        except OSError as error:
            if error.errno not in _LAYOUT:
                raise
        await bus.transfer((write(address, message),))
        return await read_register(bus, address, ads1x15.READ_BACK) or b""
