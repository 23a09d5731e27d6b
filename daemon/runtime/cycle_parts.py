"""What a cycle is made of, and the record of what one cycle consumed and decided."""

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
"""Takes every snapshot; called from the loop thread, never waited for: it must return at once."""
Step = Callable[[tuple[Record, ...], Limits], StepResult]
"""The estimator with its state inside."""


@dataclass(frozen=True, slots=True)
class CycleRecord:
    """What one cycle consumed and decided.

    Attributes:
        cycle: counts cycles from 1. t_mono: when it began.
        scan: `RawScan.seq` of the scan consumed, None without one. dropped: those that a later scan replaced.
        odometry, imu, samples: readings, and blocks of light samples, received since the start, all consumed by now.
        commands: consumed. answers: job IDs of the answers applied, in order.
        switched: SHA-256 of the stored map that the estimator has gone on in with this cycle, empty: none.
        limits: the step's caps; None where nothing had arrived and no step was made.
        result: of the step, or the previous one's; None before the first. snapshot: what was published.
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
    """A switch to another stored map that the next step carries out.

    Attributes:
        take_over: has the estimator go on in the other map; returns the map's ID and the digest of its file. None:
            there is no switch to carry out.
    """

    take_over: Callable[[], tuple[int, str]] | None = None

    def carry_out(self) -> tuple[int, str] | None:
        """Map ID and digest, once; None where there is no switch."""
        take_over, self.take_over = self.take_over, None
        return None if take_over is None else take_over()


@dataclass(slots=True)
class Parts:
    """What a cycle is made of; every part can be replaced.

    Attributes:
        status: of the lidar driver, live. lidar, odometry: there is one.
        samples, blocks: of the photodiode; None where there is none.
        budget_us: time budget of a cycle, 0: half of the scan period.
        timer: of the stages; without a stopwatch nothing is measured, and nothing counts as overrun.
        inbox: filled by the devices. snapshots: builds what is published. switch: to another stored map.
        fault: number of the gravest present fault. condition: how the daemon's parts are.
        alert_m: limit of the position error above which an alert is raised, 0: none. t_begun: start of the run; 0: now.
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
