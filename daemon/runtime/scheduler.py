"""Cycle scheduler: starts a cycle with a scan; without scans, with a sample block; otherwise after 1.5 periods."""

from __future__ import annotations

import asyncio
from typing import Final, Protocol

from daemon.runtime.cycle import Cycle
from daemon.snapshot import Stage
from hal.adc import RawSamples
from hal.lidar import RawScan
from hal.timerfd import timer

IDLE_PERIODS: Final = 1.5
"""Scan periods after which a cycle starts without a scan."""
STALL_PERIODS: Final = 2.0
"""Periods beyond the idle one after which the loop counts as stalled."""


class Watch(Protocol):
    """Finds what ran while the loop was stalled (`daemon.runtime.stall_watch.StallWatch`)."""

    def arm(self, seconds: float) -> float | None:
        """Restarts the timer of ``seconds`` at the start of a cycle.

        Returns the seconds since the last start if it expired.
        """
        ...

    def close(self) -> None:
        """Stops watching."""
        ...


class Pacemaker:
    """Starts a cycle when a scan is complete; without scans, when a sample block is complete, or after the idle time.

    Attributes:
        watch: of stalls; None: no watch.
    """

    def __init__(self, cycle: Cycle) -> None:
        self.watch: Watch | None = None
        self._cycle = cycle
        self._due: asyncio.Future[None] | None = None
        self._due_since = 0.0
        self._latest = 0.0

    def on_scan(self, scan: RawScan) -> None:
        """Receives a scan; the cycle starts in the next turn of the loop, with the latest scan by then."""
        self._cycle.inbox.put_scan(scan)
        self._wake(scan.t_rx)

    def on_samples(self, block: RawSamples) -> None:
        """Receives a sample block; the cycle of the next scan consumes it, if there are scans."""
        cycle = self._cycle
        cycle.inbox.put_samples(block)
        silence = cycle.lidar_silence(cycle.parts.clock.now())
        if silence is None or silence > IDLE_PERIODS:
            self._wake(cycle.parts.clock.now())

    def latest(self) -> float:
        """Returns the delay of the loop in its worst stall since the last call, s; 0 if there was none."""
        latest, self._latest = self._latest, 0.0
        return latest

    async def run(self) -> None:
        """Runs cycles until cancelled."""
        loop, cycle = asyncio.get_running_loop(), self._cycle
        idle_until = 0.0
        idle = timer(loop, lambda: self._wake(idle_until))
        cycle.inbox.begin()
        try:
            while True:
                self._due = loop.create_future()
                period = cycle.period.seconds
                idle_until = loop.time() + IDLE_PERIODS * period
                idle.at(idle_until)
                await self._due
                cycle.timing.late(cycle.parts.clock.now() - self._due_since)
                self._watch_stalls(period)
                cycle.run()
        finally:
            idle.close()
            if self.watch is not None:
                self.watch.close()

    def _watch_stalls(self, period: float) -> None:
        """Counts a stall before this cycle, with the stage in which it occurred."""
        cycle = self._cycle
        if self.watch is None or (lasted := self.watch.arm((IDLE_PERIODS + STALL_PERIODS) * period)) is None:
            return
        self._latest = max(self._latest, lasted - IDLE_PERIODS * period)
        inside = (cycle.cycle_us or 0) * 1e-6 >= 0.5 * lasted
        cycle.timing.stalled(lasted, cycle.stage_timer.longest() if inside else Stage.OUTSIDE)

    def _wake(self, since: float) -> None:
        if self._due is not None and not self._due.done():
            self._due_since = since
            self._due.set_result(None)
