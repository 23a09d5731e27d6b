"""The daemon's whole cycle: 1081 beams at 40 Hz, 16 lamps as converter words, odometry in; registers and datagrams out.

``make bench ARGS=cycle`` drives one simulated minute. For the long forms::

    python -m tools.bench.cycle --minutes 10
    python -m tools.bench.cycle --minutes 120 --settle 10

It is the real daemon's cycle with its real sinks; only the devices and the waiting between two scans are left out. The
machine is shared: beside wall time stands the processor time of the thread, which other programs do not lengthen much,
and how many cycles were interrupted.
"""

import argparse
import asyncio
import gc
import os
import socket
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from daemon.app import Daemon, Environment
from daemon.config.schema import Config, LidarConfig, ModbusConfig, Mount, OdometryConfig, PhotodiodeConfig, PoseConfig
from daemon.devices.light_setup import Lights
from daemon.runtime.snapshot_builder import SnapshotBuilder
from daemon.runtime.warmup import load
from estimator import pipeline
from estimator.cdma import decoder
from estimator.cdma.air_interface import PROFILE_A
from estimator.light_filter import light_filter
from estimator.result import Fix
from hal.adc import AdcStatus, RawSamples
from hal.bus.i2c import BusOpener
from hal.clock import Clock
from hal.lidar import LidarGeometry, LidarStatus, Link, RawScan
from hal.port.port import PortOpener
from tools.bench.support.drive import EndlessDrive
from tools.bench.support.manual_clock import ManualClock
from tools.bench.support.stages import CPU, WALL, Array, Stages, quantiles
from tools.ci.figures import Figure, bounded, save, table

COMMAND: Final = "python -m tools.bench.cycle"
STAGES: Final = ("bridge", "decode", "search", "lights", "match", "fuse", "map", "step", "judge", "publish")
"""``lights`` is filter and tie to the pose; ``step`` is what is between the others; ``judge`` makes the snapshot."""
SETTLE_S: Final = 10.0
"""Until all lamps are followed and the map is laid; not counted."""
MEDIAN_MS, WORST_MS = 2.0, 6.0


class Device:
    """Stands for a lidar and a converter that always work; what they deliver is put into the inbox."""

    def __init__(self, geometry: LidarGeometry | None = None) -> None:
        self.geometry = geometry
        self.status = LidarStatus(link=Link.STREAMING)

    async def run(self, on_scan: Callable[[RawScan], None]) -> None:
        """See :class:`hal.lidar.Lidar`."""


class Converter:
    """The converter's part of :class:`Device`."""

    def __init__(self) -> None:
        self.status = AdcStatus(link=Link.STREAMING)

    async def run(self, on_samples: Callable[[RawSamples], None]) -> None:
        """See :class:`hal.adc.Adc`."""


@dataclass(frozen=True, slots=True, eq=False)
class Outcome:
    """What was measured. ``links``: used per epoch. resident_mb: at the begin of each tenth, and at the end."""

    stages: Stages
    seconds: float
    links: Array
    resident_mb: list[float]
    overruns: int
    collections: int


def make_daemon(drive: EndlessDrive, clock: Clock, receiver: str, modbus: int) -> Daemon:
    """The daemon with everything configured that a cycle can have to do with."""

    def lidar(config: LidarConfig, clock: Clock, opener: PortOpener) -> Device:
        return Device(drive.geometry)

    def adc(config: PhotodiodeConfig, clock: Clock, opener: BusOpener) -> Converter:
        return Converter()

    x, y, yaw = drive.scene.mount
    told = Lights(drive.survey, PROFILE_A, 0.0)
    settings = Config(
        lidar=LidarConfig(device="/dev/bench", mount=Mount(x, y, float(np.degrees(yaw)))),
        odometry=OdometryConfig(port=1),
        photodiode=PhotodiodeConfig(bus="/dev/bench-bus"),
        modbus=ModbusConfig(port=modbus),
        pose=PoseConfig(receivers=(receiver,)),
    )
    # the budget is told processor time, so that the work that is measured does not hang on what other programs do
    world = Environment(clock=clock, make_lidar=lidar, make_adc=adc, lights=told, stopwatch=time.thread_time)
    daemon = Daemon(settings, world)
    daemon.cycle.parts.budget.learn_code(load(told).code_us)
    return daemon


async def measure(seconds: float, settle_s: float) -> Outcome:
    """Drive for so long, and time every cycle after the first ``settle_s``."""
    drive, clock = EndlessDrive(), ManualClock()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sink, socket.socket() as free:
        sink.bind(("127.0.0.1", 0))
        sink.setblocking(False)
        free.bind(("127.0.0.1", 0))
        modbus = int(free.getsockname()[1])
        free.close()
        daemon = make_daemon(drive, clock, f"127.0.0.1:{sink.getsockname()[1]}", modbus)
        parts = [asyncio.ensure_future(daemon.network.parts[name]()) for name in ("modbus", "pose")]
        await asyncio.sleep(0.1)
        try:
            return await _run(daemon, drive, clock, (seconds, settle_s))
        finally:
            for part in parts:
                part.cancel()
            await asyncio.gather(*parts, return_exceptions=True)
            daemon.cycle.parts.worker.close()


async def _run(daemon: Daemon, drive: EndlessDrive, clock: ManualClock, span: tuple[float, float]) -> Outcome:
    cycle, (seconds, settle_s) = daemon.cycle, span
    rate = 1.0 / drive.geometry.period_s
    warm, count = round(settle_s * rate), round(seconds * rate)
    stages = Stages(STAGES, count)
    links: list[int] = []
    resident: list[float] = []
    for number in range(-warm, count):
        due = next(drive)
        for reading in due.odometry:
            cycle.inbox.put_odometry(reading)
        for block in due.samples:
            cycle.inbox.put_samples(block)
        cycle.inbox.put_scan(due.scan)
        clock.t = due.t_mono
        if number < 0:
            cycle.run()
            continue
        if number == 0:
            gc.collect()
            gc.freeze()
            collections, overruns = _collections(), cycle.overruns
            instrument(stages, daemon)
        if number % max(count // 10, 1) == 0:
            resident.append(resident_mb())
        stages.run(cycle.run)
        if cycle.result is not None and cycle.result.lights is not None and due.samples:
            links.append(len(cycle.result.lights.links))
        if number % 40 == 0:
            await asyncio.sleep(0)
    stages.unwrap()
    resident.append(resident_mb())
    result = cycle.result
    if result is None or result.lights is None or result.lights.fix is not Fix.GOOD:
        raise RuntimeError(f"light has lost its place: {result and result.lights and result.lights.fix}")
    made = _collections() - collections
    return Outcome(stages, seconds, np.array(links, float), resident, cycle.overruns - overruns, made)


STAGE_OF: Final = (
    (SnapshotBuilder, "build", "judge"),
    *((decoder, "decode", "decode"), (decoder, "search", "search")),
    *((light_filter, "update", "lights"), (light_filter, "predict", "lights"), (pipeline, "fuse_light", "lights")),
    *((pipeline, "virtual_frame", "match"), (pipeline, "match_scan", "match")),
    *((pipeline, "fuse_match", "fuse"), (pipeline, "predict", "fuse")),
    *((pipeline, "extends_map", "map"), (pipeline, "extend_map", "map")),
)
"""Functions of the estimator by stage: owner, attribute, stage."""


def instrument(stages: Stages, daemon: Daemon) -> None:
    """Wrap what the stages are made of."""
    cycle = daemon.cycle
    own = (
        (cycle, "_bridge", "bridge"),
        (cycle, "_step", "step"),
        (cycle, "_judge", "judge"),
        (cycle, "_publish", "publish"),
    )
    for owner, attribute, stage in (*own, *STAGE_OF):
        stages.wrap(owner, attribute, stage)


def resident_mb() -> float:
    """Memory that this process holds."""
    pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


def _collections() -> int:
    return sum(generation["collections"] for generation in gc.get_stats())


def figures(outcome: Outcome) -> list[Figure]:
    """All rows."""
    stages, minutes = outcome.stages, outcome.seconds / 60.0
    rows = [
        Figure("simulated minutes", minutes, "min", command=COMMAND),
        Figure("lamps listed per epoch, median", float(np.median(outcome.links)), "", command=COMMAND),
        Figure("cycles interrupted by other programs", 100.0 * float(stages.interrupted.mean()), "%", command=COMMAND),
    ]
    for kind, clock in ((CPU, "CPU"), (WALL, "wall")):
        whole = stages.of("cycle", kind)
        with_light = np.isfinite(stages.of("decode", kind))
        rows += _whole(f"cycle, {clock}", whole)
        rows += _whole(f"cycle that decodes a block, {clock}", whole[with_light])
        if kind == WALL:
            rows += _whole("cycle not interrupted, wall", whole[~stages.interrupted])
        quarter = len(whole) // 4
        for name, q in (("median", 50.0), ("lowest decile", 10.0)):  # other programs disturb this one least
            growth = float(np.percentile(whole[-quarter:], q) / np.percentile(whole[:quarter], q))
            what = f"{name} of last over first quarter, {clock}"
            rows.append(bounded(what, growth, "ratio", "<= 1.1", COMMAND))
    for stage in STAGES:
        for name, value in quantiles(stages.of(stage, CPU)).items():
            rows.append(Figure(f"{stage}, CPU, {name}", 1e-3 * value, "ms", command=COMMAND))
    memory = outcome.resident_mb
    return [
        *rows,
        Figure("memory at the end", memory[-1], "MB", command=COMMAND),
        bounded("memory, growth over the second half", memory[-1] - memory[len(memory) // 2], "MB", "<= 5", COMMAND),
        Figure("overruns of the cycle's budget", outcome.overruns, "", command=COMMAND),
        Figure("garbage collections", outcome.collections, "", command=COMMAND),
    ]


def _whole(name: str, us: Array) -> list[Figure]:
    target = {"median": f"<= {MEDIAN_MS:g}", "p99.9": f"<= {WORST_MS:g}"}
    rows = []
    for quantile, value in quantiles(us).items():
        bound = target.get(quantile)
        what = f"{name}, {quantile}"
        rows.append(
            bounded(what, 1e-3 * value, "ms", bound, COMMAND)
            if bound
            else Figure(what, 1e-3 * value, "ms", command=COMMAND)
        )
    return rows


def run(minutes: float = 1.0, settle_s: float = SETTLE_S) -> list[Figure]:
    """Drive, and say what a cycle costs.

    Raises:
        RuntimeError: the light was lost; the figures would mean nothing.
    """
    return figures(asyncio.run(measure(60.0 * minutes, settle_s)))


def main() -> None:
    """The long forms."""
    parser = argparse.ArgumentParser(prog=COMMAND, description=__doc__)
    parser.add_argument("--minutes", type=float, default=10.0, help="simulated minutes to time (default %(default)s)")
    parser.add_argument("--settle", type=float, default=SETTLE_S, help="simulated seconds before (default %(default)s)")
    parser.add_argument("--out", type=Path, default=Path("out/bench"))
    options = parser.parse_args()
    begun = time.perf_counter()
    rows = run(options.minutes, options.settle)
    print(table(rows))
    print(f"written: {save('cycle', rows, options.out)}; {time.perf_counter() - begun:.0f} s")


if __name__ == "__main__":
    main()
