"""Components that a cycle is built from, and the record of the input and decisions of one cycle."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass, field

from daemon.devices.conversion import SampleBridge, ScanBridge
from daemon.devices.photodiode import BlockWatch
from daemon.runtime.budget import Budget
from daemon.runtime.inbox import Inbox
from daemon.runtime.snapshot_builder import SnapshotBuilder
from daemon.runtime.stage_times import StageTimer
from daemon.runtime.worker import Worker
from daemon.snapshot import Condition, Snapshot
from estimator import Command, Limits, Record, StepResult
from hal.clock import Clock
from hal.lidar import LidarStatus

log = logging.getLogger(__name__)

Sink = Callable[[Snapshot], None]
"""Receives every snapshot in the loop thread; the cycle never waits, so it must return at once."""
Step = Callable[[tuple[Record, ...], Limits], StepResult]
"""Estimator step: records and caps to a result; the estimator state is inside."""


@dataclass(frozen=True, slots=True)
class CycleRecord:
    """Input and decisions of one cycle.

    Attributes:
        cycle: number of the cycle, from 1. t_mono: its start, s.
        scan: `RawScan.seq` of the consumed scan, None without one. dropped: scans that a later one replaced.
        odometry, imu, samples: readings, and blocks of light samples, received since the start and consumed so far.
        commands: consumed. answers: job IDs of the applied job results, in order.
        switched: SHA-256 of the stored map that the estimator switched to in this cycle, empty: none.
        limits: caps of the step; None if nothing had arrived and no step was made.
        result: of the step, or the previous one's; None before the first. snapshot: as published.
        stage_us: measured microseconds by stage, empty without a stopwatch. waiting: `Link.WAITING` of the lidar.
    """

    cycle: int
    t_mono: float
    scan: int | None
    dropped: tuple[int, ...]
    odometry: int
    imu: int
    commands: tuple[Command, ...]
    answers: tuple[int, ...]
    limits: Limits | None
    result: StepResult | None
    snapshot: Snapshot
    stage_us: dict[str, int]
    samples: int = 0
    switched: str = ""
    waiting: bool = False


Tap = Callable[[CycleRecord], None]


@dataclass(slots=True)
class PendingSwitch:
    """A switch to another stored map, which the next step carries out.

    Attributes:
        take_over: switches the estimator to the other map; returns the map's ID and the digest of its file. None: no
            switch is pending.
    """

    take_over: Callable[[], tuple[int, str]] | None = None

    def carry_out(self) -> tuple[int, str] | None:
        """Carries out the switch once; returns map ID and digest, None if no switch is pending."""
        take_over, self.take_over = self.take_over, None
        return None if take_over is None else take_over()


@dataclass(slots=True)
class Parts:
    """Components of a cycle; each of them can be replaced.

    Attributes:
        status: of the lidar driver, live. lidar, odometry: whether there is one.
        samples, blocks: of the photodiode; None where there is none.
        budget_us: budget of a cycle, us; 0: half of the scan period.
        timer: of the stages; without a stopwatch nothing is measured, and nothing counts as overrun.
        inbox: filled by the devices. snapshots: builds what is published. switch: to another stored map.
        fault: number of the gravest present fault. condition: health of the daemon's components.
        alert_m: alert limit, m; 0: none. t_begun: start of the run, s; 0: now.
    """

    clock: Clock
    step: Step
    scans: ScanBridge
    budget: Budget
    worker: Worker
    status: LidarStatus
    lidar: bool = True
    odometry: bool = False
    samples: SampleBridge | None = None
    blocks: BlockWatch | None = None
    budget_us: float = 0.0
    timer: StageTimer = field(default_factory=lambda: StageTimer(None))
    inbox: Inbox = field(default_factory=Inbox)
    snapshots: SnapshotBuilder = field(default_factory=SnapshotBuilder)
    switch: PendingSwitch = field(default_factory=PendingSwitch)
    sinks: list[Sink] = field(default_factory=list)
    tap: Tap | None = None
    fault: Callable[[], int] = int
    condition: Callable[[], Condition | None] = lambda: None
    alert_m: float = 0.0
    t_begun: float = 0.0
