"""Converter of recorded lidar data in other formats to CARMEN logs for `lumiloop replay`.

The content of the input determines its format:

* the ``.dat`` files of CoreSLAM/BreezySLAM (``.gz`` too): a HOKUYO URG-04LX on a rover with wheel encoders, one scan a
  line: [0] time in us, [2] [3] encoder counts left and right, [24..705] 682 ranges in mm from step 44 to 725, 0 where
  there was no return;
* an ``.npz`` with ``t_device_s``, ``range_mm``, ``angle_min_rad``, ``angle_increment_rad``, ``time_increment_s``: scans
  of a HOKUYO UTM-30LX.

The log gets ROBOTLASER1 lines with start angle, field of view and resolution. PARAM lines contain what such a line has
no field for: the mount, the model, its ranges, the scan period and the time between beams.
"""

from __future__ import annotations

import gzip
import math
import zipfile
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt

from hal.errors import HalError
from hal.replay.monotone_stamps import monotone
from hal.replay.report import LogReport
from hal.replay.text import Torn, lines

Array = npt.NDArray[np.float64]

URG_STEP_RAD: Final = 2.0 * math.pi / 1024.0
URG_FIRST_STEP, URG_FRONT_STEP = 44, 384
URG_BEAMS, URG_FIELDS, URG_RANGES_AT = 682, 707, 24
GIVE_UP_LINES: Final = 100
"""Lines without a scan at the beginning after which a file is of another kind."""
URG_PERIOD_S: Final = 0.1
ROVER_COUNT_M: Final = 2.0 * math.pi * 0.077 / 2000.0
ROVER_HALF_TRACK_M: Final = 0.165
ROVER_MOUNT: Final = (0.145, 0.0, 0.0)
ROVER_HIDDEN_BEAMS: Final = 70
ROVER_TRUSTED_MM: Final = 4000
UTM_STEPS: Final = 1440
DELAY_S: Final = 0.12
"""Delay from the first beam to the arrival, s: odometry and scans of exp1 and exp2 agree best with it about every turn.
The RMS is 0.66 and 0.74 deg, against 1.70 and 1.82 with the host's stamps.
"""
MOTOR_TOLERANCE: Final = 0.03
PERIODS_TRIED: Final = 6001


class NotConverted(Exception):
    """The input cannot be converted; the text names the file, the place, and the expected content."""


@dataclass(frozen=True)
class Laser:
    """Lidar parameters of the log: angles in rad, ranges in mm, times in s."""

    model: str
    start: float
    step: float
    dmin: int
    dmax: int
    period: float
    beam_dt: float
    mount: tuple[float, float, float] = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class Scans:
    """Stamps (n,) in s, ranges (n, beams) in mm, robot poses (n, 3) by odometry in m, m, rad.

    ``report``: what of the input was skipped or repaired.
    """

    laser: Laser
    stamps: Array
    ranges: npt.NDArray[np.int64]
    poses: Array
    report: LogReport = field(default_factory=LogReport)


def read(path: Path) -> Scans:
    """Reads any of the known formats.

    Raises:
        NotConverted: the file cannot be read, or is empty.
    """
    try:
        with path.open("rb") as file:
            begin = file.read(4)
    except OSError as error:
        raise NotConverted(f"{path}: {error.strerror}") from error
    if not begin:
        raise NotConverted(f"{path}: the file is empty")
    return read_npz(path) if begin.startswith(b"PK\x03\x04") else read_dat(path)


def read_dat(path: Path) -> Scans:
    """Returns a ``.dat`` file as logged: every range, stamps of the host, odometry poses at those stamps."""
    report = LogReport()
    rows = _rows(path, report)
    laser = Laser(
        model="URG-04LX",
        start=(URG_FIRST_STEP - URG_FRONT_STEP) * URG_STEP_RAD,
        step=URG_STEP_RAD,
        dmin=20,
        dmax=5600,
        period=URG_PERIOD_S,
        beam_dt=URG_PERIOD_S / 1024.0,
        mount=ROVER_MOUNT,
    )
    ranges = rows[:, URG_RANGES_AT : URG_RANGES_AT + URG_BEAMS].astype(np.int64)
    return Scans(laser, _timed(path, 1e-6 * rows[:, 0], report), ranges, wheel_poses(rows[:, 2:4]), report)


def _rows(path: Path, report: LogReport) -> Array:
    """Returns the fields of every scan, (n, 707); lines that are no scan are counted in ``report``.

    Raises:
        NotConverted: it cannot be read, or holds no scan.
    """
    torn, rows = Torn(), []
    try:
        for number, line in lines(path, torn):
            try:
                rows.append(_fields(line))
            except ValueError as error:
                report.skip(number, str(error))
                if not rows and number >= GIVE_UP_LINES:
                    break
    except HalError as error:
        raise NotConverted(str(error)) from error
    if torn.reason:
        report.notes.append(f"{torn.reason}; the part before it is used")
    if not rows:
        first = next(((entry.first[0], reason) for reason, entry in report.skipped.items()), None)
        raise NotConverted(f"{path}: {torn.reason}" if first is None else f"{path}:{first[0]}: {first[1]}")
    return np.array(rows)


def _fields(line: bytes) -> list[float]:
    words = line.split()
    if len(words) != URG_FIELDS:
        raise ValueError(f"{len(words)} fields; a scan of this format has {URG_FIELDS}")
    values = list(map(float, words))
    if not all(map(math.isfinite, values)):
        raise ValueError("a field is not a number")
    return values


def _timed(path: Path, stamps: Array, report: LogReport) -> Array:
    """Returns stamps that increase, s: as they are if they do, repaired where the clock was set or is coarse.

    Raises:
        NotConverted: they contain no usable time.
    """
    clock = monotone(stamps, float(stamps[0]))
    if clock.refusal:
        raise NotConverted(f"{path}: its stamps cannot be used as times: {clock.refusal}")
    if np.all(np.diff(stamps) > 0.0) and not clock.restarts:
        return stamps
    report.notes.append("stamps run backwards or repeat; clock steps are removed, and equal stamps are spread in time")
    return np.asarray(stamps[0] + clock.time)


def wheel_poses(counts: Array) -> Array:
    """Returns (n, 3) poses of the middle of the axle from (n, 2) cumulative counts left and right; arcs, not chords."""
    left, right = np.diff(counts * ROVER_COUNT_M, axis=0, prepend=counts[:1] * ROVER_COUNT_M).T
    way, turn = (left + right) / 2.0, (right - left) / (2.0 * ROVER_HALF_TRACK_M)
    yaw = np.cumsum(turn)
    middle = yaw - turn / 2.0
    chord = way * np.sinc(turn / (2.0 * np.pi))
    return np.column_stack([np.cumsum(chord * np.cos(middle)), np.cumsum(chord * np.sin(middle)), yaw])


def read_npz(path: Path) -> Scans:
    """Returns an ``.npz`` file of UTM-30LX scans; it has no odometry."""
    names = ("t_device_s", "range_mm", "angle_min_rad", "angle_increment_rad", "time_increment_s")
    try:
        with path.open("rb") as file, np.load(file, allow_pickle=False) as data:
            stamps, ranges, start, step, beam_dt = (np.asarray(data[name]) for name in names)
    except (KeyError, ValueError, zipfile.BadZipFile, OSError) as error:
        raise NotConverted(f"{path}: {error}; expected the arrays {', '.join(names)}") from error
    if ranges.ndim != 2 or stamps.shape != ranges.shape[:1]:
        raise NotConverted(f"{path}: {stamps.shape} stamps for ranges of shape {ranges.shape}")
    laser = Laser("UTM-30LX", float(start), float(step), 23, 60_000, UTM_STEPS * float(beam_dt), float(beam_dt))
    report, times = LogReport(), stamps.astype(np.float64)
    if not len(times) or not np.all(np.isfinite(times)):
        raise NotConverted(f"{path}: {len(times)} stamps, of which {np.count_nonzero(np.isfinite(times))} are numbers")
    return Scans(laser, _timed(path, times, report), ranges.astype(np.int64), np.zeros((len(times), 3)), report)


def even_stamps(scans: Scans, delay: float) -> Scans:
    """Replaces the arrival stamp of each scan by the instant of its motor revolution, and interpolates the pose there.

    The motor turns evenly, but the host receives unevenly. An arrival identifies its revolution; all arrivals together
    determine the instants of the revolutions. ``delay``: from the first beam of a scan to its mean arrival, s.
    """
    if len(scans.stamps) < 2:  # no period follows from one scan
        return scans
    period, first = _rhythm(scans.stamps)
    turns = _turns((scans.stamps - first) / period)
    late = scans.stamps - first - turns * period
    first += float(np.median(late)) - delay
    stamps = first + turns * period
    poses = np.column_stack([np.interp(stamps, scans.stamps, column) for column in scans.poses.T])
    laser = replace(scans.laser, period=period, beam_dt=period / 1024.0)
    return replace(scans, stamps=stamps, poses=poses, laser=laser)


def _rhythm(stamps: Array) -> tuple[float, float]:
    """Returns period and one instant, s, of the regular grid closest to the arrivals (peak of their periodogram)."""
    usual = float(np.median(np.diff(stamps)))
    late = stamps - stamps[0]
    periods = usual * np.linspace(1.0 - MOTOR_TOLERANCE, 1.0 + MOTOR_TOLERANCE, PERIODS_TRIED)
    peaks = np.array([np.exp(2j * np.pi * late / period).mean() for period in periods])
    best = int(np.abs(peaks).argmax())
    return float(periods[best]), float(stamps[0] + np.angle(peaks[best]) / (2.0 * np.pi) * periods[best])


def _turns(late: Array) -> Array:
    """Returns rising whole revolutions nearest to ``late``; in a burst of arrivals, those before the last are late."""
    turns = np.rint(late)
    for k in range(len(turns) - 2, -1, -1):
        turns[k] = min(turns[k], turns[k + 1] - 1.0)
    return np.asarray(turns)


def trusted(scans: Scans, hidden: int, farthest: int) -> Scans:
    """Removes ``hidden`` beams at either end (they hit the rover itself) and ranges beyond ``farthest`` mm."""
    ranges = scans.ranges.copy()
    ranges[:, :hidden] = 0
    ranges[:, ranges.shape[1] - hidden :] = 0
    ranges[ranges > farthest] = 0
    return replace(scans, ranges=ranges)


def write(path: Path, scans: Scans, source: str) -> None:
    """Writes the log, gzipped if the name ends with ``.gz``.

    Raises:
        NotConverted: the file cannot be written.
    """
    text = ("\n".join(_lines(scans, source)) + "\n").encode()
    try:
        path.write_bytes(gzip.compress(text, 5, mtime=0) if path.suffix == ".gz" else text)
    except OSError as error:
        raise NotConverted(f"{path}: {error.strerror}") from error


def _lines(scans: Scans, source: str) -> Iterator[str]:
    laser, count = scans.laser, scans.ranges.shape[1]
    first = f"{scans.stamps[0]:.6f} convert 0"
    yield f"# made from {source} by lumiloop convert; see docs/data.md"
    yield from (f"PARAM {name} {value} {first}" for name, value in _parameters(laser).items())
    setup = f"0 {laser.start:.9f} {laser.step * (count - 1):.9f} {laser.step:.12f} {(laser.dmax + 1) / 1e3:.3f} 0.001 0"
    mount = laser.mount
    for stamp, ranges, pose in zip(scans.stamps.tolist(), scans.ranges.tolist(), scans.poses.tolist(), strict=True):
        values = " ".join(f"{value / 1e3:.3f}" for value in ranges)
        robot = " ".join(f"{value:.9f}" for value in pose)
        yaw = pose[2]
        x = pose[0] + math.cos(yaw) * mount[0] - math.sin(yaw) * mount[1]
        y = pose[1] + math.sin(yaw) * mount[0] + math.cos(yaw) * mount[1]
        seen = f"{x:.9f} {y:.9f} {yaw + mount[2]:.9f}"
        tail = f"0 0 0 0 0 {stamp:.6f} convert {stamp - scans.stamps[0]:.6f}"
        yield f"ROBOTLASER1 {setup} {count} {values} 0 {seen} {robot} {tail}"


def _parameters(laser: Laser) -> dict[str, str]:
    """Returns CARMEN's own parameters where they exist, and ours for the rest (`hal.replay.carmen_scans`)."""
    x, y, yaw = laser.mount
    return {
        "robot_frontlaser_offset": f"{x:.6f}",
        "robot_frontlaser_side_offset": f"{y:.6f}",
        "robot_frontlaser_angular_offset": f"{yaw:.6f}",
        "lumiloop_laser_model": laser.model,
        "lumiloop_laser_dmin": f"{laser.dmin / 1e3:.3f}",
        "lumiloop_laser_period": f"{laser.period:.9f}",
        "lumiloop_laser_beam_dt": f"{laser.beam_dt:.12f}",
    }


def convert(source: Path, log: Path, logged: bool = False, delay: float = DELAY_S, every: bool = False) -> Scans:
    """Converts a file to a CARMEN log and returns the scans that were written.

    Scans of a rover's log get even stamps, unless ``logged``. They lose beams that hit the rover, unless ``every``.

    Raises:
        NotConverted: the input cannot be read, or the log cannot be written.
    """
    scans = read(source)
    if scans.laser.model == "URG-04LX":
        scans = scans if logged else even_stamps(scans, delay)
        scans = scans if every else trusted(scans, ROVER_HIDDEN_BEAMS, ROVER_TRUSTED_MM)
    write(log, scans, source.name)
    return scans
