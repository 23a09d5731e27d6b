"""Inbox of the cycle: latest scan, some sample blocks, odometry, gyro readings and commands since the last cycle."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from daemon.integrity.arrival_monitor import Arrivals
from estimator import Command
from hal.adc import RawSamples
from hal.imu import RawImu
from hal.lidar import RawScan
from hal.odometry import RawOdometry

DEEPEST: Final = 256
"""Readings held of one kind. Beyond, every other one is dropped; odometry is cumulative, so no motion is lost."""

BLOCKS: Final = 4
"""Sample blocks held: 0.2 s of light. Beyond, the oldest is dropped and counted; each has its own time base."""


@dataclass(frozen=True, slots=True)
class Taken:
    """Input of one cycle.

    Attributes:
        dropped: sequence numbers of scans that a later one has replaced.
        odometry_total, imu_total: readings received since the start, all consumed with this cycle.
        samples: blocks, oldest first. samples_total: received since the start, consumed so far or dropped.
    """

    scan: RawScan | None
    dropped: tuple[int, ...]
    odometry: tuple[RawOdometry, ...]
    odometry_total: int
    imu: tuple[RawImu, ...]
    imu_total: int
    commands: tuple[Command, ...]
    samples: tuple[RawSamples, ...] = ()
    samples_total: int = 0


class Inbox:
    """Buffer that device callbacks fill and the cycle empties; never longer than :data:`DEEPEST`.

    Attributes:
        dropped, blocks_dropped: scans, and sample blocks, that no cycle consumed.
        wheels: arrival times of odometry readings.
    """

    def __init__(self) -> None:
        self.dropped = self.blocks_dropped = 0
        self.wheels = Arrivals()
        self._scan: RawScan | None = None
        self._dropped: list[int] = []
        self._odometry: list[RawOdometry] = []
        self._odometry_total = 0
        self._imu: list[RawImu] = []
        self._imu_total = 0
        self._commands: list[Command] = []
        self._samples: list[RawSamples] = []
        self._samples_total = 0

    def begin(self) -> None:
        """Resets the loss counters at the first cycle; input before it is no loss."""
        self.dropped = self.blocks_dropped = 0

    def put_scan(self, scan: RawScan) -> None:
        """Holds a scan; a scan that no cycle has consumed yet is dropped and counted."""
        if self._scan is not None:
            self._dropped.append(self._scan.seq)
            self.dropped += 1
        self._scan = scan

    def put_samples(self, block: RawSamples) -> None:
        """Holds a block; drops the oldest one if there are too many."""
        self._samples_total += 1
        self._samples.append(block)
        if len(self._samples) > BLOCKS:
            del self._samples[0]
            self.blocks_dropped += 1

    def put_odometry(self, reading: RawOdometry) -> None:
        """Holds a cumulative reading."""
        self._odometry_total += 1
        self.wheels.on_reading(reading.t_rx)
        self._odometry.append(reading)
        if len(self._odometry) > DEEPEST:
            self._odometry = self._odometry[::2]

    def put_imu(self, reading: RawImu) -> None:
        """Holds a gyro reading."""
        self._imu_total += 1
        self._imu.append(reading)
        if len(self._imu) > DEEPEST:
            del self._imu[0]

    def put_command(self, command: Command) -> None:
        """Holds a command; only the latest ones are kept."""
        self._commands = [*self._commands, command][-DEEPEST:]

    def drain(self) -> Taken:
        """Returns all input and empties the inbox."""
        taken = Taken(
            self._scan,
            tuple(self._dropped),
            tuple(self._odometry),
            self._odometry_total,
            tuple(self._imu),
            self._imu_total,
            tuple(self._commands),
            tuple(self._samples),
            self._samples_total,
        )
        self._scan = None
        self._dropped, self._odometry, self._imu, self._commands, self._samples = [], [], [], [], []
        return taken
