"""Recorder of a run: every byte from and to the devices, every input, and every decision of every cycle.

The loop thread only appends to a list; one thread (`daemon/recording/disk_writer.py`) writes the records. A recording
contains all that an exact repetition needs. The same bytes pass the same codec, and each cycle consumes the same input
under the same caps. The published pose, state and reason are recorded too, so that a replay can compare them. The
published faults are also recorded. A replay cannot reproduce most of them, because drivers and the computer raised
them.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Any, Final

import msgspec
import numpy as np

from daemon.config.schema import Config
from daemon.devices.light_setup import RESIDUALS, Lights
from daemon.devices.port_tap import tapped
from daemon.maps.store import START, Start
from daemon.recording.disk_writer import SegmentWriter, both
from daemon.recording.flight_recorder import BlackBox
from daemon.runtime.cycle_parts import CycleRecord
from daemon.snapshot import Snapshot
from daemon.system.atomic_file import write_whole
from daemon.system.versions import versions
from estimator import UNLIMITED, Array, Command, Limits, Order, StepResult
from hal.adc import RawSamples
from hal.clock import Clock
from hal.imu import RawImu
from hal.lidar import RawScan
from hal.odometry import RawOdometry
from hal.port.port import PortOpener
from hal.replay.recording import Kind, pack_imu, pack_odometry, pack_samples, pack_scan

MAP: Final = "map"
"""Key of a recording's head that is present if the run began with a map."""
LIDAR, PHOTODIODE = 0, 0
"""Channels: index of the device among those of its kind."""

Pose = tuple[float, float, float]


def switch_name(sha256: str) -> str:
    """Returns the file name of a map that the run switched to, in the folder of the recording."""
    return f"switch-{sha256[:16]}.lumimap"


class CommandEntry(msgspec.Struct, frozen=True, array_like=True):
    """A command as a cycle consumed it; ``t_begin`` in s, ``pose`` as (x, y, yaw) in m, m, rad."""

    t_begin: float
    order: str
    pose: Pose | None


class CycleEntry(msgspec.Struct, frozen=True, array_like=True):
    """A recorded cycle; see `daemon.runtime.cycle_parts.CycleRecord`. New fields go at the end only.

    Attributes:
        limits: (ICP iterations, points, whether the map may be updated); None if no step was made.
        odom, map_odom: T_odom_base and T_map_odom after the cycle (m, m, rad); None before the first step.
        codes: `Limits.codes`; None if no step was made, or in recordings without light.
        samples: blocks received so far. light: pose of the light filter after the cycle; None where it has none.
        rung: `Limits.level`. switched: `CycleRecord.switched`; the map is in a file of its own (:func:`switch_name`).
        reason: published with the state; None in older recordings, which have no ``faults`` either.
        faults: numbers of all published faults, gravest first. Every cycle has them: a recording may begin with any.
        waiting: `CycleRecord.waiting`, the only driver value that state and reason depend on.
    """

    cycle: int
    scan: int | None
    dropped: tuple[int, ...]
    odometry: int
    imu: int
    commands: tuple[CommandEntry, ...]
    limits: tuple[int, int, bool] | None
    answers: tuple[int, ...]
    state: int
    odom: Pose | None = None
    map_odom: Pose | None = None
    codes: int | None = None
    samples: int = 0
    light: Pose | None = None
    rung: int = 0
    switched: str = ""
    reason: int | None = None
    faults: tuple[int, ...] = ()
    waiting: bool = False

    def caps(self) -> Limits | None:
        """Returns the caps of the step as the estimator's type; None if no step was made."""
        if self.limits is None:
            return None
        return Limits(*self.limits, UNLIMITED.codes if self.codes is None else self.codes, self.rung)

    def orders(self) -> list[Command]:
        """Returns the commands as the estimator's type."""
        return [
            Command(entry.t_begin, Order(entry.order), None if entry.pose is None else np.array(entry.pose))
            for entry in self.commands
        ]


_encode: Final = msgspec.msgpack.Encoder().encode
_decode: Final = msgspec.msgpack.Decoder(CycleEntry).decode


def decode_cycle(payload: bytes) -> CycleEntry:
    """Returns the cycle in a CYCLE record.

    Raises:
        msgspec.DecodeError: the payload is not a cycle.
    """
    return _decode(payload)


def _pose(T: Array | None) -> Pose | None:
    return None if T is None else (float(T[0]), float(T[1]), float(T[2]))


def _entry(record: CycleRecord) -> CycleEntry:
    limits, result = record.limits, record.result
    return CycleEntry(
        cycle=record.cycle,
        scan=record.scan,
        dropped=record.dropped,
        odometry=record.odometry,
        imu=record.imu,
        commands=tuple(CommandEntry(c.t_begin, c.order.value, _pose(c.T_map_base)) for c in record.commands),
        limits=None if limits is None else (limits.icp_iterations, limits.points, limits.update_map),
        answers=record.answers,
        state=int(record.snapshot.state),
        odom=None if result is None else _pose(result.T_odom_base),
        map_odom=None if result is None else _pose(result.T_map_odom),
        codes=None if limits is None else limits.codes,
        samples=record.samples,
        light=light_of(result),
        rung=0 if limits is None else limits.level,
        switched=record.switched,
        reason=record.snapshot.reason,
        faults=_faults(record.snapshot),
        waiting=record.waiting,
    )


def _faults(snapshot: Snapshot) -> tuple[int, ...]:
    if snapshot.condition is not None:
        return snapshot.condition.faults
    return (snapshot.fault,) if snapshot.fault else ()


def light_of(result: StepResult | None) -> Pose | None:
    """Returns the pose of the light filter as (x, y, yaw) in m, m, rad; None where there is none."""
    return None if result is None or result.lights is None else _pose(result.lights.T_map_base)


class Recorder:
    """Records a running daemon. No method blocks, and no disk error raises, except in :meth:`keep_switch`.

    :meth:`tap` wraps the port opener of a driver. :meth:`on_scan`, :meth:`on_samples`, :meth:`on_odometry` and
    :meth:`on_imu` wrap the callbacks of the sources. :meth:`on_cycle` observes the cycle.

    Attributes:
        t_begun: start of the run as in the head, s; an input without data counts as timed out from then on.
    """

    def __init__(
        self,
        folder: Path,
        config: Config,
        clock: Clock,
        lights: Lights | None = None,
        start: Start | None = None,
        keep_s: float = math.inf,
    ) -> None:
        """Starts a recording in a new folder below ``folder``, named by its start time.

        ``lights``, ``start``: light setup and initial map of the estimator, which a replay needs again. ``keep_s``: how
        far back the recording reaches, s (`daemon.recording.retention`). If nothing can be written, now or later,
        :attr:`error` gives the reason and the writer tries again. A robot must localise on a full disk, too.
        """
        t_mono, t_utc = both(clock)
        started = datetime.fromtimestamp(t_utc, UTC)
        header: dict[str, Any] = {
            "recording": f"{started:%Y-%m-%dT%H-%M-%S.%f}",
            "t_mono": t_mono,
            "t_utc": t_utc,
            "versions": versions(),
            "config": msgspec.to_builtins(config),
            **({} if lights is None else lights.header()),
            **({} if start is None else {MAP: {"sha256": hashlib.sha256(start.content).hexdigest()}}),
        }
        self._clock, self.t_begun = clock, t_mono
        beside = {RESIDUALS: lights.residuals} if lights is not None and lights.residuals else {}
        beside |= {} if start is None else {START: start.content}  # too large for every head
        self.disk: Final = SegmentWriter(folder, f"{started:%Y-%m-%dT%H-%M-%SZ}", header, beside=beside, clock=clock)
        self.box: Final = BlackBox(self.disk, clock, header, keep_s)

    @property
    def error(self) -> str:
        """Why nothing is being written at present; empty without trouble."""
        return self.disk.error

    @property
    def failing(self) -> set[str]:
        """Names of the parts of the recording that do not work at present."""
        return {name for name, error in (("recorder", self.error), ("flight recorder", self.box.failing)) if error}

    def close(self, ended: bool = True) -> None:
        """Writes and syncs the remaining data; idempotent. ``ended``: the run ended as intended."""
        self.disk.close()
        self.box.close(ended)

    def on_cycle(self, record: CycleRecord) -> None:
        """Records the decisions of a cycle (`daemon.runtime.cycle_parts.Tap`)."""
        self.disk.put(Kind.CYCLE, 0, record.t_mono, _encode(_entry(record)))
        self.box.on_cycle(record)

    def keep_switch(self, sha256: str, content: bytes) -> None:
        """Stores a map that the run is about to switch to; for another thread, because the map may be large.

        Raises:
            OSError: the file cannot be written.
        """
        write_whole(self.disk.folder / switch_name(sha256), content)

    def on_scan(self, then: Callable[[RawScan], None]) -> Callable[[RawScan], None]:
        """Wraps a scan callback: records the scan and forwards it."""

        def mark(scan: RawScan) -> None:
            self.disk.put(Kind.SCAN, LIDAR, scan.t_rx, pack_scan(scan))
            self.box.line.scan()
            then(scan)

        return mark

    def on_samples(self, then: Callable[[RawSamples], None]) -> Callable[[RawSamples], None]:
        """Wraps a sample-block callback: records the block and forwards it."""

        def keep(block: RawSamples) -> None:
            self.disk.put(Kind.SAMPLES, PHOTODIODE, block.t1, pack_samples(block))
            then(block)

        return keep

    def on_odometry(self, then: Callable[[RawOdometry], None]) -> Callable[[RawOdometry], None]:
        """Wraps an odometry callback: records the reading and forwards it."""

        def keep(reading: RawOdometry) -> None:
            self.disk.put(Kind.ODOMETRY, 0, reading.t_rx, pack_odometry(reading))
            then(reading)

        return keep

    def on_imu(self, then: Callable[[RawImu], None]) -> Callable[[RawImu], None]:
        """Wraps a gyro callback: records the reading and forwards it."""

        def keep(reading: RawImu) -> None:
            self.disk.put(Kind.IMU, 0, reading.t_rx, pack_imu(reading))
            then(reading)

        return keep

    def tap(self, opener: PortOpener, channel: int = LIDAR) -> PortOpener:
        """Wraps a port opener: its ports record all bytes that pass through them."""
        return tapped(opener, partial(self._passed, channel), self._clock)

    def _passed(self, channel: int, kind: Kind, t_mono: float, payload: bytes) -> None:
        self.disk.put(kind, channel, t_mono, payload)
        if channel == LIDAR:
            self.box.line.passed(kind, t_mono, payload)
