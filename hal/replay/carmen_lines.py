"""Parses one line of a CARMEN log: the text format only, no I/O, nothing across lines.

Formats as the logger itself writes them at the head of a log (carmen.sourceforge.net/logger_playback.html)::

    FLASER n ranges.. x y theta odom_x odom_y odom_theta TAIL
    ROBOTLASER1 type start fov resolution max accuracy remission_mode n ranges.. [m remissions..]
        laser_x laser_y laser_theta x y theta tv rv forward side [axis] TAIL
    RAWLASER1 type start fov resolution max accuracy remission_mode n ranges.. [m remissions..] TAIL
    ODOM x y theta tv rv accel TAIL
    PARAM name value [TAIL]

where ``TAIL`` is ``ipc_time host logger_time``.
"""

from __future__ import annotations

import math
from array import array
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

Pose = tuple[float, float, float]

_TAIL: Final = 3  # ipc time, host, logger time
_CONFIG: Final = 7  # laser type, start, field of view, resolution, maximum, accuracy, remission mode
_MOST_BEAMS: Final = 20_000

OTHER_KINDS: Final = frozenset(
    b"SYNC TRUEPOS RLASER LASER3 LASER4 LASER5 RAWLASER2 RAWLASER3 RAWLASER4 RAWLASER5 ROBOTLASER2 "
    b"NMEAGGA NMEARMC GPGGA GPRMC MARKER NEFF".split()
)
"""Kinds of the format that the player does not use (second lasers, GPS, ground truth of a simulator)."""


class LineProblem(Exception):
    """Why one line cannot be used, in one clause."""


@dataclass(frozen=True, slots=True)
class LaserSetup:
    """The laser's setup in a laser line; NaN where it is missing. Radians and metres.

    Attributes:
        count: beams. start: bearing of the first. fov, resolution: as written. maximum: range that means no return.
    """

    count: int
    start: float = math.nan
    fov: float = math.nan
    resolution: float = math.nan
    maximum: float = math.nan


@dataclass(frozen=True, slots=True)
class LaserLine:
    """A scan: ranges in metres, poses in the odometry frame, ``stamp`` in seconds.

    Attributes:
        laser, robot: first and second pose triple; None where missing or not finite.
        remission: one value per beam, empty where missing. Arrays, since a whole log is in memory at once.
    """

    setup: LaserSetup
    ranges: array[float]
    remission: array[float]
    laser: Pose | None
    robot: Pose | None
    stamp: float


@dataclass(frozen=True, slots=True)
class OdometryLine:
    """A wheel odometry reading: the robot's pose in the odometry frame."""

    pose: Pose
    stamp: float


@dataclass(frozen=True, slots=True)
class ParameterLine:
    """A parameter of the logged system; values stay text."""

    name: str
    value: str


Line = LaserLine | OdometryLine | ParameterLine


def parse(line: bytes) -> Line | None:
    """Parse one line; None for blank lines, comments and unused kinds.

    Raises:
        LineProblem: a malformed line of a used kind, or an unknown kind.
    """
    words = line.split()
    if not words or words[0][:1] in (b"#", b"%", b'"'):
        return None
    reader = _READERS.get(words[0])
    if reader is None:
        if words[0] in OTHER_KINDS:
            return None
        raise LineProblem(f"unknown kind of line {words[0][:24].decode('ascii', 'backslashreplace')!r}")
    try:
        return reader(words)
    except (ValueError, IndexError) as error:
        raise LineProblem(f"{words[0].decode()}: {_clause(error)}") from error


def _clause(error: Exception) -> str:
    return "fields are missing" if isinstance(error, IndexError) else str(error)


def _count(word: bytes) -> int:
    count = int(word)
    if not 1 <= count <= _MOST_BEAMS:
        raise ValueError(f"{count} beams")
    return count


def _stamp(words: list[bytes], at: int) -> float:
    """The ipc time; host and logger's time must end the line after it, else lines were cut or joined."""
    if len(words) != at + _TAIL:
        raise ValueError(f"{len(words)} fields instead of {at + _TAIL}")
    stamp = float(words[at])
    if not math.isfinite(stamp):
        raise ValueError("the time stamp is not a number")
    return stamp


def _pose(values: list[float]) -> Pose | None:
    """Three numbers as a pose; None where one is not finite (the line's scan is still used)."""
    return (values[0], values[1], values[2]) if all(map(math.isfinite, values)) else None


def _numbers(words: list[bytes]) -> array[float]:
    return array("d", map(float, words))


def _flaser(words: list[bytes]) -> LaserLine:
    count = _count(words[1])
    end = 2 + count + 6
    stamp = _stamp(words, end)
    ranges = _numbers(words[2 : 2 + count])
    poses = list(map(float, words[2 + count : end]))
    return LaserLine(LaserSetup(count), ranges, array("d"), _pose(poses[:3]), _pose(poses[3:]), stamp)


def _configured(words: list[bytes]) -> tuple[LaserSetup, array[float], int]:
    """Setup and ranges of the newer laser lines, and the index of the first word after the ranges."""
    config = list(map(float, words[1 : 1 + _CONFIG]))
    count = _count(words[1 + _CONFIG])
    end = 2 + _CONFIG + count
    if len(words) < end + _TAIL:
        raise IndexError
    setup = LaserSetup(count, start=config[1], fov=config[2], resolution=config[3], maximum=config[4])
    return setup, _numbers(words[2 + _CONFIG : end]), end


def _remissions(words: list[bytes], at: int, rest: tuple[int, ...]) -> tuple[array[float], int]:
    """Remission values and the next index.

    Old logs omit the count of remissions. A count has no decimal point, a pose has.

    Args:
        words: the line.
        at: index after the ranges.
        rest: possible numbers of fields before the three last ones.
    """
    after = len(words) - at - _TAIL
    if words[at].isdigit():
        count = int(words[at])
        if after - 1 - count in rest:
            return _numbers(words[at + 1 : at + 1 + count]), at + 1 + count
    if after in rest:
        return array("d"), at
    raise ValueError(f"{after} fields between the ranges and the time stamp")


def _robotlaser(words: list[bytes]) -> LaserLine:
    setup, ranges, at = _configured(words)
    remission, at = _remissions(words, at, (10, 11))
    stamp = _stamp(words, len(words) - _TAIL)
    poses = list(map(float, words[at : at + 6]))
    return LaserLine(setup, ranges, _whole(remission, setup), _pose(poses[:3]), _pose(poses[3:]), stamp)


def _rawlaser(words: list[bytes]) -> LaserLine:
    setup, ranges, at = _configured(words)
    remission, at = _remissions(words, at, (0,))
    return LaserLine(setup, ranges, _whole(remission, setup), None, None, _stamp(words, at))


def _whole(remission: array[float], setup: LaserSetup) -> array[float]:
    """Remissions, if every beam has one; else none."""
    return remission if len(remission) == setup.count else array("d")


def _odometry(words: list[bytes]) -> OdometryLine:
    stamp = _stamp(words, 7)
    pose = _pose(list(map(float, words[1:4])))
    if pose is None:
        raise ValueError("the pose is not a number")
    return OdometryLine(pose, stamp)


def _parameter(words: list[bytes]) -> ParameterLine:
    """``PARAM name value [ipc_time host logger_time]``; a value may be empty or several words."""
    value = words[2:] if len(words) < 6 else words[2:-_TAIL]
    return ParameterLine(words[1].decode("utf-8", "replace"), b" ".join(value).decode("utf-8", "replace"))


_READERS: Final[dict[bytes, Callable[[list[bytes]], Line]]] = {
    b"FLASER": _flaser,
    b"ROBOTLASER1": _robotlaser,
    b"RAWLASER1": _rawlaser,
    b"ODOM": _odometry,
    b"PARAM": _parameter,
}
