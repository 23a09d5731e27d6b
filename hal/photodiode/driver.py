"""The driver of the photodiode's converter: reads sample blocks and recovers from failures of bus and chip.

Recovery escalates with each failure since the last good block: repeat the transaction; send a STOP with a short read;
reopen the bus by name and identify the chip again. Pauses grow from 0.1 to 5 s; the driver never gives up. It cannot
free a line that a chip holds low: the error asks a person to switch the power.
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
from hal.photodiode.adapter_limits import AdapterLimits, measure
from hal.photodiode.bus_watchdog import HANG_S, WatchedBus
from hal.photodiode.chips import BlockChip, chip_named
from hal.photodiode.dc_channel import FOREIGN, PERIOD_S, LevelInput, LevelMeter, read_register
from hal.photodiode.diagnosis import BlockDiagnosis
from hal.photodiode.io_errors import explain, policy_for
from hal.photodiode.sampler import Sampler, describe
from hal.photodiode.stream_watch import CheckedBlock, StreamWatch
from hal.photodiode.timebase import SLOWER
from hal.port.recovery import stay_connected

log = logging.getLogger(__name__)

_PAUSE_S: Final = (0.1, 5.0)
_ABSENT_PAUSE_S: Final = 1.0
_DESCRIBE_BLOCKS: Final = 20
_KEPT_S: Final = (5.0, 300.0)
"""A doubted measurement of the adapter is kept this long (s): doubled while a new measurement confirms it."""


@dataclass(frozen=True, slots=True)
class Sampling:
    """Sampling options.

    Attributes:
        block_s: wanted duration of a block, s. level: the DC channel; None: not fitted.
    """

    block_s: float = 0.05
    level: LevelInput | None = None


class PhotodiodeAdc:
    """A :class:`hal.adc.Adc` for converters that are clocked by SCL.

    Args:
        bus: name of the bus for the opener. address: 7-bit address of the converter.
        chip: MCP3221, ADC121C021 or ADC121C027, in any case of letters.
        clock: the loop's. opener: opens buses (:func:`hal.bus.opening.open_bus`).
        sampling: length of blocks, DC channel.

    Raises:
        ValueError: an unknown chip, or an impossible address or block length.
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
            raise ValueError(f"address {address:#04x}: an {self._chip.name} has one of the addresses {possible}")
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
        self._logged: set[str] = set()
        self._limit = ""
        self._kept_s = _KEPT_S[0]
        self._diagnosis = BlockDiagnosis(bus, self._chip, address, self._level)

    @property
    def status(self) -> AdcStatus:
        """Live state and counters."""
        return self._status

    async def run(self, on_samples: Callable[[RawSamples], None]) -> None:
        """Deliver blocks until cancelled."""
        await stay_connected(self._status, partial(self._connection, on_samples), self._note, self._pause)

    async def _connection(self, on_samples: Callable[[RawSamples], None]) -> None:
        """Open, stream, and recover on the open bus; raises when the bus must be reopened."""
        self._status.link = Link.OPENING
        bus = WatchedBus(await self._open(), self._block_s, self._explain, self._note_silence)
        watching = asyncio.create_task(bus.watch())
        found: AdapterLimits | None = None
        try:
            while True:
                try:
                    found = found or await self._prepare(bus)
                    await self._stream(bus, found, on_samples)
                    found = self._compare(found, await self._prepare(bus))
                except OSError as error:
                    await self._mend(bus, error)
        finally:
            watching.cancel()
            await bus.close()

    async def _open(self) -> AsyncBus:
        """Open the bus; an open that hangs in the kernel is reported and awaited: another attempt would hang, too."""
        opening = asyncio.ensure_future(self._opener(self._bus))
        try:
            await asyncio.wait({opening}, timeout=HANG_S)
            if not opening.done():
                problem = f"opening the bus has taken {HANG_S:g} s"
                remedy = "the adapter's driver or the bus server does not respond; restart it, or the computer"
                self._note_silence(BusStuck(self._bus, problem, remedy), True)
            return await opening
        except asyncio.CancelledError:
            opening.cancel()
            (bus,) = await asyncio.gather(opening, return_exceptions=True)
            if not isinstance(bus, BaseException):  # the open had succeeded
                await bus.close()
            raise

    async def _prepare(self, bus: AsyncBus) -> AdapterLimits:
        """Identify the chip, set it up, and measure the adapter."""
        if self._status.link is Link.STREAMING:
            self._status.link = Link.OPENING
        await bus.transfer((read(self._address, 2),))
        chip, address = self._chip, self._address
        problem = chip.mismatch(tuple([await read_register(bus, address, query) for query in chip.queries]))
        if problem:
            raise WrongChip(
                self._bus,
                f"the converter at {address:#04x} is not an {chip.name}: it {problem}",
                "check converter type and address",
            )
        for message in chip.setup:
            await bus.transfer((write(address, message),))
        found = await measure(bus, address, self._block_s)
        if found.limit and found.limit != self._limit:
            log.warning(
                "%s: blocks of %d samples cannot be used to decode lamps: %s", self._bus, found.length // 2, found.limit
            )
        self._limit = found.limit
        return found

    def _compare(self, before: AdapterLimits, now: AdapterLimits) -> AdapterLimits:
        """Compare two measurements of the adapter: equal ones lengthen the time for which doubts are ignored."""
        low, high = _KEPT_S
        same = (
            abs(now.scl_hz / before.scl_hz - 1.0) < SLOWER and abs(now.short_s - before.short_s) < SLOWER * now.span_s
        )
        self._kept_s = min(2.0 * self._kept_s, high) if same else low
        return now

    async def _stream(self, bus: AsyncBus, found: AdapterLimits, on_samples: Callable[[RawSamples], None]) -> None:
        """Stream until the adapter must be measured again; raises the error that ends the stream."""
        sampler = Sampler(self._chip, found, self._seq)

        def pass_on(checked: CheckedBlock) -> None:
            if checked.block.seq % _DESCRIBE_BLOCKS == 0:
                self._status.extra.update(describe(sampler, found, self._chip, bus.about))
            self._count(checked)
            on_samples(checked.block)

        watch = StreamWatch(sampler, self._diagnosis, pass_on, self._kept_s)
        jobs = [asyncio.create_task(bus.stream((read(self._address, found.length),), watch.receive))]
        if self._meter is not None:
            jobs.append(asyncio.create_task(self._measure_level(bus, self._meter)))
        try:
            self._status.extra.update(describe(sampler, found, self._chip, bus.about))
            await watch.watch(jobs)
        finally:
            for job in jobs:
                job.cancel()
            await asyncio.gather(*jobs, return_exceptions=True)
            self._seq, self._lost = sampler.next_seq, self._status.dropped

    def _count(self, checked: CheckedBlock) -> None:
        """Update the status for one block; a light condition stays in it while it lasts."""
        status, block, error = self._status, checked.block, checked.error
        status.blocks += 1
        status.blemished += block.blemish != Blemish.NONE
        status.dropped = self._lost + checked.dropped
        status.link = Link.STREAMING
        if not checked.sound:
            return
        if self._faults:
            status.recoveries += 1
        self._faults = self._attempts = 0
        self._retries.clear()
        if error is not None:
            self._log_once(error)
        elif self._logged:
            self._logged.clear()
            log.info("%s: %s at %#04x delivers samples again", self._bus, self._chip.name, self._address)
        status.error = error

    async def _measure_level(self, bus: AsyncBus, meter: LevelMeter) -> None:
        while True:
            await meter.update(bus)
            level = meter.level()
            shown = meter.problem if level is None else f"{100 * level:.1f} %"
            shared = level is not None and meter.shared
            self._status.extra["dc_level"] = f"{shown} ({FOREIGN})" if shared else shown
            await asyncio.sleep(PERIOD_S)

    def _level(self) -> float | None:
        return self._meter.level() if self._meter else None

    # failures

    async def _mend(self, bus: AsyncBus, error: OSError) -> None:
        """Prepare another attempt on the open bus, or raise when the bus must be reopened."""
        number = error.errno or 0
        policy = policy_for(error)
        tries = self._retries.get(number, 0)
        self._retries[number] = tries + 1
        self._faults += 1
        if tries >= policy.retries:
            raise self._explain(error) from error
        if policy.pause_s:
            await asyncio.sleep(policy.pause_s)
        if policy.send_stop:
            with contextlib.suppress(OSError):
                await bus.transfer((read(self._address, 2),))

    def _explain(self, error: OSError) -> HalError:
        return explain(error, self._bus, self._chip.name, self._address)

    def _note(self, error: HalError) -> None:
        """Store why the bus must be reopened."""
        self._attempts += 1
        self._note_silence(error, True)

    def _note_silence(self, error: HalError, certain: bool) -> None:
        """Store a silence or failure in the status; ``certain``: log it, too."""
        self._status.link, self._status.error = Link.WAITING, error
        self._faults += 1
        if certain:
            self._log_once(error)

    def _log_once(self, error: HalError) -> None:
        """Log each problem once, until good blocks arrive; see `hal.hokuyo.driver` for the level."""
        if error.problem not in self._logged:
            self._logged.add(error.problem)
            log.info("photodiode: %s", error)

    def _pause(self) -> float:
        """Seconds until the bus is reopened: doubling, with jitter; longer where only a person can act."""
        low, high = _PAUSE_S
        pause = min(low * 2.0 ** min(max(self._attempts - 1, 0), 10), high)
        if isinstance(self._status.error, DeviceMissing):
            pause = max(pause, _ABSENT_PAUSE_S)
        if isinstance(self._status.error, DeviceRefused):
            pause = high
        return pause * self._random.uniform(0.8, 1.0)
