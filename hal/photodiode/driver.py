"""The driver of a photodiode's converter: reads block after block and comes back from all a bus or a chip can do.

What it does about trouble grows with every failure since the last good block: the transaction is tried again; a short
read makes a STOP and is discarded; the bus is closed and opened anew by name, and the chip looked at again. Waits grow
from 0.1 to 5 s, and it never gives up. Freeing a line that a chip holds low is left to the adapter's driver and to
whoever can switch the power: the error says so.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import random
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Final

from hal.adc import AdcStatus, Blemish, BusStuck, RawSamples, WrongChip
from hal.bus.i2c import AsyncBus, BusOpener, read, write
from hal.clock import Clock
from hal.errors import DeviceMissing, DeviceRefused, HalError
from hal.lidar import Link
from hal.photodiode.adapter_limits import Capability, measure
from hal.photodiode.bus_watchdog import HANG_S, WatchedBus
from hal.photodiode.chips import BlockChip, chip_named
from hal.photodiode.dc_channel import PERIOD_S, LevelInput, LevelMeter, ask
from hal.photodiode.diagnosis import Judge
from hal.photodiode.io_errors import explain, policy_for
from hal.photodiode.sampler import Sampler, describe
from hal.photodiode.stream_watch import Followed, Follower
from hal.photodiode.timebase import SLOWER
from hal.port.recovery import stay_connected

log = logging.getLogger(__name__)

_PAUSE_S: Final = (0.1, 5.0)
_ABSENT_PAUSE_S: Final = 1.0
_DESCRIBE_BLOCKS: Final = 20
_KEPT_S: Final = (5.0, 300.0)
"""How long what was measured of an adapter is kept in spite of doubts: doubling while they turn out unfounded."""


@dataclass(frozen=True, slots=True)
class Sampling:
    """How to sample.

    Attributes:
        block_s: seconds of a block, as far as the adapter can do it. level: the DC channel, if there is one.
    """

    block_s: float = 0.05
    level: LevelInput | None = None


class PhotodiodeAdc:
    """A :class:`hal.adc.Adc` for converters that are clocked by SCL.

    Args:
        bus: name of the bus, as the opener takes it. address: 7-bit address of the converter.
        chip: MCP3221, ADC121C021 or ADC121C027, in any case of letters.
        clock: the loop's. opener: opens buses (:func:`hal.bus.opening.open_bus`).
        sampling: length of blocks, DC channel.

    Raises:
        ValueError: a chip that is not known, or an address or block length it cannot have.
    """

    def __init__(
        self,
        bus: str,
        address: int,
        chip: str,
        *,
        clock: Clock,
        opener: BusOpener,
        sampling: Sampling = Sampling(),
    ) -> None:
        self._chip: BlockChip = chip_named(chip)
        if address not in self._chip.addresses:
            possible = ", ".join(f"{a:#04x}" for a in sorted(self._chip.addresses))
            raise ValueError(f"address {address:#04x}: a {self._chip.name} answers at one of {possible}")
        if not 0.001 <= sampling.block_s <= 1.0:
            raise ValueError(f"block_s {sampling.block_s:g}: expected 0.001 to 1 s")
        self._bus, self._address, self._opener = bus, address, opener
        self._block_s = sampling.block_s
        self._meter = LevelMeter(sampling.level, clock) if sampling.level else None
        self._status = AdcStatus()
        self._random = random.Random(bus + chip)
        self._seq = self._lost = 0
        self._faults = 0
        self._attempts = 0
        self._retries: dict[int, int] = {}
        self._told: set[str] = set()
        self._limit = ""
        self._kept_s = _KEPT_S[0]
        self._judge = Judge(bus, self._chip, address, self._level)

    @property
    def status(self) -> AdcStatus:
        """Live state and counters."""
        return self._status

    async def run(self, on_samples: Callable[[RawSamples], None]) -> None:
        """Deliver blocks until cancelled."""
        await stay_connected(self._status, partial(self._connection, on_samples), self._note, self._pause)

    async def _connection(self, on_samples: Callable[[RawSamples], None]) -> None:
        """Open, stream, recover on the open bus as long as that makes sense; raises to have it opened anew."""
        self._status.link = Link.OPENING
        bus = WatchedBus(await self._open(), self._block_s, self._explain, self._note_silence)
        listening = asyncio.create_task(bus.listen())
        found: Capability | None = None
        try:
            while True:
                try:
                    found = found or await self._prepare(bus)
                    await self._stream(bus, found, on_samples)
                    found = self._compare(found, await self._prepare(bus))
                except OSError as error:
                    await self._mend(bus, error)
        finally:
            listening.cancel()
            await bus.close()

    async def _open(self) -> AsyncBus:
        """Open the bus; an open that hangs in the kernel is told, and waited for: another try would hang as well."""
        opening = asyncio.ensure_future(self._opener(self._bus))
        try:
            await asyncio.wait({opening}, timeout=HANG_S)
            if not opening.done():
                problem = f"the bus has been opening for {HANG_S:g} s"
                remedy = "the adapter's driver hangs, or the bus server does: restart it, or the computer"
                self._note_silence(BusStuck(self._bus, problem, remedy), True)
            return await opening
        except asyncio.CancelledError:
            opening.cancel()
            (bus,) = await asyncio.gather(opening, return_exceptions=True)
            if not isinstance(bus, BaseException):  # it was open already
                await bus.close()
            raise

    async def _prepare(self, bus: AsyncBus) -> Capability:
        """Find the chip, make sure that it is the right one, and measure what the adapter can do."""
        if self._status.link is Link.STREAMING:
            self._status.link = Link.OPENING
        await bus.transfer((read(self._address, 2),))
        chip, address = self._chip, self._address
        problem = chip.judge(tuple([await ask(bus, address, query) for query in chip.queries]))
        if problem:
            raise WrongChip(
                self._bus, f"the chip at {address:#04x} is no {chip.name}: it {problem}", "check chip and address"
            )
        for message in chip.setup:
            await bus.transfer((write(address, message),))
        found = await measure(bus, address, self._block_s)
        if found.limit and found.limit != self._limit:
            log.warning(
                "%s: blocks of %d samples, not fit for decoding lights: %s", self._bus, found.length // 2, found.limit
            )
        self._limit = found.limit
        return found

    def _compare(self, before: Capability, now: Capability) -> Capability:
        """Learn from a second measurement how much doubts are worth here."""
        low, high = _KEPT_S
        same = (
            abs(now.scl_hz / before.scl_hz - 1.0) < SLOWER and abs(now.short_s - before.short_s) < SLOWER * now.span_s
        )
        self._kept_s = min(2.0 * self._kept_s, high) if same else low
        return now

    async def _stream(self, bus: AsyncBus, found: Capability, on_samples: Callable[[RawSamples], None]) -> None:
        """Stream until the adapter has to be measured again, or until something goes wrong, which is raised."""
        sampler = Sampler(self._chip, found, self._seq)

        def pass_on(followed: Followed) -> None:
            if followed.block.seq % _DESCRIBE_BLOCKS == 0:
                self._status.extra.update(describe(sampler, found, self._chip, bus.about))
            self._count(followed)
            on_samples(followed.block)

        follower = Follower(sampler, self._judge, pass_on, self._kept_s)
        jobs = [asyncio.create_task(bus.stream((read(self._address, found.length),), follower.take))]
        if self._meter is not None:
            jobs.append(asyncio.create_task(self._measure_level(bus, self._meter)))
        try:
            self._status.extra.update(describe(sampler, found, self._chip, bus.about))
            await follower.watch(jobs)
        finally:
            for job in jobs:
                job.cancel()
            await asyncio.gather(*jobs, return_exceptions=True)
            self._seq, self._lost = sampler.next_seq, self._status.dropped

    def _count(self, followed: Followed) -> None:
        """One block has come; what is wrong with the light, if anything, stays for as long as it is so."""
        status, block, error = self._status, followed.block, followed.error
        status.blocks += 1
        status.blemished += block.blemish != Blemish.NONE
        status.dropped = self._lost + followed.dropped
        status.link = Link.STREAMING
        if not followed.sound:
            return
        if self._faults:
            status.recoveries += 1
        self._faults = self._attempts = 0
        self._retries.clear()
        if error is not None:
            self._tell(error)
        elif self._told:
            self._told.clear()
            log.info("%s: %s at %#04x delivers again", self._bus, self._chip.name, self._address)
        status.error = error

    async def _measure_level(self, bus: AsyncBus, meter: LevelMeter) -> None:
        while True:
            await meter.update(bus)
            level = meter.level()
            self._status.extra["dc_level"] = meter.problem if level is None else f"{100 * level:.1f} %"
            await asyncio.sleep(PERIOD_S)

    def _level(self) -> float | None:
        return self._meter.level() if self._meter else None

    # trouble

    async def _mend(self, bus: AsyncBus, error: OSError) -> None:
        """Make ready for another try on the open bus, or raise to have it opened anew."""
        number = error.errno or 0
        policy = policy_for(error)
        tries = self._retries.get(number, 0)
        self._retries[number] = tries + 1
        self._faults += 1
        if tries >= policy.retries:
            raise self._explain(error) from error
        if policy.pause_s:
            await asyncio.sleep(policy.pause_s)
        if policy.calm:
            with contextlib.suppress(OSError):
                await bus.transfer((read(self._address, 2),))

    def _explain(self, error: OSError) -> HalError:
        return explain(error, self._bus, self._chip.name, self._address)

    def _note(self, error: HalError) -> None:
        """The bus has to be opened anew; keep why for the status."""
        self._attempts += 1
        self._note_silence(error, True)

    def _note_silence(self, error: HalError, certain: bool) -> None:
        """Nothing comes, whatever is being done about it."""
        self._status.link, self._status.error = Link.WAITING, error
        self._faults += 1
        if certain:
            self._tell(error)

    def _tell(self, error: HalError) -> None:
        """Log each kind of problem once, until good blocks come again; see `hal.hokuyo.driver` for the level."""
        if error.problem not in self._told:
            self._told.add(error.problem)
            log.info("photodiode: %s", error)

    def _pause(self) -> float:
        """Seconds until the bus is opened again: doubling, with jitter; longer for what only a person can change."""
        low, high = _PAUSE_S
        pause = min(low * 2.0 ** min(max(self._attempts - 1, 0), 10), high)
        if isinstance(self._status.error, DeviceMissing):
            pause = max(pause, _ABSENT_PAUSE_S)
        if isinstance(self._status.error, DeviceRefused):
            pause = high
        return pause * self._random.uniform(0.8, 1.0)
