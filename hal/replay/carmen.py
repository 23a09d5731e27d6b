"""Reads a CARMEN log as a lidar with wheel odometry.

The whole log is read first. Beam geometry, no-return range, mount of the laser and monotone time are missing in its
lines and follow only from the log as a whole. Ranges become whole millimetres, finer than the resolution of these
lasers. Unusable lines are skipped and counted with their numbers; the rest is played in file order.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt

from hal.errors import DataInvalid
from hal.lidar import LidarGeometry, RawScan
from hal.odometry import RawOdometry
from hal.replay.carmen_lines import LaserLine, LineProblem, OdometryLine, ParameterLine, parse
from hal.replay.carmen_scans import CarmenScan, convert
from hal.replay.geometry_guess import beam_geometry
from hal.replay.monotone_stamps import LASTS, Monotone, monotone
from hal.replay.mount import log_mount
from hal.replay.report import LogReport
from hal.replay.text import Torn, lines

Array = npt.NDArray[np.float64]

_GIVE_UP_LINES: Final = 1000
_NO_ODOMETRY: Final = (np.empty(0), np.empty((0, 3)))
_NO_TIME: Final = "name a log with the UNIX time of every scan in seconds"
_REMEDY: Final = "name a log with scans, or make one with `lumiloop convert IN OUT`"


@dataclass(frozen=True, slots=True, eq=False)
class CarmenLog:
    """A log in memory.

    Attributes:
        stamps: original stamp of every scan in file order, seconds; spread where the log's clock is coarse. time: their
            monotone time (first near 0).
        mount: (x, y, yaw) of the laser on the robot, m and rad. report: skipped lines and assumptions.
    """

    path: Path
    stamps: Array
    time: Array
    mount: tuple[float, float, float]
    parameters: dict[str, str]
    report: LogReport
    _scans: list[CarmenScan] = field(repr=False)
    _odometry: tuple[Array, Array] = field(repr=False)  # time (n,), pose (n, 3)

    @property
    def dialect(self) -> str:
        """Kind of log, for people."""
        return "CARMEN log"

    @property
    def geometry(self) -> LidarGeometry:
        """Geometry of the first scan."""
        return self._scans[0].geometry

    @property
    def has_odometry(self) -> bool:
        """Whether the log carries usable wheel odometry."""
        return len(self._odometry[0]) > 0

    def events(self, start: float) -> Iterator[RawScan | RawOdometry]:
        """Scans in file order with the odometry due before each; the first record at ``start`` seconds."""
        odometry_time, poses = self._odometry
        shift = start - min([float(self.time[0]), *odometry_time[:1].tolist()])
        readings = zip((odometry_time + shift).tolist(), poses.tolist(), strict=True)
        reading = next(readings, None)
        for seq, t_scan in enumerate((self.time + shift).tolist()):
            scan = self._scan(seq, t_scan)
            while reading is not None and reading[0] <= scan.t_rx:
                yield RawOdometry(reading[0], reading[0], *reading[1])
                reading = next(readings, None)
            yield scan

    def _scan(self, seq: int, t_scan: float) -> RawScan:
        scan = self._scans[seq]
        ranges, code = scan.beams()
        return RawScan(
            geometry=scan.geometry,
            seq=seq,
            t_rx=t_scan + scan.geometry.beam_dt_s * (len(ranges) - 1),
            t_mono=t_scan,
            t_sigma=0.0,
            t_tick=-1,
            first_step=0,
            stride=1,
            ranges=ranges,
            code=code,
            intensity=scan.intensity,
        )


@dataclass(slots=True)
class _Parsed:
    """Usable lines, in file order."""

    lasers: list[LaserLine] = field(default_factory=list)
    odometry: list[OdometryLine] = field(default_factory=list)
    parameters: dict[str, str] = field(default_factory=dict)


def read_carmen(path: Path) -> CarmenLog:
    """Read a CARMEN log (``.gz`` or not).

    Raises:
        DeviceMissing, DeviceRefused: no such file, or no permission to read it.
        DataInvalid: no scan in it, or stamps without usable time; names file, line and remedy.
    """
    report = LogReport()
    parsed = _parse_all(path, report)
    lasers = _usable(parsed.lasers, report)
    if not lasers:
        raise DataInvalid(str(path), "has no usable scan line", _first_reasons(report))
    lasers = _ordered(lasers, report)
    stamps = np.array([line.stamp for line in lasers])
    origin = float(stamps[0])
    clock = monotone(stamps, origin)
    if clock.refusal:
        raise DataInvalid(str(path), f"its stamps cannot be used as times: {clock.refusal}", _NO_TIME)
    _note_stamps(clock, report)
    separate = _separate_odometry(parsed.odometry, origin, report)
    return CarmenLog(
        path=path,
        stamps=origin + clock.time if clock.coarse_s else stamps,
        time=clock.time,
        mount=log_mount(lasers, parsed.parameters, report),
        parameters=parsed.parameters,
        report=report,
        _scans=convert(lasers, parsed.parameters, clock.time, report),
        _odometry=_odometry(lasers, clock.time, separate, report),
    )


def _first_reasons(report: LogReport) -> str:
    reasons = [f"line {entry.first[0]}: {reason}" for reason, entry in report.skipped.items()]
    return "; ".join(reasons[:3]) or "it has odometry, but no FLASER, ROBOTLASER1 or RAWLASER1 line"


def _parse_all(path: Path, report: LogReport) -> _Parsed:
    parsed, torn = _Parsed(), Torn()
    number = 0
    for number, line in lines(path, torn):
        try:
            record = parse(line)
        except LineProblem as problem:
            report.skip(number, str(problem))
            _give_up(path, number, parsed, problem)
            continue
        if isinstance(record, LaserLine):
            parsed.lasers.append(record)
        elif isinstance(record, OdometryLine):
            parsed.odometry.append(record)
        elif isinstance(record, ParameterLine):
            parsed.parameters[record.name] = record.value
    _note_file(path, number, torn, parsed, report)
    return parsed


def _give_up(path: Path, number: int, parsed: _Parsed, problem: LineProblem) -> None:
    """Refuse another kind of file after its first thousand lines, before reading gigabytes."""
    if number >= _GIVE_UP_LINES and not (parsed.lasers or parsed.odometry or parsed.parameters):
        raise DataInvalid(f"{path}:{number}", f"not a CARMEN log: {problem}", _REMEDY)


def _note_file(path: Path, number: int, torn: Torn, parsed: _Parsed, report: LogReport) -> None:
    if number == 0:
        what = torn.reason or "the file is empty"
        raise DataInvalid(str(path), what, "record or download the log again")
    if torn.reason:
        report.notes.append(f"{torn.reason} after line {number}; the part before it is used")
    if not parsed.lasers and not parsed.odometry:
        raise DataInvalid(
            f"{path}:{number}", "not a CARMEN log: no FLASER, ROBOTLASER1 or RAWLASER1 line up to here", _REMEDY
        )
    report.use("laser lines", len(parsed.lasers))
    report.use("separate odometry lines", len(parsed.odometry))
    report.use("parameters", len(parsed.parameters))


def _usable(lasers: list[LaserLine], report: LogReport) -> list[LaserLine]:
    """Drop old-style scans with an unusual beam count and no geometry of their own."""
    counts = Counter(line.setup.count for line in lasers)
    usual = counts.most_common(1)[0][0] if counts else 0
    used: list[LaserLine] = []
    for index, line in enumerate(lasers):
        if line.setup.count == usual or beam_geometry(line.setup)[2]:
            used.append(line)
        else:
            report.skip(
                index + 1, f"{line.setup.count} beams, but the lidar of the log has {usual} (numbers count scan lines)"
            )
    if used and not beam_geometry(used[0].setup)[2]:
        report.notes.append(f"the log has no bearings for its {usual} beams; the replay assumes 180 deg from -90 deg")
    return used


def _ordered(lasers: list[LaserLine], report: LogReport) -> list[LaserLine]:
    """The scans in the order in which they were taken: that of the file, or that of their stamps.

    Where a few stamps run backwards, one of the two is wrong. The wheels decide: in the wrong order the robot drives to
    and fro, so its path is longer. A clock that was set displaces all scans that follow, and leaves the file's order.
    """
    order = np.argsort([line.stamp for line in lasers], kind="stable")
    away = np.abs(order - np.arange(len(order)))
    if not 0 < away.max() < LASTS or any(line.robot is None for line in lasers):
        return lasers
    poses = np.array([line.robot for line in lasers])
    if not _path(poses[order]) < _path(poses):
        return lasers
    moved = np.count_nonzero(away)
    report.notes.append(f"{moved} scans are out of order; they are sorted by their stamps, which fit odometry")
    return [lasers[k] for k in order.tolist()]


def _path(poses: Array) -> float:
    """Length of a path plus its rotation, m + rad."""
    dx, dy, dyaw = np.diff(poses, axis=0).T
    return float(np.sum(np.hypot(dx, dy) + np.abs((dyaw + np.pi) % (2.0 * np.pi) - np.pi)))


def _note_stamps(clock: Monotone, report: LogReport) -> None:
    if clock.backward:
        report.notes.append(
            f"stamps run backwards {clock.backward} times, by {clock.worst_s:.3f} s at most; the order of the "
            "file is kept"
        )
    if clock.wild:
        report.notes.append(f"{clock.wild} single stamps are far from both neighbours; they are interpolated")
    if clock.coarse_s:
        report.notes.append(
            f"the log's clock steps by {clock.coarse_s:.3g} s, and {clock.duplicates} stamps equal the one "
            "before; they are spread evenly over each step"
        )
    elif clock.duplicates:
        report.notes.append(f"{clock.duplicates} stamps equal the one before; they are spread in time")
    if clock.restarts:
        report.notes.append(f"the log's clock restarted or was set {clock.restarts} times; the steps are removed")


def _separate_odometry(readings: list[OdometryLine], origin: float, report: LogReport) -> tuple[Array, Array]:
    """Time and poses of the ODOM lines."""
    if not readings:
        return _NO_ODOMETRY
    clock = monotone(np.array([reading.stamp for reading in readings]), origin)
    if len(readings) > 1 and clock.duplicates == len(readings) - 1:
        report.notes.append("all ODOM lines have one stamp and are not used")
        return _NO_ODOMETRY
    return clock.time, np.array([reading.pose for reading in readings])


def _odometry(
    lasers: list[LaserLine], time: Array, separate: tuple[Array, Array], report: LogReport
) -> tuple[Array, Array]:
    """Time and poses of the wheel odometry: from the laser lines (true at the scan's stamp), else from ODOM lines."""
    posed = np.array([line.robot is not None for line in lasers])
    poses = np.array([line.robot for line in lasers if line.robot is not None]).reshape(-1, 3)
    if _moves(poses):
        if not posed.all():
            report.notes.append(f"{np.count_nonzero(~posed)} scan lines have no usable robot pose")
        return time[posed], poses
    if _moves(separate[1]):
        return separate
    report.notes.append("no wheel odometry in the log (its pose is missing or never changes)")
    return _NO_ODOMETRY


def _moves(poses: Array) -> bool:
    return len(poses) > 1 and bool(np.any(poses != poses[0]))
