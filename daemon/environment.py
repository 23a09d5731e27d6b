"""Replaceable surroundings of the daemon: clock, ports, buses, drivers, worker, estimator start and stored map."""

from __future__ import annotations

import asyncio
import secrets
import time
from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from daemon.config.endpoints import parse_lidar
from daemon.config.schema import LidarConfig
from daemon.devices.light_setup import Lights
from daemon.devices.photodiode import AdcMaker, make_adc
from daemon.devices.sample_clock import SampleClock
from daemon.maps.store import Start, Store
from daemon.runtime.budget import Budget, MeasuredBudget
from daemon.runtime.cycle_parts import Sink
from daemon.runtime.warmup import warm_up
from daemon.runtime.worker import ThreadWorker, Worker
from hal.bus.i2c import BusOpener
from hal.bus.opening import open_bus
from hal.clock import Clock
from hal.lidar import Lidar, LidarGeometry, LidarStatus, RawScan
from hal.port.opening import open_port
from hal.port.port import PortOpener


class LidarMaker(Protocol):
    """Factory of a lidar driver from its configuration."""

    def __call__(self, config: LidarConfig, clock: Clock, opener: PortOpener) -> Lidar:
        """Return a driver that is not running yet."""
        ...


def make_lidar(config: LidarConfig, clock: Clock, opener: PortOpener) -> Lidar:
    """Return the lidar driver that the device string names, otherwise the HOKUYO driver.

    Raises:
        DeviceRefused: there is no such driver.
    """
    from hal.registry import lidar_factory, split

    name, device = split(config.device)
    place = parse_lidar(device)
    return lidar_factory(name)(
        place.device, clock=clock, opener=opener, serial=place.serial, baud=place.baud, intensity=config.intensity
    )


class NoLidar:
    """Null lidar for a robot without one: no geometry, no scans (`hal.lidar.Lidar`)."""

    def __init__(self) -> None:
        self._status = LidarStatus(dialect="no lidar")

    @property
    def geometry(self) -> LidarGeometry | None:
        """Always None."""
        return None

    @property
    def status(self) -> LidarStatus:
        """Status of a closed device without an error."""
        return self._status

    async def run(self, on_scan: Callable[[RawScan], None]) -> None:
        """Wait for ever without a scan."""
        await asyncio.Event().wait()


@dataclass(slots=True)
class Environment:
    """Everything that the daemon uses outside itself. A test replaces any field; the defaults are the real devices.

    Attributes:
        stopwatch: measures stages and budget; None: nothing is measured. sinks: receive every snapshot too.
        warm_up: loads the estimator. draw_map_id: identity of a new map frame.
        lights: survey and sample clock; None: as configured, and the sample clock has to be found.
        sample_clock: stores the sample clock; None: it is not stored.
        store: stores maps; None: they are not stored. start: the map with which the run starts.
        stream: path of the local stream; None: there is no stream.
    """

    clock: Clock
    opener: PortOpener = open_port
    make_lidar: LidarMaker = make_lidar
    make_worker: Callable[[], Worker] = ThreadWorker
    make_budget: Callable[[], Budget] = MeasuredBudget
    stopwatch: Callable[[], float] | None = time.perf_counter
    warm_up: Callable[[], Awaitable[object]] = warm_up
    sinks: tuple[Sink, ...] = ()
    draw_map_id: Callable[[], int] = lambda: 1 + secrets.randbelow(2**32 - 1)
    buses: BusOpener = open_bus
    make_adc: AdcMaker = make_adc
    lights: Lights | None = None
    sample_clock: SampleClock | None = None
    store: Store | None = None
    start: Start | None = None
    stream: Path | None = None
