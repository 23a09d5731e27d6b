"""A bench for driver tests: the fake sensor in virtual time, or the real one named by ``--lidar`` in real time."""

import asyncio
from collections.abc import Awaitable, Callable
from contextlib import AbstractAsyncContextManager
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from hal.clock import Clock, LoopClock, SystemClock, run_virtual
from hal.errors import HalError
from hal.fake.faults.schedule import FaultSchedule
from hal.fake.lidar.device import FakeHokuyo
from hal.fake.lidar.models import UTM_30LX, LidarModel, Unit
from hal.fake.lidar.scan import FakeScan
from hal.fake.transport.memory_host import FakeOpener
from hal.hokuyo.driver import HokuyoDriver
from hal.lidar import RawScan
from hal.port.opening import open_port
from hal.port.port import PortOpener
from tests.hal.driven import played, running

PORT = "/dev/ttyACM7"  # a name that stands for USB; nothing is opened under it


class Scene:
    """A scan source that writes the number of the revolution into its first two beams, and remembers when it was."""

    def __init__(self, model: LidarModel) -> None:
        self.model = model
        self.starts: list[float] = []
        steps = np.arange(model.steps)
        self._base = (1500 + 300 * np.sin(steps / 50.0)).astype(np.int32)
        self._base[model.amin + 10] = 7  # an error code
        self._base[model.amin + 11] = min(model.dmax + 1, 262143)

    def __call__(self, start: float) -> FakeScan:
        ranges = self._base.copy()
        number = len(self.starts)
        ranges[self.model.amin : self.model.amin + 2] = 1000 + number % 1000, 1000 + number // 1000
        self.starts.append(start)
        return FakeScan(ranges, intensity=ranges // 2)

    def start_of(self, scan: RawScan) -> float:
        """True ``t_mono`` of step 0 of the revolution that a scan shows."""
        return self.starts[int(scan.ranges[0]) - 1000 + 1000 * (int(scan.ranges[1]) - 1000)]


@dataclass
class Bench:
    """What a test body gets. ``fake`` is None on a real device."""

    clock: Clock
    opener: PortOpener
    device: str
    fake: FakeHokuyo | None = None
    scene: Scene | None = None
    plugs: FakeOpener | None = None
    faults: FaultSchedule | None = None
    scans: list[RawScan] = field(default_factory=list)

    def driver(self, **options: object) -> HokuyoDriver:
        return HokuyoDriver(self.device, clock=self.clock, opener=self.opener, **options)  # type: ignore[arg-type]  # passed through

    async def say(self, *commands: bytes, pause: float = 0.2) -> None:
        """Another program opens the sensor, says something and leaves without a word of farewell."""
        port = await self.opener(self.device, 115200)
        port.start(lambda data, t_rx: None, lambda error: None)
        for command in commands:
            port.write(command)
            await asyncio.sleep(pause)
        port.close()
        await asyncio.sleep(0.01)

    async def deliver(self, driver: HokuyoDriver, count: int, within: float) -> list[RawScan]:
        """Run the driver until it has delivered ``count`` more scans; fails if that takes longer than ``within``."""
        async with self.running(driver):
            return await self.more(count, within, driver)

    async def more(self, count: int, within: float, driver: HokuyoDriver) -> list[RawScan]:
        before = len(self.scans)
        end = self.clock.now() + within
        while len(self.scans) < before + count:
            assert self.clock.now() < end, f"{len(self.scans) - before} of {count} scans; {driver.status}"
            await asyncio.sleep(0.005)
        return self.scans[before:]

    def running(self, driver: HokuyoDriver) -> AbstractAsyncContextManager[asyncio.Task[None]]:
        return running(driver.run(self.scans.append))

    def order(self, toml: str) -> None:
        """Put fault orders in force."""
        assert self.faults is not None
        self.faults.load(toml)


Body = Callable[[Bench], Awaitable[None]]


def on_fake(body: Body, model: LidarModel = UTM_30LX, unit: Unit | None = None, device: str = PORT) -> None:
    """Run a test body against the fake sensor in virtual time."""

    async def main() -> None:
        clock = LoopClock(asyncio.get_running_loop())
        scene = Scene(model)
        fake = FakeHokuyo(model, scene, unit=unit)
        plugs = FakeOpener(clock)
        plugs.plug(device, fake)
        faults = FaultSchedule({"lidar": fake})
        await body(Bench(clock, plugs, device, fake, scene, plugs, faults))
        faults.close()
        fake.close()

    run_virtual(main(), start=1000.0)


def faked(*where: Any, **how: Any) -> Callable[..., Callable[..., None]]:
    """A coroutine test on the fake sensor, in virtual time; arguments as of :func:`on_fake`."""
    return played(lambda body: on_fake(body, *where, **how))


def on_bench(body: Body, lidar: str, model: LidarModel = UTM_30LX, unit: Unit | None = None) -> None:
    """Run a test body against the fake sensor, or against the real one that ``--lidar`` names."""
    if lidar == "fake":
        on_fake(body, model, unit)
    else:
        asyncio.run(_on_device(body, lidar))


async def _on_device(body: Body, lidar: str) -> None:
    await body(Bench(SystemClock(), open_port, lidar))


def error_of(driver: HokuyoDriver) -> HalError:
    assert driver.status.error is not None
    return driver.status.error
