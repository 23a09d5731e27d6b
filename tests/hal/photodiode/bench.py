"""A bench for converter tests: the fake in virtual time, or the real one named by ``--adc`` in real time."""

import asyncio
from collections.abc import Awaitable, Callable
from contextlib import AbstractAsyncContextManager
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from hal.adc import Blemish, RawSamples
from hal.bus.i2c import BusOpener
from hal.bus.opening import open_bus
from hal.clock import Clock, LoopClock, SystemClock, run_virtual
from hal.errors import HalError
from hal.fake.adc.converter import FakeAdc, FakeBuses
from hal.fake.adc.i2c_adapters import BCM2835, Adapter
from hal.fake.faults.schedule import FaultSchedule
from hal.photodiode.driver import PhotodiodeAdc, Sampling
from tests.hal.driven import played, running

BUS = "/dev/i2c-7"  # a name only; nothing is opened under it
Array = npt.NDArray[np.float64]


class Light:
    """A signal that never repeats, and a memory of when it was converted."""

    def __init__(self) -> None:
        self.asked: list[Array] = []

    def __call__(self, t_mono: Array) -> Array:
        if t_mono.size > 20:
            self.asked.append(t_mono.copy())
        return self.at(t_mono)

    @staticmethod
    def at(t_mono: Array) -> Array:
        slow = 0.25 * np.sin(2 * np.pi * 0.0371 * t_mono) + 0.15 * np.sin(2 * np.pi * 100.0 * t_mono)
        return np.asarray(0.5 + slow + 0.08 * np.sin(2 * np.pi * 2611.7 * t_mono + 0.3 * np.sin(t_mono)))

    def times_of(self, block: RawSamples) -> Array | None:
        """When the words of a block were converted, to the bit; None when the converter never measured that."""
        for times in reversed(self.asked):
            if times[0] > block.t1 or times[-1] < block.t0:
                continue
            codes = np.clip(np.floor(4096.0 * self.at(times)), 0, 4095).astype(np.uint16)
            for skipped in (0, 1):
                if np.array_equal(codes[skipped : skipped + block.words.size], block.words):
                    return np.asarray(times[skipped:])
        return None


@dataclass
class Bench:
    """What a test body gets. ``fake`` and what belongs to it are None on a real device."""

    clock: Clock
    opener: BusOpener
    bus: str = BUS
    address: int = 0x4D
    chip: str = "MCP3221"
    light: Light = field(default_factory=Light)
    blocks: list[RawSamples] = field(default_factory=list)
    fake: FakeAdc | None = None
    faults: FaultSchedule | None = None

    def driver(self, sampling: Sampling | None = None) -> PhotodiodeAdc:
        return PhotodiodeAdc(
            self.bus, self.address, self.chip, clock=self.clock, opener=self.opener, sampling=sampling or Sampling()
        )

    def running(self, driver: PhotodiodeAdc) -> AbstractAsyncContextManager[asyncio.Task[None]]:
        return running(driver.run(self.blocks.append))

    async def more(self, count: int, within: float, driver: PhotodiodeAdc) -> list[RawSamples]:
        """Wait for ``count`` more blocks; fails if that takes longer than ``within``."""
        before, end = len(self.blocks), self.clock.now() + within
        while len(self.blocks) < before + count:
            assert self.clock.now() < end, f"{len(self.blocks) - before} of {count} blocks; {driver.status}"
            await asyncio.sleep(0.005)
        return self.blocks[before:]

    def order(self, toml: str) -> None:
        """Put fault orders in force; several keys separated by semicolons."""
        assert self.faults is not None
        self.faults.load("[[fault]]\n" + toml.replace("; ", "\n"))

    @property
    def device(self) -> FakeAdc:
        assert self.fake is not None
        return self.fake


Body = Callable[[Bench], Awaitable[None]]


def on_fake(body: Body, chip: str = "MCP3221", address: int = 0x4D, adapter: Adapter = BCM2835, seed: int = 0) -> None:
    """Run a test body against the fake converter in virtual time."""

    async def main() -> None:
        clock = LoopClock(asyncio.get_running_loop())
        light = Light()
        fake = FakeAdc(light, clock, chip=chip, address=address, adapter=adapter, seed=seed)
        buses = FakeBuses(clock)
        buses.plug(BUS, fake)
        faults = FaultSchedule({"adc": fake})
        await body(Bench(clock, buses, BUS, address, chip, light, [], fake, faults))
        faults.close()

    run_virtual(main(), start=1000.0)


def faked(*where: Any, **how: Any) -> Callable[..., Callable[..., None]]:
    """A coroutine test on the fake converter, in virtual time; arguments as of :func:`on_fake`."""
    return played(lambda body: on_fake(body, *where, **how))


def on_bench(body: Body, adc: str) -> None:
    """Run a test body against the fake converter, or against the real one: ``BUS@ADDRESS[,CHIP]``."""
    if adc == "fake":
        on_fake(body)
        return
    bus, _, rest = adc.rpartition("@")
    address, _, chip = rest.partition(",")
    bench = Bench(SystemClock(), open_bus, bus, int(address, 0), chip or "MCP3221")

    async def main() -> None:
        await body(bench)

    asyncio.run(main())


def error_of(driver: PhotodiodeAdc) -> HalError:
    assert driver.status.error is not None
    return driver.status.error


TRUE_S = 5e-6
"""How far the bounds of a time may be off: jitter of what was measured, and the opening of the sample switch."""
DAMAGED = Blemish.MISALIGNED | Blemish.STUCK | Blemish.CLIPPED | Blemish.SHORT | Blemish.REPAIRED

DARK_WORDS = 2.0
"""The bench's light swings by hundreds of words: a block below this was ordered to be dark."""


def falsehoods(bench: Bench, blocks: list[RawSamples], rate_error: float = 1e-3, late_s: float = TRUE_S) -> list[str]:
    """Everything delivered without a blemish that was never converted, out of order, or with a time that is off.

    ``rate_error`` is how far a rate may be off, ``late_s`` how far a time may be out of its bounds: on a computer with
    other work the first measurement is rough.
    """
    wrong: list[str] = []
    last = -1
    for block in blocks:
        if block.seq <= last:
            wrong.append(f"block {block.seq} after {last}")
        last = block.seq
        if block.blemish & DAMAGED or block.words.std() < DARK_WORDS:
            continue
        times = bench.light.times_of(block)
        if times is None:
            wrong.append(f"block {block.seq} ({block.blemish}): words never converted")
            continue
        off = times[0] - block.t_first
        if not -late_s <= off <= block.slack_s + late_s:
            wrong.append(
                f"block {block.seq}: first conversion {1e6 * off:.0f} us late, slack {1e6 * block.slack_s:.0f}"
            )
        rate = (times.size - 1) / (times[-1] - times[0])
        if not block.blemish & Blemish.STRETCHED and abs(block.rate_hz / rate - 1.0) > rate_error:
            wrong.append(f"block {block.seq}: rate {block.rate_hz:.1f}, true {rate:.1f}")
    return wrong
