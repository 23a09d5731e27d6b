"""A real driver at a fake sensor in virtual time, and a witness that knows what the sensor really measured."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from hal.clock import LoopClock, run_virtual
from hal.fake.faults.schedule import FaultSchedule
from hal.fake.lidar.device import FakeHokuyo
from hal.fake.lidar.models import LidarModel, Unit
from hal.fake.lidar.scan import FakeScan
from hal.fake.transport.memory_host import FakeOpener
from hal.hokuyo.driver import HokuyoDriver
from hal.lidar import VALID, LidarGeometry, LidarStatus, Link, RawScan

DEVICES = {"usb": "/dev/ttyACM7", "rs232": "/dev/ttyUSB7", "ethernet": "tcp://192.168.0.10"}
"""Names that tell the driver the kind of line; nothing is opened under them but the fake."""
LOOK_S = 0.005
STAMP_S = 0.005
"""How far a stamp may be off the truth, seconds: a delay that comes a few seconds after the start may be taken for a
clock that is slow by the most a clock may be (1.5e-3) while it lasts, which makes 4.5 ms in the 3 s of these faults."""
COUNTERS = ("missed", "invalid", "resyncs", "reconnects", "clock_resets")


class World:
    """Scans that can be told apart and say when they were measured: a ramp of its own for every revolution."""

    def __init__(self, model: LidarModel) -> None:
        self._ramp = 1000 + np.arange(model.steps, dtype=np.int32)
        self._model = model
        self.starts: list[float] = []

    def __call__(self, t_mono: float) -> FakeScan:
        self.starts.append(t_mono)
        number = len(self.starts) - 1
        return FakeScan(self._ramp + np.int32(number % 2000), 200 + self._ramp)

    def number(self, scan: RawScan) -> int | None:
        """Which revolution a delivered scan is, to the bit; None when the sensor never measured that."""
        ramp = self._ramp[scan.first_step :: scan.stride]
        residue = int(scan.ranges[0]) - int(ramp[0])
        if not 0 <= residue < 2000 or not np.array_equal(scan.ranges - residue, ramp[: scan.ranges.size]):
            return None
        candidates = range(residue, len(self.starts), 2000)
        nearest = min(candidates, key=lambda k: abs(self.starts[k] - scan.t_mono), default=None)
        return nearest if scan.ranges.size == (self._model.steps - self._model.amin) // scan.stride else None

    def error_s(self, scan: RawScan) -> float:
        """How far the stamp of a scan is off: its first beam's time against the sensor's own."""
        number = self.number(scan)
        assert number is not None
        first_beam = (scan.first_step + 0.5 * (scan.stride - 1)) * self._model.true_period_s / self._model.ares
        return scan.t_mono - (self.starts[number] + first_beam)


@dataclass
class Look:
    """The driver's status at an instant."""

    t: float
    link: Link
    problem: str
    counters: dict[str, int]


@dataclass
class Story:
    """What happened in a run."""

    world: World
    status: LidarStatus
    t_fault: float
    t_lifted: float
    t_end: float
    scans: list[RawScan] = field(default_factory=list)
    looks: list[Look] = field(default_factory=list)
    struck: dict[str, int] = field(default_factory=dict)
    laser: bool = True
    stop_s: float = 0.0
    extra: dict[str, str] = field(default_factory=dict)
    geometry: LidarGeometry | None = None

    def rose(self, counter: str) -> int:
        """By how much a counter rose after the fault came."""
        before = [look.counters[counter] for look in self.looks if look.t <= self.t_fault]
        return self.looks[-1].counters[counter] - before[-1]

    @property
    def problems(self) -> list[str]:
        """What the driver said was wrong after the fault came, in order, each once."""
        return list(dict.fromkeys(look.problem for look in self.looks if look.t > self.t_fault and look.problem))

    def first_after(self, t: float) -> float:
        """Arrival of the first scan that was measured after ``t``."""
        return min((scan.t_rx for scan in self.scans if scan.t_mono > t), default=float("inf"))

    def longest_gap(self) -> float:
        """Between arrivals, from the fault to the end."""
        times = [scan.t_rx for scan in self.scans if scan.t_rx > self.t_fault - 0.5] + [self.t_end]
        return float(np.diff(times).max())


@dataclass(frozen=True)
class Run:
    """One experiment: the driver streams, the fault comes, is lifted, and the driver goes on until it is stopped.

    With ``after_s`` 0 the driver is stopped while the fault is still there.
    """

    model: LidarModel
    orders: str
    unit: Unit = field(default_factory=Unit)
    before_s: float = 4.0
    fault_s: float = 3.0
    after_s: float = 8.0
    intensity: bool = False
    from_start: bool = False
    """The orders hold before the driver opens the sensor for the first time."""


def play(run: Run) -> Story:
    """Carry a run out in virtual time."""

    async def main() -> Story:
        loop = asyncio.get_running_loop()
        clock = LoopClock(loop)
        world = World(run.model)
        device = FakeHokuyo(run.model, world, unit=run.unit)
        opener = FakeOpener(clock)
        name = DEVICES[run.model.link]
        opener.plug(name, device)
        driver = HokuyoDriver(name, clock=clock, opener=opener, intensity=run.intensity)
        t_fault = 0.0 if run.from_start else run.before_s
        story = Story(world, driver.status, t_fault, t_fault + run.fault_s, t_fault + run.fault_s + run.after_s)
        schedule = FaultSchedule({"lidar": device})
        if run.from_start:
            schedule.load(run.orders)
            await asyncio.sleep(0)
        task = loop.create_task(driver.run(story.scans.append))
        watcher = loop.create_task(_watch(story, driver.status, loop.time))
        if not run.from_start:
            await asyncio.sleep(run.before_s)
            schedule.load(run.orders)
        await asyncio.sleep(run.fault_s)
        if run.after_s:
            schedule.clear()
            await asyncio.sleep(run.after_s)
        watcher.cancel()
        story.extra, story.geometry = dict(driver.status.extra), driver.geometry
        stopped = loop.time()
        task.cancel()
        results = await asyncio.gather(watcher, task, return_exceptions=True)
        assert all(isinstance(result, asyncio.CancelledError) for result in results), results
        story.stop_s = loop.time() - stopped
        await asyncio.sleep(1.0)
        story.struck = device.orders.struck
        story.laser = device.laser
        schedule.close()
        device.close()
        return story

    return run_virtual(main())


async def _watch(story: Story, status: LidarStatus, now: Callable[[], float]) -> None:
    while True:
        counters = {name: getattr(status, name) for name in COUNTERS}
        problem = "" if status.error is None else status.error.problem
        story.looks.append(Look(now(), status.link, problem, counters))
        await asyncio.sleep(LOOK_S)


def falsehoods(story: Story) -> list[str]:
    """Everything delivered that the sensor had not measured, twice, out of order, or with a stamp that is off."""
    wrong: list[str] = []
    last = -1
    for scan in story.scans:
        number = story.world.number(scan)
        if number is None or not np.all(scan.code == VALID):
            wrong.append(f"at {scan.t_rx:.3f}: ranges the sensor never measured")
            continue
        if number <= last:
            wrong.append(f"at {scan.t_rx:.3f}: scan {number} after scan {last}")
        last = number
        error = story.world.error_s(scan)
        if abs(error) > STAMP_S:
            wrong.append(f"at {scan.t_rx:.3f}: stamp off by {1e3 * error:.1f} ms (sigma {1e3 * scan.t_sigma:.1f})")
    return wrong
