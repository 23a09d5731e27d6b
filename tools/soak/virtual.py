"""Simulated days: the daemon's own cycle with its sinks, its clock put forward by hand, one scan a second."""

import asyncio
import gc
import math
import os
import socket
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np

from daemon.config.schema import LidarConfig, Mount
from daemon.devices.conversion import ScanBridge
from daemon.publish.modbus.server import ModbusPublisher
from daemon.publish.udp_sender import PoseSender
from daemon.runtime.budget import FixedBudget
from daemon.runtime.cycle import Cycle
from daemon.runtime.cycle_parts import Parts
from daemon.runtime.worker import CycleWorker
from daemon.snapshot import Snapshot, State
from estimator.light_filter.light_channel import LightsSetup
from estimator.measurements import Limits, Record
from estimator.numerics import se2
from estimator.pipeline import new_state, step
from estimator.result import StepResult
from hal.clock import SystemClock
from hal.lidar import LidarStatus, Link
from tools.bench.support.manual_clock import ManualClock
from tools.soak.patrol import Patrol
from tools.soak.watched import Watch

WINDOWS: Final = 96


@dataclass(slots=True)
class Days:
    """What came of it: rows, share of cycles in TRACKING, median error in m."""

    watch: Watch
    tracking: float
    error_m: float


def run(days: float, building: str, seed: int = 0, say: Callable[[str], None] = lambda text: None) -> Days:
    """Drive through a building for so many days."""
    return asyncio.run(_run(round(86400.0 * days), Patrol(building, seed), say))


async def _run(seconds: int, patrol: Patrol, say: Callable[[str], None]) -> Days:
    clock = ManualClock()
    state = new_state(lights=LightsSetup(patrol.survey, clock_ppm=0.0))
    fresh: list[Record] = []

    def with_light(records: tuple[Record, ...], limits: Limits) -> StepResult:
        made = step(state, (*fresh, *records), limits)
        fresh.clear()
        return made

    def kept() -> tuple[float, ...]:
        graph = state.map.graph
        return float(len(state.map.keyframes)), float(len(graph.submaps)), float(len(graph.constraints.loop))

    x, y, yaw = patrol.mount
    scans = ScanBridge(LidarConfig(mount=Mount(float(x), float(y), float(np.degrees(yaw)))))
    status = LidarStatus(link=Link.STREAMING)
    cycle = Cycle(Parts(clock, with_light, scans, FixedBudget(), CycleWorker(), status, odometry=True))
    modbus = ModbusPublisher(SystemClock())
    await modbus.start("127.0.0.1", 0)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sink:
        sink.bind(("127.0.0.1", 0))  # and never reads: the kernel drops what does not fit
        sender = PoseSender([f"127.0.0.1:{sink.getsockname()[1]}"])
        await sender.start()
        cycle.parts.sinks += [modbus.publish, sender.publish]
        try:
            watch, tracking, errors = await _drive(cycle, patrol, (seconds, clock, fresh, kept), say)
        finally:
            await sender.close()
            await modbus.close()
    return Days(watch, tracking, float(np.median(errors)))


Given = tuple[int, ManualClock, list[Record], Callable[[], tuple[float, ...]]]
"""Seconds, the clock, records of light that wait, and how much the map holds."""


async def _drive(
    cycle: Cycle, patrol: Patrol, given: Given, say: Callable[[str], None]
) -> tuple[Watch, float, list[float]]:
    seconds, clock, fresh, kept = given
    watch, took, errors, tracking = Watch(), [], [], 0
    window = max(seconds // WINDOWS, 1)
    for number in range(1, seconds + 1):
        scan = patrol.scan(number)
        if (light := patrol.light(number)) is not None:
            fresh.append(light)
        for reading in patrol.wheels(scan.t_rx):
            cycle.inbox.put_odometry(reading)
        cycle.inbox.put_scan(scan)
        clock.t = scan.t_rx
        begin = time.thread_time()
        snapshot = cycle.run()
        took.append(1e3 * (time.thread_time() - begin))
        tracking += snapshot.state is State.TRACKING
        if number % 64 == 0:
            errors.append(_error(snapshot, patrol))
            await asyncio.sleep(0)
        if number % window == 0:
            gc.collect()
            times = float(np.median(took)), float(np.percentile(took, 99)), max(took)
            watch.take(number / 3600.0, os.getpid(), times, kept())
            took.clear()
            say(watch.line())
    return watch, tracking / seconds, errors


def _error(snapshot: Snapshot, patrol: Patrol) -> float:
    if snapshot.pose is None:
        return math.inf
    x, y, _ = se2.between(patrol.truth(snapshot.t_mono), np.array(snapshot.pose)).tolist()
    return math.hypot(x, y)
