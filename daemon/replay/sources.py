"""Log sources: CARMEN logs, SCIP captures and recordings as one stream of events, in order of arrival.

Scans, odometry and gyro readings of a log carry their arrival time in the virtual clock. Our own recordings also
contain where each cycle ran (`CycleEntry`). In every other log a cycle runs when a scan has arrived.
"""

from __future__ import annotations

import hashlib
import math
import struct
import time
from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, ClassVar, Final

import msgspec

from daemon.recording.recorder import LIDAR, CycleEntry, decode_cycle
from daemon.recording.replay_start import Moment, beginning, read_moment, state_beside
from hal.adc import RawSamples
from hal.errors import DataInvalid
from hal.hokuyo.passive import PassiveHokuyo
from hal.imu import RawImu
from hal.lidar import LidarStatus, RawScan
from hal.odometry import RawOdometry
from hal.replay.capture import Chunk, looks_like_capture, read_capture
from hal.replay.carmen import CarmenLog, read_carmen
from hal.replay.player import LEAD_S
from hal.replay.recording import (
    Frame,
    Kind,
    Recording,
    ScanMark,
    frames_in,
    looks_like_recording,
    open_recording,
    unpack_imu,
    unpack_odometry,
    unpack_samples,
    unpack_scan,
)
from hal.replay.report import LogReport
from hal.replay.text import head, unreadable

Mount = tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class Turn:
    """A recorded cycle that began at ``t_mono``, s; ``entry``: its input and decisions."""

    t_mono: float
    entry: CycleEntry


Event = RawScan | RawSamples | RawOdometry | RawImu | Turn


class Source(ABC):
    """A log, ready to be replayed once.

    Attributes:
        kind: of log, for the operator. recorded: whether it contains where cycles ran.
        path: as the user named it. files: in order.
        report: what was skipped or assumed, complete at the end. status: counters of the driver, live.
        total: units of progress in the whole log; done: so far.
        mount: (x, y, yaw) of the lidar in the log, m, m, rad; or None.
        header: of a recording: its versions and configuration.
        begin: checkpoint that it begins with; None at the start of a run.
        t_begun: start of the run in its own time, s; 0: not known.
        read_s: duration of opening it, s.
    """

    kind: ClassVar[str]
    recorded: ClassVar[bool] = False

    def __init__(self, path: Path, report: LogReport, status: LidarStatus, total: int) -> None:
        self.path = path
        self.files: tuple[Path, ...] = (path,)
        self.report = report
        self.status = status
        self.total, self.done = total, 0
        self.mount: Mount | None = None
        self.header: dict[str, Any] = {}
        self.begin: Moment | None = None
        self.t_begun = 0.0
        self.read_s = 0.0

    @abstractmethod
    def events(self) -> Iterator[Event]:
        """Yields all events in order."""

    def utc(self, t_mono: float) -> float:
        """Returns the log's own stamp, s, for an instant of the virtual clock, if it has one without scans."""
        return t_mono

    @abstractmethod
    def stamp(self, scan: RawScan) -> float:
        """Returns the log's own stamp of a scan that it has delivered, s."""


def open_log(path: Path) -> Source:
    """Detects the kind of a log and reads as much of it as its replay needs.

    Raises:
        HalError: missing, unreadable, of no known kind, or without usable time; names the file and the remedy.
    """
    begun = time.perf_counter()
    source = _open(path)
    source.read_s = time.perf_counter() - begun
    return source


def _open(path: Path) -> Source:
    if path.is_dir():
        return RecordingSource(path)
    begin = head(path)
    if looks_like_recording(begin):
        return RecordingSource(path)
    if looks_like_capture(begin):
        return CaptureSource(path)
    for magic, what in FOREIGN.items():
        if begin.startswith(magic):
            remedy = "replay or export the recording from which it was made" if "MCAP" in what else _REMEDY
            raise DataInvalid(str(path), f"is {what}, which cannot be replayed", remedy)
    return CarmenSource(path)


MCAP_MAGIC: Final = b"\x89MCAP0\r\n"
FOREIGN: Final = {
    b"#ROSBAG": "a ROS 1 bag",
    MCAP_MAGIC: "an MCAP file",
    b"SQLite format 3": "a ROS 2 bag",
    b"PK\x03\x04": "a zip or npz archive",
    b"\x93NUMPY": "a numpy array",
    b"\xfd7zXZ": "an xz archive",
    b"BZh": "a bzip2 archive",
}
MOVED_S: Final = 0.005
"""Tolerance between decoded and recorded scan times, s: the passive codec has neither the baud rate nor the driver's
model of the sensor clock."""
_REMEDY: Final = "unpack it, or convert it to a CARMEN log with `lumiloop convert IN OUT`"


def sha256_of(source: Source) -> str:
    """Returns the digest of a log: of its file, or of a recording's segments one after the other.

    Raises:
        HalError: a file cannot be read.
    """
    digest = hashlib.sha256()
    for file in source.files:
        try:
            with file.open("rb") as data:
                while chunk := data.read(1 << 20):
                    digest.update(chunk)
        except OSError as error:
            raise unreadable(file, error) from error
    return digest.hexdigest()


class CarmenSource(Source):
    """A CARMEN log; see `hal.replay.carmen`."""

    kind = "CARMEN log"

    def __init__(self, path: Path) -> None:
        """Reads the log; raises `HalError`."""
        self._log: CarmenLog = read_carmen(path)
        super().__init__(path, self._log.report, LidarStatus(dialect=self.kind), len(self._log.stamps))
        self.mount = self._log.mount

    def events(self) -> Iterator[Event]:
        """Yields scans in file order, with the odometry due before each."""
        for event in self._log.events(LEAD_S):
            if isinstance(event, RawScan):
                self.done += 1
                self.status.scans += 1
            yield event

    def stamp(self, scan: RawScan) -> float:
        """Returns the stamp as in the log, s, without the changes that make time monotonic."""
        return float(self._log.stamps[scan.seq])


class CaptureSource(Source):
    """Bytes from a SCIP sensor; see `hal.replay.capture`."""

    kind = "SCIP capture"

    def __init__(self, path: Path) -> None:
        """Reads the capture; raises `HalError`."""
        report = LogReport()
        self._chunks: list[Chunk] = read_capture(path, report)
        self._codec = PassiveHokuyo(device=str(path))
        super().__init__(path, report, self._codec.status, len(self._chunks))
        self._origin = 1e-6 * self._chunks[0].t_us

    def events(self) -> Iterator[Event]:
        """Yields scans as their last byte arrives."""
        latest = 0.0
        for chunk in self._chunks:
            self.done += 1
            latest = max(latest, 1e-6 * chunk.t_us - self._origin)
            yield from self._codec.feed(chunk.data, LEAD_S + latest)
        if self.status.scans == 0:
            self.report.notes.append(
                "the capture has no scan: it is of the host's side, or of a dialogue without measurement"
            )

    def stamp(self, scan: RawScan) -> float:
        """Returns the time of the capturing host, s."""
        return scan.t_mono - LEAD_S + self._origin


@dataclass(slots=True)
class _Marks:
    """Decoded scans that no mark has claimed yet, and the counts of mismatches."""

    decoded: list[RawScan] = field(default_factory=list)
    moved: int = 0
    unmarked: int = 0
    missing: int = 0


def _size(file: Path) -> int:
    """Returns the size of a file, bytes; raises `HalError`, as a running ring may just have removed it."""
    try:
        return file.stat().st_size
    except OSError as error:
        raise unreadable(file, error) from error


def _number(header: dict[str, Any], key: str) -> float:
    """Returns an entry of a header; 0 if it is no finite number."""
    value = header.get(key, 0.0)
    return float(value) if isinstance(value, float | int) and math.isfinite(value) else 0.0


class RecordingSource(Source):
    """A recording of our own: bytes through the codec, cycles where they ran; see `daemon.recording.recorder`."""

    kind = "recording"
    recorded = True

    def __init__(self, path: Path, until: float = -math.inf) -> None:
        """Opens it at its beginning, or at the last checkpoint before the instant ``until`` (t_mono, s).

        Raises:
            HalError: it cannot be read.
        """
        whole = open_recording(path)
        self._recording: Recording = beginning(whole, until)
        self._codec = PassiveHokuyo(device=str(path), untimed=self._recording.first > 0)
        size = sum(map(_size, self._recording.segments))
        super().__init__(path, LogReport(), self._codec.status, size)
        self.files = self._recording.segments
        self.header = self._recording.header
        self.t_begun = _number(self.header, "t_mono")
        self._utc = _number(self.header, "t_utc") - self.t_begun
        self._marks = _Marks()
        if state_beside(self._recording.segments[0]).exists() and self._recording.first > 0:
            self.begin = read_moment(state_beside(self._recording.segments[0]))
        if len(self._recording.segments) < len(whole.segments) and until == -math.inf:
            self.report.notes.append(
                f"begins with segment {self._recording.first}; the checkpoints of earlier segments are lost"
            )

    def stamp(self, scan: RawScan) -> float:
        """Returns UTC, s: that of the recording computer at the start, extrapolated by its monotonic clock."""
        return self.utc(scan.t_mono)

    def utc(self, t_mono: float) -> float:
        """Returns the UTC of an instant, s; see :meth:`stamp`."""
        return self._utc + t_mono

    def events(self) -> Iterator[Event]:
        """Yields inputs and cycles in the order in which they happened."""
        if self.begin is not None:
            self._listen_in(self.begin)
        for frame in self._recording.frames(self.report):
            self.done += len(frame.payload) + 20
            try:
                event = self._event(frame)
            except (struct.error, ValueError, msgspec.DecodeError) as error:
                self.report.skip(self.done, f"{Kind(frame.kind).name} record cannot be read: {error}")
                continue
            if event is not None:
                yield event
        self._say()

    def _listen_in(self, moment: Moment) -> None:
        """Feeds the codec with the bytes of the lidar line before the checkpoint."""
        for frame in frames_in(moment.line):
            self._event(frame)
        self._marks = _Marks()
        self.report.notes.append(f"begins within a run, with the checkpoint after cycle {moment.cycle}")

    def _event(self, frame: Frame) -> Event | None:
        match frame.kind:
            case Kind.RX if frame.channel == LIDAR:
                self._marks.decoded += self._codec.feed(frame.payload, frame.t_mono)
            case Kind.OPEN | Kind.LOST:
                self._codec.restart()
            case Kind.SCAN:
                return self._claim(unpack_scan(frame.payload))
            case Kind.SAMPLES:
                return unpack_samples(frame.payload)
            case Kind.ODOMETRY:
                return unpack_odometry(frame.payload)
            case Kind.IMU:
                return unpack_imu(frame.payload)
            case Kind.CYCLE:
                return Turn(frame.t_mono, decode_cycle(frame.payload))
            case Kind.NOTE:
                self.report.notes.append(frame.payload.decode("utf-8", "replace"))
        return None

    def _claim(self, mark: ScanMark) -> RawScan | None:
        """Returns the decoded scan that the driver delivered then, with the driver's number and time.

        The passive codec has the bytes alone. Scans that the driver skipped (it was still opening the sensor) are
        omitted. Where both had different histories of the sensor clock, the driver's time is used.
        """
        marks = self._marks
        while marks.decoded and marks.decoded[0].t_rx < mark.t_rx:
            marks.decoded.pop(0)
            marks.unmarked += 1
        if not marks.decoded or marks.decoded[0].t_rx != mark.t_rx:
            marks.missing += 1
            return None
        scan = marks.decoded.pop(0)
        marks.moved += abs(scan.t_mono - mark.t_mono) > MOVED_S
        return replace(scan, seq=mark.seq, t_mono=mark.t_mono, t_sigma=mark.t_sigma)

    def _say(self) -> None:
        marks, notes = self._marks, self.report.notes
        if marks.missing:
            notes.append(f"{marks.missing} delivered scans are missing in the recorded bytes")
        if marks.unmarked:
            notes.append(f"{marks.unmarked} scans in the recorded bytes were not delivered then and are skipped")
        if marks.moved:
            notes.append(
                f"{marks.moved} scans keep the time of the recorded driver, which differs from that of the bytes"
            )
