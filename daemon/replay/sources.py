"""Logs of every kind as one stream of events, in the order in which the daemon would have seen them.

A log's scans, odometry and gyro readings carry the time of their arrival in the virtual clock. A recording of our own
also says where each cycle ran (`CycleEntry`); in every other log a cycle runs when a scan has arrived.
"""

from __future__ import annotations

import hashlib
import math
import struct
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
    """A recorded cycle: it began at ``t_mono`` and did what ``entry`` says."""

    t_mono: float
    entry: CycleEntry


Event = RawScan | RawSamples | RawOdometry | RawImu | Turn


class Source(ABC):
    """A log, ready to be played once.

    Attributes:
        kind: of log, for people. recorded: whether it says where cycles ran.
        path: as the user named it. files: in order.
        report: what was skipped or assumed, complete at the end. status: the driver's counters, live.
        total: units of progress in the whole log; done: so far.
        mount: (x, y, yaw) of the lidar as the log knows it, m and rad, or None.
        header: of a recording: versions and configuration it was made with.
        begin: the moment that it begins at, None where that is the start of a run.
        t_begun: start of the run in its own time, 0: not known.
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

    @abstractmethod
    def events(self) -> Iterator[Event]:
        """Everything in order."""

    def utc(self, t_mono: float) -> float:
        """The log's own stamp for an instant of the virtual clock, where it has one that goes on without scans."""
        return t_mono

    @abstractmethod
    def stamp(self, scan: RawScan) -> float:
        """The log's own stamp, seconds, of a scan it has delivered."""


def open_log(path: Path) -> Source:
    """Find out what kind of log this is and read as much of it as is needed to play it.

    Raises:
        HalError: missing, unreadable, or of no known kind; names the file and the remedy.
    """
    if path.is_dir():
        return RecordingSource(path)
    begin = head(path)
    if looks_like_recording(begin):
        return RecordingSource(path)
    if looks_like_capture(begin):
        return CaptureSource(path)
    for magic, what in FOREIGN.items():
        if begin.startswith(magic):
            remedy = "replay or export the recording that it was made of" if "MCAP" in what else _REMEDY
            raise DataInvalid(str(path), f"is {what}, which cannot be replayed", remedy)
    return CarmenSource(path)


FOREIGN: Final = {
    b"#ROSBAG": "a ROS 1 bag",
    b"\x89MCAP0\r\n": "an MCAP file",
    b"SQLite format 3": "a ROS 2 bag",
    b"PK\x03\x04": "a zip or npz archive",
    b"\x93NUMPY": "a numpy array",
    b"\xfd7zXZ": "an xz archive",
    b"BZh": "a bzip2 archive",
}
MOVED_S: Final = 0.005
"""The passive codec does not know the speed of the line, nor what the driver knew of the sensor's clock."""
_REMEDY: Final = "unpack it, or turn it into a CARMEN log with `lumiloop convert IN OUT`"


def sha256_of(source: Source) -> str:
    """Digest of a log: of its file, or of a recording's segments one after the other; raises `HalError`."""
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
        """Read it; raises `HalError`."""
        self._log: CarmenLog = read_carmen(path)
        super().__init__(path, self._log.report, LidarStatus(dialect=self.kind), len(self._log.stamps))
        self.mount = self._log.mount

    def events(self) -> Iterator[Event]:
        """Scans in file order, with the odometry due before each."""
        for event in self._log.events(LEAD_S):
            if isinstance(event, RawScan):
                self.done += 1
                self.status.scans += 1
            yield event

    def stamp(self, scan: RawScan) -> float:
        """The stamp as the log has it, whatever was done to make time monotone."""
        return float(self._log.stamps[scan.seq])


class CaptureSource(Source):
    """What a SCIP sensor said, byte for byte; see `hal.replay.capture`."""

    kind = "SCIP capture"

    def __init__(self, path: Path) -> None:
        """Read it; raises `HalError`."""
        report = LogReport()
        self._chunks: list[Chunk] = read_capture(path, report)
        self._codec = PassiveHokuyo(device=str(path))
        super().__init__(path, report, self._codec.status, len(self._chunks))
        self._origin = 1e-6 * self._chunks[0].t_us

    def events(self) -> Iterator[Event]:
        """Scans as their last byte arrives."""
        latest = 0.0
        for chunk in self._chunks:
            self.done += 1
            latest = max(latest, 1e-6 * chunk.t_us - self._origin)
            yield from self._codec.feed(chunk.data, LEAD_S + latest)
        if self.status.scans == 0:
            self.report.notes.append(
                "no scan in it: a capture of the host's side, or of a dialogue without measurement"
            )

    def stamp(self, scan: RawScan) -> float:
        """Time of the capturing host."""
        return scan.t_mono - LEAD_S + self._origin


@dataclass(slots=True)
class _Marks:
    """Scans that were decoded and not yet claimed by a mark, and what did not fit together."""

    decoded: list[RawScan] = field(default_factory=list)
    moved: int = 0
    unmarked: int = 0
    missing: int = 0


def _size(file: Path) -> int:
    """Bytes of a file, which the keeper of a ring that is being written may just have taken away; raises `HalError`."""
    try:
        return file.stat().st_size
    except OSError as error:
        raise unreadable(file, error) from error


def _number(header: dict[str, Any], key: str) -> float:
    """An entry of a header, 0 where it holds none that is a number."""
    value = header.get(key, 0.0)
    return float(value) if isinstance(value, float | int) and math.isfinite(value) else 0.0


class RecordingSource(Source):
    """A recording of our own: bytes through the codec, cycles where they ran; see `daemon.recording.recorder`."""

    kind = "recording"
    recorded = True

    def __init__(self, path: Path, until: float = -math.inf) -> None:
        """Open it, at its beginning or at the last state before the instant ``until`` (t_mono); raises `HalError`."""
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
            self.report.notes.append(f"begins with segment {self._recording.first}: what is before has lost its state")

    def stamp(self, scan: RawScan) -> float:
        """UTC as the recording computer knew it when the recording began, carried on by its monotonic clock."""
        return self.utc(scan.t_mono)

    def utc(self, t_mono: float) -> float:
        """UTC of an instant; see :meth:`stamp`."""
        return self._utc + t_mono

    def events(self) -> Iterator[Event]:
        """Inputs and cycles in the order in which they happened."""
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
        """Let the codec hear what the line had said before."""
        for frame in frames_in(moment.line):
            self._event(frame)
        self._marks = _Marks()
        self.report.notes.append(f"begins in the middle of a run, with the state after cycle {moment.cycle}")

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
        """The decoded scan that the driver delivered then, under the driver's number and time.

        The passive codec sees the bytes alone. Scans that the driver passed over (it was still opening the sensor) stay
        out, and where the two saw different histories of the sensor's clock, the driver's time counts.
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
            notes.append(f"{marks.missing} scans were delivered when recorded, but their bytes hold no such scan")
        if marks.unmarked:
            notes.append(f"{marks.unmarked} scans in the bytes were not delivered when recorded: left out")
        if marks.moved:
            notes.append(f"{marks.moved} scans keep the time of the recorded driver; the bytes alone say another")
