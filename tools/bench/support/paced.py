"""A daemon of its own process that is fed 40 times a second by a kernel timer, and says how late its cycles begin.

    python -m tools.bench.support.paced TELL        one JSON object with what is wanted; the outcome goes to standard
    output

When the drive is over it says so and waits for a line, or the end, of standard input: who asks it ends before it does.

It is the whole of `daemon.app.Daemon`, publishers and threads included; only the sensors' wires are left out. In turn
for a while it runs *alone* and *loaded*: readers and a stuck client (the parent's), and the graph of 1000 submaps
being solved without a pause (its own).
"""

import asyncio
import json
import logging
import os
import pickle
import sys
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from daemon.app import Daemon, Environment
from daemon.config.schema import Config, LidarConfig, ModbusConfig, Mount, OdometryConfig, PhotodiodeConfig, PoseConfig
from daemon.devices.light_setup import Lights
from daemon.runtime.stall_watch import StallWatch
from daemon.runtime.warmup import warm_up
from daemon.runtime.worker import ThreadWorker
from daemon.system.realtime import give_back
from estimator.cdma.air_interface import PROFILE_A
from estimator.mapping.loop_closure import solve_graph
from estimator.measurements import Answer, Job
from estimator.pipeline import new_state
from hal.adc import AdcStatus, RawSamples
from hal.blocking_calls import run_in_thread
from hal.bus.i2c import BusOpener
from hal.clock import Clock, SystemClock
from hal.lidar import LidarGeometry, LidarStatus, Link, RawScan
from hal.port.port import PortOpener
from hal.timerfd import timer
from tools.bench.support.drive import PERIOD_S, Delivery
from tools.bench.support.first import first_in_line
from tools.bench.support.old_map import SUBMAPS, old_map
from tools.sim.ports import free_port

SETTLE_S: Final = 8.0
SHIFT_S: Final = 2e-4
"""What it takes at most to set the stamps of what is delivered at once."""


@dataclass(slots=True)
class Wanted:
    """What the parent asks for.

    ``turns``: pairs of a stretch alone and one loaded, each of ``stretch_s``, every other pair the other way round.
    ``solve``: loaded with the graph, too. ``change_s``: from each change so many seconds do not count. ``quiet``: each
    pair has a third stretch in which the computer has nothing else to do.
    """

    drive: str
    stream: str
    modbus: int
    receiver: str
    fifo: bool
    turns: int
    stretch_s: float
    solve: bool = True
    change_s: float = 0.0
    quiet: bool = False

    @property
    def stretches(self) -> tuple[str, ...]:
        """Two turns of them."""
        turn = ("quiet", "alone", "loaded") if self.quiet else ("alone", "loaded")
        return turn + turn[::-1]


def by_stretch() -> dict[str, list[Any]]:
    """An empty list for each kind of stretch."""
    return {"quiet": [], "alone": [], "loaded": []}


@dataclass(slots=True)
class Told:
    """What comes back: microseconds, by stretch; ``pair``: of each cycle, the number of its pair of stretches."""

    late: dict[str, list[float]] = field(default_factory=by_stretch)
    cycle: dict[str, list[float]] = field(default_factory=by_stretch)
    share: dict[str, list[float]] = field(default_factory=by_stretch)
    pair: dict[str, list[int]] = field(default_factory=by_stretch)
    missed: int = 0
    scans: int = 0
    solved: int = 0
    stalls: int = 0
    said: str = ""


class Solver(ThreadWorker):
    """The daemon's own threads, which solve a graph over and over beside the daemon's jobs while ``busy``."""

    def __init__(self) -> None:
        super().__init__()
        self.busy = False
        self.solved = 0
        self._state = new_state()
        old_map(self._state, SUBMAPS)
        self._mine: set[int] = set()

    def submit(self, jobs: Iterable[Job]) -> None:
        """Submit the daemon's jobs and, while ``busy`` and none is under way, a graph solution of our own."""
        super().submit(jobs)
        state = self._state
        if self.busy and not self._mine:
            state.map.graph.stale = True
            solve_graph(state.map, state.pose, state.motion)
            mine = [replace(job, job_id=-1 - job.job_id) for job in state.jobs.take()]
            self._mine = {job.job_id for job in mine}
            super().submit(mine)

    def collect(self, t_mono: float) -> tuple[Answer, ...]:
        """Collect all answers; count our own solutions."""
        answers = super().collect(t_mono)
        for answer in answers:
            if answer.job_id in self._mine:
                self._mine.discard(answer.job_id)
                self._state.jobs.pending.clear()
                self.solved += 1
        return tuple(answer for answer in answers if answer.job_id >= 0)


class Feeder:
    """Stands for all sensors: what a recorded drive delivered, 40 times a second by the kernel's clock."""

    def __init__(self, wanted: Wanted, geometry: LidarGeometry, deliveries: list[Delivery]) -> None:
        self.geometry: LidarGeometry | None = geometry
        self.status = LidarStatus(link=Link.STREAMING)
        self.adc = AdcStatus(link=Link.STREAMING)
        self.told = Told()
        self.stretch = ""
        self.daemon: Daemon | None = None
        self.failure: Exception | None = None
        self.stop = asyncio.Event()
        self.on_samples: Callable[[RawSamples], None] = lambda block: None
        self._wanted = wanted
        self._deliveries = deliveries
        self._number = 0
        self._t0 = self._taken = 0.0
        self._begun = (0.0, 0.0)

    async def run(self, on_scan: Callable[[RawScan], None]) -> None:
        """See :class:`hal.lidar.Lidar`. A mistake in here ends it all: the daemon would start it anew, in mid-count."""
        try:
            await self._feed(on_scan)
        except Exception as error:
            self.failure = error
            self.stop.set()
            raise

    async def _feed(self, on_scan: Callable[[RawScan], None]) -> None:
        daemon = self.daemon
        assert daemon is not None
        while daemon.cycle.cycles == 0:  # noqa: ASYNC110  # nothing tells of the first cycle
            await asyncio.sleep(0.05)
        if self._wanted.fifo:
            first_in_line()
        loop, ring = asyncio.get_running_loop(), asyncio.Event()
        clock = timer(loop, ring.set)
        run = daemon.cycle.run
        daemon.cycle.run = lambda: self._timed(run)  # type: ignore[method-assign]  # to see when it begins
        self._t0 = loop.time() + PERIOD_S + SHIFT_S * len(self._deliveries)
        await self._shift()
        while self._number < len(self._deliveries):
            clock.at(self._t0 + self._number * PERIOD_S)
            await ring.wait()
            ring.clear()
            self._deliver(on_scan, loop.time())
        clock.close()
        self._turn("")
        self.told.missed, self.told.scans = daemon.cycle.inbox.dropped, self._number
        os.write(1, b"ended\n")
        await run_in_thread(sys.stdin.readline, "parent")
        self.stop.set()
        await asyncio.Event().wait()

    async def _shift(self) -> None:
        """Set all stamps to when it will be delivered, before the first: what drivers cost is not measured here."""
        for number, delivery in enumerate(self._deliveries):
            later = self._t0 + number * PERIOD_S - delivery.t_mono
            self._deliveries[number] = shifted(delivery, later)
            await asyncio.sleep(0.0)

    def _deliver(self, on_scan: Callable[[RawScan], None], now: float) -> None:
        """All that is due by now; a daemon that is late for more than a scan gets them all at once and loses some."""
        assert self.daemon is not None
        self._taken = self._t0 + self._number * PERIOD_S
        while self._number < len(self._deliveries) and self._t0 + self._number * PERIOD_S <= now:
            delivery = self._deliveries[self._number]
            for reading in delivery.odometry:
                self.daemon.cycle.inbox.put_odometry(reading)
            for block in delivery.samples:
                self.on_samples(block)
            on_scan(delivery.scan)
            self._number += 1
        self._turn(self._stretch_now())

    def _stretch_now(self) -> str:
        at, stretches = self._at(), self._wanted.stretches
        return "" if at < 0.0 else stretches[int(at) % len(stretches)]

    def _at(self) -> float:
        """Stretches since the first one began."""
        return (self._number * PERIOD_S - SETTLE_S) / self._wanted.stretch_s

    def _turn(self, stretch: str) -> None:
        """A stretch begins: tell the parent, and count the processor's time of the one that ends."""
        if stretch == self.stretch:
            return
        now, cpu = time.monotonic(), time.process_time()
        if self.stretch and now - self._begun[0] > 0.9 * self._wanted.stretch_s:
            self.told.share[self.stretch].append((cpu - self._begun[1]) / (now - self._begun[0]))
        self._begun, self.stretch = (now, cpu), stretch
        assert self.daemon is not None
        solver = self.daemon.cycle.parts.worker
        assert isinstance(solver, Solver)
        solver.busy, self.told.solved = stretch == "loaded" and self._wanted.solve, solver.solved
        os.write(1, f"{stretch or 'alone'}\n".encode())

    def _timed(self, run: Callable[[], object]) -> object:
        late = time.monotonic() - self._taken
        snapshot = run()
        counts = time.monotonic() - self._begun[0] >= self._wanted.change_s
        if self.stretch and counts and self.daemon is not None:
            self.told.pair[self.stretch].append(2 * int(self._at()) // len(self._wanted.stretches))
            self.told.late[self.stretch].append(1e6 * late)
            self.told.cycle[self.stretch].append(float(self.daemon.cycle.cycle_us or 0))
        return snapshot


def shifted(delivery: Delivery, later: float) -> Delivery:
    """The same, so many seconds later."""
    scan = delivery.scan
    return Delivery(
        delivery.t_mono + later,
        replace(scan, t_rx=scan.t_rx + later, t_mono=scan.t_mono + later),
        tuple(replace(one, t_rx=one.t_mono + later, t_mono=one.t_mono + later) for one in delivery.odometry),
        tuple(
            replace(block, t0=block.t0 + later, t1=block.t1 + later, t_first=block.t_first + later)
            for block in delivery.samples
        ),
    )


async def go(wanted: Wanted, drive: Any) -> Told:
    """Run the daemon over the drive."""
    geometry, survey, mount, deliveries = drive
    feeder = Feeder(wanted, geometry, deliveries)

    def lidar(config: LidarConfig, clock: Clock, opener: PortOpener) -> Feeder:
        return feeder

    class Converter:
        status = feeder.adc

        async def run(self, on_samples: Callable[[RawSamples], None]) -> None:
            feeder.on_samples = on_samples
            await asyncio.Event().wait()

    def adc(config: PhotodiodeConfig, clock: Clock, opener: BusOpener) -> Any:
        return Converter()

    x, y, yaw = mount
    lights = Lights(survey, PROFILE_A, 0.0)
    settings = Config(
        lidar=LidarConfig(device="/dev/bench", mount=Mount(x, y, float(np.degrees(yaw)))),
        odometry=OdometryConfig(port=free_port()),
        photodiode=PhotodiodeConfig(bus="/dev/bench-bus"),
        modbus=ModbusConfig(port=wanted.modbus),
        pose=PoseConfig(receivers=(wanted.receiver,)),
    )

    async def warm() -> object:
        return await warm_up(lights=lights)

    world = Environment(
        SystemClock(), make_lidar=lidar, make_adc=adc, lights=lights, warm_up=warm, make_worker=Solver,
        stream=Path(wanted.stream),
    )  # fmt: skip
    feeder.daemon = daemon = Daemon(settings, world)
    daemon.pacemaker.watch = watch = StallWatch()
    await daemon.run(feeder.stop)
    if feeder.failure is not None:
        raise feeder.failure
    feeder.told.stalls, feeder.told.said = daemon.cycle.timing.latest.stalls, watch.said
    return feeder.told


def main() -> None:
    """What the parent starts."""
    logging.basicConfig(level=logging.WARNING)
    give_back()
    wanted = Wanted(**json.loads(sys.argv[1]))
    drive = pickle.loads(Path(wanted.drive).read_bytes())  # written by the parent a moment ago
    told = asyncio.run(go(wanted, drive))
    os.write(1, ("told " + json.dumps({name: getattr(told, name) for name in Told.__slots__}) + "\n").encode())


if __name__ == "__main__":
    main()
