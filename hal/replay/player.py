"""Plays a log's records as devices: a lidar and an odometry source with one common order of events.

Under the virtual loop a log plays at its consumer's speed, under a real loop in its own time. File order is kept: an
odometry reading with the same time as a scan precedes it.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Iterator
from typing import Final, Protocol

from hal.lidar import LidarGeometry, LidarStatus, Link, RawScan
from hal.odometry import RawOdometry

LEAD_S: Final = 1.0
"""Time from the player's start to the first record, so that every consumer is ready."""


class Log(Protocol):
    """A log in memory."""

    @property
    def geometry(self) -> LidarGeometry:
        """Geometry of the first scan."""
        ...

    @property
    def dialect(self) -> str:
        """Kind of log, for people."""
        ...

    def events(self, start: float) -> Iterator[RawScan | RawOdometry]:
        """Records by time of arrival (``t_rx``), the log's first at ``start``."""
        ...


class LogPlayer:
    """One log as two devices: :attr:`lidar` drives the time, :attr:`odometry` follows it."""

    def __init__(self, log: Log) -> None:
        self.lidar: Final = _LogLidar(log, self)
        self.odometry: Final = _LogOdometry()

    async def play(self, log: Log, on_scan: Callable[[RawScan], None]) -> None:
        """Deliver every record at its time; returns at the log's end."""
        loop = asyncio.get_running_loop()
        for event in log.events(loop.time() + LEAD_S):
            ahead = event.t_rx - loop.time()
            if ahead > 0.0:
                await asyncio.sleep(ahead)
            if isinstance(event, RawScan):
                on_scan(event)
            else:
                self.odometry.deliver(event)
        self.odometry.finish()


class _LogLidar:
    """The lidar of a log (`hal.lidar.Lidar`)."""

    def __init__(self, log: Log, player: LogPlayer) -> None:
        self._log = log
        self._player = player
        self._status = LidarStatus(dialect=log.dialect)

    @property
    def geometry(self) -> LidarGeometry | None:
        """Geometry of the log's first scan."""
        return self._log.geometry

    @property
    def status(self) -> LidarStatus:
        """Live state and counters."""
        return self._status

    async def run(self, on_scan: Callable[[RawScan], None]) -> None:
        """Play the log, returning at its end."""
        status = self._status
        status.link = Link.STREAMING

        def count(scan: RawScan) -> None:
            status.scans += 1
            on_scan(scan)

        try:
            await self._player.play(self._log, count)
        finally:
            status.link = Link.CLOSED


class _LogOdometry:
    """The odometry of a log (`hal.odometry.OdometrySource`); it delivers while the log's lidar runs."""

    def __init__(self) -> None:
        self._listeners: list[Callable[[RawOdometry], None]] = []
        self._finished = asyncio.Event()

    def deliver(self, reading: RawOdometry) -> None:
        """Pass a reading to the consumers of this source."""
        for listener in self._listeners:
            listener(reading)

    def finish(self) -> None:
        """End every `run`."""
        self._finished.set()

    async def run(self, on_odometry: Callable[[RawOdometry], None]) -> None:
        """Deliver readings until the log ends."""
        self._listeners.append(on_odometry)
        try:
            await self._finished.wait()
        finally:
            self._listeners.remove(on_odometry)
